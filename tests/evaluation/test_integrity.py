"""Regions of the Stanford diagram, alarms, and their intervals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from vehest.evaluation.integrity import (
    HAZARDOUS,
    MISLEADING,
    NOMINAL,
    UNAVAILABLE,
    detection_delay,
    error_while_undetected,
    false_alarms_per_hour,
    integrity_of,
    missed_detections,
)
from vehest.report.integrity_figures import stanford_figure


def flags(length: int, *spans: tuple[int, int]) -> np.ndarray:
    found = np.zeros(length, bool)
    for begin, end in spans:
        found[begin:end] = True
    return found


@pytest.mark.parametrize(
    ("error", "level", "flagged", "region"),
    [
        (0.5, 1.0, False, NOMINAL),
        (-0.5, 1.0, False, NOMINAL),
        (1.5, 1.0, False, MISLEADING),
        (-2.5, 1.0, False, HAZARDOUS),
        (2.5, 3.0, False, UNAVAILABLE),
        (5.0, 3.0, False, UNAVAILABLE),
        (2.5, 1.0, True, UNAVAILABLE),
    ],
)
def test_each_sample_lies_in_its_region(error: float, level: float, flagged: bool, region: str) -> None:
    found = integrity_of(np.array([error]), np.array([level]), np.array([flagged]), alert_limit=2.0)
    assert found.shares()[region] == 1.0
    assert sum(found.shares().values()) == 1.0


def test_samples_without_a_band_do_not_count() -> None:
    found = integrity_of(np.array([0.1, np.nan, 0.1]), np.array([1.0, 1.0, np.nan]), np.zeros(3, bool))
    assert len(found.error) == 1


def test_delay_counts_from_the_first_faulty_sample_to_the_end_of_the_flagged_one() -> None:
    assert detection_delay(flags(100, (5, 8), (30, 40)), 20, 100, 10.0) == pytest.approx(1.1)
    assert detection_delay(flags(100, (5, 8)), 20, 100, 10.0) == math.inf
    assert missed_detections([0.2, 1.1, math.inf, 0.4], [0.5, 1.0, 5.0, 0.5]) == 0.5


def test_alarms_in_a_row_are_one_and_their_interval_is_poissons() -> None:
    found = false_alarms_per_hour([flags(36_000, (10, 20), (500, 501)), flags(36_000, (0, 5))], 10.0)
    assert (found.alarms, found.hours) == (3, 2.0)
    assert stats.poisson.sf(2, found.low * 2.0) == pytest.approx(0.025)
    assert stats.poisson.cdf(3, found.high * 2.0) == pytest.approx(0.025)


def test_no_alarm_in_an_hour_and_a_half_bounds_the_rate_at_two_and_a_half_an_hour() -> None:
    found = false_alarms_per_hour([np.zeros(54_000, bool)], 10.0)
    assert (found.low, found.high) == (0.0, pytest.approx(-math.log(0.025) / 1.5))


def test_error_counts_until_the_first_flag() -> None:
    error = np.array([9.0, 9.0, 3.0, -4.0, 9.0, 9.0])
    assert error_while_undetected(error, flags(6, (4, 6)), 2, 6) == (pytest.approx(math.sqrt(12.5)), 4.0)
    assert error_while_undetected(error, flags(6, (2, 6)), 2, 6) == (0.0, 0.0)


def test_the_diagram_has_a_panel_an_estimate() -> None:
    generator = np.random.default_rng(0)
    own = integrity_of(generator.standard_normal(500), generator.uniform(0.5, 3.0, 500), np.zeros(500, bool))
    assert len([axes for axes in stanford_figure({"a": own, "b": own, "c": own, "d": own}).axes if axes.get_visible()]) == 4
