"""Path guiding: draw directions towards light that earlier paths have found.

`trained` traces paths, learns a `Guide` from them, and throws them away. A guide has a distribution
of directions for each cell of surfaces. `into_scene` puts a guide into the materials of a scene, so
that all of Mitsuba's integrators use it. A share of the directions comes from the BSDF, the
rest from the guide. Each direction is weighted by the density of both together (Veach and Guibas
1995, the balance heuristic in one sample). A wrong guide thus makes noise, but never a bias. The
guide is frozen before the first sample is drawn, so that samples are independent. Media are not
guided: they draw from their phase functions.

The idea is that of Müller, Gross and Novák, "Practical path guiding for efficient light-transport
simulation", 2017, doi:10.1111/cgf.13227. The distributions are simpler and sharper:

- A cell holds surfaces that face to one of six sides, in a cube that is halved until few vertices
  of paths are left. Directions are relative to the normal, so that none goes below the surface.
- A distribution is a square of bins, which is mapped to the hemisphere so that equal areas are
  equal shares of a diffuse reflection (Shirley and Chiu, "A low distortion map between disk and
  square", 1997, doi:10.1080/10867651.1997.10487479, and Malley's method). The cosine thus needs no
  bins, and a guide without knowledge draws as a diffuse material does.
- What a path finds behind its next vertex is replaced by the mean of all paths near that vertex, as
  Dahm and Keller, "Learning light transport the reinforced way", 2017, doi:10.1145/3084363.3085032,
  do. A cell then needs fewer paths.
- A cell with few paths leans on the larger cubes around it.

Bins have whole numbers of equal chances, so that a direction is drawn by one lookup.
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
    from collections.abc import Callable, Mapping, Sequence

    from chdstat.rendering.jobs import Job
    from chdstat.rendering.seeds import Streams
    from chdstat.samples.store import Store

dr: Any = drjit
Codes = npt.NDArray[np.uint32]

_SHARE = 0.3
"""Share of directions that come from the BSDF. A path that the guide does not expect is rarer by
this factor at each vertex, and weighs more.
"""
WORTH = 0.7
"""A guide pays if it multiplies the variance by less than this. A guided sample costs up to 1.4
times an unguided one. Measured times would vary from run to run."""
FEW = 32
"""With fewer samples than this times the paths of a training, a guide is not tried. Training
takes as long as about five times its paths, which is then up to a seventh of the render."""
_AXIS = 7
"""Bits of a position along each axis: the smallest cells are 1/128 of the scene."""
_SIDES = 6
_PLACES = _SIDES << 3 * _AXIS
_EDGE = 24
"""Bins along the edge of the square of directions."""
_BINS = _EDGE**2
_CHANCES = 8 * _BINS
"""Equal chances that the bins of a cell share. Bins without one are left to the BSDF."""
_PER_CELL, _PER_MEAN = 3000, 256
"""A cube is halved if it has more vertices than this; to learn directions, and to learn means of
the light that leaves vertices."""
_PRIOR = 100
"""A cell leans on the cube around it as if that were so many equal paths."""
_OUTLIER = 20
"""Paths that carry more than this times the mean of their cell are counted as if they did not."""
_PASSES = 3
"""Passes of a training."""
_PATHS = 16
"""Paths of all passes for each pixel."""
_FEWEST, _MOST = 2**17, 2**21
"""Least and largest number of paths of a training."""
_VERTICES = 6
"""Vertices of a path that are kept."""
_LEAST = 1e-12
"""Least variance, in place of 0."""
_BLOCKS = 8
"""Blocks along a side of the image in which variances are compared."""
_R2 = 3242174889, 2447445414
"""Steps of the sequence R2 times 2^32: overflowing integers give its fractions."""
_LONGEST, _ROULETTE = 64, 4
"""Vertices of the longest path of a training, and of its part without Russian roulette."""


@dataclass(frozen=True, eq=False)
class Guide:
    """Distributions of directions in cells of surfaces; without cells, it guides nothing.

    Attributes
    ----------
    box
        Lowest and highest corner of the divided space, shape (2, 3).
    cells
        Code of a place at which each cell begins, ascending, shape (cell,).
    chances
        Whole number of the chances of each bin, the same sum in each cell, shape (cell, bin).
    """

    box: Image
    cells: Codes
    chances: npt.NDArray[np.uint16]

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

        Codes are below 2^24, so that they are exact in single precision.
        """
        if not self.cells.size:
            return {}
        cells = np.append(self.box, self.cells).astype(np.float32)
        return dict(
            zip(GUIDE, (cells[:, np.newaxis], self.chances.astype(np.float32)), strict=True)
        )

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, Image]) -> Guide:
        """Return the guide from its `arrays`."""
        cells, chances = (arrays[name] for name in GUIDE)
        box, codes = np.split(cells[:, 0], [6])
        return cls(box.reshape(2, 3), codes.astype(np.uint32), chances.astype(np.uint16))


NOTHING = Guide(
    box=np.zeros((2, 3), np.float32),
    cells=np.zeros(0, np.uint32),
    chances=np.zeros((0, _BINS), np.uint16),
)
"""The guide that guides nothing."""


class Paths(NamedTuple):
    """Paths of a training, vertices first, zeros where a path has no more of them.

    Attributes
    ----------
    places
        Codes of the places of the vertices, shape (vertex, path).
    bins
        Bins of the directions in which paths go on; too large where these are not to be learned.
    carried
        What the path to a vertex carries, mean of the channels.
    before, after
        Radiance that a path has gathered when it gets to a vertex, and with its direct light.
    ends
        Radiance that each path has gathered at its end, shape (path,).
    """

    places: Codes
    bins: Codes
    carried: Image
    before: Image
    after: Image
    ends: Image


def uniform(low: npt.ArrayLike, high: npt.ArrayLike) -> Guide:
    """Return a guide without knowledge, which draws as a diffuse material does."""
    cells = (np.arange(_SIDES) << 3 * _AXIS).astype(np.uint32)
    chances = np.full((_SIDES, _BINS), _CHANCES // _BINS, np.uint16)
    return Guide(np.array([low, high], np.float32), cells, chances)


def learn(box: Image, paths: Paths) -> Guide:
    """Learn a guide from paths.

    Parameters
    ----------
    box
        Lowest and highest corner of the divided space, shape (2, 3).
    paths
        The paths to learn from.
    """
    light, is_known = _light(paths)
    is_known &= paths.bins < _BINS
    codes, bins = paths.places[is_known], paths.bins[is_known]
    cells = _cells(codes, _PER_CELL)
    cell, light = _cell_of(cells)[codes], light[is_known].astype(np.float64)
    sums = functools.partial(np.bincount, cell, minlength=len(cells))
    mean = sums(light) / np.maximum(sums(), 1)
    light = np.minimum(light, _OUTLIER * mean[cell])
    held: Floats = np.bincount(cell * _BINS + bins, light, len(cells) * _BINS).astype(np.float64)
    squares: Floats = sums(light**2).astype(np.float64)
    share = _shares(cells, held.reshape(len(cells), _BINS), squares)
    below = np.floor(np.cumsum(share, axis=1) * _CHANCES + 0.5)
    chances = np.diff(below, axis=1, prepend=0)
    chances[:, -1] += _CHANCES - below[:, -1]
    return Guide(box, cells, chances.astype(np.uint16))


def _light(paths: Paths) -> tuple[Image, npt.NDArray[np.bool_]]:
    """Return the light that comes to each vertex along its path, and where that is known.

    It includes cosine and BSDF, and is relative to the density of the direction. Where the path
    goes on to another vertex, the mean of all that leaves the surface there stands for what this
    path has found.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        leaving = np.maximum(paths.ends - paths.before, 0) / paths.carried
        light = np.maximum(paths.ends - paths.after, 0) / paths.carried
        is_known = (paths.carried > 0) & np.isfinite(light) & np.isfinite(leaving)
        codes = paths.places[is_known]
        cells = _cells(codes, _PER_MEAN)
        of_place = _cell_of(cells)
        cell = of_place[codes]
        mean = np.bincount(cell, leaving[is_known]) / np.maximum(np.bincount(cell), 1)
        found = np.maximum(paths.before[1:] - paths.after[:-1], 0)
        beyond = mean[np.minimum(of_place[paths.places[1:]], len(mean) - 1)]
        usual = (found + paths.carried[1:] * beyond) / paths.carried[:-1]
    light[:-1] = np.where(is_known[1:], usual, light[:-1])
    is_known[-1] &= len(is_known) == 1  # what is behind the last vertices that are kept is noise
    return light, is_known


def _cells(codes: Codes, most: int) -> Codes:
    """Return where cells begin that hold at most so many of the codes."""
    below = np.concatenate([[0], np.cumsum(np.bincount(codes, minlength=_PLACES))])
    begins, done = np.arange(_SIDES) << 3 * _AXIS, []
    for level in range(3 * _AXIS, -1, -1):
        is_full = (below[begins + 2**level] - below[begins] > most) & (level > 0)
        done.append(begins[~is_full])
        begins = (begins[is_full, np.newaxis] + [0, 2**level // 2]).ravel()
    return np.sort(np.concatenate(done)).astype(np.uint32)


def _cell_of(cells: Codes) -> npt.NDArray[np.intp]:
    """Return the number of the cell that holds each place."""
    return np.repeat(np.arange(len(cells)), _sizes(cells))


def _sizes(cells: Codes) -> npt.NDArray[np.intp]:
    """Return the number of places in each cell."""
    ends = np.append(cells[1:], _PLACES).astype(np.intp)
    return ends - cells.astype(np.intp)


def _shares(cells: Codes, held: Floats, squares: Floats) -> Floats:
    """Return the probabilities of bins, from the light in them and its sum of squares.

    From the sides down to the cells, each cube mixes what it knows with the cube around it.
    """
    share = np.full(held.shape, 1 / _BINS)
    sizes = _sizes(cells)
    for level in range(3 * _AXIS, 0, -3):
        _, first, cube = np.unique(cells >> level, return_index=True, return_inverse=True)
        within = np.add.reduceat(held, first), np.add.reduceat(squares, first)
        around = _leaning(share[first], *within)[cube]
        share = np.where((sizes < 2**level)[:, np.newaxis], around, share)
    return _leaning(share, held, squares)


def _leaning(share: Floats, held: Floats, squares: Floats) -> Floats:
    """Return what light in bins tells of their probabilities, where others were known before."""
    total = held.sum(axis=1)
    # So many equal paths would tell as much (Kish, "Survey sampling", 1965).
    equal = np.divide(total**2, squares, out=np.zeros_like(total), where=squares > 0)
    weight = (equal / (equal + _PRIOR))[:, np.newaxis]
    mixed: Floats = weight * _smooth(held) + (1 - weight) * share
    return mixed


def _smooth(held: Floats) -> Floats:
    """Return the mean of each bin and those around it; the edge is repeated."""
    square = np.pad(held.reshape(-1, _EDGE, _EDGE), ((0, 0), (1, 1), (1, 1)), mode="edge")
    rows = square[:, :-2] + square[:, 1:-1] + square[:, 2:]
    mean = (rows[..., :-2] + rows[..., 1:-1] + rows[..., 2:]) / 9
    mean = mean.reshape(held.shape)
    smooth: Floats = mean / np.maximum(mean.sum(axis=1, keepdims=True), np.finfo(float).tiny)
    return smooth


def _spread(number: Any) -> Any:
    """Return a number below 2^10 with two zeros between its bits."""
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        number = (number | number << shift) & mask
    return number


# --- in Dr.Jit ----------------------------------------------------------------------------------


class _Facing(NamedTuple):
    """Where directions are drawn: the code of the place, and a frame around the normal."""

    code: Any
    one: Any
    other: Any
    normal: Any


@dataclass
class Lookup:
    """A guide in arrays of the current Mitsuba variant, for lookups by materials.

    It is a data class, so that Dr.Jit finds the arrays when it freezes a kernel.
    """

    mi: Any
    guide: InitVar[Guide]
    share: Any = None
    low: Any = None
    scale: Any = None
    cells: Any = None
    chances: Any = None
    draws: Any = None

    def __post_init__(self, guide: Guide) -> None:
        self.set(guide)

    def set(self, guide: Guide) -> None:
        """Use another guide from now on."""
        mi = self.mi
        low, high = guide.box.astype(np.float64)
        self.low = mi.Point3f(low)
        self.scale = mi.Float(2**_AXIS / (high - low).max())
        self.cells = _own(mi.UInt32, _cell_of(guide.cells) * _BINS)
        self.chances = _own(mi.Float, guide.chances.ravel())
        bins = np.tile(np.arange(_BINS), len(guide.cells))
        draws = np.repeat(bins, guide.chances.ravel())
        self.draws = _own(mi.UInt32, draws[::2] | draws[1::2] << 16)
        # Without knowledge, materials know better.
        is_known = (guide.chances != _CHANCES // _BINS).any()
        self.share = mi.Float(_SHARE if is_known else 1)
        dr.make_opaque(self.low, self.scale, self.share)

    def place(self, si: Any) -> _Facing:
        """Return the place of an interaction, on the side that is seen."""
        normal = self.mi.Vector3f(si.sh_frame.n) * dr.select(si.wi.z < 0, self.mi.Float(-1), 1)
        return self.at(si.p, normal)

    def at(self, position: Any, normal: Any) -> _Facing:
        """Return the place of a position on a surface that faces along a unit vector."""
        mi = self.mi
        x, y, z = (
            _spread(mi.UInt32(c))
            for c in dr.clip((position - self.low) * self.scale, 0, 2**_AXIS - 1)
        )
        size = dr.abs(normal)
        by_x = (size.x >= size.y) & (size.x >= size.z)
        by_y = ~by_x & (size.y >= size.z)
        main = dr.select(by_x, normal.x, dr.select(by_y, normal.y, normal.z))
        number = dr.select(by_x, mi.UInt32(0), dr.select(by_y, mi.UInt32(2), mi.UInt32(4)))
        side = dr.select(main < 0, number + 1, number)
        # The next axis is never along the normal, so that frames turn smoothly within a side.
        steps = (~(by_x | by_y), by_x, by_y)
        axis = mi.Vector3f(*(dr.select(step, mi.Float(1), mi.Float(0)) for step in steps))
        one = dr.normalize(axis - normal * dr.dot(normal, axis))
        return _Facing(side << 3 * _AXIS | x | y << 1 | z << 2, one, dr.cross(normal, one), normal)

    def bin(self, place: _Facing, direction: Any) -> Any:
        """Return the bin of a direction; too large below the surface."""
        mi = self.mi
        disk = mi.Point2f(dr.dot(place.one, direction), dr.dot(place.other, direction))
        square = mi.warp.uniform_disk_to_square_concentric(disk) * _EDGE
        x, y = (mi.UInt32(dr.clip(c, 0, _EDGE - 1)) for c in square)
        return dr.select(dr.dot(place.normal, direction) > 0, y * _EDGE + x, _BINS)

    def density(self, place: _Facing, direction: Any) -> Any:
        """Return the density of a direction per solid angle."""
        mi, held = self.mi, self.bin(place, direction)
        is_above = held < _BINS
        index = dr.gather(mi.UInt32, self.cells, place.code) + held
        chances = dr.gather(mi.Float, self.chances, index, is_above)
        cosine = dr.dot(place.normal, direction)
        return dr.select(is_above, chances * cosine * (_BINS / (_CHANCES * np.pi)), 0)

    def sample(self, place: _Facing, number: Any) -> Any:
        """Return a direction, drawn with two random numbers."""
        mi, drawn = self.mi, number.x * _CHANCES
        chance = dr.minimum(mi.UInt32(drawn), _CHANCES - 1)
        first = dr.gather(mi.UInt32, self.cells, place.code) * (_CHANCES // _BINS)
        pair = dr.gather(mi.UInt32, self.draws, (first + chance) >> 1)
        held = dr.select((chance & 1) == 0, pair & 0xFFFF, pair >> 16)
        inside = mi.Point2f(drawn - mi.Float(chance), number.y)
        square = (mi.Point2f(mi.Float(held % _EDGE), mi.Float(held // _EDGE)) + inside) / _EDGE
        x, y = mi.warp.square_to_uniform_disk_concentric(square)
        z = dr.safe_sqrt(1 - x * x - y * y)
        return dr.normalize(place.one * x + place.other * y + place.normal * z)


def _own(kind: Any, values: npt.NDArray[Any]) -> Any:
    """Return values in Dr.Jit's own memory, followed by some zeros.

    Kernels are compiled again for NumPy arrays that begin elsewhere, and for single values.
    """
    owned = dr.concat([kind(values), dr.zeros(kind, 4)])
    dr.eval(owned)
    return owned


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
            share, place = self.lookup.share, self.lookup.place(si)
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
            place = self.lookup.place(si)
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
    """Return the guide of a store's samples; None if it is to be trained again.

    Raises
    ------
    StoreError
        If its samples were drawn by a guide of another kind.
    """
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
        if nested is not None and _is_guided(mi, nested):
            if (key := str(nested.ptr)) not in made:
                made[key] = material(nested, lookup)
            shape.set_bsdf(made[key])
            before.append((shape, nested))
    return before


def _is_guided(mi: Any, material: Any) -> Any:
    flags, kinds = material.flags(), mi.BSDFFlags
    passes = mi.has_flag(flags, kinds.DiffuseTransmission)
    passes |= mi.has_flag(flags, kinds.GlossyTransmission)
    return mi.has_flag(flags, kinds.DiffuseReflection) & ~passes


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
    lookup = Lookup(mi, guide)
    before = _guide_by(lookup, scene)
    taught = []
    for i, seed in enumerate(seeds):
        last = 2 * (paths * 2**i // (2 * (2 ** len(seeds) - 1)))
        traced, guided = _traced(mi, scene, sensor, lookup, seed, last)
        taught.append(traced)
        every = (np.concatenate(parts, axis=-1) for parts in zip(*taught, strict=True))
        guide = learn(guide.box, Paths(*every))
        lookup.set(guide)
    if samples is not None:
        lookup.share = dr.opaque(mi.Float, 1)
        _, plain = _traced(mi, scene, sensor, lookup, seeds[0], last)
        # A few bright samples decide the variance of some blocks; logarithms dampen them.
        logs = np.log(np.maximum([guided, plain], _LEAST)).mean(axis=1)
        if np.exp(logs[0] - logs[1]) > WORTH:
            for shape, material in before:
                shape.set_bsdf(material)
            return NOTHING
        lookup.set(guide)
    return guide


def _traced(
    mi: Any, scene: Any, sensor: Any, lookup: Lookup, seed: int, paths: int
) -> tuple[Paths, Floats]:
    """Trace two paths through each of many positions; return them and their variances.

    Positions follow the sequence R2, which spreads them evenly over the image (Roberts 2018, "The
    unreasonable effectiveness of quasirandom sequences").
    """
    kinds = {"places": mi.UInt32, "bins": mi.UInt32}
    kinds |= dict.fromkeys(("carried", "before", "after"), mi.Float)
    held = {name: dr.zeros(kind, _VERTICES * paths) for name, kind in kinds.items()}
    dr.make_opaque(*held.values())

    def seen(si: Any, bsdf: Any, direction: Any) -> tuple[Any, Any]:
        """Return the code of a place, and the bin of a direction that is to be learned."""
        place = lookup.place(si)
        return place.code, dr.select(_is_guided(mi, bsdf), lookup.bin(place, direction), _BINS)

    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, seed), paths)
    lanes = dr.opaque(mi.UInt32, paths)
    lane = dr.arange(mi.UInt32, paths)
    position = mi.Point2f(*(mi.Float(lane // 2 * step) / 2**32 for step in _R2))
    ends = _trace(mi, scene, sensor, sampler, position, lanes, lane, held, seen)
    dr.eval(ends, *held.values())
    radiance = np.nan_to_num(np.array(ends, np.float64))
    kept = {name: np.array(value).reshape(_VERTICES, paths) for name, value in held.items()}
    return Paths(**kept, ends=np.array(ends)), _variances(radiance, *np.array(position))


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
    seen: Callable[[Any, Any, Any], tuple[Any, Any]],
) -> Any:
    """Follow paths with next-event estimation, and record their vertices.

    Rays pass media as if these were empty. What is learned there may be wrong, but biases nothing.
    """
    ray, _ = sensed(mi, position, sensor, sampler)
    ray, ctx = mi.Ray3f(ray), mi.BSDFContext()
    stored, depth = mi.UInt32(0), mi.UInt32(0)
    radiance, throughput = mi.Spectrum(0), mi.Spectrum(1)
    before, density, is_delta = dr.zeros(mi.Interaction3f), mi.Float(1), mi.Bool(True)
    active = mi.Bool(True)
    while active:
        si = scene.ray_intersect(ray, active)
        hit = mi.DirectionSample3f(scene, si, before)
        by_light = scene.pdf_emitter_direction(before, hit, active & ~is_delta)
        weight = dr.select(is_delta, 1, _power(density, by_light))
        radiance += throughput * weight * si.emitter(scene, active).eval(si, active)
        active &= si.is_valid() & (depth < _LONGEST)
        bsdf = si.bsdf(ray)
        is_smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        values = {"before": dr.mean(radiance)}
        lit, emitted = scene.sample_emitter_direction(si, sampler.next_2d(), True, is_smooth)
        value, by_bsdf = bsdf.eval_pdf(ctx, si, si.to_local(lit.d), is_smooth)
        weight = dr.select(lit.delta, 1, _power(lit.pdf, by_bsdf))
        radiance += dr.select(is_smooth & (lit.pdf > 0), throughput * weight * value * emitted, 0)
        drawn, weight = bsdf.sample(ctx, si, sampler.next_1d(), sampler.next_2d(), active)
        going = si.to_world(drawn.wo)
        is_delta = mi.has_flag(drawn.sampled_type, mi.BSDFFlags.Delta)
        is_kept = is_smooth & ~is_delta & (drawn.pdf > 0) & (stored < _VERTICES)
        is_kept &= dr.max(throughput * weight) > 0
        values["places"], values["bins"] = seen(si, bsdf, going)
        values |= {"carried": dr.mean(throughput), "after": dr.mean(radiance)}
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
    return dr.mean(radiance)


def _power(one: Any, other: Any) -> Any:
    """Return the weight of one of two densities by the power heuristic (Veach and Guibas 1995)."""
    square = one * one
    weight = square / (square + other * other)
    return dr.select(dr.isfinite(weight), weight, 0)
