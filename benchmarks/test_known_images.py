"""Known answers of the made images, and of the figures that `test_refuted` prints of them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import test_refuted as refuted
from benchmarks.known_images import KINDS, Picture, pictures

SOME = ("one noisy channel", "pixels known exactly", "signed samples", "mixture")


def some(seed: int) -> list[Picture]:
    """Return one image of each of some kinds."""
    first: dict[str, Picture] = {}
    for picture in pictures(seed, {kind: KINDS[kind] for kind in SOME}):
        first.setdefault(picture.kind, picture)
    return list(first.values())


@pytest.mark.parametrize("kind", KINDS)
def test_samples_have_the_mean_and_the_covariance_that_an_image_names(kind):
    """The sum of an image is normal: a chance of 1e-6 for each variant (of 80) to be 5 away."""
    n, rng = 64, np.random.default_rng(0)
    for picture in pictures(1, {kind: KINDS[kind]}):
        x = picture.sampler(n, rng).astype(np.float64)
        exact = picture.noise == 0
        assert x.shape == (*picture.truth.shape, n)
        assert (x[exact] == picture.truth[exact][:, np.newaxis]).all()
        if np.isfinite(picture.covariance).all():
            variance = picture.covariance.sum() / n
            assert abs(x.mean(axis=-1).sum() - picture.truth.sum()) < 5 * np.sqrt(variance)
        parts = np.sum([picture.groups.get(name, 0 * exact) for name in refuted.NOISES], axis=0)
        assert (parts == 1).all()


def stream_of(estimate):
    """Return a stream whose estimate is a function of the samples."""

    class Stream:
        def __init__(self, shape):
            self.batches, self.spp = [], 0

        def update(self, batch):
            self.batches.append(batch)
            self.spp += batch.shape[-1]

        def estimate(self, features):
            x = np.concatenate(self.batches, axis=-1).astype(np.float64)
            mean, error = x.mean(axis=-1), x.std(axis=-1, ddof=1) / np.sqrt(x.shape[-1])
            image = estimate(mean)
            reach = 1.645 * error
            return SimpleNamespace(
                radiance=image, mean=mean, low=image - reach, high=image + reach, relative_error=1.0
            )

    return Stream


def lines_of(estimate, monkeypatch) -> dict[str, refuted.Line]:
    monkeypatch.setattr(refuted, "CombinationStream", stream_of(estimate))
    monkeypatch.setattr(refuted, "NUMBERS", (16, 64))
    monkeypatch.setattr(refuted, "NAMES", [""])
    found = refuted.table(some, 1)
    return {line.what: line for line in refuted.summary(found, found)}


def test_the_mean_is_never_worse_than_itself(monkeypatch):
    lines = lines_of(lambda mean: mean, monkeypatch)
    held = [what for what, line in lines.items() if line.held and line.of]
    assert [what for what in lines if what not in held] == [
        what for what in lines if what.startswith(("intervals", "relative_error"))
    ]


def test_a_mean_that_is_too_bright_is_seen(monkeypatch):
    lines = lines_of(lambda mean: 1.1 * mean, monkeypatch)
    missed = [what for what, line in lines.items() if not line.held]
    expected = ("quiet groups", "exact pixels are kept", "images", "sums of classes", "intervals")
    for start in expected:
        assert any(what.startswith(start) for what in missed), start


def test_figures_survive_their_file(tmp_path, monkeypatch):
    monkeypatch.setattr(refuted, "CombinationStream", stream_of(lambda mean: 0.9 * mean))
    monkeypatch.setattr(refuted, "NUMBERS", (4,))
    monkeypatch.setattr(refuted, "NAMES", ["signed"])
    found = refuted.table(some, 2, str(tmp_path / "a.csv"))
    again = refuted.read(str(tmp_path / "a.csv"))
    assert [row.key for row in again] == [row.key for row in found]
    np.testing.assert_allclose([r.mse for r in again], [r.mse for r in found], rtol=1e-4)
    assert [row.apart for row in again] == [row.apart for row in found]


def test_what_is_unknown_is_missed(monkeypatch):
    row = refuted.Row("a", "b", 16, "image", 9, "", *[1.0] * 7, [0.0], np.nan, 1.0)
    missed = [line.what for line in refuted.summary([row]) if not line.held]
    assert missed == ["relative_error: .8 to 1.25 of the true one"]
    monkeypatch.setattr(refuted, "CombinationStream", stream_of(lambda mean: mean * np.nan))
    monkeypatch.setattr(refuted, "NAMES", [""])
    with pytest.raises(AssertionError, match="NaN or infinite"):
        refuted.table(some, 1)
