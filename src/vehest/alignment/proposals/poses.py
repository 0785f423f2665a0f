"""Positions and yaw of motion capture or a survey, of which a reference can be made."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vehest.alignment.proposals import names as roles
from vehest.alignment.proposals.agreement import Known
from vehest.alignment.proposals.columns import Candidate, correlation, slow_of
from vehest.data.units import factor_to_si

PARTS = {"x": roles.POSITION_X, "y": roles.POSITION_Y, "yaw": roles.HEADING}
AGREEING = 0.7  # of speed and yaw rate with the derivatives
SCALE = 1.4  # within which the speeds must be equal
LARGEST_RADIANS = 7.0  # of an angle that is wrapped
STEPS = 7.0  # rad/s; beyond, an angle was wrapped


def find_pose(columns: Sequence[Candidate], known: Known | None) -> tuple[tuple[str, str, str], ...]:
    """Part, column and unit of a pose whose derivatives are the known speed and yaw rate; empty where there is none.

    Args:
        columns: of the log.
        known: the motion; without one nothing says that positions are the car's.
    """
    if known is None:
        return ()
    x, y, yaw = named_pose(columns)
    if x is None or y is None or yaw is None:
        return ()
    for unit in [x.unit] if x.unit else ["m", "mm"]:
        if not x.measures("m"):
            return ()
        scale = factor_to_si(unit, "m") * known.rate_hz
        smooth = [slow_of(np.gradient(one.values) * scale, known.rate_hz) for one in (x, y)]
        speed, driven = np.hypot(*smooth), np.abs(slow_of(known.vx, known.rate_hz))
        length = min(len(speed), len(driven))
        size = [float(np.sqrt(np.mean(np.square(one[:length])))) for one in (speed, driven)]
        if size[1] > 0.0 and 1.0 / SCALE < size[0] / size[1] < SCALE and correlation(speed[:length], driven[:length]) > AGREEING:
            of_yaw = yaw.unit or ("rad" if float(np.abs(yaw.values).max()) < LARGEST_RADIANS else "deg")
            turned = np.gradient(np.unwrap(yaw.values * factor_to_si(of_yaw, "rad"))) * known.rate_hz
            usual = np.abs(turned) < STEPS
            if abs(correlation(turned[usual], known.yaw_rate[usual])) > AGREEING:
                return (("x", x.name, unit), ("y", y.name, unit), ("yaw", yaw.name, of_yaw))
    return ()


def named_pose(columns: Sequence[Candidate]) -> tuple[Candidate | None, Candidate | None, Candidate | None]:
    """The columns that are named as positions and yaw."""
    return _named(columns, PARTS["x"]), _named(columns, PARTS["y"]), _named(columns, PARTS["yaw"])


def _named(columns: Sequence[Candidate], role: str) -> Candidate | None:
    """The column that is named most clearly for a role."""
    named = [one for one in columns if role in one.hints]
    return max(named, key=lambda one: (one.hints[role], one.is_reference), default=None)
