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

    def __post_init__(self) -> None:
        if not self.spread > 0.0:
            raise ValueError(f"sigma points must be spread by a positive number, not {self.spread}")

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

    With κ < 0 the mean has a negative weight, and covariances may lose their definiteness.

    Raises:
        ValueError: n + κ is not positive.
    """
    _check(n, n + kappa, f"kappa = {kappa}")
    total = n + kappa
    return SigmaRule(math.sqrt(total), kappa / total, kappa / total, 0.5 / total)


def scaled_rule(n: int, alpha: float = 1e-3, beta: float = 2.0, kappa: float = 0.0) -> SigmaRule:
    """The scaled rule of van der Merwe 2004; β = 2 is best for normal distributions.

    Raises:
        ValueError: α²(n + κ) is not positive.
    """
    total = alpha**2 * (n + kappa)
    _check(n, total, f"alpha = {alpha}, kappa = {kappa}")
    centre = 1.0 - n / total
    return SigmaRule(math.sqrt(total), centre, centre + 1.0 - alpha**2 + beta, 0.5 / total)


def cubature_rule(n: int) -> SigmaRule:
    """The third-degree spherical-radial rule of Arasaratnam & Haykin 2009: 2n points of equal weight, none at the mean."""
    return symmetric_rule(n, 0.0)


def _check(n: int, total: float, what: str) -> None:
    if n < 1 or not total > 0.0:
        raise ValueError(f"no sigma points for {n} states with {what}: their squared spread would be {total:g}")
