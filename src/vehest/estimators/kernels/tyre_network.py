"""Sigma points through the car whose tyres are a network (`TyreNetworkCar`), compiled, with the adjoint.

Points lie side by side in columns, so that layers are matrix products and everything else runs along rows. The adjoint computes
stages again instead of keeping them. Blocks of sequences are small enough for a core's own cache, and for the matrix products to
stay on their thread.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
import torch

from vehest.estimators.kernels.activation import sigmoid, tanh
from vehest.filters.unscented_scan import Array, PointModel
from vehest.vehicle.dynamics import TURN, UNSCALED, TyreNetworkCar, physical_of
from vehest.vehicle.tyres import STILL

BLOCK = 110  # points at a time

compiled = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "arcp", "nsz", "afn"})


class CompiledTyreNetwork(PointModel):
    """A `TyreNetworkCar` of two hidden layers, for the unscented filter.

    Args:
        dynamics: the car; gradients go to its parameters where they are wanted.
        step: [s].
        lower: smallest possible value of each state.
        dtype: precision of the arrays.
    """

    def __init__(self, dynamics: TyreNetworkCar, step: float, lower: Sequence[float] | None, dtype: torch.dtype) -> None:
        layers = [tensor for pair in dynamics.network.layers() for tensor in pair]
        if len(layers) != 6:
            raise ValueError(f"the compiled tyre network has two hidden layers, not {len(layers) // 2 - 1}")
        values, mass, wheelbase, radius = physical_of(dynamics.car)
        tensors = [tensor.to(dtype) for tensor in (*layers, values)]
        self._arrays = [tensor.detach().contiguous().numpy() for tensor in tensors]
        self._learning = any(tensor.requires_grad for tensor in tensors)
        self.parameters = tensors if self._learning else ()
        self.lower = lower
        scalar = self._arrays[0].dtype.type
        self._constants = np.array([mass, wheelbase, radius, step, TURN, UNSCALED, STILL], scalar)
        self._scaled = dynamics.friction_scaled

    def transition(self, points: Array, inputs: Array) -> Array:
        """See `PointModel`."""
        out = np.empty_like(points)
        _transition(points, inputs, *self._arrays, self._constants, self._scaled, BLOCK, out)
        return out

    def observation(self, points: Array, inputs: Array) -> Array:
        """See `PointModel`."""
        out = np.empty((*points.shape[:2], 4), points.dtype)
        _observation(points, inputs, *self._arrays, self._constants, self._scaled, BLOCK, out)
        return out

    def transition_adjoint(self, points: Array, inputs: Array, upstream: Array, gradients: Sequence[Array]) -> Array:
        """See `PointModel`."""
        return self._adjoint(_transition_adjoint, points, inputs, upstream, gradients)

    def observation_adjoint(self, points: Array, inputs: Array, upstream: Array, gradients: Sequence[Array]) -> Array:
        """See `PointModel`."""
        return self._adjoint(_observation_adjoint, points, inputs, upstream, gradients)

    def _adjoint(self, adjoint: Any, points: Array, inputs: Array, upstream: Array, gradients: Sequence[Array]) -> Array:
        out = np.empty_like(points)
        own = gradients if self._learning else self._arrays  # never written to without learning
        adjoint(points, inputs, *self._arrays, self._constants, self._scaled, BLOCK, upstream, out, self._learning, *own)
        return out


@compiled
def _columns(points, inputs, first, end, x, u):  # type: ignore[no-untyped-def]
    """Points of some sequences side by side; rows of u are steering angle, its sine and cosine, and current."""
    count, n = points.shape[1:]
    for b in range(first, end):
        sine, cosine = math.sin(inputs[b, 0]), math.cos(inputs[b, 0])
        for s in range(count):
            p = (b - first) * count + s
            for i in range(n):
                x[i, p] = points[b, s, i]
            u[0, p], u[1, p], u[2, p], u[3, p] = inputs[b, 0], sine, cosine, inputs[b, 1]


@compiled
def _layer(weight, offset, below, above):  # type: ignore[no-untyped-def]
    np.dot(weight, below, above)
    for i in range(above.shape[0]):
        row = above[i]
        value = offset[i]
        for p in range(row.shape[0]):
            row[p] += value


@compiled
def _squash(rows):  # type: ignore[no-untyped-def]
    for i in range(rows.shape[0]):
        row = rows[i]
        for p in range(row.shape[0]):
            row[p] = sigmoid(row[p])


@compiled
def _motion(x, u, W1, b1, W2, b2, W3, b3, theta, constants, scaled, f, h1, h2, o, forces, out):  # type: ignore[no-untyped-def]
    """Rows of ``out`` are ax, ay, dr/dt, dω/dt; everything else is kept for the adjoint."""
    mass, wheelbase, radius, _, turn, unscaled, still = constants
    lr, inertia, drag0, drag1, drag2, powertrain, torque, viscous, coulomb = theta
    lf = wheelbase - lr
    points = x.shape[1]
    for i in range(5):
        f[i] = x[i]
    f[5] = u[0]
    for p in range(points):
        along = x[0, p] + still
        f[6, p] = math.atan((x[1, p] + lf * x[2, p]) / along) - u[0, p]
        f[7, p] = math.atan((x[1, p] - lr * x[2, p]) / along)
        f[8, p] = (x[3, p] - x[0, p]) / along
    if not scaled:
        f[9] = u[3]
    _layer(W1, b1, f, h1)
    _squash(h1)
    _layer(W2, b2, h1, h2)
    _squash(h2)
    _layer(W3, b3, h2, o)
    if scaled:
        for k in range(2):
            for p in range(points):
                forces[k, p] = x[4, p] * o[k, p]
                value = o[2 + k, p]
                forces[4 + k, p] = tanh(turn * f[7 - k, p])
                forces[2 + k, p] = -x[4, p] * (max(value, value * 0) + math.log1p(math.exp(-abs(value))))
                forces[2 + k, p] *= forces[4 + k, p]
    else:
        for k in range(4):
            for p in range(points):
                forces[k, p] = unscaled * o[k, p]
    for p in range(points):
        vx, rim = x[0, p], x[3, p]
        sine, cosine, current = u[1, p], u[2, p], u[3, p]
        rear_x, front_x, rear_y, front_y = forces[0, p], forces[1, p], forces[2, p], forces[3, p]
        sideways = front_x * sine + front_y * cosine
        drag = drag0 * np.sign(vx) + drag1 * vx + drag2 * vx * vx
        out[0, p] = (rear_x + front_x * cosine - front_y * sine - drag) / mass
        out[1, p] = (sideways + rear_y) / mass
        out[2, p] = (sideways * lf - rear_y * lr) / inertia
        out[3, p] = radius / powertrain * (torque * current - radius * (front_x + rear_x) - viscous * rim - coulomb * np.sign(rim))


@compiled
def _motion_adjoint(  # type: ignore[no-untyped-def]
    x, u, W1, W2, W3, theta, constants, scaled, f, h1, h2, o, forces, out, out_bar, x_bar, learning, dW1, db1, dW2, db2, dW3, db3, dtheta
):
    """Adds to ``x_bar`` and, when learning, to the gradients of parameters."""
    mass, wheelbase, radius, _, turn, unscaled, still = constants
    lr, inertia, _, drag1, drag2, powertrain, _, viscous, _ = theta
    lf = wheelbase - lr
    points = x.shape[1]
    zero = x[0, 0] * 0
    o_bar, f_bar = np.empty_like(o), np.empty_like(f)
    slope = np.empty_like(forces)
    d_lf, d_lr, d_inertia, d_drag0, d_drag1, d_drag2 = zero, zero, zero, zero, zero, zero
    d_powertrain, d_torque, d_viscous, d_coulomb = zero, zero, zero, zero
    for p in range(points):
        vx, rim = x[0, p], x[3, p]
        sine, cosine, current = u[1, p], u[2, p], u[3, p]
        front_x, rear_y, front_y = forces[1, p], forces[2, p], forces[3, p]
        ax, ay, turning, spinning = out_bar[0, p] / mass, out_bar[1, p] / mass, out_bar[2, p] / inertia, out_bar[3, p]
        twisting = spinning * radius / powertrain
        along, across = ax * cosine + ay * sine + turning * sine * lf, ay * cosine - ax * sine + turning * cosine * lf
        slope[0, p] = ax - radius * twisting
        slope[1, p] = along - radius * twisting
        slope[2, p] = ay - turning * lr
        slope[3, p] = across
        x_bar[0, p] -= ax * (drag1 + 2 * drag2 * vx)
        x_bar[3, p] -= viscous * twisting
        d_lf += turning * (front_x * sine + front_y * cosine)
        d_lr -= turning * rear_y
        d_inertia -= turning * out[2, p]
        d_drag0 -= ax * np.sign(vx)
        d_drag1 -= ax * vx
        d_drag2 -= ax * vx * vx
        d_powertrain -= spinning * out[3, p]
        d_torque += twisting * current
        d_viscous -= twisting * rim
        d_coulomb -= twisting * np.sign(rim)
    if scaled:
        for k in range(2):
            for p in range(points):
                o_bar[k, p] = slope[k, p] * x[4, p]
                direction = forces[4 + k, p]
                value = o[2 + k, p]
                size = max(value, value * 0) + math.log1p(math.exp(-abs(value)))
                through = -slope[2 + k, p] * x[4, p]
                o_bar[2 + k, p] = through * direction * sigmoid(value)
                slope[4 + k, p] = through * size * turn * (1 - direction * direction)
                x_bar[4, p] += slope[k, p] * o[k, p] - slope[2 + k, p] * size * direction
    else:
        for k in range(4):
            for p in range(points):
                o_bar[k, p] = unscaled * slope[k, p]
                slope[4 + k // 2, p] = 0
    h2_bar, h1_bar = np.empty_like(h2), np.empty_like(h1)
    np.dot(W3.T, o_bar, h2_bar)
    for i in range(h2.shape[0]):
        for p in range(points):
            h2_bar[i, p] *= h2[i, p] * (1 - h2[i, p])
    np.dot(W2.T, h2_bar, h1_bar)
    for i in range(h1.shape[0]):
        for p in range(points):
            h1_bar[i, p] *= h1[i, p] * (1 - h1[i, p])
    np.dot(W1.T, h1_bar, f_bar)
    if learning:
        _add_layer(o_bar, h2, dW3, db3)
        _add_layer(h2_bar, h1, dW2, db2)
        _add_layer(h1_bar, f, dW1, db1)
    for i in range(5):
        for p in range(points):
            x_bar[i, p] += f_bar[i, p]
    for p in range(points):
        vx, vy, yaw_rate, rim = x[0, p], x[1, p], x[2, p], x[3, p]
        along = vx + still
        front, rear = (vy + lf * yaw_rate) / along, (vy - lr * yaw_rate) / along
        front_bar = (f_bar[6, p] + (slope[5, p] if scaled else zero)) / (1 + front * front) / along
        rear_bar = (f_bar[7, p] + (slope[4, p] if scaled else zero)) / (1 + rear * rear) / along
        ratio_bar = f_bar[8, p] / along
        x_bar[0, p] -= front_bar * front + rear_bar * rear + ratio_bar * ((rim - vx) / along + 1)
        x_bar[1, p] += front_bar + rear_bar
        x_bar[2, p] += front_bar * lf - rear_bar * lr
        x_bar[3, p] += ratio_bar
        d_lf += front_bar * yaw_rate
        d_lr -= rear_bar * yaw_rate
    if learning:
        dtheta[0] += d_lr - d_lf
        dtheta[1] += d_inertia
        dtheta[2] += d_drag0
        dtheta[3] += d_drag1
        dtheta[4] += d_drag2
        dtheta[5] += d_powertrain / powertrain
        dtheta[6] += d_torque
        dtheta[7] += d_viscous
        dtheta[8] += d_coulomb


@compiled
def _add_layer(above_bar, below, dW, db):  # type: ignore[no-untyped-def]
    product = np.empty_like(dW)
    np.dot(above_bar, below.T, product)
    for i in range(dW.shape[0]):
        for j in range(dW.shape[1]):
            dW[i, j] += product[i, j]
        total = db[i] * 0
        for p in range(above_bar.shape[1]):
            total += above_bar[i, p]
        db[i] += total


@compiled
def _rates(x, motion, rates):  # type: ignore[no-untyped-def]
    for p in range(x.shape[1]):
        rates[0, p] = motion[0, p] + x[1, p] * x[2, p]
        rates[1, p] = motion[1, p] - x[0, p] * x[2, p]
        rates[2, p] = motion[2, p]
        rates[3, p] = motion[3, p]
        rates[4, p] = 0


@compiled
def _block_of(sequences, count, block):  # type: ignore[no-untyped-def]
    """Sequences in a block, so that blocks are about equal."""
    most = max(block // count, 1)
    pieces = (sequences + most - 1) // most
    return (sequences + pieces - 1) // pieces


@compiled
def _stages(x0, u, W1, b1, W2, b2, W3, b3, theta, constants, scaled, x, f, h1, h2, o, forces, motion, rates):  # type: ignore[no-untyped-def]
    """The four stages of the Runge-Kutta method."""
    step = constants[3]
    for stage in range(4):
        if stage == 0:
            x[0] = x0
        else:
            share = step if stage == 3 else step / 2
            for i in range(5):
                for p in range(x0.shape[1]):
                    x[stage, i, p] = x0[i, p] + share * rates[stage - 1, i, p]
        at = stage
        _motion(x[at], u, W1, b1, W2, b2, W3, b3, theta, constants, scaled, f[at], h1[at], h2[at], o[at], forces[at], motion[at])
        _rates(x[at], motion[at], rates[at])


@compiled
def _transition(points, inputs, W1, b1, W2, b2, W3, b3, theta, constants, scaled, block, out):  # type: ignore[no-untyped-def]
    sequences, count, n = points.shape
    step = constants[3]
    size = _block_of(sequences, count, block)
    for first in range(0, sequences, size):
        end = min(first + size, sequences)
        x0, u, x, f, h1, h2, o, forces, motion, rates = _workspace(points, end - first, W1, W2)
        _columns(points, inputs, first, end, x0, u)
        _stages(x0, u, W1, b1, W2, b2, W3, b3, theta, constants, scaled, x, f, h1, h2, o, forces, motion, rates)
        for b in range(first, end):
            for s in range(count):
                p = (b - first) * count + s
                for i in range(n):
                    moved = rates[0, i, p] + 2 * rates[1, i, p] + 2 * rates[2, i, p] + rates[3, i, p]
                    out[b, s, i] = points[b, s, i] + step / 6 * moved


@compiled
def _observation(points, inputs, W1, b1, W2, b2, W3, b3, theta, constants, scaled, block, out):  # type: ignore[no-untyped-def]
    sequences, count, _ = points.shape
    size = _block_of(sequences, count, block)
    for first in range(0, sequences, size):
        end = min(first + size, sequences)
        x, u, _, f, h1, h2, o, forces, motion, _ = _workspace(points, end - first, W1, W2)
        _columns(points, inputs, first, end, x, u)
        _motion(x, u, W1, b1, W2, b2, W3, b3, theta, constants, scaled, f[0], h1[0], h2[0], o[0], forces[0], motion[0])
        for b in range(first, end):
            for s in range(count):
                p = (b - first) * count + s
                out[b, s, 0], out[b, s, 1] = motion[0, 0, p], motion[0, 1, p]
                out[b, s, 2], out[b, s, 3] = x[2, p], x[3, p]


@compiled
def _transition_adjoint(  # type: ignore[no-untyped-def]
    points,
    inputs,
    W1,
    b1,
    W2,
    b2,
    W3,
    b3,
    theta,
    constants,
    scaled,
    block,
    upstream,
    out,
    learning,
    dW1,
    db1,
    dW2,
    db2,
    dW3,
    db3,
    dtheta,
):
    sequences, count, n = points.shape
    step = constants[3]
    size = _block_of(sequences, count, block)
    for first in range(0, sequences, size):
        end = min(first + size, sequences)
        x0, u, x, f, h1, h2, o, forces, motion, rates = _workspace(points, end - first, W1, W2)
        _columns(points, inputs, first, end, x0, u)
        _stages(x0, u, W1, b1, W2, b2, W3, b3, theta, constants, scaled, x, f, h1, h2, o, forces, motion, rates)
        total, stage_bar, motion_bar = np.empty_like(x0), np.zeros_like(x0), np.empty_like(motion[0])
        rates_bar, up = np.empty_like(x0), np.empty_like(x0)
        for b in range(first, end):
            for s in range(count):
                for i in range(n):
                    up[i, (b - first) * count + s] = upstream[b, s, i]
        total[:] = up
        for k in range(4):
            at = 3 - k
            own = step / 3 if at in (1, 2) else step / 6
            later = step if at == 2 else step / 2
            for i in range(4):
                for p in range(x0.shape[1]):
                    rates_bar[i, p] = own * up[i, p] + (later * stage_bar[i, p] if at < 3 else 0)
                    motion_bar[i, p] = rates_bar[i, p]
            for p in range(x0.shape[1]):
                stage_bar[0, p] = -rates_bar[1, p] * x[at, 2, p]
                stage_bar[1, p] = rates_bar[0, p] * x[at, 2, p]
                stage_bar[2, p] = rates_bar[0, p] * x[at, 1, p] - rates_bar[1, p] * x[at, 0, p]
                stage_bar[3, p] = 0
                stage_bar[4, p] = 0
            _motion_adjoint(
                x[at],
                u,
                W1,
                W2,
                W3,
                theta,
                constants,
                scaled,
                f[at],
                h1[at],
                h2[at],
                o[at],
                forces[at],
                motion[at],
                motion_bar,
                stage_bar,
                learning,
                dW1,
                db1,
                dW2,
                db2,
                dW3,
                db3,
                dtheta,
            )
            for i in range(5):
                for p in range(x0.shape[1]):
                    total[i, p] += stage_bar[i, p]
        for b in range(first, end):
            for s in range(count):
                for i in range(n):
                    out[b, s, i] = total[i, (b - first) * count + s]


@compiled
def _observation_adjoint(  # type: ignore[no-untyped-def]
    points,
    inputs,
    W1,
    b1,
    W2,
    b2,
    W3,
    b3,
    theta,
    constants,
    scaled,
    block,
    upstream,
    out,
    learning,
    dW1,
    db1,
    dW2,
    db2,
    dW3,
    db3,
    dtheta,
):
    sequences, count, n = points.shape
    size = _block_of(sequences, count, block)
    for first in range(0, sequences, size):
        end = min(first + size, sequences)
        x, u, _, f, h1, h2, o, forces, motion, _ = _workspace(points, end - first, W1, W2)
        _columns(points, inputs, first, end, x, u)
        _motion(x, u, W1, b1, W2, b2, W3, b3, theta, constants, scaled, f[0], h1[0], h2[0], o[0], forces[0], motion[0])
        motion_bar, x_bar = np.zeros_like(motion[0]), np.zeros_like(x)
        for b in range(first, end):
            for s in range(count):
                p = (b - first) * count + s
                motion_bar[0, p], motion_bar[1, p] = upstream[b, s, 0], upstream[b, s, 1]
                x_bar[2, p], x_bar[3, p] = upstream[b, s, 2], upstream[b, s, 3]
        _motion_adjoint(
            x,
            u,
            W1,
            W2,
            W3,
            theta,
            constants,
            scaled,
            f[0],
            h1[0],
            h2[0],
            o[0],
            forces[0],
            motion[0],
            motion_bar,
            x_bar,
            learning,
            dW1,
            db1,
            dW2,
            db2,
            dW3,
            db3,
            dtheta,
        )
        for b in range(first, end):
            for s in range(count):
                for i in range(n):
                    out[b, s, i] = x_bar[i, (b - first) * count + s]


@compiled
def _workspace(points, sequences, W1, W2):  # type: ignore[no-untyped-def]
    """Room for four stages of a block."""
    columns = sequences * points.shape[1]
    x0, u = np.empty((5, columns), points.dtype), np.empty((4, columns), points.dtype)
    x, f = np.empty((4, 5, columns), points.dtype), np.empty((4, W1.shape[1], columns), points.dtype)
    h1, h2 = np.empty((4, W1.shape[0], columns), points.dtype), np.empty((4, W2.shape[0], columns), points.dtype)
    o, forces = np.empty((4, 4, columns), points.dtype), np.empty((4, 6, columns), points.dtype)
    return x0, u, x, f, h1, h2, o, forces, np.empty((4, 4, columns), points.dtype), np.empty((4, 5, columns), points.dtype)
