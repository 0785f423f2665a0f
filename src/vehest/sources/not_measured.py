"""Texts and numbers by which files of a bus, measurements, loggers and spreadsheets mark a sample
as not measured.
"""

from __future__ import annotations

import math
import re

import numpy as np

from vehest.constants import GRAVITY, FloatArray

# ends of the ranges of integers, which a scale of a power of ten brings to 327.67 or 65.535
_ENDS_OF_RANGE = frozenset(
    sign * (2**bits - below)
    for bits in (*range(7, 17), 23, 24, 31, 32)
    for sign, below in ((1, 1), (1, 0), (-1, 1), (-1, 0))
)
# numbers of which all digits are nine
_NINES = frozenset(sign * (10**digits - 1) for digits in range(3, 10) for sign in (1, -1))
DECIMAL_SCALES = (1.0, 10.0, 100.0, 1e3, 1e4)  # powers of ten by which a code may be divided
# powers of two by which a code may be divided, of J1939: 65535 / 256 km/h is no speed
BINARY_SCALES = (16.0, 128.0, 256.0, 1024.0, 8192.0)
# of SAE J1939-71, signals with an offset: steps per unit, offset, bits, and factor to another unit
_J1939_SIGNALS = (
    (8192.0, -3.92, 16, math.degrees(1.0)),  # yaw rate [rad/s], SPN 1808
    (1024.0, -31.374, 16, math.degrees(1.0)),  # steering wheel angle [rad], SPN 1807
    (2048.0, -15.687, 16, 1.0 / GRAVITY),  # lateral acceleration [m/s²], SPN 1809
    (10.0, -12.5, 8, 1.0 / GRAVITY),  # longitudinal acceleration [m/s²], SPN 1810
)
# values that SAE J1939-71 reserves for these signals, in two units each
_J1939_CODES = tuple(
    factor * (raw / steps + offset)
    for steps, offset, bits, other_unit in _J1939_SIGNALS
    for raw in {(1 << bits) - 1, (0xFF << (bits - 8)) - 1, 0xFE << (bits - 8)}
    for factor in (1.0, other_unit)
)
MIN_HUGE = 1e15  # smallest magnitude of a number of a log that is a code, such as 1e20 or 3.4e38
MIN_CODES = 2  # smallest number of samples that hold a code; a single one may be a spike
# smallest distance of a code of J1939 from the other samples over their range, since accelerations
# come near their codes
MIN_J1939_DISTANCE = 0.2
# largest relative difference from a code, for a table's digits and another value of g
MAX_J1939_DIFFERENCE = 5e-4

# matches symbols that mark a missing sample: dashes; #VALUE!, #N/A
_SYMBOLS = re.compile(r"[-–—*?]+|#[A-Z/0]+[!?]?", re.IGNORECASE)
# words that do not change the meaning of a mark
_FILLERS = (
    *("signal", "value", "data", "sensor", "is", "indicator", "code", "state"),
    *("wert", "signalwert", "daten"),
)
_NEGATIONS = (["no"], ["kein"], ["keine"])  # words by which a text negates what follows
# words that mark a sample as not measured, without blanks
_WORDED_MARKS = """
    na nv nan sna snv inf ind qnan snan none null void
    missing invalid inv inval invld unknown undefined undef unavailable no
    notavailable notavail temporarilynotavailable notvalid notdefined notmeasured notknown reserved
    notinstalled notavailableornotinstalled notsupported notreceived noreception
    error err fault faulty failure defective defect lost timeout
    implausible notplausible outofrange rangeexceeded overflow underflow
    init initial initialized initialised initializing initialising initialization initialisation
    notinitialized notinitialised
    fehler signalfehler sensorfehler fehlerwert fehlerhaft defekt
    ungueltig ungültig nichtgültig nichtgueltig undefiniert nichtdefiniert unplausibel
    kein keine nichtverfuegbar nichtverfügbar nichtvorhanden nichtempfangen
    ueberlauf überlauf unterlauf
    initialisierung nichtinitialisiert initwert initialwert initialisierungswert
"""
_PHRASES = frozenset(_WORDED_MARKS.split())  # words of `_WORDED_MARKS` as a set


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
    if text.lower() == text.upper():  # no letters, as most cells of a table
        return False
    spaced = re.sub(r"(?<=[a-zäöü])(?=[A-ZÄÖÜ])", " ", text.removeprefix(signal)).lower()
    words = re.findall(r"[^\W\d_]+", spaced)
    phrase = [word for word in words if word not in _FILLERS]
    is_mark = "".join(phrase) in _PHRASES and (phrase not in _NEGATIONS or len(words) > 1)
    return is_mark or "sna" in words  # signal not available, beside the name of any signal


def codes_of_not_measured(values: FloatArray) -> list[float]:
    """Numbers in a column that stand for a missing sample: -9999, 1e20, 327.67 and alike.

    Such a code occurs repeatedly and is further from all other values than these are from one
    another; a code of J1939's signals with an offset, such as a yaw rate of 4.07988 rad/s, than a
    fifth of that.

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
        value_range = float(np.ptp(samples))
        if (_looks_like_code(code) and distance > value_range > 0.0) or (
            _is_j1939_code(code) and distance > MIN_J1939_DISTANCE * value_range > 0.0
        ):
            codes.append(code)
            measured = samples
    return codes


def _is_j1939_code(value: float) -> bool:
    """Whether a number is J1939's "not available" or "error" of a signal with an offset."""
    return any(abs(value / code - 1.0) < MAX_J1939_DIFFERENCE for code in _J1939_CODES)


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
