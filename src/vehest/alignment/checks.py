"""What may be wrong with a recording: each check looks for one thing and says where it found it.

``checks_of_clock`` looks at the raw time stamps of a file, ``checks_of_recording`` at the samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, signal

from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.recording import Recording

BoolArray = NDArray[np.bool_]
Level = Literal["error", "warning", "note"]

STUCK_SECONDS = 1.0
SATURATED_FRACTION = 2e-3
SATURATED_EXCESS = 4  # a quantised sine sits at its peak 2.4 times as often as one level below
STANDSTILL_SPEED = 0.1  # m/s
STANDSTILL_YAW_RATE = 0.05  # rad/s
STANDSTILL_SHAKING = 0.3  # m/s²
MOST_DRIFT = 0.5  # intervals
LATEST_TIME = 1e15  # s; beyond it a double tells no two samples apart
KINEMATIC_BAND_HZ = (0.1, 2.0)
FILTER_END_SECONDS = 2.0  # where the band-pass still feels the ends of a recording
SIGN_CORRELATION = 0.3
MAX_SCALE = 1.7  # between d(vy_ref)/dt and what it must equal; km/h for m/s makes 3.6 or 1/3.6
DEGREES_PER_RADIAN = 180.0 / np.pi
STRAIGHT_YAW_RATE = 0.02  # rad/s, slow enough to count as straight ahead
STRAIGHT_SPEED = 3.0  # m/s, fast enough for it
STRAIGHT_SECONDS = 3.0
MOST_STEERING_OFFSET = np.deg2rad(3.0)
DROPOUT_SPEED = 3.0  # m/s
DROPOUT_SHARE = 0.1  # of the other wheels' median
DROPOUT_SECONDS = 0.1
DROPOUT_BRAKING = 4.0  # m/s², beyond which a wheel may be locked
DROPOUT_CLEAR_SECONDS = 1.0  # before and after such braking
REVERSE_SPEED = 0.5  # m/s
REVERSE_SECONDS = 1.0


@dataclass(frozen=True)
class Finding:
    """One thing that a check found.

    Args:
        level: ``error`` stops an ingest, ``warning`` needs a look, ``note`` is information.
        check: name of the check.
        channel: the channel concerned, empty if it is not about one.
        message: what was found, where, and what to do.
    """

    level: Level
    check: str
    channel: str
    message: str


def checks_of_clock(time: FloatArray) -> list[Finding]:
    """Look at raw time stamps: order, repeats, gaps and jitter.

    Args:
        time: time stamps [s], shape (T,).
    """
    findings: list[Finding] = []
    if len(time) < 2:
        return [Finding("error", "clock", "time", "fewer than two time stamps")]
    if not np.isfinite(time).all():
        row = int(np.flatnonzero(~np.isfinite(time))[0])
        return [Finding("error", "clock", "time", f"time stamp of sample {row} is not a number")]
    if np.abs(time).max() > LATEST_TIME:
        row = int(np.argmax(np.abs(time)))
        return [Finding("error", "clock", "time", f"time stamp of sample {row} is {time[row]:.6g} s, which is no time of a drive")]
    steps = np.diff(time)
    for what, bad in (("goes backwards", steps < 0), ("repeats", steps == 0)):
        if bad.any():
            where = np.flatnonzero(bad)
            findings.append(
                Finding(
                    "error",
                    "clock",
                    "time",
                    f"time {what} {len(where)} times, first at sample {where[0] + 1} ({time[where[0] + 1]:.12g} s)",
                )
            )
    if findings:
        return findings
    interval = float(np.median(steps))
    gaps = np.flatnonzero(steps > 1.5 * interval)
    if len(gaps):
        longest = gaps[np.argmax(steps[gaps])]
        findings.append(
            Finding(
                "error",
                "gap",
                "time",
                f"{len(gaps)} gaps, the longest of {steps[longest]:.6g} s after {time[longest]:.12g} s (interval {interval:.6g} s)",
            )
        )
    jitter = float(np.abs(steps[steps <= 1.5 * interval] - interval).max() / interval)
    if jitter > 0.01:
        findings.append(
            Finding("warning", "jitter", "time", f"intervals deviate by up to {100 * jitter:.2g} % from the median of {interval:.6g} s")
        )
    uniform = np.linspace(time[0], time[-1], len(time))
    drift = float(np.abs(time - uniform).max() / interval)
    if drift > MOST_DRIFT and not len(gaps):
        worst = time[np.argmax(np.abs(time - uniform))]
        findings.append(
            Finding("warning", "drift", "time", f"the clock drifts: at {worst:.12g} s it is {drift:.2g} intervals away from a uniform one")
        )
    return findings


def checks_of_recording(recording: Recording) -> list[Finding]:
    """All checks of a recording's samples, the gravest findings first."""
    with np.errstate(all="ignore"):  # of samples up to 1e308, which a check may square
        findings = [finding for check in _CHECKS for finding in check(recording)]
    order = {"error": 0, "warning": 1, "note": 2}
    return sorted(findings, key=lambda finding: order[finding.level])


def _impossible_values(recording: Recording) -> list[Finding]:
    findings = []
    spun = bool(dict(recording.provenance.get("flags") or {}).get("spun"))
    for name, samples in recording.channels.items():
        described = CHANNELS[name]
        outside = np.flatnonzero((samples < described.low) | (samples > described.high))
        if not len(outside):
            continue
        worst = outside[np.argmax(np.abs(samples[outside]))]
        hint = "is the column in degrees? then say so in its unit" if described.is_angular else "check its unit and its column"
        if spun:
            hint = "the simulated car spun here"
        findings.append(
            Finding(
                "note" if spun else "error",
                "impossible",
                name,
                f"{len(outside)} samples beyond what a vehicle can do, {samples[worst]:.6g} {described.unit} at "
                f"{recording.time[worst]:.12g} s (possible: {described.low:.4g} to {described.high:.4g}); {hint}",
            )
        )
    return findings


def _yaw_rate_unit(recording: Recording) -> list[Finding]:
    """In steady driving ay ≈ vx·yaw_rate; a slope near π/180 or a negative one gives the unit or the sign away."""
    if not {"vx", "yaw_rate", "ay"} <= set(recording.channels):
        return []
    expected = recording["vx"] * recording["yaw_rate"]
    measured = recording["ay"]
    known = np.isfinite(expected) & np.isfinite(measured)
    if known.sum() < 100:
        return []
    expected, measured = expected[known] - expected[known].mean(), measured[known] - measured[known].mean()
    scatter = expected.std() * measured.std()
    if scatter == 0.0 or measured.std() < 0.2:
        return []
    correlation = float((expected * measured).mean() / scatter)
    slope = float((expected * measured).sum() / (expected**2).sum())
    if abs(correlation) < 0.7:
        return []
    ratio = abs(slope) * DEGREES_PER_RADIAN
    if 0.4 < ratio < 2.5:
        return [
            Finding(
                "error", "unit", "yaw_rate", f"ay is {slope:.3g} times vx·yaw_rate: yaw_rate is in degrees a second; set its unit to deg/s"
            )
        ]
    if slope < 0:
        return [
            Finding(
                "warning",
                "sign",
                "yaw_rate",
                f"ay runs against vx·yaw_rate (slope {slope:.3g}, correlation {correlation:.2f}): "
                f"the sign of ay or of yaw_rate is not ISO 8855's; set sign: -1 for it",
            )
        ]
    if not 0.5 < slope < 2.0:
        return [
            Finding(
                "warning", "unit", "ay", f"ay is {slope:.3g} times vx·yaw_rate, about 1 is expected: check the units of ay, vx and yaw_rate"
            )
        ]
    return []


def _kinematic_sign(recording: Recording) -> list[Finding]:
    """ay - vx·yaw_rate must follow d(vy_ref)/dt (Da Lio et al. 2023, Eq. 4a); a reference's own vx_ref before one that wheels slip."""
    speed = _speed_beside_reference(recording)
    names = (speed, "yaw_rate", "ay", "vy_ref")
    if not set(names) <= set(recording.channels):
        return []
    if any(np.isnan(recording[name]).any() for name in names) or recording.rate_hz <= 2.5 * KINEMATIC_BAND_HZ[1]:
        return []
    moving = ~_standstill(recording)
    settled = moving.copy()
    margin = round(FILTER_END_SECONDS * recording.rate_hz)
    settled[:margin] = settled[len(settled) - margin :] = False
    if settled.sum() < 10 * recording.rate_hz:
        return []
    band = signal.butter(2, KINEMATIC_BAND_HZ, btype="bandpass", fs=recording.rate_hz, output="sos")
    predicted = signal.sosfiltfilt(band, recording["ay"] - recording[speed] * recording["yaw_rate"])[settled]
    derived = signal.sosfiltfilt(band, np.gradient(recording["vy_ref"]) * recording.rate_hz)[settled]
    if predicted.std() == 0.0 or derived.std() < 1e-3:
        return []
    correlation = float(np.corrcoef(predicted, derived)[0, 1])
    where = f"between {KINEMATIC_BAND_HZ[0]:g} and {KINEMATIC_BAND_HZ[1]:g} Hz"
    if correlation < -SIGN_CORRELATION:
        return [
            Finding(
                "warning",
                "sign",
                "vy_ref",
                f"ay - vx·yaw_rate disagrees in sign with d(vy_ref)/dt (correlation {correlation:.2f} {where}): "
                f"vy_ref, or ay and yaw_rate together, point the other way; set sign: -1",
            )
        ]
    if correlation < SIGN_CORRELATION:
        return [
            Finding(
                "warning",
                "kinematics",
                "vy_ref",
                f"ay - vx·yaw_rate hardly follows d(vy_ref)/dt (correlation {correlation:.2f} {where}): "
                f"check units, delays and where the sensors sit",
            )
        ]
    scale = float(derived.std() / predicted.std())
    if correlation > 0.8 and not 1 / MAX_SCALE < scale < MAX_SCALE:
        return [
            Finding(
                "warning",
                "unit",
                "vy_ref",
                f"d(vy_ref)/dt is {scale:.3g} times as large as ay - vx·yaw_rate {where} "
                f"(correlation {correlation:.2f}): check the unit of vy_ref",
            )
        ]
    residual = np.gradient(recording["vy_ref"]) * recording.rate_hz - (recording["ay"] - recording[speed] * recording["yaw_rate"])
    residual = residual[moving]
    return [
        Finding(
            "note",
            "kinematics",
            "vy_ref",
            f"d(vy_ref)/dt follows ay - vx·yaw_rate (correlation {correlation:.2f} {where}), mean bias {residual.mean():.3f} m/s²",
        )
    ]


def _sideslip_unit(recording: Recording) -> list[Finding]:
    """sideslip_ref must be atan2(vy_ref, vx) in radians; 57 times that is degrees."""
    speed = _speed_beside_reference(recording)
    if not {speed, "vy_ref", "sideslip_ref"} <= set(recording.channels):
        return []
    expected = np.arctan2(recording["vy_ref"], recording[speed])
    given = recording["sideslip_ref"]
    known = np.isfinite(expected) & np.isfinite(given) & ~_standstill(recording)
    if known.sum() < 100 or np.std(expected[known]) < 1e-3:
        return []
    slope = float((expected[known] * given[known]).sum() / np.square(expected[known]).sum())
    if 0.4 < slope / DEGREES_PER_RADIAN < 2.5:
        message = f"sideslip_ref is {slope:.3g} times atan2(vy_ref, vx): it is in degrees; set its unit to deg"
        return [Finding("error", "unit", "sideslip_ref", message)]
    return []


def _speed_beside_reference(recording: Recording) -> str:
    return "vx_ref" if "vx_ref" in recording and not np.isnan(recording["vx_ref"]).any() else "vx"


def _not_measured(recording: Recording) -> list[Finding]:
    findings = []
    for name in sorted(recording.gappy):
        missing = int(np.isnan(recording[name]).sum())
        if missing:
            findings.append(Finding("note", "nan", name, f"{100 * missing / len(recording):.1f} % of the samples are 'not measured'"))
    return findings


def _stuck(recording: Recording) -> list[Finding]:
    """Values that stay the same for long while the car moves; at standstill nothing needs to change."""
    findings = []
    moving = ~_standstill(recording)
    moved = np.concatenate([[0], np.cumsum(moving)])
    for name, samples in recording.channels.items():
        known = np.flatnonzero(~np.isnan(samples))
        unit = CHANNELS[name].unit
        if CHANNELS[name].rests and not samples[known].any():
            continue
        if len(known) > 1 and (samples[known] == samples[known[0]]).all():
            findings.append(Finding("warning", "stuck", name, f"never changes: {samples[known[0]]:.6g} {unit} throughout"))
            continue
        starts, lengths = _long_runs(samples[known], at_least=3)
        if CHANNELS[name].rests:
            starts, lengths = starts[samples[known[starts]] != 0.0], lengths[samples[known[starts]] != 0.0]
        if not len(starts):
            continue
        begins, ends = known[starts], known[starts + lengths - 1] + 1
        held = moved[ends] - moved[begins]
        longest = int(held.max())
        begin, end = begins[np.argmax(held)], ends[np.argmax(held)]
        first = int(begin + np.argmax(moving[begin:end]))
        if longest >= STUCK_SECONDS * recording.rate_hz:
            seconds, time = longest / recording.rate_hz, recording.time[first]
            message = f"stays at {samples[first]:.6g} {unit} for {seconds:.3g} s from {time:.12g} s"
            findings.append(Finding("warning", "stuck", name, message))
    return findings


def _saturated(recording: Recording) -> list[Finding]:
    """Samples that pile up at the highest or lowest value, again and again, far more often than at the value next to it."""
    findings = []
    moving = ~_standstill(recording)
    for name, samples in recording.channels.items():
        known = samples[np.isfinite(samples) & moving]
        if len(known) < 100:
            continue
        lowest, highest = known.min(), known.max()
        between = known[(known > lowest) & (known < highest)]
        if not len(between):
            continue
        largest = max(abs(lowest), abs(highest))
        for side, extreme, beside in (("highest", highest, between.max()), ("lowest", lowest, between.min())):
            at = int(np.count_nonzero(known == extreme))
            if at <= SATURATED_FRACTION * len(known) or abs(extreme) < 0.1 * largest:
                continue
            if at < SATURATED_EXCESS * np.count_nonzero(known == beside):
                continue
            if np.count_nonzero(np.diff(np.concatenate([[0], known == extreme])) == 1) < 2:
                continue
            share = 100 * at / len(known)
            message = f"{share:.2g} % of the samples sit at the {side} value, {extreme:.6g} {CHANNELS[name].unit}"
            findings.append(Finding("warning", "saturated", name, message))
    return findings


def _steering_offset(recording: Recording) -> list[Finding]:
    """Straight ahead the steering angle must be about zero: its median where a moving car hardly turns."""
    if not {"vx", "yaw_rate", "steer"} <= set(recording.channels):
        return []
    straight = (recording["vx"] > STRAIGHT_SPEED) & (np.abs(recording["yaw_rate"]) < STRAIGHT_YAW_RATE) & np.isfinite(recording["steer"])
    seconds = straight.sum() / recording.rate_hz
    if seconds < STRAIGHT_SECONDS:
        return []
    shown = recording["steer"][straight]
    offset = float(np.median(shown))
    if abs(offset) < max(MOST_STEERING_OFFSET, 2.0 * float(shown.std())):
        return []
    return [
        Finding(
            "warning",
            "offset",
            "steer",
            f"shows {np.rad2deg(offset):.3g} deg where the car hardly turns ({seconds:.3g} s of it): "
            f"take {offset:.3g} rad off with the transform offset_correction",
        )
    ]


def _wheel_dropout(recording: Recording) -> list[Finding]:
    """A wheel that shows next to nothing beside the other three while the car neither stands nor brakes hard.

    On slippery roads wheels lock under gentle braking too; without a channel of the brakes that cannot be told from a dropout for certain.
    """
    names = [f"wheel_speed_{wheel}" for wheel in ("fl", "fr", "rl", "rr")]
    if not {"vx", *names} <= set(recording.channels):
        return []
    rolling = recording["vx"] > DROPOUT_SPEED
    if "ax" in recording:
        around = 2 * min(round(DROPOUT_CLEAR_SECONDS * recording.rate_hz), len(recording)) + 1
        rolling &= ~ndimage.maximum_filter1d(recording["ax"] < -DROPOUT_BRAKING, around)
    wheels = np.abs(recording.stack(names))
    findings = []
    for place, name in enumerate(names):
        others = np.median(np.delete(wheels, place, axis=1), axis=1)
        starts, lengths = _long_runs(rolling & (wheels[:, place] < DROPOUT_SHARE * others), at_least=1)
        out = [
            (start, length)
            for start, length in zip(starts.tolist(), lengths.tolist(), strict=True)
            if rolling[start] and wheels[start, place] < DROPOUT_SHARE * others[start] and length > DROPOUT_SECONDS * recording.rate_hz
        ]
        if out:
            longest = max(out, key=lambda run: run[1])
            findings.append(
                Finding(
                    "warning",
                    "dropout",
                    name,
                    f"shows next to nothing {len(out)} times while the other wheels turn, the longest for "
                    f"{longest[1] / recording.rate_hz:.3g} s from {recording.time[longest[0]]:.12g} s; "
                    f"the transform speed_from_wheels leaves such a wheel out",
                )
            )
    return findings


def _reverse(recording: Recording) -> list[Finding]:
    """Driving backwards is legitimate, but most estimators take the car to go forwards."""
    speed = "vx" if "vx" in recording else "vx_ref"
    if speed not in recording:
        return []
    samples = recording[speed]
    starts, lengths = _long_runs(samples < -REVERSE_SPEED, at_least=math.ceil(REVERSE_SECONDS * recording.rate_hz))
    backwards = samples[starts] < -REVERSE_SPEED
    starts, lengths = starts[backwards], lengths[backwards]
    if not len(starts):
        return []
    start, length = int(starts[np.argmax(lengths)]), int(lengths.max())
    lowest = min(float(samples[begin : begin + count].min()) for begin, count in zip(starts, lengths, strict=True))
    return [
        Finding(
            "note",
            "reverse",
            speed,
            f"goes backwards {len(starts)} times (below -{REVERSE_SPEED:g} m/s for {REVERSE_SECONDS:g} s or more), the longest for "
            f"{length / recording.rate_hz:.3g} s from {recording.time[start]:.12g} s, lowest {lowest:.3g} m/s; what estimators say there "
            "does not count if they take the car to go forwards: leave the range out (start and stop of a split), or set sign: -1 for the "
            "speed if the drive goes forwards",
        )
    ]


def _standstill(recording: Recording) -> BoolArray:
    """Where the car stands: the speed is nil and, where they are measured, neither yaw rate nor accelerations speak of motion."""
    standing = np.zeros(len(recording), dtype=bool)
    if "vx" not in recording:
        return standing
    slow = np.abs(recording["vx"]) < STANDSTILL_SPEED
    starts, lengths = _long_runs(slow, at_least=1)
    still = slow[starts]
    if "yaw_rate" in recording:
        still &= ~(np.fmax.reduceat(np.abs(recording["yaw_rate"]), starts) > STANDSTILL_YAW_RATE)
    for name in ("ax", "ay"):
        if name in recording:
            still &= _spreads(recording[name], starts, lengths) <= STANDSTILL_SHAKING
    return np.repeat(still, lengths)


def _spreads(samples: FloatArray, starts: NDArray[np.int64], lengths: NDArray[np.int64]) -> FloatArray:
    """Standard deviation of what is known of the samples, for each of the stretches that they consist of; 0 where nothing is."""
    known = np.isfinite(samples)
    number = np.maximum(np.add.reduceat(known.astype(np.int64), starts), 1)
    mean = np.add.reduceat(np.where(known, samples, 0.0), starts) / number
    deviation = np.where(known, samples - np.repeat(mean, lengths), 0.0)
    return np.asarray(np.sqrt(np.add.reduceat(np.square(deviation), starts) / number), dtype=np.float64)


def _long_runs(samples: NDArray[Any], at_least: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Starts and lengths of the runs of equal values that are long enough."""
    edges = np.flatnonzero(np.concatenate([[True], samples[1:] != samples[:-1], [True]])) if len(samples) else np.zeros(1, dtype=np.int64)
    lengths = np.diff(edges)
    return edges[:-1][lengths >= at_least], lengths[lengths >= at_least]


_CHECKS: tuple[Callable[[Recording], list[Finding]], ...] = (
    _impossible_values,
    _yaw_rate_unit,
    _kinematic_sign,
    _sideslip_unit,
    _not_measured,
    _stuck,
    _saturated,
    _steering_offset,
    _wheel_dropout,
    _reverse,
)
