"""Judges the time stamps of samples online.

Which samples repeat, which are missing, whether the clock can be trusted.

While the clock stands still nothing measures time but the calls themselves, which come at the input
rate. "0.2 s" is therefore a number of calls here, and so is "1 s". `vehest_step_at` of an export
makes the same decisions.
"""

from __future__ import annotations

import math
import warnings

import numpy as np

from vehest.trust.guard import BRIDGED_SECONDS

# s of stamps that do not advance or are uneven, after which the clock is not trusted
FAULT_SECONDS = 0.2
RECOVERY_SECONDS = 1.0  # s of even stamps after which the clock is trusted again
RESET_SECONDS = 1.0  # s by which a stamp lies before the last one where the clock was set back
MIN_ADVANCE = 0.5  # sampling intervals; a stamp that is ahead by less repeats the last sample
EVEN_INTERVALS = (0.6, 1.6)  # sampling intervals from one stamp to the next that jitter explains
RATE_INTERVALS = 20  # first intervals, whose median is compared with the expected interval
RATE_TOLERANCE = 0.2  # relative deviation of that median beyond which another rate is warned of

CLOCK_STOPPED = 33  # reason of a health code: time stamps do not advance
CLOCK_JUMPED = 34  # time stamps jump
CLOCK_UNEVEN = 35  # time stamps are unevenly spaced
"""Kinds of reasons that follow from time stamps (`vehest.trust.health.REASONS`)."""

REPEATED = -1  # the time stamp is the last sample's again, and the sample is skipped
STOPPED = -2  # the clock has stopped, and the sample counts as missing
"""Results of `SampleClock.missing_before` for a sample that is not new."""


class SampleClock:
    """Judges the time stamps of the samples of one drive, in the order of the calls.

    Parameters
    ----------
    rate_hz : float
        Input rate at which samples are expected [Hz].

    Attributes
    ----------
    fault : int
        Why the clock is not trusted: `CLOCK_STOPPED`, `CLOCK_JUMPED`, `CLOCK_UNEVEN`; 0 while it is
        trusted.
    fault_calls, recovery_calls, max_missing : int
        `FAULT_SECONDS` and `RECOVERY_SECONDS` as calls; missing samples that a row of NaN replaces
        at most.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate = rate_hz
        self.fault_calls = max(round(FAULT_SECONDS * rate_hz), 2)
        self.recovery_calls = max(round(RECOVERY_SECONDS * rate_hz), 1)
        self.max_missing = math.ceil(BRIDGED_SECONDS * rate_hz) + 1
        self.fault = 0
        self._last = math.nan  # stamp of the last sample that was used
        self._previous = math.nan  # stamp of the last call
        self._stalled = 0  # calls since a stamp advanced
        self._uneven = 0  # uneven intervals less even ones, from 0 to fault_calls
        self._recovering = 0  # even samples until the clock is trusted again
        self._intervals: list[float] = []

    def unstamped(self) -> None:
        """Take a sample without a stamp: it counts as the next one at the input rate."""
        self._last += 1.0 / self._rate
        self._previous = self._last
        self._recover()

    def missing_before(self, time: float) -> int:
        """Take the stamp of a sample [s].

        A stamp that is not finite counts as the next one at the input rate, and as uneven. A stamp
        that lies `RESET_SECONDS` or more before the last one sets the clock back: it is new, and
        the clock is not trusted for `RECOVERY_SECONDS`.

        Parameters
        ----------
        time : float
            Stamp of the sample [s].

        Returns
        -------
        int
            Number of samples that are missing before this one, at most ``max_missing``; `REPEATED`
            or `STOPPED` where it is not new.
        """
        if math.isnan(self._last) and math.isfinite(time):
            self._last = self._previous = time
            return 0
        if not math.isfinite(time):
            self._last += 1.0 / self._rate
            self._previous = self._last
            self._count_uneven()
            return 0
        gap = time - self._last
        interval = (time - self._previous) * self._rate
        self._previous = time
        self._warn_of_rate(gap)
        is_reset = gap <= -RESET_SECONDS
        advances = gap > MIN_ADVANCE / self._rate
        missing = 0
        if advances:
            missing = int(min(max(np.rint(gap * self._rate) - 1.0, 0.0), self.max_missing))
        self._stalled = 0 if advances or is_reset else min(self._stalled + 1, self.fault_calls)
        is_even = advances and EVEN_INTERVALS[0] <= interval <= EVEN_INTERVALS[1]
        if is_even:
            self._recover()
        elif interval != 0.0:  # the same stamp again is a repeated sample
            self._count_uneven()
        if is_reset or missing == self.max_missing:
            self._suspect(CLOCK_JUMPED)
        if self._stalled == self.fault_calls:
            self._suspect(CLOCK_STOPPED)
            return STOPPED
        if not (advances or is_reset):
            return REPEATED
        self._last = time
        return missing

    def _count_uneven(self) -> None:
        """Count an uneven interval; after ``fault_calls`` more uneven than even ones the clock
        is suspect.
        """
        self._uneven = min(self._uneven + 1, self.fault_calls)
        if self._uneven == self.fault_calls:
            self._suspect(CLOCK_UNEVEN)

    def _suspect(self, fault: int) -> None:
        """Distrust the clock until ``recovery_calls`` even samples have come."""
        self.fault = fault
        self._recovering = self.recovery_calls

    def _recover(self) -> None:
        """Count an even interval; after ``recovery_calls`` of them the clock is trusted again."""
        self._uneven = max(self._uneven - 1, 0)
        self._recovering = max(self._recovering - 1, 0)
        if self._recovering == 0:
            self.fault = 0

    def _warn_of_rate(self, gap: float) -> None:
        """Warn once where the median of the first `RATE_INTERVALS` intervals, ``gap`` [s] being the
        latest, is that of another rate.
        """
        if len(self._intervals) == RATE_INTERVALS:
            return
        self._intervals.append(gap)
        middle = float(np.median(self._intervals))
        if (
            len(self._intervals) == RATE_INTERVALS
            and middle > 0
            and abs(middle * self._rate - 1.0) > RATE_TOLERANCE
        ):
            rate = f"{1.0 / middle:.3g}"
            warnings.warn(
                f"samples come at {rate} Hz instead of {self._rate:g} Hz; set bus_rate_hz={rate}",
                stacklevel=4,
            )
