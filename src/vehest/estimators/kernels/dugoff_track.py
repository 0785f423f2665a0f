"""Sigma points through the single track on Dugoff's tyres (`DugoffTrack`), compiled, with the adjoint.

A point's derivatives are those of two numbers by two others: they are written out, and the adjoint multiplies by those of both axles'
forces, which are left for it beside the inputs.
"""

from __future__ import annotations

import math

import numpy as np

from vehest.constants import GRAVITY
from vehest.filters.unscented_scan import PointModel
from vehest.filters.unscented_steps import at_row, compiled, piece
from vehest.lanes import choose, each, most, store_some, width
from vehest.vehicle.dugoff import LARGEST_RATIO, LEAST_COSINE, LEAST_LOAD, LEAST_SHARE, DugoffTrack

DRIVEN = 3  # rows of inputs before those that are kept
PLAIN = LARGEST_RATIO["plain"]
SMOOTH = LARGEST_RATIO["smooth"]


class CompiledDugoffTrack(PointModel):
    """A `DugoffTrack` for the unscented filter; nothing of the car is learnt."""

    is_compiled = True
    scratch_rows = 4

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
def _put(values, row, b, vector, end):  # type: ignore[no-untyped-def]
    store_some(values, row * values.shape[values.ndim - 1] + b, vector, end - b)


@piece
def _settled(inputs, b, car):  # type: ignore[no-untyped-def]
    """Of one sample: speed, tangent and cosine of the steering angle, loads of both axles."""
    mass, _, front_arm, rear_arm, height, _, minimum_speed = car
    wheelbase = front_arm + rear_arm
    transfer = at_row(inputs, 2, b) * (height / wheelbase)
    gravity = car.dtype.type(GRAVITY)
    front = gravity * rear_arm / wheelbase
    rear = gravity * front_arm / wheelbase
    least = car.dtype.type(LEAST_LOAD)
    steer = at_row(inputs, 1, b)
    load_front = mass * most(front - transfer, least * front)
    load_rear = mass * most(rear + transfer, least * rear)
    return (
        most(at_row(inputs, 0, b), minimum_speed),
        each(math.tan, steer),
        each(math.cos, steer),
        load_front,
        load_rear,
    )


@piece
def _axle(tangent, load, vx, axle, smooth):  # type: ignore[no-untyped-def]
    """Force and its derivative by the tangent of the slip angle."""
    stiffness, friction, reduction = axle
    one = axle.dtype.type(1.0)
    least = axle.dtype.type(LEAST_SHARE)
    slide = abs(tangent)
    share = one - reduction * vx * slide
    per_slide = choose(share < least, 0.0, -reduction * vx)
    share = choose(share < least, least, share)
    half = friction * share * load / (2 * stiffness)
    largest = axle.dtype.type(SMOOTH if smooth else PLAIN)
    linear = half >= largest * slide
    ratio = half / slide
    by_slide = per_slide / share * ratio - ratio / slide
    if smooth:
        used = each(math.tanh, choose(linear, 0.0, 2 * ratio))
        by_ratio = 2 * (one - used * used)
    else:
        used = ratio * (2 - ratio)
        by_ratio = 2 - 2 * ratio
    force = stiffness * tangent
    slope = stiffness * (used + slide * by_ratio * by_slide)
    return choose(linear, force, force * used), choose(linear, stiffness, slope)


@piece
def _forces(points, s, b, settled, track):  # type: ignore[no-untyped-def]
    """Forces across the body at point s, front and rear, and the derivative of each by the lateral velocity of its axle."""
    vx, turned, cosine, load_front, load_rear = settled
    car, axles, smooth = track
    vy = at_row(points, 2 * s, b)
    yaw_rate = at_row(points, 2 * s + 1, b)
    course_front = (vy + car[2] * yaw_rate) / vx
    course_rear = (vy - car[3] * yaw_rate) / vx
    across = 1 + turned * course_front
    least = axles.dtype.type(LEAST_COSINE)
    tangent = (turned - course_front) / choose(across > least, across, least)
    by_course = choose(across > least, -(1 + turned * turned) / (across * across), -1 / least)
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
def _keep(inputs, entry, s, b, by_front, by_rear, end):  # type: ignore[no-untyped-def]
    """Leave what the forces at point s change by the lateral velocities of their axles, where inputs have rows for it."""
    row = DRIVEN + 4 * s + 2 * entry
    if row < inputs.shape[0]:
        _put(inputs, row, b, by_front, end)
        _put(inputs, row + 1, b, by_rear, end)


@piece
def _kept(inputs, entry, s, b):  # type: ignore[no-untyped-def]
    row = DRIVEN + 4 * s + 2 * entry
    return at_row(inputs, row, b), at_row(inputs, row + 1, b)


@compiled
def _transition(points, inputs, track, out, first, end):  # type: ignore[no-untyped-def]
    car = track[0]
    mass, inertia, front_arm, rear_arm, _, step, minimum_speed = car
    for b in range(first, end, width(points)):
        settled = _settled(inputs, b, car)
        rolls = at_row(inputs, 0, b) < minimum_speed
        turn = at_row(inputs, 0, b) * at_row(inputs, 1, b) / (front_arm + rear_arm)
        for s in range(points.shape[0]):
            vy, yaw_rate, front, rear, by_front, by_rear = _forces(points, s, b, settled, track)
            _keep(inputs, 0, s, b, by_front, by_rear, end)
            across = vy + step * ((front + rear) / mass - settled[0] * yaw_rate)
            turning = yaw_rate + step * (front_arm * front - rear_arm * rear) / inertia
            _put(out, 2 * s, b, choose(rolls, rear_arm * turn, across), end)
            _put(out, 2 * s + 1, b, choose(rolls, turn, turning), end)


@compiled
def _observation(points, inputs, track, out, first, end):  # type: ignore[no-untyped-def]
    car = track[0]
    m = out.shape[1]
    for b in range(first, end, width(points)):
        settled = _settled(inputs, b, car)
        for s in range(points.shape[0]):
            vy, yaw_rate, front, rear, by_front, by_rear = _forces(points, s, b, settled, track)
            _keep(inputs, 1, s, b, by_front, by_rear, end)
            _put(out, m * s, b, (front + rear) / car[0], end)
            _put(out, m * s + 1, b, yaw_rate, end)
            _put(out, m * s + 2, b, front, end)
            _put(out, m * s + 3, b, rear, end)
            if m == 5:
                _put(out, m * s + 4, b, each(math.atan, vy / settled[0]), end)


@compiled
def _transition_adjoint(points, inputs, track, upstream, out, gradients, first, end):  # type: ignore[no-untyped-def]
    car = track[0]
    mass, inertia, front_arm, rear_arm, _, step, minimum_speed = car
    for b in range(first, end, width(points)):
        vx = most(at_row(inputs, 0, b), minimum_speed)
        rolls = at_row(inputs, 0, b) < minimum_speed
        for s in range(points.shape[0]):
            by_front, by_rear = _kept(inputs, 0, s, b)
            across = at_row(upstream, 2 * s, b)
            turning = at_row(upstream, 2 * s + 1, b)
            front_bar = step * (across / mass + turning * front_arm / inertia) * by_front
            rear_bar = step * (across / mass - turning * rear_arm / inertia) * by_rear
            spun = turning - step * vx * across + front_arm * front_bar - rear_arm * rear_bar
            _put(out, 2 * s, b, choose(rolls, 0.0, across + front_bar + rear_bar), end)
            _put(out, 2 * s + 1, b, choose(rolls, 0.0, spun), end)


@compiled
def _observation_adjoint(points, inputs, track, upstream, out, gradients, first, end):  # type: ignore[no-untyped-def]
    car = track[0]
    m = upstream.shape[1]
    mass, _, front_arm, rear_arm, _, _, minimum_speed = car
    for b in range(first, end, width(points)):
        vx = most(at_row(inputs, 0, b), minimum_speed)
        for s in range(points.shape[0]):
            vy = at_row(points, 2 * s, b)
            (by_front, by_rear) = _kept(inputs, 1, s, b)
            across = at_row(upstream, m * s, b) / mass
            front_bar = (across + at_row(upstream, m * s + 2, b)) * by_front
            rear_bar = (across + at_row(upstream, m * s + 3, b)) * by_rear
            bar = front_bar + rear_bar
            if m == 5:
                bar += at_row(upstream, m * s + 4, b) * vx / (vx * vx + vy * vy)
            _put(out, 2 * s, b, bar, end)
            _put(
                out,
                2 * s + 1,
                b,
                at_row(upstream, m * s + 1, b) + front_arm * front_bar - rear_arm * rear_bar,
                end,
            )
