"""Judges estimates by the channels that they were made from: valid, degraded or invalid, with a reason.

    drives -> learn_health -> HealthModel (trust.yaml) -> packed -> health_rows -> status, reason

Learnt from training drives without any reference: relations between channels (`vehest.trust.relations`), an autoregression of what they
leave (`vehest.trust.autoregression`), and for every statistic of `vehest.trust.health_kernel` the largest value that healthy training and
validation drives reach. A statistic beyond its limit, that value times a margin, flags the estimate at once as degraded or invalid, with a
reason. The flag is taken back after `HOLD_SECONDS` in which every statistic stayed below `CLEAR` times its limit.
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
from vehest.trust.guard import ENDLESS, longest_run, stops_of
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

VALID = 0
DEGRADED = 1
INVALID = 2

HOLD_SECONDS = 1.0  # for which a flag stays after the last statistic went down
BRIDGED_SECONDS = 0.5  # from which on a missing channel makes the estimate invalid
SPIN_SECONDS = 0.3
SETTLE_SECONDS = 0.5  # after a start, before predictions count
SHARE_SECONDS = 0.5  # over which equal samples are counted
BRAKING_SECONDS = 0.2  # over which ax is averaged
ENERGY_SECONDS = 0.5  # over which what is usual is known, before a jump
OFFSET_SECONDS = 4.0
RELATION_SECONDS = 1.0
SHORT_SECONDS = 0.25  # over which both sides of a relation are averaged before their signs and sizes are compared

BLOCK_SECONDS = 5.0  # whose largest values set the limits
HOURS = 100.0  # in which healthy drives are to exceed a limit about once
BETWEEN_DRIVES = 1.25  # by which another day's drive may exceed what was seen: tyres, track, wind
LEAST_VALUES = 10.0  # independent ones that any time holds
LEAST_RUN = 4.0  # equal samples in a row
LEAST_SHARE = 0.3
LEAST = {
    "normal": 4.5,
    "slip": 0.3,
    "largest": 0.0,
}  # limits of statistics that are N(0, 1) without a fault, and of slip
APART = (
    2.0  # times the next largest block, from which on a block is a fault of the recording itself
)
MOST_APART = 0.01  # share of blocks that may be
SPIN_MARGIN = 1.3
HEAVIEST = 5.0  # of the mean weight of a sample, that one sample may have in a likelihood ratio
STILL = {"yaw_rate": 0.05, "ay": 0.5}  # rad/s, m/s²: below which a car may be taken to stand

MAX_ORDER = 10
MOST_COEFFICIENTS = 700  # of the autoregression: what a step can afford

MODELLED = ("yaw_rate", "vx", "ay", "ax", "steer", "handwheel", "motor_speed", "motor_current")
"""Channels that the autoregression holds, beside the wheels' speeds; of others only range, gaps and standing still are watched."""

NUMBERS = {
    name: number for number, name in enumerate(CHANNELS, start=1)
}  # number of a channel in a reason's code
_NAMES = {number: name for name, number in NUMBERS.items()}

NO_ESTIMATE = 30
BEYOND_SPEED = 31
TOO_WIDE = 32
"""Kinds of reasons that follow from an estimate and not from its channels (`vehest.trust.verdict`)."""

SLOW_KERNEL = "vehest.trust.health_kernel:health_kernel"  # compiles for tens of seconds

REASONS: dict[int, tuple[str, float]] = {
    kernel.FREE: ("", 0.0),
    kernel.MISSING: ("{channel} is not measured", 0.0),
    kernel.FROZEN: ("{channel} is frozen", 8.0),
    kernel.HELD: ("{channel} repeats its samples", 7.0),
    kernel.JUMP: ("{channel} jumps, or is noisier than where the model learnt", 2.0),
    kernel.NOISE: ("{channel} is noisier than where the model learnt", 2.5),
    kernel.SMOOTH: ("{channel} varies less than where the model learnt", 1.5),
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
"""Kind of a reason -> text, and priority over others: the most specific is given.

A code is 10000 times the kind, 100 times the channel's number, and the partner's.
"""

RETIRED = (kernel.NOISE, kernel.SMOOTH, kernel.SCALE, kernel.LATE)  # kinds of earlier versions


def reason_in_words(code: float) -> str:
    """Text of a reason's code; empty for 0."""
    kind, rest = divmod(round(code), 10_000)
    channel, partner = divmod(rest, 100)
    return REASONS[kind][0].format(
        channel=_NAMES.get(channel, "?"), partner=_NAMES.get(partner, "the other channels")
    )


class Health(NamedTuple):
    """Status of rows."""

    status: FloatArray  # 0 valid, 1 degraded, 2 invalid, (T,)
    reason: FloatArray  # code, (T,); 0 where there is none
    ratio: FloatArray  # largest statistic over its limit, (T,)


class Statistic(NamedTuple):
    """Kind of reason, channel, the other channel of a relation, time constant [s], and the rule for its limit."""

    kind: int
    channel: str
    partner: str
    seconds: float
    rule: str


@dataclass(frozen=True)
class HealthModel:
    """Normal behaviour of a car's C channels."""

    channels: tuple[str, ...]  # in the order of the rows' columns
    rate_hz: float  # of the rows [Hz]
    relations: tuple[Relation, ...]  # between channels
    constant: tuple[float, ...]  # of the autoregression, one a channel
    coefficients: tuple[
        tuple[tuple[float, ...], ...], ...
    ]  # of the autoregression: lag, channel, former channel
    precision: tuple[
        tuple[float, ...], ...
    ]  # inverse of the innovations' covariance; zero for channels that are not modelled
    deviation: tuple[float, ...]  # of each channel's innovations
    usual: tuple[float, ...]  # median of each channel
    largest: tuple[float, ...]  # largest size of each channel in training
    longest_gap: tuple[float, ...]  # longest time without a sample of each channel in training [s]
    standstill: tuple[
        float, float, float
    ]  # speed [unit of its channel], yaw rate [rad/s], ay [m/s²], below all of which the car stands
    spin: tuple[
        float, float
    ]  # yaw rate, and its product with the speed, beyond which the car spins if they rise without a jump
    speeds: tuple[float, ...]  # at which the noise was looked at [unit of the speed channel]
    levels: tuple[
        tuple[float, ...], ...
    ]  # size of the innovations at these speeds, in their deviations, one row a speed
    healthy: tuple[
        tuple[float, ...], ...
    ] = ()  # offset that the likelihood ratio finds in each channel of healthy drives, one row
    heaviest: tuple[tuple[float, ...], ...] = ()  # weight that one sample may have in it, one row
    limits: tuple[float, ...] = ()  # of every statistic, in the order of `statistics`
    stops: tuple[
        tuple[float, float], ...
    ] = ()  # of each channel, between which alone it is expected to move
    limits_behind_front_end: tuple[
        float, ...
    ] = ()  # the same for samples that a filter from a faster bus has passed (`front_end`)

    def __post_init__(self) -> None:
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
        for name in ("constant", "deviation", "usual", "largest", "longest_gap"):
            check_shape(f"health.{name}", getattr(self, name), channels)
        check_number("health: the order of coefficients", len(self.coefficients), 1, MAX_ORDER)
        order = len(self.coefficients)
        check_shape("health.coefficients", self.coefficients, order, channels, channels)
        check_shape("health.precision", self.precision, channels, channels)
        check_shape("health.speeds", self.speeds, N_LEVELS)
        check_shape("health.levels", self.levels, N_LEVELS, channels)
        for name in ("healthy", "heaviest"):
            check_shape(f"health.{name}", getattr(self, name), len(getattr(self, name)), channels)
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
        """Raise `DataError` unless numbers can be what training leaves behind."""
        check_number("health.rate_hz", self.rate_hz, math.ulp(0.0), HIGHEST_RATE)
        for name in ("deviation", "largest", "longest_gap", "spin", "speeds"):
            check_numbers(f"health.{name}", getattr(self, name), 0.0)
        check_numbers("health.standstill", self.standstill, 0.0)
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
        """Sizes and columns for the kernel."""
        names = list(self.channels)
        columns = [
            names.index(name) if name in names else -1
            for name in ("yaw_rate", speed_channel(names) or "", "ay", "ax")
        ]
        rows = [
            max(round(seconds * self.rate_hz), 1)
            for seconds in (HOLD_SECONDS, BRIDGED_SECONDS, SPIN_SECONDS)
        ]
        rows.append(max(round(SETTLE_SECONDS * self.rate_hz), len(self.coefficients)))
        return Layout._make(
            [
                len(names),
                len(self.coefficients),
                len(self.relations),
                *columns,
                *rows,
                len(self.statistics),
            ]
        )

    @property
    def statistics(self) -> list[Statistic]:
        """All statistics, in the kernel's order."""
        kinds = {
            "normal": ((kernel.JUMP, 0.0), (kernel.JUMP, 0.0), (kernel.OFFSET, OFFSET_SECONDS)),
            "run": ((kernel.FROZEN, 0.0),),
            "share": ((kernel.HELD, 0.0),),
            "domain": ((kernel.OUTSIDE, 0.0),),
            "slip": ((kernel.LOCKED, 0.0),),
        }
        own = [
            Statistic(kind, name, "", seconds, rule)
            for rule, those in kinds.items()
            for kind, seconds in those
            for name in self.channels
        ]
        return own + [
            Statistic(kernel.CONTRADICTION, one.target, one.partner, RELATION_SECONDS, "largest")
            for one in self.relations
        ]

    def start(self) -> FloatArray:
        """State before the first row."""
        memory = allocated(State, self.layout)
        views(State, memory, self.layout)[0].energy[:] = 1.0
        return memory

    def packed(self, *, forgets: bool = True, behind_front_end: bool = False) -> FloatArray:
        """The kernel's `Model` in one array.

        Args:
            forgets: whether the likelihood ratio of an offset does; if not, it is a sum over all rows.
            behind_front_end: whether rows come through the filter from a faster bus.
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
        model.limits.every[:] = limits or math.inf
        model.inverse.every[:] = 1.0 / model.limits.every
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
        """Weights of the last p innovations on a step that began p samples ago, (p, C, C), the latest first, and their power, (C, C)."""
        coefficients = np.array(self.coefficients)
        precision = np.array(self.precision)
        left = np.eye(len(self.channels)) - np.concatenate(
            [np.zeros((1, *coefficients.shape[1:])), coefficients[:-1]]
        ).cumsum(0)
        return (precision @ left)[::-1].transpose(0, 2, 1), np.einsum(
            "jqm,qr,jrn->mn", left, precision, left
        )


def _present_limits(limits: Sequence[float], channels: int, relations: int) -> tuple[float, ...]:
    """Limits without those of statistics that earlier versions had: 23 C + 4 R of them at first, then 17 C + 3 R, now 7 C + R."""
    forms = {
        23 * channels + 4 * relations: 7 * channels,
        17 * channels + 3 * relations: 5 * channels,
    }.get(len(limits))
    if forms is None:
        return tuple(limits)
    given = np.array(limits)
    times = 4 if forms == 7 * channels else 3
    values, means = np.split(given[len(given) - 4 * channels - times * relations :], [4 * channels])
    offsets = given[forms : forms + 4 * channels].reshape(channels, 4)[:, 2]
    kept = [
        given[channels : 2 * channels],
        given[forms - channels : forms],
        offsets,
        values,
        means.reshape(relations, times)[:, 1],
    ]
    return tuple(np.concatenate(kept).tolist())


def health_rows(
    packed: FloatArray, rows: FloatArray, measured: NDArray[np.bool_], state: FloatArray
) -> Health:
    """Judge rows (T, C), one at a time or all at once, to the same bits; they may hold anything where ``measured`` is false.

    ``packed`` is of `HealthModel.packed`; ``state`` of `HealthModel.start`, changed in place.
    """
    out = np.empty((3, len(rows)))
    health_kernel(rows, measured, packed, state, out, _NO_STATISTICS)
    return Health(*out)


_NO_STATISTICS = np.empty((0, 0))


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
    """Learn normal behaviour from drives at ``rate_hz``, without references: the training's limits count with those of validation.

    Single samples that stand apart from both neighbours are glitches of the recording and left out (`without_glitches`).

    Raises `DataError`: a recording has another rate or lacks a channel, or there are too few samples.
    """
    names = tuple(channels)
    for recording in (*train, *validation):
        if abs(recording.rate_hz / rate_hz - 1.0) > 1e-9:
            raise DataError(
                f"recording '{recording.id}' is sampled at {recording.rate_hz:g} Hz, health is learnt at {rate_hz:g} Hz"
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
            f"health cannot be judged from {', '.join(names)} alone; it needs at least one of {', '.join(MODELLED)}"
        )
    relations = learn_relations(train, usable, rate_hz, least_speed)
    order = max(1, min(MAX_ORDER, MOST_COEFFICIENTS // len(usable) ** 2))
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
    still = [min(size, 0.1 * largest.get(name, np.inf)) for name, size in STILL.items()]
    found = HealthModel(
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
        standstill=(least_speed, still[0], still[1]),
        spin=(
            SPIN_MARGIN * largest.get("yaw_rate", 1e9),
            min(SPIN_MARGIN * float(np.nanmax(np.abs(turning))), 1e9),
        ),
        speeds=tuple(speeds.tolist()),
        levels=_plain(levels),
        stops=tuple(stops_of([recording[name] for recording in train], name) for name in names),
    )
    found = _with_healthy(_with_healthy(found, train), train)
    filtered = [
        replace(
            recording,
            channels=dict(
                zip(
                    names,
                    behind_front_end(recording.stack(names), recording.rate_hz).T,
                    strict=True,
                )
            ),
        )
        for recording in (*train, *validation)
    ]
    plain, behind = (block_maxima(found, drives) for drives in ([*train, *validation], filtered))
    statistics = found.statistics
    step = 1.0 / rate_hz
    limits = limits_from(plain, statistics, step)
    limits_behind = limits_from(np.maximum(plain, behind), statistics, step)
    return replace(found, limits=limits, limits_behind_front_end=limits_behind)


def _embedded(model: Autoregression, names: Sequence[str], usable: Sequence[str]) -> dict[str, Any]:
    """The autoregression as one of all channels, those that it does not hold being zero in it."""
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
    return tuple(_plain(part) for part in values) if values.ndim > 1 else tuple(values.tolist())


def _with_healthy(model: HealthModel, recordings: Sequence[Recording]) -> HealthModel:
    """With the offset that the likelihood ratio finds over all of training, and `HEAVIEST` times its mean weight."""
    packed = replace(model, limits=(), healthy=()).packed(forgets=False)
    total, weight = np.zeros((2, len(model.channels)))
    for recording in recordings:
        memory = model.start()
        rows = np.ascontiguousarray(recording.stack(model.channels))
        health_rows(packed, rows, np.isfinite(rows), memory)
        state, _ = views(State, memory, model.layout)
        total += state.ratio_sum
        weight += state.ratio_weight
    found = total / np.maximum(weight, 1e-300)
    heaviest = HEAVIEST * weight / sum(len(recording) for recording in recordings)
    return replace(model, healthy=(_plain(found),), heaviest=(_plain(heaviest),))


def block_maxima(model: HealthModel, recordings: Sequence[Recording]) -> FloatArray:
    """Largest value of each statistic in blocks of `BLOCK_SECONDS`, (B, K), while nothing limits any."""
    packed = replace(model, limits=()).packed()
    n_statistics = len(model.statistics)
    length = max(round(BLOCK_SECONDS * model.rate_hz), 1)
    found = []
    for recording in recordings:
        state = model.start()
        samples = np.ascontiguousarray(recording.stack(model.channels))
        for begin in range(0, len(samples), length):
            part = samples[begin : begin + length]
            statistics = np.empty((len(part), n_statistics))
            health_kernel(
                part, np.isfinite(part), packed, state, np.empty((3, len(part))), statistics
            )
            found.append(statistics.max(0))
    return np.array(found)


def margin(seconds: float, healthy_seconds: float) -> float:
    """Factor between the largest value of a statistic in ``healthy_seconds`` and the one that is exceeded about once in `HOURS`.

    The ratio of the largest of N normal values, √(2 ln N), one each ``seconds``, times `BETWEEN_DRIVES`.
    """
    seen, wanted = (max(time / seconds, LEAST_VALUES) for time in (healthy_seconds, 3600.0 * HOURS))
    return BETWEEN_DRIVES * max(math.sqrt(math.log(wanted) / math.log(seen)), 1.0)


def limits_from(
    maxima: FloatArray, statistics: Sequence[Statistic], step: float
) -> tuple[float, ...]:
    """Limits of all K statistics from their largest values in blocks of healthy drives, (B, K), and the sampling interval ``step`` [s].

    The largest value times `margin`, where blocks that stand apart from all others by a factor of `APART`, at most `MOST_APART` of them
    and one from thirty blocks on, do not count: recordings hold faults of their own.
    """
    ordered = np.sort(maxima, axis=0)[::-1]
    set_aside = max(1, int(MOST_APART * len(maxima))) if len(maxima) >= 30 else 0
    found = []
    for column, statistic in zip(ordered.T, statistics, strict=True):
        apart = [k for k in range(set_aside) if column[k] > APART * column[k + 1]]
        top = float(column[apart[-1] + 1] if apart else column[0])
        limit = margin(max(statistic.seconds, step), BLOCK_SECONDS * len(maxima)) * top
        if (
            statistic.rule == "share"
        ):  # half way to 1 at most, or a channel that often repeats itself could never be found to repeat only
            limit = min(max(top + 0.15, LEAST_SHARE), 0.5 * (1.0 + min(top, 1.0)))
        elif statistic.rule == "domain":
            limit = BETWEEN_DRIVES
        else:
            limit = (
                max(limit + 2.0, LEAST_RUN)
                if statistic.rule == "run"
                else max(limit, LEAST[statistic.rule])
            )
        found.append(
            limit if limit > 0.0 and not (statistic.rule == "share" and top >= 1.0) else 1e300
        )
    return tuple(found)


def outside_domain(model: HealthModel, samples: Mapping[str, FloatArray]) -> NDArray[np.int64]:
    """Samples of a drive, channel -> (T,), outside the training's range, (C + 2,): of each channel, of any, and number of all."""
    sizes = [
        np.abs(np.nan_to_num(np.asarray(samples[name], dtype=np.float64), posinf=0.0, neginf=0.0))
        for name in model.channels
    ]
    outside = [
        size > BETWEEN_DRIVES * largest for size, largest in zip(sizes, model.largest, strict=True)
    ]
    return np.array([*(own.sum() for own in outside), np.any(outside, axis=0).sum(), len(sizes[0])])


def domain_verdict(model: HealthModel, counts: NDArray[np.int64]) -> str:
    """One line on the share of a drive outside the training's range, and by which channels, of `outside_domain`; empty if there is none."""
    *numbers, outside, samples = counts.tolist()
    named = [
        (own, f"|{name}| above {BETWEEN_DRIVES * largest:.3g} {CHANNELS[name].unit}")
        for own, name, largest in zip(numbers, model.channels, model.largest, strict=True)
        if own
    ]
    if not named:
        return ""
    words = ", ".join(text for _, text in sorted(named, reverse=True)[:3])
    return (
        f"{100.0 * outside / samples:.3g} % of the drive outside the range of the training: {words}"
    )
