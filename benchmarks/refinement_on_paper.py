"""Refinement of an image that is known already: which rays would be cast, and how wrong the image would be, exactly.

No ray is cast: marking and the hierarchical estimator are those of `jaxsph.engine.screen`; its rival, the variance of corners,
is here. What they may see of the finest image is what has been asked for. The rules are those of Kratz et al. 2011, section 5,
and nothing else: every pixel counts, none is known to be empty, and no bundle is cast whole.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsph.engine.screen.canvas import (
    Canvas,
    Leaves,
    at_nodes,
    corners_of,
    halved,
    lattices,
    leaf_errors,
    leaves_of,
    num_leaves,
    over_pixels,
    places,
    wanted_by,
    worst,
)

COLORS = 3  # channels of u in the paper; estimators see transmittance too
SMOOTH = (
    0.5  # a leaf is smooth where its errors shrink faster than that when it is split; a quarter if it is twice differentiable
)
Image = Float[Array, "height width 6"]
Known = Bool[Array, "height width"]


class Stage(NamedTuple):
    """How good an image is: rays, relative error of colours; estimated and true error of colours and transmittance; the error of
    colours if smooth leaves were biquadratic, and if those were that gain by it."""

    rays: Array
    error: Array
    estimated: Array
    true: Array
    smoothed: Array
    best: Array


def relative(picture: Float[Array, "channels height width"], truth: Float[Array, "channels height width"]) -> Float[Array, ""]:
    """Relative L2 norm of the error, equation 11."""
    return jnp.sqrt(((picture - truth) ** 2).sum() / (truth**2).sum())


def canvas_of(value: Image, known: Known) -> Canvas:
    nothing = jnp.zeros(known.shape)
    return Canvas(value, known, nothing, known.sum(dtype=jnp.float32), nothing, nothing)


def open_leaves(canvas: Canvas, coarsest: int, estimator: str) -> tuple[list[Leaves], Float[Array, ""]]:
    """Leaves that have a pixel left, and the estimated error; what looks empty is left alone."""
    found, quality = leaves_of(canvas, sides(coarsest), jnp.float32(-1))
    found = [leaves._replace(hidden=jnp.zeros_like(leaves.hidden)) for leaves in found]
    if estimator == "hierarchical":
        return found, quality.l2
    *every, picture = lattices(canvas.light, canvas.known, 1, coarsest)
    norms = (jnp.where(leaves.split, varied(at, leaves.side), 0) for leaves, at in zip(found, every[1:], strict=True))
    found = [leaves._replace(norm=norm) for leaves, norm in zip(found, norms, strict=True)]
    return found, jnp.sqrt(sum((leaves.norm**2).sum() for leaves in found) / (picture**2).sum())


def varied(nodes: Float[Array, "channels rows columns"], side: int) -> Float[Array, "rows columns"]:
    """How much colours vary at the corners of each leaf (Levoy 1990, as in Kratz et al. 2011, section 7.3)."""
    return side * jnp.sqrt(jnp.stack(corners_of(nodes)).var(0).sum(0))


def sides(coarsest: int) -> tuple[int, ...]:
    return tuple(2**k for k in range(coarsest.bit_length() - 2, 0, -1))


@functools.partial(jax.jit, static_argnames=("coarsest", "estimator", "number", "quadratic"))
def refine(
    value: Image,
    known: Known,
    share: Float[Array, ""],
    *,
    coarsest: int,
    estimator: str,
    number: int | None,
    quadratic: bool = False,
) -> tuple[Known, Stage]:
    """How good an image is, and what is known after it: `number` leaves are split, or as few as hold a share of the error."""
    canvas = canvas_of(value, known)
    found = lattices(canvas.light, known, 1, coarsest)
    leaves, estimated = open_leaves(canvas, coarsest, estimator)
    truth, picture = canvas.light[:COLORS], found[-1][:COLORS]
    smoothed = best = jnp.float32(jnp.nan)
    if quadratic:
        by_regularity, by_truth = with_parabolas(canvas, found, leaves, coarsest)
        smoothed, best = relative(by_regularity[:COLORS], truth), relative(by_truth[:COLORS], truth)
    leaves = [some._replace(split=some.split & (some.norm > 0)) for some in leaves]
    marked = worst(leaves, number, share)
    error, true = relative(picture, truth), relative(found[-1], canvas.light)
    stage = Stage(known.sum(dtype=jnp.float32), error, estimated, true, smoothed, best)
    return known | wanted_by(marked, canvas, sides(coarsest)), stage


def with_parabolas(canvas: Canvas, found: list[Array], leaves: list[Leaves], coarsest: int) -> tuple[Array, Array]:
    """Biquadratic where four leaves have one parent, are not split, and are smooth; or where that is nearer to the truth."""
    by_regularity = by_truth = found[-1]
    previous = None
    for side, here, coarser, corners in zip(sides(coarsest), leaves, found[:-2], found[1:-1], strict=True):
        errors, _ = leaf_errors(coarser, corners, canvas.shape, side)
        together = _of_four(here.split.astype(errors.dtype)) == 4
        curved = _parabolas(corners, canvas.shape, side)
        if previous is not None:
            smooth = together & (jnp.sqrt(_of_four(errors**2)) < SMOOTH * previous)
            by_regularity = jnp.where(over_pixels(smooth, canvas.shape, 2 * side), curved, by_regularity)
        off, before = (_of_four_pixels(((image - canvas.light) ** 2).sum(0), 2 * side) for image in (curved, found[-1]))
        by_truth = jnp.where(over_pixels(together & (off < before), canvas.shape, 2 * side), curved, by_truth)
        previous = errors
    return by_regularity, by_truth


def _of_four(leaves: Float[Array, "rows columns"]) -> Float[Array, "rows columns"]:
    """Summed over the children of each leaf."""
    return leaves.reshape(leaves.shape[0] // 2, 2, leaves.shape[1] // 2, 2).sum((1, 3))


def _of_four_pixels(pixels: Float[Array, "height width"], side: int) -> Float[Array, "rows columns"]:
    """Summed over the pixels of each leaf; sizes must be multiples of its side."""
    rows, columns = (size // side for size in pixels.shape)
    return pixels.reshape(rows, side, columns, side).sum((1, 3))


def _parabolas(nodes: Array, shape: tuple[int, int], side: int) -> Float[Array, "channels height width"]:
    """Biquadratic through three by three nodes."""
    for axis, size in enumerate(shape, 1):
        at, pixel = places(size, side), np.arange(size)
        first = 2 * np.minimum(pixel // (2 * side), num_leaves(size, 2 * side) - 1)
        three = [first, first + 1, first + 2]
        where = [at[index] for index in three]
        total: Any = 0
        for k in range(3):
            i, j = (other for other in range(3) if other != k)
            weight = (pixel - where[i]) * (pixel - where[j]) / ((where[k] - where[i]) * (where[k] - where[j]))
            weight = weight.reshape([-1 if a == axis else 1 for a in range(3)]).astype(np.float32)
            total = total + weight * jnp.take(nodes, jnp.asarray(three[k]), axis)
        nodes = total
    return nodes


@functools.partial(jax.jit, static_argnames=("stride",))
def uniform(value: Image, *, stride: int) -> tuple[Array, Array]:
    """Rays of a plain grid, and the error of the image that is bilinear between them."""
    light = jnp.moveaxis(value[..., :COLORS], -1, 0)
    picture, shape = at_nodes(light, stride), (value.shape[0], value.shape[1])
    nodes = picture.shape[1] * picture.shape[2]
    while stride > 1:
        stride //= 2
        picture = halved(picture, shape, stride)
    return jnp.float32(nodes), relative(picture, light)


def first_known(size: int, stride: int) -> Known:
    """A coarse lattice."""
    at = places(size, stride)
    return jnp.zeros((size, size), bool).at[at[:, None], at[None]].set(True)


@functools.partial(jax.jit, static_argnames=("coarsest", "estimator"))
def errors_of_leaves(value: Image, known: Known, *, coarsest: int, estimator: str) -> list[tuple[Array, Array]]:
    """Estimated and true norm of each leaf that has a pixel left; 0 for both where there is none."""
    canvas = canvas_of(value, known)
    leaves, _ = open_leaves(canvas, coarsest, estimator)
    squares = ((lattices(canvas.light, known, 1, coarsest)[-1] - canvas.light) ** 2).sum(0)
    return [
        (here.norm, jnp.where(here.split, jnp.sqrt(_of_four_pixels(squares, side)), 0))
        for here, side in zip(leaves, sides(coarsest), strict=True)
    ]
