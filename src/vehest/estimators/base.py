"""The interface that every estimator has, whatever is inside."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import Field, dataclass, make_dataclass
from operator import attrgetter
from typing import Any, ClassVar, NamedTuple

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.estimate import Estimate, Mode
from vehest.data.recording import HIGHEST_RATE, Recording
from vehest.data.schema import settings_from_config
from vehest.declared import Declaration, Group, setting
from vehest.training.context import FitContext
from vehest.training.context import FitRecord as FitRecord


def rate(default: float) -> Any:
    """The setting ``rate_hz`` with another default [Hz]."""
    return setting(
        default, "sampling rate it works at", unit="Hz", positive=True, most=HIGHEST_RATE
    )


@dataclass(frozen=True)
class EstimatorSettings(Group):
    """Settings of every estimator."""

    rate_hz: float = rate(100.0)


@dataclass(frozen=True)
class FitData:
    """Recordings to learn from and to stop on, at the estimator's rate, references included."""

    train: Sequence[Recording]
    validation: Sequence[Recording]


def require_learnable(
    recordings: Sequence[Recording],
    channels: Sequence[str],
    estimator: str,
    skippable: Collection[str] = (),
    hints: Mapping[str, str] | None = None,
) -> None:
    """Check that recordings have the channels that an estimator learns from.

    Parameters
    ----------
    recordings : sequence of Recording
        To learn from.
    channels : sequence of str
        Channels that they must have.
    estimator : str
        Its name, for errors.
    skippable : collection of str
        Channels that may have gaps.
    hints : mapping or None
        Channel -> remedy where it is missing.

    Raises
    ------
    DataError
        A channel is missing, or has gaps and is not skippable.
    """
    for recording in recordings:
        for name in channels:
            if name not in recording:
                hint = (hints or {}).get(name, "")
                raise DataError(
                    f"recording '{recording.id}' has no channel '{name}', on which estimator "
                    f"'{estimator}' is trained{hint}"
                )
            if name not in skippable and np.isnan(recording[name]).any():
                raise DataError(
                    f"recording '{recording.id}': channel '{name}' has gaps, on which estimator "
                    f"'{estimator}' cannot be trained; cut them out in conf/split"
                )


def largest_absolute(recordings: Sequence[Recording], channel: str, estimator: str) -> float:
    """Largest absolute value of a channel in recordings; raises `DataError`: it is 0 throughout."""
    largest = max(float(np.abs(recording[channel]).max()) for recording in recordings)
    if not largest > 0.0:
        names = ", ".join(f"'{recording.id}'" for recording in recordings)
        raise DataError(
            f"recordings {names}: channel '{channel}' is 0 throughout, which estimator "
            f"'{estimator}' cannot be trained on; train it on drives with bends"
        )
    return largest


class Trial(NamedTuple):
    """A family in the first comparison on a car without a trained model (`vehest new`)."""

    # among the trials of all families, the promising and cheap first; those that differ in place
    # alone are one sweep
    place: float
    about: str  # text for people
    # of settings and training; ``{wheelbase}`` and ``{mass}`` are those of the car, ``{car}`` all
    # of its parameters that the settings have
    overrides: str = ""
    # that some range for training, and each for validation, has to have at the family's rate
    samples: int = 0


class Stepper(ABC):
    """An estimator that runs along with the drive, one sample after another."""

    # sampling intervals after the sample for which the returned estimate holds
    horizon_steps: int = 0

    @abstractmethod
    def step(self, sample: Mapping[str, float]) -> dict[str, float]:
        """Take the measurements of one instant [SI], return ``vy`` [m/s].

        NaN while there is none yet.

        A method that has a covariance also returns ``vy_variance`` [m²/s²].

        Raises
        ------
        DataError
            A channel is missing.
        """


class Estimator(ABC):
    """A method that estimates lateral velocity and sideslip from measured channels.

    A family declares itself in its class: settings by `setting`, fitted numbers by `fitted`, and
    what follows. Settings are then an attribute of the estimator each, and together ``settings``,
    of the dataclass ``settings_type`` that is made of them. ``preparation`` is how recordings are
    brought to its rate before it sees them (method, transforms), ``trust`` its calibration
    (`vehest.trust.record.Trust`), None without one.
    """

    name: ClassVar[str]  # in conf/estimator and in the registry
    title: ClassVar[str]  # name for people
    channels: ClassVar[tuple[str, ...]]  # measured channels it reads
    settings_type: ClassVar[Any] = EstimatorSettings
    training_type: ClassVar[type]  # dataclass of the settings of its fit
    learns_from: tuple[str, ...] = ("vy_ref",)  # reference channels that its fit reads
    # channels of ``channels`` that may have gaps, because the method does without a sample
    skippable: ClassVar[tuple[str, ...]] = ()
    # measurements of a sample that are errors: ``NaN`` where it is not skippable, ``infinite``
    refuses: ClassVar[tuple[str, ...]] = ()
    # weights that may stay NaN, because each recording tells them
    may_be_nan: ClassVar[tuple[str, ...]] = ()
    covariance_of: ClassVar[tuple[str, ...]] = ()  # quantities that the covariances of `run` are of
    # sampling intervals after a sample for which the estimate made with it holds
    horizon_steps: ClassVar[int] = 0
    # whether an initial state is left aside; else it is used, or refused as an error
    ignores_initial_state: ClassVar[bool] = False
    # whether a fit of several seeds is one computation; else each is a training by itself
    fits_seeds_together: ClassVar[bool] = True
    # ``module:function`` that takes tens of seconds to compile; empty: none
    slow_kernel: ClassVar[str] = ""
    # error of `online` where its settings make it not causal, with those that make it causal
    offline: ClassVar[str] = "an estimator that is not causal cannot run along with a drive"
    # in the first comparison on a new car; none: it is left out
    trials: ClassVar[tuple[Trial, ...]] = ()
    notice: ClassVar[tuple[str, ...]] = ()  # lines for users of the method, such as a patent
    style: ClassVar[tuple[str, str, str] | None] = None  # see `line_style`
    # C template of a step, in ``export/templates/methods`` or beside the family's module; or empty
    template: ClassVar[str] = ""
    # raised when weights or estimates change; a version of ``training_type`` alone when the fit
    # does
    version: ClassVar[str] = "1"

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        declared = {name: value for name, value in vars(cls).items() if isinstance(value, Field)}
        of_bases = dict.fromkeys(
            base.settings_type for base in cls.__bases__ if issubclass(base, Estimator)
        )
        bases = [
            base
            for base in of_bases
            if not any(derived is not base and issubclass(derived, base) for derived in of_bases)
        ]
        if not declared and len(bases) == 1:
            return
        kinds = {name: cls.__annotations__[name] for name in declared}
        optional = [name for name, value in declared.items() if value.default is None]
        kinds |= {
            name: f"{kind} | None" if isinstance(kind := kinds[name], str) else kind | None
            for name in optional
        }
        described = [(name, kind, declared[name]) for name, kind in kinds.items()]
        cls.settings_type = make_dataclass(
            "settings_type", described, bases=tuple(bases), frozen=True
        )
        cls.settings_type.__module__ = cls.__module__
        cls.settings_type.__qualname__ = f"{cls.__qualname__}.settings_type"
        for name in declared:
            setattr(cls, name, property(attrgetter(f"settings.{name}")))

    def __init__(self, settings: Any) -> None:
        self.settings = settings
        self.fit_seed = 0
        self.preparation: Mapping[str, Any] = {"method": "polyphase", "transforms": []}
        self.trust: Any = None
        self.check()

    def check(self) -> None:  # noqa: B027 (most families have nothing to check)
        """Check settings against each other; raises `ConfigurationError` where they do not fit."""

    @property
    def rate_hz(self) -> float:
        """Sampling rate it works at [Hz]."""
        return float(self.settings.rate_hz)

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Estimator:
        """Build an estimator from plain values.

        Raises
        ------
        ConfigurationError
            An unknown setting or a value out of range.
        """
        return cls(settings_from_config(cls.settings_type, config, "estimator"))

    @property
    def causal(self) -> bool:
        """Whether an estimate uses measurements up to its own time only.

        If so, it also runs online.
        """
        return True

    @property
    def learns(self) -> bool:
        """Whether the fit takes anything from recordings; if not, it needs none."""
        return self.n_parameters > 0

    @property
    def adapts(self) -> bool:
        """Whether parameters of the car or its sensors are states, which a fault may corrupt."""
        return False

    @property
    def training_friction(self) -> float | None:
        """Friction of the training recordings, where ``friction`` is estimated with ``vx``.

        Bands widen as the estimate departs from it.
        """
        return None

    @property
    def warm_up_steps(self) -> int:
        """Samples after its first for which it has no estimate yet."""
        return 0

    @property
    def variant(self) -> str:
        """The paper's name of this configuration."""
        return self.name

    @property
    def full_title(self) -> str:
        """Title with what distinguishes this configuration, for people."""
        return self.title

    @classmethod
    def line_style(cls, variant: str) -> tuple[str, str, str] | None:
        """Colour, dash and marker of its lines in figures.

        None: a colour that follows from its name.
        """
        return cls.style

    @property
    def batch_key(self) -> tuple[Any, ...]:
        """Estimators with equal keys may be fitted together as members."""
        return (self.name, self.settings)

    def references(self, training: Any, channels: Collection[str]) -> tuple[str, ...]:
        """Reference channels that a fit with settings ``training`` reads of recordings.

        ``channels`` are those of the recordings.
        """
        return self.learns_from

    def unmatched_patterns(self, training: Any, recordings: Collection[str]) -> tuple[str, ...]:
        """Overrides that a fit needs where a pattern in its settings matches none of these ids."""
        return ()

    def c_values(self) -> Mapping[str, Any]:
        """Values that ``template`` needs of the fitted estimator.

        Raises
        ------
        ConfigurationError
            These settings have no C.
        """
        raise NotImplementedError(f"{type(self).__name__} has a template and no method 'c_values'")

    @property
    @abstractmethod
    def n_parameters(self) -> int:
        """Number of values that the fit determines."""

    def seed(self, seed: int) -> None:
        """Set the seed of the next fit."""
        self.fit_seed = seed

    @classmethod
    @abstractmethod
    def fit_members(
        cls, members: Sequence[Estimator], data: FitData, training: Any, context: FitContext
    ) -> list[FitRecord]:
        """Fit estimators of one ``batch_key`` together, each with the result it would have alone.

        Parameters
        ----------
        members : sequence
            Seeded estimators, changed in place.
        data : FitData
            Recordings at the estimator's rate.
        training : any
            Of ``training_type``.
        context : FitContext
            Checkpoints, progress, the wish to stop.

        Raises
        ------
        DataError
            A channel is missing or the recordings are too short.
        """

    def min_weights(self) -> int:
        """Lower bound of the number of weights with these settings."""
        return self.n_parameters

    def fit(self, data: FitData, training: Any, context: FitContext | None = None) -> FitRecord:
        """Fit this estimator alone."""
        return type(self).fit_members([self], data, training, context or FitContext())[0]

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
        """Values of ``channels`` at one instant, (C,).

        Raises
        ------
        DataError
            One is missing, or is refused.
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
        """An `Estimate` on the recording's clock.

        Sideslip is atan2(vy, vx) with the measured vx.
        """
        channels = {"vy": vy, "sideslip": np.arctan2(vy, recording["vx"]), **quantities}
        mode: Mode = "causal" if self.causal else "offline"
        clock = (recording.rate_hz, recording.start_time)
        return Estimate(recording.id, self.name, *clock, channels, mode, covariance, covariance_of)

    def _estimate_all(
        self, recordings: Sequence[Recording], states: Sequence[Mapping[str, float] | None]
    ) -> list[Estimate]:
        """Estimate checked recordings, each from its state.

        One after another, unless a method can do better.
        """
        return [
            self.estimate_recording(recording, state)
            for recording, state in zip(recordings, states, strict=True)
        ]

    def first_state(self, sample: FloatArray, initial_state: Mapping[str, float]) -> Any:
        """The state before the first sample; none where the method has no state.

        Parameters
        ----------
        sample : array
            Values of ``channels``, (C,).
        initial_state : mapping
            What a protocol hands over of ``vy``, ``vx`` [m/s] and ``yaw_rate`` [rad/s]; empty
            otherwise.
        """
        return None

    def run(self, samples: FloatArray, state: Any) -> tuple[dict[str, Any], Any]:
        """Go on from a state.

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

    def require_fitted(self) -> None:  # noqa: B027 (most networks are complete when they are made)
        """Raises `ConfigurationError`: a number is neither given nor fitted."""

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
        """`run` over a checked recording: its estimate, and the state after the last sample."""
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

    @abstractmethod
    def weights(self) -> dict[str, np.ndarray[Any, Any]]:
        """Everything the fit determined, by name."""

    @abstractmethod
    def load_weights(self, weights: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Take weights back; raises `DataError`: a name or shape does not fit the settings."""


def require_shapes(
    of: Estimator,
    weights: Mapping[str, np.ndarray[Any, Any]],
    expected: Mapping[str, tuple[int, ...]],
) -> None:
    """Raise `DataError` for weights whose names or shapes differ from those of the settings."""
    differing = sorted(
        {(name, values.shape) for name, values in weights.items()} ^ set(expected.items())
    )
    if differing:
        raise DataError(
            f"weights of '{of.name}' do not fit its settings: '{differing[0][0]}' is missing, "
            "unknown or of another shape"
        )


def require_within_bounds(
    values: Mapping[str, float], declarations: Mapping[str, Declaration], array: str = ""
) -> None:
    """Raise `DataError` for a loaded number that its setting could not have.

    ``array`` names the tensor that has the numbers, if any; NaN is not checked.
    """
    for name, value in values.items():
        problem = (
            declarations[name].problem(value)
            if name in declarations and not math.isnan(value)
            else ""
        )
        if problem:
            place = f" in '{array}'" if array else ""
            raise DataError(f"'{name}'{place} {problem}")


def require_positive(name: str, value: float) -> None:
    """Raise `DataError` for a loaded number that is not positive."""
    if not value > 0.0:
        raise DataError(f"'{name}' must be positive, not {value:g}")


class RunStepper(Stepper):
    """An estimator that has `run`, one sample at a time."""

    def __init__(self, estimator: Estimator) -> None:
        self._estimator = estimator
        self._state: Any = None
        self._started = False

    def step(self, sample: Mapping[str, float]) -> dict[str, float]:
        """Every quantity at the time of the sample, ``vy`` [m/s] among them.

        NaN in skippable channels was not measured.
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
