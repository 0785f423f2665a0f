"""Converts the units that files use to the SI units of the channel table."""

from __future__ import annotations

import math
import re
from functools import cache

from vehest.data.errors import DataError

# matches the step of a raw count before a unit, such as ``0.005`` in ``0.005*deg/s``
STEP = re.compile(r"((?=.*[1-9])\d*\.?\d+(e[-+]?\d)?)?", re.IGNORECASE)
_FACTORS = {  # SI unit -> unit -> factor that makes it SI
    "m/s": {
        "m/s": 1.0,
        "km/h": 1.0 / 3.6,
        "mph": 0.44704,
        "knots": 1852.0 / 3600.0,
        "ft/s": 0.3048,
        "cm/s": 0.01,
        "mm/s": 0.001,
    },
    "m/s²": {
        "m/s²": 1.0,
        "m/s^2": 1.0,
        "m/s2": 1.0,
        "g": 9.80665,
        "mg": 9.80665e-3,
        "ft/s²": 0.3048,
        "cm/s²": 0.01,
        "mm/s²": 0.001,
    },
    "rad": {
        "rad": 1.0,
        "deg": math.pi / 180.0,
        "rev": 2.0 * math.pi,
        "mrad": 0.001,
        "mdeg": math.pi / 180e3,
    },
    "rad/s": {
        "rad/s": 1.0,
        "deg/s": math.pi / 180.0,
        "rpm": math.pi / 30.0,
        "rev/s": 2.0 * math.pi,
        "mrad/s": 0.001,
        "mdeg/s": math.pi / 180e3,
        "deg/min": math.pi / 10_800.0,
    },
    "N": {"N": 1.0, "kN": 1e3},
    "N·m": {"N·m": 1.0, "Nm": 1.0},
    "Pa": {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "bar": 1e5, "psi": 6894.757293168361},
    "A": {"A": 1.0},
    "m": {"m": 1.0, "mm": 1e-3},
    "s": {
        "s": 1.0,
        "ms": 1e-3,
        "us": 1e-6,
        "ns": 1e-9,
        "cs": 0.01,
        "min": 60.0,
        "h": 3600.0,
        "d": 86_400.0,
    },
    "1": {"1": 1.0},
}
# unit -> its SI unit, and the factor that converts to it
_UNITS = {
    unit: (si_unit, factor) for si_unit, units in _FACTORS.items() for unit, factor in units.items()
}


@cache  # thousands of combinations of columns ask for the same few
def factor_to_si(unit: str, si_unit: str) -> float:
    """Factor that brings a value in ``unit``, such as ``deg/s`` or ``0.005*deg/s``, to ``si_unit``.

    Raises
    ------
    DataError
        The unit is not known, or measures something else.
    """
    step, _, plain = unit.rpartition("*")
    if plain not in _UNITS or not STEP.fullmatch(step):
        raise DataError(f"unit '{unit}' is not known; known units: {', '.join(sorted(_UNITS))}")
    target, factor = _UNITS[plain]
    if target != si_unit:
        raise DataError(f"unit '{unit}' cannot be converted to '{si_unit}'")
    return factor * float(step) if step else factor
