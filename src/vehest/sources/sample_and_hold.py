"""Slow channels that a table repeats from row to row until their next sample: straight lines
between the samples.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data.channels import channel
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.schema import validated
from vehest.sources.clocks import Clock
from vehest.sources.columns import Column


@dataclass(frozen=True)
class SampleAndHold:
    """Channels whose values stand in every row, though they are new in few: where ``updated``
    changes, or else any of their columns.
    """

    channels: Annotated[tuple[str, ...], "a list of channels"]  # names of the channels
    # column that changes with every new sample, such as a time stamp of the sensors' own
    updated: str | int | None = None
    # time by which a sample first stands in a row later than it was taken [s], of all channels, or
    # by channel
    delay: float | dict[str, float] = 0.0

    @property
    def delays(self) -> dict[str, float]:
        """Channel -> its delay [s]."""
        if isinstance(self.delay, dict):
            return {name: float(self.delay.get(name, 0.0)) for name in self.channels}
        return dict.fromkeys(self.channels, float(self.delay))

    def description(self, rate_hz: float) -> dict[str, Any]:
        """Provenance of the channels."""
        return {"channels": list(self.channels), "rate_hz": round(rate_hz, 3), "delay": self.delays}

    def interpolated(
        self,
        columns: Mapping[str, Column],
        values: Mapping[str, FloatArray],
        clock: Clock,
        location: str,
    ) -> tuple[dict[str, FloatArray], slice, float]:
        """Held channels on every tick of a recording's clock, along straight lines, which look
        ahead by up to one interval.

        Parameters
        ----------
        columns : mapping
            Held channel -> its column.
        values : mapping
            Columns of the table in the file's unit, shape (T,) each.
        clock : Clock
            Clock of the recording.
        location : str
            The file, for messages.

        Returns
        -------
        channels : dict
            Channel -> samples in its SI unit, NaN outside of the first and last, one a tick.
        inside : slice
            Ticks between two samples of every channel.
        rate_hz : float
            Mean rate of the samples [Hz].

        Raises
        ------
        DataError
            The channels change in fewer than two rows, or no tick lies between samples of all.
        """
        markers = {str(self.updated)}
        if self.updated is None:
            markers = {column.column for column in columns.values()}
        is_new = np.any([np.diff(values[name]) != 0 for name in markers], axis=0)
        rows = np.flatnonzero(is_new) + 1  # the first row's sample may be older
        if len(rows) < 2:
            raise DataError(
                f"{location}: the held channels change in {len(rows)} rows; was their sensor "
                "connected? leave the file out"
            )
        ticks = clock.ticks()
        times = (ticks if clock.stamps is None else clock.stamps)[rows]
        interpolated = {}
        for name, column in columns.items():
            samples = column.to_si(values[column.column], channel(name).unit)[rows]
            sample_times = times
            if self.updated is None:
                samples, sample_times = _with_repeats(samples, times)
            interpolated[name] = np.interp(
                ticks, sample_times - self.delays[name], samples, left=np.nan, right=np.nan
            )
        delays = np.array([self.delays[name] for name in columns])
        inside = np.flatnonzero(
            (ticks >= (times[0] - delays).max()) & (ticks <= (times[-1] - delays).min())
        )
        if not len(inside):
            raise DataError(
                f"{location}: no row lies between two samples of every held channel; are their "
                "delays in seconds?"
            )
        rate_hz = (len(rows) - 1) / float(times[-1] - times[0])
        return interpolated, slice(int(inside[0]), int(inside[-1]) + 1), rate_hz


def sample_and_hold_from_config(
    entry: Any, channels: Sequence[str], location: str
) -> SampleAndHold:
    """A data set's declaration of held channels.

    Parameters
    ----------
    entry : mapping
        The option ``held``.
    channels : sequence of str
        Channels of the data set.
    location : str
        Data set and option, for messages.

    Raises
    ------
    ConfigurationError
        It names a channel that is not declared, gives a delay of one that is not held, or has
        another mistake.
    """
    declared = validated(SampleAndHold, entry, location, error=ConfigurationError)
    if unknown := [name for name in declared.channels if name not in channels]:
        raise ConfigurationError(
            f"{location} names '{unknown[0]}', which is not one of the data set's channels"
        )
    if unknown := sorted(
        set(declared.delay if isinstance(declared.delay, dict) else ()) - set(declared.channels)
    ):
        raise ConfigurationError(
            f"{location}: delay names '{unknown[0]}', which is not one of its channels"
        )
    return declared


def _with_repeats(samples: FloatArray, times: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Samples and times where no column marks updates: a value that stays was sampled again, up to
    an interval before the next change.

    The interval is the median one between changes. Without this a straight line would be drawn
    through all of a standstill.
    """
    intervals = np.diff(times)
    typical = float(np.median(intervals))
    late = np.flatnonzero(intervals > 1.5 * typical)
    return np.insert(samples, late + 1, samples[late]), np.insert(
        times, late + 1, times[late + 1] - typical
    )
