"""The GRU and LSTM recursions with their read-out, compiled; equations in `vehest.estimators.gru` and `vehest.estimators.lstm`.

Parameters of a member are those of `RecurrentNetwork` in their order: weights of inputs (G, H, C), of states (G, H, H), biases (G, H), and
weight (H,) and offset of the read-out. Windows lie side by side in lanes.
"""

from __future__ import annotations

import numpy as np

from vehest.estimators.kernels.activation import sigmoid, tanh
from vehest.estimators.kernels.compiling import entry, part
from vehest.estimators.kernels.recursion import add, gather, slopes_of, squared_error, step_of_adam
from vehest.lanes import load, store, total, width

GRU = 3
LSTM = 4  # gates
KEPT = 6  # rows of the hidden state's size that a step leaves: the gates and two more
BLOCK = 4  # inputs whose weights' gradients are summed together


@entry(nogil=True)
def loop(flat, given, series, starts, targets, batch, values, gradient, losses, adam):  # type: ignore[no-untyped-def]
    """See `vehest.estimators.kernels.recursion.Recursion`."""
    gates, states, n_window, mean, scale = given
    lanes = width(series)
    channels = series.shape[1]
    measured = series.ravel()
    rows = np.empty(lanes, np.int64)
    scratch = np.empty(lanes, flat.dtype)
    inputs = channels + states  # rows of ``seen`` a sample: measurements, and the state before
    seen = np.empty(n_window * inputs * lanes, flat.dtype)
    state = np.empty(2 * states * lanes, flat.dtype)
    kept = np.empty(n_window * KEPT * states * lanes, flat.dtype)
    sums = np.empty(flat.shape[1] * lanes, flat.dtype)
    size = (gates, states, channels)
    room = (seen, kept, state)
    read = gates * states * (inputs + 1)  # where the read-out's weights begin
    for m in range(flat.shape[0]):
        own = flat[m]
        for number, start in enumerate(range(0, starts.shape[1], batch)):
            end = min(start + batch, starts.shape[1])
            out = values[m, start:end]
            sums[:] = 0
            for first in range(0, out.size, lanes):
                gather(measured, channels, starts[m, start:end], first, rows, seen, inputs)
                state[:] = 0
                for k in range(n_window):
                    at = _arguments(own, size, room, k)
                    if gates == GRU:
                        _gru(states * lanes, kept, state, at)
                    else:
                        _lstm(states * lanes, kept, state, at)
                value = load(state, 0) * 0 + own[read + states]
                for i in range(states):
                    value = value + own[read + i] * load(state, i * lanes)
                store(scratch, 0, value * scale + mean)
                for lane in range(min(lanes, out.size - first)):
                    out[first + lane] = scratch[lane]
                if gradient.size:
                    slopes_of(out, targets[m, start:end], first, losses.size > 0, scratch)
                    slope = load(scratch, 0) * scale
                    add(sums, (read + states) * lanes, slope)
                    for i in range(states):
                        add(sums, (read + i) * lanes, slope * load(state, i * lanes))
                        store(
                            state, i * lanes, slope * own[read + i]
                        )  # from here on the adjoint of the state
                        store(state, (states + i) * lanes, slope * 0)
                    for k in range(n_window - 1, -1, -1):
                        if gates == GRU:
                            _gru_adjoint(size, room, k)
                        else:
                            _lstm_adjoint(size, room, k)
                        _to_state(own, size, kept, k * KEPT * states * lanes, state)
                    _sum(size, room, sums)
            if gradient.size:
                for j in range(own.size):
                    gradient[m, j] = total(load(sums, j * lanes))
            if losses.size:
                losses[m] += squared_error(out, targets[m, start:end])
                step_of_adam(own, gradient[m], adam, m, number + 1)


@part(_nrt=False)
def _arguments(flat, size, room, k):  # type: ignore[no-untyped-def]
    """Arguments of the gates at step k; a candidate's is without U_n h, which is one row later. Returns where they are kept."""
    gates, states, channels = size
    seen, kept, state = room
    lanes = width(flat)
    row = states * width(flat)
    now = k * (channels + states) * lanes
    at = k * KEPT * row
    for i in range(states):
        store(seen, now + (channels + i) * lanes, load(state, i * lanes))
    biases = gates * states * (channels + states)
    weights = gates * states * channels
    for unit in range(gates * states):
        recurrent = load(seen, now) * 0
        driven = recurrent + flat[biases + unit]
        for c in range(channels):
            driven = driven + flat[unit * channels + c] * load(seen, now + c * lanes)
        for j in range(states):
            recurrent = recurrent + flat[weights + unit * states + j] * load(state, j * lanes)
        if gates == GRU and unit >= 2 * states:
            store(kept, at + unit * lanes, driven)
            store(kept, at + unit * lanes + row, recurrent)
        else:
            store(kept, at + unit * lanes, driven + recurrent)
    return at


@part(_nrt=False)
def _gru(row, kept, state, first):  # type: ignore[no-untyped-def]
    """One step from its gates' arguments; leaves reset, update, candidate and U_n h."""
    lanes = width(state)
    for at in range(first, first + 2 * row, lanes):
        store(kept, at, sigmoid(load(kept, at)))
    for unit in range(0, row, lanes):
        at = first + unit
        candidate = tanh(load(kept, at + 2 * row) + load(kept, at) * load(kept, at + 3 * row))
        store(kept, at + 2 * row, candidate)
        store(state, unit, candidate + load(kept, at + row) * (load(state, unit) - candidate))


@part(_nrt=False)
def _lstm(row, kept, state, first):  # type: ignore[no-untyped-def]
    """The same; leaves the four gates, tanh of the new cell, and the cell before."""
    lanes = width(state)
    for at in range(first, first + 3 * row, lanes):
        store(kept, at, sigmoid(load(kept, at)))
    for unit in range(0, row, lanes):
        at = first + unit
        offer = tanh(load(kept, at + 3 * row))
        before = load(state, row + unit)
        cell = load(kept, at + row) * before + load(kept, at) * offer
        shown = tanh(cell)
        store(kept, at + 3 * row, offer)
        store(kept, at + 4 * row, shown)
        store(kept, at + 5 * row, before)
        store(state, row + unit, cell)
        store(state, unit, load(kept, at + 2 * row) * shown)


@part(_nrt=False)
def _gru_adjoint(size, room, k):  # type: ignore[no-untyped-def]
    """Adjoint of one step: ``state`` is that of the state after it, then before it; what is kept becomes the arguments' adjoints."""
    _, states, channels = size
    seen, kept, state = room
    lanes = width(state)
    row = states * width(state)
    now = k * (channels + states) * lanes
    first = k * KEPT * row
    for i in range(states):
        at = first + i * lanes
        unit = i * lanes
        reset = load(kept, at)
        update = load(kept, at + row)
        candidate = load(kept, at + 2 * row)
        recurrent = load(kept, at + 3 * row)
        bar = load(state, unit)
        inner = bar * (1 - update) * (1 - candidate * candidate)
        store(kept, at, inner * recurrent * reset * (1 - reset))
        store(
            kept,
            at + row,
            bar * (load(seen, now + (channels + i) * lanes) - candidate) * update * (1 - update),
        )
        store(kept, at + 2 * row, inner)
        store(kept, at + 3 * row, inner * reset)
        store(state, unit, bar * update)


@part(_nrt=False)
def _lstm_adjoint(size, room, k):  # type: ignore[no-untyped-def]
    """The same; the second half of ``state`` is that of the cell."""
    _, states, _ = size
    _, kept, state = room
    lanes = width(state)
    row = states * width(state)
    first = k * KEPT * row
    for i in range(states):
        at = first + i * lanes
        unit = i * lanes
        admit = load(kept, at)
        keep = load(kept, at + row)
        show = load(kept, at + 2 * row)
        offer = load(kept, at + 3 * row)
        shown = load(kept, at + 4 * row)
        bar = load(state, unit)
        cell = load(state, row + unit) + bar * show * (1 - shown * shown)
        store(kept, at, cell * offer * admit * (1 - admit))
        store(kept, at + row, cell * load(kept, at + 5 * row) * keep * (1 - keep))
        store(kept, at + 2 * row, bar * shown * show * (1 - show))
        store(kept, at + 3 * row, cell * admit * (1 - offer * offer))
        store(state, row + unit, cell * keep)
        store(state, unit, bar * 0)


@part(_nrt=False)
def _row_of_state(gates, g):  # type: ignore[no-untyped-def]
    """Which kept row is the adjoint of what the state adds to gate g's argument: a candidate's is its own times the reset."""
    return 3 if gates == GRU and g == 2 else g


@part(_nrt=False)
def _to_state(flat, size, kept, first, state):  # type: ignore[no-untyped-def]
    """Add what goes through the gates' arguments to the adjoint of the state before."""
    gates, states, channels = size
    lanes = width(flat)
    row = states * width(flat)
    for j in range(states):
        bar = load(state, j * lanes)
        for g in range(gates):
            weights = gates * states * channels + g * states * states + j
            at = first + _row_of_state(gates, g) * row
            for i in range(states):
                bar = bar + flat[weights + i * states] * load(kept, at + i * lanes)
        store(state, j * lanes, bar)


@part(_nrt=False)
def _sum(size, room, sums):  # type: ignore[no-untyped-def]
    """Gradients by the weights: products of the arguments' adjoints and the inputs, over all steps, a few inputs at a time in registers."""
    gates, states, channels = size
    seen, kept, _ = room
    lanes = width(sums)
    row = states * lanes
    inputs = (channels + states) * lanes
    steps = seen.size // inputs
    for g in range(gates):
        for i in range(states):
            unit = g * states + i
            at = g * row + i * lanes
            offset = load(sums, (gates * states * (channels + states) + unit) * lanes)
            for k in range(steps):
                offset = offset + load(kept, k * KEPT * row + at)
            store(sums, (gates * states * (channels + states) + unit) * lanes, offset)
            for first in range(
                0, channels + 1, channels
            ):  # measurements, then states; a zero by itself would be compiled for anew
                here = (g if first == 0 else _row_of_state(gates, g)) * row + i * lanes
                weights, count = (
                    (unit * channels, channels)
                    if first == 0
                    else (gates * states * channels + unit * states, states)
                )
                _sum_block(
                    seen, kept, sums, here, first, count, (steps, row, inputs), weights * lanes
                )


@part(_nrt=False)
def _sum_block(seen, kept, sums, at, first, count, strides, weights):  # type: ignore[no-untyped-def]
    """Of ``count`` inputs from ``first`` on, with one row of adjoints; the last block may overlap the one before."""
    steps, row, inputs = strides
    lanes = width(sums)
    for block in range(0, count, BLOCK):
        c = (first + block) * lanes
        one = load(sums, 0) * 0
        two = load(sums, 0) * 0
        three = load(sums, 0) * 0
        four = load(sums, 0) * 0
        left = count - block
        for k in range(steps):
            bar = load(kept, k * KEPT * row + at)
            x = k * inputs + c
            one = one + bar * load(seen, x)
            if left > 1:
                two = two + bar * load(seen, x + lanes)
            if left > 2:
                three = three + bar * load(seen, x + 2 * lanes)
            if left > 3:
                four = four + bar * load(seen, x + 3 * lanes)
        add(sums, weights + block * lanes, one)
        if left > 1:
            add(sums, weights + (block + 1) * lanes, two)
        if left > 2:
            add(sums, weights + (block + 2) * lanes, three)
        if left > 3:
            add(sums, weights + (block + 3) * lanes, four)
