"""The sRGB transfer curve (IEC 61966-2-1): display values against linear light, both in [0, 1]."""

import numpy as np


def linear_from_srgb(values: np.ndarray) -> np.ndarray:
    """Display values to linear light."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(values: np.ndarray) -> np.ndarray:
    """Linear light to display values."""
    return np.where(values <= 0.0031308, values * 12.92, 1.055 * np.maximum(values, 0) ** (1 / 2.4) - 0.055)
