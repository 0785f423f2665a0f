"""What people see while stages run: a line an artefact and a progress bar, all on standard error."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from vehest.training.context import Progress as FitProgress

MARKS = {
    "done": "[green]done   [/]",
    "skip": "[dim]skipped[/]",
    "plan": "[cyan]would  [/]",
    "once": "[cyan]once   [/]",
    "fail": "[red]failed [/]",
    "stop": "[yellow]stopped[/]",
}


class Messages:
    """Lines and bars on standard error; standard output stays free for results.

    Args:
        quiet: say nothing but warnings.
    """

    def __init__(self, *, quiet: bool = False) -> None:
        self.console = Console(stderr=True, highlight=False, soft_wrap=True)
        self.quiet = quiet

    def line(self, status: str, stage: str, label: str, detail: str = "") -> None:
        """Say what became of one artefact."""
        if not self.quiet:
            text = f" [dim]{_escaped(detail)}[/]" if detail else ""
            self.console.print(f"{MARKS[status]} {stage:<10} {_escaped(label)}{text}")

    def warn(self, text: str) -> None:
        """Say something that needs attention."""
        self.console.print(f"[yellow]warning[/] {_escaped(text)}")

    @contextmanager
    def bars(self) -> Iterator[Bars]:
        """Progress bars that vanish when all is done; nothing is drawn where there is no terminal."""
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
        )
        with Progress(*columns, console=self.console, transient=True, disable=self.quiet or not self.console.is_terminal) as progress:
            yield Bars(progress)


class Bars:
    """Progress bars by name."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._tasks: dict[str, TaskID] = {}

    def step(self, name: str, done: int, total: int, note: str = "") -> None:
        """Move a bar; it appears when it is first moved."""
        if name not in self._tasks:
            self._tasks[name] = self._progress.add_task(name, total=total, note="")
        self._progress.update(self._tasks[name], completed=done, total=total, note=note)

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


def _escaped(text: str) -> str:
    return text.replace("[", "\\[")
