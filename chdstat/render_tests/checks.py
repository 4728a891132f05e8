"""Checks: whether a render has the light of its reference, and what becomes of the reference.

A first look that finds no difference passes. Otherwise, a second look decides, with other samples,
twice as many. A false alarm needs one in the second look, at the level of the call, whatever the
first one says; so the rule keeps that level, and few right renders are called into question twice.
Samples that are there already get one look.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import count

import numpy as np

from chdstat._core.arrays import whole
from chdstat._core.display import percent
from chdstat.errors import InputError, StoreError, check_probability
from chdstat.inference import Contrast, contrast
from chdstat.inference.contrasts import LEAST_TERMS
from chdstat.inference.references import BATCHES, OF_TEST, Reference
from chdstat.io import write_reference
from chdstat.render_tests.draws import Render, Seeds, render_of, unlike
from chdstat.render_tests.pages import make_folder, numbers_of, thumbnails, write_page
from chdstat.render_tests.verdicts import PASSED, Outcome, RenderCheck, RenderVerdict

_SIDES = (r"\b(?:render )?A\b", r"\b(?:render )?B\b")


def verdict_on(render: object, asked: RenderCheck) -> tuple[RenderVerdict, Contrast | None]:
    """Return the verdict of a call, and the contrast that it rests on, if there is one.

    Raises
    ------
    InputError, StoreError
        If the render or the reference is not what it should be.
    """
    if asked.spp is not None:
        whole("spp", asked.spp, least=1)
    if asked.finds is not None:
        check_probability(finds=asked.finds)
    drawn, seeds = (
        render_of(render, asked.name),
        Seeds(asked.name, whole("seed", asked.seed, least=0)),
    )
    if asked.update:
        return _update(drawn, asked, seeds)
    return _check(drawn, asked, seeds)


def _check(
    drawn: Render, asked: RenderCheck, seeds: Seeds
) -> tuple[RenderVerdict, Contrast | None]:
    reference = _read(asked)
    spp = asked.spp
    if drawn.again and spp is None:
        if reference.spp is None:
            message = f"give spp=: {asked.reference} does not say how many samples it has"
            raise InputError(message)
        spp = max(1, reference.spp // OF_TEST)
    if not drawn.again and _same(drawn, reference):
        sentence = "its samples are those of the reference: nothing has changed"
        return _verdict(asked, "no difference found", sentence, reference, 1, reference.spp), None
    passes, looks = map(seeds.of_test, count()), 1
    options = {"alpha": asked.alpha, "finds": asked.finds}
    found = drawn.compare(reference, spp, passes, **options)
    if drawn.again and spp is not None and _outcome(found, asked) not in (*PASSED, "too weak"):
        found, looks = drawn.compare(reference, 2 * spp, passes, **options), 2
    outcome = _outcome(found, asked)
    said = _in_words(found, "the render", "the reference")
    if outcome == "too weak":
        said = f"{said} {_too_weak(found, asked)}"
    verdict = _verdict(asked, outcome, said, reference, looks, found.spp[0], found)
    return verdict, found


def _outcome(found: Contrast, asked: RenderCheck) -> Outcome:
    if found.outcome == "differ":
        return "differ"
    if (np.asarray(found.maps["bad_a"] == 1) & np.asarray(found.maps["bad_b"] < 1)).any():
        return "bad pixels"
    if found.outcome == "cannot tell":
        return "cannot tell"
    if asked.finds is not None and not found.detectable["image"] <= asked.finds:
        return "too weak"
    return "no difference found"


def _too_weak(found: Contrast, asked: RenderCheck) -> str:
    """Return what is needed to find a loss as small as is asked for."""
    if asked.finds is None or not found.detectable["image"] < 1:
        return "That is not enough: render more samples."
    more = (found.detectable["image"] / asked.finds) ** 2
    spp = int(np.ceil(found.spp[0] * more))
    return (
        f"finds={asked.finds:g} asks for {percent(asked.finds)}: give about spp={spp}, and write a "
        "reference of as many times more samples (pytest --render-update)."
    )


def _in_words(found: Contrast, a: str, b: str) -> str:
    """Return the conclusion, with words for A and B."""
    text = re.sub(_SIDES[1], b, re.sub(_SIDES[0], a, found.conclusion))
    return re.sub(r"(^|\. )(the)", lambda m: m[1] + m[2].capitalize(), text)


def _verdict(
    asked: RenderCheck,
    outcome: Outcome,
    sentence: str,
    reference: Reference,
    looks: int,
    spp: int | None = None,
    found: Contrast | None = None,
) -> RenderVerdict:
    known = RenderVerdict(
        asked.name,
        asked.test,
        asked.alpha,
        outcome,
        sentence.rstrip("."),
        looks,
        spp,
        reference.spp,
    )
    if found is None:
        return known
    finite = {k: v if np.isfinite(v) else None for k, v in found.detectable.items()}
    known = replace(
        known,
        p_value=found.image_p_value if np.isfinite(found.image_p_value) else None,
        image=finite.get("image"),
        tenth=finite.get("tenth"),
        thumbnails=thumbnails(found),
    )
    known = replace(known, numbers=numbers_of(known, found))
    if known.passed and not asked.always:
        return known
    return write_page(known, found, asked.report, asked.page)


# --- references -----------------------------------------------------------------------------------


def _read(asked: RenderCheck) -> Reference:
    """Return the reference.

    Raises
    ------
    StoreError
        If there is none, or it is damaged.
    """
    if not asked.reference.exists():
        message = (
            f"there is no reference {asked.reference}: look at the render, and if it is right, "
            "write one with pytest --render-update"
        )
        raise StoreError(message)
    try:
        return Reference.read(asked.reference)
    except (InputError, StoreError) as error:
        message = f"{error}; get the file back, or renew it with pytest --render-update"
        raise StoreError(message) from error


def _same(drawn: Render, reference: Reference) -> bool:
    """Return whether a reference was made of these very samples."""
    try:
        own = drawn.reference(None, iter(()))
    except InputError:  # too few for a reference
        return False
    return own.spp == reference.spp and own.shape == reference.shape and _equal(own, reference)


def _equal(one: Reference, other: Reference) -> bool:
    means = [x.mean.astype(np.float32) for x in (one, other)]
    return np.array_equal(means[0], means[1], equal_nan=True)


def _update(
    drawn: Render, asked: RenderCheck, seeds: Seeds
) -> tuple[RenderVerdict, Contrast | None]:
    asked.claim(asked.reference)
    folder = asked.reference.parent
    make_folder(folder)
    if not os.access(folder, os.W_OK):
        message = f"cannot write references to {folder}: it is read-only"
        raise StoreError(message)
    old, why = _old(asked)
    if drawn.again and asked.spp is None and (old is None or old.spp is None):
        message = f"{asked.name} has no reference yet: give spp=, the samples per pixel of the test"
        raise InputError(message)
    spp = asked.spp
    if drawn.again and spp is None and old is not None and old.spp is not None:
        spp = max(1, old.spp // OF_TEST)
    other = old is not None and old.attrs.get("seed") == seeds.of_reference(0, other=False)
    new = drawn.reference(spp, _of_reference(seeds, other=other))
    if drawn.again:
        about = {"scene": asked.name, **new.attrs, "seed": seeds.of_reference(0, other=other)}
        new = replace(new, attrs=about)
    _check_light(new, asked)
    outcome: Outcome = "written"
    found, sentence = None, why or f"{BATCHES} batches, {new.spp} samples per pixel"
    if old is not None:
        outcome, sentence, found = _renewed(new, old, asked)
    if outcome in ("written", "replaced"):
        write_reference(new, asked.reference)
    return _verdict(asked, outcome, sentence, new, 1, spp, found), found


def _check_light(new: Reference, asked: RenderCheck) -> None:
    """Refuse a reference that would not see some pixels, or any light, or of too few samples."""
    if asked.spp is not None:
        whole("spp", asked.spp, least=LEAST_TERMS)
    bad = ~np.isfinite(new.mean).all(axis=-1)
    if bad.any():
        y, x = np.argwhere(bad)[0]
        message = (
            f"{asked.name}: all samples are NaN or infinite in {bad.sum()} of {bad.size} pixels "
            f"(first at y {y}, x {x}), which no test would see: mend the render, then write its "
            "reference"
        )
        raise InputError(message)
    if not new.mean.any():
        message = f"{asked.name}: the render is black, so that no test would see its light"
        raise InputError(message)


def _of_reference(seeds: Seeds, *, other: bool) -> Iterator[int]:
    return (seeds.of_reference(i, other=other) for i in count())


def _old(asked: RenderCheck) -> tuple[Reference | None, str]:
    """Return the reference that is there, or None and why it can be replaced without a test."""
    if not asked.reference.exists():
        return None, ""
    try:
        return Reference.read(asked.reference), ""
    except (InputError, StoreError):
        return None, "written in place of a damaged file"


def _renewed(
    new: Reference, old: Reference, asked: RenderCheck
) -> tuple[Outcome, str, Contrast | None]:
    """Return whether a reference takes the place of another one, and why."""
    if new.shape != old.shape:
        said = unlike("the new render has", new.shape, old.shape, "in the old reference")
        return "replaced", said, None
    if _equal(new, old) and new.spp == old.spp:
        return "kept", "the samples are the same: nothing has changed", None
    found = contrast(new, old, alpha=asked.alpha)
    said = _in_words(found, "the new render", "the old reference")
    if found.outcome == "differ":
        return "replaced", said, found
    if found.outcome == "cannot tell":
        advice = f"the old reference is kept; delete {asked.reference.name} to replace it anyway"
        return "cannot tell", f"{said} {advice}", found
    if old.spp is None or old.batches is None or (new.spp or 0) > old.spp:
        return "replaced", f"it now has {new.spp} samples per pixel. {said}", found
    return "kept", said, found
