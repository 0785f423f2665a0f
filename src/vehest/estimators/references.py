"""What estimators of the sideslip angle learn from, and are scored against."""

from __future__ import annotations

import numpy as np

from vehest.constants import FloatArray
from vehest.data.recording import Recording


def reference_sideslip(recording: Recording) -> FloatArray:
    """atan2(vy_ref, vx) with the measured vx, as it is scored, (T,) [rad]."""
    return np.arctan2(recording["vy_ref"], recording["vx"])
