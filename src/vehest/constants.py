"""Standard gravity as rounded in vehicle dynamics, and the type of arrays of numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

GRAVITY = 9.81  # standard gravity [m/s²]

FloatArray = NDArray[np.float64]
"""Array of double precision, of any shape."""
