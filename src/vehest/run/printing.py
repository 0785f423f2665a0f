"""Output of a command: lines and tables or one JSON object on standard output; remarks on standard
error.

outcome of a study -> `TerminalSummary`: tables, and figures as JSON -> `emit`
"""

from __future__ import annotations

import io
import json
import math
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import typer

from vehest.data.errors import MissingError, is_printable, printable

if TYPE_CHECKING:
    import pandas as pd

    from vehest.alignment.findings import Finding
    from vehest.studies.sweep import SweepArtefacts

# header of the columns of `score_cells`
SCORE_HEADER = (
    "RMSE(β) [deg]",
    "95 % interval [deg]",
    "difference to best [deg]",
    "beats zero, static map",
)


@dataclass(frozen=True)
class TerminalTable:
    """Cells, header and title of a table that `emit` prints; ``title`` may be empty."""

    header: Sequence[str]  # titles of the columns
    rows: Sequence[Sequence[str]]  # cells of each row
    title: str = ""  # line above the table; may be empty


@dataclass(frozen=True)
class TerminalSummary:
    """Summary of a finished study for the terminal."""

    tables: tuple[TerminalTable, ...]  # tables that are printed
    note: str  # text below the tables; may be empty
    page: str  # file of the report
    figures: str  # JSON that ``--json`` prints


class OutputClosed(Exception):
    """The reader of standard output has closed it."""


def open_streams() -> None:
    """Replace standard streams that were closed at the start by a null device, and let the others
    print any character, as an escape if need be.
    """
    for name in ("stdin", "stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            mode = "r" if name == "stdin" else "w"
            null_device = open(os.devnull, mode, encoding="utf-8")  # noqa: SIM115 (never closed)
            setattr(sys, name, null_device)
        elif name != "stdin" and isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def emit(as_json: bool, outcome: Any, lines: Iterable[str | TerminalTable] | None = None) -> None:
    """Print the outcome of a command, as one JSON object or in lines and tables.

    By default a line for each key; raises `MissingError`.

    Parameters
    ----------
    as_json : bool
        Print one JSON object instead of lines.
    outcome : Any
        Plain values.
    lines : iterable of str or TerminalTable, optional
        What people read.

    Raises
    ------
    OutputClosed
        The reader of standard output has gone.
    MissingError
        Standard output cannot be written to.
    """
    if as_json:
        echo(as_json_text(outcome), keep="\n")
        return
    if lines is None:
        lines = (
            f"{key}: {value if not isinstance(value, float) else f'{value:.6g}'}"
            for key, value in outcome.items()
        )
    for line in lines:
        if isinstance(line, str):
            echo(line)
        else:
            _print_table(line)


def _print_table(content: TerminalTable) -> None:
    """Print a table, 160 characters wide without a terminal; a title after an empty line."""
    from rich.console import Console
    from rich.table import Column, Table
    from rich.text import Text

    if content.title:
        echo("")
        echo(content.title)
    console = Console(width=None if sys.stdout.isatty() else 160, highlight=False)
    table = Table(
        *(Column(Text(printable(name))) for name in content.header),
        box=None,
        header_style="bold",
        pad_edge=False,
    )
    for row in content.rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    with console.capture() as captured:
        console.print(table)
    echo(
        captured.get().removesuffix("\n"), keep="\n\x1b"
    )  # cells hold no escapes any more, styles do


def echo(text: str, keep: str = "") -> None:
    """Print a line on standard output, control characters as escapes except for those in ``keep``.

    Errors as of `emit`.
    """
    try:
        typer.echo(printable(text, keep))
    except BrokenPipeError:
        raise OutputClosed from None
    except OSError as error:
        silence(sys.stdout)
        raise MissingError(f"cannot write to standard output ({error.strerror})") from error


def complain(text: str) -> None:
    """Print a line on standard error, unless it is closed."""
    try:
        typer.echo(text, err=True)
    except OSError:
        silence(sys.stderr)


def note(text: str) -> None:
    """Print a remark on standard error."""
    complain(f"note: {text}")


def silence(stream: Any) -> None:
    """Redirect a broken stream to a null device, so that the exit raises no further error."""
    with suppress(OSError, ValueError), open(os.devnull, "w", encoding="utf-8") as nowhere:
        os.dup2(nowhere.fileno(), stream.fileno())


def describe_finding(finding: Finding) -> str:
    """Text of a finding, preceded by the channel that it is about."""
    return f"{finding.channel}: {finding.message}" if finding.channel else finding.message


def as_json_text(outcome: Any) -> str:
    """Text of plain values as JSON, with null for numbers that are not finite, and escapes for
    unprintable characters.
    """

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(inner) for key, inner in value.items()}
        if isinstance(value, list | tuple):
            return [plain(inner) for inner in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    encoding = (sys.stdout.encoding or "utf-8").lower().replace("-", "")
    text = json.dumps(plain(outcome), indent=1, ensure_ascii=encoding != "utf8", allow_nan=False)
    return "".join(
        c if c == "\n" or is_printable(c) else json.dumps(c)[1:-1] if c != "\x7f" else "\\u007f"
        for c in text
    )


def summary_of_overview(overview: pd.DataFrame, left_out: Mapping[str, str]) -> TerminalSummary:
    """Summary of a study in parts, or of recordings alone, by its overview."""
    rows = [[_cell(value) for value in row] for row in overview.itertuples(index=False)]
    table = TerminalTable([str(name) for name in overview.columns], rows)
    return _summary([table], [], {"overview": _records(overview)}, left_out)


def summary_of_leaderboard(
    title: str, board: pd.DataFrame, left_out: Mapping[str, str], verdict: Sequence[str]
) -> TerminalSummary:
    """The leaderboard of a study, a table a test set, with the study's verdict.

    Parameters
    ----------
    title : str
        Of the study.
    board : pd.DataFrame
        As the study's module makes it.
    left_out : mapping
        Name of a training -> why it is missing.
    verdict : sequence of str
        Lines of plain text; empty for none.
    """
    header = ("estimator", "parameters", "seeds", *SCORE_HEADER, "FVU")
    tables = []
    notes = []
    for test_set, rows in board.groupby("test_set", sort=False):
        remark = (
            " (estimates start at the reference state)"
            if (rows["start"] == "reference").any()
            else ""
        )
        cells = [
            (
                row["title"],
                f"{row['n_parameters']:.0f}",
                str(row["n_seeds"]),
                *score_cells(row),
                f"{row['fvu']:.3f}",
            )
            for row in rows.to_dict("records")
        ]
        tables.append(TerminalTable(header, cells, f"{title}: test set '{test_set}'{remark}"))
        share = float(rows["share_below_min_speed"].iloc[0])
        if share > 0:
            notes.append(
                f"test set '{test_set}': sideslip is not scored at {100 * share:.1f} % of the "
                f"samples, where the car is slower than {rows['min_sideslip_speed'].iloc[0]}"
            )
        if rows["rmse_sideslip_low"].isna().all():
            notes.append(
                f"test set '{test_set}' is too short to compare estimators: no interval, no winner"
            )
    figures = {"leaderboard": _records(board)} | ({"verdict": list(verdict)} if verdict else {})
    return _summary(tables, notes, figures, left_out)


def _summary(
    tables: list[TerminalTable],
    notes: list[str],
    figures: dict[str, Any],
    left_out: Mapping[str, str],
) -> TerminalSummary:
    """Summary with notes, reasons for what is left out and the verdict below the tables."""
    missing = [f"left out: {name}: {reason}" for name, reason in left_out.items()]
    note = "\n".join([*notes, *missing, *figures.get("verdict", [])])
    return TerminalSummary(
        tuple(tables),
        note,
        "report.html",
        json.dumps(figures | ({"failed": dict(left_out)} if left_out else {})),
    )


def summary_of_sweep(artefacts: SweepArtefacts) -> TerminalSummary:
    """Summary of a sweep: a row for each combination with settings, seeds, mean and half interval
    on validation and tests.
    """
    from vehest.studies.sweep import table_of

    kinds = " and ".join(
        kind.upper() if kind == "simulated" else kind
        for kind in dict.fromkeys(artefacts.part.kinds.values())
    )
    title = (
        f"{artefacts.part.study}: RMSE(β) [deg], mean over seeds ± half its 95 % interval "
        f"(Student's t); {kinds} data"
    )
    records = _records(artefacts.table)
    figures = {
        "chosen": next((row for row in records if row["chosen"]), None),
        "summary": records,
        "failed": [
            {"jobs": name, "message": reason} for name, reason in artefacts.part.failed.items()
        ],
    }
    note = (
        "* lowest mean on the validation range; tests choose nothing" if figures["chosen"] else ""
    )
    return TerminalSummary(
        (TerminalTable(*table_of(artefacts), title),), note, "report.md", json.dumps(figures)
    )


def score_cells(row: Mapping[Any, Any]) -> tuple[str, ...]:
    """Cells of a ranked estimate for the columns `SCORE_HEADER`."""
    low = row["rmse_sideslip_low"]
    high = row["rmse_sideslip_high"]
    interval = f"{low:.3f} … {high:.3f}" if low > 0 else "–"
    return (
        f"{row['rmse_sideslip']:.3f}",
        interval,
        str(row["against_best"]),
        f"{row['beats_zero']}, {row['beats_static_map']}",
    )


def _records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows of a table as mappings, with None in place of numbers that are not finite."""
    rows: list[dict[str, Any]] = json.loads(table.to_json(orient="records"))
    return rows


def _cell(value: Any) -> str:
    """Text of a value in a table: numbers with four significant digits, a dash for what is not
    finite.
    """
    if isinstance(value, float):
        return f"{value:.4g}" if math.isfinite(value) else "–"
    return str(value)
