"""Learnt covariances without entries off their diagonals."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from vehest.filters.noise_models import ConstantNoise, StateDependentNoise


class DiagonalNoise(ConstantNoise):
    """As `ConstantNoise`, of which only the diagonal is learnt; the other entries of the factor stay zero.

    Source: what Węgrzynowski et al. 2024, Section III-B.3, leave out for its oversimplification.
    """

    def begin(self, covariance: Tensor, pace: float) -> None:
        """Start from the variances of a covariance, (n, n); see `ConstantNoise.begin`."""
        super().begin(covariance.diagonal().diag(), pace)

    def forward(self, state: Tensor, inputs: Tensor) -> Tensor:
        """The covariance, (..., n, n), the same for every state (..., k)."""
        variances = (self.factor[diagonal_entries(self.n)] * self.unit).square() + self.floor
        return variances.diag().expand(*state.shape[:-1], self.n, self.n)


class DiagonalStateDependentNoise(StateDependentNoise):
    """As `StateDependentNoise`, of which only the diagonals of both parts are learnt; the other entries stay zero."""

    def __init__(self, *args: object, **kwargs: object) -> None:
        super().__init__(*args, **kwargs)  # type: ignore[arg-type]
        full = self.constant
        self.constant = DiagonalNoise([1.0] * full.n, full.floor)
        self.constant.load_state_dict(full.state_dict())

    def reset(self, generator: torch.Generator | None = None) -> None:
        """Draw the weights anew, as many as without this constraint."""
        super().reset(generator)
        with torch.no_grad():
            diagonal = self.weight[diagonal_entries(self.constant.n)].clone()
            self.weight.zero_()
            self.weight[diagonal_entries(self.constant.n)] = diagonal

    def forward(self, state: Tensor, inputs: Tensor) -> Tensor:
        """The covariance of each state, (..., n, n)."""
        rows = diagonal_entries(self.constant.n)
        deviations = nn.functional.linear(state / self.state_unit, self.weight[rows], self.offset[rows]) * self.unit
        covariance: Tensor = self.constant(state, inputs) + self.scale * torch.diag_embed(deviations.square())
        return covariance


def diagonal_entries(n: int) -> Tensor:
    """Where the diagonal stands among the entries of a triangular factor row by row, (n,)."""
    rows = torch.arange(n)
    return rows * (rows + 3) // 2
