"""The unscented filter of a single track on Dugoff's tyres, over batches of drives.

Differentiable in measurements and noise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vehest.constants import FloatArray
from vehest.estimators.kernels.dugoff_track import CompiledDugoffTrack
from vehest.estimators.kernels.threads import over_members
from vehest.filters.gating import Gate
from vehest.filters.gaussian import Gaussian
from vehest.filters.sigma_points import symmetric_rule
from vehest.filters.unscented_scan import NonlinearFiltered, PointModel, unscented_scan
from vehest.vehicle.dugoff import TRACK_STATES, DugoffTrack

# how `error_over` combines errors: mean square over all samples, or squared mean of the recordings'
# root mean squares
Over = Literal["samples", "recordings"]
# m/s, rad/s: standard deviations of v and r where they are not given, and of a car that rolls
UNKNOWN_MOTION = (
    0.5,
    0.2,
)
ROLLING = np.diag(np.square(UNKNOWN_MOTION))  # covariance of (v, r) of a car that rolls
EXACT_STATE_DEVIATION = 1e-6  # m/s, rad/s: standard deviation of a state that is given
KAPPA = 1.0  # n + κ = 3


class TrackFilter:
    """Unscented filter of v [m/s] and r [rad/s] over a `DugoffTrack`.

    Measured are `TRACK_MEASUREMENTS`, the last one optional; inputs are forward speed, steering
    angle and ax.

    Where the car is slower than the track's minimum speed, nothing counts as measured, and the
    state is that of rolling wheels, with the deviations `UNKNOWN_MOTION`.

    Parameters
    ----------
    track : DugoffTrack
        Car, tyres and step; it is compiled as the filter's model.
    """

    def __init__(self, track: DugoffTrack) -> None:
        self.track = track
        self.rule = symmetric_rule(len(TRACK_STATES), KAPPA)
        self.model: PointModel = CompiledDugoffTrack(track)

    def filtered(
        self,
        measurements: Tensor,
        inputs: Tensor,
        process_noise: Tensor,
        observation_noise: Tensor,
        initial: Gaussian[Tensor] | None = None,
        gate: Gate | None = None,
    ) -> NonlinearFiltered:
        """Filter sequences of one length.

        Means and covariances are differentiable in measurements and noise.

        Parameters
        ----------
        measurements : Tensor
            (B, T, 4), or (B, T, 5) with a sideslip angle [rad]; NaN where nothing was measured.
        inputs : Tensor
            (B, T, 3), finite.
        process_noise : Tensor
            Covariance of each sample's step, (B, T, 2, 2) or what broadcasts to it.
        observation_noise : Tensor
            (B, T, m, m) or what broadcasts to it.
        initial : Gaussian[Tensor] | None, default None
            State before the first measurement, mean (2,) or (B, 2); none: `start` of every
            sequence.
        gate : Gate | None, default None
            Which measurements are refused; none: all are taken.

        Raises
        ------
        ValueError
            Shapes do not fit each other.
        """
        slow = (inputs[..., 0] < self.track.minimum_speed)[..., None]
        if bool(slow.any()):
            rolling = torch.as_tensor(ROLLING, dtype=inputs.dtype)
            measurements = torch.where(slow, torch.nan, measurements)
            process_noise = torch.where(slow[..., None], rolling, process_noise)
        return unscented_scan(
            self.model,
            measurements,
            inputs,
            self.start(inputs[:, 0]) if initial is None else initial,
            process_noise,
            observation_noise,
            self.rule,
            share=partial(over_members, pieces=1),
            gate=gate,
        )

    def start(
        self, inputs: Tensor, states: Sequence[Mapping[str, float] | None] | None = None
    ) -> Gaussian[Tensor]:
        """State before the first measurement.

        Straight ahead and unknown, rolling where the car is slow, or a known initial state.

        Parameters
        ----------
        inputs : Tensor
            At the first sample, (B, 3).
        states : Sequence[Mapping[str, float] | None] | None, default None
            A mapping a sequence of `TRACK_STATES` that are known.

        Returns
        -------
        Gaussian
            Mean (B, 2) and covariance (B, 2, 2), diagonal, in the precision of the inputs.
        """
        slow = (inputs[:, :1] < self.track.minimum_speed).to(inputs.dtype)
        mean = slow * self.track.rolling(inputs)
        deviation = torch.tensor(UNKNOWN_MOTION, dtype=inputs.dtype).repeat(len(inputs), 1)
        for row, state in enumerate(states or ()):
            for column, name in enumerate(TRACK_STATES):
                if state and name in state:
                    mean[row, column] = state[name]
                    deviation[row, column] = EXACT_STATE_DEVIATION
        return Gaussian(mean, torch.diag_embed(deviation.square()))


def in_nonlinear_range(
    ay: FloatArray, enter: float, leave: float, before: bool = False
) -> NDArray[np.bool_]:
    """Mask (T,) of the samples at which the car behaves non-linearly, with a hysteresis.

    It does from |ay| ≥ ``enter`` on until |ay| ≤ ``leave``, which is smaller. A NaN in ay, (T,)
    [m/s²], changes nothing; ``before`` is the value before the first sample.

    Source: Bertipaglia et al. 2024, Section IV-C, which gives no thresholds.
    """
    size = np.abs(ay)
    change = np.where(size >= enter, 1, np.where(size <= leave, -1, 0))
    last = np.maximum.accumulate(np.where(change != 0, np.arange(len(ay)), -1))
    return np.where(last < 0, before, change[last] > 0)


def error_over(sums: Sequence[tuple[float, int]], over: Over) -> float:
    """Combine the squared errors of several recordings into one figure, for a search of levels.

    ``sums`` has the sum of squared errors and the number of samples of each recording.

    ``samples``: the mean squared error over all samples. ``recordings``: the squared mean of the
    recordings' root mean squared errors, in which a recording counts by its error, not by the
    square of it. Recordings without a sample do not count.
    """
    if over == "samples":
        total = 0.0
        count = 0
        for square, number in sums:
            total = total + square
            count = count + number
        return total / max(count, 1)
    roots = [math.sqrt(square / number) for square, number in sums if number]
    return float(np.mean(roots)) ** 2 if roots else 0.0


def groups_of(lengths: Sequence[int], max_samples: int) -> Iterator[list[int]]:
    """Group sequences by length, so that they can be padded and filtered together.

    Yields the indices of each group, which has at least one sequence, and at most ``max_samples``
    samples when padded if it has more.
    """
    rows: list[int] = []
    for row in sorted(range(len(lengths)), key=lambda index: -lengths[index]):
        if rows and (len(rows) + 1) * lengths[rows[0]] > max_samples:
            yield rows
            rows = []
        rows.append(row)
    if rows:
        yield rows


def padded(arrays: Sequence[FloatArray], fill: float | None) -> FloatArray:
    """Stack arrays (T, n) of different lengths into one, (B, max T, n).

    Shorter ones are filled with ``fill`` or, for None, with their last row.
    """
    longest = max(len(array) for array in arrays)
    return np.stack(
        [
            np.concatenate(
                [
                    array,
                    np.repeat(
                        array[-1:] if fill is None else np.full_like(array[-1:], fill),
                        longest - len(array),
                        axis=0,
                    ),
                ]
            )
            for array in arrays
        ]
    )
