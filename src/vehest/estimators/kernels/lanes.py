"""Recurrent cells over many windows at once: windows lie side by side in lanes, so that inner loops become vector instructions.

A cell's module supplies two compiled loops, forward and backward over members and blocks of lanes; this module wraps them for
autograd.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

LANES = 64
WITHOUT_TRACE = 64 * LANES  # windows at a time where no gradient is wanted, so that long recordings need little memory

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
        forward: compiled loop over members and blocks of lanes.
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
        weights = [weight.detach().contiguous().numpy() for weight in (input_weight, state_weight, bias)]
        series, first = prepared.contiguous().numpy(), starts.contiguous().numpy()
        rows = trace_rows * weights[0].shape[2]
        if any(ctx.needs_input_grad[:3]):
            inputs = _gathered(series, first, n_window)
            trace = np.empty((*inputs.shape[:3], rows, LANES), series.dtype)
            ctx.saved = (weights, inputs, trace, backward)
            return torch.from_numpy(_states(forward, weights, inputs, trace)[:, : first.shape[1]])
        scratch = np.empty((1, 1, n_window, rows, LANES), series.dtype)
        pieces = [
            _states(forward, weights, _gathered(series, first[:, at : at + WITHOUT_TRACE], n_window), scratch)
            for at in range(0, first.shape[1], WITHOUT_TRACE)
        ]
        return torch.from_numpy(np.concatenate(pieces, axis=1)[:, : first.shape[1]])

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        weights, inputs, trace, backward = ctx.saved
        members, blocks = inputs.shape[:2]
        batch, states = upstream[0].shape[1:]
        padded = np.zeros((members, blocks * LANES, states), inputs.dtype)
        padded[:, :batch] = upstream[0].numpy()
        adjoint = np.ascontiguousarray(padded.reshape(members, blocks, LANES, states).swapaxes(2, 3))
        gradients = [np.zeros_like(weight) for weight in weights]
        backward(weights[0], weights[1], inputs, trace, adjoint, *gradients)
        return (*(torch.from_numpy(gradient) for gradient in gradients), None, None, None, None, None, None)


def _states(forward: Loop, weights: list[Any], inputs: Any, trace: Any) -> Any:
    """Hidden states after all windows, (M, blocks · lanes, H)."""
    members, blocks = inputs.shape[:2]
    states = np.empty((members, blocks, weights[0].shape[2], LANES), inputs.dtype)
    forward(*weights, inputs, trace, states)
    return np.ascontiguousarray(states.swapaxes(2, 3)).reshape(members, blocks * LANES, -1)


def _gathered(series: Any, starts: Any, n_window: int) -> Any:
    """Windows side by side, (M, blocks, N, C, lanes); lanes without a window repeat the last one."""
    members, batch = starts.shape
    blocks = -(-batch // LANES)
    inputs = np.empty((members, blocks, n_window, series.shape[1], LANES), series.dtype)
    _gather(series, np.ascontiguousarray(starts), inputs)
    return inputs


@numba.njit(cache=True, error_model="numpy")
def _gather(series, starts, inputs):  # type: ignore[no-untyped-def]
    members, blocks, n_window, channels, lanes = inputs.shape
    for m in range(members):
        for block in range(blocks):
            for lane in range(lanes):
                first = starts[m, min(block * lanes + lane, starts.shape[1] - 1)]
                for k in range(n_window):
                    for c in range(channels):
                        inputs[m, block, k, c, lane] = series[first + k, c]


@numba.njit(inline="always")
def copy_rows(rows, out):  # type: ignore[no-untyped-def]
    """The first rows of ``out`` become ``rows``. An assignment would take longer to compile: it checks shapes and words a message."""
    for i in range(rows.shape[0]):
        for lane in range(rows.shape[1]):
            out[i, lane] = rows[i, lane]


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
