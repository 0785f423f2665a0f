"""The interface that every estimator has, whatever is inside."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.estimate import Estimate
from vehest.data.recording import Recording
from vehest.data.schema import settings_from_config
from vehest.training.context import FitContext


@dataclass(frozen=True)
class EstimatorSettings:
    """What every estimator can be told.

    Args:
        rate_hz: sampling rate it works at [Hz].
    """

    rate_hz: float = 100.0

    def __post_init__(self) -> None:
        if not self.rate_hz > 0:
            raise ConfigurationError(f"estimator.rate_hz must be positive, not {self.rate_hz}")


@dataclass(frozen=True)
class FitData:
    """Recordings to learn from and to stop on, at the estimator's rate, references included."""

    train: Sequence[Recording]
    validation: Sequence[Recording]


@dataclass(frozen=True)
class FitRecord:
    """How a fit went.

    Args:
        history: column -> values, one row an epoch or a search; empty where there is nothing to show.
        metrics: figures such as ``epochs`` and ``train_seconds``.
        interrupted: whether the fit was stopped before it was over.
    """

    history: Mapping[str, Sequence[float]] = field(default_factory=dict)
    metrics: Mapping[str, float] = field(default_factory=dict)
    interrupted: bool = False


class Stepper(ABC):
    """An estimator that runs along with the drive, one sample after another.

    Attributes:
        horizon_steps: how many sampling intervals after the sample the returned estimate holds.
    """

    horizon_steps: ClassVar[int] = 0

    @abstractmethod
    def step(self, sample: Mapping[str, float]) -> dict[str, float]:
        """Take the measurements of one instant [SI], return ``vy`` [m/s]; NaN while there is none yet.

        A method that has a covariance also returns ``vy_variance`` [m²/s²].

        Raises:
            DataError: a channel is missing.
        """


class Estimator(ABC):
    """A method that estimates lateral velocity and sideslip from measured channels.

    Attributes:
        name: name in conf/estimator and in the registry.
        title: name for people.
        channels: measured channels it reads.
        settings_type: dataclass of its settings.
        training_type: dataclass of the settings of its fit.
        skippable: channels of ``channels`` that may have gaps, because the method does without a sample.
        open_weights: weights that may stay NaN, because each recording tells them.
        ignores_initial_state: whether an initial state is left aside; else it is used, or refused as an error.
        version: raised when weights or estimates change; a version of ``training_type`` alone when the fit does.
        preparation: how recordings are brought to its rate before it sees them (method, transforms).
    """

    name: ClassVar[str]
    title: ClassVar[str]
    channels: ClassVar[tuple[str, ...]]
    settings_type: ClassVar[type[EstimatorSettings]]
    training_type: ClassVar[type]
    skippable: ClassVar[tuple[str, ...]] = ()
    open_weights: ClassVar[tuple[str, ...]] = ()
    ignores_initial_state: ClassVar[bool] = False
    version: ClassVar[str] = "1"

    def __init__(self, settings: EstimatorSettings) -> None:
        self.settings = settings
        self.preparation: Mapping[str, Any] = {"method": "polyphase", "transforms": []}

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Estimator:
        """Build one from plain values.

        Raises:
            ConfigurationError: an unknown setting or a value out of range.
        """
        return cls(settings_from_config(cls.settings_type, config, "estimator"))

    @property
    def causal(self) -> bool:
        """Whether an estimate uses measurements up to its own time only; if so, it also runs online."""
        return True

    @property
    def learns(self) -> bool:
        """Whether the fit takes anything from recordings; if not, it needs none."""
        return True

    @property
    def horizon_steps(self) -> int:
        """How many sampling intervals after a sample the estimate made with it holds."""
        return 0

    @property
    def warm_up_steps(self) -> int:
        """Samples after its first for which it has no estimate yet."""
        return 0

    @property
    def variant(self) -> str:
        """What the paper calls this configuration."""
        return self.name

    @property
    def full_title(self) -> str:
        """Title with what distinguishes this configuration, for people."""
        return self.title

    @property
    def batch_key(self) -> tuple[Any, ...]:
        """Estimators with equal keys may be fitted together as members."""
        return (self.name, self.settings)

    @property
    @abstractmethod
    def n_parameters(self) -> int:
        """How many numbers the fit determines."""

    @abstractmethod
    def seed(self, seed: int) -> None:
        """Say which random numbers the next fit starts from and uses."""

    @classmethod
    @abstractmethod
    def fit_members(cls, members: Sequence[Estimator], data: FitData, training: Any, context: FitContext) -> list[FitRecord]:
        """Fit estimators of one ``batch_key`` together, each with the result it would have alone.

        Args:
            members: seeded estimators, changed in place.
            data: recordings at the estimator's rate.
            training: of ``training_type``.
            context: checkpoints, progress, the wish to stop.

        Raises:
            DataError: a channel is missing or the recordings are too short.
        """

    def fit(self, data: FitData, training: Any, context: FitContext | None = None) -> FitRecord:
        """Fit this one alone."""
        return type(self).fit_members([self], data, training, context or FitContext())[0]

    def estimate(
        self, recordings: Sequence[Recording], initial_state: Mapping[str, float] | Sequence[Mapping[str, float]] | None = None
    ) -> list[Estimate]:
        """Estimate the lateral velocity of recordings that carry no reference channels.

        Args:
            recordings: at the estimator's rate.
            initial_state: state at the first sample to start from, where a protocol hands it over openly, for all recordings or one a
                recording: ``vy``, ``vx`` [m/s] and ``yaw_rate`` [rad/s], of which a method takes those that it has.

        Raises:
            DataError: a channel is missing, the rate is another, or there are not as many states as recordings.
            ConfigurationError: a state is given and the method cannot start from one.
        """
        if initial_state is None or self.ignores_initial_state:
            states: list[Mapping[str, float] | None] = [None] * len(recordings)
        elif isinstance(initial_state, Mapping):
            states = [initial_state] * len(recordings)
        else:
            states = list(initial_state)
        if len(states) != len(recordings):
            raise DataError(
                f"there are {len(states)} initial states for {len(recordings)} recordings; give one a recording, or one for all"
            )
        return self._estimate_all([self._checked(recording) for recording in recordings], states)

    def _checked(self, recording: Recording) -> Recording:
        if abs(recording.rate_hz / self.settings.rate_hz - 1.0) > 1e-9:
            raise DataError(
                f"recording '{recording.id}' is sampled at {recording.rate_hz:g} Hz, estimator '{self.name}' works at "
                f"{self.settings.rate_hz:g} Hz; resample it first"
            )
        for name in self.channels:
            if name not in recording:
                raise DataError(f"recording '{recording.id}' has no channel '{name}', which estimator '{self.name}' needs")
            if name in recording.gappy and name not in self.skippable and np.isnan(recording[name]).any():
                raise DataError(f"recording '{recording.id}': channel '{name}' has gaps, which estimator '{self.name}' cannot skip")
        return recording.select(self.channels)

    def _wrapped(
        self,
        recording: Recording,
        vy: FloatArray,
        covariance: FloatArray | None = None,
        covariance_of: tuple[str, ...] = (),
        **others: FloatArray,
    ) -> Estimate:
        """An `Estimate` on the recording's clock; sideslip is atan2(vy, vx) with the measured vx."""
        channels = {"vy": vy, "sideslip": np.arctan2(vy, recording["vx"]), **others}
        mode = "causal" if self.causal else "offline"
        clock = (recording.rate_hz, recording.start_time)
        return Estimate(recording.id, self.name, *clock, channels, mode, covariance, covariance_of)  # type: ignore[arg-type]

    def _estimate_all(self, recordings: Sequence[Recording], states: Sequence[Mapping[str, float] | None]) -> list[Estimate]:
        """Estimate checked recordings, each from its state; one after another, unless a method can do better."""
        return [self._estimate_one(recording, state) for recording, state in zip(recordings, states, strict=True)]

    @abstractmethod
    def _estimate_one(self, recording: Recording, initial_state: Mapping[str, float] | None) -> Estimate:
        """Estimate one checked recording."""

    @abstractmethod
    def online(self) -> Stepper:
        """A stepper in its initial state.

        Raises:
            ConfigurationError: the method is not causal.
        """

    @abstractmethod
    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """Everything the fit determined, by name."""

    @abstractmethod
    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Take weights back.

        Raises:
            DataError: a name or shape does not fit the settings.
        """


def required(sample: Mapping[str, float], channels: Sequence[str]) -> list[float]:
    """Values of the channels in this order.

    Raises:
        DataError: one is missing.
    """
    try:
        return [float(sample[name]) for name in channels]
    except KeyError as error:
        raise DataError(f"the sample has no channel {error}; it needs {', '.join(channels)}") from None
