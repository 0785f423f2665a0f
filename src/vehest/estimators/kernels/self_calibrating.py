"""Compiled recursion of the self-calibrating estimator: a bank of filters, and its comparison.

    samples -> network, lagged signals
            -> filters, one in each lane of a vector: predict, measured speed, rear axle
            -> weights of the filters by likelihood
            -> residuals of the candidates -> weights of the candidates -> vy

A state is [v, u, β_y, β_x, κ, b, C, e]: velocities of the inertial unit [m/s], offsets of the
accelerometer [m/s²], roll leakage of ay, distance [m] and compliance [rad s²/m] of the rear axle,
and the axle's correlated error in units of its size. Candidates for v are the bank, the network
that comes with vehest, and steady cornering.

Order of sums: over filters vector by vector, and within a vector in any order (`lanes.total`); over
states in order of their index. A drive in parts gives the numbers of the drive as a whole, since
`State` has everything that is carried on. There is no gradient.

Source: equations in `vehest.estimators.self_calibrating`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vehest.constants import FloatArray
from vehest.estimators.kernels.compiling import entry, part
from vehest.lanes import VECTOR_BYTES, choose, least, load, most, root, store, total, width

STATES = 8  # states of a filter, which the next line names
V, U, OFFSET_Y, OFFSET_X, LEAKAGE, REAR, COMPLIANCE, ERROR = range(STATES)
# number of candidates for v: this bank, the network that comes with vehest, steady cornering with
# the priors
CANDIDATES = 3
BANK, NETWORK, STEADY = range(CANDIDATES)
# lagged signals: those of the axle's equation, those of the candidates' residuals, the mean
# square of the axle's error s e over the last moments, and the lateral acceleration that the drive
# has reached
LAGGED = 17  # number of lagged signals
YAW_RATE, AY, AX, SUM_AY, SUM_TURN, SUM_ONE, SPEED, SUM_AY_1, SUM_TURN_1, SUM_AX_1 = range(10)
SLOW_AY, TIME, POWER, PREDICTED, AX_OF_SPEED, SLIDE, REACHED = range(10, LAGGED)
# number of moments of a candidate: low-passed v, sum of ω v, slow parts of both residuals, moments
# of the residuals, and last v
MOMENTS = 8
SMOOTH, SUM_TURN_V, SLOW_Y, SLOW_X, SQUARE_Y, CROSS_Y, SQUARE_X, LAST = range(MOMENTS)
# Rows of the bank, with a filter in each lane: states, the upper triangle of the covariances, then
# those below.
TRIANGLE = STATES * (STATES + 1) // 2  # numbers of a covariance
GRIP = STATES + TRIANGLE  # grip limit [m/s²]
WEIGHT = GRIP + 1  # weight among all filters
COST = GRIP + 2  # two rows, one a measurement: decrease of the log likelihood
VARIANCE = GRIP + 4  # two rows, one a measurement: variance of the residual
DERIVATIVE = GRIP + 6  # derivatives of a measurement by the states
CROSS = DERIVATIVE + STATES  # covariances of a measurement with each state
BANK_ROWS = CROSS + STATES  # rows of the bank in all
# index in the bank of a covariance's first lane, by row and column
AT = np.array(
    [
        [min(i, c) * (2 * STATES - 1 - min(i, c)) // 2 + max(i, c) for c in range(STATES)]
        for i in range(STATES)
    ]
)
# as an index of float64 values: VECTOR_BYTES // 8 lanes in each row
AT = (STATES + AT) * (VECTOR_BYTES // 8)
MIN_GRIP_SHARE = 0.3  # smallest share of a grip limit that remains at any longitudinal acceleration
ROLLING_DEVIATION = 0.05  # m/s: deviation of v = b ω of a car that rolls slowly
# largest |e|, in deviations of its prior, at which b is estimated; beyond it b stays: a slide does
# not show the unit's place
MAX_ERROR_OF_PLACE = 1.0
LEAST_AY = 1e-9  # m/s²: avoids a division by zero


class State(NamedTuple):
    """State of the recursion between samples, with J filters and a window of N samples."""

    means: FloatArray  # means of the filters' states, (J, 8)
    covariances: FloatArray  # covariances of the filters' states, (J, 8, 8)
    log_weights: FloatArray  # logarithms of the filters' weights, (J,)
    lags: FloatArray  # lagged signals, (17,)
    candidates: FloatArray  # low-passed values and moments of the candidates, (3, `MOMENTS`)
    weights: FloatArray  # weights of the candidates, (3,)
    last: FloatArray  # the last sample, (4,)
    # (N, 4), the last samples, the oldest first; those before the first sample repeat it
    window: FloatArray


@part()
def _rear_slip(f, lags, turning, n):
    """φ and dφ/da of the rear axle, and its acceleration beyond the limit.

    φ = a_m (1 - (1 - |a|/a_m)^p)/p with the sign of a; a_m is the grip limit that the longitudinal
    acceleration leaves.

    Parameters
    ----------
    f : array
        Rows of one vector of filters, (`BANK_ROWS` · lanes,); the first row of `CROSS` is scratch.
    lags : array
        Lagged signals (`LAGGED`): low-passed values and running sums, (17,).
    turning : float
        Derivative of the low-passed yaw rate [rad/s²].
    n : namedtuple
        Numbers of the estimator.

    Returns
    -------
    tuple of vectors
        φ [m/s²], dφ/da [1], and |a| - a_m where positive, else 0 [m/s²].
    """
    lanes = width(f)
    grip = load(f, GRIP * lanes)
    force = (lags[AY] - load(f, OFFSET_Y * lanes)) * (1.0 - load(f, LEAKAGE * lanes)) - load(
        f, REAR * lanes
    ) * turning
    limit = root(most(grip * grip - lags[AX] ** 2, MIN_GRIP_SHARE**2 * grip * grip))
    reserve = 1.0 - least(abs(force) / limit, n.largest_share)
    store(f, CROSS * lanes, reserve)
    for k in range(CROSS * lanes, (CROSS + 1) * lanes):
        f[k] **= n.exponent
    reserve_power = load(f, CROSS * lanes)
    slip = limit * (1.0 - reserve_power) / n.exponent
    return choose(force < 0.0, -slip, slip), reserve_power / reserve, most(abs(force) - limit, 0.0)


@part()
def _predict(f, n, decay, prior, spread, ay, ax, turn, yaw_rate, unsteady):
    """v' = (1 - κ) ay - β_y - ω u, u' = ax - β_x + ω v; the other states decay to their priors.

    The covariance moves by F P Fᵀ with F = ∂x⁺/∂x written out entry by entry, A P first, then times
    Aᵀ; only its upper triangle is stored. Process noise: ``noise_vy``² + (``noise_delay`` (uω)')²
    for v, ``noise_vx``² for u, each times Δt, and what the other states need to keep their prior's
    variance.

    Parameters
    ----------
    f : array
        Rows of one vector of filters, changed in place.
    n : namedtuple
        Numbers of the estimator.
    decay, prior, spread : array
        Factor a sample, mean and standard deviation of the states at the start, (8,).
    ay, ax, turn, yaw_rate : float
        Means of this and the last sample: accelerations [m/s²], u ω [m/s²], ω [rad/s].
    unsteady : float
        Change of the yaw rate times the speed [m/s³].
    """
    lanes = width(f)
    v = load(f, V * lanes)
    v_v = load(f, AT[V, V])
    v_u = load(f, AT[V, U])
    u_u = load(f, AT[U, U])
    store(
        f,
        V * lanes,
        v + n.dt * (ay * (1.0 - load(f, LEAKAGE * lanes)) - load(f, OFFSET_Y * lanes) - turn),
    )
    store(f, U * lanes, load(f, U * lanes) + n.dt * (ax - load(f, OFFSET_X * lanes) + yaw_rate * v))
    u_v = v_u + n.dt * (yaw_rate * v_v - load(f, AT[V, OFFSET_X]))  # here of A P, below of A P A'
    u_u += n.dt * (yaw_rate * v_u - load(f, AT[U, OFFSET_X]))
    v_v -= n.dt * (ay * load(f, AT[V, LEAKAGE]) + load(f, AT[V, OFFSET_Y]))
    v_u -= n.dt * (ay * load(f, AT[U, LEAKAGE]) + load(f, AT[U, OFFSET_Y]))
    for c in range(OFFSET_Y, len(decay)):
        of_v = load(f, AT[V, c])
        store(f, AT[V, c], of_v - n.dt * (ay * load(f, AT[LEAKAGE, c]) + load(f, AT[OFFSET_Y, c])))
        store(f, AT[U, c], load(f, AT[U, c]) + n.dt * (yaw_rate * of_v - load(f, AT[OFFSET_X, c])))
    v_u += n.dt * (yaw_rate * v_v - load(f, AT[V, OFFSET_X]))
    v_v -= n.dt * (ay * load(f, AT[V, LEAKAGE]) + load(f, AT[V, OFFSET_Y]))
    u_u += n.dt * (yaw_rate * u_v - load(f, AT[U, OFFSET_X]))
    store(f, AT[V, V], v_v + n.dt * (n.noise_vy**2 + (n.noise_delay * unsteady) ** 2))
    store(f, AT[V, U], v_u)
    store(f, AT[U, U], u_u + n.dt * n.noise_vx**2)
    for c in range(OFFSET_Y, len(decay)):
        store(f, c * lanes, prior[c] + decay[c] * (load(f, c * lanes) - prior[c]))
        for i in range(c + 1):
            store(f, AT[i, c], load(f, AT[i, c]) * (decay[i] * decay[c]))
        store(f, AT[c, c], load(f, AT[c, c]) + spread[c] ** 2 * (1.0 - decay[c] ** 2))


@part()
def _measured_sum(f, first, second, factor, measured, variance):
    """Prepare an update with the measurement of one state plus ``factor`` times another: returns
    the residual and its variance, and writes the covariances with the states into the rows `CROSS`.
    """
    lanes = width(f)
    for i in range(STATES):
        store(f, (CROSS + i) * lanes, load(f, AT[i, first]) + factor * load(f, AT[i, second]))
    residual_variance = (
        load(f, (CROSS + first) * lanes) + factor * load(f, (CROSS + second) * lanes) + variance
    )
    return measured - load(f, first * lanes) - factor * load(f, second * lanes), residual_variance


@part()
def _axle(f, n, lags, turning, speed, size, states):
    """0 = v - b ω + C u φ(a_r) + s e at the rear axle, with all signals low-passed.

    The low-passed v is v - τ dv/dt. Returns the residual, its variance, and the cost of a sample
    for the acceleration beyond the grip limit, half the square in deviations.

    Parameters
    ----------
    f : array
        Rows of one vector of filters; derivatives and covariances with the states are written to
        it.
    speed, size : float
        u [m/s], and the axle's error size s [m/s].
    states : int
        Number of states, 8.
    """
    lanes = width(f)
    offset = load(f, OFFSET_Y * lanes)
    rear = load(f, REAR * lanes)
    compliance = load(f, COMPLIANCE * lanes)
    ay_share = 1.0 - load(f, LEAKAGE * lanes)
    slip, slope, excess = _rear_slip(f, lags, turning, n)
    smooth = load(f, V * lanes) - lags[SUM_AY] * ay_share + offset * lags[SUM_ONE] + lags[SUM_TURN]
    residual = (
        rear * lags[YAW_RATE] - compliance * speed * slip - size * load(f, ERROR * lanes) - smooth
    )
    gain = compliance * speed * slope
    store(f, (DERIVATIVE + V) * lanes, 1.0)
    store(f, (DERIVATIVE + OFFSET_Y) * lanes, lags[SUM_ONE] - gain * ay_share)
    store(f, (DERIVATIVE + LEAKAGE) * lanes, lags[SUM_AY] - gain * (lags[AY] - offset))
    store(f, (DERIVATIVE + REAR) * lanes, -lags[YAW_RATE] - gain * turning)
    store(f, (DERIVATIVE + COMPLIANCE) * lanes, speed * slip)
    store(f, (DERIVATIVE + ERROR) * lanes, size)
    variance = 0.0 * slip + n.axle_white**2 + n.axle_white_share * size**2
    for i in range(states):
        shared = 0.0 * slip
        for c in range(states):
            shared += load(f, AT[i, c]) * load(f, (DERIVATIVE + c) * lanes)
        store(f, (CROSS + i) * lanes, shared)
        variance += load(f, (DERIVATIVE + i) * lanes) * shared
    surplus = least(excess / n.grip_excess, n.gate)
    return residual, variance, 0.5 * n.dt * surplus * surplus


@part()
def _update(f, residual, variance, gate, learns, states):
    """Update a vector of filters, in place, with a measurement; the rows `CROSS` are its
    covariances with the states.

    Beyond ``gate`` deviations a residual is cut off. States stay in Schmidt-Kalman updates: those
    from `LEAKAGE` to `COMPLIANCE` unless the filter ``learns``, `REAR` where the axle slides.
    Returns half the square of the normalised residual after it was cut off.

    P⁺_ic = P_ic - K_i S_c with the covariances S_c of the measurement with state c and K_i =
    S_i/variance. Of a state that stays, mean and variance do, and so do the covariances of fixed
    parameters with each other; its other covariances are updated.
    """
    lanes = width(f)
    limit = gate * root(variance)
    inverse = 1.0 / variance
    residual = most(least(residual, limit), -limit)
    slides = abs(load(f, ERROR * lanes)) > MAX_ERROR_OF_PLACE
    for i in range(states):
        is_fixed = not learns and LEAKAGE <= i <= COMPLIANCE
        gain = load(f, (CROSS + i) * lanes) * inverse
        step = choose(slides, 0.0 * gain, gain) if i == REAR else gain
        if not is_fixed:
            store(f, i * lanes, load(f, i * lanes) + step * residual)
        for c in range(i, states):
            if not (is_fixed and c <= COMPLIANCE):
                share = step if c == i else gain
                store(f, AT[i, c], load(f, AT[i, c]) - share * load(f, (CROSS + c) * lanes))
    return 0.5 * residual * residual * inverse


@part()
def precise_tanh(x):
    """tanh to 1e-15: Lambert's continued fraction n/d at x/8, then tanh(2y) = 2nd/(d² + n²) thrice.

    See `activation.rational_tanh`.
    """
    y = 0.125 * least(most(x, -20.0), 20.0)
    s = y * y
    n = y * (135135.0 + s * (17325.0 + s * (378.0 + s)))
    d = 135135.0 + s * (62370.0 + s * (3150.0 + s * 28.0))
    n, d = 2.0 * n * d, d * d + n * n
    n, d = 2.0 * n * d, d * d + n * n
    return 2.0 * n * d / (d * d + n * n)


@part()
def _network(theta, yaw_rate_max, series, first, steps, dt):
    """KS-NN without biases: v [m/s] one step after windows of ``steps`` samples.

    The lanes are windows that begin at sample ``first`` and those after it. Rows of ``theta`` are
    as in `kernels.ksnn`, rows of ``series`` the columns of `scan`'s samples.

    Source: Da Lio et al. 2023, Eqs. 7 and 8.
    """
    n_local = theta.shape[0]
    n_hidden = (theta.shape[1] - 8) // 6
    row = series.shape[1]
    u = load(series, row + first)
    v = 0.0 * u
    for at in range(first, first + steps):
        yaw_rate = load(series, at)
        speed = load(series, row + at)
        place = least(abs(yaw_rate) * ((n_local - 1) / yaw_rate_max), n_local - 1.0)
        slip = dt * (load(series, 2 * row + at) - speed * yaw_rate)
        thrust = dt * (load(series, 3 * row + at) + v * yaw_rate)
        error = u - speed
        next_v = 0.0 * u
        next_u = 0.0 * u
        for m in range(n_local):
            share = most(1.0 - abs(place - m), 0.0)
            f1 = theta[m, 4] * error + theta[m, 5]
            f2 = theta[m, 6] * error + theta[m, 7]
            for q in range(n_hidden):
                lateral = 8 + 3 * q
                longitudinal = 8 + 3 * (n_hidden + q)
                f1 += theta[m, lateral + 2] * precise_tanh(
                    theta[m, lateral] * error + theta[m, lateral + 1]
                )
                f2 += theta[m, longitudinal + 2] * precise_tanh(
                    theta[m, longitudinal] * error + theta[m, longitudinal + 1]
                )
            next_v += share * (theta[m, 0] * v + theta[m, 2] * slip - yaw_rate * f1)
            next_u += share * (theta[m, 1] * u + theta[m, 3] * thrust - f2)
        v = next_v
        u = next_u
    return v


@part()
def _advance_lags(lags, sample, last, n, g, g_1, g_slow):
    """Update low-passed signals, and sums of (1 - g)^k dt x, which are τ times the low-passed x.

    Returns the derivative of the low-passed yaw rate [rad/s²].
    """
    before = lags[YAW_RATE]
    for at, value in ((YAW_RATE, sample[0]), (AY, sample[2]), (AX, sample[3])):
        lags[at] += g * (value - lags[at])
    lags[SPEED] += g_1 * (sample[1] - lags[SPEED])
    ay = (last[2] + sample[2]) / 2.0
    ax = (last[3] + sample[3]) / 2.0
    turn = (last[0] * last[1] + sample[0] * sample[1]) / 2.0
    for at, value in ((SUM_AY, ay), (SUM_TURN, turn), (SUM_ONE, 1.0)):
        lags[at] = (1.0 - g) * (lags[at] + n.dt * value)
    for at, value in ((SUM_AY_1, ay), (SUM_TURN_1, turn), (SUM_AX_1, ax)):
        lags[at] = (1.0 - g_1) * (lags[at] + n.dt * value)
    lags[SLOW_AY] += g_slow * (lags[SUM_AY_1] - lags[SLOW_AY])
    return (lags[YAW_RATE] - before) / n.dt


@part()
def _judge(values, moments, weights, lags, sample, yaw_rate, n, g_1, g_slow, moving):
    """Candidates' weights by their residuals of v' = (1 - κ) ay - ω u and of u' = ax + ω v.

    The score of a candidate is the weighted sum of the logarithms of its mean squared residuals; a
    leakage of at most ``largest_leakage`` is regressed out of that of v'. It counts by t/(t + T)
    with the driving time t and ``decision_time`` T, so that the odds at the start decide at first.

    Parameters
    ----------
    values : array
        v of the candidates at the inertial unit, (3,) [m/s].
    moments, weights : array
        (3, 8) and (3,), changed in place.
    moving : bool
        Whether the car is fast enough, so that the sample counts.
    """
    keep = 1.0 - n.dt / n.memory
    ay = lags[SUM_AY_1] - lags[SLOW_AY]
    if moving:
        lags[TIME] = lags[TIME] * keep + n.dt
        lags[POWER] = lags[POWER] * keep + ay * ay * n.dt
    odds = (0.0, math.log(n.network_odds), math.log(n.steady_odds))
    floor = n.residual_floor**2
    for c in range(CANDIDATES):
        moment = moments[c]
        v = values[c]
        moment[SMOOTH] += g_1 * (v - moment[SMOOTH])
        moment[SUM_TURN_V] = (1.0 - g_1) * (
            moment[SUM_TURN_V] + n.dt * yaw_rate * (moment[LAST] + v) / 2.0
        )
        moment[LAST] = v
        y = v - moment[SMOOTH] - lags[SUM_AY_1] + lags[SUM_TURN_1]
        x = sample[1] - lags[SPEED] - lags[SUM_AX_1] - moment[SUM_TURN_V]
        moment[SLOW_Y] += g_slow * (y - moment[SLOW_Y])
        moment[SLOW_X] += g_slow * (x - moment[SLOW_X])
        y = y - moment[SLOW_Y]
        x = x - moment[SLOW_X]
        if moving:
            moment[SQUARE_Y] = moment[SQUARE_Y] * keep + y * y * n.dt
            moment[CROSS_Y] = moment[CROSS_Y] * keep + y * ay * n.dt
            moment[SQUARE_X] = moment[SQUARE_X] * keep + x * x * n.dt
        time = max(lags[TIME], n.dt)
        leakage = min(
            max(moment[CROSS_Y] / (lags[POWER] + 1e-9), -n.largest_leakage), n.largest_leakage
        )
        square_y = max(
            moment[SQUARE_Y] - 2.0 * leakage * moment[CROSS_Y] + leakage**2 * lags[POWER], 0.0
        )
        score = n.lateral_power * math.log(
            square_y / time + floor
        ) + n.longitudinal_power * math.log(moment[SQUARE_X] / time + floor)
        weights[c] = odds[c] - 0.5 * score * lags[TIME] / (lags[TIME] + n.decision_time)
    _normalise(weights, weights, CANDIDATES)


@entry(nogil=True)
def scan(n, grips, start, prior, spread, decay, theta, state, samples, estimates, parameters):
    """Go through samples; changes ``state`` in place.

    Parameters
    ----------
    n
        Numbers of the estimator, a named tuple.
    grips
        Grip limits of the bank, (J,) [m/s²].
    start
        Logarithms of the bank's weights at the start, (J,).
    prior, spread
        Mean and standard deviation of the states at the start, (8,).
    decay
        Factors by which they return to it in a sample, (8,).
    theta
        Weights of the network, (P, 8 + 6 Q).
    state
        A `State`, changed in place.
    samples
        Columns yaw_rate [rad/s], vx [m/s], ay, ax [m/s²], (T, 4).
    estimates
        Output: vy at the reference point and its variance, (T, 2).
    parameters
        Output: mean and variance over the bank of states, (T, 16), or (1, 16) for the last sample
        alone.
    """
    g = -math.expm1(-n.dt / n.axle_lag)
    g_1 = -math.expm1(-n.dt / n.residual_time)
    g_slow = -math.expm1(-n.dt / n.slow_time)
    g_band = -math.expm1(-n.dt / n.band_time)
    g_reached = -math.expm1(-n.dt / n.reached_time)
    lags = state.lags
    log_weights = state.log_weights
    lanes = width(grips)
    count = len(grips)
    steps = len(state.window)
    bank = np.zeros(((count + lanes - 1) // lanes, BANK_ROWS * lanes))
    scratch = np.zeros((3, 4))
    values = scratch[0]
    sample = scratch[1]
    moments = scratch[2]
    last = state.last
    # lanes beyond the last filter repeat it, without weight
    for k in range(len(bank) * lanes):
        j = min(k, count - 1)
        f = bank[k // lanes]
        f[GRIP * lanes + k % lanes] = grips[j]
        for i in range(STATES):
            f[i * lanes + k % lanes] = state.means[j, i]
            for c in range(i, STATES):
                f[AT[i, c] + k % lanes] = state.covariances[j, i, c]
    # the window and the samples after it, and the network's v
    series = np.zeros((5, steps + len(samples) + lanes))
    for t in range(steps + len(samples)):
        for i in range(4):
            series[i, t] = state.window[t, i] if t < steps else samples[t - steps, i]
        if n.without_ax and t >= steps:
            series[3, t] = (series[1, t] - lags[AX_OF_SPEED]) / n.axle_lag
            lags[AX_OF_SPEED] += g * (series[1, t] - lags[AX_OF_SPEED])
    for t in range(0, len(samples), lanes):
        store(series[4], t + 1, _network(theta, n.yaw_rate_max, series, t + 1, steps, n.dt))
    series[4, 0] = lags[PREDICTED]
    _weigh(bank, log_weights)
    for t in range(len(samples)):
        for i in range(4):
            sample[i] = series[i, steps + t]
        turning = _advance_lags(lags, sample, last, n, g, g_1, g_slow)
        speed = sample[1]
        moving = sample[1] > n.minimum_speed
        yaw_rate = (last[0] + sample[0]) / 2.0
        turn = (last[0] * last[1] + sample[0] * speed) / 2.0
        ay = (last[2] + sample[2]) / 2.0
        ax = (last[3] + sample[3]) / 2.0
        size = 0.0
        for b in range(len(bank) if moving else 0):
            slips, slope, _ = _rear_slip(bank[b], lags, turning, n)
            bent = (
                n.axle_per_slip * abs(slips)
                + n.axle_per_bend * most(slope - 1.0, 0.0)
                + n.axle_per_slope * slope
            )
            sizes = n.axle_constant + speed * (n.axle_per_speed + n.compliance * bent)
            size += total(load(bank[b], WEIGHT * lanes) * sizes)
        for b in range(len(bank)):
            f = bank[b]
            _predict(f, n, decay, prior, spread, ay, ax, turn, yaw_rate, turning * speed)
            # measurements: the speed, and the rear axle, which rolls (v = b ω) at low speed
            for k in range(2):
                surplus = 0.0 * load(f, 0)
                if k == 0:
                    residual, variance = _measured_sum(f, U, U, 0.0, speed, n.noise_speed**2)
                elif moving:
                    residual, variance, surplus = _axle(
                        f, n, lags, turning, speed, size, len(prior)
                    )
                else:
                    residual, variance = _measured_sum(
                        f, V, REAR, -sample[0], 0.0, ROLLING_DEVIATION**2
                    )
                store(f, (VARIANCE + k) * lanes, variance)
                store(
                    f,
                    (COST + k) * lanes,
                    _update(f, residual, variance, n.gate, moving, len(prior)) + surplus,
                )
        if moving:
            for j in range(count):
                f = bank[j // lanes]
                lane = j % lanes
                cost = f[COST * lanes + lane] + f[(COST + 1) * lanes + lane]
                likelihood = -cost - 0.5 * math.log(
                    f[VARIANCE * lanes + lane] * f[(VARIANCE + 1) * lanes + lane]
                )
                log_weights[j] = (
                    start[j] + (log_weights[j] - start[j]) * (1.0 - n.dt / n.memory) + likelihood
                )
            _weigh(bank, log_weights)
        states = parameters[min(t, len(parameters) - 1)]
        _mixture(bank, states)
        rear = states[REAR]
        values[BANK] = states[V]
        values[NETWORK] = series[4, t] + (rear - n.network_rear) * sample[0]
        values[STEADY] = sample[0] * (rear - n.compliance * speed * speed)
        _judge(
            values,
            state.candidates,
            state.weights,
            lags,
            sample,
            yaw_rate,
            n,
            g_1,
            g_slow,
            moving,
        )
        _at_point(bank, n.is_moved, n.point, sample[0], moments)
        lags[SLIDE] += g_band * ((size * states[ERROR]) ** 2 - lags[SLIDE])
        beyond = max(abs(lags[AY]) - lags[REACHED], 0.0)
        unreached = beyond / max(abs(lags[AY]), LEAST_AY)
        if moving:
            lags[REACHED] += g_reached * beyond
        _combine(
            values, state.weights, lags[SLIDE], unreached, states, moments, sample, n, estimates[t]
        )
        for i in range(4):
            last[i] = sample[i]
    lags[PREDICTED] = series[4, len(samples)]
    for t in range(steps):
        for i in range(4):
            state.window[t, i] = series[i, len(samples) + t]
    for j in range(count):
        for i in range(STATES):
            state.means[j, i] = bank[j // lanes, i * lanes + j % lanes]
            for c in range(STATES):
                state.covariances[j, i, c] = bank[j // lanes, AT[i, c] + j % lanes]


@part()
def _weigh(bank, log_weights):
    """Write the filters' weights, of sum 1, into the bank.

    Operations on arrays instead of loops would double the time to compile.
    """
    lanes = width(bank)
    largest = log_weights[0]
    sum_ = 0.0
    for log_weight in log_weights:
        largest = max(largest, log_weight)
    for j, log_weight in enumerate(log_weights):
        weight = math.exp(log_weight - largest)
        bank[j // lanes, WEIGHT * lanes + j % lanes] = weight
        sum_ += weight
    for b in range(len(bank)):
        store(bank[b], WEIGHT * lanes, load(bank[b], WEIGHT * lanes) * (1.0 / sum_))


@part()
def _mixture(bank, moments):
    """Write mean and variance of the states over the bank, differences between filters included,
    into ``moments``, (16,).
    """
    lanes = width(bank)
    for i in range(STATES):
        mean = 0.0
        variance = 0.0
        for b in range(len(bank)):
            mean += total(load(bank[b], WEIGHT * lanes) * load(bank[b], i * lanes))
        for b in range(len(bank)):
            deviation = load(bank[b], i * lanes) - mean
            variance += total(
                load(bank[b], WEIGHT * lanes) * (load(bank[b], AT[i, i]) + deviation * deviation)
            )
        moments[i] = mean
        moments[STATES + i] = variance


@part()
def _at_point(bank, is_moved, point, yaw_rate, moments):
    """Mean and variance over the bank of v at the reference point, v + ω (point - b) [m/s].

    They are those of v itself where that point is the inertial unit (``is_moved`` 0).
    """
    lanes = width(bank)
    lever = is_moved * yaw_rate
    mean = 0.0
    variance = 0.0
    for b in range(len(bank)):
        f = bank[b]
        moved = load(f, V * lanes) + lever * (point - load(f, REAR * lanes))
        mean += total(load(f, WEIGHT * lanes) * moved)
    for b in range(len(bank)):
        f = bank[b]
        deviation = load(f, V * lanes) + lever * (point - load(f, REAR * lanes)) - mean
        variance_at_point = load(f, AT[V, V]) - 2.0 * lever * load(f, AT[V, REAR])
        variance_at_point += lever * lever * load(f, AT[REAR, REAR])
        variance += total(load(f, WEIGHT * lanes) * (variance_at_point + deviation * deviation))
    moments[0] = mean
    moments[1] = variance


@part()
def _normalise(log_weights, weights, count):
    """Write weights of sum 1 from the first ``count`` logarithms of weights."""
    largest = log_weights[0]
    total = 0.0
    for j in range(count):
        largest = max(largest, log_weights[j])
    for j in range(count):
        weights[j] = math.exp(log_weights[j] - largest)
        total += weights[j]
    for j in range(count):
        weights[j] /= total


@part()
def _combine(values, weights, slide, unreached, states, moments, sample, n, estimate):
    """vy at the reference point and its variance, of the candidates by their weights.

    The network has no weight where the car rolls slowly. ``unreached`` is the part of the lateral
    acceleration beyond that which the drive has reached before, over the acceleration [1]: there
    the car is that of the priors, and both parts of v, of an axle that rolls and of its slip, are
    in doubt, also where they cancel.
    """
    of_network = weights[NETWORK] * min(max(sample[1] / n.minimum_speed - 1.0, 0.0), 1.0)
    shares = (1.0 - of_network - weights[STEADY], of_network, weights[STEADY])
    of_slip = n.compliance_deviation * n.compliance * sample[1] ** 2
    steady = sample[0] ** 2 * ((1.0 - n.is_moved) * states[STATES + REAR] + of_slip**2)
    shift = n.is_moved * (n.point - states[REAR]) * sample[0]
    values[BANK] = moments[0]
    values[NETWORK] += shift
    values[STEADY] += shift
    mean = shares[0] * values[0] + shares[1] * values[1] + shares[2] * values[2]
    spread = 0.0
    for c in range(CANDIDATES):
        spread += shares[c] * (values[c] - mean) ** 2
    estimate[0] = mean
    estimate[1] = n.variance_share * ((1.0 - shares[2]) * moments[1] + shares[2] * steady + spread)
    estimate[1] += n.error_share * slide + (n.angle_floor * sample[1]) ** 2
    estimate[1] += (n.point_deviation * sample[0]) ** 2
    rolling = (n.is_moved * n.point + (1.0 - n.is_moved) * states[REAR]) * sample[0]
    estimate[1] += (n.unreached_share * unreached * (abs(rolling) + abs(mean - rolling))) ** 2
