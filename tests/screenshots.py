"""Pictures of a report's page and of the site as they look in Chromium: `make screenshots`."""

import base64
import io
import sys
import tempfile
from pathlib import Path

from PIL import Image

from chromium import browser, opened

PIXEL_RATIOS = {1280: 1, 390: 2}  # width [px] -> pixels of the picture for one of the page
MARGIN = 16  # px above the first element
HEIGHTS = {1280: 1150, 390: 1500}
SCHEMES = ("light", "dark")
SITE = {"site": "docs/index.html", "site_estimator": "docs/estimators/ksnn.html"}


def picture(driver, top, width, path):
    """A part of the page that is open, from ``top`` down, at most to its end, in 256 colours."""
    y = max(top - MARGIN, 0)
    page_height = driver.execute_script("return document.documentElement.scrollHeight")
    clip = {
        "x": 0,
        "y": y,
        "width": width,
        "height": min(HEIGHTS[width], page_height - y),
        "scale": 1.0,
    }
    shot = driver.execute_cdp_cmd(
        "Page.captureScreenshot", {"captureBeyondViewport": True, "clip": clip}
    )["data"]
    with Image.open(io.BytesIO(base64.b64decode(shot))) as image:
        image.convert("RGB").quantize(
            256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
        ).save(path, optimize=True)


def main(report, site, out):
    """Write ``report_*`` (its beginning), ``traces_*`` (traces, course, filter) and ``site_*`` at
    both widths, light and dark.
    """
    out.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as profile, browser(Path(profile)) as driver:
        for width, pixel_ratio in PIXEL_RATIOS.items():
            for scheme in SCHEMES:
                look = {"width": width, "scheme": scheme, "pixel_ratio": pixel_ratio}
                opened(driver, report.resolve(), **look)
                for name, selector in {"report": "h1", "traces": "figure.live"}.items():
                    element = f"document.querySelector('{selector}')"
                    script = f"return {element}.getBoundingClientRect().top + scrollY"
                    picture(
                        driver,
                        driver.execute_script(script),
                        width,
                        out / f"{name}_{width}_{scheme}.png",
                    )
                for name, page in SITE.items():
                    opened(driver, (site / page).resolve(), **look)
                    picture(driver, 0, width, out / f"{name}_{width}_{scheme}.png")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
