"""Alignment of a measuring set-up: what was planted comes back, with intervals that hold, and
nothing happens unasked.
"""

import csv
import json
import math
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from broadband_drive import changed, without
from refusals import refusal
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from place import run_vehest
from real_drives import real_drive, source_of
from vehest.alignment.align import align
from vehest.alignment.imu import smoothing_of
from vehest.alignment.settings import QUANTITIES, AlignmentSettings
from vehest.configuration.composition import compose_config
from vehest.data.derived import SteeringCurve, SteeringRatio
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import Recording
from vehest.data.resampling import resampled, transforms_of
from vehest.data.store import write_recording
from vehest.data.transforms import DelayCorrection, OffsetCorrection, transform_from_config
from vehest.run.align import FILES, override_of
from vehest.simulation.plant.multi_body import MultiBodyPlant
from vehest.simulation.plant.parameters import vehicle_from_configuration
from vehest.simulation.sensors.levels import PRESETS, SensorLevel, Tilt
from vehest.simulation.sensors.recording import measure, specific_force

IMU = ("lever_arm", "mounting", "delay", "offsets")
PLANTED = {"lever_x": 1.0, "lever_y": 0.3, "yaw": math.radians(3.0), "delay": 0.040}
PLANTED |= {"offset_ax": 0.15, "offset_ay": -0.10, "offset_yaw_rate": 0.010}
TOLERANCE = {"lever_x": 0.1, "lever_y": 0.1, "yaw": math.radians(0.3), "delay": 0.003}
TOLERANCE |= {"offset_ax": 0.03, "offset_ay": 0.03, "offset_yaw_rate": 0.002}
"""At least 1.5 times the stated standard uncertainties on this drive.

These are 0.04 m, 0.01 m, 0.04°, 0.05 to 3.7 ms, 0.010 and 0.02 m/s² and 0.0008 rad/s. The delay
without a reference yaw rate is estimated less accurately than that.
"""
LARGEST_UNCERTAINTY = TOLERANCE | {"delay": 0.004}

# Noise alone, so that no other errors add to the planted ones: 0.0017 rad/s, 0.035 m/s² and
# 0.05 m/s.
NOISE = replace(
    PRESETS["ideal"],
    yaw_rate=SensorLevel(noise=2.4e-4),
    ax=SensorLevel(noise=0.005),
    ay=SensorLevel(noise=0.005),
    vx=SensorLevel(noise=0.0071),
    reference=replace(PRESETS["ideal"].reference, vy=SensorLevel(noise=0.0021)),  # 0.015 m/s
)
CONFIGURATION = Path(__file__).parents[2] / "conf" / "vehicle" / "bmw_320i_low.yaml"


@pytest.fixture(scope="module")
def motion():
    """150 s of a multi-body car that weaves between 12 and 28 m/s: its steering is three sines, its
    speed another.
    """
    vehicle = vehicle_from_configuration(yaml.safe_load(CONFIGURATION.read_text(encoding="utf-8")))
    plant = MultiBodyPlant(vehicle)
    state = plant.initial_state(0.0, 0.0, 0.0, 20.0)
    states = []
    inputs = []
    for time in 0.01 * np.arange(15_000):
        ay = sum(
            size * math.sin(2.0 * math.pi * f * time)
            for size, f in ((3.0, 0.07), (2.5, 0.31), (1.0, 0.83))
        )
        steer = (
            plant.wheelbase / state.vx**2 + 0.002
        ) * ay  # [rad], with understeer as such cars have
        pace = 20.0 + 8.0 * math.sin(2.0 * math.pi * time / 19.0)
        period = 8.0 * 2.0 * math.pi / 19.0
        acceleration = period * math.cos(2.0 * math.pi * time / 19.0) + 1.5 * (pace - state.vx)
        states.append(state)
        inputs.append(
            np.array(
                [
                    np.clip((steer - state.steer) / 0.1, -0.4, 0.4),
                    np.clip(acceleration, -6.0, 3.0),
                    0.0,
                    0.0,
                    0.0,
                ]
            )
        )
        state = plant.advance(state, inputs[-1], 10)
    return plant.motion(states, np.array(inputs), 100.0)


def recorded(motion, planted, *, leaning=False, reference_rate=False):
    """A recording of a motion by a sensor that is misplaced, turned, late and off.

    Written with rotation matrices and cross products, on the true motion, before noise; the plane
    as complex numbers is the code's way. If ``leaning``, roll and pitch let gravity into the
    accelerometers.
    """
    p = dict.fromkeys(PLANTED, 0.0) | planted
    time = np.arange(len(motion)) / 100.0
    force = specific_force(motion, Tilt())[:2] if leaning else np.stack([motion.ax, motion.ay])
    spin = np.stack([np.zeros(len(time)), np.zeros(len(time)), motion.yaw_rate])
    spin_dot = np.stack(
        [np.zeros(len(time)), np.zeros(len(time)), CubicSpline(time, motion.yaw_rate)(time, 1)]
    )
    lever = np.broadcast_to(np.array([[p["lever_x"]], [p["lever_y"]], [0.0]]), spin.shape)
    force_at_sensor = (
        force
        + (
            np.cross(spin_dot, lever, axis=0)
            + np.cross(spin, np.cross(spin, lever, axis=0), axis=0)
        )[:2]
    )
    axes = np.array(
        [[math.cos(p["yaw"]), -math.sin(p["yaw"])], [math.sin(p["yaw"]), math.cos(p["yaw"])]]
    )  # the sensor's, as columns
    true_signals = [*(axes.T @ force_at_sensor), motion.yaw_rate]
    late = [
        CubicSpline(time, samples)(np.maximum(time - p["delay"], 0.0)) for samples in true_signals
    ]
    ax, ay, yaw_rate = (
        samples + p[f"offset_{name}"]
        for samples, name in zip(late, ("ax", "ay", "yaw_rate"), strict=True)
    )
    level = {"roll": np.zeros(len(time)), "pitch": np.zeros(len(time))}
    imu = measure(replace(motion, ax=ax, ay=ay, yaw_rate=yaw_rate, **level), NOISE, seed=7)
    channels = measure(motion, NOISE, seed=7) | {
        name: imu[name] for name in ("ax", "ay", "yaw_rate")
    }
    del channels["yaw_rate_ref"]
    if reference_rate:
        channels["yaw_rate_ref"] = motion.yaw_rate + 0.0005 * np.random.default_rng(
            11
        ).standard_normal(len(time))
    return Recording("planted", "car", 100.0, 5.0, channels, "simulated")


def assert_recovered(alignment, truth, names):
    for name in names:
        parameter = alignment[name]
        assert parameter.value == pytest.approx(truth.get(name, 0.0), abs=TOLERANCE[name]), name
        assert parameter.low <= truth.get(name, 0.0) <= parameter.high, name
        assert parameter.uncertainty <= LARGEST_UNCERTAINTY[name], name


@pytest.mark.parametrize("reference_rate", [False, True])
def test_planted_set_up_comes_back_from_a_car_that_rolls_and_pitches(motion, reference_rate):
    """Gravity through roll is 6 % of ay here, through pitch 4 % of ax: taken for motion it would
    shift rotation and offset of ay.
    """
    recording = recorded(motion, PLANTED, leaning=True, reference_rate=reference_rate)
    alignment = align(recording, AlignmentSettings(IMU))
    assert_recovered(alignment, PLANTED, tuple(PLANTED))
    assert not reference_rate or alignment.correlation.peak == pytest.approx(0.04, abs=0.01)
    assert any(
        re.search(r"3\.[567] % in ax and 5\.[789] % in ay", note) for note in alignment.notes
    )
    for residual in alignment.residuals[:2]:
        assert (
            residual.rms["rest"] < 0.045 < residual.rms["after"]
        )  # the tilt of the body is not corrected, and the table says so
    if not reference_rate:
        level = align(recording, AlignmentSettings(IMU, tilt=0.0))
        assert level["yaw"].value > PLANTED["yaw"] + 0.003
        assert level["offset_ay"].value > PLANTED["offset_ay"] + 0.05


def test_measured_roll_and_pitch_take_gravity_off_and_a_sensor_mounted_crosswise_is_found(motion):
    recording = recorded(motion, PLANTED, leaning=True, reference_rate=True)
    recording = changed(recording, roll=motion.roll, pitch=motion.pitch)
    alignment = align(recording, AlignmentSettings(IMU))
    assert_recovered(alignment, PLANTED, tuple(PLANTED))
    assert alignment["offset_ax"].value == pytest.approx(0.15, abs=0.003)  # without the mean pitch
    assert any(re.search(r"acceleration: -?0\.[01] % in ax", note) for note in alignment.notes)
    truth = PLANTED | {"yaw": math.radians(-90.0)}
    alignment = align(recorded(motion, truth, reference_rate=True), AlignmentSettings(IMU))
    assert_recovered(alignment, truth, tuple(PLANTED))


def test_its_transforms_bring_the_residuals_down_to_those_of_a_drive_that_was_aligned(motion):
    clean = align(recorded(motion, {}), AlignmentSettings(("delay",)))
    alignment = align(recorded(motion, PLANTED), AlignmentSettings(IMU))
    for aligned, residual in zip(clean.residuals, alignment.residuals, strict=True):
        assert residual.rms["before"] > 5 * aligned.rms["before"]
        assert residual.rms["after"] == pytest.approx(aligned.rms["before"], rel=0.1)


def test_what_may_be_zero_is_not_corrected(motion):
    alignment = align(recorded(motion, {"delay": PLANTED["delay"]}), AlignmentSettings(IMU))
    may_be_zero = {parameter.name for parameter in alignment.parameters if parameter.may_be_zero}
    assert {"lever_x", "lever_y", "yaw", "offset_ax", "offset_ay"} <= may_be_zero
    assert [transform["name"] for transform in alignment.transforms] == ["delay_correction"]


@pytest.mark.parametrize("quantity", IMU)
def test_each_comes_back_alone_and_brings_no_other_transform(motion, quantity):
    truth = {name: PLANTED[name] for name in QUANTITIES[quantity]}
    alignment = align(recorded(motion, truth), AlignmentSettings((quantity,)))
    assert tuple(parameter.name for parameter in alignment.parameters) == QUANTITIES[quantity]
    assert_recovered(alignment, truth, QUANTITIES[quantity])
    if quantity == "delay":
        assert alignment.correlation.peak == pytest.approx(0.040, abs=0.010)
    (transform,) = alignment.transforms
    names = {
        "lever_arm": "mounting_correction",
        "mounting": "mounting_correction",
        "delay": "delay_correction",
    }
    assert transform["name"] == names.get(quantity, "offset_correction")
    assert "yaw" not in transform or quantity == "mounting"
    assert not any("residuals suggest" in note for note in alignment.notes)


def test_what_was_not_asked_for_is_pointed_out_but_not_estimated(motion):
    alignment = align(
        recorded(motion, PLANTED, reference_rate=True), AlignmentSettings(("lever_arm", "offsets"))
    )
    (note,) = [note for note in alignment.notes if "residuals suggest" in note]
    assert re.search(r"yaw (2\.9|3\.0|3)\d* deg ±", note)
    assert re.search(r"delay (3[89]|40)[.\d]* ms ±", note)
    assert {parameter.name for parameter in alignment.parameters} == {
        *QUANTITIES["lever_arm"],
        *QUANTITIES["offsets"],
    }
    assert "Not requested and assumed to be zero: mounting, delay." in alignment.notes


RATE = 50.0
COVERED = AlignmentSettings(IMU, cutoff_hz=1.5, max_delay=0.2, tilt=0.0)


def weaving(seed, *, correlated=0.5, noise=0.1, turning=True, varying=True):
    """100 s of a made-up motion in closed form, with `PLANTED` and noise that remembers for
    ``correlated`` seconds.
    """
    generator = np.random.default_rng(seed)
    time = np.arange(5000) / RATE
    phases = generator.uniform(0.0, 2.0 * np.pi, (3, 3))

    def wave(row, at, order, mean, amplitudes, frequencies):
        omega = 2.0 * np.pi * np.array(frequencies)
        angles = np.outer(at, omega) + phases[row] + order * np.pi / 2.0
        return np.sin(angles) @ (np.array(amplitudes) * omega**order) + (
            mean if order == 0 else 0.0
        )

    def turn(at, order=0):
        return wave(
            0,
            at,
            order,
            0.05 if turning else 0.4,
            tuple(turning * a for a in (0.3, 0.15, 0.05)),
            (0.07, 0.23, 0.6),
        )

    def velocity(at, order=0):
        ahead = wave(
            1, at, order, 25.0, tuple(varying * a for a in (4.0, 1.5, 0.4)), (0.02, 0.09, 0.21)
        )
        return ahead + 1j * wave(
            2, at, order, 0.0, tuple(turning * a for a in (0.5, 0.2, 0.05)), (0.05, 0.19, 0.7)
        )

    at = time - PLANTED["delay"]
    r = turn(at)
    lever = PLANTED["lever_x"] + 1j * PLANTED["lever_y"]
    force = velocity(at, 1) + 1j * r * velocity(at) + (1j * turn(at, 1) - r**2) * lever
    force = np.exp(-1j * PLANTED["yaw"]) * force + PLANTED["offset_ax"] + 1j * PLANTED["offset_ay"]

    def coloured(size):
        memory = math.exp(-1.0 / (correlated * RATE))
        return lfilter(
            [size * math.sqrt(1.0 - memory**2)], [1.0, -memory], generator.standard_normal(6000)
        )[1000:]

    channels = {
        "ax": force.real + coloured(noise),
        "ay": force.imag + coloured(noise),
        "yaw_rate": r + PLANTED["offset_yaw_rate"] + coloured(0.002),
        "vx_ref": velocity(time).real + 0.01 * generator.standard_normal(len(time)),
        "vy_ref": velocity(time).imag + 0.01 * generator.standard_normal(len(time)),
        "yaw_rate_ref": turn(time) + 0.0005 * generator.standard_normal(len(time)),
    }
    return Recording("weave", "car", RATE, 0.0, channels, "simulated")


@pytest.mark.parametrize("correlated", [0.05, 2.0])
def test_intervals_contain_the_truth_about_as_often_as_they_say(correlated):
    """Thirty drives, whose noise remembers for 0.05 s and for 2 s: by a binomial law of 95 % fewer
    than 25 of 30 have a chance of 0.3 %.
    """
    alignments = [align(weaving(seed, correlated=correlated), COVERED) for seed in range(30)]
    inside = np.array(
        [
            [p.low <= PLANTED[p.name] <= p.high for p in alignment.parameters]
            for alignment in alignments
        ]
    )
    assert inside.sum(axis=0).min() >= 25
    assert 0.91 <= inside.mean() <= 0.99
    values, stated = (
        np.array(
            [[getattr(p, attribute) for p in alignment.parameters] for alignment in alignments]
        )
        for attribute in ("value", "uncertainty")
    )
    ratio = values.std(axis=0, ddof=1) / np.sqrt(np.square(stated).mean(axis=0))
    assert ratio.min() > 0.7  # intervals are not merely wide
    assert ratio.max() < 1.4  # the standard deviation of 30 values is itself known to 13 %


def test_log_of_20_hz_is_aligned_without_options():
    slow = resampled(weaving(0), 20.0, {"method": "polyphase", "transforms": []})
    alignment = align(slow, AlignmentSettings(IMU, tilt=0.0))
    assert alignment.settings.cutoff_at(20.0) == pytest.approx(1.767, abs=1e-3)
    assert alignment.settings.cutoff_at(22.0) < alignment.settings.cutoff_at(50.0) == 2.0
    for parameter in alignment.parameters:
        error = abs(parameter.value - PLANTED[parameter.name])
        assert error < 3 * parameter.uncertainty < 0.3, parameter.name


def test_unmeasured_tilt_adds_to_the_uncertainty():
    recording = weaving(0)
    level, tilted = (align(recording, replace(COVERED, tilt=tilt)) for tilt in (0.0, 0.002))
    assert level["offset_ax"].tilt == 0.0
    assert tilted["offset_ax"].tilt == pytest.approx(9.81 * 0.002, rel=0.2)
    assert tilted["offset_yaw_rate"].tilt < 1e-4  # its reference is a gyroscope


def test_effects_and_delays_that_a_drive_does_not_tell_are_refused(motion):
    circle = weaving(0, turning=False, varying=False, noise=0.02)
    with pytest.raises(
        DataError, match=r"lever_y and offset_ay cannot be separated .*\(condition number"
    ):
        align(circle, AlignmentSettings(("lever_arm", "offsets")))
    constant = without(weaving(0, varying=False), "yaw_rate_ref")
    with pytest.raises(
        DataError, match=r"offset_ay and offset_yaw_rate cannot be separated .*\(condition"
    ):
        align(constant, AlignmentSettings(("offsets",)))
    standstill = replace(
        motion, yaw_rate=np.zeros(len(motion)), ax=np.zeros(len(motion)), ay=np.zeros(len(motion))
    )
    straight = replace(standstill, vx=np.full(len(motion), 25.0), vy=np.zeros(len(motion)))
    with pytest.raises(
        DataError, match=r"lever_x cannot be estimated: .* % of its effect in this drive is noise"
    ):
        align(recorded(straight, {}), AlignmentSettings(("lever_arm",)))
    mixed = changed(weaving(0), yaw_rate_ref=weaving(1)["yaw_rate_ref"])
    with pytest.raises(DataError, match=r"has a correlation of at most"):
        align(mixed, AlignmentSettings(("delay",), cutoff_hz=1.5))
    with pytest.raises(DataError, match="raise max_delay"):
        align(
            recorded(motion, {"delay": 0.3}, reference_rate=True),
            AlignmentSettings(("delay",), max_delay=0.1),
        )


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_low_pass_differentiates_and_keeps_the_right_samples(order):
    time = np.arange(3001) / 100.0
    omega = 2.0 * np.pi * 0.8
    smoothing = smoothing_of(Recording("sine", "car", 100.0, 0.0, {"ay": time}), 2.0)
    out = smoothing(np.sin(omega * time), order, margin=50)
    gain = 2.0 ** (-0.5 * (0.8 / 2.0) ** 2)  # a Gaussian, -3 dB at 2 Hz
    assert smoothing.step == 4
    np.testing.assert_allclose(
        out,
        gain * omega**order * np.sin(omega * time[50:-50:4] + order * np.pi / 2.0),
        atol=1e-5 * omega**order,
    )


@pytest.mark.parametrize("missing", ["vy_ref", "ax", "ay", "yaw_rate"])
def test_missing_channel_is_one_clear_line(motion, missing):
    recording = without(recorded(motion, {}), missing)
    refused = refusal(lambda: align(recording, AlignmentSettings(IMU)))
    assert re.search(f"no (reference )?channel '{missing}'", refused)


def test_forward_speed_stands_in_for_its_reference_and_the_report_says_so(motion):
    recording = without(recorded(motion, PLANTED), "vx_ref")
    alignment = align(recording, AlignmentSettings(("offsets", "mounting")))
    assert any("No vx_ref" in note for note in alignment.notes)


def test_gaps_short_recordings_and_slow_ones_are_refused():
    recording = weaving(0)
    gap = recording["ax"].copy()
    gap[100] = np.nan
    holed = changed(recording, gappy={"ax"}, ax=gap)
    assert "'ax' has gaps" in refusal(lambda: align(holed, COVERED))
    assert "needs at least" in refusal(lambda: align(recording.cut(0.0, 15.0), COVERED))
    assert "too high for 50 Hz; use at most" in refusal(
        lambda: align(recording, replace(COVERED, cutoff_hz=10.0)), ConfigurationError
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"estimate": ("colour",)}, "'colour' cannot be estimated; there are: lever_arm"),
        ({"estimate": ("delay",), "max_delay": math.nan}, "max_delay must be positive"),
    ],
)
def test_settings_that_make_no_sense_are_refused(arguments, message):
    with pytest.raises(ConfigurationError, match=message):
        AlignmentSettings(**arguments)


WHEELBASE = 2.6
LF = 1.2
LR = 1.4
MASS = 1500.0
INERTIA = 2500.0
FRONT = 1.0e5
REAR = 1.3e5
"""A linear single-track car; stiffnesses of the axles [N/rad]."""
GRADIENT = (
    MASS * (LR * REAR - LF * FRONT) / (WHEELBASE * FRONT * REAR)
)  # steady state: δ = L/R + K·ay


def single_track(ratio, offset):
    """Calm country-road driving of the linear single-track model, integrated with its lags, seen by
    noisy sensors.
    """
    generator = np.random.default_rng(0)
    step = 0.01
    time = np.arange(20000) * step
    speed = 20.0 + 8.0 * np.sin(2.0 * np.pi * 0.013 * time)
    steer = (
        0.02 * np.sin(2.0 * np.pi * 0.04 * time) + 0.008 * np.sin(2.0 * np.pi * 0.11 * time + 1.0)
    ) * (20.0 / speed)
    side = np.zeros(len(time))
    rate = np.zeros(len(time))
    for k in range(len(time) - 1):
        front = FRONT * (steer[k] - (side[k] + LF * rate[k]) / speed[k])
        rear = -REAR * (side[k] - LR * rate[k]) / speed[k]
        side[k + 1] = side[k] + step * ((front + rear) / MASS - speed[k] * rate[k])
        rate[k + 1] = rate[k] + step * (LF * front - LR * rear) / INERTIA
    ay = np.gradient(side, step) + speed * rate
    noisy = {
        "vx": (speed, 0.05),
        "yaw_rate": (rate, 0.0017),
        "ay": (ay, 0.035),
        "handwheel": (ratio * steer + offset, 0.002),
    }
    channels = {
        name: true + size * generator.standard_normal(len(time))
        for name, (true, size) in noisy.items()
    }
    return Recording("road", "car", 100.0, 0.0, channels, "simulated")


@pytest.mark.parametrize(("ratio", "offset"), [(15.5, 0.05), (-1.0, -0.01)])
def test_steering_ratio_offset_and_understeer_gradient_come_back(ratio, offset):
    alignment = align(
        single_track(ratio, offset), AlignmentSettings(("steering_ratio",), wheelbase=WHEELBASE)
    )
    assert alignment["steering_ratio"].value == pytest.approx(ratio, rel=0.02)
    assert alignment["steering_offset"].value == pytest.approx(offset, abs=0.003)
    assert alignment["understeer_gradient"].value == pytest.approx(GRADIENT, rel=0.1)
    for name, true in (
        ("steering_ratio", ratio),
        ("steering_offset", offset),
        ("understeer_gradient", GRADIENT),
    ):
        assert alignment[name].low <= true <= alignment[name].high, name
    (transform,) = alignment.transforms
    assert (transform["name"], transform["channel"]) == ("steering_ratio", "handwheel")
    assert alignment.residuals == ()


def test_steering_intervals_contain_the_truth():
    """Twenty drives: by a binomial law of 95 % fewer than 16 have a chance of 0.3 %."""
    road = single_track(15.5, 0.05)
    generator = np.random.default_rng(0)
    inside = 0
    for _ in range(20):
        wander = lfilter(
            [0.05 * math.sqrt(1 - 0.998**2)],
            [1.0, -0.998],
            generator.standard_normal(len(road) + 5000),
        )[5000:]  # 5 s
        recording = road.with_channels({"handwheel": road["handwheel"] + wander})
        ratio = align(recording, AlignmentSettings(("steering_ratio",), wheelbase=WHEELBASE))[
            "steering_ratio"
        ]
        inside += ratio.low <= 15.5 <= ratio.high
    assert inside >= 16


def understeering(seed):
    """Three minutes of a car whose tyres give way, at a speed, with a ratio and an understeer of
    its own.
    """
    generator = np.random.default_rng(seed)
    step = 0.01
    length = 18000
    speed_mean = (8.0, 14.0, 22.0, 32.0)[seed % 4]
    wheelbase = generator.uniform(2.3, 3.0)
    front_stiffness = generator.uniform(7.0, 13.0)  # of an axle over its load [1/rad]
    rear_stiffness = front_stiffness * generator.uniform(1.0, 1.6)
    friction = generator.uniform(0.8, 1.2)

    def wander(seconds):
        samples = generator.standard_normal(length)
        for _ in range(2):
            samples = lfilter([step / seconds], [1.0, step / seconds - 1.0], samples)
        return (samples - samples.mean()) / samples.std()

    speed = np.maximum(speed_mean * (1.0 + 0.2 * wander(6.0)), 3.5)
    lateral = generator.uniform(0.8, 2.5) * wander(2.0)
    slip = [
        friction / stiffness * np.arctanh(np.clip(lateral / 9.81 / friction, -0.9, 0.9))
        for stiffness in (front_stiffness, rear_stiffness)
    ]
    rate = lateral / speed
    ratio = generator.uniform(12.0, 20.0)
    steer = wheelbase * rate / speed + slip[0] - slip[1]
    bank = generator.uniform(0.0, 0.02) * wander(8.0)
    channels = {
        "vx": speed + 0.05 * generator.standard_normal(length),
        "yaw_rate": rate + 0.003 * generator.standard_normal(length),
        "ay": lateral * 1.04 + 9.81 * bank + 0.1 * generator.standard_normal(length),
        "handwheel": ratio * steer + 0.02 + 0.003 * generator.standard_normal(length),
    }
    return Recording("car", "car", 100.0, 0.0, channels, "simulated"), wheelbase, ratio


def test_the_interval_of_a_ratio_covers_it_whatever_the_understeer_and_the_speed():
    """Twenty-four cars: by a binomial law of 95 % fewer than 20 have a chance of 0.6 %."""
    inside = certain = 0
    for seed in range(24):
        recording, wheelbase, truth = understeering(seed)
        alignment = align(recording, AlignmentSettings(("steering_ratio",), wheelbase=wheelbase))
        ratio = alignment["steering_ratio"]
        inside += ratio.low <= truth <= ratio.high
        if ratio.uncertainty <= 0.1 * ratio.value:
            certain += 1
            assert ratio.value == pytest.approx(truth, rel=0.1)
    assert inside >= 20
    assert certain >= 6


def test_the_ratio_of_a_fast_ferrari_is_uncertain_and_covered(data_root):
    """Its road-wheel angle has a ratio of 1; by scatter alone the fit gives 1.24 ± 0.11."""
    drive = real_drive(data_root)
    ratio = align(drive, AlignmentSettings(("steering_ratio",), wheelbase=2.4))["steering_ratio"]
    assert ratio.low <= 1.0 <= ratio.high
    assert abs(ratio.value - 1.0) < ratio.uncertainty
    assert abs(ratio.value - 1.0) > 2.0 * ratio.scatter


@pytest.mark.parametrize(
    ("dataset", "wheelbase", "truth", "n_recordings"),
    [("tum", 3.0, 1.0, 3), ("ferrari_250lm_unlabelled", 2.4, 13.955, 4)],
)
def test_a_ratio_lies_within_two_deviations_on_every_recording_of_known_ratio(
    data_root, dataset, wheelbase, truth, n_recordings
):
    """The DevBot's road-wheel angles have a ratio of 1, and the Ferrari's is that of its handwheel
    to `delta` of the same drive.
    """
    source = source_of(data_root, dataset)
    errors = []
    for recording in source.ids():
        settings = AlignmentSettings(("steering_ratio",), wheelbase=wheelbase)
        ratio = align(source.read(recording), settings)["steering_ratio"]
        errors.append((ratio.value - truth) / ratio.uncertainty)
    assert len(errors) == n_recordings
    assert np.abs(errors).max() < 2.0


def test_steering_without_calm_driving_without_a_channel_or_without_relation_is_refused():
    road = single_track(15.5, 0.0)
    settings = AlignmentSettings(("steering_ratio",), wheelbase=WHEELBASE)
    with pytest.raises(DataError, match=r"only .* s with vx ≥ 40 m/s"):
        align(road, replace(settings, min_speed=40.0))
    with pytest.raises(ConfigurationError, match="needs the wheelbase"):
        align(road, replace(settings, wheelbase=None))
    assert "no channel 'steer'" in refusal(
        lambda: align(road.select(["vx", "yaw_rate", "ay"]), settings)
    )
    assert "no channel 'roll'" in refusal(
        lambda: align(road, replace(settings, steering_channel="roll"))
    )
    noise = np.random.default_rng(0).standard_normal(len(road))
    with pytest.raises(DataError, match="does not follow the curvature"):
        align(changed(road, handwheel=noise), settings)


def sine(delay, frequency, rate=100.0):
    time = np.arange(1000) / rate
    return Recording(
        "sine",
        "car",
        rate,
        2.0,
        {
            "ay": np.sin(2.0 * np.pi * frequency * (time - delay)),
            "vy_ref": np.sin(2.0 * np.pi * frequency * time),
        },
    )


@pytest.mark.parametrize("delay", [0.037, -0.0123, 0.0005, 0.5049])
@pytest.mark.parametrize("frequency", [0.3, 5.0, 25.0, 40.0])
def test_delayed_sine_comes_back_between_samples(delay, frequency):
    corrected = DelayCorrection(delay)(sine(delay, frequency))
    np.testing.assert_allclose(
        corrected["ay"], corrected["vy_ref"], atol=1e-3
    )  # up to 0.8 of the Nyquist frequency


@pytest.mark.parametrize("delay", [0.04, -0.04])
def test_delay_of_whole_samples_is_a_shift_and_the_recording_is_cut(delay):
    recording = sine(delay, 3.0)
    corrected = DelayCorrection(delay, ("ay",))(recording)
    assert len(corrected) == len(recording) - 4
    assert corrected.start_time == pytest.approx(recording.start_time + max(-delay, 0.0))
    np.testing.assert_array_equal(
        corrected["ay"], recording["ay"][4:] if delay > 0 else recording["ay"][:-4]
    )
    np.testing.assert_array_equal(
        corrected["vy_ref"], recording["vy_ref"][:-4] if delay > 0 else recording["vy_ref"][4:]
    )


def test_delay_correction_cuts_what_it_cannot_reach_and_keeps_clock_and_constants():
    recording = sine(0.0, 1.0)
    corrected = DelayCorrection(0.037)(recording)
    assert corrected.start_time == pytest.approx(
        recording.start_time + 0.12
    )  # 16 samples of reach less the 4 that the delay gives
    assert corrected.end_time == pytest.approx(recording.end_time - 0.20)
    np.testing.assert_array_equal(DelayCorrection(0.0)(recording)["ay"], recording["ay"])
    assert "too short to be shifted by 20 s" in refusal(lambda: DelayCorrection(20.0)(recording))
    assert "no channel 'ax'" in refusal(lambda: DelayCorrection(0.01, ("ax",))(recording))
    holed = Recording(
        "gap", "car", 100.0, 0.0, {"ay": np.array([0.0, np.nan] * 50)}, gappy=frozenset({"ay"})
    )
    assert "has gaps" in refusal(lambda: DelayCorrection(0.013)(holed))
    recording = Recording("flat", "car", 100.0, 0.0, {"ay": np.full(100, 9.81)})
    np.testing.assert_allclose(DelayCorrection(0.0137)(recording)["ay"], 9.81, rtol=1e-14)


def test_offsets_ratios_and_curves_are_applied_exactly_and_gaps_stay_gaps():
    recording = Recording(
        "lap",
        "car",
        10.0,
        0.0,
        {"ax": np.array([1.0, np.nan]), "ay": np.array([1.0, 2.0])},
        gappy=frozenset({"ax"}),
    )
    corrected = OffsetCorrection({"ax": 0.25, "ay": -1.0})(recording)
    np.testing.assert_array_equal(corrected["ax"], [0.75, np.nan])
    np.testing.assert_array_equal(corrected["ay"], [2.0, 3.0])
    assert "no channel 'yaw_rate'" in refusal(
        lambda: OffsetCorrection({"yaw_rate": 0.1})(recording)
    )
    recording = Recording(
        "lap",
        "car",
        10.0,
        0.0,
        {"handwheel": np.array([1.6, np.nan]), "steer": np.zeros(2)},
        gappy=frozenset({"handwheel"}),
    )
    corrected = SteeringRatio(15.0, 0.1)(recording)
    np.testing.assert_allclose(corrected["steer"], [0.1, np.nan])
    assert corrected.gappy == {"handwheel", "steer"}
    np.testing.assert_array_equal(SteeringRatio(-1.0, 0.1, "steer")(recording)["steer"], [0.1, 0.1])
    assert "no channel 'roll'" in refusal(lambda: SteeringRatio(15.0, channel="roll")(recording))
    recording = Recording("a", "car", 100.0, 0.0, {"steer": np.array([-2.0, -0.5, 0.0, 0.5, 2.0])})
    curve = SteeringCurve((-1.0, 0.0, 1.0), (-0.4, 0.0, 0.3))
    np.testing.assert_allclose(curve(recording)["steer"], [-0.4, -0.2, 0.0, 0.15, 0.3])
    for inputs, angles in (((0.0, 0.0), (0.0, 1.0)), ((0.0, 1.0), (0.0,)), ((0.0,), (0.0,))):
        with pytest.raises(ConfigurationError, match="inputs that increase, and as many angles"):
            SteeringCurve(inputs, angles)


@pytest.mark.parametrize(
    "config",
    [
        {"name": "delay_correction", "delay": math.inf},
        {"name": "offset_correction", "offsets": {}},
        {"name": "offset_correction", "offsets": {"az": 0.1}},
        {"name": "steering_ratio", "ratio": 0.0},
        {"name": "steering_ratio", "ratio": 15.0, "channel": "rudder"},
    ],
)
def test_transforms_that_make_no_sense_are_refused_in_one_line(config):
    refusal(lambda: transform_from_config(config), ConfigurationError)


def files():
    return {str(file): file.read_bytes() for file in Path().rglob("*") if file.is_file()}


@pytest.fixture
def called(elsewhere, capsys):
    """Runs `vehest data align` in a folder that holds weave.parquet."""
    write_recording(weaving(0), elsewhere / "weave.parquet")
    return partial(run_vehest, capsys, "data", "align")


ASKED = (
    "weave.parquet",
    "--estimate",
    "lever_arm,mounting,delay,offsets",
    "--cutoff",
    "1.5",
    "--max-delay",
    "0.2",
)


def test_command_prints_a_table_or_json_and_an_override_and_touches_nothing(called):
    before = files()
    code, out, err = called(*ASKED)
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert "simulated" in lines[0]
    assert "no correction is applied" in lines[0]
    assert lines[1].split() == [
        "quantity",
        "estimate",
        "standard",
        "uncertainty",
        "95",
        "%",
        "interval",
        "unit",
    ]
    assert any(line.startswith("lever_x") and line.rstrip().endswith(" m") for line in lines)
    assert any(line.startswith("delay ") and "ms" in line for line in lines)
    assert any(line.startswith("yaw ") and "deg" in line for line in lines)
    assert any(line.startswith("ay ") for line in lines)
    assert lines[-1].startswith("to apply the corrections: 'downsample.transforms=[{name: delay_")
    assert files() == before
    code, out, _ = called(*ASKED, "--json")
    assert code == 0
    printed = json.loads(out)
    parameters = {entry["name"]: entry for entry in printed["parameters"]}
    assert (parameters["delay"]["unit"], parameters["yaw"]["unit"]) == ("s", "rad")
    assert parameters["delay"]["low"] <= 0.040 <= parameters["delay"]["high"]
    assert printed["kind"] == "simulated"
    assert [transform["name"] for transform in printed["transforms"]] == [
        "delay_correction",
        "offset_correction",
        "mounting_correction",
    ]
    assert {residual["channel"] for residual in printed["residuals"]} == {"ax", "ay", "yaw_rate"}


def test_printed_override_is_one_that_downsample_takes(called):
    _, out, _ = called(*ASKED)
    override = out.splitlines()[-1].removeprefix("to apply the corrections: ").strip("'")
    composed = compose_config("downsample", ["dataset=sim_quickstart", "rate_hz=20", override])[
        "downsample"
    ]
    alignment = align(weaving(0), AlignmentSettings(IMU, cutoff_hz=1.5, max_delay=0.2))
    transforms = transforms_of({"rate_hz": 20.0, **composed})
    assert list(transforms[:-1]) == [
        transform_from_config(transform) for transform in alignment.transforms
    ]
    assert override == override_of(alignment)
    small = replace(
        alignment,
        transforms=({"name": "offset_correction", "offsets": {"ax": -1e-07, "ay": 1e16}},),
    )
    composed = compose_config(
        "downsample", ["dataset=sim_quickstart", "rate_hz=20", override_of(small)]
    )["downsample"]
    assert composed["transforms"] == [
        {"name": "offset_correction", "offsets": {"ax": -1e-07, "ay": 1e16}}
    ]


def test_command_writes_a_folder_whole_and_replaces_its_own_only(called):
    assert called(*ASKED, "-o", "found")[0] == 0
    folder = Path("found")
    assert {file.name for file in folder.iterdir()} == set(FILES)
    assert {path.name for path in Path().iterdir()} == {"weave.parquet", "found"}
    written = yaml.safe_load((folder / "alignment.yaml").read_text(encoding="utf-8"))
    assert len([transform_from_config(entry) for entry in written["transforms"]]) == 3
    rows = list(csv.DictReader((folder / "alignment.csv").open(encoding="utf-8")))
    assert [row["name"] for row in rows] == list(PLANTED)
    assert {row["kind"] for row in rows} == {"simulated"}
    report = (folder / "alignment.md").read_text(encoding="utf-8")
    assert "no correction is applied" in report
    assert "| delay |" in report
    (folder / "notes.txt").write_text("mine", encoding="utf-8")
    before = files()
    code, _, err = called(*ASKED, "-o", "found")
    assert (code, err) == (
        2,
        "error: folder 'found' contains other files ('notes.txt'); name a new one\n",
    )
    assert files() == before


def test_steering_alone_is_written_too(called):
    write_recording(single_track(15.5, 0.05), Path("road.parquet"))
    for _ in range(2):  # its own files may be replaced
        code, out, _ = called(
            "road.parquet", "-e", "steering_ratio", "--wheelbase", "2.6", "-o", "found"
        )
        assert code == 0
    assert "steering_ratio " in out
    assert "{name: steering_ratio, ratio: 15." in out
    assert {file.name for file in Path("found").iterdir()} == set(FILES)


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (
            ("weave.parquet",),
            2,
            "name what to estimate: one or more of lever_arm, mounting, delay, offsets, "
            "steering_ratio",
        ),
        (
            ("sim_quickstart", "-e", "delay"),
            2,
            "3 (drive_1, drive_2, drive_3); choose one by --recording ID",
        ),
        (("sim_quickstart", "-e", "delay", "-r", "drive_9"), 4, "no drive 'drive_9'"),
        (
            ("weave.parquet", "-e", "delay", "-r", "other"),
            2,
            "contains the recording 'weave', not 'other'",
        ),
        (("weave.parquet", "-e", "delay", "-o", "weave.parquet"), 2, "is not a folder"),
    ],
)
def test_command_refuses_in_one_line_and_writes_nothing(called, arguments, code, message):
    before = files()
    left, out, err = called(*arguments)
    assert (left, out) == (code, "")
    assert err.startswith("error: ")
    assert message in err
    assert err.count("\n") == 1
    assert files() == before


def test_ferrari_shows_no_misalignment_and_the_yaw_rate_offset_of_the_turns_of_its_laps(data_root):
    """Its publishers give accelerations at the centre of gravity: lever arm, rotation and offsets
    should be near zero.
    """
    ferrari = real_drive(data_root)
    alignment = align(ferrari, AlignmentSettings(IMU))
    for name in ("lever_x", "lever_y", "yaw"):
        assert alignment[name].low <= 0.0 <= alignment[name].high, name
    assert all(math.isfinite(parameter.high - parameter.low) for parameter in alignment.parameters)
    assert alignment["lever_x"].uncertainty < 0.5
    assert abs(alignment["delay"].value) < 0.05
    # Between two passes of one place the car has turned by whole circles: what is left over of the
    # integrated yaw rate is its offset.
    path = np.cumsum(ferrari["vx"]) / ferrari.rate_hz
    curvature = np.interp(np.arange(0.0, path[-1], 10.0), path, ferrari["yaw_rate"] / ferrari["vx"])
    curvature -= curvature.mean()
    lags = np.arange(20, len(curvature) - 60)
    five_laps = (
        10.0
        * lags[np.argmax([np.corrcoef(curvature[:-lag], curvature[lag:])[0, 1] for lag in lags])]
    )
    first, last = np.searchsorted(path, [500.0, 500.0 + five_laps])
    turned = ferrari["yaw_rate"][first:last].sum() / ferrari.rate_hz
    offset = (turned - 2.0 * np.pi * round(turned / (2.0 * np.pi))) / (
        (last - first) / ferrari.rate_hz
    )
    assert abs(offset) < 2e-4
    assert alignment["offset_yaw_rate"].low <= offset <= alignment["offset_yaw_rate"].high
