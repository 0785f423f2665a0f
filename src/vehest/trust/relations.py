"""Relations between the measured channels of a car.

Their coefficients are fitted to drives without any reference.

With yaw rate r, speed u (measured, or that of the motor or a wheel) and a = u r:

    lateral         ay = k u r + c
    steering        δ = c₁ r/u + c₂ u r + c₃ (u r)³ + c,  or  δ = c₁ ay/u² + c₂ ay + c₃ ay³ + c
    longitudinal    ax = k du/dt - v r + c₁ r² + c₂ u² + c
    wheels, motor   ω = u/R + c r

The residual of the lateral relation is the change of v, which returns to zero, and bank. The terms
of steering are wheelbase, understeer gradient and tyres that give way. In the longitudinal one, u²
is drag, and v the residual of the lateral one, integrated with leakage: its changes, as in a slide;
the rest of v goes with r. Wheels and motor have the radius and half the track.

Coefficients are those of least squares on signals that are low-passed alike, reweighted by Huber's
function.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import scipy

from vehest.constants import FloatArray
from vehest.data.errors import DataError
from vehest.data.recording import Recording
from vehest.trust.checks import check_shape
from vehest.trust.health_kernel import INSTANT_FEATURES, SLIDE_SECONDS

SPEEDS = (
    "vx",
    "motor_speed",
    "wheel_speed_rl",
    "wheel_speed_rr",
    "wheel_speed_fl",
    "wheel_speed_fr",
)
"""Channels that can serve as the speed u; the first that is there does."""

# names of the terms of relations
FEATURES = (
    "1",
    "r",
    "u",
    "u r",
    "(u r)³/100",
    "r/u",
    "ay",
    "ay/u²",
    "ay³/100",
    "r²",
    "u²",
    "ax",
    "v r",
)
RATE = "du/dt"  # term that is a rate of change, and no feature of one sample
SIDESLIP_DRAG = "v r"  # feature: ax by the lateral velocity in a turn
DRAG = ("r²", "u²", SIDESLIP_DRAG)  # small features of ax, which say nothing of its sign and unit
# term -> symbols of the quantities in it
_SYMBOLS = {name: re.findall("[ru]|ay|ax", name) for name in FEATURES} | {RATE: ["u"]}

LOW_PASS_SECONDS = 0.5  # s, time constant of the low-pass of both sides of a relation
HUBER = 1.5  # robust standard deviations, beyond which a residual weighs less
MIN_SPEED_SHARE = 0.1  # speed over the median speed below which angles say little
MIN_ROWS = 50  # samples; with fewer a relation is left out, and glitches are not looked for


@dataclass(frozen=True)
class Relation:
    """One channel, the target, as a sum of features of other channels: target = Σ coefficient ·
    feature.
    """

    target: str  # channel that is explained
    partner: str  # channel that is named as the other side in messages
    # feature, or `RATE`, -> coefficient; the target's units over the feature's
    terms: dict[str, float] = field(default_factory=dict)
    instant: bool = False  # whether the relation holds for each sample, not only on average

    def __post_init__(self) -> None:
        """Raise `DataError` for a term that is unknown, or not available at each instant."""
        usable = (*(FEATURES[:INSTANT_FEATURES] if self.instant else FEATURES), RATE)
        for name, coefficient in self.terms.items():
            if name not in usable:
                raise DataError(f"terms: '{name[:40]}' is not one of: {', '.join(usable)}")
            check_shape(f"terms.{name}", coefficient)

    def involves(self, channel: str, speed: str | None) -> int:
        """1 if the relation has a channel, 2 if only in the small terms of drag, 0 if not at all.

        ``speed`` is the channel that is used as u.
        """
        if channel in (self.target, self.partner):
            return 1
        symbol = {"yaw_rate": "r", "ay": "ay", "ax": "ax", speed: "u"}.get(channel)
        if symbol is None:
            return 0
        large, small = (
            {part for name in self.terms if (name in DRAG) == drag for part in _SYMBOLS[name]}
            for drag in (False, True)
        )
        return 1 if symbol in large else 2 if symbol in small else 0


def speed_channel(channels: Sequence[str]) -> str | None:
    """The channel that serves as the speed u (`SPEEDS`); None if there is none."""
    return next((name for name in SPEEDS if name in channels), None)


def relations_among(channels: Sequence[str]) -> list[tuple[str, str, tuple[str, ...], bool]]:
    """Every relation that channels allow, before its coefficients are fitted: target, partner,
    features, whether it holds at each instant.
    """
    speed = speed_channel(channels)
    has = set(channels)
    declared: list[tuple[str, str, tuple[str, ...], bool]] = []
    if speed is None:
        return declared
    if {"ay", "yaw_rate"} <= has:
        declared.append(("ay", "yaw_rate", ("u r", "1"), True))
    for angle in ("steer", "handwheel"):
        if angle in has and "yaw_rate" in has:
            declared.append((angle, "yaw_rate", ("r/u", "u r", "(u r)³/100", "1"), True))
        if angle in has and "ay" in has:
            declared.append((angle, "ay", ("ay/u²", "ay", "ay³/100", "1"), False))
    turning = ("r²", "r") if "yaw_rate" in has else ()
    if "ax" in has:
        slide = (SIDESLIP_DRAG,) if {"ay", "yaw_rate"} <= has else ()
        declared.append(("ax", speed, (RATE, *slide, *turning[:1], "u²", "1"), False))
    for wheel in channels:
        if wheel.startswith(("wheel_speed", "motor_speed")) and wheel != speed:
            declared.append((wheel, speed, ("u", *turning[1:]), True))
    return declared


def features_of(samples: Mapping[str, FloatArray], least_speed: float) -> dict[str, FloatArray]:
    """Compute the features of relations from channels as they are measured.

    A channel that is not there counts as zeros; without a speed, ``r/u`` and ``ay/u²`` divide by
    ``least_speed``.

    Parameters
    ----------
    samples : mapping
        Channel -> (T,) [SI], at least one.
    least_speed : float
        Smallest |u| that divides [unit of the speed channel].

    Returns
    -------
    dict
        Feature -> (T,), for all `FEATURES` but ``v r``, which needs a relation (`slide_of`).
    """
    any_samples = next(iter(samples.values()))
    speed = speed_channel(list(samples))
    r, ay, ax = (samples.get(name, np.zeros_like(any_samples)) for name in ("yaw_rate", "ay", "ax"))
    u = samples[speed] if speed else np.zeros_like(any_samples)
    w = np.maximum(np.abs(u), least_speed)
    values = (
        np.ones_like(any_samples),
        r,
        u,
        u * r,
        0.01 * (u * r) ** 3,
        r / w,
        ay,
        ay / w**2,
        0.01 * ay**3,
        r * r,
        u * u,
        ax,
    )
    return dict(zip(FEATURES[:-1], values, strict=True))


def slide_of(features: Mapping[str, FloatArray], lateral: Relation, rate_hz: float) -> FloatArray:
    """The feature ``v r``, (T,): lateral velocity times yaw rate.

    v is the residual of the relation of ay, integrated with the leakage of `SLIDE_SECONDS`, and at
    most the speed in size.

    Parameters
    ----------
    features : mapping
        As of `features_of`, (T,).
    lateral : Relation
        Of ay against the yaw rate.
    rate_hz : float
        Sampling rate [Hz].
    """
    left = features["ay"] - sum(value * features[name] for name, value in lateral.terms.items())
    drift = scipy.signal.lfilter(
        [1.0 / rate_hz], [1.0, 1.0 / (SLIDE_SECONDS * rate_hz) - 1.0], left
    )
    return np.asarray(np.clip(drift, -np.abs(features["u"]), np.abs(features["u"])) * features["r"])


def without_spikes(samples: FloatArray) -> FloatArray:
    """Replace glitches of single samples by NaN; the array is a copy.

    The deviation of a glitch from the mean of its neighbours exceeds ten times the 99.9 % quantile
    of all such deviations, and the neighbours differ from each other by less than half of it.
    """
    if len(samples) < MIN_ROWS:
        return samples
    deviation = np.abs(samples[1:-1] - 0.5 * (samples[:-2] + samples[2:]))
    finite_deviation = deviation[np.isfinite(deviation)]
    if not len(finite_deviation):
        return samples
    alone = deviation > 10.0 * max(float(np.quantile(finite_deviation, 0.999)), 1e-12)
    back = np.abs(samples[2:] - samples[:-2]) < 0.5 * deviation
    clean = np.array(samples)
    clean[1:-1][alone & back] = np.nan
    return clean


def without_glitches(recording: Recording, channels: Sequence[str]) -> Recording:
    """The drive with ``channels`` alone, NaN where a single sample is a glitch."""
    selected = recording.select(channels)
    clean = {name: without_spikes(samples) for name, samples in selected.channels.items()}
    return replace(
        selected,
        channels=clean,
        gappy=frozenset(name for name in channels if np.isnan(clean[name]).any()),
    )


def least_speed_of(recordings: Sequence[Recording], channels: Sequence[str]) -> float:
    """Smallest speed [unit of the speed channel] at which relations are fitted and by which angles
    are divided: `MIN_SPEED_SHARE` of the median speed; 1 without a speed channel.
    """
    speed = speed_channel(channels)
    if speed is None:
        return 1.0
    speeds = np.abs(np.concatenate([recording[speed] for recording in recordings]))
    return max(MIN_SPEED_SHARE * float(np.nanmedian(speeds)), 1e-6)


def residuals_of(
    samples: Mapping[str, FloatArray],
    channels: Sequence[str],
    relations: Sequence[Relation],
    least_speed: float,
) -> FloatArray:
    """y = x - W φ(x), (T, C): channels minus what the relations that hold at each instant explain
    of them, which the autoregression of health then predicts.
    """
    features = features_of(samples, least_speed)
    left = {name: np.array(samples[name], dtype=np.float64) for name in channels}
    for relation in relations:
        if relation.instant:
            left[relation.target] -= sum(
                value * features[feature] for feature, value in relation.terms.items()
            )
    return np.stack([left[name] for name in channels], axis=1)


def learn_relations(
    recordings: Sequence[Recording], channels: Sequence[str], rate_hz: float, least_speed: float
) -> list[Relation]:
    """Fit the coefficients of every relation among channels to drives.

    Samples with NaN and samples below ``least_speed`` are left out.

    Both sides are low-passed by the same filter of `LOW_PASS_SECONDS` before the fit. The
    coefficient of v r is -1 by kinematics and not fitted. A relation with fewer than `MIN_ROWS`
    samples is left out.

    Parameters
    ----------
    recordings : sequence of Recording
        Healthy drives with all ``channels``.
    channels : sequence of str
        Channels among which relations are looked for.
    rate_hz : float
        Sampling rate of all recordings [Hz].
    least_speed : float
        See `least_speed_of`.
    """
    forget = 1.0 - np.exp(-1.0 / (LOW_PASS_SECONDS * rate_hz))
    speed = speed_channel(channels)
    parts = []
    usable_rows = []
    for recording in recordings:
        filled = {name: _fill_gaps(recording[name]) for name in channels}
        is_usable = np.isfinite(recording.stack(channels)).all(1)
        columns = {
            **features_of(filled, least_speed),
            **{f"channel {name}": filled[name] for name in channels},
        }
        if speed:
            is_usable &= np.abs(filled[speed]) >= least_speed
            columns[RATE] = np.concatenate([[0.0], np.diff(filled[speed])]) * rate_hz
        parts.append(columns)
        usable_rows.append(is_usable)

    def smoothed(name: str) -> FloatArray:
        """A column of all recordings, low-passed within each, at the usable samples, (N,)."""
        low_pass = partial(scipy.signal.lfilter, [forget], [1.0, forget - 1.0])
        return np.concatenate(
            [
                low_pass(part[name], zi=[(1.0 - forget) * part[name][0]])[0][is_usable]
                for part, is_usable in zip(parts, usable_rows, strict=True)
            ]
        )

    joined = {name: smoothed(name) for name in parts[0]}
    relations: list[Relation] = []
    for target, partner, features, instant in relations_among(channels):
        if SIDESLIP_DRAG in features:
            for part in parts:
                part[SIDESLIP_DRAG] = (
                    slide_of(part, relations[0], rate_hz) if relations else np.zeros_like(part["r"])
                )
            joined[SIDESLIP_DRAG] = smoothed(SIDESLIP_DRAG)
        free = [name for name in features if name != SIDESLIP_DRAG]
        target_values = joined[f"channel {target}"] + (
            joined[SIDESLIP_DRAG] if SIDESLIP_DRAG in features else 0.0
        )
        if len(target_values) >= MIN_ROWS:
            design = np.stack([joined[name] for name in free], axis=1)
            terms = dict(zip(free, _robust(design, target_values).tolist(), strict=True))
            if SIDESLIP_DRAG in features:
                terms[SIDESLIP_DRAG] = -1.0
            relations.append(Relation(target, partner, terms, instant))
    return relations


def _fill_gaps(samples: FloatArray) -> FloatArray:
    """A copy in which the last finite value replaces NaN, and the first one does at the start;
    zeros where no value is finite.
    """
    finite_places = np.flatnonzero(np.isfinite(samples))
    if not len(finite_places):
        return np.zeros_like(samples)
    place = np.maximum(np.searchsorted(finite_places, np.arange(len(samples)), side="right") - 1, 0)
    return samples[finite_places[place]]


def _robust(design: FloatArray, target: FloatArray) -> FloatArray:
    """Least squares, reweighted ten times by Huber's function of residual over median size.

    Columns are scaled to a root mean square of 1, and a ridge of 1e-9 keeps the equations regular.

    Parameters
    ----------
    design : array
        (N, K).
    target : array
        (N,).

    Returns
    -------
    array
        Coefficients, (K,).
    """
    size = np.maximum(np.sqrt(np.mean(np.square(design), axis=0)), 1e-300)
    scaled = design / size
    weight = np.ones(len(target))
    coefficients = np.zeros(design.shape[1])
    for _ in range(10):
        gram = (scaled * weight[:, None]).T @ scaled + 1e-9 * len(target) * np.eye(design.shape[1])
        coefficients = np.linalg.solve(gram, (scaled * weight[:, None]).T @ target)
        residual = np.abs(target - scaled @ coefficients)
        bound = HUBER * max(1.4826 * float(np.median(residual)), 1e-12)
        weight = np.minimum(1.0, bound / np.maximum(residual, 1e-300))
    return coefficients / size
