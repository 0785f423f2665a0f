"""Speed, yaw rate and lateral acceleration with their units, by ay ≈ vx·yaw_rate."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from vehest.alignment.motion import Motion
from vehest.alignment.proposals.columns import Candidate, largest, si_factor
from vehest.alignment.proposals.names import STRONG, is_filtered, is_reference
from vehest.constants import FloatArray

LEAST_CORRELATION = 0.75
RARE = {"mph": 0.1, "knots": 0.2}  # units of speed, with what is added to their mismatch
CLOSE, FAR = 0.3, 0.6  # logarithms of a scale: within, units explain it; beyond, they do not
APART = 0.2  # by which the next best units must be worse
RANGES = {"vx": (0.5, 110.0), "yaw_rate": (0.02, 8.0), "ay": (0.3, 60.0)}  # of the 99th percentile, SI
MOST_COLUMNS = 60
MOST_KEPT = 8
LEAST_SCORE = 6.0
FOLLOWING = ("steer", "handwheel", "vy_ref", "sideslip_ref")
"""Channels that follow a turn at an even speed as an acceleration does, but for its scale; so a clear name decides."""
UNNAMED = 3.0  # of score, for a column that no name speaks for where one speaks for another
NAMELESS = 0.5  # rank of a column whose name suggests nothing
STANDING = 0.02  # of the top speed; below, the car may stand


@dataclass(frozen=True, eq=False)
class Turning:
    """Columns that may be speed, yaw rate and lateral acceleration."""

    columns: Mapping[str, Candidate]  # by channel; without ``ay`` where only names suggest the other two
    units: Mapping[str, str]  # by channel
    decided: bool  # whether no other units explain the scale as well
    correlation: float = 0.0  # of ay with vx·yaw_rate, with its sign
    scale: float = 1.0  # ay over vx·yaw_rate in these units, positive
    score: float = 0.0  # of all evidence

    @property
    def is_close(self) -> bool:
        """Whether the units explain the scale, or nearly."""
        return abs(math.log(self.scale)) < FAR

    @property
    def signs(self) -> dict[str, int]:
        """Channel -> sign by which the car drives ahead and ay is +vx·yaw_rate."""
        ahead = -1 if float(np.median(self.columns["vx"].slow)) < 0.0 else 1
        return {"vx": ahead, "yaw_rate": 1, "ay": -ahead if self.correlation < 0.0 else ahead}

    def motion(self, rate_hz: float) -> Motion:
        """The motion by these columns."""
        signs = self.signs
        channels = {name: column.values * signs[name] * si_factor(self.units[name], name) for name, column in self.columns.items()}
        moving = np.abs(channels["vx"]) > STANDING * largest(channels["vx"])
        return Motion(rate_hz, channels, "vx", "", moving)


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
            agreeing = np.nan_to_num((turning @ shown.T) / shown.shape[1] / np.outer(scales, sizes), posinf=0.0, neginf=0.0)
        for i, j in zip(*np.nonzero(np.abs(agreeing) >= LEAST_CORRELATION), strict=True):
            if len({id(one) for one in (speed, rates[i], accelerations[j])}) == 3:
                named = {"vx": speed, "yaw_rate": rates[i], "ay": accelerations[j]}
                found.append(_scored(columns, named, float(agreeing[i, j]), float(sizes[j] / scales[i])))
    return [one for one in sorted(found, key=lambda one: -one.score)[:MOST_KEPT] if one.score >= LEAST_SCORE]


def turning_by_names(columns: Sequence[Candidate]) -> Turning | None:
    """Speed and yaw rate by name, where no lateral acceleration ties them together; None without one of them."""
    named, units = {}, {}
    for channel in ("vx", "yaw_rate"):
        pool = [one for one in _pool(columns, channel) if channel in one.hints]
        if not pool:
            return None
        named[channel] = column = max(pool, key=lambda one: (one.hints[channel], not is_filtered(one.name), bool(one.unit)))
        offered = column.units(channel)
        units[channel] = next((unit for unit in offered if _is_plausible(column, channel, unit)), offered[0])
    is_one = named["vx"] is named["yaw_rate"]
    return None if is_one else Turning(named, units, all(one.unit for one in named.values()))


def _centred(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Signals (C, T) about their means, and their standard deviations, (C,)."""
    rows = rows - rows.mean(axis=1, keepdims=True)
    return rows, np.sqrt(np.mean(np.square(rows), axis=1))


def _pool(columns: Sequence[Candidate], channel: str) -> list[Candidate]:
    """Columns that could be a channel, those whose names suggest it first."""
    own = [one for one in columns if one.measures(channel) and "other" not in one.hints and not one.is_wheel]
    own = [one for one in own if channel in one.hints or all(one.hints.get(other) != STRONG for other in FOLLOWING)]
    own = [one for one in own if channel != "vx" or _is_forward(one.slow)]
    return sorted(own, key=lambda one: -(one.hints.get(channel) or (-1.0 if one.hints else NAMELESS)))[:MOST_COLUMNS]


def _is_forward(slow: FloatArray) -> bool:
    """Whether a column is of one sign but for a little, as the speed of a car is."""
    bound = 0.1 * float(np.abs(slow).max())
    return bound > 0.0 and min(float(np.mean(slow < -bound)), float(np.mean(slow > bound))) < 0.02


def _is_plausible(column: Candidate, channel: str, unit: str) -> bool:
    low, high = RANGES[channel]
    return low <= largest(column.slow) * si_factor(unit, channel) <= high


def _scored(columns: Sequence[Candidate], named: Mapping[str, Candidate], agreeing: float, scale: float) -> Turning:
    """With the units that explain best a scale of ay over vx·yaw_rate in the file's units, and the score of all evidence."""
    ranked = []
    for units in product(*(column.units(channel) for channel, column in named.items())):
        speed, rate, acceleration = (si_factor(unit, channel) for unit, channel in zip(units, named, strict=True))
        left = scale / (speed * rate / acceleration)
        implausible = sum(not _is_plausible(column, channel, unit) for (channel, column), unit in zip(named.items(), units, strict=True))
        rare = 0.0 if named["vx"].unit else RARE.get(units[0], 0.0)
        ranked.append((abs(math.log(left)) + rare + implausible, abs(math.log(left)), units, left, implausible))
    ranked.sort()
    cost, mismatch, units, left, implausible = ranked[0]
    decided = mismatch < FAR and (len(ranked) == 1 or ranked[1][0] - cost > APART)
    score = 12.0 * (abs(agreeing) - LEAST_CORRELATION) / (1.0 - LEAST_CORRELATION)
    for channel, one in named.items():
        score += one.hint(channel) + (1.5 if one.unit else 0.0) - 0.5 * is_filtered(one.name)
        if channel not in one.hints and any(channel in other.hints for other in columns):
            score -= UNNAMED
    score -= 0.5 * is_reference(named["ay"].name) + 5.0 * implausible
    level = np.abs(named["vx"].slow)
    if float(np.std(level)) < 0.05 * float(np.mean(level)) and "vx" not in named["vx"].hints:
        score -= 2.0
    score += 3.0 if mismatch < CLOSE else 1.0 if mismatch < FAR else -5.0
    return Turning(named, dict(zip(named, units, strict=True)), decided, agreeing, left, score)
