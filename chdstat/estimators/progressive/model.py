"""The progressive estimator: a pixel's radiance from any number of its samples, and how sure it is.

>>> from chdstat.estimators import Progressive
>>> model = Progressive()  # then model.train(samples), where there is a reference
>>> alone = Progressive(inputs=["neighbours"])  # alone.train(samples): it needs no reference
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import generator
from chdstat._core.image_scales import mean_radiance
from chdstat.errors import InputError
from chdstat.estimators.progressive.dataset import (
    TrainingImage,
    chosen_pixels,
    with_reference,
    without_reference,
)
from chdstat.estimators.progressive.inputs import Input, InputConfig
from chdstat.estimators.progressive.learned import (
    Estimates,
    Learned,
    Origin,
    read_learned,
    write_learned,
)
from chdstat.estimators.progressive.prediction import (
    PredictionInput,
    estimate_input,
    estimate_profiles,
    share_of_input,
    share_of_profiles,
)
from chdstat.estimators.progressive.profile import Profile
from chdstat.estimators.training import History
from chdstat.estimators.validation import direct_of
from chdstat.samples import Samples

__all__ = ["Progressive"]

Array = npt.NDArray[Any]
Features = Mapping[str, Array]


class Progressive:
    """A network that reweighs the samples of a pixel octave by octave of their luminance.

    It takes any number of samples in any order, all channels together, and scales with their unit.
    Its estimate is the mean, moved towards what it proposes by ``n0 / (n0 + N)``; n0, the number of
    samples that its experience is worth, is predicted, too. So it tends to the mean as N grows,
    and is the mean where it has learned nothing.

    With a reference it learns two estimates, one for the least MSE and one for the least relMSE;
    `balance` mixes them. Without one it learns from halves of each pixel's own samples, whose
    expectation is the truth: then every estimate is unbiased, and `balance` matters little.
    How far it is then followed is measured on pixels that did not train it, so that an image which
    does not help it keeps its means.

    Where all samples of a pixel are the same light, as those of a lamp, their mean is kept.

    Parameters
    ----------
    inputs
        What it sees beside the samples of a pixel, any of: "features", what the camera rays hit
        (albedo, normal, depth and position); "neighbours", the profiles of the pixels around and
        what `shared_patches` makes of those that are similar, which is learned without a
        reference; "direct", direct and indirect light separately, as `chdstat.render` tells them
        with ``direct=True``: light that comes seldom is then known to be indirect.

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

    def __init__(self, *, inputs: Iterable[Input] = ()) -> None:
        self.inputs = InputConfig.of(inputs)
        self._learned: Learned | None = None

    def __repr__(self) -> str:
        known = "untrained" if self._learned is None else f"scene {self.provenance['scene']!r}"
        return f"<Progressive {', '.join([*self.inputs.names, known])}>"

    @property
    def unit(self) -> float:
        """Mean radiance of the image that it was trained on, as of `mean_radiance`.

        Of several images it is the geometric mean of theirs.
        """
        return self._state.unit

    @property
    def channels(self) -> int:
        """Channels of the samples that it takes."""
        return self._state.network.architecture.channels

    @property
    def train_pixels(self) -> npt.NDArray[np.int64]:
        """Pixels that it was trained on in images of `train_shape`, rows (y, x)."""
        return self.seen(self.train_shape)

    @property
    def train_shape(self) -> tuple[int, int]:
        """Height and width of the image that it was trained on, of several the first."""
        return self._state.train_shape

    def seen(self, shape: tuple[int, int]) -> npt.NDArray[np.int64]:
        """Return the pixels that it was trained on in images of a shape, rows (y, x).

        Several scenes may have the same shape: then a pixel that trained in one of them counts as
        seen in all, so that it does not matter which image is which.
        """
        scenes = self.provenance["scenes"]
        ends = np.cumsum([scene["pixels_used"] for scene in scenes])
        parts = np.split(self._state.train_pixels, ends[:-1])
        found = [
            part
            for part, scene in zip(parts, scenes, strict=True)
            if tuple(scene["samples_shape"][:2]) == tuple(shape)
        ]
        return np.unique(np.concatenate(found or [np.empty((0, 2), np.int64)]), axis=0)

    @property
    def history(self) -> History:
        """How the training went; losses are in units of what the sample mean loses on average."""
        return History(*self._state.history.T)

    @property
    def provenance(self) -> dict[str, Any]:
        """Where it comes from: scene, seed, pixels, iterations, chdstat version."""
        return dict(self._state.provenance)

    def trained_on(self, attrs: Mapping[str, Any]) -> bool:
        """Return whether a scene that trained it is the one that samples with `attrs` are of."""
        own = attrs.get("scene_hash")
        scenes = self.provenance["scenes"]
        return own is not None and any(s["samples"].get("scene_hash") == own for s in scenes)

    def train(
        self,
        samples: Samples | Sequence[Samples],
        *,
        reference: bool | None = None,
        seed: int = 0,
        sizes: Sequence[int] | None = None,
        iterations: int | None = None,
        pixels: npt.ArrayLike | Sequence[npt.ArrayLike] | None = None,
        progress: bool | None = None,
    ) -> Self:
        """Train on an image, with a reference or on the very samples that it is to estimate from.

        Parameters
        ----------
        samples
            The image, or with a reference several of them, of other scenes or sizes, each
            measured in its own unit. Pixels with a bad sample are left out and counted.
        reference
            True takes the other samples of a pixel for the truth, which needs many more than the
            numbers of samples that will be estimated from. False learns from splits of the samples.
            None is True unless neighbours are an input, which are learned without a reference.
        seed
            Draws the pixels, the first weights and the minibatches.
        sizes
            Numbers of samples to learn from; None for 4 to 512 with a reference, and for a half
            and three quarters of the samples without. Fewer of them are learned a little better;
            others can be estimated from all the same.
        iterations
            Minibatches; None for 6000 with a reference and 2000 without.
        pixels
            Train on these, rows (y, x); of several images, one array each. None draws some with a
            reference, and takes all without; then those in a part of 256 x 256 pixels train.
        progress
            Show a progress bar; None shows it on a terminal.

        Returns
        -------
        Progressive
            Itself, trained.

        Raises
        ------
        InputError
            If there are too few samples or good pixels, neighbours are to be learned from with a
            reference, there are several images without one, or they differ in channels, or one
            has no features, or no direct part of all samples, where these are inputs.
        """
        from chdstat.estimators.progressive.training import train_network

        if iterations is not None and iterations < 1:
            message = f"iterations must be at least 1, got {iterations}"
            raise InputError(message)
        images = [samples] if isinstance(samples, Samples) else list(samples)
        supervised = not self.inputs.neighbours if reference is None else reference
        self.inputs.check_training(images, reference=supervised)
        given = [pixels] if isinstance(samples, Samples) and pixels is not None else pixels
        chosen = chosen_pixels(images, given, reference=supervised, seed=seed)
        scenes = [
            TrainingImage(
                image,
                self.inputs.features_of(image),
                mean_radiance(image),
                own,
                direct_of(image) if self.inputs.direct else None,
            )
            for image, own in zip(images, chosen, strict=True)
        ]
        if supervised:
            training_set = with_reference(scenes, sizes=sizes, iterations=iterations)
        else:
            training_set = without_reference(
                scenes[0],
                neighbours=self.inputs.neighbours,
                sizes=sizes,
                iterations=iterations,
                rng=generator(seed),
            )
        origins = [Origin.of(scene.samples, scene.unit) for scene in scenes]
        self._learned = train_network(
            training_set, origins, inputs=self.inputs, seed=seed, progress=progress
        )
        return self

    def predict(
        self,
        x: npt.ArrayLike,
        *,
        features: Features | None = None,
        direct: npt.ArrayLike | None = None,
        balance: float = 0.5,
        unit: float | None = None,
        trust: float | None = None,
    ) -> npt.NDArray[np.float32]:
        """Estimate radiance; as `estimate`, without certainty and interval.

        Returns
        -------
        ndarray
            Shape (..., channel).
        """
        given = self._input(x, features=features, direct=direct, balance=balance, unit=unit)
        return self._estimate_trusted(given, trust, level=None).radiance

    def estimate(
        self,
        x: npt.ArrayLike,
        *,
        features: Features | None = None,
        direct: npt.ArrayLike | None = None,
        balance: float = 0.5,
        unit: float | None = None,
        level: float = 0.9,
        trust: float | None = None,
    ) -> Estimates:
        """Estimate radiance, with certainty and interval.

        Parameters
        ----------
        x
            Samples, shape (..., channel, sample), any number of them; an image (y, x, channel,
            sample) where features or neighbours are inputs. A sample of which any channel is NaN
            or infinite is left out.
        features
            First-hit features of the image.
        direct
            Direct part of the samples, of the shape of `x`, where it is an input.
        balance
            0 for the least MSE, 1 for the least relMSE, and what lies between.
        unit
            Mean radiance of the image that `x` is a part of, as of `mean_radiance`: then parts of
            it are estimated as the whole is, if neighbours are no input. None measures it on `x`.
        level
            Probability of the interval.
        trust
            How far to go from the mean to the estimate, 0 to 1. None follows it on the very
            samples that trained it; on another image it is measured how far that pays, as `trust`
            does. A part of an image, whose `unit` is given,
            is too little for that, and is taken to be of a scene that trained it.

        Raises
        ------
        InputError
            If it is not trained, `x` has another number of channels or is no image where it must
            be, features or direct part are missing, or an option is out of range.
        """
        if not 0 < level < 1:
            message = f"level must lie between 0 and 1, got {level}"
            raise InputError(message)
        given = self._input(x, features=features, direct=direct, balance=balance, unit=unit)
        return self._estimate_trusted(given, trust, level=level)

    def trust(
        self,
        x: npt.ArrayLike,
        *,
        features: Features | None = None,
        direct: npt.ArrayLike | None = None,
        balance: float = 0.5,
        unit: float | None = None,
    ) -> float:
        """Measure how far from the mean to the estimate it pays to go, without a reference.

        The estimate from one half of the samples is compared with the other half, under the
        weights of both squared and relative errors, and the other way round. A share is trusted as
        far as the comparison does not speak against it and it is better than the mean, a standard
        error over pixels off. Of fewer than 4 samples nothing is known, and the share is 0. A
        model that was trained on these very samples knows the other half, and is trusted too much.

        Parameters
        ----------
        x
            Samples as for `estimate`; the more pixels the better.
        features, direct, balance, unit
            As for `estimate`.

        Returns
        -------
        float
            From 0, the mean, to 1, the estimate; 0 where it moves nothing.

        Raises
        ------
        InputError
            As for `estimate`.
        """
        given = self._input(x, features=features, direct=direct, balance=balance, unit=unit)
        return share_of_input(self._state, self.inputs, given)

    def of_profile(
        self,
        profile: Profile,
        *,
        features: Features | None = None,
        balance: float = 0.5,
        level: float = 0.9,
        trust: float = 1.0,
    ) -> Estimates:
        """Estimate from profiles, which `Stream` keeps in place of samples.

        Raises
        ------
        InputError
            As for `estimate`; or if neighbours are an input, which need samples.
        """
        return estimate_profiles(
            self._state,
            self.inputs,
            profile,
            trust,
            features=features,
            balance=balance,
            level=level,
        )

    def trust_between(
        self,
        halves: Sequence[Profile],
        *,
        features: Features | None = None,
        balance: float = 0.5,
    ) -> float:
        """Measure between profiles of two halves of the samples how far it pays to go, as `trust`.

        Raises
        ------
        InputError
            As for `of_profile`.
        """
        return share_of_profiles(
            self._state, self.inputs, halves, features=features, balance=balance
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
        write_learned(path, self._state, self.inputs.names)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a trained network; this runs no code from the file.

        Raises
        ------
        StoreError
            If there is no such file, it is damaged, or it holds something else.
        """
        model = cls()
        model._learned, model.inputs = read_learned(path)
        return model

    @property
    def _state(self) -> Learned:
        if self._learned is None:
            message = f"{self.name} is not trained yet; call train(samples) or load(path)"
            raise InputError(message)
        return self._learned

    def _input(self, x: npt.ArrayLike, **given: Any) -> PredictionInput:
        return PredictionInput.of(x, self.inputs, self.channels, **given)

    def _estimate_trusted(
        self, given: PredictionInput, trust: float | None, *, level: float | None
    ) -> Estimates:
        if trust is None:
            known = not given.whole or self._state.fingerprint.match(
                given.samples, self.provenance["scenes"]
            )
            share = 1.0 if known else share_of_input(self._state, self.inputs, given)
        elif 0 <= trust <= 1:
            share = trust
        else:
            message = f"trust must lie between 0 and 1, or be None, got {trust}"
            raise InputError(message)
        return estimate_input(self._state, self.inputs, given, share, level=level)
