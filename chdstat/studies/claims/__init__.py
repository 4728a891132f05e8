"""Claims of the paper, and a few of ours, as numbers with intervals and verdicts, on any scene.

`CLAIMS` lists them, each with the function that measures it. `SceneData` holds the data of a scene.
`find` tests all claims on it and returns a `Finding` for each.

The decorator `chdstat.studies.claim.claim` registers a claim, in any module of this folder.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Sequence

from chdstat.inference.findings import ClaimTest, Finding, PlotData
from chdstat.studies.claim import ENTERED, Claim
from chdstat.studies.scene_data import SceneData

__all__ = ["CLAIMS", "Claim", "ClaimTest", "Finding", "PlotData", "SceneData", "find"]

for _leaf in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_leaf.name}")
CLAIMS = tuple(ENTERED[number] for number in sorted(ENTERED))
"""The claims of Elek, Thomas and Forbes 2019, "Learning patterns in sample distributions for Monte
Carlo variance reduction", in the order of the study. Those from 30 to 33 are our own, about path
guiding and adaptive sampling, which the paper leaves for later."""


def find(data: SceneData, *, others: Sequence[SceneData] = ()) -> list[Finding]:
    """Test all claims of the paper in one scene, compared with other scenes if there are any.

    A claim is *supported* if the intervals of all its tests lie within the ranges that the claim
    states, *not supported* if any interval lies wholly outside, and otherwise undecided. Regions
    with the same phenomenon are combined, each as a stratum. Intervals come from a bootstrap over
    blocks of pixels; for the tests of one claim, they hold simultaneously at 95 % (Bonferroni). A
    verdict is about the image at hand, or about a model that was trained on it; `Finding.about`
    says which, and whether the scene is a remake of the paper's. There is no correction between
    claims: each has a 5 % chance of a wrong verdict.

    Parameters
    ----------
    data
        The scene.
    others
        Further scenes, for the claims that compare scenes.

    Returns
    -------
    list of Finding
        A finding for each of `CLAIMS`, in order. If data are missing, the verdict is "cannot tell",
        and the reason names them.

    Raises
    ------
    InputError
        If the samples have neither 1 nor 3 channels.

    References
    ----------
    O. Elek, M. M. Thomas, A. Forbes, "Learning Patterns in Sample Distributions for Monte Carlo
    Variance Reduction", 2019.

    Examples
    --------
    >>> import chdstat as chd
    >>> from chdstat.samples import Region
    >>> samples = chd.simulate("gamma", shape=(8, 8), spp=16)
    >>> found = find(SceneData("simulated", samples, (Region("wall", "diffuse", (0, 0, 1, 1)),)))
    >>> found[1].name, found[1].verdict, found[1].reason
    ('diffuse objects', 'cannot tell', 'Needs 128 spp, has 16.')
    """
    return [claim.find(data, others) for claim in CLAIMS]
