import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle

import chdstat as chd
from chdstat import viz
from chdstat.patterns import Label

SCALAR = {"size": (64, 64), "backend": "scalar"}
PIXELS = {  # scene, (y, x)
    Label.NULL_HEAVY: ("bathroom", (48, 60)),
    Label.FIREFLY_DOMINATED: ("night-room", (28, 10)),
    Label.LONG_TAIL: ("many-lights", (18, 0)),
    Label.BIMODAL: ("bathroom", (53, 56)),
    Label.MULTIMODAL: ("caustic", (21, 24)),
    Label.GAMMA_LIKE: ("cornell-box", (34, 31)),
    Label.LOGNORMAL_LIKE: ("cornell-box", (26, 56)),
    Label.OTHER: ("many-lights", (46, 43)),
    Label.CONSTANT: ("bathroom", (20, 4)),
    Label.BLACK: ("cornell-box", (37, 63)),
}
scenes = {name: chd.load_scene(name) for name in {scene for scene, _ in PIXELS.values()}}
x = {}  # label: (channel, sample)
for name, scene in scenes.items():
    those = {label: place for label, (other, place) in PIXELS.items() if other == name}
    drawn = chd.rendering.render_pixels(scene, list(those.values()), spp=2048, seed=1, **SCALAR)
    x |= dict(zip(those, drawn, strict=True))
for label, samples in x.items():
    assert chd.classify(samples).label == label, label
named = {label.name.lower().replace("_", "-"): x[label] for label in PIXELS}
named["clamped"] = np.minimum(x[Label.LONG_TAIL], 2 * x[Label.LONG_TAIL].mean())
named["too few samples"] = x[Label.NULL_HEAVY][:, :16]


def chd_of(ax, samples):
    light = samples.mean(axis=0)
    viz.chd_axes(chd.histogram(light), names=["luminance"], ax=ax)
    ax.axvline(light.mean() or 1e-9, color="#0072B2", linestyle="--", linewidth=1)
    ax.tick_params(axis="x", which="minor", labelbottom=False)


images = {}


def show(label, samples=None):
    scene, (row, column) = PIXELS[label]
    if scene not in images:
        images[scene] = chd.render(scenes[scene], spp=32, **SCALAR).read().mean(axis=-1)
    samples = x[label] if samples is None else samples
    fig, (image, log, means) = plt.subplots(
        1, 3, figsize=(6.7, 1.6), layout="constrained", width_ratios=[1, 2, 2]
    )
    viz.image_map(images[scene], ax=image)
    image.add_patch(Circle((column, row), 3.5, fill=False, edgecolor="black", linewidth=2.6))
    image.add_patch(Circle((column, row), 3.5, fill=False, edgecolor="#F0E442", linewidth=1.4))
    chd_of(log, samples)
    log.set_title(f"{np.mean(samples.max(axis=0) == 0):.0%} null", loc="right", color="#666666")
    log.set_xlabel("radiance of one sample")
    batches = samples.mean(axis=0).reshape(8 if samples.shape[1] > 64 else 1, -1)
    n = np.arange(1, batches.shape[1] + 1)
    mean = batches.mean() or 1
    means.plot(n, (batches.cumsum(axis=1) / n / mean).T, linewidth=0.7, color="#0072B2")
    means.set(xlabel="samples", title="running means over the mean", xlim=(1, n[-1]), ylim=(0, 3))
    return fig


fig, axes = plt.subplots(3, 4, figsize=(6.7, 3.9), layout="constrained")
for ax, (name, samples) in zip(axes.flat, named.items(), strict=True):
    chd_of(ax, samples)
    ax.set_title(name, loc="left", fontweight="bold")
    ax.set_title(f"{np.mean(samples.max(axis=0) == 0):.0%} null", loc="right", color="#666666")
fig.supxlabel("radiance of one sample; dashed: the mean")
fig
