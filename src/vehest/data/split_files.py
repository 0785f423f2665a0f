"""Reads splits as conf/split/*.yaml holds them: ranges, patterns of recordings, conditions, percentages, laps and folds."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from fnmatch import fnmatchcase
from typing import Annotated, Any

from vehest.data.errors import ConfigurationError
from vehest.data.folds import FoldsFile, blocks_of, fold_of
from vehest.data.laps import laps_of
from vehest.data.limit_minutes import limit_minutes
from vehest.data.recording import Recording
from vehest.data.schema import validated
from vehest.data.splits import VALIDATION, Kept, Span, Split
from vehest.data.stretches import Condition, stretches_where

Reader = Callable[[Iterable[str] | None], Recording]
"""Reads the named channels of one recording, or all."""
Catalogue = Callable[[str], Mapping[str, Reader]]
"""Of the name of a data set: its recordings as ingested, by id."""

PERCENT = re.compile(r"\s*(\d+(?:\.\d+)?)\s*%\s*")
LAPS = re.compile(r"\s*(?:(first|last)(?:\s+(\d+))?|(\d+)(?:\s*(?:to|-)\s*(\d+))?)(?:\s+laps?)?\s*")
SECONDS_OR_SHARE = 'a number of seconds or a percentage such as "60 %"'


@dataclass(frozen=True)
class RangeFile:
    """One range of conf/split/*.yaml: a recording, or a pattern of several; from start to stop [s or %], or some of its laps."""

    dataset: str | None = None
    recording: str | None = None
    recordings: str | None = None
    start: Annotated[float | str, SECONDS_OR_SHARE] = -math.inf
    stop: Annotated[float | str, SECONDS_OR_SHARE] = math.inf
    laps: str | None = None
    keep: Condition | None = None


@dataclass(frozen=True)
class SplitFile:
    """Content of conf/split/*.yaml. ``minutes`` cuts training and validation down to so many in all, as if no more had been recorded with
    a reference; ``minutes_at`` is the share of them after which these begin."""

    name: str = "unnamed"
    title: str | None = None
    dataset: str | None = None
    train: tuple[RangeFile, ...] | None = None
    validation: tuple[RangeFile, ...] | None = None
    tests: dict[str, tuple[RangeFile, ...]] | None = None
    folds: FoldsFile | None = None
    fold: int = 0
    minutes: float | None = None
    minutes_at: float = 0.0


def _read(config: Any) -> SplitFile:
    name = config.get("name") if isinstance(config, Mapping) else None
    where = f"split '{name}'" if isinstance(name, str) else ""
    plain = _spelt_out(config, where) if isinstance(config, Mapping) else config
    return validated(SplitFile, plain, where, error=ConfigurationError, group="split")


def _spelt_out(config: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Roles in short (``60 %``, ``last lap``) as ranges of all recordings; percentages follow one another, training first."""
    done = 0.0

    def ranges(role: str, entries: Any) -> Any:
        nonlocal done
        if not isinstance(entries, str):
            return entries
        if (share := PERCENT.fullmatch(entries)) is not None:
            begin, done = done, done + float(share[1])
            if done > 100.0 + 1e-9:
                raise ConfigurationError(f"{where}: the percentages come to {done:g} %, more than there is")
            return [{"recordings": "*", "start": f"{begin:g} %", "stop": f"{done:g} %"}]
        if LAPS.fullmatch(entries) is not None:
            return [{"recordings": "*", "laps": entries}]
        what = f'a list of ranges, a percentage such as "60 %" or laps such as "last lap", not \'{entries[:60]}\''
        raise ConfigurationError(f"{where}: {role} must be {what}")

    spelt = {role: ranges(role, config[role]) for role in ("train", VALIDATION) if role in config}
    if isinstance(tests := config.get("tests"), Mapping):
        spelt["tests"] = {name: ranges(f"tests.{name}", entries) for name, entries in tests.items()}
    return {**config, **spelt}


def split_from_config(config: Mapping[str, Any], catalogue: Catalogue | None = None) -> Split:
    """Build a split from plain values, as conf/split/*.yaml holds them.

    Args:
        config: its values.
        catalogue: the recordings; needed only where a pattern, a condition, percentages, laps or folds name or cut recordings.

    Raises:
        ConfigurationError: a key is missing, misspelt or of the wrong type; a pattern that no recording's id matches; a condition that
            none meets; or one of them without a catalogue.
        DataError: a recording lacks a channel that a condition looks at.
    """
    file = _read(config)
    ranges = _Ranges(file, catalogue)
    split = ranges.fold(file.folds) if file.folds is not None else ranges.split()
    return split if file.minutes is None else ranges.limited(split, file.minutes)


def dataset_names(config: Mapping[str, Any]) -> list[str]:
    """Names of the data sets that a split's plain values draw on, sorted.

    Raises:
        ConfigurationError: as `split_from_config`, where a range names none.
    """
    file = _read(config)
    entries = [*(file.train or ()), *(file.validation or ()), *(entry for entries in (file.tests or {}).values() for entry in entries)]
    if file.folds is not None:
        entries = [RangeFile(recordings=file.folds.recordings)]
    return sorted({_dataset_of(entry, file) for entry in entries})


def _dataset_of(entry: RangeFile, file: SplitFile) -> str:
    dataset = entry.dataset or file.dataset
    if dataset is None or (entry.recording is None) == (entry.recordings is None):
        needed = "each range needs a recording and a dataset (or recordings, a pattern)"
        raise ConfigurationError(f"split '{file.name}': {needed}, not {_shown(entry)}")
    return dataset


def _shown(entry: RangeFile) -> dict[str, Any]:
    return {key: value for key, value in asdict(entry).items() if value not in (None, -math.inf, math.inf)}


class _Ranges:
    """Makes spans of the ranges of a configuration.

    Args:
        file: the configuration.
        catalogue: the recordings.
    """

    def __init__(self, file: SplitFile, catalogue: Catalogue | None) -> None:
        self._file, self._catalogue, self._where = file, catalogue, f"split '{file.name}'"
        self._known: dict[str, Mapping[str, Reader]] = {}
        self._kept: dict[str, Kept] = {}

    def split(self) -> Split:
        """The split of the ranges."""
        train, validation = self._spans("train", self._file.train or ()), self._spans(VALIDATION, self._file.validation or ())
        tests = {test: self._spans(test, entries) for test, entries in (self._file.tests or {}).items()}
        return Split(self._file.name, train, validation, tests, self._kept)

    def fold(self, folds: FoldsFile) -> Split:
        """The split of one fold of a cross-validation."""
        file = self._file
        if file.train or file.validation or file.tests:
            raise ConfigurationError(f"{self._where}: folds make training, validation and test; leave train, validation and tests out")
        dataset = _dataset_of(RangeFile(recordings=folds.recordings), file)
        readers = {Span(dataset, name): self._reader(dataset, name) for name in self._matching(dataset, folds.recordings)}
        train, validation, test = fold_of(blocks_of(folds, readers), folds, file.fold, self._where)
        return Split(f"{file.name}_fold_{file.fold + 1}", train, validation, {"test": test})

    def limited(self, split: Split, minutes: float) -> Split:
        """The split with fewer minutes to learn from, of which validation keeps its share."""

        def bounds_of(span: Span) -> tuple[float, float]:
            recording = self._reader(span.dataset, span.recording)(None)
            return recording.start_time, recording.end_time

        def length(spans: Sequence[Span]) -> float:
            return sum(min(span.stop, bounds_of(span)[1]) - max(span.start, bounds_of(span)[0]) for span in spans)

        at = self._file.minutes_at
        train, validation = length(split.train), length(split.validation)
        share = 60.0 * minutes / (train + validation)
        return replace(
            split,
            name=f"{split.name}_{minutes:g}min" + (f"_at_{at:g}" if at else ""),
            train=limit_minutes(split.train, share * train, at, bounds_of),
            validation=limit_minutes(split.validation, share * validation, at, bounds_of),
        )

    def _spans(self, role: str, entries: Sequence[RangeFile]) -> tuple[Span, ...]:
        """The spans of one role."""
        spans: list[Span] = []
        for entry in entries:
            dataset = _dataset_of(entry, self._file)
            names = [entry.recording] if entry.recording is not None else self._matching(dataset, str(entry.recordings))
            whole = [Span(dataset, name, *self._bounds(dataset, name, entry)) for name in names]
            if entry.keep is not None:
                whole = self._cut(role, whole, entry.keep)
            spans += whole
        return tuple(spans)

    def _bounds(self, dataset: str, name: str, entry: RangeFile) -> tuple[float, float]:
        """Start and stop of an entry in one recording [s]."""
        if entry.laps is None:
            return self._time(dataset, name, entry.start), self._time(dataset, name, entry.stop)
        if (entry.start, entry.stop) != (-math.inf, math.inf):
            raise ConfigurationError(f"{self._where}: a range has laps, or start and stop, not both: {_shown(entry)}")
        return self._laps(dataset, name, entry.laps)

    def _time(self, dataset: str, name: str, bound: float | str) -> float:
        if not isinstance(bound, str):
            return bound
        found = PERCENT.fullmatch(bound)
        share = float(found[1]) if found else math.inf
        if share > 100.0:
            raise ConfigurationError(f"{self._where}: start and stop are {SECONDS_OR_SHARE}, not '{bound[:60]}'")
        if share in (0.0, 100.0):
            return -math.inf if share == 0.0 else math.inf
        recording = self._reader(dataset, name)(None)
        return recording.start_time + round(share / 100.0 * len(recording)) / recording.rate_hz

    def _laps(self, dataset: str, name: str, words: str) -> tuple[float, float]:
        found = LAPS.fullmatch(words)
        if found is None:
            raise ConfigurationError(f"{self._where}: laps are first, last, first 3, last 2, a number, or 2 to 4, not '{words[:60]}'")
        end, number, first, last = found.groups()
        laps = laps_of(self._reader(dataset, name)(None))
        count = int(number or 1)
        begin = int(first) if first else 1 if end == "first" else len(laps) - count + 1
        stop = int(last or first) if first else begin + count - 1
        if not 1 <= begin <= stop <= len(laps):
            there = f"{len(laps)} complete laps were found" if laps else "its course does not repeat"
            raise ConfigurationError(f"{self._where}: recording '{name}' has no '{words.strip()}': {there}; name times instead")
        return laps[begin - 1][0], laps[stop - 1][1]

    def _reader(self, dataset: str, name: str) -> Reader:
        """Reads a recording that the data set has."""
        recordings = self._recordings(dataset)
        if name not in recordings:
            raise ConfigurationError(f"{self._where}: data set '{dataset}' has no recording '{name}'")
        return recordings[name]

    def _matching(self, dataset: str, pattern: str) -> list[str]:
        """Names of a data set's recordings that fit a pattern, sorted."""
        recordings = self._recordings(dataset)
        names = sorted(name for name in recordings if fnmatchcase(name, pattern))
        if not names:
            known = ", ".join([*sorted(recordings)[:5], *(["…"] if len(recordings) > 5 else [])])
            raise ConfigurationError(f"{self._where}: no recording of data set '{dataset}' matches '{pattern}' (it has {known})")
        return names

    def _recordings(self, dataset: str) -> Mapping[str, Reader]:
        if dataset not in self._known:
            if self._catalogue is None:
                raise ConfigurationError(f"{self._where}: its patterns and the like need the recordings of data set '{dataset}'")
            self._known[dataset] = self._catalogue(dataset)
        return self._known[dataset]

    def _cut(self, role: str, whole: Sequence[Span], condition: Condition) -> list[Span]:
        """Stretches of spans in which a condition holds; their amount is added up by role."""
        spans: list[Span] = []
        seconds = of_seconds = 0.0
        for span in whole:
            recording = self._reader(span.dataset, span.recording)(condition.magnitude)
            first, end = recording.index_range(span.start, span.stop)
            of_seconds += (end - first) / recording.rate_hz
            for begin, after in stretches_where(recording, condition, first, end):
                start = span.start if begin == first else recording.start_time + begin / recording.rate_hz
                stop = span.stop if after == end else recording.start_time + after / recording.rate_hz
                spans.append(replace(span, start=start, stop=stop))
                seconds += (after - begin) / recording.rate_hz
        if not spans:
            raise ConfigurationError(f"{self._where}: the condition of {role} keeps nothing ({condition.describe()})")
        so_far = self._kept.get(role, Kept(0, 0, 0.0, 0.0))
        more = (len(whole), len(spans), seconds, of_seconds)
        self._kept[role] = Kept(*(one + other for one, other in zip(astuple(so_far), more, strict=True)))
        return spans
