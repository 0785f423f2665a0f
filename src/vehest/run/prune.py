"""Lists artefacts that no current configuration can reuse, and removes them after agreement.

An artefact is listed if its code is not today's, so that no configuration gives its key; if it is damaged; or if its inputs are not in the
output root, except for trainings, which may have taken hours and whose recordings can be made again. Also listed are checkpoints of models
that are finished or listed, files of killed processes, recordings kept for an ingest that is done, and records of incomplete studies.

Only what vehest has made is listed: folders whose manifest gives their own name. Links are neither followed nor removed.
"""

from __future__ import annotations

import os
import re
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vehest.data.errors import VehestError
from vehest.data.files import ASIDE_PREFIX, aside_of, is_left_over, writing_error
from vehest.data.text_files import read_json
from vehest.run import calibrate, downsample, evaluate, evaluate_faults, ingest, report, sweep, train
from vehest.run.artefacts import MANIFEST, Artefact, read_artefact
from vehest.run.run_cache import FINISHED

CHECKPOINTS = "checkpoints"
STAGES = (ingest.STAGE, downsample.STAGE, train.STAGE, calibrate.STAGE, evaluate.STAGE, report.STAGE, sweep.STAGE)
OUTDATED, DAMAGED, ORPHANED = "its code has changed", "it is damaged", "what it was made from is gone"
SUPERFLUOUS, LEFT_OVER, BROKEN = "its model is there, or found itself", "left by a process that was killed", "of a study that is not whole"
_NAME = re.compile(r".+-[0-9a-f]{12}")


@dataclass(frozen=True)
class Unused:
    """A folder or file in the output root that no current configuration can reuse.

    Args:
        path: in the output root.
        reason: for people.
        size: of all its files [bytes].
        age: since it was last written to [s].
    """

    path: Path
    reason: str
    size: int
    age: float

    def in_words(self) -> list[str]:
        """Path, size, age and reason, for a terminal."""
        units = ((86400.0, "d"), (3600.0, "h"), (60.0, "min"), (1.0, "s"))
        length, unit = next((own for own in units if self.age >= own[0]), units[-1])
        return [str(self.path), size_in_words(self.size), f"{self.age / length:.0f} {unit}", self.reason]


def size_in_words(size: int) -> str:
    """Bytes as people read them."""
    return f"{size / 1e6:.1f} MB" if size >= 1e5 else f"{size / 1e3:.1f} kB"


def unused_artefacts(output: Path) -> list[Unused]:
    """List what no current configuration can reuse in an output root, stage by stage."""
    reasons = _artefacts(output)
    for folder in _folders(output / CHECKPOINTS):  # others may belong to a training that has not made a model yet
        model = output / train.STAGE / folder.name
        if model in reasons or (_manifest_of(model, train.STAGE) or {}).get("status") == "complete":
            reasons[folder] = SUPERFLUOUS
    reasons |= dict.fromkeys(_leftovers(output), LEFT_OVER)
    reasons |= dict.fromkeys(_broken_records(output, set(reasons)), BROKEN)
    return [Unused(path, reason, *_size_and_age(path)) for path, reason in reasons.items()]


def remove_unused(unused: Sequence[Unused], on_removed: Callable[[Unused], None]) -> None:
    """Remove what was listed; a folder is renamed first, so that no half of it is met.

    Args:
        unused: by `unused_artefacts`.
        on_removed: called after each.

    Raises:
        MissingError: something cannot be removed.
    """
    for one in unused:
        try:
            aside = one.path if one.path.name.startswith(ASIDE_PREFIX) else aside_of(one.path)
            if aside != one.path:
                os.rename(one.path, aside)
            shutil.rmtree(aside) if aside.is_dir() else aside.unlink()
        except FileNotFoundError:  # another process was quicker
            continue
        except OSError as error:
            raise writing_error(one.path, error) from error
        on_removed(one)


def _artefacts(output: Path) -> dict[Path, str]:
    """Artefacts that cannot be reused -> why."""
    artefacts: dict[Path, Artefact | None] = {}
    for stage in STAGES:
        for folder in _folders(output / stage):
            if _manifest_of(folder, stage) is not None:
                try:
                    artefacts[folder] = read_artefact(folder)
                except VehestError:
                    artefacts[folder] = None
    whole = [artefact for artefact in artefacts.values() if artefact is not None]
    present = {digest for artefact in whole for digest in (artefact.digest, *artefact.outputs.values())}
    estimators = {own.digest: own.config.get("estimator") for own in whole if own.stage == train.STAGE}
    reasons = {}
    for folder, artefact in artefacts.items():
        if artefact is None:
            reasons[folder] = DAMAGED
        elif _code_today(artefact, estimators) not in (None, artefact.code):
            reasons[folder] = OUTDATED
        elif artefact.stage not in (ingest.STAGE, train.STAGE) and not present.issuperset(artefact.inputs.values()):
            reasons[folder] = ORPHANED
    return reasons


def _code_today(artefact: Artefact, estimators: Mapping[str, Any]) -> str | None:
    """Today's version of the code of an artefact; none where it cannot be told, as for an estimator that is not installed."""
    config, stage = artefact.config, artefact.stage
    try:
        if stage == ingest.STAGE:
            return ingest.code_of_ingest(config)
        if stage == downsample.STAGE:
            return downsample.code_of_downsampling()
        if stage == sweep.STAGE:
            return sweep.code_of_sweep()
        if stage == report.STAGE:
            return report.code_of_report(str(config["module"]))
        estimator = str((config["estimator"] if stage == train.STAGE else estimators[artefact.inputs["model"]])["name"])
        if stage == train.STAGE:
            return train.code_of_training(estimator)
        if stage == calibrate.STAGE:
            return calibrate.code_of_calibration(estimator)
        code = evaluate.code_of_evaluation(estimator)
        return evaluate_faults.code_under_faults(code) if "faults" in config else code
    except (VehestError, KeyError, TypeError):
        return None


def _leftovers(output: Path) -> Iterator[Path]:
    for place in (*STAGES, CHECKPOINTS, FINISHED):
        for path in _entries(output / place):
            done = path.with_name(path.name.removeprefix(ingest.PARTS_PREFIX))
            if is_left_over(path) or (done != path and path.is_dir() and _manifest_of(done, ingest.STAGE) is not None):
                yield path


def _broken_records(output: Path, unused: set[Path]) -> Iterator[Path]:
    for file in _entries(output / FINISHED):
        if file.suffix == ".json" and not file.name.startswith("."):
            try:
                folders = [output / folder for folder in read_json(file)["made"]]
            except (VehestError, KeyError, TypeError):
                continue
            if any(folder in unused or not (folder / MANIFEST).is_file() for folder in folders):
                yield file


def _folders(place: Path) -> list[Path]:
    """Folders of artefacts or checkpoints; nothing that is being written."""
    return [path for path in _entries(place) if path.is_dir() and _NAME.fullmatch(path.name)]


def _entries(place: Path) -> list[Path]:
    """Files and folders in a folder, by name; no links."""
    return [path for path in sorted(place.iterdir()) if not path.is_symlink()] if place.is_dir() and not place.is_symlink() else []


def _manifest_of(folder: Path, stage: str) -> dict[str, Any] | None:
    """The manifest of a folder of this stage under its own name; none of any other."""
    if not folder.is_dir() or folder.is_symlink() or (folder / MANIFEST).is_symlink():
        return None
    try:
        manifest = read_json(folder / MANIFEST)
        own = manifest["stage"] == stage and folder.name == f"{manifest['label']}-{manifest['key'][:12]}"
        return manifest if own and manifest["status"] and manifest["outputs"] is not None else None
    except (VehestError, KeyError, TypeError):
        return None


def _size_and_age(path: Path) -> tuple[int, float]:
    """Bytes of all files, and seconds since the last was written."""
    found = [path, *(path.rglob("*") if path.is_dir() else ())]
    about = [one.lstat() for one in found]
    size = sum(one.st_size for one, where in zip(about, found, strict=True) if not where.is_dir())
    return size, max(0.0, time.time() - max(one.st_mtime for one in about))
