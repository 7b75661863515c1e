"""Made volumes at any resolution: a cast engine block, a knotted creature's distance field, a mixing layer.

Flow: [fields] -> Scene, Camera -> render -> image.

They stand in for the three data sets of Kratz et al. 2011, section 7.1: bytes of a CT scan with flat walls of two materials, a
smooth float field whose level sets are thin and bent, and a float field that is rough all over. The same `n` gives the same
values on every machine, but for the rounding of its arithmetic.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial import cKDTree

from jaxsph.model.camera.camera import Camera
from jaxsph.model.scene import Scene
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.transfer.maps import colormap
from jaxsph.model.volume import Volume

Field = Float[np.ndarray, "nx ny nz"]
ALUMINIUM, STEEL = 110.0, 230.0  # bytes
BORES = (0.2, 0.4, 0.6, 0.8)  # where the cylinders of the engine stand along its length 1
CURVE_POINTS = 4000  # of the creature's spine: with them the distance from its skin errs by 1e-5
LAYER_SHAPE = 682, 61, 132  # of the mixing layer of Kratz et al. 2011: along the flow, across the span, across the layer
VORTICES = 9


def engine(n: int = 256, *, width: int = 512, height: int = 512) -> tuple[Scene, Camera]:
    """A block of four cylinders with sleeves of steel, ribs, a hollow crankcase and bolt holes; (n, 3 n / 4, n / 2) bytes."""
    values, spacing = engine_values(n)
    volume = Volume.from_array(values, (0.0, 0.0, 0.0), spacing)
    grey, orange = (0.55, 0.65, 0.75), (1.0, 0.55, 0.15)
    transfer = TransferFunction.from_points(
        [50, 90, 130, 170, 200, 225], [grey, grey, (0.7, 0.8, 0.9), orange, orange, (1.0, 0.8, 0.4)], [0, 14, 14, 14, 60, 60]
    )
    camera = Camera.framing(volume, direction=(-0.55, -0.6, -1.0), fov_degrees=30.0, width=width, height=height, margin=0.85)
    return Scene(volume=volume, volume_transfer=transfer), camera


def dragon(n: int = 256, *, width: int = 512, height: int = 512) -> tuple[Scene, Camera]:
    """The distance from a spiny creature wound into a knot, negative inside; (n, n, n / 2) floats, and shells of distance."""
    values, lower, spacing = dragon_values(n)
    volume = Volume.from_array(values, lower, spacing)
    green, gold = (0.15, 0.75, 0.35), (1.0, 0.75, 0.25)
    transfer = TransferFunction.from_points(
        [-0.09, -0.05, -0.03, -0.01, 0.0, 0.02, 0.09, 0.1, 0.11],
        [(1.0, 0.3, 0.1), gold, gold, green, green, green, *[(0.3, 0.45, 1.0)] * 3],
        [60, 60, 4, 2, 14, 0, 0, 3, 0],
    )  # fmt: skip
    camera = Camera.framing(volume, direction=(-0.3, -0.45, -1.0), fov_degrees=30.0, width=width, height=height, margin=0.8)
    return Scene(volume=volume, volume_transfer=transfer), camera


def mixing_layer(n: int = 682, *, width: int = 512, height: int = 512) -> tuple[Scene, Camera]:
    """Speed in a shear layer that has rolled up into vortices, with ribs between them; `n` points along the flow, floats."""
    values, spacing = mixing_layer_values(n)
    volume = Volume.from_array(values, (0.0, 0.0, 0.0), spacing)
    shown = np.linspace(0.0, 1.6, 16)
    extinction = 12 * np.exp(-(((shown - 0.05) / 0.2) ** 2)) + 12 * np.clip(shown - 0.9, 0, None) + 0.1
    transfer = TransferFunction.from_points(shown, colormap("coolwarm"), extinction)
    camera = Camera.framing(
        volume, direction=(-0.35, 1.0, -0.55), up=(0.0, 0.0, 1.0), fov_degrees=25.0, width=width, height=height, margin=1.02
    )
    return Scene(volume=volume, volume_transfer=transfer), camera


def engine_values(n: int) -> tuple[UInt8[np.ndarray, "nx ny nz"], float]:
    """Bytes of the engine block, and the spacing at which it is 1 long."""
    x, y, z, spacing = _axes((n, 3 * n // 4, n // 2))
    middle = z[..., -1:] / 2
    body = _box(x - 0.5, y - 0.45, z - middle, (0.44, 0.2, 0.13))
    crankcase = _box(x - 0.5, y - 0.2, z - middle, (0.44, 0.12, 0.17))
    flange = _box(x - 0.5, y - 0.08, z - middle, (0.47, 0.02, 0.2))
    ribs = _box((x + 0.025) % 0.05 - 0.025, y - 0.45, z - middle, (0.006, 0.14, 0.16)) + np.where(abs(x - 0.5) < 0.43, 0.0, 1.0)
    aluminium = np.minimum.reduce(np.broadcast_arrays(body, crankcase, flange, ribs))
    hollow = _box((x - 0.1) % 0.2 - 0.1, y - 0.14, z - middle, (0.085, 0.12, 0.13))  # walls stay between the cylinders
    bolts = np.hypot((x - 0.05) % 0.1 - 0.05, abs(z - middle) - 0.185) - 0.008 + np.where(y < 0.12, 0.0, 1.0)
    shaft = np.maximum(np.hypot(y - 0.2, z - middle) - 0.05, abs(x - 0.5) - 0.5)
    ring = np.min([np.hypot(x - bore, z - middle) for bore in BORES], 0)
    above = 0.26 - y
    jacket = np.maximum(abs(ring - 0.108) - 0.01, np.maximum(above, y - 0.6))
    removed = np.minimum.reduce(np.broadcast_arrays(hollow, bolts, shaft, jacket, np.maximum(ring - 0.075, above)))
    cast = _share(np.maximum(aluminium, -removed), spacing)
    crank = np.maximum(np.hypot(y - 0.2, z - middle) - 0.022, abs(x - 0.5) - 0.48)
    sleeve = np.maximum(abs(ring - 0.08) - 0.009, np.maximum(above, y - 0.65))
    steel = _share(np.minimum(*np.broadcast_arrays(sleeve, crank)), spacing)
    return np.rint(ALUMINIUM * cast * (1 - steel) + STEEL * steel).astype(np.uint8), spacing


def dragon_values(n: int) -> tuple[Field, tuple[float, float, float], float]:
    """Distance from the creature's skin in float32, the lower corner of the grid, and its spacing."""
    spacing = 2.6 / (n - 1)
    lower = (-1.3, -1.3, -1.3 * (n // 2 - 1) / (n - 1))
    x, y, z, _ = _axes((n, n, n // 2), spacing, lower)
    turn = np.linspace(0, 2 * np.pi, CURVE_POINTS, endpoint=False)
    reach = 0.72 + 0.26 * np.cos(1.5 * (along := 2 * turn))
    spine = np.stack([reach * np.cos(along), reach * np.sin(along), 0.3 * np.sin(1.5 * along)], 1)
    points = np.stack(np.broadcast_arrays(x, y, z), -1).reshape(-1, 3)
    away = cKDTree(spine).query(points, workers=-1)[0].reshape(n, n, n // 2)
    head, snout = spine[CURVE_POINTS // 2], spine[CURVE_POINTS // 2] + (0.16, 0.1, 0.05)
    rings = np.maximum(np.cos(36 * np.arctan2(y, x)), 0) ** 4
    skin = away - 0.055 - 0.07 * np.exp(-((x - head[0]) ** 2 + (y - head[1]) ** 2)) - 0.012 * rings
    for centre, radius in ((head, 0.17), (snout, 0.09), (head + (-0.05, 0.17, 0.1), 0.045), (head + (-0.05, 0.17, -0.1), 0.045)):
        ball = np.sqrt((x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2) - radius
        skin = _smooth_union(skin, ball, 0.06)
    return skin.astype(np.float32), lower, spacing


def mixing_layer_values(n: int) -> tuple[Field, float]:
    r"""Speed in float32, and the spacing at which the layer is 11 long.

    A shear $\tanh$ profile, a row of vortices with smooth cores (Lamb and Oseen) that are bent along the span and about to pair,
    and streamwise ribs between them.
    """
    shape = (n, *(max(round(n * points / LAYER_SHAPE[0]), 2) for points in LAYER_SHAPE[1:]))
    x, span, z, spacing = _axes(shape, 11.0 / (n - 1))
    z = z - z[..., -1:] / 2
    along, across = 0.25 * np.tanh(z / 0.25) + np.zeros(shape), np.zeros(shape)
    rng = np.random.default_rng(11)
    for k in range(VORTICES + 4):
        place, phase = 11.0 * (k - 1.5) / VORTICES, rng.uniform(0, 2 * np.pi)
        bent = place + 0.12 * np.sin(2 * np.pi * span + phase)
        height = 0.2 * (-1) ** k * (1 + 0.3 * rng.uniform()) + 0.08 * np.cos(2 * np.pi * span + phase)
        dx, dz = x - bent, z - height
        square = dx**2 + dz**2
        core = 0.15 * (1 + 0.4 * rng.uniform())
        swirl = 0.36 * -np.expm1(-square / core**2) / np.maximum(square, 1e-9)
        along, across = along + swirl * dz, across - swirl * dx
    turns = 2 * np.pi * (2 * span + 0.3 * np.sin(2 * np.pi * x / 2.4))
    ribs = 0.35 * np.sin(turns) * np.exp(-((z / 0.5) ** 2)) * (1 + np.cos(2 * np.pi * x * VORTICES / 11.0)) / 2
    return np.sqrt(along**2 + (across + ribs) ** 2 + (0.5 * ribs) ** 2).astype(np.float32), spacing


def _axes(
    shape: tuple[int, ...], spacing: float | None = None, lower: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Coordinates along three axes, of one length unit along the first where no spacing is given; and the spacing."""
    spacing = 1.0 / (shape[0] - 1) if spacing is None else spacing
    x, y, z = np.ogrid[tuple(slice(0, points) for points in shape)]
    return lower[0] + x * spacing, lower[1] + y * spacing, lower[2] + z * spacing, spacing


def _box(x: np.ndarray, y: np.ndarray, z: np.ndarray, half: tuple[float, float, float]) -> np.ndarray:
    """Distance from a box around zero, negative inside."""
    off = [abs(at) - size for at, size in zip((x, y, z), half, strict=True)]
    inside = np.maximum(np.maximum(off[0], off[1]), off[2])
    return np.minimum(inside, 0) + np.sqrt(sum(np.maximum(side, 0) ** 2 for side in off))


def _share(distance: np.ndarray, spacing: float) -> np.ndarray:
    """How much of a cell lies inside, as a scanner of that resolution sees it."""
    return np.clip(0.5 - distance / (1.5 * spacing), 0, 1)


def _smooth_union(first: np.ndarray, second: np.ndarray, width: float) -> np.ndarray:
    """Distance from both, without a crease where they meet."""
    share = np.clip(0.5 + 0.5 * (second - first) / width, 0, 1)
    return second + share * (first - second) - width * share * (1 - share)
