"""When samples were taken, told from time stamps that say when software got round to them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vehest.alignment.checks import checks_of_clock
from vehest.constants import FloatArray
from vehest.data.errors import DataError

FEWEST = 20
BLOCK_SECONDS = 1.0
REJECTED = 3.0  # standard deviations, taken from the median absolute residual
MOST_WANDERING = 0.4  # of an interval; a lost sample in the middle makes 0.5
RATE_TOLERANCE = 5e-3
OTHER_CLOCK = "cut the range out or set clock: stamps"


@dataclass(frozen=True)
class SampleTimes:
    """Times of samples and how their stamps scatter about them.

    Args:
        times: strictly increasing [s], shape (T,).
        rate_hz: the rate found [Hz]; None where the stamps themselves are the times.
        jitter: root mean square of stamp minus time [s]; of the intervals where the stamps themselves are the times.
    """

    times: FloatArray
    rate_hz: float | None
    jitter: float


def stamped_times(stamps: FloatArray, where: str) -> SampleTimes:
    """The stamps themselves as times.

    Args:
        stamps: time stamps [s], shape (T,).
        where: file and topic, for messages.

    Raises:
        DataError: stamps repeat, go backwards or are no numbers.
    """
    for finding in checks_of_clock(stamps):
        if finding.check == "clock":
            raise DataError(f"{where}: {finding.message}; repair or cut the range out, or take clock: uniform if samples come in batches")
    return SampleTimes(stamps, None, float(np.diff(stamps).std()))


def uniform_times(stamps: FloatArray, rate_hz: float, where: str, tolerated: float = 0.0, fix: str = OTHER_CLOCK) -> SampleTimes:
    """Times of a sensor that samples evenly while its samples are stamped when software got round to them.

    A straight line through stamps over their number, by least squares; stamps beyond three standard deviations, as a stalled
    computer makes them, do not count. What is left of a constant latency stays in.

    Args:
        stamps: time stamps [s], shape (T,); they may repeat.
        rate_hz: the sensor's nominal rate [Hz].
        where: file and topic, for messages.
        tolerated: wandering of the stamps about the line that does not matter [s].
        fix: what messages say to do where samples are missing.

    Raises:
        DataError: too few samples, stamps that go backwards or are no numbers, another rate, or samples that are missing.
    """
    if len(stamps) < FEWEST:
        raise DataError(f"{where}: {len(stamps)} samples are too few to find a uniform clock; {FEWEST} are needed")
    if not np.isfinite(stamps).all() or (np.diff(stamps) < 0).any():
        raise DataError(f"{where}: time stamps go backwards first at sample {_first_backwards(stamps)}; repair or cut the range out")
    number = np.arange(len(stamps), dtype=np.float64)
    interval, first = _robust_line(number, stamps)
    if not interval > 0 or abs(1.0 / (interval * rate_hz) - 1.0) > RATE_TOLERANCE:
        found = 1.0 / interval if interval > 0 else float("inf")
        raise DataError(
            f"{where}: samples come at {found:.6g} Hz, not at the declared {rate_hz:g} Hz; "
            f"correct rate_hz, or cut out where samples are missing"
            if fix == OTHER_CLOCK
            else f"{where}: {len(stamps)} rows of {rate_hz:g} Hz come at {found:.6g} Hz on average: samples are missing; {fix}"
        )
    times = first + interval * number
    _refuse_missing(stamps, stamps - times, interval, rate_hz, where, tolerated, fix)
    return SampleTimes(times, 1.0 / interval, float(np.sqrt(np.mean(np.square(stamps - times)))))


def _robust_line(number: FloatArray, stamps: FloatArray) -> tuple[float, float]:
    """Slope and intercept, points beyond three standard deviations left out."""
    middle, origin = number.mean(), stamps[0]
    kept = np.ones(len(stamps), dtype=bool)
    slope = offset = 0.0
    for _ in range(10):
        slope, offset = np.polyfit(number[kept] - middle, stamps[kept] - origin, 1).tolist()
        residual = np.abs(stamps - origin - offset - slope * (number - middle))
        fitting = residual <= REJECTED * 1.4826 * np.median(residual) + 1e-9
        if (fitting == kept).all():
            break
        kept = fitting
    return slope, offset - slope * middle + origin


def _refuse_missing(
    residual_stamps: FloatArray, residual: FloatArray, interval: float, rate_hz: float, where: str, tolerated: float, fix: str
) -> None:
    """A lost sample shifts all later stamps by an interval; so does a clock that drifts, little by little."""
    block = max(round(BLOCK_SECONDS * rate_hz), FEWEST // 2)
    edges = np.arange(0, len(residual), block)
    shifts = np.array([np.median(residual[edge : edge + block]) for edge in edges if not edge or len(residual) - edge >= block // 2])
    limit = max(MOST_WANDERING * interval, tolerated)
    worst = int(np.argmax(np.abs(shifts)))
    if abs(shifts[worst]) > limit:
        raise DataError(
            f"{where}: stamps are {1e3 * shifts[worst]:.3g} ms away from a uniform clock of {1.0 / interval:.6g} Hz about "
            f"{residual_stamps[edges[worst]]:.6g} s: samples are missing or the clock drifts; {fix}"
        )


def _first_backwards(stamps: FloatArray) -> int:
    return int(np.flatnonzero(~(np.diff(stamps) >= 0))[0]) + 1
