"""Fifth stage: fitted estimators to estimates and metrics, all read on one grid of times."""

from __future__ import annotations

import csv
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from vehest.data.errors import ConfigurationError, DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.schema import settings_from_config
from vehest.data.splits import TRAINING, VALIDATION, Span, Split
from vehest.data.store import read_estimate, read_recording, write_estimate
from vehest.estimators.base import Estimator
from vehest.estimators.model_files import About, load_model, read_description
from vehest.estimators.registry import estimator_class
from vehest.evaluation.bands import band_figures, banded, coverage_intervals, figures_by_regime
from vehest.evaluation.blocks import Segments, segments_of, write_segments
from vehest.evaluation.floors import cramer_rao_floor, drives_of, inputs_of, reference_floor
from vehest.evaluation.intervals import figure_intervals
from vehest.evaluation.lever_arm import CONDITION, lever_arm_figures
from vehest.evaluation.metrics import (
    UNITS,
    Protocol,
    Scored,
    accuracy,
    pieces_of,
    reference_state,
    score_all,
    scored_range,
    sequences,
)
from vehest.evaluation.regimes import errors_by_regime, regimes_of
from vehest.run.artefacts import TIMINGS, Artefact, StagePlan
from vehest.run.train import FIT_METRICS, file_digest, learnt_spans, read_fit_metrics, recording_file
from vehest.studies.artefacts import read_frame
from vehest.trust.bands import Bands, with_bands
from vehest.trust.record import read_trust

STAGE = "evaluate"
VERSION = "1"
METRICS = "metrics.csv"
BLOCKS = "blocks.csv"
TIMES = ("train_seconds", "step_seconds")
TIMED_STEPS = 200
FIT_FIGURES = ("n_parameters", "epochs", "train_seconds")
TRAINING_METRICS = ("rmse_vy", "fvu", "rmse_sideslip")

COLUMNS = (
    "estimator",
    "variant",
    "trained_on",
    "dataset",
    "kind",
    "test_set",
    "subset",
    "condition",
    "rate_hz",
    "mode",
    "seed",
    "metric",
    "value",
    "unit",
    "low",
    "high",
)


@dataclass(frozen=True)
class EvaluateJob:
    """One model to evaluate.

    Args:
        plan: the artefact it becomes.
        model: what the train stage made.
        split: its validation range and tests are scored.
        data: data set -> recordings at the estimator's rate.
        references: data set -> recordings at the evaluation rate.
        kinds: data set -> ``real`` or ``simulated``.
        protocol: how estimates are scored.
        calibration: how far the model's estimates can be trusted, where that was learnt.
    """

    plan: StagePlan
    model: Artefact
    split: Split
    data: Mapping[str, Artefact]
    references: Mapping[str, Artefact]
    kinds: Mapping[str, str]
    protocol: Protocol
    calibration: Artefact | None = None

    def reference(self, span: Span) -> Recording:
        """The recording of a range at the evaluation rate, references included."""
        return read_recording(recording_file(self.references[span.dataset], span))


def protocol_from_config(config: Mapping[str, Any]) -> Protocol:
    """How estimates are scored.

    Raises:
        ConfigurationError: a value that makes no sense.
    """
    protocol = settings_from_config(Protocol, config, "evaluation")
    if protocol.rate_hz <= 0 or protocol.warm_up_seconds < 0 or protocol.skip_seconds < 0:
        raise ConfigurationError("evaluation.rate_hz must be positive, warm_up_seconds and skip_seconds must not be negative")
    if protocol.sequence_seconds is not None:
        samples = protocol.sequence_seconds * protocol.rate_hz
        if not protocol.sequence_seconds > protocol.skip_seconds or abs(samples - round(samples)) > 1e-6:
            raise ConfigurationError(
                f"evaluation.sequence_seconds must be longer than skip_seconds ({protocol.skip_seconds:g} s) and a whole number of "
                f"samples at {protocol.rate_hz:g} Hz, not {protocol.sequence_seconds:g} s"
            )
    if protocol.initial_state and protocol.warm_up_seconds > 0:
        raise ConfigurationError(
            f"evaluation.initial_state hands over the state at the first sample of a {protocol.piece}, so estimates cannot start "
            f"{protocol.warm_up_seconds:g} s earlier; set evaluation.warm_up_seconds=0"
        )
    return protocol


def plan_evaluate(
    model: Artefact,
    split: Split,
    data: Mapping[str, Artefact],
    references: Mapping[str, Artefact],
    kinds: Mapping[str, str],
    protocol: Protocol,
    output: Path,
    calibration: Artefact | None = None,
) -> EvaluateJob:
    """What an evaluation would make.

    Raises:
        DataError: the split names a recording that the data set does not have.
        ConfigurationError: a test range was used for training.
    """
    estimator = read_description(model.folder).estimator
    for name, spans in split.tests.items():
        for span in spans:
            for learnt in learnt_spans(model):
                if span.overlaps(learnt):
                    raise ConfigurationError(
                        f"test set '{name}' shares samples with what {model.label} was trained or chosen on ({learnt.describe()}); "
                        f"test it on something else"
                    )
    inputs = {"model": model.digest} | ({} if calibration is None else {"calibration": calibration.digest})
    for span in scored_spans(split):
        inputs[f"{span.dataset}/{span.recording}"] = file_digest(data[span.dataset], span)
        inputs[f"reference of {span.dataset}/{span.recording}"] = file_digest(references[span.dataset], span)
    for span in learnt_spans(model, "train"):
        if span.dataset in references:
            inputs[f"reference of {span.dataset}/{span.recording}"] = file_digest(references[span.dataset], span)
    sets = {name: [str(span) for span in spans] for name, spans in test_sets(split).items()}
    plan = StagePlan(
        stage=STAGE,
        label=f"{model.label}-on-{split.name}",
        config={"sets": sets, "protocol": asdict(protocol), "kinds": dict(kinds), "split": split.name},
        inputs=inputs,
        code=code_of_evaluation(estimator),
        output=output,
    )
    return EvaluateJob(plan, model, split, data, references, kinds, protocol, calibration)


def code_of_evaluation(estimator: str) -> str:
    """Version of what an evaluation of an estimator runs.

    Raises:
        ConfigurationError: the name is unknown.
    """
    return f"evaluate={VERSION} {estimator}={estimator_class(estimator).version}"


def write_evaluation(job: EvaluateJob, folder: Path) -> None:
    """Estimate and score every range; write estimates, metrics and, in a file of their own, times into ``folder``."""
    estimator = load_model(job.model.folder)
    about = read_description(job.model.folder).about
    fit = _fit_of(job.model, estimator)
    if not set(FIT_FIGURES) <= set(fit):
        raise DataError(f"'{job.model.folder}' does not say {', '.join(sorted(set(FIT_FIGURES) - set(fit)))} of its fit; train it again")
    bands = _bands_of(job)
    rows: list[tuple[Any, ...]] = []
    blocks: dict[str, Segments] = {}
    for name, spans in test_sets(job.split).items():
        pieces = sequences(spans, job.reference, job.protocol)
        estimates = _with_bands(_estimates(estimator, job, pieces), job, pieces, bands, name)
        for position, estimate in enumerate(estimates):
            write_estimate(estimate, folder / name / f"{position}.parquet")
        scored = score_all(estimates.__getitem__, spans, job.reference, job.protocol)
        blocks[name] = segments_of(scored, job.protocol.rate_hz)
        figures = accuracy(scored)
        if job.protocol.sequence_seconds is not None:
            figures["n_sequences"] = len(pieces)
        if name != VALIDATION:
            figures |= {key: fit[key] for key in FIT_FIGURES} | _floors(estimator, job, spans)
            if estimator.causal:
                figures["step_seconds"] = _step_seconds(estimator, measured_range(job, pieces[0]))
        rows += _rows(estimator, about, job, name, spans, figures, figure_intervals(blocks[name]))
        with_lever = lever_arm_figures(scored, pieces_of(spans, job.reference, job.protocol), job.protocol)
        rows += _rows(estimator, about, job, name, spans, with_lever, {}, condition=CONDITION)
        if name != VALIDATION:
            masks = [regimes_of(reference, piece, job.protocol) for reference, piece in pieces_of(spans, job.reference, job.protocol)]
            for regime, own in errors_by_regime(scored, masks, job.protocol.rate_hz).items():
                rows += _rows(estimator, about, job, name, spans, own, {}, subset=regime)
        if bands is not None:
            rows += _band_rows(estimator, about, job, name, spans, scored, bands)
    rows += _training_rows(estimator, about, job)
    write_segments(folder / BLOCKS, blocks)
    for file, timed in ((METRICS, False), (TIMINGS, True)):
        with open(folder / file, "w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(COLUMNS)
            writer.writerows(row for row in rows if (row[COLUMNS.index("metric")] in TIMES) is timed)


def _rows(
    estimator: Estimator,
    about: About,
    job: EvaluateJob,
    name: str,
    spans: Sequence[Span],
    figures: Mapping[str, float],
    intervals: Mapping[str, tuple[float, float]],
    subset: str = "all",
    condition: str = "nominal",
) -> list[tuple[Any, ...]]:
    """Rows of `COLUMNS` for one set of ranges, for the samples of it that lie in a regime, or under another condition."""
    trained_on = "+".join(about.datasets)
    datasets = "+".join(dict.fromkeys(span.dataset for span in spans))
    kinds = "+".join(dict.fromkeys(job.kinds[span.dataset] for span in spans))
    mode = "causal" if estimator.causal else "offline"
    head = (estimator.name, estimator.variant, trained_on, datasets, kinds, name, subset, condition, job.protocol.rate_hz, mode)
    rows = []
    for metric, value in figures.items():
        ends = [repr(float(end)) for end in intervals[metric]] if metric in intervals else ["", ""]
        rows.append((*head, about.seed, metric, repr(float(value)), UNITS[metric], *ends))
    return rows


def _fit_of(model: Artefact, estimator: Estimator) -> dict[str, float]:
    """Figures of a fit; of a model that came without those its number of parameters, and no epochs."""
    if model.outputs and FIT_METRICS not in model.outputs:
        return dict.fromkeys(FIT_FIGURES, 0.0) | {"n_parameters": float(estimator.n_parameters)}
    return read_fit_metrics(model.folder)


def _bands_of(job: EvaluateJob) -> Bands | None:
    """The model's calibrated bands, where there are any."""
    return None if job.calibration is None else read_trust(job.calibration.folder).bands


def _with_bands(estimates: list[Estimate], job: EvaluateJob, pieces: Sequence[Span], bands: Bands | None, test_set: str) -> list[Estimate]:
    """Estimates with their 90 % bands, wider on vehicles that bands were not calibrated on and on test sets that the protocol names."""
    if bands is None:
        return estimates
    found = []
    for estimate, piece in zip(estimates, pieces, strict=True):
        measured = measured_range(job, piece)
        elsewhere = measured.vehicle not in bands.vehicles or test_set in job.protocol.sets_elsewhere
        found.append(with_bands(estimate, measured, bands, elsewhere=elsewhere))
    return found


def _band_rows(
    estimator: Estimator, about: About, job: EvaluateJob, name: str, spans: Sequence[Span], scored: Sequence[Scored], bands: Bands
) -> list[tuple[Any, ...]]:
    """What bands are worth on a test set, and there by lateral acceleration."""
    rate, own = job.protocol.rate_hz, banded(scored, bands)
    turns, masks = [], []
    for reference, piece in pieces_of(spans, job.reference, job.protocol):
        turns.append(reference["yaw_rate"][slice(*scored_range(reference, piece, job.protocol))] if "yaw_rate" in reference else None)
        masks.append(regimes_of(reference, piece, job.protocol))
    figures = band_figures(own, scored, turns, rate)
    rows = _rows(estimator, about, job, name, spans, figures, coverage_intervals(own, scored, rate))
    for regime, inside in figures_by_regime(own, masks, rate).items():
        rows += _rows(estimator, about, job, name, spans, inside, {}, subset=regime)
    return rows


def _floors(estimator: Estimator, job: EvaluateJob, spans: Sequence[Span]) -> dict[str, float]:
    """The noise of the reference, and the bound for the inputs of a causal estimator; nothing where there is none."""
    drives = drives_of(spans, job.reference, job.protocol)
    inputs = inputs_of(estimator.channels) if estimator.causal else None
    floors = {
        "floor_reference": reference_floor(drives),
        "floor_cramer_rao": cramer_rao_floor(drives, inputs) if inputs is not None else None,
    }
    figures: dict[str, float] = {}
    for name, floor in floors.items():
        if floor is not None:
            figures |= {name: floor.sideslip, f"{name}_vy": floor.vy}
    return figures


def _training_rows(estimator: Estimator, about: About, job: EvaluateJob) -> list[tuple[Any, ...]]:
    """Errors on what the model learnt from; none where the reference has gaps there or nothing was learnt."""
    spans = [span for span in learnt_spans(job.model, "train") if span.dataset in job.data]
    try:
        pieces = sequences(spans, job.reference, job.protocol) if spans else []
        if not pieces:
            return []
        estimates = _estimates(estimator, job, pieces)
        figures = accuracy(score_all(estimates.__getitem__, spans, job.reference, job.protocol))
    except DataError:
        return []
    return _rows(estimator, about, job, TRAINING, spans, {name: figures[name] for name in TRAINING_METRICS}, {})


def read_metrics(folder: Path) -> pd.DataFrame:
    """Metrics and times of an evaluation, one row a figure, with `COLUMNS`.

    Raises:
        MissingError: they are not there.
        DataError: they are damaged.
    """
    tables = [read_frame(folder / file, COLUMNS, numbers=("value",)) for file in (METRICS, TIMINGS)]
    return pd.concat([table for table in tables if len(table)], ignore_index=True)


def read_scored(evaluation: Artefact, split: Split, references: Mapping[str, Artefact], protocol: Protocol, test_set: str) -> list[Scored]:
    """Estimate and reference of an evaluation on each range of a test set, or on each sequence."""
    return score_all(
        lambda position: read_estimate(evaluation.folder / test_set / f"{position}.parquet"),
        test_sets(split)[test_set],
        lambda span: read_recording(recording_file(references[span.dataset], span)),
        protocol,
    )


def test_sets(split: Split) -> dict[str, Sequence[Span]]:
    """Everything that is scored; the validation range too, where there is one, since seeds are chosen on it."""
    return {**({VALIDATION: split.validation} if split.validation else {}), **split.tests}


def scored_spans(split: Split) -> list[Span]:
    """The ranges of all test sets."""
    return [span for spans in test_sets(split).values() for span in spans]


def measured_range(job: EvaluateJob, span: Span) -> Recording:
    """What the estimator may see of a range: no references, and a warm-up before it."""
    recording = read_recording(recording_file(job.data[span.dataset], span))
    return recording.cut(span.start - job.protocol.warm_up_seconds, span.stop).without_references()


def _estimates(estimator: Estimator, job: EvaluateJob, pieces: Sequence[Span]) -> list[Estimate]:
    """An estimate each; those of a protocol that cuts ranges in one go, since a method may then take them all at once."""
    states: Sequence[Mapping[str, float]] | None = None
    if job.protocol.initial_state:
        states = [reference_state(job.reference(piece), piece) for piece in pieces]
    if job.protocol.sequence_seconds is not None:
        return estimator.estimate([measured_range(job, piece) for piece in pieces], states)
    return [
        estimator.estimate([measured_range(job, piece)], states[position] if states is not None else None)[0]
        for position, piece in enumerate(pieces)
    ]


def _step_seconds(estimator: Estimator, recording: Recording) -> float:
    """Median time of one online step on this machine [s]."""
    stepper = estimator.online()
    columns = {name: recording[name] for name in estimator.channels}
    times = np.empty(min(TIMED_STEPS, len(recording)))
    for k in range(len(times)):
        sample = {name: float(samples[k]) for name, samples in columns.items()}
        started = time.perf_counter()
        stepper.step(sample)
        times[k] = time.perf_counter() - started
    return float(np.median(times))
