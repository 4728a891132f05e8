"""Stores of a study: its scenes, their renders in one folder, and cached results.

The name of a store contains its scene and a digest of everything that its samples depend on, except
their number. So a stopped render resumes, and more samples are appended. Analyses, summaries and
comparisons are kept beside the store until the samples or the code change.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chdstat._core.files import Cache, digest_of, kept_until_written, release, room
from chdstat.analysis import analyze, save
from chdstat.comparison import DEFAULT_ESTIMATORS, Comparison, compare
from chdstat.comparison.estimator_choice import Entry, entry_of, without_denoiser
from chdstat.errors import InputError, StoreError
from chdstat.estimators import LearnedEstimator
from chdstat.estimators.registry import Model
from chdstat.estimators.training import TrainedModel, first_samples, load_model, train_model
from chdstat.rendering import recipes
from chdstat.rendering.backend import Backend
from chdstat.rendering.renders import render
from chdstat.rendering.seeds import SamplerName
from chdstat.samples import Region, Samples, cache_key, is_store
from chdstat.samples import open as open_samples
from chdstat.samples.dependence import check_independent
from chdstat.scenes import BUILTIN, Scene, load_scene
from chdstat.scenes.scene import MITSUBA, LiveScene
from chdstat.studies.scene_data import BSDF_SAMPLING, DIRECT, SceneData
from chdstat.summary.statistics import summarize

if TYPE_CHECKING:
    import xarray as xr

_SPP = 1024
_N = 32
"""Samples of one estimate, as in Elek et al. 2019."""
SHORT = 4
"""Longest path, in segments, of the shorter ones. Elek et al. 2019 compare "two and five bounces of
indirect transport". Direct light takes two segments and each bounce one more: four and seven."""
ROULETTE = 1
"""First segment at which the other integrator plays Russian roulette: it solves the same equation
with other samples. `volpath` in place of `path` would not do: without media, its shapes of CHDs are
those of `path`.
"""
_DIRECT = {"direct light, lights": (1, 0), "direct light, BSDFs": (0, 1), DIRECT: (1, 1)}
"""Samples of lights and of BSDFs by name of the integrator."""
_NEVER = 2**20
_EARLY = "early roulette"
_POINTS = ("point", "spot", "directional", "projector", "directionalarea", "sunsky")
"""Lights that no ray meets by chance."""
_LEAST = 128
"""Fewest samples of the renders to compare with; else a half or a quarter of those of the image.
"""
SPREAD = {"stratified": 16, "multijitter": 16, "orthogonal": 25, "ldsampler": 16}
"""Samples of a sequence, by sampler."""
_SEQUENCES = 16
_IN_MEMORY = 2**26
"""Samples up to this many bytes are read into memory, as they are used several times."""

StudySource = str | Path | Mapping[str, Any] | Scene | Samples | recipes.Recipe


@dataclass(frozen=True)
class StudyScene:
    """One scene of a study.

    Attributes
    ----------
    name
        Name of the scene; unique within a study.
    source
        The scene to render, or samples that are rendered already.
    recipe
        How to render it; None for samples.
    regions
        Regions of the image; none lets the library choose.
    """

    name: str
    source: Scene | Samples
    recipe: recipes.Recipe | None
    regions: tuple[Region, ...]


def scenes_of(
    sources: StudySource | Sequence[StudySource] | None, settings: Mapping[str, Any]
) -> tuple[StudyScene, ...]:
    """Return the scenes of a study.

    Parameters
    ----------
    sources
        Built-in names, Mitsuba XML files, recipes (also as ``*.toml``), finished stores, scenes or
        samples, one or several; None takes every built-in scene that has a recipe.
    settings
        Size, spp, seed and max_depth instead of those of recipes; from stores, the first spp are
        taken.

    Raises
    ------
    InputError
        If there is no scene, a scene is given twice, or a recipe is wrong; the message names file
        and key.
    SceneError, StoreError
        If a scene or a store cannot be read.
    """
    if sources is None:
        sources = [name for name in BUILTIN if recipes.find_recipe(name)]
    elif isinstance(sources, (str, Path, Mapping, Scene, Samples, recipes.Recipe)):
        sources = [sources]
    scenes = [_scene(source, settings) for source in sources]
    if not scenes:
        message = "a study needs at least one scene, got none"
        raise InputError(message)
    return tuple(_distinct(scenes))


def _scene(source: StudySource, settings: Mapping[str, Any]) -> StudyScene:
    if is_store(source):
        source = open_samples(source)
    if isinstance(source, Samples):
        source = first_samples(source, settings.get("spp"))
        check_independent(source.attrs)
        return StudyScene(source.name, source, None, recipes.regions_of(source))
    if isinstance(source, (str, Path)) and Path(source).suffix.lower() == ".toml":
        source = recipes.load_recipe(source)
    if isinstance(source, recipes.Recipe):
        recipe, scene = source, load_scene(source.scene)
        recipes.check_integrator(recipe, scene)
    else:
        scene = load_scene(source)
        recipe = recipes.recipe_of(scene, spp=_SPP, seed=1)
    used = replace(recipe, **settings)
    # What is no size, rendering refuses with a message of its own.
    seen = len(used.size) == 2 and recipe.shows(used.size[1], used.size[0])
    name = recipe.name or scene.name
    return StudyScene(name, scene, used, recipe.regions if seen else ())


def _distinct(scenes: Sequence[StudyScene]) -> Iterator[StudyScene]:
    """Yield scenes, with numbers to make names unique; the same scene twice is refused."""
    names, known = list[str](), list[object]()
    for scene in scenes:
        source = scene.source
        own = source.hash if isinstance(source, Scene) else source.attrs.get("scene_hash", source)
        if own in known:
            message = f"expected different scenes, got {scene.name!r} twice"
            raise InputError(message)
        known.append(own)
        names.append(scene.name)
        count = names.count(scene.name)
        yield scene if count == 1 else replace(scene, name=f"{scene.name} ({count})")


@dataclass(frozen=True)
class Stores:
    """The folder with the renders of a study and cached results.

    Attributes
    ----------
    folder
        The folder; None keeps everything in memory.
    backend, progress
        As for `chdstat.render`.
    sampler
        Sampler of one more render, with samples that are spread over pixels; "independent" for
        none.
    integrators
        Whether to render by other integrators, by path guiding and with adaptive counts, too.
    iterations
        Minibatches of trainings; None takes as many as a comparison does.
    """

    folder: Path | None
    backend: Backend = "auto"
    progress: bool = True
    sampler: SamplerName = "independent"
    integrators: bool = False
    iterations: int | None = None

    def renders(self, scene: StudyScene) -> tuple[SceneData, Samples | None]:
        """Return the renders of a scene, and one with another seed; missing ones are rendered.

        For given samples, there are no other renders.
        """
        source, recipe = scene.source, scene.recipe
        if isinstance(source, Samples) or recipe is None:
            return SceneData(scene.name, source, scene.regions), None  # type: ignore[arg-type]
        samples = self._rendered(source, recipe.settings(), film=source.renderer == MITSUBA)
        depth = dict(samples.attrs["integrator"]).get("max_depth", -1)
        spp, seed = int(recipe.spp), int(recipe.seed)
        half, quarter = (max(min(spp, _LEAST), spp // part) for part in (2, 4))

        def more(number: int, spp: int, what: Scene = source, **how: Any) -> Samples:
            """Render with its own seed: tests of a difference assume independent samples."""
            settings = {**recipe.settings(), "spp": spp, "seed": seed + number, **how}
            return self._rendered(what, settings)

        other: dict[str, Any] = {}
        variants = _variants(source, samples)
        if (early := variants.pop(_EARLY, None)) is not None:
            other["integrator"] = more(2, quarter, early)
        if depth < 0 or depth > SHORT:
            other["shorter"] = more(3, half, max_depth=SHORT)
        if self.sampler != "independent":
            length = SPREAD[self.sampler]
            other["spread"] = more(4, _SEQUENCES * length, sampler=self.sampler, sequence=length)
        if self.integrators:
            # The path length is part of each of them; Mitsuba's `direct` has none.
            by = {
                name: more(5 + i, quarter, variant, max_depth=None)
                for i, (name, variant) in enumerate(variants.items())
            }
            other["integrators"] = by if early is None else {_EARLY: other["integrator"], **by}
            if samples.attrs["backend"] != "scalar" and not isinstance(source.source, LiveScene):
                other["guided"] = more(10, quarter, integrator="guided")
            other["adaptive"] = more(11, quarter, adaptive=True)
        return SceneData(scene.name, samples, scene.regions, **other), more(1, half)

    def _rendered(
        self, scene: Scene, settings: Mapping[str, Any], *, film: bool = False
    ) -> Samples:
        out = None
        if self.folder is not None:
            named = {n: settings[n] for n in ("max_depth", "seed", "size")} | dict(settings)
            del named["spp"]
            digest = digest_of((scene.hash, list(named.items())))
            out = self.folder / f"{scene.name}-{digest}.zarr"
            done = _finished(out, scene, settings["spp"])
            if done is not None:
                return done
        about: Any = {"backend": self.backend, "progress": self.progress}
        return render(scene, **settings, out=out, film=film, **about)

    def cache(self, samples: Samples) -> Cache:
        """Return the cache of results from samples; for samples in memory, there is none."""
        return Cache(self.folder, cache_key(samples))

    def analysis(self, samples: Samples) -> xr.Dataset:
        """Return the result of `chdstat.analyze`, from the cache if possible."""

        def analysed(checkpoint: Path | None) -> xr.Dataset:
            return analyze(at_hand(samples), progress=self.progress, checkpoint=checkpoint)

        return self._dataset(samples, "analysis", analysed)

    def summary(self, samples: Samples) -> xr.Dataset:
        """Return the result of `chdstat.summarize`, from the cache if possible."""
        return self._dataset(
            samples, "summary", lambda _: summarize(samples, progress=self.progress)
        )

    def _dataset(
        self, samples: Samples, name: str, compute: Callable[[Path | None], xr.Dataset]
    ) -> xr.Dataset:
        """Return maps, in files where there is a folder: they may be larger than memory."""
        import xarray as xr

        cache, key = self.cache(samples), f"dataset.{name}"
        folder = cache.folder

        def read(path: Path) -> xr.Dataset:
            # Without chunks: with Dask it would take three times as long.
            how: Any = {"engine": "zarr", "consolidated": False, "chunks": None, "cache": False}
            with xr.open_dataset(path, **how) as kept:
                variables = {}
                for name, variable in kept.data_vars.items():
                    held = room(variable.shape, variable.dtype, folder)
                    held[...] = variable.values
                    release(held)
                    variables[name] = (variable.dims, held, variable.attrs)
                return xr.Dataset(variables, kept.coords.copy(deep=True), kept.attrs)

        dataset = cache.read(key, read)
        if dataset is None:
            with kept_until_written(folder and folder / f"{cache_key(samples)}.{name}") as kept:
                dataset = computed = compute(kept)
                cache.write(key, lambda path: save(computed, path))
        return dataset

    def comparison(
        self, samples: Samples, estimators: Sequence[str | Entry] | None, labels: xr.DataArray
    ) -> Comparison:
        """Return the result of `chdstat.compare`; models trained on these samples are reused.

        Raises
        ------
        InputError
            If the samples cannot judge the estimators.
        """
        cache, named = self.cache(samples), DEFAULT_ESTIMATORS if estimators is None else estimators
        entries = [without_denoiser(entry_of(name)) for name in named]
        learned = [e.name for e in entries if isinstance(e, LearnedEstimator)]
        files = {name: f"{name}{self.iterations or ''}.safetensors" for name in learned}
        there = {name: cache.read(file, load_model) for name, file in files.items()}
        trained = {name: model for name, model in there.items() if model is not None}
        for name in learned if self.iterations else ():
            if name not in trained:
                how: Any = {"iterations": self.iterations, "progress": self.progress}
                trained[name] = train_model(at_hand(samples), name, **how)
                cache.write(files[name], trained[name].save)
        models: dict[str, Model] = {**trained}

        def compared() -> Comparison:
            comparison = compare(
                at_hand(samples),
                estimators,
                n=_N,
                model=trained,
                labels=labels,
                progress=self.progress,
            )
            models.update(comparison.models)
            for name, model in comparison.models.items():
                if name not in trained and isinstance(model, TrainedModel):
                    cache.write(files[name], model.save)
            return replace(comparison, models={})  # a record holds no network

        inputs = (self.iterations, *(entry_of(name).name for name in named))
        again = not set(learned) <= {n for n, model in there.items() if model is not None}
        comparison = cache.record("comparison", Comparison, compared, inputs=inputs, again=again)
        return replace(comparison, models=models)


def at_hand(samples: Samples) -> Samples:
    """Return samples in memory if they are few; others are read in blocks."""
    return samples.load() if samples.nbytes <= _IN_MEMORY else samples


def _finished(path: Path, scene: Scene, spp: int) -> Samples | None:
    """Return the samples of a store that is already complete; None for any other."""
    if not path.exists():
        return None
    try:
        samples = open_samples(path)
    except StoreError:
        return None  # `render` resumes it, or says what is wrong
    # The code of plugins is known to the renderer only, which compares it before it appends.
    plugins = samples.attrs.get("scene_code") or samples.attrs.get("plugins")
    same = samples.attrs.get("scene_hash") == scene.hash and not plugins
    return samples if same and samples.attrs.get("spp", samples.spp) >= spp else None


def _variants(scene: Scene, samples: Samples) -> dict[str, Scene]:
    """Return the scene with integrators that sample paths in other ways; none for a file."""
    used, source = dict(samples.attrs["integrator"]), scene.source
    kinds = ("path", "volpath")
    if used.get("type") not in kinds or not isinstance(source, Mapping):
        return {}

    def by(integrator: Mapping[str, Any], source: Mapping[str, Any] = source) -> Scene:
        others = {
            name: value
            for name, value in source.items()
            if not (isinstance(value, Mapping) and value.get("type") in kinds)
        }
        return Scene(scene.name, {**others, "integrator": dict(integrator)})

    found = {} if used.get("rr_depth") == ROULETTE else {_EARLY: by({**used, "rr_depth": ROULETTE})}
    found["no roulette"] = by({**used, "rr_depth": _NEVER})
    unsampled = without_emitter_sampling(source)
    if unsampled is not None:
        found[BSDF_SAMPLING] = by(used, unsampled)
    if used["type"] == "path":
        for name, (emitters, bsdfs) in _DIRECT.items():
            found[name] = by({"type": "direct", "emitter_samples": emitters, "bsdf_samples": bsdfs})
    return found


def without_emitter_sampling(source: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return a scene whose lights are found by BSDF sampling alone; None if that misses some.

    Lights of weight 0 are never sampled, and multiple importance sampling knows. Mitsuba
    refuses a scene with these alone, so that one light is sampled that has no radiance.
    """
    changed = dict(source)
    for name, value in source.items():
        if not isinstance(value, Mapping):
            continue
        if value.get("type") in _POINTS:
            return None
        if isinstance(light := value.get("emitter"), Mapping):
            changed[name] = {**value, "emitter": {**light, "sampling_weight": 0.0}}
        if value.get("type") in ("constant", "envmap"):
            changed[name] = {**value, "sampling_weight": 0.0}
    black = {"type": "area", "radiance": {"type": "rgb", "value": 0.0}}
    return {**changed, "sampled-light": {"type": "sphere", "radius": 1e-6, "emitter": black}}
