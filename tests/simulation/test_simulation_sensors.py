"""Simulated sensors: each error against theory, each alone, and the levels against the real
recording.
"""

import math
from dataclasses import asdict, fields, replace

import numpy as np
import pytest
import yaml
from refusals import refusal
from scipy import signal, stats
from scipy.spatial.transform import Rotation

from vehest.data.channels import CHANNELS
from vehest.data.errors import ConfigurationError
from vehest.simulation.plant.motion import WHEELS, Motion
from vehest.simulation.sensors.config import sensor_levels_from_config, switched_off
from vehest.simulation.sensors.levels import (
    PRESETS,
    Mounting,
    Reference,
    SensorLevel,
    SensorLevels,
    Tilt,
    Vibration,
)
from vehest.simulation.sensors.recording import body_rates, described, measure, specific_force
from vehest_papers.proving_ground.noise_reading import noise_density, read_off

G = 9.81
SENSORS = [
    entry.name
    for entry in fields(SensorLevels)
    if isinstance(getattr(SensorLevels(), entry.name), SensorLevel)
]
KINDS = ("noise", "offset", "drift", "quantisation", "delay", "scale")
LOUD = SensorLevel(
    noise=0.1, offset=0.2, drift=0.3, drift_time=5.0, quantisation=1e-4, delay=0.013, scale=0.05
)


def motion_of(n_samples, rate_hz=100.0, **values):
    """A motion with the given values, numbers or arrays; all else is zero."""
    wide = ("wheel_speed", "tyre_fx", "tyre_fy", "tyre_fz")
    arrays = {
        entry.name: np.broadcast_to(
            np.asarray(values.get(entry.name, 0.0), dtype=np.float64),
            (n_samples, 4) if entry.name in wide else (n_samples,),
        )
        for entry in fields(Motion)
        if entry.name != "rate_hz"
    }
    return Motion(rate_hz, **arrays)


def weaving(seconds=20.0, rate_hz=100.0):
    """A car that weaves, rolls and pitches on a banked grade.

    Every quantity moves, and each in its own way.
    """
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    wheels = np.stack([80.0 + i + np.sin((1.0 + i) * t) for i in range(4)], axis=1)
    yaw_rate = 0.4 * np.sin(1.1 * t)
    roll = 0.05 * np.sin(1.3 * t)
    pitch = 0.02 * np.cos(0.7 * t)
    return motion_of(
        len(t),
        rate_hz,
        vx=25.0 + 3.0 * np.sin(0.3 * t),
        vy=0.8 * np.sin(0.9 * t),
        yaw_rate=yaw_rate,
        ax=2.0 * np.cos(0.5 * t),
        ay=8.0 * np.sin(1.2 * t),
        steer=0.05 * np.sin(1.4 * t),
        roll=roll,
        pitch=pitch,
        roll_rate=0.05 * 1.3 * np.cos(1.3 * t),
        pitch_rate=-0.02 * 0.7 * np.sin(0.7 * t),
        wheel_speed=wheels,
        tyre_fx=10.0 * wheels,
        tyre_fy=20.0 * wheels,
        tyre_fz=30.0 * wheels,
        bank=0.03 * np.sin(0.2 * t),
        grade=0.02 * np.cos(0.2 * t),
        motor_speed=80.0 + np.sin(0.6 * t),
        motor_current=30.0 * np.sin(0.8 * t),
    )


def swerving(seconds):
    """A hard drive that obeys planar kinematics, whose body rolls with ay and pitches with ax as
    the Ferrari's does.
    """
    t = np.arange(round(seconds * 100.0)) / 100.0

    def sines(*parts):
        angles = [2.0 * np.pi * frequency * t + phase for _, frequency, phase in parts]
        value = sum(part[0] * np.sin(angle) for part, angle in zip(parts, angles, strict=True))
        slope = sum(
            part[0] * 2.0 * np.pi * part[1] * np.cos(angle)
            for part, angle in zip(parts, angles, strict=True)
        )
        return value, slope

    yaw_rate, _ = sines((0.2, 0.06, 0.0), (0.1, 0.17, 1.0), (0.05, 0.6, 2.0))
    vy, vy_change = sines((0.6, 0.07, 1.0), (0.3, 0.2, 2.0), (0.2, 0.7, 0.5))
    vx, vx_change = sines((5.0, 0.02, 0.0), (2.0, 0.11, 1.0), (0.8, 0.5, 2.0))
    vx = vx + 35.0
    ax = vx_change - vy * yaw_rate
    ay = vy_change + vx * yaw_rate
    return motion_of(
        len(t),
        vx=vx,
        vy=vy,
        yaw_rate=yaw_rate,
        ax=ax,
        ay=ay,
        roll=0.0021 * ay,
        pitch=-0.0042 * ax,
        steer=0.1 * yaw_rate,
    )


def only(**levels):
    """Ideal sensors but for the given ones."""
    return replace(PRESETS["ideal"], **levels)


def differing_channels(first, second):
    assert first.keys() == second.keys()
    return {name for name in first if not np.array_equal(first[name], second[name])}


def test_ideal_sensors_measure_the_exact_motion():
    motion = weaving()
    channels = measure(motion, PRESETS["ideal"], seed=3)
    for name in ("vx", "yaw_rate", "roll_rate", "pitch_rate", "ax", "ay", "steer"):
        np.testing.assert_array_equal(channels[name], getattr(motion, name), err_msg=name)
    for place, wheel in enumerate(WHEELS):
        np.testing.assert_array_equal(
            channels[f"wheel_speed_{wheel}"], motion.wheel_speed[:, place]
        )
        for axis in "xyz":
            np.testing.assert_array_equal(
                channels[f"f{axis}_{wheel}"], getattr(motion, f"tyre_f{axis}")[:, place]
            )
    for name in ("vx", "vy", "yaw_rate"):
        np.testing.assert_array_equal(channels[f"{name}_ref"], getattr(motion, name))
    np.testing.assert_array_equal(channels["sideslip_ref"], motion.sideslip)
    channels = measure(weaving(1.0), SensorLevels(), seed=0)
    assert set(channels) <= set(CHANNELS)
    assert {"roll", "pitch", "handwheel"}.isdisjoint(channels)
    assert len(channels) == 2 + 5 + 4 + 12 + 2 + 4
    nothing = switched_off(PRESETS["race"], "tilt", "imu", "reference", *SENSORS)
    assert (
        differing_channels(measure(motion, nothing, 0), measure(motion, PRESETS["ideal"], 1))
        == set()
    )


def test_a_single_sample_is_measured_and_cars_without_an_electric_motor_show_none():
    electric = weaving(1.0)
    motion = replace(electric, motor_speed=None, motor_current=None)
    with_motor = measure(electric, SensorLevels(), 0)
    without = measure(motion, SensorLevels(), 0)
    assert set(with_motor) - set(without) == {"motor_speed", "motor_current"}
    assert all(np.array_equal(without[name], with_motor[name]) for name in without)
    assert set(described(SensorLevels(), electric)) - set(described(SensorLevels(), motion)) == {
        "motor_speed",
        "motor_current",
    }
    assert "vibration" not in described(SensorLevels(), electric)
    assert "vibration" in described(PRESETS["small_car"], electric)
    levels = replace(SensorLevels(), imu=Mounting(lever_x=0.5), reference=PRESETS["race"].reference)
    assert all(
        np.isfinite(samples).all() and samples.shape == (1,)
        for samples in measure(motion_of(1, vx=20.0), levels, 0).values()
    )


def test_vibration_grows_with_the_wheels_speed_and_moves_nothing_else():
    motion = motion_of(
        20_000, wheel_speed=np.repeat(np.linspace(0.0, 100.0, 20_000)[:, None], 4, axis=1)
    )
    shaken = measure(motion, only(vibration=Vibration(yaw_rate=0.01, ax=0.1, ay=0.2)), seed=3)
    assert differing_channels(shaken, measure(motion, PRESETS["ideal"], seed=3)) == {
        "yaw_rate",
        "ax",
        "ay",
    }
    for name, per_speed in (("yaw_rate", 0.01), ("ax", 0.1), ("ay", 0.2)):
        for part in (slice(1_000, 3_000), slice(17_000, 19_000)):
            expected = per_speed * np.sqrt((motion.wheel_speed[part, 0] ** 2).mean())
            assert shaken[name][part].std() == pytest.approx(expected, rel=0.06), name
    louder = measure(motion, only(vibration=Vibration(ax=0.1)), seed=3)
    np.testing.assert_array_equal(louder["ax"], shaken["ax"])


@pytest.mark.parametrize("rate_hz", [20.0, 100.0, 1000.0])
def test_noise_is_white_and_has_its_density_at_every_rate(rate_hz):
    # 20,000 samples: the standard deviation is known to 0.5 %, a correlation to 0.007; four of
    # either are allowed.
    channels = measure(
        motion_of(20_000, rate_hz, vx=20.0), only(ay=SensorLevel(noise=0.01)), seed=5
    )
    assert np.std(channels["ay"]) == pytest.approx(0.01 * math.sqrt(rate_hz / 2.0), rel=0.02)
    frequency, power = signal.welch(channels["ay"], rate_hz, nperseg=256)
    low = power[(frequency > 0) & (frequency < rate_hz / 4)].mean()
    high = power[frequency > rate_hz / 4].mean()
    assert math.sqrt(low) == pytest.approx(0.01, rel=0.05)
    assert math.sqrt(high) == pytest.approx(0.01, rel=0.05)
    assert abs(np.corrcoef(channels["ay"][1:], channels["ay"][:-1])[0, 1]) < 0.03
    assert stats.kstest(channels["ay"] / np.std(channels["ay"]), "norm").pvalue > 1e-3


def test_offset_and_scale_are_drawn_for_each_drive_and_for_each_wheel():
    # 400 draws: a standard deviation is known to 3.5 %, a mean to 5 % of it, a correlation to 0.05;
    # four of each are allowed.
    levels = only(ay=SensorLevel(offset=0.03), wheel_speed=SensorLevel(scale=0.01))
    drives = [measure(motion_of(2, wheel_speed=50.0), levels, seed) for seed in range(400)]
    offsets = np.array([drive["ay"] for drive in drives])
    assert np.ptp(offsets, axis=1).max() == 0.0  # constant along a drive
    assert np.std(offsets[:, 0]) == pytest.approx(0.03, rel=0.14)
    assert abs(np.mean(offsets[:, 0])) < 0.03 * 0.2
    scales = np.array(
        [[drive[f"wheel_speed_{wheel}"][0] / 50.0 - 1.0 for wheel in WHEELS] for drive in drives]
    )
    np.testing.assert_allclose(scales.std(axis=0), 0.01, rtol=0.14)
    assert np.abs(np.corrcoef(scales.T) - np.eye(4)).max() < 0.2


def test_drift_is_a_stationary_gauss_markov_process():
    # 2000 s with a correlation time of 2 s are about 1000 independent values: 2.5 % of the
    # deviation, 0.03 of a correlation.
    drift = measure(
        motion_of(40_000, 20.0), only(yaw_rate=SensorLevel(drift=0.01, drift_time=2.0)), seed=2
    )["yaw_rate"]
    assert np.std(drift) == pytest.approx(0.01, rel=0.1)
    for lag in (0.5, 2.0, 6.0):
        samples = round(lag * 20.0)
        assert np.corrcoef(drift[samples:], drift[:-samples])[0, 1] == pytest.approx(
            math.exp(-lag / 2.0), abs=0.1
        )
    levels = only(yaw_rate=SensorLevel(drift=0.01, drift_time=1e9))
    starts = [measure(motion_of(50), levels, seed)["yaw_rate"][[0, -1]] for seed in range(400)]
    assert np.std([start for start, _ in starts]) == pytest.approx(
        0.01, rel=0.14
    )  # it does not start from zero
    assert np.ptp(starts, axis=1).max() < 1e-5


def test_quantisation_error_is_uniform_within_half_a_step():
    ramp = np.linspace(0.0, 1.0, 50_001) ** 2
    values = measure(
        motion_of(len(ramp), steer=ramp), only(steer=SensorLevel(quantisation=0.001)), seed=0
    )["steer"]
    steps = values / 0.001
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    error = values - ramp
    assert np.abs(error).max() <= 0.0005 + 1e-12
    assert np.std(error) == pytest.approx(0.001 / math.sqrt(12.0), rel=0.02)
    assert stats.kstest(error[::7], stats.uniform(-0.0005, 0.001).cdf).pvalue > 1e-3


@pytest.mark.parametrize("delay", [0.004, 0.01, 0.0137, 0.25])
def test_delay_of_a_sine_is_its_phase(delay):
    # At 5 Hz and 100 Hz sampling the cubic between samples loses up to 3/128 (2π·0.05)⁴ = 0.02 % of
    # the amplitude.
    t = np.arange(1000) / 100.0
    values = measure(
        motion_of(1000, yaw_rate=np.sin(2.0 * np.pi * 5.0 * t)),
        only(yaw_rate=SensorLevel(delay=delay)),
        seed=0,
    )["yaw_rate"]
    late = math.ceil(delay * 100.0) + 1
    np.testing.assert_allclose(
        values[late:-1], np.sin(2.0 * np.pi * 5.0 * (t[late:-1] - delay)), atol=3e-4
    )


def test_delay_repeats_the_start_and_shifts_integer_samples_exactly():
    ramp = 5.0 + np.arange(50.0)
    delayed_ramp = measure(motion_of(50, vx=ramp), only(vx=SensorLevel(delay=0.03)), seed=0)["vx"]
    np.testing.assert_array_equal(delayed_ramp, np.concatenate([[5.0, 5.0, 5.0], ramp[:-3]]))
    parts = measure(motion_of(50, vx=ramp), only(vx=SensorLevel(delay=0.034)), seed=0)["vx"]
    np.testing.assert_allclose(parts[6:-1], ramp[6:-1] - 3.4, atol=1e-12)
    assert parts[0] == parts[2] == 5.0
    longer = measure(motion_of(50, vx=ramp), only(vx=SensorLevel(delay=3.0)), seed=0)["vx"]
    np.testing.assert_array_equal(longer, 5.0)


@pytest.mark.parametrize(
    ("angle", "ax", "ay"), [("roll", 0, 1), ("bank", 0, 1), ("pitch", -1, 0), ("grade", -1, 0)]
)
def test_gravity_leaks_in_at_rest_with_the_left_side_up_or_the_nose_down(angle, ax, ay):
    channels = measure(motion_of(3, **{angle: 0.05}), only(tilt=Tilt()), seed=0)
    np.testing.assert_allclose(channels["ax"], ax * G * math.sin(0.05), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(channels["ay"], ay * G * math.sin(0.05), rtol=1e-12, atol=1e-12)


def test_specific_force_and_gyros_are_those_of_turned_axes():
    motion = weaving()
    force = specific_force(motion, Tilt())
    for k in (0, 333, 1999):
        road = _rotation(motion.bank[k], motion.grade[k])
        body = _rotation(motion.roll[k], motion.pitch[k])
        level = road @ np.array([motion.ax[k], motion.ay[k], 0.0]) - np.array([0.0, 0.0, -G])
        np.testing.assert_allclose(force[:, k], (road @ body).T @ level, atol=1e-12)
    # A turntable: the body's axes in the road's are R(t) = Rz(ψ)Ry(θ)Rx(φ), its angular velocity
    # the skew matrix RᵀdR/dt.
    rates = body_rates(motion, Tilt())
    t = 3.21
    h = 1e-5
    k = 321

    def at(s):
        yaw = -0.4 / 1.1 * math.cos(1.1 * s)
        return _rotation(0.05 * math.sin(1.3 * s), 0.02 * math.cos(0.7 * s), yaw)

    skew = at(t).T @ (at(t + h) - at(t - h)) / (2.0 * h)
    np.testing.assert_allclose(rates[:, k], [skew[2, 1], skew[0, 2], skew[1, 0]], atol=1e-8)
    assert measure(motion_of(1, roll=0.05, yaw_rate=0.6), only(tilt=Tilt()), 0)["pitch_rate"][
        0
    ] == pytest.approx(0.6 * math.sin(0.05))
    straight = measure(motion, only(tilt=Tilt()), seed=0)
    turned = measure(
        motion, only(tilt=Tilt(), imu=Mounting(roll=0.1, pitch=-0.05, yaw=0.2)), seed=0
    )
    axes = _rotation(0.1, -0.05, 0.2)
    for names, third in (
        (("roll_rate", "pitch_rate", "yaw_rate"), None),
        (("ax", "ay"), specific_force(motion, Tilt())[2]),
    ):
        vector = np.stack(
            [straight[name] for name in names] + ([third] if third is not None else [])
        )
        np.testing.assert_allclose(
            np.stack([turned[name] for name in names]), (axes.T @ vector)[: len(names)], atol=1e-12
        )


def test_accelerometer_away_from_the_axis_feels_turning_and_swinging():
    # Yaw rate 0.5 t about the centre: tangential 0.5 l, centripetal (0.5 t)² l; central differences
    # of a line are exact.
    t = np.arange(200) / 100.0
    channels = measure(
        motion_of(200, yaw_rate=0.5 * t), only(imu=Mounting(lever_x=1.2, lever_y=-0.4)), seed=0
    )
    np.testing.assert_allclose(channels["ax"], 0.5 * 0.4 - (0.5 * t) ** 2 * 1.2, atol=1e-12)
    np.testing.assert_allclose(channels["ay"], 0.5 * 1.2 + (0.5 * t) ** 2 * 0.4, atol=1e-12)
    # Place R(t) l by differentiation, with all three rates at work; differences over 10 ms are good
    # to 1e-3 of the amplitude.
    motion = weaving()
    lever = np.array([1.0, -0.6, 0.8])
    levels = only(imu=Mounting(*lever), tilt=Tilt(bank=False, grade=False))
    channels = measure(motion, levels, 0)
    bare = measure(motion, only(tilt=levels.tilt), 0)
    yaw = lambda s: -0.4 / 1.1 * math.cos(1.1 * s)  # noqa: E731
    place = lambda s: (  # noqa: E731
        _rotation(0.05 * math.sin(1.3 * s), 0.02 * math.cos(0.7 * s), yaw(s)) @ lever
    )
    for k in (100, 321, 1500):
        t = k / 100.0
        h = 1e-3
        axes = _rotation(motion.roll[k], motion.pitch[k], yaw(t))
        expected = axes.T @ (place(t + h) - 2.0 * place(t) + place(t - h)) / h**2
        np.testing.assert_allclose(
            [channels["ax"][k] - bare["ax"][k], channels["ay"][k] - bare["ay"][k]],
            expected[:2],
            atol=1e-3,
        )


def test_misalignment_lever_and_heading_errors_have_their_size():
    values = [
        measure(motion_of(1), only(imu=Mounting(misalignment=0.01)), seed) for seed in range(400)
    ]
    for name in ("ax", "ay"):
        assert np.std([drive[name][0] for drive in values]) == pytest.approx(
            G * 0.01, rel=0.14
        )  # 400 draws
    motion = motion_of(10, vx=20.0, yaw_rate=0.5)
    errors = [
        measure(motion, only(reference=Reference("gnss", lever_error=0.02)), seed)["vy_ref"][0]
        for seed in range(400)
    ]
    assert np.std(errors) == pytest.approx(0.5 * 0.02, rel=0.14)
    motion = weaving(1.0)
    levels = only(reference=Reference("gnss", heading=SensorLevel(offset=0.01)))
    drives = [measure(motion, levels, seed) for seed in range(400)]
    errors = np.array([drive["sideslip_ref"] - motion.sideslip for drive in drives])
    assert np.ptp(errors, axis=1).max() < 1e-12
    assert np.std(errors[:, 0]) == pytest.approx(0.01, rel=0.14)  # 400 draws
    np.testing.assert_allclose(
        np.hypot(drives[0]["vx_ref"], drives[0]["vy_ref"]), np.hypot(motion.vx, motion.vy)
    )


def test_reference_in_the_bumper_is_moved_and_rolls_below_the_centre_of_gravity():
    motion = replace(weaving(), roll_rate=np.zeros(2000), pitch_rate=np.zeros(2000))
    channels = measure(
        motion, only(reference=Reference("optical", lever_x=2.0, lever_y=0.4, lever_z=-0.2)), seed=0
    )
    np.testing.assert_allclose(channels["vx_ref"], motion.vx, atol=1e-12)
    np.testing.assert_allclose(channels["vy_ref"], motion.vy, atol=1e-12)
    channels = measure(
        motion_of(5, vx=20.0, roll_rate=0.2, pitch_rate=0.1),
        only(reference=Reference("optical", lever_z=-0.3)),
        seed=0,
    )
    np.testing.assert_allclose(
        channels["vy_ref"], 0.2 * 0.3
    )  # left side going up: what is below goes left
    np.testing.assert_allclose(
        channels["vx_ref"], 20.0 - 0.1 * 0.3
    )  # nose going down: what is below goes back


def test_errors_of_reference_and_car_sensors_are_independent():
    channels = measure(
        motion_of(20_000, vx=20.0),
        only(vx=LOUD, yaw_rate=LOUD, reference=Reference("gnss", vx=LOUD, yaw_rate=LOUD)),
        seed=1,
    )
    for name in ("vx", "yaw_rate"):
        errors = np.diff(channels[name]), np.diff(channels[f"{name}_ref"])
        assert np.abs(np.corrcoef(*errors)[0, 1]) < 0.03  # 20,000 samples: 0.007
    motion = weaving()
    changed = differing_channels(
        measure(motion, PRESETS["default"], 1),
        measure(motion, replace(PRESETS["default"], reference=Reference()), 1),
    )
    assert changed == {"vx_ref", "vy_ref", "yaw_rate_ref", "sideslip_ref"}


def channels_of(sensor):
    return (
        {f"{sensor}_{wheel}" for wheel in WHEELS}
        if sensor in ("wheel_speed", "fx", "fy", "fz")
        else {sensor}
    )


@pytest.mark.parametrize("sensor", SENSORS)
def test_switching_off_an_error_leaves_all_else_bit_by_bit(sensor):
    motion = weaving(2.0)
    levels = replace(SensorLevels(), **dict.fromkeys(SENSORS, LOUD))
    all_on = measure(motion, levels, seed=7)
    for kind in KINDS:
        assert differing_channels(
            all_on, measure(motion, switched_off(levels, f"{sensor}.{kind}"), seed=7)
        ) == channels_of(sensor), kind
    silent = switched_off(levels, sensor)
    assert getattr(silent, sensor) == SensorLevel(drift_time=LOUD.drift_time)
    assert differing_channels(all_on, measure(motion, silent, seed=7)) == channels_of(sensor)


def test_error_streams_of_sensors_are_independent():
    motion = motion_of(500, ay=3.0)
    ay = {
        kind: measure(motion, only(ay=level), seed=7)["ay"] - 3.0
        for kind, level in _alone(LOUD).items()
    }
    together = measure(motion, only(ay=replace(LOUD, quantisation=0.0)), seed=7)["ay"] - 3.0
    np.testing.assert_allclose(
        ay["noise"] + ay["offset"] + ay["drift"] + ay["scale"], together, atol=1e-12
    )
    assert ay["scale"][0] / (LOUD.scale * 3.0) != pytest.approx(ay["offset"][0] / LOUD.offset)
    levels = {name: SensorLevel(offset=1.0, drift=1.0, noise=1.0, scale=1.0) for name in SENSORS}
    first = []
    for kind in ("offset", "drift", "noise"):
        quiet = {name: _alone(level)[kind] for name, level in levels.items()}
        reference = Reference("gnss", vx=quiet["vx"], vy=quiet["vx"], yaw_rate=quiet["vx"])
        channels = measure(motion_of(1), only(**quiet, reference=reference), seed=0)
        first += [
            samples[0] / (math.sqrt(50.0) if kind == "noise" else 1.0)
            for name, samples in channels.items()
            if name != "sideslip_ref"
        ]
    assert len({round(value, 9) for value in first}) == len(first) == 3 * 28


def test_switching_off_takes_parts_wholes_and_kinds():
    levels = replace(PRESETS["race"], imu=Mounting(lever_x=0.3, yaw=0.1, misalignment=0.01))
    off = switched_off(
        levels, "ay.noise", "tilt.bank", "imu.lever_x", "reference.heading.drift", "*.offset"
    )
    assert off.ay == replace(levels.ay, noise=0.0, offset=0.0)
    assert off.tilt == Tilt(bank=False)
    assert off.imu == Mounting(yaw=0.1, misalignment=0.01)
    assert off.reference == replace(
        levels.reference, heading=replace(levels.reference.heading, drift=0.0)
    )
    assert [getattr(off, name).offset for name in SENSORS] == [0.0] * len(SENSORS)
    assert switched_off(levels, "*") == switched_off(levels, *SENSORS)
    assert switched_off(levels) == levels


@pytest.mark.parametrize(
    "name", ["az", "ay.slope", "ay.noise.much", "ay.drift_time", "reference.kind", "*.lever_x", ""]
)
def test_switching_off_an_unknown_part_lists_the_parts(name):
    assert "cannot switch off" in refusal(
        lambda: switched_off(SensorLevels(), name), ConfigurationError
    )


def test_seed_determines_every_sample_independent_of_the_duration():
    motion = weaving()
    first, again, second = (measure(motion, PRESETS["race"], seed) for seed in (5, 5, 6))
    assert differing_channels(first, again) == set()
    assert differing_channels(first, second) == set(first)
    short, long = (measure(motion_of(n, vx=20.0), SensorLevels(), seed=3) for n in (500, 900))
    for name in short:
        np.testing.assert_array_equal(short[name], long[name][:500], err_msg=name)


@pytest.mark.parametrize(
    ("spelt", "meant"),
    [
        ("", SensorLevels()),
        ("race", PRESETS["race"]),
        ("ideal", PRESETS["ideal"]),
        ("{ay: {noise: 0}}", replace(SensorLevels(), ay=replace(SensorLevels().ay, noise=0.0))),
        ("{preset: race, ay: {noise: 0}}", switched_off(PRESETS["race"], "ay.noise")),
        (
            "{preset: ideal, ay: {noise: 1, drift: 0.5, drift_time: 20}}",
            only(ay=SensorLevel(noise=1.0, drift=0.5, drift_time=20.0)),
        ),
        ("{steer: 'off'}", switched_off(SensorLevels(), "steer")),
        ("{tilt: off}", switched_off(SensorLevels(), "tilt")),
        ("{tilt: {bank: off, roll: 'on'}}", switched_off(SensorLevels(), "tilt.bank")),
        (
            "{imu: {lever_x: 0.3}}",
            replace(SensorLevels(), imu=Mounting(lever_x=0.3, misalignment=0.0035)),
        ),
        ("{reference: optical}", sensor_levels_from_config({"reference": {"kind": "optical"}})),
        ("{reference: off}", replace(SensorLevels(), reference=Reference())),
        ("{reference: {vy: {noise: 0}}}", switched_off(SensorLevels(), "reference.vy.noise")),
        (
            "{switched_off: [ay.noise, '*.drift']}",
            switched_off(SensorLevels(), "ay.noise", "*.drift"),
        ),
    ],
)
def test_sensor_configurations_are_parsed(spelt, meant):
    assert sensor_levels_from_config(yaml.safe_load(spelt)) == meant


@pytest.mark.parametrize(
    ("spelt", "message"),
    [
        ("perfect", "sensors 'perfect' is not one of: default, race, ideal"),
        ("{az: {noise: 0}}", "sensors: 'az' is not one of: vx, yaw_rate"),
        ("{ay: {slope: 0}}", "sensors: ay: 'slope' is not one of: noise, offset"),
        ("{ay: {noise: -1}}", "sensors: ay: noise must be zero or positive, not -1.0"),
        ("{ay: {drift_time: 0}}", "drift_time must be positive"),
        ("{imu: {lever_x: .inf}}", "sensors: imu: lever_x must be finite"),
        (
            "{reference: radar}",
            "sensors: reference 'radar' is not one of: optical, gnss, motion_capture, ideal",
        ),
        (
            "{reference: {heading: {delay: 1}}}",
            "sensors: reference: heading has noise, offset and drift only",
        ),
        (
            "{switched_off: [ay.slope]}",
            "sensors: cannot switch off 'ay.slope': 'slope' is not one of: noise, offset",
        ),
    ],
)
def test_invalid_sensor_configurations_are_refused_in_a_single_line(spelt, message):
    assert message in refusal(
        lambda: sensor_levels_from_config(yaml.safe_load(spelt)), ConfigurationError
    )


def test_noise_density_is_measured_despite_resonance_and_jolts():
    noise = measure(motion_of(60_000), only(ay=SensorLevel(noise=0.02)), seed=0)["ay"]
    assert noise_density(noise, 100.0) == pytest.approx(0.02, rel=0.05)
    shaken = noise + 0.3 * np.sin(2.0 * np.pi * 21.0 * np.arange(60_000) / 100.0)
    shaken[[10_000, 31_000]] += 5.0
    assert noise_density(shaken, 100.0) == pytest.approx(0.02, rel=0.05)


def test_reading_a_simulated_race_car_gives_its_levels_back():
    # 25 minutes are 250 correlation times of ay's drift: 5 % of its deviation. Its time, where the
    # correlation falls to 1/e, is less well known, and the reference's own slow errors blur all
    # that is slow.
    race = PRESETS["race"]
    levels = replace(
        race,
        ax=replace(race.ax, drift=0.1, drift_time=2.0),
        ay=replace(race.ay, drift=0.2, drift_time=6.0),
    )
    levels_read = read_off(measure(swerving(1500.0), levels, 0), 100.0)
    for sensor in ("ax", "ay"):
        for kind, rel in (("noise", 0.05), ("delay", 0.2), ("drift", 0.2), ("drift_time", 0.4)):
            assert levels_read[f"{sensor}.{kind}"] == pytest.approx(
                getattr(getattr(levels, sensor), kind), rel=rel
            ), (sensor, kind)
    assert levels_read["yaw_rate.noise"] == pytest.approx(levels.yaw_rate.noise, rel=0.05)
    assert levels_read["yaw_rate.delay"] == pytest.approx(levels.yaw_rate.delay, rel=0.3)
    assert levels_read["steer.quantisation"] == pytest.approx(levels.steer.quantisation, rel=1e-6)
    assert levels_read["roll_gradient"] == pytest.approx(0.0021, rel=0.3)
    assert levels_read["pitch_gradient"] == pytest.approx(0.0042, rel=0.3)


def test_race_levels_are_those_of_the_ferrari_recording(data_root):
    folder = data_root / "revs" / "20140222_01_01_03_250lm"
    files = {
        "vx": "vx",
        "yaw_rate": "yawRate",
        "ax": "axCG",
        "ay": "ayCG",
        "steer": "delta",
        "vx_ref": "vx",
        "vy_ref": "vy",
    }
    levels_read = read_off(
        {name: np.loadtxt(folder / f"{file}.txt") for name, file in files.items()}, 100.0
    )
    levels = asdict(PRESETS["race"])
    assert (
        0.001 < levels_read.pop("roll_gradient") < 0.004
    )  # 1.2° at 1 g: its accelerometers roll with the body
    assert 0.002 < levels_read.pop("pitch_gradient") < 0.006
    for name, value in levels_read.items():
        level = levels
        for part in name.split("."):
            level = level[part]
        assert level == pytest.approx(value, rel=0.03), name  # the levels are rounded


def _rotation(roll, pitch, yaw=0.0):
    """Rz(yaw) Ry(pitch) Rx(roll): the axes of what is turned, pitched, then rolled, as columns."""
    return Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()


def _alone(level):
    """One level for each kind of error, with that kind only."""
    return {
        kind: replace(SensorLevel(drift_time=level.drift_time), **{kind: getattr(level, kind)})
        for kind in KINDS
    }
