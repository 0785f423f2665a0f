"""Running a trained model on a new recording that has no reference channels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from vehest.alignment.checks import checks_of_recording
from vehest.data.channels import REFERENCE_SUFFIX
from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.estimate import QUANTITIES, Estimate
from vehest.data.files import written_aside
from vehest.data.limits import limits_from_config, use_limits
from vehest.data.recording import Recording
from vehest.data.store import write_estimate
from vehest.data.transforms import OF_REFERENCES
from vehest.estimators.base import Estimator
from vehest.estimators.model_files import read_description
from vehest.sources.base import read_single
from vehest.stages.config import compose_config
from vehest.stages.downsample import transforms_of

SUFFIXES = (".parquet", ".csv")
PRETRAINED = "pretrained"
"""Name of the model that comes with vehest, for cars that nobody has trained on."""


def pretrained_folder() -> Path:
    """Where the model that comes with vehest lies."""
    return Path(__file__).resolve().parents[1] / PRETRAINED


def pretrained_note() -> str:
    """What people should know of an estimate by the model that comes with vehest.

    Raises:
        MissingError: it is not installed.
        DataError: its description is damaged.
    """
    return " ".join(read_description(pretrained_folder()).about.note.split())


def find_model(name: str, output: Path) -> Path:
    """A model's folder, by path or by the start of its name in the output root; ``pretrained`` is the one that comes with vehest.

    Raises:
        MissingError: there is none.
        ConfigurationError: several have that name.
    """
    given = Path(name)
    if given.is_dir():
        return given
    if name == PRETRAINED:
        return pretrained_folder()
    found = sorted(folder for folder in (output / "train").glob(f"{given.name}*") if folder.is_dir() and not folder.name.startswith("."))
    if not found:
        known = sorted(folder.name for folder in (output / "train").glob("[!.]*"))
        listed = f" (there are: {', '.join(known[:8])}{', …' if len(known) > 8 else ''})" if known else "; train one first"
        raise MissingError(f"there is no model '{name}', neither a folder nor in '{output / 'train'}'{listed}")
    if len(found) > 1:
        raise ConfigurationError(f"'{name}' could be any of: {', '.join(folder.name for folder in found[:8])}; say more of the name")
    return found[0]


def read_table(path: Path, overrides: Sequence[str] = (), *, references: bool = False) -> Recording:
    """Read a recording from its file, a table unless the data set says otherwise, as conf/estimate.yaml and overrides describe it.

    Args:
        path: the file.
        overrides: of conf/estimate.yaml.
        references: whether reference channels that the data set declares are read.

    Raises:
        MissingError: there is no such file.
        DataError: it cannot be used as it is.
        ConfigurationError: the file is of another format than the data set's.
    """
    config = compose_config("estimate", overrides)
    with use_limits(limits_from_config(config["limits"])):
        return _read_table(path, config["dataset"], references)


def _without_references(dataset: dict[str, Any]) -> dict[str, Any]:
    """A data set's options for a new drive, which needs no reference channels, whatever is declared; not validated yet."""
    channels, transforms = dataset.get("channels"), dataset.get("transforms")
    if isinstance(channels, dict):
        channels = {name: entry for name, entry in channels.items() if not str(name).endswith(REFERENCE_SUFFIX)}
    if isinstance(transforms, list | tuple):
        transforms = [entry for entry in transforms if not (isinstance(entry, dict) and str(entry.get("name")) in OF_REFERENCES)]
    changed = {"channels": channels or None, "transforms": transforms or None, "reference_point": None, "pose": None}
    return {key: value for key, value in dataset.items() if key not in changed} | {key: new for key, new in changed.items() if new}


def _read_table(path: Path, dataset: dict[str, Any], references: bool) -> Recording:
    if not references:
        dataset = _without_references(dataset)
    recording = read_single(dataset, path)
    accepted = set(dataset.get("accept") or [])
    for finding in checks_of_recording(recording):
        if finding.level == "error" and finding.check not in accepted:
            raise DataError(f"'{path}': channel '{finding.channel}': {finding.message} (or dataset.accept=[{finding.check}])")
    return recording


def estimate_recording(model: Estimator, recording: Recording, downsample: dict[str, Any]) -> Estimate:
    """Bring a recording to the model's rate and run the model on it.

    Args:
        model: fitted.
        recording: with the channels that the model reads, at any rate from the model's upwards.
        downsample: method and transforms, as in `preparation_of`.

    Raises:
        DataError: a channel is missing, or the recording is sampled too slowly.
    """
    rate = model.settings.rate_hz
    needed = recording.select(model.channels) if all(name in recording for name in model.channels) else recording
    for name in model.channels:
        if name not in needed:
            raise DataError(
                f"recording '{recording.id}' has no channel '{name}', which '{model.name}' needs (it reads {', '.join(model.channels)})"
            )
    if recording.rate_hz < rate * (1 - 1e-9):
        raise DataError(
            f"recording '{recording.id}' is sampled at {recording.rate_hz:g} Hz, below the {rate:g} Hz that '{model.name}' works at"
        )
    for transform in transforms_of({"rate_hz": rate, **downsample}):
        needed = transform(needed)
    estimate = model.estimate([needed])[0]
    if np.isnan(estimate["vy"]).all():
        raise DataError(f"recording '{recording.id}' lasts {recording.duration:.3g} s, too short for '{model.name}' to estimate anything")
    return estimate


def write_estimate_table(estimate: Estimate, path: Path) -> None:
    """Write an estimate as Parquet or CSV, by the file's ending.

    Raises:
        ConfigurationError: another ending.
        MissingError: it cannot be written.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigurationError(f"'{path}' must end in {' or '.join(SUFFIXES)}")
    if path.suffix.lower() == ".parquet":
        write_estimate(estimate, path)
        return
    frame = pd.DataFrame({"time": estimate.time, **estimate.channels})
    with written_aside(path) as aside:
        frame.to_csv(aside, index=False, lineterminator="\n")


def preparation_of(model_folder: Path) -> dict[str, Any]:
    """How a model's recordings were brought to its rate when it was trained; a new one must be prepared the same way."""
    return read_description(model_folder).about.downsample.as_plain()


def summary_of(estimate: Estimate) -> dict[str, Any]:
    """What an estimate holds, for people and scripts."""
    known = estimate["vy"][~pd.isna(estimate["vy"])]
    degrees = [math.degrees(value) for value in (estimate["sideslip"][~pd.isna(estimate["sideslip"])])] or [math.nan]
    return {
        "recording": estimate.recording_id,
        "estimator": estimate.estimator,
        "rate_hz": estimate.rate_hz,
        "samples": len(estimate),
        "estimated": len(known),
        "quantities": {name: QUANTITIES[name] for name in estimate.channels},
        "sideslip_deg": {"min": round(min(degrees), 3), "max": round(max(degrees), 3)},
    }
