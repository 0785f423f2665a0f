"""Publishes the models of a study in one file, from which the same trainings are taken elsewhere instead of being repeated.

models -> `write_weights` -> results/STUDY/weights.safetensors -> `PublishedWeights.write` -> folder of a training with the same key
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load_file, save_file

from vehest.data.errors import DataError
from vehest.data.files import sha256_of
from vehest.data.text_files import first_line, read_json
from vehest.estimators.model_files import DESCRIPTION, WEIGHTS
from vehest.run.artefacts import TIMINGS, Artefact
from vehest.run.train import FIT_METRICS, HISTORY

PUBLISHED_WEIGHTS = "weights.safetensors"
PROVENANCE = "provenance.json"  # beside it; names the file's digest
DIGEST = "weights_sha256"
MODELS = "models"  # the only entry of the file's metadata
FILES = (DESCRIPTION, FIT_METRICS, HISTORY)  # of a training, beside its weights


@dataclass(frozen=True)
class PublishedModel:
    """What a training wrote beside its weights, which are the tensors ``KEY/NAME`` of the file."""

    label: str
    code: str  # version of the training
    files: dict[str, str] = field(default_factory=dict)  # those of `FILES` that it has -> content


def write_weights(models: Iterable[Artefact], path: Path) -> None:
    """Write the models of trainings into one safetensors file, each under the key of its training."""
    tensors: dict[str, Any] = {}
    about: dict[str, Any] = {}
    for key, model in sorted({model.key: model for model in models}.items()):
        files = {
            name: (model.folder / name).read_bytes().decode()
            for name in FILES
            if name in model.outputs
        }
        about[key] = asdict(PublishedModel(model.label, model.code, files))
        tensors |= {
            f"{key}/{name}": values for name, values in load_file(model.folder / WEIGHTS).items()
        }
    save_file(tensors, path, metadata={MODELS: json.dumps(about, ensure_ascii=False)})


def _check_digest(path: Path) -> None:
    """Raise `DataError` where published weights are not those whose digest their provenance names."""
    provenance = path.with_name(PROVENANCE)
    about = read_json(provenance) if provenance.is_file() else {}
    stated = about.get(DIGEST) if isinstance(about, dict) else None
    remedy = f"restore both by 'git checkout {path.parent}', or add --retrain"
    if stated is None:
        raise DataError(f"'{path}': '{provenance}' has no {DIGEST} to verify it by; {remedy}")
    if sha256_of(path) != stated:
        raise DataError(
            f"'{path}' was changed after it was published: its SHA-256 is not {DIGEST} in '{provenance}'; {remedy}"
        )


class PublishedWeights:
    """Models of a published study by the keys of their trainings; none where there is no such file; raises `DataError` where damaged."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._models: dict[str, PublishedModel] = {}
        if path.is_file():
            _check_digest(path)
            try:
                with safe_open(path, framework="np") as file:
                    self._models = TypeAdapter(dict[str, PublishedModel]).validate_json(
                        file.metadata()[MODELS]
                    )
            except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
                raise DataError(
                    f"'{path}' is damaged ({first_line(error)}); remove it, or add --retrain"
                ) from error

    def __contains__(self, key: str) -> bool:
        return key in self._models

    def write(self, key: str, folder: Path) -> None:
        """Write a model into the folder of its training, byte for byte as that did, but without times."""
        files = self._models[key].files
        prefix = f"{key}/"
        for name in FILES:
            if name in files:
                (folder / name).write_bytes(files[name].encode())
        (folder / TIMINGS).write_text("metric,value\n", encoding="utf-8")
        with safe_open(self.path, framework="np") as file:
            tensors = {
                name.removeprefix(prefix): file.get_tensor(name)
                for name in file.keys()  # noqa: SIM118
                if name.startswith(prefix)
            }
        save_file(tensors, folder / WEIGHTS)
