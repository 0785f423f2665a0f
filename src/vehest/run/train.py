"""Third stage: recordings to fitted estimators; members that fit one batch are trained together."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import Recording
from vehest.data.schema import FURTHER_KEYS, settings_from_config, validated
from vehest.data.splits import Span, Split
from vehest.data.store import read_recording
from vehest.data.text_files import number_in, read_rows
from vehest.estimators.base import Estimator, FitData, FitRecord
from vehest.estimators.model_files import save_model
from vehest.estimators.registry import estimator_class
from vehest.run.artefacts import MANIFEST, TIMINGS, Artefact, StagePlan
from vehest.training.context import FitContext

STAGE = "train"
VERSION = "1"
HISTORY = "history.csv"
FIT_METRICS = "fit.csv"


@dataclass(frozen=True)
class TrainJob:
    """One member to train.

    Args:
        plan: the artefact it becomes.
        estimator: configuration of the estimator.
        training: configuration of its training.
        split: what it learns from.
        seed: its seed.
        data: data set -> recordings at the estimator's rate (what the downsample stage made).
    """

    plan: StagePlan
    estimator: Mapping[str, Any]
    training: Mapping[str, Any]
    split: Split
    seed: int
    data: Mapping[str, Artefact]

    @property
    def group(self) -> tuple[Any, ...]:
        """Jobs of one group may be trained together."""
        key = new_estimator(self.estimator).batch_key
        training = json.dumps(dict(self.training), sort_keys=True)  # may hold groups of settings, which have no hash
        return (key, training, self.split.train, self.split.validation, tuple(sorted(self.plan.inputs.items())))


def new_estimator(config: Mapping[str, Any]) -> Estimator:
    """An estimator that is not fitted yet.

    Raises:
        ConfigurationError: an unknown name or setting.
    """
    return estimator_class(str(config["name"])).from_config(config)


def plan_train(config: Mapping[str, Any], split: Split, data: Mapping[str, Artefact]) -> TrainJob:
    """What a training would make.

    Args:
        config: as composed for ``train``.
        split: ranges to learn from; not recorded for an estimator that learns nothing.
        data: data set -> recordings at the estimator's rate.

    Raises:
        ConfigurationError: a setting that makes no sense, a training that does not suit the estimator, or nothing to learn from.
        DataError: the split names a recording that the data set does not have.
    """
    estimator = new_estimator(config["estimator"])
    settings_from_config(estimator.training_type, config["training"], "training")
    seed = config["seed"]
    if not isinstance(seed, int) or isinstance(seed, bool) or not 0 <= seed < 2**63:
        raise ConfigurationError(f"seed must be a whole number from 0 to 2^63 - 1, not {seed!r}")
    if not estimator.learns:
        split = replace(split, train=(), validation=())
    elif not split.train:
        raise ConfigurationError(
            f"split '{split.name}' has nothing to train on, and estimator '{estimator.name}' learns; take another split"
        )
    spans = [*split.train, *split.validation]
    inputs = {f"{span.dataset}/{span.recording}": file_digest(data[span.dataset], span) for span in spans}
    plan = StagePlan(
        stage=STAGE,
        label=f"{estimator.name}-{estimator.variant}-seed{seed}",
        config={
            "estimator": dict(config["estimator"]),
            "training": {key: value for key, value in config["training"].items() if key != "checkpoint_seconds"},
            "train": [_plain(span) for span in split.train],
            "validation": [_plain(span) for span in split.validation],
            "seed": seed,
            **({} if estimator.learns else {"downsample": _preparation(data)}),  # otherwise part of the inputs
        },
        inputs=inputs,
        code=code_of_training(estimator.name),
        output=Path(config["output"]),
    )
    return TrainJob(plan, config["estimator"], config["training"], split, seed, data)


def code_of_training(estimator: str) -> str:
    """Version of what a training of an estimator runs.

    Raises:
        ConfigurationError: the name is unknown.
    """
    kind = estimator_class(estimator)
    return f"train={VERSION} {estimator}={kind.version} training={getattr(kind.training_type, 'version', '1')}"


def fit_jobs(jobs: Sequence[TrainJob], context: FitContext) -> list[tuple[Estimator, FitRecord]]:
    """Train the jobs of one group together, each as if it were alone.

    Raises:
        DataError: the recordings do not fit the estimator.
    """
    first = jobs[0]
    members = []
    for job in jobs:
        member = new_estimator(job.estimator)
        member.seed(job.seed)
        members.append(member)
    training: Any = settings_from_config(members[0].training_type, first.training, "training")
    fit_data = FitData(
        [load_span(first.data, span) for span in first.split.train], [load_span(first.data, s) for s in first.split.validation]
    )
    records = type(members[0]).fit_members(members, fit_data, training, context)
    return list(zip(members, records, strict=True))


def write_model(job: TrainJob, estimator: Estimator, record: FitRecord, folder: Path) -> None:
    """Write a fitted estimator, its history, its figures and, in a file of their own, its times into ``folder``."""
    about = {
        "seed": job.seed,
        "trained_on": [span.describe() for span in job.split.train],
        "validated_on": [span.describe() for span in job.split.validation],
        "datasets": list(dict.fromkeys(span.dataset for span in job.split.train)),
        "n_parameters": estimator.n_parameters,
        "downsample": _preparation(job.data),
        "interrupted": record.interrupted,
    }
    save_model(estimator, folder, about)
    if record.history:
        _write_csv(folder / HISTORY, list(record.history), zip(*record.history.values(), strict=True))
    metrics = {**record.metrics, "n_parameters": estimator.n_parameters}
    for file, timed in ((FIT_METRICS, False), (TIMINGS, True)):
        _write_csv(folder / file, ["metric", "value"], [item for item in metrics.items() if item[0].endswith("_seconds") is timed])


@dataclass(frozen=True)
class _Range:
    """A range as the manifest of a model names it; times as text, since JSON knows no infinity."""

    dataset: str
    recording: str
    start: str
    stop: str


@dataclass(frozen=True)
class _Rate:
    __pydantic_config__ = FURTHER_KEYS
    rate_hz: float


@dataclass(frozen=True)
class _Trained:
    __pydantic_config__ = FURTHER_KEYS
    estimator: _Rate
    train: tuple[_Range, ...]
    validation: tuple[_Range, ...]


def trained_rate(model: Artefact) -> float:
    """The rate that a model works at [Hz].

    Raises:
        DataError: its manifest does not tell.
    """
    return _trained(model).estimator.rate_hz


def learnt_spans(model: Artefact, *roles: str) -> list[Span]:
    """The ranges that a model was trained on (``train``) and stopped on (``validation``), or those of the named roles.

    Raises:
        DataError: its manifest does not tell.
    """
    told = _trained(model)
    ranges = [own for role in roles or ("train", "validation") for own in getattr(told, role)]
    try:
        return [Span(r.dataset, r.recording, float(r.start), float(r.stop)) for r in ranges]
    except (ValueError, ConfigurationError) as error:
        raise DataError(f"'{model.folder / MANIFEST}': config.train and config.validation name no ranges ({error})") from None


def _trained(model: Artefact) -> _Trained:
    return validated(_Trained, dict(model.config), f"'{model.folder / MANIFEST}'", group="config")


def _preparation(data: Mapping[str, Artefact]) -> dict[str, Any]:
    """How the recordings were brought to the estimator's rate, as ``downsample`` of the configuration says it."""
    config = next(iter(data.values())).config  # the same for all data sets of a job
    return {"method": config["method"], "transforms": [dict(entry) for entry in config["transforms"]]}


def read_fit_metrics(folder: Path) -> dict[str, float]:
    """Figures of a fit, such as ``epochs``, and its times.

    Raises:
        MissingError: they are not there.
        DataError: they are damaged.
    """
    return {
        row["metric"]: number_in(row, "value", path)
        for path in (folder / FIT_METRICS, folder / TIMINGS)
        for row in read_rows(path, ("metric", "value"))
    }


def recording_file(data: Artefact, span: Span) -> Path:
    """Where the recording of a span is stored.

    Raises:
        DataError: the data set does not have it.
    """
    file_digest(data, span)
    return data.folder / f"{span.recording}.parquet"


def file_digest(data: Artefact, span: Span) -> str:
    """Digest of the recording of a span.

    Raises:
        DataError: the data set does not have it.
    """
    name = f"{span.recording}.parquet"
    if name not in data.outputs:
        known = ", ".join(sorted(Path(file).stem for file in data.outputs))
        raise DataError(f"data set '{span.dataset}' has no recording '{span.recording}' (it has {known}); correct the split")
    return data.outputs[name]


def load_span(data: Mapping[str, Artefact], span: Span) -> Recording:
    """The samples of a span."""
    return read_recording(recording_file(data[span.dataset], span)).cut(span.start, span.stop)


def _plain(span: Span) -> dict[str, Any]:
    return {"dataset": span.dataset, "recording": span.recording, "start": str(span.start), "stop": str(span.stop)}


def _write_csv(path: Path, header: Sequence[str], rows: Any) -> None:
    with open(path, "w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
