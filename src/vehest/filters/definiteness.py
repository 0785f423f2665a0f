"""Cholesky factors of covariances that may have lost their definiteness: repaired and counted."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

MARGIN = 1e-6
"""Smallest eigenvalue of a repaired covariance, relative to its largest."""


class Factor(NamedTuple):
    """A covariance and its factor.

    Attributes:
        covariance: the repaired one, (..., n, n); NaN where it could not be.
        factor: L with L Lᵀ = covariance, lower triangular, (..., n, n).
        repaired: bool, (...).
    """

    covariance: Tensor
    factor: Tensor
    repaired: Tensor


def factorised(covariance: Tensor) -> Factor:
    """Cholesky factor of a covariance, lifted first where it is not positive definite.

    Lifting adds the same to every eigenvalue, as much as is needed for a margin of `MARGIN`; what is added counts as a constant in
    gradients. Covariances that are not finite stay NaN, each for itself: the others of a batch go on.

    Args:
        covariance: symmetric, (..., n, n).
    """
    finite = torch.isfinite(covariance).all(-1).all(-1)
    identity = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
    safe = torch.where(finite[..., None, None], covariance, identity)
    factor, info = torch.linalg.cholesky_ex(safe)
    lost = info > 0
    if bool(lost.any()):
        with torch.no_grad():
            eigenvalues = torch.linalg.eigvalsh(safe)
            lift = MARGIN * eigenvalues.abs().amax(-1) - eigenvalues[..., 0]
        safe = safe + torch.where(lost, lift, 0.0)[..., None, None] * identity
        factor, info = torch.linalg.cholesky_ex(safe)
    whole = (finite & (info == 0))[..., None, None]
    return Factor(torch.where(whole, safe, torch.nan), torch.where(whole, factor, torch.nan), lost & finite)
