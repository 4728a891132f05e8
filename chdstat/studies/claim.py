"""A claim of the paper: its text, the function that measures it, and how it becomes a finding."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from chdstat.inference.findings import Finding, MissingDataError, require
from chdstat.rendering.recipes import remake_of
from chdstat.studies.scene_data import SceneData

_ABOUT = {
    "image": "this image: other views of the scene, or other scenes, may differ",
    "paired": "this view, rendered twice: other views of the scene, or other scenes, may differ",
    "across": "these images, one of each scene: other views of the scenes may differ",
}
Measure = Callable[[SceneData], Finding] | Callable[[Sequence[SceneData]], Finding]


@dataclass(frozen=True)
class Claim:
    """A claim of the paper.

    Attributes
    ----------
    number, name
        Position in the order of the study, and a short name.
    claim
        One sentence.
    measure
        The function that measures it, in one scene or in several.
    spp
        Fewest samples per pixel: 128 for shapes and moments of logarithms, 32 for shares, 384 for
        twelve batches of 32.
    across
        Whether it compares scenes.
    paired
        Whether it compares renders of one scene.
    once
        Whether it needs the whole analysis, a training or its own render; then it is not repeated
        with another seed.
    subject
        What a verdict is about, if it is neither the image nor two renders nor scenes.
    """

    number: int
    name: str
    claim: str
    measure: Measure
    spp: int = 128
    across: bool = False
    paired: bool = False
    once: bool = False
    subject: str = ""

    @property
    def about(self) -> str:
        """What a verdict is about; intervals show how the numbers vary over parts of it."""
        kind = "across" if self.across else "paired" if self.paired else "image"
        return self.subject or _ABOUT[kind]

    @property
    def method(self) -> str:
        """How it is measured: the first sentence of the measuring function's docstring."""
        return (inspect.getdoc(self.measure) or "").splitlines()[0]

    @property
    def alone(self) -> bool:
        """Whether one render of one scene is enough."""
        return not (self.across or self.paired)

    def find(self, data: SceneData, others: Sequence[SceneData] = ()) -> Finding:
        """Test the claim in a scene, or in this scene and others."""
        used = [data, *others] if self.across else [data]
        spp = min(scene.samples.spp for scene in used)
        measured: Any = used if self.across else data
        # Remakes look like scenes of the paper but are other scenes.
        notes = [
            f"{scene.name} is a remake of the paper's {original}, not that scene."
            for scene in used
            if (original := remake_of(scene.samples))
        ]
        try:
            require(spp >= self.spp, f"{self.spp} spp, has {spp}")
            finding = self.measure(measured)
        except MissingDataError as error:
            finding = Finding(missing=(str(error),))
        return finding.on(
            number=self.number,
            name=self.name,
            claim=self.claim,
            scene=", ".join(scene.name for scene in used),
            about=" ".join([f"About {self.about}.", *notes]),
            spp=spp,
        )


ENTERED: dict[int, Claim] = {}
"""Registered claims by number; `chdstat.studies.claims.CLAIMS` has them in order."""


def claim(number: int, name: str, words: str, **options: Any) -> Callable[[Measure], Claim]:
    """Register the decorated function as the measure of a claim; `options` as for `Claim`."""

    def enter(measure: Measure) -> Claim:
        ENTERED[number] = Claim(number, name, words, measure, **options)
        return ENTERED[number]

    return enter
