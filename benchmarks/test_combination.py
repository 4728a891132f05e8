"""The default estimate on scenes: against the denoiser, by groups of pixels, and its forecast.

For each scene and number of samples:

- MSE and relMSE over those of the better denoiser from the mean (with or without features: the
  smaller product of both), those of the denoiser from the estimate, and those over the mean's;
- the bias of the image, and the share of 90 % intervals that hold the truth, by thirds of
  brightness;
- by decile of the pixels' and channels' noise, and of their relative noise, the quiet first: MSE
  (by relative noise: relMSE) over the mean's, with a star where it is above 1.1 by more than two
  standard errors; and the same share of intervals;
- energy: the sum of the image minus its mean's, in standard errors of the mean's; for each block
  and decile the sum minus the reference's, in standard errors of both;
- `relative_error` over the true one, and the number of samples that `spp_for` names for half of
  the error, beside the true one, between the errors at CHDSTAT_CURVE samples.

Then a line for each figure that must hold; the test fails if one does not. Built-in scenes trained
the network, others did not. Run with ``--benchmark-only -s``; `rendered` names the scenes and where
they are kept, CHDSTAT_NUMBERS and CHDSTAT_CURVE are numbers of samples, apart by commas,
CHDSTAT_SEEDS how many seeds.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence

import numpy as np
import pytest

import chdstat as chd
from benchmarks.groups import SURE, WORSE, Noise
from benchmarks.rendered import Rendered, scenes
from benchmarks.rows import BY_NOISE, Curve, Row
from chdstat.estimators import Combination

NUMBERS = tuple(int(n) for n in os.environ.get("CHDSTAT_NUMBERS", "16,64,256").split(","))
CURVE = tuple(int(n) for n in os.environ.get("CHDSTAT_CURVE", "16,32,64,128,256").split(","))
SEEDS = int(os.environ.get("CHDSTAT_SEEDS", "1"))
KINDS = {
    "real and built-in scenes": (0.45, 0.68),
    "other scenes": (0.9, 0.7),
}
"""Largest geometric means of MSE and relMSE over the better denoiser's."""
ROWS = 0.9
"""Share of rows in which a figure must hold, unless each row must."""
FORECASTS = 0.75


class Figures:
    """Figures of the scenes of a kind, printed with whether they hold.

    Attributes
    ----------
    missed
        Those that do not hold.
    """

    def __init__(self, rows: Sequence[Row], curves: Sequence[Curve]) -> None:
        self.rows, self.curves, self.missed = rows, curves, []

    def line(self, held: bool, words: str) -> None:
        print(f"{'held' if held else 'MISSED'}: {words}")
        if not held:
            self.missed.append(words)

    def share(self, inside: np.ndarray, words: str, *, least: float = ROWS) -> None:
        if inside.size:
            count = np.count_nonzero(inside)
            enough = f"{count} of {inside.size} (at least {least:.0%})"
            self.line(count >= least * inside.size, f"{words}: {enough}")

    def of_denoiser(self, most: tuple[float, float]) -> None:
        for name in ("denoiser", "from it", "mean"):
            table = [[r.value for r in row.over[name]] for row in self.rows]
            whole = np.exp(np.log(np.maximum(table, 0.01)).mean(axis=0)).round(2)
            if name == "denoiser":
                words = f"MSE and relMSE {whole} of the better denoiser's, at most {most}"
                self.line(bool((whole <= most).all()), words)
            else:
                print(f"geometric means, {name}: {whole}")

    def surely_worse(self) -> None:
        surely = [max(r.low for r in row.over["denoiser"]) > 1.02 for row in self.rows]
        self.line(not any(surely), f"rows surely above 1.02 of the denoiser's: {sum(surely)}")

    def night_room(self) -> None:
        for row in self.rows:
            if row.name == "night-room" and row.n == 16:
                worst = max(r.value for r in row.over["denoiser"])
                self.line(worst <= 1.05, f"night-room at 16 spp: {worst:.2f}, at most 1.05")

    def deciles(self) -> None:
        for name in BY_NOISE:
            ratio, _, z = np.concatenate([row.by_noise[name] for row in self.rows], axis=1)
            above = z > SURE
            words = (
                f"deciles by {name} surely above {WORSE} of the mean's: {np.count_nonzero(above)} "
                f"of {z.size}, largest {np.nanmax(ratio[above], initial=0):.3g}"
            )
            self.line(not above.any(), words)

    def exact(self) -> None:
        of_row = [(row.exact, row.moved, row.outside) for row in self.rows]
        known, moved, outside = np.sum(of_row, axis=0)
        words = f"exact values: {known}, {moved} moved, {outside} outside of their intervals"
        self.line(moved == 0 and outside == 0, words)

    def energy(self) -> None:
        of_mean = abs(np.array([row.from_mean for row in self.rows]))
        words = f"sum of the image within 2 of the mean's (largest {of_mean.max():.1f})"
        self.share(of_mean <= 2, words)
        for name in ("image", "block", *BY_NOISE):
            z = abs(np.concatenate([row.energy[name] for row in self.rows]))
            chance = abs(np.concatenate([row.energy_of_mean[name] for row in self.rows]))
            # Where tails are heavy, the mean is beyond 3 by chance, too.
            beyond, by_chance = (np.count_nonzero(x > 3) for x in (z, chance))
            words = (
                f"sums by {name} beyond 3: {beyond} of {z.size}, largest {z.max():.1f} (the mean's "
                f"{by_chance}, {chance.max():.1f})"
            )
            self.line(beyond <= by_chance, words)

    def intervals(self) -> None:
        for name in ("third", "channel", *BY_NOISE):
            share = np.concatenate([row.held[name] for row in self.rows])
            less, more = (np.count_nonzero(x) for x in (share < 0.85, share > 0.97))
            words = f"intervals by {name} hold .85 to .97 (mean {share.mean():.3f}, {less} less, "
            self.share((share >= 0.85) & (share <= 0.97), f"{words}{more} more)")

    def stop(self) -> None:
        said = np.concatenate([curve.over_true for curve in self.curves])
        said = said[np.isfinite(said)]
        words = f"relative_error over the true .8 to 1.25 ({said.min():.2f} to {said.max():.2f})"
        self.share((said >= 0.8) & (said <= 1.25), words)
        if not hasattr(Combination, "spp_for"):
            print("no forecast: Combination has no spp_for")
            return
        known = [c.forecast_over_true[np.isfinite(c.half)] for c in self.curves]
        first = np.array([of[0] for of in known if of.size])
        words = (
            "scenes whose forecast of half of the error, from the fewest samples, is within 25 %"
        )
        self.share(abs(np.log(first)) <= np.log(1.25), words, least=FORECASTS)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory) -> list[Rendered]:
    return scenes(tmp_path_factory.mktemp("rendered"))


def test_errors_against_the_denoiser(as_benchmark, rendered):
    table = {kind: ([], []) for kind in KINDS}
    print(
        f"\n{'scene':24s}{'spp':>4s}  MSE               relMSE            from it    "
        "over mean                            bias            in 90 %"
    )
    texts = []
    for one in rendered:
        reference, numbers = one.reference(), sorted({*NUMBERS, *CURVE})
        renders = [one.samples(i, max(numbers)) for i in range(max(SEEDS, 2))]
        noise = Noise.of(renders, SEEDS)
        groupings = noise.groupings(reference)
        rows, curves = table["other scenes" if one.other else "real and built-in scenes"]
        found = {}
        for n in numbers:
            samples = [store.first(n) for store in renders[:SEEDS]]
            found[n] = [chd.estimate(x, progress=False) for x in samples]
            if n in NUMBERS:
                rows.append(Row.of(samples, found[n], reference, noise, groupings))
                print(rows[-1].text(one.name), flush=True)
        curves.append(Curve.of({n: found[n] for n in CURVE}, reference))
        texts.append(curves[-1].text(one.name))
    print(f"\n{'true error':24s}at {CURVE} spp; relative_error over it; spp for half: said, true")
    print("\n".join(texts))
    missed = []
    for kind, (rows, curves) in table.items():
        if rows:
            print(f"\n{kind}: {len(rows)} rows of {len(curves)} scenes, {SEEDS} seeds")
            figures = Figures(rows, curves)
            figures.of_denoiser(KINDS[kind])
            if kind == "other scenes":
                figures.surely_worse()
            figures.night_room()
            figures.deciles()
            figures.exact()
            figures.energy()
            figures.intervals()
            figures.stop()
            missed += figures.missed
    assert not missed, f"{len(missed)} figures are missed"


def test_time_against_rendering(as_benchmark, rendered):
    """The processor time of an estimate is at most half of the render's."""
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
    assert took[1] <= 0.5 * rendering[1]
