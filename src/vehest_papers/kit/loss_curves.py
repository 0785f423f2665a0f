"""Losses of training and validation over the epochs of every candidate: a table of all, and one
figure.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.report.document import Figure
from vehest.report.style import DOUBLE_COLUMN, new_figure
from vehest.studies.artefacts import EvaluatedModel

NAME = "loss_curves"
LOSSES = {"train_loss": "#9aa7b5", "validation_loss": "#0b4f9c"}
COLUMNS = ("candidate", "seed", "phase", "epoch", *LOSSES)
PANELS_A_ROW = 4
TITLE_WIDTH = 30  # characters of a line of a panel's title


def loss_curves(models: Mapping[str, Sequence[EvaluatedModel]]) -> pd.DataFrame:
    """Losses of all candidates that are trained in epochs, a row an epoch of a seed.

    Parameters
    ----------
    models : mapping
        Candidate -> its seeds.

    Returns
    -------
    pandas.DataFrame
        Columns `COLUMNS`; losses as the training has them, in units of their own.
    """
    frames = []
    for candidate, seeds in models.items():
        for model in seeds:
            history = model.history()
            if history is None or not {"epoch", *LOSSES} <= set(history):
                continue
            phase = history.get("phase", 0)
            frames.append(history.assign(candidate=candidate, seed=model.seed, phase=phase))
    if not frames:
        return pd.DataFrame(columns=list(COLUMNS))
    return pd.concat(frames, ignore_index=True)[list(COLUMNS)]


def loss_figure(losses: pd.DataFrame, caption: str) -> Figure:
    """Losses of each candidate's first seed over the epochs of its longest phase, the last of
    equally long ones, a panel a candidate.

    Every curve is scaled to its own range, since losses have different units and may be negative.
    """
    candidates = list(dict.fromkeys(losses["candidate"]))
    rows = max(-(-len(candidates) // PANELS_A_ROW), 1)
    with new_figure(DOUBLE_COLUMN, 0.3 + 1.25 * rows) as figure:
        panels = figure.subplots(rows, PANELS_A_ROW, squeeze=False)
        for axes in panels.flat[len(candidates) :]:
            axes.set_axis_off()
        for axes, candidate in zip(panels.flat, candidates, strict=False):
            curve = losses[losses["candidate"] == candidate]
            curve = curve[curve["seed"] == curve["seed"].iloc[0]]
            n_epochs = curve.groupby("phase")["epoch"].transform("size")
            curve = curve[curve["phase"] == curve.loc[n_epochs == n_epochs.max(), "phase"].iloc[-1]]
            for name, colour in LOSSES.items():
                label = name.removesuffix("_loss")
                losses_of_epochs = curve[name].to_numpy(np.float64)
                validated = np.isfinite(losses_of_epochs)  # not after every epoch
                epochs = 1 + np.flatnonzero(validated)
                scaled = _scaled(losses_of_epochs[validated])
                axes.plot(epochs, scaled, color=colour, label=label)
            axes.set_title(textwrap.fill(candidate, TITLE_WIDTH), fontsize=6.0)
            axes.set_yticks([0.0, 1.0])
        panels[0, 0].legend(loc="upper right")
        panels[-1, 0].set_xlabel("epoch")
    return Figure(NAME, caption, figure)


def _scaled(values: FloatArray) -> FloatArray:
    """Values mapped to 0 … 1 by their extremes."""
    if not len(values) or np.ptp(values) == 0.0:
        return np.zeros_like(values)
    return np.asarray((values - values.min()) / np.ptp(values))
