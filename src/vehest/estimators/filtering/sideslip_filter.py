"""Base of filters of sideslip angle and yaw rate over a single track: settings, the model of a recording, estimates."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.declared import setting
from vehest.estimators.recursive import Recursive
from vehest.filters.gating import Gate
from vehest.filters.gaussian import Gaussian
from vehest.vehicle.parameters import FERRARI_250LM, SingleTrackParameters
from vehest.vehicle.single_track import forward_euler, lateral_acceleration, lateral_dynamics

KNOWN = 1e-6  # rad and rad/s, standard deviation of a state that a protocol hands over


class SampledModel(NamedTuple):
    """The model at the times of T samples: x[k+1] = A[k] x[k] + B[k] δ[k],  a_y[k] = C[k] x[k] + D[k] δ[k].

    Attributes:
        A: (T, 2, 2).
        B: (T, 2).
        C: (T, 2).
        D: (T,).
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray


class FilteredStates(NamedTuple):
    """What a filter knows after T samples.

    Attributes:
        mean: states, sideslip angle [rad] and yaw rate [rad/s] first, (T, n).
        covariance: of sideslip angle and yaw rate, (T, 2, 2).
        innovation: of yaw rate and lateral acceleration in the filter's order, 0 where nothing was measured, (T, 2).
        innovation_covariance: (T, 2, 2).
        measured: bool, (T, 2).
        last: state after the last sample.
        deviation: standard deviations of all states, (T, n), where the filter gives them.
    """

    mean: FloatArray
    covariance: FloatArray
    innovation: FloatArray
    innovation_covariance: FloatArray
    measured: NDArray[np.bool_]
    last: Gaussian[FloatArray]
    deviation: FloatArray | None = None

    def nis(self) -> tuple[FloatArray, FloatArray]:
        """Normalised innovation squared, eᵀS⁻¹e, and how many numbers were measured; (T,) each."""
        (first, both), (_, second) = np.moveaxis(self.innovation_covariance, 0, 2)
        one, other = self.innovation.T
        nis = (second * one**2 - 2.0 * both * one * other + first * other**2) / (first * second - both**2)
        return nis, np.sum(self.measured, axis=1, dtype=np.float64)


class FilterState(NamedTuple):
    """What a filter carries from sample to sample: the last one, which is filtered again without its measurements, and the state after it.

    Attributes:
        sample: values of ``channels``, (C,); none before the first.
        state: after that sample, or before the first.
        refused: how often on end each measurement was refused, see `Gate`.
    """

    sample: FloatArray | None
    state: Gaussian[FloatArray]
    refused: NDArray[np.int64]


class SideslipFilter(Recursive):
    """A filter whose state begins with sideslip angle β and yaw rate r of a single track; v = u tan β."""

    channels = ("yaw_rate", "vx", "ay", "steer")
    skippable = ("yaw_rate", "ay")
    refuses = ("NaN", "infinite")
    covariance_of = ("vy", "yaw_rate")
    car: SingleTrackParameters = setting(FERRARI_250LM, "parameters of the car")
    minimum_speed: float = setting(3.0, "speed below which the model is held at this speed", unit="m/s", positive=True)
    gate: float | None = setting(
        None, "standard deviations of an innovation beyond which a measurement is refused in use; null: all are taken", positive=True
    )

    def sampled_model(self, vx: FloatArray) -> SampledModel:
        """The model at forward speeds vx, (T,) [m/s], discretised by forward Euler."""
        speed = np.maximum(vx, self.minimum_speed)
        dynamics = forward_euler(lateral_dynamics(self.car, speed), 1.0 / self.rate_hz)
        acceleration = lateral_acceleration(self.car, speed)
        return SampledModel(*(part.numpy() for part in (*dynamics, *acceleration)))

    def gate_in_use(self) -> Gate | None:
        """The gate of estimates; numbers are found without, because noise that is too small would close it."""
        return Gate.of(self.gate, self.rate_hz)

    def first_motion(self, sample: FloatArray, deviation: FloatArray, given: Mapping[str, float]) -> Gaussian[FloatArray]:
        """β and r before the first sample: 0 with standard deviations (n ≥ 2), further states too, or what a protocol hands over."""
        mean, variance = np.zeros(len(deviation)), np.square(deviation)
        if "vy" in given:
            mean[0], variance[0] = math.atan2(given["vy"], max(sample[1], self.minimum_speed)), KNOWN**2
        if "yaw_rate" in given:
            mean[1], variance[1] = given["yaw_rate"], KNOWN**2
        return Gaussian(mean, np.diag(variance))

    @abstractmethod
    def first_gaussian(self, sample: FloatArray, given: Mapping[str, float]) -> Gaussian[FloatArray]:
        """State before the first sample; see `first_state`."""

    def filter_samples(
        self, samples: FloatArray, first: Gaussian[FloatArray], gate: Gate | None = None, refused: NDArray[np.int64] | None = None
    ) -> FilteredStates:
        """Filter samples of ``channels``, (T, 4), from a state at the first one before its measurement; ``refused``: see `Gate`."""
        raise NotImplementedError(f"{type(self).__name__} has neither 'filter_samples' nor its own 'run'")

    def quantities(self, states: FloatArray) -> dict[str, FloatArray]:
        """What further states, (T, n), say: name -> (T,)."""
        return {}

    def first_state(self, sample: FloatArray, given: Mapping[str, float]) -> FilterState:
        """State before the first sample, its gate closed."""
        return FilterState(None, self.first_gaussian(sample, given), np.zeros(len(self.skippable), np.int64))

    def run(self, samples: FloatArray, state: FilterState) -> tuple[dict[str, Any], FilterState]:
        """Lateral velocity [m/s], yaw rate [rad/s], their covariances and innovations, and what further states say."""
        rows, refused = samples, state.refused.copy()
        if state.sample is not None:
            rows = np.vstack([state.sample, samples])
            rows[0, [self.channels.index(name) for name in self.skippable]] = np.nan
        found = self.filter_samples(rows, state.state, self.gate_in_use(), refused)
        own = slice(len(rows) - len(samples), None)
        mean, vx = found.mean[own], samples[:, 1]
        tangent = np.tan(mean[:, 0])
        scale = np.stack([vx * (1.0 + tangent**2), np.ones_like(vx)], axis=1)
        values = {
            "vy": vx * tangent,
            "yaw_rate": mean[:, 1].copy(),
            "covariance": found.covariance[own] * scale[:, :, None] * scale[:, None, :],
            "innovations": found.nis,
        }
        return values | self.quantities(mean), FilterState(samples[-1], found.last, refused)
