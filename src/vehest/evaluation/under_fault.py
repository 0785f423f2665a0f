"""Errors while a sensor's fault lasts, and after it: is the estimate back at its usual size?

| subset | samples |
| `faulted` | from the start of the fault up to its end |
| `after` | from `SETTLED_SECONDS` after its end on |

Each has the errors of the same estimator on the same samples without the fault beside them, ``…_nominal``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

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
