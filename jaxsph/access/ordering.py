r"""Rank particles by support class and depth, so that a slab of samples meets a *window* of ranks.

Flow: particles -> [ordering] -> lists -> cells -> cast -> image.

Particles of similar support form a class (a factor of two wide); within a class they are ranked by depth. A particle of class
c can touch a sample at depth s only if $|z - s| < H_c$, the largest support of the class, so the particles that can touch a
slab of samples are at most one contiguous window of ranks a class. With supports spread over 20 000 : 1 a window of all
particles together would hold nearly everything; a window a class is never more than about twice too deep.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.access.resolution import LIFT, unresolved, weakest
from jaxsph.model import kernels
from jaxsph.model.camera import Camera
from jaxsph.model.particles import Particles
from jaxsph.numerics import exponents, faults
from jaxsph.numerics.staging import computed_once

DEPTH_BITS = 24  # resolution of the depth key; with 8 bits of class and 32 of index it fills one 64-bit word
DEAD_CLASS = 255
KEY_MARGIN = 8  # keys that a window is wider on either side: a key is at most an ulp of its depth, a logarithm errs by a few
ROUNDING = 16  # half-ulps that a view coordinate or a ray coordinate may be off, with a wide margin


@dataclasses.dataclass(frozen=True)
class Ordered:
    """Particles in view space, in rank order (class, then depth); those that no sample can meet come last and are not `live`.

    `reach` is the support widened by the rounding of coordinates: what lies outside it has weight zero in floating point.
    The particle's strength m = V / H^3, of which the largest is 2^LIFT, is folded into its lengths: `size = m^(1/n)` and
    `scale = size / H`, with n the degree of its kernel.

    Ranks from `first_rank` up to `last_rank` can touch a sample of the slab; from `first_beside` up to `last_beside` any point
    between the samples before and after it, where samples of wider spacing lie.
    """

    x: Float[Array, " particles"]
    y: Float[Array, " particles"]
    z: Float[Array, " particles"]
    reach: Float[Array, " particles"]
    scale: Float[Array, " particles"]
    size: Float[Array, " particles"]
    quantity: Float[Array, " particles"]
    live: Bool[Array, " particles"]
    first_rank: Int[Array, "classes slabs"]
    last_rank: Int[Array, "classes slabs"]
    first_beside: Int[Array, "classes slabs"]
    last_beside: Int[Array, "classes slabs"]
    faults: Int[Array, ""]


def order_particles(
    particles: Particles, camera: Camera, depths: Float[Array, " samples"], slab_samples: int, num_classes: int
) -> Ordered:
    """Rank `particles` for the sample `depths` (ascending), in slabs of `slab_samples`.

    Windows are conservative: the depth key is monotone but for the rounding of a logarithm, which `KEY_MARGIN` covers.

    Differentiation:
        The columns x, y, z, scale, size and quantity have derivatives; ranks, windows, `reach` and `live` are held fixed.
    """
    look = functools.partial(_view, num_classes=num_classes)
    columns, key, widest, bad = computed_once(camera.near < camera.far, look, particles, camera, depths)
    key, order = _sort_by(key)
    eps = jnp.finfo(widest.dtype).eps * ROUNDING

    slabs = math.ceil(depths.shape[0] / slab_samples)
    first = jnp.arange(slabs, dtype=jnp.int32) * slab_samples
    last = jnp.minimum(first + slab_samples, depths.shape[0]) - 1
    class_key = (jnp.arange(num_classes, dtype=jnp.uint32) << DEPTH_BITS)[:, None]
    widest = widest[:, None]

    def ranks(front: Array, back: Array) -> tuple[Array, Array]:
        lowest = _depth_key(camera, front[None] - widest * (1 + eps))
        highest = _depth_key(camera, back[None] + widest * (1 + eps))
        lowest = class_key | jnp.where(lowest > KEY_MARGIN, lowest - KEY_MARGIN, 0)
        highest = class_key | jnp.minimum(highest + KEY_MARGIN, (1 << DEPTH_BITS) - 1)
        begin, end = (jnp.searchsorted(key, wanted, side=side) for wanted, side in ((lowest, "left"), (highest, "right")))
        return begin.astype(jnp.int32), end.astype(jnp.int32)

    at_slab = ranks(depths[first], depths[last])
    beside = ranks(depths[jnp.maximum(first - 1, 0)], depths[jnp.minimum(last + 1, depths.shape[0] - 1)])
    ranked = {name: column[order] for name, column in columns.items()}
    return Ordered(
        **ranked, first_rank=at_slab[0], last_rank=at_slab[1], first_beside=beside[0], last_beside=beside[1], faults=bad
    )


def _view(
    particles: Particles, camera: Camera, depths: Float[Array, " samples"], num_classes: int
) -> tuple[dict[str, Array], Array, Array, Array]:
    """Columns of `Ordered` in the order of `particles`, sort keys, the largest reach of each class, and a fault word."""
    offset = camera.offset(particles.position, particles.position_rest)
    view = camera.rotate(offset)
    x, y, z = view[:, 0], view[:, 1], view[:, 2]
    finite = jnp.isfinite(view).all(1) & jnp.isfinite(particles.quantity)
    usable = finite & (particles.support > 0) & jnp.isfinite(particles.support)
    usable &= (particles.volume >= 0) & jnp.isfinite(particles.volume)
    eps = jnp.finfo(view.dtype).eps * ROUNDING
    distance = jnp.abs(offset).max(1)
    reach = lax.stop_gradient(particles.support * (1 + eps) + eps * distance)
    live = particles.valid & usable & (z + reach >= depths[0]) & (z - reach <= depths[-1])

    largest = jnp.where(live, reach, 0).max(initial=0)
    octave = jnp.floor(jnp.log2(jnp.where(live & (largest > 0), largest / reach, 1)))
    octave = jnp.where(live, jnp.clip(octave, 0, num_classes - 1), DEAD_CLASS).astype(jnp.uint32)
    widest = [jnp.where(live & (octave == k), reach, 0).max(initial=0) for k in range(num_classes)]

    scale, size, vanishes = _folded(particles, live)
    columns = {"x": x, "y": y, "z": z, "scale": scale, "size": size, "quantity": particles.quantity}
    columns = {name: jnp.where(live, column, 0) for name, column in columns.items()}
    bad = faults.raised(faults.BAD_PARTICLES, (particles.valid & ~usable).any())
    blurred = unresolved(view, distance, particles.support, camera, depths)
    bad |= faults.raised(faults.UNRESOLVED, (live & blurred).any()) | faults.raised(faults.WEAK_PARTICLES, vanishes.any())
    return {**columns, "reach": reach, "live": live}, (octave << DEPTH_BITS) | _depth_key(camera, z), jnp.stack(widest), bad


def _depth_key(camera: Camera, z: Float[Array, "..."]) -> Int[Array, "..."]:
    """Depth as an integer of `DEPTH_BITS` bits, uniform in sample space, clamped at near and far."""
    z = jnp.clip(z, camera.near, camera.far)
    if camera.is_perspective:
        part = jnp.log(z / camera.near) / jnp.log(camera.far / camera.near)
    else:
        part = (z - camera.near) / (camera.far - camera.near)
    part = jnp.clip(part.astype(jnp.float32), 0, 1)
    return jnp.minimum(part * (1 << DEPTH_BITS), (1 << DEPTH_BITS) - 1).astype(jnp.uint32)


def _sort_by(key: Int[Array, " particles"]) -> tuple[Array, Array]:
    """Sorted keys and the permutation, by one packed 64-bit sort: twice as fast as a key-payload sort on a CPU."""
    with jax.enable_x64(True):
        packed = (key.astype(jnp.uint64) << 32) | lax.iota(jnp.uint64, key.shape[0])
        packed = lax.sort(packed)
        return (packed >> 32).astype(jnp.uint32), packed.astype(jnp.uint32).astype(jnp.int32)


def _folded(particles: Particles, live: Bool[Array, " particles"]) -> tuple[Array, Array, Array]:
    """`scale` and `size` of every particle, and which are so weak that they would vanish.

    CSPH only knows ratios of strengths. They are taken by mantissa and exponent, as H^3 soon leaves the range of float32. What
    all of them are divided by changes nothing, and carries no gradient; nor does a strength of 0.
    """
    support, volume = jnp.where(live, particles.support, 1), jnp.where(live, particles.volume, 0)
    (long, long_exponent), (large, large_exponent) = exponents.split(support), exponents.split(volume)
    mantissa, exponent = large / (long * long * long), large_exponent - 3 * long_exponent
    counts = live & (large > 0)
    exponent -= jnp.where(counts, exponent, jnp.iinfo(jnp.int32).min).max(initial=jnp.iinfo(jnp.int32).min // 2)
    strength = mantissa * exponents.power_of_two(exponent, mantissa.dtype)
    peak = lax.stop_gradient(strength.max(initial=0))
    strength = strength / jnp.where(peak > 0, peak, 1)
    kernel = kernels.by_name(particles.kernel)
    lift = 2.0 ** (LIFT // kernel.degree)
    size = jnp.where(strength > 0, lift * jnp.where(strength > 0, strength, 1) ** (1 / kernel.degree), 0)
    weak = (counts & (strength < weakest(kernel.degree, strength.dtype))) | (live & exponents.is_subnormal(volume))
    return size / support, size, weak


jax.tree_util.register_dataclass(
    Ordered,
    data_fields=[field.name for field in dataclasses.fields(Ordered)],
    meta_fields=[],
)
