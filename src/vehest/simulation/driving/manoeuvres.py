"""Manoeuvres: what a drive consists of, from the first sample to the last.

Each is a frozen dataclass of its parameters, made from a configuration by ``manoeuvre_from_config``, and gives a controller for a car,
a surface and a seed. A parameter of type Range is a number, or a pair from which every drive draws one, uniformly. ``severity`` is always
the share of the grip that the driver means to use, on the surface at hand. Values without a source are assumed.

Time is zero at the first sample of the recording; SETTLING_TIME before it the car starts, rolling straight ahead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any, TypeVar

from vehest.data.errors import ConfigurationError
from vehest.simulation.driving.circles import BrakingInTurn, SteadyCircle
from vehest.simulation.driving.cones import DoubleLaneChange, Slalom
from vehest.simulation.driving.laps import FastLap, Laps, SpeedLaps
from vehest.simulation.driving.manoeuvre import Manoeuvre
from vehest.simulation.driving.open_loop import RandomSteer, Spiral, StepSteer
from vehest.simulation.plant.parameters import is_number

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Made = TypeVar("Made", bound="DataclassInstance")

MANOEUVRES: Mapping[str, type[Manoeuvre]] = {
    made.name: made
    for made in (Laps, SpeedLaps, FastLap, DoubleLaneChange, Slalom, SteadyCircle, BrakingInTurn, StepSteer, Spiral, RandomSteer)
}
"""Manoeuvres by name."""


def manoeuvre_from_config(configuration: Mapping[str, Any]) -> Manoeuvre:
    """A manoeuvre of the multi-body plant from its ``name`` and any of its parameters.

    Raises:
        ConfigurationError: there is no such manoeuvre or parameter, or a value makes no sense.
    """
    return one_of(configuration, MANOEUVRES)


def one_of(configuration: Mapping[str, Any], among: Mapping[str, type[Made]]) -> Made:
    """A manoeuvre from its ``name`` and any of its parameters.

    Args:
        configuration: name and parameters.
        among: the manoeuvres that the plant has, dataclasses by name.

    Raises:
        ConfigurationError: there is no such manoeuvre or parameter, or a value makes no sense.
    """
    values = {key: _tupled(value) for key, value in configuration.items()}
    name = values.pop("name", None)
    if not isinstance(name, str) or name not in among:
        raise ConfigurationError(f"there is no manoeuvre '{name}'; there are {', '.join(sorted(among))}")
    known = {entry.name for entry in fields(among[name])}
    unknown = sorted(set(values) - known)
    if unknown:
        raise ConfigurationError(f"manoeuvre '{name}': unknown keys {unknown}; it has {sorted(known)}")
    for entry in fields(among[name]):
        if entry.name in values and not _fits(values[entry.name], str(entry.type)):
            shown = _KINDS.get(str(entry.type).removesuffix(" | None"), str(entry.type))
            raise ConfigurationError(f"manoeuvre '{name}': {entry.name} must be {shown}, not {configuration[entry.name]}")
    return among[name](**values)


_KINDS = {
    "Range": "a number or a pair of numbers",
    "float": "a number",
    "int": "a whole number",
    "bool": "true or false",
    "str": "a name",
    "tuple[float, float]": "a pair of numbers",
    "tuple[float, ...]": "a list of numbers",
}


def _fits(value: Any, kind: str) -> bool:
    """Whether a value is of a field's type, as the dataclass spells it."""
    if kind.endswith(" | None"):
        return value is None or _fits(value, kind.removesuffix(" | None"))
    if kind in ("bool", "str"):
        return isinstance(value, {"bool": bool, "str": str}[kind])
    if isinstance(value, tuple):
        pair = len(value) == 2 and kind in ("Range", "tuple[float, float]")
        return (pair or (kind == "tuple[float, ...]" and len(value) > 0)) and all(is_number(entry) for entry in value)
    return kind in ("Range", "float", "int") and is_number(value) and (kind != "int" or isinstance(value, int))


def _tupled(value: Any) -> Any:
    return tuple(value) if isinstance(value, list | tuple) else value
