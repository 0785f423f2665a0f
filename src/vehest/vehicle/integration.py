"""Differential equations to steps in time."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor


def rk4(derivative: Callable[[Tensor, Tensor], Tensor], state: Tensor, inputs: Tensor, step: float) -> Tensor:
    """The state one step later by the classical fourth-order Runge-Kutta method, inputs held over the step.

    Args:
        derivative: dx/dt of states (..., n) and inputs (..., p).
        state: (..., n).
        inputs: (..., p).
        step: [s].

    Source: Kutta 1901.
    """
    first = derivative(state, inputs)
    second = derivative(state + 0.5 * step * first, inputs)
    third = derivative(state + 0.5 * step * second, inputs)
    fourth = derivative(state + step * third, inputs)
    return state + step / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
