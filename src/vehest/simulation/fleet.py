"""Cars and sensors that differ from drive to drive, drawn from stated ranges: for training that
must generalise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any

import numpy as np

from vehest.data.errors import ConfigurationError
from vehest.data.schema import validated
from vehest.simulation.plant.parameters import (
    REAR_TYRE,
    Vehicle,
    is_number,
    library_parameters,
    rear_tyre,
)
from vehest.simulation.plant.planar_car import PlanarCar, scaled_car
from vehest.simulation.random_streams import FLEET, random_stream
from vehest.simulation.sensors.levels import SensorLevel, SensorLevels

# lowest and highest scale
Scales = Annotated[tuple[float, float], "a pair [lowest, highest] of scales"]


@dataclass(frozen=True)
class Variation:
    """Parameters of the plant that are scaled together."""

    # names of the parameters in the library, ``tire.p_dy1`` for one of a group
    parameters: tuple[str, ...]
    factor: Scales  # lowest and highest scale, drawn uniformly for every drive
    # whether the scale is drawn uniformly over its logarithm, so that half as much is as likely as
    # twice as much
    log: bool = False

    def __post_init__(self) -> None:
        if not 0.0 < self.factor[0] <= self.factor[1]:
            raise ConfigurationError(
                "vary: a factor is a pair [lowest, highest] of positive scales, not "
                f"{list(self.factor)}"
            )

    def drawn(self, generator: np.random.Generator) -> float:
        """Draw the factor by which all ``parameters`` are multiplied, uniformly within ``factor``
        or its logarithms.

        Parameters
        ----------
        generator : np.random.Generator
            Of the drive; one draw is taken.
        """
        low, high = self.factor
        if self.log:
            return float(np.exp(generator.uniform(np.log(low), np.log(high))))
        return float(generator.uniform(low, high))


def variations_from_config(entries: Any) -> tuple[Variation, ...]:
    """Variations from a data set's ``vary``: a list of ``{parameters: [m, m_s], factor: [0.9,
    1.2]}``, ``log: true`` if wanted.

    Returns
    -------
    tuple of Variation
        In the order of the list, which is the order of the draws.

    Raises
    ------
    ConfigurationError
        Where an entry is no variation.
    """
    return validated(tuple[Variation, ...], entries, "", error=ConfigurationError, group="vary")


def varied(vehicle: Vehicle, variations: Sequence[Variation], seed: int) -> Vehicle:
    """The vehicle with parameters scaled as the seed draws them; the same one if nothing varies.

    Parameters
    ----------
    vehicle : Vehicle
        The car of the configuration.
    variations : sequence of Variation
        Each has one scale for all of its parameters; scales of a parameter that several variations
        name multiply.
    seed : int
        Of the drive; the stream is the fleet's own.

    Returns
    -------
    Vehicle
        The scaled values as overrides, on top of those that the vehicle has.

    Raises
    ------
    ConfigurationError
        A variation names no parameter of the plant, or one that is no number.
    """
    if not variations:
        return vehicle
    overrides = deepcopy(dict(vehicle.overrides))
    published = library_parameters(vehicle)
    rear = rear_tyre(vehicle)
    for name, factors in _drawn(variations, seed).items():
        *group, last = name.split(".")
        holder: Any = published
        target = overrides
        for part in group:
            holder = rear if part == REAR_TYRE else getattr(holder, part, None)
            target = target.setdefault(part, {})
        value = getattr(holder, last, None)
        if not isinstance(value, int | float):
            raise ConfigurationError(
                f"vary: '{name}' is no parameter of vehicle '{vehicle.name}' that can be scaled"
            )
        target[last] = math.prod(factors, start=float(value))
    return replace(vehicle, overrides=overrides)


def varied_planar(car: PlanarCar, variations: Sequence[Variation], seed: int) -> PlanarCar:
    """`varied` for a car of the planar plant.

    Raises
    ------
    ConfigurationError
        A variation names no parameter of the plant.
    """
    return scaled_car(
        car, {name: math.prod(factors) for name, factors in _drawn(variations, seed).items()}
    )


def _drawn(variations: Sequence[Variation], seed: int) -> dict[str, list[float]]:
    """Scales that the seed draws for each parameter."""
    generator = random_stream(seed, FLEET, 0)
    factors_of: dict[str, list[float]] = {}
    for variation in variations:
        factor = variation.drawn(generator)
        for name in variation.parameters:
            factors_of.setdefault(name, []).append(factor)
    return factors_of


@dataclass(frozen=True)
class SensorVariation:
    """Scales of the sensors' errors that are drawn for every drive, one for each sensor and kind of
    error.
    """

    # kind of error (``noise``, ``offset``, …) -> lowest and highest scale
    factors: Mapping[str, tuple[float, float]]
    # lowest and highest share of the body's roll that leaks into ay, of either sign; None: as the
    # sensors have it
    roll_share: tuple[float, float] | None = None

    @classmethod
    def from_config(cls, entries: Any) -> SensorVariation:
        """Variation from a data set's ``vary_sensors``: ``{noise: [0.5, 2], delay: [0, 1.5]}``;
        raises `ConfigurationError` otherwise.
        """
        kinds = [entry.name for entry in fields(SensorLevel)]
        if not isinstance(entries, Mapping) or set(entries) - {*kinds, "roll_share"}:
            raise ConfigurationError(
                f"vary_sensors is a mapping from {', '.join(kinds)} or roll_share to ranges of "
                f"scales, not {entries}"
            )
        factors = {
            str(kind): _range(value) for kind, value in entries.items() if kind != "roll_share"
        }
        return cls(
            factors,
            _range(entries["roll_share"], lowest=-np.inf) if "roll_share" in entries else None,
        )

    def applied(self, levels: SensorLevels, seed: int) -> SensorLevels:
        """Levels as the seed scales them; the same ones if nothing varies. References stay as they
        are.

        Parameters
        ----------
        levels : SensorLevels
            Levels of the data set.
        seed : int
            Of the drive. Scales are drawn sensor by sensor in the order of the fields of
            SensorLevels.

        Returns
        -------
        SensorLevels
            With one scale for each sensor and kind of error; ``roll_share`` is drawn once.
        """
        if not self.factors and self.roll_share is None:
            return levels
        generator = random_stream(seed, FLEET, 1)
        changed: dict[str, Any] = {}
        for entry in fields(levels):
            level = getattr(levels, entry.name)
            if isinstance(level, SensorLevel):
                scales = {
                    kind: float(generator.uniform(*factor)) for kind, factor in self.factors.items()
                }
                changed[entry.name] = replace(
                    level, **{kind: getattr(level, kind) * scale for kind, scale in scales.items()}
                )
        if self.roll_share is not None:
            changed["tilt"] = replace(
                levels.tilt, roll_share=float(generator.uniform(*self.roll_share))
            )
        return replace(levels, **changed)


def _range(value: Any, lowest: float = 0.0) -> tuple[float, float]:
    """A pair of numbers [lowest, highest] with the lowest at or above ``lowest``; raises
    `ConfigurationError` otherwise.
    """
    numbers = (
        isinstance(value, Sequence)
        and not isinstance(value, str)
        and all(is_number(end) for end in value)
    )
    if not numbers or len(value) != 2 or not lowest <= value[0] <= value[1]:
        raise ConfigurationError(
            f"vary_sensors: a range is a pair [lowest, highest] of scales, not {value}"
        )
    return float(value[0]), float(value[1])
