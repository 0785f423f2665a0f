"""What the study looks at: trainings, what they make of each manoeuvre, and manoeuvres as the paper
prepares them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from vehest.data.errors import DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.splits import VALIDATION, Span
from vehest.data.store import read_recording
from vehest.data.transforms import LowPass, RemoveOutliers
from vehest.estimators.base import Estimator
from vehest.estimators.dugoff_ukf import DugoffUkf
from vehest.evaluation.metrics import Scored, pieces_of, score, score_all
from vehest.report.style import Line
from vehest.studies.artefacts import EvaluatedModel, PartArtefacts
from vehest_papers.cnn_ukf import paper
from vehest_papers.cnn_ukf.manoeuvres import Kpis, kpis, manoeuvres_of
from vehest_papers.kit.reading import models_by_candidate, sideslip_error

TEST = "test"
CUTOFF_HZ = 5.0
MAX_PAPER_SIDESLIP = 0.21  # rad, 12°: beyond it no drive of the paper goes
OFFLINE = (
    RemoveOutliers(),
    LowPass(CUTOFF_HZ, design="fir"),
    LowPass(CUTOFF_HZ, channels=("vy_ref",), design="fir"),
)
"""Preprocessing of the paper (Section IV-A), of measurements and of the reference."""

LINES = {
    paper.MODEL: Line("#0b4f9c", "dashed", "s"),
    paper.SMOOTH: Line("#4aa5e0", "dotted", "P"),
    paper.DATA: Line("#b8480b", "dashdot", "o"),
    paper.DEEP: Line("#00876c", "solid", "D"),
    paper.CNN: Line("#d6336c", "solid", "^"),
    paper.FREE: Line("#7048a8", "dashed", "v"),
    paper.CNN_FREE: Line("#e599f7", "solid", "<"),
    paper.ORACLE_FILTER: Line("#444444", "dashed", "1"),
    paper.ORACLE_DISTRUST: Line("#444444", "dotted", "2"),
    paper.DATA_SHEET: Line("#9aa7b5", "dashdot", "x"),
    paper.STATIC_MAP: Line("#6b7682", "dashed", "+"),
    paper.ZERO: Line("#c3cad2", "dotted", "."),
}


def line_of(candidate: str) -> Line:
    """How a candidate is drawn."""
    return LINES[candidate]


KPIS = {
    "mse": "MSE [deg²]",
    "mse_nonlinear": "MSE_nl [deg²]",
    "max_error": "ME [deg]",
    "max_error_nonlinear": "ME_nl [deg]",
}
"""Attribute of `Kpis` -> header."""

Manoeuvres = Mapping[str, Sequence[Scored]]  # recording -> what was scored of it: one range

_NAMES = {
    ("dugoff_ukf", False): paper.MODEL,
    ("dugoff_ukf", True): paper.SMOOTH,
    ("sideslip_ffnn", False): paper.DATA,
    ("velocity_gru", False): paper.RECURRENT,
    ("ensemble_ukf", False): paper.DEEP,
    ("cnn_ukf", False): paper.CNN,
    ("zero", False): paper.ZERO,
    ("static_map", False): paper.STATIC_MAP,
    ("data_sheet", False): paper.DATA_SHEET,
}
PARTS_AWAY = {
    "_no_pseudo_measurement": paper.WITHOUT_PSEUDO,
    "_no_adaptive_distrust": paper.CONSTANT_DISTRUST,
    "_no_adaptive_process": paper.CONSTANT_NOISE,
    "_plain": paper.PLAIN,
}
"""Part of a variant's name -> what is taken away, in words."""


FACTORIAL = re.compile(r"factorial_(plain|smooth)_(paper|free)")  # tyre curve, process noise
FLOOR = re.compile(r"floor_(1e-\d)")  # ε of Eq. 6 [rad²]

RENAMED: Mapping[str, Mapping[str, str]] = {
    "before": {paper.CNN: paper.BEFORE},
    "free": {paper.SMOOTH: paper.FREE, paper.CNN: paper.CNN_FREE},
    "z_scores": {paper.DATA: paper.Z_SCORES, paper.CNN: paper.CNN_Z_SCORES},
}
"""Part -> what its candidates are called among those of the full set."""


def name_in(part: str, candidate: str) -> str:
    """What a candidate of a part is called among those of all parts."""
    if (point := FACTORIAL.fullmatch(part)) is not None:
        words = "paper's" if point[2] == "paper" else point[2]
        return f"{candidate.partition(',')[0]} ({point[1]} tyres, {words} noise)"
    if (point := FLOOR.fullmatch(part)) is not None:
        return f"{candidate}, ε = {point[1]} rad²"
    return RENAMED.get(part, {}).get(candidate, candidate)


@dataclass(frozen=True, eq=False)
class Run:
    """One training and what it makes of the validation and the test manoeuvres."""

    candidate: str  # what the report calls it
    model: EvaluatedModel  # where it comes from
    validation: Manoeuvres  # what was scored of each manoeuvre that stopped it
    test: Manoeuvres  # what was scored of each manoeuvre it is tested on

    @property
    def kpis(self) -> Kpis:
        """Of the test."""
        return kpis(self.test)


Runs = Mapping[str, Sequence[Run]]  # candidate -> its seeds


def candidate_of(model: EvaluatedModel) -> str:
    """What the paper calls a model, or what of its method is taken away; of a network's inputs
    z-scores are named; raises `DataError`.
    """
    if model.estimator == "cnn_ukf":
        away = [words for name, words in PARTS_AWAY.items() if name in model.variant]
        if away:
            return ", ".join(away)
    name = model.estimator, model.variant.endswith("_smooth")
    if name not in _NAMES:
        raise DataError(
            f"'{model.title}' is none of the paper's methods, and cannot stand in its tables; "
            "give it a part of its own study"
        )
    return _NAMES[name]


def filter_of(fitted: Estimator) -> DugoffUkf | None:
    """The filter of a fitted method; none if it has none."""
    return fitted if isinstance(fitted, DugoffUkf) else None


def runs_of(part: PartArtefacts, prepared: Prepared) -> dict[str, list[Run]]:
    """Candidate -> its seeds, in the order of Table II.

    Raises
    ------
    DataError
        Two models of a candidate have one seed, a model is none of the paper's methods, or a
        recording has several test ranges.
    """
    recordings = [span.recording for span in prepared.spans(TEST)]
    if len(set(recordings)) != len(recordings):
        raise DataError(
            f"study '{part.study}': a recording of the test set has several ranges, but a "
            "manoeuvre is one; correct the split"
        )
    groups = models_by_candidate(part, candidate_of, paper.CANDIDATES)
    return {
        name: [
            Run(
                name,
                model,
                *(
                    manoeuvres_of(prepared.spans(test), prepared.scored(model, test))
                    for test in (VALIDATION, TEST)
                ),
            )
            for model in models
        ]
        for name, models in groups.items()
    }


def chosen(runs: Sequence[Run]) -> Run:
    """The seed with the lowest mean RMSE of a validation manoeuvre, which no single one decides.
    Test manoeuvres choose nothing.
    """
    return min(runs, key=lambda run: balanced(run.validation))


def balanced(manoeuvres: Manoeuvres) -> float:
    """Mean over manoeuvres of their RMSE(β) [deg]."""
    roots = [
        np.sqrt(np.mean(np.square(np.concatenate([sideslip_error(part) for part in parts]))))
        for parts in manoeuvres.values()
    ]
    return float(np.mean(roots))


def kpi_table(runs: Runs) -> pd.DataFrame:
    """Columns: candidate, seed, those of `KPIS` on the test, ``validation_mse`` [deg²],
    ``validation_balanced`` [deg]; a row a run.
    """
    rows = [
        {"candidate": candidate, "seed": run.model.seed}
        | {name: getattr(run.kpis, name) for name in KPIS}
        | {
            "validation_mse": kpis(run.validation).mse,
            "validation_balanced": balanced(run.validation),
        }
        for candidate, seeds in runs.items()
        for run in seeds
    ]
    return pd.DataFrame(rows)


def until(part: Scored, sideslip: float) -> Scored:
    """What was scored until |β| first exceeds a limit [rad]; all of it where it never does, one
    sample at least; errors alone.
    """
    exceeding = np.flatnonzero(np.abs(part.sideslip_ref) > sideslip)
    last = max(int(exceeding[0]), 1) if len(exceeding) else len(part.time)
    return part.at(slice(last))


class Prepared:
    """Recordings of a part as the paper prepares them, at the evaluation rate; what they were
    scored against here.

    The evaluation scores against the reference as it was measured. The paper's is low-passed as the
    measurements are, and whether a sample counts as non-linear is a matter of the low-passed
    lateral acceleration.

    Parameters
    ----------
    until_sideslip
        Each drive is scored until |β| first exceeds this angle [rad]; by default whole.
    read
        Prepared recordings by file, shared by parts that have the same.
    """

    def __init__(
        self,
        part: PartArtefacts,
        *,
        until_sideslip: float = np.inf,
        read: dict[Path, Recording] | None = None,
    ) -> None:
        self._part = part
        self._until_sideslip = until_sideslip
        self._read = {} if read is None else read

    def spans(self, test: str) -> Sequence[Span]:
        """Ranges of a test set, or of the validation."""
        return self._part.split.validation if test == VALIDATION else self._part.split.tests[test]

    def recording(self, dataset: str, recording: str) -> Recording:
        """All of a recording."""
        path = self._part.references[dataset, recording]
        if path not in self._read:
            prepared = read_recording(path)
            for transform in OFFLINE:
                prepared = transform(prepared)
            self._read[path] = prepared
        return self._read[path]

    def estimator_inputs(self, test: str) -> list[Recording]:
        """What an estimator saw of each range of a test set, if it was prepared offline: with its
        warm-up, without references.
        """
        return [
            self.recording(span.dataset, span.recording)
            .cut(span.start - self._part.protocol.warm_up_seconds, span.stop)
            .without_references()
            for span in self.spans(test)
        ]

    def ranges(self, test: str) -> list[Recording]:
        """The ranges of training, validation or a test set, references included."""
        spans = self._part.split.train if test == "train" else self.spans(test)
        return [
            self.recording(span.dataset, span.recording).cut(span.start, span.stop)
            for span in spans
        ]

    def estimated_by(self, estimator: Estimator, run: Run, candidate: str = "") -> Run:
        """A run whose test is estimated anew by a changed estimator."""
        parts = self.score(estimator.estimate(self.estimator_inputs(TEST)), TEST)
        return Run(
            candidate or run.candidate,
            run.model,
            run.validation,
            manoeuvres_of(self.spans(TEST), parts),
        )

    def scored(self, model: EvaluatedModel, test: str) -> list[Scored]:
        """Estimates of a model and prepared references, range by range."""
        return self.score(
            [model.estimate(test, position) for position in range(len(self.spans(test)))], test
        )

    def score(self, estimates: Sequence[Estimate], test: str) -> list[Scored]:
        """Estimates, one a range, and prepared references."""
        spans = self.spans(test)
        parts = score_all(
            estimates.__getitem__,
            spans,
            lambda span: self.recording(span.dataset, span.recording),
            self._part.protocol,
        )
        return [until(part, self._until_sideslip) for part in parts]

    def with_covariances(self, model: EvaluatedModel, test: str) -> Iterator[Scored]:
        """Whole ranges of a test set with the covariances of the estimates, one in memory at a
        time.
        """
        protocol = self._part.protocol
        pieces = pieces_of(
            self.spans(test), lambda span: self.recording(span.dataset, span.recording), protocol
        )
        for position, (reference, piece) in enumerate(pieces):
            yield score(model.estimate(test, position), reference, piece, protocol)
