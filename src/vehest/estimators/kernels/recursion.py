"""Compiled recursions over windows, for members together: predictions, gradients, and epochs of training without a barrier between steps.

A network's module supplies one compiled loop over members and batches (`Recursion.loop`); windows lie side by side in `vehest.lanes`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from vehest.estimators.kernels.compiling import part
from vehest.estimators.kernels.threads import over_members

DECAYS, EPSILON = (0.9, 0.999), 1e-8  # of Adam


class Recursion(NamedTuple):
    """A network's compiled recursion.

    Attributes:
        loop: ``loop(flat, given, series, starts, targets, batch, values, gradient, losses, adam)``: for each member, a row of every
            array but ``series``, predictions of its windows in batches. Where ``gradient`` (M, K) has rows, it becomes that of
            Σ targets · values; if ``losses`` (M,) has, the squared error to the targets is added to it, and the parameters ``flat`` (M, K)
            take a step of Adam after every batch.
        given: what else it is called with, for arrays of a precision.
    """

    loop: Callable[..., None]
    given: Callable[[Any], tuple[Any, ...]]

    def predict(self, flat: Tensor, prepared: Tensor, starts: Tensor) -> Tensor:
        """Predictions after windows that begin at rows ``starts`` (M, B) of a series (T, C), differentiable in ``flat`` (M, K)."""
        result: Tensor = _Predict.apply(flat, prepared, starts, self)  # type: ignore[no-untyped-call]
        return result

    def descend(
        self,
        flat: Tensor,
        moments: Mapping[str, Tensor],
        prepared: Tensor,
        starts: Tensor,
        targets: Tensor,
        batch: int,
        rate: float,
        bounds: Tensor,
        averaging: float,
    ) -> Tensor:
        """Steps of Adam on mean squared errors, in place.

        Args:
            flat: parameters, (M, K).
            moments: Adam's ``step``, ``exp_avg`` and ``exp_avg_sq`` as torch names them; with averaging also ``average`` of the parameters.
            prepared: series, (T, C).
            starts: first row of each window in the order of the batches, (M, B).
            targets: what is learnt of each, (M, B).
            batch: windows in a batch.
            rate: step size.
            bounds: least and largest admissible value of each parameter, (2, K).
            averaging: see `vehest.training.supervised.SupervisedSettings`.

        Returns:
            Sums of squared errors, (M,), float64.
        """
        losses = np.zeros(len(flat))
        rows = [moments[name].numpy() for name in ("exp_avg", "exp_avg_sq", "average" if averaging else "exp_avg")]
        adam = (*rows, bounds.numpy(), float(moments["step"]), float(rate), *DECAYS, EPSILON, float(averaging))
        self._over(flat.numpy(), prepared, starts, targets.contiguous().numpy(), batch, np.empty_like(rows[0]), losses, adam)
        moments["step"] += -(-starts.shape[1] // batch)
        return torch.from_numpy(losses)

    def _over(
        self, flat: Any, prepared: Tensor, starts: Tensor, targets: Any, batch: int, gradient: Any, losses: Any, adam: Any = None
    ) -> Any:
        """Values, (M, B), by all threads."""
        series, rows = prepared.contiguous().numpy(), starts.contiguous().numpy()
        values = np.empty(rows.shape, flat.dtype)
        given = self.given(flat.dtype.type)
        if adam is None:
            adam = (flat, flat, flat, flat, *[0.0] * 6)

        def work(m: int, end: int) -> None:
            own = (*(rows[m:end] for rows in adam[:3]), *adam[3:])
            parts = (rows[m:end], targets[m:end], batch, values[m:end], gradient[m:end], losses[m:end], own)
            self.loop(flat[m:end], given, series, *parts)

        over_members(work, len(flat))
        return values


class _Predict(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, flat: Tensor, prepared: Tensor, starts: Tensor, recursion: Recursion) -> Tensor:
        ctx.kept = flat, prepared, starts, recursion
        parameters = flat.detach().contiguous().numpy()
        none = np.empty((0, 0), parameters.dtype)
        return torch.from_numpy(recursion._over(parameters, prepared, starts, none, starts.shape[1], none, np.empty(0)))

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        flat, prepared, starts, recursion = ctx.kept
        parameters, weights = flat.detach().contiguous().numpy(), upstream[0].contiguous().numpy()
        gradient = np.empty_like(parameters)
        recursion._over(parameters, prepared, starts, weights, starts.shape[1], gradient, np.empty(0))
        return torch.from_numpy(gradient), None, None, None


class CompiledNetwork(ABC):
    """What a network with a `recursion` has for `vehest.training.members`."""

    @abstractmethod
    def recursion(self) -> Recursion:
        """The compiled recursion."""

    def compiled_members(self, parameters: Mapping[str, Tensor], prepared: Tensor, starts: Tensor) -> Tensor:
        """Predictions of M members, each on its own windows, (M, B)."""
        flat = torch.cat([values.reshape(len(values), -1) for values in parameters.values()], 1)
        return self.recursion().predict(flat, prepared, starts)

    def compiled_descent(self, *arguments: Any) -> Tensor:
        """See `Recursion.descend`."""
        return self.recursion().descend(*arguments)


@part()
def gather(series, channels, starts, first, rows, seen, stride):  # type: ignore[no-untyped-def]
    """Windows ``first`` and later of a series, (T · channels,), side by side, ``stride`` rows of lanes a sample, as many as fit.

    Lanes without a window repeat the last one.
    """
    for lane in range(rows.size):
        rows[lane] = starts[min(first + lane, starts.size - 1)] * channels
    for k in range(seen.size // (stride * rows.size)):
        for c in range(channels):
            at = (k * stride + c) * rows.size
            for lane in range(rows.size):
                seen[at + lane] = series[rows[lane] + k * channels + c]


@part()
def slopes_of(values, targets, first, squared, scratch):  # type: ignore[no-untyped-def]
    """Derivatives of what is minimised by the predictions of a block of lanes into ``scratch``; 0 in lanes without a window."""
    count = values.size
    for lane in range(scratch.size):
        at, slope = first + lane, scratch.dtype.type(0)
        if at < count:
            slope = (values[at] - targets[at]) * scratch.dtype.type(2 / count) if squared else targets[at]
        scratch[lane] = slope


@part()
def squared_error(values, targets):  # type: ignore[no-untyped-def]
    """Sum of squared errors, in double precision."""
    result = 0.0
    for at in range(values.size):
        error = values[at] - targets[at]
        result += float(error) * float(error)
    return result


@part()
def step_of_adam(flat, gradient, adam, m, batches):  # type: ignore[no-untyped-def]
    """Step ``batches`` of this call for member m, as `torch.optim.Adam` takes it, back into the bounds (Kingma & Ba 2015, Algorithm 1).

    The average of the parameters is θ̄ₜ = (1 − a)/(1 − aᵗ)·Σᵢ aᵗ⁻ⁱ θᵢ over the steps i = 1 … t (Section 7.2).
    """
    first, second, average, bounds, before, rate, decay, decay_of_squares, epsilon, averaging = adam
    number, t = flat.dtype.type, before + batches
    size, root = number(rate / (1 - decay**t)), number(np.sqrt(1 - decay_of_squares**t))
    for j in range(flat.size):
        g = gradient[j]
        first[m, j] += (g - first[m, j]) * number(1 - decay)
        second[m, j] = second[m, j] * number(decay_of_squares) + g * g * number(1 - decay_of_squares)
        moved = flat[j] - size * first[m, j] / (np.sqrt(second[m, j]) / root + number(epsilon))
        flat[j] = min(max(moved, bounds[0, j]), bounds[1, j])
        if averaging:
            average[m, j] += (flat[j] - average[m, j]) * number((1 - averaging) / (1 - averaging**t))
