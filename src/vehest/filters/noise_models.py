"""Covariances of noise that can be learnt, constant or linear in the state, in torch and compiled
for use; a floor for their entropy.

All covariances are products L Lᵀ of a lower triangular factor whose n (n + 1)/2 entries are stored
row by row. `ConstantNoise` and `StateDependentNoise` are modules for training, called with states
(..., k) and inputs; `compiled_noise` copies their present values into a `CompiledNoise`, which a
compiled filter calls at every sample.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numba
import numpy as np
import torch
from torch import Tensor, nn

from vehest.filters.unscented_scan import CompiledNoise

COVARIANCE_FLOOR = 1e-7
"""Added to the diagonal, so that a covariance stays positive definite (Węgrzynowski et al. 2024,
Eq. 7).
"""
SCALE = 0.01  # weight of the part that depends on the state; as in the authors' code, like the next
DEVIATION = 1e-3  # standard deviation of the initial random weights of L; its offsets start at 0


class ConstantNoise(nn.Module):
    """A full covariance L Lᵀ + `COVARIANCE_FLOOR` · I with a learnt lower triangular factor L.

    The factor's entries are stored row by row, in units that `begin` may set.

    Parameters
    ----------
    variances : Sequence[float]
        Its diagonal to begin with, n of them.
    correlated : bool, default True
        Whether entries off the diagonal are learnt; otherwise they stay zero.

    Source: Węgrzynowski et al. 2024, Eq. 7.
    """

    unit: Tensor  # unit in which the entries of each row of the factor are learnt, (n,)
    learnt: Tensor  # whether each entry of the factor is learnt, row by row

    def __init__(self, variances: Sequence[float], correlated: bool = True) -> None:
        super().__init__()
        start = torch.tensor(list(variances))
        self.n = len(start)
        self.factor = nn.Parameter(start.sqrt().diag()[_lower(self.n)])
        self.register_buffer("unit", torch.ones(self.n))
        rows, columns = _lower(self.n)
        self.register_buffer("learnt", (rows == columns) | correlated, persistent=False)

    def begin(self, covariance: Tensor, pace: float, state_unit: Tensor | None = None) -> None:
        """Set the initial covariance, and the units in which entries are learnt: ``pace`` times its
        standard deviations.

        All entries of a row of the factor then have one unit, so that one step of an optimiser
        changes all states alike, whatever their units.

        Parameters
        ----------
        covariance : Tensor
            (n, n), positive definite. Entries off the diagonal are ignored where they are not
            learnt.
        pace : float
            Unit of an entry, in standard deviations of its state.
        state_unit : Tensor | None, default None
            Not used here; accepted so that both noise models are called alike.
        """
        with torch.no_grad():
            if not self.learnt.all():
                covariance = covariance.diagonal().diag()
            self.unit.copy_(pace * covariance.diagonal().sqrt())
            self.factor.copy_(
                (torch.linalg.cholesky(covariance) / self.unit.unsqueeze(-1))[_lower(self.n)]
            )

    def forward(self, state: Tensor, inputs: Tensor) -> Tensor:
        """The covariance, (..., n, n), the same for every state (..., k)."""
        factor = self.factor * self.unit[_lower(self.n)[0]] * self.learnt
        return _product(factor, self.n, COVARIANCE_FLOOR).expand(*state.shape[:-1], self.n, self.n)


class StateDependentNoise(nn.Module):
    """A constant covariance and a part of which the factor is linear in the state: Q + `SCALE` ·
    L(x) L(x)ᵀ.

    Parameters
    ----------
    variances : Sequence[float]
        Diagonal of the constant part to begin with, n of them.
    n_states : int
        Length k of the state.
    correlated : bool, default True
        Whether both parts have entries off their diagonals.

    Source: Węgrzynowski et al. 2024, Section III-B.3; scale and start values as in its authors'
    code.
    """

    unit: Tensor  # unit in which the entries of each row of the factor are learnt, (n,)
    state_unit: Tensor  # number by which each state is divided, (k,)

    def __init__(self, variances: Sequence[float], n_states: int, correlated: bool = True) -> None:
        super().__init__()
        self.constant = ConstantNoise(variances, correlated)
        count = self.constant.n * (self.constant.n + 1) // 2
        self.register_buffer("unit", torch.ones(self.constant.n))
        self.register_buffer("state_unit", torch.ones(n_states))
        self.weight = nn.Parameter(torch.empty(count, n_states))
        self.offset = nn.Parameter(torch.zeros(count))
        self.reset()

    def begin(self, covariance: Tensor, pace: float, state_unit: Tensor) -> None:
        """Set the initial covariance of the constant part, see `ConstantNoise.begin`.

        Parameters
        ----------
        covariance : Tensor
            (n, n), of the constant part.
        pace : float
            Unit of an entry, in standard deviations of its state; the part that depends on the
            state has the same unit over √`SCALE`.
        state_unit : Tensor
            (k,); states are divided by it before the linear layer.
        """
        self.constant.begin(covariance, pace)
        with torch.no_grad():
            self.unit.copy_(self.constant.unit / SCALE**0.5)
            self.state_unit.copy_(state_unit)

    def reset(self, generator: torch.Generator | None = None) -> None:
        """Draw the weights anew, normal with the deviation `DEVIATION`; the offsets stay.

        Parameters
        ----------
        generator : torch.Generator | None, default None
            Source of random numbers; torch's global one if None. Weights of entries that are not
            learnt become 0, and random numbers are drawn for them too.
        """
        with torch.no_grad():
            drawn = DEVIATION * torch.randn(self.weight.shape, generator=generator)
            self.weight.copy_(torch.where(self.constant.learnt.unsqueeze(-1), drawn, 0.0))

    def forward(self, state: Tensor, inputs: Tensor) -> Tensor:
        """Covariance of each state: Q + `SCALE` · L(x) L(x)ᵀ.

        Parameters
        ----------
        state : Tensor
            (..., k), in the state's own units.
        inputs : Tensor
            Not used.

        Returns
        -------
        Tensor
            (..., n, n), symmetric.
        """
        factor = (
            nn.functional.linear(state / self.state_unit, self.weight, self.offset)
            * self.unit[_lower(self.constant.n)[0]]
        )
        factor = factor * self.constant.learnt
        return self.constant(state, inputs) + SCALE * _product(factor, self.constant.n, 0.0)


def entropy(covariance: Tensor) -> Tensor:
    """Differential entropy of a normal distribution, ½ (n ln 2πe + ln |det P|).

    Parameters
    ----------
    covariance : Tensor
        (..., n, n).

    Returns
    -------
    Tensor
        (...) [nat]; it depends on the units of the states.
    """
    n = covariance.shape[-1]
    return 0.5 * (n * math.log(2.0 * math.pi * math.e) + torch.linalg.slogdet(covariance).logabsdet)


def with_entropy(covariance: Tensor, min_entropy: float) -> Tensor:
    """Scale covariances up where their entropy is too low; the shape of the ellipsoid stays.

    P is multiplied by exp(2 Δ/n), with Δ the missing entropy, which adds Δ to ½ ln det P.

    Parameters
    ----------
    covariance : Tensor
        (..., n, n), positive definite.
    min_entropy : float
        Lower bound of the entropy [nat]. Below it the gradient passes through the entropy too.
    """
    short = (min_entropy - entropy(covariance)).clamp(min=0.0)
    return torch.exp(2.0 / covariance.shape[-1] * short)[..., None, None] * covariance


def _product(factor: Tensor, n: int, floor: float) -> Tensor:
    """Covariance L Lᵀ + floor · I, (..., n, n), from the entries of L row by row, (..., n (n + 1) /
    2).
    """
    rows, columns = _lower(n)
    lower = factor.new_zeros(*factor.shape[:-1], n, n)
    lower[..., rows, columns] = factor
    return lower @ lower.mT + floor * torch.eye(n, dtype=factor.dtype, device=factor.device)


def _lower(n: int) -> tuple[Tensor, Tensor]:
    """Rows and columns of the lower triangle of an n × n matrix, row by row."""
    rows, columns = torch.tril_indices(n, n)
    return rows, columns


def compiled_noise(noise: StateDependentNoise, min_entropy: float = -math.inf) -> CompiledNoise:
    """Compile a trained `StateDependentNoise`, with `with_entropy`, for filters in use.

    Parameters
    ----------
    noise : StateDependentNoise
        As it is now; later changes of its parameters have no effect.
    min_entropy : float, default -math.inf
        See `with_entropy` [nat]; none: entropy as it is.
    """
    unit = noise.unit[_lower(noise.constant.n)[0]]
    parts = (
        noise.constant(noise.state_unit, noise.state_unit),
        noise.weight / noise.state_unit * unit[:, None],
        noise.offset * unit,
    )
    constant, weight, offset = (part.detach().contiguous().numpy() for part in parts)
    scalar = constant.dtype.type
    return CompiledNoise(
        _covariances, (constant, weight, offset, scalar(SCALE), scalar(min_entropy))
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _covariances(states, inputs, car, out, first, end):  # type: ignore[no-untyped-def]
    """Write Q + s L(x) L(x)ᵀ at states, scaled to at least an entropy.

    Sums run over states k in order for an entry of L, and over columns of L for an entry of the
    product. The log-determinant for the entropy is that of a Cholesky factor.

    Parameters
    ----------
    states : array
        (k, B), of the noise's precision.
    inputs : array
        Not used.
    car : tuple
        Constant part (n, n), weight (n (n + 1)/2, k), offset (n (n + 1)/2,), scale s, and
        ``min_entropy``, -∞ for none.
    out : array
        (n, n, B), written for the sequences from ``first`` to ``end``.
    """
    constant, weight, offset, scale, min_entropy = car
    n = constant.shape[0]
    lower = np.zeros_like(constant)
    factor = np.zeros_like(constant)
    for b in range(first, end):
        entry = 0
        for i in range(n):
            for j in range(i + 1):
                total = offset[entry]
                for k in range(states.shape[0]):
                    total += weight[entry, k] * states[k, b]
                lower[i, j] = total
                entry += 1
        for i in range(n):
            for j in range(i + 1):
                total = constant[0, 0] * 0
                for k in range(j + 1):
                    total += lower[i, k] * lower[j, k]
                out[i, j, b] = constant[i, j] + scale * total
                out[j, i, b] = out[i, j, b]
        if min_entropy > -np.inf:
            log_determinant = constant[0, 0] * 0
            for j in range(n):
                total = out[j, j, b]
                for k in range(j):
                    total -= factor[j, k] * factor[j, k]
                factor[j, j] = math.sqrt(total)
                log_determinant += 2 * math.log(factor[j, j])
                for i in range(j + 1, n):
                    total = out[i, j, b]
                    for k in range(j):
                        total -= factor[i, k] * factor[j, k]
                    factor[i, j] = total / factor[j, j]
            short = min_entropy - 0.5 * (n * math.log(2 * math.pi * math.e) + log_determinant)
            if short > 0:
                out[:, :, b] *= math.exp(2 * short / n)
