"""How a recording is driven, which error a static map has on it, its floors, and whether it can
rank estimators.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vehest.constants import FloatArray
from vehest.data.recording import Recording
from vehest.data.runs import true_runs
from vehest.data.splits import Span
from vehest.data.transforms import Resample
from vehest.evaluation.floors import INPUTS, Drive, cramer_rao_floor, drive_of, reference_floor
from vehest.evaluation.metrics import Protocol
from vehest.sources.base import origin_in_words

RATE_HZ = 20.0
"""Rate at which recordings are read."""
DRIVEN_SHARE_OF_SPEED = 0.2
"""Share of its 99th percentile above which the speed counts as driving: the sideslip of a standing
car is noise."""
QUANTILES = (0.5, 0.9, 0.99)
NO_QUANTILES = (math.nan,) * len(QUANTILES)
MIN_SEGMENT_SECONDS = 3.0

# Rules by which a recording can rank estimators, fixed before the table was first computed.
MIN_DRIVEN_SECONDS = 60.0
MIN_RMS_SIDESLIP = 0.5
"""Root mean square of the sideslip angle [deg], as in the warning of a comparison."""
MIN_ERROR_OVER_NOISE = 2.0
"""Error of a static map over the noise of the reference."""


@dataclass(frozen=True)
class Statistics:
    """One recording, or several together, while driving, at `RATE_HZ`.

    NaN where there is no reference, or no such channel.
    """

    seconds: float  # in all [s]
    driven: float  # of it driven [s]
    native_rate: float  # [Hz]
    speed: tuple[float, float]  # quantiles of vx at 1 and 99 % [m/s]
    ay: tuple[float, ...]  # `QUANTILES` of |ay| [m/s²]
    point: str  # where the reference was measured, as text
    missing: str  # the channel that is missing; empty where all are there
    sideslip: tuple[float, ...] = NO_QUANTILES  # `QUANTILES` of the reference's |β| [deg]
    rms: float = math.nan  # root mean square of the reference's β, the error of v = 0 [deg]
    # RMSE(β) of v = r (b - k u²), both numbers fitted on the recording itself [deg]
    static_map: float = math.nan
    correlation: float = math.nan  # of v with the yaw rate
    noise: float = math.nan  # white noise of the reference [deg]
    bound: float = (
        math.nan
    )  # posterior Cramér-Rao bound with every measured input, axles known [deg]
    # the same by kinematics alone, from u, ω, a_y and a_x where they are measured [deg]
    kinematic_bound: float = math.nan

    @property
    def reasons(self) -> list[str]:
        """Why it cannot rank estimators; empty where it can."""
        if self.missing:
            return [f"no {self.missing}"]
        if not self.driven > 0.0:
            return ["the car stands, or drives for moments only"]
        reasons = []
        if self.driven < MIN_DRIVEN_SECONDS:
            reasons.append(f"{self.driven:.0f} s of driving")
        if self.rms < MIN_RMS_SIDESLIP:
            reasons.append(f"sideslip of {self.rms:.2g}° (rms)")
        if not self.static_map > MIN_ERROR_OVER_NOISE * self.noise:
            reasons.append(
                f"error of a static map {self.static_map:.2g}°, noise of the reference "
                f"{self.noise:.2g}°"
            )
        return reasons


def statistics_of(recordings: Sequence[Recording]) -> Statistics:
    """Statistics of recordings as ingested, taken together.

    Where a recording has a reference, those without are left out.
    """
    labelled = [recording for recording in recordings if "vy_ref" in recording]
    recordings = labelled or recordings
    names = {"vx": "speed", "yaw_rate": "yaw rate", "vy_ref": "reference of v"}
    absent = [
        word
        for name, word in names.items()
        if not all(name in recording for recording in recordings)
    ]
    segments = [segment for recording in recordings for segment in _driven(recording)]
    vx = _joined(segments, "vx")
    ay = _joined(segments, "ay")
    without_reference = Statistics(
        seconds=sum(recording.duration for recording in recordings),
        driven=sum(segment.duration for segment in segments),
        native_rate=recordings[0].rate_hz,
        speed=tuple(np.quantile(vx, (0.01, 0.99)).tolist()) if len(vx) else (math.nan, math.nan),
        ay=tuple(np.quantile(np.abs(ay), QUANTILES).tolist()) if len(ay) else NO_QUANTILES,
        point=_point(recordings[0]),
        missing=absent[0] if absent else "",
    )
    vy = _joined(segments, "vy_ref")
    if absent or not len(vy):
        return without_reference
    yaw_rate = _joined(segments, "yaw_rate")
    beta = np.degrees(np.arctan2(vy, vx))
    drives = [_drive(segment) for segment in segments]
    noise = reference_floor(drives)
    inputs = {name for name in INPUTS if all(name in drive.inputs for drive in drives)}
    bound = cramer_rao_floor(drives, inputs)
    kinematic = cramer_rao_floor(drives, inputs - {"steer"}, car=False) if "ay" in inputs else None
    return replace(
        without_reference,
        sideslip=tuple(np.quantile(np.abs(beta), QUANTILES).tolist()),
        rms=_rms(beta),
        static_map=_static_map_error(vx, vy, yaw_rate),
        correlation=float(np.corrcoef(vy, yaw_rate)[0, 1])
        if vy.std() > 0 and yaw_rate.std() > 0
        else math.nan,
        noise=math.nan if noise is None else noise.sideslip,
        bound=math.nan if bound is None else bound.sideslip,
        kinematic_bound=math.nan if kinematic is None else kinematic.sideslip,
    )


def _static_map_error(vx: FloatArray, vy: FloatArray, yaw_rate: FloatArray) -> float:
    """RMSE(β) of v = r (b - k u²), b and k by least squares on the same samples [deg]."""
    columns = np.stack([yaw_rate, -yaw_rate * np.square(vx)], axis=1)
    fitted = columns @ np.linalg.lstsq(columns, vy, rcond=None)[0]
    return _rms(np.degrees(np.arctan2(fitted, vx) - np.arctan2(vy, vx)))


def _driven(recording: Recording) -> list[Recording]:
    """Segments of at least `MIN_SEGMENT_SECONDS` in which the car drives, at `RATE_HZ`.

    Samples without reference end a segment.
    """
    if "vx" not in recording:
        return []
    slow = recording if recording.rate_hz <= RATE_HZ * (1 + 1e-9) else _at_rate(recording)
    speed = slow["vx"]
    moving = (
        speed > DRIVEN_SHARE_OF_SPEED * float(np.nanquantile(speed, 0.99))
        if np.isfinite(speed).any()
        else np.zeros(len(slow), dtype=bool)
    )
    for name in ("vx", "ay", "yaw_rate", "vy_ref"):
        moving &= np.isfinite(slow[name]) if name in slow else True
    return [
        slow.cut(
            slow.start_time + (first - 0.5) / slow.rate_hz,
            slow.start_time + (end - 0.5) / slow.rate_hz,
        )
        for first, end in true_runs(moving).tolist()
        if end - first >= MIN_SEGMENT_SECONDS * slow.rate_hz
    ]


def _at_rate(recording: Recording) -> Recording:
    """At `RATE_HZ` without aliasing; channels with gaps, which no filter passes, interpolated."""
    gappy = [name for name in recording.channels if np.isnan(recording[name]).any()]
    complete = [name for name in recording.channels if name not in gappy]
    slow = Resample(RATE_HZ)(recording.select(complete))
    if not gappy:
        return slow
    interpolated = {
        name: np.interp(slow.time, recording.time, recording[name], left=math.nan, right=math.nan)
        for name in gappy
    }
    return replace(slow, channels={**slow.channels, **interpolated}, gappy=frozenset(gappy))


def _drive(segment: Recording) -> Drive:
    protocol = Protocol(
        rate_hz=segment.rate_hz,
        warm_up_seconds=0.0,
        skip_seconds=0.0,
        min_sideslip_speed=0.0,  # the car drives in all segments (`_driven`)
    )
    return drive_of(segment, Span("", segment.id), protocol)


def _point(recording: Recording) -> str:
    origin = next(
        (line for line in origin_in_words(recording) if line.startswith("reference measured ")), ""
    )
    return origin.removeprefix("reference measured ") or "not said"


def _joined(segments: Sequence[Recording], name: str) -> FloatArray:
    if not segments or not all(name in segment for segment in segments):
        return np.zeros(0)
    return np.concatenate([segment[name] for segment in segments])


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
