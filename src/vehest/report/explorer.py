"""All signals of a test set as data for the page: traces to zoom, the course, and errors over the rows that pass a filter.

Values are kept in 16 bits over their range, as differences between neighbours, compressed: an hour at 20 Hz of eight estimates with their
bands and ten channels takes some 4 MB of the page. The page unpacks them by itself; sideslip is computed there as everywhere,
atan2(v, u) with the measured u.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vehest.constants import FloatArray
from vehest.data.runs import true_runs
from vehest.report.style import Line, on_dark

LEVELS = 65_534
GAP = 65_535  # code of a value that is not there


@dataclass(frozen=True, eq=False)
class Signal:
    """A channel that was measured."""

    label: str  # for people
    unit: str  # that it is drawn in
    values: FloatArray  # shape (K,); NaN where there is none
    drawn: bool = True  # whether it is drawn at first


@dataclass(frozen=True, eq=False)
class Candidate:
    """An estimator in the traces."""

    label: str  # its title
    line: Line
    vy: FloatArray  # estimated lateral velocity [m/s], shape (K,)
    band_vy: FloatArray | None = None  # half width of its calibrated 90 % band of v [m/s], (K,), where it has one
    band_sideslip: FloatArray | None = None  # the same of β [deg]
    health: FloatArray | None = None  # 0 valid, 1 degraded, 2 invalid, (K,), where it is known


@dataclass(frozen=True, eq=False)
class Explorer:
    """Everything over one uniform time axis; NaN breaks all lines between two ranges."""

    start: float  # first time [s]
    step: float  # between two samples [s]
    time_label: str  # label of the time axis
    zoom: tuple[float, float]  # a range that deserves a button [s]
    vx: FloatArray  # measured forward velocity [m/s], shape (K,)
    vy: FloatArray  # reference lateral velocity [m/s], (K,)
    ay: FloatArray | None  # measured lateral acceleration [m/s²], (K,); None where there is none
    inputs: Sequence[Signal]  # further channels as measured
    candidates: Sequence[Candidate]  # in the order of the table
    course: tuple[FloatArray, FloatArray] | None = None  # x and y of the car [m], (K,) each, where they are known
    course_note: str = ""  # how they are known

    def to_json(self) -> str:
        """What the page reads; nothing in it can end a script element."""
        columns: dict[str, FloatArray | None] = {"vx": self.vx, "vy": self.vy, "ay": self.ay}
        columns |= {f"input{i}": signal.values for i, signal in enumerate(self.inputs)}
        for i, own in enumerate(self.candidates):
            columns |= {f"vy{i}": own.vy, f"bandv{i}": own.band_vy, f"bandb{i}": own.band_sideslip, f"health{i}": own.health}
        if self.course is not None:
            columns |= dict(zip(("x", "y"), self.course, strict=True))
        described, data = packed({name: values for name, values in columns.items() if values is not None})
        content = {
            "start": self.start,
            "step": self.step,
            "length": len(self.vx),
            "timeLabel": self.time_label,
            "zoom": list(self.zoom),
            "inputs": [{"label": signal.label, "unit": signal.unit, "drawn": signal.drawn} for signal in self.inputs],
            "candidates": [
                {"label": own.label, "colour": own.line.colour, "dark": on_dark(own.line.colour), "dash": own.line.dash}
                for own in self.candidates
            ],
            "courseNote": self.course_note,
            "columns": described,
            "data": data,
        }
        return json.dumps(content, ensure_ascii=False, allow_nan=False).replace("<", "\\u003c")


def packed(columns: dict[str, FloatArray]) -> tuple[dict[str, list[float]], str]:
    """Columns in 16 bits.

    Returns:
        Name -> lowest value and the step between two codes, in the order of the data; and the data, base64 of zlib: of each column the low
        bytes, then the high bytes, of differences between neighbouring codes.
    """
    described, parts = {}, []
    for name, values in columns.items():
        known = np.isfinite(values)
        low, high = (float(values[known].min()), float(values[known].max())) if known.any() else (0.0, 0.0)
        scale = (high - low) / LEVELS or 1.0
        codes = np.full(len(values), GAP, np.uint16)
        codes[known] = np.round((values[known] - low) / scale).astype(np.uint16)
        differences = np.diff(codes, prepend=np.uint16(0))  # modulo 2¹⁶
        parts += [(differences & 0xFF).astype(np.uint8), (differences >> 8).astype(np.uint8)]
        described[name] = [low, scale]
    return described, base64.b64encode(zlib.compress(b"".join(part.tobytes() for part in parts), 9)).decode()


def reckoned_course(vx: FloatArray, vy: FloatArray, yaw_rate: FloatArray, step: float) -> tuple[FloatArray, FloatArray]:
    """Where the car went, x and y (K,) [m], by integrating velocities from the origin, heading along x; after NaN it starts anew.

    ``vx`` and ``vy`` [m/s] and ``yaw_rate`` [rad/s] are (K,); ``step`` [s] lies between two samples.
    """
    x, y = np.full(len(vx), np.nan), np.full(len(vx), np.nan)
    known = np.isfinite(vx) & np.isfinite(vy) & np.isfinite(yaw_rate)
    for first, end in true_runs(known).tolist():
        own = slice(first, end)
        heading = _integral(yaw_rate[own], step)
        x[own] = _integral(vx[own] * np.cos(heading) - vy[own] * np.sin(heading), step)
        y[own] = _integral(vx[own] * np.sin(heading) + vy[own] * np.cos(heading), step)
    return x, y


def _integral(values: FloatArray, step: float) -> FloatArray:
    steps = 0.5 * step * (values[1:] + values[:-1])
    whole: FloatArray = np.concatenate([[0.0], np.cumsum(steps)])
    return whole
