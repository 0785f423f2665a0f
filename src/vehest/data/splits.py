"""Which stretch of which recording serves for training, validation and each named test."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field

from vehest.data.errors import ConfigurationError

VALIDATION = "validation"
TRAINING = "training"


def check_name(name: str, what: str) -> None:
    """See that a name can be part of a file's name.

    Raises:
        ConfigurationError: it holds anything but letters, digits, ``_``, ``-`` and ``.``, or starts with a dot.
    """
    if not re.fullmatch(r"[\w-][\w.-]*", name):
        raise ConfigurationError(f"{what}: '{name}' must be made of letters, digits, '_', '-' and '.', it becomes part of file names")


@dataclass(frozen=True, order=True)
class Span:
    """A stretch [start, stop) of one recording, in the recording's own time [s]."""

    dataset: str
    recording: str
    start: float = -math.inf
    stop: float = math.inf

    def __post_init__(self) -> None:
        if not self.start < self.stop:
            raise ConfigurationError(f"span of recording '{self.recording}': start {self.start} s is not before stop {self.stop} s")

    def overlaps(self, other: Span) -> bool:
        """Whether both stretches share samples."""
        same = (self.dataset, self.recording) == (other.dataset, other.recording)
        return same and self.start < other.stop and other.start < self.stop

    def describe(self) -> str:
        """For messages and reports, for example ``lap3 [150, 450) s``."""
        if self.start == -math.inf and self.stop == math.inf:
            return f"{self.recording} (all)"
        return f"{self.recording} [{self.start:.12g}, {self.stop:.12g}) s"


@dataclass(frozen=True)
class Kept:
    """How much a condition left of the recordings that it was put to.

    Args:
        n_recordings: how many there were.
        n_spans: how many stretches were kept.
        seconds: their time [s].
        of_seconds: time of the recordings, or of their ranges [s].
    """

    n_recordings: int
    n_spans: int
    seconds: float
    of_seconds: float

    def describe(self) -> str:
        """For messages and reports, for example ``61.2 of 90.0 min in 402 stretches of 161 recordings``."""
        minutes = f"{self.seconds / 60.0:.1f} of {self.of_seconds / 60.0:.1f} min"
        return f"{minutes} in {_counted(self.n_spans, 'stretch', 'es')} of {_counted(self.n_recordings, 'recording', 's')}"


def _counted(number: int, what: str, plural: str) -> str:
    return f"{number} {what}{'' if number == 1 else plural}"


@dataclass(frozen=True)
class Split:
    """Training, validation and named test stretches.

    Without training and validation stretches it is for estimators that learn nothing.

    Args:
        name: of the split.
        train: stretches to learn from.
        validation: stretches to stop on.
        tests: name of a test set -> its stretches.
        kept: ``train``, ``validation`` or name of a test set -> what was kept, where a condition decided it.

    Raises:
        ConfigurationError: training without validation stretches or the other way round, no stretch at all, or a stretch that
            serves two purposes.
    """

    name: str
    train: tuple[Span, ...]
    validation: tuple[Span, ...]
    tests: Mapping[str, tuple[Span, ...]]
    kept: Mapping[str, Kept] = field(default_factory=dict, compare=False)

    def __post_init__(self) -> None:
        if not (self.train or self.validation or self.tests):
            raise ConfigurationError(f"split '{self.name}' has no ranges at all")
        if self.validation and not self.train:
            raise ConfigurationError(f"split '{self.name}' has nothing to train on")
        if self.train and not self.validation:
            raise ConfigurationError(f"split '{self.name}' has nothing to validate on")
        check_name(self.name, "split")
        for name, spans in self.tests.items():
            check_name(name, f"split '{self.name}': test set")
            if name in (VALIDATION, TRAINING):
                raise ConfigurationError(
                    f"split '{self.name}': a test set cannot be called '{name}'; that is what the {name} range is called in metrics"
                )
            if not spans:
                raise ConfigurationError(f"split '{self.name}': test set '{name}' is empty")
        roles = [("train", self.train), ("validation", self.validation)]
        roles += [(f"test '{name}'", spans) for name, spans in self.tests.items()]
        for position, (role, spans) in enumerate(roles):
            for other_role, other_spans in roles[position + 1 :]:
                if role.startswith("test") and other_role.startswith("test"):
                    continue
                for span in spans:
                    for other in other_spans:
                        if span.overlaps(other):
                            raise ConfigurationError(
                                f"split '{self.name}': {role} and {other_role} share samples of recording '{span.recording}' "
                                f"({span.describe()} and {other.describe()}); separate the ranges"
                            )

    @property
    def datasets(self) -> tuple[str, ...]:
        """Names of the data sets it draws on, sorted."""
        return tuple(sorted({span.dataset for span in self.all_spans}))

    @property
    def all_spans(self) -> tuple[Span, ...]:
        """Every stretch, whatever it serves for."""
        tests = tuple(span for spans in self.tests.values() for span in spans)
        return self.train + self.validation + tests
