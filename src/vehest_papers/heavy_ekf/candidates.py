"""The paper's filters, each with and without a crossfall state, baselines, and the search for noise
levels.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize
from scipy.stats import qmc

from vehest.constants import FloatArray
from vehest.data.recording import Recording
from vehest.estimators.rational_ekf import AxleCurves, RationalFilter, TrackNoise, Tyres
from vehest.estimators.static_map import StaticMap
from vehest.vehicle.parameters import SingleTrackParameters
from vehest_papers.heavy_ekf import crossfall_filter, paper
from vehest_papers.heavy_ekf.twin import CURVES, NOISE, RATE, TRUCK, Conditions, drive

ZERO = "zero"
STATIC_MAP = "static map"
WITH_STATE = ", crossfall state"
TYRE_MODELS: dict[str, Tyres] = {
    paper.LINT: "linear",
    paper.RATT: "rational",
    paper.RATTE: "rational_adaptive",
}
FILTERS = (*TYRE_MODELS, *(f"{name}{WITH_STATE}" for name in TYRE_MODELS))
CHANNELS = ("yaw_rate", "vx", "ay", "steer")
SKIP = 30  # samples, 1.5 s, that are not scored, as in the study's other drives
MIN_SPEED = 2.0  # m/s, below which errors are not scored
BOX = {"ay": (-4.0, 4.0), "steer": (-6.0, 4.0), "tyres": (-8.0, 2.0)}
"""Powers of ten that the search may take: σ_ay [m/s²], σ_δ [rad/√s], wander of the logarithms of
tyre parameters [1/√s].
"""
DEVIATION = (
    0.26  # of these logarithms at the start: the rms of ln(1 + mismatch) over the cells of the map
)
N_DRAWN = 32
N_REFINED = 1
MAX_EVALUATIONS = 60
TUNING_SECONDS = 60.0
TUNED_SLIPS = (2.5, 4.5, 6.5)
TUNED_MISMATCHES = (-0.25, -0.05, 0.15)
FIRST_TUNING_SEED = 1000


@dataclass(frozen=True)
class Levels:
    """Noise levels that are tuned."""

    ay: float  # σ_ay [m/s²]
    steer: float  # σ_δ [rad/√s]
    tyres: float = 1e-3  # wander of the logarithms of tyre parameters [1/√s]


@dataclass(frozen=True)
class Tuned:
    """Outcome of a search."""

    levels: Levels  # the best
    cost: float  # geometric mean of RMSE(β) over the tuning drives [deg]
    evaluations: int  # of all tuning drives


@dataclass(frozen=True, eq=False)
class MeasuredDrive:
    """Samples that a filter receives, and what it is scored against.

    Attributes
    ----------
    samples : array, shape (T, 4)
        Yaw rate [rad/s], speed [m/s], lateral acceleration [m/s²] and steering angle [rad].
    sideslip : array, shape (T,)
        Reference [rad].
    is_scored : array, shape (T,)
    curves : array, shape (4,)
        c₁ and c₂ of the front and of the rear axle that the filter starts from.
    car : SingleTrackParameters
        That the filter assumes.
    """

    samples: FloatArray
    sideslip: FloatArray
    is_scored: NDArray[np.bool_]
    curves: FloatArray
    car: SingleTrackParameters = TRUCK

    def squared_error(self, sideslip: FloatArray) -> FloatArray:
        """Squared error of an estimate [deg²], 0 where it is not scored, (T,)."""
        return np.where(self.is_scored, np.square(np.degrees(sideslip - self.sideslip)), 0.0)

    def rmse(self, sideslip: FloatArray) -> float:
        """RMSE(β) of an estimate (Eq. 65) [deg]."""
        return math.sqrt(float(self.squared_error(sideslip).sum()) / int(self.is_scored.sum()))


def measured_drive(
    recording: Recording, curves: FloatArray, car: SingleTrackParameters = TRUCK
) -> MeasuredDrive:
    """A recording with its reference; neither its first 1.5 s nor slow samples are scored."""
    is_scored = recording["vx"] >= MIN_SPEED
    is_scored[:SKIP] = False
    samples = recording.stack(list(CHANNELS))
    return MeasuredDrive(samples, recording["sideslip_ref"], is_scored, curves, car)


def estimator_of(
    name: str, levels: Levels, curves: FloatArray, car: SingleTrackParameters = TRUCK
) -> RationalFilter:
    """A filter by its name in the report, whose tyres start from curves, c₁ and c₂ of both axles,
    (4,).
    """
    tyres = TYRE_MODELS[name.removesuffix(WITH_STATE)]
    c1_front, c2_front, c1_rear, c2_rear = curves.tolist()
    if tyres == "linear":
        initial = AxleCurves(c2_front=c2_front, c2_rear=c2_rear, deviation=DEVIATION)
    else:
        initial = AxleCurves(c1_front, c2_front, c1_rear, c2_rear, DEVIATION)
    noise = TrackNoise(
        NOISE["yaw_rate"], levels.ay, levels.steer, levels.tyres if tyres != "rational" else None
    )
    return RationalFilter(
        RationalFilter.settings_type(
            rate_hz=RATE, car=car, minimum_speed=MIN_SPEED, tyres=tyres, curves=initial, noise=noise
        )
    )


def mistaken(mismatch: float) -> FloatArray:
    """The twin's curves with cornering stiffnesses that are off by a part of them, (4,)."""
    return CURVES * np.array([1.0, 1.0 + mismatch, 1.0, 1.0 + mismatch])


def states_of(name: str, levels: Levels, measured: MeasuredDrive) -> FloatArray:
    """States along a drive: β first, tyre parameters from the fifth on, the pull of a crossfall
    last, (T, n).
    """
    estimator = estimator_of(name, levels, measured.curves, measured.car)
    if name.endswith(WITH_STATE):
        return crossfall_filter.filtered(estimator, measured.samples)
    return estimator.filter_samples(measured.samples).mean


def sideslip_of(name: str, levels: Levels, measured: MeasuredDrive) -> FloatArray:
    """β of a filter [rad], (T,)."""
    return states_of(name, levels, measured)[:, 0]


def baselines(training: Sequence[Recording]) -> dict[str, Callable[[MeasuredDrive], FloatArray]]:
    """Name -> β of a drive, (T,): zero, and the static map that is fitted to recordings."""
    fitted = StaticMap(StaticMap.settings_type(RATE))
    fitted.values = fitted.closed_form(training)

    def of_map(measured: MeasuredDrive) -> FloatArray:
        speed = measured.samples[:, 1]
        vy = fitted.run(measured.samples[:, [1, 0]], None)[0]["vy"]
        return np.arctan2(vy, np.maximum(speed, MIN_SPEED))

    return {ZERO: lambda measured: np.zeros(len(measured.sideslip)), STATIC_MAP: of_map}


def tuning_drives(*, plain: bool = False) -> list[MeasuredDrive]:
    """18 drives of the twin between the cells of the map, on other seeds; ``plain``: without
    payload, wet patches and crossfall.
    """
    roads = [(False, False, False)] if plain else list(itertools.product((False, True), repeat=3))
    measured = []
    for number, (slip, mismatch, _) in enumerate(
        itertools.product(TUNED_SLIPS, TUNED_MISMATCHES, range(2))
    ):
        conditions = Conditions(slip, *roads[(3 * number) % len(roads)])
        recording = drive(conditions, FIRST_TUNING_SEED + number, TUNING_SECONDS).recording
        measured.append(measured_drive(recording, mistaken(mismatch)))
    return measured


def tuned(name: str, drives: Sequence[MeasuredDrive]) -> Tuned:
    """Noise levels with the smallest geometric mean of RMSE(β) over drives, so that drives count by
    percentages.

    The gyroscope's level is that of its data sheet, as in the paper. Points are spread over the
    whole box (Sobol); the best are refined by Nelder and Mead.
    """
    searched = _searched(name)

    def levels(powers: FloatArray) -> Levels:
        return Levels(**dict(zip(searched, (10.0**powers).tolist(), strict=True)))

    def cost(powers: FloatArray) -> float:
        point = levels(powers)
        errors = [measured.rmse(sideslip_of(name, point, measured)) for measured in drives]
        return float(np.mean(np.log(errors)))

    low, high = np.array([BOX[level] for level in searched]).T
    drawn = low + (high - low) * qmc.Sobol(len(searched), seed=0).random(N_DRAWN)
    costs = np.array([cost(powers) for powers in drawn])
    best_drawn = np.argsort(costs, kind="stable")[:N_REFINED]
    refined = [_refined(cost, drawn[position], low, high) for position in best_drawn]
    best = min(refined, key=lambda result: float(result.fun))
    evaluations = N_DRAWN + sum(int(result.nfev) for result in refined)
    return Tuned(levels(best.x), math.exp(float(best.fun)), evaluations)


def _refined(
    cost: Callable[[FloatArray], float], start: FloatArray, low: FloatArray, high: FloatArray
) -> Any:
    """Nelder and Mead's search from a start, whose first steps are a tenth of the box inwards."""
    simplex = np.tile(start, (len(start) + 1, 1))
    step = 0.1 * (high - low)
    simplex[1:] += np.diag(np.where(start + step <= high, step, -step))
    options = {"maxfev": MAX_EVALUATIONS, "xatol": 0.01, "fatol": 1e-4, "initial_simplex": simplex}
    return optimize.minimize(
        cost, start, method="Nelder-Mead", bounds=list(zip(low, high, strict=True)), options=options
    )


def _searched(name: str) -> tuple[str, ...]:
    """Levels that are searched; fixed tyres do not wander."""
    is_fixed = TYRE_MODELS[name.removesuffix(WITH_STATE)] == "rational"
    return ("ay", "steer") if is_fixed else tuple(BOX)
