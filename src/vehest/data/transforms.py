"""What may be done to a recording before an estimator sees it; each transform says whether it is causal or offline."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
from scipy import signal

from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.derived import (
    AccelerationFromSpeed,
    Mode,
    ScaleToWheelbase,
    SideslipFromVelocity,
    SpeedFromWheels,
    SteeringCurve,
    SteeringRatio,
    VelocityFromSideslip,
)
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.limits import check_limit
from vehest.data.recording import Recording
from vehest.data.schema import validated

LONGEST_DIRECT = 8192
"""Taps up to which a filter is summed sample by sample; longer ones through their spectra."""
VALUES_AT_ONCE = 1 << 20
"""Samples that are compared at a time, windows included."""


class Transform(Protocol):
    """A pure function of a recording."""

    @property
    def mode(self) -> Mode:
        """``causal`` if no output sample depends on later input samples."""
        ...

    def __call__(self, recording: Recording) -> Recording:
        """Apply it."""
        ...


@dataclass(frozen=True)
class Resample:
    """Change the sampling rate by any rational ratio; the first sample keeps its time.

    ``polyphase`` applies a linear-phase FIR low-pass (Kaiser window) in polyphase form whose delay is compensated, so nothing is
    shifted and what lies above the new Nyquist frequency is removed before it can alias. ``decimate`` keeps every n-th sample as it is
    (integer ratios only), which is what a slower sensor or a naive logger would deliver.

    Args:
        rate_hz: the new rate [Hz].
        method: ``polyphase`` or ``decimate``.

    Source:
        Crochiere & Rabiner, Multirate Digital Signal Processing, 1983; `scipy.signal.resample_poly`.
    """

    rate_hz: float
    method: Literal["polyphase", "decimate"] = "polyphase"
    zero_crossings: ClassVar[int] = 16
    kaiser_beta: ClassVar[float] = 7.0
    cutoff: ClassVar[float] = 0.86  # of the slower Nyquist frequency, where the stop band has then begun

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rate_hz) and self.rate_hz > 0):
            raise ConfigurationError(f"the new sampling rate must be positive, not {self.rate_hz}")
        if self.method not in ("polyphase", "decimate"):
            raise ConfigurationError(f"resampling method '{self.method}' is not one of: polyphase, decimate")

    @property
    def mode(self) -> Mode:
        """Zero phase needs future samples."""
        return "causal" if self.method == "decimate" else "offline"

    def __call__(self, recording: Recording) -> Recording:
        """Resample every channel.

        Raises:
            DataError: the ratio is not one of small whole numbers, a gappy channel would need filtering, or the outcome or the filter
                would be longer than the limits.
            ConfigurationError: decimation by a ratio that is not whole.
        """
        expected = len(recording) * (self.rate_hz / recording.rate_hz)
        what = f"recording '{recording.id}' would hold {expected:.6g} samples at {self.rate_hz:g} Hz"
        check_limit("samples", expected, what)
        check_limit("values", expected * len(recording.channels), f"{what} in each of {len(recording.channels)} channels")
        up, down = self.ratio(recording)
        if up == down:
            return recording
        n_out = -(-len(recording) * up // down)
        if self.method == "decimate":
            if up != 1:
                raise ConfigurationError(
                    f"recording '{recording.id}': plain decimation from {recording.rate_hz:g} to {self.rate_hz:g} Hz is not a whole ratio; "
                    f"use method=polyphase"
                )
            channels = {name: samples[::down] for name, samples in recording.channels.items()}
        else:
            if recording.gappy:
                raise DataError(
                    f"recording '{recording.id}': channel '{sorted(recording.gappy)[0]}' has gaps and cannot be filtered; "
                    f"use method=decimate or leave the channel out"
                )
            reach = self.zero_crossings * max(up, down)
            ratio = f"resampling by {up}/{down}, from {recording.rate_hz:g} to {self.rate_hz:g} Hz"
            check_limit("filter_samples", 2 * reach + 1, f"recording '{recording.id}': {ratio}, needs a filter of {2 * reach + 1} samples")
            taps = self._taps(up, down)
            channels = {name: _resampled(samples, up, down, taps)[:n_out] for name, samples in recording.channels.items()}
        return replace(recording, rate_hz=float(self.rate_hz), channels=channels)

    def ratio(self, recording: Recording) -> tuple[int, int]:
        """Interpolation and decimation factors (up, down).

        Raises:
            DataError: the ratio is not one of small whole numbers.
        """
        exact = Fraction(self.rate_hz) / Fraction(recording.rate_hz)
        ratio = exact.limit_denominator(1000)
        if ratio == 0 or abs(ratio / exact - 1) > Fraction(1, 10**9):
            raise DataError(
                f"recording '{recording.id}': {self.rate_hz:g} Hz from {recording.rate_hz:g} Hz is not a ratio of whole numbers up to 1000"
            )
        return ratio.numerator, ratio.denominator

    def _taps(self, up: int, down: int) -> FloatArray:
        slower = max(up, down)
        half = self.zero_crossings * slower
        taps = signal.firwin(2 * half + 1, self.cutoff / slower, window=("kaiser", self.kaiser_beta))
        window = signal.get_window(("kaiser", self.kaiser_beta), len(taps), fftbins=False)
        lag = np.arange(-half, half + 1) / half
        for phase in range(up):  # every branch has unit gain at 0 Hz and no delay: a constant stays that constant, a line that line
            branch = slice(phase, None, up)
            taps[branch] /= up * taps[branch].sum()
            shapes = window[branch] * lag[branch] ** np.array([[0], [1]])
            moments = lag[branch] ** np.array([[0], [1]])
            excess = moments @ taps[branch] - np.array([1.0 / up, 0.0])
            taps[branch] -= np.linalg.solve(moments @ shapes.T, excess) @ shapes
        return taps


@dataclass(frozen=True)
class LowPass:
    """Remove what lies above a cut-off frequency.

    ``causal`` runs a second-order Butterworth filter forward, as a car would; ``zero_phase`` runs it both ways. A ``fir`` is symmetric
    (a sinc under a Hamming window), so that it has no phase, and cannot be causal.

    Args:
        cutoff_hz: -3 dB frequency of one pass; -6 dB of a ``fir`` [Hz].
        channels: which channels; all measured ones if empty, never references.
        direction: ``causal`` or ``zero_phase``.
        design: ``butterworth`` or ``fir``.
        reach: of a ``fir`` into past and future; the longer, the sharper its cut-off [s].

    Source: of the ``fir``, Oppenheim & Schafer, Discrete-Time Signal Processing, 2010, section 7.5.
    """

    cutoff_hz: float
    channels: tuple[str, ...] = ()
    direction: Literal["causal", "zero_phase"] = "zero_phase"
    design: Literal["butterworth", "fir"] = "butterworth"
    reach: float = 0.3

    def __post_init__(self) -> None:
        if self.direction not in ("causal", "zero_phase"):
            raise ConfigurationError(f"low-pass direction '{self.direction}' is not one of: causal, zero_phase")
        if self.design not in ("butterworth", "fir"):
            raise ConfigurationError(f"low-pass design '{self.design}' is not one of: butterworth, fir")
        if self.design == "fir" and self.direction == "causal":
            raise ConfigurationError("a low-pass of design fir sees as far ahead as back; use design=butterworth for a causal one")
        if not (math.isfinite(self.reach) and self.reach > 0):
            raise ConfigurationError(f"the reach of a low-pass must be positive, not {self.reach}")

    @property
    def mode(self) -> Mode:
        """Offline if it runs backwards too."""
        return "causal" if self.direction == "causal" else "offline"

    def __call__(self, recording: Recording) -> Recording:
        """Filter the channels.

        Raises:
            ConfigurationError: the cut-off is not below the Nyquist frequency, or so low, or the reach so long, that the filter is longer
                than the limit.
            DataError: a channel is missing or has gaps.
        """
        sections = self._sections(recording.rate_hz, f"recording '{recording.id}': ")
        settled = signal.sosfilt_zi(sections)

        def apply(samples: FloatArray) -> FloatArray:
            if self.design == "fir":
                return self._symmetric(samples, recording.rate_hz)
            if self.direction == "causal":
                return signal.sosfilt(sections, samples, zi=settled * samples[0])[0]
            return signal.sosfiltfilt(sections, samples, padlen=min(3 * len(sections) * 3, len(samples) - 1))

        return _with_changed(recording, self.channels, apply)

    def online(self, rate_hz: float) -> LowPassStepper:
        """The same for one sample at a time, as a car has them.

        Raises:
            ConfigurationError: it is not causal, or the cut-off is not below the Nyquist frequency.
        """
        if self.mode != "causal":
            raise ConfigurationError("a low-pass that sees later samples cannot run along with a drive; use direction=causal")
        return LowPassStepper(self._sections(rate_hz, ""), self.channels)

    def _sections(self, rate_hz: float, where: str) -> FloatArray:
        if not 0 < self.cutoff_hz < rate_hz / 2:
            raise ConfigurationError(f"{where}low-pass at {self.cutoff_hz:g} Hz must lie between 0 and {rate_hz / 2:g} Hz")
        length = rate_hz * (2 * self.reach if self.design == "fir" else 1 / self.cutoff_hz)
        what = f"{where}a low-pass at {self.cutoff_hz:g} Hz reaches over {length:.6g} samples"
        check_limit("filter_samples", length, what, ConfigurationError)
        return np.asarray(signal.butter(2, self.cutoff_hz, fs=rate_hz, output="sos"), dtype=np.float64)

    def _symmetric(self, samples: FloatArray, rate_hz: float) -> FloatArray:
        """By the ``fir``, on samples extended at both ends by odd reflection; a constant stays that constant, a line that line."""
        half = max(1, round(self.reach * rate_hz))
        taps = signal.firwin(2 * half + 1, self.cutoff_hz, fs=rate_hz, window="hamming")
        kind: dict[str, Any] = {"mode": "reflect", "reflect_type": "odd"} if len(samples) > 1 else {"mode": "edge"}
        convolve = np.convolve if len(taps) <= LONGEST_DIRECT else signal.oaconvolve
        return convolve(np.pad(samples, half, **kind), taps, mode="valid")


class LowPassStepper:
    """A causal low-pass, one sample at a time; settled at the first.

    Args:
        sections: second-order ones, (n, 6).
        channels: which channels; all that the first sample has if empty.
    """

    def __init__(self, sections: FloatArray, channels: tuple[str, ...] = ()) -> None:
        self._sections, self._channels = sections, channels
        self._states: dict[str, FloatArray] = {}

    def step(self, sample: Mapping[str, float]) -> dict[str, float]:
        """The sample with its channels filtered.

        Raises:
            DataError: a channel is missing, or its value is not finite.
        """
        filtered = dict(sample)
        for name in self._channels or tuple(sample):
            value = sample.get(name, math.nan)
            if not math.isfinite(value):
                raise DataError(f"the sample's '{name}' is {'missing' if name not in sample else value}, and cannot be filtered")
            if name not in self._states:
                self._states[name] = signal.sosfilt_zi(self._sections) * value
            (filtered[name],), self._states[name] = signal.sosfilt(self._sections, [value], zi=self._states[name])
        return {name: float(value) for name, value in filtered.items()}


@dataclass(frozen=True)
class RemoveOutliers:
    """Replace isolated spikes by the median of their neighbourhood (Hampel filter).

    Args:
        half_window: samples on either side that count as neighbours.
        threshold: how many scaled median absolute deviations make an outlier.
        channels: which channels; all measured ones if empty, never references.

    Source:
        Hampel, The influence curve and its role in robust estimation, JASA 69 (346), 1974.
    """

    half_window: int = 5
    threshold: float = 6.0
    channels: tuple[str, ...] = ()
    mode: ClassVar[Mode] = "offline"

    def __post_init__(self) -> None:
        if self.half_window < 1 or self.threshold <= 0:
            raise ConfigurationError(
                f"outlier removal needs half_window of 1 or more and a positive threshold, not {self.half_window} and {self.threshold}"
            )

    def __call__(self, recording: Recording) -> Recording:
        """Clean the channels.

        Raises:
            ConfigurationError: the windows hold more samples than the limits allow.
            DataError: a channel is missing or has gaps.
        """
        width = 2 * self.half_window + 1
        what = f"recording '{recording.id}': outlier removal over windows of {width} samples"
        check_limit("filter_samples", width, what, ConfigurationError)
        check_limit("values", width * len(recording), f"{what} compares {width * len(recording)} values a channel", ConfigurationError)
        at_once = max(VALUES_AT_ONCE // width, 1)

        def apply(samples: FloatArray) -> FloatArray:
            padded = np.pad(samples, self.half_window, mode="reflect" if len(samples) > 1 else "edge")
            cleaned = np.empty(len(samples))
            for begin in range(0, len(samples), at_once):
                inside = samples[begin : begin + at_once]
                neighbours = np.lib.stride_tricks.sliding_window_view(padded[begin : begin + len(inside) + width - 1], width)
                median = np.median(neighbours, axis=1)
                deviation = 1.4826 * np.median(np.abs(neighbours - median[:, None]), axis=1)
                spike = np.abs(inside - median) > self.threshold * deviation + 1e-12
                cleaned[begin : begin + len(inside)] = np.where(spike, median, inside)
            return cleaned

        return _with_changed(recording, self.channels, apply)


@dataclass(frozen=True)
class MountingCorrection:
    """Bring the accelerometer's readings to the centre of gravity and the vehicle's axes, in the plane.

    The sensor sits ``lever_x``, ``lever_y`` from the centre of gravity and is turned by ``yaw`` about the vertical axis:
    a_cg = R(yaw) a_sensor - dω/dt × l - ω × (ω × l).

    Args:
        lever_x: forward offset of the sensor from the centre of gravity [m].
        lever_y: leftward offset [m].
        yaw: rotation of the sensor's axes against the vehicle's, counter-clockwise [rad].

    Source:
        Rigid-body kinematics, e.g. Guiggiani, The Science of Vehicle Dynamics, 2018, section 3.2.
    """

    lever_x: float = 0.0
    lever_y: float = 0.0
    yaw: float = 0.0

    @property
    def mode(self) -> Mode:
        """With a lever arm the yaw acceleration is needed, taken by central differences."""
        return "causal" if self.lever_x == self.lever_y == 0.0 else "offline"

    def __call__(self, recording: Recording) -> Recording:
        """Correct ax and ay.

        Raises:
            DataError: ax, ay or yaw_rate is missing or has gaps.
        """
        _require_no_gaps(recording, ("ax", "ay", "yaw_rate"))
        ax, ay, yaw_rate = recording["ax"], recording["ay"], recording["yaw_rate"]
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        rotated_x, rotated_y = cosine * ax - sine * ay, sine * ax + cosine * ay
        if self.mode == "offline":
            yaw_acceleration = np.gradient(yaw_rate) * recording.rate_hz if len(yaw_rate) > 1 else np.zeros(1)
            rotated_x = rotated_x + yaw_acceleration * self.lever_y + yaw_rate**2 * self.lever_x
            rotated_y = rotated_y - yaw_acceleration * self.lever_x + yaw_rate**2 * self.lever_y
        return replace(recording, channels={**recording.channels, "ax": rotated_x, "ay": rotated_y})


@dataclass(frozen=True)
class ReferenceLever:
    """Move reference velocities from where their sensor sits to the centre of gravity: v_cg = v_sensor - ω × l.

    Args:
        lever_x: forward offset of the sensor from the centre of gravity [m].
        lever_y: leftward offset [m].

    Source:
        Rigid-body kinematics, as `MountingCorrection`; Bertipaglia et al. 2024, Section III-C moves an optical sensor on the bumper so.
    """

    lever_x: float = 0.0
    lever_y: float = 0.0
    mode: ClassVar[Mode] = "causal"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.lever_x) and math.isfinite(self.lever_y)):
            raise ConfigurationError(f"the lever of a reference must be numbers [m], not {self.lever_x} and {self.lever_y}")

    def __call__(self, recording: Recording) -> Recording:
        """Correct vy_ref, and vx_ref and sideslip_ref where they are there, by yaw_rate_ref or, without one, yaw_rate.

        Raises:
            DataError: vy_ref or the yaw rate is missing.
        """
        turning = "yaw_rate_ref" if "yaw_rate_ref" in recording else "yaw_rate"
        forward = {"vx_ref": recording["vx_ref"] + recording[turning] * self.lever_y} if "vx_ref" in recording else {}
        moved = {**forward, "vy_ref": recording["vy_ref"] - recording[turning] * self.lever_x}
        sources = {turning, *moved}
        if "sideslip_ref" in recording:
            speed = "vx_ref" if forward else "vx"
            sources.add(speed)
            moved["sideslip_ref"] = np.arctan2(moved["vy_ref"], forward.get("vx_ref", recording[speed]))
        gappy = recording.gappy | set(moved) if sources & recording.gappy else recording.gappy
        return replace(recording, channels={**recording.channels, **moved}, gappy=gappy)


@dataclass(frozen=True)
class DelayCorrection:
    """Bring channels that are late onto the clock of the others: each sample becomes what the sensor will show ``delay`` later.

    Between samples a band-limited interpolation (sinc under a Kaiser window) is used; it is within 0.1 % up to 0.8 of the Nyquist
    frequency. Where it would need samples that the recording does not have, the recording is cut: at either end by the reach of the
    interpolation, 16 samples, and by the delay at one of them.

    Args:
        delay: by how much the channels are late, negative if they are early [s].
        channels: which channels; all measured ones if empty, never references.

    Source:
        Laakso, Välimäki, Karjalainen & Laine, Splitting the unit delay, IEEE Signal Processing Magazine 13 (1), 1996.
    """

    delay: float
    channels: tuple[str, ...] = ()
    mode: ClassVar[Mode] = "offline"
    reach: ClassVar[int] = 16
    kaiser_beta: ClassVar[float] = 7.0

    def __post_init__(self) -> None:
        if not math.isfinite(self.delay):
            raise ConfigurationError(f"a delay must be a number of seconds, not {self.delay}")

    def __call__(self, recording: Recording) -> Recording:
        """Shift the channels, and cut the recording to the samples that then exist.

        Raises:
            DataError: a channel is missing or has gaps, or the recording is too short.
        """
        position = self.delay * recording.rate_hz
        if not abs(position) < len(recording):
            raise DataError(f"recording '{recording.id}' lasts {recording.duration:.3g} s, too short to be shifted by {self.delay:g} s")
        whole = round(position)
        fraction = position - whole
        if abs(fraction) < 1e-9:
            taps, reach = np.ones(1), 0
        else:
            taps, reach = self._taps(fraction), self.reach
        first, last = max(reach - whole, 0), len(recording) - max(reach + whole, 0)
        if first >= last:
            raise DataError(f"recording '{recording.id}' lasts {recording.duration:.3g} s, too short to be shifted by {self.delay:g} s")

        def apply(samples: FloatArray) -> FloatArray:
            # Output sample k is the sum of taps over the samples around k + whole.
            neighbours = np.lib.stride_tricks.sliding_window_view(samples, len(taps))
            shifted = np.full(len(samples), np.nan)
            shifted[first:last] = neighbours[first + whole - reach : last + whole - reach] @ taps
            return shifted[first:last]

        chosen = self.channels or tuple(name for name in recording.channels if not CHANNELS[name].is_reference)
        _require_no_gaps(recording, chosen)
        channels = {name: samples[first:last] for name, samples in recording.channels.items()}
        channels |= {name: apply(recording[name]) for name in chosen}
        return replace(recording, start_time=recording.start_time + first / recording.rate_hz, channels=channels)

    def _taps(self, fraction: float) -> FloatArray:
        distance = np.arange(-self.reach, self.reach + 1) - fraction
        inside = np.clip(1.0 - np.square(distance / (self.reach + 1)), 0.0, None)
        taps = np.sinc(distance) * np.i0(self.kaiser_beta * np.sqrt(inside)) / np.i0(self.kaiser_beta)
        return np.asarray(taps / taps.sum(), dtype=np.float64)  # a constant stays that constant


@dataclass(frozen=True)
class OffsetCorrection:
    """Take constant offsets off channels.

    Args:
        offsets: channel -> what its sensor shows too much, in the channel's unit.
    """

    offsets: Mapping[str, float] = field(hash=False)
    mode: ClassVar[Mode] = "causal"

    def __post_init__(self) -> None:
        if not isinstance(self.offsets, Mapping) or not self.offsets:
            raise ConfigurationError(f"offsets are a mapping from channels to values, such as {{ax: 0.1}}, not {self.offsets!r}")
        for name, value in self.offsets.items():
            if name not in CHANNELS:
                raise ConfigurationError(f"offset of '{name}': there is no such channel; 'vehest data channels' lists them")
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise ConfigurationError(f"offset of '{name}' must be a number, not {value!r}")
        object.__setattr__(self, "offsets", dict(self.offsets))

    def __call__(self, recording: Recording) -> Recording:
        """Subtract the offsets.

        Raises:
            DataError: a channel is missing.
        """
        changed = {name: recording[name] - value for name, value in self.offsets.items()}
        return replace(recording, channels={**recording.channels, **changed})


TRANSFORMS: dict[str, type] = {
    "resample": Resample,
    "low_pass": LowPass,
    "remove_outliers": RemoveOutliers,
    "mounting_correction": MountingCorrection,
    "reference_lever": ReferenceLever,
    "delay_correction": DelayCorrection,
    "offset_correction": OffsetCorrection,
    "steering_ratio": SteeringRatio,
    "steering_curve": SteeringCurve,
    "speed_from_wheels": SpeedFromWheels,
    "acceleration_from_speed": AccelerationFromSpeed,
    "velocity_from_sideslip": VelocityFromSideslip,
    "sideslip_from_velocity": SideslipFromVelocity,
    "scale_to_wheelbase": ScaleToWheelbase,
}


OF_REFERENCES = frozenset({"reference_lever", "velocity_from_sideslip", "sideslip_from_velocity"})
"""Transforms that read and change reference channels alone: a drive without a reference goes without them."""


@dataclass(frozen=True)
class Preparation:
    """How recordings are brought to an estimator's rate, as ``downsample`` of a configuration or of a model says it.

    Args:
        method: of `Resample`.
        transforms: applied before, at the native rate, each by its ``name`` and its arguments.
    """

    method: Literal["polyphase", "decimate"] = "polyphase"
    transforms: tuple[dict[str, Any], ...] = ()

    def __post_init__(self) -> None:
        for entry in self.transforms:
            transform_from_config(entry)

    def as_plain(self) -> dict[str, Any]:
        """As files hold it."""
        return {"method": self.method, "transforms": [dict(entry) for entry in self.transforms]}


def transform_from_config(config: Mapping[str, Any]) -> Transform:
    """Build a transform from plain values: its ``name`` and its arguments.

    Raises:
        ConfigurationError: an unknown name or argument.
    """
    if not isinstance(config, Mapping):
        raise ConfigurationError(f"a transform is a mapping with a name, such as {{name: low_pass, cutoff_hz: 5}}, not {config!r}")
    arguments = {str(key): value for key, value in config.items() if key != "name"}
    if isinstance(arguments.get("channels"), str):
        arguments["channels"] = [arguments["channels"]]
    name = config.get("name")
    if not isinstance(name, str) or name not in TRANSFORMS:
        raise ConfigurationError(f"transform '{name}' is not one of: {', '.join(TRANSFORMS)}")
    transform: Transform = validated(TRANSFORMS[name], arguments, f"transform '{name}'", error=ConfigurationError)
    return transform


def _resampled(samples: FloatArray, up: int, down: int, taps: FloatArray) -> FloatArray:
    """Polyphase filtering of samples extended at both ends by odd reflection, so that the ends do not ring."""
    reach = len(taps) // 2 // up + 1
    margin = -(-reach // down) * down  # whole steps of the output grid
    extended = np.pad(samples, margin, mode="reflect", reflect_type="odd") if len(samples) > 1 else np.pad(samples, margin, mode="edge")
    return signal.resample_poly(extended, up, down, window=taps)[margin * up // down :]


def _with_changed(recording: Recording, names: tuple[str, ...], change: Callable[[FloatArray], FloatArray]) -> Recording:
    chosen = names or tuple(name for name in recording.channels if not CHANNELS[name].is_reference)
    _require_no_gaps(recording, chosen)
    changed = {name: change(recording[name]) for name in chosen}
    return replace(recording, channels={**recording.channels, **changed})


def _require_no_gaps(recording: Recording, names: tuple[str, ...]) -> None:
    for name in names:
        if name in recording.gappy:
            raise DataError(f"recording '{recording.id}': channel '{name}' has gaps and cannot be filtered; leave it out")
