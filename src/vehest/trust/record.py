"""Bands, limits and health of a model, read from and written to trust.yaml."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import yaml

from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.data.schema import check_format, validated
from vehest.data.text_files import read_yaml
from vehest.trust.bands import Bands
from vehest.trust.guard import GuardLimits
from vehest.trust.health import HealthModel

TRUST = "trust.yaml"
FORMAT = 1


@dataclass(frozen=True)
class About:
    """The model."""

    estimator: str  # name in the registry
    variant: str = ""  # what the paper calls it
    note: str = ""  # why something is missing, for people; empty where nothing is


@dataclass(frozen=True)
class Trust:
    """Bands, limits and health of a model; None if not learnt."""

    about: About  # whose it is
    bands: Bands | None = None  # calibrated half widths
    guard: GuardLimits | None = None  # limits of plausible samples
    health: HealthModel | None = None  # residuals and thresholds of the health flag


def is_other_vehicle(trust: Trust | None, recording: Recording) -> bool:
    """Whether a recording is of another vehicle than those that bands were calibrated on."""
    return (
        trust is not None and trust.bands is not None and not trust.bands.are_of(recording.vehicle)
    )


def write_trust(trust: Trust, folder: Path) -> None:
    """Write trust.yaml into an existing folder; raises `OSError` where it cannot be written."""
    content = json.loads(json.dumps({"format": FORMAT, **asdict(trust)}))  # tuples as lists
    (folder / TRUST).write_text(
        yaml.safe_dump(content, sort_keys=False, allow_unicode=True), encoding="utf-8"
    )


def read_trust(folder: Path) -> Trust:
    """Read trust.yaml of a folder back; raises `MissingError` where there is none, `DataError` where it is damaged or of another format."""
    path = folder / TRUST
    content = read_yaml(path)
    if not isinstance(content, dict) or "format" not in content:
        raise DataError(f"'{path}' does not say how far a model can be trusted; calibrate it again")
    check_format(content.pop("format"), FORMAT, f"'{path}'")
    try:
        return validated(Trust, content, f"'{path}'")
    except DataError as error:
        raise DataError(str(error) if str(path) in str(error) else f"'{path}': {error}") from None
