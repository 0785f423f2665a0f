"""Wheel speeds: which wheel by its name, unit and radius by the speed or, without one, by ay over the yaw rate."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from vehest.alignment.proposals.agreement import Known
from vehest.alignment.proposals.columns import Candidate, correlation, slow_of
from vehest.alignment.proposals.names import AY, SPEED, WEAK, YAW_RATE
from vehest.alignment.proposals.proposal import Proposal
from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.units import factor_to_si

USUAL_RADIUS = 0.31  # m, of cars
NOMINAL_RADIUS = 0.3  # m, by which a speed at the rim is brought to rad/s and back
RADII = (0.2, 0.55)
SMALL_RADII = (0.02, 0.2)  # of models, which are not fast
FASTEST_MODEL, FASTEST = 20.0, 110.0  # m/s
SLOWEST = 1.0
UNITS = ("km/h", "m/s", "rpm", "rad/s")
TOLERANCE = 0.12  # logarithm, of a speed at the rim
APART = 0.25
MEAN = "mean of the wheels"


@dataclass(frozen=True)
class Wheels:
    """Columns that are named as wheel speeds.

    Args:
        columns: corner -> index.
        stand_in: index of their mean, where it stands for the speed.
        unit: what a wheel speed is in, where its mean stands for the speed.
        radius: that goes with it [m].
    """

    columns: Mapping[str, int]
    stand_in: set[int] = field(default_factory=set)

    def __bool__(self) -> bool:
        return bool(self.columns)

    def turning_left(self, columns: Sequence[Candidate], known: Known) -> float:
        """Correlation of the yaw rate with how much faster the right wheels are; 0 where one side is missing."""
        best = 0.0
        for left, right in (("fl", "fr"), ("rl", "rr")):
            if {left, right} <= set(self.columns):
                ahead = columns[self.columns[right]].slow - columns[self.columns[left]].slow
                rate = slow_of(known.yaw_rate, known.rate_hz)[: len(ahead)]
                own = correlation(ahead[: len(rate)], rate)
                best = own if abs(own) > abs(best) else best
        return best


def find_wheels(columns: Sequence[Candidate]) -> Wheels:
    """Columns that are named for a wheel each; of several for one, the first."""
    found: dict[str, int] = {}
    for place, column in enumerate(columns):
        for role in column.hints:
            if role.startswith("wheel_speed_") and (_is_speed(column.unit) or not column.unit):
                found.setdefault(role.removeprefix("wheel_speed_"), place)
    return Wheels(found)


def _is_speed(unit: str) -> bool:
    for si in ("m/s", "rad/s"):
        try:
            factor_to_si(unit, si)
        except DataError:
            continue
        return unit != "deg/s"
    return False


def with_wheels_for_speed(columns: list[Candidate], wheels: Wheels, rate_hz: float) -> list[Candidate]:
    """The columns, and where none may be a speed, the mean of the wheels in m/s behind them.

    Unit and radius are those that make ay = vx·yaw_rate with the likeliest columns of these.
    """
    if not wheels or any(SPEED in column.hints for column in columns):
        return columns
    mean = np.mean([columns[k].values for k in wheels.columns.values()], axis=0)
    unit, radius = unit_without_speed(columns, wheels, mean)
    factor = factor_to_si(unit, "m/s") if unit in ("km/h", "m/s") else radius * factor_to_si(unit, "rad/s")
    speed = np.asarray(mean * factor, dtype=np.float64)
    wheels.stand_in.add(len(columns))
    return [*columns, Candidate(MEAN, "m/s", speed, slow_of(speed, rate_hz), 0.0, {SPEED: WEAK})]


def unit_without_speed(columns: Sequence[Candidate], wheels: Wheels, mean: FloatArray) -> tuple[str, float]:
    """The wheels' unit, and a radius [m], by the columns that are named yaw rate and lateral acceleration."""
    told = columns[next(iter(wheels.columns.values()))].unit
    rate = max((one for one in columns if YAW_RATE in one.hints), key=lambda one: one.hints[YAW_RATE], default=None)
    ay = max((one for one in columns if AY in one.hints), key=lambda one: one.hints[AY], default=None)
    ranked = []
    for unit, of_rate, of_ay in product([told] if told else UNITS, ("rad/s", "deg/s"), ("m/s²", "g")):
        radius = 1.0
        if rate is not None and ay is not None:
            turning = slow_like(mean, rate) * rate.slow * factor_to_si(of_rate if not rate.unit else rate.unit, "rad/s")
            sizes = [float(np.std(ay.slow)) * factor_to_si(of_ay if not ay.unit else ay.unit, "m/s²"), float(np.std(turning))]
            radius = sizes[0] / sizes[1] if sizes[1] > 0.0 else math.nan
        cost, fitted = _cost(unit, radius, mean, known=rate is not None and ay is not None)
        if rate is not None:
            largest = float(np.quantile(np.abs(rate.slow), 0.99)) * factor_to_si(of_rate if not rate.unit else rate.unit, "rad/s")
            cost += 0.0 if 0.02 <= largest <= 8.0 else 3.0
        ranked.append((cost, unit, fitted))
    best = min(ranked)
    return best[1], best[2]


def slow_like(values: FloatArray, other: Candidate) -> FloatArray:
    """Values thinned out as a column's slow samples are."""
    every = max(round(len(values) / max(len(other.slow), 1)), 1)
    return values[::every][: len(other.slow)]


def _cost(unit: str, scale: float, mean: FloatArray, *, known: bool) -> tuple[float, float]:
    """How little a unit explains a scale of m/s over the column, and the radius that goes with it."""
    top = float(np.quantile(np.abs(mean), 0.99))
    if unit in ("km/h", "m/s"):
        factor = factor_to_si(unit, "m/s")
        fast = SLOWEST <= top * factor <= FASTEST
        return (abs(math.log(scale / factor)) if known else 0.5) + 3.0 * (not fast), NOMINAL_RADIUS
    radius = scale / factor_to_si(unit, "rad/s") if known else USUAL_RADIUS
    if not math.isfinite(radius) or radius <= 0.0:
        return 10.0, USUAL_RADIUS
    speed = top * factor_to_si(unit, "rad/s") * radius
    low, high = RADII if speed > FASTEST_MODEL else (SMALL_RADII[0], RADII[1])
    odd = 0.0 if low <= radius <= high else 3.0
    return 0.15 * abs(math.log(radius / USUAL_RADIUS)) + odd + 3.0 * (not SLOWEST <= speed <= FASTEST), radius


def wheel_proposals(
    columns: Sequence[Candidate], wheels: Wheels, known: Known | None, *, made_speed: bool
) -> tuple[list[Proposal], float | None]:
    """A channel each, and the rolling radius by which they make the speed; None where it is not wanted.

    Args:
        columns: of the log.
        wheels: those that are wheels.
        known: the motion, for the speed.
        made_speed: whether the speed is to be made of them.
    """
    mean = np.asarray(np.mean([columns[k].values for k in wheels.columns.values()], axis=0), dtype=np.float64)
    told = columns[next(iter(wheels.columns.values()))].unit
    if known is None:
        unit, radius, asked = told, NOMINAL_RADIUS, "" if told else "nothing to compare the wheels with"
        unit = unit or "rad/s"
    else:
        size = float(np.sqrt(np.mean(np.square(mean)))) or 1.0
        scale = float(np.sqrt(np.mean(np.square(known.vx)))) / size
        ranked = sorted((*_cost(unit, scale, mean, known=True), unit) for unit in ([told] if told else UNITS))
        unit, radius = ranked[0][2], ranked[0][1]
        asked = f"could be in {ranked[1][2]} as well" if len(ranked) > 1 and ranked[1][0] - ranked[0][0] < APART else ""
    at_rim = unit in ("km/h", "m/s")
    if at_rim and known is not None and not wheels.stand_in:
        radius = NOMINAL_RADIUS * scale / factor_to_si(unit, "m/s")
    factor = factor_to_si(unit, "m/s") / NOMINAL_RADIUS if at_rim else 1.0
    text: tuple[str, ...] = ("its name",)
    if known is not None:
        whose = "ay over the yaw rate" if wheels.stand_in else "the speed"
        text += (f"{unit} at the rim by {whose}" if at_rim else f"a radius of {radius:.3g} m by {whose} in {unit}",)
    found = [
        Proposal(
            columns[k].name,
            f"wheel_speed_{corner}",
            "rad/s" if at_rim else unit,
            1,
            text,
            asked,
            factor=float(f"{factor:.7g}"),
            others=(UNITS if asked else ()),
        )
        for corner, k in sorted(wheels.columns.items())
    ]
    return found, (float(f"{radius:.3g}") if made_speed else None)
