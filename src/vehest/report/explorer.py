"""All signals of a test set as data for the page: traces to zoom, the course, and errors over the
rows that pass a filter.

Values are kept in 16 bits over their range, as differences between neighbours, compressed: an hour
at 20 Hz of eight estimates with their bands and ten channels takes some 4 MB of the page. The page
unpacks them by itself; sideslip is computed there as everywhere, atan2(v, u) with the measured u.
It is drawn where it is scored and the car moves forward.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from vehest.constants import FloatArray
from vehest.data.channels import CHANNELS
from vehest.data.runs import true_runs

N_STEPS = 65_534  # steps of a column's range, and code of its highest value; 16 bits but for GAP
GAP = 65_535  # code of a missing value


def explorer_json(content: Mapping[str, Any], columns: Mapping[str, FloatArray | None]) -> str:
    """JSON of all signals of a test set for the page, which cannot end a script element.

    Parameters
    ----------
    content : mapping
        How columns are called and drawn, plain finite values.
    columns : mapping
        Name -> (K,), or None where it is not there: ``vx``, reference ``vy`` [m/s], ``ay`` [m/s²],
        ``input0``… as measured; ``scored``: 1 where sideslip is scored, else 0; of each candidate
        ``vy0`` [m/s], half widths of its 90 % bands ``bandv0`` [m/s] and ``bandb0`` [deg],
        ``health0``; course ``x``, ``y`` [m]. NaN breaks all lines between two ranges.
    """
    described, data = packed(
        {name: values for name, values in columns.items() if values is not None}
    )
    payload = {**content, "columns": described, "data": data}
    return json.dumps(payload, ensure_ascii=False, allow_nan=False).replace("<", "\\u003c")


def packed(columns: dict[str, FloatArray]) -> tuple[dict[str, list[float]], str]:
    """Columns in 16 bits.

    Parameters
    ----------
    columns : dict
        Name -> (K,); the error of a value is at most half a step, a 65,534th of the column's range.

    Returns
    -------
    tuple[dict[str, list[float]], str]
        Name -> lowest value and the step between two codes, in the order of the data; and the data,
        base64 of zlib: of each column the low bytes, then the high bytes, of differences between
        neighbouring codes.
    """
    described = {}
    parts = []
    for name, values in columns.items():
        finite = np.isfinite(values)
        low, high = (
            (float(values[finite].min()), float(values[finite].max()))
            if finite.any()
            else (0.0, 0.0)
        )
        scale = (high - low) / N_STEPS or 1.0
        codes = np.full(len(values), GAP, np.uint16)
        codes[finite] = np.round((values[finite] - low) / scale).astype(np.uint16)
        differences = np.diff(codes, prepend=np.uint16(0))  # modulo 2¹⁶
        parts += [(differences & 0xFF).astype(np.uint8), (differences >> 8).astype(np.uint8)]
        described[name] = [low, scale]
    return described, base64.b64encode(
        zlib.compress(b"".join(part.tobytes() for part in parts), 9)
    ).decode()


def in_display_unit(name: str, values: FloatArray) -> tuple[FloatArray, str]:
    """Values of a channel and their unit for display: angles in degrees."""
    channel = CHANNELS[name]
    if channel.is_angular:
        return np.degrees(values), {"rad": "deg", "rad/s": "deg/s"}[channel.unit]
    return values, channel.unit


def reckoned_course(
    vx: FloatArray, vy: FloatArray, yaw_rate: FloatArray, step: float
) -> tuple[FloatArray, FloatArray]:
    """Course of the car, x and y (K,) [m], by integrating velocities from the origin, heading along
    x; after NaN it starts anew.

    ``vx`` and ``vy`` [m/s] and ``yaw_rate`` [rad/s] are (K,); ``step`` [s] lies between two
    samples.
    """
    x = np.full(len(vx), np.nan)
    y = np.full(len(vx), np.nan)
    finite = np.isfinite(vx) & np.isfinite(vy) & np.isfinite(yaw_rate)
    for first, end in true_runs(finite).tolist():
        run = slice(first, end)
        heading = _integral(yaw_rate[run], step)
        x[run] = _integral(vx[run] * np.cos(heading) - vy[run] * np.sin(heading), step)
        y[run] = _integral(vx[run] * np.sin(heading) + vy[run] * np.cos(heading), step)
    return x, y


def _integral(values: FloatArray, step: float) -> FloatArray:
    """Integral by the trapezoidal rule from zero, (K,)."""
    steps = 0.5 * step * (values[1:] + values[:-1])
    integral: FloatArray = np.concatenate([[0.0], np.cumsum(steps)])
    return integral
