"""Functions for compiled loops that become vector instructions in float32.

Tanh and the logistic function also of `vehest.lanes`.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload

from vehest.lanes import Lanes, each, least, most

_F = numba.float32  # converts the constants of the polynomials


def tanh(x: Any) -> Any:
    """tanh(x) of a number or a vector.

    In compiled float32 code it is `rational_tanh`, whose loops become vector instructions; in
    float64 it is the library's, lane by lane.
    """
    return each(math.tanh, x)


def sigmoid(x: Any) -> Any:
    """1 / (1 + exp(-x)), computed as (1 + tanh(x/2)) / 2.

    This form does not overflow for any x.
    """
    return 0.5 + 0.5 * tanh(0.5 * x)


def softplus(x: Any) -> Any:
    """log(1 + exp(x)) as max(x, 0) + log(1 + exp(-|x|)), which does not overflow."""
    return max(x, x * 0) + math.log1p(math.exp(-abs(x)))


def arctan(x: Any) -> Any:
    """The principal arc tangent [rad]; in compiled float32 code a polynomial."""
    return math.atan(x)


def rational_tanh(x: Any) -> Any:
    """tanh by Lambert's continued fraction n/d at x/4; error below 2e-7.

    tanh(2y) = 2nd/(d² + n²) follows twice, divided once.

    Source: Abramowitz & Stegun, equations 4.5.70 and 4.5.24.
    """
    y = _F(0.25) * least(most(x, _F(-9.0)), _F(9.0))  # tanh(9) is 1 in float32
    s = y * y
    n = y * (_F(135135.0) + s * (_F(17325.0) + s * (_F(378.0) + s)))
    d = _F(135135.0) + s * (_F(62370.0) + s * (_F(3150.0) + s * _F(28.0)))
    n, d = _F(2.0) * n * d, d * d + n * n
    return _F(2.0) * n * d / (d * d + n * n)


_rational_tanh = numba.njit(inline="always")(rational_tanh)  # `rational_tanh`, compiled and inlined


@overload(tanh)
def _compiled_tanh(x):
    """numba's implementation of `tanh`: the rational function for float32, else the library's."""
    if types.float32 in (x, getattr(x, "dtype", None)):
        return lambda x: _rational_tanh(x)
    return (lambda x: each(math.tanh, x)) if isinstance(x, Lanes) else (lambda x: math.tanh(x))


@overload(sigmoid)
def _compiled_sigmoid(x):
    """numba's implementation of `sigmoid`, by the tanh of the argument's precision."""
    if types.float32 in (x, getattr(x, "dtype", None)):
        return lambda x: _F(0.5) + _F(0.5) * _rational_tanh(_F(0.5) * x)
    return lambda x: 0.5 + 0.5 * tanh(0.5 * x)


@intrinsic  # type: ignore[untyped-decorator]
def _of_bits(typing: Any, bits: Any) -> Any:
    """Reinterpret the bits of an int32 as a float32."""
    return types.float32(types.int32), lambda context, builder, sig, args: builder.bitcast(
        args[0], ir.FloatType()
    )


@overload(softplus)
def _compiled_softplus(x):
    """numba's implementation of `softplus` in float32, by exp(-|x|) = 2ⁿ exp(r) and log(1 + e) = 2
    artanh(e/(2 + e)).

    |r| < 0.35; exp(r) is the polynomial of Cephes' expf, artanh its series.
    """
    if x != types.float32:
        return lambda x: max(x, x * 0) + math.log1p(math.exp(-abs(x)))

    def compute(x):
        y = max(-abs(x), _F(-87.0))
        n = np.floor(y * _F(1.44269504) + _F(0.5))
        r = y - n * _F(0.693147181)
        p = _F(8.3334519e-3) + r * (_F(1.3981999e-3) + r * _F(1.9875692e-4))
        p = _F(0.5) + r * (_F(0.16666665) + r * (_F(4.1665796e-2) + r * p))
        e = (_F(1.0) + r + r * r * p) * _of_bits((np.int32(n) + np.int32(127)) << np.int32(23))
        z = e / (_F(2.0) + e)
        s = z * z
        p = _F(1 / 9) + s * (_F(1 / 11) + s * (_F(1 / 13) + s * _F(1 / 15)))
        return max(x, _F(0.0)) + _F(2.0) * z * (
            _F(1.0) + s * (_F(1 / 3) + s * (_F(1 / 5) + s * (_F(1 / 7) + s * p)))
        )

    return compute


@overload(arctan)
def _compiled_arctan(x):
    """numba's implementation of `arctan` in float32: the polynomial of Abramowitz & Stegun,
    equation 4.4.49, and π/2 - arctan(1/x) beyond 1.

    The polynomial in y² is evaluated at y = min(|x|, 1)/max(|x|, 1), so that both branches share
    it.
    """
    if x != types.float32:
        return lambda x: math.atan(x)

    def compute(x):
        a = abs(x)
        y = min(a, _F(1.0)) / max(a, _F(1.0))
        s = y * y
        p = _F(-0.0752896400) + s * (
            _F(0.0429096138) + s * (_F(-0.0161657367) + s * _F(0.0028662257))
        )
        p = _F(-0.3333314528) + s * (
            _F(0.1999355085) + s * (_F(-0.1420889944) + s * (_F(0.1065626393) + s * p))
        )
        angle = y + y * s * p
        return math.copysign(_F(1.57079633) - angle if a > _F(1.0) else angle, x)

    return compute
