"""Values of a car as settings of a model, and a car's record.

`vehest identify` identifies the record's values on drives and writes them as YAML.

    drives --`vehest identify`--> `CarRecord` as YAML --read_car--> `CarRecord`
    model, command line, record, data set --adapted--> model with the values of the car
    configuration of a training, data set --with_car_values--> configuration
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from vehest.data.car import CarValues
from vehest.data.derived import has_measured_ax
from vehest.data.errors import ConfigurationError, DataError, unknown_option
from vehest.data.recording import Recording
from vehest.data.schema import check_format, settings_from_config, validated
from vehest.data.text_files import read_yaml
from vehest.estimators.base import Estimator
from vehest.estimators.prior_map import PriorMap
from vehest.estimators.registry import option_names
from vehest.estimators.self_calibrating import SelfCalibrating
from vehest.trust.record import Trust

FORMAT = 1  # version of the record that `vehest identify` writes
DEVIATION_FACTOR = 1.5
"""Factor by which the standard deviations of a record are multiplied before an estimate starts from
them.
"""
LIMITS = {
    "leakage": (-0.3, 0.3),
    "rear_axle": (-20.0, 20.0),
    "compliance": (2e-4, 0.1),
    "grip": (1.0, 60.0),
}
"""Parameter of a record -> smallest and largest value of a car."""
ASSUMED = "the wheelbase is assumed to be"
"""Start of the remark that no wheelbase was given."""
CAR_SETTINGS = {"wheelbase": "m", "cg_to_rear_axle": "m", "imu_to_rear_axle": "m"}
"""Settings of the self-calibrating filter that are values of the car -> unit."""
DEFAULT_WHEELBASES = {
    family.name: family.settings_type().wheelbase for family in (SelfCalibrating, PriorMap)
}
"""Estimator that assumes a typical wheelbase where none is given -> that wheelbase [m]."""
Positive = Annotated[float, Field(gt=0.0)]  # number above 0


@dataclass(frozen=True)
class Number:
    """An identified parameter with its standard deviation and the drives on which it was
    identified.

    Where on none, no estimate starts from it.
    """

    value: float  # identified value
    deviation: Positive  # standard deviation, in the same unit
    # drives on which it was identified; none: no estimate starts from it
    identified_on: tuple[str, ...] = ()


@dataclass(frozen=True)
class CarRecord:
    """Identified parameters of a car; raises `DataError` where one cannot be of a car.

    Lengths are measured along the car from the rear axle, forwards positive.
    """

    wheelbase: Annotated[float, Field(ge=0.05, le=20.0)]  # [m]
    # distance of the centre of gravity from the rear axle, as given [m]
    cg_to_rear_axle: Positive | None
    # κ: share of the measured ay that is none, because the body rolls or the sensor's gain errs
    leakage: Number
    rear_axle: Number  # distance of the inertial unit from the rear axle, negative behind it [m]
    # C: slip angle of the rear axle over its lateral acceleration, both small [rad s²/m]
    compliance: Number
    grip: Number  # lateral acceleration at the rear axle's limit [m/s²]
    # drive -> channel -> mean offset [m/s²]; no estimate starts from it
    offsets: Mapping[str, Mapping[str, Number]]

    def __post_init__(self) -> None:
        """Raise `DataError` for a number beyond `LIMITS`, or a centre of gravity beyond the
        wheelbase.
        """
        for name, (low, high) in LIMITS.items():
            if not low < getattr(self, name).value < high:
                raise DataError(
                    f"{name} must lie between {low:g} and {high:g}, not at "
                    f"{getattr(self, name).value:.4g}"
                )
        if self.cg_to_rear_axle is not None and self.cg_to_rear_axle >= self.wheelbase:
            raise DataError(
                f"cg_to_rear_axle must be below the wheelbase ({self.wheelbase:g} m), not "
                f"{self.cg_to_rear_axle:g}"
            )


def stated_wheelbase(car: CarValues, settings: Mapping[str, Any]) -> float | None:
    """Wheelbase [m] by the settings of the command line, or else by the data set; None: neither.

    Raises
    ------
    ConfigurationError
        The setting is no wheelbase.
    """
    if "wheelbase" not in settings:
        return car.wheelbase
    of_command = {"wheelbase": settings["wheelbase"]}
    return validated(
        CarValues, of_command, "", error=ConfigurationError, group="estimator"
    ).wheelbase


def with_settings(model: Estimator, changed: dict[str, Any]) -> SelfCalibrating:
    """The filter with some settings changed.

    Raises `ConfigurationError` where it is another estimator, or one is out of bounds.
    """
    if not isinstance(model, SelfCalibrating):
        requirement = "a car's record and estimator.KEY=VALUE are for the self-calibrating filter"
        raise ConfigurationError(f"{requirement}, not for '{model.name}'; leave the model out")
    for option in changed:
        if not hasattr(model.settings, option):
            raise ConfigurationError(unknown_option(model.name, option, option_names()))
    new = SelfCalibrating(
        settings_from_config(
            SelfCalibrating.settings_type, asdict(model.settings) | changed, "estimator"
        )
    )
    new.load_weights(model.weights())
    new.preparation = model.preparation
    return new


def settings_for_channels(model: Estimator, recording: Recording) -> dict[str, bool]:
    """Setting -> value with which the self-calibrating filter does without an ax that is missing or
    made of the speed; empty for other models.
    """
    if isinstance(model, SelfCalibrating) and not has_measured_ax(recording):
        return {"measured_ax": False}
    return {}


def adapted(
    model: Estimator,
    trust: Trust | None,
    car: CarValues,
    settings: Mapping[str, Any],
    record: CarRecord | None = None,
) -> tuple[Estimator, Trust | None, list[str]]:
    """A model for the car of a recording.

    Settings of the command line come first, then the car's record, then the values of the data set;
    each applies where those before it do not. A model whose settings were chosen in training keeps
    them.

    Parameters
    ----------
    model : Estimator
        Only the self-calibrating filter has settings that may be changed; others stay as they are.
    trust : Trust or None
        Calibration of the model.
    car : CarValues
        Of the recording's data set.
    settings : mapping
        Of the command line: name -> value.
    record : CarRecord, optional
        By `vehest identify`.

    Returns
    -------
    tuple
        The model, its calibration without health where the channels differ, and remarks for the
        user.

    Raises
    ------
    ConfigurationError
        Settings or a record are given for another model, or a value is out of bounds.
    """
    remarks = []
    before = model
    if isinstance(model, SelfCalibrating):
        dataset_values = _values_of_dataset(model, car, settings, record)
        if dataset_values:
            values = [
                f"{name} {value:g} {CAR_SETTINGS[name]}" for name, value in dataset_values.items()
            ]
            remarks.append(f"{' and '.join(values)}: of the data set")
            model = with_settings(model, dataset_values)
        has_wheelbase = record is not None or "wheelbase" in {*settings, *dataset_values}
        if not has_wheelbase and not _is_changed(model, "wheelbase"):
            remarks.append(
                f"{ASSUMED} {model.wheelbase:g} m; give your car's, such as "
                "estimator.wheelbase=2.9, or car: {wheelbase: 2.9} in conf/dataset/NAME.yaml"
            )
    if record is not None:
        model = calibrated(model, record)
    if settings:
        model = with_settings(model, dict(settings))
    if trust is not None and model is not before:
        trust = trust.for_settings(model)
    return model, trust, remarks


def with_car_values(config: dict[str, Any], cars: Iterable[CarValues]) -> dict[str, Any]:
    """The configuration of a training with the wheelbase and centre of gravity of its one car.

    They replace settings of null and the default wheelbases of `DEFAULT_WHEELBASES`. Other settings
    stay, as do all where the cars have no wheelbase or different ones.

    Parameters
    ----------
    config : dict
        Composed, with ``estimator``; it is not changed.
    cars : iterable of CarValues
        Of the training's data sets.
    """
    settings = config["estimator"]
    unstated = {None, DEFAULT_WHEELBASES.get(settings["name"])}
    if settings.get("wheelbase", 0.0) not in unstated:
        return config
    different_cars = set(cars)
    if len({car.wheelbase for car in different_cars}) != 1:
        return config
    car = different_cars.pop()
    if car.wheelbase is None:
        return config
    if different_cars:  # of one wheelbase, with different centres of gravity
        car = CarValues(car.wheelbase)
    values = {
        name: getattr(car, name) for name in CAR_SETTINGS if settings.get(name, 0.0) in unstated
    }
    return {**config, "estimator": {**settings, **values}}


def _values_of_dataset(
    model: SelfCalibrating,
    car: CarValues,
    settings: Mapping[str, Any],
    record: CarRecord | None,
) -> dict[str, float]:
    """Values of a data set's car that command line, record and training leave open."""
    wheelbase = settings.get("wheelbase", None if record is None else record.wheelbase)
    if wheelbase not in (None, car.wheelbase):
        return {}  # another car is meant
    return {
        name: value
        for name in CAR_SETTINGS
        if (value := getattr(car, name)) is not None
        and name not in settings
        and not _is_changed(model, name)
    }


def _is_changed(model: SelfCalibrating, name: str) -> bool:
    """Whether a setting of a model is another than the default."""
    return bool(getattr(model.settings, name) != getattr(SelfCalibrating.settings_type(), name))


def calibrated(
    model: Estimator, record: CarRecord, widening: float = DEVIATION_FACTOR
) -> SelfCalibrating:
    """The filter with a car's wheelbase and, as priors, its leakage and rear axle.

    Deviations are widened. Errors are those of `with_settings`.

    Compliance and grip are found anew: tyres and road change them, and estimates that started from
    them were worse.

    Parameters
    ----------
    model : Estimator
        The self-calibrating filter.
    record : CarRecord
        Of the car.
    widening : float
        Factor of the record's standard deviations. That of the leakage is never larger than the
        model's.
    """
    changed: dict[str, Any] = {"wheelbase": record.wheelbase}
    if record.cg_to_rear_axle is not None:
        changed["cg_to_rear_axle"] = record.cg_to_rear_axle
    base = with_settings(model, changed)
    leakage = record.leakage
    rear = record.rear_axle
    if leakage.identified_on:
        changed |= {
            "leakage": leakage.value,
            "leakage_deviation": min(widening * leakage.deviation, base.leakage_deviation),
        }
    if rear.identified_on:
        changed |= {
            "imu_to_rear_axle": rear.value,
            "imu_deviation": widening * rear.deviation / record.wheelbase,
        }
    return with_settings(model, changed)


def read_car(path: Path) -> CarRecord:
    """Read a car's record back.

    Raises `MissingError`, or `DataError` where it is damaged, of another format or not of a car.
    """
    content = read_yaml(path)
    if not isinstance(content, dict) or "format" not in content:
        raise DataError(f"'{path}' is no record of a car as vehest identify writes it")
    check_format(content.pop("format"), FORMAT, f"'{path}'")
    try:
        return validated(CarRecord, content, f"'{path}'")
    except DataError as error:
        raise error if str(path) in str(error) else DataError(f"'{path}': {error}") from None
