"""State of one member's unfinished training, kept so that a killed one goes on to the same result."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from vehest.data.files import remove, written_aside

_FILE = "checkpoint.safetensors"


@dataclass(frozen=True)
class Checkpoint:
    """Tensors and plain values of a training's state."""

    tensors: Mapping[str, Tensor]
    values: Mapping[str, Any]


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Replace the checkpoint in ``folder`` in one step.

    Raises:
        MissingError: it cannot be written.
    """
    with written_aside(folder / _FILE) as aside:
        tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in checkpoint.tensors.items()}
        try:
            save_file(tensors, aside, metadata={"values": json.dumps(dict(checkpoint.values))})
        except SafetensorError as error:
            raise as_os_error(error) from error


def load_checkpoint(folder: Path) -> Checkpoint | None:
    """The checkpoint in ``folder``; none if there is none or it cannot be read, in which case training starts anew."""
    path = folder / _FILE
    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="pt") as file:
            values = json.loads((file.metadata() or {})["values"])
            return Checkpoint({name: file.get_tensor(name) for name in file.keys()}, values)  # noqa: SIM118
    except (SafetensorError, KeyError, ValueError, OSError):
        return None


def resume_epoch(folder: Path) -> int:
    """Epochs that the checkpoint in ``folder`` saves, 0 if there is none, -1 if training was over and only the model is missing.

    Members can go on together if they agree in this.
    """
    checkpoint = load_checkpoint(folder)
    if checkpoint is None:
        return 0
    return -1 if checkpoint.values.get("finished") else int(checkpoint.values["epoch"])


def drop_checkpoint(folder: Path) -> None:
    """Forget the checkpoint in ``folder``, and the folder with it."""
    remove(folder)


def as_os_error(error: SafetensorError) -> OSError:
    """Safetensors reports failed writes in prose; recover the error number from it."""
    text = str(error)
    marker = "os error "
    number = int(text.split(marker)[1].split(")")[0]) if marker in text else 5
    return OSError(number, text)
