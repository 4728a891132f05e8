"""How much light the clamp of a scene file takes, from samples that were drawn without it."""

from __future__ import annotations

import math
import re

import numpy as np

from chdstat.samples import Samples

_CLAMP_IS_OFF = re.compile(r"clamping of \w+ light \(([^)]+)\) is off")
"""What notes of a recording of Cycles say of a clamp in the file, with its level."""


def clamped_share(samples: Samples) -> tuple[float, float] | None:
    """Return the level of the file's clamp and the most light that it can take; None without one.

    Cycles scales each contribution of a path down to a mean over channels of the level. A sample is
    the sum of its contributions, so that it loses no more than if it were clamped itself. The
    share of the light that samples lose so is therefore a bound. If direct and indirect light have
    levels, the lower one counts. A sample with a bad value is left out.

    Examples
    --------
    >>> x = np.ones((1, 1, 3, 4)) * [1, 1, 1, 17]
    >>> notes = ["clamping of indirect light (10) is off"]
    >>> clamped_share(Samples.from_array(x, notes=notes))
    (10.0, 0.35)
    """
    said = map(_CLAMP_IS_OFF.fullmatch, samples.attrs.get("notes") or ())
    level = min((float(found[1]) for found in said if found), default=math.inf)
    if level == math.inf:
        return None
    light = kept = 0.0
    for _, _, _, x in samples.blocks():
        with np.errstate(invalid="ignore"):  # of infinite samples
            gray = x.mean(axis=2, dtype=np.float64)
        gray = gray[np.isfinite(gray)]
        light += gray.sum()
        kept += np.minimum(gray, level).sum()
    return (level, float(1 - kept / light)) if light > 0 else None
