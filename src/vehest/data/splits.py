"""Which stretch of which recording serves for training, validation and each named test."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from fnmatch import fnmatchcase
from typing import Any

from vehest.data.channels import CHANNELS
from vehest.data.errors import ConfigurationError
from vehest.data.recording import Recording
from vehest.data.schema import validated
from vehest.data.stretches import Condition, stretches_where

VALIDATION = "validation"
TRAINING = "training"

Catalogue = Callable[[str], Mapping[str, Callable[[Iterable[str]], Recording]]]
"""Of the name of a data set: its recordings as ingested, by id, each as a function that reads the named channels."""


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


@dataclass(frozen=True)
class BoundsFile:
    """Bounds of a channel's magnitude in its unit; what is None is not said."""

    at_least: float | None = None
    at_most: float | None = None


@dataclass(frozen=True)
class KeepFile:
    """A condition: channel -> bounds of its magnitude, and how long it must hold at least [s]."""

    magnitude: dict[str, BoundsFile]
    at_least_seconds: float = 0.0


@dataclass(frozen=True)
class RangeFile:
    """One range as conf/split/*.yaml names it: a recording, or a pattern of several; from start to stop [s]."""

    dataset: str | None = None
    recording: str | None = None
    recordings: str | None = None
    start: float = -math.inf
    stop: float = math.inf
    keep: KeepFile | None = None


@dataclass(frozen=True)
class SplitFile:
    """What conf/split/*.yaml says."""

    name: str = "unnamed"
    title: str | None = None
    dataset: str | None = None
    train: tuple[RangeFile, ...] | None = None
    validation: tuple[RangeFile, ...] | None = None
    tests: dict[str, tuple[RangeFile, ...]] | None = None


def _read(config: Any) -> SplitFile:
    name = config.get("name") if isinstance(config, Mapping) else None
    where = f"split '{name}'" if isinstance(name, str) else ""
    plain = dict(config) if isinstance(config, Mapping) else config
    return validated(SplitFile, plain, where, error=ConfigurationError, group="split")


def split_from_config(config: Mapping[str, Any], catalogue: Catalogue | None = None) -> Split:
    """Build a split from plain values, as conf/split/*.yaml holds them.

    Args:
        config: its values.
        catalogue: the recordings; asked only for data sets whose recordings are named by a pattern or cut by a condition.

    Raises:
        ConfigurationError: a key is missing, misspelt or of the wrong type; a pattern that no recording's id matches; a condition that
            none meets; or either of them without a catalogue.
        DataError: a recording lacks a channel that a condition looks at.
    """
    told = _read(config)
    ranges = _Ranges(told.name, told.dataset, catalogue)
    return Split(
        name=told.name,
        train=ranges.spans("train", told.train or ()),
        validation=ranges.spans(VALIDATION, told.validation or ()),
        tests={test: ranges.spans(test, entries) for test, entries in (told.tests or {}).items()},
        kept=ranges.kept,
    )


def dataset_names(config: Mapping[str, Any]) -> list[str]:
    """Names of the data sets that a split's plain values draw on, sorted.

    Raises:
        ConfigurationError: as `split_from_config`, where a range names none.
    """
    told = _read(config)
    entries = [*(told.train or ()), *(told.validation or ()), *(entry for entries in (told.tests or {}).values() for entry in entries)]
    return sorted({_dataset_of(entry, told.dataset, told.name) for entry in entries})


def _dataset_of(entry: RangeFile, default: str | None, split: str) -> str:
    dataset = entry.dataset or default
    if dataset is None or (entry.recording is None) == (entry.recordings is None):
        needed = "each range needs a recording and a dataset (or recordings, a pattern)"
        raise ConfigurationError(f"split '{split}': {needed}, not {_shown(entry)}")
    return dataset


def _shown(entry: RangeFile) -> dict[str, Any]:
    return {key: value for key, value in asdict(entry).items() if value not in (None, -math.inf, math.inf)}


class _Ranges:
    """Turns the ranges of a configuration into spans.

    Args:
        split: its name.
        dataset: that serves ranges which name none.
        catalogue: the recordings.
    """

    def __init__(self, split: str, dataset: str | None, catalogue: Catalogue | None) -> None:
        self._split, self._dataset, self._catalogue = split, dataset, catalogue
        self._known: dict[str, Mapping[str, Callable[[Iterable[str]], Recording]]] = {}
        self.kept: dict[str, Kept] = {}

    def spans(self, role: str, entries: Sequence[RangeFile]) -> tuple[Span, ...]:
        """The spans of one role."""
        spans: list[Span] = []
        for entry in entries:
            whole = self._named(entry)
            if entry.keep is None:
                spans += whole
            else:
                condition = _condition(entry.keep, f"split '{self._split}': keep of {role}")
                spans += self._cut(role, whole, condition)
        return tuple(spans)

    def _named(self, entry: RangeFile) -> list[Span]:
        """Spans of one entry, before any condition."""
        dataset = _dataset_of(entry, self._dataset, self._split)
        names = [entry.recording] if entry.recording is not None else self._matching(dataset, str(entry.recordings))
        return [Span(dataset, name, entry.start, entry.stop) for name in names]

    def _matching(self, dataset: str, pattern: str) -> list[str]:
        recordings = self._recordings(dataset)
        names = sorted(name for name in recordings if fnmatchcase(name, pattern))
        if not names:
            known = ", ".join([*sorted(recordings)[:5], *(["…"] if len(recordings) > 5 else [])])
            raise ConfigurationError(f"split '{self._split}': no recording of data set '{dataset}' matches '{pattern}' (it has {known})")
        return names

    def _recordings(self, dataset: str) -> Mapping[str, Callable[[Iterable[str]], Recording]]:
        if dataset not in self._known:
            if self._catalogue is None:
                raise ConfigurationError(f"split '{self._split}': its patterns and conditions need the recordings of data set '{dataset}'")
            self._known[dataset] = self._catalogue(dataset)
        return self._known[dataset]

    def _cut(self, role: str, whole: Sequence[Span], condition: Condition) -> list[Span]:
        """Those stretches of spans in which a condition holds; notes how much that is."""
        spans: list[Span] = []
        seconds = of_seconds = 0.0
        for span in whole:
            recordings = self._recordings(span.dataset)
            if span.recording not in recordings:
                raise ConfigurationError(f"split '{self._split}': data set '{span.dataset}' has no recording '{span.recording}'")
            recording = recordings[span.recording](condition.magnitude)
            first, end = recording.index_range(span.start, span.stop)
            of_seconds += (end - first) / recording.rate_hz
            for begin, after in stretches_where(recording, condition, first, end):
                start = span.start if begin == first else recording.start_time + begin / recording.rate_hz
                stop = span.stop if after == end else recording.start_time + after / recording.rate_hz
                spans.append(Span(span.dataset, span.recording, start, stop))
                seconds += (after - begin) / recording.rate_hz
        if not spans:
            raise ConfigurationError(f"split '{self._split}': the condition of {role} keeps nothing ({condition.describe()})")
        before = self.kept.get(role, Kept(0, 0, 0.0, 0.0))
        self.kept[role] = Kept(
            before.n_recordings + len(whole), before.n_spans + len(spans), before.seconds + seconds, before.of_seconds + of_seconds
        )
        return spans


def _condition(keep: KeepFile, where: str) -> Condition:
    if not keep.magnitude:
        raise ConfigurationError(f"{where}: magnitude maps channels to {{at_least, at_most}}, and names none")
    bounds: dict[str, tuple[float, float]] = {}
    for channel, limits in keep.magnitude.items():
        if channel not in CHANNELS:
            raise ConfigurationError(f"{where}: there is no channel '{channel}'; see 'vehest data channels'")
        if limits.at_least is None and limits.at_most is None:
            raise ConfigurationError(f"{where}: '{channel}' needs at_least, at_most or both")
        at_least, at_most = (limits.at_least or 0.0), (math.inf if limits.at_most is None else limits.at_most)
        if not 0.0 <= at_least <= at_most:
            raise ConfigurationError(f"{where}: no magnitude of '{channel}' lies between {at_least:g} and {at_most:g}")
        bounds[channel] = (at_least, at_most)
    if keep.at_least_seconds < 0.0:
        raise ConfigurationError(f"{where}: at_least_seconds must be zero or positive, not {keep.at_least_seconds:g}")
    return Condition(bounds, keep.at_least_seconds)
