"""A pixel explained: what its error bound is made of, and what its ray meets.

Flow: scene, camera, settings, pixel -> [explain: band of the pixel -> budget; reference.light_integral -> ray] -> Explanation.
"""

from __future__ import annotations

import dataclasses
import operator
import os
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxsph.engine.access.grid import CELL_SAMPLES, unshard
from jaxsph.engine.access.lists import BUNDLE
from jaxsph.engine.bracket import bracket
from jaxsph.engine.control.adapt import ControlPlan
from jaxsph.engine.control.allocation import rounding_of
from jaxsph.engine.control.decide import Decided
from jaxsph.engine.control.pilot import PilotPlan
from jaxsph.engine.frame.finish import finish_image
from jaxsph.engine.frame.frame import Frame
from jaxsph.engine.frame.stages import REFERENCE, ShardResult, least_transmittance, rays_may_end
from jaxsph.engine.planning.fit import PLANS
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.render import draw
from jaxsph.engine.request import Request
from jaxsph.engine.runtime.clock import Clock
from jaxsph.io.replace import write_figure
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings, estimates
from jaxsph.numerics.checks import array_of
from jaxsph.numerics.names import import_by_name
from jaxsph.numerics.trees import line_of, on_host, span_of
from jaxsph.reference import along, integral

RAY_TOLERANCE = 1e-6  # of the light integral, as `along` has it
MOST = 5  # particles that are listed, those that add most
SUPER_PIXEL = 5  # what `Image.levels` has for one
FULL_RATE = "samples are at full rate, which is what errors are measured against, not the light integral"
COARSE, SUPER_PIXELS, ROUNDING, INTERPOLATION = "coarse levels", "super-pixels", "rounding", "interpolation"
SCREEN, ENDED = "screen", "ended rays"
"""Sources; what integrators estimate is called as these are."""
LEVELS = "at full rate", *(f"at every {nth} sample" for nth in ("2nd", "4th", "8th", "16th")), "of one colour"


@dataclasses.dataclass(frozen=True, eq=False)
class Explanation:
    r"""Why a pixel is what it is; made by `explain`. Lengths are in units of the scene.

    Attributes:
        pixel: row and column.
        sources: shares of the error bound by name, that add up to `total`:
            `"coarse levels"` and `"super-pixels"`, what fewer samples along rays, and one colour for all rays of a slab, are
            proven to change at most (with `relax`, estimated);
            `"interpolation"`, of slabs from the pilot's lattice;
            `"segments"`, by how samples differ from their neighbours;
            `"screen"`, of pixels between rays of a quadtree;
            `"ended rays"`, light that rays still let through where they ended;
            `"rounding"`, by which two images of the same samples differ.
            Only those that the settings can have: none at full rate, which is what errors are measured against.
        total: `image.error_bound` of the pixel; infinite where nothing is estimated.
        certified: whether that is proven.
        note: what there is to say of that in words.
        levels: what error control gave the slabs along the pixel, see `Image.levels`; None without.
        color, alpha: of the pixel, as rendered.
        lower, upper: red, green, blue and alpha between which the pixel at full rate is proven to lie, see `jaxsph.bracket`.
        integral_color, integral_alpha: the light integral along its ray, to 1e-6: what samples tend to as they become ever more.
            How far the pixel is from it (`off_integral`) is what a tolerance of point samples says nothing of.
        half_depth: where its transmittance falls to 1/2, as rendered; infinite where it does not.
        depth: view depths of the places that are looked at along the ray, ascending: those of the samples; with other integrators
            than `"samples"`, those by which the light integral is known to 1e-6, and the ends of portions twice.
        quantity: Q there, of particles, else of the first volume (of two quantities, that of colours); NaN where there is none.
        extinction_quantity: the second of two; None of one.
        extinction: of all that is there, a unit length.
        transmittance: of all that is up to there, with what a sample stands for: the last is the pixel's, but for its error.
        particles: indices, ascending, of those particles whose supports the ray passes through between near and far, where they
            are shown; of the scene's `particles` as they are given (prepared ones in their order, periodic ones in any copy).
        added: of each of these, what it adds to alpha: of the light that particles take at a place, its share of the field there,
            $\int T \sigma \, V_j W_j / \sum V W \, dl$. Of particles alone they add up to the ray's alpha.
    """

    pixel: tuple[int, int]
    sources: dict[str, float]
    total: float
    certified: bool
    note: str
    levels: Int[np.ndarray, " slabs"] | None
    color: Float[np.ndarray, "3"]
    alpha: float
    integral_color: Float[np.ndarray, "3"]
    integral_alpha: float
    half_depth: float
    depth: Float[np.ndarray, " places"]
    quantity: Float[np.ndarray, " places"]
    extinction_quantity: Float[np.ndarray, " places"] | None
    extinction: Float[np.ndarray, " places"]
    transmittance: Float[np.ndarray, " places"]
    particles: Int[np.ndarray, " particles"]
    added: Float[np.ndarray, " particles"]
    lower: Float[np.ndarray, "4"]
    upper: Float[np.ndarray, "4"]

    def __repr__(self) -> str:
        told = f"error {self.total:.2g}", f"alpha {self.alpha:.4g}", f"{len(self.particles):,} particles met"
        return line_of("Explanation", f"pixel {self.pixel}", *told)

    @property
    def off_integral(self) -> float:
        """How far the pixel is from the light integral along its ray, in any colour or alpha."""
        color = np.abs(np.asarray(self.color, np.float64) - self.integral_color)
        return float(max(color.max(), abs(self.alpha - self.integral_alpha)))

    def __str__(self) -> str:
        seen, truth = (" ".join(f"{float(channel):.3f}" for channel in color) for color in (self.color, self.integral_color))
        half = f", half of the light gone at depth {self.half_depth:.5g}" if np.isfinite(self.half_depth) else ""
        lines = [f"pixel {self.pixel[0]} {self.pixel[1]}: colour {seen}, alpha {self.alpha:.4f}{half}"]
        off = f"colour {truth}, alpha {self.integral_alpha:.4f}; the pixel is {self.off_integral:.2g} off"
        told = [
            *_budget(self),
            ("light integral", off),
            ("bracket", _bracket(self)),
            *_slabs(self.levels),
            *_ray(self),
            *_particles(self),
        ]
        return "\n".join([*lines, *(f"{what:<16}{text}" for what, text in told)])

    def figure(self, quantity: str = "quantity", title: str = "") -> Any:
        """Quantity, extinction and transmittance over depth, and the budget beside them: a figure of matplotlib's.

        Args:
            quantity: what it is called on its axis.
            title: above the figure.

        Raises:
            ImportError: matplotlib is not installed.
        """
        return import_by_name("jaxsph.plot.pixel_figure:pixel_figure")(self, quantity, title)  # 390 ms, matplotlib too

    def save(self, path: str | os.PathLike[str], quantity: str = "quantity", title: str = "") -> None:
        """Write the figure: `.png`, `.pdf` or `.svg`."""
        write_figure(self.figure(quantity, title), os.fspath(path))


@on_host
def explain(
    scene: Scene, camera: Camera, settings: Settings | None = None, *, pixel: tuple[int, int], plan: Plan | None = None
) -> Explanation:
    """Explain a pixel of `jaxsph.render(scene, camera, settings)`: its error bound by source, and its ray (host side).

    The bound is that of the image, whose pixels are drawn for it (at least those in rows about it), by its plans and compiled
    programs. The ray is looked at in float64 by the formulas of the reference, whatever the settings leave out.

    Args:
        scene: particles, volumes and points.
        camera, settings: as for `jaxsph.render`.
        pixel: row and column, both from 0; negative ones are refused, as they are by `jaxsph.reference.integral`.
        plan: as for `jaxsph.render`.

    Raises:
        ValueError: a pixel that the image does not have, traced arguments, a scene with `media` or a surface of particles;
            as `jaxsph.render`.
        CapacityError: as `jaxsph.render`.

    Warns:
        UserWarning: where segments cannot keep a tolerance in the rows that were drawn.
    """
    settings = Settings() if settings is None else settings
    row, column = pixel_of(pixel, camera.width, camera.height)
    scene.check_without_surface("`explain`")
    ray = along(scene, camera, row, column, settings.samples if settings.integrator_used == "samples" else None)
    truth = integral(scene, camera, pixels=(np.array([row]), np.array([column])), tolerance=RAY_TOLERANCE)
    image, line, sources = budget_of(scene, camera, settings, row, column, plan)
    rendered = [np.asarray(layer)[line, column] for layer in (image.color, image.transmittance, image.depth, image.error_bound)]
    color, left, half_depth, total = rendered[0], *map(float, rendered[1:])
    levels = None if image.levels is None else np.asarray(image.levels)[:, line // BUNDLE, column // BUNDLE]
    error = sources, total, bool(image.certified), note_of(settings, total), levels
    seen = color, 1 - left, np.asarray(truth.color[0]), 1 - float(truth.transmittance[0]), half_depth
    second = ray.quantities[1] if len(ray.quantities) > 1 else None
    met: Any = ray.depth, ray.quantities[0], second, ray.extinction, ray.transmittance, ray.particles, ray.added
    bracketed = bracket(scene, camera, settings, plan=plan)
    between = (np.asarray(side)[row, column] for side in (bracketed.lower, bracketed.upper))
    return Explanation((row, column), *error, *seen, *met, *between)


def pixel_of(pixel: Any, width: int, height: int) -> tuple[int, int]:
    """Row and column, that an image of that size has. Raises `ValueError`: it has not."""
    try:
        row, column = (operator.index(number) for number in pixel)
    except (TypeError, ValueError):
        raise ValueError(f"`pixel` must be two integers, row and column, got {pixel!r}") from None
    if not (0 <= row < height and 0 <= column < width):
        ends = f"a row from 0 to {height - 1} and a column from 0 to {width - 1}"
        raise ValueError(f"`pixel` must have {ends}, got {row} {column}; row 0 is the top, column 0 the left")
    return row, column


def note_of(settings: Settings, total: float) -> str:
    """What there is to say of an error bound; nothing where it speaks for itself."""
    if np.isinf(total):
        remedy = "" if estimates(settings.integrator_used) else 'integrator="segments" and '
        return f"no estimate, as nothing is compared without a tolerance: give {remedy}tolerance="
    of_samples, along_rays = settings.integrator_used == "samples", settings.tolerance is not None
    if settings.screen != "pixels":
        judged = settings.is_refined or (of_samples and along_rays and settings.estimator == "pilot")
        return "" if judged else f"of pixels between rays; {FULL_RATE if of_samples else 'along rays nothing is compared'}"
    return FULL_RATE if of_samples and not along_rays else ""


def budget_of(
    scene: Scene, camera: Camera, settings: Settings, row: int, column: int, plan: Plan | None = None
) -> tuple[Image, int, dict[str, float]]:
    """An image that holds a pixel, in which row, and shares of its error bound by source, that add up to it.

    Bundles, and so bands, know nothing of each other: of a frame of several bands the pixel's own is drawn alone, and its numbers
    are those of the whole image, bit for bit. With a quadtree the whole image is drawn, as its leaves lie across bands.
    """
    clock, asked = Clock(), Request.of(scene, camera, settings)
    planned = plan is None
    plan, in_view = PLANS.for_frame(asked, clock, plan)
    frame = Frame.of(asked, plan, in_view, clock)
    if plan.quadtree is not None:
        drawing = clock.run(draw, frame, clock)
        image = finish_image(drawing, frame, settings, clock, planned=planned)
        shares = _of_leaves(frame, settings, clock, image, row, column)
    else:
        first = row // plan.band_height * plan.band_height
        row -= first
        drawing, cast, decided = clock.run(lambda: frame.with_ranks(clock).band(array_of(first, jnp.int32), clock))
        image = finish_image(frame.join_bands(clock, [drawing]), frame, settings, clock, planned=planned)
        shares = _of_rays(frame, settings, cast, decided, image, row, column)
    total, known = float(np.asarray(image.error_bound)[row, column]), sum(share for share in shares.values() if share is not None)
    scale, left = (total / known, 0.0) if known > total else (1.0, total - known)  # a bound cut off at 1: all are, alike
    return asked.in_given_unit(image), row, {name: left if one is None else scale * one for name, one in shares.items()}


def _of_rays(
    frame: Frame, settings: Settings, cast: list[ShardResult], decided: list[Decided], image: Image, row: int, column: int
) -> dict[str, float | None]:
    """Sources where every pixel has its ray; None is that which has what the others leave of the total."""
    shares, plan = dict[str, float | None](), frame.plan
    if plan.integrator != REFERENCE:
        shares[plan.integrator.replace("_", " ")] = None
    elif isinstance(plan.control, PilotPlan):
        shares[INTERPOLATION] = None
    elif isinstance(plan.control, ControlPlan):
        levels = np.asarray(image.levels)[:, row // BUNDLE, column // BUNDLE]
        rounding = rounding_of(jnp.asarray(_filled_cells(levels, plan.cast.slab_samples)), image.error_bound.dtype)
        shares[ROUNDING] = float(rounding) if (levels > 0).any() else 0.0
        shares |= {COARSE: None} if plan.control.by_samples else {SUPER_PIXELS: None}
        if plan.control.by_samples and plan.control.super_pixels:
            painted = [shard.painted for shard in decided if shard.painted is not None]
            shares[SUPER_PIXELS] = float(plan.lists.over_pixels(unshard(tuple(painted)))[row, column]) if painted else 0.0
    if rays_may_end(settings):
        shards = [shard.cut for shard in cast if shard.cut is not None]
        ended = bool(plan.lists.over_pixels(unshard(tuple(shards)))[row, column]) if shards else False
        shares[ENDED] = float(image.transmittance[row, column]) if ended else 0.0
    return shares


def _filled_cells(levels: Int[np.ndarray, " slabs"], slab_samples: int) -> int:
    """Cells of a bundle that hold any slab that particles can touch."""
    return len(np.unique(np.flatnonzero(levels >= 0) * slab_samples // CELL_SAMPLES))


def _of_leaves(frame: Frame, settings: Settings, clock: Clock, image: Image, row: int, column: int) -> dict[str, float | None]:
    """Sources where pixels are interpolated between rays; of those that are, what rays are wrong by is in the screen's share."""
    plan, shares = frame.plan, dict[str, float | None]({SCREEN: None})
    if settings.is_refined:
        of_rays = plan.integrator.replace("_", " ")
        shares = {SCREEN: 0.0, of_rays: None} if image.evaluations[row, column] > 0 else {SCREEN: None, of_rays: 0.0}
    if isinstance(plan.control, PilotPlan):  # decided once more: the canvas keeps sums alone
        first = row // plan.band_height * plan.band_height
        ranked = frame.with_ranks(clock)
        decided, _ = ranked.decide(ranked.grid(array_of(first, jnp.int32), clock)[0], clock)
        bound = plan.lists.over_pixels(unshard(tuple(one.bound for one in decided)))
        shares[INTERPOLATION] = float(bound[row - first, column])
    if rays_may_end(settings):
        let_through = float(image.transmittance[row, column])
        shares[ENDED] = let_through if let_through < float(least_transmittance(settings)) else 0.0
    return shares


Told = list[tuple[str, str]]


def _budget(made: Explanation) -> Told:
    if np.isinf(made.total):
        return [("error", made.note)]
    kind = "certified" if made.certified else "estimated"
    told = [("error", f"{f'{made.total:.3g}':<11}{kind}{f': {made.note}' if made.note else ''}")]
    for name, share in sorted(made.sources.items(), key=lambda one: -one[1]):
        percent = f"{share / made.total:6.1%}" if made.total > 0 else ""
        told.append((f"  {name}", f"{f'{share:.3g}':<11}{percent}"))
    return told


def _bracket(made: Explanation) -> str:
    """Between what the pixel at full rate lies."""
    names = "red", "green", "blue", "alpha"
    ends = (f"{name} {least:.3f} to {most:.3f}" for name, least, most in zip(names, made.lower, made.upper, strict=True))
    return f"{', '.join(ends)}: at full rate, proven"


def _slabs(levels: np.ndarray | None) -> Told:
    if levels is None:
        return []
    counts = [(int((levels == level).sum()), name) for level, name in enumerate(LEVELS)] + [(int((levels < 0).sum()), "empty")]
    return [("slabs", ", ".join(f"{number} {name}" for number, name in counts if number))]


def _ray(made: Explanation) -> Told:
    there, values = int((made.extinction > 0).sum()), (made.quantity, made.extinction_quantity)
    places = f"{len(made.depth):,} places from depth {made.depth[0]:.5g} to {made.depth[-1]:.5g}, {there:,} that take light"
    told = [("ray", f"{places}; {made.transmittance[-1]:.4f} of it is left at the end")]
    named = zip(("quantity", "  of extinction"), values, strict=True)
    told += [(name, span_of(value)) for name, value in named if value is not None and not np.isnan(value).all()]
    most = made.extinction.argmax()
    return told + [("extinction", f"at most {made.extinction[most]:.4g}, at depth {made.depth[most]:.5g}")] * (there > 0)


def _particles(made: Explanation) -> Told:
    if not len(made.particles):
        return []
    order = np.argsort(-made.added, kind="stable")
    running, total = np.cumsum(made.added[order]), made.added.sum()
    some = f", half of {total:.4f} is by {int(np.searchsorted(running, total / 2)) + 1:,}" if total > 0 else ""
    listed = [(f"  {made.particles[which]}", f"adds {made.added[which]:.3g}") for which in order[:MOST] if made.added[which] > 0]
    return [("particles", f"{len(made.particles):,} met{some}"), *listed]
