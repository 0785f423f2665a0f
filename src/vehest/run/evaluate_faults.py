"""Evaluates under faults: further rows of metrics.csv for every fault, each under a condition of its own.

Without faults it is the evaluation of `vehest.run.evaluate`, with the same key and the same files.
"""

from __future__ import annotations

import csv
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from vehest.data.estimate import Estimate
from vehest.data.splits import VALIDATION
from vehest.data.store import read_estimate
from vehest.estimators.model_files import load_model
from vehest.evaluation.metrics import Scored, score_all, sequences
from vehest.evaluation.under_fault import FAULTED, UNITS, Flagged, Window, errors_under_fault, flags_under_fault
from vehest.run.evaluate import METRICS, EvaluateJob, head_of, rows_of, test_sets, write_evaluation, write_rows
from vehest.run.faults import FaultSettings
from vehest.trust.contract import estimate_guarded
from vehest.trust.faults import inject, is_fault
from vehest.trust.record import is_elsewhere, read_trust


def write_faulted(job: EvaluateJob, folder: Path) -> None:
    """Write the files of `write_evaluation`, and rows of errors under each fault."""
    write_evaluation(job, folder)
    for name in test_sets(job.how.split) if job.how.faults else ():
        faulted = _FaultedTest(job, name, folder)
        for fault in job.how.faults:
            for subset, figures in faulted.errors(fault).items():
                rows = rows_of(faulted.head, figures, units=UNITS, subset=subset, condition=fault.condition)
                write_rows(folder / METRICS, rows)


def fault_figures(folder: Path) -> dict[str, float]:
    """Errors of an evaluation on tests under faults, ``METRIC.TEST_SET.CONDITION.SUBSET`` -> value."""
    with open(folder / METRICS, newline="", encoding="utf-8") as stream:
        rows = [row for row in csv.DictReader(stream) if is_fault(row["condition"]) and row["test_set"] != VALIDATION]
    return {".".join(row[key] for key in ("metric", "test_set", "condition", "subset")): float(row["value"]) for row in rows}


class _FaultedTest:
    """The ranges, or sequences, of a test set, and the errors there without faults."""

    def __init__(self, job: EvaluateJob, name: str, folder: Path) -> None:
        self.estimator, self.protocol, self.spans = load_model(job.model.folder), job.how.protocol, test_sets(job.how.split)[name]
        self.head = head_of(job, self.estimator, name, self.spans)
        self.reference = cache(job.reference)
        self.trust = None if job.calibration is None else read_trust(job.calibration.folder)
        self.other_vehicle = name in self.protocol.sets_elsewhere
        self.pieces = sequences(self.spans, self.reference, self.protocol)
        self.recordings = [job.measured(piece) for piece in self.pieces]
        self.states = [job.state(piece) for piece in self.pieces]
        self.nominal = self._scored([read_estimate(folder / name / f"{position}.parquet") for position in range(len(self.pieces))])

    def errors(self, settings: FaultSettings) -> dict[str, dict[str, float]]:
        """Subset -> metric -> value under a fault; estimates are guarded as they are online."""
        guarded: list[Estimate] = []
        windows: list[Window] = []
        for position, (piece, recording, state) in enumerate(zip(self.pieces, self.recordings, self.states, strict=True)):
            start = max(piece.start - recording.start_time, 0.0)
            fault = settings.within(start, recording.duration - start, position)
            samples = inject(recording.channels, recording.rate_hz, fault)
            other_vehicle = self.other_vehicle or is_elsewhere(self.trust, recording)
            guarded.append(estimate_guarded(self.estimator, samples, recording, self.trust, state, elsewhere=other_vehicle).estimate)
            onset = recording.start_time + fault.onset
            windows.append((onset, onset + fault.duration))
        scored = self._scored([_infinite_from(onset, estimate) for (onset, _), estimate in zip(windows, guarded, strict=True)])
        found = errors_under_fault(scored, self.nominal, windows)
        if self.trust is not None and FAULTED in found:
            flags = [_flags(*pair) for pair in zip(guarded, scored, strict=True)]
            found[FAULTED] |= flags_under_fault(scored, flags, windows, self.protocol.rate_hz)
        return found

    def _scored(self, estimates: list[Estimate]) -> list[Scored]:
        return score_all(estimates.__getitem__, self.spans, self.reference, self.protocol)


def _flags(estimate: Estimate, part: Scored) -> Flagged:
    band = estimate.held_at(part.time, "band_sideslip") if "band_sideslip" in estimate.channels else np.full(len(part.time), np.nan)
    return Flagged(band, estimate.held_at(part.time, "health"))


def _infinite_from(onset: float, estimate: Estimate) -> Estimate:
    """An estimate that counts as infinite where it is missing after the onset of a fault."""
    lost = np.isnan(estimate["vy"]) & (estimate.time >= onset)
    channels = {name: np.where(lost, np.inf, estimate[name]) for name in ("vy", "sideslip")}
    return replace(estimate, channels=channels, covariance=None, covariance_of=())
