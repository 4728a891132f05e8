"""Registry: the claims of the paper in their order, and `find`, which looks for all of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from chdstat.rendering.recipes import remake_of
from chdstat.studies.claims import (
    assumptions,
    complexity,
    diffuse,
    families,
    fireflies,
    glossy,
    indirect,
    learning,
    neighbours,
    nulls,
    path_lengths,
    penumbrae,
    reduction,
    reflections,
    scene_shapes,
    textures,
)
from chdstat.studies.outcomes import Finding, Outcome, conclude
from chdstat.studies.scene_data import SceneData

__all__ = ["FINDINGS", "Claim", "find"]

_IMAGE = "this image: other views of the scene, or other scenes, may differ"
_TWO_RENDERS = "this view, rendered twice: other views of the scene, or other scenes, may differ"
_IMAGES = "these images, one of each scene: other views of the scenes may differ"
_TRAINED = "this training on this image, judged on its other pixels: other scenes may differ"
_NETWORK = "this training on this image: the network itself, whatever the scene shows"
_MOMENTS, _SHAPES, _BATCHES = 32, 128, 384
"""Samples per pixel for shares; for shapes and moments of logarithms; for twelve batches of 32."""


@dataclass(frozen=True)
class Claim:
    """A claim of the paper.

    Attributes
    ----------
    number, name
        1 to 16, and a few words.
    claim
        One sentence.
    spp
        Samples per pixel below which nothing is said.
    measure
        What looks for it: in one scene, or in several.
    across
        Whether it compares scenes.
    paired
        Whether it compares renders of one scene.
    about
        What a verdict is about: its intervals say how the numbers vary over parts of the image.
    """

    number: int
    name: str
    claim: str
    spp: int
    measure: Callable[[SceneData], Outcome] | Callable[[Sequence[SceneData]], Outcome]
    across: bool = False
    paired: bool = False
    about: str = _IMAGE

    @property
    def alone(self) -> bool:
        """Whether one render of one scene can tell."""
        return not (self.across or self.paired)

    def find(self, data: SceneData, others: Sequence[SceneData] = ()) -> Finding:
        """Look for the claim in a scene, or in this scene and others."""
        used = [data, *others] if self.across else [data]
        spp = min(e.samples.spp for e in used)
        if spp < self.spp:
            found = Outcome(missing=(f"needs {self.spp} spp, has {spp}",))
        else:
            given: Any = used if self.across else data
            found = self.measure(given)
        scene = ", ".join(e.name for e in used)
        return conclude(
            found,
            number=self.number,
            name=self.name,
            claim=self.claim,
            scene=scene,
            spp=spp,
            about=" ".join([f"About {self.about}.", *_remakes(used)]),
        )


def _remakes(scenes: Sequence[SceneData]) -> Iterator[str]:
    """Say which scenes are not those of the paper, though they look like them."""
    for data in scenes:
        if original := remake_of(data.samples):
            yield f"{data.name} is a remake of the paper's {original}, not that scene."


FINDINGS = (
    Claim(
        1,
        "nulls",
        "The share of null samples is near 60 % in indirect light, above half by night, and low "
        "where large sources light the scene.",
        _MOMENTS,
        nulls.measure,
    ),
    Claim(
        2,
        "diffuse objects",
        "CHDs of diffuse objects are symmetric and close to Gaussian in the log domain, and "
        "gamma-like with a mode below the mean in the linear one.",
        _SHAPES,
        diffuse.measure,
    ),
    Claim(
        3,
        "glossy objects",
        "CHDs of glossy objects have the shape of diffuse ones, with channels moved apart and a "
        "spread that follows their radiance.",
        _SHAPES,
        glossy.measure,
    ),
    Claim(
        4,
        "noisy reflections",
        "All pixels of a noisy reflection share one shape of the CHD, though their estimates vary.",
        _SHAPES,
        reflections.measure,
    ),
    Claim(
        5,
        "indirect light",
        "CHDs of indirect light have long tails, high kurtosis, negative skew in the log domain, "
        "and many nulls.",
        _SHAPES,
        indirect.measure,
    ),
    Claim(
        6,
        "penumbrae",
        "CHDs in a penumbra are bimodal, with weights of the modes that follow the position "
        "across it.",
        _SHAPES,
        penumbrae.measure,
    ),
    Claim(
        7,
        "coloured textures",
        "A coloured texture moves the log CHD but does not change its shape, and albedo does not "
        "tell the relative variance.",
        _SHAPES,
        textures.measure,
    ),
    Claim(
        8,
        "fireflies",
        "A firefly and the pixel next to it have nearly the same CHD, though their estimates "
        "differ.",
        _SHAPES,
        fireflies.measure,
    ),
    Claim(
        9,
        "path lengths",
        "Longer paths give CHDs of wider support, longer tail, more skew and more variance.",
        _SHAPES,
        path_lengths.measure,
        paired=True,
        about=_TWO_RENDERS,
    ),
    Claim(
        10,
        "neighbours",
        "CHDs are continuous over the image, and across an edge a blend of those of its two sides.",
        _SHAPES,
        neighbours.measure,
    ),
    Claim(
        11,
        "complexity",
        "CHDs have more modes in more complex scenes.",
        _SHAPES,
        complexity.measure,
        across=True,
        about=_IMAGES,
    ),
    Claim(
        12,
        "scene-specific shapes",
        "Shapes of CHDs are specific to the scene, and depend on the integrator.",
        _SHAPES,
        scene_shapes.measure,
        across=True,
        about=_IMAGES,
    ),
    Claim(
        13,
        "assumptions",
        "Noise is not uniform over the image, averages are not Gaussian, variance does not follow "
        "feature buffers, and radiance is not regular.",
        _BATCHES,
        assumptions.measure,
    ),
    Claim(
        14,
        "families",
        "The most frequent elementary distribution is the gamma distribution.",
        _SHAPES,
        families.measure,
    ),
    Claim(
        15,
        "learned model",
        "The learned model improves a majority of the estimates, suppresses fireflies, gains early "
        "in training, and gives a denoiser a better start.",
        _SHAPES,
        learning.measure,
        about=_TRAINED,
    ),
    Claim(
        16,
        "reduction to the mean",
        "Where samples show no pattern, the learned model gracefully reduces to their mean: equal "
        "samples keep their value, neither the order of samples nor the unit of radiance matters.",
        _MOMENTS,
        reduction.measure,
        about=_NETWORK,
    ),
)
"""The claims of Elek, Thomas and Forbes 2019, "Learning patterns in sample distributions for Monte
Carlo variance reduction", in the order of the study."""


def find(data: SceneData, *, others: Sequence[SceneData] = ()) -> list[Finding]:
    """Look for all claims of the paper in one scene, with other scenes to compare it with.

    A claim is *supported* where the whole interval of every part of it lies within the range that
    the claim states, *not supported* where that of any part lies wholly outside, and else there is
    no telling. Regions that show one phenomenon are taken together, each as a stratum of its own.
    Intervals are of a bootstrap over blocks of pixels; those of the parts of one claim
    hold together at 95 % (Bonferroni). A verdict is about the image at hand, or what was trained on
    it; `Finding.about` says which, and whether the scene is a remake of the paper's. Each claim is
    a question of its own, so that nothing is corrected between claims: each has its own chance of
    5 % of a wrong verdict.

    Parameters
    ----------
    data
        The scene.
    others
        Further scenes, for the claims that compare scenes.

    Returns
    -------
    list of Finding
        One for each of `FINDINGS`, in their order. Where something is lacking, the verdict is
        "cannot tell", and the reason names it.

    Raises
    ------
    InputError
        If the samples have neither 1 nor 3 channels.

    References
    ----------
    O. Elek, M. M. Thomas, A. Forbes, "Learning Patterns in Sample Distributions for Monte Carlo
    Variance Reduction", 2019.

    Examples
    --------
    >>> import chdstat as chd
    >>> from chdstat.rendering.recipes import Region
    >>> samples = chd.simulate("gamma", size=(8, 8), spp=16)
    >>> found = find(SceneData("simulated", samples, (Region("wall", "diffuse", (0, 0, 1, 1)),)))
    >>> len(found), found[1].verdict, found[1].reason
    (16, 'cannot tell', 'Needs 128 spp, has 16.')
    """
    return [claim.find(data, others) for claim in FINDINGS]
