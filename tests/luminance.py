"""Luminance of linear sRGB, and errors relative to an image, by their definitions."""

import numpy as np

LUMINANCE = np.array([0.212671, 0.715160, 0.072169])
"""Weights of ITU-R BT.709, with the digits of Mitsuba's."""


def relative_error(squared, image):
    """Return the root of relMSE of squared errors, shape (y, x, channel)."""
    scale = image**2 + 0.01 * np.nanmean(image, axis=(0, 1)) ** 2
    return float(np.sqrt(np.nanmean(squared / np.maximum(scale, 1e-300))))
