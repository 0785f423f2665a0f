"""What a recording holds: how it is driven, what a static map leaves of its sideslip, its floors, and whether it can rank estimators."""

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

RATE = 20.0  # Hz, at which everything here is read
DRIVEN = 0.2  # share of its 99th percentile that a recording's speed has to reach to count as driving; sideslip of a standing car is noise
QUANTILES = (0.5, 0.9, 0.99)

# Rules by which a recording can rank estimators, set before the table was first drawn.
LEAST_SECONDS = 60.0
LEAST_SIDESLIP = 0.5  # deg, root mean square, as the warning of a comparison has it
LEAST_OVER_NOISE = 2.0  # what a static map leaves over the noise of the reference
SHORTEST_PIECE = 3.0  # s


@dataclass(frozen=True)
class Statistics:
    """Of one recording, or of several together; while it drives, at `RATE`. NaN where it has no reference, or not the channel."""

    seconds: float  # in all [s]
    driven: float  # of it driven [s]
    native_rate: float  # [Hz]
    speed: tuple[float, float]  # quantiles of vx at 1 and 99 % [m/s]
    ay: tuple[float, ...]  # quantiles of |ay| [m/s²]
    sideslip: tuple[float, ...]  # quantiles of the reference's |β| [deg]
    rms: float  # root mean square of the reference's β, the error of v = 0 [deg]
    static_map: float  # what v = r (b - k u²) leaves where both numbers are fitted on the recording itself, RMSE(β) [deg]
    correlation: float  # of v with the yaw rate
    noise: float  # white noise of the reference [deg]
    bound: float  # posterior Cramér-Rao bound with every input that was measured, axles known [deg]
    kinematic_bound: (
        float  # the same by kinematics alone, from u, ω, a_y and a_x where they are there [deg]
    )
    point: str  # where the reference was measured, in words
    missing: str = ""  # the channel that is missing; empty where all are there

    @property
    def reasons(self) -> list[str]:
        """Why it cannot rank estimators; empty where it can."""
        if self.missing:
            return [f"no {self.missing}"]
        if not self.driven > 0.0:
            return ["the car stands, or drives for moments only"]
        found = []
        if self.driven < LEAST_SECONDS:
            found.append(f"{self.driven:.0f} s of driving")
        if self.rms < LEAST_SIDESLIP:
            found.append(f"β of {self.rms:.2g}° (rms) only")
        if not self.static_map > LEAST_OVER_NOISE * self.noise:
            found.append(
                f"a static map leaves {self.static_map:.2g}°, the reference's noise is {self.noise:.2g}°"
            )
        return found


def statistics_of(recordings: Sequence[Recording]) -> Statistics:
    """Statistics of recordings as ingested, taken together; of several, those with a reference where any has one."""
    labelled = [recording for recording in recordings if "vy_ref" in recording]
    recordings = labelled or recordings
    names = {"vx": "speed", "yaw_rate": "yaw rate", "vy_ref": "reference of v"}
    missing = next(
        (
            word
            for name, word in names.items()
            if any(name not in recording for recording in recordings)
        ),
        "",
    )
    pieces = [piece for recording in recordings for piece in _driven(recording)]
    native = recordings[0].rate_hz
    seconds = sum(recording.duration for recording in recordings)
    driven = sum(piece.duration for piece in pieces)
    nothing = (math.nan,) * len(QUANTILES)
    point = _point(recordings[0])
    vx = _joined(pieces, "vx")
    speed = tuple(np.quantile(vx, (0.01, 0.99)).tolist()) if len(vx) else (math.nan, math.nan)
    ay = _joined(pieces, "ay")
    bands = tuple(np.quantile(np.abs(ay), QUANTILES).tolist()) if len(ay) else nothing
    plain = Statistics(
        seconds,
        driven,
        native,
        speed,
        bands,
        nothing,
        *(math.nan,) * 6,
        point=point,
        missing=missing,
    )
    vy = _joined(pieces, "vy_ref")
    if missing or not len(vy):
        return plain
    yaw_rate = _joined(pieces, "yaw_rate")
    beta = np.degrees(np.arctan2(vy, vx))
    drives = [_drive(piece) for piece in pieces]
    noise = reference_floor(drives)
    inputs = {name for name in INPUTS if all(name in drive.inputs for drive in drives)}
    bound = cramer_rao_floor(drives, inputs)
    kinematic = cramer_rao_floor(drives, inputs - {"steer"}, car=False) if "ay" in inputs else None
    return replace(
        plain,
        sideslip=tuple(np.quantile(np.abs(beta), QUANTILES).tolist()),
        rms=_rms(beta),
        static_map=_left_by_static_map(vx, vy, yaw_rate),
        correlation=float(np.corrcoef(vy, yaw_rate)[0, 1])
        if vy.std() > 0 and yaw_rate.std() > 0
        else math.nan,
        noise=math.nan if noise is None else noise.sideslip,
        bound=math.nan if bound is None else bound.sideslip,
        kinematic_bound=math.nan if kinematic is None else kinematic.sideslip,
    )


def _left_by_static_map(vx: FloatArray, vy: FloatArray, yaw_rate: FloatArray) -> float:
    """RMSE(β) of v = r (b - k u²), b and k by least squares on the same samples [deg]."""
    columns = np.stack([yaw_rate, -yaw_rate * np.square(vx)], axis=1)
    fitted = columns @ np.linalg.lstsq(columns, vy, rcond=None)[0]
    return _rms(np.degrees(np.arctan2(fitted, vx) - np.arctan2(vy, vx)))


def _driven(recording: Recording) -> list[Recording]:
    """Stretches of at least `SHORTEST_PIECE` in which the car drives, brought to `RATE`; samples without reference end one."""
    if "vx" not in recording:
        return []
    slow = recording if recording.rate_hz <= RATE * (1 + 1e-9) else _at_rate(recording)
    speed = slow["vx"]
    moving = (
        speed > DRIVEN * float(np.nanquantile(speed, 0.99))
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
        if end - first >= SHORTEST_PIECE * slow.rate_hz
    ]


def _at_rate(recording: Recording) -> Recording:
    """At `RATE` without aliasing; channels with gaps, which no filter passes, as they are at these times."""
    gappy = [name for name in recording.channels if np.isnan(recording[name]).any()]
    sound = [name for name in recording.channels if name not in gappy]
    slow = Resample(RATE)(recording.select(sound))
    if not gappy:
        return slow
    plain = {
        name: np.interp(slow.time, recording.time, recording[name], left=math.nan, right=math.nan)
        for name in gappy
    }
    return replace(slow, channels={**slow.channels, **plain}, gappy=frozenset(gappy))


def _drive(piece: Recording) -> Drive:
    whole = Protocol(
        rate_hz=piece.rate_hz,
        warm_up_seconds=0.0,
        skip_seconds=0.0,
        min_sideslip_speed=0.0,  # pieces are those in which the car drives (`_driven`)
    )
    return drive_of(piece, Span("", piece.id), whole)


def _point(recording: Recording) -> str:
    origin = next(
        (line for line in origin_in_words(recording) if line.startswith("reference measured ")), ""
    )
    return origin.removeprefix("reference measured ") or "not said"


def _joined(pieces: Sequence[Recording], name: str) -> FloatArray:
    if not pieces or not all(name in piece for piece in pieces):
        return np.zeros(0)
    return np.concatenate([piece[name] for piece in pieces])


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
