"""Smoothing of a whole drive by the self-calibrating filter.

    samples --_filter_pass--> filtered states of the likeliest filter --_backward_pass--> smoothed
    smoothed bank, network, steady cornering --weights at the end--> vy, variance

It needs the whole drive, so that an estimate of it is offline.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from vehest.constants import FloatArray
from vehest.estimators.kernels import self_calibrating as kernel


class FilterPass(NamedTuple):
    """The likeliest filter of the bank over a drive of T samples."""

    samples: FloatArray  # yaw rate [rad/s], u [m/s], ay, ax [m/s²] as the filter used them, (T, 4)
    means: FloatArray  # filtered means of the states, (T, 8)
    covariances: FloatArray  # covariances of the states, (T, 8, 8)
    network: FloatArray  # v of the network [m/s], (T,)
    turning: FloatArray  # change of the low-passed yaw rate in each sample [rad/s], (T,)
    lateral: FloatArray  # size of the low-passed ay [m/s²], (T,)


def smooth(estimator: Any, samples: FloatArray, state: kernel.State) -> FloatArray:
    """Smooth a whole drive: v [m/s] at the reference point and its variance [m²/s²], (T, 2).

    The filter that is likeliest at the drive's end is smoothed, its parameters included. Network
    and steady cornering count by their weights at the end, and lateral accelerations beyond what
    the whole drive has reached widen the band.

    Parameters
    ----------
    estimator : SelfCalibrating
        Its settings, priors and network.
    samples : array
        Of its channels, (T, C).
    state : State
        Before the first of them.

    Source: Rauch, Tung and Striebel, Maximum likelihood estimates of linear dynamic systems, AIAA
    Journal 3 (8), 1965.
    """
    _, _, last_state = estimator.trace(samples, state)
    likeliest = int(np.argmax(last_state.log_weights))
    before = state.last.copy()
    filtered = _filter_pass(estimator, samples, state, likeliest)
    smoothed = _backward_pass(estimator, filtered, before)
    n = estimator.numbers()
    yaw_rate, speed = filtered.samples[:, 0], filtered.samples[:, 1]
    rear = smoothed[:, 1]
    shift = n.is_moved * (n.point - rear) * yaw_rate
    bank = smoothed[:, 0] + shift
    network = filtered.network + ((rear - n.network_rear) * yaw_rate + shift)
    steady = yaw_rate * (rear - n.compliance * np.square(speed)) + shift
    moving = np.clip(speed / n.minimum_speed - 1.0, 0.0, 1.0)
    shares = last_state.weights * np.column_stack([moving, moving, np.ones(len(speed))])
    shares[:, kernel.BANK] = 1.0 - shares[:, kernel.NETWORK] - shares[:, kernel.STEADY]
    values = np.column_stack([bank, network, steady])
    vy = (shares * values).sum(axis=1)
    variance = smoothed[:, 2] + (shares * np.square(values - vy[:, None])).sum(axis=1)
    angle_variance = np.square(n.angle_floor * speed)
    point_variance = np.square(n.point_deviation * yaw_rate)
    beyond = np.maximum(filtered.lateral - last_state.lags[kernel.REACHED], 0.0)
    unreached = beyond / np.maximum(filtered.lateral, kernel.LEAST_AY)
    rolling = (n.is_moved * n.point + (1.0 - n.is_moved) * rear) * yaw_rate
    parts = np.abs(rolling) + np.abs(vy - rolling)
    unreached_variance = np.square(n.unreached_share * unreached * parts)
    return np.column_stack([vy, variance + angle_variance + point_variance + unreached_variance])


def _filter_pass(
    estimator: Any, samples: FloatArray, state: kernel.State, likeliest: int
) -> FilterPass:
    """Run the bank's recursion forwards and record the states of its likeliest filter.

    Parameters
    ----------
    estimator : SelfCalibrating
        Its numbers and network.
    samples : array
        (T, C).
    state : State
        Before the first sample; it is not changed.
    likeliest : int
        Index of the filter in the bank.
    """
    state = kernel.State(*(part.copy() for part in state))
    rows = estimator.with_ax(samples).copy()
    means = np.empty((len(rows), kernel.STATES))
    covariances = np.empty((len(rows), kernel.STATES, kernel.STATES))
    network = np.empty(len(rows))
    turning = np.empty(len(rows))
    lateral = np.empty(len(rows))
    scratch = (np.empty((1, 2)), np.empty((1, 2 * kernel.STATES)))
    for k in range(len(rows)):
        network[k] = state.lags[kernel.PREDICTED]
        turning[k] = -state.lags[kernel.YAW_RATE]
        sample = rows[k : k + 1]
        kernel.scan(*estimator.recursion_arguments, estimator.network, state, sample, *scratch)
        turning[k] += state.lags[kernel.YAW_RATE]
        lateral[k] = abs(state.lags[kernel.AY])
        means[k] = state.means[likeliest]
        covariances[k] = state.covariances[likeliest]
        rows[k] = state.last
    return FilterPass(rows, means, covariances, network, turning, lateral)


def _backward_pass(estimator: Any, filtered: FilterPass, before: FloatArray) -> FloatArray:
    """Smooth the states of one filter from the last sample to the first.

        x_{k-1} += G (x_k - x⁻_k),  P_{k-1} += G (P_k - P⁻_k) Gᵀ,  G = P_{k-1} Fᵀ (P⁻_k)⁻¹

    with the linearised transition F of the kernel, rebuilt from the samples. Decays and noise are
    those of the forward pass.

    Parameters
    ----------
    estimator : SelfCalibrating
        Its numbers, priors and noise.
    filtered : FilterPass
        The forward pass.
    before : array
        Yaw rate, u, ay, ax before the first sample, (4,).

    Returns
    -------
    array
        v at the inertial unit [m/s], b [m], and the variance of v at the reference point [m²/s²],
        (T, 3).
    """
    n = estimator.numbers()
    decay = estimator.decay
    rows, means, covariances, _, turning, _ = filtered
    middle = (np.vstack([before, rows[:-1]]) + rows) / 2.0  # yaw rate, u, ay, ax
    turn = rows[:, 0] * rows[:, 1]
    turn = (np.append(before[0] * before[1], turn[:-1]) + turn) / 2.0
    constant = estimator.prior[0] * (1.0 - decay)
    constant[[kernel.V, kernel.U]] = 0.0
    noise = np.tile(estimator.noise, (len(rows), 1))
    noise[:, kernel.V] += n.dt * (n.noise_delay * turning / n.dt * rows[:, 1]) ** 2
    x = means[-1].copy()
    p = covariances[-1].copy()
    smoothed = np.empty((len(rows), 3))
    row = np.zeros(kernel.STATES)
    row[kernel.V] = 1.0
    for k in range(len(rows) - 1, -1, -1):
        row[kernel.REAR] = -n.is_moved * rows[k, 0]
        smoothed[k] = x[kernel.V], x[kernel.REAR], row @ p @ row
        if k == 0:
            break
        step = np.eye(kernel.STATES)
        step[kernel.V, kernel.LEAKAGE] = -n.dt * middle[k, 2]
        step[kernel.V, kernel.OFFSET_Y] = -n.dt
        step[kernel.U, kernel.V] = n.dt * middle[k, 0]
        step[kernel.U, kernel.OFFSET_X] = -n.dt
        step *= decay[:, None]
        predicted = step @ means[k - 1] + constant
        predicted[[kernel.V, kernel.U]] += n.dt * (middle[k, 2] - turn[k]), n.dt * middle[k, 3]
        spread = step @ covariances[k - 1] @ step.T + np.diag(noise[k])
        gain = np.linalg.solve(spread, step @ covariances[k - 1]).T
        x = means[k - 1] + gain @ (x - predicted)
        p = covariances[k - 1] + gain @ (p - spread) @ gain.T
    return smoothed
