"""Particles as a camera sees them for a projection: which rule each follows, which pixels it can touch, and its row of the table.

Flow: particles, camera -> [seen] -> plan, lists -> sums.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.analysis.projection.columns import CUT, LARGE, PLANE, SHARES, SMALL, SMOOTH, Rule
from jaxsph.engine.access.precision import unresolved
from jaxsph.engine.access.view import ROUNDING, Spheres, pixel_ranges
from jaxsph.engine.planning.viewing import camera_usable
from jaxsph.engine.runtime.programs import stage
from jaxsph.engine.runtime.tuning import Tuning
from jaxsph.model.camera.camera import Camera
from jaxsph.model.particles.columns import depth_share
from jaxsph.model.particles.particles import Particles
from jaxsph.model.particles.periodic import between_faces, past_faces, runs_through, unfolded
from jaxsph.numerics import faults
from jaxsph.numerics.trees import tree

NARROW = 1 / 32  # of its depth that a support may have for shares in perspective, unless it is smaller than a pixel: ellipses
TINY = 2.0  # pixels that it may have where shares are not exact: with more, rays are good to 3e-4 of the peak
BESIDE_FACES = 1e-4  # of the shortest side of a period, that images may be away from it to be counted: rounding may take them in


@tree()
class Seen:
    """What a projection is made from."""

    rays: Float[Array, "particles columns"]  # table of particles, see `Rule`
    shares: Float[Array, "particles columns"] | None  # the same; None where no rule has shares
    spheres: tuple[Spheres, ...]  # for each rule, with pixels for those that follow it alone
    there: tuple[Bool[Array, ""], ...]  # for each rule, whether any particle follows it, be it beside the picture
    cameras: tuple[Camera, ...]  # for each rule, with the depths that rays begin and end at
    pixels: Float[Array, "height width"] | None  # what share of each lies between the faces of a period; None where all does
    faults: Int[Array, ""]


@stage("rules", "pixel", "images", "through", "least", quickly=True)
def see(
    particles: Particles,
    amounts: Float[Array, "particles channels"],
    camera: Camera,
    doubt: Float[Array, ""],
    *,
    rules: tuple[Rule, ...],
    pixel: str,
    images: int | None,
    through: int | None,
    least: float,
    tuning: Tuning,
) -> Seen:
    """Particles as seen by a camera.

    Within `doubt` times what rounding may be off by, decisions are open: what may be live is, and what may follow either of two
    rules follows both. Theorem: with 2 or more, there are at least the pixels that any other program finds with 0. Each is off by
    less than `ROUNDING` eps of what enters, which margins hold once for itself, and `doubt` times more. Programs round otherwise,
    and whole layers of a lattice lie on the border of a decision. For other arguments see `ProjectionPlan`.

    Differentiation:
        Tables have derivatives; which rule a particle follows, and which pixels it can touch, is held fixed.
    """
    dtype = jnp.promote_types(particles.dtype, camera.dtype)
    camera, pixels, crowded = jax.tree.map(lambda leaf: leaf.astype(dtype), camera), None, jnp.int32(faults.NONE)
    if images is None or particles.box is None:
        particles = particles.wrapped()
    else:
        beyond = BESIDE_FACES * jnp.where(doubt > 0, particles.box.sides.min(), 0)
        particles, source, camera, pixels, crowded = _in_box(particles, camera, beyond, pixel, images, through)
        amounts = amounts[source]
    offset = camera.offset(particles.position, particles.position_rest)
    view, distance = camera.rotate(offset), lax.stop_gradient(jnp.abs(offset).max(1))
    usable = jnp.isfinite(view).all(1) & (particles.support > 0) & jnp.isfinite(particles.support)
    view, support = jnp.where(usable[:, None], view, 0), jnp.where(usable, particles.support, 1)
    (x, y, z), reach, still = lax.stop_gradient(view).T, lax.stop_gradient(support), lax.stop_gradient(camera)
    size = distance + reach + jnp.maximum(jnp.abs(still.near), jnp.abs(still.far))
    off = doubt.astype(dtype) * ROUNDING * jnp.finfo(dtype).eps * size
    live = particles.valid & usable & (z + reach >= still.near - off) & (z - reach <= still.far + off)
    blurred = live & unresolved(lax.stop_gradient(view), distance, reach, still, jnp.zeros(1, dtype))
    amounts = jnp.where(live[:, None], amounts, 0).astype(dtype)
    word = crowded | faults.raised(faults.BAD_PARTICLES, (particles.valid & ~usable).any() | ~jnp.isfinite(amounts).all())
    word |= faults.raised(faults.UNRESOLVED, blurred.any()) | faults.raised(faults.BAD_CAMERA, ~camera_usable(still))
    followed = _followed(rules, z, reach, still, off, least)
    small = followed.get(SHARES, jnp.zeros_like(live))
    wanted = [live & followed[rule.name] for rule in rules]
    margin, cameras = ROUNDING * (1 + doubt.astype(dtype)), tuple(rule.seen_by(camera) for rule in rules)
    spheres = tuple(
        _spheres((x, y, z), reach, distance, one, lax.stop_gradient(own), rule, margin)
        for rule, own, one in zip(rules, cameras, wanted, strict=True)
    )
    inverse, more = 1 / support[:, None], jnp.zeros((view.shape[0], 0), dtype)
    if pixel == PLANE:
        rest = jnp.zeros_like(view) if particles.position_rest is None else particles.position_rest
        more = jnp.where(usable[:, None], camera.rotate(rest), 0)[:, :2]
    rays = jnp.concatenate([view, inverse, more, amounts * inverse * inverse], 1)
    shares = _shares_table(view, support, small, amounts, camera, rules[0].kernel) if rules[0].kind == SHARES else None
    return Seen(rays, shares, spheres, tuple(one.any() for one in wanted), cameras, pixels, word)


def _in_box(
    particles: Particles, camera: Camera, beyond: Array, pixel: str, images: int, through: int | None
) -> tuple[Particles, Array, Camera, Array, Array]:
    """Of a periodic set what its box holds, with images, which particle each is, and what the camera sees of it; faults."""
    assert particles.box is not None
    inside, pixels = between_faces(camera, particles.box, pixel)
    found, source, word = unfolded(particles, images, beyond, through)
    if through is not None:
        word |= faults.raised(faults.LIST_OVERFLOW, ~runs_through(camera, particles.box, through))
        inside = past_faces(camera, particles.box)
    return found, source, inside, pixels, word


def _followed(
    rules: tuple[Rule, ...], z: Array, reach: Array, camera: Camera, off: Array, least: float
) -> dict[str, Bool[Array, " particles"]]:
    """Who follows rules of each name; within `off` of a decision both."""
    pixel, last = 2 * camera.half_height / camera.height, max(rule.stride for rule in rules)

    def whole(off: Array) -> Array:
        return (z - reach >= camera.near - off) & (z + reach <= camera.far + off)

    def small(off: Array) -> Array:
        if rules[0].kind != SHARES:
            return jnp.zeros(z.shape, bool)
        if camera.is_perspective:
            return (z + off > 0) & (reach - off < jnp.maximum(jnp.minimum(TINY * pixel, NARROW), pixel) * (z + off))
        return (reach - off < TINY * pixel) | (whole(off) & (reach - off < SMALL * pixel))

    def of(rule: Rule) -> Array:
        if rule.kind == SHARES:
            return small(off)
        if rule.kind == PLANE:
            return jnp.ones_like(z, bool)
        if rule.kind == CUT:
            return ~whole(-off) & ~small(-off)
        found = whole(off) & ~small(-off)
        if rule.stride > 1:
            found &= reach + off >= least * rule.stride * pixel
        elif SMOOTH in (other.kind for other in rules):
            found &= (reach + off >= LARGE * pixel) if rule.kind == SMOOTH else (reach - off < LARGE * pixel)
        return found if rule.stride == last else found & (reach - off < least * 2 * rule.stride * pixel)

    return {rule.name: of(rule) for rule in rules}


def _spheres(
    view: tuple[Array, ...], support: Array, distance: Array, wanted: Array, camera: Camera, rule: Rule, margin: Array
) -> Spheres:
    """Those `wanted`, with the pixels that they can touch where a rule looks: of a plane the circles in which it cuts them."""
    x, y, z = view
    eps = jnp.finfo(x.dtype).eps * margin
    reach = support * (1 + eps) + eps * distance
    if rule.kind == PLANE:
        away = jnp.clip(jnp.abs(z) - eps * distance, 0, reach)
        z, reach = jnp.zeros_like(z), jnp.sqrt((reach - away) * (reach + away)) * (1 + eps)
    aside = math.sqrt(2) * rule.beside * 2 * camera.half_height / camera.height
    reach = reach + aside * ((jnp.abs(z) + reach) if camera.is_perspective else 1)
    sides: Any = pixel_ranges(x, y, z, reach, wanted, camera, (camera.near, camera.far), margin)
    return Spheres(x, y, z, reach, *sides)


def _shares_table(view: Array, support: Array, small: Array, amounts: Array, camera: Camera, kernel: str) -> Array:
    """Ray coordinates of centres and reciprocals of supports in them, and amounts a unit of area of a pixel.

    With perspective a small support is an ellipse in ray coordinates, of an area that is larger by the slant of its ray.
    """
    x, y, z = view.T
    inverse, pixel = 1 / support, 2 * camera.half_height / camera.height
    ends = (camera.near - z) * inverse, (camera.far - z) * inverse
    inside = jnp.where((ends[0] <= -1) & (ends[1] >= 1), 1, depth_share(kernel, *ends))
    wide, high, area = inverse, inverse, pixel
    if camera.is_perspective:
        z = jnp.where(small, z, 1)
        x, y = x / z, y / z
        wide, high = z * inverse / jnp.sqrt(1 + x * x), z * inverse / jnp.sqrt(1 + y * y)
        area = pixel * z / (1 + x * x + y * y) ** 0.25
    of_area = jnp.where(small[:, None], amounts * (inside / area / area)[:, None], 0)
    return jnp.concatenate([jnp.stack([x, y, wide, high], 1), of_area], 1)
