"""What the command line prints of a study that is done: tables as text, and figures as JSON."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

    from vehest.run.pipeline import PipelineOutcome
    from vehest.run.sweep import SweepOutcome

BOARD_HEADER = (
    "estimator",
    "parameters",
    "seeds",
    "RMSE(β) [deg]",
    "95 % interval [deg]",
    "to the lowest [deg]",
    "beats v = 0, static map",
    "FVU",
)


@dataclass(frozen=True)
class ShownTable:
    """A table in a terminal.

    Args:
        title: line above it; none if empty.
        header: over the columns.
        rows: of cells.
    """

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Shown:
    """What is printed of a study.

    Args:
        tables: one after another.
        note: line below them; none if empty.
        page: file of the report that is named last.
        figures: the same for ``--json``, as JSON.
    """

    tables: tuple[ShownTable, ...]
    note: str
    page: str
    figures: str


def shown_of_pipeline(title: str, outcome: PipelineOutcome) -> Shown:
    """What is printed of a pipeline: its leaderboard, a table a test set, or its overview.

    Args:
        title: of the study.
        outcome: what it made.
    """
    overview = outcome.overview
    note = "\n".join(f"left out: {name}: {reason}" for name, reason in outcome.left_out.items())
    failed = {"failed": dict(outcome.left_out)} if outcome.left_out else {}
    if overview is not None:
        rows = tuple(tuple(_cell(value) for value in row) for row in overview.itertuples(index=False))
        tables = (ShownTable("", tuple(str(name) for name in overview.columns), rows),)
        return Shown(tables, note, "report.html", json.dumps({"overview": _records(overview)} | failed))
    boards = []
    for test_set, rows_of_set in outcome.leaderboard.groupby("test_set", sort=False):
        given = " (estimates start at the reference state)" if (rows_of_set["start"] == "reference").any() else ""
        board = tuple(_board_row(row) for row in rows_of_set.to_dict("records"))
        boards.append(ShownTable(f"{title}: test set '{test_set}'{given}", BOARD_HEADER, board))
    short = [
        f"test set '{test_set}' is too short to tell estimators apart: no interval, no winner"
        for test_set, rows_of_set in outcome.leaderboard.groupby("test_set", sort=False)
        if rows_of_set["rmse_sideslip_low"].isna().all()
    ]
    note = "\n".join([*short, *([note] if note else []), *outcome.verdict])
    said = {"verdict": list(outcome.verdict)} if outcome.verdict else {}
    figures = {"leaderboard": _records(outcome.leaderboard)} | said | failed
    return Shown(tuple(boards), note, "report.html", json.dumps(figures))


def shown_of_sweep(outcome: SweepOutcome) -> Shown:
    """What is printed of a sweep: a row a combination with settings, seeds, mean and half interval on validation and tests."""
    from vehest.studies.sweep import table_of

    header, rows = table_of(outcome.artefacts, outcome.summary)
    kinds = " and ".join(kind.upper() if kind == "simulated" else kind for kind in dict.fromkeys(outcome.artefacts.kinds.values()))
    title = f"{outcome.artefacts.name}: RMSE(β) [deg], mean over seeds ± half its 95 % interval (Student's t); {kinds} data"
    table = _records(outcome.summary)
    figures = {
        "chosen": next((row for row in table if row["chosen"]), None),
        "summary": table,
        "failed": [{"jobs": what, "message": reason} for what, reason in outcome.failures.items()],
    }
    note = "* lowest mean on the validation range; tests choose nothing" if outcome.summary["chosen"].any() else ""
    tables = (ShownTable(title, tuple(header), tuple(tuple(row) for row in rows)),)
    return Shown(tables, note, "report.md", json.dumps(figures))


def _records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows as JSON has them: what is not a finite number is null."""
    rows: list[dict[str, Any]] = json.loads(table.to_json(orient="records"))
    return rows


def _board_row(row: dict[Any, Any]) -> tuple[str, ...]:
    return (
        str(row["title"]),
        f"{row['n_parameters']:.0f}",
        str(row["n_seeds"]),
        f"{row['rmse_sideslip']:.3f}",
        f"{row['rmse_sideslip_low']:.3f} … {row['rmse_sideslip_high']:.3f}" if row["rmse_sideslip_low"] > 0 else "–",
        str(row["against_best"]),
        f"{row['beats_zero']}, {row['beats_static_map']}",
        f"{row['fvu']:.3f}",
    )


def _cell(value: Any) -> str:
    """A value of a table, numbers with four significant digits."""
    if isinstance(value, float):
        return f"{value:.4g}" if math.isfinite(value) else "–"
    return str(value)
