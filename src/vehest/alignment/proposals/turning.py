"""Speed, yaw rate and lateral acceleration with their units, by ay ≈ vx·yaw_rate, and columns that
repeat them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from vehest.alignment.checks import MAX_REVERSE_SPEED
from vehest.alignment.motion import Motion, rms
from vehest.alignment.proposals.columns import (
    RARE_UNITS,
    UNITS,
    Candidate,
    correlation,
    largest,
    si_factor,
)
from vehest.alignment.proposals.names import STRONG, is_filtered, is_pair, is_reference
from vehest.alignment.proposals.proposal import Proposal
from vehest.constants import FloatArray

MIN_CORRELATION = 0.75  # smallest |correlation| of ay with vx·yaw_rate of a triple
UNIT_PENALTIES = {"mph": 0.1, "knots": 0.2}  # unit of speed -> penalty on its mismatch
RARITY = 0.25  # penalty of a rare unit on its mismatch
# logarithms of a gain that should be 1
CLOSE_MISMATCH = 0.3  # largest |logarithm| of a gain that units explain
FAR_MISMATCH = 0.6  # smallest |logarithm| of a gain that units do not explain
MAX_EVIDENT_MISMATCH = 0.1  # largest |logarithm| of a gain that alone indicates an acceleration
# smallest cost by which the second best units are worse than the best, so that these are proposed
# without a question; the cost of units is |natural logarithm of the gain| and penalties
MIN_COST_MARGIN = 0.2
# channel -> range of its 99th percentile, SI units; a size outside is implausible
RANGES = {
    "vx": (0.5, 110.0),
    "yaw_rate": (0.02, 8.0),
    "ay": (0.3, 60.0),
}
MAX_COLUMNS = 60  # largest number of columns that are tried as one channel, the best by name
# largest number of triples vx, yaw_rate, ay that rare units are tried for and returned
MAX_TURNINGS = 8
MIN_SCORE = 6.0  # smallest score of a triple
FOLLOWING = ("steer", "handwheel", "vy_ref", "sideslip_ref")
"""Channels that follow a turn at an even speed as an acceleration does, but for its scale; so a
clear name decides.
"""
NO_MOTION = (
    *("vx", "heading", "roll", "pitch"),
    *("latitude", "longitude", "position_x", "position_y"),
)
"""Roles whose columns are no yaw rate, no acceleration and, but for the first, no speed."""
ACCELERATIONS = {"ax", "ay", "az"}
"""Roles whose columns are no speed and no yaw rate: gravity is as even as a steady speed."""
# largest number of units that the header does not state and one gain can decide; two of them fit
# most gains
MAX_DECIDED_RARE_UNITS = 1
UNNAMED_PENALTY = 3.0  # penalty on the score of a column without a name where another one has it
# correlation above which ay was computed from vx·yaw_rate, and not measured
MIN_COMPUTED_CORRELATION = 0.9995
COMPUTED_PENALTY = 6.0  # penalty on the score of such an ay, where another column is named as ay
NAMELESS_RANK = 0.5  # rank of a column whose name suggests nothing
STANDSTILL_SPEED_SHARE = 0.02  # speed over the top speed below which the car may stand
MIN_REPEAT_CORRELATION = 0.97  # smallest correlation of one quantity that is measured twice
# channel -> the same of columns that are named alike; wheels slip
MIN_NAMED_REPEAT_CORRELATION = {
    "vx": 0.7,
    "yaw_rate": 0.9,
}
# correlation with ay above which a column repeats ay, or is an angle of lean
MIN_AY_REPEAT_CORRELATION = 0.99
# correlation of ay with another column named so above which the user is asked which one has gravity
MIN_AY_RIVAL_CORRELATION = 0.7
# largest difference of a copy, over the steps from sample to sample; two sensors differ by as much
# as their noise
MAX_COPY_DIFFERENCE = 0.05
# largest |logarithm| of the ratio of the sizes of two columns of which one repeats the other
MAX_REPEAT_MISMATCH = 0.35
# number of units that are tried; a speed that seems to be in others may be in counts
MAX_REPEAT_UNITS = 2


@dataclass(frozen=True, eq=False)
class Turning:
    """Columns that may be speed, yaw rate and lateral acceleration, with their units."""

    # channel -> column; without ``ay`` where only names suggest the other two
    columns: Mapping[str, Candidate]
    units: Mapping[str, str]  # channel -> unit
    decided: bool  # whether no other units explain the scale as well
    correlation: float = 0.0  # correlation of ay with vx·yaw_rate, with its sign
    scale: float = 1.0  # ay over vx·yaw_rate in these units, positive
    score: float = 0.0  # score of all evidence

    @property
    def is_reversing(self) -> bool:
        """Whether the speed is negative most of the time, and both ways no faster than a car
        reverses: nothing but its sign says which way is ahead.
        """
        speed = self.columns["vx"].slow
        return self._is_slow and float(np.median(speed)) < 0.0 and not _is_forward(speed)

    @property
    def may_be_unsigned(self) -> bool:
        """Whether a speed of one sign, no faster than a car reverses, and ay against vx·yaw_rate
        are as those of a car that reverses with a speed without sign.
        """
        return self._is_slow and self.correlation < 0.0 and _is_forward(self.columns["vx"].slow)

    @property
    def _is_slow(self) -> bool:
        """Whether the speed, either way, is never above that of a car that reverses."""
        largest_speed = largest(self.columns["vx"].slow) * si_factor(self.units["vx"], "vx")
        return largest_speed < MAX_REVERSE_SPEED

    @property
    def signs(self) -> dict[str, int]:
        """Channel -> sign by which the car drives ahead and ay is +vx·yaw_rate."""
        is_backward = float(np.median(self.columns["vx"].slow)) < 0.0
        ahead = -1 if is_backward and not self.is_reversing else 1
        return {"vx": ahead, "yaw_rate": 1, "ay": -ahead if self.correlation < 0.0 else ahead}

    def motion(self, rate_hz: float) -> Motion:
        """The motion by these columns.

        Parameters
        ----------
        rate_hz : float
            Of the samples [Hz].

        Returns
        -------
        Motion
            In SI units, with signs by which the car drives ahead and ay is +vx·yaw_rate; a sign of
            the yaw rate that is wrong stays, and is that of ay too.
        """
        signs = self.signs
        channels = {
            name: column.values * signs[name] * si_factor(self.units[name], name)
            for name, column in self.columns.items()
        }
        moving = np.abs(channels["vx"]) > STANDSTILL_SPEED_SHARE * largest(channels["vx"])
        return Motion(rate_hz, channels, "vx", "", moving)


@dataclass(frozen=True, eq=False)
class Search:
    """A motion, and the columns that are left beside it."""

    turning: Turning  # speed, yaw rate and lateral acceleration
    motion: Motion  # motion by these, ay = +vx·yaw_rate
    # columns without a channel that repeat none; those that get one are removed
    free: list[Candidate]


def find_turning(columns: Sequence[Candidate]) -> list[Turning]:
    """Find triples that may be speed, yaw rate and lateral acceleration, by ay ≈ vx·yaw_rate.

    Parameters
    ----------
    columns : sequence of Candidate
        With signals (S,) below 1 Hz, on one clock.

    Returns
    -------
    list of Turning
        At most `MAX_TURNINGS` with a score of `MIN_SCORE` or more, the best first.
    """
    speeds, rates, accelerations = (_pool(columns, channel) for channel in RANGES)
    if not (speeds and rates and accelerations):
        return []
    turnings = []
    centred_ay, ay_scales = _centred(np.stack([column.slow for column in accelerations]))
    for speed in speeds:
        centred_turning, scales = _centred(np.stack([column.slow for column in rates]) * speed.slow)
        with np.errstate(all="ignore"):
            correlations = np.nan_to_num(
                (centred_turning @ centred_ay.T)
                / centred_ay.shape[1]
                / np.outer(scales, ay_scales),
                posinf=0.0,
                neginf=0.0,
            )
        for i, j in zip(*np.nonzero(np.abs(correlations) >= MIN_CORRELATION), strict=True):
            if len({id(column) for column in (speed, rates[i], accelerations[j])}) == 3:
                named = {"vx": speed, "yaw_rate": rates[i], "ay": accelerations[j]}
                turnings.append((named, float(correlations[i, j]), float(ay_scales[j] / scales[i])))
    names = NameEvidence.of(columns)
    choices = {
        channel: {column: _unit_choices(column, channel) for column in pool}
        for channel, pool in zip(RANGES, (speeds, rates, accelerations), strict=True)
    }
    scored = sorted(
        ((_scored(names, choices, *turning), turning) for turning in turnings),
        key=lambda entry: -entry[0].score,
    )
    best = [
        _scored(names, choices, *turning, try_rare_units=True)
        for _, turning in scored[:MAX_TURNINGS]
    ]
    return sorted(
        (turning for turning in best if turning.score >= MIN_SCORE),
        key=lambda turning: -turning.score,
    )


def turning_by_names(columns: Sequence[Candidate]) -> Turning | None:
    """Speed and yaw rate by name, without a lateral acceleration.

    Parameters
    ----------
    columns : sequence of Candidate
        All columns.

    Returns
    -------
    Turning or None
        Units by the header, else the first in which the size is plausible; ``decided`` if the
        header has units of both columns. None where no two columns have these names.
    """
    columns_by_channel = {}
    units = {}
    for channel in ("vx", "yaw_rate"):
        named = [candidate for candidate in _pool(columns, channel) if channel in candidate.hints]
        if not named:
            return None
        columns_by_channel[channel] = column = max(
            named,
            key=lambda candidate: (
                channel == "vx" and _is_forward(candidate.slow),
                candidate.hints[channel],
                not is_filtered(candidate.name),
                bool(candidate.unit),
            ),
        )
        offered = column.units(channel)
        units[channel] = next(
            (unit for unit in offered if is_plausible(column.size, channel, unit)), offered[0]
        )
    if columns_by_channel["vx"] is columns_by_channel["yaw_rate"]:
        return None
    has_units = all(candidate.unit for candidate in columns_by_channel.values())
    return Turning(columns_by_channel, units, has_units)


def _centred(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Signals (C, T) about their means, and their standard deviations, (C,)."""
    rows = rows - rows.mean(axis=1, keepdims=True)
    return rows, np.sqrt(np.mean(np.square(rows), axis=1))


def _pool(columns: Sequence[Candidate], channel: str) -> list[Candidate]:
    """Columns that could be a channel, those whose names suggest it first."""
    pool = [
        column
        for column in columns
        if (
            channel in column.hints
            or STRONG not in {column.hints.get(role) for role in (*FOLLOWING, *NO_MOTION)}
        )
        and column.measures(channel)
        and (channel != "vx" or "vx" in column.hints or _is_forward(column.slow))
        and (channel in ("ay", *column.hints) or not ACCELERATIONS & set(column.hints))
    ]
    return sorted(
        pool,
        key=lambda column: (
            -(column.hints.get(channel) or (-1.0 if column.hints else NAMELESS_RANK))
        ),
    )[:MAX_COLUMNS]


def _is_forward(slow: FloatArray) -> bool:
    """Whether a column is of one sign but for a little, as the speed of a car is."""
    bound = 0.1 * float(np.abs(slow).max())
    return bound > 0.0 and min(float(np.mean(slow < -bound)), float(np.mean(slow > bound))) < 0.02


def is_evident(ay: Candidate, scale: float) -> bool:
    """Whether a unit, a clear name or a gain near 1 to vx·yaw_rate indicates an acceleration.

    A lateral velocity follows a turn alike.
    """
    return (
        bool(ay.unit) or ay.hints.get("ay") == STRONG or abs(math.log(scale)) < MAX_EVIDENT_MISMATCH
    )


def is_plausible(size: float, channel: str, unit: str) -> bool:
    """Whether a car has a speed, yaw rate or acceleration of a size.

    Parameters
    ----------
    size : float
        99th percentile of the magnitude, in ``unit``.
    channel : str
        ``vx``, ``yaw_rate`` or ``ay``.
    unit : str
        Of the size.
    """
    low, high = RANGES[channel]
    return low <= size * si_factor(unit, channel) <= high


class NameEvidence(NamedTuple):
    """Evidence of the names of all columns of a log, besides the three that are tried."""

    strongest: Mapping[str, float]  # channel -> strength of the clearest name of any column for it
    n_ay: int  # number of columns that are named like a lateral acceleration
    is_bus: bool  # whether one of these is a signal of a bus

    @classmethod
    def of(cls, columns: Sequence[Candidate]) -> NameEvidence:
        """Evidence of the names of these columns."""
        accelerations = [column for column in columns if "ay" in column.hints]
        return cls(
            {
                channel: max((column.hints.get(channel, 0.0) for column in columns), default=0.0)
                for channel in RANGES
            },
            len(accelerations),
            any(column.is_of_bus for column in accelerations),
        )


class UnitChoice(NamedTuple):
    """A unit that a column may have as a channel."""

    unit: str  # the unit
    factor: float  # factor to SI
    is_implausible: bool  # whether no car has the size that the column then has
    rarity: float  # penalty of a rare unit


def _unit_choices(
    column: Candidate, channel: str, *, try_rare_units: bool = False
) -> tuple[UnitChoice, ...]:
    """Units of a column as a channel; with ``try_rare_units`` rare ones too if it states none."""
    units = (
        (*UNITS[channel], *RARE_UNITS[channel])
        if try_rare_units and not column.unit
        else column.units(channel)
    )
    return tuple(
        UnitChoice(
            unit,
            si_factor(unit, channel),
            not is_plausible(column.size, channel, unit),
            UNIT_PENALTIES.get(unit, RARITY * (unit in RARE_UNITS[channel]))
            if column.unit != unit
            else 0.0,
        )
        for unit in units
    )


def _ranked(
    choices: Sequence[Sequence[UnitChoice]], file_gain: float
) -> list[tuple[float, float, tuple[str, ...], float, int]]:
    """Units of the three with their cost, the logarithm of the gain, the gain and the number of
    implausible sizes, the best first.
    """
    ranked = []
    for speed, rate, acceleration in product(*choices):
        gain = file_gain / (speed.factor * rate.factor / acceleration.factor)
        n_implausible = speed.is_implausible + rate.is_implausible + acceleration.is_implausible
        rarity = speed.rarity + rate.rarity + acceleration.rarity
        mismatch = abs(math.log(gain))
        units = (speed.unit, rate.unit, acceleration.unit)
        ranked.append((mismatch + rarity + n_implausible, mismatch, units, gain, n_implausible))
    return sorted(ranked)


def _scored(
    names: NameEvidence,
    choices: Mapping[str, Mapping[Candidate, Sequence[UnitChoice]]],
    named: Mapping[str, Candidate],
    correlation_with_ay: float,
    file_gain: float,
    *,
    try_rare_units: bool = False,
) -> Turning:
    """The triple with the units that explain the gain of ay to vx·yaw_rate best, and the score of
    all evidence.
    """
    ranked = _ranked([choices[name][column] for name, column in named.items()], file_gain)
    if try_rare_units and ranked[0][0] >= FAR_MISMATCH:
        rare = [_unit_choices(column, name, try_rare_units=True) for name, column in named.items()]
        rare_ranked = _ranked(rare, file_gain)
        if rare_ranked[0][1] < MAX_EVIDENT_MISMATCH:  # raw counts have any gain
            ranked = rare_ranked
    cost, mismatch, units, gain, n_implausible = ranked[0]
    rare_units = [
        unit
        for (channel, column), unit in zip(named.items(), units, strict=True)
        if not column.unit and unit in RARE_UNITS[channel]
    ]
    decided = (
        mismatch < FAR_MISMATCH
        and len(rare_units) <= MAX_DECIDED_RARE_UNITS
        and (len(ranked) == 1 or ranked[1][0] - cost > MIN_COST_MARGIN)
    )
    score = 12.0 * (abs(correlation_with_ay) - MIN_CORRELATION) / (1.0 - MIN_CORRELATION)
    for channel, column in named.items():
        score += (
            column.hint(channel) + (1.5 if column.unit else 0.0) - 0.5 * is_filtered(column.name)
        )
        if channel not in column.hints:
            score -= UNNAMED_PENALTY * names.strongest[channel] / STRONG
    score -= (3.0 if names.is_bus else 0.5) * named["ay"].is_reference + 5.0 * n_implausible
    score += -5.0 if mismatch >= FAR_MISMATCH else 3.0 if mismatch < CLOSE_MISMATCH else 1.0
    score -= UNNAMED_PENALTY * (not is_evident(named["ay"], gain))
    n_other_ay = names.n_ay - ("ay" in named["ay"].hints)
    score -= COMPUTED_PENALTY * (
        abs(correlation_with_ay) > MIN_COMPUTED_CORRELATION and n_other_ay > 0
    )
    return Turning(
        named, dict(zip(named, units, strict=True)), decided, correlation_with_ay, gain, score
    )


class Repeat(NamedTuple):
    """A column that measures the same as another one."""

    column: Candidate  # the column
    unit: str  # unit of the column
    sign: int  # sign by which it counts as the other one

    def si(self, channel: str, values: FloatArray) -> FloatArray:
        """Samples of a channel in SI units, from values as the column has them."""
        return values * (self.sign * si_factor(self.unit, channel))

    def proposal(self, channel: str, *evidence: str, **more: Any) -> Proposal:
        """The proposal of the column as a channel; ``more`` are further fields of it."""
        return Proposal(self.column.name, channel, self.unit, self.sign, evidence, **more)


def repeated(search: Search) -> Iterator[Proposal]:
    """Propose channels for speeds, yaw rates and lateral accelerations that are measured twice.

    Parameters
    ----------
    search : Search
        Columns that repeat one of its motion are removed from ``search.free``.

    Yields
    ------
    Proposal
        The car's own and the reference's, also for the column of the motion itself.
    """
    turning = search.turning
    measured = {
        channel: Repeat(column, turning.units[channel], turning.signs[channel])
        for channel, column in turning.columns.items()
    }
    for channel in MIN_NAMED_REPEAT_CORRELATION:
        first = measured[channel]
        repeats = []
        scaled = []
        for component in _components(search.free, first) if channel == "vx" else ():
            search.free.remove(component)
        for column in search.free:
            agreement = correlation(column.slow, first.column.slow)
            if unit := _unit(column, first, channel, agreement):
                repeats.append(Repeat(column, unit, -first.sign if agreement < 0.0 else first.sign))
            elif (
                channel == "vx"
                and column.hints.get("vx") == STRONG
                and not column.unit
                and abs(agreement) > MIN_NAMED_REPEAT_CORRELATION["vx"]
            ):
                # named as a speed, and one but for its scale, as a motor's speed is
                scaled.append(column)
        for repeat in list(repeats):
            search.free.remove(repeat.column)
            if _is_copy(repeat, first, channel):
                repeats.remove(repeat)
                yield first.proposal(
                    channel, f"'{repeat.column.name}' holds the same samples in {repeat.unit}"
                )
        family = [*(() if first.column.is_wheel_mean else (first,)), *repeats]
        if repeats:
            yield from _separated(family, channel)
        elif scaled and family:
            search.free.remove(scaled[0])
            yield from _scaled_speed(scaled[0], first, turning.decided)
    if "ay" not in measured:
        return
    ay = measured["ay"]
    for column in list(search.free):
        agreement = abs(correlation(column.slow, ay.column.slow))
        if agreement > MIN_AY_REPEAT_CORRELATION and column.hint("ay") >= 0.0:
            search.free.remove(column)
            if not _unit(column, ay, "ay", agreement):  # an angle of lean
                continue
            yield ay.proposal(
                "ay",
                f"'{column.name}': correlation {agreement:.3f}, measured at another point or "
                "filtered",
                is_repeated=True,
            )
    rivals = tuple(
        column.name
        for column in search.free
        if column.hints.get("ay") == STRONG
        and not column.is_reference
        and abs(correlation(column.slow, ay.column.slow)) > MIN_AY_RIVAL_CORRELATION
    )
    if rivals:
        question = f"{' and '.join(rivals)} would fit as well; which one contains gravity?"
        yield ay.proposal("ay", question=question, alternatives=rivals)


def reference_speed(channels: dict[str, Proposal]) -> dict[str, Proposal]:
    """Channels, by name, with the speed as vx_ref where it is named as a reference, or like the
    lateral velocity.

    Wheels supply the car's own speed.

    Parameters
    ----------
    channels : dict
        Channel -> its proposal; without a lateral velocity, or with a vx_ref, it is returned as it
        is.
    """
    speed = channels.get("vx")
    lateral = channels.get("vy_ref")
    if speed is None or lateral is None or "vx_ref" in channels:
        return channels
    evidence = "named as a reference"
    question = speed.question
    if not is_reference(speed.column):
        evidence = f"named like '{lateral.column}', and the wheel speeds supply vx"
        question = question or "is it the car's own speed or that of the reference?"
        if not is_pair(speed.column, lateral.column):
            return channels
    reference = replace(
        speed, channel="vx_ref", alternatives=("vx",), question=question
    ).with_evidence(evidence)
    return {name: proposal for name, proposal in channels.items() if name != "vx"} | {
        "vx_ref": reference
    }


def _is_copy(repeat: Repeat, first: Repeat, channel: str) -> bool:
    """Whether a column holds the samples of another one, except for unit, sign and rounding."""
    if first.column.is_wheel_mean or repeat.column.is_reference != first.column.is_reference:
        return False
    copy, samples = (each.si(channel, each.column.values) for each in (repeat, first))
    return rms(copy - samples) < MAX_COPY_DIFFERENCE * rms(np.diff(samples))


def _unit(column: Candidate, first: Repeat, channel: str, agreeing: float) -> str:
    """The unit in which a column is another one measured again; empty where it is not."""
    min_correlation = MIN_REPEAT_CORRELATION
    if channel in column.hints:
        min_correlation = MIN_NAMED_REPEAT_CORRELATION.get(channel, MIN_REPEAT_CORRELATION)
    if (
        abs(agreeing) < min_correlation
        or column.hint(channel) < 0.0
        or not column.measures(channel)
    ):
        return ""
    size = rms(first.column.slow) * si_factor(first.unit, channel)
    ranked = [
        (abs(math.log(rms(column.slow) * si_factor(unit, channel) / size)), unit)
        for unit in column.units(channel)[:MAX_REPEAT_UNITS]
    ]
    return min(ranked)[1] if min(ranked)[0] < MAX_REPEAT_MISMATCH else ""


def _components(columns: Sequence[Candidate], first: Repeat) -> set[Candidate]:
    """Velocities that repeat the speed only together, as those along two axes of the world do."""
    speed = np.abs(first.column.slow)
    components: set[Candidate] = set()
    for column in columns:
        agreement = correlation(column.slow, first.column.slow)
        if abs(agreement) < MIN_REPEAT_CORRELATION and _unit(column, first, "vx", agreement):
            for other in columns:
                size = np.hypot(column.slow, other.slow)
                is_common = correlation(size, speed) > MIN_REPEAT_CORRELATION
                if is_pair(column.name, other.name) and is_common:
                    components |= {column, other}
    return components


def _scaled_speed(column: Candidate, first: Repeat, decided: bool) -> Iterator[Proposal]:
    """The car's own speed in counts, and the reference's by which it is scaled.

    ``decided``: whether the motion decides the unit of ``first``.
    """
    if column.is_reference and not (first.column.is_reference or first.column.unit or decided):
        column, first = first.column, Repeat(column, UNITS["vx"][0], first.sign)
    name = first.column.name
    speed = first.si("vx", first.column.slow)
    factor = float(column.slow @ speed) / float(column.slow @ column.slow)
    evidence = (
        f"correlation with '{name}' {correlation(column.slow, first.column.slow):.2f}; no unit of "
        "speed explains the gain"
    )
    question = (
        f"is it the car's own speed with factor {abs(factor):.5g} m/s, so that '{name}' is the "
        "reference's, or another quantity?"
    )
    sign = -1 if factor < 0.0 else 1
    yield Proposal(
        column.name, "vx", "m/s", sign, (evidence,), question, factor=float(f"{abs(factor):.5g}")
    )
    question = (
        f"is it the reference's speed, or the car's own ('{column.name}' being another quantity)?"
    )
    yield first.proposal("vx_ref", f"proportional to '{column.name}'", question=question)


def _separated(family: Sequence[Repeat], channel: str) -> list[Proposal]:
    """Proposals of the car's own and the reference's, of columns that measure the same; others are
    left out.
    """
    plain = [repeat for repeat in family if not is_filtered(repeat.column.name)] or list(family)
    of_car = [repeat for repeat in plain if repeat.column.is_of_bus] or [
        repeat for repeat in plain if not repeat.column.is_reference
    ]
    if not of_car:  # filtered, but the car's
        of_car = [repeat for repeat in family if not repeat.column.is_reference]
    references = [repeat for repeat in plain if repeat.column.is_reference] or [
        repeat for repeat in plain if repeat not in of_car
    ]
    slow = family[0].column.slow
    lowest = min(abs(correlation(repeat.column.slow, slow)) for repeat in plain)
    text = f"correlation with the other {channel} {lowest:.2f}"

    reference = f"{channel}_ref"
    if of_car and references:
        of_car.sort(key=lambda repeat: -max(repeat.column.hints.values(), default=0.0))
        question = (
            f"{len(of_car)} columns could be the car's own {channel}" if len(of_car) > 1 else ""
        )
        first = of_car[0].proposal(
            channel,
            text,
            question=question,
            alternatives=tuple(repeat.column.name for repeat in of_car[1:]),
            is_repeated=True,
        )
        column = references[0].column
        reason = (
            "named as a reference" if column.is_reference else "the other one is from the car's bus"
        )
        question = (
            ""
            if column.is_reference or channel in column.hints
            else f"is it the reference's {channel}? Its name does not say so"
        )
        second = references[0].proposal(
            reference, text, reason, question=question, is_repeated=True
        )
        return [first, second]
    if len(plain) < 2:
        return [repeat.proposal(channel, "the other columns are filtered") for repeat in plain]
    question = (
        f"which column is the car's own {channel}, and which the reference's? No name decides"
    )

    def roughness(repeat: Repeat) -> float:
        values = repeat.column.values
        return float(np.std(np.diff(values, 2))) / max(float(np.std(values)), 1e-12)

    rough, smooth = sorted(plain, key=roughness, reverse=True)[:2]
    return [
        repeat.proposal(
            proposed, text, reason, question=question, alternatives=(other,), is_repeated=True
        )
        for repeat, proposed, other, reason in (
            (rough, channel, reference, "the noisier of the two"),
            (smooth, reference, channel, "the smoother of the two"),
        )
    ]
