"""Consequences of health.

Channels that an estimator gets, restarts, status and reason of its estimate, width of its band.

- A channel that health accuses of a fault counts as not measured where the method can do without
  it, so that nothing adapts to it.
- An estimator that remembers more than a window starts anew once a persistent fault is over.
- One with states that adapt, such as tyres and friction, does not, since it would forget them. But
  if the accused channel is one that it needs, these states go back to what they were fitted to,
  after each two seconds in which the channel was accused.
- A shorter fault, such as a single wrong sample, changes neither: what it leaves in an estimator is
  smaller than what a new start loses. Only samples at which a channel is accused count, not the
  time for which a flag is held afterwards.
- The band is twice as wide while an estimate is degraded and four times while it is invalid, and
  where there is no estimate it reaches at least as far as sideslip did in training. These factors
  were set before their effect was looked at.
"""

from __future__ import annotations

import math

import numpy as np

from vehest.constants import FloatArray
from vehest.estimators.base import Estimator
from vehest.estimators.kernels.compiling import entry
from vehest.trust import health_kernel as kernel
from vehest.trust.bands import band_rows
from vehest.trust.guard import RESTART, USE, WAIT, Cleaned
from vehest.trust.health import (
    BEYOND_SPEED,
    DEGRADED,
    INVALID,
    NO_ESTIMATE,
    NUMBERS,
    TOO_WIDE,
    VALID,
    Health,
    health_rows,
)
from vehest.trust.record import Trust
from vehest.trust.watch import CLIPPED, EXTRAPOLATED, SPINNING, Watched

BAND_FACTORS = (1.0, 2.0, 4.0)  # factor of the band of a valid, a degraded, an invalid estimate

WIDEST = math.radians(6.0)
"""Half width of the band of β beyond which an estimate is invalid.

What it says of the car is no more than v = 0 does.
"""

PERSISTENT_FAULT_SECONDS = 2.0
"""Time for which a channel has been accused, from which on a fault is persistent.

A single wrong sample is accused for up to 1.6 s, as sums decay.
"""

# kinds of reasons that accuse no sensor
NO_FAULT_KINDS = np.array([kernel.FREE, kernel.MISSING, kernel.OUTSIDE, kernel.SPIN])


def starts_anew(estimator: Estimator) -> bool:
    """Whether an estimator is better off without its memory after a fault.

    It has more than a window, and nothing in it adapts.
    """
    return estimator.warm_up_steps == 0 and not estimator.adapts


class Monitor:
    """Applies health and bands: judges rows before the estimator receives them, and estimates
    afterwards. Keeps the state between calls.

    Parts of ``trust`` that are None are not judged.

    ``elsewhere``: the car or its tyres are others than those that were calibrated on;
    ``behind_front_end``: rows come through the filter from a faster bus.

    Without health every row is valid; without bands half widths are NaN.
    """

    def __init__(
        self,
        estimator: Estimator,
        trust: Trust | None,
        *,
        elsewhere: bool = False,
        behind_front_end: bool = False,
    ) -> None:
        bands, health = (trust.bands, trust.health) if trust is not None else (None, None)
        self.packed_health = (
            health.packed(behind_front_end=behind_front_end) if health is not None else None
        )
        self._state = health.start() if health is not None else np.empty(0)
        self.packed_bands = bands.packed(elsewhere=elsewhere) if bands is not None else None
        self.has_bands = bands is not None
        self.tyre_check = bands.tyre_check if bands is not None else None
        self.largest_vy = bands.largest.get("vy", 0.0) if bands is not None else 0.0
        self.channel_numbers = np.array([NUMBERS[name] for name in estimator.channels], np.int64)
        self._skippable = np.array([name in estimator.skippable for name in estimator.channels])
        self._required = ~self._skippable
        self.starts_anew = starts_anew(estimator)
        self.adapts = estimator.adapts
        self.persistent_steps = max(round(PERSISTENT_FAULT_SECONDS * estimator.settings.rate_hz), 1)
        self._fault = np.zeros(2)

    def before(self, received: FloatArray, cleaned: Cleaned) -> Health:
        """Health of rows (T, C) as received.

        In ``cleaned``, accused channels are taken out and restarts added, in place.

        Returns
        -------
        Health
            Health of these rows, which `after` completes.
        """
        if self.packed_health is None:
            return Health(*np.zeros((3, len(received))))
        health = health_rows(self.packed_health, received, cleaned.measured, self._state)
        isolate_rows(
            health.status,
            health.reason,
            self.channel_numbers,
            self._skippable,
            self.starts_anew,
            self.adapts,
            self.persistent_steps,
            *cleaned,
            self._fault,
        )
        return health

    def after(
        self,
        verdict: Health,
        watched: Watched,
        cleaned: Cleaned,
        vx: FloatArray,
        variance: FloatArray,
        tyre_error: FloatArray,
    ) -> FloatArray:
        """Complete the verdict of `before`, in place, and return half widths, (T, 2).

        They are of v [m/s] and β [rad]; NaN without calibrated bands.

        Parameters
        ----------
        verdict, watched, cleaned : Health, Watched, Cleaned
            Results of `before`, of the watch and of the guard for the same T rows.
        vx : array
            Speed of the estimate, (T,) [m/s].
        variance : array
            Variance of v's error that the method states, (T,) [m²/s²]; NaN where it states none.
        tyre_error : array
            Mean squared error by the tyre check, (T,) [m²/s²]; 0 without one.
        """
        verdict_rows(
            watched.vy,
            watched.marks,
            cleaned.flow,
            cleaned.measured,
            self._required,
            self.channel_numbers,
            verdict.status,
            verdict.reason,
        )
        bands = np.full((len(watched.vy), 2), np.nan)
        if self.packed_bands is not None:
            band_rows(cleaned.rows, watched.vy, variance, tyre_error, *self.packed_bands, bands)
            widen_rows(
                verdict.status,
                verdict.reason,
                watched.marks,
                watched.vy,
                vx,
                self.largest_vy,
                bands,
            )
        return bands


@entry(nogil=True)
def isolate_rows(  # type: ignore[no-untyped-def]
    status,
    reason,
    numbers,
    skippable,
    starts_anew,
    adapts,
    persistent_steps,
    rows,
    measured,
    flow,
    state,
):
    """Take accused channels out of rows, and have estimators start anew.

    ``rows, measured, flow`` are changed in place.

    Parameters
    ----------
    status, reason
        Status and code of the reason by health, (T,).
    numbers, skippable
        Number of each channel in a code, whether the estimator can do without it, (C,).
    starts_anew
        Whether the estimator starts anew after a persistent fault.
    adapts
        Whether it has adapting states, which go back to fitted values while a required channel
        is accused.
    persistent_steps
        Samples of accusation after which a fault is persistent.
    rows, measured, flow
        Result of the guard (`Cleaned`).
    state
        Number of samples since health was last valid at which any channel was accused, and at
        which a required one was, (2,).
    """
    for k in range(rows.shape[0]):
        kind = int(reason[k]) // 10000
        channel = int(reason[k]) % 10000 // 100
        at_fault = status[k] == INVALID
        for no_fault in NO_FAULT_KINDS:
            at_fault = at_fault and kind != no_fault
        if at_fault:
            state[0] += 1.0
            needs = True
            for c in range(rows.shape[1]):
                if skippable[c] and numbers[c] == channel:
                    rows[k, c] = math.nan
                    measured[k, c] = False
                    needs = False
            if needs:
                state[1] += 1.0
                if adapts and flow[k] == USE and state[1] % persistent_steps == 0.0:
                    flow[k] = RESTART
        elif status[k] == VALID and state[0] > 0.0:
            if starts_anew and flow[k] == USE and state[0] >= persistent_steps:
                flow[k] = RESTART
            state[0] = 0.0
            state[1] = 0.0


@entry(nogil=True)
def verdict_rows(  # type: ignore[no-untyped-def]
    vy, marks, flow, measured, required, numbers, status, reason
):
    """Add the findings of guard and watch to status and reason of health, in place.

    In this order: a required channel that is missing degrades; a spin degrades a valid row; an
    estimate beyond the bound, and none at all, are invalid. A reason that is there stays.

    Parameters
    ----------
    vy, marks : array
        Results of the watch (`Watched`), (T,).
    flow, measured : array
        Results of the guard (`Cleaned`), (T,) and (T, C).
    required : array
        Channels that the estimator cannot do without, (C,).
    numbers : array
        Their numbers in codes, (C,).
    status, reason : array
        Of health, (T,), changed.
    """
    for k in range(vy.shape[0]):
        status_of_row = int(status[k])
        why = int(reason[k])
        for c in range(measured.shape[1]):
            if required[c] and not measured[k, c] and why == 0:
                status_of_row = max(status_of_row, DEGRADED)
                why = kernel.MISSING * 10000 + numbers[c] * 100
        if marks[k] & SPINNING and status_of_row == VALID:
            status_of_row = DEGRADED
            why = kernel.SPIN * 10000
        if marks[k] & CLIPPED:
            status_of_row = INVALID
            why = BEYOND_SPEED * 10000 if why == 0 else why
        if marks[k] & EXTRAPOLATED or flow[k] == WAIT or not math.isfinite(vy[k]):
            status_of_row = INVALID
            why = NO_ESTIMATE * 10000 if why == 0 else why
        status[k] = status_of_row
        reason[k] = why


@entry(nogil=True)
def widen_rows(status, reason, marks, vy, vx, farthest, bands):  # type: ignore[no-untyped-def]
    """Widen the bands of estimates that are not valid, in place.

    Factors are `BAND_FACTORS`. Where v fades from the last estimate, the band reaches at least |v|
    plus the largest |v| of training. A band of β wider than `WIDEST` makes the row invalid.

    Parameters
    ----------
    status, reason, marks : array
        Status and code of the reason, which may be changed, and marks of the watch, (T,).
    vy, vx : array
        Estimate and its speed, (T,) [m/s].
    farthest : float
        The 99.9th percentile of |v| of estimates in training [m/s].
    bands : array
        Of v [m/s] and β [rad], (T, 2), changed.
    """
    for k in range(vy.shape[0]):
        wider = BAND_FACTORS[int(status[k])]
        bands[k, 0] *= wider
        bands[k, 1] = min(bands[k, 1] * wider, math.pi)
        if marks[k] & EXTRAPOLATED and math.isfinite(vy[k]):
            reach = abs(vy[k]) + farthest
            speed = max(abs(vx[k]), 1.0)
            bands[k, 0] = max(bands[k, 0], reach)
            if math.isfinite(speed):
                bands[k, 1] = max(bands[k, 1], min(math.atan(reach / speed), math.pi))
        if bands[k, 1] > WIDEST:
            status[k] = INVALID
            reason[k] = TOO_WIDE * 10000 if reason[k] == 0.0 else reason[k]
