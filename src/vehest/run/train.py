"""Third stage: recordings to fitted estimators; members that fit one batch are trained together.

configuration, split, recordings -> TrainJob -> `fit_jobs` -> estimator and record -> `write_model`
"""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vehest.artefacts.artefact import MANIFEST, TIMINGS, Artefact, StagePlan, read_artefact
from vehest.artefacts.keys import changed_options
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.files import sha256_of
from vehest.data.schema import settings_from_config
from vehest.data.splits import Span, Split
from vehest.data.store import read_recording
from vehest.data.text_files import first_line, number_in, read_rows
from vehest.estimators.base import Estimator, FitData, FitRecord
from vehest.estimators.model_files import DESCRIPTION, WEIGHTS, read_description, save_model
from vehest.estimators.registry import new_estimator
from vehest.run.versions import code_of
from vehest.training.context import FitContext

STAGE = "train"  # name of the stage
HISTORY = "history.csv"  # name of the training history in a model's folder
FIT_METRICS = "fit.csv"  # name of the figures of a fit in a model's folder
# note on a training that diverged
DIVERGED = "diverged and ended with its best weights until then; lower its learning_rate"
# options of a training that change no result and are not in its key
UNKEYED = frozenset({"checkpoint_seconds"})


@dataclass(frozen=True)
class TrainJob:
    """One member to train, and the artefact it becomes."""

    plan: StagePlan  # the artefact
    estimator: Mapping[str, Any]  # ``estimator`` of the configuration
    training: Mapping[str, Any]  # ``training`` of the configuration
    split: Split  # ranges of training and validation
    seed: int  # seed of the training
    data: Mapping[str, Artefact]  # data set -> recordings at the estimator's rate

    @property
    def is_learnt_at_once(self) -> bool:
        """Whether there is no training to configure: nothing is fitted, or it has a closed form."""
        return bool(self.training["name"] == "none")

    @property
    def group(self) -> tuple[Any, ...]:
        """Key of trainings that may be done together: those with equal keys.

        It has estimator, training options, seed (unless seeds are fitted together), ranges and
        inputs.
        """
        estimator = new_estimator(self.estimator)
        key = (estimator.batch_key, None if estimator.fits_seeds_together else self.seed)
        training = json.dumps(
            dict(self.training), sort_keys=True
        )  # may hold groups of settings, which have no hash
        return (
            key,
            training,
            self.split.train,
            self.split.validation,
            tuple(sorted(self.plan.inputs.items())),
        )


def estimator_rate(config: Mapping[str, Any]) -> float:
    """Sampling rate that the estimator of a configuration works at [Hz].

    Raises
    ------
    ConfigurationError
        A wrong setting.
    """
    return new_estimator(config["estimator"]).settings.rate_hz


def plan_train(config: Mapping[str, Any], split: Split, data: Mapping[str, Artefact]) -> TrainJob:
    """Plan a training and its artefact.

    Parameters
    ----------
    config : mapping
        As composed for ``train``.
    split : Split
        Ranges of training and validation; without effect where nothing is learnt.
    data : mapping
        Data set -> recordings at the estimator's rate.

    Returns
    -------
    TrainJob
        Its key holds changed options, seed, ranges, digests of recordings and versions.

    Raises
    ------
    ConfigurationError
        A wrong setting or nothing to learn.
    DataError
        Without a recording.
    """
    estimator = new_estimator(config["estimator"])
    seed = config["seed"]
    options = training_options(config)
    if not isinstance(seed, int) or isinstance(seed, bool) or not 0 <= seed < 2**63:
        raise ConfigurationError(f"seed must be a whole number from 0 to 2^63 - 1, not {seed!r}")
    if not estimator.learns:
        split = replace(split, train=(), validation=())
    elif not split.train:
        raise ConfigurationError(
            f"split '{split.name}' has nothing to train on, and estimator '{estimator.name}' "
            "learns; take another split"
        )
    ranges = {
        "train": [_plain(span) for span in split.train],
        "validation": [_plain(span) for span in split.validation],
        **(
            {} if estimator.learns else {"downsample": _preparation(data)}
        ),  # otherwise part of the inputs
    }
    stated = {key: value for key, value in config["training"].items() if key not in UNKEYED}
    content = {
        "estimator": {**config["estimator"], "rate_hz": estimator.settings.rate_hz},
        "training": stated,
        "seed": seed,
        **ranges,
    }
    inputs = digests_of_spans(data, (*split.train, *split.validation))
    label = f"{estimator.name}-{estimator.variant}-seed{seed}"
    plan = StagePlan(
        STAGE,
        label,
        content,
        inputs,
        code_of(STAGE, estimator.name),
        Path(config["output"]),
        options | ranges,
    )
    return TrainJob(plan, config["estimator"], config["training"], split, seed, data)


def training_options(config: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a training that enter its key: those that differ from their defaults, and the
    seed.

    Parameters
    ----------
    config : mapping
        As composed for ``train``.

    Returns
    -------
    dict
        ``estimator``, ``training`` and ``seed``; options of `UNKEYED` are left out.

    Raises
    ------
    ConfigurationError
        The estimator is unknown, or one of its settings or of the training is wrong.
    """
    estimator = new_estimator(config["estimator"])
    training: Any = settings_from_config(estimator.training_type, config["training"], "training")
    changed = changed_options(training)
    return {
        "estimator": {"name": estimator.name, **changed_options(estimator.settings)},
        "training": {key: value for key, value in changed.items() if key not in UNKEYED},
        "seed": config["seed"],
    }


def _plain(span: Span) -> dict[str, str]:
    """A range as plain text, since JSON has no infinity."""
    return {
        "dataset": span.dataset,
        "recording": span.recording,
        "start": str(span.start),
        "stop": str(span.stop),
    }


def fit_jobs(jobs: Sequence[TrainJob], context: FitContext) -> list[tuple[Estimator, FitRecord]]:
    """Train the jobs of one group (`TrainJob.group`) together, each as if it were alone.

    Returns
    -------
    list of tuple
        Fitted estimator and record of its fit, one a job in their order.

    Raises
    ------
    DataError
        Recordings do not fit the estimator.
    """
    first = jobs[0]
    members = [new_estimator(job.estimator) for job in jobs]
    for member, job in zip(members, jobs, strict=True):
        member.seed(job.seed)
    training: Any = settings_from_config(members[0].training_type, first.training, "training")
    train, validation = (
        [
            read_recording(stored_recording(first.data, span)).cut(span.start, span.stop)
            for span in spans
        ]
        for spans in (first.split.train, first.split.validation)
    )
    records = type(members[0]).fit_members(members, FitData(train, validation), training, context)
    return list(zip(members, records, strict=True))


def write_model(job: TrainJob, estimator: Estimator, record: FitRecord, folder: Path) -> None:
    """Write a fitted estimator, the history and figures of its fit and, in a file of their own, its
    times into ``folder``.
    """
    about = {
        "seed": job.seed,
        "trained_on": [span.describe() for span in job.split.train],
        "validated_on": [span.describe() for span in job.split.validation],
        "datasets": list(dict.fromkeys(span.dataset for span in job.split.train)),
        "n_parameters": estimator.n_parameters,
        "downsample": _preparation(job.data),
        "interrupted": record.interrupted,
        **divergence_values(record),
    }
    save_model(estimator, folder, about)
    if record.history:
        _write_csv(
            folder / HISTORY, list(record.history), zip(*record.history.values(), strict=True)
        )
    metrics = {**record.metrics, "n_parameters": estimator.n_parameters}
    for file, timed in ((FIT_METRICS, False), (TIMINGS, True)):
        _write_csv(
            folder / file,
            ["metric", "value"],
            [item for item in metrics.items() if item[0].endswith("_seconds") is timed],
        )


def divergence_values(record: FitRecord) -> dict[str, Any]:
    """Entries of model.yaml on a training that diverged; empty for one that did not."""
    if "step_size_halvings" not in record.metrics:
        return {}
    halvings = int(record.metrics["step_size_halvings"])
    has_ended = bool(record.metrics["ended_by_divergence"])
    return {
        "step_size_halvings": halvings,
        "ended_by_divergence": has_ended,
        **({"note": f"The training {DIVERGED}."} if has_ended else {}),
    }


def _preparation(data: Mapping[str, Artefact]) -> dict[str, Any]:
    """Method and transforms by which the recordings of a job were resampled."""
    config = next(iter(data.values())).config  # the same for all data sets of a job
    return {
        "method": config["method"],
        "transforms": [dict(entry) for entry in config["transforms"]],
    }


def _write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a CSV file with a header, lines ending in LF."""
    with open(path, "w", newline="", encoding="utf-8") as stream:
        csv.writer(stream, lineterminator="\n").writerows([header, *rows])


def read_fit_metrics(folder: Path) -> dict[str, float]:
    """Figures of a fit, such as ``epochs``, and its times.

    Raises
    ------
    DataError
        A file is damaged.
    """
    paths = (folder / FIT_METRICS, folder / TIMINGS)
    return {
        row["metric"]: number_in(row, "value", path)
        for path in paths
        for row in read_rows(path, ("metric", "value"))
    }


def trained_rate(model: Artefact) -> float:
    """The rate that a model works at [Hz]."""
    with _reading_manifest(model):
        return float(model.config["estimator"]["rate_hz"])


def learnt_spans(model: Artefact, *roles: str) -> list[Span]:
    """The ranges that a model was trained on (``train``) and validated on for early stopping
    (``validation``), or those of the named roles.
    """
    with _reading_manifest(model):
        return [
            Span(
                str(entry["dataset"]),
                str(entry["recording"]),
                float(entry["start"]),
                float(entry["stop"]),
            )
            for role in roles or ("train", "validation")
            for entry in model.config[role]
        ]


@contextmanager
def _reading_manifest(model: Artefact) -> Iterator[None]:
    """Context that raises `DataError` where a manifest describes no training."""
    try:
        yield
    except (LookupError, TypeError, ValueError, ConfigurationError) as error:
        raise DataError(
            f"'{model.folder / MANIFEST}': config describes no training ({first_line(error)})"
        ) from None


def model_artefact(folder: Path) -> Artefact:
    """A model as an artefact of the stage ``train``, also where it has no manifest, such as
    `pretrained_folder` or a saved model.

    Raises
    ------
    ConfigurationError
        The folder holds an artefact of another stage.
    DataError
        The model's description or manifest is damaged.
    """
    if (folder / MANIFEST).is_file():
        artefact = read_artefact(folder)
        if artefact.stage != STAGE:
            raise ConfigurationError(
                f"'{folder}' holds no model but an artefact of the stage '{artefact.stage}'"
            )
        return artefact
    about = read_description(folder)
    outputs = {name: sha256_of(folder / name) for name in (DESCRIPTION, WEIGHTS)}
    key = hashlib.sha256(json.dumps(outputs, sort_keys=True).encode()).hexdigest()
    config = {"estimator": dict(about.settings), "train": [], "validation": []}
    return Artefact(
        folder, STAGE, folder.resolve().name, key, "complete", outputs, config, {}, skipped=True
    )


def stored_recording(data: Mapping[str, Artefact], span: Span) -> Path:
    """The file of a span's recording.

    Parameters
    ----------
    data : mapping
        Data set -> its recordings.
    span : Span
        Range of a recording.

    Raises
    ------
    DataError
        The data set does not have the recording.
    """
    artefact = data[span.dataset]
    name = f"{span.recording}.parquet"
    if name not in artefact.outputs:
        available = ", ".join(sorted(Path(file).stem for file in artefact.outputs))
        raise DataError(
            f"data set '{span.dataset}' has no recording '{span.recording}' "
            f"(it has {available}); correct the split"
        )
    return artefact.folder / name


def digests_of_spans(data: Mapping[str, Artefact], spans: Iterable[Span]) -> dict[str, str]:
    """``DATASET/RECORDING`` -> digest of its file; raises as `stored_recording`."""
    return {
        f"{span.dataset}/{span.recording}": data[span.dataset].outputs[
            stored_recording(data, span).name
        ]
        for span in spans
    }
