"""What describes a car, in SI units, with the source of every published set."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, NamedTuple


class Range(NamedTuple):
    """Smallest and largest plausible value of a quantity, in its SI unit."""

    lower: float  # smallest value
    upper: float  # largest value


# plausible ranges, from a car of 40 g on a table to the heaviest road vehicle
MASS = Range(1e-3, 1e6)  # [kg]
YAW_INERTIA = Range(1e-7, 1e8)  # [kg m²]
LENGTH = Range(1e-3, 30.0)  # [m]
CORNERING_STIFFNESS = Range(1e-3, 1e9)  # [N/rad]
# parameter of a car -> its plausible range
RANGES: Mapping[str, Range] = {
    "mass": MASS,
    "yaw_inertia": YAW_INERTIA,
    "cg_to_front_axle": LENGTH,
    "cg_to_rear_axle": LENGTH,
    "cg_height": LENGTH,
    "cornering_stiffness_front": CORNERING_STIFFNESS,
    "cornering_stiffness_rear": CORNERING_STIFFNESS,
}


def check_parameters(parameters: Any) -> None:
    """Raise `ValueError` for a field of a car's parameters that is outside of `RANGES`.

    A NaN counts as not positive.
    """
    for entry in fields(parameters):
        value = getattr(parameters, entry.name)
        if not value > 0:
            raise ValueError(f"{entry.name} must be positive, not {value}")
        low, high = RANGES[entry.name]
        if not low <= value <= high:
            raise ValueError(f"{entry.name} must lie between {low:g} and {high:g}, not at {value}")


@dataclass(frozen=True)
class SingleTrackParameters:
    """A car as a single track: each axle one tyre on the centre line.

    Raises
    ------
    ValueError
        A number outside of `RANGES`.
    """

    mass: float  # [kg]
    yaw_inertia: float  # about the vertical axis through the centre of gravity [kg m²]
    cg_to_front_axle: float  # distance from the centre of gravity [m]
    cg_to_rear_axle: float  # distance from the centre of gravity [m]
    cornering_stiffness_front: float  # lateral force of the axle per slip angle [N/rad]
    cornering_stiffness_rear: float  # the same of the rear axle [N/rad]

    def __post_init__(self) -> None:
        """Check all values against `RANGES`."""
        check_parameters(self)


FERRARI_250LM = SingleTrackParameters(
    mass=982.0,
    yaw_inertia=1605.4145,
    cg_to_front_axle=1.33,
    cg_to_rear_axle=1.07,
    cornering_stiffness_front=0.7e5,
    cornering_stiffness_rear=1.2e5,
)
"""Ferrari 250 LM Berlinetta GT, as Leanza, Reina & Blanco-Claraco (Sensors 21 (16), 5409, 2021)
have it in their public code.

The yaw inertia is that of a plate of 1.70 m by 4.09 m: 982 kg / 12 · (1.70² + 4.09²) m².
"""
