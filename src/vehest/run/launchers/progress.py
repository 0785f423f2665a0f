"""How far a launch is: groups done, running, waiting and failed, what they cost, and when the last will be done."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field


@dataclass
class LaunchProgress:
    """Counts of the groups of a launch.

    Args:
        total: groups.
        clock: reading [s]; monotonic.
    """

    total: int
    clock: Callable[[], float] = time.monotonic
    core_seconds: float = 0.0
    done: int = 0
    failed: int = 0
    _running: set[int] = field(default_factory=set)
    _begun: float | None = None

    def runs(self, position: int) -> None:
        """A group has begun, or goes on."""
        self._begun = self.clock() if self._begun is None else self._begun
        self._running.add(position)

    def ended(self, position: int, seconds: float, *, failed: bool) -> None:
        """A group has ended after so many seconds of a core."""
        self._running.discard(position)
        self.core_seconds += seconds
        self.failed += failed
        self.done += not failed

    @property
    def running(self) -> int:
        """Groups under way."""
        return len(self._running)

    @property
    def waiting(self) -> int:
        """Groups that nobody has begun."""
        return self.total - self.done - self.failed - self.running

    def seconds_left(self, cores: int) -> float | None:
        """Until all is done, if the rest takes what those that ended took; those under way count half. None before the first has ended."""
        ended = self.done + self.failed
        if not ended:
            return None
        mean = self.core_seconds / ended
        return max((self.waiting + 0.5 * self.running) * mean / max(1, cores), 0.5 * mean if self.running else 0.0)

    def row(self, cores: int) -> Mapping[str, str]:
        """What is shown, heading -> value; nothing for a single group."""
        if self.total < 2:
            return {}
        left = self.seconds_left(cores)
        counts = {"done": self.done, "running": self.running, "waiting": self.waiting, "failed": self.failed}
        return {
            **{name: str(value) for name, value in counts.items()},
            "core hours": f"{self.core_seconds / 3600:.3f}",
            "cores": str(cores),
            "left": "" if left is None else duration(left),
        }


def duration(seconds: float) -> str:
    """A time for people."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
