"""The yardstick: the least work that meets a tolerance, were the error of every choice known.

A cell (8 x 8 rays, 16 fine samples) may be given wider spaced samples ('z'); light that is interpolated from a lattice of its
rays ('light'); the quantity interpolated from such a lattice, and shaded at every sample ('field'); or both wider spaced and
interpolated. Every candidate of every cell is compared with full rate, a price on error shares out the bundles' tolerance, and
the image made of the choices is compared with the reference. Work counts kernel evaluations only: shading is not in it.

    python benchmarks/oracle.py [--scenes mixer radial:2 FILE] [--size 512] [--tolerance 0.004]

Writes `results/oracle.json`.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import peers
import workloads
from kept import keep

import jaxsph as js
from jaxsph.engine.access.grid import CELL_SAMPLES, Grid, SlabWindows, find_slab_windows
from jaxsph.engine.access.view import rank_particles, view_particles
from jaxsph.engine.field.gather import gather
from jaxsph.engine.field.tasks import SlabTask, full_rate, reference_quantities
from jaxsph.engine.frame import stages
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.planning.viewing import half_steps
from jaxsph.engine.runtime.clock import Clock
from jaxsph.model.transfer.function import Segments, look_up

CHUNK = 64  # cells at a time
HALVINGS = 60
RESULTS = peers.RESULTS.with_name("oracle.json")


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A way to sample a cell.

    Attributes:
        family: see `MIXES`.
        level: samples are 2**level fine ones apart.
        nodes: rows and columns of rays that are sampled; all others are interpolated by the polynomial through them.
        field: whether it is the sums over particles that are interpolated, not the light.
        depths: fine samples that are sampled; the field of all others is interpolated from the nearest four.
    """

    name: str
    family: str
    level: int = 0
    nodes: tuple[int, ...] = ()
    field: bool = False
    depths: tuple[int, ...] = ()

    @property
    def share(self) -> float:
        """Of the evaluations at full rate."""
        along = len(self.depths) / CELL_SAMPLES if self.depths else 0.5**self.level
        return along * (len(self.nodes) / 8) ** 2 if self.nodes else along


TWO, THREE, FOUR = (0, 7), (0, 3, 7), (0, 2, 5, 7)
EIGHT_DEEP, FIVE_DEEP = (0, 2, 4, 6, 9, 11, 13, 15), (0, 4, 8, 11, 15)
CANDIDATES = (
    Candidate("full", "full"),
    *(Candidate(f"level {level}", "z", level) for level in (1, 2, 3, 4)),
    Candidate("light 2", "light", nodes=TWO),
    Candidate("light 3", "light", nodes=THREE),
    Candidate("light 3, level 1", "light+z", 1, THREE),
    Candidate("light 2, level 2", "light+z", 2, TWO),
    Candidate("field 2", "field", nodes=TWO, field=True),
    Candidate("field 3", "field", nodes=THREE, field=True),
    Candidate("field 4", "field", nodes=FOUR, field=True),
    Candidate("field 3, level 1", "field+z", 1, THREE, True),
    Candidate("field 2, level 2", "field+z", 2, TWO, True),
    Candidate("field 3, 8 deep", "field+z", 0, THREE, True, EIGHT_DEEP),
    Candidate("field 3, 5 deep", "field+z", 0, THREE, True, FIVE_DEEP),
    Candidate("8 deep", "field+z", 0, (), True, EIGHT_DEEP),
    Candidate("5 deep", "field+z", 0, (), True, FIVE_DEEP),
)
MIXES = {
    "z": ("z",),
    "light": ("light",),
    "z and light": ("z", "light", "light+z"),
    "field": ("field",),
    "z and field": ("z", "field", "field+z"),
    "all": ("z", "light", "light+z", "field", "field+z"),
}


def lagrange(nodes: tuple[int, ...], at: np.ndarray) -> np.ndarray:
    """Weights of values at `nodes` for the polynomial through them, (at, nodes)."""
    return np.stack([np.prod([(at - b) / (a - b) for b in nodes if b != a], axis=0) for a in nodes], -1)


def from_lattice(nodes: tuple[int, ...]) -> np.ndarray:
    """(64, 64): keeps the rays at `nodes`, and interpolates all others."""
    one = np.zeros((8, 8), np.float32)
    one[:, nodes] = lagrange(nodes, np.arange(8.0))
    return np.kron(one, one)


def from_depths(nodes: tuple[int, ...]) -> np.ndarray:
    """(16, nodes): the cubic through the nearest four."""
    one = np.zeros((CELL_SAMPLES, len(nodes)), np.float32)
    for sample in range(CELL_SAMPLES):
        near = sorted(np.argsort(np.abs(np.asarray(nodes) - sample), kind="stable")[:4])
        one[sample, near] = lagrange(tuple(np.asarray(nodes)[near]), np.asarray(float(sample)))
    return one


@functools.partial(jax.jit, static_argnames="kernel")
def light_of_candidates(grid: Grid, beside: SlabWindows, scene: js.Scene, camera: js.Camera, at: Array, *, kernel: str) -> Array:
    """What cells emit and let through, (candidates, 4, cells, 64): red, green, blue, transmittance."""
    bundles = grid.windows.count.shape[1]
    cell, bundle = at // bundles, at % bundles
    u, v = (rays.T for rays in grid.rays(camera, bundle))
    half = jnp.minimum(2 * CELL_SAMPLES * cell[:, None] + jnp.arange(2 * CELL_SAMPLES + 1), grid.half_steps.shape[0] - 1)
    depth = grid.half_steps[half]
    schedule = full_rate(beside, (reference_quantities(grid.windows, grid.lists.rank, grid.ordered.quantity),))
    entry = jax.tree.map(lambda leaf: leaf[..., cell, bundle], schedule)
    border = 0.5 * (depth[:, 1:] + depth[:, :-1])
    task = SlabTask(entry, cell, bundle, u, v, depth[:, 1:-1], border, camera.is_perspective)
    sums = gather(grid.ordered, grid.lists.rank, task, kernel)
    weight, weighted = (value.reshape(*value.shape[:2], 64) for value in sums.all)
    slant = jnp.ones((at.shape[0], 1, 64), depth.dtype)
    if camera.is_perspective:
        slant = jnp.sqrt(1 + u[:, None, :] ** 2 + v[:, :, None] ** 2).reshape(-1, 1, 64)
    segments, reference = scene.transfer.segments(), entry.references[0][:, None, None]

    def light_of(candidate: Candidate) -> Array:
        step = 1 << candidate.level
        sums = [value[:, step - 1 :: 2 * step] for value in (weight, weighted)]
        across = from_lattice(candidate.nodes) if candidate.nodes else np.eye(64, dtype=np.float32)
        if candidate.depths:
            along = from_depths(candidate.depths)
            sums = [jnp.einsum("sk,ckr->csr", along, value[:, candidate.depths, :]) for value in sums]
        if candidate.field:
            sums = [jnp.einsum("pr,csr->csp", across, value) for value in sums]
        path = slant * jnp.diff(depth[:, :: 2 * step])[:, :, None]
        light = shaded(sums, reference, path, segments)
        return light if candidate.field else jnp.einsum("pr,xcr->xcp", across, light)

    return jnp.stack([light_of(candidate) for candidate in CANDIDATES])


def shaded(sums: list[Array], reference: Array, path: Array, segments: Segments) -> Array:
    """Light of cells of samples with these sums over particles, (4, cells, 64)."""
    weight, weighted = sums
    inside = weight > 0
    *color, extinction = look_up(segments, reference + jnp.where(inside, weighted / jnp.where(inside, weight, 1), 0))
    left = jnp.exp(-jnp.cumsum(jnp.where(inside, extinction * path, 0), 1))
    before = jnp.concatenate([jnp.ones_like(left[:, :1]), left[:, :-1]], 1)
    return jnp.stack([*((channel * (before - left)).sum(1) for channel in color), left[:, -1]])


@dataclasses.dataclass(frozen=True)
class Cut:
    """A frame's filled cells: light of their candidates, where they are, and their evaluations a ray at full rate."""

    light: np.ndarray
    cell: np.ndarray
    bundle: np.ndarray
    work: np.ndarray
    shape: tuple[int, int]


def cut(scene: js.Scene, camera: js.Camera) -> Cut:
    """All candidates of all cells of a frame."""
    usual = js.plan(scene, camera, js.Settings())
    deep = dataclasses.replace(usual, cast=dataclasses.replace(usual.cast, slab_samples=CELL_SAMPLES))
    assert usual.bands == 1, "the image is too large to be compared in one piece"
    slabs = np.asarray(grid_of(scene, camera, usual).windows.count)
    per_cell = CELL_SAMPLES // usual.cast.slab_samples
    slabs = np.pad(slabs, ((0, -len(slabs) % per_cell), (0, 0))).reshape(-1, per_cell, slabs.shape[1])
    work = slabs.sum(1) * usual.cast.slab_samples
    grid = grid_of(scene, camera, deep)
    beside = find_slab_windows(grid.ordered, grid.lists, beside=True)
    filled = np.flatnonzero(work.ravel())
    filled = filled[np.argsort(-np.asarray(beside.count).ravel()[filled], kind="stable")]
    light = np.empty((len(CANDIDATES), 4, len(filled), 64), np.float32)
    padded = jnp.asarray(np.pad(filled, (0, -len(filled) % CHUNK), mode="edge"), jnp.int32)
    for first in range(0, len(filled), CHUNK):
        at = padded[first : first + CHUNK]
        found = np.asarray(light_of_candidates(grid, beside, scene, camera, at, kernel=scene.particles.kernel))
        light[:, :, first : first + CHUNK] = found[:, :, : len(filled) - first]
    return Cut(light, filled // work.shape[1], filled % work.shape[1], work.ravel()[filled].astype(float), work.shape)


def grid_of(scene: js.Scene, camera: js.Camera, plan: Plan) -> Grid:
    depths = half_steps(camera, scene.particles.dtype, plan.samples)[1::2]
    ordered = rank_particles(
        view_particles(scene.particles, camera, depths, plan.num_classes), camera, depths, plan.cast.slab_samples
    )
    given = Clock(traced=True), ordered, camera, jnp.int32(0), plan.lists, plan.cast.tuning
    return stages.grid_of(*given, samples=plan.samples, beside=False)[0]


def composited(frame: Cut, light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The image by bundle, (4, bundles, 64), and what reaches each cell from the eye."""
    image = np.zeros((4, frame.shape[1], 64), np.float32)
    image[3] = 1
    front = np.empty((len(frame.cell), 64), np.float32)
    for cell in range(frame.shape[0]):
        at = np.flatnonzero(frame.cell == cell)
        bundle = frame.bundle[at]
        front[at] = image[3, bundle]
        image[:3, bundle] += image[3, bundle] * light[:3, at]
        image[3, bundle] *= light[3, at]
    return image, front


def true_errors(frame: Cut) -> np.ndarray:
    """How much each candidate, alone, changes its bundle's pixels at most, (candidates, cells)."""
    front = composited(frame, frame.light[0])[1]
    behind = np.zeros((4, frame.shape[1], 64), np.float32)
    behind[3] = 1
    errors = np.zeros((len(CANDIDATES), len(frame.cell)))
    for cell in reversed(range(frame.shape[0])):
        at = np.flatnonzero(frame.cell == cell)
        bundle, full = frame.bundle[at], frame.light[0][:, at]
        for candidate, light in enumerate(frame.light):
            change = light[:, at] - full
            color = np.abs(change[:3] + change[3] * behind[:3, bundle]).max(0)
            errors[candidate, at] = (front[at] * np.maximum(color, np.abs(change[3]) * behind[3, bundle])).max(-1)
        behind[:3, bundle] = full[:3] + full[3] * behind[:3, bundle]
        behind[3, bundle] *= full[3]
    return errors


def best(frame: Cut, errors: np.ndarray, families: tuple[str, ...], tolerance: float) -> dict:
    """The choice of least work whose errors add up to the tolerance, in each bundle."""
    offered = [k for k, candidate in enumerate(CANDIDATES) if candidate.family in ("full", *families)]
    share = np.array([CANDIDATES[k].share for k in offered])
    saving, errors, every = frame.work * (1 - share)[:, None], errors[offered], np.arange(len(frame.cell))
    low, high = np.full(frame.shape[1], 1e-3), np.full(frame.shape[1], 1e12)
    for _ in range(HALVINGS):
        price = np.sqrt(low * high)
        chosen = (saving - price[frame.bundle] * errors).argmax(0)
        keeps = np.bincount(frame.bundle, errors[chosen, every], frame.shape[1]) <= tolerance
        high, low = np.where(keeps, price, high), np.where(keeps, low, price)
    chosen = (saving - high[frame.bundle] * errors).argmax(0)
    light = frame.light[np.asarray(offered)[chosen], :, every].swapaxes(0, 1)
    error = np.abs(composited(frame, light)[0] - composited(frame, frame.light[0])[0]).max()
    taken = np.bincount(chosen, frame.work, len(offered)) / frame.work.sum()
    return {
        "saved": float(frame.work.sum() / (frame.work * share[chosen]).sum()),
        "max_error": float(error),
        "share_of_work": {CANDIDATES[k].name: round(float(part), 4) for k, part in zip(offered, taken, strict=True) if part},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--scenes", nargs="+", default=["mixer", "radial", "checker_board", "dam_break"], help="names, or particle files"
    )
    parser.add_argument("--size", type=int, default=512, help="pixels on a side")
    parser.add_argument("--tolerance", type=float, nargs="+", default=[0.004])
    parser.add_argument("-o", "--output", type=pathlib.Path, default=RESULTS)
    arguments = parser.parse_args()
    records = []
    for view in arguments.scenes:
        name, (scene, camera) = pathlib.Path(view).name, workloads.view(view, arguments.size)
        frame = cut(scene, camera)
        errors = true_errors(frame)
        for tolerance in arguments.tolerance:
            for mix, families in MIXES.items():
                found = best(frame, errors, families, tolerance)
                print(
                    f"{name:14s} {tolerance:6g} {mix:12s} saved {found['saved']:6.2f}  max error {found['max_error']:.5f}",
                    flush=True,
                )
                records.append({"scene": name, "tolerance": tolerance, "candidates": mix, **found})
    keep(arguments.output, MIXES, size=arguments.size, records=records)


if __name__ == "__main__":
    main()
