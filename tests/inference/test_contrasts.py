"""Contrasts: p-values that hold their level under the null, power, and what is said in words."""

from __future__ import annotations

import numpy as np
import pytest

import chdstat as chd
from chdstat._core.work import finished
from chdstat.errors import Reason
from chdstat.inference import contrast
from chdstat.inference.contrasts import contrasting
from chdstat.inference.permutations import p_of_signs
from chdstat.inference.references import Reference
from chdstat.inference.render_pairs import Pair, seconds_of
from chdstat.inference.windows import Cells, scan_windows, window_sums
from chdstat.io import read_exr, write_exr
from tests.luminance import LUMINANCE

LEVELS = np.array([0.01, 0.05, 0.1])
EDGE = 48


def heavy(rng, spp, *, nulls=0.5, sigma=1.2, edge=EDGE):
    """Return radiance of a smooth image with many nulls and log-normal tails."""
    y, x = np.mgrid[:edge, :edge] / edge
    level = (0.2 + y + 2 * x * y)[:, :, np.newaxis, np.newaxis]
    grey = rng.lognormal(0, sigma, (edge, edge, 1, spp)) * (
        rng.random((edge, edge, 1, spp)) > nulls
    )
    return (level * grey * [[0.9], [0.7], [0.5]]).astype(np.float32)


def roulette(rng, x, survival=0.5):
    """Return samples of which a share survives, and is brighter for it: of equal mean."""
    alive = rng.random((*x.shape[:2], 1, x.shape[3])) < survival
    return (x * alive / survival).astype(np.float32)


# --- calibration --------------------------------------------------------------------------------


@pytest.mark.parametrize("spp", [16, 64])
@pytest.mark.parametrize("kind", ["same", "roulette", "paired", "exact"])
def test_p_values_hold_their_level(kind, spp):
    """At most a + .01 of p-values up to a; not below a / 2 where both are of one distribution.

    Of 2304 pixels in 4 correlated channels, a share of 1 % varies by .002 and less: hence the
    margin of .003 below, which a seed of a hundred would cross. The seed is fixed.
    """
    rng = np.random.default_rng(5)
    a = heavy(rng, spp)
    b = {
        "same": lambda: heavy(rng, spp),
        "roulette": lambda: roulette(rng, heavy(rng, spp)),
        "paired": lambda: roulette(rng, a),
        "exact": lambda: heavy(rng, 1, nulls=0, sigma=0)[..., 0] * 0.5 * np.exp(1.2**2 / 2),
    }[kind]()
    found = contrast(a, b)
    p = found.p_value.to_numpy()
    shares = (p[..., np.newaxis] <= LEVELS).mean(axis=(0, 1, 2))
    assert (shares <= LEVELS + 0.01).all(), shares
    assert np.nanmin(found.q_value) > 0.01
    if kind == "same":
        assert (shares >= LEVELS / 2 - 0.003).all(), shares


def test_plain_flips_of_signs_would_not_hold_it():
    """The negative control: what neighbours have seen is needed."""
    rng = np.random.default_rng(5)
    a = heavy(rng, 64)
    d = (roulette(rng, a, 0.1) - a)[:, :, 0].reshape(-1, 64)
    assert (p_of_signs(d) <= 0.01).mean() > 0.05
    assert (contrast(a, roulette(rng, a, 0.1)).p_value <= 0.01).mean() <= 0.02


@pytest.mark.parametrize("paired", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_outcome_holds_its_level(paired):
    """Of 60 pairs, more than 9 at 5 % would happen in 1 of 1000 runs.

    p-values are cautious: .5 is above .22 of them or more (480 pairs), and above fewer than 4 of 60
    in 1 of 4000 runs.
    """
    rng = np.random.default_rng(11)
    p = []
    for seed in range(60):
        a = heavy(rng, 24, edge=24)
        b = roulette(rng, a if paired else heavy(rng, 24, edge=24))
        p.append(contrast(a, b, seed=seed).image_p_value)
    assert np.sum(np.array(p) <= 0.05) <= 9
    assert np.sum(np.array(p) <= 0.5) >= 4


def test_missed_rare_light_is_no_darkness():
    """Of samples shared but for 2 %, of which 1 of 10 lives on: 21 of 150 without `_missed`.

    At 5 %, more than 16 of 150 would happen in 3 of 1000 runs; the seed is fixed.
    """
    rng = np.random.default_rng(3)
    level, p = np.ones((1, 4, 4, 32)), []
    for seed in range(150):
        x = rng.gamma(0.5, size=(16, 16, 32))
        lives, drawn = rng.random(x.shape) < 0.1, rng.random(x.shape) < 0.02
        cells = (drawn * x * (lives / 0.1 - 1)).reshape(4, 4, 4, 4, 32).sum(axis=(1, 3))
        p.append(finished(scan_windows(Cells(cells[np.newaxis], level), seed=seed)).p_value)
    assert np.sum(np.array(p) <= 0.05) <= 16


@pytest.mark.filterwarnings("error")
def test_dark_windows_say_nothing():
    rng = np.random.default_rng(1)
    for _ in range(20):
        d = rng.lognormal(0, 2, (1, 12, 12, 16)) * rng.choice([-1, 1], (1, 12, 12, 16))
        d[:, 3:9, 2:10] = 0
        d *= rng.random(d.shape) < 0.2
        assert 0 < finished(scan_windows(Cells(d, np.ones(d.shape)))).p_value <= 1


# --- unequal numbers of samples -----------------------------------------------------------------


@pytest.fixture
def signs_only(monkeypatch):
    """Compare renders of unequal spp by flips of signs alone, which are not exact there."""
    monkeypatch.setattr(Pair, "units", property(lambda _: (0, 0)))


def with_fireflies(rng, spp, base, *, edge=16):
    """Return radiance of which one sample in 2000 is far brighter."""
    size = (edge, edge, 1, spp)
    level = {"constant": np.full(size, 0.1), "gamma": rng.gamma(1.0, 0.1, size)}[base]
    return (level + 100 * (rng.random(size) < 1 / 2000)).astype(np.float32)


def outcomes(base, counts, trials=40):
    found = []
    for seed in range(trials):
        rng = np.random.default_rng([seed, *counts])
        found.append(contrast(*(with_fireflies(rng, n, base) for n in counts), seed=seed))
    return found


@pytest.mark.parametrize(
    ("base", "counts"),
    [("constant", (32, 100)), pytest.param("gamma", (256, 16), marks=pytest.mark.slow)],
)
def test_fireflies_make_no_difference_at_unequal_spp(base, counts):
    """Of 40 pairs, more than 7 at 5 % would happen in 1 of 1200 runs; signs alone have 10 or so."""
    found = outcomes(base, counts)
    assert sum(f.outcome == "differ" for f in found) <= 7
    assert sum((f.q_value <= 0.05).any().item() for f in found) <= 7


@pytest.mark.usefixtures("signs_only")
def test_signs_of_unequal_terms_alone_would_make_one():
    """The negative control."""
    assert sum(f.outcome == "differ" for f in outcomes("gamma", (256, 16))) > 7


@pytest.mark.parametrize("order", [1, -1])
def test_what_the_shorter_render_has_not_seen_is_said(order):
    rng = np.random.default_rng(1)
    short, longer = rng.gamma(1.0, size=(8, 8, 1, 16)), rng.gamma(1.0, size=(8, 8, 1, 256))
    longer[[1, 5, 7], 2, 0, [3, 50, 200]] = 2000.0
    found = contrast(*(short, longer)[::order])
    name, other = "AB"[::order]
    assert found.outcome == "cannot tell"
    assert found.why.startswith(f"{other} has 2")  # 6000 of 22,000
    assert found.why.endswith(f"{name} has none: render {found.spp_needed} of {name}")
    # Three of 256 samples of the image have it.
    assert found.spp_needed == pytest.approx(np.log(0.05) / np.log(1 - 3 / 256), abs=3)
    assert found.to_dict()["spp_needed"] == found.spp_needed
    longer[longer > 1000] = 1.0
    assert contrast(short, longer).outcome == "no difference found"


def test_light_not_seen_is_a_difference():
    """The longer render has fireflies in one of 100 samples, the shorter one none of 1024."""
    rng = np.random.default_rng(2)
    short, longer = rng.gamma(1.0, size=(8, 8, 1, 16)), rng.gamma(1.0, size=(8, 8, 1, 256))
    longer += 1000 * (rng.random(longer.shape) < 0.01)
    assert contrast(short, longer).outcome == "differ"


@pytest.mark.parametrize("counts", [(16, 256), (100, 30), (16, 24), (300, 1000)])
def test_a_loss_is_found_and_placed_at_unequal_spp(counts):
    rng = np.random.default_rng(3)
    a, b = (rng.gamma(1.0, size=(16, 16, 1, n)) for n in counts)
    b[4:12, 4:12] *= 0.5
    found = contrast(a, b)
    assert found.outcome == "differ"
    y, x, height, width = found.window
    assert y < 12 and y + height > 4 and x < 12 and x + width > 4  # noqa: PT018
    assert found.spp_needed is None


@pytest.mark.parametrize("counts", [(16, 256), (300, 1000), (257, 999), (16, 24), (9, 4000)])
def test_the_shorter_render_is_compared_as_a_whole(counts):
    pair = Pair.of(*(np.zeros((1, 1, 1, n), np.float32) for n in counts), None)
    assert min(pair.units) == pair.terms


def test_samples_that_both_have_make_no_difference():
    """Renders of one seed: the first samples of the longer one are those of the shorter one."""
    for seed in range(10):
        x = with_fireflies(np.random.default_rng(seed), 256, "gamma", edge=8)
        assert contrast(x[..., :16], x, seed=seed).outcome != "differ"
        short, longer = (chd.Samples.from_array(s, seed=3) for s in (x[..., :16], x))
        assert "one render given twice" in contrast(short, longer).conclusion
        rest = longer.isel(sample=slice(16, 256))
        assert not contrast(short, rest, seed=seed).paired
        assert contrast(short, rest, seed=seed).outcome != "differ"


@pytest.mark.parametrize("counts", [(1, 1), (1, 16), (64, 1), (2, 3)])
def test_few_samples_tell_nothing(counts):
    rng = np.random.default_rng(4)
    found = contrast(*(rng.gamma(1.0, size=(8, 8, 1, n)) for n in counts))
    assert found.outcome == "cannot tell"


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_bad_samples_do_not_matter_at_unequal_spp():
    rng = np.random.default_rng(5)
    a, b = (rng.gamma(1.0, size=(8, 8, 1, n)) for n in (16, 100))
    a[rng.random(a.shape) < 0.1] = np.nan
    b[rng.random(b.shape) < 0.1] = np.inf
    assert contrast(a, b).outcome == "no difference found"
    b[0, 0] = np.nan
    found = contrast(a, b)
    assert found.why == "1 pixel has good samples on one side only"
    assert np.isnan(found.p_value[0, 0]).all()
    assert np.isfinite(found.p_value.to_numpy().ravel()[1:]).all()


# --- power --------------------------------------------------------------------------------------


def test_a_small_loss_in_a_block_is_found_and_placed():
    rng = np.random.default_rng(2)
    a, b = (heavy(rng, 128, sigma=0.5) for _ in range(2))
    b[8:24, 20:36] *= 0.94
    found = contrast(a, b)
    assert found.outcome == "differ"
    y, x, height, width = found.window
    assert y < 24 and y + height > 8 and x < 36 and x + width > 20  # noqa: PT018
    assert -0.1 < -found.window_loss < 0
    assert "The means differ" in found.conclusion
    assert not contrast(a, heavy(rng, 128, sigma=0.5)).share


def test_a_channel_s_difference_is_told():
    rng = np.random.default_rng(2)
    a, b = rng.gamma(4.0, size=(2, 8, 8, 3, 64)).astype(np.float32)
    b[:, :, 2] *= 0.5
    found = contrast(a, b)
    assert found.window_channel == "B"
    assert 0.45 < found.window_loss < 0.55 != found.loss.value
    assert "in the blue channel of the whole image, where render B is 5" in found.conclusion


def test_pairs_show_what_independent_renders_do_not():
    rng = np.random.default_rng(3)
    a = heavy(rng, 64)
    other = heavy(rng, 64)
    noise = rng.normal(1, 0.02, a.shape)
    assert contrast(a, a * noise * 0.99).outcome == "differ"
    assert contrast(a, other * 0.99).outcome == "no difference found"


def test_what_would_have_been_found_is_found():
    """A loss that is called detectable, in the whole image: 90 % of 12; below 7 in 1 of 1800."""
    rng = np.random.default_rng(4)
    hits = []
    for seed in range(12):
        a, b = (heavy(rng, 48, edge=24, sigma=0.5) for _ in range(2))
        loss = contrast(a, b, seed=seed).detectable["image"]
        hits.append(contrast(a, b * (1 - loss), seed=seed).outcome == "differ")
    assert sum(hits) >= 7


def test_single_pixels_are_found_among_others():
    rng = np.random.default_rng(6)
    a, b = (heavy(rng, 256, sigma=0.5, nulls=0.2) for _ in range(2))
    b[::7, ::5] *= 0.3
    found = contrast(a, b)
    changed = np.zeros((EDGE, EDGE), bool)
    changed[::7, ::5] = True
    rejected = (found.q_value <= 0.05).any("channel").to_numpy()
    assert rejected[changed].mean() > 0.9
    assert rejected[~changed].sum() <= 0.15 * rejected.sum()
    assert found.share == rejected.mean()


def test_lamps_that_are_constant_differ_exactly():
    rng = np.random.default_rng(8)
    a, b = (heavy(rng, 64) for _ in range(2))
    a[10, 10], b[10, 10] = 50.0, 49.0
    a[20, 20], b[20, 20] = 50.0, 50.001  # as half floats have it
    found = contrast(a, b)
    assert found.p_value[10, 10].to_numpy() == pytest.approx(2.0**-63)
    assert np.isnan(found.p_value[20, 20]).all()
    assert found.share == 1 / EDGE**2


def test_windows_count_every_cell():
    x = np.random.default_rng(0).normal(size=(9, 13, 5))
    sums, (ys, xs) = window_sums(x, 4)
    assert (ys[-1], xs[-1]) == (5, 9)
    np.testing.assert_allclose(sums[2, 3], x[ys[2] : ys[2] + 4, xs[3] : xs[3] + 4].sum((0, 1)))
    np.testing.assert_allclose(window_sums(x, 13)[0][0, 0], x.sum((0, 1)))
    one_flash = np.zeros((1, 4, 4, 16))
    one_flash[0, 1, 1, 3] = 1.0
    assert finished(scan_windows(Cells(one_flash, np.ones((1, 4, 4, 16))))).p_value == 1
    still = np.tile([1.0, -1.0], 8) * np.ones((1, 4, 4, 1))  # sums that are 0
    assert finished(scan_windows(Cells(still, np.ones((1, 4, 4, 16))))).p_value == 1
    none = finished(scan_windows(Cells(np.zeros((1, 4, 4, 16)), np.ones((1, 4, 4, 16)))))
    assert np.isnan(none.p_value)


# --- what is compared ---------------------------------------------------------------------------


def small(seed=1, spp=32, edge=16):
    return heavy(np.random.default_rng(seed), spp, edge=edge)


def test_means_and_efficiencies_are_the_samples_own():
    a = chd.Samples.from_array(small(1, 48), render_seconds=2.0)
    b = chd.Samples.from_array(small(2, 300), render_seconds=5.0)
    found = contrast(a, b)
    assert found.spp == (48, 300)
    assert found.seconds == (2 / 48, 5 / 300)
    for name, x in (("a", a), ("b", b)):
        mean = chd.summarize(x)["mean"].to_numpy()
        np.testing.assert_allclose(found.maps[f"mean_{name}"][..., 1:], mean, rtol=1e-5)
        light = np.einsum("yxcs,c->yxs", np.asarray(x, dtype=float), LUMINANCE)
        np.testing.assert_allclose(found.maps[f"variance_{name}"], light.var(-1, ddof=1), rtol=1e-4)
    ratio = found.maps["variance_a"] * (2 / 48) / (found.maps["variance_b"] * (5 / 300))
    np.testing.assert_allclose(found.efficiency, ratio)
    np.testing.assert_allclose(
        found.difference, found.maps["mean_b"] - found.maps["mean_a"], rtol=1e-12
    )
    assert found.efficiency_ratio.low < found.efficiency_ratio.value < found.efficiency_ratio.high


@pytest.mark.parametrize("counts", [(16, 256), (256, 16), (32, 32)])
def test_efficiency_needs_no_equal_counts(counts):
    rng = np.random.default_rng(4)
    lit = [
        10 * rng.exponential(size=(24, 24, 1, n)) * (rng.random((24, 24, 1, n)) < 0.1)
        for n in counts
    ]
    a, b = (chd.Samples.from_array(x, render_seconds=x.shape[-1]) for x in lit)
    found = contrast(a, b).efficiency_ratio
    assert found.low < 1 < found.high
    assert found.value == pytest.approx(1, abs=0.2)  # standard deviation 0.08


def test_averages_have_the_variance_of_samples():
    x = small(1, 256)
    means = x.reshape(16, 16, 3, 32, 8).mean(axis=-1)
    averages = chd.Samples.from_array(means, averaged=8)
    found = contrast(averages, chd.Samples.from_array(small(2, 64)))
    whole = contrast(x, chd.Samples.from_array(small(2, 64)))
    ratio = found.maps["variance_a"] / whole.maps["variance_a"]
    assert 0.9 < float(ratio.mean()) < 1.1


def test_equal_time_cuts_both_to_what_they_render_in_it():
    a = chd.Samples.from_array(small(1, 48), render_seconds=4.8)
    b = chd.Samples.from_array(small(2, 96), render_seconds=4.8)
    assert contrast(a, b, seconds=1.2).spp == (12, 24)
    assert contrast(a.isel(sample=slice(24)), b, seconds=1.2).spp == (12, 24)


def test_renders_of_one_seed_are_paired():
    a = chd.Samples.from_array(small(1, 40), seed=3)
    b = chd.Samples.from_array(roulette(np.random.default_rng(2), small(1, 64)), seed=3)
    found = contrast(a, b)
    assert found.paired
    assert found.spp == (40, 40)
    other = chd.Samples.from_array(small(5, 64), seed=4)
    assert not contrast(a, other).paired
    assert contrast(a, other).spp == (40, 64)


def test_a_converged_image_is_exact(tmp_path):
    a = small(1, 64)
    image = small(2, 1)[..., 0]
    path = write_exr(tmp_path / "reference.exr", image)
    found = contrast(a, path)
    assert found.spp == (64, None)
    assert found.names[1] == str(path)
    assert "taken as exact" in found.table()["B"]
    assert "random numbers" not in found.table()
    for other in (read_exr(path), image):
        np.testing.assert_array_equal(contrast(a, other).p_value, found.p_value)
    assert np.isnan(found.efficiency).all()
    np.testing.assert_allclose(found.maps["mean_b"][..., 1:], image)


# --- references ---------------------------------------------------------------------------------


def lit(rng, spp=217, edge=16):
    return rng.gamma(2.0, 0.5, (edge, edge, 3, spp)).astype(np.float32)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("rare", [7.6e-8, 1.5e-6, 2.4e-4, 0.002])
def test_nulls_are_no_evidence_against_an_image(rare, scale):
    """Rare light that the image has: 217 nulls would happen in most pixels, in any unit."""
    a, image = lit(np.random.default_rng(1)), np.ones((16, 16, 3))
    for at in ((3, 3), (3, 4), (12, 7)):
        a[at], image[at] = 0, rare
    found = contrast(np.float32(scale) * a, scale * image)
    assert found.outcome == "no difference found"
    assert (found.p_value.to_numpy()[[3, 12], [3, 7]] > 0.1).all()
    black = contrast(np.zeros_like(a), np.where(image < 1, scale * image, 0))
    assert black.outcome == "cannot tell"
    assert "100\xa0% of its light in pixels where A and its neighbours show none" in black.why
    assert black.spp_needed > 217


def test_a_black_pixel_among_lit_ones_is_found():
    """The control: the neighbours see at least as much light in nearly every sample."""
    a, image = lit(np.random.default_rng(1)), np.ones((16, 16, 3))
    a[3, 3] = 0
    assert (contrast(a, image).q_value[3, 3] < 0.01).all()


def test_a_black_region_differs_and_says_why():
    a, image = lit(np.random.default_rng(1)), np.ones((16, 16, 3))
    a[4:12, 4:12] = 0
    found = contrast(a, image)
    assert found.outcome == "differ"
    assert "samples there, which A may have missed" in found.conclusion


@pytest.mark.parametrize("value", [0.9997, 1.0011, (1.0011, 0.9997, 0.9997)])
def test_rounding_of_an_image_is_no_difference(value):
    """X, Y and Z as half floats, converted to R, G and B: (1.0011, .9997, .9997) is white."""
    a = lit(np.random.default_rng(1))
    a[:8] = 1
    image = np.ones((16, 16, 3))
    image[:8] = value
    found = contrast(a, image)
    assert found.outcome == "no difference found"
    assert np.isnan(found.p_value[:8]).all()
    assert contrast(a, np.where(image == 1, image, 0.98)).outcome == "differ"
    exact = contrast(a, Reference(np.ones((16, 16, 3)), precision=0))
    assert found.detectable["image"] > exact.detectable["image"] + 0.002


def test_a_constant_image_needs_no_noise_to_be_equal():
    a = np.random.default_rng(1).random((8, 8, 3, 1), np.float32) * np.ones(32, np.float32)
    with pytest.warns(chd.errors.InputWarning, match="passes that were compared are equal"):
        found = contrast(a, 1.001 * a[..., 0])
    assert found.outcome == "no difference found"
    assert "do not vary, and B is as bright" in found.conclusion


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_half_floats_lose_no_difference_and_make_none(dtype):
    rng = np.random.default_rng(2)
    mean = np.linspace(1e-7, 2e-6, 256).reshape(16, 16, 1) * np.ones(3)
    a = mean[..., np.newaxis] * lit(rng)
    image = mean.astype(dtype).astype(np.float32)
    assert contrast(a, image).outcome == "no difference found"
    bright = (1e6 * mean).astype(dtype).astype(np.float32)
    assert contrast(1e6 * a, bright).outcome == "no difference found"
    assert contrast(0.97e6 * a, bright).outcome == "differ"


@pytest.mark.parametrize("known", ["exact", "spp", "variance", "variance of unknown spp"])
def test_noise_of_a_reference_counts_if_known(known):
    """Of 20 pairs at 5 %, more than 4 would happen in 1 of 390 runs; taken as exact, they do."""
    wrong = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        counts = 64, 64 if "unknown" in known else 32
        a, b = (heavy(rng, spp, edge=16, nulls=0.2, sigma=0.5) for spp in counts)
        variance = b.var(axis=-1, ddof=1) if "variance" in known else None
        spp = 32 if known in ("spp", "variance") else None
        found = contrast(a, Reference(b.mean(axis=-1), variance, spp), seed=seed)
        wrong += found.outcome == "differ"
        assert found.reference == known.split()[0]
        assert found.spp == (64, spp)
    assert (wrong > 4) == (known == "exact")


def test_a_firefly_of_a_reference_is_no_difference():
    """One sample of 500 in 64 x 512. It is as bright as those of A; else, the pixel differs."""
    rng = np.random.default_rng(5)
    calm, image = lit(rng, 64), np.ones((16, 16, 3))
    fireflies = np.where(rng.random((16, 16, 1, 64)) < 1 / 2000, np.float32(500), calm)
    image[4, 4] += 500 / 512
    found = contrast(fireflies, image + 0.25)
    assert found.outcome == "no difference found"
    assert found.share == 0
    assert contrast(calm, image).share == 1 / 256


def test_a_variance_finds_what_samples_find():
    rng = np.random.default_rng(3)
    a, b = heavy(rng, 64, sigma=0.5), heavy(rng, 512, sigma=0.5)
    reference = Reference(b.mean(axis=-1), b.var(axis=-1, ddof=1), 512)
    for loss, outcome in ((0, "no difference found"), (0.03, "differ")):
        dark = a * np.float32(1 - loss)
        assert contrast(dark, reference).outcome == contrast(dark, b).outcome == outcome
    one, other = (contrast(a, x).detectable["image"] for x in (reference, b))
    assert 0.7 < (one - 0.0025) / other < 1.5


def test_a_variance_tells_how_rare_light_is():
    """Light of one of 20 samples is not missed by 217; of one of 500 samples, it is."""
    a = np.random.default_rng(1).gamma(400, 1 / 400, (16, 16, 3, 217))
    mean = np.ones((16, 16, 3))
    a[3, 3], mean[3, 3] = 0, 0.05
    for share, found in ((0.05, True), (0.002, False)):
        variance = np.full(mean.shape, 1 / 400)
        variance[3, 3] = 0.05**2 * (1 / share - 1)
        p = contrast(a, Reference(mean, variance, 10_000)).p_value[3, 3]
        assert (p < 0.01).all() if found else (p > 0.3).all()


def test_an_exact_image_has_missed_nothing():
    rng = np.random.default_rng(3)
    a, image = rng.gamma(4.0, 0.25, (16, 16, 1, 32)), np.full((16, 16, 1), 1.0)
    darker, brighter = contrast(0.8 * a, image), contrast(1.2 * a, image)
    assert darker.outcome == brighter.outcome == "differ"
    assert "fewer than one of 2734 samples there" in darker.conclusion  # 256 pixels x 32 / 3.0
    assert "missed" not in brighter.conclusion


def test_pixels_without_good_samples_are_named():
    a, b = small(1), small(2)
    a[3, 4] = np.nan
    b[0, 0], b[5, 5] = np.nan, np.inf
    found = contrast(a, b)
    for words in (
        "Not contrasted: 1 pixel where all samples of A are NaN or infinite (at y 3, x 4); ",
        "2 pixels where all samples of B are NaN or infinite (first at y 0, x 0).",
    ):
        assert words in found.conclusion
    assert found.outcome == "cannot tell"
    assert found.why == "3 pixels have good samples on one side only"
    assert found.to_dict()["pixels_left_out"] == {"a": 1, "b": 2}
    assert found.table()["bad samples"] == "0.4\xa0% of A, 0.8\xa0% of B"
    image = small(2).mean(axis=-1)
    image[2, 2, 1] = np.nan
    assert "1 pixel where B is NaN or infinite (at y 2, x 2)" in contrast(small(), image).conclusion


def test_black_renders_are_called_black():
    dark, bright = np.zeros((16, 16, 3, 32), np.float32), small(1)
    assert contrast(dark, dark).conclusion == "Cannot tell: A and B are black."
    for other in (bright, bright.mean(axis=-1) + 1):
        found = contrast(dark, other)
        assert found.outcome == "differ"
        assert "where render A is black and render B has a mean of" in found.conclusion
        assert found.table()["B − A over A"] == "—"
    assert "render B is 100\xa0% darker" in contrast(bright, dark).conclusion


def test_negative_means_have_no_loss():
    noise = np.random.default_rng(1).normal(-1, 1, (16, 16, 3, 64))
    same, other = (contrast(noise, np.full((16, 16, 3), mean)) for mean in (-1, -1.5))
    assert "no loss can be stated" in same.conclusion
    assert "render B has a mean of −1.50" in other.conclusion


def test_two_scenes_are_named():
    a, b = (chd.Samples.from_array(small(i), scene=n) for i, n in enumerate(("hall", "garden")))
    with pytest.warns(chd.errors.InputWarning, match="two scenes, hall and garden"):
        found = contrast(a, b)
    assert found.scenes == ("hall", "garden")
    assert found.table()["scenes"] == "hall and garden"


def test_unequal_counts_of_pixels_are_told():
    counts = np.random.default_rng(1).integers(16, 32, (16, 16))
    a = chd.Samples.from_array(small(1), counts=counts)
    assert contrast(a, small(2)).table()["A"] == f"samples, {counts.min()} to 32 spp"


def test_shapes_against_an_image_are_not_known():
    found = contrast(small(1), small(2).mean(axis=-1), distributions=True)
    assert found.table()["distributions differ"] == "not known"
    assert found.to_dict()["share_of_distributions"] is None


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_pixels_without_a_p_value_say_why():
    a, b = small(1), small(2)
    a[0, 0] = b[0, 0] = 0
    a[0, 1] = np.nan
    a[0, 2, :, 1:] = np.nan
    a[0, 3, 1, ::4] = np.inf
    b[0, 4] = a[0, 4]
    found = contrast(a, b)
    assert found.maps["reason"][0, :5].to_numpy().tolist() == [
        Reason.ALL_NULL,
        Reason.ALL_BAD,
        Reason.TOO_FEW,
        Reason.OK,
        Reason.CONSTANT,
    ]
    p = found.p_value.to_numpy()
    assert np.isnan(p[0, [0, 1, 2, 4]]).all()
    assert np.isfinite(p[0, 3]).all()
    good = np.delete(a[0, 3], np.s_[::4], axis=-1)
    np.testing.assert_allclose(found.maps["mean_a"][0, 3, 1:], good.mean(-1), rtol=1e-6)


def test_bad_samples_leave_with_their_pair():
    rng = np.random.default_rng(1)
    a = small(1, 64)
    b = a * rng.normal(1, 0.01, a.shape).astype(np.float32)
    a[3, 3, :, 5] = np.nan
    one, two = (chd.Samples.from_array(x, seed=0) for x in (a, b))
    found = contrast(one, two)
    kept = np.delete(np.arange(64), 5)
    for name, x in (("a", a), ("b", b)):
        np.testing.assert_allclose(
            found.maps[f"mean_{name}"][3, 3, 1:], x[3, 3][:, kept].mean(-1), rtol=1e-5
        )


def test_what_is_no_test_is_said():
    twice = contrast(small(), small())
    assert twice.outcome == "cannot tell"
    assert "one render given twice" in twice.conclusion
    assert np.isnan(twice.p_value).all()
    assert "5 samples per pixel are too few" in contrast(small(1, 5), small(2, 9)).conclusion
    one, other = (chd.Samples.from_array(small(s, 1, 4), axes="yxcs") for s in (1, 2))
    assert "at least 2 samples per pixel, got 1: render 8" in contrast(one, other).why


def test_one_channel_and_small_images_are_compared():
    rng = np.random.default_rng(1)
    a, b = rng.gamma(2.0, size=(2, 3, 2, 1, 64))
    found = contrast(a, b)
    assert found.maps.sizes == {"y": 3, "x": 2, "channel": 1}
    assert np.isfinite(found.p_value).all()
    b *= 0.2
    assert contrast(a, b).outcome == "differ"


def test_samples_of_any_size_are_compared():
    a, b = small(1, 64), small(2, 64) * np.float32(0.5)
    found = contrast(a, b, distributions=True)
    for scale in (1e-30, 1e30):
        scaled = contrast(a * np.float32(scale), b * np.float32(scale), distributions=True)
        for name in ("p_value", "variance_p_value", "distribution_p_value"):
            np.testing.assert_allclose(scaled.maps[name], found.maps[name], rtol=1e-3)
        np.testing.assert_allclose(scaled.image_p_value, found.image_p_value, rtol=1e-3)


@pytest.mark.parametrize("firefly", [1e6, 1e12, 1e30])
def test_one_firefly_makes_no_difference(firefly):
    a, b = small(1, 64), small(2, 64)
    a[3, 3, :, 5] += firefly
    found = contrast(a, b)
    assert found.outcome != "differ"
    assert found.share == 0


def test_it_shows_itself_and_its_numbers_go_into_json():
    found = contrast(small(1), small(2))
    assert found._repr_html_().count("<img") == 2
    assert len(repr(found).splitlines()) <= 10
    numbers = found.to_dict()
    assert numbers["outcome"] == "no difference found"
    assert numbers["efficiency_ratio"] == {"value": None, "low": None, "high": None}
    assert set(numbers["detectable"]) == {"image", "tenth"}


@pytest.mark.parametrize("paired", [False, True])
def test_shapes_of_equal_renders_have_even_p_values(paired):
    rng = np.random.default_rng(11)
    lit = rng.random((2, 24, 24, 1, 64)) < 0.3
    light = rng.lognormal(sigma=1.5, size=lit.shape)
    a, b = light * (lit[:1] if paired else lit)
    seeds = (1, 1) if paired else (1, 2)
    given = [chd.Samples.from_array(x, seed=s) for x, s in zip((a, b), seeds, strict=True)]
    found = chd.contrast(*given, distributions=True).maps
    for name in ("variance", "distribution"):
        p = found[f"{name}_p_value"].to_numpy().ravel()
        assert np.all(
            np.abs((p[:, np.newaxis] <= [0.05, 0.1, 0.5]).mean(0) - [0.05, 0.1, 0.5]) < 0.05
        )
        assert (found[f"{name}_q_value"] <= 0.05).mean() < 0.01


def test_other_shapes_are_found_at_equal_means():
    rng = np.random.default_rng(12)
    a, b = rng.gamma(1.0, size=(2, 16, 16, 1, 256))
    b[:8] = rng.gamma(0.25, 4.0, size=(8, 16, 1, 256))
    found = chd.contrast(a, b, distributions=True)
    for name in ("variance", "distribution"):
        q = found.maps[f"{name}_q_value"].to_numpy()
        assert (q[:8] <= 0.05).mean() > 0.8
        assert (q[8:] <= 0.05).mean() < 0.1
        assert 0.4 < found.to_dict()[f"share_of_{name}s"] < 0.6
    assert "distributions differ" in found.table()


@pytest.mark.parametrize("image", [False, True])
def test_the_share_that_is_done_rises(monkeypatch, image):
    monkeypatch.setattr("chdstat.inference.render_pairs._AT_ONCE", 1)
    one, other = np.random.default_rng(1).gamma(1.0, size=(2, 16, 16, 3, 16))
    told = list(contrasting(one, other.mean(axis=-1) if image else other))
    for text in ("contrasting pixels", "contrasting regions"):
        shares = [share for what, share in told if what == text]
        assert len(shares) >= 4
        assert shares == sorted(set(shares))
        assert 0 <= shares[0] < shares[-1] <= 1


def test_efficiency_takes_the_measured_time_of_each_pixel():
    """A sample of B takes half the time of one of A on the left, and twice of it on the right."""
    rng = np.random.default_rng(5)
    x, y = rng.gamma(2.0, size=(2, 16, 16, 1, 64))
    left = np.arange(16) < 8
    of_a = np.full((16, 16), 2.0)
    a = chd.Samples.from_array(x, seconds=of_a, render_seconds=1.0)
    b = chd.Samples.from_array(y, seconds=np.where(left, 1.0, 4.0) * np.ones((16, 1)))
    found = contrast(a, b)
    assert found.timed == "pixels"
    assert found.seconds == pytest.approx((512, 640))
    ratio = found.maps["variance_a"] / found.maps["variance_b"] * np.where(left, 2, 0.5)
    np.testing.assert_allclose(found.efficiency, ratio)
    plain = found.maps["variance_a"].mean() / found.maps["variance_b"].mean()
    assert found.efficiency_ratio.value == pytest.approx(float(plain) * 512 / 640, rel=0.05)
    assert "measured time" in found.table()["efficiency of B over A"]
    assert contrast(a, chd.Samples.from_array(y, render_seconds=2.0)).timed == "clock"
    assert contrast(chd.Samples.from_array(x), b).timed == ""


def test_a_ranking_takes_measured_times_only_if_all_renders_know_them():
    rng, of_all = np.random.default_rng(8), np.full((8, 8), 0.5)
    timed = [
        chd.Samples.from_array(x, seconds=of_all, render_seconds=64.0)
        for x in rng.gamma(2.0, size=(2, 8, 8, 1, 64))
    ]
    other = chd.Samples.from_array(rng.gamma(2.0, size=(8, 8, 1, 64)), render_seconds=64.0)
    assert seconds_of(timed) == [32.0, 32.0]
    assert seconds_of([*timed, other]) == [1.0, 1.0, 1.0]
    found = contrast({"a": timed[0], "b": timed[1], "c": other})
    assert set(found.noise.seconds.values()) == {1.0}
