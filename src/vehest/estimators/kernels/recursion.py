"""Predictions, gradients and training of compiled recursions over windows, for batched members.

    parameters (M, K), series (T, C), starts (M, B)
    --`Recursion.loop`--> predictions (M, B), gradient (M, K), steps of Adam

A network's module supplies one compiled loop over members and batches; this one calls it on several
threads, each for its own members, without a barrier between the steps of training. Windows lie side
by side in `vehest.lanes`. Order of sums: that of the network's module; members do not mix.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehest.estimators.kernels.compiling import part
from vehest.estimators.kernels.threads import over_members
from vehest.lanes import load, store

Floats = NDArray[Any]  # array of numbers of either precision

DECAYS = (0.9, 0.999)  # β₁ and β₂ of Adam
EPSILON = 1e-8  # ε of Adam


class Recursion(NamedTuple):
    """A network's compiled recursion, with which members predict and are trained.

    Attributes
    ----------
    loop : Callable[..., None]
        ``loop(flat, constants, series, starts, targets, batch, values, gradient, losses, adam)``:
        for each member, a row of every array but ``series``, predictions of its windows in batches.
        Where ``gradient`` (M, K) has rows, it becomes that of Σ targets · values; if ``losses``
        (M,) has, the squared error to the targets is added to it, and the parameters ``flat`` (M,
        K) take a step of Adam after every batch.
    constants : Callable[[Any], tuple[Any, ...]]
        Function of the number type that returns the further arguments of the loop, such as sizes
        and scales.
    """

    loop: Callable[..., None]
    constants: Callable[[Any], tuple[Any, ...]]

    def values(self, flat: Floats, series: Floats, starts: NDArray[np.int64]) -> Floats:
        """Predictions of parameters (M, K) after windows that begin at rows ``starts`` (M, B) of a
        series (T, C), (M, B).
        """
        none = np.empty((0, 0), flat.dtype)
        return self._over(flat, series, starts, none, starts.shape[1], none, np.empty(0))

    def gradient(
        self, flat: Floats, series: Floats, starts: NDArray[np.int64], weights: Floats
    ) -> Floats:
        """Derivatives of the `values`, summed with weights (M, B), by the parameters, (M, K).

        Parameters
        ----------
        flat : Floats
            Parameters, (M, K).
        series : Floats
            Measurements as the network takes them, (T, C).
        starts : NDArray[np.int64]
            First row of each window, (M, B).
        weights : Floats
            Gradient of a loss by each prediction, (M, B).
        """
        gradient = np.empty_like(flat)
        self._over(flat, series, starts, weights, starts.shape[1], gradient, np.empty(0))
        return gradient

    def descend(
        self,
        flat: Floats,
        series: Floats,
        starts: NDArray[np.int64],
        targets: Floats,
        batch: int,
        adam: tuple[Any, ...],
    ) -> Floats:
        """Steps of Adam on mean squared errors, in place.

        Returns sums of squared errors, (M,), float64.

        Parameters
        ----------
        flat : Floats
            Parameters, (M, K).
        series : Floats
            Measurements as the network takes them, (T, C).
        starts : NDArray[np.int64]
            First row of each window in the order of the batches, (M, B).
        targets : Floats
            Values to learn of each, (M, B).
        batch : int
            Windows in a batch.
        adam : tuple[Any, ...]
            Averages of the gradient, of its square and of the parameters, (M, K) each, the last one
            used with averaging alone; least and largest admissible values, (2, K); number of steps
            before these; step size; averaging, see
            `vehest.training.supervised_settings.SupervisedSettings`.
        """
        losses = np.zeros(len(flat))
        self._over(
            flat,
            series,
            starts,
            targets,
            batch,
            np.empty_like(flat),
            losses,
            (*adam[:-1], *DECAYS, EPSILON, adam[-1]),
        )
        return losses

    def _over(
        self,
        flat: Floats,
        series: Floats,
        starts: Any,
        targets: Floats,
        batch: int,
        gradient: Floats,
        losses: Floats,
        adam: Any = None,
    ) -> Floats:
        """Run the loop on all threads; returns predictions, (M, B).

        Members are rows of every array but ``series``; each thread works on a range of them.
        """
        values = np.empty(starts.shape, flat.dtype)
        constants = self.constants(flat.dtype.type)
        if adam is None:
            adam = (flat, flat, flat, flat, *[0.0] * 6)

        def work(m: int, end: int) -> None:
            """Run the loop over the members from ``m`` to ``end``."""
            adam_rows = (*(rows[m:end] for rows in adam[:3]), *adam[3:])
            parts = (
                starts[m:end],
                targets[m:end],
                batch,
                values[m:end],
                gradient[m:end],
                losses[m:end],
                adam_rows,
            )
            self.loop(flat[m:end], constants, series, *parts)

        over_members(work, len(flat))
        return values


@part(_nrt=False)
def gather(series, channels, starts, first, rows, windows, stride):
    """Copy the windows ``first`` and later of a series, (T · channels,), into ``windows``, one a
    lane, as many as fit; a sample has ``stride`` rows of lanes.

    Lanes without a window repeat the last one.
    """
    for lane in range(rows.size):
        rows[lane] = starts[min(first + lane, starts.size - 1)] * channels
    for k in range(windows.size // (stride * rows.size)):
        for c in range(channels):
            at = (k * stride + c) * rows.size
            for lane in range(rows.size):
                windows[at + lane] = series[rows[lane] + k * channels + c]


@part(_nrt=False)
def slopes_of(values, targets, first, squared, scratch):
    """Write the derivatives of the loss by the predictions of a block of lanes into ``scratch``; 0
    in lanes without a window.

    A derivative is 2 (v - target)/B where squared errors are minimised (``squared``), else the
    weight that ``targets`` has.
    """
    count = values.size
    for lane in range(scratch.size):
        at = first + lane
        slope = scratch.dtype.type(0)
        if at < count:
            slope = (
                (values[at] - targets[at]) * scratch.dtype.type(2 / count)
                if squared
                else targets[at]
            )
        scratch[lane] = slope


@part(_nrt=False)
def squared_error(values, targets):
    """Sum of squared errors, in double precision."""
    result = 0.0
    for at in range(values.size):
        error = values[at] - targets[at]
        result += float(error) * float(error)
    return result


@part(_nrt=False)
def step_of_adam(flat, gradient, adam, m, batches):
    """Take step number ``batches`` of this call for member m as `torch.optim.Adam` does, and clip
    the parameters to their bounds.


    Source: Kingma & Ba 2015, Algorithm 1.

    The average of the parameters is θ̄ₜ = (1 − a)/(1 − aᵗ)·Σᵢ aᵗ⁻ⁱ θᵢ over the steps i = 1 … t
    (Section 7.2).
    """
    first, second, average, bounds, before, rate, decay, decay_of_squares, epsilon, averaging = adam
    number = flat.dtype.type
    t = before + batches
    size = number(rate / (1 - decay**t))
    root = number(np.sqrt(1 - decay_of_squares**t))
    for j in range(flat.size):
        g = gradient[j]
        first[m, j] += (g - first[m, j]) * number(1 - decay)
        second[m, j] = second[m, j] * number(decay_of_squares) + g * g * number(
            1 - decay_of_squares
        )
        stepped = flat[j] - size * first[m, j] / (np.sqrt(second[m, j]) / root + number(epsilon))
        flat[j] = min(max(stepped, bounds[0, j]), bounds[1, j])
        if averaging:
            average[m, j] += (flat[j] - average[m, j]) * number(
                (1 - averaging) / (1 - averaging**t)
            )


@part(_nrt=False)
def add(sums, at, value):
    """Add a vector to the lanes of ``sums`` from a place on."""
    store(sums, at, load(sums, at) + value)
