r"""A surface of particles that lets light through: each time a ray crosses it is a layer of one opacity.

Flow: grid, schedule -> [surface layers: borders -> crossings -> roots -> light] -> integrator.

All crossings of a slab are found, see `field.crossing`, and put into the intervals that they lie in. Layers of an interval are
composited among themselves, in order of depth: what is in front of a layer dims it by one less its opacity. Other media that
share the interval are mixed with them as media are, as if all were spread over it.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsph.engine.access.view import Viewed
from jaxsph.engine.field.crossing import all_crossings
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.media.surfaces.iso_surface import OPAQUE
from jaxsph.engine.media.surfaces.particle_surface import ParticleSurface, Place
from jaxsph.model.clips.clips import Clip
from jaxsph.model.medium import Cotangents, Places, Stops
from jaxsph.model.particles.particles import Particles
from jaxsph.model.particles.surface import Surface
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.numerics import faults
from jaxsph.numerics.extremes import lesser, ratio
from jaxsph.numerics.trees import tree


class Layers(NamedTuple):
    """Where rays meet the surface in slabs: of each interval some places, in order of depth.

    Attributes:
        depth: view depth; infinite where a place is none.
        color: red, green and blue, lit.
        normal: of unit length, out of the fluid, in view space; 0 for none.
    """

    depth: Float[Array, "tasks samples places rays"]
    color: Float[Array, "tasks samples places 3 rays"]
    normal: Float[Array, "tasks samples places 3 rays"]


@tree(static=("kernel",))
class SurfaceLayers(ParticleSurface):
    """The surface of a scene's particles in view space with an opacity, see `jaxsph.Surface`.

    Attributes:
        opacity: of a layer, in (0, 1].
    """

    opacity: Float[Array, ""] | float = 1.0

    @classmethod
    def seen_through(
        cls, surface: Surface, particles: Particles, viewed: Viewed, transfer: TransferFunction | None, clip: Clip | None
    ) -> SurfaceLayers:
        """See `ParticleSurface.seen`; of one with an opacity."""
        made: Any = cls.seen(surface, particles, viewed, transfer, clip)
        opacity = jnp.asarray(surface.opacity, viewed.x.dtype)
        fault = made.fault | faults.raised(faults.BAD_SURFACE, ~((opacity > 0) & (opacity <= 1)))
        shone_through: SurfaceLayers = dataclasses.replace(made, opacity=opacity, fault=fault)
        return shone_through

    def gather(self, task: SlabTask) -> Layers:  # type: ignore[override]
        """Every crossing of the rays of slabs, and how the surface looks there.

        Differentiation:
            As `ParticleSurface.gather`.
        """
        on_borders, weight = self.on_borders(task)
        still = lax.stop_gradient(self)
        brackets = all_crossings(still.rays, lax.stop_gradient(on_borders), weight, still.level, still.cut())
        found = lax.map(lambda bracket: self.place(on_borders, bracket), brackets)

        def by_interval(of: Array) -> Array:
            return jnp.moveaxis(of.reshape(-1, 2, *of.shape[1:]), 2, 0)

        return Layers(*map(by_interval, found))

    def extinction(self, gathered: Layers, task: SlabTask) -> tuple[Array, Array]:  # type: ignore[override]
        """Of all layers of each interval; and their colour in all."""
        dtype = gathered.depth.dtype
        left, light = jnp.ones_like(gathered.depth[:, :, 0]), jnp.zeros_like(gathered.color[:, :, 0])
        for k in range(gathered.depth.shape[2]):
            opacity = jnp.where(jnp.isfinite(gathered.depth[:, :, k]), self.opacity, 0).astype(dtype)
            light = light + (left * opacity)[:, :, None] * gathered.color[:, :, k]
            left = left * (1 - opacity)
        path, taken = task.path(), (1 - left)[:, :, None]
        thickness = jnp.where(left > 0, lesser(-jnp.log(jnp.where(left > 0, left, 1)), OPAQUE), OPAQUE)
        return ratio(thickness, path), ratio(light, taken)

    def colors(self, samples: Array, task: SlabTask, channels: slice) -> list[Array]:  # type: ignore[override]
        """Of the layers of each interval, lit."""
        return [samples[:, :, k] for k in range(3)[channels]]

    def stops(self, gathered: Layers, task: SlabTask) -> Stops:  # type: ignore[override]
        """See `Medium.stops`: the first layer of each ray, which does not end it."""
        depth, _, normal = (of.reshape(of.shape[0], -1, *of.shape[3:]) for of in gathered)
        first = jnp.argmin(lax.stop_gradient(depth), 1)[:, None]
        found = jnp.take_along_axis(normal, first[:, :, None], 1)[:, 0]
        return jnp.take_along_axis(depth, first, 1)[:, 0], *(found[:, k] for k in range(3))  # type: ignore[return-value]

    def pull_gather(  # type: ignore[override]
        self, total: Cotangents, gathered: Layers, task: SlabTask, cotangents: Layers
    ) -> tuple[Cotangents, Places]:
        """See `Medium.pull_gather`."""
        depth, *of_places = (
            jnp.moveaxis(of, (1, 2), (0, 1)).reshape(-1, *of.shape[:1], *of.shape[3:]) for of in (gathered.depth, *cotangents)
        )

        def pull_one(nth: Array, carry: tuple[Cotangents, Array]) -> tuple[Cotangents, Array]:
            total, factor = carry
            total, more = self.pull_place(total, task, depth[nth], Place(*(of[nth] for of in of_places)))
            return total, factor + more

        total, factor = lax.fori_loop(0, depth.shape[0], pull_one, (total, jnp.zeros((), depth.dtype)))
        return total, Places.none(task)._replace(factor=factor)
