"""Noise that depends on the state, compiled for filters at work."""

from __future__ import annotations

import math

import numba
import numpy as np
import torch

from vehest.filters.noise_models import StateDependentNoise
from vehest.filters.unscented_scan import CompiledNoise

compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


def compiled_noise(noise: StateDependentNoise, least_entropy: float = -math.inf) -> CompiledNoise:
    """What `StateDependentNoise` and `with_entropy` return, as a function of arrays of the noise's precision.

    Args:
        noise: as it is now; later changes of its parameters are not seen.
        least_entropy: see `with_entropy` [nat]; none: entropy as it is.
    """
    unit = noise.unit[torch.tril_indices(noise.constant.n, noise.constant.n)[0]]
    parts = (noise.constant(noise.state_unit, noise.state_unit), noise.weight / noise.state_unit * unit[:, None], noise.offset * unit)
    constant, weight, offset = (part.detach().contiguous().numpy() for part in parts)
    scalar = constant.dtype.type
    return CompiledNoise(_covariances, (constant, weight, offset, scalar(noise.scale), scalar(least_entropy)), len(constant))


@compiled
def _covariances(states, inputs, car, out, first, end):  # type: ignore[no-untyped-def]
    constant, weight, offset, scale, least = car
    n = constant.shape[0]
    lower, factor = np.zeros_like(constant), np.zeros_like(constant)
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
        if least > -np.inf:
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
            short = least - 0.5 * (n * math.log(2 * math.pi * math.e) + log_determinant)
            if short > 0:
                out[:, :, b] *= math.exp(2 * short / n)
