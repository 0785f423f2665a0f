"""Speed, yaw rate and lateral acceleration with their units, by ay ≈ vx·yaw_rate, and columns that repeat them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np

from vehest.alignment.motion import Motion, rms
from vehest.alignment.proposals.columns import UNITS, Candidate, correlation, largest, si_factor
from vehest.alignment.proposals.names import STRONG, is_filtered, is_pair, is_reference
from vehest.alignment.proposals.proposal import Proposal
from vehest.constants import FloatArray

LEAST_CORRELATION = 0.75
RARE = {"mph": 0.1, "knots": 0.2}  # units of speed, with a penalty on their mismatch
CLOSE = 0.3
FAR = 0.6  # logarithms of a scale: within, units explain it; beyond, they do not
EVIDENT = 0.1  # likewise: within, the scale alone indicates an acceleration
APART = 0.2  # by which the next best units must be worse
RANGES = {
    "vx": (0.5, 110.0),
    "yaw_rate": (0.02, 8.0),
    "ay": (0.3, 60.0),
}  # of the 99th percentile, SI
MOST_COLUMNS = 60
MOST_KEPT = 8
LEAST_SCORE = 6.0
FOLLOWING = ("steer", "handwheel", "vy_ref", "sideslip_ref")
"""Channels that follow a turn at an even speed as an acceleration does, but for its scale; so a clear name decides."""
NO_RATE_OR_ACCELERATION = (
    *("vx", "heading", "roll", "pitch"),
    *("latitude", "longitude", "position_x", "position_y"),
)
"""Roles of speeds, angles and positions, none of which is a yaw rate or an acceleration."""
UNNAMED = 3.0  # of score, for a column that no name speaks for where one speaks for another
EXACT = 0.9995  # correlation beyond which ay was computed of vx·yaw_rate, and not measured
COMPUTED = 6.0  # of score, for that, where another column is named as ay
NAMELESS = 0.5  # rank of a column whose name suggests nothing
STANDING = 0.02  # of the top speed; below, the car may stand
SAME = 0.97  # correlation of one quantity measured twice
SAME_NAMED = {"vx": 0.7, "yaw_rate": 0.9}  # of columns that are named alike; wheels slip
SAME_AY = 0.99
SAME_SCALE = 0.35  # logarithm
LIKELY = 2  # units to try; a speed that seems to be in others may be in counts


@dataclass(frozen=True, eq=False)
class Turning:
    """Columns that may be speed, yaw rate and lateral acceleration."""

    columns: Mapping[
        str, Candidate
    ]  # by channel; without ``ay`` where only names suggest the other two
    units: Mapping[str, str]  # by channel
    decided: bool  # whether no other units explain the scale as well
    correlation: float = 0.0  # of ay with vx·yaw_rate, with its sign
    scale: float = 1.0  # ay over vx·yaw_rate in these units, positive
    score: float = 0.0  # of all evidence

    @property
    def signs(self) -> dict[str, int]:
        """Channel -> sign by which the car drives ahead and ay is +vx·yaw_rate."""
        ahead = -1 if float(np.median(self.columns["vx"].slow)) < 0.0 else 1
        return {"vx": ahead, "yaw_rate": 1, "ay": -ahead if self.correlation < 0.0 else ahead}

    def motion(self, rate_hz: float) -> Motion:
        """The motion by these columns."""
        signs = self.signs
        channels = {
            name: column.values * signs[name] * si_factor(self.units[name], name)
            for name, column in self.columns.items()
        }
        moving = np.abs(channels["vx"]) > STANDING * largest(channels["vx"])
        return Motion(rate_hz, channels, "vx", "", moving)


@dataclass(frozen=True, eq=False)
class Search:
    """A motion, and the columns that are left beside it."""

    turning: Turning  # speed, yaw rate and lateral acceleration
    known: Motion  # by these, ay = +vx·yaw_rate
    free: list[
        Candidate
    ]  # columns without a channel that repeat none; those that get one are removed


def find_turning(columns: Sequence[Candidate]) -> list[Turning]:
    """Triples that may be speed, yaw rate and lateral acceleration, the best first."""
    speeds, rates, accelerations = (_pool(columns, channel) for channel in RANGES)
    if not (speeds and rates and accelerations):
        return []
    found = []
    shown, sizes = _centred(np.stack([one.slow for one in accelerations]))
    for speed in speeds:
        turning, scales = _centred(np.stack([one.slow for one in rates]) * speed.slow)
        with np.errstate(all="ignore"):
            agreeing = np.nan_to_num(
                (turning @ shown.T) / shown.shape[1] / np.outer(scales, sizes),
                posinf=0.0,
                neginf=0.0,
            )
        for i, j in zip(*np.nonzero(np.abs(agreeing) >= LEAST_CORRELATION), strict=True):
            if len({id(one) for one in (speed, rates[i], accelerations[j])}) == 3:
                named = {"vx": speed, "yaw_rate": rates[i], "ay": accelerations[j]}
                found.append(
                    _scored(columns, named, float(agreeing[i, j]), float(sizes[j] / scales[i]))
                )
    return [
        one
        for one in sorted(found, key=lambda one: -one.score)[:MOST_KEPT]
        if one.score >= LEAST_SCORE
    ]


def turning_by_names(columns: Sequence[Candidate]) -> Turning | None:
    """Speed and yaw rate by name, where no lateral acceleration ties them together; None without one of them."""
    named = {}
    units = {}
    for channel in ("vx", "yaw_rate"):
        pool = [one for one in _pool(columns, channel) if channel in one.hints]
        if not pool:
            return None
        ahead = [one for one in pool if channel == "vx" and _is_forward(one.slow)]
        named[channel] = column = max(
            ahead or pool,
            key=lambda one: (one.hints[channel], not is_filtered(one.name), bool(one.unit)),
        )
        offered = column.units(channel)
        units[channel] = next(
            (unit for unit in offered if _is_plausible(column, channel, unit)), offered[0]
        )
    is_one = named["vx"] is named["yaw_rate"]
    return None if is_one else Turning(named, units, all(one.unit for one in named.values()))


def _centred(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Signals (C, T) about their means, and their standard deviations, (C,)."""
    rows = rows - rows.mean(axis=1, keepdims=True)
    return rows, np.sqrt(np.mean(np.square(rows), axis=1))


def _pool(columns: Sequence[Candidate], channel: str) -> list[Candidate]:
    """Columns that could be a channel, those whose names suggest it first."""
    own = [
        one
        for one in columns
        if channel in one.hints
        or STRONG
        not in {
            one.hints.get(role)
            for role in (*FOLLOWING, *(NO_RATE_OR_ACCELERATION if channel != "vx" else ()))
        }
    ]
    own = [
        one
        for one in own
        if one.measures(channel) and (channel != "vx" or "vx" in one.hints or _is_forward(one.slow))
    ]
    return sorted(
        own, key=lambda one: -(one.hints.get(channel) or (-1.0 if one.hints else NAMELESS))
    )[:MOST_COLUMNS]


def _is_forward(slow: FloatArray) -> bool:
    """Whether a column is of one sign but for a little, as the speed of a car is."""
    bound = 0.1 * float(np.abs(slow).max())
    return bound > 0.0 and min(float(np.mean(slow < -bound)), float(np.mean(slow > bound))) < 0.02


def is_evident(ay: Candidate, scale: float) -> bool:
    """Whether a unit, a clear name or a scale near 1 over vx·yaw_rate indicates a lateral acceleration; a velocity follows a turn alike."""
    return bool(ay.unit) or ay.hints.get("ay") == STRONG or abs(math.log(scale)) < EVIDENT


def _is_plausible(column: Candidate, channel: str, unit: str) -> bool:
    low, high = RANGES[channel]
    return low <= column.size * si_factor(unit, channel) <= high


def _scored(
    columns: Sequence[Candidate], named: Mapping[str, Candidate], agreeing: float, scale: float
) -> Turning:
    """With the units that explain best a scale of ay over vx·yaw_rate in the file's units, others than by the header only where these
    are far from it, and the score of all evidence."""
    ranked = []
    tried = [
        {*column.units(channel), *(() if column.is_made else UNITS[channel])}
        for channel, column in named.items()
    ]
    for units in product(*tried):
        speed, rate, acceleration = (
            si_factor(unit, channel) for unit, channel in zip(units, named, strict=True)
        )
        left = scale / (speed * rate / acceleration)
        implausible = sum(
            not _is_plausible(column, channel, unit)
            for (channel, column), unit in zip(named.items(), units, strict=True)
        )
        rare = 0.0 if named["vx"].unit == units[0] else RARE.get(units[0], 0.0)
        against = sum(
            column.unit not in ("", unit)
            for column, unit in zip(named.values(), units, strict=True)
        )
        ranked.append(
            (
                abs(math.log(left)) + rare + implausible + against,
                abs(math.log(left)),
                units,
                left,
                implausible,
                against,
            )
        )
    ranked.sort()
    cost, mismatch, units, left, implausible, against = ranked[0]
    decided = mismatch < FAR and (len(ranked) == 1 or ranked[1][0] - cost > APART)
    score = 12.0 * (abs(agreeing) - LEAST_CORRELATION) / (1.0 - LEAST_CORRELATION)
    for channel, one in named.items():
        score += one.hint(channel) + (1.5 if one.unit else 0.0) - 0.5 * is_filtered(one.name)
        if channel not in one.hints:
            score -= (
                UNNAMED
                * max((other.hints.get(channel, 0.0) for other in columns), default=0.0)
                / STRONG
            )
    score -= (3.0 if any(one.is_of_bus and "ay" in one.hints for one in columns) else 0.5) * named[
        "ay"
    ].is_reference + 5.0 * implausible
    level = np.abs(named["vx"].slow)
    if float(np.std(level)) < 0.05 * float(np.mean(level)) and "vx" not in named["vx"].hints:
        score -= 2.0
    score += -5.0 if against or mismatch >= FAR else 3.0 if mismatch < CLOSE else 1.0
    score -= UNNAMED * (not is_evident(named["ay"], left))
    others = any("ay" in one.hints for one in columns if one is not named["ay"])
    score -= COMPUTED * (abs(agreeing) > EXACT and others)
    return Turning(named, dict(zip(named, units, strict=True)), decided, agreeing, left, score)


class Repeat(NamedTuple):
    """A column that measures the same as another one."""

    column: Candidate
    unit: str
    sign: int


def repeated(search: Search) -> Iterator[Proposal]:
    """Proposals for speeds, yaw rates and lateral accelerations that are measured twice, those of the motion among them."""
    for channel in SAME_NAMED:
        first = Repeat(
            search.turning.columns[channel],
            search.turning.units[channel],
            search.turning.signs[channel],
        )
        same = []
        scaled = []
        for column in search.free:
            agreeing = correlation(column.slow, first.column.slow)
            unit = _unit(column, first, channel, agreeing)
            if unit:
                same.append(Repeat(column, unit, -first.sign if agreeing < 0.0 else first.sign))
            elif (
                channel == "vx"
                and column.hints.get("vx") == STRONG
                and not column.unit
                and abs(agreeing) > SAME_NAMED["vx"]
            ):
                scaled.append(
                    column
                )  # named as a speed, and one but for its scale, as a motor's speed is
        for one in same:
            search.free.remove(one.column)
        family = [*(() if first.column.is_made else (first,)), *same]
        if same:
            yield from _separated(family, channel)
        elif scaled and family:
            search.free.remove(scaled[0])
            yield from _scaled_speed(scaled[0], first, search.turning.decided)
    ay = search.turning.columns.get("ay")
    for column in list(search.free):
        if (
            ay is not None
            and abs(correlation(column.slow, ay.slow)) > SAME_AY
            and column.hint("ay") >= 0.0
        ):
            search.free.remove(column)
            text = f"'{column.name}' agrees {abs(correlation(column.slow, ay.slow)):.3f}, as of another place or filtered"
            yield Proposal(
                ay.name, "ay", search.turning.units["ay"], search.turning.signs["ay"], (text,)
            )


def reference_speed(found: dict[str, Proposal]) -> dict[str, Proposal]:
    """With a speed that is named as a reference, or like the lateral velocity, as the reference's, where wheels can give the car's own."""
    own = found.get("vx")
    lateral = found.get("vy_ref")
    if own is None or lateral is None or "vx_ref" in found:
        return found
    evidence = "named as a reference"
    asked = own.asked
    if not is_reference(own.column):
        evidence = f"named like '{lateral.column}', and wheels are there for vx"
        asked = asked or "whether it is the car's own speed or the reference's"
        if not is_pair(own.column, lateral.column):
            return found
    reference = replace(own, channel="vx_ref", others=("vx",), asked=asked).with_evidence(evidence)
    return {name: one for name, one in found.items() if name != "vx"} | {"vx_ref": reference}


def _unit(column: Candidate, first: Repeat, channel: str, agreeing: float) -> str:
    """The unit in which a column is another one measured again; empty where it is not."""
    least = SAME_NAMED[channel] if channel in column.hints else SAME
    if abs(agreeing) < least or column.hint(channel) < 0.0 or not column.measures(channel):
        return ""
    size = rms(first.column.slow) * si_factor(first.unit, channel)
    ranked = [
        (abs(math.log(rms(column.slow) * si_factor(unit, channel) / size)), unit)
        for unit in column.units(channel)[:LIKELY]
    ]
    return min(ranked)[1] if min(ranked)[0] < SAME_SCALE else ""


def _scaled_speed(column: Candidate, first: Repeat, decided: bool) -> Iterator[Proposal]:
    """The car's own speed in counts, and the reference's by which it is scaled; the first one's unit may be ``decided`` by the motion."""
    if column.is_reference and not (first.column.is_reference or first.column.unit or decided):
        column, first = first.column, Repeat(column, UNITS["vx"][0], first.sign)
    name = first.column.name
    speed = first.column.slow * first.sign * si_factor(first.unit, "vx")
    factor = float(column.slow @ speed) / float(column.slow @ column.slow)
    evidence = f"follows '{name}' ({correlation(column.slow, first.column.slow):.2f}), no unit of speed explains its scale"
    asked = f"the car's own speed, {abs(factor):.5g} m/s for a unit of it, or another quantity; '{name}' is then the reference's"
    sign = -1 if factor < 0.0 else 1
    yield Proposal(
        column.name, "vx", "m/s", sign, (evidence,), asked, factor=float(f"{abs(factor):.5g}")
    )
    asked = f"the reference's speed, or the car's own ('{column.name}' in counts)"
    yield Proposal(name, "vx_ref", first.unit, first.sign, (f"'{column.name}' follows it",), asked)


def _separated(family: Sequence[Repeat], channel: str) -> list[Proposal]:
    """The car's own and the reference's of columns that measure the same; more than these two are left out."""
    plain = [one for one in family if not is_filtered(one.column.name)] or list(family)
    own = [one for one in plain if one.column.is_of_bus] or [
        one for one in plain if not one.column.is_reference
    ]
    own = own or [one for one in family if not one.column.is_reference]  # filtered, but the car's
    references = [one for one in plain if one.column.is_reference] or [
        one for one in plain if one not in own
    ]
    text = f"agrees {min(abs(correlation(one.column.slow, family[0].column.slow)) for one in plain):.2f} with the other {channel}"

    def proposal(
        one: Repeat, name: str, *more: str, asked: str = "", others: tuple[str, ...] = ()
    ) -> Proposal:
        return Proposal(
            one.column.name, name, one.unit, one.sign, (text, *more), asked, others=others
        )

    reference = f"{channel}_ref"
    if own and references:
        own.sort(key=lambda one: -max(one.column.hints.values(), default=0.0))
        asked = f"{len(own)} columns could be the car's own {channel}" if len(own) > 1 else ""
        first = proposal(
            own[0], channel, asked=asked, others=tuple(one.column.name for one in own[1:])
        )
        other = references[0].column
        why = (
            "named as a reference"
            if other.is_reference
            else "the other one is of the car's own bus"
        )
        asked = (
            ""
            if other.is_reference or channel in other.hints
            else f"whether it is the reference's {channel}: no name says so"
        )
        return [first, proposal(references[0], reference, why, asked=asked)]
    if len(plain) < 2:
        return [
            Proposal(one.column.name, channel, one.unit, one.sign, ("the others are filtered",))
            for one in plain
        ]
    asked = f"which is the car's own {channel}, and which the reference's: no name decides"
    roughness = {
        id(one): float(np.std(np.diff(one.column.values, 2)))
        / max(float(np.std(one.column.values)), 1e-12)
        for one in plain
    }
    rough, smooth = sorted(plain, key=lambda one: roughness[id(one)], reverse=True)[:2]
    return [
        proposal(rough, channel, "the rougher of the two", asked=asked, others=(reference,)),
        proposal(smooth, reference, "the smoother", asked=asked, others=(channel,)),
    ]
