"""Errors while a sensor's fault lasts, and after it: is the estimate back at its usual size?

| subset | samples |
| `faulted` | from the start of the fault up to its end |
| `after` | from `SETTLED_SECONDS` after its end on |

Each has the errors of the same estimator on the same samples without the fault beside them, ``…_nominal``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.evaluation.metrics import Scored

SETTLED_SECONDS = 3.0
FAULTED, AFTER = "faulted", "after"

UNITS = {
    "rmse_sideslip": "deg",
    "rmse_vy": "m/s",
    "max_error_sideslip": "deg",
    "rmse_sideslip_nominal": "deg",
    "rmse_vy_nominal": "m/s",
    "max_error_sideslip_nominal": "deg",
    "coverage_90": "1",
    "coverage_90_unflagged": "1",
    "detection_delay": "s",
    "missed_detections": "1",
}
"""Metrics under a fault, with units."""

_CLOCK = 1e-6  # s, within which times are the same

Window = tuple[float, float]
"""Start and end of a fault on a recording's clock [s]."""


def errors_under_fault(parts: Sequence[Scored], nominal: Sequence[Scored], windows: Sequence[Window]) -> dict[str, dict[str, float]]:
    """Subset -> metric -> value, over all parts together; a subset without samples is left out.

    Args:
        parts: estimate under the fault and reference, of each range or sequence; an infinite estimate is a sideslip of 90° and an
            infinite error of the lateral velocity.
        nominal: the same without the fault.
        windows: of the fault in each.
    """
    found = {}
    for subset, inside in ((FAULTED, _during), (AFTER, _after)):
        masks = [inside(part.time, window) for part, window in zip(parts, windows, strict=True)]
        if any(mask.any() for mask in masks):
            usual = {f"{name}_nominal": value for name, value in _errors(nominal, masks).items()}
            found[subset] = _errors(parts, masks) | usual
    return found


@dataclass(frozen=True, eq=False)
class Flagged:
    """What is said of an estimate besides its value, on the grid that errors are read on.

    Args:
        band: half width of the 90 % band of β, (K,) [rad]; NaN where there is none.
        health: 0 valid, 1 degraded, 2 invalid, (K,).
    """

    band: FloatArray
    health: FloatArray


def flags_under_fault(parts: Sequence[Scored], flagged: Sequence[Flagged], windows: Sequence[Window]) -> dict[str, float]:
    """Whether bands hold and faults are flagged while they last, over all parts together.

    ``coverage_90`` share of samples whose error of β lies in the band, ``coverage_90_unflagged`` the same of those said to be valid;
    ``detection_delay`` mean time from a fault's start to the first sample that is not valid [s], of ranges that were valid before, as the
    grid tells; ``missed_detections`` share of these in which none is before the fault's end. Only figures that there is something for.
    """
    inside, valid, delays = [], [], []
    for part, own, window in zip(parts, flagged, windows, strict=True):
        during = _during(part.time, window)
        turned = np.abs(np.remainder(part.sideslip - part.sideslip_ref + np.pi, 2.0 * np.pi) - np.pi)
        known = during & np.isfinite(own.band)
        inside.append((turned <= own.band)[known])
        valid.append(own.health[known] == 0)
        before = np.flatnonzero(part.time < window[0] - _CLOCK)
        if during.any() and (not len(before) or own.health[before[-1]] == 0):
            at = np.flatnonzero(during & (own.health > 0))
            delays.append(part.time[at[0]] - window[0] if len(at) else np.inf)
    held, calm, late = np.concatenate(inside), np.concatenate(valid), np.array(delays)
    figures = {}
    if len(held):
        figures["coverage_90"] = float(held.mean())
    if calm.any():
        figures["coverage_90_unflagged"] = float(held[calm].mean())
    if np.isfinite(late).any():
        figures["detection_delay"] = float(late[np.isfinite(late)].mean())
    if len(late):
        figures["missed_detections"] = float(np.mean(~np.isfinite(late)))
    return figures


def _during(time: FloatArray, window: Window) -> NDArray[np.bool_]:
    return (time >= window[0] - _CLOCK) & (time < window[1] - _CLOCK)


def _after(time: FloatArray, window: Window) -> NDArray[np.bool_]:
    return time >= window[1] + SETTLED_SECONDS - _CLOCK


def _errors(parts: Sequence[Scored], masks: Sequence[NDArray[np.bool_]]) -> dict[str, float]:
    def over_all(error_of: Callable[[Scored], FloatArray]) -> FloatArray:
        return np.concatenate([error_of(part)[mask] for part, mask in zip(parts, masks, strict=True)])

    vy = over_all(lambda part: part.vy - part.vy_ref)
    sideslip = np.degrees(over_all(lambda part: part.sideslip - part.sideslip_ref))
    turned = np.abs(np.remainder(sideslip + 180.0, 360.0) - 180.0)
    return {
        "rmse_sideslip": float(np.sqrt(np.mean(np.square(turned)))),
        "rmse_vy": float(np.sqrt(np.mean(np.square(vy)))),
        "max_error_sideslip": float(turned.max()),
    }
