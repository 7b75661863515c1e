"""Images as files, by their suffix: OpenEXR with every layer of a render, and PNG for looking at.

Flow: Image -> [write_image] -> file -> [read_image] -> Image.

| channel | meaning |
|---|---|
| `R` `G` `B` | linear light of Rec. 709, premultiplied, over black: the sRGB decoding of `image.color` |
| `A` | `1 - transmittance` |
| `Z` | view depth where transmittance falls to 1/2, inf where it never does |
| `N.x` `N.y` `N.z` | normal of the surface of particles in the world, 0 where none is met; of scenes with one |
| `error.bound` | largest difference to the reference image that a pixel can have |
| `lower.R` ... `upper.A` | between what each of `R` `G` `B` `A` lies at full rate; of an image that has its bracket |
| `work.evaluations` | kernel evaluations spent on the pixel |

An image whose metadata say `jaxsph.first_row` and `jaxsph.rows` is some rows of a larger one: its data window is their place in
the display window, so that EXR tools show it where it belongs. Its colours are `image.color` itself, bit for bit, so that parts
make the same picture as the whole.

All are float32, ZIP compressed without loss. The header holds the metadata of the image as text and numbers, among them
`jaxsph.version`, `jaxsph.color` (what the colours are), `jaxsph.integrator` (how samples became light), `jaxsph.tolerance`,
`jaxsph.estimator` (`segments` of that integrator) and `certified` (`true` or `false`).

Colour maps are made by eye on a display, and so `image.color` is display-referred: sRGB, premultiplied, over black. Tools take
the numbers of an EXR file for linear light, and encode them themselves to show them. So a file holds the sRGB decoding
(IEC 61966-2-1) of `image.color`, and what such a tool shows over black is what a PNG file shows. Its header says so.

| `jaxsph.color` in the header | colours of the file |
|---|---|
| `linear Rec.709` | linear light |
| `linear Rec.709, premultiplied as light` | alpha times linear light of colours without alpha: to be laid over backgrounds |
| `sRGB, display-referred` | `image.color` itself: a part of a picture, which is to keep its bits |
| none, of a file of jaxsph | `image.color` itself: written before colours were linear |
| none, of a foreign file | linear light, as OpenEXR defines it; other primaries than those of Rec. 709 are not converted |

What is half transparent is mixed with what lies behind it in sRGB by a PNG and `Image.over`, and as light by tools for EXR. The
two agree over black; over other backgrounds a colour whose light was decoded with its alpha in it is too dark. Written with the
background `"transparent"`, a file holds alpha times the light of the colour itself: white over white is white. Over black it is
brighter than the PNG where it is half transparent.

A PNG has 8 bit RGB of the colours over black, or another background, or RGBA in front of none: display-referred as they are,
clipped to [0, 1] and rounded to the nearest of 256 steps. Layers other than colour are left out. The metadata goes into text
chunks.
"""

from __future__ import annotations

import contextlib
import io
import os
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsph.io.damage import DataError, explained, regular_file, require
from jaxsph.io.parsing import DEFLATE_RATIO
from jaxsph.io.replace import known_suffix, written_whole
from jaxsph.model.image import Image
from jaxsph.numerics import __version__
from jaxsph.numerics.checks import array_of

SUFFIXES, KIND = (".exr", ".png"), "images are written and read as"
STDOUT, STDERR = 1, 2
_LOCK = threading.Lock()  # there is one of each in a process
FIRST_ROW, ROWS = "jaxsph.first_row", "jaxsph.rows"
"""Names of the metadata of some rows of an image: which is the first, and how many the whole has."""
NORMAL = "N.x", "N.y", "N.z"
BRACKET = "lower", "upper"
RESERVED = (
    "channels", "chromaticities", "chunkCount", "compression", "dataWindow", "displayWindow", "lineOrder", "name",
    "pixelAspectRatio", "screenWindowCenter", "screenWindowWidth", "tiles", "type", "version", "view",
)  # fmt: skip
WORDS = {"true": True, "false": False, "none": None}
COLOR_KEY = "jaxsph.color"
LIGHT, DISPLAYED = "linear Rec.709", "sRGB, display-referred"
OVER = f"{LIGHT}, premultiplied as light"
CHROMATICITIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""Of Rec. 709, which are those of sRGB: red, green, blue and white, x and y each."""
SLOPE, POWER, OFFSET = 12.92, 2.4, 0.055
DARKEST_OF_POWER = 0.04045  # a displayed number up to which the curve is a straight line
BLOCK = 1 << 20  # numbers that are converted at a time, as float64 takes room


def write_image(path: str | os.PathLike[str], image: Image, background: Any = None) -> None:
    """Write `image` to `path`, whole or not at all: `.exr` (every layer) or `.png` (8 bit colours over black).

    Both show the same: a PNG holds `image.color` as displayed, an EXR the linear light of it.

    Args:
        path: where to.
        image: what.
        background: of a PNG, what is behind the picture: a colour as `Image.over` takes it, `"transparent"`, or None for black.
            Of an EXR, which holds alpha, `"transparent"` for colours that tools lay over a background as linear light, or None
            for those that show over black what a PNG shows.

    Raises:
        ValueError: another suffix, a place that cannot be written to, no colour, or a colour behind an EXR.
    """
    file, image = Path(path), image.as_one("save")
    if known_suffix(file, SUFFIXES, KIND) == ".png":
        return write_png(file, image, background)
    if background not in (None, "transparent"):
        why = f"{path} holds alpha, over which any can be put; leave it out"
        raise ValueError(f"`background` = {background!r} is for .png: {why}")
    return _write_exr(file, image, background is not None)


def read_image(path: str | os.PathLike[str]) -> Image:
    """Read an image that `write_image` wrote, or another program. Layers that the file does not hold are NaN.

    `image.color` is display-referred (sRGB), whatever the file holds: to 1e-6 what was written as EXR, to half of 1/255 as PNG,
    with alpha, too.
    Colours of an EXR file are linear light, and are encoded, unless its header says otherwise or an earlier jaxsph wrote it.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another suffix, no regular file, a damaged one, or colours of a kind that is not known.
    """
    read = _read_exr if known_suffix(path, SUFFIXES, KIND) == ".exr" else _read_png
    return read(regular_file(path))


def write_png(path: Path, image: Image, background: Any = None) -> None:
    """Write the colours of `image`, as `write_image` does."""
    write_pixels(path, pixels_of(image, background), dict(image.metadata))


def pixels_of(image: Image, background: Any) -> np.ndarray:
    """(H, W, 3 or 4) uint8, as `write_png` has them."""
    if background is None:
        return image.to_uint8()
    return _with_alpha(image) if background == "transparent" else (image.over(background) * 255 + 0.5).astype(np.uint8)


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
    """Read a PNG file in steps of 1/255, over black where it has alpha; layers that it lacks are NaN, an error bound infinite."""
    pillow = require("PIL.Image", "reading PNG images")
    with explained(path, "PNG"):
        with pillow.open(path, formats=["PNG"]) as opened:
            opened.verify()  # the check sum of every chunk, which decoding does not compare
        with pillow.open(path, formats=["PNG"]) as opened:
            deep = opened.mode.startswith("I")  # 16 bits of grey, which Pillow would clip to 8
            held = opened if deep else opened.convert("RGBA" if opened.has_transparency_data else "RGB")
            pixels = np.asarray(held, np.float32).reshape(held.height, held.width, -1) / np.float32(65535 if deep else 255)
            metadata = tuple(getattr(opened, "text", {}).items())
        unknown, bound = (array_of(np.full(pixels.shape[:2], value, np.float32)) for value in (np.nan, np.inf))
        color, alpha = np.broadcast_to(pixels[..., :3], (*pixels.shape[:2], 3)), pixels[..., 3:]
        color, left = (color * alpha, array_of(1 - alpha[..., 0])) if alpha.size else (color, unknown)
        return Image(array_of(color), left, unknown, bound, unknown, False, 0, {}, metadata)


def _write_exr(path: Path, image: Image, over: bool) -> None:
    """Write every layer and the metadata of `image`, to be laid `over` a background or not; `ValueError` where a name of these is
    one that OpenEXR uses itself.
    """
    windows, alpha = _windows(image), 1 - np.asarray(image.transmittance, np.float32)
    color = np.asarray(image.color, np.float32)
    if not windows:
        color = _straight(color, alpha, light_of) if over else light_of(image.color)
    layers = {
        **{name: color[..., i] for i, name in enumerate("RGB")},
        "A": alpha,
        "Z": image.depth,
        "error.bound": image.error_bound,
        "work.evaluations": image.evaluations,
    }
    if image.normal is not None:
        layers |= {name: image.normal[..., i] for i, name in enumerate(NORMAL)}
    for side in BRACKET:
        if (bound := getattr(image, side)) is None:
            continue
        if over:
            raise ValueError(f'{path}: a bracket is of colours over black; leave out `background="transparent"`')
        pixels = np.asarray(bound, np.float32)
        color, alpha = pixels[..., :3], pixels[..., 3:]
        pixels = np.concatenate([color if windows else light_of(color), alpha], -1)
        layers |= {f"{side}.{name}": pixels[..., i] for i, name in enumerate("RGBA")}
    write_layers(
        path,
        layers,
        {
            **_attributes(image),
            **windows,
            **header_of(displayed=bool(windows)),
            **({COLOR_KEY: OVER} if over and not windows else {}),
        },
    )


def _read_exr(path: Path) -> Image:
    """Read an image that `write_image` wrote, or any OpenEXR image with `R`, `G` and `B`.

    Layers that the file lacks are NaN, an error bound infinite. `stats` is empty: sums of a render are not in it.
    """
    with explained(path, "OpenEXR"):
        layers, header = read_layers(path)
        missing = [name for name in "RGB" if name not in layers]
        if missing:
            raise DataError(f"has no channel {' '.join(missing)}, only {' '.join(layers)}; a colour image is expected")
        unknown = np.full_like(layers["R"], np.nan)
        own = (*RESERVED, COLOR_KEY)
        stored = {name: value for name, value in header.items() if name not in own and isinstance(value, str | int | float)}
        metadata = {name: _value(value) for name, value in stored.items()}
        color = np.stack([layers[name] for name in "RGB"], axis=-1)
        if is_light(header):
            color = _straight(color, layers.get("A", np.ones(())), color_of) if header.get(COLOR_KEY) == OVER else color_of(color)
        return Image(
            color=array_of(color),
            transmittance=array_of(1 - layers.get("A", unknown)),
            depth=array_of(layers.get("Z", unknown)),
            error_bound=array_of(layers.get("error.bound", np.full_like(unknown, np.inf))),
            evaluations=array_of(layers.get("work.evaluations", unknown)),
            certified=metadata.get("certified") is True,
            faults=int(metadata.get("faults") or 0),
            stats={},
            metadata=tuple(metadata.items()),
            normal=array_of(np.stack([layers[name] for name in NORMAL], -1)) if set(NORMAL) <= set(layers) else None,
            **{side: _bound_of(side, layers, is_light(header)) for side in BRACKET},
        )


def _bound_of(side: str, layers: Mapping[str, np.ndarray], light: bool) -> Any:
    """The lower or upper image, if a file holds it."""
    names = [f"{side}.{name}" for name in "RGBA"]
    if not set(names) <= set(layers):
        return None
    pixels = np.stack([layers[name] for name in names], -1)
    color = color_of(pixels[..., :3]) if light else pixels[..., :3]
    return array_of(np.concatenate([color, pixels[..., 3:]], -1))


def write_layers(path: Path, layers: Mapping[str, Any], header: Mapping[str, Any]) -> None:
    """Write layers as channels of float32, compressed without loss; whole or not at all. Raises as `write_image`."""
    openexr = require("OpenEXR", "writing EXR images")
    channels = {name: np.ascontiguousarray(layer, dtype=np.float32) for name, layer in layers.items()}
    with written_whole(path) as temporary:
        try:
            header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage, **header}
            openexr.File(header, channels).write(str(temporary))
        except (RuntimeError, ValueError) as error:
            raise ValueError(f"cannot write {path}: {error}") from error


def read_layers(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The channels of a file, float32, and its header; `ValueError` where it does not begin as such files do."""
    openexr = require("OpenEXR", "reading EXR images")
    if path.read_bytes()[:4] != b"\x76\x2f\x31\x01":
        raise DataError("does not begin as OpenEXR files do; it is another format, or damaged")
    with hushed():  # of what is damaged the library says more, line by line
        header = openexr.File(str(path), header_only=True).header()
        low, high = (np.array(corner, np.int64) for corner in header["dataWindow"])
        width, height = (high - low + 1).tolist()
        ratio = DEFLATE_RATIO * (64 if "DWA" in str(header.get("compression")) else 1)  # of one colour DWA keeps next to nothing
        if width * height > ratio * path.stat().st_size:  # before memory is taken for them
            held = path.stat().st_size
            raise DataError(f"announces {width} x {height} pixels, more than its {held} bytes can hold; copy it again")
        file = openexr.File(str(path), separate_channels=True)
    return {name: np.array(channel.pixels, np.float32) for name, channel in file.channels().items()}, dict(file.header())


@contextlib.contextmanager
def hushed() -> Iterator[None]:
    """Nothing that is written to the process's stdout or stderr inside the block is seen; where it has none, nothing changes.

    Libraries of C and C++ print past Python what their errors say too.
    """
    with _LOCK, contextlib.ExitStack() as undone:
        undone.enter_context(contextlib.redirect_stdout(io.StringIO()))  # bindings print by way of Python
        for number in (STDOUT, STDERR):
            with contextlib.suppress(OSError):
                kept = os.dup(number)
                undone.callback(os.close, kept)
                nowhere = os.open(os.devnull, os.O_WRONLY)
                undone.callback(os.close, nowhere)
                os.dup2(nowhere, number)
                undone.callback(os.dup2, kept, number)
        yield


def _attributes(image: Image) -> dict[str, Any]:
    """The metadata of `image` as EXR attributes."""
    attributes = {str(name): _attribute(value) for name, value in dict(image.metadata).items()}
    clash = [name for name in attributes if name in RESERVED]
    if clash:
        raise ValueError(f"`metadata` must not use the name {clash[0]!r}, which OpenEXR uses itself; rename it")
    attributes.setdefault("jaxsph.version", __version__)
    attributes.setdefault("certified", _attribute(bool(image.certified)))
    attributes.setdefault("faults", int(image.faults))
    return attributes


def _windows(image: Image) -> dict[str, Any]:
    """Where rows of a larger image belong; nothing of a whole one."""
    metadata, (height, width) = dict(image.metadata), image.shape
    if FIRST_ROW not in metadata or ROWS not in metadata:
        return {}
    first = int(metadata[FIRST_ROW])
    rows = {"dataWindow": (first, first + height - 1), "displayWindow": (0, int(metadata[ROWS]) - 1)}
    return {name: (np.array([0, top], np.int32), np.array([width - 1, low], np.int32)) for name, (top, low) in rows.items()}


def _attribute(value: Any) -> str | int | float:
    if hasattr(value, "item") and getattr(value, "ndim", 1) == 0:
        value = value.item()
    if value is None or isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int) and abs(value) < 2**31:
        return value
    return float(value) if isinstance(value, int | float) else str(value)


def _value(value: str | int | float) -> str | int | float | bool | None:
    """An attribute as it was before it was written: EXR holds single precision, so the shortest decimal is meant."""
    if isinstance(value, str):
        return WORDS.get(value, value)
    return float(str(np.float32(value))) if isinstance(value, float) else value


def light_of(color: Any) -> Float[np.ndarray, "..."]:
    """Linear light of displayed colours, by float64 in float32; beyond [0, 1] the curve goes on, and is odd."""

    def decoded(color: np.ndarray) -> np.ndarray:
        return np.where(color <= DARKEST_OF_POWER, color / SLOPE, ((color + OFFSET) / (1 + OFFSET)) ** POWER)

    return _by_blocks(color, decoded)


def color_of(light: Any) -> Float[np.ndarray, "..."]:
    """Displayed colours of linear light: of `light_of(color)` to 2 eps of `color`, relative; NaN and inf stay what they are."""

    def encoded(light: np.ndarray) -> np.ndarray:  # its border is where that of `decoded` goes, not 0.0031308 of the standard
        straight = light <= np.float32(DARKEST_OF_POWER / SLOPE)
        return np.where(straight, light * SLOPE, (1 + OFFSET) * light ** (1 / POWER) - OFFSET)

    return _by_blocks(light, encoded)


def header_of(*, displayed: bool) -> dict[str, Any]:
    """What a header says of colours that are displayed numbers, or linear light."""
    return {COLOR_KEY: DISPLAYED} if displayed else {COLOR_KEY: LIGHT, "chromaticities": CHROMATICITIES}


def is_light(header: Mapping[str, Any]) -> bool:
    """Whether colours of a file are linear light. Raises `DataError`: the header says something else than files of jaxsph do."""
    told = header.get(COLOR_KEY)
    if told is None:
        return not any(name.startswith("jaxsph.") for name in header)
    if told not in (LIGHT, OVER, DISPLAYED):
        raise DataError(f"has {COLOR_KEY} = {told!r}, which is neither {LIGHT!r} nor {DISPLAYED!r}; save it as one")
    return bool(told != DISPLAYED)


def _straight(color: np.ndarray, alpha: np.ndarray, convert: Callable[[Any], np.ndarray]) -> np.ndarray:
    """Premultiplied colours converted without their alpha; as they are where that is 0."""
    share = np.where(alpha > 0, alpha, 1).astype(np.float64)[..., None]
    return np.asarray(share * convert(color / share), np.float32)


def _by_blocks(values: Any, convert: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    given = np.asarray(values)
    flat, made = given.reshape(-1), np.empty(given.size, np.float32)
    with np.errstate(over="ignore", under="ignore"):  # what float32 cannot hold is inf or 0 in it
        for first in range(0, given.size, BLOCK):
            part = flat[first : first + BLOCK].astype(np.float64)
            made[first : first + BLOCK] = np.copysign(convert(np.abs(part)), part)
    return made.reshape(given.shape)
