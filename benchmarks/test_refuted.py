"""The default estimate on made images with known truth, where pixels know more than what is pooled.

For each image, number of samples and group of its pixels and channels (the image, its quiet, loud
and exact ones, its classes, channels, thirds of brightness, and blocks): MSE and relMSE over those
of the mean, the share of 90 % intervals that hold the truth, and how far the sum is from the
mean's, in standard errors of the latter. Of the image, `Combination.relative_error` over the true
one. The last lines say what of it is held. A ratio is above a limit if it is so by two standard
errors, which come from seeds and blocks.

Run with ``--benchmark-only -s``. CHDSTAT_SEEDS images are drawn of each variant; CHDSTAT_NAMES
names kinds, apart by semicolons, CHDSTAT_NUMBERS the samples, apart by commas. CHDSTAT_WRITE names
a CSV file for all figures, CHDSTAT_BASELINE one of another version, to compare with:
rows of as many seeds have the same samples.
"""

from __future__ import annotations

import csv
import os
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path

import numpy as np

from benchmarks.known_images import SIZE, Picture, pictures
from chdstat.estimators import CombinationStream

SEEDS = int(os.environ.get("CHDSTAT_SEEDS", "1"))
NAMES = os.environ.get("CHDSTAT_NAMES", "").split(";")
NUMBERS = tuple(int(n) for n in os.environ.get("CHDSTAT_NUMBERS", "4,16,64,256,1024").split(","))
LARGEST = 1024
CELL = 16
"""Edge of the blocks from which standard errors come."""
NOISES = "loud", "quiet", "exact"
CHANNELS = "red", "green", "blue"
THIRDS = "dark third", "middle third", "bright third"
JUDGED = "loud", "quiet", *CHANNELS, *THIRDS
"""Groups whose intervals are judged."""
LARGE = 300
"""Fewest pixels and channels, over seeds, for a share of intervals."""
IN_INTERVALS = 0.85, 0.97
OF_ERROR = 0.8, 1.25


@dataclass(frozen=True)
class Row:
    """Figures of one group of one image at one number of samples, over seeds.

    Attributes
    ----------
    noise
        Whether all of it is loud, quiet or exact; empty if it is not.
    mse, relmse
        Errors over those of the mean, with standard errors; NaN where neither has an error.
    error
        Mean squared error.
    held
        Share of intervals that hold the truth.
    bias
        Sum over the sum of the truth, minus 1.
    apart
        Of each seed, the sum minus the mean's, in standard errors of the mean's.
    relative_error
        The estimated relative error over the true one.
    kept
        Share of estimates that equal the truth.
    """

    kind: str
    variant: str
    n: int
    group: str
    size: int
    noise: str
    mse: float
    mse_error: float
    relmse: float
    relmse_error: float
    error: float
    held: float
    bias: float
    apart: list[float]
    relative_error: float
    kept: float

    @property
    def is_large(self) -> bool:
        """Whether there are enough pixels for a share of intervals."""
        return self.size * len(self.apart) >= LARGE

    @property
    def name(self) -> str:
        return f"{self.kind}, {self.variant}; {self.group} at {self.n}"

    @property
    def key(self) -> tuple[str, str, int, str]:
        return self.kind, self.variant, self.n, self.group


@dataclass
class Sums:
    """Sums over the pixels and channels of a group: for each seed, or each seed and cell."""

    cells: list[np.ndarray] = field(default_factory=list)
    apart: list[float] = field(default_factory=list)
    lights: list[tuple[float, float]] = field(default_factory=list)
    noises: set[str] = field(default_factory=set)

    def add(self, mask: np.ndarray, maps: np.ndarray, lights: np.ndarray, of_sum: float) -> None:
        """Add an image: `maps` (map, y, x, channel) and the `lights` of estimate, mean, truth."""
        y, x, c = mask.shape
        cut = (maps * mask).reshape(-1, y // CELL, CELL, x // CELL, CELL, c).sum(axis=(2, 4, 5))
        self.cells += [cell for cell in cut.reshape(len(maps), -1).T if cell[0]]
        estimate, mean, truth = lights[:, mask].sum(axis=-1)
        self.apart.append((estimate - mean) / of_sum if of_sum else 0.0)
        self.lights.append((estimate, truth))

    def row(self, name: tuple[str, str, int, str], relative_error: float) -> Row:
        cells = np.array(self.cells)
        size, held, kept, of_estimate, of_mean, relative, of_mean_relative = cells.T
        return Row(
            *name,
            int(size.sum() / len(self.apart)),
            self.noises.pop() if len(self.noises) == 1 else "",
            *ratio(of_estimate, of_mean),
            *ratio(relative, of_mean_relative),
            of_estimate.sum() / size.sum(),
            held.sum() / size.sum(),
            np.divide(*np.sum(self.lights, axis=0)) - 1,
            [round(z, 2) for z in self.apart],
            relative_error / np.sqrt(relative.sum() / size.sum()) if relative.any() else np.nan,
            kept.sum() / size.sum(),
        )


def ratio(one: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Return a ratio of sums over cells, and its standard error (linearised)."""
    if not other.any():
        return np.inf if one.any() else np.nan, np.nan
    value, k = one.sum() / other.sum(), len(one)
    if k < 3:
        return value, np.nan
    return value, np.sqrt(np.square(one - value * other).sum() * k / (k - 1)) / other.sum()


def groups(picture: Picture) -> Iterator[tuple[str, np.ndarray]]:
    """Yield all groups of an image; of those by brightness and channel, what varies."""
    truth, varies = picture.truth, picture.noise > 0
    yield "image", np.ones(truth.shape, bool)
    yield from picture.groups.items()
    for c, name in enumerate(CHANNELS):
        if varies[..., c].any():
            yield name, varies & (np.arange(3) == c)
    order = np.argsort(np.where(varies, truth, np.inf), axis=None, kind="stable")[: varies.sum()]
    for name, part in zip(THIRDS, np.array_split(order, 3), strict=True):
        mask = np.zeros(truth.size, bool)
        mask[part] = True
        yield name, mask.reshape(truth.shape)
    half = SIZE // 2
    for y in (0, half):
        for x in (0, half):
            mask = np.zeros(truth.shape, bool)
            mask[y : y + half, x : x + half] = True
            yield f"block {y}, {x}", mask


def covariance(picture: Picture, x: np.ndarray) -> np.ndarray:
    """Return the covariance of channels, (y, x, channel, channel); from samples if it has none."""
    if np.isfinite(picture.covariance).all():
        return picture.covariance
    apart = x - x.mean(axis=-1, keepdims=True, dtype=np.float64)
    return np.einsum("yxcn,yxdn->yxcd", apart, apart) / (x.shape[-1] - 1)


def rows(seeds: Sequence[Picture], numbers: Sequence[int]) -> Iterator[Row]:
    """Yield the figures of images that differ in their seeds."""
    kind, variant = seeds[0].kind, seeds[0].variant
    sums: dict[tuple[int, str], Sums] = {}
    stop: dict[int, list[float]] = {n: [] for n in numbers}
    for seed, picture in enumerate(seeds):
        rng = np.random.default_rng((seed, zlib.crc32(f"{kind} {variant}".encode())))
        most = max(picture.numbers or (LARGEST, *numbers))  # first samples are always the same
        drawn, truth = picture.sampler(most, rng), picture.truth
        weight = 1 / (truth**2 + 0.01 * truth.mean(axis=(0, 1)) ** 2)
        stream = CombinationStream(truth.shape)  # equals `estimate`, and sums each sample once
        for n in sorted(numbers):
            stream.update(drawn[..., stream.spp : n])
            found = stream.estimate(features=picture.features)
            image = np.asarray(found.radiance, np.float64)
            assert np.isfinite(image).all(), f"{kind}, {variant} at {n}: NaN or infinite"
            mean = np.asarray(found.mean, np.float64)
            squared, of_mean = (image - truth) ** 2, (mean - truth) ** 2
            inside = (found.low <= truth) & (truth <= found.high)
            kept = np.isclose(image, truth, rtol=1e-6, atol=0)
            ones = np.ones(truth.shape)
            maps = np.array(
                [ones, inside, kept, squared, of_mean, squared * weight, of_mean * weight]
            )
            lights, of_channels = (
                np.array([image, mean, truth]),
                covariance(picture, drawn[..., :n]),
            )
            stop[n].append(found.relative_error)
            for name, mask in groups(picture):
                m = mask.astype(float)
                of_sum = np.sqrt(np.einsum("yxc,yxcd,yxd->", m, of_channels, m, optimize=True) / n)
                of_group = sums.setdefault((n, name), Sums())
                of_group.add(mask, maps, lights, of_sum)
                of_noise = [k for k in NOISES if picture.groups.get(k, ~mask)[mask].all()]
                of_group.noises.add(of_noise[0] if of_noise else "")
    for (n, name), found in sums.items():
        error = np.mean(stop[n]) if name == "image" else np.nan
        yield found.row((kind, variant, n, name), error)


def table(
    images: Callable[[int], Iterable[Picture]], seeds: int, write: str | None = None
) -> list[Row]:
    """Return the figures of all images of some kinds, print them, and write them to a file."""
    found: list[Row] = []
    for same in zip(*map(images, range(seeds)), strict=True):
        if not any(name in same[0].kind for name in NAMES):
            continue
        new = list(rows(same, same[0].numbers or NUMBERS))
        show(new)
        if write:
            with Path(write).open("a" if found else "w", newline="") as file:
                writer = csv.DictWriter(file, [f.name for f in fields(Row)])
                if not found:
                    writer.writeheader()
                for row in new:
                    of = asdict(row) | {"apart": " ".join(map(str, row.apart))}
                    writer.writerow(
                        {k: f"{v:.5g}" if isinstance(v, float) else v for k, v in of.items()}
                    )
        found += new
    return found


def read(path: str) -> list[Row]:
    """Return the figures in a file."""
    with Path(path).open(newline="") as file:
        texts = list(csv.DictReader(file))
    plain = {"kind": str, "variant": str, "group": str, "noise": str, "n": int, "size": int}
    plain["apart"] = lambda text: [float(z) for z in text.split()]
    return [Row(**{k: plain.get(k, float)(v) for k, v in text.items()}) for text in texts]


def show(new: list[Row]) -> None:
    """Print MSE, relMSE and coverage of an image by number of samples; of exact pixels, how many
    are kept, and coverage."""
    of = {row.key[2:]: row for row in new}
    numbers = sorted({row.n for row in new})
    print(f"\n{new[0].kind}: {new[0].variant}; at {', '.join(map(str, numbers))}")
    for group in ("image", *NOISES):
        if any((n, group) not in of for n in numbers):
            continue
        cells = [of[n, group] for n in numbers]
        shown = "  ".join(
            f"{r.kept:6.2f}      {r.held:5.2f}"
            if group == "exact"
            else f"{r.mse:6.2f} {r.relmse:5.2f} {r.held:4.2f}"
            for r in cells
        )
        print(f"  {group:6s}  {shown}", flush=True)


# --- what is held ---


@dataclass(frozen=True)
class Line:
    """What should be held, in how much of all, and where it is missed by how much."""

    what: str
    most: float
    missed: list[tuple[float, str]]
    of: int
    about: str = ""

    @property
    def held(self) -> bool:
        return len(self.missed) <= self.most * self.of

    def __str__(self) -> str:
        worst = sorted(self.missed, reverse=True)[:4]
        share = len(self.missed) / max(self.of, 1)
        verdict = "none  " if not self.of else "held  " if self.held else "MISSED"
        return (
            f"{verdict} {self.what}: not in {len(self.missed)} of "
            f"{self.of} ({share:.1%}, limit {self.most:.1%}){self.about}"
            + "".join(f"\n         {value:9.3g}  {name}" for value, name in worst)
        )


def line(
    what: str, most: float, values: Iterable[tuple[float, Row]], limit: float, about: str = ""
) -> Line:
    """Return a line of values, of which those are missed that are above a limit, or NaN."""
    of = [(value, row.name) for value, row in values]
    return Line(what, most, [pair for pair in of if not pair[0] <= limit], len(of), about)


def geometric(values: Iterable[float]) -> float:
    kept = np.array([v for v in values if np.isfinite(v) and v > 0])
    return float(np.exp(np.log(kept).mean())) if kept.size else np.nan


def outside(value: float, bounds: tuple[float, float]) -> float:
    return max(bounds[0] - value, value - bounds[1])


def below(values: Sequence[float], limit: float) -> float:
    return float(np.mean(np.less(values, limit))) if values else np.nan


def surely(value: float, error: float) -> float:
    return value - 2 * np.nan_to_num(error)


def is_quiet(row: Row) -> bool:
    return row.noise == "quiet" and not row.group.startswith("block")


def summary(found: Sequence[Row], baseline: Sequence[Row] = ()) -> list[Line]:
    """Return what should be held of a table, also compared with that of another version."""
    of: dict[str, list[Row]] = {name: [] for name in (*NOISES, *CHANNELS, *THIRDS)}
    for row in found:
        of.setdefault(row.group, []).append(row)
    image, exact = of["image"], of["exact"]
    parts = [r for r in found if r.group not in ("image", "exact", *CHANNELS, *THIRDS)]
    quiet = [r for r in found if is_quiet(r) and 8 <= r.n <= 1024 and not np.isnan(r.mse)]
    judged = [r for name in JUDGED for r in of[name] if r.is_large]
    stops = [r for r in image if 16 <= r.n <= 512]
    held = [r.held for r in judged]
    stop = [r.relative_error for r in stops]
    lines = [
        line(
            "quiet groups: MSE at most 1.1 of the mean's",
            0,
            [(surely(r.mse, r.mse_error), r) for r in quiet],
            1.1,
            f"; geometric mean {geometric(r.mse for r in quiet):.3f}",
        ),
        line("exact pixels are kept", 0, [(1 - r.kept, r) for r in exact], 0),
        line("exact pixels are in their intervals", 0, [(1 - r.held, r) for r in exact], 0),
        line(
            "images: MSE and relMSE at most 1.05 of the mean's",
            0.05,
            [(max(surely(r.mse, r.mse_error), surely(r.relmse, r.relmse_error)), r) for r in image],
            1.05,
            f"; geometric means {geometric(r.mse for r in image):.3f}, "
            f"{geometric(r.relmse for r in image):.3f}",
        ),
        line(
            "sums of images: at most two standard errors from the mean's",
            0.1,
            [(abs(z), r) for r in image for z in r.apart],
            2,
        ),
        line(
            "sums of classes and blocks: at most three standard errors from the mean's",
            0.003,
            [(abs(z), r) for r in parts for z in r.apart],
            3,
        ),
        line(
            "intervals: .85 to .97 in loud and quiet, channels, thirds of brightness",
            0.1,
            [(outside(r.held, IN_INTERVALS), r) for r in judged],
            0,
            f"; below in {below(held, IN_INTERVALS[0]):.1%}",
        ),
        line(
            "relative_error: .8 to 1.25 of the true one",
            0.1,
            [(abs(np.log(r.relative_error)), r) for r in stops],
            np.log(OF_ERROR[1]),
            f"; below in {below(stop, OF_ERROR[0]):.1%}, geometric mean {geometric(stop):.2f}",
        ),
    ]
    if baseline:
        before = {row.key: row for row in baseline}
        both = [(r, before[r.key]) for r in found if r.key in before]
        both = [(r, b) for r, b in both if len(r.apart) == len(b.apart)]  # of the same samples
        assert both, "the baseline has no row of as many seeds"
        loud = [(r, b) for r, b in both if r.noise == "loud" and r.error > 0]
        images = [(r, b) for r, b in both if r.group == "image"]
        lines.append(
            line(
                "loud groups: MSE at most 1.1 of the baseline's",
                0,
                [(r.error / b.error, r) for r, b in loud],
                1.1,
                f"; geometric mean {geometric(r.error / b.error for r, b in loud):.3f}",
            )
        )
        for what in ("mse", "relmse"):
            now, then = (
                geometric(getattr(r, what) for r in of) for of in zip(*images, strict=True)
            )
            worse = [(now, "geometric mean")] if now > 1.0001 * then else []  # digits of a file
            about = f"; {now:.3f} after {then:.3f}"
            lines.append(
                Line(f"geometric mean of {what} not above the baseline's", 0, worse, 1, about)
            )
    return lines


def by_kind(found: Sequence[Row]) -> str:
    """Return a table of kinds: errors of images, of quiet groups, and coverage."""
    text = f"{'':34s}image MSE relMSE worst  quiet MSE worst  held < .85  exact kept"
    for kind in dict.fromkeys(row.kind for row in found):
        of = [row for row in found if row.kind == kind]
        image = [r for r in of if r.group == "image"]
        quiet = [r.mse for r in of if is_quiet(r)]
        exact = [r.kept for r in of if r.group == "exact"]
        held = [r.held for r in of if r.group in JUDGED and r.is_large]
        worst = max(max(r.mse, r.relmse) for r in image)
        text += (
            f"\n{kind:34s}{geometric(r.mse for r in image):9.2f} "
            f"{geometric(r.relmse for r in image):6.2f} {worst:5.1f}  "
            f"{geometric(quiet):9.2f} {max(quiet, default=np.nan):5.0f}  "
            f"{below(held, IN_INTERVALS[0]):10.0%}  {np.mean(exact) if exact else np.nan:10.2f}"
        )
    return text


def test_what_made_images_hold(as_benchmark):
    found = table(pictures, SEEDS, os.environ.get("CHDSTAT_WRITE"))
    assert found, "no kind has one of these names"
    baseline = os.environ.get("CHDSTAT_BASELINE")
    lines = summary(found, read(baseline) if baseline else ())
    print("", by_kind(found), "", *lines, sep="\n", flush=True)
    assert all(of.held for of in lines), "see the lines marked MISSED"
