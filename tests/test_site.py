"""The documentation site: it builds without a warning, its links lead somewhere, and it reads well
in a browser.
"""

import subprocess
import sys
from pathlib import Path

import pytest
from check_site import broken_links

from chromium import WIDTHS, axe_violations, browser, complaints, opened

ROOT = Path(__file__).resolve().parents[1]
CHECKED_PAGES = (
    "docs/index.html",
    "docs/from_python.html",
    "docs/estimators.html",
    "docs/estimators/ksnn.html",
    "results/ferrari_drive/report.html",
    "results/scorecard.html",
    "results/scorecard/heavy_ekf.html",
)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip(
        "furo", reason="the site's tools are not installed: pip install 'vehest[docs]'"
    )
    folder = tmp_path_factory.mktemp("site")
    strict = [
        sys.executable,
        "-m",
        "sphinx",
        "-q",
        "-W",
        "--keep-going",
        "-b",
        "html",
        "-c",
        str(ROOT / "docs"),
    ]
    done = subprocess.run(
        [*strict, str(ROOT), str(folder)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def chromium(tmp_path_factory):
    with browser(tmp_path_factory.mktemp("profile")) as driver:
        yield driver


def test_links_to_no_file_no_anchor_or_out_of_the_site_are_detected(tmp_path):
    folder = tmp_path / "site"
    folder.mkdir()
    (tmp_path / "outside.html").write_text("", encoding="utf-8")
    (folder / "other.html").write_text('<h1 id="there">x</h1>', encoding="utf-8")
    links = (
        "other.html",
        "other.html#there",
        "#here",
        "https://example.org/x",
        "gone.html",
        "other.html#gone",
        "../outside.html",
        "#gone",
    )
    text = "".join(f'<a href="{link}">x</a>' for link in links)
    (folder / "index.html").write_text(
        f'<p id="here">{text}</p><img src="gone.png">', encoding="utf-8"
    )
    assert [line.split(": ")[1] for line in broken_links(folder)] == [*links[4:], "gone.png"]


@pytest.mark.page
def test_every_local_link_of_the_site_leads_somewhere(site):
    assert len(list(site.rglob("*.html"))) > 40
    assert broken_links(site) == []


@pytest.mark.page
def test_every_equation_of_the_pages_is_mathml(site):
    for source in sorted((ROOT / "docs").rglob("*.md")):
        equations = source.read_text(encoding="utf-8").count("```math\n")
        page = (site / source.relative_to(ROOT)).with_suffix(".html").read_text(encoding="utf-8")
        assert page.count("<math ") == equations, f"{source.name} has {equations} equations"
        assert "mathjax" not in page.lower()


@pytest.mark.page
@pytest.mark.parametrize(("width", "scheme"), zip(WIDTHS, ("light", "dark"), strict=True))
@pytest.mark.parametrize("name", CHECKED_PAGES)
def test_pages_are_accessible_and_fit_their_width(chromium, site, name, scheme, width):
    opened(chromium, site / name, width=width, scheme=scheme)
    assert axe_violations(chromium, "article") == []  # what stands around it is the theme's
    assert chromium.execute_script("return document.documentElement.scrollWidth") <= width
    assert complaints(chromium) == []
