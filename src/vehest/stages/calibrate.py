"""Between training and evaluation: how far a model's estimates can be trusted, from its own training and validation ranges.

A calibration belongs to a model and knows no evaluation's protocol: estimates run through whole ranges from a start of their own, as they
do on a new drive. It is judged by what it says on test ranges, which it does not see.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vehest.data.errors import DataError, VehestError
from vehest.data.recording import Recording
from vehest.data.splits import Span, Split
from vehest.data.store import read_recording
from vehest.estimators.base import Estimator
from vehest.estimators.model_files import load_model, read_description
from vehest.estimators.registry import estimator_module
from vehest.stages.artefacts import Artefact, StagePlan, read_artefact
from vehest.stages.code_version import code_version
from vehest.stages.train import file_digest, recording_file
from vehest.trust.bands import Bands, Origin, Piece, band_inputs, calibrated
from vehest.trust.guard import learn_limits
from vehest.trust.health import learn_health
from vehest.trust.record import TRUST, About, Trust, read_trust, write_trust

STAGE = "calibrate"
WARM_UP_SECONDS = 10.0  # before a range, as far as its recording goes
SKIP_SECONDS = 1.5  # at the start of each range, as in evaluations


@dataclass(frozen=True)
class CalibrateJob:
    """One model to calibrate.

    Args:
        plan: the artefact it becomes.
        model: what the train stage made.
        split: whose training and validation ranges serve.
        data: data set -> recordings at the model's rate, references included.
    """

    plan: StagePlan
    model: Artefact
    split: Split
    data: Mapping[str, Artefact]


def plan_calibrate(model: Artefact, split: Split, data: Mapping[str, Artefact], output: Path) -> CalibrateJob | None:
    """What a calibration would make; none where a split has no validation range, and so nothing to calibrate by.

    Args:
        model: what the train stage made.
        split: that the model was trained on; of a model that learns nothing, any.
        data: data set -> recordings at the model's rate.
        output: the output root.

    Raises:
        DataError: the split names a recording that the data set does not have.
    """
    if not split.validation:
        return None
    roles = {"train": split.train, "validation": split.validation}
    inputs = {"model": model.digest}
    inputs |= {f"{span.dataset}/{span.recording}": file_digest(data[span.dataset], span) for spans in roles.values() for span in spans}
    plan = StagePlan(
        stage=STAGE,
        label=f"{model.label}-trust",
        config={role: [str(span) for span in spans] for role, spans in roles.items()},
        inputs=inputs,
        code=code_of_calibration(estimator_module(read_description(model.folder).estimator)),
        output=output,
    )
    return CalibrateJob(plan, model, split, data)


def code_of_calibration(module: str) -> str:
    """Version of what a calibration runs.

    Args:
        module: that of the estimator.
    """
    return code_version(
        [module, "vehest.trust.bands", "vehest.trust.guard", "vehest.trust.health", "vehest.trust.record", "vehest.estimators.model_files"],
        own=[__name__],
    )


def write_calibration(job: CalibrateJob, folder: Path) -> None:
    """Calibrate a model; write trust.yaml into ``folder``. What keeps a model from bands is noted in there."""
    description, estimator = read_description(job.model.folder), load_model(job.model.folder)
    train, validation = (_measured(estimator, job.data, spans) for spans in (job.split.train, job.split.validation))
    bands, guard, health, notes = None, None, None, []
    try:
        bands = _bands(estimator, job)
    except DataError as error:  # as of a reference that is not there, which is no reason to go without an evaluation
        notes.append(str(error))
    try:
        guard = learn_limits(train, estimator.channels, estimator.settings.rate_hz)
        health = learn_health(
            [recording.without_references() for recording in train],
            [recording.without_references() for recording in validation],
            estimator.channels,
            estimator.settings.rate_hz,
        )
    except DataError as error:
        notes.append(str(error))
    write_trust(Trust(About(description.estimator, description.variant, "; ".join(notes)), bands, guard, health), folder)


def calibration_figures(folder: Path) -> dict[str, float]:
    """Figures of a calibration that are worth tracking; none where there are no bands.

    Raises:
        VehestError: it cannot be read.
    """
    bands = read_trust(folder).bands
    if bands is None:
        return {}
    return {
        "calibration_blocks": float(bands.n_blocks),
        "calibration_blocks_effective": bands.sideslip.effective_blocks,
        "calibration_seconds": bands.seconds,
    }


def trust_of(model_folder: Path, output: Path) -> Trust | None:
    """What is known of how far a model can be trusted: trust.yaml in its folder, else its calibration in an output root.

    Of several calibrations, which a model that learns nothing has, the one that was made last.

    Raises:
        DataError: it is damaged.
    """
    if (model_folder / TRUST).is_file():
        return read_trust(model_folder)
    found = calibration_of(model_folder, output)
    return None if found is None else read_trust(found.folder)


def calibration_of(model_folder: Path, output: Path) -> Artefact | None:
    """The calibration of a model in an output root, see `trust_of`."""
    try:
        digest = read_artefact(model_folder).digest
    except VehestError:
        return None
    found = []
    for folder in sorted((output / STAGE).glob("[!.]*")):
        try:
            artefact = read_artefact(folder)
        except VehestError:
            continue
        if artefact.stage == STAGE and artefact.inputs.get("model") == digest:
            found.append(artefact)
    return max(found, key=lambda artefact: str(artefact.provenance.get("created", "")), default=None)


def _measured(estimator: Estimator, data: Mapping[str, Artefact], spans: Sequence[Span]) -> list[Recording]:
    """The ranges, references included."""
    return [read_recording(recording_file(data[span.dataset], span)).cut(span.start, span.stop) for span in spans]


def _bands(estimator: Estimator, job: CalibrateJob) -> Bands:
    horizon = estimator.online().horizon_steps if estimator.causal else 0
    training, validation = (_pieces(estimator, job.data, spans, horizon) for spans in (job.split.train, job.split.validation))
    origin = Origin(
        vehicles=tuple(dict.fromkeys(vehicle for vehicle, _ in validation)),
        datasets=tuple(dict.fromkeys(span.dataset for span in job.split.validation)),
        scaled_on=tuple(span.describe() for span in job.split.train),
        calibrated_on=tuple(span.describe() for span in job.split.validation),
        channels=tuple(estimator.channels),
        horizon_steps=horizon,
    )
    return calibrated([piece for _, piece in training], [piece for _, piece in validation], origin)


def _pieces(estimator: Estimator, data: Mapping[str, Artefact], spans: Sequence[Span], horizon: int) -> list[tuple[str, Piece]]:
    """The vehicle of each range, and the range after its start with the model's estimate on it.

    Raises:
        DataError: a recording lacks a channel or the reference, or the model cannot estimate it.
    """
    seen = []
    for span in spans:
        whole = read_recording(recording_file(data[span.dataset], span))
        seen.append(whole.cut(span.start - WARM_UP_SECONDS, span.stop))
    for recording in seen:
        if "vy_ref" not in recording:
            raise DataError(f"recording '{recording.id}' has no channel 'vy_ref' to calibrate bands by")
    found: list[tuple[str, Piece]] = []
    estimates = estimator.estimate([recording.without_references() for recording in seen])
    for span, recording, estimate in zip(spans, seen, estimates, strict=True):
        rows, vy, variance = band_inputs(estimate, recording, tuple(estimator.channels), horizon)
        scored = slice(*recording.index_range(max(span.start, recording.start_time) + SKIP_SECONDS, span.stop))
        error = vy - recording["vy_ref"]
        turned = estimate["sideslip"] - np.arctan2(recording["vy_ref"], recording["vx"])
        turned = np.remainder(turned + np.pi, 2.0 * np.pi) - np.pi
        yaw_rate = recording["yaw_rate"][scored] if "yaw_rate" in recording else None
        piece = Piece(rows[scored], vy[scored], variance[scored], error[scored], turned[scored], yaw_rate, recording.rate_hz)
        found.append((recording.vehicle, piece))
    return found
