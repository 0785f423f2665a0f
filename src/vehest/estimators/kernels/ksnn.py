"""The KS-NN recursion, compiled: predictions and, in the same pass, their derivatives.

Windows lie side by side in lanes. The parameters of local models that enter linearly are blended before they are used, and the neurons are
those of each lane's two active models.

A row of local model p holds [γ₁, γ₂, β₁, β₂, w₁, b of f₁, w₁, b of f₂, then (w₂, b₂, w₃) of each neuron of f₁ and of f₂] in the notation of
Da Lio et al. 2023, Eqs. 7 and 8. A parameter is added to the entry of the rows that its slot names.
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
KEPT = 7  # rows that a step leaves for its adjoint: v, û, and the blended γ₁, γ₂, β₂ and two w₁
CHANNELS = 4


def shapes_of(n_local: int, n_hidden: int, *, bias: bool) -> dict[str, tuple[int, ...]]:
    """Parameters of a network by name, with their shapes."""
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
    """Parameters by name, (..., P, 2) or (..., P, 2, Q), as rows of local models, (..., P, 8 + 6 Q)."""
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
    """What the C takes of a network with rows of `packed`, (P, 8 + 6 Q); without ``bias`` their biases are left out."""
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
    """The recursion of a network with parameters in the order of `shapes_of`; its last local model is centred at a yaw rate [rad/s]."""
    own = settings
    views = {}
    first = 0
    shapes = shapes_of(own.n_local, own.n_hidden, bias=own.bias)
    one = np.eye(sum(int(np.prod(shape)) for shape in shapes.values()))
    for name, shape in shapes.items():
        views[name] = one[:, first : first + int(np.prod(shape))].reshape(-1, *shape)
        first += int(np.prod(shape))
    slots = packed(views).reshape(len(one), -1).argmax(1)
    step = 1.0 / own.rate_hz
    per_width = (own.n_local - 1) / yaw_rate_max
    return Recursion(
        loop,
        lambda number: (
            slots,
            own.n_local,
            own.n_hidden,
            own.window,
            number(step),
            number(per_width),
        ),
    )


@entry(nogil=True)
def loop(flat, given, series, starts, targets, batch, values, gradient, losses, adam):  # type: ignore[no-untyped-def]
    """See `vehest.estimators.kernels.recursion.Recursion`."""
    slots, n_local, n_hidden, n_window, step, per_width = given
    lanes = width(series)
    neurons = 4 * n_hidden
    theta = np.empty(n_local * (LINEAR + 6 * n_hidden), flat.dtype)
    sums = np.empty(theta.size * lanes, flat.dtype)
    scratch = np.empty(lanes, flat.dtype)
    measured = series.ravel()
    rows = np.empty(lanes, np.int64)
    seen = np.empty(n_window * CHANNELS * lanes, flat.dtype)
    kept = np.empty(n_window * KEPT * lanes, flat.dtype)
    outputs = np.empty(max(n_window * neurons * 3, 1) * lanes, flat.dtype)
    car = (theta, n_local, n_hidden, step, per_width)
    room = (seen, kept, outputs)
    for m in range(flat.shape[0]):
        for number, start in enumerate(range(0, starts.shape[1], batch)):
            end = min(start + batch, starts.shape[1])
            own = values[m, start:end]
            theta[:] = 0
            for j in range(slots.size):
                theta[slots[j]] += flat[m, j]
            sums[:] = 0
            for first in range(0, own.size, lanes):
                gather(measured, CHANNELS, starts[m, start:end], first, rows, seen, CHANNELS)
                v = load(scratch, 0) * 0
                v = load(seen, lanes) * 0
                u = load(seen, lanes)
                for k in range(n_window):
                    v, u = _forward(car, room, k, v, u)
                store(scratch, 0, v)
                for lane in range(min(lanes, own.size - first)):
                    own[first + lane] = scratch[lane]
                if gradient.size:
                    slopes_of(own, targets[m, start:end], first, losses.size > 0, scratch)
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
                losses[m] += squared_error(own, targets[m, start:end])
                step_of_adam(flat[m], gradient[m], adam, m, number + 1)


@part(_nrt=False)
def _forward(car, room, k, v, u):  # type: ignore[no-untyped-def]
    """v and û after a step of all lanes."""
    theta, n_local, n_hidden, step, per_width = car
    seen, kept, outputs = room
    lanes = width(theta)
    row = LINEAR + 6 * n_hidden
    now = k * CHANNELS * lanes
    then = k * KEPT * lanes
    neuron = k * 4 * n_hidden * 3 * lanes
    omega = load(seen, now)
    speed = load(seen, now + lanes)
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
        own = p * row
        g1 = g1 + phi * theta[own + 0]
        g2 = g2 + phi * theta[own + 1]
        b1 = b1 + phi * theta[own + 2]
        b2 = b2 + phi * theta[own + 3]
        w1 = w1 + phi * theta[own + 4]
        f1 = f1 + phi * theta[own + 5]
        w2 = w2 + phi * theta[own + 6]
        f2 = f2 + phi * theta[own + 7]
    error = u - speed
    f1 = f1 + w1 * error
    f2 = f2 + w2 * error
    if n_hidden:
        model = _model(position, n_local)
        for side in range(min(2, n_local)):
            beyond = position - model
            phi = beyond if side == 1 else 1 - beyond
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
    store(kept, then, v)
    store(kept, then + lanes, u)
    store(kept, then + 2 * lanes, g1)
    store(kept, then + 3 * lanes, g2)
    store(kept, then + 4 * lanes, b2)
    store(kept, then + 5 * lanes, w1)
    store(kept, then + 6 * lanes, w2)
    slip = step * (load(seen, now + 2 * lanes) - speed * omega)
    thrust = step * (load(seen, now + 3 * lanes) + v * omega)
    return g1 * v + b1 * slip - omega * f1, g2 * u + b2 * thrust - f2


@part(_nrt=False)
def _model(position, n_local):  # type: ignore[no-untyped-def]
    """First active local model of each lane."""
    model = position * 0
    for p in range(1, n_local - 1):
        model = choose(position >= p, p, model)
    return model


@part(_nrt=False)
def _chosen(theta, column, model, n_local, row):  # type: ignore[no-untyped-def]
    """w₂, b₂, w₃ of one neuron of the lanes' active models."""
    w2 = model * 0 + theta[column]
    b2 = model * 0 + theta[column + 1]
    w3 = model * 0 + theta[column + 2]
    for p in range(1, n_local - 1):
        at = column + p * row
        here = model == p
        w2 = choose(here, theta[at], w2)
        b2 = choose(here, theta[at + 1], b2)
        w3 = choose(here, theta[at + 2], w3)
    return w2, b2, w3


@part(_nrt=False)
def _backward(car, room, k, to_v, to_u, sums):  # type: ignore[no-untyped-def]
    """Adjoint of one step: derivatives by v and û before it from those after it; ``sums`` adds up those by parameters."""
    theta, n_local, n_hidden, step, per_width = car
    seen, kept, outputs = room
    lanes = width(theta)
    row = LINEAR + 6 * n_hidden
    now = k * CHANNELS * lanes
    then = k * KEPT * lanes
    neuron = k * 4 * n_hidden * 3 * lanes
    omega = load(seen, now)
    speed = load(seen, now + lanes)
    v = load(kept, then)
    u = load(kept, then + lanes)
    error = u - speed
    position = least(abs(omega) * per_width, n_local - 1)
    slip = step * (load(seen, now + 2 * lanes) - speed * omega)
    thrust = step * (load(seen, now + 3 * lanes) + v * omega)
    to_f1 = -omega * to_v
    to_f2 = -to_u
    for p in range(n_local):
        phi = most(1 - abs(position - p), 0)
        at = p * row * lanes
        add(sums, at, phi * to_v * v)
        add(sums, at + lanes, phi * to_u * u)
        add(sums, at + 2 * lanes, phi * to_v * slip)
        add(sums, at + 3 * lanes, phi * to_u * thrust)
        add(sums, at + 4 * lanes, phi * to_f1 * error)
        add(sums, at + 5 * lanes, phi * to_f1)
        add(sums, at + 6 * lanes, phi * to_f2 * error)
        add(sums, at + 7 * lanes, phi * to_f2)
    next_v = (
        load(kept, then + 2 * lanes) * to_v + load(kept, then + 4 * lanes) * step * omega * to_u
    )
    next_u = (
        load(kept, then + 3 * lanes) * to_u
        + load(kept, then + 5 * lanes) * to_f1
        + load(kept, then + 6 * lanes) * to_f2
    )
    if n_hidden:
        model = _model(position, n_local)
        for side in range(min(2, n_local)):
            beyond = position - model
            phi = beyond if side == 1 else 1 - beyond
            for i in range(2):
                a = phi * (to_f1 if i == 0 else to_f2)
                for j in range(n_hidden):
                    at = neuron + ((2 * side + i) * n_hidden + j) * 3 * lanes
                    h = load(outputs, at + 2 * lanes)
                    inner = a * load(outputs, at + lanes) * (1 - h * h)
                    next_u = next_u + inner * load(outputs, at)
                    column = side * row + LINEAR + 3 * (i * n_hidden + j)
                    for p in range(max(n_local - 1, 1)):
                        here = model == p
                        slot = (column + p * row) * lanes
                        own = choose(here, inner, 0)
                        add(sums, slot, own * error)
                        add(sums, slot + lanes, own)
                        add(sums, slot + 2 * lanes, choose(here, a * h, 0))
    return next_v, next_u
