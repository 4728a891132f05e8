"""Help: what each part of the page shows and when to trust it, in a few sentences."""

from __future__ import annotations

__all__ = ["HELP"]

HELP = {
    "headline": "Five numbers of the luminance of the selected pixel. The mean is given with its "
    "standard error. A null sample is one of a path that found no light. The tail index ξ is that "
    "of a generalised Pareto distribution fitted to the largest samples: from ½ on the variance is "
    "infinite, and the standard error means nothing. The last number is how many samples bring the "
    "standard error down to 1 % of the mean, if the variance is finite.",
    "linear": "Density of the positive samples over radiance. The bins cover the range of the "
    "first 50 samples and a quarter more at both ends, as in Elek, Thomas and Forbes (2019); "
    "samples beyond them, nulls and bad ones are counted in the line above. Dashed vertical lines "
    "are means. Curves are the fits that are switched on.",
    "log": "The same samples over the decimal logarithm of radiance, where log-normal samples "
    "look Gaussian and tails can be seen. Nulls have no logarithm; their share is given above.",
    "qq": "Quantiles of the positive samples against those of the first family that is switched "
    "on. On the dotted diagonal the family describes the samples; where the upper end bends above "
    "it, the tail of the samples is heavier than that of the family.",
    "running": "Mean of the first n samples, with the 95 % interval that the central limit theorem "
    "gives. Jumps are fireflies. With a tail index of ½ or more the interval is too short, however "
    "many samples there are.",
    "averages": "Distribution of averages of N consecutive samples, the values that a render with "
    "N samples per pixel would have, with the Gaussian of the same moments. p is that of a test of "
    "normality; a small p says that averages of N samples are not Gaussian yet.",
    "patterns": "What the distribution looks like, decided by the statistic and the threshold in "
    "each row. A pixel may have several patterns; the heading names the first that counts. Point "
    "at a row to read how it is measured and tested.",
    "estimates": "What each estimator gives from N samples, averaged over batches of this pixel, "
    "and its mean squared error over that of the sample mean: below 1 is better. Bias is the mean "
    "error over the mean; improved is the share of batches in which the estimate is nearer to the "
    "reference than the mean is.",
    "statistics": "Moments, the best family by BIC with its parameters, the tail, modes and tests "
    "of normality. A dash stands for what cannot be computed; the margin is the difference of BIC "
    "to the next best family.",
    "goodness": "Parametric bootstrap: each family is fitted, samples are drawn from the fit, "
    "fitted again, and compared with the fit as the pixel's samples are. A small p says that the "
    "family does not describe the samples; D is the largest gap of the distribution functions.",
    "compared": "Distances between the distributions of the pixel in the two stores, with a "
    "permutation test. Pixels that were picked because they look different make its p too small "
    "too often.",
    "paths": "Light that comes by paths of each length, known from the same samples with their "
    "paths cut: its share of the mean, of the variance, and of what the samples of each mode and "
    "of the tail carry.",
    "lights": "Light that comes from each of the lights, known from the same samples with the "
    "others switched off: its share of the mean, of the variance, and of what the samples of each "
    "mode and of the tail carry.",
}
"""Text by the part of the page that it explains."""
