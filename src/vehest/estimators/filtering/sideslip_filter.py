"""Base of filters of sideslip angle and yaw rate over a single track.

    samples (T, 4), `FilterState` --filter_samples--> `FilteredStates` --run--> vy, r, covariances

A subclass filters (`filter_samples`) and starts (`first_gaussian`). Between calls the last sample
is kept and filtered again without its measurements, since its inputs lead to the next one.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.declared import setting
from vehest.estimators.filtering.gated import GatedFilter
from vehest.estimators.recursive import Recursive
from vehest.filters.gating import Gate
from vehest.filters.gaussian import Gaussian
from vehest.filters.noise_levels import high_passed_level
from vehest.vehicle.parameters import FERRARI_250LM, SingleTrackParameters
from vehest.vehicle.single_track import LateralModel, lateral_model

MEASURED = [0, 2]  # indices of yaw rate and lateral acceleration among the channels
# rad and rad/s, standard deviation of a state that a protocol passes
EXACT_STATE_DEVIATION = 1e-6


class FilteredStates(NamedTuple):
    """Result of a filter over T samples."""

    mean: FloatArray  # states, sideslip angle [rad] and yaw rate [rad/s] first, (T, n)
    # standard deviations of all states, (T, n), where the filter gives them
    deviation: FloatArray | None
    covariance: FloatArray  # covariance of sideslip angle and yaw rate, (T, 2, 2)
    # innovation of yaw rate and lateral acceleration in the filter's order, (T, 2), 0 where nothing
    # was measured
    innovation: FloatArray
    innovation_covariance: FloatArray  # covariance of the innovations, (T, 2, 2)
    measured: NDArray[np.bool_]  # whether each of both was measured and not refused, (T, 2)
    last: Gaussian[FloatArray]  # state after the last sample

    def nis(self, rows: slice = slice(None)) -> tuple[FloatArray, FloatArray]:
        """Normalised innovation squared, eᵀS⁻¹e, and number of measurements, (T,) each."""
        (first_variance, covariance), (_, second_variance) = np.moveaxis(
            self.innovation_covariance[rows], 0, 2
        )
        first_error, second_error = self.innovation[rows].T
        nis = (
            second_variance * first_error**2
            - 2.0 * covariance * first_error * second_error
            + first_variance * second_error**2
        ) / (first_variance * second_variance - covariance**2)
        return nis, np.sum(self.measured[rows], axis=1, dtype=np.float64)


class FilterState(NamedTuple):
    """State of a filter between calls.

    The last sample is filtered again without its measurements.
    """

    sample: FloatArray | None  # values of ``channels``, (C,); none before the first
    state: Gaussian[FloatArray]  # after that sample, or before the first
    # number of times in a row that yaw rate and lateral acceleration were refused, (2,), see `Gate`
    refused: NDArray[np.int64]


class SideslipFilter(GatedFilter, Recursive):
    """A filter whose state begins with sideslip angle β and yaw rate r; v = u tan β."""

    channels = ("yaw_rate", "vx", "ay", "steer")
    skippable = ("yaw_rate", "ay")
    refuses = ("NaN", "infinite")
    covariance_of = ("vy", "yaw_rate")
    car: SingleTrackParameters = setting(
        FERRARI_250LM, "Ferrari 250 LM, from the authors' code; replace by your car's parameters"
    )
    minimum_speed: float = setting(
        3.0, "speed below which the model is held at this speed", unit="m/s", positive=True
    )

    def sampled_model(self, vx: FloatArray) -> LateralModel:
        """The single-track model in discrete time at forward speeds vx, (T,) [m/s].

        x[k+1] = A[k] x[k] + B[k] δ[k], a_y[k] = C[k] x[k] + D[k] δ[k].
        """
        return lateral_model(self.car, np.maximum(vx, self.minimum_speed)).in_steps(
            1.0 / self.rate_hz
        )

    def first_motion(
        self, sample: FloatArray, deviation: FloatArray, initial_state: Mapping[str, float]
    ) -> Gaussian[FloatArray]:
        """Mean and covariance of the state before the first sample, β [rad] and r [rad/s] first.

        The mean is 0 with the standard deviations ``deviation``, (n,), n ≥ 2; a known initial state
        replaces that of β and r.
        """
        mean = np.zeros(len(deviation))
        variance = np.square(deviation)
        if "vy" in initial_state:
            mean[0] = math.atan2(initial_state["vy"], max(sample[1], self.minimum_speed))
            variance[0] = EXACT_STATE_DEVIATION**2
        if "yaw_rate" in initial_state:
            mean[1] = initial_state["yaw_rate"]
            variance[1] = EXACT_STATE_DEVIATION**2
        return Gaussian(mean, np.diag(variance))

    @abstractmethod
    def first_gaussian(
        self, sample: FloatArray, initial_state: Mapping[str, float]
    ) -> Gaussian[FloatArray]:
        """Mean and covariance of the state before the first sample; arguments as of
        `Estimator.first_state`.
        """

    def filter_samples(
        self,
        samples: FloatArray,
        first: Gaussian[FloatArray],
        gate: Gate | None = None,
        refused: NDArray[np.int64] | None = None,
    ) -> FilteredStates:
        """Filter samples of ``channels``, (T, 4).

        ``first`` is the state before the first measurement; ``refused``: see `Gate`.

        Parameters
        ----------
        samples : array
            Yaw rate [rad/s], vx [m/s], ay [m/s²] and road-wheel angle [rad]; NaN in the first and
            third was not measured.
        first : Gaussian
            Mean (n,) and covariance (n, n).
        gate : Gate, optional
            Which measurements are refused.
        refused : array, optional
            Counters of the gate, (2,), changed in place.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has neither 'filter_samples' nor its own 'run'"
        )

    def quantities(self, states: FloatArray) -> dict[str, FloatArray]:
        """Quantities of an `Estimate` that follow from states beyond β and r: name -> (T,).

        ``states`` are all states, (T, n).
        """
        return {}

    def first_state(self, sample: FloatArray, initial_state: Mapping[str, float]) -> FilterState:
        """State before the first sample, at which the gate has refused nothing."""
        return FilterState(
            None,
            self.first_gaussian(sample, initial_state),
            np.zeros(len(self.skippable), np.int64),
        )

    def run(self, samples: FloatArray, state: FilterState) -> tuple[dict[str, Any], FilterState]:
        """Lateral velocity [m/s], yaw rate [rad/s], covariances, innovations, other quantities.

        The covariance of (β, r) becomes that of (v, r) by the slope ∂v/∂β = u (1 + tan² β).
        """
        rows = samples
        refused = state.refused.copy()
        if state.sample is not None:
            rows = np.empty((len(samples) + 1, len(self.channels)))
            rows[0] = state.sample
            rows[1:] = samples
            rows[0, MEASURED] = np.nan
        filtered = self.filter_samples(rows, state.state, self.gate_in_use(), refused)
        new_rows = slice(len(rows) - len(samples), None)
        mean = filtered.mean[new_rows]
        vx = samples[:, 1]
        tangent = np.tan(mean[:, 0])
        scale = np.ones((len(samples), 2))
        scale[:, 0] = vx * (1.0 + tangent**2)
        values = {
            "vy": vx * tangent,
            "yaw_rate": mean[:, 1].copy(),
            "covariance": filtered.covariance[new_rows] * scale[:, :, None] * scale[:, None, :],
            "innovations": partial(filtered.nis, new_rows),
        }
        return values | self.quantities(mean), FilterState(samples[-1], filtered.last, refused)


def read_levels(
    recordings: Sequence[Recording], names: Sequence[str], cutoff: float, min_level: float = 0.0
) -> dict[str, float]:
    """Noise levels of measured channels: name -> standard deviation above a frequency, over all
    recordings.

    Parameters
    ----------
    recordings : sequence of Recording
        Recordings, whose samples are taken together.
    names : sequence of str
        Channels.
    cutoff : float
        As a fraction of the Nyquist frequency, see `high_passed_level`.
    min_level : float
        A level has to exceed it to be noise, in the channel's unit.

    Raises
    ------
    DataError
        A channel has too many gaps, or no noise.
    """
    label = (
        f"recording{'s' if len(recordings) > 1 else ''} "
        f"{', '.join(repr(recording.id) for recording in recordings)}"
    )
    levels = {}
    for name in names:
        try:
            levels[name] = high_passed_level([recording[name] for recording in recordings], cutoff)
        except ValueError as error:
            raise DataError(
                f"{label}: channel '{name}': {error}; give estimator.noise.{name}"
            ) from None
        if not levels[name] > min_level:
            raise DataError(
                f"{label}: channel '{name}' has no noise that could be read off it; give "
                f"estimator.noise.{name}"
            )
    return levels
