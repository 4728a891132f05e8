"""Integrators: whether CHDs depend on how paths are sampled, and which averages are Gaussian first.

This is finding 29. An average of n samples has the skewness of one sample over the root of n, so
that the n which makes it nearly Gaussian is proportional to the square of that skewness. Times n,
the time of a sample is the time until averages are Gaussian; of two integrators, only the ratio
matters.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from chdstat._core.positive import Floats
from chdstat._core.resampling import Blocks, Interval, mean_of, median_of
from chdstat.samples import Samples
from chdstat.studies.claims.paths import TIMING, seconds_per_sample
from chdstat.studies.claims.scene_shapes import DIFFERENT, squares
from chdstat.studies.outcomes import ClaimTest, Outcome, PlotData, level_of, require
from chdstat.studies.scene_data import SceneData, logs
from chdstat.summary.statistics import summarize

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["BSDF_SAMPLING", "DIRECT", "measure"]

BSDF_SAMPLING = "BSDF sampling alone"
"""Integrator that finds lights by chance, where surfaces scatter light."""
DIRECT = "direct light, both"
"""Integrator that other ones of direct light are compared with."""
_SLOWEST, _FASTEST = "time until averages are Gaussian", "samples until averages are Gaussian"


def measure(data: SceneData) -> Outcome:
    """Compare the shapes of integrators, and the time until their averages are Gaussian."""
    require(
        data.integrators,
        "the same scene by other integrators, as a study does with integrators=True",
    )
    sizes = {samples.shape[:3] for samples in data.integrators.values()}
    require(sizes == {data.samples.shape[:3]}, "other integrators in the same size")
    least = min(s.spp for s in (data.samples, *data.integrators.values()))
    # Sample skewness grows with the number of samples: each integrator has as many.
    renders = {"": data.samples, **data.integrators}
    summaries = {name: _summary(samples, least) for name, samples in renders.items()}
    pairs = {
        name: DIRECT if name.startswith("direct light") and DIRECT in renders else ""
        for name in data.integrators
        if name != DIRECT
    }
    blocks, level = data.whole().blocks, level_of(2)
    distances, sooner, fewer = dict[str, Interval[float]](), dict[str, Interval[float]](), {}
    for name, base in pairs.items():
        squared = squares(summaries[name], summaries[base])
        distances[name] = mean_of(squared, blocks, level=1 - (1 - level) / len(pairs)).root()
        fewer[name] = _samples_ratio(summaries[name], summaries[base], blocks, level)
        seconds = [seconds_per_sample(renders[n]) for n in (name, base)]
        if seconds[0] and seconds[1]:
            sooner[name] = _timed(fewer[name], seconds[0] / seconds[1])
    known = [d for d in distances.values() if np.isfinite(d.value)]
    require(known, "positive samples enough for shapes")
    # The largest of several: its ends are the largest of ends that hold together.
    value, low, high = (max(getattr(d, end) for d in known) for end in ("value", "low", "high"))
    tests = [
        ClaimTest(
            "largest distance between the shapes of two integrators",
            Interval(value, low, high, level),
            least=DIFFERENT,
            unit="decade^1/2",
        )
    ]
    missing = []
    if BSDF_SAMPLING not in pairs:
        missing.append("needs lights that sampling BSDFs can find")
    elif BSDF_SAMPLING not in sooner:
        missing.append("needs times of the renders, by the scalar backend")
    else:
        tests.append(
            ClaimTest(
                f"log {_SLOWEST}, {BSDF_SAMPLING} over lights, too",
                sooner[BSDF_SAMPLING],
                least=0.0,
                unit="decade",
            )
        )
    shown = sooner or fewer
    return Outcome(
        tuple(tests),
        tuple(missing),
        details={
            "distances": {name: d.value for name, d in distances.items()},
            **{
                key: {
                    name: {"value": i.value, "low": i.low, "high": i.high}
                    for name, i in found.items()
                }
                for key, found in ((f"log {_SLOWEST}", sooner), (f"log {_FASTEST}", fewer))
            },
        },
        plot_data=PlotData.bars(
            {name: i.value for name, i in shown.items()},
            f"decades of {_SLOWEST if sooner else _FASTEST}",
        ),
        few="renders on a quiet machine",
    )


def _summary(samples: Samples, spp: int) -> xr.Dataset:
    used = samples if samples.spp == spp else samples.isel(sample=slice(0, spp))
    return summarize(used, progress=False)


def _samples_ratio(
    one: xr.Dataset, two: xr.Dataset, blocks: Blocks, level: float
) -> Interval[float]:
    """Return the median log ratio of the samples that averages need to be Gaussian."""
    log: list[Floats] = [
        logs(np.abs(summary["skewness"].to_numpy().astype(np.float64))) for summary in (one, two)
    ]
    ratio = 2 * (log[0] - log[1])
    return median_of(ratio.reshape(len(blocks.of_pixel), -1), blocks, level=level)


def _timed(log_samples: Interval[float], slower: float) -> Interval[float]:
    """Return log time from log numbers of samples, of which one takes `slower` times as long."""
    by, room = math.log10(slower), math.log10(TIMING)
    low, high = log_samples.low + by - room, log_samples.high + by + room
    return Interval(log_samples.value + by, low, high, log_samples.level)
