"""Networks of two hidden layers over single samples, compiled, with seeded dropout.

    h₁ = d₁ relu(W₁ x + b₁),  h₂ = d₂ relu(W₂ h₁ + b₂),  o = W₃ h₂ + b₃
    d: 0 or 256/(256 - dropped) (dropout)

Adjoint: W̄₃ = h₂ᵀ ō, b̄₃ = Σ ō, h̄₂ = ō W₃ᵀ; through a layer ā = h̄ d where h > 0, else 0; W̄, b̄
and the layer below likewise. Order of sums: matrix products as BLAS has them; biases' gradients
over samples in order.

    inputs, parameters --outputs_of--> outputs
    table, rows, parameters --losses_of--> loss and gradient of each member

Members are computed one by one, since the layers of one member fit the processor's cache and those
of all members together do not. A mask is not stored: what it hides is zero in the hidden layer,
which is all that the adjoint asks for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vehest.estimators.kernels.threads import over_members

# decorator of compiled functions
compiled = numba.njit(cache=True, nogil=True, error_model="numpy", boundscheck=False)

LEVELS = 256  # the share of dropout is rounded to a multiple of 1/256
LAYERS = 3  # number of layers: two hidden ones and the output

Criterion = Callable[[NDArray[Any], NDArray[Any], NDArray[Any]], float]
"""Function that returns the mean loss of outputs (B, O) for targets (B,).

Its gradient by the outputs, (B, O), is written into the last argument.
"""


def outputs_of(
    inputs: Tensor, parameters: Sequence[Tensor], seeds: Tensor | None = None, dropout: float = 0.0
) -> Tensor:
    """Outputs of M members, (M, B, O), differentiable in the parameters.

    h = d(relu(W x + b)) twice, then W h + b.

    Parameters
    ----------
    inputs : Tensor
        (M, B, C), or (1, B, C) for all members.
    parameters : Sequence[Tensor]
        Weights and biases by turns from the inputs on, (M, C, H), (M, H), and so on.
    seeds : Tensor | None, default None
        Seed of each member's dropout mask, int64 (M,); None: no dropout.
    dropout : float, default 0.0
        Share of hidden values that are dropped, rounded to a 256th; the others are scaled so that
        their mean stays.

    Source: Srivastava et al., Dropout, Journal of Machine Learning Research 15, 2014.
    """
    dropped_parts = round(LEVELS * dropout) if seeds is not None else 0
    drawn = np.zeros(len(parameters[0]), np.int64) if seeds is None else seeds.numpy()
    return _Outputs.apply(inputs, drawn, dropped_parts, *parameters)  # type: ignore


def losses_of(
    table: Tensor,
    targets: Tensor,
    rows: Tensor,
    parameters: Sequence[Tensor],
    seeds: Tensor,
    dropout: float,
    criterion: Criterion,
) -> Tensor:
    """Losses of M members, each on rows of its own, (M,), differentiable in the parameters.

    A member's outputs, loss and gradient are computed in one go, so that nothing of one member is
    in the next one's way.

    Parameters
    ----------
    table : Tensor
        Inputs, (N, C).
    targets : Tensor
        Targets of the inputs, (N,).
    rows : Tensor
        Indices of the inputs that each member is trained on, int64 (M, B).
    parameters : Sequence[Tensor]
        See `outputs_of`; likewise ``seeds`` and ``dropout``.
    criterion : Criterion
        See `Criterion`; compiled, or it keeps members from running side by side.
    """
    losses: Tensor = _Losses.apply(
        table, targets, rows, seeds, round(LEVELS * dropout), criterion, *parameters
    )  # type: ignore[no-untyped-call]
    return losses


class _Outputs(torch.autograd.Function):
    """Autograd function of `outputs_of`: hidden layers of all members are stored for the
    adjoint.
    """

    @staticmethod
    def forward(
        ctx: Any, inputs: Tensor, seeds: NDArray[np.int64], dropped_parts: int, *parameters: Tensor
    ) -> Tensor:
        """Outputs of all members, each from its own inputs or the common ones."""
        x = inputs.contiguous().numpy()
        weights = [parameter.detach().contiguous().numpy() for parameter in parameters]
        members = len(weights[0])
        samples = x.shape[1]
        layers = [
            np.empty((members, samples, weights[2 * layer].shape[2]), x.dtype)
            for layer in range(LAYERS)
        ]

        def work(first: int, end: int) -> None:
            for m in range(first, end):
                member_weights = [weight[m] for weight in weights]
                _forward(
                    x[m if len(x) > 1 else 0],
                    *member_weights,
                    seeds[m],
                    dropped_parts,
                    *[layer[m] for layer in layers],
                )

        over_members(work, members)
        ctx.forward_values = (x, weights, layers[:-1], dropped_parts)
        return torch.from_numpy(layers[-1])

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of weights and biases; inputs and seeds have none."""
        x, weights, layers, dropped_parts = ctx.forward_values
        up = upstream[0].contiguous().numpy()
        gradients = [np.empty_like(weight) for weight in weights]

        def work(first: int, end: int) -> None:
            for m in range(first, end):
                member_gradients = [gradient[m] for gradient in gradients]
                _backward(
                    x[m if len(x) > 1 else 0],
                    weights[2][m],
                    weights[4][m],
                    dropped_parts,
                    layers[0][m],
                    layers[1][m],
                    up[m],
                    *member_gradients,
                )

        over_members(work, len(gradients[0]))
        return (None, None, None, *(torch.from_numpy(gradient) for gradient in gradients))


class _Losses(torch.autograd.Function):
    """Autograd function of `losses_of`: gradients are computed in the forward pass, since each
    member's loss has one number, and scaled in the backward pass.
    """

    @staticmethod
    def forward(
        ctx: Any,
        table: Tensor,
        targets: Tensor,
        rows: Tensor,
        seeds: Tensor,
        dropped_parts: int,
        criterion: Criterion,
        *parameters: Tensor,
    ) -> Tensor:
        """Losses (M,), and gradients of all parameters for an upstream gradient of 1.

        Hidden layers are allocated once for each thread and reused by its members.
        """
        x, y, chosen, drawn = (tensor.numpy() for tensor in (table, targets, rows, seeds))
        weights = [parameter.detach().contiguous().numpy() for parameter in parameters]
        gradients = [np.empty_like(weight) for weight in weights]
        losses = np.empty(len(chosen), x.dtype)

        def work(first: int, end: int) -> None:
            layers = [
                np.empty((chosen.shape[1], weights[2 * layer].shape[2]), x.dtype)
                for layer in range(LAYERS)
            ]
            up = np.empty_like(layers[-1])
            for m in range(first, end):
                member_inputs = x[chosen[m]]
                member_weights = [weight[m] for weight in weights]
                bars = [gradient[m] for gradient in gradients]
                _forward(member_inputs, *member_weights, drawn[m], dropped_parts, *layers)
                losses[m] = criterion(layers[-1], y[chosen[m]], up)
                _backward(
                    member_inputs,
                    member_weights[2],
                    member_weights[4],
                    dropped_parts,
                    layers[0],
                    layers[1],
                    up,
                    *bars,
                )

        over_members(work, len(chosen))
        ctx.forward_values = gradients
        return torch.from_numpy(losses)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        """Multiply each member's gradients by the upstream gradient of its loss."""
        scaled = (
            torch.from_numpy(gradient).mul_(upstream[0].reshape(-1, *[1] * (gradient.ndim - 1)))
            for gradient in ctx.forward_values
        )
        return (None, None, None, None, None, None, *scaled)


@compiled
def squared_error(outputs, targets, gradient):
    """Mean of (o - t)²; a `Criterion` of one output."""
    total = 0.0
    count = len(targets)
    for row in range(count):
        error = outputs[row, 0] - targets[row]
        total += error * error
        gradient[row, 0] = outputs.dtype.type(2.0 / count) * error
    return total / count


@compiled
def gaussian_likelihood(outputs, targets, gradient):
    """Mean of (log v + (o - t)²/v)/2 with v = softplus(o₂) + 1e-6; a `Criterion` of two outputs.

    Source: Lakshminarayanan, Pritzel & Blundell, Simple and scalable predictive uncertainty
    estimation using deep ensembles, 2017, Eq. 1.
    """
    total = 0.0
    count = len(targets)
    for row in range(count):
        raw = outputs[row, 1]
        error = outputs[row, 0] - targets[row]
        variance = max(raw, 0.0) + np.log1p(np.exp(-abs(raw))) + 1e-6
        total += 0.5 * (np.log(variance) + error * error / variance)
        by_variance = 0.5 * (1.0 - error * error / variance) / variance
        gradient[row, 0] = error / variance / count
        gradient[row, 1] = by_variance / (1.0 + np.exp(-raw)) / count
    return total / count


@compiled
def _forward(x, w1, b1, w2, b2, w3, b3, seed, dropped_parts, first, second, out):
    """Write both hidden layers (B, H₁), (B, H₂) and the outputs (B, O) of one member; see the
    module.

    Masks follow from ``seed`` and the number of the layer; ``dropped_parts`` 0: none.
    """
    np.dot(x, w1, first)
    _activate(first, b1, seed, 0, dropped_parts)
    np.dot(first, w2, second)
    _activate(second, b2, seed, 1, dropped_parts)
    np.dot(second, w3, out)
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            out[row, column] += b3[column]


@compiled
def _backward(
    x, w2, w3, dropped_parts, first, second, up, w1_bar, b1_bar, w2_bar, b2_bar, w3_bar, b3_bar
):
    """Write gradients of weights and biases of one member, given those of the outputs, ``up`` (B,
    O).

    W̄₃ = h₂ᵀ ō,  ā₂ = gate(ō W₃ᵀ),  W̄₂ = h₁ᵀ ā₂,  ā₁ = gate(ā₂ W₂ᵀ),  W̄₁ = xᵀ ā₁; biases are sums
    of these over samples. Hidden layers are those that `_forward` wrote.
    """
    np.dot(second.T, up, w3_bar)
    _summed(up, b3_bar)
    second_bar = np.empty_like(second)
    first_bar = np.empty_like(first)
    np.dot(up, w3.T, second_bar)
    _gate(second, second_bar, dropped_parts, b2_bar)
    np.dot(first.T, second_bar, w2_bar)
    np.dot(second_bar, w2.T, first_bar)
    _gate(first, first_bar, dropped_parts, b1_bar)
    np.dot(x.T, first_bar, w1_bar)


@compiled
def _activate(values, bias, seed, layer, dropped_parts):
    """Write relu(values + bias) with dropout into ``values``, (B, O): each value is dropped with
    a probability of ``dropped_parts``/256, and the others are scaled by the inverse of the rest.

    Eight bytes of every random word decide of eight values (SplitMix64).
    """
    rows, columns = values.shape
    scale = values.dtype.type(256.0 / (256 - dropped_parts))
    zero = values.dtype.type(0.0)
    if dropped_parts == 0:
        for row in range(rows):
            for column in range(columns):
                values[row, column] = max(values[row, column] + bias[column], zero)
        return
    words = (columns + 7) // 8
    mask = np.empty(8 * words, np.uint8)
    start = np.uint64(seed) * np.uint64(0xD1342543DE82EF95) + np.uint64(layer + 1) * np.uint64(
        0xA0761D6478BD642F
    )
    for row in range(rows):
        for word in range(words):
            z = start + np.uint64(row * words + word + 1) * np.uint64(0x9E3779B97F4A7C15)
            z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            z = z ^ (z >> np.uint64(31))
            for byte in range(8):
                mask[8 * word + byte] = np.uint8(z >> np.uint64(8 * byte))
        for column in range(columns):
            value = max(values[row, column] + bias[column], zero) * scale
            values[row, column] = value if mask[column] >= dropped_parts else zero


@compiled
def _gate(values, bars, dropped_parts, bias_bar):
    """Adjoint of `_activate`, in place; that of the bias is written."""
    scale = values.dtype.type(256.0 / (256 - dropped_parts))
    zero = values.dtype.type(0.0)
    bias_bar[:] = zero
    for row in range(values.shape[0]):
        for column in range(values.shape[1]):
            bar = bars[row, column] * scale if values[row, column] > zero else zero
            bars[row, column] = bar
            bias_bar[column] += bar


@compiled
def _summed(bars, total):
    """Write the sum over samples of the gradients ``bars``, (B, O) -> (O,)."""
    total[:] = total.dtype.type(0.0)
    for row in range(bars.shape[0]):
        for column in range(bars.shape[1]):
            total[column] += bars[row, column]
