"""Columns of a log on one even clock, with low-passed copies for comparisons."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from vehest.alignment.proposals.names import WEAK, bare, hints, is_of_bus, is_reference
from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.errors import DataError
from vehest.data.runs import true_runs
from vehest.data.units import factor_to_si

# Hz, cut-off of low-passed columns; below it, a delay of a tenth of a second and vibration matter
# little
SLOW_HZ = 1.0
SLOW_RATE_HZ = 5.0  # Hz, approximate rate of low-passed columns
# largest number of samples of a low-passed column; a longer one is thinned out further
MAX_SLOW_SAMPLES = 4000
MAX_MISSING_SHARE = 0.5  # largest share of missing samples of a column, which a line then bridges
STRAY_DISTANCE = 20.0  # smallest distance of a stray sample, over the spread of nearly all samples
# largest share of stray samples; where more lie far outside, none counts as stray
MAX_STRAY_SHARE = 0.002
# the same of stray samples that come and go, such as of frames that were decoded wrongly
BRIEF_DISTANCE = 3.0
MAX_BRIEF_SHARE = 0.01
MAX_BRIEF_SAMPLES = 5  # largest number of such samples after one another
# number of samples above which a column that never decreases is a clock, unless it is named as a
# position
MIN_CLOCK_SAMPLES = 1000
HINT_OF_LETTER = 3.0  # strength of hints by three names that differ in the letter of an axis alone
ROLES_OF_AXES = {"roll_rate", "pitch_rate"}  # roles that no relation to other channels reveals
MAX_LEVEL_SAMPLES = 200_000  # largest number of samples in which different values are counted
# matches names of columns that hold the sign of a magnitude
_SIGN = re.compile(r" (vz|vorzeichen|sign)$|\b(vz|vorzeichen|sign) ")
# matches the letter of an axis in a name, perhaps before a unit
_LETTER_OF_AXIS = re.compile(r"^[xyz] | ?[xyz](?= \w+$|$)")
MIN_LEVELS = 9  # smallest number of values that a motion takes; a gear or a flag takes fewer

# channel -> units that are tried where the header states none, the likeliest first
UNITS = {
    "vx": ("m/s", "km/h", "mph", "knots"),
    "yaw_rate": ("rad/s", "deg/s"),
    "ay": ("m/s²", "g"),
    "ax": ("m/s²", "g"),
    "handwheel": ("deg", "rad"),
    "steer": ("rad", "deg"),
    "vy_ref": ("m/s", "km/h"),
    "sideslip_ref": ("rad", "deg"),
}
# channel -> units of loggers that write whole numbers, tried where the others explain nothing
RARE_UNITS = {
    "vx": ("cm/s", "mm/s", "ft/s", "0.01*km/h"),
    "yaw_rate": ("mrad/s", "mdeg/s", "0.1*deg/s", "0.01*deg/s", "deg/min"),
    "ay": ("mg", "cm/s²", "mm/s²", "ft/s²", "0.01*g"),
    "ax": ("mg", "cm/s²", "mm/s²", "ft/s²", "0.01*g"),
}


@dataclass(frozen=True, eq=False)
class Candidate:
    """A column that may be a channel."""

    name: str  # name of the column in its log
    unit: str  # unit by the header, as vehest spells it; empty where unknown
    values: FloatArray  # samples in the file's unit, without gaps, (T,)
    slow: FloatArray  # low-passed samples, at `SLOW_RATE_HZ` or less, (S,)
    hints: Mapping[str, float]  # role -> strength with which the name suggests it
    is_wheel_mean: bool = False  # whether this is the mean of wheels, and no column of the log
    device: str = ""  # ``car`` or ``reference`` where the file says which of them measured it

    @cached_property
    def size(self) -> float:
        """99th percentile of the magnitude of the low-passed samples, in the file's unit; thousands
        of triples of columns ask for it.
        """
        return largest(self.slow)

    @cached_property
    def is_reference(self) -> bool:
        """Whether the reference measured it, by the file or else by its name."""
        return self.device == "reference" or (not self.device and is_reference(self.name))

    @cached_property
    def is_of_bus(self) -> bool:
        """Whether it comes from the car's own bus, by the file or else by its name."""
        return self.device == "car" or (
            not self.device and is_of_bus(self.name) and not is_reference(self.name)
        )

    @property
    def is_wheel(self) -> bool:
        """Whether its name suggests the speed of a wheel."""
        return any(role.startswith("wheel_speed") for role in self.hints)

    def hint(self, role: str) -> float:
        """Strength with which the name suggests a role; negative where it suggests others only."""
        return self.hints.get(role, -max(self.hints.values(), default=0.0))

    def units(self, channel: str) -> Sequence[str]:
        """The header's unit, or those to try for a channel where it states none."""
        return [self.unit] if self.unit else UNITS[channel]

    def measures(self, channel: str) -> bool:
        """Whether the header's unit, if there is one, is of a channel's quantity."""
        return not self.unit or is_unit_of(self.unit, channel)


def si_factor(unit: str, channel: str) -> float:
    """Factor from a unit to that of a channel.

    Parameters
    ----------
    unit : str
        As vehest spells it.
    channel : str
        A channel, whose SI unit is the target.

    Raises
    ------
    DataError
        The unit is unknown, or of another quantity.
    """
    return factor_to_si(unit, CHANNELS[channel].unit)


def unchanging(columns: Sequence[tuple[str, str, FloatArray, str]]) -> list[str]:
    """Columns that are named like a channel of the motion, in a unit of it, and take too few values
    to be one.

    Parameters
    ----------
    columns : sequence of tuple
        As `candidates` takes them.

    Returns
    -------
    list of str
        Name of each, with its value or the number of values.
    """
    texts = []
    for name, unit, values, _ in columns:
        is_motion = any(
            "wheel_speed" in role or (role in UNITS and (not unit or is_unit_of(unit, role)))
            for role in hints(name, unit)
        )
        levels = np.unique(values[np.isfinite(values)][:MAX_LEVEL_SAMPLES])
        if is_motion and 0 < len(levels) < MIN_LEVELS:
            seen = f"{levels[0]:.4g}" if len(levels) == 1 else f"{len(levels)} values"
            texts.append(f"'{name}' ({seen})")
    return texts


def magnitudes_beside_signs(
    columns: Sequence[tuple[str, str, FloatArray, str]],
) -> dict[str, str]:
    """Columns that are never negative because another one, named alike, holds their sign.

    Parameters
    ----------
    columns : sequence of tuple
        As `candidates` takes them.

    Returns
    -------
    dict
        Name of a magnitude -> name of the column of its sign, such as ``ESP_VZ_Gierrate``.
    """
    signs = {_SIGN.sub("", bare(name)): name for name, *_ in columns if _SIGN.search(bare(name))}
    return {
        name: signs[bare(name)]
        for name, _, values, _ in columns
        if bare(name) in signs and not np.any(values < 0.0)
    }


def is_unit_of(unit: str, channel: str) -> bool:
    """Whether a unit is of a channel's quantity."""
    try:
        return si_factor(unit, channel) > 0.0
    except DataError:
        return False


def candidates(
    columns: Sequence[tuple[str, str, FloatArray, str]], rate_hz: float
) -> list[Candidate]:
    """Columns that change, are mostly there, and are neither clocks nor distances; see
    `vehest.alignment.proposals.assign.propose`.

    Parameters
    ----------
    columns : sequence of tuple
        Name, unit (empty if unknown), samples (T,) with NaN for missing ones, and device (``car``,
        ``reference`` or empty).
    rate_hz : float
        Of the samples [Hz].

    Returns
    -------
    list of Candidate
        Missing and stray samples are bridged by lines.
    """
    usable = []
    for name, unit, values, device in columns:
        is_measured = np.isfinite(values) & (np.abs(values) < 1e15)
        if (
            1.0 - is_measured.mean() > MAX_MISSING_SHARE
            or not np.ptp(values[is_measured]) > 0.0
            or len(np.unique(values[is_measured][:MAX_LEVEL_SAMPLES])) < MIN_LEVELS
        ):
            continue
        roles = hints(name, unit)
        only_grows = len(values) > MIN_CLOCK_SAMPLES and np.min(np.diff(values[is_measured])) >= 0.0
        if "other" in roles or (
            only_grows and not {"latitude", "longitude", "position_x", "position_y"} & set(roles)
        ):
            continue
        is_measured[is_measured] = ~stray_samples(values[is_measured])
        if not is_measured.all():
            rows = np.flatnonzero(is_measured)
            values = np.interp(np.arange(len(values)), rows, values[rows])
        usable.append(Candidate(name, unit, values, slow_of(values, rate_hz), roles, device=device))
    return usable


def without_axes(columns: Sequence[Candidate]) -> list[Candidate]:
    """Columns whose names do not decide axes: all of a family x, y and z may be along any, and so
    may the two of an accelerometer without z.

    A log may count y up, or name the axes otherwise. The letters stay a weak hint.
    """
    families: dict[str, list[Candidate]] = {}
    for column in columns:
        words = bare(column.name)
        without_letter = _LETTER_OF_AXIS.sub("", words)
        if without_letter != words:
            families.setdefault(without_letter, []).append(column)
    changed = {}
    for family in families.values():
        roles = {role for column in family for role in column.hints}
        is_plane = len(family) == 2 and {"ax", "ay"} <= roles  # an accelerometer without z
        for column in family if len(family) == 3 or is_plane else ():
            named_roles = dict.fromkeys(set(column.hints) - ROLES_OF_AXES, HINT_OF_LETTER)
            roles_of_motion = {"yaw_rate", "ax", "ay", "vx", "vy_ref"} & roles
            changed[column.name] = replace(
                column, hints={**dict.fromkeys(roles_of_motion, WEAK), **named_roles}
            )
    return [changed.get(column.name, column) for column in columns]


def stray_samples(values: FloatArray) -> NDArray[np.bool_]:
    """Samples that lie far outside of nearly all others, (T,); none where they are not few.

    Those that come and go within `MAX_BRIEF_SAMPLES` may be nearer, and more.
    """
    brief = _outside(values, BRIEF_DISTANCE, MAX_BRIEF_SHARE)
    for begin, end in true_runs(brief):
        brief[begin:end] = end - begin <= MAX_BRIEF_SAMPLES
    return brief | _outside(values, STRAY_DISTANCE, MAX_STRAY_SHARE)


def _outside(values: FloatArray, distance: float, max_share: float) -> NDArray[np.bool_]:
    """Samples further from the median than ``distance`` times the spread of all but ``max_share``
    at either end, (T,); none where they are more than that share.
    """
    low, middle, high = np.quantile(values, [max_share, 0.5, 1.0 - max_share])
    outside = np.abs(values - middle) > distance * max(high - low, 1e-300)
    return outside if outside.mean() <= max_share else np.zeros(len(values), dtype=bool)


def slow_of(values: FloatArray, rate_hz: float) -> FloatArray:
    """Samples low-passed at `SLOW_HZ` and thinned out.

    Parameters
    ----------
    values : FloatArray
        (T,), without gaps.
    rate_hz : float
        Sampling rate [Hz]; a slow or short column is not filtered.

    Returns
    -------
    FloatArray
        (S,), at about SLOW_RATE_HZ and at most MAX_SLOW_SAMPLES long; the filter runs both ways and
        delays nothing.
    """
    if rate_hz > 4.0 * SLOW_HZ and len(values) > 30:
        sections = signal.butter(2, SLOW_HZ, fs=rate_hz, output="sos")
        values = np.asarray(signal.sosfiltfilt(sections, values), dtype=np.float64)
    step = max(round(rate_hz / SLOW_RATE_HZ), -(-len(values) // MAX_SLOW_SAMPLES), 1)
    return values[::step]


def correlation(left: FloatArray, right: FloatArray) -> float:
    """Correlation of two signals about their means; 0 where one does not change.

    Parameters
    ----------
    left, right : FloatArray
        Of one length.
    """
    a = left - left.mean()
    b = right - right.mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 0.0 else 0.0


def largest(samples: FloatArray) -> float:
    """99th percentile of the magnitude of samples."""
    return float(np.quantile(np.abs(samples), 0.99))
