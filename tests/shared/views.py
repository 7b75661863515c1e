"""A small scene to look around in, and its view."""

import jax
import numpy as np

import jaxsph as js

WIDTH, HEIGHT = 48, 32
SETTINGS = js.Settings(samples=16)


def scene(seed=0):
    """Particles in a ball, and a look of four points."""
    rng = np.random.default_rng(seed)
    position = rng.normal(0, 0.35, (80, 3)).clip(-1, 1).astype(np.float32)
    particles = js.Particles.from_arrays(position, np.float32(0.4), position[:, 0])
    colors = [(0.1, 0.2, 0.9), (0.1, 0.8, 0.3), (0.9, 0.9, 0.2), (0.9, 0.3, 0.1)]
    transfer = js.TransferFunction.from_points(np.float32([-0.6, -0.2, 0.2, 0.6]), colors, np.float32([1, 4, 6, 8]))
    return js.Scene(particles=particles, transfer=transfer)


def camera(width=WIDTH, height=HEIGHT):
    return js.Camera.look_at((0.3, 0.5, 4.0), (0, 0, 0), width=width, height=height, fov_degrees=35.0, near=2.0, far=6.0)


def compiles():
    """A list that grows with everything that is compiled from now on."""
    compiled, event = [], "/jax/core/compile/backend_compile_duration"
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, *_, **more: compiled.append(more) if name == event else None
    )
    return compiled
