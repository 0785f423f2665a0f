"""The loop over samples of the unscented filter and the loop of its adjoint.

    measurements, inputs, noise --forward--> `Tape` of all samples --backward--> gradients

Both loops compile where the model is compiled; with any other model they run uncompiled. They call
models and steps (`unscented_steps`) by address, so that they compile once, in a second, for all
models.

Arrays over time are (T, ..., B), followed by room for one vector (`room`). A loop works on the
sequences from ``first`` to ``end``, so that several loops may run in parallel.
"""

from __future__ import annotations

from collections import namedtuple
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
    """Settings that are the same at every sample.

    ``rules`` are those of `unscented_steps`; ``limit`` is the squared deviations of a `Gate`,
    ``patience`` its number of samples.
    """

    rules: tuple[Any, Any, Any, bool]
    gated: bool  # whether there is a gate
    limit: Any
    patience: int


class Tape(NamedTuple):
    """Values of all samples that the adjoint and the caller need, arrays (T, ..., B) for T samples
    and B sequences, with S sigma points, n states and m measurements.
    """

    prior_mean: Any  # state before the measurement, (T, n, B)
    prior_covariance: Any  # covariance of the prior, (T, n, n, B)
    post_mean: Any  # state after the measurement, (T, n, B)
    post_covariance: Any  # covariance of the posterior, (T, n, n, B)
    moved: Any  # sigma points after the transition, (T, S, n, B)
    expected: Any  # measurements expected at the points, (T, S, m, B)
    innovation: Any  # (T, m, B)
    innovation_covariance: Any  # (T, m, m, B)
    gain: Any  # (T, n, m, B)
    centre: Any  # weight of the mean point in covariances, (T, B)
    repaired: Any  # whether a covariance had lost its definiteness, (T, B)
    is_gated_out: Any  # whether the gate refused a measurement, (T, m, B)


def tape_of(steps: int, sequences: int, n: int, m: int, dtype: Any) -> Tape:
    """A tape of T = ``steps`` samples and B = ``sequences`` for n states and m measurements.

    ``dtype`` is the precision of all arrays but the flags.

    Returns
    -------
    Tape
        Values are not filled; the flags are False.
    """
    points = 2 * n + 1
    shapes: list[tuple[int, ...]] = [
        (n,),
        (n, n),
        (n,),
        (n, n),
        (points, n),
        (points, m),
        (m,),
        (m, m),
        (n, m),
        (),
    ]
    arrays = [room((steps, *shape, sequences), dtype) for shape in shapes]
    return Tape(
        *arrays, np.zeros((steps, sequences), np.bool_), np.zeros((steps, m, sequences), np.bool_)
    )  # type: ignore[call-arg]


def forward_scratch(tape: Tape) -> tuple[Any, ...]:
    """Scratch memory of one call of `forward`.

    Each call has its own, so that no two threads write to one cache line at every step.

    Returns
    -------
    tuple
        Drawn points, factors and covariances; flags (B,) of lost definiteness; process noise (n, n,
        B) and measurement noise (m, m, B) where these are functions of the state.
    """
    points = tape.moved[0]
    covariance = tape.prior_covariance[0]
    innovation_covariance = tape.innovation_covariance[0]
    lost = np.empty(points.shape[-1:], np.bool_)
    *drawn, process_noise_scratch, observation_noise_scratch = (
        room(part.shape, part.dtype) for part in (points, *[covariance] * 3, innovation_covariance)
    )
    return tuple(drawn), lost, process_noise_scratch, observation_noise_scratch


def backward_scratch(tape: Tape) -> tuple[Any, ...]:
    """Scratch memory of one call of `backward`.

    The last two arrays become the gradients of the initial mean and covariance.
    """
    points = tape.moved[0]
    expected = tape.expected[0]
    mean = tape.post_mean[0]
    covariance = tape.post_covariance[0]
    states = (mean, covariance)
    shapes = [
        part.shape
        for part in (
            points,
            covariance,
            covariance,
            points,
            points,
            points,
            expected,
            *states,
            *states,
        )
    ]
    arrays = [room(shape, points.dtype) for shape in shapes]
    return tuple(arrays[:3]), np.empty(points.shape[-1:], np.bool_), *arrays[3:]


def by_address(function: Any, *arguments: Any) -> CompileResultWAP:
    """A compiled function for arguments of these types, to be called by address.

    A loop that receives it compiles no copy of it.

    Parameters
    ----------
    function : Any
        numba dispatcher; it is compiled for these types if it is not yet.
    *arguments : Any
        Examples of the arguments, of which only the types count.
    """
    return _of_types(function, tuple(typeof(argument) for argument in arguments))


def _of_types(function: Any, kinds: tuple[Any, ...]) -> CompileResultWAP:
    """Compile a function for argument types and return it as a value that is called by address."""
    function.compile(kinds)
    return CompileResultWAP(function.overloads[kinds])


FORWARD = (points_of, moments_of, gate_of, update_of)  # steps that `forward` calls
BACKWARD = (points_of, update_adjoint, points_adjoint, moments_adjoint)  # steps of `backward`
Forward = namedtuple(
    "Forward",
    ("points_of", "moments_of", "gate_of", "update_of", "transition", "observation", "car"),
)
"""Functions that `forward` calls: `FORWARD`, a model's transition and observation, and the numbers
``car`` that both are passed; numba warns of a plain tuple of these.
"""
Backward = namedtuple(
    "Backward", ("points_of", "update", "points", "moments", "transition", "observation", "car")
)
"""Functions that `backward` calls: `BACKWARD`, the model's adjoints and their numbers ``car``."""


@cache
def steps_by_address(steps: tuple[Any, ...], dtype: Any) -> tuple[CompileResultWAP, ...]:
    """The steps of a loop, `FORWARD` or `BACKWARD`, compiled for arrays of a precision, so that a
    compiled loop can call them by address.

    It compiles each step once for each precision; later calls return the same objects.
    """
    return tuple(_of_types(step, types_of(step, dtype)) for step in steps)


@compiled
def forward(
    calls,
    at_state,
    car_at,
    at_prior,
    car_of,
    setting,
    tape,
    y,
    u,
    noise,
    refused,
    scratch,
    halves,
    first,
    end,
):
    """Run half-steps: 2k predicts the states of sample k, 2k + 1 updates them with its measurement.

    ``noise`` = (process, measurement) covariances, (T, k, k, B) each. Where there is a function
    ``at_state`` or ``at_prior``, covariances are what it writes: ``at(states, inputs, car, out,
    first, end)``. What the gate refuses becomes NaN in ``y`` and is counted in ``refused``, (B, m).

    For k from 0: even half-steps compute points_of -> transition -> moments_of, with inputs and
    noise of sample k - 1; odd ones compute points_of -> observation -> gate -> update_of, with
    those of k. The first half-step of a sequence is 1, since the initial state is that of sample 0.

    Parameters
    ----------
    calls : Forward
        Steps and model.
    at_state, car_at
        Process noise as a function of the state before the step, and its parameters, or None.
    at_prior, car_of
        Measurement noise as a function of the predicted state, and its parameters, or None.
    setting : Setting
        Rules and gate.
    tape : Tape
        Written at the samples of ``halves``.
    y, u : array
        Measurements (T, m, B) and inputs (T, p, B).
    scratch : tuple
        See `forward_scratch`.
    halves : tuple[int, int]
        First half-step, and the one after the last.
    first, end : int
        Range of sequences.
    """
    car = calls.car
    rules = setting.rules
    (drawn, lost, process_noise_scratch, observation_noise_scratch) = scratch
    for half in range(halves[0], halves[1]):
        k = half // 2
        if half % 2 == 0:
            mean = tape.post_mean[k - 1]
            inputs = u[k - 1]
            calls.points_of(
                mean, tape.post_covariance[k - 1], rules, drawn, tape.repaired[k], first, end
            )
            calls.transition(drawn[0], inputs, car, tape.moved[k], first, end)
            if at_state is None:
                added = noise[0][k - 1]
            else:
                at_state(mean, inputs, car_at, process_noise_scratch, first, end)
                added = process_noise_scratch
            calls.moments_of(
                tape.moved[k],
                added,
                rules,
                tape.prior_mean[k],
                tape.prior_covariance[k],
                first,
                end,
            )
        else:
            mean = tape.prior_mean[k]
            inputs = u[k]
            expected = tape.expected[k]
            repaired = tape.repaired[k]
            calls.points_of(mean, tape.prior_covariance[k], rules, drawn, lost, first, end)
            for b in range(first, end):
                repaired[b] |= lost[b]
            calls.observation(drawn[0], inputs, car, expected, first, end)
            if at_prior is None:
                added = noise[1][k]
            else:
                at_prior(mean, inputs, car_of, observation_noise_scratch, first, end)
                added = observation_noise_scratch
            if setting.gated:
                calls.gate_of(
                    expected,
                    added,
                    rules,
                    setting.limit,
                    setting.patience,
                    y[k],
                    refused,
                    tape.is_gated_out[k],
                    first,
                    end,
                )
            post = tape.post_mean[k], tape.post_covariance[k]
            update_results = (
                tape.innovation[k],
                tape.innovation_covariance[k],
                tape.gain[k],
                tape.centre[k],
            )
            calls.update_of(
                mean,
                drawn,
                expected,
                y[k],
                added,
                rules,
                post,
                update_results,
                repaired,
                first,
                end,
            )


@compiled
def backward(calls, setting, tape, y, u, bars, scratch, gradients, first, end):
    """The adjoint of `forward` over all samples, from the last to the first.

        x̄⁺_k, P̄⁺_k += gradient of the loss by the filtered state of sample k
        x̄_k, P̄_k, X̄, h̄ = update_adjoint;  X̄ += observation adjoint of h̄;  points_adjoint of X̄
        V̄, Q̄ = moments_adjoint of x̄_k, P̄_k;  X̄ = transition adjoint of V̄
        x̄⁺_{k-1}, P̄⁺_{k-1} = points_adjoint of X̄

    Points are drawn again from the tape's states, which costs less than storing them.

    Parameters
    ----------
    calls : Backward
        Steps and the model's adjoints.
    setting : Setting
        As in the forward loop.
    tape : Tape
        As the forward loop left it.
    y, u : array
        Measurements (T, m, B), with NaN where the gate refused one, and inputs (T, p, B).
    bars : tuple
        Gradients of process noise, observation noise and measurements, which are written, and of
        filtered means and covariances.
    scratch : tuple
        See `backward_scratch`.
    gradients
        Those of the model's parameters, to which is added.
    first, end : int
        Range of sequences.
    """
    process_bar, spread_bar, y_bar, mean_up, covariance_up = bars
    (
        drawn,
        lost,
        points_bar,
        through,
        moved_bar,
        expected_bar,
        post_mean_bar,
        post_covariance_bar,
        mean_bar,
        covariance_bar,
    ) = scratch
    car = calls.car
    rules = setting.rules
    points = drawn[0]
    factor = drawn[1]
    _clear(post_mean_bar, first, end)
    _clear(post_covariance_bar, first, end)
    for k in range(len(y) - 1, -1, -1):
        _add(post_mean_bar, mean_up[k], first, end)
        _add(post_covariance_bar, covariance_up[k], first, end)
        mean = tape.prior_mean[k]
        update_results = (
            tape.innovation[k],
            tape.innovation_covariance[k],
            tape.gain[k],
            tape.centre[k],
        )
        calls.points_of(mean, tape.prior_covariance[k], rules, drawn, lost, first, end)
        post_bars = (post_mean_bar, post_covariance_bar)
        prior_bars = (mean_bar, covariance_bar)
        other_bars = points_bar, expected_bar, spread_bar[k], y_bar[k]
        calls.update(
            mean,
            points,
            tape.expected[k],
            y[k],
            rules,
            update_results,
            post_bars,
            prior_bars,
            other_bars,
            first,
            end,
        )
        calls.observation(points, u[k], car, expected_bar, through, gradients, first, end)
        _add(points_bar, through, first, end)
        calls.points(mean, factor, rules, points_bar, mean_bar, covariance_bar, first, end)
        if k == 0:
            break
        calls.moments(
            tape.moved[k],
            rules,
            mean_bar,
            covariance_bar,
            moved_bar,
            process_bar[k - 1],
            first,
            end,
        )
        mean = tape.post_mean[k - 1]
        calls.points_of(mean, tape.post_covariance[k - 1], rules, drawn, lost, first, end)
        calls.transition(points, u[k - 1], car, moved_bar, points_bar, gradients, first, end)
        _clear(post_mean_bar, first, end)
        _clear(post_covariance_bar, first, end)
        calls.points(
            mean, factor, rules, points_bar, post_mean_bar, post_covariance_bar, first, end
        )


@compiled
def _add(total, values, first, end):
    """Add values to an array of the same shape (..., B), for the sequences from ``first`` to
    ``end``.
    """
    rows = total.reshape(-1, total.shape[total.ndim - 1])
    added = values.reshape(-1, total.shape[total.ndim - 1])
    for row in range(rows.shape[0]):
        for b in range(first, end):
            rows[row, b] += added[row, b]


@compiled
def _clear(values, first, end):
    """Set an array (..., B) to zero, for the sequences from ``first`` to ``end``."""
    rows = values.reshape(-1, values.shape[values.ndim - 1])
    for row in range(rows.shape[0]):
        for b in range(first, end):
            rows[row, b] = 0
