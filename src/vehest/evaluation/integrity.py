"""Detection of a fault: its delay, and the error while it is undetected."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray


def detection_delay(flagged: NDArray[np.bool_], onset: int, end: int, rate_hz: float) -> float:
    """Time from the first faulty sample to the end of the sample that is flagged first [s]; infinite if none is before ``end``.

    ``flagged`` is (T,) at ``rate_hz`` [Hz]; ``onset`` is the index of the first faulty sample.
    """
    found = np.flatnonzero(flagged[onset:end])
    return (int(found[0]) + 1) / rate_hz if len(found) else math.inf


def error_while_undetected(error: FloatArray, flagged: NDArray[np.bool_], onset: int, end: int) -> float:
    """Largest size of the error from a fault's onset to its first flag, or to ``end``; 0 if it is flagged at once.

    ``error``, in which NaN does not count, and ``flagged`` are (T,); ``onset`` is the index of the first faulty sample.
    """
    found = np.flatnonzero(flagged[onset:end])
    own = error[onset : onset + int(found[0]) if len(found) else end]
    return float(np.nanmax(np.abs(own), initial=0.0))
