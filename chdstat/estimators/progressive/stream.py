"""Streams: samples are kept as profiles while they are rendered, with an estimate at any time.

A stream may also train its model on the samples that arrive; `schedule` says when, and for how many
iterations.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import as_pixels
from chdstat._core.image_scales import mean_radiance
from chdstat._core.progress import track
from chdstat.errors import InputError
from chdstat.estimators.progressive.dataset import Profile
from chdstat.estimators.progressive.inputs import (
    EstimateOptions,
    Estimates,
    Features,
    keep_constants,
    unchanged,
)
from chdstat.estimators.progressive.model import Progressive
from chdstat.estimators.progressive.online import OnlineTrainer
from chdstat.estimators.progressive.shrinkage import shrinkage_factor
from chdstat.estimators.progressive.training import FEWEST, ITERATIONS_ALONE
from chdstat.estimators.training import check_iterations

__all__ = ["Stream", "follow", "schedule"]

_NOTHING_YET = "the stream has no samples yet; call update(samples)"
_FIXED = "this stream takes its model as it is; make it with learns=True"


class Stream:
    """Estimates that get better with every batch, in memory that does not grow.

    A pixel takes 24 octaves of 4 numbers (of RGB), however many samples there are, twice as many
    where direct light is an input; of 65,536 pixels eight times as many are kept where it
    learns, to cut them in two at random. A model of another scene takes three times as
    many: it is followed as far as one half of the samples says that the other half's estimate
    pays.

    Parameters
    ----------
    model
        An estimator without neighbours: these need the samples. It was trained before, or
        learns here.
    features
        First-hit features of the image, where they are an input.
    unit
        Mean radiance of the image, as of `mean_radiance`; None measures it on the first batch with
        light. Given, the pixels may be a part of an image, which tells too little of how far a
        model of another scene should be followed: it is taken for one of this scene.
    learns
        Whether `learn` is going to train the model on the samples as they arrive, without a
        reference. A model that was trained before goes on from there; until it has learned
        anything, a new one gives the mean.
    seed
        Of the training: draws pixels, first weights and minibatches.
    attrs
        Where the samples come from, as `Samples.attrs`, for the provenance of what is learned.

    Raises
    ------
    InputError
        If a model that learns has neighbours for an input, or wants features and gets none.

    References
    ----------
    J. Lehtinen et al., "Noise2Noise: learning image restoration without clean data", ICML 2018.
    I. Loshchilov and F. Hutter, "SGDR: stochastic gradient descent with warm restarts", ICLR 2017,
    arXiv:1608.03983.

    Examples
    --------
    >>> import chdstat as chd
    >>> rng = np.random.default_rng(0)
    >>> rendered = rng.exponential(size=(16, 16, 1, 64))
    >>> model = Progressive().train(chd.Samples.from_array(rendered), iterations=10, progress=False)
    >>> stream = Stream(model)
    >>> for first in range(0, 64, 16):
    ...     stream.update(rendered[..., first : first + 16])
    >>> int(stream.count[0, 0]), stream.estimate().radiance.shape
    (64, (16, 16, 1))

    One that learns while it streams:

    >>> stream = Stream(Progressive(), learns=True)
    >>> for first in range(0, 64, 16):
    ...     stream.update(rendered[..., first : first + 16])
    ...     stream.learn(iterations=5)
    >>> stream.iterations, stream.estimate().radiance.shape
    (20, (16, 16, 1))
    """

    def __init__(
        self,
        model: Progressive,
        *,
        features: Features | None = None,
        unit: float | None = None,
        learns: bool = False,
        seed: int = 0,
        attrs: Mapping[str, Any] | None = None,
    ) -> None:
        if model.inputs.neighbours:
            message = (
                f"a stream takes a model without neighbours, which need the samples; got {model!r}"
            )
            raise InputError(message)
        if learns and model.inputs.features and not features:
            message = (
                "the model looks at first-hit features, but the stream got none; pass features="
            )
            raise InputError(message)
        self._model, self._unit = model, unit
        self.features = features
        self._learns, self._seed, self._attrs = learns, seed, dict(attrs or {})
        self._trainer: OnlineTrainer | None = None
        # Of all samples; and of every other one and those between, where trust is measured.
        self._profiles: list[Profile] = []
        self._foreign = not (learns or unit is not None or model.trained_on(self._attrs))
        self._spp = 0
        self._first: npt.NDArray[Any] | None = None
        self._same: npt.NDArray[np.bool_] = np.empty(0, bool)
        self._lit = False

    @property
    def model(self) -> Progressive:
        """The estimator, with all that it has learned so far; `Progressive.save` keeps it."""
        if self._trainer is not None:
            self._model._trained = self._trainer.learned(self._attrs) or self._model._trained
        return self._model

    @property
    def count(self) -> npt.NDArray[np.int64]:
        """Good samples so far, shape (...)."""
        return self._profile.count

    @property
    def iterations(self) -> int:
        """Minibatches that were learned from."""
        return 0 if self._trainer is None else self._trainer.iterations

    @property
    def nbytes(self) -> int:
        """Bytes that are kept."""
        kept = sum(profile.nbytes for profile in self._profiles)
        if self._trainer is not None:
            kept += self._trainer.batches.nbytes
        return kept if self._first is None else kept + self._first.nbytes + self._same.nbytes

    def update(self, x: npt.ArrayLike, direct: npt.ArrayLike | None = None) -> None:
        """Add samples (..., channel, sample) of the same pixels as before.

        Parameters
        ----------
        x
            The samples.
        direct
            Their direct part, of the same shape, where it is an input.

        Raises
        ------
        InputError
            If these are other pixels, `x` has no channels, it is no image (y, x, channel, sample)
            where the model learns, or `direct` is missing or not their direct part.
        """
        samples = as_pixels(x)
        part = self._model.inputs.direct_of(direct, samples.shape)
        if not self._profiles:
            self._begin(samples)
        kept = self._profile
        if (*kept.count.shape, kept.channels) != samples.shape[:-1]:
            message = (
                f"the stream holds pixels {kept.count.shape} with {kept.channels} channels, got "
                f"samples of shape {samples.shape}"
            )
            raise InputError(message)
        if self._unit is None and not kept.bins.any():
            # Black so far: the unit is that of the first batch with light.
            unit = mean_radiance(samples)
            for profile in self._profiles:
                profile.unit = unit
            if self._trainer is not None:
                self._trainer.batches.unit = unit
        halves = [slice((first + self._spp) % 2, None, 2) for first in range(2)]
        for profile, every in zip(self._profiles, (slice(None), *halves), strict=False):
            own = None if part is None else part[..., every]
            if samples[..., every].shape[-1]:
                profile.add(Profile.of(samples[..., every], unit=kept.unit, direct=own))
        self._spp += samples.shape[-1]
        if self._first is None:
            self._first = samples[..., 0].copy()
            self._same = np.ones(self._first.shape[:-1], bool)
        self._same &= unchanged(self._first, samples)
        self._lit = self._lit or bool(samples[..., 0].any() or samples.any())
        if self._trainer is not None:
            self._trainer.add(samples, part)

    def learn(self, *, iterations: int = 500, progress: bool | None = False) -> None:
        """Learn from all samples so far, going on from what was learned before.

        Parameters
        ----------
        iterations
            Minibatches. The step size falls as a cosine from its start to 0, each time anew.
        progress
            Show a progress bar; None shows it on a terminal.

        Raises
        ------
        InputError
            If the stream does not learn, there are fewer than 4 samples, or too few pixels without
            a bad sample.
        """
        check_iterations(iterations)
        if self._trainer is None:
            message = _NOTHING_YET if self._learns else _FIXED
            raise InputError(message)
        with track("learning", iterations, unit="it", show=progress) as advance:
            self._trainer.learn(iterations, advance)

    def mean(self) -> npt.NDArray[np.floating[Any]]:
        """Return the sample mean so far, shape (..., channel)."""
        return self._profile.mean()

    def estimate(
        self, *, loss_weight: float = 0.5, level: float = 0.9, trust: float | None = None
    ) -> Estimates:
        """Estimate from all samples so far; see `Progressive.estimate`.

        Without `trust`, a model that did not train on the scene that ``attrs`` name is followed as
        far as it pays.

        Before a new model has learned anything it is the mean, its certainty is 0, and nothing is
        said of its error: the ends of the interval, and its level, are NaN.
        """
        profile = self._profile
        if self._trainer is not None and self._trainer.iterations == 0:
            mean = profile.mean().astype(np.float32)
            unknown = np.full_like(mean, np.nan)
            certainty = np.zeros(mean.shape[:-1], np.float32)
            return Estimates(mean, certainty, unknown, unknown, np.nan)
        self.model.check(profile.channels, loss_weight)
        if trust is None:
            trust = self._measured_trust(loss_weight) if self._foreign else 1.0
        found = self._of_profile(profile, EstimateOptions(trust, loss_weight, level))
        if self._first is not None and self._spp > 1:
            keep_constants(found, self._first, self._same, lit=self._lit)
        return found

    def _begin(self, samples: npt.NDArray[Any]) -> None:
        """Prepare to keep what is needed of pixels like these."""
        *shape, channels = samples.shape[:-1]
        inputs, start = self._model.inputs, self._model._trained
        unit = mean_radiance(samples) if self._unit is None else self._unit
        if self._learns:
            if len(shape) != 2:
                message = (
                    f"learning takes an image (y, x, channel, sample), got pixels {tuple(shape)}"
                )
                raise InputError(message)
            if start is not None:
                self._model.check(channels)
            self._trainer = OnlineTrainer(
                (shape[0], shape[1]),
                channels,
                inputs,
                unit=unit,
                features=self.features,
                seed=self._seed,
                start=start,
            )
        self._profiles = [
            Profile.empty(tuple(shape), channels, unit=unit, parts=inputs.parts)
            for _ in range(3 if self._foreign else 1)
        ]

    def _of_profile(self, profile: Profile, options: EstimateOptions) -> Estimates:
        from chdstat.estimators.progressive.network import estimate_pixels

        state, shape, rows = self.model.state, profile.count.shape, profile.reshape(-1)
        known = self._model.inputs.auxiliary(
            self.features, shape, described=state.network.described
        )
        return estimate_pixels(state, rows.__getitem__, known, shape, options)

    def _measured_trust(self, loss_weight: float) -> float:
        """Compare the estimate from the profiles of one half of the samples with the other half."""
        halves = self._profiles[1:]
        spp = sum(int(half.count.max(initial=0)) for half in halves)
        if spp < FEWEST:
            return 0.0
        moves, options = [], EstimateOptions(1.0, loss_weight, spp=spp)
        for half, other in zip(halves, halves[::-1], strict=True):
            found = self._of_profile(half, options).radiance
            mean, estimate, target = (
                (np.asarray(a, np.float64) / half.unit).reshape(-1, half.channels)
                for a in (half.mean(), found, other.mean())
            )
            noise = np.asarray(other.variance_of_mean(), np.float64).reshape(mean.shape)
            moves.append((np.arange(len(mean)), mean, estimate, target, noise))
        return shrinkage_factor(moves)

    @property
    def _profile(self) -> Profile:
        if not self._profiles:
            raise InputError(_NOTHING_YET)
        return self._profiles[0]


_FIRST = 16
"""Samples from which learning pays: fewer tell the network little that lasts."""


def follow(
    stream: Stream, batches: Iterable[npt.NDArray[Any]], *, spp: int, iterations: int | None = None
) -> None:
    """Take in batches as they are rendered, and learn whenever the samples have doubled.

    Parameters
    ----------
    stream
        One that learns, without samples.
    batches
        Samples, shape (y, x, channel, sample) each.
    spp
        Samples per pixel in all.
    iterations
        Minibatches in all; None for 2000.

    Raises
    ------
    InputError
        If there are fewer than 4 samples, or less than one minibatch.

    Examples
    --------
    >>> import numpy as np
    >>> from chdstat.estimators import Progressive
    >>> x = np.random.default_rng(0).exponential(size=(4, 16, 16, 1, 16))
    >>> stream = Stream(Progressive(), learns=True)
    >>> follow(stream, x, spp=64, iterations=14)
    >>> stream.iterations
    14
    """
    plan = schedule(spp, iterations)
    there = 0
    for batch in batches:
        stream.update(batch)
        there += batch.shape[-1]
        due = sum(plan.pop(mark) for mark in sorted(plan) if mark <= there)
        if due:
            stream.learn(iterations=due)


def schedule(spp: int, iterations: int | None = None) -> dict[int, int]:
    """Return after how many samples to learn, and with how many minibatches.

    Samples double from one time to the next, and so do the minibatches, as the periods of
    Loshchilov and Hutter 2017 (arXiv:1608.03983) do: more than half of them see all samples.

    Examples
    --------
    >>> schedule(64, 700)
    {16: 100, 32: 200, 64: 400}
    """
    total = ITERATIONS_ALONE if iterations is None else iterations
    if spp < FEWEST:
        message = f"learning while rendering needs at least {FEWEST} spp, got {spp}"
        raise InputError(message)
    check_iterations(iterations)
    marks = [spp]
    while marks[0] // 2 >= _FIRST:
        marks.insert(0, marks[0] // 2)
    # What is shared out comes to the total exactly, however few there are.
    ends = [round(total * (2**k - 1) / (2 ** len(marks) - 1)) for k in range(len(marks) + 1)]
    shares = {mark: ends[k + 1] - ends[k] for k, mark in enumerate(marks)}
    return {mark: share for mark, share in shares.items() if share}
