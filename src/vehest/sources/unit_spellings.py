"""Spellings of units in files, compared with the units that conf/dataset declares."""

from __future__ import annotations

import re

from vehest.data.errors import DataError
from vehest.data.units import factor_to_si
from vehest.sources.columns import Column

# unit as vehest spells it, or a unit of no channel -> its spellings, without blanks, dots, stars,
# brackets and case, sec as s; ambiguous ones are left out
_SPELLINGS_OF = {
    "m/s": "m/s mps meter/s meters/s ms-1 ms^-1",
    "km/h": "km/h kmh kph km/hr kmph kmh-1 kmh^-1",
    "mph": "mph mi/h mile/h miles/h",
    "knots": "kt kts knot knots knoten noeuds nœuds",
    "ft/s": "ft/s fps",
    "m/s²": "m/s² m/s^2 m/s2 m/s/s mps2 mps^2 meter/s^2 meters/s^2 ms-2 ms^-2",
    "ft/s²": "ft/s² ft/s^2 ft/s2",
    "g": "g gs g's gn g0",
    "rad": "rad radian radians",
    "deg": "deg ° degree degrees",
    "rad/s": "rad/s radian/s radians/s rads-1 rads^-1",
    "deg/s": "deg/s °/s degree/s degrees/s degs-1 degs^-1 °s-1 dps",
    "rpm": "rpm 1/min u/min r/min rev/min upm min-1 min^-1",
    "cm/s": "cm/s",
    "mm/s": "mm/s",
    "mrad": "mrad",
    "mrad/s": "mrad/s",
    "mg": "mg",
    "cm/s²": "cm/s² cm/s^2 cm/s2",
    "mm/s²": "mm/s² mm/s^2 mm/s2",
    "N": "n newton",
    "Nm": "nm",
    "Pa": "pa pascal",
    "kPa": "kpa",
    "MPa": "mpa",
    "bar": "bar",
    "psi": "psi",
    "A": "a amp ampere",
    "V": "v volt",
    "%": "% percent",
    "°C": "°c degc",
    "m": "m meter metre",
    "another unit": "mm cm km mv ma hpa mbar hz kg ms s",
}
_SPELLINGS = {
    spelling: unit for unit, spellings in _SPELLINGS_OF.items() for spelling in spellings.split()
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
