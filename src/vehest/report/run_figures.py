"""Figures of a single run, small enough to be kept with each one in the tracking store."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.report.figures import Learning, Traces, learning_curves, traces_figure
from vehest.report.style import REFERENCE, line_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def fit_figure(label: str, estimator: str, variant: str, history: pd.DataFrame) -> Figure | None:
    """Loss over the epochs; none where a fit has no epochs."""
    if not {"epoch", "train_loss", "validation_loss"} <= set(history.columns) or history.empty:
        return None
    columns = (history[name].to_numpy(np.float64) for name in ("epoch", "train_loss", "validation_loss"))
    return learning_curves([Learning(label, line_of(estimator, variant), *columns)], "loss [m²/s²]")


def trace_figure(
    label: str,
    estimator: str,
    variant: str,
    time: FloatArray,
    measured: tuple[FloatArray, FloatArray],
    estimated: tuple[FloatArray, FloatArray],
) -> Figure:
    """Measured and estimated lateral velocity [m/s] and sideslip [rad], (K,) each, over the scored times, (K,) [s], of a test range."""
    reference = Traces("measured", REFERENCE, measured[0], np.degrees(measured[1]))
    own = Traces(label, line_of(estimator, variant), estimated[0], np.degrees(estimated[1]))
    return traces_figure(time, reference, [own], "time [s]")
