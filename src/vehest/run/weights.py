"""Publishes the models of a study in one file, from which the same trainings are taken elsewhere
instead of being repeated.

models -> `PublishedWeights.add` -> results/STUDY/weights.safetensors -> `PublishedWeights.write` ->
folder of a training with the same key

Each model has its digest in the file, so that the file is consistent by itself: it grows training
by training, and is replaced in one step.

The key of a training contains the digests of its recordings. Simulated recordings differ in their
last bits between processors, and so does this key. A model is therefore found by its *origin* as
well: the key with how the recordings are made (configuration, versions of code, digests of raw
files) in place of their digests.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from pydantic import TypeAdapter
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load_file, save, save_file

from vehest.artefacts.artefact import TIMINGS, Artefact
from vehest.artefacts.keys import hash_of
from vehest.artefacts.locks import Lock, held
from vehest.data.errors import DataError, VehestError, number_of
from vehest.data.files import remove_leftovers, sha256_of, written_aside
from vehest.data.text_files import first_line
from vehest.estimators.model_files import DESCRIPTION, WEIGHTS
from vehest.run.console import Messages
from vehest.run.train import FIT_METRICS, HISTORY

MODELS = "models"  # the only entry of the file's metadata
COMPRESSED = "zlib,"
"""Begins the content of a file that is compressed and written in base64; files of weights of
earlier versions have plain text.
"""
# files of a model that are published beside its weights
FILES = (DESCRIPTION, FIT_METRICS, HISTORY)
FORMAT = 4  # version in the key of a report that has weights: 3 has compressed files, 4 origins
# MB of a study's weights, at most, since every clone of the repository downloads them
MAX_MEGABYTES = 25
MAX_FILE_BYTES = 10_000_000  # uncompressed, so that no file of weights can fill the memory


class WeightsTooLargeError(VehestError):
    """The weights of a study would exceed `MAX_MEGABYTES`."""


@dataclass(frozen=True)
class PublishedModel:
    """Record of a training beside its weights, which are the tensors ``KEY/NAME`` of the file."""

    label: str  # name of the training
    code: str  # version of the training
    digest: str  # digest of the training's artefact
    origin: str = ""  # the training's key with the origins of its recordings; empty: not known
    # file of `FILES` -> its content, `compressed`
    files: dict[str, str] = field(default_factory=dict)


class PublishedWeights:
    """Models of a study by the keys of their trainings; none where there is no such file.

    Parameters
    ----------
    path : Path
        weights.safetensors of a published study.

    Raises
    ------
    DataError
        The file is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.models: dict[str, PublishedModel] = {}
        """Key of a training -> its published model, as last read or written."""
        self._read()

    def published_key(self, key: str, origin: str) -> str | None:
        """The key under which the model of a training is published, its own or that of a training
        of the same origin; None where it is not.
        """
        if key in self.models:
            return key
        return next(
            (other for other, model in self.models.items() if model.origin == origin != ""), None
        )

    def add(self, models: Iterable[Artefact], origins: Mapping[str, str] | None = None) -> int:
        """Add models of finished trainings, in one step: whoever reads or is killed finds the file
        of before or after.

        Parameters
        ----------
        models : iterable of Artefact
            Finished trainings. Each replaces the model that is published under its key, or under
            another key of the same origin.
        origins : mapping, optional
            Key of a training -> its origin; they are recorded for models that are published
            already, too.

        Returns
        -------
        int
            Number of models that were not in the file, or not with this content and origin.

        Raises
        ------
        WeightsTooLargeError
            The file would exceed `MAX_MEGABYTES`; it stays as it is.
        DataError
            The present file is damaged.
        MissingError
            The disk is full or the folder cannot be written to.
        """
        self._read()  # another run may have added to it
        origins = origins or {}
        added: dict[str, Artefact] = {}
        replaced: set[str] = set()
        for model in models:
            origin = origins.get(model.key, "")
            former = self.published_key(model.key, origin)
            if former is not None:
                record = self.models[former]
                if record.digest == model.digest and origin in ("", record.origin):
                    continue
                replaced.add(former)
            added[model.key] = model
        if not added:
            return 0
        tensors = {
            name: values
            for name, values in (load_file(self.path) if self.models else {}).items()
            if name.partition("/")[0] not in replaced
        }
        for key, model in added.items():
            of_model = load_file(model.folder / WEIGHTS)
            tensors |= {f"{key}/{name}": values for name, values in of_model.items()}
        kept = {key: record for key, record in self.models.items() if key not in replaced}
        records = kept | {
            key: _record_of(model, origins.get(key, "")) for key, model in added.items()
        }
        about = {key: asdict(record) for key, record in sorted(records.items())}
        content = save(tensors, metadata={MODELS: json.dumps(about)})
        megabytes = len(content) / 1e6
        if megabytes > MAX_MEGABYTES:
            raise WeightsTooLargeError(
                f"{megabytes:.1f} MB of weights are more than the {MAX_MEGABYTES} MB of a study"
            )
        remove_leftovers(self.path.parent)
        with written_aside(self.path) as aside:
            aside.write_bytes(content)
        self.models = records
        return len(added)

    def write(self, key: str, folder: Path) -> None:
        """Write a model into the folder of its training, byte for byte as that did, but without
        times.

        Parameters
        ----------
        key : str
            Of the training.
        folder : Path
            Of the artefact, while it is made.

        Raises
        ------
        DataError
            The model is not the one that was published.
        """
        record = self.models[key]
        try:
            for name in FILES:
                if name in record.files:
                    (folder / name).write_bytes(uncompressed(record.files[name]))
        except ValueError as error:
            raise DataError(
                f"'{self.path}' is damaged ({error}, in {record.label}); restore it by 'git "
                f"checkout {self.path}', or add --retrain"
            ) from error
        (folder / TIMINGS).write_text("metric,value\n", encoding="utf-8")
        prefix = f"{key}/"
        with safe_open(self.path, framework="np") as file:
            tensors = {
                name.removeprefix(prefix): file.get_tensor(name)
                for name in file.keys()  # noqa: SIM118
                if name.startswith(prefix)
            }
        save_file(tensors, folder / WEIGHTS)
        names = [WEIGHTS, *record.files]
        if hash_of({name: sha256_of(folder / name) for name in names}) != record.digest:
            raise DataError(
                f"'{self.path}' was changed after it was published: {record.label} does not have "
                f"its digest; restore the file by 'git checkout {self.path}', or add --retrain"
            )

    def _read(self) -> None:
        """Read the models from the file, if there is one."""
        if not self.path.is_file():
            self.models = {}
            return
        try:
            with safe_open(self.path, framework="np") as file:
                self.models = TypeAdapter(dict[str, PublishedModel]).validate_json(
                    file.metadata()[MODELS]
                )
        except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
            raise DataError(
                f"'{self.path}' is damaged ({first_line(error)}); restore it by 'git checkout "
                f"{self.path}', remove it, or add --retrain"
            ) from error


def compressed(content: bytes) -> str:
    """A file's content as text in a `PublishedModel`."""
    return COMPRESSED + base64.b64encode(zlib.compress(content, level=9)).decode()


def uncompressed(text: str) -> bytes:
    """The content of a file from its text in a `PublishedModel`; raises `ValueError` where it is
    damaged or above `MAX_FILE_BYTES`.
    """
    if not text.startswith(COMPRESSED):
        return text.encode()
    inflation = zlib.decompressobj()
    try:
        content = inflation.decompress(
            base64.b64decode(text.removeprefix(COMPRESSED), validate=True), MAX_FILE_BYTES
        )
    except (ValueError, zlib.error) as error:
        raise ValueError(f"a compressed file is damaged: {error}") from error
    if not inflation.eof:
        raise ValueError(
            f"a compressed file is cut off or has more than {MAX_FILE_BYTES / 1e6:g} MB"
        )
    return content


def _record_of(model: Artefact, origin: str) -> PublishedModel:
    """The published record of a model beside its weights."""
    files = {
        name: compressed((model.folder / name).read_bytes())
        for name in FILES
        if name in model.outputs
    }
    return PublishedModel(model.label, model.code, model.digest, origin, files)


def publish_weights(
    weights: PublishedWeights,
    models: Sequence[Artefact],
    origins: Mapping[str, str],
    output: Path,
    messages: Messages,
) -> bool:
    """Add models of finished trainings, with their origins by key, to a study's published weights.

    Returns whether there was room for them.

    Parameters
    ----------
    weights : PublishedWeights
        Of the study.
    models : sequence of Artefact
        Finished trainings.
    output : Path
        Output root, where the lock lies.
    messages : Messages
        Prints how many were added, or that there is no room.
    """
    study = weights.path.parent.name
    with held(Lock(output, "publish", study), lambda: False):
        try:
            n_added = weights.add(models, origins)
        except WeightsTooLargeError as error:
            messages.warn(
                f"no more weights are published: {error}; '{weights.path}' stays as it is, "
                "and may be removed to leave out former models"
            )
            return False
    if n_added:
        added = f"{number_of(n_added, 'model')} added to {weights.path}"
        messages.line("done", "publish", study, added)
    return True
