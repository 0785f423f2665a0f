"""Signals of a recording that planar motion ties together, made ready for comparing them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vehest.alignment.standstill import BoolArray
from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.derived import derivative
from vehest.data.recording import Recording
from vehest.data.runs import filled

# largest sample over the largest that a vehicle can do; beyond lies no wrong unit
MAX_EXCESS = 100.0
MAX_MISSING_SHARE = 0.05  # largest share of missing samples of a channel, which a line then bridges
# channels of the speeds of the four wheels [rad/s]
WHEELS = ("wheel_speed_fl", "wheel_speed_fr", "wheel_speed_rl", "wheel_speed_rr")


@dataclass(frozen=True, eq=False)
class Motion:
    """Complete channels of a drive, and motion that is made of them."""

    rate_hz: float  # sampling rate [Hz]
    channels: dict[str, FloatArray]  # name -> samples without gaps, (T,)
    # name of the channel of the forward velocity: the reference's own before one by wheels that
    # slip; empty if there is none
    speed: str
    velocity: str  # name of the channel of the lateral velocity; empty if there is none
    moving: BoolArray  # whether the car does not stand, (T,)

    def __contains__(self, name: object) -> bool:
        return name in self.channels

    def __getitem__(self, name: str) -> FloatArray:
        return self.channels[name]

    def __len__(self) -> int:
        return len(self.moving)

    @property
    def steering(self) -> str:
        """The channel of the steering angle; empty if there is none."""
        return next((name for name in ("steer", "handwheel") if name in self), "")

    @property
    def vx(self) -> FloatArray:
        """Forward velocity [m/s], (T,)."""
        return self[self.speed]

    @property
    def vy(self) -> FloatArray:
        """Lateral velocity of the reference [m/s], (T,)."""
        if self.velocity == "sideslip_ref":
            return self.vx * np.tan(np.clip(self["sideslip_ref"], -1.5, 1.5))
        return self[self.velocity]

    @property
    def turning(self) -> FloatArray:
        """Part of the lateral acceleration by turning, vx·yaw_rate [m/s²], (T,)."""
        return self.vx * self["yaw_rate"]

    @property
    def sliding(self) -> FloatArray:
        """Part of the lateral acceleration by sliding, d(vy)/dt [m/s²], (T,)."""
        return self.derivative(self.vy)

    @property
    def forward(self) -> FloatArray:
        """Expected ``ax``: d(vx)/dt - vy·yaw_rate, the latter where it is known [m/s²], (T,)."""
        gained = self.derivative(self.vx)
        return (
            gained - self.vy * self["yaw_rate"] if self.velocity and "yaw_rate" in self else gained
        )

    @property
    def wheels(self) -> FloatArray:
        """Mean of the four wheel speeds [rad/s], (T,)."""
        return np.asarray(np.mean([self[name] for name in WHEELS], axis=0), dtype=np.float64)

    def derivative(self, samples: FloatArray) -> FloatArray:
        """Derivative by time, with central differences, which delay nothing.

        Parameters
        ----------
        samples : FloatArray
            (T,), without gaps.

        Returns
        -------
        FloatArray
            (T,), per second; one-sided differences at both ends, zeros for a single sample.
        """
        return derivative(samples, self.rate_hz)

    def slower(self, factor: int) -> Motion:
        """Means of so many samples each, at a rate that is so many times slower.

        Parameters
        ----------
        factor : int
            At least 1; samples at the end that do not fill a mean are dropped.

        Returns
        -------
        Motion
            ``moving`` where all samples of a mean are.
        """
        if factor == 1:
            return self
        count = len(self) // factor
        channels = {
            name: samples[: count * factor].reshape(count, factor).mean(axis=1)
            for name, samples in self.channels.items()
        }
        moving = np.asarray(
            self.moving[: count * factor].reshape(count, factor).all(axis=1), dtype=bool
        )
        return replace(self, rate_hz=self.rate_hz / factor, channels=channels, moving=moving)

    def corrected(self, factors: dict[str, float]) -> Motion:
        """The motion with some channels multiplied by factors."""
        return replace(
            self,
            channels={
                name: samples * factors.get(name, 1.0) for name, samples in self.channels.items()
            },
        )


def motion_of(recording: Recording, moving: BoolArray) -> Motion:
    """Channels of a recording that are complete, or nearly, and not larger than a wrong unit
    explains.

    Parameters
    ----------
    recording : Recording
        Channels with a few gaps (MAX_MISSING_SHARE) are bridged by lines, others left out.
    moving : BoolArray
        Where the car does not stand, (T,).

    Returns
    -------
    Motion
        Its speed is vx_ref, else vx; its lateral velocity vy_ref, else that of sideslip_ref.
    """
    channels = {
        name: complete
        for name in recording.channels
        if (complete := _bridged(recording, name)) is not None
    }
    speed = next((name for name in ("vx_ref", "vx") if name in channels), "")
    velocity = (
        next((name for name in ("vy_ref", "sideslip_ref") if name in channels), "") if speed else ""
    )
    return Motion(recording.rate_hz, channels, speed, velocity, moving)


def _bridged(recording: Recording, name: str) -> FloatArray | None:
    """Samples of a channel without gaps; None where too many are missing, or one is beyond
    MAX_EXCESS times what is possible.
    """
    if np.isnan(recording[name]).mean() > MAX_MISSING_SHARE:
        return None
    samples = filled(recording[name])
    described = CHANNELS[name]
    bound = MAX_EXCESS * max(abs(described.low), abs(described.high))
    return None if np.abs(samples).max() > bound else samples


def rms(samples: FloatArray) -> float:
    """Root mean square of samples."""
    return float(np.sqrt(np.mean(np.square(samples))))
