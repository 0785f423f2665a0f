"""Covariances of noise that can be learnt: constant or linear in the state; and a floor for their entropy."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

FLOOR = 1e-7
"""Added to the diagonal, so that a covariance stays positive definite (Węgrzynowski et al. 2024, Eq. 7)."""


class ConstantNoise(nn.Module):
    """A full covariance L Lᵀ + floor · I with a lower triangular factor that is learnt, row by row in units that `begin` may set.

    Args:
        variances: its diagonal to begin with, n of them.
        correlated: whether entries off the diagonal are learnt; otherwise they stay zero.
        floor: see `FLOOR`.

    Source: Węgrzynowski et al. 2024, Eq. 7.
    """

    unit: Tensor
    learnt: Tensor

    def __init__(self, variances: Sequence[float], correlated: bool = True, floor: float = FLOOR) -> None:
        super().__init__()
        start = torch.tensor(list(variances))
        self.floor = floor
        self.n = len(start)
        self.factor = nn.Parameter(start.sqrt().diag()[_lower(self.n)])
        self.register_buffer("unit", torch.ones(self.n))
        rows, columns = _lower(self.n)
        self.register_buffer("learnt", (rows == columns) | correlated, persistent=False)

    def begin(self, covariance: Tensor, pace: float, state_unit: Tensor | None = None) -> None:
        """Start from a covariance, (n, n), and learn in units of ``pace`` times its deviations, so that all entries learn alike."""
        with torch.no_grad():
            if not self.learnt.all():
                covariance = covariance.diagonal().diag()
            self.unit.copy_(pace * covariance.diagonal().sqrt())
            self.factor.copy_((torch.linalg.cholesky(covariance) / self.unit.unsqueeze(-1))[_lower(self.n)])

    def forward(self, state: Tensor, inputs: Tensor) -> Tensor:
        """The covariance, (..., n, n), the same for every state (..., k)."""
        factor = self.factor * self.unit[_lower(self.n)[0]] * self.learnt
        return _product(factor, self.n, self.floor).expand(*state.shape[:-1], self.n, self.n)


class StateDependentNoise(nn.Module):
    """A constant covariance and a part of which the factor is linear in the state: Q + scale · L(x) L(x)ᵀ.

    Args:
        variances: diagonal of the constant part to begin with, n of them.
        n_states: length k of the state.
        scale: weight of the part that depends on the state.
        deviation: of the random weights of L to begin with; its offsets start at 0.
        generator: of these.
        correlated: whether both parts have entries off their diagonals.

    Source: Węgrzynowski et al. 2024, Section III-B.3; scale and start values as in its authors' code.
    """

    unit: Tensor
    state_unit: Tensor

    def __init__(
        self,
        variances: Sequence[float],
        n_states: int,
        *,
        scale: float = 0.01,
        deviation: float = 1e-3,
        generator: torch.Generator | None = None,
        correlated: bool = True,
    ) -> None:
        super().__init__()
        self.constant = ConstantNoise(variances, correlated)
        self.scale = scale
        count = self.constant.n * (self.constant.n + 1) // 2
        self.deviation = deviation
        self.register_buffer("unit", torch.ones(self.constant.n))
        self.register_buffer("state_unit", torch.ones(n_states))
        self.weight = nn.Parameter(torch.empty(count, n_states))
        self.offset = nn.Parameter(torch.zeros(count))
        self.reset(generator)

    def begin(self, covariance: Tensor, pace: float, state_unit: Tensor) -> None:
        """Start from a covariance, (n, n); see `ConstantNoise.begin`. L sees states in units, (k,)."""
        self.constant.begin(covariance, pace)
        with torch.no_grad():
            self.unit.copy_(self.constant.unit / self.scale**0.5)
            self.state_unit.copy_(state_unit)

    def reset(self, generator: torch.Generator | None = None) -> None:
        """Draw the weights anew."""
        with torch.no_grad():
            drawn = self.deviation * torch.randn(self.weight.shape, generator=generator)
            self.weight.copy_(torch.where(self.constant.learnt.unsqueeze(-1), drawn, 0.0))

    def forward(self, state: Tensor, inputs: Tensor) -> Tensor:
        """The covariance of each state, (..., n, n)."""
        factor = nn.functional.linear(state / self.state_unit, self.weight, self.offset) * self.unit[_lower(self.constant.n)[0]]
        factor = factor * self.constant.learnt
        return self.constant(state, inputs) + self.scale * _product(factor, self.constant.n, 0.0)


def entropy(covariance: Tensor) -> Tensor:
    """Differential entropy of a normal distribution [nat], (..., n, n) -> (...)."""
    n = covariance.shape[-1]
    return 0.5 * (n * math.log(2.0 * math.pi * math.e) + torch.linalg.slogdet(covariance).logabsdet)


def with_entropy(covariance: Tensor, least: float) -> Tensor:
    """The covariance, scaled up where its entropy lies below ``least`` [nat]; the shape of its ellipsoid stays."""
    short = (least - entropy(covariance)).clamp(min=0.0)
    return torch.exp(2.0 / covariance.shape[-1] * short)[..., None, None] * covariance


def _product(factor: Tensor, n: int, floor: float) -> Tensor:
    """L Lᵀ + floor · I of the entries of L row by row, (..., n (n + 1) / 2) -> (..., n, n)."""
    rows, columns = _lower(n)
    lower = factor.new_zeros(*factor.shape[:-1], n, n)
    lower[..., rows, columns] = factor
    return lower @ lower.mT + floor * torch.eye(n, dtype=factor.dtype, device=factor.device)


def _lower(n: int) -> tuple[Tensor, Tensor]:
    rows, columns = torch.tril_indices(n, n)
    return rows, columns
