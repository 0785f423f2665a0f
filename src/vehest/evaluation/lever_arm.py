"""Errors with the best lever arm, where the point of the car at which the reference was measured is
unknown.

Lateral velocity x ahead of a point is v + x·r, and satisfies the kinematics as well for any x:
inertial sensors cannot tell an estimate at one point from an error at another. Where the
reference's point is unknown, the plain error therefore ranks estimators by the point that each
happened to learn, too.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from vehest.data.recording import DERIVED, Recording
from vehest.data.splits import Span
from vehest.evaluation.metrics import Protocol, Scored, accuracy, scored_range

CONDITION = "best_lever_arm"  # value of the column ``condition`` in rows of such errors
MAX_LEVER_ARM = 0.5  # m, ahead of the reference's point or behind it
METRICS = ("rmse_vy", "rmse_sideslip", "fvu")  # metrics that are given with the best lever arm


def lever_arm_figures(
    parts: Sequence[Scored], pieces: Iterable[tuple[Recording, Span]], protocol: Protocol
) -> dict[str, float]:
    """Errors of a test set whose references were all measured at unknown points, after the lever
    arm x that minimises them is removed.

    x = Σ(v̂ - v)r / Σr² minimises the mean of (v̂ - v - x·r)², and is limited to ±`MAX_LEVER_ARM`.

    Returns
    -------
    dict[str, float]
        Metric -> value for `METRICS`, and ``lever_arm``, the distance x by which the estimates'
        point lies ahead of the reference's [m]; empty where a reference's point is known or
        undeclared, or a recording has no yaw rate.
    """
    yaw_rates = []
    speeds = []
    for reference, span in pieces:
        turning = next((name for name in ("yaw_rate_ref", "yaw_rate") if name in reference), None)
        derived = reference.provenance.get(DERIVED)  # from the data set's declaration
        if (
            turning is None
            or not isinstance(derived, dict)
            or derived.get("reference_point") != "unknown"
        ):
            return {}
        first, end = scored_range(reference, span, protocol)
        yaw_rates.append(reference[turning][first:end])
        speeds.append(reference["vx"][first:end])
        if not np.isfinite(yaw_rates[-1]).all():
            return {}
    if not yaw_rates:
        return {}
    whole = Scored.joined(parts)
    error = whole.vy - whole.vy_ref
    turns = np.concatenate(yaw_rates)
    power = float(turns @ turns)
    x = float(np.clip(error @ turns / power, -MAX_LEVER_ARM, MAX_LEVER_ARM)) if power > 0.0 else 0.0
    moved = []
    for part, yaw_rate, speed in zip(parts, yaw_rates, speeds, strict=True):
        vy = part.vy - x * yaw_rate
        moved.append(replace(part, vy=vy, sideslip=np.arctan2(vy, speed)))
    figures = accuracy(moved)
    return {**{name: figures[name] for name in METRICS}, "lever_arm": x}
