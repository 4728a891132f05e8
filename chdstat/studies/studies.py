"""Studies: several scenes rendered, compared and tested for all claims, and what was found.

`study` returns a `Study`, with a `SceneStudy` for each scene, a table of verdicts, JSON and a PDF.
"""

from __future__ import annotations

import importlib.metadata
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from chdstat._core.arrays import plain
from chdstat._core.display import Card, Shown, Tabled, duration
from chdstat._core.doors import report
from chdstat._core.files import checked_target
from chdstat._core.progress import portion, track
from chdstat.analysis import NoiseShares, Overview, noise_of, overview
from chdstat.comparison import Comparison
from chdstat.comparison.estimator_choice import Entry, entry_of
from chdstat.errors import InputError, StoreError
from chdstat.patterns import Atlas, atlas, choose_regions
from chdstat.rendering import refuse_render
from chdstat.rendering.backend import Backend
from chdstat.rendering.seeds import SamplerName, Sequences
from chdstat.samples import Samples, cache_key
from chdstat.studies.claims import CLAIMS, Finding, SceneData
from chdstat.studies.stores import SPREAD, Stores, StudyScene, StudySource, scenes_of

_log = logging.getLogger("chdstat")

T = TypeVar("T")
Findings = tuple[Finding, ...]

ACROSS = "all scenes"
"""Name of the column of claims that compare scenes."""


@dataclass(frozen=True, repr=False)
class SceneStudy(Shown):
    """What a study found in one scene.

    Attributes
    ----------
    data
        Samples, regions, analysis, and the other renders.
    findings
        Findings on all claims about a single scene, in order.
    repeated
        Verdicts of another seed, by number of the claim.
    chosen
        Whether the library chose the regions.
    atlas
        Shapes that recur; None if no pixel has one.
    again
        Samples of the other seed, or None.
    seconds
        Time of each part of the work, in s.
    notes
        What could not be done, and why.
    """

    data: SceneData
    findings: Findings
    repeated: Mapping[int, str] = field(default_factory=dict)
    chosen: bool = False
    atlas: Atlas | None = None
    again: Samples | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the scene."""
        return self.data.name

    @property
    def comparison(self) -> Comparison | None:
        """Comparison of the estimators; None if the samples cannot judge them."""
        return self.data.comparison

    def _card(self) -> Card:
        facts = {"notes": "; ".join(self.notes)} if self.notes else {}
        rows = [
            {"claim": f"{f.number} {f.name}", "verdict": f.verdict, "reason": f.reason}
            for f in self.findings
        ]
        return Card(f"Study of {self.name}", facts, rows)

    @cached_property
    def overview(self) -> Overview:
        """The scene in a few numbers."""
        return overview(self.data.analysis)

    @cached_property
    def noise(self) -> NoiseShares:
        """Where the noise of the scene is."""
        return noise_of(self.data.analysis)

    def to_dict(self) -> dict[str, Any]:
        """Return everything but arrays, ready for JSON."""
        renders = self.data.renders
        if self.again is not None:
            renders["another_seed"] = self.again
        return {
            "scene": self.name,
            "regions": [plain(vars(region)) for region in self.data.regions],
            "regions_chosen_by_library": self.chosen,
            "overview": self.overview.to_dict(),
            "findings": [
                {**f.to_dict(), "verdict_of_another_seed": self.repeated.get(f.number)}
                for f in self.findings
            ],
            "renders": {name: _provenance(samples) for name, samples in renders.items()},
            "seconds": plain(self.seconds),
            "notes": list(self.notes),
        }


def _provenance(samples: Samples) -> dict[str, Any]:
    """Return the provenance of samples, ready for JSON."""
    known = (str, bool, int, float, list, tuple, Mapping)
    attrs = {k: plain(v) for k, v in samples.attrs.items() if isinstance(v, known)}
    return {**attrs, "shape": list(samples.shape), "store": samples.path and str(samples.path)}


@dataclass(frozen=True, repr=False)
class Study(Tabled):
    """What a study found.

    Attributes
    ----------
    scenes
        The scenes, in the given order.
    across
        Findings on claims that compare scenes.
    provenance
        Versions of the packages, and the total time in s.
    """

    scenes: tuple[SceneStudy, ...]
    across: Findings
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the scenes."""
        return tuple(scene.name for scene in self.scenes)

    def finding(self, number: int, scene: str | None = None) -> Finding | None:
        """Return the finding on a claim in a scene, or across all scenes if `scene` is None."""
        findings = self.across
        if scene is not None:
            findings = next((s.findings for s in self.scenes if s.name == scene), ())
        return next((f for f in findings if f.number == number), None)

    def table(self) -> list[dict[str, str]]:
        """Return a row for each claim, with its number, its name and its verdict in each scene.

        A claim that compares scenes has its verdict in the column "all scenes". An empty string
        means not tested.
        """
        rows = []
        for claim in CLAIMS:
            row = {"number": str(claim.number), "claim": claim.name}
            for column in (*self.names, None):
                finding = self.finding(claim.number, column)
                row[column or ACROSS] = "" if finding is None else finding.verdict
            rows.append(row)
        return rows

    def _card(self) -> Card:
        seconds = self.provenance.get("seconds")
        facts = {} if seconds is None else {"time": duration(float(seconds))}
        rows = [{k: v for k, v in row.items() if k != "number"} for row in self.table()]
        return Card(f"Study of {', '.join(self.names)}", facts, rows)

    def to_dict(self) -> dict[str, Any]:
        """Return everything but arrays, ready for JSON; NaN and infinity are None."""
        return {
            "provenance": plain(self.provenance),
            "table": self.table(),
            "across": [f.to_dict() for f in self.across],
            "scenes": [scene.to_dict() for scene in self.scenes],
        }

    def save_pdf(self, path: str | Path) -> Path:
        """Typeset the study.

        Raises
        ------
        InputError
            If the path does not end in .pdf, or nothing can be written there.
        ChdstatError
            If it cannot be typeset or written.
        """
        return report(self, checked_target(path, ".pdf"))


def study(
    scenes: StudySource | Sequence[StudySource] | None = None,
    *,
    folder: str | Path | None = None,
    spp: int | None = None,
    size: tuple[int, int] | None = None,
    seed: int | None = None,
    max_depth: int | None = None,
    estimators: Sequence[str | Entry] | None = None,
    sampler: SamplerName = "independent",
    integrators: bool = False,
    backend: Backend = "auto",
    progress: bool = True,
) -> Study:
    """Render scenes, or continue earlier renders, and test all claims of the paper in them.

    Each scene is rendered up to four times: the image; with paths of at most four segments, at
    half the samples; with another seed, at half the samples; and, unless the scene is a file, with
    Russian roulette from the first segment on, at a quarter of the samples. A `sampler` adds one
    render, `integrators` adds up to seven. If another seed gives the opposite verdict, the finding
    becomes "cannot tell".

    Parameters
    ----------
    scenes
        One or several built-in names, Mitsuba XML files, recipes (``*.toml``), finished stores,
        scenes or `Samples`; None takes every built-in scene that has a recipe. For stores and
        `Samples`, no further renders are made.
    folder
        Folder for renders, trained networks and findings. A study continues from what the folder
        holds; when repeated, it takes seconds. A store with more samples than asked for is used
        whole. None keeps everything in memory: all built-in scenes at full size take several GB.
    spp, size, seed, max_depth, backend
        As for `chdstat.render`; None takes the values of the recipe, or 1024 spp, 128 pixels along
        the longer edge, and seed 1. From stores and `Samples`, the first `spp` samples are taken.
    estimators
        As for `chdstat.compare`; learned estimators are trained on each scene. The claims on
        learning are about "elek2019", one of the default estimators; other learned estimators are
        tested separately.
    sampler
        A sampler that spreads samples over pixels, as for `chdstat.render`. Each scene is rendered
        once more with it, with 256 or 400 samples, for the claim on correlated samples. With
        "independent", there is no such render, and that claim is not tested.
    integrators
        Whether to render scenes in more ways, at a quarter of the samples: by path guiding (not
        with the scalar backend) and with adaptive counts, for the claims on these. Scenes that are
        not files are also rendered by five more integrators, for the claim on integrators: without
        Russian roulette, with lights found by BSDF sampling alone, and direct light by sampling
        lights, BSDFs, or both.
    progress
        Show progress: a bar in a terminal or notebook, elsewhere a line every ten seconds.

    Returns
    -------
    Study
        Findings on each scene and on all of them, with `Study.table`, `Study.save` and
        `Study.save_pdf`.

    Raises
    ------
    InputError
        If no scene is given, one is given twice, an estimator is unknown, or a recipe or an option
        is wrong.
    SceneError, RenderError, StoreError
        As for `chdstat.render` and `chdstat.open`.

    References
    ----------
    O. Elek, M. M. Thomas, A. Forbes, "Learning Patterns in Sample Distributions for Monte Carlo
    Variance Reduction", 2019.

    Examples
    --------
    >>> import chdstat as chd
    >>> samples = chd.simulate("gamma", shape=(8, 8), spp=128)
    >>> found = study(samples, estimators=["mean"])
    >>> found.table()[0]["claim"], found.scenes[0].findings[0].verdict
    ('nulls', 'cannot tell')
    """
    options = {"spp": spp, "size": size, "seed": seed, "max_depth": max_depth}
    for name in estimators or ():
        entry_of(name)  # an unknown one is refused before the work
    settings = {name: value for name, value in options.items() if value is not None}
    chosen = scenes_of(scenes, settings)
    if all(isinstance(scene.source, Samples) for scene in chosen):
        asked: dict[str, Any] = {"sampler": None if sampler == "independent" else sampler}
        asked["integrators"] = integrators or None
        refuse_render("what is studied", options | asked | {"spp": None, "backend": backend})
    Sequences.of(sampler, SPREAD.get(sampler))  # an unknown one is refused before the work
    stores = Stores(
        None if folder is None else Path(folder), backend, progress, sampler, integrators
    )
    return studied(chosen, stores, estimators)


def studied(
    chosen: Sequence[StudyScene], stores: Stores, estimators: Sequence[str | Entry] | None
) -> Study:
    """Study scenes, and keep in a folder what is made.

    Raises
    ------
    StoreError
        If nothing can be kept there.
    """
    if stores.folder is not None:
        try:
            stores.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            message = f"cannot keep renders in {stores.folder}: {error.strerror or error}"
            raise StoreError(message) from error
    start, found = time.monotonic(), []
    what = f"studying {len(chosen)} scene{'s' * (len(chosen) > 1)}"
    with track(what, len(chosen), unit="scene", show=stores.progress) as advance:
        for i, scene in enumerate(chosen):
            _log.info("studying %s (%d of %d)", scene.name, i + 1, len(chosen))
            with portion(1, advance):
                found.append(_scene(scene, stores, estimators))
        across = _across([scene.data for scene in found], stores)
    packages = ("chdstat", "mitsuba", "numpy", "scipy")
    versions = {package: importlib.metadata.version(package) for package in packages}
    seconds = round(time.monotonic() - start, 1)
    return Study(tuple(found), across, {**versions, "seconds": seconds})


_STAGES = 7
"""Stages of the study of a scene."""


def _scene(
    scene: StudyScene, stores: Stores, estimators: Sequence[str | Entry] | None
) -> SceneStudy:
    """Study one scene."""
    seconds: dict[str, float] = {}

    def timed(name: str, work: Callable[[], T]) -> T:
        start = time.monotonic()
        with portion(1 / _STAGES):
            result = work()
        seconds[name] = round(time.monotonic() - start, 3)
        return result

    notes: list[str] = []

    def compared() -> Comparison | None:
        try:
            return stores.comparison(samples, estimators, dataset["label"])
        except InputError as error:
            notes.append(f"estimators were not compared: {error}")
            return None

    def atlas_of_samples() -> Atlas:
        return atlas(samples, progress=stores.progress)

    data, again = timed("rendering", lambda: stores.renders(scene))
    samples, shorter = data.samples, data.shorter
    dataset = timed("analysis", lambda: stores.analysis(samples))
    comparison = timed("estimators", compared)
    names = () if comparison is None else comparison.estimators
    data = replace(
        data,
        regions=data.regions or choose_regions(dataset),
        given=dataset,
        given_shorter=timed(
            "shorter paths", lambda: None if shorter is None else stores.summary(shorter)
        ),
        comparison=comparison,
    )
    findings = timed("findings", lambda: _findings(data, stores, inputs=names))
    repeated = timed("another seed", lambda: _repeated(data, again, stores))
    shapes = timed("atlas", lambda: stores.cache(samples).record("atlas", Atlas, atlas_of_samples))
    return SceneStudy(
        data,
        tuple(f.confirmed(repeated.get(f.number)) for f in findings),
        {number: f.verdict for number, f in repeated.items()},
        chosen=not scene.regions,
        atlas=shapes if len(shapes.share) else None,
        again=again,
        seconds=seconds,
        notes=tuple(notes),
    )


def _findings(
    data: SceneData,
    stores: Stores,
    *,
    again: bool = False,
    inputs: tuple[str, ...] = (),
) -> Findings:
    """Test the claims about one scene, those of another seed `again`."""
    claims = [c for c in CLAIMS if not (c.across or (again and c.once))]
    renders = {name: cache_key(samples) for name, samples in data.renders.items()}
    return stores.cache(data.samples).record(
        "findings",
        Findings,
        lambda: tuple(claim.find(data) for claim in claims),
        inputs=(data.name, data.regions, renders, [c.number for c in claims], *inputs),
    )


def _repeated(data: SceneData, again: Samples | None, stores: Stores) -> dict[int, Finding]:
    """Return what another seed says, by number of the claim."""
    if again is None:
        return {}
    other = SceneData(
        data.name, again, data.regions, shorter=data.shorter, given_shorter=data.given_shorter
    )
    return {f.number: f for f in _findings(other, stores, again=True)}


def _across(scenes: Sequence[SceneData], stores: Stores) -> Findings:
    """Test the claims that compare scenes."""
    first, *others = scenes
    names = tuple(data.name for data in scenes)
    keys = [[cache_key(samples) for samples in data.renders.values()] for data in scenes]

    def find() -> Findings:
        return tuple(claim.find(first, others) for claim in CLAIMS if claim.across)

    if not all(map(all, keys)):  # some are in memory
        return find()
    return stores.cache(first.samples).record("across", Findings, find, inputs=(names, keys))
