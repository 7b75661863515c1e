r"""What a ray finds where it crosses a surface, as a function of the particles that make it: the implicit function theorem.

Flow: bracket -> [root: place -> field -> light] -> particle_surface; cotangents -> [root] -> particles.

With F the field, p all that it depends on, and t the depth of a crossing, $F(t, p) = c$ makes t a function of p and c whose
derivatives are those of one step of Newton's with its slope held fixed, $dt = (dc - F_p \, dp) / F_t$. What is found there, G
(field, gradient and quantities), moves by $G_p \, dp + G_t \, dt$. So however the root was found, only the place counts.

Backward, $\bar G$ gives the place the cotangent $\bar t + \bar G \cdot G_t$, and the field takes minus that over $F_t$: what is
found then has the cotangents of particles at a place that stays, in one more pass over them.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxsph.engine.field.crossing import Bracket
from jaxsph.engine.field.piercing import Found, Piercing
from jaxsph.engine.media.surfaces.iso_surface import headlight
from jaxsph.model.medium import COLORS
from jaxsph.model.transfer.function import Segments, find, read
from jaxsph.numerics.extremes import clamped, ratio
from jaxsph.numerics.trees import tree

Vectors = list[Float[Array, "tasks rays"]]


class Root(NamedTuple):
    """Where rays cross the level, relative to the middle of their slab, and what is found there."""

    place: Float[Array, "tasks rays"]
    found: Found


class OfRoot(NamedTuple):
    """Cotangents of particles, `field.transposed.COLUMNS`, of the level, and of a common factor of all u and v."""

    table: Float[Array, "particles 8"]
    level: Float[Array, ""]
    factor: Float[Array, ""]


@tree()
class SurfaceLook:
    """How a surface looks.

    Attributes:
        color: red, green and blue where no transfer function colours it.
        ambient: share of the light that it has where it is seen edge on.
        segments: of the transfer function that colours it; None without one.
        light: x, y and z in view space of a vector of unit length towards the light; None for one at the eye.
    """

    color: Float[Array, "3"]
    ambient: Float[Array, ""]
    segments: Segments | None
    light: Float[Array, "3"] | None = None

    def shade(self, found: Found, ray: Vectors, reference: Float[Array, "tasks 1"]) -> tuple[Vectors, Vectors]:
        """Red, green and blue, lit; and the normal out of the fluid, of unit length, 0 where the field has no slope.

        Args:
            ray: x, y and z of vectors along the rays.
            reference: what the quantities that were found are relative to.
        """
        steepest = lax.stop_gradient(jnp.stack([abs(of) for of in found.gradient]).max(0))
        gradient = [jnp.where(steepest > 0, of / jnp.where(steepest > 0, steepest, 1), 0) for of in found.gradient]
        square = gradient[0] ** 2 + gradient[1] ** 2 + gradient[2] ** 2
        normal = [-of * lax.rsqrt(jnp.where(square > 0, square, 1)) for of in gradient]
        light = headlight(normal, ray, self.ambient, self.light)
        return [color * light for color in self._colors(found, reference)], normal

    def _colors(self, found: Found, reference: Float[Array, "tasks 1"]) -> list[Float[Array, "..."]]:
        """Red, green and blue before they are lit."""
        if self.segments is None:
            return list(self.color)
        return read(self.segments, find(self.segments, reference + found.weighted[0] * ratio(1.0, found.weight)), COLORS)


def slope_along(found: Found, ray: Vectors) -> Float[Array, "tasks rays"]:
    """Of the field, a unit of depth."""
    return found.gradient[0] * ray[0] + found.gradient[1] * ray[1] + found.gradient[2] * ray[2]


def root_near(rays: Piercing, bracket: Bracket, level: Float[Array, ""], is_root: Bool[Array, ""]) -> Root:
    """The root in a bracket, by a step of Newton's from its secant, which has the derivatives; and what is found there.

    Args:
        is_root: whether the secant is the root: then it stays, and the step has the derivatives alone.

    Differentiation:
        By the particles, the rays and the level, as of an implicit function; the bracket has none.
    """
    bracket = lax.stop_gradient(bracket)
    given = bracket.secant()

    def find(nth: Array, root: Root) -> Root:
        slope = lax.stop_gradient(slope_along(root.found, rays.ray()))  # 0 before anything is found
        place = given + jnp.where(slope != 0, (level - root.found.weight) / jnp.where(slope != 0, slope, 1), 0)
        taken = jnp.where(is_root | (nth == 0), given, clamped(place, bracket.low, bracket.high))
        place = place + lax.stop_gradient(taken - place)
        return Root(place, rays.found(place))

    zero = jnp.zeros_like(given)
    nothing = Found(zero, (zero,) * 3, (zero,) * len(rays.task.entry.references))
    return lax.fori_loop(0, 2, find, Root(given, nothing))  # at the secant, and at the root


def pull_root(table: Float[Array, "particles 8"], rays: Piercing, place: Float[Array, "tasks rays"], cotangents: Root) -> OfRoot:
    """Cotangents of all that a root depends on, from those of the root; 0 where the field has no slope along the ray."""
    _, moved = jax.jvp(rays.found, (place,), (jnp.ones_like(place),))
    of_found = cotangents.found
    of_place = cotangents.place
    for of, along in zip(jax.tree.leaves(of_found), jax.tree.leaves(moved), strict=True):
        of_place = of_place + of * along
    slope = moved.weight
    of_level = jnp.where(slope != 0, of_place / jnp.where(slope != 0, slope, 1), 0)
    table, factor = rays.pull(table, place, of_found._replace(weight=of_found.weight - of_level))
    return OfRoot(table, of_level.sum(), factor)
