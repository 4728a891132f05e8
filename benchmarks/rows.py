"""What a scene tells of the default estimate: rows at a number of samples, and curves over them.

No figure contains the noise of the reference.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

import chdstat as chd
from benchmarks.groups import SURE, Noise, errors_of_sums, holds, means, ratios, sums
from benchmarks.rendered import REFERENCE_SPP
from chdstat.comparison import Interval, Judge
from chdstat.estimators import Combination
from chdstat.io import denoise
from chdstat.studies.claims import SceneData

BY_NOISE = ("noise", "relative noise")
"""Groupings by noise: the first for squared errors, the second for relative ones."""

Images = Sequence[np.ndarray]


@dataclass(frozen=True)
class Row:
    """Estimates of a scene from n samples of several seeds.

    Attributes
    ----------
    name, n
        The scene, and the number of samples.
    over
        MSE and relMSE of the estimate over those of the better denoiser ("denoiser") and the mean's
        ("mean"), and of the better denoiser from the estimate over the former ("from it").
    by_noise
        Errors over the mean's, their standard errors and z, as of `ratios`, by grouping.
    held
        Share of 90 % intervals that hold the truth in each group, by grouping.
    bias, bias_error
        Of the sum of the image, and the standard error that the estimate says; relative.
    from_mean
        Sum of the image minus the mean's, in standard errors of the mean's.
    energy, energy_of_mean
        Sums of each group minus the reference's, in standard errors of both, by grouping; and the
        same of the mean, which has no bias: what is beyond 3 there is chance.
    exact, moved, outside
        Values that all renders know exactly, those of them that are moved, and those outside of
        their intervals.
    """

    name: str
    n: int
    over: Mapping[str, list[Interval[float]]]
    by_noise: Mapping[str, np.ndarray]
    held: Mapping[str, np.ndarray]
    bias: float
    bias_error: float
    from_mean: float
    energy: Mapping[str, np.ndarray]
    energy_of_mean: Mapping[str, np.ndarray]
    exact: int
    moved: int
    outside: int

    @classmethod
    def of(
        cls,
        samples: Sequence[chd.Samples],
        found: Sequence[Combination],
        reference: Judge,
        noise: Noise,
        groupings: Mapping[str, np.ndarray],
    ) -> Row:
        n = found[0].spp
        made = [_images_of(x, f) for x, f in zip(samples, found, strict=True)]
        errors = {k: np.stack([errors_of(m[k], reference) for m in made]) for k in made[0]}
        images, of_mean = ([getattr(f, k) for f in found] for k in ("radiance", "mean"))
        inside = np.stack([holds(f, reference) for f in found])
        apart = np.subtract(images, of_mean).sum(dtype=np.float64) / len(found)
        return cls(
            samples[0].name,
            n,
            _over(samples[0], errors),
            {
                name: ratios(groupings[name], errors["estimate"][:, i], errors["mean"][:, i])
                for i, name in enumerate(BY_NOISE)
            },
            {name: means(group, inside) for name, group in groupings.items()},
            float(np.mean(images) / reference.mean.mean() - 1),
            float(np.mean([f.bias_error for f in found])),
            float(apart / noise.error_of_sum(groupings["image"], n)[0]),
            *(_energy(x, reference, noise, groupings, n) for x in (images, of_mean)),
            *_of_exact(found, noise.exact()),
        )

    def text(self, name: str) -> str:
        """Return the row and those by groups, as text."""
        started = " ".join(f"{r.value:.2f}" for r in self.over["from it"])
        thirds = " ".join(f"{x:.2f}" for x in self.held["third"])
        lines = [
            f"{name:24s}{self.n:4d}  {_shown(self.over['denoiser'])}  {started}  "
            f"{_shown(self.over['mean'])}  {self.bias:+6.1%} ± {self.bias_error:4.1%}  {thirds}  "
            f"energy {self.from_mean:+.1f} of the mean's, {self.energy['image'][0]:+.1f}; "
            f"{self.exact} exact, {self.moved} moved, {self.outside} outside"
        ]
        for grouping, (ratio, error, z) in self.by_noise.items():
            star = np.where(z > SURE, "*", " ")
            cells = zip(ratio, error, star, strict=True)
            groups = zip(self.held[grouping], self.energy[grouping], strict=True)
            lines += [
                f"  {grouping:16s}" + "".join(f"{r:7.3g} ±{e:5.2g}{s}" for r, e, s in cells),
                "  in 90 %, energy " + "".join(f"{h:7.2f} {z:+6.1f} " for h, z in groups),
            ]
        blocks = " ".join(f"{z:+.1f}" for z in self.energy["block"])
        return "\n".join([*lines, f"  blocks, energy    {blocks}"])


@dataclass(frozen=True)
class Curve:
    """Errors of a scene at several numbers of samples.

    Attributes
    ----------
    numbers
        Numbers of samples, shape (number,).
    true
        True relative errors, same shape.
    said
        `relative_error` of each seed, shape (number, seed).
    forecast
        Samples for half of that error, as `spp_for` says, same shape; NaN if it does not exist.
    """

    numbers: np.ndarray
    true: np.ndarray
    said: np.ndarray
    forecast: np.ndarray

    @classmethod
    def of(cls, found: Mapping[int, Sequence[Combination]], reference: Judge) -> Curve:
        relative = [[reference.relative(f.radiance)[0].mean() for f in of] for of in found.values()]
        true = np.sqrt(np.maximum(np.mean(relative, axis=1), 0))
        said, forecast = (
            np.array([[one(f) for f in of] for of in found.values()], dtype=float)
            for one in (lambda f: f.relative_error, _for_half)
        )
        return cls(np.array(list(found)), true, said, forecast)

    @cached_property
    def over_true(self) -> np.ndarray:
        """Estimated errors over the true ones, shape (number,)."""
        return np.median(self.said, axis=1) / np.where(self.true > 0, self.true, np.nan)

    @cached_property
    def half(self) -> np.ndarray:
        """Samples at which the true error is half, shape (number,); NaN outside of the curve."""
        fallen = -np.log(np.minimum.accumulate(np.maximum(self.true, 1e-30)))
        number = np.interp(
            fallen + np.log(2), fallen, np.log(self.numbers), left=np.nan, right=np.nan
        )
        return np.exp(number)

    @property
    def forecast_over_true(self) -> np.ndarray:
        """Forecasts over the true number, shape (number,), NaN where that is not known."""
        return np.median(self.forecast, axis=1) / self.half

    def text(self, name: str) -> str:
        true = " ".join(f"{x:.3f}" for x in self.true)
        said = " ".join(f"{x:5.2f}" for x in self.over_true)
        pairs = zip(self.numbers, np.median(self.forecast, axis=1), self.half, strict=True)
        half = "  ".join(f"{n}: {f:.0f} {h:.0f}" for n, f, h in pairs if np.isfinite(h))
        return f"{name:24s}{true}  {said}  half from {half or '(outside of the curve)'}"


def _for_half(found: Combination) -> float:
    return found.spp_for(found.relative_error / 2) if hasattr(found, "spp_for") else np.nan


def _shown(values: Sequence[Interval[float]]) -> str:
    return " ".join(f"{r.value:.2f} [{r.low:.2f}, {r.high:.2f}]" for r in values)


def _images_of(samples: chd.Samples, found: Combination) -> dict[str, np.ndarray]:
    """Return the estimate, the mean and both denoised, with and without features."""
    guides = {name: samples.features[name] for name in ("albedo", "normal")}
    images = {"estimate": found.radiance, "mean": found.mean}
    for name, features in {"": {}, " with features": guides}.items():
        images[f"denoised{name}"] = denoise(found.mean, **features)
        images[f"from it{name}"] = found.guarded(denoise(found.radiance, **features))
    return images


def errors_of(image: np.ndarray, reference: Judge) -> np.ndarray:
    """Return the squared and the relative squared errors, shape (2, y, x, channel)."""
    return np.stack([reference.squared(image), reference.relative(image)[0]])


def _over(samples: chd.Samples, errors: Mapping[str, np.ndarray]) -> dict[str, list]:
    """Return ratios of errors over the image, from errors (seed, 2, y, x, channel)."""
    e = {k: v.mean(axis=(0, -1)).reshape(2, -1).T for k, v in errors.items()}
    whole = SceneData(samples.name, samples).whole(across=4)

    def better(kind: str) -> np.ndarray:
        """Return the errors of the image whose product of both is the least."""
        return min((e[kind], e[f"{kind} with features"]), key=lambda x: np.prod(x.mean(axis=0)))

    pairs = {
        "denoiser": (e["estimate"], better("denoised")),
        "from it": (better("from it"), better("denoised")),
        "mean": (e["estimate"], e["mean"]),
    }
    return {
        name: [whole.ratio(a, b) for a, b in zip(one.T, other.T, strict=True)]
        for name, (one, other) in pairs.items()
    }


def _energy(
    images: Images, reference: Judge, noise: Noise, groupings: Mapping[str, np.ndarray], n: int
) -> dict[str, np.ndarray]:
    apart, found = np.stack(images) - reference.mean, {}
    for name in ("image", "block", *BY_NOISE):
        group = groupings[name]
        of_reference = errors_of_sums(group[0], reference.error)
        # Renders chose the groups by noise, and the reference may have missed rare light: the
        # larger of both standard errors.
        of_mean = np.maximum(
            noise.error_of_sum(group, n), of_reference * np.sqrt(REFERENCE_SPP / n)
        )
        error = np.maximum(np.hypot(of_mean, of_reference), 1e-30)
        found[name] = sums(group, apart) / len(apart) / error
    return found


def _of_exact(found: Sequence[Combination], exact: np.ndarray) -> tuple[int, int, int]:
    image, mean, low, high = (
        np.stack([getattr(f, name) for f in found])[exact]
        for name in ("radiance", "mean", "low", "high")
    )
    rounding = 1e-5 * abs(mean)
    outside = (mean < low - rounding) | (mean > high + rounding)
    return len(mean), int((abs(image - mean) > rounding).sum()), int(outside.sum())
