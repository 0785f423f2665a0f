"""Estimates lever arm, mounting, delay and offsets of the inertial unit.

recording -> Signals, low-passed -> ImuModel: prediction and derivatives -> most likely Fit ->
uncertainties -> ImuFit
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from vehest.alignment.motion import rms
from vehest.alignment.settings import (
    MAX_CUTOFF_SHARE,
    MIN_KERNEL_SAMPLES,
    TILT_LAG_GAIN,
    AlignmentSettings,
)
from vehest.constants import GRAVITY, FloatArray
from vehest.data.errors import ConfigurationError, DataError, listed
from vehest.data.limits import check_limit
from vehest.data.recording import Recording

ComplexArray = NDArray[np.complex128]  # array of complex numbers in double precision

IMU_CHANNELS = ("ax", "ay", "yaw_rate")  # channels of the inertial unit
# names of the parameters of the unit
IMU_PARAMETERS = ("lever_x", "lever_y", "yaw", "delay", "offset_ax", "offset_ay", "offset_yaw_rate")

# prior standard deviation of the part of an acceleration that gravity adds through roll or pitch;
# 0.1 is 5.8° at 1 g
TILT_GAIN = 0.1
# assumed correlation of the remaining tilt of body and road with the effect of a parameter
TILT_LIKENESS = 0.3

ROAD_CUTOFF = 0.2  # Hz; bank and grade of the road change more slowly

MAX_BLOCKS = 12  # largest number of blocks into which a drive is divided for the jackknife
MIN_BLOCK_SECONDS = 2.0  # s, shortest block; longer than the correlation time of the residuals
MIN_BLOCKS = 8  # smallest number of blocks; a drive that is too short for so many is refused
# smallest maximum of the correlation over all searched delays; with less, sensor and reference are
# refused
MIN_CORRELATION = 0.5
MAX_CONDITION = 50.0  # largest condition number of the scaled columns; ordinary drives have 4 to 20
# largest share of noise in a parameter's effect; with more a requested one is refused, a tilt not
# fitted
MAX_NOISE_SHARE = 0.05
KERNEL_REACH = 6.0  # half the length of the Gaussian kernel, in its standard deviations
# largest number of steps of Levenberg and Marquardt; a fit that needs more is refused
N_ITERATIONS = 60
STEP_TOLERANCE = 1e-6  # change of a parameter (m, rad, s, m/s², rad/s) below which it has converged
# smallest variance of a channel's residuals, (m/s²)² or (rad/s)²; avoids an infinite weight
MIN_VARIANCE = 1e-24
# smallest change of a parameter outside the fit that is reported, in standard uncertainties
SUSPICIOUS_UNCERTAINTIES = 3.0
# remedy for a drive that does not determine a parameter, for messages
MORE_MOTION = "more turning, braking and accelerating"

# parameter of the tilt -> standard deviation of its prior
TILT_PRIOR = {
    "tilt_gain_x": TILT_GAIN,
    "tilt_gain_y": TILT_GAIN,
    "tilt_lag_x": TILT_LAG_GAIN,
    "tilt_lag_y": TILT_LAG_GAIN,
}
# all parameters at zero, as of a sensor that is aligned
NOTHING = dict.fromkeys([*IMU_PARAMETERS, *TILT_PRIOR], 0.0)


@dataclass(frozen=True, eq=False)
class Correlation:
    """Cross-correlation between the sensor and its expected signal by the reference."""

    signal: str  # text on the signals
    at_end: bool  # whether the largest value lies at the end of the delays that are searched
    peak: float  # lag of the largest value, between samples by a parabola [s]
    highest: float  # largest value


@dataclass(frozen=True, eq=False)
class ImuFit:
    """Estimated parameters of the inertial unit, with their uncertainties."""

    names: Sequence[str]  # names of the N parameters that were asked for
    values: Mapping[str, float]  # values of all parameters; those that were not asked for are zero
    scatter: FloatArray  # standard uncertainty of each by the scatter of the residuals, (N,)
    tilt: FloatArray  # standard uncertainty of each by roll and pitch that are not modelled, (N,)
    blocks: int  # number of blocks by which ``scatter`` was estimated
    # name -> value and standard uncertainty of other parameters that the residuals suggest
    suspects: Mapping[str, tuple[float, float]]
    correlation: Correlation  # correlation by which the delay was first searched
    signals: Signals  # signals that were compared


def fit_imu(recording: Recording, settings: AlignmentSettings, names: Sequence[str]) -> ImuFit:
    """Fit some of `IMU_PARAMETERS` to a drive; the others are zero.

    Parameters
    ----------
    recording : Recording
        With the channels that `vehest.alignment.align.align` needs.
    settings : AlignmentSettings
        Cut-off, largest delay, and prior of the tilt.
    names : sequence of str
        Parameters to fit.

    Returns
    -------
    ImuFit
        Gains and lags of tilt are fitted too where the drive shows them (`TILT_PRIOR`), and count
        as uncertainty where it does not.

    Raises
    ------
    DataError
        A channel is missing or has gaps, the recording is too short, sensor and reference have
        nothing in common, the delay is beyond ``max_delay``, or parameters cannot be separated or
        are lost in noise.
    ConfigurationError
        The cut-off is too high for the recording's rate.
    """
    signals = signals_of(recording, settings)
    model = ImuModel(signals)
    start = dict(NOTHING)
    (predicted, columns) = model(NOTHING)
    if "yaw" in names:
        expected, measured = (rows[0] + 1j * rows[1] for rows in (predicted, model.measured))
        if "offset_ax" in names:
            expected = expected - expected.mean()
            measured = measured - measured.mean()
        # brings both together best, without delay and lever arm
        start["yaw"] = -float(np.angle(np.vdot(expected, measured)))
    correlation = _cross_correlation(signals, start["yaw"], settings)
    if "delay" in names:
        _require_peak(recording, correlation, settings)
        start["delay"] = correlation.peak
    noise = _noise_of_columns(signals)
    tilts = [
        name
        for name in TILT_PRIOR
        if settings.tilt > 0 and _is_above_noise(columns[name], noise[name])
    ]
    fit = _most_likely(model, start, [*names, *tilts], names)
    _require_identified(signals, fit, names, noise)
    if "delay" in names and abs(fit.values["delay"]) > settings.max_delay:
        raise DataError(
            f"recording '{recording.id}': the delay is longer than {settings.max_delay:g} s; raise "
            "max_delay"
        )
    blocks = n_blocks(signals.duration)
    columns = model(fit.values)[1]
    rate_hz = signals.rate_hz / signals.smoothing.step
    uncertainties = partial(
        _uncertainties, columns=columns, tilt=settings.tilt, blocks=blocks, rate_hz=rate_hz
    )
    scatter, tilt = (sizes[: len(names)] for sizes in uncertainties(fit))
    return ImuFit(
        names,
        fit.values,
        scatter,
        tilt,
        blocks,
        _suspects(fit, columns, uncertainties),
        correlation,
        signals,
    )


@dataclass(frozen=True, eq=False)
class Signals:
    """Signals that are compared, unfiltered, and the filter."""

    recording: Recording  # recording of the signals
    speed: str  # channel of the reference's forward velocity
    measured: ComplexArray  # ax + i·ay of the sensor, (T,)
    velocity: ComplexArray  # vx + i·vy of the reference, (T,)
    gyro: FloatArray  # yaw rate of the sensor, (T,)
    reference_rate: FloatArray | None  # yaw rate of the reference if there is one, (T,)
    # gravity in the accelerometer by roll and pitch, (T,); None where they are not measured or not
    # used
    gravity: ComplexArray | None
    smoothing: Smoothing  # low-pass that both sides go through
    margin: int  # number of samples at either end that serve filtering and shifting only

    @property
    def rate_hz(self) -> float:
        """Sampling rate of the recording."""
        return self.recording.rate_hz

    @property
    def duration(self) -> float:
        """Length of the signals without the margins [s]."""
        return (len(self.measured) - 2 * self.margin) / self.rate_hz

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels that are compared."""
        return IMU_CHANNELS if self.reference_rate is not None else IMU_CHANNELS[:2]

    def low_passed(self, samples: NDArray[Any], order: int = 0) -> NDArray[Any]:
        """A derivative of the low-passed samples without the margins.

        Parameters
        ----------
        samples : array
            (T,), real or complex.
        order : int
            Of the derivative by time; 0 for the samples themselves.

        Returns
        -------
        array
            Every ``smoothing.step``-th sample.
        """
        return self.smoothing(samples, order, margin=self.margin)

    def as_rows(self, plane: ComplexArray, turn: FloatArray | None = None) -> FloatArray:
        """A complex signal, and a real one where the yaw rate is compared too, as rows of shape (C,
        T).
        """
        rows = [plane.real, plane.imag]
        if self.reference_rate is not None:
            rows.append(np.zeros(len(plane)) if turn is None else turn)
        return np.stack(rows)


def signals_of(recording: Recording, settings: AlignmentSettings) -> Signals:
    """Signals of a recording, unfiltered, with the filter and the margins that it needs.

    Parameters
    ----------
    recording : Recording
        With ax, ay, yaw_rate, vy_ref and vx_ref or vx; yaw_rate_ref, roll and pitch are used where
        they are there.
    settings : AlignmentSettings
        Cut-off, largest delay and prior of the tilt, which decides whether roll and pitch are used.

    Raises
    ------
    DataError
        A channel is missing or has gaps, or the recording is too short.
    ConfigurationError
        The cut-off is too high for the recording's rate, or a delay has more samples than the
        limit.
    """
    quantities = ", ".join(settings.kinematic)
    if "vy_ref" not in recording:
        raise DataError(
            f"recording '{recording.id}' has no channel 'vy_ref', the reference that {quantities} "
            "require"
        )
    speed = "vx_ref" if "vx_ref" in recording else "vx"
    optional = [name for name in ("yaw_rate_ref", "roll", "pitch") if name in recording]
    require_complete(recording, [*IMU_CHANNELS, speed, "vy_ref", *optional], quantities)
    gravity = None
    if settings.tilt > 0 and ("roll" in recording or "pitch" in recording):
        level = np.zeros(len(recording))
        roll, pitch = (recording.channels.get(name, level) for name in ("roll", "pitch"))
        gravity = GRAVITY * (-np.sin(pitch) + 1j * np.sin(roll) * np.cos(pitch))
    smoothing = smoothing_of(recording, settings.cutoff_at(recording.rate_hz))
    lags = settings.max_delay * recording.rate_hz
    subject = (
        f"recording '{recording.id}': a delay of {settings.max_delay:g} s is {lags:.6g} samples"
    )
    check_limit("filter_samples", lags, subject, ConfigurationError)
    shift = math.ceil(lags) if "delay" in settings.estimate else 0
    measured = recording["ax"] + 1j * recording["ay"]
    velocity = recording[speed] + 1j * recording["vy_ref"]
    rates = recording["yaw_rate"], recording.channels.get("yaw_rate_ref")
    signals = Signals(
        recording,
        speed,
        measured,
        velocity,
        *rates,
        gravity,
        smoothing,
        margin=smoothing.reach + shift,
    )
    require_length(recording, signals.duration, 2 * signals.margin / recording.rate_hz)
    return signals


class ImuModel:
    """Expected signals of the sensor, low-passed, and their derivatives by every parameter.

    The equation is that of `vehest.alignment.align`, with two terms for gravity by roll and pitch
    that follow the acceleration: a gain and a lag in each axis. Velocities between samples come
    from cubic splines. Without a yaw rate of the reference the sensor's own is used, without a
    delay.

    Parameters
    ----------
    signals : Signals
        Of the recording; the splines are made once.
    """

    def __init__(self, signals: Signals) -> None:
        self.signals = signals
        low = signals.low_passed
        self.measured = signals.as_rows(low(signals.measured), low(signals.gyro))
        self._gravity = 0.0 if signals.gravity is None else low(signals.gravity)
        self._clock = np.arange(len(signals.measured)) / signals.rate_hz
        self._velocity = CubicSpline(self._clock, signals.velocity)
        self._rate = (
            None
            if signals.reference_rate is None
            else CubicSpline(self._clock, signals.reference_rate)
        )

    def __call__(self, at: Mapping[str, float]) -> tuple[FloatArray, dict[str, FloatArray]]:
        """Prediction (C, T) and its derivatives, name -> (C, T), at a set of parameters.

        Parameters
        ----------
        at : mapping
            Name -> value in SI units, of all of `IMU_PARAMETERS` and `TILT_PRIOR`.
        """
        low = self.signals.low_passed
        now = np.clip(self._clock - at["delay"], 0.0, self._clock[-1])
        v = self._velocity(now)
        v_dot = self._velocity(now, 1)
        r = self.signals.gyro - at["offset_yaw_rate"] if self._rate is None else self._rate(now)
        lever = at["lever_x"] + 1j * at["lever_y"]
        gain, lag = (
            complex(at[f"tilt_{part}_x"], at[f"tilt_{part}_y"]) for part in ("gain", "lag")
        )

        rv = r * v
        acceleration = low(v, 1) + 1j * low(rv)
        jerk = low(v, 2) + 1j * low(rv, 1)  # at the reference point
        r_low = low(r)
        r_dot = low(r, 1)
        r_squared = low(r * r)
        arm = 1j * r_dot - r_squared
        tilted = acceleration + _axiswise(gain, acceleration) + _axiswise(lag, jerk)
        turned = np.exp(-1j * at["yaw"])
        plane = turned * (tilted + arm * lever + self._gravity)

        if self._rate is None:  # the yaw rate is on the sensor's own clock
            late = low(v, 2) + 1j * low(r * v_dot)
            late_dot = low(v, 3) + 1j * low(r * v_dot, 1)
            late_arm = np.zeros_like(arm)
        else:
            late = jerk
            late_dot = low(v, 3) + 1j * low(rv, 2)
            late_arm = 1j * low(r, 2) - low(r * r, 1)
        by_delay = late + _axiswise(gain, late) + _axiswise(lag, late_dot) + late_arm * lever
        rows = self.signals.as_rows
        ones = np.ones(len(plane), dtype=np.complex128)
        columns = {
            "lever_x": rows(turned * arm),
            "lever_y": rows(turned * 1j * arm),
            "yaw": rows(-1j * plane),
            "delay": rows(-turned * by_delay, -r_dot),
            "offset_ax": rows(ones),
            "offset_ay": rows(1j * ones),
            "offset_yaw_rate": rows(np.zeros_like(ones), np.ones(len(plane))),
            "tilt_gain_x": rows(turned * acceleration.real),
            "tilt_gain_y": rows(turned * 1j * acceleration.imag),
            "tilt_lag_x": rows(turned * jerk.real),
            "tilt_lag_y": rows(turned * 1j * jerk.imag),
        }
        if self._rate is None:
            by_rate = -1j * low(v)
            by_rate_dot = -1j * low(v, 1)
            columns["offset_yaw_rate"] = rows(
                turned
                * (
                    by_rate
                    + _axiswise(gain, by_rate)
                    + _axiswise(lag, by_rate_dot)
                    + 2.0 * r_low * lever
                )
            )
        prediction = rows(
            plane + at["offset_ax"] + 1j * at["offset_ay"], r_low + at["offset_yaw_rate"]
        )
        return prediction, columns


def _axiswise(factors: complex, plane: ComplexArray) -> ComplexArray:
    """Multiply the x and the y part of a complex signal by a factor each."""
    return factors.real * plane.real + 1j * factors.imag * plane.imag


@dataclass(frozen=True, eq=False)
class Fit:
    """A fit of C channels over T samples by P parameters."""

    names: Sequence[str]  # names of the P parameters
    values: Mapping[str, float]  # values of all parameters, also of those that are not free
    error: FloatArray  # measured less predicted, (C, T)
    columns: FloatArray  # derivatives of the prediction, (P, C, T)
    weights: FloatArray  # weights of the channels, (C,)
    prior: FloatArray  # precision of the prior, (P, P); zero except for parameters that have one

    @property
    def point(self) -> FloatArray:
        """Values of the free and nuisance parameters, (P,)."""
        return np.array([self.values[name] for name in self.names])

    @property
    def cost(self) -> float:
        """Twice the negative logarithm of the likelihood, up to a constant."""
        values = self.point
        return float(
            -self.error.shape[1] * np.log(self.weights).sum() + values @ self.prior @ values
        )

    @property
    def gradient(self) -> FloatArray:
        """Half the decrease of the cost by each parameter, (P,)."""
        return (
            np.einsum("pct,ct,c->p", self.columns, self.error, self.weights)
            - self.prior @ self.point
        )

    @property
    def information(self) -> FloatArray:
        """Inverse of the covariance, were the errors white, (P, P)."""
        return (
            np.einsum("pct,qct,c->pq", self.columns, self.columns, self.weights, optimize=True)
            + self.prior
        )


def _cross_correlation(signals: Signals, yaw: float, settings: AlignmentSettings) -> Correlation:
    """Correlation of sensor and reference over the delay: of the yaw rates if the reference has
    one, else of the accelerations without vx·yaw rate, which has no delay of its own.
    """
    v = signals.velocity
    gyro = signals.gyro

    def low(samples: NDArray[Any], order: int = 0) -> NDArray[Any]:
        return signals.smoothing(samples, order, margin=signals.smoothing.reach, step=1)

    if signals.reference_rate is not None:
        pairs = [(low(gyro, 1), low(signals.reference_rate, 1))]
        quantity = "yaw acceleration"
    else:
        sensor = np.exp(1j * yaw) * low(signals.measured) - 1j * low(gyro * v)
        derived = low(v, 1)
        pairs = [(sensor.real, derived.real), (sensor.imag, derived.imag)]
        quantity = "acceleration"
    n_lags = math.ceil(settings.max_delay * signals.rate_hz)
    lags = np.arange(-n_lags, n_lags + 1)
    products = np.zeros(len(lags))
    sensor_energy = np.zeros(len(lags))
    derived_energy = 0.0
    for sensor, derived in pairs:
        sensor = sensor - sensor.mean()
        core = (derived - derived.mean())[n_lags : len(derived) - n_lags]
        products += signal.correlate(sensor, core, mode="valid", method="fft")
        energy = np.concatenate([[0.0], np.cumsum(np.square(sensor))])
        sensor_energy += energy[len(core) :] - energy[: len(lags)]
        derived_energy += float(core @ core)
    size = np.sqrt(sensor_energy * derived_energy)
    value = np.divide(products, size, out=np.zeros(len(lags)), where=size > 0)
    top = int(np.argmax(value))
    at_end = top in (0, len(value) - 1)
    shift = 0.0
    if not at_end:
        before, at, after = value[top - 1 : top + 2]
        bend = before - 2.0 * at + after
        shift = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return Correlation(
        quantity, at_end, float(lags[top] + shift) / signals.rate_hz, float(value[top])
    )


def _require_peak(
    recording: Recording, correlation: Correlation, settings: AlignmentSettings
) -> None:
    """Raise an error for a sensor and a reference that do not correlate, or only at the end of the
    delays that are searched.
    """
    if correlation.highest < MIN_CORRELATION:
        raise DataError(
            f"recording '{recording.id}': the {correlation.signal} of sensor and reference has a "
            f"correlation of at most {correlation.highest:.2f} (required: {MIN_CORRELATION:g}); "
            "check units, signs and channels (vehest data check), or raise max_delay "
            f"({settings.max_delay:g} s)"
        )
    if correlation.at_end:
        raise DataError(
            f"recording '{recording.id}': the largest correlation is at the limit of the searched "
            f"delays ({settings.max_delay:g} s); raise max_delay"
        )


def _most_likely(
    model: ImuModel, start: Mapping[str, float], names: Sequence[str], requested: Sequence[str]
) -> Fit:
    """The fit of largest likelihood, by Levenberg and Marquardt's steps; each channel's variance is
    the mean square of its own residuals.
    """
    prior = np.diag([TILT_PRIOR[name] ** -2 if name in TILT_PRIOR else 0.0 for name in names])

    def fit_at(values: Mapping[str, float]) -> Fit:
        predicted, by_name = model(values)
        error = model.measured - predicted
        weights = 1.0 / np.maximum(np.mean(np.square(error), axis=1), MIN_VARIANCE)
        return Fit(
            names, dict(values), error, np.stack([by_name[name] for name in names]), weights, prior
        )

    fit = fit_at(start)
    damping = 1e-4
    for _ in range(N_ITERATIONS):
        information = fit.information
        require_condition(model.signals.recording, information, names, requested)
        step = np.linalg.solve(information + damping * np.diag(np.diag(information)), fit.gradient)
        moved = fit_at({**fit.values, **dict(zip(names, (fit.point + step).tolist(), strict=True))})
        settled = float(np.abs(step).max()) < STEP_TOLERANCE
        if moved.cost <= fit.cost:
            fit = moved
            damping = damping / 10.0
        elif not settled:
            damping = max(damping, 1e-4) * 10.0
        if settled:
            return fit
    raise DataError(
        f"recording '{model.signals.recording.id}': the estimate of {listed(requested)} does not "
        "converge; request fewer quantities, lower the cut-off, or use a drive with "
        f"{MORE_MOTION}"
    )


def require_condition(
    recording: Recording, information: FloatArray, names: Sequence[str], requested: Sequence[str]
) -> None:
    """Refuse, by a `DataError`, parameters that the drive cannot distinguish: the condition number
    of the scaled problem is too large.

    Parameters
    ----------
    recording : Recording
        Named in the error.
    information : FloatArray
        (P, P), of the least-squares problem.
    names : sequence of str
        Of the P parameters.
    requested : sequence of str
        Those that the user asked for; others are called tilt in the error.

    Raises
    ------
    DataError
        The condition number exceeds MAX_CONDITION, or no signal depends on a parameter.
    """
    scale = np.sqrt(np.diag(information))
    silent = [name for name, size in zip(names, scale, strict=True) if size == 0.0]
    if silent:
        raise DataError(
            f"recording '{recording.id}': no signal depends on {listed(silent)}; the drive needs "
            "turning and accelerating"
        )
    condition = condition_of(information)
    if condition <= MAX_CONDITION:
        return
    weakest = np.linalg.eigh(information / scale / scale[:, None])[1][:, 0]
    confused = [
        name if name in requested else "tilt of the body"
        for name, part in zip(names, weakest, strict=True)
        if abs(part) > 0.3
    ]
    raise DataError(
        f"recording '{recording.id}': {listed(list(dict.fromkeys(confused)))} cannot be separated "
        f"in this drive (condition number {condition:.2g}, at most {MAX_CONDITION:g}); request "
        "fewer quantities, or use a drive with varying speed and turns both ways"
    )


def condition_of(information: FloatArray) -> float:
    """Condition number of a least-squares problem whose columns are scaled to length 1; infinite
    where one is zero.

    Parameters
    ----------
    information : FloatArray
        (P, P), symmetric: columns times columns.
    """
    scale = np.sqrt(np.diag(information))
    values = (
        np.linalg.eigvalsh(information / scale / scale[:, None]) if scale.all() else np.zeros(1)
    )
    return math.sqrt(values[-1] / values[0]) if values[0] > 0 else math.inf


def _noise_of_columns(signals: Signals) -> dict[str, tuple[float, float, float]]:
    """Standard deviation of the noise in the derivatives by each parameter, for ax, ay and yaw
    rate.

    It is that of the reference and of the yaw rate, taken as white.
    """
    speed_noise = _noise(signals.velocity.real)
    side_noise = _noise(signals.velocity.imag)
    rate_noise = _noise(signals.gyro if signals.reference_rate is None else signals.reference_rate)
    level, slope, bend = (
        float(np.linalg.norm(signals.smoothing.kernel(order))) for order in range(3)
    )
    speed = rms(np.abs(signals.velocity))
    turning = rms(signals.gyro)
    ahead = slope * speed_noise
    aside = math.hypot(slope * side_noise, level * speed * rate_noise)
    arm = math.hypot(2.0 * turning * level * rate_noise, slope * rate_noise) / math.sqrt(2.0)
    no_noise = (0.0, 0.0, 0.0)
    by_offset = (level * side_noise, level * speed_noise, 0.0)
    return dict.fromkeys(IMU_PARAMETERS, no_noise) | {
        "lever_x": (arm, arm, 0.0),
        "lever_y": (arm, arm, 0.0),
        "yaw": (aside, ahead, 0.0),
        "delay": (bend * speed_noise, bend * side_noise, slope * rate_noise),
        "offset_yaw_rate": by_offset if signals.reference_rate is None else no_noise,
        "tilt_gain_x": (ahead, 0.0, 0.0),
        "tilt_gain_y": (0.0, aside, 0.0),
        "tilt_lag_x": (bend * speed_noise, 0.0, 0.0),
        "tilt_lag_y": (0.0, math.hypot(bend * side_noise, slope * speed * rate_noise), 0.0),
    }


def _is_above_noise(column: FloatArray, noise: tuple[float, float, float]) -> bool:
    """Whether an effect varies enough to be separated from noise; where it does not, it counts as
    an uncertainty only.
    """
    return sum(size**2 for size in noise) <= MAX_NOISE_SHARE * float(column.var(axis=1).sum())


def _require_identified(
    signals: Signals,
    fit: Fit,
    requested: Sequence[str],
    noise: Mapping[str, tuple[float, float, float]],
) -> None:
    """Raise an error for parameters whose column, without the share of the others, does not stand
    well above the noise of yaw rate and reference.
    """
    unique = 1.0 / np.diag(np.linalg.inv(fit.information[: len(requested), : len(requested)]))
    for index, name in enumerate(requested):
        share = (
            fit.error.shape[1]
            * float(fit.weights @ np.square(noise[name][: len(fit.weights)]))
            / unique[index]
        )
        if share > MAX_NOISE_SHARE:
            raise DataError(
                f"recording '{signals.recording.id}': {name} cannot be estimated: "
                f"{100 * min(share, 1.0):.0f} % of its effect in this drive is noise (at most "
                f"{100 * MAX_NOISE_SHARE:g} %); lower the cut-off, or use a drive with "
                f"{MORE_MOTION}"
            )


def _noise(samples: FloatArray) -> float:
    """Standard deviation of the white noise on a smooth signal, from its third differences."""
    return rms(np.diff(samples, 3)) / math.sqrt(20.0)


def require_length(recording: Recording, usable: float, lost: float) -> None:
    """Raise `DataError` for a drive that is too short for an uncertainty.

    Parameters
    ----------
    recording : Recording
        Named in the error.
    usable : float
        Of the signals without margins [s].
    lost : float
        Margins at both ends together [s].

    Raises
    ------
    DataError
        Fewer than MIN_BLOCKS blocks of MIN_BLOCK_SECONDS would be left.
    """
    min_seconds = MIN_BLOCKS * MIN_BLOCK_SECONDS
    if usable < min_seconds:
        raise DataError(
            f"recording '{recording.id}' lasts {recording.duration:.3g} s; an uncertainty needs at "
            f"least {min_seconds + lost:.3g} s, of which {lost:.2g} s for filtering and shifting"
        )


def n_blocks(seconds: float) -> int:
    """Number of blocks that a drive is divided into: longer ones for longer drives.

    Returns
    -------
    int
        From MIN_BLOCKS to MAX_BLOCKS, of at least MIN_BLOCK_SECONDS where the drive allows.
    """
    return min(max(int(seconds / MIN_BLOCK_SECONDS), MIN_BLOCKS), MAX_BLOCKS)


def scatter_of(fit: Fit, blocks: int) -> FloatArray:
    """Covariance of the parameters (P, P), from leaving out one block of time after another.

    Residuals remember for seconds; blocks that are longer than that are nearly independent,
    whatever the residuals' spectrum. Parameters with a prior vary as the prior does.

    Source: Cluster jackknife: MacKinnon, Nielsen & Webb, Cluster-robust inference: A guide to
    empirical practice, Journal of Econometrics 232 (2), 2023, section 3; blocks of a time series as
    clusters: Ibragimov & Müller, J. Business & Economic Statistics 28 (4), 2010.

    Parameters
    ----------
    fit : Fit
        With errors and derivatives at the estimate.
    blocks : int
        Number of blocks, of nearly equal length.
    """
    information = fit.information
    edges = np.linspace(0, fit.error.shape[1], blocks + 1).astype(int)
    changes = []
    for first, last in itertools.pairwise(edges):
        columns = fit.columns[:, :, first:last]
        error = fit.error[:, first:last]
        block_information = np.einsum("pct,qct,c->pq", columns, columns, fit.weights, optimize=True)
        score = np.einsum("pct,ct,c->p", columns, error, fit.weights, optimize=True)
        changes.append(np.linalg.lstsq(information - block_information, -score, rcond=None)[0])
    moved = np.stack(changes)
    inverse = np.linalg.inv(information)
    return (blocks - 1) / blocks * moved.T @ moved + inverse @ fit.prior @ inverse


def _uncertainties(
    fit: Fit, columns: Mapping[str, FloatArray], tilt: float, blocks: int, rate_hz: float
) -> tuple[FloatArray, FloatArray]:
    """Standard uncertainties of the parameters by scatter and by tilt, (P,) each.

    Tilt is the change by roll and pitch that the fit does not know: of the body, constant, moving,
    or following the accelerations where that is not fitted, and of the road. The slow part of the
    residuals shows how much the road tilts; the worst case is assumed, a tilt that looks like the
    effect of a parameter. ``tilt`` is the body's [rad], ``blocks`` the number of blocks of time.
    """
    scatter = np.sqrt(np.diag(scatter_of(fit, blocks)))
    if tilt == 0.0:
        return scatter, np.zeros(len(fit.names))
    # change of each parameter by an error of either axis at one time
    pull = np.linalg.solve(
        fit.information, (fit.columns[:, :2] * fit.weights[:2, None]).reshape(len(fit.names), -1)
    ).reshape(len(fit.names), 2, -1)
    moving = pull - pull.mean(axis=2, keepdims=True)
    deviation = _deviation(ROAD_CUTOFF, rate_hz)
    slow, road = (
        gaussian_filter1d(samples, deviation, axis=-1, mode="reflect")
        for samples in (moving, fit.error[:2])
    )
    body = GRAVITY * tilt
    variance = (
        np.square(body * pull.sum(axis=2))
        + _likened(moving, body)
        + _likened(slow, road.std(axis=1))
    )
    total = variance.sum(axis=1)
    for name in [name for name in TILT_PRIOR if name not in fit.names]:
        total += np.square(TILT_PRIOR[name] * np.einsum("pct,ct->p", pull, columns[name][:2]))
    return scatter, np.sqrt(total)


def _suspects(
    fit: Fit,
    columns: Mapping[str, FloatArray],
    uncertainties: Callable[[Fit], tuple[FloatArray, FloatArray]],
) -> dict[str, tuple[float, float]]:
    """Parameters that are no part of the fit and that one more step would move by more than three
    standard uncertainties.
    """
    suspects = {}
    for name in [name for name in IMU_PARAMETERS if name not in fit.names]:
        names = [*fit.names, name]
        wider = replace(
            fit,
            names=names,
            columns=np.stack([columns[parameter] for parameter in names]),
            prior=np.pad(fit.prior, (0, 1)),
        )
        if condition_of(wider.information) > MAX_CONDITION:
            continue
        step = np.linalg.solve(wider.information, wider.gradient)
        left = replace(wider, error=fit.error - np.einsum("p,pct->ct", step, wider.columns))
        uncertainty = math.hypot(*(float(sizes[-1]) for sizes in uncertainties(left)))
        if abs(step[-1]) > SUSPICIOUS_UNCERTAINTIES * uncertainty:
            suspects[name] = (float(step[-1]), uncertainty)
    return suspects


def _likened(pull: FloatArray, size: float | FloatArray) -> FloatArray:
    """Variance of each parameter, (P,), by an error of a given size that resembles its effect to
    the assumed degree.
    """
    return pull.shape[2] * np.square(pull).sum(axis=2) * np.square(TILT_LIKENESS * size)


@dataclass(frozen=True)
class Smoothing:
    """Low-passing by a Gaussian kernel, whose derivatives differentiate; of the output as many
    samples are kept as its band needs.
    """

    deviation: float  # standard deviation of the kernel [samples]
    rate_hz: float  # sampling rate of the input [Hz]

    @property
    def reach(self) -> int:
        """Half the length of the kernel [samples]."""
        return math.ceil(KERNEL_REACH * self.deviation)

    @property
    def step(self) -> int:
        """Number of input samples of which one is kept."""
        return max(math.floor(self.deviation / MIN_KERNEL_SAMPLES), 1)

    def __call__(
        self, samples: NDArray[Any], order: int = 0, *, margin: int, step: int = 0
    ) -> NDArray[Any]:
        """A derivative of the low-passed samples (T,), real or complex, from ``margin`` (at least
        the reach) to as many before the end.

        Parameters
        ----------
        samples : array
            (T,), without gaps.
        order : int
            Of the derivative by time.
        margin : int
            Samples at either end that are not returned.
        step : int
            Every how many samples one is kept; 0 for the filter's own step.
        """
        if np.iscomplexobj(samples):  # faster than a real kernel on complex samples
            ahead, aside = (
                self(part, order, margin=margin, step=step) for part in (samples.real, samples.imag)
            )
            return ahead + 1j * aside
        step = step or self.step
        inside = samples[margin - self.reach : len(samples) - margin + self.reach]
        padding = (
            -2 * self.reach % step
        )  # the first sample whose kernel is whole is to be the first of a step
        smooth = signal.upfirdn(
            self.kernel(order), np.concatenate([np.zeros(padding), inside]), down=step
        )
        first = (padding + 2 * self.reach) // step
        count = -(-(len(samples) - 2 * margin) // step)
        return smooth[first : first + count]

    def kernel(self, order: int) -> FloatArray:
        """Impulse response of a derivative of the low-pass; its norm is the standard deviation,
        after it, of white noise of standard deviation 1.

        Parameters
        ----------
        order : int
            0 for the low-pass itself.

        Returns
        -------
        FloatArray
            (2·reach + 1,), in 1/s to the power of ``order``.
        """
        impulse = np.zeros(2 * self.reach + 1)
        impulse[self.reach] = 1.0
        kernel = gaussian_filter1d(
            impulse, self.deviation, order=order, mode="constant", truncate=KERNEL_REACH
        )
        return np.asarray(kernel * self.rate_hz**order, dtype=np.float64)


def smoothing_of(recording: Recording, cutoff_hz: float) -> Smoothing:
    """The low-pass with -3 dB at a frequency.

    Parameters
    ----------
    recording : Recording
        For its rate.
    cutoff_hz : float
        [Hz].

    Raises
    ------
    ConfigurationError
        The kernel is too narrow to be sampled, or longer than the limit.
    """
    deviation = _deviation(cutoff_hz, recording.rate_hz)
    length = 2 * KERNEL_REACH * deviation
    subject = (
        f"recording '{recording.id}': a low-pass at {cutoff_hz:g} Hz reaches over {length:.6g} "
        "samples"
    )
    check_limit("filter_samples", length, subject, ConfigurationError)
    limit = MAX_CUTOFF_SHARE * recording.rate_hz
    if cutoff_hz > limit:
        raise ConfigurationError(
            f"recording '{recording.id}': a cut-off of {cutoff_hz:g} Hz is too high for "
            f"{recording.rate_hz:g} Hz; use at most {math.floor(100 * limit) / 100:g} Hz, or a "
            "recording at its native rate"
        )
    return Smoothing(deviation, recording.rate_hz)


def require_complete(recording: Recording, names: Sequence[str], quantities: str) -> None:
    """Refuse, by a `DataError`, channels that are not there or have gaps.

    Parameters
    ----------
    recording : Recording
        The recording.
    names : sequence of str
        Channels that are needed.
    quantities : str
        What they are needed for, in the error.
    """
    for name in names:
        if np.isnan(recording[name]).any():
            raise DataError(
                f"recording '{recording.id}': channel '{name}' has gaps; select a range without "
                f"gaps to estimate {quantities}"
            )


def _deviation(cutoff_hz: float, rate_hz: float) -> float:
    """Standard deviation [samples] of the Gaussian kernel that is at -3 dB at a frequency [Hz]."""
    return math.sqrt(math.log(2.0)) / (2.0 * math.pi * cutoff_hz) * rate_hz
