"""Numbers and tables as C source, beside those of `vehest.export.rendering`: limits may be infinite, and some tables hold no numbers."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from vehest.export.rendering import Precision, literal

LARGEST_FLOAT = float(np.finfo(np.float32).max)
LEAST_FLOAT = float(np.finfo(np.float32).tiny)
LINE = 110  # characters of a table's line


def limit(value: float, precision: Precision) -> str:
    """A literal of a number that may be infinite; what a float cannot hold becomes infinite or 0."""
    value = float(value)
    if precision == "float":
        value = math.copysign(math.inf, value) if abs(value) > LARGEST_FLOAT else 0.0 if abs(value) < LEAST_FLOAT else value
    if math.isinf(value):
        return "VEHEST_INFINITY" if value > 0 else "-VEHEST_INFINITY"
    return literal(value, precision)


def braced(values: Any, write: Callable[[Any], str]) -> str:
    """An array of any depth as the initialiser of a table, in lines that can be read."""
    array = np.asarray(values)
    if array.ndim == 0:
        return write(array.item())
    if array.ndim == 1:
        return _wrapped([write(value) for value in array.tolist()])
    rows = ",\n".join(braced(row, write) for row in array)
    return "{\n" + "\n".join(f"    {line}" for line in rows.split("\n")) + "\n}"


def _wrapped(words: list[str]) -> str:
    """Words in braces, on one line if they fit on it."""
    if sum(len(word) + 2 for word in words) <= LINE:
        return "{ " + ", ".join(words) + " }"
    lines, line = [], ""
    for word in words:
        if line and len(line) + len(word) + 2 > LINE:
            lines.append(line.rstrip())
            line = ""
        line += f"{word}, "
    lines.append(line.rstrip().rstrip(","))
    return "{\n" + "\n".join(f"    {line}" for line in lines) + "\n}"


def whole(values: Any) -> str:
    """The initialiser of a table of whole numbers."""
    return braced(np.asarray(values, np.int64), str)


def truths(values: Any) -> str:
    """The initialiser of a table of ``bool``."""
    return braced(np.asarray(values, bool), lambda value: "true" if value else "false")
