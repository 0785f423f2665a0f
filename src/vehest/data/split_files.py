"""Splits as conf/split/*.yaml holds them: ranges, patterns of recordings, conditions, percentages, laps and folds, to a `Split`."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatchcase
from typing import Annotated, Any

from vehest.data.channels import CHANNELS
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
    """One range as conf/split/*.yaml names it: a recording, or a pattern of several; from start to stop [s or %], or some of its laps."""

    dataset: str | None = None
    recording: str | None = None
    recordings: str | None = None
    start: Annotated[float | str, SECONDS_OR_SHARE] = -math.inf
    stop: Annotated[float | str, SECONDS_OR_SHARE] = math.inf
    laps: str | None = None
    keep: KeepFile | None = None


@dataclass(frozen=True)
class SplitFile:
    """What conf/split/*.yaml says. ``minutes`` cuts training and validation down to so many in all, as if no more had been recorded with
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
    plain = _spelt_out(dict(config), where) if isinstance(config, Mapping) else config
    return validated(SplitFile, plain, where, error=ConfigurationError, group="split")


def _spelt_out(config: dict[str, Any], where: str) -> dict[str, Any]:
    """Roles in short (``60 %``, ``last lap``) as ranges of all recordings; percentages follow one another, training first."""
    tests = config.get("tests")
    roles: dict[tuple[str, ...], Any] = {("train",): config.get("train"), (VALIDATION,): config.get(VALIDATION)}
    roles |= {("tests", str(name)): entries for name, entries in tests.items()} if isinstance(tests, Mapping) else {}
    done = 0.0
    ranges: dict[tuple[str, ...], Any] = {}
    for role, entries in roles.items():
        ranges[role] = entries
        if not isinstance(entries, str):
            continue
        if (share := PERCENT.fullmatch(entries)) is not None:
            begin, done = done, done + float(share[1])
            if done > 100.0 + 1e-9:
                raise ConfigurationError(f"{where}: the percentages come to {done:g} %, more than there is")
            ranges[role] = [{"recordings": "*", "start": f"{begin:g} %", "stop": f"{done:g} %"}]
        elif LAPS.fullmatch(entries) is not None:
            ranges[role] = [{"recordings": "*", "laps": entries}]
        else:
            what = f'a list of ranges, a percentage such as "60 %" or laps such as "last lap", not \'{entries[:60]}\''
            raise ConfigurationError(f"{where}: {'.'.join(role)} must be {what}")
    said = {key: ranges[(key,)] for key in ("train", VALIDATION) if key in config}
    if isinstance(tests, Mapping):
        said["tests"] = {name: ranges[("tests", str(name))] for name in tests}
    return {**config, **said}


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
    made = _split_of(told, ranges) if told.folds is None else _folded(told, told.folds, ranges)
    return made if told.minutes is None else _cut_down(made, told.minutes, told.minutes_at, ranges)


def _cut_down(split: Split, minutes: float, at: float, ranges: _Ranges) -> Split:
    """A split with less to learn from: validation keeps its share of what is left."""

    def bounds_of(span: Span) -> tuple[float, float]:
        recording = ranges.recording(span.dataset, span.recording)(None)
        return recording.start_time, recording.end_time

    def length(spans: Sequence[Span]) -> float:
        return sum(min(span.stop, bounds_of(span)[1]) - max(span.start, bounds_of(span)[0]) for span in spans)

    learnt, stopped = length(split.train), length(split.validation)
    share = 60.0 * minutes / (learnt + stopped)
    return replace(
        split,
        name=f"{split.name}_{minutes:g}min" + (f"_at_{at:g}" if at else ""),
        train=limit_minutes(split.train, share * learnt, at, bounds_of),
        validation=limit_minutes(split.validation, share * stopped, at, bounds_of),
    )


def _split_of(told: SplitFile, ranges: _Ranges) -> Split:
    """Ranges as they are written."""
    return Split(
        name=told.name,
        train=ranges.spans("train", told.train or ()),
        validation=ranges.spans(VALIDATION, told.validation or ()),
        tests={test: ranges.spans(test, entries) for test, entries in (told.tests or {}).items()},
        kept=ranges.kept,
    )


def _folded(told: SplitFile, folds: FoldsFile, ranges: _Ranges) -> Split:
    """One fold of a cross-validation."""
    where = f"split '{told.name}'"
    if told.train or told.validation or told.tests:
        raise ConfigurationError(f"{where}: folds make training, validation and test; leave train, validation and tests out")
    dataset = _dataset_of(RangeFile(recordings=folds.recordings), told.dataset, told.name)
    blocks = blocks_of(folds, {Span(dataset, name): ranges.recording(dataset, name) for name in ranges.matching(dataset, folds.recordings)})
    train, validation, test = fold_of(blocks, folds, told.fold, where)
    return Split(f"{told.name}_fold_{told.fold + 1}", train, validation, {"test": test})


def dataset_names(config: Mapping[str, Any]) -> list[str]:
    """Names of the data sets that a split's plain values draw on, sorted.

    Raises:
        ConfigurationError: as `split_from_config`, where a range names none.
    """
    told = _read(config)
    if told.folds is not None:
        return [_dataset_of(RangeFile(recordings=told.folds.recordings), told.dataset, told.name)]
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
        self._known: dict[str, Mapping[str, Reader]] = {}
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
        names = [entry.recording] if entry.recording is not None else self.matching(dataset, str(entry.recordings))
        return [self._span(dataset, name, entry) for name in names]

    def _span(self, dataset: str, name: str, entry: RangeFile) -> Span:
        """The stretch of one recording that an entry means."""
        if entry.laps is not None:
            if (entry.start, entry.stop) != (-math.inf, math.inf):
                raise ConfigurationError(f"split '{self._split}': a range has laps, or start and stop, not both: {_shown(entry)}")
            return Span(dataset, name, *self._laps(dataset, name, entry.laps))
        start, stop = entry.start, entry.stop
        return Span(dataset, name, self._time(dataset, name, start), self._time(dataset, name, stop))

    def _time(self, dataset: str, name: str, said: float | str) -> float:
        if not isinstance(said, str):
            return said
        share = PERCENT.fullmatch(said)
        if share is None or float(share[1]) > 100.0:
            raise ConfigurationError(f"split '{self._split}': start and stop are {SECONDS_OR_SHARE}, not '{said[:60]}'")
        if float(share[1]) in (0.0, 100.0):
            return -math.inf if float(share[1]) == 0.0 else math.inf
        recording = self.recording(dataset, name)(None)
        samples = round(float(share[1]) / 100.0 * len(recording))
        return recording.start_time + samples / recording.rate_hz

    def _laps(self, dataset: str, name: str, said: str) -> tuple[float, float]:
        found = LAPS.fullmatch(said)
        if found is None:
            what = "first, last, first 3, last 2, a number, or 2 to 4"
            raise ConfigurationError(f"split '{self._split}': laps are said as {what}, not '{said[:60]}'")
        end, number, first, last = found.groups()
        laps = laps_of(self.recording(dataset, name)(None))
        count = int(number or 1)
        begin = int(first) if first else 1 if end == "first" else len(laps) - count + 1
        stop = int(last or first) if first else begin + count - 1
        if not 1 <= begin <= stop <= len(laps):
            there = f"{len(laps)} complete laps were found" if laps else "its course does not repeat"
            missing = f"recording '{name}' has no '{said.strip()}': {there}"
            raise ConfigurationError(f"split '{self._split}': {missing}; name times instead")
        return laps[begin - 1][0], laps[stop - 1][1]

    def recording(self, dataset: str, name: str) -> Reader:
        """A recording of a data set, as a function that reads it.

        Raises:
            ConfigurationError: the data set does not have it.
        """
        recordings = self._recordings(dataset)
        if name not in recordings:
            raise ConfigurationError(f"split '{self._split}': data set '{dataset}' has no recording '{name}'")
        return recordings[name]

    def matching(self, dataset: str, pattern: str) -> list[str]:
        """Names of a data set's recordings that fit a pattern, sorted."""
        recordings = self._recordings(dataset)
        names = sorted(name for name in recordings if fnmatchcase(name, pattern))
        if not names:
            known = ", ".join([*sorted(recordings)[:5], *(["…"] if len(recordings) > 5 else [])])
            raise ConfigurationError(f"split '{self._split}': no recording of data set '{dataset}' matches '{pattern}' (it has {known})")
        return names

    def _recordings(self, dataset: str) -> Mapping[str, Reader]:
        if dataset not in self._known:
            if self._catalogue is None:
                raise ConfigurationError(f"split '{self._split}': its patterns and the like need the recordings of data set '{dataset}'")
            self._known[dataset] = self._catalogue(dataset)
        return self._known[dataset]

    def _cut(self, role: str, whole: Sequence[Span], condition: Condition) -> list[Span]:
        """Those stretches of spans in which a condition holds; notes how much that is."""
        spans: list[Span] = []
        seconds = of_seconds = 0.0
        for span in whole:
            recording = self.recording(span.dataset, span.recording)(condition.magnitude)
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
