"""Metrics against their definitions on series whose errors are known."""

import math
from dataclasses import replace

import numpy as np
import pytest

from conftest import planar_drive
from vehest.data.errors import DataError
from vehest.data.estimate import Estimate
from vehest.data.splits import Span
from vehest.evaluation.blocks import segments_of
from vehest.evaluation.metrics import UNITS, Protocol, Scored, accuracy, score, weighted_squared_errors
from vehest_papers.cnn_ukf.manoeuvres import kpis


def _estimate(times, vy, rate_hz, start):
    return Estimate("drive", "test", rate_hz, start, {"vy": vy, "sideslip": np.zeros(len(vy))})


def test_accuracy_has_the_values_of_a_hand_calculation():
    vy_ref = np.array([1.0, -1.0, 2.0, -2.0])
    vy = vy_ref + np.array([0.1, 0.1, 0.3, 0.3])
    part = Scored(np.arange(4.0), vy, vy_ref, np.radians([1.0, 2.0, 3.0, 4.0]), np.zeros(4), np.array([1.0, 5.0, -6.0, 0.0]))
    figures = accuracy([part])
    assert figures["rmse_vy"] == pytest.approx(math.sqrt((0.01 + 0.01 + 0.09 + 0.09) / 4))
    assert figures["fvu"] == pytest.approx(0.01 / 2.5)
    assert figures["r2"] == pytest.approx(1 - 0.01 / 2.5)
    assert figures["rmse_sideslip"] == pytest.approx(math.sqrt(30 / 4))
    assert figures["mse_sideslip"] == pytest.approx(7.5)
    assert figures["mse_sideslip_nonlinear"] == pytest.approx((4 + 9) / 2)
    assert figures["max_error_sideslip"] == pytest.approx(4.0)
    assert figures["max_error_sideslip_nonlinear"] == pytest.approx(3.0)
    assert figures["p99_sideslip"] == pytest.approx(np.quantile([1, 2, 3, 4], 0.99))
    assert set(figures) <= set(UNITS)


def test_sideslip_errors_are_never_more_than_half_a_turn():
    part = Scored(np.arange(2.0), np.ones(2), np.array([1.0, 2.0]), np.radians([179.0, -170.0]), np.radians([-178.0, 170.0]), np.zeros(2))
    figures = accuracy([part])
    assert figures["max_error_sideslip"] == pytest.approx(20.0)
    assert figures["rmse_sideslip"] == pytest.approx(math.sqrt((3.0**2 + 20.0**2) / 2))


def test_a_constant_offset_does_not_count_in_fvu_but_does_in_rmse(drive):
    part = Scored(drive.time, drive["vy_ref"] + 0.5, drive["vy_ref"], drive["sideslip_ref"], drive["sideslip_ref"], drive["ay"])
    figures = accuracy([part])
    assert figures["fvu"] == pytest.approx(0.0, abs=1e-12)
    assert figures["rmse_vy"] == pytest.approx(0.5)


def test_without_nonlinear_samples_nonlinear_metrics_are_nan():
    part = Scored(np.arange(3.0), np.ones(3), np.arange(3.0), np.zeros(3), np.zeros(3), np.zeros(3))
    assert math.isnan(accuracy([part])["mse_sideslip_nonlinear"])


def test_weighted_metrics_have_the_values_of_a_hand_calculation():
    zero = np.zeros(2)
    others = {"vx": (np.array([1.0, 0.0]), zero), "yaw_rate": (np.array([0.0, -2.0]), zero)}
    part = Scored(np.arange(2.0), np.array([0.0, 3.0]), zero, zero, zero, zero, others)
    figures = accuracy([part])
    absolute = [0.2225, 3 * 0.5064 + 2 * 0.1566]
    assert figures["mse_weighted"] == pytest.approx((0.2225 + 9 * 0.5064 + 4 * 0.1566) / 2)
    assert figures["mae_weighted"] == pytest.approx(sum(absolute) / 2)
    assert figures["ae99_weighted"] == pytest.approx(np.quantile(absolute, 0.99))
    assert (figures["rmse_vx"], figures["rmse_yaw_rate"]) == (pytest.approx(math.sqrt(0.5)), pytest.approx(math.sqrt(2.0)))
    assert set(figures) <= set(UNITS)


def test_metrics_of_states_that_one_part_lacks_are_absent():
    zero = np.zeros(2)
    with_vx = Scored(zero, zero, zero, zero, zero, zero, {"vx": (zero, zero)})
    without = Scored(zero, zero, zero, zero, zero, zero)
    assert "rmse_vx" in accuracy([with_vx])
    assert "mse_weighted" not in accuracy([with_vx])
    assert not {"rmse_vx", "rmse_yaw_rate", "nees", "nis"} & set(accuracy([with_vx, without]))
    with pytest.raises(DataError, match="there is none of yaw_rate"):
        weighted_squared_errors(with_vx)


def test_faster_estimates_are_held_never_interpolated_from_the_future(drive):
    """A 100 Hz estimate is read at 20 Hz at the same instant; one that starts late is held."""
    times = np.arange(0, 60, 0.01)
    estimate = _estimate(times, times.copy(), 100.0, 0.0)
    scored = score(estimate, drive, Span("d", "drive", 10.0, 20.0), Protocol(20.0, 10.0, 1.5))
    assert scored.time[0] == pytest.approx(11.5)
    assert scored.time[-1] == pytest.approx(19.95)
    assert np.allclose(scored.vy, scored.time, atol=1e-9)
    slow = _estimate(times[::50], times[::50].copy(), 2.0, 0.0)
    held = score(slow, drive, Span("d", "drive", 10.0, 20.0), Protocol(20.0, 10.0, 1.5))
    assert np.allclose(held.vy, np.floor(held.time * 2 + 1e-6) / 2)
    assert (held.vy <= held.time + 1e-9).all()


def test_the_first_second_and_a_half_is_not_scored(drive):
    vy = np.where(drive.time < 11.5 - 1e-9, 1e6, drive["vy_ref"])
    scored = score(_estimate(drive.time, vy, 20.0, 0.0), drive, Span("d", "drive", 10.0, 30.0), Protocol())
    assert accuracy([scored])["rmse_vy"] == 0.0


def test_sideslip_uses_the_measured_forward_velocity():
    drive = planar_drive(noise=0.3)
    scored = score(_estimate(drive.time, drive["vy_ref"] + 1.0, 20.0, 0.0), drive, Span("d", "drive"), Protocol())
    vx = drive["vx"][30:]
    assert np.allclose(scored.sideslip_ref, np.arctan2(drive["vy_ref"][30:], vx))
    assert np.allclose(scored.sideslip, np.arctan2(drive["vy_ref"][30:] + 1.0, vx))


def test_standstill_has_no_sideslip(drive):
    """Half a second at 0.0003 m/s: 0.1 m/s of v would be a sideslip of 90 degrees there."""
    vx, vy = drive["vx"].copy(), drive["vy_ref"].copy()
    vx[500:510], vy[500:510] = 0.0003, 0.0
    own = replace(drive, channels={**drive.channels, "vx": vx, "vy_ref": vy})
    estimate = _estimate(own.time, vy + np.where(vx < 1.0, 0.1, 0.0), 20.0, 0.0)
    counted, without = (
        accuracy([score(estimate, own, Span("d", "drive"), Protocol(least_speed=least))])["max_error_sideslip"] for least in (0.0, 0.1)
    )
    assert (counted > 80.0, without) == (True, 0.0)


def test_estimate_with_holes_is_an_error_not_a_better_score(drive):
    vy = drive["vy_ref"].copy()
    vy[500] = np.nan
    with pytest.raises(DataError, match="has no estimate for 1 of"):
        score(_estimate(drive.time, vy, 20.0, 0.0), drive, Span("d", "drive"), Protocol())


def test_recording_without_lateral_acceleration_is_scored_all_but_the_nonlinear_range(drive):
    without = drive.select([name for name in drive.channels if name != "ay"])
    estimate = _estimate(drive.time, drive["vy_ref"] + 0.1 * np.sin(drive.time), 20.0, 0.0)
    figures, known = (accuracy([score(estimate, own, Span("d", "drive", 10.0, 30.0), Protocol())]) for own in (without, drive))
    blank = {"mse_sideslip_nonlinear", "max_error_sideslip_nonlinear"}
    assert all(math.isnan(figures[name]) for name in blank)
    assert {name: value for name, value in figures.items() if name not in blank} == {
        name: value for name, value in known.items() if name not in blank
    }


def test_manoeuvres_without_lateral_acceleration_have_no_nonlinear_indicators(drive):
    without = drive.select([name for name in drive.channels if name != "ay"])
    part = score(_estimate(drive.time, drive["vy_ref"] + 0.1, 20.0, 0.0), without, Span("d", "drive"), Protocol())
    indicators = kpis({"slalom": [part]})
    assert indicators.mse > 0
    assert math.isnan(indicators.mse_nonlinear)
    assert segments_of([part], 20.0).squared_error_vy.sum() == pytest.approx(0.01 * len(part.time))
