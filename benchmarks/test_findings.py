"""How often findings are right in worlds whose truth is known: verdicts, a row a world.

Run with ``pytest --benchmark-only -s benchmarks/test_findings.py``. CHDSTAT_WORLDS says how
many worlds of each kind are drawn, in place of 50 (ties: eight times as many).
"""

import os
from collections import Counter

import numpy as np
import pytest

from chdstat.studies.claims import CLAIMS
from tests.studies.claims import worlds

WORLDS = int(os.environ.get("CHDSTAT_WORLDS", "50"))


BY_NUMBER = {claim.number: claim for claim in CLAIMS}


def verdicts(number, world, *, count=WORLDS, spp=512):
    found = Counter()
    for seed in range(count):
        first, *others = world(np.random.default_rng([number, seed]), spp)
        found[BY_NUMBER[number].find(first, others).verdict] += 1
    return {kind: found[kind] / count for kind in ("supported", "not supported", "cannot tell")}


def told(name, shares):
    row = ", ".join(f"{kind} {share:.1%}" for kind, share in shares.items())
    print(f"\n  {name}: {row}", end="")


TIES = {
    "tie of two": (0.5, 0.5),
    "tie of three": (1 / 3, 1 / 3, 1 / 3),
    "tie of four": (0.25, 0.25, 0.25, 0.25),
    "tie of two, a third below": (0.4, 0.4, 0.2),
    "lead .03 over one": (0.515, 0.485),
    "lead .04 over three": (0.28, 0.24, 0.24, 0.24),
    "lead .10 over one": (0.55, 0.45),
    "lead .20 over one": (0.6, 0.4),
    "behind by .03": (0.485, 0.515),
    "behind by .10": (0.45, 0.55),
}


@pytest.mark.usefixtures("as_benchmark")
@pytest.mark.parametrize("name", TIES)
def test_the_most_frequent_family(name):
    """Of 24 x 24 pixels; wrong is "not supported" where gamma leads or ties, else "supported"."""
    shares = TIES[name]
    found = verdicts(14, worlds.family_shares(*shares), count=8 * WORLDS, spp=128)
    told(f"14, {name}", found)
    lead = shares[0] - max(shares[1:])
    wrong = found["supported" if lead < 0 else "not supported"]
    slack = 3 * np.sqrt(0.025 / (8 * WORLDS))
    assert wrong <= 0.025 + slack
    if lead == 0:
        assert found["supported"] + found["not supported"] <= 0.05 + slack


FIREFLIES = {
    "the same CHD, 1e-3 of the samples x1000, 12 x 12": (True, worlds.fireflies()),
    "the same CHD, 1e-3 of the samples x1000": (True, worlds.fireflies(edge=24)),
    "the same CHD, 1e-2 x100": (True, worlds.fireflies(0.01, 100, edge=24)),
    "the same CHD, 5e-2 x80": (True, worlds.fireflies(0.05, 80, edge=24)),
    "the same CHD, 1e-4 x10000": (True, worlds.fireflies(1e-4, 1e4, edge=24)),
    "5 % of pixels: 5 % of samples x80": (False, worlds.fireflies(0.05, 80, 0.05, 24)),
    "5 % of pixels: 5 % of samples x30": (False, worlds.fireflies(0.05, 30, 0.05, 24)),
    "5 % of pixels: 1 % of samples x400": (False, worlds.fireflies(0.01, 400, 0.05, 24)),
    "5 % of pixels: .1 % of samples x4000": (False, worlds.fireflies(1e-3, 4000, 0.05, 24)),
    "5 % of pixels x12": (False, worlds.fireflies(1, 12, 0.05, 24)),
}


@pytest.mark.usefixtures("as_benchmark")
@pytest.mark.parametrize("name", FIREFLIES)
def test_fireflies_and_their_neighbours(name):
    same, world = FIREFLIES[name]
    found = verdicts(8, world)
    told(f"8, {name}", found)
    assert found["not supported" if same else "supported"] <= 0.05


@pytest.mark.usefixtures("as_benchmark")
@pytest.mark.parametrize("spp", [128, 512, 2048])
@pytest.mark.parametrize("name", worlds.HARD_EDGES)
def test_hard_edges_are_no_penumbra(name, spp):
    """One mode in every pixel, however many samples there are: never "supported"."""
    world = worlds.lit_across(worlds.HARD_EDGES[name])
    found = verdicts(6, world, count=max(WORLDS // 5, 1), spp=spp)
    told(f"6, {name}, {spp} spp", found)
    assert found["supported"] == 0


@pytest.mark.usefixtures("as_benchmark")
def test_two_modes_across_a_penumbra_are_found():
    """The control: what the claim describes is supported."""
    found = verdicts(6, worlds.penumbra(True), count=max(WORLDS // 5, 1))
    told("6, two modes", found)
    assert found["supported"] >= 0.9
