"""Compiled recursions (`vehest.estimators.kernels.recursion`) as torch uses them.

Differentiable, and trained several steps at a time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from vehest.estimators.kernels.recursion import Recursion


class CompiledNetwork(ABC):
    """Base of networks with a compiled `recursion`, for `vehest.training.members`."""

    @abstractmethod
    def recursion(self) -> Recursion:
        """The compiled recursion."""

    def compiled_members(
        self, parameters: Mapping[str, Tensor], prepared: Tensor, starts: Tensor
    ) -> Tensor:
        """Predictions of M members, each on its own windows, (M, B).

        Parameters
        ----------
        parameters : Mapping[str, Tensor]
            Name -> (M, ...), in the order of the network's own parameters.
        prepared : Tensor
            Series, (T, C).
        starts : Tensor
            First rows of windows, (M, B), int64.

        Returns
        -------
        Tensor
            [m/s], differentiable in the parameters.
        """
        flat = torch.cat([values.reshape(len(values), -1) for values in parameters.values()], 1)
        return _Predict.apply(flat, prepared, starts, self.recursion())  # type: ignore

    def compiled_descent(
        self,
        flat: Tensor,
        moments: Mapping[str, Tensor],
        prepared: Tensor,
        starts: Tensor,
        targets: Tensor,
        batch: int,
        *adam_options: Any,
    ) -> Tensor:
        """See `Recursion.descend`.

        ``moments`` are Adam's ``step``, ``exp_avg`` and ``exp_avg_sq`` as torch names them, and
        ``average``.

        Parameters
        ----------
        flat : Tensor
            Parameters (M, K), changed in place.
        moments : Mapping[str, Tensor]
            Changed in place; the step grows by the number of batches.
        prepared, starts, targets : Tensor
            Series (T, C), first rows (M, B) and targets (M, B) [m/s].
        batch : int
            Windows in a batch.
        *adam_options : Any
            Step size, bounds of parameters (2, K), and decay of the average, 0 for none.

        Returns
        -------
        Tensor
            Sums of squared errors, (M,), float64.
        """
        rate, bounds, averaging = adam_options
        names = ("exp_avg", "exp_avg_sq", "average" if "average" in moments else "exp_avg")
        adam = (
            *(moments[name].numpy() for name in names),
            bounds.numpy(),
            float(moments["step"]),
            float(rate),
            float(averaging),
        )
        series, rows, learnt_targets = (
            tensor.contiguous().numpy() for tensor in (prepared, starts, targets)
        )
        losses = self.recursion().descend(flat.numpy(), series, rows, learnt_targets, batch, adam)
        moments["step"] += -(-starts.shape[1] // batch)
        return torch.from_numpy(losses)


class _Predict(torch.autograd.Function):
    """Autograd function of a recursion: its values, and its gradient by the parameters alone."""

    @staticmethod
    def forward(
        ctx: Any, flat: Tensor, prepared: Tensor, starts: Tensor, recursion: Recursion
    ) -> Tensor:
        """Predictions (M, B) of flat parameters (M, K)."""
        ctx.recursion = recursion
        ctx.arrays = [tensor.detach().contiguous().numpy() for tensor in (flat, prepared, starts)]
        return torch.from_numpy(recursion.values(*ctx.arrays))

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        """Gradient by the parameters, for which the recursion runs forward once more."""
        return (
            torch.from_numpy(ctx.recursion.gradient(*ctx.arrays, upstream[0].contiguous().numpy())),
            None,
            None,
            None,
        )
