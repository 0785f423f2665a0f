"""Channels that nothing but a name tells of."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from vehest.alignment.proposals import names as roles
from vehest.alignment.proposals.agreement import Known
from vehest.alignment.proposals.columns import Candidate
from vehest.alignment.proposals.proposal import Proposal
from vehest.data.channels import CHANNELS
from vehest.data.units import factor_to_si

MOTION = {  # role -> channel, units to try where the header is silent
    roles.SPEED: ("vx", ("m/s", "km/h")),
    roles.YAW_RATE: ("yaw_rate", ("rad/s", "deg/s")),
    roles.AY: ("ay", ("m/s²", "g")),
    roles.AX: ("ax", ("m/s²", "g")),
    roles.HANDWHEEL: ("handwheel", ("deg", "rad")),
    roles.STEER: ("steer", ("rad", "deg")),
    roles.LATERAL_VELOCITY: ("vy_ref", ("m/s", "km/h")),
    roles.SIDESLIP: ("sideslip_ref", ("rad", "deg")),
}
USUAL = {  # 99th percentile that is usual, SI
    "vx": (1.0, 90.0),
    "yaw_rate": (0.03, 3.0),
    "ay": (0.5, 25.0),
    "ax": (0.3, 25.0),
    "handwheel": (0.2, 14.0),
    "steer": (0.01, 0.7),
    "vy_ref": (0.02, 8.0),
    "sideslip_ref": (0.002, 0.8),
}
ONE_UNIT = frozenset({"motor_current"})
TOLD = ("motor_current", "brake_pressure_front", "brake_pressure_rear", "roll", "pitch", "roll_rate", "pitch_rate")


def named_channels(columns: Sequence[Candidate], free: Sequence[int], held: Collection[str], known: Known | None) -> list[Proposal]:
    """What names say of columns that are left, of channels that are not held yet.

    Channels of the motion are proposed and asked: had they agreed with the others, they would not be left. Those that nothing could be held
    against are taken where the header gives their unit, or where only one is known.

    Args:
        columns: of the log.
        free: indices of those that are left.
        held: channels that are proposed already.
        known: the motion, if three columns agree.
    """
    found: dict[str, Proposal] = {}
    wheels = {name for name in held if name.startswith("wheel_speed")}
    for role, (channel, units) in MOTION.items():
        strength = roles.STRONG if known is not None else roles.WEAK
        named = [k for k in free if columns[k].hints.get(role, 0.0) >= strength and columns[k].measures(CHANNELS[channel].unit)]
        if not named or channel in held or (channel == "steer" and {"handwheel"} & (set(held) | set(found))):
            continue
        if channel == "vx" and wheels and known is not None:
            continue
        best = max(named, key=lambda k: (columns[k].hints[role], not columns[k].is_filtered, not columns[k].is_reference))
        if columns[best].name not in {one.column for one in found.values()}:
            found[channel] = _by_name(columns[best], channel, units)
    for k in free:
        for channel in TOLD:
            column = columns[k]
            told = column.unit or channel in ONE_UNIT
            if channel in column.hints and channel not in {*held, *found} and column.measures(CHANNELS[channel].unit) and told:
                unit = column.unit or CHANNELS[channel].unit
                found[channel] = Proposal(column.name, channel, unit, 1, ("its name" + (" and unit" if column.unit else ""),))
    return list(found.values())


def _by_name(column: Candidate, channel: str, units: Sequence[str]) -> Proposal:
    """The unit of the header, or the first in which the column is of a usual size, or at least of a possible one."""
    si, (low, high) = CHANNELS[channel].unit, USUAL[channel]
    size = float(np.quantile(np.abs(column.values), 0.99))
    fitting = [unit for unit in units if low <= size * factor_to_si(unit, si) <= high]
    fitting = fitting or [unit for unit in units if size * factor_to_si(unit, si) <= CHANNELS[channel].high]
    unit = column.unit or (fitting[0] if fitting else units[0])
    told = "its name and unit" if column.unit else f"its name, and {size:.3g} for its 99th percentile"
    return Proposal(
        column.name, channel, unit, 1, (told,), "sign" if column.unit else "unit and sign: nothing to hold it against", others=tuple(units)
    )
