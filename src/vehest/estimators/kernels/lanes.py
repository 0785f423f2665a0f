"""Recurrent cells over many windows at once: windows lie side by side in lanes, so that inner loops become vector instructions.

A cell's module supplies two compiled loops, forward and backward over one block of lanes; this module wraps them for autograd.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

LANES = 64

Loop = Callable[..., None]


def last_state(
    forward: Loop,
    backward: Loop,
    trace_rows: int,
    input_weight: Tensor,
    state_weight: Tensor,
    bias: Tensor,
    prepared: Tensor,
    starts: Tensor,
    n_window: int,
) -> Tensor:
    """Hidden state after each window, differentiable in the weights.

    Args:
        forward: compiled loop over one block of lanes.
        backward: its adjoint.
        trace_rows: values a lane keeps for the adjoint at every step, in hidden-state sizes.
        input_weight: (M, G, H, C).
        state_weight: (M, G, H, H).
        bias: (M, G, H).
        prepared: measurements, (T, C).
        starts: first row of each window, (M, B).
        n_window: samples N in a window.

    Returns:
        (M, B, H).
    """
    result: Tensor = _LastState.apply(  # type: ignore[no-untyped-call]
        input_weight, state_weight, bias, prepared, starts, n_window, forward, backward, trace_rows
    )
    return result


class _LastState(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        input_weight: Tensor,
        state_weight: Tensor,
        bias: Tensor,
        prepared: Tensor,
        starts: Tensor,
        n_window: int,
        forward: Loop,
        backward: Loop,
        trace_rows: int,
    ) -> Tensor:
        wanted = any(ctx.needs_input_grad[:3])
        weights = [weight.detach().contiguous().numpy() for weight in (input_weight, state_weight, bias)]
        series, first = prepared.contiguous().numpy(), starts.contiguous().numpy()
        members, batch = first.shape
        states, channels = weights[0].shape[2:]
        blocks = -(-batch // LANES)
        kept = (members, blocks) if wanted else (1, 1)
        inputs = np.empty((*kept, n_window, channels, LANES), series.dtype)
        trace = np.empty((*kept, n_window, trace_rows * states, LANES), series.dtype)
        result = np.empty((members, batch, states), series.dtype)
        _all_blocks_forward(forward, *weights, series, first, inputs, trace, result)
        ctx.saved = (weights, inputs, trace, backward, batch)
        return torch.from_numpy(result)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        weights, inputs, trace, backward, batch = ctx.saved
        gradients = [np.zeros_like(weight) for weight in weights]
        _all_blocks_backward(backward, *weights, inputs, trace, upstream[0].contiguous().numpy(), batch, *gradients)
        return (*(torch.from_numpy(gradient) for gradient in gradients), None, None, None, None, None, None)


@numba.njit(cache=True, error_model="numpy")
def _all_blocks_forward(forward, input_weight, state_weight, bias, series, starts, inputs, trace, result):  # type: ignore[no-untyped-def]
    members, batch = starts.shape
    n_window, channels, lanes = inputs.shape[2:]
    for m in range(members):
        for block in range((batch + lanes - 1) // lanes):
            used = min(lanes, batch - block * lanes)
            window = inputs[min(m, inputs.shape[0] - 1), min(block, inputs.shape[1] - 1)]
            for lane in range(lanes):  # lanes without a window repeat the last one
                first = starts[m, block * lanes + min(lane, used - 1)]
                for k in range(n_window):
                    for c in range(channels):
                        window[k, c, lane] = series[first + k, c]
            state = forward(
                input_weight[m], state_weight[m], bias[m], window, trace[min(m, trace.shape[0] - 1), min(block, trace.shape[1] - 1)]
            )
            for lane in range(used):
                for i in range(state.shape[0]):
                    result[m, block * lanes + lane, i] = state[i, lane]


@numba.njit(cache=True, error_model="numpy")
def _all_blocks_backward(backward, input_weight, state_weight, bias, inputs, trace, upstream, batch, to_input, to_state, to_bias):  # type: ignore[no-untyped-def]
    members, blocks = inputs.shape[:2]
    lanes, states = inputs.shape[4], upstream.shape[2]
    for m in range(members):
        for block in range(blocks):
            used = min(lanes, batch - block * lanes)
            adjoint = np.zeros((states, lanes), upstream.dtype)
            for lane in range(used):
                for i in range(states):
                    adjoint[i, lane] = upstream[m, block * lanes + lane, i]
            backward(input_weight[m], state_weight[m], inputs[m, block], trace[m, block], adjoint, to_input[m], to_state[m], to_bias[m])


@numba.njit(inline="always")
def affine(out, weight, rows):  # type: ignore[no-untyped-def]
    """out[lane] += Σ_c weight[c] rows[c, lane]."""
    for c in range(weight.shape[0]):
        w = weight[c]
        for lane in range(out.shape[0]):
            out[lane] += w * rows[c, lane]


@numba.njit(inline="always")
def outer(out, adjoint, rows):  # type: ignore[no-untyped-def]
    """out[c] += Σ_lane adjoint[lane] rows[c, lane]."""
    for c in range(out.shape[0]):
        total = out[c] * 0
        for lane in range(adjoint.shape[0]):
            total += adjoint[lane] * rows[c, lane]
        out[c] += total
