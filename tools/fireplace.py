"""Say which paths make the distributions of the fireplace in the white room of Elek et al. (2019).

    CHDSTAT_SCENES=FOLDER python tools/fireplace.py

Renders places of "The White Room" by Jay-Artist (CC BY 3.0), ``white-room/scene_day_pbrt.xml``
in that folder, as it is and with one thing changed at a time (`CHANGES`). What is found goes to
``docs/understand/fireplace.npz``, from which a page of the documentation is drawn.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

import chdstat as chd

RESULTS = Path(__file__).parents[1] / "docs" / "understand" / "fireplace.npz"
SIZE, SPP = (704, 384), 4096
LIGHTS = ("window-middle", "window-left", "window-right", "room", "lamp")
"""Names that the lights get, which have none, in the order of the file."""
GROUPS = {"windows": "window-*", "room": "room", "lamp": "lamp"}
"""Lights that are told apart."""
IRON, HEARTH = "BlackRaughtIron", "BlackMarble"
PLACES = {
    "iron front": (183, 212),
    "back of the firebox": (185, 240),
    "side of the firebox": (193, 243),
    "grate": (190, 260),
    "hearth": (183, 275),
    "white surround": (160, 230),
}
"""The upper left pixel of three by three."""
EDGES = np.linspace(-6, 3, 181)
"""Of histograms: log10 of radiance, twenty bins a decade."""
FRONT, COARSE = (86, 105, 16, 33), (352, 192)
"""The iron front with the firebox, as crop of an image of this size."""

Edit = Callable[[ElementTree.Element], None]
Floats = npt.NDArray[np.float64]


# --- the scene, and one thing changed in it -------------------------------------------------------


def written(folder: Path, name: str, *edits: Edit) -> Path:
    """Write the scene with names for its lights, and with changes."""
    source = Path(os.environ["CHDSTAT_SCENES"], "white-room", "scene_day_pbrt.xml")
    root = ElementTree.parse(source).getroot()  # noqa: S314 - the user's own
    for string in root.iter("string"):
        if string.get("name") == "filename":
            string.set("value", str(source.parent / string.get("value", "")))
    lit = [shape for shape in root.iter("shape") if shape.find("emitter") is not None]
    for shape, light in zip(lit, LIGHTS, strict=True):
        shape.set("id", light)
    for edit in edits:
        edit(root)
    path = folder / f"{name.replace(' ', '-')}.xml"
    ElementTree.ElementTree(root).write(path)
    return path


def _remove(*lights: str) -> Edit:
    def edit(root: ElementTree.Element) -> None:
        for shape in root.findall("shape"):
            if shape.get("id") in lights:
                root.remove(shape)

    return edit


def _emitter(root: ElementTree.Element, light: str) -> ElementTree.Element:
    found = root.find(f"shape[@id='{light}']/emitter")
    assert found is not None
    return found


def _brighter(light: str, factor: float) -> Edit:
    def edit(root: ElementTree.Element) -> None:
        color = _emitter(root, light).find("rgb")
        assert color is not None
        values = color.get("value", "").split(",")
        color.set("value", ", ".join(str(factor * float(value)) for value in values))

    return edit


def _picked_by_power(root: ElementTree.Element) -> None:
    areas = (1.389, 1.08, 1.08, 5.9, 0.2827)  # square metres
    for light, area in zip(LIGHTS, areas, strict=True):
        emitter = _emitter(root, light)
        radiance = float(emitter.find("rgb").get("value").split(",")[1])  # type: ignore[union-attr]
        ElementTree.SubElement(emitter, "float", name="sampling_weight", value=str(radiance * area))


def _material(name: str, plugin: str) -> Edit:
    """Replace a material."""

    def edit(root: ElementTree.Element) -> None:
        for i, child in enumerate(root):
            if child.tag == "bsdf" and child.get("id") == name:
                root[i] = ElementTree.fromstring(plugin)  # noqa: S314
                root[i].set("id", name)

    return edit


def _diffuse(color: str) -> str:
    return (
        '<bsdf type="twosided"><bsdf type="diffuse">'
        f'<rgb name="reflectance" value="{color}"/></bsdf></bsdf>'
    )


def _all_black_but(*kept: str) -> Edit:
    def edit(root: ElementTree.Element) -> None:
        for name in [bsdf.get("id", "") for bsdf in root.findall("bsdf")]:
            if name not in kept:
                _material(name, _diffuse("0, 0, 0"))(root)

    return edit


def _without_blinds(root: ElementTree.Element) -> None:
    for shape in root.findall("shape"):
        reference = shape.find("ref")
        if reference is not None and reference.get("id") == "BlindMaterial":
            root.remove(shape)


_GREY_IRON = (
    '<bsdf type="twosided"><bsdf type="roughconductor"><float name="alpha" value="0.4"/>'
    '<string name="distribution" value="ggx"/>'
    '<rgb name="specularReflectance" value="0.1, 0.1, 0.1"/>'
    '<rgb name="eta" value="3.3, 3.3, 3.3"/><rgb name="k" value="2.6, 2.6, 2.6"/></bsdf></bsdf>'
)
CHANGES: Mapping[str, tuple[Edit, ...]] = {
    "nothing, another seed": (),
    "no lamp": (_remove("lamp"),),
    "no light from the room": (_remove("room"),),
    "windows alone": (_remove("lamp", "room"),),
    "lamp and room alone": (_remove("window-left", "window-middle", "window-right"),),
    "lamp 100 times as bright": (_brighter("lamp", 100),),
    "lights picked by power": (_picked_by_power,),
    "no blinds": (_without_blinds,),
    "hearth black": (_material(HEARTH, _diffuse("0, 0, 0")),),
    "iron matt": (_material(IRON, _diffuse("0.06, 0.045, 0.04")),),
    "iron grey": (_material(IRON, _GREY_IRON),),
    "all but the iron black": (_all_black_but(IRON),),
    "direct light alone": (),
}


# --- samples and what they tell -------------------------------------------------------------------


def _drawn(scene: object, place: tuple[int, int], **options: object) -> chd.Samples:
    asked = {"spp": SPP, "size": SIZE, "crop": (*place, 3, 3), "backend": "llvm", "seed": 1}
    return chd.render(scene, progress=False, **{**asked, **options})  # type: ignore[arg-type]


def _luminance(samples: chd.Samples) -> Floats:
    weights = np.array([0.2126, 0.7152, 0.0722])
    return np.einsum("yxcs,c->yxs", samples.read().astype(np.float64), weights)


def kinds(
    scene: object, place: tuple[int, int], **options: object
) -> tuple[chd.Samples, Floats, list[str]]:
    """Return samples, parts of their luminance by light and length of path, and the parts' names.

    Renders of one seed draw the same paths, so that differences are light of longer paths.
    """
    by_length = []
    for depth in (2, 3, None):
        samples = _drawn(scene, place, max_depth=depth, by_light=[*GROUPS.values()], **options)
        by_length.append([_luminance(part) for part in samples.lights.values()])
    parts = np.diff(np.array(by_length), axis=0, prepend=0)
    lengths = ("direct", "one bounce", "more bounces")
    names = [f"{light}, {length}" for length in lengths for light in GROUPS]
    return samples, parts.reshape(-1, *parts.shape[2:]), names


def _spread(log: Floats) -> tuple[float, float]:
    """Return the median of logarithms, and half of the range that holds the middle two thirds."""
    if not log.size:
        return np.nan, np.nan
    low, middle, high = np.quantile(log, (1 / 6, 1 / 2, 5 / 6))
    return float(middle), float((high - low) / 2)


def _log(light: Floats) -> Floats:
    return np.log10(light[light > 0])


def _counted(light: Floats) -> Floats:
    """Return the share of the samples in each bin of the log histogram."""
    return np.histogram(_log(light), EDGES)[0] / light.size


def of_place(
    scene: object, place: tuple[int, int], **options: object
) -> tuple[dict[str, Floats], dict[str, object]]:
    """Return the histograms of a place, by channel and kind, and its numbers."""
    samples, parts, names = kinds(scene, place, **options)
    total = _luminance(samples)
    largest = np.where(total > 0, parts.argmax(axis=0), -1)
    rows = {}
    for i, name in enumerate(names):
        log = np.log10(total[largest == i])
        middle, width = _spread(log)
        rows[name] = {
            "samples": float((largest == i).mean()),
            "light": float(parts[i].sum() / total.sum()),
            "at": middle,
            "width": width,
        }
    radiance = samples.read().astype(np.float64)
    held = {
        "rgb": np.array([_counted(radiance[:, :, channel]) for channel in range(3)]),
        "kinds": np.array(
            [_counted(np.where(largest == i, total, 0.0)) for i in range(len(names))]
        ),
    }
    about = {
        "nulls": float((total <= 0).mean()),
        "mean": radiance.mean(axis=(0, 1, 3)).tolist(),
        "medians": [_spread(_log(radiance[:, :, c]))[0] for c in range(3)],
        "kinds": rows,
        "modes": chd.modality(total).modes.ravel().tolist(),
    }
    return held, about


def _fullest(light: Floats) -> float:
    """Return the largest share of the positive samples of a pixel in a tenth of a decade."""
    return float(
        np.median(
            [
                np.max(np.searchsorted(log, log + 0.1) - np.arange(log.size)) / log.size
                for log in (np.sort(_log(pixel)) for pixel in light.reshape(-1, light.shape[-1]))
                if log.size
            ]
        )
    )


def changed(folder: Path, place: tuple[int, int]) -> tuple[dict[str, Floats], dict[str, object]]:
    """Return histograms and numbers of a place with one thing changed at a time."""
    base = _drawn(written(folder, "as it is"), place)
    held, rows = {"as it is": _counted(_luminance(base))}, {}
    for name, edits in CHANGES.items():
        scene = written(folder, name, *edits)
        depth = 2 if name == "direct light alone" else None
        samples = _drawn(scene, place, seed=2, max_depth=depth)
        light = _luminance(samples)
        difference = chd.difference(base, samples)
        held[name] = _counted(light)
        rows[name] = {
            "distance": float(np.median(difference.distance)),
            "nulls": float((light <= 0).mean()),
            "mean": float(light.mean()),
            "fullest": _fullest(light),
            "modes": float(chd.modality(light).modes.mean()),
        }
        sys.stdout.write(f"{name}: {rows[name]}\n")
    return held, rows


def multimodal(scene: object, **options: object) -> tuple[float, float, float]:
    """Return the share of the pixels with several modes and its standard error by blocks of 4."""
    asked = {"spp": 1024, "backend": "llvm", "seed": 3}
    samples = chd.render(scene, progress=False, **{**asked, **options})  # type: ignore[arg-type]
    several = chd.modality(_luminance(samples)).modes
    blocks = [
        (several[y : y + 4, x : x + 4] > 1).mean()
        for y in range(0, several.shape[0], 4)
        for x in range(0, several.shape[1], 4)
    ]
    error = np.std(blocks, ddof=1) / np.sqrt(len(blocks))
    return float((several > 1).mean()), float(error), float((several > 2).mean())


def main() -> None:
    """Measure all places and changes, and write the results."""
    held: dict[str, npt.NDArray[np.float32]] = {}
    about: dict[str, object] = {"spp": SPP, "size": SIZE, "places": {}, "changes": {}}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        scene = written(folder, "as it is")
        for name, place in PLACES.items():
            found, about["places"][name] = of_place(scene, place)
            held |= {f"{name}/{key}": array.astype(np.float32) for key, array in found.items()}
            sys.stdout.write(f"{name}: {json.dumps(about['places'][name], indent=1)}\n")
        for name in ("iron front", "side of the firebox"):
            found, about["changes"][name] = changed(folder, PLACES[name])
            held |= {f"{name}/{key}": array.astype(np.float32) for key, array in found.items()}
        about["front"] = multimodal(scene, size=COARSE, crop=FRONT)
        about["image"] = multimodal(scene, size=(88, 48))
    np.savez_compressed(RESULTS, edges=EDGES, about=json.dumps(about), **held)


if __name__ == "__main__":
    main()
