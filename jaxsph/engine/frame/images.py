"""The one maker of images: of what was drawn, whatever drew it, with all that an image says of itself; and budgets of errors.

Flow: bands -> Drawn -> [images] -> Image; scene, camera, settings, pixel -> band of the pixel -> [images: budget_of] -> explain.

The error budget of a pixel is its error bound by source. Bundles, and so bands, know nothing of each other: of a frame of several
bands the pixel's own is drawn alone, and its numbers are those of the whole image, bit for bit. With a quadtree the whole image
is drawn, as its leaves lie across bands.
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

from jaxsph.engine.access.grid import unshard
from jaxsph.engine.access.lists import BUNDLE
from jaxsph.engine.control.decide import ControlPlan, Decided, PilotPlan
from jaxsph.engine.frame.frame import Frame
from jaxsph.engine.frame.stages import REFERENCE, Cast, Drawn, ends, least_transmittance
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.request import Request
from jaxsph.engine.runtime.executors import Eager
from jaxsph.model import registry
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.scene import Formulas, Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics import __version__, faults
from jaxsph.numerics.checks import array_of, at_hand, is_traced
from jaxsph.numerics.names import found

LEVELS, SUPER_PIXELS, ROUNDING, INTERPOLATION = "coarse levels", "super-pixels", "rounding", "interpolation"
SCREEN, ENDED = "screen", "ended rays"
"""Sources; what integrators estimate is called as these are."""


def certified(plan: Plan, settings: Settings, formulas: Formulas) -> Bool[Array, ""] | bool:
    """Whether `error_bound` is proven, without faults: by strict bounds, of point samples of no surface, a ray a pixel."""
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


def tell(word: int, image: Image, settings: Settings) -> None:
    """Warn whoever called this package of what is no reason to raise."""
    if word & faults.TOLD:
        number = int((np.asarray(image.error_bound) > settings.tolerance).sum())
        pixels = f"{number} of {image.error_bound.size} pixels"
        level, frame = 1, sys._getframe()
        while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] == __name__.partition(".")[0]:
            level, frame = level + 1, frame.f_back
        warnings.warn(f"{pixels}: {faults.describe(word & faults.TOLD)}", stacklevel=level)


def image_of(drawn: Drawn, frame: Frame, run: Eager, *, planned: bool = True, **stats: Any) -> Image:
    """The image that is drawn of a frame, by a run that was timed; faults raise, and warned is where a tolerance cannot be kept.

    `planned` is whether capacities were made for this very frame; `stats` have what else is known of it.
    """
    faults.raise_for(int(drawn.faults), planned)
    image, word = _image(drawn, frame)
    word = int(word)
    tell(word, image, frame.settings)
    counted: dict[str, Any] = {
        "evaluations": int(np.asarray(image.evaluations, np.float64).sum()),
        "evaluations_full": int(np.asarray(drawn.layers.full, np.float64).sum()),
        **{name: int(count) for name, count in _counts(drawn).items()},
    }
    run.mark("image")
    proven = bool(certified(frame.plan, frame.settings, frame.formulas))
    counted |= {"seconds": dict(run.seconds), **stats}
    metadata = metadata_of(frame.camera, frame.settings, proven)
    return dataclasses.replace(image, certified=proven, faults=word, stats=counted, metadata=metadata)


def traced_image_of(drawn: Drawn, frame: Frame) -> Image:
    """The image that is drawn of a frame within a trace: after a fault it claims nothing."""
    image, word = _image(drawn, frame)
    sums = {"evaluations": image.evaluations.sum(), "evaluations_full": drawn.layers.full.sum(), **_counts(drawn)}
    image = dataclasses.replace(image, certified=jnp.asarray(certified(frame.plan, frame.settings, frame.formulas)), stats=sums)
    return disclaimed(image, word | faults_of_settings(frame.settings))


def _image(drawn: Drawn, frame: Frame) -> tuple[Image, Any]:
    """The layers as an image, and its fault word."""
    layers, plan, settings, formulas = drawn.layers, frame.plan, frame.settings, frame.formulas
    of_pixels = *layers[:3], layers.bound, layers.evaluations
    image = Image(*of_pixels, True, drawn.faults, {}, levels=layers.levels, normal=layers.normal)
    if plan.quadtree is not None:
        if ends(settings):  # what interpolated rays that may have ended can have left out; of rays of pixels `develop` knows it
            let_through = lax.stop_gradient(image.transmittance)
            left_out = jnp.where(let_through < least_transmittance(settings), let_through, 0)
            image = dataclasses.replace(image, error_bound=image.error_bound + left_out)
    elif formulas.surfaces and not plan.cast.doublings:  # of surfaces where nothing is compared no error is known
        unknown = array_of(np.full(image.error_bound.shape, np.inf), image.error_bound.dtype)
        image = dataclasses.replace(image, error_bound=unknown)
    word = drawn.faults
    if settings.is_refined:  # for a tolerance, that the estimate may be above somewhere
        xp, bound = at_hand(lax.stop_gradient(image.error_bound))
        word = word | xp.where((bound > settings.tolerance).any(), faults.TOLERANCE_MISSED, faults.NONE)
    return image, word


def _counts(drawn: Drawn) -> dict[str, Any]:
    counts = {"cells": drawn.filled, "pairs": drawn.pairs}
    return counts if drawn.layers.rays is None else counts | {"rays": drawn.layers.rays}


def metadata_of(camera: Camera, settings: Settings, certified: bool) -> tuple[tuple[str, Any], ...]:
    """What a file says of how its image was made."""
    exact = settings.tolerance is None
    estimator = settings.integrator_used if registry.estimates(settings.integrator_used) else settings.estimator or "interval"
    return (
        ("jaxsph.version", __version__),
        ("jaxsph.integrator", settings.integrator_used),
        ("jaxsph.tolerance", "none" if exact else float(settings.tolerance)),
        ("jaxsph.estimator", "none" if exact else estimator),
        ("jaxsph.relax", "none" if exact else float(settings.relax)),
        ("jaxsph.certified", float(certified)),
        ("jaxsph.camera", camera.describe()),
    )


def budget_of(
    scene: Scene, camera: Camera, settings: Settings, row: int, column: int, plan: Plan | None = None
) -> tuple[Image, int, dict[str, float]]:
    """The budget of a pixel (eager, as `jaxsph.render` is, whose plans, compiled programs and errors it shares).

    Returns:
        An image that holds the pixel, in which row, and shares of its error bound by source, that add up to it; infinite where
        nothing is known.
    """
    run, asked = Eager(), Request.of(scene, camera, settings)
    planned = plan is None
    frame = Frame.begun(asked, run, plan)
    plan = frame.plan
    if plan.quadtree is not None:
        image = image_of(frame.drawn(run), frame, run, planned=planned)
        shares = _of_leaves(frame, run, image, row, column)
    else:
        first = row // plan.band_height * plan.band_height
        row -= first
        drawn, cast, decided = run.foreseen(lambda: frame.ranked(run).band(array_of(first, jnp.int32), run))
        image = image_of(frame.joined(run, [drawn]), frame, run, planned=planned)
        shares = _of_rays(frame, cast, decided, image, row, column)
    total, known = float(np.asarray(image.error_bound)[row, column]), sum(share for share in shares.values() if share is not None)
    # that which was left open has what is left; of a bound that was cut off at 1 all are cut off alike
    scale, left = (total / known, 0.0) if known > total else (1.0, total - known)
    apart = {name: left if share is None else scale * share for name, share in shares.items()}
    return asked.in_given_unit(image), row, apart


def _of_rays(
    frame: Frame, cast: list[Cast], decided: list[Decided], image: Image, row: int, column: int
) -> dict[str, float | None]:
    """Sources where every pixel has its ray; None is that which has what the others leave of the total."""
    shares, plan = dict[str, float | None](), frame.plan
    if plan.integrator != REFERENCE:
        shares[plan.integrator.replace("_", " ")] = None
    elif isinstance(plan.control, PilotPlan):
        shares[INTERPOLATION] = None
    elif isinstance(plan.control, ControlPlan):
        levels = np.asarray(image.levels)[:, row // BUNDLE, column // BUNDLE]
        rounding_of = found("jaxsph.engine.control.adapt:rounding_of")
        rounding = rounding_of(jnp.asarray((levels >= 0).sum()), image.error_bound.dtype)
        shares |= {LEVELS: None, ROUNDING: float(rounding) if (levels > 0).any() else 0.0}
        if plan.control.super_pixels:
            painted = [shard.painted for shard in decided if shard.painted is not None]
            shares[SUPER_PIXELS] = float(plan.lists.over_pixels(unshard(tuple(painted)))[row, column]) if painted else 0.0
    if ends(frame.settings):
        shards = [shard.cut for shard in cast if shard.cut is not None]
        ended = bool(plan.lists.over_pixels(unshard(tuple(shards)))[row, column]) if shards else False
        shares[ENDED] = float(image.transmittance[row, column]) if ended else 0.0
    return shares


def _of_leaves(frame: Frame, run: Eager, image: Image, row: int, column: int) -> dict[str, float | None]:
    """Sources where pixels are interpolated between rays."""
    plan, shares = frame.plan, dict[str, float | None]({SCREEN: None})
    if isinstance(plan.control, PilotPlan):  # decided once more: the canvas keeps sums alone
        first = row // plan.band_height * plan.band_height
        ranked = frame.ranked(run)
        decided, _ = ranked.decide(ranked.grid(array_of(first, jnp.int32), run)[0], run)
        bound = plan.lists.over_pixels(unshard(tuple(one.bound for one in decided)))
        shares[INTERPOLATION] = float(bound[row - first, column])
    if ends(frame.settings):
        let_through = float(image.transmittance[row, column])
        shares[ENDED] = let_through if let_through < float(least_transmittance(frame.settings)) else 0.0
    return shares
