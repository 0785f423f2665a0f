"""Spellings of units in files, compared with the units that conf/dataset declares."""

from __future__ import annotations

import re

from vehest.data.errors import DataError
from vehest.data.units import factor_to_si
from vehest.sources.columns import Column

# without blanks, dots, stars, brackets and case, sec as s -> the spelling of vehest, or a unit of
# no channel; ambiguous ones are left out
_SPELLINGS = {
    **dict.fromkeys(("m/s", "mps", "meter/s", "meters/s", "ms-1", "ms^-1"), "m/s"),
    **dict.fromkeys(("km/h", "kmh", "kph", "km/hr", "kmph", "kmh-1", "kmh^-1"), "km/h"),
    **dict.fromkeys(("mph", "mi/h", "mile/h", "miles/h"), "mph"),
    **dict.fromkeys(("kt", "kts", "knot", "knots", "knoten", "noeuds", "nœuds"), "knots"),
    **dict.fromkeys(("ft/s", "fps"), "ft/s"),
    **dict.fromkeys(
        (
            "m/s²",
            "m/s^2",
            "m/s2",
            "m/s/s",
            "mps2",
            "mps^2",
            "meter/s^2",
            "meters/s^2",
            "ms-2",
            "ms^-2",
        ),
        "m/s²",
    ),
    **dict.fromkeys(("ft/s²", "ft/s^2", "ft/s2"), "ft/s²"),
    **dict.fromkeys(("g", "gs", "g's", "gn", "g0"), "g"),
    **dict.fromkeys(("rad", "radian", "radians"), "rad"),
    **dict.fromkeys(("deg", "°", "degree", "degrees"), "deg"),
    **dict.fromkeys(("rad/s", "radian/s", "radians/s", "rads-1", "rads^-1"), "rad/s"),
    **dict.fromkeys(
        ("deg/s", "°/s", "degree/s", "degrees/s", "degs-1", "degs^-1", "°s-1", "dps"), "deg/s"
    ),
    **dict.fromkeys(("rpm", "1/min", "u/min", "r/min", "rev/min", "upm", "min-1", "min^-1"), "rpm"),
    **{unit: unit for unit in ("cm/s", "mm/s", "mrad", "mrad/s", "mg")},
    **{f"{unit}/s{square}": f"{unit}/s²" for unit in ("cm", "mm") for square in ("²", "^2", "2")},
    **dict.fromkeys(("n", "newton"), "N"),
    "nm": "Nm",
    **dict.fromkeys(("pa", "pascal"), "Pa"),
    "kpa": "kPa",
    "mpa": "MPa",
    "bar": "bar",
    "psi": "psi",
    **dict.fromkeys(("a", "amp", "ampere"), "A"),
    **dict.fromkeys(("v", "volt"), "V"),
    **dict.fromkeys(("%", "percent"), "%"),
    **dict.fromkeys(("°c", "degc"), "°C"),
    **dict.fromkeys(("m", "meter", "metre"), "m"),
    **dict.fromkeys(
        ("mm", "cm", "km", "mv", "ma", "hpa", "mbar", "hz", "kg", "ms", "s"), "another unit"
    ),
}
# where upper and lower case differ in meaning
_CASES = {
    "kN": "kN",
    "kn": "knots",
    "Mpa": "MPa",
    "mPa": "another unit",
}


def plain_unit(text: str) -> str | None:
    """A unit as vehest spells it, ``another unit`` for one that no channel has.

    None for an unknown spelling or none.
    """
    bare = re.sub(r"[\s·*.Â()\[\]]", "", text)  # Â: UTF-8 that was read as Latin-1
    return _CASES.get(bare) or _SPELLINGS.get(bare.lower().replace("sec", "s"))


def require_unit(written: str, column: Column, si_unit: str, location: str, fix: str) -> None:
    """Refuse a declared unit that contradicts the file's; unknown spellings pass.

    Raises `DataError` where the units differ.
    """
    plain = plain_unit(written)
    if plain is None or column.factor != 1.0:
        return
    try:
        if factor_to_si(plain, si_unit) == factor_to_si(column.unit, si_unit):
            return
    except DataError:  # of another quantity
        pass
    raise DataError(
        f"{location} is in '{written}' by the file and in '{column.unit}' by conf/dataset; "
        f"correct the unit there, or {fix}"
    )
