"""Constant parts of ay and ax that motion does not explain."""

from __future__ import annotations

import math

import numpy as np

from vehest.alignment.findings import Finding, Level
from vehest.alignment.motion import Motion
from vehest.alignment.signs import settled_samples
from vehest.alignment.spectra import MAX_GROUPS, Measured, jackknife
from vehest.constants import GRAVITY, FloatArray

MIN_NOTED_OFFSET = 0.15  # m/s², smallest offset that is noted: that of a unit tilted by 0.9 degrees
# m/s², largest offset that is only noted: 2.9 degrees, more than the crown of a road and a careless
# mounting together
MAX_NOTED_OFFSET = 0.5
MAX_GYRO_OFFSET = 0.05  # rad/s, largest offset of the yaw rate that is named as a possible cause
# m/s², largest offset of a unit that is only tilted, by 30 degrees; no more is mounted so
MAX_INCLINED_OFFSET = 0.5 * GRAVITY
BLOCK_SECONDS = 2.0  # s, shortest block of time
MIN_BLOCKS = 6  # smallest number of blocks with which there is an interval, and an offset


def lateral_offset(motion: Motion) -> Measured | None:
    """The constant c of ay - d(vy)/dt = c + g·vx·yaw_rate over the drive [m/s²], with its interval
    from blocks of time.

    The gain g holds the gravity that roll lets in, which is no offset in a drive of left turns
    only. Without a lateral velocity its derivative counts as nil, which its mean is in any drive
    that is not short.

    Parameters
    ----------
    motion : Motion
        With a speed, ay and the yaw rate.

    Returns
    -------
    Measured or None
        None where a channel is missing, the drive is too short, or fewer than MIN_BLOCKS blocks of
        BLOCK_SECONDS are left.
    """
    settled = settled_samples(motion)
    if settled is None or not motion.speed or not {"ay", "yaw_rate"} <= set(motion.channels):
        return None
    left = motion["ay"] - motion.sliding if motion.velocity else motion["ay"]
    return _offset(left[settled], motion.turning[settled], motion.rate_hz)


def longitudinal_offset(motion: Motion) -> Measured | None:
    """The constant c of ax = c + g·(d(vx)/dt - vy·yaw_rate) [m/s²], as `lateral_offset` of ay.

    Parameters
    ----------
    motion : Motion
        With a speed and ax.

    Returns
    -------
    Measured or None
        None where a channel is missing or the drive is too short.
    """
    settled = settled_samples(motion)
    if settled is None or not motion.speed or "ax" not in motion:
        return None
    return _offset(motion["ax"][settled], motion.forward[settled], motion.rate_hz)


def _offset(effect: FloatArray, cause: FloatArray, rate_hz: float) -> Measured | None:
    """Intercept of an effect over its cause, (S,) each, with its interval from blocks of time."""
    number = min(int(len(effect) / (BLOCK_SECONDS * rate_hz)), MAX_GROUPS)
    if number < MIN_BLOCKS:
        return None
    starts = np.linspace(0, len(effect), number + 1).astype(int)[:-1]
    sums = np.stack(
        [
            np.add.reduceat(values, starts)
            for values in (np.ones(len(effect)), cause, effect, cause * cause, cause * effect)
        ]
    )
    (offset,) = jackknife(sums.T, _intercept)
    return offset if math.isfinite(offset.value) and math.isfinite(offset.half_width) else None


def _intercept(sums: FloatArray) -> FloatArray:
    """Intercept of a straight line from sums of 1, x, y, x² and xy; NaN where x does not vary."""
    number, cause, effect, squared, product = sums.tolist()
    determinant = number * squared - cause * cause
    return np.array(
        [(effect * squared - cause * product) / determinant if determinant > 0.0 else math.nan]
    )


def offset_findings(motion: Motion) -> list[Finding]:
    """A note of an offset of ay beyond a level mounting, a warning of one of ay or ax beyond any
    road.

    Parameters
    ----------
    motion : Motion
        Channels whose signs and units are right.

    Returns
    -------
    list of Finding
        At most one of each. Neither can be told from an inclined sensor or road, nor that of ay,
        at about one speed, from an offset of the yaw rate; the message states the causes.
    """
    findings = []
    offset = lateral_offset(motion)
    if offset is not None and abs(offset.value) >= max(MIN_NOTED_OFFSET, offset.half_width):
        level: Level = "warning" if abs(offset.value) > MAX_NOTED_OFFSET else "note"
        turning = -offset.value / max(float(np.mean(np.abs(motion.vx[motion.moving]))), 0.1)
        is_small = abs(turning) < MAX_GYRO_OFFSET
        gyro = f", or a yaw_rate offset of {turning:.3f} rad/s" if is_small else ""
        sliding = f" + d({motion.velocity})/dt" if motion.velocity else ""
        text = _described(offset, f"{motion.speed}·yaw_rate{sliding}", gyro)
        findings.append(Finding(level, "offset", "ay", text))
    offset = longitudinal_offset(motion)
    if offset is not None and abs(offset.value) - offset.half_width > MAX_NOTED_OFFSET:
        text = _described(offset, f"d({motion.speed})/dt")
        findings.append(Finding("warning", "offset", "ax", text))
    return findings


def _described(offset: Measured, expected: str, another_cause: str = "") -> str:
    """Text of an offset, of what it is left over, and of its possible causes."""
    text = (
        f"constant offset of {offset.value:.2f} m/s² (95 %: {offset.low:.2f} to {offset.high:.2f}) "
        f"relative to {expected}"
    )
    if abs(offset.value) > MAX_INCLINED_OFFSET:
        return f"{text}: too large for an inclined sensor; check the column, its unit and its axis"
    degrees = np.degrees(np.arcsin(abs(offset.value) / GRAVITY))
    return (
        f"{text}: a sensor or road inclined by {degrees:.1f} deg{another_cause}; "
        "the transform offset_correction removes it"
    )
