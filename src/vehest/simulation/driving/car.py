"""The car as its driver knows it: size, limits, and steering over lateral acceleration.

Sizes and limits are the vehicle's parameters. The steering is measured: the car goes into an ever
tighter turn at constant speed until it follows no more, as in the constant-speed test of ISO 4138.
"""

from __future__ import annotations

import json
import math
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vehest.data.errors import ConfigurationError
from vehest.simulation.plant.handling import ramp_steer
from vehest.simulation.plant.multi_body import MultiBodyPlant

# speed of the measurement [m/s], or half of the top speed if that is less; assumed
TEST_SPEED = 25.0
# share of the largest lateral acceleration that counts as the grip, since the last bit takes far
# more steering; assumed
USEFUL_SHARE = 0.985
# difference between lateral acceleration and speed times yaw rate [m/s²] from which on a car spins;
# assumed
UNSTEADY = 0.5
MAX_GRIP_SHARE = 0.85
"""Share of the lateral acceleration at which a car began to spin, or lifted a wheel, that a driver
counts as all of the grip; assumed.
"""
# share of the driven axle's static grip that a driver uses for accelerating straight ahead; assumed
TRACTION_SHARE = 0.8
DRAG_AREA = 0.25
"""Drag coefficient times frontal area, per square of the width; assumed: 0.7 m² for a car 1.7 m
wide. ``driver: drag_area`` replaces it.
"""
AIR_DENSITY = 1.2  # [kg/m³]
POWER_SHARE = 0.9  # share of the engine's power that a driver uses; assumed


@dataclass(frozen=True)
class Car:
    """A car as its driver knows it, on a dry road."""

    name: str  # name of the vehicle
    wheelbase: float  # [m]
    width: float  # width over all [m]
    front_share: float  # share of the weight on the front axle
    grip: float  # largest steady lateral acceleration [m/s²]
    driving_share: float  # share of the grip that is available for accelerating straight ahead
    power_per_mass: float  # largest power that is used per mass [W/kg]
    top_speed: float  # largest speed that is driven [m/s]
    drag: float  # deceleration by the air per square of the speed [1/m]
    steering_rate: float  # largest steering velocity of the road wheels [rad/s]
    largest_steer: float  # largest angle of the road wheels [rad]
    # lateral accelerations of the measured points, from 0 to the grip, (M,) [m/s²]
    lateral_acceleration: tuple[float, ...]
    # road-wheel angle beyond wheelbase times curvature at these, (M,) [rad]
    excess_steer: tuple[float, ...]
    # magnitude of the slip angle of the rear axle at these, (M,) [rad]
    rear_slip: tuple[float, ...]

    def steer_for(
        self, curvature: float, lateral_acceleration: float, friction: float = 1.0
    ) -> float:
        """Road-wheel angle [rad] of a steady turn; beyond the grip as much as at the grip.

        Parameters
        ----------
        curvature : float
            Of the path [1/m], positive to the left.
        lateral_acceleration : float
            In the turn [m/s²], positive to the left.
        friction : float
            Scale of the tyres' friction. It scales forces and slip angles alike, because a tyre's
            cornering stiffness hardly depends on it.

        Returns
        -------
        float
            Positive to the left: wheelbase times curvature, plus the measured excess angle.
        """
        excess = self._at(self.excess_steer, lateral_acceleration, friction)
        return self.wheelbase * curvature + math.copysign(friction * excess, lateral_acceleration)

    def sideslip_for(
        self, curvature: float, lateral_acceleration: float, friction: float = 1.0
    ) -> float:
        """Sideslip [rad] at the centre of gravity in the turn of `steer_for`.

        Parameters
        ----------
        curvature, lateral_acceleration, friction : float
            As of `steer_for`.

        Returns
        -------
        float
            Positive where the car points to the right of its path, as in a slow left turn; at high
            lateral acceleration the slip of the rear axle makes it negative.
        """
        slip = self._at(self.rear_slip, lateral_acceleration, friction)
        return (self.wheelbase * self.front_share) * curvature - math.copysign(
            friction * slip, lateral_acceleration
        )

    def resistance(self, speed: float, yaw_rate: float, steer: float, sideslip: float) -> float:
        """Deceleration along the path [m/s²] by the air, and by tyres that slip in a turn.

        Parameters
        ----------
        speed : float
            Over the ground [m/s].
        yaw_rate : float
            Positive to the left [rad/s].
        steer, sideslip : float
            Road-wheel angle and sideslip, positive to the left [rad].

        Returns
        -------
        float
            Positive against the motion. The part of the turn is yaw rate times speed, times how far
            the front wheels (weighted by their share of the load) and the car itself point off the
            path.
        """
        return self.drag * speed**2 + yaw_rate * speed * (
            self.front_share * math.sin(steer) - math.sin(sideslip)
        )

    def _at(self, values: tuple[float, ...], lateral_acceleration: float, friction: float) -> float:
        """Linear interpolation over lateral acceleration, scaled by friction; held at the grip
        beyond it.
        """
        grid = self.lateral_acceleration
        lateral = min(abs(lateral_acceleration) / friction, grid[-1])
        after = min(max(bisect_right(grid, lateral), 1), len(grid) - 1)
        share = (lateral - grid[after - 1]) / (grid[after] - grid[after - 1])
        return values[after - 1] + share * (values[after] - values[after - 1])


def car_of(plant: MultiBodyPlant) -> Car:
    """The car as its driver knows it; measured once a process for each vehicle and step.

    Parameters
    ----------
    plant : MultiBodyPlant
        The car and its integration step. Both, and the vehicle's ``driver`` values, identify the
        result in the cache of this process.

    Returns
    -------
    Car
        Grip, excess steer and rear slip are read off a slow ramp of the steering angle
        (`ramp_steer`) at TEST_SPEED, or at half of the top speed; ``driver`` of the vehicle
        replaces single values.

    Raises
    ------
    ConfigurationError
        A value under ``driver`` is unknown, not finite or not positive, or the car's largest steady
        lateral acceleration is below 1 m/s².
    """
    driver_values = dict(plant.vehicle.driver)
    vehicle = plant.vehicle
    values = [vehicle.name, vehicle.parameter_set, vehicle.overrides, driver_values, plant.step]
    key = json.dumps(values, sort_keys=True)
    if key not in _CARS:
        _CARS[key] = _driver_view(plant, driver_values)
    return _CARS[key]


_CARS: dict[str, Car] = {}  # cars that were measured in this process, by vehicle and step
# names of the values that ``driver`` of a vehicle may replace
_DRIVER_VALUES = ("drag_area", "grip", "power_per_mass", "top_speed")


def _driver_view(plant: MultiBodyPlant, driver_values: Mapping[str, Any]) -> Car:
    """The Car of a plant: parameters of the vehicle, the measured ramp, and the ``driver`` values
    that replace defaults.
    """
    vehicle = plant.vehicle
    parameters = plant.parameters
    unknown = sorted(set(driver_values) - set(_DRIVER_VALUES))
    if unknown:
        raise ConfigurationError(
            f"vehicle '{vehicle.name}': unknown values {unknown} of its driver; known ones: "
            f"{', '.join(_DRIVER_VALUES)}"
        )

    def driver_value(name: str, default: float) -> float:
        value = float(driver_values.get(name, default))
        if not (math.isfinite(value) and value > 0.0):
            raise ConfigurationError(
                f"vehicle '{vehicle.name}': the driver's {name} must be positive, not {value}"
            )
        return value

    front_share = parameters.b / (parameters.a + parameters.b)
    driven_axle = min(
        _ratio(front_share, parameters.T_se), _ratio(1.0 - front_share, 1.0 - parameters.T_se)
    )
    longitudinal = parameters.longitudinal
    top_speed = driver_value("top_speed", longitudinal.v_max)
    accelerations, steers, slips = _measure(plant, min(TEST_SPEED, 0.5 * top_speed))
    return Car(
        name=vehicle.name,
        wheelbase=plant.wheelbase,
        width=parameters.w,
        front_share=front_share,
        grip=driver_value("grip", accelerations[-1]),
        driving_share=min(TRACTION_SHARE * driven_axle, TRACTION_SHARE),
        power_per_mass=driver_value(
            "power_per_mass", POWER_SHARE * longitudinal.a_max * longitudinal.v_switch
        ),
        top_speed=top_speed,
        drag=0.5
        * AIR_DENSITY
        / parameters.m
        * driver_value("drag_area", DRAG_AREA * parameters.w**2),
        steering_rate=parameters.steering.v_max,
        largest_steer=parameters.steering.max,
        lateral_acceleration=accelerations,
        excess_steer=steers,
        rear_slip=slips,
    )


def _ratio(load: float, torque: float) -> float:
    """Load share of an axle over its torque share: the acceleration, over the grip, at which it
    would slip; infinite for an axle that is not driven.
    """
    return load / torque if torque > 0.0 else math.inf


def _measure(
    plant: MultiBodyPlant, speed: float
) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    """Lateral accelerations [m/s²] in steps of 0.25 from zero to the largest steady one, and excess
    steer and rear slip [rad] at each.
    """
    ramp = ramp_steer(plant, speed)
    steady = ramp.vx * ramp.yaw_rate
    astray = np.flatnonzero(
        (np.abs(ramp.ay - steady) > UNSTEADY) | (ramp.tyre_fz.min(axis=1) <= 0.0)
    )
    end = int(astray[0]) if len(astray) else len(steady) - 1
    limit = int(np.argmax(steady >= USEFUL_SHARE * steady[: end + 1].max()))
    grip = (MAX_GRIP_SHARE if len(astray) and limit > 0.9 * end else 1.0) * float(steady[limit])
    if grip < 1.0:
        raise ConfigurationError(
            f"vehicle '{plant.vehicle.name}' cannot be driven around a corner at {speed:.3g} m/s: "
            "it does not follow"
        )
    ramp_values = (
        ramp.steer - plant.wheelbase * ramp.yaw_rate / ramp.vx,
        (float(plant.parameters.b) * ramp.yaw_rate - ramp.vy) / ramp.vx,
    )
    grid = np.append(np.arange(0.0, grip - 0.05, 0.25), grip)
    rising = np.maximum.accumulate(steady[: limit + 1])
    steers, slips = (
        np.interp(grid, rising, values[: limit + 1]).tolist() for values in ramp_values
    )
    return tuple(grid.tolist()), tuple(steers), tuple(slips)
