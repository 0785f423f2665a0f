"""Calibrates a model between training and evaluation: bands, limits of samples and health, from its training and validation ranges.

model, ranges -> estimates through whole ranges from a start of their own, as on a new drive -> `Trust` -> trust.yaml

A calibration knows no evaluation's protocol, and no test range.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vehest.data.car import UNKNOWN_CAR, CarValues
from vehest.data.errors import DataError, VehestError
from vehest.data.files import file_name
from vehest.data.recording import Recording
from vehest.data.splits import Span, Split
from vehest.data.store import read_recording
from vehest.estimators.base import Estimator
from vehest.estimators.model_files import (
    DESCRIPTION,
    WEIGHTS,
    load_model,
    model_digest,
    read_description,
)
from vehest.run.artefacts import MANIFEST, Artefact, StagePlan, read_artefact, read_manifest
from vehest.run.train import file_digest, recording_file
from vehest.run.versions import code_of
from vehest.trust.bands import Piece, band_inputs, calibrated
from vehest.trust.guard import learn_limits
from vehest.trust.health import learn_health
from vehest.trust.record import TRUST, About, Trust, read_trust, write_trust

STAGE = "calibrate"
WARM_UP_SECONDS = 10.0  # before a range, as far as its recording goes
SKIP_SECONDS = 1.5  # at the start of each range, as in evaluations


def plan_calibrate(
    model: Artefact,
    split: Split,
    data: Mapping[str, Artefact],
    output: Path,
    cars: Mapping[str, CarValues],
) -> tuple[StagePlan, Callable[[Path], None]] | None:
    """The calibration of a model, as `vehest.run.artefacts.make` takes it; none where a split has no validation range.

    ``cars`` are values of the cars of data sets.
    """
    if not split.validation:
        return None
    spans = {"train": split.train, "validation": split.validation}
    inputs = {"model": model.digest}
    inputs |= {
        f"{span.dataset}/{span.recording}": file_digest(data[span.dataset], span)
        for own in spans.values()
        for span in own
    }
    config: dict[str, Any] = {role: [str(span) for span in own] for role, own in spans.items()}
    calibrated_cars = {
        name: asdict(cars[name])
        for name in sorted({span.dataset for span in split.validation})
        if cars.get(name, UNKNOWN_CAR) != UNKNOWN_CAR
    }
    if calibrated_cars:
        config["cars"] = calibrated_cars
    code = code_of(STAGE, read_description(model.folder).estimator)
    plan = StagePlan(STAGE, _label(model), config, inputs, code, output)
    return plan, partial(_write, model.folder, split, data, cars)


def _write(
    model_folder: Path,
    split: Split,
    data: Mapping[str, Artefact],
    cars: Mapping[str, CarValues],
    folder: Path,
) -> None:
    """Calibrate a model; write trust.yaml into ``folder``, with the reason where bands or health are missing."""

    def stretch(span: Span) -> Stretch:
        recording = read_recording(recording_file(data[span.dataset], span)).cut(
            span.start - WARM_UP_SECONDS, span.stop
        )
        recording = replace(recording, car=cars.get(span.dataset, UNKNOWN_CAR))
        return Stretch(
            recording, max(span.start, recording.start_time), span.dataset, span.describe()
        )

    train, validation = (
        [stretch(span) for span in spans] for spans in (split.train, split.validation)
    )
    write_trust(
        learn_trust(
            load_model(model_folder), train, validation, read_description(model_folder).variant
        ),
        folder,
    )


@dataclass(frozen=True, eq=False)
class Stretch:
    """A range to learn from, with the part of its recording before it."""

    recording: Recording  # at the model's rate, from `WARM_UP_SECONDS` before the range if it is that long, references included
    start: float  # of the range [s]
    dataset: str  # of the recording; may be empty
    name: str  # for people

    @property
    def range(self) -> Recording:
        """The recording without its warm-up."""
        return self.recording.cut(self.start, self.recording.end_time)


def learn_trust(
    estimator: Estimator, train: Sequence[Stretch], validation: Sequence[Stretch], variant: str = ""
) -> Trust:
    """Bands, limits of samples and health of a fitted estimator.

    Training ranges give scales, limits and relations between channels; validation ranges give factors of bands and, together with the
    others, thresholds of health.
    """
    bands = None
    guard = None
    health = None
    notes = []
    try:
        bands = calibrated(
            _pieces(estimator, train),
            _pieces(estimator, validation),
            tuple(estimator.channels),
            vehicles=tuple(dict.fromkeys(stretch.recording.vehicle for stretch in validation)),
            datasets=tuple(
                dict.fromkeys(stretch.dataset for stretch in validation if stretch.dataset)
            ),
            scaled_on=tuple(stretch.name for stretch in train),
            calibrated_on=tuple(stretch.name for stretch in validation),
            horizon_steps=estimator.horizon_steps,
            cars=tuple(
                dict.fromkeys(
                    stretch.recording.car
                    for stretch in validation
                    if stretch.recording.car != UNKNOWN_CAR
                )
            ),
        )
    except DataError as error:  # such as a missing reference, which does not prevent an evaluation
        notes.append(str(error))
    try:
        if not train:
            raise DataError("there is no training range to learn limits and health from")
        guard = learn_limits(
            [stretch.range for stretch in train], estimator.channels, estimator.settings.rate_hz
        )
        learnt, stopped = (
            [stretch.range.without_references() for stretch in part] for part in (train, validation)
        )
        health = learn_health(learnt, stopped, estimator.channels, estimator.settings.rate_hz)
    except DataError as error:
        notes.append(str(error))
    return Trust(About(estimator.name, variant, "; ".join(notes)), bands, guard, health)


def _pieces(estimator: Estimator, stretches: Sequence[Stretch]) -> list[Piece]:
    """Ranges after their starts with the model's estimates on them; raises `DataError` where a recording lacks a channel."""
    found: list[Piece] = []
    estimates = estimator.estimate(
        [stretch.recording.without_references() for stretch in stretches]
    )
    for stretch, estimate in zip(stretches, estimates, strict=True):
        recording = stretch.recording
        rows, vy, variance = band_inputs(
            estimate, recording, tuple(estimator.channels), estimator.horizon_steps
        )
        scored = slice(*recording.index_range(stretch.start + SKIP_SECONDS, recording.end_time))
        turned = estimate["sideslip"] - np.arctan2(recording["vy_ref"], recording["vx"])
        errors = np.stack(
            [vy - recording["vy_ref"], np.remainder(turned + np.pi, 2.0 * np.pi) - np.pi], axis=1
        )
        yaw_rate = recording["yaw_rate"][scored] if "yaw_rate" in recording else None
        found.append(
            Piece(
                rows[scored],
                vy[scored],
                variance[scored],
                errors[scored],
                yaw_rate,
                recording.rate_hz,
            )
        )
    return found


def calibration_figures(folder: Path) -> dict[str, float]:
    """Figures of a calibration for tracking; none where there are no bands."""
    bands = read_trust(folder).bands
    if bands is None:
        return {}
    return {
        "calibration_blocks": float(bands.n_blocks),
        "calibration_blocks_effective": bands.sideslip.effective_blocks,
        "calibration_seconds": bands.seconds,
    }


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

    Raises `DataError`: the model or a calibration of it is damaged or was changed after it was made; also one whose manifest cannot be
    read, where its folder has the model's name.
    """
    if not os.path.lexists(model_folder / MANIFEST):
        return None  # a model that was saved from Python, which no calibration names
    model = read_artefact(model_folder, hash_files=False)
    roots = {model_folder.resolve().parent.parent, output.resolve()}
    folders = sorted({folder for root in roots for folder in (root / STAGE).glob("[!.]*")})
    calibrations = [folder for folder in folders if _calibrates(folder, model)]
    newest = max(
        map(read_artefact, calibrations),
        key=lambda artefact: str(artefact.provenance.get("created", "")),
        default=None,
    )
    return newest


def _calibrates(folder: Path, model: Artefact) -> bool:
    """Whether a folder holds the calibration of a model; raises `DataError` where its manifest is damaged and its name is the model's."""
    try:
        manifest = read_manifest(folder)
    except VehestError as error:
        if not folder.name.startswith(file_name(_label(model), "-")):
            return False  # of another model
        raise DataError(
            f"'{folder}' may be the calibration of this model, and cannot be read ({error}); "
            f"remove the folder, and the stage '{STAGE}' makes it again"
        ) from None
    return manifest.stage == STAGE and manifest.inputs.get("model") == model.digest


def _label(model: Artefact) -> str:
    """Start of the name of a model's calibration."""
    return f"{model.label}-trust"
