"""Slices: what the quantity of particles is on a plane, as numbers and as a picture.

Flow: particles, plane -> orthographic camera -> samples on a lattice -> [slices] -> files, notebooks.

A camera looks against the plane's normal, and each of its rays has one sample, on the plane.
"""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsph.analysis.at_places import on_lattice
from jaxsph.io.images.planes import PlaneAxes, middle_of, write_slice
from jaxsph.model.camera.camera import Camera
from jaxsph.model.clips import Clip, Plane
from jaxsph.model.image import PLANE, Image, dataset, places
from jaxsph.model.particles.field import EvenSamples
from jaxsph.model.particles.particles import Particles
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.numerics import __version__
from jaxsph.numerics.checks import in_unit, require_shape
from jaxsph.numerics.trees import kind_of, line_of, on_host, span_of
from jaxsph.reference.where import inside, lines, ray_coordinates, to_view, to_world

ALONG = 0.9  # cosine of the angle to x or y, from which a normal is along it


@dataclasses.dataclass(frozen=True)
class Slice:
    """The field on a plane; made by `slice`. Row 0 is the top, column 0 the left.

    Attributes:
        values: the quantity Q, float32 or float64, NaN outside of every support; or a plain sum, NaN where nothing is shown.
        camera: orthographic, with its eye in the middle of the slice, looking against the plane's normal.
        metadata: strings and numbers for the file header.
        length_unit: what the unit of lengths is called; empty where it is not known.
    """

    values: Float[np.ndarray, "height width"]
    camera: Camera
    metadata: tuple[tuple[str, Any], ...] = ()
    length_unit: str = ""

    def __repr__(self) -> str:
        return line_of("Slice", kind_of(self.values), f"values {span_of(self.values)}")

    @property
    def pixel_size(self) -> float:
        """Of a pixel's side, length units."""
        return 2 * float(self.camera.half_height) / self.camera.height

    @property
    def _ray_coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        return ray_coordinates(self.camera, np.arange(self.camera.width) + 0.5, np.arange(self.camera.height) + 0.5)

    def positions(self) -> Float[np.ndarray, "height width 3"]:
        """Places of all values, float64, length units."""
        across, down = np.meshgrid(*self._ray_coordinates)
        return to_world(lines(across, down, False)[0], self.camera)

    def image(self, transfer: TransferFunction) -> Image:
        """A picture by the colours of a transfer function, opaque wherever there is a value."""
        there = np.isfinite(self.values)
        filled = np.where(there, self.values, 0)
        colors = np.asarray(transfer.colors, np.float64)
        shown: Any = np.stack([np.interp(filled, np.asarray(transfer.values, np.float64), one) for one in colors.T], -1)
        color = np.where(there[..., None], shown, 0).astype(np.float32)
        transmittance, nothing = np.where(there, 0, 1).astype(np.float32), np.zeros(there.shape, np.float32)
        depth: Any = np.where(there, 0, np.inf).astype(np.float32)
        return Image(color, transmittance, depth, nothing, nothing, True, 0, {}, self.metadata)  # type: ignore[arg-type]

    def save(self, path: str | os.PathLike[str], transfer: TransferFunction | None = None) -> None:
        """Write `.npy` or `.fits` (values), `.exr` (values, and colours where a transfer function is given) or `.png` (colours).

        Raises:
            ValueError: another suffix, a `.png` without a transfer function, a place that cannot be written to.
        """
        axes = PlaneAxes(self.pixel_size, middle_of(self.camera), self.length_unit)
        write_slice(Path(path), self.values, None if transfer is None else self.image(transfer), self.metadata, axes)

    def to_xarray(self) -> Any:
        """Values as an `xarray.Dataset` over `row` and `column`, with coordinates `x` and `y`; metadata are its attributes.

        These are coordinates along the directions that are to the right and upwards: of a plane along z the x and y of positions.

        Raises:
            ImportError: xarray is not installed.
        """
        height, width = self.values.shape
        where = places((height, width), self.pixel_size, middle_of(self.camera), self.length_unit)
        return dataset({"values": (PLANE, self.values)}, where, self.metadata)


@on_host
def slice(
    particles: Particles,
    plane: Plane,
    *,
    within: Clip | None = None,
    center: Any = None,
    up: Any = None,
    view_height: float | None = None,
    width: int = 512,
    height: int = 512,
    of: Any = None,
    normalised: bool = True,
) -> Slice:
    """The field of particles on a plane, or a plain sum over them (host side).

    Args:
        particles: whose quantity is shown; of a periodic set one period.
        plane: a `jaxsph.Plane`, seen from where its normal points to: of one along z, x is to the right and y upwards.
        within: where it is shown; default everywhere.
        center: (3,) what is in the middle, moved to the plane; default the middle of the particles.
        up: (3,) direction that points upwards; default y, or z where the normal is along x or y.
        view_height: visible height, length units; default all of the particles.
        width, height: size in pixels.
        of, normalised: as for `jaxsph.sample`: the plain sum of masses is the density. There is none outside of a period or of
            `within`, and it is 0 outside of every support.

    Raises:
        ValueError: arguments out of range, particles that cannot be rendered.
    """
    if not isinstance(plane, Plane):
        raise ValueError(f"`plane` must be a `jaxsph.Plane`, got {type(plane).__name__}; give a point of it and its normal")
    unit, normal = particles.length_unit, np.asarray(plane.normal, np.float64)
    point = np.asarray(plane.point, np.float64) + np.asarray(plane.rest, np.float64)
    center, view_height = in_unit("center", center, unit), in_unit("view_height", view_height, unit)
    if up is None:
        up = np.eye(3)[2 if np.abs(normal[:2]).max() > ALONG else 1]
    lower, upper = particles.bounds()
    middle = (lower + upper) / 2 if center is None else np.asarray(center, np.float64)
    require_shape("center", middle, (3,), "give x, y and z")
    foot = middle - ((middle - point) @ normal) * normal
    if view_height is None:
        axes = np.asarray(Camera.orthographic(foot, foot - normal, up, 1.0, width, height, near=-1.0, far=1.0).axes, np.float64)
        corners = np.stack(np.meshgrid(*zip(lower, upper, strict=True), indexing="ij"), -1).reshape(-1, 3) - foot
        reach = np.abs(corners @ axes.T).max(0)
        view_height = 2 * max(float(reach[0]) * height / width, float(reach[1])) or 1.0
    deep = view_height / height
    camera = Camera.orthographic(foot, foot - normal, up, view_height, width, height, near=-deep, far=deep)
    said = ("jaxsph.slice", f"point={point.tolist()} normal={normal.round(9).tolist()}")
    metadata = (("jaxsph.version", __version__), said, ("jaxsph.camera", camera.describe()))
    found = Slice(np.zeros((height, width)), camera, metadata, unit or "")
    rays = EvenSamples(*found._ray_coordinates, 0.0, deep, 1, np.zeros((height, width)), False)
    values = on_lattice(particles, rays, lambda position: to_view(position, camera), of, normalised)[..., 0]
    place = found.positions()
    return dataclasses.replace(found, values=np.where(inside(particles.box, place) & inside(within, place), values, np.nan))
