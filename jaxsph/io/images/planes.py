"""Projections and slices as files: raw values in OpenEXR, FITS or NumPy arrays, or a picture of them.

| suffix | what it holds |
|---|---|
| `.exr` | values as a float32 channel called as they are, such as `mass` or `column.density`; the channel `weight` of means |
| `.npy` | values alone, in their own dtype |
| `.fits` | values in their own dtype, and weights as an extension, with coordinates in lengths; by astropy |
| `.png` | 8 bit colours of a colour map |

The EXR header holds `jaxsph.of`, `jaxsph.unit`, `jaxsph.pixel_area` (length units squared; at depth 1 with perspective) and the
metadata of the projection. Row 0 is the top. The channel `value` of a slice is NaN where there is none; where a picture of it is
given, `R` `G` `B` `A` are that in linear light, as of images (`image_files`).

| card of FITS | holds |
|---|---|
| `CTYPE1`, `CTYPE2` | axes along rows and columns: `X`, `Y`, `Z`, else `RIGHT`, `UP`; with perspective tangents, `X/Z`, `Y/Z` |
| `CRVAL`, `CRPIX`, `CDELT` | coordinates of the middle of the picture, and the side of a pixel, negative against an axis |
| `CUNIT` | unit of lengths, where it is known: these are told in such that the standard spells |
| `BUNIT` | unit of values, as the standard spells it; not there where it cannot |
| `BTYPE` | what the values are |
| `COMMENT` | how they were made, and units as they are told elsewhere |

Values are the same in all files, whatever their unit. A scale factor a and a Hubble parameter h would be years and hours in a
card: units with powers of these stand in comments.

The first row of a FITS file is the lowest, so rows are turned round.
Source: Pence et al. 2010, A&A 524, A42; Greisen & Calabretta 2002, A&A 395, 1061.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxsph.io.damage import DataError, explained, regular_file, require
from jaxsph.io.images.image_files import header_of, light_of, read_layers, write_layers, write_pixels, write_png
from jaxsph.io.replace import known_suffix, written_whole
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.projection import Projection
from jaxsph.numerics.checks import array_of

SUFFIXES = (".exr", ".npy", ".fits", ".png")
WEIGHT = "weight"
MIDDLE, AXES = "jaxsph.middle", "jaxsph.axes"
ALIGNED = 1e-6  # of 1: what an axis of a picture may be off that of the world
NAME, UNIT, AREA, PERSPECTIVE = "jaxsph.of", "jaxsph.unit", "jaxsph.pixel_area", "jaxsph.perspective"


class PlaneAxes(NamedTuple):
    """Where the pixels of a picture are."""

    pixel: float  # side of one, length units; with perspective at depth 1
    middle: tuple[float, float]  # coordinates of the middle of the picture, to the right and upwards, length units
    unit: str  # of lengths; empty where it is not known
    names: Sequence[str] = ("X", "Y")  # of what is to the right and upwards, `-X` where that is against the axis
    perspective: bool = False  # whether rays spread with depth


def middle_of(camera: Camera) -> tuple[float, float]:
    """Coordinates of the middle of a picture, along what is to the right and upwards, length units."""
    x, y, _ = (camera.exact_axes() @ camera.exact_eye()).tolist()
    return x, y


def names_of(camera: Camera) -> list[str]:
    """What is to the right and upwards: an axis, `-X` where it is against it, or of oblique views `RIGHT` and `UP`."""
    axes = camera.exact_axes()[:2]
    along = np.abs(axes).argmax(1)
    named = ("-" * bool(axis[which] < 0) + "XYZ"[which] for axis, which in zip(axes, along, strict=True))
    return list(named) if (np.abs(axes).max(1) > 1 - ALIGNED).all() else ["RIGHT", "UP"]


def told_of(camera: Camera) -> dict[str, str]:
    """What metadata say of a camera, and of the coordinates of its picture."""
    middle = "{!r} {!r}".format(*middle_of(camera))
    return {"jaxsph.camera": camera.describe(), MIDDLE: middle, AXES: " ".join(names_of(camera))}


def converted(values: Any, factor: float) -> np.ndarray:
    """Values times a factor in their dtype, or in float64 where that does not hold them."""
    given = np.asarray(values)
    made, limits = given.astype(np.float64) * factor, np.finfo(given.dtype)
    size = np.abs(made[np.isfinite(made) & (made != 0)])
    return made if size.size and not limits.tiny <= size.min() <= size.max() <= limits.max else made.astype(given.dtype)


def write_projection(path: str | os.PathLike[str], projection: Projection, **look: Any) -> None:
    """Write a projection, whole or not at all; `look` is that of `Projection.to_uint8`, for pictures.

    Raises:
        ValueError: another suffix, a place that cannot be written to, values that float32 cannot hold (EXR).
        ImportError: OpenEXR is not installed, or astropy, for `.fits`.
    """
    projection = projection.as_one("save")
    file, suffix = Path(path), known_suffix(path, SUFFIXES, "projections are written as")
    if look and suffix != ".png":
        raise ValueError(f"{file}: `{next(iter(look))}` is for pictures (.png); raw values have no colours")
    if suffix == ".exr":
        _write_exr(file, projection)
    elif suffix == ".png":
        log, (low, high) = projection.span(look.get("norm"), look.get("range"))
        kind = "symlog " if look.get("norm") == "symlog" else "log " * log
        shown = f"{kind}{low:.6g} to {high:.6g}"
        more = {NAME: projection.name, UNIT: projection.unit, "jaxsph.colors": shown}
        write_pixels(file, projection.to_uint8(**look), dict(projection.metadata) | more)
    else:
        layers = {projection.name: projection.values} | ({} if projection.weight is None else {WEIGHT: projection.weight})
        told = dict(projection.metadata)
        x, y = map(float, told.get(MIDDLE, "0 0").split())
        side, names = math.sqrt(float(projection.pixel_area)), told.get(AXES, "X Y").split()
        axes = PlaneAxes(side, (x, y), projection.length_unit, names, bool(projection.perspective))
        _write_numbers(file, layers, axes, projection.unit, projection.metadata)


def write_slice(
    path: Path, values: np.ndarray, picture: Image | None, metadata: tuple[tuple[str, Any], ...], axes: PlaneAxes
) -> None:
    """Write a slice, whole or not at all; `axes` say where its pixels are."""
    suffix = known_suffix(path, SUFFIXES, "slices are written as")
    if suffix == ".exr":
        layers, header = {"value": _single("value", values)}, dict(metadata)
        if picture is not None:
            light = light_of(picture.color)
            layers |= {**{name: light[..., k] for k, name in enumerate("RGB")}, "A": 1 - np.asarray(picture.transmittance)}
            header |= header_of(displayed=False)
        write_layers(path, layers, header)
    elif suffix != ".png":
        _write_numbers(path, {"value": values}, axes, dict(metadata).get(UNIT, ""), metadata)
    elif picture is None:
        raise ValueError(f"{path}: a picture needs colours; give `transfer`, or write .npy, .fits or .exr")
    else:
        write_png(path, picture)


def read_projection(path: str | os.PathLike[str]) -> Projection:
    """Read the raw values that `write_projection` wrote to an EXR file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: damaged, or not of a projection.
        ImportError: OpenEXR is not installed.
    """
    file = regular_file(path)
    with explained(file, "OpenEXR projection"):
        layers, header = read_layers(file)
        if NAME not in header or _channel(header[NAME]) not in layers:
            raise DataError(f"holds no projection, only channels {' '.join(layers)}; read images by `read_image`")
        known = {NAME, UNIT, AREA, PERSPECTIVE}
        more = tuple((name, value) for name, value in header.items() if name.startswith("jaxsph.") and name not in known)
        weight = layers.get(WEIGHT)
        return Projection(
            array_of(layers[_channel(header[NAME])]),
            None if weight is None else array_of(weight),
            np.float64(header[AREA]) if isinstance(header[AREA], str) else jnp.float32(header[AREA]),
            header[PERSPECTIVE] == "true",
            name=header[NAME],
            unit=header[UNIT],
            metadata=more,
        )


def _write_exr(path: Path, projection: Projection) -> None:
    name = _channel(projection.name)
    layers = {name: _single(name, projection.values)}
    if projection.weight is not None:
        layers[WEIGHT] = _single(WEIGHT, projection.weight)
    area, limits = float(projection.pixel_area), np.finfo(np.float32)  # as numbers of EXR hold it, in float32, or else as text
    own: dict[str, Any] = {AREA: area if float(limits.tiny) <= area <= float(limits.max) else repr(area)}
    own |= {NAME: projection.name, UNIT: projection.unit, PERSPECTIVE: str(bool(projection.perspective)).lower()}
    write_layers(path, layers, dict(projection.metadata) | own)


def _single(name: str, layer: Any) -> np.ndarray:
    """A layer in float32. Raises `ValueError`: its largest values are beyond that, or all of it is."""
    given, limits = np.asarray(layer), np.finfo(np.float32)
    largest = np.abs(given).max(initial=0, where=~np.isnan(given))
    if largest and not limits.tiny <= largest <= limits.max:
        why = f"has values up to {largest:.3g}, that float32 cannot hold, as EXR needs it"
        raise ValueError(f"`{name}` {why}; give them in another unit (--unit), or write .npy or .fits")
    return given.astype(np.float32)


def _channel(name: str) -> str:
    """A name that channels can have, and that is none of those that viewers take for colours."""
    plain = "".join(c if c.isalnum() or c in "._-" else "_" for c in name) or "values"
    return f"of.{plain}" if plain in ("R", "G", "B", "A", "Z", WEIGHT) else plain


def _write_numbers(path: Path, layers: dict[str, Any], axes: PlaneAxes, unit: str, metadata: Iterable[tuple[str, Any]]) -> None:
    """Write layers (height, width) by name, the values first: these alone to `.npy`, to FITS others as extensions too.

    `unit` is that of the values.
    """
    if path.suffix.lower() == ".npy":
        with written_whole(path) as temporary, temporary.open("wb") as stream:
            return np.save(stream, np.asarray(next(iter(layers.values()))), allow_pickle=False)
    fits = require("astropy.io.fits", "FITS files", "fits")
    parts = []
    for number, (name, values) in enumerate(layers.items()):
        kind = fits.ImageHDU if number else fits.PrimaryHDU
        part = kind(np.ascontiguousarray(np.asarray(values)[::-1]))
        part.header.update(_cards(name, np.shape(values), axes))
        if number:
            part.header["EXTNAME"] = _letters(name).upper()
        elif spelled := _spelled(unit)[1]:
            part.header["BUNIT"] = spelled
        parts.append(part)
    left = " (a is the scale factor, h the Hubble parameter)"
    told = {"values": unit, "lengths": axes.unit}.items()
    units = [(f"unit of {what}", f"{text}{left * _has_cosmology(text)}") for what, text in told if text]
    for name, value in (*metadata, *units):
        parts[0].header.add_comment(_letters(f"{name} = {value}"))
    with written_whole(path) as temporary, temporary.open("wb") as file:
        fits.HDUList(parts).writeto(file)


def _cards(name: str, shape: tuple[int, ...], axes: PlaneAxes) -> dict[str, Any]:
    """The coordinate system of a picture, and what its values are."""
    cards: dict[str, Any] = {"BTYPE": _letters(name), "WCSAXES": 2}
    names = ("X/Z", "Y/Z") if axes.perspective else axes.names
    for nth, (label, size, place) in enumerate(zip(names, (shape[1], shape[0]), axes.middle, strict=True), 1):
        factor, spelled = (1.0, None) if axes.perspective else _spelled(axes.unit, scaled=True)
        factor = -factor if label.startswith("-") else factor
        cards |= {f"CTYPE{nth}": label.removeprefix("-"), f"CRPIX{nth}": (size + 1) / 2, f"CDELT{nth}": factor * axes.pixel}
        cards |= {f"CRVAL{nth}": 0.0 if axes.perspective else factor * place}
        if spelled:
            cards[f"CUNIT{nth}"] = spelled
    return cards


def _has_cosmology(unit: str) -> bool:
    return bool({word.partition("^")[0] for word in unit.split()} & {"a", "h"})


def _spelled(unit: str, *, scaled: bool = False) -> tuple[float, str | None]:
    """What numbers in a unit are to be multiplied by, which only `scaled` allows, and the unit as FITS spells it; None where it
    has no word for it.
    """
    if not unit or _has_cosmology(unit):
        return 1.0, None
    units = require("astropy.units", "FITS files", "fits")
    try:
        known = units.Unit(unit)
        factor = float(known.scale) if scaled else 1.0
        return factor, str((known if factor == 1 else units.CompositeUnit(1, known.bases, known.powers)).to_string("fits"))
    except (ValueError, TypeError):
        return 1.0, None


def _letters(text: str) -> str:
    """What of a text FITS can hold: the letters of ASCII that are printed, others as question marks."""
    return "".join(c if " " <= c <= "~" else "?" for c in text)
