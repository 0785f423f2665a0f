"""Sigma points through the planar cars of `vehicle.dynamics`, compiled, with the adjoint.

    points (S, n, B) --_gather_points--> columns --_stages: _motion, _rates--> x⁺
    --_scatter_points--> points

Equations: see `vehest.vehicle.dynamics` (cars, network) and `vehest.vehicle.planar` (chassis), the
readable definitions in torch. A step is x⁺ = x + Δt/6 (k₁ + 2 k₂ + 2 k₃ + k₄). Its adjoint computes
the stages again and passes x̄⁺ through them from the last to the first: k̄₄ = Δt/6 x̄⁺, k̄₃ = Δt/3
x̄⁺ + Δt J₄ᵀ k̄₄ and so on, x̄ = x̄⁺ + Σ J_iᵀ k̄_i, with J_i the Jacobian of the rates at stage i.

Order of sums: sums may be reordered (``fastmath``); gradients of parameters are added over points
in order, stage by stage.

Points lie side by side in columns, so that what is computed of each runs along rows; columns are as
many as fill whole vectors, and those beyond the points repeat the last one and have no gradient. A
network receives a point a row, its units side by side: its matrix products are as fast for a few
points as for many. The adjoint computes stages again instead of storing them. Blocks of sequences
are small enough for a core's own cache; matrix products stay on their thread.

In the compiled code ``car`` is (layers, theta, constants, kind): weights and offsets of the three
layers, then their weights transposed; learnt numbers in the order of `LEARNT` and `PACEJKA`; fixed
ones; and which car. ``room`` is what a motion saves for its adjoint (`_room`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import torch

from vehest.constants import GRAVITY
from vehest.estimators.kernels.activation import arctan, sigmoid, softplus, tanh
from vehest.estimators.kernels.blas import single_blas_thread
from vehest.estimators.kernels.compiling import entry, part
from vehest.filters.unscented_scan import Array, PointModel
from vehest.lanes import width
from vehest.vehicle.dynamics import (
    TURN,
    UNSCALED,
    Dynamics,
    NeuralCar,
    PacejkaCar,
    Perceptron,
    ResidualCar,
    TyreNetworkCar,
    physical_of,
)
from vehest.vehicle.tyres import SLIP_SPEED_OFFSET

BLOCK = 110  # largest number of sigma points that are computed together
# numbers of the kinds of cars, see `_kind_of`
FRICTION_SCALED, UNSCALED_FORCES, PACEJKA_FORCES, PACEJKA_AND_RATES, RATES = range(5)

# options of numba for these functions
_FAST = {"nogil": True, "fastmath": {"reassoc", "contract", "arcp", "nsz", "afn"}}
compiled = entry(**_FAST)  # decorator of functions that Python calls
piece = part(**_FAST)  # decorator of functions that only compiled ones call


@piece
def copy_rows(rows, out):
    """Copy ``rows`` into the first rows of ``out``.

    An assignment would take longer to compile: it checks shapes and words a message.
    """
    for i in range(rows.shape[0]):
        for p in range(rows.shape[1]):
            out[i, p] = rows[i, p]


class CompiledPlanarCar(PointModel):
    """A planar car for the unscented filter.

    Parameters
    ----------
    dynamics : Dynamics
        The car, one that `is_compilable`; gradients go to its parameters where they are wanted.
    step : float
        Time step [s].
    lower : Sequence[float] | None
        Smallest possible value of each state.
    dtype : torch.dtype
        Precision of the arrays.
    """

    is_compiled = True

    def __init__(
        self, dynamics: Dynamics, step: float, lower: Sequence[float] | None, dtype: torch.dtype
    ) -> None:
        network = getattr(dynamics, "network", None)
        if isinstance(network, Perceptron):
            (W1, b1), (W2, b2), (W3, b3) = network.layers()
            layers = [W1.mT, b1, W2.mT, b2, W3, b3]  # as their gradients are fastest
        else:
            layers = [torch.zeros(0, 0), torch.zeros(0)] * 3
        learnt, fixed = physical_of(dynamics)
        tensors = [tensor.to(dtype) for tensor in (*layers, learnt)]
        arrays = [tensor.detach().contiguous().numpy() for tensor in tensors]
        learning = any(tensor.requires_grad for tensor in tensors)
        self.parameters = tensors if learning else ()
        self.lower = lower
        scalar = arrays[0].dtype.type
        flat = 4.0 * np.finfo(scalar).eps
        numbers = [*fixed, step, TURN, UNSCALED, SLIP_SPEED_OFFSET, flat, GRAVITY]
        matrices = tuple(np.ascontiguousarray(arrays[place].T) for place in (0, 2, 4))
        self.car = (
            (*arrays[:6], *matrices),
            arrays[6],
            np.array(numbers, scalar),
            _kind_of(dynamics),
        )
        self.entries = (_transition, _observation, _transition_adjoint, _observation_adjoint)

    def working(self) -> AbstractContextManager[object]:
        """Context in which matrix products stay on their thread."""
        return single_blas_thread()

    def learnt(self, gradients: Sequence[Array]) -> tuple[Any, ...]:
        """Arrays for the gradients by the parameters, and whether they are required; if not, they
        are placeholders that are never written.
        """
        learning = bool(self.parameters)
        return (*(gradients if learning else (*self.car[0][:6], self.car[1])), learning)


def is_compilable(dynamics: Dynamics) -> bool:
    """Whether there is compiled code for a car's dynamics."""
    return _kind_of(dynamics) is not None


def _kind_of(dynamics: Dynamics) -> int | None:
    """Number of a car's compiled code; None where there is none.

    None are networks without exactly two hidden layers, curves with E terms, and other classes.
    """
    network = getattr(dynamics, "network", None)
    if isinstance(network, Perceptron) and len(network) != 5:
        return None
    if isinstance(dynamics, TyreNetworkCar):
        return FRICTION_SCALED if dynamics.friction_scaled else UNSCALED_FORCES
    if isinstance(dynamics, PacejkaCar):
        if dynamics.tyres.curvature is not None:
            return None
        return PACEJKA_AND_RATES if isinstance(dynamics, ResidualCar) else PACEJKA_FORCES
    return RATES if isinstance(dynamics, NeuralCar) else None


@piece
def _columns(points, first, end, padding, x):
    """Write the points of the sequences ``first`` to ``end`` side by side into the columns of
    ``x``.

    Columns beyond them are ``padding`` times the last one.
    """
    count, n = points.shape[:2]
    for b in range(first, end):
        for s in range(count):
            for i in range(n):
                x[i, (b - first) * count + s] = points[s, i, b]
    last = (end - first) * count - 1
    for i in range(n):
        for p in range(last + 1, x.shape[1]):
            x[i, p] = padding * x[i, last]


@piece
def _driven(inputs, first, end, count, u):
    """Write the inputs of the columns of `_columns`; rows of u are steering angle, its sine and
    cosine, and motor current.
    """
    for b in range(first, end):
        sine = math.sin(inputs[0, b])
        cosine = math.cos(inputs[0, b])
        for p in range((b - first) * count, (b + 1 - first) * count if b + 1 < end else u.shape[1]):
            u[0, p] = inputs[0, b]
            u[1, p] = sine
            u[2, p] = cosine
            u[3, p] = inputs[1, b]


@piece
def _scatter_points(rows, points, first, end):
    """Write rows back into the points of the sequences ``first`` to ``end``."""
    count = points.shape[0]
    for b in range(first, end):
        for s in range(count):
            for i in range(points.shape[1]):
                points[s, i, b] = rows[i, (b - first) * count + s]


@piece
def _hidden(below, transposed, offset, above):
    """A hidden layer: above = σ(below Wᵀ + offset)."""
    np.dot(below, transposed, above)
    for p in range(above.shape[0]):
        for i in range(above.shape[1]):
            above[p, i] = sigmoid(above[p, i] + offset[i])


@piece
def _rise(above, below, flat, nothing):
    """Slope of a logistic function, as the product of its distances from both ends, ``above`` and
    ``below``; ``nothing`` where it has reached an end but for rounding.

    At a crawl slips change by a million per m/s, and rounding would count.
    """
    return above * below if min(above, below) > flat else nothing


@piece
def _network(layers, f, h1, h2, o):
    """Outputs o (4, P) of the network for features f (P, F); columns beyond the points are zero."""
    T1, b1, T2, b2, _, b3, _, _, T3 = layers
    _hidden(f, T1, b1, h1)
    _hidden(h1, T2, b2, h2)
    out = np.empty((f.shape[0], 4), f.dtype)
    np.dot(h2, T3, out)
    for k in range(4):
        for p in range(f.shape[0]):
            o[k, p] = out[p, k] + b3[k]
        for p in range(f.shape[0], o.shape[1]):
            o[k, p] = 0


@piece
def _network_adjoint(layers, flat, f, h1, h2, o_bar, f_bar, learning, gradients):
    """Adjoint of `_network`: writes ``f_bar``, and adds to the gradients when learning.

    ``o_bar`` is (4, P) and ``f_bar`` (P, F). ō W₃ -> h̄₂, times σ', W₂ -> h̄₁, times σ', W₁ -> f̄;
    gradients of weights are products of a layer's values and the gradients above it.
    """
    _, _, _, _, W3, _, W1, W2, _ = layers
    h2_bar = np.empty_like(h2)
    h1_bar = np.empty_like(h1)
    out_bar = np.empty((f.shape[0], 4), f.dtype)
    for p in range(f.shape[0]):
        for k in range(4):
            out_bar[p, k] = o_bar[k, p]
    np.dot(out_bar, W3, h2_bar)
    _through_hidden(h2, flat, h2_bar)
    np.dot(h2_bar, W2, h1_bar)
    _through_hidden(h1, flat, h1_bar)
    np.dot(h1_bar, W1, f_bar)
    if learning:
        dT1, db1, dT2, db2, dW3, db3 = gradients[:6]
        _add_product(out_bar, h2, dW3)
        _add_product(h1, h2_bar, dT2)
        _add_product(f, h1_bar, dT1)
        _add_rows(out_bar, db3)
        _add_rows(h2_bar, db2)
        _add_rows(h1_bar, db1)


@piece
def _through_hidden(rows, flat, rows_bar):
    """Multiply gradients of a hidden layer by its slope σ (1 - σ), in place."""
    unity = rows.dtype.type(1)
    nothing = rows.dtype.type(0)
    for p in range(rows.shape[0]):
        for i in range(rows.shape[1]):
            rows_bar[p, i] *= _rise(rows[p, i], unity - rows[p, i], flat, nothing)


@piece
def _add_product(first, second, out):
    """out += firstᵀ second."""
    product = np.empty_like(out)
    np.dot(first.T, second, product)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] += product[i, j]


@piece
def _add_rows(rows, out):
    """out += sum of the rows."""
    for p in range(rows.shape[0]):
        for i in range(rows.shape[1]):
            out[i] += rows[p, i]


@piece
def _slips_and_features(x, u, car, f, slips):
    """Write slips (front, rear, ratio), and the features that the network receives."""
    _, theta, constants, kind = car
    lr = theta[0]
    speed_offset = constants[6]
    lf = constants[1] - lr
    for p in range(x.shape[1]):
        vx_safe = x[0, p] + speed_offset
        slips[0, p] = arctan((x[1, p] + lf * x[2, p]) / vx_safe) - u[0, p]
        slips[1, p] = arctan((x[1, p] - lr * x[2, p]) / vx_safe)
        slips[2, p] = (x[3, p] - x[0, p]) / vx_safe
    if kind in (FRICTION_SCALED, UNSCALED_FORCES):
        for p in range(f.shape[0]):
            for i in range(5):
                f[p, i] = x[i, p]
            f[p, 5] = u[0, p]
            for i in range(3):
                f[p, 6 + i] = slips[i, p]
            if kind == UNSCALED_FORCES:
                f[p, 9] = u[3, p]
    elif kind in (PACEJKA_AND_RATES, RATES):
        for p in range(f.shape[0]):
            for i in range(4):
                f[p, i] = x[i, p]
            f[p, 4] = u[0, p]
            f[p, 5] = u[3, p]


@piece
def _curve(slip, stiffness, shape, unity):
    """Pacejka's curve for a peak of 1, and its slopes along slip, stiffness and shape."""
    angle = arctan(stiffness * slip)
    slope = math.cos(shape * angle)
    steep = slope * shape / (unity + stiffness * slip * stiffness * slip)
    return math.sin(shape * angle), steep * stiffness, steep * slip, slope * angle


@piece
def _loads(theta, constants):
    """Weight over wheelbase [N/m], and static loads of front and rear axle [N]."""
    weight = constants[0] * constants[8] / constants[1]
    return weight, weight * theta[0], weight * (constants[1] - theta[0])


@piece
def _forces(x, car, slips, o, forces):
    """Write the axle forces [N], in the rows rear x, front x, rear y, front y, and behind them what
    else the adjoint needs.
    """
    _, theta, constants, kind = car
    points = x.shape[1]
    turn = constants[4]
    unscaled = constants[5]
    unity = theta.dtype.type(1)
    if kind == FRICTION_SCALED:
        for k in range(2):
            for p in range(points):
                forces[k, p] = x[4, p] * o[k, p]
                forces[4 + k, p] = tanh(turn * slips[1 - k, p])
                forces[2 + k, p] = -x[4, p] * softplus(o[2 + k, p]) * forces[4 + k, p]
    elif kind == UNSCALED_FORCES:
        for k in range(4):
            for p in range(points):
                forces[k, p] = unscaled * o[k, p]
    else:
        _, front_load, rear_load = _loads(theta, constants)
        friction, Bx, Cx, Dx, Bf, Cf, Df, Br, Cr, Dr = theta[9:]
        for p in range(points):
            vx_safe = friction * Dx * _curve(slips[2, p], Bx, Cx, unity)[0]
            forces[0, p] = rear_load * vx_safe
            forces[1, p] = front_load * vx_safe
            forces[2, p] = -friction * Dr * rear_load * _curve(slips[1, p], Br, Cr, unity)[0]
            forces[3, p] = -friction * Df * front_load * _curve(slips[0, p], Bf, Cf, unity)[0]


@piece
def _forces_adjoint(x, car, slips, o, forces, slope, o_bar, slips_bar, x_bar, learning, dtheta):
    """Adjoint of `_forces`: writes ``o_bar`` and ``slips_bar`` from the gradients of the forces
    (rows of ``slope``), and adds to ``x_bar`` and, when learning, ``dtheta``.
    """
    _, theta, constants, kind = car
    points = x.shape[1]
    turn = constants[4]
    unscaled = constants[5]
    flat = constants[7]
    unity = theta.dtype.type(1)
    nothing = theta.dtype.type(0)
    slips_bar[:] = 0
    if kind == FRICTION_SCALED:
        for k in range(2):
            for p in range(points):
                o_bar[k, p] = slope[k, p] * x[4, p]
                direction = forces[4 + k, p]
                value = o[2 + k, p]
                size = softplus(value)
                through = -slope[2 + k, p] * x[4, p]
                o_bar[2 + k, p] = through * direction * sigmoid(value)
                slips_bar[1 - k, p] = (
                    through
                    * size
                    * turn
                    * _rise(unity - direction, unity + direction, flat, nothing)
                )
                x_bar[4, p] += slope[k, p] * o[k, p] - slope[2 + k, p] * size * direction
    elif kind == UNSCALED_FORCES:
        for k in range(4):
            for p in range(points):
                o_bar[k, p] = unscaled * slope[k, p]
    else:
        weight, front_load, rear_load = _loads(theta, constants)
        friction, Bx, Cx, Dx, Bf, Cf, Df, Br, Cr, Dr = theta[9:]
        total = np.zeros_like(theta)
        for p in range(points):
            peak, rise, stiffer, rounder = _curve(slips[2, p], Bx, Cx, unity)
            up = slope[0, p] * rear_load + slope[1, p] * front_load
            slips_bar[2, p] = up * friction * Dx * rise
            total[0] += (slope[1, p] - slope[0, p]) * weight * friction * Dx * peak
            total[9] += up * Dx * peak
            total[10] += up * friction * Dx * stiffer
            total[11] += up * friction * Dx * rounder
            total[12] += up * friction * peak
            peak, rise, stiffer, rounder = _curve(slips[0, p], Bf, Cf, unity)
            up = -slope[3, p] * front_load
            slips_bar[0, p] = up * friction * Df * rise
            total[0] -= slope[3, p] * weight * friction * Df * peak
            total[9] += up * Df * peak
            total[13] += up * friction * Df * stiffer
            total[14] += up * friction * Df * rounder
            total[15] += up * friction * peak
            peak, rise, stiffer, rounder = _curve(slips[1, p], Br, Cr, unity)
            up = -slope[2, p] * rear_load
            slips_bar[1, p] = up * friction * Dr * rise
            total[0] += slope[2, p] * weight * friction * Dr * peak
            total[9] += up * Dr * peak
            total[16] += up * friction * Dr * stiffer
            total[17] += up * friction * Dr * rounder
            total[18] += up * friction * peak
        if learning:
            for i in range(theta.shape[0]):
                dtheta[i] += total[i]


@piece
def _chassis(x, u, car, forces, out):
    """Write the accelerations of the chassis; rows of ``out`` are ax, ay [m/s²], dr/dt [rad/s²] and
    the rate of the rim speed.
    """
    _, theta, constants, _ = car
    mass, wheelbase, radius = constants[:3]
    lr, inertia, drag0, drag1, drag2, powertrain, torque, viscous, coulomb = theta[:9]
    lf = wheelbase - lr
    for p in range(x.shape[1]):
        vx = x[0, p]
        rim = x[3, p]
        sine = u[1, p]
        cosine = u[2, p]
        current = u[3, p]
        rear_x = forces[0, p]
        front_x = forces[1, p]
        rear_y = forces[2, p]
        front_y = forces[3, p]
        sideways = front_x * sine + front_y * cosine
        drag = drag0 * np.sign(vx) + drag1 * vx + drag2 * vx * vx
        out[0, p] = (rear_x + front_x * cosine - front_y * sine - drag) / mass
        out[1, p] = (sideways + rear_y) / mass
        out[2, p] = (sideways * lf - rear_y * lr) / inertia
        out[3, p] = (
            radius
            / powertrain
            * (
                torque * current
                - radius * (front_x + rear_x)
                - viscous * rim
                - coulomb * np.sign(rim)
            )
        )


@piece
def _chassis_adjoint(x, u, car, forces, out, out_bar, slope, x_bar, learning, dtheta):
    """Adjoint of `_chassis`: writes the gradients of the forces, rows of ``slope``, and adds to
    ``x_bar`` and, when learning, ``dtheta``. ``out`` is what `_chassis` wrote.
    """
    _, theta, constants, _ = car
    mass, wheelbase, radius = constants[:3]
    lr, inertia, _, drag1, drag2, powertrain, _, viscous, _ = theta[:9]
    lf = wheelbase - lr
    zero = x.dtype.type(0)
    two = x.dtype.type(2)
    d_lf = zero
    d_lr = zero
    d_inertia = zero
    d_drag0 = zero
    d_drag1 = zero
    d_drag2 = zero
    d_powertrain = zero
    d_torque = zero
    d_viscous = zero
    d_coulomb = zero
    for p in range(x.shape[1]):
        vx = x[0, p]
        rim = x[3, p]
        sine = u[1, p]
        cosine = u[2, p]
        current = u[3, p]
        front_x = forces[1, p]
        rear_y = forces[2, p]
        front_y = forces[3, p]
        ax = out_bar[0, p] / mass
        ay = out_bar[1, p] / mass
        turning = out_bar[2, p] / inertia
        spinning = out_bar[3, p]
        twisting = spinning * radius / powertrain
        vx_safe = ax * cosine + ay * sine + turning * sine * lf
        across = ay * cosine - ax * sine + turning * cosine * lf
        slope[0, p] = ax - radius * twisting
        slope[1, p] = vx_safe - radius * twisting
        slope[2, p] = ay - turning * lr
        slope[3, p] = across
        x_bar[0, p] -= ax * (drag1 + two * drag2 * vx)
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


@piece
def _motion(x, u, car, room, out):
    """Compute a car's motion from its state; rows of ``out`` are as of `_chassis`. ``room`` saves
    everything else for the adjoint.
    """
    layers, _, _, kind = car
    f, slips, h1, h2, o, forces, plain = room
    _slips_and_features(x, u, car, f, slips)
    if kind != PACEJKA_FORCES:
        _network(layers, f, h1, h2, o)
    if kind == RATES:
        for p in range(x.shape[1]):
            out[0, p] = o[0, p] - x[1, p] * x[2, p]
            out[1, p] = o[1, p] + x[0, p] * x[2, p]
            out[2, p] = o[2, p]
            out[3, p] = o[3, p]
        return
    _forces(x, car, slips, o, forces)
    _chassis(x, u, car, forces, plain)
    copy_rows(plain, out)
    if kind == PACEJKA_AND_RATES:
        for i in range(4):
            for p in range(x.shape[1]):
                out[i, p] += o[i, p]


@piece
def _motion_adjoint(x, u, car, room, out_bar, x_bar, learning, gradients):
    """Adjoint of `_motion`: adds to ``x_bar`` and, when learning, to the gradients of
    parameters.
    """
    layers, theta, constants, kind = car
    f, slips, h1, h2, o, forces, plain = room
    points = x.shape[1]
    o_bar = np.empty_like(o)
    f_bar = np.zeros_like(f)
    slips_bar = np.zeros_like(slips)
    dtheta = gradients[6]
    if kind != RATES:
        slope = np.empty_like(o)
        _chassis_adjoint(x, u, car, forces, plain, out_bar, slope, x_bar, learning, dtheta)
        _forces_adjoint(x, car, slips, o, forces, slope, o_bar, slips_bar, x_bar, learning, dtheta)
    if kind in (PACEJKA_AND_RATES, RATES):
        for i in range(4):
            for p in range(points):
                o_bar[i, p] = out_bar[i, p]
    if kind != PACEJKA_FORCES:
        _network_adjoint(layers, constants[7], f, h1, h2, o_bar, f_bar, learning, gradients)
    if kind in (FRICTION_SCALED, UNSCALED_FORCES):
        for p in range(f.shape[0]):
            for i in range(5):
                x_bar[i, p] += f_bar[p, i]
            for i in range(3):
                slips_bar[i, p] += f_bar[p, 6 + i]
    elif kind in (PACEJKA_AND_RATES, RATES):
        for p in range(f.shape[0]):
            for i in range(4):
                x_bar[i, p] += f_bar[p, i]
    if kind == RATES:
        for p in range(points):
            x_bar[0, p] += out_bar[1, p] * x[2, p]
            x_bar[1, p] -= out_bar[0, p] * x[2, p]
            x_bar[2, p] += out_bar[1, p] * x[0, p] - out_bar[0, p] * x[1, p]
        return
    _slips_adjoint(x, theta[0], constants, slips_bar, x_bar, learning, dtheta)


@piece
def _slips_adjoint(x, lr, constants, slips_bar, x_bar, learning, dtheta):
    """Add the gradients of slips to those of the state and, when learning, of the distance of the
    rear axle.
    """
    lf = constants[1] - lr
    speed_offset = constants[6]
    unity = x.dtype.type(1)
    d_lf = x.dtype.type(0)
    d_lr = x.dtype.type(0)
    for p in range(x.shape[1]):
        vx = x[0, p]
        vy = x[1, p]
        yaw_rate = x[2, p]
        rim = x[3, p]
        vx_safe = vx + speed_offset
        front = (vy + lf * yaw_rate) / vx_safe
        rear = (vy - lr * yaw_rate) / vx_safe
        front_bar = slips_bar[0, p] / (unity + front * front) / vx_safe
        rear_bar = slips_bar[1, p] / (unity + rear * rear) / vx_safe
        ratio_bar = slips_bar[2, p] / vx_safe
        x_bar[0, p] -= (
            front_bar * front + rear_bar * rear + ratio_bar * ((rim - vx) / vx_safe + unity)
        )
        x_bar[1, p] += front_bar + rear_bar
        x_bar[2, p] += front_bar * lf - rear_bar * lr
        x_bar[3, p] += ratio_bar
        d_lf += front_bar * yaw_rate
        d_lr -= rear_bar * yaw_rate
    if learning:
        dtheta[0] += d_lr - d_lf


@piece
def _rates(x, motion, rates):
    """dx/dt from accelerations: dvx/dt = ax + vy r, dvy/dt = ay - vx r; friction stays."""
    for p in range(x.shape[1]):
        rates[0, p] = motion[0, p] + x[1, p] * x[2, p]
        rates[1, p] = motion[1, p] - x[0, p] * x[2, p]
        rates[2, p] = motion[2, p]
        rates[3, p] = motion[3, p]
        rates[4, p] = 0


@piece
def _block_of(sequences, count):
    """Number of sequences in a block of at most `BLOCK` points, so that blocks are about equal."""
    max_sequences = max(BLOCK // count, 1)
    pieces = (sequences + max_sequences - 1) // max_sequences
    return (sequences + pieces - 1) // pieces


@piece
def _gather_points(points, inputs, first, end):
    """Points of some sequences and their inputs, in as many columns as fill whole vectors.

    See `_columns` and `_driven`.
    """
    count, n, _ = points.shape
    lanes = width(points)
    columns = ((end - first) * count + lanes - 1) // lanes * lanes
    x = np.empty((n, columns), points.dtype)
    u = np.empty((4, columns), points.dtype)
    _columns(points, first, end, 1, x)
    _driven(inputs, first, end, count, u)
    return x, u


@piece
def _room(points, x, car):
    """Allocate what a motion saves for its adjoint: the network's features, slips, both hidden
    layers, the network's outputs, forces, and rates without what the network adds.
    """
    (T1, _, T2) = car[0][:3]
    columns = x.shape[1]
    dtype = x.dtype
    return (
        np.empty((points, T1.shape[0]), dtype),
        np.empty((3, columns), dtype),
        np.empty((points, T1.shape[1]), dtype),
        np.empty((points, T2.shape[1]), dtype),
        np.empty((4, columns), dtype),
        np.empty((6, columns), dtype),
        np.empty((4, columns), dtype),
    )


@piece
def _stages(x0, u, car, rooms):
    """Compute states and rates at the four stages of the Runge-Kutta method from the states x0."""
    step = car[2][3]
    half = x0.dtype.type(0.5)
    x = np.empty((4, *x0.shape), x0.dtype)
    rates = np.empty((4, *x0.shape), x0.dtype)
    motion = np.empty((4, x0.shape[1]), x0.dtype)
    for stage in range(4):
        if stage == 0:
            copy_rows(x0, x[0])
        else:
            share = step if stage == 3 else step * half
            for i in range(5):
                for p in range(x0.shape[1]):
                    x[stage, i, p] = x0[i, p] + share * rates[stage - 1, i, p]
        _motion(x[stage], u, car, rooms[stage], motion)
        _rates(x[stage], motion, rates[stage])
    return x, rates


@compiled
def _transition(points, inputs, car, out, start, stop):
    """Write states one step later at all points by the Runge-Kutta method, (S, 5, B).

    Parameters
    ----------
    points : array
        vx, vy [m/s], yaw rate [rad/s], rim speed [m/s], friction [1], (S, 5, B).
    inputs : array
        Steering angle [rad] and motor current [A], (2, B).
    car : tuple
        See the module.
    out : array
        (S, 5, B), written for the sequences from ``start`` to ``stop``.
    """
    count, n, _ = points.shape
    sixth = points.dtype.type(car[2][3] / 6)
    two = points.dtype.type(2)
    size = _block_of(stop - start, count)
    for first in range(start, stop, size):
        end = min(first + size, stop)
        x0, u = _gather_points(points, inputs, first, end)
        room = _room((end - first) * count, x0, car)
        _, rates = _stages(x0, u, car, (room, room, room, room))
        for i in range(n):
            for p in range(x0.shape[1]):
                x0[i, p] += sixth * (
                    rates[0, i, p] + two * rates[1, i, p] + two * rates[2, i, p] + rates[3, i, p]
                )
        _scatter_points(x0, out, first, end)


@compiled
def _observation(points, inputs, car, out, start, stop):
    """Write expected measurements at all points: ax, ay [m/s²], yaw rate, rim speed, (S, 4, B).

    Arguments as those of `_transition`.
    """
    count = points.shape[0]
    size = _block_of(stop - start, count)
    for first in range(start, stop, size):
        end = min(first + size, stop)
        x, u = _gather_points(points, inputs, first, end)
        expected = np.empty_like(u)
        _motion(x, u, car, _room((end - first) * count, x, car), expected)
        for p in range(x.shape[1]):
            expected[2, p] = x[2, p]
            expected[3, p] = x[3, p]
        _scatter_points(expected, out, first, end)


@compiled
def _transition_adjoint(points, inputs, car, upstream, out, gradients, start, stop):
    """Write gradients by the points, and add those by the parameters.

    The four stages are computed again, each with a room of its own. From the last to the first,
    k̄_i = w_i x̄⁺ + c_i J_{i+1}ᵀ k̄_{i+1} with w = Δt (1/6, 1/3, 1/3, 1/6) and c = Δt (1/2, 1/2, 1,
    -); x̄ = x̄⁺ + Σ J_iᵀ k̄_i. ``gradients`` are those of the layers and of theta, and whether they
    are wanted.
    """
    learning = gradients[7]
    count, n, _ = points.shape
    step = car[2][3]
    nothing = points.dtype.type(0)
    size = _block_of(stop - start, count)
    for first in range(start, stop, size):
        end = min(first + size, stop)
        x0, u = _gather_points(points, inputs, first, end)
        n_points = (end - first) * count
        columns = x0.shape[1]
        rooms = (
            _room(n_points, x0, car),
            _room(n_points, x0, car),
            _room(n_points, x0, car),
            _room(n_points, x0, car),
        )
        x, _ = _stages(x0, u, car, rooms)
        up = np.empty_like(x0)
        _columns(upstream, first, end, 0, up)
        total = up.copy()
        stage_bar = np.zeros_like(up)
        rates_bar = np.empty((4, columns), points.dtype)
        for k in range(4):
            at = 3 - k
            weight = points.dtype.type(step / 3 if at in (1, 2) else step / 6)
            later = points.dtype.type(step if at == 2 else step / 2)
            for i in range(4):
                for p in range(columns):
                    rates_bar[i, p] = weight * up[i, p] + (
                        later * stage_bar[i, p] if at < 3 else nothing
                    )
            for p in range(columns):
                stage_bar[0, p] = -rates_bar[1, p] * x[at, 2, p]
                stage_bar[1, p] = rates_bar[0, p] * x[at, 2, p]
                stage_bar[2, p] = rates_bar[0, p] * x[at, 1, p] - rates_bar[1, p] * x[at, 0, p]
                stage_bar[3, p] = 0
                stage_bar[4, p] = 0
            _motion_adjoint(x[at], u, car, rooms[at], rates_bar, stage_bar, learning, gradients)
            for i in range(n):
                for p in range(columns):
                    total[i, p] += stage_bar[i, p]
        _scatter_points(total, out, first, end)


@compiled
def _observation_adjoint(points, inputs, car, upstream, out, gradients, start, stop):
    """Write gradients by the points, and add those by the parameters, from those by the
    measurements.

    Yaw rate and rim speed pass to the state directly, accelerations through `_motion_adjoint`.
    """
    learning = gradients[7]
    count = points.shape[0]
    size = _block_of(stop - start, count)
    for first in range(start, stop, size):
        end = min(first + size, stop)
        x, u = _gather_points(points, inputs, first, end)
        room = _room((end - first) * count, x, car)
        up = np.empty_like(u)
        x_bar = np.zeros_like(x)
        _motion(x, u, car, room, np.empty_like(u))
        _columns(upstream, first, end, 0, up)
        for p in range(x.shape[1]):
            x_bar[2, p] = up[2, p]
            x_bar[3, p] = up[3, p]
            up[2, p] = 0
            up[3, p] = 0
        _motion_adjoint(x, u, car, room, up, x_bar, learning, gradients)
        _scatter_points(x_bar, out, first, end)
