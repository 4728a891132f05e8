"""Recipes: how a study renders a scene, and which regions it looks at.

A recipe is a TOML file; those of the study scenes lie in ``renders/``. For a scene without a
recipe, `chdstat.patterns.choose_regions` finds a region for every pattern of the classified image.
"""

from __future__ import annotations

import os
import reprlib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import chdstat
from chdstat._core.files import is_file
from chdstat.errors import InputError
from chdstat.rendering.jobs import checked_settings, scene_integrator, scene_size
from chdstat.samples import Samples
from chdstat.samples.tiles import Region
from chdstat.scenes import BUILTIN, REMAKES, Scene

_EDGE = 128
"""Longest edge of the image if neither the user nor a recipe gives a size."""
SCHEMA = 1
_SCENES = "$CHDSTAT_SCENES"
_KEYS = ("schema", "name", "scene", "integrator", "size", "spp", "seed", "regions")
_LONGEST, _DOTS = 2**16, 1000
PHENOMENA = (
    "diffuse",
    "glossy",
    "noisy-reflection",
    "direct",
    "indirect",
    "penumbra",
    "texture",
    "firefly",
    "highlight",
    "shadow",
    "virtual-source",
    "albedo-contrast",
    "multi-bounce",
    "fireplace",
    "multi-light",
    "caustic",
    "volume",
)
"""Phenomena of regions; all but the last three come from the case study of Elek et al. 2019.

``texture`` covers several colours under one light. Regions of ``albedo-contrast`` come in pairs: a
dark and a pale one of the same texture, side by side.
"""


@dataclass(frozen=True)
class Recipe:
    """How a study renders a scene, and where it looks.

    Parameters
    ----------
    scene
        Source for `chdstat.load_scene`. In a file, a path may start from the file's folder, or from
        a folder in an environment variable, such as ``$CHDSTAT_SCENES/attic/scene.xml``.
    size, spp, seed, max_depth
        As for `chdstat.render`.
    regions
        Regions to look at, in the order of the report.
    integrator
        Mitsuba's name of the integrator that the scene asks for, such as ``path``; None if the
        recipe does not say.
    name
        Name of the scene in the study; None for the scene's own name.
    """

    scene: str
    size: tuple[int, int]
    spp: int
    seed: int
    max_depth: int | None
    regions: tuple[Region, ...]
    integrator: str | None = None
    name: str | None = None

    def settings(self) -> dict[str, Any]:
        """Return the arguments of `chdstat.render`."""
        return {"size": self.size, "spp": self.spp, "seed": self.seed, "max_depth": self.max_depth}

    def shows(self, height: int, width: int) -> bool:
        """Return whether an image of this size has the proportions, and so the view, of the recipe.

        Examples
        --------
        >>> find_recipe("bathroom").shows(64, 64), find_recipe("bathroom").shows(64, 96)
        (True, False)
        """
        own_width, own_height = self.size
        scale = max(width / own_width, height / own_height)
        return abs(width - own_width * scale) < 1 and abs(height - own_height * scale) < 1


def check_integrator(recipe: Recipe, scene: Scene) -> None:
    """Refuse a recipe that was written for another integrator than its scene has.

    Raises
    ------
    InputError
        If the types differ.
    """
    used = scene_integrator(scene)
    if recipe.integrator not in (None, used):
        message = (
            f"key integrator.type of the recipe must be {used!r}, as scene {scene.name!r} has it, "
            f"got {recipe.integrator!r}; change it in the scene, or leave it out of the recipe"
        )
        raise InputError(message)


def _own_recipe(name: str, origin: str) -> Recipe | None:
    """Return the recipe of a built-in scene; None for another scene, whatever its name.

    Parameters
    ----------
    name, origin
        Name and origin of a `Scene`, or of the scene of samples.
    """
    return find_recipe(name) if name in BUILTIN and origin == "chdstat" else None


def recipe_of(scene: Scene, *, spp: int, seed: int) -> Recipe:
    """Return the recipe of a built-in scene; for others, a small image with their proportions."""
    own = _own_recipe(scene.name, scene.origin)
    if own is not None:
        return own
    width, height = scene_size(scene)
    scale = _EDGE / max(width, height)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return Recipe(scene.name, size, spp, seed, max_depth=None, regions=())


def regions_of(samples: Samples) -> tuple[Region, ...]:
    """Return the regions of samples of a built-in scene in its recipe's view, else none."""
    recipe = _own_recipe(samples.name, str(samples.attrs.get("scene_source")))
    height, width = samples.shape[:2]
    whole = samples.attrs.get("size", [width, height]) == [width, height]  # not cut by `isel`
    return recipe.regions if recipe and whole and recipe.shows(height, width) else ()


def remake_of(samples: Samples) -> str:
    """Return the name of the paper's scene whose remake these samples show, or "".

    Findings on a remake need not hold for the scene of Elek, Thomas and Forbes 2019, whose geometry
    and materials differ.
    """
    built_in = samples.attrs.get("scene_source") == "chdstat"
    return REMAKES.get(samples.name, "") if built_in else ""


def find_recipe(scene: str, scenes: str | Path | None = None) -> Recipe | None:
    """Return the recipe of a built-in scene; None if it has none.

    `scenes` is the folder of scenes, as for `load_recipe`.
    """
    package = Path(chdstat.__file__).parent
    for place in (package, package.parent):  # as it is installed, and in a source checkout
        path = place / "renders" / f"{scene}.toml"
        if path.is_file():
            return load_recipe(path, scenes)
    return None


def load_recipe(path: str | Path, scenes: str | Path | None = None) -> Recipe:
    """Read a recipe; its scene's path may start from the recipe's folder.

    Parameters
    ----------
    path
        The file.
    scenes
        Folder of scenes, for a path that starts with ``$CHDSTAT_SCENES``; None takes the
        environment variable of that name.

    Raises
    ------
    InputError
        If the file is missing or not TOML, a key is missing or out of range, or the scene's path
        uses an environment variable that is not set. The message names file and key.
    """
    path = Path(path)
    content = _toml(path)
    try:
        recipe = _recipe(content)
    except InputError as error:
        message = f"recipe {path}: {error}"
        raise InputError(message) from error
    given = recipe.scene if scenes is None else recipe.scene.replace(_SCENES, str(scenes))
    recipe = replace(recipe, scene=os.path.expandvars(given))
    if "$" in recipe.scene:
        message = (
            f"recipe {path}: key scene must not name an environment variable that is not set, got "
            f"{recipe.scene!r}; set it to the folder of your scenes"
        )
        raise InputError(message)
    beside = path.parent / recipe.scene
    if recipe.scene not in BUILTIN and is_file(beside):
        return replace(recipe, scene=str(beside))
    return recipe


def _toml(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file; refuse one that no person would write.

    Python's parser overflows its stack in deep arrays, and takes minutes for a key with many parts.
    """
    try:
        with path.open("rb") as stream:
            text = stream.read(_LONGEST + 1).decode("utf-8")
    except OSError as error:
        message = f"cannot read recipe {path}: {error.strerror}"
        raise InputError(message) from error
    except UnicodeDecodeError as error:
        message = f"recipe {path} is no text in UTF-8"
        raise InputError(message) from error
    if len(text) > _LONGEST or any(line.count(".") > _DOTS for line in text.splitlines()):
        message = f"recipe {path} must have at most {_LONGEST} characters, {_DOTS} points in a line"
        raise InputError(message)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        message = f"recipe {path} is not valid TOML: {error}"
        raise InputError(message) from error


def _recipe(content: Mapping[str, Any]) -> Recipe:
    _expect(content.get("schema") == SCHEMA, "schema", SCHEMA, content.get("schema"))
    _only_known(content, _KEYS)
    integrator = _key(content, "integrator", dict, optional=True) or {}
    _only_known(integrator, ("type", "max_depth"), "integrator.")
    kinds: dict[str, type] = {"size": list, "spp": int, "seed": int}
    given: Any = {name: _key(content, name, kind) for name, kind in kinds.items()}
    given["max_depth"] = integrator.get("max_depth")
    used: Any = checked_settings(given)
    settings = {name: used[name] for name in given}
    regions = content.get("regions", [])
    tables = isinstance(regions, list) and all(isinstance(r, Mapping) for r in regions)
    _expect(tables, "regions", "tables [[regions]]", regions)
    names = [r.get("name") for r in regions]
    _expect(len({str(n) for n in names}) == len(names), "regions", "distinct names", names)
    return Recipe(
        scene=_key(content, "scene", str),
        **settings,
        regions=tuple(_region(i, region) for i, region in enumerate(regions)),
        integrator=_key(integrator, "type", str, "integrator.", optional=True),
        name=_key(content, "name", str, optional=True),
    )


def _region(index: int, content: Mapping[str, Any]) -> Region:
    where = f"regions[{index}]."
    _only_known(content, ("name", "phenomenon", "rectangle", "note"), where)
    phenomenon = _key(content, "phenomenon", str, where)
    known = ", ".join(PHENOMENA)
    _expect(phenomenon in PHENOMENA, f"{where}phenomenon", f"one of {known}", phenomenon)
    name, rectangle = _key(content, "name", str, where), _key(content, "rectangle", list, where)
    note = _key(content, "note", str, where, optional=True) or ""
    return Region(name, phenomenon, rectangle, note)


def _key(
    content: Mapping[str, Any], name: str, kind: type, where: str = "", *, optional: bool = False
) -> Any:
    if optional and name not in content:
        return None
    value = content.get(name)
    # In Python, a truth value is a whole number; in a recipe, it is a mistake.
    good = isinstance(value, kind) and not isinstance(value, bool)
    _expect(good, f"{where}{name}", f"a {kind.__name__}", value)
    return value


def _only_known(content: Mapping[str, Any], known: tuple[str, ...], where: str = "") -> None:
    """Refuse a key that would be ignored: it is misspelt or from another version."""
    for name in content:
        _expect(name in known, f"key {where}{name}", f"one of {', '.join(known)}", name)


def _expect(holds: bool, key: str, expected: object, got: object) -> None:
    if not holds:
        message = f"{key} must be {expected}, got {reprlib.repr(got)}"
        raise InputError(message)
