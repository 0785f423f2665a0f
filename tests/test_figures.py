"""Every number that README.md and the pages in docs/ state as a result is the one in results/, or
the one that a test asserts.

docs/figures.csv lists them, a row a statement:

- ``page``, ``stated``: the page, and the shortest text on it that holds the number or numbers and
  occurs once;
- ``source``: a CSV, JSON, Markdown or text file, a test, or ``not a result``;
- ``rows``: of a table the rows, as `pandas.DataFrame.query` takes them (empty: all); of a test or
  module the name of the function, class or constant (a share of 0.05 in it agrees with 5 % on a
  page); of prose in Markdown or text (``column`` empty) a phrase of it; for ``not a result`` the
  reason;
- ``column``: column or expression of columns (`pandas.DataFrame.eval`), several separated by ``;``;
  of a test that compares the page itself ``reads the page``;
- ``statistic``: min, max, median, mean, sum or count over these rows, several separated by ``;``;
  empty for a single row.

A number agrees if it is the value of the source rounded to the digits that the page prints.
"""

import ast
import csv
import json
import re
import sys
from decimal import Decimal
from functools import cache
from pathlib import Path

import pandas as pd
import pytest
from pandas.api.types import is_numeric_dtype

ROOT = Path(__file__).resolve().parents[1]
LIST = "docs/figures.csv"
COLUMNS = ("page", "stated", "source", "rows", "column", "statistic")
NOT_A_RESULT = "not a result"
READS_THE_PAGE = "reads the page"
PAGES_NOT_LISTED = (
    "docs/alignment.md",
    "docs/architecture.md",
    "docs/bus.md",
    "docs/channels.md",
    "docs/cnn_ukf.md",
    "docs/data.md",
    "docs/estimators/learned_ukf.md",
    "docs/estimators/networks_and_ukf.md",
    "docs/estimators/self_calibrating.md",
    "docs/learned_ukf.md",
)
"""Pages of which numbers may be missing in the list; this tuple may only shrink."""

NUMBER = re.compile(r"(?<![\w.,])(?<!= )[-−]?\d[\d,]*(?:\.\d+)?(?:e[-−+]?\d+)?(?![\w])")
UNITS = "%|s|ms|µs|ns|MB|GB|kB|bytes|minutes|min|hours|h|times"
FIGURE = re.compile(
    rf"(?<![\w./:-])\d[\d,]*(?:\.\d+(?:e[-−]?\d+)?(?![.\d/]*\w)|e[-−]?\d+|(?= (?:{UNITS})(?!\w)))"
)
"""A number that has to be in the list: with a decimal point, an exponent or a unit of `UNITS`."""
MASKED = (
    r"<!-- made by docs/make_\w+\.py.*?<!-- end -->",  # tests/test_docs.py compares these
    r"^[ \t]*(`{3,})[^`\n]*\n.*?^[ \t]*\1[ \t]*$",
    r"`[^`]*`",
    r"(?<=\])\([^)]*\)",
    r"\[(?:10\.\d{4,}/|arXiv )[^\]]*\]",
    r"\b9[05] % (?:intervals?|bands?)\b",
    r"<!--.*?-->",
)


def listed():
    with (ROOT / LIST).open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def places_of(stated, text):
    """Where a statement stands on a page, however its lines are broken."""
    words = r"\s+".join(re.escape(word) for word in stated.split())
    return [match.span() for match in re.finditer(rf"(?<!\w){words}(?!\w)", text)]


def numbers_in(text):
    return [Decimal(match[0].replace(",", "").replace("−", "-")) for match in NUMBER.finditer(text)]


def unlisted_figures(text, statements):
    """Numbers on a page that look like results and are in none of its statements, each with words
    around it.
    """
    masked = text
    for pattern in MASKED:
        masked = re.sub(pattern, lambda m: "·" * len(m[0]), masked, flags=re.MULTILINE | re.DOTALL)
    spans = [span for stated in statements for span in places_of(stated, text)]
    return [
        " ".join(text[max(0, figure.start() - 40) : figure.end() + 30].split())
        for figure in FIGURE.finditer(masked)
        if not any(start <= figure.start() and figure.end() <= end for start, end in spans)
    ]


def agrees(stated, value):
    """Whether a printed number is a value, rounded to its digits."""
    half = Decimal(5).scaleb(stated.as_tuple().exponent - 1)
    difference = abs(float(value) - float(stated))  # not a number agrees with nothing
    return difference <= float(half) * (1 + 1e-9)


def numeric(frame):
    """The frame with numbers where every cell of a column is one, or a dash."""
    for name in frame:
        cells = frame[name].astype(str).str.replace("−", "-").replace({"–": "nan", "": "nan"})
        try:
            frame[name] = pd.to_numeric(cells)
        except ValueError:
            continue
    return frame


@cache
def tables_of(source):
    """The tables of a file."""
    file = ROOT / source
    text = file.read_text(encoding="utf-8")
    if file.suffix == ".csv":
        return [pd.read_csv(file)]
    if file.suffix == ".json":
        content = json.loads(text)
        lists = [value for value in content.values() if isinstance(value, list)]
        return [pd.json_normalize(table, sep="_") for table in (content, *lists)]
    tables = []
    for block in re.findall(r"(?:^\|.*\|$\n?)+", text, re.MULTILINE):
        rows = [
            [cell.strip() for cell in line.strip("| \n").split(" | ")]
            for line in block.splitlines()
        ]
        tables.append(numeric(pd.DataFrame(rows[2:], columns=rows[0])))
    return tables


def column_of(frame, expression):
    return frame[expression] if expression in frame else frame.eval(expression, engine="python")


def values_of_table(source, rows, columns, statistics):
    """Numbers of the first table of a file that has the rows and columns."""
    reasons = []
    for frame in tables_of(source):
        try:
            chosen = frame.query(rows, engine="python") if rows else frame
            cells = [column_of(chosen, column.strip()) for column in columns.split(";")]
        except (
            KeyError,
            AttributeError,
            TypeError,
            SyntaxError,
            pd.errors.UndefinedVariableError,
        ) as error:
            reasons.append(str(error))
            continue
        if statistics:
            return [
                value.agg(statistic.strip())
                for value in cells
                for statistic in statistics.split(";")
            ]
        if len(chosen) != 1:
            reasons.append(f"{len(chosen)} rows instead of one")
            continue
        return [
            number
            for value in cells
            for number in (
                [value.iloc[0]] if is_numeric_dtype(value) else numbers_in(str(value.iloc[0]))
            )
        ]
    raise LookupError("; ".join(dict.fromkeys(reasons)) or "no table")


def node_of(source, name):
    """The text of a function, or of the assignment of a constant, and the numbers in it."""
    text = (ROOT / source).read_text(encoding="utf-8")
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names = [node.name]
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [target.id for target in targets if isinstance(target, ast.Name)]
        else:
            continue
        if name in names:
            constants = (part.value for part in ast.walk(node) if isinstance(part, ast.Constant))
            numbers = [
                Decimal(repr(value))
                for value in constants
                if isinstance(value, int | float) and not isinstance(value, bool)
            ]
            return ast.get_source_segment(text, node), numbers
    raise LookupError(f"nothing is called '{name}' there")


def disagreement(row):
    """What is wrong with a statement, in words; empty if it is right."""
    page, stated, source, rows = (row[name] for name in COLUMNS[:4])
    text = (ROOT / page).read_text(encoding="utf-8")
    n_places = len(places_of(stated, text))
    if n_places != 1:
        advice = "take words around it into" if n_places else "adapt or delete"
        return f"{page} states '{stated}' {n_places} times; {advice} its row in {LIST}"
    numbers = numbers_in(stated)
    if source == NOT_A_RESULT:
        return "" if rows else f"{LIST}: '{stated}' of {page} needs a reason in the column 'rows'"
    try:
        if source.endswith(".py"):
            code, asserted = node_of(source, rows)
            reads = row["column"] == READS_THE_PAGE and Path(page).name in code
            if "%" in stated:
                asserted = [*asserted, *(100 * number for number in asserted)]
            values = numbers if reads or set(numbers) <= set(asserted) else asserted
        elif row["column"]:
            values = values_of_table(source, rows, row["column"], row["statistic"])
        else:
            phrases = places_of(rows, (ROOT / source).read_text(encoding="utf-8"))
            values = numbers_in(rows) if phrases else []
    except (OSError, LookupError) as error:
        return f"{page} states '{stated}', for which {LIST} names {source}, {rows}: {error}"
    if len(numbers) == len(values) and all(map(agrees, numbers, values)):
        return ""
    figures = ", ".join(f"{value:.6g}" for value in map(float, values)) or "nothing of the kind"
    return f"{page} states '{stated}'; {source} has {figures} ({rows}, {row['column']})"


def pages():
    files = [
        ROOT / "README.md",
        *(ROOT / "docs").glob("*.md"),
        *(ROOT / "docs/estimators").glob("*.md"),
    ]
    return sorted(file.relative_to(ROOT).as_posix() for file in files)


@pytest.mark.parametrize("page", pages())
def test_figures_of_a_page_are_those_of_its_sources(page):
    faults = [disagreement(row) for row in listed() if row["page"] == page]
    if any(faults):
        pytest.fail("\n".join(filter(None, faults)), pytrace=False)


@pytest.mark.parametrize("page", pages())
def test_figures_of_a_page_are_listed(page):
    statements = [row["stated"] for row in listed() if row["page"] == page]
    missing = unlisted_figures((ROOT / page).read_text(encoding="utf-8"), statements)
    if missing and page not in PAGES_NOT_LISTED:
        advice = (
            f"{LIST} lacks these numbers of {page}; add rows with their sources, or delete them"
        )
        pytest.fail("\n  … ".join([advice, *missing]), pytrace=False)
    assert missing or page not in PAGES_NOT_LISTED, "complete: take it out of PAGES_NOT_LISTED"


def test_every_row_is_of_a_page():
    assert not {row["page"] for row in listed()} - set(pages())
    assert not set(PAGES_NOT_LISTED) - set(pages())


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A checkout with a page, a table and a test."""
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    tables_of.cache_clear()
    (tmp_path / "page.md").write_text("It errs by 0.42° [0.36,\n0.50], C by 1e-9 m/s at most.\n")
    (tmp_path / "a.csv").write_text("car,error,low,high\nx,0.4203,0.357,0.4948\ny,1.2,1,2\n")
    (tmp_path / "test_c.py").write_text("def test_c():\n    assert difference < 1e-9\n")
    yield tmp_path
    tables_of.cache_clear()


def row_of(stated, source="a.csv", rows="car == 'x'", column="error; low; high", statistic=""):
    return dict(zip(COLUMNS, ("page.md", stated, source, rows, column, statistic), strict=True))


def test_a_wrong_number_is_named_with_that_of_its_source(folder):
    row = row_of("0.42° [0.36, 0.50]")
    assert disagreement(row).startswith(
        "page.md states '0.42° [0.36, 0.50]'; a.csv has 0.4203, 0.357, 0.4948"
    )
    (folder / "page.md").write_text("It errs by 0.42° [0.36, 0.49].\n")
    assert disagreement(row | {"stated": "0.42° [0.36, 0.49]"}) == ""
    assert "0 times" in disagreement(row)


def test_an_expression_and_statistics_over_rows_are_compared(folder):
    (folder / "page.md").write_text("0.61 to 1.18 times\n")
    row = row_of("0.61 to 1.18 times", rows="", column="error / low", statistic="min; max")
    assert "a.csv has 1.17731, 1.2 (" in disagreement(row)
    (folder / "page.md").write_text("1.18 to 1.20 times\n")
    assert disagreement(row | {"stated": "1.18 to 1.20 times"}) == ""


def test_a_stated_limit_must_be_asserted_by_its_test(folder):
    row = row_of("1e-9 m/s", "test_c.py", "test_c", "")
    assert disagreement(row) == ""
    (folder / "test_c.py").write_text("def test_c():\n    assert difference < 1e-6\n")
    assert "test_c.py has 1e-06" in disagreement(row)


def test_a_share_in_the_code_is_a_percentage_on_the_page(folder):
    (folder / "page.md").write_text("2 % of the samples\n")
    (folder / "faults.py").write_text("SPIKE_SHARE: float = 0.02\n")
    row = row_of("2 % of the samples", "faults.py", "SPIKE_SHARE", "")
    assert disagreement(row) == ""
    (folder / "faults.py").write_text("SPIKE_SHARE: float = 0.03\n")
    assert "faults.py has 0.03" in disagreement(row)


def test_numbers_that_are_not_listed_are_named():
    text = (
        "RMSE 0.42°, P = 2, `0.5 s`, [10.1109/x.1](https://a.b/1.5), version 1.2.3; 90 % of 3 cars"
    )
    assert len(unlisted_figures(text, [])) == 2
    (missing,) = unlisted_figures(text, ["RMSE 0.42°"])
    assert missing.endswith("90 % of 3 cars")
