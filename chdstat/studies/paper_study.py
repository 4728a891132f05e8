"""The paper's experiment: its scenes, their distributions, and its network as published.

`paper` studies the four scenes of Elek, Thomas and Forbes 2019 and trains a network on each, as
published or with some of `chdstat.estimators.elek2019.CHOICES` changed. Its result typesets all
figures and tables of the paper.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Array, generator, plain, whole
from chdstat._core.display import Card, Tabled, duration, number, percent
from chdstat._core.doors import report
from chdstat._core.files import checked_target
from chdstat._core.progress import portion, track
from chdstat._core.resampling import Interval
from chdstat.comparison import PixelEstimates
from chdstat.comparison.judges import Judge, PartialSums
from chdstat.comparison.judging import Units, measures_of_image
from chdstat.errors import InputError, check_option
from chdstat.estimators.elek2019 import CHOICES, MLP, PAPER, Preset, as_published
from chdstat.estimators.held_out import draw_pixels
from chdstat.estimators.training import History
from chdstat.rendering.backend import Backend
from chdstat.rendering.recipes import find_recipe
from chdstat.samples import Samples
from chdstat.scenes import BUILTIN, REMAKES
from chdstat.studies.claims.whole_image import brightest_firefly
from chdstat.studies.stores import SHORT, Stores, StudyScene, at_hand, scenes_of
from chdstat.studies.studies import SceneStudy, Study, studied

SCENES = {title: name for name, title in REMAKES.items()}
"""Built-in scenes in place of the paper's, by the names that these have there."""
_REAL = {
    "Bathroom": "real-bathroom",
    "WhiteRoom": "real-white-room",
    "NightRoom": "real-night-room",
}
"""Recipes of the paper's own scenes. MeasureOne was in PBRT's distribution; there is no version of
it in a format that Mitsuba reads."""
RESULTS = ("Bathroom", "MeasureOne")
"""Scenes of the figures on the network."""
_FIVE = SHORT + 3
"""Longest path of MeasureOne, in segments: the paper compares five bounces with two there."""
BATCH, BATCHES, PIXELS, EVALUATED = 32, 64, 5, 25
"""Samples of an estimate; batches and pixels of the first figure; pixels of the last one."""


@dataclass(frozen=True)
class Extent:
    """Size of the experiment.

    Attributes
    ----------
    edge
        Pixels along the longer edge of an image.
    spp
        Samples per pixel.
    iterations
        Minibatches of a training.
    """

    edge: int
    spp: int
    iterations: int


PUBLISHED = Extent(800, 2048, 30_000)
"""The paper's: 64 batches of 32 samples are its "2k"."""
_FULL = Extent(128, 2048, 30_000)
_QUICK = Extent(40, 2048, 3000)


@dataclass(frozen=True)
class TrainedNetwork:
    """The paper's network trained on a scene, and its estimate from the first samples.

    Attributes
    ----------
    estimate
        Shape (y, x, channel).
    history
        Rows of `chdstat.estimators.training.History`: of several networks, their mean.
    pixels
        Pixels that trained, rows (y, x).
    training_seconds, seconds
        Time of all of the training, and of the estimate of the image.
    """

    estimate: npt.NDArray[np.float32]
    history: npt.NDArray[np.float64]
    pixels: npt.NDArray[np.int64]
    training_seconds: float
    seconds: float

    @property
    def losses(self) -> History:
        """How the training went."""
        return History(*self.history.T)


@dataclass(frozen=True)
class PaperScene:
    """One of the paper's scenes, or a remake in its place.

    Attributes
    ----------
    title
        Name of the scene in the paper.
    study
        What a study found in it.
    network
        The network, as published or with changes.
    changed
        Names of the changed choices.
    """

    title: str
    study: SceneStudy
    network: TrainedNetwork
    changed: tuple[str, ...] = ()

    @property
    def samples(self) -> Samples:
        """Samples of the image."""
        return self.study.data.samples

    @cached_property
    def batch(self) -> npt.NDArray[np.float32]:
        """The samples that are estimated from, shape (y, x, channel, sample)."""
        return self.samples.read(ss=slice(BATCH))

    @cached_property
    def mean(self) -> npt.NDArray[np.float64]:
        """Mean of these samples."""
        return np.asarray(self.batch.mean(axis=-1, dtype=np.float64))

    @cached_property
    def sums(self) -> PartialSums:
        """Sums over all samples."""
        return PartialSums.of(self.samples)

    @property
    def truth(self) -> npt.NDArray[np.float64]:
        """Mean of all samples."""
        return self.sums.mean

    def errors(self, *, published: bool) -> dict[str, Interval[Array]]:
        """Return the errors of the network, judged as published or as comparisons here judge.

        Returns
        -------
        dict
            Measures as of `chdstat.compare`; empty if no pixel can judge.
        """
        test = np.ones(self.samples.shape[:2], np.bool_)
        if published:
            truth = Judge.of_image(
                np.stack([self.truth] * 4), np.zeros_like(self.truth), self.sums.scene_mean
            )
        else:
            truth = self.sums.judge(self.batch)
            test[tuple(self.network.pixels.T)] = False
        if not (test & np.isfinite(truth.mean).all(axis=-1)).any():
            return {}
        images = [self.network.estimate]
        return measures_of_image(images, self.mean, truth, Units.of(test), self.sums.scene_mean)

    @property
    def ours(self) -> dict[str, Interval[Array]]:
        """Errors of the library's own network, as its comparison has them."""
        found = self.study.comparison
        if found is None:
            return {}
        row = found.estimators.index(PAPER)
        return {name: measure[row : row + 1] for name, measure in found.measures.items()}

    def drawn_pixels(self) -> PixelEstimates:
        """Return random pixels with their estimates, as in the paper's numerical evaluation."""
        height, width = self.samples.shape[:2]
        flat = generator(0).permutation(height * width)[:EVALUATED]
        ys, xs = np.unravel_index(np.sort(flat), (height, width))
        return PixelEstimates(
            pixels=np.stack([ys, xs], axis=-1),
            estimators=(PAPER,),
            channels=self.samples.channels,
            reference=self.truth[ys, xs],
            mean=self.mean[ys, xs].astype(np.float32),
            estimates=self.network.estimate[np.newaxis, ys, xs],
            n=BATCH,
        )

    def firefly(self) -> tuple[int, int, int] | None:
        """Return row, column and batch of the brightest firefly; None without any."""
        return brightest_firefly(self.study.data.batch_light)


@dataclass(frozen=True, repr=False)
class PaperStudy(Tabled):
    """What the paper's experiment gave here.

    Attributes
    ----------
    scenes
        The scenes in the order of the paper.
    study
        The study of all of them, with the verdicts on claims.
    scale
        Size of the experiment.
    changed
        Names of the choices in which the network is not as published.
    """

    scenes: tuple[PaperScene, ...]
    study: Study
    scale: Extent
    changed: tuple[str, ...] = ()

    def table(self) -> list[dict[str, Any]]:
        """Return a row for each scene and way to train and judge, with errors over the mean's."""
        name = "as published" + f", but for {', '.join(self.changed)}" * bool(self.changed)
        rows = []
        for scene in self.scenes:
            ways = {
                (name, "as published"): scene.errors(published="judging" not in self.changed),
                (name, "as here"): scene.errors(published=False),
                ("as here", "as here"): scene.ours,
            }
            for (network, judged), found in ways.items():
                row: dict[str, Any] = {"scene": scene.title, "network": network, "judged": judged}
                for measure in ("mse_ratio", "relmse_ratio", "improved", "fireflies_left"):
                    one = found.get(measure)
                    ends = ("value", "low", "high")
                    values = [float(getattr(one, e)[0, -1]) if one else np.nan for e in ends]
                    row |= dict(zip((measure, f"{measure}_low", f"{measure}_high"), values,
                                    strict=True))  # fmt: skip
                rows.append(row)
        return rows

    def _card(self) -> Card:
        seconds = self.study.provenance.get("seconds")
        facts = {} if seconds is None else {"time": duration(float(seconds))}
        return Card("The paper's experiment", facts, self._shown_rows())

    def _shown_rows(self) -> list[dict[str, str]]:
        return [
            {
                **{name: row[name] for name in ("scene", "network", "judged")},
                "squared error": shown(row, "mse_ratio", number),
                "improved": shown(row, "improved", percent),
            }
            for row in self.table()
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return everything but arrays, ready for JSON; NaN and infinity are None."""
        return {
            "scale": plain(vars(self.scale)),
            "changed": list(self.changed),
            "errors": plain(self.table()),
            "study": self.study.to_dict(),
        }

    def save_pdf(self, path: str | Path) -> Path:
        """Typeset all figures and tables of the paper.

        Raises
        ------
        InputError
            If the path does not end in .pdf, or nothing can be written there.
        ChdstatError
            If it cannot be typeset or written.
        """
        return report(self, checked_target(path, ".pdf"))


def shown(row: Mapping[str, Any], name: str, write: Callable[..., str]) -> str:
    """Return a measure of a row of `PaperStudy.table` with its interval."""
    ends = Interval(row[name], row[f"{name}_low"], row[f"{name}_high"])
    return ends.shown(write)


def paper(
    folder: str | Path | None = None,
    *,
    scenes: str | Path | None = None,
    only: Sequence[str] | None = None,
    quick: bool = False,
    changed: Sequence[str] = (),
    edge: int | None = None,
    spp: int | None = None,
    iterations: int | None = None,
    backend: Backend = "auto",
    progress: bool = True,
) -> PaperStudy:
    """Repeat the experiment of the paper: its scenes, distributions, network and claims.

    Parameters
    ----------
    folder
        Folder for renders, networks and findings, from which a stopped run goes on; None keeps
        everything in memory.
    scenes
        Folder with scenes of the paper, ``bathroom/`` and ``white-room/``, as the recipes
        ``renders/real-*.toml`` name their files. Built-in remakes take the place of those that are
        not there; MeasureOne is always one.
    only
        Names of the paper's scenes, for a part of the experiment; None takes all four.
    quick
        Small images and a tenth of the training, for a first look: minutes.
    changed
        Names of `chdstat.estimators.elek2019.CHOICES` in which the network is not as published.
    edge, spp, iterations
        Pixels along the longer edge of images, samples per pixel, and minibatches of a training;
        None takes 128, 2048 and 30,000. The paper's images are 800 pixels wide.
    backend, progress
        As for `chdstat.render`.

    Returns
    -------
    PaperStudy
        With `PaperStudy.table` of errors, and `PaperStudy.save_pdf`.

    Raises
    ------
    InputError
        If a choice or a scene is unknown, `scenes` holds none of the paper's, or a number is out of
        range.
    SceneError, RenderError, StoreError
        As for `chdstat.study`.

    References
    ----------
    O. Elek, M. M. Thomas, A. Forbes, "Learning Patterns in Sample Distributions for Monte Carlo
    Variance Reduction", 2019.
    """
    for name in changed:
        check_option("changed", name, CHOICES)
    titles = list(SCENES if only is None else only)
    for title in titles:
        check_option("only", title, SCENES)
    usual, given = _QUICK if quick else _FULL, {"edge": edge, "spp": spp, "iterations": iterations}
    asked = {n: whole(n, v, least=1) for n, v in given.items() if v is not None}
    scale = replace(usual, **asked)
    if scale.spp < 2 * BATCH:
        message = f"spp must be at least {2 * BATCH}, two estimates of the network, got {scale.spp}"
        raise InputError(message)
    chosen = dict(zip(titles, _scenes(titles, scenes, scale), strict=True))
    stores = Stores(
        None if folder is None else Path(folder), backend, progress, "multijitter",
        iterations=scale.iterations,
    )  # fmt: skip
    with track("repeating the paper", 2, show=progress) as advance:
        with portion(1, advance):
            study = studied(list(chosen.values()), stores, ["mean", PAPER])
        networks = []
        for one in study.scenes:
            with portion(1 / len(titles), advance):
                networks.append(_network(one.data.samples, stores, changed, scale.iterations))
    found = zip(titles, study.scenes, networks, strict=True)
    parts = tuple(PaperScene(*part, tuple(changed)) for part in found)
    return PaperStudy(parts, study, scale, tuple(changed))


def _scenes(
    titles: Sequence[str], folder: str | Path | None, scale: Extent
) -> tuple[StudyScene, ...]:
    """Return the scenes by these titles, real ones where the folder has them."""
    recipes = []
    for title in titles:
        own = find_recipe(_REAL[title], folder) if folder and title in _REAL else None
        recipe = own if own and Path(own.scene).is_file() else find_recipe(SCENES[title])
        assert recipe is not None, "each of them has a recipe"
        longest = scale.edge / max(recipe.size)
        width, height = (max(1, round(length * longest)) for length in recipe.size)
        depth = _FIVE if title == RESULTS[-1] else recipe.max_depth
        recipes.append(replace(recipe, size=(width, height), spp=scale.spp, max_depth=depth))
    real = [_REAL[title] for title in titles if title in _REAL]
    if folder and real and all(recipe.scene in BUILTIN for recipe in recipes):
        wanted = [find_recipe(name, folder) for name in real]
        named = ", ".join(recipe.scene for recipe in wanted if recipe)
        message = f"expected one of the paper's scenes at least, {named}, got none of them"
        raise InputError(message)
    return scenes_of(recipes, {})


def _network(
    samples: Samples, stores: Stores, changed: Sequence[str], iterations: int
) -> TrainedNetwork:
    """Return the network of a scene, trained as published but for what is changed."""
    config, each = as_published(*changed), "channels" in changed
    return stores.cache(samples).record(
        "paper",
        TrainedNetwork,
        lambda: _trained(at_hand(samples), config, iterations, each=each, progress=stores.progress),
        inputs=(config, iterations, each),
    )


def _trained(
    samples: Samples, config: Preset, iterations: int, *, each: bool, progress: bool
) -> TrainedNetwork:
    """Train one network, or one for `each` channel, and estimate from the first samples."""
    pixels = draw_pixels(samples.shape[:2], config.pixels, seed=0, spare=config.spare)
    batch, start = samples.read(ss=slice(BATCH)), time.perf_counter()
    parts = [slice(i, i + 1) for i in range(batch.shape[2])] if each else [slice(None)]
    models = []
    for part in parts:
        image = samples
        if each:
            image = Samples.from_array(samples.read()[:, :, part], scene=samples.name)
        options: Any = {"iterations": iterations, "pixels": pixels, "progress": progress}
        models.append(MLP(config).train(image, **options))
    trained = time.perf_counter()
    images = [model.predict(batch[:, :, part]) for model, part in zip(models, parts, strict=True)]
    done = time.perf_counter()
    length = min(len(model.state.history) for model in models)
    history = np.mean([model.state.history[:length] for model in models], axis=0)
    times = trained - start, done - trained
    return TrainedNetwork(np.concatenate(images, axis=-1), history, pixels, *times)
