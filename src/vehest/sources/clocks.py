"""Checks time stamps, finds the even clock behind them, and brings samples onto it.

stamps -> `require_clock` -> `uniform_clock` or, with software delay, `uniform_times` -> samples on
the clock's ticks
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vehest.alignment.motion import rms
from vehest.constants import FloatArray
from vehest.data.errors import DataError, number_of
from vehest.data.limits import check_limit
from vehest.data.recording import HIGHEST_RATE

# treatment of uneven time stamps, see `uniform_clock`
ClockPolicy = Literal["strict", "interpolate", "uniform"]

LONGEST_STEP = 86_400.0  # s; a recording with a longer typical step is refused
MOST_STEPS = 1e8  # median steps from the first to the last stamp; a recording with more is refused
LATEST_TIME = 1e11  # s; a later stamp is refused: two samples at 1e5 Hz would be the same double
GAP = 1.5  # median steps; a longer step is a gap
MOST_JITTER = 0.01  # largest difference of an even interval from the median, over a step
# largest distance of an even clock from the line between first and last stamp, in steps
MOST_CLOCK_DRIFT = 0.5
# largest difference between a plain rate and the measured one over a whole recording, in steps
MOST_STRETCH = 0.1
# largest difference over a whole recording that may come from the resolution of the stamps, in
# steps
MOST_DRIFT = 0.01
# largest relative difference at which an interpolated clock, which may run at any rate, takes a
# plain one
INTERPOLATED_TOLERANCE = 5e-3
SLACK = 1e-6  # steps; times that are nearer are the same
SORT = "repair, remove or sort the rows"  # remedy for stamps in the wrong order, for messages
BRIDGE = "cut the range out or set dataset.clock=interpolate"  # remedy for gaps, for messages

MIN_SAMPLES_OF_CLOCK = 20  # samples behind which an even clock is looked for
# s, length of the blocks by whose median stamp missing samples and drift are found
BLOCK_SECONDS = 1.0
# number of standard deviations, by the median |residual|, beyond which a stamp is left out of the
# line
REJECTED = 3.0
# largest deviation of stamps from an even clock, in steps; a lost sample in the middle makes 0.5
MOST_WANDERING = 0.4
# largest relative difference between a measured rate and the stated one, or a limit
RATE_TOLERANCE = 5e-3


def require_clock(
    stamps: FloatArray, location: str, fix: str = SORT, *, may_repeat: bool = False
) -> None:
    """Refuse time stamps that have a `clock_fault`.

    Parameters
    ----------
    stamps : FloatArray
        Time stamps, shape (T,) [s].
    location : str
        File and signal, for messages.
    fix : str
        How to repair the order of the stamps, for messages.
    may_repeat : bool
        Whether stamps may repeat, as they do with software delay.

    Raises
    ------
    DataError
        They break the rule for every recording.
    """
    if fault := clock_fault(stamps, fix, may_repeat=may_repeat):
        raise DataError(f"{location}: {fault}")


def clock_fault(stamps: FloatArray, fix: str = SORT, *, may_repeat: bool = False) -> str:
    """Text on how time stamps break the rule for every recording, and on what to do about it.

    The rule is: increasing finite times, at most 1e5 Hz, at most 1e8 median steps in all.

    Parameters
    ----------
    stamps : FloatArray
        Time stamps, shape (T,) [s].
    fix : str
        How to repair their order, for the text.
    may_repeat : bool
        Whether they may repeat, as they do with software delay.

    Returns
    -------
    str
        The first fault that is found; empty where the rule holds.
    """
    if fault := _order_fault(stamps, fix, may_repeat):
        return fault
    step = typical_step(stamps)
    if not (1.0 - RATE_TOLERANCE) / HIGHEST_RATE <= step <= LONGEST_STEP:
        return (
            f"the time stamps lie {step:.6g} s apart (from {stamps[0]:.12g} s to "
            f"{stamps[-1]:.12g} s); correct the unit of time"
        )
    return span_fault(stamps)


def span_fault(stamps: FloatArray) -> str:
    """Text on a stray one among time stamps.

    Parameters
    ----------
    stamps : FloatArray
        Increasing time stamps, two at least, shape (T,) [s].

    Returns
    -------
    str
        The longest gap, where the stamps span more than 1e8 median steps; empty where they do not.
    """
    step = typical_step(stamps)
    if not stamps[-1] - stamps[0] > MOST_STEPS * step:
        return ""
    steps = np.diff(stamps)
    at = int(np.argmax(steps))
    return (
        f"time spans more than {MOST_STEPS:g} steps of {step:.6g} s, with a gap of {steps[at]:.6g} "
        f"s between sample {at} ({stamps[at]:.12g} s) and {at + 1} ({stamps[at + 1]:.12g} s); "
        "remove the stray stamp, or what lies on one side"
    )


def typical_step(stamps: FloatArray) -> float:
    """Median step of time stamps (T,) [s]; the mean where most of them repeat."""
    steps = np.diff(stamps)
    return float(np.median(steps)) or float(steps.mean())


def _order_fault(stamps: FloatArray, fix: str, may_repeat: bool) -> str:
    """Text on the first stamp that is no time of a drive, goes backwards or repeats; empty if there
    is none.
    """
    if len(stamps) < 2:
        return f"fewer than two time stamps; {fix}"
    odd = np.flatnonzero(~(np.abs(stamps) <= LATEST_TIME))
    if len(odd):
        return (
            f"time stamp of sample {odd[0]} is {stamps[odd[0]]:.6g} s, which is no time of a "
            f"drive; {fix}"
        )
    steps = np.diff(stamps)
    for fault, bad in (("goes backwards", steps < 0), ("repeats", (steps == 0) & (not may_repeat))):
        if bad.any():
            first = int(np.argmax(bad)) + 1
            return (
                f"time {fault} {number_of(bad.sum(), 'time')}, first at sample {first} "
                f"({stamps[first]:.12g} s); {fix}"
            )
    return ""


def unevenness(stamps: FloatArray) -> str:
    """Text on gaps, jitter or drift of increasing time stamps.

    Parameters
    ----------
    stamps : FloatArray
        Increasing time stamps, two at least, shape (T,) [s].

    Returns
    -------
    str
        The first that holds of: an interval above 1.5 medians, one that differs by more than 1 %
        from the median, a stamp more than half an interval from the straight line between first and
        last. Empty where the stamps are even.
    """
    steps = np.diff(stamps)
    step = float(np.median(steps))
    longest = int(np.argmax(steps))
    if steps[longest] > GAP * step:
        return (
            f"{number_of((steps > GAP * step).sum(), 'gap')}, the longest of "
            f"{steps[longest]:.6g} s after {stamps[longest]:.12g} s (interval {step:.6g} s)"
        )
    jitter = float(np.abs(steps - step).max() / step)
    if jitter > MOST_JITTER:
        return f"intervals deviate by up to {100 * jitter:.2g} % from the median of {step:.6g} s"
    away = np.abs(stamps - np.linspace(stamps[0], stamps[-1], len(stamps)))
    drift = float(away.max() / step)
    if drift > MOST_CLOCK_DRIFT:
        return (
            f"the clock drifts: at {stamps[np.argmax(away)]:.12g} s it is {drift:.2g} "
            "intervals away from a uniform one"
        )
    return ""


def require_samples(values: FloatArray, times: FloatArray, longest: float, location: str) -> None:
    """Refuse samples that are not finite, or that leave a gap.

    Parameters
    ----------
    values : FloatArray
        Samples in any unit, shape (T,).
    times : FloatArray
        Their increasing times, shape (T,) [s].
    longest : float
        Longest time between two samples [s].
    location : str
        File and signal, for messages.

    Raises
    ------
    DataError
        A sample is not finite, or two lie further apart than ``longest``.
    """
    bad = np.flatnonzero(~np.isfinite(values))
    steps = np.diff(times)
    if len(bad):
        raise DataError(
            f"{location} holds {number_of(len(bad), 'sample')} between {times[bad[0]]:.6g} s and "
            f"{times[bad[-1]]:.6g} s that are marked invalid or no finite numbers; cut the range "
            "out, or declare the channel gappy"
        )
    at = int(np.argmax(steps))
    if steps[at] > longest:
        raise DataError(
            f"{location} has a gap of {steps[at]:.6g} s after {times[at]:.6g} s, the longest of "
            f"{(steps > longest).sum()} above {longest:.6g} s; raise its max_gap where values may "
            "be interpolated over that time, or end the recording there: by the data set's "
            "max_gap, or by cutting the range out"
        )


def bridged(samples: FloatArray, times: FloatArray, longest: float) -> FloatArray:
    """Samples with straight lines across short gaps.

    Parameters
    ----------
    samples : FloatArray
        Samples in any unit, NaN where there is none, shape (T,).
    times : FloatArray
        Times of the rows, shape (T,) [s]. Where they go backwards or leave a gap above ``longest``,
        a run begins, which no line reaches across.
    longest : float
        Longest time between two samples that a line crosses [s].

    Returns
    -------
    FloatArray
        Shape (T,), still NaN in longer gaps. Lines are straight over the number of the row, not
        over its time. Beside the first and the last sample of a run that one stands, for at most
        ``longest``.
    """
    measured = np.flatnonzero(np.isfinite(samples))
    if not 0 < len(measured) < len(samples):
        return samples
    places = np.arange(len(samples))
    before = measured[np.maximum(np.searchsorted(measured, places, side="right") - 1, 0)]
    after = measured[np.minimum(np.searchsorted(measured, places, side="left"), len(measured) - 1)]
    longest *= 1.0 + 1e-9
    steps = np.diff(times, prepend=times[0])
    run = np.cumsum((steps < 0.0) | (steps > longest))
    before, after = (
        np.where(run[before] == run, before, after),
        np.where(run[after] == run, after, before),
    )
    near = (
        (run[before] == run)
        & (np.abs(times[after] - times[before]) <= longest)
        & (np.abs(times - times[before]) <= longest)
    )
    slope = (samples[after] - samples[before]) / np.maximum(after - before, 1)
    return np.where(
        np.isfinite(samples) | near, slope * (places - before) + samples[before], np.nan
    )


@dataclass(frozen=True)
class Clock:
    """A uniform clock, and how to bring samples onto it."""

    start_time: float  # time of the first tick [s]
    rate_hz: float  # rate of the ticks [Hz]
    n_samples: int  # number of ticks
    # the file's own time stamps, where samples must be interpolated [s]
    stamps: FloatArray | None = None

    def ticks(self) -> FloatArray:
        """Times of the uniform clock [s]."""
        return self.start_time + np.arange(self.n_samples) / self.rate_hz

    def part(self, rows: slice) -> Clock:
        """The clock of some of its ticks, evenly stamped: ``rows`` has a start and a stop."""
        start_time = self.start_time + rows.start / self.rate_hz
        return Clock(start_time, self.rate_hz, rows.stop - rows.start)

    def align(self, samples: FloatArray, gappy: bool = False) -> FloatArray:
        """Samples on the uniform clock, by linear interpolation where the file's own clock jitters.

        A gappy channel's samples go to the nearest tick instead: interpolation would lose those
        between two gaps.

        Parameters
        ----------
        samples : FloatArray
            Samples at the file's stamps, shape (T,).
        gappy : bool
            Whether NaN in them means "not measured".

        Returns
        -------
        FloatArray
            Shape (n_samples,); the samples themselves where the file's rows are the ticks.
        """
        if self.stamps is None:
            return samples
        elapsed = self.stamps - self.stamps[0]
        if gappy:
            ticks = np.minimum(np.rint(elapsed * self.rate_hz), self.n_samples - 1)
            return on_nearest(samples, ticks, self.n_samples)
        return at_ticks(samples, elapsed, np.arange(self.n_samples) / self.rate_hz)


def uniform_clock(
    stamps: FloatArray, location: str, policy: ClockPolicy = "strict", fix: str = BRIDGE
) -> Clock:
    """The uniform clock behind a file's time stamps.

    Parameters
    ----------
    stamps : FloatArray
        Time stamps of the rows, shape (T,) [s].
    location : str
        The file, for messages.
    policy : {'strict', 'interpolate', 'uniform'}
        ``strict`` refuses gaps, jitter above 1 % of an interval and drift, ``interpolate`` bridges
        them, ``uniform`` takes the rows as evenly sampled and their stamps as late, and refuses
        missing rows.
    fix : str
        What to do where ``strict`` finds no even clock, for messages.

    Returns
    -------
    Clock
        Its rate is the plain number that was meant, see `plain_rate`. Only with ``interpolate``
        does it keep the stamps and may have another number of samples than the file has rows.

    Raises
    ------
    DataError
        Stamps break the rule of `require_clock`, are not as even as ``policy`` wants them, or an
        even clock over them would hold more samples than the limits allow.
    """
    require_clock(stamps, location, may_repeat=policy == "uniform")
    start = float(stamps[0])
    elapsed = float(stamps[-1] - stamps[0])
    steps = np.diff(stamps)
    if policy == "interpolate":
        rate = plain_rate(1.0 / mean_step(steps), INTERPOLATED_TOLERANCE)
        n_samples = int(np.floor(elapsed * rate + 1e-3)) + 1
        check_limit(
            "samples",
            n_samples,
            f"{location}: an even clock of {rate:.6g} Hz over {len(stamps)} rows would hold "
            f"{n_samples} samples",
        )
        return Clock(start, rate, n_samples, stamps)
    rate = len(steps) / elapsed
    deviation = MOST_DRIFT
    if policy == "uniform":
        nominal = plain_rate(1.0 / float(np.median(steps)), INTERPOLATED_TOLERANCE)
        deviation = MOST_STRETCH
        remedy = "leave rows out by drop_rows or set dataset.clock=interpolate"
        times, rate, _ = uniform_times(stamps, nominal, location, fix=remedy)
        start = float(times[0])
    elif uneven := unevenness(stamps):
        raise DataError(f"{location}: {uneven}; {fix}")
    return Clock(start, plain_rate(rate, min(deviation / len(steps), 1e-4)), len(stamps))


def even_clock(blocks: Iterable[FloatArray]) -> Clock | None:
    """The `uniform_clock` of stamps that come in blocks, where these are surely strict and even.

    Only a line of each block is kept, so that the judgement is by an upper bound of the distance
    from an even clock.

    Parameters
    ----------
    blocks : iterable of FloatArray
        Time stamps in their order, shape (T,) each, none of them empty [s].

    Returns
    -------
    Clock or None
        None where the bound does not suffice, or the stamps are few: they may still be even.
    """
    lines: list[tuple[int, int, float, float, float]] = []
    intervals: list[float] = []
    count = 0
    before = np.empty(0)
    for block in blocks:
        if not (np.abs(block) <= LATEST_TIME).all():
            return None
        steps = np.diff(block, prepend=before)
        block_step = float(block[-1] - block[0]) / max(len(block) - 1, 1)
        intervals += [float(steps.min(initial=math.inf)), float(steps.max(initial=0.0))]
        # away from the block's own line
        deviation = float(np.abs(block - block[0] - block_step * np.arange(len(block))).max())
        lines.append((count, len(block) - 1, float(block[0]), block_step, deviation))
        count += len(block)
        before = block[-1:]
    if not MIN_SAMPLES_OF_CLOCK < count < MOST_STEPS:
        return None
    low = min(intervals)
    high = max(intervals)
    start = lines[0][2]
    elapsed = float(before[0]) - start
    n_steps = count - 1
    step = elapsed / n_steps
    away = max(
        abs(first - start - at * step) + abs(block_step - step) * reach + deviation
        for at, reach, first, block_step, deviation in lines
    )
    if (
        not (1.0 - RATE_TOLERANCE) / HIGHEST_RATE
        <= low
        <= high
        <= min(LONGEST_STEP, (1.0 + MOST_JITTER) * low)
        or away > MOST_CLOCK_DRIFT * low
    ):
        return None
    return Clock(start, plain_rate(n_steps / elapsed, min(MOST_DRIFT / n_steps, 1e-4)), count)


def uniform_times(
    stamps: FloatArray,
    rate_hz: float,
    location: str,
    tolerated: float = 0.0,
    fix: str = "cut the range out or set clock: stamps",
) -> tuple[FloatArray, float, float]:
    """Times of a sensor that samples evenly, from time stamps with software delay.

    A straight line through stamps over their number, by least squares; stamps beyond three standard
    deviations, as a stalled computer makes them, do not count. A constant latency stays in.

    Parameters
    ----------
    stamps : FloatArray
        Time stamps, which may repeat, shape (T,) [s].
    rate_hz : float
        The sensor's nominal rate [Hz].
    location : str
        File and topic, for messages.
    tolerated : float
        Wandering of the stamps about the line that does not matter [s].
    fix : str
        What to do where samples are missing, for messages.

    Returns
    -------
    times : FloatArray
        Evenly spaced times, shape (T,) [s].
    rate_hz : float
        The rate found [Hz].
    jitter : float
        Root mean square of stamps minus times [s].

    Raises
    ------
    DataError
        Too few samples, stamps that go backwards or are no numbers, another rate than the nominal
        one by more than 0.5 %, or samples that are missing.
    """
    if len(stamps) < MIN_SAMPLES_OF_CLOCK:
        raise DataError(
            f"{location}: {len(stamps)} samples are too few to find a uniform clock; "
            f"{MIN_SAMPLES_OF_CLOCK} are needed"
        )
    if fault := _order_fault(stamps, "repair or cut the range out", may_repeat=True):
        raise DataError(f"{location}: {fault}")
    number = np.arange(len(stamps), dtype=np.float64)
    step, first = _robust_line(number, stamps)
    measured_rate_hz = 1.0 / step if step > 0 else math.inf
    if not abs(measured_rate_hz / rate_hz - 1.0) <= RATE_TOLERANCE:
        raise DataError(
            f"{location}: samples come at {measured_rate_hz:.6g} Hz, not at {rate_hz:g} Hz: "
            f"samples are missing, or the rate is another one; {fix}"
        )
    times = first + step * number
    late = stamps - times
    # A lost sample shifts all later stamps by a step; so does a clock that drifts, little by
    # little.
    block = max(round(BLOCK_SECONDS * rate_hz), MIN_SAMPLES_OF_CLOCK // 2)
    edges = np.arange(0, len(late), block)
    shifts = np.array(
        [
            np.median(late[edge : edge + block])
            for edge in edges
            if not edge or len(late) - edge >= block // 2
        ]
    )
    worst = int(np.argmax(np.abs(shifts)))
    if abs(shifts[worst]) > max(MOST_WANDERING * step, tolerated):
        raise DataError(
            f"{location}: stamps are {1e3 * shifts[worst]:.3g} ms away from a uniform clock of "
            f"{measured_rate_hz:.6g} Hz about "
            f"{stamps[edges[worst]]:.6g} s: samples are missing or the clock drifts; {fix}"
        )
    return times, measured_rate_hz, rms(late)


def _robust_line(number: FloatArray, stamps: FloatArray) -> tuple[float, float]:
    """Slope [s] and intercept [s] of stamps over their number, points beyond three standard
    deviations left out.

    The standard deviation is taken from the median absolute residual; at most ten rounds.
    """
    middle = number.mean()
    origin = stamps[0]
    is_used = np.ones(len(stamps), dtype=bool)
    slope = offset = 0.0
    for _ in range(10):
        slope, offset = np.polyfit(number[is_used] - middle, stamps[is_used] - origin, 1).tolist()
        residual = np.abs(stamps - origin - offset - slope * (number - middle))
        fitting = residual <= REJECTED * 1.4826 * np.median(residual) + 1e-9
        if (fitting == is_used).all():
            break
        is_used = fitting
    return slope, offset - slope * middle + origin


def common_span(spans: Mapping[str, tuple[float, float]], location: str) -> tuple[float, float]:
    """Time that all spans have in common.

    Parameters
    ----------
    spans : mapping
        Name, for messages -> first and last time [s]; one at least.
    location : str
        The file, for messages.

    Returns
    -------
    begin, end : float
        The latest beginning and the earliest end [s].

    Raises
    ------
    DataError
        Nothing is common to all.
    """
    late = max(spans, key=lambda name: spans[name][0])
    early = min(spans, key=lambda name: spans[name][1])
    begin = spans[late][0]
    end = spans[early][1]
    if begin >= end:
        raise DataError(
            f"{location}: {late} begins at {begin:.6g} s, {early} ends at {end:.6g} s: nothing is "
            "common to all; leave one out, declare it gappy or take stamps of one clock"
        )
    return begin, end


def ticks_within(begin: float, end: float, rate_hz: float, location: str) -> FloatArray:
    """Whole multiples of a sampling interval from ``begin`` to ``end`` [s].

    Parameters
    ----------
    begin, end : float
        Both ends are included, with a slack of 1e-6 of an interval [s].
    rate_hz : float
        Rate of the ticks [Hz].
    location : str
        The file, for messages.

    Returns
    -------
    FloatArray
        Times, shape (T,) [s].

    Raises
    ------
    DataError
        They would be fewer than two, or more than the limits allow.
    """
    n_samples = (end - begin) * rate_hz
    span = f"from {begin:.6g} s to {end:.6g} s at {rate_hz:g} Hz"
    check_limit("samples", n_samples, f"{location} would become {n_samples:.0f} samples {span}")
    first = math.ceil(begin * rate_hz - SLACK)
    ticks = np.arange(first, math.floor(end * rate_hz + SLACK) + 1) / rate_hz
    if len(ticks) < 2:
        raise DataError(f"{location} would become fewer than two samples {span}")
    return ticks


def at_ticks(
    samples: FloatArray,
    stamps: FloatArray,
    ticks: FloatArray,
    *,
    hold: bool = False,
    slack: float = 0.0,
) -> FloatArray:
    """Samples at other times.

    Parameters
    ----------
    samples : FloatArray
        Samples in any unit, shape (T,).
    stamps : FloatArray
        Their increasing times, shape (T,) [s].
    ticks : FloatArray
        Times at which they are wanted, shape (N,) [s]; outside the stamps the first or last sample
        stands.
    hold : bool
        Whether a sample stands until the next one; else straight lines lead from one to the other.
    slack : float
        How much later than a tick the sample may be that is held there [s].

    Returns
    -------
    FloatArray
        Shape (N,).
    """
    if not hold:
        return np.interp(ticks, stamps, samples)
    return samples[np.maximum(np.searchsorted(stamps, ticks + slack, side="right") - 1, 0)]


def on_nearest(samples: FloatArray, ticks: FloatArray, n_samples: int) -> FloatArray:
    """Every sample that is measured on its tick, NaN on the others.

    Parameters
    ----------
    samples : FloatArray
        Samples, NaN where nothing was measured, shape (T,).
    ticks : FloatArray
        Number of the tick of each, a whole number, shape (T,); those outside are left out. Of
        several samples on one tick the last stays.
    n_samples : int
        Number of ticks.

    Returns
    -------
    FloatArray
        Shape (n_samples,).
    """
    placed = np.full(n_samples, np.nan)
    is_inside = (ticks >= 0) & (ticks < n_samples) & ~np.isnan(samples)
    placed[ticks[is_inside].astype(np.int64)] = samples[is_inside]
    return placed


def mean_step(steps: FloatArray) -> float:
    """The sampling interval behind jittering time stamps: the mean, a gap counting as the samples
    that it lacks.

    Parameters
    ----------
    steps : FloatArray
        Intervals between the stamps, shape (T - 1,) [s].

    Returns
    -------
    float
        The interval [s]; the median, 0, where most stamps repeat.
    """
    step = float(np.median(steps))
    for _ in range(3 if step > 0 else 0):
        step = float(steps.sum() / np.maximum(np.rint(steps / step), 1.0).sum())
    return step


def plain_rate(rate: float, tolerance: float) -> float:
    """The rate that was meant: the nearest whole number of Hz, ms, mHz or µs, the coarse ones
    first.

    A double holds unix time to 0.24 µs, so that the rate computed from time stamps would not be a
    rational multiple of any other.

    Parameters
    ----------
    rate : float
        The rate found [Hz].
    tolerance : float
        Share of it by which the plain one may differ.

    Returns
    -------
    float
        The plain rate [Hz], or ``rate`` where none is near enough.
    """
    for scale in (1.0, 1e3):
        hertz = round(rate * scale) / scale
        interval = round(1e3 * scale / rate) / (1e3 * scale)
        candidates = (hertz, 1.0 / interval if interval else 0.0)
        nearest = min(candidates, key=lambda candidate: abs(candidate - rate))
        if abs(nearest / rate - 1.0) <= tolerance:
            return nearest
    return rate
