"""Health and band of an estimator's samples, row by row, from what was learnt with it."""

from __future__ import annotations

import numpy as np

from vehest.constants import FloatArray
from vehest.estimators.base import Estimator
from vehest.trust.bands import band_rows
from vehest.trust.guard import Cleaned
from vehest.trust.health import health_rows
from vehest.trust.record import Trust
from vehest.trust.verdict import ROLLED_BACK_SECONDS, Verdict, adapts, isolate_rows, numbers_of, starts_anew, verdict_rows, widen_rows
from vehest.trust.watch import Watched


class Monitor:
    """Judges samples before and after they are estimated; keeps the state between calls.

    Args:
        estimator: whose samples these are.
        trust: learnt with it; what it does not hold is not judged.
        elsewhere: whether the car or its tyres are others than those that were calibrated on.
        behind_front_end: whether rows come through the filter from a faster bus.
    """

    def __init__(self, estimator: Estimator, trust: Trust | None, *, elsewhere: bool = False, behind_front_end: bool = False) -> None:
        bands, health = (trust.bands, trust.health) if trust is not None else (None, None)
        self._health = health.packed(behind_front_end=behind_front_end) if health is not None else None
        self._state = health.start() if health is not None else np.empty(0)
        self._bands = bands.packed(elsewhere=elsewhere) if bands is not None else None
        self._farthest = bands.largest.get("vy", 0.0) if bands is not None else 0.0
        self._numbers = numbers_of(estimator.channels)
        self._skippable = np.array([name in estimator.skippable for name in estimator.channels])
        self._needed = ~self._skippable
        self._starts_anew = starts_anew(estimator)
        self._rollback = max(round(ROLLED_BACK_SECONDS * estimator.settings.rate_hz), 1) if adapts(estimator) else 0
        self._fault = np.zeros(2)

    @property
    def has_bands(self) -> bool:
        """Whether half widths are known."""
        return self._bands is not None

    def before(self, received: FloatArray, cleaned: Cleaned) -> Verdict:
        """Health of rows, and what follows from it for them, in place.

        Args:
            received: rows as they came, (T, C).
            cleaned: what the guard made of them; accused channels are taken out, starts added.
        """
        if self._health is None:
            return Verdict(np.zeros(len(received)), np.zeros(len(received)))
        found = health_rows(self._health, received, cleaned.measured, self._state)
        isolate_rows(
            found.status,
            found.reason,
            self._numbers,
            self._skippable,
            self._starts_anew,
            self._rollback,
            cleaned.rows,
            cleaned.measured,
            cleaned.flow,
            self._fault,
        )
        return Verdict(found.status, found.reason)

    def after(self, verdict: Verdict, watched: Watched, cleaned: Cleaned, vx: FloatArray, variance: FloatArray) -> FloatArray:
        """Complete the verdict, in place, and give half widths of v [m/s] and β [rad], (T, 2); NaN where none are known.

        Args:
            verdict: of `before`, as many rows as ``watched`` has.
            watched: what is passed on.
            cleaned: the same rows.
            vx: speed that goes with the estimate, (T,) [m/s].
            variance: of the error of v as the method gives it, (T,) [m²/s²]; NaN where it gives none.
        """
        verdict_rows(watched.vy, watched.marks, cleaned.flow, cleaned.measured, self._needed, self._numbers, verdict.status, verdict.reason)
        bands = np.full((len(watched.vy), 2), np.nan)
        if self._bands is not None:
            band_rows(cleaned.rows, watched.vy, variance, self._bands.columns, self._bands.numbers, bands)
            widen_rows(verdict.status, watched.marks, watched.vy, vx, self._farthest, bands)
        return bands
