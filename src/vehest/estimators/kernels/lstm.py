"""The LSTM recursion, compiled; equations in `vehest.estimators.lstm`."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from vehest.estimators.kernels import lanes
from vehest.estimators.kernels.activation import sigmoid, tanh
from vehest.estimators.kernels.compiling import entry, part
from vehest.estimators.kernels.lanes import affine, copy_rows, outer

TRACE_ROWS = 7  # the four gates, tanh of the new cell, and cell and state before the step


def last_state(input_weight: Tensor, state_weight: Tensor, bias: Tensor, prepared: Tensor, starts: Tensor, n_window: int) -> Tensor:
    """Hidden state after each window, (M, B, H); see `lanes.last_state`."""
    return lanes.last_state(_forward, _backward, TRACE_ROWS, input_weight, state_weight, bias, prepared, starts, n_window)


@entry(fastmath=True)
def _forward(input_weight, state_weight, bias, inputs, trace, states):  # type: ignore[no-untyped-def]
    for m in range(inputs.shape[0]):
        for block in range(inputs.shape[1]):
            kept = trace[min(m, trace.shape[0] - 1), min(block, trace.shape[1] - 1)]
            _forward_block(input_weight[m], state_weight[m], bias[m], inputs[m, block], kept, states[m, block])


@entry(fastmath=True)
def _backward(input_weight, state_weight, inputs, trace, adjoint, to_input, to_state, to_bias):  # type: ignore[no-untyped-def]
    for m in range(inputs.shape[0]):
        for block in range(inputs.shape[1]):
            _backward_block(state_weight[m], inputs[m, block], trace[m, block], adjoint[m, block], to_input[m], to_state[m], to_bias[m])


@part(fastmath=True)
def _forward_block(input_weight, state_weight, bias, inputs, trace, state):  # type: ignore[no-untyped-def]
    n_states, n_lanes = bias.shape[1], inputs.shape[2]
    state[:] = 0
    cell = np.zeros((n_states, n_lanes), bias.dtype)
    for k in range(inputs.shape[0]):
        gate, before = trace[k], trace[k, 6 * n_states :]
        copy_rows(cell, trace[k, 5 * n_states :])
        copy_rows(state, before)
        for i in range(n_states):
            for g in range(4):
                row = gate[g * n_states + i]
                row[:] = bias[g, i]
                affine(row, input_weight[g, i], inputs[k])
                affine(row, state_weight[g, i], before)
            admit, keep, show, offer = gate[i], gate[n_states + i], gate[2 * n_states + i], gate[3 * n_states + i]
            shown = gate[4 * n_states + i]
            for lane in range(n_lanes):
                admit[lane], keep[lane], show[lane] = sigmoid(admit[lane]), sigmoid(keep[lane]), sigmoid(show[lane])
                offer[lane] = tanh(offer[lane])
                cell[i, lane] = keep[lane] * cell[i, lane] + admit[lane] * offer[lane]
                shown[lane] = tanh(cell[i, lane])
                state[i, lane] = show[lane] * shown[lane]


@part(fastmath=True)
def _backward_block(state_weight, inputs, trace, adjoint, to_input, to_state, to_bias):  # type: ignore[no-untyped-def]
    n_states, n_lanes = adjoint.shape
    one = adjoint.dtype.type(1)
    cell_adjoint = np.zeros((n_states, n_lanes), adjoint.dtype)
    inner = np.empty((4, n_states, n_lanes), adjoint.dtype)  # adjoints of the gates' arguments
    for k in range(inputs.shape[0] - 1, -1, -1):
        gate, before = trace[k], trace[k, 6 * n_states :]
        for i in range(n_states):
            admit, keep, show, offer = gate[i], gate[n_states + i], gate[2 * n_states + i], gate[3 * n_states + i]
            shown, cell_before = gate[4 * n_states + i], gate[5 * n_states + i]
            for lane in range(n_lanes):
                a, s, t = adjoint[i, lane], show[lane], shown[lane]
                c = cell_adjoint[i, lane] + a * s * (one - t * t)
                inner[0, i, lane] = c * offer[lane] * admit[lane] * (one - admit[lane])
                inner[1, i, lane] = c * cell_before[lane] * keep[lane] * (one - keep[lane])
                inner[2, i, lane] = a * t * s * (one - s)
                inner[3, i, lane] = c * admit[lane] * (one - offer[lane] * offer[lane])
                cell_adjoint[i, lane] = c * keep[lane]
                adjoint[i, lane] = one * 0
        for i in range(n_states):
            for g in range(4):
                outer(to_input[g, i], inner[g, i], inputs[k])
                outer(to_state[g, i], inner[g, i], before)
                total = one * 0
                for lane in range(n_lanes):
                    total += inner[g, i, lane]
                to_bias[g, i] += total
                for j in range(n_states):
                    w = state_weight[g, i, j]
                    for lane in range(n_lanes):
                        adjoint[j, lane] += w * inner[g, i, lane]
