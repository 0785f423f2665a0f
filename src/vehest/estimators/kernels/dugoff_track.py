"""Sigma points through `DugoffTrack`, a single track on Dugoff's tyres, and the adjoint.

Equations: see `vehest.vehicle.dugoff`, which is the readable definition in torch. With F_F, F_R the
axle forces and F' their derivatives by the lateral velocity of their axle, which the forward pass
saves beside the inputs:

    v⁺ = v + Δt ((F_F + F_R)/m - u r),   r⁺ = r + Δt (l_F F_F - l_R F_R)/I_zz
    F̄_F = Δt (v̄⁺/m + l_F r̄⁺/I_zz) F_F',   F̄_R = Δt (v̄⁺/m - l_R r̄⁺/I_zz) F_R'
    v̄ = v̄⁺ + F̄_F + F̄_R,   r̄ = r̄⁺ - Δt u v̄⁺ + l_F F̄_F - l_R F̄_R

The observation (a_y, r, F_F, F_R and, for five measurements, β = atan v/u) is treated alike. Order
of sums: there are none over points.
"""

from __future__ import annotations

import math

import numpy as np

from vehest.constants import GRAVITY
from vehest.filters.unscented_scan import PointModel
from vehest.filters.unscented_steps import at_row, compiled, piece
from vehest.lanes import choose, each, most, store_some, width
from vehest.vehicle.dugoff import (
    MAX_FORCE_RATIO,
    MIN_COSINE,
    MIN_FRICTION_SHARE,
    MIN_LOAD_SHARE,
    DugoffTrack,
)

# rows of inputs (speed, steering angle, longitudinal acceleration) before saved derivatives
DRIVEN = 3
PLAIN = MAX_FORCE_RATIO["plain"]  # λ from which on tyres of Eq. 9 are linear
SMOOTH = MAX_FORCE_RATIO["smooth"]  # λ from which on tyres of Eq. 10 are linear


class CompiledDugoffTrack(PointModel):
    """A `DugoffTrack` for the unscented filter; nothing of the car is learnt.

    Parameters
    ----------
    track : DugoffTrack
        Its numbers are copied: later changes have no effect.

    Attributes
    ----------
    car : tuple
        Numbers (7,): m, I_zz, l_F, l_R, h, Δt, minimum speed; axles (2, 3): C, μ₀, e_r of the front
        and the rear one; whether tyres are smooth.
    """

    is_compiled = True
    scratch_rows = 4  # rows of inputs for each point in which entries store numbers

    def __init__(self, track: DugoffTrack) -> None:
        car = track.car
        numbers = [
            car.mass,
            car.yaw_inertia,
            car.cg_to_front_axle,
            car.cg_to_rear_axle,
            car.cg_height,
            track.step,
            track.minimum_speed,
        ]
        axles = [
            [axle.cornering_stiffness, axle.friction, axle.reduction]
            for axle in (track.front, track.rear)
        ]
        self.car = (np.array(numbers), np.array(axles), track.tyres == "smooth")
        self.entries = (_transition, _observation, _transition_adjoint, _observation_adjoint)


@piece
def _set_row(values, row, b, vector, end):
    """Write a vector, one lane a sequence, to the sequences from b to ``end`` of a row."""
    store_some(values, row * values.shape[values.ndim - 1] + b, vector, end - b)


@piece
def _input_terms(inputs, b, car):
    """Terms that all sigma points share, of the sequences from b on.

    Speed, at least the minimum, tangent and cosine of the steering angle, loads of both axles.
    """
    mass, _, front_arm, rear_arm, height, _, minimum_speed = car
    wheelbase = front_arm + rear_arm
    transfer = at_row(inputs, 2, b) * (height / wheelbase)
    gravity = car.dtype.type(GRAVITY)
    front = gravity * rear_arm / wheelbase
    rear = gravity * front_arm / wheelbase
    min_load_share = car.dtype.type(MIN_LOAD_SHARE)
    steer = at_row(inputs, 1, b)
    load_front = mass * most(front - transfer, min_load_share * front)
    load_rear = mass * most(rear + transfer, min_load_share * rear)
    return (
        most(at_row(inputs, 0, b), minimum_speed),
        each(math.tan, steer),
        each(math.cos, steer),
        load_front,
        load_rear,
    )


@piece
def _axle(tangent, load, vx, axle, smooth):
    """Force of an axle and its derivative by the tangent of the slip angle (Eqs. 9 and 10).

    Parameters
    ----------
    tangent, load, vx : vector
        tan α, positive where it makes a force to the left; F_z [N]; u [m/s].
    axle : array
        C [N/rad], μ₀ [1], e_r [s/m], (3,).
    smooth : bool
        Eq. 10 instead of Eq. 9.

    Returns
    -------
    tuple
        F = C tan α f(λ) [N] and dF/d tan α [N]. Where λ reaches its largest value the tyre is
        linear, F = C tan α.
    """
    stiffness, friction, reduction = axle
    unity = axle.dtype.type(1.0)
    min_share = axle.dtype.type(MIN_FRICTION_SHARE)
    slide = abs(tangent)
    share = unity - reduction * vx * slide
    per_slide = choose(share < min_share, 0.0, -reduction * vx)
    share = choose(share < min_share, min_share, share)
    half = friction * share * load / (2 * stiffness)
    largest = axle.dtype.type(SMOOTH if smooth else PLAIN)
    linear = half >= largest * slide
    ratio = half / slide
    by_slide = per_slide / share * ratio - ratio / slide
    if smooth:
        force_share = each(math.tanh, choose(linear, 0.0, 2 * ratio))
        by_ratio = 2 * (unity - force_share * force_share)
    else:
        force_share = ratio * (2 - ratio)
        by_ratio = 2 - 2 * ratio
    force = stiffness * tangent
    slope = stiffness * (force_share + slide * by_ratio * by_slide)
    return choose(linear, force, force * force_share), choose(linear, stiffness, slope)


@piece
def _forces(points, s, b, input_terms, track):
    """Forces across the body at point s, front and rear, and the derivative of each by the lateral
    velocity of its axle.
    """
    vx, turned, cosine, load_front, load_rear = input_terms
    car, axles, smooth = track
    vy = at_row(points, 2 * s, b)
    yaw_rate = at_row(points, 2 * s + 1, b)
    course_front = (vy + car[2] * yaw_rate) / vx
    course_rear = (vy - car[3] * yaw_rate) / vx
    across = 1 + turned * course_front
    min_cosine = axles.dtype.type(MIN_COSINE)
    tangent = (turned - course_front) / choose(across > min_cosine, across, min_cosine)
    by_course = choose(
        across > min_cosine, -(1 + turned * turned) / (across * across), -1 / min_cosine
    )
    front, front_slope = _axle(tangent, load_front, vx, axles[0], smooth)
    rear, rear_slope = _axle(-course_rear, load_rear, vx, axles[1], smooth)
    return (
        vy,
        yaw_rate,
        front * cosine,
        rear,
        front_slope * cosine * by_course / vx,
        -rear_slope / vx,
    )


@piece
def _save_slopes(inputs, entry, s, b, by_front, by_rear, end):
    """Save the derivatives of the forces at point s by the lateral velocities of their axles, where
    inputs have rows for them.
    """
    row = DRIVEN + 4 * s + 2 * entry
    if row < inputs.shape[0]:
        _set_row(inputs, row, b, by_front, end)
        _set_row(inputs, row + 1, b, by_rear, end)


@piece
def _saved_slopes(inputs, entry, s, b):
    """Derivatives by the lateral velocities of the front and the rear axle that `_save_slopes`
    saved for point s.
    """
    row = DRIVEN + 4 * s + 2 * entry
    return at_row(inputs, row, b), at_row(inputs, row + 1, b)


@compiled
def _transition(points, inputs, track, out, first, end):
    """Write states one step later at all points; see the module.

    Parameters
    ----------
    points : array
        v [m/s] and r [rad/s], (S, 2, B).
    inputs : array
        u, δ, a_x, then rows for saved derivatives where gradients are computed, (3 or 3 + 4 S, B).
    track : tuple
        See `CompiledDugoffTrack`.
    out : array
        (S, 2, B), written for the sequences from ``first`` to ``end``.
    """
    car = track[0]
    mass, inertia, front_arm, rear_arm, _, step, minimum_speed = car
    for b in range(first, end, width(points)):
        input_terms = _input_terms(inputs, b, car)
        rolls = at_row(inputs, 0, b) < minimum_speed
        turn = at_row(inputs, 0, b) * at_row(inputs, 1, b) / (front_arm + rear_arm)
        for s in range(points.shape[0]):
            vy, yaw_rate, front, rear, by_front, by_rear = _forces(points, s, b, input_terms, track)
            _save_slopes(inputs, 0, s, b, by_front, by_rear, end)
            across = vy + step * ((front + rear) / mass - input_terms[0] * yaw_rate)
            turning = yaw_rate + step * (front_arm * front - rear_arm * rear) / inertia
            _set_row(out, 2 * s, b, choose(rolls, rear_arm * turn, across), end)
            _set_row(out, 2 * s + 1, b, choose(rolls, turn, turning), end)


@compiled
def _observation(points, inputs, track, out, first, end):
    """Write expected measurements at all points, (S, 4 or 5, B): a_y, r, F_F cos δ, F_R, and
    perhaps β.

    Arguments as those of `_transition`.
    """
    car = track[0]
    m = out.shape[1]
    for b in range(first, end, width(points)):
        input_terms = _input_terms(inputs, b, car)
        for s in range(points.shape[0]):
            vy, yaw_rate, front, rear, by_front, by_rear = _forces(points, s, b, input_terms, track)
            _save_slopes(inputs, 1, s, b, by_front, by_rear, end)
            _set_row(out, m * s, b, (front + rear) / car[0], end)
            _set_row(out, m * s + 1, b, yaw_rate, end)
            _set_row(out, m * s + 2, b, front, end)
            _set_row(out, m * s + 3, b, rear, end)
            if m == 5:
                _set_row(out, m * s + 4, b, each(math.atan, vy / input_terms[0]), end)


@compiled
def _transition_adjoint(points, inputs, track, upstream, out, gradients, first, end):
    """Write gradients by the points, given those by the states one step later (``upstream``, (S, 2,
    B)).

    Equations: see the module. Wheels that roll have no gradient, since the state does not count.
    """
    car = track[0]
    mass, inertia, front_arm, rear_arm, _, step, minimum_speed = car
    for b in range(first, end, width(points)):
        vx = most(at_row(inputs, 0, b), minimum_speed)
        rolls = at_row(inputs, 0, b) < minimum_speed
        for s in range(points.shape[0]):
            by_front, by_rear = _saved_slopes(inputs, 0, s, b)
            across = at_row(upstream, 2 * s, b)
            turning = at_row(upstream, 2 * s + 1, b)
            front_bar = step * (across / mass + turning * front_arm / inertia) * by_front
            rear_bar = step * (across / mass - turning * rear_arm / inertia) * by_rear
            spun = turning - step * vx * across + front_arm * front_bar - rear_arm * rear_bar
            _set_row(out, 2 * s, b, choose(rolls, 0.0, across + front_bar + rear_bar), end)
            _set_row(out, 2 * s + 1, b, choose(rolls, 0.0, spun), end)


@compiled
def _observation_adjoint(points, inputs, track, upstream, out, gradients, first, end):
    """Write gradients by the points, given those by the expected measurements (``upstream``, (S, m,
    B)).

    F̄_i = (ā_y/m + F̄_i,measured) F_i' for both axles i;  v̄ = F̄_F + F̄_R + β̄ u/(u² + v²);
    r̄ = r̄_measured + l_F F̄_F - l_R F̄_R.
    """
    car = track[0]
    m = upstream.shape[1]
    mass, _, front_arm, rear_arm, _, _, minimum_speed = car
    for b in range(first, end, width(points)):
        vx = most(at_row(inputs, 0, b), minimum_speed)
        for s in range(points.shape[0]):
            vy = at_row(points, 2 * s, b)
            (by_front, by_rear) = _saved_slopes(inputs, 1, s, b)
            across = at_row(upstream, m * s, b) / mass
            front_bar = (across + at_row(upstream, m * s + 2, b)) * by_front
            rear_bar = (across + at_row(upstream, m * s + 3, b)) * by_rear
            bar = front_bar + rear_bar
            if m == 5:
                bar += at_row(upstream, m * s + 4, b) * vx / (vx * vx + vy * vy)
            _set_row(out, 2 * s, b, bar, end)
            _set_row(
                out,
                2 * s + 1,
                b,
                at_row(upstream, m * s + 1, b) + front_arm * front_bar - rear_arm * rear_bar,
                end,
            )
