"""Columns that repeat speed or yaw rate: the car's own and the reference's."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vehest.alignment.motion import rms
from vehest.alignment.proposals.columns import Candidate, correlation, si_factor
from vehest.alignment.proposals.fitting import Search
from vehest.alignment.proposals.names import STRONG, is_filtered, is_pair, is_reference
from vehest.alignment.proposals.proposal import Proposal

SAME = 0.97  # correlation of one quantity measured twice
SAME_NAMED = {"vx": 0.7, "yaw_rate": 0.9}  # of columns that are named alike; wheels slip
SAME_AY = 0.99
SAME_SCALE = 0.35  # logarithm
LIKELY = 2  # units to try; a speed that seems to be in others may be in counts


class Repeat(NamedTuple):
    """A column that measures the same as another one."""

    column: Candidate
    unit: str
    sign: int


def repeated_channels(search: Search) -> Iterator[Proposal]:
    """Proposals for speeds and yaw rates that are measured twice, those of the motion among them."""
    for channel in SAME_NAMED:
        first = Repeat(search.turning.columns[channel], search.turning.units[channel], search.turning.signs[channel])
        scaled = [one for one in search.free if channel == "vx" and _is_scaled(one, first.column)]
        same = [Repeat(one, unit, _sign(one, first)) for one in search.free if (unit := _unit(one, first, channel))]
        for one in same:
            search.free.remove(one.column)
        family = [*(() if first.column.is_made else (first,)), *same]
        if same:
            yield from _told_apart(family, channel)
        elif scaled and family:
            search.free.remove(scaled[0])
            yield from _scaled_speed(scaled[0], first)
    ay = search.turning.columns.get("ay")
    for column in list(search.free):
        if ay is not None and abs(correlation(column.slow, ay.slow)) > SAME_AY and column.hint("ay") >= 0.0:
            search.free.remove(column)


def with_reference_speed(found: dict[str, Proposal]) -> dict[str, Proposal]:
    """With a speed that is named as a reference, or like the lateral velocity, as the reference's, where wheels can give the car's own."""
    own, lateral = found.get("vx"), found.get("vy_ref")
    if own is None or lateral is None or "vx_ref" in found:
        return found
    evidence, asked = "named as a reference", own.asked
    if not is_reference(own.column):
        evidence = f"named like '{lateral.column}', and wheels are there for vx"
        asked = asked or "whether it is the car's own speed or the reference's"
        if not is_pair(own.column, lateral.column):
            return found
    reference = replace(own, channel="vx_ref", others=("vx",), asked=asked).with_evidence(evidence)
    return {name: one for name, one in found.items() if name != "vx"} | {"vx_ref": reference}


def _sign(column: Candidate, first: Repeat) -> int:
    return -first.sign if correlation(column.slow, first.column.slow) < 0.0 else first.sign


def _unit(column: Candidate, first: Repeat, channel: str) -> str:
    """The unit in which a column is another one measured again; empty where it is not."""
    least = SAME_NAMED[channel] if channel in column.hints else SAME
    is_same = abs(correlation(column.slow, first.column.slow)) >= least and column.hint(channel) >= 0.0
    if not is_same or column.is_wheel or not column.measures(channel):
        return ""
    size = rms(first.column.slow) * si_factor(first.unit, channel)
    ranked = [(abs(math.log(rms(column.slow) * si_factor(unit, channel) / size)), unit) for unit in column.units(channel)[:LIKELY]]
    return min(ranked)[1] if min(ranked)[0] < SAME_SCALE else ""


def _is_scaled(column: Candidate, first: Candidate) -> bool:
    """Whether a column that is named as a speed, without a unit, is one but for its scale, as a motor's speed is."""
    is_named = column.hints.get("vx") == STRONG and not column.unit
    return is_named and abs(correlation(column.slow, first.slow)) > SAME_NAMED["vx"]


def _scaled_speed(column: Candidate, first: Repeat) -> Iterator[Proposal]:
    """The car's own speed in counts, and the reference's by which it is scaled."""
    name = first.column.name
    speed = first.column.slow * first.sign * si_factor(first.unit, "vx")
    factor = float(column.slow @ speed) / float(column.slow @ column.slow)
    evidence = f"follows '{name}' ({correlation(column.slow, first.column.slow):.2f}), no unit of speed explains its scale"
    asked = f"the car's own speed, {abs(factor):.5g} m/s for a unit of it, or another quantity; '{name}' is then the reference's"
    sign = -1 if factor < 0.0 else 1
    yield Proposal(column.name, "vx", "m/s", sign, (evidence,), asked, factor=float(f"{abs(factor):.5g}"))
    asked = f"the reference's speed, or the car's own ('{column.name}' in counts)"
    yield Proposal(name, "vx_ref", first.unit, first.sign, (f"'{column.name}' follows it",), asked)


def _told_apart(family: Sequence[Repeat], channel: str) -> list[Proposal]:
    """The car's own and the reference's of columns that measure the same; more than these two are left out."""
    plain = [one for one in family if not is_filtered(one.column.name)] or list(family)
    own = [one for one in plain if not is_reference(one.column.name)]
    references = [one for one in plain if is_reference(one.column.name)]
    text = f"agrees {min(abs(correlation(one.column.slow, family[0].column.slow)) for one in plain):.2f} with the other {channel}"

    def proposal(one: Repeat, name: str, *more: str, asked: str = "", others: tuple[str, ...] = ()) -> Proposal:
        return Proposal(one.column.name, name, one.unit, one.sign, (text, *more), asked, others=others)

    reference = f"{channel}_ref"
    if own and references:
        own.sort(key=lambda one: -max(one.column.hints.values(), default=0.0))
        asked = f"{len(own)} columns could be the car's own {channel}" if len(own) > 1 else ""
        first = proposal(own[0], channel, asked=asked, others=tuple(one.column.name for one in own[1:]))
        return [first, proposal(references[0], reference, "named as a reference")]
    if len(plain) < 2:
        return [Proposal(one.column.name, channel, one.unit, one.sign) for one in plain]
    asked = f"which is the car's own {channel}, and which the reference's: no name tells"
    rough, smooth = sorted(plain, key=lambda one: _roughness(one.column), reverse=True)[:2]
    return [
        proposal(rough, channel, "the rougher of the two", asked=asked, others=(reference,)),
        proposal(smooth, reference, "the smoother", asked=asked, others=(channel,)),
    ]


def _roughness(column: Candidate) -> float:
    """Size of the second difference."""
    return float(np.std(np.diff(column.values, 2))) / max(float(np.std(column.values)), 1e-12)
