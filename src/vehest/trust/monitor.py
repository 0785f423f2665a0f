"""Health and band of an estimator's samples, row by row: before the estimate health and isolation, after it verdict and band."""

from __future__ import annotations

import numpy as np

from vehest.constants import FloatArray
from vehest.estimators.base import Estimator
from vehest.trust.bands import band_rows
from vehest.trust.guard import Cleaned
from vehest.trust.health import NUMBERS, Health, health_rows
from vehest.trust.record import Trust
from vehest.trust.verdict import ROLLED_BACK_SECONDS, isolate_rows, starts_anew, verdict_rows, widen_rows
from vehest.trust.watch import Watched


class Monitor:
    """Judges samples before and after they are estimated; keeps the state between calls. Parts of ``trust`` that are None are not judged.

    ``elsewhere``: the car or its tyres are others than those that were calibrated on; ``behind_front_end``: rows come through the filter
    from a faster bus.
    """

    def __init__(self, estimator: Estimator, trust: Trust | None, *, elsewhere: bool = False, behind_front_end: bool = False) -> None:
        bands, health = (trust.bands, trust.health) if trust is not None else (None, None)
        self._health = health.packed(behind_front_end=behind_front_end) if health is not None else None
        self._state = health.start() if health is not None else np.empty(0)
        self._bands = bands.packed(elsewhere=elsewhere) if bands is not None else None
        self.has_bands = bands is not None
        self._farthest = bands.largest.get("vy", 0.0) if bands is not None else 0.0
        self._numbers = np.array([NUMBERS[name] for name in estimator.channels], np.int64)
        self._skippable = np.array([name in estimator.skippable for name in estimator.channels])
        self._needed = ~self._skippable
        self._starts_anew = starts_anew(estimator)
        self._rollback = max(round(ROLLED_BACK_SECONDS * estimator.settings.rate_hz), 1) if getattr(estimator, "adapts", False) else 0
        self._fault = np.zeros(2)

    def before(self, received: FloatArray, cleaned: Cleaned) -> Health:
        """Health of rows (T, C) as received; in ``cleaned``, accused channels are taken out and restarts added, in place."""
        if self._health is None:
            return Health(*np.zeros((3, len(received))))
        found = health_rows(self._health, received, cleaned.measured, self._state)
        isolate_rows(found.status, found.reason, self._numbers, self._skippable, self._starts_anew, self._rollback, *cleaned, self._fault)
        return found

    def after(self, verdict: Health, watched: Watched, cleaned: Cleaned, vx: FloatArray, variance: FloatArray) -> FloatArray:
        """Complete the verdict of `before`, in place, and give half widths of v [m/s] and β [rad], (T, 2); NaN where none are known.

        Args:
            verdict, watched, cleaned: of the same T rows.
            vx: speed of the estimate, (T,) [m/s].
            variance: of the error of v by the method, (T,) [m²/s²]; NaN where it gives none.
        """
        verdict_rows(watched.vy, watched.marks, cleaned.flow, cleaned.measured, self._needed, self._numbers, verdict.status, verdict.reason)
        bands = np.full((len(watched.vy), 2), np.nan)
        if self._bands is not None:
            band_rows(cleaned.rows, watched.vy, variance, *self._bands, bands)
            widen_rows(verdict.status, watched.marks, watched.vy, vx, self._farthest, bands)
        return bands
