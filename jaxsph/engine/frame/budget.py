"""The error budget of a pixel: its error bound by source, as the frame that draws the pixel puts it together.

Flow: scene, camera, settings, pixel -> plan -> band of the pixel -> [budget] -> Budget.

Bundles, and so bands, know nothing of each other: of a frame of several bands the pixel's own is drawn alone, and its numbers are
those of the whole image, bit for bit. With a quadtree the whole image is drawn, as its leaves lie across bands.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxsph.engine.access.grid import unshard
from jaxsph.engine.access.lists import BUNDLE
from jaxsph.engine.control import ControlPlan, PilotPlan
from jaxsph.engine.control.adapt import rounding_of
from jaxsph.engine.frame.bands import Work
from jaxsph.engine.frame.images import image_of
from jaxsph.engine.frame.layers import REFERENCE, Band
from jaxsph.engine.frame.stages import ends, least_transmittance
from jaxsph.engine.planning.fit import PLANS, seen_by
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.request import Request
from jaxsph.engine.runtime.executors import Clock
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics.checks import array_of

LEVELS, SUPER_PIXELS, ROUNDING, INTERPOLATION = "coarse levels", "super-pixels", "rounding", "interpolation"
SCREEN, ENDED = "screen", "ended rays"
"""Sources; what integrators estimate is called as these are."""


class Budget(NamedTuple):
    """What an image says of a pixel, and what its error bound is made of.

    Attributes:
        color, transmittance, depth, total: of the pixel; `total` is its error bound.
        certified: whether that is proven.
        sources: shares of it, that add up to it; infinite where nothing is known.
        levels: what error control gave the cells along the pixel, front to back, see `Image.levels`; None without.
    """

    color: Float[np.ndarray, "3"]
    transmittance: float
    depth: float
    total: float
    certified: bool
    sources: dict[str, float]
    levels: Int[np.ndarray, " cells"] | None


def budget_of(scene: Scene, camera: Camera, settings: Settings, row: int, column: int, plan: Plan | None = None) -> Budget:
    """The budget of a pixel (eager, as `jaxsph.render` is, whose plans, compiled programs and errors it shares)."""
    clock, asked = Clock(), Request.of(scene, camera, settings)
    planned = plan is None
    plan, seen = PLANS.for_frame(asked, clock) if plan is None else seen_by(plan, asked, clock)
    work, number = Work(seen, asked.camera, settings, plan, asked.scene.formulas), row // plan.band_height
    if plan.quadtree is not None:
        image = work.image(clock, planned=planned)
        shares = _of_leaves(work, clock, image, row, column)
    else:
        band, image = _drawn(work, clock, number, planned)
        row -= number * plan.band_height
        shares = _of_rays(plan, settings, band, image, row, column)
    image = asked.in_given_unit(image)
    color, left, depth = (np.asarray(layer)[row, column] for layer in (image.color, image.transmittance, image.depth))
    levels = None if image.levels is None else np.asarray(image.levels)[:, row // BUNDLE, column // BUNDLE]
    total = float(np.asarray(image.error_bound)[row, column])
    return Budget(color, float(left), float(depth), total, bool(image.certified), _apart(total, shares), levels)


def _drawn(work: Work, clock: Clock, number: int, planned: bool) -> tuple[Band, Image]:
    """A band, and the image of it alone."""
    shards, plan = work.plan.shards, work.plan
    clock.foresee(lambda run: work.bands(shards, run, [number], None))
    (band,) = work.bands(shards, clock, [number], None)
    about = work.camera, work.settings, plan, work.formulas, clock
    return band, image_of(work.developed(clock, [band]), *about, planned=planned)


def _of_rays(plan: Plan, settings: Settings, band: Band, image: Image, row: int, column: int) -> dict[str, float | None]:
    """Sources where every pixel has its ray; None is that which has what the others leave of the total."""
    shares: dict[str, float | None] = {}
    if plan.integrator != REFERENCE:
        shares[plan.integrator.replace("_", " ")] = None
    elif isinstance(plan.control, PilotPlan):
        shares[INTERPOLATION] = None
    elif isinstance(plan.control, ControlPlan):
        levels = np.asarray(image.levels)[:, row // BUNDLE, column // BUNDLE]
        rounding = rounding_of(jnp.asarray((levels >= 0).sum()), image.error_bound.dtype)
        shares |= {LEVELS: None, ROUNDING: float(rounding) if (levels > 0).any() else 0.0}
        if plan.control.super_pixels:
            painted = [shard.painted for shard in band.of_shards.verdicts if shard.painted is not None]
            shares[SUPER_PIXELS] = float(plan.lists.over_pixels(unshard(tuple(painted)))[row, column]) if painted else 0.0
    if ends(settings):
        shards = [shard.cut for shard in band.of_shards.cast if shard.cut is not None]
        ended = bool(plan.lists.over_pixels(unshard(tuple(shards)))[row, column]) if shards else False
        shares[ENDED] = float(image.transmittance[row, column]) if ended else 0.0
    return shares


def _of_leaves(work: Work, clock: Clock, image: Image, row: int, column: int) -> dict[str, float | None]:
    """Sources where pixels are interpolated between rays."""
    plan, shares = work.plan, dict[str, float | None]({SCREEN: None})
    if isinstance(plan.control, PilotPlan):  # decided once more: the canvas keeps sums alone
        first = row // plan.band_height * plan.band_height
        frame = work.begun(plan.shards, clock)
        decided, _ = frame.decide(frame.grid(array_of(first, jnp.int32), clock).of(frame.ordered), clock)
        bound = plan.lists.over_pixels(unshard(tuple(one.verdict.bound for one in decided)))
        shares[INTERPOLATION] = float(bound[row - first, column])
    if ends(work.settings):
        let_through = float(image.transmittance[row, column])
        shares[ENDED] = let_through if let_through < float(least_transmittance(work.settings)) else 0.0
    return shares


def _apart(total: float, shares: dict[str, float | None]) -> dict[str, float]:
    """All sources, that which was left open with what is left; of a bound that was cut off at 1 they are cut off alike."""
    known = sum(share for share in shares.values() if share is not None)
    scale, left = (total / known, 0.0) if known > total else (1.0, total - known)
    return {name: left if share is None else scale * share for name, share in shares.items()}
