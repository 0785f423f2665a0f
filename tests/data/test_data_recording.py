"""Recordings, estimates, channels and units: what they refuse, and that cutting loses and doubles
nothing.
"""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refusal

from vehest.data.channels import CHANNELS, channel
from vehest.data.errors import DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.units import factor_to_si

PROPERTY = settings(max_examples=80, deadline=None, derandomize=True, database=None)
RATES = st.sampled_from([20.0, 100.0, 125.0, 1000.0 / 3.0, 400.0, 1000.0, 7.3, 99.997])
STARTS = st.sampled_from([0.0, 149.99, -3.7, 1e5, 1.7e9, 1_700_000_123.456])


def counting(length, rate_hz=100.0, start_time=0.0, **changes):
    """A recording whose samples are their own index."""
    return Recording("lap", "car", rate_hz, start_time, {"ay": np.arange(float(length))}, **changes)


@PROPERTY
@given(st.integers(1, 400), RATES, STARTS, st.lists(st.floats(-0.2, 1.2), max_size=5))
def test_consecutive_ranges_cover_every_sample_once(length, rate_hz, start_time, split_points):
    recording = counting(length, rate_hz, start_time)
    inner = [start_time + share * recording.duration for share in split_points]
    bounds = [-math.inf, *sorted(inner), math.inf]
    covered = []
    for start, stop in pairwise(bounds):
        first, end = recording.index_range(start, stop)
        if first < end:
            covered += recording.cut(start, stop)["ay"].tolist()
    assert covered == recording["ay"].tolist()


@PROPERTY
@given(st.integers(1, 400), RATES, STARTS, st.data())
def test_a_cut_at_two_sample_times_holds_the_first_and_not_the_second(
    length, rate_hz, start_time, data
):
    recording = counting(length, rate_hz, start_time)
    first = data.draw(st.integers(0, length - 1))
    end = data.draw(st.integers(first + 1, length))
    piece = recording.cut(
        recording.time[first], recording.time[end] if end < length else recording.end_time
    )
    assert piece["ay"].tolist() == list(range(first, end))
    assert piece.start_time == pytest.approx(recording.time[first], abs=1e-12, rel=1e-15)


def test_empty_ranges_missing_channels_and_unknown_quantities_are_refused():
    with pytest.raises(
        DataError,
        match=r"'lap' spans 10 s to 11 s; it has no samples between 10.501 s and 10.502 s",
    ):
        counting(100, 100.0, 10.0).cut(10.501, 10.502)
    with pytest.raises(DataError, match=r"'lap' has no channel 'vx' \(it has ay\)"):
        _ = counting(3)["vx"]
    for channels, message in (
        ({"vz": np.zeros(3)}, "unknown quantity 'vz'"),
        ({"vy": np.zeros(3), "vx": np.zeros(2)}, "one common length"),
    ):
        with pytest.raises(ValueError, match=message):
            Estimate("r", "ekf", 20.0, 0.0, channels)
    with pytest.raises(ValueError, match=r"not None and \(vy\)"):
        Estimate("r", "ekf", 20.0, 0.0, {"vy": np.zeros(3)}, covariance_of=("vy",))


def test_samples_are_immutable_copies_and_estimators_receive_no_references():
    samples = np.zeros(3)
    recording = Recording("r", "car", 10.0, 0.0, {"ay": samples})
    samples[0] = 1.0
    assert recording["ay"][0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        recording["ay"][0] = 1.0
    recording = Recording(
        "r",
        "car",
        10.0,
        0.0,
        {name: np.zeros(2) for name in ("vx", "vy_ref", "ay", "sideslip_ref")},
    )
    assert list(recording.without_references().channels) == ["vx", "ay"]
    assert "reference channels only" in refusal(
        lambda: recording.select(["vy_ref"]).without_references()
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"channels": {}}, "one common length"),
        ({"channels": {"ay": np.zeros(3), "ax": np.zeros(2)}}, "one common length"),
        ({"channels": {"ay": np.zeros((3, 1))}}, "one common length"),
        ({"channels": {"vz": np.zeros(3)}}, "'vz' is not known"),
        (
            {"channels": {"ay": np.array([0.0, np.nan, 0.0])}},
            "channel 'ay' holds 1 NaN between 0.1 s and 0.1 s",
        ),
        ({"channels": {"ay": np.array([0.0, np.inf, 0.0])}}, "infinite"),
        (
            {"channels": {"ay": np.array([np.nan, -np.inf])}, "gappy": frozenset({"ay"})},
            "holds 1 infinite values",
        ),
        ({"rate_hz": 0.0}, "rate must lie between 1e-06 and 100000 Hz, not at 0 Hz"),
        ({"start_time": math.nan}, "start time must be finite"),
        ({"kind": "reel"}, "real or simulated"),
    ],
)
def test_invalid_recordings_are_refused(changes, message):
    arguments = {
        "id": "r",
        "vehicle": "car",
        "rate_hz": 10.0,
        "start_time": 0.0,
        "channels": {"ay": np.zeros(3)},
    }
    assert message in refusal(lambda: Recording(**(arguments | changes)))


@PROPERTY
@given(st.integers(1, 60), RATES, STARTS, st.integers(1, 20))
def test_resampled_estimates_are_the_latest_not_in_the_future(length, rate_hz, start_time, finer):
    values = np.arange(float(length))
    estimate = Estimate("r", "ekf", rate_hz, start_time, {"vy": values, "sideslip": values})
    ticks = np.arange(-finer, (length + 1) * finer)  # sample k of the estimate is tick k·finer
    resampled = estimate.held_at(start_time + ticks / (rate_hz * finer), "vy")
    naive = [
        float(tick // finer) if 0 <= tick // finer < length else math.nan for tick in ticks.tolist()
    ]
    np.testing.assert_array_equal(resampled, naive)


SHAPES = [(shape, ("vy", "vx")) for shape in ((3, 2), (2, 2, 2), (3, 2, 1), (4, 2, 2))]
NAMES = [
    ((3, 2, 2), quantities)
    for quantities in ((), ("vy",), ("vy", "vy"), ("vy", "vz"), ("vy", "vx", "yaw_rate"))
]


@pytest.mark.parametrize(("shape", "names"), [*SHAPES, *NAMES])
def test_a_covariance_has_a_row_a_name(shape, names):
    with pytest.raises(ValueError, match=r"covariance_of name n quantities, not \([234].* and \("):
        Estimate(
            "r",
            "ekf",
            20.0,
            0.0,
            {"vy": np.zeros(3)},
            covariance=np.zeros(shape),
            covariance_of=names,
        )


def test_covariances_are_resampled_like_their_quantities_and_read_by_name():
    covariance = np.arange(27.0).reshape(3, 3, 3)
    estimate = Estimate(
        "r",
        "ukf",
        10.0,
        0.0,
        {"vy": np.zeros(3)},
        covariance=covariance,
        covariance_of=("vx", "vy", "friction"),
    )
    resampled = estimate.covariance_at(np.array([-0.05, 0.1, 0.19, 0.3]), ["friction", "vx"])
    assert np.isnan(resampled[[0, 3]]).all()
    assert (resampled[1] == [[17.0, 15.0], [11.0, 9.0]]).all()
    assert (resampled[2] == resampled[1]).all()
    assert "a covariance of vx, vy, friction, not of yaw_rate" in refusal(
        lambda: estimate.covariance_at(np.zeros(1), ["yaw_rate"])
    )


def test_units_of_something_else_and_unknown_channels_are_refused():
    for name, described in CHANNELS.items():
        assert name == described.name
        assert described.low < described.high
        assert factor_to_si(described.unit, described.unit) == 1.0
    assert "'vz' is not known" in refusal(lambda: channel("vz"))
    assert "'deg' cannot be converted to 'm/s'" in refusal(lambda: factor_to_si("deg", "m/s"))
    assert "'0*deg' is not known" in refusal(lambda: factor_to_si("0*deg", "rad"))
    assert "'furlong' is not known" in refusal(lambda: factor_to_si("furlong", "m/s"))


@pytest.mark.parametrize(
    ("unit", "si_unit", "si_value"),
    [
        ("km/h", "m/s", 1000 / 3600),
        ("mdeg/s", "rad/s", np.deg2rad(1.0) / 1000),
        ("deg/min", "rad/s", np.deg2rad(1.0) / 60),
        ("0.01*deg/s", "rad/s", np.deg2rad(1.0) * 0.01),
        ("0.005*m/s", "m/s", 0.005),
        ("mph", "m/s", 1609.344 / 3600),
        ("knots", "m/s", 1852 / 3600),
        ("g", "m/s²", 9.80665),
        ("m/s^2", "m/s²", 1.0),
        ("deg", "rad", np.deg2rad(1.0)),
        ("deg/s", "rad/s", np.deg2rad(1.0)),
        ("rpm", "rad/s", 2 * np.pi / 60),
        ("kN", "N", 1000.0),
        ("ms", "s", 1e-3),
        ("ns", "s", 1e-9),
    ],
)
def test_units_convert_as_defined(unit, si_unit, si_value):
    assert factor_to_si(unit, si_unit) == pytest.approx(si_value, rel=1e-15)
