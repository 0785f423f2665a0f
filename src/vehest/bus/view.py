"""What people see of a model on a bus: a table that changes in place on a terminal, else a line now and then."""

from __future__ import annotations

import math
import sys
import threading
import time
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self, TextIO

from vehest.bus.receiver import Figures, Said
from vehest.bus.sampling import Sample
from vehest.trust.verdict import reason_in_words

HEALTH = ("valid", "degraded", "invalid")
STYLES = {"valid": "green", "degraded": "yellow", "invalid": "bold red"}
PER_SECOND = 5.0
LINE_SECONDS = 10.0


@dataclass(frozen=True)
class Shown:
    """What there is to show.

    Args:
        figures: so far.
        said: last estimate.
        sample: last one.
        first: time of the log's first frame [s].
    """

    figures: Figures
    said: Said | None
    sample: Sample | None
    first: float


def rows_of(shown: Shown, estimates_hz: float) -> list[tuple[str, str]]:
    """Names and values, as people read them.

    Args:
        shown: what there is.
        estimates_hz: rate at which estimates came of late.
    """
    figures, values = shown.figures, shown.said.values if shown.said is not None else {}
    now = shown.sample.time - shown.first if shown.sample is not None else 0.0
    rows = [
        ("time", f"{now:.1f} s"),
        ("v", _with_band(values, "vy", 1.0, "m/s", 3)),
        ("β", _with_band(values, "sideslip", 180.0 / math.pi, "°", 2)),
    ]
    if "yaw_rate" in values:
        rows.append(("yaw rate", f"{values['yaw_rate']:+.3f} rad/s"))
    rows += [
        ("health", health_in_words(values)),
        ("rate", f"{estimates_hz:.1f} estimates/s"),
        ("frames", f"{figures.received} taken, {figures.sent} sent"),
        ("samples", f"{figures.samples}, {figures.lost} lost"),
        ("latest", f"{1e3 * figures.latest:.2f} ms"),
        ("deadlines missed", str(figures.missed)),
    ]
    return rows


def health_in_words(values: Any) -> str:
    """Health and its reason; a dash before the first estimate."""
    if "health" not in values:
        return "-"
    word, reason = HEALTH[int(values["health"])], reason_in_words(values["health_reason"])
    return f"{word}: {reason}" if reason else word


def _with_band(values: Any, name: str, factor: float, unit: str, digits: int) -> str:
    value, band = values.get(name, math.nan), values.get(f"band_{name}", math.nan)
    if math.isnan(value):
        return "-"
    text = f"{factor * value:+.{digits}f}"
    return f"{text} ± {factor * band:.{digits}f} {unit}" if not math.isnan(band) else f"{text} {unit}"


class View:
    """Shows nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Leave what was shown last."""

    def is_due(self, samples: int) -> bool:
        """Whether it is time to show something anew, after so many samples."""
        return False

    def show(self, shown: Shown) -> None:
        """Show it."""


class _Paced(View):
    """One that shows something so often by the clock on the wall."""

    def __init__(self, stream: TextIO, seconds: float) -> None:
        self.stream, self.seconds = stream, seconds
        self._next, self._samples = 0.0, -1
        self._then: tuple[float, int] | None = None

    def is_due(self, samples: int) -> bool:
        """Right after a sample, so that the most time is left until the next one."""
        if samples == self._samples:
            return False
        self._samples = samples
        return time.monotonic() >= self._next

    def show(self, shown: Shown) -> None:
        """Show it, with the rate since the last time."""
        now = time.monotonic()
        rate = 0.0
        if self._then is not None and now > self._then[0]:
            rate = (shown.figures.estimates - self._then[1]) / (now - self._then[0])
        self._then, self._next = (now, shown.figures.estimates), now + self.seconds
        self.put(rows_of(shown, rate))

    def put(self, rows: list[tuple[str, str]]) -> None:
        """Print the rows."""
        raise NotImplementedError


class PlainView(_Paced):
    """A line every so many seconds, for what is no terminal."""

    def __init__(self, stream: TextIO, seconds: float = LINE_SECONDS) -> None:
        super().__init__(stream, seconds)

    def put(self, rows: list[tuple[str, str]]) -> None:
        """Print a line."""
        self.stream.write(", ".join(f"{name} {value}" for name, value in rows) + "\n")
        self.stream.flush()


class LiveView(_Paced):
    """A table in a terminal, drawn by a thread of its own, so that no sample waits for it."""

    def __init__(self, stream: TextIO, title: str) -> None:
        super().__init__(stream, 1.0 / PER_SECOND)
        self.title = title
        self._live: Any = None
        self._rows: list[tuple[str, str]] = []
        self._changed, self._over = threading.Event(), False
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        from rich.console import Console
        from rich.live import Live

        self._live = Live(console=Console(file=self.stream), auto_refresh=False)
        self._live.start()
        self._thread = threading.Thread(target=self._draw, name="view", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Draw what is there last, and give the terminal back."""
        self._over = True
        self._changed.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)
        self._live.stop()

    def put(self, rows: list[tuple[str, str]]) -> None:
        """Have the rows drawn."""
        self._rows = rows
        self._changed.set()

    def _draw(self) -> None:
        while not self._over:
            self._changed.wait()
            self._changed.clear()
            self._live.update(self._table(), refresh=True)

    def _table(self) -> Any:
        from rich.table import Table
        from rich.text import Text

        table = Table(box=None, show_header=False, title=Text(self.title), title_justify="left", pad_edge=False)
        for name, value in self._rows:
            style = STYLES.get(value.partition(":")[0], "") if name == "health" else ""
            table.add_row(Text(name, style="bold"), Text(value, style=style))
        return table


def view_on(stream: TextIO, title: str, *, quiet: bool = False) -> View:
    """A view for a stream, by whether it is a terminal."""
    if quiet:
        return View()
    return LiveView(stream, title) if stream.isatty() else PlainView(stream)


def standard_view(title: str, *, quiet: bool = False) -> View:
    """A view on standard error."""
    return view_on(sys.stderr, title, quiet=quiet)
