"""Figure 4: a hard sequence on the unseen tyre, as estimated by some candidates, with what the
filters know of their friction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from vehest.constants import FloatArray
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.splits import Span
from vehest.data.store import read_recording
from vehest.evaluation.metrics import REFERENCES, sequences, weighted_errors
from vehest.report.document import Figure, as_code
from vehest.report.style import (
    DOUBLE_COLUMN,
    NONLINEAR_ORANGES,
    REFERENCE,
    Line,
    MatplotlibFigure,
    fixed,
    new_figure,
)
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest_papers.kit.legends import legend_above
from vehest_papers.learned_ukf import paper

LINES = {
    paper.NNTF_UH: Line("#0b4f9c", "solid"),
    paper.NNTF_UH_LOW: Line(NONLINEAR_ORANGES[0], "dashed"),
    paper.GRU: Line("#8e24aa", "dashdot"),
    paper.LSTM: Line("#c792dd", "dotted"),
}
AXES = {"vx": "$v_x$ [m/s]", "vy": "$v_y$ [m/s]", "yaw_rate": "yaw rate [rad/s]"}


def hardest(errors: Sequence[Sequence[FloatArray]]) -> int:
    """The sequence on which the models together err most; ``errors``: of each model its losses,
    sequence by sequence.
    """
    return int(
        np.argmax(
            [
                sum(float(of_candidate[position].mean()) for of_candidate in errors)
                for position in range(len(errors[0]))
            ]
        )
    )


def hard_sequence(
    part: PartArtefacts, models: Mapping[str, EvaluatedModel], test: str, name: str, data: str
) -> tuple[Figure, pd.DataFrame]:
    """Reference and estimates over the sequence on which the shown models together err most."""
    losses = [
        [
            weighted_errors(losses_of_candidate, np.square)
            for losses_of_candidate in part.scored(model, test)
        ]
        for model in models.values()
    ]
    position = hardest(losses)
    pieces = sequences(
        part.split.tests[test],
        lambda span: read_recording(part.references[span.dataset, span.recording]),
        part.protocol,
    )
    piece = pieces[position]
    reference = read_recording(part.references[piece.dataset, piece.recording]).cut(
        piece.start, piece.stop
    )
    estimates = {candidate: model.estimate(test, position) for candidate, model in models.items()}
    time = np.arange(len(reference)) / reference.rate_hz
    drawn = _values(reference, estimates, time)
    mse = {
        candidate: float(losses_of_candidate[position].mean())
        for candidate, losses_of_candidate in zip(models, losses, strict=True)
    }
    listed_errors = "; ".join(
        f"{candidate}, seed {model.seed}: {fixed(mse[candidate], 4)}"
        for candidate, model in models.items()
    )
    caption = (
        f"Estimates over a hard sequence of {_place_of(piece)}, Figure 4 of the paper. Of "
        f"{len(pieces)} sequences it is the one on which the candidates shown err most together. "
        f"MSE (weighted) here: {listed_errors}. Grey: not scored. Bands: one standard deviation "
        "of the friction by the filter itself; dotted: the paper's nominal friction of that tyre, "
        f"{paper.NOMINAL_FRICTION[test]:g}. Data: {data}."
    )
    return Figure(
        f"figure_4_{name}", caption, _drawn(drawn, estimates, part.protocol.skip_seconds, test)
    ), drawn


def _values(
    reference: Recording, estimates: Mapping[str, Estimate], time: FloatArray
) -> pd.DataFrame:
    columns = {"time_s": time} | {
        f"{state}.reference": reference[channel] for state, channel in REFERENCES.items()
    }
    for candidate, estimate in estimates.items():
        columns |= {
            f"{state}.{candidate}": estimate.held_at(reference.time, state) for state in REFERENCES
        }
        if "friction" in estimate.channels:
            columns[f"friction.{candidate}"] = estimate.held_at(reference.time, "friction")
            variance = estimate.covariance_at(reference.time, ("friction",))[:, 0, 0]
            columns[f"friction_sigma.{candidate}"] = np.sqrt(np.maximum(variance, 0.0))
    return pd.DataFrame(columns)


def _drawn(
    values: pd.DataFrame, candidates: Mapping[str, Estimate], skip_seconds: float, test: str
) -> MatplotlibFigure:
    with new_figure(DOUBLE_COLUMN, 6.2) as figure:
        grid = figure.subplots(4, 1, sharex=True)
        time = values["time_s"].to_numpy()
        for axes, (state, label) in zip(grid, AXES.items(), strict=False):
            axes.plot(
                time,
                values[f"{state}.reference"],
                color=REFERENCE.colour,
                linewidth=1.4,
                label="reference",
            )
            for candidate in candidates:
                line = LINES[candidate]
                axes.plot(
                    time,
                    values[f"{state}.{candidate}"],
                    color=line.colour,
                    linestyle=line.dash,
                    linewidth=1.0,
                    label=candidate,
                )
            axes.set_ylabel(label)
        bottom = grid[-1]
        for candidate in candidates:
            if f"friction.{candidate}" not in values:
                continue
            line = LINES[candidate]
            friction = values[f"friction.{candidate}"]
            sigma = values[f"friction_sigma.{candidate}"]
            bottom.fill_between(
                time, friction - sigma, friction + sigma, color=line.colour, alpha=0.2, linewidth=0
            )
            bottom.plot(time, friction, color=line.colour, linestyle=line.dash, linewidth=1.0)
        bottom.axhline(
            paper.NOMINAL_FRICTION[test], color="#444444", linewidth=0.8, linestyle="dotted"
        )
        bottom.set_ylabel("friction [1]")
        bottom.set_xlabel("time in the sequence [s]")
        for axes in grid:
            axes.axvspan(0.0, skip_seconds, color="#e8e8e8", zorder=0)
            axes.margins(x=0.0)
        figure.align_ylabels()
        legend_above(figure, grid[0], columns=4)
    return figure


def _place_of(piece: Span) -> str:
    return f"{as_code(piece.recording)}, {piece.start:.2f} to {piece.stop:.2f} s"
