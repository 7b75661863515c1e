"""Scenes that no other benchmark reports, made here from random numbers: some to calibrate with, others to validate by.

The two groups differ in kind: in how particles lie and vary, in supports and kernels, in transfer functions and views.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import ndtr

import jaxsph as js

SUPPORT_IN_SPACINGS = 2.0
MODES = 48  # of a random field: enough to look like noise of one correlation length
NEIGHBOURS = 33  # within a support, by which it adapts to how dense particles are
RATIO = 8.0  # of the largest support to the smallest, where they vary
PIXELS = 4  # between the finest nodes


class Fluid(NamedTuple):
    """Particles, as arrays."""

    position: np.ndarray
    support: np.ndarray
    quantity: np.ndarray


@dataclasses.dataclass(frozen=True)
class Look:
    """One frame of a kind: which random numbers, which transfer function, how opaque, from where."""

    seed: int
    transfer: str
    optical_depth: float
    direction: tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Kind:
    """Frames that differ in seed, transfer function and view only, such that they share compiled programs."""

    name: str
    make: Callable[[np.random.Generator, int], Fluid]
    kernel: str
    orthographic: bool
    looks: tuple[Look, ...]

    def frames(self, size: int) -> Iterator[tuple[Look, js.Scene, js.Camera]]:
        """Scenes and cameras of all looks."""
        for look in self.looks:
            fluid = self.make(np.random.default_rng(look.seed), size)
            columns = (column.astype(np.float32) for column in (*fluid, (fluid.support / SUPPORT_IN_SPACINGS) ** 3))
            particles = js.Particles.from_arrays(*columns, kernel=self.kernel)
            extent = float(np.median(np.ptp(fluid.position, 0)))
            transfer = transfer_function(look.transfer, look.optical_depth / extent)
            view = parallel if self.orthographic else js.Camera.framing
            yield (
                look,
                js.Scene(particles=particles, transfer=transfer),
                view(particles, direction=look.direction, width=size, height=size),
            )


def parallel(particles: js.Particles, *, direction: tuple[float, float, float], width: int, height: int) -> js.Camera:
    """An orthographic camera that sees all particles, with near and far snug."""
    columns = particles.to_numpy()
    position, support = columns["position"].astype(float), columns["support"].astype(float)
    forward = np.asarray(direction) / np.linalg.norm(direction)
    right = np.cross(forward, (0, 1, 0)) / np.linalg.norm(np.cross(forward, (0, 1, 0)))
    local = position @ np.stack([right, np.cross(right, forward), forward]).T
    low, high = (local - support[:, None]).min(0), (local + support[:, None]).max(0)
    eye = np.append((low + high)[:2] / 2, 0) @ np.stack([right, np.cross(right, forward), forward])
    side = 1.02 * (high - low)[:2].max()
    return js.Camera.orthographic(eye, eye + forward, (0, 1, 0), side, width, height, near=low[2], far=high[2])


def transfer_function(style: str, extinction: float) -> js.TransferFunction:
    """Eight control points over [0, 1]; `extinction` is the mean over all quantities."""
    values, opacity = np.asarray(STYLES[style], float)
    shade = 0.5 + 0.5 * np.cos(2 * np.pi * (values[:, None] * (1, 1.7, 2.9) + (0, 0.3, 0.6)))
    if style == "tint":
        shade = np.arange(len(values))[:, None] % 2 * np.array([1, 0.8, 0.4])
    mean = np.trapezoid(opacity, values)
    return js.TransferFunction.from_points(*(a.astype(np.float32) for a in (values, shade, extinction / mean * opacity)))


STYLES = {
    # to calibrate with
    "smooth": (np.linspace(0, 1, 8), np.linspace(0.1, 1, 8) ** 2),
    "steep": ([0, 0.3, 0.46, 0.49, 0.51, 0.54, 0.7, 1], [0.02, 0.02, 0.05, 0.3, 0.7, 0.95, 1, 1]),
    "bands": ([0, 0.27, 0.3, 0.33, 0.67, 0.7, 0.73, 1], [0.02, 0.02, 1, 0.02, 0.02, 1, 0.02, 0.02]),
    # to validate by
    "saw": (np.linspace(0, 1, 8), [0.05, 1] * 4),
    "cliff": ([0, 0.2, 0.4, 0.6, 0.61, 0.8, 0.9, 1], [0, 0, 0, 0, 1, 1, 0.6, 0.2]),
    "tint": (np.linspace(0, 1, 8), [1] * 8),
}


def noise(rng: np.random.Generator, position: np.ndarray, length: float) -> np.ndarray:
    """A random field of Gaussian correlation over `length`, evenly distributed over [0, 1]."""
    waves = rng.normal(size=(3, MODES)) / length
    phase = rng.uniform(0, 2 * np.pi, MODES)
    return ndtr(np.sqrt(2 / MODES) * np.cos(position @ waves + phase).sum(1))


def lattice(rng: np.random.Generator, shape: tuple[int, int, int], jitter: float) -> np.ndarray:
    """Points at unit distance, each moved by up to `jitter` along every axis."""
    place = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1).reshape(-1, 3)
    return place + rng.uniform(-jitter, jitter, place.shape)


def adapted(position: np.ndarray) -> np.ndarray:
    """Supports that hold about `NEIGHBOURS` particles each, over no more than `RATIO`."""
    reach = cKDTree(position).query(position, k=[NEIGHBOURS])[0][:, 0]
    middle = np.median(reach)
    return np.clip(reach, middle / np.sqrt(RATIO), middle * np.sqrt(RATIO))


def waves(rng: np.random.Generator, size: int, lengths: float = 3.0) -> Fluid:
    """A field that is correlated over some spacings, on jittered particles."""
    position = lattice(rng, (24, 24, 24), 0.4)
    return Fluid(position, np.full(len(position), SUPPORT_IN_SPACINGS), noise(rng, position, lengths))


def clusters(rng: np.random.Generator, size: int) -> Fluid:
    """Clumps of all sizes, with supports that adapt and a field of two scales."""
    centre, width = rng.uniform(0, 1, (40, 3)), rng.uniform(0.03, 0.2, (40, 1))
    which = rng.integers(0, 40, 15_000)
    position = centre[which] + width[which] * rng.normal(size=(15_000, 3))
    return Fluid(position, adapted(position), 0.6 * noise(rng, position, 0.3) + 0.4 * noise(rng, position, 0.06))


def sheet(rng: np.random.Generator, size: int) -> Fluid:
    """A sheet whose density falls off upwards, as do its layers of the quantity, a little wrinkled."""
    position = rng.uniform(0, 1, (15_000, 3)) * (1, 0.4, 1)
    position[:, 1] = 0.4 * (position[:, 1] / 0.4) ** 2.5
    wrinkled = position[:, 1] + 0.02 * noise(rng, position * (1, 0, 1), 0.1)
    return Fluid(position, adapted(position), 0.5 + 0.5 * np.sin(50 * wrinkled))


def scattered(rng: np.random.Generator, size: int) -> Fluid:
    """Particles anywhere, each of a quantity of its own."""
    position = rng.uniform(0, 1, (8_000, 3))
    return Fluid(position, np.full(8_000, SUPPORT_IN_SPACINGS * 8_000 ** (-1 / 3)), rng.uniform(0, 1, 8_000))


def plate(rng: np.random.Generator, size: int, *, layers: int = 10, reach: float = 1.55, correlated: float = 0.0) -> Fluid:
    """A plate that fills the image, with noise; its supports reach so many of the finest nodes' spacings."""
    across = int(size * SUPPORT_IN_SPACINGS / (1.02 * PIXELS * reach)) - 3
    position = lattice(rng, (across, across, layers), 0.3)
    quantity = noise(rng, position, correlated) if correlated else rng.uniform(0, 1, len(position))
    return Fluid(position, np.full(len(position), SUPPORT_IN_SPACINGS), quantity)


def shell(rng: np.random.Generator, size: int) -> Fluid:
    """A hollow ball whose skin is of uneven thickness, and noisy."""
    place = rng.normal(size=(20_000, 3))
    place /= np.linalg.norm(place, axis=1, keepdims=True)
    thick = 0.05 + 0.3 * noise(rng, place, 0.5)
    position = place * (1 - thick * rng.uniform(0, 1, 20_000))[:, None]
    return Fluid(position, adapted(position), 0.7 * noise(rng, position, 0.25) + 0.3 * rng.uniform(0, 1, 20_000))


def foam(rng: np.random.Generator, size: int) -> Fluid:
    """What is left of a block between bubbles: free surfaces everywhere."""
    position = lattice(rng, (40, 40, 40), 0.25)
    centre, radius = rng.uniform(0, 40, (60, 3)), rng.uniform(3, 9, 60)
    outside = (np.linalg.norm(position[:, None] - centre, axis=-1) > radius).all(1)
    position = position[outside]
    return Fluid(position, np.full(len(position), SUPPORT_IN_SPACINGS), noise(rng, position, 5.0))


def strands(rng: np.random.Generator, size: int) -> Fluid:
    """Winding strands that grow eight times as thick and as coarse along their way."""
    along = rng.uniform(0, 1, 10_000) ** 0.5
    strand, coarse = rng.integers(0, 7, 10_000), RATIO ** (1 - along) / RATIO
    angle = 9 * along + strand * (2 * np.pi / 7)
    axis = np.stack([0.35 * np.cos(angle), 1.6 * along, 0.35 * np.sin(angle)], 1)
    position = axis + 0.16 * coarse[:, None] * rng.normal(size=(10_000, 3))
    return Fluid(position, adapted(position), (0.5 + 0.5 * np.sin(40 * along + strand)) * noise(rng, position, 0.05))


def grains(rng: np.random.Generator, size: int) -> Fluid:
    """Fine grains, one in eight of the volume in clumps, amid coarse particles: supports of two sizes, 8:1 apart."""
    coarse = lattice(rng, (16, 16, 16), 0.35)
    centre = rng.uniform(2, 14, (30, 3))
    fine = (centre[:, None] + 0.35 * rng.normal(size=(30, 1500, 3))).reshape(-1, 3)
    position = np.concatenate([coarse, fine])
    support = np.repeat([SUPPORT_IN_SPACINGS, SUPPORT_IN_SPACINGS / RATIO], [len(coarse), len(fine)])
    return Fluid(position, support, np.where(support < 1, 0.9, 0.1) + 0.2 * noise(rng, position, 2.0) - 0.1)


def _looks(styles: tuple[str, ...], depths: tuple[float, ...], seed: int, front: bool = False) -> tuple[Look, ...]:
    """One for each transfer function, each with its seed and view."""
    around = ((-0.4, -0.3, -1.0), (0.9, -0.5, -0.4), (0.1, 0.6, 1.0))
    ahead = ((0.0, 0.0, 1.0),) * 3
    each = zip(styles, depths, ahead if front else around, strict=True)
    return tuple(Look(seed + nth, *look) for nth, look in enumerate(each))


_mild, _hard = functools.partial(_looks, ("smooth", "steep", "bands")), functools.partial(_looks, ("saw", "cliff", "tint"))
CALIBRATION = (
    Kind("waves", waves, "poly6", False, _mild((1.5, 4.0, 12.0), 100)),
    Kind("clusters", clusters, "cubic_spline", True, _mild((12.0, 1.5, 4.0), 110)),
    Kind("sheet", sheet, "poly6", False, _mild((4.0, 12.0, 1.5), 120)),
    Kind("scattered", scattered, "wendland_c2", False, _mild((4.0, 4.0, 1.0), 130)),
    Kind("plate", plate, "poly6", True, _mild((1.5, 12.0, 4.0), 140, front=True)),
)
VALIDATION = (
    Kind("shell", shell, "wendland_c2", True, _hard((3.0, 8.0, 1.0), 200)),
    Kind("foam", foam, "poly6", False, _hard((8.0, 1.0, 3.0), 210)),
    Kind("strands", strands, "poly6", False, _hard((1.0, 3.0, 8.0), 220)),
    Kind("grains", grains, "cubic_spline", True, _hard((3.0, 1.0, 8.0), 230)),
    Kind(
        "woven",
        functools.partial(plate, layers=14, reach=1.9, correlated=1.0),
        "cubic_spline",
        False,
        _hard((8.0, 3.0, 1.0), 240, front=True),
    ),
)
GROUPS = {"calibration": CALIBRATION, "validation": VALIDATION}
