"""Segments of recordings for training, validation and each named test."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain, pairwise, product

from vehest.data.errors import ConfigurationError, printable

VALIDATION = "validation"  # name of the validation ranges as a test set
TRAINING = "training"  # name of the training ranges as a test set
MAX_NAME_CHARACTERS = 100  # characters, so that file names with a stage and a key stay below 255
# words that YAML or Hydra reads as something else than text
YAML_WORDS = frozenset(["null", "true", "false", "yes", "no", "on", "off", "y", "n", "nan", "inf"])
# matches text that YAML reads as a number or date
YAML_NUMBER = re.compile(
    r"0[xob][0-9a-f_]+|[0-9][0-9_]*(\.[0-9_]*)?(e-?[0-9]+)?|[0-9]{4}-[0-9]{1,2}-[0-9]{1,2}",
    re.IGNORECASE,
)
# matches names of devices of Windows
WINDOWS_DEVICE = re.compile(r"con|prn|aux|nul|com[0-9]|lpt[0-9]", re.IGNORECASE)


def check_name(name: str, subject: str) -> None:
    """Refuse a name that would not mean itself in a file name, YAML or an override.

    It starts with a letter, digit or ``_`` of ASCII, goes on with these, ``-`` and ``.``, ends
    with none of the last, and has `MAX_NAME_CHARACTERS` characters at most. It is no word or number
    of YAML or of Hydra's grammar (``null``, ``yes``, ``1e5``), and no device of Windows (``con``).

    Raises
    ------
    ConfigurationError
        The name is another.
    """
    if not re.fullmatch(r"[A-Za-z0-9_]([A-Za-z0-9_.-]*[A-Za-z0-9_-])?", name):
        raise ConfigurationError(
            f"{subject}: '{printable(name[:60])}' must be made of letters A to Z, digits, '_', '-' "
            "and '.', begin with none of the last two and not end with '.'; it becomes part of "
            "file names"
        )
    if len(name) > MAX_NAME_CHARACTERS:
        raise ConfigurationError(
            f"{subject}: '{name[:20]}…' has {len(name)} characters; take {MAX_NAME_CHARACTERS} at "
            "most"
        )
    if name.lower() in YAML_WORDS or YAML_NUMBER.fullmatch(name):
        raise ConfigurationError(
            f"{subject}: '{name}' is a word or number of YAML; add letters, such as car_{name}"
        )
    if WINDOWS_DEVICE.fullmatch(name.partition(".")[0]):
        raise ConfigurationError(
            f"{subject}: '{name}' is a device of Windows, not a file; add letters, such as "
            f"car_{name}"
        )


@dataclass(frozen=True, order=True)
class Span:
    """A segment [start, stop) of one recording, in the recording's own time [s]."""

    dataset: str  # name of the data set
    recording: str  # id of the recording
    start: float = -math.inf  # start [s]
    stop: float = math.inf  # end [s], not included

    def __post_init__(self) -> None:
        if not self.start < self.stop:
            raise ConfigurationError(
                f"range of recording '{self.recording}': start {self.start} s is not before stop "
                f"{self.stop} s"
            )

    def overlaps(self, other: Span) -> bool:
        """Whether both segments share samples."""
        is_same_recording = (self.dataset, self.recording) == (other.dataset, other.recording)
        return is_same_recording and self.start < other.stop and other.start < self.stop

    def describe(self) -> str:
        """Text for messages and reports, for example ``lap3 [150, 450) s``."""
        if self.start == -math.inf and self.stop == math.inf:
            return f"{self.recording} (all)"
        return f"{self.recording} [{self.start:.12g}, {self.stop:.12g}) s"


@dataclass(frozen=True)
class Split:
    """Training, validation and named test segments.

    Without training and validation segments it is for estimators that learn nothing.

    Raises
    ------
    ConfigurationError
        Training without validation stretches or the other way round, no stretch at all, or a
        stretch that serves two purposes.
    """

    name: str  # name of the split
    train: tuple[Span, ...]  # segments to learn from
    validation: tuple[Span, ...]  # segments for early stopping
    tests: Mapping[str, tuple[Span, ...]]  # name of a test set -> its segments

    def __post_init__(self) -> None:
        if not (self.train or self.validation or self.tests):
            raise ConfigurationError(f"split '{self.name}' has no ranges at all")
        if bool(self.train) != bool(self.validation):
            raise ConfigurationError(
                f"split '{self.name}' has nothing to {'validate' if self.train else 'train'} on"
            )
        check_name(self.name, "split")
        for name, spans in self.tests.items():
            check_name(name, f"split '{self.name}': test set")
            if name in (VALIDATION, TRAINING):
                raise ConfigurationError(
                    f"split '{self.name}': a test set cannot be called '{name}', as the {name} "
                    "range is in metrics"
                )
            if not spans:
                raise ConfigurationError(f"split '{self.name}': test set '{name}' is empty")
        learnt = [("train", self.train), ("validation", self.validation)]
        tests = [(f"test '{name}'", spans) for name, spans in self.tests.items()]
        for (role, spans), (other_role, other_spans) in [
            *pairwise(learnt),
            *product(learnt, tests),
        ]:
            for span, other in product(spans, other_spans):
                if span.overlaps(other):
                    raise ConfigurationError(
                        f"split '{self.name}': {role} and {other_role} share samples of recording "
                        f"'{span.recording}' ({span.describe()} and {other.describe()}); separate "
                        "the ranges"
                    )

    @property
    def datasets(self) -> tuple[str, ...]:
        """Names of the data sets it draws on, sorted."""
        spans = (*self.train, *self.validation, *self.test_spans)
        return tuple(sorted({span.dataset for span in spans}))

    @property
    def test_spans(self) -> tuple[Span, ...]:
        """The ranges of all test sets."""
        return tuple(chain.from_iterable(self.tests.values()))
