"""Samples that depend on each other: what takes them, what refuses them, and their averages."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError
from chdstat.estimators import MLP, train_model
from chdstat.inference import difference

N, SEQUENCES = 16, 64


def spread(seed: int = 0, *, shape: tuple[int, ...] = (8, 8, 3), total: int = SEQUENCES) -> Any:
    """Return uniform samples of which each stratum of a sequence holds one."""
    rng = np.random.default_rng(seed)
    order = rng.permuted(np.broadcast_to(np.arange(N), (*shape, total, N)), axis=-1)
    x = (order + rng.random(order.shape)) / N
    return x.reshape(*shape, total * N).astype(np.float32)


def stratified(seed: int = 0, **options: Any) -> chd.Samples:
    x = spread(seed, **options)
    return chd.Samples.from_array(x, scene="wall", sampler="stratified", sequence=N)


# --- averages -----------------------------------------------------------------------------------


def test_means_of_sequences_are_averages():
    samples = stratified()
    means = samples.sequence_means()
    expected = samples.read().reshape(8, 8, 3, SEQUENCES, N).mean(axis=-1, dtype=np.float64)
    np.testing.assert_allclose(means.read(), expected, rtol=1e-6)
    assert means.attrs["averaged"] == N
    assert means.attrs["spp"] == SEQUENCES
    assert "sequence" not in means.attrs
    assert "(averages of 16)" in repr(means)
    assert "1024 spp in stratified sequences of 16" in repr(samples)
    assert "in sequences of 16 samples that depend on each other" in samples._repr_html_()


def test_whole_sequences_have_means():
    samples = stratified()
    whole = samples.sequence_means().read()
    part = samples.isel(y=slice(2, 4), sample=slice(32, 70))
    assert np.array_equal(part.sequence_means().read(), whole[2:4, ..., 2:4])
    assert np.array_equal(part.load().sequence_means().read(), whole[2:4, ..., 2:4])
    for sample in (slice(8, 40), slice(None, None, 2)):
        part = samples.isel(sample=sample)
        for function in (part.sequence_means, lambda p=part: chd.summarize(p)):
            with pytest.raises(InputError, match="sequences of 16"):
                function()
    with pytest.raises(InputError, match="8 of a sequence of 16"):
        samples.isel(sample=slice(8)).sequence_means()
    with pytest.raises(InputError, match="independent"):
        chd.Samples.from_array(spread()).sequence_means()


def test_an_average_with_a_bad_sample_is_bad():
    x = spread()
    x[0, 0, 0, 3] = np.nan
    x[1, 1, 1, 20] = np.inf
    means = chd.Samples.from_array(x, sequence=N).sequence_means().read()
    assert np.argwhere(~np.isfinite(means)).tolist() == [[0, 0, 0, 0], [1, 1, 1, 1]]


# --- what is corrected --------------------------------------------------------------------------


def test_the_standard_error_is_that_of_the_averages():
    """Of one uniform number in each of n strata, the mean has 1/n^2 of the variance."""
    samples = stratified()
    found = chd.summarize(samples)
    means = samples.sequence_means().read()
    expected = means.std(axis=-1, ddof=1) / np.sqrt(SEQUENCES)
    np.testing.assert_allclose(found["standard_error"], expected, rtol=1e-4)
    assert float(found["standard_error"].mean()) == pytest.approx(
        np.sqrt(1 / 12 / (N * SEQUENCES)) / N, rel=0.05
    )
    as_independent = chd.summarize(chd.Samples.from_array(samples.read()))
    ratio = as_independent["standard_error"] / found["standard_error"]
    assert float(ratio.mean()) == pytest.approx(N, rel=0.05)
    for name in ("mean", "variance", "null_share", "log_counts"):
        assert np.array_equal(found[name], as_independent[name]), name


def test_batches_are_of_whole_sequences():
    found = chd.summarize(stratified(), batch_size=20)
    assert found.attrs["batch_size"] == 32
    assert (found["batch_spp"] == 32).all()


def test_few_and_many_sequences():
    assert chd.summarize(stratified(total=1))["standard_error"].isnull().all()
    samples = stratified(shape=(4, 4, 1), total=700)  # more than are kept
    found = chd.summarize(samples)["standard_error"].to_numpy()
    expected = samples.sequence_means().read().std(axis=-1, ddof=1) / np.sqrt(700)
    assert abs(found / expected - 1).max() < 0.25
    assert abs(found.mean() / expected.mean() - 1) < 0.05


def test_a_contrast_takes_averages_of_sequences():
    independent = chd.Samples.from_array(np.random.default_rng(5).random((8, 8, 3, 512)))
    found = chd.contrast(stratified(), independent)
    assert found.spp == (SEQUENCES, 512)
    assert found.outcome == "no difference found"
    assert float(found.maps["variance_a"].mean()) == pytest.approx(
        float(found.maps["variance_b"].mean()) / N**2, rel=0.1
    )
    x = independent.read() * 0.99
    darker = chd.contrast(stratified(), chd.Samples.from_array(x))
    assert darker.outcome == "differ"


def test_other_averages_are_not_compared():
    b = chd.Samples.from_array(np.random.default_rng(5).random((8, 8, 3, 64)))
    with pytest.raises(InputError, match="16 and 1"):
        chd.contrast(stratified(), b, distributions=True)
    both = chd.contrast(stratified(), stratified(1), distributions=True)
    assert "variance_q_value" in both.maps


# --- what is refused, and what is not -----------------------------------------------------------

REFUSED = {
    "analyze": chd.analyze,
    "classify": chd.classify,
    "gaussianity": chd.gaussianity,
    "gaussianity_of_means": chd.inference.gaussianity_of_means,
    "modality": chd.modality,
    "atlas": chd.atlas,
    "fit": chd.fit.select,
    "goodness": lambda x: chd.fit.goodness(x, "gamma"),
    "tail": chd.fit.tail_index,
    "compare": lambda x: chd.compare(x, ["mean"]),
    "error_curve": lambda x: chd.comparison.error_curve(x, ["mean"]),
    "estimate": chd.estimate,
    "predict": MLP.preset("elek2019").predict,
    "estimate by a model": MLP.preset("elek2019").estimate,
    "train": lambda x: train_model(x, "elek2019", iterations=1),
    "difference": lambda x: difference(x, x),
    "study": lambda x: chd.study(x, estimators=["mean"]),
    "map": lambda x: x.map(lambda block: {"mean": (("channel",), block.mean(axis=-1))}),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_assumes_independence_refuses(name):
    with pytest.raises(InputError, match=r"16 at a time.*sequence_means\(\)"):
        REFUSED[name](stratified())


def test_what_looks_at_single_samples_takes_them():
    samples = stratified()
    same = chd.Samples.from_array(samples.read())
    assert np.array_equal(chd.histogram(samples)["log_counts"], chd.histogram(same)["log_counts"])
    assert samples.to_dataset()["radiance"].shape == samples.shape
    found = samples.map(lambda block: {"mean": (("channel",), block.mean(axis=-1))}, dependent=True)
    assert found["mean"].shape == (8, 8, 3)
    pixel = samples.pixel(2, 3)
    assert "in sequences of 16" in pixel._card().html()
    error = chd.summarize(samples)["standard_error"][2, 3]
    np.testing.assert_allclose(pixel.statistics["standard_error"], error, rtol=1e-6)
    pixel.plot().savefig(io.BytesIO())


# --- stores -------------------------------------------------------------------------------------


def test_a_store_mixes_no_sequences(tmp_path):
    samples = stratified()
    stored = samples.save(tmp_path / "a.zarr")
    assert stored.attrs["sequence"] == N
    means = stored.sequence_means()
    assert np.array_equal(means.read(), samples.sequence_means().read())
    assert means.save(tmp_path / "m.zarr").attrs["averaged"] == N
    stratified(1).save(tmp_path / "a.zarr", append=True)
    assert chd.open(tmp_path / "a.zarr").sequence_means().spp == 2 * SEQUENCES
    independent = chd.Samples.from_array(np.random.default_rng(5).random((8, 8, 3, 64)))
    with pytest.raises(InputError, match="sequences of 1 "):
        independent.save(tmp_path / "a.zarr", append=True)
    with pytest.raises(InputError, match="whole sequences"):
        samples.isel(sample=slice(8, 40)).save(tmp_path / "b.zarr")


def test_samplers_of_one_seed_share_no_numbers():
    x = spread()
    one, same, other = (
        chd.Samples.from_array(x, seed=0, **about)
        for about in (
            {"sampler": "stratified", "sequence": N},
            {"sampler": "stratified", "sequence": N},
            {"sampler": "independent"},
        )
    )
    assert one.shares_numbers_with(same)
    assert not one.shares_numbers_with(other)
    assert other.shares_numbers_with(chd.Samples.from_array(x, seed=0))
    assert one.sequence_means().shares_numbers_with(same.sequence_means())
    assert not one.sequence_means().shares_numbers_with(other)
