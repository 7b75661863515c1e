"""Images held against each other, and the views that they are seen in."""

from __future__ import annotations

from typing import Any

import numpy as np

import jaxsph as js


def layers(image: Any) -> np.ndarray:
    """Colour and transmittance, (rows, columns, 4) float64."""
    return np.concatenate([np.asarray(image.color, np.float64), np.asarray(image.transmittance, np.float64)[..., None]], -1)


def error_of(image: Any, truth: Any) -> np.ndarray:
    """Largest difference of a colour channel or of transmittance, each pixel."""
    return np.abs(layers(image) - layers(truth)).max(-1)


def same_bits(image: Any, other: Any, *names: str) -> None:
    """That layers are the same, by default those of a picture."""
    for name in names or ("color", "transmittance", "depth"):
        np.testing.assert_array_equal(np.asarray(getattr(image, name)), np.asarray(getattr(other, name)), err_msg=name)


def seen_from(
    eye: Any, projection: str = "perspective", fov_degrees: float = 50.0, view_height: float = 2.8, **more: Any
) -> js.Camera:
    """A camera that looks at the origin, or where it is told to."""
    where = {"eye": eye, "target": (0.0, 0.0, 0.0)} | more
    if projection == "orthographic":
        return js.Camera.orthographic(**where, view_height=view_height)
    return js.Camera.look_at(**where, fov_degrees=fov_degrees)
