"""What an alignment estimates, and how."""

from __future__ import annotations

import math
from dataclasses import dataclass

from vehest.data.errors import ConfigurationError

TILT_LAG_GAIN = 0.005
"""Prior standard deviation of the part of an acceleration's derivative that gravity adds through roll or pitch [s].

The body follows late, say 0.1 times 50 ms.
"""

QUANTITIES: dict[str, tuple[str, ...]] = {
    "lever_arm": ("lever_x", "lever_y"),
    "mounting": ("yaw",),
    "delay": ("delay",),
    "offsets": ("offset_ax", "offset_ay", "offset_yaw_rate"),
    "steering_ratio": ("steering_ratio", "steering_offset", "understeer_gradient"),
}
"""What can be asked for, and the parameters that it consists of."""


@dataclass(frozen=True)
class AlignmentSettings:
    """What to estimate, and how.

    Args:
        estimate: names in `QUANTITIES`.
        cutoff_hz: -3 dB frequency of the low-pass filter that both sides go through [Hz].
        max_delay: largest delay that is looked for, either way [s].
        tilt: standard deviation of the body's roll and pitch beyond what follows the accelerations [rad]; 0 says that the accelerations are
            free of gravity, as a levelled inertial system delivers them.
        wheelbase: needed for the steering ratio [m].
        steering_channel: what the steering ratio is estimated of; by default ``handwheel``, or ``steer`` where there is none.
        max_ay: lateral acceleration up to which steering is taken as linear [m/s²].
        min_speed: speed from which the steering relation is used [m/s].

    Raises:
        ConfigurationError: nothing or something unknown is asked for, or a value makes no sense.
    """

    estimate: tuple[str, ...]
    cutoff_hz: float = 2.0
    max_delay: float = 0.5
    tilt: float = 0.001
    wheelbase: float | None = None
    steering_channel: str | None = None
    max_ay: float = 3.0
    min_speed: float = 5.0

    def __post_init__(self) -> None:
        offered = ", ".join(QUANTITIES)
        if not self.estimate:
            raise ConfigurationError(f"say what to estimate: one or more of {offered}")
        unknown = [name for name in self.estimate if name not in QUANTITIES]
        if unknown:
            raise ConfigurationError(f"'{unknown[0]}' cannot be estimated; there are: {offered}")
        for name in ("cutoff_hz", "max_delay", "max_ay", "min_speed"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ConfigurationError(f"alignment: {name} must be positive, not {value}")
        if not (math.isfinite(self.tilt) and self.tilt >= 0):
            raise ConfigurationError(f"alignment: tilt must be zero or positive [rad], not {self.tilt}")
        if "steering_ratio" in self.estimate and self.wheelbase is None:
            raise ConfigurationError("the steering ratio needs the wheelbase [m]")
        if self.wheelbase is not None and not (math.isfinite(self.wheelbase) and self.wheelbase > 0):
            raise ConfigurationError(f"alignment: the wheelbase must be positive, not {self.wheelbase}")

    @property
    def kinematic(self) -> tuple[str, ...]:
        """What needs a reference, in the order of `QUANTITIES`."""
        return tuple(name for name in QUANTITIES if name in self.estimate and name != "steering_ratio")
