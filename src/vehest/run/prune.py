"""What stands in an output root and is named by no present key: found by what can be known, and removed when that was agreed to.

An artefact is found if its code is no longer that of its stage, so that no configuration gives its key any more; if it is damaged; or if
what it was made from is not in the output root, other than for trainings, which may have taken hours and whose recordings can be made
again. Further: checkpoints of models that are finished or found themselves, what killed processes left half-written, recordings
that were kept for an ingest that is done, and records of finished studies of which something is missing.

Only what vehest has made is looked at: folders whose manifest gives their own name. Links are not followed and not removed.
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
class Found:
    """Something that no present key names.

    Args:
        path: a folder or file in the output root.
        reason: why, for people.
        size: of all its files [bytes].
        age: since it was last written to [s].
    """

    path: Path
    reason: str
    size: int
    age: float

    def in_words(self) -> list[str]:
        """Path, size, age and reason, for a terminal."""
        return [str(self.path), size_in_words(self.size), _age_in_words(self.age), self.reason]


def size_in_words(size: int) -> str:
    """Bytes as people read them."""
    return f"{size / 1e6:.1f} MB" if size >= 1e5 else f"{size / 1e3:.1f} kB"


def _age_in_words(seconds: float) -> str:
    for length, unit in ((86400.0, "d"), (3600.0, "h"), (60.0, "min")):
        if seconds >= length:
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds:.0f} s"


def unnamed(output: Path) -> list[Found]:
    """What in an output root no present key names, stage by stage.

    Args:
        output: the output root.
    """
    reasons = _artefacts(output)
    reasons |= _checkpoints(output, set(reasons))
    reasons |= dict(_leftovers(output))
    reasons |= _records(output, set(reasons))
    return [Found(path, reason, *_size_and_age(path)) for path, reason in reasons.items()]


def remove_found(found: Sequence[Found], on_removed: Callable[[Found], None]) -> None:
    """Remove what was found; a folder goes at once, so that no half of it is met.

    Args:
        found: by `unnamed`.
        on_removed: called after each.

    Raises:
        MissingError: something cannot be removed.
    """
    for one in found:
        try:
            aside = one.path if one.path.name.startswith(ASIDE_PREFIX) else aside_of(one.path)
            if aside != one.path:
                os.rename(one.path, aside)
            if aside.is_dir():
                shutil.rmtree(aside)
            else:
                aside.unlink()
        except FileNotFoundError:  # somebody else was quicker
            continue
        except OSError as error:
            raise writing_error(one.path, error) from error
        on_removed(one)


def _artefacts(output: Path) -> dict[Path, str]:
    """Artefacts that nothing names -> why."""
    whole: dict[str, list[Artefact]] = {stage: [] for stage in STAGES}
    reasons: dict[Path, str] = {}
    for stage in STAGES:
        for folder in _folders(output / stage):
            manifest = _manifest_of(folder, stage)
            if manifest is None:
                continue
            try:
                whole[stage].append(read_artefact(folder))
            except VehestError:
                reasons[folder] = DAMAGED
                continue
    provided = _provided(whole)
    for stage, artefacts in whole.items():
        for artefact in artefacts:
            code = _code_of(artefact, whole[train.STAGE])
            if code is not None and code != artefact.code:
                reasons[artefact.folder] = OUTDATED
            elif stage not in (ingest.STAGE, train.STAGE) and not set(artefact.inputs.values()) <= provided[stage]:
                reasons[artefact.folder] = ORPHANED
    order = [folder for stage in STAGES for folder in _folders(output / stage)]
    return {folder: reasons[folder] for folder in order if folder in reasons}


def _provided(whole: Mapping[str, Sequence[Artefact]]) -> dict[str, set[str]]:
    """Stage -> digests of what there is to be made from."""
    files = {stage: {digest for one in artefacts for digest in one.outputs.values()} for stage, artefacts in whole.items()}
    digests = {stage: {one.digest for one in artefacts} for stage, artefacts in whole.items()}
    compared = digests[train.STAGE] | digests[evaluate.STAGE] | digests[ingest.STAGE]
    return {
        downsample.STAGE: files[ingest.STAGE],
        calibrate.STAGE: digests[train.STAGE] | files[downsample.STAGE],
        evaluate.STAGE: digests[train.STAGE] | digests[calibrate.STAGE] | files[downsample.STAGE],
        report.STAGE: compared,
        sweep.STAGE: compared,
    }


def _code_of(artefact: Artefact, models: Sequence[Artefact]) -> str | None:
    """Today's version of the code that would make an artefact; none where it cannot be told, as of an estimator that is not installed."""
    config = artefact.config
    try:
        if artefact.stage == ingest.STAGE:
            return ingest.code_of_ingest(config)
        if artefact.stage == downsample.STAGE:
            return downsample.code_of_downsampling()
        if artefact.stage == train.STAGE:
            return train.code_of_training(str(config["estimator"]["name"]))
        if artefact.stage in (calibrate.STAGE, evaluate.STAGE):
            model = next(model for model in models if model.digest == artefact.inputs["model"])
            estimator = str(model.config["estimator"]["name"])
            if artefact.stage == calibrate.STAGE:
                return calibrate.code_of_calibration(estimator)
            code = evaluate.code_of_evaluation(estimator)
            return evaluate_faults.code_under_faults(code) if "faults" in config else code
        if artefact.stage == sweep.STAGE:
            return sweep.code_of_sweep()
        return report.code_of_report(str(config["module"]))
    except (VehestError, KeyError, TypeError, StopIteration):
        return None


def _checkpoints(output: Path, found: set[Path]) -> dict[Path, str]:
    """Checkpoints that no training will go on with; others may belong to one that has not made a model yet."""
    reasons = {}
    for folder in _folders(output / CHECKPOINTS):
        model = output / train.STAGE / folder.name
        manifest = _manifest_of(model, train.STAGE)
        if model in found or (manifest is not None and manifest["status"] == "complete"):
            reasons[folder] = SUPERFLUOUS
    return reasons


def _leftovers(output: Path) -> Iterator[tuple[Path, str]]:
    for place in (*STAGES, CHECKPOINTS, FINISHED):
        if not _is_own_folder(output / place):
            continue
        for path in sorted((output / place).iterdir()):
            if path.name.startswith(ASIDE_PREFIX) and not path.is_symlink() and is_left_over(path):
                yield path, LEFT_OVER
            elif path.name.startswith(ingest.PARTS_PREFIX) and _is_own_folder(path):
                done = path.with_name(path.name.removeprefix(ingest.PARTS_PREFIX))
                if _manifest_of(done, ingest.STAGE) is not None:
                    yield path, LEFT_OVER


def _records(output: Path, found: set[Path]) -> dict[Path, str]:
    reasons: dict[Path, str] = {}
    if not _is_own_folder(output / FINISHED):
        return reasons
    for file in sorted((output / FINISHED).glob("*.json")):
        if file.is_symlink() or file.name.startswith("."):
            continue
        try:
            folders = [output / made["folder"] for made in read_json(file)["made"]]
        except (VehestError, KeyError, TypeError):
            continue
        if any(folder in found or not (folder / MANIFEST).is_file() for folder in folders):
            reasons[file] = BROKEN
    return reasons


def _folders(place: Path) -> list[Path]:
    """Folders in a folder, by name; no links and nothing that is being written."""
    if not _is_own_folder(place):
        return []
    return [folder for folder in sorted(place.iterdir()) if _is_own_folder(folder) and _NAME.fullmatch(folder.name)]


def _is_own_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _manifest_of(folder: Path, stage: str) -> dict[str, Any] | None:
    """The manifest of a folder that is what it says: this stage's, under its own name."""
    if not _is_own_folder(folder) or (folder / MANIFEST).is_symlink():
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
    size = sum(one.st_size for one, where in zip(about, found, strict=True) if where.is_symlink() or where.is_file())
    return size, max(0.0, time.time() - max(one.st_mtime for one in about))
