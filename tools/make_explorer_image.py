"""Photograph the explorer; write docs/_static/explorer.png.

    python tools/make_explorer_image.py [--browser /usr/bin/chromium]

Renders the built-in bathroom, 128 x 128 pixels at 256 spp, with all paths and with short ones, and
a reference, and opens their page in a headless Chromium, with two pixels and all figures in view.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

from playwright.sync_api import sync_playwright

import chdstat as chd

OUT = Path(__file__).parents[1] / "docs" / "_static" / "explorer.png"
SIDE = 128, 128
SIZE = {"width": 1600, "height": 1000}
VIEW = "?p=60,70&p=115,46&f=best&a=0"
PATIENCE = 120_000


def photograph(url: str, browser: str | None) -> None:
    """Write what the page at an address shows."""
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        page = chromium.new_page(viewport=SIZE)
        page.set_default_timeout(PATIENCE)
        page.goto(url + VIEW)
        page.wait_for_selector("body[data-shown]")
        page.wait_for_function("document.querySelector('#working').innerText === ''")
        page.wait_for_timeout(2000)
        page.screenshot(path=OUT)
        chromium.close()


def main() -> None:
    """Render, serve, photograph."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--browser", help="Chromium to use; playwright's own without.")
    arguments = parser.parse_args()
    with TemporaryDirectory() as folder:
        names = {"path": None, "path-depth-3": 3}
        stores = [
            chd.render(
                "bathroom", spp=256, size=SIDE, seed=i, max_depth=depth,
                out=Path(folder) / f"{name}.zarr",
            ).path
            for i, (name, depth) in enumerate(names.items())
        ]  # fmt: skip
        converged = chd.render("bathroom", spp=1024, size=SIDE, seed=9)
        mean = chd.summarize(converged)["mean"].to_numpy()
        image = chd.io.write_exr(Path(folder) / "reference.exr", mean)
        explorer = chd.explore([*stores, image], port=0, browser=False)
        try:
            photograph(explorer.url, arguments.browser)
        finally:
            explorer.stop()


if __name__ == "__main__":
    main()
