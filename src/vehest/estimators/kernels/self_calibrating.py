"""The bank of filters of the self-calibrating estimator and the check that weighs it against others, compiled.

sample -> lags -> each filter: predict, measured speed, rear axle -> weights by likelihood -> residuals of the candidates -> weights -> vy

A state is [v, u, β_y, β_x, κ, b, C, e]: velocities of the inertial unit, offsets of the accelerometer, roll leakage of ay, distance and
compliance of the rear axle, and the axle's correlated error in units of its size.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vehest.constants import FloatArray
from vehest.estimators.kernels.compiling import entry, part

STATES = 8
V, U, OFFSET_Y, OFFSET_X, LEAKAGE, REAR, COMPLIANCE, ERROR = range(STATES)
CANDIDATES = 3  # this bank, the network that comes with vehest, steady cornering with the priors
BANK, NETWORK, STEADY = range(CANDIDATES)
# lagged signals: those of the axle's equation, then those of the candidates' residuals
LAGS = 16
YAW_RATE, AY, AX, SUM_AY, SUM_TURN, SUM_ONE, SPEED, SUM_AY_1, SUM_TURN_1, SUM_AX_1 = range(10)
SLOW_AY, TIME, POWER, PREDICTED, AX_OF_SPEED, SLIP = range(10, LAGS)
# of a candidate: low-passed v, sum of ω v, slow parts of both residuals, moments of the residuals, last v
SMOOTH, SUM_TURN_V, SLOW_Y, SLOW_X, SQUARE_Y, CROSS_Y, SQUARE_X, LAST = range(8)
LEAST_LIMIT = 0.3  # of a grip limit that longitudinal acceleration leaves
ROLLING = 0.05  # m/s: deviation of v = b ω of a car that rolls slowly


class State(NamedTuple):
    """What is carried from sample to sample; J filters, a window of N samples."""

    means: FloatArray  # (J, 8)
    covariances: FloatArray  # (J, 8, 8)
    log_weights: FloatArray  # (J,)
    lags: FloatArray  # (16,)
    candidates: FloatArray  # (3, 8)
    weights: FloatArray  # (3,), of the candidates
    last: FloatArray  # (4,), the sample before
    window: FloatArray  # (N, 4), the last samples, the oldest first; the first sample stands for those before it


@part()
def _rear_slip(force, grip, lags, n):  # type: ignore[no-untyped-def]
    """φ and dφ/da of the rear axle, and the acceleration beyond its limit; a filter without a grip limit (0) takes φ of the network.

    φ = a_m (1 - (1 - |a|/a_m)^p)/p with the sign of a, a_m what the longitudinal acceleration leaves of the grip limit.
    """
    if grip <= 0.0:
        return lags[SLIP], 0.0, 0.0
    limit = math.sqrt(max(grip * grip - lags[AX] ** 2, (LEAST_LIMIT * grip) ** 2))
    share = min(abs(force) / limit, n.largest_share)
    left = (1.0 - share) ** n.exponent
    return math.copysign(limit * (1.0 - left) / n.exponent, force), left / (1.0 - share), max(abs(force) - limit, 0.0)


@part()
def _predict(x, p, n, decay, prior, spread, ay, ax, turn, yaw_rate, unsteady):  # type: ignore[no-untyped-def]
    """v' = (1 - κ) ay - β_y - ω u, u' = ax - β_x + ω v; the other states decay to their priors."""
    v = x[V]
    x[V] += n.dt * (ay * (1.0 - x[LEAKAGE]) - x[OFFSET_Y] - turn)
    x[U] += n.dt * (ax - x[OFFSET_X] + yaw_rate * v)
    for c in range(STATES):
        of_v = p[V, c] - n.dt * (ay * p[LEAKAGE, c] + p[OFFSET_Y, c])
        of_u = p[U, c] + n.dt * (yaw_rate * p[V, c] - p[OFFSET_X, c])
        p[V, c], p[U, c] = of_v, of_u
    for c in range(STATES):
        of_v = p[c, V] - n.dt * (ay * p[c, LEAKAGE] + p[c, OFFSET_Y])
        of_u = p[c, U] + n.dt * (yaw_rate * p[c, V] - p[c, OFFSET_X])
        p[c, V], p[c, U] = of_v, of_u
    for i in range(OFFSET_Y, STATES):
        x[i] = prior[i] + decay[i] * (x[i] - prior[i])
        for c in range(STATES):
            p[i, c] *= decay[i]
            p[c, i] *= decay[i]
        p[i, i] += spread[i] ** 2 * (1.0 - decay[i] ** 2)
    p[V, V] += n.dt * (n.noise_vy**2 + (n.noise_delay * unsteady) ** 2)
    p[U, U] += n.dt * n.noise_vx**2


@part()
def _update(x, p, row, residual, variance, gate, learns, scratch):  # type: ignore[no-untyped-def]
    """Take a measurement with the given row of derivatives; returns its log likelihood.

    Beyond ``gate`` deviations a residual is cut off; parameters stay where the filter does not learn (a Schmidt-Kalman update).
    """
    total = variance
    for i in range(STATES):
        scratch[i] = 0.0
        for c in range(STATES):
            scratch[i] += p[i, c] * row[c]
    for i in range(STATES):
        total += row[i] * scratch[i]
    square = residual * residual / total
    if square > gate * gate:
        residual *= gate / math.sqrt(square)
        square = gate * gate
    for i in range(STATES):
        held = not learns and LEAKAGE <= i <= COMPLIANCE
        if not held:
            x[i] += scratch[i] / total * residual
        for c in range(STATES):
            if not (held and LEAKAGE <= c <= COMPLIANCE):
                p[i, c] -= scratch[i] * scratch[c] / total
    return -0.5 * (square + math.log(total))


@part()
def _axle(x, p, grip, n, lags, turning, speed, size, row, scratch):  # type: ignore[no-untyped-def]
    """0 = v - b ω + C u φ(a_r) + s e at the rear axle, low-passed: v - τ dv/dt stands for the low-passed v."""
    own, force = 1.0 - x[LEAKAGE], (lags[AY] - x[OFFSET_Y]) * (1.0 - x[LEAKAGE]) - x[REAR] * turning
    slip, slope, excess = _rear_slip(force, grip, lags, n)
    smooth = x[V] - lags[SUM_AY] * own + x[OFFSET_Y] * lags[SUM_ONE] + lags[SUM_TURN]
    residual = x[REAR] * lags[YAW_RATE] - x[COMPLIANCE] * speed * slip - size * x[ERROR] - smooth
    gain = x[COMPLIANCE] * speed * slope
    row[V], row[U], row[OFFSET_X] = 1.0, 0.0, 0.0
    row[OFFSET_Y] = lags[SUM_ONE] - gain * own
    row[LEAKAGE] = lags[SUM_AY] - gain * (lags[AY] - x[OFFSET_Y])
    row[REAR] = -lags[YAW_RATE] - gain * turning if grip > 0.0 else 0.0
    row[COMPLIANCE] = speed * slip
    row[ERROR] = size
    surplus = 0.5 * min(excess / n.grip_excess, n.gate) ** 2 * n.dt  # which the grip limit rules out
    return _update(x, p, row, residual, n.axle_white**2 + n.axle_white_share * size**2, n.gate, True, scratch) - surplus


@part()
def _network(theta, width, window, dt):  # type: ignore[no-untyped-def]
    """KS-NN without biases, v one step after the window (Da Lio et al. 2023, Eqs. 7 and 8); rows of ``theta`` as in `kernels.ksnn`."""
    v, u = 0.0, window[0, 1]
    local = theta.shape[0]
    for k in range(len(window)):
        yaw_rate, speed, ay, ax = window[k, 0], window[k, 1], window[k, 2], window[k, 3]
        place = min(abs(yaw_rate) / width * (local - 1), local - 1.0)
        slip, thrust, error = dt * (ay - speed * yaw_rate), dt * (ax + v * yaw_rate), u - speed
        next_v, next_u = 0.0, 0.0
        for m in range(local):
            share = 1.0 - abs(place - m)
            if share > 0.0:
                f1, f2 = theta[m, 4] * error + theta[m, 5], theta[m, 6] * error + theta[m, 7]
                half = (theta.shape[1] - 8) // 6
                for q in range(half):
                    one, two = 8 + 3 * q, 8 + 3 * (half + q)
                    f1 += theta[m, one + 2] * math.tanh(theta[m, one] * error + theta[m, one + 1])
                    f2 += theta[m, two + 2] * math.tanh(theta[m, two] * error + theta[m, two + 1])
                next_v += share * (theta[m, 0] * v + theta[m, 2] * slip - yaw_rate * f1)
                next_u += share * (theta[m, 1] * u + theta[m, 3] * thrust - f2)
        v, u = next_v, next_u
    return v


@part()
def _advance_lags(lags, sample, last, n, g, g_1, g_slow):  # type: ignore[no-untyped-def]
    """Low-passed signals, and sums of (1 - g)^k dt x, which are τ times the low-passed x; returns the low-passed yaw rate's derivative."""
    before = lags[YAW_RATE]
    for at, value in ((YAW_RATE, sample[0]), (AY, sample[2]), (AX, sample[3])):
        lags[at] += g * (value - lags[at])
    lags[SPEED] += g_1 * (sample[1] - lags[SPEED])
    ay, ax, turn = (last[2] + sample[2]) / 2.0, (last[3] + sample[3]) / 2.0, (last[0] * last[1] + sample[0] * sample[1]) / 2.0
    for at, value in ((SUM_AY, ay), (SUM_TURN, turn), (SUM_ONE, 1.0)):
        lags[at] = (1.0 - g) * (lags[at] + n.dt * value)
    for at, value in ((SUM_AY_1, ay), (SUM_TURN_1, turn), (SUM_AX_1, ax)):
        lags[at] = (1.0 - g_1) * (lags[at] + n.dt * value)
    lags[SLOW_AY] += g_slow * (lags[SUM_AY_1] - lags[SLOW_AY])
    return (lags[YAW_RATE] - before) / n.dt


@part()
def _judge(found, own, weights, left, lags, sample, yaw_rate, n, g_1, g_slow, moving):  # type: ignore[no-untyped-def]
    """Weights of the candidates by what each v leaves of v' = (1 - κ) ay - ω u, its mean square in ``left``, and of u' = ax + ω v."""
    keep = 1.0 - n.dt / n.memory
    ay = lags[SUM_AY_1] - lags[SLOW_AY]
    if moving:
        lags[TIME] = lags[TIME] * keep + n.dt
        lags[POWER] = lags[POWER] * keep + ay * ay * n.dt
    odds, floor = (0.0, math.log(n.network_odds), math.log(n.steady_odds)), n.residual_floor**2
    for c in range(CANDIDATES):
        one, v = own[c], found[c]
        one[SMOOTH] += g_1 * (v - one[SMOOTH])
        one[SUM_TURN_V] = (1.0 - g_1) * (one[SUM_TURN_V] + n.dt * yaw_rate * (one[LAST] + v) / 2.0)
        one[LAST] = v
        y = v - one[SMOOTH] - lags[SUM_AY_1] + lags[SUM_TURN_1]
        x = sample[1] - lags[SPEED] - lags[SUM_AX_1] - one[SUM_TURN_V]
        one[SLOW_Y] += g_slow * (y - one[SLOW_Y])
        one[SLOW_X] += g_slow * (x - one[SLOW_X])
        y, x = y - one[SLOW_Y], x - one[SLOW_X]
        if moving:
            one[SQUARE_Y] = one[SQUARE_Y] * keep + y * y * n.dt
            one[CROSS_Y] = one[CROSS_Y] * keep + y * ay * n.dt
            one[SQUARE_X] = one[SQUARE_X] * keep + x * x * n.dt
        time = max(lags[TIME], n.dt)
        leakage = min(max(one[CROSS_Y] / (lags[POWER] + 1e-9), -n.largest_leakage), n.largest_leakage)
        left[c] = max(one[SQUARE_Y] - 2.0 * leakage * one[CROSS_Y] + leakage**2 * lags[POWER], 0.0) / time
        score = n.lateral_power * math.log(left[c] + floor) + n.longitudinal_power * math.log(one[SQUARE_X] / time + floor)
        weights[c] = odds[c] - 0.5 * score * lags[TIME] / (lags[TIME] + n.decision_time)
    _normalise(weights, weights, CANDIDATES)


@entry()
def scan(n, grips, start, prior, spread, decay, theta, state, samples, found, parameters):  # type: ignore[no-untyped-def]
    """Go through samples; changes ``state`` in place.

    Args:
        n: numbers of the estimator, a named tuple.
        grips: grip limits of the bank, (J,) [m/s²]; 0 for the filter whose axle slips as the network has it.
        start: logarithms of the bank's weights at the start, (J,).
        prior, spread: mean and standard deviation of the states at the start, (8,).
        decay: factors by which they return to it in a sample, (8,).
        theta: weights of the network, (P, 8 + 6 Q).
        state: a `State`.
        samples: yaw_rate, vx, ay, ax, (T, 4).
        found: output, vy and its variance, (T, 2).
        parameters: output, mean and variance over the bank of states, (T, 16).
    """
    g, g_1, g_slow = -math.expm1(-n.dt / n.axle_lag), -math.expm1(-n.dt / n.residual_time), -math.expm1(-n.dt / n.slow_time)
    means, lags, last, window = state.means, state.lags, state.last, state.window
    row, scratch, values, left = np.zeros(STATES), np.zeros(STATES), np.zeros(CANDIDATES), np.zeros(CANDIDATES)
    weights = np.empty(len(grips))
    for t in range(len(samples)):
        sample = samples[t].copy()
        if n.without_ax:
            sample[3] = (sample[1] - lags[AX_OF_SPEED]) / n.axle_lag
            lags[AX_OF_SPEED] += g * (sample[1] - lags[AX_OF_SPEED])
        turning = _advance_lags(lags, sample, last, n, g, g_1, g_slow)
        slip = (n.rear * sample[0] - lags[PREDICTED]) / (n.compliance * max(sample[1], n.minimum_speed))
        lags[SLIP] += g * (slip - lags[SLIP])
        speed, moving = sample[1], sample[1] > n.minimum_speed
        yaw_rate, turn = (last[0] + sample[0]) / 2.0, (last[0] * last[1] + sample[0] * speed) / 2.0
        ay, ax = (last[2] + sample[2]) / 2.0, (last[3] + sample[3]) / 2.0
        _normalise(state.log_weights, weights, len(grips))
        size = 0.0
        for j in range(len(grips)):
            x = means[j]
            force = (lags[AY] - x[OFFSET_Y]) * (1.0 - x[LEAKAGE]) - x[REAR] * turning
            slip, slope, _ = _rear_slip(force, grips[j], lags, n)
            bent = n.axle_per_slip * abs(slip) + n.axle_per_bend * max(slope - 1.0, 0.0) + n.axle_per_slope * slope
            size += weights[j] * (n.axle_constant + max(speed, 0.0) * (n.axle_per_speed + n.compliance * bent))
        for j in range(len(grips)):
            x, p = means[j], state.covariances[j]
            _predict(x, p, n, decay, prior, spread, ay, ax, turn, yaw_rate, turning * speed)
            row[:] = 0.0
            row[U] = 1.0
            likelihood = _update(x, p, row, speed - x[U], n.noise_speed**2, n.gate, moving, scratch)
            if moving:
                likelihood += _axle(x, p, grips[j], n, lags, turning, speed, size, row, scratch)
                state.log_weights[j] = start[j] + (state.log_weights[j] - start[j]) * (1.0 - n.dt / n.memory) + likelihood
            else:
                row[:] = 0.0
                row[V], row[REAR] = 1.0, -sample[0]
                _update(x, p, row, x[REAR] * sample[0] - x[V], ROLLING**2, n.gate, False, scratch)
        _mixture(means, state.covariances, state.log_weights, weights, parameters[t])
        values[BANK], values[NETWORK] = 0.0, lags[PREDICTED]
        for j in range(len(grips)):
            values[BANK] += weights[j] * (means[j, V] + n.rear_known * (n.rear - means[j, REAR]) * sample[0])
        values[STEADY] = sample[0] * (n.rear - n.compliance * speed * speed)
        _judge(values, state.candidates, state.weights, left, lags, sample, yaw_rate, n, g_1, g_slow, moving)
        _combine(values, state.weights, left, parameters[t], sample, n, found[t])
        for j in range(len(sample)):  # slices would compile for seconds
            for i in range(len(window) - 1):
                window[i, j] = window[i + 1, j]
            window[-1, j] = last[j] = sample[j]
        lags[PREDICTED] = _network(theta, n.yaw_rate_max, window, n.dt)


@part()
def _normalise(log_weights, weights, count):  # type: ignore[no-untyped-def]
    """Weights of sum 1 from the first logarithms; whole arrays would double the time to compile."""
    largest, total = log_weights[0], 0.0
    for j in range(count):
        largest = max(largest, log_weights[j])
    for j in range(count):
        weights[j] = math.exp(log_weights[j] - largest)
        total += weights[j]
    for j in range(count):
        weights[j] /= total


@part()
def _mixture(means, covariances, log_weights, weights, found):  # type: ignore[no-untyped-def]
    """Mean and variance of the states over the bank, differences between filters included; of b and C without the network's filter."""
    found[:] = 0.0
    for i in range(STATES):
        filters = len(weights) - 1 if REAR <= i <= COMPLIANCE else len(weights)
        _normalise(log_weights, weights, filters)
        for j in range(filters):
            found[i] += weights[j] * means[j, i]
        for j in range(filters):
            found[STATES + i] += weights[j] * (covariances[j, i, i] + (means[j, i] - found[i]) ** 2)


@part()
def _combine(values, weights, left, parameters, sample, n, found):  # type: ignore[no-untyped-def]
    """vy at the reference point and its variance: candidates by their weights, without the network where the car rolls slowly."""
    of_network = weights[NETWORK] * min(max(sample[1] / n.minimum_speed - 1.0, 0.0), 1.0)
    own = (1.0 - of_network - weights[STEADY], of_network, weights[STEADY])
    mean, spread, unexplained = own[0] * values[0] + own[1] * values[1] + own[2] * values[2], 0.0, 0.0
    for c in range(CANDIDATES):
        spread += own[c] * (values[c] - mean) ** 2
        unexplained += own[c] * left[c]
    found[0] = mean
    found[1] = n.variance_share * (parameters[STATES + V] + spread) + n.residual_share * unexplained
    found[1] += (n.angle_floor * sample[1]) ** 2 + (n.point * sample[0]) ** 2
