"""Integrity of an estimate with bands: protection levels, misleading information, false alarms.

The terms are those of satellite navigation: the **protection level** is the error that is exceeded
with a stated risk only, here the calibrated band; the **alert limit** the error beyond which the
estimate must not be used. Information is **misleading** when the error exceeds the protection level
and nothing was flagged, **hazardously** so when it exceeds the alert limit as well. Where the level
is beyond the limit, or the estimate was flagged as invalid, it is **unavailable**.

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

NOMINAL = "nominal"
MISLEADING = "misleading"
HAZARDOUS = "hazardously misleading"
UNAVAILABLE = "unavailable"


@dataclass(frozen=True, eq=False)
class Integrity:
    """Errors and protection levels of K samples, and their regions in the Stanford diagram."""

    error: FloatArray  # size of the error of the sideslip angle [deg]
    level: FloatArray  # protection level [deg]
    flagged: NDArray[np.bool_]  # whether the estimate was flagged as invalid

    def masks(self) -> dict[str, NDArray[np.bool_]]:
        """Region -> samples in it, (K,); each sample lies in one."""
        unavailable = self.flagged | ~(self.level <= ALERT_LIMIT)
        outside = ~unavailable & ~(self.error <= self.level)
        hazardous = outside & ~(self.error <= ALERT_LIMIT)
        return {
            NOMINAL: ~unavailable & ~outside,
            MISLEADING: outside & ~hazardous,
            HAZARDOUS: hazardous,
            UNAVAILABLE: unavailable,
        }

    def shares(self) -> dict[str, float]:
        """Region -> share of the samples; NaN without samples."""
        return {
            region: float(mask.mean()) if len(mask) else math.nan
            for region, mask in self.masks().items()
        }


def integrity_of(error: FloatArray, level: FloatArray, flagged: NDArray[np.bool_]) -> Integrity:
    """Integrity from signed errors; samples without error or level are omitted.

    Parameters
    ----------
    error
        Estimate less reference, (T,); NaN while a window is not full.
    level
        Protection level in the same unit, (T,).
    flagged
        Whether the estimate was flagged as invalid, (T,).
    """
    has_both = ~np.isnan(error) & ~np.isnan(level)
    return Integrity(np.abs(error[has_both]), level[has_both], flagged[has_both])


def joined(parts: Sequence[Integrity]) -> Integrity:
    """Integrity of several drives together."""
    return Integrity(
        np.concatenate([part.error for part in parts]),
        np.concatenate([part.level for part in parts]),
        np.concatenate([part.flagged for part in parts]),
    )


@dataclass(frozen=True)
class AlarmRate:
    """False alarms and their rate."""

    alarms: int  # number of false alarms
    hours: float  # of healthy driving
    low: float  # of the 95 % interval of the rate, exact for a Poisson process
    high: float  # likewise


def false_alarms_per_hour(flagged: Sequence[NDArray[np.bool_]], rate_hz: float) -> AlarmRate:
    """Alarms on healthy drives; flagged samples in a row are one.

    Parameters
    ----------
    flagged
        Whether each sample of each drive is flagged, (T,).
    rate_hz
        Rate of the samples [Hz].

    Source of the interval: Garwood, Fiducial limits for the Poisson distribution, Biometrika 28
    (3/4), 1936.
    """
    alarms = sum(len(true_runs(drive)) for drive in flagged)
    hours = sum(len(drive) for drive in flagged) / rate_hz / 3600.0
    if hours == 0.0:
        return AlarmRate(0, 0.0, 0.0, math.inf)
    tail = 0.5 * (1.0 - CONFIDENCE)
    low = 0.5 * float(stats.chi2.ppf(tail, 2 * alarms)) if alarms else 0.0
    high = 0.5 * float(stats.chi2.ppf(1.0 - tail, 2 * alarms + 2))
    return AlarmRate(alarms, hours, low / hours, high / hours)
