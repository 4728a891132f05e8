"""Clamps: what samples would have been, had they not been cut off at a value.

Renderers clamp radiance against fireflies. A law that is cut off is no longer of its family: the
rest looks like several components. So the clamped samples, which are an atom at the top of the row,
take part in a fit as the tail that the law leaves above the clamp (the EM algorithm for censored
samples: Dempster, Laird and Rubin, "Maximum likelihood from incomplete data via the EM algorithm",
1977, section 4.2, doi:10.1111/j.2517-6161.1977.tb01600.x).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from chdstat._core.positive import Part, PositivePart
from chdstat.fit.atoms import Atoms
from chdstat.fit.em import MixtureFamily
from chdstat.fit.families import estimate_part, get_family
from chdstat.fit.family import take_part

__all__ = ["before_clamps"]

_IMPUTATIONS, _LAMP = 12, 0.1
"""How often clamped samples are drawn anew; and the share of an atom at the top that one law leaves
to its tail, below which the atom is a lamp, not a clamp."""


def before_clamps(part: Part, atoms: Atoms, family: MixtureFamily) -> Part:
    """Return the continuous rest with the samples of an atom at its top as they may have been.

    They become the quantiles of the tail that one component leaves above the clamp, which is fitted
    to all of them in turn. Rows without a clamp stay as they are.
    """
    if not isinstance(part, PositivePart) or not isinstance(atoms.rest, PositivePart):
        return atoms.rest
    last = np.maximum(part.n - 1, 0)[..., np.newaxis]
    top = np.take_along_axis(part.sorted, last, axis=-1).astype(np.float64)
    held = np.where(atoms.values == top, atoms.counts, 0).sum(axis=-1)
    rows = np.flatnonzero((held > 0) & ~atoms.discrete)
    if not rows.size:
        return atoms.rest
    described, rest, whole = get_family(family), take_part(atoms.rest, rows), take_part(part, rows)
    top, held = top.reshape(-1)[rows], held.reshape(-1)[rows]
    clamped = whole.positive & ~rest.positive & (whole.x == top[:, np.newaxis])
    parameters = estimate_part(rest, described)[0].parameters
    with np.errstate(invalid="ignore"):
        clamped &= (described.distribution(parameters).sf(top) * rest.n > _LAMP * held)[:, None]
    row, at = np.nonzero(clamped)
    share = (np.cumsum(clamped, axis=-1)[row, at] - 0.5) / held[row]
    filled = replace(
        rest,
        x=rest.x.copy(),
        positive=rest.positive | clamped,
        n=rest.n + np.count_nonzero(clamped, axis=-1),
    )
    for _ in range(_IMPUTATIONS):
        law = described.distribution({name: value[row] for name, value in parameters.items()})
        filled.x[row, at] = law.isf(share * law.sf(top[row]))
        filled = replace(filled)
        parameters = estimate_part(filled, described)[0].parameters
    samples = part.x.shape[-1]
    x, positive = (np.array(v).reshape(-1, samples) for v in (atoms.rest.x, atoms.rest.positive))
    x[rows], positive[rows] = filled.x, filled.positive
    n = atoms.rest.n.reshape(-1).copy()
    n[rows] = filled.n
    shape = part.x.shape
    return PositivePart(
        np.asarray(x.reshape(shape), dtype=np.float64),
        np.asarray(positive.reshape(shape), dtype=bool),
        n.reshape(part.n.shape),
        *(part.n_null, part.n_zero, part.n_negative, part.n_bad),
    )
