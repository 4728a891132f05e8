"""Numbers in the text of pages: those of the code and of the tables beside the pages."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest

from chdstat.inference import averages, noise_rankings
from chdstat.rendering import guiding

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


def words(page: Path) -> str:
    """Return the text of a page on one line."""
    return " ".join(page.read_text("utf-8").split())


_FEWEST, _MOST = (int(np.log2(n)) for n in (guiding._FEWEST, guiding._MOST))
_NULLS = round(10 * averages._LEAST, -3)
CONSTANTS = [
    ("README.md", f"only from {averages._LEAST} samples that are not null"),
    ("understand/normality.rst", f"needs {averages._LEAST} samples that"),
    ("understand/normality.rst", f"nulls need {_NULLS // 1000} 000 spp"),
    ("how-to/contrast-renders.rst", f"wrong by a factor of {noise_rankings.TIMING}"),
    ("how-to/contrast-renders.rst", f"{guiding._PATHS} paths for each pixel"),
    ("how-to/contrast-renders.rst", rf":sup:`{_FEWEST}` and at most 2\ :sup:`{_MOST}`"),
    ("how-to/contrast-renders.rst", f"fewer than {guiding.FEW} samples for each training path"),
    ("how-to/contrast-renders.rst", f"less than {guiding.WORTH:.1f} of".replace("0.", ".")),
    ("understand/claims.rst", f"off by a factor of {noise_rankings.TIMING}"),
    (
        "how-to/replace-reference-images.rst",
        "a path tracer in "
        f"{len((DOCS / 'how-to/render-tests/tiny_renderer.py').read_text().splitlines())} lines",
    ),
]


@pytest.mark.parametrize(("page", "said"), CONSTANTS)
def test_constants_are_those_of_the_code(page: str, said: str) -> None:
    assert said in words(ROOT / page if page == "README.md" else DOCS / page)


def test_guided_renders_of_the_page_are_large_enough() -> None:
    """The sample counts from which ``auto`` tries guiding follow from the size of the image."""
    said = words(DOCS / "how-to/contrast-renders.rst")
    found = re.findall(r"(\d+) spp in images of (\d+) x \d+", said)
    assert len(found) == 2
    for spp, edge in found:
        pixels = int(edge) ** 2
        paths = np.clip(guiding._PATHS * pixels, guiding._FEWEST, guiding._MOST)
        assert int(spp) * pixels == guiding.FEW * paths


def test_errors_of_statistical_denoising_are_those_of_its_table() -> None:
    with (DOCS / "understand/statistical_denoising.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file, skipinitialspace=True))
    columns = ("StatER: relMSE", "MSE", "OIDN", "default estimate")
    means = {
        (spp, name): np.exp(np.mean(np.log([float(row[name].split()[0]) for row in of_spp])))
        for spp in ("16", "64")
        for of_spp in [[row for row in rows if row["samples"] == spp]]
        for name in columns
    }
    relative, mse, denoised, ours = (
        [f"{means[spp, name]:.2f}" for spp in ("16", "64")] for name in columns
    )
    page = words(DOCS / "understand/statistical-denoising.rst")
    assert len({row["scene"] for row in rows}) == 8
    assert (
        f"its relMSE is {relative[0]} of StatMC's from 16 samples and {relative[1]} from 64, "
        f"its MSE {mse[0]} and {mse[1]}."
    ) in page
    from_16, from_64 = (f"{denoised[k]} and {ours[k]}" for k in (0, 1))
    assert f"those have {from_16} of StatMC's from 16 samples, {from_64} from 64." in page


def test_errors_of_the_estimate_are_those_of_its_table() -> None:
    with (DOCS / "understand/estimates.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file, skipinitialspace=True))
    first = {name: [float(row[name].split()[0]) for row in rows] for name in ("MSE", "relMSE")}
    mse, rel = (f"{np.exp(np.mean(np.log(first[name]))):.2f}" for name in first)
    evidence, page = (words(DOCS / "understand" / f"{n}.rst") for n in ("evidence", "pixel-value"))
    assert f"over the {len(rows)} rows are {mse} for MSE and {rel} for relMSE" in evidence
    assert f"its MSE is {mse} of that of Open Image Denoise and its relMSE {rel}" in page
    assert len({row["scene"] for row in rows}) == 10
    assert "Over ten scenes" in page
    lows = [float(re.search(r"\[(.*?),", row[n])[1]) for row in rows for n in first]
    assert "No row has its whole interval above 1.02" in evidence
    assert max(lows) <= 1.02
    from_it = np.array([row["from it"].split() for row in rows], float)
    both = np.exp(np.log(from_it).mean(axis=0))
    assert f"(geometric means {both[0]:.2f} and {both[1]:.2f})" in evidence
    held = np.array([float(x) for row in rows for x in [*row.values()][-1].split()])
    outside = np.count_nonzero((held < 0.85) | (held > 0.97))
    assert f"{outside} of the {held.size} coverages of 90 % intervals are outside" in evidence
