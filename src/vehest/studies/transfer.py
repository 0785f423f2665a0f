"""The study of several vehicles, each tested by estimators that were trained on others.

A part of the pipeline is a vehicle, or a test of its own. Vehicles are too few for an interval over
vehicles, so that each test is listed by itself.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from vehest.evaluation.ranking import BASELINES, Name, Ranking
from vehest.report.document import (
    PATENT_NOTE,
    REPORT,
    Block,
    Column,
    Document,
    Figure,
    Table,
    as_code,
    as_text,
)
from vehest.report.style import (
    DOUBLE_COLUMN,
    MISSING,
    MatplotlibFigure,
    decimals_for,
    fixed,
    lines_of,
    new_figure,
)
from vehest.report.template import fill_template
from vehest.studies.artefacts import PartArtefacts, StudyArtefacts
from vehest.studies.drive import data_of_parts
from vehest.studies.kit.runs import titles_of
from vehest.studies.kit.standing import figure_of, ranking_of, standing_columns

VERSION = "4"  # raised where tables or figures change
TEMPLATE = Path(__file__).with_name("transfer.md.j2")  # file of the report's template
TAKES = "parts"  # data that pipelines of this study name (`vehest.studies.registry`)
SHOWS_FAILED = True  # the report leaves out what failed, and says so (`registry`)
MAX_PANEL_COLUMNS = 4  # panels side by side at most; further ones begin a row
TITLE_WIDTH = 24  # characters of a line of a panel's title
ROW_HEIGHT = 0.16  # height of an estimator's row, in
REFERENCES = ("zero", "static_map", "kinematic", "data_sheet")
"""Baselines, in the order in which tables list them first."""
# caption of a figure, with places
FIGURE_CAPTION = (
    "RMSE(β) over that of the zero-sideslip baseline (zero), with 95 % intervals: left of 1, an "
    "estimator is better than it. The vertical line in each row is the static map, whose two "
    "numbers are fitted on the same ranges."
)
# caption of the overview
OVERVIEW_CAPTION = (
    "Number of tests on which an estimator is significantly better than each baseline, and its "
    "RMSE(β) over that of zero: median and highest over tests."
)
# caption of the table of errors
ERRORS_CAPTION = (
    "RMSE(β) [deg] over all seeds. * significantly better than zero and the static map, corrected "
    "by Holm within the test. – lacks a channel, failed or has no finite error."
)


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """The report: answer, errors as a figure, a summary by estimator and the errors of every test.

    Parameters
    ----------
    artefacts : StudyArtefacts
        A part is a vehicle or a test of its own.

    Returns
    -------
    dict
        One document, named REPORT, with leaderboards of the parts as data.

    Raises
    ------
    DataError
        An estimate is damaged, or fits no range of the test.
    """
    parts = artefacts.parts
    rankings = {
        (name, test_set): ranking_of(part, test_set)
        for name, part in parts.items()
        for test_set in part.split.tests
    }
    board = standings(parts, rankings)
    summary = _summary(board)
    placed: list[Block] = [
        Figure("transfer", FIGURE_CAPTION, _drawn(board)),
        Table("overview", OVERVIEW_CAPTION, summary, SUMMARY_COLUMNS),
        _errors(board),
    ]
    values = _values(artefacts, board, summary)
    blocks: list[Block] = fill_template(TEMPLATE, values, placed)
    if (board["estimator"] == "ksnn").any():
        blocks.append(PATENT_NOTE)
    data = {
        "tests": _tests(parts, rankings),
        **{f"leaderboard_{name}": board[board["part"] == name] for name in parts},
        **data_of_parts(parts),
    }
    return {REPORT: Document(artefacts.title, blocks, data)}


def _values(
    artefacts: StudyArtefacts, board: pd.DataFrame, summary: pd.DataFrame
) -> dict[str, object]:
    """Values that the template of the report is filled with, by name."""
    parts = artefacts.parts
    places = board[["part", "test_set"]].drop_duplicates()
    kinds = [
        parts[part].kinds_of(parts[part].split.tests[test]) for part, test in places.to_numpy()
    ]
    candidates = summary[~summary["name"].isin(BASELINES)]
    everywhere = candidates[candidates["beats_both"] == len(places)]
    best = int(candidates["beats_both"].max()) if len(candidates) else 0
    beaten = board[_beats_both(board)]
    missing = [as_text(title) for name, title in artefacts.titles.items() if name not in parts]
    return {
        "about": artefacts.about.strip(),
        "everywhere": list(everywhere["estimator"]),
        "n_best": best,
        "best": list(candidates.loc[candidates["beats_both"] == best, "estimator"]) if best else [],
        "n_tests": len(places),
        "n_tests_beaten": len(beaten[["part", "test_set"]].drop_duplicates()),
        "n_parts": len(parts),
        "n_real": kinds.count("real"),
        "n_estimators": len(candidates),
        "n_models": sum(len(part.models) for part in parts.values()),
        "missing": missing,
        "left_out": [
            {"name": as_code(name), "part": as_text(part.title), "reason": as_text(reason)}
            for part in parts.values()
            for name, reason in part.failed.items()
        ],
        "command": as_code(artefacts.command),
        "link": {name: f"tables/leaderboard_{name}.csv" for name in parts},
        "titles": {name: as_text(parts[name].title) for name in parts},
    }


def _beats_both(board: pd.DataFrame) -> pd.Series:
    """Mask of the rows of a leaderboard that are significantly better than both baselines, zero
    lateral velocity and the map of speed and yaw rate.
    """
    return (board["beats_zero"] == "yes") & (board["beats_static_map"] == "yes")


# column of `_summary` -> column of the table in the report
SUMMARY_COLUMNS = {
    "estimator": Column("estimator"),
    "tests": Column("tests", decimals=0),
    "beats_both": Column("better than both", decimals=0),
    "beats_zero": Column("better than zero", decimals=0),
    "beats_static_map": Column("better than static map", decimals=0),
    "median_ratio": Column("RMSE(β) / zero, median", decimals=2),
    "max_ratio": Column("highest", decimals=2),
}


def _summary(board: pd.DataFrame) -> pd.DataFrame:
    """Summary with a row for each estimator: number of tests with a finite error, on how many of
    them it is significantly better than the baselines, and its RMSE(β) over that of zero.
    """
    zero = board[board["estimator"] == "zero"].set_index(["part", "test_set"])["rmse_sideslip"]
    places = pd.MultiIndex.from_frame(board[["part", "test_set"]])
    ratio = board["rmse_sideslip"] / zero.reindex(places).to_numpy()
    rows = []
    for title, group in board.assign(ratio=ratio).groupby("estimator_title", sort=False):
        tested = group[np.isfinite(group["rmse_sideslip"])]
        is_baseline = group["estimator"].iloc[0] in BASELINES
        counts = {
            "beats_both": int(_beats_both(tested).sum()),
            "beats_zero": int((tested["beats_zero"] == "yes").sum()),
            "beats_static_map": int((tested["beats_static_map"] == "yes").sum()),
        }
        row = {
            "estimator": title,
            "name": group["estimator"].iloc[0],
            "tests": len(tested),
            **(dict.fromkeys(counts, math.nan) if is_baseline else counts),
            "median_ratio": tested["ratio"].median(),
            "max_ratio": tested["ratio"].max(),
        }
        rows.append(row)
    return pd.DataFrame(rows)


def _errors(board: pd.DataFrame) -> Table:
    """Table of RMSE(β) [deg], with a row for each test and a column for each estimator."""
    titles = list(dict.fromkeys(board["estimator_title"]))
    columns = {"test": Column("test")}
    columns |= {f"estimator_{position}": Column(title) for position, title in enumerate(titles)}
    rows = []
    for _, group in board.groupby(["part", "test_set"], sort=False):
        records = group.drop_duplicates("estimator_title").to_dict("records")
        cells = {row["estimator_title"]: _cell(row) for row in records}
        row = {"test": _place(records[0], board)}
        row |= {
            f"estimator_{position}": cells.get(title, MISSING)
            for position, title in enumerate(titles)
        }
        rows.append(row)
    return Table("errors", ERRORS_CAPTION, pd.DataFrame(rows), columns)


def _tests(
    parts: Mapping[str, PartArtefacts], rankings: Mapping[tuple[str, str], Ranking]
) -> pd.DataFrame:
    """Table with a row for each test: its data, the estimator with the lowest error, those that are
    not significantly worse, and the blocks of the comparison.
    """
    rows = []
    for (name, test_set), ranking in rankings.items():
        part = parts[name]
        titles = titles_of(part.models)
        best = ranking.order[0] if ranking.order else None
        row = {
            "part": name,
            "test_set": test_set,
            "test_data": part.kinds_of(part.split.tests[test_set]),
            "training_data": part.kinds_of(part.split.train),
            "best": titles[best] if best else MISSING,
            "rmse_sideslip": figure_of(ranking, best) if best else MISSING,
            "not_significantly_worse": "; ".join(titles[name] for name in ranking.tied_with_best),
            "blocks": ranking.n_blocks,
            "block_seconds": ranking.block_seconds,
            "effective_blocks": ranking.effective_blocks,
        }
        rows.append(row)
    return pd.DataFrame(rows)


def standings(
    parts: Mapping[str, PartArtefacts], rankings: Mapping[tuple[str, str], Ranking]
) -> pd.DataFrame:
    """One row an estimator, part and test set, baselines first: RMSE(β) over all seeds with its
    interval [deg], and what it beats.

    Parameters
    ----------
    parts : mapping
        Part -> its comparison.
    rankings : mapping
        (part, test set) -> ranking of its candidates.

    Returns
    -------
    pd.DataFrame
        A candidate without a finite error has NaN there. ``rmse_sideslip_best_lever`` [deg] and
        ``lever_arm`` [m] are those of the lever arm that fits each model best, where the point of
        the reference is not known.
    """
    no_rank: dict[str, Any] = dict.fromkeys(("rmse_sideslip_low", "rmse_sideslip_high"), math.nan)
    no_rank |= dict.fromkeys(
        (*(f"beats_{baseline}" for baseline in BASELINES), "against_best"), MISSING
    )
    rows = []
    for (part, test_set), ranking in rankings.items():
        titles = titles_of(parts[part].models)
        order = [name for baseline in REFERENCES for name in titles if name[0] == baseline]
        order += [name for name in ranking.order if name not in order] + [
            name for name in titles if name not in ranking.order
        ]
        for name in dict.fromkeys(order):
            row: dict[str, Any] = {
                "part": part,
                "title": as_text(parts[part].title),
                "test_set": test_set,
                "estimator": name[0],
                "variant": name[1],
                "estimator_title": titles[name],
                "rmse_sideslip": ranking.rmse.get(name, math.nan),
                **(standing_columns(ranking, name) if name in ranking.rmse else no_rank),
                **_with_best_lever(parts[part], name, test_set),
            }
            rows.append(row)
    return pd.DataFrame(rows)


def _with_best_lever(part: PartArtefacts, name: Name, test_set: str) -> dict[str, float]:
    """Root mean square over seeds of RMSE(β) with the best lever arm [deg], and the arms' mean [m].

    NaN where the point is known.
    """
    metrics = part.metrics
    rows = metrics[
        (metrics["condition"] == "best_lever_arm")
        & (metrics["test_set"] == test_set)
        & (metrics["subset"] == "all")
    ]
    rows = rows[(rows["estimator"] == name[0]) & (rows["variant"].fillna("") == name[1])]
    errors, arms = (
        rows.loc[rows["metric"] == metric, "value"].to_numpy(dtype=float)
        for metric in ("rmse_sideslip", "lever_arm")
    )
    if not len(errors):
        return {"rmse_sideslip_best_lever": math.nan, "lever_arm": math.nan}
    return {
        "rmse_sideslip_best_lever": float(np.sqrt(np.mean(np.square(errors)))),
        "lever_arm": float(np.mean(arms)),
    }


def _place(row: Mapping[Any, Any], board: pd.DataFrame) -> str:
    """Name of a test in tables: title of the part, and the test set where the part has several."""
    several = board[board["part"] == row["part"]]["test_set"].nunique() > 1
    return f"{row['title']}, {row['test_set']}" if several else str(row["title"])


def _cell(row: Mapping[Any, Any]) -> str:
    """An error [deg] as a cell, with a star where it is significantly better than both
    baselines.
    """
    error = row["rmse_sideslip"]
    if not math.isfinite(error):
        return MISSING
    mark = " *" if row["beats_zero"] == row["beats_static_map"] == "yes" else ""
    return f"{fixed(error, decimals_for([error]))}{mark}"


def _drawn(board: pd.DataFrame) -> MatplotlibFigure:
    """Draw a panel for each test with a row for each estimator: RMSE(β) over that of zero with its
    interval, and the static map as a vertical line.
    """
    places = list(dict.fromkeys(zip(board["part"], board["test_set"], strict=True)))
    names = list(
        dict.fromkeys(
            zip(board["estimator"], board["variant"], board["estimator_title"], strict=True)
        )
    )
    names = [name for name in names if name[0] != "zero"]
    lines = lines_of([name[:2] for name in names])
    columns = min(MAX_PANEL_COLUMNS, len(places))
    rows = -(-len(places) // columns)
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    with new_figure(DOUBLE_COLUMN, rows * (0.75 + ROW_HEIGHT * len(names))) as figure:
        grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for axes in grid.flat[len(places) :]:
            axes.set_visible(False)
        for axes, (part, test_set) in zip(grid.flat, places, strict=False):
            rows_of_test = board[
                (board["part"] == part) & (board["test_set"] == test_set)
            ].set_index(["estimator", "variant"])
            zero = _first(rows_of_test, "zero")
            for height, name in enumerate(names):
                if name[:2] not in rows_of_test.index or not math.isfinite(
                    rows_of_test.loc[name[:2], "rmse_sideslip"]
                ):
                    continue
                value, low, high = (
                    float(rows_of_test.loc[name[:2], f"rmse_sideslip{end}"]) / zero
                    for end in ("", "_low", "_high")
                )
                colour = lines[name[:2]].colour
                if math.isfinite(low):
                    axes.plot(
                        [low, high],
                        [height, height],
                        color=colour,
                        linewidth=1.4,
                        solid_capstyle="butt",
                    )
                axes.plot(value, height, marker="o", color=colour, markersize=3.0)
            axes.axvline(1.0, color="black", linewidth=0.7, label="zero-sideslip baseline")
            static = _first(rows_of_test, "static_map") / zero
            if math.isfinite(static):
                axes.axvline(
                    static,
                    color="#999999",
                    linewidth=0.7,
                    linestyle=(0, (3, 2)),
                    label="static map",
                )
            title = str(rows_of_test["title"].iloc[0])
            several = board[board["part"] == part]["test_set"].nunique() > 1
            lines_of_title = [
                *textwrap.wrap(title, TITLE_WIDTH),
                *([test_set.replace("_", " ")] if several else []),
            ]
            axes.set_title("\n".join(lines_of_title), fontsize=6.5, loc="left")
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.xaxis.set_minor_formatter(NullFormatter())
        for axes in grid[:, 0]:
            axes.set_yticks(range(len(names)), [name[2] for name in names])
            axes.set_ylim(len(names) - 0.5, -0.5)
        figure.supxlabel("RMSE(β) over that of the zero-sideslip baseline", fontsize=7.5)
        figure.legend(
            *grid[0, 0].get_legend_handles_labels(),
            loc="outside upper right",
            ncols=2,
            fontsize=6.5,
        )
    return figure


def _first(rows_of_test: pd.DataFrame, estimator: str) -> float:
    """RMSE(β) [deg] of the first row of an estimator; NaN where there is none."""
    errors = rows_of_test[rows_of_test.index.get_level_values("estimator") == estimator][
        "rmse_sideslip"
    ]
    return float(errors.iloc[0]) if len(errors) else math.nan
