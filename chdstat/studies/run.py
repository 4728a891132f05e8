"""A study from scenes to findings: renders, analyses, comparisons and claims."""

from __future__ import annotations

import importlib.metadata
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from chdstat.comparison import Comparison
from chdstat.errors import InputError, StoreError
from chdstat.estimators import lookup
from chdstat.patterns import Atlas, atlas
from chdstat.rendering.backend import Backend
from chdstat.rendering.jobs import refuse_render
from chdstat.rendering.recipes import choose_regions
from chdstat.samples import Samples
from chdstat.studies.claims import FINDINGS, Finding, SceneData
from chdstat.studies.config import Source, Subject, subjects_of
from chdstat.studies.results import SceneStudy, Study
from chdstat.studies.stores import Stores, analysis_of, comparison_of, record_of, summary_of

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["study"]

_log = logging.getLogger("chdstat")

T = TypeVar("T")

_ONCE = frozenset({14, 15, 16})
"""Claims that need the whole analysis or a training: no other seed repeats them."""
_OPPOSITE = {"supported", "not supported"}


def study(
    scenes: Source | Sequence[Source] | None = None,
    *,
    folder: str | Path | None = "renders/out",
    spp: int | None = None,
    size: tuple[int, int] | None = None,
    seed: int | None = None,
    max_depth: int | None = None,
    estimators: Sequence[str] = ("mean", "elek2019"),
    backend: Backend = "auto",
    progress: bool | None = None,
) -> Study:
    """Render scenes, or take up earlier renders, and look for all claims of the paper in them.

    For each scene there are up to four renders: the image; the same with paths of at most three
    segments, and with another seed, each at half the samples; and by another integrator, which
    plays Russian roulette from the first segment on, at a quarter, where the scene is not a file. A
    finding that another seed contradicts becomes "cannot tell".

    Parameters
    ----------
    scenes
        Built-in names, Mitsuba XML files, recipes (``*.toml``), finished stores, scenes or
        `Samples`, one or several; None takes every built-in scene that has a recipe. Stores and
        samples stand alone: nothing else is rendered for them.
    folder
        Where renders, trained networks and all that was found are kept. What is there is taken up,
        whole or half done, so that the same study once more takes seconds; a store with more
        samples than asked for is used whole. None keeps all in memory.
    spp, size, seed, max_depth, backend
        As for `chdstat.render`; None takes the recipe's, or 1024 spp, 128 pixels along the longer
        edge, and seed 1. Stores and samples are taken as they are.
    estimators
        Names of the estimators to compare; those that learn are trained on each scene. "elek2019"
        is the model that the claim on learning is about; what else learns is judged beside it.
        "progressive" trains for about a minute on each scene.
    progress
        Show progress bars; None shows them on a terminal.

    Returns
    -------
    Study
        Findings on each scene and on all of them, with `Study.table`, `Study.save_json` and
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
    >>> samples = chd.simulate("gamma", size=(8, 8), spp=128)
    >>> found = study(samples, folder=None, estimators=["mean"])
    >>> found.table()[0]["claim"], len(found.scenes[0].findings)
    ('nulls', 14)
    """
    asked = {"spp": spp, "size": size, "seed": seed, "max_depth": max_depth}
    given = {name: value for name, value in asked.items() if value is not None}
    for name in estimators:
        lookup(name)  # an unknown one is refused before the work
    subjects = subjects_of(scenes, given=given)
    if all(subject.scene is None for subject in subjects):
        refuse_render("what is studied", asked | {"backend": backend})
    stores = Stores(_made(folder), backend, progress)
    start = time.monotonic()
    found = []
    for i, subject in enumerate(subjects):
        _log.info("studying %s (%d of %d)", subject.name, i + 1, len(subjects))
        found.append(_scene(subject, stores, estimators, progress))
    across = _across([scene.evidence for scene in found], stores)
    return Study(tuple(found), across, _provenance(time.monotonic() - start))


def _made(folder: str | Path | None) -> Path | None:
    if folder is None:
        return None
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        message = f"cannot keep renders in {path}: {error.strerror or error}"
        raise StoreError(message) from error
    return path


def _scene(
    subject: Subject, stores: Stores, estimators: Sequence[str], progress: bool | None
) -> SceneStudy:
    """Study one scene."""
    clock = _Clock()
    renders = clock("rendering", lambda: stores.renders(subject))
    samples = renders.samples
    dataset = clock("analysis", lambda: analysis_of(samples, stores, progress=progress))
    comparison, notes = clock("estimators", lambda: _compared(samples, estimators, dataset, stores))
    shorter = renders.shorter
    summary = clock(
        "shorter paths",
        lambda: None if shorter is None else summary_of(shorter, stores, progress=progress),
    )
    evidence = SceneData(
        subject.name,
        samples,
        subject.regions or choose_regions(dataset),
        given=dataset,
        shorter=shorter,
        given_shorter=summary,
        integrator=renders.integrator,
        comparison=comparison,
    )
    findings = clock("findings", lambda: _findings(evidence, stores, needs=[estimators]))
    repeated = clock("another seed", lambda: _repeated(evidence, renders.again, stores))
    return SceneStudy(
        evidence=evidence,
        findings=tuple(_confirmed(f, repeated.get(f.number)) for f in findings),
        repeated={number: f.verdict for number, f in repeated.items()},
        chosen=not subject.regions,
        atlas=clock("atlas", lambda: _shapes(samples, stores)),
        again=renders.again,
        seconds=clock.seconds,
        notes=notes,
    )


class _Clock:
    """Times parts of the work."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def __call__(self, name: str, work: Callable[[], T]) -> T:
        start = time.monotonic()
        try:
            return work()
        finally:
            self.seconds[name] = round(time.monotonic() - start, 3)


def _compared(
    samples: Samples, estimators: Sequence[str], dataset: xr.Dataset, stores: Stores
) -> tuple[Comparison | None, tuple[str, ...]]:
    """Compare the estimators, or say why these samples cannot judge them."""
    try:
        return (
            comparison_of(samples, estimators, dataset["label"], stores, progress=stores.progress),
            (),
        )
    except InputError as error:
        return None, (f"estimators were not compared: {error}",)


def _findings(
    evidence: SceneData,
    stores: Stores,
    *,
    but: frozenset[int] = frozenset(),
    needs: Sequence[object] = (),
) -> tuple[Finding, ...]:
    """Ask a scene for every claim about one scene but some."""

    def asked() -> tuple[Finding, ...]:
        return tuple(c.find(evidence) for c in FINDINGS if not c.across and c.number not in but)

    told = [evidence.name, evidence.regions, stores.told(evidence.shorter), sorted(but), *needs]
    kind = tuple[Finding, ...]
    return record_of(evidence.samples, stores, "findings", kind, asked, needs=told)


def _repeated(evidence: SceneData, again: Samples | None, stores: Stores) -> dict[int, Finding]:
    """Return what another seed says, by number of the claim."""
    if again is None:
        return {}
    repeat = SceneData(
        evidence.name,
        again,
        evidence.regions,
        shorter=evidence.shorter,
        given_shorter=evidence.given_shorter,
    )
    return {f.number: f for f in _findings(repeat, stores, but=_ONCE)}


def _across(evidences: Sequence[SceneData], stores: Stores) -> tuple[Finding, ...]:
    """Ask all scenes for the claims that compare scenes."""
    first, *others = evidences

    def asked() -> tuple[Finding, ...]:
        return tuple(claim.find(first, others) for claim in FINDINGS if claim.across)

    told = [
        stores.told(samples)
        for evidence in evidences
        for samples in (evidence.samples, evidence.shorter, evidence.integrator)
    ]
    names = tuple(evidence.name for evidence in evidences)
    kind = tuple[Finding, ...]
    return record_of(first.samples, stores, "across", kind, asked, needs=[names, *told])


def _confirmed(finding: Finding, again: Finding | None) -> Finding:
    """Return a finding, without a verdict if another seed has the opposite one."""
    if again is None or {finding.verdict, again.verdict} != _OPPOSITE:
        return finding
    reason = f"Seeds disagree. The first: {finding.reason} Another: {again.reason}"
    return replace(finding, verdict="cannot tell", reason=reason)


def _shapes(samples: Samples, stores: Stores) -> Atlas | None:
    def drawn() -> Atlas:
        return atlas(samples, progress=stores.progress)

    found = record_of(samples, stores, "atlas", Atlas, drawn)
    return found if len(found.share) else None


def _provenance(seconds: float) -> dict[str, str | float]:
    versions = {
        name: importlib.metadata.version(name) for name in ("chdstat", "mitsuba", "numpy", "scipy")
    }
    return {**versions, "seconds": round(seconds, 1)}
