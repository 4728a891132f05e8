"""Several renders at once: which is noisier, where in the image, and why."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest

import chdstat as chd
from chdstat._core import progress
from chdstat._core.resampling import Blocks, Interval
from chdstat.errors import InputError, LeftOutWarning
from chdstat.inference import noise_rankings
from chdstat.inference.noise_rankings import NoiseOrder, RankedRender, noise_ranking
from chdstat.samples import Samples
from chdstat.viz.several_renders import _differing

SIZE, SPP = 48, 64
HALF = np.broadcast_to(np.arange(SIZE) < SIZE // 2, (SIZE, SIZE))


def image(variance, *, seed, spp=SPP, mean=1.0, size=SIZE):
    """Return gamma samples (y, x, channel, sample) with a mean and variances (y, x)."""
    variance = np.broadcast_to(variance, (size, size))[..., np.newaxis, np.newaxis]
    rng = np.random.default_rng(seed)
    x = rng.gamma(mean**2 / variance, variance / mean, size=(size, size, 1, spp))
    return x.astype(np.float32)


@pytest.fixture(scope="module")
def ranked():
    """A is better by 2 in the left half, B by 3 in the right one; C is worse than both."""
    renders = {
        "A": image(np.where(HALF, 0.5, 1.5), seed=1),
        "B": image(np.where(HALF, 1.0, 0.5), seed=2),
        "C": image(2.0, seed=3),
    }
    return chd.contrast(renders)


def test_renders_are_ranked_with_the_known_ratios(ranked):
    order = ranked.noise.order
    assert order.names == ("B", "A", "C")
    assert [order.rank(name) for name in order.names] == [(1, 1), (2, 2), (3, 3)]
    for pair, true in {("B", "A"): 1.5 / 2, ("A", "C"): 2 / 4, ("B", "C"): 1.5 / 4}.items():
        ratio = order.ratios[pair]
        assert ratio.low < true < ratio.high < 1
        assert ratio.high - ratio.low < 0.2 * true


def test_each_render_wins_where_it_is_less_noisy(ranked):
    least = ranked.noise.maps["least_noisy"].sel(at="equal spp").to_numpy()
    names = ranked.noise.names
    for name, half in {"A": HALF, "B": ~HALF}.items():
        won = least == names.index(name)
        assert won[half].mean() > 0.8
        assert won[~half].mean() < 0.05  # twice the false discovery rate, as share of all
    shares = ranked.noise.wins()
    assert shares["C"] == (0, 0)
    assert shares["A"][0] == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("telling", [noise_rankings._TELLING, 256])
def test_excess_noise_is_explained_by_the_pattern_that_has_it(telling, monkeypatch):
    monkeypatch.setattr(noise_rankings, "_TELLING", telling)
    null_heavy = image(0.1, seed=1, spp=2 * SPP)  # half of them tell the patterns
    rng = np.random.default_rng(2)
    hit = rng.random(null_heavy.shape) < 0.25
    there = HALF[..., np.newaxis, np.newaxis]
    null_heavy = np.where(there, np.where(hit, 4 * null_heavy, 0), null_heavy)
    noise = chd.contrast({"misses": null_heavy, "finds": image(0.1, seed=4, spp=2 * SPP)}).noise
    cause = noise.causes[0]
    assert (cause.name, cause.least, cause.pattern) == ("misses", "finds", "null_heavy")
    assert cause.share.low > 0.9
    assert cause.pixels == pytest.approx(0.5, abs=0.05)
    assert "is in null-heavy pixels" in replace(cause, pattern="null_heavy").details
    assert "is in seemingly black pixels" in replace(cause, pattern="black").details
    assert cause.null_share.low - 0.02 < 0.75 < cause.null_share.high + 0.02
    assert cause.least_null_share == 0
    true = (0.25 * 16 * 1.1 - 1) / 0.1
    assert cause.ratio.value == pytest.approx(true, rel=0.1)


def test_pixels_are_not_explained_by_the_samples_that_pick_them():
    # Every pixel of "b" has 1.69 times the variance, so that its fireflies only pick the unlucky.
    def law(rng):
        shape = (32, 32, 1, 64)
        rare = rng.random(shape) < 1 / 500
        return rng.gamma(2, size=shape) + rare * rng.gamma(4, 20, size=shape)

    mean = 2 + 80 / 500
    for seed in (1, 2):  # "b" is surely noisier in both
        rng = np.random.default_rng(seed)
        a = law(rng)
        b = np.maximum(mean + (law(rng) - mean) * 1.3, 1e-4)
        noise = chd.contrast({"a": a.astype(np.float32), "b": b.astype(np.float32)}).noise
        assert noise.order.surely("a", "b")
        for cause in noise.causes:
            assert cause.ratio.low < 1.69 * 1.5
            assert cause.share.low < 3 * cause.pixels
            assert " null" not in cause.details  # neither has null samples


def test_a_biased_render_does_not_win_without_a_word():
    renders = {
        "darker": image(0.2, seed=1, mean=0.97),
        "a": image(0.4, seed=2),
        "b": image(0.4, seed=3),
    }
    found = chd.contrast(renders)
    assert found["darker"].outcome == "differ"
    assert found["a"].outcome == "no difference found"
    assert found.noise.order.names[0] == "darker"
    assert "% darker as a whole) differs from b" in found.means
    assert "lacks light also has less noise: perhaps darker." in found.means
    assert _differing(found, "b") == ["darker"]


def test_the_last_render_is_marked_if_all_others_differ_from_it():
    found = chd.contrast(
        {
            "a": image(0.4, seed=2, size=16),
            "b": image(0.4, seed=3, size=16),
            "darker": image(0.2, seed=1, mean=0.9, size=16),
        }
    )
    assert "as a whole) differ from darker" in found.means
    assert "perhaps darker." in found.means
    assert _differing(found, "darker") == ["darker"]
    titles = [ax.get_title().split("\n") for ax in found.plot().axes]
    assert [title[1] for title in titles if len(title) > 1] == ["mean differs"]


def test_a_brighter_render_with_less_noise_does_not_lack_light():
    renders = {"bright": image(0.2, seed=1, mean=1.2, size=16), "a": image(0.4, seed=2, size=16)}
    found = chd.contrast(renders)
    assert "% brighter as a whole) differs from a" in found.means
    assert "lacks light" not in found.means


def test_a_render_without_light_is_not_ranked():
    lit = {"a": image(0.4, seed=2, size=16), "b": image(0.8, seed=3, size=16)}
    for black in (np.zeros_like(lit["a"]), np.full_like(lit["a"], np.nan)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LeftOutWarning)
            found = chd.contrast({"black": black, **lit})
        alone = chd.contrast(lit).noise
        assert found.noise.order.names == alone.order.names == ("a", "b")
        assert found.noise.order.ratios["a", "b"].value == alone.order.ratios["a", "b"].value
        assert found.noise.wins()["black"] == (0, 0)
        assert found.noise.wins()["a"][0] == alone.wins()["a"][0]
        assert "Not ranked: black" in found.conclusion
        assert [row["render"] for row in found.table()] == ["a", "b", "black"]
        assert [*found.table()[0]][-1] == "conclusion"
        found.plot()
    found = chd.contrast({"a": lit["a"], "black": np.zeros_like(lit["a"])}).noise
    assert not found.order.surely("black", "a")
    assert found.wins()["black"] == (0, 0)
    assert not found.causes


def test_a_pair_that_is_not_adjacent_is_told_too():
    ratios = {
        ("a", "b"): Interval(0.8, 0.6, 1.0),
        ("b", "c"): Interval(0.8, 0.6, 1.0),
        ("a", "c"): Interval(0.5, 0.4, 0.6),
        ("c", "d"): Interval(0.5, 0.4, 0.6),
        ("b", "d"): Interval(0.4, 0.3, 0.5),
        ("a", "d"): Interval(0.3, 0.2, 0.4),
    }
    order = NoiseOrder("equal spp", tuple("abcd"), dict.fromkeys("abcd", 1.0), ratios)
    assert order.conclusion == (
        "At equal spp, a and b cannot be told apart, ratio 0.80 [0.60, 1.00]; b and c cannot be "
        "told apart, ratio 0.80 [0.60, 1.00]; c has 0.50 [0.40, 0.60] of the variance of d; "
        "a has 0.50 [0.40, 0.60] of the variance of c."
    )


def test_one_pixel_has_no_winner_without_an_order():
    x = [image(v, seed=s, size=1, spp=64) for s, v in enumerate((0.01, 1.0))]
    found = noise_ranking(of_arrays(x), patterns=False)
    assert not found.order.surely("A", "B")
    assert found.wins()["A"] == (0, 0)


def test_fireflies_are_doubted():
    bright = image(0.2, seed=1)
    rng = np.random.default_rng(0)
    bright += 300 * (rng.random(bright.shape) < 4e-4)
    found = chd.contrast({"fireflies": bright, "a": image(0.2, seed=2)}).noise
    assert found.order.names == ("a", "fireflies")
    assert found.doubtful["fireflies"] > 0.9 > 0.2 > found.doubtful["a"]
    # A render that only fireflies make noisier is said to be so.
    surely = found.order.surely("a", "fireflies")
    assert (("a", "fireflies") in found.order.doubtful) == surely
    assert not surely or "cannot be trusted" in found.conclusion


def of_arrays(arrays, seconds=(np.nan,) * 9):
    """Return renders to rank, without contrasts."""
    return [
        RankedRender(
            "ABCDEFGHI"[i],
            Samples.from_array(x),
            x.mean(axis=-1, dtype=float),
            x.mean(axis=2).var(axis=-1, ddof=1, dtype=float),
            seconds[i],
        )
        for i, x in enumerate(arrays)
    ]


def rankings_of_equal_renders(spps, repetitions):
    """Return in how many repetitions any pair is ranked, and any cell has a winner."""
    ranked = won = 0
    for seed in range(repetitions):
        rng = np.random.default_rng(seed)
        spread = rng.uniform(0.3, 1.5, size=(24, 24, 1, 1))
        arrays = [
            np.exp(spread * rng.normal(size=(24, 24, 1, spp)))
            + 300 * (rng.random((24, 24, 1, spp)) < 1e-4)
            for spp in spps
        ]
        found = noise_ranking(of_arrays([x.astype(np.float32) for x in arrays]), patterns=False)
        ranked += any(ratio.high < 1 for ratio in found.order.ratios.values())
        won += bool((found.maps["least_noisy"] >= 0).any())
    return ranked, won


def test_equal_renders_have_no_ranking():
    # Of 20, more than 4 are ranked with a probability of .3 % if each is with one of 5 %.
    ranked, won = rankings_of_equal_renders((16, 16, 16), 20)
    assert ranked <= 4
    assert won <= 4


@pytest.mark.slow
@pytest.mark.parametrize("spps", [(16, 16, 16), (8, 32, 64)])
def test_equal_renders_have_no_ranking_in_200_repetitions(spps):
    # More than 20 of 200 with a probability of .1 % if each is ranked with one of 5 %.
    ranked, won = rankings_of_equal_renders(spps, 200)
    assert ranked <= 20
    assert won <= 20


def test_intervals_hold_the_true_ratio():
    # Of 25, fewer than 21 hold it with a probability of .7 % if each does with one of 95 %.
    held = 0
    for seed in range(25):
        x = [image(v, seed=(seed, i), spp=16, size=24) for i, v in enumerate((0.5, 0.75))]
        ratio = noise_ranking(of_arrays(x), patterns=False).order.ratios.get(("A", "B"))
        held += ratio is not None and ratio.low <= 2 / 3 <= ratio.high
    assert held >= 21


def test_time_is_part_of_the_ranking_where_it_is_known():
    x = [image(0.4, seed=1), image(0.6, seed=2)]
    found = noise_ranking(of_arrays(x, (4.0, 1.0)), patterns=False)
    assert found.order.names == ("A", "B")
    order = found.orders["equal time"]
    assert order.names == ("B", "A")
    assert order.ratios["B", "A"].value == pytest.approx(0.375, rel=0.05)
    assert order.surely("B", "A")
    near = noise_ranking(of_arrays([x[0], x[0][::-1]], (1.4, 1.0)), patterns=False)
    assert not near.orders["equal time"].surely("B", "A")  # times are never that exact
    assert (near.maps["least_noisy"] == -1).mean() > 0.9
    assert (found.maps["least_noisy"].sel(at="equal time") == 1).mean() > 0.9
    assert (found.maps["least_noisy"].sel(at="equal spp") == 0).mean() > 0.5
    assert "equal time" in found.in_words()[0]
    without = noise_ranking(of_arrays(x, (3.0, np.nan)), patterns=False)
    assert [*without.orders] == ["equal spp"]
    assert "times are unknown" in without.conclusion


def test_unequal_numbers_of_samples_do_not_decide():
    few, many = image(0.5, seed=1, spp=16), image(0.5, seed=2, spp=256)
    found = noise_ranking(of_arrays([few, many]), patterns=False)
    (ratio,) = found.order.ratios.values()
    assert ratio.high >= 1
    better = image(0.25, seed=3, spp=256)
    found = noise_ranking(of_arrays([few, better]), patterns=False)
    assert found.order.surely("B", "A")
    assert found.spp == {"A": "16", "B": "256"}


def test_dependent_samples_are_ranked_by_their_averages():
    rng = np.random.default_rng(0)
    # Stratified samples of a ramp: averages of 4 vary a sixteenth of independent samples.
    strata = (rng.random((SIZE, SIZE, 1, 64, 4)) + np.arange(4)) / 4
    spread = Samples.from_array(strata.reshape(SIZE, SIZE, 1, 256), sequence=4)
    free = Samples.from_array(rng.random((SIZE, SIZE, 1, 256)))
    found = chd.contrast({"spread": spread, "free": free}).noise
    assert found.order.names == ("spread", "free")
    assert found.order.ratios["spread", "free"].value == pytest.approx(1 / 16, rel=0.05)


def test_bad_samples_and_black_pixels_do_not_spread():
    a, b = image(0.5, seed=1), image(1.0, seed=2)
    good = chd.contrast({"a": a, "b": b}).noise
    a[:8, :8] = b[:8, :8] = 0
    b[20, 20], b[30, 30, :, 5] = np.nan, np.nan
    found = chd.contrast({"a": a, "b": b}).noise
    assert found.order.names == ("a", "b")
    assert found.order.ratios["a", "b"].value == pytest.approx(
        good.order.ratios["a", "b"].value, rel=0.1
    )
    least = found.maps["least_noisy"].sel(at="equal spp").to_numpy()
    assert (least[:8, :8] == -1).all()
    assert (least[24:, :24] == 0).mean() > 0.5


def test_black_and_constant_renders_have_no_order():
    for value in (0.0, 1.0):
        x = np.full((16, 16, 1, 16), value, np.float32)
        found = noise_ranking(of_arrays([x, x]), patterns=True)
        assert found.order.rank("A") == found.order.rank("B") == (1, 2)
        assert (found.maps["least_noisy"] == -1).all()
        assert "cannot be told apart" in found.conclusion


def test_a_ranking_is_taken_away_as_a_table_and_as_json(ranked):
    frame = ranked.to_dataframe()
    assert frame["render"].tolist() == ["B", "A", "C"]
    assert frame["outcome"].tolist()[:2] == ["no difference found"] * 2
    assert frame["outcome"].isna().tolist() == [False, False, True]
    told = json.loads(json.dumps(ranked.to_dict(), allow_nan=False))
    assert told["noise"]["orders"]["equal spp"]["names"] == ["B", "A", "C"]
    assert "least noisy" in repr(ranked)
    assert "<table" in ranked._repr_html_()


def test_settings_that_differ_are_named():
    x = image(0.5, seed=1, size=16), image(0.5, seed=2, size=16)
    one, two = (
        Samples.from_array(of, integrator={"type": kind}, scene="box")
        for of, kind in zip(x, ("path", "direct"), strict=True)
    )
    found = chd.contrast([one, two]).noise
    assert found.settings == {"Integrator": ("path", "direct")}
    assert found.names == ("A", "B")
    few = [Samples.from_array(of, scene="box") for of in (x[0], x[1][..., :32])]
    assert chd.contrast(few).noise.settings == {}


SMALL = np.ones((16, 16, 1, 16), np.float32)


@pytest.mark.parametrize(
    ("renders", "named"),
    [
        ([SMALL], "got 1"),
        ([SMALL, SMALL[:8]], "16 x 16 pixels of 1 channels in A and 16 x 8"),
        (
            [Samples.from_array(SMALL, scene=n, scene_hash=n) for n in ("box", "fog")],
            "box in A and fog in B",
        ),
    ],
)
def test_renders_of_other_views_are_refused(renders, named):
    with pytest.raises(InputError, match=named):
        chd.contrast(renders)


def test_what_cannot_be_ranked_is_refused():
    with pytest.raises(InputError, match="give b, too"):
        chd.contrast(SMALL)
    with pytest.raises(InputError, match="got spp or finds"):
        chd.contrast([SMALL, SMALL], spp=8)
    with pytest.raises(InputError, match="got an image"):
        chd.contrast([SMALL, SMALL[..., 0]])


def test_renders_are_contrasted_and_not_compared():
    renders = Samples.from_array(SMALL), Samples.from_array(SMALL)
    for given in ((list(renders),), renders, (renders[0], [renders[1]])):
        with pytest.raises(InputError, match="estimators are compared, renders are contrasted"):
            chd.compare(*given)


def test_strata_are_blocks_within_regions():
    blocks = Blocks.strata(40, 20)
    assert len(blocks) == len(np.unique(blocks.of_pixel))
    of_region = [
        len(np.unique(blocks.of_pixel[blocks.region[blocks.of_pixel] == r])) for r in range(16)
    ]
    assert of_region == [16] * 16
    assert len(np.unique(Blocks.strata(4, 4).region)) == 1


def test_contrasts_tell_their_progress_unless_asked_not_to(monkeypatch, capfd):
    monkeypatch.setattr(progress, "_LINE_EVERY", 0.001)
    few = [image(0.5, seed=seed, size=32, spp=128) for seed in (1, 2, 3)]
    for given in ((few[0], few[1]), ({"a": few[0]}, few[1])):
        chd.contrast(*given)
        assert "contrasting renders" in capfd.readouterr().err
        chd.contrast(*given, progress=False)
        assert capfd.readouterr().err == ""
    chd.contrast(few, progress=False)
    assert capfd.readouterr().err == ""
