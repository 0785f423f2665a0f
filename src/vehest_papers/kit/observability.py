"""What measurements over a short while can tell of a model's state, along a drive.

A model is given by its functions, x[k+1] = f(x[k], u[k]) and z[k] = h(x[k], u[k]). To first order
about the states along the drive, N measurements from sample k on depend on x[k] by the local
observability matrix

    O[k] = [H[k]; H[k+1] A[k]; …; H[k+N-1] A[k+N-2] … A[k]],   A = ∂f/∂x,  H = ∂h/∂x

With states in units of their typical sizes and measurements in units of their noise, its smallest
singular value is a ratio of signal to noise: below one, the N measurements tell less of some
combination of states than was known before.

Source: Kou, Elliott & Tarn, Information and Control 22 (1), 1973; Krener & Ide, Measures of
unobservability, CDC 2009.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vehest.constants import FloatArray

StateFunction = Callable[[Tensor, Tensor], Tensor]


class Observability(NamedTuple):
    """How well windows of measurements determine the state at their start; a row a window."""

    smallest: FloatArray  # smallest singular value of the local observability matrix, (T - N + 1,)
    # standard deviation of each state from these measurements alone, in units of its size; infinite
    # where they do not determine it, (T - N + 1, n)
    deviation: FloatArray
    rank: NDArray[np.int64]  # of the local observability matrix, (T - N + 1,)


def jacobians_along(
    transition: StateFunction, observation: StateFunction, states: FloatArray, inputs: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """A (T, n, n) and H (T, m, n) about the states (T, n) with inputs (T, p) along a drive, by
    automatic differentiation.
    """
    from torch.func import jacrev, vmap

    at = (
        torch.as_tensor(states, dtype=torch.float64),
        torch.as_tensor(inputs, dtype=torch.float64),
    )
    A, H = (vmap(jacrev(function))(*at).detach().numpy() for function in (transition, observation))
    return A, H


def observability_matrices(A: FloatArray, H: FloatArray, steps: int) -> FloatArray:
    """O of every window of N samples of A (T, n, n) and H (T, m, n), (T - N + 1, N m, n); raises
    ValueError unless N is between 1 and T.
    """
    count = len(A) - steps + 1
    if not 1 <= steps <= len(A):
        raise ValueError(
            f"a window of {steps} samples does not fit into {len(A)}; take 1 to {len(A)}"
        )
    product = np.broadcast_to(np.eye(A.shape[-1]), (count, *A.shape[1:]))
    rows = []
    for ahead in range(steps):
        rows.append(H[ahead : ahead + count] @ product)
        product = A[ahead : ahead + count] @ product
    return np.concatenate(rows, axis=1)


def observability_along(
    transition: StateFunction,
    observation: StateFunction,
    states: FloatArray,
    inputs: FloatArray,
    *,
    sizes: FloatArray,
    noise: FloatArray,
    steps: int,
) -> Observability:
    """Smallest singular value, standard deviations and rank of every window along a drive.

    Parameters
    ----------
    transition
        f of states (n,) and inputs (p,), to (n,); smooth.
    observation
        h of the same, to (m,).
    states
        About which is linearised, for example a filter's estimates, (T, n).
    inputs
        (T, p).
    sizes
        Typical size of each state, its unit here, (n,).
    noise
        Standard deviation of each measurement, (m,).
    steps
        Measurements a window.

    Raises
    ------
    ValueError
        Sizes or noise are not positive, or the window does not fit into the drive.
    """
    if not (np.all(np.asarray(sizes) > 0) and np.all(np.asarray(noise) > 0)):
        raise ValueError("sizes of states and noise of measurements must be positive")
    A, H = jacobians_along(transition, observation, states, inputs)
    A = A * sizes / np.asarray(sizes)[:, None]
    H = H * sizes / np.asarray(noise)[:, None]
    matrices = observability_matrices(A, H, steps)
    n = A.shape[-1]
    _, values, directions = np.linalg.svd(matrices, full_matrices=matrices.shape[1] < n)
    full = np.zeros((len(values), n))
    full[:, : values.shape[1]] = values
    full[full <= 1e-13 * full[:, :1]] = 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = np.where(np.abs(directions) > 1e-7, directions / full[:, :, None], 0.0)
    return Observability(
        full[:, -1], np.sqrt(np.square(spread).sum(1)), np.count_nonzero(full, axis=1)
    )
