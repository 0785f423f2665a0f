"""Renders templates as C.

Constants are literals that read back to the same number, with suffixes in float builds.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from vehest.data.channels import CHANNELS
from vehest.data.errors import ConfigurationError

if TYPE_CHECKING:
    from jinja2 import Environment

Precision = Literal["double", "float"]  # number type of ``vehest_real`` in C

MAX_FLOAT = float(np.finfo(np.float32).max)  # largest float32
MIN_FLOAT = float(np.finfo(np.float32).tiny)  # smallest normal float32
MAX_TABLE_COLUMNS = 110  # characters of a line of a table
_COMMENT = re.compile(r"(/\*.*?\*/)", re.DOTALL)  # matches a comment of C
# matches a floating literal without suffix
_FLOATING = re.compile(r"(?<![\w.])(\d+\.\d*(?:[eE][+-]?\d+)?|\d+[eE][+-]?\d+)(?![\w.])")
_BLANK = re.compile(r"\n{3,}")  # matches more than one empty line
# character -> its replacement in ASCII
_ASCII = {
    "²": "^2",
    "³": "^3",
    "·": "*",
    "°": "deg",
    "ω": "omega",
    "β": "beta",
    "δ": "delta",
    "ä": "ae",
    "ö": "oe",
    "ü": "ue",
}


def render(template: str, precision: Precision, beside: Path | None = None, **values: Any) -> str:
    """The text of a template.

    Every floating literal outside comments has the type of ``vehest_real``.

    Parameters
    ----------
    template : str
        Path among those of `vehest.export`; ``methods/NAME`` may also be ``NAME`` in another
        folder.
    precision : Precision
        Type of ``vehest_real``.
    beside : Path or None
        The other folder.
    values : any
        Variables of the template by name.
    """
    text = _environment(precision, beside).get_template(template).render(values)
    return typed(_BLANK.sub("\n\n", text), precision)


def render_block(
    template: str, block: str, precision: Precision, beside: Path | None = None, **values: Any
) -> str:
    """The text of one block of a template; see `render`."""
    loaded = _environment(precision, beside).get_template(template)
    if block not in loaded.blocks:
        return ""
    context = loaded.new_context(dict(values))
    return typed("".join(loaded.blocks[block](context)), precision)


def typed(source: str, precision: Precision) -> str:
    """C source whose floating literals are those of a precision.

    ``0.5`` stays, or becomes ``0.5f``.
    """
    if precision == "double":
        return source
    pieces = _COMMENT.split(source)
    return "".join(
        piece if piece.startswith("/*") else _FLOATING.sub(r"\1f", piece) for piece in pieces
    )


def literal(value: float, precision: Precision) -> str:
    """A C literal, without suffix, that reads back to the same double or the nearest float.

    Raises
    ------
    ConfigurationError
        The value is not finite in this precision.
    """
    with np.errstate(over="ignore"):
        number = float(np.float32(value)) if precision == "float" else float(value)
    if not math.isfinite(number):
        raise ConfigurationError(
            f"the model holds {value}, which is no {precision} number; fit it anew, or export "
            "with precision double"
        )
    text = f"{number:.9g}" if precision == "float" else repr(number)
    return text if any(mark in text for mark in ".e") else f"{text}.0"


def limit(value: float, precision: Precision) -> str:
    """C literal of a number that may be infinite.

    What a float cannot hold becomes infinite or 0.
    """
    value = float(value)
    if precision == "float":
        value = (
            math.copysign(math.inf, value)
            if abs(value) > MAX_FLOAT
            else 0.0
            if abs(value) < MIN_FLOAT
            else value
        )
    if math.isinf(value):
        return "VEHEST_INFINITY" if value > 0 else "-VEHEST_INFINITY"
    return literal(value, precision)


def braced(values: Any, write: Callable[[Any], str]) -> str:
    """An array of any depth as the initialiser of a table, in lines that can be read.

    Parameters
    ----------
    values : any
        Number, or array of any dimension; each dimension becomes a pair of braces.
    write : callable
        Literal of one number.
    """
    array = np.asarray(values)
    if array.ndim == 0:
        return write(array.item())
    if array.ndim == 1:
        return _wrapped([write(value) for value in array.tolist()])
    rows = ",\n".join(braced(row, write) for row in array)
    return "{\n" + "\n".join(f"    {line}" for line in rows.split("\n")) + "\n}"


def _wrapped(words: list[str]) -> str:
    """Words in braces, on one line if they fit on it."""
    text = ", ".join(words)
    if len(text) + 2 <= MAX_TABLE_COLUMNS:
        return f"{{ {text} }}"
    lines = textwrap.wrap(
        f"{text},", MAX_TABLE_COLUMNS - 1, break_long_words=False, break_on_hyphens=False
    )
    return "{\n" + "\n".join(f"    {line}" for line in lines).removesuffix(",") + "\n}"


def integer_table(values: Any) -> str:
    """The initialiser of a table of whole numbers."""
    return braced(np.asarray(values, np.int64), str)


def bool_table(values: Any) -> str:
    """The initialiser of a table of ``bool``."""
    return braced(np.asarray(values, bool), lambda value: "true" if value else "false")


def ascii_only(text: str) -> str:
    """Text for comments and units in C, which not every compiler takes in UTF-8."""
    for mark, word in _ASCII.items():
        text = text.replace(mark, word)
    return text.encode("ascii", "replace").decode()


@cache
def _environment(precision: Precision, beside: Path | None) -> Environment:
    """Jinja environment of a precision, cached; undefined variables raise.

    Its filters write numbers: ``real`` one, ``table`` an array, ``ascii`` text for comments,
    ``unit`` the unit of a channel.
    """
    from jinja2 import (
        ChoiceLoader,
        Environment,
        FileSystemLoader,
        PackageLoader,
        PrefixLoader,
        StrictUndefined,
    )

    packaged = PackageLoader("vehest.export")
    environment = Environment(
        loader=ChoiceLoader([packaged, PrefixLoader({"methods": FileSystemLoader(beside)})])
        if beside
        else packaged,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "real": partial(literal, precision=precision),
        "table": lambda values: braced(
            np.asarray(values, np.float64), partial(literal, precision=precision)
        ),
        "ascii": ascii_only,
        "unit": lambda name: ascii_only(CHANNELS[name].unit),
    }
    environment.globals["precision"] = precision
    return environment
