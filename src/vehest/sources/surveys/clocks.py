"""Finds the column of a table that is its clock, its unit, and where runs begin."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.recording import HIGHEST_RATE
from vehest.sources.clocks import (
    INTERPOLATED_TOLERANCE,
    RATE_TOLERANCE,
    plain_rate,
    span_fault,
)
from vehest.sources.surveys.log import Stamps
from vehest.sources.table_rows import stretches, timed_runs, unwrapped

# matches names of columns of time
NAMED = re.compile(
    r"^(t|ts|tm|time|zeit|timestamps?|stamp|sec|secs|seconds|sekunden|"
    r"epoch|utc|clock|unix|temps|tiempo|tempo|elapsed|uhrzeit)\b"
)
# matches names of columns that count runs
COUNTER = re.compile(
    r"^(run|session|stint|segment|drive|trial|fahrt|versuch|sequence|episode)( "
    r"?(id|nr|no|number|index))?$"
)
UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "d": 86_400.0}  # unit of time -> seconds
# unit of time -> seconds, also those that are used only where a header states them
STATED_UNITS = {**UNITS, "0.1*ms": 1e-4, "0.1*us": 1e-7, "cs": 0.01, "min": 60.0, "h": 3600.0}
# unit of time -> its spellings
SPELLINGS_OF = {
    "s": "s sec secs second seconds sekunden с сек 秒 초",
    "ms": "ms msec millis milliseconds ミリ秒",
    "us": "us µs μs usec micros microseconds",
    "ns": "ns nsec nanos nanoseconds",
    "d": "d day days",
    "0.1*ms": "100us 100µs 100μs 0.1ms",
    "0.1*us": "100ns 0.1us 0.1µs 0.1μs",
    "cs": "cs 1/100s 10ms 0.01s centiseconds hundredths",
    "min": "min mins minute minutes 分",
    "h": "h hr hrs hour hours stunden",
}
# spelling -> unit of time
SPELLINGS = {
    spelling: unit for unit, spellings in SPELLINGS_OF.items() for spelling in spellings.split()
}
# name of a column of parts of seconds, beside one of whole seconds -> their unit
PARTS_OF_SECONDS = {
    name: unit
    for unit, names in {
        "ms": "ms msec millis millisec millisecond milliseconds millisekunden",
        "us": "us usec micros microsec microsecond microseconds",
        "ns": "ns nsec nanos nanosec nanosecond nanoseconds",
    }.items()
    for name in names.split()
}
# Hz, lowest and highest rate that loggers write; the units' ranges do not meet
RATES = (4.0, 2500.0)
# lowest rate of a slow logger, in the header's unit or where another makes the log too short
MIN_RATE_HZ = 0.5
MIN_LOG_SECONDS = 5.0  # s; where a unit makes a log shorter, a larger one is taken and asked for
LONG_GAP = 20.0  # steps, gap after which a run ends where a column counts on, too
MAX_GAP = 1.0  # s, gap after which a run ends in any case, if it has `FEWEST_STEPS`
FEWEST_STEPS = 5.0  # smallest length of such a gap, in typical steps
FARTHEST_ROW = 100  # largest number of rows by which one may be out of order, to be sorted
TIME_FACTORS = (1, 1e3, 1e6, 1e9)  # units per second of times
# possible periods of times that begin anew: of a minute … a GPS week
PERIODS = {
    period * factor for period in (60.0, 3600.0, 86_400.0, 604_800.0) for factor in TIME_FACTORS
}
# counts at which counters may wrap, also as fractions of a second; of a second, a minute … a GPS
# week
MODULI = (
    *(2.0**bits * factor for bits in (*range(8, 17), 24, 31, 32) for factor in (1.0, 1e-3, 1e-6)),
    *TIME_FACTORS,
    *sorted(PERIODS),
)
MAX_WRAP_STEPS = 3.0  # largest step of a counter where it wraps, in steps
# smallest share of steps within half a typical step, for a column without a name of time
REGULAR = 0.8
# smallest share of steps that grow, for a column that is named as time; stamps of a coarser
# resolution are no clock
GROWING = 0.9
MOST_RESTARTS = 0.01  # largest share of the rows at which times may go back, pause or begin anew
# s, largest difference between two columns of times in one row; beyond, they are different clocks
MAX_APART = 1.0
MIN_TIMES = 10  # smallest number of times of a column that is compared, or has a rate
# smallest number of times that repeat in most rows, for a mean rate within a per cent
MIN_COARSE_TIMES = 100
MAX_END_SHARE = 0.05  # largest difference between times that end alike, over the longer span


def find_clock(
    columns: Mapping[str, FloatArray], units: Mapping[str, str]
) -> tuple[Stamps | None, FloatArray | None, tuple[slice, ...], dict[str, Any]]:
    """The column that is the clock of a table.

    It grows evenly, by name or unit before another, or is named so and grows, perhaps once rows of
    one device after those of another are sorted. One that counts rows, by 1 from 0 or 1 without a
    name or unit of time, is none.

    Parameters
    ----------
    columns : mapping
        Name -> numbers, shape (N,); one at least.
    units : mapping
        Name -> unit as the file writes it, of those that have one.

    Returns
    -------
    stamps : Stamps or None
        The column, its unit and what tells them; None where none is a clock.
    seconds : FloatArray or None
        Times of the rows from the first on, shape (N,) [s].
    runs : tuple of slice
        Rows of each run, the longest first; one of all without a clock.
    options : dict
        Options of the source by which runs begin.
    """
    candidates = []
    for name, raw in columns.items():
        unit = _unit_of_time(name, units.get(name, ""))
        named = bool(NAMED.match(plain_name(name)))
        may_be_time = named or unit or (np.diff(raw) < 0).mean() <= MOST_RESTARTS
        values, repair = in_order(raw) if may_be_time else (raw, {})
        if may_be_time and not repair and _is_of_several_devices(columns, name):
            values, repair = np.sort(raw), {"sort": True}
        step = _step(values, named=named)
        counts_rows = step == 1.0 and float(values[0]) in (0.0, 1.0) and not (unit or named)
        if step is None or counts_rows:
            continue
        stamps = _stamps(name, step, unit, named, float(np.ptp(values)))
        if stamps is not None:
            is_unknown = bool(units.get(name, "").strip("-#[]() ")) and not unit
            stamps = replace(stamps, repair=repair, asked=stamps.asked or is_unknown)
            candidates.append((2 * bool(unit) + named, stamps, values, step))
    n_rows = len(next(iter(columns.values())))
    if not candidates:
        return None, None, (slice(0, n_rows),), {}
    _, best, values, step = max(candidates, key=lambda candidate: candidate[0])
    columns = {**columns, best.column: values}
    steps = np.diff(values)
    seconds = (values - values[0]) * STATED_UNITS[best.unit]
    starts, counted_by = _run_starts(columns, best.column, steps, step)
    options: dict[str, Any] = {"runs": counted_by}
    if counted_by:
        runs = stretches(starts, n_rows)
    else:
        runs, pause = between_pauses(seconds, step * STATED_UNITS[best.unit])
        options = pause | ({"time_restarts": True} if starts.any() else {})
    return best, seconds, tuple(sorted(runs, key=lambda rows: rows.start - rows.stop)), options


def times_apart(columns: Mapping[str, FloatArray], units: Mapping[str, str]) -> list[str]:
    """Columns of times that contradict one another: each channel has a clock of its own.

    They grow from the first row on, perhaps to fewer rows, start and end alike, and are more than
    `MAX_APART` from one another in a row.

    Parameters
    ----------
    columns : mapping
        Name -> numbers, shape (N,), NaN where a cell is empty.
    units : mapping
        Name -> unit as the file writes it, of those that have one.

    Returns
    -------
    list of str
        Their names in the order of the file; empty where all times agree.
    """
    times: dict[str, FloatArray] = {}
    for name, values in columns.items():
        written = units.get(name, "").replace(" ", "").strip("#[]()").lower()
        unit = SPELLINGS.get(written, "")
        n_times = int(np.isfinite(values).sum())
        leading = values[:n_times]
        is_named = bool(unit) or (not written and NAMED.match(plain_name(name)))
        if is_named and n_times >= MIN_TIMES and (np.diff(leading) > 0.0).all():
            times[name] = leading * STATED_UNITS[unit or "s"]
    apart: set[str] = set()
    for first, second in combinations(times, 2):
        n_both = min(len(times[first]), len(times[second]))
        longest_step = max(np.median(np.diff(times[name])) for name in (first, second))
        longest_span = max(np.ptp(times[name]) for name in (first, second))
        start_error = abs(times[first][0] - times[second][0])
        end_error = abs(times[first][-1] - times[second][-1])
        in_a_row = np.abs(times[first][:n_both] - times[second][:n_both]).max()
        is_same_drive = start_error <= longest_step and end_error <= MAX_END_SHARE * longest_span
        if is_same_drive and in_a_row > MAX_APART:
            apart |= {first, second}
    return [name for name in times if name in apart]


def may_be_times(values: FloatArray) -> bool:
    """Whether a column without a name grows evenly, and not as the numbers of rows do."""
    return _step(values, named=False) is not None and bool((np.diff(values) != 1.0).any())


def mean_rate(name: str, times: FloatArray, written: str) -> float | None:
    """Mean rate of the rows between pauses, by times that are no clock: they repeat too often, or
    have no name.

    Parameters
    ----------
    name : str
        The column.
    times : FloatArray
        Its numbers, shape (N,).
    written : str
        Its unit as the file writes it; empty where it has none.

    Returns
    -------
    float or None
        In Hz; None where it goes backwards, hardly grows, or pauses often.
    """
    steps = np.diff(times)
    pauses = pauses_of(times)
    n_times = np.count_nonzero(steps > 0.0)
    min_times = MIN_TIMES if n_times > 0.5 * len(steps) else MIN_COARSE_TIMES
    if n_times < min_times or not (steps >= 0.0).all():
        return None
    step = float((steps.sum() - pauses.sum()) / (len(steps) - len(pauses)))
    unit = _unit_of_time(name, written)
    stamps = _stamps(name, step, unit, named=True, length=float(np.ptp(times)))
    if stamps is None or stamps.asked or len(pauses) > MOST_RESTARTS * len(steps):
        return None
    return plain_rate(1.0 / (step * STATED_UNITS[stamps.unit]), INTERPOLATED_TOLERANCE)


def pauses_of(times: FloatArray) -> FloatArray:
    """Steps of times that repeat, (N,), beside which the usual ones are short, in their unit."""
    steps = np.diff(times)
    return steps[steps > FEWEST_STEPS * np.median(steps[steps > 0.0])] if steps.any() else steps[:0]


def _unit_of_time(name: str, written: str) -> str:
    """The unit of time that a header states, in `STATED_UNITS`, or that ends a name; else empty."""
    spelling = written.replace(" ", "").strip("#[]()").lower()
    return SPELLINGS.get(spelling, "") or PARTS_OF_SECONDS.get(plain_name(name).split(" ")[-1], "")


def in_order(times: FloatArray) -> tuple[FloatArray, dict[str, Any]]:
    """Times that go on where a counter wrapped or rows stood out of order.

    A counter wraps if each of its steps back is that of one modulus. Rows are out of order if
    sorting makes the times even, and either puts none of them beside another of nearly the same
    time, as two drives would, or moves none far; others that go back begin a run.

    Parameters
    ----------
    times : FloatArray
        Numbers of a column in its unit, shape (N,).

    Returns
    -------
    times : FloatArray
        Shape (N,); as they were where nothing is to be put in order.
    options : dict
        ``wraps_at`` or ``sort`` of the column of times; empty where nothing is.
    """
    steps = np.diff(times)
    if not (np.isfinite(times).all() and (steps < 0).any()):
        return times, {}
    step = float(np.median(steps))
    if step > 0.0:
        modulus = min(MODULI, key=lambda modulus: abs(steps.min() + modulus - step))
        ahead = steps[steps < 0] + modulus
        # recordings of a full minute begin at nil, the first one too
        may_restart = modulus in PERIODS and times[0] < step
        is_wrap = np.ptp(times) < modulus and not may_restart
        if is_wrap and 0.0 < ahead.min() <= ahead.max() < MAX_WRAP_STEPS * step:
            return unwrapped(times, modulus), {"wraps_at": modulus}
    rows = np.argsort(times, kind="stable")
    ordered = times[rows]
    sorted_steps = np.diff(ordered)
    relative_steps = sorted_steps / max(float(np.median(sorted_steps)), 1e-300)
    is_even = np.mean(np.abs(relative_steps - 1.0) < 0.5) >= GROWING
    is_apart = relative_steps.min() > 0.5 and not span_fault(ordered)  # no stray stamp
    is_near = np.abs(rows - np.arange(len(rows))).max() <= FARTHEST_ROW
    repeats_no_more = (sorted_steps == 0).sum() <= (steps == 0).sum()
    is_out_of_order = is_even and (is_apart or (is_near and repeats_no_more))
    return (ordered, {"sort": True}) if is_out_of_order else (times, {})


def _is_of_several_devices(columns: Mapping[str, FloatArray], clock: str) -> bool:
    """Whether the rows of each device follow those of another: where times go back, other columns
    have samples.
    """
    goes_back = np.diff(columns[clock]) < 0
    if not 0 < goes_back.sum() < len(columns):
        return False
    measured = [
        {name for name in columns if name != clock and np.isfinite(columns[name][rows]).any()}
        for rows in stretches(goes_back, len(columns[clock]))
    ]
    return all(a and b and a.isdisjoint(b) for a, b in combinations(measured, 2))


def between_pauses(seconds: FloatArray, step: float) -> tuple[list[slice], dict[str, Any]]:
    """Rows of each run of times, which ends where they restart or pause.

    Parameters
    ----------
    seconds : FloatArray
        Times, shape (N,) [s].
    step : float
        Their typical step [s]; a pause is a step above `FEWEST_STEPS` of it, and above `MAX_GAP`.

    Returns
    -------
    runs : list of slice
        Rows of each run, in their order; where pauses end them, none that last less than
        ``max_gap``.
    options : dict
        The option ``max_gap``, if times pause and seldom; else empty.
    """
    steps = np.diff(seconds)
    longest = float(f"{max(MAX_GAP, FEWEST_STEPS * step):.3g}")
    runs = stretches(steps < 0, len(seconds))
    pauses = steps > longest
    stray = any(span_fault(seconds[run]) for run in runs if run.stop - run.start > 1)
    if pauses.any() and pauses.mean() <= MOST_RESTARTS and not stray:
        cut = timed_runs(seconds, longest, restarts=True)
        if cut:
            return [*cut.values()], {"max_gap": longest}
    return runs, {}


def plain_name(name: str) -> str:
    """A column's name in lower case, without marks, words apart: ``wheelSpeed_FL`` is ``wheel speed
    fl``.
    """
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)
    return re.sub(r"[\W_]+", " ", words).strip().lower()


def _step(values: FloatArray, *, named: bool) -> float | None:
    """Median step of a column that grows evenly, or that is named as time and repeats seldom,
    except for restarts; None for any other column.
    """
    if len(values) < 10 or not np.isfinite(values).all():
        return None
    steps = np.diff(values)
    grown = steps[steps > 0]
    # stamps of too coarse a resolution repeat
    if (steps < 0).mean() > MOST_RESTARTS or len(grown) < 0.3 * len(steps):
        return None
    step = float(np.median(steps)) or float(grown.sum() / len(steps))
    grows = (
        np.mean(steps > 0) >= GROWING
        if named
        else np.mean(np.abs(steps - step) <= 0.5 * step) >= REGULAR
    )
    return step if step > 0 and grows else None


def _stamps(name: str, step: float, unit: str, named: bool, length: float) -> Stamps | None:
    """A column of time, of a step and a length, in the unit that makes a rate that loggers have.

    Parameters
    ----------
    name : str
        The column.
    step : float
        Its typical step, in the column's unit.
    unit : str
        Unit that the header states, as `STATED_UNITS` has it; empty where it states none.
    named : bool
        Whether the column is named as time.
    length : float
        Its largest value less its smallest, in the column's unit.

    Returns
    -------
    Stamps or None
        None where no unit is stated or fits and the column is not named as time, or where its rate
        would be too high. ``asked`` where the unit that is taken does not fit, or is not the stated
        one.
    """
    offered = UNITS | ({unit: STATED_UNITS[unit]} if unit else {})
    rates = {name: 1.0 / (step * factor) for name, factor in offered.items()}
    fitting = [name for name, rate in rates.items() if RATES[0] <= rate <= RATES[1]]
    slow = [name for name, rate in rates.items() if MIN_RATE_HZ <= rate < RATES[0]]
    is_short = bool(fitting) and length * STATED_UNITS[fitting[0]] < MIN_LOG_SECONDS
    if unit in slow:
        fitting = slow
    chosen = unit if unit in fitting or not fitting else fitting[0]
    if not unit and is_short and slow:
        chosen, fitting = slow[0], []
    chosen = chosen or ((slow or ["s"])[0] if named else "")
    if not chosen or step * STATED_UNITS[chosen] * HIGHEST_RATE < 1.0 - RATE_TOLERANCE:
        return None
    evidence = f"grows evenly by {step:.6g}: {rates[chosen]:.6g} Hz if in {chosen}"
    if unit == chosen:
        evidence = f"unit in the header, {rates[chosen]:.6g} Hz"
    elif unit:
        evidence += f", {rates[unit]:.6g} Hz in {unit}, as the header says"
    is_asked = chosen not in fitting or unit not in ("", chosen)
    return Stamps(name, chosen, evidence, asked=is_asked, is_stated=bool(unit))


def _run_starts(
    columns: Mapping[str, FloatArray], clock: str, steps: FloatArray, step: float
) -> tuple[NDArray[np.bool_], str]:
    """Where runs begin with the next row, (N - 1,), and the column that counts them, if one
    does.
    """
    counters = [name for name in columns if name != clock and COUNTER.match(plain_name(name))]
    for name, starts in _counters(columns, counters):
        if 0 < starts.sum() <= MOST_RESTARTS * (len(steps) + 1):
            return starts, name
    breaks = (steps < 0) | (steps > LONG_GAP * step)
    for name, starts in _counters(columns, columns) if breaks.any() else ():
        if (starts == breaks).all():
            return breaks, name
    return steps < 0, ""


def _counters(
    columns: Mapping[str, FloatArray], names: Iterable[str]
) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Columns of whole numbers that never take a value again, each with where it changes, (N -
    1,).
    """
    for name in names:
        values = columns[name]
        if np.isfinite(values).all() and (values == np.rint(values)).all():
            changes = np.diff(values) != 0
            if len(np.unique(values)) == changes.sum() + 1:
                yield name, changes
