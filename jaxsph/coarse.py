r"""One point for many that are seen as one: the outlook of Kaehler, Abel & Hege 2007, section 5.

Flow: points or particles, camera -> octree_cut -> [coarse] -> scene.

Of a node of the octree one point stays, at the centroid. Weights are extinction times the cube of the radius, which is the
integral of extinction over space but for a factor of the profile; their sum is kept, and colour is their mean. The radius keeps
the mean of the squared distance from the centroid, the profile's own included. So blurred images of the thickness of a node and
of its coarse point differ in second order of the node's size by that of the blur, and only as far as the node is not alike in
all directions.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxsph.access.octree_cut import Cut, octree_cut
from jaxsph.model.camera import Camera
from jaxsph.model.particles import Particles, capacity_class
from jaxsph.model.points import Points
from jaxsph.model.profiles import Ball, Profile
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics.checks import is_traced
from jaxsph.plan import Plan
from jaxsph.render import render

ROUNDINGS = 16  # of a coordinate or a sum, in eps
WIDER = 2.0**0.5  # of a ball, than what each of its chords must be as long as the diameter of
Part = TypeVar("Part", Points, Particles)


class Coarsened(NamedTuple):
    """Points or particles, of which some stand for many.

    Attributes:
        part: in as many entries as before, the rest not valid; in fewer if that was known outside of `jit`.
        merged: which of them stand for several.
        balls: for `coarse_bound`, what those that were merged can be seen in; of points alone.
    """

    part: Any
    merged: Bool[Array, " entries"]
    balls: Points | None


def coarsened(part: Part, camera: Camera, pixels: Any = 1.0) -> Coarsened:
    """Merge what is seen as one: nodes of an octree that are no larger than some pixels, between near and far.

    What is in no such node is as it was, bit for bit. **Points** keep the integral of extinction over space: where a node is
    thin and smaller than a pixel, an image that is averaged over pixels is hardly changed, while one with a ray a pixel, which
    meets small points or misses them, is less noisy. `coarse_bound` bounds the change of any pixel. **Particles** keep volume,
    and quantity weighed by volume, in a support that covers all of the node: the field is normalised, so that its border can
    move outwards by less than twice `pixels`, and quantities within a node are averaged. Sparse particles of supports
    below a pixel look fuller then (`docs/accuracy_and_limits.md`). That is an estimate; nothing bounds it.

    Args:
        part: `Points` with a radial profile, or `Particles`.
        camera: where from; coarse points are for it, and for what is at least as far away in as large pixels.
        pixels: > 0: largest width, height and depth of what is merged, in pixels at its nearest depth.

    Differentiation:
        None: what is returned is held fixed.

    Raises:
        ValueError: a profile that is a function of the offset, other parts, `pixels` not > 0.
    """
    if not isinstance(part, Points | Particles):
        raise ValueError(f"`part` must be `jaxsph.Points` or `jaxsph.Particles`, got {type(part).__name__}")
    if not is_traced(pixels) and not float(pixels) > 0:
        raise ValueError(f"`pixels` must be > 0, got {pixels!r}; it is the largest size of what is merged")
    if isinstance(part, Points) and not part.profile.is_radial:
        raise ValueError("`profile` must be radial for points to be merged, got a function of the offset")
    found: Coarsened = _coarsened(part, camera, pixels)
    return found if is_traced(found.merged) else _compressed(found)


def coarse_bound(
    found: Coarsened, camera: Camera, settings: Settings | None = None, *, plan: Plan | None = None
) -> Float[Array, "height width"]:
    r"""How much any channel of a pixel, or its alpha, differs at most between points and `coarsened` points.

    **Theorem.** Let node n have the thickness $f_n$ along a ray, and its coarse point $g_n$, whatever else there is. Then light
    differs by at most $1 - \exp(-\sum_n \max(f_n, g_n))$. *Argument.* Light is the expected colour of the first event along the
    ray, of a Poisson process of all media. Both images may share what is not merged, and of each node as many events as the
    thinner of both has, if in other places; so where none of the $\max(f_n, g_n)$ events of any node happens, both see the same.
    $\square$ A node's ball here holds all of its points and the coarse one, and is wider such that every ray that can meet those
    has the thickness in it that all would have on one ray through their centres. It is not taken into account what hides a node,
    nor that rays miss most of it: a bound for few merged points beside much else, and one that says nothing where all of a
    picture is merged points that are thick.

    Args:
        found: of points.
        camera: the one that they were coarsened for: in front of its near depth, and behind the far one, nothing is merged.
        settings: `samples` and `memory_limit` are looked at.
        plan: as for `jaxsph.render`, for `Scene(points=found.balls)`.

    Returns:
        Bounds in [0, 1]; with rounding, but for that of points which both images have.
    """
    if found.balls is None:
        raise ValueError("`found` must be of points; nothing bounds merged particles")
    settings = settings or Settings()
    image = render(Scene(points=found.balls), camera, settings, plan=plan)
    rounding = 4 * (settings.samples + ROUNDINGS) * jnp.finfo(image.color.dtype).eps
    return jnp.minimum(image.alpha + rounding, 1)


@jax.jit
def _coarsened(part: Any, camera: Camera, pixels: Any) -> Coarsened:
    part, camera = lax.stop_gradient((part, camera))
    is_points = isinstance(part, Points)
    spheres = dataclasses.replace(part.spheres() if is_points else part, valid=part.usable() if is_points else part.valid)
    nodes = _Nodes.of(octree_cut(spheres, camera, pixels))
    return (_merged_points if is_points else _merged_particles)(part, camera, nodes)


@dataclasses.dataclass(frozen=True)
class _Nodes:
    """Members of nodes, as entries of a part.

    Attributes:
        head: of each entry, the one that stays.
        merged: entries that stay and stand for several.
        gone: entries that do not stay.
    """

    head: Array
    merged: Array
    gone: Array

    @classmethod
    def of(cls, cut: Cut) -> _Nodes:
        own = jnp.arange(cut.order.shape[0], dtype=jnp.int32)
        head = jnp.zeros_like(own).at[cut.order].set(cut.order[cut.head].astype(jnp.int32), unique_indices=True)
        members = jnp.zeros_like(own).at[head].add(1)
        return cls(head, members > 1, head != own)

    def sum(self, value: Array) -> Array:
        """Over the members of the node of each head."""
        return jnp.zeros_like(value).at[self.head].add(value)

    def max(self, value: Array) -> Array:
        """Over the same, of what is >= 0."""
        return jnp.zeros_like(value).at[self.head].max(value)

    def mean(self, value: Array, weight: Array) -> Array:
        """Weighed; of all alike where nothing has any weight."""
        largest = self.max(weight)[self.head]
        share = jnp.where(largest > 0, weight / jnp.where(largest > 0, largest, 1), 1)
        total = self.sum(share)
        total = jnp.where(total > 0, total, 1)
        return self.sum(value * _like(share, value)) / _like(total, value)

    def put(self, new: Array, old: Array) -> Array:
        """What stands for several, beside what is as it was."""
        return jnp.where(_like(self.merged, old), new.astype(old.dtype), old)


def _like(value: Array, other: Array) -> Array:
    return value if other.ndim == 1 else value[:, None]


class _Centroid(NamedTuple):
    """Position of nodes by head, and of members relative to it."""

    shift: Array
    offset: Array

    @classmethod
    def of(cls, part: Any, nodes: _Nodes, weight: Array) -> _Centroid:
        rest = jnp.zeros_like(part.position) if part.position_rest is None else part.position_rest
        from_head = (part.position - part.position[nodes.head]) + (rest - rest[nodes.head])
        shift = nodes.mean(from_head, weight)
        return cls(shift, from_head - shift[nodes.head])


def _moved(part: Any, nodes: _Nodes, shift: Array) -> dict[str, Any]:
    position = nodes.put(part.position + shift, part.position)
    if part.position_rest is None:
        return {"position": position}
    left = (part.position - position) + shift  # what adding it up has lost
    return {"position": position, "position_rest": nodes.put(part.position_rest + left, part.position_rest)}


def _merged_points(points: Points, camera: Camera, nodes: _Nodes) -> Coarsened:
    unit = nodes.max(points.radius)[nodes.head]
    weight = points.extinction * (points.radius / unit) ** 3
    centroid = _Centroid.of(points, nodes, weight)
    away = jnp.linalg.norm(centroid.offset, axis=1)
    square = (away / unit) ** 2 / (3 * _second_moment(points.profile, points.dtype)) + (points.radius / unit) ** 2
    radius = unit * jnp.sqrt(nodes.mean(square, weight))
    extinction = nodes.sum(points.extinction * (points.radius / radius[nodes.head]) ** 3)
    color = jnp.clip(nodes.mean(points.color, weight), 0, 1)
    new: dict[str, Any] = {"radius": radius, "extinction": extinction, "color": color}
    merged: dict[str, Any] = {name: nodes.put(value, getattr(points, name)) for name, value in new.items()}
    coarse = dataclasses.replace(points, **_moved(points, nodes, centroid.shift), **merged, valid=points.valid & ~nodes.gone)
    return Coarsened(coarse, nodes.merged, _balls(points, coarse, camera, nodes, away))


def _balls(points: Points, coarse: Points, camera: Camera, nodes: _Nodes, away: Array) -> Points:
    """Balls around merged points, with which every ray that can meet them has at least their thickness; rounded up."""
    through = points.profile.most()
    needed = jnp.maximum(nodes.sum(points.extinction * points.radius), coarse.extinction * coarse.radius) * through
    eps = jnp.finfo(points.dtype).eps
    reach = jnp.maximum(nodes.max(away + points.radius), coarse.radius)
    size = jnp.abs(camera.offset(coarse.position, coarse.position_rest)).sum(1)
    reach = reach * (1 + ROUNDINGS * eps) + 3 * ROUNDINGS * eps * size
    num = nodes.sum(jnp.ones_like(away))
    needed = needed * (1 + (num + 2 * ROUNDINGS) * eps)
    radius, extinction = jnp.where(nodes.merged, WIDER * reach, 1), jnp.where(nodes.merged, 0.5 * needed / reach, 0)
    columns: dict[str, Any] = {"radius": radius, "extinction": extinction, "color": jnp.ones_like(coarse.color)}
    static: dict[str, Any] = {"attributes": {}, "profile": Ball(), "splats_beyond": None, "spread": "centres"}
    return dataclasses.replace(coarse, **columns, **static, valid=coarse.valid & nodes.merged)


def _second_moment(profile: Profile, dtype: Any) -> Array:
    """Mean square of a coordinate over the profile of a point of radius 1."""
    node, weight = (jnp.asarray(part, dtype) for part in np.polynomial.legendre.leggauss(64))
    square = (0.5 * (node + 1)) ** 2
    shell = weight * square * profile.at_square(square)
    total = shell.sum()
    return jnp.where(total > 0, (shell * square).sum() / (3 * jnp.where(total > 0, total, 1)), 0.2)


def _merged_particles(particles: Particles, camera: Camera, nodes: _Nodes) -> Coarsened:
    weight = jnp.where(particles.valid, particles.volume, 0)
    centroid = _Centroid.of(particles, nodes, weight)
    support = nodes.max(jnp.linalg.norm(centroid.offset, axis=1) + particles.support)
    new = {"support": support, "volume": nodes.sum(weight)}
    names = [name for name in particles.columns if name.endswith("quantity")]
    new |= {name: nodes.mean(getattr(particles, name), weight) for name in names}
    merged: dict[str, Any] = {name: nodes.put(value, getattr(particles, name)) for name, value in new.items()}
    moved = _moved(particles, nodes, centroid.shift)
    return Coarsened(dataclasses.replace(particles, **moved, **merged, valid=particles.valid & ~nodes.gone), nodes.merged, None)


def _compressed(found: Coarsened) -> Coarsened:
    """In no more entries than what is left takes (host side)."""
    kept = np.flatnonzero(np.asarray(found.part.valid))
    room = capacity_class(len(kept))
    if room >= found.part.capacity:
        return found
    chosen = np.concatenate([kept, np.full(room - len(kept), kept[0] if len(kept) else 0)])
    exists = jnp.arange(room) < len(kept)
    take = functools.partial(_taken, chosen=chosen)
    part, merged = take(found.part), take(found.merged) & exists
    balls = None if found.balls is None else take(found.balls)
    if balls is not None:
        balls = dataclasses.replace(balls, valid=balls.valid & exists)
    return Coarsened(dataclasses.replace(part, valid=exists), merged, balls)


def _taken(tree: Any, *, chosen: np.ndarray) -> Any:
    """Some entries of columns; what is of a whole set is left."""
    if isinstance(tree, Points):
        columns = {name: getattr(tree, name)[chosen] for name in ("position", "radius", "color", "extinction", "valid")}
        rest = None if tree.position_rest is None else tree.position_rest[chosen]
        attributes = {name: value[chosen] for name, value in tree.attributes.items()}
        return dataclasses.replace(tree, **columns, position_rest=rest, attributes=attributes)
    if isinstance(tree, Particles):
        return tree.at(chosen)
    return jax.tree.map(lambda column: column[chosen], tree)
