"""The unscented Kalman filter with additive noise over long sequences, by compiled steps and their
adjoints.

    x[k+1] = f(x[k], u[k]) + w[k],  w ~ N(0, Q)
    y[k]   = h(x[k], u[k]) + v[k],  v ~ N(0, R)

Flow: `unscented_scan` receives tensors (B, T, ...), copies them to (T, ..., B), runs the loop
`forward` of `unscented_loops`, which fills a `Tape`, and returns the tape's values by sequence. Its
gradient runs the loop `backward` over the same tape. `UnscentedStepper` runs the same loop for one
sample at a time.

A `PointModel` provides f, h and their adjoints. The tape contains states and moved points only, so
that long sequences need little memory.

Source: Julier & Uhlmann 1997; van der Merwe 2004, Algorithm 3.1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from numba import config
from numpy.typing import NDArray
from torch import Tensor

from vehest.filters.gating import Gate
from vehest.filters.gaussian import Filtered, Gaussian
from vehest.filters.sigma_points import SigmaRule
from vehest.filters.unscented_loops import (
    BACKWARD,
    FORWARD,
    Backward,
    Forward,
    Setting,
    Tape,
    backward,
    backward_scratch,
    by_address,
    forward,
    forward_scratch,
    steps_by_address,
    tape_of,
)
from vehest.filters.unscented_steps import room

MIN_EIGENVALUE_SHARE = 1e-6
"""Smallest eigenvalue of a repaired covariance, relative to its largest."""
Array = NDArray[Any]  # array of numbers of either precision
Function = Callable[[Tensor, Tensor], Tensor]
"""Function of states (..., n) and inputs (..., p), whose leading dimensions are equal or broadcast:
the transition f or the observation h.
"""
Share = Callable[[Callable[[int, int], None], int], None]
"""Function of ``work`` and a number of sequences that calls ``work(first, end)`` on ranges of
these, perhaps on several threads.
"""


class NonlinearFiltered(NamedTuple):
    """Result of a nonlinear filter over a sequence."""

    steps: Filtered[Tensor]  # states and innovations at each sample
    # bool, (..., T): a covariance had lost its definiteness at this sample, and was repaired or, in
    # a scan without repair, made everything from there on NaN
    repaired: Tensor


class PointModel:
    """How sigma points move and what is expected at them, with adjoints; arrays of one precision,
    float32 or float64.

    Entries are transition and observation, called with (points, inputs, car, out, first, end), and
    their adjoints, called with (points, inputs, car, upstream, out, gradients, first, end), which
    add to the gradients of parameters. Sequences lie side by side in points (S, n, B), inputs (p,
    B), what is expected (S, m, B) and gradients, each followed by room for a vector; ``out`` is
    written from ``first`` to ``end``. Where gradients are computed, inputs have ``scratch_rows``
    more rows for each point, in which entries may store numbers for their adjoints.
    """

    # transition, observation, adjoint of the transition, adjoint of the observation
    entries: Sequence[Any]
    car: Any = None  # numbers of the model, passed to all entries
    is_compiled = (
        False  # whether the entries are, so that the loop over samples runs without Python
    )
    scratch_rows = 0  # rows of inputs for each point in which entries store numbers
    parameters: Sequence[Tensor] = ()  # tensors by which gradients are computed
    # smallest possible value of each state, (n,); none: everything is possible
    lower: Sequence[float] | None = None

    def working(self) -> AbstractContextManager[object]:
        """Context within which the entries are called; one thread enters it for all."""
        return nullcontext()

    def learnt(self, gradients: Sequence[Array]) -> tuple[Any, ...]:
        """The arrays for the gradients of the parameters, in the form that the adjoints take."""
        return tuple(gradients)


class TorchModel(PointModel):
    """A model written in torch, whose adjoints are those of automatic differentiation.

    Parameters
    ----------
    transition : Function
        f of points (..., n) and inputs (..., p).
    observation : Function
        h of the same, (..., m).
    parameters : Sequence[Tensor], default ()
        Leaves that both may use; those that require a gradient receive one.
    lower : Sequence[float] | None, default None
        See `PointModel`.
    """

    def __init__(
        self,
        transition: Function,
        observation: Function,
        parameters: Sequence[Tensor] = (),
        lower: Sequence[float] | None = None,
    ) -> None:
        self.parameters = [parameter for parameter in parameters if parameter.requires_grad]
        self.lower = lower
        self.entries = [
            partial(method, function)
            for method in (self._value, self._adjoint)
            for function in (transition, observation)
        ]

    @staticmethod
    def _value(
        function: Function, points: Array, inputs: Array, car: Any, out: Array, first: int, end: int
    ) -> None:
        """Write f or h of the points of some sequences; ``function`` is bound by the
        constructor.
        """
        with torch.no_grad():
            value = function(*_of_torch(points, inputs, first, end))
        out[..., first:end] = value.movedim(0, -1).numpy()

    def _adjoint(
        self,
        function: Function,
        points: Array,
        inputs: Array,
        car: Any,
        up: Array,
        out: Array,
        gradients: Sequence[Array],
        *ends: int,
    ) -> None:
        """Write the gradient of the points, and add to those of the parameters.

        ``up`` is the gradient of what ``function`` returned, (S, ..., B). The function is evaluated
        again, since nothing of the forward pass was stored.
        """
        with torch.enable_grad():
            state, input_tensor = _of_torch(points, inputs, *ends)
            upstream = torch.from_numpy(sequences_first(up, *ends))
            leaf_gradients = torch.autograd.grad(
                function(state.requires_grad_(), input_tensor),
                [state, *self.parameters],
                upstream,
                allow_unused=True,
                materialize_grads=True,
            )
        for gradient, part in zip(gradients, leaf_gradients[1:], strict=True):
            gradient += part.numpy()
        out[..., slice(*ends)] = leaf_gradients[0].movedim(0, -1).numpy()


def _of_torch(points: Array, inputs: Array, first: int, end: int) -> tuple[Tensor, Tensor]:
    """Points (B, S, n) and inputs (B, 1, p) of some sequences as tensors, which share no memory
    with the arrays.
    """
    return torch.from_numpy(sequences_first(points, first, end)), torch.from_numpy(
        sequences_first(inputs, first, end)
    ).unsqueeze(-2)


@dataclass(frozen=True, eq=False)
class CompiledNoise:
    """Covariances of noise at estimated states."""

    # called with (states (n, B), inputs (p, B), car, out, first, end), compiled where the model is;
    # writes covariances (k, k, B)
    entry: Any
    car: tuple[Any, ...]  # numbers of the noise model, passed to ``entry``


StepNoise = Array | CompiledNoise
"""Covariance of noise at one sample: an array (1, k, k), or a function of the state."""


def _setting(
    model: PointModel, rule: SigmaRule, n: int, dtype: Any, repair: bool, gate: Gate | None
) -> Setting:
    """The loop's `Setting` for a model and a precision; without a gate its limit is 0 and not
    used.
    """
    lower = np.full(n, -np.inf, dtype) if model.lower is None else np.asarray(model.lower, dtype)
    limit, patience = (0.0, 0) if gate is None else (gate.deviations**2, gate.patience)
    return Setting(
        (np.array(rule, dtype), lower, dtype(MIN_EIGENVALUE_SHARE), repair),
        gate is not None,
        dtype(limit),
        patience,
    )


def unscented_scan(
    model: PointModel,
    measurements: Tensor,
    inputs: Tensor,
    initial: Gaussian[Tensor],
    process_noise: Tensor | CompiledNoise,
    observation_noise: Tensor | CompiledNoise,
    rule: SigmaRule,
    *,
    repair: bool = True,
    share: Share | None = None,
    gate: Gate | None = None,
) -> NonlinearFiltered:
    """Filter sequences; filtered means and covariances are differentiable in every tensor but the
    inputs, the rest is not.

    Sigma points are drawn again before each update. Where a negative weight of the mean point is
    what takes the definiteness of an update, the update goes without it; every other covariance
    that is not positive definite is lifted.

    Parameters
    ----------
    model : PointModel
        How points move.
    measurements : Tensor
        y, (B, T, m); what is NaN was not measured.
    inputs : Tensor
        u, (B, T, p).
    initial : Gaussian[Tensor]
        State at the first sample before its measurement, mean (n,) or (B, n).
    process_noise : Tensor | CompiledNoise
        Q of each step, (B, T, n, n) or what broadcasts to it; or at the estimated state, without
        gradients.
    observation_noise : Tensor | CompiledNoise
        R of each sample, (B, T, m, m) or what broadcasts to it; or at the predicted state, without
        gradients.
    rule : SigmaRule
        Which sigma points.
    repair : bool, default True
        Whether covariances that are not positive definite are repaired; otherwise the sequence
        becomes NaN.
    share : Share | None, default None
        How sequences are shared out over threads; none: one thread.
    gate : Gate | None, default None
        Which measurements are refused; none: all are taken. The decision itself has no gradient.

    Returns
    -------
    NonlinearFiltered
        Predicted and filtered states (B, T, n), innovations (B, T, m), which measurements were
        used, and where a covariance was repaired, in the precision of the measurements.

    Raises
    ------
    ValueError
        Shapes do not fit each other.

    Source: Julier & Uhlmann 1997; van der Merwe 2004, Algorithm 3.1; adjoint of the Cholesky
    factor: Murray 2016, arXiv 1602.07527.
    """
    if measurements.dim() != 3 or not measurements.shape[1]:
        raise ValueError(
            f"measurements must be of shape (B, T, m) with T > 0, not {tuple(measurements.shape)}"
        )
    if inputs.shape[:-1] != measurements.shape[:-1]:
        raise ValueError(
            f"inputs of shape {tuple(inputs.shape)} do not fit measurements of shape "
            f"{tuple(measurements.shape)}"
        )
    sequences, steps, m = measurements.shape
    n = initial.mean.shape[-1]
    try:
        mean = initial.mean.expand(sequences, n)
        covariance = initial.covariance.expand(sequences, n, n)
    except RuntimeError:
        raise ValueError(
            f"the initial state, mean {tuple(initial.mean.shape)}, does not fit {sequences} "
            "sequences"
        ) from None
    dtype = np.float32 if measurements.dtype == torch.float32 else np.float64
    setting = _setting(model, rule, n, dtype, repair, gate)
    noises = [process_noise, observation_noise]
    functions = [noise if not isinstance(noise, Tensor) else None for noise in noises]
    tensors = [
        noise.expand(sequences, steps, size, size)
        if isinstance(noise, Tensor)
        else measurements.new_empty(0, 0, 0, 0)
        for noise, size in zip(noises, (n, m), strict=True)
    ]
    tape = tape_of(steps, sequences, n, m, dtype)
    post_mean, post_covariance = _Scan.apply(  # type: ignore[no-untyped-call]
        model,
        setting,
        share or _alone,
        tape,
        functions,
        measurements,
        inputs,
        mean,
        covariance,
        *tensors,
        *model.parameters,
    )
    predictions = (
        tape.prior_mean,
        tape.prior_covariance,
        tape.innovation,
        tape.innovation_covariance,
    )
    prior_mean, prior_covariance, innovation, innovation_covariance = (
        _by_sequence(values) for values in predictions
    )
    measured = ~(torch.isnan(measurements) | _by_sequence(tape.is_gated_out))
    filtered = Filtered(
        Gaussian(prior_mean, prior_covariance),
        Gaussian(post_mean, post_covariance),
        innovation,
        innovation_covariance,
        measured,
    )
    return NonlinearFiltered(filtered, _by_sequence(tape.repaired))


class UnscentedStepper:
    """The unscented filter of one sequence, one sample at a time.

    Digits are those of `unscented_scan` for the same measurements, since both run the same loop.

    Parameters
    ----------
    model : PointModel
        How points move.
    mean, covariance : Array
        Mean and covariance of the state at the first sample before its measurement, (n,) and (n,
        n), of the model's precision.
    measurements : int
        Number m of measured values.
    rule : SigmaRule
        Which sigma points.
    repair, gate
        See `unscented_scan`.

    Attributes
    ----------
    prior
        The state before its measurement, mean (n,).
    state
        The same after it; both are valid until the next step and may be changed.
    innovation, innovation_covariance, gain
        Results of the last update, (m,), (m, m) and (n, m).
    tape : Tape
        Intermediate values of the last half-step, of one sample and one sequence; what the other
        attributes view.
    """

    def __init__(
        self,
        model: PointModel,
        mean: Array,
        covariance: Array,
        measurements: int,
        rule: SigmaRule,
        *,
        repair: bool = True,
        gate: Gate | None = None,
    ) -> None:
        n = len(mean)
        dtype = mean.dtype.type
        self._model = model
        self._setting = _setting(model, rule, n, dtype, repair, gate)
        self._refused = np.zeros((1, measurements), np.int64)
        self.tape = tape = tape_of(1, 1, n, measurements, dtype)
        self.prior = Gaussian(tape.prior_mean[0, :, 0], tape.prior_covariance[0, :, :, 0])
        self.state = Gaussian(tape.post_mean[0, :, 0], tape.post_covariance[0, :, :, 0])
        self.prior.mean[:] = mean
        self.prior.covariance[:] = covariance
        self._inputs: Array | None = None
        self._runs: dict[CompiledNoise | None, Callable[..., None]] = {}
        self._scratch = forward_scratch(tape)
        self.innovation = tape.innovation[0, :, 0]
        self.innovation_covariance = tape.innovation_covariance[0, :, :, 0]
        self.gain = tape.gain[0, :, :, 0]

    def step(
        self,
        measurement: Array,
        inputs: Array,
        process_noise: StepNoise,
        observation_noise: StepNoise,
    ) -> Array:
        """Predict and update by one sample; returns the filtered mean, (n,), valid until the next
        step.

        Parameters
        ----------
        measurement : Array
            (m,); what is NaN was not measured.
        inputs : Array
            (p,); they act from this sample to the next.
        process_noise : StepNoise
            Q of the step that led here, (1, n, n), or at the state before.
        observation_noise : StepNoise
            R, (1, m, m), or at the predicted state.
        """
        if self._inputs is not None:
            self.predict(self._inputs, process_noise)
        self.update(measurement, inputs, observation_noise)
        self._inputs = inputs
        return self.state.mean

    def predict(self, inputs: Array, process_noise: StepNoise) -> None:
        """Move the state to the next sample by inputs of this one.

        Parameters
        ----------
        inputs : Array
            (p,), held from this sample to the next.
        process_noise : StepNoise
            Q, (1, n, n), or at the state.
        """
        self._run(0, self.innovation, inputs, process_noise)

    def update(self, measurement: Array, inputs: Array, observation_noise: StepNoise) -> None:
        """Update the state with a measurement.

        Parameters
        ----------
        measurement : Array
            (m,); NaN where nothing was measured.
        inputs : Array
            (p,), of this sample.
        observation_noise : StepNoise
            R, (1, m, m), or at the predicted state.
        """
        self._run(1, measurement, inputs, observation_noise)

    def _run(self, half: int, measurement: Array, inputs: Array, noise: StepNoise) -> None:
        """Run half-step 0 (prediction) or 1 (update) on the tape of one sample.

        The prediction writes the prior from the state after the last measurement: with one sample
        on the tape, sample k - 1 is sample k itself.
        """
        noise_covariance, at = (
            (noise[0], None)
            if isinstance(noise, np.ndarray)
            else (self.innovation_covariance, noise)
        )
        y, u, noise_covariance = (
            _alone_by_time(part) for part in (measurement, inputs, noise_covariance)
        )
        if at not in self._runs:
            self._runs[at] = _forward_by(self._model, (at, at))
        with self._model.working():
            self._runs[at](
                self._setting,
                self.tape,
                y,
                u,
                (noise_covariance, noise_covariance),
                self._refused,
                self._scratch,
                (half, half + 1),
                0,
                1,
            )


def moved(model: PointModel, states: Tensor, inputs: Tensor) -> Tensor:
    """States one step later, without noise.

    Parameters
    ----------
    model : PointModel
        Whose transition is used.
    states, inputs : Tensor
        (B, n) and (B, p).

    Returns
    -------
    Tensor
        (B, n), differentiable in the model's parameters alone.
    """
    apply: Any = _Moved.apply
    moved_states: Tensor = apply(model, states, inputs, *model.parameters)
    return moved_states


class _Moved(torch.autograd.Function):
    """Autograd function of `moved`: the model's transition, and its adjoint for the parameters."""

    @staticmethod
    def forward(
        ctx: Any, model: PointModel, states: Tensor, inputs: Tensor, *parameters: Tensor
    ) -> Tensor:
        """Run the transition on states as the only sigma point of each sequence."""
        points, inputs_by_time = (_by_time(part.unsqueeze(1)) for part in (states, inputs))
        ctx.forward_values = (model, points, inputs_by_time[0])
        out = room(points.shape, points.dtype)
        with model.working():
            model.entries[0](*ctx.forward_values[1:], model.car, out, 0, len(states))
        return torch.from_numpy(sequences_first(out[0]))

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of the parameters; states and inputs have none."""
        model, points, inputs = ctx.forward_values
        gradients = [
            np.zeros(tuple(parameter.shape), points.dtype) for parameter in model.parameters
        ]
        with model.working():
            adjoint_arguments = (
                _by_time(upstream[0].unsqueeze(1)),
                room(points.shape, points.dtype),
                model.learnt(gradients),
            )
            model.entries[2](points, inputs, model.car, *adjoint_arguments, 0, points.shape[-1])
        return (None, None, None, *(torch.from_numpy(gradient) for gradient in gradients))


class _Scan(torch.autograd.Function):
    """Autograd function of `unscented_scan`.

    Forward copies tensors to arrays by time, runs `forward` of `unscented_loops` for each share of
    the sequences, and returns filtered means and covariances. Backward runs `backward` over the
    same tape. Gradients of parameters are added up over the shares in the order of their first
    sequence.
    """

    @staticmethod
    def forward(
        ctx: Any,
        model: PointModel,
        setting: Setting,
        share: Share,
        tape: Tape,
        functions: Sequence[CompiledNoise | None],
        measurements: Tensor,
        inputs: Tensor,
        mean: Tensor,
        covariance: Tensor,
        process: Tensor,
        observation: Tensor,
        *parameters: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Fill the tape from half-step 1 on, and return filtered means (B, T, n) and covariances.

        Inputs have further rows for what the model saves for its adjoints where gradients are
        needed.
        """
        ctx.set_materialize_grads(False)
        scratch_rows = model.scratch_rows * tape.moved.shape[1] if any(ctx.needs_input_grad) else 0
        y = _by_time(measurements)
        u = _by_time(inputs, scratch_rows)
        noises = (_by_time(process), _by_time(observation))
        tape.prior_mean[0] = sequences_last(mean.detach().numpy())
        tape.prior_covariance[0] = sequences_last(covariance.detach().numpy())
        refused = np.zeros(measurements.shape[::2], np.int64)
        halves = (1, 2 * len(y))
        run = _forward_by(model, functions, (tape, u[0]))
        with model.working():
            share(
                lambda *sequence_range: run(
                    setting,
                    tape,
                    y,
                    u,
                    noises,
                    refused,
                    forward_scratch(tape),
                    halves,
                    *sequence_range,
                ),
                len(measurements),
            )
        ctx.forward_values = (model, setting, share, tape, functions, y, u)
        return _by_sequence(tape.post_mean), _by_sequence(tape.post_covariance)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of measurements, initial state, noise and parameters, in this order of
        arguments.

        Raises `RuntimeError` where noise is a function of the estimate, which has no adjoint.
        """
        model, setting, share, tape, functions, y, u = ctx.forward_values
        if any(function is not None for function in functions):
            raise RuntimeError(
                "noise that is a function of the estimate has no gradients; give it as a tensor"
            )
        noises = [
            room(part.shape, part.dtype)
            for part in (tape.post_covariance, tape.innovation_covariance)
        ]
        noises[0][-1] = 0  # no step leads on from the last sample
        measured, mean, covariance = (
            np.empty_like(part)
            for part in (tape.innovation, tape.post_mean[0], tape.post_covariance[0])
        )
        posts = zip(upstream, (tape.post_mean, tape.post_covariance), strict=True)
        bars = (
            *noises,
            measured,
            *(
                room(own.shape, own.dtype, np.zeros) if part is None else _by_time(part)
                for part, own in posts
            ),
        )
        gradients: dict[int, list[Array]] = {}

        def work(first: int, end: int) -> None:
            """Run the adjoint over sequences ``first`` to ``end`` with gradients of parameters
            of their own.
            """
            gradients[first] = [
                np.zeros(tuple(parameter.shape), y.dtype) for parameter in model.parameters
            ]
            run, parameter_gradients = _backward_by(model, tape, u, gradients[first])
            scratch = backward_scratch(tape)
            run(setting, tape, y, u, bars, scratch, parameter_gradients, first, end)
            mean[:, first:end], covariance[:, :, first:end] = (
                part[..., first:end] for part in scratch[-2:]
            )

        with model.working():
            share(work, y.shape[-1])
        summed = [
            torch.from_numpy(np.asarray(sum(parts)))
            for parts in zip(*(gradients[key] for key in sorted(gradients)), strict=True)
        ]
        y_bar, *noise_bars = (_by_sequence(part) for part in (measured, *noises))
        first_bars = (torch.from_numpy(sequences_first(part)) for part in (mean, covariance))
        return (None, None, None, None, None, y_bar, None, *first_bars, *noise_bars, *summed)


def _forward_by(
    model: PointModel,
    functions: Sequence[CompiledNoise | None],
    like: tuple[Tape, Array] | None = None,
) -> Any:
    """`forward` bound to a model and noise; it is compiled where both are, for arrays like those of
    a tape and inputs (p, B).
    """
    entries = [*model.entries[:2]]
    at_states = [at and at.entry for at in functions]
    loop = getattr(forward, "py_func", forward)
    steps = cast(tuple[Any, ...], FORWARD)
    if like and model.is_compiled and not config.DISABLE_JIT:
        (tape, inputs) = like
        loop = forward
        steps = steps_by_address(FORWARD, like[1].dtype)
        given = (tape.moved[0], inputs, model.car), (tape.post_mean[0], inputs)
        entries = [
            by_address(entry, *given[0], out, 0, 0)
            for entry, out in zip(entries, (tape.moved[0], tape.expected[0]), strict=True)
        ]
        at_states = [
            at and by_address(at.entry, *given[1], at.car, tape.post_covariance[0], 0, 0)
            for at in functions
        ]
    noises = [
        part
        for at, entry in zip(functions, at_states, strict=True)
        for part in (entry, at and at.car)
    ]
    called: list[Any] = [*steps, *entries, model.car]
    return partial(loop, Forward(*called), *noises)


def _backward_by(
    model: PointModel, tape: Tape, u: Array, gradients: Sequence[Array]
) -> tuple[Callable[..., None], Any]:
    """`backward` bound to a model, and the gradients in the form that it takes."""
    parameter_gradients = model.learnt(gradients)
    if not model.is_compiled or config.DISABLE_JIT:
        uncompiled: list[Any] = [*BACKWARD, *model.entries[2:], model.car]
        loop = getattr(backward, "py_func", backward)
        return partial(loop, Backward(*uncompiled)), parameter_gradients
    points = tape.moved[0]
    inputs = u[0]
    models = [
        by_address(entry, points, inputs, model.car, upstream, points, parameter_gradients, 0, 0)
        for entry, upstream in zip(model.entries[2:], (points, tape.expected[0]), strict=True)
    ]
    called: list[Any] = [*steps_by_address(BACKWARD, points.dtype), *models, model.car]
    return partial(backward, Backward(*called)), parameter_gradients


def sequences_last(values: Array) -> Array:
    """Move sequences to the last dimension, (B, ...) -> (..., B), followed by room for a vector."""
    moved = np.moveaxis(values, 0, -1)
    out: Array = room(moved.shape, values.dtype)
    out[:] = moved
    return out


def sequences_first(values: Array, first: int = 0, end: int | None = None) -> Array:
    """Move the sequences ``first`` to ``end`` to the first dimension, (..., B) -> (B, ...), in
    contiguous memory.
    """
    return np.ascontiguousarray(np.moveaxis(values[..., first:end], -1, 0))


def _alone_by_time(values: Array) -> Array:
    """Shape the values of one sequence at one sample, (...), for the loop: (1, ..., 1), followed by
    room for a vector.
    """
    out: Array = room((1, *values.shape, 1), values.dtype)
    out[0, ..., 0] = values
    return out


def _by_time(tensor: Tensor, scratch_rows: int = 0) -> Array:
    """Bring a tensor by sequence into an array by time for the loop, (B, T, p, ...) -> (T, p +
    scratch_rows, ..., B), followed by room for a vector.
    """
    moved = tensor.detach().movedim(0, -1)
    steps, rows, *sizes = moved.shape
    out: Array = room((steps, rows + scratch_rows, *sizes), moved.numpy().dtype)
    torch.from_numpy(out)[:, :rows].copy_(moved)
    return out


def _by_sequence(values: Array) -> Tensor:
    """Bring an array by time back into a tensor by sequence, (T, ..., B) -> (B, T, ...); in memory
    it stays ordered by time.
    """
    return torch.from_numpy(values).movedim(-1, 1).contiguous().transpose(0, 1)


def _alone(work: Callable[[int, int], None], sequences: int) -> None:
    """A `Share` that does all work in the calling thread."""
    work(0, sequences)
