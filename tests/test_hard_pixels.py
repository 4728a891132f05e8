"""Pixels that no method likes: every function says why, warns of nothing and invents no number.

Warnings are errors in this project's tests, so that each call here also shows that there is none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import Reason
from chdstat.inference import gaussianity_of_means

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
HOPELESS = {"all null", "one sample", "constant", "constant but for nulls", "nan"}
HOPELESS_FOR_MEANS = {"all null", "constant", "nan"}
"""A null is a sample like any other where averages are looked at."""
FUNCTIONS: dict[str, Callable[[np.ndarray], Any]] = {
    **{name: getattr(chd.fit, name) for name in chd.fit.FAMILIES},
    "select": chd.fit.select,
    "mixture": chd.fit.mixture,
    "tail_index": chd.fit.tail_index,
    "gaussianity": chd.gaussianity,
    "gaussianity_of_means": gaussianity_of_means,
    "modality": chd.modality,
    "classify": lambda x: chd.classify(x[..., np.newaxis, :]),
}


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
    hopeless = HOPELESS_FOR_MEANS if name == "gaussianity_of_means" else HOPELESS
    for i, row in enumerate(ROWS):
        if row in hopeless:
            assert (together.reason[i] != Reason.OK).all(), row
    assert (together.reason[0] == Reason.OK).all()


@pytest.mark.filterwarnings("ignore::chdstat.errors.LeftOutWarning")
@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_pixel_is_the_same_alone_and_in_a_batch(name):
    batch = np.stack(list(ROWS.values()))
    together = dict(_arrays(FUNCTIONS[name](batch)))
    for index, row in enumerate(ROWS):
        alone = dict(_arrays(FUNCTIONS[name](batch[index])))
        for path, values in together.items():
            if values.ndim and len(values) == len(ROWS):
                np.testing.assert_allclose(
                    alone[path], values[index], rtol=1e-6, atol=1e-12, err_msg=f"{row}{path}"
                )
