"""Artefacts outside of any output root: files by their digests, anywhere fsspec reaches, so that machines need no common file system.

    objects/AB/ABCD…                what files hold, by the SHA-256 of their bytes
    artefacts/STAGE/NAME-KEY.json   manifests; one is there only once all files that it names are
    checkpoints/NAME-KEY            state of an unfinished training

Everything is compared with its digest when it is fetched; what differs counts as not there, and is put there anew by whoever makes it.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from vehest.data.errors import ConfigurationError, DataError, MissingError, VehestError
from vehest.data.files import remove_leftovers, written_aside
from vehest.run.artefacts import DIGEST, MANIFEST, Artefact, read_artefact
from vehest.training.checkpoints import resume_epoch

CHECKPOINT = "checkpoint.safetensors"
SCHEMES = ("file://", "s3://")


class Store:
    """A place for artefacts.

    Args:
        address: ``file:///folder`` or ``s3://bucket/folder``.

    Raises:
        ConfigurationError: it is no such address.
        MissingError: what reaches it is not installed.
    """

    def __init__(self, address: str) -> None:
        if not address.startswith(SCHEMES) or not address.split("://", 1)[1].strip("/"):
            raise ConfigurationError(f"--store must be file:///FOLDER or s3://BUCKET/FOLDER, not '{address}'")
        self.address = address.rstrip("/")
        try:
            import fsspec
        except ImportError:
            raise MissingError("--store needs fsspec: pip install 'vehest[ray]'") from None
        try:
            self._files, self._root = fsspec.core.url_to_fs(self.address)
        except ImportError:
            raise MissingError(f"--store {self.address} needs s3fs: pip install 'vehest[ray]'") from None

    @property
    def scratch(self) -> Path:
        """Where a machine keeps its copies: in ``VEHEST_SCRATCH``, else where temporary files go."""
        user = os.getuid() if hasattr(os, "getuid") else 0
        place = Path(os.environ.get("VEHEST_SCRATCH") or Path(tempfile.gettempdir()) / f"vehest-{user}")
        return place.resolve() / hashlib.sha256(self.address.encode()).hexdigest()[:12]

    def push(self, artefact: Artefact) -> None:
        """Put an artefact here, unless it is; its manifest last.

        Raises:
            MissingError: the store cannot be written to.
        """
        text = (artefact.folder / MANIFEST).read_bytes()
        name = self._manifest(artefact.stage, artefact.folder.name)
        with self._reached("write"):
            if self._read(name) == text:
                return
            for file, digest in artefact.outputs.items():
                path = artefact.folder / file
                place = self._object(digest)
                if self._size(place) != path.stat().st_size:
                    self._put(path.read_bytes(), place)
            self._put(text, name)

    def fetch(self, stage: str, folder: Path) -> Artefact | None:
        """Bring an artefact into its folder, every file compared with its digest; none where it is not here whole.

        Args:
            stage: that makes it.
            folder: where it belongs; its name is that of the artefact.

        Raises:
            MissingError: the store does not answer, or the disk is full.
        """
        with self._reached("read"):
            text = self._read(self._manifest(stage, folder.name))
        if text is None:
            return None
        try:
            outputs = {str(name): str(entry["sha256"]) for name, entry in json.loads(text)["outputs"].items()}
        except (ValueError, KeyError, TypeError, AttributeError):
            return None
        if not all(DIGEST.fullmatch(digest) for digest in outputs.values()):
            return None
        remove_leftovers(folder.parent)
        try:
            with written_aside(folder, replace_folder=True) as aside:
                aside.mkdir()
                for name, digest in outputs.items():
                    self._bring(digest, aside / _inside(name))
                (aside / MANIFEST).write_bytes(text)
            return read_artefact(folder)
        except (_NotWholeError, DataError):
            self._forget(self._manifest(stage, folder.name))
            return None

    def push_checkpoint(self, folder: Path) -> None:
        """Keep the state of an unfinished training, as its folder has it."""
        with self._reached("write"):
            self._put((folder / CHECKPOINT).read_bytes(), f"checkpoints/{folder.name}")

    def fetch_checkpoint(self, folder: Path) -> None:
        """Bring the state of an unfinished training, unless the one in its folder is as far; a damaged one is none, as everywhere."""
        with self._reached("read"):
            content = self._read(f"checkpoints/{folder.name}")
        if content is None:
            return
        with tempfile.TemporaryDirectory(dir=_made(folder.parent), prefix=".checkpoint-") as scratch:
            brought = Path(scratch) / CHECKPOINT
            brought.write_bytes(content)
            if _further(resume_epoch(Path(scratch)), resume_epoch(folder)):
                with written_aside(folder / CHECKPOINT) as aside:
                    aside.write_bytes(content)

    def drop_checkpoint(self, folder: Path) -> None:
        """Forget the state of a training that is over."""
        self._forget(f"checkpoints/{folder.name}")

    def _forget(self, name: str) -> None:
        with self._reached("write"), suppress(FileNotFoundError):
            self._files.rm_file(self._place(name))

    def _bring(self, digest: str, path: Path) -> None:
        place = self._object(digest)
        with self._reached("read"):
            content = self._read(place)
        if content is None:
            raise _NotWholeError
        if hashlib.sha256(content).hexdigest() != digest:
            self._forget(place)
            raise _NotWholeError
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)

    def _put(self, content: bytes, name: str) -> None:
        """Write in one step: an upload is one by itself, a file is renamed."""
        place = self._place(name)
        if self.address.startswith("file://"):
            with written_aside(Path(place)) as aside:
                aside.write_bytes(content)
        else:
            self._files.pipe_file(place, content)

    def _read(self, name: str) -> bytes | None:
        try:
            return bytes(self._files.cat_file(self._place(name)))
        except FileNotFoundError:
            return None

    def _size(self, name: str) -> int:
        try:
            return int(self._files.info(self._place(name))["size"])
        except FileNotFoundError:
            return -1

    def _place(self, name: str) -> str:
        return f"{self._root}/{name}"

    @staticmethod
    def _manifest(stage: str, name: str) -> str:
        return f"artefacts/{stage}/{name}.json"

    @staticmethod
    def _object(digest: str) -> str:
        return f"objects/{digest[:2]}/{digest}"

    @contextmanager
    def _reached(self, what: str) -> Iterator[None]:
        try:
            yield
        except VehestError:
            raise
        except Exception as error:  # whatever a service does, it is one line
            words = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
            raise MissingError(
                f"cannot {what} the store '{self.address}' ({words}); check the address, its service and your rights"
            ) from error


class _NotWholeError(Exception):
    """A file of an artefact is not in the store, or is not what its digest says."""


def _inside(name: str) -> Path:
    path = Path(name)
    if path.is_absolute() or ".." in path.parts:
        raise _NotWholeError
    return path


def _further(brought: int, here: int) -> bool:
    """Whether a training stands further on; -1 is one that is over."""
    return here != -1 and (brought == -1 or brought > here)


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder
