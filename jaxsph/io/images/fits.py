"""FITS files of values on a plane, with a linear coordinate system in lengths, by astropy.

Flow: Projection, Slice -> [fits] -> file.

| card | holds |
|---|---|
| `CTYPE1`, `CTYPE2` | `X` to the right, `Y` upwards: linear, in lengths; with perspective `X/Z` and `Y/Z`, which are tangents |
| `CRVAL`, `CRPIX`, `CDELT` | coordinates of the middle of the picture, and the side of a pixel |
| `CUNIT`, `BUNIT` | units of lengths and of values, where they are known: numbers are told in such that the standard spells |
| `BTYPE` | what the values are |
| `COMMENT` | how they were made |

The first row of a FITS file is the lowest, so rows are turned round. The values come first, others are extensions.
Source: Pence et al. 2010, A&A 524, A42; Greisen & Calabretta 2002, A&A 395, 1061.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from jaxsph.io.libraries import require
from jaxsph.io.replace import written_whole
from jaxsph.model.camera.camera import Camera


@dataclasses.dataclass(frozen=True)
class PlaneAxes:
    """Where the pixels of a picture are.

    Attributes:
        pixel: side of a pixel, length units; with perspective at depth 1.
        middle: coordinates of the middle of the picture, to the right and upwards, length units.
        unit: of lengths; empty where it is not known.
        perspective: whether rays spread with depth.
    """

    pixel: float
    middle: tuple[float, float] = (0.0, 0.0)
    unit: str = ""
    perspective: bool = False


def middle_of(camera: Camera) -> tuple[float, float]:
    """Coordinates of the middle of a picture, along what is to the right and upwards, length units."""
    x, y, _ = (np.asarray(camera.axes, np.float64) @ camera.exact_eye()).tolist()
    return x, y


def write(
    path: Path, layers: dict[str, np.ndarray], axes: PlaneAxes, unit: str = "", metadata: Iterable[tuple[str, Any]] = ()
) -> None:
    """Write layers (height, width) by name, the values first, whole or not at all; `unit` is that of the values.

    Raises `ImportError`: astropy is not installed.
    """
    fits = require("astropy.io.fits", "FITS files", "fits")
    parts = []
    for number, (name, values) in enumerate(layers.items()):
        kind = fits.ImageHDU if number else fits.PrimaryHDU
        factor, spelled = _spelled(unit) if not number else (1.0, None)
        rows = np.asarray(values)[::-1]
        part = kind(np.ascontiguousarray(rows) if factor == 1 else factor * rows.astype(np.float64))  # whose range is that of CGS
        part.header.update(_cards(part.header, name, np.shape(values), axes))
        if number:
            part.header["EXTNAME"] = _letters(name).upper()
        elif unit:
            part.header["BUNIT"] = spelled or _letters(unit)
        parts.append(part)
    for name, value in metadata:
        parts[0].header.add_comment(_letters(f"{name} = {value}"))
    with written_whole(path) as temporary, temporary.open("wb") as file:
        fits.HDUList(parts).writeto(file)


def _cards(header: Any, name: str, shape: tuple[int, ...], axes: PlaneAxes) -> dict[str, Any]:
    """The coordinate system of a picture, and what its values are."""
    cards: dict[str, Any] = {"BTYPE": _letters(name), "WCSAXES": 2}
    for nth, (label, size, place) in enumerate(zip("XY", (shape[1], shape[0]), axes.middle, strict=True), 1):
        cards |= {f"CTYPE{nth}": f"{label}/Z" if axes.perspective else label, f"CRPIX{nth}": (size + 1) / 2}
        factor, spelled = (1.0, None) if axes.perspective else _spelled(axes.unit)
        cards |= {f"CRVAL{nth}": 0.0 if axes.perspective else factor * place, f"CDELT{nth}": factor * axes.pixel}
        if spelled:
            cards[f"CUNIT{nth}"] = spelled
    return cards


def _spelled(unit: str) -> tuple[float, str | None]:
    """What numbers in a unit are to be multiplied by, and the unit as FITS spells it; None where it has no word for it.

    A scale factor a and a Hubble parameter h are no years and hours.
    """
    if not unit or {word.partition("^")[0] for word in unit.split()} & {"a", "h"}:
        return 1.0, None
    units = require("astropy.units", "FITS files", "fits")
    try:
        known = units.Unit(unit)
        whole = known if float(known.scale) == 1 else units.CompositeUnit(1, known.bases, known.powers)
        return float(known.scale), str(whole.to_string("fits"))
    except (ValueError, TypeError):
        return 1.0, None


def _letters(text: str) -> str:
    """What of a text FITS can hold: the letters of ASCII that are printed, others as question marks."""
    return "".join(c if " " <= c <= "~" else "?" for c in text)
