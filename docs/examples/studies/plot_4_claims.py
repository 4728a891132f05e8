"""
Put claims about a scene to the test
====================================

The paper describes what its authors saw in the distributions of four scenes. Does another scene
show the same?
"""

# %%
# `chdstat.studies.claims` turns each of the paper's observations into tests with intervals.
# Built-in scenes have named regions, each inside one phenomenon;
# `chdstat.patterns.choose_regions` finds some in yours.

# sphinx_gallery_panel = 1, 3
import chdstat as chd
from chdstat import viz
from chdstat.rendering.recipes import regions_of
from chdstat.studies.claims import CLAIMS, SceneData

samples = chd.render("caustic", spp=128, size=(64, 64), seed=1, backend="scalar")
data = SceneData("caustic", samples, regions_of(samples))
for region in data.regions[:5]:
    print(f"{region.name.replace('-', ' ')} ({region.phenomenon}): {region.note}")

# %%
# Verdicts
# --------
#
# A claim is supported where the intervals of all its tests lie within the range that it states, and
# not supported where one lies outside. Otherwise it is undecided, and the reason says what would
# decide it. `chdstat.studies.claims.find` tests all claims; six of them keep this page short.

found = [claim.find(data) for claim in CLAIMS if claim.number in {2, 3, 6, 7, 8, 10}]
for finding in found:
    print(f"{finding.number:2} {finding.name}: {finding.verdict}")

# %%
# What they rest on:

viz.finding_plots({f"{finding.number} {finding.name}": finding.plot_data for finding in found})

# %%
# The tests of one claim
# ----------------------
#
# The blue range is what the claim states, the mark with its line is what was measured.

penumbrae = found[2]
print(penumbrae.claim)
viz.claim_intervals({"caustic": penumbrae.tests}).figure

# %%
# As a sentence:

verdicts = [finding.verdict for finding in found]
kept = [finding.name for finding in found if finding.verdict == "supported"]
sentence = (
    f"Of six claims of the paper, a scene that it did not study supports "
    f"{verdicts.count('supported')} ({', '.join(kept) or 'none'}) and does not support "
    f"{verdicts.count('not supported')}; {verdicts.count('cannot tell')} cannot be told from "
    f"{samples.spp} samples per pixel."
)
print(sentence)

# %%
# **Next:** ``chdstat study bathroom fog caustic -o study.pdf`` renders several scenes, again with
# another seed and with shorter paths, and typesets the answers to all claims:
# see `the how-to page <../../how-to/studies.html>`_.
