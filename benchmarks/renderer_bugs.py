"""Faults that developers of renderers make: 97 changes of integrators, scenes, and samples.

Each is a row of `FAULTS`: its name, what it does, and how it is made. `Of an integrator` are those
of `benchmarks.faulty_path`. A change of a scene gives None if the scene has nothing to change. A
change of samples (y, x, channel, sample) is that of a renderer that does all else right.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from chdstat.scenes.builtin import built_in

INTEGRATOR = {
    "no cosine": "neither next event nor the BSDF's samples have the cosine",
    "no cosine at next event": "light that is sampled lacks the cosine of the surface",
    "cosine twice": "all smooth BSDFs have one more",
    "no cosine at the light": "light that is sampled lacks the cosine of the light",
    "uniform pdf": "directions by the cosine, divided by the pdf of uniform ones",
    "no 1/pi at next event": "BSDFs are pi times too large for sampled light",
    "no MIS weights": "both strategies count in full",
    "MIS by the wrong pdf": "weights take the other's density for that of uniform directions",
    "MIS of two heuristics": "balance for light, power for the BSDF: no sum of 1",
    "next event twice": "sampled light is counted twice",
    "no visibility": "sampled light shines through walls",
    "shadow rays start late": "at a fifth of the way, as by an epsilon too large",
    "shadow rays end early": "at four fifths of the way",
    "shadow acne": "3 of 100 shadow rays hit the surface that they leave",
    "roulette without weight": "survivors are not weighted, from the fifth bounce",
    "roulette weight squared": "survivors are weighted twice",
    "early roulette without weight": "survivors are not weighted, from the second bounce",
    "emission twice at the camera": "visible lights count twice",
    "lights invisible": "lights are not seen by the camera",
    "lights not divided by their probability": "sampled light lacks 1 / p of its choice",
    "lights as if equally likely": "1 / p is the number of lights, whatever their weights",
    "next event after the bounce": "sampled light has the throughput of the next segment",
    "throughput twice": "weights of bounces are squared",
    "same numbers at each bounce": "all bounces of a path have the first one's numbers",
    "random numbers of 6 bits": "directions and lights have 64 values in a dimension",
    "random numbers end at .99": "the last hundredth is never drawn",
    "no sine in the environment": "density of the map without its Jacobian",
    "geometric normals": "shading normals are ignored",
    "glossy lobe -10 %": "samples of rough lobes lose a tenth",
}
"""Faults of the path tracer of `benchmarks.faulty_path`."""
CAMERA = {
    "centre": "camera rays pass the centres of pixels",
    "tent": "a tent of 2 pixels filters the image, instead of a box",
    "lens": "points of the lens are too near its centre",
}
"""Faults of camera rays."""

TOGETHER = (
    (
        "MIS of two heuristics",
        "no cosine at next event",
        "depth 1 less",
        "no MIS weights",
        "next event twice",
        "no visibility",
        "emission twice at the camera",
        "lights not divided by their probability",
        "shadow rays end early",
        "depth 3 less",
    ),
    (
        "MIS by the wrong pdf",
        "no cosine at the light",
        "no 1/pi at next event",
        "shadow rays start late",
        "shadow acne",
        "lights invisible",
        "lights as if equally likely",
        "next event after the bounce",
        "no sine in the environment",
        "depth 2 less",
    ),
)
"""Faults that leave paths as they are: those of a group are rendered along the same paths."""

Description = dict[str, Any]
EDGE = 64
SCENES = (
    "bathroom",
    "caustic",
    "cornell-box",
    "courtyard",
    "fog",
    "gallery",
    "many-lights",
    "night-room",
)


@dataclass(frozen=True)
class Fault:
    """A fault of a renderer.

    Attributes
    ----------
    name, what
        A short name, and what the renderer does.
    kind
        What is changed: "integrator", "camera", "scene" or "samples".
    change
        Returns the changed scene, or None if it has nothing of the kind; or the changed samples,
        from samples and random numbers. None for the faults of the plugin.
    """

    name: str
    what: str
    kind: str
    change: Callable[..., Any] | None = None


# --- scenes -------------------------------------------------------------------------------------


def described(name: str, folder: Path) -> Description:
    """Return the description of a scene; that of the courtyard writes its sky into a folder."""
    return courtyard(folder) if name == "courtyard" else copy.deepcopy(dict(built_in(name)))


def sky() -> np.ndarray:
    """Return an environment map: a gradient, a cloud and a sun, shape (32, 64, 3)."""
    y, x = np.mgrid[:32, :64] / (32, 64)[0]
    light = np.stack([0.5 + 0.5 * y, 0.6 + 0.4 * y, 0.9 + 0.1 * y], axis=-1) * (1.2 - y)[..., None]
    light += 2 * np.exp(-((x - 0.5) ** 2 + (y - 0.35) ** 2) / 0.02)[..., None]
    light[8:10, 43:45] = (160, 140, 110)
    return light.astype(np.float32)


def write_sky(image: np.ndarray, path: Path) -> str:
    """Write an environment map, and return its path."""
    import mitsuba as mi

    path.parent.mkdir(parents=True, exist_ok=True)
    mi.Bitmap(np.ascontiguousarray(image, np.float32)).write(str(path))
    return str(path)


def courtyard(folder: Path) -> Description:
    """Return a yard under a sky with sun: an environment map, a thin lens, textures and glass."""
    import mitsuba as mi

    def rgb(*value):
        return {"type": "rgb", "value": list(value)}

    rng = np.random.default_rng(5)
    tiles = np.clip(0.45 + 0.25 * rng.standard_normal((12, 12, 1)) * (1.0, 0.9, 0.7), 0.05, 0.9)
    at = mi.ScalarTransform4f
    view = at().look_at(origin=[0, 1.6, 5], target=[0, 0.7, 0], up=[0, 1, 0])
    plane = at().rotate([1, 0, 0], -90).scale(6)
    wall = at().translate([0, 0, -2.5]).scale([4, 2, 1])
    lamp = at().translate([-2.2, 1.2, 0.5]).scale(0.15)
    bitmap = {"type": "bitmap", "data": tiles.astype(np.float32), "filter_type": "bilinear"}
    gold = {"type": "roughconductor", "material": "Au", "alpha": 0.15, "distribution": "ggx"}
    varnish = {
        "type": "roughplastic",
        "distribution": "ggx",
        "alpha": 0.1,
        "nonlinear": True,
        "diffuse_reflectance": rgb(0.5, 0.1, 0.1),
    }
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 8},
        "sensor": {
            "type": "thinlens",
            "fov": 45.0,
            "aperture_radius": 0.08,
            "focus_distance": 4.6,
            "to_world": np.array(view.matrix),
            "film": {"type": "hdrfilm", "rfilter": {"type": "box"}},
            "sampler": {"type": "independent"},
        },
        "sky": {"type": "envmap", "filename": write_sky(sky(), folder / "sky.exr")},
        "ground": {
            "type": "rectangle",
            "to_world": np.array(plane.matrix),
            "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": bitmap}},
        },
        "wall": {
            "type": "rectangle",
            "to_world": np.array(wall.matrix),
            "bsdf": {
                "type": "twosided",
                "bsdf": {"type": "diffuse", "reflectance": rgb(0.7, 0.65, 0.55)},
            },
        },
        "glass": _ball((-0.2, 0.5, 1.2), 0.5, {"type": "dielectric", "int_ior": 1.5}),
        "gold": _ball((1.2, 0.6, 0), 0.6, {"type": "twosided", "bsdf": gold}),
        "red": _ball((-1.4, 0.7, -0.8), 0.7, {"type": "twosided", "bsdf": varnish}),
        "lamp": {
            "type": "rectangle",
            "to_world": np.array(lamp.matrix),
            "emitter": {"type": "area", "radiance": rgb(60.0, 45.0, 25.0)},
        },
    }


def _ball(centre, radius, bsdf) -> Description:
    return {"type": "sphere", "center": list(centre), "radius": radius, "bsdf": bsdf}


def _parts(scene: Mapping[str, Any], *types: str) -> Iterator[Description]:
    """Yield the parts of a description, at any depth, that have one of some types."""
    for part in scene.values():
        if isinstance(part, dict):
            if part.get("type") in types:
                yield part
            yield from _parts(part, *types)


def _each(*types: str) -> Callable[[Callable[[Description], Any]], Callable[..., Any]]:
    """Return a decorator: a change of each part of some types; a part may refuse by False."""

    def made(change: Callable[[Description], Any]) -> Callable[..., Any]:
        def of(scene: Description, _folder: Path) -> Description | None:
            changed = [change(part) is not False for part in _parts(scene, *types)]
            return scene if any(changed) else None

        return of

    return made


def _set(*types: str, **values: Any) -> Callable[..., Any]:
    """Return a change that sets values of parts."""
    return _each(*types)(lambda part: part.update(values))


def _textures(change: Callable[[np.ndarray], np.ndarray]) -> Callable[..., Any]:
    """Return a change of the images of textures, not of lights."""

    def of(part: Description) -> Any:
        if part.get("raw"):
            return False
        part["data"] = np.ascontiguousarray(change(part["data"]), np.float32)
        return None

    return _each("bitmap")(of)


def _depth(more: int) -> Callable[..., Any]:
    def of(scene: Description, _folder: Path) -> Description:
        scene["integrator"]["max_depth"] += more
        return scene

    return of


def _lamps(scene: Description) -> list[Description]:
    """Return the shapes that are lights, in the order of the description."""
    return [p for p in scene.values() if isinstance(p, dict) and "emitter" in p]


def _without_last_light(scene: Description, _folder: Path) -> Description | None:
    if len(_lamps(scene)) + len(list(_parts(scene, "constant", "envmap"))) < 2:
        return None
    del _lamps(scene)[-1]["emitter"]
    return scene


def _last_light(factor: float) -> Callable[..., Any]:
    def of(scene: Description, _folder: Path) -> Description:
        radiance = _lamps(scene)[-1]["emitter"]["radiance"]
        key = "data" if "data" in radiance else "value"
        radiance[key] = (factor * np.asarray(radiance[key], np.float32)).tolist()
        if key == "data":
            radiance[key] = np.asarray(radiance[key], np.float32)
        return scene

    return of


def _flipped_light(scene: Description, _folder: Path) -> Description:
    shape = _lamps(scene)[0]
    if shape["type"] == "mesh":
        shape["faces"] = np.ascontiguousarray(np.asarray(shape["faces"])[:, ::-1])
    else:
        shape["flip_normals"] = not shape.get("flip_normals", False)
    return scene


def _objects(scene: Description) -> list[str]:
    return [
        name
        for name, p in scene.items()
        if isinstance(p, dict) and "bsdf" in p and "emitter" not in p and p.get("type") != "cube"
    ]


def _without_last_object(scene: Description, _folder: Path) -> Description:
    del scene[_objects(scene)[-1]]
    return scene


def _first_object_darker(scene: Description, _folder: Path) -> Description | None:
    """Take 5 % of the reflectance of the first object that has one of a single colour."""
    for name in _objects(scene):
        for part in _parts(scene[name], "rgb"):
            part["value"] = [0.95 * x for x in part["value"]]
            return scene
    return None


def _one_sided(scene: Description, _folder: Path) -> Description | None:
    """Turn one object inside out, with a material that is black from behind."""
    for name in reversed(_objects(scene)):
        shape = scene[name]
        if shape["bsdf"].get("type") != "twosided":
            continue
        shape["bsdf"] = next(p for p in shape["bsdf"].values() if isinstance(p, dict))
        if shape["type"] == "mesh":
            shape["faces"] = np.ascontiguousarray(np.asarray(shape["faces"])[:, ::-1])
        else:
            shape["flip_normals"] = not shape.get("flip_normals", False)
        return scene
    return None


def _half_pixel(scene: Description, _folder: Path) -> Description | None:
    if scene["sensor"]["type"] != "perspective":
        return None
    scene["sensor"]["principal_point_offset_x"] = 0.5 / EDGE
    return scene


def _wider(scene: Description, _folder: Path) -> Description:
    scene["sensor"]["fov"] *= 1.005
    return scene


def _environment(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[..., Any]:
    def of(scene: Description, folder: Path) -> Description | None:
        found = list(_parts(scene, "envmap"))
        for part in found:
            part["filename"] = write_sky(change(sky()), folder / f"sky-{name}.exr")
        return scene if found else None

    return of


@_each("roughplastic", "roughconductor", "roughdielectric")
def _squared(part: Description) -> None:
    part["alpha"] **= 2


@_each("roughplastic", "roughconductor", "roughdielectric")
def _root(part: Description) -> None:
    part["alpha"] **= 0.5


@_each("dielectric", "roughdielectric")
def _inverted(part: Description) -> None:
    part["int_ior"], part["ext_ior"] = part.get("ext_ior", 1.0), part["int_ior"]


@_each("hg")
def _backward(part: Description) -> None:
    part["g"] *= -1


def _density(factor: float) -> Callable[..., Any]:
    def of(part: Description) -> None:
        part["sigma_t"] *= factor

    return _each("homogeneous")(of)


@_each("bitmap")
def _other_filter(part: Description) -> Any:
    if part.get("raw"):
        return False
    part["filter_type"] = {"nearest": "bilinear", "bilinear": "nearest"}[part["filter_type"]]
    return None


# --- samples ------------------------------------------------------------------------------------

Samples = np.ndarray
Rng = np.random.Generator


def _times(factor: float, channel: int | slice = slice(None)) -> Callable[..., Any]:
    def of(x: Samples, _rng: Rng) -> Samples:
        x = x.copy()
        x[:, :, channel] *= np.float32(factor)
        return x

    return of


def _clamped(limit: float, *, of_mean: bool = False) -> Callable[..., Any]:
    def of(x: Samples, _rng: Rng) -> Samples:
        return np.minimum(x, np.float32(limit * (x.mean(dtype=float) if of_mean else 1)))

    return of


def _window(factor: float, share: float = 0.05) -> Callable[..., Any]:
    """Return a change of a square window in the middle of the right half."""

    def of(x: Samples, _rng: Rng) -> Samples:
        edge = round(np.sqrt(share) * EDGE)
        top, left = EDGE // 2 - edge // 2, 3 * EDGE // 4 - edge // 2
        x = x.copy()
        x[top : top + edge, left : left + edge] *= np.float32(factor)
        return x

    return of


def _nan_as_black(x: Samples, rng: Rng) -> Samples:
    lost = rng.random((*x.shape[:2], 1, x.shape[3])) < 0.01
    return np.where(lost, np.float32(0), x)


def _brightest_lost(x: Samples, _rng: Rng) -> Samples:
    """Leave out the brightest sample of each eight of a pixel, as a filter of fireflies does."""
    groups = x.reshape(*x.shape[:3], -1, 8)
    brightest = groups.sum(axis=2).argmax(axis=-1)[:, :, np.newaxis, :, np.newaxis]
    top = np.take_along_axis(groups, np.broadcast_to(brightest, (*groups.shape[:4], 1)), axis=-1)
    rest = (groups.sum(axis=-1, keepdims=True) - top) / 7
    out = np.where(np.arange(8) == brightest, rest, groups)
    return out.reshape(x.shape).astype(np.float32)


def _in_half(x: Samples, _rng: Rng) -> Samples:
    """Add up in half precision: what each sample adds to the sum."""
    total, out = np.zeros(x.shape[:3], np.float16), np.empty_like(x)
    for i in range(x.shape[3]):
        after = (total + x[..., i].astype(np.float16)).astype(np.float16)
        out[..., i] = after.astype(np.float32) - total.astype(np.float32)
        total = after
    return out


def _tile(source: tuple[int, int]) -> Callable[..., Any]:
    """Return a change: a tile of 16 x 16 pixels at (32, 16) is that at another place."""

    def of(x: Samples, _rng: Rng) -> Samples:
        y, left = source
        out = x.copy()
        out[32:48, 16:32] = x[y : y + 16, left : left + 16]
        return out

    return of


def _blurred(x: Samples, _rng: Rng) -> Samples:
    return ndimage.uniform_filter(x, (3, 3, 1, 1), mode="nearest")


def _blurred_quarter(x: Samples, rng: Rng) -> Samples:
    out = x.copy()
    out[:32, :32] = _blurred(x, rng)[:32, :32]
    return out


def _moved(x: Samples, _rng: Rng) -> Samples:
    return np.concatenate([x[:, :1], x[:, :-1]], axis=1)


def _swapped(x: Samples, _rng: Rng) -> Samples:
    return np.ascontiguousarray(x[:, :, ::-1])


def _black_level(x: Samples, _rng: Rng) -> Samples:
    return x + np.float32(0.01 * x.mean(dtype=float))


def _greyer(x: Samples, _rng: Rng) -> Samples:
    return 0.98 * x + np.float32(0.02) * x.mean(axis=2, keepdims=True)


def _display(x: Samples, _rng: Rng) -> Samples:
    return np.round(np.clip(x, 0, 1) * 255).astype(np.float32) / 255


def _srgb(x: Samples, _rng: Rng) -> Samples:
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0) ** (1 / 2.4) - 0.055)


def _row_black(x: Samples, _rng: Rng) -> Samples:
    x = x.copy()
    x[40] = 0
    return x


def _hot_pixel(x: Samples, _rng: Rng) -> Samples:
    x = x.copy()
    x[20, 20] = 5 * x[20, 20] + np.float32(x.mean(dtype=float))
    return x


def _repeated(x: Samples, _rng: Rng) -> Samples:
    """Repeat a quarter of the passes: of each eight, the last two are the first two."""
    out = x.copy()
    i = np.arange(x.shape[3])
    return out[..., np.where(i % 8 >= 6, i - 6, i)]


def _first_twice(x: Samples, _rng: Rng) -> Samples:
    """Divide by n - 1 instead of n, of passes of 48."""
    return x * np.float32(48 / 47)


def _vignette(x: Samples, _rng: Rng) -> Samples:
    """Darken to the corners, by up to 4 %."""
    y, u = (np.mgrid[:EDGE, :EDGE] + 0.5) / EDGE - 0.5
    return x * (1 - 0.08 * (y**2 + u**2)).astype(np.float32)[:, :, np.newaxis, np.newaxis]


# --- all ----------------------------------------------------------------------------------------

FAULTS: tuple[Fault, ...] = (
    *(Fault(name, what, "integrator") for name, what in INTEGRATOR.items()),
    *(Fault(name, what, "camera") for name, what in CAMERA.items()),
    *(
        Fault(name, what, "scene", change)
        for name, (what, change) in {
            "depth 1 less": ("paths end one segment early", _depth(-1)),
            "depth 2 less": ("paths end two segments early", _depth(-2)),
            "depth 3 less": ("paths end three segments early", _depth(-3)),
            "depth 1 more": ("paths end one segment late", _depth(1)),
            "light left out": ("the last light of the scene is lost", _without_last_light),
            "light 10 % dimmer": ("the last light of the scene loses a tenth", _last_light(0.9)),
            "light flipped": ("normals of the first light are flipped", _flipped_light),
            "object missing": ("the last object is lost", _without_last_object),
            "object darker": ("5 % less reflectance of the first one", _first_object_darker),
            "object inside out": ("flipped normals, black from behind", _one_sided),
            "half a pixel off": ("camera rays are half a pixel off", _half_pixel),
            "wider view": ("the field of view is half a per cent wide", _wider),
            "gamma twice": ("textures are decoded from sRGB twice", _textures(lambda t: t**2.2)),
            "gamma missing": (
                "textures are not decoded from sRGB",
                _textures(lambda t: t ** (1 / 2.2)),
            ),
            "texture upside down": ("v of textures is flipped", _textures(lambda t: t[::-1])),
            "texture a texel off": ("u is off", _textures(lambda t: np.roll(t, 1, axis=1))),
            "texture of 4 bits": ("quantised", _textures(lambda t: np.round(t * 15) / 15)),
            "texture filter": ("nearest and bilinear are swapped", _other_filter),
            "roughness squared twice": ("alpha is squared", _squared),
            "roughness not squared": ("alpha is its root", _root),
            "IOR inverted": ("glass has the inside outside", _inverted),
            "glass does not reflect": (
                "Fresnel reflection of glass is lost",
                _set("dielectric", specular_reflectance=0.0),
            ),
            "metals without Fresnel": (
                "metals reflect everything",
                _set("conductor", "roughconductor", material="none"),
            ),
            "plastic is linear": (
                "colours of inner reflections of plastic are lost",
                _set("roughplastic", nonlinear=False),
            ),
            "Beckmann for GGX": (
                "another distribution of facets",
                _set("roughplastic", "roughconductor", distribution="beckmann"),
            ),
            "phase function backward": ("g has the wrong sign", _backward),
            "phase function isotropic": ("g is ignored", _set("hg", g=0.0)),
            "medium 5 % denser": ("wrong transmittance", _density(1.05)),
            "medium 20 % thinner": ("wrong transmittance", _density(0.8)),
            "medium without absorption": ("albedo is 1", _set("homogeneous", albedo=1.0)),
            "environment rotated": (
                "by one of 64 columns",
                _environment("rotated", lambda s: np.roll(s, 1, axis=1)),
            ),
            "environment mirrored": (
                "left is right",
                _environment("mirrored", lambda s: s[:, ::-1]),
            ),
            "environment clipped": (
                "at 10, as by 8 bits",
                _environment("clipped", lambda s: np.minimum(s, 10)),
            ),
        }.items()
    ),
    *(
        Fault(name, what, "samples", change)
        for name, (what, change) in {
            "energy -.5 %": ("all is darker", _times(0.995)),
            "energy -1 %": ("all is darker", _times(0.99)),
            "energy +1 %": ("all is brighter", _times(1.01)),
            "energy -2 %": ("all is darker", _times(0.98)),
            "energy +2 %": ("all is brighter", _times(1.02)),
            "energy -5 %": ("all is darker", _times(0.95)),
            "green -1 %": ("one channel is darker", _times(0.99, 1)),
            "blue +2 %": ("one channel is brighter", _times(1.02, 2)),
            "channels swapped": ("red is blue", _swapped),
            "clamped at 10": ("samples are at most 10", _clamped(10)),
            "clamped at 10 means": ("at most 10 times the mean", _clamped(10, of_mean=True)),
            "clamped at 100 means": ("at most 100 times the mean", _clamped(100, of_mean=True)),
            "brightest left out": ("of each 8 samples", _brightest_lost),
            "NaN is black": ("of each 100 samples, one becomes black", _nan_as_black),
            "half precision": ("samples are added up in half precision", _in_half),
            "tile shifted": ("16 x 16 pixels, by one pixel", _tile((32, 17))),
            "tile duplicated": ("16 x 16 pixels, those beside them", _tile((32, 32))),
            "window -2 %": ("a twentieth of the image is darker", _window(0.98)),
            "window -5 %": ("a twentieth of the image is darker", _window(0.95)),
            "window +20 %": ("a hundredth of the image is brighter", _window(1.2, 0.01)),
            "blurred": ("denoised: means of 3 x 3 pixels", _blurred),
            "a quarter blurred": ("denoised in one corner", _blurred_quarter),
            "image a pixel off": ("columns are one off", _moved),
            "black level": ("a hundredth of the mean is added everywhere", _black_level),
            "greyer": ("2 % towards grey", _greyer),
            "clipped for display": ("samples are between 0 and 1, of 8 bits", _display),
            "sRGB written": ("samples have the transfer function of sRGB", _srgb),
            "row black": ("one row is not written", _row_black),
            "hot pixel": ("one pixel is six times as bright or more", _hot_pixel),
            "vignette": ("up to 4 % darker in the corners", _vignette),
            "divided by n - 1": ("in passes of 48 samples", _first_twice),
            "passes repeated": ("a quarter, with the same seed: no change of means", _repeated),
        }.items()
    ),
)
