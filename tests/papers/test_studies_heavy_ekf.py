"""Measures of the study of heavy-vehicle laps, on a short drive."""

import math

import numpy as np
import pytest

from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest_papers.heavy_ekf import accuracy

RATE = 20.0
WHEEL_RADIUS = 0.48


def short_drive(seconds=60.0):
    """A truck that weaves, by steady-state gains, with wheels that roll."""
    time = np.arange(round(seconds * RATE)) / RATE
    generator = np.random.default_rng(0)
    u = np.full(len(time), 10.0)
    steer = 0.05 * np.sin(0.4 * time)
    yaw_rate = u * steer / 3.5
    clean = {
        "vx": u,
        "steer": steer,
        "yaw_rate": yaw_rate,
        "ay": u * yaw_rate,
        "ax": np.zeros(len(time)),
    }
    levels = {"vx": 0.01, "steer": 0.0005, "yaw_rate": 0.002, "ay": 0.05, "ax": 0.05}
    channels = {
        name: samples + levels[name] * generator.standard_normal(len(time))
        for name, samples in clean.items()
    }
    sides = {"fl": 1.04, "fr": -1.04, "rl": 1.04, "rr": -1.04}
    channels |= {
        f"wheel_speed_{wheel}": (u - yaw_rate * side) / WHEEL_RADIUS
        for wheel, side in sides.items()
    }
    references = {
        "vx_ref": u,
        "vy_ref": 0.1 * yaw_rate,
        "yaw_rate_ref": yaw_rate,
        "sideslip_ref": 0.01 * yaw_rate,
    }
    return Recording("short", "truck", RATE, 0.0, channels | references, "simulated")


def estimated(drive, gain, noise=0.0):
    sideslip = gain * drive["sideslip_ref"] + noise * np.random.default_rng(1).standard_normal(
        len(drive)
    )
    return Estimate(
        drive.id,
        "scaled",
        drive.rate_hz,
        drive.start_time,
        {"vy": drive["vx"] * np.tan(sideslip), "sideslip": sideslip},
    )


def test_errors_that_double_on_the_last_lap_have_a_log_change_of_their_squares():
    drive = short_drive(90.0)
    last = accuracy.laps_of(drive)[-1]
    wrong = 0.01 * np.where(last, 2.0, 1.0) * np.where(drive.time < 1.5, 100.0, 1.0)
    sideslip = drive["sideslip_ref"] + wrong
    estimate = Estimate(drive.id, "doubled", RATE, 0.0, {"vy": sideslip, "sideslip": sideslip})
    changes = accuracy.log_change_of_last_lap(drive, estimate, 2.0)
    assert len(changes) == 2, "30 s, less the start that is not scored, in stretches of 10 s"
    assert changes == pytest.approx(np.full(2, math.log(4.0)))


def test_error_before_the_stop_leaves_the_last_moments_out():
    drive = short_drive(60.0)
    speed = np.where(drive.time < 40.0, 10.0, 0.0)
    stops = drive.with_channels({"vx_ref": speed})
    wrong = np.radians(np.where(drive.time > 39.58, 50.0, np.where(drive.time > 34.98, 0.3, 7.0)))
    sideslip = drive["sideslip_ref"] + wrong
    estimate = Estimate(drive.id, "late", RATE, 0.0, {"vy": sideslip, "sideslip": sideslip})
    assert accuracy.error_before_stop(stops, estimate) == pytest.approx(0.3)


def test_laps_are_thirds_of_the_way():
    laps = accuracy.laps_of(short_drive(90.0))
    assert [int(lap.sum()) for lap in laps] == [600, 600, 600]
    assert not (laps[0] & laps[1]).any()
