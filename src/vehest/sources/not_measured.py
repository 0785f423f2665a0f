"""Texts by which DBC files, measurement files, loggers and spreadsheets mark a sample as not measured."""

from __future__ import annotations

import re

_SYMBOLS = re.compile(r"[-–—*?]+|#[A-Z/0]+[!?]?", re.IGNORECASE)  # dashes; #VALUE!, #N/A
_FILLERS = frozenset(("signal", "value", "data", "sensor", "is", "indicator", "code", "state"))
_PHRASES = frozenset(
    (
        *("na", "nv", "nan", "sna", "snv", "inf", "ind", "qnan", "snan", "none", "null", "void"),
        *("missing", "invalid", "inv", "inval", "invld", "unknown", "undefined", "undef"),
        *("unavailable", "no", "notavailable", "notavail", "temporarilynotavailable"),
        *("notvalid", "notdefined", "notmeasured", "notknown", "reserved"),
        *("error", "err", "fault", "faulty", "failure"),
        *("init", "initial", "initialized", "initialised", "initializing", "initialising"),
        *("initialization", "initialisation", "notinitialized", "notinitialised"),
        *("fehler", "ungueltig", "ungültig", "nichtgültig", "nichtgueltig", "undefiniert"),
        *("nichtverfuegbar", "nichtverfügbar", "initialisierung"),
    )
)


def marks_not_measured(text: str, signal: str = "") -> bool:
    """Whether a text marks a sample as not measured.

    The whole text has to say so, so that neither ``no error`` nor a gear called ``N`` does.

    Parameters
    ----------
    text : str
        A cell of a table, or the name that a DBC or a measurement file gives to a raw value.
    signal : str
        Name of the signal, with which the text may begin, as in ``VehSpd_SNA``.
    """
    if _SYMBOLS.fullmatch(text.strip()):
        return True
    words = re.findall(r"[^\W\d_]+", text.removeprefix(signal).lower())
    phrase = [word for word in words if word not in _FILLERS]
    return "".join(phrase) in _PHRASES and (phrase != ["no"] or len(words) > 1)
