"""The verb: particles in, a lower and an upper image out, between which the picture at full rate lies.

Flow: view_scene -> plan -> grid, band by band -> bounds of samples -> intervals of bundles -> Bracket.
"""

from __future__ import annotations

import dataclasses
import functools
import operator

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.engine.access.grid import CELL_SAMPLES, Grid, by_cell, shard_of_grid, slab_extents, slabs_with, unshard
from jaxsph.engine.control.allocation import rounding_of
from jaxsph.engine.control.decide import at_full_rate
from jaxsph.engine.control.intervals import MIXING, bounds_of_cells, composited, rays_of_bundles, with_unknown, within_clip
from jaxsph.engine.frame.frame import HALF, Frame
from jaxsph.engine.media.shown import Shown, over_slabs
from jaxsph.engine.planning.fit import PLANS
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.request import Request
from jaxsph.engine.runtime.clock import Clock
from jaxsph.engine.runtime.programs import stage
from jaxsph.engine.runtime.tuning import Tuning
from jaxsph.model.camera.camera import Camera
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics import faults
from jaxsph.numerics.checks import at_once, require_plan
from jaxsph.numerics.trees import line_of, tree

SUBDIVISIONS = 2  # sub-rectangles on each side of a bundle's footprint that are tested for coverage


@tree()
class Bracket:
    """Two images that hold the picture at full rate between them; made by `jaxsph.bracket`.

    Attributes:
        lower, upper: least and greatest red, green, blue and alpha (1 - transmittance) of every pixel. By rounding, they may
            lie a little outside of 0 to 1.
        faults: what went wrong, as of `Image`; then the bounds are infinite.
    """

    lower: Float[Array, "height width 4"]
    upper: Float[Array, "height width 4"]
    faults: Int[Array, ""] | int

    def __repr__(self) -> str:
        height, width = self.lower.shape[:2]
        if isinstance(self.lower, jax.core.Tracer):
            return line_of("Bracket", f"{width} x {height}")
        widest = float(np.max(np.asarray(self.upper) - np.asarray(self.lower), initial=0))
        return line_of("Bracket", f"{width} x {height}", f"at most {widest:.3g} wide")


def bracket(scene: Scene, camera: Camera, settings: Settings | None = None, *, plan: Plan | None = None) -> Bracket:
    r"""Bracket the picture at full rate: two images between which each of its pixels lies, without a reference image.

    The picture is that of `jaxsph.render` with `integrator="samples"`, no tolerance, every ray to its end. Of particles the
    samples of a bundle of 8 x 8 rays are bounded by the quantities of the particles that can touch them, what they look like
    by the extremes of the transfer function between, and the bundle's pixels by compositing these intervals back to front.
    So all pixels of a bundle have one bracket, which is narrow where a fluid varies little across a bundle, and wide where it
    is mixed on the scale of a support. Media that have no bounds of their own (volumes, points, surfaces, media of other
    packages) may be of any colour, clear or opaque, in all slabs of samples that hold any of them: of points, where a sphere
    of one may be; of particles' surfaces, where any sphere may be.

    Args:
        scene: as for `jaxsph.render`.
        camera: where from, and how large the image is.
        settings: `samples` a ray, and what memory may be used; what it says of tolerances, integrators and screens is left out.
        plan: of `jaxsph.plan(scene, camera, settings)`; needed under `jit`.

    Returns:
        Bracket with the dtype of the particles. It has no derivatives.

    Raises:
        ValueError: as `jaxsph.render`.
        CapacityError: eager, when a given `plan` is too small for this frame.

    References:
        Hochstetter, Orthmann & Kolb 2016, sections 4.1 to 4.3, equations 3 and 4; the theorem is in
        `jaxsph.engine.control.intervals`.
    """
    settings = Settings() if settings is None else settings
    require_plan("plan", plan, Plan, "plan")
    at_samples = dataclasses.replace(
        settings, tolerance=None, integrator="samples", screen="pixels", estimator=None, relax=0.0, min_transmittance=0.0
    )
    with at_once(scene, camera, settings) as traced:
        if plan is not None:
            asked = Request.of(scene, camera, settings)
            plan.check(asked.scene, asked.camera, asked.along)
            plan = _at_full_rate(plan, at_samples)
        clock, asked = Clock(traced=traced), Request.of(scene, camera, at_samples)
        frame = Frame.of(asked, *PLANS.for_frame(asked, clock, plan), clock)
        made = clock.run(_of_frame, frame, clock)
        if traced:
            usable = made.faults & ~faults.TOLD == 0
            return Bracket(jnp.where(usable, made.lower, -jnp.inf), jnp.where(usable, made.upper, jnp.inf), made.faults)
        faults.raise_for(int(made.faults), plan is None)
        return dataclasses.replace(made, faults=int(made.faults))


def _at_full_rate(plan: Plan, settings: Settings) -> Plan:
    """The plan of a frame, for its picture at full rate."""
    cast = dataclasses.replace(plan.cast, doublings=0)
    how = {"integrator": "samples", "screen": "pixels", "control": None, "quadtree": None}
    return dataclasses.replace(plan, samples=settings.samples, cast=cast, **how)  # type: ignore[arg-type]


def _of_frame(frame: Frame, clock: Clock) -> Bracket:
    """Of all bands, one after the other."""
    ranked, plan = frame.with_ranks(clock), frame.plan
    static = {
        "shards": frame.shards,
        "mix": frame.formulas.mix,
        "antialias": frame.formulas.antialias,
        "slab_samples": plan.cast.slab_samples,
        "tuning": plan.cast.tuning,
    }

    def of_band(first_row: Int[Array, ""]) -> tuple[Array, Array, Array]:
        grid, (word, _, _) = ranked.grid(first_row, clock)
        inputs = [(grid, ranked.shown, nth) for nth in clock.shards(frame.shards)]
        bundles = tuple(clock.each("adapt", bracket_shard, inputs, **static))
        lower, upper = clock.one("image", over_pixels, (bundles,), plan=plan)
        return lower, upper, word

    bands = clock.over(frame.first_rows, of_band)
    lower, upper = (jnp.concatenate([band[side] for band in bands])[: plan.height] for side in (0, 1))
    word = functools.reduce(operator.or_, (band[2] for band in bands), frame.in_view.viewed.faults)
    return Bracket(lower, upper, word)


@stage("shards", "mix", "antialias", "slab_samples", quickly=True)
def bracket_shard(
    grid: Grid, shown: Shown, nth: Int[Array, ""], *, shards: int, mix: str, antialias: int, slab_samples: int, tuning: Tuning
) -> tuple[Float[Array, "4 bundles"], Float[Array, "4 bundles"]]:
    """Between what the pixels of the bundles of a shard lie: the `nth` of `shards` of a band.

    Where several rays are cast through a pixel, of which it is the mean, they all lie in the bracket.
    """
    grid, shown = jax.tree.map(lax.stop_gradient, (shard_of_grid(grid, nth, shards), shown.of_type(grid.half_steps.dtype)))
    camera, transfer, media, within = shown
    slabs, _ = grid.windows.count.shape
    cells = -(-slabs * slab_samples // CELL_SAMPLES)
    fringe = HALF if antialias > 1 else 0
    rays, extents = rays_of_bundles(grid, camera, fringe), slab_extents(grid, camera, slab_samples, fringe)
    middles = jnp.pad(grid.half_steps[1::2], (0, cells * CELL_SAMPLES - grid.samples), mode="edge")
    references = at_full_rate(grid, transfer, slab_samples)[0].references
    of_cells = [(by_cell(one, slab_samples, jnp.inf).min(1), by_cell(one, slab_samples, -jnp.inf).max(1)) for one in references]
    bounds = bounds_of_cells(
        grid,
        grid.windows,
        (middles, middles),
        rays,
        of_cells,
        transfer,
        slab_samples=slab_samples,
        subdivisions=SUBDIVISIONS,
        perspective=camera.is_perspective,
        cells_at_once=tuning.cells_bounded,
    )
    if within is not None:
        lies = over_slabs(within, extents)
        bounds = within_clip(bounds, lies.meets, lies.holds)
    largest = float(len(media) + 1 if mix == "opacity" else 1) + (MIXING * float(jnp.finfo(middles.dtype).eps) if media else 0)
    for medium in media:
        occupied = medium.occupied(extents)
        unknown = occupied | slabs_with(grid, medium.spheres) if medium.between_samples else occupied
        bounds = with_unknown(bounds, unknown, largest)
    lower, upper = composited(bounds, grid.borders(cells * CELL_SAMPLES), rays, largest=largest)
    filled = bounds.touched.any(1).sum(0)
    several = antialias**2 * jnp.finfo(lower.dtype).eps if antialias > 1 else 0
    rounding = jnp.where(filled > 0, largest * (0.5 * rounding_of(filled, lower.dtype) + several), 0)
    return lower - rounding, upper + rounding


@stage("plan", quickly=True)
def over_pixels(bundles: tuple[tuple[Array, Array], ...], *, plan: Plan) -> tuple[Array, Array]:
    """The lower and the upper image of a band, of all of its shards."""

    def image(side: Float[Array, "4 bundles"]) -> Float[Array, "rows columns 4"]:
        return jnp.moveaxis(jax.vmap(plan.lists.over_pixels)(side), 0, -1)[:, : plan.width]

    lower, upper = unshard(bundles)
    return image(lower), image(upper)
