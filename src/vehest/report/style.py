"""One look for all studies: widths, colours, lines and the way numbers are written."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

from vehest.data.errors import listed as listed
from vehest.estimators.registry import estimator_class, estimator_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MatplotlibFigure: TypeAlias = "Figure"

SINGLE_COLUMN = 3.5  # width of one column of a two-column journal, in
DOUBLE_COLUMN = 7.16  # width of both columns, in
MISSING = "–"  # text of a missing value

REFERENCE_COLOUR = "#000000"  # colour of a line of the reference
REFERENCE_GREY = "#8c9096"  # colour of a wide line of the reference below estimates, 3:1 on white
# colours of KS-NN with linear feedback, without and with bias
LINEAR_BLUES = ("#4aa5e0", "#0b4f9c")
# colours of KS-NN with nonlinear feedback, without and with bias
NONLINEAR_ORANGES = ("#f59a23", "#b8480b")
# colours of estimators whose family declares no line
OTHER_COLOURS = ("#00876c", "#a6761d", "#d6336c", "#5b8c00", "#17a2b8", "#6d4c41")

_DARK_PAPER = 0x1A  # grey of the page in its dark scheme, as in templates/page.css
_DARK_INK = 0xE6  # grey of the text there
_DASHES = ("solid", "dashed", "dotted", "dashdot")  # dashes by which equal lines are distinguished
_MARKERS = ("o", "s", "^", "D", "v", "P", "X")  # markers by which equal lines are distinguished

# settings of matplotlib for all figures
_PAPER = {
    "font.family": "DejaVu Sans",
    "font.size": 7.5,
    "axes.titlesize": 8.0,
    "axes.labelsize": 7.5,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "legend.fontsize": 7.0,
    "legend.frameon": False,
    "legend.handlelength": 2.2,
    "axes.linewidth": 0.6,
    "axes.edgecolor": "#444444",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e2e2e2",
    "grid.linewidth": 0.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "lines.linewidth": 1.1,
    "lines.markersize": 3.5,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "figure.constrained_layout.h_pad": 0.03,
    "figure.constrained_layout.w_pad": 0.03,
    "axes.formatter.use_mathtext": True,
    "path.simplify": True,
    "path.simplify_threshold": 0.25,
    "svg.fonttype": "path",
    "svg.hashsalt": "vehest",
}


@dataclass(frozen=True)
class Line:
    """Look of an estimator's line, the same in every figure."""

    colour: str  # hexadecimal, readable on white
    dash: str = "solid"  # ``solid``, ``dashed``, ``dotted`` or ``dashdot``
    marker: str = "o"  # matplotlib's marker, where points are drawn


REFERENCE = Line(REFERENCE_COLOUR)  # look of the reference


def line_of(estimator: str, variant: str = "") -> Line:
    """Line of an estimator as its family declares it (`Estimator.line_style`), else one of a colour
    that depends on the name only.

    Parameters
    ----------
    estimator, variant : str
        Names; another tool's estimator has no family.
    """
    drawn = (
        estimator_class(estimator).line_style(variant) if estimator in estimator_names() else None
    )
    if drawn is not None:
        return Line(*drawn)
    return Line(
        OTHER_COLOURS[zlib.crc32(f"{estimator}/{variant}".encode()) % len(OTHER_COLOURS)],
        "solid",
        "P",
    )


def lines_of(names: Iterable[tuple[str, str]]) -> dict[tuple[str, str], Line]:
    """Lines of several (estimator, variant), all different as long as dashes and markers last.

    The first of those that would look alike keeps its own line; the later ones change dash, then
    marker.
    """
    lines: dict[tuple[str, str], Line] = {}
    for name in names:
        line_of_family = line_of(*name)
        dashes = (line_of_family.dash, *(dash for dash in _DASHES if dash != line_of_family.dash))
        markers = (
            line_of_family.marker,
            *(marker for marker in _MARKERS if marker != line_of_family.marker),
        )
        used_lines = set(lines.values())
        options = (
            replace(line_of_family, dash=dash, marker=marker)
            for marker in markers
            for dash in dashes
        )
        lines[name] = next((line for line in options if line not in used_lines), line_of_family)
    return lines


def on_dark(colour: str) -> str:
    """The colour that replaces ``colour`` on a dark page: greys change places with their opposites,
    hues get lighter.

    Parameters
    ----------
    colour : str
        ``#rrggbb``.
    """
    red, green, blue = (int(colour[start : start + 2], 16) for start in (1, 3, 5))
    if max(red, green, blue) - min(red, green, blue) <= 12:
        level = _DARK_INK + (_DARK_PAPER - _DARK_INK) * (red + green + blue) / (3 * 255)
        return f"#{round(level):02x}{round(level):02x}{round(level):02x}"
    return "#" + "".join(f"{round(0.65 * part + 0.35 * 255):02x}" for part in (red, green, blue))


@contextmanager
def paper_style() -> Iterator[None]:
    """Matplotlib settings of all figures, in force inside the ``with`` block only."""
    import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_PAPER)
        yield


@contextmanager
def new_figure(width: float, height: float) -> Iterator[MatplotlibFigure]:
    """An empty figure of a width and height [in] without global state, drawn inside the ``with``
    block in `paper_style`.

    Yields
    ------
    Figure
        With constrained layout.
    """
    from matplotlib.figure import Figure

    with paper_style():
        yield Figure(figsize=(width, height), layout="constrained")


def significant(value: float, digits: int = 3) -> str:
    """Text of a number with some significant digits, without an exponent between 1e-4 and 1e6.

    `MISSING` if it is not finite.
    """
    if not math.isfinite(value):
        return MISSING
    return (
        _grouped(value, decimals_for([value], digits))
        if value == 0 or 1e-4 <= abs(value) < 1e6
        else f"{value:.{digits - 1}e}"
    )


def decimals_for(values: Sequence[float], digits: int = 3) -> int:
    """Decimals that show the typical of some numbers with so many significant digits, so that a
    column lines up.

    Parameters
    ----------
    values : sequence of float
        Zeros and values that are not finite do not count; the typical one is the lower median of
        the magnitudes.
    digits : int
        Significant digits of the typical value.

    Returns
    -------
    int
        From 0 to 6.
    """
    sizes = sorted(abs(value) for value in values if math.isfinite(value) and value != 0)
    if not sizes:
        return 0
    typical = sizes[(len(sizes) - 1) // 2]
    return min(max(digits - 1 - math.floor(math.log10(typical)), 0), 6)


def fixed(value: float, decimals: int) -> str:
    """Text of a number with a fixed number of decimals and grouped thousands.

    `MISSING` if it is not finite.
    """
    return _grouped(value, decimals) if math.isfinite(value) else MISSING


def _grouped(value: float, decimals: int) -> str:
    """Text of a number with decimals, a narrow space between thousands from 10,000 on, and a minus
    sign.
    """
    text = f"{value:,.{decimals}f}" if abs(value) >= 1e4 else f"{value:.{decimals}f}"
    return text.replace(",", "\N{NARROW NO-BREAK SPACE}").replace("-", "\N{MINUS SIGN}")
