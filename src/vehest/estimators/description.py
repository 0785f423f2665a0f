"""What a family of estimators declares: settings, channels, texts, version.

`Description.__init_subclass__` turns the `setting` and `fitted` entries of a class body into a
frozen dataclass, ``settings_type``, and into properties of the class. A configuration becomes an
estimator by `Description.from_config`.
"""

from __future__ import annotations

from abc import ABC
from collections.abc import Mapping
from dataclasses import Field, dataclass, make_dataclass
from operator import attrgetter
from typing import Any, ClassVar, NamedTuple, Self

from vehest.data.recording import HIGHEST_RATE
from vehest.data.schema import settings_from_config
from vehest.declared import Group, setting


def rate(default: float) -> Any:
    """Declare the setting ``rate_hz`` of a family with its default [Hz]."""
    return setting(
        default, "sampling rate it works at", unit="Hz", positive=True, most=HIGHEST_RATE
    )


@dataclass(frozen=True)
class EstimatorSettings(Group):
    """Settings of every estimator."""

    rate_hz: float = rate(100.0)  # rate of the estimates [Hz]


class Trial(NamedTuple):
    """A family in the first comparison on a car without a trained model (`vehest new`)."""

    # position in the order of the trials of all families, promising and cheap ones first; trials
    # of several families that differ in it alone are one sweep
    place: float
    about: str  # one line that describes the method and its cost
    # command-line overrides of settings and training; ``{wheelbase}`` and ``{mass}`` are those of
    # the car, ``{car}`` all of its parameters that the settings have
    overrides: str = ""
    # number of samples, at the family's rate, that one range for training and each for validation
    # must have
    samples: int = 0


class Description(ABC):
    """Declarations of a family, and what follows from the settings of one of its estimators.

    A family declares itself in its class: settings by `setting`, fitted numbers by `fitted`, and
    the class variables below. Settings are then an attribute of the estimator each, and together
    ``settings``, of the dataclass ``settings_type`` that is made of them.

    Attributes
    ----------
    settings : settings_type
        The estimator's settings.
    preparation : mapping
        How recordings are brought to its rate (``method``, ``transforms``).
    trust : Trust or None
        Its calibration (`vehest.trust.record.Trust`).
    """

    name: ClassVar[str]  # identifier in conf/estimator and in the registry
    title: ClassVar[str]  # name in tables and figures
    channels: ClassVar[tuple[str, ...]]  # measured channels it reads
    settings_type: ClassVar[Any] = EstimatorSettings
    # channels of ``channels`` that may have gaps, because the method does without a sample
    skippable: ClassVar[tuple[str, ...]] = ()
    # channels that it must not get from a transform that derives them from others
    measured_only: ClassVar[tuple[str, ...]] = ()
    # measurements of a sample that are errors: ``NaN`` where it is not skippable, ``infinite``
    refuses: ClassVar[tuple[str, ...]] = ()
    # sampling intervals after a sample for which the estimate made with it holds
    horizon_steps: ClassVar[int] = 0
    # ``module:function`` that takes tens of seconds to compile; empty: none
    slow_kernel: ClassVar[str] = ""
    # error of `online` where its settings make it not causal, with those that make it causal
    offline: ClassVar[str] = "an estimator that is not causal cannot run along with a drive"
    # trials in the first comparison on a new car; none: the family is left out
    trials: ClassVar[tuple[Trial, ...]] = ()
    notice: ClassVar[tuple[str, ...]] = ()  # lines for users of the method, such as a patent
    trace_note: ClassVar[str] = ""  # explains a conspicuous course of its traces, below figures
    # colour, dash and marker of its lines, see `line_style`; None: by its name
    style: ClassVar[tuple[str, str, str] | None] = None
    # C template of a step, in ``export/templates/methods`` or beside the family's module; or empty
    template: ClassVar[str] = ""
    # raised when weights or estimates change; a version of ``training_type`` alone when the fit
    # does
    version: ClassVar[str] = "1"

    def __init_subclass__(cls, **options: Any) -> None:
        """Make ``settings_type`` of the fields that the class declares and those of its bases."""
        super().__init_subclass__(**options)
        declared = {name: value for name, value in vars(cls).items() if isinstance(value, Field)}
        of_bases = dict.fromkeys(
            base.settings_type for base in cls.__bases__ if issubclass(base, Description)
        )
        bases = tuple(
            base
            for base in of_bases
            if not any(derived is not base and issubclass(derived, base) for derived in of_bases)
        )
        if not declared and len(bases) == 1:
            return
        described = []
        for name, value in declared.items():
            kind = cls.__annotations__[name]
            if value.default is None:
                kind = f"{kind} | None" if isinstance(kind, str) else kind | None
            described.append((name, kind, value))
        cls.settings_type = make_dataclass("settings_type", described, bases=bases, frozen=True)
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

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Build an estimator from plain values.

        Raises
        ------
        ConfigurationError
            An unknown setting or a value out of range.
        """
        return cls(settings_from_config(cls.settings_type, config, "estimator"))

    @property
    def rate_hz(self) -> float:
        """Sampling rate it works at [Hz]."""
        return float(self.settings.rate_hz)

    @property
    def causal(self) -> bool:
        """Whether an estimate uses measurements up to its own time only.

        If so, it also runs online.
        """
        return True

    @property
    def adapts(self) -> bool:
        """Whether parameters of the car or its sensors are states, which a fault may corrupt."""
        return False

    @property
    def training_friction(self) -> float | None:
        """Friction of the training recordings [1], where the estimator estimates ``friction`` and
        ``vx``; else None.

        Bands widen as the estimate departs from it.
        """
        return None

    @property
    def warm_up_steps(self) -> int:
        """Number of samples from the start for which it has no estimate yet."""
        return 0

    @property
    def variant(self) -> str:
        """Identifier of this configuration of the family in tables, as the paper names it."""
        return self.name

    @property
    def full_title(self) -> str:
        """Title with what distinguishes this configuration of the family."""
        return self.title

    @classmethod
    def line_style(cls, variant: str) -> tuple[str, str, str] | None:
        """Colour, dash and marker of its lines in figures.

        None: a colour that follows from its name.
        """
        return cls.style

    def c_values(self) -> Mapping[str, Any]:
        """Values that ``template`` needs of the fitted estimator.

        Raises
        ------
        ConfigurationError
            These settings have no C.
        """
        raise NotImplementedError(f"{type(self).__name__} has a template and no method 'c_values'")
