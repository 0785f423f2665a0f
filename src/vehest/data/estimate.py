"""What an estimator returns: time series of the estimated quantities on a recording's clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vehest.data.errors import DataError
from vehest.data.recording import FloatArray, clock_tolerance

Mode = Literal["causal", "offline"]

QUANTITIES: dict[str, str] = {
    "vy": "m/s",
    "sideslip": "rad",
    "vx": "m/s",
    "yaw_rate": "rad/s",
    "friction": "1",
}


@dataclass(frozen=True, eq=False)
class Estimate:
    """Estimated states of one recording; sample k holds for ``start_time + k / rate_hz``.

    NaN means that the method has no estimate yet (a window that is not full).

    Args:
        recording_id: the recording it was made from.
        estimator: name of the estimator.
        rate_hz: rate of the estimate [Hz].
        start_time: time of the first sample [s].
        channels: quantity -> values, shape (T,); ``vy`` and ``sideslip`` always, others where the method has them.
        mode: ``causal`` if no sample used measurements later than its own time.
        covariance: of the state (vy first), shape (T, n, n), where the method has one.

    Raises:
        DataError: a quantity is unknown or of another length, or the covariance is not of shape (T, n, n).
    """

    recording_id: str
    estimator: str
    rate_hz: float
    start_time: float
    channels: Mapping[str, FloatArray]
    mode: Mode = "causal"
    covariance: FloatArray | None = None

    def __post_init__(self) -> None:
        lengths = set()
        for name, values in self.channels.items():
            if name not in QUANTITIES:
                raise DataError(f"estimate of '{self.recording_id}': unknown quantity '{name}'")
            lengths.add(len(values))
        if len(lengths) != 1:
            raise DataError(f"estimate of '{self.recording_id}': quantities must have one common length, not {sorted(lengths)}")
        if self.covariance is not None:
            shape = self.covariance.shape
            if len(shape) != 3 or shape[0] != len(self) or shape[1] != shape[2]:
                raise DataError(f"estimate of '{self.recording_id}': the covariance must be of shape ({len(self)}, n, n), not {shape}")

    def __len__(self) -> int:
        return len(next(iter(self.channels.values())))

    def __getitem__(self, name: str) -> FloatArray:
        """Values of one quantity, shape (T,)."""
        try:
            return self.channels[name]
        except KeyError:
            raise DataError(f"estimator '{self.estimator}' does not estimate '{name}'") from None

    @property
    def time(self) -> FloatArray:
        """Times the values hold for [s], shape (T,)."""
        return self.start_time + np.arange(len(self)) / self.rate_hz

    def held_at(self, times: FloatArray, name: str) -> FloatArray:
        """Values of ``name`` at other times: the latest one that is not in the future, NaN outside the estimate.

        Args:
            times: shape (K,) [s].
            name: quantity.

        Returns:
            Shape (K,).
        """
        tolerance = clock_tolerance(self.start_time, self.start_time + len(self) / self.rate_hz, self.rate_hz)
        index = np.floor((np.asarray(times) - self.start_time) * self.rate_hz + tolerance).astype(np.int64)
        values = self[name][np.clip(index, 0, len(self) - 1)]
        return np.where((index >= 0) & (index < len(self)), values, np.nan)
