"""Simulation: images whose regions have known CHDs, and what is true of their pixels."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import LUMINANCE, Seed, generator
from chdstat._core.reasons import flag_attributes
from chdstat.errors import InputError
from chdstat.patterns.classification import Label
from chdstat.patterns.known_chds import CHD, Component
from chdstat.patterns.population import Truth, truth
from chdstat.samples import Samples

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["CHDS", "simulate", "truth_of"]

_TWO = (Component("lognormal", 0.5, 0.02, 0.4), Component("lognormal", 0.4, 1.0, 0.6))
CHDS: Mapping[str, CHD] = {
    "gamma": CHD((Component("gamma", 2.0),)),
    "lognormal": CHD((Component("lognormal", 0.5),)),
    "null-heavy": CHD((Component("gamma", 2.0),), null_share=0.8),
    "bimodal": CHD(_TWO),
    "multimodal": CHD((*_TWO, Component("lognormal", 0.3, 20.0, 0.5))),
    "long-tail": CHD((Component("gamma", 2.0),), tail_index=0.6, tail_share=0.2),
    "firefly": CHD((Component("gamma", 2.0),), firefly_share=0.5),
    "constant": CHD((Component("constant"),)),
    "black": CHD((Component("constant"),), null_share=1.0),
}
"""A clear case of each pattern, by name."""


def simulate(
    chds: str | CHD | Sequence[str | CHD],
    *,
    shape: tuple[int, int] = (64, 64),
    spp: int = 512,
    seed: Seed = 0,
) -> Samples:
    """Draw an image whose regions have given CHDs.

    Regions are the cells of a grid that is as square as possible, in reading order; cells that are
    left over have the last CHD.

    Parameters
    ----------
    chds
        One `CHD` or several, or names of `CHDS`.
    shape
        (height, width) in pixels.
    spp
        Samples of each pixel, nulls included.
    seed
        Of the draws: the same seed, the same samples.

    Returns
    -------
    Samples
        In memory, three channels in the ratios of each CHD's colour, so that luminance is what the
        CHD says. `truth_of` returns what is true of each pixel.

    Raises
    ------
    InputError
        If a name is unknown, or the shape leaves a region without a pixel.

    Examples
    --------
    >>> samples = simulate(["gamma", "bimodal"], shape=(2, 4), spp=64)
    >>> samples
    <Samples 'simulated' 4 x 2 pixels, 3 channels, 64 spp, in memory>
    >>> truth_of(samples)["modes"].to_numpy()
    array([[1, 1, 2, 2],
           [1, 1, 2, 2]], dtype=int8)
    """
    given = [chds] if isinstance(chds, (str, CHD)) else list(chds)
    for name in given:
        if isinstance(name, str) and name not in CHDS:
            message = f"a CHD must be one of {', '.join(CHDS)} or a CHD, got {name!r}"
            raise InputError(message)
    chosen = [CHDS[chd] if isinstance(chd, str) else chd for chd in given]
    if len(shape) != 2 or min(shape) < 1 or spp < 1 or not chosen:
        message = f"simulate needs a CHD, a shape (height, width) and spp >= 1; got {shape}, {spp}"
        raise InputError(message)
    region = _regions(len(chosen), shape)
    image = np.empty((*shape, 3, spp), dtype=np.float32)
    streams = generator(seed).spawn(len(chosen))
    for index, (chd, rng) in enumerate(zip(chosen, streams, strict=True)):
        here = region == index
        radiance = chd.draw(int(np.count_nonzero(here)), samples=spp, seed=rng)
        color = np.array(chd.color) / (LUMINANCE @ np.array(chd.color))
        image[here] = radiance[:, np.newaxis] * color[:, np.newaxis]
    described = json.dumps([asdict(chd) for chd in chosen])
    return Samples.from_array(image, axes="yxcs", scene="simulated", simulated_chds=described)


def truth_of(samples: Samples) -> xr.Dataset:
    """Return what is true of each pixel of an image that `simulate` made.

    Returns
    -------
    xarray.Dataset
        Over (y, x): ``region``; each flag by its name, 1, 0, or -1 in an indifference zone;
        ``label``; ``tail_index``; ``modes``; ``mean`` of luminance, a planted firefly left out.

    Raises
    ------
    InputError
        If the samples were not simulated.
    """
    if "simulated_chds" not in samples.attrs:
        message = f"truth_of needs samples made by chdstat.simulate, got {samples!r}"
        raise InputError(message)
    truths = []
    for values in json.loads(samples.attrs["simulated_chds"]):
        body = tuple(Component(**component) for component in values.pop("body"))
        truths.append(truth(CHD(body, color=tuple(values.pop("color")), **values)))
    return _truth_map(truths, _regions(len(truths), samples.shape[:2]))


def _regions(count: int, shape: tuple[int, int]) -> npt.NDArray[np.intp]:
    columns = math.ceil(math.sqrt(count))
    rows = math.ceil(count / columns)
    if rows > shape[0] or columns > shape[1]:
        message = f"{count} regions need at least {rows} x {columns} pixels, got {shape}"
        raise InputError(message)
    y, x = (
        np.arange(edge) * cells // edge for edge, cells in zip(shape, (rows, columns), strict=True)
    )
    return np.asarray(np.minimum(y[:, np.newaxis] * columns + x, count - 1))


def _truth_map(truths: Sequence[Truth], region: npt.NDArray[np.intp]) -> xr.Dataset:
    import xarray as xr

    def spread(values: Sequence[Any], dtype: type[np.generic]) -> Any:
        return ("y", "x"), np.array(values, dtype=dtype)[region]

    flags = {
        name: spread([-1 if t.flags[name] is None else t.flags[name] for t in truths], np.int8)
        for name in truths[0].flags
    }
    others = {
        "label": spread([t.label for t in truths], np.int8),
        "tail_index": spread([t.tail_index for t in truths], np.float64),
        "modes": spread([t.modes for t in truths], np.int8),
        "mean": spread([t.mean for t in truths], np.float64),
    }
    dataset = xr.Dataset({"region": (("y", "x"), region), **flags, **others})
    for name, variable in dataset.data_vars.items():
        variable.attrs.update(long_name=f"true {name}".replace("_", " "), units="1")
    dataset["mean"].attrs["units"] = "W sr-1 m-2"
    dataset["label"].attrs.update(flag_attributes(Label))
    return dataset
