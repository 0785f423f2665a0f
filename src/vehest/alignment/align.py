"""Aligns a measuring set-up with its reference: lever arm, mounting rotation, delay and offsets of
the sensors, steering ratio.

Only quantities that are asked for are estimated, the others count as zero. Nothing is applied: the
outcome names the transforms that would.

In the plane, with velocities v = vx + i·vy and accelerations a = ax + i·ay as complex numbers, an
accelerometer at the lever l from the reference point, turned by ψ, late by τ and with the offset b
reads

    a(t) = exp(-iψ)·(v' + i·r·v + (i·r' - r²)·l + gravity by tilt) + b,    velocities and yaw rate r
    taken at t - τ,

and the yaw rate sensor r(t - τ) + b_r. Both sides go through the same low-pass filter, which
therefore cancels. ``docs/alignment.md`` derives it and lists its limits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from vehest.alignment.imu import (
    IMU_CHANNELS,
    MIN_BLOCK_SECONDS,
    MIN_BLOCKS,
    NOTHING,
    Correlation,
    Fit,
    ImuFit,
    ImuModel,
    Signals,
    fit_imu,
    n_blocks,
    require_complete,
    require_condition,
    require_length,
    scatter_of,
    signals_of,
    smoothing_of,
)
from vehest.alignment.motion import rms
from vehest.alignment.settings import QUANTITIES, AlignmentSettings
from vehest.constants import GRAVITY, FloatArray
from vehest.data.errors import ConfigurationError, DataError, listed
from vehest.data.recording import Recording
from vehest.data.transforms import transform_from_config

# name of a parameter -> its SI unit
UNITS: dict[str, str] = {
    "lever_x": "m",
    "lever_y": "m",
    "yaw": "rad",
    "delay": "s",
    "offset_ax": "m/s²",
    "offset_ay": "m/s²",
    "offset_yaw_rate": "rad/s",
    "steering_ratio": "1",
    "steering_offset": "rad",
    "understeer_gradient": "rad/(m/s²)",
}

READ_AS = {"rad": (180.0 / math.pi, "deg"), "s": (1e3, "ms")}
"""SI unit -> factor and unit in tables for people; files and JSON hold SI units."""

# rad s²/m, by which the understeer gradients of real cars depart from a constant one
UNDERSTEER_CHANGE = 3e-4
LINKAGE_CHANGE = 0.06
"""Standard deviation of the ratio from linkage, wheelbase and gain of the yaw rate, as a share of
it.

Five recordings of two cars whose slow corners determine the ratio best (DevBot, Audi TTS) are 8 to
9 % off.
"""
STEERING_CUTOFF = 0.25
"""Cut-off of the steering's regression as a part of the other one: only slow steering obeys the
steady-state relation.
"""


@dataclass(frozen=True)
class Parameter:
    """One estimated number."""

    name: str  # name, one of `UNITS`
    value: float  # estimate in SI units
    uncertainty: float  # standard uncertainty of all contributions together
    low: float  # lower end of the 95 % interval
    high: float  # upper end of the 95 % interval
    scatter: float  # contribution of the residuals' scatter to it
    tilt: float  # contribution of roll and pitch of body and road that are not measured
    model: float = 0.0  # contribution of an understeer gradient that is not constant

    @property
    def may_be_zero(self) -> bool:
        """Whether the 95 % interval contains zero."""
        return self.low <= 0.0 <= self.high

    @property
    def unit(self) -> str:
        """SI unit."""
        return UNITS[self.name]


@dataclass(frozen=True, eq=False)
class Residual:
    """Low-passed difference between a sensor and its expected signal by the reference."""

    channel: str  # channel of the sensor
    unit: str  # SI unit of the channel
    # root mean square: ``before`` as recorded, ``after`` once the transforms have been applied,
    # ``rest`` without the part that follows the accelerations, as roll and pitch do; NaN where not
    # fitted
    rms: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Alignment:
    """Alignment of a measuring set-up by a drive."""

    recording: Recording  # recording as it was
    settings: AlignmentSettings  # settings of the estimate
    parameters: tuple[Parameter, ...]  # estimated parameters in the order of `UNITS`
    # configurations of the transforms that would correct it, in the order of their application
    transforms: tuple[Mapping[str, Any], ...]
    residuals: tuple[Residual, ...] = ()  # residuals of the channels that were compared
    # cross-correlation of sensor and reference; None where there is no reference
    correlation: Correlation | None = None
    notes: tuple[str, ...] = ()  # remarks, a sentence or two each

    def __getitem__(self, name: str) -> Parameter:
        """A parameter by its name. Raises `KeyError`: it was not asked for."""
        return {parameter.name: parameter for parameter in self.parameters}[name]


def in_words(name: str, value: float) -> str:
    """A value in degrees or milliseconds, with its unit.

    Parameters
    ----------
    name : str
        A parameter, one of `UNITS`.
    value : float
        In SI units.

    Returns
    -------
    str
        Three significant digits; a number alone where the unit is 1.
    """
    factor, unit = READ_AS.get(UNITS[name], (1.0, UNITS[name]))
    number = f"{factor * value:.3g}"
    return number if unit == "1" else f"{number} {unit}"


def align(recording: Recording, settings: AlignmentSettings) -> Alignment:
    """Estimate the quantities that are requested; the recording stays as it is.

    The steering ratio is estimated last, on the drive as the other transforms would correct it.

    Parameters
    ----------
    recording : Recording
        With ``handwheel`` or ``steer``, ``vx``, ``yaw_rate`` and ``ay`` for the steering ratio;
        with ``ax``, ``ay``, ``yaw_rate``, ``vy_ref`` and ``vx_ref`` (or ``vx``) for all others.
    settings : AlignmentSettings
        What to estimate, and cut-off, largest delay, tilt, wheelbase and limits of the steering.

    Returns
    -------
    Alignment
        Parameters with 95 % intervals, transforms in the order in which they have to be applied,
        residuals before and after them, and notes.

    Raises
    ------
    DataError
        A channel is missing or has gaps, the recording is too short, sensor and reference have
        nothing in common, or the parameters cannot be separated in this drive.
    ConfigurationError
        The cut-off is too high for the recording's rate.
    """
    parameters: list[Parameter] = []
    transforms: list[dict[str, Any]] = []
    residuals: tuple[Residual, ...] = ()
    notes: list[str] = []
    corrected = recording
    correlation = None
    if settings.kinematic:
        fit = fit_imu(
            recording,
            settings,
            [name for quantity in settings.kinematic for name in QUANTITIES[quantity]],
        )
        uncertainties = zip(fit.names, fit.scatter.tolist(), fit.tilt.tolist(), strict=True)
        parameters = [
            _parameter(name, fit.values[name], scatter, tilt, fit.blocks - 1)
            for name, scatter, tilt in uncertainties
        ]
        transforms = _imu_transforms(parameters)
        for transform in transforms:
            corrected = transform_from_config(transform)(corrected)
        residuals = _residuals(fit, signals_of(corrected, settings))
        correlation = fit.correlation
        notes = _imu_notes(fit, parameters, settings)
    if "steering_ratio" in settings.estimate:
        estimates, transform, note = _align_steering(corrected, settings)
        parameters = [*parameters, *estimates]
        transforms = [*transforms, transform]
        notes = [*notes, note]
    return Alignment(
        recording,
        settings,
        tuple(parameters),
        tuple(transforms),
        residuals,
        correlation,
        tuple(notes),
    )


def _parameter(
    name: str, value: float, scatter: float, tilt: float, freedom: int, model: float = 0.0
) -> Parameter:
    """A parameter with the 95 % interval of Student's distribution, effective degrees of freedom
    after Welch and Satterthwaite (GUM, G.4.1).
    """
    uncertainty = math.hypot(scatter, tilt, model)
    effective = freedom * (uncertainty / scatter) ** 4 if scatter > 0 else math.inf
    half = uncertainty * float(
        stats.t.ppf(0.975, effective) if effective < 1e6 else stats.norm.ppf(0.975)
    )
    return Parameter(name, value, uncertainty, value - half, value + half, scatter, tilt, model)


def _imu_transforms(parameters: Sequence[Parameter]) -> list[dict[str, Any]]:
    """Configurations of the transforms that correct those parameters whose interval excludes zero,
    in the order of their application: delay, offsets (they are in the sensor's axes), mounting.
    """
    values = {
        parameter.name: _rounded(parameter.value)
        for parameter in parameters
        if not parameter.may_be_zero
    }
    transforms: list[dict[str, Any]] = []
    if "delay" in values:
        transforms.append(
            {"name": "delay_correction", "delay": values["delay"], "channels": list(IMU_CHANNELS)}
        )
    offsets = {
        channel: values[f"offset_{channel}"]
        for channel in IMU_CHANNELS
        if f"offset_{channel}" in values
    }
    if offsets:
        transforms.append({"name": "offset_correction", "offsets": offsets})
    mounting: dict[str, Any] = {
        name: values[name] for name in ("lever_x", "lever_y", "yaw") if name in values
    }
    if mounting:
        transforms.append({"name": "mounting_correction", **mounting})
    return transforms


def _residuals(fit: ImuFit, corrected: Signals) -> tuple[Residual, ...]:
    """Sensor less reference, as recorded and as the transforms leave them."""
    before = ImuModel(fit.signals)
    after = ImuModel(corrected)
    tilt = {name: value for name, value in fit.values.items() if name.startswith("tilt")}
    error_before, error_after = (model.measured - model(NOTHING)[0] for model in (before, after))
    untilted = after.measured - after({**NOTHING, **tilt})[0]
    residuals = []
    for row, channel in enumerate(fit.signals.channels):
        is_tilted = any(tilt.values()) and channel != "yaw_rate"
        sizes = {
            "before": rms(error_before[row]),
            "after": rms(error_after[row]),
            "rest": rms(untilted[row]) if is_tilted else math.nan,
        }
        residuals.append(Residual(channel, UNITS[f"offset_{channel}"], sizes))
    return tuple(residuals)


def _imu_notes(
    fit: ImuFit, parameters: Sequence[Parameter], settings: AlignmentSettings
) -> list[str]:
    """Sentences on what an estimate assumes, what its residuals suggest, and which intervals
    contain zero.
    """
    signals = fit.signals
    values = fit.values
    notes = []
    left = [
        name for name in QUANTITIES if name not in settings.estimate and name != "steering_ratio"
    ]
    if left:
        notes.append(f"Not requested and assumed to be zero: {', '.join(left)}.")
    if fit.suspects:
        suspected = listed(
            [
                f"{name} {in_words(name, value)} ± {in_words(name, sigma)}"
                for name, (value, sigma) in fit.suspects.items()
            ]
        )
        notes.append(
            "The residuals suggest values other than zero for quantities that were not requested, "
            f"each fitted alone: {suspected}. If they are requested too, the other estimates may "
            "change."
        )
    unproven = [parameter.name for parameter in parameters if parameter.may_be_zero]
    if unproven:
        notes.append(
            f"The 95 % interval of {listed(unproven)} contains zero: this drive does not justify a "
            "correction, and none is proposed."
        )
    if signals.speed == "vx":
        notes.append(
            "No vx_ref: vx is used as the reference's forward velocity and assumed to be "
            "synchronous with it."
        )
    if signals.reference_rate is None:
        notes.append(
            "No yaw_rate_ref: delay and yaw rate offset are estimated from the accelerations; "
            "they are less certain, and biased by the bank of the road."
        )
    if "offset_ax" in fit.names:
        angles = (
            math.degrees(math.asin(min(abs(values[name]) / GRAVITY, 1.0)))
            for name in ("offset_ax", "offset_ay")
        )
        notes.append(
            "The offsets of ax and ay cannot be distinguished from a mounting pitch of {:.2f}° and "
            "roll of {:.2f}°.".format(*angles)
        )
    if signals.gravity is not None:
        notes.append(
            "For this estimate, gravity is subtracted from the accelerations by the measured roll "
            "and pitch."
        )
    if settings.tilt > 0:
        notes.append(
            "Gain error relative to the reference's acceleration: "
            f"{_percent(values['tilt_gain_x'])} in ax and {_percent(values['tilt_gain_y'])} in "
            "ay, from gravity in the pitching and rolling body (1 % is 0.57° at 1 g) or a scale "
            "error. No transform corrects it."
        )
    return notes


def _align_steering(
    recording: Recording, settings: AlignmentSettings
) -> tuple[list[Parameter], dict[str, Any], str]:
    """Least squares of channel = ratio·(atan(wheelbase·r/vx) + K·ay) + offset where the car drives
    calmly.

    A term in the derivative of the angle is fitted beside it: in transients the steering leads.

    Parameters
    ----------
    recording : Recording
        As the other transforms would correct it.
    settings : AlignmentSettings
        With the wheelbase [m].

    Returns
    -------
    tuple
        Steering ratio [1], steering offset [rad] and understeer gradient [rad/(m/s²)] with their
        uncertainties, the transform, and a note.

    Raises
    ------
    ConfigurationError
        There is no wheelbase, or the cut-off is too high.
    DataError
        A channel has gaps, the car hardly ever drives calmly, the parameters cannot be separated,
        or the ratio is not significantly different from zero.
    """
    if settings.wheelbase is None:
        raise ConfigurationError(
            "the steering ratio needs the wheelbase [m]: --wheelbase 2.7, "
            "or car: {wheelbase: 2.7} in conf/dataset/NAME.yaml"
        )
    source = settings.steering_channel or ("handwheel" if "handwheel" in recording else "steer")
    yaw_rate = "yaw_rate_ref" if "yaw_rate_ref" in recording else "yaw_rate"
    require_complete(recording, [source, "vx", yaw_rate, "ay"], "steering_ratio")
    smoothing = smoothing_of(recording, STEERING_CUTOFF * settings.cutoff_at(recording.rate_hz))
    lost = 2 * smoothing.reach / recording.rate_hz
    require_length(recording, recording.duration - lost, lost)

    def low(samples: FloatArray, order: int = 0) -> FloatArray:
        return smoothing(samples, order, margin=smoothing.reach)

    speed = np.maximum(recording["vx"], 0.1 * settings.min_speed)
    angle = np.arctan(settings.wheelbase * recording[yaw_rate] / speed)
    calm = (low(recording["vx"]) >= settings.min_speed) & (
        np.abs(low(recording["ay"])) <= settings.max_ay
    )
    seconds = float(calm.sum()) * smoothing.step / recording.rate_hz
    min_seconds = MIN_BLOCKS * MIN_BLOCK_SECONDS
    if seconds < min_seconds:
        raise DataError(
            f"recording '{recording.id}': only {seconds:.3g} s with vx ≥ {settings.min_speed:g} "
            f"m/s and |ay| ≤ {settings.max_ay:g} m/s²; the steering ratio needs at least "
            f"{min_seconds:g} s"
        )
    columns = np.stack([low(angle), np.ones(len(calm)), low(recording["ay"]), low(angle, 1)])[
        :, calm
    ]
    measured = low(recording[source])[calm]
    names = ["steering_ratio", "steering_offset", "understeer_gradient", "lead"]
    require_condition(recording, columns @ columns.T, names, names[:3])
    solution = np.linalg.lstsq(columns.T, measured, rcond=None)[0]
    error = measured - solution @ columns
    fit = Fit(
        names,
        dict(zip(names, solution.tolist(), strict=True)),
        error[None],
        columns[:, None],
        np.ones(1),
        np.zeros((4, 4)),
    )
    blocks = n_blocks(seconds)
    ratio, offset, slope, _ = solution.tolist()
    to_gradient = np.diag([1.0, 1.0, 1.0 / ratio, 1.0])  # understeer gradient = slope / ratio
    to_gradient[2, 0] = -slope / ratio**2
    scatter = np.sqrt(np.diag(to_gradient @ scatter_of(fit, blocks) @ to_gradient.T))
    of_model = _error_of_constant_understeer(columns, low(recording["vx"])[calm], ratio)
    gentle = np.abs(columns[2]) <= 0.5 * settings.max_ay
    if np.count_nonzero(gentle) * smoothing.step / recording.rate_hz >= min_seconds:
        of_gentle = np.linalg.lstsq(columns[:, gentle].T, measured[gentle], rcond=None)[0][0]
        of_model = math.hypot(of_model, float(of_gentle) - ratio)
    values = zip(
        names[:3],
        (ratio, offset, slope / ratio),
        scatter[:3].tolist(),
        (of_model, 0.0, 0.0),
        strict=True,
    )
    estimates = [
        _parameter(name, value, size, 0.0, blocks - 1, model) for name, value, size, model in values
    ]
    by_scatter = _parameter(names[0], ratio, float(scatter[0]), 0.0, blocks - 1)
    if by_scatter.may_be_zero:
        raise DataError(
            f"recording '{recording.id}': '{source}' does not follow the curvature of the path "
            f"(ratio {ratio:.3g} ± {scatter[0]:.2g}); check its sign, or use a drive with slow "
            "turns"
        )
    transform = {
        "name": "steering_ratio",
        "ratio": _rounded(ratio),
        "offset": _rounded(offset),
        "channel": source,
    }
    note = (
        f"Steering ratio of '{source}' to atan(wheelbase·{yaw_rate}/vx), wheelbase "
        f"{settings.wheelbase:g} m, from {seconds:.0f} s (vx ≥ {settings.min_speed:g} m/s, |ay| ≤ "
        f"{settings.max_ay:g} m/s²); residual {rms(error):.2g} rad RMS."
    )
    return estimates, transform, note


def _error_of_constant_understeer(columns: FloatArray, speed: FloatArray, ratio: float) -> float:
    """Standard error of a ratio whose fit takes the understeer gradient as constant.

    Curvature and lateral acceleration are nearly proportional at one speed, so that an understeer
    gradient that changes by `UNDERSTEER_CHANGE` with a standard deviation of the speed, or of |ay|,
    passes for a ratio.

    Parameters
    ----------
    columns : (4, N)
        Regressors: kinematic angle [rad], 1, ay [m/s²], derivative of the angle.
    speed : (N,)
        [m/s].
    ratio : float
        Of the fit.

    Returns
    -------
    float
        In units of the ratio; it includes LINKAGE_CHANGE.
    """
    ay = columns[2]
    weights = np.square(ay) / np.square(ay).sum()
    changes = []
    for quantity in (speed, np.abs(ay)):
        deviation = quantity - weights @ quantity
        spread = math.sqrt(weights @ np.square(deviation))
        if spread > 0.0:
            changes.append(ay * deviation / spread)
    shares = [np.linalg.lstsq(columns.T, change, rcond=None)[0][0] for change in changes]
    return abs(ratio) * math.hypot(LINKAGE_CHANGE, UNDERSTEER_CHANGE * math.hypot(*shares))


def _percent(share: float) -> str:
    """A share as a percentage with one decimal."""
    return f"{round(100.0 * share, 1) + 0.0:.1f} %"  # no -0.0


def _rounded(value: float) -> float:
    """A value rounded to six significant digits, as configurations show it."""
    return float(f"{value:.6g}")
