"""The extended Kalman filter over `TyreTrack`, compiled: analytic Jacobians, one pass over a recording.

The derivatives are those of Di Biase, Lenzo & Timpone 2020, Eqs. 28 to 36 and 58 and the appendix, with respect to logarithms of the tyre
parameters and derived anew, since several lines of the printed ones are damaged.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from vehest.vehicle.rational_tyres import rational_axle

LOST = 1.0  # rad, standard deviation of a sideslip angle of which nothing is known any more

_axle = numba.njit(rational_axle)


@numba.njit(cache=True, error_model="numpy")
def scan(  # type: ignore[no-untyped-def]
    samples,
    car,
    nominal,
    adapted,
    variances,
    lower,
    upper,
    rolling,
    step,
    minimum_speed,
    adapt_above,
    mean,
    cov,
    means,
    deviations,
    sideslip_cov,
    innovation,
    innovation_cov,
    measured,
):
    """Filter samples of yaw_rate, vx, ay, steer, (T, 4); NaN in yaw_rate and ay is skipped.

    Below the minimum speed wheels roll without slip: β = a_R δ/L, r = u δ/L, with variances ``rolling``, and tyre parameters are held.

    Args:
        samples: (T, 4).
        car: mass, yaw inertia, a_F, a_R.
        nominal: tyre parameters in the order of `TYRE_PARAMETERS`, (5,).
        adapted: which of them are states, (n - 4,).
        variances: of yaw rate, ay, steering angle · √s, and the adapted parameters a second, (3 + n - 4,).
        lower: of states, (n,).
        upper: of states, (n,).
        rolling: variances of the first four states of a car that rolls, (4,).
        step: Δt [s].
        minimum_speed: [m/s].
        adapt_above: lateral acceleration |u r| below which tyre parameters are held [m/s²].
        mean: at the first sample before its measurement, (n,); at the last sample after it on return.
        cov: likewise, (n, n).
        means: out, (T, n).
        deviations: out, (T, n).
        sideslip_cov: out, of β and r, (T, 2, 2).
        innovation: out, (T, 2).
        innovation_cov: out, (T, 2, 2).
        measured: out, (T, 2).
    """
    n = len(mean)
    mass, inertia, front_arm, rear_arm = car
    left, gain, cross = np.empty((n, n)), np.empty((n, 2)), np.empty((n, 2))
    per_rate, per_turn = np.zeros(n), np.zeros(n)  # derivatives of β' and r' one step later
    parameters = nominal.copy()
    for k in range(len(samples)):
        vx, steer = samples[k, 1], samples[k, 3]
        if vx < minimum_speed:
            _roll(mean, cov, rolling, rear_arm * steer / (front_arm + rear_arm), vx * steer / (front_arm + rear_arm))
            _note(k, mean, cov, means, deviations, sideslip_cov)
            innovation[k], measured[k] = 0.0, False
            innovation_cov[k] = np.eye(2)
            continue
        if k > 0:
            speed, before = max(samples[k - 1, 1], minimum_speed), samples[k - 1, 3]
            for i, index in enumerate(adapted):
                parameters[index] = nominal[index] * math.exp(mean[4 + i])
            turn = mean[1] / speed
            front = _axle(before - mean[0] - front_arm * turn, parameters[0], parameters[1], parameters[4])
            rear = _axle(-mean[0] + rear_arm * turn, parameters[2], parameters[3], parameters[4])
            along = 1.0 / (mass * speed)
            per_rate[0] = -(front.per_slip + rear.per_slip) * along
            per_rate[1] = (rear_arm * rear.per_slip - front_arm * front.per_slip) / speed * along - 1.0
            per_turn[0] = (rear_arm * rear.per_slip - front_arm * front.per_slip) / inertia
            per_turn[1] = -(front_arm * front_arm * front.per_slip + rear_arm * rear_arm * rear.per_slip) / (inertia * speed)
            for i, index in enumerate(adapted):
                by_front, by_rear = 0.0, 0.0
                if index == 0:
                    by_front = front.per_log_c1
                elif index == 1:
                    by_front = front.per_log_c2
                elif index == 2:
                    by_rear = rear.per_log_c1
                elif index == 3:
                    by_rear = rear.per_log_c2
                else:
                    by_front, by_rear = front.per_log_friction, rear.per_log_friction
                per_rate[4 + i] = (by_front + by_rear) * along
                per_turn[4 + i] = (front_arm * by_front - rear_arm * by_rear) / inertia
            rate = (front.force + rear.force) * along - mean[1]
            acceleration = (front_arm * front.force - rear_arm * rear.force) / inertia
            mean[0] += step * mean[2]
            mean[1] += step * mean[3]
            mean[2], mean[3] = rate, acceleration
            for j in range(n):  # A P
                left[0, j] = cov[0, j] + step * cov[2, j]
                left[1, j] = cov[1, j] + step * cov[3, j]
                first, second = 0.0, 0.0
                for i in range(n):
                    first += per_rate[i] * cov[i, j]
                    second += per_turn[i] * cov[i, j]
                left[2, j], left[3, j] = first, second
                for i in range(4, n):
                    left[i, j] = cov[i, j]
            for i in range(n):  # A P Aᵀ
                cov[i, 0] = left[i, 0] + step * left[i, 2]
                cov[i, 1] = left[i, 1] + step * left[i, 3]
                first, second = 0.0, 0.0
                for j in range(n):
                    first += left[i, j] * per_rate[j]
                    second += left[i, j] * per_turn[j]
                cov[i, 2], cov[i, 3] = first, second
                for j in range(4, n):
                    cov[i, j] = left[i, j]
            rate, acceleration = front.per_slip * along, front_arm * front.per_slip / inertia
            spread = step * variances[2]
            cov[2, 2] += spread * rate * rate
            cov[2, 3] += spread * rate * acceleration
            cov[3, 2] += spread * rate * acceleration
            cov[3, 3] += spread * acceleration * acceleration
            if abs(vx * mean[1]) >= adapt_above:
                for i in range(4, n):
                    cov[i, i] += step * variances[i - 1]
            _make_symmetric(cov)
            _clip(mean, lower, upper)
            if not cov[0, 0] < LOST * LOST:  # without measurements the model may be unstable: begin anew
                _roll(mean, cov, rolling, mean[0], mean[1])
        for i in range(n):
            cross[i, 0] = cov[i, 1]
            cross[i, 1] = vx * (cov[i, 2] + cov[i, 1])
        for j in range(2):
            value = samples[k, 0] if j == 0 else samples[k, 2]
            measured[k, j] = not math.isnan(value)
            expected = mean[1] if j == 0 else vx * (mean[2] + mean[1])
            innovation[k, j] = value - expected if measured[k, j] else 0.0
            if not measured[k, j]:
                cross[:, j] = 0.0
        S = innovation_cov[k]
        S[0, 0] = cross[1, 0] + variances[0] if measured[k, 0] else 1.0
        S[1, 1] = vx * (cross[2, 1] + cross[1, 1]) + variances[1] if measured[k, 1] else 1.0
        S[0, 1] = cross[1, 1] if measured[k, 0] and measured[k, 1] else 0.0
        S[1, 0] = S[0, 1]
        determinant = S[0, 0] * S[1, 1] - S[0, 1] * S[0, 1]
        for i in range(n):
            gain[i, 0] = (cross[i, 0] * S[1, 1] - cross[i, 1] * S[0, 1]) / determinant
            gain[i, 1] = (cross[i, 1] * S[0, 0] - cross[i, 0] * S[0, 1]) / determinant
        if abs(vx * mean[1]) < adapt_above:
            gain[4:] = 0.0
        for i in range(n):
            mean[i] += gain[i, 0] * innovation[k, 0] + gain[i, 1] * innovation[k, 1]
        _clip(mean, lower, upper)
        for i in range(n):  # (I - K H) P (I - K H)ᵀ + K R Kᵀ, row by row
            for j in range(n):
                left[i, j] = cov[i, j] - gain[i, 0] * cross[j, 0] - gain[i, 1] * cross[j, 1]
        for i in range(n):
            seen_rate, seen_ay = left[i, 1], vx * (left[i, 2] + left[i, 1])
            for j in range(n):
                total = left[i, j]
                if measured[k, 0]:
                    total += (gain[i, 0] * variances[0] - seen_rate) * gain[j, 0]
                if measured[k, 1]:
                    total += (gain[i, 1] * variances[1] - seen_ay) * gain[j, 1]
                cov[i, j] = total
        _make_symmetric(cov)
        _note(k, mean, cov, means, deviations, sideslip_cov)


@numba.njit(inline="always")
def _roll(mean, cov, rolling, sideslip, yaw_rate):  # type: ignore[no-untyped-def]
    mean[0], mean[1], mean[2], mean[3] = sideslip, yaw_rate, 0.0, 0.0
    for i in range(4):
        cov[i, :] = 0.0
        cov[:, i] = 0.0
    for i in range(4):
        cov[i, i] = rolling[i]


@numba.njit(inline="always")
def _note(k, mean, cov, means, deviations, sideslip_cov):  # type: ignore[no-untyped-def]
    means[k] = mean
    for i in range(len(mean)):
        deviations[k, i] = math.sqrt(max(cov[i, i], 0.0))
    for i in range(2):
        for j in range(2):
            sideslip_cov[k, i, j] = cov[i, j]


@numba.njit(inline="always")
def _clip(mean, lower, upper):  # type: ignore[no-untyped-def]
    for i in range(len(mean)):
        mean[i] = min(max(mean[i], lower[i]), upper[i])


@numba.njit(inline="always")
def _make_symmetric(matrix):  # type: ignore[no-untyped-def]
    for i in range(len(matrix)):
        for j in range(i):
            matrix[i, j] = matrix[j, i] = 0.5 * (matrix[i, j] + matrix[j, i])
