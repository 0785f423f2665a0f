"""Reads a file as a recording for a model, whether or not it has references."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from vehest.alignment.checks import refuse_errors
from vehest.data.channels import REFERENCE_SUFFIX
from vehest.data.limits import Limits, use_limits
from vehest.data.recording import UNNAMED_VEHICLE, Recording
from vehest.data.transforms import OF_REFERENCES
from vehest.sources.base import read_single
from vehest.sources.named_columns import declare_columns
from vehest.sources.tables import column_names


def read_checked(
    path: Path,
    dataset: Mapping[str, Any],
    limits: Limits,
    columns: Mapping[str, str] = MappingProxyType({}),
) -> Recording:
    """Read a recording from a file of any format.

    Parameters
    ----------
    path : Path
        The file.
    dataset : mapping
        Options of its data set, by default a table with the channels' names.
    limits : Limits
        On what the file may ask for.
    columns : mapping
        Columns of a table that take the place of those of the data set; see `declare_columns`.

    Raises
    ------
    VehestError
        As `read_single`; `DataError` also where a check finds an error that the data set does not
        accept.
    """
    with use_limits(limits):
        if columns:
            names = column_names(path)
            dataset = {**dataset, **declare_columns(columns, names, {}, f"'{path}'")}
        recording = read_single(dataset, path)
        refuse_errors(recording, dataset.get("accept") or (), f"'{path}'")
    return recording


def without_references(dataset: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a data set without its reference channels; not validated yet."""
    channels = dataset.get("channels")
    transforms = dataset.get("transforms")
    if isinstance(channels, dict):
        channels = {name: entry for name, entry in channels.items() if not _names_reference(name)}
    if isinstance(transforms, list | tuple):
        measured = [_of_measured(entry) for entry in transforms]
        transforms = [entry for entry in measured if entry is not None]
    changed = {
        "channels": channels or None,
        "transforms": transforms or None,
        "reference_point": None,
        "pose": None,
    }
    unchanged = {key: value for key, value in dataset.items() if key not in changed}
    return unchanged | {key: value for key, value in changed.items() if value}


def _names_reference(name: Any) -> bool:
    """Whether a channel comes from a reference sensor, by its suffix."""
    return str(name).endswith(REFERENCE_SUFFIX)


def _of_measured(transform: Any) -> Any:
    """A transform's options for its measured channels; None where it concerns references alone."""
    if not isinstance(transform, dict):
        return transform
    if str(transform.get("name")) in OF_REFERENCES:
        return None
    remaining = dict(transform)
    for key in ("channels", "offsets"):
        names = transform.get(key)
        if isinstance(names, dict):
            remaining[key] = {k: value for k, value in names.items() if not _names_reference(k)}
        elif isinstance(names, list | tuple):
            remaining[key] = [name for name in names if not _names_reference(name)]
        if names and not remaining[key]:  # no channels would mean all measured ones
            return None
    return remaining


def vehicle_of(dataset: Mapping[str, Any]) -> str:
    """The name of a data set's car; `UNNAMED_VEHICLE` where it has none."""
    vehicle = dataset.get("vehicle")
    return vehicle if isinstance(vehicle, str) and vehicle else UNNAMED_VEHICLE
