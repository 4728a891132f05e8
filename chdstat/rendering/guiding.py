"""Path guiding: draw directions towards light that earlier paths have found.

`trained` traces paths, learns a `Guide` from them, and throws them away. A guide has a distribution
of directions for each cell of space. `into_scene` puts a guide into the materials of a scene, so
that all of Mitsuba's integrators use it. A share of the directions comes from the BSDF, the
rest from the guide. Each direction is weighted by the density of both together (Veach and Guibas
1995, the balance heuristic in one sample). A wrong guide thus makes noise, but never a bias. The
guide is frozen before the first sample is drawn, so that samples are independent. Media are not
guided: they draw from their phase functions.

The method is that of Müller, Gross and Novák, "Practical path guiding for efficient light-transport
simulation", 2017, doi:10.1111/cgf.13227, and Müller, "Practical path guiding in production", 2019,
doi:10.1145/3305366.3328091 (section 10). Two things differ:

- The guide learns the light that a path carries on, including cosine and BSDF, as suggested by Rath
  et al., "Variance-aware path guiding", 2020, doi:10.1145/3386569.3392441.
- A cell does not keep directions, but points on a sphere around its center. The radius of the
  sphere is the distance of the light that reaches the cell, so that rays from all positions in the
  cell go to the same points (Ruppert et al., "Robust fitting of parallax-aware mixtures for path
  guiding", 2020, doi:10.1145/3386569.3392421).

Trees are sorted lists. A k-d tree that halves x, y and z in turn, and a quadtree, number their
places by Morton codes. Their leaves are intervals of these codes; a lookup is a binary search for
the last leaf that begins at or before a code.
"""

from __future__ import annotations

import functools
import hashlib
import math
from dataclasses import InitVar, dataclass, fields
from typing import TYPE_CHECKING, Any, NamedTuple

import drjit
import numpy as np
import numpy.typing as npt

from chdstat._core.arrays import Floats, Image
from chdstat.rendering.rays import sensed
from chdstat.samples.layout import GUIDE

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from chdstat.rendering.jobs import Job
    from chdstat.rendering.seeds import Streams
    from chdstat.samples.store import Store

dr: Any = drjit
Codes = npt.NDArray[np.uint64]

_SHARE = 0.7
"""Share of directions that come from the BSDF. A path that the guide does not expect is rarer by
this factor at each vertex, and weighs more. With a smaller share, such paths are outliers; with a
larger one, the guide helps less.
"""
WORTH = 0.7
"""A guide pays if it multiplies the variance by less than this. A guided sample costs up to 1.65
times an unguided one, 1.3 times in most scenes. Measured times would vary from run to run."""
FEW = 64
"""With fewer samples than this times the paths of a training, a guide is not tried. Learning that
it does not pay could cost more than a seventh of the render; with half as many samples, it was 0.28
of the render in two of three scenes."""
_AXIS = 8
"""Bits of a position along each axis: the smallest cells are 1/256 of the scene."""
_SQUARE = 10
"""Bits of each of the two coordinates of a direction."""
_PLACES, _DIRECTIONS = 2 ** (3 * _AXIS), 2 ** (2 * _SQUARE)
_SPHERE = 4 * np.pi
_LARGEST_LEAF, _KNOWN = 0.01, 64
"""A square is divided if it holds more than this share of the light of a cell (Müller et al. 2017),
and if more than this many paths are known to go there; fewer would only show chance."""
_EVERYWHERE = 0.1
"""Share of a guide that is uniform, so that no direction is left out."""
_PER_CELL = 8
"""A cell is halved if it has more vertices than this times the root of the number of all."""
_PASSES = 3
"""Passes of a training."""
_ROOM = 15, 12
"""Steps of searches during a training: one kernel serves all passes."""
_PATHS = 8
"""Paths of all passes for each pixel."""
_FEWEST, _MOST = 2**17, 2**20
"""Least and largest number of paths of a training."""
_VERTICES = 5
"""Vertices of a path to learn from."""
_ROUND = 1.05
"""Radius of the sphere around a cell, relative to the cell."""
_LEAST = 1e-12
"""Least size of a square, in place of 0 by rounding."""
_BLOCKS = 8
"""Blocks along a side of the image in which variances are compared."""
_R2 = 3242174889, 2447445414
"""Steps of the sequence R2 times 2^32: overflowing integers give its fractions."""
_LONGEST, _ROULETTE = 64, 4
"""Vertices of the longest path of a training, and of its part without Russian roulette."""


@dataclass(frozen=True, eq=False)
class Guide:
    """Distributions of directions in cells of space; without cells, it guides nothing.

    Attributes
    ----------
    box
        Lowest and highest corner of the divided space, shape (2, 3).
    cells
        Morton code at which each cell begins, ascending, shape (cell,).
    centers
        Center of the paths of each cell, shape (cell, 3).
    nearness
        One over the distance from the center to the nearest light of each cell, shape (cell,).
    first
        Number of the first leaf of each cell, and the number of all leaves, shape (cell + 1,).
    leaves
        Morton code at which each leaf begins, ascending from 0 within its cell, shape (leaf,).
    below
        Probability of all earlier leaves of the same cell, shape (leaf,).
    """

    box: Image
    cells: npt.NDArray[np.uint32]
    centers: Image
    nearness: Image
    first: npt.NDArray[np.uint32]
    leaves: npt.NDArray[np.uint32]
    below: Image

    @property
    def digest(self) -> str | None:
        """Hash that tells the guide from another one; None if it guides nothing."""
        if not self.cells.size:
            return None
        content = hashlib.sha256()
        for field in fields(self):
            content.update(np.ascontiguousarray(getattr(self, field.name)).tobytes())
        return content.hexdigest()[:16]

    @property
    def arrays(self) -> dict[str, Image]:
        """The guide as two arrays, which are kept beside samples; none if it guides nothing.

        Codes and numbers of leaves are below 2^24, so that they are exact in single precision.
        """
        if not self.cells.size:
            return {}
        columns = (self.centers, self.nearness, self.cells, self.first[:-1])
        cells = np.column_stack(columns).astype(np.float32)
        box = np.pad(self.box, ((0, 0), (0, 3)))
        leaves = np.stack([self.leaves, self.below], axis=1).astype(np.float32)
        return dict(zip(GUIDE, (np.concatenate([box, cells]), leaves), strict=True))

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, Image]) -> Guide:
        """Return the guide from its `arrays`."""
        cells, leaves = (arrays[name] for name in GUIDE)
        *center, nearness, code, first = cells[2:].T
        return cls(
            box=np.ascontiguousarray(cells[:2, :3]),
            cells=code.astype(np.uint32),
            centers=np.stack(center, axis=1),
            nearness=np.ascontiguousarray(nearness),
            first=np.append(first, len(leaves)).astype(np.uint32),
            leaves=leaves[:, 0].astype(np.uint32),
            below=np.ascontiguousarray(leaves[:, 1]),
        )


NOTHING = Guide(
    box=np.zeros((2, 3), np.float32),
    cells=np.zeros(0, np.uint32),
    centers=np.zeros((0, 3), np.float32),
    nearness=np.zeros(0, np.float32),
    first=np.zeros(1, np.uint32),
    leaves=np.zeros(0, np.uint32),
    below=np.zeros(0, np.float32),
)
"""The guide that guides nothing."""


class Paths(NamedTuple):
    """Vertices of paths, all with the same first axis.

    Attributes
    ----------
    positions, directions
        Positions of the vertices, and unit vectors along which the paths go on, shape (n, 3).
    light
        Radiance that the paths carry on, over the density of the directions, shape (n,).
    distances
        Distance to the next hit, shape (n,).
    """

    positions: Floats
    directions: Floats
    light: Floats
    distances: Floats


def uniform(low: npt.ArrayLike, high: npt.ArrayLike) -> Guide:
    """Return a guide without knowledge: one cell, in which all directions are equally likely."""
    zero = np.zeros(1, np.uint32)
    box = np.array([low, high], np.float32)
    nothing = np.zeros(1, np.float32)
    return Guide(box, zero, box[:1], nothing, np.array([0, 1], np.uint32), zero, nothing)


def learn(box: Image, paths: Paths) -> Guide:
    """Learn a guide from paths.

    Parameters
    ----------
    box
        Lowest and highest corner of the divided space, shape (2, 3).
    paths
        The vertices to learn from.
    """
    codes = _place_codes(paths.positions, box)
    cells = _cells(np.sort(codes), _PER_CELL * len(codes) ** 0.5)
    cell = np.searchsorted(cells, codes, side="right") - 1
    centers, nearness = _views(box, cells, cell, paths)
    places = (paths.positions - centers[cell]) * nearness[cell, np.newaxis]
    seen, _ = _seen_from_center(places, paths.directions)
    keys = _keys(cell, _direction_codes(seen))
    order = np.argsort(keys, kind="stable")
    leaves, probability = _leaves(keys[order], paths.light[order], len(cells))
    holder = (leaves // _DIRECTIONS).astype(np.intp)
    first = np.searchsorted(holder, np.arange(len(cells) + 1))
    below = np.concatenate([[0.0], np.cumsum(probability)])[:-1]
    below -= below[first[:-1]][holder]
    return Guide(
        box,
        cells.astype(np.uint32),
        centers.astype(np.float32),
        nearness.astype(np.float32),
        first.astype(np.uint32),
        (leaves % _DIRECTIONS).astype(np.uint32),
        np.minimum(below, 1).astype(np.float32),
    )


def _views(
    box: Image, cells: Codes, cell: npt.NDArray[np.intp], paths: Paths
) -> tuple[Floats, Floats]:
    """Return the center of the paths of each cell, and how near the light that they carry is."""
    sums = functools.partial(np.bincount, cell, minlength=len(cells))
    size = np.diff(np.append(cells, np.uint64(_PLACES))).astype(np.int64)
    bits = (np.log2(size).astype(int)[:, np.newaxis] + [2, 1, 0]) // 3
    step = (box[1] - box[0]) / 2**_AXIS
    low = box[0] + step * np.stack([_joined(cells >> i, 3) for i in range(3)], axis=1)
    high, count = low + step * 2.0**bits, sums()[:, np.newaxis]
    centers = (low + high) / 2
    places = np.stack([sums(x) for x in paths.positions.T], axis=1)
    np.divide(places, count, out=centers, where=count > 0)
    radius = np.linalg.norm(np.maximum(centers - low, high - centers), axis=1)
    light, near = sums(paths.light), sums(paths.light / paths.distances)
    nearness = np.divide(near, light, out=np.zeros(len(cells)), where=light > 0)
    return centers, np.minimum(nearness, 1 / (_ROUND * radius))


def _seen_from_center(places: Any, directions: Any) -> tuple[Floats, Floats]:
    """Return where rays from places in the unit ball leave it, and the growth of solid angles."""
    along = (places * directions).sum(axis=1)
    root = np.sqrt(np.maximum(along**2 - (places**2).sum(axis=1) + 1, _LEAST))
    length = root - along
    return places + length[:, np.newaxis] * directions, length**2 / root


def _cells(codes: Codes, per_cell: float) -> Codes:
    """Return where cells begin that hold at most `per_cell` of the ascending codes."""
    begins, done = np.zeros(1, np.uint64), list[Codes]()
    for level in range(3 * _AXIS, 0, -1):
        ends = np.searchsorted(codes, begins + np.uint64(2**level))
        is_full = ends - np.searchsorted(codes, begins) > per_cell
        done.append(begins[~is_full])
        halves = np.array([0, 2 ** (level - 1)], np.uint64)
        begins = (begins[is_full, np.newaxis] + halves).ravel()
    return np.sort(np.concatenate([*done, begins]))


def _leaves(keys: Codes, light: Floats, cells: int) -> tuple[Codes, Floats]:
    """Return the keys at which the leaves of all cells begin, and their probabilities."""
    sums = np.concatenate([[0.0], np.cumsum(light, dtype=np.float64)])

    def within(begins: Codes, size: int) -> tuple[npt.NDArray[np.intp], Floats]:
        """Return the paths to each square of a size, and the light that they carry."""
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
    """Return a number with its bits spread apart; for NumPy or Dr.Jit."""
    for shift, mask in _STEPS[apart]:
        number = (number | number << shift) & mask
    return number


def _joined(number: Any, apart: int) -> Any:
    """Return every second or third bit of a number: the inverse of `_spread`."""
    shifts, masks = zip(*reversed(_STEPS[apart]), strict=True)
    number = number & masks[0]
    for shift, mask in zip(shifts, (*masks[1:], 0x3FF), strict=True):
        number = (number | number >> shift) & mask
    return number


# --- in Dr.Jit ----------------------------------------------------------------------------------


@dataclass
class Lookup:
    """A guide in arrays of the current Mitsuba variant, for lookups by materials.

    It is a data class, so that Dr.Jit finds the arrays when it freezes a kernel.
    """

    mi: Any
    guide: InitVar[Guide]
    steps: InitVar[tuple[int, int] | None] = None
    share: Any = None
    low: Any = None
    scale: Any = None
    cells: Any = None
    views: Any = None
    first: Any = None
    count: Any = None
    leaves: Any = None
    below: Any = None

    def __post_init__(self, guide: Guide, steps: tuple[int, int] | None) -> None:
        self.set(guide, steps)

    def set(self, guide: Guide, steps: tuple[int, int] | None = None) -> None:
        """Use another guide from now on.

        The numbers of search steps for a cell and a leaf are part of the kernel. None takes as few
        as the guide needs.
        """
        mi, longest = self.mi, int(np.diff(guide.first).max())
        counts = len(guide.cells), longest
        self.cell_steps, self.leaf_steps = steps or ((n - 1).bit_length() for n in counts)
        # With a single leaf, the guide knows nothing.
        self.share = dr.opaque(mi.Float, 1 if len(guide.leaves) == 1 else _SHARE)
        low, high = guide.box.astype(np.float64)
        self.low, self.scale = mi.Point3f(low), mi.Vector3f(2**_AXIS / (high - low))
        self.cells = _own(mi.UInt32, guide.cells)
        self.views = _own(mi.Float, np.column_stack([guide.centers, guide.nearness]).ravel())
        self.first, self.count = _own(mi.UInt32, guide.first), mi.UInt32(len(guide.cells))
        self.leaves, self.below = _own(mi.UInt32, guide.leaves), _own(mi.Float, guide.below)
        dr.make_opaque(self.low, self.scale, self.count)

    def place(self, position: Any) -> tuple[Any, Any, Any]:
        """Return a position relative to the center of its cell, and the range of its leaves."""
        mi = self.mi
        scaled = dr.clip((position - self.low) * self.scale, 0, 2**_AXIS - 1)
        x, y, z = (_spread(mi.UInt32(c), 3) for c in (scaled.x, scaled.y, scaled.z))
        cell = self._last(self.cells, x | y << 1 | z << 2, 0, self.count, self.cell_steps)
        first, end = (dr.gather(mi.UInt32, self.first, cell + i) for i in (0, 1))
        view = dr.gather(mi.Vector4f, self.views, cell)
        return (mi.Vector3f(position) - view.xyz) * view.w, first, end

    def density(self, place: Sequence[Any], direction: Any) -> Any:
        """Return the density of a direction per solid angle."""
        mi, (offset, first, end) = self.mi, place
        along = dr.dot(offset, direction)
        root = dr.sqrt(dr.maximum(along * along - dr.squared_norm(offset) + 1, _LEAST))
        length = root - along
        seen = offset + length * direction
        turn = dr.atan2(seen.y, seen.x) / (2 * dr.pi)
        square = (0.5 * seen.z + 0.5, dr.select(turn < 0, turn + 1, turn))
        u, v = (mi.UInt32(dr.clip(c * 2**_SQUARE, 0, 2**_SQUARE - 1)) for c in square)
        code = _spread(u, 2) | _spread(v, 2) << 1
        leaf = self._last(self.leaves, code, first, end - first, self.leaf_steps)
        _, probability, _, size = self._leaf(leaf, end)
        return probability * (_DIRECTIONS / _SPHERE) / size * length * length / root

    def sample(self, place: Sequence[Any], number: Any) -> Any:
        """Return a direction, drawn with two random numbers."""
        mi, (offset, first, end) = self.mi, place
        leaf = self._last(self.below, number.x, first, end - first, self.leaf_steps)
        below, probability, begin, size = self._leaf(leaf, end)
        inside = dr.clip((number.x - below) / probability, 0, dr.one_minus_epsilon(mi.Float))
        edge = dr.sqrt(size) / 2**_SQUARE
        z = 2 * (mi.Float(_joined(begin, 2)) / 2**_SQUARE + inside * edge) - 1
        turn = mi.Float(_joined(begin >> 1, 2)) / 2**_SQUARE + number.y * edge
        (sine, cosine), radius = dr.sincos(2 * dr.pi * turn), dr.safe_sqrt(1 - z * z)
        return dr.normalize(mi.Vector3f(radius * cosine, radius * sine, z) - offset)

    def _leaf(self, leaf: Any, end: Any) -> tuple[Any, Any, Any, Any]:
        """Return the probability below a leaf, its own probability, its start, and its size."""
        mi, goes_on = self.mi, leaf + 1 != end
        below = dr.gather(mi.Float, self.below, leaf)
        begin = dr.gather(mi.UInt32, self.leaves, leaf)
        next_below = dr.gather(mi.Float, self.below, leaf + 1, goes_on)
        next_begin = dr.gather(mi.UInt32, self.leaves, leaf + 1, goes_on)
        probability = dr.select(goes_on, next_below, 1) - below
        size = mi.Float(dr.select(goes_on, next_begin, _DIRECTIONS) - begin)
        return below, probability, begin, size

    def _last(self, values: Any, wanted: Any, first: Any, count: Any, steps: int) -> Any:
        """Return the last of `count` places from `first` whose value is at most the wanted one."""
        first, count = self.mi.UInt32(first), self.mi.UInt32(count)
        for _ in range(steps):
            half = count >> 1
            is_right = (half > 0) & (dr.gather(type(values), values, first + half) <= wanted)
            first = dr.select(is_right, first + half, first)
            count = dr.select(is_right, count - half, dr.maximum(half, 1))
        return first


def _own(kind: Any, values: npt.NDArray[Any]) -> Any:
    """Return values in Dr.Jit's own memory, followed by some zeros.

    Kernels are compiled again for NumPy arrays that begin elsewhere, and for single values.
    """
    return kind([*values.tolist(), 0, 0, 0, 0])


@functools.cache
def _material(mi: Any, _variant: str) -> type:
    """Return the class of guided materials for the current variant."""

    class Guided(mi.BSDF):  # type: ignore[misc]
        """A material whose directions come partly from a guide."""

        def __init__(self, nested: Any, lookup: Lookup) -> None:
            mi.BSDF.__init__(self, mi.Properties())
            self.nested, self.lookup = nested, lookup
            self.m_components = [nested.flags(i) for i in range(nested.component_count())]
            self.m_flags = nested.flags()

        def sample(self, ctx: Any, si: Any, one: Any, two: Any, active: Any = True) -> Any:
            share, place = self.lookup.share, self.lookup.place(si.p)
            is_guided = one >= share
            drawn, weight = self.nested.sample(
                ctx, si, dr.select(is_guided, 0.5, one / share), two, active & ~is_guided
            )
            guided = si.to_local(self.lookup.sample(place, two))
            is_delta = ~is_guided & mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Delta)
            drawn.wo = dr.select(is_guided, guided, drawn.wo)
            is_smooth = active & ~is_delta & (is_guided | (drawn.pdf > 0))
            value, density = self.nested.eval_pdf(ctx, si, drawn.wo, is_smooth)
            density = self._mixed(si, drawn.wo, density, place)
            is_smooth &= density > 0
            weight = dr.select(is_delta, weight / share, 0)
            drawn.pdf = dr.select(is_delta, drawn.pdf * share, dr.select(is_smooth, density, 0))
            reflection = mi.UInt32(int(mi.BSDFFlags.GlossyReflection))
            drawn.sampled_type = dr.select(is_guided, reflection, drawn.sampled_type)
            drawn.sampled_component = dr.select(is_guided, 0, drawn.sampled_component)
            drawn.eta = dr.select(is_guided, 1, drawn.eta)
            return drawn, dr.select(is_smooth, value / density, weight)

        def _mixed(self, si: Any, wo: Any, density: Any, place: Any) -> Any:
            share = self.lookup.share
            return share * density + (1 - share) * self.lookup.density(place, si.to_world(wo))

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.nested.eval(ctx, si, wo, active)

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[1]

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            value, density = self.nested.eval_pdf(ctx, si, wo, active)
            place = self.lookup.place(si.p)
            density = self._mixed(si, wo, density, place)
            return value, dr.select(active, density, 0)

        def eval_null_transmission(self, si: Any, active: Any = True) -> Any:
            return self.nested.eval_null_transmission(si, active)

        def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
            return self.nested.eval_diffuse_reflectance(si, active)

        def to_string(self) -> str:
            return f"Guided[{self.nested}]"

    return Guided


def kept_guide(store: Store, asked: str) -> Guide | None:
    """Return the guide of a store's samples; None if it is to be trained again."""
    if (kept := store.guide()) is not None:
        return Guide.of_arrays(kept)
    unguided = asked == "auto" and store.attrs.get("guide") is None  # it goes on as it was begun
    return NOTHING if unguided else None


def put_to_use(job: Job, mi: Any, scene: Any, sensor: Any, streams: Streams) -> Guide:
    """Let a scene draw directions by the guide of a job, or by one that is trained now."""
    if job.backend.name == "scalar":  # which cannot be guided, and need not be
        return NOTHING
    if job.guide is not None:
        into_scene(mi, scene, job.guide)
        return job.guide
    seeds = [streams.of_training(i) for i in range(_PASSES)]
    samples = math.prod(streams.size) * job.options["spp"] if job.guided == "auto" else None
    return trained(mi, scene, sensor, streams.size, seeds, samples=samples)


def into_scene(mi: Any, scene: Any, guide: Guide) -> None:
    """Let the materials of a Mitsuba scene draw directions by a guide.

    Materials without a diffuse part stay as they are: they know better than a guide where a glossy
    reflection looks.
    """
    if guide.cells.size:
        _guide_by(Lookup(mi, guide), scene)


def _guide_by(lookup: Lookup, scene: Any) -> list[tuple[Any, Any]]:
    """Let a scene look up directions; return its shapes with their original materials."""
    mi, made, before = lookup.mi, dict[str, Any](), []
    material = _material(mi, str(mi.variant()))
    for shape in scene.shapes():
        nested = shape.bsdf()
        if nested is not None and mi.has_flag(nested.flags(), mi.BSDFFlags.Diffuse):
            if (key := str(nested.ptr)) not in made:
                made[key] = material(nested, lookup)
            shape.set_bsdf(made[key])
            before.append((shape, nested))
    return before


# --- training -----------------------------------------------------------------------------------


def trained(
    mi: Any,
    scene: Any,
    sensor: Any,
    size: tuple[int, int],
    seeds: Sequence[int],
    *,
    samples: int | None = None,
) -> Guide:
    """Train a guide with paths of a scene, let the scene use it, and return it.

    Parameters
    ----------
    scene, sensor
        Mitsuba's scene and sensor, in the current variant, which must not be scalar.
    size
        (width, height) of the image, which sets the number of paths.
    seeds
        Seeds of the random numbers of each pass. A pass has twice as many paths as the one before.
        The first pass is not guided; each guide learns from the paths of all passes so far.
    samples
        Number of samples over all pixels, to guide only if that pays; None to guide in any case. It
        does not pay if there are few samples compared with the paths of a training (see `FEW`), or
        if the variance of the last pass is not below `WORTH` times that of as many unguided paths.
        The guide then has no cells, and the scene stays as it was.
    """
    paths = int(np.clip(_PATHS * size[0] * size[1], _FEWEST, _MOST))
    if samples is not None and samples < FEW * paths:
        return NOTHING
    box = scene.bbox()
    low, high = (np.array(corner, np.float64).ravel() for corner in (box.min, box.max))
    margin = 1e-3 * (high - low).max()
    guide = uniform(low - margin, high + margin)
    lookup = Lookup(mi, guide, _ROOM)
    before = _guide_by(lookup, scene)
    taught = []
    for i, seed in enumerate(seeds):
        last = 2 * (paths * 2**i // (2 * (2 ** len(seeds) - 1)))
        traced, guided = _traced(mi, scene, sensor, seed, last)
        taught.append(traced)
        guide = learn(guide.box, Paths(*map(np.concatenate, zip(*taught, strict=True))))
        lookup.set(guide, _ROOM)
    if samples is not None:
        lookup.share = dr.opaque(mi.Float, 1)
        _, plain = _traced(mi, scene, sensor, seeds[0], last)
        # A few bright samples decide the variance of some blocks; logarithms dampen them.
        logs = np.log(np.maximum([guided, plain], _LEAST)).mean(axis=1)
        if np.exp(logs[0] - logs[1]) > WORTH:
            for shape, material in before:
                shape.set_bsdf(material)
            return NOTHING
    lookup.set(guide)
    return guide


def _traced(mi: Any, scene: Any, sensor: Any, seed: int, paths: int) -> tuple[Paths, Floats]:
    """Trace two paths through each of many positions; return their vertices and variances.

    Positions follow the sequence R2, which spreads them evenly over the image (Roberts 2018, "The
    unreasonable effectiveness of quasirandom sequences").
    """
    room = paths * _VERTICES
    kinds = {"p": mi.Point3f, "wo": mi.Vector3f, "distance": mi.Float}
    kinds |= {"throughput": mi.Spectrum, "radiance": mi.Spectrum}
    held = {name: dr.zeros(kind, room) for name, kind in kinds.items()}
    dr.make_opaque(*held.values())
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, seed), paths)
    lanes = dr.opaque(mi.UInt32, paths)
    lane = dr.arange(mi.UInt32, paths)
    position = mi.Point2f(*(mi.Float(lane // 2 * step) / 2**32 for step in _R2))
    total = _trace(mi, scene, sensor, sampler, position, lanes, lane, held)
    dr.eval(total, *held.values())
    ends = dr.gather(mi.Spectrum, total, dr.arange(mi.UInt32, room) % lanes)
    carried = held["throughput"]
    light = dr.mean(dr.select(carried > 0, (ends - held["radiance"]) / carried, 0))
    good = dr.compress((held["distance"] > 0) & dr.isfinite(light) & (light >= 0))
    vertices = (held["p"], held["wo"], light, held["distance"])
    kept = (np.array(dr.gather(type(value), value, good)).T for value in vertices)
    radiance = np.nan_to_num(np.array(dr.mean(total), np.float64))
    return Paths(*kept), _variances(radiance, *np.array(position))


def _variances(radiance: Floats, x: Any, y: Any) -> Floats:
    """Return the variance of pairs of paths in each block of the image."""
    block = (_BLOCKS * y[::2]).astype(int) * _BLOCKS + (_BLOCKS * x[::2]).astype(int)
    first, second = radiance.reshape(-1, 2).T
    count = np.maximum(np.bincount(block, minlength=_BLOCKS**2), 1)
    return np.bincount(block, (first - second) ** 2 / 2, minlength=_BLOCKS**2) / count


@dr.syntax  # type: ignore[untyped-decorator]
def _trace(
    mi: Any,
    scene: Any,
    sensor: Any,
    sampler: Any,
    position: Any,
    paths: Any,
    lane: Any,
    held: Mapping[str, Any],
) -> Any:
    """Follow paths with next-event estimation, and record their vertices.

    Rays pass media as if these were empty. What is learned there may be wrong, but biases nothing.
    """
    ray, _ = sensed(mi, position, sensor, sampler)
    ray, ctx = mi.Ray3f(ray), mi.BSDFContext()
    stored, depth = mi.UInt32(0), mi.UInt32(0)
    radiance, throughput = mi.Spectrum(0), mi.Spectrum(1)
    before, density, is_delta = dr.zeros(mi.Interaction3f), mi.Float(1), mi.Bool(True)
    active, last = mi.Bool(True), mi.Bool(False)
    while active:
        si = scene.ray_intersect(ray, active)
        dr.scatter(held["distance"], si.t, (stored - 1) * paths + lane, active & last)
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
        values = {"p": si.p, "wo": going}
        values |= {"throughput": throughput, "radiance": radiance}
        for name, value in values.items():
            dr.scatter(held[name], value, stored * paths + lane, is_kept)
        stored, last = dr.select(is_kept, stored + 1, stored), mi.Bool(is_kept)
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
