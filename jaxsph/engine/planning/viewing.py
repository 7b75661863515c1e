"""The first stage of a frame: all that is in the scene as the camera sees it, in the units of later stages; and how much it is.

Flow: scene, camera -> [viewing: view_scene -> measure] -> plan, stages.

Looks that an optimiser stepped out of range with are taken back into it, and derivatives pass as if they had not been: a further
step may lead inside again. What is off by more than rounding sets a fault.

A frame's capacities are made from counts of pairs, exact, and a few medians of sizes, which the host finds.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.lists import BUNDLE, TILE, nodes_between
from jaxsph.engine.access.precision import in_units_of, too_fine, too_small
from jaxsph.engine.access.view import Spheres, Viewed, view_particles
from jaxsph.engine.media.points import PointsMedium
from jaxsph.engine.media.shown import Within
from jaxsph.engine.media.surfaces.particle_surface import ParticleSurface
from jaxsph.engine.media.volume import VolumeMedium
from jaxsph.engine.runtime.programs import stage
from jaxsph.model.camera.camera import Camera
from jaxsph.model.clips import Clip
from jaxsph.model.medium import Medium
from jaxsph.model.particles.periodic import unfolded
from jaxsph.model.points import Points
from jaxsph.model.scene import Scene, first_spheres, num_spheres, spheres_of
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.numerics import faults
from jaxsph.numerics.checks import ROUNDED, as_usual

MAX_MEDIAN_OF = 1 << 16  # particles that a median is taken of: it only has to tell sizes that differ by a half


def scene_in_range(scene: Scene) -> tuple[Scene, Int[Array, ""]]:
    """The scene with all looks in range, and a fault word."""
    word = jnp.int32(faults.NONE)

    def kept(look: Any) -> Any:
        nonlocal word
        if look is None or isinstance(look, tuple):
            return look if look is None else tuple(map(kept, look))
        if isinstance(look, Points):
            (color, extinction), off = _shaded(look.color, look.extinction, look.valid)
            look = dataclasses.replace(look, color=color, extinction=extinction)
        else:
            (colors, extinction), off = _shaded(look.colors, look.extinction)
            control = {name: getattr(look, name) for name in ("values", "extinction_values") if getattr(look, name) is not None}
            ascending = {name: _straight(lax.cummax, values) for name, values in control.items()}
            for name, values in control.items():
                off |= (ascending[name] - values > _slack(values)).any()
            look = dataclasses.replace(look, colors=colors, extinction=extinction, **ascending)
        word |= faults.raised(faults.CLIPPED_LOOK, off)
        return look

    looks = {name: kept(getattr(scene, name)) for name in ("transfer", "volume_transfer", "points")}
    return dataclasses.replace(scene, **looks), word


def _shaded(color: Array, extinction: Array, valid: Any = True) -> tuple[tuple[Array, Array], Bool[Array, ""]]:
    """Colours in [0, 1] and extinctions >= 0; whether any was off by more than rounding."""
    shades = _straight(lambda value: jnp.clip(value, 0, 1), color)
    darkness = _straight(lambda value: jnp.clip(value, 0, jnp.inf), extinction)
    bright = (abs(shades - color) > ROUNDED * jnp.finfo(color.dtype).eps).any(-1) & valid
    glowing = (darkness - extinction > _slack(extinction)) & valid
    return (shades, darkness), bright.any() | glowing.any()


def _slack(values: Array) -> Array:
    """What rounding may have moved values by that are made of one another."""
    return ROUNDED * jnp.finfo(values.dtype).eps * jnp.max(jnp.where(jnp.isfinite(values), abs(values), 0), initial=0)


def _straight(function: Callable[[Array], Array], values: Array) -> Array:
    """`function(values)` with the derivatives of the values themselves, also where it changes them."""
    found = jax.custom_jvp(lambda values: function(values))
    found.defjvp(as_usual()(lambda primals, tangents: (found(*primals), tangents[0])))
    return found(values)  # type: ignore[no-any-return]


class SceneInView(NamedTuple):
    """A scene in view space: particles, other media, and the transfer function in the units of the particles.

    Attributes:
        viewed: particles, spheres of point sets, and padding; a scene without any has padding alone.
        transfer: of the particles; None without any, or where their surface is shown instead.
        media: other media, in view space.
        order: particles in the order of their keys; None where the host did not sort them.
        within: where particles are shown; None everywhere.
    """

    viewed: Viewed
    transfer: TransferFunction | None
    media: tuple[Medium, ...]
    order: Int[Array, " particles"] | None = None
    within: Clip | None = None

    def with_data(self, scene: Scene) -> SceneInView:
        """With the arrays of the scene that media read, which no stage is to copy."""
        surface = () if scene.surface is None else (scene.surface,)
        given = (*surface, *(volume for volume, _ in scene.volumes), *scene.point_sets, *scene.media)
        return self._replace(media=tuple(medium.with_data(part) for medium, part in zip(self.media, given, strict=True)))


@stage("samples", "capacity", "num_classes", "between_samples", quickly=True)
def view_scene(
    scene: Scene, camera: Camera, *, samples: int, capacity: int, num_classes: int, between_samples: bool = False
) -> SceneInView:
    """All that depends on the scene and the camera alone; with the fault bits of both, whose numbers may change under jit."""
    dtype, within = jnp.promote_types(scene.dtype, camera.dtype), scene.particles_within
    margin = longest_interval(camera, samples) if between_samples else 0.0
    scene, clipped = scene_in_range(scene)
    folded = jnp.int32(faults.NONE)
    if scene.particles is not None and scene.particles.box is not None:  # as many ghosts as there is room for
        particles, _, folded = unfolded(scene.particles, capacity - num_spheres(scene), lax.stop_gradient(margin))
        scene = dataclasses.replace(scene, particles=particles)
    particles = spheres_of(scene).padded(capacity)
    particles = jax.tree.map(lambda leaf: leaf.astype(dtype) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf, particles)
    transfer = jax.tree.map(lambda leaf: leaf.astype(dtype), scene.transfer)
    if transfer is not None:
        particles, transfer = in_units_of(particles, transfer)
    depths = sphere_depths(camera, dtype, samples, between_samples)
    fringe = 0.5 if scene.formulas.antialias > 1 else 0
    viewed = view_particles(particles, camera, depths, num_classes, fringe)
    volumes = (VolumeMedium.seen(volume, look, camera) for volume, look in scene.volumes)
    sets = zip(scene.point_sets, first_spheres(scene), strict=True)
    points, clip = (PointsMedium.seen(some, camera, number) for some, number in sets), _clip(scene.within, camera, dtype)
    media = tuple(Within.of(one, clip) for one in (*volumes, *points, *(medium.seen_by(camera) for medium in scene.media)))
    if scene.surface is not None:
        clip = _clip(within, camera, dtype)
        media, transfer = (ParticleSurface.seen(scene.surface, particles, viewed, transfer, clip, camera), *media), None
    word = functools.reduce(lambda a, b: a | b, (medium.fault for medium in media), _input_faults(scene, camera, samples))
    media = tuple(medium.with_data(None) for medium in media)
    viewed = dataclasses.replace(viewed, faults=viewed.faults | word | folded | clipped)
    return SceneInView(viewed, transfer, media, within=_clip(within, camera, dtype))


def _clip(clip: Clip | None, camera: Camera, dtype: Any) -> Clip | None:
    return None if clip is None else jax.tree.map(lambda leaf: leaf.astype(dtype), clip.seen_by(camera))  # type: ignore[no-any-return]


def half_steps(camera: Camera, dtype: Any, samples: int) -> Float[Array, " two_samples_and_one"]:
    """View depths s(0), s(1/2), ... s(N): fine samples sit at the odd entries, between borders at the even ones."""
    return camera.depth(jnp.arange(2 * samples + 1, dtype=dtype) / 2, samples).astype(dtype)


def longest_interval(camera: Camera, samples: int) -> Float[Array, ""]:
    """Path length between neighbouring borders of samples, where they are farthest apart."""
    depth = half_steps(camera, camera.dtype, samples)[::2]
    step = (depth[1:] - depth[:-1]).max()
    if not camera.is_perspective:
        return step
    return step * jnp.sqrt(1 + camera.half_height**2 * (1 + (camera.width / camera.height) ** 2))


def sphere_depths(camera: Camera, dtype: Any, samples: int, between_samples: bool) -> Float[Array, " samples"]:
    """Depths of the fine samples, by which spheres are ordered; out to the borders of the first and the last where they count."""
    steps = half_steps(camera, dtype, samples)
    depths = steps[1::2]
    if not between_samples:
        return depths
    return depths.at[0].set(steps[0]).at[-1].set(steps[-1]) if samples > 1 else steps[::2]


def camera_usable(camera: Camera) -> Bool[Array, ""]:
    """Whether a camera's numbers are finite, and its depths and its size such as can be."""
    numbers = jnp.concatenate([camera.eye, camera.axes.ravel(), jnp.stack([camera.half_height, camera.near, camera.far])])
    found = jnp.isfinite(numbers).all() & (camera.half_height > 0) & (camera.near < camera.far)
    return found & (camera.near > 0) if camera.is_perspective else found


def _input_faults(scene: Scene, camera: Camera, samples: int) -> Int[Array, ""]:
    """Of a camera and transfer functions that are not usable, once they are in range."""
    good = camera_usable(camera)
    word = faults.raised(faults.UNRESOLVED, good & too_fine(camera, samples)) | faults.raised(faults.BAD_CAMERA, ~good)
    for transfer in (scene.transfer, *(look for _, look in scene.volumes)):
        if transfer is not None:
            shown = jnp.isfinite(transfer.colors).all() & jnp.isfinite(transfer.extinction).all()
            for part in transfer.parts():
                shown &= jnp.isfinite(part.values).all() & ~too_small(part.values)
            word |= faults.raised(faults.BAD_TRANSFER, ~shown)
    return word


@dataclasses.dataclass(frozen=True)
class Measures:
    """Of the particles that a camera sees.

    Attributes:
        tile_pairs: (particle, tile) pairs in each row of tiles of the image.
        bundle_pairs: at most so many (particle, bundle) pairs in each row of tiles.
        rows, columns: of bundles, from the first to the last that any particle is seen in; at least 1.
        depth_extent: median diameter along depth, in samples; NaN where nothing is seen.
        diameter: median diameter across, in pixels; NaN where nothing is seen.
        of_lattice: (particle, tile) and (particle, bundle) pairs of the bundles of a lattice of rays.
    """

    tile_pairs: np.ndarray
    bundle_pairs: np.ndarray
    rows: int
    columns: int
    depth_extent: float
    diameter: float
    of_lattice: tuple[int, int] = (0, 0)


def measure(viewed: Viewed, camera: Camera, samples: int, stride: int = 1) -> Measures:
    """Measure particles in the view of a camera with `samples` along each ray; and for a lattice of rays of some stride."""
    seen, sides, of_tiles, of_bundles = pairs_in_view(viewed, camera)
    left, right, top, bottom = sides
    some = seen[:: max(1, len(seen) // MAX_MEDIAN_OF)]
    diameters = np.asarray(viewed.right)[some] - np.asarray(viewed.left)[some] + 1
    z, reach, (near, far) = np.asarray(viewed.z)[some], np.asarray(viewed.reach)[some], camera.near_and_far()
    front, back = (np.clip(np.asarray(z + side, np.float64), near, far) for side in (-reach, reach))  # as far as they are seen
    if camera.is_perspective:
        extents = samples * np.log(back / front) / np.log(far / near)
    else:
        extents = samples * (back - front) / (far - near)
    ends = (top, bottom), (left, right)
    rows, columns = (
        max(int(last.max(initial=-1) // BUNDLE - first.min(initial=1 << 30) // BUNDLE + 1), 1) for first, last in ends
    )
    depth, diameter = (float(np.median(values)) if len(values) else float("nan") for values in (extents, diameters))
    of_lattice = _pairs_of_lattice(sides, camera, stride) if stride > 1 else (0, 0)
    return Measures(of_tiles, of_bundles, rows, columns, depth, diameter, of_lattice)


def pairs_in_view(
    viewed: Spheres, camera: Camera
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray, np.ndarray]:
    """Which particles are in view, the pixels that they can touch, and how many tiles and bundles in each row of tiles."""
    sides = [np.asarray(side) for side in (viewed.left, viewed.right, viewed.top, viewed.bottom)]
    seen = np.flatnonzero((sides[1] >= sides[0]) & (sides[3] >= sides[2]))
    left, right, top, bottom = found = tuple(side[seen] for side in sides)
    tile_rows = -(-camera.height // TILE)
    of_bundles = _pairs_in_rows(found, BUNDLE, 2 * tile_rows).reshape(-1, 2).sum(1)
    return seen, (left, right, top, bottom), _pairs_in_rows(found, TILE, tile_rows), of_bundles


def _pairs_of_lattice(sides: tuple[np.ndarray, ...], camera: Camera, stride: int) -> tuple[int, int]:
    """How many tiles and bundles of nodes all particles can touch."""
    left, right = nodes_between(sides[0], sides[1], camera.width, stride)
    top, bottom = nodes_between(sides[2], sides[3], camera.height, stride)
    met = (right >= left) & (bottom >= top)
    ranges = [side[met] for side in (left, right, top, bottom)]
    rows = -(-camera.strided(stride).nodes[0] // TILE)
    tiles, bundles = (int(_pairs_in_rows(tuple(ranges), size, rows * TILE // size).sum()) for size in (TILE, BUNDLE))
    return tiles, bundles


def _pairs_in_rows(sides: tuple[np.ndarray, ...], size: int, rows: int) -> np.ndarray:
    """How many squares of `size` pixels all particles can touch in each row of them."""
    left, right, top, bottom = sides
    columns = right // size - left // size + 1
    begun = np.bincount(top // size, columns, rows + 1) - np.bincount(bottom // size + 1, columns, rows + 1)
    return np.cumsum(begun)[:-1].astype(np.int64)
