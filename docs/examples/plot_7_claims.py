"""
The paper's claims, tested in a scene
=====================================

Elek, Thomas and Forbes (2019) looked at distributions and described them. `chdstat.studies.claims`
turns each description into statistics with intervals, and says whether they bear it out.
"""

# %%
# A scene with named regions
# --------------------------
#
# A built-in scene comes with regions, each inside one phenomenon: a wall lit diffusely, a mirror,
# the edge of a shadow. For another scene, `chdstat.rendering.recipes.choose_regions` finds some.

import chdstat as chd
from chdstat import viz
from chdstat.rendering import recipes
from chdstat.studies import claims

samples = chd.render("bathroom", spp=512, size=(64, 64), seed=1, backend="scalar")
regions = recipes.regions_of(samples)
data = claims.SceneData("bathroom", samples, regions)
for region in regions[:6]:
    print(f"{region.name:12} {region.phenomenon:16} {region.note}")

# %%
# Test
# ----
#
# A claim is supported where the intervals of all its tests lie in the range that it states, and not
# supported where one lies wholly outside. Otherwise it is undecided, and the reason says what is
# missing: here another scene, another path length, and a comparison of estimators.

found = claims.find(data)
for finding in found:
    print(f"{finding.number:2} {finding.name:20} {finding.verdict}")

# %%
# One of them in numbers
# ----------------------
#
# Every test of a claim has a statistic, its interval, and the range that was claimed.

indirect = found[4]
print(indirect.claim)
for test in indirect.tests:
    print(" ", test)

# %%
# What they rest on
# -----------------
#
# Each finding carries what its figure draws.

shown = [f for f in found if f.plot_data.series][:8]
viz.finding_plots({f"{f.number} {f.name}": f.plot_data for f in shown})

# %%
# Many scenes
# -----------
#
# ``chdstat study bathroom fog caustic -o study.pdf`` renders each scene, and again with another
# seed, with shorter paths and by another integrator; it asks all claims and typesets the answers.
