r"""Projections: integrals of what particles hold along rays, additive and not normalised.

Flow: particles, camera -> see -> lists of bundles -> sum_columns -> join -> [project] -> Projection.

**Accuracy.** Rays are exact to 1e-5 of each particle's peak in float32 and 1e-13 in float64. Means over pixels are good to 1e-4
of that peak where rays are parallel and no depth cuts the support, and mass in an image is kept to 1e-4, however small supports
are: see `columns`. Else they are those of 3 x 3 rays, good to 3e-4 for supports of 2 pixels or more. Of smaller ones
two things are estimated, while mass is kept: with perspective how it is spread over pixels, by ellipses along the axes; and
where a depth cuts them, as if the share behind it were the same in all pixels.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, TypedDict, Unpack

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsph.analysis.at_places import rounded
from jaxsph.analysis.projection.columns import SHARES, Rule, over_blocks
from jaxsph.analysis.projection.plan import ProjectionPlan, in_common, particles_in, planned, require_pixel
from jaxsph.analysis.projection.seen import Seen
from jaxsph.engine.access.compaction import running_sum
from jaxsph.engine.access.lists import BUNDLE, BundleLists, ListPlan, bundle_origins
from jaxsph.engine.frame.stages import lists_of
from jaxsph.engine.request import digits_to_scale, scaled, times
from jaxsph.engine.runtime.clock import Clock
from jaxsph.engine.runtime.programs import stage
from jaxsph.engine.runtime.tuning import Tuning, cores_at_hand, memory_for, tuning_for
from jaxsph.io.images.planes import told_of
from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.framing import with_depths
from jaxsph.model.particles.columns import Held, held_by, require_usable, unit_held, values_held
from jaxsph.model.particles.field import EvenSamples, ParticleField
from jaxsph.model.particles.particles import Particles
from jaxsph.model.particles.periodic import sees_images
from jaxsph.model.projection import Projection
from jaxsph.model.scene import Scene
from jaxsph.numerics import __version__, faults
from jaxsph.numerics.checks import (
    array_of,
    at_hand,
    at_once,
    in_unit,
    is_traced,
    module_for,
    one_number,
    require_kinds,
    require_plan,
)
from jaxsph.numerics.compiled import ratio
from jaxsph.numerics.faults import CapacityError
from jaxsph.numerics.names import refuse_unknown
from jaxsph.numerics.trees import fitting

ALONG, WEIGHED = ("sum", "mean", "dispersion", "max"), ("mean", "dispersion")
"""What is made of the values along a ray, and which of these need a weight."""
LEAST_PIECE = 64  # particles that pieces of lists have at most, or more: shorter ones cost more than what waits for longer ones
ROUNDING = 16  # eps of a mean square that a variance may be off by: less is that of one value alone


class Called(TypedDict, total=False):
    """What values are called, and their unit."""

    name: str
    unit: str


def project(
    particles: Particles | Scene,
    camera: Camera,
    of: Any = None,
    weight: Any = None,
    *,
    pixel: str = "mean",
    depth_range: tuple[Any, Any] | None = None,
    tolerance: float = 0.0,
    plan: ProjectionPlan | None = None,
    along: str | None = None,
    **labels: Unpack[Called],
) -> Projection:
    r"""Integrate what particles hold along the rays of an image.

    Without a weight a pixel is $\sum_j a_j F_j$: an amount a unit of area, such as a column density where $a_j$ is a mass. $F_j$
    is the integral of the kernel, itself of integral 1, along the ray between two depths, in closed form. With a weight it is the
    mean $\sum_j w_j q_j F_j / \sum_j w_j F_j$, NaN where none is. For $A \rho^n$: `model.particles.columns.emission_measure`.

    Args:
        particles: kernel and supports are theirs; or a scene's, of whose clip (but that of `read_scene(width=)`) those are taken
            whose centres are inside, with all of their supports. For periodic sets see `model.periodic`.
        camera: where from, how large the image is, and the depths that rays begin and end at (`Projection.cut` says what is
            beyond); where they are None, as of `read_scene` with parallel rays, all there is.
        of: numbers of all particles in their order, or `"volume"` or `"quantity"`. Without weight the amounts $a_j$, default the
            volumes (true ones, which give the path length inside); with weight the values $q_j$, default the quantity.
        weight: the weights $w_j$, as for `of`: masses or volumes. Not negative.
        pixel: `"mean"` over its area, by which mass is kept however small a support is; or `"ray"`, the value along that through
            its middle, which misses supports that are smaller.
        depth_range: depths that rays begin and end at, for those of the camera.
        tolerance: what interpolation may be off by, as a share of each particle's peak: supports of many pixels are drawn on
            lattices of fewer, by parallel rays. An estimate, see `columns`; 0 interpolates nothing. A plan has its. Of sums.
        plan: as for `jaxsph.render`, by `jaxsph.plan_projection`; `check()` of what is returned raises faults of `jit`.
        along: `"sum"` or `"mean"`, which `weight` says by itself; `"dispersion"`, the standard deviation by weight, of values
            less the mean of all, $\sqrt{\langle q^2 \rangle - \langle q \rangle^2}$; or `"max"`, the largest value $q_j$ of all
            particles whose supports a ray meets between its depths, NaN where none is: exact, on the host in float64, without
            derivatives. Means over pixels take every support for at least half of a pixel's diagonal then, such that no particle
            lies between rays.
        labels: `name` and `unit` of the values; by default those of `of` and of positions, where these carry one.

    Returns:
        Values in the dtype of the particles, in units of `of`, over length squared without weight; of the largest `weight` is how
        many particles a ray meets.

    Differentiation:
        By positions, supports, `of`, `weight` and the camera, in both modes. Which pixels a particle can touch and by which rule
        is held fixed; there are no second derivatives.

    Raises:
        ValueError: bad data, no such column or rule, depths that do not ascend, a plan for other shapes, values beyond the dtype.
        CapacityError: eager, when a given `plan` is too small.

    References:
        Price 2007, section 4.1 (projection of kernels); Petkova, Laibe & Bonnell 2018 (exact shares of cells).
    """
    refuse_unknown(project, labels, tuple(Called.__annotations__))
    what = of, weight, labels.get("name"), labels.get("unit", "")
    more: dict[str, Any] = {"depth_range": depth_range, "tolerance": tolerance, "plan": plan, "along": along}
    return projected(Clock(), particles, camera, what, pixel=pixel, **more)


def projected(
    clock: Clock,
    particles: Particles | Scene,
    camera: Camera,
    what: tuple[Any, Any, str | None, str],
    *,
    pixel: str = "mean",
    depth_range: tuple[Any, Any] | None = None,
    tolerance: float = 0.0,
    plan: ProjectionPlan | None = None,
    along: str | None = None,
) -> Projection:
    """The same, given a clock that books the seconds of its stages; of what: `of`, `weight`, `name` and `unit`."""
    require_plan("plan", plan, ProjectionPlan, "plan_projection")
    require_kinds(projected, {"pixel": pixel, "tolerance": tolerance, "along": along})
    require_pixel(pixel)
    of, weight, name, unit = what
    if along not in (None, *ALONG) or (along is not None and (weight is None) == (along in WEIGHED)):
        needs = f"{', '.join(ALONG)}; {' and '.join(WEIGHED)} need a `weight`, the others have none"
        raise ValueError(f"`along` must be one of {needs}, got {along!r} {'without' if weight is None else 'with'} a weight")
    if along == "max":
        for asked, value in ("tolerance", tolerance), ("plan", plan):
            if value:
                raise ValueError(f"`{asked}` is of sums along rays, and `along` = 'max' is exact without: leave it out")
        return _largest(particles_in(particles), fitting("camera", camera, Camera), what, pixel, depth_range)
    if along == "dispersion":
        more: dict[str, Any] = {"pixel": pixel, "depth_range": depth_range, "tolerance": tolerance, "plan": plan}
        both = particles_in(particles)
        return _dispersion(lambda of: projected(clock, particles, camera, (of, weight, name, unit), **more), *both, of, weight)
    with at_once(particles, camera, of, weight, depth_range) as traced:
        (whole, particles), camera = particles_in(particles), fitting("camera", camera, Camera)
        camera = _between(camera, depth_range, whole)
        held, unit = held_by(whole, of, weight), unit or unit_held(whole, of, weight)
        sums, word, plan, digits = summed(clock, particles, camera, held.amounts, pixel, tolerance, plan)
        told: dict[str, Any] = {"jaxsph.version": __version__, "jaxsph.pixel": pixel, "jaxsph.kernel": particles.kernel}
        told |= {"jaxsph.tolerance": plan.tolerance(particles.kernel)} if plan.levels else {}
        told |= {} if traced else told_of(camera)
        told |= {"jaxsph.cut": cut} if not traced and (cut := _cut(particles, camera, held)) else {}
        named: dict[str, Any] = {"name": name or held.name, "unit": unit, "length_unit": particles.length_unit or ""}
        return dataclasses.replace(
            _image(sums, held, scaled(camera, digits), digits), faults=word, metadata=tuple(told.items()), **named
        )


def summed(
    clock: Clock,
    particles: Particles,
    camera: Camera,
    amounts: Float[Array, "particles channels"],
    pixel: str,
    tolerance: float = 0.0,
    plan: ProjectionPlan | None = None,
) -> tuple[list[Float[Array, "height width"]], Int[Array, ""], ProjectionPlan, int]:
    """Sums of all pixels, the fault word and the plan; with lengths in a unit that is `2 ** -digits` of what is meant: digits."""
    traced = is_traced(particles, camera, amounts)
    digits = 0 if traced else digits_to_scale(particles, camera)
    given = scaled(particles, digits), amounts, scaled(camera, digits)
    if plan is None and traced:
        raise ValueError("`plan` is needed under jit, vmap or grad; make it outside with `jaxsph.plan_projection`")
    own, machine, seen = plan is not None, particles.support, None
    if plan is None:
        given = in_common(given)
        plan, seen = planned(given, pixel, tolerance, memory_for(machine), clock, tuning_for(machine).common_pairs)
    plan.check(given[0], camera, pixel)
    clock.traced = traced
    sums, word = clock.run(_sums, given, seen, plan, clock)
    if not traced and int(word) & faults.OVERFLOWS and own:
        raise CapacityError("`plan` is too small for these particles: make a new one with `plan_projection`")
    if not traced and int(word):
        require_usable(particles)
        raise ValueError(f"these particles cannot be summed up: {faults.describe(int(word))}")
    return sums, word, plan, digits


def _dispersion(mean_of: Callable[[Any], Projection], whole: Particles, left: Particles, of: Any, weight: Any) -> Projection:
    """Standard deviations by two means along rays: of values less the mean of all, so that little is lost, and of squares."""
    values, weights = values_held(whole, "of", "quantity" if of is None else of), values_held(whole, "weight", weight)
    xp = jnp if is_traced(values, weights, left.valid) else np
    count = xp.where(xp.asarray(left.valid), weights, 0)
    apart = values - (count * xp.where(count > 0, values, 0)).sum() / xp.maximum(count.sum(), np.finfo(np.float32).tiny)
    size = 1.0 if xp is jnp else np.abs(np.where(count > 0, apart, 0)).max() or 1.0  # whose square float32 can hold
    mean, square = mean_of(apart / size), mean_of((apart / size) ** 2)
    xp, (first, second) = at_hand([mean.values, square.values])
    variance = second - first**2
    there = variance > ROUNDING * np.finfo(variance.dtype).eps * second  # NaN where nothing is, no slope where one value is
    spread = xp.where(there, size * xp.sqrt(xp.where(there, variance, 1)), xp.where(xp.isnan(variance), xp.nan, 0))
    spread = spread if xp is jnp else rounded(spread, 0, mean.values.dtype)
    return dataclasses.replace(mean, values=array_of(spread), metadata=(*mean.metadata, ("jaxsph.along", "dispersion")))


def _largest(
    shown: tuple[Particles, Particles], camera: Camera, what: tuple[Any, ...], pixel: str, depth_range: tuple[Any, Any] | None
) -> Projection:
    """See `project`; of a periodic set along an axis of its box what is in one period (host side, float64)."""
    (whole, particles), (of, _, name, unit) = shown, what
    if is_traced(particles, camera, of):
        raise ValueError("`along` = 'max' is found on the host and has no derivatives: call it outside of jit, vmap and grad")
    camera, held = _between(camera, depth_range, whole), held_by(whole, "quantity" if of is None else of, None)
    unit = unit or unit_held(whole, of, of)
    is_boxed = particles.box is not None and sees_images(particles, camera)
    field = ParticleField(particles if is_boxed else particles.wrapped(), is_boxed)
    (near, far), view, support = camera.near_and_far(), camera.exact_view(field.position), field.support
    u, v = camera.exact_rays()
    inside = np.ones((camera.height, camera.width), bool)
    if is_boxed:
        low, high = np.sort(camera.exact_view(np.stack(particles.box.corners())), 0)  # type: ignore[union-attr]
        near, far = max(near, low[2]), min(far, high[2])
        inside = ((v >= low[1]) & (v <= high[1]))[:, None] & (u >= low[0]) & (u <= high[0])
    side = 2 * float(camera.half_height) / camera.height
    if pixel == "mean":
        support = np.maximum(support, math.sqrt(0.5) * side * (view[:, 2] if camera.is_perspective else 1))
    rays = EvenSamples(u, v, near, max(far - near, 0), 1, np.zeros(inside.shape), camera.is_perspective)
    found, number = rays.largest(view, support, np.ldexp(np.float64(held.amounts[:, 0]), held.exponents[0])[field.entry])
    there = inside & (number > 0)
    told = {"jaxsph.version": __version__, "jaxsph.along": "max"} | told_of(camera)
    named: dict[str, Any] = {"name": name or held.name, "unit": unit, "length_unit": particles.length_unit or ""}
    values: Any = rounded(np.where(there, found, np.nan), 0, particles.dtype)
    weight: Any = np.where(there, number, 0).astype(particles.dtype)
    values, weight, area = map(array_of, (values, weight, np.float64(side**2)))
    return Projection(values, weight, area, camera.is_perspective, metadata=tuple(told.items()), **named)


def _between(camera: Camera, depths: tuple[Any, Any] | None, particles: Particles) -> Camera:
    """With the depths that are asked for, or its own; where it has none, those of all there is."""
    if depths is None:
        if any(end is None for end in (camera.near, camera.far)) and not is_traced(particles, camera):
            require_usable(particles)
        camera = with_depths(camera, particles)
        if not is_traced(camera.near, camera.far) and not float(camera.near) < float(camera.far):
            raise ValueError(f"`camera` must have near < far, both finite, got near = {camera.near} and far = {camera.far}")
        return camera
    pair = tuple(depths) if np.iterable(depths) else ()
    near, far = (
        one_number("depth_range", in_unit("depth_range", depth, particles.length_unit))
        for depth in (pair if len(pair) == 2 else (1, 0))
    )
    if not is_traced(near, far) and not (np.isfinite(near) and np.isfinite(far) and float(near) < float(far)):
        raise ValueError(f"`depth_range` must be two finite depths that ascend, got {depths}")
    if camera.is_perspective and not is_traced(near) and not float(near) > 0:
        raise ValueError(f"`depth_range` must begin in front of the eye of a perspective camera, at > 0, got {near}")
    return dataclasses.replace(camera, near=array_of(near, camera.dtype), far=array_of(far, camera.dtype), snug=None)


def _cut(particles: Particles, camera: Camera, held: Held) -> float:
    """Share of what is held by particles in the picture whose middles lie nearer or farther than rays go (host side)."""
    right, up, ahead = camera.exact_axes()
    offset, (near, far) = particles.exact_position() - camera.exact_eye(), camera.near_and_far()
    depth = offset @ ahead
    beyond = (depth < near) | (depth > far)
    if not beyond.any():
        return 0.0
    half = float(camera.half_height) * (depth if camera.is_perspective else 1.0)
    seen = (np.abs(offset @ right) <= half * camera.width / camera.height) & (np.abs(offset @ up) <= half)
    amounts = np.where(seen & np.asarray(particles.valid), np.abs(np.asarray(held.amounts[:, -1], np.float64)), 0)
    return float(amounts[beyond].sum() / (amounts.sum() or 1.0))


def _image(sums: list[Float[Array, "height width"]], held: Held, camera: Camera, digits: int) -> Projection:
    """Amounts, or means of values, where lengths of the camera are in a unit that is `2 ** -digits` of what is meant."""
    area: Any = array_of((2 * module_for(camera).asarray(camera.half_height) / camera.height) ** 2)
    if digits and not camera.is_perspective:
        area = np.float64(area) * 4.0**-digits  # float32 may not hold it
    xp, (values, *weights) = at_hand(sums)
    weight: Any = None
    if held.is_mean:
        (some,) = weights
        values = xp.where(some > 0, ratio(values, some) if xp is jnp else values / np.where(some > 0, some, 1), xp.nan)
        weight = array_of(times(some, held.exponents[1] + 2 * digits))
        if xp is not jnp and some.any() and not float(jnp.finfo(weight.dtype).tiny) <= float(np.asarray(weight).max()) < np.inf:
            weight = np.ldexp(np.asarray(some, np.float64), held.exponents[1] + 2 * digits)
    first = held.exponents[0] + (-held.exponents[1] if held.is_mean else 2 * digits)
    image = Projection(array_of(times(values, first)), weight, area, camera.is_perspective)
    if xp is not jnp and np.asarray(sums[0]).any():
        largest, kind = float(np.nanmax(np.abs(image.values), initial=0)), image.values.dtype
        if not float(jnp.finfo(kind).tiny) <= largest < np.inf:
            beyond = f"{'overflow' if largest else 'underflow'} {kind}: give the amounts in another unit, or all lengths"
            raise ValueError(f"the values of the projection, amounts over a length squared, {beyond}")
    return image


def _sums(
    given: tuple[Any, ...], seen: Seen | None, plan: ProjectionPlan, clock: Clock
) -> tuple[list[Float[Array, "height width"]], Int[Array, ""]]:
    """Sums of all pixels, and the fault word; of what has been seen for the plan, if it was made just now."""
    seen = plan.see(clock, *given) if seen is None else seen
    lists, rules = dict(plan.lists), plan.rules(given[0].kernel, given[2].is_perspective)
    each = zip(rules, seen.spheres, seen.cameras, strict=True)
    followed = [(rule, lists[rule.name], spheres, camera) for rule, spheres, camera in each if rule.name in lists]
    missing = [there for rule, there in zip(rules, seen.there, strict=True) if rule.name not in lists]

    def draw(first_row: Array, nested: bool = False) -> list[tuple[Any, ...]]:
        found = []
        for rule, sizes, spheres, camera in followed:
            if (rule.stride > 1) != nested:
                continue
            made = lists_of(clock, spheres, camera, first_row, sizes, plan.tuning)
            shards = clock.num_shards(min(plan.tuning.max_shards, cores_at_hand(), sizes.num_bundles))
            table = seen.shares if rule.kind == SHARES else seen.rays
            inputs = [(table, made, camera, first_row, nth) for nth in clock.shards(shards)]
            static: dict[str, Any] = {"rule": rule, "lists": sizes, "shards": shards, "tuning": plan.tuning}
            found.append((clock.each("cast", sum_columns, inputs, **static), made.faults))
        return found

    bands = clock.over([nth * plan.band_height for nth in range(plan.bands)], draw)
    found = bands, draw(array_of(0, jnp.int32), True), missing, seen.pixels, seen.faults, seen.cameras[0]
    static = {"of_rules": tuple((rule, sizes) for rule, sizes, *_ in followed), "channels": given[1].shape[1]}
    return clock.one("image", join, found, band_height=plan.band_height, tuning=plan.tuning, **static)  # type: ignore[no-any-return]


@stage("rule", "lists", "shards", widely=True)
def sum_columns(
    table: Float[Array, "particles columns"],
    made: BundleLists,
    camera: Camera,
    first_row: Int[Array, ""],
    nth: Int[Array, ""],
    *,
    rule: Rule,
    lists: ListPlan,
    shards: int,
    tuning: Tuning,
) -> tuple[Int[Array, " bundles"], list[Float[Array, "down across bundles"]]]:
    """Sums over the `nth` of `shards` of the pieces of lists, the longest first, dealt out like cards; and whose they are.

    What is past the last has a sum of 0.
    """
    bundle, begin, length = cut_to_pieces(lists, made)
    chunk = min(rule.chunk(tuning.samples_at_once), -(-len(length) // shards))
    order = jnp.argsort(-length)
    order = jnp.pad(order, (0, -len(length) % (chunk * shards)), constant_values=len(length) - 1)
    mine = order.reshape(-1, shards)[:, nth].reshape(-1, chunk)
    row, column = (one[bundle[mine]][:, None] for one in bundle_origins(lists, first_row))
    at = jnp.asarray(rule.places, camera.dtype)[:, None]
    given = table, rule.rays(camera, column + at, row + at), jnp.stack([camera.near, camera.far])
    sums = over_blocks(rule, given, (made.rank, begin[mine], length[mine]))
    return bundle[mine].ravel(), [jnp.moveaxis(one, 0, -2).reshape(*one.shape[1:3], -1) for one in sums]


def cut_to_pieces(lists: ListPlan, made: BundleLists) -> tuple[Int[Array, " pieces"], ...]:
    """Bundles, and where their lists begin and how long they are, cut such that none is longer than lists are on average.

    A crowded bundle would else keep all waiting that are summed together with it. The last piece is empty.
    """
    length = made.end - made.start
    longest = jnp.maximum(length.sum() // lists.num_bundles + 1, LEAST_PIECE)
    number = (length + longest - 1) // longest
    end, pieces = running_sum(number), jnp.arange(2 * lists.num_bundles + 1, dtype=jnp.int32)
    bundle = jnp.repeat(jnp.arange(lists.num_bundles, dtype=jnp.int32), number, total_repeat_length=len(pieces))
    done = longest * (pieces - (end - number)[bundle])
    return bundle, made.start[bundle] + done, jnp.where(pieces < end[-1], jnp.minimum(length[bundle] - done, longest), 0)


@stage("of_rules", "channels", "band_height", quickly=True)
def join(
    bands: list[list[Any]],
    nested: list[Any],
    missing: list[Bool[Array, ""]],
    pixels: Float[Array, "height width"] | None,
    word: Int[Array, ""],
    camera: Camera,
    *,
    of_rules: tuple[tuple[Rule, ListPlan], ...],
    channels: int,
    band_height: int,
    tuning: Tuning,
) -> tuple[list[Float[Array, "height width"]], Int[Array, ""]]:
    """The image of what `sum_columns` has of all bands, rules and shards, by channels; and all faults.

    `missing`: whether anybody follows a rule without room.
    """

    def image(found: list[Any], stride: bool, height: int, k: int) -> Array:
        total = jnp.zeros((height, camera.width), camera.dtype)
        for (rule, lists), (shards, _) in zip([one for one in of_rules if (one[0].stride > 1) == stride], found, strict=True):
            pixels = jnp.concatenate([sums[k] for _, sums in shards], -1)
            bundle = jnp.concatenate([bundles for bundles, _ in shards])
            placed = jnp.zeros((lists.num_bundles + 1, BUNDLE, BUNDLE), pixels.dtype).at[bundle].add(jnp.moveaxis(pixels, -1, 0))
            total += rule.interpolated(lists.as_image(placed[:-1]), height, camera.width)
        return total

    of_bands = [jnp.concatenate([image(one, False, band_height, k) for one in bands])[: camera.height] for k in range(channels)]
    images = [plain + image(nested, True, camera.height, k) if nested else plain for k, plain in enumerate(of_bands)]
    words = [fault for found in (*bands, nested) for _, fault in found]
    lost = functools.reduce(jnp.logical_or, missing, jnp.zeros((), bool))
    word = functools.reduce(jnp.bitwise_or, words, word) | faults.raised(faults.LIST_OVERFLOW, lost)
    return images if pixels is None else [one * pixels for one in images], word
