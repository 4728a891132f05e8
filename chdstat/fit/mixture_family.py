"""Mixture family: mixtures of a fixed number of components, as a row of the table of families.

What is made for families, as the bootstrap is, does for mixtures, too. The parameters are those of
each component, numbered: ``mu_1``, ``sigma_1``, ``weight_1`` and so on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from chdstat._core.positive import Floats
from chdstat.fit.components import MixtureFamily
from chdstat.fit.families import get_family
from chdstat.fit.family import Estimate, Family, Parameters, summed
from chdstat.fit.mixtures import mixture_of_part
from chdstat.fit.results import Mixture
from chdstat.fit.weighted_samples import Points
from chdstat.summary.dispatch import Part

__all__ = ["mixture_family", "mixture_parameters"]


def mixture_family(component: MixtureFamily, k: int) -> Family:
    """Return the mixtures of `k` components."""
    base = get_family(component)

    def estimate(part: Part, _near: Parameters | None) -> Estimate:
        found = mixture_of_part(part, k, family=component)
        return Estimate(
            parameters=mixture_parameters(found, k),
            standard_errors=_numbered(found.standard_errors, k),
            converged=found.converged,
        )

    def log_density(points: Points, parameters: Parameters) -> Floats:
        densities = [
            base.log_density(points, one) + np.log(weight)[:, np.newaxis]
            for weight, one in _components(parameters, k)
        ]
        return np.asarray(np.logaddexp.reduce(densities))

    return Family(
        name=f"{component}_mixture",
        label=f"mixture of {base.label}",
        documentation=__doc__,
        units={
            f"{name}_{i + 1}": unit
            for i in range(k)
            for name, unit in {**base.units, "weight": "1"}.items()
        },
        estimate=estimate,
        log_likelihood=summed(log_density),
        log_density=log_density,
        distribution=lambda parameters: _Distribution(base, parameters, k),
    )


def mixture_parameters(mixture: Mixture, k: int) -> dict[str, Floats]:
    """Return the parameters of the first `k` components by numbered name, each of shape (...)."""
    return _numbered({**mixture.parameters, "weight": mixture.weights}, k)


@dataclass(frozen=True)
class _Distribution:
    """What is needed of SciPy's distributions."""

    base: Family
    parameters: Parameters
    k: int

    def cdf(self, x: Floats) -> Floats:
        """Return P(X <= x)."""
        return self._mix("cdf", x)

    def sf(self, x: Floats) -> Floats:
        """Return P(X > x)."""
        return self._mix("sf", x)

    def rvs(self, size: tuple[int, ...], random_state: np.random.Generator) -> Floats:
        """Draw samples."""
        # A sample is of the component in whose share of (0, 1) its number lies.
        number, drawn = random_state.random(size), np.zeros(size)
        below = np.zeros(1)
        for i, (weight, one) in enumerate(_components(self.parameters, self.k)):
            values = self.base.distribution(one).rvs(size=size, random_state=random_state)
            drawn = np.where(number >= below, values, drawn) if i else values
            below = below + weight
        return np.asarray(drawn)

    def _mix(self, name: str, x: Floats) -> Floats:
        return np.asarray(
            sum(
                weight * getattr(self.base.distribution(one), name)(x)
                for weight, one in _components(self.parameters, self.k)
            )
        )


def _numbered(values: Mapping[str, Floats], k: int) -> dict[str, Floats]:
    return {f"{name}_{i + 1}": v[..., i] for i in range(k) for name, v in values.items()}


def _components(parameters: Parameters, k: int) -> list[tuple[Floats, dict[str, Floats]]]:
    """Return the weight and the parameters of each component."""
    components = []
    for i in range(1, k + 1):
        mark = f"_{i}"
        one = {n.removesuffix(mark): v for n, v in parameters.items() if n.endswith(mark)}
        components.append((one.pop("weight"), one))
    return components
