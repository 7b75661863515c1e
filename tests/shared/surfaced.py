"""The surface of particles in float64 NumPy, from nothing but its definition: dense samples, then bisection."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from images import seen_from

import jaxsph as js
from jaxsph.model.particles import kernels

SPACING = 0.1
SAMPLES, HALVINGS = 1200, 40


class Crossing(NamedTuple):
    """Where the rays of all pixels first cross.

    Depth (inf for none); how far the field is from the level, as a share of it: at least in front of the crossing, and at most
    behind it, such that little is grazed; unit normal out of the fluid, its cosine to the ray, and the interpolated quantity.
    """

    depth: np.ndarray
    clearance: np.ndarray
    normal: np.ndarray
    facing: np.ndarray
    quantity: np.ndarray


def ball(kernel="cubic_spline", dtype=np.float32, spread=0.2, seed=3):
    """Jittered particles in a ball, with supports that vary."""
    rng = np.random.default_rng(seed)
    steps = (np.arange(9) - 4) * SPACING
    position = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 3)
    position = position[np.linalg.norm(position, axis=1) < 0.4]
    position = position + rng.uniform(-0.01, 0.01, position.shape)
    support = 0.2 * rng.uniform(1 - spread, 1 + spread, len(position))
    columns = (one.astype(dtype) for one in (position, support, position[:, 0], np.full(len(position), SPACING**3)))
    return js.Particles.from_arrays(*columns, kernel)


def view_of_ball(projection="perspective", width=16, height=14, eye=(0.35, 0.45, -2.1), near=1.2, dtype=None):
    """Of all of it."""
    camera = seen_from(eye, projection, 35.0, 1.3, width=width, height=height, near=near, far=3.2)
    return camera if dtype is None else jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), camera)


def crossing(scene: Any, camera: Any, within: Any = None, samples: int = SAMPLES) -> Crossing:
    """Of a scene's surface; `within` tells of places (..., 3) in the world whether they are shown."""
    surface, p = scene.surface, scene.particles
    real, level = np.asarray(p.valid), float(surface.level)
    view = (np.asarray(p.position, np.float64)[real] - np.asarray(camera.eye, np.float64)) @ np.asarray(camera.axes, np.float64).T
    reach = np.asarray(p.support, np.float64)[real] * float(surface.smoothing)
    amount = 1.0 if surface.of == "coverage" else np.asarray(getattr(p, surface.of), np.float64)[real]
    strength = amount * np.asarray(p.volume, np.float64)[real] / reach**3
    quantity, kernel = np.asarray(p.quantity, np.float64)[real], kernels.by_name(p.kernel)

    def weights(place: np.ndarray, some: np.ndarray) -> np.ndarray:
        square = ((place[..., None, :] - view[some]) ** 2).sum(-1) / reach[some] ** 2
        return strength[some] * kernel.norm * kernel.of_square(square, np)

    def beside(ray: np.ndarray) -> np.ndarray:
        """Particles that a ray comes so near to that places on it, or a little off it, may lie in their supports."""
        start, end = (at(ray, depth) for depth in (0.0, 1.0))
        way = (end - start) / np.linalg.norm(end - start)
        away = (view - start) - ((view - start) @ way)[:, None] * way
        return np.flatnonzero(np.linalg.norm(away, axis=1) <= reach + 0.01 * reach.min())

    u, v = (np.asarray(axis, np.float64) for axis in _axes(camera))
    rays = np.stack(np.broadcast_arrays(u[None, :], v[:, None], np.ones((len(v), len(u)))), -1).reshape(-1, 3)
    depths = np.linspace(float(camera.near), float(camera.far), samples)

    def at(ray: np.ndarray, depth: Any) -> np.ndarray:
        depth = np.asarray(depth)[..., None]
        return (
            ray * depth
            if camera.is_perspective
            else np.concatenate([np.broadcast_to(ray[:2], (*depth.shape[:-1], 2)), depth], -1)
        )

    some = [beside(ray) for ray in rays]
    found = [
        _of_ray(at, ray, depths, functools.partial(weights, some=near), level, within, camera)
        for ray, near in zip(rays, some, strict=True)
    ]
    depth, clearance = (np.array([one[k] for one in found]) for k in (0, 1))
    normal, facing, carried = np.zeros((len(rays), 3)), np.ones(len(rays)), np.zeros(len(rays))
    for k, (ray, t) in enumerate(zip(rays, depth, strict=True)):
        if not np.isfinite(t):
            continue
        place, step = at(ray, t), 1e-5 * reach.min()
        here, near = functools.partial(weights, some=some[k]), some[k]
        slopes = [(here(place + e).sum() - here(place - e).sum()) / (2 * step) for e in step * np.eye(3)]
        normal[k] = -np.array(slopes) / np.linalg.norm(slopes)
        way = ray if camera.is_perspective else np.array([0.0, 0.0, 1.0])
        facing[k] = abs(normal[k] @ way) / np.linalg.norm(way)
        carried[k] = (here(place) * quantity[near]).sum() / here(place).sum()
    shape = len(v), len(u)
    return Crossing(*(one.reshape(*shape, *one.shape[1:]) for one in (depth, clearance, normal, facing, carried)))


def _of_ray(at: Any, ray: Any, depths: Any, weights: Any, level: float, within: Any, camera: Any) -> tuple[float, float]:
    places = at(ray, depths)
    field = weights(places).sum(-1) - level
    crossed = (field[1:] >= 0) != (field[:-1] >= 0)
    if within is not None:
        world = places @ np.asarray(camera.axes, np.float64) + np.asarray(camera.eye, np.float64)
        crossed &= within(0.5 * (world[1:] + world[:-1]))
    (where,) = np.nonzero(crossed)
    near = np.abs(field[: where[0]] if len(where) else field).min(initial=np.inf) / level
    if not len(where):
        return np.inf, near
    end = where[1] if len(where) > 1 else len(field)
    near = min(near, np.abs(field[where[0] + 1 : end + 1]).max(initial=0) / level)
    low, high, sign = depths[where[0]], depths[where[0] + 1], field[where[0]] >= 0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        behind = (weights(at(ray, middle)).sum() - level >= 0) == sign
        low, high = (middle, high) if behind else (low, middle)
    return 0.5 * (low + high), near


def _axes(camera: Any) -> tuple[np.ndarray, np.ndarray]:
    half, aspect = float(camera.half_height), camera.width / camera.height
    columns, rows = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
    return half * aspect * (2 * columns / camera.width - 1), half * (1 - 2 * rows / camera.height)
