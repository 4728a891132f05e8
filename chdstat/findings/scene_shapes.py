"""Scene shapes: whether a scene can be told by the shapes of its CHDs alone (finding 12)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat.findings._equal import common_count, drawn
from chdstat.findings._integrators import permuted, squares, squares_of_pairs
from chdstat.findings.conclusions import Conclusion, level_of
from chdstat.findings.evidence import Evidence
from chdstat.findings.log_chds import EDGES, aligned
from chdstat.findings.resampling import Blocks, Spread, interval_of, mean_of
from chdstat.findings.results import Exhibit, Part
from chdstat.summary import summarize

__all__ = ["DIFFERENT", "measure", "tells_apart"]

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

DIFFERENT = 0.02
"""Cramér distance, root of its mean square over pixels, from which shapes are different.

As of two log-normal CHDs of which one has a spread a tenth larger, at a third of a decade: that
takes a fifth more samples for the same error in the logarithm. What is smaller may be there, and a
test with samples enough would find it, but it changes nothing for who renders. `SAME_SHAPE`, up to
which CHDs look the same, is no border here: a difference need not be seen to be one.
"""
_NULL = "both integrators give each pixel a CHD of the same shape (permutations within pixels)"
_FOLDS = 4
_ACROSS = 4
_PIXELS = 1500
"""Pixels of each scene that take part, at most."""
_LEAST = 64
_LEAST_SAMPLES = 32
"""Positive samples that a shape needs."""
_TREES = 30
_PARTS = 2


@dataclass(frozen=True)
class _Difference:
    """How far the shapes of two integrators are apart, and whether they are, by scene, too."""

    spread: Spread
    p_value: float
    by_scene: Mapping[str, float]


def measure(evidences: Sequence[Evidence]) -> Conclusion:
    """Tell scenes apart by shapes, and compare shapes of integrators pixel by pixel."""
    level = level_of(_PARTS)
    parts, missing = list[Part](), list[str]()
    details: dict[str, Any] = {}
    n = common_count(evidences, least=_LEAST_SAMPLES)
    looks = [_shapes(evidence, n) for evidence in evidences]
    if len(evidences) < 2:
        missing.append("needs a second scene")
    else:
        found, confusion = tells_apart(looks, level=level)
        if confusion is None:
            missing.append(f"needs {_LEAST} pixels of each scene with {n} positive samples")
        else:
            details |= {"confusion": confusion, "positive_samples": n}
            chance = 1 / len(evidences)
            name = "accuracy of telling scenes apart"
            parts.append(Part.of(name, found, least=(1 + chance) / 2))
    changed = [e for e in evidences if (e.integrator or e.shorter) is not None]
    difference = _between_integrators(changed, level)
    if changed:
        name, unit = "distance between the shapes of two integrators", "decade^1/2"
        parts.append(Part.of(name, difference.spread, least=DIFFERENT, unit=unit))
        details |= {"null_hypothesis": _NULL, "p_value_by_scene": difference.by_scene}
    else:
        missing.append("needs a scene rendered by another integrator, or with shorter paths")
    return Conclusion(
        tuple(parts),
        tuple(missing),
        p_value=None if math.isnan(difference.p_value) else difference.p_value,
        details={"scenes": [e.name for e in evidences], **details},
        exhibit=_exhibit(evidences, looks),
    )


def tells_apart(
    looks: Sequence[tuple[Floats, Blocks]], *, level: float
) -> tuple[Spread, list[list[float]] | None]:
    """Return the accuracy of a classifier of shapes, and its table of shares by scene.

    Each scene comes with shapes, (pixel, edge), and the blocks that its pixels lie in.

    Extremely randomised trees (Geurts, Ernst and Wehenkel 2006, doi:10.1007/s10994-006-6226-1) see
    shapes without place or scale, each of as many positive samples: of more, a shape is smoother,
    which would tell of nulls and spp. Each image is cut into 16 blocks; a quarter of
    them is held out at a time, as neighbours resemble each other (Roberts et al. 2017,
    doi:10.1111/ecog.02881). Every scene counts alike.

    Half-way between chance and certainty, the claim's border, is a choice of ours.
    """
    from sklearn.ensemble import ExtraTreesClassifier

    shapes, blocks = zip(*looks, strict=True)
    if min(len(s) for s in shapes) < _LEAST:
        return Spread.unknown(level=level), None
    x = np.concatenate(shapes)
    scene = np.repeat(np.arange(len(shapes)), [len(s) for s in shapes])
    # Blocks of one fold do not touch.
    fold = np.concatenate(
        [(b.of_pixel % _ACROSS + 2 * (b.of_pixel // _ACROSS)) % _FOLDS for b in blocks]
    )
    guess = np.full(len(x), -1)
    for k in range(_FOLDS):
        if (held := fold == k).any():
            model = ExtraTreesClassifier(
                _TREES, min_samples_leaf=3, class_weight="balanced", random_state=0
            )
            guess[held] = model.fit(x[~held], scene[~held]).predict(x[held])
    joined = Blocks.join([b[:] for b in blocks])  # without blocks that have no pixel
    right, count = joined.sums((guess == scene).astype(float)), joined.sums(np.ones(len(x)))
    confusion = [
        [float((guess[scene == i] == j).mean()) for j in range(len(shapes))]
        for i in range(len(shapes))
    ]
    accuracy = _balanced(right, count, joined.region)
    return interval_of(accuracy, joined, level=level, bounds=(0.0, 1.0)), confusion


def _balanced(right: Floats, count: Floats, scene: Ints) -> Callable[[Floats], Floats]:
    member = (scene[:, np.newaxis] == np.unique(scene)).astype(np.float64)

    def accuracy(weights: Floats) -> Floats:
        hits, all_ = (weights * right) @ member, (weights * count) @ member
        return np.asarray((hits / all_).mean(axis=1))

    return accuracy


def _shapes(evidence: Evidence, n: int) -> tuple[Floats, Blocks]:
    """Return shapes of `n` samples, shape (pixel, edge), and the blocks that the pixels lie in."""
    x, blocks = drawn(evidence, n, pixels=_PIXELS, across=_ACROSS)
    found = aligned(x)
    # Blocks keep their numbers, which say where they lie.
    return found.whole[found.known], Blocks(blocks.of_pixel[found.known], blocks.region)


def _between_integrators(evidences: Sequence[Evidence], level: float) -> _Difference:
    """Compare the shapes that two integrators give each pixel."""
    found: dict[str, tuple[Floats, Blocks]] = {}
    for evidence in evidences:
        apart = _squares(evidence)
        if apart is not None:
            found[evidence.name] = apart, evidence.whole().blocks
    if not found:
        return _Difference(Spread.unknown(level=level), math.nan, {})
    each = {name: permuted([values]) for name, (values, _) in found.items()}
    values, blocks = zip(*found.values(), strict=True)
    spread = mean_of(np.concatenate(values), Blocks.join(list(blocks)), level=level)
    return _Difference(spread.root(), permuted(values), each)


def _squares(evidence: Evidence) -> Floats | None:
    """Return squared distances to the other render of the view; None where sizes differ."""
    other = evidence.integrator or evidence.shorter
    if other is None or other.shape[:2] != evidence.samples.shape[:2]:
        return None
    if evidence.samples.shares_numbers_with(other):
        return squares_of_pairs(evidence.samples, other)
    theirs = evidence.shorter_summary if other is evidence.shorter else None
    if theirs is None:
        theirs = summarize(other, progress=False)
    return squares(evidence.summary, theirs)


def _exhibit(evidences: Sequence[Evidence], looks: Sequence[tuple[Floats, Blocks]]) -> Exhibit:
    series = {}
    for evidence, (shapes, _) in zip(evidences, looks, strict=True):
        if len(shapes):
            series[evidence.name] = (EDGES, shapes.mean(axis=0))
    return Exhibit("curves", series, "log10 radiance around its mean", "share below")
