"""Pages: what render tests show, as a picture and a page for each, and an index of all.

Pages need no other file and no network, so that they are useful among the artifacts of a CI run.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from scipy import ndimage

from chdstat._core.arrays import Array, Floats
from chdstat._core.display import colour, number, percent, png, with_interval
from chdstat._core.files import writing
from chdstat._core.image_scales import display_stops, tonemap
from chdstat.errors import StoreError
from chdstat.inference import Contrast
from chdstat.render_tests.session_summary import headline
from chdstat.render_tests.verdicts import PASSED, Outcome, RenderVerdict

_THUMBNAIL = 128
"""Longest edge of a thumbnail in pixels."""
_SURE = 4.0
"""Significance at the end of its scale, −log10 p, as in `chdstat.viz.contrast`."""
_PARTS = 6
"""Differences are averaged over at most this fraction of the shorter edge of the image."""
_STOPS = 9
"""Colours of a scale, between which a page interpolates."""
_UNSURE: Sequence[Outcome] = ("cannot tell", "too weak", "refused")


@dataclass(frozen=True)
class _Scale:
    """Colours of a layer, and what its ends and its middle mean."""

    colours: str
    low: str
    middle: str
    high: str
    note: str


@dataclass(frozen=True)
class _Layer:
    """An image of a page: its title, the image as a data URL, and its scale."""

    title: str
    image: str
    scale: _Scale | None = None


def thumbnails(found: Contrast) -> dict[str, str]:
    """Return small images of reference and render, PNG as text in base64, by name."""
    reference, render = _shown(found)
    step = -(-max(render.shape[:2]) // _THUMBNAIL)
    return {
        name: base64.b64encode(png(image[::step, ::step])).decode()
        for name, image in (("reference", reference), ("render", render))
    }


def write_page(verdict: RenderVerdict, found: Contrast, folder: Path, name: str) -> RenderVerdict:
    """Write the picture and the page of a test, and return its verdict with their file names.

    Raises
    ------
    StoreError
        If they cannot be written.
    """
    make_folder(folder)
    verdict = replace(verdict, picture=f"{name}.png", page=f"{name}.html")
    with writing(folder / verdict.picture) as partial:
        figure = replace(found, names=("render", "reference")).plot()
        figure.savefig(partial, format="png")
    height, width = found.maps["reason"].shape
    y, x, rows, columns = found.window
    place = {
        "left": x / width,
        "top": y / height,
        "width": columns / width,
        "height": rows / height,
    }
    window = {name: round(100 * share, 3) for name, share in place.items()}
    text = _template("test.html").render(
        css=_css(),
        verdict=verdict,
        kind=_kind(verdict),
        layers=_layers(found),
        window={**window, "shown": found.outcome == "differ"},
        middle=window["left"] + window["width"] / 2,
        height=height,
        width=width,
    )
    _write(folder / verdict.page, text)
    return verdict


def write_index(verdicts: Sequence[RenderVerdict], alpha: float, folder: Path) -> Path:
    """Write the page of all render tests of a session; those that fail come first.

    Raises
    ------
    StoreError
        If it cannot be written.
    """
    make_folder(folder)
    rows = [
        {"verdict": verdict, "kind": _kind(verdict), "losses": _losses(verdict)}
        for verdict in sorted(verdicts, key=lambda v: (v.outcome in PASSED, v.name))
    ]
    path = folder / "index.html"
    _write(
        path,
        _template("index.html").render(css=_css(), headline=headline(verdicts, alpha), rows=rows),
    )
    return path


def make_folder(folder: Path) -> None:
    """Make a folder, or say why that is not possible."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        message = f"cannot make the folder {folder}: {error.strerror or error}"
        raise StoreError(message) from error


def _write(path: Path, text: str) -> None:
    with writing(path) as partial:
        partial.write_text(text, encoding="utf-8")


@cache
def _template(name: str) -> jinja2.Template:
    loader = jinja2.PackageLoader("chdstat.render_tests", "templates")
    return jinja2.Environment(loader=loader, autoescape=True).get_template(name)


@cache
def _css() -> str:
    return Path(__file__).with_name("templates").joinpath("look.css").read_text("utf-8")


def _kind(verdict: RenderVerdict) -> str:
    """Return the class of a verdict in the style sheet."""
    if verdict.outcome in PASSED:
        return "good"
    return "unsure" if verdict.outcome in _UNSURE else "bad"


def _losses(verdict: RenderVerdict) -> str:
    found = [percent(loss) for loss in (verdict.image, verdict.tenth) if loss is not None]
    return " in the image, ".join(found) + " in a tenth" * (len(found) > 1)


# --- layers ---------------------------------------------------------------------------------------


def _shown(found: Contrast) -> tuple[Floats, Floats]:
    """Return reference and render for the screen, at one exposure."""
    channels = slice(1, None) if found.maps.sizes["channel"] == 4 else slice(0, 1)
    render, reference = (found.maps[f"mean_{k}"].to_numpy()[..., channels] for k in "ab")
    stops = display_stops(reference)
    one, other = (tonemap(np.nan_to_num(image), exposure=stops) for image in (reference, render))
    return one, other


def _layers(found: Contrast) -> list[_Layer]:
    """Return the images of a page, the reference first."""
    from chdstat.viz.styling import color_map

    reference, render = _shown(found)
    diverging = color_map(diverging=True)
    band = list(found.maps["channel"].values).index(found.window_channel)
    render_mean, reference_mean = (found.maps[f"mean_{k}"].to_numpy()[..., band] for k in "ab")
    edge = max(1, min(*found.window[2:], min(reference.shape[:2]) // _PARTS))
    with np.errstate(all="ignore"):
        significance = -np.log10(np.fmin.reduce(found.p_value.to_numpy(), axis=-1))
    size = f"squares of {edge} x {edge} pixels" if edge > 1 else "single pixels"
    notes = {
        1: "render minus reference over reference, in single pixels: mostly noise",
        edge: f"render minus reference over reference, in {size}",
    }
    layers = [_Layer("Reference", _url(reference)), _Layer("Render", _url(render))]
    for title, width in (("Difference", edge), ("Difference per pixel", 1)):
        values = _relative(render_mean, reference_mean, width)
        limit = _limit(values)
        scale = _Scale(
            _gradient(diverging), f"{percent(limit)} darker", "as the reference",
            f"{percent(limit)} brighter", notes[width],
        )  # fmt: skip
        layers.append(_Layer(title, _url(diverging(values / limit / 2 + 0.5)[..., :3]), scale))
    colours = color_map()
    scale = _Scale(
        _gradient(colours),
        "p = 1",
        "p = .01",
        "p ≤ .0001",
        "p-values of single pixels, all channels",
    )
    layers.append(_Layer("Significance", _url(colours(significance / _SURE)[..., :3]), scale))
    return layers


@np.errstate(all="ignore")
def _relative(render: Array, reference: Array, edge: int) -> Floats:
    """Return by how much squares of the render are brighter, over the reference."""
    known = np.isfinite(render) & np.isfinite(reference)
    one, other = (
        ndimage.uniform_filter(np.where(known, x, 0.0), edge, mode="constant")
        for x in (render, reference)
    )
    return np.where(known & (other > 0), (one - other) / other, np.nan)


def _limit(values: Floats) -> float:
    """Return the end of a scale: the 99th percentile of sizes."""
    finite = np.abs(values[np.isfinite(values)])
    return float(max(np.percentile(finite, 99), 1e-3)) if finite.size else 1.0


def _gradient(colours: Any) -> str:
    from matplotlib.colors import to_hex

    return ", ".join(to_hex(colours(x)) for x in np.linspace(0, 1, _STOPS))


def _url(values: Floats) -> str:
    image = values[..., 0] if values.ndim == 3 and values.shape[-1] == 1 else values
    return f"data:image/png;base64,{base64.b64encode(png(image)).decode()}"


def _gain(loss: float) -> float:
    """Return A / B - 1 for 1 - B / A; NaN if B is black."""
    return 1 / (1 - loss) - 1 if loss < 1 else np.nan


def numbers_of(verdict: RenderVerdict, found: Contrast) -> dict[str, str]:
    """Return the rows of the table of numbers, in words."""
    y, x, height, width = found.window
    loss = found.loss
    value, low, high = map(_gain, (loss.value, loss.low, loss.high))
    rows = {
        "test": verdict.test,
        "render": f"{found.spp_range[0]} samples per pixel",
        "reference": f"{found.spp_range[1]} samples per pixel",
        "looks": f"{verdict.looks}" + ", with other samples" * (verdict.looks > 1),
        "p-value of the image": number(found.image_p_value),
        "level": f"{number(verdict.alpha)}, this test's share of alpha",
        "render over reference": with_interval(value, low, high, partial(percent, sign=True)),
        "clearest window": f"{width} x {height} pixels at y {y}, x {x}",
        "its channel": colour(found.window_channel),
        "pixels that differ": percent(found.share),
    }
    if verdict.image is not None and verdict.tenth is not None:
        rows["smallest loss found"] = (
            f"{percent(verdict.image)} in the image, {percent(verdict.tenth)} in a tenth of it, "
            f"with a probability of {percent(0.9)}"
        )
    if found.cannot_show:
        rows["what the reference cannot show"] = " ".join(found.cannot_show)
    bad = [float(found.maps[f"bad_{name}"].mean()) for name in "ab"]
    if any(bad):
        rows["bad samples"] = f"{percent(bad[0])} of the render, {percent(bad[1])} of the reference"
    return rows
