"""The interface that every estimator has, whatever is inside.

Description (description.py)  settings, channels, texts, version
Fittable (fitting.py)         fit, weights
Estimator                     estimates of recordings, online steps

Flow of an estimate: `Estimator.estimate` checks rate, channels and gaps of each recording, makes
the first state from an initial state or the first sample, runs the method over the whole recording
(`run`, or `_estimate_all` where recordings are batched), and wraps the quantities on the
recording's clock. Online, `RunStepper` calls the same `run` with one row at a time, so that both
give the same numbers.

Quantities are in SI units and ISO 8855 axes: x forwards, y to the left, yaw rate and sideslip
positive to the left.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.estimate import Estimate, Mode
from vehest.data.recording import Recording
from vehest.estimators.description import EstimatorSettings, Trial, rate
from vehest.estimators.fitting import (
    FitData,
    Fittable,
    largest_absolute,
    require_learnable,
    require_positive,
    require_shapes,
    require_within_bounds,
)
from vehest.training.context import FitRecord

__all__ = [
    "Estimator",
    "EstimatorSettings",
    "FitData",
    "FitRecord",
    "RunStepper",
    "Stepper",
    "Trial",
    "largest_absolute",
    "rate",
    "require_learnable",
    "require_positive",
    "require_shapes",
    "require_within_bounds",
]


class Stepper(ABC):
    """An estimator that runs along with the drive, one sample after another."""

    # sampling intervals after the sample for which the returned estimate holds
    horizon_steps: int = 0

    @abstractmethod
    def step(self, sample: Mapping[str, float]) -> dict[str, float]:
        """Take the measurements of one instant and return the estimate, quantity -> value.

        ``vy`` [m/s] is always there, NaN while there is no estimate yet. A method that has a
        covariance also returns ``vy_variance`` [m²/s²].

        Parameters
        ----------
        sample : mapping
            Channel -> value [SI]; channels that the method does not read are ignored.

        Raises
        ------
        DataError
            A channel is missing.
        """


class Estimator(Fittable):
    """A method that estimates lateral velocity and sideslip from measured channels."""

    # quantities, in order, whose covariance `run` returns; empty: it returns none
    covariance_of: ClassVar[tuple[str, ...]] = ()
    # whether an initial state is ignored; else it is used, or refused as an error
    ignores_initial_state: ClassVar[bool] = False

    def estimate(
        self,
        recordings: Sequence[Recording],
        initial_state: Mapping[str, float] | Sequence[Mapping[str, float]] | None = None,
    ) -> list[Estimate]:
        """Estimate the lateral velocity of recordings.

        Parameters
        ----------
        recordings : sequence
            At the estimator's rate; their reference channels are not used.
        initial_state : mapping, sequence of mappings or None
            State at the first sample to start from, for all recordings or one a recording, where a
            protocol provides it: ``vy``, ``vx`` [m/s] and ``yaw_rate`` [rad/s], of which a method
            takes those that it has.

        Returns
        -------
        list of Estimate
            One a recording.

        Raises
        ------
        DataError
            A channel is missing, the rate is another, or there are not as many states as
            recordings.
        ConfigurationError
            A state is given and the method cannot start from one.
        """
        if initial_state is None or self.ignores_initial_state:
            states: list[Mapping[str, float] | None] = [None] * len(recordings)
        elif isinstance(initial_state, Mapping):
            states = [initial_state] * len(recordings)
        else:
            states = list(initial_state)
        if len(states) != len(recordings):
            raise DataError(
                f"there are {len(states)} initial states for {len(recordings)} recordings; give "
                "one a recording, or one for all"
            )
        return self._estimate_all([self._checked(recording) for recording in recordings], states)

    def _checked(self, recording: Recording) -> Recording:
        """Check a recording, and return it with only the channels that the method reads.

        Raises
        ------
        DataError
            The rate differs by more than 1e-9, a channel is missing, or one that is not skippable
            has gaps.
        """
        if abs(recording.rate_hz / self.settings.rate_hz - 1.0) > 1e-9:
            raise DataError(
                f"recording '{recording.id}' is sampled at {recording.rate_hz:g} Hz, estimator "
                f"'{self.name}' works at {self.settings.rate_hz:g} Hz; resample it first"
            )
        for name in self.channels:
            if name not in recording:
                raise DataError(
                    f"recording '{recording.id}' has no channel '{name}', which estimator "
                    f"'{self.name}' needs"
                )
            if (
                name in recording.gappy
                and name not in self.skippable
                and np.isnan(recording[name]).any()
            ):
                raise DataError(
                    f"recording '{recording.id}': channel '{name}' has gaps, which estimator "
                    f"'{self.name}' cannot skip"
                )
        return recording.select(self.channels)

    def checked_sample(self, sample: Mapping[str, float]) -> FloatArray:
        """Values of ``channels`` at one instant, (C,), from a sample channel -> value.

        Raises
        ------
        DataError
            A channel is missing, or its value is refused (`refuses`).
        """
        try:
            values = [float(sample[name]) for name in self.channels]
        except KeyError as error:
            raise DataError(
                f"the sample has no channel {error}; it needs {', '.join(self.channels)}"
            ) from None
        if not all(map(math.isfinite, values)):
            for name, value in zip(self.channels, values, strict=True):
                defect = "infinite" if math.isinf(value) else "NaN"
                if (
                    not math.isfinite(value)
                    and defect in self.refuses
                    and not (defect == "NaN" and name in self.skippable)
                ):
                    raise DataError(
                        f"the sample's '{name}' is {value}, which estimator '{self.name}' cannot "
                        "take"
                    )
        return np.array(values)

    def _wrapped(
        self,
        recording: Recording,
        vy: FloatArray,
        covariance: FloatArray | None = None,
        covariance_of: tuple[str, ...] = (),
        **quantities: FloatArray,
    ) -> Estimate:
        """Make an `Estimate` of arrays of quantities, at the recording's times.

        Sideslip is atan2(vy, vx) with the measured vx.
        """
        channels = {"vy": vy, "sideslip": np.arctan2(vy, recording["vx"]), **quantities}
        mode: Mode = "causal" if self.causal else "offline"
        clock = (recording.rate_hz, recording.start_time)
        return Estimate(recording.id, self.name, *clock, channels, mode, covariance, covariance_of)

    def _estimate_all(
        self, recordings: Sequence[Recording], states: Sequence[Mapping[str, float] | None]
    ) -> list[Estimate]:
        """Estimate checked recordings, each from its initial state, one after another.

        A method that can batch recordings overrides this.
        """
        return [
            self.estimate_recording(recording, state)
            for recording, state in zip(recordings, states, strict=True)
        ]

    def first_state(self, sample: FloatArray, initial_state: Mapping[str, float]) -> Any:
        """The method's state before the first sample, for `run`; None where it has no state.

        Parameters
        ----------
        sample : array
            Values of ``channels``, (C,).
        initial_state : mapping
            Known values of ``vy``, ``vx`` [m/s] and ``yaw_rate`` [rad/s]; empty
            otherwise.
        """
        return None

    def run(self, samples: FloatArray, state: Any) -> tuple[dict[str, Any], Any]:
        """Estimate T further samples from a state.

        Parameters
        ----------
        samples : array
            Values of ``channels``, (T, C), T ≥ 1.
        state : any
            That before the first of them.

        Returns
        -------
        tuple
            Quantities of an `Estimate` at the time of each sample, (T,), ``vy`` [m/s] among
            them; perhaps ``covariance``, (T, n, n), of ``covariance_of``, and ``innovations``,
            a function that returns ``nis`` and ``nis_dof``. And the state after the last
            sample.
        """
        raise NotImplementedError(f"{type(self).__name__} has no method 'run'")

    def estimate_recording(
        self, recording: Recording, initial_state: Mapping[str, float] | None
    ) -> Estimate:
        """Estimate a checked recording from a state, or from its first sample."""
        self.require_fitted()
        sample = np.array([recording[name][0] for name in self.channels])
        return self._run_over(recording, self.first_state(sample, dict(initial_state or {})))[0]

    @property
    def continues(self) -> bool:
        """Whether an estimate may continue from the state after the last sample."""
        return self.causal and self._overrides("run") and not self._overrides("_estimate_all")

    def continue_from(self, recording: Recording, state: Any) -> tuple[Estimate, Any]:
        """Estimate a recording from a state, where `continues`.

        Parameters
        ----------
        recording : Recording
            At the estimator's rate.
        state : Any
            After the last sample before the recording, as this method or `run` returned it, or by
            `first_state`.

        Returns
        -------
        tuple
            The estimate, and the state after the last sample.

        Raises
        ------
        DataError
            A channel is missing, or the rate is another.
        ConfigurationError
            The estimator has not been fitted.
        """
        self.require_fitted()
        return self._run_over(self._checked(recording), state)

    def _run_over(self, recording: Recording, state: Any) -> tuple[Estimate, Any]:
        """Apply `run` to a checked recording; returns its estimate and the state after the last
        sample.
        """
        quantities, last_state = self.run(recording.stack(self.channels), state)
        covariance = quantities.pop("covariance", None)
        innovations = quantities.pop("innovations", None)
        if innovations is not None:
            quantities["nis"], quantities["nis_dof"] = innovations()
        estimate = self._wrapped(
            recording,
            quantities.pop("vy"),
            covariance,
            self.covariance_of if covariance is not None else (),
            **quantities,
        )
        return estimate, last_state

    def _overrides(self, method: str) -> bool:
        """Whether a family replaces a method of this class."""
        return getattr(type(self), method) is not getattr(Estimator, method)

    def online(self) -> Stepper:
        """A stepper in its initial state.

        Raises
        ------
        ConfigurationError
            It has not been fitted, or is not causal.
        """
        if not self.causal:
            raise ConfigurationError(self.offline)
        self.require_fitted()
        return RunStepper(self)


class RunStepper(Stepper):
    """Steps an estimator that has `run`, one sample at a time.

    The first sample sets the state; without an initial state the estimate begins as that of a
    recording. Estimates equal those of `Estimator.estimate` on the same samples.
    """

    def __init__(self, estimator: Estimator) -> None:
        self._estimator = estimator
        self._state: Any = None
        self._started = False

    def step(self, sample: Mapping[str, float]) -> dict[str, float]:
        """Take a sample and return all quantities of the estimate at its time, ``vy`` [m/s] among
        them. NaN in skippable channels counts as not measured.
        """
        estimator = self._estimator
        row = estimator.checked_sample(sample)
        state = self._state if self._started else estimator.first_state(row, {})
        quantities, self._state = estimator.run(row[None], state)
        self._started = True
        covariance = quantities.pop("covariance", None)
        _ = quantities.pop("innovations", None)
        values = {name: quantity.item(0) for name, quantity in quantities.items()}
        if covariance is not None:
            row_of_vy = estimator.covariance_of.index("vy")
            values["vy_variance"] = float(covariance[0, row_of_vy, row_of_vy])
        return values
