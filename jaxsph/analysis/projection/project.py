r"""Projections: integrals of what particles hold along rays, additive and not normalised.

Flow: particles, camera -> place -> lists of bundles -> column_sums -> [project] -> Projection.

**Accuracy.** Rays are exact to 1e-5 of each particle's peak in float32 and 1e-13 in float64. A mean over a pixel is good to 1e-4
of that peak where rays are parallel and no depth cuts the support, by shares of the whole column that add up: mass in an image is
kept to 1e-4, however small supports are. Else it is that of 3 x 3 rays, good to 3e-4 for supports of at least 2 pixels. Of
smaller ones two things are estimated, while their mass is kept: with perspective, by ellipses along the axes, how it is spread
over pixels; and where a depth cuts them, as if the share behind it were the same in all pixels.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.analysis.projection.column_sums import ColumnInputs, ColumnMethod, column_sums, pixels_of, subrays_of
from jaxsph.analysis.projection.columns import depth_share
from jaxsph.analysis.projection.pixel_lists import Placed, footprints, place
from jaxsph.analysis.projection.plan import SHARES, WANTED, ProjectionPlan, beside, plan_projection
from jaxsph.engine.access.lists import BUNDLE, ListPlan, build_lists, bundle_origins
from jaxsph.engine.lengths import digits_to_scale, scaled, scaled_camera, times
from jaxsph.engine.runtime.executors import Clock
from jaxsph.io.images.fits import middle_of
from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.snug import with_depths
from jaxsph.model.particles.held import Held, held_by, unit_held
from jaxsph.model.particles.particles import Particles
from jaxsph.model.particles.periodic import between_faces, past_faces, runs_through, with_sources
from jaxsph.model.projection import Projection
from jaxsph.numerics import faults
from jaxsph.numerics.checks import array_of, as_usual, at_once, is_traced, module_for, require_plan
from jaxsph.numerics.extremes import ratio
from jaxsph.numerics.faults import CapacityError
from jaxsph.numerics.fusion import barriers
from jaxsph.numerics.given import in_unit
from jaxsph.numerics.trees import fitting
from jaxsph.numerics.version import __version__


def project(
    particles: Particles,
    camera: Camera,
    of: Any = None,
    weight: Any = None,
    *,
    pixel: str = "mean",
    depth_range: tuple[Any, Any] | None = None,
    plan: ProjectionPlan | None = None,
    name: str | None = None,
    unit: str = "",
    clock: Clock | None = None,
) -> Projection:
    r"""Integrate what particles hold along the rays of an image.

    Without a weight a pixel is $\sum_j a_j F_j$: an amount a unit of area, such as a column density where $a_j$ is a mass. $F_j$
    is the integral of the kernel, itself of integral 1, along the ray between two depths, in closed form. With a weight it is the
    mean $\sum_j w_j q_j F_j / \sum_j w_j F_j$, NaN where none is. For $A \rho^n$: `model.particles.held.emission_measure`.

    Args:
        particles: kernel and supports are theirs; nothing is normalised. For periodic sets see `model.periodic`.
        camera: where from, how large the image is, and the depths that rays begin and end at; where they are None, all there is.
        of: numbers of all particles in their order, or `"volume"` or `"quantity"`. Without weight the amounts $a_j$, default the
            volumes (true ones, which give the path length inside); with weight the values $q_j$, default the quantity.
        weight: the weights $w_j$, as for `of`: masses or volumes. Not negative.
        pixel: `"mean"` over its area, by which mass is kept however small a support is; or `"ray"`, the value along that through
            its middle, which misses supports that are smaller.
        depth_range: depths that rays begin and end at, for those of the camera.
        plan: as for `jaxsph.render`, by `jaxsph.plan_projection`; `check()` of what is returned raises faults of `jit`.
        name, unit: what values are called, and their unit: by default that of `of` and of positions, where these carry one.
        clock: that books the seconds of compiling and of casting apart; eager only.

    Returns:
        Values in the dtype of the particles, in units of `of`, over length squared without weight.

    Differentiation:
        By positions, supports, `of`, `weight` and the camera, in both modes. Which pixels a particle can touch and by which rule
        is held fixed; there are no second derivatives.

    Raises:
        ValueError: bad data, no such column or rule, depths that do not ascend, a plan for other shapes, values beyond the dtype.
        CapacityError: eager, when a given `plan` is too small.

    References:
        Price 2007, section 4.1 (projection of kernels); Petkova, Laibe & Bonnell 2018 (exact shares of cells).
    """
    require_plan("plan", plan, ProjectionPlan, "plan_projection")
    with as_usual() if (traced := is_traced(particles, camera, of, weight, depth_range)) else at_once():
        particles, camera = fitting("particles", particles, Particles), fitting("camera", camera, Camera)
        camera = with_depths(_between(camera, depth_range, particles.length_unit), particles)
        held, unit = held_by(particles, of, weight), unit or unit_held(particles, of, weight)
        digits = 0 if traced else digits_to_scale(particles, camera)
        given = scaled(particles, digits), held.amounts, scaled_camera(camera, digits)
        planned, plan = plan is None, plan or _planned(given[0], given[2], pixel, traced)
        plan.check(particles, camera, pixel)
        sums, word = _sums(*given, plan=plan) if traced else _eagerly(given, plan, planned, clock)
        named: dict[str, Any] = {"name": name or held.name, "unit": unit, "length_unit": particles.length_unit or ""}
        told = {"jaxsph.version": __version__, "jaxsph.pixel": pixel, "jaxsph.kernel": particles.kernel}
        told |= {} if traced else {"jaxsph.camera": camera.describe(), "jaxsph.middle": "{!r} {!r}".format(*middle_of(camera))}
        return dataclasses.replace(_image(sums, held, given[2], digits), faults=word, metadata=tuple(told.items()), **named)


def _eagerly(given: tuple[Any, ...], plan: ProjectionPlan, planned: bool, clock: Clock | None) -> tuple[Any, Any]:
    """Sums by programs that are kept, and no fault that was left unsaid."""
    sums, word = (clock or Clock()).one("cast", _sums_at_once, given, plan=plan)
    if int(word) & faults.OVERFLOWS and not planned:
        raise CapacityError("`plan` is too small for these particles: make a new one with `plan_projection`")
    if int(word):
        raise ValueError(f"these particles cannot be projected: {faults.describe(int(word))}")
    return sums, word


def _planned(particles: Particles, camera: Camera, pixel: str, traced: bool) -> ProjectionPlan:
    if traced:
        raise ValueError("`plan` is needed under jit, vmap or grad; make it outside with `jaxsph.plan_projection`")
    return plan_projection(particles, camera, pixel=pixel)


def _between(camera: Camera, depths: tuple[Any, Any] | None, unit: str | None) -> Camera:
    if depths is None:
        return camera
    near, far = (in_unit("depth_range", depth, unit) for depth in depths)
    if not is_traced(near, far) and not (np.isfinite(near) and np.isfinite(far) and float(near) < float(far)):
        raise ValueError(f"`depth_range` must be two finite depths that ascend, got ({near}, {far})")
    if camera.is_perspective and not is_traced(near) and not float(near) > 0:
        raise ValueError(f"`depth_range` must begin in front of the eye of a perspective camera, at > 0, got {near}")
    return dataclasses.replace(camera, near=array_of(near, camera.dtype), far=array_of(far, camera.dtype))


def _image(sums: Float[Array, "height width channels"], held: Held, camera: Camera, digits: int) -> Projection:
    """Amounts, or means of values, where lengths of the camera are in a unit that is `2 ** -digits` of what is meant."""
    area: Any = array_of((2 * module_for(camera).asarray(camera.half_height) / camera.height) ** 2)
    if digits and not camera.is_perspective:
        area = np.float64(area) * 4.0**-digits  # float32 may not hold it
    values, weight = sums[..., 0], None
    if held.is_mean:
        weight = sums[..., 1]
        values = jnp.where(weight > 0, ratio(values, weight), jnp.nan)
        weight = times(weight, held.exponents[1] + 2 * digits)
    first = held.exponents[0] + (-held.exponents[1] if held.is_mean else 2 * digits)
    image = Projection(times(values, first), weight, area, camera.is_perspective)
    if digits:
        _require_held(image, sums)
    return image


def _require_held(image: Projection, sums: Array) -> None:
    """Raise where amounts over a length squared are no numbers of the dtype, though there are some."""
    amounts = {"values": image.values} if image.weight is None else {"weight": image.weight}
    for name, found in amounts.items():
        largest = float(jnp.max(jnp.abs(found)))
        if bool((sums[..., -1] != 0).any()) and not float(jnp.finfo(found.dtype).tiny) <= largest < np.inf:
            what = "overflow" if largest else "underflow"
            raise ValueError(
                f"`{name}` of the projection, amounts over a length squared, {what} {found.dtype}: give the amounts in "
                "another unit, or positions, supports and camera in a larger or smaller one"
            )


class _Rule(NamedTuple):
    """Particles that follow a rule, as a table, and where they can be."""

    method: ColumnMethod
    lists: ListPlan
    table: Float[Array, "particles columns"]
    footprints: Any


def _sums(
    particles: Particles, amounts: Float[Array, "particles channels"], camera: Camera, *, plan: ProjectionPlan
) -> tuple[Float[Array, "height width channels"], Int[Array, ""]]:
    """Sums of all pixels, and the fault word."""
    with barriers(plan.tuning.fusion_barriers):
        dtype = jnp.promote_types(particles.dtype, camera.dtype)
        camera = jax.tree.map(lambda leaf: leaf.astype(dtype), camera)
        particles, amounts, camera, pixels, crowded = _shown(particles, amounts, camera, plan)
        placed = place(particles, camera)
        amounts = jnp.where(placed.live[:, None], amounts, 0).astype(dtype)
        word = placed.faults | faults.raised(faults.BAD_PARTICLES, ~jnp.isfinite(amounts).all())
        rules, missing = [], jnp.zeros((), bool)
        for subrays, lists in plan.rules:
            wanted = WANTED[subrays](placed)
            if lists is None:
                missing |= wanted.any()
                continue
            made = _shares_table if subrays == SHARES else _rays_table
            method = ColumnMethod(
                particles.kernel, camera.is_perspective, subrays == SHARES, max(subrays, 1), plan.chunk(subrays)
            )
            table = jnp.where(wanted[:, None], made(placed, amounts, camera, particles.kernel), 0)
            rules.append(_Rule(method, lists, table, footprints(placed, camera, wanted, beside(subrays))))
        found, word_of_lists = _in_bands(rules, camera, plan, amounts.shape[1])
        found = found if pixels is None else found * pixels[..., None]
        return found, word | crowded | word_of_lists | faults.raised(faults.LIST_OVERFLOW, missing)


_sums_at_once = functools.partial(jax.jit, static_argnames="plan")(_sums)


def _shown(
    particles: Particles, amounts: Array, camera: Camera, plan: ProjectionPlan
) -> tuple[Particles, Array, Camera, Float[Array, "height width"] | None, Int[Array, ""]]:
    """Of a periodic set what its box holds, what share of each pixel that is, and faults; else all there is."""
    if plan.images is None or particles.box is None:
        return particles.wrapped(), amounts, camera, None, jnp.int32(faults.NONE)
    seen, pixels = between_faces(camera, particles.box, plan.pixel)
    found, source, word = with_sources(particles, plan.images, through=plan.through)
    if plan.through is not None:
        word |= faults.raised(faults.LIST_OVERFLOW, ~runs_through(camera, particles.box, plan.through))
        seen = past_faces(camera, particles.box)
    return found, amounts[source], seen, pixels, word


def _in_bands(rules: list[_Rule], camera: Camera, plan: ProjectionPlan, channels: int) -> tuple[Array, Array]:
    def one(band: Int[Array, ""]) -> tuple[Array, Array]:
        first_row = band * plan.band_height
        total, word = jnp.zeros((plan.band_height, camera.width, channels), camera.dtype), jnp.int32(faults.NONE)
        for rule in rules:
            found, of_lists = _of_rule(rule, camera, first_row)
            total, word = total + found[:, : camera.width], word | of_lists
        return total, word

    if plan.bands == 1:
        image, word = one(jnp.int32(0))
        return image[: camera.height], word
    images, words = lax.map(jax.checkpoint(one, prevent_cse=False), jnp.arange(plan.bands, dtype=jnp.int32))
    return images.reshape(-1, camera.width, channels)[: camera.height], jnp.bitwise_or.reduce(words)


def _of_rule(rule: _Rule, camera: Camera, first_row: Array) -> tuple[Array, Array]:
    """Pixels of a band, by one of the rules."""
    method, lists = rule.method, rule.lists
    made = lax.stop_gradient(build_lists(rule.footprints, lax.stop_gradient(camera), lists, first_row))
    row, column = bundle_origins(lists, first_row)
    if method.shares:
        at = jnp.arange(BUNDLE + 1, dtype=camera.dtype)
    else:
        at = jnp.asarray(np.arange(BUNDLE)[:, None] + subrays_of(method.subrays)[0], camera.dtype).ravel()
    across, down = camera.column(column[:, None] + at), camera.row(row[:, None] + at)
    inputs = ColumnInputs(rule.table, across, down, jnp.stack([camera.near, camera.far]))
    sums = column_sums(method, inputs, made)
    return lists.as_image(pixels_of(sums, 1 if method.shares else method.subrays)), made.faults


def _rays_table(placed: Placed, amounts: Array, camera: Camera, kernel: str) -> Array:
    """Places and reciprocal supports, and amounts a unit of area of the support."""
    inverse = 1 / placed.support[:, None]
    return jnp.concatenate([placed.view, inverse, amounts * inverse * inverse], 1)


def _shares_table(placed: Placed, amounts: Array, camera: Camera, kernel: str) -> Array:
    """Ray coordinates of centres and reciprocals of supports in them, and amounts a unit of area of a pixel.

    With perspective a small support is an ellipse in ray coordinates, of an area that is larger by the slant of its ray.
    """
    x, y, z = (placed.view[:, k] for k in range(3))
    inverse, pixel = 1 / placed.support, 2 * camera.half_height / camera.height
    inside = depth_share(kernel, (camera.near - z) * inverse, (camera.far - z) * inverse)
    wide, high, area = inverse, inverse, pixel
    if camera.is_perspective:
        z = jnp.where(placed.small, z, 1)
        x, y = x / z, y / z
        wide, high = z * inverse / jnp.sqrt(1 + x * x), z * inverse / jnp.sqrt(1 + y * y)
        area = pixel * z / (1 + x * x + y * y) ** 0.25
    of_area = amounts * (inside / area / area)[:, None]
    return jnp.concatenate([jnp.stack([x, y, wide, high], 1), of_area], 1)
