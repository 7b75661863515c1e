"""A pixel of a surface of particles explained: where its ray meets the surface, who makes it there, and what was passed before.

Flow: scene, camera, settings, pixel -> render; coverage along the ray -> [surface] -> SurfaceExplanation.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxsph.analysis.at_places import ParticleField
from jaxsph.analysis.explanation.words import surface_table
from jaxsph.engine.render import render
from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.snug import with_depths
from jaxsph.model.scene import Scene, widened
from jaxsph.model.settings import Settings
from jaxsph.numerics import short
from jaxsph.reference.chords import rays_of
from jaxsph.reference.image import sample_borders
from jaxsph.reference.where import inside, to_world

FINER = 8
"""Places along the ray over samples: what several particles make between two of them is looked for there."""
HALVINGS = 60
SAME = 1e-3
"""Of the least support met, by which a crossing may be off the depth of the picture, and be that."""


@dataclasses.dataclass(frozen=True, eq=False)
class SurfaceExplanation:
    """Why a pixel of a surface is what it is; made by `explain`. Lengths are in units of the scene.

    Attributes:
        pixel: row and column.
        color, alpha: of the pixel, as rendered, with all that is in the scene.
        field: what the surface is a level of, for people; `coverage` is that field.
        level: of it, where the surface is.
        surface_depth: view depth of the surface, as rendered; infinite where the ray does not meet it.
        position: of that place in space; NaN without one.
        normal: of unit length, out of the fluid, in the axes of positions; 0 without one.
        facing: cosine between the normal and the ray: 1 is lit most, 0 is grazed.
        surface_quantity: what particles interpolate there; NaN without one.
        off: how far that depth is from the crossing next to it in float64; NaN without one.
        missed: depth of a crossing in front of that of the picture, of what is thinner than a sample; infinite for none.
        depth: of places along the ray, ascending, `FINER` times as many as samples.
        coverage, quantity: there; NaN where nothing is shown, and the quantity where nothing is.
        particles: entries, ascending, of those whose widened supports hold the place on the surface.
        shares: of the coverage there, of each of them; they add up to 1.
        sources, total, certified: a surface has no error bound: nothing, NaN, False.
    """

    pixel: tuple[int, int]
    color: Float[np.ndarray, "3"]
    alpha: float
    level: float
    surface_depth: float
    position: Float[np.ndarray, "3"]
    normal: Float[np.ndarray, "3"]
    facing: float
    surface_quantity: float
    off: float
    missed: float
    depth: Float[np.ndarray, " places"]
    coverage: Float[np.ndarray, " places"]
    quantity: Float[np.ndarray, " places"]
    particles: Int[np.ndarray, " particles"]
    shares: Float[np.ndarray, " particles"]
    sources: dict[str, float] = dataclasses.field(default_factory=dict)
    total: float = float("nan")
    certified: bool = False
    field: str = "coverage"

    def __repr__(self) -> str:
        where = f"surface at depth {self.surface_depth:.4g}" if np.isfinite(self.surface_depth) else "no surface"
        return short.line("SurfaceExplanation", f"pixel {self.pixel}", where, f"{len(self.particles):,} particles met there")

    def __str__(self) -> str:
        return surface_table(self)


class _Ray:
    """The coverage along the ray of a pixel."""

    def __init__(self, scene: Scene, camera: Camera, row: int, column: int) -> None:
        wide = widened(scene).particles
        assert wide is not None and scene.surface is not None
        self.field, self.level, self._within = ParticleField(wide), float(scene.surface.level), scene.particles_within
        self._camera, self._rays = camera, rays_of(camera, np.array([row]), np.array([column]))

    def places(self, depth: Any) -> Float[np.ndarray, "places 3"]:
        """In space, at view depths."""
        return to_world(self._rays.start + np.reshape(depth, (-1, 1)) * self._rays.direction, self._camera)

    def direction(self) -> Float[np.ndarray, "3"]:
        """Of unit length."""
        first, second = self.places([0.0, 1.0])
        way: np.ndarray = (second - first) / np.linalg.norm(second - first)
        return way

    def along(self, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coverage and quantity; NaN where nothing is shown."""
        places = self.places(depth)
        found, shown = self.field.at(places), inside(self._within, places)
        return np.where(shown, found.coverage, np.nan), np.where(shown, found.quantity, np.nan)

    def crossings(self, depth: np.ndarray, coverage: np.ndarray) -> list[float]:
        """Depths at which the level is crossed between neighbouring places."""
        above = coverage >= self.level
        known = np.isfinite(coverage[1:]) & np.isfinite(coverage[:-1])
        return [self._bisected(*depth[k : k + 2]) for k in np.flatnonzero(known & (above[1:] != above[:-1]))]

    def _bisected(self, low: float, high: float) -> float:
        first = self.field.at(self.places(low)).coverage[0] >= self.level
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            is_first = (self.field.at(self.places(middle)).coverage[0] >= self.level) == first
            low, high = (middle, high) if is_first else (low, middle)
        return (low + high) / 2


def explain_surface(scene: Scene, camera: Camera, settings: Settings, row: int, column: int) -> SurfaceExplanation:
    """See `jaxsph.explain`: of a scene with a surface."""
    camera = with_depths(camera, scene)
    image = render(scene, camera, settings)
    assert scene.surface is not None
    first = dataclasses.replace(scene.surface, opacity=None)
    alone = Scene(particles=scene.particles, transfer=scene.transfer, surface=first, within=scene.within)
    others = bool(scene.media or scene.volumes or scene.point_sets) or scene.surface.opacity is not None
    found = float(np.asarray((render(alone, camera, settings) if others else image).depth)[row, column])
    ray = _Ray(alone, camera, row, column)
    borders = sample_borders(camera, settings.samples)
    depth = np.interp(np.arange(FINER * settings.samples + 1) / FINER, np.arange(settings.samples + 1), borders)
    coverage, quantity = ray.along(depth)
    met, places = np.isfinite(found), ray.places([found if np.isfinite(found) else 0.0])
    there, near = ray.field.at(places), ray.field.near(places if met else places[:0])
    order = np.argsort(near.entry, kind="stable")
    support = np.asarray(scene.particle_set.support, np.float64)[near.entry]
    crossed = ray.crossings(depth, coverage)
    close = SAME * float(support.min(initial=np.inf)) if met else 0.0
    off = min((abs(one - found) for one in crossed), default=np.nan) if met else np.nan
    normal = there.normal[0] if met else np.zeros(3)
    return SurfaceExplanation(
        (row, column),
        np.asarray(image.color)[row, column],
        1 - float(np.asarray(image.transmittance)[row, column]),
        ray.level,
        found,
        places[0] if met else np.full(3, np.nan),
        normal,
        abs(float(normal @ ray.direction())),
        float(there.quantity[0]) if met else np.nan,
        off,
        next((one for one in crossed if one < found - close), np.inf),
        depth,
        coverage,
        quantity,
        near.entry[order],
        near.weight[order] / near.weight.sum(),
        field="coverage" if scene.surface.of == "coverage" else "smoothed quantity",
    )
