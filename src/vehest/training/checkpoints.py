"""State of one member's unfinished training, from which a killed run reaches the same result.

A checkpoint is one safetensors file in a folder of the member: tensors, and in its metadata the
plain values as JSON with a SHA-256 of both. `save_checkpoint` replaces it by one rename;
`load_checkpoint` takes a damaged file or one of another layout for none, and training starts anew.
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

_FILE = "checkpoint.safetensors"
_LAYOUT = b"2"  # of what trainings keep; a checkpoint of another one is none


class Checkpoint(NamedTuple):
    """Tensors and plain values of a training's state."""

    tensors: Mapping[str, Tensor]
    values: Mapping[str, Any]


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Replace the checkpoint in a folder in one step.

    Parameters
    ----------
    folder : Path
        Of one member.
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
    """The checkpoint in ``folder``; none if there is none or it cannot be read, in which case
    training starts anew.
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
    """Hash of all that a checkpoint holds: one that has been damaged anywhere is none."""
    digest = hashlib.sha256(_LAYOUT + values.encode())
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()


def resume_epoch(folder: Path) -> int:
    """Epochs that the checkpoint in ``folder`` saves, 0 if there is none, -1 if training was over
    and only the model is missing.

    Members can go on together if they agree in this.
    """
    checkpoint = load_checkpoint(folder)
    if checkpoint is None:
        return 0
    return -1 if checkpoint.values["finished"] else int(checkpoint.values["epoch"])


def drop_checkpoint(folder: Path) -> None:
    """Forget the checkpoint in ``folder``, and the folder with it."""
    remove(folder)
