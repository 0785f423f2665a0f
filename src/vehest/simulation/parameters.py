"""Parameters of the multi-body plant: a set published by CommonRoad, with named values replaced."""

from __future__ import annotations

import math
from collections import namedtuple
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any

from vehiclemodels.utils.longitudinal_parameters import LongitudinalParameters
from vehiclemodels.utils.steering_parameters import SteeringParameters
from vehiclemodels.utils.tireParameters import TireParameters
from vehiclemodels.utils.trailer_parameters import TrailerParameters
from vehiclemodels.vehicle_parameters import VehicleParameters, setup_vehicle_parameters

from vehest.data.errors import ConfigurationError

PUBLISHED_SETS: Mapping[int, str] = MappingProxyType({1: "Ford Escort", 2: "BMW 320i", 3: "VW Vanagon"})
"""Sets for which CommonRoad publishes all multi-body values (Althoff and Würsching 2020, appendix)."""


def _field_names(library_class: type) -> list[str]:
    return [entry.name for entry in fields(library_class)]


# The library's dataclasses again as named tuples, which compiled code can read. They stand at module level, under
# fixed names, because a compiled function is found again on disk by the type of its arguments.
SteeringValues = namedtuple("SteeringValues", _field_names(SteeringParameters))  # type: ignore[misc]
LongitudinalValues = namedtuple("LongitudinalValues", _field_names(LongitudinalParameters))  # type: ignore[misc]
TyreValues = namedtuple("TyreValues", _field_names(TireParameters))  # type: ignore[misc]
TrailerValues = namedtuple("TrailerValues", _field_names(TrailerParameters))  # type: ignore[misc]
MultiBodyValues = namedtuple("MultiBodyValues", _field_names(VehicleParameters))  # type: ignore[misc]

_TUPLE_OF: Mapping[type, type] = MappingProxyType(
    {
        SteeringParameters: SteeringValues,
        LongitudinalParameters: LongitudinalValues,
        TireParameters: TyreValues,
        TrailerParameters: TrailerValues,
        VehicleParameters: MultiBodyValues,
    }
)


@dataclass(frozen=True)
class Vehicle:
    """A car that the multi-body plant can drive.

    Args:
        name: what recordings call it.
        parameter_set: number of the published set it starts from.
        overrides: values that replace the published ones, by the library's names; a mapping inside it replaces
            values of a group (``tire``, ``steering``, ``longitudinal``).

    Raises:
        ConfigurationError: no such set, no such parameter, or a value that is not a finite number.
    """

    name: str
    parameter_set: int
    overrides: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        library_parameters(self)


def vehicle_from_configuration(configuration: Mapping[str, Any]) -> Vehicle:
    """A vehicle from the keys ``name``, ``parameter_set`` and (optional) ``overrides``.

    Raises:
        ConfigurationError: a key is missing or unknown, or see Vehicle.
    """
    known = {"name", "parameter_set", "overrides"}
    unknown = sorted(set(configuration) - known)
    missing = sorted({"name", "parameter_set"} - set(configuration))
    if unknown or missing:
        raise ConfigurationError(f"vehicle configuration: unknown keys {unknown}, missing keys {missing}; it has {sorted(known)}")
    overrides = _plain(configuration.get("overrides") or {})
    return Vehicle(str(configuration["name"]), configuration["parameter_set"], overrides)


def library_parameters(vehicle: Vehicle) -> VehicleParameters:
    """The library's own parameter object with the overrides in place; a fresh one at every call."""
    if vehicle.parameter_set not in PUBLISHED_SETS:
        known = ", ".join(f"{number} ({car})" for number, car in PUBLISHED_SETS.items())
        raise ConfigurationError(
            f"vehicle '{vehicle.name}': there is no multi-body parameter set {vehicle.parameter_set}; there are {known}"
        )
    parameters = setup_vehicle_parameters(vehicle.parameter_set)
    _override(parameters, vehicle.overrides, vehicle.name, prefix="")
    return parameters


def compiled_parameters(vehicle: Vehicle) -> Any:
    """The same values as nested named tuples of floats (MultiBodyValues); absent ones are NaN."""
    return _as_values(library_parameters(vehicle))


def _plain(mapping: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _plain(value) if isinstance(value, Mapping) else value for name, value in mapping.items()}


def _override(parameters: Any, overrides: Mapping[str, Any], vehicle_name: str, prefix: str) -> None:
    for name, value in overrides.items():
        where = f"vehicle '{vehicle_name}': override '{prefix}{name}'"
        if name not in _field_names(type(parameters)):
            known = ", ".join(_field_names(type(parameters)))
            raise ConfigurationError(f"{where} names no parameter of the plant; known ones: {known}")
        is_group = type(getattr(parameters, name)) in _TUPLE_OF
        if is_group != isinstance(value, Mapping):
            raise ConfigurationError(f"{where} must be {'a mapping' if is_group else 'a number'}, not {value!r}")
        if is_group:
            _override(getattr(parameters, name), value, vehicle_name, prefix=f"{prefix}{name}.")
            continue
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise ConfigurationError(f"{where} must be a finite number, not {value!r}")
        setattr(parameters, name, float(value))


def _as_values(parameters: Any) -> Any:
    values = []
    for entry in fields(parameters):
        value = getattr(parameters, entry.name)
        if type(value) in _TUPLE_OF:
            values.append(_as_values(value))
        else:
            values.append(math.nan if value is None else float(value))
    return _TUPLE_OF[type(parameters)](*values)
