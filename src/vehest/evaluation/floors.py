"""Noise floor of a drive's reference, and Cramér-Rao bound of v for a set of inputs along the
drive.

    spans, protocol --drives_of--> drives --reference_floor, cramer_rao_floor--> `Floor`

Errors are compared with both, to separate a poor estimator from a drive that contains little
information. Both rest on models, and are no exact limits.

**Noise of the reference** (`reference_floor`). White noise of standard deviation σ has third
differences of variance 20 σ². What the inertial signals explain of those of v, the second
differences of a_y and of u ω, is taken out by least squares. The rest is measured by the median of
its size, so that kerbs and jumps do not count. Not seen are errors that are slow (an offset, a
lever arm), that smoothing of the reference hid, or that it shares with the inertial signals: a
lower bound. A reference in coarse steps errs by at least step/√12.

**Cramér-Rao bound** (`cramer_rao_floor`). No causal estimator has a mean squared error below the
posterior bound (Tichavský, Muravchik & Nehorai, Posterior Cramér-Rao bounds for discrete-time
nonlinear filtering, IEEE Trans. Signal Processing 46 (5), 1998), which is taken of a model whose
states and noise are drawn at random and whose parameters are known. For a linear model with
Gaussian noise its recursion is that of the Kalman filter's covariance. The model, with yaw rate ω
and speed u as measured:

    v is a Gauss-Markov process with the spread and correlation time of the drive's v
    (always) dv/dt = a_y - u ω - b - n          b slow (bank, roll, offset), n white
    (where a_y is read) du/dt = a_x + v ω + c + m          c slow, m white; u is measured with white
    noise          (where a_x is read) v = l_r ω - (1 + s_r) u α_r + e_r,         α = k₁ a + k₂
    dω/dt + k₃ a³                      (rear axle, if the car is known) v = (δ - δ₀) u - l_f ω - (1
    + s_f) u α_f + e_f                                              (front axle, where steer is read
    too)

The axles are the balances of forces of the single track, each with the load and inertia that belong
to it (J = m l_f l_r) and a tyre that gives way with the third power; a is a_y where it is read,
else u ω.

Unknown to the bound are v, u, b, c, the errors e of the axles (a Gauss-Markov process and white
noise), and the stiffness of the tyres, of which a data sheet says no more than 6 to 15 per rad: s
has a standard deviation of 23 %. Known are arms, shape of the tyre, offset of the steering angle
and all levels of noise, read off the test drive and its reference for the bound's own use: mostly
more than an estimator knows. An error below the bound says that an estimator knows more of the car
still, and an error above it what it leaves unused.

Without the car (``car=False``) the axles are left out: what kinematics alone tells of a car of
which nothing is known.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from vehest.alignment.motion import rms
from vehest.constants import FloatArray
from vehest.data.derived import derivative
from vehest.data.recording import Recording
from vehest.data.runs import filled
from vehest.data.splits import Span
from vehest.evaluation.metrics import (
    BoolArray,
    Protocol,
    is_fast_enough,
    pieces_of,
    scored_range,
)
from vehest.filters.gaussian import Gaussian
from vehest.filters.kalman import LinearModel
from vehest.filters.kalman_scan import kalman_scan

# channels that a bound knows what to make of; the first two are needed
INPUTS = ("vx", "yaw_rate", "ay", "ax", "steer")
SETS = (
    ("vx", "yaw_rate"),
    ("vx", "yaw_rate", "ay"),
    ("vx", "yaw_rate", "ay", "ax"),
    ("vx", "yaw_rate", "steer"),
    ("vx", "yaw_rate", "ay", "steer"),
    ("vx", "yaw_rate", "ay", "ax", "steer"),
)
"""Sets of inputs whose bounds reports compare."""

# 0.23: 6 to 15 per rad as four standard deviations (Milliken & Milliken 1995)
STIFFNESS_DEVIATION = math.log(15.0 / 6.0) / 4.0
BLOCK_SECONDS = 1.0  # s over which residuals are averaged to separate slow from white noise
SLOW_SECONDS = (2.0, 100.0)  # s, shortest and longest time constant of slow noise
MIN_SAMPLES = 20  # samples of all drives together; with fewer there is no floor
# smallest variance of an axle's white error over that of its slow error, so that no axle is exact
MIN_WHITE_SHARE = 0.01
SAMPLES_TOGETHER = 20_000  # samples whose matrices are in memory at once
UNIFORM_ANGLE_DEVIATION = 180.0 / math.sqrt(3.0)  # deg, of an angle of which nothing is known
MIN_POSITIVE = 1e-9  # least standard deviation of a noise or squared speed, so that none is 0

_SPEEDS = ("motor_speed", "wheel_speed_")  # prefixes of channels that count as the speed
# thrust and brakes say nothing of v that the speed does not
_SILENT = ("motor_current", "wheel_torque_", "brake_pressure_")


@dataclass(frozen=True)
class Floor:
    """Noise floor or Cramér-Rao bound as a root mean square over the scored samples of a test
    set.
    """

    vy: float  # floor of the error of lateral velocity [m/s]
    # floor of the error of the sideslip angle, where it is scored [deg]; NaN where it is at no
    # sample
    sideslip: float


@dataclass(frozen=True, eq=False)
class Drive:
    """A range or sequence of a test set, from where estimators may start, at the evaluation rate;
    arrays are of shape (T,).
    """

    rate_hz: float  # [Hz]
    # those of `INPUTS` that were measured, gaps filled by straight lines [SI]
    inputs: dict[str, FloatArray]
    vy_ref: FloatArray  # reference lateral velocity [m/s]; may be NaN before the scored samples
    first: int  # index of the first scored sample; all after it are scored
    # whether estimators start from the reference at the first sample
    starts_at_reference: bool = False
    min_sideslip_speed: float = 0.0  # speed from which on sideslip is scored [m/s]

    @property
    def step(self) -> float:
        """Sampling time [s]."""
        return 1.0 / self.rate_hz

    @property
    def scored(self) -> Drive:
        """The scored samples alone."""
        inputs = {name: samples[self.first :] for name, samples in self.inputs.items()}
        return replace(self, inputs=inputs, vy_ref=self.vy_ref[self.first :], first=0)

    @property
    def is_sideslip_scored(self) -> BoolArray:
        """Mask (T,) of the samples at which the car is fast enough that sideslip is scored."""
        return is_fast_enough(self.inputs["vx"], self.vy_ref, self.min_sideslip_speed)


def drives_of(
    spans: Sequence[Span], recording_of: Callable[[Span], Recording], protocol: Protocol
) -> list[Drive]:
    """The drives of a test set, one for each range or sequence in the order of `score_all`, for the
    floors.
    """
    return [
        drive_of(reference, piece, protocol)
        for reference, piece in pieces_of(spans, recording_of, protocol)
    ]


def drive_of(reference: Recording, span: Span, protocol: Protocol) -> Drive:
    """One range or sequence of a recording, with the warm-up before it.

    Parameters
    ----------
    reference : Recording
        The whole recording, at the evaluation rate.
    span : Span
        The range; samples of the warm-up are those before it, as far as there are any.
    protocol : Protocol
        Warm-up, first samples that are not scored, and lowest speed.
    """
    begin = reference.index_range(span.start - protocol.warm_up_seconds, span.stop)[0]
    first, end = scored_range(reference, span, protocol)
    inputs = {name: filled(reference[name][begin:end]) for name in INPUTS if name in reference}
    return Drive(
        reference.rate_hz,
        inputs,
        reference["vy_ref"][begin:end],
        first - begin,
        protocol.initial_state,
        protocol.min_sideslip_speed_on(span.dataset),
    )


def inputs_of(channels: Collection[str]) -> frozenset[str] | None:
    """The inputs of the bound for an estimator that reads these channels; None where no bound
    suits.

    Wheels and motor stand for the speed, the angle of the steering wheel for that of the road
    wheels. Measured tyre forces and other channels tell what the bound does not know; without yaw
    rate there is none.
    """
    inputs = set()
    for name in channels:
        if name in INPUTS:
            inputs.add(name)
        elif name.startswith(_SPEEDS):
            inputs.add("vx")
        elif name == "handwheel":
            inputs.add("steer")
        elif not name.startswith(_SILENT):
            return None
    return frozenset(inputs) if {"vx", "yaw_rate"} <= inputs else None


def reference_spread(drives: Sequence[Drive]) -> Floor:
    """Root mean square of the reference itself, which is the error of the zero-sideslip baseline;
    the sideslip is atan2(v, |u|), within a quarter turn also in reverse.
    """
    velocity, speed = _joined(drives)
    sideslip = np.degrees(np.arctan2(velocity, np.abs(speed)))
    return Floor(_rms([velocity]), _rms([sideslip[_is_sideslip_scored(drives)]]))


# Noise of the reference


def reference_floor(drives: Sequence[Drive]) -> Floor | None:
    """Standard deviation of the white noise of the reference at the evaluation rate; None where
    there are too few samples.

    That of the sideslip is that of v times |∂β/∂v| = u/(u² + v²), at most that of an angle of which
    nothing is known.

    Parameters
    ----------
    drives : sequence of Drive
        Drives of a test set, of which the scored samples count; their third differences, less what
        measured lateral acceleration and yaw rate explain, show the noise.

    Returns
    -------
    Floor or None
        Deviations of v [m/s] and of the sideslip [deg] at samples at which it is scored.
    """
    third = []
    explained = []
    shared_inputs = {
        name for name in ("ay", "yaw_rate") if all(name in drive.inputs for drive in drives)
    }
    for drive in (drive.scored for drive in drives):
        if len(drive.vy_ref) < 4:
            continue
        inputs = drive.inputs
        parts = ([inputs["ay"]] if "ay" in shared_inputs else []) + (
            [inputs["vx"] * inputs["yaw_rate"]] if "yaw_rate" in shared_inputs else []
        )
        third.append(np.diff(drive.vy_ref, 3))
        explained.append(
            np.stack([np.diff(_middle(part), 2) for part in parts], 1)
            if parts
            else np.empty((len(third[-1]), 0))
        )
    if sum(map(len, third)) < MIN_SAMPLES:
        return None
    residuals = np.concatenate(third)
    regressors = np.concatenate(explained)
    if regressors.shape[1]:
        residuals = residuals - regressors @ np.linalg.lstsq(regressors, residuals, rcond=None)[0]
    velocity, speed = _joined(drives)
    level = max(
        _robust_deviation(residuals) / math.sqrt(20.0),
        quantisation_step(velocity) / math.sqrt(12.0),
    )
    sideslip = _sideslip_deviation(np.full_like(velocity, level), velocity, speed)
    return Floor(level, _rms([sideslip[_is_sideslip_scored(drives)]]))


def white_level(series: Sequence[FloatArray]) -> float:
    """Standard deviation of the white noise of a smooth signal, in its unit, from the third
    differences of its uninterrupted segments, (T,) each; at least the quantisation step over √12,
    and 0 if all segments are too short.
    """
    third = [np.diff(samples, 3) for samples in series if len(samples) >= 4]
    noise = _robust_deviation(np.concatenate(third)) / math.sqrt(20.0) if third else 0.0
    return max(noise, quantisation_step(np.concatenate(series)) / math.sqrt(12.0))


def quantisation_step(samples: FloatArray) -> float:
    """Step of a signal whose values are multiples of one step, in its unit; 0 where fewer than half
    of the values occur twice, or there is no common step.
    """
    values = np.unique(samples)
    if len(values) < 2 or len(values) > len(samples) // 2:
        return 0.0
    steps = np.diff(values)
    step = float(steps.min())
    return step if np.all(np.abs(steps / step - np.round(steps / step)) < 0.01) else 0.0


def _robust_deviation(samples: FloatArray) -> float:
    """Standard deviation of the zero-mean normal distribution with the samples' median absolute
    value.
    """
    return float(np.median(np.abs(samples))) / 0.6744897501960817


# The bound


class Noise(NamedTuple):
    """A disturbance as the sum of white noise and a slow Gauss-Markov process."""

    # density of its white part [unit²/Hz], two-sided: the variance of a mean over T is density/T
    density: float
    deviation: float  # standard deviation of its slow part, a Gauss-Markov process [unit]
    time_constant: float  # time constant of the slow part [s]


class Axle(NamedTuple):
    """The force balance of an axle as a measurement of v, fitted to a test set."""

    coefficients: FloatArray  # coefficients of the columns of `_axle_columns`, (4,) or (5,)
    error: Noise  # v - what the balance gives [m/s]


@dataclass(frozen=True, eq=False)
class _Levels:
    """Levels of noise and models that a bound takes as known, from all drives of a test set."""

    velocity: Noise  # v itself, without a white part [m/s]
    lateral: Noise | None  # error of dv/dt by ay [m/s²]; None where ay is not read
    longitudinal: Noise | None  # error of du/dt by ax [m/s²]; None where ax is not read
    speed: float  # standard deviation of the measured u [m/s]
    reference: float  # standard deviation of the reference of v [m/s]
    rear: Axle | None  # rear axle; None where the car is not known
    front: Axle | None  # front axle; None where the car is not known or steer is not read


def cramer_rao_floor(
    drives: Sequence[Drive], inputs: Collection[str], *, car: bool = True
) -> Floor | None:
    """Root mean square of the posterior Cramér-Rao bound of causal estimators over the scored
    samples.

    Parameters
    ----------
    drives : Sequence[Drive]
        Drives of a test set (`drives_of`), from which the levels of noise are taken as well.
    inputs : Collection[str]
        Some of `INPUTS`, ``vx`` and ``yaw_rate`` among them.
    car : bool, default True
        Whether the car is known as well as by a data sheet; else only kinematics is used.

    Returns
    -------
    Floor | None
        None where an input was not measured, or there are too few samples.

    Raises
    ------
    ValueError
        ``vx`` or ``yaw_rate`` is not among the inputs, or an input is none of `INPUTS`.
    """
    if not {"vx", "yaw_rate"} <= set(inputs) <= set(INPUTS):
        raise ValueError(
            f"inputs of a bound are vx, yaw_rate and some of {', '.join(INPUTS[2:])}, not "
            f"{', '.join(sorted(inputs))}"
        )
    if (
        not all(set(inputs) <= set(drive.inputs) for drive in drives)
        or sum(len(drive.scored.vy_ref) for drive in drives) < MIN_SAMPLES
    ):
        return None
    levels = _levels(drives, set(inputs), car)
    velocity, speed = _joined(drives)
    deviation = np.concatenate(
        [_deviation_along(drive, set(inputs), levels)[drive.first :] for drive in drives]
    )
    sideslip = _sideslip_deviation(deviation, velocity, speed)
    return Floor(_rms([deviation]), _rms([sideslip[_is_sideslip_scored(drives)]]))


def posterior_bound(model: LinearModel[FloatArray], prior: FloatArray) -> FloatArray:
    """Smallest covariance of any causal estimate of the state of a linear model with Gaussian
    noise, (T, n, n).

    Parameters
    ----------
    model : LinearModel[FloatArray]
        See `LinearModel`, observation (T, m, n); covariances do not depend on its offsets.
    prior : FloatArray
        Covariance of the state at the first sample before its measurement, (n, n).

    Source: Tichavský, Muravchik & Nehorai 1998, whose recursion is then the Riccati recursion of
    the Kalman filter.
    """
    steps, m, n = model.observation.shape
    initial = Gaussian(np.zeros(n), prior)
    return kalman_scan(model, np.zeros((steps, m)), initial).filtered.covariance


def split_noise(series: Sequence[FloatArray], rate_hz: float) -> Noise:
    """Split a disturbance into white noise and a slow Gauss-Markov process, by the covariances of
    its means over seconds.

    Means of the slow part over τ = 1 s have the covariance d² 2(cosh x - 1)/x² e^(-kx) at a lag of
    k > 0 seconds, x = τ/T, and d² 2(x - 1 + e^(-x))/x² at none, where white noise adds its density
    over τ. Lags of one and two seconds give d and T. The mean counts as part of the disturbance,
    and white noise has no more than the variance that the slow part leaves.

    Parameters
    ----------
    series : Sequence[FloatArray]
        Uninterrupted segments of the disturbance, (T,) each.
    rate_hz : float
        Sampling rate [Hz].
    """
    block = max(round(BLOCK_SECONDS * rate_hz), 1)
    means = [
        samples[: len(samples) // block * block].reshape(-1, block).mean(1) for samples in series
    ]
    products = [
        [mean[lag:] * mean[: len(mean) - lag] for mean in means if len(mean) > lag]
        for lag in range(3)
    ]
    lags = [float(np.concatenate(parts).mean()) if parts else 0.0 for parts in products]
    variance = _rms(series) ** 2
    if not min(lags[:2]) > 0:
        return Noise(
            min(max(lags[0], 0.0) * BLOCK_SECONDS, variance / rate_hz), 0.0, SLOW_SECONDS[0]
        )
    low, high = (math.exp(-BLOCK_SECONDS / time) for time in SLOW_SECONDS)
    ratio = min(max(lags[2] / lags[1], low), high)
    x = -math.log(ratio)
    lagged_factor = 2.0 * (math.cosh(x) - 1.0) / x**2
    same_factor = 2.0 * (x - 1.0 + ratio) / x**2
    slow = min(lags[1] / (ratio * lagged_factor), lags[0] / same_factor)
    white = min((lags[0] - slow * same_factor) * BLOCK_SECONDS, max(variance - slow, 0.0) / rate_hz)
    return Noise(max(white, 0.0), math.sqrt(slow), BLOCK_SECONDS / x)


def gauss_markov(series: Sequence[FloatArray], rate_hz: float) -> Noise:
    """Fit a Gauss-Markov process: its root mean square, and the time in which its autocorrelation
    falls to 1/e.

    Parameters
    ----------
    series : sequence of FloatArray
        Samples of uninterrupted segments, (T,) each, in any unit.
    rate_hz : float
        Sampling rate [Hz].

    Returns
    -------
    Noise
        Without a white part; its time constant is one interval at least, and at most the length of
        the longest segment [s].
    """
    deviation = _rms(series)
    longest = max(len(samples) for samples in series)
    total = np.zeros(longest)
    for samples in series:
        spectrum = np.fft.rfft(samples, 2 * len(samples))
        total[: len(samples)] += np.fft.irfft(np.square(np.abs(spectrum)), 2 * len(samples))[
            : len(samples)
        ]
    below = np.flatnonzero(total < total[0] / math.e)
    lags = int(below[0]) if len(below) else longest
    return Noise(0.0, max(deviation, MIN_POSITIVE), max(lags, 1) / rate_hz)


def _levels(drives: Sequence[Drive], inputs: set[str], car: bool) -> _Levels:
    """Levels of noise of all drives together: of v, the reference, the sensors among ``inputs``
    and, with ``car``, the axles.
    """
    parts = [drive.scored for drive in drives]
    rate = drives[0].rate_hz
    lateral = longitudinal = rear = front = None
    if "ay" in inputs:
        balances = [
            (
                drive.vy_ref,
                drive.inputs["ay"] - drive.inputs["vx"] * drive.inputs["yaw_rate"],
                drive.inputs["ay"],
            )
            for drive in parts
        ]
        lateral = split_noise(_unexplained(balances, rate), rate)
    if "ax" in inputs:
        balances = [
            (
                drive.inputs["vx"],
                drive.inputs["ax"] + drive.vy_ref * drive.inputs["yaw_rate"],
                drive.inputs["ax"],
            )
            for drive in parts
        ]
        longitudinal = split_noise(_unexplained(balances, rate), rate)
    if car:
        rear = _fitted_axle(parts, inputs, False)
        front = _fitted_axle(parts, inputs, True) if "steer" in inputs else None
    reference = reference_floor(drives)
    return _Levels(
        velocity=gauss_markov([drive.vy_ref for drive in parts], rate),
        lateral=lateral,
        longitudinal=longitudinal,
        speed=max(white_level([drive.inputs["vx"] for drive in parts]), MIN_POSITIVE),
        reference=reference.vy if reference is not None else 0.0,
        rear=rear,
        front=front,
    )


def _unexplained(
    series: Sequence[tuple[FloatArray, FloatArray, FloatArray]], rate_hz: float
) -> list[FloatArray]:
    """Rate of change of a velocity less an expected rate [m/s²], without the part proportional to a
    sensor; an array (T - 1,) for each triple (velocity, expected rate, sensor) in ``series``.

    That part is the sensor's scale error; roll and pitch of the body have the same effect.
    """
    residuals = [np.diff(velocity) * rate_hz - _middle(rate) for velocity, rate, _ in series]
    sensor = [_middle(samples) for *_, samples in series]
    power = sum(float(samples @ samples) for samples in sensor)
    scale = (
        sum(float(residual @ samples) for residual, samples in zip(residuals, sensor, strict=True))
        / power
        if power > 0
        else 0.0
    )
    return [residual - scale * samples for residual, samples in zip(residuals, sensor, strict=True)]


def _fitted_axle(parts: Sequence[Drive], inputs: set[str], front: bool) -> Axle:
    """Fit the balance of one axle by least squares over all drives, and the noise of its residuals.

    The target is the lateral velocity at the centre of gravity [m/s], for the front axle less that
    of the wheels' heading, δ u.
    """
    columns = [
        _axle_columns(drive, inputs, front) for drive in parts
    ]  # slip and arm make up v, or v - δ u
    targets = [
        drive.vy_ref - drive.inputs["steer"] * drive.inputs["vx"] if front else drive.vy_ref
        for drive in parts
    ]
    coefficients = np.linalg.lstsq(np.concatenate(columns), np.concatenate(targets), rcond=None)[0]
    residuals = [
        target - column @ coefficients for target, column in zip(targets, columns, strict=True)
    ]
    return Axle(coefficients, split_noise(residuals, parts[0].rate_hz))


def _axle_columns(drive: Drive, inputs: set[str], front: bool) -> FloatArray:
    """Regressors of v in the balance of an axle, (T, 4) or, in front, (T, 5): ω (lever arm), u a, u
    dω/dt and u a³ (slip angle), and u (offset of the steering angle).
    """
    u = drive.inputs["vx"]
    yaw_rate = drive.inputs["yaw_rate"]
    a = drive.inputs["ay"] if "ay" in inputs else u * yaw_rate
    change = derivative(yaw_rate, drive.rate_hz)
    return np.stack([yaw_rate, u * a, u * change, u * a**3, *([u] if front else [])], 1)


def _deviation_along(drive: Drive, inputs: set[str], levels: _Levels) -> FloatArray:
    """Square root of the bound of v's mean squared error along a drive, (T,) [m/s]."""
    model, prior = _model_of(drive, inputs, levels)
    deviation = np.empty(len(drive.vy_ref))
    for begin in range(0, len(deviation), SAMPLES_TOGETHER):
        part = slice(begin, begin + SAMPLES_TOGETHER)
        part_model = model._replace(
            transition=model.transition[part], observation=model.observation[part]
        )
        covariance = posterior_bound(part_model, prior)
        deviation[part] = np.sqrt(covariance[:, 0, 0])
        last = part_model.transition[-1]
        prior = last @ covariance[-1] @ last.T + model.process_noise
    return deviation


def _model_of(
    drive: Drive, inputs: set[str], levels: _Levels
) -> tuple[LinearModel[FloatArray], FloatArray]:
    """The model of the module's docstring in discrete time, and the prior covariance of its state,
    whose first element is v.

    The increment z = v⁺ - v + τ b + n that a_y measures shares its noise with that of v⁺ = φ v + ξ:
    given z, with the gain K = q/(q + r), v⁺ = (φ - K (φ - 1)) v - K τ b + ξ' with the variance (1 -
    K) q, and z itself measures (φ - 1) v + τ b with the variance q + r.
    """
    steps = len(drive.vy_ref)
    step = drive.step
    transition: dict[tuple[int, int], FloatArray | float] = {}
    noises = list[float]()
    priors = list[float]()
    # combinations of states, and the variance of each
    measured: list[tuple[dict[int, FloatArray | float], float]] = []

    def state(decay: float, noise: float, prior: float) -> int:
        """Add x⁺ = decay x + w; returns its index."""
        index = len(noises)
        transition[index, index] = decay
        noises.append(noise)
        priors.append(prior)
        return index

    decay, noise = _discretised(levels.velocity, step)
    v = state(
        decay,
        noise,
        levels.reference**2 if drive.starts_at_reference else levels.velocity.deviation**2,
    )
    if levels.lateral is not None:
        white = levels.lateral.density * step + MIN_POSITIVE**2
        gain = noise / (noise + white)
        offset = state(*_discretised(levels.lateral, step), levels.lateral.deviation**2)
        transition[v, v] = decay - gain * (decay - 1.0)
        transition[v, offset] = -gain * step
        noises[v] = noise * (1.0 - gain)
        measured.append(({v: decay - 1.0, offset: step}, noise + white))
    if levels.longitudinal is not None:
        speed = state(1.0, levels.longitudinal.density * step, levels.speed**2)
        pitch = state(*_discretised(levels.longitudinal, step), levels.longitudinal.deviation**2)
        transition[speed, v] = drive.inputs["yaw_rate"] * step
        transition[speed, pitch] = step
        measured.append(({speed: 1.0}, levels.speed**2))
    for axle, front in ((levels.rear, False), (levels.front, True)):
        if axle is not None:
            error = state(*_discretised(axle.error, step), axle.error.deviation**2)
            stiffness = state(1.0, 0.0, STIFFNESS_DEVIATION**2)
            slip = _axle_columns(drive, inputs, front)[:, 1:4] @ axle.coefficients[1:4]
            white = (
                axle.error.density / step
                + levels.reference**2
                + (MIN_WHITE_SHARE * axle.error.deviation) ** 2
            )
            measured.append(({v: 1.0, error: -1.0, stiffness: -slip}, white))
    n = len(noises)
    m = max(len(measured), 1)
    A = np.zeros((steps, n, n))
    C = np.zeros((steps, m, n))
    for (row, column), value in transition.items():
        A[:, row, column] = value
    for row, (of, _) in enumerate(measured):
        for column, value in of.items():
            C[:, row, column] = value
    R = np.array([variance + MIN_POSITIVE**2 for _, variance in measured] or [1.0])
    return LinearModel(A, np.zeros(n), np.diag(noises), C, np.zeros(m), R), np.diag(priors)


def _discretised(process: Noise, step: float) -> tuple[float, float]:
    """Decay of a Gauss-Markov process over a step [s], and the variance of its innovation."""
    decay = math.exp(-step / process.time_constant)
    return decay, process.deviation**2 * (1.0 - decay**2)


# Arrays


def _middle(samples: FloatArray) -> FloatArray:
    """Means of neighbouring samples, (T - 1,), which are for the same times as differences."""
    return 0.5 * (samples[1:] + samples[:-1])


def _joined(drives: Sequence[Drive]) -> tuple[FloatArray, FloatArray]:
    """Lateral and forward velocity of the scored samples of all drives, (N,) each [m/s]."""
    parts = [drive.scored for drive in drives]
    return np.concatenate([drive.vy_ref for drive in parts]), np.concatenate(
        [drive.inputs["vx"] for drive in parts]
    )


def _is_sideslip_scored(drives: Sequence[Drive]) -> BoolArray:
    """Mask of the scored samples of all drives, (N,), at which sideslip is scored."""
    return np.concatenate([drive.scored.is_sideslip_scored for drive in drives])


def _rms(series: Sequence[FloatArray]) -> float:
    """Root mean square over all arrays; NaN without samples."""
    joined = np.concatenate(series)
    return rms(joined) if len(joined) else math.nan


def _sideslip_deviation(
    deviation: FloatArray, velocity: FloatArray, speed: FloatArray
) -> FloatArray:
    """Standard deviation of atan2(v, u) [deg] to first order, (K,), from that of v [m/s]; at most
    `UNIFORM_ANGLE_DEVIATION`.
    """
    slope = np.abs(speed) / np.maximum(np.square(speed) + np.square(velocity), MIN_POSITIVE)
    return np.minimum(np.degrees(deviation * slope), UNIFORM_ANGLE_DEVIATION)
