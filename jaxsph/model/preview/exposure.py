"""Exposure: how opaque a scene is to be, such that its picture is neither dark nor flat.

Flow: Glimpse -> [exposure] -> factor of extinction -> TransferFunction.
"""

from __future__ import annotations

import numpy as np

from jaxsph.model.preview.glimpse import Glimpse

BRIGHT, ALPHA = 99.0, 0.95
"""Percentile of the pixels that is to have this alpha."""
LIT, LEAST_LIT = 0.12, 0.3
"""A channel from which a pixel is not dark, and the share of the pixels that have anything at all that is to be lit."""
MOST = 64.0
"""Factor by which the share of lit pixels may brighten what the brightest alone ask for."""


def exposure(seen: Glimpse) -> float:
    """A factor of the extinction, > 0, at which the 99th percentile of alpha is 0.95, and of all pixels that meet anything three
    in ten are lit; 1 where nothing is met.
    """
    depth = seen.optical_depth
    meets = depth > 0
    if not meets.any():
        return 1.0
    brightest = float(np.percentile(depth, BRIGHT)) or float(depth.max())
    scale = -np.log1p(-ALPHA) / brightest
    limit = scale * MOST
    while scale < limit and (seen.picture(scale).max(-1) > LIT)[meets].mean() < LEAST_LIT:
        scale *= 2**0.25
    return float(scale)


def typical_exposure(seen: Glimpse) -> float:
    r"""A factor of the extinction, > 0, at which what is most opaque has an alpha of 0.95, however small it is in the picture.

    That is the mean optical depth weighted by itself, $\sum \tau^2 / \sum \tau$; 1 where nothing is met.
    """
    depth = seen.optical_depth
    total = float(depth.sum())
    return float(-np.log1p(-ALPHA) * total / (depth**2).sum()) if total > 0 else 1.0
