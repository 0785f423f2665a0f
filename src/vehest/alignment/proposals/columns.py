"""Columns of a log on one even clock, as slow as evidence needs them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from vehest.alignment.proposals.names import LATITUDE, LONGITUDE, POSITION_X, POSITION_Y, hints, is_filtered, is_reference
from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.units import factor_to_si

SLOW_HZ = 1.0  # below, a delay of a tenth of a second and vibration matter little
KEPT_HZ = 5.0
MOST_SLOW = 4000  # samples
MOST_MISSING = 0.5  # of a column's samples, which a line then bridges
STRAY = 20.0  # times the spread of nearly all samples; beyond lies no sample of a motion
MOST_STRAY = 0.002
LONG = 1000  # samples
FEWEST_LEVELS = 9  # values that a motion takes; a gear or a flag takes fewer

_POSITIONS = {LATITUDE, LONGITUDE, POSITION_X, POSITION_Y}


@dataclass(frozen=True, eq=False)
class Candidate:
    """A column that may be a channel.

    Args:
        name: in its log.
        unit: by the header, as vehest spells it; empty where it does not say.
        values: in the file's unit, without gaps, (T,).
        slow: low-passed, at `KEPT_HZ` or less, (S,).
        missing: share of the samples that were not there.
        hints: role -> how strongly the name speaks for it.
    """

    name: str
    unit: str
    values: FloatArray
    slow: FloatArray
    missing: float = 0.0
    hints: dict[str, float] = field(default_factory=dict)

    @property
    def is_reference(self) -> bool:
        """Whether its name tells of a reference sensor."""
        return is_reference(self.name)

    @property
    def is_filtered(self) -> bool:
        """Whether its name tells of a filter."""
        return is_filtered(self.name)

    def hint(self, role: str) -> float:
        """How strongly the name speaks for a role; negative where it speaks strongly for others only."""
        if role in self.hints:
            return self.hints[role]
        return -max(self.hints.values(), default=0.0)

    def measures(self, si_unit: str) -> bool:
        """Whether the header's unit, if there is one, is of a quantity."""
        if not self.unit:
            return True
        try:
            factor_to_si(self.unit, si_unit)
        except DataError:
            return False
        return True


def candidates(columns: Sequence[tuple[str, str, FloatArray]], rate_hz: float) -> list[Candidate]:
    """Columns that change and are mostly there.

    Args:
        columns: name, unit as vehest spells it (empty where unknown), values on an even clock, (T,) each.
        rate_hz: of that clock.
    """
    found = []
    for name, unit, values in columns:
        known = np.isfinite(values) & (np.abs(values) < 1e15)
        missing = float(1.0 - known.mean())
        if missing > MOST_MISSING or not np.ptp(values[known]) > 0.0 or len(np.unique(values[known][:200_000])) < FEWEST_LEVELS:
            continue
        if (
            len(values) > LONG and not _POSITIONS & set(hints(name)) and np.min(np.diff(values[known])) >= 0.0
        ):  # a clock, a distance: it only grows
            continue
        known[known] = ~_stray(values[known])
        whole = values if known.all() else np.interp(np.arange(len(values)), np.flatnonzero(known), values[known])
        found.append(Candidate(name, unit, whole, slow_of(whole, rate_hz), missing, dict(hints(name))))
    return found


def _stray(values: FloatArray) -> NDArray[np.bool_]:
    """Samples that lie far outside of nearly all others, (T,); none where they are not few."""
    low, middle, high = np.quantile(values, [MOST_STRAY, 0.5, 1.0 - MOST_STRAY])
    stray = np.abs(values - middle) > STRAY * max(high - low, 1e-300)
    return stray if stray.mean() <= MOST_STRAY else np.zeros(len(values), dtype=bool)


def slow_of(values: FloatArray, rate_hz: float) -> FloatArray:
    """Low-passed at `SLOW_HZ` and thinned out."""
    if rate_hz > 4.0 * SLOW_HZ and len(values) > 30:
        sections = signal.butter(2, SLOW_HZ, fs=rate_hz, output="sos")
        values = np.asarray(signal.sosfiltfilt(sections, values), dtype=np.float64)
    every = max(round(rate_hz / KEPT_HZ), -(-len(values) // MOST_SLOW), 1)
    return values[::every]


def correlation(left: FloatArray, right: FloatArray) -> float:
    """Of two signals about their means; 0 where one does not change."""
    a, b = left - left.mean(), right - right.mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 0.0 else 0.0
