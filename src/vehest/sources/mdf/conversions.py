"""From raw to physical values: linear, rational, tables and formulas; what leads to text is refused when a sample meets it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from vehest.constants import FloatArray
from vehest.data.errors import DataError, printable
from vehest.sources.mdf.blocks import BlockFile
from vehest.sources.mdf.formulas import FormulaError, parse_formula
from vehest.sources.mdf.layout import Conversion


class TextError(Exception):
    """A sample stands for text."""


def same(values: FloatArray) -> FloatArray:
    """Raw values as they are."""
    return values


def text(values: FloatArray) -> FloatArray:
    """Text instead of numbers.

    Raises:
        TextError: there is a sample.
    """
    if len(values):
        raise TextError
    return values


def linear(offset: float, factor: float) -> Conversion:
    """offset + factor · x."""
    return same if (offset, factor) == (0.0, 1.0) else lambda x: x * factor + offset


def rational(p: Sequence[float]) -> Conversion:
    """(p₁ x² + p₂ x + p₃) / (p₄ x² + p₅ x + p₆)."""
    return lambda x: (p[0] * x**2 + p[1] * x + p[2]) / (p[3] * x**2 + p[4] * x + p[5])


def polynomial(p: Sequence[float]) -> Conversion:
    """(p₂ - p₄ (x - p₅ - p₆)) / (p₃ (x - p₅ - p₆) - p₁), version 3; p₄ x / p₁ where the others are zero."""
    if not any((p[1], p[2], p[4], p[5])):
        return lambda x: p[3] * x / p[0] if p[0] else x / 0.0
    return lambda x: (p[1] - p[3] * (x - p[4] - p[5])) / (p[2] * (x - p[4] - p[5]) - p[0])


def table(raw: FloatArray, physical: FloatArray, interpolated: bool) -> Conversion:
    """Values at ascending supporting points: between them interpolated, or that of the nearest, of two equally near the lower."""
    if interpolated:
        return lambda x: np.interp(x, raw, physical)

    def nearest(x: FloatArray) -> FloatArray:
        above = np.minimum(np.searchsorted(raw, x), len(raw) - 1)
        below = np.maximum(above - 1, 0)
        return np.where(np.abs(x - raw[above]) >= np.abs(x - raw[below]), physical[below], physical[above])

    return nearest


def ranges(lower: FloatArray, upper: FloatArray, physical: FloatArray, default: float, whole: bool) -> Conversion:
    """Values of ranges; whole numbers belong to both ends of one, real numbers not to the upper."""

    def looked_up(x: FloatArray) -> FloatArray:
        at, inside = _range_of(x, lower, upper, whole)
        return np.where(inside, physical[at], default)

    return looked_up


def choice(keys: FloatArray, made: Callable[[int], Conversion], default: Callable[[], Conversion]) -> Conversion:
    """Another conversion for single raw values; only those that a sample meets are made."""
    order = np.argsort(keys, kind="stable")
    ascending = keys[order]

    def chosen(x: FloatArray) -> FloatArray:
        at = np.minimum(np.searchsorted(ascending, x), max(len(keys) - 1, 0))
        hit = ascending[at] == x if len(keys) else np.zeros(len(x), dtype=bool)
        return _applied(x, np.where(hit, order[at] if len(keys) else 0, -1), made, default)

    return chosen


def range_choice(
    lower: FloatArray, upper: FloatArray, made: Callable[[int], Conversion], default: Callable[[], Conversion], whole: bool
) -> Conversion:
    """Another conversion for each range of raw values."""

    def chosen(x: FloatArray) -> FloatArray:
        if not len(lower):
            return default()(x)
        at, inside = _range_of(x, lower, upper, whole)
        return _applied(x, np.where(inside, at, -1), made, default)

    return chosen


def formula(file: BlockFile, where: str, written: str) -> Conversion:
    """A formula that the file holds.

    Raises:
        DataError: it says more than numbers, X, the four operations, powers and a dozen functions.
    """
    try:
        return parse_formula(written)
    except FormulaError as error:
        short = written if len(written) <= 80 else written[:80] + "…"
        raise DataError(
            f"'{file.path}': {where}: its formula {printable(short)!r} is not applied: {printable(str(error))[:160]}; "
            f"export the signal as plain numbers, or with a linear conversion"
        ) from None


def _range_of(x: FloatArray, lower: FloatArray, upper: FloatArray, whole: bool) -> tuple[np.ndarray, np.ndarray]:
    order = np.argsort(lower, kind="stable")
    at = order[np.maximum(np.searchsorted(lower[order], x, side="right") - 1, 0)]
    return at, (lower[at] <= x) & ((x <= upper[at]) if whole else (x < upper[at]))


def _applied(x: FloatArray, which: np.ndarray, made: Callable[[int], Conversion], default: Callable[[], Conversion]) -> FloatArray:
    """Each conversion on the samples that it is for; -1 stands for the default."""
    result = np.empty(len(x))
    order = np.argsort(which, kind="stable")
    numbers, starts = np.unique(which[order], return_index=True)
    for number, begin, end in zip(numbers.tolist(), starts.tolist(), [*starts.tolist()[1:], len(x)], strict=True):
        places = order[begin:end]
        result[places] = (made(number) if number >= 0 else default())(x[places])
    return result
