"""Figure 3 of Da Lio et al. 2023: which local models of a trained KS-NN work at which yaw rate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vehest.data.errors import ConfigurationError
from vehest.data.recording import Recording
from vehest.estimators.ksnn import Ksnn
from vehest.report.document import Block, Figure
from vehest.report.style import DOUBLE_COLUMN, fixed, listed, new_figure
from vehest_papers.ksnn.linear_system import LocalModels
from vehest_papers.ksnn.subjects import Trained, kinds_of

LOCAL_COLOURS = (
    "#0b4f9c",
    "#b8480b",
    "#00876c",
    "#8e24aa",
    "#a6761d",
    "#d6336c",
    "#5b8c00",
    "#17a2b8",
)
LOCAL_DASHES = ("solid", "dashed", "dashdot", "dotted")
BEYOND = 1.12  # the axis ends so far beyond the last centre, where the last model stays alone
BINS = 40


def activation(own: Trained, recordings: Sequence[Recording] = ()) -> list[Block]:
    """Activation functions of a trained network over |ω|, and how much of the drives lies where.

    Args:
        recordings: drives whose |ω| is counted; none if empty.

    Raises:
        ConfigurationError: it is no KS-NN.
    """
    if not isinstance(own.estimator, Ksnn):
        raise ConfigurationError(f"'{own.estimator.name}' has no local models; give a 'ksnn'")
    models = LocalModels.of(own.estimator)
    size = (
        np.abs(np.concatenate([recording["yaw_rate"] for recording in recordings]))
        if recordings
        else np.zeros(0)
    )
    end = BEYOND * float(own.estimator.weights()["yaw_rate_max"])
    grid = np.union1d(np.linspace(0.0, end, 400), models.centres)
    weights = models.activations(grid)
    with new_figure(DOUBLE_COLUMN * 0.75, 2.4) as figure:
        axes = figure.add_subplot()
        if len(size):
            counts, edges = np.histogram(np.minimum(size, end), np.linspace(0.0, end, BINS + 1))
            axes.stairs(
                counts / counts.max(),
                edges,
                fill=True,
                color="#d9d9d9",
                label="$|\\omega|$ of the drives, share",
                zorder=1,
            )
        for position, column in enumerate(weights.T):
            colour = LOCAL_COLOURS[position % len(LOCAL_COLOURS)]
            dash = LOCAL_DASHES[position % len(LOCAL_DASHES)]
            axes.plot(
                grid,
                column,
                color=colour,
                linestyle=dash,
                linewidth=1.5,
                label=f"$\\phi_{{{position + 1}}}$",
                zorder=3,
            )
            axes.plot(
                models.centres[position],
                1.0,
                color=colour,
                marker="o",
                markersize=4.0,
                zorder=4,
                clip_on=False,
            )
        axes.set_xlim(0.0, end)
        axes.set_ylim(0.0, 1.05)
        axes.set_xlabel("$|\\omega|$ [rad/s]")
        axes.set_ylabel("activation $\\phi_p$")
        figure.legend(
            *axes.get_legend_handles_labels(),
            loc="outside upper left",
            ncols=len(models.centres) + 1,
            columnspacing=1.4,
        )
    centres = listed([fixed(centre, 3) for centre in models.centres.tolist()])
    caption = f"Activation functions of the local models, Figure 3 of the paper: {own.described}. Centres at |ω| = {centres} rad/s."
    if len(size):
        phi = models.activations(size).mean(axis=0)
        shares = listed([f"{100 * share:.0f} %" for share in phi.tolist()])
        caption += f" Grey: yaw rates of {len(recordings)} {kinds_of(recordings)} drives; on average over them the models weigh {shares}."
    return [Figure("activation", caption, figure)]
