"""The paper's filters with one more state: the pull of a crossfall, b = g sin φ, which enters motion and accelerometer.

    β'⁺ = (F_F + F_R)/(M u) - r + b/u,   a_y = u (β' + r) - b,   b⁺ = b

All else is `vehest.estimators.rational_ekf`, guards included, which it agrees with where b is known to be nothing; it is two to three times
as fast, since it notes means alone, so that the twin runs all filters through it. The single track of Di Biase, Lenzo &
Timpone 2020 has no such state; their outlook names bank angles.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from vehest.constants import FloatArray
from vehest.estimators.rational_ekf import LOST, ROLLING, RationalFilter
from vehest.vehicle.rational_tyres import rational_axle
from vehest.vehicle.tyre_track import TYRE_PARAMETERS

DEVIATION = 0.2  # m/s², standard deviation of b at the start: 1.2° of crossfall
WANDER = 0.002  # m/s² √s⁻¹, by which it drifts: 0.1° in a minute
FIRST_TYRE = 5  # of the state's elements


def filtered(estimator: RationalFilter, samples: FloatArray, deviation: float = DEVIATION, wander: float = WANDER) -> FloatArray:
    """States (β, r, β', r', b, θ…) after each sample, (T, n), of samples of the estimator's channels, (T, 4), all fast enough for it.

    Args:
        estimator: whose car, curves, levels of noise and bounds are taken.
        samples: yaw_rate, vx, ay, steer.
        deviation: standard deviation of b at the start [m/s²].
        wander: of its drift [m/s² √s⁻¹].
    """
    levels, first = estimator.values, estimator.first_gaussian(samples[0], {})
    place = [0, 1, 2, 3, *range(FIRST_TYRE, FIRST_TYRE + len(estimator.adapted))]
    mean, covariance, bound = (
        np.zeros(FIRST_TYRE + len(estimator.adapted)),
        np.zeros((len(place) + 1,) * 2),
        np.full(len(place) + 1, math.inf),
    )
    mean[place], covariance[np.ix_(place, place)], bound[place] = first.mean, first.covariance, estimator.bounds()
    covariance[4, 4] = deviation**2
    means = np.empty((len(samples), len(mean)))
    car = estimator.car
    _scan(
        np.ascontiguousarray(samples),
        np.array([car.mass, car.yaw_inertia, car.cg_to_front_axle, car.cg_to_rear_axle], dtype=np.float64),
        np.array([*estimator.axle_curves, 1.0]),
        np.array([TYRE_PARAMETERS.index(name) for name in estimator.adapted], dtype=np.int64),
        np.square([levels["yaw_rate"], levels["ay"], levels["steer"], levels["tyres"], wander]),
        bound,
        np.square(ROLLING),
        estimator.start_tyres(),
        estimator.largest_sideslip,
        LOST**2,
        1.0 / estimator.rate_hz,
        mean,
        covariance,
        means,
    )
    return means


_axle = numba.njit(rational_axle)


@numba.njit(cache=True, error_model="numpy")
def _scan(samples, car, nominal, adapted, variances, bound, rolling, start_tyres, largest, lost, step, mean, cov, means):  # type: ignore[no-untyped-def]
    """The extended filter in its plain form, measurements one after the other."""
    n = len(mean)
    slope, left, cross = np.zeros((n, n)), np.empty((n, n)), np.empty(n)
    parameters = nominal.copy()
    for i in range(n):
        slope[i, i] = 1.0
    slope[0, 2] = slope[1, 3] = step
    slope[2, 2] = slope[3, 3] = 0.0
    for k in range(len(samples)):
        if k > 0:
            for i, index in enumerate(adapted):
                parameters[index] = nominal[index] * math.exp(mean[5 + i])
            spread = _move(mean, car, parameters, adapted, samples[k - 1, 1], samples[k - 1, 3], step, slope)
            _spread(cov, slope, left)
            for i in range(2, 4):
                for j in range(2, 4):
                    cov[i, j] += step * variances[2] * spread[i - 2] * spread[j - 2]
            cov[4, 4] += step * variances[4]
            for i in range(5, n):
                cov[i, i] += step * variances[3]
            _clip(mean, bound)
            if not abs(mean[0]) < largest:
                _roll(mean, cov, rolling, car, samples[k, 1], samples[k, 3])
                mean[5:], cov[5:, 5:] = 0.0, start_tyres
            elif not cov[0, 0] < lost:
                _roll(mean, cov, rolling, car, samples[k, 1], samples[k, 3])
        for which in range(2):
            u = samples[k, 1]
            for i in range(n):
                cross[i] = cov[i, 1] if which == 0 else u * (cov[i, 2] + cov[i, 1]) - cov[i, 4]
            expected = mean[1] if which == 0 else u * (mean[2] + mean[1]) - mean[4]
            seen = cross[1] if which == 0 else u * (cross[2] + cross[1]) - cross[4]
            total = seen + variances[which]
            error = samples[k, 0 if which == 0 else 2] - expected
            for i in range(n):
                mean[i] += cross[i] / total * error
                for j in range(n):
                    cov[i, j] -= cross[i] * cross[j] / total
        _clip(mean, bound)
        means[k] = mean


@numba.njit(cache=True, error_model="numpy")
def _clip(mean, bound):  # type: ignore[no-untyped-def]
    for i in range(len(mean)):
        mean[i] = min(max(mean[i], -bound[i]), bound[i])


@numba.njit(cache=True, error_model="numpy")
def _roll(mean, cov, rolling, car, u, steer):  # type: ignore[no-untyped-def]
    """The motion of a car that rolls without slip; what is known of road and tyres stays."""
    turn = steer / (car[2] + car[3])
    mean[0], mean[1], mean[2], mean[3] = car[3] * turn, u * turn, 0.0, 0.0
    for i in range(4):
        cov[i, :] = 0.0
        cov[:, i] = 0.0
        cov[i, i] = rolling[i]


@numba.njit(cache=True, error_model="numpy")
def _move(mean, car, parameters, adapted, u, steer, step, slope):  # type: ignore[no-untyped-def]
    """Mean one step later, in place; writes the rows of A for β' and r', returns what a steering angle changes those by."""
    mass, inertia, front_arm, rear_arm = car
    turn = mean[1] / u
    front = _axle(steer - mean[0] - front_arm * turn, parameters[0], parameters[1], parameters[4])
    rear = _axle(rear_arm * turn - mean[0], parameters[2], parameters[3], parameters[4])
    slope[2, 0] = -(front.per_slip + rear.per_slip) / (mass * u)
    slope[2, 1] = (rear_arm * rear.per_slip - front_arm * front.per_slip) / (mass * u * u) - 1.0
    slope[2, 4] = 1.0 / u
    slope[3, 0] = (rear_arm * rear.per_slip - front_arm * front.per_slip) / inertia
    slope[3, 1] = -(front_arm * front_arm * front.per_slip + rear_arm * rear_arm * rear.per_slip) / (inertia * u)
    for i, index in enumerate(adapted):
        by_front = front.per_log_c1 if index == 0 else (front.per_log_c2 if index == 1 else 0.0)
        by_rear = rear.per_log_c1 if index == 2 else (rear.per_log_c2 if index == 3 else 0.0)
        slope[2, 5 + i] = (by_front + by_rear) / (mass * u)
        slope[3, 5 + i] = (front_arm * by_front - rear_arm * by_rear) / inertia
    rate = (front.force + rear.force) / (mass * u) - mean[1] + mean[4] / u
    acceleration = (front_arm * front.force - rear_arm * rear.force) / inertia
    mean[0] += step * mean[2]
    mean[1] += step * mean[3]
    mean[2], mean[3] = rate, acceleration
    return front.per_slip / (mass * u), front_arm * front.per_slip / inertia


@numba.njit(cache=True, error_model="numpy")
def _spread(cov, slope, left):  # type: ignore[no-untyped-def]
    """A P Aᵀ, in place: rows 0 and 1 of A have two elements, 2 and 3 all but those of their own rates, the others one."""
    n = len(cov)
    for j in range(n):
        left[0, j] = cov[0, j] + slope[0, 2] * cov[2, j]
        left[1, j] = cov[1, j] + slope[1, 3] * cov[3, j]
        first, second = 0.0, 0.0
        for i in range(n):
            first += slope[2, i] * cov[i, j]
            second += slope[3, i] * cov[i, j]
        left[2, j], left[3, j] = first, second
        for i in range(4, n):
            left[i, j] = cov[i, j]
    for i in range(n):
        cov[i, 0] = left[i, 0] + slope[0, 2] * left[i, 2]
        cov[i, 1] = left[i, 1] + slope[1, 3] * left[i, 3]
        first, second = 0.0, 0.0
        for j in range(n):
            first += left[i, j] * slope[2, j]
            second += left[i, j] * slope[3, j]
        cov[i, 2], cov[i, 3] = first, second
        for j in range(4, n):
            cov[i, j] = left[i, j]
    for i in range(n):
        for j in range(i):
            cov[i, j] = cov[j, i] = 0.5 * (cov[i, j] + cov[j, i])
