r"""How a surface is lit: from the eye or by a lamp, and less where the fluid itself stands around.

Flow: place, normal, ray -> [light] -> share of its colour that a surface shows.

**Occlusion** of short reach is told by the coverage around: with Gaussians of a width $\sigma$ in place of kernels,
$B(x) = \sum_j V_j G_\sigma(x - x_j)$, sampled at $x + a n$, in front of a place x by $a = 3/2 \sigma$ along the normal n out of
the fluid. In front of what is flat that is $b = \Phi(-a/\sigma)$ of what it is within, where it bulges less, and in its folds
more: of the light from all around $\max(B - b, 0) / (1 - b)$ is held to be hidden. As all directions are averaged over, it is
smooth, and the same from wherever one looks. B is looked up on a grid over the box of all particles, made once a frame;
$\sigma$ is the median support, or more where that is too little for the grid.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsph.engine.access.volume_grid import VolumeGrid
from jaxsph.model.camera.camera import Camera
from jaxsph.model.particles.particles import Particles
from jaxsph.model.volume import Volume
from jaxsph.numerics.extremes import clamped, ratio
from jaxsph.numerics.trees import tree

SIDE = 96  # points of the grid along each axis
AWAY, LEAST_CELLS, MARGIN = 1.5, 1.5, 4.0  # of sigma: where it is looked up; cells, at least; and room around all particles
FLAT = 0.5 * math.erfc(AWAY / math.sqrt(2))  # what is there of a half space whose surface that is
STEPS = 2**16 - 1  # kept as whole numbers: they have no derivatives, and take half of the memory
Vector = Sequence[Float[Array, "..."]]


def dot(one: Vector, other: Vector) -> Float[Array, "..."]:
    """Of x, y and z of vectors."""
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def headlight(normal: Vector, ray: Vector, ambient: Float[Array, ""]) -> Float[Array, "..."]:
    """Ambient light, and that from the eye, which a surface faces (Lambert); where it faces nowhere, all of it.

    Args:
        normal, ray: x, y and z of a vector across the surface and of one along the ray, of any lengths.
        ambient: share of the light that a surface has which is seen edge on.
    """
    along, square = jnp.abs(dot(normal, ray)), dot(normal, normal) * dot(ray, ray)
    return ambient + (1 - ambient) * jnp.where(square > 0, along * lax.rsqrt(jnp.where(square > 0, square, 1)), 1)


def lamp(normal: Vector, light: Float[Array, "3"], ambient: Float[Array, ""]) -> Float[Array, "..."]:
    """Ambient light, and that of a lamp far away and as wide as the sky around it: $(1 + n l) / 2$ of it at a normal n.

    So no side is black, nor any rim; what faces nowhere has a half.

    Args:
        normal: x, y and z of a vector across the surface in view space, of unit length or 0.
        light: to the lamp, rightwards, upwards and towards the eye; of any length.
        ambient: share of the light that a surface has which faces away from it.
    """
    right, up, back = light * ratio(1.0, jnp.sqrt((light**2).sum()))
    return ambient + (1 - ambient) * 0.5 * (1 + dot(normal, (right, up, -back)))


@tree()
class Surroundings:
    """The coverage by particles, smoothed over what is around: 1 within a fluid.

    Attributes:
        grid: `STEPS` times that, on a grid in view space.
        away: where it is looked up, in front of a surface, length units.
    """

    grid: VolumeGrid
    away: Float[Array, ""]

    @classmethod
    def of(cls, particles: Particles, level: Float[Array, ""], camera: Camera) -> Surroundings:
        """Of particles in the world, by twice the level of their surface: a half is halfway into the fluid. Held fixed."""
        particles, level, camera = lax.stop_gradient((particles, level, camera))
        place, dtype = particles.position, particles.support.dtype
        counts = particles.valid & (particles.volume > 0) & jnp.isfinite(place).all(1)
        volume, far = jnp.where(counts, particles.volume, 0), jnp.finfo(dtype).max
        ascending = jnp.sort(jnp.where(counts, particles.support, far))
        support = ascending[jnp.maximum(counts.sum() - 1, 0) // 2]  # whatever room there is, as a sum would not be
        lower, upper = (of(jnp.where(counts[:, None], place, sign * far), 0) for of, sign in ((jnp.min, 1), (jnp.max, -1)))
        size = jnp.maximum(upper - lower, 0)  # of no particles nothing
        wide = jnp.maximum(jnp.where(counts.any(), support, 1), LEAST_CELLS * size.max() / (SIDE - 1 - 2 * MARGIN * LEAST_CELLS))
        lower, cell = lower - MARGIN * wide, (size + 2 * MARGIN * wide) / (SIDE - 1)
        nearest = jnp.clip(jnp.round((place - lower) / cell), 0, SIDE - 1).astype(jnp.int32)
        made = jnp.zeros((SIDE,) * 3, dtype).at[tuple(nearest.T)].add(volume * ratio(0.5, level))
        steps = jnp.arange(SIDE, dtype=dtype)
        for step in cell:  # axis after axis, the first of what is left each time, which becomes the last
            weights = jnp.exp(-0.5 * ((steps[:, None] - steps) * (step / wide)) ** 2) / (wide * math.sqrt(2 * math.pi))
            made = jnp.tensordot(made, weights, ([0], [0]))
        values = jnp.round(STEPS * clamped(made, 0, 1)).astype(jnp.uint16)
        grid = VolumeGrid.seen(Volume(values, lower, cell, jnp.zeros_like(lower)), camera)
        return cls(grid, AWAY * wide)

    def hidden(self, place: Vector, normal: Vector) -> Float[Array, "tasks rays"]:
        """Share of the light from all around that fluid is in the way of, at view coordinates with a normal of unit length."""
        at = lax.stop_gradient([(here + self.away * along)[:, None] for here, along in zip(place, normal, strict=True)])
        around = self.grid.interpolate(self.grid.coordinates(tuple(at)))[:, 0] / STEPS
        return clamped((around - FLAT) / (1 - FLAT), 0, 1)
