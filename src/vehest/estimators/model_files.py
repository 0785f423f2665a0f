"""Fitted estimators on disk: weights as safetensors, settings as YAML; loading executes no code from the files."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from vehest.data.errors import ConfigurationError, DataError, MissingError, VehestError
from vehest.data.files import as_os_error, regular_file
from vehest.data.limits import check_limit
from vehest.data.schema import FURTHER_KEYS, check_format, validated
from vehest.data.text_files import first_line, parse_json, read_yaml
from vehest.data.transforms import Preparation
from vehest.estimators.base import Estimator
from vehest.estimators.registry import estimator_class

WEIGHTS = "model.safetensors"
DESCRIPTION = "model.yaml"
FORMAT = 1
DTYPES = ("F32", "F64")
USUAL_SIZE = 4096
"""A whole number among the settings that is larger than this and than the number of weights is no layer's width."""


@dataclass(frozen=True)
class About:
    """How a model came to be, as ``about`` of model.yaml says it; further keys are for people.

    Args:
        seed: of the fit.
        datasets: names of the data sets that it learnt on.
        trained_on: ranges that it learnt on.
        validated_on: ranges that it was stopped on.
        n_parameters: how many numbers the fit determined.
        downsample: how recordings were brought to its rate.
        interrupted: whether the fit was stopped before it was over.
        note: what people should know of its estimates.
    """

    __pydantic_config__ = FURTHER_KEYS
    seed: int = 0
    datasets: tuple[str, ...] = ()
    trained_on: tuple[str, ...] = ()
    validated_on: tuple[str, ...] = ()
    n_parameters: int | None = None
    downsample: Preparation = field(default_factory=Preparation)
    interrupted: bool = False
    note: str = ""


@dataclass(frozen=True)
class Description:
    """What model.yaml says.

    Args:
        format: version of the layout.
        estimator: name in the registry, never an import path.
        settings: of the estimator, plain values.
        variant: what the paper calls it.
        channels: measured channels that it reads.
        about: how it came to be.
        version: of the estimator; folders older than this entry have "1".
    """

    format: int
    estimator: str
    settings: dict[str, Any]
    variant: str = ""
    channels: tuple[str, ...] = ()
    about: About = field(default_factory=About)
    version: str = "1"


def save_model(estimator: Estimator, folder: Path, about: Mapping[str, Any] | None = None) -> None:
    """Write a fitted estimator into an existing folder.

    Args:
        estimator: fitted.
        folder: where to.
        about: plain values to keep beside it: those of `About`, and others for people.

    Raises:
        OSError: it cannot be written.
    """
    description = {
        "format": FORMAT,
        "estimator": estimator.name,
        "version": estimator.version,
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
        DataError: a file is damaged or of another format, the estimator is unknown, a weight is not finite, or the weights do not fit the
            settings.
    """
    description, path = read_description(folder), folder / DESCRIPTION
    try:
        kind = estimator_class(description.estimator)
    except ConfigurationError as error:
        raise DataError(f"'{path}': {error}") from None
    if description.version != kind.version:
        raise DataError(
            f"'{folder}' holds version {description.version} of '{kind.name}', whose estimates differ from those of version {kind.version} "
            f"here; train it again, or use the vehest that trained it"
        )
    weights = _read_weights(folder)
    estimator = _built(kind, description.settings, sum(values.size for values in weights.values()), path)
    _refuse_non_finite(weights, estimator.open_weights, folder / WEIGHTS)
    try:
        estimator.load_weights(weights)
    except VehestError as error:
        raise DataError(f"'{folder / WEIGHTS}': {error}") from None
    except (TypeError, ValueError, KeyError, IndexError, StopIteration, RuntimeError) as error:
        raise DataError(f"'{folder / WEIGHTS}' does not fit the settings in {DESCRIPTION} ({first_line(error)})") from error
    return estimator


def read_description(folder: Path) -> Description:
    """What a model folder says about itself.

    Raises:
        MissingError: there is no model.
        DataError: the description is damaged, or of another format.
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
    return replace(described, settings=content["settings"])


def _built(kind: type[Estimator], settings: Mapping[str, Any], n_weights: int, path: Path) -> Estimator:
    """An estimator of these settings, once they are known to ask for no more parameters than there are weights.

    Raises:
        DataError: they ask for more, or make no sense.
    """
    for name, number in _whole_numbers(settings, "settings"):
        if number > max(USUAL_SIZE, n_weights):
            raise DataError(f"'{path}': {name} is {number:.4g}, and {WEIGHTS} holds {n_weights} numbers; the two do not belong together")
    try:
        own = validated(kind.settings_type, dict(settings), f"'{path}'", group="settings")
        needed = _parameters_without_memory(kind, own)
        if needed > n_weights:
            raise DataError(f"'{path.parent / WEIGHTS}' holds {n_weights} numbers, which do not fit its settings: they need {needed}")
        return kind(own)
    except ConfigurationError as error:
        raise DataError(f"'{path}': {error}") from None


def _parameters_without_memory(kind: type[Estimator], settings: Any) -> int:
    """How many parameters an estimator of these settings has; 0 where building it needs values."""
    try:
        with torch.device("meta"):
            return kind(settings).n_parameters
    except (RuntimeError, NotImplementedError, TypeError, ValueError, OverflowError):
        return 0


def _whole_numbers(content: Any, name: str) -> Iterator[tuple[str, int]]:
    """Dotted names and values of the whole numbers in plain values."""
    if isinstance(content, Mapping):
        for key, inner in content.items():
            yield from _whole_numbers(inner, f"{name}.{key}")
    elif isinstance(content, list):
        for position, inner in enumerate(content):
            yield from _whole_numbers(inner, f"{name}.{position}")
    elif isinstance(content, int) and not isinstance(content, bool):
        yield name, content


@dataclass(frozen=True)
class _Tensor:
    """A tensor as the header of a safetensors file declares it."""

    dtype: str
    shape: tuple[int, ...]
    data_offsets: tuple[int, int]


def _read_weights(folder: Path) -> dict[str, np.ndarray[Any, Any]]:
    """Weights by name, of the lengths that the file itself has.

    Raises:
        MissingError: there are none.
        DataError: the file is damaged, or holds other numbers than float32 and float64.
    """
    path = folder / WEIGHTS
    try:
        size = regular_file(path).stat().st_size
    except MissingError:
        raise MissingError(f"'{folder}' has no {WEIGHTS}; train the model again") from None
    try:
        with open(path, "rb") as stream:
            length = int.from_bytes(stream.read(8), "little")
            if not 0 < length <= size - 8:
                raise DataError(f"'{path}' is truncated or damaged (a header of {length} bytes in a file of {size}); train the model again")
            check_limit("text_bytes", length, f"'{path}' has a header of {length} bytes")
            header = parse_json(stream.read(length), f"'{path}'")
        if not isinstance(header, dict):
            raise DataError(f"'{path}' is truncated or damaged (its header is no mapping); train the model again")
        for name, entry in header.items():
            if name != "__metadata__":
                _check_tensor(validated(_Tensor, entry, f"'{path}': tensor '{name}'"), name, size - 8 - length, path)
        return load_file(path)
    except (SafetensorError, OSError, ValueError) as error:
        raise DataError(f"'{path}' is truncated or damaged ({first_line(error)}); train the model again") from error


def _check_tensor(tensor: _Tensor, name: str, n_bytes: int, path: Path) -> None:
    if tensor.dtype not in DTYPES:
        raise DataError(f"'{path}': tensor '{name}' is of type {tensor.dtype[:20]}, not one of: {', '.join(DTYPES)}")
    width = 4 if tensor.dtype == "F32" else 8
    first, end = tensor.data_offsets
    if min(tensor.shape, default=1) < 0 or end - first != width * math.prod(tensor.shape) or not 0 <= first <= end <= n_bytes:
        raise DataError(
            f"'{path}' is truncated or damaged (tensor '{name}' of shape {list(tensor.shape)} in bytes {first} to {end} of {n_bytes}); "
            f"train the model again"
        )


def _refuse_non_finite(weights: Mapping[str, np.ndarray[Any, Any]], unset: tuple[str, ...], path: Path) -> None:
    for name, values in weights.items():
        bad = np.isinf(values) if name in unset else ~np.isfinite(values)
        if bad.any():
            raise DataError(
                f"'{path}': {int(bad.sum())} of the {bad.size} numbers of tensor '{name}' are not finite; train the model again"
            )
