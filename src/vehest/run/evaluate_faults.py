"""An evaluation under faults: the one without them, and further rows for every fault, each under a condition of its own.

Without faults it is the evaluation of `vehest.run.evaluate`, with the same key and the same files: what a fault does is no part of it.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.splits import VALIDATION, Span
from vehest.data.store import read_estimate
from vehest.estimators.base import Estimator
from vehest.estimators.model_files import load_model
from vehest.evaluation.metrics import Scored, reference_state, score_all, sequences
from vehest.evaluation.under_fault import FAULTED, UNITS, Flagged, Window, errors_under_fault, flags_under_fault
from vehest.run.artefacts import StagePlan
from vehest.run.evaluate import COLUMNS, METRICS, EvaluateJob, measured_range, test_sets, write_evaluation
from vehest.run.faults import FaultSettings
from vehest.trust.contract import estimate_guarded
from vehest.trust.faults import Fault, inject, is_fault
from vehest.trust.record import is_other_vehicle, read_trust

VERSION = "1"


@dataclass(frozen=True)
class FaultedJob:
    """One model to evaluate without faults, and under each of some.

    Args:
        job: the evaluation without faults.
        faults: one condition each.
    """

    job: EvaluateJob
    faults: tuple[FaultSettings, ...] = ()

    @property
    def plan(self) -> StagePlan:
        """The artefact that it becomes; without faults that of the plain evaluation."""
        plan = self.job.plan
        if not self.faults:
            return plan
        faults = [asdict(fault) for fault in self.faults]
        return replace(plan, config={**plan.config, "faults": faults}, code=code_under_faults(plan.code))


def code_under_faults(code: str) -> str:
    """Version of what an evaluation under faults runs.

    Args:
        code: version of the evaluation without faults.
    """
    return f"{code} faults={VERSION}"


def write_faulted(job: FaultedJob, folder: Path) -> None:
    """Write what `write_evaluation` does, and rows of errors under each fault."""
    write_evaluation(job.job, folder)
    if not job.faults:
        return
    estimator = load_model(job.job.model.folder)
    with open(folder / METRICS, newline="", encoding="utf-8") as stream:
        heads = {row["test_set"]: row for row in reversed(list(csv.DictReader(stream)))}
    with open(folder / METRICS, "a", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
        for name, spans in test_sets(job.job.split).items():
            ranges = _Ranges(estimator, job.job, name, spans, folder)
            for fault in job.faults:
                for subset, figures in ranges.errors(fault).items():
                    own = {**heads[name], "subset": subset, "condition": fault.condition, "low": "", "high": ""}
                    writer.writerows(
                        {**own, "metric": metric, "value": repr(value), "unit": UNITS[metric]} for metric, value in figures.items()
                    )


def fault_figures(folder: Path) -> dict[str, float]:
    """Errors of an evaluation on tests under faults, ``METRIC.TEST_SET.CONDITION.SUBSET`` -> value."""
    with open(folder / METRICS, newline="", encoding="utf-8") as stream:
        rows = [row for row in csv.DictReader(stream) if is_fault(row["condition"]) and row["test_set"] != VALIDATION]
    return {".".join(row[key] for key in ("metric", "test_set", "condition", "subset")): float(row["value"]) for row in rows}


class _Ranges:
    """The ranges, or sequences, of a test set as the estimator gets them, and how it did there without faults."""

    def __init__(self, estimator: Estimator, job: EvaluateJob, name: str, spans: Sequence[Span], folder: Path) -> None:
        self.estimator, self.spans, self.protocol = estimator, spans, job.protocol
        self.reference = cache(job.reference)
        self.trust = read_trust(job.calibration.folder) if job.calibration is not None else None
        self.elsewhere = name in job.protocol.sets_elsewhere
        self.pieces = sequences(spans, self.reference, job.protocol)
        self.recordings = [measured_range(job, piece) for piece in self.pieces]
        self.states = [reference_state(self.reference(piece), piece) if job.protocol.initial_state else None for piece in self.pieces]
        self.nominal = self._scored([read_estimate(folder / name / f"{position}.parquet") for position in range(len(self.pieces))])

    def errors(self, settings: FaultSettings) -> dict[str, dict[str, float]]:
        """Subset -> metric -> value under a fault."""
        estimates: list[Estimate] = []
        said: list[Estimate] = []
        windows: list[Window] = []
        for position, (piece, recording, state) in enumerate(zip(self.pieces, self.recordings, self.states, strict=True)):
            start = max(piece.start - recording.start_time, 0.0)
            fault = settings.within(start, recording.duration - start, position)
            onset = recording.start_time + fault.onset
            estimate = self._estimated(recording, fault, state)
            said.append(estimate)
            estimates.append(_lost_from(onset, estimate))
            windows.append((onset, onset + fault.duration))
        scored = self._scored(estimates)
        found = errors_under_fault(scored, self.nominal, windows)
        if self.trust is not None and FAULTED in found:
            flags = [_flags(*pair) for pair in zip(said, scored, strict=True)]
            found[FAULTED] |= flags_under_fault(scored, flags, windows, self.protocol.rate_hz)
        return found

    def _estimated(self, recording: Recording, fault: Fault, state: Mapping[str, float] | None) -> Estimate:
        """The estimate of a recording one of whose channels is faulty, under the contract that holds online."""
        samples = inject(recording.channels, recording.rate_hz, fault)
        elsewhere = self.elsewhere or is_other_vehicle(self.trust, recording)
        return estimate_guarded(self.estimator, samples, recording, self.trust, state, elsewhere=elsewhere)

    def _scored(self, estimates: Sequence[Estimate]) -> list[Scored]:
        return score_all(estimates.__getitem__, self.spans, self.reference, self.protocol)


def _flags(estimate: Estimate, part: Scored) -> Flagged:
    band = estimate.held_at(part.time, "band_sideslip") if "band_sideslip" in estimate.channels else np.full(len(part.time), np.nan)
    return Flagged(band, estimate.held_at(part.time, "health"))


def _lost_from(onset: float, estimate: Estimate) -> Estimate:
    """An estimate that counts as infinite where there is none from the onset of a fault on."""
    lost = np.isnan(estimate["vy"]) & (estimate.time >= onset)
    channels = {name: np.where(lost, np.inf, estimate[name]) for name in ("vy", "sideslip")}
    return replace(estimate, channels=channels, covariance=None, covariance_of=())
