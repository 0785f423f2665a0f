"""Figures of a model on a bus, shown while it runs: a table that changes in place on a terminal, else a line every ten seconds."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TextIO

from vehest.trust.health import reason_in_words

HEALTH = ("valid", "degraded", "invalid")
STYLES = {"valid": "green", "degraded": "yellow", "invalid": "bold red"}
PER_SECOND = 5.0
LINE_SECONDS = 10.0


@dataclass
class Figures:
    """How a replay goes, under the names that it reports."""

    seconds: float = 0.0  # on the bus's clock, from the first sample to the last
    frames_sent: int = 0  # of the log, put on the bus
    frames_received: int = 0  # of them, those that carry wanted signals
    frames_too_short: int = 0  # of these, those that are shorter than the DBC says
    samples: int = 0
    samples_lost: int = 0  # of them, those at which a channel was missing: lost, late or invalid
    missing: dict[str, int] = field(default_factory=dict)  # channel -> at how many
    estimates: int = 0  # that were sent
    latest_ms: float = 0.0  # longest time from a sample's instant until its estimate was sent; as fast as possible: that a sample took
    deadlines_missed: int = 0  # samples for which that was longer than a cycle of the bus

    def plain(self) -> dict[str, Any]:
        """Figures for people and scripts."""
        return {name: round(value, 3) if isinstance(value, float) else value for name, value in vars(self).items()}


def rows_of(figures: Figures, values: Mapping[str, float], seconds: float, estimates_hz: float) -> list[tuple[str, str]]:
    """Names and texts of an estimate's ``values``, ``seconds`` after the first frame, and of figures."""
    health = "-"
    if "health" in values:
        reason = reason_in_words(values["health_reason"])
        health = HEALTH[int(values["health"])] + (f": {reason}" if reason else "")
    return [
        ("time", f"{seconds:.1f} s"),
        ("v", _with_band(values, "vy", 1.0, "m/s", 3)),
        ("β", _with_band(values, "sideslip", 180.0 / math.pi, "°", 2)),
        *([("yaw rate", f"{values['yaw_rate']:+.3f} rad/s")] if "yaw_rate" in values else []),
        ("health", health),
        ("rate", f"{estimates_hz:.1f} estimates/s"),
        ("frames", f"{figures.frames_received} taken, {figures.frames_sent} sent"),
        ("samples", f"{figures.samples}, {figures.samples_lost} lost"),
        ("latest", f"{figures.latest_ms:.2f} ms"),
        ("deadlines missed", str(figures.deadlines_missed)),
    ]


def _with_band(values: Mapping[str, float], name: str, factor: float, unit: str, digits: int) -> str:
    value, band = values.get(name, math.nan), values.get(f"band_{name}", math.nan)
    if math.isnan(value):
        return "-"
    text = f"{factor * value:+.{digits}f}"
    return f"{text} ± {factor * band:.{digits}f} {unit}" if not math.isnan(band) else f"{text} {unit}"


class View:
    """Shows a replay on a stream; on None nothing."""

    def __init__(self, stream: TextIO | None, title: str) -> None:
        self._stream, self._title = stream, title
        self._live: Any = None
        self._rows: list[tuple[str, str]] = []
        self._then, self._estimates = time.monotonic(), 0
        self._due = 0.0 if stream is not None else math.inf

    def __enter__(self) -> View:
        if self._stream is not None and self._stream.isatty():
            from rich.console import Console
            from rich.live import Live

            console = Console(file=self._stream)  # drawn by a thread of rich, so that no sample waits for it
            self._live = Live(console=console, refresh_per_second=PER_SECOND, get_renderable=self._table)
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, figures: Figures, values: Mapping[str, float], seconds: float) -> None:
        """Show an estimate and figures, if it is time to, ``seconds`` after the first frame."""
        now = time.monotonic()
        if now < self._due:
            return
        rate = (figures.estimates - self._estimates) / max(now - self._then, 1e-6)
        self._then, self._estimates = now, figures.estimates
        self._rows = rows_of(figures, values, seconds, rate)
        self._due = now + (1.0 / PER_SECOND if self._live is not None else LINE_SECONDS)
        if self._live is None and self._stream is not None:
            self._stream.write(", ".join(f"{name} {text}" for name, text in self._rows) + "\n")
            self._stream.flush()

    def _table(self) -> Any:
        from rich.table import Table
        from rich.text import Text

        table = Table(box=None, show_header=False, title=Text(self._title), title_justify="left", pad_edge=False)
        for name, text in self._rows:
            style = STYLES.get(text.partition(":")[0], "") if name == "health" else ""
            table.add_row(Text(name, style="bold"), Text(text, style=style))
        return table
