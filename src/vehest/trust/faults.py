"""Injects faults of sensors, wiring or decoding into a channel of a recording.

16 kinds at three severities.

    samples + Fault -> FaultedChannel -> samples with the fault

All random numbers come from the fault's seed. Sizes are round numbers of engineering judgement,
from faults that a driver would not notice to those of no car, and were set before the error of any
estimator under them was looked at; docs/faults.md, "Kinds and sizes", is the table of all of them.
"""

from __future__ import annotations

import difflib
import math
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from vehest.constants import GRAVITY, FloatArray
from vehest.data.channels import CHANNELS, Channel
from vehest.data.errors import ConfigurationError

Severity = Literal["mild", "medium", "severe"]  # severity of a fault, by which its size is chosen
SEVERITIES: tuple[Severity, ...] = get_args(Severity)  # severities in ascending order

Sizes = tuple[float, float, float]  # sizes of a mild, a medium and a severe fault

DEGREE = math.pi / 180.0  # rad
PIECE_SECONDS = 0.2  # s, length of the pieces in which samples are lost
LOSS_SECONDS = 0.2  # s until a wheel is locked or spins
SPIKE_SHARE = 0.02  # share of the samples that are spikes
HUGE_SHARE = 0.05  # share of the samples that are huge
STEERING_RATIO = 15.0  # handwheel per road wheel, of a usual passenger car

OFFSETS: dict[str, Sizes] = {
    "vx": (0.5, 2.0, 5.0),
    **dict.fromkeys(
        ("yaw_rate", "roll_rate", "pitch_rate"), (0.7 * DEGREE, 3.0 * DEGREE, 10.0 * DEGREE)
    ),
    "ax": (0.3, 1.0, 3.0),
    "ay": (0.3, 1.0, 3.0),
    **dict.fromkeys(("steer", "roll", "pitch"), (0.5 * DEGREE, 2.0 * DEGREE, 6.0 * DEGREE)),
    "handwheel": (
        0.5 * DEGREE * STEERING_RATIO,
        2.0 * DEGREE * STEERING_RATIO,
        6.0 * DEGREE * STEERING_RATIO,
    ),
}
"""Channel -> mild, medium and severe offset [unit of the channel]."""

OFFSETS_OF_SPEED: Sizes = (0.02, 0.08, 0.25)
"""Offsets of angular speeds of wheels and motor, as shares of the largest size in the samples.

Their radii differ by a factor of ten.
"""

# offsets of all other channels, as shares of the largest size that `CHANNELS` allows
OFFSETS_OF_RANGE: Sizes = (
    0.01,
    0.05,
    0.2,
)

UNIT_FACTORS: dict[str, Sizes] = {
    "m/s": (2.236936, 1.0 / 3.6, 3.6),
    "m/s²": (1.0 / 0.3048, 1.0 / GRAVITY, GRAVITY),
    "rad": (1.0 / math.tau, DEGREE, 1.0 / DEGREE),
    "rad/s": (1.0 / math.tau, DEGREE, 1.0 / DEGREE),
    "Pa": (1e-3, 1e-5, 1e5),
}
"""Unit of a channel -> factors by which its values are wrong in another unit.

In the order of the table: miles an hour, km/h converted once too often, km/h; ft/s², g for m/s² and
the inverse; turns, degrees converted once too often, degrees; kPa, bar, and bar converted once too
often.
"""

WHEEL_FACTORS: Sizes = (1.0 / math.tau, math.tau / 60.0, 60.0 / math.tau)
"""Factors of a wrong unit of the angular speeds of wheels and motor.

Turns a second, turns a minute converted once too often, turns a minute.
"""


@dataclass(frozen=True)
class Fault:
    """A fault of one channel: kind, size and time.

    Raises `ConfigurationError` for a combination that makes no sense.
    """

    kind: str  # one of `KINDS`
    channel: str  # never a reference
    severity: Severity = "medium"  # severity, by which one of the sizes in this module is chosen
    onset: float = 0.0  # time from the first sample to its start [s]
    duration: float = math.inf  # [s]; ``inf``: to the end
    seed: int = 0  # seed of all random draws of the fault
    # size that replaces the severity's, in the same unit; its sign is kept, that of a severity's
    # bias, drift or scale is drawn
    size: float | None = None

    def __post_init__(self) -> None:
        """Raise `ConfigurationError` for an unknown kind, channel or severity, or a size out of
        range.
        """
        for name, choices in (("kind", KINDS), ("channel", CHANNELS), ("severity", SEVERITIES)):
            value = getattr(self, name)
            if value not in choices:
                close = difflib.get_close_matches(value, choices, n=1)
                hint = f"did you mean {close[0]}? " if close else ""
                raise ConfigurationError(
                    f"fault.{name} '{value}' is not there; {hint}there are: {', '.join(choices)}"
                )
        if CHANNELS[self.channel].is_reference:
            raise ConfigurationError(
                f"fault.channel '{self.channel}' is a reference, which no estimator reads; name a "
                "measured channel"
            )
        if not applies(self.kind, self.channel):
            fitting = ", ".join(name for name in CHANNELS if applies(self.kind, name))
            raise ConfigurationError(
                f"a fault '{self.kind}' makes no sense for channel '{self.channel}'; it is for "
                f"{fitting}"
            )
        size_rule = KINDS[self.kind].size_rule
        for name, value, requirement, fits in (
            ("start", self.onset, "a time from 0 s on", 0 <= self.onset < math.inf),
            ("duration", self.duration, "positive", self.duration > 0),
            ("seed", self.seed, "a whole number from 0 to 2^63 - 1", 0 <= self.seed < 2**63),
            (
                f"size of a fault '{self.kind}'",
                self.size,
                size_rule,
                self.size is None or SIZE_RULES[size_rule](self.size),
            ),
        ):
            if not fits:
                raise ConfigurationError(f"fault.{name} must be {requirement}, not {value:g}")

    @property
    def condition(self) -> str:
        """Name of the fault as a condition of an evaluation, such as ``bias:ay:mild``.

        A size replaces the severity, and a seed other than 0 is appended: ``bias:ay:0.5:3``.
        """
        level = self.severity if self.size is None else f"{self.size:.12g}"
        return f"{self.kind}:{self.channel}:{level}" + (f":{self.seed}" if self.seed else "")


def is_fault(condition: str) -> bool:
    """Whether a condition of an evaluation is a fault, rather than ``nominal`` or the like."""
    return ":" in condition


def applies(kind: str, channel: str) -> bool:
    """Whether a kind of fault makes sense for a channel.

    A reference has no fault. A wrong sign is for channels whose sign is a convention, a wrong unit
    for units with `UNIT_FACTORS`, a lost wheel for wheel speeds and the forward velocity, which one
    wheel may measure.
    """
    channel_range = CHANNELS[channel]
    special = {
        "sign": channel_range.low == -channel_range.high,
        "unit": channel_range.unit in UNIT_FACTORS,
        "lost_wheel": channel == "vx" or channel.startswith("wheel_speed"),
    }
    return not channel_range.is_reference and special.get(kind, True)


def size_of(kind: str, channel: str, severity: Severity) -> float:
    """Size of a fault, as in the module's tables.

    Offsets of wheels and motor are shares of the largest speed.

    Returns
    -------
    float
        In the channel's unit (of wheels and motor: a share) for offsets, drifts a second, spikes
        and noise; a share, a factor or seconds for other kinds (`KINDS`). NaN: a lost wheel that
        drops out.
    """
    channel_range = CHANNELS[channel]
    at = SEVERITIES.index(severity)
    sizes = KINDS[kind].sizes
    is_speed = _is_angular_speed(channel)
    if sizes is None:
        return (WHEEL_FACTORS if is_speed else UNIT_FACTORS[channel_range.unit])[at]
    if isinstance(sizes, tuple):
        return sizes[at]
    if channel in OFFSETS:
        return sizes * OFFSETS[channel][at]
    if is_speed:
        return sizes * OFFSETS_OF_SPEED[at]
    return sizes * (OFFSETS_OF_RANGE[at] * _range(channel_range))


def inject(
    samples: Mapping[str, FloatArray], rate_hz: float, fault: Fault
) -> dict[str, FloatArray]:
    """Samples, channel -> (T,) [SI], with a fault in one channel, which may then have any value.

    Raises `ConfigurationError` where there is no such channel.

    Parameters
    ----------
    samples : mapping
        Channel -> (T,) [SI]; it is not changed.
    rate_hz : float
        Sampling rate [Hz].
    fault : Fault
        Kind, channel, size and time.
    """
    if fault.channel not in samples:
        raise ConfigurationError(
            f"fault '{fault.condition}': there is no channel '{fault.channel}'; there are: "
            f"{', '.join(samples)}"
        )
    values = np.array(samples[fault.channel], dtype=np.float64)
    first, end = window(fault, len(values), rate_hz)
    if first < end:
        values[first:end] = KINDS[fault.kind].effect(
            FaultedChannel(fault, values.copy(), first, end, rate_hz)
        )
    return {**samples, fault.channel: values}


def window(fault: Fault, n_samples: int, rate_hz: float) -> tuple[int, int]:
    """First index and end index of the samples while a fault lasts.

    Times are counted from the first sample; a sample at the onset is inside, one at the end is not.
    Both indices are at most the number of samples.
    """
    ends = (fault.onset * rate_hz, (fault.onset + fault.duration) * rate_hz)
    first, end = (
        min(math.ceil(at - 1e-6) if math.isfinite(at) else n_samples, n_samples) for at in ends
    )
    return first, end


class FaultedChannel:
    """A channel while its fault lasts, with the random draws of the fault.

    Parameters
    ----------
    fault : Fault
        Its seed, kind and channel determine all random draws.
    values : array
        The channel, (T,) [SI].
    first, end : int
        Samples while the fault lasts.
    rate_hz : float
        Sampling rate [Hz].

    Attributes
    ----------
    inside : array
        Values while the fault lasts, (end - first,).
    seconds : array
        Times since its onset, (end - first,) [s].
    size : float
        Size of the fault: with a drawn sign for bias, drift and scale unless the fault has a size
        of its own, and in rad/s for offsets of wheels and motor.
    """

    def __init__(
        self, fault: Fault, values: FloatArray, first: int, end: int, rate_hz: float
    ) -> None:
        self.values = values
        self.first = first
        self.end = end
        self.rate_hz = rate_hz
        self.inside = values[first:end]
        self.seconds = np.arange(end - first) / rate_hz
        self.range = _range(CHANNELS[fault.channel])
        self.random = np.random.default_rng(
            [fault.seed, zlib.crc32(f"{fault.kind}:{fault.channel}".encode())]
        )
        self.size = (
            size_of(fault.kind, fault.channel, fault.severity) if fault.size is None else fault.size
        )
        if fault.size is None and fault.kind in ("bias", "drift", "scale"):
            self.size *= float(self.random.choice([-1.0, 1.0]))
        if isinstance(KINDS[fault.kind].sizes, float) and _is_angular_speed(fault.channel):
            self.size *= _largest_size(values)

    def signs(self) -> FloatArray:
        """Random signs, -1 or 1, one for each sample inside, (end - first,)."""
        return self.random.choice([-1.0, 1.0], len(self.inside))

    def share(self) -> NDArray[np.bool_]:
        """Mask of the first samples inside, as many as the share ``size``, one at least."""
        return np.arange(len(self.inside)) < max(round(self.size * len(self.inside)), 1)

    def drawn(self, share: float, number: int | None = None) -> NDArray[np.bool_]:
        """Random mask that is true for a share of the samples inside, or of ``number`` pieces, one
        at least.
        """
        is_chosen = np.zeros(len(self.inside) if number is None else number, np.bool_)
        order = self.random.permutation(len(is_chosen))
        is_chosen[order[: max(round(share * len(is_chosen)), 1)]] = True
        return is_chosen

    def pieces(self) -> NDArray[np.bool_]:
        """Mask of the samples inside that lie in randomly chosen pieces of `PIECE_SECONDS`; the
        chosen share of the pieces is ``size``.
        """
        length = max(round(PIECE_SECONDS * self.rate_hz), 1)
        drawn = self.drawn(self.size, math.ceil(len(self.inside) / length))
        return np.repeat(drawn, length)[: len(self.inside)]

    def earlier(self, samples: int) -> FloatArray:
        """Values that the channel had ``samples`` samples earlier, (end - first,); its first value
        where the recording begins later.
        """
        return self.values[np.maximum(np.arange(self.first, self.end) - samples, 0)]


def _sample_and_hold(at: FaultedChannel) -> FloatArray:
    """Hold each value for ``size`` seconds, two samples at least."""
    samples = max(round(at.size * at.rate_hz), 2)
    return at.inside[np.arange(len(at.inside)) // samples * samples]


def _saturation(at: FaultedChannel) -> FloatArray:
    """Clip to a share of the largest size that the channel has while the fault lasts."""
    limit = at.size * _largest_size(at.inside)
    return np.clip(at.inside, -limit, limit)


def _lost_wheel(at: FaultedChannel) -> FloatArray:
    """Scale the speed to ``size`` times itself within `LOSS_SECONDS`; NaN: it drops out at once."""
    if math.isnan(at.size):
        return np.full_like(at.inside, np.nan)
    return at.inside * (1.0 + (at.size - 1.0) * np.minimum(at.seconds / LOSS_SECONDS, 1.0))


class Kind(NamedTuple):
    """A kind of fault: its sizes and its effect."""

    # mild, medium and severe size; or the factor that multiplies the channel's offsets; None: the
    # factors of a wrong unit
    sizes: Sizes | float | None
    size_rule: str  # requirement of a size of one's own, a key of `SIZE_RULES`
    effect: Callable[[FaultedChannel], FloatArray]  # returns the values that replace ``inside``


# requirements of a size of one's own, as messages state them
ANY = "a number other than 0"
SHARE = "a share above 0, up to 1"  # requirement of a size that is a share
POSITIVE = "a positive number"  # requirement of a size that is positive
FACTOR = "a factor from 0 on"  # requirement of a size that is a factor
SIZE_RULES: dict[str, Callable[[float], bool]] = {
    ANY: lambda size: math.isfinite(size) and size != 0,
    SHARE: lambda size: 0 < size <= 1,
    POSITIVE: lambda size: 0 < size < math.inf,
    FACTOR: lambda size: 0 <= size < math.inf,
}
"""Requirement of a size -> test of it."""

KINDS: dict[str, Kind] = {
    "bias": Kind(1.0, ANY, lambda at: at.inside + at.size),
    "drift": Kind(
        0.1, ANY, lambda at: at.inside + at.size * at.seconds
    ),  # reaches the offset in 10 s
    "scale": Kind((0.05, 0.2, 0.5), ANY, lambda at: at.inside * (1.0 + at.size)),  # factor less 1
    "frozen": Kind(
        (0.1, 0.5, 1.0),
        SHARE,
        lambda at: np.where(at.share(), at.values[max(at.first - 1, 0)], at.inside),
    ),  # of the duration
    "dropout": Kind(
        (0.1, 0.5, 1.0), SHARE, lambda at: np.where(at.pieces(), 0.0, at.inside)
    ),  # share of the samples
    "spikes": Kind(10.0, ANY, lambda at: at.inside + at.size * at.signs() * at.drawn(SPIKE_SHARE)),
    "noise": Kind(
        1.0, POSITIVE, lambda at: at.inside + at.size * at.random.standard_normal(len(at.inside))
    ),
    "delay": Kind(
        (0.05, 0.2, 0.5), POSITIVE, lambda at: at.earlier(max(round(at.size * at.rate_hz), 1))
    ),  # s, at least one sample
    "saturation": Kind((0.8, 0.5, 0.2), SHARE, _saturation),  # of the channel's largest size
    "sign": Kind(
        (0.1, 0.5, 1.0), SHARE, lambda at: np.where(at.share(), -at.inside, at.inside)
    ),  # of the duration
    "unit": Kind(None, ANY, lambda at: at.inside * at.size),
    "nan": Kind(
        (0.1, 0.5, 1.0), SHARE, lambda at: np.where(at.pieces(), np.nan, at.inside)
    ),  # share of the samples
    "inf": Kind(
        (0.01, 0.1, 1.0),
        SHARE,
        lambda at: np.where(at.drawn(at.size), at.signs() * np.inf, at.inside),
    ),  # at least one
    "huge": Kind(  # times the channel's physical range
        (10.0, 1e4, 1e200),
        POSITIVE,
        lambda at: np.where(at.drawn(HUGE_SHARE), at.signs() * at.size * at.range, at.inside),
    ),
    "held": Kind((0.1, 0.25, 0.5), POSITIVE, _sample_and_hold),  # s, at least two samples
    "lost_wheel": Kind(
        (math.nan, 1.5, 0.0), FACTOR, _lost_wheel
    ),  # factor of the speed; NaN: drops out
}
"""Name of a kind -> its sizes, its rule for a size of one's own, its effect on the channel."""


def _is_angular_speed(channel: str) -> bool:
    """Whether a channel is the angular speed of a wheel or of the motor."""
    return channel.startswith("wheel_speed") or channel == "motor_speed"


def _largest_size(values: FloatArray) -> float:
    """Largest absolute value among finite values; 0 where there is none."""
    return float(np.abs(values[np.isfinite(values)]).max(initial=0.0))


def _range(channel: Channel) -> float:
    """Largest absolute value in the physical range of a channel, in its unit."""
    return max(abs(channel.low), abs(channel.high))
