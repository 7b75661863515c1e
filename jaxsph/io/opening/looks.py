"""Colours and opacity of a file's quantity where nobody chose: by the kind of data that its name says.

Flow: Particles or Volume, names of quantities, Look -> [looks] -> TransferFunction, what was chosen.

| kind | names | colours |
|---|---|---|
| `density` | density, rho, mass, pressure, column densities | over decades, from dark red |
| `temperature` | temperature, internal energy, entropy | over decades, from violet to yellow |
| `velocity` | components of vectors, and all that has both signs | diverging, even about 0 |
| `speed`, `magnetic` | speed and Mach number; strengths of fields | from blue to white |
| `fluid` | concentrations, dyes, all else | viridis |

Opacity follows the logarithm of its quantity where that is positive and spreads over more than a decade.
"""

from __future__ import annotations

import dataclasses
import os
from typing import Any

import numpy as np

from jaxsph.io.json_files import read_transfer
from jaxsph.io.opening.options import Look
from jaxsph.io.settle.quantities import LOG_PREFIX, ROLES, is_log, spreads
from jaxsph.io.table import plain
from jaxsph.model.particles.particles import Particles
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.transfer.looks import (
    OPTICAL_DEPTH,
    PRESETS,
    default_volume_transfer,
    domain_transfer,
    opacity_by_second,
    preset,
)
from jaxsph.model.transfer.maps import TAILS
from jaxsph.model.volume import Volume
from jaxsph.numerics.checks import array_of

KINDS = {
    "temperature": (*ROLES["temperature"], *ROLES["internal_energy"], "entropy", "energy"),
    "density": (*ROLES["density"], *ROLES["mass"], "pressure", "numberdensity", "metallicity"),
    "speed": ("speed", "mach", "machnumber"),
    "magnetic": ("fieldstrength",),
}
"""Names by which the kind of a quantity is known, but for case and punctuation."""
SIGNED = 0.05  # of the largest value, what the smallest must be below zero for a quantity to have both signs
LEAST_POWER, PER_DECADE, LESS = 4.0, 1.5, 2.0
"""With which extinction rises over the logarithm of its quantity, at least; and of D decades with `PER_DECADE` D - `LESS`."""


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
    values = np.asarray(second, np.float64)
    real = values[np.asarray(particles.valid)]
    if not (real >= 0).all() or not spreads(real):
        return particles, opacity_by
    least = float(real[real > 0].min())
    logarithm = array_of(np.log10(np.maximum(values, least)), second.dtype)
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
    if look.transfer is not None:
        if isinstance(look.transfer, TransferFunction):
            return look.transfer, "the transfer function given"
        return read_transfer(os.fspath(look.transfer)), f"{os.fspath(look.transfer)}"
    depth = look.optical_depth or OPTICAL_DEPTH
    second = isinstance(shown, Particles) and shown.extinction_quantity is not None
    whole: Any = shown
    alone = dataclasses.replace(whole, extinction_quantity=None) if second else whole
    made, called = _made(alone, name, look, depth)
    if not second:
        return made, called
    low, high = np.percentile(np.asarray(whole.extinction_quantity, np.float64)[np.asarray(whole.valid)], TAILS)
    ramp = max(LEAST_POWER, PER_DECADE * float(high - low) - LESS) if by_log else "steep"
    return opacity_by_second(made, whole, depth, ramp=ramp), called


def _made(shown: Particles | Volume, name: str, look: Look, depth: float) -> tuple[TransferFunction, str]:
    """Of one quantity."""
    if is_log(name) and look.norm == "log":
        other = name[len(LOG_PREFIX) :]
        raise ValueError(f"`norm` 'log' is for a quantity, and {name} is a logarithm already: leave it out, or color by {other}")
    if look.preset is None and look.norm not in (None, "linear"):
        colormap = look.colormap or PRESETS[_kind(shown, name)].colormap
        return domain_transfer(shown, str(look.norm), colormap, look.range, depth), f"{colormap}, {look.norm},"
    if isinstance(shown, Volume) and look.preset is None:
        colormap = look.colormap or "viridis"
        return default_volume_transfer(shown, colormap, look.range, depth), colormap
    kind = look.preset or _kind(shown, name)
    norm = "linear" if look.norm is None and is_log(name) and PRESETS[kind].domain == "log" else look.norm
    more: dict[str, Any] = {"range": look.range, "norm": norm, "colormap": look.colormap}
    return preset(kind, shown, **more, optical_depth=depth), f"{look.colormap or PRESETS[kind].colormap} ({kind})"


def _kind(shown: Particles | Volume, name: str) -> str:
    if isinstance(shown, Volume):
        return kind_of(name, np.asarray(shown.values, np.float64))
    return kind_of(name, np.asarray(shown.quantity, np.float64)[np.asarray(shown.valid)])
