"""The limit of what the samples of one pixel tell: the posterior mean under the scene's own prior.

Every estimator that sees only the samples of a pixel is a function of them, and on average over a
scene none can beat the posterior mean under the distribution of the scene's pixels.
`EmpiricalPrior` estimates that distribution from a reference and computes the posterior: an
estimate, its spread, and how many pixels of the scene explain the samples about as well.

Use it to learn how far an estimator is from what is possible. As an estimator it is registered as
`empirical_prior`; it needs a reference of its scene.
"""

from __future__ import annotations

import math
from typing import Any, Self, get_args

import numpy as np
import numpy.typing as npt

import chdstat
from chdstat._arrays import as_samples, generator, is_bad, spans
from chdstat._positive import Floats
from chdstat.errors import InputError
from chdstat.estimators._atoms import Atoms, Density, Observed, observe
from chdstat.estimators._posterior import Losses, Posterior
from chdstat.estimators.classical import mean_of_good
from chdstat.estimators.registry import LearnedEstimator, register_learned
from chdstat.metrics import relative_squared_error
from chdstat.samples import Samples

__all__ = ["EmpiricalPrior", "Posterior"]

_INPUTS, _PIXELS = 32, 16384
_STRENGTHS = (250.0, 1000.0, 4000.0)
"""Samples that the topics may count as much as."""
_PROBES = 1024
"""Pixels that choose among them."""
_BETWEEN = 0.01
_CHUNK = 2**22
"""Pairs of a batch and an atom at once."""


class EmpiricalPrior:
    r"""The pixels of a scene as a discrete prior of what another pixel of it may be.

    Pixel j is an atom with radiance y_j and distribution f_j of its samples. A batch x has

    ``w_j = pi_j prod_i f_j(x_i)``,  ``mean = sum_j w_j v_j y_j / sum_j w_j v_j``,

    with v_j = 1 for the least squared error and ``v_j = 1 / (y_j^2 + 0.01 m^2)`` for the least
    relative one, m the mean of the scene. Make one with `EmpiricalPrior.of`.

    What it bounds: no function of a batch alone has a smaller expected loss over the pixels that
    the prior describes than the posterior mean under the true prior (the Bayes risk). On pixels
    that are not among the atoms (`exclude`), the error of this posterior mean is the error of
    something that can be done, so the limit lies at it or below: it is an upper bound. What lies
    between are finitely many atoms where the scene is a continuum, the smoothing of f_j, and the
    noise of f_j and y_j. With the pixel itself among the atoms, and a batch that f_j has not seen,
    it is near the limit of a network that has learned the whole picture by heart; a method that
    has not cannot be asked to reach it. Both count a reference of the scene as known, which an
    estimator trained on the same reference may use as well, and which no one has who renders it.

    Deviations: f_j is a histogram (see `chdstat.estimators._sample_bins`), drawn towards a topic
    model of all of them, as strongly as is best for pixels of the scene that are left out. Some
    atoms lie between near pixels of different radiance, since a scene shows all shares of a
    light's edge but few pixels of each.

    References
    ----------
    H. Robbins, "An empirical Bayes approach to statistics", Proceedings of the Third Berkeley
    Symposium 1, 1956, pp. 157-163.
    J. Kiefer and J. Wolfowitz, "Consistency of the maximum likelihood estimator in the presence of
    infinitely many incidental parameters", Annals of Mathematical Statistics 27(4), 1956,
    doi:10.1214/aoms/1177728066.
    J. O. Berger, "Statistical decision theory and Bayesian analysis", 2nd edition, 1985,
    doi:10.1007/978-1-4757-4286-2, section 4.4.2 (weighted squared error).
    """

    def __init__(self, observed: Observed, atoms: Atoms, provenance: dict[str, Any]) -> None:
        self._observed = observed
        self._atoms = atoms
        self._provenance = provenance

    @classmethod
    def of(
        cls,
        samples: Samples,
        *,
        pixels: npt.ArrayLike | None = None,
        density: Density = "histogram",
        between: float = _BETWEEN,
        strength: float | None = None,
        seed: int | np.random.Generator | None = 0,
    ) -> Self:
        """Make the prior that a scene's pixels are.

        Parameters
        ----------
        samples
            The scene with many samples per pixel.
        pixels
            Rows (y, x), none twice; None takes all, or 16384 drawn at random where there are more.
        density
            What f_j says of luminance: "histogram", or "lognormal" for the mixture that
            `chdstat.fit.mixture` fits to the pixel.
        between
            Prior probability of the atoms between pixels; 0 for none.
        strength
            How many samples the topics of the scene count as much as; None chooses 250, 1000 or
            4000 by the relMSE of 1024 batches of 32 samples, each with its own pixel left out.
        seed
            Draws pixels and topics.

        Raises
        ------
        InputError
            If a pixel lies outside or is named twice, no pixel has a good sample, there are neither
            1 nor 3 channels, or an option is out of range.

        Examples
        --------
        >>> rng = np.random.default_rng(0)
        >>> brightness = np.repeat([1.0, 3.0], 32).reshape(8, 8, 1, 1)
        >>> scene = Samples.from_array(brightness * rng.exponential(size=(8, 8, 1, 256)))
        >>> prior = EmpiricalPrior.of(scene)
        >>> x = 3 * rng.exponential(size=(1, 32))
        >>> x.mean().round(1), prior.posterior(x).mean.round(1)
        (np.float64(2.1), array([2.7]))
        """
        _check_options(samples, density, between, strength)
        rng = generator(seed)
        chosen = _flat_pixels(samples, pixels, rng)
        observed = observe(samples, chosen, density=density, rng=rng)
        about = {
            "scene": samples.name,
            "samples_shape": list(samples.shape),
            "density": density,
            "between": between,
            "pixels_used": len(observed.pixels),
            "chdstat": chdstat.__version__,
        }
        rivals = [
            cls(observed, Atoms.of(observed, strength=s, between=between), about | {"strength": s})
            for s in (_STRENGTHS if strength is None else (strength,))
        ]
        probes = _probes(samples, observed.pixels, rng)
        return min(rivals, key=lambda prior: prior._error(*probes)) if rivals[1:] else rivals[0]

    @property
    def name(self) -> str:
        """Registered name."""
        return "empirical_prior"

    @property
    def inputs(self) -> int:
        """Samples per estimate in comparisons; `posterior` takes any number."""
        return _INPUTS

    @property
    def train_pixels(self) -> npt.NDArray[np.int64]:
        """Pixels that are atoms, rows (y, x)."""
        rows = np.unravel_index(self._observed.pixels, self._observed.shape)
        return np.stack(rows, axis=-1).astype(np.int64)

    @property
    def train_shape(self) -> tuple[int, int]:
        """Height and width of the picture that they lie in."""
        return self._observed.shape

    @property
    def provenance(self) -> dict[str, Any]:
        """Where it comes from: scene, options, strength of the smoothing, chdstat version."""
        return dict(self._provenance)

    def __repr__(self) -> str:
        scene = self._provenance["scene"]
        return f"<EmpiricalPrior scene {scene!r}, {len(self._observed.pixels)} pixels>"

    def predict(self, x: npt.ArrayLike, *, relative: float = 0.0) -> Floats:
        """Estimate radiance: the posterior mean, and the mean of the good samples without one.

        Parameters
        ----------
        x
            Samples, shape (..., channel, sample).
        relative
            As for `posterior`.

        Returns
        -------
        ndarray
            Shape (..., channel), in radiance; NaN where no sample of the channel is good.
        """
        samples = as_samples(x)
        found = self.posterior(samples, relative=relative).mean
        return np.where(np.isnan(found), mean_of_good(samples), found)

    def posterior(
        self,
        x: npt.ArrayLike,
        *,
        exclude: npt.ArrayLike | None = None,
        relative: float = 0.0,
        shares: npt.ArrayLike = (),
    ) -> Posterior:
        """Return what samples say of their pixel.

        Parameters
        ----------
        x
            Samples, shape (..., channel, sample). A sample of which any channel is NaN, infinite or
            negative is left out.
        exclude
            The pixel that a batch comes from, as flat index y * width + x, broadcastable to (...):
            atoms that it is part of do not count. Negative for none; None for none at all.
        relative
            Exponent p of the loss ``(estimate - y)^2 / (y^2 + 0.01 m^2)^p``, from 0 for the least
            MSE to 1 for the least relMSE. Only the mean depends on it.
        shares
            Quantiles wanted, between 0 and 1; each costs time.

        Raises
        ------
        InputError
            If `x` has other channels than the scene, or an option is out of range.
        """
        samples = as_samples(x)
        self._check_batches(samples, relative)
        wanted = _check_shares(shares)
        *lead, channels, n = samples.shape
        rows = samples.reshape(math.prod(lead), channels, n)
        excluded = _broadcast(exclude, tuple(lead))
        found = Losses.empty(len(rows), channels, wanted)
        known = np.flatnonzero(~is_bad(rows).any(axis=1).all(axis=-1))
        losses = Losses.of(self._atoms, self._scene_mean, relative)
        for part in spans(len(known), max(1, _CHUNK // len(self._atoms.radiance))):
            some = known[part]
            found[some] = losses.read(*self._weights(rows[some], excluded[some]), wanted)
        return Posterior.of(found, (*lead, channels), unit=self._observed.bins.unit)

    @property
    def _scene_mean(self) -> Floats:
        return np.asarray(self._observed.radiance.mean(axis=0))

    def _error(self, x: npt.NDArray[np.float32], pixels: npt.NDArray[np.int64]) -> float:
        """Return the relMSE of batches of pixels that are atoms, but left out."""
        unit, y = self._observed.bins.unit, self._observed.radiance
        found = self.posterior(x, exclude=pixels, relative=1.0).mean / unit
        truth = y[np.searchsorted(self._observed.pixels, pixels)]
        known = np.isfinite(found).all(axis=-1)
        error = relative_squared_error(found[known], truth[known], scene_mean=self._scene_mean)
        return float(error.mean()) if known.any() else 0.0

    def _weights(
        self, rows: npt.NDArray[np.floating[Any]], excluded: npt.NDArray[np.int64]
    ) -> tuple[npt.NDArray[np.float32], Floats]:
        """Return w_j relative to the largest of each row, (row, atom), and the latter's log."""
        atoms = self._atoms
        log = self._observed.bins.counts(rows) @ atoms.logs
        log += atoms.log_mass
        if (excluded >= 0).any():
            number = len(self._observed.pixels)
            _leave_out(log[:, :number], self._observed.pixels, excluded)
            for parent in atoms.parents[number:].T:
                log[:, number:][excluded[:, np.newaxis] == parent] = -np.inf
        top = log.max(axis=-1, keepdims=True)
        # Where nothing remains all is left at minus infinity, and every weight is 0.
        log -= np.where(np.isfinite(top), top, 0)
        return np.exp(log, out=log), top[:, 0].astype(np.float64)

    def _check_batches(self, samples: npt.NDArray[Any], relative: float) -> None:
        channels = self._observed.bins.channels
        if samples.ndim < 2 or samples.shape[-2] != channels:
            message = f"x must have shape (..., {channels}, sample), got {samples.shape}"
            raise InputError(message)
        if not 0 <= relative <= 1:
            message = f"relative must lie between 0 (MSE) and 1 (relMSE), got {relative}"
            raise InputError(message)


def _leave_out(
    log: npt.NDArray[np.float32], pixels: npt.NDArray[np.int64], excluded: npt.NDArray[np.int64]
) -> None:
    """Take the atom that is the pixel itself out of each row; `pixels` are ascending."""
    at = np.minimum(np.searchsorted(pixels, excluded), len(pixels) - 1)
    rows = np.flatnonzero(pixels[at] == excluded)
    log[rows, at[rows]] = -np.inf


def _probes(
    samples: Samples, pixels: npt.NDArray[np.int64], rng: np.random.Generator
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
    """Return batches of the scene, (batch, channel, sample), and the pixels they come from."""
    drawn = np.sort(rng.permutation(pixels)[:_PROBES])
    where = np.unravel_index(drawn, samples.shape[:2])
    return samples.read(ss=slice(0, _INPUTS))[where], drawn


def _flat_pixels(
    samples: Samples, pixels: npt.ArrayLike | None, rng: np.random.Generator
) -> npt.NDArray[np.int64]:
    """Return flat indices in ascending order."""
    height, width = samples.shape[:2]
    if pixels is None:
        return np.sort(rng.permutation(height * width)[:_PIXELS])
    rows = np.asarray(pixels)
    if rows.ndim != 2 or rows.shape[-1] != 2 or rows.dtype.kind not in "iu" or not len(rows):
        message = f"pixels must be rows (y, x) of integers, got {rows.dtype} of shape {rows.shape}"
        raise InputError(message)
    if (rows < 0).any() or (rows >= (height, width)).any():
        message = f"pixels must lie in the picture of {width} x {height} pixels; one lies outside"
        raise InputError(message)
    flat = np.unique(rows @ (width, 1))
    if len(flat) < len(rows):
        message = f"pixels must differ, got {len(rows)} rows with {len(flat)} different pixels"
        raise InputError(message)
    return flat.astype(np.int64)


def _broadcast(exclude: npt.ArrayLike | None, lead: tuple[int, ...]) -> npt.NDArray[np.int64]:
    given = np.asarray(-1 if exclude is None else exclude)
    try:
        return np.broadcast_to(given, lead).reshape(-1).astype(np.int64)
    except ValueError:
        message = f"exclude must be broadcastable to the batches {lead}, got shape {given.shape}"
        raise InputError(message) from None


def _check_shares(shares: npt.ArrayLike) -> Floats:
    wanted = np.asarray(shares, np.float64).reshape(-1)
    if not ((wanted >= 0) & (wanted <= 1)).all():
        message = f"shares must lie between 0 and 1, got {wanted.tolist()}"
        raise InputError(message)
    return wanted


def _check_options(samples: Samples, density: str, between: float, strength: float | None) -> None:
    if samples.shape[2] not in (1, 3):
        message = f"an empirical prior needs 1 or 3 channels, got {samples.shape[2]}"
        raise InputError(message)
    if density not in get_args(Density):
        message = f"density must be one of {get_args(Density)}, got {density!r}"
        raise InputError(message)
    if not 0 <= between < 1:
        message = f"between must be a probability below 1, got {between}"
        raise InputError(message)
    if strength is not None and not 0 <= strength < np.inf:
        message = f"strength must be a number of samples, 0 or more, or None, got {strength}"
        raise InputError(message)


def _trained(
    samples: Samples,
    *,
    seed: int = 0,
    pixels: npt.ArrayLike | None = None,
    progress: bool | None = None,  # noqa: ARG001 - what trains elsewhere shows its progress
) -> EmpiricalPrior:
    return EmpiricalPrior.of(samples, pixels=pixels, seed=seed)


register_learned(
    LearnedEstimator(
        "empirical_prior",
        _trained,
        "this library, after Robbins 1956 and Kiefer and Wolfowitz 1956, "
        "doi:10.1214/aoms/1177728066",
        inputs=_INPUTS,
        pixels=_PIXELS,
        iterates=False,
    )
)
