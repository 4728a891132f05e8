import matplotlib.pyplot as plt
import numpy as np

from chdstat import viz
from chdstat.patterns import Label
from chdstat.viz.maps import LABEL_COLORS
from chdstat.viz.styling import called

data = np.load("noise.npz")
NAMES = {label.value: called(label.name.lower()) for label in Label}
COLORS = [LABEL_COLORS[name] for name in NAMES.values()]


def example(room, after, titles):
    """Draw the image, its map of patterns, and the image after a change, at 64 samples each."""
    fig, (before, patterns, changed) = plt.subplots(1, 3, figsize=(6.7, 2.6), layout="constrained")
    exposure = 0.25 / np.median(data[f"{room}/{after}/image"].astype(np.float32))
    for ax, number, title in ((before, 0, titles[0]), (changed, after, titles[1])):
        image = data[f"{room}/{number}/image"].astype(np.float32)
        viz.image_map(exposure * image, title=title, ax=ax)
    viz.categorical_map(data[f"{room}/0/labels"], NAMES, colors=COLORS, columns=1, ax=patterns)
    patterns.set_title("what its pixels are", fontsize="medium")
    return fig


def told(room, after):
    """Say what the numbers of the two images are."""
    samples = data[f"{room}/0/pixel"]
    black, share = np.count_nonzero(samples == 0), samples.max() / samples.sum()
    print(f"Of 64 samples of a pixel on the floor, {black} are black;")
    print(f"the brightest one makes {share:.0%} of the pixel.")
    (mean, _, noise), (new, _, less) = (data[f"{room}/{n}/numbers"] for n in (0, after))
    print(f"After the change, the image is {new / mean:.2f} times as bright,")
    print(f"and needs {float(f'{noise / less:.2g}'):g} times fewer samples for the same noise.")
