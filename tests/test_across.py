"""Across scenes: what trains, what judges, and how the matrix is laid out."""

import json

import numpy as np
import pytest

import chdstat as chd
from chdstat.comparison import MEASURES
from chdstat.comparison.matrix import ALL, CONDITIONED, OTHERS, _School, across
from chdstat.errors import InputError


def picture(seed, *, height=16, width=16, spp=64, nulls=0.5):
    rng = np.random.default_rng(seed)
    radiance = rng.lognormal(size=(height, width, 1, 1))
    lit = rng.random((height, width, 1, spp)) > nulls
    return chd.Samples.from_array(radiance * lit * rng.exponential(size=lit.shape))


SCENES = {
    "dark": picture(0, nulls=0.9),
    "wide": picture(1, width=20),
    "lit": picture(2, nulls=0.0),
}
OPTIONS = {"n": 8, "iterations": 5, "max_batches": 2, "progress": False}


@pytest.fixture(scope="module")
def found():
    return across(SCENES, **OPTIONS)


@pytest.fixture(scope="module")
def school():
    return _School(SCENES, n=8, iterations=5, seed=0, progress=False)


def test_every_training_is_judged_by_every_scene(found):
    rows = ("dark", "wide", "lit", OTHERS, ALL, OTHERS + CONDITIONED, ALL + CONDITIONED)
    assert found.trainings == rows
    assert found.scenes == ("dark", "wide", "lit")
    for measures in (found.measures, found.trusted):
        assert tuple(measures) == tuple(MEASURES)
        for values in measures.values():
            assert values.value.shape == values.low.shape == (7, 3)
    assert found.trust.shape == (7, 3)
    assert ((found.trust >= 0) & (found.trust <= 1)).all()


def test_intervals_hold_the_errors(found):
    ratio = found.measures["mse_ratio"]
    assert (ratio.low <= ratio.value).all()
    assert (ratio.value <= ratio.high).all()
    assert (ratio.standard_error > 0).all()


def test_what_judges_trained_nothing(found, school):
    """Every model has seen half of the pixels of its scenes, and the same half as the others."""
    for row in found.trainings:
        for name, samples in SCENES.items():
            seen = school.model(row, name).seen(samples.shape[:2])
            drawn = school.pixels[name]
            assert len(drawn) == samples.shape[0] * samples.shape[1] // 2
            assert {*map(tuple, seen)} <= {*map(tuple, drawn)}
    assert found.test_pixels == (128, 160, 128)


def test_all_others_leave_the_judge_out(school):
    trained_on = {
        (row, name): [tuple(s["samples_shape"][:2]) for s in scenes]
        for row in ("dark", OTHERS, ALL)
        for name in ("wide", "lit")
        for scenes in [school.model(row, name).provenance["scenes"]]
    }
    square, wide = (16, 16), (16, 20)
    assert trained_on["dark", "wide"] == trained_on["dark", "lit"] == [square]
    assert trained_on[OTHERS, "wide"] == [square, square]
    assert trained_on[OTHERS, "lit"] == [square, wide]
    assert trained_on[ALL, "wide"] == [square, wide, square]


@pytest.fixture(scope="module")
def two():
    return across({name: SCENES[name] for name in ("dark", "lit")}, **OPTIONS)


def test_of_two_scenes_all_others_are_the_other(two):
    ratio = two.measures["mse_ratio"].value
    others = ratio[two.trainings.index(OTHERS)]
    np.testing.assert_array_equal(others, [ratio[1, 0], ratio[0, 1]])


def test_a_seed_repeats_the_matrix(found, two):
    """What other scenes there are changes nothing for those that train alone."""
    ratio, again = (f.measures["mse_ratio"].value for f in (found, two))
    np.testing.assert_array_equal(again[:2], ratio[[0, 2]][:, [0, 2]])


def test_the_diagonal_is_what_a_comparison_measures(found, school):
    """The same training, batches and pixels as `compare` with the model at hand."""
    model = school.model("dark", "dark")
    compared = chd.compare(
        SCENES["dark"], ["progressive"], n=8, max_batches=2, model=model, cost=False
    )
    for name in ("mse_ratio", "relmse_ratio", "improved", "bias"):
        expected = compared.measures[name].value[0, -1]
        assert found.measures[name].value[0, 0] == pytest.approx(expected, rel=1e-6)


def test_the_table_says_all_of_it(found):
    rows = found.table()
    assert len(rows) == 7 * 3
    row = rows[3 * 3 + 1]
    assert (row["training"], row["scene"]) == (OTHERS, "wide")
    assert row["mse_ratio"] == found.measures["mse_ratio"].value[3, 1]
    assert row["trusted_bias_low"] == found.trusted["bias"].low[3, 1]
    assert row["trust"] == found.trust[3, 1]


def test_it_becomes_json_and_a_dataset(found):
    content = json.loads(json.dumps(found.to_dict()))
    assert content["test_pixels"] == {"dark": 128, "wide": 160, "lit": 128}
    assert {tuple(model["trained_on"]) for model in content["provenance"]["models"]} == {
        ("dark",), ("wide",), ("lit",),
        ("wide", "lit"), ("dark", "lit"), ("dark", "wide"), ("dark", "wide", "lit"),
    }  # fmt: skip
    dataset = found.to_dataset()
    assert dataset["mse_ratio"].dims == ("training", "scene")
    place = {"training": ALL, "scene": "lit"}
    assert float(dataset["trusted_improved"].sel(place)) == found.trusted["improved"].value[4, 2]
    assert "units" in dataset["trust"].attrs


@pytest.mark.parametrize(
    ("scenes", "options", "words"),
    [
        ({"dark": SCENES["dark"]}, {}, "needs at least 2 of them"),
        ({"dark": SCENES["dark"], "all": SCENES["lit"]}, {}, "cannot name scenes"),
        (SCENES, {"n": 40}, "at least 80 spp, got 64"),
        (SCENES, {"n": 0}, "n must be at least 1"),
        (SCENES, {"max_batches": 0}, "max_batches must be at least 1"),
        (SCENES, {"balance": -1}, "balance must lie between"),
        ({"a": SCENES["lit"], "b": chd.Samples.from_array(np.ones((8, 8, 3, 64)))}, {}, "channels"),
    ],
)
def test_what_makes_no_matrix_is_refused(scenes, options, words):
    with pytest.raises(InputError, match=words):
        across(scenes, **(OPTIONS | options))
