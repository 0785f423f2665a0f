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
from vehest.estimators.registry import estimator_class
from vehest.run.artefacts import Artefact, StagePlan, read_artefact
from vehest.run.train import file_digest, recording_file
from vehest.trust.bands import Bands, Origin, Piece, band_inputs, calibrated
from vehest.trust.guard import learn_limits
from vehest.trust.health import learn_health
from vehest.trust.record import TRUST, About, Trust, read_trust, write_trust

STAGE = "calibrate"
VERSION = "1"
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
        code=code_of_calibration(read_description(model.folder).estimator),
        output=output,
    )
    return CalibrateJob(plan, model, split, data)


def code_of_calibration(estimator: str) -> str:
    """Version of what a calibration of an estimator runs.

    Raises:
        ConfigurationError: the name is unknown.
    """
    return f"calibrate={VERSION} {estimator}={estimator_class(estimator).version}"


def write_calibration(job: CalibrateJob, folder: Path) -> None:
    """Calibrate a model; write trust.yaml into ``folder``. What keeps a model from bands or health is noted in there."""
    description, estimator = read_description(job.model.folder), load_model(job.model.folder)
    train, validation = (_stretches(job.data, spans) for spans in (job.split.train, job.split.validation))
    write_trust(learn_trust(estimator, train, validation, description.variant), folder)


@dataclass(frozen=True, eq=False)
class Stretch:
    """A range to learn from, with what of its recording lies before it.

    Args:
        recording: at the model's rate, from `WARM_UP_SECONDS` before the range on as far as there is any, references included.
        start: of the range [s].
        dataset: whose recording it is; empty where it is of none.
        name: of the range, for people.
    """

    recording: Recording
    start: float
    dataset: str
    name: str

    @property
    def measured(self) -> Recording:
        """The range as an estimator may see it."""
        return self.recording.cut(self.start, self.recording.end_time).without_references()


def learn_trust(estimator: Estimator, train: Sequence[Stretch], validation: Sequence[Stretch], variant: str = "") -> Trust:
    """Bands, limits of samples and health of an estimator, from what it was fitted on and what it was stopped on.

    Args:
        estimator: fitted.
        train: give scales, limits and relations between channels.
        validation: gives factors of bands and, together with ``train``, thresholds of health.
        variant: what the paper calls the estimator.
    """
    bands, guard, health, notes = None, None, None, []
    try:
        bands = _bands(estimator, train, validation)
    except DataError as error:  # as of a reference that is not there, which is no reason to go without an evaluation
        notes.append(str(error))
    try:
        if not train:
            raise DataError("there is no training range to learn limits and health from")
        ranges = [stretch.recording.cut(stretch.start, stretch.recording.end_time) for stretch in train]
        guard = learn_limits(ranges, estimator.channels, estimator.settings.rate_hz)
        learnt, stopped = ([stretch.measured for stretch in part] for part in (train, validation))
        health = learn_health(learnt, stopped, estimator.channels, estimator.settings.rate_hz)
    except DataError as error:
        notes.append(str(error))
    return Trust(About(estimator.name, variant, "; ".join(notes)), bands, guard, health)


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
    """Bands, limits and health of a model: trust.yaml in its folder, else its calibration in its own output root, else in another.

    Of several calibrations, which a model that learns nothing has, the one that was made last.

    Args:
        model_folder: of the model, wherever it is.
        output: an output root.

    Raises:
        DataError: it is damaged.
    """
    if (model_folder / TRUST).is_file():
        return read_trust(model_folder)
    found = calibration_of(model_folder, output)
    return None if found is None else read_trust(found.folder)


def calibration_of(model_folder: Path, output: Path) -> Artefact | None:
    """The calibration of a model in its own output root or in another, see `trust_of`."""
    try:
        digest = read_artefact(model_folder).digest
    except VehestError:
        return None
    found = []
    own = model_folder.resolve().parent.parent
    for folder in sorted({place for root in (own, output.resolve()) for place in (root / STAGE).glob("[!.]*")}):
        try:
            artefact = read_artefact(folder)
        except VehestError:
            continue
        if artefact.stage == STAGE and artefact.inputs.get("model") == digest:
            found.append(artefact)
    return max(found, key=lambda artefact: str(artefact.provenance.get("created", "")), default=None)


def _stretches(data: Mapping[str, Artefact], spans: Sequence[Span]) -> list[Stretch]:
    found = []
    for span in spans:
        recording = read_recording(recording_file(data[span.dataset], span)).cut(span.start - WARM_UP_SECONDS, span.stop)
        found.append(Stretch(recording, max(span.start, recording.start_time), span.dataset, span.describe()))
    return found


def _bands(estimator: Estimator, train: Sequence[Stretch], validation: Sequence[Stretch]) -> Bands:
    origin = Origin(
        vehicles=tuple(dict.fromkeys(stretch.recording.vehicle for stretch in validation)),
        datasets=tuple(dict.fromkeys(stretch.dataset for stretch in validation if stretch.dataset)),
        scaled_on=tuple(stretch.name for stretch in train),
        calibrated_on=tuple(stretch.name for stretch in validation),
        channels=tuple(estimator.channels),
        horizon_steps=estimator.horizon_steps,
    )
    return calibrated(_pieces(estimator, train), _pieces(estimator, validation), origin)


def _pieces(estimator: Estimator, stretches: Sequence[Stretch]) -> list[Piece]:
    """Ranges after their starts with the model's estimates on them.

    Raises:
        DataError: a recording lacks a channel or the reference, or the model cannot estimate it.
    """
    for stretch in stretches:
        if "vy_ref" not in stretch.recording:
            raise DataError(f"recording '{stretch.recording.id}' has no channel 'vy_ref' to calibrate bands by")
    found: list[Piece] = []
    estimates = estimator.estimate([stretch.recording.without_references() for stretch in stretches])
    for stretch, estimate in zip(stretches, estimates, strict=True):
        recording = stretch.recording
        rows, vy, variance = band_inputs(estimate, recording, tuple(estimator.channels), estimator.horizon_steps)
        scored = slice(*recording.index_range(stretch.start + SKIP_SECONDS, recording.end_time))
        error = vy - recording["vy_ref"]
        turned = estimate["sideslip"] - np.arctan2(recording["vy_ref"], recording["vx"])
        turned = np.remainder(turned + np.pi, 2.0 * np.pi) - np.pi
        yaw_rate = recording["yaw_rate"][scored] if "yaw_rate" in recording else None
        found.append(Piece(rows[scored], vy[scored], variance[scored], error[scored], turned[scored], yaw_rate, recording.rate_hz))
    return found
