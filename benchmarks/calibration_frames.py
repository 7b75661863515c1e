"""Frames of the pilot estimator taken apart: the only place where calibration looks into the package.

What is measured is always the true effect: sums over particles, and light, are compared with those of every ray and sample.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxsph as js
from jaxsph.engine.access.grid import Grid
from jaxsph.engine.access.view import rank_particles
from jaxsph.engine.cast.march import CastMethod
from jaxsph.engine.control import pilot
from jaxsph.engine.control.decide import Limits
from jaxsph.engine.control.interpolation_error import CUBIC, InterpolationError, interpolation_error
from jaxsph.engine.control.pilot import decide_by_pilot
from jaxsph.engine.field.gather import gather
from jaxsph.engine.field.lattice import REACH, Lattice, gather_subsampled, interpolate, region_of, sum_at_nodes
from jaxsph.engine.field.sums import Sums
from jaxsph.engine.field.tasks import DENSE, INTERPOLATED, MAX_SPACING_LEVEL, SlabSchedule, SlabTask, full_rate
from jaxsph.engine.frame.stages import cast_shard, grid_of
from jaxsph.engine.media.shown import RayLimits, Shown
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.planning.viewing import half_steps, view_scene
from jaxsph.engine.runtime.clock import Clock
from jaxsph.engine.screen.packets import every_bundle
from jaxsph.model.settings import integrator_of
from jaxsph.model.transfer.function import TransferFunction

REACHES = 1.0, 1.25, 1.5, 2.0, 2.5, 3.0  # node spacings
CHUNK = 64  # slabs whose sums are compared at once


@dataclasses.dataclass(frozen=True)
class Frame:
    """A frame of one band: its lattice, whether it pays or not, and its interpolation error."""

    grid: Grid
    camera: js.Camera
    transfer: TransferFunction
    lattice: Lattice
    found: InterpolationError
    plan: Plan
    kernel: str

    @property
    def slab_samples(self) -> int:
        """Fine samples of a slab."""
        return self.plan.cast.slab_samples

    @property
    def full(self) -> SlabSchedule:
        """Every slab at full rate, of the shape that the pilot's has."""
        method = jnp.full(self.grid.windows.count.shape, DENSE, jnp.int32)
        reference = (jnp.broadcast_to(self.lattice.references[0], method.shape),)
        return dataclasses.replace(full_rate(self.grid.windows, reference), method=method)

    @property
    def sizes(self) -> dict:
        """What stages are compiled for."""
        return {"tuning": self.plan.cast.tuning}

    def decide(self, tolerance: float) -> SlabSchedule:
        """What the pilot decides."""
        limits = Limits(jnp.float32(tolerance), jnp.float32(0))
        shown = Shown(self.camera, self.transfer)
        return decide_by_pilot(
            self.grid, shown, limits, self.lattice, slab_samples=self.plan.cast.slab_samples, **self.sizes
        ).schedule

    def light(self, schedule: SlabSchedule) -> np.ndarray:
        """Colour and transmittance that rays end up with, (4, bundles, 64)."""
        inputs = self.grid, Shown(self.camera, self.transfer), schedule, self.lattice, RayLimits(), jnp.int32(0)
        method = CastMethod(self.kernel, self.plan.cast, integrator_of(self.plan.integrator), every_bundle)
        rays = cast_shard(*inputs, shards=1, method=method, **self.sizes)
        return np.append(
            np.moveaxis(np.asarray(rays.color, float), -1, 0), np.asarray(rays.transmittance, float)[None], 0
        ).reshape(4, -1, 64)


def frame_of(scene: js.Scene, camera: js.Camera, plan: Plan) -> Frame:
    """Grid, lattice and interpolation error as a frame of the pilot has them."""
    assert plan.bands == 1, "the image is too large to be looked at in one piece"
    grid, transfer = _seen(scene, camera, plan)
    lattice, found = _judged(grid, camera, transfer, plan=plan, kernel=scene.particles.kernel)
    return Frame(grid, camera, transfer, lattice, found, plan, scene.particles.kernel)


def _seen(scene: js.Scene, camera: js.Camera, plan: Plan) -> tuple[Grid, TransferFunction]:
    viewed, transfer, _ = view_scene(scene, camera, samples=plan.samples, num_classes=plan.num_classes)
    depths = half_steps(camera, viewed.x.dtype, plan.samples)[1::2]
    ordered = rank_particles(viewed, camera, depths, plan.cast.slab_samples)
    given = Clock(traced=True), ordered, camera, jnp.int32(0), plan.lists, plan.cast.tuning
    return grid_of(*given, samples=plan.samples, beside=False)[0], transfer


@functools.partial(jax.jit, static_argnames=("plan", "kernel"))
def _judged(
    grid: Grid, camera: js.Camera, transfer: TransferFunction, *, plan: Plan, kernel: str
) -> tuple[Lattice, InterpolationError]:
    """`stages.sum_shard`, but that a lattice is sampled even where it does not pay."""
    nodes, slab_samples = plan.control.nodes, plan.cast.slab_samples
    amid = jnp.clip(grid.ordered.quantity[jnp.argmax(grid.ordered.live)], transfer.values[0], transfer.values[-1])
    region = region_of(grid, *(plan.control.room or plan.lists.bundles), nodes)
    lattice = sum_at_nodes(grid, camera, kernel, slab_samples, region, (amid,), plan.cast.tuning.cells_of_nodes)
    return lattice, interpolation_error(grid, lattice, camera, transfer, slab_samples)


def variants(frame: Frame, schedule: SlabSchedule) -> dict[str, SlabSchedule]:
    """A schedule with every sample of what is interpolated; and as it is."""
    full = frame.full
    level = jnp.where(schedule.method >= INTERPOLATED, INTERPOLATED, schedule.method)
    return {"fine": dataclasses.replace(schedule, filled=full.filled, level=full.level, method=level), "all": schedule}


def bend_effect(frame: Frame, schedule: SlabSchedule) -> np.ndarray:
    """Deviation that `spacing` ascribes to wider samples, per bundle, were `DEVIATION_PER_BEND` one."""
    bend, level = np.asarray(frame.found.bend, float), np.asarray(schedule.level)
    variance = np.zeros(bend.shape[1])
    for coarse in range(1, MAX_SPACING_LEVEL + 1):
        share = 1 << coarse
        whole = len(bend) // share * share
        groups = np.where(level == coarse, bend, 0)[:whole].reshape(-1, share, bend.shape[1]).sum(1)
        variance += (((share**2 - 1) / (24 * frame.plan.control.nodes.samples**2) * groups) ** 2).sum(0)
    return np.sqrt(variance)


def reached(frame: Frame, slab: np.ndarray, bundle: np.ndarray) -> np.ndarray:
    """Node spacings that the least support of slabs reaches, rounded down to one of `REACHES`; 0 below all of them."""
    most, present = np.zeros(len(slab)), pilot.RESOLVED
    try:
        for reach in REACHES:
            pilot.RESOLVED = reach
            here = pilot._resolved(frame.grid, frame.camera, frame.slab_samples, frame.lattice.region.spacing)
            most = np.where(np.asarray(here)[slab, bundle], reach, most)
    finally:
        pilot.RESOLVED = present
    return most


def slabs_to_compare(frame: Frame, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Filled slabs, chosen at random, whose cubics take no nodes beyond the lattice; and their bundles."""
    region, count = frame.lattice.region, np.asarray(frame.grid.windows.count)
    row, column, inside = (np.asarray(side) for side in region.place(frame.grid))
    inside = inside & (row > 0) & (row < region.rows - 2) & (column > 0) & (column < region.columns - 2)
    slab, bundle = np.nonzero((count > 0) & inside)
    usable = (slab > 0) & ((slab + 2) * frame.slab_samples < frame.grid.samples)
    slab, bundle = slab[usable], bundle[usable]
    chosen = np.random.default_rng(0).permutation(len(slab))[:number]
    chosen = chosen[np.argsort(-count[slab[chosen], bundle[chosen]], kind="stable")]
    return slab[chosen], bundle[chosen]


def compare_sums(frame: Frame, slab: np.ndarray, bundle: np.ndarray) -> dict[str, np.ndarray]:
    """What interpolation of sums does to slabs, see `_compared`."""
    pad = (0, -len(slab) % CHUNK)
    at = [np.pad(side, pad, mode="edge").reshape(-1, CHUNK) for side in (slab, bundle)]
    compared = functools.partial(_compared, frame.grid, frame.lattice, frame.camera, kernel=frame.kernel)
    found = [compared(*each, slab_samples=frame.slab_samples) for each in zip(*at, strict=True)]
    return {name: np.concatenate([np.asarray(one[name]) for one in found])[: len(slab)] for name in found[0]}


@functools.partial(jax.jit, static_argnames=("kernel", "slab_samples"))
def _compared(
    grid: Grid, lattice: Lattice, camera: js.Camera, slab: Array, bundle: Array, *, kernel: str, slab_samples: int
) -> dict[str, Array]:
    """Mean squares of errors of the quantity, its true range, and whether samples were taken out of or put into nothing."""
    entries = full_rate(grid.windows, (jnp.broadcast_to(lattice.references[0], grid.windows.count.shape),))
    entry = jax.tree.map(lambda leaf: leaf[..., slab, bundle], entries)
    u, v = (rays.T for rays in grid.rays(camera, bundle))
    steps = grid.half_steps[2 * slab[:, None] * slab_samples + jnp.arange(2 * slab_samples + 1)]
    task = SlabTask(entry, slab, bundle, u, v, steps[:, 1::2], steps[:, ::2], camera.is_perspective)
    row, column, _ = (side[bundle] * lattice.region.spacing.across for side in lattice.region.place(grid))
    true, few, cubic = (
        _complex(sums)
        for sums in (
            gather(grid.ordered, grid.lists.rank, task, kernel),
            gather_subsampled(grid.ordered, grid.lists.rank, task, kernel),
            interpolate(lattice, slab, (row, column), slab_samples),
        )
    )
    inside = true.real > 0

    def ratio(sums: Array) -> Array:
        return jnp.where(inside & (sums.real > 0), sums.imag / jnp.where(sums.real > 0, sums.real, 1), 0)

    def mean_square(sums: Array) -> Array:
        return jnp.where(inside & (sums.real > 0), (ratio(sums) - ratio(true)) ** 2, 0).mean((1, 2))

    low = jnp.where(inside, ratio(true), jnp.inf).min((1, 2))
    high = jnp.where(inside, ratio(true), -jnp.inf).max((1, 2))
    wrong = ((cubic.real > 0) != inside).any((1, 2))
    return {"subsampled": mean_square(few), "lattice": mean_square(cubic), "low": low, "high": high, "wrong": wrong}


def _complex(sums: Sums) -> Array:
    """Weights as real, weighted quantities as imaginary part, rays in a row."""
    weight, weighted = (value.reshape(*value.shape[:2], -1) for value in sums.all)
    return jax.lax.complex(weight, weighted)


def estimate_sums(frame: Frame, slab: np.ndarray, bundle: np.ndarray) -> dict[str, np.ndarray]:
    """What the nodes tell of the same: as `interpolation_error` has it, written once more in plain NumPy."""
    nodes, region = frame.lattice.region.spacing, frame.lattice.region
    weight, weighted = (np.asarray(value, float) for value in (frame.lattice.weight, *frame.lattice.weighted))
    ratio = np.divide(weighted, weight, out=np.zeros_like(weight), where=weight > 0)
    of_weight, of_weighted = ([_fourth(value, axis) for axis in range(3)] for value in (weight, weighted))
    unsure = CUBIC * sum(np.abs(change) for change in of_weight)
    inverse = np.divide(1, weight, out=np.zeros_like(weight), where=weight > 0)
    squares = [(CUBIC * inverse * (b - ratio * a)) ** 2 for a, b in zip(of_weight, of_weighted, strict=True)]
    within, across = frame.slab_samples // nodes.samples, nodes.across
    row, column, _ = (np.asarray(side)[bundle] for side in region.place(frame.grid))
    layers = REACH + slab[:, None] * within + np.arange(within + 1)
    rows, columns = (side[:, None] * across + np.arange(across + 1) for side in (row, column))
    at = layers[:, :, None, None], rows[:, None, :, None], columns[:, None, None, :]
    border = np.asarray(frame.grid.half_steps, float)[::2]
    front, back = border[slab * frame.slab_samples], border[(slab + 1) * frame.slab_samples]
    pixel = 2 * float(frame.camera.half_height) / frame.camera.height * (back if frame.camera.is_perspective else 1)
    alike = np.maximum(frame.slab_samples * nodes.pixels * pixel / (back - front), 1)
    lateral = (squares[1] + squares[2])[at].mean((1, 2, 3))
    deep = squares[0][at].mean((1, 2, 3))
    margin = np.where(weight > 0, weight / np.maximum(unsure, np.finfo(float).tiny), 0)
    return {
        "lateral": lateral, "alike": alike, "deep": deep, "total": alike * lateral + nodes.samples * deep,
        "low": ratio[at].min((1, 2, 3)), "high": ratio[at].max((1, 2, 3)), "margin": margin[at].min((1, 2, 3)),
        "variance": np.asarray(frame.found.variance, float)[slab, bundle], "reach": reached(frame, slab, bundle),
    }  # fmt: skip


def _fourth(value: np.ndarray, axis: int) -> np.ndarray:
    """Fourth differences, zero at the two first and last nodes."""
    return np.pad(np.diff(value, 4, axis), [(2, 2) if k == axis else (0, 0) for k in range(3)])
