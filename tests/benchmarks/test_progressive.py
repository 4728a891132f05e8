"""The progressive estimator: its errors on pixels that trained nothing, and how fast it is.

Measured on the stores that the environment variable CHDSTAT_STORES names, their paths separated by
colons; without it, on a simulated image. Errors are relative to those of the sample mean.
"""

import functools
import os
import time

import numpy as np
import pytest

import chdstat as chd
from chdstat.comparison import metrics
from chdstat.estimators import Progressive

SIZES = (4, 8, 16, 32, 64, 128, 256, 512)
CORES = len(os.sched_getaffinity(0))
CLOSE = 1.01
"""Validation loss, over the final one, that training counts as done at."""
IMAGE = (800, 800, 3, 32)


@functools.cache
def simulated():
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:48, :48][..., np.newaxis, np.newaxis] / 48
    albedo = np.where((3 * y + 2 * x) % 1 < 0.5, 0.8, 0.3) * np.array([1, 0.8, 0.5])[:, np.newaxis]
    light = np.exp(np.sin(5 * y) + np.cos(4 * x))
    lit = rng.random((48, 48, 1, 1024)) < 0.3 + 0.2 * np.sin(3 * x)
    draws = light * lit * rng.gamma(0.7, size=(48, 48, 1, 1024))
    return chd.Samples.from_array(albedo * draws, features={"albedo": albedo[..., 0]})


@functools.cache
def opened(source):
    return simulated() if source == "simulated" else chd.open(source).load()


@functools.cache
def trained(source):
    """Train for all numbers of samples, with a reference, once for those who judge it."""
    start = time.perf_counter()
    model = Progressive().train(opened(source), progress=False)
    return model, time.perf_counter() - start


def sources():
    stores = [path for path in os.environ.get("CHDSTAT_STORES", "").split(":") if path]
    return stores or ["simulated"]


each_source = pytest.mark.parametrize("source", sources())


class Judge:
    """Estimates of a whole image from its first samples, against the mean of all others."""

    def __init__(self, samples, spp):
        self.samples = samples
        self.features = samples.features
        self.x = samples.read(ss=slice(0, spp))
        rest = samples.spp - spp
        total = samples.read().sum(axis=-1, dtype=np.float64)
        self.mean = self.x.mean(axis=-1, dtype=np.float64)
        self.reference = (total - spp * self.mean) / rest
        self.scene_mean = self.reference.mean(axis=(0, 1))

    def ratio(self, error, found):
        """Return an error relative to the mean's, averaged over channels."""
        ours, theirs = (error(p).mean(axis=(0, 1)) for p in (found, self.mean))
        return (ours / theirs).mean()

    def judge(self, found):
        y = self.reference
        return {
            "MSE": self.ratio(lambda p: metrics.squared_error(p, y), found),
            "relMSE": self.ratio(
                lambda p: metrics.relative_squared_error(p, y, scene_mean=self.scene_mean), found
            ),
            "improved": metrics.improved(found, y, self.mean).mean(),
            "bias": metrics.bias(found, y).mean(),
        }

    def line(self, label, found):
        print(row(label, self.judge(found)))


def row(label, measures, more=""):
    return (
        f"  {label:36s} MSE {measures['MSE']:.3f}  relMSE {measures['relMSE']:.3f}  "
        f"improved {measures['improved']:.1%}  bias {measures['bias']:+.2%}  {more}"
    )


@pytest.mark.usefixtures("as_benchmark")
@each_source
def test_with_a_reference(source):
    """At 32 spp, on pixels that trained nothing."""
    samples = opened(source)
    names = ["mean", "elek2019", "progressive_mse", "progressive", "progressive_relmse"]
    names += ["progressive_features"] if samples.features else []
    found = chd.compare(samples, names, n=32, progress=False)
    print(f"\n{source}: 32 spp, {found.batches} estimates of {found.test_pixels.sum()} pixels")
    keys = {"MSE": "mse_ratio", "relMSE": "relmse_ratio", "improved": "improved", "bias": "bias"}
    for entry in found.table():
        errors = f"+- {entry['mse_ratio_se']:.3f}, {entry['relmse_ratio_se']:.3f}"
        print(row(entry["estimator"], {k: entry[v] for k, v in keys.items()}, errors))
    assert np.isfinite(found.measures["mse_ratio"].value).all()


@pytest.mark.usefixtures("as_benchmark")
@each_source
def test_error_and_coverage_at_any_number_of_samples(source):
    """One model; of its 90 % intervals, how many contain the mean of the other samples.

    That mean is itself noisy where N is large; then fewer do than contain the truth.
    """
    samples = opened(source)
    model, _ = trained(source)
    test = np.ones(samples.shape[:2], bool)
    test[tuple(model.train_pixels.T)] = False
    print(f"\n{source}: one model, {test.sum()} pixels that trained nothing")
    for n in SIZES:
        judge = Judge(samples, n)
        for loss_weight in (0.0, 0.5, 1.0):
            found = model.estimate(judge.x, loss_weight=loss_weight)
            within = (judge.reference >= found.low) & (judge.reference <= found.high)
            part = judge_of_pixels(judge, found.radiance, test)
            more = f"90 % intervals hold {within[test].mean():.1%}"
            certainty = found.certainty[test].mean()
            print(
                row(
                    f"{n} spp, loss weight {loss_weight}",
                    part,
                    f"{more}, certainty {certainty:.2f}",
                )
            )
            assert np.isfinite(found.radiance).all()
            if loss_weight == 0:
                assert part["MSE"] < 1.02


def judge_of_pixels(judge, found, test):
    """Judge some of the pixels alone."""
    part = object.__new__(Judge)
    part.mean, part.reference = judge.mean[test][np.newaxis], judge.reference[test][np.newaxis]
    part.scene_mean = judge.scene_mean
    return part.judge(found[test][np.newaxis])


@pytest.mark.usefixtures("as_benchmark")
@each_source
def test_training_time(source):
    """Seconds until the validation loss stays within 1 % of its final one."""
    model, seconds = trained(source)
    history = model.history
    far = np.flatnonzero(history.validation_loss > CLOSE * history.validation_loss[-1])
    done = history.iteration[min(far[-1] + 1, len(history.iteration) - 1)] if len(far) else 0
    print(
        f"\n{source}: {history.iteration[-1]} iterations in {seconds:.0f} s on {CORES} cores; "
        f"within 1 % of the final loss ({history.validation_loss[-1]:.3f} of one sample's, the "
        f"mean's {history.validation_baseline[-1]:.3f}) after {done:.0f}, that is "
        f"{seconds * done / history.iteration[-1]:.0f} s"
    )
    assert np.isfinite(history.validation_loss).all()


@pytest.mark.usefixtures("as_benchmark")
def test_estimating_time():
    """800 x 800 x 3 x 32, as published, and how near that is to merely reading the samples."""
    rng = np.random.default_rng(0)
    small = rng.gamma(0.5, size=(100, 100, 3, 32)).astype(np.float32)
    model = Progressive().train(
        chd.Samples.from_array(np.tile(small[:16, :16], 2)), iterations=5, progress=False
    )
    x = np.tile(small, (8, 8, 1, 1))
    assert x.shape == IMAGE
    work = {
        "predict": lambda: model.predict(x),
        "estimate with intervals": lambda: model.estimate(x),
        "copy": x.copy,
        "read": x.sum,
    }
    seconds = {name: min(_seconds(call) for _ in range(3)) for name, call in work.items()}
    bandwidth = 2 * x.nbytes / seconds["copy"][0]
    print(f"\n{x.shape}: copied at {bandwidth / 1e9:.1f} GB/s, on {CORES} cores")
    for name, (wall, processor) in seconds.items():
        share = x.nbytes / bandwidth / wall
        print(
            f"  {name:24s} {wall:.2f} s ({processor:.2f} s of processor time), {share:.1%} of the "
            "memory-bandwidth limit"
        )


def _seconds(call):
    """Return seconds on the clock and of processor time."""
    wall, processor = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - wall, time.process_time() - processor
