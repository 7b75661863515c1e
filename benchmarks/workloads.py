"""What the contenders render: a filled cube of jittered particles, a dam break that is mostly empty space, scenes and files."""

from __future__ import annotations

import dataclasses
import pathlib

import jax.numpy as jnp
import numpy as np

import jaxsph as js

CUBE = 46  # particles along an edge of the smaller filled cube


@dataclasses.dataclass(frozen=True)
class Workload:
    """Equal supports, a camera that looks along +z, and a transfer table of 256 even entries over [0, 1]."""

    name: str
    position: np.ndarray
    support: float
    quantity: np.ndarray
    table: np.ndarray
    eye: tuple[float, float, float]
    half: float
    near: float
    far: float
    size: int = 512
    samples: int = 256

    def scene(self, kernel: str) -> js.Scene:
        particles = js.Particles.from_arrays(self.position, self.support, self.quantity, kernel=kernel)
        values = np.linspace(0, 1, len(self.table))
        transfer = js.TransferFunction.from_points(values, self.table[:, :3], self.table[:, 3])
        return js.Scene(particles=particles, transfer=transfer)

    def camera(self) -> js.Camera:
        """The contract's `right = forward x up` makes x point left when looking along +z, so up is turned over."""
        fov = float(np.degrees(2 * np.arctan(self.half)))
        target = (self.eye[0], self.eye[1], self.eye[2] + 1)
        size = {"width": self.size, "height": self.size, "near": self.near, "far": self.far}
        return js.Camera.look_at(self.eye, target, (0, -1, 0), fov, **size)


def _table(scale: float = 1.0) -> np.ndarray:
    q = np.linspace(0, 1, 256)
    red, green = np.interp(q, [0, 0.3, 0.6, 1], [0, 0.2, 1, 1]), np.interp(q, [0, 0.3, 0.6, 1], [0, 0.5, 0.6, 1])
    blue = np.interp(q, [0, 0.3, 0.6, 1], [0.5, 1, 0.1, 0.9])
    extinction = np.interp(q, [0, 0.2, 0.5, 0.8, 1], [0, 0.5, 4, 1, 8]) * scale
    return np.stack([red, green, blue, extinction], 1).astype(np.float32)


def cube(side: int, **size: int) -> Workload:
    """`side`^3 jittered particles in the unit cube, support 2 / side; every sample lies inside."""
    rng = np.random.default_rng(1)
    grid = (np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3) + 0.5) / side
    position = grid + rng.uniform(-0.4, 0.4, grid.shape) / side
    rng.shuffle(position)
    x, y, z = position.T
    quantity = 0.5 + 0.5 * np.sin(6 * x) * np.cos(5 * y) * np.sin(4 * z + 1)
    columns = position.astype(np.float32), quantity.astype(np.float32)
    return Workload(f"cube {side**3}", columns[0], 2 / side, columns[1], _table(), (0.5, 0.5, -1.5), 0.2, 1.5, 2.5, **size)


def dam_break(**size: int) -> Workload:
    """The packaged dam break: 60 k particles, most of the frustum is empty."""
    scene, _ = js.scenes.load("dam_break", frame=1)
    particles = scene.particles
    columns = particles.to_numpy()
    position, support = columns["position"], float(columns["support"][0])
    lower, upper = particles.bounds()
    middle, extent = (lower + upper) / 2, float((upper - lower).max())
    depth = float(upper[2] - lower[2])
    eye = (float(middle[0]), float(middle[1]), float(lower[2] - 1.5 * extent))
    near, far = 1.5 * extent, 1.5 * extent + depth
    half = 0.52 * extent / near
    quantity = columns["quantity"]
    return Workload("dam break", position, support, quantity, _table(4 / extent), eye, half, near, far, **size)


def blocks(particles: int, size: int) -> tuple[js.Scene, js.Camera]:
    """The checker board's view of a unit cube whose eight blocks hold four constants: mixed nowhere but at their faces."""
    scene, camera = js.scenes.load("checker_board", particles, 0, width=size, height=size)
    octant = (np.asarray(scene.particles.position) > 0.5) @ np.array([1, 2, 3])
    quantity = np.array([0.1, 0.4, 0.7, 1.0], np.float32)[octant % 4]
    held = dataclasses.replace(scene.particles, quantity=jnp.asarray(quantity))
    return dataclasses.replace(scene, particles=held), camera


def view(name: str, size: int) -> tuple[js.Scene, js.Camera]:
    """A built-in scene, maybe of a frame (`mixer:2`), the filled `cube`, or the particles of a file, framed."""
    if name == "cube":
        work = cube(CUBE, size=size)
        return work.scene("poly6"), work.camera()
    if pathlib.Path(name).is_file():
        particles = js.io.read_particles(name)
        transfer = js.scenes.default_transfer(particles)
        return js.Scene(particles=particles, transfer=transfer), js.Camera.framing(particles, width=size, height=size)
    scene, _, frame = name.partition(":")
    return js.scenes.load(scene, frame=int(frame) if frame else None, width=size, height=size)
