"""Images as files, by their suffix: OpenEXR, and PNG for looking at.

Flow: Image -> [write_image] -> file -> [read_image] -> Image.

A PNG has 8 bit RGB of the colours over black, or another background, or RGBA in front of none.
Colours come from a transfer function, which is made by eye on a display, so they are display-referred (sRGB): they are written
as they are, clipped to [0, 1] and rounded to the nearest of 256 steps, with no further encoding. Layers other than
colour are left out; write EXR to keep them. The metadata goes into text chunks.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxsph.io.damage import explained, regular_file
from jaxsph.io.images import exr
from jaxsph.io.libraries import require
from jaxsph.io.replace import written_whole
from jaxsph.model.image import Image
from jaxsph.numerics.checks import array_of

SUFFIXES = (".exr", ".png")


def write_image(path: str | os.PathLike[str], image: Image, background: Any = None) -> None:
    """Write `image` to `path`, whole or not at all: `.exr` (every layer) or `.png` (8 bit colours over black).

    Both show the same: a PNG holds `image.color` as displayed, an EXR the linear light of it (`jaxsph.io.images.exr`).

    Args:
        path: where to.
        image: what.
        background: of a PNG, what is behind the picture: a colour as `Image.over` takes it, `"transparent"`, or None for black.
            An EXR holds alpha, over which any background can be put.

    Raises:
        ValueError: another suffix, a place that cannot be written to, no colour, or a colour behind an EXR.
    """
    file, image = Path(path), image.as_one("save")
    if _suffix(file) == ".png":
        write_png(file, image, background)
    elif background in (None, "transparent"):
        exr.write(file, image)
    else:
        raise ValueError(
            f"`background` = {background!r} is for .png: {path} holds alpha, over which any can be put; leave it out"
        )


def read_image(path: str | os.PathLike[str]) -> Image:
    """Read an image that `write_image` wrote, or another program. Layers that the file does not hold are NaN.

    `image.color` is display-referred (sRGB), whatever the file holds: to 1e-6 what was written as EXR, to half of 1/255 as PNG.
    Colours of an EXR file are linear light, and are encoded, unless its header says otherwise or an earlier jaxsph wrote it.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another suffix, no regular file, a damaged one, or colours of a kind that is not known.
    """
    read = exr.read if _suffix(Path(path)) == ".exr" else _read_png
    return read(regular_file(path))


def _suffix(path: Path) -> str:
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path}: images are written and read as {' or '.join(SUFFIXES)}, not as {path.suffix!r}")
    return path.suffix.lower()


def write_png(path: Path, image: Image, background: Any = None) -> None:
    """Write the colours of `image`; whole or not at all. `ValueError` when the path cannot be written to.

    A `background` of None is black, and `"transparent"` keeps alpha.
    """
    if background is None:
        pixels = image.to_uint8()
    elif background == "transparent":
        pixels = _with_alpha(image)
    else:
        pixels = (image.over(background) * 255 + 0.5).astype(np.uint8)
    write_pixels(path, pixels, dict(image.metadata))


def _with_alpha(image: Image) -> np.ndarray:
    """(H, W, 4) uint8: colours divided by alpha, as PNG has them, and alpha.

    Colours are display-referred, premultiplied, and divided as they are: in front of black, programs that mix displayed values
    show `image.color`. Where alpha is 0 in 8 bits, nothing is seen, and colours are 0; elsewhere they are divided by the alpha
    that is written, and at most 1, as they are at most alpha where colours of the transfer function are at most 1.
    """
    color = np.clip(np.nan_to_num(np.asarray(image.color, np.float64), nan=0.0), 0, 1)
    alpha = np.floor(np.clip(np.nan_to_num(np.asarray(image.alpha, np.float64), nan=1.0), 0, 1) * 255 + 0.5)
    straight = np.divide(color * 255, alpha[..., None], out=np.zeros_like(color), where=alpha[..., None] > 0)
    return np.concatenate([np.clip(straight, 0, 1) * 255 + 0.5, alpha[..., None]], -1).astype(np.uint8)


def write_pixels(path: Path, pixels: np.ndarray, metadata: Mapping[str, Any]) -> None:
    """Write (H, W, 3) or (H, W, 4) uint8, whole or not at all, with metadata in text chunks."""
    pillow = require("PIL.Image", "writing PNG images")
    chunks = require("PIL.PngImagePlugin", "writing PNG images").PngInfo()
    for name, value in metadata.items():
        chunks.add_text(str(name), str(value))
    with written_whole(path) as temporary:
        pillow.fromarray(pixels).save(temporary, format="PNG", pnginfo=chunks)


def _read_png(path: Path) -> Image:
    """Read the colours of a PNG file, in steps of 1/255; the other layers are not in the file: NaN, and an infinite error bound.

    Raises `ValueError`: damaged or another format.
    """
    pillow = require("PIL.Image", "reading PNG images")
    with explained(path, "PNG"):
        with pillow.open(path, formats=["PNG"]) as opened:
            opened.verify()  # the check sum of every chunk, which decoding does not compare
        with pillow.open(path, formats=["PNG"]) as opened:
            color = np.asarray(opened.convert("RGB"), np.float32) / np.float32(255)
            metadata = tuple(getattr(opened, "text", {}).items())
        unknown, bound = (array_of(np.full(color.shape[:2], value, np.float32)) for value in (np.nan, np.inf))
        return Image(array_of(color), unknown, unknown, bound, unknown, False, 0, {}, metadata)
