"""The GRU and LSTM recursions with their read-out, compiled, and their adjoints.

GRU (Cho et al. 2014), with reset r, update z and candidate n; LSTM (Hochreiter & Schmidhuber 1997),
with input, forget and output gates i, f, o, candidate g and cell c:

    r, z = σ(W x + U h + b),  n = tanh(W_n x + b_n + r (U_n h)),  h⁺ = n + z (h - n)
    i, f, o = σ(W x + U h + b),  g = tanh(W_g x + U_g h + b_g),  c⁺ = f c + i g,  h⁺ = o tanh c⁺

Read-out: v = (wᵀ h + b) scale + mean after the last sample. Adjoint of a step, with ā the gradient
of a gate's argument, σ' = σ (1 - σ) and tanh' = 1 - tanh², and sums of W̄, Ū, b̄ over all steps:

    h̄ = Σ_gates Uᵀ ā + z h̄⁺ (GRU),  c̄ = f c̄⁺ (LSTM),  W̄ = Σ ā xᵀ,  Ū = Σ ā hᵀ,  b̄ = Σ ā

Order of sums: bias, measurements, then states in order of their index; gradients over samples in
order of time (`_sum`), and over lanes at the end of a batch. The readable definitions in torch are
`torch.nn.GRU` and `torch.nn.LSTM` (`vehest.estimators.networks.recurrent`).

Parameters of a member are those of `RecurrentNetwork` in their order: weights of inputs (G, H, C),
of states (G, H, H), biases (G, H), and weight (H,) and offset of the read-out. Windows lie side by
side in lanes.
"""

from __future__ import annotations

import numpy as np

from vehest.estimators.kernels.activation import sigmoid, tanh
from vehest.estimators.kernels.compiling import entry, part
from vehest.estimators.kernels.recursion import add, gather, slopes_of, squared_error, step_of_adam
from vehest.lanes import load, store, total, width

GRU = 3  # number of gates of a GRU, which also identifies this kind of cell
LSTM = 4  # number of gates of an LSTM, which also identifies this kind of cell
SAVED_ROWS = 6  # rows of the hidden state's size that a step saves: the gates and two more
BLOCK = 4  # inputs whose weights' gradients are summed together


@entry(nogil=True)
def loop(flat, constants, series, starts, targets, batch, values, gradient, losses, adam):
    """Predictions of GRU or LSTM members, and perhaps gradients and steps of Adam; for the
    arguments see `vehest.estimators.kernels.recursion.Recursion`.


    ``constants`` are the number of gates (`GRU` or `LSTM`), H, N, and mean and scale of the output.
    The state, (2 H, lanes), is hidden state and cell in the forward pass and their gradients in the
    backward pass; gradients by the weights are summed once all arguments' adjoints are saved.
    """
    gates, states, n_window, mean, scale = constants
    lanes = width(series)
    channels = series.shape[1]
    measured = series.ravel()
    rows = np.empty(lanes, np.int64)
    scratch = np.empty(lanes, flat.dtype)
    inputs = channels + states  # rows of ``seen`` a sample: measurements, and the state before
    windows = np.empty(n_window * inputs * lanes, flat.dtype)
    state = np.empty(2 * states * lanes, flat.dtype)
    saved = np.empty(n_window * SAVED_ROWS * states * lanes, flat.dtype)
    sums = np.empty(flat.shape[1] * lanes, flat.dtype)
    size = (gates, states, channels)
    room = (windows, saved, state)
    readout = gates * states * (inputs + 1)  # where the read-out's weights begin
    for m in range(flat.shape[0]):
        parameters = flat[m]
        for number, start in enumerate(range(0, starts.shape[1], batch)):
            end = min(start + batch, starts.shape[1])
            out = values[m, start:end]
            sums[:] = 0
            for first in range(0, out.size, lanes):
                gather(measured, channels, starts[m, start:end], first, rows, windows, inputs)
                state[:] = 0
                for k in range(n_window):
                    at = _arguments(parameters, size, room, k)
                    if gates == GRU:
                        _gru(states * lanes, saved, state, at)
                    else:
                        _lstm(states * lanes, saved, state, at)
                value = load(state, 0) * 0 + parameters[readout + states]
                for i in range(states):
                    value = value + parameters[readout + i] * load(state, i * lanes)
                store(scratch, 0, value * scale + mean)
                for lane in range(min(lanes, out.size - first)):
                    out[first + lane] = scratch[lane]
                if gradient.size:
                    slopes_of(out, targets[m, start:end], first, losses.size > 0, scratch)
                    slope = load(scratch, 0) * scale
                    add(sums, (readout + states) * lanes, slope)
                    for i in range(states):
                        add(sums, (readout + i) * lanes, slope * load(state, i * lanes))
                        # from here on the adjoint of the state
                        store(state, i * lanes, slope * parameters[readout + i])
                        store(state, (states + i) * lanes, slope * 0)
                    for k in range(n_window - 1, -1, -1):
                        if gates == GRU:
                            _gru_adjoint(size, room, k)
                        else:
                            _lstm_adjoint(size, room, k)
                        _to_state(parameters, size, saved, k * SAVED_ROWS * states * lanes, state)
                    _sum(size, room, sums)
            if gradient.size:
                for j in range(parameters.size):
                    gradient[m, j] = total(load(sums, j * lanes))
            if losses.size:
                losses[m] += squared_error(out, targets[m, start:end])
                step_of_adam(parameters, gradient[m], adam, m, number + 1)


@part(_nrt=False)
def _arguments(flat, size, room, k):
    """Save the arguments of the gates at step k, and return the place of the first.

    A GRU candidate's is without U_n h, which is one row later.
    """
    gates, states, channels = size
    windows, saved, state = room
    lanes = width(flat)
    row = states * width(flat)
    window_at = k * (channels + states) * lanes
    at = k * SAVED_ROWS * row
    for i in range(states):
        store(windows, window_at + (channels + i) * lanes, load(state, i * lanes))
    biases = gates * states * (channels + states)
    weights = gates * states * channels
    for unit in range(gates * states):
        recurrent = load(windows, window_at) * 0
        driven = recurrent + flat[biases + unit]
        for c in range(channels):
            driven = driven + flat[unit * channels + c] * load(windows, window_at + c * lanes)
        for j in range(states):
            recurrent = recurrent + flat[weights + unit * states + j] * load(state, j * lanes)
        if gates == GRU and unit >= 2 * states:
            store(saved, at + unit * lanes, driven)
            store(saved, at + unit * lanes + row, recurrent)
        else:
            store(saved, at + unit * lanes, driven + recurrent)
    return at


@part(_nrt=False)
def _gru(row, saved, state, first):
    """One step of a GRU from its gates' arguments; saves reset, update, candidate and U_n h."""
    lanes = width(state)
    for at in range(first, first + 2 * row, lanes):
        store(saved, at, sigmoid(load(saved, at)))
    for unit in range(0, row, lanes):
        at = first + unit
        candidate = tanh(load(saved, at + 2 * row) + load(saved, at) * load(saved, at + 3 * row))
        store(saved, at + 2 * row, candidate)
        store(state, unit, candidate + load(saved, at + row) * (load(state, unit) - candidate))


@part(_nrt=False)
def _lstm(row, saved, state, first):
    """One step of an LSTM; saves the four gates, tanh of the new cell, and the cell before."""
    lanes = width(state)
    for at in range(first, first + 3 * row, lanes):
        store(saved, at, sigmoid(load(saved, at)))
    for unit in range(0, row, lanes):
        at = first + unit
        candidate = tanh(load(saved, at + 3 * row))
        before = load(state, row + unit)
        cell = load(saved, at + row) * before + load(saved, at) * candidate
        cell_output = tanh(cell)
        store(saved, at + 3 * row, candidate)
        store(saved, at + 4 * row, cell_output)
        store(saved, at + 5 * row, before)
        store(state, row + unit, cell)
        store(state, unit, load(saved, at + 2 * row) * cell_output)


@part(_nrt=False)
def _gru_adjoint(size, room, k):
    """Adjoint of `_gru`: ``state`` is the gradient of the state after the step, then before it.

    ``saved`` becomes that of the arguments.
    """
    _, states, channels = size
    windows, saved, state = room
    lanes = width(state)
    row = states * width(state)
    window_at = k * (channels + states) * lanes
    first = k * SAVED_ROWS * row
    for i in range(states):
        at = first + i * lanes
        unit = i * lanes
        reset = load(saved, at)
        update = load(saved, at + row)
        candidate = load(saved, at + 2 * row)
        recurrent = load(saved, at + 3 * row)
        bar = load(state, unit)
        inner = bar * (1 - update) * (1 - candidate * candidate)
        store(saved, at, inner * recurrent * reset * (1 - reset))
        store(
            saved,
            at + row,
            bar
            * (load(windows, window_at + (channels + i) * lanes) - candidate)
            * update
            * (1 - update),
        )
        store(saved, at + 2 * row, inner)
        store(saved, at + 3 * row, inner * reset)
        store(state, unit, bar * update)


@part(_nrt=False)
def _lstm_adjoint(size, room, k):
    """Adjoint of `_lstm`, as `_gru_adjoint`.

    The second half of ``state`` is the gradient of the cell.
    """
    _, states, _ = size
    _, saved, state = room
    lanes = width(state)
    row = states * width(state)
    first = k * SAVED_ROWS * row
    for i in range(states):
        at = first + i * lanes
        unit = i * lanes
        input_gate = load(saved, at)
        forget_gate = load(saved, at + row)
        output_gate = load(saved, at + 2 * row)
        candidate = load(saved, at + 3 * row)
        cell_output = load(saved, at + 4 * row)
        bar = load(state, unit)
        cell = load(state, row + unit) + bar * output_gate * (1 - cell_output * cell_output)
        store(saved, at, cell * candidate * input_gate * (1 - input_gate))
        store(saved, at + row, cell * load(saved, at + 5 * row) * forget_gate * (1 - forget_gate))
        store(saved, at + 2 * row, bar * cell_output * output_gate * (1 - output_gate))
        store(saved, at + 3 * row, cell * input_gate * (1 - candidate * candidate))
        store(state, row + unit, cell * forget_gate)
        store(state, unit, bar * 0)


@part(_nrt=False)
def _row_of_state(gates, g):
    """Saved row of the adjoint of U_g h, the state's part of gate g's argument.

    That of a candidate is multiplied by the reset.
    """
    return 3 if gates == GRU and g == 2 else g


@part(_nrt=False)
def _to_state(flat, size, saved, first, state):
    """Add what passes through the gates' arguments to the adjoint of the state before the step."""
    gates, states, channels = size
    lanes = width(flat)
    row = states * width(flat)
    for j in range(states):
        bar = load(state, j * lanes)
        for g in range(gates):
            weights = gates * states * channels + g * states * states + j
            at = first + _row_of_state(gates, g) * row
            for i in range(states):
                bar = bar + flat[weights + i * states] * load(saved, at + i * lanes)
        store(state, j * lanes, bar)


@part(_nrt=False)
def _sum(size, room, sums):
    """Add the gradients by the weights to ``sums``.

    They are products of the arguments' adjoints and the inputs, over all steps, a few inputs at a
    time in registers.
    """
    gates, states, channels = size
    windows, saved, _ = room
    lanes = width(sums)
    row = states * lanes
    inputs = (channels + states) * lanes
    steps = windows.size // inputs
    for g in range(gates):
        for i in range(states):
            unit = g * states + i
            at = g * row + i * lanes
            offset = load(sums, (gates * states * (channels + states) + unit) * lanes)
            for k in range(steps):
                offset = offset + load(saved, k * SAVED_ROWS * row + at)
            store(sums, (gates * states * (channels + states) + unit) * lanes, offset)
            # measurements, then states; a zero by itself would be compiled for anew
            for first in range(0, channels + 1, channels):
                adjoint_at = (g if first == 0 else _row_of_state(gates, g)) * row + i * lanes
                weights, count = (
                    (unit * channels, channels)
                    if first == 0
                    else (gates * states * channels + unit * states, states)
                )
                _sum_block(
                    windows,
                    saved,
                    sums,
                    adjoint_at,
                    first,
                    count,
                    (steps, row, inputs),
                    weights * lanes,
                )


@part(_nrt=False)
def _sum_block(windows, saved, sums, at, first, count, strides, weights):
    """Sum products of ``count`` inputs from ``first`` on with one row of adjoints.

    The last block may overlap the one before.
    """
    steps, row, inputs = strides
    lanes = width(sums)
    for block in range(0, count, BLOCK):
        c = (first + block) * lanes
        sum_0 = load(sums, 0) * 0
        sum_1 = load(sums, 0) * 0
        sum_2 = load(sums, 0) * 0
        sum_3 = load(sums, 0) * 0
        remaining = count - block
        for k in range(steps):
            bar = load(saved, k * SAVED_ROWS * row + at)
            x = k * inputs + c
            sum_0 = sum_0 + bar * load(windows, x)
            if remaining > 1:
                sum_1 = sum_1 + bar * load(windows, x + lanes)
            if remaining > 2:
                sum_2 = sum_2 + bar * load(windows, x + 2 * lanes)
            if remaining > 3:
                sum_3 = sum_3 + bar * load(windows, x + 3 * lanes)
        add(sums, weights + block * lanes, sum_0)
        if remaining > 1:
            add(sums, weights + (block + 1) * lanes, sum_1)
        if remaining > 2:
            add(sums, weights + (block + 2) * lanes, sum_2)
        if remaining > 3:
            add(sums, weights + (block + 3) * lanes, sum_3)
