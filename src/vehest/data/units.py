"""Converts the units that files use to the SI units of the channel table."""

from __future__ import annotations

import math

from vehest.data.errors import DataError

# unit -> (SI unit, factor); value_si = value * factor
_UNITS: dict[str, tuple[str, float]] = {
    "m/s": ("m/s", 1.0),
    "km/h": ("m/s", 1.0 / 3.6),
    "mph": ("m/s", 0.44704),
    "knots": ("m/s", 1852.0 / 3600.0),
    "m/s²": ("m/s²", 1.0),
    "m/s^2": ("m/s²", 1.0),
    "m/s2": ("m/s²", 1.0),
    "g": ("m/s²", 9.80665),
    "rad": ("rad", 1.0),
    "deg": ("rad", math.pi / 180.0),
    "rad/s": ("rad/s", 1.0),
    "deg/s": ("rad/s", math.pi / 180.0),
    "rpm": ("rad/s", math.pi / 30.0),
    "N": ("N", 1.0),
    "kN": ("N", 1e3),
    "N·m": ("N·m", 1.0),
    "Nm": ("N·m", 1.0),
    "Pa": ("Pa", 1.0),
    "kPa": ("Pa", 1e3),
    "MPa": ("Pa", 1e6),
    "bar": ("Pa", 1e5),
    "psi": ("Pa", 6894.757293168361),
    "A": ("A", 1.0),
    "m": ("m", 1.0),
    "mm": ("m", 1e-3),
    "s": ("s", 1.0),
    "ms": ("s", 1e-3),
    "us": ("s", 1e-6),
    "ns": ("s", 1e-9),
    "1": ("1", 1.0),
}


def factor_to_si(unit: str, si_unit: str) -> float:
    """Factor that brings a value in ``unit`` to ``si_unit``. Raises `DataError`: the unit is not known, or measures something else."""
    if unit not in _UNITS:
        raise DataError(f"unit '{unit}' is not known; known units: {', '.join(sorted(_UNITS))}")
    target, factor = _UNITS[unit]
    if target != si_unit:
        raise DataError(f"unit '{unit}' cannot be converted to '{si_unit}'")
    return factor
