"""Benchmark: errors that are known, what judges, and what is written of it."""

import json

import numpy as np
import pandas as pd
import pytest

import chdstat as chd
from chdstat._core.display import number
from chdstat.comparison import denoised
from chdstat.comparison.metrics import exposures, flip
from chdstat.errors import InputError
from chdstat.estimators import Estimator
from chdstat.studies import benchmark

SHAPE = (48, 64)
TRUTH = np.stack([np.full(SHAPE, value) for value in (2.0, 1.0, 0.5)], axis=-1)


def times(factor: float) -> Estimator:
    return Estimator(f"x{factor}", lambda x: factor * np.asarray(x).mean(axis=-1), "known")


def images(seed: int, n: int = 64, noise: float = 1.0) -> chd.Samples:
    """Return samples of `TRUTH` with a variance that is known."""
    rng = np.random.default_rng(seed)
    x = TRUTH[..., np.newaxis] * (1 + noise * rng.standard_normal((*TRUTH.shape, n)))
    return chd.Samples.from_array(x.astype(np.float32))


@pytest.fixture(scope="module")
def found():
    scenes, references = {"a": images(1), "b": images(2)}, {"a": TRUTH, "b": images(3, 256)}
    entries = ["mean", times(1.5), times(0.0)]
    return chd.bench(scenes, entries, spp=[16, 64], references=references, progress=False)


def test_errors_and_biases_are_those_that_are_known(found):
    rows = {(r["scene"], r["spp"], r["estimator"]): r for r in found.table()}
    assert len(rows) == 2 * 2 * 3
    square = np.square(TRUTH).mean()
    for scene in "ab":
        for n in (16, 64):
            mean, brighter, black = (rows[scene, n, k] for k in ("mean", "x1.5", "x0.0"))
            # Without the noise of the reference: that of b has 256 samples.
            assert mean["mse"] == pytest.approx(square / n, rel=0.06)
            assert brighter["mse"] == pytest.approx(square * (1.5**2 / n + 0.25), rel=0.04)
            assert black["mse"] == pytest.approx(square, rel=0.04)
            assert brighter["bias"] == pytest.approx(0.5, abs=0.02)
            assert black["bias"] == pytest.approx(-1)
            assert brighter["mse_ratio_low"] < brighter["mse_ratio"] < brighter["mse_ratio_high"]
            assert mean["mse_ratio"] == 1


def test_an_error_that_may_be_0_divides_no_ratio():
    scenes = {str(seed): images(seed, 48) for seed in range(2)}
    exact = Estimator("exact", lambda x: TRUTH[0, 0] + 0 * np.asarray(x).mean(axis=-1), "known")
    found = chd.bench(scenes, ["mean", exact], spp=[16], baseline="exact", progress=False)
    assert np.isnan([row["mse_ratio"] for row in found.table()]).all()
    assert np.isnan(found.geometric_mean("mean").value)
    assert "cannot tell" in repr(found)
    assert found.notes["the reference cannot tell"].startswith("MSE in 2 of 2 cases")
    # Divided by the error of the mean, that of the truth is 0.
    found = chd.bench(scenes, ["mean", exact], spp=[16], progress=False)
    assert all(row["mse_ratio_low"] == 0 for row in found.table()[1::2])
    assert found.geometric_mean("exact").value < 0.05


def test_flip_lies_between_seen_and_unseen():
    pytest.importorskip("flip_evaluator")
    same = flip(TRUTH, TRUTH)
    assert same.shape == SHAPE
    assert np.abs(same).max() < 1e-6
    little, much = (flip(factor * TRUTH, TRUTH).mean() for factor in (1.02, 0.0))
    assert 0 < little < 0.1 < 0.5 < much <= 1
    grey = flip(np.zeros((*SHAPE, 1)), np.ones((*SHAPE, 1)))
    assert grey.mean() > 0.5


def test_geometric_means_and_ranks_are_over_all_cases(found):
    ratios = [(2.25 / n + 0.25) * n for n in (16, 64)] * 2
    mean = found.geometric_mean("x1.5")
    assert mean.low < np.exp(np.log(ratios).mean()) < mean.high
    assert mean.high < 1.1 * mean.low
    assert [found.rank(name).value for name in found.estimators] == [1, 2, 3]
    brighter, black = found.summary()[1:]
    assert black["worst"] == pytest.approx(64, rel=0.06)
    assert (brighter["rank_low"], brighter["rank"], brighter["rank_high"]) == (2, 2, 2)
    assert brighter["bias"] == pytest.approx(0.5, abs=0.02)
    assert (black["bias"], black["fireflies"]) == (pytest.approx(-1), 0)


def test_the_summary_says_how_to_get_flip(found, monkeypatch):
    found.table()  # which is kept, measured FLIP included
    monkeypatch.setattr(benchmark, "HAS_FLIP", False)
    lines = repr(found).splitlines()
    (head,) = (line for line in lines if line.split()[0] == "estimator")
    (black,) = (line for line in lines if line.split()[0] == "x0.0")
    assert head.split()[-4:] == ["bias", "fireflies", "rank", "worst"]
    assert black.replace("\xa0", " ").split()[-6:-2] == ["−100", "%", "0", "%"]
    assert sum("pip install 'chdstat[flip]'" in line for line in lines) == 1
    monkeypatch.setattr(benchmark, "HAS_FLIP", True)
    assert "pip install" not in repr(found)
    # The reference of a is one luminance, 2^0.2345, in all pixels: white at 85 % is 2^1.0833.
    assert found.notes["exposures of FLIP"].startswith("a 0.8 to 0.8, b 0.")


def disc(black: float, noise: float, seed: int) -> np.ndarray:
    """Return a noisy disc before a black background of that share of the image."""
    rows, columns = (np.arange(n) - n / 2 for n in SHAPE)
    away = np.hypot(rows[:, np.newaxis], columns)
    lit = away <= np.quantile(away, 1 - black)
    rng = np.random.default_rng(seed)
    return np.where(lit, 1 + noise * rng.standard_normal(SHAPE), 0)[..., np.newaxis] * np.ones(3)


@pytest.mark.parametrize("unit", [1e-12, 1e-8, 1.0, 1e9])
@pytest.mark.parametrize("black", [0.0, 0.6, 0.999])
def test_flip_agrees_with_the_noise_that_one_sees(black, unit):
    pytest.importorskip("flip_evaluator")
    truth = unit * disc(black, 0, 0)
    errors = [flip(unit * disc(black, noise, 1), truth).mean() for noise in (0.05, 0.2, 0.8)]
    assert errors == sorted(errors)
    assert 0 < errors[0] < 0.5 * errors[2]


@pytest.mark.parametrize("value", [1e-8, 1e-30, 1.0, -1.0])
def test_flip_of_extremes_is_a_number(value):
    pytest.importorskip("flip_evaluator")
    one = np.zeros((*SHAPE, 3))
    one[3, 4] = value
    for reference, image in ((one, 0 * one), (0 * one, one), (one, one), (one, np.nan * one)):
        found = flip(image, reference)
        assert ((found >= 0) & (found <= 1)).all()
    assert (flip(0 * one, one)[3, 4] > 0.1) == (value > 0)


def test_exposures_follow_the_lit_part():
    bright = disc(0.6, 0.1, 0)
    wider = np.pad(bright, ((40, 40), (40, 40), (0, 0)))
    assert exposures(bright) == pytest.approx(exposures(wider), abs=1e-3)
    assert exposures(bright / 1024) == pytest.approx(np.add(exposures(bright), 10), abs=1e-3)


def test_flip_is_withheld_where_noise_decides():
    pytest.importorskip("flip_evaluator")
    blurred = Estimator(
        "true", lambda x: TRUTH[0, 0] * 1.01 + 0 * np.asarray(x).mean(axis=-1), "known"
    )
    entries, options = ["mean", blurred], {"spp": [16], "progress": False}
    noisy = chd.bench({"a": images(1, 48)}, entries, **options).table()[1]
    exact = chd.bench({"a": images(1)}, entries, references={"a": TRUTH}, **options).table()[1]
    assert np.isnan(noisy["flip_ratio"])
    assert exact["flip_ratio"] < 0.3


def test_it_shows_itself_and_is_written(found, tmp_path):
    assert "x1.5" in repr(found)
    assert len(repr(found).splitlines()) <= 16
    assert found.to_latex().count(r"\\") == 4
    ratio = found.geometric_mean("x1.5")
    assert number(ratio.value) in repr(found)
    table = pd.read_csv(found.save(tmp_path / "a.csv"))
    assert list(table["estimator"]) == [row["estimator"] for row in found.table()]
    assert json.loads(found.save(tmp_path / "a.json").read_text())["baseline"] == "mean"
    with pytest.raises(InputError, match=r"\.csv, \.json, got"):
        found.save(tmp_path / "a.xls")


def test_left_over_samples_judge(tmp_path):
    alone = chd.bench([images(1, 192)], ["mean"], spp=[64], progress=False)
    assert alone.summary()[0]["rank"] == 1
    own = alone.table()[0]
    assert own["mse"] == pytest.approx(np.square(TRUTH).mean() / 64, rel=0.06)
    options = {"spp": [4], "size": (16, 16), "folder": tmp_path, "progress": False}
    entries, many = ["mean", denoised("mean"), "median"], {"reference_spp": 64}
    two, again = (chd.bench(["cornell-box"], entries, seeds=2, **options, **many) for _ in range(2))
    files = {path.name for path in tmp_path.iterdir()}
    (reference,) = (f for f in files if f.endswith(".npz"))
    assert files == {"cornell-box-0.zarr", "cornell-box-1.zarr", reference}
    one = chd.bench(["cornell-box"], ["mean"], **options, **many)
    other = chd.bench(["cornell-box"], ["mean"], **options, reference_spp=32)
    assert len(list(tmp_path.glob("*-reference-*.npz"))) == 2  # that of 64 spp is not taken for it
    errors = [table.table()[0]["mse"] for table in (two, again, one, other)]
    assert errors[0] == errors[1]
    assert len(set(errors)) == 3
    denoising = two.table()[1]
    assert denoising["seconds"] > 0
    assert denoising["mse_equal_time"] > denoising["mse_ratio"]


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
def test_references_judge_by_what_pixels_have():
    samples, more = images(1), images(3, 256).read()
    more[:24, ..., 16:] = np.nan
    more[3, 4] = np.nan
    spoilt = samples.read().copy()
    spoilt[30, 40] = np.nan
    given = {"a": chd.Samples.from_array(more)}
    found = chd.bench(
        {"a": chd.Samples.from_array(spoilt)}, ["mean"], spp=[16], references=given, progress=False
    )
    (row,) = found.table()
    assert row["mse"] == pytest.approx(np.square(TRUTH).mean() / 16, rel=0.1)  # 2.5 errors of it
    assert all(np.isfinite(row[name]) for name in ("relmse", "bias", "mse_ratio_low"))


def test_references_of_one_seed_use_other_samples():
    x = images(1, 128).read()
    one, other = (chd.Samples.from_array(x[..., :n], seed=5) for n in (16, 128))
    references = {"a": other}, {"a": chd.Samples.from_array(x[..., 16:])}
    found = [
        chd.bench({"a": one}, ["mean"], spp=[16], references=given, progress=False).table()
        for given in references
    ]
    assert found[0][0]["mse"] == found[1][0]["mse"]
    few = {"a": chd.Samples.from_array(x[..., :24], seed=5)}
    with pytest.raises(InputError, match="32 samples"):
        chd.bench({"a": one}, ["mean"], spp=[16], references=few, progress=False)


def test_a_finished_image_takes_part(tmp_path):
    file = tmp_path / "done.exr"
    chd.io.write_exr(file, (1.1 * TRUTH).astype(np.float32))
    scene = {"a": images(1)}
    options = {"spp": [16], "references": {"a": TRUTH}, "progress": False}
    found = chd.bench(scene, ["mean"], images={"other": {"a": file}}, **options)
    row = found.table()[1]
    assert row["mse"] == pytest.approx(0.01 * np.square(TRUTH).mean(), rel=1e-3)
    assert np.isnan(row["seconds"])
    with pytest.raises(InputError, match="each"):
        chd.bench(scene, ["mean"], images={"o": {"a": file}}, **options | {"spp": [4, 8]})
    chd.io.write_exr(file, np.ones((8, 8, 3), np.float32))
    with pytest.raises(InputError, match=r"\(8, 8, 3\)"):
        chd.bench(scene, ["mean"], images={"other": {"a": file}}, **options)


def test_notes_say_who_is_not_in_every_case():
    few = ["mean", "median_of_means"]
    found = chd.bench(images(1), few, spp=[4, 16], references={"samples": TRUTH}, progress=False)
    assert [case.scene for case in found.cases] == ["samples", "samples"]
    assert found.notes["left out"] == "median of means in 1 of 2 cases"


def test_the_command_prints_and_writes_the_table(tmp_path, monkeypatch, run):
    images(1, 64).save(tmp_path / "a.zarr")
    chd.io.write_exr(tmp_path / "truth.exr", TRUTH.astype(np.float32))
    monkeypatch.chdir(tmp_path)
    line = "bench a.zarr -e mean -e median --spp 16 --reference a=truth.exr -o t.csv -q --image "
    code, out, _ = run(*(line + "ideal@a=truth.exr").split())
    assert (code, "ideal" in out) == (0, True)
    assert "median" in (tmp_path / "t.csv").read_text()
