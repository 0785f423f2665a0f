"""Speed, yaw rate and lateral acceleration, tied together by ay ≈ vx·yaw_rate: they are looked for first, and their units with them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from vehest.alignment.proposals.columns import Candidate
from vehest.alignment.proposals.names import AY, HANDWHEEL, LATERAL_VELOCITY, OTHER, SIDESLIP, SPEED, STEER, STRONG, YAW_RATE
from vehest.constants import FloatArray
from vehest.data.units import factor_to_si

LEAST_CORRELATION = 0.75
UNITS = {SPEED: ("m/s", "km/h", "mph", "knots"), YAW_RATE: ("rad/s", "deg/s"), AY: ("m/s²", "g")}
RARE = {"mph": 0.1, "knots": 0.2}  # added to a mismatch
CLOSE, FAR = 0.3, 0.6  # logarithms of a scale: within, units explain it; beyond, they do not
APART = 0.2  # by which the next best units must be worse
RANGES = {SPEED: (0.5, 110.0), YAW_RATE: (0.02, 8.0), AY: (0.3, 60.0)}  # of the 99th percentile, SI
MOST_COLUMNS = 60
MOST_KEPT = 8
LEAST_SCORE = 6.0
FOLLOWING = frozenset({STEER, HANDWHEEL, LATERAL_VELOCITY, SIDESLIP})
"""What follows a turn at an even speed as an acceleration does, but for its scale; so a name that is clear decides."""
UNNAMED = 3.0  # of score, for a column that no name speaks for where one speaks for another
NAMELESS = 0.5  # rank of a column whose name says nothing


@dataclass(frozen=True)
class Units:
    """Units in which speed, yaw rate and lateral acceleration agree.

    Args:
        speed: of the speed.
        yaw_rate: of the yaw rate.
        ay: of the lateral acceleration.
        mismatch: logarithm of what is left of the scale.
        decided: whether no others explain it as well.
    """

    speed: str
    yaw_rate: str
    ay: str
    mismatch: float
    decided: bool


@dataclass(frozen=True, eq=False)
class Turning:
    """Three columns that may be speed, yaw rate and lateral acceleration.

    Args:
        speed: index of the column.
        yaw_rate: likewise.
        ay: likewise; -1 where there is none, and names alone tell of the other two.
        correlation: of ay with speed·yaw_rate, with its sign.
        scale: ay over speed·yaw_rate in the file's units, positive.
        units: that explain the scale.
        score: of all evidence.
    """

    speed: int
    yaw_rate: int
    ay: int
    correlation: float
    scale: float
    units: Units
    score: float


def find_turning(columns: Sequence[Candidate]) -> list[Turning]:
    """Triples that may be speed, yaw rate and lateral acceleration, the best first."""
    pools = {role: _pool(columns, role) for role in UNITS}
    if not all(pools.values()):
        return []
    found = []
    accelerations = np.stack([columns[k].slow for k in pools[AY]])
    accelerations = accelerations - accelerations.mean(axis=1, keepdims=True)
    sizes = np.sqrt(np.mean(np.square(accelerations), axis=1))
    for s in pools[SPEED]:
        rates = np.stack([columns[k].slow for k in pools[YAW_RATE]]) * columns[s].slow
        rates = rates - rates.mean(axis=1, keepdims=True)
        scales = np.sqrt(np.mean(np.square(rates), axis=1))
        with np.errstate(all="ignore"):
            agreeing = np.nan_to_num((rates @ accelerations.T) / accelerations.shape[1] / np.outer(scales, sizes))
        for i, j in zip(*np.nonzero(np.abs(agreeing) >= LEAST_CORRELATION), strict=True):
            r, a = pools[YAW_RATE][i], pools[AY][j]
            if len({s, r, a}) == 3:
                scale = float(sizes[j] / scales[i])
                found.append(_scored(columns, (s, r, a), float(agreeing[i, j]), scale))
    return [one for one in sorted(found, key=lambda one: -one.score)[:MOST_KEPT] if one.score >= LEAST_SCORE]


def turning_by_names(columns: Sequence[Candidate]) -> Turning | None:
    """Speed and yaw rate by name, where no lateral acceleration ties them together; None where one has none."""
    named = {}
    for role in (SPEED, YAW_RATE):
        pool = [k for k in _pool(columns, role) if role in columns[k].hints]
        if not pool:
            return None
        named[role] = max(pool, key=lambda k: (columns[k].hints[role], not columns[k].is_filtered, bool(columns[k].unit), -k))
    if named[SPEED] == named[YAW_RATE]:
        return None
    units = []
    for role, k in named.items():
        low, high = RANGES[role]
        fitting = [unit for unit in UNITS[role] if low <= extent(columns[k], unit, factor_unit(role)) <= high]
        units.append(columns[k].unit or (fitting or [UNITS[role][0]])[0])
    decided = all(columns[k].unit for k in named.values())
    return Turning(named[SPEED], named[YAW_RATE], -1, 0.0, 0.0, Units(units[0], units[1], "m/s²", 0.0, decided), 0.0)


def _pool(columns: Sequence[Candidate], role: str) -> list[int]:
    """Columns that could have a role, those that are named for it first."""
    si = factor_unit(role)
    own = [k for k, one in enumerate(columns) if one.measures(si) and OTHER not in one.hints and not _is_wheel(one)]
    own = [k for k in own if role in columns[k].hints or not _follows(columns[k])]
    if role == SPEED:
        own = [k for k in own if _forward(columns[k].slow)]
    own.sort(key=lambda k: -(columns[k].hints.get(role) or (-1.0 if columns[k].hints else NAMELESS)))
    return own[:MOST_COLUMNS]


def factor_unit(role: str) -> str:
    """SI unit of a role."""
    return UNITS[role][0]


def _is_wheel(one: Candidate) -> bool:
    return any(role.startswith("wheel_speed") for role in one.hints)


def _follows(one: Candidate) -> bool:
    """Whether a column's name says clearly that it follows the turning, and is none of the three."""
    return any(role in FOLLOWING and strength == STRONG for role, strength in one.hints.items())


def _forward(slow: FloatArray) -> bool:
    """Whether a column is of one sign but for a little, as the speed of a car is."""
    largest = float(np.abs(slow).max())
    backwards = min(float(np.mean(slow < -0.1 * largest)), float(np.mean(slow > 0.1 * largest)))
    return largest > 0.0 and backwards < 0.02


def _scored(columns: Sequence[Candidate], triple: tuple[int, int, int], agreeing: float, scale: float) -> Turning:
    named = dict(zip(UNITS, (columns[k] for k in triple), strict=True))
    units = explained(named, scale)
    score = 12.0 * (abs(agreeing) - LEAST_CORRELATION) / (1.0 - LEAST_CORRELATION)
    score += sum(one.hint(role) + (1.5 if one.unit else 0.0) - 0.5 * one.is_filtered for role, one in named.items())
    score -= 0.5 * named[AY].is_reference
    for role, one in named.items():
        if role not in one.hints and any(role in other.hints for other in columns):
            score -= UNNAMED
    level = np.abs(named[SPEED].slow)
    score -= 2.0 if float(np.std(level)) < 0.05 * float(np.mean(level)) and SPEED not in named[SPEED].hints else 0.0
    score += 3.0 if units.mismatch < CLOSE else 1.0 if units.mismatch < FAR else -5.0
    for role, unit in zip(UNITS, (units.speed, units.yaw_rate, units.ay), strict=True):
        low, high = RANGES[role]
        score -= 0.0 if low <= extent(named[role], unit, factor_unit(role)) <= high else 5.0
    return Turning(*triple, agreeing, scale, units, score)


def extent(one: Candidate, unit: str, si_unit: str) -> float:
    """How large a column gets, in SI units."""
    return float(np.quantile(np.abs(one.slow), 0.99)) * factor_to_si(unit, si_unit)


def explained(named: dict[str, Candidate], scale: float) -> Units:
    """The units that explain a scale of ay over speed·yaw_rate; those of the header where it says."""
    offered = [(named[role].unit,) if named[role].unit else units for role, units in UNITS.items()]
    ranked = []
    for speed, yaw_rate, ay in product(*offered):
        expected = factor_to_si(speed, "m/s") * factor_to_si(yaw_rate, "rad/s") / factor_to_si(ay, "m/s²")
        mismatch = abs(math.log(scale / expected)) if scale > 0.0 else math.inf
        implausible = sum(
            not RANGES[role][0] <= extent(named[role], unit, factor_unit(role)) <= RANGES[role][1]
            for role, unit in zip(UNITS, (speed, yaw_rate, ay), strict=True)
        )
        rare = sum(RARE.get(unit, 0.0) for unit in (speed, yaw_rate, ay) if not named[SPEED].unit)
        ranked.append((mismatch + rare + 1.0 * implausible, mismatch, speed, yaw_rate, ay))
    ranked.sort()
    best = ranked[0]
    rival = ranked[1][0] if len(ranked) > 1 else math.inf
    return Units(best[2], best[3], best[4], best[1], best[1] < FAR and rival - best[0] > APART)
