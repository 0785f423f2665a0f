"""A car's record: what `vehest identify` finds on its drives, kept in a YAML file that later estimates start from."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from vehest.data.errors import ConfigurationError, DataError
from vehest.data.schema import check_format, settings_from_config, validated
from vehest.data.text_files import read_yaml
from vehest.estimators.base import Estimator
from vehest.estimators.self_calibrating import TYPICAL_REAR, SelfCalibrating

FORMAT = 1
WIDENING = 1.5
"""By which the deviations of a record are multiplied before an estimate starts from them."""
LIMITS = {
    "leakage": (-0.3, 0.3),
    "rear_axle": (0.0, 20.0),
    "compliance": (2e-4, 0.1),
    "grip": (1.0, 60.0),
}
"""Beyond which a number is not one of a car."""
Positive = Annotated[float, Field(gt=0.0)]


@dataclass(frozen=True)
class Number:
    """A number with its standard deviation, and the drives on which it was identified; where on none, no estimate starts from it."""

    value: float
    deviation: Positive
    identified_on: tuple[str, ...] = ()


@dataclass(frozen=True)
class CarRecord:
    """Numbers of a car; raises `DataError` where one is not of a car."""

    wheelbase: Annotated[float, Field(ge=0.05, le=20.0)]  # [m]
    cg_to_rear_axle: Positive | None  # as given [m]
    leakage: Number  # κ: share of the measured ay that is none, because the body rolls or the sensor's gain errs
    rear_axle: Number  # its distance from the inertial unit [m]
    compliance: Number  # C: slip angle of the rear axle over its lateral acceleration, both small [rad s²/m]
    grip: Number  # lateral acceleration at the rear axle's limit [m/s²]
    offsets: Mapping[
        str, Mapping[str, Number]
    ]  # drive -> channel -> mean offset [m/s²]; no estimate starts from it

    def __post_init__(self) -> None:
        for name, (low, high) in LIMITS.items():
            if not low < getattr(self, name).value < high:
                raise DataError(
                    f"{name} must lie between {low:g} and {high:g}, not at {getattr(self, name).value:.4g}"
                )
        if self.cg_to_rear_axle is not None and self.cg_to_rear_axle >= self.wheelbase:
            raise DataError(
                f"cg_to_rear_axle must be below the wheelbase ({self.wheelbase:g} m), not {self.cg_to_rear_axle:g}"
            )


def with_settings(model: Estimator, changed: dict[str, Any]) -> SelfCalibrating:
    """The filter with some settings changed; raises `ConfigurationError` where it is another estimator, or one is out of bounds."""
    if not isinstance(model, SelfCalibrating):
        what = "a car's record and estimator.KEY=VALUE are for the self-calibrating filter"
        raise ConfigurationError(f"{what}, not for '{model.name}'; leave the model out")
    new = SelfCalibrating(
        settings_from_config(
            SelfCalibrating.settings_type, asdict(model.settings) | changed, "estimator"
        )
    )
    new.load_weights(model.weights())
    new.preparation = model.preparation
    return new


def calibrated(model: Estimator, record: CarRecord, widening: float = WIDENING) -> SelfCalibrating:
    """The filter with a car's wheelbase and, as priors, its leakage and rear axle, deviations widened; errors of `with_settings`.

    Compliance and grip are found anew: tyres and road change them, and estimates that started from them were worse.
    """
    changed: dict[str, Any] = {
        "wheelbase": record.wheelbase,
        "cg_to_rear_axle": record.cg_to_rear_axle,
    }
    base = with_settings(model, changed)
    leakage = record.leakage
    rear = record.rear_axle
    point = record.cg_to_rear_axle
    if leakage.identified_on:
        changed |= {
            "leakage": leakage.value,
            "leakage_deviation": min(widening * leakage.deviation, base.leakage_deviation),
        }
    if rear.identified_on:
        if point is None:  # where the filter's estimates hold without it
            point = rear.value + base.rear_share * (TYPICAL_REAR * record.wheelbase - rear.value)
        changed |= {
            "cg_to_rear_axle": point,
            "imu_deviation": math.hypot(widening * rear.deviation, rear.value - point)
            / record.wheelbase,
        }
    return with_settings(model, changed)


def read_car(path: Path) -> CarRecord:
    """Read a car's record back; raises `MissingError`, or `DataError` where it is damaged, of another format or not of a car."""
    content = read_yaml(path)
    if not isinstance(content, dict) or "format" not in content:
        raise DataError(f"'{path}' is no record of a car as vehest identify writes it")
    check_format(content.pop("format"), FORMAT, f"'{path}'")
    try:
        return validated(CarRecord, content, f"'{path}'")
    except DataError as error:
        raise error if str(path) in str(error) else DataError(f"'{path}': {error}") from None
