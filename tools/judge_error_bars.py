"""Judge the verdicts on error bars by certified pixels, and fit their calibration.

The built-in scenes are rendered at 64 x 64; `chdstat.fit.error_bars` says how often the error bars
of n samples hold, from a pixel's own samples and with the pixels around; certified pixels know how
often they do. Printed are, for each n and each way:

- the area under the curve that parts pixels whose error bars hold in 92 % or more from those where
  they hold in 85 % or less, with its standard error (bootstrap over pixels), and for each scene;
- the share of each that is said to fail;
- what is predicted and what is true, in bins: the largest difference of bins with 20 pixels.

Every scene is judged with constants fitted to the other scenes. The last lines are the constants
fitted to all, for `_OWN` and `_POOLED`, and how the built-in ones do.

With ``--indices``, the tail index is judged instead: 65 536 samples of each certified pixel say the
index of as large a share of the samples as the tail of n samples has. Printed are the share of the
95 % intervals that hold it, with its standard error over pixels, and why others have no index.

    python tools/judge_error_bars.py [--truth FILE.npz] [--seed 1001] [--repeats 2] [--folder DIR]
    python tools/judge_error_bars.py --indices [--truth FILE.npz]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator

import numpy as np
from scipy import optimize, special, stats

import chdstat as chd
from chdstat._core.arrays import luminance
from chdstat._core.positive import PositivePart
from chdstat.errors import Reason
from chdstat.fit import error_bars
from chdstat.summary.runner import measured

SIZES = (256, 1024, 4096)
TAIL_SIZES, MANY, BATCHES = (512, 2048), 65536, 2
HOLD, FAIL = 0.92, 0.85
EDGES = (0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.93)
Rows = dict[str, np.ndarray]


def main() -> None:
    """Judge what the command line asks for."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--truth", help="file of certified pixels; the library's own by default")
    options.add_argument("--seed", type=int, default=1001, help="of the images")
    options.add_argument("--repeats", type=int, default=2, help="images of each size below 4096")
    options.add_argument("--folder", help="keep rendered stores there")
    options.add_argument("--indices", action="store_true", help="judge intervals of tail indices")
    given = options.parse_args()
    truth = chd.certified(given.truth)
    if given.indices:
        _judge_indices(truth)
        return
    found: dict[str, list[Rows]] = {"own": [], "around": []}
    for scene in sorted(set(truth.scene.to_numpy().tolist())):
        for way, rows in _of_scene(truth, scene, given):
            found[way].append(rows)
    for way, by in (("own", error_bars._OWN), ("around", error_bars._POOLED)):
        rows = {key: np.concatenate([part[key] for part in found[way]]) for key in found[way][0]}
        _print(way, rows, by)


def _of_scene(truth, scene: str, given: argparse.Namespace) -> Iterator[tuple[str, Rows]]:
    """Yield logits before calibration and certified coverages of the pixels of a scene."""
    of_scene = truth.isel(pixel=np.flatnonzero(truth.scene.to_numpy() == scene))
    y, x = (of_scene[name].to_numpy() for name in ("y", "x"))
    size = int(of_scene["width"][0]), int(of_scene["height"][0])
    out = f"{given.folder}/{scene}.zarr" if given.folder else None
    samples = chd.render(scene, spp=max(SIZES), size=size, seed=given.seed, out=out)
    for n in SIZES:
        true = of_scene["coverage"].sel(size=n).transpose("pixel", "channel").to_numpy()
        for repeat in range(min(given.repeats, max(SIZES) // n)):
            block = samples.read(ss=slice(repeat * n, (repeat + 1) * n))
            bars = measured(PositivePart.of_pixels(block, rows="both"), error_bars.Bar())
            pooled = error_bars.pooled_bars(bars.shape, bars.samples).coverage
            ways = (
                ("own", bars.coverage_own, error_bars._OWN),
                ("around", pooled, error_bars._POOLED),
            )
            for way, coverage, by in ways:
                logit = (special.logit(coverage[y, x]) - by.shift) / by.slope
                known = np.isfinite(logit) & np.isfinite(true)
                channel = np.broadcast_to(np.arange(true.shape[1]), true.shape)
                place = np.broadcast_to(np.arange(len(y))[:, np.newaxis], true.shape)
                yield (
                    way,
                    {
                        "logit": logit[known],
                        "true": true[known],
                        "n": np.full(known.sum(), n),
                        "channel": channel[known],
                        "pixel": place[known],
                        "scene": np.full(known.sum(), scene, dtype="U40"),
                    },
                )


def _fitted(rows: Rows, which: np.ndarray) -> np.ndarray:
    """Return shift and slope that make the true coverage likeliest (fractional logits)."""
    x, true = rows["logit"][which], rows["true"][which]

    def loss(b: np.ndarray) -> float:
        middle = b[0] + b[1] * x
        return float(np.sum(np.logaddexp(0, middle) - true * middle))

    return optimize.minimize(loss, np.array([0.0, 1.0]), method="BFGS").x


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def _judge_indices(truth) -> None:
    found: list[tuple[str, int, int, float, int]] = []
    for scene in sorted(set(truth.scene.to_numpy().tolist())):
        of_scene = truth.isel(pixel=np.flatnonzero(truth.scene.to_numpy() == scene))
        places = np.stack([of_scene["y"], of_scene["x"]], axis=-1)
        size = int(of_scene["width"][0]), int(of_scene["height"][0])
        for at in range(0, len(places), 16):
            drawn = chd.rendering.render_pixels(
                scene, places[at : at + 16], spp=MANY, size=size, seed=1, backend="llvm"
            )
            for i, x in enumerate(luminance(drawn)):
                for n in TAIL_SIZES:
                    for batch in range(BATCHES):
                        part = x[batch * n : (batch + 1) * n]
                        found.append((scene, at + i, n, *_holds(part, x)))
    for n in TAIL_SIZES:
        here = [row for row in found if row[2] == n]
        held = np.array([row[3] for row in here])
        pixel = np.unique([f"{row[0]}{row[1]}" for row in here], return_inverse=True)[1]
        known = np.isfinite(held)
        means = np.array([held[known & (pixel == i)].mean() for i in np.unique(pixel[known])])
        error = means.std(ddof=1) / np.sqrt(len(means))
        scenes = np.array([row[0] for row in here])
        each = [f"{s[:4]} {held[known & (scenes == s)].mean():.2f}" for s in np.unique(scenes)]
        why, counts = np.unique([row[4] for row in here if row[4]], return_counts=True)
        reasons = {Reason(int(k)).name: int(c) for k, c in zip(why, counts, strict=True)}
        _say(
            f"n {n}: intervals hold the index of {MANY} samples in {held[known].mean():.3f} ± "
            f"{error:.3f} of {known.sum()}; no index: {reasons} of {len(here)}; {' '.join(each)}"
        )


def _holds(few: np.ndarray, many: np.ndarray) -> tuple[float, int]:
    """Return whether the interval holds the index of many samples, and the reason if none."""
    tail = chd.fit.tail_index(few)
    if tail.reason != Reason.OK:
        return np.nan, int(tail.reason)
    true = chd.fit.tail_index(many, share=min(float(tail.share), 0.999)).xi
    held = float(tail.interval[0] <= true <= tail.interval[1])
    return (held if np.isfinite(true) else np.nan), 0


def area(score: np.ndarray, fails: np.ndarray) -> float:
    """Return the area under the curve: P(a pixel that fails scores higher)."""
    ranks, ones = stats.rankdata(score), fails.sum()
    if not 0 < ones < len(fails):
        return np.nan
    return float((ranks[fails].sum() - ones * (ones + 1) / 2) / (ones * (~fails).sum()))


def _print(way: str, rows: Rows, by) -> None:
    predicted = np.full(len(rows["true"]), np.nan)
    for scene in np.unique(rows["scene"]):
        here = rows["scene"] == scene
        shift, slope = _fitted(rows, ~here)
        predicted[here] = special.expit(shift + slope * rows["logit"][here])
    built_in = special.expit(by.shift + by.slope * rows["logit"])
    _say(f"\n{way}: scenes held out")
    for n in (*SIZES, None):
        _line(rows, predicted, n)
    _say(f"{way}: built-in constants {tuple(by)}")
    for n in (*SIZES, None):
        _line(rows, built_in, n)
    everything = np.ones(len(predicted), dtype=bool)
    shift, slope = _fitted(rows, everything)
    middle = shift + slope * rows["logit"]
    off = np.abs(special.logit(np.clip(rows["true"], 0.01, 0.99)) - middle)
    deviation = np.quantile(off, 0.95) / stats.norm.isf(0.025)
    _say(f"constants fitted to all: {shift:.2f}, {slope:.3f}, {deviation:.2f}")


def _line(rows: Rows, predicted: np.ndarray, n: int | None) -> None:
    luminance = rows["channel"] == rows["channel"].max()
    here = luminance if n is None else luminance & (rows["n"] == n)
    true, p, scene = rows["true"][here], predicted[here], rows["scene"][here]
    judged = (true >= HOLD) | (true <= FAIL)
    fails = true <= FAIL
    pixel = np.unique(
        [f"{s}{i}" for s, i in zip(scene, rows["pixel"][here], strict=True)], return_inverse=True
    )[1]
    rng = np.random.default_rng(0)
    areas, alarms = [], []
    members = [np.flatnonzero(pixel == i) for i in range(pixel.max() + 1)]
    for _ in range(200):
        at = np.concatenate([members[i] for i in rng.integers(0, len(members), len(members))])
        some = at[judged[at]]
        areas.append(area(-p[some], fails[some]))
        alarms.append(np.mean(p[at[true[at] >= HOLD]] < error_bars.FAILS))
    of_scenes = [
        f"{s[:4]} {area(-p[judged & (scene == s)], fails[judged & (scene == s)]):.2f}"
        for s in np.unique(scene)
    ]
    bins = np.digitize(p, EDGES)
    cells, worst = [], 0.0
    for k in range(len(EDGES) + 1):
        if (inside := bins == k).sum():
            cells.append(f"{p[inside].mean():.2f}/{true[inside].mean():.2f}({inside.sum()})")
            if inside.sum() >= 20:
                worst = max(worst, abs(p[inside].mean() - true[inside].mean()))
    well, said_hold = true >= HOLD, p >= error_bars.HOLDS
    said_fail = p < error_bars.FAILS
    lines = [
        f"n {n or 'all':>5}: area {area(-p[judged], fails[judged]):.3f} ± {np.std(areas):.3f}",
        f"said to fail {said_fail[well].mean():.3f} ± {np.std(alarms):.3f} where bars hold, "
        f"{said_fail[fails].mean():.2f} where they fail",
        f"said to hold {said_hold[well].mean():.2f}, {said_hold[fails].mean():.3f}",
        f"bins off by at most {worst:.3f}",
    ]
    _say("; ".join(lines))
    _say(f"        {' '.join(of_scenes)}\n        {' '.join(cells)}")


if __name__ == "__main__":
    main()
