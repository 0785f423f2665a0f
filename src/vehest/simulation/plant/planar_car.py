"""Parameters of the planar plant: a small four-wheel-drive car with one electric motor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any

from pydantic import Field

from vehest.data.errors import ConfigurationError
from vehest.data.schema import validated

Positive = Annotated[float, Field(gt=0.0)]
ZeroOrPositive = Annotated[float, Field(ge=0.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]

PLANAR = "planar"
"""Value of ``plant`` in a vehicle's configuration that selects this plant; without it the vehicle is the multi-body plant's."""


@dataclass(frozen=True)
class PlanarCar:
    """A car that the planar plant can drive; a parameter of zero takes its effect away.

    Args:
        name: in recordings.
        mass: [kg].
        yaw_inertia: about the vertical axis through the centre of gravity [kg m²].
        cg_to_front_axle, cg_to_rear_axle: distances from the centre of gravity [m].
        track: distance of left and right wheels, of both axles [m].
        cg_height: [m].
        wheel_radius: [m].
        wheel_inertia: of one wheel with its shafts [kg m²].
        motor_inertia: of the motor and the gears, referred to the wheels [kg m²].
        torque_constant: torque at the wheels, all four together, per motor current [N m/A].
        coulomb_torque: friction of motor and gears, referred to the wheels [N m].
        viscous_torque: the same, proportional to the speed of the wheels [N m s/rad].
        axle_lock: of the front and of the rear differential: torque per difference of a wheel's speed to its axle's mean [N m s/rad].
        centre_lock: of the centre differential: torque on a wheel per difference of its axle's mean speed to that of all [N m s/rad].
        air_drag: force per square of the speed [N s²/m²].
        friction: peak friction of the tyres at a quarter of the weight [1].
        load_sensitivity: relative loss of friction per relative gain of load [1].
        stiffness_factor_front, stiffness_factor_rear: B of the magic formula sin(C atan(B s)), s the combined slip [1].
        shape_factor: its C [1].
        relaxation_length: of the tyres [m].
        carcass_damping: share of the slip that acts at once, without relaxation [1].
        roll_share_front: share of the lateral load transfer that the front axle takes [1].
        load_time: time constant with which load transfer, roll and pitch follow the accelerations [s].
        roll_gradient, pitch_gradient: angles of the body per acceleration [rad s²/m].
        largest_steer: road-wheel angle at the stop [rad].
        steering_rate: of the servo, largest [rad/s].
        steering_time: time constant of the servo [s].
        current_time: time constant of the motor's current [s].
        largest_current: either sign [A].
    """

    name: str
    mass: Positive
    yaw_inertia: Positive
    cg_to_front_axle: Positive
    cg_to_rear_axle: Positive
    track: Positive
    cg_height: ZeroOrPositive
    wheel_radius: Positive
    wheel_inertia: Positive
    motor_inertia: Positive
    torque_constant: Positive
    coulomb_torque: ZeroOrPositive
    viscous_torque: ZeroOrPositive
    axle_lock: ZeroOrPositive
    centre_lock: ZeroOrPositive
    air_drag: ZeroOrPositive
    friction: Positive
    load_sensitivity: Annotated[float, Field(ge=0.0, le=0.5)]
    stiffness_factor_front: Positive
    stiffness_factor_rear: Positive
    shape_factor: Annotated[float, Field(gt=0.0, le=2.0)]
    relaxation_length: Positive
    carcass_damping: Share
    roll_share_front: Share
    load_time: Positive
    roll_gradient: ZeroOrPositive
    pitch_gradient: ZeroOrPositive
    largest_steer: Positive
    steering_rate: Positive
    steering_time: Positive
    current_time: Positive
    largest_current: Positive

    @property
    def wheelbase(self) -> float:
        """[m]."""
        return self.cg_to_front_axle + self.cg_to_rear_axle

    @property
    def parameters(self) -> dict[str, float]:
        """All values but the name."""
        return {name: float(getattr(self, name)) for name in PARAMETERS}


PARAMETERS = tuple(entry.name for entry in fields(PlanarCar) if entry.name != "name")
"""Names of the plant's parameters, in order."""


@dataclass(frozen=True)
class PlanarVehicle:
    """A vehicle's configuration."""

    name: str
    plant: str
    parameters: Annotated[dict[str, Any], "a mapping"]


def planar_car_from_configuration(configuration: Mapping[str, Any]) -> PlanarCar:
    """A car from the keys ``name``, ``plant`` and ``parameters``.

    Raises:
        ConfigurationError: a key or a parameter is missing or unknown, or a value makes no sense.
    """
    whole = validated(PlanarVehicle, dict(configuration), "planar vehicle", error=ConfigurationError)
    return _checked(whole.name, whole.parameters)


def scaled_car(car: PlanarCar, factors: Mapping[str, float]) -> PlanarCar:
    """The car with some of its parameters scaled.

    Raises:
        ConfigurationError: a name is no parameter, or the scaled value makes no sense.
    """
    unknown = sorted(set(factors) - set(PARAMETERS))
    if unknown:
        raise ConfigurationError(f"vary: '{unknown[0]}' is no parameter of vehicle '{car.name}' that can be scaled")
    return _checked(car.name, {name: value * factors.get(name, 1.0) for name, value in car.parameters.items()})


def _checked(name: str, parameters: dict[str, Any]) -> PlanarCar:
    return validated(PlanarCar, {"name": name, **parameters}, f"vehicle '{name}'", error=ConfigurationError)
