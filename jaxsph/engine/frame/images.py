"""The one maker of images: of what was drawn, whatever drew it, with all that an image says of itself.

Flow: bands -> Drawn -> [images] -> Image.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxsph.engine.frame.claims import certified, disclaimed, faults_of_settings, missed, tell, with_ended_rays, with_unknown
from jaxsph.engine.frame.layers import Drawn, Layers
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.runtime.executors import Clock
from jaxsph.model import registry
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.scene import Formulas
from jaxsph.model.settings import Settings
from jaxsph.numerics import faults
from jaxsph.numerics.version import __version__


def image_of(
    drawn: Drawn,
    camera: Camera,
    settings: Settings,
    plan: Plan,
    formulas: Formulas,
    clock: Clock,
    *,
    planned: bool = True,
    **stats: Any,
) -> Image:
    """The image that stages have drawn and a clock has timed; faults raise, and warned is where a tolerance cannot be kept.

    `planned` is whether capacities were made for this very frame; `stats` have what else is known of it.
    """
    faults.raise_for(int(drawn.faults), planned)
    image, word = _image(drawn, settings, plan, formulas)
    word = int(word)
    tell(word, image, settings)
    counted: dict[str, Any] = {
        "evaluations": int(np.asarray(image.evaluations, np.float64).sum()),
        "evaluations_full": int(np.asarray(drawn.layers.full, np.float64).sum()),
        **{name: int(count) for name, count in _counts(drawn).items()},
    }
    clock.mark("image")
    proven = bool(certified(plan, settings, formulas))
    counted |= {"seconds": dict(clock.seconds), **stats}
    metadata = metadata_of(camera, settings, proven)
    return dataclasses.replace(image, certified=proven, faults=word, stats=counted, metadata=metadata)


def traced_image_of(drawn: Drawn, settings: Settings, plan: Plan, formulas: Formulas) -> Image:
    """The image that is drawn within a trace: after a fault it claims nothing."""
    image, word = _image(drawn, settings, plan, formulas)
    sums = {"evaluations": image.evaluations.sum(), "evaluations_full": drawn.layers.full.sum(), **_counts(drawn)}
    image = dataclasses.replace(image, certified=jnp.asarray(certified(plan, settings, formulas)), stats=sums)
    return disclaimed(image, word | faults_of_settings(settings))


def _image(drawn: Drawn, settings: Settings, plan: Plan, formulas: Formulas) -> tuple[Image, Any]:
    """The layers as an image, and its fault word."""
    layers: Layers = drawn.layers
    of_pixels = *layers[:3], layers.bound, layers.evaluations
    image = Image(*of_pixels, True, drawn.faults, {}, levels=layers.levels, normal=layers.normal)
    if plan.quadtree is not None:
        image = with_ended_rays(image, settings)
    image = with_unknown(image, plan, formulas)
    return image, drawn.faults | missed(image, settings)


def _counts(drawn: Drawn) -> dict[str, Any]:
    counts = {"cells": drawn.filled, "pairs": drawn.pairs}
    return counts if drawn.layers.rays is None else counts | {"rays": drawn.layers.rays}


def metadata_of(camera: Camera, settings: Settings, certified: bool) -> tuple[tuple[str, Any], ...]:
    """What a file says of how its image was made."""
    exact = settings.tolerance is None
    estimator = settings.integrator if registry.estimates(settings.integrator) else settings.estimator
    return (
        ("jaxsph.version", __version__),
        ("jaxsph.integrator", settings.integrator),
        ("jaxsph.tolerance", "none" if exact else float(settings.tolerance)),
        ("jaxsph.estimator", "none" if exact else estimator),
        ("jaxsph.relax", "none" if exact else float(settings.relax)),
        ("jaxsph.certified", float(certified)),
        ("jaxsph.camera", camera.describe()),
    )
