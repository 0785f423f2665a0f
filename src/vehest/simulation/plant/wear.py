"""Loss of grip over a stint: cold tyres, and wear."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from vehest.data.errors import ConfigurationError
from vehest.data.schema import validated


@dataclass(frozen=True)
class Stint:
    """Friction of the tyres over the time of a drive, over that of warm, new tyres; all values are assumed.

    factor(t) = (1 - cold exp(-t/warm_time)) (1 - wear min(t/wear_time, 1))

    Raises:
        ConfigurationError: a share is not between 0 and 0.5, or a time not positive.
    """

    cold: float = 0.0  # share that cold tyres lack at the first sample
    warm_time: float = 120.0  # time constant of warming up [s]
    wear: float = 0.0  # share that is lost over ``wear_time``
    wear_time: float = 1200.0  # [s]

    def __post_init__(self) -> None:
        for name in ("cold", "wear"):
            if not 0.0 <= getattr(self, name) <= 0.5:
                raise ConfigurationError(f"tyres: {name} is a share between 0 and 0.5, not {getattr(self, name)}")
        for name in ("warm_time", "wear_time"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ConfigurationError(f"tyres: {name} must be positive, not {getattr(self, name)} s")

    def friction_at(self, time: float) -> float:
        """The factor at a time after the first sample [s]; before it, that of the first."""
        since = max(time, 0.0)
        return (1.0 - self.cold * math.exp(-since / self.warm_time)) * (1.0 - self.wear * min(since / self.wear_time, 1.0))


def stint_from_config(values: Any) -> Stint:
    """A stint from a drive's ``tyres``: ``{cold: 0.06, wear: 0.04}``; raises `ConfigurationError` for another name or value."""
    return validated(Stint, values, "tyres", error=ConfigurationError)
