"""Clips, bridges and restarts.

An estimate stays finite and within the bound by the car's speed; a diverged estimator starts anew.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.estimators.kernels.compiling import entry
from vehest.trust.guard import RESTART, WAIT, GuardLimits

LEAST_SPEED = 1.0  # m/s, below which the angle is not bounded
SPIN_RATE = 4.0  # m/s²: |a_y - u r|, the change of v, beyond which a car that keeps it up spins
SPIN_SECONDS = 0.3  # s beyond SPIN_RATE, less those below it, after which the car spins
# s, time constant with which the speed before a spin, or before it was lost, fades
REMEMBERED_SECONDS = 3.0
LOST_SECONDS = 0.3  # s beyond the bound, after which an estimator starts anew
FADE_SECONDS = 1.0  # time constant with which v goes to 0 where there is no estimate

EXTRAPOLATED = 1  # no estimate: v fades from the last one
CLIPPED = 2  # the estimate was beyond the bound and was set to it
SPINNING = 4  # the car spins
STARTED = 8  # the estimator started anew at this sample
"""Marks of a sample; `Watched.marks` is their sum."""


class Watched(NamedTuple):
    """Estimates after bounds and bridging."""

    vy: FloatArray  # v, (T,) [m/s]; NaN before the first estimate only
    marks: NDArray[np.int8]  # sum of marks at each row, (T,)
    # whether the estimator diverged at the last row, behind which the others are left out
    lost: bool


class Watch:
    """Clips and bridges estimates row after row, and finds that an estimator has diverged; keeps
    the state between calls.

    Parameters
    ----------
    limits : GuardLimits
        Only the top speed and the largest tan β are used.
    warm_up : int
        Samples after a start for which an estimator may have no estimate.
    rate_hz : float
        Rate of the rows [Hz].
    """

    def __init__(self, limits: GuardLimits, warm_up: int, rate_hz: float) -> None:
        self.limits = limits
        self.interval = 1.0 / rate_hz
        self._settings = np.array(
            [limits.top_speed, limits.largest_tan_sideslip, float(warm_up), self.interval]
        )
        self.state = np.zeros(6)
        self.state[0] = math.nan  # no estimate yet

    def __call__(self, vy: FloatArray, motion: FloatArray, flow: NDArray[np.int8]) -> Watched:
        """Process the estimator's v of the next rows, (T,) [m/s], NaN where it has none.

        ``motion`` holds accepted vx [m/s], yaw rate [rad/s] and ay [m/s²], (T, 3), NaN if unknown;
        ``flow`` is of the guard, (T,).
        """
        out = np.empty(len(vy))
        marks = np.zeros(len(vy), np.int8)
        done, lost = watch_rows(vy, motion, flow, self.state, self._settings, out, marks)
        return Watched(out[:done], marks[:done], bool(lost))

    def c_values(self) -> dict[str, float]:
        """Limits and constants of the watch, name -> value, for the C template of an export."""
        return {
            "top_speed": float(self.limits.top_speed),
            "largest_tan_sideslip": float(self.limits.largest_tan_sideslip),
            "interval": self.interval,
            "remembering": math.exp(-self.interval / REMEMBERED_SECONDS),
            "fading": math.exp(-self.interval / FADE_SECONDS),
            "REMEMBERED_SECONDS": REMEMBERED_SECONDS,
            "FADE_SECONDS": FADE_SECONDS,
            "SPIN_RATE": SPIN_RATE,
            "SPIN_SECONDS": SPIN_SECONDS,
            "LEAST_SPEED": LEAST_SPEED,
            "LOST_SECONDS": LOST_SECONDS,
        }


@entry(nogil=True)
def watch_rows(vy, motion, flow, state, settings, out, marks):  # type: ignore[no-untyped-def]
    """Bound, bridge and judge estimates, up to the row at which the estimator is lost.

    Returns the number of rows that were processed, and whether it is lost.

    The bound is tan β_max · max(u, 1 m/s), with u the accepted speed, or the remembered one while
    the car spins or no speed is known; the memory fades with `REMEMBERED_SECONDS`. The estimator is
    lost once its estimate has been beyond the bound for `LOST_SECONDS`, or is not finite after the
    warm-up. Without an estimate v fades with `FADE_SECONDS`.

    Parameters
    ----------
    vy, motion, flow
        As in `Watch`.
    state
        Last value passed on, remembered speed, seconds of spinning, seconds beyond the bound,
        samples since the estimator's start, whether it was lost at the last row.
    settings
        Top speed, largest tan β, warm-up in samples, sampling interval [s].
    out, marks
        Output, (T,).
    """
    top_speed, largest_tan, warm_up, step = settings
    for k in range(vy.shape[0]):
        begins = flow[k] == RESTART or (state[5] > 0.0 and flow[k] != WAIT)
        state[4] = 0.0 if begins else state[4] + 1.0
        state[5] = 1.0 if state[5] > 0.0 and flow[k] == WAIT else 0.0
        if begins:
            marks[k] += STARTED
            state[3] = 0.0
        u = motion[k, 0]
        r = motion[k, 1]
        ay = motion[k, 2]
        spins = abs(ay - u * r) > SPIN_RATE  # false where one is not known
        state[2] = min(state[2] + step, 2.0 * SPIN_SECONDS) if spins else max(state[2] - step, 0.0)
        remembered = (
            state[1] * math.exp(-step / REMEMBERED_SECONDS)
            if state[1] > 0.0
            else top_speed * math.isnan(u)
        )
        speed = remembered if math.isnan(u) else min(abs(u), top_speed)
        state[1] = max(speed, remembered)
        bound = largest_tan * max(state[1] if state[2] > 0.0 else speed, LEAST_SPEED)
        if state[2] > SPIN_SECONDS:
            marks[k] += SPINNING
        value = math.nan
        lost = False
        if flow[k] != WAIT:
            if math.isfinite(vy[k]):
                value = vy[k]
                if abs(value) > bound:
                    state[3] += step
                    marks[k] += CLIPPED
                    value = math.copysign(bound, value)
                    lost = state[3] > LOST_SECONDS
                else:
                    state[3] = 0.0
            else:
                lost = state[4] >= warm_up
        if math.isnan(value):
            value = state[0] * math.exp(-step / FADE_SECONDS)
            if abs(value) > bound:
                value = math.copysign(bound, value)
            marks[k] += EXTRAPOLATED
        out[k] = value
        state[0] = value
        if lost:
            state[5] = 1.0
            return k + 1, True
    return vy.shape[0], False
