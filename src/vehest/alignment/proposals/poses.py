"""Positions and yaw of motion capture or a survey, of which a reference can be made."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vehest.alignment.motion import Motion, rms
from vehest.alignment.proposals.columns import Candidate, correlation, slow_of
from vehest.data.units import factor_to_si

# part of a pose -> role of its name
PARTS = {"x": "position_x", "y": "position_y", "yaw": "heading"}
LENGTH_UNITS = ("m", "mm")  # units of positions that are tried
MIN_CORRELATION = 0.7  # smallest correlation of speed and yaw rate with the derivatives of a pose
MAX_SPEED_GAIN = 1.4  # largest ratio of the speed to that by the pose, or its inverse
MAX_RADIANS = 7.0  # largest magnitude of an angle that is taken to be in radians
MAX_YAW_RATE = 7.0  # rad/s, largest yaw rate; beyond it, an angle was wrapped


def named_pose(columns: Sequence[Candidate]) -> list[Candidate]:
    """Columns that are named as x, y and yaw; fewer than three where one is missing."""
    pose = []
    for role in PARTS.values():
        named = [column for column in columns if role in column.hints]
        pose += sorted(named, key=lambda column: (-column.hints[role], not column.is_reference))[:1]
    return pose


def find_pose(
    columns: Sequence[Candidate], motion: Motion | None
) -> tuple[tuple[str, str, str], ...]:
    """Part, column and unit of each part of a pose whose derivatives are the known speed and yaw
    rate; empty where there is none, or no motion.

    Parameters
    ----------
    columns : sequence of Candidate
        All columns.
    motion : Motion or None
        Speed and yaw rate that are known.

    Returns
    -------
    tuple
        ``x``, ``y`` and ``yaw`` in this order; units by the header, else those in which the
        derivatives agree with the motion.
    """
    pose = named_pose(columns)
    if (
        motion is None
        or len(pose) < len(PARTS)
        or pose[0].unit not in ("", *LENGTH_UNITS)
        or not pose[2].measures("sideslip_ref")
    ):
        return ()
    x, y, yaw = pose
    driven = np.abs(slow_of(motion.vx, motion.rate_hz))
    for unit in [x.unit] if x.unit else LENGTH_UNITS:
        scale = factor_to_si(unit, "m") * motion.rate_hz
        velocities = (np.gradient(coordinate.values) * scale for coordinate in (x, y))
        speed = np.hypot(*(slow_of(samples, motion.rate_hz) for samples in velocities))
        if (
            1.0 / MAX_SPEED_GAIN < rms(speed) / rms(driven) < MAX_SPEED_GAIN
            and correlation(speed, driven) > MIN_CORRELATION
        ):
            unit_of_yaw = yaw.unit or (
                "rad" if float(np.abs(yaw.values).max()) < MAX_RADIANS else "deg"
            )
            if abs(turning_of(yaw, unit_of_yaw, motion)) > MIN_CORRELATION:
                return (("x", x.name, unit), ("y", y.name, unit), ("yaw", yaw.name, unit_of_yaw))
    return ()


def turning_of(yaw: Candidate, unit: str, motion: Motion) -> float:
    """Correlation of a yaw angle's derivative with the yaw rate, where it was not wrapped.

    Parameters
    ----------
    yaw : Candidate
        Column of an angle, wrapped or not.
    unit : str
        Of the column.
    motion : Motion
        With the yaw rate.

    Returns
    -------
    float
        Negative where the angle counts the other way round than the yaw rate.
    """
    turned = np.gradient(np.unwrap(yaw.values * factor_to_si(unit, "rad"))) * motion.rate_hz
    is_sound = np.abs(turned) < MAX_YAW_RATE
    return correlation(turned[is_sound], motion["yaw_rate"][is_sound])
