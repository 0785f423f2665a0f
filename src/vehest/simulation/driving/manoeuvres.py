"""Manoeuvres by name, and made from a configuration.

A manoeuvre is a frozen dataclass of its parameters; its controller drives a car on a surface as a
seed draws it. A parameter of type Range is a number, or a pair from which every drive draws one,
uniformly. ``severity`` is the share of the grip that the driver uses on the surface of the drive.
Values without a source are assumed.

Time is zero at the first sample of the recording; SETTLING_TIME before it the car starts, rolling
straight ahead.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from vehest.data.errors import ConfigurationError
from vehest.data.schema import validated
from vehest.simulation.driving.circles import BrakingInTurn, SteadyCircle
from vehest.simulation.driving.cones import DoubleLaneChange, Slalom
from vehest.simulation.driving.laps import FastLap, Laps, SpeedLaps
from vehest.simulation.driving.manoeuvre import Manoeuvre
from vehest.simulation.driving.open_loop import RandomSteer, Spiral, StepSteer

MANOEUVRES: Mapping[str, type[Manoeuvre]] = {
    manoeuvre.name: manoeuvre
    for manoeuvre in (
        Laps,
        SpeedLaps,
        FastLap,
        DoubleLaneChange,
        Slalom,
        SteadyCircle,
        BrakingInTurn,
        StepSteer,
        Spiral,
        RandomSteer,
    )
}
"""Manoeuvres by name."""


def manoeuvre_from_config(
    configuration: Mapping[str, Any], among: Mapping[str, type[Any]] = MANOEUVRES
) -> Any:
    """A manoeuvre from its ``name`` and any of its parameters.

    Parameters
    ----------
    configuration : mapping
        ``name`` and parameters; a list of two is a range.
    among : mapping
        Name -> class, of the manoeuvres that the plant has.

    Returns
    -------
    Manoeuvre
        Whole numbers stay whole numbers, as the provenance shows them.

    Raises
    ------
    ConfigurationError
        There is no such manoeuvre; a parameter is unknown, of a wrong type or outside its limits.
    """
    values = dict(configuration)
    name = values.pop("name", None)
    if not isinstance(name, str) or name not in among:
        raise ConfigurationError(
            f"there is no manoeuvre '{name}'; there are {', '.join(sorted(among))}"
        )
    validated(among[name], values, f"manoeuvre '{name}'", error=ConfigurationError)
    # Made of the values as they are written, whole numbers too, which provenance keeps.
    return among[name](
        **{key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
    )
