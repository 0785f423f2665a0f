"""Transforms of recordings before an estimator reads them: pure functions with settings, causal
unless they say otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cache
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import scipy
from pydantic import Field, PositiveFloat, PositiveInt

from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.derived import (
    AccelerationFromSpeed,
    ChannelName,
    ScaleToWheelbase,
    SideslipFromVelocity,
    SpeedFromWheels,
    SteeringCurve,
    SteeringRatio,
    VelocityFromSideslip,
    derivative,
    speed_of_reference,
)
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.limits import check_limit
from vehest.data.recording import Recording
from vehest.data.schema import validated

# taps up to which a filter is summed sample by sample; longer ones through their spectra
MAX_DIRECT_TAPS = 8192
OUTPUTS_AT_ONCE = 4096  # output samples that a resampling computes together
MOST_BRIDGED = 0.1  # largest share of a channel's samples that is bridged
VALUES_AT_ONCE = 1 << 20  # samples that are compared at a time, windows included


Transform = Callable[[Recording], Recording]  # function from a recording to a recording


@dataclass(frozen=True)
class Resample:
    """Change the sampling rate by any rational ratio; the first sample keeps its time.

    ``polyphase`` is offline: it applies a linear-phase FIR low-pass (Kaiser window) in polyphase
    form whose delay is compensated, so nothing is shifted and frequencies above the new Nyquist
    frequency are removed before they can alias. ``decimate`` keeps every n-th sample as it is
    (integer ratios only), as a slower sensor or a naive logger would.

    Source: Crochiere & Rabiner, Multirate Digital Signal Processing, 1983;
    `scipy.signal.resample_poly`.
    """

    rate_hz: float  # the new rate [Hz]
    method: Literal["polyphase", "decimate"] = "polyphase"  # ``polyphase`` or ``decimate``
    zero_crossings: ClassVar[int] = 16  # zero crossings of the filter's sinc on either side
    kaiser_beta: ClassVar[float] = 7.0  # shape of the Kaiser window
    # cut-off over the slower Nyquist frequency, at which the stop band has then begun
    cutoff: ClassVar[float] = 0.86

    def __post_init__(self) -> None:
        if not 0.0 < self.rate_hz < math.inf:
            raise ConfigurationError(
                f"resampling: rate_hz must be a positive number, not {self.rate_hz:g}"
            )

    def __call__(self, recording: Recording) -> Recording:
        """Resample every channel.

        Errors where the outcome or the filter is more than the limits, or a gappy channel needs
        filtering.
        """
        expected = len(recording) * (self.rate_hz / recording.rate_hz)
        problem = (
            f"recording '{recording.id}' would hold {expected:.6g} samples at {self.rate_hz:g} Hz"
        )
        check_limit("samples", expected, problem)
        check_limit(
            "memory",
            8 * expected * len(recording.channels),
            f"{problem} in each of {len(recording.channels)} channels",
        )
        exact = Fraction(self.rate_hz) / Fraction(recording.rate_hz)
        ratio = exact.limit_denominator(1000)
        if ratio == 0 or abs(ratio / exact - 1) > Fraction(1, 10**9):
            raise DataError(
                f"recording '{recording.id}': {self.rate_hz:g} Hz from {recording.rate_hz:g} Hz is "
                "not a ratio of whole numbers up to 1000"
            )
        up = ratio.numerator
        down = ratio.denominator
        if up == down:
            return recording
        if self.method == "decimate":
            if up != 1:
                raise ConfigurationError(
                    f"recording '{recording.id}': plain decimation from {recording.rate_hz:g} to "
                    f"{self.rate_hz:g} Hz is not a whole ratio; use method=polyphase"
                )
            channels = {name: samples[::down] for name, samples in recording.channels.items()}
        else:
            length = 2 * self.zero_crossings * max(up, down) + 1
            check_limit(
                "filter_samples",
                length,
                f"recording '{recording.id}': resampling by {up}/{down} needs a filter of "
                f"{length} samples",
            )
            names = _without_gaps(recording, tuple(recording.channels))
            taps = self.taps(up, down)
            n_out = -(-len(recording) * up // down)
            channels = {name: _resampled(recording[name], up, down, taps, n_out) for name in names}
        return replace(recording, rate_hz=self.rate_hz, channels=channels)

    @classmethod
    def reach(cls, ratio: Fraction) -> int:
        """Largest distance, in input samples, of the samples on which an output depends, rounded up
        to whole steps of the new clock.
        """
        up = ratio.numerator
        down = ratio.denominator
        return -(-(cls.zero_crossings * max(up, down) // up + 1) // down) * down

    def taps(self, up: int, down: int) -> FloatArray:
        """Coefficients of the anti-aliasing filter at ``up`` times the rate of the recording.

        Parameters
        ----------
        up, down : int
            Ratio of the new rate to that of the recording, up / down.

        Returns
        -------
        FloatArray
            Shape (2 half + 1,), with half ``zero_crossings`` times the larger of both. Each of the
            ``up`` branches keeps constants and straight lines.
        """
        slower = max(up, down)
        half = self.zero_crossings * slower
        taps, window = windowed_sinc(half, self.cutoff / slower, self.kaiser_beta)
        lag = np.arange(-half, half + 1) / half
        # Every branch has unit gain at 0 Hz and no delay: a constant stays that constant, a line
        # that line.
        for phase in range(up):
            branch = slice(phase, None, up)
            taps[branch] /= up * taps[branch].sum()
            shapes = window[branch] * lag[branch] ** np.array([[0], [1]])
            moments = lag[branch] ** np.array([[0], [1]])
            excess = moments @ taps[branch] - np.array([1.0 / up, 0.0])
            taps[branch] -= np.linalg.solve(moments @ shapes.T, excess) @ shapes
        return taps


@dataclass(frozen=True)
class LowPass:
    """Remove frequencies above a cut-off.

    ``causal`` runs a second-order Butterworth filter forward, as a car would; ``zero_phase`` runs
    it both ways, offline. A ``fir`` is symmetric (a sinc under a Hamming window), so that it has no
    phase, and cannot be causal.

    Source: of the ``fir``, Oppenheim & Schafer, Discrete-Time Signal Processing, 2010, section 7.5.
    """

    cutoff_hz: float  # -3 dB frequency of one pass; -6 dB of a ``fir`` [Hz]
    # names of the channels; all measured ones if empty, never references
    channels: tuple[str, ...] = ()
    direction: Literal["causal", "zero_phase"] = "zero_phase"  # ``causal`` or ``zero_phase``
    design: Literal["butterworth", "fir"] = "butterworth"  # ``butterworth`` or ``fir``
    # length of a ``fir`` into past and future [s]; the longer, the sharper its cut-off
    reach: PositiveFloat = 0.3

    def __post_init__(self) -> None:
        if self.design == "fir" and self.direction == "causal":
            raise ConfigurationError(
                "a low-pass of design fir needs as many later samples as earlier ones; use "
                "design=butterworth for a causal one"
            )

    def __call__(self, recording: Recording) -> Recording:
        """Filter the channels.

        Errors where one is missing or has gaps, or the cut-off does not suit the rate or the
        limits.
        """
        subject = f"recording '{recording.id}'"
        rate_hz = recording.rate_hz
        if not 0 < self.cutoff_hz < rate_hz / 2:
            raise ConfigurationError(
                f"{subject}: low-pass at {self.cutoff_hz:g} Hz must lie between 0 and "
                f"{rate_hz / 2:g} Hz"
            )
        length = rate_hz * (2 * self.reach if self.design == "fir" else 1 / self.cutoff_hz)
        problem = (
            f"{subject}: a low-pass at {self.cutoff_hz:g} Hz reaches over {length:.6g} samples"
        )
        check_limit("filter_samples", length, problem, ConfigurationError)
        sections = scipy.signal.butter(2, self.cutoff_hz, fs=rate_hz, output="sos")

        def filtered(samples: FloatArray) -> FloatArray:
            if self.design == "fir":
                return self._symmetric(samples, rate_hz)
            if self.direction == "causal":
                return scipy.signal.sosfilt(
                    sections, samples, zi=scipy.signal.sosfilt_zi(sections) * samples[0]
                )[0]
            return scipy.signal.sosfiltfilt(
                sections, samples, padlen=min(3 * len(sections) * 3, len(samples) - 1)
            )

        return recording.with_channels(
            {name: filtered(recording[name]) for name in _without_gaps(recording, self.channels)}
        )

    def _symmetric(self, samples: FloatArray, rate_hz: float) -> FloatArray:
        """Samples filtered by the ``fir``, with both ends extended by odd reflection.

        A constant stays that constant, a line that line.
        """
        half = max(1, round(self.reach * rate_hz))
        taps = scipy.signal.firwin(2 * half + 1, self.cutoff_hz, fs=rate_hz, window="hamming")
        convolve = np.convolve if len(taps) <= MAX_DIRECT_TAPS else scipy.signal.oaconvolve
        return convolve(_extended(samples, half), taps, mode="valid")


@dataclass(frozen=True)
class RemoveOutliers:
    """Replace isolated spikes by the median of their neighbourhood (Hampel filter); offline.

    Source: Hampel, The influence curve and its role in robust estimation, JASA 69 (346), 1974.
    """

    half_window: PositiveInt = 5  # samples on either side that count as neighbours
    # number of scaled median absolute deviations beyond which a sample is an outlier
    threshold: PositiveFloat = 6.0
    # names of the channels; all measured ones if empty, never references
    channels: tuple[str, ...] = ()

    def __call__(self, recording: Recording) -> Recording:
        """Clean the channels.

        Errors where one is missing or has gaps, or the windows are more than the limits.
        """
        width = 2 * self.half_window + 1
        problem = f"recording '{recording.id}': outlier removal over windows of {width} samples"
        check_limit("filter_samples", width, problem, ConfigurationError)
        check_limit(
            "memory",
            8 * width * len(recording),
            f"{problem} compares {width * len(recording)} values a channel",
            ConfigurationError,
        )
        at_once = max(VALUES_AT_ONCE // width, 1)

        def cleaned(samples: FloatArray) -> FloatArray:
            padded = np.pad(
                samples, self.half_window, mode="reflect" if len(samples) > 1 else "edge"
            )
            result = np.empty(len(samples))
            for begin in range(0, len(samples), at_once):
                inside = samples[begin : begin + at_once]
                neighbours = np.lib.stride_tricks.sliding_window_view(
                    padded[begin : begin + len(inside) + width - 1], width
                )
                median = np.median(neighbours, axis=1)
                deviation = 1.4826 * np.median(np.abs(neighbours - median[:, None]), axis=1)
                spike = np.abs(inside - median) > self.threshold * deviation + 1e-12
                result[begin : begin + len(inside)] = np.where(spike, median, inside)
            return result

        return recording.with_channels(
            {name: cleaned(recording[name]) for name in _without_gaps(recording, self.channels)}
        )


@dataclass(frozen=True)
class BridgeImpossible:
    """Replace samples beyond what a vehicle can do by straight lines, in channels with a few of
    them.

    offline.
    """

    # reach of a line to either side, where a slower signal was interpolated [s]
    beside: Annotated[float, Field(ge=0.0)] = 0.0

    def __call__(self, recording: Recording) -> Recording:
        """Bridge them; a channel with more than a tenth of them stays, whose unit is then wrong."""
        around = np.ones(2 * round(self.beside * recording.rate_hz) + 1)
        places = np.arange(len(recording))
        changed = {}
        for name, samples in recording.channels.items():
            is_impossible = (samples < CHANNELS[name].low) | (samples > CHANNELS[name].high)
            if (
                is_impossible.any()
                and (
                    near := np.convolve(is_impossible, around)[len(around) // 2 :][
                        : len(is_impossible)
                    ]
                    > 0.5
                ).mean()
                <= MOST_BRIDGED
            ):
                changed[name] = np.where(
                    near, np.interp(places, places[~near], samples[~near]), samples
                )
        return recording.with_channels(changed)


@dataclass(frozen=True)
class MountingCorrection:
    """Bring the accelerometer's readings to the centre of gravity and the vehicle's axes, in the
    plane.

    The sensor sits ``lever_x``, ``lever_y`` from the centre of gravity and is turned by ``yaw``
    about the vertical axis: a_cg = R(yaw) a_sensor - dω/dt × l - ω × (ω × l). With a lever arm it
    is offline: dω/dt is taken by central differences.

    Source: Rigid-body kinematics, e.g. Guiggiani, The Science of Vehicle Dynamics, 2018, section
    3.2.
    """

    lever_x: float = 0.0  # forward offset of the sensor from the centre of gravity [m]
    lever_y: float = 0.0  # leftward offset [m]
    yaw: float = 0.0  # rotation of the sensor's axes against the vehicle's, counter-clockwise [rad]

    def __call__(self, recording: Recording) -> Recording:
        """Correct ax and ay.

        Raises
        ------
        DataError
            One of ax, ay and yaw_rate is missing or has gaps.
        """
        ax, ay, yaw_rate = (
            recording[name] for name in _without_gaps(recording, ("ax", "ay", "yaw_rate"))
        )
        cosine = math.cos(self.yaw)
        sine = math.sin(self.yaw)
        rotated_x = cosine * ax - sine * ay
        rotated_y = sine * ax + cosine * ay
        if self.lever_x or self.lever_y:
            yaw_acceleration = derivative(yaw_rate, recording.rate_hz)
            rotated_x = rotated_x + yaw_acceleration * self.lever_y + yaw_rate**2 * self.lever_x
            rotated_y = rotated_y - yaw_acceleration * self.lever_x + yaw_rate**2 * self.lever_y
        return recording.with_channels({"ax": rotated_x, "ay": rotated_y})


@dataclass(frozen=True)
class ReferenceLever:
    """Move reference velocities from where their sensor sits to the centre of gravity: v_cg =
    v_sensor - ω × l.

    Source: Rigid-body kinematics, as `MountingCorrection`; Bertipaglia et al. 2024, Section III-C
    moves an optical sensor on the bumper so.
    """

    lever_x: float = 0.0  # forward offset of the sensor from the centre of gravity [m]
    lever_y: float = 0.0  # leftward offset [m]

    def __call__(self, recording: Recording) -> Recording:
        """Correct vy_ref, and vx_ref and sideslip_ref where they are there, by yaw_rate_ref or,
        without one, yaw_rate.
        """
        turning = "yaw_rate_ref" if "yaw_rate_ref" in recording else "yaw_rate"
        moved = (
            {"vx_ref": recording["vx_ref"] + recording[turning] * self.lever_y}
            if "vx_ref" in recording
            else {}
        )
        moved["vy_ref"] = recording["vy_ref"] - recording[turning] * self.lever_x
        made_of = {turning, *moved}
        if "sideslip_ref" in recording:
            speed = speed_of_reference(recording)
            made_of.add(speed)
            moved["sideslip_ref"] = np.arctan2(moved["vy_ref"], moved.get(speed, recording[speed]))
        return recording.with_channels(moved, made_of if made_of & recording.gappy else None)


@dataclass(frozen=True)
class DelayCorrection:
    """Bring channels that are late onto the clock of the others: each sample becomes the sensor's
    value ``delay`` later; offline.

    Between samples a band-limited interpolation (sinc under a Kaiser window) is used; it is within
    0.1 % up to 0.8 of the Nyquist frequency. Where it would need samples that the recording does
    not have, the recording is cut: at either end by the reach of the interpolation, 16 samples, and
    by the delay at one of them.

    Source: Laakso, Välimäki, Karjalainen & Laine, Splitting the unit delay, IEEE Signal Processing
    Magazine 13 (1), 1996.
    """

    delay: float  # by how much the channels are late, negative if they are early [s]
    # names of the channels; all measured ones if empty, never references
    channels: tuple[str, ...] = ()
    reach: ClassVar[int] = 16  # samples on either side that the interpolation uses
    kaiser_beta: ClassVar[float] = 7.0  # shape of the Kaiser window

    def __call__(self, recording: Recording) -> Recording:
        """Shift the channels, and cut the recording to the samples that then exist."""
        length = len(recording)
        position = self.delay * recording.rate_hz
        n_samples = round(min(max(position, -length), length))
        fraction = position - n_samples
        reach = 0 if abs(fraction) < 1e-9 else self.reach
        first = max(reach - n_samples, 0)
        last = length - max(reach + n_samples, 0)
        if first >= last:
            raise DataError(
                f"recording '{recording.id}' lasts {recording.duration:.3g} s, too short to be "
                f"shifted by {self.delay:g} s"
            )
        taps = self._taps(fraction) if reach else np.ones(1)
        channels = {name: samples[first:last] for name, samples in recording.channels.items()}
        for name in _without_gaps(
            recording, self.channels
        ):  # output sample k is the sum of taps over the samples around k + whole
            neighbours = np.lib.stride_tricks.sliding_window_view(recording[name], len(taps))
            channels[name] = neighbours[first + n_samples - reach : last + n_samples - reach] @ taps
        return replace(
            recording,
            start_time=recording.start_time + first / recording.rate_hz,
            channels=channels,
        )

    def _taps(self, fraction: float) -> FloatArray:
        """Weights of the 2 reach + 1 samples about a place that lies ``fraction`` of an interval
        behind the middle one.

        A sinc under a Kaiser window, whose sum is 1.
        """
        distance = np.arange(-self.reach, self.reach + 1) - fraction
        inside = np.clip(1.0 - np.square(distance / (self.reach + 1)), 0.0, None)
        taps = (
            np.sinc(distance) * np.i0(self.kaiser_beta * np.sqrt(inside)) / np.i0(self.kaiser_beta)
        )
        return np.asarray(taps / taps.sum(), dtype=np.float64)  # a constant stays that constant


@dataclass(frozen=True)
class OffsetCorrection:
    """Subtract constant offsets from channels."""

    # channel -> offset in its unit
    offsets: Annotated[dict[ChannelName, float], Field(min_length=1)] = field(hash=False)

    def __call__(self, recording: Recording) -> Recording:
        """Subtract the offsets.

        Raises
        ------
        DataError
            A channel is missing.
        """
        return recording.with_channels(
            {name: recording[name] - value for name, value in self.offsets.items()}
        )


# name in a configuration -> transform
TRANSFORMS: dict[str, type[Any]] = {
    "resample": Resample,
    "low_pass": LowPass,
    "remove_outliers": RemoveOutliers,
    "bridge_impossible": BridgeImpossible,
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
"""Transforms that read and change reference channels alone: a drive without a reference goes
without them.
"""


@dataclass(frozen=True)
class Preparation:
    """Resampling of recordings to an estimator's rate: ``downsample`` of a configuration or of a
    model.
    """

    method: Literal["polyphase", "decimate"] = "polyphase"  # method of `Resample`
    # applied before, at the native rate, each by its ``name`` and its arguments
    transforms: tuple[dict[str, Any], ...] = ()

    def __post_init__(self) -> None:
        for entry in self.transforms:
            transform_from_config(entry)

    def as_plain(self) -> dict[str, Any]:
        """Plain values, as files hold them."""
        return {"method": self.method, "transforms": [dict(entry) for entry in self.transforms]}


def transform_from_config(config: Mapping[str, Any]) -> Transform:
    """Build a transform from plain values: its ``name`` and its arguments.

    Raises
    ------
    ConfigurationError
        An unknown name or argument.
    """
    if not isinstance(config, Mapping):
        raise ConfigurationError(
            f"a transform is a mapping with a name, such as {{name: low_pass, cutoff_hz: 5}}, not "
            f"{config!r}"
        )
    arguments = {str(key): value for key, value in config.items() if key != "name"}
    if isinstance(arguments.get("channels"), str):
        arguments["channels"] = [arguments["channels"]]
    name = config.get("name")
    if not isinstance(name, str) or name not in TRANSFORMS:
        raise ConfigurationError(f"transform '{name}' is not one of: {', '.join(TRANSFORMS)}")
    return validated(TRANSFORMS[name], arguments, f"transform '{name}'", error=ConfigurationError)


def windowed_sinc(half: int, cutoff: float, beta: float) -> tuple[FloatArray, FloatArray]:
    """Taps of a low-pass of unit gain at 0 Hz, and their Kaiser window, (2 half + 1,); ``cutoff``
    in Nyquist frequencies.

    As by `scipy.signal.firwin` to the bit, which takes a second to import.

    Parameters
    ----------
    half : int
        Taps on either side of the middle one, 1 or more.
    cutoff : float
        Frequency at which the gain is about a half, from 0 to 1.
    beta : float
        Shape of the Kaiser window.
    """
    place = np.arange(2 * half + 1) - float(half)
    window = scipy.special.i0(beta * np.sqrt(1 - (place / half) ** 2)) / scipy.special.i0(beta)
    taps = cutoff * np.sinc(cutoff * place) * window
    return taps / taps.sum(), window


def _resampled(samples: FloatArray, up: int, down: int, taps: FloatArray, n_out: int) -> FloatArray:
    """Polyphase filtering of samples that are extended at both ends, so that the ends do not ring;
    (T,) -> (n_out,).

    Sums run over the samples in their order, as in `scipy.signal.resample_poly`, for many outputs
    at once.
    """
    half = len(taps) // 2
    margin = -(-(half // up + 1) // down) * down  # whole steps of the output grid
    extended = _extended(samples, margin)
    rows = np.ascontiguousarray(
        np.pad(extended, (0, -len(extended) % down)).reshape(-1, down).T
    )  # (down, steps)
    filtered = np.zeros(n_out)
    _compiled_sums()(rows, up * taps, up, margin * up + half, filtered)
    return filtered


@cache
def _compiled_sums() -> Callable[..., None]:
    """`_sums` compiled, imported on first use, so that this module does not import numba."""
    import numba

    compiled = numba.njit(cache=True, nogil=True, error_model="numpy")
    return compiled(_sums)  # type: ignore[no-any-return]


def _sums(rows, taps, up, newest, filtered):  # type: ignore[no-untyped-def]
    """Add the contribution of each sample to the outputs.

    ``newest``: place of the first output's last tap on the grid of up times the rate.
    """
    down = len(rows)
    sums = np.empty(OUTPUTS_AT_ONCE)
    for begin in range(0, len(filtered), OUTPUTS_AT_ONCE * up):
        for phase in range(min(up, len(filtered) - begin)):
            count = min((len(filtered) - begin - phase + up - 1) // up, OUTPUTS_AT_ONCE)
            sums[:] = 0.0
            last = newest + phase * down
            for sample in range(-((len(taps) - 1 - last) // up), last // up + 1):
                row = rows[sample % down]
                first = np.uint64(sample // down + begin // up)
                tap = taps[last - up * sample]
                for i in range(count):
                    sums[i] += row[first + np.uint64(i)] * tap
            for i in range(count):
                filtered[begin + phase + i * up] = sums[i]


def _extended(samples: FloatArray, margin: int) -> FloatArray:
    """Samples with ``margin`` more at both ends, by odd reflection."""
    return (
        np.pad(samples, margin, mode="reflect", reflect_type="odd")
        if len(samples) > 1
        else np.pad(samples, margin, mode="edge")
    )


def _without_gaps(recording: Recording, names: tuple[str, ...]) -> tuple[str, ...]:
    """The given channels, or all measured ones where none are given; raises an error where one of
    them has gaps.

    Refused where one of the channels has gaps.
    """
    chosen = names or tuple(name for name in recording.channels if not CHANNELS[name].is_reference)
    for name in chosen:
        if name in recording.gappy:
            problem = f"channel '{name}' has gaps and cannot be filtered"
            raise DataError(
                f"recording '{recording.id}': {problem}; leave it out, or resample with "
                "method=decimate"
            )
    return chosen
