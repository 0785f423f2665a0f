"""The KS-NN recursion, compiled: predictions and, in the same pass, their derivatives.

Windows lie side by side in lanes, so that loops over them become vector instructions. Of the local models only the active ones count: the
parameters that enter linearly are blended before they are used, and the neurons are those of each lane's two active models.

A row of local model p holds [γ₁, γ₂, β₁, β₂, w₁, b of f₁, w₁, b of f₂, then (w₂, b₂, w₃) of each neuron of f₁ and of f₂] in the notation of
Da Lio et al. 2023, Eqs. 7 and 8.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehest.estimators.kernels.activation import tanh
from vehest.estimators.kernels.compiling import entry, part
from vehest.estimators.kernels.threads import over_members

Floats = NDArray[Any]

LANES = 64
LINEAR = 8  # parameters of a local model besides its neurons
ROWS = LINEAR + 11  # what the adjoint reads of a step: blended parameters, and the rows named below
YAW_RATE, SPEED, SLIP, ERROR, V, U, THRUST, POSITION, MODEL, F1, F2 = range(LINEAR * LANES, ROWS * LANES, LANES)
NEURON = 3  # rows of a neuron: w₂ and w₃ of the lane's local model, and its output


def shapes_of(n_local: int, n_hidden: int, *, bias: bool) -> dict[str, tuple[int, ...]]:
    """Parameters of a network by name, with their shapes."""
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("gamma", "beta", "linear_weight"), (n_local, 2))
    shapes |= {"linear_bias": (n_local, 2)} if bias else {}
    if n_hidden:
        shapes |= dict.fromkeys(("hidden_weight", "output_weight"), (n_local, 2, n_hidden))
        shapes |= {"hidden_bias": (n_local, 2, n_hidden), "output_bias": (n_local, 2)} if bias else {}
    return shapes


def packed(library: Any, parameters: Mapping[str, Any]) -> Any:
    """Parameters by name, (..., P, 2) or (..., P, 2, Q), as rows of local models, (..., P, 8 + 6 Q).

    ``library`` is the one whose arrays they are, NumPy or PyTorch.
    """
    p, gamma = parameters, parameters["gamma"]
    bias = p.get("linear_bias", library.zeros_like(gamma))
    if "output_bias" in p:
        bias = bias + p["output_bias"]
    pieces = [gamma, p["beta"], library.stack([p["linear_weight"], bias], -1).reshape(*gamma.shape[:-1], 4)]
    if "hidden_weight" in p:
        weight = p["hidden_weight"]
        neurons = library.stack([weight, p.get("hidden_bias", library.zeros_like(weight)), p["output_weight"]], -1)
        pieces.append(neurons.reshape(*gamma.shape[:-1], -1))
    return library.concatenate(pieces, -1)


def predictions(
    theta: Floats,
    series: Floats,
    starts: NDArray[np.int64],
    yaw_rate_max: float,
    step: float,
    n_window: int,
    *,
    differentiated: bool = False,
) -> tuple[Floats, Floats]:
    """Lateral velocity one step after each window.

    Args:
        theta: parameters, (M, P, 8 + 6 Q).
        series: measurements yaw_rate, vx, ay, ax, (T, 4).
        starts: first row of each window, (M, B).
        yaw_rate_max: centre of the last local model [rad/s].
        step: sampling time [s].
        n_window: samples N in a window.
        differentiated: whether derivatives are wanted.

    Returns:
        (M, B) [m/s], and its derivatives by the parameters, in blocks of lanes, (M, blocks, P, (8 + 6 Q) · lanes); of no block otherwise.
    """
    members, batch = starts.shape
    blocks, scalar = -(-batch // LANES), theta.dtype.type
    settings = (scalar(yaw_rate_max), scalar(step), (theta.shape[2] - LINEAR) // 6, n_window)
    values = np.empty((members, blocks * LANES), theta.dtype)
    jacobian = np.empty((members, blocks if differentiated else 0, theta.shape[1], theta.shape[2] * LANES), theta.dtype)

    def work(m: int, end: int) -> None:
        _recursion(theta[m:end], series, starts[m:end], *settings, values[m:end], jacobian[m:end])

    over_members(work, members)
    return values[:, :batch], jacobian


def weighted_sum(jacobian: Floats, weights: Floats) -> Floats:
    """Derivatives of `predictions` summed over the windows with weights (M, B), (M, P, 8 + 6 Q)."""
    members, _, n_local, width = jacobian.shape
    gradient = np.empty((members, n_local, width // LANES), jacobian.dtype)
    _weighted_sum(jacobian, weights, gradient)  # too little to share
    return gradient


@entry(fastmath=True, nogil=True)
def _weighted_sum(jacobian, weights, gradient):  # type: ignore[no-untyped-def]
    members, blocks, n_local, width = jacobian.shape
    row = np.empty(LANES, weights.dtype)
    for m in range(members):
        gradient[m] = 0
        for block in range(blocks):
            used = min(LANES, weights.shape[1] - block * LANES)
            row[:] = 0  # lanes without a window count for nothing
            for lane in range(used):
                row[lane] = weights[m, block * LANES + lane]
            for p in range(n_local):
                for c in range(width // LANES):
                    derivative = jacobian[m, block, p, c * LANES : (c + 1) * LANES]
                    total = row[0] * 0
                    for lane in range(LANES):
                        total += row[lane] * derivative[lane]
                    gradient[m, p, c] += total


@entry(fastmath=True, nogil=True)
def _recursion(theta, series, starts, yaw_rate_max, step, n_hidden, n_window, values, jacobian):  # type: ignore[no-untyped-def]
    members, n_local = theta.shape[:2]
    dtype = theta.dtype
    wanted = jacobian.shape[1] > 0
    per_width = dtype.type(n_local - 1) / yaw_rate_max
    kept = n_window if wanted else 1  # steps to remember
    steps = np.empty((kept, ROWS * LANES), dtype)
    neurons = np.empty((kept, 4 * n_hidden, NEURON * LANES), dtype)  # active model, feedback function, neuron
    first = np.empty(LANES, np.int64)
    state, scratch = np.empty(2 * LANES, dtype), np.empty(LINEAR * LANES, dtype)
    for m in range(members):
        for block in range(values.shape[1] // LANES):
            for lane in range(LANES):  # lanes without a window repeat the last one
                first[lane] = starts[m, min(block * LANES + lane, starts.shape[1] - 1)]
                state[lane], state[LANES + lane] = 0, series[first[lane], 1]
            for k in range(n_window):
                at = k if wanted else 0
                _gather(series, first, k, steps[at], step)
                _forward(theta[m], per_width, step, n_hidden, steps[at], neurons[at], scratch, state)
            for lane in range(LANES):
                values[m, block * LANES + lane] = state[lane]
            if wanted:
                jacobian[m, block] = 0
                state[:LANES], state[LANES:] = 1, 0  # derivatives of the prediction by v and û after the last step
                for k in range(n_window - 1, -1, -1):
                    _backward(theta[m], step, n_hidden, steps[k], neurons[k], scratch, state, jacobian[m, block])


@part(fastmath=True, nogil=True)
def _gather(series, first, k, now, step):  # type: ignore[no-untyped-def]
    for lane in range(LANES):
        t = first[lane] + k
        omega, speed = series[t, 0], series[t, 1]
        now[YAW_RATE + lane], now[SPEED + lane] = omega, speed
        now[SLIP + lane] = step * (series[t, 2] - speed * omega)
        now[THRUST + lane] = step * series[t, 3]


@part(fastmath=True, nogil=True)
def _forward(theta, per_width, step, n_hidden, now, neurons, scratch, state):  # type: ignore[no-untyped-def]
    """One step of all lanes; ``state`` holds v and û."""
    n_local = theta.shape[0]
    one, zero = theta.dtype.type(1), theta.dtype.type(0)
    last, last_pair = theta.dtype.type(n_local - 1), theta.dtype.type(max(n_local - 2, 0))
    for lane in range(LANES):
        position = min(abs(now[YAW_RATE + lane]) * per_width, last)
        now[POSITION + lane] = position
        now[MODEL + lane] = min(np.floor(position), last_pair)
        v, u = state[lane], state[LANES + lane]
        now[V + lane], now[U + lane] = v, u
        now[ERROR + lane] = u - now[SPEED + lane]
        now[THRUST + lane] += step * v * now[YAW_RATE + lane]
    now[: LINEAR * LANES] = zero
    for q in range(n_local):
        row, centre = theta[q], theta.dtype.type(q)
        for lane in range(LANES):
            phi = max(one - abs(now[POSITION + lane] - centre), zero)
            now[lane] += phi * row[0]
            now[LANES + lane] += phi * row[1]
            now[2 * LANES + lane] += phi * row[2]
            now[3 * LANES + lane] += phi * row[3]
            now[4 * LANES + lane] += phi * row[4]
            now[5 * LANES + lane] += phi * row[5]
            now[6 * LANES + lane] += phi * row[6]
            now[7 * LANES + lane] += phi * row[7]
    for lane in range(LANES):
        error = now[ERROR + lane]
        now[F1 + lane] = now[4 * LANES + lane] * error + now[5 * LANES + lane]
        now[F2 + lane] = now[6 * LANES + lane] * error + now[7 * LANES + lane]
    for side in range(min(2, n_local) if n_hidden else 0):
        for i in range(2):
            value = now[F1 + i * LANES : F1 + (i + 1) * LANES]
            for j in range(n_hidden):
                neuron = neurons[(2 * side + i) * n_hidden + j]
                _choose(theta, side, LINEAR + 3 * (i * n_hidden + j), now, neuron, scratch)
                for lane in range(LANES):
                    neuron[2 * LANES + lane] = tanh(neuron[lane] * now[ERROR + lane] + scratch[lane])
                for lane in range(LANES):
                    beyond = now[POSITION + lane] - now[MODEL + lane]
                    phi = beyond if side == 1 else one - beyond
                    value[lane] += phi * neuron[LANES + lane] * neuron[2 * LANES + lane]
    for lane in range(LANES):
        forced = now[2 * LANES + lane] * now[SLIP + lane] - now[YAW_RATE + lane] * now[F1 + lane]
        state[lane] = now[lane] * now[V + lane] + forced
        state[LANES + lane] = now[LANES + lane] * now[U + lane] + now[3 * LANES + lane] * now[THRUST + lane] - now[F2 + lane]


@part(fastmath=True, nogil=True)
def _choose(theta, side, column, now, neuron, offset):  # type: ignore[no-untyped-def]
    """w₂, b₂, w₃ of one neuron of the lanes' first (side 0) or second (side 1) active model."""
    w2, b2, w3 = theta[side, column], theta[side, column + 1], theta[side, column + 2]
    for lane in range(LANES):
        neuron[lane], offset[lane], neuron[LANES + lane] = w2, b2, w3
    for p in range(1, theta.shape[0] - 1):
        w2, b2, w3 = theta[p + side, column], theta[p + side, column + 1], theta[p + side, column + 2]
        model = theta.dtype.type(p)
        for lane in range(LANES):
            here = now[MODEL + lane] == model
            neuron[lane] = w2 if here else neuron[lane]
            offset[lane] = b2 if here else offset[lane]
            neuron[LANES + lane] = w3 if here else neuron[LANES + lane]


@part(fastmath=True, nogil=True)
def _backward(theta, step, n_hidden, now, neurons, scratch, state, jacobian):  # type: ignore[no-untyped-def]
    """Adjoint of one step; ``state`` holds the derivatives by v and û, ``jacobian`` (P, parameters · lanes) adds up those by parameters."""
    n_local = theta.shape[0]
    one, zero = theta.dtype.type(1), theta.dtype.type(0)
    for lane in range(LANES):
        to_v, to_u = state[lane], state[LANES + lane]
        omega, error = now[YAW_RATE + lane], now[ERROR + lane]
        to_f1, to_f2 = -omega * to_v, -to_u
        scratch[lane] = to_v * now[V + lane]
        scratch[LANES + lane] = to_u * now[U + lane]
        scratch[2 * LANES + lane] = to_v * now[SLIP + lane]
        scratch[3 * LANES + lane] = to_u * now[THRUST + lane]
        scratch[4 * LANES + lane] = to_f1 * error
        scratch[5 * LANES + lane] = to_f1
        scratch[6 * LANES + lane] = to_f2 * error
        scratch[7 * LANES + lane] = to_f2
        state[lane] = now[lane] * to_v + now[3 * LANES + lane] * step * omega * to_u
        state[LANES + lane] = now[LANES + lane] * to_u + now[4 * LANES + lane] * to_f1 + now[6 * LANES + lane] * to_f2
    for q in range(n_local):
        slot, centre = jacobian[q], theta.dtype.type(q)
        for lane in range(LANES):
            phi = max(one - abs(now[POSITION + lane] - centre), zero)
            slot[lane] += phi * scratch[lane]
            slot[LANES + lane] += phi * scratch[LANES + lane]
            slot[2 * LANES + lane] += phi * scratch[2 * LANES + lane]
            slot[3 * LANES + lane] += phi * scratch[3 * LANES + lane]
            slot[4 * LANES + lane] += phi * scratch[4 * LANES + lane]
            slot[5 * LANES + lane] += phi * scratch[5 * LANES + lane]
            slot[6 * LANES + lane] += phi * scratch[6 * LANES + lane]
            slot[7 * LANES + lane] += phi * scratch[7 * LANES + lane]
    for side in range(min(2, n_local) if n_hidden else 0):
        for i in range(2):
            to_f = scratch[(5 + 2 * i) * LANES : (6 + 2 * i) * LANES]
            for j in range(n_hidden):
                neuron = neurons[(2 * side + i) * n_hidden + j]
                for lane in range(LANES):
                    beyond = now[POSITION + lane] - now[MODEL + lane]
                    a = to_f[lane] * (beyond if side == 1 else one - beyond)
                    h = neuron[2 * LANES + lane]
                    inner = a * neuron[LANES + lane] * (one - h * h)
                    state[LANES + lane] += inner * neuron[lane]
                    scratch[lane], scratch[LANES + lane] = inner, a * h
                column = (LINEAR + 3 * (i * n_hidden + j)) * LANES
                for p in range(max(n_local - 1, 1)):
                    slot, model = jacobian[p + side, column : column + 3 * LANES], theta.dtype.type(p)
                    for lane in range(LANES):
                        here = one if now[MODEL + lane] == model else zero
                        slot[lane] += here * scratch[lane] * now[ERROR + lane]
                        slot[LANES + lane] += here * scratch[lane]
                        slot[2 * LANES + lane] += here * scratch[LANES + lane]
