"""Texts and numbers by which files of a bus, measurements, loggers and spreadsheets mark a sample
as not measured.
"""

from __future__ import annotations

import re

import numpy as np

from vehest.constants import FloatArray

# of integers, which a scale of a power of ten brings to 327.67 or 65.535
_ENDS_OF_RANGE = frozenset(
    sign * (2**bits - below)
    for bits in (*range(7, 17), 23, 24, 31, 32)
    for sign, below in ((1, 1), (1, 0), (-1, 1), (-1, 0))
)
_NINES = frozenset(sign * (10**digits - 1) for digits in range(3, 10) for sign in (1, -1))
DECIMAL_SCALES = (1.0, 10.0, 100.0, 1e3, 1e4)
BINARY_SCALES = (16.0, 128.0, 256.0, 1024.0, 8192.0)  # of J1939: 65535 / 256 km/h is no speed
MIN_HUGE = 1e15  # beyond it a number of a log is a code such as 1e20 or 3.4e38
MIN_CODES = 2  # samples; one alone may be a spike

_SYMBOLS = re.compile(r"[-–—*?]+|#[A-Z/0]+[!?]?", re.IGNORECASE)  # dashes; #VALUE!, #N/A
_FILLERS = ("signal", "value", "data", "sensor", "is", "indicator", "code", "state")
_WORDED_MARKS = """
    na nv nan sna snv inf ind qnan snan none null void
    missing invalid inv inval invld unknown undefined undef unavailable no
    notavailable notavail temporarilynotavailable notvalid notdefined notmeasured notknown reserved
    error err fault faulty failure
    init initial initialized initialised initializing initialising initialization initialisation
    notinitialized notinitialised
    fehler ungueltig ungültig nichtgültig nichtgueltig undefiniert
    nichtverfuegbar nichtverfügbar initialisierung
"""
_PHRASES = frozenset(_WORDED_MARKS.split())


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


def codes_of_not_measured(values: FloatArray) -> list[float]:
    """Numbers in a column that stand for a missing sample: -9999, 1e20, 327.67 and alike.

    Such a code occurs repeatedly and is further from all other values than these are from one
    another.

    Parameters
    ----------
    values : FloatArray
        Samples in the file's unit, NaN where there is none, shape (N,).

    Returns
    -------
    list of float
        None, one or two of them, in the file's unit: the largest value, then the smallest. A code
        stands in two samples at least, and in at most half of ``values``.
    """
    measured = values[np.isfinite(values)]
    codes = []
    for extreme in (np.max, np.min):
        if not len(measured):
            break
        code = float(extreme(measured))
        samples = measured[measured != code]
        if len(measured) - len(samples) < MIN_CODES or len(samples) < 0.5 * len(values):
            continue
        distance = float(np.abs(samples - code).min())
        if _looks_like_code(code) and distance > float(np.ptp(samples)) > 0.0:
            codes.append(code)
            measured = samples
    return codes


def _looks_like_code(value: float) -> bool:
    """Whether a number is huge, the end of an integer's range or all nines, perhaps scaled by a
    power of ten or, the end of a range, by one of two.
    """
    if abs(value) >= MIN_HUGE:
        return True
    for scale in (*DECIMAL_SCALES, *BINARY_SCALES):
        integer = round(value * scale)
        is_integer = abs(value * scale - integer) <= 1e-6 * abs(integer)  # of single precision, too
        if is_integer and (
            integer in _ENDS_OF_RANGE or (scale in DECIMAL_SCALES[:3] and integer in _NINES)
        ):
            return True
    return False
