"""Spellings of units in files, compared with the units that conf/dataset declares."""

from __future__ import annotations

import re

from vehest.data.errors import DataError
from vehest.data.units import factor_to_si
from vehest.sources.columns import Column

# unit as vehest spells it, or a unit of no channel -> its spellings, without blanks, dots, stars,
# brackets and case, sec as s; ambiguous ones are left out
_SPELLINGS_OF = {
    "m/s": "m/s mps meter/s meters/s ms-1 ms^-1 м/с 米/s",
    "km/h": (
        "km/h kmh kph km/hr km/hour km/std kmph kmh-1 kmh^-1 unit_kilometerperhour "
        "км/ч 千米/小时 公里/小时"
    ),
    "mph": "mph mi/h mi/hr mile/h miles/h miles/hour",
    "knots": "kt kts knt knot knots knoten noeuds nœuds nodi",
    "ft/s": "ft/s fps feet/s foot/s fts-1 fts^-1",
    "m/s²": (
        "m/s² m/s^2 m/s2 m/s/s mps2 mps^2 meter/s^2 meters/s^2 ms-2 ms^-2 unit_meterperssquar "
        "м/с² м/с^2 м/с2 米/s² 米/s^2 米/s2"
    ),
    "ft/s²": "ft/s² ft/s^2 ft/s2 ft/s/s fps2 fps² feet/s² feet/s^2 feet/s2 fts-2 fts^-2",
    "g": "g gs g's gn g0",
    "rad": "rad radian radians рад 弧度",
    "deg": "deg ° º degree degrees gradi grados degré degrés 度 град unit_degreofarc",
    "rad/s": "rad/s radian/s radians/s rads-1 rads^-1 рад/с 弧度/s",
    "deg/s": (
        "deg/s °/s º/s degree/s degrees/s degs-1 degs^-1 °s-1 dps gradi/s grados/s "
        "degré/s degrés/s 度/s град/с °/с unit_degreofarcpers"
    ),
    "rpm": "rpm 1/min u/min r/min rev/min tr/min giri/min upm min-1 min^-1",
    "rev/s": "rev/s revs/s tr/s giri/s",
    "cm/s": "cm/s cms-1 cms^-1",
    "mm/s": "mm/s mms-1 mms^-1",
    "rev": "rev revs revolution revolutions turn turns umdrehung umdrehungen tours",
    "mrad": "mrad milliradian milliradians",
    "mdeg": "mdeg m° millideg millidegree millidegrees",
    "mrad/s": "mrad/s mrads-1 mrads^-1 milliradian/s milliradians/s",
    "mdeg/s": "mdeg/s m°/s mdps mdegs-1 mdegs^-1 millideg/s millidegree/s millidegrees/s",
    "deg/min": "deg/min °/min º/min degree/min degrees/min degree/minute degrees/minute degmin-1",
    "mg": "mg millig milli-g milligs",
    "cm/s²": "cm/s² cm/s^2 cm/s2 cm/s/s cms-2 cms^-2",
    "mm/s²": "mm/s² mm/s^2 mm/s2 mm/s/s mms-2 mms^-2",
    "N": "n newton",
    "Nm": "nm",
    "Pa": "pa pascal",
    "kPa": "kpa",
    "MPa": "mpa",
    "bar": "bar",
    "psi": "psi",
    "A": "a amp ampere",
    "V": "v volt",
    "%": "% percent pct prozent",
    "°C": "°c degc",
    "m": "m meter metre",
    "another unit": "mm cm km mv ma hpa mbar hz kg ms s",
}
# spelling -> unit
_SPELLINGS = {
    spelling: unit for unit, spellings in _SPELLINGS_OF.items() for spelling in spellings.split()
}
# spelling of which upper and lower case matter -> unit
_CASES = {
    "kN": "kN",
    "kn": "knots",
    "Mpa": "MPa",
    "mPa": "another unit",
}
# matches a unit with the step of a raw count before it
_STEPPED = re.compile(
    r"(?:((?=.*?[1-9])\d*[.,]?\d+(?:e[-+]?\d)?)(?=[\s·*×\[a-z°]))?(.*)", re.IGNORECASE | re.DOTALL
)
# matches a fraction before a unit, as in 1/1000 g
_FRACTION = re.compile(r"^1/(10{1,4})[\s·*×]*(?=[^\W\d]|[°º])")
_SECOND = re.compile(r"sec(on(d[saeoi]?)?)?|sek(unden?)?|秒")  # matches spellings of a second


def plain_unit(text: str) -> str | None:
    """A unit as vehest spells it.

    Blanks, dots, stars, brackets and, but for a few spellings, case do not matter.

    Parameters
    ----------
    text : str
        The unit as a file writes it.

    Returns
    -------
    str or None
        ``another unit`` for one that no channel has; a step of raw counts stays before it:
        ``0.01*deg/s``. None for an unknown spelling or none.
    """
    text = _FRACTION.sub(lambda match: f"{1.0 / float(match[1]):g} ", text.strip())
    step, rest = _STEPPED.fullmatch(text.strip("()[] ")).groups()  # type: ignore[union-attr]
    bare = re.sub(r"[\s·*×.Â()\[\]]", "", rest)  # Â: UTF-8 that was read as Latin-1
    bare = bare.replace("|", "/")  # as dSPACE writes km|h
    plain = _CASES.get(bare) or _SPELLINGS.get(_SECOND.sub("s", bare.lower()))
    if not step or plain in (None, "another unit"):
        return None if step else plain
    return f"{step.lower().replace(',', '.')}*{plain}"


def require_unit(written: str, column: Column, si_unit: str, location: str, fix: str) -> None:
    """Refuse a declared unit that contradicts the file's; unknown spellings pass, and so does a
    column with a factor.

    Parameters
    ----------
    written : str
        The unit as the file writes it.
    column : Column
        Declaration of the channel.
    si_unit : str
        Unit of the channel.
    location : str
        File and column, for messages.
    fix : str
        What else to do than to correct the unit, for messages.

    Raises
    ------
    DataError
        The units differ, even if only by a factor.
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
