"""What may be wrong with a recording: each check looks for one thing and says where it found it."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy import ndimage, signal

from vehest.alignment.bandwidth import held_findings, low_pass_findings, low_passed
from vehest.alignment.delays import delay_findings, delays_of, spectra_of
from vehest.alignment.findings import Finding
from vehest.alignment.motion import Motion, motion_of
from vehest.alignment.offsets import offset_findings
from vehest.alignment.signs import (
    KINEMATIC_BAND_HZ,
    LEAST_SLIDING,
    SIGN_CORRELATION,
    relations_of,
    settled_samples,
    sign_findings,
    turned_channels,
    wrong_unit,
)
from vehest.alignment.standstill import long_runs, standstill
from vehest.data.channels import CHANNELS
from vehest.data.recording import Recording

__all__ = ["Finding", "checks_of_recording"]

MOST_WRONG_UNITS = 3
STUCK_SECONDS = 1.0
SATURATED_FRACTION = 2e-3
SATURATED_EXCESS = 4  # a quantised sine sits at its peak 2.4 times as often as one level below
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


def _agreement(recording: Recording) -> list[Finding]:
    """Channels that planar motion ties together: signs and units first, the rest with these put right."""
    motion = motion_of(recording)
    if not motion.moving.any():
        return []
    relations = relations_of(motion)
    findings = sign_findings(relations, motion)
    turned = turned_channels(relations, motion)
    if turned:
        motion = motion.corrected(dict.fromkeys(turned[0], -1.0))
        relations = relations_of(motion)
    for _ in range(MOST_WRONG_UNITS):
        wrong = wrong_unit(relations)
        if wrong is None:
            break
        findings.append(wrong.finding)
        if not wrong.explanations:
            break
        motion = motion.corrected(wrong.factors)
        relations = relations_of(motion)
    clocks: list[Finding] = []
    spectra = spectra_of(motion)
    if spectra is not None:
        slow = low_passed(motion, spectra)
        clocks = low_pass_findings(motion, spectra, slow) + delay_findings(delays_of(motion, spectra, frozenset(slow)))
    explained = any(finding.channel in ("ay", "yaw_rate", "vy_ref") for finding in clocks)
    kinematics = [finding for finding in _kinematics(motion) if finding.level == "note" or not explained]
    return findings + kinematics + offset_findings(motion) + clocks


def _kinematics(motion: Motion) -> list[Finding]:
    """ay - vx·yaw_rate must follow d(vy_ref)/dt (Da Lio et al. 2023, Eq. 4a)."""
    settled = settled_samples(motion)
    if settled is None or motion.velocity != "vy_ref" or not {"ay", "yaw_rate"} <= set(motion.channels):
        return []
    band = signal.butter(2, KINEMATIC_BAND_HZ, btype="bandpass", fs=motion.rate_hz, output="sos")
    expected = motion["ay"] - motion.turning
    predicted, derived = (signal.sosfiltfilt(band, samples)[settled] for samples in (expected, motion.sliding))
    if predicted.std() == 0.0 or derived.std() < LEAST_SLIDING:
        return []
    correlation = float(np.corrcoef(predicted, derived)[0, 1])
    where = f"between {KINEMATIC_BAND_HZ[0]:g} and {KINEMATIC_BAND_HZ[1]:g} Hz"
    if not correlation >= SIGN_CORRELATION:
        return [
            Finding(
                "warning",
                "kinematics",
                "vy_ref",
                f"ay - vx·yaw_rate hardly follows d(vy_ref)/dt (correlation {correlation:.2f} {where}): "
                f"check units, delays and where the sensors sit",
            )
        ]
    bias = float((motion.sliding - expected)[motion.moving].mean())
    return [
        Finding(
            "note",
            "kinematics",
            "vy_ref",
            f"d(vy_ref)/dt follows ay - vx·yaw_rate (correlation {correlation:.2f} {where}), mean bias {bias:.3f} m/s²",
        )
    ]


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
    moving = ~standstill(recording)
    moved = np.concatenate([[0], np.cumsum(moving)])
    for name, samples in recording.channels.items():
        known = np.flatnonzero(~np.isnan(samples))
        unit = CHANNELS[name].unit
        if CHANNELS[name].rests and not samples[known].any():
            continue
        if len(known) > 1 and (samples[known] == samples[known[0]]).all():
            findings.append(Finding("warning", "stuck", name, f"never changes: {samples[known[0]]:.6g} {unit} throughout"))
            continue
        starts, lengths = long_runs(samples[known], at_least=3)
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
    moving = ~standstill(recording)
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
        starts, lengths = long_runs(rolling & (wheels[:, place] < DROPOUT_SHARE * others), at_least=1)
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
    starts, lengths = long_runs(samples < -REVERSE_SPEED, at_least=math.ceil(REVERSE_SECONDS * recording.rate_hz))
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


_CHECKS: tuple[Callable[[Recording], list[Finding]], ...] = (
    _impossible_values,
    _agreement,
    _not_measured,
    _stuck,
    held_findings,
    _saturated,
    _steering_offset,
    _wheel_dropout,
    _reverse,
)
