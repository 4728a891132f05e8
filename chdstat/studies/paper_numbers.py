"""Numbers that the paper prints, and the same of a repetition; its sentences, by claim.

`NUMBERS` has a row for each number, `SENTENCES` what the paper says of each claim. Sections are
those of Elek, Thomas and Forbes 2019.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from chdstat._core.display import duration, number, percent
from chdstat.estimators.elek2019 import as_published
from chdstat.samples import Samples
from chdstat.studies.paper_study import BATCH, BATCHES, EVALUATED, RESULTS, PaperScene, PaperStudy
from chdstat.summary.histograms import FIRST_DRAWS, LOG_SUPPORT, PADDING, linear_support

_UNKNOWN = "—"
_EARLY = 1000
"""Iterations after which the first gain of a training is read."""


@dataclass(frozen=True)
class Number:
    """A number of the paper.

    Attributes
    ----------
    section
        Where the paper has it.
    paper
        What it says, in its words.
    what
        What is measured here.
    measure
        Returns it for a scene, in words.
    scenes
        Titles of the scenes that it is about; none for all.
    """

    section: str
    paper: str
    what: str
    measure: Callable[[PaperScene], str]
    scenes: tuple[str, ...] = ()


def _spp(scene: PaperScene) -> str:
    return str(scene.samples.spp)


def _size(scene: PaperScene) -> str:
    height, width = scene.samples.shape[:2]
    return f"{width} × {height}"


def _batches(scene: PaperScene) -> str:
    return f"{min(BATCHES, scene.samples.spp // BATCH)} of {BATCH}"


def _bins(scene: PaperScene) -> str:
    found = scene.study.data.summary
    return f"{found.sizes['linear_bin']} and {found.sizes['log_bin']}"


def _support(_: PaperScene) -> str:
    known = linear_support(np.arange(1.0, 2 * FIRST_DRAWS))
    span = FIRST_DRAWS - 1
    padding = float(known.high - known.low - span) / (2 * span)
    assert math.isclose(padding, PADDING)
    return f"first {FIRST_DRAWS}, {percent(padding)}"


def _log_support(_: PaperScene) -> str:
    low, high = LOG_SUPPORT
    return f"{low:.0e} to {high:.0e}".replace("e-0", "e−").replace("e+0", "e")


def _nulls_of(phenomenon: str) -> Callable[[PaperScene], str]:
    def measure(scene: PaperScene) -> str:
        data = scene.study.data
        regions = [r for r in data.regions if r.phenomenon == phenomenon]
        shares = data.analysis["null_share"].to_numpy()
        found = [float(shares[r.pixels(*shares.shape)].mean()) for r in regions]
        return ", ".join(map(percent, found)) or _UNKNOWN

    return measure


def _null_share(scene: PaperScene) -> str:
    return percent(scene.study.overview.null_share)


def _nulls_above(scene: PaperScene) -> str:
    return percent(float((scene.study.data.analysis["null_share"] > 0.5).mean()))


def _nulls_below(scene: PaperScene) -> str:
    return percent(float((scene.study.data.analysis["null_share"] < 0.2).mean()))


def firefly(above: int) -> Callable[[PaperScene], str]:
    """Return what says the radiance of the firefly, or of the pixel so far above it."""

    def measure(scene: PaperScene) -> str:
        found = scene.firefly()
        if found is None:
            return "no firefly"
        y, x, batch = found
        radiance = scene.study.data.summary["batch_means"].to_numpy()[y - above, x, :, batch]
        return f"[{', '.join(f'{value:.3g}' for value in radiance)}]"

    return measure


def _ratio_of(name: str) -> Callable[[PaperScene], str]:
    def measure(scene: PaperScene) -> str:
        data = scene.study.data
        if data.shorter_summary is None:
            return _UNKNOWN
        long, short = (float(s[name].sum()) for s in (data.summary, data.shorter_summary))
        return number(long / short) if short else _UNKNOWN

    return measure


def _time_ratio(scene: PaperScene) -> str:
    data = scene.study.data
    if data.shorter is None:
        return _UNKNOWN
    long, short = map(_seconds_of_sample, (data.samples, data.shorter))
    return number(long / short) if short > 0 else _UNKNOWN


def _seconds_of_sample(samples: Samples) -> float:
    return float(samples.attrs.get("render_seconds", 0)) / samples.spp


def _layers(_: PaperScene) -> str:
    return "-".join(map(str, as_published().sizes))


def _pixels(scene: PaperScene) -> str:
    return str(len(scene.network.pixels))


def _validation(scene: PaperScene) -> str:
    return percent(as_published(*scene.changed).validation_share)


def _iterations(scene: PaperScene) -> str:
    config = as_published(*scene.changed)
    return f"{int(scene.network.losses.iteration[-1])}, {config.learning_rate:g}"


def _training_time(scene: PaperScene) -> str:
    return duration(scene.network.training_seconds)


def _running_time(scene: PaperScene) -> str:
    height, width = scene.samples.shape[:2]
    return duration(scene.network.seconds * 800 * 800 / (height * width))


def _measure(name: str) -> Callable[[PaperScene], str]:
    def measure(scene: PaperScene) -> str:
        found = scene.errors(published="judging" not in scene.changed).get(name)
        return found[0, -1].shown(percent) if found else _UNKNOWN  # type: ignore[misc]

    return measure


def _early_gain(scene: PaperScene) -> str:
    losses = scene.network.losses
    ratio = losses.validation_loss / losses.validation_baseline
    early = ratio[int(np.searchsorted(losses.iteration, _EARLY).clip(0, len(ratio) - 1))]
    return f"{number(float(early))}, then {number(float(ratio[-1]))}"


def _evaluated(scene: PaperScene) -> str:
    return str(min(EVALUATED, math.prod(scene.samples.shape[:2])))


NUMBERS = (
    Number("Figure 1", "64 superimposed batches of 32 radiance samples", "batches", _batches),
    Number("5", "2k samples per pixel", "samples per pixel", _spp),
    Number("5", "100 bins for both the linear and log variants", "bins", _bins),
    Number("5", "the first 50 collected samples and pad it by 25 % on both ends",
           "support of linear bins", _support),
    Number("5", "fixed absolute support [1e-5, 1e5]", "support of log bins", _log_support),
    Number("5.1", "High number of null samples (around 60 %)", "nulls in indirect light",
           _nulls_of("indirect"), ("Bathroom",)),
    Number("5.2", "low numbers of null samples", "nulls", _null_share, ("WhiteRoom",)),
    Number("5.3", "the proportion of null samples is high, often exceeding 50 %",
           "pixels with more than 50 % nulls", _nulls_above, ("NightRoom",)),
    Number("5.4", "low numbers of null samples, typically under 20 %",
           "pixels with less than 20 % nulls", _nulls_below, ("MeasureOne",)),
    Number("5.4", "a bright firefly (RGB irradiance [4.56, 2.03, 0.22])", "brightest firefly",
           firefly(0)),
    Number("5.4", "its immediate neighbor on top (RGB irradiance [0.25, 0.26, 0.26])",
           "the pixel above it", firefly(1)),
    Number("5.4", "the order-2 image visibly darker than the order-5 one",
           "mean, of longer over shorter paths", _ratio_of("mean")),
    Number("5.4", "the order-5 image ends up having higher variance",
           "variance, of longer over shorter paths", _ratio_of("variance")),
    Number("5.4", "taking roughly twice longer to render",
           "time of a sample, of longer over shorter paths: one measurement", _time_ratio),
    Number("6", "a width-32 input layer [...], three 32-neuron densely connected layers, and a "
           "single output unit", "layers", _layers),
    Number("6", "we uniformly selected 6400 pixels", "pixels that train", _pixels),
    Number("6", "separated out 10 % of the batches as validation data", "validation", _validation),
    Number("6", "30k training iterations with the learning rate of 0.005",
           "iterations, learning rate", _iterations),
    Number("6", "the training took 20 minutes in Tensorflow on NVIDIA RTX 2080 Ti GPU",
           "training, on a thread of this processor", _training_time),
    Number("6", "an 800×800 RGB image with 3×32 SPP is under 1 minute",
           "estimate, for as many pixels", _running_time),
    Number("Figure 8", "the model does not improve markedly after the initial iteration batch",
           f"validation loss over the mean's after {_EARLY} iterations, and at the end",
           _early_gain),
    Number("6", "the majority of the estimates is improved by our model", "improved estimates",
           _measure("improved")),
    Number("6", "a majority of the fireflies in the baseline is suppressed", "fireflies left",
           _measure("fireflies_left")),
    Number("Figure 9", "25 randomly selected pixels", "pixels shown", _evaluated, RESULTS),
    Number("6", "an 800×800 RGB image", "pixels", _size),
)  # fmt: skip
"""Numbers of the paper in the order of their sections."""


def numbers(found: PaperStudy) -> list[dict[str, str]]:
    """Return a row for each of `NUMBERS`, with its value in each scene, one if all are equal."""
    rows = []
    for one in NUMBERS:
        values = {
            scene.title: one.measure(scene)
            for scene in found.scenes
            if not one.scenes or scene.title in one.scenes
        }
        if values:
            same = len(set(values.values())) == 1 and not one.scenes
            named = [f"{title} {value}" for title, value in values.items()]
            here = next(iter(values.values())) if same else "; ".join(named)
            rows.append({"section": one.section, "paper": one.paper, "what": one.what,
                         "here": here})  # fmt: skip
    return rows


SENTENCES = {
    1: ("5.1 to 5.3", "High number of null samples (around 60 %) [...] low numbers of null samples "
        "[...] the proportion of null samples is high, often exceeding 50 %"),
    2: ("5.1", "CHD tend to be quite symmetric in the log domain, close to Gaussian in fact. In "
        "the linear (radiance) domain, CHD exhibit long tails, strong skew, with mode typically "
        "lower than mean"),
    3: ("5.1", "Shapes surprisingly similar to diffuse objects, although in this case the "
        "different RGB channels’ CHD are shifted w.r.t. each other"),
    4: ("5.1", "All of the pixels in the reflection, in spite of their high estimate variance, "
        "share virtually the same CHD shape."),
    5: ("5.1", "Noisy CHD with very long tails (high kurtosis). High number of null samples "
        "[...] showing inverted (negative) skew in the log domain"),
    6: ("5.1", "A visibly bi-modal CHD marking the transition from lit to shadowed regions."),
    7: ("5.2", "the color cast shifts the distributions in the log domain, it basically does not "
        "change their shape"),
    8: ("5.4", "In spite of this stark difference in value, their distributions are almost "
        "identical"),
    9: ("5.4", "the resulting CHD for the order-5 images are more spread, with wider support and "
        "longer, noisy tails"),
    10: ("5.5", "CHD are not even discontinuous between neighboring pixels"),
    11: ("5.5", "The complexity of CHD is tightly linked with the scene complexity."),
    12: ("5.5", "the shapes of the characteristic distributions are scene-specific"),
    13: ("4", "many of the assumptions frequently adopted for solving the MC variance reduction "
         "problem are fragile"),
    14: ("5.5", "The most frequent elementary distribution we have encountered across the board "
         "has a Gamma-like shape"),
    15: ("6", "a majority of the fireflies in the baseline is suppressed [...] lateral denoising "
         "approaches would have an easier time [...] does not improve markedly after the initial "
         "iteration batch [...] the majority of the estimates is improved by our model, some "
         "exceptions remain."),
    16: ("6", "in the absence of any identifiable patterns [...] it should gracefully reduce to "
         "the baseline solution"),
    17: ("2", "negative if correlated (low-discrepancy) sampling is used"),
    18: ("5.2", "This yields complex multi-modal CHD, with an added color cast for the "
         "aforementioned reasons. Very long tails are present"),
    19: ("5.1", "Very well resolved, low-noise CHD—in spite of their very significant spread and "
         "long tail."),
    20: ("5.2", "less spiky CHD in log domain and significantly longer tails in the primal domain"),
    21: ("5.2", "In spite of the fact that these objects are spread across large space, their CHD "
         "look strikingly alike"),
    22: ("5.3", "The log domain shows stronger skew towards the dark end"),
    23: ("5.3", "The CHD contain complex multi-modal patterns, but their shape is remarkably "
         "stable across channels"),
    24: ("5.3", "a very long faint tail caused by the multi-scattered diffuse transmission. In "
         "spite of this, the variance in these areas is low"),
    25: ("5.2", "This fireplace appears boring, but after closer examination in the log domain "
         "displays a wild CHD"),
    26: ("5.4", "most of its mass vanishes in a single spike; the log version however reveals a "
         "complicated multi-modal structure"),
    27: ("5.4", "even though this scene is geometrically very symmetric, the CHD are not in all "
         "cases"),
    28: ("5.4", "As expected, that influences the amount of transported energy, making the "
         "order-2 image visibly darker than the order-5 one. [...] taking roughly twice longer to "
         "render"),
    29: ("8", "the characteristic per-pixel distributions holistically depend on the scene and "
         "the particular integrator used for the rendering"),
    34: ("2", "Dropping the temporary assumption of constant L within the pixel i, the actual "
         "variance [...] is bound to be slightly higher"),
}  # fmt: skip
"""Section and sentence of the paper, by number of the claim that tests it."""
