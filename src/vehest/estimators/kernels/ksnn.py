"""The KS-NN recursion, compiled: predictions and, in the same pass, their derivatives.

Only the two local models that are active at a sample are evaluated. A row of local model p holds
[γ₁, γ₂, β₁, β₂, (w₁, b, w₂…, b₂…, w₃…) of f₁, the same of f₂] in the notation of Da Lio et al. 2023, Eqs. 7 and 8.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from vehest.estimators.kernels.activation import tanh


def predict(theta: Tensor, series: Tensor, starts: Tensor, yaw_rate_max: float, step: float, n_hidden: int, n_window: int) -> Tensor:
    """Lateral velocity one step after each window, differentiable in ``theta``.

    Args:
        theta: parameters, (M, P, 4 + 2 (2 + 3 Q)).
        series: measurements yaw_rate, vx, ay, ax, (T, 4).
        starts: first row of each window, (M, B).
        yaw_rate_max: centre of the last local model [rad/s].
        step: sampling time [s].
        n_hidden: neurons Q.
        n_window: samples N in a window.

    Returns:
        (M, B) [m/s].
    """
    result: Tensor = _Predict.apply(theta, series, starts, yaw_rate_max, step, n_hidden, n_window)  # type: ignore[no-untyped-call]
    return result


class _Predict(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, theta: Tensor, series: Tensor, starts: Tensor, yaw_rate_max: float, step: float, n_hidden: int, n_window: int
    ) -> Tensor:
        wanted = ctx.needs_input_grad[0]
        members, batch = starts.shape
        values = torch.empty(members, batch, dtype=theta.dtype)
        jacobian = torch.zeros(members, batch if wanted else 0, *theta.shape[1:], dtype=theta.dtype)
        scalar = np.dtype(str(theta.dtype).removeprefix("torch.")).type
        _recursion(
            theta.detach().contiguous().numpy(),
            series.contiguous().numpy(),
            starts.contiguous().numpy(),
            scalar(yaw_rate_max),
            scalar(step),
            n_hidden,
            n_window,
            values.numpy(),
            jacobian.numpy(),
        )
        ctx.save_for_backward(jacobian)
        return values

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        (jacobian,) = ctx.saved_tensors
        members, batch = upstream[0].shape
        gradient = torch.bmm(upstream[0].unsqueeze(1), jacobian.view(members, batch, -1))
        return gradient.view(members, *jacobian.shape[2:]), None, None, None, None, None, None


@numba.njit(cache=True, fastmath=True, error_model="numpy")
def _recursion(theta, series, starts, yaw_rate_max, step, n_hidden, n_window, values, jacobian):  # type: ignore[no-untyped-def]
    members, batch = starts.shape
    n_local = theta.shape[1]
    dtype = theta.dtype
    one, zero = dtype.type(1), dtype.type(0)
    wanted = jacobian.shape[1] > 0
    last = dtype.type(n_local - 1)
    per_width = last / yaw_rate_max
    block = 2 + 3 * n_hidden
    v_at, u_at = np.empty(n_window, dtype), np.empty(n_window, dtype)
    hidden = np.empty((n_window, 2, 2, max(n_hidden, 1)), dtype)  # step, active model, feedback function, neuron
    adjoint = np.empty(2, dtype)
    for m in range(members):
        for b in range(batch):
            first = starts[m, b]
            v, u = zero, series[first, 1]
            for k in range(n_window):
                omega, speed, ay, ax = series[first + k, 0], series[first + k, 1], series[first + k, 2], series[first + k, 3]
                v_at[k], u_at[k] = v, u
                p, weight_next = _active(omega, per_width, last)
                error = u - speed
                slip = step * (ay - speed * omega)
                thrust = step * (ax + v * omega)
                v_next, u_next = zero, zero
                for side in range(min(2, n_local)):
                    phi = weight_next if side == 1 else one - weight_next
                    row = theta[m, p + side]
                    f1, f2 = row[4] * error + row[5], row[4 + block] * error + row[5 + block]
                    for j in range(n_hidden):
                        h1 = tanh(row[6 + j] * error + row[6 + n_hidden + j])
                        h2 = tanh(row[6 + block + j] * error + row[6 + block + n_hidden + j])
                        hidden[k, side, 0, j], hidden[k, side, 1, j] = h1, h2
                        f1 += row[6 + 2 * n_hidden + j] * h1
                        f2 += row[6 + block + 2 * n_hidden + j] * h2
                    v_next += phi * (row[0] * v + row[2] * slip - omega * f1)
                    u_next += phi * (row[1] * u + row[3] * thrust - f2)
                v, u = v_next, u_next
            values[m, b] = v
            if not wanted:
                continue
            to_v, to_u = one, zero  # derivatives of the prediction by the states after step k
            for k in range(n_window - 1, -1, -1):
                omega, speed, ay, ax = series[first + k, 0], series[first + k, 1], series[first + k, 2], series[first + k, 3]
                v, u = v_at[k], u_at[k]
                p, weight_next = _active(omega, per_width, last)
                error = u - speed
                slip = step * (ay - speed * omega)
                thrust = step * (ax + v * omega)
                new_v, new_u = zero, zero
                for side in range(min(2, n_local)):
                    phi = weight_next if side == 1 else one - weight_next
                    row, slot = theta[m, p + side], jacobian[m, b, p + side]
                    local_v, local_u = phi * to_v, phi * to_u
                    slot[0] += local_v * v
                    slot[1] += local_u * u
                    slot[2] += local_v * slip
                    slot[3] += local_u * thrust
                    new_v += row[0] * local_v + row[3] * step * omega * local_u
                    new_u += row[1] * local_u
                    adjoint[0], adjoint[1] = -omega * local_v, -local_u
                    for i in range(2):
                        base, a = 4 + i * block, adjoint[i]
                        slot[base] += a * error
                        slot[base + 1] += a
                        new_u += a * row[base]
                        for j in range(n_hidden):
                            h = hidden[k, side, i, j]
                            inner = a * row[base + 2 + 2 * n_hidden + j] * (one - h * h)
                            slot[base + 2 + j] += inner * error
                            slot[base + 2 + n_hidden + j] += inner
                            slot[base + 2 + 2 * n_hidden + j] += a * h
                            new_u += inner * row[base + 2 + j]
                to_v, to_u = new_v, new_u


@numba.njit(inline="always")
def _active(omega, per_width, last):  # type: ignore[no-untyped-def]
    """First of the two active local models and the weight of the second; beyond the last centre the last one alone."""
    position = min(abs(omega) * per_width, last)
    p = max(min(int(position), int(last) - 1), 0)
    return p, position - type(last)(p)
