"""Who holds which particle, where samples are shared among devices by depth (host side).

Flow: scene, camera -> [depth_dealing: ranges of cells -> particles of each -> plan] -> depth_slabs.

All is found by NumPy in float64, from positions and supports alone: no device sees more than its own particles.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as Spec
from jaxtyping import Array, Int

from jaxsph.access.resolution import ROUNDING
from jaxsph.access.slab_windows import CELL_SAMPLES
from jaxsph.along_rays import first_samples
from jaxsph.model.camera import Camera
from jaxsph.model.particles import Particles, capacity_class
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.plan import Plan
from jaxsph.planning import plan as make_plan

HALO_ROUNDING = 4  # times what rounding widens a support by in view, that it is widened by here


@dataclasses.dataclass(frozen=True)
class Parts:
    """What each device holds, side by side along the first axis.

    Attributes:
        index: of each entry, its place among all particles.
        valid: which entries are particles.
        first, last: devices that hold the particle of an entry, by number: the first and the last.
        cells: first cell of 16 samples that a device marches, and the one past its last.
    """

    index: Int[Array, "devices particles"]
    valid: Any
    first: Int[Array, "devices particles"]
    last: Int[Array, "devices particles"]
    cells: Int[Array, "devices 2"]

    def of(self, particles: Particles) -> Particles:
        """The particles of each device, given all."""
        chosen = particles.at(self.index)
        return dataclasses.replace(chosen, valid=chosen.valid & self.valid)


def dealt_particles(scene: Scene, camera: Camera, settings: Settings, mesh: Mesh, margin: float) -> tuple[Particles, Parts, Plan]:
    """Particles where they belong, who they are, and a plan with room for each device's."""
    assert scene.particles is not None
    columns = _in_host_memory(scene.particles)
    reached = cells_reached(columns, camera, first_samples(settings), margin)
    cuts = shared_out(_particles_of_cells(*reached, -(-first_samples(settings) // CELL_SAMPLES)), mesh.size)
    first, last = (np.searchsorted(cuts[1:-1], cells, side="right") for cells in reached)
    live = np.asarray(columns.valid) & (reached[1] >= reached[0])
    chosen = [np.flatnonzero(live & (first <= nth) & (nth <= last)) for nth in range(mesh.size)]
    capacity = capacity_class(max(max(map(len, chosen)), 1))
    index = np.stack([np.pad(one, (0, capacity - len(one)), mode="edge" if len(one) else "constant") for one in chosen])
    valid = np.arange(capacity) < np.array([len(one) for one in chosen])[:, None]
    numbers = (value.astype(np.int32) for value in (index, first[index], last[index], np.stack([cuts[:-1], cuts[1:]], 1)))
    parts = _parts(valid, *numbers)
    plan = _plan(scene, columns, parts, camera, settings)
    each = NamedSharding(mesh, Spec(mesh.axis_names))
    return _on_devices(parts.of(columns), each), _on_devices(parts, each), plan


def _parts(valid: Any, index: Any, first: Any, last: Any, cells: Any) -> Parts:
    return Parts(index, valid, first, last, cells)


def cells_reached(particles: Particles, camera: Camera, samples: int, margin: float) -> tuple[np.ndarray, np.ndarray]:
    """First and last cell that a support reaches into, borders included; in wrong order where it reaches none.

    Supports are wider by `margin`, and by more than rounding widens them in view.
    """
    offset = np.asarray(particles.exact_position() - camera.exact_eye())
    depth = offset @ np.asarray(camera.axes, np.float64)[2]
    eps = HALO_ROUNDING * ROUNDING * float(np.finfo(particles.dtype).eps)
    reach = np.asarray(particles.support, np.float64) * (1 + eps) + eps * np.abs(offset).max(1, initial=0) + margin
    number = np.minimum(np.arange(0, samples + CELL_SAMPLES, CELL_SAMPLES), samples) / samples
    near, far = float(camera.near), float(camera.far)
    borders = near * (far / near) ** number if camera.is_perspective else near + (far - near) * number
    first = np.searchsorted(borders[1:], (depth - reach) * (1 - np.sign(depth - reach) * eps), side="left")
    last = np.searchsorted(borders[:-1], (depth + reach) * (1 + np.sign(depth + reach) * eps), side="right") - 1
    return first, last


def shared_out(weight: np.ndarray, parts: int) -> np.ndarray:
    """Where to cut a row of cells into so many ranges, none of them empty, such that the heaviest is as light as can be.

    Returns:
        First cell of each range, and the number of cells; ascending.
    """
    total, cells = np.concatenate([[0], np.cumsum(weight)]), len(weight)
    best = np.full((parts + 1, cells + 1), np.inf)
    best[0, 0], cut = -np.inf, np.zeros((parts + 1, cells + 1), int)
    for part in range(1, parts + 1):
        for end in range(part, cells + 1):
            heaviest = np.maximum(best[part - 1, part - 1 : end], total[end] - total[part - 1 : end])
            cut[part, end] = part - 1 + int(heaviest.argmin())
            best[part, end] = heaviest.min()
    ends = [cells]
    for part in range(parts, 0, -1):
        ends.append(int(cut[part, ends[-1]]))
    return np.array(ends[::-1])


def _particles_of_cells(first: np.ndarray, last: np.ndarray, cells: int) -> np.ndarray:
    """How many particles reach into each cell."""
    met = (last >= first) & (last >= 0) & (first < cells)
    begun = np.bincount(first[met], minlength=cells + 1) - np.bincount(last[met] + 1, minlength=cells + 1)
    return np.cumsum(begun)[:cells]


def _in_host_memory(particles: Particles) -> Particles:
    return jax.tree.map(np.asarray, particles)


def _plan(scene: Scene, particles: Particles, parts: Parts, camera: Camera, settings: Settings) -> Plan:
    """With room for the particles of any device, measured one after the other."""
    made: Plan | None = None
    for nth in range(len(parts.index)):
        one = jax.tree.map(lambda leaf: leaf[nth], parts)  # noqa: B023
        held = jax.tree.map(jnp.asarray, one.of(particles))
        made = make_plan(dataclasses.replace(scene, particles=held), camera, settings, like=made)
    assert made is not None
    return made


def _on_devices(tree: Any, place: NamedSharding) -> Any:
    """Arrays of the host, each device with its own part."""

    def put(leaf: np.ndarray) -> Array:
        return jax.make_array_from_callback(leaf.shape, place, lambda where: leaf[where])

    return jax.tree.map(put, tree)


jax.tree_util.register_dataclass(Parts, data_fields=[field.name for field in dataclasses.fields(Parts)], meta_fields=[])
