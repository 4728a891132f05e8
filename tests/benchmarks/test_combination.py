"""The default estimate on scenes: against the denoiser, by groups of pixels, and its forecast.

For each scene and number of samples:

- MSE and relMSE over those of the better denoiser from the mean (with or without features: the
  smaller product of both), those of the denoiser from the estimate, and those over the mean's;
- the bias of the image, and the share of 90 % intervals that hold the truth, by thirds of
  brightness;
- by decile of the pixels' and channels' noise, and of their relative noise, the quiet first: MSE
  (of relative noise: relMSE) over the mean's, with a star where it is above 1.1 by more than two
  standard errors; and the same share of intervals;
- energy: the sum of the image minus its mean's, in standard errors of the mean's; for each block
  and decile the sum minus the reference's, in standard errors of both;
- `relative_error` over the true one, and the number of samples that `spp_for` names for half of
  the error, beside the true one, between the errors at CHDSTAT_CURVE samples.

No number contains the noise of the reference. Then a line for each figure that must hold; the test
fails if one does not. Built-in scenes trained the network, others did not. Run with
``--benchmark-only -s``; `rendered` names the scenes and where they are kept, CHDSTAT_NUMBERS and
CHDSTAT_CURVE are numbers of samples, apart by commas, CHDSTAT_SEEDS how many seeds.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pytest

import chdstat as chd
from chdstat.comparison import Interval, Judge
from chdstat.estimators import Combination
from chdstat.io import denoise
from chdstat.studies.claims import SceneData
from tests.benchmarks.groups import Noise, errors_of_sums, holds, means, ratios, sums
from tests.benchmarks.rendered import Rendered, scenes

NUMBERS = tuple(int(n) for n in os.environ.get("CHDSTAT_NUMBERS", "16,64,256").split(","))
CURVE = tuple(int(n) for n in os.environ.get("CHDSTAT_CURVE", "16,32,64,128,256").split(","))
SEEDS = int(os.environ.get("CHDSTAT_SEEDS", "1"))
WORSE = 1.1
"""MSE over the mean's that a group must not surely exceed."""
ROWS = 0.9
"""Share of rows in which a figure holds."""


def better_of(errors: Mapping[str, np.ndarray], *names: str) -> np.ndarray:
    """Return squared errors (pixel, 2) of the image whose product of both errors is the least."""
    return min((errors[name] for name in names), key=lambda e: np.prod(e.mean(axis=0)))


def errors_of(image: np.ndarray, reference: Judge) -> np.ndarray:
    """Return the squared and the relative squared errors, shape (2, y, x, channel)."""
    return np.stack([reference.squared(image), reference.relative(image)[0]])


def images_of(samples: chd.Samples, found: Combination) -> dict[str, np.ndarray]:
    """Return the estimate, the mean and both denoised, with and without features."""
    guides = {name: samples.features[name] for name in ("albedo", "normal")}
    images = {"estimate": found.radiance, "mean": found.mean}
    for name, features in {"": {}, " with features": guides}.items():
        images[f"denoised{name}"] = denoise(found.mean, **features)
        images[f"from it{name}"] = found.guarded(denoise(found.radiance, **features))
    return images


@dataclass(frozen=True)
class Row:
    """Estimates of a scene from n samples, one for each seed."""

    rendered: Rendered
    n: int
    samples: list[chd.Samples]
    found: list[Combination]
    reference: Judge
    noise: Noise
    groupings: Mapping[str, np.ndarray]

    @cached_property
    def errors(self) -> dict[str, np.ndarray]:
        """Errors (seed, 2, y, x, channel) by name of the image."""
        made = [images_of(x, f) for x, f in zip(self.samples, self.found, strict=True)]
        return {k: np.stack([errors_of(m[k], self.reference) for m in made]) for k in made[0]}

    @cached_property
    def over(self) -> dict[str, list[Interval[float]]]:
        """MSE and relMSE over the better denoiser's and the mean's, and of that from it."""
        e = {k: v.mean(axis=(0, -1)).reshape(2, -1).T for k, v in self.errors.items()}
        whole = SceneData(self.rendered.name, self.samples[0]).whole(across=4)
        denoised = better_of(e, "denoised", "denoised with features")
        pairs = {
            "denoiser": (e["estimate"], denoised),
            "from it": (better_of(e, "from it", "from it with features"), denoised),
            "mean": (e["estimate"], e["mean"]),
        }
        return {
            name: [whole.ratio(a, b) for a, b in zip(one.T, other.T, strict=True)]
            for name, (one, other) in pairs.items()
        }

    @cached_property
    def by_noise(self) -> dict[str, np.ndarray]:
        """Errors over the mean's and their standard errors, (2, decile), by grouping."""
        own, mean = (self.errors[name].swapaxes(0, 1) for name in ("estimate", "mean"))
        return {
            name: ratios(self.groupings[name], own[i], mean[i])
            for i, name in enumerate(("noise", "relative noise"))
        }

    @cached_property
    def held(self) -> dict[str, np.ndarray]:
        """Share of intervals that hold the truth in each group, by grouping."""
        inside = np.stack([holds(f, self.reference)[1] for f in self.found])
        return {name: means(group, inside) for name, group in self.groupings.items()}

    @cached_property
    def from_mean(self) -> float:
        """Sum of the image minus the mean's, in standard errors of the mean's."""
        apart = np.mean([np.sum(f.radiance - f.mean, dtype=np.float64) for f in self.found])
        return float(apart / self.noise.error_of_sum(self.groupings["image"], self.n)[0])

    @cached_property
    def energy(self) -> dict[str, np.ndarray]:
        """Sums minus the reference's, in standard errors of the mean's and its, by grouping."""
        return self._energy([f.radiance for f in self.found])

    @cached_property
    def energy_of_mean(self) -> dict[str, np.ndarray]:
        """The same of the mean, which has no bias: what is beyond 3 there is chance."""
        return self._energy([f.mean for f in self.found])

    def _energy(self, images: list[np.ndarray]) -> dict[str, np.ndarray]:
        apart = np.stack(images) - self.reference.mean
        found = {}
        for name in ("image", "block", "noise", "relative noise"):
            group = self.groupings[name]
            noise = self.noise.error_of_sum(group, self.n)
            error = np.hypot(noise, errors_of_sums(group[0], self.reference.error))
            found[name] = sums(group, apart) / len(apart) / np.maximum(error, 1e-30)
        return found

    @cached_property
    def of_exact(self) -> tuple[int, int, int]:
        """Values known exactly: how many, how many are moved, and outside of their interval."""
        exact = self.noise.exact()
        image, mean, low, high = (
            np.stack([getattr(f, name) for f in self.found])[exact]
            for name in ("radiance", "mean", "low", "high")
        )
        moved = abs(image - mean) > 1e-5 * abs(mean)
        outside = (mean < low * (1 - 1e-5)) | (mean > high * (1 + 1e-5))
        return len(mean), int(moved.sum()), int(outside.sum())

    def lines(self) -> str:
        def shown(values):
            return " ".join(f"{r.value:.2f} [{r.low:.2f}, {r.high:.2f}]" for r in values)

        bias = np.mean([f.radiance.mean() for f in self.found]) / self.reference.mean.mean() - 1
        doubt = np.mean([f.bias_error for f in self.found])
        thirds = " ".join(f"{x:.2f}" for x in self.held["third"])
        known, moved, outside = self.of_exact
        started = " ".join(f"{r.value:.2f}" for r in self.over["from it"])
        text = (
            f"{self.rendered.name:24s}{self.n:4d}  {shown(self.over['denoiser'])}  "
            f"{started}  {shown(self.over['mean'])}  "
            f"{bias:+6.1%} ± {doubt:4.1%}  {thirds}  energy {self.from_mean:+.1f} of the mean's, "
            f"{self.energy['image'][0]:+.1f}; {known} exact, {moved} moved, {outside} outside\n"
        )
        for name, (ratio, error) in self.by_noise.items():
            star = np.where(ratio - 2 * error > WORSE, "*", " ")
            cells = zip(ratio, error, star, strict=True)
            text += f"  {name:16s}" + "".join(f"{r:7.3g} ±{e:5.2g}{s}" for r, e, s in cells)
            text += "\n  in 90 %, energy "
            cells = zip(self.held[name], self.energy[name], strict=True)
            text += "".join(f"{share:7.2f} {z:+6.1f} " for share, z in cells) + "\n"
        return text + "  blocks, energy  " + " ".join(f"{z:+.1f}" for z in self.energy["block"])


@dataclass(frozen=True)
class Curve:
    """Errors of a scene at numbers of samples: the estimated ones of each seed, and the true."""

    name: str
    said: np.ndarray
    true: np.ndarray
    forecast: np.ndarray

    @classmethod
    def of(cls, name: str, found: Mapping[int, list[Combination]], reference: Judge) -> Curve:
        relative = [
            np.mean([reference.relative(f.radiance)[0].mean() for f in found[n]]) for n in CURVE
        ]
        said = np.array([[f.relative_error for f in found[n]] for n in CURVE])
        forecast = np.array(
            [
                [f.spp_for(f.relative_error / 2) if hasattr(f, "spp_for") else np.nan for f in of]
                for of in (found[n] for n in CURVE)
            ],
            dtype=float,
        )
        return cls(name, said, np.sqrt(np.maximum(relative, 0)), forecast)

    @cached_property
    def over_true(self) -> np.ndarray:
        """Estimated error over the true one, shape (number,)."""
        return np.median(self.said, axis=1) / np.where(self.true > 0, self.true, np.nan)

    @cached_property
    def half(self) -> np.ndarray:
        """Number of samples at which the true error is half; NaN if that is outside the curve."""
        least = np.minimum.accumulate(np.maximum(self.true, 1e-30))
        x, y = np.log(CURVE), np.log(least)
        return np.exp(np.interp(-y - np.log(0.5), -y, x, left=np.nan, right=np.nan))

    def line(self) -> str:
        said = " ".join(f"{x:5.2f}" for x in self.over_true)
        pairs = zip(CURVE, np.median(self.forecast, axis=1), self.half, strict=True)
        half = "  ".join(f"{n}: {f:.0f} {h:.0f}" for n, f, h in pairs if np.isfinite(h))
        true = " ".join(f"{x:.3f}" for x in self.true)
        return f"{self.name:24s}{true}  {said}  half from {half or 'no number: outside the curve'}"


class Figures:
    """Lines of what must hold, printed with numbers; `missed` lists those that do not."""

    def __init__(self) -> None:
        self.missed: list[str] = []

    def line(self, held: bool, words: str) -> None:
        print(f"{'held' if held else 'MISSED'}: {words}")
        if not held:
            self.missed.append(words)

    def share(self, inside: np.ndarray, words: str, *, least: float = ROWS) -> None:
        """Print how many rows hold, and whether these are enough."""
        if inside.size:
            count = np.count_nonzero(inside)
            enough = f"{count} of {inside.size} (at least {least:.0%})"
            self.line(count >= least * inside.size - 1e-9, f"{words}: {enough}")


def geometric(rows: list[Row], name: str) -> np.ndarray:
    """Return geometric means of MSE and relMSE over an image's."""
    table = [[r.value for r in row.over[name]] for row in rows]
    return np.exp(np.log(np.maximum(table, 0.01)).mean(axis=0))


def figures_of(rows: list[Row], curves: list[Curve], kind: str) -> list[str]:
    """Print whether each figure holds in scenes of a kind; return those that do not."""
    found = Figures()
    print(f"\n{kind}: {len(rows)} rows of {len(curves)} scenes, {SEEDS} seeds")
    for name in ("from it", "mean"):
        print(f"geometric means, {name}: {geometric(rows, name).round(2)}")
    other = rows[0].rendered.other
    most, of_denoiser = ((0.9, 0.7) if other else (0.45, 0.68)), geometric(rows, "denoiser")
    words = f"{of_denoiser.round(2)} of the better denoiser, at most {most}"
    found.line(bool((of_denoiser.round(2) <= most).all()), words)
    surely = [max(r.low for r in row.over["denoiser"]) > 1.02 for row in rows]
    found.line(not (other and any(surely)), f"rows surely above 1.02 of it: {sum(surely)}")
    for row in rows:
        if row.rendered.name.startswith("night-room") and row.n == 16:
            worst = max(r.value for r in row.over["denoiser"])
            found.line(worst <= 1.05, f"night-room at 16 spp: {worst:.2f}, at most 1.05")
    for name in ("noise", "relative noise"):
        ratio, error = np.concatenate([row.by_noise[name] for row in rows], axis=1)
        above = np.count_nonzero(ratio - 2 * error > WORSE)
        known = np.isfinite(ratio)
        words = f"deciles by {name} surely above {WORSE} of the mean's: {above} of {known.sum()}"
        found.line(above == 0, f"{words}; largest {np.nanmax(ratio):.3g}, {(~known).sum()} unknown")
    known, moved, outside = np.sum([row.of_exact for row in rows], axis=0)
    found.line(moved == 0, f"exact values that are moved: {moved} of {known}")
    found.line(outside == 0, f"exact values outside of their intervals: {outside} of {known}")
    of_mean = np.array([row.from_mean for row in rows])
    words = f"sum of the image within 2 of the mean's (largest {abs(of_mean).max():.1f})"
    found.share(abs(of_mean) <= 2, words)
    for name in ("image", "block", "noise", "relative noise"):
        z, chance = (
            abs(np.concatenate([of[name] for of in each]))
            for each in zip(*((row.energy, row.energy_of_mean) for row in rows), strict=True)
        )
        count = np.count_nonzero(z > 3)
        words = f"sums by {name} beyond 3: {count} of {z.size}, largest {z.max():.1f}"
        by_chance = np.count_nonzero(chance > 3)
        # The mean has no bias: where tails are heavy, it is beyond 3 by chance.
        found.line(count <= by_chance, f"{words} (the mean's {by_chance}, {chance.max():.1f})")
    for name in ("third", "channel", "noise", "relative noise"):
        share = np.concatenate([row.held[name] for row in rows])
        within = (share >= 0.85) & (share <= 0.97)
        words = f"intervals by {name} hold .85 to .97 (mean {share.mean():.3f}"
        found.share(within, f"{words}, {(share < 0.85).sum()} less, {(share > 0.97).sum()} more)")
    over_true = np.concatenate([curve.over_true for curve in curves])
    over_true = over_true[np.isfinite(over_true)]
    words = f"relative_error over the true .8 to 1.25 ({over_true.min():.2f} to "
    found.share((over_true >= 0.8) & (over_true <= 1.25), f"{words}{over_true.max():.2f})")
    forecast = np.concatenate(
        [np.median(c.forecast, axis=1)[np.isfinite(c.half)] for c in curves] or [np.empty(0)]
    )
    half = np.concatenate([c.half[np.isfinite(c.half)] for c in curves])
    if not hasattr(Combination, "spp_for"):
        print("no forecast: Combination has no spp_for")
    else:
        within = abs(np.log(forecast / half)) <= np.log(1.25)
        found.share(within, "forecast of half of the error within 25 %", least=0.75)
    return found.missed


@pytest.fixture(scope="module")
def rendered(tmp_path_factory) -> list[Rendered]:
    return scenes(tmp_path_factory.mktemp("rendered"))


def test_errors_against_the_denoiser(as_benchmark, rendered):
    rows: list[Row] = []
    curves: list[tuple[bool, Curve]] = []
    print(
        f"\n{'scene':24s}{'spp':>4s}  MSE               relMSE            from it    "
        "over mean                            bias            in 90 %"
    )
    for one in rendered:
        reference, most = one.reference(), max(*NUMBERS, *CURVE)
        renders = [one.samples(i, most) for i in range(max(SEEDS, 2) if SEEDS < 3 else SEEDS)]
        noise = Noise.of(renders, SEEDS)
        groupings = noise.groupings(reference)
        found = {}
        for n in sorted({*NUMBERS, *CURVE}):
            samples = [store.first(n) for store in renders[:SEEDS]]
            found[n] = [chd.estimate(x, progress=False) for x in samples]
            if n in NUMBERS:
                rows.append(Row(one, n, samples, found[n], reference, noise, groupings))
                print(rows[-1].lines(), flush=True)
        curves.append((one.other, Curve.of(one.name, found, reference)))
    print(f"\n{'true error':24s}at {CURVE} spp; relative_error over it; spp for half: said, true")
    for _, curve in curves:
        print(curve.line())
    missed = []
    for other, kind in ((False, "real and built-in scenes"), (True, "other scenes")):
        of_kind = [row for row in rows if row.rendered.other == other]
        if of_kind:
            missed += figures_of(of_kind, [c for o, c in curves if o == other], kind)
    assert not missed, f"{len(missed)} figures are missed"


def test_time_against_rendering(as_benchmark, rendered):
    scene = next((one.scene for one in rendered if one.name == "bathroom"), "bathroom")
    start, spent = time.perf_counter(), time.process_time()
    samples = chd.render(scene, spp=64, size=(256, 256), progress=False)
    rendering = time.perf_counter() - start, time.process_time() - spent
    chd.estimate(samples.isel(y=slice(64), x=slice(64)))  # the denoiser loads its network
    start, spent = time.perf_counter(), time.process_time()
    chd.estimate(samples)
    took = time.perf_counter() - start, time.process_time() - spent
    print(
        f"\n256 x 256 x 64: {took[0] / rendering[0]:.2f} of the time of rendering (target .35), "
        f"{took[1] / rendering[1]:.2f} of its processor time"
    )
