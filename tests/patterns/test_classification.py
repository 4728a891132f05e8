"""Patterns: clear cases are found, the false discovery rate holds, labels follow their order."""

import re

import numpy as np
import pytest
import xarray as xr

import chdstat as chd
from chdstat.errors import Reason
from chdstat.fit.families import FAMILIES
from chdstat.patterns import (
    CHD,
    PATTERNS,
    Component,
    Label,
    Thresholds,
    agreement,
    choose_regions,
    classify,
    simulate,
)
from chdstat.patterns.classification import untrusted_variance
from tests.patterns.flag_scores import flag_scores, penultimate_index, random_chds

SPP = 1024
FAMILY_FLAGS = ("gamma_like", "lognormal_like")
GAMMA = Component("gamma", 2.0)


def gray(radiance):
    """Return pixels of three equal channels, whose luminance is `radiance` but for rounding."""
    return np.repeat(radiance[..., np.newaxis, :], 3, axis=-2)


def clear_cases(rng, count):
    shape = (count, SPP)
    gamma = rng.gamma(2.0, size=shape)
    kind = rng.choice(3, p=[0.4, 0.3, 0.3], size=shape)
    kinds = (rng.lognormal(-4, 0.4, size=shape), gamma, rng.lognormal(5, 0.3, size=shape))
    firefly = gamma.copy()
    firefly[:, 5] = 1000
    return {
        Label.BLACK: np.zeros(shape),
        Label.CONSTANT: np.full(shape, 3.0),
        Label.FIREFLY_DOMINATED: firefly,
        Label.MULTIMODAL: np.choose(kind, kinds),
        Label.BIMODAL: np.where(rng.random(shape) < 0.4, kinds[0], gamma),
        # Few samples of a long tail are dominated by one of them.
        Label.LONG_TAIL: CHD((GAMMA,), tail_index=0.7, tail_share=0.25).draw(
            count, samples=16 * SPP, seed=rng
        ),
        Label.NULL_HEAVY: np.where(rng.random(shape) < 0.7, 0, gamma),
        Label.GAMMA_LIKE: gamma,
        Label.LOGNORMAL_LIKE: rng.lognormal(0, 0.4, size=shape),
        Label.OTHER: rng.uniform(size=shape),
    }


@pytest.mark.parametrize("label", [label for label in Label if label != Label.UNDETERMINED])
def test_clear_cases_are_labelled(label):
    # Up to a tenth of the tails and of the bodies are missed: 80 % of 100 pixels is 3 sigma below.
    x = clear_cases(np.random.default_rng(int(label)), 100)[label]
    assert (classify(gray(x)).label == label).mean() > 0.8


@pytest.mark.parametrize(
    "draw",
    [
        lambda rng, n: rng.gamma(0.7, size=(n, SPP)),
        lambda rng, n: rng.gamma(5.0, size=(n, SPP)),
        lambda rng, n: rng.lognormal(0, 0.4, size=(n, SPP)),
        lambda rng, n: rng.weibull(1.2, size=(n, SPP)),
    ],
)
def test_plain_distributions_are_rarely_flagged(draw):
    # Tail indices at or below 0 up to second order, one mode, no nulls: below the nominal 5 %;
    # 4 sigma of 400 pixels is 4 %.
    patterns = classify(gray(draw(np.random.default_rng(1), 400)))
    for name in ("null_heavy", "long_tail", "bimodal", "multimodal"):
        assert patterns.flags[name].mean() < 0.05 + 0.04
    assert not patterns.flags["constant"].any()
    assert not patterns.flags["firefly_dominated"].any()


@pytest.mark.parametrize("samples", [32, 64, 128])
def test_level_of_the_tail_test_with_few_samples(samples):
    # Exponential samples, of which log-normal is the better family in a third of all cases at 32.
    # Of 4000 p-values 200 are below 5 % and 20 below 0.5 %; the two tests are approximate.
    x = np.random.default_rng(1).exponential(size=(4000, samples))
    found = classify(gray(x))
    assert found.flags["long_tail"].mean() < 0.08
    assert np.mean(found.flags["long_tail"] & (found.p_values["long_tail"] < 0.005)) < 0.01


def test_level_of_the_null_test_at_its_threshold():
    # The worst case of the hypothesis: a share of exactly 1/2. Discreteness keeps it below 5 %.
    rng = np.random.default_rng(2)
    x = np.where(rng.random((2000, 256)) < 0.5, 0, rng.gamma(2.0, size=(2000, 256)))
    flagged = classify(gray(x)).flags["null_heavy"].mean()
    assert 0.01 < flagged < 0.05 + 0.02


def test_an_image_keeps_its_false_discovery_rate():
    # 992 pixels at the edge of the hypothesis and 32 with more nulls: tested one by one at 5 %, the
    # false flags outnumber half the true ones; over the image, they must not.
    half, most = (CHD((GAMMA,), null_share=share) for share in (0.5, 0.75))
    samples = simulate([most, *[half] * 31], shape=(24, 48), spp=256, seed=3)
    true = np.zeros((24, 48), dtype=bool)
    true[:4, :8] = True
    one_by_one = classify(samples.read()).flags["null_heavy"][~true].sum()
    dataset = chd.classify(samples, progress=False)
    flagged = dataset["null_heavy"].to_numpy()
    assert one_by_one > 20
    assert flagged[true].mean() > 0.9
    assert flagged[~true].sum() <= 6
    q_value = dataset["null_heavy_q_value"].to_numpy()
    np.testing.assert_array_equal(flagged, q_value <= 0.05)


def test_flags_do_not_exclude_each_other():
    tail = CHD((GAMMA,), tail_index=1.2, tail_share=0.25, null_share=0.7)
    patterns = classify(gray(tail.draw(50, samples=4096, seed=4)))
    assert (patterns.flags["null_heavy"] & patterns.flags["long_tail"]).mean() > 0.9
    assert np.isin(patterns.label, [Label.LONG_TAIL, Label.FIREFLY_DOMINATED]).all()


def test_only_one_plain_body_is_like_a_family():
    rng = np.random.default_rng(4)
    cases = clear_cases(rng, 40)
    flags = {label: classify(gray(x)).flags for label, x in cases.items()}
    for label, found in flags.items():
        assert not (found["gamma_like"] & found["lognormal_like"]).any()
        for other in ("constant", "bimodal", "multimodal"):
            assert not ((found["gamma_like"] | found["lognormal_like"]) & found[other]).any()
        if label in (Label.OTHER, Label.MULTIMODAL, Label.BIMODAL, Label.CONSTANT, Label.BLACK):
            assert not any(found[name].mean() > 0.1 for name in FAMILY_FLAGS)
    assert flags[Label.NULL_HEAVY]["gamma_like"].mean() > 0.8


def test_a_firefly_decides_no_shape():
    rng = np.random.default_rng(5)
    x = rng.gamma(2.0, size=(100, SPP))
    x[:, 7] = 1e4
    patterns, clean = classify(gray(x)), classify(gray(np.delete(x, 7, axis=-1)))
    assert patterns.flags["firefly_dominated"].all()
    assert not clean.flags["firefly_dominated"].any()
    # But the error bar of the pixel fails with such a sample in it: others lack it.
    assert patterns.flags["long_tail"].all()
    assert not clean.flags["long_tail"].any()
    for name in ("bimodal", "gamma_like", "lognormal_like"):
        np.testing.assert_array_equal(patterns.flags[name], clean.flags[name])
        np.testing.assert_allclose(patterns.statistics[name], clean.statistics[name], rtol=1e-4)


def test_few_samples_have_few_fireflies():
    x = np.full((1, 20), 1.0)
    x[0, :2] = 3.0
    assert not classify(gray(x)).flags["firefly_dominated"].any()
    x[0, 0] = 50.0
    assert classify(gray(x)).flags["firefly_dominated"].all()
    few = Thresholds(firefly_samples=1.0)
    assert classify(gray(x[:, 1:]), thresholds=few).flags["firefly_dominated"].all()


def test_thresholds_move_the_flags():
    rng = np.random.default_rng(5)
    x = gray(np.where(rng.random((20, SPP)) < 0.3, 0, rng.gamma(2.0, size=(20, SPP))))
    assert not classify(x).flags["null_heavy"].any()
    assert classify(x, thresholds=Thresholds(null_share=0.2)).flags["null_heavy"].all()
    tails = gray(rng.pareto(1.0, size=(20, SPP)))
    assert classify(tails).flags["long_tail"].mean() > 0.8
    plain = gray(rng.gamma(2.0, size=(20, SPP)))
    assert not classify(plain).flags["long_tail"].any()
    assert classify(plain, thresholds=Thresholds(misses=0.01)).flags["long_tail"].all()
    two = gray(clear_cases(rng, 20)[Label.BIMODAL])
    assert classify(two).flags["bimodal"].all()
    assert not classify(two, thresholds=Thresholds(ashman_d=20.0)).flags["bimodal"].any()


@pytest.mark.parametrize(
    "component",
    [Component("gamma", 0.4), Component("gamma", 3.0), Component("lognormal", 0.8)],
)
def test_the_body_has_its_tail_index(component):
    # The shape of 50 000 samples is right to about 0.7 %.
    body = CHD((component,))
    patterns = classify(gray(body.draw(1, samples=50_000, seed=1)))
    assert patterns.body_tail_index[0] == pytest.approx(penultimate_index(body), abs=0.015)


def test_a_heavy_body_is_not_plain():
    """Log-normal, sigma 1.2: 92 % of the error bars of 512 samples hold (20 000 simulated)."""
    draw = CHD((Component("lognormal", 1.2),)).draw
    found = classify(gray(draw(200, samples=512, seed=1)))
    assert found.flags["long_tail"].mean() < 0.05
    assert found.flags["lognormal_like"].mean() < 0.1


def test_what_the_samples_cannot_tell_is_said():
    """Of a rare tail of index 1: not long, not short. 96 % of 40 were measured; below 30: 1e-6."""
    rng = np.random.default_rng(61)
    x = rng.exponential(size=(40, 1, 8192))
    rare = rng.random(x.shape) < 0.003
    x[rare] = 5 + rng.pareto(1.0, size=np.count_nonzero(rare))
    found = chd.classify(x)
    assert found.variance_unidentified.sum() >= 30


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_coloured_samples_are_no_nulls():
    rng = np.random.default_rng(7)
    x = gray(rng.gamma(2.0, size=(1, SPP)))
    x[0, 1:, :900] = 0
    x[0, 0, :10] = np.nan
    patterns = classify(x)
    assert float(patterns.statistics["null_heavy"][0]) == 0
    assert patterns.intervals["null_heavy"][0, 0] == 0
    few = x[..., :15]
    assert classify(few).reason[0] == Reason.OK
    assert classify(x[..., :10]).reason[0] == Reason.ALL_BAD
    assert classify(x[..., :10]).label[0] == Label.UNDETERMINED


@pytest.mark.parametrize("scale", [1e-38, 1.0, 1e30])
def test_scaling_radiance_changes_no_pattern(scale):
    x = np.stack([case[0, :SPP] for case in clear_cases(np.random.default_rng(8), 1).values()])
    one, other = classify(x[:, np.newaxis]), classify(scale * x[:, np.newaxis])
    np.testing.assert_array_equal(one.label, other.label)
    for name, value in one.statistics.items():
        np.testing.assert_allclose(other.statistics[name], value, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("samples", [1, 2, 3, 5, 19])
def test_few_samples_give_no_shape(samples):
    x = np.random.default_rng(9).gamma(2.0, size=(6, samples))
    x[0] = 0
    x[1, 1:] = 0
    x[2] = 4
    patterns = classify(gray(x))
    assert patterns.label[0] == Label.BLACK
    assert (patterns.label[3:] == Label.UNDETERMINED).all()
    assert not any(patterns.flags[name].any() for name in ("long_tail", "bimodal", "gamma_like"))


def test_image():
    for label, radiance in clear_cases(np.random.default_rng(8), 16).items():
        image = chd.Samples.from_array(gray(radiance).reshape(4, 4, 3, -1), scene="cases")
        dataset = chd.classify(image, progress=False)
        # The pixels around know that most error bars of 16 384 samples hold.
        assert (dataset["label"] == label).mean() >= 0.75
    assert dataset["label"].dims == ("y", "x")
    assert dataset["label"].attrs["flag_meanings"].split()[5] == "bimodal"
    assert dataset["long_tail_interval"].dims == ("y", "x", "bound")
    assert dataset["luminance_family"].attrs["flag_meanings"].split() == ["none", *FAMILIES]
    assert dataset.attrs["threshold_alpha"] == 0.05
    assert dataset.attrs["scene"] == "cases"
    for pattern in PATTERNS:
        assert dataset[pattern.name].dtype == bool
        assert f"{pattern.name}_statistic" in dataset
        assert pattern.source in dataset[pattern.name].attrs["source"]
    for variable in dataset.data_vars.values():
        assert {"long_name", "units"} <= set(variable.attrs)


@pytest.mark.parametrize("spp", [32, 256])
def test_variances_that_cannot_be_trusted_are_those_of_long_tails_and_fireflies(spp):
    kinds = ["gamma", "long-tail", "null-heavy", "firefly"]
    samples = chd.simulate(kinds, shape=(16, 16), spp=spp, seed=2)
    found = chd.classify(samples, progress=False)
    flagged = (found["long_tail"] | found["firefly_dominated"]).to_numpy()
    assert 0 < flagged.mean() < 1
    np.testing.assert_array_equal(untrusted_variance(samples, progress=False), flagged)


def test_labels_of_regions_agree_with_their_neighbours():
    samples = simulate(["gamma", "bimodal", "constant", "null-heavy"], shape=(16, 16), spp=256)
    found = chd.classify(samples, progress=False)["label_agreement"]
    assert found.attrs["kappa"] > 0.7
    assert found[2:6, 2:6].mean() > 0.9


def test_expectation_is_that_of_shuffled_labels():
    rng = np.random.default_rng(10)
    labels = rng.choice(4, p=[0.5, 0.3, 0.15, 0.05], size=(9, 7))
    known = rng.random((9, 7)) < 0.85
    found = agreement(labels, known)
    shares = np.empty(1000)
    for i in range(1000):
        labels[known] = rng.permutation(labels[known])
        shares[i] = agreement(labels, known).observed
    assert abs(shares.mean() - found.expected) < 4 * shares.std() / np.sqrt(1000)


def test_agreement_of_known_maps():
    checkers = np.indices((8, 8)).sum(axis=0) % 2
    inside = agreement(checkers).share[1:-1, 1:-1]
    np.testing.assert_array_equal(inside, 0.5)
    one = agreement(np.zeros((5, 5), dtype=int))
    assert one.share.min() == 1
    assert np.isnan(one.kappa)
    lonely = np.zeros((3, 3), dtype=bool)
    lonely[1, 1] = True
    assert np.isnan(agreement(checkers[:3, :3], lonely).share).all()
    assert agreement(checkers).expected == pytest.approx(31 / 63)


def test_flags_are_right_on_a_population():
    # A small run of benchmarks/test_patterns.py, which has the figures.
    scores = flag_scores(random_chds(300, seed=11), 512, seed=11)
    assert np.mean([score.f1 for score in scores.values()]) > 0.88
    assert min(score.f1 for score in scores.values()) > 0.6


FLAGS = {
    "flag_values": [int(label) for label in Label],
    "flag_meanings": " ".join(label.name.lower() for label in Label),
}


def test_one_pure_region_is_chosen_for_each_pattern():
    label = np.full((32, 32), Label.GAMMA_LIKE, dtype=np.int8)
    label[20:28, 4:12] = Label.BIMODAL
    label[2, 30] = Label.LONG_TAIL
    dataset = xr.Dataset({"label": (("y", "x"), label, FLAGS)})
    regions = choose_regions(dataset)
    assert [r.name for r in regions] == ["gamma-like", "bimodal", "long-tail"]
    for region, code in zip(regions[:2], (Label.GAMMA_LIKE, Label.BIMODAL), strict=True):
        assert (label[region.pixels(32, 32)] == code).all()
    assert label[regions[2].center(32, 32)] == Label.LONG_TAIL


def test_the_middle_of_a_region_has_its_label():
    label = np.full((9, 12), Label.OTHER, dtype=np.int8)
    label[:2, :3] = Label.BLACK
    label[8, 11] = Label.CONSTANT
    regions = choose_regions(xr.Dataset({"label": (("y", "x"), label, FLAGS)}))
    names = {r.name: Label(label[r.center(9, 12)]).name.lower() for r in regions}
    assert names == {"other": "other", "black": "black", "constant": "constant"}


def test_choosing_works_on_a_single_pixel():
    label = xr.DataArray(np.full((1, 1), Label.BLACK), dims=("y", "x"), attrs=FLAGS)
    (region,) = choose_regions(xr.Dataset({"label": label}))
    assert region.pixels(1, 1) == (slice(0, 1), slice(0, 1))


def test_patterns_are_read_by_name():
    x = np.random.default_rng(0).gamma(2.0, size=(2, 1, 128))
    x[1] = 0
    assert re.search(r"label  black\n.*\n  null_heavy +yes +1\.00", repr(classify(x[1])))
    assert re.search(r"label +.*black 50\s%", repr(classify(x)))
