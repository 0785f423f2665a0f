"""The extended Kalman filter over `TyreTrack`, compiled: one pass with analytic Jacobians.

For each sample, with A = ∂f/∂x, H = ∂h/∂x (the readable definition of f and h in torch is
`vehest.vehicle.tyre_track`):

    x⁻ = f(x, u),  P⁻ = A P Aᵀ + Δt B Λ Bᵀ                       `_move`, `_propagate`, `_add_noise`
    e = y - h(x⁻),  S = H P⁻ Hᵀ + R,  K = P⁻ Hᵀ S⁻¹               `_innovate`, `_gain`
    x = x⁻ + K e,  P = (I - K H) P⁻ (I - K H)ᵀ + K R Kᵀ           `_reduce`

Order of sums: over states in order of their index; P is made symmetric after prediction and update.

The derivatives are those of Di Biase, Lenzo & Timpone 2020, Eqs. 28 to 36 and 58 and the appendix,
with respect to logarithms of the tyre parameters and derived anew, since several lines of the
printed ones are damaged.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from vehest.filters.gating import refuses
from vehest.filters.kalman_scan import make_symmetric
from vehest.vehicle.rational_tyres import rational_axle

_axle = numba.njit(rational_axle)  # `rational_axle`, compiled


@numba.njit(cache=True, error_model="numpy")
def scan(samples, track, variances, bounds, start_tyre_covariance, restart, gate, state, out):
    """Filter samples of yaw_rate, vx, ay, steer, (T, 4); NaN in yaw_rate and ay is skipped.

    Below the minimum speed wheels roll without slip: β = a_R δ/L, r = u δ/L, and tyre parameters
    stay. States are β, r, β', r', the logarithms of the adapted tyre parameters and, optionally,
    the pull of a crossfall b = g sin φ [m/s²]:

        β'⁺ = (F_F + F_R)/(M u) - r + b/u,   a_y = u (β' + r) - b,   b⁺ = b

    Parameters
    ----------
    samples
        (T, 4).
    track
        Mass, yaw inertia, a_F and a_R; tyre parameters in the order of `TYRE_PARAMETERS`, (5,);
        which of them are states, (p,), p = n - 4, or n - 5 where the last state is b; Δt [s]; the
        minimum speed [m/s]; and the lateral acceleration |u r| below which the states from the
        fifth on stay [m/s²].
    variances
        Of yaw rate, ay, and, a second, of the steering angle and the states from the fifth on,
        (n - 1,).
    bounds
        Largest absolute value of each state, (n,).
    start_tyre_covariance
        Covariance of the logarithms of the adapted parameters at the start, (p, p).
    restart
        Sideslip angle [rad] beyond which motion and tyres restart, the motion as that of a car that
        rolls; variance of β [rad²] beyond which the motion alone restarts, since without
        measurements the model may be unstable; and variances of the first four states of a car that
        rolls, (4,).
    gate
        Its deviations squared, inf: none; its patience in samples; and how often in a row yaw rate
        and ay were refused before the first sample, (2,), after the last one on return.
    state
        Mean (n,) and covariance (n, n) at the first sample before its measurement; at the last
        sample after it on return.
    out
        Means and deviations of states, (T, n) each, covariance of β and r, (T, 2, 2), innovation,
        (T, 2), its covariance, (T, 2, 2), and what was measured, (T, 2).
    """
    car, nominal, adapted, step, minimum_speed, adapt_above = track
    (max_sideslip, lost_variance, rolling) = restart
    (limit, patience, refused) = gate
    (mean, cov) = state
    means, deviations, sideslip_cov, innovation, innovation_cov, measured = out
    n = len(mean)
    tyres = 4 + len(adapted)
    product = np.empty((n, n))
    gain = np.empty((n, 2))
    cross = np.empty((n, 2))
    per_rate = np.zeros(n)
    per_turn = np.zeros(n)
    parameters = nominal.copy()
    for k in range(len(samples)):
        vx = samples[k, 1]
        steer = samples[k, 3]
        if vx < minimum_speed:
            roll_without_slip(mean, cov, rolling, car, vx, steer)
            _record(k, mean, cov, means, deviations, sideslip_cov)
            innovation[k] = 0.0
            measured[k] = False
            innovation_cov[k] = np.eye(2)
            continue
        if k > 0:
            speed = max(samples[k - 1, 1], minimum_speed)
            for i, index in enumerate(adapted):
                parameters[index] = nominal[index] * math.exp(mean[4 + i])
            front = _move(
                mean, car, parameters, adapted, speed, samples[k - 1, 3], step, per_rate, per_turn
            )
            _propagate(cov, per_rate, per_turn, step, product)
            _add_noise(cov, front, car, speed, step, variances, abs(speed * mean[1]) >= adapt_above)
            _clip(mean, bounds)
            if not abs(mean[0]) < max_sideslip:
                roll_without_slip(mean, cov, rolling, car, vx, steer)
                mean[4:tyres] = 0.0
                cov[4:tyres, 4:tyres] = start_tyre_covariance
            elif not cov[0, 0] < lost_variance:
                roll_without_slip(mean, cov, rolling, car, vx, steer)
        holds_tyres = abs(vx * mean[1]) < adapt_above
        _innovate(
            mean,
            cov,
            samples[k],
            tyres < n,
            variances,
            limit,
            patience,
            refused,
            cross,
            innovation[k],
            innovation_cov[k],
            measured[k],
        )
        _gain(cross, innovation_cov[k], holds_tyres, gain)
        for i in range(n):
            mean[i] += gain[i, 0] * innovation[k, 0] + gain[i, 1] * innovation[k, 1]
        _clip(mean, bounds)
        _reduce(cov, gain, cross, vx, tyres < n, variances, measured[k], product)
        _record(k, mean, cov, means, deviations, sideslip_cov)


@numba.njit(inline="always")
def _move(mean, car, parameters, adapted, speed, steer, step, per_rate, per_turn):
    """f: mean one step later, in place; writes the rows of A for β' and r', returns the front
    axle's force and slopes.

    With c = 1/(M u) and slopes F' = ∂F/∂α:

        ∂β'/∂β = -(F_F' + F_R') c,   ∂β'/∂r = (a_R F_R' - a_F F_F') c/u - 1
        ∂r'/∂β = (a_R F_R' - a_F F_F')/J,   ∂r'/∂r = -(a_F² F_F' + a_R² F_R')/(J u)
    """
    mass, inertia, front_arm, rear_arm = car
    turn = mean[1] / speed
    front = _axle(steer - mean[0] - front_arm * turn, parameters[0], parameters[1], parameters[4])
    rear = _axle(-mean[0] + rear_arm * turn, parameters[2], parameters[3], parameters[4])
    along = 1.0 / (mass * speed)
    per_rate[0] = -(front.per_slip + rear.per_slip) * along
    per_rate[1] = (rear_arm * rear.per_slip - front_arm * front.per_slip) / speed * along - 1.0
    per_turn[0] = (rear_arm * rear.per_slip - front_arm * front.per_slip) / inertia
    per_turn[1] = -(
        front_arm * front_arm * front.per_slip + rear_arm * rear_arm * rear.per_slip
    ) / (inertia * speed)
    for i, index in enumerate(adapted):
        by_front = 0.0
        by_rear = 0.0
        if index == 0:
            by_front = front.per_log_c1
        elif index == 1:
            by_front = front.per_log_c2
        elif index == 2:
            by_rear = rear.per_log_c1
        elif index == 3:
            by_rear = rear.per_log_c2
        else:
            by_front = front.per_log_friction
            by_rear = rear.per_log_friction
        per_rate[4 + i] = (by_front + by_rear) * along
        per_turn[4 + i] = (front_arm * by_front - rear_arm * by_rear) / inertia
    rate = (front.force + rear.force) * along - mean[1]
    if len(mean) > 4 + len(adapted):
        per_rate[-1] = 1.0 / speed
        rate += mean[-1] / speed
    acceleration = (front_arm * front.force - rear_arm * rear.force) / inertia
    mean[0] += step * mean[2]
    mean[1] += step * mean[3]
    mean[2] = rate
    mean[3] = acceleration
    return front


@numba.njit(inline="always")
def _propagate(cov, per_rate, per_turn, step, product):
    """Propagate the covariance, P ← A P Aᵀ, in place.

    β and r are moved by their rates, β' and r' come from all states, tyre parameters stay.
    """
    n = len(cov)
    for j in range(n):  # A P
        product[0, j] = cov[0, j] + step * cov[2, j]
        product[1, j] = cov[1, j] + step * cov[3, j]
        first = 0.0
        second = 0.0
        for i in range(n):
            first += per_rate[i] * cov[i, j]
            second += per_turn[i] * cov[i, j]
        product[2, j] = first
        product[3, j] = second
        for i in range(4, n):
            product[i, j] = cov[i, j]
    for i in range(n):
        cov[i, 0] = product[i, 0] + step * product[i, 2]
        cov[i, 1] = product[i, 1] + step * product[i, 3]
        first = 0.0
        second = 0.0
        for j in range(n):
            first += product[i, j] * per_rate[j]
            second += product[i, j] * per_turn[j]
        cov[i, 2] = first
        cov[i, 3] = second
        for j in range(4, n):
            cov[i, j] = product[i, j]


@numba.njit(inline="always")
def _add_noise(cov, front, car, speed, step, variances, wandering):
    """Add the process noise Q = Δt B Λ Bᵀ of the steering angle and, if ``wandering``, of the tyre
    parameters to the covariance, in place; Eqs. 41 to 45.
    """
    rate = front.per_slip * (1.0 / (car[0] * speed))
    acceleration = car[2] * front.per_slip / car[1]
    spread = step * variances[2]
    cov[2, 2] += spread * rate * rate
    cov[2, 3] += spread * rate * acceleration
    cov[3, 2] += spread * rate * acceleration
    cov[3, 3] += spread * acceleration * acceleration
    if wandering:
        for i in range(4, len(cov)):
            cov[i, i] += step * variances[i - 1]
    make_symmetric(cov)


@numba.njit(inline="always")
def _innovate(
    mean,
    cov,
    sample,
    crossfall,
    variances,
    limit,
    patience,
    refused,
    cross,
    innovation,
    S,
    measured,
):
    """Write the innovations of yaw rate and ay, their covariance S, and P Hᵀ into ``cross``.

    For a value that was not measured or is refused by the gate these are 0, the identity's row and
    0.
    """
    vx = sample[1]
    for i in range(len(mean)):
        cross[i, 0] = cov[i, 1]
        cross[i, 1] = vx * (cov[i, 2] + cov[i, 1])
        if crossfall:
            cross[i, 1] -= cov[i, -1]
    ay = vx * (mean[2] + mean[1])
    spread_of_ay = vx * (cross[2, 1] + cross[1, 1])
    if crossfall:
        ay = ay - mean[-1]
        spread_of_ay = spread_of_ay - cross[-1, 1]
    for j in range(2):
        value = sample[0] if j == 0 else sample[2]
        measured[j] = not math.isnan(value)
        expected = mean[1] if j == 0 else ay
        if measured[j] and limit < math.inf:
            spread = cross[1, 0] if j == 0 else spread_of_ay
            measured[j] = not refuses(
                value - expected, spread + variances[j], limit, patience, refused, j
            )
        innovation[j] = value - expected if measured[j] else 0.0
        if not measured[j]:
            cross[:, j] = 0.0
    S[0, 0] = cross[1, 0] + variances[0] if measured[0] else 1.0
    S[1, 1] = spread_of_ay + variances[1] if measured[1] else 1.0
    S[0, 1] = cross[1, 1] if measured[0] and measured[1] else 0.0
    S[1, 0] = S[0, 1]


@numba.njit(inline="always")
def _gain(cross, S, holds_tyres, gain):
    """Write the gain K = P Hᵀ S⁻¹; the rows of tyre parameters are 0 where these stay."""
    determinant = S[0, 0] * S[1, 1] - S[0, 1] * S[0, 1]
    for i in range(len(gain)):
        gain[i, 0] = (cross[i, 0] * S[1, 1] - cross[i, 1] * S[0, 1]) / determinant
        gain[i, 1] = (cross[i, 1] * S[0, 0] - cross[i, 0] * S[0, 1]) / determinant
    if holds_tyres:
        gain[4:] = 0.0


@numba.njit(inline="always")
def _reduce(cov, gain, cross, vx, crossfall, variances, measured, product):
    """Update the covariance, P ← (I - K H) P (I - K H)ᵀ + K R Kᵀ, in place and row by row.

    This is Joseph's form, which holds for any gain.
    """
    n = len(cov)
    for i in range(n):
        for j in range(n):
            product[i, j] = cov[i, j] - gain[i, 0] * cross[j, 0] - gain[i, 1] * cross[j, 1]
    for i in range(n):
        rate_covariance = product[i, 1]
        ay_covariance = vx * (product[i, 2] + product[i, 1])
        if crossfall:
            ay_covariance -= product[i, -1]
        for j in range(n):
            total = product[i, j]
            if measured[0]:
                total += (gain[i, 0] * variances[0] - rate_covariance) * gain[j, 0]
            if measured[1]:
                total += (gain[i, 1] * variances[1] - ay_covariance) * gain[j, 1]
            cov[i, j] = total
    make_symmetric(cov)


@numba.njit(inline="always")
def roll_without_slip(mean, cov, rolling, car, vx, steer):
    """Set the motion to that of a car that rolls, with variances ``rolling``, independent of all
    else.
    """
    turn = steer / (car[2] + car[3])
    mean[0] = car[3] * turn
    mean[1] = vx * turn
    mean[2] = 0.0
    mean[3] = 0.0
    for i in range(4):
        cov[i, :] = 0.0
        cov[:, i] = 0.0
    for i in range(4):
        cov[i, i] = rolling[i]


@numba.njit(inline="always")
def _record(k, mean, cov, means, deviations, sideslip_cov):
    """Write mean, deviations and the covariance of β and r of sample k."""
    means[k] = mean
    for i in range(len(mean)):
        deviations[k, i] = math.sqrt(max(cov[i, i], 0.0))
    for i in range(2):
        for j in range(2):
            sideslip_cov[k, i, j] = cov[i, j]


@numba.njit(inline="always")
def _clip(mean, bounds):
    """Clip states to ±bounds, in place."""
    for i in range(len(mean)):
        mean[i] = min(max(mean[i], -bounds[i]), bounds[i])
