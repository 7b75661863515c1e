"""Read particles, points, volumes and images, write volumes and images. Optional libraries are imported when needed.

Flow: file -> [read_table] -> ParticleTable -> [particles_from_table] -> Particles ... Image -> [write_image] -> file.

A ParticleTable holds what the file holds; Particles carry one quantity, with supports and volumes settled. The report
of `particles_from_table` says how they were settled. `read_points` makes Points of the same files.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsph.io.damage import DataError
from jaxsph.io.file_units import without_cosmology
from jaxsph.io.formats import FORMATS, Format, find_format, read_with
from jaxsph.io.images.image_files import read_image, write_image
from jaxsph.io.images.movie import MovieInfo, movie_info, write_movie
from jaxsph.io.images.planes import read_projection, write_projection
from jaxsph.io.json_files import read_camera_path, read_transfer, write_camera_path, write_transfer
from jaxsph.io.opening.opened import read_scene
from jaxsph.io.opening.options import Source
from jaxsph.io.opening.part_types import read_together
from jaxsph.io.settle.assemble import FROM_FILE, Report, particles_from_table
from jaxsph.io.settle.points import PointsReport, points_from_table
from jaxsph.io.settle.quantities import available_quantities
from jaxsph.io.settle.supports import kernel_sum, nearest_neighbour_supports
from jaxsph.io.settle.where import ConditionError
from jaxsph.io.table import ParticleTable
from jaxsph.io.units import Labels, labels_of
from jaxsph.io.volumes.volume_files import is_volume, read_volume, read_volume_table, volume_from_table, write_volume
from jaxsph.io.volumes.volume_table import VolumeTable
from jaxsph.model.particles.particles import Particles
from jaxsph.model.points import Points
from jaxsph.numerics.names import refuse_unknown

__all__ = [
    "FORMATS",
    "ConditionError",
    "DataError",
    "Format",
    "Labels",
    "MovieInfo",
    "ParticleTable",
    "PointsReport",
    "Report",
    "VolumeTable",
    "available_quantities",
    "is_volume",
    "kernel_sum",
    "labels_of",
    "movie_info",
    "nearest_neighbour_supports",
    "particles_from_table",
    "points_from_table",
    "read_camera_path",
    "read_image",
    "read_particles",
    "read_points",
    "read_projection",
    "read_scene",
    "read_table",
    "read_transfer",
    "read_volume",
    "read_volume_table",
    "volume_from_table",
    "write_camera_path",
    "write_image",
    "write_movie",
    "write_projection",
    "write_transfer",
    "write_volume",
]


def read_table(path: str | os.PathLike[str], *, part_type: int | str | None = None, physical: bool = False) -> ParticleTable:
    """Read a particle file as it is: positions, columns, and supports and volumes where the format defines them.

    The format is found by content, else by suffix: `.npz`, `.hdf5` `.h5` (Gadget, SWIFT, GIZMO, AREPO, Phantom,
    points), `.vtk`, `.vtu`, `.vtp`, `.ply`, `.bgeo`, Gadget binary, dumps of Phantom, `.csv` `.txt` `.xyz` `.dat`.

    Args:
        path: the file.
        part_type: for formats with particle types, which one to read, by number (Gadget: 0 gas, 1 dark matter, ...; Phantom:
            1 gas, -1 sinks) or name ("gas", "dm", "disk", "bulge", "stars", "bh", "sinks", ...); `None` means gas, or the first
            other type there is. Several, as "gas,stars", are one set, each with its own supports and volumes, and with the
            columns that all of them have (`jaxsph.io.opening.part_types.together`).
        physical: whether the scale factor and the Hubble parameter are taken out of all numbers, as `jaxsph.io.file_units` says.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: unknown format, a damaged file, positions that are not finite, no such particle type.
        ImportError: a library that the format needs is not installed; the message says how to install it.
    """
    return _read(path, part_type, physical)


def _read(path: str | os.PathLike[str], part_type: int | str | None, physical: bool, *settled: Any) -> ParticleTable:
    """The particles of a type, or of several as one set, `settled` by a support, a kernel and a box."""
    if isinstance(part_type, str) and "," in part_type and ":" not in part_type:
        return read_together(path, Source(part_type=part_type).types, physical, *settled)
    table = read_with(find_format(Path(path)), Path(path), part_type)
    return without_cosmology(table) if physical else table


def read_particles(
    path: str | os.PathLike[str],
    quantity: str | None = None,
    support: float | str | Float[np.ndarray, " particles"] | None = None,
    *,
    kernel: str | None = None,
    part_type: int | str | None = None,
    progress: bool = False,
    physical: bool = False,
    **which: Any,
) -> Particles:
    """Read a particle file, ready to render.

    Args:
        path: the file; see `read_table` for formats.
        quantity: a column, a component (`velocity.x`), `density`, `speed`, `x`, `y`, `z`, an expression of these
            (`"Masses * Density"`, see `jaxsph.io.settle.where`), what is computed, such as `temperature`
            (`jaxsph.io.settle.derived`), or `log10:` before any of them; `None` picks the first
            telling one of a concentration, temperature, density, internal energy, speed.
        support: support radius in the file's length unit, or an expression of columns, as `"2*h"`; `None` means the file's own,
            else two spacings where particles lie evenly, else the distance to the 32nd neighbour.
        kernel: its name, one of `jaxsph.model.particles.kernels.KERNELS`; `None` for that of the file or its code, else poly6.
        part_type: which type of particles to read, or which types, see `read_table`.
        progress: show progress bars; on a terminal large sets show them anyway.
        physical: as for `read_table`; a given `support` or `box` is in physical lengths then.
        which: any of `box`, `where`, `share` and `opacity_by`.
        box: (Lx, Ly, Lz), sides of a periodic box; "file" for that of the file, `None` for none.
        where: a condition on the particles that are shown, such as `"Temperature > 1e4 and Density < 2"`
            (`jaxsph.io.settle.where`); what is derived (supports, volumes, densities) is of all particles.
        share: in (0, 1]: a share of the particles at random, for a quick look, drawn before supports are found: it changes the
            field, in which each stands for as many.
        opacity_by: name of the quantity that extinction is looked up by, if that is another; `"auto"` for the logarithm of the
            density where densities spread over more than a decade, as the normalised field would show gas of any density at
            full strength. `jaxsph.scenes.default_transfer` makes a transfer function that suits.

    Returns:
        Particles with quantity, support and volume; `particles_from_table` also tells how they were found.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: see `read_table` and `particles_from_table`.
        ImportError: a library that the format needs is not installed; the message says how to install it.
    """
    refuse_unknown(read_particles, which, ("box", "where", "share", "opacity_by"))
    of_all = support if isinstance(support, str | int | float) else None
    table = _read(path, part_type, physical, of_all, kernel, which.get("box", FROM_FILE))
    return particles_from_table(table, quantity, support, kernel, progress=progress, **which)[0]


def read_points(
    path: str | os.PathLike[str],
    *,
    color: Any = None,
    radius: Any = None,
    extinction: Any = None,
    opacity: Any = None,
    profile: Any = "gaussian",
    colormap: str = "viridis",
    part_type: int | str | None = None,
) -> Points:
    """Read points (stars, galaxies, tracers) from a file of any particle format, such as CSV with `x,y,z,radius,r,g,b,opacity`.

    Each of these is a number, or the name of a column; what is `None` is taken from the file where it is there
    (`jaxsph.io.settle.points` says under which names). Colours and opacities in whole numbers up to 255 are bytes.

    Args:
        path: the file; see `read_table` for formats.
        color: three numbers in [0, 1], the name of a column of colours, or of a quantity that a colour map shows; else white.
        radius: length units; must be given where the file has none.
        extinction: at the centre, a unit length.
        opacity: that of a whole point along a ray through its centre; where neither is known, 0.8.
        profile: as for `Points.from_arrays`.
        colormap: name of a colour map.
        part_type: which type of particles to read, see `read_table`; stars are 4 of a Gadget-like file, sinks -1 of Phantom's.

    Returns:
        Points; `points_from_table` also tells how they were found.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: see `read_table` and `points_from_table`.
        ImportError: a library that the format needs is not installed; the message says how to install it.
    """
    table = read_with(find_format(Path(path)), Path(path), part_type)
    given = {"color": color, "radius": radius, "extinction": extinction, "opacity": opacity}
    return points_from_table(table, **given, profile=profile, colormap=colormap)[0]
