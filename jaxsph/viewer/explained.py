"""What a place of a picture is: colours, depth, the quantity there; and what all rays meet.

Flow: Picture, place -> [explained] -> numbers for the page.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxsph.analysis.at_places import ParticleField
from jaxsph.analysis.visibility import visibility_histogram
from jaxsph.model.camera.camera import Camera
from jaxsph.model.scene import Scene, widened
from jaxsph.model.transfer.domains import Scale
from jaxsph.viewer.control_points import is_flat
from jaxsph.viewer.picture import Picture

RAYS, BINS = 300, 64  # of a histogram: a quarter of a second
ON_SURFACE = 0.01
"""Of its level, what the coverage may be off where a place is one of the surface, and not of what is in front of it."""


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
    if picture.scene.surface is not None:
        told["surface"] = True
    place = place_seen(picture, right, down)
    if place is not None:
        told["depth"] = float(np.asarray(image.depth)[found])
        told["place"] = place.tolist()
        told |= _of_particles(picture.scene, place)
    return told


def _of_particles(scene: Scene, place: np.ndarray) -> dict[str, Any]:
    """The field at a place, and how many particles it is of; of their surface, too, which way it faces."""
    particles = widened(scene).particles
    if particles is None:
        return {}
    there = ParticleField(particles).at(place[None])
    told = {"quantity": _plain(there.quantity[0]), "neighbours": int(there.number[0])}
    if scene.surface is not None and abs(there.coverage[0] / float(scene.surface.level) - 1) < ON_SURFACE:
        told["normal"] = there.normal[0].tolist()
    return told


def histogram_of(scene: Scene, camera: Camera, scale: Scale, picture: Picture | None = None) -> dict[str, Any] | None:
    """What rays meet by place on an axis, as JSON has it: path length, and light absorbed; each over its largest.

    Of a surface it is where rays of a picture meet it: both are one. None of media that have no quantity.
    """
    if scene.media or not scene.looks:
        return None
    if scene.surface is not None:
        return None if picture is None or not is_flat(scene) else _of_surface(scene, scale, picture)
    found = visibility_histogram(scene, camera, rays=RAYS, bins=BINS)
    places = np.clip(np.nan_to_num(scale.place(found.edges), neginf=-1.0, posinf=2.0), -1, 2)
    bars = {name: _shares(getattr(found, name)) for name in ("there", "absorbed")}
    return {"edges": places.tolist(), **bars, "rays": found.rays}


def _of_surface(scene: Scene, scale: Scale, picture: Picture) -> dict[str, Any]:
    """Of the quantity where some rays of a picture meet a surface."""
    depth, particles = np.asarray(picture.image.depth), widened(scene).particles
    assert particles is not None
    height, width = depth.shape
    chosen = np.random.default_rng(0).choice(depth.size, min(RAYS, depth.size), replace=False)
    rows, columns = np.unravel_index(chosen[np.isfinite(depth.ravel()[chosen])], depth.shape)
    at = zip((columns + 0.5 - width / 2) / height, (rows + 0.5) / height - 0.5, depth[rows, columns].tolist(), strict=True)
    met = [picture.pose.place_at(*place) for place in at]
    quantity = ParticleField(particles).at(np.reshape(met, (-1, 3))).quantity
    place = np.clip(scale.place(quantity[np.isfinite(quantity)]), -1, 2)
    counts, edges = np.histogram(place, BINS, (min(0.0, place.min(initial=0)), max(1.0, place.max(initial=1))))
    shares = _shares(counts.astype(np.float64))
    return {"edges": edges.tolist(), "there": shares, "absorbed": shares, "rays": len(chosen)}


def _shares(values: np.ndarray) -> list[float]:
    largest = float(values.max(initial=0))
    return (values / largest).tolist() if largest > 0 else np.zeros(len(values)).tolist()


def _plain(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None
