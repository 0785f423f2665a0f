"""Key performance indicators over manoeuvres: what is averaged over samples, and what over manoeuvres."""

import numpy as np
import pytest

from vehest.data.errors import DataError
from vehest.data.splits import Span
from vehest.evaluation.metrics import Scored, accuracy
from vehest_papers.cnn_ukf.manoeuvres import error_distribution, group_of, kpis, kpis_by_group, manoeuvres_of


def scored(errors_deg, ay):
    zero, error = np.zeros(len(ay)), np.radians(errors_deg)
    return Scored(np.arange(len(ay)) * 0.01, 20.0 * np.tan(error), zero, error, zero, np.array(ay))


CALM = scored([1.0, -0.5, 0.5, 0.5], [0.0, 1.0, -2.0, 3.0])
HARD = scored([0.0, -4.0, 2.0, 0.0], [0.0, -8.0, 4.0, 3.9])
SET = {"test_slalom_18_on_001": [CALM], "test_j_turn_off_002": [HARD]}


def test_squared_errors_are_means_over_samples_as_the_metrics_of_a_test_set():
    figures = accuracy([CALM, HARD])
    assert kpis(SET).mse == pytest.approx(figures["mse_sideslip"]) == pytest.approx((1.75 + 20.0) / 8)
    assert kpis(SET).mse_nonlinear == pytest.approx(figures["mse_sideslip_nonlinear"]) == pytest.approx(10.0)


def test_largest_errors_are_means_over_manoeuvres_and_not_the_largest_of_all():
    assert kpis(SET).max_error == pytest.approx(0.5 * (1.0 + 4.0))
    assert kpis(SET).max_error_nonlinear == pytest.approx(4.0)  # the calm one has no such sample
    assert np.isnan(kpis({"calm": [CALM]}).max_error_nonlinear)


def test_ranges_of_one_recording_are_one_manoeuvre():
    spans = [Span("bmw", "test_lap_off_001", 0.0, 1.0), Span("bmw", "test_lap_off_001", 2.0, 3.0)]
    together = manoeuvres_of(spans, [CALM, HARD])
    assert kpis(together).manoeuvres == 1
    assert kpis(together).max_error == pytest.approx(4.0)
    with pytest.raises(DataError, match="1 scored parts do not belong to 2 ranges"):
        manoeuvres_of(spans, [CALM])


def test_groups_are_told_by_the_names_of_recordings():
    assert group_of("test_lane_change_2_off_001") == "lane change"
    assert group_of("20140222_01") == "other"
    groups = kpis_by_group(SET | {"train_slalom_30_off_003": [HARD]})
    assert list(groups) == ["J-turn", "slalom"]
    assert groups["slalom"].manoeuvres == 2
    assert groups["slalom"].max_error == pytest.approx(2.5)


def test_distribution_counts_errors_in_bins_of_a_quarter_of_a_degree():
    found = error_distribution([scored([0.6, -0.6, 0.1, 0.7], [0.0, 5.0, -6.0, 1.0])], nonlinear_only=False)
    np.testing.assert_allclose(found.edges, [-0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75])
    np.testing.assert_array_equal(found.counts, [1, 0, 0, 1, 0, 2])
    hard = error_distribution([CALM, HARD])
    assert (hard.counts.sum(), hard.mean, hard.deviation) == (2, pytest.approx(-1.0), pytest.approx(3.0))
    with pytest.raises(DataError, match="no sample has a lateral acceleration"):
        error_distribution([CALM])
