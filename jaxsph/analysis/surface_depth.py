"""The surface of particles as points: how deep it lies on the ray of every pixel, where that is, and which way it faces.

Flow: Scene, Camera, Settings -> render -> depths -> at_places: normals, quantity -> [surface_depth] -> SurfaceDepth -> PLY.
"""

from __future__ import annotations

import dataclasses
import os
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsph.analysis.at_places import ParticleField
from jaxsph.engine.render import render
from jaxsph.io.images.point_cloud import write_points
from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.snug import with_depths
from jaxsph.model.scene import Scene, widened
from jaxsph.model.settings import Settings
from jaxsph.numerics import short
from jaxsph.numerics.checks import is_traced
from jaxsph.reference.chords import rays_of
from jaxsph.reference.where import to_world


@dataclasses.dataclass(frozen=True, eq=False)
class SurfaceDepth:
    """Where rays first meet a surface of particles; made by `surface_depth`. Row 0 is the top, column 0 the left.

    Attributes:
        depth: view depth, length units; inf where there is no surface.
        position: where that is in space, length units, float64; NaN where there is no surface.
        normal: out of the fluid, of unit length, in the axes of positions, float64; 0 where there is no surface.
        quantity: what particles interpolate there (of two quantities that of colours); NaN where there is no surface.
        color: red, green and blue of the surface, lit from the eye, in [0, 1], display-referred; 0 where there is none.
        metadata: strings and numbers for the file header.
    """

    depth: Float[np.ndarray, "height width"]
    position: Float[np.ndarray, "height width 3"]
    normal: Float[np.ndarray, "height width 3"]
    quantity: Float[np.ndarray, "height width"]
    color: Float[np.ndarray, "height width 3"]
    metadata: tuple[tuple[str, Any], ...] = ()

    def __repr__(self) -> str:
        height, width = self.depth.shape
        told = f"{width} x {height}", f"{int(self.met.sum()):,} rays meet it", f"depth {short.span(self.depth[self.met])}"
        return short.line("SurfaceDepth", *told)

    @property
    def met(self) -> np.ndarray:
        """(height, width) where there is a surface."""
        return np.isfinite(self.depth)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all points that are seen as `.ply`: positions, normals, colours and quantity (whole or not at all).

        Raises:
            ValueError: another suffix, a place that cannot be written to.
        """
        met = self.met
        write_points(path, self.position[met], self.normal[met], self.color[met], {"quantity": self.quantity[met]}, self.metadata)


def surface_depth(scene: Scene, camera: Camera, settings: Settings | None = None) -> SurfaceDepth:
    """Where the rays of all pixels first meet the surface of a scene's particles (host side).

    Depths are those of `jaxsph.render`, by its programs, of particles alone: whatever else is in the scene hides nothing, and is
    not in it. Normals and quantity are taken in float64 of the particles around each place: the gradient of the coverage itself.

    Args:
        scene: particles with a `jaxsph.Surface`; where it is clipped, the surface is.
        camera, settings: as for `jaxsph.render`; without a tolerance.

    Raises:
        ValueError: a scene without a surface, traced arguments; as `jaxsph.render`.
        CapacityError: as `jaxsph.render`.

    Warns:
        UserWarning: where no ray meets the surface, with the range of the coverage.
    """
    if is_traced(scene, camera, settings):
        raise ValueError("`surface_depth` needs concrete arrays; call it outside of jit, vmap and grad")
    if scene.surface is None or scene.particles is None:
        raise ValueError("`scene` must have particles and a `surface`, got none; give `jaxsph.Scene` a `jaxsph.Surface()`")
    first = dataclasses.replace(scene.surface, opacity=None)
    alone = Scene(particles=scene.particles, transfer=scene.transfer, surface=first, within=scene.within)
    camera = with_depths(camera, alone)
    image = render(alone, camera, settings)
    depth = np.asarray(image.depth)
    rows, columns = np.nonzero(np.isfinite(depth))
    rays = rays_of(camera, rows, columns)
    place = to_world(rays.start + depth[rows, columns, None].astype(np.float64) * rays.direction, camera)
    wide = widened(alone).particles
    assert wide is not None
    there = ParticleField(wide).at(place)

    def spread(values: np.ndarray, otherwise: float) -> np.ndarray:
        whole = np.full((*depth.shape, *values.shape[1:]), otherwise)
        whole[rows, columns] = values
        return whole

    normal, quantity = spread(there.normal, 0.0), spread(there.quantity, np.nan)
    return SurfaceDepth(depth, spread(place, np.nan), normal, quantity, np.asarray(image.color), image.metadata)
