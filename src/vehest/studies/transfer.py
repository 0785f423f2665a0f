"""The study of several vehicles, each tested by estimators that have learnt on others: which family
carries over from which cars to which.

A part of the pipeline is a vehicle, or a test of its own. Each is shown by itself: so few vehicles
carry no interval over vehicles.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping
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
    as_text,
)
from vehest.report.style import (
    DOUBLE_COLUMN,
    MISSING,
    MatplotlibFigure,
    decimals_for,
    fixed,
    lines_of,
    listed,
    new_figure,
)
from vehest.studies.artefacts import PartArtefacts, StudyArtefacts
from vehest.studies.drive import appendix_of, budget_sentence, data_sentence
from vehest.studies.kit.runs import titles_of
from vehest.studies.kit.standing import (
    interval_in_words,
    ranking_of,
    standing_columns,
    verdict_sentences,
)
from vehest.studies.kit.warnings import warnings_of

VERSION = "3"
TAKES = "parts"
SHOWS_FAILED = True
MAX_PANEL_COLUMNS = 4
TITLE_WIDTH = 24
ROW_HEIGHT = 0.16  # in, height of an estimator
REFERENCES = (
    "zero",
    "static_map",
    "kinematic",
    "data_sheet",
)  # baselines, in the order in which tables show them first


def documents(artefacts: StudyArtefacts) -> dict[str, Document]:
    """Report: errors as a figure, what carried over, a table estimator x vehicle, each vehicle, how
    it was made.

    Raises `DataError`.
    """
    parts = artefacts.parts
    rankings = {
        (name, test_set): ranking_of(part, test_set)
        for name, part in parts.items()
        for test_set in part.split.tests
    }
    board = overview(parts, rankings)
    caption = (
        "RMSE(β) over that of the zero-sideslip baseline (zero), with 95 % intervals: left of 1, "
        "an estimator is better than it. The "
        "vertical line in each row is the static map, whose two numbers are fitted on the same "
        "ranges."
    )
    blocks: list[Block] = [
        Figure("transfer", caption, _drawn(board)),
        *([artefacts.about] if artefacts.about.strip() else []),
    ]
    missing = [as_text(title) for name, title in artefacts.titles.items() if name not in parts]
    blocks.append(
        carried_over(board)
        + (
            f"\n\nNot here, since nothing could be trained or scored: {listed(missing)}."
            if missing
            else ""
        )
    )
    blocks.append(_matrix(board))
    for name, part in parts.items():
        blocks += _part(name, part, board[board["part"] == name], rankings)
    blocks += [block for name, part in parts.items() for block in appendix_of(name, part)]
    if (board["estimator"] == "ksnn").any():
        blocks.append(PATENT_NOTE)
    return {REPORT: Document(artefacts.title, blocks)}


def overview(
    parts: Mapping[str, PartArtefacts], rankings: Mapping[tuple[str, str], Ranking]
) -> pd.DataFrame:
    """One row an estimator, part and test set, baselines first: RMSE(β) over all seeds with its
    interval [deg], and what it beats.
    """
    nothing: dict[str, Any] = dict.fromkeys(("rmse_sideslip_low", "rmse_sideslip_high"), math.nan)
    nothing |= dict.fromkeys(
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
                **(standing_columns(ranking, name) if name in ranking.rmse else nothing),
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


def carried_over(board: pd.DataFrame) -> str:
    """Sentences: on which vehicles an estimator is significantly better than zero and the static
    map.
    """
    places = list(dict.fromkeys(zip(board["part"], board["test_set"], strict=True)))
    tested = board[~board["estimator"].isin(BASELINES)]
    beaten = tested[(tested["beats_zero"] == "yes") & (tested["beats_static_map"] == "yes")]
    lines = []
    everywhere = []
    for title, rows in tested.groupby("estimator_title", sort=False):
        names = beaten[beaten["estimator_title"] == title]
        places_beaten = [_place(row, board) for row in names.to_dict("records")]
        if len(names) == len(rows) == len(places):
            everywhere.append(str(title))
        lines.append(
            f"- {title}: {len(names)} of "
            f"{len(rows)}{f' ({listed(places_beaten)})' if places_beaten else ''}"
        )
    if everywhere:
        first = (
            f"On every one of {len(places)} tests {listed(everywhere)} are significantly better "
            "than zero and the static map."
        )
    else:
        first = (
            "**No estimator is significantly better than both zero and the static map on each "
            f"of the {len(places)} tests.**"
        )
    return (
        f"{first} Vehicles are few, so nothing here is an interval over vehicles. Tests on which "
        "both are beaten significantly:\n\n" + "\n".join(lines)
    )


def _place(row: Mapping[Any, Any], board: pd.DataFrame) -> str:
    several = board[board["part"] == row["part"]]["test_set"].nunique() > 1
    return f"{row['title']}, {row['test_set']}" if several else str(row["title"])


def _matrix(board: pd.DataFrame) -> Table:
    rows: dict[str, dict[str, Any]] = {
        title: {"estimator": title} for title in board["estimator_title"]
    }
    columns = {"estimator": Column("estimator")}
    for place, (_, rows_of_test) in enumerate(board.groupby(["part", "test_set"], sort=False)):
        rows_by_title = rows_of_test.drop_duplicates("estimator_title").to_dict("records")
        cells = {row["estimator_title"]: _cell(row) for row in rows_by_title}
        columns[f"place_{place}"] = Column(_place(rows_by_title[0], board))
        for title, row in rows.items():
            row[f"place_{place}"] = cells.get(title, MISSING)
    caption = (
        "RMSE(β) [deg] over all seeds, with its 95 % interval over blocks of the drives and seeds. "
        "* significantly better than zero and the "
        "static map, corrected by Holm within the test. – lacks a channel, failed or has no finite "
        "error. Inputs may differ from "
        "vehicle to vehicle under one name; they are listed in the pipeline's file."
    )
    return Table("overview", caption, pd.DataFrame(list(rows.values())), columns)


def _cell(row: Mapping[Any, Any]) -> str:
    if not math.isfinite(row["rmse_sideslip"]):
        return MISSING
    decimals = decimals_for([row["rmse_sideslip"]])
    mark = " *" if row["beats_zero"] == row["beats_static_map"] == "yes" else ""
    low = row["rmse_sideslip_low"]
    high = row["rmse_sideslip_high"]
    interval = f" [{fixed(low, decimals)}, {fixed(high, decimals)}]" if math.isfinite(low) else ""
    return f"{fixed(row['rmse_sideslip'], decimals)}{interval}{mark}"


def _drawn(board: pd.DataFrame) -> MatplotlibFigure:
    """A panel a test, a row an estimator: RMSE(β) over that of zero with its interval, and the
    static map as a vertical line.
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
            nothing = _first(rows_of_test, "zero")
            for height, name in enumerate(names):
                if name[:2] not in rows_of_test.index or not math.isfinite(
                    rows_of_test.loc[name[:2], "rmse_sideslip"]
                ):
                    continue
                value, low, high = (
                    float(rows_of_test.loc[name[:2], f"rmse_sideslip{end}"]) / nothing
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
            axes.axvline(1.0, color="black", linewidth=0.7)
            static = _first(rows_of_test, "static_map") / nothing
            if math.isfinite(static):
                axes.axvline(static, color="#999999", linewidth=0.7, linestyle=(0, (3, 2)))
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
    return figure


def _first(rows_of_test: pd.DataFrame, estimator: str) -> float:
    errors = rows_of_test[rows_of_test.index.get_level_values("estimator") == estimator][
        "rmse_sideslip"
    ]
    return float(errors.iloc[0]) if len(errors) else math.nan


def _part(
    name: str, part: PartArtefacts, board: pd.DataFrame, rankings: Mapping[tuple[str, str], Ranking]
) -> list[Block]:
    titles = titles_of(part.models)
    blocks: list[Block] = [f"## {as_text(part.title)}", data_sentence(part)]
    for test_set in part.split.tests:
        kinds = part.kinds_of(part.split.tests[test_set])
        blocks.append(
            verdict_sentences(rankings[name, test_set], titles, f"test set `{test_set}` ({kinds})")
        )
    warned = warnings_of(part)
    if warned:
        blocks.append("**Notes:**\n\n" + "\n".join(f"- {line}" for line in warned))
    blocks.append(budget_sentence(part))
    decimals = decimals_for(board["rmse_sideslip"].tolist())
    table = board.assign(
        interval=[interval_in_words(row, decimals) for row in board.to_dict("records")]
    )
    columns: dict[str, Column] = (
        {"test_set": Column("test set")} if board["test_set"].nunique() > 1 else {}
    )
    columns |= {
        "estimator_title": Column("estimator"),
        "rmse_sideslip": Column("RMSE(β) [deg]", decimals=decimals),
        "interval": Column("95 % interval [deg]"),
        "against_best": Column("difference to best [deg]"),
        "beats_zero": Column("beats zero"),
        "beats_static_map": Column("beats static map"),
    }
    caption = (
        f"{as_text(part.title)}: baselines first, then by error. Differences are paired over "
        "blocks and seeds, corrected by Holm."
    )
    if board["rmse_sideslip_best_lever"].notna().any():
        columns |= {
            "rmse_sideslip_best_lever": Column("with the best lever [deg]", decimals=decimals),
            "lever_arm": Column("lever [m]", decimals=2),
        }
        caption += (
            " Where the reference was measured is not known: the best lever arm, within 0.5 m, "
            "takes off the part of an error that is "
            "one alone; it is chosen on the test, of each estimator for itself."
        )
    return [*blocks, Table(f"leaderboard_{name}", caption, table, columns)]
