"""Weights of linear sRGB in luminance (ITU-R BT.709), with the digits of Mitsuba's."""

import numpy as np

LUMINANCE = np.array([0.212671, 0.715160, 0.072169])
