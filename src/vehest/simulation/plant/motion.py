"""True motion of a simulated car, which sensors measure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vehest.constants import FloatArray

WHEELS = ("fl", "fr", "rl", "rr")
"""Order of the columns of (T, 4) arrays: front left, front right, rear left, rear right."""


@dataclass(frozen=True, eq=False)
class Motion:
    """True motion of the centre of gravity of the car body, uniformly sampled; arrays have shape (T,) or (T, 4).

    Axes are those of ISO 8855: x forward, y left, z up; a left turn has positive steer, yaw_rate and ay. They yaw with
    the car and stay level with the road; columns of (T, 4) arrays are WHEELS.

    Args:
        rate_hz: sampling rate [Hz].
        x, y: position on the ground [m].
        yaw: heading, counter-clockwise from the x axis, not wrapped [rad].
        vx, vy: velocity [m/s].
        yaw_rate: [rad/s].
        ax, ay: acceleration, dvx/dt - vy·yaw_rate and dvy/dt + vx·yaw_rate [m/s²].
        steer: road-wheel angle of the front axle [rad].
        roll: of the body against the road, positive with the left side up, as in a left turn [rad].
        pitch: of the body against its place at rest, positive with the nose down, as when braking [rad].
        roll_rate, pitch_rate: their derivatives [rad/s].
        wheel_speed: rotational speeds (T, 4) [rad/s].
        tyre_fx, tyre_fy: forces of the road on the tyres, along and across the body, not the wheel (T, 4) [N].
        tyre_fz: wheel loads, positive (T, 4) [N].
        friction: scale of the tyres' friction in effect (T,), 1 for the vehicle's own tyres on a dry road.
        bank: of the road, positive with its left side higher [rad].
        grade: of the road, positive downhill [rad].
        motor_speed: of an electric drive motor, referred to the wheels [rad/s]; none where the car has no such motor.
        motor_current: its torque-producing current [A]; likewise.
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
    roll_rate: FloatArray
    pitch_rate: FloatArray
    wheel_speed: FloatArray
    tyre_fx: FloatArray
    tyre_fy: FloatArray
    tyre_fz: FloatArray
    friction: FloatArray
    bank: FloatArray
    grade: FloatArray
    motor_speed: FloatArray | None = None
    motor_current: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.x)

    @property
    def sideslip(self) -> FloatArray:
        """atan2(vy, vx) [rad], shape (T,)."""
        return np.arctan2(self.vy, self.vx)
