"""Figure 7: the length of training sequences against the error, at a constant batch and at constant samples a batch."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import pandas as pd

from vehest.data.errors import DataError
from vehest.report.document import Column, Figure, Table
from vehest.report.style import DOUBLE_COLUMN, OTHER_COLOURS, legend_above, new_figure, paper_style
from vehest.studies.artefacts import PartArtefacts
from vehest.studies.kit.claims import Claim
from vehest_papers.learned_ukf.candidates import SETS, losses
from vehest_papers.learned_ukf.claims import difference_claim
from vehest_papers.learned_ukf.errors import Errors, in_words

_SUBSCRIPT_U = re.compile(r"_uh?(_|$)")
WAYS = {"batch": "constant batch", "samples": "constant samples a batch"}


@dataclass(frozen=True)
class Length:
    """Trainings on sequences of one length.

    Args:
        steps: samples of a sequence.
        batch: sequences in a batch.
        epochs: through the filter.
        errors: test set -> losses of the only candidate.
        candidate: which.
    """

    steps: int
    batch: int
    epochs: int
    errors: Mapping[str, Errors]
    candidate: str


def lengths(parts: Mapping[str, PartArtefacts]) -> list[Length]:
    """By length, then batch.

    Raises:
        DataError: a model was not trained through the filter.
    """
    found = []
    for name, part in parts.items():
        for model in part.models:
            if "steps" not in model.training or not _SUBSCRIPT_U.search(model.variant):
                raise DataError(f"part '{name}': {model.title} was not trained through the filter; set estimator.through_filter=true")
        training = part.models[0].training
        errors = {test: losses(part, test) for test in part.split.tests}
        candidate = next(iter(next(iter(errors.values())).squared))
        found.append(Length(int(training["steps"]), int(training["batch_size"]), int(training["through"]["max_epochs"]), errors, candidate))
    return sorted(found, key=lambda own: (own.steps, own.batch))


def of_way(found: Sequence[Length], way: str) -> list[Length]:
    """Those with the batch, or with the samples a batch, of the longest sequences."""
    longest = found[-1]
    if way == "batch":
        return [own for own in found if own.batch == longest.batch]
    return [own for own in found if own.steps * own.batch == longest.steps * longest.batch]


def figure_7(found: Sequence[Length], data: str) -> tuple[Figure, Table]:
    """The figure and its table, with 95 % intervals over sequences and seeds."""
    rows = []
    for way, words in WAYS.items():
        for own in of_way(found, way):
            row: dict[str, object] = {"way": words, "steps": own.steps, "batch": own.batch, "epochs": own.epochs}
            for test, errors in own.errors.items():
                mse = errors.mean(errors.squared[own.candidate])
                row |= {f"mse.{test}": mse.value, f"low.{test}": mse.low, f"high.{test}": mse.high}
                row[f"words.{test}"] = in_words(mse.value, max(mse.low, 0.0), mse.high, 4)
            rows.append(row)
    frame, tests = pd.DataFrame(rows), list(found[0].errors)
    with paper_style():
        figure = new_figure(DOUBLE_COLUMN, 2.7)
        grid = figure.subplots(1, len(tests), squeeze=False)[0]
        for axes, test in zip(grid, tests, strict=True):
            for (_, words), colour, shift in zip(WAYS.items(), OTHER_COLOURS, (0.97, 1.03), strict=False):
                part = frame[frame["way"] == words]
                ends = [part[f"mse.{test}"] - part[f"low.{test}"], part[f"high.{test}"] - part[f"mse.{test}"]]
                axes.errorbar(part["steps"] * shift, part[f"mse.{test}"], yerr=ends, color=colour, marker="o", capsize=2, label=words)
            steps = sorted(set(frame["steps"]))
            axes.set_xscale("log")
            axes.set_xticks(steps, [f"{own:g}" for own in steps])
            axes.minorticks_off()
            axes.set_title(SETS[test], loc="left")
            axes.set_xlabel("samples of a training sequence")
            axes.set_ylim(bottom=0.0)
        grid[0].set_ylabel("MSE (weighted)")
        legend_above(figure, grid[0])
    seeds = len(next(iter(found[0].errors.values())).squared[found[0].candidate])
    caption = (
        f"Length of training sequences against MSE (weighted), Figure 7 of the paper: {found[0].candidate}, {seeds} seeds, "
        f"{found[0].epochs} epochs through the filter. An epoch goes once through the drives, so a smaller batch takes more steps. "
        f"Bars: 95 % intervals over sequences and seeds. Data: {data}."
    )
    columns = {"way": Column("held constant"), "steps": Column("samples", decimals=0), "batch": Column("sequences in a batch", decimals=0)}
    columns |= {"epochs": Column("epochs", decimals=0)}
    columns |= {f"words.{test}": Column(f"MSE (weighted), {SETS[test]}") for test in tests}
    return Figure("figure_7", caption, figure), Table("sequence_length", "What Figure 7 draws.", frame, columns)


def length_claims(found: Sequence[Length], test: str, data: str) -> list[Claim]:
    """That the longest sequences have the lower error than the shortest ones, either way."""
    claims = []
    for way, words in WAYS.items():
        own = of_way(found, way)
        if len(own) < 2:
            continue
        short, long = own[0], own[-1]
        one, other = (part.errors[test].squared[part.candidate] for part in (long, short))
        change = long.errors[test].difference(one, other)
        claim = f"sequences of {long.steps} samples below {short.steps}, {words}"
        values = (float(one.mean()), float(other.mean()))
        claims.append(difference_claim(claim, "Figure 7: longer is better", change, values, f"{data}, {SETS[test]}"))
    return claims
