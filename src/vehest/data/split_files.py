"""Reads splits as conf/split/*.yaml holds them: ranges, patterns of recordings, conditions,
percentages, laps and folds.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from typing import Annotated, Any

from pydantic import Field, PositiveFloat

from vehest.data.errors import ConfigurationError, first_of
from vehest.data.folds import FoldsFile, blocks_of, fold_of
from vehest.data.laps import laps_of
from vehest.data.recording import Recording
from vehest.data.schema import validated
from vehest.data.splits import VALIDATION, Span, Split
from vehest.data.stretches import Condition, stretches_where

# reads the named channels of one recording, None for all
Reader = Callable[[Iterable[str] | None], Recording]
# name of a data set -> its recordings as ingested, id -> reader
Catalogue = Callable[[str], Mapping[str, Reader]]

PERCENT = re.compile(r"\s*(\d+(?:\.\d+)?)\s*%\s*")  # matches a percentage
# matches laps, such as ``last lap`` or ``2 to 5``
LAPS = re.compile(r"\s*(?:(first|last)(?:\s+(\d+))?|(\d+)(?:\s*(?:to|-)\s*(\d+))?)(?:\s+laps?)?\s*")
# text on what a start or stop may be, for messages
SECONDS_OR_SHARE = 'a number of seconds or a percentage such as "60 %"'
# s, shortest segment of limited minutes; a shorter one holds no window after the start that is not
# scored
MIN_PIECE_SECONDS = 3.0


@dataclass(frozen=True)
class RangeFile:
    """A range of conf/split/*.yaml: a recording or a pattern of several.

    Start to stop [s or %] or some laps; else raises `ValueError`.
    """

    dataset: str | None = None  # name of the data set; None: that of the split
    recording: str | None = None  # id of the one recording
    recordings: str | None = None  # pattern of the ids of several
    start: Annotated[float | str, SECONDS_OR_SHARE] = -math.inf  # start of the range
    stop: Annotated[float | str, SECONDS_OR_SHARE] = math.inf  # end of the range
    laps: str | None = None  # laps of the range, such as ``last lap``
    keep: Condition | None = None  # condition on the segments of the range that are used

    def __post_init__(self) -> None:
        if (self.recording is None) == (self.recordings is None):
            raise ValueError("a range needs a recording or recordings, a pattern of several")
        if self.laps is not None and (self.start, self.stop) != (-math.inf, math.inf):
            raise ValueError("a range has laps, or start and stop, not both")


@dataclass(frozen=True)
class SplitFile:
    """Content of conf/split/*.yaml."""

    name: str = "unnamed"  # name of the split
    title: str | None = None  # title for people
    dataset: str | None = None  # data set of the ranges that name none
    train: tuple[RangeFile, ...] = ()  # ranges to learn from
    validation: tuple[RangeFile, ...] = ()  # ranges for early stopping
    # name of a test set -> its ranges
    tests: dict[str, tuple[RangeFile, ...]] = field(default_factory=dict)
    folds: FoldsFile | None = None  # cross-validation in place of ranges
    fold: int = 0  # index of the fold that is tested, from 0
    # training and validation are cut down to so many minutes in all, as if no more had been
    # recorded with a reference
    minutes: PositiveFloat | None = None
    # share of the ranges' length at which the minutes begin
    minutes_at: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0

    def dataset_of(self, entry: RangeFile | None = None) -> str:
        """Data set of a range, or of the folds."""
        dataset = (entry.dataset if entry else None) or self.dataset
        if dataset is None:
            raise ConfigurationError(
                f"split '{self.name}': each range needs a dataset, or the split has one for all"
            )
        return dataset


def _read(config: Any) -> SplitFile:
    """The content of a split's configuration, short forms written out and validated; raises
    `ConfigurationError`.
    """
    name = config.get("name") if isinstance(config, Mapping) else None
    subject = f"split '{name}'" if isinstance(name, str) else ""
    plain = _spelt_out(config, subject) if isinstance(config, Mapping) else config
    return validated(SplitFile, plain, subject, error=ConfigurationError, group="split")


def _spelt_out(config: Mapping[str, Any], subject: str) -> dict[str, Any]:
    """Roles in short (``60 %``, ``last lap``) as ranges of all recordings.

    Percentages follow one another, training first.
    """
    done = 0.0

    def ranges(role: str, entries: Any) -> Any:
        nonlocal done
        if not isinstance(entries, str):
            return entries
        if (share := PERCENT.fullmatch(entries)) is not None:
            begin = done
            done = done + float(share[1])
            if done > 100.0 + 1e-9:
                raise ConfigurationError(
                    f"{subject}: the percentages come to {done:g} %, more than there is"
                )
            return [{"recordings": "*", "start": f"{begin:g} %", "stop": f"{done:g} %"}]
        if LAPS.fullmatch(entries) is not None:
            return [{"recordings": "*", "laps": entries}]
        expected = (
            'a list of ranges, a percentage such as "60 %" or laps such as "last lap", not '
            f"'{entries[:60]}'"
        )
        raise ConfigurationError(f"{subject}: {role} must be {expected}")

    content = {key: value for key, value in config.items() if value is not None}
    content |= {
        role: ranges(role, content[role]) for role in ("train", VALIDATION) if role in content
    }
    if isinstance(tests := content.get("tests"), Mapping):
        content["tests"] = {
            name: ranges(f"tests.{name}", entries) for name, entries in tests.items()
        }
    return content


def split_from_config(config: Mapping[str, Any], catalogue: Catalogue | None = None) -> Split:
    """Build a split from plain values, as conf/split/*.yaml holds them.

    The recordings, ``catalogue``, are needed only where a pattern, a condition, percentages, laps
    or folds name or cut them.

    Raises
    ------
    ConfigurationError
        A key is missing, misspelt or of the wrong type; a pattern that no recording's id matches; a
        condition that none meets; or one of them without a catalogue.
    DataError
        A recording lacks a channel that a condition looks at.
    """
    ranges = _Ranges(_read(config), catalogue)
    return ranges.limited(ranges.split())


def dataset_names(config: Mapping[str, Any]) -> list[str]:
    """Names of the data sets that a split's plain values draw on, sorted.

    Raises
    ------
    ConfigurationError
        A range names none.
    """
    file = _read(config)
    entries = [
        entry
        for entries in (file.train, file.validation, *file.tests.values())
        for entry in entries
    ]
    return (
        [file.dataset_of()] if file.folds else sorted({file.dataset_of(entry) for entry in entries})
    )


def limit_minutes(spans: Sequence[Span], seconds: float, at: float) -> tuple[Span, ...]:
    """Cut ranges to a total length: a segment of the ranges laid end to end, which wraps around at
    the end.

    Parameters
    ----------
    spans : sequence of Span
        Ranges whose ends are finite.
    seconds : float
        Length of the stretch, at most that of all ranges [s].
    at : float
        Share of the whole at which it begins, from 0 to 1.

    Returns
    -------
    tuple of Span
        In the order of ``spans``; pieces shorter than `MIN_PIECE_SECONDS` are left out, unless all
        are.
    """
    total = _seconds_of(spans)
    begin = at * total
    upper = _between(spans, begin, min(begin + seconds, total))
    pieces = (*_between(spans, 0.0, begin + seconds - total), *upper)
    return (
        tuple(piece for piece in pieces if piece.stop - piece.start >= MIN_PIECE_SECONDS) or pieces
    )


def _seconds_of(spans: Iterable[Span]) -> float:
    """Length of all ranges together [s]."""
    return sum(span.stop - span.start for span in spans)


def _between(spans: Sequence[Span], begin: float, end: float) -> list[Span]:
    """Parts of ranges laid end to end that lie between two times of that common time axis [s]."""
    pieces = []
    position = 0.0
    for span in spans:
        length = span.stop - span.start
        start = max(begin - position, 0.0)
        stop = min(end - position, length)
        if stop - start > 1e-9:
            pieces.append(replace(span, start=span.start + start, stop=span.start + stop))
        position += length
    return pieces


class _Ranges:
    """Resolves the ranges of a split's file into spans of recordings."""

    def __init__(self, file: SplitFile, catalogue: Catalogue | None) -> None:
        self._file = file
        self._catalogue = catalogue
        self._subject = f"split '{file.name}'"
        self._catalogues: dict[str, Mapping[str, Reader]] = {}

    def split(self) -> Split:
        """The split of the ranges, or of one fold of a cross-validation.

        Raises
        ------
        ConfigurationError
            Folds are declared beside roles, or a range cannot be found.
        DataError
            A recording cannot be read or lacks a channel that laps or conditions need.
        """
        file = self._file
        folds = self._file.folds
        if folds is None:
            train = self._spans("train", file.train)
            validation = self._spans(VALIDATION, file.validation)
            tests = {test: self._spans(test, entries) for test, entries in file.tests.items()}
            return Split(file.name, train, validation, tests)
        if file.train or file.validation or file.tests:
            raise ConfigurationError(
                f"{self._subject}: folds make training, validation and test; leave train, "
                "validation "
                "and tests out"
            )
        dataset = file.dataset_of()
        recordings = (
            (Span(dataset, name), self._recording(dataset, name))
            for name in self._matching(dataset, folds.recordings)
        )
        train, validation, test = fold_of(
            blocks_of(folds, recordings), folds, file.fold, self._subject
        )
        return Split(f"{file.name}_fold_{file.fold + 1}", train, validation, {"test": test})

    def limited(self, split: Split) -> Split:
        """The split with fewer minutes to learn from, of which validation keeps its share."""
        minutes = self._file.minutes
        at = self._file.minutes_at
        if minutes is None:
            return split
        train, validation = (
            tuple(self._with_ends(span) for span in spans)
            for spans in (split.train, split.validation)
        )
        share = 60.0 * minutes / (_seconds_of(train) + _seconds_of(validation))
        named = replace(split, name=f"{split.name}_{minutes:g}min" + (f"_at_{at:g}" if at else ""))
        if share >= 1.0:
            return named
        train, validation = (
            limit_minutes(spans, share * _seconds_of(spans), at) for spans in (train, validation)
        )
        return replace(named, train=train, validation=validation)

    def _with_ends(self, span: Span) -> Span:
        """A range whose start and stop, which may be infinite, lie within its recording [s]."""
        recording = self._recording(span.dataset, span.recording)
        return replace(
            span,
            start=max(span.start, recording.start_time),
            stop=min(span.stop, recording.end_time),
        )

    def _spans(self, role: str, entries: Sequence[RangeFile]) -> tuple[Span, ...]:
        """Ranges of a role: one for each recording that an entry names or whose name its pattern
        matches.

        Those of an entry with ``keep`` are cut further.
        """
        spans: list[Span] = []
        for entry in entries:
            dataset = self._file.dataset_of(entry)
            names = (
                [entry.recording]
                if entry.recording is not None
                else self._matching(dataset, str(entry.recordings))
            )
            ranges = [Span(dataset, name, *self._bounds(dataset, name, entry)) for name in names]
            spans += ranges if entry.keep is None else self._cut(role, ranges, entry.keep)
        return tuple(spans)

    def _bounds(self, dataset: str, name: str, entry: RangeFile) -> tuple[float, float]:
        """Start and stop [s] of an entry in a recording, by laps or by times; infinite for its
        ends.
        """
        if entry.laps is not None:
            return self._laps(dataset, name, entry.laps)
        return self._time(dataset, name, entry.start), self._time(dataset, name, entry.stop)

    def _time(self, dataset: str, name: str, bound: float | str) -> float:
        """A time [s], or that of a share of a recording's samples; infinite for 0 and 100 %.

        Raises
        ------
        ConfigurationError
            The text is no share from 0 to 100 %.
        """
        if not isinstance(bound, str):
            return bound
        match = PERCENT.fullmatch(bound)
        share = float(match[1]) if match else math.inf
        if share > 100.0:
            raise ConfigurationError(
                f"{self._subject}: start and stop are {SECONDS_OR_SHARE}, not '{bound[:60]}'"
            )
        if share in (0.0, 100.0):
            return -math.inf if share == 0.0 else math.inf
        recording = self._recording(dataset, name)
        return recording.start_time + round(share / 100.0 * len(recording)) / recording.rate_hz

    def _laps(self, dataset: str, name: str, words: str) -> tuple[float, float]:
        """Start of the first and end of the last of the laps that words name [s].

        Raises
        ------
        ConfigurationError
            The words name no laps, or the recording has no such complete laps.
        """
        match = LAPS.fullmatch(words)
        if match is None:
            raise ConfigurationError(
                f"{self._subject}: laps are first, last, first 3, last 2, a number, or 2 to 4, not "
                f"'{words[:60]}'"
            )
        end, number, first, last = match.groups()
        laps = laps_of(self._recording(dataset, name))
        count = int(number or 1)
        begin = int(first) if first else 1 if end == "first" else len(laps) - count + 1
        stop = int(last or first) if first else begin + count - 1
        if not 1 <= begin <= stop <= len(laps):
            found = f"{len(laps)} complete laps were found"
            raise ConfigurationError(
                f"{self._subject}: recording '{name}' has no '{words.strip()}': "
                f"{found if laps else 'its course does not repeat'}; name times instead"
            )
        return laps[begin - 1][0], laps[stop - 1][1]

    def _recording(
        self, dataset: str, name: str, channels: Iterable[str] | None = None
    ) -> Recording:
        """A recording with some of its channels, None for all; `ConfigurationError` where there is
        none.
        """
        recordings = self._recordings(dataset)
        if name not in recordings:
            raise ConfigurationError(
                f"{self._subject}: data set '{dataset}' has no recording '{name}'"
            )
        return recordings[name](channels)

    def _matching(self, dataset: str, pattern: str) -> list[str]:
        """Names of a data set's recordings that fit a pattern, sorted."""
        recordings = self._recordings(dataset)
        names = sorted(name for name in recordings if fnmatchcase(name, pattern))
        if not names:
            raise ConfigurationError(
                f"{self._subject}: no recording of data set '{dataset}' matches '{pattern}' (it "
                f"has {first_of(sorted(recordings), 5)})"
            )
        return names

    def _recordings(self, dataset: str) -> Mapping[str, Reader]:
        """Readers of a data set's recordings by name, looked up once.

        Raises
        ------
        ConfigurationError
            They are needed, and no catalogue of data sets is given.
        """
        if dataset not in self._catalogues:
            if self._catalogue is None:
                raise ConfigurationError(
                    f"{self._subject}: its patterns and the like need the recordings of data set "
                    f"'{dataset}'"
                )
            self._catalogues[dataset] = self._catalogue(dataset)
        return self._catalogues[dataset]

    def _cut(self, role: str, ranges: Sequence[Span], condition: Condition) -> list[Span]:
        """Segments of spans in which a condition holds."""
        spans: list[Span] = []
        for span in ranges:
            recording = self._recording(span.dataset, span.recording, condition.magnitude)
            first, end = recording.index_range(span.start, span.stop)
            for begin, after in stretches_where(recording, condition, first, end):
                start = (
                    span.start
                    if begin == first
                    else recording.start_time + begin / recording.rate_hz
                )
                stop = (
                    span.stop if after == end else recording.start_time + after / recording.rate_hz
                )
                spans.append(replace(span, start=start, stop=stop))
        if not spans:
            raise ConfigurationError(
                f"{self._subject}: the condition of {role} keeps nothing ({condition.describe()})"
            )
        return spans
