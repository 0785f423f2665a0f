"""Hyperbolic tangent and logistic function for compiled loops, of numbers and of `vehest.lanes`."""

from __future__ import annotations

import math
from typing import Any

import numba
from numba import types
from numba.extending import overload

from vehest.lanes import Lanes, each, least, most

_F = numba.float32


def tanh(x: Any) -> Any:
    """tanh(x); in compiled float32 code a rational function, whose loops become vector instructions."""
    return each(math.tanh, x)


def sigmoid(x: Any) -> Any:
    """1 / (1 + exp(-x)), computed as (1 + tanh(x/2)) / 2."""
    return 0.5 + 0.5 * tanh(0.5 * x)


def rational_tanh(x: Any) -> Any:
    """tanh by Lambert's continued fraction n/d at x/4, then tanh(2y) = 2nd/(d² + n²) twice, divided once; error below 2e-7.

    Source: Abramowitz & Stegun, equations 4.5.70 and 4.5.24.
    """
    y = _F(0.25) * least(most(x, _F(-9.0)), _F(9.0))  # tanh(9) is 1 in float32
    s = y * y
    n = y * (_F(135135.0) + s * (_F(17325.0) + s * (_F(378.0) + s)))
    d = _F(135135.0) + s * (_F(62370.0) + s * (_F(3150.0) + s * _F(28.0)))
    n, d = _F(2.0) * n * d, d * d + n * n
    return _F(2.0) * n * d / (d * d + n * n)


_rational_tanh = numba.njit(inline="always")(rational_tanh)


@overload(tanh)
def _compiled_tanh(x):  # type: ignore[no-untyped-def]
    if types.float32 in (x, getattr(x, "dtype", None)):
        return lambda x: _rational_tanh(x)
    return (lambda x: each(math.tanh, x)) if isinstance(x, Lanes) else (lambda x: math.tanh(x))


@overload(sigmoid)
def _compiled_sigmoid(x):  # type: ignore[no-untyped-def]
    if types.float32 in (x, getattr(x, "dtype", None)):
        return lambda x: _F(0.5) + _F(0.5) * _rational_tanh(_F(0.5) * x)
    return lambda x: 0.5 + 0.5 * tanh(0.5 * x)
