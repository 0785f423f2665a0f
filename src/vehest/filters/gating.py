"""Gates: a measurement too far from what a filter expects is refused, unless it has been for so
long that the filter must be wrong.

Flow: a filter computes an innovation and its variance for each measurement, and `refuses` decides.
The only state is one counter for each measurement, which the caller stores between samples, so that
a filter that runs sample by sample decides as one over a whole recording.
"""

from __future__ import annotations

from typing import NamedTuple

import numba

PATIENCE = 0.5  # s, time for which a measurement is refused before its gate opens


class Gate(NamedTuple):
    """Rule by which a measurement is refused: (y - ŷ)² > deviations² S, with S the variance of y -
    ŷ.

    That is the chi-square test of the normalised innovation squared with one degree of freedom,
    measurement by measurement, so that a sensor that fails takes no other one with it. What is
    refused counts as not measured. A contradiction longer than ``patience`` says that the filter is
    lost: the gate opens, until the measurement has agreed as long as it was open, half a second at
    most. Samples without it count neither way.

    Source: Bar-Shalom, Li & Kirubarajan 2001 (validation gate).
    """

    deviations: float  # standard deviations of the innovation [1]
    patience: int  # samples, 1 at least

    @classmethod
    def of(cls, deviations: float | None, rate_hz: float) -> Gate | None:
        """A gate that opens again after `PATIENCE`; None without ``deviations``.

        Parameters
        ----------
        deviations : float | None
            Standard deviations of the innovation beyond which a measurement is refused.
        rate_hz : float
            Rate of the filter [Hz], by which `PATIENCE` becomes a number of samples.
        """
        return None if deviations is None else cls(deviations, max(1, round(PATIENCE * rate_hz)))


@numba.njit(inline="always")
def refuses(error, variance, limit, patience, refused, i):  # type: ignore[no-untyped-def]
    """Decide whether measurement i is refused, and update its counter.

    A contradiction counts up to twice the patience; an accepted measurement counts an open gate
    down by one, and sets the counter of a closed one to 0. The gate is open while the counter is
    above the patience.

    Parameters
    ----------
    error : float
        Innovation y_i - ŷ_i, in the measurement's unit.
    variance : float
        Variance of the innovation. A NaN in either counts as an agreement, since no comparison with
        it is true.
    limit : float
        Squared deviations of the `Gate`.
    patience : int
        Samples of the `Gate`.
    refused : array
        Counters (m,), int64; entry i is changed.
    i : int
        Index of the measurement.
    """
    if not error * error > limit * variance:
        refused[i] = refused[i] - 1 if refused[i] > patience else 0
        return False
    refused[i] = min(refused[i] + 1, 2 * patience)
    return refused[i] <= patience
