"""Errors by regime: straight ahead or turning, by lateral acceleration, in transients or steady;
each a ``subset`` of the metrics.

| regime | samples |
| `straight`, `turning` | yaw rate within ±0.05 rad/s, and the rest |
| `ay_0_2`, `ay_2_4`, `ay_4_6`, `ay_6_` | |lateral acceleration| between these values [m/s²] |
| `transient` | yaw rate changes faster than 0.1 rad/s² or lateral acceleration than 2 m/s³ |
| `steady` | the rest |

The two limits of transients are the same at 20 m/s, where a_y ≈ u ω changes by 2 m/s³ with 0.1
rad/s². They were set before any error was looked at. Rates of change are slopes of lines fitted by
least squares to 0.5 s around each sample (Savitzky & Golay 1964, first order): a regime says what
the car did, so it may look ahead.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from vehest.constants import FloatArray
from vehest.data.recording import Recording
from vehest.data.runs import filled
from vehest.data.splits import Span
from vehest.evaluation.metrics import Protocol, Scored, accuracy, scored_range

Mask = NDArray[np.bool_]  # (K,), one value for each scored sample

STRAIGHT_YAW_RATE = 0.05  # rad/s; a car that turns more slowly drives straight ahead
AY_EDGES = (0.0, 2.0, 4.0, 6.0, math.inf)  # m/s², limits of the bands of |ay|
# rates of change from which a sample is transient [rad/s², m/s³]
TRANSIENT = {"yaw_rate": 0.1, "ay": 2.0}
SLOPE_SECONDS = 0.5  # s around a sample; the slope of a line through them is its rate of change
MIN_REGIME_SECONDS = 2.0  # s of samples in a regime; with less it has no errors
METRICS = ("rmse_vy", "rmse_sideslip")  # metrics that are split by regime

AY_BANDS = {
    f"ay_{low:g}_{high:g}".removesuffix("inf"): (low, high)
    for low, high in itertools.pairwise(AY_EDGES)
}
"""Name of a band of lateral acceleration, ``ay_2_4`` or ``ay_6_`` without upper end -> its ends
[m/s²].
"""

# names of the regimes, in the order of tables
REGIMES = ("straight", "turning", *AY_BANDS, "transient", "steady")


def regimes_of(reference: Recording, span: Span, protocol: Protocol) -> dict[str, Mask]:
    """Masks of the scored samples of a range that lie in each regime.

    Returns
    -------
    dict[str, Mask]
        Regime -> mask, (K,); without yaw rate neither straight nor turning, without lateral
        acceleration no bands, without both none.
    """
    first, end = scored_range(reference, span, protocol)
    margin = math.ceil(SLOPE_SECONDS * reference.rate_hz)
    around = slice(max(first - margin, 0), end + margin)
    inside = slice(first - around.start, end - around.start)
    signals = {name: reference[name][around] for name in ("yaw_rate", "ay") if name in reference}
    size = {name: np.abs(samples[inside]) for name, samples in signals.items()}
    masks: dict[str, Mask] = {}
    if "yaw_rate" in size:
        masks["straight"] = size["yaw_rate"] < STRAIGHT_YAW_RATE
        masks["turning"] = size["yaw_rate"] >= STRAIGHT_YAW_RATE
    if "ay" in size:
        masks |= {
            name: (size["ay"] >= low) & (size["ay"] < high)
            for name, (low, high) in AY_BANDS.items()
        }
    if signals:
        fast = [
            np.abs(slope(samples, reference.rate_hz)[inside]) > TRANSIENT[name]
            for name, samples in signals.items()
        ]
        transient = np.logical_or.reduce(fast)
        masks |= {"transient": transient, "steady": ~transient}
    return masks


def slope(samples: FloatArray, rate_hz: float) -> FloatArray:
    """Rate of change of a signal, from a line through `SLOPE_SECONDS` around each sample, (T,)
    [unit/s]; 0 if it is too short.
    """
    samples = filled(samples)
    window = min(
        2 * max(round(0.5 * SLOPE_SECONDS * rate_hz), 1) + 1, len(samples) - (len(samples) + 1) % 2
    )
    if window < 3:
        return np.zeros_like(samples)
    return np.asarray(
        signal.savgol_filter(samples, window, 1, deriv=1, delta=1.0 / rate_hz), dtype=np.float64
    )


def is_represented(regime: str, masks: Sequence[Mapping[str, Mask]], rate_hz: float) -> bool:
    """Whether every range has the channels that a regime needs, and `MIN_REGIME_SECONDS` of samples
    at ``rate_hz`` [Hz] lie in it in all.
    """
    return all(regime in mask for mask in masks) and is_long_enough(
        [mask[regime] for mask in masks], rate_hz
    )


def is_long_enough(chosen: Sequence[Mask], rate_hz: float) -> bool:
    """Whether as many samples as `MIN_REGIME_SECONDS` at ``rate_hz`` [Hz] are chosen, over all
    ranges.
    """
    return sum(int(mask.sum()) for mask in chosen) >= max(MIN_REGIME_SECONDS * rate_hz, 1.0)


def errors_by_regime(
    parts: Sequence[Scored], masks: Sequence[Mapping[str, Mask]], rate_hz: float
) -> dict[str, dict[str, float]]:
    """Errors by regime over all parts together, with samples at ``rate_hz`` [Hz].

    Returns
    -------
    dict[str, dict[str, float]]
        Regime -> metric -> value, for `METRICS` and ``share``, the share of the samples that lie in
        it; only regimes that are represented (`is_represented`). RMSE(β) is NaN where sideslip is
        scored at too few samples of the regime.
    """
    total = sum(len(part.time) for part in parts)
    figures_of = {}
    for name in (name for name in REGIMES if is_represented(name, masks, rate_hz)):
        inside = [part.at(mask[name]) for part, mask in zip(parts, masks, strict=True)]
        figures = accuracy(inside)
        if not is_long_enough([part.is_sideslip_scored for part in inside], rate_hz):
            figures["rmse_sideslip"] = math.nan
        count = sum(len(part.time) for part in inside)
        figures_of[name] = {
            **{metric: figures[metric] for metric in METRICS},
            "share": count / total,
        }
    return figures_of
