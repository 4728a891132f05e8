"""Path guiding: directions are drawn where earlier paths have found light.

`trained` traces paths that are thrown away, and learns a `Guide` from them: for each cell of space,
a distribution of directions, and the share of directions that its materials should draw instead.
`into_scene` puts a guide into the materials of a scene, so that all of Mitsuba's integrators draw
by it: half, or another share, of the directions come from the guide, the rest from the BSDF, and
each is weighted by the density of both together (Veach and Guibas 1995, the balance heuristic in
one sample). A guide that is wrong makes noise, never a bias. It is frozen before the first sample
is drawn, so that samples are independent. Media are not guided: they draw from their phase
functions.

Müller, Gross and Novák, "Practical path guiding for efficient light-transport simulation", 2017,
doi:10.1111/cgf.13227; Müller, "Practical path guiding in production", 2019,
doi:10.1145/3305366.3328091 (section 10). Two things differ. The guide learns the light that a path
carries on, cosine and BSDF included, as Rath et al. 2020, "Variance-aware path guiding",
doi:10.1145/3386569.3392441, suggest; and the share of the BSDF is not descended to by gradients,
but chosen for each cell from `SHARES` by paths that the guide has not seen.

Trees are sorted lists. A k-d tree that halves x, y and z in turn, and a quadtree, number their
places by Morton codes; their leaves are intervals of these, and a lookup is a binary search for the
last leaf that begins at or before a code.
"""

from __future__ import annotations

import functools
import hashlib
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, NamedTuple

import drjit
import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Floats, Image
from chdstat.rendering.rays import sensed
from chdstat.samples.layout import GUIDE

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = [
    "PASSES",
    "SHARES",
    "Guide",
    "Lookup",
    "Paths",
    "into_scene",
    "learn",
    "trained",
    "uniform",
]

dr: Any = drjit
Codes = npt.NDArray[np.uint64]

SHARES = (0.75, 0.5, 0.25)
"""Shares of directions that may come from the BSDF: never all, or rare light is not found."""
_AXIS = 8
"""Bits of a position along each axis: the smallest cells are 1/256 of the scene."""
_SQUARE = 10
"""Bits of each of the two coordinates of a direction."""
_PLACES, _DIRECTIONS = 2 ** (3 * _AXIS), 2 ** (2 * _SQUARE)
_SPHERE = 4 * np.pi
_LARGEST_LEAF, _KNOWN = 0.01, 64
"""A square that holds more than this of the light of a cell is divided (Müller et al. 2017), if
more than so many paths are known to go there: of fewer, chance would be learned."""
_EVERYWHERE = 0.1
"""Share of a guide that is uniform, so that no direction is left out."""
_PER_CELL = 1000
"""Vertices from which a cell is halved in the first pass; times the root of the growth later."""
PASSES = 4
"""Passes of a training."""
_ROOM = 15, 12
"""Steps of searches while a guide is trained: one kernel serves all passes."""
_PATHS = 16
"""Paths of all passes for each pixel."""
_FEWEST, _MOST = 2**17, 2**20
"""Least and largest number of paths of a training."""
_VERTICES = 5
"""Vertices of a path that are learned from."""
_LEAST = 1e-12
"""Densities that are 0 by rounding are taken for this."""
_LONGEST, _ROULETTE = 64, 4
"""Vertices of the longest path of a training, and how many are free of Russian roulette."""


@dataclass(frozen=True, eq=False)
class Guide:
    """Distributions of directions in cells of space.

    Attributes
    ----------
    box
        Lowest and highest corner of the space that is divided, shape (2, 3).
    cells
        Morton code at which each cell begins, ascending, shape (cell,).
    shares
        Share of directions that come from the BSDF, shape (cell,).
    first
        Number of the first leaf of each cell, and of all leaves, shape (cell + 1,).
    leaves
        Morton code at which each leaf begins, within its cell ascending from 0, shape (leaf,).
    below
        Probability of all leaves of the cell before each leaf, shape (leaf,).
    """

    box: Image
    cells: npt.NDArray[np.uint32]
    shares: Image
    first: npt.NDArray[np.uint32]
    leaves: npt.NDArray[np.uint32]
    below: Image

    @property
    def digest(self) -> str:
        """What tells it from another guide."""
        content = hashlib.sha256()
        for field in fields(self):
            content.update(np.ascontiguousarray(getattr(self, field.name)).tobytes())
        return content.hexdigest()[:16]

    @property
    def arrays(self) -> dict[str, Image]:
        """All that it is, in arrays of two dimensions that are kept beside samples, by name.

        Codes and numbers of leaves are below 2^24, so that they are exact in single precision.
        """
        cells = np.stack([self.cells, self.shares, self.first[:-1]], axis=1).astype(np.float32)
        leaves = np.stack([self.leaves, self.below], axis=1).astype(np.float32)
        return dict(zip(GUIDE, (np.concatenate([self.box, cells]), leaves), strict=True))

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, Image]) -> Guide:
        """Return the guide of some `arrays`."""
        cells, leaves = (arrays[name] for name in GUIDE)
        code, share, first = cells[2:].T
        return cls(
            box=cells[:2],
            cells=code.astype(np.uint32),
            shares=np.ascontiguousarray(share),
            first=np.append(first, len(leaves)).astype(np.uint32),
            leaves=leaves[:, 0].astype(np.uint32),
            below=np.ascontiguousarray(leaves[:, 1]),
        )

    def cells_at(self, positions: npt.ArrayLike) -> npt.NDArray[np.intp]:
        """Return the numbers of the cells that hold some positions (n, 3)."""
        codes = _place_codes(positions, self.box)
        return np.asarray(np.searchsorted(self.cells, codes, side="right") - 1)

    def density(self, cells: npt.NDArray[np.intp], directions: npt.ArrayLike) -> Floats:
        """Return the density per solid angle of unit vectors (n, 3), each in a cell."""
        keys = _keys(np.repeat(np.arange(len(self.cells)), np.diff(self.first)), self.leaves)
        wanted = _keys(cells, _direction_codes(directions))
        leaf = np.searchsorted(keys, wanted, side="right") - 1
        is_last = leaf + 1 == self.first[cells + 1]
        after = np.minimum(leaf + 1, len(self.leaves) - 1)
        probability = np.where(is_last, 1.0, self.below[after]) - self.below[leaf]
        size = np.where(is_last, _DIRECTIONS, self.leaves[after].astype(float)) - self.leaves[leaf]
        return np.asarray(probability * _DIRECTIONS / size / _SPHERE)


class Paths(NamedTuple):
    """Vertices of paths, all with the same first axis.

    Attributes
    ----------
    positions, directions
        Where the vertices are, and unit vectors to where the paths go on, shape (n, 3).
    light
        Radiance that they carry on, over the density of the directions, shape (n,).
    densities
        Density of the directions per solid angle, shape (n,).
    """

    positions: Floats
    directions: Floats
    light: Floats
    densities: Floats


def uniform(low: npt.ArrayLike, high: npt.ArrayLike) -> Guide:
    """Return the guide that knows nothing: one cell, where all directions come from the BSDF.

    Examples
    --------
    >>> guide = uniform((0, 0, 0), (1, 1, 1))
    >>> bool(guide.density(guide.cells_at([[0.5, 0.5, 0.5]]), [[0, 0, 1]]) == 1 / (4 * np.pi))
    True
    """
    zero, one = np.zeros(1, np.uint32), np.ones(1, np.float32)
    box = np.array([low, high], np.float32)
    return Guide(box, zero, one, np.array([0, 1], np.uint32), zero, np.zeros(1, np.float32))


def learn(guide: Guide, paths: Paths, *, per_cell: float) -> Guide:
    """Return a guide that has learned from paths, which another guide has drawn.

    Parameters
    ----------
    guide
        What has drawn the paths.
    paths
        Their vertices.
    per_cell
        A cell with more vertices is halved.
    """
    codes = _place_codes(paths.positions, guide.box)
    cells = _cells(np.sort(codes), per_cell)
    cell = np.searchsorted(cells, codes, side="right") - 1
    keys = _keys(cell, _direction_codes(paths.directions))
    order = np.argsort(keys, kind="stable")
    leaves, probability = _leaves(keys[order], paths.light[order], len(cells))
    holder = (leaves // _DIRECTIONS).astype(np.intp)
    first = np.searchsorted(holder, np.arange(len(cells) + 1))
    below = np.concatenate([[0.0], np.cumsum(probability)])[:-1]
    below -= below[first[:-1]][holder]
    return Guide(
        guide.box,
        cells.astype(np.uint32),
        _shares(guide, paths, cell, len(cells)),
        first.astype(np.uint32),
        (leaves % _DIRECTIONS).astype(np.uint32),
        np.minimum(below, 1).astype(np.float32),
    )


def _cells(codes: Codes, per_cell: float) -> Codes:
    """Return where cells begin that hold at most so many of the codes, which ascend."""
    begins, done = np.zeros(1, np.uint64), list[Codes]()
    for level in range(3 * _AXIS, 0, -1):
        ends = np.searchsorted(codes, begins + np.uint64(2**level))
        is_full = ends - np.searchsorted(codes, begins) > per_cell
        done.append(begins[~is_full])
        halves = np.array([0, 2 ** (level - 1)], np.uint64)
        begins = (begins[is_full, np.newaxis] + halves).ravel()
    return np.sort(np.concatenate([*done, begins]))


def _leaves(keys: Codes, light: Floats, cells: int) -> tuple[Codes, Floats]:
    """Return where the leaves of all cells begin, as keys, and their probabilities."""
    sums = np.concatenate([[0.0], np.cumsum(light)])

    def within(begins: Codes, size: int) -> tuple[npt.NDArray[np.intp], Floats]:
        """Return how many paths go to squares of a size, and the light that they carry."""
        first, end = (np.searchsorted(keys, begins + np.uint64(i)) for i in (0, size))
        return end - first, sums[end] - sums[first]

    begins = np.arange(cells, dtype=np.uint64) * np.uint64(_DIRECTIONS)
    _, total = within(begins, _DIRECTIONS)
    done = []
    for level in range(_SQUARE, -1, -1):
        size = 4**level
        count, held = within(begins, size)
        of_cell = total[(begins // np.uint64(_DIRECTIONS)).astype(np.intp)]
        share = np.full(held.shape, size / _DIRECTIONS)
        np.divide(held, of_cell, out=share, where=of_cell > 0)
        is_full = (count > _KNOWN) & (held > _LARGEST_LEAF * of_cell) & (level > 0)
        mixed = (1 - _EVERYWHERE) * share + _EVERYWHERE * size / _DIRECTIONS
        done.append((begins[~is_full], mixed[~is_full]))
        quarters = np.arange(4, dtype=np.uint64) * np.uint64(size // 4)
        begins = (begins[is_full, np.newaxis] + quarters).ravel()
    leaves, probability = (np.concatenate(parts) for parts in zip(*done, strict=True))
    order = np.argsort(leaves)
    return leaves[order], probability[order]


def _shares(guide: Guide, paths: Paths, cell: npt.NDArray[np.intp], cells: int) -> Image:
    """Return the share of the BSDF in each cell whose mixture is closest to where light went.

    That is the one of least cross-entropy (Müller 2019), which a rare bright path sways less than a
    second moment. It is judged for the old guide, which has not seen these paths. Where that one
    has learned nothing yet, both have half.
    """
    if len(guide.cells) == 1:
        return np.full(cells, 0.5, np.float32)
    drawn_in = guide.cells_at(paths.positions)
    guided, share = guide.density(drawn_in, paths.directions), guide.shares[drawn_in]
    alone = np.maximum((paths.densities - (1 - share) * guided) / share, 0)
    mixtures = (np.maximum(s * alone + (1 - s) * guided, _LEAST) for s in SHARES)
    found = [np.bincount(cell, paths.light * np.log(m), minlength=cells) for m in mixtures]
    best: Image = np.array(SHARES, np.float32)[np.argmax(found, axis=0)]
    return best


# --- Morton codes -------------------------------------------------------------------------------


def _place_codes(positions: npt.ArrayLike, box: Image) -> Any:
    scaled = (np.asarray(positions) - box[0]) / (box[1] - box[0]) * 2**_AXIS
    x, y, z = np.clip(scaled, 0, 2**_AXIS - 1).astype(np.uint64).T
    return _spread(x, 3) | _spread(y, 3) << 1 | _spread(z, 3) << 2


def _direction_codes(directions: npt.ArrayLike) -> Any:
    """Return codes of unit vectors in the equal-area projection of the sphere to a cylinder."""
    x, y, z = np.asarray(directions).T
    square = np.stack([(z + 1) / 2, np.arctan2(y, x) / (2 * np.pi) % 1]) * 2**_SQUARE
    u, v = np.clip(square, 0, 2**_SQUARE - 1).astype(np.uint64)
    return _spread(u, 2) | _spread(v, 2) << 1


def _keys(cells: npt.NDArray[Any], codes: npt.NDArray[Any]) -> Codes:
    return cells.astype(np.uint64) * np.uint64(_DIRECTIONS) + codes.astype(np.uint64)


_STEPS = {
    2: ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)),
    3: ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)),
}
"""Shifts and masks that put 1 or 2 zeros between the bits of a number below 2^10."""


def _spread(number: Any, apart: int) -> Any:
    """Return a number whose bits are so far apart; of NumPy or of Dr.Jit."""
    for shift, mask in _STEPS[apart]:
        number = (number | number << shift) & mask
    return number


def _joined(number: Any) -> Any:
    """Undo `_spread` by 2."""
    number = number & _STEPS[2][-1][1]
    for shift, mask in ((1, 0x33333333), (2, 0x0F0F0F0F), (4, 0x00FF00FF), (8, 0x0000FFFF)):
        number = (number | number >> shift) & mask
    return number


# --- in Dr.Jit ----------------------------------------------------------------------------------


class Lookup:
    """A guide in the arrays of the Mitsuba variant that is set, which materials look up."""

    def __init__(self, mi: Any, guide: Guide) -> None:
        self.mi = mi
        self.set(guide)

    def set(self, guide: Guide, steps: tuple[int, int] | None = None) -> None:
        """Look up another guide from now on.

        The numbers of steps of searches for a cell and a leaf are part of the kernel. None takes as
        few as this guide needs.
        """
        mi, longest = self.mi, int(np.diff(guide.first).max())
        counts = len(guide.cells), longest
        self.cell_steps, self.leaf_steps = steps or ((n - 1).bit_length() for n in counts)
        low, high = guide.box.astype(np.float64)
        self.low, self.scale = mi.Point3f(low), mi.Vector3f(2**_AXIS / (high - low))
        self.cells, self.shares = mi.UInt32(guide.cells), mi.Float(guide.shares)
        self.first, self.count = mi.UInt32(guide.first), mi.UInt32(len(guide.cells))
        self.leaves, self.below = mi.UInt32(guide.leaves), mi.Float(guide.below)
        dr.make_opaque(self.low, self.scale, self.cells, self.shares)
        dr.make_opaque(self.first, self.count, self.leaves, self.below)

    def cell(self, position: Any) -> tuple[Any, Any, Any]:
        """Return the share of the BSDF at a position, and the range of leaves there."""
        mi = self.mi
        scaled = dr.clip((position - self.low) * self.scale, 0, 2**_AXIS - 1)
        x, y, z = (_spread(mi.UInt32(c), 3) for c in (scaled.x, scaled.y, scaled.z))
        cell = self._last(self.cells, x | y << 1 | z << 2, 0, self.count, self.cell_steps)
        first, end = (dr.gather(mi.UInt32, self.first, cell + i) for i in (0, 1))
        return dr.gather(mi.Float, self.shares, cell), first, end

    def density(self, leaves: Sequence[Any], direction: Any) -> Any:
        """Return the density of a direction per solid angle."""
        mi, turn = self.mi, dr.atan2(direction.y, direction.x) / (2 * dr.pi)
        square = (0.5 * direction.z + 0.5, dr.select(turn < 0, turn + 1, turn))
        u, v = (mi.UInt32(dr.clip(c * 2**_SQUARE, 0, 2**_SQUARE - 1)) for c in square)
        first, end = leaves
        code = _spread(u, 2) | _spread(v, 2) << 1
        leaf = self._last(self.leaves, code, first, end - first, self.leaf_steps)
        _, probability, _, size = self._leaf(leaf, end)
        return probability * (_DIRECTIONS / _SPHERE) / size

    def sample(self, leaves: Sequence[Any], number: Any) -> Any:
        """Return a direction that is drawn by two random numbers."""
        mi, (first, end) = self.mi, leaves
        leaf = self._last(self.below, number.x, first, end - first, self.leaf_steps)
        below, probability, begin, size = self._leaf(leaf, end)
        inside = dr.clip((number.x - below) / probability, 0, dr.one_minus_epsilon(mi.Float))
        edge = dr.sqrt(size) / 2**_SQUARE
        z = 2 * (mi.Float(_joined(begin)) / 2**_SQUARE + inside * edge) - 1
        turn = mi.Float(_joined(begin >> 1)) / 2**_SQUARE + number.y * edge
        (sine, cosine), radius = dr.sincos(2 * dr.pi * turn), dr.safe_sqrt(1 - z * z)
        return mi.Vector3f(radius * cosine, radius * sine, z)

    def _leaf(self, leaf: Any, end: Any) -> tuple[Any, Any, Any, Any]:
        """Return the probability below a leaf, its own, where it begins, and its size."""
        mi, goes_on = self.mi, leaf + 1 != end
        below, begin = (
            dr.gather(mi.Float, self.below, leaf),
            dr.gather(mi.UInt32, self.leaves, leaf),
        )
        next_below = dr.gather(mi.Float, self.below, leaf + 1, goes_on)
        next_begin = dr.gather(mi.UInt32, self.leaves, leaf + 1, goes_on)
        probability = dr.select(goes_on, next_below, 1) - below
        return (
            below,
            probability,
            begin,
            mi.Float(dr.select(goes_on, next_begin, _DIRECTIONS) - begin),
        )

    def _last(self, values: Any, wanted: Any, first: Any, count: Any, steps: int) -> Any:
        """Return the last of `count` places from `first` on whose value is at most the wanted."""
        first, count = self.mi.UInt32(first), self.mi.UInt32(count)
        for _ in range(steps):
            half = count >> 1
            is_right = (half > 0) & (dr.gather(type(values), values, first + half) <= wanted)
            first = dr.select(is_right, first + half, first)
            count = dr.select(is_right, count - half, dr.maximum(half, 1))
        return first


@functools.cache
def _material(mi: Any, _variant: str) -> type:
    """Return the class of guided materials of the variant that is set."""

    class Guided(mi.BSDF):  # type: ignore[misc]
        """A material whose directions come partly from a guide."""

        def __init__(self, nested: Any, lookup: Lookup) -> None:
            mi.BSDF.__init__(self, mi.Properties())
            self.nested, self.lookup = nested, lookup
            self.m_components = [nested.flags(i) for i in range(nested.component_count())]
            self.m_flags = nested.flags()

        def sample(self, ctx: Any, si: Any, one: Any, two: Any, active: Any = True) -> Any:
            share, *leaves = self.lookup.cell(si.p)
            is_guided = one >= share
            drawn, weight = self.nested.sample(
                ctx, si, dr.select(is_guided, 0.5, one / share), two, active & ~is_guided
            )
            guided = si.to_local(self.lookup.sample(leaves, two))
            is_delta = ~is_guided & mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Delta)
            drawn.wo = dr.select(is_guided, guided, drawn.wo)
            is_smooth = active & ~is_delta & (is_guided | (drawn.pdf > 0))
            value, density = self.nested.eval_pdf(ctx, si, drawn.wo, is_smooth)
            density = self._mixed(si, drawn.wo, density, share, leaves)
            is_smooth &= density > 0
            weight = dr.select(is_delta, weight / share, 0)
            drawn.pdf = dr.select(is_delta, drawn.pdf * share, dr.select(is_smooth, density, 0))
            reflection = mi.UInt32(int(mi.BSDFFlags.GlossyReflection))
            drawn.sampled_type = dr.select(is_guided, reflection, drawn.sampled_type)
            drawn.sampled_component = dr.select(is_guided, 0, drawn.sampled_component)
            drawn.eta = dr.select(is_guided, 1, drawn.eta)
            return drawn, dr.select(is_smooth, value / density, weight)

        def _mixed(self, si: Any, wo: Any, density: Any, share: Any, leaves: Any) -> Any:
            guided = self.lookup.density(leaves, si.to_world(wo))
            return share * density + (1 - share) * guided

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.nested.eval(ctx, si, wo, active)

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[1]

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            value, density = self.nested.eval_pdf(ctx, si, wo, active)
            share, *leaves = self.lookup.cell(si.p)
            return value, dr.select(active, self._mixed(si, wo, density, share, leaves), 0)

        def eval_null_transmission(self, si: Any, active: Any = True) -> Any:
            return self.nested.eval_null_transmission(si, active)

        def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
            return self.nested.eval_diffuse_reflectance(si, active)

        def to_string(self) -> str:
            return f"Guided[{self.nested}]"

    return Guided


def into_scene(mi: Any, scene: Any, guide: Guide) -> None:
    """Let the materials of a Mitsuba scene draw directions by a guide.

    Those that only reflect and refract like mirrors and glass stay as they are.
    """
    _guide_by(Lookup(mi, guide), scene)


def _guide_by(lookup: Lookup, scene: Any) -> None:
    mi, made = lookup.mi, dict[str, Any]()
    material = _material(mi, str(mi.variant()))
    for shape in scene.shapes():
        nested = shape.bsdf()
        if nested is not None and mi.has_flag(nested.flags(), mi.BSDFFlags.Smooth):
            if (key := str(nested.ptr)) not in made:
                made[key] = material(nested, lookup)
            shape.set_bsdf(made[key])


# --- training -----------------------------------------------------------------------------------


def trained(mi: Any, scene: Any, sensor: Any, size: tuple[int, int], seeds: Sequence[int]) -> Guide:
    """Return the guide that paths of a scene have taught, and let the scene draw by it.

    Parameters
    ----------
    scene, sensor
        Of Mitsuba, in the variant that is set, which must not be a scalar one.
    size
        (width, height) of the image, of which the number of paths depends.
    seeds
        Of the random numbers of each pass, which has twice as many paths as the one before.
    """
    paths = int(np.clip(_PATHS * size[0] * size[1], _FEWEST, _MOST)) // (2 ** len(seeds) - 1)
    box = scene.bbox()
    low, high = (np.array(corner, np.float64).ravel() for corner in (box.min, box.max))
    margin = 1e-3 * (high - low).max()
    guide = uniform(low - margin, high + margin)
    lookup = Lookup(mi, guide)
    lookup.set(guide, _ROOM)
    _guide_by(lookup, scene)
    for i, seed in enumerate(seeds):
        traced = _traced(mi, scene, sensor, seed, paths * 2**i)
        guide = learn(guide, traced, per_cell=_PER_CELL * 2 ** (i / 2))
        lookup.set(guide, _ROOM)
    lookup.set(guide)
    return guide


def _traced(mi: Any, scene: Any, sensor: Any, seed: int, paths: int) -> Paths:
    """Trace paths through positions all over the image, and return their vertices."""
    room = paths * _VERTICES
    kinds = {"p": mi.Point3f, "wo": mi.Vector3f, "pdf": mi.Float}
    kinds |= {"throughput": mi.Spectrum, "radiance": mi.Spectrum}
    held = {name: dr.zeros(kind, room) for name, kind in kinds.items()}
    dr.make_opaque(*held.values())
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, seed), paths)
    total = _trace(mi, scene, sensor, sampler, dr.opaque(mi.UInt32, paths), paths, held)
    dr.eval(total, *held.values())
    found = {name: np.array(value, np.float64) for name, value in held.items()}
    kept = found["pdf"] > 0
    ends = np.tile(np.array(total, np.float64).reshape(-1, paths), (1, _VERTICES))[:, kept]
    start, carried = (found[name].reshape(-1, room)[:, kept] for name in ("radiance", "throughput"))
    lit = carried > 0
    light = np.divide(ends - start, carried, out=np.zeros(carried.shape), where=lit).mean(axis=0)
    good = np.isfinite(light) & (light >= 0)
    vertices = (found["p"].T[kept], found["wo"].T[kept], light, found["pdf"][kept])
    return Paths(*(values[good] for values in vertices))


@dr.syntax  # type: ignore[untyped-decorator]
def _trace(
    mi: Any, scene: Any, sensor: Any, sampler: Any, paths: Any, lanes: int, held: Mapping[str, Any]
) -> Any:
    """Follow paths with next-event estimation, and note what they are at their vertices.

    Rays pass media as if these were empty: what is learned there may be wrong, and biases nothing.
    """
    ray, _ = sensed(mi, mi.Point2f(sampler.next_2d()), sensor, sampler)
    ray, ctx = mi.Ray3f(ray), mi.BSDFContext()
    lane, stored, depth = dr.arange(mi.UInt32, lanes), mi.UInt32(0), mi.UInt32(0)
    radiance, throughput = mi.Spectrum(0), mi.Spectrum(1)
    before, density, is_delta = dr.zeros(mi.Interaction3f), mi.Float(1), mi.Bool(True)
    active = mi.Bool(True)
    while active:
        si = scene.ray_intersect(ray, active)
        seen = mi.DirectionSample3f(scene, si, before)
        by_light = scene.pdf_emitter_direction(before, seen, active & ~is_delta)
        weight = dr.select(is_delta, 1, _power(density, by_light))
        radiance += throughput * weight * si.emitter(scene, active).eval(si, active)
        active &= si.is_valid() & (depth < _LONGEST)
        bsdf = si.bsdf(ray)
        is_smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        lit, emitted = scene.sample_emitter_direction(si, sampler.next_2d(), True, is_smooth)
        value, by_bsdf = bsdf.eval_pdf(ctx, si, si.to_local(lit.d), is_smooth)
        weight = dr.select(lit.delta, 1, _power(lit.pdf, by_bsdf))
        radiance += dr.select(is_smooth & (lit.pdf > 0), throughput * weight * value * emitted, 0)
        drawn, weight = bsdf.sample(ctx, si, sampler.next_1d(), sampler.next_2d(), active)
        going = si.to_world(drawn.wo)
        is_delta = mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Delta)
        is_kept = is_smooth & ~is_delta & (drawn.pdf > 0) & (stored < _VERTICES)
        is_kept &= dr.max(throughput * weight) > 0
        values = {"p": si.p, "wo": going, "pdf": drawn.pdf}
        values |= {"throughput": throughput, "radiance": radiance}
        for name, value in values.items():
            dr.scatter(held[name], value, stored * paths + lane, is_kept)
        stored = dr.select(is_kept, stored + 1, stored)
        throughput *= weight
        survives = dr.select(depth < _ROULETTE, 1, dr.minimum(dr.max(throughput), 0.95))
        active &= (dr.max(throughput) > 0) & (sampler.next_1d() < survives)
        throughput *= dr.rcp(dr.maximum(survives, 1e-8))
        ray, before = si.spawn_ray(going), mi.Interaction3f(si)
        density = mi.Float(drawn.pdf)
        depth += 1
    return radiance


def _power(one: Any, other: Any) -> Any:
    """Return the weight of one of two densities by the power heuristic (Veach and Guibas 1995)."""
    square = one * one
    weight = square / (square + other * other)
    return dr.select(dr.isfinite(weight), weight, 0)
