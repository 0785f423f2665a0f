"""Sigma points through the single track on Dugoff's tyres (`DugoffTrack`), compiled, with the adjoint.

A point's derivatives are those of two numbers by two others: they are written out, and the adjoint multiplies by them.
"""

from __future__ import annotations

import math

import numba
import numpy as np
import torch

from vehest.constants import GRAVITY
from vehest.filters.unscented_scan import CompiledModel
from vehest.vehicle.dugoff import LARGEST_RATIO, LEAST_COSINE, LEAST_LOAD, LEAST_SHARE, DugoffTrack

PLAIN, SMOOTH = LARGEST_RATIO["plain"], LARGEST_RATIO["smooth"]

compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


class CompiledDugoffTrack(CompiledModel):
    """A `DugoffTrack` for the unscented filter; nothing of the car is learnt.

    Args:
        track: the model.
        dtype: precision of the arrays.
    """

    def __init__(self, track: DugoffTrack, dtype: torch.dtype = torch.float64) -> None:
        car = track.car
        scalar = np.float32 if dtype == torch.float32 else np.float64
        numbers = [car.mass, car.yaw_inertia, car.cg_to_front_axle, car.cg_to_rear_axle, car.cg_height, track.step, track.minimum_speed]
        axles = [[axle.cornering_stiffness, axle.friction, axle.reduction] for axle in (track.front, track.rear)]
        self.car = (np.array(numbers, scalar), np.array(axles, scalar), track.tyres == "smooth")
        self.measured = 5 if track.sees_sideslip else 4
        self.entries = (_transition, _observation, _transition_adjoint, _observation_adjoint)


@compiled
def _settled(speed, steer, ax, car):  # type: ignore[no-untyped-def]
    """Of one sample: speed, tangent and cosine of the steering angle, loads of both axles."""
    mass, _, front_arm, rear_arm, height, _, minimum_speed = car
    wheelbase = front_arm + rear_arm
    transfer = ax * (height / wheelbase)
    gravity = car.dtype.type(GRAVITY)
    front, rear = gravity * rear_arm / wheelbase, gravity * front_arm / wheelbase
    least = car.dtype.type(LEAST_LOAD)
    load_front, load_rear = mass * max(front - transfer, least * front), mass * max(rear + transfer, least * rear)
    return max(speed, minimum_speed), math.tan(steer), math.cos(steer), load_front, load_rear


@compiled
def _axle(tangent, load, vx, axle, smooth):  # type: ignore[no-untyped-def]
    """Force and its derivative by the tangent of the slip angle."""
    stiffness, friction, reduction = axle
    one, least = axle.dtype.type(1.0), axle.dtype.type(LEAST_SHARE)
    slide = abs(tangent)
    share, per_slide = one - reduction * vx * slide, -reduction * vx
    if share < least:
        share, per_slide = least, one * 0
    half = friction * share * load / (2 * stiffness)
    largest = axle.dtype.type(SMOOTH if smooth else PLAIN)
    if half >= largest * slide:
        return stiffness * tangent, stiffness
    ratio = half / slide
    by_slide = per_slide / share * ratio - ratio / slide
    if smooth:
        used = math.tanh(2 * ratio)
        by_ratio = 2 * (one - used * used)
    else:
        used = ratio * (2 - ratio)
        by_ratio = 2 - 2 * ratio
    return stiffness * tangent * used, stiffness * (used + slide * by_ratio * by_slide)


@compiled
def _forces(vy, yaw_rate, vx, turned, cosine, load_front, load_rear, front_arm, rear_arm, axles, smooth):  # type: ignore[no-untyped-def]
    """Forces across the body, front and rear, and the derivative of each by the lateral velocity of its axle."""
    course_front, course_rear = (vy + front_arm * yaw_rate) / vx, (vy - rear_arm * yaw_rate) / vx
    across = 1 + turned * course_front
    least = axles.dtype.type(LEAST_COSINE)
    if across > least:
        tangent, by_course = (turned - course_front) / across, -(1 + turned * turned) / (across * across)
    else:
        tangent, by_course = (turned - course_front) / least, -1 / least
    front, front_slope = _axle(tangent, load_front, vx, axles[0], smooth)
    rear, rear_slope = _axle(-course_rear, load_rear, vx, axles[1], smooth)
    return front * cosine, rear, front_slope * cosine * by_course / vx, -rear_slope / vx


@compiled
def _transition(points, inputs, track, out, first, end):  # type: ignore[no-untyped-def]
    car, axles, smooth = track
    mass, inertia, front_arm, rear_arm, _, step, minimum_speed = car
    for b in range(first, end):
        vx, turned, cosine, load_front, load_rear = _settled(inputs[0, b], inputs[1, b], inputs[2, b], car)
        turn = inputs[0, b] * inputs[1, b] / (front_arm + rear_arm)
        for s in range(points.shape[0]):
            vy, yaw_rate = points[s, 0, b], points[s, 1, b]
            if inputs[0, b] < minimum_speed:
                out[s, 0, b], out[s, 1, b] = rear_arm * turn, turn
                continue
            front, rear, _, _ = _forces(vy, yaw_rate, vx, turned, cosine, load_front, load_rear, front_arm, rear_arm, axles, smooth)
            out[s, 0, b] = vy + step * ((front + rear) / mass - vx * yaw_rate)
            out[s, 1, b] = yaw_rate + step * (front_arm * front - rear_arm * rear) / inertia


@compiled
def _observation(points, inputs, track, out, first, end):  # type: ignore[no-untyped-def]
    car, axles, smooth = track
    mass, _, front_arm, rear_arm, _, _, _ = car
    for b in range(first, end):
        vx, turned, cosine, load_front, load_rear = _settled(inputs[0, b], inputs[1, b], inputs[2, b], car)
        for s in range(points.shape[0]):
            vy, yaw_rate = points[s, 0, b], points[s, 1, b]
            front, rear, _, _ = _forces(vy, yaw_rate, vx, turned, cosine, load_front, load_rear, front_arm, rear_arm, axles, smooth)
            out[s, 0, b], out[s, 1, b] = (front + rear) / mass, yaw_rate
            out[s, 2, b], out[s, 3, b] = front, rear
            if out.shape[1] == 5:
                out[s, 4, b] = math.atan(vy / vx)


@compiled
def _transition_adjoint(points, inputs, track, upstream, out, gradients, first, end):  # type: ignore[no-untyped-def]
    car, axles, smooth = track
    mass, inertia, front_arm, rear_arm, _, step, minimum_speed = car
    for b in range(first, end):
        vx, turned, cosine, load_front, load_rear = _settled(inputs[0, b], inputs[1, b], inputs[2, b], car)
        for s in range(points.shape[0]):
            if inputs[0, b] < minimum_speed:
                out[s, 0, b], out[s, 1, b] = 0, 0
                continue
            vy, yaw_rate = points[s, 0, b], points[s, 1, b]
            _, _, by_front, by_rear = _forces(vy, yaw_rate, vx, turned, cosine, load_front, load_rear, front_arm, rear_arm, axles, smooth)
            across, turning = upstream[s, 0, b], upstream[s, 1, b]
            front_bar = step * (across / mass + turning * front_arm / inertia) * by_front
            rear_bar = step * (across / mass - turning * rear_arm / inertia) * by_rear
            out[s, 0, b] = across + front_bar + rear_bar
            out[s, 1, b] = turning - step * vx * across + front_arm * front_bar - rear_arm * rear_bar


@compiled
def _observation_adjoint(points, inputs, track, upstream, out, gradients, first, end):  # type: ignore[no-untyped-def]
    car, axles, smooth = track
    mass, _, front_arm, rear_arm, _, _, _ = car
    for b in range(first, end):
        vx, turned, cosine, load_front, load_rear = _settled(inputs[0, b], inputs[1, b], inputs[2, b], car)
        for s in range(points.shape[0]):
            vy, yaw_rate = points[s, 0, b], points[s, 1, b]
            _, _, by_front, by_rear = _forces(vy, yaw_rate, vx, turned, cosine, load_front, load_rear, front_arm, rear_arm, axles, smooth)
            front_bar = (upstream[s, 0, b] / mass + upstream[s, 2, b]) * by_front
            rear_bar = (upstream[s, 0, b] / mass + upstream[s, 3, b]) * by_rear
            out[s, 0, b] = front_bar + rear_bar
            out[s, 1, b] = upstream[s, 1, b] + front_arm * front_bar - rear_arm * rear_bar
            if upstream.shape[1] == 5:
                out[s, 0, b] += upstream[s, 4, b] * vx / (vx * vx + vy * vy)
