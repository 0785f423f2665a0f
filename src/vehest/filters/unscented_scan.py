"""The unscented Kalman filter with additive noise over long sequences, by compiled steps and their adjoints.

A model says how its points move and what is expected at them, and the adjoints of both; everything else is here. Of each step only states
and what became of the points are kept, so that long sequences need little memory.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vehest.filters.gating import Gate
from vehest.filters.gaussian import Filtered, Gaussian
from vehest.filters.sigma_points import SigmaRule
from vehest.filters.unscented_steps import gate_of, moments_adjoint, moments_of, points_adjoint, points_of, update_adjoint, update_of

MARGIN = 1e-6
"""Smallest eigenvalue of a repaired covariance, relative to its largest."""
Array = NDArray[Any]
Function = Callable[[Tensor, Tensor], Tensor]
"""Of states (..., n) and inputs (..., p); leading dimensions of both are equal or broadcast."""
NoiseAt = Callable[[Array, Array], Array]
"""Covariances of noise at estimated states, (B, n) under inputs (B, p) -> (B, k, k)."""
Share = Callable[[Callable[[int, int], None], int], None]
"""Calls work(first, end) on stretches of so many sequences, side by side if it likes."""


class NonlinearFiltered(NamedTuple):
    """What a nonlinear filter knows after a sequence.

    Attributes:
        steps: see `Filtered`.
        repaired: bool, (..., T): a covariance had lost its definiteness at this sample, and was repaired or, in a scan without repair,
            made everything from there on NaN.
    """

    steps: Filtered[Tensor]
    repaired: Tensor


class PointModel(ABC):
    """How sigma points move and what is expected at them, with adjoints; arrays of one precision, float32 or float64.

    Attributes:
        parameters: what gradients are wanted for.
        lower: smallest possible value of each state, (n,); none: everything is possible.
    """

    parameters: Sequence[Tensor] = ()
    lower: Sequence[float] | None = None

    def working(self) -> AbstractContextManager[object]:
        """What the methods below are called within, by one thread for all."""
        return nullcontext()

    @abstractmethod
    def transition(self, points: Array, inputs: Array) -> Array:
        """Points one step later, (B, S, n) under inputs (B, p) -> (B, S, n)."""

    @abstractmethod
    def observation(self, points: Array, inputs: Array) -> Array:
        """What is expected at points, (B, S, n) -> (B, S, m)."""

    @abstractmethod
    def transition_adjoint(self, points: Array, inputs: Array, upstream: Array, gradients: Sequence[Array]) -> Array:
        """Gradient of the points, (B, S, n); those of the parameters are added to ``gradients``."""

    @abstractmethod
    def observation_adjoint(self, points: Array, inputs: Array, upstream: Array, gradients: Sequence[Array]) -> Array:
        """Gradient of the points, (B, S, n); those of the parameters are added to ``gradients``."""


class TorchModel(PointModel):
    """A model written in torch, whose adjoints are those of automatic differentiation.

    Args:
        transition: f of points (..., n) and inputs (..., p).
        observation: h of the same, (..., m).
        parameters: leaves that both may use and gradients are wanted for.
        lower: see `PointModel`.
    """

    def __init__(
        self, transition: Function, observation: Function, parameters: Sequence[Tensor] = (), lower: Sequence[float] | None = None
    ) -> None:
        self._transition, self._observation = transition, observation
        self.parameters = [parameter for parameter in parameters if parameter.requires_grad]
        self.lower = lower

    def transition(self, points: Array, inputs: Array) -> Array:
        """By the function."""
        return self._value(self._transition, points, inputs)

    def observation(self, points: Array, inputs: Array) -> Array:
        """By the function."""
        return self._value(self._observation, points, inputs)

    def transition_adjoint(self, points: Array, inputs: Array, upstream: Array, gradients: Sequence[Array]) -> Array:
        """By automatic differentiation."""
        return self._adjoint(self._transition, points, inputs, upstream, gradients)

    def observation_adjoint(self, points: Array, inputs: Array, upstream: Array, gradients: Sequence[Array]) -> Array:
        """By automatic differentiation."""
        return self._adjoint(self._observation, points, inputs, upstream, gradients)

    @staticmethod
    def _value(function: Function, points: Array, inputs: Array) -> Array:
        with torch.no_grad():
            value: Array = function(torch.from_numpy(points), torch.from_numpy(inputs).unsqueeze(-2)).contiguous().numpy()
        return value

    def _adjoint(self, function: Function, points: Array, inputs: Array, upstream: Array, gradients: Sequence[Array]) -> Array:
        with torch.enable_grad():
            state = torch.from_numpy(points).requires_grad_()
            value = function(state, torch.from_numpy(inputs).unsqueeze(-2))
            own = torch.autograd.grad(value, [state, *self.parameters], torch.from_numpy(upstream), allow_unused=True)
        for gradient, part in zip(gradients, own[1:], strict=True):
            if part is not None:
                gradient += part.numpy()
        return np.zeros_like(points) if own[0] is None else np.ascontiguousarray(own[0].numpy())


@dataclass(frozen=True)
class _Setting:
    model: PointModel
    rule: Array
    lower: Array
    margin: Any
    repair: bool
    gate: Gate | None
    limit: Any

    @classmethod
    def of(cls, model: PointModel, rule: SigmaRule, n: int, dtype: Any, repair: bool, gate: Gate | None) -> _Setting:
        lower = np.full(n, -np.inf, dtype) if model.lower is None else np.asarray(model.lower, dtype)
        limit = None if gate is None else dtype(gate.deviations**2)
        return cls(model, np.array(rule, dtype), lower, dtype(MARGIN), repair, gate, limit)


class _Points:
    """Sigma points of sequences, and room for them.

    Attributes:
        values: (B, 2n + 1, n).
        factor: that they are drawn with, (B, n, n).
        lost: whether a covariance was not positive definite, (B,).
        covariance: that they are drawn from, repaired where it had to be, (B, n, n).
    """

    def __init__(self, setting: _Setting, sequences: int, n: int, dtype: Any) -> None:
        self._setting = setting
        self.values, self.factor = np.empty((sequences, 2 * n + 1, n), dtype), np.empty((sequences, n, n), dtype)
        self.lost, self.covariance = np.zeros(sequences, np.bool_), np.empty((sequences, n, n), dtype)

    def draw(self, mean: Array, covariance: Array) -> Array:
        """Points of states."""
        own = self._setting
        self.covariance[:] = covariance
        points_of(mean, self.covariance, own.rule, own.lower, own.margin, own.repair, self.factor, self.values, self.lost)
        return self.values

    def adjoint(self, mean: Array, points_bar: Array, mean_bar: Array, covariance_bar: Array) -> None:
        """Add to the gradients of the states that points were last drawn of."""
        points_adjoint(mean, self.factor, self._setting.rule, self._setting.lower, points_bar, mean_bar, covariance_bar)


class _Tape:
    """What the steps leave behind, sample by sample."""

    def __init__(self, steps: int, sequences: int, n: int, m: int, dtype: Any) -> None:
        def empty(*shape: int) -> Array:
            return np.empty((steps, sequences, *shape), dtype)

        points = 2 * n + 1
        self.prior_mean, self.prior_covariance = empty(n), empty(n, n)
        self.post_mean, self.post_covariance = empty(n), empty(n, n)
        self.moved, self.expected = empty(points, n), empty(points, m)
        self.innovation, self.own, self.gain, self.likelihood, self.centre = empty(m), empty(m, m), empty(n, m), empty(), empty()
        self.repaired, self.gone = np.zeros((steps, sequences), np.bool_), np.zeros((steps, sequences, m), np.bool_)

    def slice(self, first: int, end: int) -> _Tape:
        """The same of some sequences, copied to lie together."""
        part = _Tape.__new__(_Tape)
        for name, values in vars(self).items():
            setattr(part, name, np.ascontiguousarray(values[:, first:end]))
        return part

    def put(self, first: int, end: int, part: _Tape) -> None:
        """Take what was computed for some sequences back."""
        for name, values in vars(part).items():
            getattr(self, name)[:, first:end] = values


def unscented_scan(
    model: PointModel,
    measurements: Tensor,
    inputs: Tensor,
    initial: Gaussian[Tensor],
    process_noise: Tensor | NoiseAt,
    observation_noise: Tensor | NoiseAt,
    rule: SigmaRule,
    *,
    repair: bool = True,
    share: Share | None = None,
    gate: Gate | None = None,
) -> NonlinearFiltered:
    """Filter sequences; filtered means and covariances are differentiable in every tensor but the inputs, the rest is not.

    Sigma points are drawn again before each update. Where a negative weight of the mean point is what takes the definiteness of an update,
    the update goes without it; every other covariance that is not positive definite is lifted.

    Args:
        model: how points move.
        measurements: y, (B, T, m); what is NaN was not measured.
        inputs: u, (B, T, p).
        initial: state at the first sample before its measurement, mean (n,) or (B, n).
        process_noise: Q of each step, (B, T, n, n) or what broadcasts to it; or at the estimated state, without gradients.
        observation_noise: R of each sample, (B, T, m, m) or what broadcasts to it; or at the predicted state, without gradients.
        rule: which sigma points.
        repair: whether covariances that are not positive definite are repaired; otherwise the sequence becomes NaN.
        share: how sequences are shared out over threads; none: one thread.
        gate: which measurements are refused; none: all are taken. The decision itself has no gradient.

    Raises:
        ValueError: shapes do not fit each other.

    Source: Julier & Uhlmann 1997; van der Merwe 2004, Algorithm 3.1; adjoint of the Cholesky factor: Murray 2016, arXiv 1602.07527.
    """
    if measurements.dim() != 3 or not measurements.shape[1]:
        raise ValueError(f"measurements must be of shape (B, T, m) with T > 0, not {tuple(measurements.shape)}")
    if inputs.shape[:-1] != measurements.shape[:-1]:
        raise ValueError(f"inputs of shape {tuple(inputs.shape)} do not fit measurements of shape {tuple(measurements.shape)}")
    sequences, steps, m = measurements.shape
    n = initial.mean.shape[-1]
    try:
        mean, covariance = initial.mean.expand(sequences, n), initial.covariance.expand(sequences, n, n)
    except RuntimeError:
        raise ValueError(f"the initial state, mean {tuple(initial.mean.shape)}, does not fit {sequences} sequences") from None
    dtype = measurements.dtype
    numpy_dtype = np.float32 if dtype == torch.float32 else np.float64
    setting = _Setting.of(model, rule, n, numpy_dtype, repair, gate)
    noises = [process_noise, observation_noise]
    functions = [noise if not isinstance(noise, Tensor) else None for noise in noises]
    tensors = [
        noise.expand(sequences, steps, size, size) if isinstance(noise, Tensor) else measurements.new_empty(0)
        for noise, size in zip(noises, (n, m), strict=True)
    ]
    tape = _Tape(steps, sequences, n, m, numpy_dtype)
    post_mean, post_covariance = _Scan.apply(  # type: ignore[no-untyped-call]
        setting, share or _alone, tape, functions, measurements, inputs, mean, covariance, *tensors, *model.parameters
    )
    outside = [torch.from_numpy(values.swapaxes(0, 1)) for values in (tape.prior_mean, tape.prior_covariance, tape.innovation, tape.own)]
    filtered = Filtered(
        Gaussian(outside[0], outside[1]),
        Gaussian(post_mean.transpose(0, 1), post_covariance.transpose(0, 1)),
        outside[2],
        outside[3],
        ~(torch.isnan(measurements) | torch.from_numpy(tape.gone.swapaxes(0, 1))),
        torch.from_numpy(tape.likelihood.swapaxes(0, 1)),
    )
    return NonlinearFiltered(filtered, torch.from_numpy(tape.repaired.swapaxes(0, 1)))


class UnscentedStepper:
    """The same filter of one sequence, one sample at a time.

    Args:
        model: how points move.
        mean, covariance: of the state at the first sample before its measurement, (n,) and (n, n), of the model's precision.
        measurements: how many there are, m.
        rule: which sigma points.
        repair, gate: see `unscented_scan`.

    Attributes:
        prior: the state before its measurement, mean (n,).
        state: the same after it; both are valid until the next step and may be changed.
        innovation, innovation_covariance, gain: of the last update, (m,), (m, m) and (n, m).
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
        n, dtype = len(mean), mean.dtype.type
        self._setting = _Setting.of(model, rule, n, dtype, repair, gate)
        self._refused = np.zeros((1, measurements), np.int64)
        self._points = _Points(self._setting, 1, n, dtype)
        self._tape = tape = _Tape(1, 1, n, measurements, dtype)
        tape.prior_mean[0], tape.prior_covariance[0] = mean, covariance
        self._inputs: Array | None = None
        self.prior = Gaussian(tape.prior_mean[0, 0], tape.prior_covariance[0, 0])
        self.state = Gaussian(tape.post_mean[0, 0], tape.post_covariance[0, 0])
        self.innovation, self.innovation_covariance, self.gain = tape.innovation[0, 0], tape.own[0, 0], tape.gain[0, 0]

    def step(self, measurement: Array, inputs: Array, process_noise: Array | NoiseAt, observation_noise: Array | NoiseAt) -> Array:
        """The filtered mean, (n,), valid until the next step.

        Args:
            measurement: (m,); what is NaN was not measured.
            inputs: (p,); they act from this sample to the next.
            process_noise: Q of the step that led here, (1, n, n), or as a function of the state before.
            observation_noise: R, (1, m, m), or as a function of the predicted state.
        """
        if self._inputs is not None:
            self.predict(self._inputs, process_noise)
        self.update(measurement, inputs, observation_noise)
        self._inputs = inputs
        return self.state.mean

    def predict(self, inputs: Array, process_noise: Array | NoiseAt) -> None:
        """Move the state to the next sample by inputs of this one."""
        before = self._tape.post_mean[0].copy(), self._tape.post_covariance[0].copy()
        with self._setting.model.working():
            _predict(self._setting, self._tape, 0, self._points, *before, inputs[None], process_noise)

    def update(self, measurement: Array, inputs: Array, observation_noise: Array | NoiseAt) -> None:
        """Take in the measurement."""
        with self._setting.model.working():
            _update(self._setting, self._tape, 0, self._points, measurement[None].copy(), inputs[None], observation_noise, self._refused)


def moved(model: PointModel, states: Tensor, inputs: Tensor) -> Tensor:
    """States one step later, (B, n) under inputs (B, p) -> (B, n), differentiable in the model's parameters alone."""
    after: Tensor = _Moved.apply(model, states, inputs, *model.parameters)  # type: ignore[no-untyped-call]
    return after


class _Moved(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, model: PointModel, states: Tensor, inputs: Tensor, *parameters: Tensor) -> Tensor:
        ctx.kept = (model, states.detach().unsqueeze(1).contiguous().numpy(), inputs.contiguous().numpy())
        with model.working():
            return torch.from_numpy(model.transition(*ctx.kept[1:])[:, 0])

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        model, points, inputs = ctx.kept
        gradients = [np.zeros(tuple(parameter.shape), points.dtype) for parameter in model.parameters]
        with model.working():
            model.transition_adjoint(points, inputs, upstream[0].unsqueeze(1).contiguous().numpy(), gradients)
        return (None, None, None, *(torch.from_numpy(gradient) for gradient in gradients))


class _Scan(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        setting: _Setting,
        share: Share,
        tape: _Tape,
        functions: Sequence[NoiseAt | None],
        measurements: Tensor,
        inputs: Tensor,
        mean: Tensor,
        covariance: Tensor,
        process: Tensor,
        observation: Tensor,
        *parameters: Tensor,
    ) -> tuple[Tensor, Tensor]:
        y, u = _by_time(measurements), _by_time(inputs)
        if setting.gate is not None:
            y = y.copy()  # what is refused becomes NaN in it, and so is never measured for the adjoint either
        first = [tensor.detach().contiguous().numpy() for tensor in (mean, covariance)]
        noises: list[Any] = [
            _by_time(noise) if function is None else function for noise, function in zip((process, observation), functions, strict=True)
        ]

        def work(start: int, end: int) -> None:
            part = tape if end - start == y.shape[1] else tape.slice(start, end)
            own = [noise[:, start:end] if isinstance(noise, np.ndarray) else noise for noise in noises]
            _forward(setting, part, y[:, start:end], u[:, start:end], first[0][start:end], first[1][start:end], own)
            if part is not tape:
                tape.put(start, end, part)

        with setting.model.working():
            share(work, y.shape[1])
        ctx.kept = (setting, share, tape, functions, y, u)
        return torch.from_numpy(tape.post_mean), torch.from_numpy(tape.post_covariance)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        setting, share, tape, functions, y, u = ctx.kept
        if any(function is not None for function in functions):
            raise RuntimeError("noise that is a function of the estimate has no gradients; give it as a tensor")
        steps, sequences, n = tape.post_mean.shape
        m = y.shape[2]
        dtype = y.dtype
        process, observation = np.zeros((steps, sequences, n, n), dtype), np.zeros((steps, sequences, m, m), dtype)
        measured = np.zeros((steps, sequences, m), dtype)
        mean, covariance = np.zeros((sequences, n), dtype), np.zeros((sequences, n, n), dtype)
        mean_up, covariance_up = (np.ascontiguousarray(part.numpy()) for part in upstream)
        gradients: dict[int, list[Array]] = {}

        def work(start: int, end: int) -> None:
            whole = end - start == sequences
            part = tape if whole else tape.slice(start, end)
            own = [np.zeros(tuple(parameter.shape), dtype) for parameter in setting.model.parameters]
            gradients[start] = own
            wanted = (process, observation, measured)
            bars = [piece if whole else np.ascontiguousarray(piece[:, start:end]) for piece in (*wanted, mean_up, covariance_up)]
            data = (y[:, start:end], u[:, start:end])
            mean[start:end], covariance[start:end] = _backward(setting, part, *data, bars, own)
            if not whole:
                for piece, bar in zip(wanted, bars, strict=False):
                    piece[:, start:end] = bar

        with setting.model.working():
            share(work, sequences)
        summed = [torch.from_numpy(np.asarray(sum(parts))) for parts in zip(*(gradients[key] for key in sorted(gradients)), strict=True)]
        y_bar, *noise = (torch.from_numpy(bar).transpose(0, 1) for bar in (measured, process, observation))
        return (None, None, None, None, y_bar, None, torch.from_numpy(mean), torch.from_numpy(covariance), *noise, *summed)


def _forward(
    setting: _Setting,
    tape: _Tape,
    y: Array,
    u: Array,
    mean: Array,
    covariance: Array,
    noises: Sequence[Any],
) -> None:
    refused = np.zeros(y.shape[1:], np.int64)
    points = _Points(setting, len(mean), mean.shape[1], y.dtype)
    for k in range(len(y)):
        now = np.ascontiguousarray(u[k])
        if k == 0:
            tape.prior_mean[0], tape.prior_covariance[0] = mean, covariance
        else:
            before = np.ascontiguousarray(u[k - 1])
            _predict(setting, tape, k, points, tape.post_mean[k - 1], tape.post_covariance[k - 1], before, _noise(noises[0], k - 1))
        seen = np.ascontiguousarray(y[k])
        _update(setting, tape, k, points, seen, now, _noise(noises[1], k), refused)
        if setting.gate is not None:
            y[k] = seen


def _predict(
    setting: _Setting, tape: _Tape, k: int, points: _Points, mean: Array, covariance: Array, inputs: Array, noise: Array | NoiseAt
) -> None:
    """Move states to sample ``k`` of the tape."""
    tape.moved[k] = setting.model.transition(points.draw(mean, covariance), inputs)
    tape.repaired[k] = points.lost
    added = noise if isinstance(noise, np.ndarray) else noise(mean, inputs)
    moments_of(tape.moved[k], added, setting.rule, setting.lower, tape.prior_mean[k], tape.prior_covariance[k])


def _update(
    setting: _Setting,
    tape: _Tape,
    k: int,
    points: _Points,
    y: Array,
    inputs: Array,
    noise: Array | NoiseAt,
    refused: NDArray[np.int64],
) -> None:
    """Take in the measurement at sample ``k`` of the tape; what a gate refuses becomes NaN in ``y``."""
    mean = tape.prior_mean[k]
    tape.expected[k] = setting.model.observation(points.draw(mean, tape.prior_covariance[k]), inputs)
    tape.repaired[k] |= points.lost
    spread = noise if isinstance(noise, np.ndarray) else noise(mean, inputs)
    if setting.gate is not None:
        tape.gone[k] = False
        gate_of(tape.expected[k], spread, setting.rule, setting.limit, setting.gate.patience, y, refused, tape.gone[k])
    update_of(
        mean,
        points.covariance,
        points.values,
        tape.expected[k],
        y,
        spread,
        setting.rule,
        setting.lower,
        setting.margin,
        setting.repair,
        tape.post_mean[k],
        tape.post_covariance[k],
        tape.innovation[k],
        tape.own[k],
        tape.gain[k],
        tape.likelihood[k],
        tape.repaired[k],
        tape.centre[k],
    )


def _backward(
    setting: _Setting,
    tape: _Tape,
    y: Array,
    u: Array,
    bars: Sequence[Array],
    gradients: Sequence[Array],
) -> tuple[Array, Array]:
    """Gradients of the initial mean and covariance; those of noise and measurements are written, those of the parameters added.

    Args:
        bars: gradients of process noise, observation noise and measurements, which are written, and of filtered means and covariances.
    """
    process_bar, observation_bar, y_bar, mean_up, covariance_up = bars
    model, rule, lower = setting.model, setting.rule, setting.lower
    steps, sequences, n = tape.post_mean.shape
    m = y.shape[2]
    points = _Points(setting, sequences, n, y.dtype)
    points_bar, expected_bar = np.empty_like(points.values), np.empty((sequences, 2 * n + 1, m), y.dtype)
    moved_bar = np.empty_like(points.values)
    post_mean_bar, post_covariance_bar = np.zeros((sequences, n), y.dtype), np.zeros((sequences, n, n), y.dtype)
    mean_bar, covariance_bar = np.empty_like(post_mean_bar), np.empty_like(post_covariance_bar)
    for k in range(steps - 1, -1, -1):
        now = np.ascontiguousarray(u[k])
        post_mean_bar += mean_up[k]
        post_covariance_bar += covariance_up[k]
        update_adjoint(
            tape.prior_mean[k],
            points.draw(tape.prior_mean[k], tape.prior_covariance[k]),
            tape.expected[k],
            np.ascontiguousarray(y[k]),
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
            observation_bar[k],
            y_bar[k],
        )
        points_bar += model.observation_adjoint(points.values, now, expected_bar, gradients)
        points.adjoint(tape.prior_mean[k], points_bar, mean_bar, covariance_bar)
        if k == 0:
            break
        moments_adjoint(tape.moved[k], rule, lower, mean_bar, covariance_bar, moved_bar, process_bar[k - 1])
        before = np.ascontiguousarray(u[k - 1])
        points.draw(tape.post_mean[k - 1], tape.post_covariance[k - 1])
        points_bar[:] = model.transition_adjoint(points.values, before, moved_bar, gradients)
        post_mean_bar[:] = 0
        post_covariance_bar[:] = 0
        points.adjoint(tape.post_mean[k - 1], points_bar, post_mean_bar, post_covariance_bar)
    return mean_bar, covariance_bar


def _noise(noise: Any, k: int) -> Array | NoiseAt:
    """That of sample k, or the function that it is."""
    own: Array | NoiseAt = np.ascontiguousarray(noise[k]) if isinstance(noise, np.ndarray) else noise
    return own


def _by_time(tensor: Tensor) -> Array:
    """(B, T, ...) -> (T, B, ...), together in memory."""
    values: Array = tensor.detach().transpose(0, 1).contiguous().numpy()
    return values


def _alone(work: Callable[[int, int], None], sequences: int) -> None:
    work(0, sequences)
