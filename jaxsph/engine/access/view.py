r"""Particles as a camera sees them: view coordinates, strengths, the pixels that each can touch, and their ranks.

Flow: particles -> [view] -> plan; [view: ranks] -> lists -> grid -> cast -> image.

First all that is asked of a single particle, whatever the others are: capacities are counted from it. Then particles are ranked
by support class and depth, so that a slab of samples meets a *window* of ranks. Those of similar support form a class (a factor
of two wide); within a class they are ranked by depth. A particle of class c can touch a sample at depth s only if
$|z - s| < H_c$, the largest support of the class, so the particles that can touch a slab of samples are at most one contiguous
window of ranks a class. With supports spread over 20 000 : 1 a window of all particles together would hold nearly everything; a
window a class is never more than about twice too deep.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.precision import lift_of_sizes, unresolved, weakest
from jaxsph.model.camera.camera import Camera
from jaxsph.model.particles import kernels
from jaxsph.model.particles.particles import Particles
from jaxsph.numerics import faults
from jaxsph.numerics.compiled import greater, is_subnormal, mantissa_and_exponent, power_of_two
from jaxsph.numerics.trees import tree

DEPTH_BITS = 24  # resolution of the depth key; with 8 bits of class and 32 of index it fills one 64-bit word
DEAD_CLASS = 255
KEY_MARGIN = 8  # keys that a window is wider on either side: a key is at most an ulp of its depth, a logarithm errs by a few
ROUNDING = 16  # half-ulps that a view coordinate or a ray coordinate may be off, with a wide margin


@tree()
class Spheres:
    """Spheres in view space: all that lists are made from.

    Attributes:
        x, y, z: view coordinates, length units.
        reach: the support widened by the rounding of coordinates: what lies outside has weight zero in floating point.
        left, right, top, bottom: first and last column, first and last row of pixels whose rays can meet it; none where
            `left > right` or `top > bottom`.
    """

    x: Float[Array, " particles"]
    y: Float[Array, " particles"]
    z: Float[Array, " particles"]
    reach: Float[Array, " particles"]
    left: Int[Array, " particles"]
    right: Int[Array, " particles"]
    top: Int[Array, " particles"]
    bottom: Int[Array, " particles"]


@dataclasses.dataclass(frozen=True)
class Columns(Spheres):
    """Of particles; those that no sample can meet are not `live`, and their numbers are 0.

    Attributes:
        scale, size: the particle's strength m = V / H^3, of which the largest is 2^`precision.LIFT`, folded into its lengths:
            `size = m^(1/n)` and `scale = size / H`, with n the degree of its kernel.
        quantity: that is carried; of two, that of colours.
        live: whether any sample can meet the particle.
        extinction_quantity: the second that is carried; None where there is one alone.
    """

    scale: Float[Array, " particles"]
    size: Float[Array, " particles"]
    quantity: Float[Array, " particles"]
    live: Bool[Array, " particles"]
    extinction_quantity: Float[Array, " particles"] | None = dataclasses.field(default=None, kw_only=True)

    @property
    def quantities(self) -> tuple[Float[Array, " particles"], ...]:
        """One or two; none of particles whose weights alone are asked for."""
        return tuple(one for one in (self.quantity, self.extinction_quantity) if one is not None)


@tree()
class Viewed(Columns):
    """Particles in their own order.

    Attributes:
        key: class of support above depth, what they are ranked by.
        widest: largest reach of each class.
        faults: fault word.
    """

    key: Int[Array, " particles"]
    widest: Float[Array, " classes"]
    faults: Int[Array, ""]

    @property
    def in_picture(self) -> Bool[Array, " particles"]:
        """Those that any ray through a pixel can meet."""
        return self.live & (self.left <= self.right) & (self.top <= self.bottom)


def view_particles(
    particles: Particles, camera: Camera, depths: Float[Array, " samples"], num_classes: int, fringe: float = 0
) -> Viewed:
    """See `particles` from `camera`, with samples at `depths` (ascending), by rays so many pixels beside those of pixels.

    Differentiation:
        The columns x, y, z, scale, size and quantities have derivatives; all else is held fixed.
    """
    offset = camera.offset(particles.position, particles.position_rest)
    view = camera.rotate(offset)
    x, y, z = view[:, 0], view[:, 1], view[:, 2]
    finite = functools.reduce(jnp.logical_and, map(jnp.isfinite, particles.quantities), jnp.isfinite(view).all(1))
    usable = finite & (particles.support > 0) & jnp.isfinite(particles.support)
    usable &= (particles.volume >= 0) & jnp.isfinite(particles.volume)
    eps = jnp.finfo(view.dtype).eps * ROUNDING
    distance = jnp.abs(offset).max(1)
    reach = lax.stop_gradient(particles.support * (1 + eps) + eps * distance)
    if fringe:  # two rays are as far apart at the depths that a sphere reaches
        apart = lax.stop_gradient(2**0.5 * fringe * 2 / camera.height * camera.half_height * (1 + eps))
        reach = reach + apart * (lax.stop_gradient(greater(z, 0)) + reach if camera.is_perspective else 1)
    live = particles.valid & usable & (z + reach >= depths[0]) & (z - reach <= depths[-1])

    # the class of each particle, by octaves below the largest reach
    largest = jnp.where(live, reach, 0).max(initial=0)
    octave = jnp.floor(jnp.log2(jnp.where(live & (largest > 0), largest / reach, 1)))
    octave = jnp.where(live, jnp.clip(octave, 0, num_classes - 1), DEAD_CLASS).astype(jnp.uint32)
    each = jnp.arange(num_classes, dtype=jnp.uint32)[:, None]
    widest = jnp.where(live & (octave == each), reach, 0).max(1, initial=0)
    scale, size, vanishes = _folded(particles, live)
    columns = {"x": x, "y": y, "z": z, "scale": scale, "size": size}
    columns |= dict(zip(("quantity", "extinction_quantity"), particles.quantities, strict=False))
    columns = {name: jnp.where(live, column, 0) for name, column in columns.items()}
    blurred = unresolved(view, distance, particles.support, camera, depths)
    word = faults.raised(faults.BAD_PARTICLES, particles.valid & ~usable)
    word |= faults.raised(faults.UNRESOLVED, live & blurred) | faults.raised(faults.WEAK_PARTICLES, vanishes)
    x, y, z = (lax.stop_gradient(columns[name]) for name in "xyz")
    still, between = lax.stop_gradient(camera), (depths[0], depths[-1])
    sides = dict(zip(("left", "right", "top", "bottom"), pixel_ranges(x, y, z, reach, live, still, between), strict=True))
    key = (octave << DEPTH_BITS) | depth_key(camera, z)
    return Viewed(**columns, **sides, reach=reach, live=live, key=key, widest=widest, faults=jnp.bitwise_or.reduce(word))


def depth_key(camera: Camera, z: Float[Array, "..."]) -> Int[Array, "..."]:
    """Depth as an integer of `DEPTH_BITS` bits, uniform in sample space, clamped at near and far."""
    z = jnp.clip(z, camera.near, camera.far)
    if camera.is_perspective:
        part = jnp.log(z / camera.near) / jnp.log(camera.far / camera.near)
    else:
        part = (z - camera.near) / (camera.far - camera.near)
    part = jnp.clip(part.astype(jnp.float32), 0, 1)
    return jnp.minimum(part * (1 << DEPTH_BITS), (1 << DEPTH_BITS) - 1).astype(jnp.uint32)


def _folded(particles: Particles, live: Bool[Array, " particles"]) -> tuple[Array, Array, Array]:
    """`scale` and `size` of every particle, and which are so weak that they would vanish.

    CSPH only knows ratios of strengths. They are taken by mantissa and exponent, as H^3 soon leaves the range of float32. What
    all of them are divided by changes nothing, and carries no gradient; nor does a strength of 0.
    """
    strength, peak, _, counts = _strengths(particles, live)
    support, volume = jnp.where(live, particles.support, 1), jnp.where(live, particles.volume, 0)
    strength = strength / jnp.where(peak > 0, peak, 1)
    kernel = kernels.by_name(particles.kernel)
    lift = 2.0 ** lift_of_sizes(kernel)
    size = jnp.where(strength > 0, lift * jnp.where(strength > 0, strength, 1) ** (1 / kernel.degree), 0)
    weak = (counts & (strength < weakest(kernel, strength.dtype))) | (live & is_subnormal(volume))
    return size / support, size, weak


def _strengths(particles: Particles, live: Bool[Array, " particles"]) -> tuple[Array, Array, Array, Array]:
    """V / H^3 in units of a power of two; the largest in these units, that power, and which particles have any."""
    support, volume = jnp.where(live, particles.support, 1), jnp.where(live, particles.volume, 0)
    (long, long_exponent), (large, large_exponent) = mantissa_and_exponent(support), mantissa_and_exponent(volume)
    mantissa, exponent = large / (long * long * long), large_exponent - 3 * long_exponent
    counts = live & (large > 0)
    lowest = jnp.iinfo(jnp.int32).min
    unit = jnp.where(counts, exponent, lowest).max(initial=lowest // 2)
    strength = mantissa * power_of_two(exponent - unit, mantissa.dtype)
    return strength, lax.stop_gradient(strength.max(initial=0)), unit, counts


def weight_of(coverage: Any, particles: Particles, live: Bool[Array, " particles"]) -> Float[Array, ""]:
    r"""The sum of weights, as `scale` and `size` fold them, that is so much of $\sum V_j W_j$; never 0.

    Without live particles that have any volume, it is of no meaning.
    """
    kernel = kernels.by_name(particles.kernel)
    _, peak, unit, _ = _strengths(particles, live)
    lifted = jnp.asarray(coverage, peak.dtype) * 2.0 ** (kernel.degree * lift_of_sizes(kernel)) / kernel.norm
    bits = jnp.finfo(peak.dtype).maxexp - 2
    half = jnp.clip(-unit, -2 * bits, 2 * bits) // 2
    rest = jnp.clip(-unit, -2 * bits, 2 * bits) - half
    lifted = lifted / jnp.where(peak > 0, peak, 1) * power_of_two(half, peak.dtype)
    return jnp.maximum(lifted * power_of_two(rest, peak.dtype), jnp.finfo(peak.dtype).tiny)


@tree()
class Ordered(Columns):
    """Particles in rank order (class, then depth); those that no sample can meet come last.

    Ranks from `first_rank` up to `last_rank` can touch a sample of the slab; from `first_beside` up to `last_beside` any point
    between the samples before and after it, where samples of wider spacing lie. `index` is each one's place before.
    """

    first_rank: Int[Array, "classes slabs"]
    last_rank: Int[Array, "classes slabs"]
    first_beside: Int[Array, "classes slabs"]
    last_beside: Int[Array, "classes slabs"]
    index: Int[Array, " particles"]


def rank_particles(
    viewed: Viewed, camera: Camera, depths: Array, slab_samples: int, order: Int[Array, " particles"] | None = None
) -> Ordered:
    """Rank particles for the sample `depths` (ascending), in slabs of `slab_samples`; in the `order` of keys, where it is known.

    Windows are conservative: the depth key is monotone but for the rounding of a logarithm, which `KEY_MARGIN` covers.

    Differentiation:
        The columns x, y, z, scale, size and quantities have derivatives; all else is held fixed.
    """
    if order is None:  # by one packed 64-bit sort: twice as fast as a key-payload sort on a CPU
        with jax.enable_x64(True):
            packed = lax.sort((viewed.key.astype(jnp.uint64) << 32) | lax.iota(jnp.uint64, viewed.key.shape[0]))
            key, order = (packed >> 32).astype(jnp.uint32), packed.astype(jnp.uint32).astype(jnp.int32)
    else:
        key = viewed.key[order]
    columns = {field.name: getattr(viewed, field.name) for field in dataclasses.fields(Columns)}
    ranked = {name: column[order] for name, column in columns.items() if column is not None}
    begin, end = _windows(key, viewed.widest, camera, depths, slab_samples)
    windows = {"first_rank": begin[0], "last_rank": end[0], "first_beside": begin[1], "last_beside": end[1]}
    return Ordered(**ranked, **windows, index=order)


def _windows(
    key: Int[Array, " particles"], widest: Float[Array, " classes"], camera: Camera, depths: Array, slab_samples: int
) -> tuple[Int[Array, "2 classes slabs"], Int[Array, "2 classes slabs"]]:
    """First rank, and the one past the last, of each class and slab: at its samples, and beside them."""
    number, eps = depths.shape[0], jnp.finfo(widest.dtype).eps * ROUNDING
    slabs = math.ceil(number / slab_samples)
    first = jnp.arange(slabs, dtype=jnp.int32) * slab_samples
    last = jnp.minimum(first + slab_samples, number) - 1
    front = depths[jnp.stack([first, jnp.maximum(first - 1, 0)])][:, None]
    back = depths[jnp.stack([last, jnp.minimum(last + 1, number - 1)])][:, None]
    class_key = (jnp.arange(widest.shape[0], dtype=jnp.uint32) << DEPTH_BITS)[:, None]
    widest = widest[:, None] * (1 + eps)
    lowest, highest = depth_key(camera, front - widest), depth_key(camera, back + widest)
    lowest = class_key | jnp.where(lowest > KEY_MARGIN, lowest - KEY_MARGIN, 0)
    highest = class_key | jnp.minimum(highest + KEY_MARGIN, (1 << DEPTH_BITS) - 1)
    begin, end = jnp.searchsorted(key, jnp.stack([lowest, highest + 1])).astype(jnp.int32)  # past `highest`: at the next key
    return begin, end


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
