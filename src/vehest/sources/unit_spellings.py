"""Units as files spell them; to see whether what a file says of itself contradicts what conf/dataset declares."""

from __future__ import annotations

import re

from vehest.data.errors import DataError
from vehest.data.units import factor_to_si
from vehest.sources.columns import Column

# without blanks, dots, stars and case -> as vehest spells it, or something that no channel is in; left out is what means two things
_SPELLINGS = {
    **dict.fromkeys(("m/s", "mps", "m/sec", "ms-1", "ms^-1"), "m/s"),
    **dict.fromkeys(("km/h", "kmh", "kph", "km/hr", "kmph", "kmh-1", "kmh^-1"), "km/h"),
    **dict.fromkeys(("mph", "mi/h", "mile/h", "miles/h"), "mph"),
    **dict.fromkeys(("kt", "kts", "knot", "knots"), "knots"),
    **dict.fromkeys(("m/s²", "m/s^2", "m/s2", "m/s/s", "m/sec^2", "m/sec²", "m/sec2", "mps2", "ms-2", "ms^-2"), "m/s²"),
    **dict.fromkeys(("g", "gn", "g0"), "g"),
    **dict.fromkeys(("rad", "radian", "radians"), "rad"),
    **dict.fromkeys(("deg", "°", "degree", "degrees"), "deg"),
    **dict.fromkeys(("rad/s", "rad/sec", "rads-1", "rads^-1"), "rad/s"),
    **dict.fromkeys(("deg/s", "°/s", "deg/sec", "°/sec", "degree/s", "degrees/s", "dps"), "deg/s"),
    **dict.fromkeys(("rpm", "1/min", "u/min", "r/min", "rev/min", "min-1", "min^-1"), "rpm"),
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
    **dict.fromkeys(("mm", "cm", "km", "mv", "ma", "hpa", "mbar", "hz", "kg", "ms", "s"), "another unit"),
}
_CASES = {"kN": "kN", "Mpa": "MPa", "mPa": "another unit"}  # where upper and lower case are two things


def plain_unit(text: str) -> str | None:
    """A unit's one spelling, ``another unit`` for one that no channel has; None where the spelling is not known or there is none."""
    bare = re.sub(r"[\s·*.]", "", text.strip().strip("[]()").replace("Â", ""))  # Â: UTF-8 that was taken for Latin-1 on its way
    return _CASES.get(bare) or _SPELLINGS.get(bare.lower())


def require_unit(written: str, column: Column, si_unit: str, where: str, fix: str) -> None:
    """See that the unit that a file writes does not contradict the declared one. A spelling that is not known says nothing.

    Args:
        written: in the file.
        column: what is declared; one with a factor other than 1 is in another unit than its file on purpose.
        si_unit: of the channel.
        where: file and signal, for messages.
        fix: how to let it pass, for messages.

    Raises:
        DataError: it does.
    """
    plain = plain_unit(written)
    if plain is None or column.factor != 1.0:
        return
    try:
        same = factor_to_si(plain, si_unit) == factor_to_si(column.unit, si_unit)
    except DataError:  # of another quantity
        same = False
    if not same:
        raise DataError(f"{where} is in '{written}' by the file and in '{column.unit}' by conf/dataset; correct the unit there, or {fix}")
