"""The KS-NN recursion, compiled: predictions and, in the same pass, their derivatives.

One step of a window (Da Lio et al. 2023, Eq. 7), with φ_p the weights of the local models p at |ω|
(Eq. 9), e = û - u, γ = Σ_p φ_p γ_p and likewise β, and
f_i(e) = b_i + w_i e + Σ_j w₃ tanh(w₂ e + b₂) blended likewise (Eq. 8):

    v⁺ = γ₁ v + β₁ τ (a_y - u ω) - ω f₁(e)
    û⁺ = γ₂ û + β₂ τ (a_x + v ω) - f₂(e)

The readable definition of the same equations in torch is `vehest.estimators.networks.ksnn`.
Adjoint, with f̄₁ = -ω v̄⁺, f̄₂ = -û̄⁺:

    v̄ = γ₁ v̄⁺ + β₂ τ ω û̄⁺,   û̄ = γ₂ û̄⁺ + Σ_i f_i' f̄_i
    γ̄₁,p += φ_p v v̄⁺,  β̄₁,p += φ_p τ (a_y - u ω) v̄⁺,  γ̄₂,p, β̄₂,p likewise with û̄⁺
    w̄_i,p += φ_p e f̄_i,  b̄_i,p += φ_p f̄_i

and through tanh' = 1 - tanh² to w₂, b₂, w₃ of the active models.

Order of sums: local models in order of p, then neurons in order of j; gradients over samples
backwards in time, lane by lane, and over lanes at the end of a batch.

    flat parameters --slots--> theta --_forward, k = 0 … N-1--> predictions
    --slopes_of--> _backward, k = N-1 … 0 --> gradient

Windows lie side by side in lanes. The parameters of local models that enter linearly are blended
before they are used, and the neurons are those of each lane's two active models.

A row of local model p holds [γ₁, γ₂, β₁, β₂, w₁, b of f₁, w₁, b of f₂, then (w₂, b₂, w₃) of each
neuron of f₁ and of f₂] in the notation of Da Lio et al. 2023, Eqs. 7 and 8. A parameter is added to
the entry of the rows that its slot names.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.estimators.kernels.activation import tanh
from vehest.estimators.kernels.compiling import entry, part
from vehest.estimators.kernels.recursion import (
    Recursion,
    add,
    gather,
    slopes_of,
    squared_error,
    step_of_adam,
)
from vehest.lanes import choose, least, load, most, store, total, width

LINEAR = 8  # parameters of a local model besides its neurons
# rows that a step saves for its adjoint: v, û, and the blended γ₁, γ₂, β₂ and both w₁
SAVED_ROWS = 7
CHANNELS = 4  # inputs of a sample: yaw rate, speed, ay, ax


def shapes_of(n_local: int, n_hidden: int, *, bias: bool) -> dict[str, tuple[int, ...]]:
    """Shapes of the parameters of a network with P = ``n_local`` and Q = ``n_hidden``, by name."""
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(
        ("gamma", "beta", "linear_weight"), (n_local, 2)
    )
    shapes |= {"linear_bias": (n_local, 2)} if bias else {}
    if n_hidden:
        shapes |= dict.fromkeys(("hidden_weight", "output_weight"), (n_local, 2, n_hidden))
        shapes |= (
            {"hidden_bias": (n_local, 2, n_hidden), "output_bias": (n_local, 2)} if bias else {}
        )
    return shapes


def packed(parameters: Mapping[str, FloatArray]) -> FloatArray:
    """Pack parameters by name, (..., P, 2) or (..., P, 2, Q), into rows of local models, (..., P, 8
    + 6 Q), which the recursion reads.

    A row is [γ₁, γ₂, β₁, β₂, w₁, b of f₁, w₁, b of f₂, (w₂, b₂, w₃) of each neuron of f₁, then of
    f₂]. The two biases of a feedback function are added; a missing one is 0.
    """
    p = parameters
    gamma = parameters["gamma"]
    bias = p.get("linear_bias", np.zeros_like(gamma))
    if "output_bias" in p:
        bias = bias + p["output_bias"]
    pieces = [
        gamma,
        p["beta"],
        np.stack([p["linear_weight"], bias], -1).reshape(*gamma.shape[:-1], 4),
    ]
    if "hidden_weight" in p:
        weight = p["hidden_weight"]
        neurons = np.stack(
            [weight, p.get("hidden_bias", np.zeros_like(weight)), p["output_weight"]], -1
        )
        pieces.append(neurons.reshape(*gamma.shape[:-1], -1))
    return np.concatenate(pieces, -1)


def c_tables(
    theta: FloatArray, window: int, rate_hz: float, yaw_rate_max: float, *, bias: bool
) -> dict[str, Any]:
    """Values of the C template of a network with rows of `packed`, (P, 8 + 6 Q).

    Biases are left out without ``bias``.
    """
    n_local = len(theta)
    n_hidden = (theta.shape[1] - LINEAR) // 6
    return {
        "window": window,
        "local": n_local,
        "active": min(n_local, 2),
        "hidden": n_hidden,
        "bias": bias,
        "step": 1.0 / rate_hz,
        "per_width": (n_local - 1) / yaw_rate_max,
        "linear": theta[:, [0, 1, 2, 3, 4, 6] + [5, 7] * bias],
        "neurons": theta[:, LINEAR:].reshape(n_local, 2, n_hidden, 3)[..., [0, 2] + [1] * bias],
    }


def recursion_of(settings: Any, yaw_rate_max: float) -> Recursion:
    """The recursion of a network with parameters in the order of `shapes_of`.

    Its last local model is centred at a yaw rate [rad/s].

    The slots are found by packing the identity matrix: each parameter's column shows the entry of
    the rows that it is added to.
    """
    views = {}
    first = 0
    shapes = shapes_of(settings.n_local, settings.n_hidden, bias=settings.bias)
    identity = np.eye(sum(int(np.prod(shape)) for shape in shapes.values()))
    for name, shape in shapes.items():
        views[name] = identity[:, first : first + int(np.prod(shape))].reshape(-1, *shape)
        first += int(np.prod(shape))
    slots = packed(views).reshape(len(identity), -1).argmax(1)
    step = 1.0 / settings.rate_hz
    per_width = (settings.n_local - 1) / yaw_rate_max
    return Recursion(
        loop,
        lambda number: (
            slots,
            settings.n_local,
            settings.n_hidden,
            settings.window,
            number(step),
            number(per_width),
        ),
    )


@entry(nogil=True)
def loop(flat, constants, series, starts, targets, batch, values, gradient, losses, adam):
    """Predictions of KS-NN members, and perhaps gradients and steps of Adam.

    See `vehest.estimators.kernels.recursion.Recursion` for the arguments. For each member and
    batch: parameters are added into the rows ``theta``; blocks of windows, as many as a vector has
    lanes, run forward over N samples and, where gradients are wanted, backward; lanes without a
    window have the slope 0. ``constants`` are slots (K,), P, Q, N, the sampling interval τ [s], and
    the local models per rad/s of yaw rate.
    """
    slots, n_local, n_hidden, n_window, step, per_width = constants
    lanes = width(series)
    neurons = 4 * n_hidden
    theta = np.empty(n_local * (LINEAR + 6 * n_hidden), flat.dtype)
    sums = np.empty(theta.size * lanes, flat.dtype)
    scratch = np.empty(lanes, flat.dtype)
    measured = series.ravel()
    rows = np.empty(lanes, np.int64)
    windows = np.empty(n_window * CHANNELS * lanes, flat.dtype)
    saved = np.empty(n_window * SAVED_ROWS * lanes, flat.dtype)
    outputs = np.empty(max(n_window * neurons * 3, 1) * lanes, flat.dtype)
    car = (theta, n_local, n_hidden, step, per_width)
    room = (windows, saved, outputs)
    for m in range(flat.shape[0]):
        for number, start in enumerate(range(0, starts.shape[1], batch)):
            end = min(start + batch, starts.shape[1])
            predictions = values[m, start:end]
            theta[:] = 0
            for j in range(slots.size):
                theta[slots[j]] += flat[m, j]
            sums[:] = 0
            for first in range(0, predictions.size, lanes):
                gather(measured, CHANNELS, starts[m, start:end], first, rows, windows, CHANNELS)
                v = load(scratch, 0) * 0
                v = load(windows, lanes) * 0
                u = load(windows, lanes)
                for k in range(n_window):
                    v, u = _forward(car, room, k, v, u)
                store(scratch, 0, v)
                for lane in range(min(lanes, predictions.size - first)):
                    predictions[first + lane] = scratch[lane]
                if gradient.size:
                    slopes_of(predictions, targets[m, start:end], first, losses.size > 0, scratch)
                    v = load(scratch, 0)
                    u = load(scratch, 0) * 0
                    for k in range(n_window - 1, -1, -1):
                        v, u = _backward(car, room, k, v, u, sums)
            if gradient.size:
                for c in range(theta.size):
                    theta[c] = total(load(sums, c * lanes))
                for j in range(slots.size):
                    gradient[m, j] = theta[slots[j]]
            if losses.size:
                losses[m] += squared_error(predictions, targets[m, start:end])
                step_of_adam(flat[m], gradient[m], adam, m, number + 1)


@part(_nrt=False)
def _forward(car, room, k, v, u):
    """Compute lateral velocity v and longitudinal velocity û [m/s] after step k in all lanes.

    Leaves ``saved`` rows and neurons' ``outputs`` for `_backward`.

    Parameters
    ----------
    car : tuple
        Rows ``theta``, P, Q, τ [s], and local models per yaw rate [s/rad].
    room : tuple
        Windows (N, 4, lanes), saved rows (N, `SAVED_ROWS`, lanes), and outputs of neurons.
    k : int
        Sample of the window.
    v, u : vector
        v and û before the step [m/s].
    """
    theta, n_local, n_hidden, step, per_width = car
    windows, saved, outputs = room
    lanes = width(theta)
    row = LINEAR + 6 * n_hidden
    window_at = k * CHANNELS * lanes
    saved_at = k * SAVED_ROWS * lanes
    neuron = k * 4 * n_hidden * 3 * lanes
    omega = load(windows, window_at)
    speed = load(windows, window_at + lanes)
    position = least(abs(omega) * per_width, n_local - 1)
    phi = most(1 - position, 0)
    g1 = phi * theta[0]
    g2 = phi * theta[1]
    b1 = phi * theta[2]
    b2 = phi * theta[3]
    w1 = phi * theta[4]
    f1 = phi * theta[5]
    w2 = phi * theta[6]
    f2 = phi * theta[7]
    for p in range(1, n_local):
        phi = most(1 - abs(position - p), 0)
        base = p * row
        g1 = g1 + phi * theta[base + 0]
        g2 = g2 + phi * theta[base + 1]
        b1 = b1 + phi * theta[base + 2]
        b2 = b2 + phi * theta[base + 3]
        w1 = w1 + phi * theta[base + 4]
        f1 = f1 + phi * theta[base + 5]
        w2 = w2 + phi * theta[base + 6]
        f2 = f2 + phi * theta[base + 7]
    error = u - speed
    f1 = f1 + w1 * error
    f2 = f2 + w2 * error
    if n_hidden:
        model = _model(position, n_local)
        for side in range(min(2, n_local)):
            fraction = position - model
            phi = fraction if side == 1 else 1 - fraction
            for i in range(2):
                value = error * 0
                for j in range(n_hidden):
                    column = side * row + LINEAR + 3 * (i * n_hidden + j)
                    inner, offset, outer = _chosen(theta, column, model, n_local, row)
                    at = neuron + ((2 * side + i) * n_hidden + j) * 3 * lanes
                    h = tanh(inner * error + offset)
                    store(outputs, at, inner)
                    store(outputs, at + lanes, outer)
                    store(outputs, at + 2 * lanes, h)
                    value = value + outer * h
                if i == 0:
                    f1 = f1 + phi * value
                else:
                    f2 = f2 + phi * value
    store(saved, saved_at, v)
    store(saved, saved_at + lanes, u)
    store(saved, saved_at + 2 * lanes, g1)
    store(saved, saved_at + 3 * lanes, g2)
    store(saved, saved_at + 4 * lanes, b2)
    store(saved, saved_at + 5 * lanes, w1)
    store(saved, saved_at + 6 * lanes, w2)
    slip = step * (load(windows, window_at + 2 * lanes) - speed * omega)
    thrust = step * (load(windows, window_at + 3 * lanes) + v * omega)
    return g1 * v + b1 * slip - omega * f1, g2 * u + b2 * thrust - f2


@part(_nrt=False)
def _model(position, n_local):
    """Index of the first active local model of each lane, by the ``position`` of its |ω| among the
    centres.

    The active models of a lane are this one and the next; φ is zero for all others.
    """
    model = position * 0
    for p in range(1, n_local - 1):
        model = choose(position >= p, p, model)
    return model


@part(_nrt=False)
def _chosen(theta, column, model, n_local, row):
    """w₂, b₂, w₃ of one neuron of the lanes' active models.

    ``column`` is the neuron's first entry in the rows of the first active model.
    """
    w2 = model * 0 + theta[column]
    b2 = model * 0 + theta[column + 1]
    w3 = model * 0 + theta[column + 2]
    for p in range(1, n_local - 1):
        at = column + p * row
        is_active = model == p
        w2 = choose(is_active, theta[at], w2)
        b2 = choose(is_active, theta[at + 1], b2)
        w3 = choose(is_active, theta[at + 2], w3)
    return w2, b2, w3


@part(_nrt=False)
def _backward(car, room, k, v_bar, u_bar, sums):
    """Adjoint of step k: returns v̄ and û̄ before the step from those after it, and adds the
    gradients of parameters to ``sums``.


    Equations: see the module. ``sums`` has a vector for each entry of ``theta``, so that no lane
    waits for another.
    """
    theta, n_local, n_hidden, step, per_width = car
    windows, saved, outputs = room
    lanes = width(theta)
    row = LINEAR + 6 * n_hidden
    window_at = k * CHANNELS * lanes
    saved_at = k * SAVED_ROWS * lanes
    neuron = k * 4 * n_hidden * 3 * lanes
    omega = load(windows, window_at)
    speed = load(windows, window_at + lanes)
    v = load(saved, saved_at)
    u = load(saved, saved_at + lanes)
    error = u - speed
    position = least(abs(omega) * per_width, n_local - 1)
    slip = step * (load(windows, window_at + 2 * lanes) - speed * omega)
    thrust = step * (load(windows, window_at + 3 * lanes) + v * omega)
    f1_bar = -omega * v_bar
    f2_bar = -u_bar
    for p in range(n_local):
        phi = most(1 - abs(position - p), 0)
        at = p * row * lanes
        add(sums, at, phi * v_bar * v)
        add(sums, at + lanes, phi * u_bar * u)
        add(sums, at + 2 * lanes, phi * v_bar * slip)
        add(sums, at + 3 * lanes, phi * u_bar * thrust)
        add(sums, at + 4 * lanes, phi * f1_bar * error)
        add(sums, at + 5 * lanes, phi * f1_bar)
        add(sums, at + 6 * lanes, phi * f2_bar * error)
        add(sums, at + 7 * lanes, phi * f2_bar)
    v_bar_before = (
        load(saved, saved_at + 2 * lanes) * v_bar
        + load(saved, saved_at + 4 * lanes) * step * omega * u_bar
    )
    u_bar_before = (
        load(saved, saved_at + 3 * lanes) * u_bar
        + load(saved, saved_at + 5 * lanes) * f1_bar
        + load(saved, saved_at + 6 * lanes) * f2_bar
    )
    if n_hidden:
        model = _model(position, n_local)
        for side in range(min(2, n_local)):
            fraction = position - model
            phi = fraction if side == 1 else 1 - fraction
            for i in range(2):
                a = phi * (f1_bar if i == 0 else f2_bar)
                for j in range(n_hidden):
                    at = neuron + ((2 * side + i) * n_hidden + j) * 3 * lanes
                    h = load(outputs, at + 2 * lanes)
                    inner = a * load(outputs, at + lanes) * (1 - h * h)
                    u_bar_before = u_bar_before + inner * load(outputs, at)
                    column = side * row + LINEAR + 3 * (i * n_hidden + j)
                    for p in range(max(n_local - 1, 1)):
                        is_active = model == p
                        slot = (column + p * row) * lanes
                        active_inner = choose(is_active, inner, 0)
                        add(sums, slot, active_inner * error)
                        add(sums, slot + lanes, active_inner)
                        add(sums, slot + 2 * lanes, choose(is_active, a * h, 0))
    return v_bar_before, u_bar_before
