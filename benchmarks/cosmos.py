"""Gas on a grid with stars or galaxies as points: hydrogen that galaxies ionise, and a spiral galaxy.

Flow: [cosmos] -> Scene, Camera -> render -> image.

They stand in for the two data sets of Kaehler, Abel & Hege 2007, section 4, in kind and in size: 150,000 galaxies in a box of
gas of 256^3, and 120,000 stars in a disc of gas of 256^3. The same arguments give the same values on every machine, but for the
rounding of its arithmetic.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from jaxsph.model.camera.camera import Camera
from jaxsph.model.points import Points
from jaxsph.model.scene import Scene
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.volume import Volume

Field = Float[np.ndarray, "n n n"]
SIZE = 830, 520  # pixels, of Kaehler et al. 2007
SPECTRUM = 2.2  # density waves have the power k^-SPECTRUM
ARMS, PITCH = 2, 0.28  # of the spiral; PITCH is what its logarithm turns by
BULGE, HALO = 0.22, 0.08  # of the stars, what is in the middle and all around; the rest is in the disc


def reionization(
    points: int = 150_000, n: int = 256, *, width: int = SIZE[0], height: int = SIZE[1], seed: int = 3
) -> tuple[Scene, Camera]:
    """Galaxies in a cosmic web, and the gas around them: neutral (red) and ionised (blue); a box of side 1."""
    rng = np.random.default_rng(seed)
    density = _web(n, rng)
    position = _drawn(density**2.4, points, rng)
    mass = np.exp(rng.normal(0, 0.7, points))
    gas = _ionised(density, position, mass)
    volume = Volume.from_array(gas, (0.0, 0.0, 0.0), 1.0 / (n - 1))
    red, dark, blue, white = (0.85, 0.16, 0.05), (0.5, 0.05, 0.05), (0.12, 0.3, 0.95), (0.55, 0.8, 1.0)
    transfer = TransferFunction.from_points(
        [-1.0, -0.5, -0.22, -0.1, 0.1, 0.25, 0.6, 1.0],
        [(1.0, 0.5, 0.2), red, red, dark, blue, blue, blue, white],
        [14.0, 5.0, 1.2, 0.0, 0.0, 0.8, 4.0, 12.0],
    )
    warm = np.clip(rng.normal(0.6, 0.25, points), 0, 1)[:, None]
    color = (1 - warm) * (0.6, 0.75, 1.0) + warm * (1.0, 0.93, 0.75)
    shown = Points.from_arrays(position, 0.0022 * mass ** (1 / 3), color, opacity=np.clip(0.35 * mass, 0.1, 0.9))
    size = {"width": width, "height": height}
    camera = Camera.look_at((0.05, 0.86, -0.78), (0.52, 0.47, 0.5), fov_degrees=42.0, **size, near=0.3, far=2.1)
    return Scene(volume=volume, volume_transfer=transfer, points=shown), camera


def galaxy(
    points: int = 120_000, n: int = 256, *, width: int = SIZE[0], height: int = SIZE[1], seed: int = 5
) -> tuple[Scene, Camera]:
    """Stars of a bulge, a disc with spiral arms and a halo, and the gas of the disc; the disc's radius is about 1."""
    rng = np.random.default_rng(seed)
    volume = Volume.from_array(_disc_gas(n, rng), (-1.2, -1.2, -1.2), 2.4 / (n - 1))
    transfer = TransferFunction.from_points(
        [0.0, 0.05, 0.2, 0.45, 0.7, 1.0],
        [(0.12, 0.16, 0.35), (0.14, 0.16, 0.34), (0.3, 0.16, 0.14), (0.45, 0.18, 0.13), (0.9, 0.3, 0.42), (1.0, 0.62, 0.75)],
        [0.0, 0.2, 1.2, 3.0, 7.0, 22.0],
    )
    position, age = _stars(points, rng)
    young, old = np.array((0.62, 0.78, 1.0)), np.array((1.0, 0.86, 0.62))
    color = (1 - age[:, None]) * young + age[:, None] * old
    bright = np.exp(rng.normal(0, 1.0, points))
    shown = Points.from_arrays(position, 0.0034 * bright ** (1 / 3), color, opacity=np.clip(0.3 * bright, 0.05, 0.95))
    size = {"width": width, "height": height}
    camera = Camera.look_at((0.35, 1.05, -2.1), (0.0, -0.06, 0.0), fov_degrees=36.0, **size, near=0.7, far=4.0)
    return Scene(volume=volume, volume_transfer=transfer, points=shown), camera


def _web(n: int, rng: np.random.Generator) -> Field:
    """Density of a cosmic web, in [0, 1], most of it in filaments and knots."""
    wave = _smooth(rng.standard_normal((n, n, n), np.float32), lambda k: k ** (-SPECTRUM / 2) * np.exp(-((k / (0.12 * n)) ** 2)))
    wave = (wave - wave.mean()) / wave.std()
    density = np.exp(1.1 * wave)
    return (density / (density + np.quantile(density, 0.97))).astype(np.float32)


def _ionised(density: Field, position: np.ndarray, mass: np.ndarray) -> Field:
    """What gas there is, above zero where galaxies near by have ionised it, below where they have not."""
    n = density.shape[0]
    cell = np.minimum((position * n).astype(int), n - 1)
    light = np.bincount(np.ravel_multi_index(tuple(cell.T), density.shape), mass, density.size).reshape(density.shape)
    flux = _smooth(light.astype(np.float32), lambda k: 1 / (1 + (k / 3.0) ** 2))
    ratio = flux / np.quantile(flux, 0.72) / (0.35 + density)
    front = np.tanh(6 * np.log(np.maximum(ratio, 1e-3)))
    return (front * np.clip(1.6 * density, 0, 1)).astype(np.float32)


def _drawn(weight: Field, number: int, rng: np.random.Generator) -> Float[np.ndarray, "points 3"]:
    """Places in the unit box, as often as `weight` says."""
    total = np.cumsum(weight.ravel(), dtype=np.float64)
    cell = np.searchsorted(total, rng.uniform(0, total[-1], number))
    place = np.stack(np.unravel_index(np.minimum(cell, weight.size - 1), weight.shape), 1)
    return (place + rng.uniform(0, 1, place.shape)) / weight.shape[0]


def _disc_gas(n: int, rng: np.random.Generator) -> Field:
    """Density of gas in a thin disc that is densest along spiral arms, torn by turbulence; in [0, 1]."""
    axis = np.linspace(-1.2, 1.2, n, dtype=np.float32)
    x, height, z = axis[:, None, None], axis[None, :, None], axis[None, None, :]
    radius = np.hypot(x, z)
    arms = 0.5 + 0.5 * np.cos(ARMS * (np.arctan2(z, x) - np.log(radius + 0.02) / PITCH))
    torn = _smooth(rng.standard_normal((n, n, n), np.float32), lambda k: k**-1.6)
    torn = np.exp(0.75 * torn / torn.std())
    thin = np.exp(-((height / (0.03 + 0.03 * radius)) ** 2))
    flat = thin * np.exp(-((radius / 0.85) ** 3)) * (1 - np.exp(-((radius / 0.14) ** 2)))
    gas = flat * (0.1 + arms**2) * torn
    return np.clip(gas / np.quantile(gas[gas > 0.02], 0.98), 0, 1).astype(np.float32)


def _stars(number: int, rng: np.random.Generator) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, " points"]]:
    """Places of stars, and how old each is from 0 to 1."""
    kind = rng.uniform(size=number)
    direction = rng.normal(size=(number, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    away = np.where(kind < BULGE, 0.075 * rng.gamma(1.5, size=number), 0.9 * rng.uniform(size=number) ** 0.7)
    round_ones = direction * away[:, None] * (1, 0.75, 1)
    radius = 0.24 * rng.gamma(2.0, size=number)
    radius = np.where(radius < 1.15, radius, 1.15 * rng.uniform(size=number) ** 0.5)
    arm = rng.integers(0, ARMS, number) * (2 * np.pi / ARMS) + np.log(radius + 0.02) / PITCH
    in_arm = rng.uniform(size=number) < 0.7
    angle = np.where(in_arm, arm + rng.normal(0, 0.28, number), rng.uniform(0, 2 * np.pi, number))
    height = rng.normal(0, 1, number) * (0.012 + 0.02 * ~in_arm)
    flat_ones = np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], 1)
    in_disc = kind >= BULGE + HALO
    age = np.where(in_disc & in_arm, rng.beta(1.2, 4, number), rng.beta(5, 1.5, number))
    return np.where(in_disc[:, None], flat_ones, round_ones), age


def _smooth(values: Field, filtered: Callable[[np.ndarray], np.ndarray]) -> Field:
    """Waves of a periodic box, each times a function of its wave number in cycles a box."""
    n = values.shape[0]
    full, half = np.fft.fftfreq(n, 1 / n).astype(np.float32), np.fft.rfftfreq(n, 1 / n).astype(np.float32)
    k = np.sqrt(full[:, None, None] ** 2 + full[:, None] ** 2 + half**2)
    k[0, 0, 0] = 1
    return np.fft.irfftn(np.fft.rfftn(values) * filtered(k), s=values.shape, axes=(0, 1, 2)).astype(np.float32)
