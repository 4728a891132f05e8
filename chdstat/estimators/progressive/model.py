"""The progressive estimator: a pixel's radiance from any number of its samples, and how sure it is.

>>> from chdstat.estimators import Progressive
>>> model = Progressive()  # then model.train(samples), where there is a reference
>>> alone = Progressive(inputs=["neighbours"])  # alone.train(samples): it needs no reference
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import as_pixels, generator, warn_left_out
from chdstat._core.image_scales import mean_radiance
from chdstat.errors import InputError, StoreError, check_probability
from chdstat.estimators.progressive import shrinkage, training
from chdstat.estimators.progressive.dataset import Profile
from chdstat.estimators.progressive.error_model import ErrorModel
from chdstat.estimators.progressive.inputs import (
    EstimateOptions,
    Estimates,
    Features,
    Input,
    InputConfig,
    keep_constants,
    shared_estimates,
    unchanged,
)
from chdstat.estimators.registry import mean_of_good
from chdstat.estimators.training import TrainedModel, check_iterations
from chdstat.estimators.validation import reordered, training_pixels
from chdstat.samples import Samples
from chdstat.samples.tiles import check_independent

__all__ = ["Progressive"]

_MEASURED = 2**14
"""Pixels that trust is measured on, where each is estimated separately: more tell little more."""

Array = npt.NDArray[Any]


class Progressive(TrainedModel[training.Learned]):
    """A network that reweighs the samples of a pixel octave by octave of their luminance.

    It takes any number of samples in any order, all channels together, and scales with their unit.
    Its estimate is the mean, moved towards what it proposes by ``n0 / (n0 + N)``; n0, the number of
    samples that its experience is worth, is predicted, too. So it tends to the mean as N grows,
    and is the mean where it has learned nothing.

    With a reference it learns two estimates, one for the least MSE and one for the least relMSE;
    `loss_weight` mixes them. Without one it learns from halves of each pixel's own samples, whose
    expectation is the truth: then every estimate is unbiased, and `loss_weight` matters little.
    How far it is then followed is measured on pixels that did not train it, so that an image which
    does not help it keeps its means.

    Where all samples of a pixel are the same light, as those of a lamp, their mean is kept.

    Parameters
    ----------
    inputs
        What it takes beside the samples of a pixel, any of: "features", what the camera rays hit
        (albedo, normal, depth and position); "neighbours", the profiles of the pixels around and
        what `shared_patches` makes of those that are similar, which is learned without a
        reference; "direct", direct and indirect light separately, as `chdstat.render` tells them
        with ``direct=True``: light that comes seldom is then known to be indirect.

    References
    ----------
    Weights of luminance layers: T. Zirr, J. Hanika and C. Dachsbacher, "Re-weighting firefly
    samples for improved finite-sample Monte Carlo estimates", Computer Graphics Forum 37(6), 2018,
    doi:10.1111/cgf.13335. Training without a reference: J. Lehtinen et al., "Noise2Noise: learning
    image restoration without clean data", ICML 2018. The rest is new.

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

    kind = name = "progressive"

    def __init__(self, *, inputs: Iterable[Input] = ()) -> None:
        self.inputs = InputConfig.of(inputs)
        self._trained: training.Learned | None = None

    def __repr__(self) -> str:
        known = "untrained" if self._trained is None else f"scene {self.provenance['scene']!r}"
        return f"<Progressive {', '.join([*self.inputs.names, known])}>"

    @property
    def unit(self) -> float:
        """Mean radiance of the image that it was trained on, as of `mean_radiance`.

        Of several images it is the geometric mean of theirs.
        """
        return self.state.unit

    @property
    def channels(self) -> int:
        """Channels of the samples that it takes."""
        return self.state.network.channels

    @property
    def train_pixels(self) -> npt.NDArray[np.int64]:
        """Pixels that it was trained on in images of `train_shape`, rows (y, x)."""
        return self.train_pixels_of(self.train_shape)

    def train_pixels_of(self, shape: tuple[int, int]) -> npt.NDArray[np.int64]:
        """Return the pixels that it was trained on in images of a shape, rows (y, x).

        Several scenes may have the same shape: then a pixel that trained in one of them counts as
        used in all, so that it does not matter which image is which.
        """
        return self.state.pixels_of(shape)

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
        check_iterations(iterations)
        images = [samples] if isinstance(samples, Samples) else list(samples)
        for image in images:
            check_independent(image)
        supervised = not self.inputs.neighbours if reference is None else reference
        if not images:
            message = "training needs at least one image, got none"
            raise InputError(message)
        if supervised and self.inputs.neighbours:
            message = "neighbours are learned from without a reference; pass reference=False"
            raise InputError(message)
        given = [pixels] if isinstance(samples, Samples) and pixels is not None else pixels
        if not supervised and len(images) > 1:
            message = (
                f"without a reference, give the one image that is to be improved, got {len(images)}"
            )
            raise InputError(message)
        if supervised:
            chosen = training_pixels(images, given, seed=seed)
            training_set = training.with_reference(images, chosen, self.inputs, sizes=sizes)
        else:
            own = None if given is None else training_pixels(images, given, seed=seed)[0]
            training_set = training.without_reference(
                images[0], own, self.inputs, sizes=sizes, rng=generator(seed)
            )
        training_set.iterations = iterations or training_set.iterations
        self._trained = training.train_network(
            training_set, self.inputs, seed=seed, progress=progress
        )
        return self

    def predict(
        self,
        x: npt.ArrayLike,
        *,
        features: Features | None = None,
        direct: npt.ArrayLike | None = None,
        loss_weight: float = 0.5,
        unit: float | None = None,
        trust: float | None = None,
    ) -> npt.NDArray[np.float32]:
        """Estimate radiance, shape (..., channel); as `estimate`, without interval."""
        beside: dict[str, Any] = {"features": features, "direct": direct, "unit": unit}
        return self.estimate(x, **beside, loss_weight=loss_weight, level=None, trust=trust).radiance

    def estimate(
        self,
        x: npt.ArrayLike,
        *,
        features: Features | None = None,
        direct: npt.ArrayLike | None = None,
        loss_weight: float = 0.5,
        unit: float | None = None,
        level: float | None = 0.9,
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
        loss_weight
            0 for the least MSE, 1 for the least relMSE, and what lies between.
        unit
            Mean radiance of the image that `x` is a part of, as of `mean_radiance`: then parts of
            it are estimated as the whole is, if neighbours are no input. None measures it on `x`.
        level
            Probability of the interval; None leaves it out (NaN).
        trust
            How far to go from the mean to the estimate, 0 to 1. None follows it on the very
            samples that trained it; on another image it is measured how far that pays, as `trust`
            does. A part of an image, whose `unit` is given, is too little for that, and is taken to
            be of a scene that trained it.

        Raises
        ------
        InputError
            If it is not trained, `x` has another number of channels or is no image where it must
            be, features or direct part are missing, or an option is out of range.
        """
        if level is not None:
            check_probability(level=level)
        if trust is not None and not 0 <= trust <= 1:
            message = f"trust must lie between 0 and 1, or be None, got {trust}"
            raise InputError(message)
        lights, measured = self._checked(x, direct, loss_weight, unit)
        if trust is None:
            known = unit is not None or self.state.recognises(lights[0])
            trust = 1.0 if known else self._measured_trust(lights, features, measured, loss_weight)
        return self._of_samples(
            lights, features, measured, EstimateOptions(trust, loss_weight, level)
        )

    def trust(
        self,
        x: npt.ArrayLike,
        *,
        features: Features | None = None,
        direct: npt.ArrayLike | None = None,
        loss_weight: float = 0.5,
        unit: float | None = None,
    ) -> float:
        """Measure how far from the mean to the estimate it pays to go, without a reference.

        The estimate from one half of the samples is compared with the other half, under the
        weights of both squared and relative errors, and the other way round. A share is trusted as
        far as the comparison does not speak against it and it is better than the mean, a standard
        error over pixels off. Of fewer than 4 samples nothing is known, and the share is 0. A
        model that was trained on these very samples knows the other half, and is trusted too much.

        The arguments, and what is refused, are those of `estimate`; the more pixels the better.

        Returns
        -------
        float
            From 0, the mean, to 1, the estimate; 0 where it moves nothing.
        """
        lights, measured = self._checked(x, direct, loss_weight, unit)
        return self._measured_trust(lights, features, measured, loss_weight)

    def check(self, channels: int, loss_weight: float = 0.5) -> None:
        """Refuse samples of other channels than it takes, and a loss weight out of range."""
        if channels != self.channels:
            message = (
                f"the model was trained on samples with {self.channels} channels, got {channels}; "
                "train one for these"
            )
            raise InputError(message)
        if not 0 <= loss_weight <= 1:
            message = f"loss_weight must lie between 0 (MSE) and 1 (relMSE), got {loss_weight}"
            raise InputError(message)

    def _checked(
        self, x: npt.ArrayLike, direct: npt.ArrayLike | None, loss_weight: float, unit: float | None
    ) -> tuple[list[Array], float]:
        """Return the samples, their direct part where it is an input, and the unit."""
        samples = as_pixels(x)
        warn_left_out(samples, channel_axis=-2, within="chdstat.estimators")
        self.check(samples.shape[-2], loss_weight)
        part = self.inputs.direct_of(direct, samples.shape)
        lights = [samples] if part is None else [samples, part]
        return lights, mean_radiance(samples) if unit is None else unit

    def _measured_trust(
        self, lights: list[Array], features: Features | None, unit: float, loss_weight: float
    ) -> float:
        """Compare the estimate from each half of the samples with the other half."""
        spp = lights[0].shape[-1]
        if spp < training.FEWEST:
            return 0.0
        rows = [light.reshape(-1, *light.shape[-2:]) for light in lights]
        if len(rows[0]) > _MEASURED and not (self.inputs.features or self.inputs.neighbours):
            chosen = np.sort(generator(0).choice(len(rows[0]), _MEASURED, replace=False))
            lights = [light[chosen] for light in rows]
        lights = reordered(*lights)
        halves = [[light[..., first::2] for light in lights] for first in range(2)]
        # As far as all samples will be trusted, half of them are.
        options = EstimateOptions(1.0, loss_weight, spp=spp)
        moves = []
        for half, other in zip(halves, halves[::-1], strict=True):
            found = self._of_samples(half, features, unit, options).radiance
            moves.append(shrinkage.moves_between(half[0], found, other[0], unit=unit))
        return shrinkage.shrinkage_factor(moves)

    def _of_samples(
        self, lights: list[Array], features: Features | None, unit: float, options: EstimateOptions
    ) -> Estimates:
        from chdstat.estimators.progressive.network import estimate_pixels

        state, samples, profile = self.state, lights[0], None
        if self.inputs.neighbours:
            profile = Profile.of(as_pixels(samples, image=True), unit=unit)
        auxiliary = self.inputs.auxiliary(
            features, samples.shape[:-2], described=state.network.described, profile=profile
        )
        if self.inputs.neighbours:
            auxiliary["shared"] = shared_estimates(samples) / np.float32(unit)
        rows = [light.reshape(-1, *light.shape[-2:]) for light in lights]

        def profile_of(part: slice) -> Profile:
            own, *direct = (light[part] for light in rows)
            return Profile.of(own, unit=unit, direct=direct[0] if direct else None)

        found = estimate_pixels(state, profile_of, auxiliary, samples.shape[:-2], options)
        # A profile may overflow, or hold no sample that is good in all channels.
        lost = ~np.isfinite(found.radiance).all(axis=-1)
        if lost.any():
            with np.errstate(over="ignore"):
                mean = mean_of_good(samples[lost]).astype(np.float32)
            found.radiance[lost] = found.low[lost] = found.high[lost] = mean
            found.certainty[lost] = 0
        if samples.shape[-1] > 1:
            first = samples[..., 0]
            # Of nearly all images one sample a pixel tells that there is light.
            lit = bool(first.any() or samples.any())
            keep_constants(found, first, unchanged(first, samples), lit=lit)
        return found

    def _to_file(self, state: training.Learned) -> tuple[dict[str, Array], dict[str, Any]]:
        sizes, shares = state.network.shrinkage or shrinkage.FULL
        arrays: dict[str, Array] = {"trust.sizes": sizes, "trust.shares": shares}
        arrays |= zip(("marks.places", "marks.samples"), state.marks, strict=True)
        arrays |= {f"network.{name}": w for name, w in state.network.to_arrays().items()}
        arrays |= {f"spread.{name}": a for name, a in vars(state.error_model).items()}
        about = {"shape": state.network.shape, "inputs": list(self.inputs.names)}
        return arrays, about | {"unit": state.unit}

    @classmethod
    def _from_file(
        cls, arrays: dict[str, Array], about: Mapping[str, Any], common: dict[str, Any]
    ) -> Self:
        from chdstat.estimators.progressive.network import Network

        def below(prefix: str) -> dict[str, Array]:
            return {k.removeprefix(prefix): a for k, a in arrays.items() if k.startswith(prefix)}

        if "trust.shares" not in arrays:
            message = (
                "this model was trained by an earlier version, which did not measure how far it "
                "pays to follow the network; train it again"
            )
            raise StoreError(message)
        network = Network(**about["shape"]).eval()
        network.load_arrays(below("network."))
        network.shrinkage = shrinkage.checked_shares(**below("trust."))
        model = cls(inputs=about["inputs"])
        model._trained = training.Learned(
            network=network,
            error_model=ErrorModel(**below("spread.")),
            unit=float(about["unit"]),
            marks=(arrays["marks.places"], arrays["marks.samples"]),
            **common,
        )
        return model
