"""Channels that only a name suggests."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from vehest.alignment.proposals.columns import UNITS, Candidate, largest, si_factor
from vehest.alignment.proposals.names import STRONG, WEAK, is_filtered, is_reference
from vehest.alignment.proposals.proposal import Proposal
from vehest.data.channels import CHANNELS

USUAL = {  # 99th percentile of the motion's channels, SI
    "vx": (1.0, 90.0),
    "yaw_rate": (0.03, 3.0),
    "ay": (0.5, 25.0),
    "ax": (0.3, 25.0),
    "handwheel": (0.2, 14.0),
    "steer": (0.01, 0.7),
    "vy_ref": (0.02, 8.0),
    "sideslip_ref": (0.002, 0.8),
}
ONE_UNIT = "motor_current"
BY_NAME_ALONE = (ONE_UNIT, "brake_pressure_front", "brake_pressure_rear", "roll", "pitch", "roll_rate", "pitch_rate")
"""Channels that no relation is known of."""


def named_channels(columns: Sequence[Candidate], held: Collection[str], *, moves: bool) -> list[Proposal]:
    """Channels that names suggest for the columns that are left.

    Channels of the motion are proposed and asked: had they agreed with the others, they would not be left. `BY_NAME_ALONE` are taken where
    the header gives their unit, or where only one is known.

    Args:
        columns: that are left.
        held: channels that are proposed already.
        moves: whether the motion is known.
    """
    found: dict[str, Proposal] = {}
    has_wheels = any(name.startswith("wheel_speed") for name in held)
    for channel in USUAL:
        least = STRONG if moves else WEAK
        named = [one for one in columns if one.hints.get(channel, 0.0) >= least and one.measures(channel)]
        needless = (channel == "steer" and "handwheel" in {*held, *found}) or (channel == "vx" and has_wheels and moves)
        if not named or channel in held or needless:
            continue
        best = max(named, key=lambda one: (one.hints[channel], not is_filtered(one.name), not is_reference(one.name)))
        if best.name not in {one.column for one in found.values()}:
            found[channel] = _by_name(best, channel)
    for column in columns:
        for channel in BY_NAME_ALONE:
            is_sure = (column.unit or channel == ONE_UNIT) and column.measures(channel)
            if is_sure and channel in column.hints and channel not in {*held, *found}:
                evidence = "its name and unit" if column.unit else "its name"
                found[channel] = Proposal(column.name, channel, column.unit or CHANNELS[channel].unit, 1, (evidence,))
    return list(found.values())


def _by_name(column: Candidate, channel: str) -> Proposal:
    """With the header's unit, or the first in which the column is of a usual size, or at least of a possible one."""
    if column.unit:
        return Proposal(column.name, channel, column.unit, 1, ("its name and unit",), "sign", others=UNITS[channel])
    size, (low, high) = largest(column.values), USUAL[channel]
    sizes = {unit: size * si_factor(unit, channel) for unit in UNITS[channel]}
    fitting = [unit for unit, own in sizes.items() if low <= own <= high]
    fitting += [unit for unit, own in sizes.items() if own <= CHANNELS[channel].high]
    evidence = f"its name, and {size:.3g} for its 99th percentile"
    asked = "unit and sign: nothing to hold it against"
    return Proposal(column.name, channel, (*fitting, *sizes)[0], 1, (evidence,), asked, others=UNITS[channel])
