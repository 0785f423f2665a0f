"""The best lever arm against planted ones, and where it is asked for."""

import numpy as np
import pytest
from scipy import optimize

from vehest.data.recording import Recording
from vehest.data.splits import Span
from vehest.evaluation.lever_arm import LONGEST, best_lever_arm, lever_arm_figures
from vehest.evaluation.metrics import Protocol, Scored, accuracy

RATE, N = 20.0, 400
PROTOCOL = Protocol(rate_hz=RATE, skip_seconds=1.5)


def drive(point="unknown"):
    time = np.arange(N) / RATE
    yaw_rate = 0.8 * np.sin(0.9 * time) + 0.1
    channels = {"vx": 12.0 + np.sin(0.3 * time), "yaw_rate": yaw_rate, "vy_ref": 0.4 * np.cos(0.7 * time) - 0.3 * yaw_rate}
    derived = {} if point is None else {"derived": {"reference_point": point}}
    return Recording("drive", "car", RATE, 0.0, channels, provenance=derived)


def scored(recording, vy):
    cut = recording.cut(PROTOCOL.skip_seconds, recording.end_time)
    vy = vy[-len(cut) :]
    sideslip, reference = np.arctan2(vy, cut["vx"]), np.arctan2(cut["vy_ref"], cut["vx"])
    return Scored(cut.time, vy, cut["vy_ref"], sideslip, reference, np.full(len(cut), np.nan))


def figures(recording, vy):
    span = Span("mine", "drive")
    return lever_arm_figures([scored(recording, vy)], [(recording, span)], PROTOCOL)


@pytest.mark.parametrize("x", [-0.4, 0.0, 0.27])
def test_a_planted_lever_arm_is_found_and_leaves_no_error(x):
    recording = drive()
    found = figures(recording, recording["vy_ref"] + x * recording["yaw_rate"])
    assert found["lever_arm"] == pytest.approx(x, abs=1e-12)
    assert [found[name] for name in ("rmse_vy", "rmse_sideslip", "fvu")] == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)


def test_no_other_lever_arm_leaves_less_of_a_noisy_estimate():
    recording = drive()
    vy = recording["vy_ref"] + 0.2 * recording["yaw_rate"] + np.random.default_rng(0).normal(0.0, 0.1, N)
    part = scored(recording, vy)
    yaw_rate = recording["yaw_rate"][-len(part.vy) :]
    searched = optimize.minimize_scalar(
        lambda x: np.mean((part.vy - part.vy_ref - x * yaw_rate) ** 2), bounds=(-0.5, 0.5), method="bounded"
    )
    found = figures(recording, vy)
    assert found["lever_arm"] == pytest.approx(searched.x, abs=1e-4)
    assert found["rmse_vy"] ** 2 == pytest.approx(searched.fun, rel=1e-6)
    assert found["rmse_vy"] < accuracy([part])["rmse_vy"]


def test_a_lever_arm_beyond_half_a_metre_is_cut_there():
    recording = drive()
    found = figures(recording, recording["vy_ref"] - 1.3 * recording["yaw_rate"])
    assert found["lever_arm"] == -LONGEST
    yaw_rate = recording["yaw_rate"][-round((N / RATE - 1.5) * RATE) :]
    assert found["rmse_vy"] == pytest.approx(0.8 * np.sqrt(np.mean(yaw_rate**2)), rel=1e-9)


@pytest.mark.parametrize("point", [None, {"x": 0.0, "y": 0.0}])
def test_where_the_point_is_known_or_undeclared_nothing_is_given(point):
    recording = drive(point)
    assert figures(recording, recording["vy_ref"]) == {}


def test_a_car_that_never_turns_has_no_lever_arm():
    recording = drive()
    part = scored(recording, recording["vy_ref"] + 0.1)
    best = best_lever_arm([part], [np.zeros(len(part.vy))], [np.ones(len(part.vy))])
    assert best.x == 0.0
    np.testing.assert_array_equal(best.parts[0].vy, part.vy)
