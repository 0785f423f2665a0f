"""The page of a report in headless Chromium: what it draws, what its filter says, how it reads with
dark and light, wide and narrow.
"""

import json
import math

import numpy as np
import pytest
from hour import hour_of_driving
from packed_columns import unpacked
from test_report import FAMILIES, drive, study

from chromium import WIDTHS, axe_violations, browser, complaints, opened
from vehest.data.splits import Span
from vehest.report.document import write_document
from vehest.studies.artefacts import StudyArtefacts
from vehest.studies.drive import comparison, leaderboard
from vehest.studies.own_car import documents

pytestmark = pytest.mark.page

SCHEMES = ("light", "dark")


@pytest.fixture(scope="module")
def chromium(tmp_path_factory):
    with browser(tmp_path_factory.mktemp("profile")) as driver:
        yield driver


@pytest.fixture(scope="module")
def toy(tmp_path_factory):
    """A comparison whose numbers are known, as a page."""
    folder = tmp_path_factory.mktemp("toy")
    artefacts = study(tmp_path_factory.mktemp("study"))
    document = comparison(artefacts)
    write_document(document, folder)
    return folder / "report.html", leaderboard(artefacts), document


@pytest.fixture(scope="module")
def hour(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hour")
    write_document(hour_of_driving(), folder)
    return folder / "report.html"


def board(driver):
    """What the filter's table says: estimator -> RMSE(β) [deg], RMSE(v) [m/s]."""
    script = (
        "return [...document.querySelectorAll('.explorer tbody tr')].map(row => "
        "[...row.cells].map(cell => cell.textContent))"
    )
    return {cells[1]: (float(cells[2]), float(cells[4])) for cells in driver.execute_script(script)}


def fill(driver, label, value):
    field = driver.find_element("css selector", f'.explorer input[aria-label="{label}"]')
    field.clear()
    field.send_keys(value)


def views(driver):
    """First and last time that each trace shows [s]."""
    plots = "document.querySelector('figure.live').explorer.plots"
    return driver.execute_script(
        f"return {plots}.map(plot => [plot.scales.x.min, plot.scales.x.max])"
    )


def open_appendices(driver):
    driver.execute_script(
        "document.querySelectorAll('details').forEach((section) => (section.open = true))"
    )


def press(driver, text):
    (button,) = [
        toggle
        for toggle in driver.find_elements("css selector", ".views button, .filters button")
        if toggle.text == text
    ]
    button.click()


def test_errors_over_filtered_rows_follow_the_signals(chromium, toy):
    path, ranked, _ = toy
    opened(chromium, path)
    fill(chromium, "speed from [m/s]", "30")
    fill(chromium, "|ay| from [m/s²]", "4")
    fill(chromium, "|ay| to [m/s²]", "10")
    recording = drive()
    time = recording.time
    vx = recording["vx"]
    vy_ref = recording["vy_ref"]
    ay = np.abs(recording["ay"])
    rows = (time >= 61.5 - 1e-9) & (time < 85.0 - 1e-9) & (vx >= 30) & (ay >= 4) & (ay <= 10)
    assert 20 < rows.sum() < 400
    vy = vy_ref + 0.15 * np.sin(
        3.0 * time + 1 + 0.1
    )  # the KS-NN of the seed that validation chooses
    error = np.degrees(np.arctan2(vy, vx) - np.arctan2(vy_ref, vx))[rows]
    assert board(chromium)["KS-NN linear + bias, P = 2"][0] == pytest.approx(
        math.sqrt(np.mean(error**2)), abs=1e-3
    )
    assert f"{rows.sum()} of" in chromium.find_element("css selector", ".said").text
    press(chromium, "all rows")
    figures = board(chromium)
    assert len(figures) == len(FAMILIES)
    for row in ranked.to_dict("records"):
        assert figures[row["title"]] == pytest.approx(
            (row["rmse_sideslip_chosen"], row["rmse_vy"]), abs=1e-3
        )


def test_browser_unpacks_the_packed_columns(chromium, toy):
    path, _, document = toy
    opened(chromium, path)
    (explorer,) = [
        block.interactive for block in document.blocks if getattr(block, "interactive", "")
    ]
    columns = unpacked(json.loads(explorer))
    for name in ("vx", "vy", "vy2", "x"):
        read = chromium.execute_script(
            f"return [...document.querySelector('figure.live').explorer.columns['{name}']]"
        )
        assert np.array(read, dtype=float) == pytest.approx(columns[name], abs=1e-12, nan_ok=True)


def test_all_traces_zoom_together_and_back(chromium, hour):
    opened(chromium, hour)
    assert len(views(chromium)) == 3 + 1 + 3  # v, β and its error; health; three channels
    for text, view in {
        "": (100.0, 120.0),
        "whole range": (0.0, 3599.95),
        "20 s of largest sideslip": (100.0, 120.0),
    }.items():
        if text:
            press(chromium, text)
        assert all(current == pytest.approx(view) for current in views(chromium))


def test_dragging_over_a_trace_zooms_all(chromium, hour):
    from selenium.webdriver import ActionChains

    opened(chromium, hour)
    press(chromium, "whole range")
    over = chromium.find_elements("css selector", ".u-over")[1]
    quarter = over.size["width"] // 4
    ActionChains(chromium).move_to_element_with_offset(
        over, -quarter, 0
    ).click_and_hold().move_by_offset(quarter, 0).release().perform()
    for start, stop in views(chromium):
        assert start == pytest.approx(900.0, abs=30.0)
        assert stop == pytest.approx(1800.0, abs=30.0)


def test_errors_can_be_taken_over_the_segment_in_view(chromium, hour):
    opened(chromium, hour)
    press(chromium, "20 s of largest sideslip")
    chromium.find_element("css selector", '.filters input[type="checkbox"]').click()
    assert chromium.find_element("css selector", ".said").text.startswith(
        "401 of 72000 samples, 20.1 s"
    )


def test_leaderboard_sorts_by_its_bars_and_prints_the_command(chromium, toy):
    path, ranked, _ = toy
    opened(chromium, path)
    open_appendices(chromium)
    header = chromium.find_element(
        "xpath", "//figure[@id='table-leaderboard_test']//th/button[contains(., 'interval')]"
    )
    header.click()
    header.click()
    rows = chromium.find_elements("css selector", "#table-leaderboard_test tbody tr")
    assert rows[0].text.startswith(ranked.iloc[-1]["title"])
    button = rows[0].find_element("css selector", "button.command")
    button.click()
    assert chromium.find_element(
        "css selector", "#table-leaderboard_test p.command code"
    ).text == button.get_attribute("data-command")
    assert button.get_attribute("data-command").startswith("vehest estimate ")
    assert rows[0].find_element("css selector", "a").get_dom_attribute("href").startswith("../../")


@pytest.mark.parametrize("scheme", SCHEMES)
def test_button_turns_the_page_to_the_other_scheme_with_its_figures(chromium, toy, scheme):
    opened(chromium, toy[0], scheme=scheme)

    def paper():
        return chromium.execute_script("return getComputedStyle(document.body).backgroundColor")

    grounds = {"light": "rgb(255, 255, 255)", "dark": "rgb(26, 26, 26)"}
    opposite = SCHEMES[scheme == "light"]
    assert paper() == grounds[scheme]
    chromium.find_element("id", "theme").click()
    assert paper() == grounds[opposite]
    image = chromium.find_element("css selector", "#figure-forest_test img")
    assert (
        image.value_of_css_property("color-scheme") == opposite
    )  # by which an SVG image picks its colours
    chromium.execute_script("localStorage.clear()")


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("scheme", SCHEMES)
def test_page_is_accessible_fits_its_width_and_complains_of_nothing(
    chromium, hour, toy, width, scheme
):
    for path in (hour, toy[0]):
        opened(chromium, path, width=width, scheme=scheme)
        open_appendices(chromium)
        assert axe_violations(chromium) == []
        assert chromium.execute_script("return document.documentElement.scrollWidth") <= width
        assert complaints(chromium) == []


CUT = """return [...document.querySelectorAll("main *")].filter(
  (own) => own.clientWidth > 0 && own.scrollWidth > own.clientWidth + 1 &&
    getComputedStyle(own).overflowX !== "visible"
).map((own) => own.ariaLabel ?? own.tagName)"""


def test_page_of_a_users_car_opens_with_verdict_forest_and_traces_the_rest_folded(
    chromium, tmp_path
):
    """Two test ranges: nothing is cut at 1280 px, folded or not, the page does not scroll sideways
    at 390, traces break between ranges.
    """
    tests = {"test": (Span("toy", "lap", 60.0, 72.0), Span("toy", "lap", 74.0, 85.0))}
    part = study(tmp_path / "study", tests)
    write_document(
        documents(
            StudyArtefacts(
                "toy", "A toy study", "", "vehest run toy", {"": ""}, {"": part}, [], [], []
            )
        )["report"],
        tmp_path,
    )
    opened(chromium, tmp_path / "report.html", width=390)
    assert chromium.execute_script("return document.documentElement.scrollWidth <= innerWidth")
    opened(chromium, tmp_path / "report.html", width=1280)
    text = chromium.execute_script("return document.querySelector('main').innerText")
    assert all(
        words in text
        for words in ("Verdict", "Recommended: KS-NN", "95 % interval", "vehest export")
    )
    assert "FVU" not in text
    assert len(text.split()) <= 1500
    assert chromium.execute_script(CUT) == []
    gaps = (
        "return document.querySelector('figure.live').explorer.plots[0].data.slice(1).map((line) "
        "=> line.includes(null))"
    )
    assert all(chromium.execute_script(gaps))
    first = "return document.querySelector('figure.live').explorer.detail.label"
    assert f"Recommended: {chromium.execute_script(first)}, expected" in text
    open_appendices(chromium)
    assert "FVU" in chromium.execute_script("return document.querySelector('main').innerText")
    assert chromium.execute_script(CUT) == []


LEGEND = "return [...document.querySelectorAll('.legend > span')].map((own) => own.textContent)"
SERIES = (
    "return document.querySelector('figure.live').explorer.plots[1].series.map((own) => own.label)"
)


def test_legend_names_the_lines_and_the_reference_lies_below_the_estimates(chromium, hour):
    opened(chromium, hour)
    drawn = [f"Estimator {i}" for i in range(1, 5)]
    assert chromium.execute_script(LEGEND) == ["reference", *drawn, "90 % band of Estimator 1"]
    labels = chromium.execute_script(SERIES)
    order = [label for label in labels if label in {"reference", *drawn}]
    assert order[0] == "reference"  # uPlot draws series in their order
    assert set(order[1:]) == set(drawn)
    chromium.find_element("css selector", 'input[aria-label="draw Estimator 2"]').click()
    assert "Estimator 2" not in chromium.execute_script(LEGEND)


DRAWN_TEXTS = """const done = arguments[arguments.length - 1];
const drawn = [];
const { fillText } = CanvasRenderingContext2D.prototype;
CanvasRenderingContext2D.prototype.fillText = function (text, left, bottom, ...rest) {
  drawn.push([text, bottom]);
  return fillText.call(this, text, left, bottom, ...rest);
};
document.querySelector("figure.live").explorer.plots[3].redraw();
requestAnimationFrame(() => {
  CanvasRenderingContext2D.prototype.fillText = fillText;
  done(drawn);
});"""


def test_strips_of_sensor_health_have_a_legend_and_the_estimators_names(chromium, hour):
    opened(chromium, hour)
    heads = [head.text for head in chromium.find_elements("css selector", ".panel .head")]
    (strip,) = [text for text in heads if text.startswith("sensor health")]
    words = ("valid", "degraded", "invalid")
    assert [strip.index(word) for word in words] == sorted(strip.index(word) for word in words)
    texts = chromium.execute_async_script(DRAWN_TEXTS)
    names = [text for text, _ in sorted(texts, key=lambda drawn: drawn[1])]
    assert names == [f"Estimator {i}" for i in range(1, 5)]  # from the top


def test_rule_below_the_contents_is_as_wide_as_the_page_and_none_is_above_the_verdict(
    chromium, toy
):
    opened(chromium, toy[0], width=1280)
    rules = chromium.execute_script(
        "return ['header', 'nav'].map((tag) => document.querySelector(tag).clientWidth)"
    )
    assert rules[0] == rules[1] > 1000
    verdict, contents = (
        chromium.execute_script(
            f"return getComputedStyle(document.querySelector('{selector}')).{side}"
        )
        for selector, side in (("h2", "borderTopWidth"), ("nav", "borderBottomWidth"))
    )
    assert (verdict, contents) == ("0px", "1px")


def test_appendices_are_a_folded_list_at_the_end(chromium, toy):
    opened(chromium, toy[0])
    after = (
        "return [...document.querySelectorAll('#appendices ~ *')].map((own) => [own.tagName, "
        "own.open])"
    )
    position = chromium.execute_script(after)
    assert len(position) >= 5
    assert all(section == ["DETAILS", False] for section in position)
    contents = [link.text for link in chromium.find_elements("css selector", "nav a")]
    assert contents == ["Verdict", "Minutes of reference", "Appendices"]
    last = "return document.querySelector('#appendices ~ details:last-of-type h2').textContent"
    assert chromium.execute_script(last) == "Note"


def test_a_figure_that_scrolls_on_a_phone_says_so(chromium, toy):
    opened(chromium, toy[0], width=390)
    places = chromium.execute_script(
        "return [...document.querySelectorAll('.static')].filter((place) => place.clientWidth)"
        ".map((place) => [place.scrollWidth > place.clientWidth,"
        " getComputedStyle(place, '::before').content.includes('scroll sideways')])"
    )
    assert {True, False} == {scrolls for scrolls, _ in places}
    assert all(scrolls == says_so for scrolls, says_so in places)


def test_forest_plot_is_beside_the_verdict_on_a_wide_screen(chromium, toy):
    opened(chromium, toy[0], width=1280)
    text, figure = chromium.execute_script(
        "return ['.text', '.text + figure'].map((selector) => {"
        " const box = document.querySelector(selector).getBoundingClientRect();"
        " return [box.left, box.right, box.top, box.bottom] })"
    )
    assert text[1] <= figure[0]
    assert text[2] < figure[3]
    assert figure[2] < text[3]


def test_page_shows_the_figure_where_scripts_may_not_run(chromium, toy):
    chromium.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
    try:
        chromium.get(toy[0].as_uri())
        assert chromium.find_element("css selector", "figure.live img.static").is_displayed()
    finally:
        chromium.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})
