"""Progress of stages on standard error: a line an artefact, and progress bars.

Text from files is shown with control characters as escapes, and nothing in it is read as markup.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from vehest.data.errors import printable

WARNING = "warn"  # status of a warning
REUSED = "skip"  # status of an existing artefact, also in records of finished studies
RUNNING = "run"  # status of a stage that is running
# name of the stage before those of a study, in which libraries and configurations are loaded
PLAN = "plan"
MARKS = {
    WARNING: ("warning", "yellow"),
    "done": ("done", "green"),
    REUSED: ("reused", "dim"),
    "plan": ("would", "cyan"),
    "once": ("once", "cyan"),
    "note": ("note", "cyan"),
    "fail": ("failed", "red"),
    "stop": ("stopped", "yellow"),
    "wait": ("waiting", "cyan"),
    RUNNING: ("running", "cyan"),
    "again": ("again", "yellow"),
}
"""Status -> the word that is printed and its colour."""

MAX_BARS = 16  # progress bars at a time; further names get none
MAX_SILENT_SECONDS = 5.0
"""s after which a stage that is still running gets a line, so that it is not mistaken for a
hang.
"""


class _Console(Console):
    """rich's console, which raises `BrokenPipeError` instead of ending the process."""

    def on_broken_pipe(self) -> None:
        """Raise `BrokenPipeError` where the reader of the stream has closed it."""
        raise BrokenPipeError  # which rich would turn into an exit


class Messages:
    """Lines and bars on standard error; warnings alone if ``quiet``.

    Attributes
    ----------
    printed : list[tuple[str, str, str, str]]
        (status, stage, label, detail) of every line, a warning's text in the last; also where
        nothing is shown. Lines of reused artefacts are printed as one, by `print_reused`.
    """

    def __init__(self, *, quiet: bool = False) -> None:
        self.console = _Console(stderr=True, highlight=False, soft_wrap=True)
        self.quiet = quiet
        self.printed: list[tuple[str, str, str, str]] = []
        self._reused: list[tuple[str, str]] = []  # stage and label, not printed yet
        self._timers: dict[tuple[str, str], threading.Timer] = {}  # of running stages

    def warn(self, text: str) -> None:
        """Print a warning."""
        self.line(WARNING, "", "", text)

    def line(self, status: str, stage: str, label: str, detail: str = "") -> None:
        """Print the status of one artefact, or a warning.

        Parameters
        ----------
        status : str
            One of `MARKS`; REUSED is collected and printed by `print_reused`.
        stage, label : str
            What it is about; empty for a warning.
        detail : str
            Remark behind it, or the text of a warning, which may have several lines.
        """
        self.printed.append((status, stage, label, detail))
        if status == REUSED:
            self._reused.append((stage, label))
            return
        if status == WARNING:
            word, colour = MARKS[status]
            text = Text.assemble((word, colour), f" {printable(detail, keep=chr(10))}")
        else:
            text = _status_line(status, stage, label, detail)
        self._print(text, always=status == WARNING)

    def begin(self, stage: str, label: str) -> None:
        """Print that a stage is running if it has not ended after `MAX_SILENT_SECONDS`.

        The line comes from a timer, a daemon thread, so that a long stage needs no polling.
        """
        line = _status_line(RUNNING, stage, label)
        timer = threading.Timer(MAX_SILENT_SECONDS, self._print, [line])
        timer.daemon = True
        self.end(stage, label)
        self._timers[stage, label] = timer
        timer.start()

    def end(self, stage: str, label: str) -> None:
        """Note the end of a stage, if it was begun."""
        timer = self._timers.pop((stage, label), None)
        if timer is not None:
            timer.cancel()

    @contextmanager
    def running(self, stage: str, label: str) -> Iterator[None]:
        """Begin a stage, and end it with the block."""
        self.begin(stage, label)
        try:
            yield
        finally:
            self.end(stage, label)

    def close(self) -> None:
        """Note the end of all stages and print the reused artefacts."""
        for stage, label in list(self._timers):
            self.end(stage, label)
        self.print_reused()

    def print_reused(self) -> None:
        """Print one line for all existing artefacts that were reused since the last such line."""
        stages = Counter(stage for stage, _ in self._reused)
        if not stages:
            return
        if len(self._reused) == 1:
            [(stage, label)] = self._reused
            text = f"{stage:<10} {printable(label)}"
        else:
            counts = ", ".join(f"{count} {stage}" for stage, count in stages.items())
            text = f"{len(self._reused)} artefacts: {counts}"
        self._reused.clear()
        word, colour = MARKS[REUSED]
        self._print(Text.assemble((f"{word:<7}", colour), f" {text}"))

    def _print(self, text: Text, *, always: bool = False) -> None:
        """Print a line, of a quiet run only if it is ``always`` printed."""
        if always or not self.quiet:
            with suppress(OSError):  # a closed stream or a full disk does not end the work
                self.console.print(text)

    def bars(self) -> AbstractContextManager[Bars]:
        """Progress bars that vanish at the end; nothing is drawn without a terminal.

        Returns
        -------
        context manager of Bars
            Bars may be moved in it in any case; without a terminal they are not drawn.
        """
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}", markup=False),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        drawn = not self.quiet and self.console.is_terminal
        bars = Bars(*columns, console=self.console, transient=True, disable=not drawn)
        return bars if drawn else nullcontext(bars)


def _status_line(status: str, stage: str, label: str, detail: str = "") -> Text:
    """A line of status, stage, label and detail with colours."""
    word, colour = MARKS[status]
    suffix = (f" {printable(detail)}" if detail else "", "dim")
    return Text.assemble((f"{word:<7}", colour), f" {stage:<10} {printable(label)}", suffix)


class Bars(Progress):
    """Progress bars by name."""

    def __init__(self, *columns: ProgressColumn, **options: Any) -> None:
        self._named: dict[str, TaskID] = {}
        super().__init__(*columns, **options)

    def step(self, name: str, done: int, total: int, note: str = "") -> None:
        """Move a bar, which appears when it is first moved.

        Parameters
        ----------
        name : str
            Of the bar; beyond `MAX_BARS` no more bars appear.
        done, total : int
            In any unit.
        note : str
            Behind the bar.
        """
        if name not in self._named and len(self._named) < MAX_BARS:
            self._named[name] = self.add_task(printable(name), total=total, note="")
        if name in self._named:
            self.update(self._named[name], completed=done, total=total, note=printable(note))

    def close(self, name: str) -> None:
        """Remove a bar."""
        if name in self._named:
            self.remove_task(self._named.pop(name))
