"""Particles by their surface where that was asked for, or where nobody chose and they are a liquid.

Flow: Particles or Volume, Report, Look -> [surfaces] -> Surface or None, what was chosen.
"""

from __future__ import annotations

from jaxsph.io.opening.options import Look, Source
from jaxsph.io.settle.assemble import Report
from jaxsph.model.particles.particles import Particles
from jaxsph.model.particles.surface import Surface
from jaxsph.model.volume import Volume

OF_LIQUIDS = "Houdini bgeo", "legacy VTK", "VTK XML", "PLY"
"""Formats that liquids are kept in, by tools that draw their surface."""


def surface_of(shown: Particles | Volume, report: Report | None, look: Look, source: Source | None) -> Surface | None:
    """The surface that is asked for, or that of a liquid; None shows a medium.

    Args:
        shown: what is looked at; of a sequence the particles of one of its files, by which all are shown alike.
        report: how particles were settled.
        look, source: what was asked for.

    Raises:
        ValueError: a surface of a volume, which is another.
    """
    if look.surface is None:
        return Surface() if _is_liquid(report) and not _of_medium(look, source) else None
    if look.surface is False:
        return None
    if isinstance(shown, Volume):
        raise ValueError("`surface` is of particles, and this is a volume; `jaxsph.IsoSurface` is where that has a value")
    return look.surface if isinstance(look.surface, Surface) else Surface(look.surface)


def told_of_surface(surface: Surface, look: Look) -> str:
    """Where it is, and whether it was chosen, for people."""
    smoothed = "" if surface.smoothing == 1 else f", supports times {surface.smoothing:g}"
    chosen = "" if look.surface is not None else ", as of a liquid; --surface none shows a medium"
    return f"where the coverage by particles is {surface.level:g}{smoothed}{chosen}"


def _is_liquid(report: Report | None) -> bool:
    """Whether particles lie evenly, without supports of their own, in a file of a kind that liquids are kept in."""
    return report is not None and report.evenly and report.source in OF_LIQUIDS


def _of_medium(look: Look, source: Source | None) -> bool:
    """Whether anything was asked for that only a medium has."""
    own = look.transfer, look.optical_depth, look.exposure or None, None if source is None else source.opacity_by
    return any(one is not None for one in own)
