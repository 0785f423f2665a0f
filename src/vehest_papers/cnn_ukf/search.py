"""The small search over widths of the data-driven network, on validation alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import pandas as pd

from vehest.estimators.model_files import load_model
from vehest.estimators.sideslip_ffnn import SideslipFfnn
from vehest.report.document import Column, Table
from vehest.report.style import MISSING, fixed
from vehest_papers.cnn_ukf import paper
from vehest_papers.cnn_ukf.indicators import BALANCED, ManoeuvreErrors
from vehest_papers.cnn_ukf.subjects import Run, Runs, balanced
from vehest_papers.kit.verdict_table import figure_in_words

PREFIX = "search_"  # parts whose names begin so are points of the search, one network each


def is_point(part: str) -> bool:
    """Whether a part of the study is a point of the search."""
    return part.startswith(PREFIX)


def points_of(parts: Mapping[str, Runs], full: Runs) -> dict[tuple[int, int], Run]:
    """Widths of both layers -> its run, in order; among them the paper's widths with their lowest seed, of the full set."""
    runs = [
        own[paper.DATA][0] for name, own in parts.items() if is_point(name) and paper.DATA in own
    ]
    found = {_network(run).settings.hidden: run for run in [*runs, full[paper.DATA][0]]}
    return {widths: found[widths] for widths in sorted(found)}


def search_table(parts: Mapping[str, Runs], full: Runs, data: str) -> Table:
    """Errors on validation by widths, and how each stands to the paper's, with paired intervals over manoeuvres."""
    points = points_of(parts, full)
    given = _network(full[paper.DATA][0]).settings.hidden
    judged = {_words(widths): [replace(run, test=run.validation)] for widths, run in points.items()}
    own = ManoeuvreErrors(judged)
    rows = []
    for widths, run in points.items():
        fit = run.model.fit_metrics()
        rows.append(
            {
                "first": widths[0],
                "second": widths[1],
                "weights": _network(run).n_parameters,
                "validation": own.text(_words(widths), BALANCED),
                "ratio": MISSING
                if widths == given
                else figure_in_words(own.ratio(_words(widths), _words(given), BALANCED)),
                "best_epoch": fit.get("best_epoch", float("nan")),
            }
        )
    columns = {
        "first": Column("first layer", decimals=0),
        "second": Column("second layer", decimals=0),
        "weights": Column("weights", decimals=0),
        "validation": Column("RMSE of a validation manoeuvre [deg]"),
        "ratio": Column(f"over that of {_words(given)}"),
        "best_epoch": Column("best epoch", decimals=0),
    }
    caption = (
        f"Search over widths of the data-driven network, on validation alone, seed {points[given].model.seed}; the paper's {_words(given)} "
        f"are kept, and their seeds have {_seeds(full[paper.DATA])}°. 95 % intervals over manoeuvres alone, paired, none corrected. "
        f"Data: {data}."
    )
    return Table("search", caption, pd.DataFrame(rows), columns)


def _network(run: Run) -> SideslipFfnn:
    fitted = load_model(run.model.model_folder)
    assert isinstance(fitted, SideslipFfnn)
    return fitted


def _words(widths: tuple[int, int]) -> str:
    return f"{widths[0]} and {widths[1]}"


def _seeds(runs: Sequence[Run]) -> str:
    values = [balanced(run.validation) for run in runs]
    return f"{fixed(min(values), 3)} to {fixed(max(values), 3)}"
