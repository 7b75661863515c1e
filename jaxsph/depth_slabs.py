r"""Particles that are dealt out too: each device marches the samples of a depth slab, and holds only who can reach it.

Flow: scene, camera -> [depth_slabs: dealt -> march each -> composite] -> Image.

A field of CSPH is a quotient of sums, and the transfer function is not linear: what devices find of *particles* cannot be added
up, what they find of *samples* can be composited. So samples are shared out by their global number, in ranges of whole cells,
and a device holds every particle whose support reaches from its first border to its last: a halo of one support. All see the
depths, slabs and cells that one device sees, and sums of the same particles. Where a depth slab shows the premultiplied colour
C and lets through T, two of them show

$$(C_1, T_1) \circ (C_2, T_2) = (C_1 + T_1 C_2, \; T_1 T_2),$$

which is associative.

**Tolerance.** Let P depth slabs each be off by at most $e_p$, whatever colour in [0, 1] shines from behind: $|\Delta C_p +
\Delta T_p B| \le e_p$ for all B. That is how bounds of cells are meant (`control.errors`), and their sums. Replace the true
depth slabs by those that were found one after the other, front to back. In step p all in front is what was found, and lets
$\hat F_p = \prod_{q<p} \hat T_q \le 1$ through; all behind is true, and shows some B in [0, 1]. So the step changes the image
by at most $\hat F_p e_p$, and all of them together by at most $\sum_p \hat F_p e_p \le \sum_p e_p$, which is `error_bound`.
With a P-th part of the tolerance for each it is at most the tolerance. Alpha is the channel with colour 1.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Array, Float, Int

from jaxsph.access.slab_windows import CELL_SAMPLES
from jaxsph.along_rays import first_samples
from jaxsph.claims import certified, disclaimed, faults_of_settings, missed, tell
from jaxsph.depth_dealing import Parts, dealt_particles
from jaxsph.field.schedule import SlabRange
from jaxsph.frame import Drawn, Frame, over_bands
from jaxsph.layers import OfShards, assemble, crop, of_band
from jaxsph.model.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.particles import Particles
from jaxsph.model.registry import AT_POINTS, BOUNDING
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics import faults
from jaxsph.numerics.across import across
from jaxsph.numerics.checks import is_traced
from jaxsph.numerics.devices import mesh_of
from jaxsph.numerics.executors import Executor, Traced
from jaxsph.over_mesh import apart, on_each, over
from jaxsph.plan import Plan
from jaxsph.planning import see
from jaxsph.render import metadata_of
from jaxsph.viewing import Seen, half_steps

TIES = 16  # eps that a transmittance may be off one half, where rounding decides which depth slab it crosses in
SHARE_ROUNDING = 4  # eps a part that shares of a tolerance are less, so that their sum is not more in floating point


@dataclasses.dataclass(frozen=True)
class DepthSlabs:
    """A scene whose particles are dealt to devices by depth; make it with `of`.

    Attributes:
        scene: of whose particles every array has a first axis of devices, along which it lies on them; all else all devices hold.
        parts: which particles those are, and which samples each device marches.
        plan: with room for each of them.
        mesh: the devices, front to back.
    """

    scene: Scene
    parts: Parts
    plan: Plan
    mesh: Mesh

    @classmethod
    def of(
        cls, scene: Scene, camera: Camera, settings: Settings | None = None, devices: Any = "all", *, margin: float = 0.0
    ) -> DepthSlabs:
        """Deal out the particles of a scene as a camera sees it (host side).

        Depth slabs are so deep that about as many particles reach each. The arrays of `scene` may be NumPy's or those of any
        device; each device is given its own particles alone, and one of them at a time measures what room these need.

        Args:
            scene: particles, and other media, of which every device holds all.
            camera, settings: as for `jaxsph.render`.
            devices: `"all"`, a number, a sequence of `jax.Device`, or a mesh.
            margin: length by which particles may move, or the camera along its line of sight, before they are to be dealt anew.

        Raises:
            ValueError: settings that ask for samples that others would have to know of (`estimator="pilot"`,
                `screen="quadtree"`, `"step_doubling"`), a periodic set, or more devices than cells of 16 samples along a ray.
        """
        settings = settings or Settings()
        mesh = mesh_of(devices)
        _require_local(scene, settings)
        _require_cells(settings, mesh.size)
        particles, parts, plan = dealt_particles(scene, camera, _share_of(settings, mesh.size), mesh, margin)
        return cls(dataclasses.replace(scene, particles=particles), parts, plan, mesh)

    def with_particles(self, particles: Particles) -> DepthSlabs:
        """With other values of the same particles as `of` was given, each with those who hold it; differentiable."""
        dealt = on_each(self.mesh, lambda particles, parts: parts.of(particles), particles, self.parts)
        return dataclasses.replace(self, scene=dataclasses.replace(self.scene, particles=dealt))


def render_slabs(slabs: DepthSlabs, camera: Camera, settings: Settings | None = None) -> Image:
    """Render a scene whose particles are dealt to devices by depth.

    Eagerly, faults raise; under `jax.jit` the function is pure and reports them in `image.faults`. Where transmittance falls to
    one half, slabs are marched once more to find the depth: `evaluations` do not count that.

    Args:
        slabs: see `DepthSlabs.of`.
        camera, settings: as the particles were dealt for; another camera may look as long as each particle reaches no depth slab
            of a device that does not hold it, which is a fault.

    Returns:
        The image of `jaxsph.render` to rounding; with a tolerance, within that of the image at full rate, of which every device
        takes a part.

    Differentiation:
        As `jaxsph.render`, in both modes, by all that floats in `slabs.scene` and `camera`; by particles of their own through
        `DepthSlabs.with_particles`, which adds up what all who hold one find.
    """
    settings = settings or Settings()
    _require_local(slabs.scene, settings)
    slabs.plan.check_image(camera, _share_of(settings, slabs.mesh.size))
    if is_traced(slabs, camera, settings):
        return _traced(slabs, camera, settings)
    return _eager(slabs, camera, settings)


def _eager(slabs: DepthSlabs, camera: Camera, settings: Settings) -> Image:
    given = {name: getattr(settings, name) for name in ("tolerance", "relax", "min_transmittance")}
    numbers: dict[str, Any] = {name: None if value is None else float(value) for name, value in given.items()}
    settings = dataclasses.replace(settings, **numbers)  # hashable, whatever they were
    begun = time.perf_counter()
    image = jax.block_until_ready(_program(settings)(slabs, camera))
    seconds = {"cast": time.perf_counter() - begun}
    word = int(image.faults)
    faults.raise_for(word & ~faults.TOLD)
    tell(word, image, settings)
    stats = {name: int(value) for name, value in image.stats.items()} | {"seconds": seconds}
    proven = bool(image.certified)
    return dataclasses.replace(image, certified=proven, faults=word, stats=stats, metadata=metadata_of(camera, settings, proven))


@functools.lru_cache(maxsize=16)
def _program(settings: Settings) -> Any:
    return jax.jit(functools.partial(_traced, settings=settings))


def _traced(slabs: DepthSlabs, camera: Camera, settings: Settings) -> Image:
    plan, mesh = slabs.plan, slabs.mesh
    share = _share_of(settings, mesh.size)
    rest = dataclasses.replace(slabs.scene, particles=None, transfer=None)

    def of_device(shared: Any, part: tuple[Particles, Parts]) -> tuple[Image, Any, Drawn]:
        (rest, transfer, camera, share), (particles, own) = shared, part
        scene = dataclasses.replace(rest, particles=particles, transfer=transfer)
        return _part(scene, own, camera, share, plan, mesh)

    parts = slabs.scene.particles, slabs.parts
    images, full, found = over(mesh, of_device, (rest, slabs.scene.transfer, camera, share), parts)
    word = functools.reduce(lambda a, b: a | b, [found.faults[nth] for nth in range(mesh.size)])
    image = composited(apart(images, mesh.size))
    word = word | missed(image, settings) | faults_of_settings(settings)
    counts = {"cells": found.filled.sum(), "pairs": found.pairs.sum()}
    stats = {"evaluations": image.evaluations.sum(), "evaluations_full": full.sum(), **counts}
    return disclaimed(dataclasses.replace(image, certified=jnp.asarray(certified(plan, settings)), stats=stats), word)


def _part(scene: Scene, own: Parts, camera: Camera, share: Settings, plan: Plan, mesh: Mesh) -> tuple[Image, Any, Drawn]:
    """What the rays meet of this device's depth slab: all by itself, but for the depth of half transmittance."""
    run, axes = Traced(), mesh.axis_names
    with across(axes):
        seen = see(scene, camera, plan, run)
    begun = Frame.begun(seen, camera, share, plan, scene.formulas, 1, run)
    per_cell = CELL_SAMPLES // plan.cast.slab_samples
    frame = dataclasses.replace(begun, own=SlabRange(own.cells[0] * per_cell, own.cells[1] * per_cell))
    found = over_bands(plan, functools.partial(_band, frame, run, axes))
    layers = crop(found.layers, plan)
    word = found.faults | seen.viewed.faults | _beyond(seen, own, camera, plan, axes)
    image = dataclasses.replace(assemble(layers, word), certified=jnp.asarray(True))
    return image, layers.full, Drawn((), word, found.filled, found.pairs)


def _band(frame: Frame, run: Executor, axes: tuple[str, ...], first_row: Int[Array, ""]) -> Drawn:
    made = frame.grid(first_row, run)
    grid = made.of(frame.ordered)
    ((decided,), lattice) = frame.decide(grid, run)
    (met,) = frame.cast(grid, [decided], lattice, run)
    through = lax.stop_gradient(met.rays.transmittance)
    front = _in_front(through, axes)
    crossed = (front > 0.5) & (front * through <= 0.5 * (1 + TIES * jnp.finfo(front.dtype).eps))
    filled = decided.schedule.filled & crossed.any((1, 2))
    where = decided._replace(schedule=dataclasses.replace(decided.schedule, filled=filled))
    (again,) = frame.cast(grid, [where], None, run, front=front)
    met = met._replace(rays=dataclasses.replace(met.rays, depth=again.rays.depth))
    layers = of_band(OfShards((met,), (decided.verdict,)), plan=frame.plan)
    return Drawn(layers, made.lists.faults, made.filled, made.pairs)


def _in_front(through: Float[Array, "packets rows columns"], axes: tuple[str, ...]) -> Float[Array, "packets rows columns"]:
    """What all depth slabs in front of this device's let through."""
    every, nth = lax.all_gather(through, axes), lax.axis_index(axes)
    number = jnp.arange(every.shape[0], dtype=jnp.int32)[:, None, None, None]
    return jnp.where(number < nth, every, 1).prod(0)


def _beyond(seen: Seen, own: Parts, camera: Camera, plan: Plan, axes: tuple[str, ...]) -> Int[Array, ""]:
    """A fault where a particle reaches depth slabs that other devices march and do not hold it for."""
    viewed = jax.tree.map(lax.stop_gradient, seen.viewed)
    borders = half_steps(jax.tree.map(lax.stop_gradient, camera), viewed.z.dtype, plan.samples)[::2]
    ends = lax.all_gather(own.cells[1], axes)[:-1]
    inner = borders[jnp.minimum(ends * CELL_SAMPLES, plan.samples)]
    first = jnp.searchsorted(inner, viewed.z - viewed.reach, side="left")
    last = jnp.searchsorted(inner, viewed.z + viewed.reach, side="right")
    room = viewed.live.shape[0] - own.first.shape[0]
    holders = [jnp.pad(value, (0, room)) for value in (own.first, own.last)]
    out = viewed.live & ((first < holders[0]) | (last > holders[1]))
    return faults.raised(faults.BEYOND_HALO, out.any())


def composited(parts: tuple[Image, ...]) -> Image:
    """The image of depth slabs one behind the other; see the top of this file for its error."""
    whole, *behind = parts
    for part in behind:
        front = whole.transmittance
        color = whole.color + front[..., None] * part.color
        bound = whole.error_bound + lax.stop_gradient(front) * part.error_bound
        levels = None if whole.levels is None or part.levels is None else jnp.maximum(whole.levels, part.levels)
        whole = dataclasses.replace(
            whole,
            color=color,
            transmittance=front * part.transmittance,
            depth=jnp.minimum(whole.depth, part.depth),
            error_bound=jnp.minimum(bound, 1),
            evaluations=whole.evaluations + part.evaluations,
            levels=levels,
        )
    return whole


def _share_of(settings: Settings, parts: int) -> Settings:
    """What each of so many depth slabs keeps to; cells are not merged, as those of others are not known."""
    if settings.tolerance is None:
        return settings
    share = settings.tolerance * ((1 - SHARE_ROUNDING * parts * float(np.finfo(np.float32).eps)) / parts)
    return dataclasses.replace(settings, tolerance=share, merge=False)


def _require_local(scene: Scene, settings: Settings) -> None:
    """Raise where a depth slab would need what lies beyond its halo."""
    scene.check()
    if scene.particles is None:
        raise ValueError("`scene` must have particles to deal out, got none; take `jaxsph.render(..., devices=...)`")
    if scene.particles.box is not None:
        raise ValueError("`scene` must have no periodic particles, as their images are found from all of them; leave out `box`")
    if settings.tolerance is not None and settings.estimator == "pilot" and not settings.is_refined:
        raise ValueError("`estimator` must be 'interval' with depth slabs, got 'pilot', which interpolates across their borders")
    if settings.screen != "pixels":
        raise ValueError(f"`screen` must be 'pixels' with depth slabs, got {settings.screen!r}")
    if settings.integrator in AT_POINTS | BOUNDING:
        raise ValueError(f"`integrator` must be 'samples' or 'segments' with depth slabs, got {settings.integrator!r}")


def _require_cells(settings: Settings, parts: int) -> None:
    samples = first_samples(settings)
    cells = -(-samples // CELL_SAMPLES)
    if parts > cells:
        raise ValueError(
            f"`devices` must be at most {cells}, one for each {CELL_SAMPLES} of {samples} samples, got {parts}; "
            "give more samples, or fewer devices"
        )


jax.tree_util.register_dataclass(DepthSlabs, data_fields=["scene", "parts"], meta_fields=["plan", "mesh"])
