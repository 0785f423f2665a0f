"""Parameters of the planar plant: a small four-wheel-drive car with one electric motor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any

from pydantic import Field

from vehest.data.errors import ConfigurationError
from vehest.data.schema import validated

Positive = Annotated[float, Field(gt=0.0)]  # number above 0
ZeroOrPositive = Annotated[float, Field(ge=0.0)]  # number of 0 or above
Share = Annotated[float, Field(ge=0.0, le=1.0)]  # number from 0 to 1

PLANAR = "planar"
"""Value of ``plant`` in a vehicle's configuration that selects this plant; without it the vehicle
is the multi-body plant's.
"""


@dataclass(frozen=True)
class PlanarCar:
    """A car that the planar plant can drive; a parameter of zero takes its effect away."""

    name: str  # name of the vehicle in recordings
    mass: Positive  # mass [kg]
    yaw_inertia: Positive  # about the vertical axis through the centre of gravity [kg m²]
    cg_to_front_axle: Positive  # distance from the centre of gravity [m]
    cg_to_rear_axle: Positive  # distance from the centre of gravity [m]
    track: Positive  # distance between left and right wheels, of both axles [m]
    cg_height: ZeroOrPositive  # height of the centre of gravity [m]
    wheel_radius: Positive  # radius of the wheels [m]
    wheel_inertia: Positive  # inertia of one wheel with its shafts [kg m²]
    motor_inertia: Positive  # inertia of the motor and the gears, referred to the wheels [kg m²]
    torque_constant: Positive  # torque at the wheels, all four together, per motor current [N m/A]
    coulomb_torque: ZeroOrPositive  # friction of motor and gears, referred to the wheels [N m]
    # friction of motor and gears that is proportional to the speed of the wheels [N m s/rad]
    viscous_torque: ZeroOrPositive
    # lock of the front and of the rear differential: torque per difference of a wheel's speed to
    # its axle's mean [N m s/rad]
    axle_lock: ZeroOrPositive
    # lock of the centre differential: torque on a wheel per difference of its axle's mean speed to
    # that of all [N m s/rad]
    centre_lock: ZeroOrPositive
    air_drag: ZeroOrPositive  # drag force over the square of the speed [N s²/m²]
    friction: Positive  # peak friction of the tyres at a quarter of the weight [1]
    # relative loss of friction per relative gain of load [1]
    load_sensitivity: Annotated[float, Field(ge=0.0, le=0.5)]
    # front axle: B of the magic formula sin(C atan(B s)), s the combined slip [1]
    stiffness_factor_front: Positive
    # rear axle: B of the magic formula sin(C atan(B s)), s the combined slip [1]
    stiffness_factor_rear: Positive
    shape_factor: Annotated[float, Field(gt=0.0, le=2.0)]  # C of the magic formula [1]
    relaxation_length: Positive  # relaxation length of the tyres at small slip [m]
    carcass_damping: Share  # share of the slip that acts at once, without relaxation [1]
    roll_share_front: Share  # share of the lateral load transfer that the front axle takes [1]
    # time constant with which load transfer, roll and pitch follow the accelerations [s]
    load_time: Positive
    roll_gradient: ZeroOrPositive  # roll angle of the body over lateral acceleration [rad s²/m]
    # pitch angle of the body over longitudinal acceleration [rad s²/m]
    pitch_gradient: ZeroOrPositive
    largest_steer: Positive  # road-wheel angle at the stop [rad]
    steering_rate: Positive  # largest steering velocity of the servo [rad/s]
    steering_time: Positive  # time constant of the servo [s]
    current_time: Positive  # time constant of the motor's current [s]
    largest_current: Positive  # largest magnitude of the motor current [A]

    @property
    def wheelbase(self) -> float:
        """Distance between the axles [m]."""
        return self.cg_to_front_axle + self.cg_to_rear_axle

    @property
    def parameters(self) -> dict[str, float]:
        """All values except the name, by their names."""
        return {name: float(getattr(self, name)) for name in PARAMETERS}


PARAMETERS = tuple(
    entry.name for entry in fields(PlanarCar) if entry.name != "name"
)  # names of the plant's parameters, in order


@dataclass(frozen=True)
class PlanarVehicle:
    """Content of a vehicle's configuration for the planar plant."""

    name: str  # name of the vehicle
    plant: str  # `PLANAR`
    parameters: Annotated[dict[str, Any], "a mapping"]  # parameter of `PlanarCar` -> value


def planar_car_from_configuration(configuration: Mapping[str, Any]) -> PlanarCar:
    """A car from the keys ``name``, ``plant`` and ``parameters``; raises `ConfigurationError` where
    one is missing, unknown or wrong.
    """
    vehicle = validated(
        PlanarVehicle, dict(configuration), "planar vehicle", error=ConfigurationError
    )
    return _checked(vehicle.name, vehicle.parameters)


def scaled_car(car: PlanarCar, factors: Mapping[str, float]) -> PlanarCar:
    """The car with some of its parameters scaled.

    Parameters
    ----------
    car : PlanarCar
        The car of the configuration.
    factors : mapping
        Parameter -> scale; parameters that are not named keep their value.

    Raises
    ------
    ConfigurationError
        A name is no parameter, or a scaled value makes no sense.
    """
    unknown = sorted(set(factors) - set(PARAMETERS))
    if unknown:
        raise ConfigurationError(
            f"vary: '{unknown[0]}' is no parameter of vehicle '{car.name}' that can be scaled"
        )
    return _checked(
        car.name, {name: value * factors.get(name, 1.0) for name, value in car.parameters.items()}
    )


def _checked(name: str, parameters: dict[str, Any]) -> PlanarCar:
    """A PlanarCar whose values lie within the bounds of their annotations; raises
    `ConfigurationError` otherwise.
    """
    return validated(
        PlanarCar, {"name": name, **parameters}, f"vehicle '{name}'", error=ConfigurationError
    )
