"""Values of the car that recordings were made with, and when two cars cannot be the same."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

from pydantic import Field

PositiveNumber = Annotated[float, Field(gt=0.0), "a positive number"]  # number above 0

SAME_CAR_RANGES = {"wheelbase": (1.05, "m"), "mass": (1.25, "kg")}
"""Value -> factor by which it may differ for one car, and its unit.

Sources differ by 4 % on the wheelbase of a Volvo V40. Five passengers are 25 % of a small car's
mass.
"""

LENGTHS = ("wheelbase", "cg_to_rear_axle", "imu_to_rear_axle")  # values in metres


@dataclass(frozen=True)
class CarValues:
    """Values of the car that a data set was recorded with; None where one is not known.

    Attributes
    ----------
    wheelbase : float or None
        Distance between the axles [m].
    mass : float or None
        Mass as it was driven [kg].
    cg_to_rear_axle : float or None
        Distance of the centre of gravity from the rear axle [m].
    steering_ratio : float or None
        Overall steering ratio: handwheel angle over road-wheel angle.
    imu_to_rear_axle : float or None
        Distance of the inertial unit from the rear axle, negative behind it [m].
    """

    wheelbase: (
        Annotated[float, Field(ge=0.05, le=20.0), "a number of metres, 0.05 to 20"] | None
    ) = None
    mass: PositiveNumber | None = None
    cg_to_rear_axle: PositiveNumber | None = None
    steering_ratio: PositiveNumber | None = None
    imu_to_rear_axle: (
        Annotated[float, Field(ge=-20.0, le=40.0), "a number of metres, -20 to 40"] | None
    ) = None

    def __post_init__(self) -> None:
        """Raises `ValueError`: a centre of gravity outside of the wheelbase, or an inertial unit
        farther than one wheelbase behind the rear axle or two ahead of it.
        """
        if self.wheelbase is None:
            return
        rear = self.cg_to_rear_axle
        if rear is not None and rear >= self.wheelbase:
            raise ValueError(
                f"cg_to_rear_axle must be below the wheelbase ({self.wheelbase:g} m), not {rear:g}"
            )
        imu = self.imu_to_rear_axle
        if imu is not None and not -self.wheelbase <= imu <= 2.0 * self.wheelbase:
            raise ValueError(
                "imu_to_rear_axle must lie between one wheelbase behind the rear axle and two "
                f"ahead of it ({-self.wheelbase:g} to {2.0 * self.wheelbase:g} m), not at {imu:g}"
            )

    def scaled(self, factor: float) -> CarValues:
        """The car with its lengths multiplied by a factor; its mass is unknown then."""
        lengths = {name: getattr(self, name) for name in LENGTHS}
        scaled = {name: length and factor * length for name, length in lengths.items()}
        return replace(self, mass=None, **scaled)

    def difference_to(self, second: CarValues) -> str:
        """Text of the first value in which this and another car differ too much to be the same,
        such as ``wheelbase 0.33 m, not 2.7 m``; empty if there is none.

        They cannot where a value that both have differs by more than `SAME_CAR_RANGES`.
        """
        for name, (factor, unit) in SAME_CAR_RANGES.items():
            value = getattr(self, name)
            expected = getattr(second, name)
            if value is None or expected is None:
                continue
            if max(value, expected) > factor * min(value, expected):
                return f"{name} {value:g} {unit}, not {expected:g} {unit}"
        return ""


UNKNOWN_CAR = CarValues()  # car of which no value is known
