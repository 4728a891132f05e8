"""Topics: distributions that many histograms are mixtures of, found from the histograms alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from chdstat._arrays import spans

__all__ = ["topic_histograms"]

Counts = npt.NDArray[np.float32]

_CHUNK = 512
"""Histograms worked on at once: they and their ratios stay in the cache."""
_POOLED = 0.2
"""Share of the pooled histogram in a first topic; without it no topic could take up a new bin."""
_LEAST = 1e-3
"""Weight of the pooled histogram among the counts of a topic: no probability becomes 0."""


def topic_histograms(
    counts: Counts, *, topics: int, iterations: int, rng: np.random.Generator
) -> Counts:
    r"""Describe every histogram as a mixture of a few topics that all of them share.

    Maximises ``sum_jb c_jb log sum_k theta_jk phi_kb`` by expectation-maximisation, from topics
    that are histograms drawn at random. What only noise tells apart becomes equal.

    Parameters
    ----------
    counts
        c, shape (row, bin), not negative; every row and the first topics drawn hold a count.
    topics
        How many; no more than there are rows.
    iterations
        Of expectation-maximisation.
    rng
        Draws the rows that are the first topics.

    Returns
    -------
    ndarray
        Probabilities theta phi, shape (row, bin); each row adds up to 1.

    References
    ----------
    T. Hofmann, "Probabilistic latent semantic indexing", SIGIR 1999, doi:10.1145/312624.312649,
    equations 3 to 6.
    """
    number = min(topics, len(counts))
    pooled = counts.mean(axis=0)
    first = counts[rng.choice(len(counts), number, replace=False)]
    phi = _normalised(first + _POOLED * pooled + _LEAST)
    theta = np.full((len(counts), number), 1 / number, np.float32)
    for _ in range(iterations):
        found = np.zeros_like(phi)
        for part in spans(len(counts), _CHUNK):
            ratio = counts[part] / _positive(theta[part] @ phi)
            found += theta[part].T @ ratio
            theta[part] = _normalised(theta[part] * (ratio @ phi.T))
        phi = _normalised(phi * found + _LEAST * pooled)
    return np.asarray(theta @ phi)


def _positive(values: Counts) -> Counts:
    return np.maximum(values, np.float32(1e-20))


def _normalised(rows: npt.NDArray[Any]) -> Counts:
    return np.asarray(rows / _positive(rows.sum(axis=-1, keepdims=True)), np.float32)
