"""Finds and opens fitted models and their calibrations.

By folder, by name in an output root, or those that come with vehest.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from vehest.artefacts.artefact import MANIFEST, Artefact, read_artefact, read_manifest
from vehest.data.errors import DataError, MissingError, VehestError, counted
from vehest.data.files import file_name
from vehest.estimators.base import Estimator
from vehest.estimators.model_files import (
    DESCRIPTION,
    WEIGHTS,
    load_model,
    model_digest,
    read_description,
)
from vehest.trust.record import TRUST, Trust, read_trust

PRETRAINED = "pretrained"  # name of the network that comes with vehest
SELF_CALIBRATING = "self_calibrating"
"""Names of the models that come with vehest, for cars without a model of their own.

A network, and the filter around it.
"""
# name of a model that comes with vehest -> its folder in the package
WITH_VEHEST = {PRETRAINED: "pretrained", SELF_CALIBRATING: "pretrained_filter"}
SHIPPED_NOTES = {
    PRETRAINED: "trained on simulated cars, not on yours; the KS-NN is patented by its authors "
    "(PCT/IT2023/050058); errors and limits: docs/estimators/ksnn.md",
    SELF_CALIBRATING: "the network inside was trained on simulated cars, not on yours; the KS-NN "
    "is patented by its authors (PCT/IT2023/050058); errors and limits: "
    "docs/estimators/self_calibrating.md",
}
"""Name of a model that comes with vehest -> note in one line; its model.yaml says more."""
CALIBRATION_STAGE = "calibrate"
"""Stage that calibrates models, and its folder in an output root."""


def pretrained_folder(name: str = PRETRAINED) -> Path:
    """The folder of a model that comes with vehest."""
    return Path(__file__).resolve().parents[1] / WITH_VEHEST[name]


def find_model(name: str, output: Path, say: Callable[[str], None]) -> Path:
    """A model's folder, by path or by the start of its name in the output root.

    Those of `WITH_VEHEST` come with vehest.

    Of several models the newest is taken, with a remark to ``say``; `MissingError` where there is
    none.

    Parameters
    ----------
    name : str
        Folder, start of a name in ``output/train``, or one of `WITH_VEHEST`.
    output : Path
        Output root.
    say : callable
        Receives remarks for the user.
    """
    path = Path(name)
    if path.is_dir():
        return path
    models = [folder for folder in sorted(output.glob("train/[!.]*")) if folder.is_dir()]
    matches = [folder for folder in models if folder.match(f"{path.name}*")]
    if name in WITH_VEHEST:
        if matches:
            say(
                f"'{name}' is the model that comes with vehest; yours are "
                f"{counted([folder.name for folder in matches])}"
            )
        return pretrained_folder(name)
    if not matches:
        places = (
            f"'{output / 'train'}', which contains {counted([folder.name for folder in models])}"
        )
        raise MissingError(
            f"there is no model '{name}', neither a folder nor in {places}; train one first, or "
            f"take one that comes with vehest: {', '.join(WITH_VEHEST)}"
        )
    newest = max(matches, key=lambda folder: folder.stat().st_mtime_ns)
    if len(matches) > 1:
        say(
            f"'{name}' is assumed to be {newest.name}, the newest of "
            f"{counted([folder.name for folder in matches])}"
        )
    return newest


def open_model(
    name: str, output: Path, say: Callable[[str], None]
) -> tuple[Path, Estimator, Trust | None]:
    """Find a model as `find_model` does and open it.

    Returns its folder, the model with the preparation of its training data, and its calibration.

    Raises
    ------
    MissingError
        There is no model of this name.
    DataError
        A file is damaged or was changed, or the calibration is not of this model.
    """
    folder = find_model(name, output, say)
    if (folder / MANIFEST).is_file():
        read_artefact(folder)  # raises `DataError` where a file was changed after it was made
    model = load_model(folder)
    model.preparation = preparation_of(folder)
    trust = trust_of(folder, output, say)
    if trust is not None:
        trust.check_fit(model)
    return folder, model, trust


def is_training_recording(model_folder: Path, recording_id: str) -> bool:
    """Whether a model was trained or validated on some part of a recording."""
    about = read_description(model_folder).about
    return any(
        span.startswith((f"{recording_id} [", f"{recording_id} ("))
        for span in (*about.trained_on, *about.validated_on)
    )


def preparation_of(model_folder: Path) -> dict[str, Any]:
    """Method and transforms by which a model's training data were resampled, which new recordings
    need too.
    """
    return read_description(model_folder).about.downsample.as_plain()


def trust_of(
    model_folder: Path, output: Path, say: Callable[[str], None] = warnings.warn
) -> Trust | None:
    """Bands, limits and health of a model.

    They are in trust.yaml in its folder, else in its calibration in its own output root or in
    ``output``. A file in its folder that names no model is read with a remark to ``say``.
    Raises `DataError`: the file is damaged, or names another model.
    """
    path = model_folder / TRUST
    if not os.path.lexists(path):
        calibration = calibration_of(model_folder, output)
        return None if calibration is None else read_trust(calibration.folder)
    trust = read_trust(model_folder)
    if not trust.about.model:
        say(f"'{path}' does not say which model it belongs to; it is assumed to be this one")
    elif trust.about.model != model_digest(model_folder):
        raise DataError(
            f"'{path}' belongs to another model, or {WEIGHTS} or {DESCRIPTION} has been changed "
            f"since; calibrate the model again, or remove {TRUST}"
        )
    return trust


def calibration_of(model_folder: Path, output: Path) -> Artefact | None:
    """The calibration of a model in its own output root or in another; the newest of several.

    Raises
    ------
    DataError
        The model or a calibration of it is damaged or was changed after it was made; also one
        whose manifest cannot be read, where its folder has the model's name.
    """
    if not os.path.lexists(model_folder / MANIFEST):
        return None  # a model that was saved from Python, which no calibration names
    model = read_artefact(model_folder, hash_files=False)
    roots = {model_folder.resolve().parent.parent, output.resolve()}
    folders = sorted(
        {folder for root in roots for folder in (root / CALIBRATION_STAGE).glob("[!.]*")}
    )
    calibrations = [folder for folder in folders if _calibrates(folder, model)]
    return max(
        map(read_artefact, calibrations),
        key=lambda artefact: str(artefact.provenance.get("created", "")),
        default=None,
    )


def _calibrates(folder: Path, model: Artefact) -> bool:
    """Whether a folder holds the calibration of a given model.

    Raises `DataError` where its manifest is damaged and its name is the model's.
    """
    try:
        manifest = read_manifest(folder)
    except VehestError as error:
        if not folder.name.startswith(file_name(calibration_label(model), "-")):
            return False  # of another model
        raise DataError(
            f"'{folder}' may be the calibration of this model, and cannot be read ({error}); "
            f"remove the folder, and the stage '{CALIBRATION_STAGE}' makes it again"
        ) from None
    return manifest.stage == CALIBRATION_STAGE and manifest.inputs.get("model") == model.digest


def calibration_label(model: Artefact) -> str:
    """Start of the name of a model's calibration."""
    return f"{model.label}-trust"
