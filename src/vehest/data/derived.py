"""Transforms that make channels which a log lacks from others, causal unless they say otherwise."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal

import numpy as np
import scipy
from pydantic import AfterValidator, NonNegativeFloat, PositiveFloat

from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.errors import ConfigurationError, DataError
from vehest.data.recording import DERIVED, Recording

WHEELS = ("fl", "fr", "rl", "rr")  # suffixes of the channels of the four wheels
# m/s, speed below which a sideslip angle of 90 degrees or more has no meaning and gives ``vy_ref``
# 0
STANDSTILL_SPEED = 0.1
AX_OF_SPEED = "acceleration_from_speed"  # name of the transform that derives ax from the speed


def _checked_channel(name: str) -> str:
    """The name itself; `ValueError` where there is no such channel."""
    if name not in CHANNELS:
        raise ValueError(f"there is no channel '{name}'; 'vehest data channels' lists them")
    return name


ChannelName = Annotated[str, AfterValidator(_checked_channel)]  # name of a channel of the table


def has_measured_ax(recording: Recording) -> bool:
    """Whether a recording has an ax that no transform of its data set made from the speed.

    d(vx)/dt lacks the term -vy·yaw_rate of a measured acceleration: to a filter that compares both
    it says that the car does not slip.
    """
    derived = recording.provenance.get(DERIVED)
    transforms = derived.get("transforms", ()) if isinstance(derived, Mapping) else ()
    return "ax" in recording and all(entry.get("name") != AX_OF_SPEED for entry in transforms)


def derivative(samples: FloatArray, rate_hz: float) -> FloatArray:
    """Central differences of samples, shape (T,) [unit/s]."""
    return np.gradient(samples) * rate_hz if len(samples) > 1 else np.zeros(1)


@dataclass(frozen=True)
class SteeringRatio:
    """Make the road-wheel angle ``steer`` from another angle: steer = (angle - offset) / ratio."""

    ratio: float  # angle for a unit of ``steer``; negative if it counts the other way
    offset: float = 0.0  # angle that is shown straight ahead [rad]
    channel: ChannelName = "handwheel"  # the angle; ``steer`` itself may be it

    def __post_init__(self) -> None:
        if self.ratio == 0.0:
            raise ConfigurationError("a steering ratio must be a number other than zero")

    def __call__(self, recording: Recording) -> Recording:
        """Set ``steer``.

        It has gaps where the angle has them.

        Raises
        ------
        DataError
            The channel is missing.
        """
        steer = (recording[self.channel] - self.offset) / self.ratio
        return recording.with_channels({"steer": steer}, made_of=(self.channel,))


@dataclass(frozen=True)
class SteeringCurve:
    """Make the road-wheel angle ``steer`` from a command or an angle by a curve of straight pieces,
    as of a linkage that is not linear.
    """

    inputs: tuple[float, ...]  # values of the channel at the corners, increasing
    # road-wheel angle at each [rad]; beyond the first and last corner the curve is flat
    angles: tuple[float, ...]
    channel: ChannelName = "steer"  # channel to which the curve is applied; it may be ``steer``

    def __post_init__(self) -> None:
        if (
            len(self.inputs) != len(self.angles)
            or len(self.inputs) < 2
            or not np.all(np.diff(self.inputs) > 0)
        ):
            raise ConfigurationError(
                "a steering curve needs two corners or more: inputs that increase, and as many "
                "angles"
            )

    def __call__(self, recording: Recording) -> Recording:
        """Set ``steer``.

        It has gaps where the channel has them.

        Raises
        ------
        DataError
            The channel is missing.
        """
        steer = np.interp(recording[self.channel], self.inputs, self.angles)
        return recording.with_channels({"steer": steer}, made_of=(self.channel,))


@dataclass(frozen=True)
class SpeedFromWheels:
    """Make the forward speed ``vx`` from wheel speeds, each brought to the centre of gravity,
    without those that slip or dropped out.

        u_FL = ω_FL R cos δ + r t_F/2,   u_FR = ω_FR R cos δ - r t_F/2,   u_RL = ω_RL R + r t_R/2,
        u_RR = ω_RR R - r t_R/2

    A wheel counts while it is within ``tolerance`` of their median, and ``vx`` is the mean of those
    that count, which moves by no more than ``most_acceleration`` allows. Where fewer than two
    count, ``ax`` carries the speed on (or nothing, where there is no ``ax``), for ``hold_seconds``;
    after them the median counts, since something must. Wheels that the recording does not have do
    not count; one alone counts as it is. Without ``steer`` the front wheels point straight ahead.

    Source: Di Biase, Lenzo & Timpone 2020, Eqs. 61 to 64, after Selmanaj et al. 2017; the check of
    plausibility is vehest's own.
    """

    wheel_radius: PositiveFloat  # rolling radius R [m]
    track_front: NonNegativeFloat = 0.0  # t_F [m]; 0: not known
    track_rear: NonNegativeFloat = 0.0  # t_R [m]; the same
    tolerance: PositiveFloat = 0.3  # absolute part of it [m/s]; 5 % of the median come on top
    most_acceleration: PositiveFloat = 12.0  # of the car, forwards or backwards [m/s²]
    hold_seconds: PositiveFloat = 2.0  # for how long ``vx`` goes on without two wheels [s]
    # part of the tolerance that is proportional to the median
    relative_tolerance: ClassVar[float] = 0.05

    def corrected(self, recording: Recording) -> FloatArray:
        """Speeds of the centre of gravity by each wheel, (4, T) [m/s]: front left, front right,
        rear left, rear right; NaN without it.

        Raises
        ------
        DataError
            There is no wheel speed at all, or tracks are given and ``yaw_rate`` is missing.
        """
        names = [f"wheel_speed_{wheel}" for wheel in WHEELS]
        if not set(names) & set(recording.channels):
            raise DataError(
                f"recording '{recording.id}' has no wheel speed to make vx of; declare one of "
                f"{', '.join(names)}"
            )
        missing = np.full(len(recording), np.nan)
        wheels = self.wheel_radius * np.stack(
            [recording.channels.get(name, missing) for name in names]
        )
        if "steer" in recording:
            wheels[:2] *= np.cos(recording["steer"])
        if not (self.track_front or self.track_rear):
            return wheels
        sides = 0.5 * np.array(
            [self.track_front, -self.track_front, self.track_rear, -self.track_rear]
        )
        return wheels + sides[:, None] * recording["yaw_rate"]

    def __call__(self, recording: Recording) -> Recording:
        """Set ``vx``, without gaps, since wheels that were not measured do not count.

        `DataError` if none ever was.
        """
        speeds = self.corrected(recording)
        with warnings.catch_warnings(
            action="ignore", category=RuntimeWarning
        ):  # where no wheel was measured the median is NaN
            medians = np.nanmedian(speeds, axis=0)
        counts = np.abs(speeds - medians) <= self.tolerance + self.relative_tolerance * np.abs(
            medians
        )
        if not np.isfinite(speeds).any():
            raise DataError(
                f"recording '{recording.id}': no wheel speed was measured together with yaw_rate "
                "and steer; vx cannot be made"
            )
        enough = min(2, sum(f"wheel_speed_{wheel}" in recording for wheel in WHEELS))
        step = 1.0 / recording.rate_hz
        max_change = self.most_acceleration * step
        patience = round(min(self.hold_seconds * recording.rate_hz, len(recording)))
        number = counts.sum(0)
        mean = np.where(counts, speeds, 0.0).sum(0) / np.maximum(number, 1)
        ahead = (
            np.nan_to_num(recording["ax"]) * step if "ax" in recording else np.zeros(len(recording))
        )
        vx = np.empty(len(recording))
        n_samples_carried = 0
        now = math.nan
        rows = zip(mean.tolist(), number.tolist(), medians.tolist(), ahead.tolist(), strict=True)
        for k, (wheels, agreeing, median, gain) in enumerate(rows):
            n_samples_carried = 0 if agreeing >= enough else n_samples_carried + 1
            target = wheels if agreeing >= enough else median
            if math.isnan(now):
                now = target
            elif (n_samples_carried and n_samples_carried <= patience) or math.isnan(target):
                now += gain
            else:
                now += min(max(target - now, -max_change), max_change)
            vx[k] = now
        if not np.isfinite(vx).any():
            raise DataError(
                f"recording '{recording.id}': no speed comes of the wheels; check wheel_radius and "
                "the tracks"
            )
        vx[: int(np.isnan(vx).sum())] = vx[np.isfinite(vx)][
            0
        ]  # before the first wheel was measured
        return recording.with_channels({"vx": vx}, made_of=())


@dataclass(frozen=True)
class AccelerationFromSpeed:
    """Make the longitudinal acceleration ``ax`` from a speed: ax ≈ dvx/dt, low-passed.

    An accelerometer shows du/dt - v·r; the second term is left out, since v is unknown. It is small
    where sideslip is: 0.2 m/s² for v = 0.5 m/s and r = 0.4 rad/s.

    Source: Rigid-body kinematics, e.g. Da Lio et al. 2023, Eq. 4b.
    """

    channel: Literal["vx", "vx_ref"] = "vx"  # the speed; ``vx`` or ``vx_ref``
    cutoff_hz: PositiveFloat = 5.0  # cut-off of a Butterworth filter of second order [Hz]
    # ``causal``, late by 1.41/(2π·cutoff_hz) and half a sample, or ``zero_phase``
    direction: Literal["causal", "zero_phase"] = "causal"

    def __call__(self, recording: Recording) -> Recording:
        """Set ``ax``.

        Raises
        ------
        DataError
            The speed is missing or has gaps, or the cut-off lies beyond half the sampling rate.
        """
        speed = recording[self.channel]
        rate = recording.rate_hz
        if np.isnan(speed).any():
            raise DataError(
                f"recording '{recording.id}': channel '{self.channel}' has gaps, so no ax can be "
                "made of it"
            )
        if not self.cutoff_hz < rate / 2:
            raise DataError(
                f"recording '{recording.id}': cutoff_hz must lie below half of {rate:g} Hz, not at "
                f"{self.cutoff_hz:g}"
            )
        sections = scipy.signal.butter(2, self.cutoff_hz, fs=rate, output="sos")
        if self.direction == "causal":
            ax = scipy.signal.sosfilt(sections, np.diff(speed, prepend=speed[0]) * rate)
        else:
            ax = scipy.signal.sosfiltfilt(
                sections, derivative(speed, rate), padlen=min(9, len(speed) - 1)
            )
        return recording.with_channels({"ax": ax}, made_of=())


@dataclass(frozen=True)
class VelocityFromSideslip:
    """Make the reference ``vy_ref`` from ``sideslip_ref``, as an optical sensor gives it: v = u·tan
    β.

    It holds where the angle was measured; `ReferenceLever`, or ``reference_point`` of a data set,
    moves it from there.

    Attributes
    ----------
    min_speed : float
        Speed below which the angle has no meaning, so that ``vy_ref`` is 0 [m/s].
    """

    min_speed: NonNegativeFloat = 0.0

    def __call__(self, recording: Recording) -> Recording:
        """Set ``vy_ref``, by ``vx_ref`` or, without one, ``vx``; it has gaps where the angle or the
        speed has them.

        At standstill, where the angle means nothing, 90 degrees and more become 0.
        """
        speed = speed_of_reference(recording)
        angle = recording["sideslip_ref"]
        if self.min_speed:
            angle = np.where(np.abs(recording[speed]) < self.min_speed, 0.0, angle)
        is_sideways = np.abs(angle) >= 0.5 * np.pi
        moving = is_sideways & ~(np.abs(recording[speed]) < STANDSTILL_SPEED)
        if moving.any():
            worst = int(np.argmax(np.where(moving, np.abs(angle), 0.0)))
            raise DataError(
                f"recording '{recording.id}': sideslip_ref is {angle[worst]:.4g} rad at "
                f"{recording.time[worst]:.12g} s; lateral velocity follows from less than 90 "
                "degrees only"
            )
        return recording.with_channels(
            {"vy_ref": recording[speed] * np.tan(np.where(is_sideways, 0.0, angle))},
            made_of=("sideslip_ref", speed),
        )


@dataclass(frozen=True)
class SideslipFromVelocity:
    """Make the reference ``sideslip_ref`` from ``vy_ref``: β = atan2(v, u)."""

    def __call__(self, recording: Recording) -> Recording:
        """Set ``sideslip_ref``, by ``vx_ref`` or else ``vx``.

        Gaps where they have them; `DataError` where one is missing.
        """
        speed = speed_of_reference(recording)
        return recording.with_channels(
            {"sideslip_ref": np.arctan2(recording["vy_ref"], recording[speed])},
            made_of=("vy_ref", speed),
        )


def speed_of_reference(recording: Recording) -> str:
    """Name of the channel of the forward speed that belongs to a reference: ``vx_ref``, or ``vx``
    without one.
    """
    return "vx_ref" if "vx_ref" in recording else "vx"


@dataclass(frozen=True)
class ScaleToWheelbase:
    """Scale a recording to that of a similar car with another wheelbase: times and lengths in units
    that leave accelerations and angles as they are.

    With λ = to/wheelbase, lengths grow by λ and times by √λ: velocities by √λ, yaw rates by 1/√λ. A
    1:10 car and a full-size one that are geometrically similar on similar tyres then drive the same
    manoeuvre. Channels that are no lengths, times or angles (forces, torques, currents, pressures)
    are left out.

    Source: Froude scaling: dynamic similarity under gravity, the unit of time being √(wheelbase/g);
    e.g. Brennan & Alleyne, Using a scale testbed, IEEE Control Systems Magazine 21 (3), 2001, for
    vehicles.
    """

    wheelbase: PositiveFloat  # wheelbase of the car [m]
    to: PositiveFloat  # wheelbase to which it is scaled [m]

    def __call__(self, recording: Recording) -> Recording:
        """Scale rate, start time and channels."""
        stretch = math.sqrt(self.to / self.wheelbase)
        factors = {"m/s": stretch, "rad/s": 1.0 / stretch, "m/s²": 1.0, "rad": 1.0}
        channels = {
            name: samples * factors[unit]
            for name, samples in recording.channels.items()
            if (unit := CHANNELS[name].unit) in factors
        }
        return replace(
            recording,
            rate_hz=recording.rate_hz / stretch,
            start_time=recording.start_time * stretch,
            channels=channels,
        )
