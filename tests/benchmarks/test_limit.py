"""The limit of one-pixel estimation: the error of the posterior mean under the scene's own prior.

Measured on the stores that the environment variable CHDSTAT_STORES names, their paths separated by
colons; without it, on a simulated picture. Errors are relative to those of the sample mean.

The prior is made of all samples but the first 128 of each pixel; these are the four batches of 32
that are judged, each against the mean of all other samples of its pixel. "left out": the pixel is
no atom, which bounds the limit from above. "own": it is one, which is near the limit of an
estimator that has learned the picture by heart (and a little below, since the atom's radiance and
the reference share samples). CHDSTAT_LIMIT_RIVALS=1 measures other priors, those
of fewer pixels among them, which tell whether more would help.
"""

import os
import time

import numpy as np
import pytest

import chdstat as chd
from chdstat import metrics
from chdstat.estimators.empirical_prior import EmpiricalPrior

N, BATCHES, PIXELS = 32, 4, 4096
NETWORKS = {"real-bathroom": (0.62, 0.18), "white-room": (0.74, 0.23)}
"""MSE and relMSE that large networks ended at, trained on 12000 pixels without limit of time."""


def simulated():
    rng = np.random.default_rng(0)
    level = np.exp(rng.normal(size=(48, 48, 1, 1))) * np.ones((1, 1, 3, 1))
    lit = rng.random((48, 48, 1, 512)) < rng.uniform(0.1, 0.9, size=(48, 48, 1, 1))
    return chd.Samples.from_array(level * lit * rng.gamma(0.7, size=(48, 48, 1, 512)))


def sources():
    stores = [path for path in os.environ.get("CHDSTAT_STORES", "").split(":") if path]
    return stores or ["simulated"]


class Judge:
    """Held-out batches of random pixels, and what estimates of them are worth."""

    def __init__(self, samples):
        x = samples.read()
        height, width, channels, spp = x.shape
        flat = x.reshape(height * width, channels, spp)
        total = flat.sum(axis=-1, dtype=np.float64)
        self.scene_mean = total.mean(axis=0) / spp
        rng = np.random.default_rng(1)
        self.pixels = rng.permutation(len(flat))[:PIXELS]
        first = flat[self.pixels, :, : N * BATCHES]
        # (pixel, batch, channel, sample)
        self.x = first.reshape(len(first), channels, BATCHES, N).swapaxes(1, 2)
        sums = self.x.sum(axis=-1, dtype=np.float64)
        self.mean = sums / N
        self.reference = (total[self.pixels, np.newaxis] - sums) / (spp - N)
        self.atoms = chd.Samples.from_array(x[..., N * BATCHES :], **samples.attrs)
        self.shape = height, width

    def relative(self, error):
        """Return an error measure relative to the mean's, averaged over channels, and its error."""
        pixels = np.stack([error(self.found).mean(axis=1), error(self.mean).mean(axis=1)], axis=1)
        interval = metrics.bootstrap(pixels, lambda m: (m[:, 0] / m[:, 1]).mean(axis=-1))
        return f"{interval.value:.3f} +- {interval.standard_error:.3f}"

    def line(self, label, found, *, relative):
        self.found = found
        y = self.reference
        if relative:
            what = "relMSE"
            error = self.relative(
                lambda p: metrics.relative_squared_error(p, y, scene_mean=self.scene_mean)
            )
        else:
            what, error = "MSE", self.relative(lambda p: metrics.squared_error(p, y))
        better = metrics.improved(found, y, self.mean).mean()
        bias = metrics.bias(found, y).mean()
        print(f"  {label:34s} {what:6s} {error}, improved {better:.1%}, bias {bias:+.2%}")


@pytest.mark.slow
@pytest.mark.usefixtures("as_benchmark")
@pytest.mark.parametrize("source", sources())
def test_limit(source):
    samples = simulated() if source == "simulated" else chd.open(source)
    judge = Judge(samples)
    start = time.perf_counter()
    prior = EmpiricalPrior.of(judge.atoms)
    print(f"\n{source}: {prior}, made in {time.perf_counter() - start:.0f} s, {prior.provenance}")
    own = judge.pixels[:, np.newaxis]
    for relative in (0.0, 1.0):
        start = time.perf_counter()
        posterior = prior.posterior(judge.x, exclude=own, relative=relative)
        seconds = time.perf_counter() - start
        judge.line("left out", posterior.mean, relative=relative)
        judge.line("own", prior.posterior(judge.x, relative=relative).mean, relative=relative)
    rows = posterior.effective_atoms.size
    atoms = np.quantile(posterior.effective_atoms, [0.1, 0.5, 0.9]).round(1)
    print(f"  effective atoms {atoms}; {seconds:.0f} s for {rows} batches")
    inside(judge, prior, own)
    if os.environ.get("CHDSTAT_LIMIT_RIVALS"):
        rivals(judge, own)
    targets = [v for k, v in NETWORKS.items() if k in source]
    print(f"  large networks: MSE, relMSE {targets[0] if targets else 'unknown'}")
    assert np.isfinite(posterior.mean).all()


def inside(judge, prior, own):
    some = slice(0, 512)
    ends = prior.posterior(judge.x[some], exclude=own[some], shares=[0.05, 0.95]).quantiles
    y = judge.reference[some]
    within = (y >= ends[..., 0]) & (y <= ends[..., 1])
    print(f"  of 90 % intervals {within.mean():.1%} contain the reference")


def rivals(judge, own):
    half = np.argwhere(np.add.outer(*map(np.arange, judge.shape)) % 2 == 0)
    ways = {
        "half of the pixels": {"pixels": half},
        "a quarter": {"pixels": half[half[:, 0] % 2 == 0]},
        "nothing between pixels": {"between": 0.0},
        "log-normal mixtures": {"density": "lognormal"},
        "log-normal, nothing between": {"density": "lognormal", "between": 0.0},
    }
    for label, options in ways.items():
        prior = EmpiricalPrior.of(judge.atoms, **options)
        for relative in (0.0, 1.0):
            found = prior.posterior(judge.x, exclude=own, relative=relative)
            judge.line(f"{label} ({found.log_evidence.mean():.2f})", found.mean, relative=relative)
