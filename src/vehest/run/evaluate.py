"""Evaluates fitted estimators: estimates and metrics, all read on one grid of times.

model, calibration, recordings -> estimates of each test set -> scored at the evaluation rate ->
metrics.csv, timings.csv, blocks.csv

Every fault adds rows under a condition of its own; without faults, key and files are those of an
evaluation that has none.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from vehest.artefacts.artefact import TIMINGS, Artefact, StagePlan, Write
from vehest.artefacts.keys import changed_options
from vehest.data.car import UNKNOWN_CAR, CarValues
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.schema import settings_from_config
from vehest.data.splits import TRAINING, VALIDATION, Span, Split
from vehest.data.store import read_recording, write_estimate
from vehest.estimators.base import Estimator
from vehest.estimators.model_files import load_model, read_description
from vehest.evaluation.bands import (
    band_figures,
    coverage_intervals,
    figures_by_regime,
    scored_bands,
)
from vehest.evaluation.blocks import figure_intervals, segments_of, write_segments
from vehest.evaluation.floors import cramer_rao_floor, drives_of, inputs_of, reference_floor
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
from vehest.evaluation.under_fault import UNITS as UNITS_UNDER_FAULT
from vehest.run.evaluate_faults import FaultSettings, errors_under
from vehest.run.train import (
    FIT_METRICS,
    digests_of_spans,
    learnt_spans,
    read_fit_metrics,
    stored_recording,
)
from vehest.run.versions import code_of
from vehest.studies.artefacts import HEAD, METRIC_COLUMNS, nominal_rows, read_frame
from vehest.trust.bands import Bands, with_bands
from vehest.trust.faults import is_fault
from vehest.trust.record import Trust, read_trust

STAGE = "evaluate"  # name of the stage
METRICS = "metrics.csv"  # name of the table of metrics in an evaluation's folder
BLOCKS = "blocks.csv"  # name of the table of segments in an evaluation's folder
TIMES = ("train_seconds", "step_seconds")  # metrics that are times, which have a file of their own
TIMED_STEPS = 200  # online steps at most, of which the median time is reported
# figures of the fit that are listed among the metrics
FIT_FIGURES = ("n_parameters", "epochs", "train_seconds")
# metrics that are computed on the training ranges
TRAINING_METRICS = ("rmse_vy", "fvu", "rmse_sideslip")

COLUMNS = METRIC_COLUMNS[1:]  # columns of the table of metrics: `METRIC_COLUMNS` without the study
ALL_UNITS = UNITS | UNITS_UNDER_FAULT  # metric -> unit


def protocol_from_config(config: Mapping[str, Any]) -> Protocol:
    """Rules of scoring by the section ``evaluation`` of a configuration.

    Parameters
    ----------
    config : mapping
        ``evaluation`` of a configuration.

    Returns
    -------
    Protocol
        Without the wheelbases of cars, which `Protocol.with_wheelbases` adds.

    Raises
    ------
    ConfigurationError
        A value that makes no sense.
    """
    if "least_speed" in config:
        raise ConfigurationError(
            "evaluation.least_speed is now evaluation.min_sideslip_speed: slower samples are left "
            "out of errors of sideslip, instead of counting as 0; leave it out for "
            "1 m/s · sqrt(wheelbase / 2.7 m)"
        )
    protocol = settings_from_config(Protocol, config, "evaluation")
    speeds = protocol.min_sideslip_speed
    if (
        protocol.rate_hz <= 0
        or min(protocol.warm_up_seconds, protocol.skip_seconds) < 0
        or min(speeds.values() if isinstance(speeds, dict) else [speeds or 0.0], default=0.0) < 0
    ):
        raise ConfigurationError(
            "evaluation.rate_hz must be positive, warm_up_seconds, skip_seconds and "
            "min_sideslip_speed must not be negative"
        )
    if protocol.sequence_seconds is not None:
        samples = protocol.sequence_seconds * protocol.rate_hz
        if (
            not protocol.sequence_seconds > protocol.skip_seconds
            or abs(samples - round(samples)) > 1e-6
        ):
            raise ConfigurationError(
                "evaluation.sequence_seconds must be longer than skip_seconds "
                f"({protocol.skip_seconds:g} s) and a whole number of "
                f"samples at {protocol.rate_hz:g} Hz, not {protocol.sequence_seconds:g} s"
            )
    if protocol.initial_state and protocol.warm_up_seconds > 0:
        raise ConfigurationError(
            f"evaluation.initial_state gives the state at the first sample of a {protocol.piece}, "
            "so estimates cannot start "
            f"{protocol.warm_up_seconds:g} s earlier; set evaluation.warm_up_seconds=0"
        )
    return protocol


def evaluation_options(protocol: Protocol, faults: Sequence[FaultSettings]) -> dict[str, Any]:
    """Options of an evaluation that enter its key: those of its protocol and faults that differ
    from their defaults.

    Without faults, no option of faults is among them.
    """
    options: dict[str, Any] = {"protocol": changed_options(protocol)}
    return options | ({"faults": [changed_options(fault) for fault in faults]} if faults else {})


@dataclass(frozen=True)
class Evaluation:
    """Settings of an evaluation: on which validation range and tests models are scored, how, and
    under which faults.
    """

    split: Split  # ranges; the validation and the tests are scored
    data: Mapping[str, Artefact]  # data set -> recordings at the estimator's rate
    references: Mapping[str, Artefact]  # data set -> recordings at the evaluation rate
    kinds: Mapping[str, str]  # data set -> ``real`` or ``simulated``
    protocol: Protocol  # protocol by which estimates are scored
    output: Path  # output root
    faults: tuple[FaultSettings, ...] = ()  # faults under which tests are scored, too
    cars: Mapping[str, CarValues] = field(default_factory=dict)  # data set -> values of its car

    def of(self, model: Artefact, calibration: Artefact | None) -> tuple[StagePlan, Write]:
        """Plan the evaluation of a model, as `artefacts.make` takes it.

        Parameters
        ----------
        model : Artefact
            A finished training, or a model that was saved from Python.
        calibration : Artefact or None
            With the bands and the health that estimates get.

        Returns
        -------
        tuple
            Plan, whose key holds model, calibration, recordings, references, protocol and faults;
            and the function that writes the artefact into a folder.

        Raises
        ------
        ConfigurationError
            It was trained on a test range.
        """
        for name, spans in self.split.tests.items():
            for learnt in learnt_spans(model):
                if any(span.overlaps(learnt) for span in spans):
                    raise ConfigurationError(
                        f"test set '{name}' shares samples with the ranges that {model.label} was "
                        f"trained or chosen on ({learnt.describe()}); test it on something else"
                    )
        inputs = {"model": model.digest} | (
            {} if calibration is None else {"calibration": calibration.digest}
        )
        scored = scored_spans(self.split)
        inputs |= digests_of_spans(self.data, scored)
        compared = [
            *scored,
            *(span for span in learnt_spans(model, "train") if span.dataset in self.references),
        ]
        inputs |= {
            f"reference of {name}": digest
            for name, digest in digests_of_spans(self.references, compared).items()
        }
        config: dict[str, Any] = {
            "sets": {
                name: [str(span) for span in spans] for name, spans in test_sets(self.split).items()
            },
            "protocol": asdict(self.protocol),
            "kinds": dict(self.kinds),
            "split": self.split.name,
        }
        cars = {name: asdict(car) for name, car in self.cars.items() if car != UNKNOWN_CAR}
        if calibration is not None and cars:
            config["cars"] = cars  # they decide whether bands apply
        if self.faults:
            config["faults"] = [asdict(fault) for fault in self.faults]
        code = code_of(STAGE, read_description(model.folder).estimator, faults=bool(self.faults))
        plan = StagePlan(
            STAGE,
            f"{model.label}-on-{self.split.name}",
            config,
            inputs,
            code,
            self.output,
            config | evaluation_options(self.protocol, self.faults),
        )
        return plan, partial(_write, self, model, calibration)

    def reference(self, span: Span) -> Recording:
        """The recording of a range at the evaluation rate, references included.

        Raises
        ------
        DataError
            The data set lacks the recording, or its file is damaged.
        """
        return read_recording(stored_recording(self.references, span))

    def measured(self, span: Span) -> Recording:
        """A range as the estimator receives it: no references, and a warm-up before it.

        Returns
        -------
        Recording
            At the estimator's rate, from ``warm_up_seconds`` before the range (as far as the
            recording goes), with values of its car.
        """
        recording = read_recording(stored_recording(self.data, span))
        recording = replace(recording, car=self.cars.get(span.dataset, UNKNOWN_CAR))
        return recording.cut(
            span.start - self.protocol.warm_up_seconds, span.stop
        ).without_references()

    def state(self, piece: Span) -> dict[str, float] | None:
        """The state that the protocol passes to an estimator at the start of a piece, quantity ->
        value [SI]; None if there is none.
        """
        return (
            reference_state(self.reference(piece), piece) if self.protocol.initial_state else None
        )

    def score(self, spans: Sequence[Span], estimates: Sequence[Estimate]) -> list[Scored]:
        """Score the estimates of a test set against the reference, one a range or sequence."""
        return score_all(estimates.__getitem__, spans, self.reference, self.protocol)


def test_sets(split: Split) -> dict[str, Sequence[Span]]:
    """Name -> ranges of everything that is scored: the tests, and the validation range, on which
    seeds are chosen.
    """
    return {**({VALIDATION: split.validation} if split.validation else {}), **split.tests}


def scored_spans(split: Split) -> list[Span]:
    """The ranges of all test sets, the validation range included."""
    return [span for spans in test_sets(split).values() for span in spans]


def _write(
    evaluation: Evaluation, model: Artefact, calibration: Artefact | None, folder: Path
) -> None:
    """Estimate and score every range, under faults too, and write estimates, metrics and, in a file
    of their own, times into ``folder``.
    """
    estimator = load_model(model.folder)
    protocol = evaluation.protocol
    without_fit = (
        model.outputs and FIT_METRICS not in model.outputs
    )  # such as a model that was saved from Python
    fit = {"n_parameters": float(estimator.n_parameters), "epochs": 0.0, "train_seconds": 0.0}
    fit |= {} if without_fit else read_fit_metrics(model.folder)
    trust = None if calibration is None else read_trust(calibration.folder)
    bands = None if trust is None else trust.bands
    rows: list[dict[str, Any]] = []
    under_faults: list[dict[str, Any]] = []
    blocks = {}
    for name, spans in test_sets(evaluation.split).items():
        head = _head(evaluation, model, estimator, name, spans)
        pieces = sequences(spans, evaluation.reference, protocol)
        estimates = _estimates(estimator, evaluation, pieces)
        for position, piece in enumerate(pieces):
            if (
                bands is not None
            ):  # wider on vehicles without calibration and on test sets that the protocol names
                measured = evaluation.measured(piece)
                other_vehicle = (
                    not bands.are_of(measured.vehicle, measured.car)
                    or name in protocol.sets_elsewhere
                )
                estimates[position] = with_bands(
                    estimates[position], measured, bands, elsewhere=other_vehicle
                )
            write_estimate(estimates[position], folder / name / f"{position}.parquet")
        scored = evaluation.score(spans, estimates)
        blocks[name] = segments_of(scored, protocol.rate_hz)
        figures = accuracy(scored)
        if protocol.sequence_seconds is not None:
            figures["n_sequences"] = len(pieces)
        if name != VALIDATION:
            figures |= {key: fit[key] for key in FIT_FIGURES} | _floors(
                estimator, evaluation, spans
            )
            if estimator.causal:
                figures["step_seconds"] = _step_seconds(estimator, evaluation.measured(pieces[0]))
        rows += _rows(head, figures, figure_intervals(blocks[name]))
        rows += _rows_of_parts(evaluation, head, spans, scored, bands)
        under_faults += _rows_under_faults(estimator, evaluation, head, spans, scored, trust)
    rows += training_rows(evaluation, model, estimator)
    write_segments(folder / BLOCKS, blocks)
    for file, timed in ((METRICS, False), (TIMINGS, True)):
        with open(folder / file, "w", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows(
                row for row in rows + under_faults if (row["metric"] in TIMES) is timed
            )


def _rows_of_parts(
    evaluation: Evaluation,
    head: Mapping[str, Any],
    spans: Sequence[Span],
    scored: Sequence[Scored],
    bands: Bands | None,
) -> list[dict[str, Any]]:
    """Rows of the metrics with the best lever arm, by regime (except on validation), and of
    bands.
    """
    protocol = evaluation.protocol
    masks = []
    turns = []
    for reference, piece in pieces_of(spans, evaluation.reference, protocol):
        masks.append(regimes_of(reference, piece, protocol))
        turns.append(
            reference["yaw_rate"][slice(*scored_range(reference, piece, protocol))]
            if "yaw_rate" in reference
            else None
        )
    rows = _rows(
        head,
        lever_arm_figures(scored, pieces_of(spans, evaluation.reference, protocol), protocol),
        condition=CONDITION,
    )
    if head["test_set"] != VALIDATION:
        for regime, figures in errors_by_regime(scored, masks, protocol.rate_hz).items():
            rows += _rows(head, figures, subset=regime)
    if bands is not None:
        within = scored_bands(scored, bands)
        intervals = coverage_intervals(within, scored, protocol.rate_hz)
        rows += _rows(head, band_figures(within, scored, turns, protocol.rate_hz), intervals)
        for regime, figures in figures_by_regime(within, masks, protocol.rate_hz).items():
            rows += _rows(head, figures, subset=regime)
    return rows


def _rows_under_faults(
    estimator: Estimator,
    evaluation: Evaluation,
    head: Mapping[str, Any],
    spans: Sequence[Span],
    nominal: Sequence[Scored],
    trust: Trust | None,
) -> list[dict[str, Any]]:
    """Rows of the metrics under each fault, with its condition, for the subsets while it lasts and
    after it.
    """
    if not evaluation.faults:
        return []
    rows: list[dict[str, Any]] = []
    pieces = [
        (piece, evaluation.measured(piece), evaluation.state(piece))
        for piece in sequences(spans, evaluation.reference, evaluation.protocol)
    ]
    other_vehicle = head["test_set"] in evaluation.protocol.sets_elsewhere
    score = partial(evaluation.score, spans)
    rate_hz = evaluation.protocol.rate_hz
    for fault in evaluation.faults:
        for subset, figures in errors_under(
            fault, estimator, pieces, trust, nominal, score, rate_hz, other_vehicle=other_vehicle
        ).items():
            rows += _rows(head, figures, subset=subset, condition=fault.condition)
    return rows


def _head(
    evaluation: Evaluation, model: Artefact, estimator: Estimator, name: str, spans: Sequence[Span]
) -> dict[str, Any]:
    """Columns that all rows of a test set share: estimator, data, kinds, rate, mode and seed."""
    about = read_description(model.folder).about
    datasets = dict.fromkeys(span.dataset for span in spans)
    kinds = dict.fromkeys(evaluation.kinds[name] for name in datasets)
    mode = "causal" if estimator.causal else "offline"
    learnt = (estimator.name, estimator.variant, "+".join(about.datasets))
    test = (
        "+".join(datasets),
        "+".join(kinds),
        name,
        "all",
        "nominal",
        evaluation.protocol.rate_hz,
        mode,
        about.seed,
    )
    return dict(zip(HEAD, (*learnt, *test), strict=True))


def _rows(
    head: Mapping[str, Any],
    figures: Mapping[str, float],
    intervals: Mapping[str, tuple[float, float]] | None = None,
    **columns: str,
) -> list[dict[str, Any]]:
    """Rows of `COLUMNS`, one for each metric in ``figures``, with the ends of its interval;
    ``columns`` replace those of the head.
    """
    rows = []
    for metric, value in figures.items():
        low, high = (
            (repr(float(end)) for end in intervals[metric])
            if intervals and metric in intervals
            else ("", "")
        )
        row = {
            "metric": metric,
            "value": repr(float(value)),
            "unit": ALL_UNITS[metric],
            "low": low,
            "high": high,
        }
        rows.append({**head, **columns, **row})
    return rows


def _estimates(
    estimator: Estimator, evaluation: Evaluation, pieces: Sequence[Span]
) -> list[Estimate]:
    """Estimate each piece; sequences are passed at once, since a method may process them
    together.
    """
    batches = (
        [pieces]
        if evaluation.protocol.sequence_seconds is not None
        else [[piece] for piece in pieces]
    )
    estimates: list[Estimate] = []
    for batch in batches:
        states = [state for piece in batch if (state := evaluation.state(piece)) is not None]
        estimates += estimator.estimate(
            [evaluation.measured(piece) for piece in batch], states or None
        )
    return estimates


def _floors(
    estimator: Estimator, evaluation: Evaluation, spans: Sequence[Span]
) -> dict[str, float]:
    """Metrics of the reference's noise and, for a causal estimator, of the bound for its inputs,
    name -> value, as far as they can be computed.
    """
    drives = drives_of(spans, evaluation.reference, evaluation.protocol)
    inputs = inputs_of(estimator.channels) if estimator.causal else None
    floors = {"floor_reference": reference_floor(drives)} | (
        {"floor_cramer_rao": cramer_rao_floor(drives, inputs)} if inputs else {}
    )
    finite_floors = {name: floor for name, floor in floors.items() if floor is not None}
    return {
        name + suffix: value
        for name, floor in finite_floors.items()
        for suffix, value in (("", floor.sideslip), ("_vy", floor.vy))
    }


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


def training_rows(
    evaluation: Evaluation, model: Artefact, estimator: Estimator
) -> list[dict[str, Any]]:
    """Rows of the metrics on the training ranges; empty where the reference has gaps there or
    nothing was trained.

    Parameters
    ----------
    evaluation : Evaluation
        Scores the ranges as it does tests.
    model : Artefact
        Names the ranges that it was trained on.
    estimator : Estimator
        The model, loaded.

    Returns
    -------
    list of dict
        Rows of `COLUMNS` for TRAINING_METRICS, test set TRAINING.
    """
    spans = [span for span in learnt_spans(model, "train") if span.dataset in evaluation.data]
    if not spans:
        return []
    try:
        estimates = _estimates(
            estimator, evaluation, sequences(spans, evaluation.reference, evaluation.protocol)
        )
        figures = accuracy(evaluation.score(spans, estimates))
    except DataError:
        for span in spans:  # what cannot be read is an error, a gap in it is not
            evaluation.reference(span)
            evaluation.measured(span)
        return []
    return _rows(
        _head(evaluation, model, estimator, TRAINING, spans),
        {name: figures[name] for name in TRAINING_METRICS},
    )


def read_metrics(folder: Path, file: str = METRICS) -> pd.DataFrame:
    """Read the metrics (METRICS) or times (TIMINGS) in the folder of an evaluation, a table with
    `COLUMNS`.

    Raises
    ------
    DataError
        The file is damaged.
    """
    return read_frame(folder / file, COLUMNS, numbers=("value",))


def test_figures(folder: Path) -> dict[str, float]:
    """Metrics and times of an evaluation over all samples of each test set, ``METRIC.TEST_SET`` ->
    value.

    Returns
    -------
    dict
        Such as ``rmse_sideslip.test``; without validation, training and faults.
    """
    tables = [read_metrics(folder, file) for file in (METRICS, TIMINGS)]
    table = nominal_rows(pd.concat([part for part in tables if len(part)], ignore_index=True))
    tested = table[~table["test_set"].isin((VALIDATION, TRAINING))]
    return dict(
        zip(tested["metric"] + "." + tested["test_set"], map(float, tested["value"]), strict=True)
    )


def fault_figures(folder: Path) -> dict[str, float]:
    """Metrics of an evaluation on tests under faults, ``METRIC.TEST_SET.CONDITION.SUBSET`` ->
    value.
    """
    return {
        ".".join(row[key] for key in ("metric", "test_set", "condition", "subset")): row["value"]
        for row in read_metrics(folder).to_dict("records")
        if is_fault(row["condition"]) and row["test_set"] != VALIDATION
    }
