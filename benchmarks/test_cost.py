"""What timing samples costs, how true its map is, and what it gains an adaptive render.

``--benchmark-only -s`` prints for each scene: the processor time with ``cost=True`` over that
without, the median over pairs of renders; the map beside a slow direct measurement, which renders
single cells of 8 x 8 pixels alone, again and again: their rank correlation, that of two halves of
the direct measurement, which bounds it, the median ratio, and the ratios that nine of ten cells lie
between; and how costs differ over the image (95th over 5th percentile of cells). Then, from the
variances of many samples and from the costs of adaptive renders, which draw pixel by pixel: the
relMSE x time of adaptive counts that know costs over that of others; and the best that counts in
proportion to the root of variance over cost could reach, over counts in proportion to the root of
the variance, if both were known; also if samples cost what they do in whole passes.
CHDSTAT_COST names other scenes. On a busy machine, the two measurements differ by its state. A
failure: samples take 30 % longer anywhere; a map that orders cells much worse than
the direct measurement does, or is a factor of 1.6 from it; or adaptive renders that lose 3 % by
costs.
"""

import os
import time
from unittest.mock import patch

import numpy as np
from scipy import stats

import chdstat as chd
from chdstat.rendering.adaptive import Adaptive, Look, decided
from chdstat.rendering.backend import activate, one_thread
from chdstat.rendering.jobs import Job
from chdstat.rendering.mitsuba_renderer import MitsubaRenderer
from chdstat.rendering.sample_clock import now

SCENES = "caustic cornell-box many-lights night-room bathroom fog day-room gallery"
VIEW = {"size": (64, 64), "backend": "scalar", "progress": False}
CELL, ROUNDS = 8, 2


def by_cells(values):
    """Return means over cells."""
    return values.reshape(64 // CELL, CELL, 64 // CELL, CELL).mean(axis=(1, 3))


def measured_directly(scene):
    """Return seconds of a sample of each cell, (round, y, x), by rendering it alone."""
    job, times = Job.of(scene, spp=64, size=(64, 64), backend="scalar"), []
    with activate(job.backend), one_thread():
        renderer = MitsubaRenderer(job)
        integrator, made = renderer._integrator, renderer._scene
        places = np.ndindex(64 // CELL, 64 // CELL)
        sensors = [renderer._sensor((CELL * x, CELL * y), (CELL, CELL)) for y, x in places]
        for i in range(ROUNDS + 1):
            for sensor in sensors:
                begun = now()
                integrator.render(made, sensor, seed=i, spp=64)
                times.append((now() - begun) / 64 / CELL**2)
    return np.reshape(times, (ROUNDS + 1, 64 // CELL, 64 // CELL))[1:]


def rendered(scene, **options):
    """Return a render in one thread: those of several wait for each other's counters."""
    with patch("chdstat.rendering.workers.cores", lambda: 1):
        return chd.render(scene, **VIEW, **options)


def overhead(scene):
    """Return the time of a render with costs over one without, the median of pairs."""
    ratios = []
    for seed in range(3):
        taken = []
        for cost in (False, True):
            begun = time.process_time()
            rendered(scene, spp=128, seed=seed, cost=cost)
            taken.append(time.process_time() - begun)
        ratios.append(taken[1] / taken[0])
    return float(np.median(ratios))


def gained(scene, samples):
    """Return relMSE x time of adaptive renders with costs over that without, and of the best.

    The best is also that of samples as costly as those of passes.
    """
    x = samples.read().astype(np.float64)
    truth = x.mean(axis=-1)
    scale = truth**2 + 0.01 * truth.mean(axis=(0, 1)) ** 2
    noise = (x.var(axis=-1) / scale).mean(axis=-1)
    own = rendered(scene, spp=32, adaptive=True, cost=True, seed=99).costs
    how = Adaptive.of(True, None, None, 64, None)
    look = Look.of(rendered(scene, spp=how.first, seed=3))
    counts = [decided(look, how, samples.features, costs)[0] for costs in (own, None)]
    ours = [(noise / n).mean() * (n * own.seconds).mean() for n in counts]
    root, best = np.sqrt(noise), []
    for seconds in (own.seconds, samples.costs.seconds):
        known = np.where(np.isfinite(seconds), seconds, np.nanmean(seconds))
        of_time = (root * np.sqrt(known)).mean() ** 2
        best.append(of_time / (root.mean() * (root * known).mean()))
    return ours[0] / ours[1], *best


def test_costs_of_samples(as_benchmark):
    for i, scene in enumerate(os.environ.get("CHDSTAT_COST", SCENES).split()):
        samples = rendered(scene, spp=256, cost=True)
        found, direct = by_cells(samples.costs.seconds), measured_directly(scene)
        whole = np.median(direct, axis=0)
        ratio = found / whole
        row = {
            "us": 1e6 * np.nanmean(samples.costs.seconds),
            "overhead": overhead(scene),
            "rank": stats.spearmanr(found.ravel(), whole.ravel())[0],
            "bound": stats.spearmanr(*(d.mean(axis=0).ravel() for d in np.split(direct, 2)))[0],
            "ratio": np.median(ratio),
            "low": np.quantile(ratio, 0.05),
            "high": np.quantile(ratio, 0.95),
            "spread": np.quantile(whole, 0.95) / np.quantile(whole, 0.05),
        }
        row["adaptive"], row["best"], row["of passes"] = gained(scene, samples)
        if not i:
            print(f"\n{'':16}" + "".join(f"{title:>10}" for title in row))
        print(f"{scene:16}" + "".join(f"{x:10.3f}" for x in row.values()), flush=True)
        assert row["overhead"] < 1.3
        assert row["rank"] > row["bound"] - 0.2
        assert 0.6 < row["ratio"] < 1.6
        assert row["adaptive"] < 1.03
