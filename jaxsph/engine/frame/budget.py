"""The error budget of a pixel: its error bound by source, as the frame that draws the pixel puts it together.

Flow: scene, camera, settings, pixel -> plan -> band of the pixel -> [budget] -> explain.

Bundles, and so bands, know nothing of each other: of a frame of several bands the pixel's own is drawn alone, and its numbers are
those of the whole image, bit for bit. With a quadtree the whole image is drawn, as its leaves lie across bands.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from jaxsph.engine.access.grid import unshard
from jaxsph.engine.access.lists import BUNDLE
from jaxsph.engine.control.adapt import rounding_of
from jaxsph.engine.control.decide import ControlPlan, Decided, PilotPlan
from jaxsph.engine.frame.frame import Frame
from jaxsph.engine.frame.images import image_of
from jaxsph.engine.frame.stages import REFERENCE, Cast, ends, least_transmittance
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.request import Request
from jaxsph.engine.runtime.executors import Eager
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics.checks import array_of

LEVELS, SUPER_PIXELS, ROUNDING, INTERPOLATION = "coarse levels", "super-pixels", "rounding", "interpolation"
SCREEN, ENDED = "screen", "ended rays"
"""Sources; what integrators estimate is called as these are."""


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
    return asked.in_given_unit(image), row, _apart(float(np.asarray(image.error_bound)[row, column]), shares)


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


def _apart(total: float, shares: dict[str, float | None]) -> dict[str, float]:
    """All sources, that which was left open with what is left; of a bound that was cut off at 1 they are cut off alike."""
    known = sum(share for share in shares.values() if share is not None)
    scale, left = (total / known, 0.0) if known > total else (1.0, total - known)
    return {name: left if share is None else scale * share for name, share in shares.items()}
