"""Integrity of an estimate that states how wrong it may be: protection levels, misleading information, alarms in time or not.

The terms are those of satellite navigation: the **protection level** is the error that is exceeded with a stated risk only, here the
calibrated band; the **alert limit** the error beyond which the estimate must not be used. Information is **misleading** when the error
exceeds the protection level and nothing was flagged, **hazardously** so when it exceeds the alert limit as well. Where the level is beyond
the limit, or the estimate was flagged as invalid, it is **unavailable**.

Source: RTCA DO-229; Tossaint et al., The Stanford-ESA integrity diagram, Navigation 54, 2007.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from vehest.constants import FloatArray
from vehest.data.runs import true_runs

ALERT_LIMIT = 2.0  # deg of sideslip
CONFIDENCE = 0.95

NOMINAL, MISLEADING, HAZARDOUS, UNAVAILABLE = "nominal", "misleading", "hazardously misleading", "unavailable"


@dataclass(frozen=True, eq=False)
class Integrity:
    """Errors and protection levels of samples, and where they lie in the Stanford diagram; arrays are (K,).

    Args:
        error: size of the error [deg, or the unit of the levels].
        level: protection level.
        flagged: whether the estimate was said to be invalid.
        alert_limit: the same for all.
    """

    error: FloatArray
    level: FloatArray
    flagged: NDArray[np.bool_]
    alert_limit: float = ALERT_LIMIT

    def masks(self) -> dict[str, NDArray[np.bool_]]:
        """Region -> samples in it, (K,); each sample lies in one."""
        unavailable = self.flagged | ~(self.level <= self.alert_limit)
        outside = ~unavailable & ~(self.error <= self.level)
        hazardous = outside & ~(self.error <= self.alert_limit)
        return {NOMINAL: ~unavailable & ~outside, MISLEADING: outside & ~hazardous, HAZARDOUS: hazardous, UNAVAILABLE: unavailable}

    def shares(self) -> dict[str, float]:
        """Region -> share of the samples; NaN without samples."""
        return {region: float(mask.mean()) if len(mask) else math.nan for region, mask in self.masks().items()}


def integrity_of(error: FloatArray, level: FloatArray, flagged: NDArray[np.bool_], alert_limit: float = ALERT_LIMIT) -> Integrity:
    """Of signed errors; samples without error or level (a window that is not full yet) are left out.

    Args:
        error: estimate less reference, (T,).
        level: protection level in the same unit, (T,).
        flagged: whether the estimate was said to be invalid, (T,).
        alert_limit: in the same unit.
    """
    known = ~np.isnan(error) & ~np.isnan(level)
    return Integrity(np.abs(error[known]), level[known], np.asarray(flagged, bool)[known], alert_limit)


def detection_delay(flagged: NDArray[np.bool_], onset: int, end: int, rate_hz: float) -> float:
    """Time from the first faulty sample to the end of the sample that is flagged first [s]; infinite if none is before ``end``.

    Args:
        flagged: (T,).
        onset: index of the first faulty sample.
        end: index before which a flag counts.
        rate_hz: [Hz].
    """
    found = np.flatnonzero(flagged[onset:end])
    return (int(found[0]) + 1) / rate_hz if len(found) else math.inf


def missed_detections(delays: Sequence[float], within: Sequence[float] | float = math.inf) -> float:
    """Share of faults that were not flagged, or not in time; NaN without faults.

    Args:
        delays: of `detection_delay`, one a fault [s].
        within: longest delay that counts as in time, for all or one a fault [s].
    """
    if not len(delays):
        return math.nan
    found = np.asarray(delays, np.float64)
    return float(np.mean(~(np.isfinite(found) & (found <= np.asarray(within, np.float64)))))


@dataclass(frozen=True)
class AlarmRate:
    """False alarms in so many hours.

    Args:
        alarms: how many there were.
        hours: of healthy driving.
        per_hour: alarms an hour; NaN without any time.
        low, high: 95 % interval of the rate, exact for a Poisson process.
    """

    alarms: int
    hours: float
    per_hour: float
    low: float
    high: float


def false_alarms_per_hour(flagged: Sequence[NDArray[np.bool_]], rate_hz: float) -> AlarmRate:
    """Alarms on healthy drives; flagged samples in a row are one.

    Args:
        flagged: of each drive, (T,).
        rate_hz: [Hz].

    Source of the interval: Garwood, Fiducial limits for the Poisson distribution, Biometrika 28 (3/4), 1936.
    """
    alarms = sum(len(true_runs(drive)) for drive in flagged)
    hours = sum(len(drive) for drive in flagged) / rate_hz / 3600.0
    if hours == 0.0:
        return AlarmRate(0, 0.0, math.nan, 0.0, math.inf)
    tail = 0.5 * (1.0 - CONFIDENCE)
    low = 0.5 * float(stats.chi2.ppf(tail, 2 * alarms)) if alarms else 0.0
    high = 0.5 * float(stats.chi2.ppf(1.0 - tail, 2 * alarms + 2))
    return AlarmRate(alarms, hours, alarms / hours, low / hours, high / hours)


def error_while_undetected(error: FloatArray, flagged: NDArray[np.bool_], onset: int, end: int) -> tuple[float, float]:
    """Root mean square and largest size of the error from a fault's onset to its first flag, or to ``end``; 0 if it is flagged at once.

    Args:
        error: (T,); NaN does not count.
        flagged: (T,).
        onset: index of the first faulty sample.
        end: index before which errors count.
    """
    found = np.flatnonzero(flagged[onset:end])
    own = error[onset : onset + int(found[0]) if len(found) else end]
    own = own[~np.isnan(own)]
    return (float(np.sqrt(np.mean(np.square(own)))), float(np.abs(own).max())) if len(own) else (0.0, 0.0)
