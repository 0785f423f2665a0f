"""Filters and corrections: what each says about time and truth, checked against closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from refusals import refusal

from vehest.data import transforms
from vehest.data.derived import (
    AccelerationFromSpeed,
    ScaleToWheelbase,
    SideslipFromVelocity,
    SpeedFromWheels,
    VelocityFromSideslip,
)
from vehest.data.errors import ConfigurationError, DataError, VehestError
from vehest.data.recording import Recording
from vehest.data.transforms import (
    TRANSFORMS,
    LowPass,
    MountingCorrection,
    ReferenceLever,
    RemoveOutliers,
    Resample,
    transform_from_config,
)
from vehest.data.windows import windows_of

PROPERTY = settings(max_examples=50, deadline=None, derandomize=True, database=None)
RATE = 100.0


def recorded(**channels):
    return Recording("lap", "car", RATE, 3.0, channels)


def filtered(samples, direction, cutoff_hz=5.0):
    return LowPass(cutoff_hz, direction=direction)(recorded(ay=samples))["ay"]


def fitted_sine(samples, time, frequency):
    """Amplitude and phase of the sine that fits best."""
    basis = np.stack(
        [np.sin(2 * np.pi * frequency * time), np.cos(2 * np.pi * frequency * time)], axis=1
    )
    (sine, cosine), *_ = np.linalg.lstsq(basis, samples, rcond=None)
    return float(np.hypot(sine, cosine)), float(np.arctan2(cosine, sine))


def bilinear(frequency, cutoff_hz):
    """Response of a second-order Butterworth filter made digital by the bilinear transform with
    pre-warping.
    """
    warped = 1j * np.tan(np.pi * frequency / RATE) / np.tan(np.pi * cutoff_hz / RATE)
    return complex(1.0 / (warped**2 + math.sqrt(2.0) * warped + 1.0))


@pytest.mark.parametrize("frequency", [0.5, 2.0, 5.0, 9.0, 20.0])
def test_low_pass_has_the_gain_and_phase_of_a_butterworth_filter(frequency):
    time = np.arange(2000) / RATE
    inside = slice(500, 1500)
    response = bilinear(frequency, 5.0)
    sine = np.sin(2 * np.pi * frequency * time)
    gain, phase = fitted_sine(filtered(sine, "causal")[inside], time[inside], frequency)
    assert gain == pytest.approx(abs(response), rel=1e-6)
    assert phase == pytest.approx(np.angle(response), abs=1e-6)
    gain, phase = fitted_sine(filtered(sine, "zero_phase")[inside], time[inside], frequency)
    assert gain == pytest.approx(abs(response) ** 2, rel=1e-6)
    assert phase == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("cutoff_hz", [0.0, -1.0, 50.0, 80.0, math.nan])
def test_low_pass_beyond_nyquist_is_refused(cutoff_hz):
    assert "between 0 and 50 Hz" in refusal(
        lambda: LowPass(cutoff_hz)(recorded(ay=np.zeros(10))), ConfigurationError
    )
    assert "use design=butterworth for a causal one" in refusal(
        lambda: LowPass(5.0, direction="causal", design="fir"), ConfigurationError
    )


@pytest.mark.parametrize("frequency", [0.5, 2.0, 5.0, 9.0, 20.0])
def test_a_symmetric_low_pass_has_the_gain_of_its_taps_and_no_phase(frequency):
    time = np.arange(1000) / RATE
    samples = LowPass(5.0, design="fir")(recorded(ay=np.sin(2 * np.pi * frequency * time)))["ay"]
    lag = np.arange(-30, 31) / RATE
    taps = np.sinc(10.0 * lag) * (0.54 + 0.46 * np.cos(np.pi * lag / 0.3))
    response = float(np.sum(taps * np.cos(2 * np.pi * frequency * lag)) / taps.sum())
    inside = slice(200, 800)
    gain, phase = fitted_sine(samples[inside], time[inside], frequency)
    assert gain * np.cos(phase) == pytest.approx(response, abs=1e-6)
    assert gain * np.sin(phase) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("length", [1, 2, 7, 300])
def test_a_symmetric_low_pass_keeps_a_line_to_its_ends(length):
    line = 3.0 - 0.2 * np.arange(length)
    np.testing.assert_allclose(LowPass(5.0, design="fir")(recorded(ay=line))["ay"], line, atol=1e-9)


def test_reference_lever_brings_velocities_to_the_centre_of_gravity():
    """A point 2 m ahead and 0.5 m to the left of the centre of gravity of a car that turns about a
    fixed point.
    """
    yaw_rate = np.array([0.0, 0.4, -0.3])
    vx = np.full(3, 15.0)
    vy = np.array([0.0, -0.2, 0.4])
    at_sensor = {"vx_ref": vx - yaw_rate * 0.5, "vy_ref": vy + yaw_rate * 2.0, "yaw_rate": yaw_rate}
    moved = ReferenceLever(2.0, 0.5)(recorded(**at_sensor, sideslip_ref=np.zeros(3)))
    np.testing.assert_allclose(moved["vx_ref"], vx)
    np.testing.assert_allclose(moved["vy_ref"], vy)
    np.testing.assert_allclose(moved["sideslip_ref"], np.arctan2(vy, vx))


def test_outlier_removal_removes_planted_spikes_and_keeps_steps_and_ramps():
    time = np.arange(2000) / RATE
    clean = 4.0 * np.sin(2 * np.pi * 0.3 * time) + np.sin(2 * np.pi * 1.1 * time + 1.0)
    spikes = np.random.default_rng(3).choice(np.arange(0, len(clean), 8), 60, replace=False)
    spoilt = clean.copy()
    spoilt[spikes] += np.random.default_rng(4).choice([-1.0, 1.0], 60) * np.random.default_rng(
        5
    ).uniform(3, 50, 60)
    out = RemoveOutliers()(recorded(ay=spoilt))["ay"]
    assert np.abs(out - clean)[spikes].max() < 0.5
    untouched = np.setdiff1d(np.arange(len(clean)), spikes)
    np.testing.assert_array_equal(out[untouched], clean[untouched])
    for samples in (
        np.repeat([0.0, 5.0], 50),
        np.arange(100.0),
        np.round(np.arange(100.0) / 7.0),
        np.full(100, 2.0),
    ):
        np.testing.assert_array_equal(RemoveOutliers()(recorded(ay=samples))["ay"], samples)
    samples = np.zeros(50)
    samples[20] = 9.0
    np.testing.assert_array_equal(RemoveOutliers()(recorded(ay=samples))["ay"], np.zeros(50))
    np.testing.assert_array_equal(RemoveOutliers()(recorded(ay=clean))["ay"], clean)
    noisy = clean + 0.3 * np.random.default_rng(0).standard_normal(2000)
    assert (
        np.mean(RemoveOutliers()(recorded(ay=noisy))["ay"] == noisy) > 0.99
    )  # six deviations of eleven normal samples: a few in 1000
    for wrong in ({"half_window": 0}, {"threshold": 0.0}, {"half_window": -3}):
        message = refusal(
            lambda wrong=wrong: transform_from_config({"name": "remove_outliers", **wrong}),
            ConfigurationError,
        )
        assert "greater than 0" in message


@PROPERTY
@given(st.integers(1, 14), st.integers(1, 8), st.data())
def test_outlier_removal_of_short_recordings_stays_within_their_values(length, half_window, data):
    samples = data.draw(arrays(np.float64, length, elements=st.floats(-10, 10)))
    out = RemoveOutliers(half_window)(recorded(ay=samples))["ay"]
    assert len(out) == length
    assert out.min() >= samples.min()
    assert out.max() <= samples.max()


@pytest.mark.parametrize("beside", [0.0, 0.03])
def test_a_few_impossible_samples_are_bridged_by_lines_and_many_stay(beside):
    line = np.linspace(-5.0, 5.0, 400)
    spoilt = line.copy()
    reach = round(beside * RATE)
    spoilt[[100, 101]] = 9e3
    spoilt[100 - reach : 100] = spoilt[102 : 102 + reach] = (
        70.0  # of a slower signal that was interpolated
    )
    bridge = transform_from_config({"name": "bridge_impossible", "beside": beside})
    np.testing.assert_allclose(bridge(recorded(ay=spoilt))["ay"], line, atol=1e-12)
    np.testing.assert_array_equal(bridge(recorded(ay=100.0 * line))["ay"], 100.0 * line)


def rigid_body(lever_x, lever_y, yaw):
    """A car that circles and weaves, seen by a displaced and turned accelerometer, and what it does
    at its centre of gravity.

    The sensor's acceleration comes from differentiating its position in the plane twice, not from
    rigid-body formulae.
    """
    time = np.arange(800) / RATE
    step = 2e-4
    lever = complex(lever_x, lever_y)
    turn = np.exp(1j * yaw)  # the plane as complex numbers

    def heading(at):
        return 0.4 * at + 0.5 * np.sin(1.5 * at)

    def centre(at):
        return 20.0 * at + 3.0 * np.sin(0.7 * at) + 5.0j * np.cos(0.5 * at)

    def sensor(at):
        return centre(at) + lever * np.exp(1j * heading(at))

    def acceleration(position):
        """In the vehicle's axes."""
        return (
            (position(time + step) - 2 * position(time) + position(time - step))
            / step**2
            * np.exp(-1j * heading(time))
        )

    truth = acceleration(centre)
    measured = acceleration(sensor) / turn
    channels = {
        "ax": measured.real,
        "ay": measured.imag,
        "yaw_rate": 0.4 + 0.75 * np.cos(1.5 * time),
    }
    return Recording("lap", "car", RATE, 0.0, channels), truth.real, truth.imag


@pytest.mark.parametrize(
    ("lever_x", "lever_y", "yaw"),
    [(0.0, 0.0, 0.2), (1.3, 0.0, 0.0), (0.0, -0.6, 0.0), (-0.8, 0.5, -0.15)],
)
def test_mounting_correction_undoes_lever_arm_and_rotation(lever_x, lever_y, yaw):
    recording, true_ax, true_ay = rigid_body(lever_x, lever_y, yaw)
    corrected = MountingCorrection(lever_x, lever_y, yaw)(recording)
    inside = slice(1, -1)  # central differences of the yaw rate
    np.testing.assert_allclose(corrected["ax"][inside], true_ax[inside], atol=1e-4)
    np.testing.assert_allclose(corrected["ay"][inside], true_ay[inside], atol=1e-4)
    before = max(np.abs(recording["ax"] - true_ax).max(), np.abs(recording["ay"] - true_ay).max())
    assert before > 0.1


def test_mounting_correction_of_a_single_sample_includes_the_centripetal_part():
    recording = recorded(ax=np.array([1.0]), ay=np.array([2.0]), yaw_rate=np.array([0.5]))
    corrected = MountingCorrection(lever_x=2.0, lever_y=-1.0)(recording)
    assert corrected["ax"].tolist() == [1.0 + 0.25 * 2.0]
    assert corrected["ay"].tolist() == [2.0 - 0.25 * 1.0]


def test_filters_and_corrections_refuse_gaps_and_missing_channels_by_name():
    channels = {name: np.array([0.0, np.nan, 1.0, 2.0]) for name in ("ax", "ay", "yaw_rate")}
    recording = Recording("lap", "car", RATE, 0.0, channels, gappy=frozenset(channels))
    for transform in (LowPass(5.0), RemoveOutliers(), MountingCorrection(1.0)):
        with pytest.raises(DataError, match="has gaps and cannot be filtered"):
            transform(recording)
    for transform in (
        LowPass(5.0, channels=("vx",)),
        RemoveOutliers(channels=("vx",)),
        MountingCorrection(1.0),
    ):
        with pytest.raises(DataError, match=r"no channel '(vx|ax)'"):
            transform(recorded(ay=np.zeros(20)))


def test_transforms_are_built_from_plain_values():
    assert transform_from_config(
        {"name": "low_pass", "cutoff_hz": 5, "channels": ["ax", "ay"]}
    ) == LowPass(5, ("ax", "ay"))
    assert transform_from_config({"name": "remove_outliers", "channels": "ay"}) == RemoveOutliers(
        channels=("ay",)
    )
    assert transform_from_config({"name": "resample", "rate_hz": 20.0}) == Resample(20.0)
    # Those of an alignment are built from plain values in test_alignment.py.
    of_an_alignment = {"delay_correction", "offset_correction", "steering_ratio", "steering_curve"}
    assert transform_from_config({"name": "reference_lever", "lever_x": 2.0}) == ReferenceLever(2.0)
    configurations = {
        "resample",
        "low_pass",
        "remove_outliers",
        "bridge_impossible",
        "mounting_correction",
        "reference_lever",
        "speed_from_wheels",
    }
    deriving = {
        "acceleration_from_speed",
        "velocity_from_sideslip",
        "sideslip_from_velocity",
        "scale_to_wheelbase",
    }
    assert set(TRANSFORMS) == configurations | of_an_alignment | deriving


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"name": "high_pass"}, "'high_pass' is not one of: resample"),
        ({"name": "low_pass"}, "transform 'low_pass': cutoff_hz"),
        ({"name": "low_pass", "cutoff_hz": "5"}, "transform 'low_pass': cutoff_hz"),
        (
            {"name": "low_pass", "cutoff_hz": 5, "direction": "sideways"},
            "transform 'low_pass': direction",
        ),
        ({"name": "low_pass", "cutoff_hz": 5, "zero": 1}, "transform 'low_pass': "),
    ],
)
def test_misspelt_transforms_are_refused_in_a_single_line(config, message):
    assert message in refusal(lambda: transform_from_config(config), ConfigurationError)


WHEELS = SpeedFromWheels(wheel_radius=0.48, track_front=2.1, track_rear=2.0)


def rolling(**damages):
    """A car whose wheels roll, as Eqs. 61 to 64 have it, and its speed.

    ``shown`` replaces channels.
    """
    time = np.arange(2000) / RATE
    u = 8.0 + 3.0 * np.sin(0.7 * time)
    yaw_rate = 0.3 * np.sin(0.9 * time)
    steer = 0.2 * np.sin(0.9 * time)
    sides = {"fl": 1.05, "fr": -1.05, "rl": 1.0, "rr": -1.0}
    wheels = {f"wheel_speed_{place}": (u - yaw_rate * side) / 0.48 for place, side in sides.items()}
    for place in ("fl", "fr"):
        wheels[f"wheel_speed_{place}"] /= np.cos(steer)
    channels = {
        "yaw_rate": yaw_rate,
        "steer": steer,
        "ax": 2.1 * np.cos(0.7 * time),
        **wheels,
    } | damages
    gappy = frozenset(name for name, samples in channels.items() if np.isnan(samples).any())
    return Recording("lap", "car", RATE, 3.0, channels, gappy=gappy), u


def damaged(value, *wheels, start=500, stop=650):
    """The same with some wheels that show another value for a while."""
    complete, _ = rolling()
    broken = {}
    for wheel in wheels:
        broken[f"wheel_speed_{wheel}"] = np.array(complete[f"wheel_speed_{wheel}"])
        broken[f"wheel_speed_{wheel}"][start:stop] = value
    return rolling(**broken)


def test_speed_from_wheels_inverts_rolling_wheels():
    drive, u = rolling()
    np.testing.assert_allclose(WHEELS.corrected(drive), np.tile(u, (4, 1)), atol=1e-12)
    np.testing.assert_allclose(WHEELS(drive)["vx"], u, atol=1e-12)
    missing = np.full(2000, math.nan)
    assert "no wheel speed was measured" in refusal(lambda: WHEELS(rolling(yaw_rate=missing)[0]))
    complete, u = rolling()
    rear = complete.select(["wheel_speed_rl", "wheel_speed_rr"])
    np.testing.assert_allclose(
        SpeedFromWheels(wheel_radius=0.48)(rear)["vx"], u, atol=1e-12
    )  # left and right make up for the track
    single_wheel = complete.select(["wheel_speed_rl"])
    np.testing.assert_allclose(
        SpeedFromWheels(wheel_radius=0.48)(single_wheel)["vx"],
        0.48 * complete["wheel_speed_rl"],
        atol=1e-12,
    )
    assert "has no wheel speed to make vx of" in refusal(
        lambda: SpeedFromWheels(wheel_radius=0.48)(complete.select(["yaw_rate"]))
    )


def test_a_wheel_that_drops_out_or_spins_does_not_count_and_no_later_sample():
    for value in (0.0, 60.0, math.nan):
        drive, u = damaged(value, "fl")
        np.testing.assert_allclose(WHEELS(drive)["vx"], u, atol=1e-12)
    drive, _ = damaged(0.0, "rl", "rr")
    np.testing.assert_array_equal(WHEELS(drive.cut(3.0, 9.0))["vx"], WHEELS(drive)["vx"][:600])


@pytest.mark.parametrize("wheels", [("rl", "rr"), ("fl", "fr", "rl"), ("fl", "fr", "rl", "rr")])
def test_without_two_wheels_the_acceleration_carries_the_speed_on(wheels):
    drive, u = damaged(math.nan if len(wheels) == 4 else 0.0, *wheels)
    vx = WHEELS(drive)["vx"]
    limited = np.abs(vx - u).max()
    assert np.isfinite(vx).all()
    assert limited < (
        0.1 if len(wheels) != 3 else 12.0
    )  # three that agree on zero outvote one: what remains is the limit of acceleration
    assert np.abs(np.diff(vx)).max() <= 12.0 / RATE + 1e-12


def test_acceleration_from_speed_is_its_derivative_with_the_delay_of_the_filter():
    frequency = 0.5
    rate = 100.0
    time = np.arange(3000) / rate
    drive = Recording(
        "lap", "car", rate, 0.0, {"vx": 20.0 + 3.0 * np.sin(2 * np.pi * frequency * time)}
    )
    amplitude = 3.0 * 2 * np.pi * frequency
    late = math.sqrt(2.0) / (2.0 * np.pi * 5.0) + 0.5 / rate
    for direction, delay in (("zero_phase", 0.0), ("causal", late)):
        derived = AccelerationFromSpeed(cutoff_hz=5.0, direction=direction)(drive)
        expected = amplitude * np.cos(2 * np.pi * frequency * (time - delay))
        np.testing.assert_allclose(
            derived["ax"][300:-300], expected[300:-300], atol=0.005 * amplitude
        )
    causal = AccelerationFromSpeed()
    np.testing.assert_array_equal(causal(drive.cut(0.0, 9.0))["ax"], causal(drive)["ax"][:900])
    assert "cutoff_hz must lie below half of 100 Hz" in refusal(
        lambda: AccelerationFromSpeed(cutoff_hz=50.0)(drive)
    )


def test_velocity_and_sideslip_follow_from_each_other_gaps_included():
    angle = np.deg2rad(np.array([-58.0, -3.0, 0.0, 12.0]))
    drive = recorded(vx=np.array([5.0, 20.0, 30.0, 10.0]), sideslip_ref=angle)
    with_velocity = VelocityFromSideslip()(drive)
    np.testing.assert_allclose(with_velocity["vy_ref"], drive["vx"] * np.tan(angle))
    back = SideslipFromVelocity()(with_velocity.select(["vx", "vy_ref"]))
    np.testing.assert_allclose(back["sideslip_ref"], angle, atol=1e-15)
    assert "less than 90 degrees" in refusal(
        lambda: VelocityFromSideslip()(recorded(vx=np.ones(2), sideslip_ref=np.array([0.1, 1.6])))
    )
    at_standstill = VelocityFromSideslip()(
        recorded(vx=np.array([0.01, 0.05, 20.0]), sideslip_ref=np.array([3.1, 0.2, 0.1]))
    )
    np.testing.assert_allclose(
        at_standstill["vy_ref"], [0.0, 0.05 * np.tan(0.2), 20.0 * np.tan(0.1)]
    )
    channels = {"vx": np.full(3, 20.0), "sideslip_ref": np.array([0.1, math.nan, 0.2])}
    drive = Recording("lap", "car", RATE, 0.0, channels, gappy=frozenset({"sideslip_ref"}))
    derived = VelocityFromSideslip()(drive)
    assert "vy_ref" in derived.gappy
    np.testing.assert_array_equal(np.isnan(derived["vy_ref"]), [False, True, False])


def test_a_scaled_car_obeys_the_same_kinematics_with_the_same_accelerations():
    """d(vy)/dt + vx·yaw_rate = ay holds in the units of the other car, by central differences of
    smooth signals.
    """
    time = np.arange(4000) / 100.0
    vx = 3.0 + 0.5 * np.sin(time)
    vy = 0.4 * np.sin(1.3 * time)
    yaw_rate = 2.0 * np.sin(0.8 * time)
    ay = 0.4 * 1.3 * np.cos(1.3 * time) + vx * yaw_rate
    small = Recording(
        "lap",
        "car",
        100.0,
        2.0,
        {"vx": vx, "vy_ref": vy, "yaw_rate": yaw_rate, "ay": ay, "motor_current": ay},
    )
    large = ScaleToWheelbase(0.25, 2.25)(small)
    assert large.rate_hz == pytest.approx(100.0 / 3.0)
    assert large.start_time == pytest.approx(6.0)
    assert "motor_current" not in large
    np.testing.assert_array_equal(large["ay"], ay)
    np.testing.assert_allclose(
        np.arctan2(large["vy_ref"], large["vx"]), np.arctan2(vy, vx), atol=1e-12
    )
    derived = np.gradient(large["vy_ref"]) * large.rate_hz + large["vx"] * large["yaw_rate"]
    np.testing.assert_allclose(derived[1:-1], ay[1:-1], atol=1e-3)


def lap(rate_hz=100.0, n_samples=400):
    generator = np.random.default_rng(0)
    return Recording(
        "lap",
        "car",
        rate_hz,
        0.0,
        {name: generator.normal(0.0, 1.0, n_samples) for name in ("vx", "ay")},
    )


@pytest.mark.parametrize(
    ("config", "limit"),
    [
        ({"name": "resample", "rate_hz": 1e300}, "samples"),
        ({"name": "resample", "rate_hz": 4e6}, "filter_samples"),
        ({"name": "low_pass", "cutoff_hz": 1e-300, "direction": "causal"}, "filter_samples"),
        ({"name": "low_pass", "cutoff_hz": 5, "design": "fir", "reach": 1e308}, "filter_samples"),
        ({"name": "remove_outliers", "half_window": 10**30}, "filter_samples"),
        ({"name": "remove_outliers", "half_window": 499_999, "channels": "long"}, "memory"),
    ],
    ids=str,
)
def test_excessive_requests_are_refused_by_the_name_of_the_limit(config, limit):
    long = config.get("channels") == "long"
    changed = transform_from_config(
        {key: value for key, value in config.items() if value != "long"}
    )
    message = refusal(lambda: changed(lap(n_samples=600 if long else 400)), VehestError)
    assert f"limits.{limit}=NUMBER" in message
    assert "recording 'lap'" in message


def test_chunked_and_spectral_computations_equal_the_direct_computation(monkeypatch):
    direct = RemoveOutliers(half_window=7, threshold=2.0)(lap())["ay"]
    monkeypatch.setattr(transforms, "VALUES_AT_ONCE", 40)
    np.testing.assert_array_equal(RemoveOutliers(half_window=7, threshold=2.0)(lap())["ay"], direct)
    low_pass = LowPass(2.0, design="fir", reach=50.0)
    through_spectra = low_pass(lap(n_samples=12_000))["ay"]
    monkeypatch.setattr(transforms, "MAX_DIRECT_TAPS", 20_000)
    np.testing.assert_allclose(through_spectra, low_pass(lap(n_samples=12_000))["ay"], atol=1e-12)


def test_a_window_longer_than_the_limit_is_refused():
    with pytest.raises(
        DataError,
        match=r"a window of 2000000 samples is asked for, more than the limit of 1000000; "
        r".*limits\.filter_samples",
    ):
        windows_of([lap()], ["vx"], "ay", 2_000_000)
