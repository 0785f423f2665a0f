"""Estimates: time series of the estimated quantities on a recording's clock."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.recording import clock_tolerance
from vehest.data.time_series import TimeSeries

# whether a sample may use measurements of later times: ``causal`` for no
Mode = Literal["causal", "offline"]

QUANTITIES: dict[str, str] = {
    "vy": "m/s",
    "sideslip": "rad",
    "vx": "m/s",
    "yaw_rate": "rad/s",
    "friction": "1",
    "rim_speed": "m/s",
    "cornering_stiffness_front": "N/rad",
    "cornering_stiffness_rear": "N/rad",
    "tyre_c1_front": "rad²",
    "tyre_c1_rear": "rad²",
    "nis": "1",
    "nis_dof": "1",
    "band_vy": "m/s",
    "band_sideslip": "rad",
    "health": "1",
    "health_reason": "1",
}
"""Quantities of an estimate, with units. ``rim_speed`` is the driven wheels' angular speed times
their radius; a cornering stiffness is an axle's force per slip angle where there is none,
``tyre_c1`` where its curve bends (`vehest.vehicle.rational_tyres`); ``nis`` the normalised
innovation squared of a filter's update, eᵀS⁻¹e, and ``nis_dof`` how many numbers were measured at
it. ``band_vy`` and ``band_sideslip`` are half widths of the calibrated 90 % band, ``health`` is 0
(valid), 1 (degraded) or 2 (invalid), ``health_reason`` says why by a number (`vehest.trust`).
"""

IN_DEGREES: dict[str, str] = {"sideslip_deg": "sideslip", "band_sideslip_deg": "band_sideslip"}
"""Columns of written tables in degrees -> the quantity [rad] that each repeats for people."""

COLUMN_UNITS: dict[str, str] = {"time": "s", **QUANTITIES, **dict.fromkeys(IN_DEGREES, "deg")}
"""Columns of written tables, with units; entries of a covariance have theirs by `column_units`."""

COVARIANCE = "covariance"  # start of the name of the column of entry (i, j), covariance_i_j


def time_cell(seconds: float) -> str:
    """A time in a table of text, to a microsecond."""
    return f"{seconds:.6f}"


def number_cell(value: float) -> str:
    """A value in a table of text, to six significant digits; empty for NaN."""
    return "" if math.isnan(value) else f"{value:.6g}"


@dataclass(frozen=True, eq=False, repr=False)
class Estimate(TimeSeries):
    """Estimated states of one recording; sample k holds for ``start_time + k / rate_hz``.

    NaN means that the method has no estimate yet (a window that is not full).

    Raises
    ------
    ValueError
        A quantity is unknown or of another length, the covariance is not of shape (T, n, n), or its
        rows have no n different names.
    """

    recording_id: str  # the recording it was made from
    estimator: str  # name of the estimator
    rate_hz: float  # rate of the estimate [Hz]
    start_time: float  # time of the first sample [s]
    # quantity -> values, (T,); ``vy`` and ``sideslip`` always, others where the method has them
    channels: Mapping[str, FloatArray]
    mode: Mode = "causal"  # ``causal`` if no sample used measurements later than its own time
    # covariance of the errors of some of the quantities, (T, n, n), where the method has one
    covariance: FloatArray | None = None
    covariance_of: tuple[str, ...] = ()  # the quantity behind each row of the covariance, n names

    def __post_init__(self) -> None:
        subject = f"estimate of '{self.recording_id}'"
        lengths = {len(values) for values in self.channels.values()}
        for name in self.channels.keys() - QUANTITIES.keys():
            raise ValueError(f"{subject}: unknown quantity '{name}'")
        if len(lengths) != 1:
            raise ValueError(
                f"{subject}: quantities must have one common length, not {sorted(lengths)}"
            )
        n_rows = len(self.covariance_of)
        shape = None if self.covariance is None else self.covariance.shape
        if (
            shape != ((len(self), n_rows, n_rows) if n_rows else None)
            or len(QUANTITIES.keys() & set(self.covariance_of)) != n_rows
        ):
            actual = f"not {shape} and ({', '.join(self.covariance_of)})"
            raise ValueError(
                f"{subject}: a covariance must be of shape (T, n, n) and covariance_of name n "
                f"quantities, {actual}"
            )

    @property
    def label(self) -> str:
        """Text that identifies the estimate in messages."""
        return f"of '{self.recording_id}' by {self.estimator}"

    @property
    def units(self) -> dict[str, str]:
        """Quantity -> SI unit."""
        return {name: QUANTITIES[name] for name in self.channels}

    def __getitem__(self, name: str) -> FloatArray:
        """Values of one quantity, shape (T,)."""
        if name not in self.channels:
            raise DataError(f"estimator '{self.estimator}' does not estimate '{name}'")
        return self.channels[name]

    def _table(self) -> dict[str, FloatArray]:
        """Columns of the table of the estimate, angles also in degrees."""
        [columns] = estimate_columns([self])
        return with_degrees(columns)

    def _table_units(self) -> dict[str, str]:
        """Column of the table -> its unit."""
        return column_units(self)

    def held_at(self, times: FloatArray, name: str) -> FloatArray:
        """Values of ``name`` at other times: the latest that is not in the future.

        Parameters
        ----------
        times : FloatArray
            Shape (K,) [s].
        name : str
            A channel of the estimate.

        Returns
        -------
        FloatArray
            In the channel's unit, NaN outside the estimate, shape (K,).
        """
        index = self._held_index(times)
        return np.where(index < 0, np.nan, self[name][index])

    def covariance_at(self, times: FloatArray, names: Sequence[str]) -> FloatArray:
        """Covariance (K, n, n) of n quantities at other times (K,) [s]: the latest that is not in
        the future, NaN outside the estimate.

        Raises
        ------
        DataError
            The estimate has no covariance of one of them.
        """
        if self.covariance is None or set(names) - set(self.covariance_of):
            have = ", ".join(self.covariance_of) or "nothing"
            raise DataError(
                f"estimator '{self.estimator}' gives a covariance of {have}, not of "
                f"{', '.join(names)}"
            )
        index = self._held_index(times)
        rows = [self.covariance_of.index(name) for name in names]
        return np.where(
            index[:, None, None] < 0, np.nan, self.covariance[index][:, rows][:, :, rows]
        )

    def _held_index(self, times: FloatArray) -> NDArray[np.int64]:
        """Index of the sample that is held at each time; -1 outside the estimate."""
        tolerance = clock_tolerance(self.start_time, self.end_time, self.rate_hz)
        index = np.floor((np.asarray(times) - self.start_time) * self.rate_hz + tolerance).astype(
            np.int64
        )
        return np.where((index >= 0) & (index < len(self)), index, -1)


def estimate_columns(parts: Iterable[Estimate]) -> Iterator[dict[str, FloatArray]]:
    """Time, quantities and entries of the covariance of each part of an estimate, on one clock."""
    done = 0
    start = None
    for part in parts:
        start = part.start_time if start is None else start
        columns = {
            "time": start + np.arange(done, done + len(part)) / part.rate_hz,
            **part.channels,
        }
        done += len(part)
        if part.covariance is not None:
            columns |= {
                f"{COVARIANCE}_{i}_{j}": part.covariance[:, i, j]
                for i, j in np.ndindex(part.covariance.shape[1:])
            }
        yield columns


def with_degrees(columns: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Columns of an estimate, followed by the angles among them in degrees."""
    angles = {name: angle for name, angle in IN_DEGREES.items() if angle in columns}
    return {**columns, **{name: np.degrees(columns[angle]) for name, angle in angles.items()}}


def column_units(estimate: Estimate) -> dict[str, str]:
    """Units of the columns of an estimate's table, entries of its covariance included."""
    units = [QUANTITIES[name] for name in estimate.covariance_of]
    of_covariance = {
        f"{COVARIANCE}_{i}_{j}": f"{units[i]}·{units[j]}" for i, j in np.ndindex(2 * (len(units),))
    }
    return COLUMN_UNITS | of_covariance
