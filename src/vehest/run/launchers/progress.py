"""Counts the groups of a launch, and estimates when the last will be done."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass
class LaunchProgress:
    """Of so many groups those that are done, running and failed."""

    total: int
    core_seconds: float = 0.0
    done: int = 0
    failed: int = 0
    _running: set[int] = field(default_factory=set)

    def runs(self, position: int) -> None:
        """A group has begun, or goes on."""
        self._running.add(position)

    def ended(self, position: int, seconds: float, *, failed: bool) -> None:
        """A group has ended after so many seconds of a core."""
        self._running.discard(position)
        self.core_seconds += seconds
        self.failed += failed
        self.done += not failed

    def row(self, cores: int) -> Mapping[str, str]:
        """What is shown, heading -> value; nothing for a single group.

        The time left is that of groups which take as long as those that ended; running ones count half.
        """
        if self.total < 2:
            return {}
        running, ended = len(self._running), self.done + self.failed
        waiting = self.total - ended - running
        mean = self.core_seconds / max(1, ended)
        left = max((waiting + 0.5 * running) * mean / max(1, cores), 0.5 * mean if running else 0.0)
        counts = {"done": self.done, "running": running, "waiting": waiting, "failed": self.failed}
        texts = {"core hours": f"{self.core_seconds / 3600:.3f}", "cores": str(cores), "left": duration(left) if ended else ""}
        return {name: str(value) for name, value in counts.items()} | texts


def duration(seconds: float) -> str:
    """A time for people."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
