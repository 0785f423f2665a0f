"""Parameters of the planar plant: a small four-wheel-drive car with one electric motor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from vehest.data.errors import ConfigurationError
from vehest.simulation.plant.parameters import is_number

PLANAR = "planar"
"""What ``plant`` of a vehicle's configuration says to be this plant's; without it the vehicle is the multi-body plant's."""


@dataclass(frozen=True)
class PlanarCar:
    """A car that the planar plant can drive.

    Args:
        name: what recordings call it.
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

    Raises:
        ConfigurationError: a value is not a finite number, or not positive where it must be.
    """

    name: str
    mass: float
    yaw_inertia: float
    cg_to_front_axle: float
    cg_to_rear_axle: float
    track: float
    cg_height: float
    wheel_radius: float
    wheel_inertia: float
    motor_inertia: float
    torque_constant: float
    coulomb_torque: float
    viscous_torque: float
    axle_lock: float
    centre_lock: float
    air_drag: float
    friction: float
    load_sensitivity: float
    stiffness_factor_front: float
    stiffness_factor_rear: float
    shape_factor: float
    relaxation_length: float
    carcass_damping: float
    roll_share_front: float
    load_time: float
    roll_gradient: float
    pitch_gradient: float
    largest_steer: float
    steering_rate: float
    steering_time: float
    current_time: float
    largest_current: float

    def __post_init__(self) -> None:
        for name in PARAMETERS:
            value = getattr(self, name)
            if not is_number(value):
                raise ConfigurationError(f"vehicle '{self.name}': {name} must be a finite number, not {value!r}")
            if not (value > 0.0 or (value == 0.0 and name in MAY_BE_ZERO)):
                raise ConfigurationError(
                    f"vehicle '{self.name}': {name} must be {'zero or ' if name in MAY_BE_ZERO else ''}positive, not {value}"
                )
        for name, most in (("shape_factor", 2.0), ("load_sensitivity", 0.5), ("roll_share_front", 1.0), ("carcass_damping", 1.0)):
            if getattr(self, name) > most:
                raise ConfigurationError(f"vehicle '{self.name}': {name} must be at most {most:g}, not {getattr(self, name)}")

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

MAY_BE_ZERO = frozenset(
    {
        "cg_height",
        "coulomb_torque",
        "viscous_torque",
        "axle_lock",
        "centre_lock",
        "air_drag",
        "load_sensitivity",
        "carcass_damping",
        "roll_share_front",
        "roll_gradient",
        "pitch_gradient",
    }
)
"""Parameters of effects that may be absent."""


def planar_car_from_configuration(configuration: Mapping[str, Any]) -> PlanarCar:
    """A car from the keys ``name``, ``plant`` and ``parameters``.

    Raises:
        ConfigurationError: a key or a parameter is missing or unknown, or see PlanarCar.
    """
    known = {"name", "plant", "parameters"}
    unknown, missing = sorted(set(configuration) - known), sorted(known - set(configuration))
    if unknown or missing:
        raise ConfigurationError(f"planar vehicle: unknown keys {unknown}, missing keys {missing}; it has {sorted(known)}")
    name, values = str(configuration["name"]), configuration["parameters"]
    if not isinstance(values, Mapping):
        raise ConfigurationError(f"vehicle '{name}': parameters must be a mapping, not {values!r}")
    unknown, missing = sorted(set(values) - set(PARAMETERS)), sorted(set(PARAMETERS) - set(values))
    if unknown or missing:
        raise ConfigurationError(
            f"vehicle '{name}': unknown parameters {unknown}, missing parameters {missing}; the planar plant has {', '.join(PARAMETERS)}"
        )
    return PlanarCar(name, **values)


def scaled_car(car: PlanarCar, factors: Mapping[str, float]) -> PlanarCar:
    """The car with some of its parameters scaled.

    Raises:
        ConfigurationError: a name is no parameter, or see PlanarCar.
    """
    unknown = sorted(set(factors) - set(PARAMETERS))
    if unknown:
        raise ConfigurationError(f"vary: '{unknown[0]}' is no parameter of vehicle '{car.name}' that can be scaled")
    changes: dict[str, Any] = {name: getattr(car, name) * factor for name, factor in factors.items()}
    return replace(car, **changes)
