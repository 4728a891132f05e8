"""Claims in a report: every part with its number, and what stands beside it apart from it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from chdstat.comparison import Interval
from chdstat.reporting.content import claim_content, finding_content, with_others
from chdstat.reporting.figures import claim_figures
from chdstat.studies.claims import CLAIMS, ClaimTest, Finding, PlotData

CLAIM = CLAIMS[14]


def part(low, high, unit="1"):
    return ClaimTest("share", Interval((low + high) / 2, low, high), least=0.5, unit=unit)


def finding(*parts, **more):
    about = {"number": 15, "name": CLAIM.name, "claim": CLAIM.claim, "about": "About this image."}
    return Finding(parts, scene="box", spp=64, **about, **more)


@pytest.fixture
def both():
    other = finding(part(0.1, 0.2))
    return finding(part(0.6, 0.8), other_models={"mine": other})


def test_each_part_has_its_number_and_what_was_claimed(both):
    content = finding_content(both)
    assert content["parts"] == [
        {
            "name": "share",
            "value": "0.700",
            "interval": "0.600 to 0.800",
            "claimed": "at least 0.5",
            "verdict": "supported",
        }
    ]
    assert json.dumps(content)


def test_a_part_without_an_interval_says_so():
    unknown = part(np.nan, np.nan, "decade^1/2")
    (shown,) = finding_content(finding(unknown))["parts"]
    assert (shown["name"], shown["value"], shown["interval"]) == ("share (√decade)", "—", "—")
    assert "no interval" in str(unknown)


def test_a_verdict_is_that_of_the_claim_and_not_of_what_stands_beside_it(both):
    (beside,) = finding_content(both)["beside"]
    assert (beside["name"], beside["verdict"]) == ("mine", "not supported")
    rows = claim_content(CLAIM, {"box": both})["rows"]
    assert [(row["scenes"], row["verdict"]) for row in rows] == [
        (["box"], "supported"),
        (["box, mine"], "not supported"),
    ]
    assert list(with_others({"box": both})) == ["box", "box, mine"]
    (figure,) = claim_figures(15, {"box": both}).values()
    assert [text.get_text() for text in figure.axes[0].get_yticklabels()] == list(
        with_others({"box": both})
    )


def test_what_cannot_be_told_says_what_is_needed():
    assert finding_content(finding())["needs"] == "Nothing was measured."
    assert finding_content(finding(part(0.6, 0.8)))["needs"] == ""


def test_plots_of_several_claims_have_labels_that_fit_their_panels():
    long = "log10 relative variance around its region's mean"
    x = np.arange(5.0)
    one = finding(plot_data=PlotData("curves", {"a": (x, x)}, "x", long))
    two = replace(one, plot_data=PlotData("bars", {"a": (x[:1], x[:1])}, y_label="share"))
    figure = claim_figures(15, {"1": one, "2": two})["plots15"]
    assert max(len(line) for line in figure.axes[0].get_ylabel().splitlines()) < 30
    assert claim_figures(15, {"none": finding()}) == {}
