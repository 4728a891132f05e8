"""Render tests: references with batches, several renders, and renders that are drawn as needed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from chdstat.errors import InputError, InputWarning
from chdstat.inference import Contrast, Contrasts, Reference, contrast
from chdstat.inference.permutations import PermutationTail, p_of_tail, quantile_of_tail
from chdstat.samples import Samples

EDGE = 16
SMALL = 2.5e-4
"""Level of one of forty tests of which the chance of any false alarm is 1 %."""


def drawing(factor=1.0, *, edge=EDGE, nulls=0.8, block=1):
    """Return a function that draws a gradient with nulls and log-normal tails."""
    y, x = np.mgrid[:edge, :edge] / edge
    level = (0.2 + y + 2 * x * y)[..., np.newaxis, np.newaxis] * [[1.0], [0.8], [0.6]]

    def draw(seed):
        rng = np.random.default_rng(seed)
        grey = rng.lognormal(0, 1, (edge, edge, 1, block)) / (1 - nulls)
        return factor * level * grey * (rng.random(grey.shape) >= nulls)

    return draw


def referenced(seed=10**6, spp=768, **kind):
    return Reference.of_samples(drawing(block=spp, **kind)(seed))


# --- deep p-values --------------------------------------------------------------------------------


def test_tails_go_on_as_exponentials():
    """P-values far beyond 499 shuffles, within a factor of e of the truth in 9 of 10 rows."""
    rng = np.random.default_rng(1)
    far = -np.log(1e-5)
    p = p_of_tail(np.full(400, far), rng.exponential(size=(400, 499)))
    assert (np.abs(np.log(p / 1e-5)) < np.log(20)).mean() > 0.9
    assert np.exp(np.log(p).mean()) > 1e-5  # rather too large than too small


@pytest.mark.parametrize("share", [0.3, 0.05, 1e-3, 1e-6])
def test_quantiles_of_tails_have_their_p_values(share):
    shuffled = np.random.default_rng(2).exponential(size=(20, 499))
    p = p_of_tail(quantile_of_tail(shuffled, share), shuffled)
    np.testing.assert_allclose(p, share, rtol=0.2 if share > 0.01 else 1e-6)


def test_tails_heavier_than_exponentials_stay_so():
    shuffled = stats.genpareto(0.5).rvs((50, 499), random_state=3)
    assert (PermutationTail.of(shuffled).k < -0.1).mean() > 0.9


# --- references with batches ----------------------------------------------------------------------


def test_right_renders_do_not_differ_from_batches():
    """Of 30 right renders, more than 2 at 1 % would happen in 1 of 300 runs; seeds are fixed."""
    found = [
        contrast(drawing(block=256)(seed), referenced(1000 + seed), alpha=0.01, seed=seed)
        for seed in range(30)
    ]
    assert sum(c.outcome == "differ" for c in found) <= 2
    assert {c.reference for c in found} == {"batches"}


def test_clear_losses_have_p_values_below_any_session():
    reference = referenced()
    p = [
        contrast(drawing(1 - loss, block=256)(3), reference, alpha=SMALL).image_p_value
        for loss in (0.0, 0.1, 0.2, 0.4, 0.8)
    ]
    assert p[0] > 0.01
    assert max(p[2:]) < SMALL / 100


@pytest.mark.parametrize(
    ("part", "terms"),
    [
        ("image", 256),
        ("tenth", 16),
        pytest.param("image", 16, marks=pytest.mark.slow),
        pytest.param("tenth", 256, marks=pytest.mark.slow),
    ],
)
def test_stated_losses_are_found(terms, part):
    """90 % of 16 losses of the stated size are found; below 10 in 1 of 2000 runs."""
    rng, found = np.random.default_rng(4), 0
    for seed in range(16):
        x, reference = drawing(block=256)(seed), referenced(1000 + seed)
        samples = x.reshape(*x.shape[:3], terms, -1).mean(axis=-1)
        about = {"averaged": 256 // terms} if terms < 256 else {}
        loss = contrast(Samples.from_array(samples, **about), reference, alpha=SMALL)
        size = loss.detectable[part]
        assert size < 1
        edge = EDGE if part == "image" else round(np.sqrt(0.1) * EDGE)
        y, x = rng.integers(0, EDGE - edge + 1, 2)
        samples[y : y + edge, x : x + edge] *= 1 - size
        changed = Samples.from_array(samples, **about)
        found += contrast(changed, reference, alpha=SMALL, seed=seed).outcome == "differ"
    assert found >= 10


def test_one_render_may_be_more_noisy():
    """Roulette that ends 9 of 10 paths: more than 1 of 30 at 1 % would happen in 1 of 30 runs.

    The seeds are fixed.
    """
    alarms = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        x = drawing(block=256)(seed)
        x = x * (rng.random((EDGE, EDGE, 1, 256)) < 0.1) / 0.1
        found = contrast(x, referenced(1000 + seed), alpha=0.01, seed=seed)
        alarms += found.outcome == "differ"
    assert alarms <= 1


def test_light_in_few_batches_cannot_be_told():
    """A reference has light in one of 768 samples, which 64 are likely to miss."""
    x = drawing(nulls=0.0, block=768)(1)
    x[..., 5] *= 1e4  # one bright sample in each pixel
    found = contrast(drawing(nulls=0.0, block=64)(2), Reference.of_samples(x))
    assert found.outcome == "cannot tell"
    assert found.why.startswith("B has 100\xa0% of its light in samples so rare that 64")
    assert found.spp_needed == 2277  # for a batch of 48, ln(.05) / ln(47 / 48) batches of 16


def test_samples_of_other_sizes_than_batches_are_compared():
    reference = referenced()
    for spp in (8, 20, 100, 333):
        found = contrast(drawing(block=spp)(3), reference)
        assert found.outcome in ("no difference found", "cannot tell")
        assert contrast(drawing(0.2, block=spp)(3), reference).outcome != "no difference found"


def test_pixels_without_good_batches_are_left_out():
    x = drawing(block=480)(1)
    x[2, 3] = np.nan
    x[4, 5, :, 7] = np.inf
    reference = Reference.of_samples(x)
    assert np.isnan(reference.batches[2, 3]).all()
    assert reference.bad[4, 5] == pytest.approx(1 / 480)
    found = contrast(drawing(block=160)(2), reference)
    assert found.outcome == "cannot tell"
    assert "1 pixel where B is NaN or infinite (at y 2, x 3)" in found.conclusion


def test_the_seed_of_a_reference_is_told():
    a, b = (Samples.from_array(drawing(block=n)(1), seed=7) for n in (64, 192))
    with pytest.warns(InputWarning, match="with the seed of the reference, 7"):
        contrast(a, Reference.of_samples(b))


@pytest.mark.parametrize("terms", [16, 256])
def test_rounding_of_parts_without_noise_is_no_difference(terms):
    """Half of the image has no noise, and another compiler changes it by some ulp."""

    def half(seed, spp):
        x = drawing(block=spp)(seed)
        x[:, :8] = 0.7
        return x

    reference = Reference.of_samples(half(1, 768))
    for change, outcome in ((2e-6, "no difference found"), (1e-4, "differ")):
        x = half(2, 256)
        x[:, :8] *= 1 + change
        means = x.reshape(*x.shape[:3], terms, -1).mean(axis=-1)
        about = {"averaged": 256 // terms} if terms < 256 else {}
        found = contrast(Samples.from_array(means, **about), reference, alpha=SMALL)
        assert found.outcome == outcome


def test_a_single_pixel_that_decides_is_named():
    level = np.full((16, 16, 3, 1), 0.5)
    x = level * np.random.default_rng(1).gamma(4.0, size=(16, 16, 3, 1024))
    reference = Reference.of_samples(x[..., :768])
    other = x[..., 768:].copy()
    other[7, 9] *= 0.5
    found = contrast(other, reference)
    assert (found.outcome, found.window) == ("differ", (7, 9, 1, 1))
    assert "of the pixel at y 7, x 9, where render A is" in found.conclusion
    assert found.window_loss < -0.8  # B is about twice as bright


@pytest.mark.parametrize("spp", [8, 9, 17])
def test_few_samples_are_drawn(spp):
    assert contrast(drawing(), referenced(), spp=spp).spp[0] == spp


# --- both sides -----------------------------------------------------------------------------------


def known(kind, factor=1.0, seed=5, spp=4096):
    """Return a reference of which only some is known."""
    x = factor * drawing(block=spp)(seed)
    mean = x.mean(axis=-1)
    return {
        "image": lambda: mean,
        "spp": lambda: Reference(mean, spp=spp, precision=0),
        "variance": lambda: Reference(mean, x.var(axis=-1, ddof=1), spp, precision=0),
        "batches": lambda: Reference.of_samples(x),
        "samples": lambda: x,
    }[kind]()


KINDS = ("image", "spp", "variance", "batches", "samples")


@pytest.mark.parametrize("b", KINDS)
@pytest.mark.parametrize("a", KINDS)
def test_every_kind_is_compared_with_every_other(a, b):
    if not {a, b} & {"variance", "batches", "samples"}:
        with pytest.raises(InputError, match="the noise of neither is known"):
            contrast(known(a), known(b))
        return
    assert contrast(known(a), known(b, seed=6, spp=2048), alpha=0.01).outcome != "differ"
    assert contrast(known(a), known(b, 0.9, seed=6, spp=2048), alpha=0.01).outcome == "differ"


def test_images_say_what_they_cannot_show():
    found = contrast(known("samples"), known("image"))
    assert "does not show how rare its light is" in " ".join(found.cannot_show)
    assert found.table()["what B cannot show"]
    assert contrast(known("samples"), known("batches")).cannot_show == ()


# --- several --------------------------------------------------------------------------------------


def test_several_renders_share_alpha():
    renders = {"right": drawing(), "dark": drawing(0.8), "array": drawing(block=256)(9)}
    found = contrast(renders, referenced(), spp=256, alpha=0.03)
    assert isinstance(found, Contrasts)
    outcomes = {name: of.outcome for name, of in found.contrasts.items()}
    assert outcomes == {
        "right": "no difference found",
        "dark": "differ",
        "array": "no difference found",
    }
    assert {of.alpha for of in found.contrasts.values()} == {0.01}
    assert found.outcome == "differ"
    assert found["dark"].outcome == "differ"
    assert found.conclusion.startswith("1 of 3 renders differ")
    assert [row["render"] for row in found.table()] == list(renders)
    assert set(found.to_dict()["contrasts"]) == set(renders)
    assert "dark" in repr(found)


# --- drawn as needed ------------------------------------------------------------------------------


def test_clear_differences_take_a_quarter_of_the_samples():
    found = contrast(drawing(0.5), referenced(), spp=256, alpha=SMALL)
    assert (found.outcome, found.spp[0]) == ("differ", 64)


def test_right_renders_take_all_samples():
    found = contrast(drawing(), referenced(), spp=256, alpha=0.05)
    assert (found.outcome, found.spp[0], found.alpha) == ("no difference found", 256, 0.05)


def test_enough_to_find_is_enough():
    found = contrast(drawing(), referenced(), spp=256, alpha=0.05, finds=0.3)
    assert found.outcome == "no difference found"
    assert found.spp[0] < 256
    assert found.detectable["image"] < 0.3


def test_looks_keep_alpha():
    """Of 24 right renders, more than 4 at 5 % would happen in 1 of 170 runs; seeds are fixed."""
    alarms = sum(
        contrast(drawing(block=16), referenced(5000 + s), spp=256, seed=100 * s).outcome == "differ"
        for s in range(24)
    )
    assert alarms <= 4


@pytest.mark.parametrize("block", [1, 7, 300])
def test_blocks_of_samples_are_cut_at_the_budget(block):
    assert contrast(drawing(block=block), referenced(), spp=128).spp[0] == 128


def test_seeds_count_up():
    seeds = []
    draw = drawing()
    contrast(lambda seed: seeds.append(seed) or draw(seed), referenced(), spp=64, seed=7)
    assert seeds == list(range(7, 71))


def test_a_render_is_a_contrast_of_its_own():
    assert isinstance(contrast(drawing(), referenced(), spp=64), Contrast)
