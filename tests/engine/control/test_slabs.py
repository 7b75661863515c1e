"""Painted slabs change no pixel by more than is said, whichever are painted; a band is looked at where that pays."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adversary import cameras, numbers, scenes
from derivatives import QUICKLY
from examples import examples
from hypothesis import currently_in_test_context, given, strategies as st, target

import jaxsph as js
from jaxsph.engine.access.compaction import compact
from jaxsph.engine.access.extremes import window_extremes
from jaxsph.engine.access.grid import some_of_grid
from jaxsph.engine.cast.march import CastMethod, cast
from jaxsph.engine.control.allocation import rounding_of
from jaxsph.engine.control.bounds import spheres
from jaxsph.engine.control.coverage import covered_slabs
from jaxsph.engine.control.decide import Limits, at_full_rate
from jaxsph.engine.control.errors import SUPER_PIXEL
from jaxsph.engine.control.slabs import (
    FEW,
    FEWEST,
    LEAST_OF_ALL,
    ONE_OF,
    SlabRanges,
    decide_by_slabs,
    find_radii,
    forecast,
    slab_errors,
    survey,
)
from jaxsph.engine.field.tasks import Painting, painted_over
from jaxsph.engine.media.shown import Shown
from jaxsph.engine.screen.packets import every_bundle
from jaxsph.model.settings import integrator_of
from jaxsph.numerics.checks import array_of


@functools.partial(jax.jit, static_argnames=("plan", "kernel", "few"), compiler_options=QUICKLY)
def painted(scene, camera, grid, wished, fineness, *, plan, kernel, few):
    """Pixels at full rate and with some slabs painted, how much they are said to differ, and which slabs those are."""
    slab_samples, transfer, tuning = plan.cast.slab_samples, scene.transfer, plan.cast.tuning
    schedule, _ = at_full_rate(grid, transfer, slab_samples)
    filled, balls = compact(schedule.filled), spheres(grid.ordered)
    covered = covered_slabs(grid, balls, camera, filled.item, filled.start[-1], slab_samples)
    extremes = [window_extremes(quantity, grid.lists, grid.windows) for quantity in grid.ordered.quantities]

    def bounds(_, slab, bundle):
        return [(least[slab, bundle], greatest[slab, bundle]) for least, greatest in extremes], covered[slab, bundle]

    limits = Limits(fineness, jnp.zeros_like(fineness))
    look, at_once = SlabRanges(bounds, few), tuning.slabs_bounded
    errors = slab_errors(grid, balls, camera, transfer, schedule, schedule.filled, look, limits, slab_samples, at_once)
    error, paint = errors.error.slabs[0], errors.paint[:, 0]
    here = wished & (error < jnp.inf)
    method = CastMethod(kernel, plan.cast, integrator_of(plan.integrator), every_bundle)

    def pixels(here):
        rays = cast(grid, painted_over(schedule, Painting(here, paint)), Shown(camera, transfer), method)
        return jnp.concatenate([rays.color, 1 - rays.transmittance[None]])

    exact, found = jax.lax.map(pixels, jnp.stack([jnp.zeros_like(here), here]))
    rounding = rounding_of(schedule.filled.sum(0), error.dtype)
    return exact, found, jnp.where(here, error, 0).sum(0) + rounding * here.any(0), here


@pytest.mark.parametrize(("kernel", "projection", "dtype", "few"), [
    pytest.param("poly6", "perspective", np.float64, 0, marks=pytest.mark.core),
    ("cubic_spline", "orthographic", np.float64, FEW),
    pytest.param("wendland_c2", "perspective", np.float32, 0, marks=pytest.mark.slow),
    pytest.param("poly6", "orthographic", np.float32, 0, marks=pytest.mark.slow),
])  # fmt: skip
def test_errors_of_any_painted_slabs_are_bounds(stages, frames, kernel, projection, dtype, few):
    frames = frames.deep(4)
    plan, met = frames.plan(4), 0

    def holds(scene, camera, drawn, fineness):
        nonlocal met
        grid, _ = stages(scene.particles, camera, plan=plan)
        wished = np.resize(drawn, grid.windows.count.shape) < 0.7
        fineness = np.asarray(fineness, dtype)
        exact, found, off, here = map(
            np.asarray, painted(scene, camera, grid, wished, fineness, plan=plan, kernel=kernel, few=few)
        )
        error = np.abs(found - exact).max((0, 2, 3))
        if currently_in_test_context():
            target(float((error - off).max()))
        assert (error <= off).all(), f"{error[error > off]} > {off[error > off]}"
        met += int(here.sum())

    with jax.enable_x64(dtype is np.float64):
        rounded = st.sampled_from([0.0, 0.004, 0.5])
        examples(20)(given(scenes(kernel, dtype), cameras(frames, projection, dtype), numbers(7, 31), rounded)(holds))()
        assert met > 100


@pytest.mark.core
@pytest.mark.parametrize(("spread", "dtype"), [(0.0, np.float32), (1.0, np.float32), (0.0, np.float64)])
def test_a_band_is_looked_at_where_it_pays(stages, frames, spread, dtype):
    """It is where all particles are alike, and is not where quantities vary from one to the next."""
    alike, frames = spread == 0, frames.deep(4)
    with jax.enable_x64(dtype is np.float64):
        rng, plan = np.random.default_rng(2), frames.plan(4)
        scene, camera = frames.scene(rng, decades=0.1, dtype=dtype), frames.camera(rng, dtype=dtype)
        quantity = 0.5 + spread * (np.arange(24) % 2 - 0.5)
        particles = dataclasses.replace(scene.particles, support=array_of(3 * np.asarray(scene.particles.support), dtype))
        particles = dataclasses.replace(particles, quantity=array_of(quantity, dtype))
        transfer = js.TransferFunction.from_points(*map(dtype, ([0.0, 1.0], [[0, 0, 0], [1, 1, 1]], [0.4, 0.6])))
        grid, _ = stages(particles, camera, plan=plan)
        limits, shown = Limits(dtype(0.02), dtype(0)), Shown(camera, transfer)
        sizes = {"slab_samples": 4, "tuning": plan.cast.tuning}
        all_of_it = {"shards": 1, "allocation": "budget", **sizes}

        @jax.jit
        def look(grid):
            """What is expected, what is found of the band, and what is decided."""
            radii = find_radii.__wrapped__(grid.ordered, tuning=plan.cast.tuning)
            ahead = forecast.__wrapped__(grid, radii, shown, limits, np.int32(0), **all_of_it)
            by_lists, by_voxels = (
                survey.__wrapped__(grid, radii, shown, (ahead,), np.bool_(of_voxels), **sizes) for of_voxels in (False, True)
            )
            seen = by_lists._replace(covered=by_voxels.covered)
            decided = decide_by_slabs.__wrapped__(grid, radii, shown, limits, seen, np.int32(0), **all_of_it)
            return ahead, by_lists, by_voxels, decided.levels, decided.bound

        ahead, by_lists, by_voxels, levels, bound = look(grid)
        assert (ahead.saved / ahead.full > LEAST_OF_ALL) == alike
        assert [bool(found.pays) for found in (by_lists, by_voxels)] == [alike, alike]
        assert [np.asarray(found.covered).any() for found in (by_lists, by_voxels)] == [False, alike]
        assert [np.asarray(found.extremes[0][0]).any() for found in (by_lists, by_voxels)] == [alike, False]
        assert (np.asarray(levels) == SUPER_PIXEL).any() == alike and bound.dtype == dtype


def test_a_forecast_is_the_same_however_a_band_is_dealt(stages, frames):
    """Shards look at parts of the same bundles, also of numbers that nothing divides."""
    rng, frames = np.random.default_rng(2), frames.deep(4)
    scene, camera, plan = frames.scene(rng, decades=0.1), frames.camera(rng), frames.plan(4)
    particles = dataclasses.replace(scene.particles, support=array_of(3 * np.asarray(scene.particles.support)))
    grid, _ = stages(particles, camera, plan=plan)
    at = np.arange(2 * ONE_OF * FEWEST + 3) % grid.row.shape[0]
    limits, sizes = Limits(np.float32(0.02), np.float32(0)), {"slab_samples": 4, "tuning": plan.cast.tuning}

    @jax.jit
    def saved(grid):
        """By all at once, and by four shards."""
        many, shown = some_of_grid(grid, at, np.ones(at.shape, bool)), Shown(camera, scene.transfer)
        radii = find_radii.__wrapped__(grid.ordered, tuning=plan.cast.tuning)

        def look(shards):
            dealt = functools.partial(forecast.__wrapped__, shards=shards, allocation="budget", **sizes)
            found = jax.lax.map(lambda nth: dealt(many, radii, shown, limits, nth), np.arange(shards, dtype=np.int32))
            return [value.sum() for value in found]

        return look(1), look(4)

    one, four = saved(grid)
    assert one[0] > 0
    np.testing.assert_allclose(one, four, rtol=1e-6)
