"""Host-side capacities: how much room a frame needs, rounded up so that similar frames share a compiled program.

Flow: scene, camera, settings -> [plan] -> render.

Counting is cheap (no sort): every particle's range of tiles and bundles is exact, so that the capacities made from it are
never too small for the frame they were made for. A frame that outgrows a reused plan raises a fault.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxsph.access.footprint import pixel_ranges
from jaxsph.access.lattice import FINEST, Spacing
from jaxsph.access.lists import BUNDLE, TILE, ListPlan
from jaxsph.access.ordering import order_particles
from jaxsph.cast.stretches import CastPlan
from jaxsph.control.adapt import ControlPlan
from jaxsph.control.pilot import PilotPlan
from jaxsph.model.camera import Camera
from jaxsph.model.particles import Particles
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics.checks import is_traced

STEPS_AN_OCTAVE = 4  # capacities are rounded up to 1, 5/4, 6/4, 7/4 times a power of two
MOST_CLASSES = 16  # classes of support, a factor of two each; the last holds all that is smaller still
LARGEST_CAPACITY = 1 << 30
MOST_SLABS = 1 << 27  # of a band: what sort keys have room for
SLAB_SAMPLES = (4, 8, 16)
SAMPLES_AT_ONCE = 1024  # along depth, times 64 rays: accumulators and operands of a chunk stay in the second-level cache
SAMPLES_HELD = 1 << 15  # of light, along depth, times 64 rays: it stays in the third-level cache
ARRAYS_OF_NODES = 12  # as large as the lattice, that live at once
NODE_PIXELS, NODE_SAMPLES = (FINEST.pixels, 8), (FINEST.samples, 4, 8)  # what nodes can be apart, in pixels and fine samples
NODES_REACHED = 2.5, 3  # by a support to every side, across and in depth: with fewer, wider nodes save less than they cost less
FINE_DIAMETER = 12  # pixels: supports that are smaller cannot cover a quarter of a footprint


@dataclasses.dataclass(frozen=True)
class Plan:
    """Everything that fixes a shape: hashable, and shared by similar frames.

    Attributes:
        width, height: of the image, pixels.
        samples: fine samples a ray.
        num_particles: entries of the particle arrays, padding included.
        num_classes: classes of support.
        bands: horizontal bands that are rendered one after the other.
        lists: sizes of the lists of one band.
        cast: sizes of the march.
        bytes: estimate of the working memory, in bytes; of no matter to what is compiled, so plans are equal whatever it is.
        control: static choices of error control; None renders at full rate.
    """

    width: int
    height: int
    samples: int
    num_particles: int
    num_classes: int
    bands: int
    lists: ListPlan
    cast: CastPlan
    bytes: int = dataclasses.field(compare=False)
    control: ControlPlan | PilotPlan | None = None

    @property
    def band_height(self) -> int:
        """Pixel rows of a band."""
        return self.lists.tile_rows * TILE

    def check(self, scene: Scene, camera: Camera, settings: Settings) -> None:
        """Raise `ValueError` where the plan is for other shapes than those given."""
        given = {
            "camera.width": (camera.width, self.width),
            "camera.height": (camera.height, self.height),
            "settings.samples": (settings.samples, self.samples),
            "scene.particles.capacity": (scene.particles.capacity, self.num_particles),
        }
        for name, (have, planned) in given.items():
            if have != planned:
                raise ValueError(f"`plan` was made for {name} = {planned}, got {have}; make a new one with `jaxsph.plan`")
        parts = self.control.parts if isinstance(self.control, ControlPlan) else 1
        pilot = self.control if isinstance(self.control, PilotPlan) else PilotPlan()
        wanted = control_plan(settings, parts, pilot)
        if wanted != self.control:
            raise ValueError(
                f"`plan` was made for error control {self.control}, but settings ask for {wanted}; make a new one with "
                "`jaxsph.plan`"
            )


def control_plan(settings: Settings, parts: int, pilot: PilotPlan) -> ControlPlan | PilotPlan | None:
    """What of `settings` and of the frame's measures is fixed when a program is compiled; None without a tolerance."""
    if settings.tolerance is None:
        return None
    if settings.estimator == "pilot":
        return pilot
    return ControlPlan(settings.super_pixels, settings.merge, settings.allocation, parts)


def _choose_parts(diameter: float) -> int:
    """A sub-rectangle is covered only by a support a few times as wide as itself."""
    return 2 if diameter >= FINE_DIAMETER else 4


def _choose_nodes(depth_extent: float, diameter: float, slab_samples: int) -> Spacing:
    """As far apart as supports of the median size, in samples and in pixels, reach enough of them."""
    pixels = max((n for n in NODE_PIXELS if diameter >= 2 * NODES_REACHED[0] * n), default=FINEST.pixels)
    samples = max((n for n in NODE_SAMPLES if depth_extent >= 2 * NODES_REACHED[1] * n), default=FINEST.samples)
    return Spacing(pixels, min(samples, slab_samples))


def plan(scene: Scene, camera: Camera, settings: Settings | None = None, *, slab_samples: int | None = None) -> Plan:
    """Measure the room that a frame needs (host side; values must be concrete).

    Args:
        scene, camera, settings: as for `jaxsph.render`.
        slab_samples: samples of a cell that share a window of particles, 4, 8 or 16; by default chosen from how deep a
            support is in samples.

    Raises:
        ValueError: under a trace, or when even a band of one row of tiles exceeds `settings.memory_limit`.
    """
    settings = settings or Settings()
    if is_traced(scene, camera):
        raise ValueError("`plan` needs concrete arrays to count; call it outside jit and pass `plan=` to `render`")
    particles = scene.particles
    tile_rows, columns = _ceil(camera.height, TILE), _ceil(camera.width, TILE)
    counts = (np.asarray(count) for count in _count(particles, camera, settings.samples, tile_rows))
    tiles, bundles, depth_extent, diameter, extent = counts
    num_classes = _num_classes(particles)
    slab_samples = slab_samples or _choose_slab_samples(float(depth_extent))
    nodes = _choose_nodes(float(depth_extent), float(diameter), slab_samples)
    parts, bands = _choose_parts(float(diameter)), 1
    while True:
        rows = _ceil(tile_rows, bands)
        cast = _cast_plan(4 * rows * columns, settings.samples, slab_samples)
        room = min(round_up(int(extent[0])), 2 * rows), min(round_up(int(extent[1])), 2 * columns)
        control = control_plan(settings, parts, PilotPlan(nodes, room))
        made = _for_bands(camera, settings, particles, (rows, columns), (tiles, bundles), num_classes, cast, control)
        slabs = made.lists.num_bundles * _ceil(settings.samples, slab_samples)
        fits = made.bytes <= settings.memory_limit and made.lists.list_capacity <= LARGEST_CAPACITY and slabs < MOST_SLABS
        if fits or rows == 1:
            break
        bands = min(2 * bands, tile_rows)
    if not fits:
        raise ValueError(
            f"`memory_limit` = {settings.memory_limit} bytes is too little: one band of {TILE} pixel rows needs "
            f"about {made.bytes} bytes; raise the limit, or lower the image width, the samples or the number of particles"
        )
    return made


def _for_bands(
    camera: Camera,
    settings: Settings,
    particles: Particles,
    tiles_a_band: tuple[int, int],
    pairs_a_row: tuple[np.ndarray, np.ndarray],
    num_classes: int,
    cast: CastPlan,
    control: ControlPlan | PilotPlan | None,
) -> Plan:
    rows = tiles_a_band[0]
    bands = _ceil(len(pairs_a_row[0]), rows)
    fullest = [int(_by_band(counts, rows, bands).max(initial=0)) for counts in pairs_a_row]
    lists = ListPlan(*tiles_a_band, *(round_up(max(count, 1)) for count in fullest))
    slabs = _ceil(settings.samples, cast.slab_samples)
    number = np.dtype(particles.dtype).itemsize
    memory = (
        particles.capacity * (24 * number + 32)
        + lists.tile_capacity * (12 * number + 48)
        + lists.list_capacity * 8
        + num_classes * slabs * lists.num_bundles * 40
        + lists.num_bundles * BUNDLE * BUNDLE * 5 * number * 2
        + (16 * cast.chunk + 3 * cast.held) * cast.slab_samples * BUNDLE * BUNDLE * number
        + slabs * lists.num_bundles * 8
        + camera.width * camera.height * 8 * number
        + _bytes_of_control(control, lists, slabs, cast.slab_samples, num_classes, number)
    )
    size = (camera.width, camera.height, settings.samples, particles.capacity)
    return Plan(*size, num_classes, bands, lists, cast, int(memory), control)


def _bytes_of_control(
    control: ControlPlan | PilotPlan | None, lists: ListPlan, slabs: int, slab_samples: int, num_classes: int, number: int
) -> int:
    """Of the tables of all candidates of all cells, and of the windows of coarser slabs; or of lattices of nodes."""
    if control is None:
        return 0
    if isinstance(control, PilotPlan):
        of_nodes = math.prod(control.room or lists.bundles) * control.nodes.across**2
        return slabs * _ceil(slab_samples, control.nodes.samples) * of_nodes * ARRAYS_OF_NODES * number
    return slabs * lists.num_bundles * (64 * number // 4 + num_classes * 32)


def _by_band(counts: np.ndarray, rows: int, bands: int) -> np.ndarray:
    return np.pad(counts, (0, rows * bands - len(counts))).reshape(bands, rows).sum(1)


def round_up(count: int) -> int:
    """The next of 4, 5, 6, 7 times a power of two."""
    step = max(1 << max((count - 1).bit_length() - 1, 0), 4) // STEPS_AN_OCTAVE
    return _ceil(count, step) * step


def _ceil(a: int, b: int) -> int:
    return -(-a // b)


def _num_classes(particles: Particles) -> int:
    support = np.asarray(particles.support)[np.asarray(particles.valid)]
    support = support[np.isfinite(support) & (support > 0)]
    if support.size == 0:
        return 1
    octaves = math.log2(float(support.max()) / float(support.min()))
    return min(1 + math.ceil(max(octaves - 0.01, 0)), MOST_CLASSES)


def _choose_slab_samples(depth_extent: float) -> int:
    """Deeper slabs for deeper supports: a window is the slab's depth plus a support's diameter."""
    for slab_samples in SLAB_SAMPLES:
        if depth_extent <= 6 * slab_samples:
            return slab_samples
    return SLAB_SAMPLES[-1]


def _cast_plan(bundles: int, samples: int, slab_samples: int) -> CastPlan:
    """As many slabs as the caches hold, but not many more than a small image has."""
    most = bundles * _ceil(samples, slab_samples)
    chunk = 1 << (min(SAMPLES_AT_ONCE // slab_samples, most) - 1).bit_length()
    return CastPlan(chunk, slab_samples, min(SAMPLES_HELD // slab_samples, _ceil(most, chunk) * chunk))


@functools.partial(jax.jit, static_argnames=("samples", "tile_rows"))
def _count(particles: Particles, camera: Camera, samples: int, tile_rows: int) -> tuple[Array, ...]:
    """What a plan is made from.

    Pairs in each row of tiles (with tiles, and at most with bundles); the median diameter of a support in samples, and in
    pixels; rows and columns of bundles from the first to the last that any particle is seen in.
    """
    depths = camera.depth(jnp.arange(samples, dtype=camera.dtype) + 0.5, samples).astype(particles.dtype)
    ordered = order_particles(particles, camera, depths, samples, 1)
    left, right, top, bottom = pixel_ranges(ordered, camera, depths[0], depths[-1])
    seen = (right >= left) & (bottom >= top)
    tiles = jnp.zeros(tile_rows + 1, jnp.float32)
    bundles = jnp.zeros(2 * tile_rows + 1, jnp.float32)
    for size, counts in ((TILE, "tiles"), (BUNDLE, "bundles")):
        columns = jnp.where(seen, right // size - left // size + 1, 0).astype(jnp.float32)
        first, past = jnp.where(seen, top // size, 0), jnp.where(seen, bottom // size + 1, 0)
        target = tiles if counts == "tiles" else bundles
        target = jnp.cumsum(target.at[first].add(columns).at[past].add(-columns))
        tiles, bundles = (target, bundles) if counts == "tiles" else (tiles, target)
    index = jnp.arange(samples, dtype=depths.dtype)
    extent = jnp.interp(ordered.z + ordered.reach, depths, index) - jnp.interp(ordered.z - ordered.reach, depths, index)
    median = jnp.nanmedian(jnp.where(seen, extent, jnp.nan))
    wide = jnp.nanmedian(jnp.where(seen, right - left + 1, jnp.nan))
    sides = (top // BUNDLE, bottom // BUNDLE, 2 * tile_rows), (left // BUNDLE, right // BUNDLE, camera.width)
    reach = [jnp.where(seen, last, -1).max() - jnp.where(seen, first, most).min() + 1 for first, last, most in sides]
    return tiles[:-1], bundles[:-1].reshape(-1, 2).sum(1), median, wide, jnp.maximum(jnp.stack(reach), 1)
