"""What follows from health: who still gets a channel, who starts anew, how wide a band is."""

import math

import numpy as np
import pytest

from vehest.estimators.registry import estimator_class
from vehest.trust import health_kernel as kernel
from vehest.trust.guard import RESTART, USE
from vehest.trust.health import BEYOND_SPEED, NO_ESTIMATE, NUMBERS, TOO_WIDE, reason_in_words
from vehest.trust.verdict import Monitor, isolate_rows, verdict_rows, widen_rows
from vehest.trust.watch import CLIPPED, EXTRAPOLATED, SPINNING

CHANNELS = ("yaw_rate", "vx", "ay")
SKIPPABLE = np.array([True, False, True])
STEPS = 60
PERSISTENT = 10
NUMBERS_OF = np.array([NUMBERS[name] for name in CHANNELS])


def code(kind, channel):
    return 10_000.0 * kind + 100.0 * NUMBERS[channel]


def heeded(kind, channel, status=2, first=10, last=40, rows_together=STEPS, **family):
    """Rows, what was measured and the flow after a fault that health sees from ``first`` to
    ``last``.
    """
    statuses = np.zeros(STEPS)
    statuses[first:last] = status
    return isolated(statuses, code(kind, channel), rows_together, **family)


def isolated(statuses, reason, rows_together=STEPS, *, adapts=False, starts_anew=True):
    """The same for any statuses with one reason, some rows at a time."""
    reasons = np.where(statuses > 0, reason, 0.0)
    rows = np.ones((STEPS, 3))
    measured = np.ones((STEPS, 3), np.bool_)
    flow = np.full(STEPS, USE, np.int8)
    state = np.zeros(2)
    for k in range(0, STEPS, rows_together):
        part = slice(k, k + rows_together)
        isolate_rows(
            statuses[part],
            reasons[part],
            NUMBERS_OF,
            SKIPPABLE,
            starts_anew,
            adapts,
            PERSISTENT,
            rows[part],
            measured[part],
            flow[part],
            state,
        )
    return rows, measured, flow


def test_accused_channels_are_left_out_unless_needed_or_merely_suspected():
    rows, measured, _ = heeded(kernel.OFFSET, "ay")
    assert np.isnan(rows[10:40, 2]).all()
    assert not measured[10:40, 2].any()
    assert np.isfinite(np.delete(rows, np.s_[10:40], axis=0)).all()
    assert np.isfinite(rows[:, :2]).all()
    assert np.isfinite(heeded(kernel.SCALE, "vx")[0]).all()
    rows, _, flow = heeded(kernel.OFFSET, "ay", status=1)
    assert np.isfinite(rows).all()
    assert (flow == USE).all()


@pytest.mark.parametrize("kind", [kernel.OUTSIDE, kernel.SPIN, kernel.MISSING])
def test_a_verdict_that_is_no_sensor_fault_changes_nothing(kind):
    rows, _, flow = heeded(kind, "ay")
    assert np.isfinite(rows).all()
    assert (flow == USE).all()


def test_recursive_families_restart_once_and_adaptive_ones_every_second():
    assert np.flatnonzero(heeded(kernel.OFFSET, "ay")[2] == RESTART).tolist() == [40]
    assert not (heeded(kernel.OFFSET, "ay", starts_anew=False)[2] == RESTART).any()
    adaptive = {"adapts": True, "starts_anew": False}
    for rows_together in (STEPS, 1):
        flow = heeded(kernel.SCALE, "vx", rows_together=rows_together, **adaptive)[2]
        assert np.flatnonzero(flow == RESTART).tolist() == [19, 29, 39]
    assert not (heeded(kernel.OFFSET, "ay", **adaptive)[2] == RESTART).any()


def test_a_fault_shorter_than_a_second_restarts_nothing():
    statuses = np.zeros(STEPS)
    statuses[10:19] = 2.0
    statuses[19:55] = 1.0
    for adapts in (False, True):
        family = {"adapts": adapts, "starts_anew": not adapts}
        assert (isolated(statuses, code(kernel.SCALE, "vx"), **family)[2] == USE).all()


def test_the_verdict_names_the_reasons_of_guard_and_watch():
    marks = np.array([0, 0, SPINNING, CLIPPED, EXTRAPOLATED], np.int8)
    measured = np.ones((5, 3), np.bool_)
    measured[1, 1] = False
    status = np.zeros(5)
    reason = np.zeros(5)
    verdict_rows(
        np.ones(5), marks, np.zeros(5, np.int8), measured, ~SKIPPABLE, NUMBERS_OF, status, reason
    )
    assert status.tolist() == [0, 1, 1, 2, 2]
    reasons_text = [reason_in_words(reason_code) for reason_code in reason]
    assert reasons_text == [
        "",
        "vx is not measured",
        "spin",
        "the estimate exceeds what the speed allows",
        "there is no estimate",
    ]
    assert reason[3] == BEYOND_SPEED * 10_000
    assert reason[4] == NO_ESTIMATE * 10_000


@pytest.mark.parametrize(
    ("name", "config", "adapts"),
    [
        ("rational_ekf", {}, True),
        ("rational_ekf", {"tyres": "linear"}, True),
        ("rational_ekf", {"tyres": "rational_friction"}, True),
        ("rational_ekf", {"tyres": "rational"}, False),
        ("kalman", {}, False),
        ("kalman", {"offsets": {"ay": 0.3}}, True),
        ("learned_ukf", {}, True),
        ("self_calibrating", {}, True),
        ("luenberger", {}, False),
    ],
)
def test_filters_with_parameters_as_states_adapt_and_do_not_start_anew(name, config, adapts):
    monitor = Monitor(estimator_class(name).from_config(config), None)
    assert monitor.adapts == adapts
    assert monitor.starts_anew != adapts


def test_a_band_widens_with_worse_health_and_is_invalid_beyond_six_degrees():
    bands = np.full((4, 2), 0.1)
    marks = np.array([0, 0, 0, EXTRAPOLATED], np.int8)
    widen_rows(
        np.array([0.0, 1.0, 2.0, 2.0]),
        np.zeros(4),
        marks,
        np.full(4, 0.5),
        np.full(4, 20.0),
        1.5,
        bands,
    )
    assert bands[:3, 0].tolist() == pytest.approx([0.1, 0.2, 0.4])
    assert bands[3].tolist() == pytest.approx(
        [2.0, max(0.4, math.atan(2.0 / 20.0))]
    )  # as far as |v| and the farthest in training
    # Half widths of 2, 2, 4 and 7 degrees, the second and third twice as wide since they are
    # degraded.
    status = np.array([0.0, 1.0, 1.0, 0.0])
    reason = np.array([0.0, 40_200.0, 40_200.0, 0.0])
    bands = np.radians([[2.0, 2.0], [2.0, 2.0], [4.0, 4.0], [7.0, 7.0]])
    widen_rows(status, reason, np.zeros(4, np.int8), np.full(4, 0.5), np.full(4, 20.0), 1.5, bands)
    assert status.tolist() == [0.0, 1.0, 2.0, 2.0]
    assert reason.tolist() == [0.0, 40_200.0, 40_200.0, TOO_WIDE * 10_000.0]
    assert reason_in_words(reason[3]) == "the band of sideslip exceeds 6 degrees"
