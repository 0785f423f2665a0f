"""What people see while stages run: a line an artefact and a progress bar, all on standard error.

Names and other text come from files: their control characters are shown as escapes, and nothing in them is read as markup.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from vehest.data.errors import printable
from vehest.training.context import Progress as FitProgress

MARKS = {
    "done": ("done", "green"),
    "skip": ("skipped", "dim"),
    "plan": ("would", "cyan"),
    "once": ("once", "cyan"),
    "note": ("note", "cyan"),
    "fail": ("failed", "red"),
    "stop": ("stopped", "yellow"),
    "wait": ("waiting", "cyan"),
    "again": ("again", "yellow"),
}
"""Status -> its word and colour."""

MOST_STANDING = 12
MOST_BARS = 16  # of trainings that run at a time
LINE_BREAK = "\n"


class _Console(Console):
    def on_broken_pipe(self) -> None:
        raise BrokenPipeError  # which rich would turn into an exit


WARNING = "warn"


class Messages:
    """Lines and bars on standard error; standard output stays free for results.

    Args:
        quiet: say nothing but warnings.
        silent: say nothing at all.

    Attributes:
        said: (status, stage, label, detail) of every line, a warning's text in the last; also where nothing is printed.
    """

    def __init__(self, *, quiet: bool = False, silent: bool = False) -> None:
        self.console = _Console(stderr=True, highlight=False, soft_wrap=True, quiet=silent)
        self.quiet = quiet or silent
        self.said: list[tuple[str, str, str, str]] = []

    def again(self, said: Sequence[tuple[str, str, str, str]]) -> None:
        """Say lines and warnings that were said before."""
        for status, stage, label, detail in said:
            if status == WARNING:
                self.warn(detail)
            else:
                self.line(status, stage, label, detail)

    def line(self, status: str, stage: str, label: str, detail: str = "") -> None:
        """Say what became of one artefact."""
        self.said.append((status, stage, label, detail))
        if not self.quiet:
            word, colour = MARKS[status]
            shown = (f" {printable(detail)}" if detail else "", "dim")
            self._print(Text.assemble((f"{word:<7}", colour), f" {stage:<10} {printable(label)}", shown))

    def warn(self, text: str) -> None:
        """Say something that needs attention."""
        self.said.append((WARNING, "", "", text))
        self._print(Text.assemble(("warning", "yellow"), f" {printable(text, keep=LINE_BREAK)}"))

    def _print(self, text: Text) -> None:
        with suppress(OSError):  # nobody reads it, or its disk is full: the work goes on
            self.console.print(text)

    @contextmanager
    def off_record(self) -> Iterator[None]:
        """Say in here what `said` is not to hold."""
        before = self.said
        self.said = []
        try:
            yield
        finally:
            self.said = before

    @contextmanager
    def bars(self) -> Iterator[Bars]:
        """Progress bars that vanish when all is done; nothing is drawn where there is no terminal."""
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}", markup=False),
            TimeElapsedColumn(),
        )
        drawn = not self.quiet and self.console.is_terminal
        bars = Bars(Progress(*columns, console=self.console, disable=not drawn))
        with Live(bars, console=self.console, transient=True) if drawn else nullcontext():
            yield bars


class Bars:
    """Progress bars by name, and above them how those that are done stand to each other."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._tasks: dict[str, TaskID] = {}
        self._standing: dict[str, tuple[float, ...]] = {}
        self._header: tuple[str, ...] = ()
        self._counted: Mapping[str, str] = {}

    def __rich__(self) -> RenderableType:
        shown: list[RenderableType] = [self._progress]
        if self._standing:
            shown.insert(0, self._table())
        if self._counted:
            counts = Table(*self._counted, box=None, header_style="dim", padding=(0, 2))
            counts.add_row(*self._counted.values())
            shown.append(counts)
        return Group(*shown)

    def count(self, counted: Mapping[str, str]) -> None:
        """Say how much is done; nothing where there is nothing to count."""
        self._counted = counted

    def _table(self) -> Table:
        table = Table(*self._header, box=None, header_style="dim", padding=(0, 2))
        for name, values in sorted(self._standing.items(), key=lambda row: row[1])[:MOST_STANDING]:
            table.add_row(Text(printable(name)), *(f"{value:.3f}" for value in values))
        return table

    def stands(self, name: str, figures: Mapping[str, float]) -> None:
        """Add one that is done, by its figures; the first of them sorts the rows."""
        if figures:
            self._header = ("done so far", *figures)
            self._standing[name] = tuple(figures.values())

    def step(self, name: str, done: int, total: int, note: str = "") -> None:
        """Move a bar; it appears when it is first moved."""
        if name not in self._tasks and len(self._tasks) >= MOST_BARS:
            return
        if name not in self._tasks:
            self._tasks[name] = self._progress.add_task(printable(name), total=total, note="")
        self._progress.update(self._tasks[name], completed=done, total=total, note=printable(note))

    def fit(self, name: str, progress: FitProgress | None) -> None:
        """Move the bar of a training."""
        if progress is None:
            self.step(name, 0, 1, "starting")
            return
        note = f"{progress.active}/{progress.members} active, best validation loss {progress.best_validation_loss:.4g}"
        self.step(name, progress.epoch, progress.max_epochs, note)

    def close(self, name: str) -> None:
        """Take a bar away."""
        if name in self._tasks:
            self._progress.remove_task(self._tasks.pop(name))
