"""Pieces of the study of heavy-vehicle laps, on a short drive of a filter whose curves and levels are given."""

import math
from dataclasses import replace

import numpy as np
import pytest

from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.estimators.rational_ekf import AxleCurves, RationalFilter, TrackNoise
from vehest.vehicle.parameters import SingleTrackParameters
from vehest_papers.heavy_ekf import accuracy, tables, tyres, vehicle, watching
from vehest_papers.heavy_ekf.document import WHEELS
from vehest_papers.heavy_ekf.subjects import Filter, corners

RATE = 20.0
TRUCK = SingleTrackParameters(7912.0, 24230.0, 1.7401, 1.7599, 1.0, 1.0)


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
        f"wheel_speed_{wheel}": (u - yaw_rate * side) / WHEELS.wheel_radius
        for wheel, side in sides.items()
    }
    references = {
        "vx_ref": u,
        "vy_ref": 0.1 * yaw_rate,
        "yaw_rate_ref": yaw_rate,
        "sideslip_ref": 0.01 * yaw_rate,
    }
    return Recording("short", "truck", RATE, 0.0, channels | references, "simulated")


@pytest.fixture(scope="module")
def ratte():
    curves = AxleCurves(0.013, 487e3, 0.0077, 622e3)
    return RationalFilter(
        RationalFilter.settings_type(
            car=TRUCK, minimum_speed=2.0, curves=curves, noise=TrackNoise(0.003, 0.1, 0.002, 0.003)
        )
    )


def test_every_fault_leaves_the_filter_finite_and_the_monitor_sees_another_sign(ratte):
    drive = short_drive()
    for name, apply in watching.faults(WHEELS).items():
        estimate = ratte.estimate([apply(drive).without_references()])[0]
        assert all(np.isfinite(values).all() for values in estimate.channels.values()), name
    wrong = watching.faults(WHEELS)["yaw rate of the other sign"](drive)
    sound, flipped = (ratte.estimate([own.without_references()])[0] for own in (drive, wrong))
    limit = watching.MARGIN * np.max(watching.monitor(sound["nis"], sound["nis_dof"], RATE))
    assert np.max(watching.monitor(flipped["nis"], flipped["nis_dof"], RATE)) > 3.0 * limit
    nis = np.repeat([2.0, 6.0, 0.0], 200)
    dof = np.repeat([2.0, 1.0, 0.0], 200)
    np.testing.assert_array_equal(watching.monitor(nis, dof, RATE), [1.0, 6.0, math.nan])


def test_table_of_bad_input_names_the_drive_backwards(ratte):
    drive = short_drive()
    filters = {"RATTE": Filter("RATTE", None, ratte)}
    table, *words = watching.bad_input_table(filters, drive, [drive], WHEELS, 2.0, "SIMULATED")
    said = table.frame.set_index("fault")["check"]
    assert said["nothing"] == "–"
    assert said["the drive backwards"] == "reverse: vx"
    assert not any("the drive backwards" in str(block) for block in words)


def test_convergence_counts_from_the_last_time_outside():
    time = np.arange(6.0) + 100.0
    assert tyres.convergence_time(time, np.array([2.0, 1.0, 1.5, 1.05, 1.0, 0.95]), 1.0) == 3.0
    assert tyres.convergence_time(time, np.full(6, 1.05), 1.0) == 0.0
    assert tyres.convergence_time(time, np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.2]), 1.0) == math.inf


def test_gains_are_those_of_the_figures_and_locked_axles_named():
    rmse = {
        (name, f"{kind}_{drive}"): value
        for name, value in (("LINT", 1.0), ("RATT", 0.5), ("RATTE", 0.25))
        for kind in tables.TYRES
        for drive in tables.DRIVES
    }
    frame = tables.gains_table(rmse).frame
    assert frame["nominal_laps"].tolist() == ["50 %", "50 %", "75 %"]
    assert frame["paper"].tolist() == ["37 %", "44 %", "65 %"]
    assert "rear (Eqs. 63, 64)" in vehicle._locked_in_words(np.array([1.6, 0.0]))
    assert vehicle._locked_in_words(np.array([1.6, 1.5])) == ""


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


def test_an_estimate_that_is_a_fifth_too_small_has_a_gain_of_0_8():
    drive = short_drive(120.0)
    drive = replace(drive, channels={**drive.channels, "ay": 2.0 * drive["ay"]})
    values = accuracy.gains_of(drive, estimated(drive, 0.8, 1e-5))
    assert len(values) == 12
    assert values.mean() == pytest.approx(0.8, abs=0.01)
    turning = corners(drive)
    true = drive["sideslip_ref"][turning]
    scaled = estimated(drive, 0.8, 1e-3)["sideslip"][turning]
    slope = np.polyfit(true, scaled, 1)[0]
    assert accuracy.gains_of(drive, estimated(drive, 0.8, 1e-3)).mean() == pytest.approx(slope)


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
    stops = replace(drive, channels={**drive.channels, "vx_ref": speed})
    wrong = np.radians(np.where(drive.time > 39.58, 50.0, np.where(drive.time > 34.98, 0.3, 7.0)))
    sideslip = drive["sideslip_ref"] + wrong
    estimate = Estimate(drive.id, "late", RATE, 0.0, {"vy": sideslip, "sideslip": sideslip})
    assert accuracy.error_before_stop(stops, estimate) == pytest.approx(0.3)


def test_laps_are_thirds_of_the_way_and_the_stop_is_when_the_truck_last_moved():
    drive = short_drive(90.0)
    laps = accuracy.laps_of(drive)
    assert [int(lap.sum()) for lap in laps] == [600, 600, 600]
    assert not (laps[0] & laps[1]).any()
    drive = short_drive(60.0)
    speed = np.where(drive.time < 40.0, 10.0, 0.0)
    stopped = Recording(
        "stops", "truck", RATE, 0.0, {**drive.channels, "vx_ref": speed}, "simulated"
    )
    assert accuracy.stop_of(stopped) == pytest.approx(40.0, abs=0.06)
