"""Wheel speeds: corner by name, unit and radius by the speed or, without one, by ay over the yaw
rate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np

from vehest.alignment.motion import Motion, rms
from vehest.alignment.proposals.columns import (
    Candidate,
    correlation,
    is_unit_of,
    largest,
    si_factor,
    slow_of,
)
from vehest.alignment.proposals.names import WEAK
from vehest.alignment.proposals.proposal import Proposal, Proposals
from vehest.alignment.proposals.turning import RANGES
from vehest.constants import FloatArray

USUAL_RADIUS = 0.31  # m, rolling radius of a usual car
NOMINAL_RADIUS = 0.3  # m, radius by which a speed at the rim is converted to rad/s and back
# m, smallest and largest radius of cars; a unit that gives another one is implausible
RADIUS_RANGE = (0.2, 0.55)
MIN_MODEL_RADIUS = 0.02  # m, smallest radius of models up to MAX_MODEL_SPEED
MAX_MODEL_SPEED = 20.0  # m/s, highest speed of the wheels of a model
MAX_SPEED = 110.0  # m/s, highest top speed; a unit that gives a higher one is implausible
MIN_TOP_SPEED = 1.0  # m/s, lowest top speed; a unit that gives a lower one is implausible
# unit that is tried where the header states none -> its cost; a rare one only if no other fits
UNIT_PENALTIES = {
    **dict.fromkeys(("km/h", "m/s", "rpm", "rad/s"), 0.0),
    "mph": 0.2,
    **dict.fromkeys(("cm/s", "mm/s", "ft/s", "0.01*km/h", "rev/s", "deg/s"), 1.0),
}
# smallest difference of the cost of the next best unit with which the user is not asked
MIN_COST_MARGIN = 0.25
IMPLAUSIBLE = 3.0  # cost of a unit that gives an impossible speed or radius
MAX_RIM_MISMATCH = 0.3  # largest |logarithm| of the ratio of a speed at the rim to that of the car
PREFIX = "wheel_speed_"  # start of the channels of wheel speeds
# smallest and largest ratio of a speedometer to the wheels' speed at the rim: none reads too
# little, many too much
SPEEDOMETER_GAIN_RANGE = (
    0.98,
    1.08,
)

Wheels = Mapping[str, Candidate]  # corner -> the column that is named as its speed


def find_wheels(columns: Sequence[Candidate]) -> tuple[Wheels, list[str]]:
    """Columns that are named for one wheel each, the first where there are several; and notes on
    those that are left out for their unit.
    """
    wheels: dict[str, Candidate] = {}
    left_out: dict[str, list[str]] = {}
    for column in columns:
        if not column.is_wheel:
            continue
        role = next(iter(column.hints))
        unit = _header_unit(wheels)
        problem = ""
        if not column.measures("vx") and not column.measures(role):
            problem = "the unit is of no speed"
        elif unit and column.unit not in ("", unit):
            problem = f"another wheel is in {unit}"
        if problem:
            left_out.setdefault(problem, []).append(f"{role}: {{column: '{column.name}'")
        else:
            wheels.setdefault(role.removeprefix(PREFIX), column)
    notes = [
        f"named like wheel speeds and left out, since {problem}: to add one, write "
        + ", ".join(f"{entry}, unit: rad/s, factor: …}}" for entry in entries)
        + " below channels in the data set"
        for problem, entries in left_out.items()
    ]
    return wheels, notes


def turning_left(wheels: Wheels, motion: Motion) -> float:
    """Correlation of the yaw rate with the excess of the right wheels' speed; 0 where one side is
    missing.

    Parameters
    ----------
    wheels : Wheels
        Corner -> column.
    motion : Motion
        With the yaw rate.

    Returns
    -------
    float
        Of the axle that decides more clearly; positive where the yaw rate is positive to the left.
    """
    rate = slow_of(motion["yaw_rate"], motion.rate_hz)
    axles = [
        (wheels[left].slow, wheels[right].slow)
        for left, right in (("fl", "fr"), ("rl", "rr"))
        if {left, right} <= set(wheels)
    ]
    return max((correlation(right - left, rate) for left, right in axles), key=abs, default=0.0)


def speed_of_wheels(
    columns: Sequence[Candidate], wheels: Wheels, rate_hz: float
) -> list[Candidate]:
    """The mean of the wheels in m/s, where no column may be a speed, by the unit and radius that
    make ay = vx·yaw_rate.

    Returns
    -------
    list of Candidate
        One, or none.
    """
    if not wheels or any("vx" in column.hints for column in columns):
        return []
    mean = _mean(wheels)
    rate, ay = (_named(columns, channel) for channel in ("yaw_rate", "ay"))
    ranked = []
    for unit, rate_unit, ay_unit in product(
        _units_of(wheels), rate.units("yaw_rate") if rate else [""], ay.units("ay") if ay else [""]
    ):
        implausible = False
        scale = None
        if rate:
            turning = rate.slow * si_factor(rate_unit, "yaw_rate")
            implausible = not RANGES["yaw_rate"][0] <= largest(turning) <= RANGES["yaw_rate"][1]
        if rate and ay:
            step = max(round(len(mean) / max(len(rate.slow), 1)), 1)
            size = float(np.std(mean[::step][: len(turning)] * turning))
            scale = (
                float(np.std(ay.slow)) * si_factor(ay_unit, "ay") / size if size > 0.0 else math.nan
            )
        cost, radius = _cost(unit, scale, mean)
        ranked.append((cost + _penalty(wheels, unit) + IMPLAUSIBLE * implausible, unit, radius))
    _, unit, radius = min(ranked)
    factor = (
        si_factor(unit, "vx")
        if is_unit_of(unit, "vx")
        else radius * si_factor(unit, "wheel_speed_fl")
    )
    speed = mean * factor
    slow = slow_of(speed, rate_hz)
    return [Candidate("mean of the wheels", "m/s", speed, slow, {"vx": WEAK}, is_wheel_mean=True)]


def wheel_proposals(
    wheels: Wheels, motion: Motion | None, *, has_speed: bool, is_wheel_mean: bool
) -> tuple[list[Proposal], float | None]:
    """Proposals of a channel for each wheel, and the rolling radius by which they make the speed,
    if it has no column.

    Parameters
    ----------
    wheels : Wheels
        Corner -> column, at least one.
    motion : Motion or None
        Whose speed decides the unit; None where it is not known.
    has_speed : bool
        Whether a column is the speed.
    is_wheel_mean : bool
        Whether the motion's speed was made of the wheels.

    Returns
    -------
    tuple
        Proposals in rad/s or rpm, a speed at the rim brought to rad/s by NOMINAL_RADIUS; and the
        radius [m], None where there is a column of the speed.
    """
    mean = _mean(wheels)
    units = _units_of(wheels)
    evidence = ["name"]
    radius = NOMINAL_RADIUS
    is_weak = False
    if motion is None:
        unit = units[0]
        question = ""
        if len(units) > 1:
            unit = "rad/s"
            question = "unit: there is no speed to compare it with"
    else:
        scale = rms(motion.vx) / (rms(mean) or 1.0)
        costs = [(*_cost(unit, scale, mean), unit) for unit in units]
        ranked = sorted(
            (cost + _penalty(wheels, unit), radius, unit) for cost, radius, unit in costs
        )
        cost, radius, unit = ranked[0]
        question = ""
        if cost >= IMPLAUSIBLE:
            question = f"unit: in {unit} it does not agree with the speed"
            is_weak = len(units) > 1
        elif len(ranked) > 1 and ranked[1][0] - cost < MIN_COST_MARGIN:
            question = f"unit: {ranked[1][2]} fits equally well"
        if is_unit_of(unit, "vx") and not is_wheel_mean:
            radius = NOMINAL_RADIUS * scale / si_factor(unit, "vx")
        source = "ay/yaw_rate" if is_wheel_mean else "the speed"
        evidence += [
            f"circumferential speed in {unit}, compared with {source}"
            if is_unit_of(unit, "vx")
            else f"in {unit} with a radius of {radius:.3g} m, compared with {source}"
        ]
    factor = 1.0
    if is_unit_of(unit, "vx"):
        factor = float(f"{si_factor(unit, 'vx') / NOMINAL_RADIUS:.7g}")
        unit = "rad/s"
    alternatives = tuple(UNIT_PENALTIES) if question else ()
    proposals = [
        Proposal(
            column.name,
            f"{PREFIX}{corner}",
            unit,
            1,
            tuple(evidence),
            question,
            factor=factor,
            alternatives=alternatives,
            is_weak=is_weak,
        )
        for corner, column in sorted(wheels.items())
    ]
    return proposals, None if has_speed else float(f"{radius:.3g}")


def wheels_over_speed(wheels: Wheels, proposals: Proposals, speed: FloatArray) -> float | None:
    """Speed of the wheels at the rim over a speed [m/s]; None where they are in no unit of a speed
    at the rim.
    """
    pairs = [
        (wheel.slow, proposals.by_channel.get(f"{PREFIX}{corner}"))
        for corner, wheel in wheels.items()
    ]
    at_rim = [
        slow * NOMINAL_RADIUS * proposal.factor
        for slow, proposal in pairs
        if proposal is not None and proposal.factor != 1.0
    ]
    return rms(np.mean(at_rim, axis=0)) / rms(speed) if at_rim else None


def _mean(wheels: Wheels) -> FloatArray:
    """Mean of the wheels' columns in the file's unit, (T,)."""
    return np.asarray(
        np.mean([column.values for column in wheels.values()], axis=0), dtype=np.float64
    )


def _header_unit(wheels: Wheels) -> str:
    """The first unit that a header states; empty where none does."""
    return next((column.unit for column in wheels.values() if column.unit), "")


def _units_of(wheels: Wheels) -> Sequence[str]:
    """The header's unit, or those to try."""
    unit = _header_unit(wheels)
    return [unit] if unit else tuple(UNIT_PENALTIES)


def _penalty(wheels: Wheels, unit: str) -> float:
    """Cost of a unit that no header states, relative to the likelier ones."""
    return 0.0 if _header_unit(wheels) else UNIT_PENALTIES[unit]


def _named(columns: Sequence[Candidate], channel: str) -> Candidate | None:
    """The column whose name suggests a channel most clearly; None where none does."""
    named = [column for column in columns if channel in column.hints and column.measures(channel)]
    return max(named, key=lambda column: column.hints[channel], default=None)


def _cost(unit: str, scale: float | None, mean: FloatArray) -> tuple[float, float]:
    """Cost of a unit for a scale of m/s over the column, if it is known, and the radius that goes
    with it.
    """
    top = largest(mean)
    if is_unit_of(unit, "vx"):
        factor = si_factor(unit, "vx")
        mismatch = 0.5 if scale is None else abs(math.log(scale / factor))
        low, high = SPEEDOMETER_GAIN_RANGE
        if scale is not None and low < scale / factor < high:
            mismatch = 0.0
        is_other_speed = scale is not None and mismatch > MAX_RIM_MISMATCH
        is_odd = is_other_speed or not MIN_TOP_SPEED <= top * factor <= MAX_SPEED
        return mismatch + IMPLAUSIBLE * is_odd, NOMINAL_RADIUS
    factor = si_factor(unit, "wheel_speed_fl")
    radius = USUAL_RADIUS if scale is None else scale / factor
    if not math.isfinite(radius) or radius <= 0.0:
        return 10.0, USUAL_RADIUS
    speed = top * factor * radius
    low, high = RADIUS_RANGE if speed > MAX_MODEL_SPEED else (MIN_MODEL_RADIUS, RADIUS_RANGE[1])
    n_odd = (not low <= radius <= high) + (not MIN_TOP_SPEED <= speed <= MAX_SPEED)
    return 0.15 * abs(math.log(radius / USUAL_RADIUS)) + IMPLAUSIBLE * n_odd, radius
