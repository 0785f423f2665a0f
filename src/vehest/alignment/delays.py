"""Delays between channels that must agree: which is late, by how much, and how surely.

Three accelerations are tied together, ay = vx·yaw_rate + d(vy)/dt, and two by two: ax and d(vx)/dt, a channel and its reference,
wheels and the speed. A delay is reported where its whole 95 % interval lies beyond 15 ms.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vehest.alignment.findings import Finding
from vehest.alignment.imu import TILT_LAG_GAIN
from vehest.alignment.motion import WHEELS, Motion
from vehest.alignment.spectra import LARGEST_LAG, ComplexArray, CrossSpectra, Measured, cross_spectra, jackknife, lag_of, smoothed
from vehest.constants import FloatArray

LONGEST_UNREPORTED = 0.015  # s
LEAST_FIT = 0.97  # share of the phase that a delay must explain
LARGEST_GAIN = 2.5  # of d(vy)/dt beside that of vx·yaw_rate; noise alone shrinks it to 0.6 in sound drives
LEAST_SLIDING_SHARE = 0.1  # of what vx·yaw_rate leaves of ay, that d(vy)/dt must explain
SLIPPING = frozenset({"vx", "motor_speed", "wheel speeds"})
"""Speeds that may come from wheels: driving slip grows with the acceleration, which makes them lead and never lag."""
N_STEPS = 8
N_WEIGHTINGS = 3
LARGEST_STEP = 0.1  # s
LARGEST_HALF_WIDTH = 0.05  # s; a delay that is known no better is not known
DELAYED = {"wheel speeds": WHEELS}


@dataclass(frozen=True)
class Delay:
    """By how much a channel is late against another.

    Args:
        channel: the one that may be late.
        against: the other.
        signals: what was compared, for people.
        delay: lateness of the channel with its 95 % interval, negative if the other is the late one [s].
    """

    channel: str
    against: str
    signals: str
    delay: Measured

    @property
    def established(self) -> bool:
        """Whether the whole interval lies beyond what is not reported."""
        return abs(self.delay.value) - self.delay.half_width > LONGEST_UNREPORTED

    @property
    def turned(self) -> Delay:
        """The same seen from the other channel."""
        return Delay(self.against, self.channel, self.signals, Measured(-self.delay.value, self.delay.half_width))


def signals_to_compare(motion: Motion) -> dict[str, FloatArray]:
    """All signals that delays and low-passes are found from, under names of their own."""
    signals: dict[str, FloatArray] = {}
    if motion.speed and {"ay", "yaw_rate"} <= set(motion.channels):
        signals |= {"ay": motion["ay"], "turning": motion.turning, "arm": motion.derivative(motion["yaw_rate"])}
        if motion.velocity:
            signals["sliding"] = motion.sliding
            steady = motion.vx / (np.square(motion.vx) + np.square(0.3 * np.sqrt(np.mean(np.square(motion.vx)))) + np.finfo(float).tiny)
            signals |= {"turned": motion.turning * steady, "turn": (motion["ay"] - motion.sliding) * steady}
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
        signals |= {"sideslip_ref": motion["sideslip_ref"], "slip of vy_ref": np.arctan2(motion.vy, motion.vx)}
    if motion.speed and motion.steering:
        signals["steered"] = motion.vx * motion[motion.steering]
    return {name: samples for name, samples in signals.items() if 0.0 < np.ptp(samples) < np.inf}


def spectra_of(motion: Motion) -> CrossSpectra | None:
    """Their cross-spectra; None for a drive that is too short."""
    signals = signals_to_compare(motion)
    return cross_spectra(signals, motion.rate_hz, motion.moving) if signals else None


def delays_of(motion: Motion, spectra: CrossSpectra, slow: frozenset[str] = frozenset()) -> list[Delay]:
    """Every delay that the drive shows, established or not.

    Args:
        motion: the drive.
        spectra: of its signals.
        slow: channels that are low-passed; a delay says nothing of those.
    """
    found: list[Delay] = []
    if {"ay", "turning", "sliding", "arm"} <= set(spectra.names) and not slow & {"ay", "yaw_rate"}:
        found += lateral_delays(spectra, motion.velocity)
    found += _pair(spectra, "forward", "ax", (motion.speed, "ax"), f"ax and d({motion.speed})/dt", tilted=True)
    found += _pair(spectra, "yaw_rate_ref", "yaw_rate", ("yaw_rate_ref", "yaw_rate"), "both")
    found += _pair(spectra, "d(vx_ref)", "d(vx)", ("vx_ref", "vx"), "both")
    for name in ("motor_speed", "wheel speeds"):
        found += _pair(spectra, f"d({motion.speed})", f"d({name})", (motion.speed, name), "both")
    found += _pair(spectra, "slip of vy_ref", "sideslip_ref", ("vy_ref", "sideslip_ref"), f"sideslip_ref and atan2(vy_ref, {motion.speed})")
    return [delay for delay in found if not {delay.channel, delay.against} & slow]


def _pair(
    spectra: CrossSpectra, source: str, follower: str, channels: tuple[str, str], signals: str, *, tilted: bool = False
) -> list[Delay]:
    if not {source, follower} <= set(spectra.names):
        return []
    lag = lag_of(spectra, source, follower, low_pass=False)
    if lag is None or lag.fit < LEAST_FIT or not _sound(lag.delay):
        return []
    delay = lag.delay.widened(TILT_LAG_GAIN) if tilted else lag.delay
    return [Delay(channels[1], channels[0], signals, delay)]


def _sound(delay: Measured) -> bool:
    return delay.half_width <= LARGEST_HALF_WIDTH and abs(delay.value) < LARGEST_LAG


def lateral_delays(spectra: CrossSpectra, velocity: str) -> list[Delay]:
    """Lateness of yaw rate and lateral velocity against ay and each other, from ay = g·(vx·yaw_rate + d(vy)/dt) + x·d(yaw_rate)/dt.

    Both delays, the gain g that roll lets in and the lever arm x are fitted together: at one speed a lever arm looks as a delay of the yaw
    rate does, and varying speed tells them apart. One gain serves both terms, so that noise of the differentiated velocity shrinks
    neither. Bins have the weight that the residual leaves them.

    Args:
        spectra: with ay, turning, sliding and arm.
        velocity: the channel that d(vy)/dt comes from.
    """
    chosen = CrossSpectra(("ay", "turning", "sliding", "arm"), spectra.frequency, _chosen(spectra, ("ay", "turning", "sliding", "arm")))
    whole, omega = chosen.whole, chosen.omega
    weight = 1.0 / np.maximum(whole[:, 0, 0].real.mean(), np.finfo(float).tiny) * np.ones(len(omega))
    start = (0.0, 0.0)
    for _ in range(N_WEIGHTINGS):
        fitted = _lateral_fit(whole, omega, weight, start)
        if fitted is None:
            return []
        start, residual, explained = fitted
        floor = 1e-6 * float(whole[:, 0, 0].real.max())
        weight = 1.0 / np.maximum(smoothed(residual), floor) if floor > 0.0 else weight

    if explained < LEAST_SLIDING_SHARE or not 1.0 / LARGEST_GAIN < _sliding_gain(whole, omega, weight, start) < LARGEST_GAIN:
        return []

    def lateness(spectrum: ComplexArray) -> FloatArray:
        again = _lateral_fit(spectrum, omega, weight, start)
        turning, sliding = again[0] if again is not None else (math.nan, math.nan)
        return np.array([turning, sliding, turning - sliding])

    turning, sliding, difference = jackknife(chosen, lateness)
    if not all(_sound(measured) for measured in (turning, sliding, difference)):
        return []
    signals = f"ay, vx·yaw_rate and d({velocity})/dt"
    return [
        Delay("yaw_rate", "ay", signals, turning.widened(TILT_LAG_GAIN)),
        Delay(velocity, "ay", signals, sliding.widened(TILT_LAG_GAIN)),
        Delay("yaw_rate", velocity, signals, difference),
    ]


def _chosen(spectra: CrossSpectra, names: Sequence[str]) -> ComplexArray:
    places = [spectra.names.index(name) for name in names]
    return np.asarray(spectra.groups[:, :, places][:, :, :, places], dtype=np.complex128)


def _lateral_fit(
    spectrum: ComplexArray, omega: FloatArray, weight: FloatArray, start: tuple[float, float]
) -> tuple[tuple[float, float], FloatArray, float] | None:
    """Gauss-Newton: both delays, the power of the residual (F,), and the share of it that d(vy)/dt took away."""
    turning, sliding = start
    for _ in range(N_STEPS):
        p, d = np.exp(1j * omega * turning), np.exp(1j * omega * sliding)
        columns = np.zeros((len(omega), 4, 4), dtype=np.complex128)  # (F, signals, parameters): g, x, g·delay, g·delay
        columns[:, 1, 0], columns[:, 2, 0], columns[:, 3, 1] = p, d, p
        columns[:, 1, 2], columns[:, 2, 3] = 1j * omega * p, 1j * omega * d
        left = columns.conj().transpose(0, 2, 1)
        normal = np.einsum("fpq,f->pq", (left @ spectrum @ columns).real, weight)
        right = np.einsum("fp,f->p", (left @ spectrum[:, :, :1])[:, :, 0].real, weight)
        scale = np.sqrt(np.diag(normal))
        if not (np.isfinite(scale).all() and (scale > 0.0).all()):
            return None
        try:
            values = np.linalg.solve(normal / scale / scale[:, None] + 1e-9 * np.eye(4), right / scale) / scale
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(values).all() or values[0] == 0.0:
            return None
        turning += float(np.clip(values[2] / values[0], -LARGEST_STEP, LARGEST_STEP))
        sliding += float(np.clip(values[3] / values[0], -LARGEST_STEP, LARGEST_STEP))
        turning, sliding = (min(max(delay, -LARGEST_LAG), LARGEST_LAG) for delay in (turning, sliding))
    mix = -np.einsum("fsp,p->fs", columns, values)
    mix[:, 0] += 1.0
    residual = np.einsum("fs,fst,ft->f", mix.conj(), spectrum, mix).real
    without = mix.copy()
    without[:, 2] = 0.0
    before = np.einsum("fs,fst,ft->f", without.conj(), spectrum, without).real
    total = float(weight @ before)
    return (turning, sliding), residual, 1.0 - float(weight @ residual) / total if total > 0.0 else 0.0


def _sliding_gain(spectrum: ComplexArray, omega: FloatArray, weight: FloatArray, delays: tuple[float, float]) -> float:
    """The gain that d(vy)/dt would have, were it fitted apart from that of vx·yaw_rate."""
    advance = np.ones((len(omega), 4), dtype=np.complex128)
    advance[:, 1], advance[:, 2] = (np.exp(1j * omega * delay) for delay in delays)
    own = np.einsum("fst,fs,ft,f->st", spectrum, advance.conj(), advance, weight).real
    gains = np.linalg.lstsq(own[1:, 1:], own[1:, 0], rcond=None)[0]
    return float(gains[1] / gains[0]) if gains[0] != 0.0 else 0.0


def delay_findings(delays: Sequence[Delay]) -> list[Finding]:
    """A warning for every channel that is later than another; what lags is taken to be late, not the other early."""
    late = [delay if delay.delay.value > 0.0 else delay.turned for delay in delays if delay.established]
    late = [delay for delay in late if delay.against not in SLIPPING or (delay.channel, delay.against) == ("ax", "vx")]
    findings = []
    for channel in dict.fromkeys(delay.channel for delay in late):
        own = [delay for delay in late if delay.channel == channel]
        signals = [text for text in dict.fromkeys(delay.signals for delay in own) if text != "both"]
        figures = " and ".join(f"{_milliseconds(delay.delay)} behind {delay.against}" for delay in own)
        names = DELAYED.get(channel, (channel,))
        longest = max(delay.delay.value for delay in own)
        findings.append(
            Finding(
                "warning",
                "delay",
                names[0],
                f"is late{' with the other wheels' if len(names) > 1 else ''}, {figures}{f', from {_listed(signals)}' if signals else ''}"
                f"{_doubt(own)}; {{name: delay_correction, delay: {longest:.3f}, channels: [{', '.join(names)}]}} takes it off",
            )
        )
    return findings


def _doubt(own: Sequence[Delay]) -> str:
    """What else could be meant."""
    if [delay.against for delay in own] == ["vx"]:
        return "; or vx comes from wheels, whose slip makes it lead"
    return ""


def _listed(texts: Sequence[str]) -> str:
    return "; ".join(texts)


def _milliseconds(measured: Measured) -> str:
    return f"{1e3 * measured.value:.0f} ms (95 %: {1e3 * measured.low:.0f} to {1e3 * measured.high:.0f})"
