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

SCORE_HEADER = ("RMSE(β) [deg]", "95 % interval [deg]", "to the lowest [deg]", "beats v = 0, static map")


@dataclass(frozen=True)
class TerminalSummary:
    """Tables of a study, a note below them (may be empty), the file of its report, and the figures of ``--json`` as JSON."""

    tables: tuple[TerminalTable, ...]
    note: str
    page: str
    figures: str


def summary_of_overview(overview: pd.DataFrame, left_out: Mapping[str, str]) -> TerminalSummary:
    """The overview of a study in parts, or of recordings alone."""
    rows = tuple(tuple(_cell(value) for value in row) for row in overview.itertuples(index=False))
    table = TerminalTable("", tuple(str(name) for name in overview.columns), rows)
    figures = {"overview": _records(overview)} | _failed(left_out)
    return TerminalSummary((table,), "\n".join(_notes(left_out)), "report.html", json.dumps(figures))


def summary_of_leaderboard(title: str, board: pd.DataFrame, left_out: Mapping[str, str], verdict: Sequence[str]) -> TerminalSummary:
    """The leaderboard of a study, a table a test set, with the study's verdict."""
    header = ("estimator", "parameters", "seeds", *SCORE_HEADER, "FVU")
    tables, notes = [], []
    for test_set, rows in board.groupby("test_set", sort=False):
        given = " (estimates start at the reference state)" if (rows["start"] == "reference").any() else ""
        cells = tuple(
            (row["title"], f"{row['n_parameters']:.0f}", str(row["n_seeds"]), *score_cells(row), f"{row['fvu']:.3f}")
            for row in rows.to_dict("records")
        )
        tables.append(TerminalTable(f"{title}: test set '{test_set}'{given}", header, cells))
        if rows["rmse_sideslip_low"].isna().all():
            notes.append(f"test set '{test_set}' is too short to tell estimators apart: no interval, no winner")
    figures = {"leaderboard": _records(board)} | ({"verdict": list(verdict)} if verdict else {}) | _failed(left_out)
    return TerminalSummary(tuple(tables), "\n".join([*notes, *_notes(left_out), *verdict]), "report.html", json.dumps(figures))


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


def score_cells(row: Mapping[Any, Any]) -> tuple[str, ...]:
    """Cells of a ranked estimate under `SCORE_HEADER`."""
    low, high = row["rmse_sideslip_low"], row["rmse_sideslip_high"]
    interval = f"{low:.3f} … {high:.3f}" if low > 0 else "–"
    return (f"{row['rmse_sideslip']:.3f}", interval, str(row["against_best"]), f"{row['beats_zero']}, {row['beats_static_map']}")


def _notes(left_out: Mapping[str, str]) -> list[str]:
    return [f"left out: {name}: {reason}" for name, reason in left_out.items()]


def _failed(left_out: Mapping[str, str]) -> dict[str, Any]:
    return {"failed": dict(left_out)} if left_out else {}


def _records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows with null in place of numbers that are not finite."""
    rows: list[dict[str, Any]] = json.loads(table.to_json(orient="records"))
    return rows


def _cell(value: Any) -> str:
    """A value of a table, numbers with four significant digits."""
    if isinstance(value, float):
        return f"{value:.4g}" if math.isfinite(value) else "–"
    return str(value)
