"""Metrics, best lever arms and indicators over manoeuvres against their definitions on series whose
errors are known.
"""

import math

import numpy as np
import pytest
from refusals import refusal
from scipy import optimize

from conftest import planar_drive
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.splits import Span
from vehest.evaluation.blocks import figure_intervals, segments_of
from vehest.evaluation.lever_arm import MAX_LEVER_ARM, lever_arm_figures
from vehest.evaluation.metrics import (
    UNITS,
    Protocol,
    Scored,
    accuracy,
    is_fast_enough,
    min_sideslip_speed,
    moves_forward,
    score,
    weighted_errors,
)
from vehest.evaluation.ranking import rank
from vehest_papers.cnn_ukf.manoeuvres import (
    error_distribution,
    group_of,
    kpis,
    kpis_by_group,
    manoeuvres_of,
)


def _estimate(vy, rate_hz=20.0):
    return Estimate("drive", "test", rate_hz, 0.0, {"vy": vy, "sideslip": np.zeros(len(vy))})


def test_accuracy_has_the_values_of_a_hand_calculation_and_wraps_angles():
    vy_ref = np.array([1.0, -1.0, 2.0, -2.0])
    vy = vy_ref + np.array([0.1, 0.1, 0.3, 0.3])
    part = Scored(
        np.arange(4.0),
        vy,
        vy_ref,
        np.radians([1.0, 2.0, 3.0, 4.0]),
        np.zeros(4),
        np.array([1.0, 5.0, -6.0, 0.0]),
        np.ones(4, dtype=bool),
    )
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
    part = Scored(
        np.arange(2.0),
        np.ones(2),
        np.array([1.0, 2.0]),
        np.radians([179.0, -170.0]),
        np.radians([-178.0, 170.0]),
        np.zeros(2),
        np.ones(2, dtype=bool),
    )
    figures = accuracy([part])
    assert figures["max_error_sideslip"] == pytest.approx(20.0)
    assert figures["rmse_sideslip"] == pytest.approx(math.sqrt((3.0**2 + 20.0**2) / 2))


def test_scoring_starts_after_warm_up_at_speed_without_offset(drive):
    part = Scored(
        drive.time,
        drive["vy_ref"] + 0.5,
        drive["vy_ref"],
        drive["sideslip_ref"],
        drive["sideslip_ref"],
        drive["ay"],
        np.ones(len(drive), dtype=bool),
    )
    figures = accuracy([part])
    assert figures["fvu"] == pytest.approx(0.0, abs=1e-12)
    assert figures["rmse_vy"] == pytest.approx(0.5)
    vy = np.where(drive.time < 11.5 - 1e-9, 1e6, drive["vy_ref"])
    scored = score(_estimate(vy), drive, Span("d", "drive", 10.0, 30.0), Protocol())
    assert accuracy([scored])["rmse_vy"] == 0.0
    drive = planar_drive(noise=0.3)
    scored = score(
        _estimate(drive["vy_ref"] + 1.0),
        drive,
        Span("d", "drive"),
        Protocol(),
    )
    vx = drive["vx"][30:]
    assert np.allclose(scored.sideslip_ref, np.arctan2(drive["vy_ref"][30:], vx))
    assert np.allclose(scored.sideslip, np.arctan2(drive["vy_ref"][30:] + 1.0, vx))


def test_weighted_metrics_match_a_hand_calculation():
    zero = np.zeros(2)
    other_states = {"vx": (np.array([1.0, 0.0]), zero), "yaw_rate": (np.array([0.0, -2.0]), zero)}
    is_scored = np.ones(2, dtype=bool)
    part = Scored(
        np.arange(2.0), np.array([0.0, 3.0]), zero, zero, zero, zero, is_scored, other_states
    )
    figures = accuracy([part])
    absolute = [0.2225, 3 * 0.5064 + 2 * 0.1566]
    assert figures["mse_weighted"] == pytest.approx((0.2225 + 9 * 0.5064 + 4 * 0.1566) / 2)
    assert figures["mae_weighted"] == pytest.approx(sum(absolute) / 2)
    assert figures["ae99_weighted"] == pytest.approx(np.quantile(absolute, 0.99))
    assert (figures["rmse_vx"], figures["rmse_yaw_rate"]) == (
        pytest.approx(math.sqrt(0.5)),
        pytest.approx(math.sqrt(2.0)),
    )
    assert set(figures) <= set(UNITS)
    with_vx = Scored(zero, zero, zero, zero, zero, zero, is_scored, {"vx": (zero, zero)})
    without = Scored(zero, zero, zero, zero, zero, zero, is_scored)
    assert "rmse_vx" in accuracy([with_vx])
    assert "mse_weighted" not in accuracy([with_vx])
    assert not {"rmse_vx", "rmse_yaw_rate", "nees", "nis"} & set(accuracy([with_vx, without]))
    assert "there is none of yaw_rate" in refusal(lambda: weighted_errors(with_vx, np.square))


def test_faster_estimates_use_the_latest_past_sample(drive):
    """A 100 Hz estimate is read at 20 Hz at the same instant; one that starts late is held."""
    times = np.arange(0, 60, 0.01)
    estimate = _estimate(times.copy(), 100.0)
    scored = score(estimate, drive, Span("d", "drive", 10.0, 20.0), Protocol(20.0, 10.0, 1.5))
    assert scored.time[0] == pytest.approx(11.5)
    assert scored.time[-1] == pytest.approx(19.95)
    assert np.allclose(scored.vy, scored.time, atol=1e-9)
    slow = _estimate(times[::50].copy(), 2.0)
    slow_score = score(slow, drive, Span("d", "drive", 10.0, 20.0), Protocol(20.0, 10.0, 1.5))
    assert np.allclose(slow_score.vy, np.floor(slow_score.time * 2 + 1e-6) / 2)
    assert (slow_score.vy <= slow_score.time + 1e-9).all()


def stopping(drive):
    """The drive with half a second at 0.0003 m/s."""
    vx = drive["vx"].copy()
    vy = drive["vy_ref"].copy()
    vx[500:510] = 0.0003
    vy[500:510] = 0.0
    return drive.with_channels({"vx": vx, "vy_ref": vy})


def test_sideslip_at_standstill_is_left_out_of_the_mean_and_lateral_velocity_is_not(drive):
    """An error of 0.1 m/s everywhere; at 0.0003 m/s it would be a sideslip of 90 degrees."""
    recording = stopping(drive)
    estimate = _estimate(recording["vy_ref"] + 0.1)
    everywhere, moving = (
        accuracy([score(estimate, recording, Span("d", "drive"), protocol)])
        for protocol in (Protocol(min_sideslip_speed=0.0), Protocol())
    )
    is_scored = (recording.time >= 1.5) & (recording["vx"] > 1.0)
    true = np.arctan2(recording["vy_ref"], recording["vx"])
    error = np.degrees(np.arctan2(recording["vy_ref"] + 0.1, recording["vx"]) - true)[is_scored]
    assert everywhere["max_error_sideslip"] > 80.0
    assert moving["max_error_sideslip"] == pytest.approx(np.abs(error).max())
    assert moving["rmse_sideslip"] == pytest.approx(np.sqrt(np.mean(error**2)))
    assert moving["share_below_min_speed"] == pytest.approx(10 / (recording.time >= 1.5).sum())
    assert everywhere["share_below_min_speed"] == 0.0
    assert moving["rmse_vy"] == everywhere["rmse_vy"] == pytest.approx(0.1)
    assert moving["mse_sideslip"] == everywhere["mse_sideslip"]  # of a paper: all samples


def test_standing_car_has_an_error_of_lateral_velocity_alone(drive):
    at_rest = {"vx": np.zeros(len(drive)), "vy_ref": np.zeros(len(drive))}
    recording = drive.with_channels(at_rest)
    estimate = _estimate(np.full(len(recording), 0.1))
    part = score(estimate, recording, Span("d", "drive"), Protocol())
    figures = accuracy([part])
    assert (figures["rmse_vy"], figures["share_below_min_speed"]) == (pytest.approx(0.1), 1.0)
    for name in ("rmse_sideslip", "max_error_sideslip", "p99_sideslip"):
        assert math.isnan(figures[name])
    segments = segments_of([part], 20.0)
    assert set(figure_intervals(segments)) == {"rmse_vy"}
    ranking = rank({("a", ""): [segments], ("zero", ""): [segments]}, 20.0)
    assert (list(ranking.order), ranking.winner, ranking.n_blocks) == ([], None, 0)


def test_min_sideslip_speed_follows_the_wheelbase_unless_set():
    assert min_sideslip_speed(None) == min_sideslip_speed(2.7) == 1.0
    assert min_sideslip_speed(0.324) == pytest.approx(0.3464, abs=1e-4)
    by_car = Protocol().with_wheelbases({"car": 2.7, "model": 0.675, "unknown": None})
    speeds = [by_car.min_sideslip_speed_on(name) for name in ("car", "model", "unknown", "other")]
    assert speeds == [1.0, 0.5, 1.0, 1.0]
    assert by_car.describe_min_sideslip_speed(["car", "model"]) == "1 m/s (car), 0.5 m/s (model)"
    protocol = Protocol(min_sideslip_speed=0.1).with_wheelbases({"car": 2.7})
    assert protocol.min_sideslip_speed_on("car") == 0.1


def test_an_estimate_with_holes_has_no_score(drive):
    vy = drive["vy_ref"].copy()
    vy[500] = np.nan
    assert "has no estimate for 1 of" in refusal(
        lambda: score(_estimate(vy), drive, Span("d", "drive"), Protocol())
    )


def test_without_lateral_acceleration_all_but_the_nonlinear_range_is_scored(drive):
    without = drive.select([name for name in drive.channels if name != "ay"])
    estimate = _estimate(drive["vy_ref"] + 0.1 * np.sin(drive.time))
    figures, expected = (
        accuracy([score(estimate, recording, Span("d", "drive", 10.0, 30.0), Protocol())])
        for recording in (without, drive)
    )
    blank = {"mse_sideslip_nonlinear", "max_error_sideslip_nonlinear"}
    assert all(math.isnan(figures[name]) for name in blank)
    assert {name: value for name, value in figures.items() if name not in blank} == {
        name: value for name, value in expected.items() if name not in blank
    }
    part = score(
        _estimate(drive["vy_ref"] + 0.1),
        without,
        Span("d", "drive"),
        Protocol(),
    )
    indicators = kpis({"slalom": [part]})
    assert indicators.mse > 0
    assert math.isnan(indicators.mse_nonlinear)
    assert segments_of([part], 20.0).squared_error_vy.sum() == pytest.approx(0.01 * len(part.time))


RATE = 20.0
N = 400
PROTOCOL = Protocol(rate_hz=RATE, skip_seconds=1.5)


def drive(point="unknown"):
    time = np.arange(N) / RATE
    yaw_rate = 0.8 * np.sin(0.9 * time) + 0.1
    channels = {
        "vx": 12.0 + np.sin(0.3 * time),
        "yaw_rate": yaw_rate,
        "vy_ref": 0.4 * np.cos(0.7 * time) - 0.3 * yaw_rate,
    }
    derived = {} if point is None else {"derived": {"reference_point": point}}
    return Recording("drive", "car", RATE, 0.0, channels, provenance=derived)


def scored(recording, vy):
    cut = recording.cut(PROTOCOL.skip_seconds, recording.end_time)
    vy = vy[-len(cut) :]
    sideslip = np.arctan2(vy, cut["vx"])
    reference = np.arctan2(cut["vy_ref"], cut["vx"])
    nothing = np.full(len(cut), np.nan)
    is_scored = np.ones(len(cut), dtype=bool)
    return Scored(cut.time, vy, cut["vy_ref"], sideslip, reference, nothing, is_scored)


def figures(recording, vy):
    span = Span("mine", "drive")
    return lever_arm_figures([scored(recording, vy)], [(recording, span)], PROTOCOL)


def test_planted_lever_arm_is_estimated_only_where_the_reference_point_is_unknown():
    recording = drive()
    for x in (-0.4, 0.0, 0.27):
        values = figures(recording, recording["vy_ref"] + x * recording["yaw_rate"])
        assert values["lever_arm"] == pytest.approx(x, abs=1e-12)
        assert [values[name] for name in ("rmse_vy", "rmse_sideslip", "fvu")] == pytest.approx(
            [0.0, 0.0, 0.0], abs=1e-9
        )
    for recording in (drive(None), drive({"x": 0.0, "y": 0.0})):
        assert figures(recording, recording["vy_ref"]) == {}


def test_no_other_lever_arm_leaves_less_of_a_noisy_estimate():
    recording = drive()
    vy = (
        recording["vy_ref"]
        + 0.2 * recording["yaw_rate"]
        + np.random.default_rng(0).normal(0.0, 0.1, N)
    )
    part = scored(recording, vy)
    yaw_rate = recording["yaw_rate"][-len(part.vy) :]
    searched = optimize.minimize_scalar(
        lambda x: np.mean((part.vy - part.vy_ref - x * yaw_rate) ** 2),
        bounds=(-0.5, 0.5),
        method="bounded",
    )
    best = figures(recording, vy)
    assert best["lever_arm"] == pytest.approx(searched.x, abs=1e-4)
    assert best["rmse_vy"] ** 2 == pytest.approx(searched.fun, rel=1e-6)
    assert best["rmse_vy"] < accuracy([part])["rmse_vy"]


def test_lever_arms_end_at_half_a_metre_and_need_a_turn():
    recording = drive()
    values = figures(recording, recording["vy_ref"] - 1.3 * recording["yaw_rate"])
    assert values["lever_arm"] == -MAX_LEVER_ARM
    yaw_rate = recording["yaw_rate"][-round((N / RATE - 1.5) * RATE) :]
    assert values["rmse_vy"] == pytest.approx(0.8 * np.sqrt(np.mean(yaw_rate**2)), rel=1e-9)
    straight = recording.with_channels({"yaw_rate": np.zeros(N)})
    values = figures(straight, recording["vy_ref"] + 0.1)
    assert (values["lever_arm"], values["rmse_vy"]) == (0.0, pytest.approx(0.1))


def driven_by(errors_deg, ay):
    zero = np.zeros(len(ay))
    error = np.radians(errors_deg)
    time = np.arange(len(ay)) * 0.01
    is_scored = np.ones(len(ay), dtype=bool)
    return Scored(time, 20.0 * np.tan(error), zero, error, zero, np.array(ay), is_scored)


CALM = driven_by([1.0, -0.5, 0.5, 0.5], [0.0, 1.0, -2.0, 3.0])
HARD = driven_by([0.0, -4.0, 2.0, 0.0], [0.0, -8.0, 4.0, 3.9])
SET = {"test_slalom_18_on_001": [CALM], "test_j_turn_off_002": [HARD]}


def test_errors_are_means_over_samples_and_largest_ones_over_manoeuvres():
    figures = accuracy([CALM, HARD])
    assert (
        kpis(SET).mse == pytest.approx(figures["mse_sideslip"]) == pytest.approx((1.75 + 20.0) / 8)
    )
    assert (
        kpis(SET).mse_nonlinear
        == pytest.approx(figures["mse_sideslip_nonlinear"])
        == pytest.approx(10.0)
    )
    assert kpis(SET).max_error == pytest.approx(0.5 * (1.0 + 4.0))
    assert kpis(SET).max_error_nonlinear == pytest.approx(4.0)  # the calm one has no such sample
    assert np.isnan(kpis({"calm": [CALM]}).max_error_nonlinear)


def test_manoeuvres_are_recordings_grouped_by_their_names():
    spans = [Span("bmw", "test_lap_off_001", 0.0, 1.0), Span("bmw", "test_lap_off_001", 2.0, 3.0)]
    together = manoeuvres_of(spans, [CALM, HARD])
    assert kpis(together).manoeuvres == 1
    assert kpis(together).max_error == pytest.approx(4.0)
    assert "1 scored parts do not belong to 2 ranges" in refusal(
        lambda: manoeuvres_of(spans, [CALM])
    )
    assert group_of("test_lane_change_2_off_001") == "lane change"
    assert group_of("20140222_01") == "other"
    groups = kpis_by_group(SET | {"train_slalom_30_off_003": [HARD]})
    assert list(groups) == ["J-turn", "slalom"]
    assert groups["slalom"].manoeuvres == 2
    assert groups["slalom"].max_error == pytest.approx(2.5)


def test_distribution_counts_errors_in_bins_of_a_quarter_of_a_degree():
    distribution = error_distribution(
        [driven_by([0.6, -0.6, 0.1, 0.7], [0.0, 5.0, -6.0, 1.0])], nonlinear_only=False
    )
    np.testing.assert_allclose(distribution.edges, [-0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75])
    np.testing.assert_array_equal(distribution.counts, [1, 0, 0, 1, 0, 2])
    hard = error_distribution([CALM, HARD])
    assert (hard.counts.sum(), hard.mean, hard.deviation) == (
        2,
        pytest.approx(-1.0),
        pytest.approx(3.0),
    )
    assert "no sample has a lateral acceleration" in refusal(lambda: error_distribution([CALM]))


def test_an_estimate_moves_forward_by_its_velocity_and_angle():
    vx = np.array([0.99, 1.01, 0.6, -3.0, 0.05, 2.0, 2.0])
    vy = np.array([0.0, 0.0, 0.81, 0.1, 0.01, np.nan, -0.5])
    is_forward = moves_forward(vy[2:], np.arctan2(vy, vx)[2:], 1.0)
    assert is_forward.tolist() == [False, False, False, False, True]
    assert moves_forward(vy[:2], np.arctan2(vy, vx)[:2], 1.0).all()  # v = 0: β = 0 at any speed
    assert not moves_forward(np.array([0.1]), np.zeros(1), 1.0).any()  # standstill
    assert not moves_forward(np.zeros(1), np.arctan2(np.zeros(1), -np.ones(1)), 1.0).any()


def test_sideslip_in_reverse_is_scored_within_a_half_turn_and_not_drawn():
    vx = np.array([5.0, -5.0, 0.2])
    vy = np.array([0.1, 0.1, 0.1])
    vy_ref = np.array([-0.1, -0.1, -0.1])
    scored = Scored(
        np.arange(3.0),
        vy,
        vy_ref,
        np.arctan2(vy, vx),
        np.arctan2(vy_ref, vx),
        np.zeros(3),
        is_fast_enough(vx, vy_ref, 1.0),
    )
    turn = 2.0 * np.arctan2(0.1, 5.0)
    assert scored.sideslip_error[:2] == pytest.approx([turn, -turn])
    assert scored.is_sideslip_scored.tolist() == [True, True, False]
    assert scored.is_sideslip_drawn.tolist() == [True, False, False]
