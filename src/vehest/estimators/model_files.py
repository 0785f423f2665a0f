"""Fitted estimators on disk: weights as safetensors, settings as YAML; loading executes no code from the files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import yaml
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from vehest.data.errors import DataError, MissingError
from vehest.estimators.base import Estimator
from vehest.estimators.registry import estimator_class
from vehest.training.checkpoints import as_os_error

WEIGHTS = "model.safetensors"
DESCRIPTION = "model.yaml"
FORMAT = 1


def save_model(estimator: Estimator, folder: Path, about: Mapping[str, Any] | None = None) -> None:
    """Write a fitted estimator into an existing folder.

    Args:
        estimator: fitted.
        folder: where to.
        about: plain values to keep beside it, for people.

    Raises:
        OSError: it cannot be written.
    """
    description = {
        "format": FORMAT,
        "estimator": estimator.name,
        "variant": estimator.variant,
        "settings": asdict(estimator.settings),
        "channels": list(estimator.channels),
        "about": dict(about or {}),
    }
    (folder / DESCRIPTION).write_text(yaml.safe_dump(description, sort_keys=False, allow_unicode=True), encoding="utf-8")
    try:
        save_file(estimator.weights(), folder / WEIGHTS)
    except SafetensorError as error:
        raise as_os_error(error) from error


def load_model(folder: Path) -> Estimator:
    """Read a fitted estimator back.

    Raises:
        MissingError: there is no model.
        DataError: a file is damaged, or the weights do not fit the settings.
        ConfigurationError: the estimator's name is unknown.
    """
    description = read_description(folder)
    try:
        weights = load_file(folder / WEIGHTS)
    except FileNotFoundError:
        raise MissingError(f"'{folder}' has no {WEIGHTS}; train the model again") from None
    except (SafetensorError, OSError, ValueError) as error:
        raise DataError(f"'{folder / WEIGHTS}' is truncated or damaged ({str(error).splitlines()[0]}); train the model again") from error
    estimator = estimator_class(str(description["estimator"])).from_config(description["settings"])
    estimator.load_weights(weights)
    return estimator


def read_description(folder: Path) -> dict[str, Any]:
    """What a model folder says about itself.

    Raises:
        MissingError: there is no model.
        DataError: the description is damaged.
    """
    path = folder / DESCRIPTION
    if not path.is_file():
        raise MissingError(f"'{folder}' holds no model: there is no {DESCRIPTION} in it")
    try:
        description = yaml.safe_load(path.read_text(encoding="utf-8"))
        if not isinstance(description, dict) or not {"format", "estimator", "settings"} <= set(description):
            raise DataError(f"'{path}' is not the description of a model; train it again")
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise DataError(f"'{path}' is damaged ({str(error).splitlines()[0]}); train the model again") from error
    if description["format"] > FORMAT:
        raise DataError(f"'{path}' was written by a newer vehest (format {description['format']}); update vehest")
    return description
