"""Attribution: which paths, or lights, make the mean, the variance, a mode or the tail of a CHD.

With ``by_depth``, the same paths are also kept cut after 2, 3, ... segments. The differences are
the light of each sample by the length of its path. With ``by_light``, samples are kept for some
lights alone; the light of all others is the remainder.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import first_of, is_bad, label_variables, luminance
from chdstat._core.resampling import Blocks, Interval, mean_of
from chdstat.errors import InputError, Reason, check_option
from chdstat.samples import ImageLike, Mapped, Samples, samples_of
from chdstat.samples.assembly import over_tiles
from chdstat.samples.tiles import DIRECT_DEPTH, LightPart, tiles

if TYPE_CHECKING:
    import xarray as xr

_BRIGHTEST = 0.01
_ROUNDING = 1e-5
_ASKED = {
    "depth": ("the length of their paths", "by_depth=5 (--by-depth 5)"),
    "light": ("light", "by_light=['NAME'] (--light NAME)"),
}
_SAID = {
    "mean_share": "share of the mean",
    "variance_share": "share of the variance",
    "brightest_share": "share of the light of the brightest hundredth of the samples",
    "reason": "why there are no shares",
}
By = Literal["depth", "light"]


def attribute(
    samples: ImageLike | npt.ArrayLike, *, by: By = "depth", progress: bool = True
) -> xr.Dataset:
    """Return the shares of path lengths, or of lights, in each pixel's luminance and variance.

    The share of a part in the variance is its covariance with all light, over the variance. Shares
    add up to 1. A share is negative if that light is bright where the rest is dark. With a heavy
    tail, shares of the variance and of the brightest samples rest on few samples.

    Parameters
    ----------
    samples
        Samples rendered with ``by_depth=``, with ``direct=True`` for two lengths, or with
        ``by_light=``.
    by
        "depth" for path lengths, "light" for lights.
    progress
        Show progress: a bar in a terminal or notebook, elsewhere a line every ten seconds.

    Returns
    -------
    xarray.Dataset
        ``mean_share``, ``variance_share`` and ``brightest_share`` with dims (y, x, segments) or (y,
        x, light). The last is the share of the light in the brightest hundredth of the samples.
        They are NaN where ``reason`` (y, x) says why. ``segments`` is the longest path of each
        group, infinite for the rest, and ``paths`` says it in words. ``light`` are the names that
        were asked for, and "other lights".

    Raises
    ------
    InputError
        If the samples were not rendered so, or have neither 1 nor 3 channels.

    References
    ----------
    Shares of a variance by covariance: Shorrocks, "Inequality decomposition by factor components",
    Econometrica 50(1), 1982, doi:10.2307/1912537.

    Examples
    --------
    >>> import chdstat as chd
    >>> scene = {"scene": "cornell-box", "spp": 16, "size": (8, 8), "backend": "scalar"}
    >>> found = attribute(chd.render(**scene, by_depth=3))
    >>> found["paths"].to_numpy().tolist()
    ['emitted and direct', '3 segments', 'more than 3 segments']
    >>> round(float(found["variance_share"].sum("segments").max()), 5)
    1.0
    """
    check_option("by", by, _ASKED)
    image = samples_of(samples)
    known = image.depths if by == "depth" else image.lights
    if not known:
        kind, advice = _ASKED[by]
        message = f"these samples are not divided by {kind}; render them with {advice}"
        raise InputError(message)
    spp = min(part.spp for part in known.values())
    dim = "segments" if by == "depth" else "light"

    def of_tile(tile: Samples, _: object) -> Mapped:
        of_parts = tile.depths if by == "depth" else tile.lights
        read = [part.read(ss=slice(spp)) for part in (*of_parts.values(), tile)]
        light = by_part(read, by=by)
        total = light.sum(axis=0)
        good = np.isfinite(total)
        highest = np.where(good, total, -np.inf).max(axis=-1)
        lowest = np.where(good, total, np.inf).min(axis=-1)
        reason = first_of(
            {
                Reason.ALL_BAD: ~good.any(axis=-1),
                Reason.ALL_NULL: highest <= 0,
                Reason.CONSTANT: highest <= lowest,
            }
        )
        usable = (reason == Reason.OK)[..., np.newaxis]
        found: Mapped = {
            name: ((dim,), np.where(usable, share, np.nan).astype(np.float32))
            for name, share in zip(_SAID, shares(light), strict=False)
        }
        return {**found, "reason": ((), reason)}

    found = over_tiles(
        image, of_tile, tiles(image.shape), description="attributing light", progress=progress
    )
    found = label_variables(found, _SAID)
    names = np.array(part_names(list(known)), dtype=object)
    if by == "light":
        return found.assign_coords(light=("light", names, {"long_name": "lights"}))
    longest = [*map(float, known), np.inf]
    return found.assign_coords(
        segments=("segments", longest, {"long_name": "longest path"}), paths=("segments", names)
    )


class _LargestPart(NamedTuple):
    """The part of the light that makes most of the variance, over the pixels where that is known.

    ``share`` is its share of the variance with an interval, ``lead`` how much that is above the
    share of any other part, ``mean`` its share of the light, and ``place`` its place among the
    parts, -1 for the last.
    """

    name: str
    place: int
    share: Interval[float]
    lead: Interval[float]
    mean: float


def largest_part(samples: Samples, blocks: Blocks, *, by: By) -> _LargestPart | None:
    """Return the path lengths, or the light, that make most of the variance; None if unknown."""
    light = attribute(samples, by=by, progress=False)
    held, mean = (light[f"{of}_share"].to_numpy() for of in ("variance", "mean"))
    held, mean = (shares.reshape(-1, shares.shape[-1]) for shares in (held, mean))
    known = np.isfinite(held[:, 0])
    if not known.any():
        return None
    held = held.astype(np.float64)
    *_, second, most = held[known].mean(axis=0).argsort().tolist()
    share, lead = (
        mean_of(shares[known], blocks[known])
        for shares in (held[:, most], held[:, most] - held[:, second])
    )
    name = str(light["paths" if by == "depth" else "light"].to_numpy()[most])
    place = -1 if most == held.shape[1] - 1 else most
    return _LargestPart(name, place, share, lead, float(mean[known, most].mean()))


def part_names(parts: Sequence[LightPart]) -> list[str]:
    """Return the names of the light of each part, and of the rest.

    Examples
    --------
    >>> part_names([2, 3])
    ['emitted and direct', '3 segments', 'more than 3 segments']
    >>> part_names(["lamp-*", "sun"])
    ['lamp-*', 'sun', 'other lights']
    """
    names = [
        part
        if isinstance(part, str)
        else ("emitted and direct" if part == DIRECT_DEPTH else f"{part} segments")
        for part in parts
    ]
    last = parts[-1]
    return [*names, "other lights" if isinstance(last, str) else f"more than {last} segments"]


def shares(light: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], ...]:
    """Return the shares of each part of the light in mean, variance and brightest samples.

    Parameters
    ----------
    light
        Luminance of each sample by part, shape (part, ..., sample); bad samples are NaN in all
        parts.

    Returns
    -------
    mean, variance, brightest : ndarray
        Shares, shape (..., part), which add up to 1; not finite where there is nothing to share.

    Examples
    --------
    >>> light = np.array([[1.0, 1.0, 1.0, 1.0], [0.0, 2.0, 0.0, 2.0]])
    >>> [found.tolist() for found in shares(light)]
    [[0.5, 0.5], [0.0, 1.0], [0.3333333333333333, 0.6666666666666666]]
    """
    total = light.sum(axis=0)
    good = np.isfinite(total)
    known, count = np.where(good, light, 0), good.sum(axis=-1)
    with np.errstate(all="ignore"):
        mean = known.sum(axis=-1)
        sums = mean.sum(axis=0)
        centred = np.where(good, total - (sums / count)[..., np.newaxis], 0)
        variance = (known * centred).sum(axis=-1)
        most = max(1, round(_BRIGHTEST * light.shape[-1]))
        last = np.argpartition(np.where(good, total, -np.inf), -most, axis=-1)[..., -most:]
        brightest = np.take_along_axis(known, last[np.newaxis], axis=-1).sum(axis=-1)
        found = mean / sums, variance / variance.sum(axis=0), brightest / brightest.sum(axis=0)
    return tuple(np.moveaxis(part, 0, -1) for part in found)


def groups_of(
    total: npt.NDArray[np.float64],
    null: npt.NDArray[np.bool_],
    places: Sequence[float],
    threshold: float,
) -> Mapping[str, npt.NDArray[np.bool_]]:
    """Return the samples of a pixel that make its modes and its tail, as masks by name.

    Parameters
    ----------
    total
        Luminance of the samples, shape (sample,).
    null
        Which samples are null, shape (sample,).
    places
        Places of the modes, log10 of luminance, the darkest first. A sample belongs to the nearest
        mode.
    threshold
        Luminance where the tail begins; NaN without a tail.

    Examples
    --------
    >>> total = np.array([0.0, 0.1, 0.1, 10.0, 90.0])
    >>> {n: m.sum().item() for n, m in groups_of(total, total == 0, [-1.0, 1.0], 50.0).items()}
    {'mode 1': 2, 'mode 2': 2, 'tail': 1}
    """
    positive = (total > 0) & ~null
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.abs(np.log10(total) - np.reshape(places, (-1, 1)))
    nearest = np.where(np.isnan(distance), np.inf, distance).argmin(axis=0) if len(places) else 0
    groups = {f"mode {i + 1}": positive & (nearest == i) for i in range(len(places))}
    return {**groups, "tail": positive & (total > threshold)} if threshold > 0 else groups


def by_part(
    parts: Sequence[npt.NDArray[np.floating[Any]]], *, by: By = "depth"
) -> npt.NDArray[np.float64]:
    """Return the luminance of each part, and of the rest, shape (part, ..., sample).

    `parts` are samples (..., channel, sample), ending with those of all light. Parts of rising
    depth each include the ones before. A bad sample is NaN in all parts.
    """
    bad = np.any([is_bad(part).any(axis=-2) for part in parts], axis=0)
    found = np.stack([luminance(part.astype(np.float64)) for part in parts])
    if by == "depth":
        found = np.diff(found, axis=0, prepend=0)
    else:
        rest = found[-1] - found[:-1].sum(axis=0)
        # A remainder within rounding is none: if all lights are named, nothing remains.
        found[-1] = np.where(np.abs(rest) > _ROUNDING * np.abs(found[-1]), rest, 0)
    return np.where(bad, np.nan, found)
