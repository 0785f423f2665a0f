"""Resampling: nothing is shifted, bent or aliased, at any rational ratio."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import Recording
from vehest.data.transforms import Resample, windowed_sinc

RATIOS = [(100.0, 20.0), (125.0, 20.0), (125.0, 100.0), (1000.0, 20.0), (20.0, 100.0), (50.0, 30.0), (1000.0 / 3.0, 20.0), (400.0, 100.0)]
PROPERTY = settings(max_examples=60, deadline=None, derandomize=True, database=None)
SMALL = st.floats(-1e3, 1e3)
every_ratio = pytest.mark.parametrize(("rate", "new_rate"), RATIOS)


def recorded(samples, rate_hz, start_time=0.0):
    return Recording("lap", "car", rate_hz, start_time, {"ay": samples})


def resampled(samples, rate, new_rate):
    return Resample(new_rate)(recorded(samples, rate))["ay"]


@every_ratio
@pytest.mark.parametrize("length", [1, 7, 40, 12_000])
def test_filter_and_sums_are_those_of_scipy_to_the_bit(rate, new_rate, length):
    ratio = Fraction(new_rate / rate).limit_denominator(1000)
    up, down = ratio.numerator, ratio.denominator
    samples, half = np.cumsum(np.random.default_rng(length).normal(size=length)), 16 * max(up, down)
    sinc, window = windowed_sinc(half, 0.86 / max(up, down), 7.0)
    np.testing.assert_array_equal(window, signal.windows.kaiser(2 * half + 1, 7.0))
    np.testing.assert_array_equal(sinc, signal.firwin(2 * half + 1, 0.86 / max(up, down), window=("kaiser", 7.0)))
    taps = Resample(new_rate)._taps(up, down)
    margin = -(-(half // up + 1) // down) * down
    extended = np.pad(samples, margin, mode="reflect", reflect_type="odd") if length > 1 else np.pad(samples, margin, mode="edge")
    expected = signal.resample_poly(extended, up, down, window=taps)[margin * up // down :][: -(-length * up // down)]
    np.testing.assert_array_equal(resampled(samples, rate, new_rate), expected)


@pytest.mark.parametrize(("rate", "new_rate"), [ratio for ratio in RATIOS if ratio[1] < ratio[0]])
def test_what_lies_above_the_new_nyquist_frequency_is_attenuated_by_60_db(rate, new_rate):
    seconds = 200 / new_rate
    time = np.arange(round(seconds * rate)) / rate
    for frequency in np.linspace(new_rate / 2, rate / 2, 23):
        out = Resample(new_rate)(recorded(np.sin(2 * np.pi * frequency * time + 0.4), rate))
        inside = (out.time > 17 / new_rate) & (out.time < seconds - 17 / new_rate)
        assert np.abs(out["ay"][inside]).max() < 1e-3, frequency


@every_ratio
@pytest.mark.parametrize("length", [1, 2, 3, 50, 101])
def test_the_first_sample_keeps_its_time_and_the_last_lies_in_the_recording(rate, new_rate, length):
    recording = recorded(np.zeros(length), rate, start_time=1_700_000_000.25)
    out = Resample(new_rate)(recording)
    assert out.start_time == recording.start_time
    assert out.rate_hz == new_rate
    ratio = (Fraction(new_rate) / Fraction(rate)).limit_denominator(1000)
    assert len(out) == math.ceil(length * ratio)
    assert Fraction(len(out) - 1) / ratio < length


@PROPERTY
@given(st.integers(1, 80), st.integers(1, 40))
def test_plain_decimation_takes_every_nth_sample_as_it_is(length, step):
    samples = np.random.default_rng(length).standard_normal(length)
    out = Resample(1000.0 / step, method="decimate")(recorded(samples, 1000.0))
    assert out["ay"].tolist() == samples.tolist()[::step]


def test_the_same_rate_changes_nothing():
    recording = recorded(np.random.default_rng(0).standard_normal(99), 100.0)
    for method in ("polyphase", "decimate"):
        assert Resample(100.0, method=method)(recording) is recording


def test_channels_with_gaps_are_refused_by_the_filter_and_kept_by_decimation():
    samples = np.where(np.arange(20) % 4 == 0, 1.0, np.nan)
    recording = Recording("lap", "car", 100.0, 0.0, {"ay": samples, "ax": np.zeros(20)}, gappy=frozenset({"ay"}))
    with pytest.raises(DataError, match="'ay' has gaps") as error:
        Resample(20.0)(recording)
    assert "method=decimate" in str(error.value)
    np.testing.assert_array_equal(Resample(20.0, method="decimate")(recording)["ay"], samples[::5])


def test_ratios_that_a_method_cannot_make_are_refused():
    with pytest.raises(DataError, match="not a ratio of whole numbers"):
        Resample(100.0 / math.pi)(recorded(np.zeros(10), 100.0))
    with pytest.raises(DataError, match="not a ratio of whole numbers"):
        Resample(20.0)(recorded(np.zeros(10), 99.997))
    with pytest.raises(DataError, match="not a ratio of whole numbers"):
        Resample(1e-9)(recorded(np.zeros(10), 100.0))
    with pytest.raises(ConfigurationError, match="method=polyphase"):
        Resample(30.0, method="decimate")(recorded(np.zeros(10), 50.0))


@pytest.mark.parametrize("rate_hz", [0.0, math.nan, -1.0])
def test_a_rate_that_is_not_positive_is_refused(rate_hz):
    with pytest.raises(ConfigurationError, match="rate_hz must be a positive number"):
        Resample(rate_hz)


def test_only_decimation_is_causal():
    recording = recorded(np.zeros(400), 100.0)
    changed = recorded(np.where(np.arange(400) < 200, 0.0, 1.0), 100.0)
    for method, same in (("polyphase", False), ("decimate", True)):
        before = Resample(20.0, method=method)(recording)["ay"][:40]
        after = Resample(20.0, method=method)(changed)["ay"][:40]
        assert bool((before == after).all()) is same
