"""The GRU recursion, compiled; equations in `vehest.estimators.gru`."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from vehest.estimators.kernels import lanes
from vehest.estimators.kernels.activation import sigmoid, tanh
from vehest.estimators.kernels.compiling import entry, part
from vehest.estimators.kernels.lanes import affine, copy_rows, outer

TRACE_ROWS = 5  # reset, update, candidate, U_n h, and the state before the step


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
    for k in range(inputs.shape[0]):
        gate, before = trace[k], trace[k, 4 * n_states :]
        copy_rows(state, before)
        for i in range(n_states):
            reset, update, candidate, recurrent = gate[i], gate[n_states + i], gate[2 * n_states + i], gate[3 * n_states + i]
            reset[:], update[:], candidate[:], recurrent[:] = bias[0, i], bias[1, i], bias[2, i], bias[0, i] * 0
            affine(reset, input_weight[0, i], inputs[k])
            affine(reset, state_weight[0, i], before)
            affine(update, input_weight[1, i], inputs[k])
            affine(update, state_weight[1, i], before)
            affine(candidate, input_weight[2, i], inputs[k])
            affine(recurrent, state_weight[2, i], before)
            for lane in range(n_lanes):
                reset[lane] = sigmoid(reset[lane])
                update[lane] = sigmoid(update[lane])
                candidate[lane] = tanh(candidate[lane] + reset[lane] * recurrent[lane])
                state[i, lane] = candidate[lane] + update[lane] * (before[i, lane] - candidate[lane])


@part(fastmath=True)
def _backward_block(state_weight, inputs, trace, adjoint, to_input, to_state, to_bias):  # type: ignore[no-untyped-def]
    n_states, n_lanes = adjoint.shape
    one = adjoint.dtype.type(1)
    inner = np.empty((3, n_states, n_lanes), adjoint.dtype)  # adjoints of the gates' arguments
    recurrent_inner = np.empty((n_states, n_lanes), adjoint.dtype)  # adjoint of U_n h
    for k in range(inputs.shape[0] - 1, -1, -1):
        gate, before = trace[k], trace[k, 4 * n_states :]
        for i in range(n_states):
            reset, update, candidate, recurrent = gate[i], gate[n_states + i], gate[2 * n_states + i], gate[3 * n_states + i]
            for lane in range(n_lanes):
                a, r, z, n = adjoint[i, lane], reset[lane], update[lane], candidate[lane]
                to_candidate = a * (one - z) * (one - n * n)
                inner[0, i, lane] = to_candidate * recurrent[lane] * r * (one - r)
                inner[1, i, lane] = a * (before[i, lane] - n) * z * (one - z)
                inner[2, i, lane] = to_candidate
                recurrent_inner[i, lane] = to_candidate * r
                adjoint[i, lane] = a * z
        for i in range(n_states):
            for g in range(3):
                through = recurrent_inner[i] if g == 2 else inner[g, i]
                outer(to_input[g, i], inner[g, i], inputs[k])
                outer(to_state[g, i], through, before)
                total = one * 0
                for lane in range(n_lanes):
                    total += inner[g, i, lane]
                to_bias[g, i] += total
                for j in range(n_states):
                    w = state_weight[g, i, j]
                    for lane in range(n_lanes):
                        adjoint[j, lane] += w * through[lane]
