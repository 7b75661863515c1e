"""Images as files, by their suffix.

Flow: Image -> [write_image] -> file -> [read_image] -> Image.
"""

from __future__ import annotations

import os
from pathlib import Path
from types import ModuleType
from typing import Any

from jaxsph.io.damage import regular_file
from jaxsph.io.images import exr, png
from jaxsph.model.image import Image

FORMATS = {".exr": exr, ".png": png}


def write_image(path: str | os.PathLike[str], image: Image, background: Any = None) -> None:
    """Write `image` to `path`, whole or not at all: `.exr` (every layer) or `.png` (8 bit colours over black).

    Both show the same: a PNG holds `image.color` as displayed, an EXR the linear light of it (`jaxsph.io.images.scene_linear`).

    Args:
        path: where to.
        image: what.
        background: of a PNG, what is behind the picture: a colour as `Image.over` takes it, `"transparent"`, or None for black.
            An EXR holds alpha, over which any background can be put.

    Raises:
        ValueError: another suffix, a place that cannot be written to, no colour, or a colour behind an EXR.
    """
    file, image = Path(path), image.as_one("save")
    form = _format(file)
    if form is exr and background not in (None, "transparent"):
        raise ValueError(
            f"`background` = {background!r} is for .png: {path} holds alpha, over which any can be put; leave it out"
        )
    if form is exr or background is None:
        form.write(file, image)
    else:
        png.write(file, image, background)


def read_image(path: str | os.PathLike[str]) -> Image:
    """Read an image that `write_image` wrote, or another program. Layers that the file does not hold are NaN.

    `image.color` is display-referred (sRGB), whatever the file holds: to 1e-6 what was written as EXR, to half of 1/255 as PNG.
    Colours of an EXR file are linear light, and are encoded, unless its header says otherwise or an earlier jaxsph wrote it.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another suffix, no regular file, a damaged one, or colours of a kind that is not known.
    """
    file = Path(path)
    form = _format(file)
    image: Image = form.read(regular_file(file))
    return image


def _format(path: Path) -> ModuleType:
    if path.suffix.lower() not in FORMATS:
        raise ValueError(f"{path}: images are written and read as {' or '.join(FORMATS)}, not as {path.suffix!r}")
    return FORMATS[path.suffix.lower()]
