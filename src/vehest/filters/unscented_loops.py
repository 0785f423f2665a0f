"""The loop over samples of the unscented filter and that of its adjoint, compiled for compiled models; uncompiled they run with any model.

Arrays by time lie (T, ..., B), followed by room for a vector (`room`); a loop works on the sequences from ``first`` to ``end``, so that
several may run side by side. It calls models and steps by their addresses, so that it compiles once, and in a second.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import typeof
from numba.core.types.function_type import CompileResultWAP

from vehest.filters.unscented_steps import (
    compiled,
    gate_of,
    moments_adjoint,
    moments_of,
    points_adjoint,
    points_of,
    room,
    types_of,
    update_adjoint,
    update_of,
)


class Setting(NamedTuple):
    """What a filter does the same at every sample; ``rule`` and ``lower`` as in `unscented_steps`, ``limit`` is a gate's deviations²."""

    rule: Any
    lower: Any
    margin: Any
    repair: bool
    gated: bool
    limit: Any
    patience: int


class Tape(NamedTuple):
    """What the steps leave behind, sample by sample, (T, ..., B)."""

    prior_mean: Any
    prior_covariance: Any
    post_mean: Any
    post_covariance: Any
    moved: Any
    expected: Any
    innovation: Any
    own: Any
    gain: Any
    likelihood: Any
    centre: Any
    repaired: Any
    gone: Any


def tape_of(steps: int, sequences: int, n: int, m: int, dtype: Any) -> Tape:
    """A tape for n states and m measurements."""
    points = 2 * n + 1
    shapes: list[tuple[int, ...]] = [(n,), (n, n), (n,), (n, n), (points, n), (points, m), (m,), (m, m), (n, m), (), ()]
    made = [room((steps, *shape, sequences), dtype) for shape in shapes]
    return Tape(*made, np.zeros((steps, sequences), np.bool_), np.zeros((steps, m, sequences), np.bool_))  # type: ignore[call-arg]


def forward_scratch(tape: Tape) -> tuple[Any, ...]:
    """What `forward` works with: each call has its own, so that no two threads write to one line of a cache at every step."""
    points, covariance, spread = tape.moved[0], tape.prior_covariance[0], tape.own[0]
    lost = np.empty(points.shape[-1:], np.bool_)
    points, factor, own, made, made_spread = (room(part.shape, part.dtype) for part in (points, *[covariance] * 3, spread))
    return points, factor, own, lost, made, made_spread


def backward_scratch(tape: Tape) -> tuple[Any, ...]:
    """What `backward` works with, likewise; the last two become the gradients of the initial mean and covariance."""
    points, expected, mean, covariance = tape.moved[0], tape.expected[0], tape.post_mean[0], tape.post_covariance[0]
    states = (mean, covariance)
    shapes = [part.shape for part in (points, covariance, covariance, points, points, points, expected, *states, *states)]
    made = [room(shape, points.dtype) for shape in shapes]
    return (*made[:3], np.empty(points.shape[-1:], np.bool_), *made[3:])


def by_address(function: Any, *arguments: Any) -> CompileResultWAP:
    """A compiled function for arguments of these types, as a loop takes it: the loop calls it where it is, and compiles no copy of it."""
    return _of_types(function, tuple(typeof(argument) for argument in arguments))


def _of_types(function: Any, kinds: tuple[Any, ...]) -> CompileResultWAP:
    function.compile(kinds)
    return CompileResultWAP(function.overloads[kinds])


FORWARD, BACKWARD = (points_of, moments_of, gate_of, update_of), (points_of, update_adjoint, points_adjoint, moments_adjoint)


@cache
def steps_by_address(steps: tuple[Any, ...], dtype: Any) -> tuple[CompileResultWAP, ...]:
    """The steps of a loop, `FORWARD` or `BACKWARD`, for arrays of a precision, as it takes them where it is compiled."""
    return tuple(_of_types(step, types_of(step, dtype)) for step in steps)


@compiled
def forward(  # type: ignore[no-untyped-def]
    points_of,
    moments_of,
    gate_of,
    update_of,
    transition,
    observation,
    car,
    process_at,
    process_car,
    spread_at,
    spread_car,
    setting,
    tape,
    y,
    u,
    process,
    spread,
    refused,
    scratch,
    halves,
    first,
    end,
):
    """Halves of steps: half 2k moves the states to sample k of the tape, half 2k + 1 takes in the measurement there.

    Noise is ``process`` and ``spread``, (T, k, k, B), or where there is a function, what it writes: ``at(states, inputs, car, out, first,
    end)``. What a gate refuses becomes NaN in ``y`` and counts in ``refused``, (B, m).
    """
    rule, lower = setting.rule, setting.lower
    points, factor, covariance, lost, made_process, made_spread = scratch
    for half in range(halves[0], halves[1]):
        k = half // 2
        if half % 2 == 0:
            mean, given, inputs, moved, repaired = (
                tape.post_mean[k - 1],
                tape.post_covariance[k - 1],
                u[k - 1],
                tape.moved[k],
                tape.repaired[k],
            )
            points_of(mean, given, rule, lower, setting.margin, setting.repair, covariance, factor, points, repaired, first, end)
            transition(points, inputs, car, moved, first, end)
            if process_at is None:
                added = process[k - 1]
            else:
                process_at(mean, inputs, process_car, made_process, first, end)
                added = made_process
            moments_of(moved, added, rule, lower, tape.prior_mean[k], tape.prior_covariance[k], first, end)
        else:
            mean, given, inputs, expected, repaired = tape.prior_mean[k], tape.prior_covariance[k], u[k], tape.expected[k], tape.repaired[k]
            points_of(mean, given, rule, lower, setting.margin, setting.repair, covariance, factor, points, lost, first, end)
            for b in range(first, end):
                repaired[b] |= lost[b]
            observation(points, inputs, car, expected, first, end)
            if spread_at is None:
                noise = spread[k]
            else:
                spread_at(mean, inputs, spread_car, made_spread, first, end)
                noise = made_spread
            if setting.gated:
                gate_of(expected, noise, rule, setting.limit, setting.patience, y[k], refused, tape.gone[k], first, end)
            update_of(
                mean,
                covariance,
                points,
                expected,
                y[k],
                noise,
                rule,
                lower,
                setting.margin,
                setting.repair,
                tape.post_mean[k],
                tape.post_covariance[k],
                tape.innovation[k],
                tape.own[k],
                tape.gain[k],
                tape.likelihood[k],
                repaired,
                tape.centre[k],
                first,
                end,
            )


@compiled
def backward(  # type: ignore[no-untyped-def]
    points_of,
    update_adjoint,
    points_adjoint,
    moments_adjoint,
    transition_adjoint,
    observation_adjoint,
    car,
    setting,
    tape,
    y,
    u,
    bars,
    scratch,
    gradients,
    first,
    end,
):
    """The adjoint of `forward` over all samples.

    Args:
        bars: gradients of process noise, observation noise and measurements, which are written, and of filtered means and covariances.
        scratch: see `backward_scratch`.
        gradients: those of the model's parameters are added.
    """
    process_bar, spread_bar, y_bar, mean_up, covariance_up = bars
    points, factor, covariance, lost, points_bar, through, moved_bar, expected_bar = scratch[:8]
    post_mean_bar, post_covariance_bar, mean_bar, covariance_bar = scratch[8:]
    margin, repair, rule, lower = setting.margin, setting.repair, setting.rule, setting.lower
    _clear(post_mean_bar, first, end)
    _clear(post_covariance_bar, first, end)
    for k in range(len(y) - 1, -1, -1):
        _add(post_mean_bar, mean_up[k], first, end)
        _add(post_covariance_bar, covariance_up[k], first, end)
        mean = tape.prior_mean[k]
        points_of(mean, tape.prior_covariance[k], rule, lower, margin, repair, covariance, factor, points, lost, first, end)
        update_adjoint(
            mean,
            points,
            tape.expected[k],
            y[k],
            rule,
            lower,
            tape.innovation[k],
            tape.own[k],
            tape.gain[k],
            tape.centre[k],
            post_mean_bar,
            post_covariance_bar,
            mean_bar,
            covariance_bar,
            points_bar,
            expected_bar,
            spread_bar[k],
            y_bar[k],
            first,
            end,
        )
        observation_adjoint(points, u[k], car, expected_bar, through, gradients, first, end)
        _add(points_bar, through, first, end)
        points_adjoint(mean, factor, rule, lower, points_bar, mean_bar, covariance_bar, first, end)
        if k == 0:
            break
        moments_adjoint(tape.moved[k], rule, lower, mean_bar, covariance_bar, moved_bar, process_bar[k - 1], first, end)
        mean = tape.post_mean[k - 1]
        points_of(mean, tape.post_covariance[k - 1], rule, lower, margin, repair, covariance, factor, points, lost, first, end)
        transition_adjoint(points, u[k - 1], car, moved_bar, points_bar, gradients, first, end)
        _clear(post_mean_bar, first, end)
        _clear(post_covariance_bar, first, end)
        points_adjoint(mean, factor, rule, lower, points_bar, post_mean_bar, post_covariance_bar, first, end)


@compiled
def _add(total, values, first, end):  # type: ignore[no-untyped-def]
    rows, added = total.reshape(-1, total.shape[total.ndim - 1]), values.reshape(-1, total.shape[total.ndim - 1])
    for row in range(rows.shape[0]):
        for b in range(first, end):
            rows[row, b] += added[row, b]


@compiled
def _clear(values, first, end):  # type: ignore[no-untyped-def]
    rows = values.reshape(-1, values.shape[values.ndim - 1])
    for row in range(rows.shape[0]):
        for b in range(first, end):
            rows[row, b] = 0
