r"""Which rays a support sphere can touch: exact tests, rounded outwards.

Flow: particles -> [footprint] -> view, lists.

Every test errs on the side of touching. Rounding is covered by terms that bound it, `ROUNDING * eps` of the magnitudes that
enter, never by a share of the support.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.resolution import ROUNDING
from jaxsph.model.camera.camera import Camera


def pixel_ranges(
    x: Float[Array, " particles"],
    y: Float[Array, " particles"],
    z: Float[Array, " particles"],
    reach: Float[Array, " particles"],
    live: Bool[Array, " particles"],
    camera: Camera,
    between: tuple[Float[Array, ""], Float[Array, ""]],
    rounding: Any = ROUNDING,
) -> tuple[Int[Array, " particles"], ...]:
    """First and last column, first and last row of pixels whose rays can meet each sphere `between` two depths.

    Where the whole sphere lies in front of the eye, the tangents of its silhouette in the (x, z) plane bound x / z exactly;
    the box `[x - H, x + H] / [s_0, s_1]` bounds it always. The tighter is taken. Empty ranges have first > last. With more
    `rounding`, ranges hold all that others can be.
    """
    front = jnp.maximum(z - reach, between[0])
    back = jnp.minimum(z + reach, between[1])
    left, right = _lateral(x, z, reach, (front, back), camera.is_perspective, rounding)
    bottom, top = _lateral(y, z, reach, (front, back), camera.is_perspective, rounding)
    half_width = camera.half_height * (camera.width / camera.height)
    left, right = (0.5 * camera.width * (side / half_width + 1) for side in (left, right))
    top, bottom = (0.5 * camera.height * (1 - side / camera.half_height) for side in (top, bottom))
    columns, rows = _pixels(left, right, camera.width, rounding), _pixels(top, bottom, camera.height, rounding)
    last_column = jnp.where(live & (front <= back), columns[1], -1)
    return columns[0], last_column, rows[0], rows[1]


def _lateral(
    x: Array, z: Array, reach: Array, between: tuple[Array, Array], perspective: bool, rounding: int
) -> tuple[Array, Array]:
    """Bounds of the ray coordinate (x / s, or x if orthographic) over the sphere `between` two depths."""
    front, back = between
    eps = jnp.finfo(x.dtype).eps * rounding
    low, high = x - reach, x + reach
    if not perspective:
        margin = eps * (jnp.abs(x) + reach)
        return low - margin, high + margin
    low, high = low / jnp.where(low < 0, front, back), high / jnp.where(high < 0, back, front)
    low, high = low - eps * jnp.abs(low), high + eps * jnp.abs(high)
    ahead = z > reach * (1 + eps)
    product = jnp.where(ahead, (z - reach) * (z + reach), 1)
    tangent = reach * jnp.sqrt(x * x + product)
    margin = eps * (jnp.abs(x) * z + tangent) * (z / jnp.where(ahead, z - reach, 1))
    low = jnp.where(ahead, jnp.maximum(low, (x * z - tangent - margin) / product), low)
    high = jnp.where(ahead, jnp.minimum(high, (x * z + tangent + margin) / product), high)
    return low, high


def _pixels(low: Array, high: Array, size: int, rounding: Any) -> tuple[Array, Array]:
    """Pixels whose centres lie in [low, high] (image-space units), clipped to the image."""
    margin = jnp.finfo(low.dtype).eps * rounding * size
    margin_low, margin_high = margin * (1 + jnp.abs(low) / size), margin * (1 + jnp.abs(high) / size)
    first = jnp.ceil(low - margin_low - 0.5)
    last = jnp.floor(high + margin_high - 0.5)
    return jnp.clip(first, 0, size).astype(jnp.int32), jnp.clip(last, -1, size - 1).astype(jnp.int32)


def side_distances(
    x: Float[Array, "..."],
    z: Float[Array, "..."],
    low: Float[Array, "..."],
    high: Float[Array, "..."],
    perspective: bool,
) -> tuple[Array, Array]:
    """Signed distance of (x, z) to the wedge of rays between coordinates `low` and `high`, and the normal's z-part.

    Positive outside. The nearer to being outside of the two planes is the one that counts.
    """
    if not perspective:
        outside = jnp.maximum(low - x, x - high)
        return outside, jnp.zeros_like(outside)
    low_norm, high_norm = 1 / jnp.sqrt(1 + low * low), 1 / jnp.sqrt(1 + high * high)
    below, above = (z * low - x) * low_norm, (x - z * high) * high_norm
    return jnp.maximum(below, above), jnp.where(below > above, low * low_norm, -high * high_norm)


def touches(
    x_side: tuple[Array, Array], y_side: tuple[Array, Array], reach: Float[Array, "..."], size: Float[Array, "..."]
) -> Bool[Array, "..."]:
    r"""Whether a sphere meets the pyramid of rays, given its distances to the two wedges.

    With unit normals $n_1, n_2$ of the two violated planes, $c = n_1 \cdot n_2$, distances $a \ge b$: the nearest point of plane
    one is $a$ away, and from there plane two is still $b - c a$ away along a direction of length $\sqrt{1 - c^2}$ a unit, so
    the distance is $\sqrt{a^2 + \max(b - c a, 0)^2 / (1 - c^2)}$. `size` bounds the coordinates, for the rounding: $b - c a$ is
    taken less and $1 - c^2$ more by what it can make of them. So no sphere that touches is left out, however wide the view:
    towards 180 degrees c tends to 1, both roundings to all there is, and the wedge that the sphere is farther from decides.
    """
    (dx, nx), (dy, ny) = x_side, y_side
    cosine, eps = nx * ny, jnp.finfo(reach.dtype).eps
    far, near = jnp.maximum(dx, dy), jnp.minimum(dx, dy)
    slack = eps * ROUNDING * size
    beyond = jnp.maximum(near - cosine * far - slack, 0)
    far = jnp.maximum(far, 0)
    limit = reach + slack
    return far * far + beyond * beyond / (1 - cosine * cosine + eps * ROUNDING) * (far > 0) <= limit * limit
