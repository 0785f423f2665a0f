"""Errors while a sensor's fault lasts, and after it: is the estimate back at its usual size?

| subset | samples |
| `faulted` | from the start of the fault up to its end |
| `after` | from `SETTLED_SECONDS` after its end on |

Each has the errors of the same estimator on the same samples without the fault beside them,
``…_nominal``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vehest.alignment.motion import rms
from vehest.constants import FloatArray
from vehest.evaluation.metrics import Scored, wrap_to_half_turn

SETTLED_SECONDS = 3.0  # s after the end of a fault, from which on samples count as `after`
FAULTED = "faulted"  # name of the subset of samples while a fault lasts
AFTER = "after"  # name of the subset of samples after a fault

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
    "max_error_sideslip_undetected": "deg",
}
"""Metrics under a fault, with units."""

_CLOCK = 1e-6  # s, tolerance within which two times are equal

Window = tuple[float, float]  # start and end of a fault on a recording's clock [s]
# (K,) as the errors: half width of the 90 % band of β [rad], NaN for none; health 0, 1 or 2
Flags = tuple[FloatArray, FloatArray]


def errors_under_fault(
    parts: Sequence[Scored], nominal: Sequence[Scored], windows: Sequence[Window]
) -> dict[str, dict[str, float]]:
    """Errors while faults last and after them, with the errors of the same samples without the
    fault (``…_nominal``): subset -> metric -> value, over all parts together.

    A subset without samples is left out.

    Parameters
    ----------
    parts : Sequence[Scored]
        Estimate under the fault and reference, of each range or sequence; an infinite estimate is a
        sideslip of 90° and an infinite error of the lateral velocity.
    nominal : Sequence[Scored]
        The same ranges without the fault.
    windows : Sequence[Window]
        Start and end of the fault in each part [s].
    """
    figures = {}
    pairs = list(zip(parts, windows, strict=True))
    during = [
        (part.time >= window[0] - _CLOCK) & (part.time < window[1] - _CLOCK)
        for part, window in pairs
    ]
    after = [part.time >= window[1] + SETTLED_SECONDS - _CLOCK for part, window in pairs]
    for subset, masks in ((FAULTED, during), (AFTER, after)):
        if any(mask.any() for mask in masks):
            usual = {f"{name}_nominal": value for name, value in _errors(nominal, masks).items()}
            figures[subset] = _errors(parts, masks) | usual
    return figures


def flags_under_fault(
    parts: Sequence[Scored], flagged: Sequence[Flags], windows: Sequence[Window], rate_hz: float
) -> dict[str, float]:
    """Metrics of bands and health flags while faults last, name -> value, over all parts together.

    Errors count where sideslip is scored, flags at all samples.

    ``coverage_90`` share of samples whose error of β lies in the band, ``coverage_90_unflagged``
    the same of those marked valid; of ranges that were valid before: ``missed_detections`` share in
    which nothing is flagged before the fault's end, ``detection_delay`` mean time to the first flag
    of the others [s], ``max_error_sideslip_undetected`` largest error before it [deg]. Only figures
    that there is something for.

    Parameters
    ----------
    parts : sequence of Scored
        Ranges or sequences that were scored.
    flagged : sequence of Flags
        Half width of the band [rad], NaN without one, and health (0: valid) of each part, (K,).
    windows : sequence of Window
        Start and end of the fault in each part [s].
    rate_hz : float
        Rate of the samples [Hz].
    """
    inside = []
    valid = []
    delays = []
    undetected = []
    for part, (band, health), window in zip(parts, flagged, windows, strict=True):
        during = (part.time >= window[0] - _CLOCK) & (part.time < window[1] - _CLOCK)
        error = wrap_to_half_turn(part.sideslip - part.sideslip_ref)
        error[~part.is_sideslip_scored] = np.nan
        has_band = during & np.isfinite(band) & part.is_sideslip_scored
        inside.append((np.abs(error) <= band)[has_band])
        valid.append(health[has_band] == 0)
        at = np.flatnonzero(during)
        if len(at) and (at[0] == 0 or health[at[0] - 1] == 0):
            flags = health > 0
            onset = int(at[0])
            end = int(at[-1]) + 1
            delays.append(detection_delay(flags, onset, end, rate_hz))
            undetected.append(error_while_undetected(np.degrees(error), flags, onset, end))
    is_inside = np.concatenate(inside)
    is_valid = np.concatenate(valid)
    finite_delays = [delay for delay in delays if math.isfinite(delay)]
    figures = {"coverage_90": float(is_inside.mean())} if len(is_inside) else {}
    if is_valid.any():
        figures["coverage_90_unflagged"] = float(is_inside[is_valid].mean())
    if finite_delays:
        figures["detection_delay"] = float(np.mean(finite_delays))
    if delays:
        figures["missed_detections"] = (len(delays) - len(finite_delays)) / len(delays)
        figures["max_error_sideslip_undetected"] = max(undetected)
    return figures


def _errors(parts: Sequence[Scored], masks: Sequence[NDArray[np.bool_]]) -> dict[str, float]:
    """RMSE and largest error of the sideslip [deg] and RMSE of the lateral velocity [m/s], metric
    -> value, over the samples that masks select of all parts.

    Sideslip is NaN where none of these samples counts for it; its error is turned into ±180°.
    """
    inside = Scored.joined([part.at(mask) for part, mask in zip(parts, masks, strict=True)])
    sideslip = np.degrees(inside.sideslip - inside.sideslip_ref)
    is_scored = inside.is_sideslip_scored
    sideslip = sideslip[is_scored] if is_scored.any() else np.full(1, np.nan)
    turned = np.abs(np.remainder(sideslip + 180.0, 360.0) - 180.0)
    return {
        "rmse_sideslip": rms(turned),
        "rmse_vy": rms(inside.vy - inside.vy_ref),
        "max_error_sideslip": float(turned.max()),
    }


def detection_delay(flagged: NDArray[np.bool_], onset: int, end: int, rate_hz: float) -> float:
    """Time from the first faulty sample to the end of the sample that is flagged first [s];
    infinite if none is before ``end``.

    ``flagged`` is (T,) at ``rate_hz`` [Hz]; ``onset`` is the index of the first faulty sample.
    """
    flagged_rows = np.flatnonzero(flagged[onset:end])
    return (int(flagged_rows[0]) + 1) / rate_hz if len(flagged_rows) else math.inf


def error_while_undetected(
    error: FloatArray, flagged: NDArray[np.bool_], onset: int, end: int
) -> float:
    """Largest size of the error from a fault's onset to its first flag, or to ``end``; 0 if it is
    flagged at once.

    ``error``, in which NaN does not count, and ``flagged`` are (T,); ``onset`` is the index of the
    first faulty sample.
    """
    flagged_rows = np.flatnonzero(flagged[onset:end])
    undetected = error[onset : onset + int(flagged_rows[0]) if len(flagged_rows) else end]
    return float(np.nanmax(np.abs(undetected), initial=0.0))
