"""Inspects logs that no data set describes yet: files -> surveys -> evidence on one clock ->
proposals of channels, units and signs.
"""

from __future__ import annotations

import glob
import math
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import filter as matching
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from vehest.alignment.proposals.assign import MAX_DECADE_ERROR, possible, propose
from vehest.alignment.proposals.columns import correlation, magnitudes_beside_signs
from vehest.alignment.proposals.names import hints
from vehest.alignment.proposals.proposal import Proposals
from vehest.configuration.composition import compose_config
from vehest.configuration.files import choices
from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError, DataError, counted
from vehest.data.limits import check_limit, limits_from_config, use_limits
from vehest.data.recording import Kind
from vehest.data.splits import check_name
from vehest.sources.base import source_names
from vehest.sources.can.logs import SUFFIXES
from vehest.sources.clocks import INTERPOLATED_TOLERANCE, bridged, plain_rate, typical_step
from vehest.sources.columns import signed
from vehest.sources.surveys import Log, survey
from vehest.sources.surveys.clocks import STATED_UNITS, between_pauses
from vehest.sources.tables import is_text
from vehest.sources.unit_spellings import plain_unit

# Hz, highest rate of the samples that proposals rest on; faster ones are averaged
EVIDENCE_HZ = 50.0
# smallest share of a log that a column must cover, so that the evidence is restricted to its time
MIN_COVERED = 0.5
MAX_EVIDENCE_SECONDS = 1200.0  # s; of a longer log the busiest parts are used
END_SECONDS = 1.0  # s at either end of a longer drive that do not count
# s without a sample that straight lines bridge: as between fixes of a satellite receiver of 1 Hz
MAX_BRIDGED_SECONDS = 1.1
MAX_LISTED = 5  # parts of a log that were not read, in a message; further ones are counted
# rows in the middle of a log, by which a column is found to be the difference of another one
MAX_COMPARED_ROWS = 4_000
USUAL_STEP_QUANTILE = 0.99  # quantile of a velocity's |steps|, above which rows are not compared
# |correlation| with these steps, above which a column is their difference
MIN_DIFFERENCE_CORRELATION = 0.999
TABLES = ("tabular", "text_log")  # sources of tables: text, Parquet and MAT-files
DBC = ".dbc"  # suffix of a description of a CAN bus
LAYOUT = {
    "delimiter": ",",
    "decimal": ".",
    "encoding": "utf8",
    "skip_rows": 0,
    "rows_below_names": 0,
    "runs": None,
}
"""Options of a table's layout with their defaults."""
VEHICLE = {
    "wheelbase": (
        "wheelbase [m], if known (for the self-calibrating filter, the steering ratio and the "
        "data_sheet baseline)"
    ),
    "mass": "mass [kg], if known (with the wheelbase, for single-track filters)",
    "steering_ratio": (
        "overall steering ratio, if known (else estimated from slow corners, with the wheelbase)"
    ),
}
"""Value of the car that no log contains -> text of its question."""
IMU_PLACE = "imu_to_rear_axle"
"""Key of a further value, which is always asked for: the distance of the inertial unit from the
rear axle [m], negative behind it.
"""


@dataclass(frozen=True, eq=False)
class Examined:
    """Logs with the proposals for their columns, and what is known of the car."""

    name: str  # name of the data set
    files: tuple[Path, ...]  # files, in the order of the command
    logs: tuple[Log, ...]  # the longest first; its layout is that of all
    proposals: Proposals  # proposals for all logs
    place: dict[str, Any]  # options ``path``, ``files`` and ``exclude`` of the data set
    rate_hz: float | None  # sampling rate of logs without times; else None
    vehicle: Mapping[str, float | None]  # values of `VEHICLE` and `IMU_PLACE`, None where unknown
    kind: Kind = "real"  # whether a real car or a simulation wrote the logs

    @property
    def log(self) -> Log:
        """The longest log."""
        return self.logs[0]

    @property
    def pose_columns(self) -> dict[str, dict[str, str]]:
        """Component of the poses -> its column and unit, as a data set declares them."""
        return {
            part: {"column": column, "unit": unit} for part, column, unit in self.proposals.pose
        }

    def in_words(self) -> list[str]:
        """Lines for a terminal on the files and the proposals."""
        proposals = self.proposals
        lines = [f"read {file}" for file in self.files]
        lines += [
            f"{'?' if proposal.question else ' '} {proposal.describe()}"
            for proposal in proposals.channels
        ]
        lines += [f"  left/right: {proposals.left_right}"] if proposals.left_right else []
        if proposals.unused:
            lines.append(f"  columns without a channel: {counted(proposals.unused)}")
        return lines


def inspect(
    name: str,
    files: Sequence[Path],
    vehicle: Mapping[str, float | None] | None = None,
    *,
    force: bool = False,
) -> Examined:
    """Read logs and propose a channel, unit and sign for each column.

    Parameters
    ----------
    name : str
        Of the data set.
    files : sequence of Path
        Of one format, with the same columns; among logs of a CAN bus its DBC.
    vehicle : mapping of str to float or None, optional
        Values of `VEHICLE`.
    force : bool
        Whether the files of the data set may exist.

    Raises
    ------
    ConfigurationError
        The name is taken, the files are of several formats or folders, or a DBC is not beside logs
        of a bus.
    MissingError
        A file does not exist.
    DataError
        A file cannot be read.
    """
    check_name(name, "data set")
    existing = [file for file in paths_of(name) if os.path.lexists(file)]
    if existing and not force:
        raise ConfigurationError(
            f"'{existing[0]}' exists already; use another name, or --force to overwrite it"
        )
    if name in source_names():
        raise ConfigurationError(f"'{name}' is a built-in source; use another name")
    files, dbc = _divided(files)
    with use_limits(limits_from_config(compose_config("estimate")["limits"])):
        logs = [_with_signs(_at_stated_rate(survey(file, dbc))) for file in files]
    longest = _longest(logs)
    others = [log for log in logs if log.file != longest.file]
    differences = _differences(longest)
    columns, rate = _evidence(longest, differences)
    is_guessed = longest.clock is not None and not longest.clock.is_stated
    is_vbo = longest.source == "vbo"
    proposals = propose(columns, rate, is_vbo=is_vbo, is_rate_sure=not is_guessed)
    if rate is not None and proposals.rate_hz is not None:
        ratio = proposals.rate_hz / rate
        reason = "ax equals d(vx)/dt at"
        corrected = [_with_corrected_clock(log, ratio, reason) for log in (longest, *others)]
        if corrected[0] is longest:
            proposals = propose(columns, rate, is_vbo=is_vbo)
        longest, *others = corrected
        logs = corrected
        proposals = replace(proposals, rate_hz=None)
    if longest.source not in TABLES:  # other sources make no reference of positions
        proposals = replace(proposals, pose=())
    for log in others:
        missing = [
            proposal for proposal in proposals.channels if proposal.column not in log.by_name
        ]
        notes = [
            f"'{proposal.column}' ({proposal.channel}) is left out: it is missing or empty in "
            f"'{log.file}'"
            for proposal in missing
        ]
        remaining = [proposal for proposal in proposals.channels if proposal not in missing]
        if missing and not remaining:
            raise DataError(
                f"'{log.file}' has none of the columns that are channels in '{longest.file}'; use "
                f"files with the same columns{_way_to_join(longest, log)}"
            )
        proposals = proposals.keeping(remaining, notes)
        assigned = {proposal.column for proposal in remaining}
        for column in longest.columns:
            unit = log.by_name[column.name].unit if column.name in assigned else column.unit
            if unit != column.unit:
                raise DataError(
                    f"'{log.file}' has '{column.name}' in '{unit}', '{longest.file}' in "
                    f"'{column.unit}'; use the same unit in both, or create a data set for each"
                )
        proposals = possible(proposals, {column.name: column.values for column in log.columns})
    if not proposals.channels:
        names = counted([column.name for column in longest.columns])
        raise DataError(
            f"'{longest.file}': no column is recognised as a channel, by name or by motion, of "
            f"{names}{unread(longest)}; "
            "name the columns of speed, yaw rate and lateral acceleration accordingly, with units"
            + "".join(_way_to_join(longest, log) for log in others[:1])
        )
    computed = [
        f"'{column}' is left out: it is the difference of '{of}' from row to row, not a measurement"
        for column, of in differences.items()
    ]
    by_column = {proposal.column: proposal for proposal in proposals.channels}
    foreign = [
        f"the unit '{column.unit}' of '{column.name}' is unknown; "
        + (
            "answer its question with CHANNEL UNIT SIGN FACTOR"
            if by_column[column.name].question
            else f"according to magnitude and motion it is {by_column[column.name].unit}"
        )
        for column in longest.columns
        if column.name in by_column
        and column.unit.strip("-[]() 1")
        and plain_unit(column.unit) is None
    ]
    shadowed = (
        [f"'{name}' is also a built-in data set; in this folder the name refers to yours"]
        if name in choices("dataset") and not existing
        else []
    )
    return Examined(
        name,
        tuple(files),
        (longest, *others),
        proposals.with_notes(*computed, *foreign, *_notes(longest, logs), *shadowed),
        _place(files, longest.source),
        proposals.rate_hz or (longest.rate_hz if longest.clock is None else None),
        dict.fromkeys((*VEHICLE, IMU_PLACE)) | dict(vehicle or {}),
    )


def _way_to_join(log: Log, other: Log) -> str:
    """How two tables of one drive become one, as the end of a sentence; empty without times."""
    if log.clock is None or other.clock is None:
        return ""
    first, second = log.file, other.file
    time, other_time = log.clock.column, other.clock.column
    renamed = "" if time == other_time else f".rename(columns={{'{other_time}': '{time}'}})"
    return (
        "; if the files are of one drive, by one clock, join them, for example by pandas: "
        f"merge(read_csv('{first.name}'), read_csv('{second.name}'){renamed}, on='{time}', "
        f"how='outer', suffixes=('_{first.stem}', '_{second.stem}'))"
        ".to_csv('joined.csv', index=False)"
    )


def _divided(files: Sequence[Path]) -> tuple[list[Path], Path | None]:
    """Separate the logs from the DBC among the files; its path is relative to the working folder if
    it lies in it, None without one.
    """
    logs = [file for file in files if file.suffix.lower() != DBC]
    dbcs = [file for file in files if file.suffix.lower() == DBC]
    if not dbcs:
        return logs, None
    if not logs:
        raise ConfigurationError(f"'{dbcs[0]}' describes a bus; name a log of it as well")
    if len(dbcs) > 1:
        raise ConfigurationError(
            f"'{dbcs[0]}' and '{dbcs[1]}': a data set has one DBC; join them, or create one for "
            "each, with a name of its own"
        )
    if foreign := [file for file in logs if file.suffix.lower() not in SUFFIXES]:
        raise ConfigurationError(
            f"'{foreign[0]}' is no log of a CAN bus ({', '.join(SUFFIXES)}), which '{dbcs[0]}' "
            "would describe; leave the DBC out"
        )
    dbc = dbcs[0].resolve()
    return logs, Path(os.path.relpath(dbc)) if dbc.is_relative_to(Path.cwd()) else dbc


def unread(log: Log) -> str:
    """Clause on the parts of a log that were not read, to end a sentence; empty if there are
    none.
    """
    return f"; not read: {'; '.join(log.skipped[:MAX_LISTED])}" if log.skipped else ""


def paths_of(name: str) -> tuple[Path, Path, Path]:
    """Paths of the files of data set, split and pipeline with that name, in ./conf and
    ./pipelines.
    """
    return (
        Path("conf") / "dataset" / f"{name}.yaml",
        Path("conf") / "split" / f"{name}.yaml",
        Path("pipelines") / f"{name}.yaml",
    )


def rate_of(stamps: FloatArray) -> float:
    """Sampling rate of time stamps [s], (N,), by their typical step [Hz]."""
    return 1.0 / max(typical_step(stamps), 1e-6)


def _at_stated_rate(log: Log) -> Log:
    """The log with the unit of time by which its rows have the rate that the file states; unchanged
    where the header has the unit, or no unit gives that rate.
    """
    if log.rate_hz is None or log.clock is None or log.seconds is None or log.clock.is_stated:
        return log
    ratio = log.rate_hz / rate_of(log.seconds)
    decades = round(math.log10(ratio))
    is_decade = decades and abs(math.log10(ratio) - decades) < MAX_DECADE_ERROR
    reason = f"{log.rate_source} states"
    return _with_corrected_clock(log, 10.0**decades, reason) if is_decade else log


def _with_signs(log: Log) -> Log:
    """The log with signed values in place of magnitudes whose sign is in another column of 0 and 1,
    without these columns.
    """
    columns = log.by_name
    rows = [(column.name, column.unit, column.values, column.device) for column in log.columns]
    signed_columns = {}
    used = set()
    for name, sign_name in magnitudes_beside_signs(rows).items():
        magnitude, sign = columns[name], columns[sign_name]
        is_declarable = "column" in sign.place and (
            sign.place.get("group") == magnitude.place.get("group")
        )
        stamps = [np.empty(0) if each.stamps is None else each.stamps for each in (sign, magnitude)]
        if (
            is_declarable
            and np.array_equal(stamps[0], stamps[1])
            and np.isin(sign.values[np.isfinite(sign.values)], (0.0, 1.0)).all()
        ):
            used.add(sign_name)
            signed_columns[name] = replace(
                magnitude,
                values=signed(magnitude.values, sign.values),
                place={**magnitude.place, "sign_column": sign.place["column"]},
            )
    remaining = (column for column in log.columns if column.name not in used)
    return replace(
        log, columns=tuple(signed_columns.get(column.name, column) for column in remaining)
    )


def _with_corrected_clock(log: Log, ratio: float, reason: str) -> Log:
    """The log with another unit of time, by which the rate is ``ratio`` times that of the guessed
    unit, and with a question on it; unchanged where no unit is.
    """
    clock = log.clock
    if clock is None or log.seconds is None:
        return log
    size = STATED_UNITS[clock.unit] / ratio
    for unit, factor in STATED_UNITS.items():
        if math.isclose(size, factor, rel_tol=1e-6):
            rate_hz = ratio * rate_of(log.seconds)
            evidence = f"{reason} {rate_hz:.6g} Hz, in {unit}; {clock.evidence}"
            corrected = replace(clock, unit=unit, evidence=evidence, asked=True)
            return replace(log, clock=corrected, seconds=log.seconds / ratio)
    return log


def _longest(logs: Sequence[Log]) -> Log:
    """The longest log, with options that suit all of them; raises an error where formats or layouts
    differ.
    """
    formats = {"text" if log.source in TABLES and is_text(log.file) else log.source for log in logs}
    if len(formats) > 1:
        raise ConfigurationError(
            f"the files are of several formats ({', '.join(sorted(formats))}); create a data set "
            "for each"
        )
    longest = max(
        logs,
        key=lambda log: (
            log.runs[0].stop - log.runs[0].start
            if log.runs
            else max(len(column.values) for column in log.columns)
        ),
    )
    expected = _layout(longest)
    for log in logs:
        for key, value in _layout(log).items():
            if value != expected[key]:
                is_part = key == "times" and not {*log.by_name} & {*longest.by_name}
                raise DataError(
                    f"'{log.file}' has {key} {value!r}, '{longest.file}' {expected[key]!r}; "
                    "use the same layout in both, or create a data set for each"
                    + (_way_to_join(longest, log) if is_part else "")
                )
    options = dict(longest.options)
    marks = sorted({mark for log in logs for mark in log.options.get("missing", ())})
    options |= {"missing": marks} if marks else {}
    if "runs" not in options:
        options |= {
            key: log.options[key]
            for log in logs
            for key in ("time_restarts", "max_gap")
            if key in log.options
        }
    return replace(
        longest,
        options=options,
        source="text_log" if any(log.source == "text_log" for log in logs) else longest.source,
    )


def _layout(log: Log) -> dict[str, Any]:
    """Layout of a log, with its time column and unit, by which logs are compared."""
    times = None if log.clock is None else f"{log.clock.column} in {log.clock.unit}"
    return {key: log.options.get(key, default) for key, default in LAYOUT.items()} | {
        "times": times
    }


def _notes(longest: Log, logs: Sequence[Log]) -> Iterator[str]:
    """Sentences on parts of the files that were not read, and on gaps that are interpolated."""
    yield from (
        f"'{column.name}' is negative where '{column.place['sign_column']}' is 1"
        for column in longest.columns
        if "sign_column" in column.place
    )
    yield from (f"not read: {text}" for text in longest.skipped[:MAX_LISTED])
    if len(longest.skipped) > MAX_LISTED:
        yield f"not read: {len(longest.skipped) - MAX_LISTED} more"
    for log in logs:
        for run in log.runs:
            stamps = np.empty(0) if log.seconds is None else log.seconds[run]
            steps = np.diff(stamps)
            if steps.max(initial=0.0) > MAX_BRIDGED_SECONDS:
                start = stamps[np.argmax(steps)]
                yield (
                    f"'{log.file.name}' has a gap of {steps.max():.3g} s at {start:.4g} s after "
                    "its start, which is interpolated linearly; split the file there"
                )
                break


def _place(files: Sequence[Path], source: str) -> dict[str, Any]:
    """Options ``path``, ``files`` and ``exclude`` of a data set: folder of the files, pattern that
    they match, and stems of further files that match it.
    """
    folder, *other_folders = sorted({file.resolve().parent for file in files})
    if other_folders:
        listed = ", ".join(map(str, (folder, *other_folders)))
        raise ConfigurationError(
            f"the files are in several folders ({listed}); put them into one, or create a data set "
            "for each folder"
        )
    names = sorted({file.name for file in files})
    stems = [Path(name).stem for name in names]
    if doubled := [stem for stem in stems if stems.count(stem) > 1]:
        raise ConfigurationError(
            f"two files are called '{min(doubled)}'; a recording's name must be unique"
        )
    path = os.path.relpath(folder) if folder.is_relative_to(Path.cwd()) else str(folder)
    if source == "rosbag":
        return {"path": path, "files": [file.name for file in files]}
    both_ways = (names, [name[::-1] for name in names])
    prefixes = map(os.path.commonprefix, both_ways)
    start, end = (prefix.rstrip("0123456789") for prefix in prefixes)
    pattern = glob.escape(names[0])
    if len(names) > 1:
        pattern = f"{glob.escape(start)}*{glob.escape(end[::-1])}"
    unlisted = sorted(
        file.name for file in folder.iterdir() if file.is_file() and file.name not in names
    )
    unlisted_matches = [Path(name).stem for name in matching(unlisted, pattern)]
    if unlisted_matches and source not in TABLES:
        raise ConfigurationError(
            f"'{folder}' contains other files of that name ('{unlisted_matches[0]}'); use a folder "
            "with the files of the data set only"
        )
    return {"path": path, "files": pattern} | (
        {"exclude": unlisted_matches} if unlisted_matches else {}
    )


def _evidence(
    log: Log, differences: Collection[str]
) -> tuple[list[tuple[str, str, FloatArray, str]], float | None]:
    """Columns of a log's longest run on an even clock of at most `EVIDENCE_HZ`, for the proposals,
    and the rate [Hz]; without times the rows as they are.

    Of a long drive the minutes in which columns change most are taken.
    """
    samples, rate = _on_even_clock(log)
    if rate is not None:
        n_rows = samples.shape[1]
        cut = round(END_SECONDS * rate) if n_rows > 20.0 * END_SECONDS * rate else 0
        factor = max(math.floor(rate / EVIDENCE_HZ), 1)
        n_used = (n_rows - 2 * cut) // factor * factor
        samples = samples[:, cut : cut + n_used].reshape(len(samples), -1, factor).mean(axis=2)
        rate = rate / factor
        samples = busiest_rows(
            samples, round(MAX_EVIDENCE_SECONDS * rate), max(round(60.0 * rate), 1)
        )
    return [
        (column.name, plain_unit(column.unit) or "", values, column.device)
        for column, values in zip(log.columns, samples, strict=True)
        if column.name not in differences
    ], rate


def _differences(log: Log) -> dict[str, str]:
    """Column that is the difference of another one from row to row -> that other one, which is a
    velocity by its name; such a column is no measured acceleration.
    """
    signals = [column for column in log.columns if column.stamps is None]
    if not signals:
        return {}
    run = log.runs[0]
    middle = run.start + max((run.stop - run.start - MAX_COMPARED_ROWS) // 2, 0)
    compared = slice(middle, min(middle + MAX_COMPARED_ROWS, run.stop))
    rows = np.array([column.values[compared] for column in signals])
    velocities = [
        k
        for k, column in enumerate(signals)
        if {"vx", "vy_ref"} & set(hints(column.name)) and np.isfinite(rows[k]).all()
    ]
    differences: dict[str, str] = {}
    for k, (first, last) in product(velocities, ((0, -1), (1, None))):
        steps = np.diff(rows[k])
        usual = np.abs(steps) <= np.quantile(np.abs(steps), USUAL_STEP_QUANTILE)
        agreeing = [abs(correlation(row[first:last][usual], steps[usual])) for row in rows]
        differences |= {
            signals[j].name: signals[k].name
            for j, agreement in enumerate(agreeing)
            if agreement > MIN_DIFFERENCE_CORRELATION and j != k
        }
    return differences


def _on_even_clock(log: Log) -> tuple[FloatArray, float | None]:
    """Columns of a log on one even clock, and its rate [Hz], None where the log has no times.

    Columns with times of their own are restricted to the time that those which cover most of the
    log have in common.
    """
    timed = [(column.values, column.stamps) for column in log.columns if column.stamps is not None]
    if timed:
        sampled = np.unique(np.concatenate([stamps for _, stamps in timed]))
        highest_rate = max(rate_of(stamps) for _, stamps in timed)
        runs, _ = between_pauses(sampled, 1.0 / highest_rate)
        longest = sampled[max(runs, key=lambda run: sampled[run.stop - 1] - sampled[run.start])]
        edges = np.clip([stamps[[0, -1]] for _, stamps in timed], longest[0], longest[-1])
        begin, end = np.median(edges, axis=0).tolist()
        covered = np.minimum(edges[:, 1], end) - np.maximum(edges[:, 0], begin)
        covering = edges[covered >= MIN_COVERED * (end - begin)]
        begin = float(covering[:, 0].max(initial=begin))
        end = float(covering[:, 1].min(initial=end))
        rate = plain_rate(min(highest_rate, EVIDENCE_HZ), INTERPOLATED_TOLERANCE)
        check_limit(
            "samples",
            (end - begin) * rate,
            f"'{log.file}' lasts {(end - begin) * rate:.0f} samples at {rate:g} Hz",
        )
        grid = np.arange(begin, end, 1.0 / rate)
        return np.stack([np.interp(grid, stamps, values) for values, stamps in timed]), rate
    run = log.runs[0]
    if log.seconds is None:
        return np.stack([column.values[run] for column in log.columns]), log.rate_hz
    stamps = log.seconds[run]
    rows = [bridged(column.values[run], stamps, MAX_BRIDGED_SECONDS) for column in log.columns]
    rate = plain_rate(rate_of(stamps), INTERPOLATED_TOLERANCE)
    is_even = np.abs(stamps - stamps[0] - np.arange(len(stamps)) / rate).max() <= 1.0 / rate
    if is_even or (stamps[-1] - stamps[0]) * rate > 4 * len(stamps):
        return np.stack(rows), rate
    grid = np.arange(stamps[0], stamps[-1], 1.0 / rate)
    return np.stack([np.interp(grid, stamps, values) for values in rows]), rate


def busiest_rows(columns: FloatArray, max_rows: int, minute: int) -> FloatArray:
    """The contiguous rows in which the columns (C, N) change most, (C, at most ``max_rows``), by
    the minutes of ``minute`` rows in them; all rows where there are no more, or where ``max_rows``
    is below a minute, as with a misread clock.
    """
    if columns.shape[1] <= max_rows or max_rows < minute:
        return columns
    starts = np.arange(0, columns.shape[1] - minute, minute)
    with np.errstate(invalid="ignore", divide="ignore"):
        changes = [
            np.nanstd(values[: len(starts) * minute].reshape(-1, minute), axis=1)
            / np.nanstd(values)
            for values in columns
        ]
    activity = np.nan_to_num(changes, posinf=0.0).sum(axis=0)
    first = int(starts[np.argmax(np.convolve(activity, np.ones(max_rows // minute), mode="valid"))])
    return columns[:, first : first + max_rows]
