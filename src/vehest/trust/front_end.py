"""From the rate of a vehicle's bus to that of an estimator, causally and without aliasing.

    row (1, C) at the bus's rate --guard--> accepted values --filter_row--> low-passed values
    --every 1/ratio rows--> row (1, C) for the estimator

The filter's group delay is the price of running causally; `FrontEnd.delay` states it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from vehest.constants import FloatArray
from vehest.data.errors import ConfigurationError
from vehest.data.recording import HIGHEST_RATE
from vehest.data.runs import filled
from vehest.estimators.kernels.compiling import entry
from vehest.trust.guard import WAIT, Guard, GuardLimits, usual_limits

FILTER_ORDER = 4  # order of the Butterworth low-pass
CUTOFF = 0.4  # cut-off as a share of the estimator's rate, below its Nyquist frequency
# band in which the density of a channel's noise is taken, over the model's rate
NOISE_BAND = (0.3, 0.4)
TYPICAL_RATE_RATIO = 5  # rate of a bus over that of a model, as 100 to 20 Hz
SLACK = 1e-9  # relative; within it rates are equal, and a sample is due


def behind_front_end(samples: FloatArray, rate_hz: float) -> FloatArray:
    """Simulate how channels at the model's rate would arrive through `FrontEnd` from a bus that is
    `TYPICAL_RATE_RATIO` times as fast, so that limits of health can be learnt for that case.

    They are brought to that rate without phase, then filtered causally and thinned out again; the
    filter starts as in a steady signal. What lay above the model's Nyquist frequency is gone in
    them, and white noise of the density below it takes its place, since some of it comes through
    the filter.

    Parameters
    ----------
    samples : array
        (T, C) at the model's rate; NaN stays NaN in the result.
    rate_hz : float
        The model's rate [Hz].

    Returns
    -------
    array
        (T, C) at the model's rate. The noise is drawn from a fixed seed, so that limits that are
        learnt from it are reproducible.
    """
    together = np.stack([filled(column) for column in samples.T], axis=1)
    fast = scipy.signal.resample_poly(together, TYPICAL_RATE_RATIO, 1, axis=0, padtype="line")
    band = scipy.signal.butter(2, NOISE_BAND, btype="bandpass", fs=1.0, output="sos")
    density = scipy.signal.sosfilt(band, together - together.mean(axis=0), axis=0).var(axis=0) / (
        NOISE_BAND[1] - NOISE_BAND[0]
    )
    noise = np.sqrt(0.5 * TYPICAL_RATE_RATIO * density) * np.random.default_rng(0).standard_normal(
        fast.shape
    )
    fast += scipy.signal.sosfilt(
        scipy.signal.butter(8, 0.5, btype="highpass", fs=TYPICAL_RATE_RATIO, output="sos"),
        noise,
        axis=0,
    )
    sections = scipy.signal.butter(
        FILTER_ORDER, CUTOFF * rate_hz, fs=TYPICAL_RATE_RATIO * rate_hz, output="sos"
    )
    start = scipy.signal.sosfilt_zi(sections)[:, :, None] * fast[0]
    filtered = scipy.signal.sosfilt(sections, fast, axis=0, zi=start)[0][::TYPICAL_RATE_RATIO]
    return np.asarray(np.where(np.isnan(samples), np.nan, filtered), dtype=np.float64)


class FrontEnd:
    """Causal low-pass from a bus's rate to the estimator's, over accepted samples.

    A Butterworth filter of fourth order, cut off at 0.4 of the estimator's rate. A channel that is
    not measured holds its last value in the filter, and is passed on as not measured. After longer
    gaps the filter starts from the first sample that is back.

    ``limits`` of the guard are those calibrated at the estimator's rate; ``channels`` are in the
    order of the columns.

    Raises `ConfigurationError`: the bus is slower than the estimator, or faster than any.
    """

    def __init__(
        self,
        channels: Sequence[str],
        skippable: Sequence[str],
        limits: GuardLimits,
        bus_rate_hz: float,
        rate_hz: float,
    ) -> None:
        if not bus_rate_hz >= rate_hz * (1 - SLACK):
            raise ConfigurationError(
                f"samples at {bus_rate_hz:g} Hz are too slow for an estimator that works at "
                f"{rate_hz:g} Hz"
            )
        if not bus_rate_hz <= HIGHEST_RATE:
            raise ConfigurationError(
                f"samples at {bus_rate_hz:g} Hz are beyond any bus; rates go up to "
                f"{HIGHEST_RATE:g} Hz"
            )
        # jumps are those of another rate; ranges are the same
        usual = usual_limits(channels, bus_rate_hz).channels
        merged = {
            name: replace(limits_of_channel, jump=max(usual[name].jump, limits_of_channel.jump))
            for name, limits_of_channel in (limits.channels or usual).items()
        }
        self.guard = Guard(channels, skippable, replace(limits, channels=merged), bus_rate_hz)
        self.ratio = rate_hz / bus_rate_hz
        self._phase = 1.0 - self.ratio  # the first sample is passed on
        if bus_rate_hz > rate_hz * (1 + 1e-6):
            self.sections = scipy.signal.butter(
                FILTER_ORDER, CUTOFF * rate_hz, fs=bus_rate_hz, output="sos"
            )
        else:
            self.sections = np.zeros((0, 6))
        self._state = np.full((len(self.sections), len(channels), 2), math.nan)
        self._last_row = np.full(len(channels), math.nan)

    @property
    def delay(self) -> float:
        """Delay of slow signals through the filter [s]."""
        if not len(self.sections):
            return 0.0
        numerator, denominator = scipy.signal.sos2tf(self.sections)
        return (
            float(scipy.signal.group_delay((numerator, denominator), w=[1e-6])[1][0])
            / self.guard.rate_hz
        )

    def __call__(self, row: FloatArray) -> FloatArray | None:
        """Take one row at the bus's rate, (1, C).

        Returns a row (1, C) for the estimator, with NaN for what was not measured, or None where
        none is due.

        The first row is always due. While the guard waits, the filter forgets its state.
        """
        cleaned = self.guard(row)
        waits = bool(cleaned.flow[0] == WAIT)
        measured = cleaned.measured[0]
        if waits:
            self._state[:] = math.nan
        out = np.where(measured, cleaned.rows[0], self._last_row)
        self._last_row = out.copy()
        if len(self.sections) and not waits:
            filter_row(out, self.sections, self._state)
        self._phase += self.ratio
        if self._phase < 1.0 - SLACK:
            return None
        self._phase -= 1.0
        return np.where(measured & (not waits), out, math.nan)[None]


@entry(nogil=True)
def filter_row(row, sections, state):  # type: ignore[no-untyped-def]
    """Second-order sections, direct form II transposed, on one row, in place.

        y = b₀ x + s₀,   s₀ = b₁ x - a₁ y + s₁,   s₁ = b₂ x - a₂ y,   x of the next section = y

    Parameters
    ----------
    row : array
        Values, (C,); NaN stays, and leaves the state of its channel as it is.
    sections : array
        Coefficients b₀, b₁, b₂, 1, a₁, a₂ of each section, (S, 6).
    state : array
        (S, C, 2), changed in place. A channel whose state is NaN starts as if its value had always
        stood.
    """
    for c in range(row.shape[0]):
        x = row[c]
        if math.isnan(x):
            continue
        for s in range(sections.shape[0]):
            b0, b1, b2, _, a1, a2 = sections[s]
            if math.isnan(state[s, c, 0]):
                gain = (b0 + b1 + b2) / (1.0 + a1 + a2)
                steady = gain * x
                state[s, c, 1] = b2 * x - a2 * steady
                state[s, c, 0] = b1 * x - a1 * steady + state[s, c, 1]
            y = b0 * x + state[s, c, 0]
            state[s, c, 0] = b1 * x - a1 * y + state[s, c, 1]
            state[s, c, 1] = b2 * x - a2 * y
            x = y
        row[c] = x
