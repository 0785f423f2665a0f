"""Positions and yaw of motion capture or a survey, of which a reference can be made."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vehest.alignment.motion import Motion, rms
from vehest.alignment.proposals.columns import Candidate, correlation, slow_of
from vehest.data.units import factor_to_si

PARTS = {"x": "position_x", "y": "position_y", "yaw": "heading"}
LENGTHS = ("m", "mm")
AGREEING = 0.7  # of speed and yaw rate with the derivatives
SCALE = 1.4  # within which the speeds must be equal
LARGEST_RADIANS = 7.0  # of an angle that is wrapped
STEPS = 7.0  # rad/s; beyond, an angle was wrapped


def named_pose(columns: Sequence[Candidate]) -> list[Candidate]:
    """Columns that are named as x, y and yaw; fewer than three where one is missing."""
    found = []
    for role in PARTS.values():
        named = [one for one in columns if role in one.hints]
        found += sorted(named, key=lambda one: (-one.hints[role], not one.is_reference))[:1]
    return found


def find_pose(
    columns: Sequence[Candidate], known: Motion | None
) -> tuple[tuple[str, str, str], ...]:
    """Part, column and unit of a pose whose derivatives are the known speed and yaw rate; empty where there is none, or no motion."""
    pose = named_pose(columns)
    if (
        known is None
        or len(pose) < len(PARTS)
        or pose[0].unit not in ("", *LENGTHS)
        or not pose[2].measures("sideslip_ref")
    ):
        return ()
    x, y, yaw = pose
    driven = np.abs(slow_of(known.vx, known.rate_hz))
    for unit in [x.unit] if x.unit else LENGTHS:
        scale = factor_to_si(unit, "m") * known.rate_hz
        speed = np.hypot(
            *(slow_of(np.gradient(one.values) * scale, known.rate_hz) for one in (x, y))
        )
        if 1.0 / SCALE < rms(speed) / rms(driven) < SCALE and correlation(speed, driven) > AGREEING:
            unit_of_yaw = yaw.unit or (
                "rad" if float(np.abs(yaw.values).max()) < LARGEST_RADIANS else "deg"
            )
            if abs(turning_of(yaw, unit_of_yaw, known)) > AGREEING:
                return (("x", x.name, unit), ("y", y.name, unit), ("yaw", yaw.name, unit_of_yaw))
    return ()


def turning_of(yaw: Candidate, unit: str, known: Motion) -> float:
    """Correlation of a yaw angle's derivative with the yaw rate, where the angle was not wrapped."""
    turned = np.gradient(np.unwrap(yaw.values * factor_to_si(unit, "rad"))) * known.rate_hz
    usual = np.abs(turned) < STEPS
    return correlation(turned[usual], known["yaw_rate"][usual])
