"""What `vehest new` makes of logs that nobody has described: proposals, the data set that they come to, and what that reads.

Files are looked into by `vehest.sources.surveys`, columns are told apart by `vehest.alignment.proposals`; here both meet, and what comes
out is read again as `vehest ingest` would read it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehest.alignment.align import align
from vehest.alignment.checks import checks_of_recording
from vehest.alignment.findings import Finding
from vehest.alignment.proposals.assign import possible, propose
from vehest.alignment.proposals.lateness import Late, late_channels
from vehest.alignment.proposals.proposal import Proposal, Proposals
from vehest.alignment.settings import AlignmentSettings
from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.contents import Contents, contents_of
from vehest.data.errors import ConfigurationError, DataError, VehestError
from vehest.data.recording import Recording
from vehest.run.new_car_files import Located, located
from vehest.sources.base import open_source
from vehest.sources.columns import ClockPolicy, plain_rate, uniform_clock
from vehest.sources.surveys import Log, RawColumn, survey
from vehest.sources.surveys.clocks import UNITS
from vehest.sources.text_log import bridged
from vehest.sources.unit_spellings import plain_unit

EVIDENCE_HZ = 50.0
LONGEST_EVIDENCE = 1200.0  # s
ENDS = 1.0  # s at either end of a longer drive that do not count
POLICIES: tuple[ClockPolicy, ...] = ("strict", "interpolate", "uniform")
BAG_HZ = 100.0
MOST_SKIPPED = 5
LEAST_GAP = 0.05  # s
LONGEST_GAP = 1.0  # s that signals of a measurement may be missing
CLOCKWISE = {"vbo": "heading"}
"""Source -> column that counts a heading clockwise by its format."""
WEST_POSITIVE = ("vbo",)
TABLES = ("tabular", "text_log")
MOST_STRAY = 0.002  # of the rows
FEWEST_CHANGES = 50
LEAST_REPEATED = 3.0  # rows with the same sample
LAYOUT = {"delimiter": ",", "decimal": ".", "encoding": "utf8", "skip_rows": 0, "rows_below_names": 0, "runs": None}
"""Options that say how a table is laid out, with what holds where they are not said."""
CONTRADICTIONS = ("sign", "unit", "impossible")
"""Checks that say that a file's columns are others than those of the longest."""
BRIDGED = 1.0  # s without a sample that straight lines bridge
POSE_SECONDS = 0.15  # of the filter that differentiates poses


@dataclass(frozen=True)
class Vehicle:
    """What only who knows the car can say; None where nobody did.

    Args:
        wheelbase: [m].
        mass: [kg].
        steering_ratio: of the steering wheel's angle to the road wheels'.
    """

    wheelbase: float | None = None
    mass: float | None = None
    steering_ratio: float | None = None


@dataclass(frozen=True, eq=False)
class Examined:
    """Logs, and what is proposed for them.

    Args:
        name: of the data set to be.
        logs: in the order of the files.
        proposals: for all of them, by the longest.
        located: path and pattern of the files.
        rate_hz: sampling rate, where there are no times; None otherwise.
        evidence_seconds: of the drive that was looked at [s].
    """

    name: str
    logs: tuple[Log, ...]
    proposals: Proposals
    located: Located
    rate_hz: float | None = None
    evidence_seconds: float = 0.0

    def clocked(self, *, rate_hz: float | None = None, unit: str = "") -> Examined:
        """The same with another rate, or with the clock in another unit."""
        if unit and self.log.clock is not None:
            factor = UNITS[unit] / UNITS[self.log.clock.unit]
            logs = tuple(
                replace(log, clock=replace(log.clock, unit=unit, asked=False), seconds=log.seconds * factor)
                if log.clock is not None and log.seconds is not None
                else log
                for log in self.logs
            )
            return replace(self, logs=logs)
        return replace(self, rate_hz=rate_hz or self.rate_hz)

    @property
    def log(self) -> Log:
        """The one that shows how all are laid out."""
        return self.logs[0]


def examine(name: str, files: Sequence[Path]) -> Examined:
    """Look into files and propose what their columns are.

    Args:
        name: of the data set to be.
        files: of one format and one set of columns, a recording each.

    Raises:
        ConfigurationError: no file is given, or they are of several formats.
        MissingError: one is not there.
        DataError: one cannot be read, or lacks columns that another has.
    """
    if not files:
        raise ConfigurationError("name the files: vehest new my_car lap*.csv")
    logs = tuple(survey(file) for file in files)
    formats = {"text" if log.source in TABLES and not _is_parquet(log.file) else log.source for log in logs}
    if len(formats) > 1:
        raise ConfigurationError(f"the files are of several formats ({', '.join(sorted(formats))}); make a data set of each")
    longest = max(logs, key=_length)
    _refuse_other_layouts(longest, logs)
    longest = replace(longest, **_in_common(longest, logs))
    columns, rate, seconds = evidence_of(longest)
    proposals = propose(columns, rate, compass=CLOCKWISE.get(longest.source, ""), west_positive=longest.source in WEST_POSITIVE)
    if longest.source not in TABLES:  # other sources make no reference of positions
        proposals = replace(proposals, pose=())
    used = {one.column for one in proposals.channels}
    for log in logs:
        missing = sorted(used - {column.name for column in log.columns})
        if missing:
            raise DataError(f"'{log.file}' has no column '{missing[0]}', which '{longest.file}' has; give files of the same columns")
    for log in logs:
        if log.file != longest.file:
            proposals = possible(proposals, {column.name: column.values for column in log.columns})
    used = {one.column for one in proposals.channels}
    proposals = replace(proposals, notes=(*proposals.notes, *_notes(longest, logs), *_held_notes(longest, used)))
    if not proposals.channels:
        names = ", ".join(column.name for column in longest.columns[:8])
        raise DataError(f"'{longest.file}': no column could be told to be a channel, by name or by motion (it has {names})")
    constant = not longest.has_clock
    first = (longest, *(log for log in logs if log.file != longest.file))
    return Examined(name, first, proposals, located(files, longest.source), proposals.rate_hz if constant else None, seconds)


def _refuse_other_layouts(longest: Log, logs: Sequence[Log]) -> None:
    """See that one description fits all files.

    Raises:
        DataError: one is written otherwise, or has other times.
    """
    for log in logs:
        for key, default in LAYOUT.items():
            own, other = log.options.get(key, default), longest.options.get(key, default)
            if own != other:
                raise DataError(f"'{log.file}' has {key} {own!r}, '{longest.file}' {other!r}; write both alike, or make a data set of each")
        clocks = [None if one.clock is None else (one.clock.column, one.clock.unit) for one in (log, longest)]
        if clocks[0] != clocks[1]:
            told = ["no column of times" if clock is None else f"the times '{clock[0]}' in {clock[1]}" for clock in clocks]
            raise DataError(f"'{log.file}' has {told[0]}, '{longest.file}' {told[1]}; write both alike, or make a data set of each")


def _in_common(longest: Log, logs: Sequence[Log]) -> dict[str, Any]:
    """Source and options that read all files: marks of missing samples of any, times that restart in any."""
    options = dict(longest.options)
    marks = sorted({mark for log in logs for mark in log.options.get("missing", ())})
    options |= {"missing": marks} if marks else {}
    if "runs" not in options and any(log.options.get("time_restarts") for log in logs):
        options["time_restarts"] = True
    source = "text_log" if any(log.source == "text_log" for log in logs) else longest.source
    return {"options": options, "source": source}


def _notes(longest: Log, logs: Sequence[Log]) -> tuple[str, ...]:
    """What is to be known of the files themselves."""
    notes = [f"not read: {text}" for text in longest.skipped[:MOST_SKIPPED]]
    notes += [f"not read: {len(longest.skipped) - MOST_SKIPPED} more"] if len(longest.skipped) > MOST_SKIPPED else []
    for log in logs:
        for run in log.runs if log.seconds is not None else ():
            steps = np.diff(log.seconds[run]) if log.seconds is not None else np.zeros(0)
            if len(steps) and steps.max() > BRIDGED:
                at = float(log.seconds[run][int(np.argmax(steps))]) if log.seconds is not None else 0.0
                notes.append(
                    f"'{log.file.name}' has a gap of {steps.max():.3g} s, {at:.4g} s after its start, which lines bridge; cut it there"
                )
                break
    return tuple(notes)


def _held_notes(log: Log, used: Collection[str]) -> list[str]:
    """Columns whose samples rows repeat, beside others that change in every row."""
    if log.seconds is None or len(log.seconds) < 2:
        return []
    run = log.runs[0]
    repeats = {}
    for column in log.columns:
        values = column.values[run]
        changes = int(np.count_nonzero(np.diff(values[np.isfinite(values)])))
        repeats[column.name] = len(values) / changes if changes > FEWEST_CHANGES else math.inf
    held = [name for name in repeats if name in used and LEAST_REPEATED <= repeats[name] < math.inf]
    if not held or min(repeats.values()) > 1.5:
        return []
    rate, often = _rate(log.seconds[run]), min(repeats[name] for name in held)
    listed = ", ".join(f"'{name}'" for name in held)
    return [
        f"{listed}: a new value in one of {often:.2g} rows or fewer, {rate / often:.2g} Hz of {rate:.4g}; if rows repeat old samples "
        "there, declare them under held"
    ]


def _length(log: Log) -> float:
    return log.runs[0].stop - log.runs[0].start if log.runs else max(len(column.values) for column in log.columns)


def evidence_of(log: Log) -> tuple[list[tuple[str, str, FloatArray]], float | None, float]:
    """Columns of a log's longest run on an even clock of at most `EVIDENCE_HZ`, its rate [Hz], and its length [s].

    Of a long drive those minutes count in which most happens. Without times there is no rate, and rows are taken as they are.
    """
    own, rate = _on_one_clock(log)
    n_rows = len(own[0][2])
    if rate is None:
        return own, None, float(n_rows)
    if n_rows > 20.0 * ENDS * rate:
        cut = round(ENDS * rate)
        own = [(name, unit, values[cut:-cut]) for name, unit, values in own]
    factor = max(math.floor(rate / EVIDENCE_HZ), 1)
    slower = [(name, unit, _averaged(values, factor)) for name, unit, values in own]
    kept = _busiest([values for _, _, values in slower], round(LONGEST_EVIDENCE * rate / factor), round(60.0 * rate / factor))
    return [(name, unit, values[kept]) for name, unit, values in slower], rate / factor, n_rows / rate


def _on_one_clock(log: Log) -> tuple[list[tuple[str, str, FloatArray]], float | None]:
    if log.columns[0].stamps is not None:
        timed = [(column, column.stamps) for column in log.columns if column.stamps is not None and len(column.stamps) > 1]
        begin, end = (float(np.median([stamps[edge] for _, stamps in timed])) for edge in (0, -1))
        rate = plain_rate(min(max(_rate(stamps) for _, stamps in timed), EVIDENCE_HZ), 5e-3)
        grid = np.arange(begin, end, 1.0 / rate)
        return [(column.name, _unit(column), np.interp(grid, stamps, column.values)) for column, stamps in timed], rate
    run = log.runs[0]
    if log.seconds is None:
        return [(column.name, _unit(column), column.values[run]) for column in log.columns], None
    stamps = log.seconds[run]
    columns = [(column.name, _unit(column), bridged(column.values[run], stamps, BRIDGED)) for column in log.columns]
    step = float(np.median(np.diff(stamps))) or float(stamps[-1] - stamps[0]) / max(len(stamps) - 1, 1)
    rate = plain_rate(1.0 / step, 5e-3)
    even = np.arange(len(stamps)) / rate
    if np.abs(stamps - stamps[0] - even).max() <= 1.0 / rate:
        return columns, rate
    grid = np.arange(stamps[0], stamps[-1], 1.0 / rate)
    if len(grid) > 4 * len(stamps):
        return columns, rate
    return [(name, unit, np.interp(grid, stamps, values)) for name, unit, values in columns], rate


def _rate(stamps: FloatArray) -> float:
    return 1.0 / max(float(np.median(np.diff(stamps))), 1e-6)


def _unit(column: RawColumn) -> str:
    return plain_unit(column.unit) or ""


def _averaged(values: FloatArray, factor: int) -> FloatArray:
    return values if factor == 1 else values[: len(values) // factor * factor].reshape(-1, factor).mean(axis=1)


def _busiest(columns: Sequence[FloatArray], most: int, minute: int) -> slice:
    """Rows of the stretch in which the columns change most."""
    n_rows = len(columns[0])
    if n_rows <= most or minute < 2:
        return slice(0, n_rows)
    starts = np.arange(0, n_rows - minute, minute)
    activity = np.zeros(len(starts))
    for values in columns:
        size = float(np.nanstd(values))
        if size > 0.0 and math.isfinite(size):
            activity += np.nan_to_num([np.nanstd(values[start : start + minute]) / size for start in starts])
    width = max(most // minute, 1)
    totals = np.convolve(activity, np.ones(width), mode="valid") if len(activity) > width else activity[:1]
    first = int(starts[int(np.argmax(totals))])
    return slice(first, first + most)


# --- the data set -------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Draft:
    """The data set to be, and what is read by it.

    Args:
        examined: the logs.
        proposals: after what was answered.
        vehicle: what was told of the car.
        dataset: as conf/dataset will hold it.
        late: channel -> by how much it is late, in the longest recording.
        contents: of the recordings, as the data set makes them.
        findings: of the checks, of the longest recording.
        ratio: of the steering, as found with its uncertainty; None where it was told, or is not needed.
        notes: what came up on the way.
        seconds: all recordings together [s].
    """

    examined: Examined
    proposals: Proposals
    vehicle: Vehicle
    dataset: Mapping[str, Any]
    late: Mapping[str, Late]
    contents: tuple[Contents, ...]
    findings: tuple[Finding, ...] = ()
    ratio: tuple[float, float] | None = None
    notes: tuple[str, ...] = ()
    seconds: float = 0.0

    @property
    def has_reference(self) -> bool:
        """Whether estimates can be scored."""
        return "vy_ref" in frozenset.intersection(*(own.channels for own in self.contents))

    @property
    def remarks(self) -> tuple[Finding, ...]:
        """Findings that say something of the proposals."""
        return tuple(
            one for one in self.findings if one.check in ("sign", "unit", "impossible", "dropout", "stuck") and one.level != "note"
        )


def draft(examined: Examined, proposals: Proposals, vehicle: Vehicle) -> Draft:
    """The data set by proposals that were confirmed or corrected, read as an ingest would read it.

    Raises:
        VehestError: it cannot be read by it.
    """
    if not proposals.channels:
        raise ConfigurationError("no column is left that would be a channel")
    dataset = _dataset(examined, proposals)
    plain = {**dataset, "transforms": _speed(proposals)}
    longest = max(_recordings(plain), key=lambda own: own.duration)
    late, findings = late_channels(longest), checks_of_recording(longest)
    ratio, notes = None, list(proposals.notes)
    for stem, rows in dict(dataset.get("drop_rows") or {}).items():
        listed = ", ".join(map(str, rows[:MOST_SKIPPED])) + (", …" if len(rows) > MOST_SKIPPED else "")
        notes.append(f"left out of '{stem}' by drop_rows, beyond what a vehicle can do: data row{'s' * (len(rows) > 1)} {listed}")
    if vehicle.wheelbase and vehicle.steering_ratio is None and "handwheel" in longest:
        try:
            found = align(longest, AlignmentSettings(("steering_ratio",), wheelbase=vehicle.wheelbase))["steering_ratio"]
            ratio = (found.value, found.uncertainty)
        except VehestError as error:
            notes.append(f"the steering ratio could not be estimated: {error}")
    channels = frozenset(longest.channels)
    dataset = {**dataset, "transforms": _transforms(proposals, channels, longest.rate_hz, late, vehicle, ratio)}
    recordings = list(_recordings(dataset))
    delayed = tuple(
        replace(one, delay=late[one.channel].delay).with_evidence(late[one.channel].evidence) if one.channel in late else one
        for one in proposals.channels
    )
    return Draft(
        examined,
        replace(proposals, channels=delayed),
        vehicle,
        dataset,
        late,
        tuple(contents_of(own) for own in recordings),
        (*findings, *_of_other_files(recordings, longest)),
        ratio,
        tuple(notes),
        sum(own.duration for own in recordings),
    )


def _of_other_files(recordings: Sequence[Recording], longest: Recording) -> list[Finding]:
    """What contradicts the proposals in the longest recording of each file that they were not made of."""
    by_file: dict[str, Recording] = {}
    for own in recordings:
        file = str(own.provenance.get("file", ""))
        if file not in by_file or own.duration > by_file[file].duration:
            by_file[file] = own
    others = [own for file, own in by_file.items() if file != str(longest.provenance.get("file", ""))]
    return [
        replace(one, message=f"in '{own.id}', {one.message}")
        for own in others
        for one in checks_of_recording(own)
        if one.check in CONTRADICTIONS
    ]


def _recordings(dataset: Mapping[str, Any]) -> list[Recording]:
    source = open_source(dataset)
    return [source.read(name) for name in source.ids()]


def _dataset(examined: Examined, proposals: Proposals) -> dict[str, Any]:
    """Without transforms."""
    log, name = examined.log, examined.name
    common: dict[str, Any] = {
        "name": name,
        "title": f"Recordings of {name}",
        "kind": "real",
        "vehicle": name,
        "licence": "yours",
        "citation": "none",
    }
    common |= {"source": log.source, "path": str(examined.located.path)}
    if log.source == "rosbag":
        return common | _bag_options(examined, proposals)
    columns = {column.name: column for column in log.columns}
    channels = {one.channel: _entry(one, columns[one.column].place) for one in proposals.channels}
    common |= {"files": examined.located.pattern}
    if log.source == "mdf":
        return common | _mdf_options(columns, proposals, channels)
    common |= {"exclude": list(examined.located.exclude)} if examined.located.exclude else {}
    common |= dict(log.options)
    if log.source != "vbo":
        common["time"] = None if log.clock is None else {"column": log.clock.column, "unit": log.clock.unit}
        if log.clock is None:
            common["rate_hz"] = examined.rate_hz
    stray = _stray_rows(examined, proposals) if log.source in TABLES and log.clock is not None else {}
    common |= {"drop_rows": {stem: rows.tolist() for stem, rows in stray.items()}} if stray else {}
    common["clock"] = _policy(examined, len(channels), stray)
    gaps = {one.channel: _longest_gap(examined, one.column) for one in proposals.channels}
    short = [gap for gap in gaps.values() if 0.0 < gap <= BRIDGED]
    if short and log.source in TABLES and not _is_parquet(log.file):
        common |= {"source": "text_log", "bridge": math.ceil(100.0 * max(short) * 1.05) / 100.0}
        gaps = {name: gap for name, gap in gaps.items() if gap > BRIDGED}
    common |= {"channels": channels, "gappy": [name for name, gap in gaps.items() if gap > 0.0]}
    if proposals.pose:
        rate = _rate(log.seconds) if log.seconds is not None else float(examined.rate_hz or EVIDENCE_HZ)
        parts = {part: {"column": column, "unit": unit} for part, column, unit in proposals.pose}
        made = [name for name in ("vx_ref", "vy_ref", "yaw_rate_ref", "sideslip_ref") if name not in channels]
        common["pose"] = {**parts, "window": max(2 * round(POSE_SECONDS * rate / 2.0) + 1, 5), "order": 2, "channels": made}
    return common


def _stray_rows(examined: Examined, proposals: Proposals) -> dict[str, NDArray[np.int64]]:
    """File's stem -> rows, from 1, in which a channel is beyond what a vehicle can do, where they are few, as spikes are."""
    found = {}
    for log in examined.logs:
        columns = {column.name: column.values for column in log.columns}
        beyond = np.zeros(len(next(iter(columns.values()))), dtype=bool)
        for one in proposals.channels:
            beyond |= one.beyond(columns[one.column])
        if 0.0 < beyond.mean() <= MOST_STRAY:
            found[log.file.stem] = np.flatnonzero(beyond) + 1
    return found


def _is_parquet(file: Path) -> bool:
    return file.suffix.lower() in (".parquet", ".pq")


def _longest_gap(examined: Examined, column: str) -> float:
    """Longest time without a sample in any file [s]; infinite where there are no times, 0 where none is missing."""
    longest = 0.0
    for log in examined.logs:
        values = next(own.values for own in log.columns if own.name == column)
        known = np.isfinite(values)
        if known.all():
            continue
        seconds = log.seconds if log.seconds is not None else np.arange(len(values)) / float(examined.rate_hz or EVIDENCE_HZ)
        for run in log.runs:
            edges = np.concatenate([seconds[run][:1], seconds[run][known[run]], seconds[run][-1:]])
            longest = max(longest, float(np.diff(edges).max(initial=0.0))) if known[run].any() else math.inf
    return longest


def _entry(one: Proposal, place: Mapping[str, Any]) -> dict[str, Any]:
    """A channel's declaration."""
    entry = {**place, "unit": one.unit}
    entry |= {"sign": one.sign} if one.sign != 1 else {}
    return entry | ({"factor": one.factor} if one.factor != 1.0 else {})


def _policy(examined: Examined, n_channels: int, stray: Mapping[str, NDArray[np.int64]]) -> ClockPolicy:
    """The strictest clock that all runs of all files keep, without the rows that are left out."""
    for policy in POLICIES if examined.log.source != "vbo" else POLICIES[:2]:
        try:
            for log in examined.logs:
                for run in log.runs if log.seconds is not None else ():
                    assert log.seconds is not None
                    left_out = stray.get(log.file.stem, np.empty(0, dtype=np.int64)) - 1
                    rows = np.setdiff1d(np.arange(run.start, run.stop), left_out)
                    if len(rows) > 1:
                        uniform_clock(log.seconds[rows], f"'{log.file}'", policy, n_channels=n_channels)
            return policy
        except DataError:
            continue
    return "strict"


def _mdf_options(columns: Mapping[str, RawColumn], proposals: Proposals, channels: dict[str, dict[str, Any]]) -> dict[str, Any]:
    rates = []
    for one in proposals.channels:
        stamps = columns[one.column].stamps
        assert stamps is not None
        rates.append(_rate(stamps))
        gap = float(np.diff(stamps).max())
        if gap > 3.0 / rates[-1] and gap <= LONGEST_GAP:
            channels[one.channel]["max_gap"] = math.ceil(100.0 * gap) / 100.0
    return {
        "rate_hz": plain_rate(max(rates), 5e-3),
        "channels": channels,
        "gappy": [one.channel for one in proposals.channels if one.gappy],
    }


def _bag_options(examined: Examined, proposals: Proposals) -> dict[str, Any]:
    columns = {column.name: column for column in examined.log.columns}
    names: dict[str, str] = {}
    topics: dict[str, dict[str, Any]] = {}
    channels: dict[str, dict[str, Any]] = {}
    rates = []
    for one in proposals.channels:
        place, stamps = columns[one.column].place, columns[one.column].stamps
        assert stamps is not None
        topic = str(place["topic"])
        if topic not in names:
            short = topic.strip("/").replace("/", "_")
            names[topic] = short
            rates.append(_rate(stamps))
            gap = max(LEAST_GAP, math.ceil(150.0 * float(np.diff(stamps).max())) / 100.0)
            topics[short] = {"topic": topic, "type": place["type"], "stamps": place["stamps"], "max_gap": gap}
        entry = {"topic": names[topic], "field": place["field"], "unit": one.unit}
        entry |= {"sign": one.sign} if one.sign != 1 else {}
        entry |= {"factor": one.factor} if one.factor != 1.0 else {}
        channels[one.channel] = entry | ({"offset": float(f"{one.offset:.5g}")} if one.offset else {})
    rate = plain_rate(min(max(rates), BAG_HZ), 5e-3)
    return {"files": [file.name for file in examined.located.files], "rate_hz": rate, "topics": topics, "channels": channels}


def _speed(proposals: Proposals) -> list[dict[str, Any]]:
    """What makes vx of wheels."""
    if proposals.wheel_radius is None:
        return []
    return [{"name": "speed_from_wheels", "wheel_radius": proposals.wheel_radius}]


def _transforms(
    proposals: Proposals,
    channels: frozenset[str],
    rate_hz: float,
    late: Mapping[str, Late],
    vehicle: Vehicle,
    ratio: tuple[float, float] | None,
) -> list[dict[str, Any]]:
    """What makes the channels that estimators want of those that are there.

    A reference that is late is put on the others' clock; a measured channel is not, since an estimator in the car would get it late, too.
    """
    made: list[dict[str, Any]] = []
    for name, own in late.items():
        if CHANNELS[name].is_reference:
            made.append({"name": "delay_correction", "delay": own.delay, "channels": [name]})
    offsets = {one.channel: float(f"{one.factor * one.sign * one.offset:.5g}") for one in proposals.channels if one.offset}
    if offsets and not any(one.column.startswith("/") for one in proposals.channels if one.offset):
        made.append({"name": "offset_correction", "offsets": offsets})
    made += _speed(proposals)
    if "sideslip_ref" in channels and "vy_ref" not in channels and {"vx", "vx_ref"} & channels:
        made.append({"name": "velocity_from_sideslip"})
    if "ax" not in channels and "vx" in channels:
        usual = rate_hz > 10.0
        made.append({"name": "acceleration_from_speed"} | ({} if usual else {"cutoff_hz": 0.2 * rate_hz}))
    told = vehicle.steering_ratio or (ratio[0] if ratio else None)
    if "handwheel" in channels and "steer" not in channels and told:
        made.append({"name": "steering_ratio", "ratio": float(f"{told:.4g}")})
    return made
