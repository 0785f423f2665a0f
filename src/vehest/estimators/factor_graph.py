"""Factor graph over the linear single track: the FG of Leanza et al. 2021, as in Table VI of Da Lio et al. 2023, on GTSAM."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError, MissingError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.estimators.base import Estimator, FitData, FitRecord, Stepper, Trial
from vehest.estimators.filtering.single_track import (
    SampledModel,
    SingleTrackEstimator,
    SingleTrackSettings,
    checked_sample,
    require_positive,
)
from vehest.filters.gating import Gate, in_words, refuses, suffix
from vehest.filters.gaussian import Gaussian
from vehest.training.context import FitContext


@dataclass(frozen=True)
class FactorNoise:
    """Standard deviations of the factors, per sample at 100 Hz.

    Args:
        model_sideslip: of β one sample later, given β and r [rad].
        model_yaw_rate: of r one sample later, given β and r [rad/s].
        measured_yaw_rate: of r, given the gyroscope [rad/s].
        measured_ay: of a_y as the model has it, given the accelerometer [m/s²].
        first_state: of β and r before the first sample [rad, rad/s].
        window_start: of a window's first β and r, given the running estimate of them [rad, rad/s].
    """

    model_sideslip: float = 4e-3
    model_yaw_rate: float = 9e-3
    measured_yaw_rate: float = 1e-2
    measured_ay: float = 7.0
    first_state: float = 100.0
    window_start: float = 1.0

    def __post_init__(self) -> None:
        require_positive("estimator.noise", asdict(self))


@dataclass(frozen=True)
class FactorGraphSettings(SingleTrackSettings):
    """Settings of the factor graph.

    Args:
        window: how far the graph behind a causal estimate reaches back [s]; none for one graph over the whole recording, offline.
        noise: standard deviations of the factors.
        gate: standard deviations of an innovation beyond which a measurement gets no factor; none: all get one. Only with a window; see
            `Gate`.
    """

    window: float | None = None
    noise: FactorNoise = FactorNoise()
    gate: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.window is not None and not round(self.window * self.rate_hz) >= 1:
            raise ConfigurationError(
                f"estimator.window must be null or at least one sampling interval, {1 / self.rate_hz:g} s, not {self.window} s"
            )
        require_positive("estimator", {"gate": self.gate})
        if self.gate is not None and self.window is None:
            raise ConfigurationError("estimator.gate needs estimator.window: one graph over a whole recording has no sample to predict")

    @property
    def intervals(self) -> int:
        """Sampling intervals that the window spans."""
        return round((self.window or 0.0) * self.rate_hz)


class FactorGraph(SingleTrackEstimator):
    """Factor graph of sideslip angle and yaw rate, solved as a whole or over a window that moves along.

    At each sample a factor on a_y and one on r; between samples one factor for β and one for r. The model is linear given the
    speed, so one Gauss-Newton step from anywhere is exact, and the factors are handed over as linear ones.

    Source: Leanza, Reina & Blanco-Claraco, Sensors 21 (16), 5409, 2021, and the authors' public code, from which the standard
    deviations are. The window's estimate here is that of its newest sample, with that sample's measurements.
    """

    name = "factor_graph"
    title = "Factor graph"
    trials = (
        Trial(
            10,
            "factor graph over half a second, causal; nothing is learnt",
            "estimator.window=0.5 {car}",
        ),
    )
    settings_type = FactorGraphSettings
    settings: FactorGraphSettings

    @property
    def causal(self) -> bool:
        """With a window."""
        return self.settings.window is not None

    @property
    def learns(self) -> bool:
        """Everything is given."""
        return False

    @property
    def variant(self) -> str:
        """Batch, or how long the window is and its gate."""
        return f"factor_graph_lag_{self.settings.window:g}s{suffix(self.settings.gate)}" if self.causal else "factor_graph_batch"

    @property
    def full_title(self) -> str:
        """Title with how it is solved."""
        own = f"fixed lag of {self.settings.window:g} s{in_words(self.settings.gate)}" if self.causal else "batch"
        return f"{self.title}, {own}"

    @property
    def n_parameters(self) -> int:
        """Nothing is fitted."""
        return 0

    @classmethod
    def fit_members(cls, members: Sequence[Estimator], data: FitData, training: Any, context: FitContext) -> list[FitRecord]:
        """Fit nothing; see that GTSAM is there."""
        started = time.monotonic()
        _gtsam()
        return [FitRecord(metrics={"epochs": 0, "train_seconds": (time.monotonic() - started) / len(members)}) for _ in members]

    def _estimate_one(self, recording: Recording, initial_state: Mapping[str, float] | None) -> Estimate:
        samples = recording.stack(self.channels)
        model = self.sampled_model(samples[:, 1])
        first = self.first_state(samples[0, 1], self.settings.noise.first_state, initial_state)
        factors = _Factors(self.settings.noise)
        if not self.causal:
            return self.wrapped_state(recording, _whole(factors, model, samples, first))
        window = _Window(factors, self.settings.intervals, first, Gate.of(self.settings.gate, self.settings.rate_hz))
        states = np.empty((len(samples), 2))
        for k in range(len(samples)):
            between = factors.between(k - 1, model, k - 1, samples[k - 1]) if k > 0 else []
            states[k] = window.add(between, model, k, samples[k])
        return self.wrapped_state(recording, states)

    def online(self) -> FactorGraphStepper:
        """A stepper with an empty window."""
        if not self.causal:
            raise ConfigurationError("a factor graph over a whole recording cannot run along with a drive; set estimator.window=0.05 [s]")
        return FactorGraphStepper(self)

    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """There are none."""
        return {}

    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """See that there are none."""
        if weights:
            raise DataError(f"'factor_graph' has no weights, not {', '.join(weights)}")


class FactorGraphStepper(Stepper):
    """The graph over a moving window, one sample at a time."""

    def __init__(self, estimator: FactorGraph) -> None:
        self._estimator = estimator
        self._factors = _Factors(estimator.settings.noise)
        self._window: _Window | None = None
        self._last: tuple[SampledModel, FloatArray] | None = None
        self._count = 0

    def step(self, sample: Mapping[str, float]) -> dict[str, float]:
        """Lateral velocity [m/s] and yaw rate [rad/s] at the time of the sample; NaN in yaw_rate or ay is skipped."""
        estimator = self._estimator
        row = checked_sample(sample, estimator.channels, estimator.skippable)
        if self._window is None:
            first = estimator.first_state(row[1], estimator.settings.noise.first_state, None)
            gate = Gate.of(estimator.settings.gate, estimator.settings.rate_hz)
            self._window = _Window(self._factors, estimator.settings.intervals, first, gate)
        model = estimator.sampled_model(row[1:2])
        between = self._factors.between(self._count - 1, self._last[0], 0, self._last[1]) if self._last is not None else []
        sideslip, yaw_rate = self._window.add(between, model, 0, row)
        self._last, self._count = (model, row), self._count + 1
        return {"vy": float(row[1] * math.tan(sideslip)), "yaw_rate": float(yaw_rate)}


class _Factors:
    """Makes the graph's factors; β and r of sample k are variables of their own."""

    def __init__(self, noise: FactorNoise) -> None:
        self.gtsam = _gtsam()
        self.noise = noise
        sigmas = {name: self.sigma(value) for name, value in asdict(noise).items()}
        self._step = (sigmas["model_sideslip"], sigmas["model_yaw_rate"])
        self._gyroscope, self._accelerometer = sigmas["measured_yaw_rate"], sigmas["measured_ay"]
        self._one = np.eye(1)

    def keys(self, k: int) -> tuple[int, int]:
        """Variables β and r of sample k."""
        return self.gtsam.symbol("b", k), self.gtsam.symbol("r", k)

    def sigma(self, value: float) -> Any:
        """A factor's noise."""
        return self.gtsam.noiseModel.Isotropic.Sigma(1, value)

    def prior(self, k: int, state: Gaussian[FloatArray]) -> list[Any]:
        """β and r of sample k are known with (independent) uncertainties."""
        deviations = np.sqrt(np.diag(state.covariance))
        return [
            self.gtsam.JacobianFactor(key, self._one, np.array([mean]), self.sigma(deviation))
            for key, mean, deviation in zip(self.keys(k), state.mean, deviations, strict=True)
        ]

    def between(self, k: int, model: SampledModel, row: int, sample: FloatArray) -> list[Any]:
        """From sample k, whose model stands in a row, to k+1: one factor for β, one for r."""
        A, offset = model.A[row], model.B[row] * sample[3]
        now, then = self.keys(k), self.keys(k + 1)
        return [
            self.gtsam.JacobianFactor(
                now[0], -A[i : i + 1, :1], now[1], -A[i : i + 1, 1:], then[i], self._one, offset[i : i + 1], self._step[i]
            )
            for i in (0, 1)
        ]

    def at(self, k: int, model: SampledModel, row: int, sample: FloatArray) -> list[Any]:
        """What was measured at sample k, whose model stands in a row: one factor for r, one for a_y."""
        sideslip, yaw_rate = self.keys(k)
        made = []
        if not np.isnan(sample[0]):
            made.append(self.gtsam.JacobianFactor(yaw_rate, self._one, sample[:1].copy(), self._gyroscope))
        if not np.isnan(sample[2]):
            C, right = model.C[row], sample[2:3] - model.D[row] * sample[3]
            made.append(self.gtsam.JacobianFactor(sideslip, C[:1, None], yaw_rate, C[1:, None], right, self._accelerometer))
        return made

    def solve(self, factors: Sequence[Any], wanted: Sequence[int]) -> FloatArray:
        """The most likely states of these samples, (len(wanted), 2), given all factors."""
        solution = self._graph(factors).optimize()
        return np.array([[solution.at(key)[0] for key in self.keys(k)] for k in wanted])

    def covariance(self, factors: Sequence[Any]) -> FloatArray:
        """Of the last sample's state given all factors, (2, 2)."""
        information, _ = self._graph(factors).hessian()  # rows in the order of the keys: β of all samples, then r
        own = np.eye(len(information))[:, [len(information) // 2 - 1, len(information) - 1]]
        marginal: FloatArray = own.T @ np.linalg.solve(information, own)
        return marginal

    def _graph(self, factors: Sequence[Any]) -> Any:
        graph = self.gtsam.GaussianFactorGraph()
        for factor in factors:
            graph.push_back(factor)
        return graph


def _whole(factors: _Factors, model: SampledModel, samples: FloatArray, first: Gaussian[FloatArray]) -> FloatArray:
    """States given all measurements, (T, 2)."""
    made = factors.prior(0, first)
    for k, sample in enumerate(samples):
        made += factors.at(k, model, k, sample)
        if k + 1 < len(samples):
            made += factors.between(k, model, k, sample)
    return factors.solve(made, range(len(samples)))


class _Kept(NamedTuple):
    """Number of a window's first sample, what is known before it, and factors of each sample: those that lead to it, and its own."""

    first: int
    begin: Gaussian[FloatArray]
    samples: list[tuple[list[Any], list[Any]]]


class _Window:
    """The factors of the newest samples, and the running estimate of where they begin; a sample that fails changes nothing."""

    def __init__(self, factors: _Factors, intervals: int, first: Gaussian[FloatArray], gate: Gate | None) -> None:
        self._factors = factors
        self._intervals = intervals
        self._gate = gate
        self._kept = _Kept(0, first, [])
        self._second = first.mean
        self._refused = np.zeros(2, np.int64)

    def add(self, between: list[Any], model: SampledModel, row: int, sample: FloatArray) -> FloatArray:
        """Take a sample, whose model stands in a row; ``between``: factors from the one before to it. Returns its β and r."""
        refused = self._refused.copy()
        if self._gate is not None:
            sample = self._gated(self._gate, self._with(between, []), model, row, sample, refused)
        last = self._kept.first + len(self._kept.samples)
        kept = self._with(between, self._factors.at(last, model, row, sample))
        second, newest = self._factors.solve(self._made(kept), (min(kept.first + 1, last), last))
        self._kept, self._second, self._refused = kept, second, refused
        return newest

    def _with(self, between: list[Any], at: list[Any]) -> _Kept:
        """What is kept once there is a sample more, of which these factors are."""
        first, begin, samples = self._kept
        samples = [*samples, (between, at)]
        if len(samples) <= self._intervals + 1:
            return _Kept(first, begin, samples)
        deviation = self._factors.noise.window_start
        return _Kept(first + 1, Gaussian(self._second, np.diag([deviation**2, deviation**2])), samples[1:])

    def _made(self, kept: _Kept) -> list[Any]:
        made = self._factors.prior(kept.first, kept.begin)
        for position, (leading_here, measured) in enumerate(kept.samples):
            made += [*leading_here, *measured] if position > 0 else measured
        return made

    def _gated(
        self, gate: Gate, before: _Kept, model: SampledModel, row: int, sample: FloatArray, refused: NDArray[np.int64]
    ) -> FloatArray:
        """The sample with NaN where it is too far from what the graph without its measurements expects."""
        made = self._made(before)
        (state,), covariance = self._factors.solve(made, (before.first + len(before.samples) - 1,)), self._factors.covariance(made)
        noise, left = self._factors.noise, sample.copy()
        for i, (column, slope, offset, own) in enumerate(
            (
                (0, np.array([0.0, 1.0]), 0.0, noise.measured_yaw_rate),
                (2, model.C[row], model.D[row] * sample[3], noise.measured_ay),
            )
        ):
            error, variance = sample[column] - offset - slope @ state, slope @ covariance @ slope + own**2
            if not np.isnan(error) and refuses(error, variance, gate.deviations**2, gate.patience, refused, i):
                left[column] = np.nan
        return left


def _gtsam() -> ModuleType:
    try:
        import gtsam
    except ImportError:
        raise MissingError("estimator 'factor_graph' needs the package gtsam; pip install 'vehest[factor-graph]'") from None
    module: ModuleType = gtsam
    return module


ESTIMATOR = FactorGraph
