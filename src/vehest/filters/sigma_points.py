"""Rules by which an unscented filter stands for a normal distribution with a few points."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class SigmaRule:
    """Symmetric points: the mean, and mean ± spread · columns of the covariance's Cholesky factor.

    Args:
        spread: distance in columns of the factor, positive.
        centre_mean: weight of the mean point in means.
        centre_covariance: its weight in covariances.
        other: weight of each of the 2n other points, in both.
    """

    spread: float
    centre_mean: float
    centre_covariance: float
    other: float

    def points(self, mean: Tensor, factor: Tensor) -> Tensor:
        """Points of N(mean, L Lᵀ).

        Args:
            mean: (..., n).
            factor: L, lower triangular, (..., n, n).

        Returns:
            (..., 2n + 1, n), the mean first.
        """
        offsets = self.spread * factor.mT
        centre = mean.unsqueeze(-2)
        return torch.cat([centre, centre + offsets, centre - offsets], dim=-2)

    def mean(self, values: Tensor) -> Tensor:
        """Weighted mean of values at the points, (..., 2n + 1, m) -> (..., m)."""
        return self.centre_mean * values[..., 0, :] + self.other * values[..., 1:, :].sum(-2)

    def covariance(self, deviations: Tensor, others: Tensor) -> Tensor:
        """Weighted Σ w d eᵀ of deviations from the mean, (..., 2n + 1, m) and (..., 2n + 1, k) -> (..., m, k)."""
        centre = deviations[..., 0, :].unsqueeze(-1) * others[..., 0, :].unsqueeze(-2)
        return self.centre_covariance * centre + self.other * (deviations[..., 1:, :].mT @ others[..., 1:, :])


def symmetric_rule(n: int, kappa: float) -> SigmaRule:
    """The rule of Julier & Uhlmann 1997; n + κ = 3 meets the fourth moments of a normal distribution.

    n + κ is positive. With κ < 0 the mean has a negative weight, and covariances may lose their definiteness.
    """
    total = n + kappa
    return SigmaRule(math.sqrt(total), kappa / total, kappa / total, 0.5 / total)


def cubature_rule(n: int) -> SigmaRule:
    """The third-degree spherical-radial rule of Arasaratnam & Haykin 2009: 2n points of equal weight, none at the mean."""
    return symmetric_rule(n, 0.0)
