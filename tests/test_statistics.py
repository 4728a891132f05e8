"""Laws of every statistic: of an array, a pixel alone, an image, another scale, and hard pixels.

Warnings are errors in this project's tests, so that each call here also shows that there is none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import MISSING, fields, is_dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest

import chdstat as chd
from chdstat._core.positive import PositivePart
from chdstat._core.statistic import Statistic
from chdstat.errors import Reason
from chdstat.fit.families import FamilyFit
from chdstat.fit.goodness_of_fit import GoodnessOfFit
from chdstat.fit.selection import FamilySelection
from chdstat.inference import TESTS, TRANSFORMS, gaussianity_of_means
from chdstat.inference.averages import NormalityOfMeans
from chdstat.inference.normality import Normality
from chdstat.summary.runner import measured, run

N = 96


def _rows() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(6)
    usual = rng.gamma(2.0, size=N)
    few = np.zeros(N)
    few[:3] = 1.0, 2.0, 5.0
    return {
        "usual": usual,
        "all null": np.zeros(N),
        "one sample": np.r_[2.0, np.zeros(N - 1)],
        "two samples": np.r_[2.0, 3.0, np.zeros(N - 2)],
        "fewer than parameters": few,
        "constant": np.full(N, 0.7),
        "constant but for nulls": np.where(np.arange(N) % 2, 0.7, 0),
        "nearly constant": 0.7 * (1 + 1e-9 * rng.random(N)),
        "two values": np.where(np.arange(N) % 3, 1.0, 4.0),
        "three values": 2.0 ** (np.arange(N) % 3),
        "clamped": np.minimum(usual, np.median(usual)),
        "rounded": np.round(usual, 1) + 0.1,
        "half of one value": np.where(np.arange(N) % 2, usual, 1.0),
        "subnormal": usual * 1e-43,
        "huge": usual * 1e30,
        "every magnitude": 10.0 ** rng.uniform(-38, 30, size=N),
        "one firefly": np.r_[1e30, usual[1:]],
        "nan": np.full(N, np.nan),
        "some nan": np.where(np.arange(N) % 4, usual, np.nan),
        "inf": np.where(np.arange(N) % 4, usual, np.inf),
        "negative": np.where(np.arange(N) % 4, usual, -1.0),
    }


ROWS = _rows()
HOPELESS = {
    "all null": Reason.ALL_NULL,
    "nan": Reason.ALL_BAD,
    "one sample": Reason.TOO_FEW,
    "constant": Reason.CONSTANT,
    "constant but for nulls": Reason.CONSTANT,
}
"""Rows of which nothing can be said, and why."""
NULLS_COUNT = {"one sample", "constant but for nulls"}
"""Those of which averages can be looked at: a null is a sample like any other there."""


def _declared(kind: type[Any] = Statistic) -> Iterator[type[Any]]:
    """Yield the statistics of channels that are declared, those below a class after it."""
    for each in kind.__subclasses__():
        yield from (each, *_declared(each)) if each.rows == "channels" else ()


def _optional(kind: type[Any]) -> bool:
    """Return whether all options of a statistic have defaults."""
    return is_dataclass(kind) and all(f.default is not MISSING for f in fields(kind))


STATISTICS: dict[str, Any] = {
    **{kind.__name__: kind() for kind in _declared() if _optional(kind)},
    "FamilyFit": FamilyFit(chd.fit.FAMILIES["gamma"]),
    "FamilySelection": FamilySelection(held_out=True),
    "GoodnessOfFit": GoodnessOfFit(resamples=9),
    "Normality of all": Normality(tuple(TRANSFORMS), tuple(TESTS)),
    "NormalityOfMeans": NormalityOfMeans((1, 2, 4)),
}
"""A new one is tested with its defaults, and needs no line here."""
FUNCTIONS: dict[str, Callable[[np.ndarray], Any]] = {
    **{name: getattr(chd.fit, name) for name in chd.fit.FAMILIES},
    **{name: partial(run, statistic) for name, statistic in STATISTICS.items()},
    "NormalityOfMeans": gaussianity_of_means,
    "classify": lambda x: chd.classify(x[..., np.newaxis, :]),
}

SAID_ANYWAY = (
    *(".null_share", ".null_interval", ".atom_weights", ".atoms", ".tested"),
    *(".coverage_own", ".coverage_own_interval"),
)
"""Fields that do not need what the reason says is missing."""


def _arrays(result: Any, path: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Yield every floating-point array of a result, with where it lies."""
    if is_dataclass(result):
        for field in fields(result):
            yield from _arrays(getattr(result, field.name), f"{path}.{field.name}")
    elif isinstance(result, dict):
        for name, value in result.items():
            yield from _arrays(value, f"{path}.{name}")
    elif isinstance(result, (np.ndarray, np.floating)) and result.dtype.kind == "f":
        yield path, np.asarray(result)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_batch_of_hard_pixels(name, dtype):
    batch = np.stack(list(ROWS.values())).astype(dtype)
    together = FUNCTIONS[name](batch)
    for path, values in _arrays(together):
        assert not np.isinf(values).any(), path
    for path, values in _arrays(FUNCTIONS[name](batch[:0])):
        assert not values.size or not values.ndim, path
    for row, reason in HOPELESS.items():
        if name in {"NormalityOfMeans", "Bar"} and row in NULLS_COUNT:
            continue
        at = list(ROWS).index(row)
        if name == "classify":  # whose shares and spreads are known for some of them
            assert together.reason[at] != Reason.OK, row
            continue
        assert (together.reason[at] == reason).all(), row
        for path, values in _arrays(together):
            if values.ndim and not path.endswith(SAID_ANYWAY):
                assert np.isnan(values[at]).all(), f"{row}{path}"
    assert (together.reason[0] == Reason.OK).all()


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_pixel_is_the_same_alone_and_in_a_batch(name):
    _check_alone(FUNCTIONS[name], np.stack(list(ROWS.values())), atol=1e-12)


def _check_alone(function: Callable[[np.ndarray], Any], x: np.ndarray, *, atol: float) -> None:
    together = dict(_arrays(function(x)))
    for index, row in enumerate(x):
        alone = dict(_arrays(function(row)))
        for path, values in together.items():
            if values.ndim and len(values) == len(x):
                told = f"row {index}{path}"
                np.testing.assert_allclose(
                    alone[path], values[index], rtol=1e-6, atol=atol, err_msg=told
                )


OVERLAPPING: dict[str, Callable[[np.ndarray], Any]] = {
    "mixture": chd.fit.mixture,
    "fast mixture": lambda x: chd.fit.mixture(x, effort="fast"),
    "mixture of bins": lambda x: chd.fit.mixture(chd.histogram(x)),
    "fast mixture of bins": lambda x: chd.fit.mixture(chd.histogram(x), effort="fast"),
    "gamma mixture of bins": lambda x: chd.fit.mixture(chd.histogram(x), family="gamma"),
    "modality": chd.modality,
}


@pytest.mark.parametrize("name", OVERLAPPING)
def test_overlapping_components_are_the_same_alone(name):
    """Where searches end depends on where they begin, and on when they end."""
    rng = np.random.default_rng(12)
    x = np.zeros((12, 256))
    for row, count in zip(x, np.linspace(40, 256, len(x)).astype(int), strict=True):
        second = rng.random(count) < rng.uniform(0.2, 0.8)
        deviation, place = np.where(second, 0.5, 1.0), rng.uniform(0.3, 3.0) * second
        row[:count] = np.exp(rng.normal(place, deviation))
    _check_alone(OVERLAPPING[name], x, atol=1e-8)


SHAPES: dict[str, Callable[[np.ndarray], Any]] = {
    **{
        name: lambda x, name=name: [
            getattr(chd.fit, name)(x).parameters[p]
            for p, unit in chd.fit.FAMILIES[name].units.items()
            if unit == "1" and p != "mu"
        ]
        for name in chd.fit.FAMILIES
    },
    "select": lambda x: chd.fit.select(x).vuong_z,
    "mixture": lambda x: chd.fit.mixture(x).weights,
    "gamma mixture": lambda x: chd.fit.mixture(x, family="gamma").parameters["shape"],
    "tail_index": lambda x: [(t := chd.fit.tail_index(x)).xi, *t.interval.T],
    "goodness": lambda x: chd.fit.goodness(x, "gamma", resamples=0).statistic,
    "gaussianity": lambda x: [
        chd.gaussianity(x, transform=t, test=tuple(TESTS)).statistic for t in TRANSFORMS
    ],
    "modality": lambda x: [(m := chd.modality(x)).dip, m.delta_bic, *m.ashman_d.T],
}
"""What neither the unit of radiance, nor nulls, bad samples or the order of samples change."""

SCALES: dict[str, Callable[[np.ndarray], Any]] = {
    "mixture": lambda x: np.exp(chd.fit.mixture(x).parameters["mu"]),
    "gamma mixture": lambda x: chd.fit.mixture(x, family="gamma").parameters["scale"],
    "tail_index": lambda x: [(t := chd.fit.tail_index(x)).scale, t.threshold],
    "modality": lambda x: 10 ** chd.modality(x).places,
}
"""What is in the unit of radiance; of families, `tests/fit/test_mle.py` has it."""


@pytest.mark.parametrize("factor", [1e3, 1e30, 1e-30])
@pytest.mark.parametrize("name", SHAPES)
def test_the_unit_of_radiance_does_not_matter(name, factor):
    x = np.random.default_rng(8).gamma(2.0, size=(4, 200))
    x[2:, ::3] *= 1000
    one, other = (np.array(SHAPES[name](y)) for y in (x, factor * x))
    np.testing.assert_allclose(other, one, rtol=2e-5, atol=1e-6)
    if name in SCALES:
        one, other = (np.array(SCALES[name](y)) for y in (x, factor * x))
        np.testing.assert_allclose(other / factor, one, rtol=2e-5)


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
@pytest.mark.parametrize("name", SHAPES)
def test_nulls_bad_samples_and_order_take_no_part(name):
    rng = np.random.default_rng(9)
    x = rng.gamma(2.0, size=(2, 200))
    x[1, ::3] *= 1000
    beside = np.broadcast_to(np.r_[np.zeros(77), np.nan, np.inf, -1.0], (2, 80))
    mixed = rng.permuted(np.concatenate([x, beside], axis=-1), axis=-1)
    one, other = (np.array(SHAPES[name](y)) for y in (x, mixed))
    np.testing.assert_allclose(other, one, rtol=2e-5, atol=1e-6)


@pytest.mark.parametrize("name", STATISTICS)
def test_an_image_has_what_its_pixels_have(name):
    statistic = STATISTICS[name]
    x = np.random.default_rng(10).gamma(1.5, size=(2, 3, 3, 256)).astype(np.float32)
    x[0, 1] = 0
    x[1, 0, :, ::3] *= 1000
    dataset = run(statistic, chd.Samples.from_array(x), progress=False)
    for y, column in ((0, 1), (1, 0), (1, 2)):
        pixel = statistic.variables(measured(PositivePart.of(x[y, column]), statistic))
        for own, (dims, values) in pixel.items():
            if own in statistic.around:
                continue
            found = dataset[own]
            assert found.dims == ("y", "x", *dims)
            np.testing.assert_allclose(found[y, column], values, rtol=1e-6, atol=1e-9, err_msg=own)
    for variable in dataset.data_vars.values():
        assert {"long_name", "units"} <= set(variable.attrs)
    for own in filter(lambda own: str(own).endswith("q_value"), dataset):
        p_value = dataset[str(own).replace("q_value", "p_value")]
        assert ((dataset[own] >= p_value) | p_value.isnull()).all()


@pytest.mark.parametrize("name", [name for name, s in STATISTICS.items() if s.binned])
def test_histograms_go_the_way_of_pixels(name):
    statistic = FamilySelection() if name == "FamilySelection" else STATISTICS[name]
    x = np.random.default_rng(11).gamma(2.0, size=(2, 3, 3, 256))
    x[..., ::3] *= 5
    samples = chd.Samples.from_array(x)
    dataset = run(statistic, chd.histogram(samples))
    pixel = statistic.variables(run(statistic, chd.histogram(samples[1, 2])))
    for own, (dims, values) in pixel.items():
        assert dataset[own].dims == ("y", "x", *dims)
        np.testing.assert_allclose(dataset[own][1, 2], values, rtol=1e-6, atol=1e-9, err_msg=own)
