"""The fields on which convergence is shown, after section 7 of Kratz et al. 2011, and their finest images.

None of their data is at hand: the made volumes of `made_fields` stand in for them, an SPH scene is beside them, and the
block of their figure 4, which fades slowly into the background, is made here.
"""

from __future__ import annotations

import pathlib
from collections.abc import Callable

import made_fields
import numpy as np

import jaxsph as js
from jaxsph.engine.screen.canvas import channels_of

RESOLUTION = 256  # of the engine and the creature; the mixing layer has 682 points along the flow
RAMP_SHAPE = 96, 48, 48
View = tuple[js.Scene, js.Camera]


def engine(size: int) -> View:
    return made_fields.engine(RESOLUTION, width=size, height=size)


def dragon(size: int) -> View:
    """Its skin alone, shaded."""
    scene, camera = made_fields.dragon(RESOLUTION, width=size, height=size)
    return js.Scene(media=(js.IsoSurface.from_volume(scene.volume, level=0.0),)), camera


def mixing_layer(size: int) -> View:
    return made_fields.mixing_layer(width=size, height=size)


def mixer(size: int) -> View:
    """A stirred tank of SPH particles."""
    return js.scenes.load("mixer", width=size, height=size)


def ramp(size: int) -> View:
    """A red block that fades slowly into the background, and in it an edge."""
    x, y, z = (np.linspace(0, 1, points) for points in RAMP_SHAPE)
    x, y, z = x[:, None, None], y[:, None], z
    sides = (np.clip(4 * np.minimum(across, 1 - across), 0, 1) for across in (y, z))
    values = np.maximum(np.clip(1.02 - x, 0, 1) * next(sides) * next(sides), 0)
    inner = np.sqrt((2 * x - 0.6) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2) - 0.22
    values = np.where(inner < 0, 2.0, values).astype(np.float32)
    volume = js.Volume.from_array(values, (0, 0, 0), 2 / (RAMP_SHAPE[0] - 1))
    red, blue = (0.9, 0.15, 0.1), (0.25, 0.5, 1.0)
    transfer = js.TransferFunction.from_points([0, 1, 1.2, 2], [red, red, blue, blue], [0, 2.5, 2.5, 6])
    camera = js.Camera.framing(volume, direction=(0.2, 0.25, 1.0), fov_degrees=30.0, width=size, height=size, margin=0.9)
    return js.Scene(volume=volume, volume_transfer=transfer), camera


FIELDS: dict[str, Callable[[int], View]] = {
    "engine": engine,
    "dragon": dragon,
    "mixing layer": mixing_layer,
    "mixer": mixer,
    "ramp": ramp,
}


def finest(name: str, size: int, samples: int, kept: pathlib.Path | None) -> np.ndarray:
    """What a canvas holds of a field whose every pixel has a ray; `kept` is a folder of those made before."""
    path = kept / f"{name.replace(' ', '_')}_{size}_{samples}.npy" if kept else None
    if path and path.exists():
        return np.load(path)
    scene, camera = FIELDS[name](size)
    image = js.render(scene, camera, js.Settings(samples=samples))
    value = np.asarray(channels_of(np.moveaxis(np.asarray(image.color), -1, 0), image.transmittance, image.depth, None))
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, value)
    return value
