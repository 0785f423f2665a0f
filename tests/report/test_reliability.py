"""The reliability diagram: what it draws, and labels that do not cover each other."""

import numpy as np
import pytest

from vehest.report.figures import Reliability, reliability_figure, spread_heights
from vehest.report.style import line_of


def test_labels_of_a_reliability_figure_keep_order_and_distance():
    rows = [
        Reliability(
            "Zero",
            line_of("zero"),
            np.array([0.4, 0.6, 0.85, 0.9]),
            np.array([0.3, 0.5, 0.7, 0.8]),
            np.full(4, 0.97),
        ),
        Reliability(
            "Static map",
            line_of("static_map"),
            np.array([0.5, 0.7, 0.9, 0.95]),
            np.full(4, np.nan),
            np.full(4, np.nan),
        ),
    ]
    [axes] = reliability_figure((0.5, 0.68, 0.9, 0.95), rows).axes
    assert [text.get_text() for text in axes.texts] == ["Zero", "Static map"]
    assert [line.get_ydata().tolist() for line in axes.lines[1:]] == [
        row.coverage.tolist() for row in rows
    ]
    placed = spread_heights([0.99, 0.98, 0.5, 1.0], 0.05, 1.0)
    assert placed == pytest.approx([0.95, 0.9, 0.5, 1.0])
