"""Slices as files: values as `.npy` or FITS, values with colours as OpenEXR, colours alone as `.png`.

| channel of `.exr` | meaning |
|---|---|
| `value` | the quantity on the plane, NaN where there is none |
| `R` `G` `B` `A` | its picture, where one is given: linear light, see `scene_linear` |
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from jaxsph.io.images import exr, fits, png
from jaxsph.io.images.fits import PlaneAxes
from jaxsph.io.images.scene_linear import header_of, light_of
from jaxsph.io.replace import written_whole
from jaxsph.model.image import Image

SUFFIXES = (".npy", ".fits", ".exr", ".png")


def write(path: Path, values: np.ndarray, picture: Image | None, metadata: tuple[tuple[str, Any], ...], axes: PlaneAxes) -> None:
    """Write a slice, whole or not at all; `axes` say where its pixels are.

    Raises:
        ValueError: another suffix, a `.png` without a picture, a place that cannot be written to.
        ImportError: a library that is needed is not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"{path}: slices are written as {', '.join(SUFFIXES)}, not as {path.suffix!r}")
    if suffix == ".npy":
        with written_whole(path) as temporary, open(temporary, "wb") as file:
            np.save(file, values)
    elif suffix == ".fits":
        fits.write(path, {"value": values}, axes, dict(metadata).get("jaxsph.unit", ""), metadata)
    elif suffix == ".exr":
        layers, header = {"value": values}, dict(metadata)
        if picture is not None:
            light = light_of(picture.color)
            layers |= {**{name: light[..., k] for k, name in enumerate("RGB")}, "A": 1 - np.asarray(picture.transmittance)}
            header |= header_of(displayed=False)
        exr.write_layers(path, layers, header)
    elif picture is None:
        raise ValueError(f"{path}: a picture needs colours; give `transfer`, or write .npy, .fits or .exr")
    else:
        png.write(path, picture)
