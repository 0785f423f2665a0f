"""Health of estimates, judged by the channels that they were computed from.

An estimate is valid, degraded or invalid.

    drives -> learn_health -> HealthModel (trust.yaml) -> packed -> health_rows -> status, reason

`learn_health` uses training drives without any reference:

1. relations between channels (`vehest.trust.relations`), such as ay = du/dt + u r;
2. an autoregression of their residuals (`vehest.trust.autoregression`);
3. the largest value of every statistic of `vehest.trust.health_kernel` on healthy training and
   validation drives. Multiplied by a margin it is the limit of the statistic.

`health_rows` flags an estimate as degraded or invalid, with a reason, as soon as a statistic
exceeds its limit. The flag is cleared after `HOLD_SECONDS` in which every statistic stayed below
`CLEAR` times its limit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.errors import DataError
from vehest.data.recording import HIGHEST_RATE, Recording
from vehest.trust import health_kernel as kernel
from vehest.trust.autoregression import Autoregression, fit_autoregression, learn_noise_levels
from vehest.trust.checks import check_channels, check_number, check_numbers, check_shape
from vehest.trust.clock import CLOCK_JUMPED, CLOCK_STOPPED, CLOCK_UNEVEN
from vehest.trust.front_end import behind_front_end
from vehest.trust.guard import ENDLESS, columns_of, longest_run, stops_of
from vehest.trust.health_kernel import N_LEVELS, Layout, Model, State, health_kernel
from vehest.trust.named_arrays import allocated, views
from vehest.trust.relations import (
    FEATURES,
    RATE,
    Relation,
    learn_relations,
    least_speed_of,
    relations_among,
    residuals_of,
    speed_channel,
    without_glitches,
)

# status of an estimate, as the channel ``health`` has it
VALID = 0
DEGRADED = 1  # code of health of a degraded sample
INVALID = 2  # code of health of an invalid sample

HOLD_SECONDS = 1.0  # s for which a flag is held after the last statistic fell below its limit
BRIDGED_SECONDS = 0.5  # s; a channel that is missing for longer makes the estimate invalid
SPIN_SECONDS = 0.3  # s beyond SPIN_MARGIN without a break, after which the car counts as spinning
SETTLE_SECONDS = 0.5  # s after a start, before predictions count

# Time constants of the statistics' means.
SHARE_SECONDS = 0.5  # share of equal samples
BRAKING_SECONDS = 0.2  # ax, by which a wheel that stands is locked or lost
ENERGY_SECONDS = 0.5  # energy of the innovations before a jump
OFFSET_SECONDS = 4.0  # evidence of an offset in a channel
RELATION_SECONDS = 1.0  # residual of a relation
# time constant of the means of both sides of a relation, before their signs and sizes are compared
SHORT_SECONDS = 0.25

# Limits from healthy drives.
BLOCK_SECONDS = 5.0  # limits are set by the largest value in each block of this length
HOURS_BETWEEN_FALSE_ALARMS = 100.0  # healthy driving in which a limit is exceeded about once
DAY_TO_DAY_FACTOR = 1.25  # tyres, track and wind of another day may raise a statistic by this
# smallest number of independent values of a statistic for which a drive counts
MIN_INDEPENDENT_VALUES = 10.0
MIN_RUN_SAMPLES = 4.0  # equal samples in a row: smallest limit
MIN_REPEATED_SHARE = 0.3  # share of equal samples: smallest limit
MIN_LIMITS = {"normal": 4.5, "slip": 0.3, "largest": 0.0}
"""`Statistic.rule` -> smallest limit; statistics of ``normal`` are N(0, 1) without a fault."""
OUTLIER_FACTOR = 2.0  # a block that exceeds the next largest by this is a fault of the recording
MAX_OUTLIER_SHARE = 0.01  # largest share of the blocks that are set aside as such faults
# yaw rate and vx·yaw_rate over their largest values in training, beyond which a car spins
SPIN_MARGIN = 1.3
# largest weight of one sample in a likelihood ratio, over the mean weight
MAX_RELATIVE_WEIGHT = 5.0
STANDSTILL_LIMITS = {"yaw_rate": 0.05, "ay": 0.5}
"""Channel -> value below which the car may be at standstill [rad/s, m/s²]."""

MAX_ORDER = 10  # samples that the autoregression looks back at most
# largest number of coefficients of the autoregression, which limits its order for the time of a
# step
MAX_COEFFICIENTS = 700

MODELLED = ("yaw_rate", "vx", "ay", "ax", "steer", "handwheel", "motor_speed", "motor_current")
"""Channels of the autoregression, besides wheel speeds.

Of other channels range, gaps and repeated samples are checked.
"""

NUMBERS = {name: number for number, name in enumerate(CHANNELS, start=1)}
"""Channel -> its number in the code of a reason."""
_NAMES = {number: name for name, number in NUMBERS.items()}  # number in a code -> channel

NO_ESTIMATE = 30  # there is no estimate
BEYOND_SPEED = 31  # it is beyond the bound by the car's speed
TOO_WIDE = 32  # its band of sideslip is wider than `vehest.trust.verdict.WIDEST`
"""Kinds of reasons that follow from an estimate, not from its channels (`vehest.trust.verdict`)."""

SLOW_KERNEL = "vehest.trust.health_kernel:health_kernel"  # compiles for tens of seconds

REASONS: dict[int, tuple[str, float]] = {
    kernel.FREE: ("", 0.0),
    kernel.MISSING: ("{channel} is not measured", 0.0),
    kernel.FROZEN: ("{channel} is frozen", 8.0),
    kernel.HELD: ("{channel} repeats its samples", 7.0),
    kernel.JUMP: ("{channel} jumps, or is noisier than in training", 2.0),
    kernel.NOISE: ("{channel} is noisier than in training", 2.5),
    kernel.SMOOTH: ("{channel} varies less than in training", 1.5),
    kernel.OFFSET: ("{channel} has an offset against the other channels", 4.0),
    kernel.SCALE: ("{channel} has another scale than the other channels", 4.0),
    kernel.SIGN: ("{channel} has the wrong sign", 0.0),
    kernel.UNIT: ("{channel} has the wrong unit", 0.0),
    kernel.CONTRADICTION: ("{channel} and {partner} contradict each other", 3.0),
    kernel.OUTSIDE: ("outside the range of the training: |{channel}|", 1.0),
    kernel.SPIN: ("spin", 0.0),
    kernel.LOCKED: ("locked wheel: {channel}", 9.0),
    kernel.DROPOUT: ("lost wheel: {channel}", 9.0),
    kernel.LATE: ("{channel} comes late", 4.0),
    NO_ESTIMATE: ("there is no estimate", 0.0),
    BEYOND_SPEED: ("the estimate exceeds what the speed allows", 0.0),
    TOO_WIDE: ("the band of sideslip exceeds 6 degrees", 0.0),
    CLOCK_STOPPED: ("the time stamps do not advance", 0.0),
    CLOCK_JUMPED: ("the time stamps jump, or all samples are missing", 0.0),
    CLOCK_UNEVEN: ("the time stamps are uneven, or come at another rate", 0.0),
}
"""Kind of a reason -> text and priority; of several reasons that with the highest is reported.

code = 10000 kind + 100 (number of the channel) + number of the partner
"""

RETIRED = (kernel.NOISE, kernel.SMOOTH, kernel.SCALE, kernel.LATE)  # kinds of earlier versions


def reason_in_words(code: float) -> str:
    """Text of a reason's code; empty for 0.

    The code is 10000 kind + 100 (number of the channel) + number of the partner, see `REASONS`.
    """
    kind, channels_code = divmod(round(code), 10_000)
    channel, partner = divmod(channels_code, 100)
    return REASONS[kind][0].format(
        channel=_NAMES.get(channel, "?"), partner=_NAMES.get(partner, "the other channels")
    )


class Health(NamedTuple):
    """Status of T rows and of the estimates from them, with the reason."""

    status: FloatArray  # 0 valid, 1 degraded, 2 invalid, (T,)
    reason: FloatArray  # code of the reason (`REASONS`), (T,); 0 where there is none
    ratio: FloatArray  # largest statistic over its limit, (T,)


class Statistic(NamedTuple):
    """Description of one statistic that the kernel compares with a limit at each row."""

    kind: int  # kind of the reason that it leads to
    channel: str  # channel that is accused
    partner: str  # other channel of a relation; empty for statistics of one channel
    seconds: float  # time constant of its mean [s]; 0 if it has none
    rule: str  # rule of its limit, see `limits_from`


@dataclass(frozen=True)
class HealthModel:
    """Normal behaviour of a car's C channels, with the limits of the K statistics by which
    `health_rows` judges rows.

    Numbers of channels are in the channels' units.
    """

    channels: tuple[str, ...]  # names of the channels, in the order of the rows' columns
    rate_hz: float  # sampling rate of the rows [Hz]
    relations: tuple[Relation, ...]  # relations between channels that were fitted
    constant: tuple[float, ...]  # constant c of the autoregression, (C,)
    # coefficients of the autoregression, [lag, predicted channel, former channel], (p, C, C)
    coefficients: tuple[tuple[tuple[float, ...], ...], ...]
    # inverse of the innovations' covariance, (C, C); zero for channels that are not modelled
    precision: tuple[tuple[float, ...], ...]
    deviation: tuple[float, ...]  # standard deviation of each channel's innovations
    usual: tuple[float, ...]  # median of each channel
    largest: tuple[float, ...]  # largest absolute value of each channel in training
    longest_gap: tuple[float, ...]  # longest time without a sample of each channel in training [s]
    # speed [unit of its channel], yaw rate [rad/s], ay [m/s²], below all of which the car stands
    standstill: tuple[float, float, float]
    # yaw rate, and its product with the speed, beyond which the car spins if they rise without a
    # jump
    spin: tuple[float, float]
    speeds: tuple[float, ...]  # L speeds of the noise levels [unit of the speed channel]
    # root mean square of the innovations at these speeds over their deviation, (L, C)
    levels: tuple[tuple[float, ...], ...]
    # offset that the likelihood ratio finds in each channel of healthy drives, (1, C)
    healthy: tuple[tuple[float, ...], ...] = ()
    heaviest: tuple[tuple[float, ...], ...] = ()  # largest weight of one sample in it, (1, C)
    limits: tuple[float, ...] = ()  # limit of each statistic, (K,), in the order of `statistics`
    # lower and upper stop of each channel, between which alone it is expected to move, (C, 2)
    stops: tuple[tuple[float, float], ...] = ()
    # limits for samples that a low-pass from a faster bus has passed (`front_end`), (K,)
    limits_behind_front_end: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Bring limits of earlier versions into the present order, then check shapes and ranges."""
        channels = len(self.channels)
        relations = len(self.relations)
        for name in ("healthy", "heaviest"):
            object.__setattr__(self, name, getattr(self, name)[:1])
        for name in ("limits", "limits_behind_front_end"):
            object.__setattr__(
                self, name, _present_limits(getattr(self, name), channels, relations)
            )
        self._check_shapes()
        self._check_ranges()

    def _check_shapes(self) -> None:
        """Raise `DataError` unless everything has the length that the kernel's arrays have."""
        check_channels("health.channels", self.channels)
        channels = len(self.channels)
        order = len(self.coefficients)
        check_number("health: the order of coefficients", order, 1, MAX_ORDER)
        shapes = {
            **dict.fromkeys(
                ("constant", "deviation", "usual", "largest", "longest_gap"), (channels,)
            ),
            "coefficients": (order, channels, channels),
            "precision": (channels, channels),
            "speeds": (N_LEVELS,),
            "levels": (N_LEVELS, channels),
            "healthy": (len(self.healthy), channels),
            "heaviest": (len(self.heaviest), channels),
        }
        for name, shape in shapes.items():
            check_shape(f"health.{name}", getattr(self, name), *shape)
        if self.stops and len(self.stops) != channels:
            raise DataError(f"health.stops has {len(self.stops)} entries, not {channels}")
        allowed = relations_among(self.channels)
        pairs = {(target, partner) for target, partner, _, _ in allowed}
        for relation in self.relations:
            if (relation.target, relation.partner) not in pairs:
                raise DataError(
                    f"health.relations: there is none of '{relation.target[:40]}' against "
                    f"'{relation.partner[:40]}' among its channels"
                )
        if len(self.relations) > len(allowed):
            raise DataError(f"health.relations has {len(self.relations)} entries of {len(allowed)}")
        for name in ("limits", "limits_behind_front_end"):
            limits = getattr(self, name)
            if limits and len(limits) != len(self.statistics):
                raise DataError(
                    f"health.{name} has {len(limits)} entries, not {len(self.statistics)}"
                )

    def _check_ranges(self) -> None:
        """Raise `DataError` unless numbers are in ranges that training can produce."""
        check_number("health.rate_hz", self.rate_hz, math.ulp(0.0), HIGHEST_RATE)
        for name in ("deviation", "largest", "longest_gap", "spin", "speeds", "standstill"):
            check_numbers(f"health.{name}", getattr(self, name), 0.0)
        check_number("health.standstill", self.standstill[0], math.ulp(0.0))
        for row in self.levels:
            check_numbers("health.levels", row, math.ulp(0.0))
        check_numbers("health.precision", np.diag(np.array(self.precision)), 0.0)
        for row in self.heaviest:
            check_numbers("health.heaviest", row, 0.0)
        for name in ("limits", "limits_behind_front_end"):
            check_numbers(f"health.{name}", getattr(self, name), math.ulp(0.0), ENDLESS)
        for lower, upper in self.stops:
            if not lower <= upper:
                raise DataError(f"health.stops must rise, not {lower:.4g} and {upper:.4g}")

    @property
    def layout(self) -> Layout:
        """Sizes, columns of channels and numbers of rows that the kernel needs."""
        names = self.channels
        columns = columns_of(("yaw_rate", speed_channel(names) or "", "ay", "ax"), names)
        rows = [
            max(round(seconds * self.rate_hz), 1)
            for seconds in (HOLD_SECONDS, BRIDGED_SECONDS, SPIN_SECONDS)
        ]
        rows.append(max(round(SETTLE_SECONDS * self.rate_hz), len(self.coefficients)))
        counts = [len(names), len(self.coefficients), len(self.relations)]
        sizes = [*counts, *columns, *rows, len(self.statistics)]
        return Layout(*sizes)

    @property
    def statistics(self) -> list[Statistic]:
        """Descriptions of all K statistics, in the order of the kernel's `Statistics`."""
        kinds = {
            "normal": ((kernel.JUMP, 0.0), (kernel.JUMP, 0.0), (kernel.OFFSET, OFFSET_SECONDS)),
            "run": ((kernel.FROZEN, 0.0),),
            "share": ((kernel.HELD, 0.0),),
            "domain": ((kernel.OUTSIDE, 0.0),),
            "slip": ((kernel.LOCKED, 0.0),),
        }
        of_channels = [
            Statistic(kind, name, "", seconds, rule)
            for rule, kinds_of_rule in kinds.items()
            for kind, seconds in kinds_of_rule
            for name in self.channels
        ]
        return of_channels + [
            Statistic(
                kernel.CONTRADICTION, relation.target, relation.partner, RELATION_SECONDS, "largest"
            )
            for relation in self.relations
        ]

    def start(self) -> FloatArray:
        """The kernel's `State` before the first row, as a flat array."""
        memory = allocated(State, self.layout)
        views(State, memory, self.layout)[0].energy[:] = 1.0
        return memory

    def packed(self, *, forgets: bool = True, behind_front_end: bool = False) -> FloatArray:
        """The kernel's `Model` in one array.

        Parameters
        ----------
        forgets : bool
            Whether the likelihood ratio of an offset forgets; if not, it is a sum over all rows.
        behind_front_end : bool
            Whether rows come through the filter from a faster bus.
        """
        limits = (self.limits_behind_front_end if behind_front_end else ()) or self.limits
        layout = self.layout
        statistics = self.statistics
        names = list(self.channels)
        tables = allocated(Model, layout)
        step = 1.0 / self.rate_hz
        coefficients = np.array(self.coefficients)
        model, _ = views(Model, tables, layout)

        seconds = (
            SHARE_SECONDS,
            BRAKING_SECONDS,
            ENERGY_SECONDS,
            OFFSET_SECONDS if forgets else math.inf,
            SHORT_SECONDS,
            RELATION_SECONDS,
        )
        settings = [*self.standstill, step, *self.spin, *(1.0 - np.exp(-step / np.array(seconds)))]
        for place, value in zip(
            (*model.layout, *model.settings), (*layout, *settings), strict=True
        ):
            place[...] = value
        for row, relation in enumerate(self.relations):
            model.target[row] = names.index(relation.target)
            model.versus[row] = names.index(relation.partner)
            model.involved[row] = [relation.involves(name, speed_channel(names)) for name in names]
            for feature, value in relation.terms.items():
                if feature == RATE:
                    model.rate_gain[row] = value
                    continue
                model.average[row, FEATURES.index(feature)] = value
                if relation.instant:
                    model.instant[model.target[row], FEATURES.index(feature)] = value
        model.lags[:] = coefficients.transpose(0, 2, 1)
        model.largest[:] = np.maximum(self.largest, 1e-12)
        model.settled_gain[:] = (np.eye(layout.channels) - coefficients.sum(0)).T
        model.steps[:], model.step_power[:] = self._step_filter()
        model.healthy[:] = self.healthy[0] if self.healthy else 0.0
        model.heaviest[:] = self.heaviest[0] if self.heaviest else math.inf
        model.stops[:] = np.array(self.stops or [(-ENDLESS, ENDLESS)]).T
        model.limits.all_values[:] = limits or math.inf
        model.inverse.all_values[:] = 1.0 / model.limits.all_values
        model.modelled[:] = np.diag(self.precision) > 0.0
        for i, name in enumerate(names):
            model.rests[i] = CHANNELS[name].rests
            model.code[i] = NUMBERS[name]
            model.wheel[i] = name.startswith("wheel_speed") and model.instant[i].any()
            model.gap_limit[i] = round(self.longest_gap[i] * self.rate_hz)
        for name in ("constant", "precision", "deviation", "usual", "speeds", "levels"):
            getattr(model, name)[:] = getattr(self, name)
        for k, statistic in enumerate(statistics):
            model.kind[k] = statistic.kind
            model.priority[k] = REASONS[statistic.kind][1]
            model.accused[k] = names.index(statistic.channel)
            model.partner[k] = names.index(statistic.partner) if statistic.partner else -1
        return tables

    def _step_filter(self) -> tuple[FloatArray, FloatArray]:
        """Matched filter for a step that began p samples ago: weights of the last p innovations,
        (p, C, C), the latest first, and the variance of their sum, (C, C).

        With G_j = I - Σ_{l ≤ j} A_l, the effect of a step after j samples, the score of a step is
        Σ_j G_jᵀ S⁻¹ ε_{k-p+1+j} and its variance Σ_j G_jᵀ S⁻¹ G_j.
        """
        coefficients = np.array(self.coefficients)
        precision = np.array(self.precision)
        left = np.eye(len(self.channels)) - np.concatenate(
            [np.zeros((1, *coefficients.shape[1:])), coefficients[:-1]]
        ).cumsum(0)
        return (precision @ left)[::-1].transpose(0, 2, 1), np.einsum(
            "jqm,qr,jrn->mn", left, precision, left
        )


def _present_limits(limits: Sequence[float], channels: int, relations: int) -> tuple[float, ...]:
    """Limits of the statistics of health that this version uses, 7 C + R for C channels and R
    relations between them, picked out of those of a file of an earlier version, which has 23 C +
    4 R or 17 C + 3 R; limits of another number stay as they are.
    """
    forms = {
        23 * channels + 4 * relations: 7 * channels,
        17 * channels + 3 * relations: 5 * channels,
    }.get(len(limits))
    if forms is None:
        return tuple(limits)
    former_limits = np.array(limits)
    times = 4 if forms == 7 * channels else 3
    values, means = np.split(
        former_limits[len(former_limits) - 4 * channels - times * relations :], [4 * channels]
    )
    offsets = former_limits[forms : forms + 4 * channels].reshape(channels, 4)[:, 2]
    present_limits = [
        former_limits[channels : 2 * channels],
        former_limits[forms - channels : forms],
        offsets,
        values,
        means.reshape(relations, times)[:, 1],
    ]
    return tuple(np.concatenate(present_limits).tolist())


def health_rows(
    packed: FloatArray, rows: FloatArray, measured: NDArray[np.bool_], state: FloatArray
) -> Health:
    """Judge rows; one at a time or all at once, the result is bitwise the same.

    Parameters
    ----------
    packed : ndarray
        Model as of `HealthModel.packed`.
    rows : ndarray of shape (T, C)
        Samples in SI units; any value where ``measured`` is false.
    measured : ndarray of shape (T, C)
        Whether a sample was accepted by the guard.
    state : ndarray
        As of `HealthModel.start`; changed in place.
    """
    out = np.empty((3, len(rows)))
    health_kernel(rows, measured, packed, state, out, _NO_STATISTICS)
    return Health(*out)


_NO_STATISTICS = np.empty((0, 0))  # empty statistics, for `health_kernel` where they are not needed


def compile_health(*_: object) -> None:
    """Compile the kernel, for later processes to load."""
    rows = _NO_STATISTICS
    flat = np.empty(0)
    health_kernel.compile(tuple(map(numba.typeof, (rows, rows > 0, flat, flat, rows, rows))))


def learn_health(
    train: Sequence[Recording],
    validation: Sequence[Recording],
    channels: Sequence[str],
    rate_hz: float,
) -> HealthModel:
    """Learn the normal behaviour of channels from healthy drives, without references.

    Single samples that differ from both neighbours are glitches of the recording and are left out
    (`without_glitches`).

    Parameters
    ----------
    train : sequence of Recording
        Determine relations, autoregression and ranges.
    validation : sequence of Recording
        Count for the limits of statistics, together with ``train``.
    channels : sequence of str
        In the order of the rows' columns.
    rate_hz : float
        Sampling rate of all recordings [Hz].

    Returns
    -------
    HealthModel
        With limits for rows as measured and for rows behind the filter from a faster bus.

    Raises
    ------
    DataError
        A recording has another rate or lacks a channel, there are too few samples, or no channel
        can be modelled.
    """
    names = tuple(channels)
    for recording in (*train, *validation):
        if abs(recording.rate_hz / rate_hz - 1.0) > 1e-9:
            raise DataError(
                f"recording '{recording.id}' is sampled at {recording.rate_hz:g} Hz, health was "
                f"fitted at {rate_hz:g} Hz"
            )
    received = train
    train, validation = (
        [without_glitches(recording, names) for recording in part] for part in (train, validation)
    )
    joined = {name: np.concatenate([recording[name] for recording in train]) for name in names}
    speed = speed_channel(names)
    least_speed = least_speed_of(train, names)
    usable = [name for name in names if name in MODELLED or name.startswith("wheel_speed")]
    if not usable:
        raise DataError(
            f"health cannot be judged from {', '.join(names)} alone; it needs at least one of "
            f"{', '.join(MODELLED)}"
        )
    relations = learn_relations(train, usable, rate_hz, least_speed)
    order = max(1, min(MAX_ORDER, MAX_COEFFICIENTS // len(usable) ** 2))
    pieces = [
        residuals_of({name: recording[name] for name in usable}, usable, relations, least_speed)
        for recording in train
    ]
    model = fit_autoregression(pieces, order)
    innovations = np.concatenate([model.innovations(piece) for piece in pieces])
    driven = joined[speed] if speed else np.zeros(len(innovations))
    speeds, factors = learn_noise_levels(innovations, model.covariance, driven, N_LEVELS)
    levels = np.ones((N_LEVELS, len(names)))
    levels[:, [names.index(name) for name in usable]] = factors
    largest = {
        name: float(np.nanmax(np.abs(values), initial=0.0)) for name, values in joined.items()
    }
    turning = (
        joined[speed] * joined["yaw_rate"] if speed and "yaw_rate" in names else np.full(1, np.inf)
    )
    yaw_rate_limit, ay_limit = (
        min(size, 0.1 * largest.get(name, np.inf)) for name, size in STANDSTILL_LIMITS.items()
    )
    health = HealthModel(
        channels=names,
        rate_hz=float(rate_hz),
        relations=tuple(relations),
        **_embedded(model, names, usable),
        usual=tuple(
            float(np.nanmedian(joined[name])) if np.isfinite(joined[name]).any() else 0.0
            for name in names
        ),
        largest=tuple(largest.values()),
        longest_gap=tuple(
            max((longest_run(np.isnan(part[name])) for part in received), default=0) / rate_hz
            for name in names
        ),
        standstill=(least_speed, yaw_rate_limit, ay_limit),
        spin=(
            SPIN_MARGIN * largest.get("yaw_rate", 1e9),
            min(SPIN_MARGIN * float(np.nanmax(np.abs(turning))), 1e9),
        ),
        speeds=tuple(speeds.tolist()),
        levels=_plain(levels),
        stops=tuple(stops_of([recording[name] for recording in train], name) for name in names),
    )
    health = _with_healthy(_with_healthy(health, train), train)
    drives = [*train, *validation]
    filtered = []
    for recording in drives:
        columns = behind_front_end(recording.stack(names), recording.rate_hz).T
        filtered.append(replace(recording, channels=dict(zip(names, columns, strict=True))))
    plain = block_maxima(health, drives)
    behind = block_maxima(health, filtered)
    statistics = health.statistics
    step = 1.0 / rate_hz
    limits = limits_from(plain, statistics, step)
    limits_behind = limits_from(np.maximum(plain, behind), statistics, step)
    return replace(health, limits=limits, limits_behind_front_end=limits_behind)


def _embedded(model: Autoregression, names: Sequence[str], usable: Sequence[str]) -> dict[str, Any]:
    """Fields of `HealthModel` with an autoregression of the ``usable`` channels, extended to all
    channels, ``names``, by zeros.
    """
    places = [names.index(name) for name in usable]
    n = len(names)
    constant = np.zeros(n)
    coefficients = np.zeros((model.order, n, n))
    precision = np.zeros((n, n))
    deviation = np.ones(n)
    constant[places] = model.constant
    deviation[places] = np.sqrt(np.diag(model.covariance))
    coefficients[np.ix_(range(model.order), places, places)] = model.coefficients
    precision[np.ix_(places, places)] = np.linalg.inv(model.covariance)
    parts = {
        "constant": constant,
        "coefficients": coefficients,
        "precision": precision,
        "deviation": deviation,
    }
    return {name: _plain(values) for name, values in parts.items()}


def _plain(values: FloatArray) -> Any:
    """Nested tuples of an array's numbers, as YAML holds them."""
    return tuple(_plain(part) for part in values) if values.ndim > 1 else tuple(values.tolist())


def _with_healthy(model: HealthModel, recordings: Sequence[Recording]) -> HealthModel:
    """Fill `HealthModel.healthy` and `HealthModel.heaviest` from healthy drives.

    It is called twice, since the largest weight of a sample changes the offsets.
    """
    packed = replace(model, limits=(), healthy=()).packed(forgets=False)
    total, weight = np.zeros((2, len(model.channels)))
    for recording in recordings:
        memory = model.start()
        rows = np.ascontiguousarray(recording.stack(model.channels))
        health_rows(packed, rows, np.isfinite(rows), memory)
        state, _ = views(State, memory, model.layout)
        total += state.ratio_sum
        weight += state.ratio_weight
    mean_offset = total / np.maximum(weight, 1e-300)
    heaviest = MAX_RELATIVE_WEIGHT * weight / sum(len(recording) for recording in recordings)
    return replace(model, healthy=(_plain(mean_offset),), heaviest=(_plain(heaviest),))


def block_maxima(model: HealthModel, recordings: Sequence[Recording]) -> FloatArray:
    """Largest value of each of K statistics in each of B blocks of `BLOCK_SECONDS`, (B, K), for
    `limits_from`.

    Parameters
    ----------
    model : HealthModel
        Its limits do not count.
    recordings : sequence of Recording
        Each begins with a new state; the last block of one may be shorter.
    """
    packed = replace(model, limits=()).packed()
    n_statistics = len(model.statistics)
    length = max(round(BLOCK_SECONDS * model.rate_hz), 1)
    maxima = []
    for recording in recordings:
        state = model.start()
        samples = np.ascontiguousarray(recording.stack(model.channels))
        for begin in range(0, len(samples), length):
            part = samples[begin : begin + length]
            statistics = np.empty((len(part), n_statistics))
            health_kernel(
                part, np.isfinite(part), packed, state, np.empty((3, len(part))), statistics
            )
            maxima.append(statistics.max(0))
    return np.array(maxima)


def margin(seconds: float, healthy_seconds: float) -> float:
    """Ratio of a limit to the largest value of a statistic in healthy drives.

    The limit is exceeded about once in `HOURS_BETWEEN_FALSE_ALARMS`. The largest of N independent
    normal values is about √(2 ln N), with one value in each ``seconds``. The ratio of both is
    multiplied by `DAY_TO_DAY_FACTOR`.

    Parameters
    ----------
    seconds : float
        Time constant of the statistic [s].
    healthy_seconds : float
        Length of the healthy drives [s].
    """
    n_healthy, n_allowed = (
        max(time / seconds, MIN_INDEPENDENT_VALUES)
        for time in (healthy_seconds, 3600.0 * HOURS_BETWEEN_FALSE_ALARMS)
    )
    return DAY_TO_DAY_FACTOR * max(math.sqrt(math.log(n_allowed) / math.log(n_healthy)), 1.0)


def limits_from(
    maxima: FloatArray, statistics: Sequence[Statistic], step: float
) -> tuple[float, ...]:
    """Limits of all K statistics from healthy drives.

    A limit is the largest value times `margin`. Blocks that exceed all others by `OUTLIER_FACTOR`
    are not counted, since recordings have faults of their own: of thirty blocks or more at most
    `MAX_OUTLIER_SHARE`, but one at least; of fewer, none.

    Rules: ``share`` is 0.15 above the largest value, `MIN_REPEATED_SHARE` at least, and at most
    half way from the largest value to 1; ``domain`` is
    `DAY_TO_DAY_FACTOR` alone; ``run`` has two samples more, and `MIN_RUN_SAMPLES` at least; the
    others have a smallest limit (`MIN_LIMITS`). A limit that would be 0, and that of the share of a
    channel that always repeats, is 1e300, which is never exceeded.

    Parameters
    ----------
    maxima : ndarray of shape (B, K)
        Largest value of each statistic in each block, as of `block_maxima`.
    statistics : sequence of Statistic
        The K statistics.
    step : float
        Sampling interval [s].
    """
    ordered = np.sort(maxima, axis=0)[::-1]
    set_aside = max(1, int(MAX_OUTLIER_SHARE * len(maxima))) if len(maxima) >= 30 else 0
    limits = []
    for column, statistic in zip(ordered.T, statistics, strict=True):
        outlying_blocks = [
            k for k in range(set_aside) if column[k] > OUTLIER_FACTOR * column[k + 1]
        ]
        top = float(column[outlying_blocks[-1] + 1] if outlying_blocks else column[0])
        limit = margin(max(statistic.seconds, step), BLOCK_SECONDS * len(maxima)) * top
        # half way to 1 at most, or a channel that often repeats itself could never be found to
        # repeat only
        if statistic.rule == "share":
            limit = min(max(top + 0.15, MIN_REPEATED_SHARE), 0.5 * (1.0 + min(top, 1.0)))
        elif statistic.rule == "domain":
            limit = DAY_TO_DAY_FACTOR
        elif statistic.rule == "run":
            limit = max(limit + 2.0, MIN_RUN_SAMPLES)
        else:
            limit = max(limit, MIN_LIMITS[statistic.rule])
        limits.append(
            limit if limit > 0.0 and not (statistic.rule == "share" and top >= 1.0) else 1e300
        )
    return tuple(limits)


def outside_domain(model: HealthModel, samples: Mapping[str, FloatArray]) -> NDArray[np.int64]:
    """Count the samples of a drive that are outside the range of the training.

    Parameters
    ----------
    model : HealthModel
        Of C channels.
    samples : mapping
        Channel -> (T,) in SI units.

    Returns
    -------
    ndarray of shape (C + 2,)
        Samples outside by each channel, samples outside by any, and T.
    """
    sizes = [
        np.abs(np.nan_to_num(np.asarray(samples[name], dtype=np.float64), posinf=0.0, neginf=0.0))
        for name in model.channels
    ]
    outside = np.stack(sizes) > DAY_TO_DAY_FACTOR * np.array(model.largest)[:, None]
    return np.array([*outside.sum(axis=1), outside.any(axis=0).sum(), len(sizes[0])])


def domain_verdict(model: HealthModel, counts: NDArray[np.int64]) -> str:
    """Describe the share of a drive outside the training's range; empty if there is none.

    ``counts`` is the result of `outside_domain`.
    """
    *numbers, outside, samples = counts.tolist()
    named = [
        (n_outside, f"|{name}| above {DAY_TO_DAY_FACTOR * largest:.3g} {CHANNELS[name].unit}")
        for n_outside, name, largest in zip(numbers, model.channels, model.largest, strict=True)
        if n_outside
    ]
    if not named:
        return ""
    words = ", ".join(text for _, text in sorted(named, reverse=True)[:3])
    return (
        f"{100.0 * outside / samples:.3g} % of the drive outside the range of the training: {words}"
    )
