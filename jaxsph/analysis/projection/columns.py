r"""By which rule a particle's column is laid into pixels, and sums over blocks of particles that follow it.

Flow: projection.seen -> [columns] -> project; cotangents of sums -> [columns] -> those of particles.

A column along a ray is exact there, and says nothing of the rest of the pixel: a support smaller than a pixel is met by chance.
A mean over a pixel is found by what the size of the support allows. *Shares* are differences of corner integrals, which keep
mass however small a support is. Several rays are good to 3e-5 of the peak from 3 pixels a support on. Of large supports the ray
through the middle will do with the curvature there: $w^4 / 1920$ of fourth derivatives are left out, 3e-5 of the peak.
Supports of many pixels can be *nested*: drawn on a lattice with a ray for every 2, 4, 8, ... pixels, and interpolated by
cubics. Of $\rho$ spacings a support that is off by at most $K \rho^{-7/2}$ of the peak; K is found at some places, so this is an
estimate.
Columns that no depth cuts are read from a fit by the squared distance alone; only those that one cuts need their closed form.

Of a ray the sum is $\sum_j a_j F_j$, with F_j the integral of a kernel of unit integral along the ray between two depths, and a_j
what the particle holds. Shapes, once: (particles of a block, places down, places across, bundles).
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.engine.access.lists import BUNDLE
from jaxsph.engine.field.sums import known_at, pull_blocks
from jaxsph.model.camera.camera import Camera
from jaxsph.model.particles import kernels
from jaxsph.model.particles.columns import column_between, curvature, pixel_shares, side_shares, whole_column
from jaxsph.numerics.checks import as_usual
from jaxsph.numerics.compiled import apart_of, fusion_barrier, together_of
from jaxsph.numerics.transposed import tangent_of

PIXELS = ("mean", "ray")
SHARES, SMOOTH, WHOLE, CUT = "shares", "smooth", "whole", "cut"
PLANE = "plane"  # what kernels are there, instead of columns: a slice
SUBRAYS = 3  # of a pixel on each axis in means
SMALL, LARGE = 3.0, 16.0  # pixels that a support radius has less of for shares, and at least for smooth means
STENCIL = 4  # nodes that are interpolated between, on either axis
PLACE = 4  # columns of the table that say where a particle is; what it holds comes behind, of a plane the rests of x and y before
TWICE = "second derivatives of a projection are not implemented; take differences of `jax.grad`"
Windows = tuple[Int[Array, " pairs"], Int[Array, "chunks windows"], Int[Array, "chunks windows"]]


@dataclasses.dataclass(frozen=True)
class Rule:
    """How columns are found, static."""

    kind: str  # `SHARES`, `SMOOTH`, `WHOLE`, `CUT` or `PLANE`
    kernel: str  # name of the smoothing kernel
    perspective: bool  # whether rays spread with depth
    subrays: int = 1  # rays of a pixel on each axis
    stride: int = 1  # pixels from one ray to the next on each axis; of several, pixels between are interpolated

    @property
    def name(self) -> str:
        """By which plans know it."""
        return self.kind if self.stride == 1 else f"{self.kind}/{self.stride}"

    def seen_by(self, camera: Camera) -> Camera:
        """A camera whose pixels have the rays of a stride, with as many beyond the picture as are interpolated between."""
        if self.stride == 1:
            return camera
        width, height = (-(-size // self.stride) + STENCIL for size in (camera.width, camera.height))
        half = camera.half_height * (height * self.stride / camera.height)
        return dataclasses.replace(camera, width=width, height=height, half_height=half)

    def interpolated(self, image: Float[Array, "rows columns"], height: int, width: int) -> Float[Array, "height width"]:
        """Pixels from what such a camera sees, by cubics through the four nearest on either axis."""
        if self.stride == 1:
            return image[:, :width]
        down, across = (_cubics(size, self.stride) for size in (height, width))
        image = image[: down.shape[1], : across.shape[1]]
        rows, columns = (jnp.asarray(table, image.dtype) for table in (down, across.T))
        return jnp.linalg.multi_dot([rows, image, columns], precision="highest")

    @property
    def block(self) -> int:
        """Particles that are met at once: written out where a column takes a few operations."""
        return 16 if self.kind in (SMOOTH, WHOLE, PLANE) else 8

    block_back = 4

    def chunk(self, at_once: int) -> int:
        """Bundles that are summed together, where so many bundles of single samples fit."""
        return max(at_once // (8 * self.subrays**2), 1)

    @property
    def places(self) -> Float[np.ndarray, " places"]:
        """Where rays go through the pixels of a bundle, on either axis; of shares, where pixels end."""
        if self.kind == SHARES:
            return np.arange(BUNDLE + 1.0)
        return np.asarray((np.arange(BUNDLE)[:, None] + _nodes(self.subrays)[0]).ravel())

    @property
    def beside(self) -> float:
        """How far from the middle of its pixel a rule looks, in pixels on either axis."""
        return 0.5 if self.kind == SHARES else float(np.max(np.abs(_nodes(self.subrays)[0] - 0.5)))

    def pixels_of(self, sums: Float[Array, "down across bundles"]) -> Float[Array, "8 8 bundles"]:
        """Means over the rays of each pixel, by Gauss-Legendre quadrature on either axis."""
        if self.subrays == 1:
            return sums
        parts = sums.reshape(BUNDLE, self.subrays, BUNDLE, self.subrays, -1)
        return (parts * self._weights(sums.dtype)).sum((1, 3))

    def sums_of(self, pixels: Float[Array, "8 8 bundles"]) -> Float[Array, "down across bundles"]:
        """Cotangents of sums for those of their means."""
        if self.subrays == 1:
            return pixels
        places = len(self.places)
        return (pixels[:, None, :, None] * self._weights(pixels.dtype)).reshape(places, places, -1)

    def _weights(self, dtype: Any) -> Float[Array, "rays 1 rays 1"]:
        weights = _nodes(self.subrays)[1]
        return jnp.asarray((weights[:, None] * weights)[:, None, :, None], dtype)

    def rays(self, camera: Camera, column: Array, row: Array) -> tuple[Array, Array]:
        """Lateral coordinates of columns and rows; of a plane in pixels from the middle, as which they are exact."""
        if self.kind == PLANE:
            return column - camera.width / 2, camera.height / 2 - row
        return camera.column(column), camera.row(row)

    def prepare(
        self, rows: Float[Array, "particles bundles columns"], each: tuple[Array, Array], shared: Float[Array, "2"]
    ) -> tuple[Array, ...]:
        """What columns are found from, and amounts. Parallel rays have squared distances that add up.

        Args:
            rows: for rays x, y, z and reciprocal support; for shares ray coordinates of the centre, and the reciprocals of the
                support in them. Then amounts.
            each: ray coordinates of columns and of rows, or of the edges of pixels, (places, bundles).
            shared: near and far depth; a plane is at depth 0, of particles whose lengths are in pixels.
        """
        x, y, z, inverse, *amounts = (rows[:, None, None, :, k] for k in range(rows.shape[2]))
        u, v = each[0], each[1][:, None]
        if self.kind == SHARES:
            edges = ((u - x) * z)[:, 0], ((y - v) * inverse)[:, :, 0]
            return *(part for side in edges for part in side_shares(self.kernel, side)), *amounts
        if self.perspective:
            where = tuple(jnp.broadcast_to(side, (x.shape[0], *jnp.broadcast_shapes(side.shape, x.shape[1:]))) for side in (u, v))
            depths = () if self.kind == WHOLE else tuple(jnp.broadcast_to(end, x.shape) for end in shared)
            return x, y, z, inverse, *where, *depths, *amounts
        if self.kind == PLANE:
            right, up, *amounts = amounts
            squares = (((u - x) - right) * inverse) ** 2, (((v - y) - up) * inverse) ** 2
            return *squares, (z * inverse) ** 2, *(amount * inverse for amount in amounts)
        squares = ((u - x) * inverse) ** 2, ((v - y) * inverse) ** 2
        if self.kind == WHOLE:
            return *squares, *amounts
        if self.kind == CUT:
            return *squares, (shared[0] - z) * inverse, (shared[1] - z) * inverse, *amounts
        return *squares, ((u[1] - u[0]) * inverse / self.stride) ** 2 / 24, *amounts

    def sums(self, part: tuple[Array, ...]) -> list[Array]:
        """Over particles of a block, at the places of bundles: one or two; of rows of zeros nothing."""
        own = {SHARES: 4, WHOLE: 6 if self.perspective else 2, CUT: 8 if self.perspective else 4, SMOOTH: 3, PLANE: 3}[self.kind]
        place, amounts = part[:own], part[own:]
        particles = place[0].shape[0]
        if particles < self.block or self.kind == CUT or place[0].dtype != jnp.float32:
            columns = fusion_barrier(amounts[0][0, 0, 0, 0] >= 0, self._column, place)
            return [(amount * columns).sum(0) for amount in amounts]
        each = [self._column(tuple(value[k] for value in place)) for k in range(particles)]
        return [functools.reduce(jnp.add, [amount[k] * one for k, one in enumerate(each)]) for amount in amounts]

    def _column(self, place: Any) -> Array:
        """Of particles that hold 1."""
        if self.kind == SHARES:
            return pixel_shares(self.kernel, place[:2], place[2:])
        if not self.perspective:
            square, depths = place[1] + place[0], place[2:]
        else:
            x, y, z, inverse, u, v, *ends = place
            slant = 1 + u * u + v * v
            x, y = x - u * z, y - v * z  # from the depth of the centre on, as what is small is no difference of what is large
            further = (x * u + y * v) / slant
            square = ((u * further - x) * inverse) ** 2 + ((v * further - y) * inverse) ** 2 + (further * inverse) ** 2
            depths = tuple((end - (z + further)) * (jnp.sqrt(slant) * inverse) for end in ends)
        if self.kind == CUT:
            return column_between(self.kernel, square, *depths)
        if self.kind == PLANE:
            kernel = kernels.by_name(self.kernel)
            return kernel.norm * kernel.of_square(square + depths[0], jnp)
        column = whole_column(self.kernel, square)
        return column + depths[0] * curvature(self.kernel, square) if self.kind == SMOOTH else column


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def over_blocks(rule: Rule, given: tuple[Array, Any, Any], windows: Windows) -> list[Float[Array, "chunks ... windows"]]:
    """Sums over the particles of many windows, a block at a time.

    Windows come in chunks that are summed together, those of about as many particles, as a chunk takes as many turns as its
    longest window. They come last in all shapes, such that they are summed side by side: with 16 lanes that takes half of the
    time that rows of 8 pixels take.

    Args:
        rule: what a block adds, see `Rule.prepare` and `Rule.sums`.
        given: a table of particles, a pytree of what there is for each window, (chunks, ..., windows), and one of what all share.
        windows: `rank`, `begin` and `length`: particles `rank[begin : begin + length]` for each.

    Differentiation:
        By all that is `given`, in both modes. Which particles there are is held fixed.
    """
    return _sum(rule, given, windows)


@as_usual()
def _differentiate(rule: Rule, primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[list[Array], list[Array]]:
    """Sums and their tangents, which are a linear map of the tangents with a transpose of its own."""
    given, windows = primals
    result = over_blocks(rule, given, windows)
    ways = functools.partial(_sum, rule, windows=windows), functools.partial(_pull, rule, given, windows)
    return result, tangent_of(*ways, given, tangents[0], result, TWICE)


over_blocks.defjvp(_differentiate, symbolic_zeros=True)


def _sum(rule: Rule, given: tuple[Array, Any, Any], windows: Windows) -> list[Array]:
    (table, of_each, shared), (rank, *places) = given, windows
    table = jnp.pad(table, ((0, 1), (0, 0)))

    def one(chunk: tuple[Array, Array, Any]) -> list[Array]:
        begin, length, each = chunk

        def fetch(nth: Array) -> Array:
            return known_at(table, _particles(table, rank, begin, length, nth, rule.block))

        @functools.partial(jax.jit, inline=True)  # so that it is traced once
        def found(nth: Array) -> list[Array]:
            rows = fusion_barrier(nth >= 0, fetch, nth)
            return rule.sums(fusion_barrier(nth >= 0, rule.prepare, rows, each, shared))

        zero = [jnp.zeros(shape.shape, shape.dtype) for shape in found.eval_shape(jnp.int32(0))]
        if len(zero) == 1:
            total = lax.fori_loop(0, _turns(length, rule.block), lambda nth, total: [total[0] + found(nth)[0]], zero)
            return [rule.pixels_of(total[0])]

        def add(nth: Array, total: Any) -> Any:
            return jax.tree.map(jnp.add, total, together_of(*found(nth)))

        total = lax.fori_loop(0, _turns(length, rule.block), add, together_of(*zero))
        return [rule.pixels_of(one) for one in apart_of(total)]

    return lax.map(one, (*places, of_each))


def _pull(rule: Rule, given: tuple[Array, Any, Any], windows: Windows, cotangents: list[Array]) -> tuple[Array, Any, Any]:
    """Cotangents of what is given, for those of the sums: all blocks are met again."""
    (table, of_each, shared), (rank, *places) = given, windows
    table = jnp.pad(table, ((0, 1), (0, 0)))

    def one(carry: tuple[Array, Any], chunk: tuple[Array, Array, Any, list[Array]]) -> tuple[tuple[Array, Any], Any]:
        begin, length, each, of_sums = chunk

        def fetch(nth: Array) -> tuple[Array, Array, None]:
            particle = _particles(table, rank, begin, length, nth, rule.block_back)
            return particle, known_at(table, particle), None

        def sums(rows: Array, inputs: tuple[Any, Any], _: None) -> list[Array]:
            return rule.sums(rule.prepare(rows, *inputs))

        turns = 0, _turns(length, rule.block_back)
        of_sums = [rule.sums_of(one) for one in of_sums]
        total, (found, more) = pull_blocks(sums, fetch, turns, carry[0], (each, shared), of_sums)
        return (total, jax.tree.map(jnp.add, carry[1], more)), found

    start = jax.tree.map(jnp.zeros_like, (table, shared))
    (total, of_shared), found = lax.scan(one, start, (*places, of_each, cotangents))
    return total[:-1], found, of_shared


def _turns(length: Int[Array, " windows"], block: int) -> Int[Array, ""]:
    """Blocks of the longest window."""
    return (length.max() + block - 1) // block


def _particles(table: Array, rank: Array, begin: Array, length: Array, nth: Array, block: int) -> Array:
    """The nth block of all windows, (particles, windows); past their ends the last of the table, which holds nothing."""
    index = nth * block + jnp.arange(block, dtype=jnp.int32)[:, None]
    inside = index < length
    return jnp.where(inside, known_at(rank, jnp.where(inside, begin + index, 0)), table.shape[0] - 1)


def rules_of(kernel: str, perspective: bool, pixel: str, levels: int = 0) -> tuple[Rule, ...]:
    """Those that particles may follow, with values of rays or means over pixels; and of so many lattices."""
    of = functools.partial(Rule, kernel=kernel, perspective=perspective)
    if pixel == PLANE:
        return (of(PLANE),)
    nested = tuple(of(WHOLE if pixel == "ray" else SMOOTH, stride=2**level) for level in range(1, levels + 1))
    if pixel == "ray":
        return of(WHOLE), of(CUT), *nested
    smooth = () if perspective else (of(SMOOTH),)
    return of(SHARES), *smooth, of(WHOLE, subrays=SUBRAYS), of(CUT, subrays=SUBRAYS), *nested


@functools.cache
def nesting(kernel: str) -> float:
    """K, see above, of the kernel called so: as its entry says, else as large as it is found to be."""
    return kernels.by_name(kernel).nested or nesting_found(kernel)


def nesting_found(kernel: str) -> float:
    """K in the middle of cells whose row goes through the centre of a support, where errors are largest."""
    spacings = np.geomspace(4, 48, 25)[:, None]
    place = np.arange(-12, 204) / 4  # nodes at all quarters of a spacing
    middle, near, far = (whole_column(kernel, (place**2 + row**2) / spacings**2, np) for row in (0, 0.5, 1.5))
    nodes = (9 * near - far) / 8
    between = (9 * (nodes[:, 4:-8] + nodes[:, 8:-4]) - (nodes[:, :-12] + nodes[:, 12:])) / 16
    off = np.abs(middle[:, 6:-6] - between) / whole_column(kernel, np.float64(0), np)
    return float((off * spacings**3.5).max())


def _cubics(size: int, stride: int) -> Float[np.ndarray, "pixels nodes"]:
    """What each node counts in each pixel, see `Rule.seen_by`."""
    number = -(-size // stride) + STENCIL
    place = (np.arange(size) + 0.5 + (number * stride - size) / 2) / stride - 0.5
    first = np.floor(place).astype(int) - 1
    t, weights = place - first - 1, np.zeros((size, number))
    shares = -t * (t - 1) * (t - 2) / 6, (t + 1) * (t - 1) * (t - 2) / 2, -(t + 1) * t * (t - 2) / 2, (t + 1) * t * (t - 1) / 6
    for k, share in enumerate(shares):
        weights[np.arange(size), first + k] = share
    return weights


def _nodes(subrays: int) -> tuple[Any, Any]:
    """Where rays go through a pixel on one axis, in [0, 1], and the shares of it that they stand for."""
    nodes, weights = np.polynomial.legendre.leggauss(subrays)
    return (nodes + 1) / 2, weights / 2
