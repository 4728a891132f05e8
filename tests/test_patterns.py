"""Patterns: clear cases are found, the false discovery rate holds, labels follow their order."""

import numpy as np
import pytest

import chdstat as chd
from chdstat._reasons import Reason
from chdstat.errors import InputError
from chdstat.patterns import PATTERNS, Label, Thresholds, classify

SPP = 1024
TESTED = ("null_heavy", "long_tail", "bimodal")


def gray(radiance):
    """Return pixels of three equal channels, whose luminance is `radiance` but for rounding."""
    return np.repeat(radiance[..., np.newaxis, :], 3, axis=-2)


def clear_cases(rng, count):
    shape = (count, SPP)
    gamma = rng.gamma(2.0, size=shape)
    indirect = rng.lognormal(-4, 0.6, size=shape)
    return {
        Label.BLACK: np.zeros(shape),
        Label.CONSTANT: np.full(shape, 3.0),
        Label.BIMODAL: np.where(rng.random(shape) < 0.4, indirect, gamma),
        Label.LONG_TAIL: rng.pareto(1.0, size=shape),
        Label.NULL_HEAVY: np.where(rng.random(shape) < 0.7, 0, gamma),
        Label.GAMMA_LIKE: gamma,
        Label.LOGNORMAL_LIKE: rng.lognormal(0, 0.7, size=shape),
    }


@pytest.mark.parametrize("label", [label for label in Label if label != Label.UNDETERMINED])
def test_clear_cases_are_labelled(label):
    # The rarest miss: 2 to 3 % of each, by the level of other flags; below 90 % of 100 pixels is
    # less likely than 1e-4.
    x = clear_cases(np.random.default_rng(int(label)), 100)[label]
    assert (classify(gray(x)).label == label).mean() > 0.9


@pytest.mark.parametrize(
    "draw",
    [
        lambda rng, n: rng.gamma(0.7, size=(n, SPP)),
        lambda rng, n: rng.gamma(5.0, size=(n, SPP)),
        lambda rng, n: rng.lognormal(0, 0.7, size=(n, SPP)),
        lambda rng, n: rng.weibull(0.9, size=(n, SPP)),
    ],
)
def test_plain_distributions_are_rarely_flagged(draw):
    # All are inside the null hypotheses, so below the nominal 5 %; 4 sigma of 400 pixels is 4 %.
    patterns = classify(gray(draw(np.random.default_rng(1), 400)))
    for name in TESTED:
        assert patterns.flags[name].mean() < 0.05 + 0.04
    assert not patterns.flags["constant"].any()


def test_level_of_the_null_test_at_its_threshold():
    # The worst case of the hypothesis: a share of exactly 1/2. Discreteness keeps it below 5 %.
    rng = np.random.default_rng(2)
    x = np.where(rng.random((2000, 256)) < 0.5, 0, rng.gamma(2.0, size=(2000, 256)))
    flagged = classify(gray(x)).flags["null_heavy"].mean()
    assert 0.01 < flagged < 0.05 + 0.02


def test_an_image_keeps_its_false_discovery_rate():
    # 1000 pixels at the edge of the hypothesis and 24 long-tailed ones: tested one by one at 5 %,
    # the false flags outnumber the true ones; over the image, they must not.
    rng = np.random.default_rng(3)
    radiance = rng.lognormal(0, 0.95, size=(32, 32, SPP))
    radiance[0, :24] = rng.pareto(1.0, size=(24, SPP))
    one_by_one = classify(gray(radiance)).flags["long_tail"][1:].sum()
    dataset = chd.classify(chd.Samples.from_array(gray(radiance)), progress=False)
    flagged = dataset["long_tail"].to_numpy()
    assert one_by_one > 10
    assert flagged[0, :24].mean() > 0.8
    assert flagged[1:].sum() <= 5
    q_value = dataset["long_tail_q_value"].to_numpy()
    np.testing.assert_array_equal(flagged, q_value <= 0.05)


def test_flags_do_not_exclude_each_other():
    rng = np.random.default_rng(4)
    x = np.where(rng.random((50, 4096)) < 0.7, 0, rng.pareto(0.9, size=(50, 4096)))
    patterns = classify(gray(x))
    assert (patterns.flags["null_heavy"] & patterns.flags["long_tail"]).mean() > 0.9
    assert (patterns.label == Label.LONG_TAIL).mean() > 0.9


def test_thresholds_move_the_flags():
    rng = np.random.default_rng(5)
    x = gray(np.where(rng.random((20, SPP)) < 0.3, 0, rng.gamma(2.0, size=(20, SPP))))
    assert not classify(x).flags["null_heavy"].any()
    assert classify(x, thresholds=Thresholds(null_share=0.2)).flags["null_heavy"].all()
    tails = gray(rng.pareto(1.0, size=(20, SPP)))
    assert classify(tails).flags["long_tail"].mean() > 0.8
    assert not classify(tails, thresholds=Thresholds(tail_index=2.0)).flags["long_tail"].any()


def test_statistics_are_those_of_the_modules_upstream():
    x = np.random.default_rng(6).gamma(0.7, size=(5, SPP))
    patterns = classify(x[:, np.newaxis])
    tail, modes = chd.fit.tail_index(x), chd.modality(x)
    np.testing.assert_allclose(patterns.statistics["long_tail"], tail.xi)
    np.testing.assert_allclose(patterns.p_values["long_tail"], tail.p_value)
    np.testing.assert_allclose(patterns.statistics["bimodal"], modes.dip)
    np.testing.assert_array_equal(patterns.statistics["null_heavy"], 0)
    np.testing.assert_array_equal(patterns.p_values["null_heavy"], 1)


def test_a_coloured_sample_is_no_null_and_a_bad_channel_spoils_it():
    rng = np.random.default_rng(7)
    x = gray(rng.gamma(2.0, size=(1, SPP)))
    x[0, 1:, :900] = 0
    x[0, 0, :10] = np.nan
    patterns = classify(x)
    assert float(patterns.statistics["null_heavy"][0]) == 0
    assert patterns.null_interval[0, 0] == 0
    few = x[..., :15]
    assert classify(few).reason[0] == Reason.OK
    assert classify(x[..., :10]).reason[0] == Reason.ALL_BAD
    assert classify(x[..., :10]).label[0] == Label.UNDETERMINED


def test_image():
    rng = np.random.default_rng(8)
    cases = clear_cases(rng, 4)
    radiance = gray(np.stack(list(cases.values())))
    dataset = chd.classify(chd.Samples.from_array(radiance, scene="cases"), progress=False)
    for row, label in enumerate(cases):
        assert (dataset["label"][row] == label).mean() >= 0.75
    assert dataset["label"].dims == ("y", "x")
    assert dataset["label"].attrs["flag_meanings"].split()[3] == "bimodal"
    assert dataset["family"].attrs["flag_meanings"] == "none gamma lognormal"
    assert dataset.attrs["threshold_alpha"] == 0.05
    assert dataset.attrs["scene"] == "cases"
    for pattern in PATTERNS:
        assert dataset[pattern.name].dtype == bool
        assert f"{pattern.name}_statistic" in dataset
        assert pattern.source in dataset[pattern.name].attrs["source"]
    for variable in dataset.data_vars.values():
        assert {"long_name", "units"} <= set(variable.attrs)


def test_wrong_input_is_refused():
    with pytest.raises(InputError, match="alpha"):
        Thresholds(alpha=2)
    with pytest.raises(InputError, match="channel, sample"):
        classify(np.ones(30))
    with pytest.raises(InputError, match="1 or 3 channels"):
        classify(np.ones((2, 30)))
