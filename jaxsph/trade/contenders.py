"""Contenders: what a sweep compares, how an image of fewer pixels is made comparable, and the light integral beside them.

Flow: settings -> [contenders] -> sweep.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Hashable, Iterable, Sequence
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float

from jaxsph.model import Camera, Image, Scene, Settings, registry
from jaxsph.reference import integral

TOLERANCES = (0.001, 0.004, 0.01)
ESTIMATORS: dict[str, dict[str, Any]] = {
    "interval": {"integrator": "samples", "estimator": "interval", "relax": 0.0},
    "interval relaxed": {"integrator": "samples", "estimator": "interval", "relax": 1.0},
    "pilot": {"integrator": "samples", "estimator": "pilot", "relax": 0.0},
    "segments": {"integrator": "segments", "relax": 0.0},
}
BASELINES = ("samples/2", "samples/4", "segments/1", "segments/4", "size/2", "size/4")
FULL_RATE = "full rate"
SEED = 0  # of the pixels that the light integral is taken at
TOLERANCE = 1e-6  # of the integral itself: far below any tolerance that images are asked for
Pixels = tuple[np.ndarray, np.ndarray]  # rows and columns


@dataclasses.dataclass(frozen=True)
class Contender:
    """Settings to render with, at a size divided by `shrink` each way, to be scaled up again."""

    method: str
    settings: Settings
    shrink: int = 1

    @property
    def tolerance(self) -> float | None:
        """What error control is asked for."""
        return self.settings.tolerance

    @property
    def is_against_integral(self) -> bool:
        """Whether its tolerance is kept against the light integral, not against full rate."""
        return self.tolerance is not None and registry.estimates(self.settings.integrator_used)

    @property
    def kind(self) -> Hashable:
        """What fixes its plan besides the frame: all but the numbers that a plan does not depend on."""
        tolerance = None if self.tolerance is None else 0.0
        return dataclasses.replace(self.settings, tolerance=tolerance, relax=0.0), self.shrink

    def camera(self, camera: Camera) -> Camera:
        """`camera`, for the image that is rendered."""
        if self.shrink == 1:
            return camera
        width, height = (-(-size // self.shrink) for size in (camera.width, camera.height))
        return dataclasses.replace(camera, width=width, height=height)


def suitable(settings: Settings) -> tuple[str, ...]:
    """Estimators that keep a tolerance against full rate of those settings, or against the light integral."""
    own = settings.integrator_used
    return tuple(name for name, it in ESTIMATORS.items() if it["integrator"] == own or registry.estimates(it["integrator"]))


def estimators_of(scenes: Iterable[Scene], estimators: Sequence[str] | None) -> Sequence[str] | None:
    """Those that are asked for; of scenes with a surface none.

    Raises:
        ValueError: some are asked for of a surface.
    """
    if all(scene.surface is None for scene in scenes):
        return estimators
    if estimators:
        raise ValueError(
            f"`estimators` must be (), got {estimators!r}: a surface of particles has no tolerance; leave the surface out, or "
            "compare `baselines` alone"
        )
    return ()


def contenders(
    settings: Settings, tolerances: Sequence[float], estimators: Sequence[str] | None, baselines: Sequence[str]
) -> list[list[Contender]]:
    """Settings that take turns: full rate and baselines, then each estimator with all of its tolerances."""
    estimators = suitable(settings) if estimators is None else estimators
    for name in estimators:
        if name not in ESTIMATORS:
            raise ValueError(f"`estimators` must be of {', '.join(map(repr, ESTIMATORS))}, got {name!r}")
        if name not in suitable(settings):
            raise ValueError(
                f"`estimators` holds {name!r}, which keeps a tolerance against full rate of point samples, and full rate has "
                f"`integrator={settings.integrator_used!r}`; leave it out, or give `integrator='samples'`"
            )
    groups = [[Contender(FULL_RATE, settings), *dict.fromkeys(baseline(settings, name) for name in baselines)]]
    for name in dict.fromkeys(estimators):
        chosen = [dataclasses.replace(settings, **ESTIMATORS[name], tolerance=float(t)) for t in dict.fromkeys(tolerances)]
        groups.append([Contender(name, one) for one in chosen])
    return groups


def baseline(settings: Settings, name: str) -> Contender:
    """Uniform sampling with K times fewer points or segments, or a smaller image: `"samples/K"`, `"segments/K"` or `"size/K"`."""
    name = "segments/1" if name == "segments" else name
    matched = re.fullmatch(r"(samples|segments|size)/([1-9]\d{0,5})", name)
    if matched is None:
        raise ValueError(f"`baselines` must be like 'samples/2', 'segments', 'segments/2' or 'size/4', got {name!r}")
    factor = int(matched[2])
    if matched[1] == "size":
        return Contender(name, settings, factor)
    return Contender(name, dataclasses.replace(settings, integrator=matched[1], samples=-(-settings.samples // factor)))


def scaled_up(layers: Float[np.ndarray, "rows columns 4"], camera: Camera) -> Float[np.ndarray, "height width 4"]:
    """What an image of fewer pixels shows along the rays of `camera`, bilinearly; the same image where the sizes agree."""
    rows, columns = layers.shape[:2]
    if (rows, columns) == (camera.height, camera.width):
        return layers
    down = (np.arange(camera.height) + 0.5) / camera.height * 2 - 1
    across = ((np.arange(camera.width) + 0.5) / camera.width * 2 - 1) * (camera.width / camera.height) / (columns / rows)
    place = np.meshgrid((down + 1) / 2 * rows - 0.5, (across + 1) / 2 * columns - 0.5, indexing="ij")
    return np.stack(
        [scipy.ndimage.map_coordinates(layer, place, order=1, mode="nearest") for layer in np.moveaxis(layers, -1, 0)], -1
    )


def integral_at(scene: Scene, camera: Camera, count: int) -> tuple[Pixels, Float[np.ndarray, "pixels 4"]] | None:
    """Rows and columns of so many pixels, always the same of one size, and the light integral there: colour and alpha, float64.

    None of no pixels, or of `media` or a surface, which are unknown to it.
    """
    if not count or scene.media or scene.surface is not None:
        return None
    number = camera.width * camera.height
    chosen = np.random.default_rng(SEED).choice(number, min(count, number), replace=False)
    pixels = chosen // camera.width, chosen % camera.width
    return pixels, layers_of(integral(scene, camera, pixels=pixels, tolerance=TOLERANCE))


def layers_of(image: Image) -> Float[np.ndarray, "... 4"]:
    """Colour and alpha, float64."""
    alpha = 1 - np.asarray(image.transmittance, np.float64)
    return np.concatenate([np.asarray(image.color, np.float64), alpha[..., None]], -1)
