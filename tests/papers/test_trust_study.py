"""Regions of the Stanford diagram, alarms, and their intervals."""

import math

import numpy as np
import pytest
from scipy import stats

from vehest_papers.trust.integrity import HAZARDOUS, MISLEADING, NOMINAL, UNAVAILABLE, false_alarms_per_hour, integrity_of
from vehest_papers.trust.integrity_figures import stanford_figure


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
def test_each_sample_lies_in_its_region(error, level, flagged, region):
    found = integrity_of(np.array([error]), np.array([level]), np.array([flagged]), alert_limit=2.0)
    assert found.shares()[region] == 1.0
    assert sum(found.shares().values()) == 1.0


def test_samples_without_a_band_do_not_count():
    found = integrity_of(np.array([0.1, np.nan, 0.1]), np.array([1.0, 1.0, np.nan]), np.zeros(3, bool))
    assert len(found.error) == 1


def alarmed(*edges):
    """An hour at 10 Hz that is flagged from each odd edge to the next one."""
    return np.searchsorted(edges, np.arange(36_000), side="right") % 2 == 1


def test_alarms_in_a_row_are_one_and_their_intervals_poissons():
    found = false_alarms_per_hour([alarmed(10, 20, 500, 501), alarmed(0, 5)], 10.0)
    assert (found.alarms, found.hours) == (3, 2.0)
    assert stats.poisson.sf(2, found.low * 2.0) == pytest.approx(0.025)
    assert stats.poisson.cdf(3, found.high * 2.0) == pytest.approx(0.025)
    found = false_alarms_per_hour([np.zeros(54_000, bool)], 10.0)
    assert (found.low, found.high) == (0.0, pytest.approx(-math.log(0.025) / 1.5))


def test_the_diagram_has_a_panel_an_estimate():
    generator = np.random.default_rng(0)
    own = integrity_of(generator.standard_normal(500), generator.uniform(0.5, 3.0, 500), np.zeros(500, bool))
    assert len([axes for axes in stanford_figure({"a": own, "b": own, "c": own, "d": own}).axes if axes.get_visible()]) == 4
