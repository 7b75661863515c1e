r"""Which slabs are covered: wherever in them a ray's sample lies, some particle's support holds it.

Flow: grid -> [coverage] -> slabs -> schedule.

Space is cut into voxels, and a particle covers those around the corner nearest to it that lie wholly in its support. Count
along each axis how many layers a voxel is beyond the eight at the corner. `COARSE` voxels are covered up to (1, 0, 0) in any
order, which makes 32 of them; `FINE` ones up to (2, 1, 1) and (3, 0, 0), which makes 184.

**Theorem.** What lies in a covered voxel lies in the support of a particle, as weights are computed. *Argument.* Let the edge
of a voxel be a. The particle is within a/2 of its corner along each axis, so nothing in layer l is farther from it than (l +
3/2) a along that axis: in all at most $a \sqrt{(5/2)^2 + 2 (3/2)^2} = 3.279 a$ of coarse voxels; of fine ones at most $a
\sqrt{(7/2)^2 + 2 (5/2)^2} = a \sqrt{(9/2)^2 + 2 (3/2)^2} = 4.975 a$. Places in voxels are less than `MOST_VOXELS` along each
axis, and an eps of themselves off, of the particle and of what is asked for: in all less than 0.008 in float32, which adds at
most 1.75 times that. Inner radii (`bounds.spheres`) are 3.3 a and 5 a at least. $\square$

So a slab is covered if all voxels that its box meets are. Boxes are made of the very numbers that the cast multiplies, and
rounding is monotone. Particles of very different radii have voxels of their own, octave by octave.

A voxel is a bit. Those along x make words, which lie in one row, by y and then by z, with a margin: so any shift is a slice,
and what is marked at each corner becomes what particles cover by a few shifts of all voxels at once. In the same way it becomes
known of which blocks all voxels are covered (`_blocks`), of which a slab needs only some.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.control.bounds import Spheres
from jaxsph.model.camera.camera import Camera
from jaxsph.numerics.compiled import extent, fusion_barrier

FINE, COARSE = (5.0, 3), (3.3, 1)  # edges of a voxel that an inner radius is at least; layers beyond the eight at a corner
MARGIN = 6  # voxels on either side of all corners, that none covers
MOST_VOXELS = 1 << 15  # along an axis
BITS = 32  # of a word
MOST_FINE = 1 << 24  # voxels: their words stay in the second-level cache or near
# Voxels that there is room for, a particle: a cube full of supports of 60 neighbours takes nine, and three.
OF_PARTICLE = {FINE: 128, COARSE: 48}
MOST = 1 << 30  # voxels that there is room for at most: their numbers are 32-bit integers
FEWEST = 1 << 18  # voxels that there is room for at least
OCTAVES = 6  # of radii, from the largest down; smaller particles cover nothing
WORDS_AT_ONCE = 1 << 13
SEGMENT = 1 << 22  # voxels that are marked together: their bytes stay in the second-level cache or near
PARTICLES = 1 << 12  # that are marked together
LARGEST = 16  # side of a block
AT_ONCE = 1 << 10  # slabs
Axes = Sequence[Array]  # along x, y and z
Row = UInt[Array, " words"]
Box = Sequence[tuple[Float[Array, " boxes"], Float[Array, " boxes"]]]


class Voxels(NamedTuple):
    """Blocks of voxels that are covered.

    Attributes:
        covered: whether all voxels of the block that begins at each are covered.
        low: coordinates at which the first voxel begins.
        rate: voxels a unit of length.
        number: of voxels along each axis; along x a multiple of `BITS`.
        size: of blocks along each axis, in voxels.
    """

    covered: Row
    low: Axes
    rate: Array
    number: Axes
    size: Axes


def covered_slabs(
    grid: Grid, ball: Spheres, camera: Camera, items: Int[Array, " items"], number: Int[Array, ""], slab_samples: int
) -> Bool[Array, "slabs bundles"]:
    """Which slabs of a band are covered.

    Args:
        ball: of all particles.
        items: of the slabs that are asked about, the first `number` of these: `slab * bundles + bundle`.
    """
    slabs, bundles = grid.windows.count.shape
    chunk = min(AT_ONCE, -(-slabs * bundles // 16) * 16)
    items, turns = jnp.pad(items, (0, chunk), constant_values=slabs * bundles), (number + chunk - 1) // chunk
    box_of = _boxes(grid, camera, slab_samples)

    def boxes(nth: Array) -> tuple[Array, Box]:
        at = lax.dynamic_slice(items, (nth * chunk,), (chunk,))
        return at, box_of(jnp.minimum(at, slabs * bundles - 1))

    live = grid.ordered.live
    radius, places = jnp.where(live & (ball.inner < jnp.inf), 1 / ball.inner, 0), (ball.x, ball.y, ball.z)
    least, largest = extent(radius, radius > 0)
    of_fine, of_coarse = (OF_PARTICLE[kind] * radius.shape[0] for kind in (FINE, COARSE))
    words = min(-(-max(FEWEST, min(of_fine, MOST_FINE), of_coarse) // SEGMENT) * SEGMENT, MOST) // BITS
    usual = [(high - low).mean() for low, high in fusion_barrier(number >= 0, boxes, turns // 2)[1]]

    def of_octave(octave: Array, found: Array) -> Array:
        smallest = jnp.maximum(largest * jnp.exp2(-1.0 - octave), least)
        counts = radius >= smallest
        low, high = zip(*(extent(place, counts) for place in places), strict=True)

        def sizes(edges: Any) -> tuple[list[Array], Array]:
            """Voxels along each axis, and how many are read: slices reach ahead of the last, and must not reach the end."""
            along = [jnp.ceil((last - first) / smallest * edges + 2 * MARGIN) for first, last in zip(low, high, strict=True)]
            along[0] = BITS * jnp.ceil(along[0] / BITS)
            return along, along[0] * along[1] * (along[2] + MARGIN + LARGEST) + BITS * WORDS_AT_ONCE

        fine = sizes(FINE[0])[1] <= min(MOST_FINE, words * BITS)
        edges = jnp.where(fine, FINE[0], COARSE[0]).astype(smallest.dtype)
        (along, total), rate = sizes(edges), edges / smallest
        fits = (total <= words * BITS) & (functools.reduce(jnp.maximum, along) < MOST_VOXELS)

        def look() -> Array:
            voxels = covered_voxels(places, counts, low, rate, tuple(one.astype(jnp.int32) for one in along), fine, words)
            voxels = _blocks(voxels, [jnp.clip(one * rate + 1, 1, LARGEST).astype(jnp.int32) for one in usual])

            def ask(nth: Array, found: Array) -> Array:
                at, box = boxes(nth)
                return found.at[at].max(fusion_barrier(nth >= 0, covers, voxels, box))

            return lax.fori_loop(0, turns, ask, found)

        return lax.cond(fits, look, lambda: found)

    octaves = jnp.where(largest > 0, jnp.floor(jnp.log2(largest / least)) + 1, 0)
    nothing = jnp.zeros(slabs * bundles + 1, bool)
    found = lax.fori_loop(0, jnp.minimum(octaves, OCTAVES).astype(jnp.int32), of_octave, nothing)
    return found[:-1].reshape(slabs, bundles)


def _boxes(grid: Grid, camera: Camera, slab_samples: int) -> Callable[[Int[Array, " some"]], Box]:
    """The boxes of slabs, by `slab * bundles + bundle`: least and greatest x, y and z of any sample in them."""
    slabs, bundles = grid.windows.count.shape
    borders = grid.borders(slabs * slab_samples)[::slab_samples]
    sides = [(rays.min(0), rays.max(0)) for rays in grid.rays(camera, jnp.arange(bundles, dtype=jnp.int32))]

    def boxes(place: Int[Array, " some"]) -> Box:
        depths = borders[place // bundles], borders[place // bundles + 1]
        scales, found = depths if camera.is_perspective else (jnp.ones_like(depths[0]),), []
        for side in sides:
            low, high = (end[place % bundles] for end in side)
            lows, highs = ([end * one for one in scales] for end in (low, high))
            found.append((functools.reduce(jnp.minimum, lows), functools.reduce(jnp.maximum, highs)))
        return [*found, depths]

    return boxes


def covered_voxels(
    places: Axes, counts: Bool[Array, " particles"], low: Axes, rate: Array, number: Axes, fine: Bool[Array, ""], words: int
) -> Voxels:
    """The voxels that particles cover, of those that count: each a block of its own.

    Args:
        low: the least coordinates of those that count.
        number: voxels along each axis, with a margin on both sides.
        fine: whether voxels are `FINE` or `COARSE`.
        words: that there is room for.
    """
    low = tuple(first - MARGIN / rate for first in low)
    corner, stride, reach = jnp.zeros(counts.shape, jnp.int32), jnp.int32(1), jnp.where(fine, FINE[1], COARSE[1])
    for place, first, along in zip(places, low, number, strict=True):
        corner += (jnp.round((place - first) * rate).astype(jnp.int32) + reach) * stride
        stride = stride * along
    row, plane = _strides(number)
    used, axes = number[2] * plane, np.eye(3, dtype=int)

    def merged(of: Row, steps: list[tuple[int, ...]]) -> Row:
        return _combined(jnp.bitwise_or, of, [(int(x), int(y) * row + int(z) * plane) for x, y, z in steps], used)

    def beside(middle: int, step: int) -> list[tuple[int, ...]]:
        return [tuple(middle + side * step * axis) for axis in axes for side in (-1, 1)]

    # each pass looks ahead along all axes: what is marked has been put as many voxels ahead as the last of them reaches back
    eight = merged(_marked(jnp.where(counts, corner, words * BITS), stride, words), [*np.ndindex(2, 2, 2)])

    def finely() -> Row:
        cubes = merged(merged(eight, [*np.ndindex(3, 1, 1)]), [*np.ndindex(1, 3, 3)])
        return jnp.bitwise_or(merged(cubes, [(2, 2, 2), *beside(2, 1)]), merged(eight, beside(3, 3)))

    covered = lax.cond(fine, finely, lambda: merged(eight, [(1, 1, 1), *beside(1, 1)]))
    return Voxels(covered, low, rate, number, (jnp.int32(1),) * 3)


def _strides(number: Axes) -> tuple[Array, Array]:
    """Words to the next row of voxels, and to the next plane."""
    return number[0] // BITS, number[0] // BITS * number[1]


def _marked(at: Int[Array, " particles"], used: Array, words: int) -> Row:
    """Words with the bits at these numbers, of the `used` ones; a number past the last is none.

    By bytes, of a segment at a time: particles come in order of depth, and so most that are marked together are near each
    other.
    """
    chunk = min(PARTICLES, at.shape[0])
    at = jnp.pad(at, (0, -at.shape[0] % chunk), constant_values=words * BITS)
    chunks = at.reshape(-1, chunk)
    first, last = chunks.min(1), jnp.where(chunks < words * BITS, chunks, -1).max(1)

    def of_segment(nth: Array, found: Row) -> Row:
        begin = nth * SEGMENT
        here = (last >= begin) & (first < begin + SEGMENT)
        until = first.shape[0] - jnp.argmax(here[::-1])

        def mark(turn: Array, found: Array) -> Array:
            inside = lax.dynamic_slice(at, (turn * chunk,), (chunk,)) - begin
            inside = jnp.where((inside >= 0) & (inside < SEGMENT), inside, SEGMENT)
            return found.at[inside].set(1, mode="promise_in_bounds")

        marks = lax.fori_loop(jnp.argmax(here), jnp.where(here.any(), until, 0), mark, jnp.zeros(SEGMENT + 1, jnp.uint8))[:-1]
        # four bytes of 0 or 1 become four bits: their first bits, and no others, are put together at the upper end
        fours = (
            lax.bitcast_convert_type(marks.reshape(-1, 4), jnp.uint32) * jnp.uint32(1 << 28 | 1 << 21 | 1 << 14 | 1 << 7) >> 28
        )
        bits = functools.reduce(jnp.bitwise_or, (fours[k::8] << 4 * k for k in range(8)))
        return lax.dynamic_update_slice(found, bits, (begin // BITS,))

    return lax.fori_loop(0, (used + SEGMENT - 1) // SEGMENT, of_segment, jnp.zeros(words + 1, jnp.uint32))


def _combined(combine: Callable[..., Array], row: Row, steps: Sequence[tuple[Any, Any]], used: Array) -> Row:
    """At each of the `used` voxels what lies so many bits and words further along, combined.

    Words are replaced where they lie, as nothing that comes later looks back.
    """
    chunk = min(WORDS_AT_ONCE, row.shape[0] - 1)

    def some(nth: Array, row: Array) -> Array:
        def ahead(bits: Any, words: Any) -> Array:
            here = lax.dynamic_slice(row, (nth * chunk + words,), (chunk,))
            if isinstance(bits, int) and not bits:
                return here
            after = lax.dynamic_slice(row, (nth * chunk + words + 1,), (chunk,))
            bits = jnp.asarray(bits, jnp.uint32)
            return here >> bits | after << BITS - bits

        found = fusion_barrier(nth >= 0, lambda: functools.reduce(combine, [ahead(*step) for step in steps]))
        return lax.dynamic_update_slice(row, found, (nth * chunk,))

    return lax.fori_loop(0, (used + chunk - 1) // chunk, some, row)


def _blocks(voxels: Voxels, wanted: list[Array]) -> Voxels:
    """Blocks whose sides are the largest powers of two that are at most as long as wanted, which is at most `LARGEST`."""
    row, plane = _strides(voxels.number)
    covered, sizes, used = voxels.covered, [], voxels.number[2] * plane
    for axis, (most, along) in enumerate(zip(wanted, voxels.number, strict=True)):
        doublings = 31 - lax.clz(jnp.clip(most, 1, along // 2))

        def double(nth: Array, covered: Array, axis: int = axis) -> Array:
            step = 1 << nth
            return _combined(
                jnp.bitwise_and, covered, [(0, 0), (step, 0) if axis == 0 else (0, step * (row, plane)[axis - 1])], used
            )

        covered = lax.fori_loop(0, doublings, double, covered)
        sizes.append(1 << doublings)
    return voxels._replace(covered=covered, size=tuple(sizes))


def covers(voxels: Voxels, box: Box) -> Bool[Array, " boxes"]:
    """Whether all voxels that boxes meet are covered."""
    inside, first, last = jnp.ones(box[0][0].shape, bool), [], []
    for (low, high), start, number in zip(box, voxels.low, voxels.number, strict=True):
        ends = [jnp.clip(jnp.floor((end - start) * voxels.rate), -1, number).astype(jnp.int32) for end in (low, high)]
        inside &= (ends[0] >= 0) & (ends[1] < number)
        first.append(jnp.clip(ends[0], 0, number - 1))
        last.append(jnp.clip(ends[1], 0, number - 1))
    turns = [((high - low) // size).max() + 1 for low, high, size in zip(first, last, voxels.size, strict=True)]
    row, plane = _strides(voxels.number)

    def place(axis: int, nth: Array) -> Array:
        size = voxels.size[axis]
        return jnp.maximum(jnp.minimum(first[axis] + nth * size, last[axis] + 1 - size), first[axis])

    def along_z(nth: Array, found: Array) -> Array:
        of_plane = place(2, nth) * plane

        def along_y(nth: Array, found: Array) -> Array:
            of_row = of_plane + place(1, nth) * row

            def along_x(nth: Array, found: Array) -> Array:
                x = place(0, nth)
                word = voxels.covered.at[of_row + (x >> 5)].get(mode="promise_in_bounds")
                return found & (word >> (x & 31).astype(jnp.uint32) & 1 > 0)

            return lax.fori_loop(0, turns[0], along_x, found)

        return lax.fori_loop(0, turns[1], along_y, found)

    return lax.fori_loop(0, turns[2], along_z, inside)
