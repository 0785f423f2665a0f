"""Physical parameters that can be learnt and stay positive."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn


class PositiveParameters(nn.Module):
    """Named positive numbers, learnt as their logarithms.

    Args:
        values: to begin with.
        fixed: names of those that are not learnt.

    Raises:
        ValueError: a value is not positive, or ``fixed`` names another.

    Source: Węgrzynowski et al. 2024, Section III-B.4.
    """

    def __init__(self, values: Mapping[str, float], fixed: frozenset[str] = frozenset()) -> None:
        super().__init__()
        if fixed - set(values):
            raise ValueError(f"there is no parameter '{min(fixed - set(values))}'")
        for name, value in values.items():
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be positive, not {value}")
            logarithm = torch.tensor(math.log(value))
            if name in fixed:
                self.register_buffer(f"log_{name}", logarithm)
            else:
                self.register_parameter(f"log_{name}", nn.Parameter(logarithm))

    def __getitem__(self, name: str) -> Tensor:
        """The value of a parameter."""
        logarithm: Tensor = getattr(self, f"log_{name}")
        return logarithm.exp()
