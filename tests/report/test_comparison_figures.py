"""Figures of a comparison: what they draw where, read from matplotlib's artists."""

import numpy as np
import pytest
from matplotlib.collections import PolyCollection

from vehest.estimators.registry import estimator_names
from vehest.report.comparison_figures import (
    Cloud,
    ForestRow,
    agreement_figure,
    clouds_figure,
    forest_figure,
)
from vehest.report.figures import Band, Traces, traces_figure, zoom_figure
from vehest.report.style import REFERENCE, REFERENCE_GREY, Line, line_of

TIME = np.arange(200) / 20.0
GRU = Line("#7b1fa2", "solid", "D")


def traces(label, line, size):
    return Traces(label, line, size * np.sin(TIME), 2.0 * size * np.sin(TIME))


def rows(worst):
    return [
        ForestRow("GRU", GRU, 0.19, 0.16, 0.23, is_filled=True),
        ForestRow("Zero", Line("#111111"), worst, 0.9 * worst, 1.1 * worst, is_filled=False),
    ]


def test_forest_plot_has_its_first_row_on_top_with_its_interval_and_figures():
    (axes,) = forest_figure(rows(0.67)).axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["GRU", "Zero"]
    assert axes.get_ylim()[0] > axes.get_ylim()[1]
    interval, marker = axes.lines[:2]
    assert list(interval.get_xdata()) == [0.16, 0.23]
    assert marker.get_markerfacecolor() == GRU.colour
    assert axes.lines[3].get_markerfacecolor() == "white"
    assert [text.get_text() for text in axes.texts] == ["0.19 [0.16, 0.23]", "0.67 [0.60, 0.74]"]
    assert (axes.get_xscale(), axes.get_xlim()[0]) == ("linear", 0.0)


def test_forest_plot_of_errors_that_differ_much_is_logarithmic_and_says_so():
    (axes,) = forest_figure(rows(18.0)).axes
    assert axes.get_xscale() == "log"
    assert axes.get_xlabel() == "RMSE(β) [deg], logarithmic scale"
    assert forest_figure(rows(0.67)).axes[0].get_xlabel() == "RMSE(β) [deg]"


def test_points_of_the_cloud_below_are_larger_than_those_above():
    clouds = [Cloud(name, "#111111", TIME, TIME) for name in ("measured", "GRU", "LSTM")]
    (axes,) = clouds_figure([(clouds, "x", "y", False)]).axes
    first, *smaller_sizes = (line.get_markersize() for line in axes.lines)
    assert all(first > size for size in smaller_sizes)


@pytest.mark.parametrize("name", estimator_names())
def test_no_estimator_is_drawn_in_a_grey_like_the_reference(name):
    colour = line_of(name).colour if name != "ksnn" else line_of(name, "linear_bias_p2").colour
    parts = [int(colour[start : start + 2], 16) for start in (1, 3, 5)]
    assert max(parts) - min(parts) > 40


def test_reference_lies_below_the_estimates_and_is_wider():
    reference = traces("measured", REFERENCE, 1.0)
    estimate = traces("GRU", GRU, 0.9)
    for axes in (
        *traces_figure(TIME, reference, [estimate], [0.1], "time [s]").axes,
        zoom_figure(TIME, None, reference, [estimate], "time [s]").axes[0],
    ):
        (below,) = [line for line in axes.lines if line.get_color() == REFERENCE_GREY]
        (above,) = [line for line in axes.lines if line.get_color() == GRU.colour]
        order = [(line.get_zorder(), axes.lines.index(line)) for line in (below, above)]
        assert order[0] < order[1]
        assert below.get_linewidth() > 2 * above.get_linewidth()


def test_band_covers_its_half_width_about_the_estimate_and_is_in_the_legend():
    reference = traces("measured", REFERENCE, 1.0)
    estimate = traces("GRU", GRU, 0.9)
    band = Band(estimate, np.full(len(TIME), 0.25), np.full(len(TIME), 0.5))
    figure = zoom_figure(TIME, None, reference, [estimate], "time [s]", band)
    for axes, values, half in (
        (figure.axes[0], estimate.sideslip, 0.5),
        (figure.axes[2], estimate.vy, 0.25),
    ):
        (area,) = [
            collection for collection in axes.collections if isinstance(collection, PolyCollection)
        ]
        corners = area.get_paths()[0].vertices
        at_start = corners[corners[:, 0] == TIME[50], 1]
        assert (at_start.min(), at_start.max()) == pytest.approx(
            (values[50] - half, values[50] + half)
        )
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert set(labels) == {"measured", "GRU", "90 % band of GRU"}


def test_agreement_has_a_panel_per_estimator_with_equal_limits():
    reference = 3.0 * np.sin(TIME)
    clouds = [Cloud(f"estimator {i}", GRU.colour, reference, 0.9 * reference) for i in range(5)]
    figure = agreement_figure(reference, clouds)
    drawn = [axes for axes in figure.axes if axes.axison]
    assert len(drawn) == 5
    for axes in drawn:
        assert axes.get_xlim() == axes.get_ylim()
        assert axes.get_xlim()[1] >= np.abs(reference).max()
        (equality,) = [line for line in axes.lines if line.get_color() == REFERENCE_GREY]
        assert equality.get_slope() == 1.0


def test_clouds_are_thinned_but_span_all_of_a_drive():
    x = np.arange(20_000.0)
    cloud = Cloud("test", GRU.colour, x, x)
    (axes,) = clouds_figure([([cloud], "x", "y", False)]).axes
    drawn = axes.lines[0].get_xdata()
    assert 400 < len(drawn) < 1000
    assert drawn[0] == 0.0
    assert drawn[-1] > 19_900
