"""How what a file holds is shown where nobody chose: colours and opacity by the kind of data that its name says, or a surface.

Flow: Particles or Volume, names of quantities, Look -> [looks] -> TransferFunction, Surface or None, what was chosen.

Colours go by the kind of data (`jaxsph.model.transfer.looks`): by its name (`KINDS`), or as a `velocity` where it has both signs.

Opacity follows the logarithm of its quantity where that is positive and spreads over more than a decade.

Particles are shown by their surface where that was asked for, or where nobody chose and they are a liquid. A surface of a
quantity is asked for by name, and shown at its median where no level is given: by that a camera frames it.

A liquid is told by its data: particles lie evenly, hardly two of them closer than half a spacing, as pressure keeps them apart,
and all supports are one length, of about two spacings. Files of gas, in formats of codes for it, are never taken for liquids.
"""

from __future__ import annotations

import dataclasses
import os
from typing import Any

import numpy as np
import scipy

from jaxsph.io.json_files import read_transfer
from jaxsph.io.opening.options import Look, Source
from jaxsph.io.settle.assemble import Report
from jaxsph.io.settle.quantities import LOG_PREFIX, is_log, spreads
from jaxsph.io.settle.supports import even_spacing
from jaxsph.io.table import ROLES, plain
from jaxsph.model.image import rgb
from jaxsph.model.particles.particles import Particles
from jaxsph.model.preview.glimpse import RISING, extinction_at
from jaxsph.model.projection import SIGNED
from jaxsph.model.scene import Surface
from jaxsph.model.transfer.function import TransferFunction, fitted
from jaxsph.model.transfer.looks import default_transfer, opacity_by_second
from jaxsph.model.transfer.maps import TAILS, colormap as colors_of, colors_at
from jaxsph.model.transfer.presets import OPTICAL_DEPTH, PRESETS
from jaxsph.model.volume import Volume
from jaxsph.numerics.checks import array_of
from jaxsph.numerics.rows import share_places

KINDS = {
    "temperature": (*ROLES["temperature"], *ROLES["internal_energy"], "entropy", "energy"),
    "density": (*ROLES["density"], *ROLES["mass"], "pressure", "numberdensity", "metallicity"),
    "speed": ("speed", "mach", "machnumber"),
    "magnetic": ("fieldstrength",),
}  # names by which the kind of a quantity is known, but for case and punctuation
POWER, POWERS, THIN = 0.5, 65, 0.2
"""Of a density whose logarithm is shown, with which extinction rises, below 1, as that of columns of a projection is; values at
which it is laid; and the share of particles, the thinnest, that give half of all light, up to which it rises as the density: 0.3
to 0.7 as a rule, and 0.1 of a disc in a halo a hundred times as large, which would be all that is seen.
"""
LIFTED, PALE = 0.2, 0.8  # share of the light end of a map that is left out where it is turned round; channels of a pale colour
LEAST_POWER, PER_DECADE, LESS = 4.0, 1.5, 2.0
"""With which extinction rises over the logarithm of its quantity, at least; and of D decades with `PER_DECADE` D - `LESS`."""
OF_LIQUIDS = "Houdini bgeo", "legacy VTK", "VTK XML", "PLY", "ParaView table", "DualSPHysics table"
"""Formats that liquids are kept in, by tools that draw their surface: points that lie evenly are one, without supports, too."""
OF_BOTH = "text table", "PySPH"  # which gas is kept in, too: it has temperatures or energies, or is as wide as what it is in
ALSO = (*OF_LIQUIDS, *OF_BOTH, "NumPy archive", "HDF5 points", "XDMF")  # in which particles with supports may be a liquid
CELL, FULL = 0.75, 0.95  # of a support, cells of the box around particles; and the share of them that these are in all over it
LEAST, MOST = 1.5, 3.0  # support of a liquid over its spacing; mixed and splashing ones have 2.0 to 2.3
NEAR, FEW = 0.5, 0.05
"""Of the spacing, within which at most such a share of particles has a neighbour: up to 0.014 of liquids, 0.3 at random."""
SHOWN: dict[str, Any] = {"light": (-0.5, 0.8, 0.7), "occlusion": 0.8, "antialias": 4}
"""How surfaces are shown of which nobody said more than a level."""
ONE, SAMPLED = 1e-6, 1 << 14
"""Of a support, by which others may differ and be the same; and particles whose nearest neighbour is looked at."""


def kind_of(name: str, values: np.ndarray) -> str:
    """The preset that suits a quantity, by its name and by its signs."""
    bare = name[len(LOG_PREFIX) :] if is_log(name) else name
    if bare is name and values.size:
        low, high = np.percentile(values, TAILS)
        if low < -SIGNED * abs(high) and high > 0 and plain(bare) not in "xyz":
            return "velocity"
    wanted = plain(bare)
    return next((kind for kind, names in KINDS.items() if wanted in map(plain, names)), "fluid")


def by_logarithm(particles: Particles, opacity_by: str | None) -> tuple[Particles, str | None]:
    """The particles with extinction by the logarithm of its quantity, where that spreads over more than a decade; its name."""
    second = particles.extinction_quantity
    if second is None or opacity_by is None or is_log(opacity_by):
        return particles, opacity_by
    values, real = np.asarray(second, np.float64), particles.unpadded(second)
    if not (real >= 0).all() or not spreads(real):
        return particles, opacity_by
    logarithm = array_of(np.log10(np.maximum(values, real[real > 0].min())), second.dtype)
    return dataclasses.replace(particles, extinction_quantity=logarithm), LOG_PREFIX + opacity_by


def look_of(shown: Particles | Volume, name: str, look: Look, *, by_log: bool = False) -> tuple[TransferFunction, str]:
    """The transfer function that is asked for, or chosen by the kind of data; and its name, for people.

    Its extinction is that of typical columns (`jaxsph.scenes.fitted`): `opening` fits it to the picture afterwards.

    Args:
        shown: what is looked at.
        name: of the quantity that colours are looked up by.
        look: what was asked for.
        by_log: extinction is looked up by a logarithm: over more decades it rises the more steeply, as else thin gas in a large
            box hides what is dense.

    Raises:
        ValueError: a norm or a range that the quantity does not suit.
        OSError: a file of a transfer function that cannot be read.
    """
    if (given := transfer_of(look)) is not None:
        return given, "the transfer function given" if given is look.transfer else str(look.transfer)
    depth = look.optical_depth or OPTICAL_DEPTH
    second = isinstance(shown, Particles) and shown.extinction_quantity is not None
    whole: Any = shown
    alone = dataclasses.replace(whole, extinction_quantity=None) if second else whole
    made, called = _made(alone, name, look, depth)
    if look.colormap is None and is_light(look.background):
        made, called = _turned(made, called)
    if not second:
        return made, called
    low, high = np.percentile(whole.unpadded(whole.extinction_quantity), TAILS)
    ramp = max(LEAST_POWER, PER_DECADE * float(high - low) - LESS) if by_log else "steep"
    return opacity_by_second(made, whole, depth, ramp=ramp), called


def transfer_of(look: Look) -> TransferFunction | None:
    """The transfer function that is asked for, read if it is the name of a file."""
    return read_transfer(look.transfer) if isinstance(look.transfer, str | os.PathLike) else look.transfer


def is_light(background: str | None) -> bool:
    """Whether what is behind a picture is nearer to white than to black, which is behind it where nothing is said."""
    return background not in (None, "transparent") and float(np.mean(rgb(background))) > 0.5


def _turned(made: TransferFunction, called: str) -> tuple[TransferFunction, str]:
    """With colours from light to dark: where they are from dark to light, or pale in the middle, which is not clear."""
    rows, middle = np.asarray(made.colors), len(made.colors) // 2
    clear = made.extinction_values is None and not float(made.extinction[middle]) > RISING * float(np.max(made.extinction))
    if rows[-1].mean() - rows[0].mean() < RISING:
        if rows[middle].min() < PALE or clear:
            return made, called
        rows, called = colors_of("heat", len(rows)), "heat"
    place = np.linspace(1 - LIFTED, 0, len(rows)) * (len(rows) - 1)
    colors = colors_at(place, np.arange(len(rows)), rows)
    turned = dataclasses.replace(made, colors=array_of(colors, made.colors.dtype))
    return turned, f"{called}, from light to dark for a light background,"


def _made(shown: Particles | Volume, name: str, look: Look, depth: float) -> tuple[TransferFunction, str]:
    """Of one quantity."""
    if is_log(name) and look.norm == "log":
        other = name[len(LOG_PREFIX) :]
        raise ValueError(f"`norm` 'log' is for a quantity, and {name} is a logarithm already: leave it out, or color by {other}")
    if look.preset is None and look.norm not in (None, "linear"):
        colormap = look.colormap or PRESETS[kind_of(name, values_of(shown))].colormap
        return default_transfer(shown, colormap, look.range, depth, norm=look.norm), f"{colormap}, {look.norm},"
    if isinstance(shown, Volume) and look.preset is None:
        return default_transfer(shown, colormap := look.colormap or "viridis", look.range, depth), colormap
    kind = look.preset or kind_of(name, values_of(shown))
    norm = "linear" if look.norm is None and is_log(name) and PRESETS[kind].domain == "log" else look.norm
    more: dict[str, Any] = {"range": look.range, "norm": norm, "colormap": look.colormap}
    made = TransferFunction.preset(kind, shown, **more, optical_depth=depth)
    if kind == "density" and is_log(name):
        at = np.linspace(float(made.values[0]), float(made.values[-1]), POWERS)
        colored, place = (np.asarray(made.values), np.asarray(made.colors)), np.linspace(0, 1, POWERS) ** 2
        for power in (POWER, 1.0):
            rising = TransferFunction.from_points(*colored, place * 10 ** (power * (at - at[-1])), at)
            if isinstance(shown, Volume) or _thinnest(shown, rising) > THIN:
                break
        made = fitted(rising, shown, depth)
    return made, f"{look.colormap or PRESETS[kind].colormap} ({kind})"


def _thinnest(shown: Particles, look: TransferFunction) -> float:
    """The share of the particles, those of the lowest quantity, that half of the light is from."""
    quantity = shown.unpadded(shown.quantity)
    light = (extinction_at(look, quantity) * shown.unpadded(shown.volume))[np.argsort(quantity)]
    return float((np.cumsum(light) < light.sum() / 2).mean()) if light.any() else 1.0


def values_of(shown: Particles | Volume) -> np.ndarray:
    """The values that colours are looked up by."""
    return np.asarray(shown.quantity)[np.asarray(shown.valid)] if isinstance(shown, Particles) else np.asarray(shown.values)


def surface_of(
    shown: Particles | Volume, report: Report | None, look: Look, source: Source | None, *, clipped: bool = False
) -> Surface | None:
    """The surface that is asked for, or that of a liquid; None shows a medium.

    Args:
        shown: what is looked at; of a sequence the particles of one of its files, by which all are shown alike.
        report: how particles were settled.
        look, source: what was asked for.
        clipped: whether clips cut what is shown: nothing closes a surface there, and what was asked for is to see inside.

    Raises `ValueError`: a surface of a volume, which is another.
    """
    asked = look.surface_of is not None or look.surface not in (None, False)
    if asked and isinstance(shown, Volume):
        raise ValueError("`surface` is of particles, and this is a volume; `jaxsph.IsoSurface` is where that has a value")
    if look.surface_of is not None:
        return _of_quantity(shown, look)
    of_medium = look.transfer, look.optical_depth, look.exposure or None, None if source is None else source.opacity_by
    medium = look.surface is False or clipped or any(one is not None for one in of_medium)
    if not asked and (medium or not isinstance(shown, Particles) or not _is_liquid(shown, report, source)):
        if look.of_surface:
            asked_for = next(iter(look.of_surface))
            raise ValueError(f"`{asked_for}` is of a surface, and there is none: give `surface`, or leave that out")
        return None
    return shown_surface(look)


def shown_surface(look: Look, level: Any = None, of: str = "coverage") -> Surface:
    """The surface of a level, of the look's own if it has one, shaded as that says."""
    if isinstance(look.surface, Surface):
        return look.shaded(look.surface if of == "coverage" else dataclasses.replace(look.surface, of=of))
    level = level if look.surface is None else look.surface
    return look.shaded(Surface(Surface().level if level is None else level, of, **SHOWN))


def _of_quantity(particles: Any, look: Look) -> Surface:
    """The surface of what particles carry besides their colours, or of what they are coloured by if that is the same."""
    of = "quantity" if particles.extinction_quantity is None else "extinction_quantity"
    if look.surface is not None:
        return shown_surface(look, of=of)
    values = particles.unpadded(getattr(particles, of))
    level = float(np.median(values)) if values.size else 1.0
    if not level > 0:
        raise ValueError(f"`surface` must be a level of {look.surface_of} > 0, and the median of its values is {level:g}")
    return shown_surface(look, level, of)


def within_surface(shown: Particles, surface: Surface) -> Particles:
    """What a camera is to frame: of a quantity's surface the particles that have the level, if any has."""
    if surface.of == "coverage":
        return shown
    high = np.asarray(shown.valid) & (np.asarray(getattr(shown, surface.of)) >= float(surface.level))
    return dataclasses.replace(shown, valid=array_of(high)) if high.any() else shown


def told_of_surface(surface: Surface, look: Look) -> str:
    """Where it is, and whether it was chosen, for people."""
    if look.surface_of is not None:
        chosen = "" if look.surface is not None else ", which half of the particles have; --surface LEVEL sets another"
        return f"where {look.surface_of}, smoothed by kernels, is {surface.level:.6g}{chosen}"
    smoothed = "" if surface.smoothing == 1 else f", supports times {surface.smoothing:g}"
    chosen = "" if look.surface is not None else ", as of a liquid, which lies evenly; --surface none shows a medium"
    return f"where the coverage by particles is {surface.level:g}{smoothed}{chosen}"


def _is_liquid(particles: Particles, report: Report | None, source: Source | None) -> bool:
    """Whether particles are those of a liquid, by the format of their file, and by how they lie."""
    if report is None or report.source not in ALSO or (source is not None and source.support is not None):
        return False
    columns = particles.to_numpy()
    support, position = columns["support"].astype(np.float64), columns["position"].astype(np.float64)
    if report.evenly:
        return report.source in OF_LIQUIDS or (report.source in OF_BOTH and not report.gas and not _is_full(position, support[0]))
    if not len(support) or np.ptp(support) > ONE * support[0]:
        return False
    spacing = even_spacing(position)
    if spacing is None or not LEAST <= support[0] / spacing <= MOST:
        return False
    if share_places(position):
        return False
    nearest = scipy.spatial.cKDTree(position).query(position[:: -(-len(position) // SAMPLED)], 2)[0][:, 1]
    return float((nearest < NEAR * spacing).mean()) <= FEW


def _is_full(position: np.ndarray, support: float) -> bool:
    """Whether particles are all over the box around them."""
    extent = np.ptp(position, axis=0)
    number = np.maximum(extent // (CELL * support), 1).astype(int)
    cell = np.minimum((position - position.min(0)) / np.where(extent > 0, extent, 1) * number, number - 1).astype(int)
    return len(np.unique(cell, axis=0)) > FULL * number.prod()
