"""State of one member's unfinished training, from which a killed run reaches the same result.

A checkpoint is one safetensors file in a folder of the member: tensors, and in its metadata the
plain values as JSON with a SHA-256 of both. `save_checkpoint` replaces it by one rename;
`load_checkpoint` ignores a damaged file and one of another layout, and training starts anew.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from vehest.data.errors import VehestError
from vehest.data.files import as_os_error, regular_file, remove, written_aside
from vehest.data.text_files import parse_json

_FILE = "checkpoint.safetensors"  # name of the file in a member's folder
_LAYOUT = b"2"  # version of what trainings store; a checkpoint of another one is ignored


class Checkpoint(NamedTuple):
    """State of a training after an epoch."""

    tensors: Mapping[str, Tensor]  # name -> weights, moments, states of generators
    values: Mapping[str, Any]  # name -> plain value, as JSON stores it; ``epoch`` is among them


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Replace the checkpoint in a folder in one step.

    Parameters
    ----------
    folder : Path
        Folder of one member.
    checkpoint : Checkpoint
        Its values must be JSON; a valid checkpoint has an integer ``epoch`` and perhaps
        ``finished``.

    Raises
    ------
    MissingError
        It cannot be written.
    """
    with written_aside(folder / _FILE) as aside:
        tensors = {
            name: tensor.detach().cpu().contiguous() for name, tensor in checkpoint.tensors.items()
        }
        try:
            values = json.dumps(dict(checkpoint.values))
            save_file(
                tensors, aside, metadata={"values": values, "digest": _digest(values, tensors)}
            )
        except SafetensorError as error:
            raise as_os_error(error) from error


def load_checkpoint(folder: Path) -> Checkpoint | None:
    """Read the checkpoint in ``folder``; None where there is none or it cannot be read, in which
    case training starts anew.
    """
    path = folder / _FILE
    try:
        regular_file(path)
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            if metadata.get("digest") != _digest(metadata.get("values", ""), tensors):
                return None
            values = parse_json(metadata["values"], f"'{path}'")
            is_sound = isinstance(values.get("epoch"), int) and isinstance(
                values.setdefault("finished", False), bool
            )
            return Checkpoint(tensors, values) if is_sound else None
    except (SafetensorError, VehestError, ValueError, OSError):
        return None


def _digest(values: str, tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of the layout, the values and the tensors of a checkpoint, by which damage is
    found.
    """
    digest = hashlib.sha256(_LAYOUT + values.encode())
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()


def resume_epoch(folder: Path) -> int:
    """Number of epochs after which the checkpoint in ``folder`` was stored; 0 without a checkpoint,
    -1 if training was over and only the model is missing.

    Members can continue together if these numbers are equal.
    """
    checkpoint = load_checkpoint(folder)
    if checkpoint is None:
        return 0
    return -1 if checkpoint.values["finished"] else int(checkpoint.values["epoch"])


def drop_checkpoint(folder: Path) -> None:
    """Delete ``folder`` with the checkpoint in it."""
    remove(folder)
