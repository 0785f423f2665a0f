"""Recordings: uninterrupted drives, uniformly sampled, in SI units and ISO 8855 axes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from vehest.constants import FloatArray
from vehest.data.car import UNKNOWN_CAR, CarValues
from vehest.data.channels import CHANNELS, channel
from vehest.data.errors import DataError
from vehest.data.time_series import TimeSeries

Kind = Literal["real", "simulated"]  # whether a drive was real or simulated

MAX_PART_SECONDS = 900.0  # s; a longer drive is checked and, from a large table, read in parts
PART = "part"  # key in the provenance of a part of a drive: its number and the number of parts
# key in the provenance: the data set's transforms and the points of its sensors
DERIVED = "derived"
# key in the provenance: channel (empty: all of them) -> texts on missing samples
MISSING = "missing_samples"
UNNAMED_VEHICLE = "unknown"  # name of the vehicle where nobody named it
LOWEST_RATE = 1e-6  # Hz; a recording with a lower rate is refused
HIGHEST_RATE = 1e5  # Hz; a recording, clock or estimator with a higher rate is refused


@dataclass(frozen=True, eq=False, repr=False)
class Recording(TimeSeries):
    """One uninterrupted drive; immutable. Sample k was taken at ``start_time + k / rate_hz``.

    Raises
    ------
    DataError
        No samples, unknown channel, unequal lengths, values that are not finite, or a senseless
        rate, start or kind.
    """

    id: str  # name, unique within its data set
    vehicle: str  # name of the vehicle that was driven
    rate_hz: float  # sampling rate [Hz]
    start_time: float  # time of the first sample [s]
    channels: Mapping[str, FloatArray]  # canonical name -> samples, float64 of shape (T,), SI units
    kind: Kind = "real"  # ``real`` or ``simulated``
    # channels in which NaN means "not measured"; everywhere else NaN is an error
    gappy: frozenset[str] = frozenset()
    # origin of the samples (JSON values only); not part of the data
    provenance: Mapping[str, Any] = field(default_factory=dict)
    car: CarValues = UNKNOWN_CAR  # values of its data set; a stored recording has none

    def __post_init__(self) -> None:
        if not LOWEST_RATE <= self.rate_hz <= HIGHEST_RATE:
            bounds = f"between {LOWEST_RATE:g} and {HIGHEST_RATE:g} Hz"
            raise DataError(
                f"recording '{self.id}': the sampling rate must lie {bounds}, not at "
                f"{self.rate_hz:g} Hz"
            )
        if not math.isfinite(self.start_time):
            raise DataError(
                f"recording '{self.id}': the start time must be finite, not {self.start_time}"
            )
        if self.kind not in ("real", "simulated"):
            raise DataError(
                f"recording '{self.id}': kind must be real or simulated, not '{self.kind}'"
            )
        object.__setattr__(self, "rate_hz", float(self.rate_hz))
        object.__setattr__(self, "start_time", float(self.start_time))
        frozen = {
            channel(name).name: _immutable(samples) for name, samples in self.channels.items()
        }
        n_samples = max((samples.size for samples in frozen.values()), default=0)
        if not n_samples or any(samples.shape != (n_samples,) for samples in frozen.values()):
            shapes = {name: samples.shape for name, samples in frozen.items()}
            raise DataError(
                f"recording '{self.id}': channels must hold samples and have one common length, "
                f"not the shapes {shapes}"
            )
        object.__setattr__(self, "channels", frozen)
        object.__setattr__(self, "gappy", frozenset(self.gappy) & frozenset(frozen))
        for name, samples in frozen.items():
            samples.flags.writeable = False
            bad = np.flatnonzero(np.isinf(samples) if name in self.gappy else ~np.isfinite(samples))
            if len(bad):
                first, last = (self.start_time + bad[[0, -1]] / self.rate_hz).tolist()
                kind = "NaN" if np.isnan(samples[bad]).all() else "infinite values"
                raise DataError(
                    f"recording '{self.id}': channel '{name}' holds {len(bad)} {kind} between "
                    f"{first:.12g} s and {last:.12g} s; cut the range out (max_gap of the data set "
                    "ends a recording there), or declare the channel in 'gappy' if a gap means "
                    "'not measured'"
                )

    @property
    def label(self) -> str:
        """Text that identifies the recording in messages."""
        return f"'{self.id}'"

    @property
    def units(self) -> dict[str, str]:
        """Channel -> SI unit."""
        return {name: CHANNELS[name].unit for name in self.channels}

    def __getitem__(self, name: str) -> FloatArray:
        """Samples of one channel, shape (T,).

        Raises
        ------
        DataError
            The recording does not have it.
        """
        if name not in self.channels:
            raise DataError(
                f"recording '{self.id}' has no channel '{name}' (it has {', '.join(self.channels)})"
            )
        return self.channels[name]

    def __contains__(self, name: object) -> bool:
        return name in self.channels

    def stack(self, names: Iterable[str]) -> FloatArray:
        """Channels as columns, shape (T, C).

        Raises
        ------
        DataError
            One of them is missing.
        """
        return np.stack([self[name] for name in names], axis=1)

    def select(self, names: Iterable[str]) -> Recording:
        """The same drive with these channels only."""
        return replace(self, channels={name: self[name] for name in names})

    def with_channels(
        self, changed: Mapping[str, FloatArray], made_of: Iterable[str] | None = None
    ) -> Recording:
        """The same drive with channels replaced or added.

        Parameters
        ----------
        changed : mapping
            Channel -> samples in its SI unit, shape (T,).
        made_of : iterable of str or None
            Channels that they were made of: all of them are gappy if one of these is, and else
            none. None leaves them as they were.
        """
        gappy = self.gappy
        if made_of is not None:
            gappy = gappy | set(changed) if gappy & set(made_of) else gappy - set(changed)
        return replace(self, channels={**self.channels, **changed}, gappy=gappy)

    def without_references(self) -> Recording:
        """The same drive as an estimator may see it: no ``_ref`` channels."""
        measured = [name for name in self.channels if not CHANNELS[name].is_reference]
        if not measured:
            raise DataError(f"recording '{self.id}' has reference channels only")
        return self.select(measured)

    def cut(self, start: float, stop: float) -> Recording:
        """The samples taken in [start, stop) seconds.

        Raises
        ------
        DataError
            The range holds no samples.
        """
        first, last = self.index_range(start, stop)
        if first >= last:
            spans = f"spans {self.start_time:.12g} s to {self.end_time:.12g} s"
            raise DataError(
                f"recording '{self.id}' {spans}; it has no samples between {start:.12g} s and "
                f"{stop:.12g} s"
            )
        return self.part(slice(first, last))

    def part(self, samples: slice) -> Recording:
        """The samples of a range of indices; the same recording where that is all of them."""
        if samples == slice(0, len(self)):
            return self
        channels = {name: values[samples] for name, values in self.channels.items()}
        return replace(
            self, start_time=self.start_time + samples.start / self.rate_hz, channels=channels
        )

    def index_range(self, start: float, stop: float) -> tuple[int, int]:
        """First index and end index of the samples taken in [start, stop), clipped to the
        recording.

        Parameters
        ----------
        start, stop : float
            On the clock of the recording, infinite ones included [s].
        """
        tolerance = clock_tolerance(self.start_time, self.end_time, self.rate_hz)
        first, end = ((time - self.start_time) * self.rate_hz - tolerance for time in (start, stop))
        return math.ceil(min(max(first, 0.0), len(self))), math.ceil(min(max(end, 0.0), len(self)))


def joined(parts: Sequence[Recording]) -> Recording:
    """Concatenate parts that follow one another into one recording."""
    first = parts[0]
    channels = {name: np.concatenate([part[name] for part in parts]) for name in first.channels}
    return replace(
        first,
        channels=channels,
        provenance={key: value for key, value in first.provenance.items() if key != PART},
    )


def clock_tolerance(start_time: float, end_time: float, rate_hz: float) -> float:
    """Largest distance of a time from a sample at which it still counts as that sample's, in
    samples.

    A millionth of a sample, or the resolution of a double where the times are large: at 1.7e9 s
    (unix time) 0.24 µs.

    Parameters
    ----------
    start_time, end_time : float
        Ends of the recording, the larger of which counts [s].
    rate_hz : float
        Its rate [Hz].

    Returns
    -------
    float
        From 1e-6 to 0.25 of a sample.
    """
    resolution = math.ulp(max(abs(start_time), abs(end_time)))
    return min(max(1e-6, 2.0 * resolution * rate_hz), 0.25)


def _immutable(samples: FloatArray) -> FloatArray:
    """Samples that nobody else can change: a copy, unless they are those of a recording."""
    shared = (
        isinstance(samples, np.ndarray)
        and samples.base is None
        and not samples.flags.writeable
        and samples.dtype == np.float64
    )
    return samples if shared else np.array(samples, dtype=np.float64, copy=True)


def part_slices(n_samples: int, rate_hz: float) -> list[slice]:
    """Ranges of indices that divide so many samples into parts of about one length, none longer
    than `MAX_PART_SECONDS`.
    """
    edges = (
        np.linspace(0, n_samples, max(math.ceil(n_samples / (MAX_PART_SECONDS * rate_hz)), 1) + 1)
        .astype(int)
        .tolist()
    )
    return [slice(first, end) for first, end in pairwise(edges)]
