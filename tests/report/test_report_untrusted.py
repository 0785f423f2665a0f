"""Names and titles from files in a report: they are shown as text, whatever they hold."""

import re

import pandas as pd
import pytest
from markdown_it import MarkdownIt
from test_report import Page

from vehest.report.document import Column, Document, Table, as_code, as_text, write_document

HOSTILE = (
    "<script>alert(1)</script>",
    "<img src=x onerror=alert(1)>",
    "[x](javascript:alert(1))",
    "![x](http://evil.example/x.png)",
    "a | b | c",
    "first\n\n# second\n<b>",
    "`</code><script>`",
    "<javascript:alert(1)>",
    "&lt;script&gt;",
    r"\<script>\[x](y)",
    "**bold** _slanted_ ~~gone~~",
    "a\u202eb\x1b[31m\x9b",
    "</title></style><script>x</script>",
)


def _document(name):
    table = Table(
        "names",
        f"Of {name}.",
        pd.DataFrame({"n": [name], "x": [1.0]}),
        {"n": Column(name), "x": Column("x")},
    )
    return Document(
        name, [f"The data are {name}.", f"Recording {as_text(name)}, {as_code(name)}.", table]
    )


def _rendered(folder):
    """The Markdown file as a lenient viewer shows it, and the page."""
    lenient = MarkdownIt("commonmark", {"html": True}).enable("table")
    lenient.validateLink = lambda url: True
    return lenient.render((folder / "report.md").read_text(encoding="utf-8")), (
        folder / "report.html"
    ).read_text(encoding="utf-8")


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_name_is_plain_text_in_both_forms_of_a_report(tmp_path, name):
    (tmp_path / "plain").mkdir()
    (tmp_path / "hostile").mkdir()
    write_document(_document("plain"), tmp_path / "plain")
    write_document(_document(name), tmp_path / "hostile")
    for calm, hostile in zip(
        _rendered(tmp_path / "plain"), _rendered(tmp_path / "hostile"), strict=True
    ):
        expected = Page(calm)
        page = Page(hostile)
        assert page.tags.count("script") == expected.tags.count("script")
        assert page.tags.count("img") == expected.tags.count("img") == 0
        assert page.tags.count("td") == expected.tags.count("td"), "a cell stays one cell"
        assert not any(key.startswith("on") for key, _ in page.attributes)
        assert not any(
            key in ("href", "src") and re.match(r"\s*javascript:", value or "", re.I)
            for key, value in page.attributes
        )
    lenient = MarkdownIt("commonmark", {"html": True})
    line = (
        " ".join(name.split())
        .replace("\u202e", r"\u202e")
        .replace("\x1b", r"\x1b")
        .replace("\x9b", r"\x9b")
    )
    for form in (as_text, as_code):
        page = Page(lenient.render(f"Name: {form(name)}"))
        assert page.text.strip() == f"Name: {line}"
        assert set(page.tags) <= {"p", "code"}


def test_honest_markdown_stays_as_it_is(tmp_path):
    text = (
        "**Bold** with `code <b>`, a [link](tables/names.csv), <https://example.org>, |ω| < 3 "
        "rad/s and [deg]."
    )
    write_document(Document("Honest", [text]), tmp_path)
    assert text in (tmp_path / "report.md").read_text(encoding="utf-8")
    assert as_text("KS-NN (Revs) sim_quickstart, 20 Hz") == "KS-NN (Revs) sim_quickstart, 20 Hz"
    assert (
        as_code("vehest run pipelines/quickstart.yaml") == "`vehest run pipelines/quickstart.yaml`"
    )
