"""Directives that show the built-in scenes, from the pictures and numbers in docs/scenes.

``scene`` shows picture, noise map and numbers of one scene, ``scene-strip`` all scenes as a row of
links, ``scene-recipe`` how the pictures were made. `tools/make_scene_pictures.py` makes them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.util.docutils import SphinxDirective

from chdstat.scenes import BUILTIN

__all__ = ["ScenePair", "SceneRecipe", "SceneStrip"]

FOLDER = Path(__file__).parents[1] / "scenes"


def recipe() -> dict[str, Any]:
    """Return what is known of the pictures."""
    found: dict[str, Any] = json.loads((FOLDER / "recipe.json").read_text("utf-8"))
    return found


def sentence(numbers: dict[str, float], brightest: float) -> str:
    """Return the numbers of a scene in words."""
    return (
        f"{numbers['null_share']:.0%} of the samples are null. The brightest {brightest:.0%} of "
        f"the samples carry {numbers['brightest_share']:.0%} of the light. The standard deviation "
        f"of one sample is {numbers['noise_median']:.1f} times the mean in the median pixel, and "
        f"more than {numbers['noise_high']:.1f} times in every tenth."
    )


class ScenePair(SphinxDirective):
    """Show the picture of a scene, the map of its noise, and its numbers."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        (name,) = self.arguments
        told = recipe()
        self.env.note_dependency(str(FOLDER / "recipe.json"))
        pair = nodes.container(classes=["scene-pair"])
        for end, words in (("", "The scene"), ("-noise", "Noise of one sample")):
            image = nodes.image(
                uri=f"/scenes/{name}{end}.webp", alt=f"{words}: {name.replace('-', ' ')}."
            )
            pair += nodes.figure("", image, nodes.caption(words, words))
        text = sentence(told["scenes"][name]["numbers"], told["brightest"])
        return [pair, nodes.paragraph(text, text, classes=["scene-numbers"])]


class SceneStrip(SphinxDirective):
    """Show all scenes in a row, each with a link to its place."""

    def run(self) -> list[nodes.Node]:
        up = "../" * self.env.docname.count("/")
        strip = nodes.container(classes=["scene-strip"])
        for name in BUILTIN:
            words = name.replace("-", " ")
            picture = nodes.image(uri=f"/scenes/{name}.webp", alt=words)
            link = nodes.reference("", "", picture, refuri=f"{up}scenes/index.html#{name}")
            strip += nodes.paragraph("", "", link)
        return [strip]


class SceneRecipe(SphinxDirective):
    """List settings, versions and hashes of the pictures."""

    def run(self) -> list[nodes.Node]:
        lines = [".. list-table::", "   :header-rows: 1", ""]
        rows = [("scene", "hash of the scene", "pixels", "spp", "seed", "backend, versions")]
        for name, made in recipe()["scenes"].items():
            versions = f"{made['backend']}, Mitsuba {made['mitsuba']}, chdstat {made['chdstat']}"
            pixels = " x ".join(map(str, made["size"]))
            settings = pixels, str(made["spp"]), str(made["seed"])
            rows.append((name, f"``{made['scene_hash'][:12]}``", *settings, versions))
        for row in rows:
            lines += [f"   * - {row[0]}", *(f"     - {cell}" for cell in row[1:])]
        return self.parse_text_to_nodes("\n".join(lines))


def setup(app: Any) -> dict[str, bool]:
    """Let Sphinx load this module as an extension."""
    app.add_directive("scene", ScenePair)
    app.add_directive("scene-recipe", SceneRecipe)
    app.add_directive("scene-strip", SceneStrip)
    return {"parallel_read_safe": True}
