"""Stability control: a yaw moment by braking one side, when the car does not yaw as its driver
asks.

The reference is the steady yaw rate of a linear single track at this steering angle, limited by
friction at this speed and delayed as a car answers (e.g. Rajamani, "Vehicle Dynamics and Control",
chapter on electronic stability control). The control acts between two thresholds of the yaw rate's
error, with hysteresis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from vehest.constants import GRAVITY
from vehest.simulation.plant.multi_body import MultiBodyPlant


@dataclass(frozen=True)
class StabilityState:
    """State of the stability control."""

    reference: float = 0.0  # yaw rate that the car is to follow [rad/s]
    active: bool = False  # whether the control intervenes
    # yaw moment that it asks for, positive to the left [N m]; the plant's third input
    moment: float = 0.0


@dataclass(frozen=True)
class StabilityControl:
    """Stability control that is fitted to a car; `stability_control` makes one."""

    wheelbase: float  # distance between the axles [m]
    understeer_gradient: float  # understeer gradient of the linear single track [rad s²/m]
    yaw_inertia: float  # yaw inertia of the car [kg m²]
    grip: float  # lateral acceleration that friction allows on a dry road [m/s²]
    largest_moment: float  # largest yaw moment of braking one side on a dry road [N m]
    # moment per error of the yaw rate and per inertia [1/s]; assumed: the car follows within 50 ms,
    # and cars get all of the moment at about 7 degrees a second. With half of it, a car whose rear
    # slides is lost before the brakes are fully on.
    gain: float = 20.0
    on_above: float = 0.07  # error of the yaw rate at which it intervenes [rad/s]; assumed
    off_below: float = 0.03  # error below which it stops intervening [rad/s]; assumed
    lag: float = 0.1  # time constant of the reference [s]; assumed
    slowest: float = 5.0  # speed below which it does nothing [m/s]; assumed

    def step(
        self,
        before: StabilityState,
        interval: float,
        *,
        steer: float,
        vx: float,
        yaw_rate: float,
        friction: float = 1.0,
    ) -> StabilityState:
        """The state one interval later.

        Parameters
        ----------
        before : StabilityState
            The last state.
        interval : float
            Time since then [s].
        steer : float
            Road-wheel angle [rad].
        vx, yaw_rate : float
            Measured speed [m/s] and yaw rate [rad/s].
        friction : float
            Scale of the tyres' friction that the control assumes.

        Returns
        -------
        StabilityState
            Below ``slowest`` the control is off and its reference follows the measured yaw rate.
            The yaw moment is limited by friction, and positive where the car should turn further to
            the left.
        """
        if vx < self.slowest:
            return StabilityState(reference=yaw_rate)
        target_yaw_rate = vx * steer / (self.wheelbase + self.understeer_gradient * vx**2)
        allowed = friction * self.grip / vx
        target_yaw_rate = max(-allowed, min(allowed, target_yaw_rate))
        reference = target_yaw_rate + (before.reference - target_yaw_rate) * math.exp(
            -interval / self.lag
        )
        error = reference - yaw_rate
        active = abs(error) > (self.off_below if before.active else self.on_above)
        limit = friction * self.largest_moment
        moment = max(-limit, min(limit, self.gain * self.yaw_inertia * error)) if active else 0.0
        return StabilityState(reference, active, moment)


def stability_control(plant: MultiBodyPlant) -> StabilityControl:
    """A control for this car, from its parameters.

    Its largest moment is that of one side's friction under its static load. A side that is braked
    against a spin carries more; the rest is left for cornering.

    Parameters
    ----------
    plant : MultiBodyPlant
        Its tyres' cornering stiffnesses give the understeer gradient, its longitudinal friction and
        tracks the largest moment.
    """
    parameters = plant.parameters
    cornering_front = abs(parameters.tire.p_ky1)
    cornering_rear = abs(parameters.tire_rear.p_ky1)
    friction = min(parameters.tire.p_dx1, parameters.tire_rear.p_dx1)
    brake_arm = 0.25 * (parameters.T_f + parameters.T_r)
    return StabilityControl(
        wheelbase=plant.wheelbase,
        understeer_gradient=(1.0 / cornering_front - 1.0 / cornering_rear) / GRAVITY,
        yaw_inertia=parameters.I_z,
        grip=plant.grip,
        largest_moment=friction * 0.5 * parameters.m * GRAVITY * brake_arm,
    )
