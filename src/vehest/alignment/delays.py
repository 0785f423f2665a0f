"""Delays between channels that must agree: which is late, by how much, and how surely.

Three accelerations are tied together, ay = vx·yaw_rate + d(vy)/dt, and two by two: ax and d(vx)/dt,
a channel and its reference, wheels and the speed. A delay is reported where its whole 95 % interval
lies beyond 15 ms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vehest.alignment.bandwidth import MIN_REPORTED_DELAY_SECONDS, low_passed
from vehest.alignment.findings import Finding
from vehest.alignment.lateral import lateral_lateness
from vehest.alignment.motion import WHEELS, Motion, motion_of
from vehest.alignment.settings import TILT_LAG_GAIN
from vehest.alignment.spectra import MAX_LAG_SECONDS, CrossSpectra, Measured, cross_spectra, lag_of
from vehest.alignment.standstill import standstill
from vehest.constants import FloatArray
from vehest.data.channels import REFERENCE_SUFFIX
from vehest.data.recording import Recording

MIN_PHASE_SHARE = 0.97  # smallest share of the phase that a delay must explain
SPEEDS_WITH_SLIP = frozenset({"vx", "motor_speed", "wheel speeds"})
"""Speeds that may come from wheels: driving slip grows with the acceleration, which makes them lead
and never lag.
"""
MAX_HALF_WIDTH_SECONDS = 0.05  # s, largest half width of the 95 % interval of a delay that is known
CHANNELS_OF_SIGNAL = {"wheel speeds": WHEELS}  # name of a compared signal -> its channels


@dataclass(frozen=True)
class Delay:
    """Delay of a channel against another."""

    channel: str  # channel that is late
    against: str  # channel against which it is late
    signals: str  # text on the signals that were compared
    delay: Measured  # lateness of the channel, negative if the other is the late one [s]

    @property
    def turned(self) -> Delay:
        """The same delay as seen from the other channel, with the opposite sign."""
        return Delay(
            self.against,
            self.channel,
            self.signals,
            Measured(-self.delay.value, self.delay.half_width),
        )


@dataclass(frozen=True)
class Late:
    """Channels that are late together."""

    channels: tuple[str, ...]  # names of the channels
    delay: float  # delay, rounded to whole milliseconds [s]
    evidence: str  # text on why it is known


def signals_to_compare(motion: Motion) -> dict[str, FloatArray]:
    """Signals by which delays and low-passes are found, under names of their own.

    Parameters
    ----------
    motion : Motion
        Channels without gaps.

    Returns
    -------
    dict
        Name -> (T,), of those whose channels are there and that change. ``turned`` and ``turn`` are
        vx·yaw_rate and ay - d(vy)/dt over the speed [rad/s], regularised near standstill.
    """
    signals: dict[str, FloatArray] = {}
    if motion.speed and {"ay", "yaw_rate"} <= set(motion.channels):
        signals |= {"ay": motion["ay"], "turning": motion.turning}
        if motion.velocity:
            signals["sliding"] = motion.sliding
            steady = motion.vx / (
                np.square(motion.vx)
                + np.square(0.3 * np.sqrt(np.mean(np.square(motion.vx))))
                + np.finfo(float).tiny
            )
            signals |= {
                "turned": motion.turning * steady,
                "turn": (motion["ay"] - motion.sliding) * steady,
            }
    if motion.speed and "ax" in motion:
        signals |= {"ax": motion["ax"], "forward": motion.forward}
    for name in ("vx", "vx_ref"):
        if name in motion:
            signals[f"d({name})"] = motion.derivative(motion[name])
    if "motor_speed" in motion:
        signals["d(motor_speed)"] = motion.derivative(motion["motor_speed"])
    if set(WHEELS) <= set(motion.channels):
        signals["d(wheel speeds)"] = motion.derivative(motion.wheels)
    for name in ("yaw_rate", "yaw_rate_ref"):
        if name in motion:
            signals[name] = motion[name]
    if motion.velocity == "vy_ref" and "sideslip_ref" in motion:
        signals |= {
            "sideslip_ref": motion["sideslip_ref"],
            "slip of vy_ref": np.arctan2(motion.vy, motion.vx),
        }
    if motion.speed and motion.steering:
        signals["steered"] = motion.vx * motion[motion.steering]
    return {name: samples for name, samples in signals.items() if 0.0 < np.ptp(samples) < np.inf}


def spectra_of(motion: Motion) -> CrossSpectra | None:
    """Cross-spectra of these signals; None for a drive that is too short.

    Parameters
    ----------
    motion : Motion
        Samples at standstill are left out.
    """
    signals = signals_to_compare(motion)
    return cross_spectra(signals, motion.rate_hz, motion.moving) if signals else None


def delays_of(
    motion: Motion, spectra: CrossSpectra, slow: frozenset[str] = frozenset()
) -> list[Delay]:
    """Every delay that the drive shows, established or not, except those of ``slow``, low-passed
    channels.

    Parameters
    ----------
    motion : Motion
        Channels without gaps.
    spectra : CrossSpectra
        As `spectra_of` returns them.
    slow : frozenset of str
        Channels whose lag is that of a low-pass.

    Returns
    -------
    list of Delay
        With half widths of at most MAX_HALF_WIDTH_SECONDS; lags that a pure delay does not explain
        are left out.
    """
    delays: list[Delay] = []
    if not slow & {"ay", "yaw_rate"}:
        delays += _lateral(motion)
    delays += _pair(
        spectra, "forward", "ax", (motion.speed, "ax"), f"ax and d({motion.speed})/dt", tilted=True
    )
    delays += _pair(spectra, "yaw_rate_ref", "yaw_rate", ("yaw_rate_ref", "yaw_rate"), "both")
    delays += _pair(spectra, "d(vx_ref)", "d(vx)", ("vx_ref", "vx"), "both")
    for name in ("motor_speed", "wheel speeds"):
        delays += _pair(spectra, f"d({motion.speed})", f"d({name})", (motion.speed, name), "both")
    delays += _pair(
        spectra,
        "slip of vy_ref",
        "sideslip_ref",
        ("vy_ref", "sideslip_ref"),
        f"sideslip_ref and atan2(vy_ref, {motion.speed})",
    )
    return [delay for delay in delays if not {delay.channel, delay.against} & slow]


def _lateral(motion: Motion) -> list[Delay]:
    """Delays between yaw rate, lateral velocity and ay, two by two, from the fit to all three."""
    lateness = lateral_lateness(motion)
    if lateness is None or not all(_sound(measured) for measured in lateness):
        return []
    turning, sliding, difference = lateness
    signals = f"ay, vx·yaw_rate and d({motion.velocity})/dt"
    return [
        Delay("yaw_rate", "ay", signals, turning.widened(TILT_LAG_GAIN)),
        Delay(motion.velocity, "ay", signals, sliding.widened(TILT_LAG_GAIN)),
        Delay("yaw_rate", motion.velocity, signals, difference),
    ]


def _pair(
    spectra: CrossSpectra,
    source: str,
    follower: str,
    channels: tuple[str, str],
    signals: str,
    *,
    tilted: bool = False,
) -> list[Delay]:
    """The delay of one signal behind another, in a list; empty where it is missing or not
    established. ``tilted``: gravity by body tilt adds to the uncertainty.
    """
    lag = lag_of(spectra, source, follower, low_pass=False)
    if lag is None or lag.fit < MIN_PHASE_SHARE or not _sound(lag.delay):
        return []
    delay = lag.delay.widened(TILT_LAG_GAIN) if tilted else lag.delay
    return [Delay(channels[1], channels[0], signals, delay)]


def _sound(delay: Measured) -> bool:
    """Whether a delay is known to MAX_HALF_WIDTH_SECONDS and inside the lags that are searched."""
    return delay.half_width <= MAX_HALF_WIDTH_SECONDS and abs(delay.value) < MAX_LAG_SECONDS


def late_channels(recording: Recording) -> dict[str, Late]:
    """Channel -> its delay, as the checks of a recording find it.

    Parameters
    ----------
    recording : Recording
        Whose checks are repeated.

    Returns
    -------
    dict
        Empty for a drive that is too short; channels that are late together share one entry.
    """
    motion = motion_of(recording, ~standstill(recording))
    spectra = spectra_of(motion)
    if spectra is None:
        return {}
    late_groups = _late(delays_of(motion, spectra, frozenset(low_passed(motion, spectra))))
    return {name: late_group for late_group in late_groups for name in late_group.channels}


def delay_findings(delays: Sequence[Delay]) -> list[Finding]:
    """A warning for every channel that is later than another.

    Parameters
    ----------
    delays : sequence of Delay
        As `delays_of` returns them.

    Returns
    -------
    list of Finding
        With the transform that compensates for it.
    """
    remedy = (
        "the transform {{name: delay_correction, delay: {:.3f}, channels: [{}]}} compensates for it"
    )
    return [
        Finding(
            "warning",
            "delay",
            late.channels[0],
            f"{late.evidence}; {remedy.format(late.delay, ', '.join(late.channels))}",
        )
        for late in _late(delays)
    ]


def _late(delays: Sequence[Delay]) -> list[Late]:
    """Channels that are later than another; that which lags is taken to be late, not the other
    early.

    The reference's channels have one clock: a yaw rate that is surely on time beside yaw_rate_ref
    is not late behind vy_ref.
    """
    punctual = {
        delay.channel
        for delay in delays
        if abs(delay.delay.value) + delay.delay.half_width < MIN_REPORTED_DELAY_SECONDS
        and delay.against.endswith(REFERENCE_SUFFIX)
    }
    late = [
        delay
        for delay in (either if either.delay.value > 0.0 else either.turned for either in delays)
        if delay.delay.low > MIN_REPORTED_DELAY_SECONDS  # with its whole interval
        and (
            delay.against not in SPEEDS_WITH_SLIP or (delay.channel, delay.against) == ("ax", "vx")
        )
        and not (delay.channel in punctual and delay.against.endswith(REFERENCE_SUFFIX))
    ]
    groups = []
    for channel in dict.fromkeys(delay.channel for delay in late):
        delays_of_channel = [delay for delay in late if delay.channel == channel]
        signals = "; ".join(
            dict.fromkeys(delay.signals for delay in delays_of_channel if delay.signals != "both")
        )
        figures = " and ".join(
            f"{1e3 * delay.delay.value:.0f} ms (95 %: {1e3 * delay.delay.low:.0f} to "
            f"{1e3 * delay.delay.high:.0f} ms) relative to {delay.against}"
            for delay in delays_of_channel
        )
        text = (
            f"delayed{', like the other wheels,' if channel in CHANNELS_OF_SIGNAL else ''} by "
            f"{figures}" + (f" (from {signals})" if signals else "")
        )
        if [delay.against for delay in delays_of_channel] == ["vx"]:
            text += ", unless vx is a wheel speed, which leads by its slip"
        groups.append(
            Late(
                CHANNELS_OF_SIGNAL.get(channel, (channel,)),
                round(max(delay.delay.value for delay in delays_of_channel), 3),
                text,
            )
        )
    return groups
