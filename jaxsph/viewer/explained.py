"""What a place of a picture is: colours, depth, the quantity there; and what all rays meet.

Flow: Picture, place -> [explained] -> numbers for the page.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxsph.analysis.visibility import visibility_histogram
from jaxsph.model.camera.camera import Camera
from jaxsph.model.particles import kernels
from jaxsph.model.particles.particles import Particles
from jaxsph.model.scene import Scene
from jaxsph.model.transfer.domains import Scale
from jaxsph.viewer.picture import Picture

RAYS, BINS = 300, 64
"""Of a histogram: a quarter of a second."""


def pixel_at(picture: Picture, right: float, down: float) -> tuple[int, int] | None:
    """Row and column at a place in shares of the picture's height from its middle; None outside."""
    height, width = picture.image.shape
    row, column = int(np.floor((down + 0.5) * height)), int(np.floor(right * height + width / 2))
    return (row, column) if 0 <= row < height and 0 <= column < width else None


def place_seen(picture: Picture, right: float, down: float) -> np.ndarray | None:
    """(3,) where light is half absorbed on the ray there, length units; None where it never is."""
    found = pixel_at(picture, right, down)
    if found is None:
        return None
    depth = float(np.asarray(picture.image.depth)[found])
    height, width = picture.image.shape
    middle = (found[1] + 0.5 - width / 2) / height, (found[0] + 0.5) / height - 0.5
    return picture.pose.place_at(*middle, depth) if np.isfinite(depth) else None


def told_of_pixel(picture: Picture, right: float, down: float) -> dict[str, Any]:
    """Numbers of the pixel there, as JSON has them: what is not known is left out."""
    found = pixel_at(picture, right, down)
    if found is None:
        return {"text": "outside of the picture"}
    image = picture.image
    told: dict[str, Any] = {
        "row": found[0],
        "column": found[1],
        "of": list(image.shape),
        "stage": picture.stage,
        "color": np.asarray(image.color)[found].tolist(),
        "transmittance": float(np.asarray(image.transmittance)[found]),
    }
    if picture.settings.tolerance is not None:
        told["error"] = _plain(np.asarray(image.error_bound)[found])
    place = place_seen(picture, right, down)
    if place is not None:
        told["depth"] = float(np.asarray(image.depth)[found])
        told["place"] = place.tolist()
        if picture.scene.particles is not None:
            told["quantity"], told["neighbours"] = quantity_at(picture.scene.particles, place)
    return told


def quantity_at(particles: Particles, place: np.ndarray) -> tuple[float | None, int]:
    r"""The field $\sum q_j V_j W_j / \sum V_j W_j$ at a place (host side, float64), None outside of every support.

    Args:
        particles: of a periodic set those of one period, without their images.
        place: (3,), length units.

    Returns:
        The quantity (of two, that of colours), and how many particles it is of.
    """
    valid = np.asarray(particles.valid)
    support = np.asarray(particles.support, np.float64)
    square = ((particles.exact_position() - place) ** 2).sum(-1)
    near = np.flatnonzero(valid & (square < support**2))
    if not near.size:
        return None, 0
    kernel = kernels.by_name(particles.kernel)
    volume, quantity = (np.asarray(getattr(particles, name), np.float64)[near] for name in ("volume", "quantity"))
    weight = volume / support[near] ** 3 * kernel.of_square(square[near] / support[near] ** 2, np)
    total = float(weight.sum())
    return (float((weight * quantity).sum() / total) if total > 0 else None), int(near.size)


def histogram_of(scene: Scene, camera: Camera, scale: Scale) -> dict[str, Any] | None:
    """What rays meet by place on an axis, as JSON has it: path length, and light absorbed; each over its largest.

    None of media that have no quantity.
    """
    if scene.media or not scene.looks:
        return None
    found = visibility_histogram(scene, camera, rays=RAYS, bins=BINS)
    places = np.clip(np.nan_to_num(scale.place(found.edges), neginf=-1.0, posinf=2.0), -1, 2)
    bars = {name: _shares(getattr(found, name)) for name in ("there", "absorbed")}
    return {"edges": places.tolist(), **bars, "rays": found.rays}


def _shares(values: np.ndarray) -> list[float]:
    largest = float(values.max(initial=0))
    return (values / largest).tolist() if largest > 0 else np.zeros(len(values)).tolist()


def _plain(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None
