"""Registry: the claims of the paper in their order, and `find`, which tests all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from chdstat.rendering.recipes import remake_of
from chdstat.studies.claims import (
    assumptions,
    case_study,
    correlated,
    learning,
    modes,
    neighbours,
    paths,
    scene_shapes,
    surfaces,
)
from chdstat.studies.outcomes import Finding, MissingDataError, Outcome, require
from chdstat.studies.scene_data import SceneData

__all__ = ["FINDINGS", "Claim", "find"]

_IMAGE = "this image: other views of the scene, or other scenes, may differ"
_TWO_RENDERS = "this view, rendered twice: other views of the scene, or other scenes, may differ"
_IMAGES = "these images, one of each scene: other views of the scenes may differ"
_TRAINED = "this training on this image, judged on its other pixels: other scenes may differ"
_NETWORK = "this training on this image: the network itself, whatever the scene shows"


@dataclass(frozen=True)
class Claim:
    """A claim of the paper.

    Attributes
    ----------
    number, name
        1 to 29, and a few words.
    claim
        One sentence.
    measure
        The function that measures it: in one scene, or in several.
    spp
        Samples per pixel below which nothing is measured: 128 for shapes and moments of logarithms,
        32 for shares, 384 for twelve batches of 32.
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
    measure: Callable[[SceneData], Outcome] | Callable[[Sequence[SceneData]], Outcome]
    spp: int = 128
    across: bool = False
    paired: bool = False
    about: str = _IMAGE

    @property
    def alone(self) -> bool:
        """Whether one render of one scene can tell."""
        return not (self.across or self.paired)

    def find(self, data: SceneData, others: Sequence[SceneData] = ()) -> Finding:
        """Test the claim in a scene, or in this scene and others."""
        used = [data, *others] if self.across else [data]
        spp = min(scene.samples.spp for scene in used)
        measured: Any = used if self.across else data
        try:
            require(spp >= self.spp, f"{self.spp} spp, has {spp}")
            outcome = self.measure(measured)
        except MissingDataError as error:
            outcome = Outcome(missing=(str(error),))
        return self.conclude(outcome, used, spp)

    def conclude(self, outcome: Outcome, scenes: Sequence[SceneData], spp: int) -> Finding:
        """Make a finding of what was measured in scenes with `spp` samples per pixel."""
        # Remakes look like scenes of the paper and are not.
        remakes = {scene.name: remake_of(scene.samples) for scene in scenes}
        notes = [
            f"{name} is a remake of the paper's {original}, not that scene."
            for name, original in remakes.items()
            if original
        ]
        return Finding(
            self.number,
            self.name,
            scene=", ".join(scene.name for scene in scenes),
            claim=self.claim,
            about=" ".join([f"About {self.about}.", *notes]),
            verdict=outcome.verdict,
            reason=outcome.reason(spp),
            test=outcome.deciding,
            tests=outcome.tests,
            p_value=outcome.p_value,
            details=outcome.details,
            plot_data=outcome.plot_data,
            other_models={
                name: self.conclude(other, scenes, spp)
                for name, other in outcome.other_models.items()
            },
        )


FINDINGS = (
    Claim(
        1,
        "nulls",
        "The share of null samples is near 60 % in indirect light, above half by night, and low "
        "where large sources light the scene.",
        paths.measure_nulls,
        spp=32,
    ),
    Claim(
        2,
        "diffuse objects",
        "CHDs of diffuse objects are symmetric and close to Gaussian in the log domain, and "
        "gamma-like with a mode below the mean in the linear one.",
        surfaces.measure_diffuse,
    ),
    Claim(
        3,
        "glossy objects",
        "CHDs of glossy objects have the shape of diffuse ones, with channels moved apart and a "
        "spread that follows their radiance.",
        surfaces.measure_glossy,
    ),
    Claim(
        4,
        "noisy reflections",
        "All pixels of a noisy reflection share one shape of the CHD, though their estimates vary.",
        surfaces.measure_reflections,
    ),
    Claim(
        5,
        "indirect light",
        "CHDs of indirect light have long tails, high kurtosis, negative skew in the log domain, "
        "and many nulls.",
        paths.measure_indirect,
    ),
    Claim(
        6,
        "penumbrae",
        "CHDs in a penumbra are bimodal, with weights of the modes that follow the position "
        "across it.",
        modes.measure_penumbrae,
    ),
    Claim(
        7,
        "coloured textures",
        "A coloured texture moves the log CHD but does not change its shape, and albedo does not "
        "tell the relative variance.",
        surfaces.measure_textures,
    ),
    Claim(
        8,
        "fireflies",
        "A firefly and the pixel next to it have nearly the same CHD, though their estimates "
        "differ.",
        neighbours.measure_fireflies,
    ),
    Claim(
        9,
        "path lengths",
        "Longer paths give CHDs of wider support, longer tail, more skew and more variance.",
        paths.measure_lengths,
        paired=True,
        about=_TWO_RENDERS,
    ),
    Claim(
        10,
        "neighbours",
        "CHDs are continuous over the image, and across an edge a blend of those of its two sides.",
        neighbours.measure_neighbours,
    ),
    Claim(
        11,
        "complexity",
        "CHDs have more modes in more complex scenes.",
        modes.measure_complexity,
        across=True,
        about=_IMAGES,
    ),
    Claim(
        12,
        "scene-specific shapes",
        "Shapes of CHDs are specific to the scene, and depend on the integrator.",
        scene_shapes.measure,
        across=True,
        about=_IMAGES,
    ),
    Claim(
        13,
        "assumptions",
        "Noise is not uniform over the image, averages are not Gaussian, variance does not follow "
        "feature buffers, and radiance is not regular.",
        assumptions.measure,
        spp=384,
    ),
    Claim(
        14,
        "families",
        "The most frequent elementary distribution is the gamma distribution.",
        modes.measure_families,
    ),
    Claim(
        15,
        "learned model",
        "The learned model improves a majority of the estimates, suppresses fireflies, gains early "
        "in training, and gives a denoiser a better start.",
        learning.measure,
        about=_TRAINED,
    ),
    Claim(
        16,
        "reduction to the mean",
        "Where samples show no pattern, the learned model gracefully reduces to their mean: equal "
        "samples keep their value, neither the order of samples nor the unit of radiance matters.",
        learning.measure_reduction,
        spp=32,
        about=_NETWORK,
    ),
    Claim(
        17,
        "correlated samples",
        "The average of samples that a sampler spreads over the pixel varies no more than that of "
        "as many independent samples.",
        correlated.measure,
        spp=32,
        paired=True,
        about=_TWO_RENDERS,
    ),
    Claim(
        18,
        "direct light",
        "CHDs of directly lit surfaces have several modes, a colour cast, and long tails.",
        case_study.measure_direct,
    ),
    Claim(
        19,
        "resolved direct light",
        "CHDs of directly lit surfaces are well resolved in spite of their spread and long tail.",
        case_study.statement("resolved direct light"),
    ),
    Claim(
        20,
        "direct and diffuse",
        "CHDs of diffuse objects that get more indirect light are less spiky in the log domain "
        "than those of directly lit surfaces, and have longer tails in the linear one.",
        case_study.statement("direct and diffuse"),
    ),
    Claim(
        21,
        "distant indirect light",
        "CHDs of indirect light have one shape all over a room, and vary more than those of "
        "direct light.",
        case_study.measure_similarity,
    ),
    Claim(
        22,
        "shadows",
        "CHDs in a shadow are skewed further to the dark in the log domain than in direct light, "
        "and vary more.",
        case_study.statement("shadows"),
    ),
    Claim(
        23,
        "several bounces",
        "CHDs of light that comes by several bounces have several modes and one shape in all "
        "channels, in spite of a colour cast.",
        case_study.measure_bounces,
    ),
    Claim(
        24,
        "virtual sources",
        "CHDs of translucent lamp shades have a very long, faint tail, and yet a low variance.",
        case_study.statement("virtual sources"),
    ),
    Claim(
        25,
        "fireplace",
        "The fireplace looks dull, but its CHD is wild in the log domain.",
        case_study.statement("fireplace"),
    ),
    Claim(
        26,
        "hidden modes",
        "Most of a CHD of indirect light is one spike of the linear histogram; the log histogram "
        "shows several modes.",
        case_study.statement("hidden modes"),
    ),
    Claim(
        27,
        "symmetry",
        "In a scene of symmetric geometry, CHDs are not symmetric everywhere.",
        neighbours.measure_symmetry,
        spp=32,
    ),
    Claim(
        28,
        "cost of longer paths",
        "Images of longer paths are visibly brighter, and take longer to render.",
        paths.measure_cost,
        spp=32,
        paired=True,
        about=_TWO_RENDERS,
    ),
    Claim(
        29,
        "integrators",
        "CHDs depend on how paths are sampled; where lights are sampled, too, averages are "
        "Gaussian sooner, at equal time, than where surfaces alone are.",
        paths.measure_integrators,
        paired=True,
        about=_TWO_RENDERS,
    ),
)
"""The claims of Elek, Thomas and Forbes 2019, "Learning patterns in sample distributions for Monte
Carlo variance reduction", in the order of the study."""


def find(data: SceneData, *, others: Sequence[SceneData] = ()) -> list[Finding]:
    """Test all claims of the paper in one scene, with other scenes to compare it with.

    A claim is *supported* where the whole interval of each of its tests lies within the range that
    the claim states, *not supported* where that of any lies wholly outside, and otherwise
    undecided. Regions that show one phenomenon are taken together, each as a stratum of its own.
    Intervals are of a bootstrap over blocks of pixels; those of the tests of one claim
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
    >>> samples = chd.simulate("gamma", shape=(8, 8), spp=16)
    >>> found = find(SceneData("simulated", samples, (Region("wall", "diffuse", (0, 0, 1, 1)),)))
    >>> len(found), found[1].verdict, found[1].reason
    (29, 'cannot tell', 'Needs 128 spp, has 16.')
    """
    return [claim.find(data, others) for claim in FINDINGS]
