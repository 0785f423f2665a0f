"""Whether an estimate can be trusted, judged from the channels it was made from.

Learnt from training drives without any reference: relations between channels (`vehest.trust.relations`), an autoregression of what they
leave (`vehest.trust.autoregression`), and for every statistic of `vehest.trust.health_kernel` the largest value that training and
validation drives reach. A statistic beyond its limit flags the estimate at once, as degraded or invalid, with a reason; the flag is taken
back after `HOLD_SECONDS` in which every statistic stayed below `CLEAR` times its limit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.trust.autoregression import fit_autoregression, learn_noise_levels
from vehest.trust.health_kernel import (
    CONTRADICTION,
    DELAY,
    DROPOUT,
    FREE,
    FROZEN,
    HELD,
    JUMP,
    LOCKED,
    MEMORY,
    MISSING,
    N_LEVELS,
    N_FEATURES,
    NOISE,
    OFFSET,
    OUTSIDE,
    SCALE,
    SETTINGS,
    SIGN,
    SMOOTH,
    SPIN,
    UNIT,
    health_kernel,
    n_state,
    n_statistics,
)
from vehest.trust.relations import FEATURES, RATE, Relation, learn_relations, least_speed_of, residuals_of, speed_channel, without_glitches

VALID, DEGRADED, INVALID = 0, 1, 2
STATUS = ("valid", "degraded", "invalid")

HOLD_SECONDS = 1.0  # for which a flag stays after the last statistic went down
BRIDGED_SECONDS = 0.5  # from which on a missing channel makes the estimate invalid
SPIN_SECONDS = 0.3
BLOCK_SECONDS = 5.0  # whose largest values set the limits
ENERGY_SECONDS = (0.1, 0.5, 2.0)
RATIO_SECONDS = (0.25, 1.0, 4.0, 12.0)
RELATION_SECONDS = (0.25, 1.0, 4.0, 12.0)
SHARE_SECONDS = 0.5
HEAVIEST = 5.0  # of the mean weight of a sample, that one sample may have in a likelihood ratio
LATE_SECONDS = 0.05  # of the low-pass that stands for a delay
MARGIN = 1.5  # of a limit over the largest value seen
LEAST_Z = 4.5  # below which no statistic that is N(0, 1) while all is well counts
DOMAIN_MARGIN = 1.1  # of a channel over its largest value in training, beyond which it is outside what was learnt
SPIN_MARGIN = 1.3
MAX_ORDER = 10
MOST_COEFFICIENTS = 700
"""Of the autoregression: what a step can afford."""

MODELLED = ("yaw_rate", "vx", "ay", "ax", "steer", "handwheel", "motor_speed", "motor_current")
"""Channels that the autoregression holds, beside the wheels' speeds; of others only range, gaps and standing still are watched."""

NUMBERS = {name: number for number, name in enumerate(CHANNELS, start=1)}
"""Number of a channel in a reason's code."""
_NAMES = {number: name for name, number in NUMBERS.items()}

WORDS = {
    FREE: "nothing found",
    MISSING: "{channel} is not measured",
    FROZEN: "{channel} is frozen",
    HELD: "{channel} repeats its samples",
    JUMP: "{channel} jumps",
    NOISE: "{channel} is noisier than where the model learnt",
    SMOOTH: "{channel} varies less than where the model learnt",
    OFFSET: "{channel} has an offset against the other channels",
    SCALE: "{channel} has another scale than the other channels",
    SIGN: "{channel} has the wrong sign",
    UNIT: "{channel} has the wrong unit",
    CONTRADICTION: "{channel} and {partner} contradict each other",
    OUTSIDE: "outside what the model learnt: |{channel}|",
    SPIN: "spin",
    LOCKED: "locked wheel: {channel}",
    DROPOUT: "lost wheel: {channel}",
    DELAY: "{channel} comes late",
}
"""Kind of a reason -> what is said. A code is 10000 times the kind, 100 times the channel's number, and the partner's."""


def reason_in_words(code: float) -> str:
    """What a reason's code says."""
    kind, rest = divmod(round(code), 10_000)
    channel, partner = divmod(rest, 100)
    return WORDS[kind].format(channel=_NAMES.get(channel, "?"), partner=_NAMES.get(partner, "the other channels"))


def reason_kind(code: float) -> int:
    """Kind of a reason's code."""
    return round(code) // 10_000


def reason_channel(code: float) -> str:
    """Channel that a reason's code accuses; empty where it names none."""
    return _NAMES.get(round(code) % 10_000 // 100, "")


class PackedHealth(NamedTuple):
    """A model as the kernel reads it."""

    numbers: FloatArray
    sizes: NDArray[np.int64]


class Health(NamedTuple):
    """What was found in rows.

    Args:
        status: 0 valid, 1 degraded, 2 invalid, (T,).
        reason: code, (T,); 0 where there is none.
        ratio: largest statistic over its limit, (T,).
    """

    status: FloatArray
    reason: FloatArray
    ratio: FloatArray


@dataclass(frozen=True)
class HealthModel:
    """What is normal for a car's channels.

    Args:
        channels: in the order of the rows' columns.
        rate_hz: of the rows [Hz].
        relations: between channels.
        constant: of the autoregression, one a channel.
        coefficients: of the autoregression: lag, channel, former channel.
        precision: inverse of the innovations' covariance.
        deviation: of each channel's innovations.
        usual: median of each channel.
        largest: largest size of each channel in training.
        longest_gap: longest time without a sample of each channel in training [s].
        standstill: speed [unit of the speed channel], yaw rate [rad/s], ay [m/s²], below all of which the car stands.
        spin: yaw rate [rad/s] and product with the speed beyond which the car spins, if they rise without a jump.
        speeds: at which the noise was looked at [unit of the speed channel].
        levels: size of the innovations at these speeds, in their deviations.
        healthy: offset, scale and delay that the likelihood ratios find in each channel while all is well.
        heaviest: weight that one sample may have in them.
        limits: of every statistic, as `health_kernel` counts them.
    """

    channels: tuple[str, ...]
    rate_hz: float
    relations: tuple[Relation, ...]
    constant: tuple[float, ...]
    coefficients: tuple[tuple[tuple[float, ...], ...], ...]
    precision: tuple[tuple[float, ...], ...]
    deviation: tuple[float, ...]
    usual: tuple[float, ...]
    largest: tuple[float, ...]
    longest_gap: tuple[float, ...]
    standstill: tuple[float, float, float]
    spin: tuple[float, float]
    speeds: tuple[float, ...]
    levels: tuple[tuple[float, ...], ...]
    healthy: tuple[tuple[float, ...], ...]
    heaviest: tuple[tuple[float, ...], ...]
    limits: tuple[float, ...] = ()

    @property
    def n_statistics(self) -> int:
        """How many statistics are watched."""
        return n_statistics(len(self.channels), len(self.relations), len(ENERGY_SECONDS), len(RATIO_SECONDS), len(RELATION_SECONDS))

    def start(self) -> FloatArray:
        """State before the first row."""
        sizes = (len(self.channels), len(self.coefficients), len(self.relations))
        state = np.zeros(n_state(*sizes, len(ENERGY_SECONDS), len(RATIO_SECONDS), len(RELATION_SECONDS)))
        C, p = len(self.channels), len(self.coefficients)
        first = MEMORY + 5 * C + 4 * p * C
        state[first : first + C * len(ENERGY_SECONDS)] = 1.0
        return state

    def _step_filter(self) -> tuple[FloatArray, FloatArray]:
        """Weights of the last p innovations on a step that began p samples ago, (p, C, C), the latest first, and their power, (C, C)."""
        coefficients, precision = np.array(self.coefficients), np.array(self.precision)
        left = np.eye(len(self.channels)) - np.concatenate([np.zeros((1, *coefficients.shape[1:])), coefficients[:-1]]).cumsum(0)
        return (precision @ left)[::-1].transpose(0, 2, 1), np.einsum("jqm,qr,jrn->mn", left, precision, left)

    def packed(self) -> PackedHealth:
        """Tables of the kernel."""
        names, n_channels = list(self.channels), len(self.channels)
        coefficients = np.array(self.coefficients)
        instant, everything = np.zeros((n_channels, N_FEATURES)), np.zeros((len(self.relations), N_FEATURES))
        rates = np.zeros(len(self.relations))
        for row, relation in enumerate(self.relations):
            for feature, value in relation.terms.items():
                if feature == RATE:
                    rates[row] = value
                    continue
                everything[row, FEATURES.index(feature)] = value
                if relation.instant:
                    instant[names.index(relation.target), FEATURES.index(feature)] = value
        domain = np.maximum(np.array(self.largest), 1e-12)
        step = 1.0 / self.rate_hz

        def forgetting(seconds: Sequence[float]) -> FloatArray:
            return 1.0 - np.exp(-step / np.array(seconds))

        limits = self.limits or (math.inf,) * self.n_statistics
        settings = [*self.standstill, step, *self.spin, *forgetting([SHARE_SECONDS, 0.2, LATE_SECONDS])]
        parts = [
            np.array(self.constant),
            coefficients.transpose(0, 2, 1),
            np.array(self.precision),
            np.array(self.deviation),
            instant,
            everything,
            rates,
            np.array(self.usual),
            np.stack([-domain, domain]),
            np.array(self.speeds),
            np.array(self.levels),
            (np.eye(n_channels) - coefficients.sum(0)).T,
            *self._step_filter(),
            np.array(self.healthy),
            np.array(self.heaviest),
            forgetting(ENERGY_SECONDS),
            forgetting(RATIO_SECONDS),
            forgetting(RELATION_SECONDS),
            np.array(limits),
            np.array(settings),
        ]
        speed = speed_channel(names)

        def place(name: str | None) -> int:
            return names.index(name) if name in names else -1

        rows = [round(seconds * self.rate_hz) for seconds in (HOLD_SECONDS, BRIDGED_SECONDS, SPIN_SECONDS)]
        sizes = [
            n_channels,
            len(coefficients),
            len(self.relations),
            *(len(seconds) for seconds in (ENERGY_SECONDS, RATIO_SECONDS, RELATION_SECONDS)),
            *(place(name) for name in ("yaw_rate", speed, "ay", "ax")),
            *(max(row, 1) for row in rows),
            *(int(self.precision[i][i] > 0.0) for i in range(n_channels)),
            *(int(CHANNELS[name].rests) for name in names),
            *(round(gap * self.rate_hz) for gap in self.longest_gap),
            *(int(name.startswith("wheel_speed") and bool(instant[i].any())) for i, name in enumerate(names)),
            *(NUMBERS[name] for name in names),
            *(names.index(relation.target) for relation in self.relations),
            *(place(relation.partner) for relation in self.relations),
        ]
        return PackedHealth(np.concatenate([np.ravel(part) for part in parts]).astype(np.float64), np.array(sizes, np.int64))


def health_rows(packed: PackedHealth, rows: FloatArray, measured: NDArray[np.bool_], state: FloatArray) -> Health:
    """Judge rows one after another; one at a time or all at once, to the same bits.

    Args:
        packed: of `HealthModel.packed`.
        rows: (T, C) as received; may hold anything where ``measured`` is false.
        measured: (T, C).
        state: of `HealthModel.start`, changed in place.
    """
    found = Health(np.empty(len(rows)), np.empty(len(rows)), np.empty(len(rows)))
    health_kernel(rows, measured, packed.numbers, packed.sizes, state, *found, _NO_STATISTICS)
    return found


_NO_STATISTICS = np.empty((0, 0))


def learn_health(
    train: Sequence[Recording], validation: Sequence[Recording], channels: Sequence[str], rate_hz: float
) -> HealthModel:
    """Learn what is normal.

    Args:
        train: at ``rate_hz``, from which relations, noise and domain are learnt.
        validation: at ``rate_hz``, which together with ``train`` set the limits.
        channels: that the estimator reads, in the order of the rows' columns.
        rate_hz: of the estimator [Hz].

    Raises:
        DataError: a channel is missing or there are too few samples.
    """
    names = tuple(channels)
    received = train
    train, validation = ([without_glitches(recording, names) for recording in part] for part in (train, validation))
    for recording in (*train, *validation):
        if abs(recording.rate_hz / rate_hz - 1.0) > 1e-9:
            raise DataError(f"recording '{recording.id}' is sampled at {recording.rate_hz:g} Hz, health is learnt at {rate_hz:g} Hz")
    joined = {name: np.concatenate([recording[name] for recording in train]) for name in names}
    speed = speed_channel(names)
    least_speed = least_speed_of(train, names)
    usable = [name for name in names if name in MODELLED or name.startswith("wheel_speed")]
    relations = learn_relations(train, usable, rate_hz, least_speed)
    order = max(1, min(MAX_ORDER, MOST_COEFFICIENTS // max(len(usable) ** 2, 1)))
    pieces = [residuals_of({name: recording[name] for name in usable}, usable, relations, least_speed) for recording in train]
    model = fit_autoregression(pieces, order)
    innovations = np.concatenate([model.innovations(piece) for piece in pieces])
    noise = learn_noise_levels(innovations, model.covariance, joined[speed] if speed else np.zeros(len(innovations)), N_LEVELS)
    levels = np.ones((N_LEVELS, len(names)))
    levels[:, [names.index(name) for name in usable]] = noise.factors
    constant, coefficients, precision, deviation = _embedded(model, names, usable)
    largest = [float(np.nanmax(np.abs(joined[name]), initial=0.0)) for name in names]
    turning = joined[speed] * joined["yaw_rate"] if speed and "yaw_rate" in names else np.zeros(1)
    found = HealthModel(
        channels=names,
        rate_hz=float(rate_hz),
        relations=tuple(relations),
        constant=constant,
        coefficients=coefficients,
        precision=precision,
        deviation=deviation,
        usual=tuple(float(np.nanmedian(joined[name])) if np.isfinite(joined[name]).any() else 0.0 for name in names),
        largest=tuple(largest),
        longest_gap=tuple(_longest_gap([part[name] for part in received], rate_hz) for name in names),
        standstill=(least_speed, _scale(joined, "yaw_rate", 0.05), _scale(joined, "ay", 0.5)),
        speeds=tuple(noise.speeds.tolist()),
        levels=_tuples(levels),
        healthy=((0.0,) * len(names),) * 3,
        heaviest=((1e300,) * len(names),) * 3,
        spin=(SPIN_MARGIN * dict(zip(names, largest, strict=True)).get("yaw_rate", 1e9), SPIN_MARGIN * float(np.nanmax(np.abs(turning)))),
    )
    return _with_limits(_with_healthy(_with_healthy(found, train), train), train, validation)


def _embedded(model, names, usable):  # type: ignore[no-untyped-def]
    places = [names.index(name) for name in usable]
    n = len(names)
    constant, coefficients, precision, deviation = np.zeros(n), np.zeros((model.order, n, n)), np.zeros((n, n)), np.ones(n)
    constant[places] = model.constant
    coefficients[np.ix_(range(model.order), places, places)] = model.coefficients
    precision[np.ix_(places, places)] = np.linalg.inv(model.covariance)
    deviation[places] = np.sqrt(np.diag(model.covariance))
    return tuple(constant.tolist()), _tuples(coefficients), _tuples(precision), tuple(deviation.tolist())


def _tuples(values):  # type: ignore[no-untyped-def]
    return tuple(_tuples(part) if part.ndim > 1 else tuple(part.tolist()) for part in values)


def _scale(joined: Mapping[str, FloatArray], name: str, usual: float) -> float:
    return min(usual, 0.1 * float(np.nanmax(np.abs(joined[name])))) if name in joined else usual


def _longest_gap(parts: Sequence[FloatArray], rate_hz: float) -> float:
    longest = 0
    for samples in parts:
        missing = np.concatenate([[0], np.isnan(samples).astype(np.int8), [0]])
        edges = np.flatnonzero(np.diff(missing))
        longest = max(longest, int((edges[1::2] - edges[::2]).max()) if len(edges) else 0)
    return longest / rate_hz


def _with_healthy(model: HealthModel, recordings: Sequence[Recording]) -> HealthModel:
    """With the offset, scale and delay that the likelihood ratios find over all of training, and `HEAVIEST` times their mean weight."""
    C, p, G = len(model.channels), len(model.coefficients), len(RATIO_SECONDS)
    packed = replace(model, limits=(), healthy=((0.0,) * C,) * 3).packed()
    at = packed.numbers.size - SETTINGS - model.n_statistics - len(RELATION_SECONDS) - G
    packed.numbers[at : at + G] = 0.0  # forgets nothing
    state, total = model.start(), np.zeros((C, 8))
    for recording in recordings:
        state[:] = model.start()
        rows = np.ascontiguousarray(recording.stack(model.channels))
        health_rows(packed, rows, np.isfinite(rows), state)
        first = MEMORY + 5 * C + 4 * p * C + C * len(ENERGY_SECONDS)
        total += state[first : first + C * G * 8].reshape(C, G, 8)[:, 0]
    found = total[:, 0:6:2] / np.maximum(total[:, 1:6:2], 1e-300)
    heaviest = HEAVIEST * total[:, 1:6:2] / sum(len(recording) for recording in recordings)
    return replace(model, healthy=_tuples(found.T), heaviest=_tuples(heaviest.T))


def block_maxima(model: HealthModel, recordings: Sequence[Recording]) -> FloatArray:
    """Largest value of each statistic in blocks of `BLOCK_SECONDS`, (B, K), while nothing limits any."""
    packed = replace(model, limits=()).packed()
    length, rows = max(round(BLOCK_SECONDS * model.rate_hz), 1), []
    for recording in recordings:
        state, samples = model.start(), np.ascontiguousarray(recording.stack(model.channels))
        for begin in range(0, len(samples), length):
            part = samples[begin : begin + length]
            outcome, statistics = np.empty((3, len(part))), np.empty((len(part), model.n_statistics))
            health_kernel(part, np.isfinite(part), *packed, state, *outcome, statistics)
            rows.append(statistics.max(0))
    return np.array(rows)


def _with_limits(model: HealthModel, train: Sequence[Recording], validation: Sequence[Recording]) -> HealthModel:
    return replace(model, limits=limits_from(block_maxima(model, [*train, *validation]), model))


def limits_from(maxima: FloatArray, model: HealthModel) -> tuple[float, ...]:
    C, e, g = len(model.channels), len(ENERGY_SECONDS), len(RATIO_SECONDS)
    kinds = np.concatenate([np.full(C, 0), np.full(2 * C * e, 1), np.full(3 * C * g, 0), np.full(C, 2), np.full(C, 3), np.full(C, 4), np.full(C, 5), np.full(2 * C, 0), np.full(len(model.relations) * len(RELATION_SECONDS), 1)])
    ordered = np.sort(maxima, axis=0)[::-1]
    top = ordered[0].copy()
    out = max(1, len(maxima) // 100) if len(maxima) > 30 else 0
    for k in range(out):
        apart = ordered[k] > 2.0 * ordered[k + 1]
        top = np.where(apart, ordered[k + 1], top)
    limits = MARGIN * top
    limits = np.where(kinds == 0, np.maximum(limits, LEAST_Z), limits)
    limits = np.where(kinds == 2, np.maximum(1.5 * top + 2.0, 4.0), limits)
    limits = np.where(kinds == 3, np.minimum(np.maximum(top + 0.15, 0.3), 0.5 + 0.5 * np.minimum(top, 1.0)+1e-3), limits)
    limits = np.where(kinds == 4, DOMAIN_MARGIN, limits)
    limits = np.where(kinds == 5, np.maximum(limits, 0.3), limits)
    limits = np.where(limits > 0, limits, math.inf)
    return tuple(limits.tolist())
