"""Detection of a fault: its delay, the share of faults that are missed, and the error while a fault is undetected."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray


def detection_delay(flagged: NDArray[np.bool_], onset: int, end: int, rate_hz: float) -> float:
    """Time from the first faulty sample to the end of the sample that is flagged first [s]; infinite if none is before ``end``.

    ``flagged`` is (T,) at ``rate_hz`` [Hz]; ``onset`` is the index of the first faulty sample.
    """
    found = np.flatnonzero(flagged[onset:end])
    return (int(found[0]) + 1) / rate_hz if len(found) else math.inf


def missed_detections(delays: Sequence[float], within: Sequence[float] | float = math.inf) -> float:
    """Share of faults that were not flagged, by their ``delays`` [s], or not ``within`` a time [s]; NaN without faults."""
    if not len(delays):
        return math.nan
    found = np.asarray(delays, np.float64)
    return float(np.mean(~(np.isfinite(found) & (found <= np.asarray(within, np.float64)))))


def error_while_undetected(error: FloatArray, flagged: NDArray[np.bool_], onset: int, end: int) -> tuple[float, float]:
    """Root mean square and largest size of the error from a fault's onset to its first flag, or to ``end``; 0 if it is flagged at once.

    ``error``, in which NaN does not count, and ``flagged`` are (T,); ``onset`` is the index of the first faulty sample.
    """
    found = np.flatnonzero(flagged[onset:end])
    own = error[onset : onset + int(found[0]) if len(found) else end]
    own = own[~np.isnan(own)]
    return (float(np.sqrt(np.mean(np.square(own)))), float(np.abs(own).max())) if len(own) else (0.0, 0.0)
