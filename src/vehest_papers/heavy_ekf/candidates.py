"""Candidates on the twin: the paper's three filters, each with and without a state of crossfall, oracle tyres and three baselines."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import optimize
from scipy.stats import qmc

from vehest.constants import FloatArray
from vehest.estimators.data_sheet import DataSheet
from vehest.estimators.rational_ekf import AxleCurves, RationalFilter, TrackNoise, Tyres
from vehest.estimators.recursive import Recursive
from vehest.estimators.static_map import StaticMap
from vehest.vehicle.parameters import SingleTrackParameters
from vehest_papers.heavy_ekf import crossfall_filter, paper
from vehest_papers.heavy_ekf.twin import CURVES, NOISE, RATE, TRUCK, Conditions, Drive, drive

ORACLE = "oracle tyres"
ZERO = "zero"
STATIC_MAP = "static map"
DATA_SHEET = "data sheet"
WITH_STATE = ", crossfall state"
KINDS: dict[str, Tyres] = {
    paper.LINT: "linear",
    paper.RATT: "rational",
    paper.RATTE: "rational_adaptive",
}
FILTERS = (*KINDS, *(f"{name}{WITH_STATE}" for name in KINDS))
SKIP = 30  # samples, 1.5 s, that are not scored, as in the study's other drives
BOX = {"ay": (-4.0, 4.0), "steer": (-6.0, 4.0), "tyres": (-8.0, 2.0)}
"""Powers of ten that the search may take: σ_ay [m/s²], σ_δ [rad √s], wander of the logarithms of tyre parameters [1/√s]."""
DEVIATION = (
    0.26  # of these logarithms at the start: the rms of ln(1 + mismatch) over the cells of the map
)
DRAWN = 128
REFINED = 3
EVALUATIONS = 80  # points of the box, how many of the best are refined, and evaluations of each
TUNING_SECONDS = 60.0
EDGE = 0.02  # of a box's width: nearer to its end than this the search ended on it
TUNED_SLIPS = (2.5, 4.5, 6.5)
TUNED_MISMATCHES = (-0.25, -0.05, 0.15)
FIRST_TUNING_SEED = 1000


@dataclass(frozen=True)
class Levels:
    """What was tuned for a filter, once for all cells."""

    ay: float  # σ_ay [m/s²]
    steer: float  # σ_δ [rad √s]
    tyres: float = 1e-3  # wander of the logarithms of tyre parameters [1/√s]


@dataclass(frozen=True)
class Tuned:
    """Outcome of a search."""

    levels: Levels  # the best
    cost: float  # geometric mean of RMSE(β) over the tuning drives [deg]
    evaluations: int  # of all tuning drives
    at_limits: Mapping[
        str, float
    ]  # level that ended on a limit of the box -> by how much the cost changes a decade inwards [%]


def estimator_of(
    name: str, levels: Levels, curves: FloatArray, car: SingleTrackParameters = TRUCK
) -> RationalFilter:
    """A filter by its name in the report, whose tyres start from curves, c₁ and c₂ of both axles, (4,)."""
    tyres: Tyres = "rational" if name == ORACLE else KINDS[name.removesuffix(WITH_STATE)]
    c1_front, c2_front, c1_rear, c2_rear = curves.tolist()
    if tyres == "linear":
        given = AxleCurves(c2_front=c2_front, c2_rear=c2_rear, deviation=DEVIATION)
    else:
        given = AxleCurves(c1_front, c2_front, c1_rear, c2_rear, DEVIATION)
    noise = TrackNoise(
        NOISE["yaw_rate"], levels.ay, levels.steer, levels.tyres if tyres != "rational" else None
    )
    return RationalFilter(
        RationalFilter.settings_type(
            rate_hz=RATE, car=car, minimum_speed=2.0, tyres=tyres, curves=given, noise=noise
        )
    )


def mistaken(mismatch: float) -> FloatArray:
    """The plant's curves with cornering stiffnesses that are off by a part of them, (4,)."""
    return CURVES * np.array([1.0, 1.0 + mismatch, 1.0, 1.0 + mismatch])


def states_of(
    name: str, levels: Levels, own: Drive, curves: FloatArray, car: SingleTrackParameters = TRUCK
) -> FloatArray:
    """States along a drive: β first, tyre parameters from the fifth on, the pull of a crossfall last, (T, n)."""
    estimator = estimator_of(name, levels, curves, car)
    if name.endswith(WITH_STATE):
        return crossfall_filter.filtered(estimator, own.samples)
    return estimator.filter_samples(own.samples).mean


def oracle(levels: Levels, own: Drive) -> FloatArray:
    """β of RATT that knows the plant's tyres, their loads and the friction at each sample, (T,), but not the payload's mass."""
    changes = np.flatnonzero(np.diff(own.friction)) + 1
    found = np.empty(len(own.friction))
    state = None
    for begin, end in itertools.pairwise([0, *changes.tolist(), len(own.friction)]):
        before = 1 if begin else 0  # one more sample, whose measurements the state holds already
        rows = own.samples[begin - before : end].copy()
        rows[:before, [0, 2]] = np.nan
        estimator = estimator_of(ORACLE, levels, own.plant.curves(float(own.friction[begin])))
        filtered = estimator.filter_samples(rows, state)
        found[begin:end] = filtered.mean[before:, 0]
        state = filtered.last
    return found


def baselines(tuning: Sequence[Drive]) -> dict[str, Callable[[Drive], FloatArray]]:
    """Name -> β of a drive, (T,): nothing, the static map of the tuning drives, and the data sheet."""
    recordings = [own.recording for own in tuning]
    fitted = StaticMap(StaticMap.settings_type(RATE))
    fitted.values = fitted.closed_form(recordings)
    front = float(TRUCK.cg_to_front_axle)
    rear = float(TRUCK.cg_to_rear_axle)
    sheet = DataSheet(
        DataSheet.settings_type(rate_hz=RATE, wheelbase=front + rear, cg_to_rear_axle=rear)
    )

    def of(baseline: Recursive) -> Callable[[Drive], FloatArray]:
        return lambda own: np.arctan2(
            baseline.run(own.samples[:, [1, 0]], None)[0]["vy"], own.samples[:, 1]
        )  # vx, yaw_rate

    return {
        ZERO: lambda own: np.zeros(len(own.sideslip)),
        STATIC_MAP: of(fitted),
        DATA_SHEET: of(sheet),
    }


def tuning_drives(*, plain: bool = False) -> list[tuple[float, Drive]]:
    """Mismatch and drive of 18 cells between those of the map, on other seeds; ``plain``: without payload, wet patches and crossfall."""
    conditions = (
        [(False, False, False)] if plain else list(itertools.product((False, True), repeat=3))
    )
    found = []
    for number, (slip, mismatch, _) in enumerate(
        itertools.product(TUNED_SLIPS, TUNED_MISMATCHES, range(2))
    ):
        own = Conditions(slip, *conditions[(3 * number) % len(conditions)])
        found.append((mismatch, drive(own, FIRST_TUNING_SEED + number, TUNING_SECONDS)))
    return found


def tuned(name: str, drives: Sequence[tuple[float, Drive]]) -> Tuned:
    """Levels with the smallest geometric mean of RMSE(β) over the tuning drives, so that cells count by percentages, as in the map.

    The gyroscope's level is that of its data sheet, as in the paper. Points are spread over the whole box (Sobol); from the best of them
    Nelder and Mead go on.
    """
    searched = _searched(name)

    def levels(powers: FloatArray) -> Levels:
        return Levels(**dict(zip(searched, (10.0**powers).tolist(), strict=True)))

    def cost(powers: FloatArray) -> float:
        own = levels(powers)
        return float(
            np.mean(
                [
                    math.log(rmse(sideslip_of(name, own, each, mistaken(mismatch)), each))
                    for mismatch, each in drives
                ]
            )
        )

    low, high = np.array([BOX[each] for each in searched]).T
    drawn = low + (high - low) * qmc.Sobol(len(searched), seed=0).random(DRAWN)
    costs = np.array([cost(powers) for powers in drawn])
    found = [
        _refined(cost, drawn[at], low, high) for at in np.argsort(costs, kind="stable")[:REFINED]
    ]
    best = min(found, key=lambda own: float(own.fun))
    at_limits = {}
    for at, each in enumerate(searched):
        if min(best.x[at] - low[at], high[at] - best.x[at]) < EDGE * (high[at] - low[at]):
            inwards = best.x + np.eye(len(searched))[at] * (
                1.0 if best.x[at] - low[at] < high[at] - best.x[at] else -1.0
            )
            at_limits[each] = 100.0 * math.expm1(cost(inwards) - float(best.fun))
    return Tuned(
        levels(best.x),
        math.exp(float(best.fun)),
        DRAWN + sum(int(own.nfev) for own in found),
        at_limits,
    )


def _refined(
    cost: Callable[[FloatArray], float], start: FloatArray, low: FloatArray, high: FloatArray
) -> Any:
    """Nelder and Mead's search from a start, whose first steps are a tenth of the box inwards."""
    simplex = np.tile(start, (len(start) + 1, 1))
    step = 0.1 * (high - low)
    simplex[1:] += np.diag(np.where(start + step <= high, step, -step))
    options = {"maxfev": EVALUATIONS, "xatol": 0.01, "fatol": 1e-4, "initial_simplex": simplex}
    return optimize.minimize(
        cost, start, method="Nelder-Mead", bounds=list(zip(low, high, strict=True)), options=options
    )


def sideslip_of(name: str, levels: Levels, own: Drive, curves: FloatArray) -> FloatArray:
    """β of a filter, (T,)."""
    return oracle(levels, own) if name == ORACLE else states_of(name, levels, own, curves)[:, 0]


def rmse(sideslip: FloatArray, own: Drive) -> float:
    """RMSE(β) of a drive [deg], its first 1.5 s left out (Eq. 65)."""
    return float(np.degrees(np.sqrt(np.mean(np.square(sideslip - own.sideslip)[SKIP:]))))


def table_of(found: Mapping[str, Tuned]) -> list[dict[str, object]]:
    """A row a filter with what was tuned."""
    return [
        {
            "filter": name,
            "ay": own.levels.ay,
            "steer": np.degrees(own.levels.steer),
            "tyres": own.levels.tyres if "tyres" in _searched(name) else np.nan,
            "cost": own.cost,
            "evaluations": own.evaluations,
            "at_limits": "; ".join(
                f"{each} ({change:.2g} % a decade inwards)"
                for each, change in own.at_limits.items()
            )
            or "none",
        }
        for name, own in found.items()
    ]


def _searched(name: str) -> tuple[str, ...]:
    return (
        tuple(BOX)
        if name != ORACLE and KINDS[name.removesuffix(WITH_STATE)] != "rational"
        else ("ay", "steer")
    )
