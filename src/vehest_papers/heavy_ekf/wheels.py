"""Equations 61 to 64 on the real wheel speeds of the AV-21."""

from __future__ import annotations

import numpy as np

from vehest.constants import FloatArray
from vehest.data.derived import SpeedFromWheels
from vehest.data.recording import Recording
from vehest.studies.artefacts import PartArtefacts
from vehest_papers.kit.reading import recordings_of

WHEELS = ("fl", "fr", "rl", "rr")
RADIUS = 0.2972  # m, of the AV-21, as in conf/dataset/av21.yaml
BLOCK_SECONDS = 10.0
MIN_SPEED = 5.0  # m/s
LOCKED = 0.5  # m of track by the wheels' difference, below which an axle turns as one


def tracks_of(drive: Recording) -> tuple[float, float]:
    """Front and rear track by least squares of the wheels' difference on the yaw rate [m]."""
    moving = drive["vx_ref"] > MIN_SPEED
    turn = drive["yaw_rate"][moving]
    tracks = []
    for left, right in (("fl", "fr"), ("rl", "rr")):
        scale = np.cos(drive["steer"][moving]) if left == "fl" else 1.0
        difference = (
            RADIUS * scale * (drive[f"wheel_speed_{right}"] - drive[f"wheel_speed_{left}"])[moving]
        )
        tracks.append(float(difference @ turn / (turn @ turn)))
    return tracks[0], tracks[1]


def trained_tracks(part: PartArtefacts) -> FloatArray:
    """Front and rear track by least squares on the training range, (2,) [m]."""
    drives = recordings_of(part, part.split.train)
    return np.asarray(np.mean([tracks_of(drive) for drive in drives], axis=0), dtype=np.float64)


def wheel_sums(part: PartArtefacts) -> dict[str, dict[str, tuple[FloatArray, ...]]]:
    """Test set -> name of a drive -> its `block_sums`, without axles whose wheels turn as one."""
    tracks = trained_tracks(part)
    turning = np.where(tracks > LOCKED, tracks, 0.0)
    wheels = SpeedFromWheels(
        wheel_radius=RADIUS, track_front=float(turning[0]), track_rear=float(turning[1])
    )
    return {
        test: {
            f"{drive.id} {drive.start_time:.2f} s": block_sums(drive, wheels)
            for drive in recordings_of(part, spans)
            if (drive["vx_ref"] > MIN_SPEED).any()
        }
        for test, spans in part.split.tests.items()
    }


def block_sums(
    drive: Recording, wheels: SpeedFromWheels
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sums over blocks of 10 s of one drive; samples of a slow car do not count.

    Parameters
    ----------
    drive
        With the four wheel speeds [rad/s], and what their correction needs.
    wheels
        Correction of the wheel speeds (Eqs. 61 to 64), with its tracks.

    Returns
    -------
    tuple of array
        Variance over the four wheels of the measured and of the corrected speeds, summed over the
        samples of each block [m²/s²], and the number of its samples; blocks without samples are
        left out.
    """
    is_moving = (drive["vx_ref"] > MIN_SPEED).astype(np.float64)
    measured = wheels.wheel_radius * drive.stack([f"wheel_speed_{wheel}" for wheel in WHEELS]).T
    starts = np.arange(0, len(drive), round(BLOCK_SECONDS * drive.rate_hz))
    variances = [
        np.add.reduceat(speeds.var(0) * is_moving, starts)
        for speeds in (measured, wheels.corrected(drive))
    ]
    sizes = np.add.reduceat(is_moving, starts)
    has_samples = sizes > 0
    return variances[0][has_samples], variances[1][has_samples], sizes[has_samples]
