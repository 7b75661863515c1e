"""From a drawing to the `Image`: faults, certificate, counts, warnings, and the metadata of its file.

Flow: Drawing, frame -> [finish: finish_image] -> Image.
"""

from __future__ import annotations

import dataclasses
import sys
import warnings
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int

from jaxsph.engine.control.pilot import PilotPlan
from jaxsph.engine.frame.frame import Frame
from jaxsph.engine.frame.stages import REFERENCE, Drawing, least_transmittance, rays_may_end
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.runtime.clock import Clock
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.scene import Formulas
from jaxsph.model.settings import Settings, estimates
from jaxsph.numerics import __version__, faults
from jaxsph.numerics.checks import array_of, at_hand, is_traced


def is_certified(plan: Plan, settings: Settings, formulas: Formulas) -> Bool[Array, ""] | bool:
    """Whether `error_bound` is proven, if there are no faults.

    It is for point samples without surfaces, with one ray for each pixel, at full rate or by strict bounds (`relax` = 0).
    """
    if plan.integrator != REFERENCE or plan.quadtree is not None or isinstance(plan.control, PilotPlan) or formulas.surfaces:
        return False
    if plan.control is None:
        return True
    relax = settings.relax
    return relax == 0 if is_traced(relax) else float(relax) == 0


def disclaim(image: Image, word: Int[Array, ""]) -> Image:
    """The image after the faults of `word`: not certified, `error_bound` 1 everywhere, and blank if its numbers mean nothing.

    A missed tolerance (`faults.TOLD`) changes nothing but the word: `error_bound` says where it was missed.
    """
    faulty, unusable = word & ~faults.TOLD != 0, word & faults.UNUSABLE != 0
    return dataclasses.replace(
        image,
        color=jnp.where(unusable, 0, image.color),
        transmittance=jnp.where(unusable, 1, image.transmittance),
        depth=jnp.where(unusable, jnp.inf, image.depth),
        normal=None if image.normal is None else jnp.where(unusable, 0, image.normal),
        error_bound=jnp.where(faulty, 1, image.error_bound),
        certified=image.certified & ~faulty,
        faults=word,
    )


def faults_of_settings(settings: Settings) -> Int[Array, ""]:
    """The fault bit of traced numbers of `settings` that are out of range; numbers that are known were checked before."""
    tolerance, relax, least = settings.tolerance, settings.relax, settings.min_transmittance
    usable = jnp.asarray(True)
    if is_traced(tolerance):
        usable &= jnp.isfinite(tolerance) & (tolerance >= 0)
    if is_traced(relax):
        usable &= (relax >= 0) & (relax <= 1)
    if is_traced(least):
        usable &= (least >= 0) & (least < 0.5)
    if tolerance is not None and is_traced(tolerance, least):
        usable &= ~(jnp.asarray(least) >= tolerance) | (jnp.asarray(least) == 0) | (jnp.asarray(tolerance) == 0)
    return faults.raised(faults.BAD_SETTINGS, ~usable)


def warn_of(word: int, image: Image, settings: Settings) -> None:
    """Warn of faults that are no reason to raise: a missed tolerance. The warning names the line that called this package."""
    if word & faults.TOLD:
        number = int((np.asarray(image.error_bound) > settings.tolerance).sum())
        pixels = f"{number} of {image.error_bound.size} pixels"
        level, frame = 1, sys._getframe()
        while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] == __name__.partition(".")[0]:
            level, frame = level + 1, frame.f_back
        warnings.warn(f"{pixels}: {faults.describe(word & faults.TOLD)}", stacklevel=level)


def finish_image(
    drawing: Drawing, frame: Frame, settings: Settings, clock: Clock, *, planned: bool = True, **stats: Any
) -> Image:
    """Make the image of a drawing.

    Eagerly, faults raise, and a missed tolerance warns; under a trace, faults are a word of the image, which then claims nothing.

    Args:
        settings: those of the request, in which the user asked for a tolerance.
        planned: whether the plan was found for this very frame: a user's plan may be too small, which is a `CapacityError`.
        stats: more entries of `image.stats`.
    """
    if not clock.traced:
        faults.raise_for(int(drawing.faults), planned)
    image, word = _image(drawing, frame, settings)
    xp, bound = at_hand(image.error_bound)
    proven = is_certified(frame.plan, settings, frame.formulas) & xp.isfinite(bound).all()
    if clock.traced:
        sums = {"evaluations": image.evaluations.sum(), "evaluations_full": drawing.layers.full.sum(), **image.stats}
        image = dataclasses.replace(image, certified=proven, stats=sums)
        return disclaim(image, word | faults_of_settings(settings))
    word = int(word)
    warn_of(word, image, settings)
    counted: dict[str, Any] = {
        "evaluations": int(np.asarray(image.evaluations, np.float64).sum()),
        "evaluations_full": int(np.asarray(drawing.layers.full, np.float64).sum()),
        **{name: int(count) for name, count in image.stats.items()},
    }
    clock.mark("image")
    counted |= {"seconds": dict(clock.seconds), **stats}
    metadata = metadata_of(frame.camera, settings, bool(proven))
    return dataclasses.replace(image, certified=bool(proven), faults=word, stats=counted, metadata=metadata)


def _image(drawing: Drawing, frame: Frame, settings: Settings) -> tuple[Image, Any]:
    """The layers as an image with counts, whose certificate is still to be decided; and its fault word."""
    layers, plan, formulas = drawing.layers, frame.plan, frame.formulas
    of_pixels = *layers[:3], layers.bound, layers.evaluations
    counts = {"cells": drawing.filled, "pairs": drawing.pairs} | ({} if layers.rays is None else {"rays": layers.rays})
    image = Image(*of_pixels, True, drawing.faults, counts, levels=layers.levels, normal=layers.normal)
    if plan.quadtree is not None:
        if rays_may_end(settings):  # of interpolated rays it is not known which ended; `develop` knows it where all are cast
            let_through = lax.stop_gradient(image.transmittance)
            left_out = jnp.where(let_through < least_transmittance(settings), let_through, 0)
            image = dataclasses.replace(image, error_bound=image.error_bound + left_out)
    elif formulas.surfaces and not plan.cast.doublings:  # the error of surfaces is not known without a comparison
        unknown = array_of(np.full(image.error_bound.shape, np.inf), image.error_bound.dtype)
        image = dataclasses.replace(image, error_bound=unknown)
    word = drawing.faults
    if settings.is_refined:  # the finest segments may still be estimated to miss the tolerance
        xp, bound = at_hand(lax.stop_gradient(image.error_bound))
        word = word | xp.where((bound > settings.tolerance).any(), faults.TOLERANCE_MISSED, faults.NONE)
    return image, word


def metadata_of(camera: Camera, settings: Settings, certified: bool) -> tuple[tuple[str, Any], ...]:
    """The metadata that a file tells of how its image was made."""
    exact = settings.tolerance is None
    estimator = settings.integrator_used if estimates(settings.integrator_used) else settings.estimator or "interval"
    return (
        ("jaxsph.version", __version__),
        ("jaxsph.integrator", settings.integrator_used),
        ("jaxsph.tolerance", "none" if exact else float(settings.tolerance)),
        ("jaxsph.estimator", "none" if exact else estimator),
        ("jaxsph.relax", "none" if exact else float(settings.relax)),
        ("jaxsph.certified", float(certified)),
        ("jaxsph.camera", camera.describe()),
    )
