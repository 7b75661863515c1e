"""What an image says of itself: how wrong it can be, whether that is proven, and what went wrong.

Flow: layers, fault word -> [claims] -> Image.
"""

from __future__ import annotations

import dataclasses
import sys
import warnings

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int

from jaxsph.engine.control.pilot import PilotPlan
from jaxsph.engine.frame.layers import REFERENCE
from jaxsph.engine.frame.stages import ends, least_transmittance
from jaxsph.engine.planning.plan import Plan
from jaxsph.model.image import Image
from jaxsph.model.scene import Formulas
from jaxsph.model.settings import Settings
from jaxsph.numerics import faults
from jaxsph.numerics.checks import array_of, at_hand, is_traced


def certified(plan: Plan, settings: Settings, formulas: Formulas) -> Bool[Array, ""] | bool:
    """Whether `error_bound` is proven where there are no faults: of point samples, a ray a pixel, by strict bounds.

    Of surfaces nothing is: samples may miss what is thin of them.
    """
    if plan.integrator != REFERENCE or plan.quadtree is not None or isinstance(plan.control, PilotPlan) or formulas.surfaces:
        return False
    if plan.control is None:
        return True
    relax = settings.relax
    return relax == 0 if is_traced(relax) else float(relax) == 0


def disclaimed(image: Image, word: Int[Array, ""]) -> Image:
    """After a fault an image is not certified, and no bound less than 1 holds; where its numbers mean nothing, it is blank.

    A tolerance that was missed leaves all else as it is: `error_bound` says where.
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
    """Fault bit of traced numbers of `settings` that are out of range; what is known has been checked before."""
    return faults.raised(faults.BAD_SETTINGS, ~_usable(settings))


def _usable(settings: Settings) -> Bool[Array, ""]:
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
    return usable


def with_ended_rays(image: Image, settings: Settings) -> Image:
    """With what interpolated rays that may have ended can have left out; `layers.of_band` knows it of rays of pixels."""
    if not ends(settings):
        return image
    let_through = lax.stop_gradient(image.transmittance)
    left_out = jnp.where(let_through < least_transmittance(settings), let_through, 0)
    return dataclasses.replace(image, error_bound=image.error_bound + left_out)


def with_unknown(image: Image, plan: Plan, formulas: Formulas) -> Image:
    """With no error told of surfaces where nothing is compared: infinite."""
    if not formulas.surfaces or plan.quadtree is not None or plan.cast.doublings:
        return image
    return dataclasses.replace(image, error_bound=array_of(np.full(image.error_bound.shape, np.inf), image.error_bound.dtype))


def missed(image: Image, settings: Settings) -> Int[Array, ""] | int:
    """Fault bit of a tolerance that segments were refined for, and that the estimate is above somewhere."""
    if not settings.is_refined:
        return faults.NONE
    xp, bound = at_hand(lax.stop_gradient(image.error_bound))
    return xp.where((bound > settings.tolerance).any(), faults.TOLERANCE_MISSED, faults.NONE)


def tell(word: int, image: Image, settings: Settings) -> None:
    """Warn whoever called this package of what is no reason to raise."""
    if word & faults.TOLD:
        number = int((np.asarray(image.error_bound) > settings.tolerance).sum())
        pixels = f"{number} of {image.error_bound.size} pixels"
        warnings.warn(f"{pixels}: {faults.describe(word & faults.TOLD)}", stacklevel=_caller())


def _caller() -> int:
    """Frames between the function that asks and the first outside of this package."""
    level, frame = 1, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] == __name__.partition(".")[0]:
        level, frame = level + 1, frame.f_back
    return level
