"""Where an octree over spheres is cut, such that what lies below is no larger than some pixels.

Flow: spheres, camera -> keys -> [octree_cut] -> coarse.

A node holds all centres whose Morton keys begin with the same digits: in the order of keys, a run. Its box is the smallest in
view space around the spheres that it holds. A node is *small* if its box is between near and far, and no wider, higher or deeper
than so many pixels where it is nearest to the eye. The box of a child is within that of its parent, and no nearer; every one of
these sizes then is at most that of the parent, in floating point too, as minima, maxima, differences and quotients are rounded
monotonically. So whatever is below a small node is small, and the highest small nodes are a cut through the tree.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.access.morton import DIGITS, NOWHERE, morton_keys
from jaxsph.model.camera import Camera
from jaxsph.model.particles import Particles


class Cut(NamedTuple):
    """The highest small nodes.

    Attributes:
        order: of the spheres by key.
        head: of each sphere in that order, the place of the first of its node; its own where it is in no small node.
    """

    order: Int[Array, " spheres"]
    head: Int[Array, " spheres"]


class _Boxes(NamedTuple):
    lower: Float[Array, "spheres 3"]
    upper: Float[Array, "spheres 3"]


def octree_cut(spheres: Particles, camera: Camera, pixels: Float[Array, ""] | float) -> Cut:
    """Cut the octree over the centres of spheres; those that are not valid are in no node.

    Args:
        spheres: radii are supports.
        pixels: largest size of a small node.

    Differentiation:
        None: a decision.
    """
    spheres, camera = lax.stop_gradient((spheres, camera))
    keys = morton_keys(spheres)
    order = jnp.argsort(keys, stable=True)
    keys = keys[order]
    view, radius = camera.to_view(spheres.position, spheres.position_rest)[order], spheres.support[order][:, None]
    own = jnp.arange(keys.shape[0], dtype=jnp.int32)
    placed = keys < NOWHERE

    def climb(state: tuple[Array, _Boxes, Array, Array]) -> tuple[Array, _Boxes, Array, Array]:
        level, boxes, head, _ = state
        shifted = keys >> (3 * level).astype(keys.dtype)
        start = lax.cummax(jnp.where(shifted == jnp.roll(shifted, 1), 0, own)).at[0].set(0)
        boxes = _Boxes(
            jax.ops.segment_min(boxes.lower, start, keys.shape[0], indices_are_sorted=True)[start],
            jax.ops.segment_max(boxes.upper, start, keys.shape[0], indices_are_sorted=True)[start],
        )
        small = _small(boxes, camera, pixels) & placed
        return level + 1, boxes, jnp.where(small, start, head), small.any()

    def more(state: tuple[Array, _Boxes, Array, Array]) -> Array:
        return state[3] & (state[0] <= DIGITS)

    start = jnp.int32(0), _Boxes(view - radius, view + radius), own, jnp.asarray(True)
    return Cut(order, lax.while_loop(more, climb, start)[2])


def _small(boxes: _Boxes, camera: Camera, pixels: Float[Array, ""] | float) -> Bool[Array, " spheres"]:
    (left, bottom, nearest), (right, top, farthest) = boxes.lower.T, boxes.upper.T
    between = (nearest > camera.near) & (farthest < camera.far)
    depth = farthest - nearest
    if camera.is_perspective:
        front, back = (jnp.where(between, at, 1) for at in (nearest, farthest))
        left, bottom = (jnp.minimum(at / front, at / back) for at in (left, bottom))
        right, top = (jnp.maximum(at / front, at / back) for at in (right, top))
        depth = depth / front
    largest = pixels * 2 * camera.half_height / camera.height
    return between & (right - left <= largest) & (top - bottom <= largest) & (depth <= largest)
