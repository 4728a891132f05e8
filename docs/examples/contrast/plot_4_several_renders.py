"""
Which of several renders is noisier, where, and why?
====================================================

A path tracer can look for light in two ways: pick a point on a lamp, or follow the material and
hope to meet one. Most do both. What does each do to the distributions?
"""

# %%
# Direct light in the hall, once by lamps, once by the material, and once by both, each path
# weighted by how likely either way was to find it (multiple importance sampling). All three have
# the same mean, so that their noise can be ranked.

import chdstat as chd

ways = {"lamps": (1, 0), "material": (0, 1), "both": (1, 1)}
renders = {}
for seed, (name, (lamps, material)) in enumerate(ways.items(), start=1):
    way = {"type": "direct", "emitter_samples": lamps, "bsdf_samples": material}
    renders[name] = chd.render(
        "gallery", spp=36, size=(64, 64), seed=seed, integrator=way, backend="scalar"
    )
found = chd.contrast(renders)
found.plot()

# %%
# Points on lamps meet the light nearly always. But where a surface is shiny or a lamp is near, some
# count for far too much. Following the material has no such fireflies on shiny surfaces, and mostly
# ends in the dark: the pixels are null-heavy. Weighting takes from each what it does well,
# but a sample is two paths then, which take longer: the order at equal time is another question.

found

# %%
# If one pattern surely holds most of the additional variance, it says why:

noise = found.noise
best, *others = noise.order.names
reasons = []
for name in others:
    ratio = noise.order.ratios[best, name]
    if not noise.order.surely(best, name):
        reasons.append(f"by {name}, it cannot be told apart")
        continue
    causes = [cause for cause in noise.causes if cause.name == name]
    reasons.append(
        f"by {name}, the variance is {1 / ratio.value:.1f} times as large ({1 / ratio.high:.1f} to "
        f"{1 / ratio.low:.1f})"
    )
    if most := [cause.pattern for cause in causes if cause.share.low > 0.5]:
        reasons[-1] += f", mostly in {most[0].replace('_', '-')} pixels"
    if (best, name) in noise.order.doubtful:
        reasons[-1] += ", but only by pixels whose variance cannot be trusted yet"
wins, spp = noise.wins(), noise.spp[best]
decided = sum(pixels for pixels, _ in wins.values())
sentence = f"At equal samples, sampling by {best} has the least noise: {'; '.join(reasons)}. "
sentence += (
    f"Where in the image that is so takes more than {spp} spp to tell. "
    if decided < 0.01
    else f"That is told cell by cell in {decided:.0%} of the image. "
)
by_time = noise.orders["equal time"]
first, *rest = by_time.names
sentence += (
    f"At equal time, {first} has the least."
    if all(by_time.surely(first, name) for name in rest)
    else "At equal time, which has the least is not told."
)
print(sentence)

# %%
# **Next:** the how-to page on `contrasting renders <../../how-to/contrast-renders.html>`_ has the
# ranking at equal time, the map and the report.
