"""The loop over samples of the unscented filter and that of its adjoint, compiled with any compiled model; without compilation, with any model.

Arrays by time lie (T, B, ...); a loop works on the sequences from ``first`` to ``end``, so that several may run side by side.
"""

from __future__ import annotations

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
    """What the steps leave behind, sample by sample, (T, B, ...)."""

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

    @classmethod
    def of(cls, steps: int, sequences: int, n: int, m: int, dtype: Any) -> Tape:
        """Of n states and m measurements."""
        points = 2 * n + 1
        shapes: list[tuple[int, ...]] = [(n,), (n, n), (n,), (n, n), (points, n), (points, m), (m,), (m, m), (n, m), (), ()]
        made = [np.empty((steps, sequences, *shape), dtype) for shape in shapes]
        return cls(*made, np.zeros((steps, sequences), np.bool_), np.zeros((steps, sequences, m), np.bool_))


def by_address(function: Any, *arguments: Any) -> CompileResultWAP:
    """A compiled function for arguments of these types, as a loop takes it: the loop calls it where it is, and compiles no copy of it."""
    types = tuple(typeof(argument) for argument in arguments)
    function.compile(types)
    return CompileResultWAP(function.overloads[types])


@compiled
def forward(  # type: ignore[no-untyped-def]
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
    halves,
    first,
    end,
):
    """Halves of steps: half 2k moves the states to sample k of the tape, half 2k + 1 takes in the measurement there.

    Noise is ``process`` and ``spread``, (T, B, k, k), or where there is a function, what it writes: ``at(states, inputs, car, out)``. What a
    gate refuses becomes NaN in ``y`` and counts in ``refused``, (B, m).
    """
    n, count, m = tape.post_mean.shape[2], tape.moved.shape[2], y.shape[2]
    sequences = end - first
    points, factor = np.empty((sequences, count, n), y.dtype), np.empty((sequences, n, n), y.dtype)
    covariance, lost = np.empty_like(factor), np.empty(sequences, np.bool_)
    made_process, made_spread = np.empty_like(factor), np.empty((sequences, m, m), y.dtype)
    rule, lower = setting.rule, setting.lower
    for half in range(halves[0], halves[1]):
        k = half // 2
        repaired = tape.repaired[k, first:end]
        if half % 2 == 0:
            mean, inputs = tape.post_mean[k - 1, first:end], u[k - 1, first:end]
            covariance[:] = tape.post_covariance[k - 1, first:end]
            points_of(mean, covariance, rule, lower, setting.margin, setting.repair, factor, points, repaired)
            moved = tape.moved[k, first:end]
            transition(points, inputs, car, moved)
            if process_at is None:
                added = process[k - 1, first:end]
            else:
                process_at(mean, inputs, process_car, made_process)
                added = made_process
            moments_of(moved, added, rule, lower, tape.prior_mean[k, first:end], tape.prior_covariance[k, first:end])
        else:
            mean, inputs, expected = tape.prior_mean[k, first:end], u[k, first:end], tape.expected[k, first:end]
            covariance[:] = tape.prior_covariance[k, first:end]
            points_of(mean, covariance, rule, lower, setting.margin, setting.repair, factor, points, lost)
            repaired |= lost
            observation(points, inputs, car, expected)
            if spread_at is None:
                noise = spread[k, first:end]
            else:
                spread_at(mean, inputs, spread_car, made_spread)
                noise = made_spread
            measured = y[k, first:end]
            if setting.gated:
                gone = tape.gone[k, first:end]
                gone[:] = False
                gate_of(expected, noise, rule, setting.limit, setting.patience, measured, refused[first:end], gone)
            update_of(
                mean,
                covariance,
                points,
                expected,
                measured,
                noise,
                rule,
                lower,
                setting.margin,
                setting.repair,
                tape.post_mean[k, first:end],
                tape.post_covariance[k, first:end],
                tape.innovation[k, first:end],
                tape.own[k, first:end],
                tape.gain[k, first:end],
                tape.likelihood[k, first:end],
                repaired,
                tape.centre[k, first:end],
            )


@compiled
def backward(transition_adjoint, observation_adjoint, car, setting, tape, y, u, bars, gradients, first, end):  # type: ignore[no-untyped-def]
    """The adjoint of `forward` over all samples.

    Args:
        bars: gradients of process noise, observation noise and measurements, which are written, of filtered means and covariances, and of
            the initial mean and covariance, which are written.
        gradients: those of the model's parameters are added.
    """
    process_bar, spread_bar, y_bar, mean_up, covariance_up, first_mean_bar, first_covariance_bar = bars
    n, count, m = tape.post_mean.shape[2], tape.moved.shape[2], y.shape[2]
    sequences = end - first
    points, factor = np.empty((sequences, count, n), y.dtype), np.empty((sequences, n, n), y.dtype)
    covariance, lost = np.empty_like(factor), np.empty(sequences, np.bool_)
    points_bar, through, moved_bar = np.empty_like(points), np.empty_like(points), np.empty_like(points)
    expected_bar = np.empty((sequences, count, m), y.dtype)
    post_mean_bar, post_covariance_bar = np.zeros((sequences, n), y.dtype), np.zeros_like(factor)
    mean_bar, covariance_bar = first_mean_bar[first:end], first_covariance_bar[first:end]
    rule, lower = setting.rule, setting.lower
    for k in range(len(y) - 1, -1, -1):
        post_mean_bar += mean_up[k, first:end]
        post_covariance_bar += covariance_up[k, first:end]
        mean = tape.prior_mean[k, first:end]
        covariance[:] = tape.prior_covariance[k, first:end]
        points_of(mean, covariance, rule, lower, setting.margin, setting.repair, factor, points, lost)
        update_adjoint(
            mean,
            points,
            tape.expected[k, first:end],
            y[k, first:end],
            rule,
            lower,
            tape.innovation[k, first:end],
            tape.own[k, first:end],
            tape.gain[k, first:end],
            tape.centre[k, first:end],
            post_mean_bar,
            post_covariance_bar,
            mean_bar,
            covariance_bar,
            points_bar,
            expected_bar,
            spread_bar[k, first:end],
            y_bar[k, first:end],
        )
        observation_adjoint(points, u[k, first:end], car, expected_bar, through, gradients)
        points_bar += through
        points_adjoint(mean, factor, rule, lower, points_bar, mean_bar, covariance_bar)
        if k == 0:
            break
        moments_adjoint(tape.moved[k, first:end], rule, lower, mean_bar, covariance_bar, moved_bar, process_bar[k - 1, first:end])
        mean = tape.post_mean[k - 1, first:end]
        covariance[:] = tape.post_covariance[k - 1, first:end]
        points_of(mean, covariance, rule, lower, setting.margin, setting.repair, factor, points, lost)
        transition_adjoint(points, u[k - 1, first:end], car, moved_bar, points_bar, gradients)
        post_mean_bar[:] = 0
        post_covariance_bar[:] = 0
        points_adjoint(mean, factor, rule, lower, points_bar, post_mean_bar, post_covariance_bar)
