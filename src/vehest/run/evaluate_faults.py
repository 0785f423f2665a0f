"""Errors of estimates under a fault: each range with the fault injected -> guarded estimate, as online -> errors and flags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.splits import Span
from vehest.estimators.base import Estimator
from vehest.evaluation.metrics import Scored
from vehest.evaluation.under_fault import FAULTED, Flagged, Window, errors_under_fault, flags_under_fault
from vehest.run.faults import FaultSettings
from vehest.trust.contract import estimate_guarded
from vehest.trust.faults import inject
from vehest.trust.record import Trust, is_other_vehicle

VERSION = "1"

Piece = tuple[Span, Recording, dict[str, float] | None]
"""A range or sequence, its samples with a warm-up before it, and the state to start from, if any."""


def code_under_faults(code: str) -> str:
    """Version of an evaluation under faults, from that without them."""
    return f"{code} faults={VERSION}"


def guarded_estimates(
    settings: FaultSettings, estimator: Estimator, pieces: Sequence[Piece], trust: Trust | None, *, other_vehicle: bool
) -> tuple[list[Estimate], list[Window]]:
    """Estimates of pieces with a fault injected into each, and start and end of the faults [s]."""
    guarded: list[Estimate] = []
    windows: list[Window] = []
    for position, (span, recording, state) in enumerate(pieces):
        start = max(span.start - recording.start_time, 0.0)
        fault = settings.within(start, recording.duration - start, position)
        samples = inject(recording.channels, recording.rate_hz, fault)
        elsewhere = other_vehicle or is_other_vehicle(trust, recording)
        guarded.append(estimate_guarded(estimator, samples, recording, trust, state, elsewhere=elsewhere))
        onset = recording.start_time + fault.onset
        windows.append((onset, onset + fault.duration))
    return guarded, windows


def infinite_from(windows: Sequence[Window], estimates: Sequence[Estimate]) -> list[Estimate]:
    """Estimates that count as infinite where they are missing after the onset of a fault."""
    found = []
    for (onset, _), estimate in zip(windows, estimates, strict=True):
        lost = np.isnan(estimate["vy"]) & (estimate.time >= onset)
        channels = {name: np.where(lost, np.inf, estimate[name]) for name in ("vy", "sideslip")}
        found.append(replace(estimate, channels=channels, covariance=None, covariance_of=()))
    return found


def errors_and_flags(
    scored: list[Scored], nominal: Sequence[Scored], guarded: Sequence[Estimate], windows: list[Window], rate_hz: float, *, flagged: bool
) -> dict[str, dict[str, float]]:
    """Subset -> metric -> value under a fault, beside the errors without it; with figures of bands and health if ``flagged``."""
    found = errors_under_fault(scored, nominal, windows)
    if flagged and FAULTED in found:
        found[FAULTED] |= flags_under_fault(scored, [_flags(*pair) for pair in zip(guarded, scored, strict=True)], windows, rate_hz)
    return found


def _flags(estimate: Estimate, part: Scored) -> Flagged:
    band = estimate.held_at(part.time, "band_sideslip") if "band_sideslip" in estimate.channels else np.full(len(part.time), np.nan)
    return Flagged(band, estimate.held_at(part.time, "health"))
