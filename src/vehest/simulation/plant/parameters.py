"""Parameters of the multi-body plant: a set published by CommonRoad, with named values replaced.

The library has one tyre for all wheels. Here the rear axle may have its own: ``tire_rear`` replaces
values of ``tire``, which is then the front axle's.
"""

from __future__ import annotations

import math
from collections import namedtuple
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cache
from importlib import metadata
from types import MappingProxyType
from typing import Any

import numpy as np
from vehiclemodels.utils.longitudinal_parameters import LongitudinalParameters
from vehiclemodels.utils.steering_parameters import SteeringParameters
from vehiclemodels.utils.tireParameters import TireParameters
from vehiclemodels.vehicle_parameters import VehicleParameters, setup_vehicle_parameters

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError
from vehest.data.schema import validated

_published = cache(setup_vehicle_parameters)  # reads the library's files, which takes 20 ms
LIBRARY = "commonroad-vehicle-models"  # name of the package whose parameter files are read
LIBRARY_VERSION = metadata.version(LIBRARY)  # installed version of this package

PUBLISHED_SETS: Mapping[int, str] = MappingProxyType(
    {1: "Ford Escort", 2: "BMW 320i", 3: "VW Vanagon"}
)
"""Sets whose multi-body values CommonRoad publishes (Althoff and Würsching 2020, appendix)."""


def _field_names(library_class: type) -> list[str]:
    """Names of the fields of a dataclass of the library, in their order."""
    return [entry.name for entry in fields(library_class)]


REAR_TYRE = "tire_rear"  # name of the group of the rear tyre's parameters

STEERING_NAMES = _field_names(SteeringParameters)  # names of the parameters of the steering
# names of the parameters of the longitudinal dynamics
LONGITUDINAL_NAMES = _field_names(LongitudinalParameters)
TYRE_NAMES = _field_names(TireParameters)  # names of the parameters of a tyre
GROUPS = ("steering", "longitudinal", "tire", REAR_TYRE)
"""Fields of `MultiBodyValues` that are named tuples themselves."""
BODY_NAMES = [name for name in _field_names(VehicleParameters) if name not in (*GROUPS, "trailer")]
"""The other fields of `MultiBodyValues`."""

# The library's dataclasses again as named tuples, which compiled code can read; no trailer, but a
# rear tyre. Groups stand last.
SteeringValues = namedtuple("SteeringValues", STEERING_NAMES)  # type: ignore[misc]
LongitudinalValues = namedtuple("LongitudinalValues", LONGITUDINAL_NAMES)  # type: ignore[misc]
TyreValues = namedtuple("TyreValues", TYRE_NAMES)  # type: ignore[misc]
MultiBodyValues = namedtuple("MultiBodyValues", [*BODY_NAMES, *GROUPS])  # type: ignore[misc]

POSITIVE = (
    "m",
    "m_s",
    "m_uf",
    "m_ur",
    "a",
    "b",
    "I_z",
    "I_Phi_s",
    "I_y_s",
    "I_y_w",
    "T_f",
    "T_r",
    "R_w",
    "K_zt",
    "K_sf",
    "K_sr",
    "w",
)
"""Parameters that must be positive."""


@dataclass(frozen=True)
class Vehicle:
    """A car that the multi-body plant can drive; ``relaxation`` [m] is of its tyres.

    ``overrides`` replace the published values, by the library's names; a mapping inside it replaces
    values of a group (``tire``, ``tire_rear``, ``steering``, ``longitudinal``).
    `ConfigurationError` for an unknown set or parameter, or what is no finite number.
    """

    name: str  # name of the vehicle in recordings
    parameter_set: int  # number of the published set whose values apply where none is overridden
    # name of a parameter or group -> value that replaces the published one
    overrides: Mapping[str, Any] = field(default_factory=dict)
    # values of this car for its driver (car.py); the plant does not read them
    driver: Mapping[str, float] = field(default_factory=dict)
    # way over which lateral forces of the tyres follow their slip, front and rear [m]; 0: at once
    relaxation: tuple[float, float] = (
        0.0,
        0.0,
    )

    def __post_init__(self) -> None:
        parameters = library_parameters(self)
        for name in POSITIVE:
            value = getattr(parameters, name)
            if not value > 0.0:
                raise ConfigurationError(
                    f"vehicle '{self.name}': {name} must be positive, not {value}"
                )
        rear_tyre(self)
        for place, length in zip(("front", "rear"), self.relaxation, strict=True):
            if not 0.0 <= length < math.inf:
                raise ConfigurationError(
                    f"vehicle '{self.name}': relaxation {place} must be zero or positive, not "
                    f"{length} m"
                )


def vehicle_from_configuration(configuration: Mapping[str, Any]) -> Vehicle:
    """A vehicle from the keys ``name``, ``parameter_set`` and (optional) ``overrides``, ``driver``
    and ``relaxation`` (front, rear).

    Parameters
    ----------
    configuration : mapping
        As in conf/vehicle; a key whose value is None counts as absent, the relaxation of an axle
        that is not named as zero.

    Raises
    ------
    ConfigurationError
        Where a key is missing or unknown, or a value of the wrong type, and as `Vehicle` does.
    """
    values = {key: value for key, value in configuration.items() if value is not None}
    label = f"vehicle '{configuration.get('name')}'"
    lengths = values.pop("relaxation", {})
    if not isinstance(lengths, Mapping) or set(lengths) - {"front", "rear"}:
        raise ConfigurationError(
            f"{label}: relaxation is {{front: 0.3, rear: 0.3}} [m], not {lengths!r}"
        )
    values["relaxation"] = [lengths.get("front", 0.0), lengths.get("rear", 0.0)]
    return validated(Vehicle, values, label, error=ConfigurationError)


def loaded(vehicle: Vehicle, mass: float, forward: float, up: float) -> Vehicle:
    """The vehicle with a payload, a point mass that its springs carry.

    Unsprung masses are shared anew between the axles, so that body and car keep one centre of
    gravity in plan.

    Parameters
    ----------
    vehicle : Vehicle
        Without the payload.
    mass : float
        [kg]; with 0 the result is the same vehicle.
    forward, up : float
        Place of the mass from the centre of gravity [m], positive forward and upward.

    Returns
    -------
    Vehicle
        With masses, lever arms, moments of inertia (parallel axes) and heights as overrides.

    Raises
    ------
    ConfigurationError
        The mass is negative, or an axle would carry nothing.
    """
    if mass == 0.0:
        return vehicle
    p = library_parameters(vehicle)
    total = p.m + mass
    wheelbase = p.a + p.b
    shift = forward * mass / total
    if mass < 0.0 or not (p.a - shift > 0.0 and p.b + shift > 0.0):
        raise ConfigurationError(
            f"vehicle '{vehicle.name}': a payload of {mass:g} kg at {forward:g} m puts the centre "
            "of gravity off the axles"
        )
    unsprung = p.m_uf + p.m_ur
    changed = {
        "m": total,
        "m_s": p.m_s + mass,
        "a": p.a - shift,
        "b": p.b + shift,
        "m_uf": unsprung * (p.b + shift) / wheelbase,
        "m_ur": unsprung * (p.a - shift) / wheelbase,
        "I_z": p.I_z + mass * p.m / total * forward**2,
        "I_y_s": p.I_y_s + mass * p.m_s / (p.m_s + mass) * (forward**2 + up**2),
        "I_Phi_s": p.I_Phi_s + mass * p.m_s / (p.m_s + mass) * up**2,
        "h_cg": p.h_cg + up * mass / total,
        "h_s": p.h_s + up * mass / (p.m_s + mass),
    }
    return replace(vehicle, overrides={**vehicle.overrides, **changed})


def library_parameters(vehicle: Vehicle) -> VehicleParameters:
    """Parameter object of the library with the overrides in place, except the rear tyre's; a new
    one at every call.

    Raises
    ------
    ConfigurationError
        The set has no multi-body values, or an override names no parameter or is no finite number.
    """
    if vehicle.parameter_set not in PUBLISHED_SETS:
        published_sets = ", ".join(f"{number} ({car})" for number, car in PUBLISHED_SETS.items())
        raise ConfigurationError(
            f"vehicle '{vehicle.name}': there is no multi-body parameter set "
            f"{vehicle.parameter_set}; there are {published_sets}"
        )
    parameters = deepcopy(_published(vehicle.parameter_set))
    overrides = {name: value for name, value in vehicle.overrides.items() if name != REAR_TYRE}
    _override(parameters, overrides, vehicle.name, prefix="")
    return parameters


def rear_tyre(vehicle: Vehicle) -> TireParameters:
    """Parameters of the rear tyres: the front ones with the overrides of ``tire_rear`` in place."""
    tyre = library_parameters(vehicle).tire
    overrides = vehicle.overrides.get(REAR_TYRE, {})
    if not isinstance(overrides, Mapping):
        raise ConfigurationError(
            f"vehicle '{vehicle.name}': override '{REAR_TYRE}' must be a mapping, not {overrides!r}"
        )
    _override(tyre, overrides, vehicle.name, prefix=f"{REAR_TYRE}.")
    return tyre


def compiled_parameters(vehicle: Vehicle) -> Any:
    """Parameters of a vehicle as nested named tuples of floats (MultiBodyValues); absent ones are
    NaN.
    """
    parameters = library_parameters(vehicle)
    return MultiBodyValues(  # type: ignore[call-arg]
        *_values_of(parameters, BODY_NAMES),
        SteeringValues(*_values_of(parameters.steering, STEERING_NAMES)),
        LongitudinalValues(*_values_of(parameters.longitudinal, LONGITUDINAL_NAMES)),
        TyreValues(*_values_of(parameters.tire, TYRE_NAMES)),
        TyreValues(*_values_of(rear_tyre(vehicle), TYRE_NAMES)),
    )


def parameter_vector(parameters: Any) -> FloatArray:
    """The values of (nested) named tuples one after the other, in the order of their fields.

    Returns
    -------
    FloatArray
        (N,), nested tuples in place; `compiled._unpack` is its inverse.
    """
    values: list[float] = []
    for value in parameters:
        values.extend(parameter_vector(value) if isinstance(value, tuple) else [value])
    return np.array(values)


def _override(
    parameters: Any, overrides: Mapping[str, Any], vehicle_name: str, prefix: str
) -> None:
    """Set values of a library object by name, groups within; refuses unknown names and values that
    are no finite numbers.
    """
    for name, value in overrides.items():
        label = f"vehicle '{vehicle_name}': override '{prefix}{name}'"
        names = _field_names(type(parameters))
        if name not in names:
            raise ConfigurationError(
                f"{label} names no parameter of the plant; known ones: {', '.join(names)}"
            )
        is_group = is_dataclass(getattr(parameters, name))
        if is_group != isinstance(value, Mapping):
            raise ConfigurationError(
                f"{label} must be {'a mapping' if is_group else 'a number'}, not {value!r}"
            )
        if is_group:
            _override(getattr(parameters, name), value, vehicle_name, prefix=f"{prefix}{name}.")
        elif is_number(value):
            setattr(parameters, name, float(value))
        else:
            raise ConfigurationError(f"{label} must be a finite number, not {value!r}")


def is_number(value: Any) -> bool:
    """Whether a value is a finite number, not a truth value."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _values_of(parameters: Any, names: Sequence[str]) -> list[float]:
    """Values of these names; NaN where the library has none."""
    values = [getattr(parameters, name) for name in names]
    return [math.nan if value is None else float(value) for value in values]
