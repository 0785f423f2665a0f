"""Figure 7: the length of training sequences against the error, at a constant batch and at constant
samples a batch.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import pandas as pd

from vehest.data.errors import DataError
from vehest.report.document import Figure
from vehest.report.style import DOUBLE_COLUMN, OTHER_COLOURS, listed, new_figure
from vehest.studies.artefacts import PartArtefacts
from vehest_papers.kit.block_errors import BlockErrors, Key
from vehest_papers.kit.legends import legend_above
from vehest_papers.kit.reading import lengths_of
from vehest_papers.kit.verdict_table import figure_in_words
from vehest_papers.kit.verdicts import value_of
from vehest_papers.learned_ukf.block_errors import candidate_name
from vehest_papers.learned_ukf.candidates import SETS, models_by_candidate

_SUBSCRIPT_U = re.compile(r"_uh?(_|$)")
WAYS = {"batch": "constant batch", "samples": "constant samples a batch"}


@dataclass(frozen=True)
class Length:
    """Trainings on sequences of one length."""

    part: str  # of the pipeline
    candidate: str
    n_seeds: int
    steps: int  # samples of a sequence
    batch: int  # sequences in a batch
    epochs: int  # through the filter
    sequences: int  # that an epoch goes through

    @property
    def batches(self) -> int:
        """Of an epoch."""
        return math.ceil(self.sequences / self.batch)


def lengths(parts: Mapping[str, PartArtefacts]) -> list[Length]:
    """Trainings by length, then batch.

    Raises
    ------
    DataError
        A model was not trained through the filter.
    """
    trained = []
    for name, part in parts.items():
        for model in part.models:
            if "steps" not in model.training or not _SUBSCRIPT_U.search(model.variant):
                raise DataError(
                    f"part '{name}': {model.title} was not trained through the filter; set "
                    "estimator.through_filter=true"
                )
        training = part.models[0].training
        steps = int(training["steps"])
        batch = int(training["batch_size"])
        candidate = next(iter(models_by_candidate(part)))
        sequences = sum(length // steps for length in lengths_of(part, part.split.train))
        trained.append(
            Length(
                name,
                candidate,
                len(part.models),
                steps,
                batch,
                int(training["through"]["max_epochs"]),
                sequences,
            )
        )
    return sorted(trained, key=lambda entry: (entry.steps, entry.batch))


def of_way(trained: Sequence[Length], way: str) -> list[Length]:
    """Those with the batch, or with the samples a batch, of the longest sequences."""
    longest = trained[-1]
    if way == "batch":
        return [length for length in trained if length.batch == longest.batch]
    return [
        length for length in trained if length.steps * length.batch == longest.steps * longest.batch
    ]


def figure_7(
    trained: Sequence[Length], blocks: Mapping[Key, BlockErrors], data: str
) -> tuple[Figure, pd.DataFrame]:
    """The figure and its table, with 95 % intervals over sequences and seeds."""
    rows = []
    for way, words in WAYS.items():
        for length in of_way(trained, way):
            row: dict[str, object] = {
                "way": words,
                "steps": length.steps,
                "batch": length.batch,
                "epochs": length.epochs,
            }
            row |= {
                "epoch_samples": length.sequences * length.steps,
                "batches": length.batches,
                "in_a_row": length.batches * length.steps,
            }
            name = candidate_name(length.part, length.candidate)
            for test in SETS:
                _, mse = value_of(
                    blocks[Key(length.part, name, test, "mse_weighted")], "mse_weighted"
                )
                row |= {f"mse.{test}": mse.value, f"low.{test}": mse.low, f"high.{test}": mse.high}
                row[f"words.{test}"] = figure_in_words(mse)
            rows.append(row)
    frame = pd.DataFrame(rows)
    tests = list(SETS)
    with new_figure(DOUBLE_COLUMN, 2.7) as figure:
        grid = figure.subplots(1, len(tests), squeeze=False)[0]
        for axes, test in zip(grid, tests, strict=True):
            for (_, words), colour, shift in zip(
                WAYS.items(), OTHER_COLOURS, (0.97, 1.03), strict=False
            ):
                part = frame[frame["way"] == words]
                ends = [
                    part[f"mse.{test}"] - part[f"low.{test}"],
                    part[f"high.{test}"] - part[f"mse.{test}"],
                ]
                axes.errorbar(
                    part["steps"] * shift,
                    part[f"mse.{test}"],
                    yerr=ends,
                    color=colour,
                    marker="o",
                    capsize=2,
                    label=words,
                )
            steps = sorted(set(frame["steps"]))
            axes.set_xscale("log")
            axes.set_xticks(steps, [f"{length:g}" for length in steps])
            axes.minorticks_off()
            axes.set_title(SETS[test], loc="left")
            axes.set_xlabel("samples of a training sequence")
            axes.set_yscale("log")
        grid[0].set_ylabel("MSE (weighted)")
        legend_above(figure, grid[0])
    seeds = listed([str(number) for number in sorted({length.n_seeds for length in trained})])
    caption = (
        "Length of training sequences against MSE (weighted), Figure 7 of the paper: "
        f"{trained[0].candidate}, {seeds} seeds, {trained[0].epochs} epochs "
        "through the filter. An epoch goes once through the drives, so a smaller batch "
        f"takes more steps. Bars: 95 % intervals over sequences and seeds. Data: {data}."
    )
    return Figure("figure_7", caption, figure), frame
