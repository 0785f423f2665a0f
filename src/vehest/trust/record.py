"""Bands, limits and health of a model, read from and written to trust.yaml."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import yaml

from vehest.data.car import UNKNOWN_CAR, CarValues
from vehest.data.errors import DataError
from vehest.data.recording import UNNAMED_VEHICLE
from vehest.data.schema import check_format, validated
from vehest.data.text_files import read_yaml
from vehest.estimators.base import Estimator
from vehest.estimators.model_files import current_name
from vehest.trust.bands import Bands
from vehest.trust.guard import GuardLimits
from vehest.trust.health import HealthModel

TRUST = "trust.yaml"  # name of the file
FORMAT = 1  # version of its layout; files of another one are refused


@dataclass(frozen=True)
class About:
    """The model that a `Trust` belongs to."""

    estimator: str  # name in the registry
    variant: str = ""  # the paper's name of the configuration
    note: str = ""  # text on why something is missing; empty where nothing is
    model: str = ""  # digest of the model beside which it is kept; empty in a folder of its own


@dataclass(frozen=True)
class Trust:
    """Bands, limits and health of a model; None if not calibrated."""

    about: About  # the model that it was calibrated with
    bands: Bands | None = None  # calibrated half widths
    guard: GuardLimits | None = None  # limits of plausible samples
    health: HealthModel | None = None  # residuals and thresholds of the health flag

    def check_fit(self, estimator: Estimator) -> None:
        """Raise `DataError` unless family, channels, rate and horizon are those of an estimator."""
        channels = tuple(estimator.channels)
        differences: list[tuple[str, object, object]] = [
            ("about.estimator", current_name(self.about.estimator), estimator.name)
        ]
        if self.bands is not None:
            differences += [
                ("bands.channels", self.bands.channels, channels),
                ("bands.horizon_steps", self.bands.horizon_steps, estimator.horizon_steps),
            ]
        if self.health is not None:
            differences += [
                ("health.channels", self.health.channels, channels),
                ("health.rate_hz", self.health.rate_hz, estimator.settings.rate_hz),
            ]
        for name, value, expected_value in differences:
            if value != expected_value:
                raise DataError(
                    f"{TRUST} belongs to another model: its {name} is {_abbreviated(value)}, that "
                    "of the "
                    f"model is {_abbreviated(expected_value)}; calibrate the model again, or "
                    f"remove {TRUST}"
                )

    def for_settings(self, estimator: Estimator) -> Trust:
        """The parts that apply to the same model with other settings, those of ``estimator``.

        Health is that of all channels together and is left out where these differ; a band counts
        a channel that is not read as not measured.
        """
        channels = tuple(estimator.channels)
        expected = (channels, estimator.settings.rate_hz)
        health = self.health
        if health is not None and (health.channels, health.rate_hz) != expected:
            health = None
        bands = self.bands
        if bands is not None:
            bands = replace(bands, channels=channels, horizon_steps=estimator.horizon_steps)
        return replace(self, bands=bands, health=health)


def is_other_vehicle(
    trust: Trust | None,
    vehicle: str,
    same_vehicle: bool | None = None,
    car: CarValues = UNKNOWN_CAR,
) -> bool:
    """Whether a recording is of another vehicle than those that bands were calibrated on.

    Parameters
    ----------
    trust : Trust or None
        Calibration of the model; without bands the answer is False.
    vehicle : str
        Name of the recording's car; the rule is that of `Bands.are_of`.
    same_vehicle : bool, optional
        Answer of the user, which comes first.
    car : CarValues
        Values of the recording's car.
    """
    if trust is None or trust.bands is None:
        return False
    if same_vehicle is not None:
        return not same_vehicle
    return not trust.bands.are_of(vehicle, car)


def describe_band(
    trust: Trust | None,
    vehicle: str,
    same_vehicle: bool | None = None,
    car: CarValues = UNKNOWN_CAR,
) -> str:
    """Describe which vehicles the band of an estimate was calibrated on, and whether and why it is
    widened; empty without a band.

    The rules are those of `is_other_vehicle`.
    """
    if trust is None or trust.bands is None:
        return ""
    bands = trust.bands
    datasets = ", ".join(bands.datasets)
    if not bands.vehicles and same_vehicle is None:
        return f"calibrated on drives of many cars ({datasets}): for any car"
    names = [f"'{name}'" for name in bands.vehicles if name != UNNAMED_VEHICLE]
    cars = ", ".join(names) or ("a car without a name" if bands.vehicles else "many cars")
    basis = f"calibrated on recordings of {cars} ({datasets})"
    if same_vehicle is not None:
        answer = "the same car" if same_vehicle else "another car: band doubled"
        return f"{basis}; this one is of {answer}, as same_vehicle says"
    if difference := bands.difference_to(car):
        remedy = "if it is the same, correct car of the data set, or give same_vehicle=true"
        return f"{basis}; this one is of another car ({difference}): band doubled; {remedy}"
    if is_other_vehicle(trust, vehicle):
        remedy = "if it is the same, give same_vehicle=true, or its name as vehicle of the data set"
        answer = "assumed to be of" if vehicle == UNNAMED_VEHICLE else f"of '{vehicle}',"
        return f"{basis}; this one is {answer} another car: band doubled; {remedy}"
    if names and vehicle in bands.vehicles:
        return f"{basis}; this one is of the same car, by its name"
    remedy = "if it is another, give same_vehicle=false, which doubles the band"
    by = "neither names nor values of car" if bands.cars and car != UNKNOWN_CAR else "no names"
    return f"{basis}; this one is assumed to be of the same car, as {by} differ; {remedy}"


def write_trust(trust: Trust, folder: Path, model: str = "") -> None:
    """Write trust.yaml into an existing folder; raises `OSError` where it cannot be written.

    ``model`` is the digest of the model in the same folder (`model_digest`). Without it the file
    names no model: the manifest of a calibration does.

    Parameters
    ----------
    trust : Trust
        Fields that earlier versions did not have are left out where they are empty, so that files
        stay the same.
    folder : Path
        Existing; trust.yaml in it is replaced.
    model : str
        SHA-256, or empty.
    """
    content = json.loads(json.dumps({"format": FORMAT, **asdict(trust)}))  # tuples as lists
    del content["about"]["model"]
    for name in ("cars", "tyre_check") if content["bands"] else ():
        if not content["bands"][name]:
            del content["bands"][name]
    content["about"] |= {"model": model} if model else {}
    (folder / TRUST).write_text(
        yaml.safe_dump(content, sort_keys=False, allow_unicode=True), encoding="utf-8"
    )


def read_trust(folder: Path) -> Trust:
    """Read trust.yaml of a folder back.

    Raises
    ------
    MissingError
        There is none.
    DataError
        It is damaged, of another format, or something else than a file.
    """
    path = folder / TRUST
    content = read_yaml(path)
    if not isinstance(content, dict) or "format" not in content:
        raise DataError(f"'{path}' does not say how far a model can be trusted; calibrate it again")
    check_format(content.pop("format"), FORMAT, f"'{path}'")
    try:
        return validated(Trust, content, f"'{path}'")
    except DataError as error:
        raise DataError(str(error) if str(path) in str(error) else f"'{path}': {error}") from None


def _abbreviated(value: object) -> str:
    """Text of a value for a message, of at most 80 characters."""
    text = ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)
    return text if len(text) <= 80 else f"{text[:80]} …"
