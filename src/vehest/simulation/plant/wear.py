"""Loss of grip over a stint: cold tyres, and wear."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field, PositiveFloat

Share = Annotated[float, Field(ge=0.0, le=0.5)]  # number from 0 to 0.5


@dataclass(frozen=True)
class Stint:
    """Friction of the tyres over the time of a drive, over that of warm, new tyres; all values are
    assumed.

    factor(t) = (1 - cold exp(-t/warm_time)) (1 - wear min(t/wear_time, 1))
    """

    cold: Share = 0.0  # share that cold tyres lack at the first sample
    warm_time: PositiveFloat = 120.0  # time constant of warming up [s]
    wear: Share = 0.0  # share that is lost over ``wear_time``
    wear_time: PositiveFloat = 1200.0  # time over which ``wear`` is lost [s]

    def friction_at(self, time: float) -> float:
        """Factor of the tyres' friction at a time after the first sample [s]; before it, that of
        the first.

        Returns
        -------
        float
            1 for warm, new tyres; it multiplies the surface's scale.
        """
        since = max(time, 0.0)
        return (1.0 - self.cold * math.exp(-since / self.warm_time)) * (
            1.0 - self.wear * min(since / self.wear_time, 1.0)
        )
