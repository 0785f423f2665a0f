"""What a study is made from: recordings, metrics, estimates, references and training histories that
earlier stages wrote.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from vehest.data.errors import DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.splits import Span, Split
from vehest.data.store import read_estimate, read_recording
from vehest.data.text_files import first_line, number_in, read_rows, read_text
from vehest.evaluation.blocks import Segments, read_segments
from vehest.evaluation.metrics import Protocol, Scored, score_all


def read_frame(
    path: Path, columns: Iterable[str] = (), *, numbers: Iterable[str] = ()
) -> pd.DataFrame:
    """Read a table that vehest wrote as CSV; its numbers are bitwise those that were written.

    Parameters
    ----------
    path : Path
        The CSV file, UTF-8 with a header.
    columns : iterable of str
        Columns that must be there.
    numbers : iterable of str
        Those of them that must hold numbers; a column that is empty throughout passes.

    Returns
    -------
    pd.DataFrame
        All columns of the file; an empty field is NaN, also in a column of text.

    Raises
    ------
    DataError
        The file cannot be read as CSV, lacks a column, or has text where numbers belong.
    """
    text = read_text(path)
    try:
        table = pd.read_csv(io.StringIO(text), float_precision="round_trip")
    except ValueError as error:  # pandas' own errors are of this kind
        raise DataError(f"'{path}' cannot be read as CSV ({first_line(error)})") from None
    for name in columns:
        if name not in table:
            raise DataError(f"'{path}' has no column '{name}'")
    for name in numbers:
        if not pd.api.types.is_numeric_dtype(table[name]):
            raise DataError(f"'{path}': column '{name}' holds text where numbers belong")
    return table


def write_frame(table: pd.DataFrame, path: Path) -> None:
    """Write a table as CSV, numbers with all their digits.

    Parameters
    ----------
    table : pd.DataFrame
        Its index is not written.
    path : Path
        Replaced if it is there; lines end in LF on every system.
    """
    table.to_csv(path, index=False, lineterminator="\n", errors="backslashreplace")


def nominal_rows(metrics: pd.DataFrame) -> pd.DataFrame:
    """Rows of a table with METRIC_COLUMNS that are over all samples, without a fault."""
    return metrics[(metrics["subset"] == "all") & (metrics["condition"] == "nominal")]


# columns that identify a run and what a metric is over
HEAD = (
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
)
# columns of a long table of metrics, a row for each value; low and high are the ends of its
# interval
METRIC_COLUMNS = ("study", *HEAD, "metric", "value", "unit", "low", "high")


@dataclass(frozen=True)
class EvaluatedModel:
    """One fitted and evaluated estimator."""

    estimator: str  # name in conf/estimator
    variant: str  # identifier of its configuration, as the paper names it
    title: str  # name in tables and figures, for example ``KS-NN linear + bias, P = 2``
    seed: int  # seed of its training
    # folder that the train stage wrote, with ``history.csv`` where the method has one
    model_folder: Path
    # folder that the evaluate stage wrote, with ``<test set>/<n>.parquet`` for the n-th range of a
    # test set, or the n-th sequence
    evaluation_folder: Path
    training: Mapping[str, Any] = field(default_factory=dict)  # settings of its training
    calibration_folder: Path | None = None  # folder of trust.yaml; None: not calibrated

    @property
    def name(self) -> tuple[str, str]:
        """Estimator and variant, which models that differ in their seed share."""
        return self.estimator, self.variant

    def history(self) -> pd.DataFrame | None:
        """Training history, one row an epoch (or a search); none if the method has none."""
        path = self.model_folder / "history.csv"
        return read_frame(path) if path.is_file() else None

    def fit_metrics(self) -> dict[str, float]:
        """Figures of the fit beyond those in the metrics, such as ``skipped_steps``, without times:
        name -> value; empty where nothing was written.
        """
        path = self.model_folder / "fit.csv"
        rows = read_rows(path, ("metric", "value")) if path.is_file() else []
        return {row["metric"]: number_in(row, "value", path) for row in rows}

    def segments(self, test_set: str) -> Segments:
        """Sums of the model's errors over the segments of a test set.

        Returns
        -------
        Segments
            Sums of squared errors and numbers of samples, one entry a segment.

        Raises
        ------
        DataError
            The file is damaged, or has no such test set.
        """
        path = self.evaluation_folder / "blocks.csv"
        segments = read_segments(path)
        if test_set not in segments:
            raise DataError(f"'{path}' has no test set '{test_set}'; evaluate again")
        return segments[test_set]

    def estimate(self, test_set: str, position: int) -> Estimate:
        """The stored estimate of the n-th range of a test set, or of the n-th sequence
        (`sequences`).

        Parameters
        ----------
        test_set : str
            Name of the test set, or ``validation``.
        position : int
            Counted from 0.

        Returns
        -------
        Estimate
            With all stored quantities, at the rate of the estimate.

        Raises
        ------
        DataError
            The file is missing or damaged.
        """
        return read_estimate(self.evaluation_folder / test_set / f"{position}.parquet")


@dataclass(frozen=True)
class PartArtefacts:
    """One comparison: estimators that were trained on one split and were scored on it."""

    study: str  # name of the study
    title: str  # title of the comparison
    about: str  # a paragraph on what is compared, from the pipeline file
    command: str  # the command that makes this report
    split: Split  # training, validation and test ranges
    protocol: Protocol  # protocol by which estimates are scored
    kinds: Mapping[str, str]  # data set -> ``real`` or ``simulated``
    data_titles: Mapping[str, str]  # data set -> title in the report
    # long table with `METRIC_COLUMNS`; test_set ``validation`` is the validation range. Times are
    # not among them, since what a study draws
    # is published, and a time is never the same twice.
    metrics: pd.DataFrame
    models: Sequence[EvaluatedModel]  # evaluated models, in the order of the pipeline file
    # (data set, recording) -> Parquet file at the evaluation rate, references included; of all
    # ranges of the split
    references: Mapping[tuple[str, str], Path]
    facts: Sequence[str]  # further lines on how it was made: training budget, versions, machine
    # name of a model or data set that is left out -> why: it failed or is not available
    failed: Mapping[str, str] = field(default_factory=dict)

    def reference(self, span: Span, channels: Iterable[str] | None = None) -> Recording:
        """The recording of a range at the evaluation rate, with all or some of its channels.

        Parameters
        ----------
        span : Span
            Only its data set and recording count; the recording is not cut.
        channels : iterable of str, optional
            Channels to read; None for all.

        Raises
        ------
        KeyError
            The recording has no file among ``references``.
        DataError
            The file is damaged.
        """
        return read_recording(self.references[span.dataset, span.recording], channels)

    def reference_ranges(self, spans: Iterable[Span]) -> list[Recording]:
        """The recordings of ranges, cut to them; without those whose reference is not there."""
        return [
            self.reference(span).cut(span.start, span.stop)
            for span in spans
            if (span.dataset, span.recording) in self.references
        ]

    def kinds_of(self, spans: Iterable[Span]) -> str:
        """Whether ranges are ``real``, ``simulated`` or ``real and simulated``."""
        return " and ".join(sorted({self.kinds[span.dataset] for span in spans}))

    def scored(self, model: EvaluatedModel, test_set: str) -> list[Scored]:
        """Estimate and reference of a model on each range of a test set, or on each sequence if the
        protocol cuts ranges.

        Returns
        -------
        list of Scored
            One a range or sequence, in the order of the split.

        Raises
        ------
        DataError
            An estimate is damaged, or does not cover its range.
        """
        spans = self.split.validation if test_set == "validation" else self.split.tests[test_set]
        return score_all(
            lambda position: model.estimate(test_set, position),
            spans,
            self.reference,
            self.protocol,
        )


def of_parts(tables: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Concatenate the tables of all parts; the part's name, where it has one, is appended to
    ``trained_on``.

    Parameters
    ----------
    tables : mapping
        Part -> table with a column ``trained_on``; a part without a name leaves it as it is.
    """
    named = [
        table.assign(trained_on=table["trained_on"].fillna("") + f"/{name}") if name else table
        for name, table in tables.items()
    ]
    return pd.concat(named, ignore_index=True)


@dataclass(frozen=True)
class StoredDataset:
    """A data set in the store."""

    name: str  # name in conf/dataset
    title: str  # title in reports
    kind: str  # ``real`` or ``simulated``
    config: Mapping[str, Any]  # configuration of the data set, without texts
    files: Mapping[str, Path]  # recording -> Parquet file at the native rate
    licence: str = ""  # licence of the recordings
    citation: str = ""  # work to cite

    def recordings(self) -> Iterator[Recording]:
        """All recordings, one at a time.

        Raises
        ------
        DataError
            A file is damaged.
        """
        return map(read_recording, self.files.values())


@dataclass(frozen=True)
class AbsentDataset:
    """A data set of a study whose raw files are not available."""

    name: str  # name in conf/dataset
    title: str  # title in reports
    licence: str  # licence of the recordings
    citation: str  # work to cite


@dataclass(frozen=True)
class Trial:
    """One candidate of a search: a training whose error on the validation range is compared with
    that of others.
    """

    search: str  # part of the pipeline file that lists the candidates
    name: str  # part of the pipeline file that trained this one
    options: str  # overrides that were tried, for example ``training.learning_rate=0.001``
    estimator: str  # name in conf/estimator
    variant: str  # identifier of its configuration, as the paper names it
    title: str  # name in tables
    seed: int  # seed of its training
    training: Mapping[str, Any]  # settings of its training
    metric: str  # metric by which the candidate is chosen
    validation: float  # value of the metric on the validation range, to six significant digits
    origin: str  # key of its training in `vehest.run.weights`
    evaluation: str  # version and options of its evaluation
    chosen: bool = False  # whether the trial has the lowest value of its search


@dataclass(frozen=True)
class StudyArtefacts:
    """Input of a study module: parts that compare estimators, or data sets."""

    study: str  # name of the study
    title: str  # title of the study
    about: str  # a paragraph on what is compared or shown, from the pipeline file
    command: str  # the command that makes this report
    # part -> title, for all parts of the pipeline file
    titles: Mapping[str, str] = field(default_factory=dict)
    # name of a part -> artefacts that were compared in it; a study that is not in parts has one
    # without a name
    parts: Mapping[str, PartArtefacts] = field(default_factory=dict)
    absent: Sequence[str] = ()  # parts whose raw files are not available
    # part -> names of trainings that are planned and not done, absent parts included
    not_trained: Mapping[str, Sequence[str]] = field(default_factory=dict)
    trials: Sequence[Trial] = ()  # candidates of searches, which are in no part
    search_remarks: Sequence[str] = ()  # sentences on parts that do not use what a search chose
    # data sets of a study of recordings alone, in the order of the pipeline file
    datasets: Sequence[StoredDataset] = ()
    absent_datasets: Sequence[AbsentDataset] = ()  # data sets whose raw files are not available
    report_command: str = ""  # command that draws this report again, with all of its overrides
    # overrides, as text for a shell, that say where raw files come from and results go; in no
    # published file
    location: str = ""

    @property
    def first(self) -> PartArtefacts:
        """The first part, or the only one."""
        return next(iter(self.parts.values()))

    @property
    def metrics(self) -> pd.DataFrame:
        """Metrics of all parts, `METRIC_COLUMNS`.

        After ``trained_on`` the part, if it has a name: ``sim_two_cars/scheme_1``.
        """
        return of_parts({name: part.metrics for name, part in self.parts.items()})
