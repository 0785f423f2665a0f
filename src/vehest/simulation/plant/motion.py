"""True motion of a simulated car, which sensors measure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vehest.constants import FloatArray

# wheels in the order of the columns of (T, 4) arrays: front left, front right, rear left, rear
# right
WHEELS = (
    "fl",
    "fr",
    "rl",
    "rr",
)


@dataclass(frozen=True, eq=False)
class Motion:
    """True motion of the centre of gravity of the car body, uniformly sampled; arrays have shape
    (T,) or (T, 4).

    Axes are those of ISO 8855: x forward, y left, z up; a left turn has positive steer, yaw_rate
    and ay. They yaw with the car and stay level with the road; columns of (T, 4) arrays are WHEELS.
    """

    rate_hz: float  # sampling rate [Hz]
    x: FloatArray  # position on the ground [m]
    y: FloatArray  # position on the ground [m]
    yaw: FloatArray  # heading, counter-clockwise from the x axis, not wrapped [rad]
    vx: FloatArray  # forward velocity [m/s]
    vy: FloatArray  # lateral velocity [m/s]
    yaw_rate: FloatArray  # yaw rate, positive to the left [rad/s]
    ax: FloatArray  # acceleration dvx/dt - vy·yaw_rate [m/s²]
    ay: FloatArray  # acceleration dvy/dt + vx·yaw_rate [m/s²]
    steer: FloatArray  # road-wheel angle of the front axle [rad]
    # roll angle of the body against the road [rad], positive with the left side up, as in a left
    # turn
    roll: FloatArray
    # pitch angle of the body against its place at rest [rad], positive with the nose down, as when
    # braking
    pitch: FloatArray
    roll_rate: FloatArray  # derivative of the roll [rad/s]
    pitch_rate: FloatArray  # derivative of the pitch [rad/s]
    wheel_speed: FloatArray  # rotational speeds (T, 4) [rad/s]
    tyre_fx: FloatArray  # forces of the road on the tyres, along the body, not the wheel (T, 4) [N]
    tyre_fy: FloatArray  # forces of the road on the tyres across the body (T, 4) [N]
    tyre_fz: FloatArray  # wheel loads, positive (T, 4) [N]
    # scale of the tyres' friction in effect (T,), 1 for the vehicle's own tyres on a dry road
    friction: FloatArray
    bank: FloatArray  # bank of the road, positive with its left side higher [rad]
    grade: FloatArray  # grade of the road, positive downhill [rad]
    # speed of an electric drive motor, referred to the wheels [rad/s]; None where the car has no
    # such motor
    motor_speed: FloatArray | None = None
    motor_current: FloatArray | None = None  # torque-producing current of this motor [A]; likewise

    def __len__(self) -> int:
        return len(self.x)

    @property
    def sideslip(self) -> FloatArray:
        """Sideslip angle, atan2(vy, vx) [rad], shape (T,)."""
        return np.arctan2(self.vy, self.vx)
