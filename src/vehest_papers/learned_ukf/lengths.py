"""Figure 7: the length of training sequences against the error; the time of an epoch, its other half, is on the page alone."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
import pandas as pd

from vehest.data.errors import DataError
from vehest.report.document import Block, Column, Figure, Table
from vehest.report.style import OTHER_COLOURS, SINGLE_COLUMN, legend_above, new_figure, paper_style
from vehest.studies.artefacts import PartArtefacts
from vehest.studies.kit.reading import words_of_kinds
from vehest_papers.learned_ukf.candidates import SETS, runs_of

_SUBSCRIPT_U = re.compile(r"_uh?(_|$)")


def lengths(parts: Mapping[str, PartArtefacts]) -> pd.DataFrame:
    """One row a run of the parts, sorted by length: steps, batch, candidate, seed, epochs, ``mse.SET``.

    Raises:
        DataError: a model was not trained through the filter.
    """
    rows = []
    for name, part in parts.items():
        runs = runs_of(part)
        for model in part.models:
            run = runs[(runs["variant"] == model.variant) & (runs["seed"] == model.seed)].iloc[0]
            if "steps" not in model.training or not _SUBSCRIPT_U.search(model.variant):
                raise DataError(f"part '{name}': {model.title} was not trained through the filter; set estimator.through_filter=true")
            epochs = int(model.training["through"]["max_epochs"])
            row = {"steps": int(model.training["steps"]), "batch": int(model.training["batch_size"]), "candidate": run["candidate"]}
            row |= {"seed": model.seed, "epochs": epochs}
            rows.append(row | {f"mse.{test}": float(run[f"mse_weighted.{test}"]) for test in part.split.tests})
    return pd.DataFrame(rows).sort_values(["steps", "seed"], kind="stable").reset_index(drop=True)


def figure_7(parts: Mapping[str, PartArtefacts]) -> list[Block]:
    """The figure and its table."""
    first = next(iter(parts.values()))
    frame, tests = lengths(parts), list(first.split.tests)
    middle = frame.groupby("steps", as_index=False).median(numeric_only=True)
    with paper_style():
        figure = new_figure(SINGLE_COLUMN * 1.5, 2.7)
        axes = figure.add_subplot()
        for test, colour, marker in zip(tests, OTHER_COLOURS, "os", strict=False):
            axes.plot(middle["steps"], middle[f"mse.{test}"], color=colour, marker=marker, label=f"MSE, {SETS[test]}")
            axes.scatter(frame["steps"], frame[f"mse.{test}"], s=7, color=colour, linewidths=0)
        axes.set_xscale("log")
        axes.set_xticks(middle["steps"].to_numpy(), [f"{steps:g}" for steps in middle["steps"]])
        axes.minorticks_off()
        axes.set_xlabel("samples of a training sequence")
        axes.set_ylabel("MSE (weighted)")
        axes.set_ylim(bottom=0.0)
        legend_above(figure, axes)
    names = ", ".join(dict.fromkeys(frame["candidate"]))
    batches = ", ".join(f"{row['batch']:.0f} of {row['steps']:.0f}" for row in middle.to_dict("records"))
    epochs = ", ".join(f"{value}" for value in sorted(set(frame["epochs"])))
    caption = (
        f"Length of training sequences against MSE (weighted), Figure 7 of the paper without the time of an epoch: {names}, "
        f"{len(set(frame['seed']))} seed(s), {epochs} epochs through the filter, with batches of {batches} samples. An epoch goes once "
        f"through the drives. Data: {words_of_kinds(first).upper()}."
    )
    columns = {
        "steps": Column("samples", decimals=0),
        "batch": Column("sequences in a batch", decimals=0),
        "seed": Column("seed", decimals=0),
        "epochs": Column("epochs", decimals=0),
        **{f"mse.{test}": Column(f"MSE (weighted), {SETS[test]}", decimals=4) for test in tests},
    }
    order = np.argsort(middle[f"mse.{tests[0]}"].to_numpy())
    best = int(middle["steps"].iloc[int(order[0])])
    words = f"The paper: longer sequences lower the error. Here it is lowest on {SETS[tests[0]]} with {best} samples of those tried."
    return [Figure("figure_7", caption, figure), words, Table("sequence_length", "What is drawn, run by run.", frame, columns)]
