"""Channels that show less than their rate promises: low-passed, held and coarse ones."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from vehest.alignment.findings import Finding
from vehest.alignment.motion import Motion
from vehest.alignment.spectra import MAX_TIME_CONSTANT_SECONDS, CrossSpectra, Lag, Measured, lag_of
from vehest.alignment.standstill import BoolArray
from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.recording import Recording

# s; a delay that is surely longer is reported; one by holding is then a warning
MIN_REPORTED_DELAY_SECONDS = 0.015
MIN_PHASE_SHARE = 0.9  # smallest share of the phase that a low-pass must explain
# s, smallest time constant of a low-pass; a shorter one is a delay in the band where cars move
MIN_TIME_CONSTANT_SECONDS = 0.1
# s, longest lag of the yaw rate behind the steering angle that is not reported
MAX_YAW_RESPONSE_SECONDS = 0.3
MIN_CHANGES = 20  # smallest number of changes of value of a held channel
# largest share of changes of a held channel that follow the one before at once
MAX_ADJACENT_SHARE = 0.1
# share of changes by one quantum above which a channel is quantised, not held
MAX_SINGLE_STEP_SHARE = 0.5
# channels that may be coarse; health expects these to change all the time
COARSE_CHANNELS = ("vx", "yaw_rate", "ay", "ax")
# Hz, highest rate of a recording of which every sample counts; of a faster one every n-th sample
# does, as a model of a lower rate sees it
MAX_COARSE_RATE_HZ = 30.0
MAX_LEVELS = 5000.0  # largest number of steps in the range of a coarse channel
# the same of a faster recording, whose fine steps a model's rate averages out
MAX_LEVELS_OF_FAST = 500.0
# smallest share of the changes of a coarse channel that are whole numbers of its step
MIN_WHOLE_STEP_SHARE = 0.99
STEP_TOLERANCE = 0.02  # largest distance of such a change from whole numbers of the step, in steps
REPEAT_SECONDS = 0.5  # s around a sample in which repeated samples are counted
MIN_REPEAT_SHARE = 0.3  # share of repeated samples from which on health calls them held
# smallest share of the moving time in which a coarse channel repeats samples so
MIN_COARSE_SHARE = 0.05
# Hz, highest cut-off of the low-pass that removes the steps of a coarse channel
COARSE_CUTOFF_HZ = 3.0
MAX_CUTOFF_SHARE = 0.4  # largest ratio of this cut-off to the sampling rate
# m/s²; speeds change at about twice this, so that coarser steps need lower cut-offs
SPEED_CHANGE = 0.5


def low_passed(motion: Motion, spectra: CrossSpectra) -> dict[str, tuple[str, Lag]]:
    """Channels that follow others as a first-order low-pass does: name -> signal that it was
    compared with, lag.

    Where ay and yaw rate are held against each other, one that is low-passed makes the other lead;
    the one whose phase is explained better is named.

    Parameters
    ----------
    motion : Motion
        The channels.
    spectra : CrossSpectra
        Of `signals_to_compare`.

    Returns
    -------
    dict
        Only those with a time constant above MIN_TIME_CONSTANT_SECONDS over its whole 95 %
        interval.
    """
    lateral = f"d({motion.velocity})/dt"
    together = {"ay": {"ay": 1.0}, "lateral": {"turning": 1.0, "sliding": 1.0}}
    sideways = (
        spectra.combined(together)
        if {"ay", "turning", "sliding"} <= set(spectra.names)
        else spectra
    )
    candidates = [
        ("ax", f"d({motion.speed})/dt", _established(spectra, "forward", "ax")),
        ("yaw_rate", "yaw_rate_ref", _established(spectra, "yaw_rate_ref", "yaw_rate")),
        ("yaw_rate", f"(ay - {lateral})/{motion.speed}", _established(spectra, "turn", "turned")),
        ("ay", f"{motion.speed}·yaw_rate + {lateral}", _established(sideways, "lateral", "ay")),
    ]
    slow: dict[str, tuple[str, Lag]] = {}
    for channel, text, lag in candidates:
        if lag is not None and (
            channel != "ay" or "yaw_rate" not in slow or lag.fit > slow["yaw_rate"][1].fit
        ):
            slow.setdefault(channel, (text, lag))
    return slow


def _established(spectra: CrossSpectra, source: str, follower: str) -> Lag | None:
    """The lag of a follower if it is surely that of a low-pass: well explained, slow, and not ahead
    of its source; else None.
    """
    lag = lag_of(spectra, source, follower, low_pass=True)
    if (
        lag is None
        or lag.fit < MIN_PHASE_SHARE
        or lag.time_constant.value >= MAX_TIME_CONSTANT_SECONDS
    ):
        return None
    advanced = lag.delay.high < -MIN_REPORTED_DELAY_SECONDS  # no sensor leads the motion
    slow = min(lag.time_constant.low, lag.together.low) > MIN_TIME_CONSTANT_SECONDS
    return lag if slow and not advanced else None


def low_pass_findings(
    motion: Motion, spectra: CrossSpectra, slow: Mapping[str, tuple[str, Lag]]
) -> list[Finding]:
    """Warnings of low-passed channels, and of a yaw rate that only the steering angle can be held
    against.

    Parameters
    ----------
    motion : Motion
        The channels.
    spectra : CrossSpectra
        Of `signals_to_compare`.
    slow : mapping
        As `low_passed` returns it.
    """
    findings = []
    for channel, (text, lag) in slow.items():
        message = (
            f"low-passed: it lags {text} like a first-order low-pass with a time constant of "
            f"{_seconds(lag.time_constant)}; use it only with an estimator trained on it, or leave "
            "it out"
        )
        findings.append(Finding("warning", "bandwidth", channel, message))
    steered = (
        lag_of(spectra, "steered", "yaw_rate", low_pass=True)
        if not {"ay", "yaw_rate_ref"} & set(motion.channels)
        else None
    )
    if (
        steered is not None
        and steered.fit > MIN_PHASE_SHARE
        and steered.together.low > MAX_YAW_RESPONSE_SECONDS
    ):
        message = (
            f"lags {motion.steering} by {_seconds(steered.together)}, more than the "
            f"{MAX_YAW_RESPONSE_SECONDS:g} s usual for cars: it is low-passed or delayed, or "
            f"{motion.steering} is a command; with ay or yaw_rate_ref the check can decide"
        )
        findings.append(Finding("warning", "bandwidth", "yaw_rate", message))
    return findings


def _seconds(measured: Measured) -> str:
    """Text of a time with its 95 % interval, whose lower end is at least zero."""
    return f"{measured.value:.2g} s (95 %: {max(measured.low, 0.0):.2g} to {measured.high:.2g})"


def repetition_findings(recording: Recording, moving: BoolArray) -> list[Finding]:
    """Channels whose samples repeat in steps: a slower sensor, whose last value was held. Those of
    one rate make one finding.

    Parameters
    ----------
    recording : Recording
        Any channels.
    moving : BoolArray
        Where the car moves, (T,); other samples do not count.

    Returns
    -------
    list of Finding
        A warning where the mean delay by holding, half an update, exceeds
        MIN_REPORTED_DELAY_SECONDS, else a note.
    """
    findings = []
    for rate_text, names in held_channels(recording, moving).items():
        delay = 0.5 / float(rate_text)
        further = f" (also {', '.join(names[1:])})" if len(names) > 1 else ""
        message = (
            f"updated at only {rate_text} Hz and held in between{further}, in a recording at "
            f"{recording.rate_hz:.4g} Hz, which delays it by {1e3 * delay:.3g} ms on average; "
            f"of a table, declare held: {{channels: [{', '.join(names)}]}}, which draws lines "
            f"between new samples; else downsample to {rate_text} Hz"
        )
        findings.append(
            Finding(
                "warning" if delay > MIN_REPORTED_DELAY_SECONDS else "note",
                "held",
                names[0],
                message,
            )
        )
    return findings


def held_channels(recording: Recording, moving: BoolArray) -> dict[str, list[str]]:
    """Rates at which held channels are updated, as text [Hz] -> these channels.

    Only samples where the car is ``moving``, (T,), count.
    """
    names_by_rate: dict[str, list[str]] = {}
    for name, samples in recording.channels.items():
        rate = update_rate_hz(samples[moving], recording.rate_hz)
        if rate is not None:
            names_by_rate.setdefault(f"{rate:.3g}", []).append(name)
    return names_by_rate


def coarse_findings(recording: Recording, moving: BoolArray) -> list[Finding]:
    """Warnings of `coarse_steps`, such as those of a speed in whole km/h, with the remedy."""
    return [
        Finding(
            "warning",
            "coarse",
            name,
            f"in steps of {step:.3g} {CHANNELS[name].unit}, between which samples repeat: a model "
            "that was calibrated on finer ones takes this for a fault; the transform "
            f"{{name: low_pass, cutoff_hz: {coarse_cutoff_hz(recording.rate_hz, name, step):g},"
            f" channels: [{name}]}} removes the steps; it uses samples of some periods of the "
            "cut-off later",
        )
        for name, step in coarse_steps(recording, moving).items()
    ]


def coarse_steps(recording: Recording, moving: BoolArray) -> dict[str, float]:
    """Coarse channel -> its step [SI]; channels that are held or have gaps are left out.

    A coarse channel changes by whole numbers of its step, between which its samples repeat; only
    those where the car is ``moving``, (T,), count.
    """
    steps = {}
    names = [name for name in COARSE_CHANNELS if name in recording]
    stride = math.ceil(recording.rate_hz / MAX_COARSE_RATE_HZ)
    n_samples = max(round(REPEAT_SECONDS * recording.rate_hz / stride), 1)
    for name in names:
        at_full_rate = recording[name][moving]
        samples = at_full_rate[::stride]
        changes = np.abs(np.diff(samples))
        width = np.ptp(samples) if len(samples) else 0.0
        is_change = changes > width / MAX_LEVELS
        if np.isnan(recording[name]).any() or np.count_nonzero(is_change) < MIN_CHANGES:
            continue
        step = float(changes[is_change].min())
        in_steps = changes[changes > 0.0] / step
        is_whole = np.abs(in_steps - np.rint(in_steps)) < STEP_TOLERANCE
        repeated = np.convolve(changes == 0.0, np.ones(n_samples) / n_samples, mode="same")
        if (
            step > width / (MAX_LEVELS if stride == 1 else MAX_LEVELS_OF_FAST)
            and is_whole.mean() >= MIN_WHOLE_STEP_SHARE
            and np.mean(repeated >= MIN_REPEAT_SHARE) >= MIN_COARSE_SHARE
            and update_rate_hz(at_full_rate, recording.rate_hz) is None
        ):
            steps[name] = step
    return steps


def coarse_cutoff_hz(rate_hz: float, name: str, step: float) -> float:
    """Cut-off of the low-pass that removes the steps (SI) of a coarse channel [Hz]."""
    slow = SPEED_CHANGE / step if name == "vx" else math.inf
    return float(f"{min(COARSE_CUTOFF_HZ, MAX_CUTOFF_SHARE * rate_hz, slow):.2g}")


def update_rate_hz(samples: FloatArray, rate_hz: float) -> float | None:
    """Rate at which a held channel, (T,), really changes [1/s]; None if it is not held.

    A held channel hardly ever changes twice in a row, and then by any amount. A quantised one does
    so too while it moves slowly, but by one quantum at a time.

    Parameters
    ----------
    samples : FloatArray
        (T,); NaN are left out.
    rate_hz : float
        Sampling rate [Hz].

    Returns
    -------
    float or None
        From the median distance of two changes; None also for fewer than MIN_CHANGES changes.
    """
    steps = np.diff(samples[np.isfinite(samples)])
    changes = np.flatnonzero(steps)
    if len(changes) < MIN_CHANGES:
        return None
    spacing = np.diff(changes)
    if np.mean(spacing == 1) > MAX_ADJACENT_SHARE:
        return None
    sizes = np.abs(steps[changes])
    if np.mean(sizes < 1.5 * sizes.min()) > MAX_SINGLE_STEP_SHARE:
        return None
    return float(rate_hz / np.median(spacing))
