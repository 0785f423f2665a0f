"""Fits of tyre curves against cars whose curves are known."""

from functools import cache

import numpy as np
import pytest
from refusals import refusal

from single_track_drive import with_gaps
from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.estimators.filtering.tyre_fit import (
    ROAD_TYRE_LOG_C1,
    axle_force,
    axle_motion,
    fit_motion,
)
from vehest.vehicle.parameters import SingleTrackParameters

TRUCK = SingleTrackParameters(7912.0, 24230.0, 1.7401, 1.7599, 1.0, 1.0)
CURVES = {
    "linear": np.array([[3.0e5], [4.0e5]]),
    "rational": np.array([[0.01286, 486735.0], [0.00769, 622319.0]]),
}


@cache
def car(kind, seconds, rate_hz, size):
    """What a single track with these curves does, integrated at 200 Hz."""
    stride = round(200.0 / rate_hz)
    step = 1.0 / (stride * rate_hz)
    time = np.arange(round(seconds / step)) * step
    speed = 12.0 + 4.0 * np.sin(0.11 * time)
    angle = size * (0.10 * np.sin(0.5 * time) + 0.06 * np.sin(0.83 * time))
    curves = CURVES[kind].tolist()
    front_arm = TRUCK.cg_to_front_axle
    rear_arm = TRUCK.cg_to_rear_axle
    beta = 0.0
    r = 0.0
    rows = []
    for u, steer in zip(speed.tolist(), angle.tolist(), strict=True):
        front = axle_force(kind, curves[0], steer - beta - front_arm * r / u)
        rear = axle_force(kind, curves[1], rear_arm * r / u - beta)
        lateral = (front + rear) / TRUCK.mass
        rows.append((r, lateral, steer, beta, u))
        beta += step * (lateral / u - r)
        r += step * (front_arm * front - rear_arm * rear) / TRUCK.yaw_inertia
    return dict(
        zip(
            ("yaw_rate", "ay", "steer", "sideslip_ref", "vx"),
            np.array(rows)[::stride].T,
            strict=True,
        )
    )


def drive(kind="rational", seed=0, noise=1.0, seconds=100.0, rate_hz=50.0, size=1.0):
    """That car with noisy sensors."""
    generator = np.random.default_rng(seed)
    levels = {"yaw_rate": 0.002, "ay": 0.1, "steer": 0.001, "sideslip_ref": 0.001, "vx": 0.0}
    true = car(kind, seconds, rate_hz, size)
    channels = {
        name: samples + noise * levels[name] * generator.standard_normal(len(samples))
        for name, samples in true.items()
    }
    return Recording("known", "truck", rate_hz, 0.0, channels, "simulated")


@pytest.mark.parametrize("kind", ["linear", "rational"])
def test_fit_finds_the_curves_of_a_car_that_has_such_curves(kind):
    fit = fit_motion(axle_motion([drive(kind, seconds=200.0)], TRUCK), kind)
    parameters = np.stack([fit.front, fit.rear])
    np.testing.assert_allclose(parameters, CURVES[kind], rtol=0.03)
    assert (np.abs(parameters - CURVES[kind]) < 2.0 * fit.interval).all()
    assert (fit.interval / CURVES[kind] < 0.1).all()


def test_forces_without_noise_are_those_of_the_car_and_refusals_name_the_remedy():
    clean = drive(noise=0.0)
    motion = axle_motion([clean], TRUCK)
    for curve, slip, force in zip(CURVES["rational"], motion.slip, motion.force, strict=True):
        assert (
            np.sqrt(np.mean((axle_force("rational", curve, slip) - force) ** 2))
            < 0.005 * np.abs(force).max()
        )
    recording = drive()
    assert "100 are needed" in refusal(lambda: axle_motion([recording.cut(0.0, 1.0)], TRUCK))
    mirrored = recording.with_channels({name: -recording[name] for name in ("ay", "yaw_rate")})
    with pytest.raises(DataError, match="check the signs of steer, ay and vy_ref"):
        fit_motion(axle_motion([mirrored], TRUCK))


def test_intervals_hold_the_truth_about_as_often_as_they_say():
    inside = []
    for seed in range(12):
        fit = fit_motion(axle_motion([drive(seed=seed, rate_hz=20.0)], TRUCK))
        inside.append(np.abs(np.stack([fit.front, fit.rear]) - CURVES["rational"]) < fit.interval)
    assert 0.7 < np.mean(inside) <= 1.0


def test_priors_of_road_tyres_remain_where_drives_do_not_reach_the_bend():
    """c1 stays where tyres peak at 9 degrees and as uncertain as that is, while c2 is what the
    drive says.
    """
    fit = fit_motion(axle_motion([drive(size=0.05)], TRUCK))
    assert (
        np.abs(np.log(np.stack([fit.front, fit.rear])[:, 0]) - ROAD_TYRE_LOG_C1[0])
        < 1.0 * ROAD_TYRE_LOG_C1[1]
    ).all()
    c1 = np.array([fit.front[0], fit.rear[0]])
    interval = fit.interval[:, 0]
    np.testing.assert_allclose(interval / c1, 1.96 * ROAD_TYRE_LOG_C1[1], rtol=0.3)
    np.testing.assert_allclose([fit.front[1], fit.rear[1]], CURVES["rational"][:, 1], rtol=0.08)


def test_measured_forces_and_several_drives_count_and_slow_samples_do_not():
    recording = drive(noise=0.0)
    wheels = {
        f"fy_{wheel}": np.full(len(recording), value)
        for wheel, value in (("fl", 1.0), ("fr", 2.0), ("rl", 10.0), ("rr", 20.0))
    }
    motion = axle_motion([recording.with_channels(wheels)], TRUCK, measured_forces=True)
    np.testing.assert_allclose(
        motion.force, np.repeat([[3.0], [30.0]], motion.force.shape[1], axis=1)
    )
    two_drives = fit_motion(axle_motion([drive(seed=1), drive(seed=2)], TRUCK))
    assert (
        two_drives.slip.shape[1]
        == 2 * fit_motion(axle_motion([drive(seed=1)], TRUCK)).slip.shape[1]
    )
    recording = drive()
    slow = np.array(recording["vx"])
    slow[:500] = 1.0
    gappy = with_gaps(recording.with_channels({"vx": slow}), {"ay": slice(1000, 1100)})
    motion = axle_motion([gappy], TRUCK)
    assert motion.slip.shape == motion.force.shape == (2, len(motion.block))
    assert (
        len(motion.block) == len(recording) - 500 - 100 - 24 - 12
    )  # the smoothing reaches 12 samples to either side
