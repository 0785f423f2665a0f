"""Settings of an alignment."""

from __future__ import annotations

import math
from dataclasses import dataclass

from vehest.data.errors import ConfigurationError

TILT_LAG_GAIN = 0.005
"""Prior standard deviation of the part of an acceleration's derivative that gravity adds through
roll or pitch [s].

The body follows late, say 0.1 times 50 ms.
"""

DEFAULT_CUTOFF_HZ = 2.0  # Hz, cut-off where none is set
# smallest standard deviation of the kernel, in samples; a narrower sampled Gaussian has no exact
# derivatives
MIN_KERNEL_SAMPLES = 1.5
# largest ratio of the cut-off to the rate
MAX_CUTOFF_SHARE = math.sqrt(math.log(2.0)) / (2.0 * math.pi * MIN_KERNEL_SAMPLES)

QUANTITIES: dict[str, tuple[str, ...]] = {
    "lever_arm": ("lever_x", "lever_y"),
    "mounting": ("yaw",),
    "delay": ("delay",),
    "offsets": ("offset_ax", "offset_ay", "offset_yaw_rate"),
    "steering_ratio": ("steering_ratio", "steering_offset", "understeer_gradient"),
}
"""Quantities that can be asked for, with their parameters."""


@dataclass(frozen=True)
class AlignmentSettings:
    """Quantities to estimate, and how. Raises `ConfigurationError`: nothing or something unknown is
    asked for, or a value is wrong.
    """

    estimate: tuple[str, ...]  # names of the quantities to estimate, in `QUANTITIES`
    # cut-off of the low-pass that both sides go through [Hz]; None: see `cutoff_at`
    cutoff_hz: float | None = None
    max_delay: float = 0.5  # largest delay that is searched, either way [s]
    # standard deviation of roll and pitch besides those that follow the accelerations [rad]; 0:
    # levelled
    tilt: float = 0.001
    wheelbase: float | None = None  # distance between the axles, needed for the steering ratio [m]
    # channel of the steering ratio; None: ``handwheel``, or ``steer`` where there is none
    steering_channel: str | None = None
    max_ay: float = 3.0  # lateral acceleration up to which steering is taken as linear [m/s²]
    min_speed: float = 5.0  # speed from which the steering relation is used [m/s]

    def __post_init__(self) -> None:
        offered = ", ".join(QUANTITIES)
        if not self.estimate:
            raise ConfigurationError(f"name what to estimate: one or more of {offered}")
        unknown = [name for name in self.estimate if name not in QUANTITIES]
        if unknown:
            raise ConfigurationError(f"'{unknown[0]}' cannot be estimated; there are: {offered}")
        for name in ("cutoff_hz", "max_delay", "max_ay", "min_speed", "wheelbase"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ConfigurationError(f"alignment: {name} must be positive, not {value}")
        if not (math.isfinite(self.tilt) and self.tilt >= 0):
            raise ConfigurationError(
                f"alignment: tilt must be zero or positive [rad], not {self.tilt}"
            )

    def cutoff_at(self, rate_hz: float) -> float:
        """-3 dB frequency of the low-pass [Hz]: as set, 2 Hz, or what a rate below 23 Hz allows.

        Parameters
        ----------
        rate_hz : float
            Of the recording [Hz].
        """
        if self.cutoff_hz is not None:
            return self.cutoff_hz
        return min(DEFAULT_CUTOFF_HZ, MAX_CUTOFF_SHARE * rate_hz)

    @property
    def kinematic(self) -> tuple[str, ...]:
        """Quantities that need a reference, in the order of `QUANTITIES`."""
        return tuple(
            name for name in QUANTITIES if name in self.estimate and name != "steering_ratio"
        )
