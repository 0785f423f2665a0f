"""Fitted estimators on disk.

Weights as safetensors, settings as YAML; loading executes no code from the files.

A model is a folder of two files. ``model.yaml`` (`Description`) names the family by its registry
name, never by an import path, with settings and origin; ``model.safetensors`` has the weights.
`load_model` checks both before anything is built: format, version, known settings, finite numbers,
and that the settings do not ask for more memory than the file has weights.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from vehest.data.errors import ConfigurationError, DataError, MissingError, VehestError
from vehest.data.files import as_os_error, regular_file, sha256_of
from vehest.data.schema import FURTHER_KEYS, check_format, validated
from vehest.data.text_files import first_line, read_yaml
from vehest.data.transforms import Preparation
from vehest.estimators.base import Estimator
from vehest.estimators.registry import estimator_class

WEIGHTS = "model.safetensors"  # name of the file of weights
DESCRIPTION = "model.yaml"  # name of the file of settings and origin
FORMAT = 1  # version of the layout; folders of another one are refused
DTYPES = ("F32", "F64")  # data types of tensors that are read
# former name of a family in files of a model -> name
RENAMED = {"learned_ukf_variant": "learned_ukf"}
MIN_CHECKED_SIZE = 4096
"""A whole number among the settings that is larger than this and than the number of weights is no
layer's width.
"""


def current_name(estimator: str) -> str:
    """The name of a family today, by the name in a file of a model."""
    return RENAMED.get(estimator, estimator)


@dataclass(frozen=True)
class About:
    """Origin of a model, the entry ``about`` of model.yaml; further keys are kept, but not used."""

    __pydantic_config__ = FURTHER_KEYS
    seed: int = 0  # seed of the training
    datasets: tuple[str, ...] = ()  # names of the data sets that it was trained on
    trained_on: tuple[str, ...] = ()  # ranges of recordings that it was trained on
    validated_on: tuple[str, ...] = ()  # ranges on which the training was stopped early
    n_parameters: int | None = None  # number of fitted values; None: not stated
    # resampling by which recordings were brought to the model's rate
    downsample: Preparation = field(default_factory=Preparation)
    interrupted: bool = False  # whether the training was stopped before its end
    note: str = ""  # remark for users on the model's estimates


@dataclass(frozen=True)
class Description:
    """Content of model.yaml."""

    format: int  # version of the layout
    estimator: str  # name in the registry, never an import path
    settings: dict[str, Any]  # settings of the estimator, plain values
    variant: str = ""  # the paper's name of the configuration
    channels: tuple[str, ...] = ()  # channels that the estimator reads
    about: About = field(default_factory=About)  # origin
    version: str = "1"  # version of the family's code; folders older than this entry have none


def save_model(estimator: Estimator, folder: Path, about: Mapping[str, Any] | None = None) -> None:
    """Write a fitted estimator into an existing folder.

    ``about`` has plain values of the fields of `About`, and perhaps further keys.

    Raises
    ------
    DataError
        A weight is not finite, before anything is written.
    OSError
        It cannot be written.
    """
    weights = estimator.weights()
    trained_on = ", ".join((about or {}).get("trained_on", ())) or "its recordings"
    for name, values in weights.items():
        n_bad = _count_not_finite(estimator, name, values)
        if n_bad:
            raise DataError(
                f"estimator '{estimator.name}': {n_bad} of the {values.size} numbers of '{name}' "
                f"are not finite after the training on {trained_on}, which does not determine "
                "them; train it on other drives"
            )
    description = {
        "format": FORMAT,
        "estimator": estimator.name,
        "version": estimator.version,
        "variant": estimator.variant,
        "settings": asdict(estimator.settings),
        "channels": list(estimator.channels),
        "about": dict(about or {}),
    }
    (folder / DESCRIPTION).write_text(
        yaml.safe_dump(description, sort_keys=False, allow_unicode=True), encoding="utf-8"
    )
    try:
        save_file(weights, folder / WEIGHTS)
    except SafetensorError as error:
        raise as_os_error(error) from error


def load_model(folder: Path) -> Estimator:
    """Read a fitted estimator back.

    Returns
    -------
    Estimator
        Fitted; its ``preparation`` and ``trust`` are left as they are by default.

    Raises
    ------
    MissingError
        There is no model.
    DataError
        A file is damaged or of another format, the estimator is unknown, a weight is not
        finite, or the weights do not fit the settings.
    """
    description = read_description(folder)
    path = folder / DESCRIPTION
    try:
        kind = estimator_class(description.estimator)
    except ConfigurationError as error:
        raise DataError(f"'{path}': {error}") from None
    if description.version != kind.version:
        raise DataError(
            f"'{folder}' holds version {description.version} of '{kind.name}', whose estimates "
            f"differ from those of version {kind.version} here; train it again, or use the vehest "
            "that trained it"
        )
    weights = _read_weights(folder, kind)
    estimator = _built(
        kind, description.settings, sum(values.size for values in weights.values()), path
    )
    try:
        estimator.load_weights(weights)
    except VehestError as error:
        raise DataError(f"'{folder / WEIGHTS}': {error}") from None
    except (TypeError, ValueError, KeyError, IndexError, StopIteration, RuntimeError) as error:
        raise DataError(
            f"'{folder / WEIGHTS}' does not fit the settings in {DESCRIPTION} ({first_line(error)})"
        ) from error
    return estimator


def read_description(folder: Path) -> Description:
    """Read the description of a model folder.

    Raises
    ------
    MissingError
        There is no model.
    DataError
        The description is damaged, or of another format.
    """
    path = folder / DESCRIPTION
    try:
        content = read_yaml(path)
    except MissingError:
        raise MissingError(f"'{folder}' holds no model: there is no {DESCRIPTION} in it") from None
    if not isinstance(content, dict) or not {"format", "estimator", "settings"} <= set(content):
        raise DataError(f"'{path}' is not the description of a model; train it again")
    check_format(content["format"], FORMAT, f"'{path}'")
    described = validated(Description, content, f"'{path}'")
    name = current_name(described.estimator)
    return replace(described, estimator=name, settings=content["settings"])


def model_digest(folder: Path) -> str:
    """SHA-256 of what determines a model's estimates.

    Its weights, and of its description all but words for people.

    Raises `MissingError` or `DataError`: a file is missing or damaged.
    """
    described = read_description(folder)
    content = {
        "estimator": described.estimator,
        "version": described.version,
        "settings": described.settings,
        "channels": described.channels,
        "downsample": asdict(described.about.downsample),
        "weights": sha256_of(regular_file(folder / WEIGHTS)),
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _built(
    kind: type[Estimator], settings: Mapping[str, Any], n_weights: int, path: Path
) -> Estimator:
    """Build an estimator, unless its settings need more parameters than there are weights.

    A whole number among the settings that exceeds the number of weights and `MIN_CHECKED_SIZE` is
    refused before anything of that size is allocated.

    Raises
    ------
    DataError
        They ask for more, or make no sense.
    """
    for name, number in _integers(settings, "settings"):
        if number > max(MIN_CHECKED_SIZE, n_weights):
            raise DataError(
                f"'{path}': {name} is {number:.4g}, and {WEIGHTS} holds {n_weights} numbers; the "
                "two do not belong together"
            )
    try:
        validated_settings = validated(
            kind.settings_type, dict(settings), f"'{path}'", group="settings"
        )
        try:
            n_required = kind(validated_settings).min_weights()
        except NotImplementedError:  # of torch, where building it needs values of tensors
            n_required = 0
        except (RuntimeError, TypeError, ValueError, OverflowError) as error:
            raise DataError(
                f"'{path}': no estimator can be built with these settings ({first_line(error)})"
            ) from error
        if n_required > n_weights:
            raise DataError(
                f"'{path.parent / WEIGHTS}' holds {n_weights} numbers, which do not fit its "
                f"settings: they need {n_required}"
            )
        return kind(validated_settings)
    except ConfigurationError as error:
        raise DataError(f"'{path}': {error}") from None


def _integers(content: Any, name: str) -> Iterator[tuple[str, int]]:
    """Dotted names and values of the whole numbers in plain values."""
    if isinstance(content, int) and not isinstance(content, bool):
        yield name, content
    elif isinstance(content, Mapping | list):
        for key, inner in content.items() if isinstance(content, Mapping) else enumerate(content):
            yield from _integers(inner, f"{name}.{key}")


def _count_not_finite(
    kind: Estimator | type[Estimator], name: str, values: np.ndarray[Any, Any]
) -> int:
    """Number of values of the tensor ``name`` that are not finite, though they must be."""
    return int((np.isinf(values) if name in kind.may_be_nan else ~np.isfinite(values)).sum())


def _read_weights(folder: Path, kind: type[Estimator]) -> dict[str, np.ndarray[Any, Any]]:
    """Read and check the weights of a model folder, by name.

    Raises
    ------
    MissingError
        There are none.
    DataError
        The file is damaged, or holds other numbers than finite float32 and float64.
    """
    path = folder / WEIGHTS
    try:
        regular_file(path)
    except MissingError:
        raise MissingError(f"'{folder}' has no {WEIGHTS}; train the model again") from None
    weights = {}
    try:
        with safe_open(path, framework="np") as file:
            for name in file.keys():  # noqa: SIM118
                dtype = file.get_slice(name).get_dtype()
                if dtype not in DTYPES:
                    raise DataError(
                        f"'{path}': tensor '{name}' is of type {dtype}, not one of: "
                        f"{', '.join(DTYPES)}"
                    )
                weights[name] = file.get_tensor(name)
    except (SafetensorError, OSError, ValueError) as error:
        raise DataError(
            f"'{path}' is truncated or damaged ({first_line(error)}); train the model again"
        ) from error
    for name, values in weights.items():
        n_bad = _count_not_finite(kind, name, values)
        if n_bad:
            raise DataError(
                f"'{path}': {n_bad} of the {values.size} numbers of tensor '{name}' are not "
                "finite; train the model again"
            )
    return weights
