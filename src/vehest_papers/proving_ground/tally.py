"""Statistics of recordings that are seen one at a time: their size does not grow with the number of
recordings.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.recording import Recording

Counts = NDArray[np.int64]

MIN_SPEED = 5.0
"""Speed above which samples count in quantiles [m/s] (Bertipaglia et al. 2024)."""

FLAGS = ("spun", "left_road", "stood")


@dataclass(frozen=True)
class Grid:
    """Equal bins from -limit to limit; what lies beyond counts in the outermost ones."""

    limit: float  # a whole number of widths
    width: float  # of a bin

    @property
    def size(self) -> int:
        """Number of bins."""
        return 2 * round(self.limit / self.width)

    @property
    def edges(self) -> FloatArray:
        """Shape (size + 1,)."""
        return self.width * (np.arange(self.size + 1, dtype=np.float64) - self.size // 2)

    def count(self, values: FloatArray) -> Counts:
        """How many of the values (T,) lie in each bin, shape (size,); a value on an edge counts
        above it.
        """
        index = np.floor(values / self.width).astype(np.int64) + self.size // 2
        return np.bincount(np.clip(index, 0, self.size - 1), minlength=self.size)


FINE: Mapping[str, Grid] = {
    "sideslip": Grid(180.0, 0.02),  # deg
    "ay": Grid(40.0, 0.02),  # m/s²
    "ax": Grid(40.0, 0.02),
    "vy": Grid(40.0, 0.02),  # m/s
    "steer": Grid(75.0, 0.02),  # deg
}


@dataclass
class Tally:
    """Statistics of a set of drives; quantiles are those above `MIN_SPEED`, exact to half a bin of
    `FINE`.
    """

    drives: int = 0
    seconds: float = 0.0
    distance: float = 0.0
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)
    counts: dict[str, Counts] = field(
        default_factory=lambda: {
            name: np.zeros(grid.size, dtype=np.int64) for name, grid in FINE.items()
        }
    )
    flags: dict[str, int] = field(default_factory=lambda: dict.fromkeys(FLAGS, 0))

    def add(self, recording: Recording) -> None:
        """Count a recording in; its channels are vx, vy_ref, sideslip_ref, ay, ax, yaw_rate and, if
        it has it, steer.
        """
        speed = np.hypot(recording["vx"], recording["vy_ref"])
        self.drives += 1
        self.seconds += recording.duration
        self.distance += float(speed.sum()) / recording.rate_hz
        self._widen(
            {
                name: (float(recording[name].min()), float(recording[name].max()))
                for name in ("vx", "yaw_rate")
            }
        )
        samples = {
            "sideslip": np.degrees(recording["sideslip_ref"]),
            "ay": recording["ay"],
            "ax": recording["ax"],
            "vy": recording["vy_ref"],
        }
        if "steer" in recording:
            samples["steer"] = np.degrees(recording["steer"])
        for name, values in samples.items():
            self.counts[name] += FINE[name].count(values[speed > MIN_SPEED])
        for name in FLAGS:
            self.flags[name] += bool(flags_of(recording).get(name))

    def merge(self, added: Tally) -> None:
        """Count another set's drives in."""
        self.drives += added.drives
        self.seconds += added.seconds
        self.distance += added.distance
        self._widen(added.ranges)
        for name, counts in added.counts.items():
            self.counts[name] = self.counts[name] + counts
        for name, number in added.flags.items():
            self.flags[name] += number

    def _widen(self, ranges: Mapping[str, tuple[float, float]]) -> None:
        for name, (low, high) in ranges.items():
            lowest, highest = self.ranges.get(name, (math.inf, -math.inf))
            self.ranges[name] = (min(low, lowest), max(high, highest))

    def quantile(self, name: str, share: float, *, absolute: bool = False) -> float:
        """The value below which a share of the samples lies; NaN where there are none."""
        grid = FINE[name]
        counts = self.counts[name]
        centres = grid.edges[:-1] + grid.width / 2
        if absolute:
            half = grid.size // 2
            counts = counts[half:] + counts[half - 1 :: -1]
            centres = centres[half:]
        total = int(counts.sum())
        if total == 0:
            return math.nan
        return float(centres[int(np.searchsorted(np.cumsum(counts), share * total, side="left"))])

    def share_within(self, name: str, limit: float) -> float:
        """Share of the samples whose size is below ``limit``; NaN where there are none."""
        inside = np.abs(FINE[name].edges[:-1] + FINE[name].width / 2) < limit
        total = int(self.counts[name].sum())
        return float(self.counts[name][inside].sum()) / total if total else math.nan

    def histogram(self, name: str, width: float) -> tuple[FloatArray, Counts]:
        """Edges (B + 1,) and counts (B,) of wider bins, a whole number of fine ones each, one edge
        at zero.
        """
        grid = FINE[name]
        n_fine = round(width / FINE[name].width)
        if abs(n_fine * grid.width - width) > 1e-9 or (grid.size // 2) % n_fine:
            raise ValueError(f"bins of {width} do not fit those of {grid.width} up to {grid.limit}")
        return grid.edges[::n_fine], self.counts[name].reshape(-1, n_fine).sum(axis=1)

    def values(self) -> dict[str, tuple[float, str]]:
        """Quantity -> value and unit."""
        vx, yaw_rate = (self.ranges.get(name, (math.nan, math.nan)) for name in ("vx", "yaw_rate"))
        return {
            "drives": (self.drives, "1"),
            "duration": (self.seconds, "s"),
            "distance": (self.distance, "m"),
            "speed_mean": (self.distance / self.seconds if self.seconds else math.nan, "m/s"),
            "vx_min": (vx[0], "m/s"),
            "vx_max": (vx[1], "m/s"),
            "vy_q01": (self.quantile("vy", 0.01), "m/s"),
            "vy_q99": (self.quantile("vy", 0.99), "m/s"),
            "yaw_rate_min": (yaw_rate[0], "rad/s"),
            "yaw_rate_max": (yaw_rate[1], "rad/s"),
            "ay_abs_q50": (self.quantile("ay", 0.5, absolute=True), "m/s²"),
            "ay_abs_q99": (self.quantile("ay", 0.99, absolute=True), "m/s²"),
            "ax_q01": (self.quantile("ax", 0.01), "m/s²"),
            "ax_q99": (self.quantile("ax", 0.99), "m/s²"),
            "steer_abs_q99": (self.quantile("steer", 0.99, absolute=True), "deg"),
            "sideslip_abs_q50": (self.quantile("sideslip", 0.5, absolute=True), "deg"),
            "sideslip_abs_q99": (self.quantile("sideslip", 0.99, absolute=True), "deg"),
            "sideslip_abs_q999": (self.quantile("sideslip", 0.999, absolute=True), "deg"),
            "spun": (self.flags["spun"], "1"),
            "left_road": (self.flags["left_road"], "1"),
            "stood": (self.flags["stood"], "1"),
        }


def flags_of(recording: Recording) -> Mapping[str, object]:
    """How a drive went, as the simulation wrote it down; nothing for a real one."""
    flags = recording.provenance.get("flags")
    return flags if isinstance(flags, Mapping) else {}
