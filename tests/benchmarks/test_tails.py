"""How often the variance is trusted: of bodies alone, and of bodies with a rare heavy tail.

Run with ``pytest tests/benchmarks/test_tails.py --benchmark-only -s``.
"""

import numpy as np
import pytest
from scipy import stats

import chdstat as chd

ROWS = 400
BODIES = {
    "exponential": stats.expon(),
    "gamma 0.2": stats.gamma(0.2),
    "gamma 0.3": stats.gamma(0.3),
    "gamma 0.5": stats.gamma(0.5),
    "gamma 2": stats.gamma(2),
    "uniform": stats.uniform(),
    "Beta(2, 5)": stats.beta(2, 5),
    "|normal|": stats.halfnorm(),
    "log-normal 0.5": stats.lognorm(0.5),
    "Weibull 0.7": stats.weibull_min(0.7),
    "Weibull 1.5": stats.weibull_min(1.5),
}
TAILS = {
    "GPD 1": stats.genpareto(1.0),
    "Pareto 1.5": stats.genpareto(2 / 3),
    "|t| 1.5": stats.t(1.5),
    "Frechet 1.5": stats.invweibull(1.5),
}
SHARES, SIZES = (0.003, 0.01, 0.03, 0.1), tuple(2**i for i in range(7, 14))
RARE = [(share, samples) for share in SHARES for samples in SIZES if share * samples >= 20]
FEW = ((0.003, 8192), (0.01, 2048), (0.03, 1024), (0.1, 256), (0.1, 512))
"""Shares of a rare heavy tail and numbers of samples: 20 and more are of the tail."""
MUST = ("exponential", "gamma 0.5", "gamma 2", "uniform")


def _line(name, tail):
    verdicts = tail.variance_trusted, tail.variance_unidentified, tail.variance_suspect
    shares = "".join(f"{100 * v.mean():9.1f}" for v in verdicts)
    light = 100 * np.mean(tail.p_exponential < 0.05)
    far = np.nanmedian(tail.xi_far)
    return f"{name:34}{shares}{light:9.1f}{np.nanmedian(tail.xi):8.2f}{far:8.2f}"


HEADER = f"{'':34}{'trusted':>9}{'not id.':>9}{'suspect':>9}{'p < .05':>9}{'xi':>8}{'far':>8}"


@pytest.mark.parametrize("samples", [512, 2048, 8192])
def test_bodies_alone(benchmark, samples):
    rng = np.random.default_rng(samples)
    x = {name: body.rvs((ROWS, samples), random_state=rng) for name, body in BODIES.items()}
    found = benchmark.pedantic(
        lambda: {name: chd.fit.tail_index(values) for name, values in x.items()}, rounds=1
    )
    print(f"\n{HEADER}")
    for name, tail in found.items():
        print(_line(f"{name}, {samples} samples", tail))
    assert all(found[name].variance_trusted.mean() >= 0.9 - 0.045 for name in MUST)


@pytest.mark.parametrize("heavy", TAILS)
def test_rare_heavy_tails(benchmark, heavy):
    rng = np.random.default_rng(len(heavy))
    names = [name for name in BODIES if not name.startswith("gamma")]

    def draw(body, share, samples):
        shape = (ROWS, samples)
        rare = rng.random(shape) < share
        tail = 5 + np.abs(TAILS[heavy].rvs(shape, random_state=rng))
        return np.where(rare, tail, BODIES[body].rvs(shape, random_state=rng))

    def run():
        return {
            (body, share, samples): chd.fit.tail_index(draw(body, share, samples))
            for body in names
            for share, samples in (RARE if (heavy, body) == ("GPD 1", "exponential") else FEW)
        }

    found = benchmark.pedantic(run, rounds=1)
    print(f"\n{HEADER}")
    for (body, share, samples), tail in found.items():
        print(_line(f"{body} + {share:g} {heavy}, {samples}", tail))
    if heavy == "GPD 1":
        trusted = [t.variance_trusted.mean() for (b, *_), t in found.items() if b == "exponential"]
        assert max(trusted) <= 0.05 + 0.033
