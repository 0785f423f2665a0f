"""What a simulated car really did: the truth that sensors measure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Motion:
    """True motion of the centre of gravity of the car body, uniformly sampled; every array has shape (T,).

    Axes are those of ISO 8855: x forward, y left, z up; a left turn has positive steer, yaw_rate and ay.

    Args:
        rate_hz: sampling rate [Hz].
        x, y: position on the ground [m].
        yaw: heading, counter-clockwise from the x axis, not wrapped [rad].
        vx, vy: velocity in the axes of the yawed, level body [m/s].
        yaw_rate: [rad/s].
        ax, ay: acceleration in the same axes, dvx/dt - vy·yaw_rate and dvy/dt + vx·yaw_rate [m/s²].
        steer: road-wheel angle of the front axle [rad].
        roll: positive with the left side up, as in a left turn [rad].
        pitch: positive with the nose down, as when braking [rad].
        wheel_speed_fl, wheel_speed_fr, wheel_speed_rl, wheel_speed_rr: rotational speeds [rad/s].
    """

    rate_hz: float
    x: FloatArray
    y: FloatArray
    yaw: FloatArray
    vx: FloatArray
    vy: FloatArray
    yaw_rate: FloatArray
    ax: FloatArray
    ay: FloatArray
    steer: FloatArray
    roll: FloatArray
    pitch: FloatArray
    wheel_speed_fl: FloatArray
    wheel_speed_fr: FloatArray
    wheel_speed_rl: FloatArray
    wheel_speed_rr: FloatArray

    def __len__(self) -> int:
        return len(self.x)

    @property
    def sideslip(self) -> FloatArray:
        """atan2(vy, vx) [rad], shape (T,)."""
        return np.arctan2(self.vy, self.vx)
