"""The progressive estimator: a pixel's radiance from any number of its samples, and how sure it is.

>>> from chdstat.estimators import Progressive
>>> model = Progressive()  # then model.train(samples), where there is a reference
>>> alone = Progressive(neighbours=True)  # then alone.train(samples, reference=False)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

import chdstat
from chdstat._arrays import as_samples, generator
from chdstat.errors import InputError, StoreError
from chdstat.estimators._modelfile import read_model, write_model
from chdstat.estimators._rows import check_pixels
from chdstat.estimators.classical import mean_of_good
from chdstat.estimators.heldout import Totals
from chdstat.estimators.progressive.application import apply, with_means
from chdstat.estimators.progressive.exposure import picture_unit
from chdstat.estimators.progressive.lessons import (
    Material,
    Scenery,
    ask,
    scenery_of,
    with_reference,
    without_reference,
)
from chdstat.estimators.progressive.profiles import Profile
from chdstat.estimators.progressive.results import Estimates, Learned
from chdstat.estimators.progressive.shapes import Shape
from chdstat.estimators.progressive.spread import Spread
from chdstat.estimators.training import History
from chdstat.progress import track
from chdstat.samples import Samples

__all__ = ["Progressive"]

Array = npt.NDArray[Any]
Features = Mapping[str, Array]

_VALIDATION_SHARE = 0.1


class Progressive:
    """A network that reweighs the samples of a pixel octave by octave of their luminance.

    It takes any number of samples in any order, all channels together, and scales with their unit.
    Its estimate is the mean, moved towards what it proposes by ``n0 / (n0 + N)``; n0, the number of
    samples that its experience is worth, is part of its answer. So it tends to the mean as N grows,
    and is the mean where it has learned nothing.

    With a reference it learns two answers, one for the least MSE and one for the least relMSE;
    `balance` mixes them. Without one it learns from halves of each pixel's own samples, whose
    expectation is the truth: then every answer is unbiased, and `balance` makes little difference.

    Parameters
    ----------
    features
        Whether it looks at what the camera rays hit: albedo, normal, depth and position.
    neighbours
        Whether it looks at the pixels around, too: at their profiles, and at what `shared_patches`
        makes of those that are alike. Only without a reference.

    References
    ----------
    Weights of luminance layers: T. Zirr, J. Hanika and C. Dachsbacher, "Re-weighting firefly
    samples for improved finite-sample Monte Carlo estimates", Computer Graphics Forum 37(6), 2018,
    doi:10.1111/cgf.13335. Training without a reference: J. Lehtinen et al., "Noise2Noise: learning
    image restoration without clean data", ICML 2018. The network and its certainty are ours.

    Examples
    --------
    >>> import chdstat as chd
    >>> rng = np.random.default_rng(0)
    >>> radiance = rng.lognormal(size=(32, 32, 1, 1))
    >>> samples = chd.Samples.from_array(radiance * rng.exponential(size=(32, 32, 1, 64)))
    >>> model = Progressive().train(samples, iterations=20, progress=False)
    >>> found = model.estimate(samples.read(ss=slice(0, 6)))
    >>> found.radiance.shape, found.certainty.shape, bool((found.low <= found.high).all())
    ((32, 32, 1), (32, 32), True)
    """

    name = "progressive"

    def __init__(self, *, features: bool = False, neighbours: bool = False) -> None:
        self.features = features
        self.neighbours = neighbours
        self._learned: Learned | None = None

    def __repr__(self) -> str:
        sees = [name for name in ("features", "neighbours") if getattr(self, name)]
        known = "untrained" if self._learned is None else f"scene {self.provenance['scene']!r}"
        return f"<Progressive {', '.join([*sees, known])}>"

    @property
    def unit(self) -> float:
        """Mean radiance of the picture that it was trained on."""
        return self._state.unit

    @property
    def channels(self) -> int:
        """Channels of the samples that it takes."""
        return self._state.network.shape.channels

    @property
    def train_pixels(self) -> npt.NDArray[np.int64]:
        """Pixels that it was trained on, rows (y, x)."""
        return self._state.train_pixels

    @property
    def train_shape(self) -> tuple[int, int]:
        """Height and width of the picture that it was trained on."""
        return self._state.train_shape

    @property
    def history(self) -> History:
        """How the training went; losses are in units of what the sample mean loses on average."""
        return History(*self._state.history.T)

    @property
    def provenance(self) -> dict[str, Any]:
        """Where it comes from: scene, seed, pixels, iterations, chdstat version."""
        return dict(self._state.provenance)

    def train(
        self,
        samples: Samples,
        *,
        reference: bool = True,
        seed: int = 0,
        sizes: Sequence[int] | None = None,
        iterations: int | None = None,
        pixels: npt.ArrayLike | None = None,
        progress: bool | None = None,
    ) -> Self:
        """Train on a picture, with a reference or on the very samples that it is to estimate from.

        Parameters
        ----------
        samples
            The picture. Pixels with a bad sample are left out and counted.
        reference
            True takes the other samples of a pixel for the truth, which needs many more than the
            numbers of samples that will be estimated from. False learns from splits of the samples.
        seed
            Draws the pixels, the first weights and the minibatches.
        sizes
            With a reference, the numbers of samples to learn from; None for 4 to 512. Fewer of them
            are learned a little better; others can be estimated from all the same.
        iterations
            Minibatches; None for 6000 with a reference and 2000 without.
        pixels
            With a reference, train on these, rows (y, x), and draw none.
        progress
            Show a progress bar; None shows it on a terminal.

        Returns
        -------
        Progressive
            Itself, trained.

        Raises
        ------
        InputError
            If there are too few samples or good pixels, an option does not fit the others, or the
            picture has no features where they are wanted.
        """
        if iterations is not None and iterations < 1:
            message = f"iterations must be at least 1, got {iterations}"
            raise InputError(message)
        if reference and self.neighbours:
            message = "neighbours=True learns without a reference: train(samples, reference=False)"
            raise InputError(message)
        if not reference and (pixels is not None or sizes is not None):
            message = "pixels and sizes are for training with a reference; without one, all train"
            raise InputError(message)
        features = self._features_of(samples)
        unit = picture_unit(_means(samples))
        if reference:
            chosen = None if pixels is None else np.unique(np.asarray(pixels, np.int64), axis=0)
            material = with_reference(
                samples,
                chosen,
                features=features,
                unit=unit,
                sizes=sizes,
                iterations=iterations,
                seed=seed,
            )
        else:
            material = without_reference(
                samples.read(),
                features=features,
                neighbours=self.neighbours,
                unit=unit,
                iterations=iterations,
                rng=generator(seed),
            )
        self._learned = self._learn(samples, material, unit, seed=seed, progress=progress)
        return self

    def predict(
        self,
        x: npt.ArrayLike,
        *,
        features: Features | None = None,
        balance: float = 0.5,
        unit: float | None = None,
    ) -> npt.NDArray[np.float32]:
        """Estimate radiance; as `estimate`, without certainty and interval.

        Returns
        -------
        ndarray
            Shape (..., channel).
        """
        return self._estimate(x, features, balance, unit, level=None).radiance

    def estimate(
        self,
        x: npt.ArrayLike,
        *,
        features: Features | None = None,
        balance: float = 0.5,
        unit: float | None = None,
        level: float = 0.9,
    ) -> Estimates:
        """Estimate radiance, with certainty and interval.

        Parameters
        ----------
        x
            Samples, shape (..., channel, sample), any number of them; a picture (y, x, channel,
            sample) where it looks at features or neighbours. A sample of which any channel is NaN,
            infinite or negative is left out.
        features
            First-hit features of the picture.
        balance
            0 for the least MSE, 1 for the least relMSE, and what lies between.
        unit
            Mean radiance of the picture that `x` is a part of; None measures it on `x`.
        level
            Probability of the interval.

        Raises
        ------
        InputError
            If it is not trained, `x` has another number of channels or is no picture where it must
            be, features are missing, or an option is out of range.
        """
        if not 0 < level < 1:
            message = f"level must lie between 0 and 1, got {level}"
            raise InputError(message)
        return self._estimate(x, features, balance, unit, level=level)

    def of_profile(
        self,
        profile: Profile,
        *,
        features: Features | None = None,
        balance: float = 0.5,
        level: float = 0.9,
    ) -> Estimates:
        """Estimate from profiles, which `Stream` keeps in place of samples.

        Raises
        ------
        InputError
            As for `estimate`; or if it looks at neighbours, which need samples.
        """
        if self.neighbours:
            message = "an estimator that looks at neighbours needs the samples, not their profiles"
            raise InputError(message)
        self._check(profile.channels, balance)
        shape = profile.count.shape
        rows = profile.reshape(-1)
        return apply(
            self._state,
            lambda part: rows[part],
            self._scenery(features, shape, None),
            None,
            shape=shape,
            balance=balance,
            level=level,
        )

    def save(self, path: str | Path) -> None:
        """Write the trained network and its provenance to a safetensors file.

        Raises
        ------
        InputError
            If nothing was trained yet.
        StoreError
            If the file cannot be written.
        """
        state = self._state
        about = {
            "kind": "progressive",
            "shape": state.network.shape.to_dict(),
            "features": self.features,
            "unit": state.unit,
            "train_shape": state.train_shape,
            "provenance": state.provenance,
        }
        arrays: dict[str, Array] = {
            f"network.{name}": w for name, w in state.network.to_arrays().items()
        }
        arrays |= {f"spread.{name}": a for name, a in vars(state.spread).items()}
        arrays |= {"history": state.history, "train_pixels": state.train_pixels}
        write_model(Path(path), arrays, about)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a trained network; this runs no code from the file.

        Raises
        ------
        StoreError
            If there is no such file, it is damaged, or it holds something else.
        """
        from chdstat.estimators.progressive.network import Network

        arrays, about = read_model(Path(path))
        if about.get("kind") != "progressive":
            message = f"{path} holds a model of kind {about.get('kind')!r}, not 'progressive'"
            raise StoreError(message)
        try:
            network = Network(Shape(**about["shape"]))
            network.load_arrays(_below("network.", arrays))
            learned = Learned(
                network=network.eval(),
                spread=Spread(**_below("spread.", arrays)),
                unit=float(about["unit"]),
                history=arrays["history"],
                train_pixels=arrays["train_pixels"],
                train_shape=(int(about["train_shape"][0]), int(about["train_shape"][1])),
                provenance=dict(about["provenance"]),
            )
        except (KeyError, IndexError, TypeError, ValueError) as error:
            message = f"{path} does not hold a whole network ({error!r}); train or copy it again"
            raise StoreError(message) from error
        model = cls(features=bool(about["features"]), neighbours=network.shape.neighbours)
        model._learned = learned
        return model

    @property
    def _state(self) -> Learned:
        if self._learned is None:
            message = f"{self.name} is not trained yet; call train(samples) or load(path)"
            raise InputError(message)
        return self._learned

    def _features_of(self, samples: Samples) -> Features | None:
        if not self.features:
            return None
        if not samples.features:
            message = "this picture has no first-hit features; render it, or pass features=False"
            raise InputError(message)
        return samples.features

    def _learn(
        self, samples: Samples, material: Material, unit: float, *, seed: int, progress: bool | None
    ) -> Learned:
        import torch

        from chdstat.estimators.progressive.network import Network
        from chdstat.estimators.progressive.training import learn

        count = len(material.pixels)
        if count < 2:
            message = (
                f"training needs at least 2 pixels without a bad sample, got {count}; give a "
                "larger picture"
            )
            raise InputError(message)
        rng = generator(seed).spawn(1)[0]
        order = rng.permutation(count)
        watching = max(1, round(count * _VALIDATION_SHARE))
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            network = Network(
                Shape(
                    channels=samples.shape[2],
                    described=material.scenery.described.shape[1],
                    neighbours=self.neighbours,
                )
            )
        with track("training", material.lesson.iterations, unit="it", show=progress) as advance:
            history = learn(
                network,
                material,
                train=order[watching:],
                validation=order[:watching],
                rng=rng,
                advance=advance,
            )
        spread = Spread.learn(network, material, pixels=order[:watching], rng=rng)
        provenance = {
            "scene": samples.name,
            "samples": samples.attrs,
            "samples_shape": list(samples.shape),
            "reference": material.lesson.reference,
            "features": self.features,
            "neighbours": self.neighbours,
            "seed": seed,
            "pixels_used": count,
            "pixels_excluded": material.excluded,
            "sizes": sorted(set(material.lesson.sizes)),
            "iterations": material.lesson.iterations,
            "chdstat": chdstat.__version__,
        }
        return Learned(
            network, spread, unit, history, material.pixels, samples.shape[:2], provenance
        )

    def _estimate(
        self,
        x: npt.ArrayLike,
        features: Features | None,
        balance: float,
        unit: float | None,
        *,
        level: float | None,
    ) -> Estimates:
        samples = as_samples(x)
        if samples.ndim < 2:
            message = f"x must have shape (..., channel, sample), got {samples.shape}"
            raise InputError(message)
        *shape, channels, n = samples.shape
        self._check(channels, balance)
        unit = picture_unit(mean_of_good(samples)) if unit is None else unit
        profile, asked = None, None
        if self.neighbours:
            check_pixels(samples, picture=True)
            profile = Profile.of(samples, unit=unit)
            asked = ask(samples) / np.float32(unit)
        rows = samples.reshape(-1, channels, n)
        found = apply(
            self._state,
            lambda part: Profile.of(rows[part], unit=unit),
            self._scenery(features, tuple(shape), profile),
            asked,
            shape=tuple(shape),
            balance=balance,
            level=level,
        )
        return with_means(found, samples)

    def _check(self, channels: int, balance: float) -> None:
        if channels != self.channels:
            message = (
                f"the model was trained on samples with {self.channels} channels, got {channels}; "
                "train one for these"
            )
            raise InputError(message)
        if not 0 <= balance <= 1:
            message = f"balance must lie between 0 (MSE) and 1 (relMSE), got {balance}"
            raise InputError(message)

    def _scenery(
        self, features: Features | None, shape: tuple[int, ...], profile: Profile | None
    ) -> Scenery:
        if not (self.features or self.neighbours):
            return Scenery.nothing(int(np.prod(shape)))
        if len(shape) != 2:
            message = f"features belong to a picture (y, x, channel, sample), got pixels {shape}"
            raise InputError(message)
        found = scenery_of(features if self.features else None, (shape[0], shape[1]), profile)
        wanted = self._state.network.shape.described
        if found.described.shape[1] != wanted:
            message = (
                f"the model looks at {wanted} numbers of the first hit, but these features give "
                f"{found.described.shape[1]}; pass features= as it was trained with"
            )
            raise InputError(message)
        return found


def _means(samples: Samples) -> Array:
    """Return the means of all pixels, shape (y, x, channel)."""
    return Totals.of(samples).mean()


def _below(prefix: str, arrays: Mapping[str, Array]) -> dict[str, Array]:
    return {k.removeprefix(prefix): a for k, a in arrays.items() if k.startswith(prefix)}
