"""The report on several renders."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import chdstat as chd
from chdstat.errors import InputError
from chdstat.reporting.documents import pages_of
from chdstat.reporting.ranking_report import _ranking_document
from chdstat.samples import Samples
from tests.pdf import text_of

SIZE = 24


@pytest.fixture(scope="module")
def renders():
    """Two equal renders and one with many nulls, by two integrators."""
    rng = np.random.default_rng(1)
    x = rng.gamma(4.0, 0.25, size=(3, SIZE, SIZE, 3, 64)).astype(np.float32)
    x[2] *= 4 * (rng.random((SIZE, SIZE, 1, 64)) < 0.25)
    kinds = ("path", "path", "guided")
    return [
        Samples.from_array(one, scene="hall", integrator={"type": kind}, render_seconds=2.0)
        for one, kind in zip(x, kinds, strict=True)
    ]


def test_it_says_which_is_noisier_where_and_why(renders, tmp_path):
    path = chd.report(renders, tmp_path / "found.pdf")
    text = text_of(path)
    assert pages_of(path) <= 3
    assert "A and B cannot be told apart" in text or "B and A cannot be told apart" in text
    assert "1 to 2" in text
    assert "Least noisy" in text
    assert "Most paths find no light" in text
    assert "Integrator path path guided" in text
    assert "5.0 %; grey where" in text.replace("\N{NO-BREAK SPACE}", " ")


def test_what_it_cannot_say_is_refused(renders, tmp_path):
    target = tmp_path / "found.pdf"
    for source, options, named in (
        ([renders[0], "cornell-box"], {}, "finished stores of one view, got cornell-box"),
        (renders, {"spp": 8}, "takes no spp"),
        (renders, {"contents": "full"}, "takes no contents"),
    ):
        with pytest.raises(InputError, match=named):
            chd.report(source, target, **options)
    means = chd.contrast({"A": renders[0]}, renders[1])
    with pytest.raises(InputError, match="ranked by their noise"):
        means.report(target)
    assert not target.exists()


def test_what_a_pattern_means_is_said_once_and_parts_are_counted(renders):
    found = chd.contrast([renders[0], renders[2], renders[2].isel(y=slice(None, None))])
    causes, examples = found.noise.causes, found.noise.examples
    assert [cause.pattern for cause in causes].count("null_heavy") == 2
    content = _ranking_document(found).content
    assert sum(row["meaning"] != "" for row in content["causes"]) == len(
        {cause.pattern for cause in causes}
    )
    for count, words in enumerate(("", "one part", "two parts")):
        noise = replace(found.noise, examples=examples[:1] * count)
        assert words in _ranking_document(replace(found, noise=noise)).content["magnified"]
