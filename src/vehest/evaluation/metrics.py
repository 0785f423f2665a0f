"""Error metrics of lateral velocity and sideslip angle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vehest.data.errors import DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import FloatArray, Recording
from vehest.data.splits import Span

NONLINEAR_AY = 4.0  # m/s², from which tyres are taken to be in their nonlinear range (Bertipaglia et al. 2024, Section V)

UNITS: dict[str, str] = {
    "rmse_vy": "m/s",
    "fvu": "1",
    "r2": "1",
    "rmse_sideslip": "deg",
    "mse_sideslip": "deg²",
    "mse_sideslip_nonlinear": "deg²",
    "max_error_sideslip": "deg",
    "max_error_sideslip_nonlinear": "deg",
    "p99_sideslip": "deg",
    "n_parameters": "1",
    "epochs": "1",
    "train_seconds": "s",
    "step_seconds": "s",
}


@dataclass(frozen=True)
class Protocol:
    """What is scored, and when.

    Args:
        rate_hz: rate at which every estimate is read, whatever rate it was made at [Hz]; held, never interpolated.
        warm_up_seconds: how long before a test range an estimator may start [s].
        skip_seconds: start of each range that is not scored [s].
    """

    rate_hz: float = 20.0
    warm_up_seconds: float = 10.0
    skip_seconds: float = 1.5


@dataclass(frozen=True, eq=False)
class Scored:
    """Estimate and reference at the scored times; every array has shape (K,).

    Args:
        time: [s].
        vy: estimated lateral velocity [m/s].
        vy_ref: reference lateral velocity [m/s].
        sideslip: estimated sideslip angle, atan2(vy, vx) with the measured vx [rad].
        sideslip_ref: reference sideslip angle, atan2(vy_ref, vx) [rad].
        ay: measured lateral acceleration [m/s²].
    """

    time: FloatArray
    vy: FloatArray
    vy_ref: FloatArray
    sideslip: FloatArray
    sideslip_ref: FloatArray
    ay: FloatArray


def score(estimate: Estimate, reference: Recording, span: Span, protocol: Protocol) -> Scored:
    """Bring an estimate and its reference onto the evaluation grid.

    Args:
        estimate: at any rate; a value made for time t is scored at t.
        reference: the recording at ``protocol.rate_hz``, with vx, ay and vy_ref.
        span: the range that is scored, after ``protocol.skip_seconds``.
        protocol: see `Protocol`.

    Raises:
        DataError: the range is too short, or the estimate does not cover it.
    """
    start = max(span.start, reference.start_time) + protocol.skip_seconds
    scored = reference.cut(start, span.stop)
    for name in ("vx", "vy_ref", "ay"):
        if np.isnan(scored[name]).any():
            raise DataError(f"recording '{reference.id}': channel '{name}' has gaps within {span.describe()}; test on a range without")
    vy = estimate.held_at(scored.time, "vy")
    missing = int(np.isnan(vy).sum())
    if missing:
        raise DataError(
            f"estimator '{estimate.estimator}' has no estimate for {missing} of {len(vy)} scored samples of {span.describe()}; "
            f"give it a longer warm-up or check that it does not diverge"
        )
    return Scored(
        time=scored.time,
        vy=vy,
        vy_ref=scored["vy_ref"],
        sideslip=np.arctan2(vy, scored["vx"]),
        sideslip_ref=np.arctan2(scored["vy_ref"], scored["vx"]),
        ay=scored["ay"],
    )


def accuracy(parts: Sequence[Scored]) -> dict[str, float]:
    """Metrics over all parts together.

    Definitions: RMSE = sqrt(E[e²]); FVU = var(v - v̂)/var(v) and R² = 1 - FVU (Da Lio et al. 2023, Section VIII);
    ``…_nonlinear`` counts samples with |a_y| ≥ 4 m/s² only (Bertipaglia et al. 2024) and is NaN where there are none.

    Returns:
        Metric name -> value; sideslip in deg or deg².
    """
    vy = np.concatenate([part.vy for part in parts])
    vy_ref = np.concatenate([part.vy_ref for part in parts])
    error = np.degrees(np.concatenate([part.sideslip - part.sideslip_ref for part in parts]))
    nonlinear = np.abs(np.concatenate([part.ay for part in parts])) >= NONLINEAR_AY
    variance = float(np.var(vy_ref))
    fvu = float(np.var(vy_ref - vy)) / variance if variance > 0 else float("nan")
    return {
        "rmse_vy": float(np.sqrt(np.mean(np.square(vy - vy_ref)))),
        "fvu": fvu,
        "r2": 1.0 - fvu,
        "rmse_sideslip": float(np.sqrt(np.mean(np.square(error)))),
        "mse_sideslip": float(np.mean(np.square(error))),
        "mse_sideslip_nonlinear": float(np.mean(np.square(error[nonlinear]))) if nonlinear.any() else float("nan"),
        "max_error_sideslip": float(np.abs(error).max()),
        "max_error_sideslip_nonlinear": float(np.abs(error[nonlinear]).max()) if nonlinear.any() else float("nan"),
        "p99_sideslip": float(np.quantile(np.abs(error), 0.99)),
    }
