"""Rejects implausible samples before an estimator receives them.

    rows -> Guard -> rows, measured, flow (use, wait, restart)

A value that is not finite, that no car reaches, that jumps further than a car can, or that has
stood still for twice as long as it ever did in the estimator's training counts as not measured.
Channels
that a method can do without become NaN then; the others hold the last value that was accepted, for
half a second at most. After longer gaps the estimator starts anew when the channels
are back.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.derived import speed_of_reference
from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.data.runs import true_runs
from vehest.estimators.kernels.compiling import entry
from vehest.trust.checks import check_channels, check_number

BRIDGED_SECONDS = 0.5  # gaps up to here are bridged
PERSISTS_SECONDS = 0.1  # a jump is accepted once its new level has lasted this long
MAX_OVER_TRAINING = 3.0  # times the largest value in training that counts as plausible
MAX_RUN_SECONDS = 5.0  # s; a channel that stood still for longer in training has no limit
MIN_RUN_SECONDS = 0.3  # s, smallest limit of the time for which a channel may stand still
# largest change of a steering angle that stays where it is, over the largest angle
STOP_TOLERANCE = 2e-3
NEAR_STOP = 0.9  # smallest angle at which the steering may be at its stop, over the largest angle

CAR_LIMITS = {
    "m/s²": (25.0, 200.0, 6.0),
    "rad/s": (4.0, 15.0, 0.5),
    "rad": (1.0, 15.0, 0.1),
    "m/s": (100.0, 25.0, 2.0),
}
"""Unit -> largest absolute value and largest change a second that some road car reaches, and
largest change by sensor noise from one sample to the next.

They apply where no limits were calibrated.
"""

CAR_DEPENDENT_PREFIXES = ("wheel_", "motor_", "handwheel", "brake_", "fx_", "fy_", "fz_")
"""Prefixes of channels whose ranges and changes differ too much between cars for `CAR_LIMITS`.

Without calibration their limits are those of the channel's table.
"""

STEERING = ("steer", "handwheel")  # channels with stops: at its lock, a steering may stand still

ENDLESS = 1e300  # absolute value of the stops of channels that have none

MAX_TOP_SPEED = MAX_OVER_TRAINING * CHANNELS["vx"].high  # [m/s] that calibration allows
TAN_MARGIN = 1.2  # largest |v|/max(u, 1 m/s) over that in training
# largest limit of |v|/max(u, 1 m/s) that a calibration may have
MAX_TAN_SIDESLIP = TAN_MARGIN * CHANNELS["vy_ref"].high

STANDSTILL_SPEED = 0.5  # m/s
STANDSTILL_YAW_RATE = 0.05  # rad/s; below both, nothing is expected to move

# What an estimator does with a row (`Cleaned.flow`).
USE = 0  # flow of a row with which the estimator continues
WAIT = 1  # flow of a row that the estimator skips, since too much is missing
RESTART = 2  # flow of a row with which the estimator starts anew


@dataclass(frozen=True)
class ChannelLimits:
    """Limits of plausible values of one channel."""

    low: float  # smallest value [unit of the channel]
    high: float  # largest value [unit]
    jump: Annotated[float, "a positive number"]  # largest change from one sample to the next [unit]
    run: float = 0.0  # longest time that it may stand still while the car moves [s]; 0 if any
    # between which alone it is expected to move [unit]
    stops: tuple[float, float] = (-ENDLESS, ENDLESS)

    def __post_init__(self) -> None:
        """Raise `DataError` for limits in the wrong order or out of range."""
        if not self.low < self.high:
            raise DataError(f"low must be below high, not {self.low:.4g} and {self.high:.4g}")
        check_number("jump", self.jump, math.ulp(0.0))
        check_number("run", self.run, 0.0)
        if not self.stops[0] <= self.stops[1]:
            raise DataError(f"stops must rise, not {self.stops[0]:.4g} and {self.stops[1]:.4g}")


@dataclass(frozen=True)
class GuardLimits:
    """Limits of plausible values of each channel, for `Guard`, and of the estimate, for `Watch`."""

    channels: Mapping[str, ChannelLimits] = field(default_factory=dict)  # name -> limits
    top_speed: float = 140.0  # largest speed that the car reaches [m/s]
    # largest |v| over max(u, 1 m/s) of a plausible estimate; 1 is a sideslip of 45°
    largest_tan_sideslip: float = 1.0

    def __post_init__(self) -> None:
        """Raise `DataError` for limits that are wider than a channel's table or than any car
        allows.
        """
        check_channels("guard.channels", list(self.channels))
        for name, limits in self.channels.items():
            table = CHANNELS[name]
            if limits.low < table.low or limits.high > table.high:
                raise DataError(
                    f"guard.channels.{name}: {limits.low:.4g} to {limits.high:.4g} {table.unit} is "
                    f"wider than the channel's own range, {table.low:g} to {table.high:g}"
                )
        check_number("guard.top_speed", self.top_speed, math.ulp(0.0), MAX_TOP_SPEED)
        check_number("guard.largest_tan_sideslip", self.largest_tan_sideslip, 1.0, MAX_TAN_SIDESLIP)


def columns_of(names: Sequence[str], channels: Sequence[str]) -> list[int]:
    """Index of each name among the channels, -1 where it is not there."""
    return [channels.index(name) if name in channels else -1 for name in names]


def usual_limits(channels: Sequence[str], rate_hz: float) -> GuardLimits:
    """Limits of channels that hold for any car, at a sampling rate [Hz]; for `Guard` where none
    were calibrated.
    """
    return GuardLimits({name: _usual(name, rate_hz) for name in channels})


def learn_limits(
    recordings: Sequence[Recording], channels: Sequence[str], rate_hz: float
) -> GuardLimits:
    """Learn the limits of channels and of the estimate from training drives.

    A range is that of any car or, if larger, `MAX_OVER_TRAINING` times the largest value; a jump
    likewise. A channel may stand still for twice its longest run while the car moved
    (`_run_limit`). The largest tan β of the estimate is `TAN_MARGIN` times that of the references,
    and at least 1.

    Parameters
    ----------
    recordings : sequence of Recording
        Training drives.
    channels : sequence of str
        Channels that the estimator reads; one that no recording has gets the limits of any car.
    rate_hz : float
        Sampling rate of all recordings [Hz].
    """
    channel_limits = {}
    for name in channels:
        usual = _usual(name, rate_hz)
        table = CHANNELS[name]
        having = [recording for recording in recordings if name in recording]
        parts = [recording[name] for recording in having]
        stops = stops_of(parts, name)
        size = _largest(parts)
        jump = _largest([np.diff(part) for part in parts])
        channel_limits[name] = ChannelLimits(
            low=max(table.low, min(usual.low, -MAX_OVER_TRAINING * size)),
            high=min(table.high, max(usual.high, MAX_OVER_TRAINING * size)),
            jump=max(_fastest(name, rate_hz), MAX_OVER_TRAINING * jump),
            run=_run_limit(having, name, stops),
            stops=stops,
        )
    speeds = [
        recording.channels[name]
        for recording in recordings
        for name in recording.channels.keys() & {"vx", "vx_ref"}
    ]
    top = _largest(speeds)
    tangents = _largest([_tan_sideslip(recording) for recording in recordings])
    return GuardLimits(
        channel_limits,
        MAX_OVER_TRAINING * top if top > 0 else GuardLimits.top_speed,
        max(1.0, TAN_MARGIN * tangents),
    )


def _largest(parts: Sequence[FloatArray]) -> float:
    """Largest absolute value in all parts; 0 where there is none."""
    return max((float(np.nanmax(np.abs(part), initial=0.0)) for part in parts), default=0.0)


def _usual(name: str, rate_hz: float) -> ChannelLimits:
    """Limits of a channel that hold for any car, at a rate [Hz].

    Channels in `CAR_DEPENDENT_PREFIXES` have the range and the span of their table.
    """
    table = CHANNELS[name]
    size, _, noise = CAR_LIMITS.get(table.unit, (max(abs(table.low), abs(table.high)), 0.0, 0.0))
    if name.startswith(CAR_DEPENDENT_PREFIXES):
        size = math.inf
        noise = 0.0
    return ChannelLimits(
        max(table.low, -size), min(table.high, size), _fastest(name, rate_hz) + noise
    )


def _fastest(name: str, rate_hz: float) -> float:
    """Largest change of a channel from one sample to the next that a car reaches, in its unit."""
    table = CHANNELS[name]
    span = table.high - table.low
    if name.startswith(CAR_DEPENDENT_PREFIXES):
        return span
    return CAR_LIMITS.get(table.unit, (0.0, span, 0.0))[1] / rate_hz


def _tan_sideslip(recording: Recording) -> FloatArray:
    """|v|/max(|u|, 1 m/s) of a recording's references; empty where it has none."""
    name = speed_of_reference(recording)
    if not {"vy_ref", name} <= recording.channels.keys():
        return np.zeros(0)
    return np.abs(recording["vy_ref"]) / np.maximum(np.abs(recording[name]), 1.0)


def _run_limit(recordings: Sequence[Recording], name: str, stops: tuple[float, float]) -> float:
    """Limit of the time for which a channel may stand still while the car moves [s]; 0: no limit.

    It is twice the longest such time in the recordings, `MIN_RUN_SECONDS` at least. There is none
    for a channel that may rest, or that stood still for longer than `MAX_RUN_SECONDS`. Samples at
    its stops do not count.
    """
    if CHANNELS[name].rests or not recordings:
        return 0.0
    longest = 0.0
    for recording in recordings:
        samples = recording[name]
        is_frozen = (
            np.concatenate([[False], samples[1:] == samples[:-1]])
            & _moves(recording)
            & (samples > stops[0])
            & (samples < stops[1])
        )
        longest = max(longest, longest_run(is_frozen) / recording.rate_hz)
    return 0.0 if longest > MAX_RUN_SECONDS else max(2.0 * longest, MIN_RUN_SECONDS)


def longest_run(flags: NDArray[np.bool_]) -> int:
    """Number of samples in the longest run of true values; 0 where there is none."""
    return int(np.diff(true_runs(flags)).max(initial=0))


def stops_of(parts: Sequence[FloatArray], name: str) -> tuple[float, float]:
    """Lower and upper stop of a steering channel in its unit: the values near its locks at which
    it stayed for three samples in training, within a tenth of the extremes.

    Resampling rings at a stop, so that the extreme itself may lie beyond it. Channels other than
    `STEERING` have no stops.
    """
    stops = [-ENDLESS, ENDLESS]
    if name in STEERING and any(np.isfinite(part).any() for part in parts):
        for side, sign in enumerate((-1.0, 1.0)):
            farthest = max(float(np.nanmax(sign * part, initial=-ENDLESS)) for part in parts)
            reached: list[float] = []
            for part in parts:
                is_repeated = np.abs(np.diff(part)) <= STOP_TOLERANCE * farthest
                # samples that equal the two before them
                stayed = sign * part[2:][is_repeated[1:] & is_repeated[:-1]]
                reached += stayed[stayed >= NEAR_STOP * farthest].tolist()
            if farthest > 0 and reached:
                stops[side] = sign * (float(np.median(reached)) - STOP_TOLERANCE * farthest)
    return stops[0], stops[1]


def _moves(recording: Recording) -> NDArray[np.bool_]:
    """Mask (T,) of the samples at which the car moves by its speed or yaw rate; all true without a
    speed.
    """
    if "vx" not in recording:
        return np.ones(len(recording), np.bool_)
    is_standing = np.abs(recording["vx"]) < STANDSTILL_SPEED
    if "yaw_rate" in recording:
        is_standing &= np.abs(recording["yaw_rate"]) < STANDSTILL_YAW_RATE
    return ~is_standing


class Cleaned(NamedTuple):
    """Rows after the guard, as an estimator receives them."""

    # (T, C), finite, or NaN in channels that the method can skip; arbitrary where ``flow`` is
    # `WAIT`
    rows: FloatArray
    measured: NDArray[np.bool_]  # whether values were accepted, (T, C)
    flow: NDArray[np.int8]  # `USE`, `WAIT` or `RESTART` at each row, (T,)


class Guard:
    """Accepts or rejects samples, row after row; keeps the state between calls.

    Channels are in the order of the columns; those without ``limits`` get those of any car. An
    estimator that ``remembers`` more than a window starts anew at a jump that is accepted after
    all.

    Attributes
    ----------
    limits : ndarray of shape (C, 6)
        Low, high, largest jump, longest run [samples], lower and upper stop of each channel.
    bridged_samples, persistent_samples : int
        Missing samples that are bridged at most; samples after which a new level is accepted.
    """

    def __init__(
        self,
        channels: Sequence[str],
        skippable: Sequence[str],
        limits: GuardLimits,
        rate_hz: float,
        *,
        remembers: bool = False,
    ) -> None:
        self.rate_hz = rate_hz
        rows = [limits.channels.get(name) or _usual(name, rate_hz) for name in channels]
        runs = [row.run * rate_hz if row.run > 0 else math.inf for row in rows]
        self.limits = np.array(
            [
                (row.low, row.high, row.jump, run, *row.stops)
                for row, run in zip(rows, runs, strict=True)
            ]
        )
        self._skippable = np.array([name in skippable for name in channels])
        places = columns_of(("vx", "yaw_rate"), channels)
        self.bridged_samples = max(round(BRIDGED_SECONDS * rate_hz), 1)
        self.persistent_samples = max(round(PERSISTS_SECONDS * rate_hz), 2)
        self._settings = np.array(
            [*places, self.bridged_samples, self.persistent_samples, int(remembers)], np.int64
        )
        self.state = np.zeros((len(channels) + 1, 6))
        self.state[:-1, [0, 3, 4]] = np.nan  # nothing accepted, no last value, no candidate
        self.state[-1, 0] = WAIT

    def __call__(self, rows: FloatArray) -> Cleaned:
        """Go on with further rows, (T, C).

        Parameters
        ----------
        rows : array
            As received, in the order of the channels; any value, NaN and infinity included.

        Returns
        -------
        Cleaned
            Of these rows. Parts of a recording give the same as the whole.
        """
        clean = np.empty_like(rows)
        measured = np.empty(rows.shape, np.bool_)
        flow = np.empty(len(rows), np.int8)
        guard_rows(
            rows, self.state, self.limits, self._skippable, self._settings, clean, measured, flow
        )
        return Cleaned(clean, measured, flow)


@entry(nogil=True)
def guard_rows(  # type: ignore[no-untyped-def]
    rows, state, limits, skippable, settings, clean, measured, flow
):
    """Accept or reject values, row by row.

    A value within the range is accepted unless it has stood still for too long between its stops
    while the car moves, or jumps from a value that is at most ``bridged`` samples old. A jump is
    accepted once ``persists`` samples have confirmed its new level. The estimator waits where a
    channel that it needs, or every skippable one, has been missing for longer than ``bridged``.

    Parameters
    ----------
    rows
        (T, C), as received.
    state
        (C + 1, 6), of each channel: last accepted value, samples since, length of the present
        run, last value, candidate after a jump, how often it was confirmed; last row: whether
        the estimator waits.
    limits
        (C, 6): low, high, jump, longest run in samples, lower and upper stop.
    skippable
        Whether the estimator can do without each channel, bool (C,).
    settings
        Columns of vx and yaw rate (-1: none), samples that are bridged, samples that a new
        level has to stand, whether an accepted jump makes the estimator start anew.
    clean, measured, flow
        Output, as in `Cleaned`.
    """
    n_channels = rows.shape[1]
    vx_at, yaw_at, bridged, persists, remembers = settings
    for k in range(rows.shape[0]):
        is_standing = (
            vx_at >= 0
            and abs(state[vx_at, 0]) < STANDSTILL_SPEED
            and (yaw_at < 0 or abs(state[yaw_at, 0]) < STANDSTILL_YAW_RATE)
        )
        most_needed = 0.0
        least_skippable = math.inf
        any_skippable = False
        jumped = False
        for c in range(n_channels):
            x = rows[k, c]
            memory = state[c]
            accepted = limits[c, 0] <= x <= limits[c, 1]  # false for NaN
            if accepted:
                memory[2] = memory[2] + 1.0 if x == memory[3] else 0.0
                memory[3] = x
                if memory[2] > limits[c, 3] and limits[c, 4] < x < limits[c, 5] and not is_standing:
                    accepted = False
                elif memory[1] <= bridged and abs(x - memory[0]) > limits[c, 2]:
                    # a jump from what is not long gone
                    memory[5] = memory[5] + 1.0 if abs(x - memory[4]) <= limits[c, 2] else 1.0
                    memory[4] = x
                    accepted = memory[5] >= persists
                    jumped = jumped or accepted
            if accepted:
                memory[0] = x
                memory[1] = 0.0
                memory[4] = math.nan
                memory[5] = 0.0
            else:
                memory[1] += 1.0
            measured[k, c] = accepted
            clean[k, c] = x if accepted else (math.nan if skippable[c] else memory[0])
            missing = math.inf if math.isnan(memory[0]) else memory[1]
            if skippable[c]:
                any_skippable = True
                least_skippable = min(least_skippable, missing)
            else:
                most_needed = max(most_needed, missing)
        if most_needed > bridged or (any_skippable and least_skippable > bridged):
            flow[k] = WAIT
        else:
            flow[k] = RESTART if state[n_channels, 0] == WAIT or (jumped and remembers) else USE
        state[n_channels, 0] = flow[k]
