"""Summary of a finished study for the terminal: tables as text, and figures as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from vehest.run.printing import TerminalTable

if TYPE_CHECKING:
    import pandas as pd

    from vehest.studies.sweep import SweepArtefacts

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
class TerminalSummary:
    """What is printed of a study.

    Args:
        tables: one after another.
        note: line below them; none if empty.
        page: file of the report that is named last.
        figures: the same for ``--json``, as JSON.
    """

    tables: tuple[TerminalTable, ...]
    note: str
    page: str
    figures: str


def summary_of_overview(overview: pd.DataFrame, left_out: Mapping[str, str]) -> TerminalSummary:
    """The overview of a study in parts, or of recordings alone.

    Args:
        overview: as the report shows it.
        left_out: name of a failed or unfinished job -> why.
    """
    rows = tuple(tuple(_cell(value) for value in row) for row in overview.itertuples(index=False))
    table = TerminalTable("", tuple(str(name) for name in overview.columns), rows)
    return TerminalSummary((table,), _note(left_out), "report.html", json.dumps({"overview": _records(overview)} | _failed(left_out)))


def summary_of_leaderboard(title: str, board: pd.DataFrame, left_out: Mapping[str, str], verdict: Sequence[str]) -> TerminalSummary:
    """The leaderboard of a study, a table a test set, with the study's verdict.

    Args:
        title: of the study.
        board: one row an estimator and test set.
        left_out: name of a failed or unfinished job -> why.
        verdict: a line each.
    """
    tables, notes = [], []
    for test_set, rows in board.groupby("test_set", sort=False):
        given = " (estimates start at the reference state)" if (rows["start"] == "reference").any() else ""
        cells = tuple(_board_row(row) for row in rows.to_dict("records"))
        tables.append(TerminalTable(f"{title}: test set '{test_set}'{given}", BOARD_HEADER, cells))
        if rows["rmse_sideslip_low"].isna().all():
            notes.append(f"test set '{test_set}' is too short to tell estimators apart: no interval, no winner")
    note = "\n".join([*notes, *([_note(left_out)] if left_out else []), *verdict])
    figures = {"leaderboard": _records(board)} | ({"verdict": list(verdict)} if verdict else {}) | _failed(left_out)
    return TerminalSummary(tuple(tables), note, "report.html", json.dumps(figures))


def summary_of_sweep(artefacts: SweepArtefacts, table: pd.DataFrame) -> TerminalSummary:
    """A row a combination with settings, seeds, mean and half interval on validation and tests."""
    from vehest.studies.sweep import table_of

    header, rows = table_of(artefacts, table)
    kinds = " and ".join(kind.upper() if kind == "simulated" else kind for kind in dict.fromkeys(artefacts.kinds.values()))
    title = f"{artefacts.name}: RMSE(β) [deg], mean over seeds ± half its 95 % interval (Student's t); {kinds} data"
    records = _records(table)
    figures = {
        "chosen": next((row for row in records if row["chosen"]), None),
        "summary": records,
        "failed": [{"jobs": name, "message": reason} for name, reason in artefacts.failures.items()],
    }
    note = "* lowest mean on the validation range; tests choose nothing" if table["chosen"].any() else ""
    shown = TerminalTable(title, tuple(header), tuple(tuple(row) for row in rows))
    return TerminalSummary((shown,), note, "report.md", json.dumps(figures))


def _note(left_out: Mapping[str, str]) -> str:
    return "\n".join(f"left out: {name}: {reason}" for name, reason in left_out.items())


def _failed(left_out: Mapping[str, str]) -> dict[str, Any]:
    return {"failed": dict(left_out)} if left_out else {}


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
