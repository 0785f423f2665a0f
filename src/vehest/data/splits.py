"""Which stretch of which recording serves for training, validation and each named test."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vehest.data.errors import ConfigurationError

VALIDATION = "validation"


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
class Split:
    """Training, validation and named test stretches.

    Without training and validation stretches it is for estimators that learn nothing.

    Raises:
        ConfigurationError: training without validation stretches or the other way round, no stretch at all, or a stretch that
            serves two purposes.
    """

    name: str
    train: tuple[Span, ...]
    validation: tuple[Span, ...]
    tests: Mapping[str, tuple[Span, ...]]

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
            if name == VALIDATION:
                raise ConfigurationError(
                    f"split '{self.name}': a test set cannot be called '{VALIDATION}'; seeds are chosen on the validation range"
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


def split_from_config(config: Mapping[str, Any]) -> Split:
    """Build a split from plain values, as conf/split/*.yaml holds them.

    Raises:
        ConfigurationError: a key is missing, misspelt or of the wrong type.
    """
    name = str(config.get("name", "unnamed"))
    unknown = set(config) - {"name", "title", "dataset", "train", "validation", "tests"}
    if unknown:
        raise ConfigurationError(f"split '{name}': unknown key '{sorted(unknown)[0]}'")
    default = config.get("dataset")
    tests = config.get("tests") or {}
    if not isinstance(tests, Mapping):
        raise ConfigurationError(f"split '{name}': 'tests' must map a name to a list of ranges")
    return Split(
        name=name,
        train=_spans(name, default, config.get("train") or []),
        validation=_spans(name, default, config.get("validation") or []),
        tests={str(test): _spans(name, default, spans) for test, spans in tests.items()},
    )


def _spans(split: str, default_dataset: Any, entries: Any) -> tuple[Span, ...]:
    if not isinstance(entries, Sequence) or isinstance(entries, str):
        raise ConfigurationError(f"split '{split}': ranges come as a list of recording, start and stop, not {entries}")
    spans = []
    for entry in entries:
        if not isinstance(entry, Mapping):
            raise ConfigurationError(f"split '{split}': a range is {{recording, start, stop}}, not {entry}")
        unknown = set(entry) - {"dataset", "recording", "start", "stop"}
        if unknown:
            raise ConfigurationError(f"split '{split}': unknown key '{sorted(unknown)[0]}' in {dict(entry)}")
        dataset = entry.get("dataset", default_dataset)
        if dataset is None or "recording" not in entry:
            raise ConfigurationError(f"split '{split}': each range needs a recording and a dataset, not {dict(entry)}")
        try:
            start = float(entry.get("start", -math.inf))
            stop = float(entry.get("stop", math.inf))
        except (TypeError, ValueError):
            raise ConfigurationError(f"split '{split}': start and stop of {dict(entry)} must be numbers [s]") from None
        spans.append(Span(str(dataset), str(entry["recording"]), start, stop))
    return tuple(spans)
