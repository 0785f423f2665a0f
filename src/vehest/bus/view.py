"""Figures of a model on a bus, and the line that shows them every ten seconds while it runs."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TextIO

from vehest.trust.health import reason_in_words

HEALTH = ("valid", "degraded", "invalid")  # texts of the codes of health, 0 first
LINE_SECONDS = 10.0  # s, at least, between two lines that `View` writes


@dataclass
class Figures:
    """Figures of a replay, by the names under which they are reported."""

    seconds: float = 0.0  # time from the first sample to the last, on the bus's clock
    frames_sent: int = 0  # frames of the log that were put on the bus
    frames_received: int = 0  # frames with signals that the model reads, among those sent
    frames_too_short: int = 0  # frames that are shorter than the DBC says, among those received
    samples: int = 0  # samples that were formed
    samples_lost: int = 0  # samples at which a channel was missing: lost, late or invalid
    # channel -> number of samples at which it was missing
    missing: dict[str, int] = field(default_factory=dict)
    estimates: int = 0  # estimates that were sent
    # longest time from a sample's instant until its estimate was sent; as fast as possible: that a
    # sample took
    latest_ms: float = 0.0
    deadlines_missed: int = 0  # samples for which that was longer than a cycle of the bus

    def plain(self) -> dict[str, Any]:
        """Figures as plain values, to print or to write as JSON."""
        return {
            name: round(value, 3) if isinstance(value, float) else value
            for name, value in vars(self).items()
        }


class View:
    """Shows a replay on a stream; on None nothing."""

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream
        self._due = 0.0

    def show(self, figures: Figures, values: Mapping[str, float], seconds: float) -> None:
        """Write an estimate's values and figures in a line, if it is time to, ``seconds`` after the
        first frame.
        """
        if self._stream is None or time.monotonic() < self._due:
            return
        self._due = time.monotonic() + LINE_SECONDS
        reason = reason_in_words(values.get("health_reason", 0.0))
        health = (
            HEALTH[int(values["health"])] + (f": {reason}" if reason else "")
            if "health" in values
            else "-"
        )
        yaw_rate = f"yaw rate {values['yaw_rate']:+.3f} rad/s, " if "yaw_rate" in values else ""
        vy = _with_band(values, "vy", 1.0, "m/s", 3)
        sideslip = _with_band(values, "sideslip", 180.0 / math.pi, "°", 2)
        self._stream.write(
            f"time {seconds:.1f} s, v {vy}, β {sideslip}, "
            f"{yaw_rate}health {health}, {figures.estimates} estimates, {figures.samples} "
            f"samples, {figures.samples_lost} lost, "
            f"latest {figures.latest_ms:.2f} ms, {figures.deadlines_missed} deadlines missed\n"
        )
        self._stream.flush()


def _with_band(
    values: Mapping[str, float], name: str, factor: float, unit: str, digits: int
) -> str:
    """Text of a value in a display unit with the half width of its band; a dash where there is
    none.
    """
    value = values.get(name, math.nan)
    band = values.get(f"band_{name}", math.nan)
    if math.isnan(value):
        return "-"
    return (
        f"{factor * value:+.{digits}f}"
        + (f" ± {factor * band:.{digits}f}" if not math.isnan(band) else "")
        + f" {unit}"
    )
