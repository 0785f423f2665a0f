"""Checks of a recording: each looks for one kind of fault and names where it is.

Flow: recording -> parts of a long drive -> where the car moves (`standstill`) -> each function of
`_CHECKS` -> findings, merged over the parts and sorted by level. A check yields nothing where its
channels are missing.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from itertools import pairwise

import numpy as np
import scipy
from numpy.typing import NDArray

from vehest.alignment.bandwidth import (
    coarse_findings,
    low_pass_findings,
    low_passed,
    repetition_findings,
)
from vehest.alignment.computed import computed_findings
from vehest.alignment.delays import delay_findings, delays_of, spectra_of
from vehest.alignment.findings import Finding
from vehest.alignment.motion import WHEELS, Motion, motion_of
from vehest.alignment.offsets import offset_findings
from vehest.alignment.signs import (
    KINEMATIC_BAND_HZ,
    MIN_SAMPLES,
    MIN_SIGN_CORRELATION,
    MIN_SLIDING,
    kinematic_band,
    relations_of,
    reversed_channels,
    sign_findings,
    wrong_unit,
)
from vehest.alignment.standstill import BoolArray, standstill
from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.derived import STANDSTILL_SPEED, has_measured_ax
from vehest.data.errors import DataError, number_of
from vehest.data.recording import MISSING, PART, Recording, part_slices
from vehest.data.runs import equal_runs, true_runs

__all__ = ["Finding", "checks_of_recording"]

MAX_WRONG_UNITS = 3  # units that are corrected one after another; further ones are not reported
STUCK_SECONDS = 1.0  # s of driving with one value, from which on a channel counts as stuck
MIN_STUCK_SAMPLES = 3  # equal samples in a row; shorter runs do not count as stuck
MIN_COARSE_LEVELS = 10  # different values of a coarse sensor; a command that rests takes fewer
# share of the samples at an extreme value above which it may be saturation
SATURATED_FRACTION = 2e-3
# smallest ratio of the samples at a saturated value to those at the next one; a quantised sine has
# 2.4 at its peak
SATURATED_EXCESS = 4
USUAL_QUANTILES = (0.005, 0.995)  # quantiles of a channel's samples that bound its usual range
SPIKE_EXCESS = 1.0  # widths of the usual range; samples that lie further beyond it may be spikes
SPIKE_SECONDS = 0.25  # s; a longer excursion beyond the usual range is no spike
USUAL_STEP_QUANTILE = 0.995  # quantile of |steps between samples| that is the usual step
# smallest jump of a spike, in usual steps: a sensor that shakes jumps all the time
SPIKE_STEP = 3.0
# smallest jump away and back of an excursion within the usual range, in usual steps
JUMP_STEP = 20.0
MIN_CODES = 3  # smallest number of equal samples that may be a code other than zero
JUMP_SECONDS = 1.0  # s; a longer excursion within the usual range is not reported
STRAIGHT_YAW_RATE = 0.02  # rad/s, largest yaw rate that counts as straight ahead
STRAIGHT_SPEED = 3.0  # m/s, lowest speed of samples that count as straight ahead
# s, shortest time of driving straight ahead by which steering offset and speed are checked
STRAIGHT_SECONDS = 3.0
# rad, largest offset while driving straight ahead; for the steering wheel more than the crown of a
# road requires
MAX_STEERING_OFFSETS = {"steer": np.deg2rad(3.0), "handwheel": np.deg2rad(2.5)}
# rad, steps of a steering wheel's angle from one sample to the next that are those of a full turn:
# a hand turns it by less
FULL_TURN = (1.5 * np.pi, 2.5 * np.pi)
# largest difference from the reference's speed, as a share of it; speedometers read up to 10 % too
# much
MAX_SPEED_DIFFERENCE = 0.04
# largest such share that is an error of reading; beyond it a unit may be wrong
MAX_READING_ERROR = 0.35
MIN_ROTATION = np.deg2rad(4.0)  # rad, smallest mounting angle about the vertical that is reported
# smallest ratio of the smaller to the larger of two estimates of that angle
MIN_ROTATION_AGREEMENT = 0.6
# m/s², smallest standard deviation of d(vx)/dt and of vx·yaw_rate by which it is estimated
MIN_ROTATION_MOTION = 0.4
MAX_ROTATION_GAIN_ERROR = 0.35  # largest distance of either gain from 1 for a rotation
DROPOUT_SPEED = 3.0  # m/s, lowest speed at which wheels are checked
DROPOUT_SHARE = 0.1  # speed of a wheel over the other wheels' median below which its signal is lost
DROPOUT_SECONDS = 0.1  # s, shortest loss that is reported
DROPOUT_BRAKING = 4.0  # m/s²; while braking harder a wheel may be locked, and does not count
DROPOUT_CLEAR_SECONDS = 1.0  # s before and after such braking that do not count either
REVERSE_SPEED = 0.5  # m/s, lowest speed at which a car that goes backwards is reversing
REVERSE_SECONDS = 1.0  # s, shortest time of driving backwards that is reported
# m/s, highest speed of a car that reverses; below it, the signs of ay and steering decide
MAX_REVERSE_SPEED = 8.0
MIN_REVERSE_YAW_RATE = 0.03  # rad/s, smallest yaw rate at which the signs of ay and steering count


def checks_of_recording(recording: Recording) -> list[Finding]:
    """Check the samples of a recording; a long drive part by part.

    Of a part of a drive in which the car stands throughout only impossible values count.

    Parameters
    ----------
    recording : Recording
        Any channels, in SI units.

    Returns
    -------
    list of Finding
        Errors first, then warnings, then notes; merged over the parts by `merged_findings`.
    """
    slices = part_slices(len(recording), recording.rate_hz)
    is_undivided = len(slices) == 1 and PART not in recording.provenance
    with np.errstate(all="ignore"):  # of samples up to 1e308, which a check may square
        return merged_findings(
            _findings(recording.part(part), is_undivided=is_undivided) for part in slices
        )


def _findings(recording: Recording, *, is_undivided: bool) -> list[Finding]:
    """Findings of one part of a drive, or of all of it if ``is_undivided``.

    Of a part in which the car stands throughout, only impossible values count.
    """
    moving = ~standstill(recording)
    checks = _CHECKS if is_undivided or moving.any() else (_impossible_values,)
    return [finding for check in checks for finding in check(recording, moving)]


def merged_findings(parts: Iterable[Sequence[Finding]]) -> list[Finding]:
    """Findings in the parts of a drive, the gravest first: of each level, check and channel those
    of the first part that has any.

    Parameters
    ----------
    parts : iterable of sequence of Finding
        In the order of time.
    """
    merged: list[Finding] = []
    for part in parts:
        earlier = {(finding.level, finding.check, finding.channel) for finding in merged}
        merged += [
            finding
            for finding in part
            if (finding.level, finding.check, finding.channel) not in earlier
        ]
    order = {"error": 0, "warning": 1, "note": 2}
    return sorted(merged, key=lambda finding: order[finding.level])


def refuse_errors(recording: Recording, accepted: Collection[str], place: str) -> list[Finding]:
    """Findings of a recording, of which none may be an error.

    Parameters
    ----------
    recording : Recording
        As `checks_of_recording` takes it.
    accepted : collection of str
        Checks whose errors are accepted.
    place : str
        Beginning of an error's message.

    Returns
    -------
    list of Finding
        All of them, for the user to see.

    Raises
    ------
    DataError
        A finding of a check that is not accepted is an error.
    """
    findings = checks_of_recording(recording)
    for finding in findings:
        if finding.level == "error" and finding.check not in accepted:
            raise DataError(
                f"{place}: channel '{finding.channel}': {finding.message} (to accept it: "
                f"dataset.accept=[{finding.check}])"
            )
    return findings


def _impossible_values(recording: Recording, _: BoolArray) -> Iterator[Finding]:
    """Samples outside the range that a channel's description allows; an error, unless a simulated
    car spun.
    """
    spun = bool(dict(recording.provenance.get("flags") or {}).get("spun"))
    for name, samples in recording.channels.items():
        channel = CHANNELS[name]
        outside = np.flatnonzero((samples < channel.low) | (samples > channel.high))
        if not len(outside):
            continue
        worst = outside[np.argmax(np.abs(samples[outside]))]
        remedy = (
            "if the column is in degrees, set its unit: deg or deg/s"
            if channel.is_angular
            else "check the column and its unit"
        )
        message = (
            f"{number_of(len(outside), 'sample')} outside the possible range "
            f"({channel.low:.4g} to {channel.high:.4g} {channel.unit}), the largest "
            f"{samples[worst]:.6g} {channel.unit} at t = {recording.time[worst]:.12g} s; "
            f"{'the simulated car spun here' if spun else remedy}"
        )
        yield Finding("note" if spun else "error", "impossible", name, message)


def _agreement(recording: Recording, moving: BoolArray) -> list[Finding]:
    """Channels that planar motion ties together: signs and units first, the rest with these put
    right.

    Units are corrected one after another, at most MAX_WRONG_UNITS, so that one wrong unit is not
    reported of every channel that is compared with it. Where a delay or low-pass of ay, yaw rate or
    vy explains poor kinematics, only the former is reported.
    """
    motion = motion_of(_without_ax_of_speed(recording), moving)
    if not motion.moving.any():
        return []
    relations = relations_of(motion)
    turned = reversed_channels(relations, motion)
    findings = sign_findings(relations, motion, turned)
    if turned:
        motion = motion.corrected(dict.fromkeys(turned[0], -1.0))
        relations = relations_of(motion)
    for _ in range(MAX_WRONG_UNITS):
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
        clocks = (
            low_pass_findings(motion, spectra, slow)
            + delay_findings(delays_of(motion, spectra, frozenset(slow)))
            + computed_findings(motion, spectra)
        )
    explained = any(finding.channel in ("ay", "yaw_rate", "vy_ref") for finding in clocks)
    kinematics = [
        finding for finding in _kinematics(motion) if finding.level == "note" or not explained
    ]
    rotation = [] if findings else list(_rotation(motion))
    return findings + kinematics + rotation + offset_findings(motion) + clocks


def _without_ax_of_speed(recording: Recording) -> Recording:
    """The recording without an ax that a transform made from its speed: that one is late by the
    transform's filter, as it has to be on a car, and says nothing of the log.
    """
    if has_measured_ax(recording):
        return recording
    return recording.select([name for name in recording.channels if name != "ax"])


def _kinematics(motion: Motion) -> Iterator[Finding]:
    """Findings where ay - vx·yaw_rate does not follow d(vy_ref)/dt (Da Lio et al. 2023, Eq. 4a)."""
    band = kinematic_band(motion)
    if (
        band is None
        or motion.velocity != "vy_ref"
        or not {"ay", "yaw_rate"} <= set(motion.channels)
    ):
        return
    expected = motion["ay"] - motion.turning
    predicted = band(expected)
    derived = band(motion.sliding)
    if predicted.std() == 0.0 or derived.std() < MIN_SLIDING:
        return
    correlation = float(np.corrcoef(predicted, derived)[0, 1])
    low_hz, high_hz = KINEMATIC_BAND_HZ
    figures = (
        f"d(vy_ref)/dt vs. ay - vx·yaw_rate: correlation {correlation:.2f} ({low_hz:g} to "
        f"{high_hz:g} Hz)"
    )
    if correlation >= MIN_SIGN_CORRELATION:
        bias = float((motion.sliding - expected)[motion.moving].mean())
        message = f"{figures}, mean difference {bias:.3f} m/s²"
        yield Finding("note", "kinematics", "vy_ref", message)
    else:
        message = (
            f"{figures}, expected at least {MIN_SIGN_CORRELATION:g}: "
            "check units, delays and sensor positions"
        )
        yield Finding("warning", "kinematics", "vy_ref", message)


def _rotation(motion: Motion) -> Iterator[Finding]:
    """Findings of a turned inertial unit: d(vx)/dt must show in ax alone and vx·yaw_rate in ay
    alone.

    A unit that is turned by ψ about the vertical, counter-clockwise, reads ax = cos ψ d(vx)/dt +
    sin ψ vx·yaw_rate and ay = -sin ψ d(vx)/dt + cos ψ vx·yaw_rate; each of the two has its own
    estimate of ψ.
    """
    band = kinematic_band(motion)
    if band is None or not motion.speed or not {"ax", "ay", "yaw_rate"} <= set(motion.channels):
        return
    causes = np.stack([band(motion.derivative(motion.vx)), band(motion.turning)], axis=1)
    if causes.std(axis=0).min() < MIN_ROTATION_MOTION:
        return
    effects = np.stack([band(motion["ax"]), band(motion["ay"])], axis=1)
    (along, across), (turning_in_ax, turning_in_ay) = np.linalg.lstsq(causes, effects)[0]
    angles = np.arctan2(turning_in_ax, turning_in_ay), np.arctan2(-across, along)
    small, large = sorted(angles, key=abs)
    gains = np.hypot(turning_in_ax, turning_in_ay), np.hypot(across, along)
    is_rotation = (
        small * large > 0.0 and max(np.abs(np.subtract(gains, 1.0))) < MAX_ROTATION_GAIN_ERROR
    )
    if is_rotation and abs(small) > max(MIN_ROTATION, MIN_ROTATION_AGREEMENT * abs(large)):
        angle = float(np.mean(angles))
        yield Finding(
            "warning",
            "rotation",
            "ay",
            f"the accelerometer is turned by about {np.rad2deg(angle):.2g} deg about the vertical: "
            "braking and accelerating show in ay, turning shows in ax; the transform "
            f"mounting_correction removes it (yaw: {angle:.2g} rad)",
        )


def _not_measured(recording: Recording, _: BoolArray) -> Iterator[Finding]:
    """Samples that are missing, that the source interpolated, or at which it ended the
    recording.
    """
    for name, texts in (recording.provenance.get(MISSING) or {}).items():
        for text in texts:
            yield Finding("warning", "missing", name, text)
    for name in sorted(recording.gappy):
        missing = int(np.isnan(recording[name]).sum())
        if missing:
            message = f"{100 * missing / len(recording):.1f} % of the samples are missing"
            yield Finding("note", "nan", name, message)


def _stuck(recording: Recording, moving: BoolArray) -> Iterator[Finding]:
    """Findings of values that stay the same for long while the car moves; at standstill nothing
    needs to change.
    """
    moved = np.concatenate([[0], np.cumsum(moving)])
    for name, samples in recording.channels.items():
        rows = np.flatnonzero(~np.isnan(samples))
        measured = samples[rows]
        unit = CHANNELS[name].unit
        rests = CHANNELS[name].rests
        if rests and not measured.any():
            continue
        runs = equal_runs(measured)
        if len(measured) > 1 and len(runs) == 1:
            message = (
                f"constant at {measured[0]:.6g} {unit} throughout; "
                "check the sensor, or leave the channel out"
            )
            yield Finding("warning", "stuck", name, message)
            continue
        runs = runs[
            (runs[:, 1] - runs[:, 0] >= MIN_STUCK_SAMPLES)
            & ~(rests & (measured[runs[:, 0]] == 0.0))
            & ~_goes_on_by_one_step(measured, runs)
        ]
        begins = rows[runs[:, 0]]
        ends = rows[runs[:, 1] - 1] + 1
        moving_samples = moved[ends] - moved[begins]
        is_stuck = moving_samples >= STUCK_SECONDS * recording.rate_hz
        if is_stuck.any():
            longest = int(np.argmax(moving_samples))
            first = int(begins[longest] + np.argmax(moving[begins[longest] : ends[longest]]))
            n_others = int(is_stuck.sum()) - 1
            others = f", and in {number_of(n_others, 'other segment')}" if n_others else ""
            message = (
                f"constant at {samples[first]:.6g} {unit} for "
                f"{moving_samples[longest] / recording.rate_hz:.3g} s from t = "
                f"{recording.time[first]:.12g} s while the car moves{others}; check the sensor, or "
                f"exclude {'these ranges' if others else 'this range'}"
            )
            yield Finding("warning", "stuck", name, message)


def _goes_on_by_one_step(samples: FloatArray, runs: NDArray[np.int64]) -> BoolArray:
    """Whether a coarse channel enters and leaves each of the runs of equal values (N, 2) by its
    smallest step, as a sensor that was stuck does not; none where it takes few values, as a command
    does.
    """
    if len(np.unique(samples)) < MIN_COARSE_LEVELS:
        return np.zeros(len(runs), bool)
    steps = np.concatenate([[0.0], np.abs(np.diff(samples)), [0.0]])
    smallest = steps[steps > 1e-9 * steps.max()].min(initial=np.inf)
    return np.asarray(np.maximum(steps[runs[:, 0]], steps[runs[:, 1]]) < 1.5 * smallest)


def _saturated(recording: Recording, moving: BoolArray) -> Iterator[Finding]:
    """Samples that pile up at the highest or lowest value, again and again, far more often than at
    the value next to it.
    """
    for name, samples in recording.channels.items():
        measured = samples[np.isfinite(samples) & moving]
        if len(measured) < MIN_SAMPLES:
            continue
        lowest = measured.min()
        highest = measured.max()
        between = measured[(measured > lowest) & (measured < highest)]
        if not len(between):
            continue
        for side, extreme, beside in (
            ("highest", highest, between.max()),
            ("lowest", lowest, between.min()),
        ):
            at = measured == extreme
            number = int(at.sum())
            if (
                abs(extreme) >= 0.1 * max(abs(lowest), abs(highest))
                and number > SATURATED_FRACTION * len(measured)
                and number >= SATURATED_EXCESS * np.count_nonzero(measured == beside)
                and len(true_runs(at)) > 1
            ):
                message = (
                    f"saturated: {100 * number / len(measured):.2g} % of the samples are at the "
                    f"{side} value, {extreme:.6g} {CHANNELS[name].unit}; "
                    "check the range of the sensor, or exclude these samples"
                )
                yield Finding("warning", "saturated", name, message)


def _spikes(recording: Recording, _: BoolArray) -> Iterator[Finding]:
    """Findings of short excursions that begin and end with a jump: far beyond the usual range, or
    to one value by steps that are far larger than usual.

    A code for "not available", a lost bit or a zero for want of a sample looks so; a manoeuvre
    needs longer to come and go. A wheel that shows nothing is the finding ``dropout``.
    Those beyond what a vehicle can do are the finding ``impossible``. A sideslip angle without
    speed is noise.
    """
    speed = np.abs(recording["vx"]) if "vx" in recording else np.full(len(recording), np.inf)
    for name, samples in recording.channels.items():
        counts = (samples >= CHANNELS[name].low) & (samples <= CHANNELS[name].high)
        if name == "sideslip_ref":
            counts &= speed > STANDSTILL_SPEED
        rows = np.flatnonzero(np.isfinite(samples))
        measured = samples[rows]
        if len(measured) < MIN_SAMPLES:
            continue
        low, high = np.quantile(measured, USUAL_QUANTILES)
        excess = SPIKE_EXCESS * (high - low)
        steps = np.abs(np.diff(measured))
        jump = max(excess, SPIKE_STEP * float(np.quantile(steps, USUAL_STEP_QUANTILE)))
        is_jump = np.pad(steps > jump, 1)
        is_open = np.pad(np.diff(rows) > 1, 1, constant_values=True)  # an end, or missing samples
        # before its first step, or after its last one, a command rests near zero
        reach = max(high, 0.0) - min(low, 0.0)
        is_far = (measured > max(high, 0.0) + reach) | (measured < min(low, 0.0) - reach)
        max_samples = max(SPIKE_SECONDS * recording.rate_hz, 1.0)
        spikes = [
            (int(rows[begin]), int(rows[end - 1]) + 1)
            for begin, end in true_runs((measured > high + excess) | (measured < low - excess))
            if end - begin <= max_samples
            and (is_jump | is_open)[[begin, end]].all()
            and is_jump[[begin, end]].any()
            and (is_jump[[begin, end]].all() or is_far[begin:end].all())
            and counts[rows[begin:end]].all()
        ]
        unit = CHANNELS[name].unit
        if spikes:
            sizes = np.abs(samples)
            begin, end = max(spikes, key=lambda run: float(np.nanmax(sizes[slice(*run)])))
            at = begin + int(np.nanargmax(sizes[begin:end]))
            message = (
                f"{number_of(len(spikes), 'spike')} of at most {SPIKE_SECONDS:g} s far outside the "
                f"usual range ({low:.4g} to {high:.4g} {unit}), the largest {samples[at]:.4g} "
                f"{unit} at t = {recording.time[at]:.12g} s; mark these samples as missing, or "
                "exclude them"
            )
            yield Finding("warning", "spike", name, message)
        jumps = [
            run
            for run in _between_jumps(samples, recording.rate_hz)
            if run not in spikes and name not in WHEELS and counts[slice(*run)].all()
        ]
        if jumps:
            begin, end = max(jumps, key=lambda run: run[1] - run[0])
            message = (
                f"jumps away and back {number_of(len(jumps), 'time')} within {JUMP_SECONDS:g} s, "
                f"the longest to {samples[begin]:.4g} {unit} for "
                f"{(end - begin) / recording.rate_hz:.3g} s from t = {recording.time[begin]:.12g} "
                "s; mark these samples as missing, or exclude them"
            )
            yield Finding("warning", "spike", name, message)


def _between_jumps(samples: FloatArray, rate_hz: float) -> Iterator[tuple[int, int]]:
    """Runs of equal samples, or a single sample of a code, between two jumps that lead away and
    back, or between a jump and an end of the recording.
    """
    rows = np.flatnonzero(np.isfinite(samples))
    measured = samples[rows]
    steps = np.diff(measured)
    usual, codes = _usual_step(measured)
    jumps = np.flatnonzero((np.abs(steps) > JUMP_STEP * usual) & (usual > 0.0)) + 1
    for first, after in pairwise([0, *jumps.tolist(), len(rows)] if len(jumps) else ()):
        away = steps[first - 1] if first else -steps[after - 1]
        back = steps[after - 1] if after < len(rows) else -away
        is_return = abs(away + back) < 0.5 * min(abs(away), abs(back))
        run = measured[first:after]
        is_code = np.ptp(run) == 0.0 and (after - first > 1 or run[0] in codes)
        begin = int(rows[first])
        end = int(rows[after - 1]) + 1
        if is_return and is_code and end - begin <= JUMP_SECONDS * rate_hz:
            yield begin, end


def _usual_step(measured: FloatArray) -> tuple[float, set[float]]:
    """Usual |step| between samples, and values that may be codes: zero and the most frequent one,
    whose jumps may be so frequent that they do not count.
    """
    values, counts = np.unique(measured, return_counts=True)
    codes = {0.0, *values[counts == max(counts.max(), MIN_CODES)].tolist()}
    others = measured[~np.isin(measured, [*codes])]
    steps = np.abs(np.diff(others if len(others) > 0.5 * len(measured) else measured))
    return float(np.quantile(steps, USUAL_STEP_QUANTILE)), codes


def _steering_offset(recording: Recording, _: BoolArray) -> Iterator[Finding]:
    """Findings of a steering angle that is not about zero straight ahead: its median where a moving
    car hardly turns, less what is proportional to yaw_rate/vx.
    """
    for name, max_offset in MAX_STEERING_OFFSETS.items():
        if not {"vx", "yaw_rate", name} <= set(recording.channels):
            continue
        if name == "handwheel" and len(_rows_of_full_turns(recording)):
            continue
        straight = (
            (recording["vx"] > STRAIGHT_SPEED)
            & (np.abs(recording["yaw_rate"]) < STRAIGHT_YAW_RATE)
            & np.isfinite(recording[name])
        )
        seconds = straight.sum() / recording.rate_hz
        if seconds < STRAIGHT_SECONDS:
            continue
        angles = recording[name][straight]
        curvature = recording["yaw_rate"][straight] / recording["vx"][straight]
        change = curvature - curvature.mean()
        gain = float(change @ angles) / max(float(change @ change), 1e-300)
        angles = angles - gain * curvature
        offset = float(np.median(angles))
        uncertainty = float(angles.std()) / np.sqrt(len(true_runs(straight)))
        if abs(offset) >= max(max_offset, 2.0 * uncertainty):
            message = (
                f"median of {np.rad2deg(offset):.3g} deg while driving straight ahead "
                f"(|yaw_rate| < {STRAIGHT_YAW_RATE:g} rad/s, {seconds:.3g} s); "
                f"the transform offset_correction removes it ({name}: {offset:.3g} rad)"
            )
            yield Finding("warning", "offset", name, message)


def _full_turns(recording: Recording, _: BoolArray) -> Iterator[Finding]:
    """A steering wheel's angle steps by a full turn where it is counted from 0 to 360 degrees, or
    where its sensor finds zero only while driving.
    """
    rows = _rows_of_full_turns(recording)
    if len(rows):
        message = (
            f"{number_of(len(rows), 'step')} of a full turn from one sample to the next, the first "
            f"at t = {recording.time[rows[0]]:.12g} s; write the angle without them, for example "
            "by numpy.unwrap(angle, period=360) of degrees"
        )
        yield Finding("warning", "full_turn", "handwheel", message)


def _rows_of_full_turns(recording: Recording) -> NDArray[np.int64]:
    """Samples before which the steering wheel's angle steps by about a full turn."""
    if "handwheel" not in recording:
        return np.empty(0, dtype=np.int64)
    steps = np.abs(np.diff(recording["handwheel"]))
    return np.flatnonzero((steps > FULL_TURN[0]) & (steps < FULL_TURN[1])) + 1


def _speed_difference(recording: Recording, _: BoolArray) -> Iterator[Finding]:
    """Findings of a speed that is not the reference's straight ahead, where wheels slip least."""
    if not {"vx", "vx_ref", "yaw_rate"} <= set(recording.channels):
        return
    is_straight = np.abs(recording["yaw_rate"]) < STRAIGHT_YAW_RATE
    driven = is_straight & (recording["vx_ref"] > STRAIGHT_SPEED) & np.isfinite(recording["vx"])
    if driven.sum() < STRAIGHT_SECONDS * recording.rate_hz:
        return
    ratio = float(np.median(recording["vx"][driven] / recording["vx_ref"][driven]))
    if MAX_SPEED_DIFFERENCE < abs(ratio - 1.0) < MAX_READING_ERROR:
        message = (
            f"{100.0 * abs(ratio - 1.0):.2g} % {'above' if ratio > 1.0 else 'below'} vx_ref "
            "(median straight ahead), as of a speedometer, worn tyres or a wrong wheel radius; if "
            f"vx_ref is right, multiply the channel's factor by {1.0 / ratio:.4g}"
        )
        yield Finding("warning", "unit", "vx", message)


def _wheel_dropout(recording: Recording, _: BoolArray) -> Iterator[Finding]:
    """A wheel that shows next to nothing beside the other three while the car neither stands nor
    brakes hard.

    On slippery roads wheels lock under gentle braking too; without a channel of the brakes that
    looks like a dropout.
    """
    if not {"vx", *WHEELS} <= set(recording.channels):
        return
    rolling = recording["vx"] > DROPOUT_SPEED
    if "ax" in recording:
        around = 2 * min(round(DROPOUT_CLEAR_SECONDS * recording.rate_hz), len(recording)) + 1
        rolling &= ~scipy.ndimage.maximum_filter1d(recording["ax"] < -DROPOUT_BRAKING, around)
    wheels = np.abs(recording.stack(WHEELS))
    for place, name in enumerate(WHEELS):
        median_of_rest = np.median(np.delete(wheels, place, axis=1), axis=1)
        runs = true_runs(rolling & (wheels[:, place] < DROPOUT_SHARE * median_of_rest))
        runs = runs[runs[:, 1] - runs[:, 0] > DROPOUT_SECONDS * recording.rate_hz]
        if len(runs):
            message = (
                f"{number_of(len(runs), 'dropout')}: below {100 * DROPOUT_SHARE:g} % of the other "
                f"wheels' speed, the longest {_longest(runs, recording)}; the transform "
                "speed_from_wheels ignores such a wheel"
            )
            yield Finding("warning", "dropout", name, message)


def _reverse(recording: Recording, _: BoolArray) -> Iterator[Finding]:
    """Notes of driving backwards, which is legitimate, although most estimators take the car to go
    forwards.
    """
    speed = "vx" if "vx" in recording else "vx_ref"
    if speed not in recording:
        return
    runs = _lasting_runs(recording[speed] < -REVERSE_SPEED, recording)
    if len(runs):
        lowest = min(float(recording[speed][begin:end].min()) for begin, end in runs.tolist())
        message = (
            f"reversing in {number_of(len(runs), 'segment')} (below -{REVERSE_SPEED:g} m/s for "
            f"{REVERSE_SECONDS:g} s or more), the longest {_longest(runs, recording)}, minimum "
            f"{lowest:.3g} m/s; most estimators assume forward driving: exclude the range (start "
            "and stop in the split), or set sign: -1 for the speed if the car drove forwards"
        )
        yield Finding("note", "reverse", speed, message)


def _unsigned_speed(recording: Recording, _: BoolArray) -> Iterator[Finding]:
    """A positive speed while the reference goes backwards, or while ay and steering both oppose the
    yaw rate for a part of the drive.
    """
    angle = next((name for name in ("steer", "handwheel") if name in recording), "")
    if "vx" not in recording or (
        "vx_ref" not in recording and not {"yaw_rate", "ay", angle} <= set(recording.channels)
    ):
        return
    if "vx_ref" in recording:
        backwards = recording["vx_ref"] < -REVERSE_SPEED
    else:
        n_second = min(round(recording.rate_hz) or 1, len(recording))
        rate, ay, turned = (
            np.convolve(recording[name], np.full(n_second, 1.0 / n_second), "same")
            for name in ("yaw_rate", "ay", angle)
        )
        turns = np.abs(rate) > MIN_REVERSE_YAW_RATE
        against = turns & (ay * rate < 0.0) & (turned * rate < 0.0)
        # in most turns it would be the sign of a channel that is wrong
        is_part = np.count_nonzero(against) < 0.5 * np.count_nonzero(turns)
        backwards = against & (recording["vx"] < MAX_REVERSE_SPEED) & is_part
    runs = _lasting_runs(backwards & (recording["vx"] > REVERSE_SPEED), recording)
    if len(runs):
        message = (
            f"unsigned: positive while the car reverses in {number_of(len(runs), 'segment')}, "
            f"the longest {_longest(runs, recording)}; exclude the range (start and stop in the "
            "split), or record a signed speed"
        )
        yield Finding("warning", "reverse", "vx", message)


def _lasting_runs(backwards: BoolArray, recording: Recording) -> NDArray[np.int64]:
    """Runs, (N, 2), in which the car goes backwards for `REVERSE_SECONDS` or more."""
    runs = true_runs(backwards)
    return runs[runs[:, 1] - runs[:, 0] >= REVERSE_SECONDS * recording.rate_hz]


def _longest(runs: NDArray[np.int64], recording: Recording) -> str:
    """Text of the length and begin of the longest run, (N, 2)."""
    begin, end = runs[np.argmax(runs[:, 1] - runs[:, 0])].tolist()
    return f"for {(end - begin) / recording.rate_hz:.3g} s from t = {recording.time[begin]:.12g} s"


# functions that check a recording
_CHECKS: tuple[Callable[[Recording, BoolArray], Iterable[Finding]], ...] = (
    _impossible_values,
    _agreement,
    _not_measured,
    _stuck,
    repetition_findings,
    coarse_findings,
    _saturated,
    _spikes,
    _steering_offset,
    _full_turns,
    _speed_difference,
    _wheel_dropout,
    _reverse,
    _unsigned_speed,
)
