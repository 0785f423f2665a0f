"""Consequences of health: channels that an estimator gets, restarts, status and reason of its estimate, width of its band.

- A channel that health accuses of a fault counts as not measured where the method can do without it, so that nothing adapts to it.
- An estimator that remembers more than a window starts anew once a fault is over.
- One with states that adapt, such as tyres and friction, does not, since it would forget them. But if the accused channel is one that it
  needs, these states go back to what they were fitted to, every second until nothing is suspected any more.
- The band is twice as wide while an estimate is degraded and four times while it is invalid, and where there is no estimate it reaches at
  least as far as sideslip did in training. These factors were set before their effect was looked at.
"""

from __future__ import annotations

import math

import numpy as np

from vehest.estimators.base import Estimator
from vehest.estimators.kernels.compiling import entry
from vehest.trust import health_kernel as kernel
from vehest.trust.guard import RESTART, USE, WAIT
from vehest.trust.health import BEYOND_SPEED, DEGRADED, INVALID, NO_ESTIMATE, VALID
from vehest.trust.watch import CLIPPED, EXTRAPOLATED, SPINNING

BAND_FACTORS = (1.0, 2.0, 4.0)
"""Factor of the band of a valid, a degraded, an invalid estimate."""

ROLLED_BACK_SECONDS = 1.0

NO_FAULTS = np.array([kernel.FREE, kernel.MISSING, kernel.OUTSIDE, kernel.SPIN])
"""Kinds of reasons that accuse no sensor."""


def starts_anew(estimator: Estimator) -> bool:
    """Whether an estimator is better off without its memory after a fault: it has more than a window, and nothing in it adapts."""
    return estimator.warm_up_steps == 0 and not getattr(estimator, "adapts", False)


@entry(nogil=True)
def isolate_rows(status, reason, numbers, skippable, starts_anew, rollback, rows, measured, flow, state):  # type: ignore[no-untyped-def]
    """Take accused channels out of rows, and have estimators start anew after faults; ``rows, measured, flow`` are changed in place.

    Args:
        status, reason: of health, (T,).
        numbers, skippable: of the channels: number in a code, whether the estimator can do without it, (C,).
        starts_anew: whether the estimator does after a fault.
        rollback: samples after which adapting states go back to fitted values, while a needed channel is accused; 0 if nothing adapts.
        state: whether there was a fault since health was last valid, and for how many samples one in a needed channel, (2,).
    """
    for k in range(rows.shape[0]):
        kind, channel = int(reason[k]) // 10000, int(reason[k]) % 10000 // 100
        at_fault = status[k] == INVALID
        for other in NO_FAULTS:
            at_fault = at_fault and kind != other
        if at_fault:
            state[0], needs = 1.0, True
            for c in range(rows.shape[1]):
                if skippable[c] and numbers[c] == channel:
                    rows[k, c], measured[k, c], needs = math.nan, False, False
            if needs and state[1] == 0.0:
                state[1] = 1.0
        elif status[k] == VALID and state[0] > 0.0:
            state[0], state[1] = 0.0, 0.0
            if starts_anew and flow[k] == USE:
                flow[k] = RESTART
        if state[1] > 0.0:
            state[1] += 1.0
            if rollback > 0 and flow[k] == USE and state[1] % rollback == 0.0:
                flow[k] = RESTART


@entry(nogil=True)
def verdict_rows(vy, marks, flow, measured, needed, numbers, status, reason):  # type: ignore[no-untyped-def]
    """Add the findings of guard (``flow``, ``measured``) and watch (``vy``, ``marks``) to ``status, reason`` of health, in place.

    ``needed`` are channels that the estimator cannot do without, ``numbers`` those in codes, (C,).
    """
    for k in range(vy.shape[0]):
        found, why = int(status[k]), int(reason[k])
        for c in range(measured.shape[1]):
            if needed[c] and not measured[k, c] and why == 0:
                found, why = max(found, DEGRADED), kernel.MISSING * 10000 + numbers[c] * 100
        if marks[k] & SPINNING and found == VALID:
            found, why = DEGRADED, kernel.SPIN * 10000
        if marks[k] & CLIPPED:
            found, why = INVALID, BEYOND_SPEED * 10000 if why == 0 else why
        if marks[k] & EXTRAPOLATED or flow[k] == WAIT or not math.isfinite(vy[k]):
            found, why = INVALID, NO_ESTIMATE * 10000 if why == 0 else why
        status[k], reason[k] = found, why


@entry(nogil=True)
def widen_rows(status, marks, vy, vx, farthest, bands):  # type: ignore[no-untyped-def]
    """Widen ``bands`` of v [m/s] and β [rad], (T, 2), of estimates that are not valid, in place.

    ``farthest`` is the 99.9th percentile of |v| of estimates in training, ``vx`` the speed of the estimate [m/s].
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
