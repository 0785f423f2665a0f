"""Resampling: nothing is shifted, bent or aliased, at any rational ratio."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refusal
from scipy import signal

from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import Recording
from vehest.data.resampling import resampled
from vehest.data.transforms import Resample, windowed_sinc

RATIOS = [
    (100.0, 20.0),
    (125.0, 20.0),
    (125.0, 100.0),
    (1000.0, 20.0),
    (20.0, 100.0),
    (50.0, 30.0),
    (1000.0 / 3.0, 20.0),
    (400.0, 100.0),
]
PROPERTY = settings(max_examples=60, deadline=None, derandomize=True, database=None)
every_ratio = pytest.mark.parametrize(("rate", "new_rate"), RATIOS)


def recorded(samples, rate_hz, start_time=0.0):
    return Recording("lap", "car", rate_hz, start_time, {"ay": samples})


@every_ratio
@pytest.mark.parametrize("length", [1, 7, 40, 12_000])
def test_filter_and_sums_are_those_of_scipy_to_the_bit(rate, new_rate, length):
    ratio = Fraction(new_rate / rate).limit_denominator(1000)
    up = ratio.numerator
    down = ratio.denominator
    samples = np.cumsum(np.random.default_rng(length).normal(size=length))
    half = 16 * max(up, down)
    sinc, window = windowed_sinc(half, 0.86 / max(up, down), 7.0)
    np.testing.assert_array_equal(window, signal.windows.kaiser(2 * half + 1, 7.0))
    np.testing.assert_array_equal(
        sinc, signal.firwin(2 * half + 1, 0.86 / max(up, down), window=("kaiser", 7.0))
    )
    taps = Resample(new_rate).taps(up, down)
    margin = -(-(half // up + 1) // down) * down
    extended = (
        np.pad(samples, margin, mode="reflect", reflect_type="odd")
        if length > 1
        else np.pad(samples, margin, mode="edge")
    )
    expected = signal.resample_poly(extended, up, down, window=taps)[margin * up // down :][
        : -(-length * up // down)
    ]
    resampled = Resample(new_rate)(recorded(samples, rate, start_time=1_700_000_000.25))
    np.testing.assert_array_equal(resampled["ay"], expected)
    assert (resampled.start_time, resampled.rate_hz) == (1_700_000_000.25, new_rate)


@pytest.mark.parametrize(("rate", "new_rate"), [ratio for ratio in RATIOS if ratio[1] < ratio[0]])
def test_frequencies_above_the_new_nyquist_are_attenuated_by_60_db(rate, new_rate):
    seconds = 200 / new_rate
    time = np.arange(round(seconds * rate)) / rate
    for frequency in np.linspace(new_rate / 2, rate / 2, 23):
        out = Resample(new_rate)(recorded(np.sin(2 * np.pi * frequency * time + 0.4), rate))
        inside = (out.time > 17 / new_rate) & (out.time < seconds - 17 / new_rate)
        assert np.abs(out["ay"][inside]).max() < 1e-3, frequency


@PROPERTY
@given(st.integers(1, 80), st.integers(1, 40))
def test_plain_decimation_takes_every_nth_sample_as_it_is(length, step):
    samples = np.random.default_rng(length).standard_normal(length)
    out = Resample(1000.0 / step, method="decimate")(recorded(samples, 1000.0))
    assert out["ay"].tolist() == samples.tolist()[::step]


def test_resampling_to_the_same_rate_keeps_channels_with_gaps():
    recording = recorded(np.random.default_rng(0).standard_normal(99), 100.0)
    for method in ("polyphase", "decimate"):
        assert Resample(100.0, method=method)(recording) is recording
    samples = np.where(np.arange(20) % 4 == 0, 1.0, np.nan)
    recording = Recording(
        "lap", "car", 100.0, 0.0, {"ay": samples, "ax": np.zeros(20)}, gappy=frozenset({"ay"})
    )
    with pytest.raises(DataError, match="'ay' has gaps") as error:
        Resample(20.0)(recording)
    assert "method=decimate" in str(error.value)
    np.testing.assert_array_equal(Resample(20.0, method="decimate")(recording)["ay"], samples[::5])


def test_ratios_that_a_method_cannot_make_are_refused():
    for new_rate, rate in ((20.0, 99.997), (1e-9, 100.0)):
        with pytest.raises(DataError, match="not a ratio of whole numbers"):
            Resample(new_rate)(recorded(np.zeros(10), rate))
    assert "method=polyphase" in refusal(
        lambda: Resample(30.0, method="decimate")(recorded(np.zeros(10), 50.0)), ConfigurationError
    )
    for rate_hz in (0.0, math.nan):
        with pytest.raises(ConfigurationError, match="rate_hz must be a positive number"):
            Resample(rate_hz)


@pytest.mark.parametrize(("slowest_hz", "needed"), [(math.inf, 20.0), (5.0, 5.0)])
def test_a_recording_that_is_too_slow_is_refused_with_the_rate_that_would_do(slowest_hz, needed):
    slow = recorded(np.zeros(40), 2.0)
    preparation = {"method": "polyphase", "transforms": []}
    with pytest.raises(DataError, match=f"2 Hz, below the 20 Hz needed; .* at {needed:g} Hz or"):
        resampled(slow, 20.0, preparation, slowest_hz=slowest_hz)
