"""Smoothed estimates of the self-calibrating filter, for a whole drive.

samples -> forward pass: parameters, likeliest filter, weights -> second pass from these -> Rauch-Tung-Striebel pass -> v, variance
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.estimators.kernels import self_calibrating as kernel

PARAMETERS = slice(kernel.LEAKAGE, kernel.ERROR)


def smoothed(estimator: Any, samples: FloatArray, state: kernel.State) -> FloatArray:
    """v [m/s] at the reference point and its variance, (T, 2), each from all samples.

    The likeliest filter of the bank at the drive's end is smoothed (Rauch, Tung & Striebel 1965), from its own parameters there; network
    and steady cornering count by their weights there.

    Args:
        estimator: a `SelfCalibrating`.
        samples: of its channels, (T, C).
        state: before the first of them.
    """
    _, _, last = estimator.trace(samples, state)
    best, n, (mean, deviation), decay = int(np.argmax(last.log_weights)), estimator.numbers(), estimator.prior, estimator.decay
    bank = estimator.bank_arrays
    state = kernel.State(*(part.copy() for part in state))
    state.means[:, PARAMETERS] = last.means[:, PARAMETERS]
    state.covariances[:, PARAMETERS, PARAMETERS] = last.covariances[:, PARAMETERS, PARAMETERS]
    state.log_weights[:] = last.log_weights
    rows, before = estimator.with_ax(samples).copy(), state.last.copy()
    means, covariances = np.empty((len(rows), kernel.STATES)), np.empty((len(rows), kernel.STATES, kernel.STATES))
    network, turning, scratch = np.empty(len(rows)), np.empty(len(rows)), (np.empty((1, 2)), np.empty((1, 2 * kernel.STATES)))
    for k in range(len(rows)):
        network[k], turning[k] = state.lags[kernel.PREDICTED], -state.lags[kernel.YAW_RATE]
        kernel.scan(n, *bank, mean, deviation, decay, estimator.network, state, rows[k : k + 1], *scratch)
        turning[k] += state.lags[kernel.YAW_RATE]
        means[k], covariances[k], rows[k] = state.means[best], state.covariances[best], state.last
    middle = (np.vstack([before, rows[:-1]]) + rows) / 2.0  # yaw rate, u, ay, ax
    turn = rows[:, 0] * rows[:, 1]
    turn = (np.append(before[0] * before[1], turn[:-1]) + turn) / 2.0
    constant = mean * (1.0 - decay)
    constant[[kernel.V, kernel.U]] = 0.0
    noise = np.square(deviation) * (1.0 - np.square(decay))
    noise[kernel.U] = n.dt * n.noise_vx**2
    x, p = means[-1].copy(), covariances[-1].copy()
    found = np.empty((len(rows), 3))
    for k in range(len(rows) - 1, -1, -1):
        found[k] = x[kernel.V], x[kernel.REAR], p[kernel.V, kernel.V]
        if k == 0:
            break
        step = np.eye(kernel.STATES)
        step[kernel.V, kernel.LEAKAGE], step[kernel.V, kernel.OFFSET_Y] = -n.dt * middle[k, 2], -n.dt
        step[kernel.U, kernel.V], step[kernel.U, kernel.OFFSET_X] = n.dt * middle[k, 0], -n.dt
        step *= decay[:, None]
        predicted = step @ means[k - 1] + constant
        predicted[[kernel.V, kernel.U]] += n.dt * (middle[k, 2] - turn[k]), n.dt * middle[k, 3]
        noise[kernel.V] = n.dt * (n.noise_vy**2 + (n.noise_delay * turning[k] / n.dt * rows[k, 1]) ** 2)
        spread = step @ covariances[k - 1] @ step.T + np.diag(noise)
        gain = np.linalg.solve(spread, step @ covariances[k - 1]).T
        x, p = means[k - 1] + gain @ (x - predicted), covariances[k - 1] + gain @ (p - spread) @ gain.T
    own = found[:, 0] + n.rear_known * (n.rear - found[:, 1]) * rows[:, 0]
    steady = rows[:, 0] * (n.rear - n.compliance * np.square(rows[:, 1]))
    moving = np.clip(rows[:, 1] / n.minimum_speed - 1.0, 0.0, 1.0)
    shares = last.weights * np.column_stack([moving, moving, np.ones(len(rows))])
    shares[:, kernel.BANK] = 1.0 - shares[:, kernel.NETWORK] - shares[:, kernel.STEADY]
    values = np.column_stack([own, network, steady])
    vy = (shares * values).sum(axis=1)
    variance = found[:, 2] + (shares * np.square(values - vy[:, None])).sum(axis=1)
    return np.column_stack([vy, variance + np.square(n.angle_floor * rows[:, 1]) + np.square(n.point * rows[:, 0])])
