"""A report as data, and its two forms: a Markdown file with tables and figures beside it, and one
self-contained page.
"""

from __future__ import annotations

import base64
import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from vehest.data.errors import printable
from vehest.report.style import (
    MISSING,
    REFERENCE_COLOUR,
    decimals_for,
    fixed,
    on_dark,
    paper_style,
    significant,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure as MatplotlibFigure

PATENT_NOTE = (
    "## Note\n\nThe KS-NN is patented by its authors (PCT/IT2023/050058). Using it in a product "
    "may need their licence; the licence of this software grants none."
)
"""Section with which every report with a KS-NN ends."""

REPORT = "report"  # name of the document with which a study starts

MAX_AXIS_RATIO = 6.0  # times the median error, beyond which a bar is cut
PNG_DPI = 150  # resolution of figures as pixels, unless a caller says another
PNG_COLOURS = 256  # colours of a PNG, the most that a palette may have
# matches cells that a spreadsheet would read as a formula
_FORMULA = re.compile(r"[=@\t\r]|[+-].*[A-Za-z|!(]", re.DOTALL)
_PATH = re.compile(r'\bd="[^"]*"')  # matches the path data of an SVG
_LONG_NUMBER = re.compile(r"-?\d+\.\d{3,}")  # matches numbers with three decimals or more
_NAME = re.compile(r"[a-z0-9][a-z0-9_.-]*")  # matches valid file names of tables and figures
_UNWANTED = {"html_inline", "html_block", "image"}  # Markdown tokens that are shown as text
# matches link schemes other than http, https and mailto
_SCRIPTED = re.compile(r"(?!https?:|mailto:)[a-z][a-z0-9+.-]*:", re.IGNORECASE)
_APPENDIX = re.compile(r"\A## Appendix: (.)")  # the page lists these under "Appendices"
# matches links to other documents, which the page replaces
_LINK_TO_PAGE = re.compile(r'href="([a-z0-9][a-z0-9_-]*)\.md"')


@dataclass(frozen=True)
class Column:
    """Column of a table and the format of its numbers; its CSV file keeps every digit."""

    header: str  # title of the column, unit included
    digits: int = (
        3  # significant digits of its typical value, from which the decimals of all follow
    )
    decimals: int | None = None  # decimals of every value, instead of ``digits``
    each: bool = False  # every value has its own decimals, as in a column of different units
    # columns of the frame with a value and the ends of its interval; the page draws them into the
    # cells, and sorts by the value
    bar: tuple[str, str, str] | None = None


@dataclass(frozen=True)
class ModelLink:
    """Place of the model behind a row of a table."""

    folder: str  # folder of the model, relative to the page
    command: str  # command that runs it


@dataclass(frozen=True, eq=False)
class Table:
    """A table with a caption."""

    name: str  # file name without ending: small letters, digits, ``_``, ``-`` and ``.``
    caption: str  # Markdown
    frame: pd.DataFrame  # the values, with short names as columns
    # column of the frame -> how it is shown, in this order; all of them, by their own names, if
    # empty
    columns: Mapping[str, Column] = field(default_factory=dict)
    links: Sequence[ModelLink] = ()  # a model a row, for the page alone; none if empty


@dataclass(frozen=True, eq=False)
class Figure:
    """A figure with a caption."""

    name: str  # file name without ending, as in `Table`
    caption: str  # Markdown; its first sentence is the alternative text
    static: MatplotlibFigure  # matplotlib figure, for PNG, SVG and print
    interactive: str = ""  # `explorer_json` of what the page draws in its place


Block: TypeAlias = "str | Table | Figure"  # part of a document: Markdown, a table or a figure


@dataclass(frozen=True, eq=False)
class Document:
    """A report.

    Raises
    ------
    ValueError
        Two tables or two figures share a name, or a name is no file name.
    """

    title: str  # plain text
    blocks: Sequence[
        Block
    ]  # Markdown text (headings from ``##`` down), tables and figures, in reading order
    # name -> table that is written beside the others without being shown; text may link to
    # ``tables/NAME.csv``
    data: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    # number of first blocks that the page shows, the sections after them being folded appendices;
    # None: all up to the first appendix
    open_blocks: int | None = None

    def __post_init__(self) -> None:
        for kind in (Table, Figure):
            names = [block.name for block in self.blocks if isinstance(block, kind)] + (
                list(self.data) if kind is Table else []
            )
            for name in names:
                if not _NAME.fullmatch(name):
                    raise ValueError(f"'{name}' cannot name a file of a report")
                if names.count(name) > 1:
                    raise ValueError(
                        f"report '{self.title}' has {names.count(name)} {kind.__name__.lower()}s "
                        f"called '{name}'"
                    )


def write_documents(
    documents: Mapping[str, Document], folder: Path, *, on_page: Sequence[str | Table]
) -> None:
    """Write documents that link to each other as ``NAME.md``; their tables and figures lie side by
    side.

    Parameters
    ----------
    documents : mapping
        Name of the file, without ending -> document.
    folder : Path
        Existing folder; ``tables`` and ``figures`` are made in it.
    on_page : Sequence[str or Table]
        Text and tables that the page of ``report`` alone ends with, and no other file contains.

    Raises
    ------
    ValueError
        Tables or figures of two documents share a name, or a name is no file name.
    """
    blocks = [block for document in documents.values() for block in document.blocks]
    Document(
        "all pages",
        blocks,
        {name: frame for document in documents.values() for name, frame in document.data.items()},
    )
    for name, document in documents.items():
        if not _NAME.fullmatch(name):
            raise ValueError(f"'{name}' cannot name a file of a report")
        write_document(document, folder, name=name, on_page=on_page if name == REPORT else ())


def write_document(
    document: Document,
    folder: Path,
    *,
    page: bool = True,
    name: str = "report",
    on_page: Sequence[str | Table] = (),
) -> None:
    """Write ``report.md``, ``tables/*.csv``, ``figures/*.png`` and ``*.svg``, and ``report.html``
    where ``page`` is set.

    The same document gives the same bytes.

    Parameters
    ----------
    document : Document
        The report.
    folder : Path
        Existing folder.
    page : bool
        Whether to write the HTML page too.
    name : str
        Of both files, without ending.
    on_page : Sequence[str or Table]
        Text and tables that the page alone ends with, and no other file contains.

    Raises
    ------
    ValueError
        A table of ``on_page`` has the name of another.
    """
    images: dict[str, bytes] = {}
    for table, frame in document.data.items():
        _write_table(folder, table, frame)
    for block in document.blocks:
        if isinstance(block, Table):
            _write_table(folder, block.name, block.frame)
        elif isinstance(block, Figure):
            (folder / "figures").mkdir(exist_ok=True)
            (folder / "figures" / f"{block.name}.png").write_bytes(png_of(block.static))
            images[block.name] = svg_of(block.static)
            (folder / "figures" / f"{block.name}.svg").write_bytes(images[block.name])
    (folder / f"{name}.md").write_bytes(_markdown(document).encode("utf-8", "backslashreplace"))
    if page:
        page_document = replace(document, blocks=[*document.blocks, *on_page])
        (folder / f"{name}.html").write_bytes(page_of(page_document, images))


def page_of(document: Document, images: Mapping[str, bytes] | None = None) -> bytes:
    """The self-contained HTML page of a document.

    ``images``: its figures as SVG by name; drawn here if None.

    Returns
    -------
    bytes
        UTF-8; it loads nothing from elsewhere, and shows figures in the reader's colour scheme.
    """
    drawn = images or {
        block.name: svg_of(block.static) for block in document.blocks if isinstance(block, Figure)
    }
    return _page(document, drawn).encode("utf-8", "backslashreplace")


def as_text(name: str) -> str:
    """A name or title of unknown origin as Markdown that shows it as it is, on one line: nothing in
    it is a link, markup or HTML.
    """
    line = printable(" ".join(name.split()))
    line = re.sub(r"[\\`*\[\]]", r"\\\g<0>", line)
    line = re.sub(r"(?<![^\W_])_|_(?![^\W_])", r"\_", line)
    return re.sub(r"&(?=#?\w+;)", "&amp;", line).replace("<", "&lt;")


def as_code(text: str) -> str:
    """Text as a Markdown code span that it cannot end."""
    line = printable(" ".join(text.split()))
    fence = "`" * (max((len(run) for run in re.findall("`+", line)), default=0) + 1)
    return f"{fence} {line} {fence}" if "`" in line else f"`{line}`"


def formatted(table: Table) -> tuple[list[str], list[list[str]], list[bool]]:
    """Headers of a table, rows of cells, and for each column whether it contains numbers.

    Parameters
    ----------
    table : Table
        Decimals of a column follow from its typical value, unless its `Column` states them.

    Returns
    -------
    tuple
        Cells are text; missing values are `MISSING`.
    """
    from pandas.api.types import is_bool_dtype, is_numeric_dtype

    visible = table.columns or {str(name): Column(str(name)) for name in table.frame.columns}
    columns = []
    numeric = []
    for name, column in visible.items():
        values = table.frame[name]
        is_number = bool(is_numeric_dtype(values) and not is_bool_dtype(values))
        numeric.append(is_number)
        texts = (
            MISSING if value is None or value != value else printable(str(value))
            for value in values.tolist()
        )
        columns.append(_number_cells(values.tolist(), column) if is_number else list(texts))
    return (
        [printable(column.header) for column in visible.values()],
        [list(row) for row in zip(*columns, strict=True)],
        numeric,
    )


def _number_cells(values: list[Any], column: Column) -> list[str]:
    """Texts of the numbers of a column, those of integers without decimals."""
    if all(isinstance(value, int) for value in values):
        return [fixed(value, 0) for value in values]
    numbers = [
        float(value) if value is not None and value == value else math.nan for value in values
    ]
    if column.each:
        return [
            fixed(number, 0) if number.is_integer() else significant(number, column.digits)
            for number in numbers
        ]
    decimals = decimals_for(numbers, column.digits) if column.decimals is None else column.decimals
    return [fixed(number, decimals) for number in numbers]


def _numbers(document: Document) -> dict[int, str]:
    """Position of a table or figure -> ``Table 1``, ``Figure 3``."""
    counts = {"Table": 0, "Figure": 0}
    numbers = {}
    for position, block in enumerate(document.blocks):
        if not isinstance(block, str):
            kind = type(block).__name__
            counts[kind] += 1
            numbers[position] = f"{kind} {counts[kind]}"
    return numbers


def png_of(figure: MatplotlibFigure, dpi: int = PNG_DPI) -> bytes:
    """A figure as pixels, in as few colours as look the same: a third of the size.

    The same figure gives the same bytes.
    """
    from PIL import Image

    small = io.BytesIO()
    with Image.open(io.BytesIO(_saved(figure, "png", dpi=dpi))) as image:
        quantized = image.convert("RGB").quantize(
            PNG_COLOURS, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
        )
        quantized.save(small, format="png", optimize=True, dpi=(dpi, dpi))
    return small.getvalue()


def pdf_of(figure: MatplotlibFigure) -> bytes:
    """A figure as PDF."""
    return _saved(figure, "pdf", metadata={"CreationDate": None, "Creator": None})


def svg_of(figure: MatplotlibFigure) -> bytes:
    """A figure as SVG, with places to a hundredth of a point, finer than any page: half the
    size.
    """

    def in_hundredths(path: re.Match[str]) -> str:
        return _LONG_NUMBER.sub(
            lambda number: f"{float(number[0]):.2f}".rstrip("0").rstrip("."), path[0]
        )

    svg = _saved(figure, "svg", dpi=PNG_DPI, metadata={"Date": None, "Creator": None})
    return _PATH.sub(in_hundredths, svg.decode("utf-8")).encode("utf-8")


def _saved(figure: MatplotlibFigure, form: str, **options: Any) -> bytes:
    """A figure as matplotlib writes it in a format."""
    buffer = io.BytesIO()
    with paper_style():
        figure.savefig(buffer, format=form, **options)
    return buffer.getvalue()


def _for_both_schemes(svg: bytes) -> bytes:
    """An SVG figure that has other colours where its reader prefers a dark page."""
    text = svg.decode("utf-8")
    colours = sorted(set(re.findall(r"(?:fill|stroke): (#[0-9a-f]{6})", text)))
    rules = [
        f'[style*="{kind}: {colour}"]{{{kind}:{on_dark(colour)}!important}}'
        for colour in colours
        for kind in ("fill", "stroke")
        if f"{kind}: {colour}" in text
    ]
    style = (
        "<style>@media (prefers-color-scheme: "
        f"dark){{svg{{fill:{on_dark(REFERENCE_COLOUR)}}}{''.join(rules)}}}</style>"
    )
    return re.sub(r"(<svg\b[^>]*>)", lambda opening: opening[0] + style, text, count=1).encode(
        "utf-8"
    )


def _write_table(folder: Path, name: str, frame: pd.DataFrame) -> None:
    """Write a table as tables/NAME.csv with all digits, lines ending in LF."""
    (folder / "tables").mkdir(exist_ok=True)
    frame.to_csv(
        folder / "tables" / f"{name}.csv",
        index=False,
        lineterminator="\n",
        encoding="utf-8",
        errors="backslashreplace",
    )


def _markdown(document: Document) -> str:
    """The report as Markdown, tables in pipes, figures as links to PNG and SVG."""
    numbers = _numbers(document)
    parts = [f"# {as_text(document.title)}"]
    for position, block in enumerate(document.blocks):
        if isinstance(block, str):
            parts.append(_harmless(block.strip()))
        elif isinstance(block, Table):
            parts.append(
                f"**{numbers[position]}.** {_harmless(block.caption)} "
                f"([CSV](tables/{block.name}.csv))"
            )
            headers, rows, numeric = formatted(block)
            lines = [headers, ["--:" if is_number else ":--" for is_number in numeric], *rows]
            parts.append(
                "\n".join(
                    "| " + " | ".join(_in_pipes(cell) for cell in line) + " |" for line in lines
                )
            )
        else:
            parts.append(f"![{_spoken(block.caption)}](figures/{block.name}.png)")
            parts.append(
                f"**{numbers[position]}.** {_harmless(block.caption)} "
                f"([SVG](figures/{block.name}.svg))"
            )
    return "\n\n".join(parts) + "\n"


def _in_pipes(cell: str) -> str:
    """Text of a cell for a Markdown table, on one line, that cannot end the column or be HTML or a
    link.
    """
    line = printable(" ".join(cell.split()))
    return (
        line.replace("\\", "&#92;").replace("|", "\\|").replace("<", "&lt;").replace("](", "]\\(")
    )


def _harmless(text: str) -> str:
    """Markdown as it is, unless it has HTML, pictures, or links with a scheme other than http,
    https and mailto; then these, and all other links, are shown as text.

    What it contains of them is shown as text.
    """
    from markdown_it import MarkdownIt

    text = printable(text, keep="\n\t")
    parser = MarkdownIt("commonmark", {"html": True})
    parser.validateLink = lambda url: True  # type: ignore[method-assign]
    tokens = [token for outer in parser.parse(text) for token in (outer, *(outer.children or []))]
    if not any(
        token.type in _UNWANTED or _SCRIPTED.match(str(token.attrGet("href") or ""))
        for token in tokens
    ):
        return text
    return text.replace("\\[", "[").replace("<", "&lt;").replace("[", "&#91;")


def _spoken(caption: str) -> str:
    """Alternative text of a figure: first sentence of a caption, without marks of Markdown."""
    plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", caption)
    plain = re.sub(r"[*`\[\]<>|]", "", plain).replace("\n", " ").strip()
    return re.split(r"(?<=\.)\s", plain, maxsplit=1)[0]


def _page(document: Document, images: Mapping[str, bytes]) -> str:
    """The HTML page from its template, with style, script, figures and data inside."""
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markdown_it import MarkdownIt
    from markupsafe import Markup

    markdown = MarkdownIt("commonmark", {"html": False}).enable("table").disable("image")
    numbers = _numbers(document)
    blocks: list[dict[str, Any]] = []
    for position, block in enumerate(document.blocks):
        if isinstance(block, str):
            block = _APPENDIX.sub(lambda heading: f"## {heading[1].upper()}", block)
            blocks.append(
                {
                    "kind": "text",
                    "html": Markup(
                        _LINK_TO_PAGE.sub(r'href="\1.html"', markdown.render(_harmless(block)))
                    ),
                }
            )
            continue
        shared = {
            "name": block.name,
            "number": numbers[position],
            "caption": Markup(markdown.renderInline(_harmless(block.caption))),
        }
        if isinstance(block, Table):
            blocks.append({"kind": "table", **shared, **_page_table(block)})
        else:
            alternative = {
                "image": _data_uri(_for_both_schemes(images[block.name]), "image/svg+xml"),
                "alt": _spoken(block.caption),
                "inches": f"{block.static.get_figwidth():.3g}",
            }
            interactive = Markup(block.interactive) if block.interactive else None
            blocks.append({"kind": "figure", **shared, **alternative, "json": interactive})
    explored = any(block.get("json") for block in blocks)
    environment = Environment(
        loader=PackageLoader("vehest.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template("page.html.j2").render(
        title=printable(document.title),
        blocks=blocks,
        open_blocks=_open_blocks(document),
        style=Markup(_packaged("page.css")),
        script=Markup(_packaged("page.js")),
        plots=Markup(_packaged("uplot.js") + _packaged("explorer.js")) if explored else "",
        plots_style=Markup(_packaged("uplot.css")) if explored else "",
        missing=MISSING,
    )


def _open_blocks(document: Document) -> int | None:
    """Number of blocks that the page shows before its appendices.

    Those of `Document.open_blocks`, else all up to the first appendix.
    """
    if document.open_blocks is not None:
        return document.open_blocks
    appendices = (
        position
        for position, block in enumerate(document.blocks)
        if isinstance(block, str) and block.startswith("## Appendix")
    )
    return next(appendices, None)


def without_formula(cell: Any) -> Any:
    """A cell that spreadsheets show as text: an apostrophe before what they would read as a
    formula.
    """
    return f"'{cell}" if isinstance(cell, str) and _FORMULA.match(cell) else cell


def _page_table(table: Table) -> dict[str, Any]:
    """Values of a table for the page's template: cells with bars, links to models, and the CSV as
    data.
    """
    headers, rows, numeric = formatted(table)
    csv = (
        table.frame.map(without_formula)
        .to_csv(index=False, lineterminator="\n")
        .encode("utf-8", "backslashreplace")
    )
    barred = {i: column.bar for i, column in enumerate(table.columns.values()) if column.bar}
    bars = {
        i: bars_of(*(table.frame[name].tolist() for name in names)) for i, names in barred.items()
    }
    cells = [
        [{"text": text, "bar": bars[i][k] if i in bars else None} for i, text in enumerate(row)]
        for k, row in enumerate(rows)
    ]
    return {
        "headers": headers,
        "rows": cells,
        "numeric": numeric,
        "links": list(table.links),
        "csv": _data_uri(csv, "text/csv"),
    }


def bars_of(
    values: Sequence[float], lows: Sequence[float], highs: Sequence[float]
) -> list[dict[str, Any] | None]:
    """Positions of values and of the ends of their intervals on one axis from zero, in per cent of
    its length; None where a value is missing.

    The axis ends at the highest, but at `MAX_AXIS_RATIO` times the median value where one lies far
    beyond; what is longer is ``cut``.

    Parameters
    ----------
    values, lows, highs : sequence of float
        Of one length; NaN for an end that is not known.

    Returns
    -------
    list
        ``value``, places ``at``, ``low`` and ``high`` [%], and ``cut``, of each; None for a missing
        one.
    """
    lows, highs = (
        [end if math.isfinite(end) else value for value, end in zip(values, ends, strict=True)]
        for ends in (lows, highs)
    )
    finite = sorted(value for value in values if math.isfinite(value))
    longest = max(
        (high for value, high in zip(values, highs, strict=True) if math.isfinite(value)),
        default=0.0,
    )
    if longest <= 0:
        return [None] * len(values)
    axis = min(longest, MAX_AXIS_RATIO * finite[len(finite) // 2] or longest)

    def place(value: float) -> float:
        return round(100 * min(max(value / axis, 0.0), 1.0), 1)

    return [
        {
            "value": value,
            "at": place(value),
            "low": place(low),
            "high": place(high),
            "cut": max(value, high) > axis * (1 + 1e-9),
        }
        if math.isfinite(value)
        else None
        for value, low, high in zip(values, lows, highs, strict=True)
    ]


def _packaged(name: str) -> str:
    """Text of a file of the page's templates."""
    from importlib.resources import files

    return (files("vehest.report") / "templates" / name).read_text(encoding="utf-8")


def _data_uri(content: bytes, media_type: str) -> str:
    """Content as a URI that contains it, base64."""
    return f"data:{media_type};base64,{base64.b64encode(content).decode()}"
