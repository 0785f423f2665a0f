"""Headless Chromium for tests of pages: starting it, opening a page at a width and in a scheme,
what it and axe complain of.
"""

import shutil
from contextlib import contextmanager
from importlib.resources import files

import pytest

WIDTHS = (1280, 390)
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
)
FLAGS += ("--disable-component-update", "--disable-sync")
READY_SECONDS = 60.0


@contextmanager
def browser(profile):
    """A browser with a profile of its own, in an empty folder.

    The test is skipped where there is none.
    """
    webdriver = pytest.importorskip(
        "selenium.webdriver", reason="selenium is not installed: pip install 'vehest[dev]'"
    )
    from selenium.webdriver.chrome.service import Service

    chromium = shutil.which("chromium")
    driver = shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip(
            "no chromium with its chromedriver here: apt-get install chromium chromium-driver"
        )
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in (*FLAGS, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    started = webdriver.Chrome(options=options, service=Service(driver))
    try:
        yield started
    finally:
        started.quit()


def opened(driver, path, *, width=1280, scheme="light", pixel_ratio=1):
    """Open a page in a window so wide [px], a narrow one counts as a phone's, and wait until all
    that it draws by itself is drawn.
    """
    from selenium.webdriver.support.ui import WebDriverWait

    size = {"width": width, "height": 900, "deviceScaleFactor": pixel_ratio, "mobile": width < 600}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    driver.execute_cdp_cmd(
        "Emulation.setEmulatedMedia",
        {"features": [{"name": "prefers-color-scheme", "value": scheme}]},
    )
    driver.get_log("browser")
    driver.get(path.as_uri())
    drawn = (
        "return [...document.querySelectorAll('figure.live')].every(figure => figure.dataset.ready)"
    )
    WebDriverWait(driver, READY_SECONDS, 0.1).until(lambda page: page.execute_script(drawn))


def complaints(driver):
    """What the browser has written to its console since the page was opened."""
    return [f"{entry['level']}: {entry['message']}" for entry in driver.get_log("browser")]


def axe_violations(driver, within="html"):
    """What axe finds on the page that is open, or in a part of it, a line each: rule, and the first
    element.
    """
    pytest.importorskip(
        "axe_core_python", reason="axe-core-python is not installed: pip install 'vehest[dev]'"
    )
    driver.execute_script((files("axe_core_python") / "axe.min.js").read_text(encoding="utf-8"))
    result = driver.execute_async_script(
        "const done = arguments[arguments.length - 1]; axe.run(arguments[0]).then(done)", within
    )
    return [
        f"{violation['id']}: {violation['help']}, {violation['nodes'][0]['html'][:200]}"
        for violation in result["violations"]
    ]
