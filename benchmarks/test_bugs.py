"""The bench of bugs: which faults of renderers tests find, at equal false alarms.

97 faults on eight scenes, at 2e6 samples an image and a tenth of it. Ours is `chdstat.contrast` at
an alpha of .01 for all eight scenes; others are those of `benchmarks.rival_tests`, with the limits
that their authors give. All are also compared with the largest score of 20 right renders of a scene
as the limit ("tuned"): equal false alarms, of about 1 in 21.

A failure: fewer than 95 % found at 2e6 samples of the bugs that change the image, or a twentieth of
it, by 1 % or more, and surely by more than the smallest loss that the test states; or fewer bugs
found than another test finds, both tuned. What a bug changes is measured along the same paths, or
beside all right renders of a scene, with a standard error. Run with ``--benchmark-only -s``;
`benchmarks.bug_renders` says what it costs. The tests themselves take 20 minutes.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import uniform_filter

import chdstat as chd
from benchmarks import bug_renders
from benchmarks.bug_renders import RIGHT, SPP, TENTH, Render, Scene
from benchmarks.renderer_bugs import EDGE, FAULTS, Fault
from benchmarks.rival_tests import SCORES, XYZ, Means, published
from chdstat.inference import Reference

ALPHA = 0.01 / 8
BUDGETS = ("2e6", "2e5")
MEANS = 48
"""Batches of renders."""
BATCHES = {"2e6": 48, "2e5": 480}
"""Batches of the reference, so that a test makes 16 of that size."""
NONE = Fault("none", "the path tracer has no fault", "integrator")
RIGHT_ONES = ("", NONE.name)
"""Names of right renders: by the scene's own integrator, and by the path tracer without a fault."""
LIMITS = 20
"""Right renders that give the limits of scores."""
CHANGED = 0.01
SURE = 4
WINDOW = round(np.sqrt(0.05) * EDGE)


@dataclass(frozen=True)
class Change:
    """What a fault changes, relative, brighter above 0; each with its standard error.

    Attributes
    ----------
    image
        Of the luminance of the image.
    twentieth
        Of the window of a twentieth where it is clearest.
    channel
        Of the channel of the image where it is clearest.
    pixels
        Mean square of what it changes of pixels, over the square of the mean.
    """

    image: tuple[float, float]
    twentieth: tuple[float, float]
    channel: tuple[float, float]
    pixels: tuple[float, float]

    @property
    def surely(self) -> bool:
        """Whether it changes the image, a window or pixels, beyond the noise of the measurement."""
        least = {"image": 0.001, "channel": 0.001, "twentieth": CHANGED, "pixels": CHANGED**2}
        pairs = [(*getattr(self, name), size) for name, size in least.items()]
        return any(abs(x) > max(size, SURE * error) for x, error, size in pairs)


@dataclass(frozen=True)
class Row:
    """What tests say of a render.

    Attributes
    ----------
    scene, budget
        A scene, and one of `BUDGETS`.
    fault
        Name of the fault; "" for a right render.
    outcome, p_value, detectable
        Of `chdstat.contrast`.
    scores
        Of `SCORES`, and of "contrast": minus the logarithm of its p-value.
    change
        What the fault changes; None of a right render.
    """

    scene: str
    budget: str
    fault: str
    outcome: str
    p_value: float
    detectable: Mapping[str, float]
    scores: Mapping[str, float]
    change: Change | None = None

    @property
    def stated(self) -> bool:
        """Whether the change is surely as large as a loss that the test says to find."""
        if self.change is None:
            return False
        pairs = (
            (self.change.image, self.detectable["image"]),
            (self.change.twentieth, self.detectable["tenth"]),
        )
        return any(abs(x) - 2 * error >= max(CHANGED, loss) for (x, error), loss in pairs)


# --- what is compared ---------------------------------------------------------------------------


def means_of(samples: np.ndarray, size: int) -> Means:
    """Return means of batches of samples or of means, each of a number of them."""
    shape = (*samples.shape[:3], samples.shape[3] // size, size)
    return Means(samples.reshape(shape).mean(axis=-1, dtype=float).astype(np.float32), size)


def at_budget(render: Render, budget: str) -> Means:
    """Return the means of a render that tests compare: 48 batches of 10, or samples."""
    return Means(render.batches, SPP // MEANS) if budget == "2e6" else Means(render.first, 1)


def mixed(samples: np.ndarray, budget: str) -> Iterator[Means]:
    """Yield right renders: mixed batches of samples (y, x, channel, sample), or parts of them."""
    batches = means_of(samples, SPP // MEANS).batches
    # Not the first tenth of a render, which faults of samples change.
    starts = [s for s in range(0, samples.shape[-1], TENTH) if s % SPP]
    for k in range(LIMITS):
        if budget == "2e6":
            chosen = np.random.default_rng(k).choice(batches.shape[-1], MEANS, replace=False)
            yield Means(batches[..., chosen], SPP // MEANS)
        else:
            yield Means(samples[..., starts[2 * k] :][..., :TENTH], 1)


def scores(a: Means, b: Means) -> dict[str, float]:
    return {name: float(score(a, b)) for name, score in SCORES.items()}


# --- what a fault changes -----------------------------------------------------------------------


def change_of(fault: Fault, render: Render, pool: np.ndarray, scene: Scene) -> Change:
    """Return what a fault changes: beside all right renders, or beside the same samples."""
    x, right = render.batches.astype(float), pool.astype(float)
    same = scene.unchanged(fault)
    if same is not None:  # beside which the change has hardly any noise
        level = right.mean(axis=-1, keepdims=True)
        x, right = level + x - same.batches, np.broadcast_to(level, x.shape)
    light, of_right = (np.einsum("c,yxck->yxk", XYZ[1], v) for v in (x, right))
    channels = [_relative(*(v.mean(axis=(0, 1))[c] for v in (x, right))) for c in range(3)]
    return Change(
        _relative(light.mean(axis=(0, 1)), of_right.mean(axis=(0, 1))),
        _clearest(light, of_right),
        max(channels, key=lambda c: abs(c[0]) - 2 * c[1]),
        _of_pixels(light, of_right),
    )


@np.errstate(all="ignore")
def _relative(x: np.ndarray, right: np.ndarray) -> Any:
    """Return relative differences of means over the last axis, and their standard errors."""
    level = right.mean(axis=-1)
    error = np.sqrt(sum(v.var(axis=-1, ddof=1) / v.shape[-1] for v in (x, right)))
    found = (np.where(level > 0, v / level, 0) for v in (x.mean(axis=-1) - level, error))
    return tuple(v if v.ndim else float(v) for v in found)


def _clearest(x: np.ndarray, right: np.ndarray) -> tuple[float, float]:
    """Return the change of a window of a twentieth, and its error; one half chooses the window."""
    cut, found = slice(WINDOW // 2, EDGE - (WINDOW - 1) // 2), []
    x, right = (
        uniform_filter(v, (WINDOW, WINDOW, 1), mode="nearest")[cut, cut] for v in (x, right)
    )
    for half in (0, 1):
        value, error = _relative(x[..., half::2], right[..., half::2])
        at = np.unravel_index(np.argmax(np.abs(value) - 2 * error), value.shape)
        found.append(_relative(x[at][1 - half :: 2], right[at][1 - half :: 2]))
    values, errors = np.transpose(found)
    return float(values.mean()), float(np.sqrt((errors**2).sum()) / 2)


def _of_pixels(x: np.ndarray, right: np.ndarray) -> tuple[float, float]:
    """Return the mean square of differences over the squared mean; halves have no common noise."""
    one, other = (x[..., k::2].mean(axis=-1) - right[..., k::2].mean(axis=-1) for k in (0, 1))
    squares = (one * other).ravel() / right.mean() ** 2
    return float(squares.mean()), float(squares.std() / np.sqrt(squares.size))


# --- rows ---------------------------------------------------------------------------------------


def rows_of(scene: Scene, faults: Sequence[Fault] = FAULTS) -> Iterator[Row]:
    """Yield what tests say of right and of faulty renders of a scene."""
    batch = SPP // MEANS
    means = means_of(scene.reference, batch)
    rights = np.concatenate([scene.right(i) for i in range(RIGHT)], axis=-1)
    pool = np.concatenate([means_of(rights, batch).batches, means.batches], axis=-1)
    references = {b: Reference.of_samples(scene.reference, batches=n) for b, n in BATCHES.items()}

    def row(a: Means, budget: str, fault: str, change: Change | None = None) -> Row:
        samples = chd.Samples.from_array(a.batches, averaged=a.size)
        found = chd.contrast(samples, references[budget], alpha=ALPHA)
        told = found.outcome, found.image_p_value, found.detectable
        every = {"contrast": -np.log10(found.image_p_value), **scores(a, means)}
        return Row(scene.name, budget, fault, *told, every, change)

    for budget in BUDGETS:
        for a in mixed(rights, budget):
            yield row(a, budget, "")
    for fault in (NONE, *faults):
        render = scene.control() if fault is NONE else scene.faulty(fault)
        if render is not None:
            change = change_of(fault, render, pool, scene)
            for budget in BUDGETS:
                yield row(at_budget(render, budget), budget, fault.name, change)


# --- tables -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Found:
    """Which faults a test finds.

    Attributes
    ----------
    name
        Of the test.
    faulty
        For each row with a fault, whether it is found.
    right
        The share of right renders that it rejects.
    """

    name: str
    faulty: np.ndarray
    right: float


def found_by(rows: Sequence[Row]) -> list[Found]:
    """Return what tests find: ours at its alpha, all at the limits of right renders, published."""
    right, faulty = ([r for r in rows if (r.fault in RIGHT_ONES) == k] for k in (True, False))
    tests: dict[str, Callable[[Row], bool]] = {"contrast": lambda r: r.outcome == "differ"}
    for name in ("contrast", *SCORES):
        tests[f"{name}, tuned"] = partial(_beyond, name, _limits(name, right))
    for name, limit in published(ALPHA, EDGE**2).items():
        same = dict.fromkeys({(r.scene, r.budget) for r in rows}, limit)
        tests[f"{name}, published"] = partial(_beyond, name, same)
    return [
        Found(name, np.array([test(r) for r in faulty]), float(np.mean([test(r) for r in right])))
        for name, test in tests.items()
    ]


def _limits(name: str, right: Sequence[Row]) -> dict[tuple[str, str], float]:
    """Return the largest scores of right renders, by scene and budget."""
    found: dict[tuple[str, str], float] = {}
    for row in right:
        place = row.scene, row.budget
        found[place] = max(found.get(place, -np.inf), row.scores[name])
    return found


def _beyond(name: str, limits: Mapping[tuple[str, str], float], row: Row) -> bool:
    return row.scores[name] > limits[row.scene, row.budget]


def table(rows: Sequence[Row]) -> str:
    """Return the bugs found that change the image, by scene, budget and test, as text."""
    every = found_by(rows)
    faulty = [r for r in rows if r.fault not in RIGHT_ONES]
    changing = np.array([r.change.surely for r in faulty])
    places = list(dict.fromkeys((r.scene, r.budget) for r in faulty))
    lines = [
        f"{'found of bugs':28}" + "".join(f"{s[:8]:>9}" for s, _ in places) + "      all  false"
    ]
    lines.append(f"{'':28}" + "".join(f"{b:>9}" for _, b in places) + "           alarms")
    here = {p: np.array([(r.scene, r.budget) == p for r in faulty]) & changing for p in places}
    lines.append(f"{'(that change the image)':28}" + "".join(f"{h.sum():9}" for h in here.values()))
    lines[-1] += f"{changing.sum():9}"
    for found in every:
        counts = "".join(f"{found.faulty[h].sum():9}" for h in here.values())
        lines.append(f"{found.name:28}{counts}{found.faulty[changing].sum():9}  {found.right:.3f}")
    return "\n".join(lines)


def told(row: Row) -> str:
    """Return a row as text."""
    loss = row.detectable
    image, twentieth = row.change.image, row.change.twentieth
    return (
        f"{row.scene:12} {row.budget:4} {row.fault:40} {row.outcome:20} p {row.p_value:8.2g}  "
        f"image {image[0]:+.2%} ± {image[1]:.2%} (finds {loss['image']:.2%}), twentieth "
        f"{twentieth[0]:+.2%} ± {twentieth[1]:.2%} (tenth {loss['tenth']:.2%})"
    )


def _cell(change: Change | None) -> str:
    if change is None:
        return f"{'-':>14}"
    image, twentieth = (100 * x for x, _ in (change.image, change.twentieth))
    return f"{image:7.2f}{twentieth:6.1f}{'*' if change.surely else ' '}"


@pytest.fixture(scope="module")
def rows(tmp_path_factory) -> list[Row]:
    folder = Path(os.environ.get("CHDSTAT_BUGS", tmp_path_factory.mktemp("bugs")))
    every = bug_renders.scenes(folder)
    return [row for scene in every for row in rows_of(scene)]


def test_what_faults_change(as_benchmark, rows):
    """At least 40 faults change an image; the path tracer without a fault does not."""
    full = {(r.fault, r.scene): r.change for r in rows if r.budget == "2e6" and r.change}
    places = list(dict.fromkeys(scene for _, scene in full))
    print(
        "\nchange of the image and of the clearest twentieth, %; - if the scene has nothing of it"
    )
    print(f"{'':40}" + "".join(f"{scene:>14}" for scene in places))
    for fault in (NONE, *FAULTS):
        found = [full.get((fault.name, scene)) for scene in places]
        print(f"{fault.name:40}" + "".join(map(_cell, found)))
    changing = {fault for (fault, _), change in full.items() if change.surely}
    assert NONE.name not in changing
    assert len(changing) >= 40


def test_bugs_that_the_test_says_to_find(as_benchmark, rows):
    """95 % at 2e6 samples are found."""
    stated = [r for r in rows if r.budget == "2e6" and r.stated]
    missed = [r for r in stated if r.outcome != "differ"]
    print(f"\nfound {len(stated) - len(missed)} of {len(stated)}; missed:")
    print("\n".join(map(told, missed)))
    assert len(missed) <= 0.05 * len(stated)


def test_as_many_bugs_as_others(as_benchmark, rows):
    """At limits of the same right renders, no other test finds more; at alpha, few are rejected."""
    print("\n" + table(rows))
    own, first, *others = found_by(rows)
    faulty = [r for r in rows if r.fault not in RIGHT_ONES]
    for k, row in enumerate(faulty):
        by = [o.name for o in others if o.name.endswith("tuned") and o.faulty[k]]
        if by and not own.faulty[k]:
            print(f"{told(row)}: found by {', '.join(by)}")
    assert own.right <= 0.01
    changing = np.array([r.change.surely for r in faulty])
    for other in others:
        if other.name.endswith("tuned"):
            assert first.faulty[changing].sum() >= other.faulty[changing].sum(), other.name
