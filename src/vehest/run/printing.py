"""Output of a command: lines and tables or one JSON object on standard output; remarks on standard error."""

from __future__ import annotations

import io
import json
import math
import os
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import typer

from vehest.data.errors import MissingError, is_printable, printable


@dataclass(frozen=True)
class TerminalTable:
    """A table in a terminal; an empty title is left out."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]


class OutputClosed(Exception):
    """The reader of standard output has closed it."""


def open_streams() -> None:
    """Replace streams that were closed at the start by a null device; let the others show any character, as an escape if need be."""
    for name in ("stdin", "stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w", encoding="utf-8"))  # noqa: SIM115 (as long as the process lives)
        elif name != "stdin" and isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def emit(as_json: bool, outcome: Any, shown: Iterable[str | TerminalTable] | None = None) -> None:
    """Print the outcome of a command.

    Args:
        as_json: as one JSON object.
        outcome: plain values.
        shown: lines and tables for people; by default a line for each key of the outcome.

    Raises:
        MissingError: the disk behind standard output is full.
        OutputClosed: its reader has closed it.
    """
    if as_json:
        echo(as_json_text(outcome), keep="\n")
        return
    if shown is None:
        shown = (f"{key}: {value if not isinstance(value, float) else f'{value:.6g}'}" for key, value in outcome.items())
    for one in shown:
        if isinstance(one, str):
            echo(one)
        else:
            _print_table(one)


def _print_table(shown: TerminalTable) -> None:
    """Print a table, 160 characters wide without a terminal; a title after an empty line."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    if shown.title:
        echo("")
        echo(shown.title)
    console = Console(width=None if sys.stdout.isatty() else 160, highlight=False)
    table = Table(box=None, header_style="bold", pad_edge=False)
    for name in shown.header:
        table.add_column(Text(printable(name)))
    for row in shown.rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    with console.capture() as captured:
        console.print(table)
    echo(captured.get().removesuffix("\n"), keep="\n\x1b")  # cells hold no escapes any more, styles do


def echo(text: str, keep: str = "") -> None:
    """Print a line on standard output, control characters as escapes except for those in ``keep``.

    Raises:
        MissingError: its disk is full.
        OutputClosed: its reader has closed it.
    """
    try:
        typer.echo(printable(text, keep))
    except BrokenPipeError:
        raise OutputClosed from None
    except OSError as error:
        silence(sys.stdout)
        raise MissingError(f"cannot write to standard output ({error.strerror})") from error


def complain(text: str) -> None:
    """Print on standard error, unless it is closed."""
    try:
        typer.echo(text, err=True)
    except OSError:
        silence(sys.stderr)


def note(text: str) -> None:
    """Print a remark on standard error."""
    complain(f"note: {text}")


def silence(stream: Any) -> None:
    """Discard the rest of a broken stream, so that leaving does not complain about it."""
    with suppress(OSError, ValueError), open(os.devnull, "w", encoding="utf-8") as nowhere:
        os.dup2(nowhere.fileno(), stream.fileno())


def counted(names: Sequence[str]) -> str:
    """Their number, and the first of them."""
    return f"{len(names)} ({', '.join([*names[:6], *(['…'] if len(names) > 6 else [])])})" if names else "0"


def as_json_text(outcome: Any) -> str:
    """An outcome as JSON; numbers that are not finite become null, unprintable characters their escapes."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(inner) for key, inner in value.items()}
        if isinstance(value, list | tuple):
            return [plain(inner) for inner in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    encoding = (sys.stdout.encoding or "utf-8").lower().replace("-", "")
    text = json.dumps(plain(outcome), indent=1, ensure_ascii=encoding != "utf8", allow_nan=False)
    return "".join(c if c == "\n" or is_printable(c) else json.dumps(c)[1:-1] if c != "\x7f" else "\\u007f" for c in text)
