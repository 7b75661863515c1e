"""Bundle bounds always enclose sampled pixels; errors are no more than analysed, and relaxed where nothing is partly empty."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adversary import cameras, scenes
from derivatives import QUICKLY
from examples import examples
from hypothesis import currently_in_test_context, given, strategies as st, target

import jaxsph as js
from jaxsph.engine.access.grid import CELL_SAMPLES, MAX_LEVEL, by_slab, coarser_windows, find_slab_windows
from jaxsph.engine.cast.march import CastMethod, cast
from jaxsph.engine.control.adapt import coarse_schedule, merged_levels
from jaxsph.engine.control.allocation import bound, rounding_of
from jaxsph.engine.control.bounds import SampleBounds, tables_of_parts
from jaxsph.engine.control.decide import Limits
from jaxsph.engine.control.errors import EXPONENTIAL, SUPER_PIXEL, analyse, cell_errors
from jaxsph.engine.control.intervals import bounds_of_cells, composited, rays_of_bundles
from jaxsph.engine.field.tasks import Painting
from jaxsph.engine.media.shown import Shown
from jaxsph.engine.screen.packets import every_bundle
from jaxsph.model.settings import integrator_of
from jaxsph.numerics.checks import array_of

BUNDLES = 64
errors_of = jax.jit(functools.partial(cell_errors, fitting=2), compiler_options={"xla_backend_optimization_level": 0})


def found(relax):
    """Cells whose samples are all touched and covered, some in part empty, some with slabs that nothing touches."""
    rng = np.random.default_rng(0)
    shape = (CELL_SAMPLES, BUNDLES)
    touched = rng.uniform(size=shape) < np.where(np.arange(BUNDLES) % 4 == 3, 0.8, 1)
    covered = touched & (rng.uniform(size=shape) < np.where(np.arange(BUNDLES) % 4 == 1, 0.8, 1))
    low = [rng.uniform(0, 0.5, shape) for _ in range(4)]
    high = [value + rng.uniform(0, 0.3, shape) for value in low]
    low, high = ([np.float32(value) for value in side] for side in (low, high))
    bounds = SampleBounds(touched, covered, low, high)
    borders = np.tile(np.linspace(1, 2, CELL_SAMPLES + 1, dtype=np.float32)[:, None], BUNDLES)
    path, none = np.ones(BUNDLES, np.float32), np.zeros(BUNDLES, np.float32)
    errors = errors_of(bounds, borders, path, path, (none, none), Limits(np.float32(0.01), np.float32(relax)))
    return np.asarray(errors.error.levels), np.asarray(errors.strict), (covered | ~touched).all(0)


def test_cells_that_may_be_partly_empty_are_never_relaxed():
    error, strict, whole = found(1.0)
    assert 0 < whole.sum() < BUNDLES
    np.testing.assert_array_equal(error[:, ~whole], strict[:, ~whole])
    assert (error <= strict).all() and (error[:, whole] < strict[:, whole]).any()


def test_without_relaxation_errors_are_strict_and_grow_with_the_level():
    error, strict, _ = found(0.0)
    np.testing.assert_array_equal(error, strict)
    assert not error[0].any() and (np.diff(error, axis=0) >= 0).all()


@pytest.mark.slow
def test_the_exponential_is_as_exact_as_certificates_take_it_to_be():
    """For every float32 from 2^-25 to 2^7: certificates rest on XLA's polynomial, which may change with its version."""
    exponential, worst = jax.jit(lambda thickness: jnp.exp(-thickness)), 0.0
    first, last = (int(np.float32(end).view(np.int32)) for end in (2.0**-25, 2.0**7))
    for begin in range(first, last, 1 << 22):
        thickness = np.arange(begin, min(begin + (1 << 22), last), dtype=np.int32).view(np.float32)
        exact = np.exp(-thickness.astype(np.float64))
        worst = max(worst, float(np.abs(np.asarray(exponential(thickness)) - exact).max()))
    assert worst / np.finfo(np.float32).eps <= EXPONENTIAL - 0.6  # the rest is for three half ulp of its argument


CANDIDATES = range(SUPER_PIXEL + 1)


@dataclasses.dataclass(frozen=True)
class Looked:
    """Pixels at full rate and at some levels, how much they are said to differ, and brackets of both: by both forms at levels."""

    exact: jax.Array
    found: jax.Array
    bracket: tuple[jax.Array, jax.Array]
    of_paper: tuple[jax.Array, jax.Array]
    at_full_rate: tuple[jax.Array, jax.Array]
    off: jax.Array
    levels: jax.Array
    filled: jax.Array


jax.tree_util.register_dataclass(Looked, data_fields=[field.name for field in dataclasses.fields(Looked)], meta_fields=[])


@functools.partial(jax.jit, static_argnames=("plan", "kernel"), compiler_options=QUICKLY)
def look(scene, camera, frame, wished, fineness, *, plan, kernel):
    grid, reference = frame
    slab_samples, number = plan.cast.slab_samples, wished.shape[0]
    windows, beside = coarser_windows(grid.windows), find_slab_windows(grid.ordered, grid.lists, beside=True)
    filled, free = (filled_cells(slabs, slab_samples, number) for slabs in (grid.windows, beside))
    whole, free = ((jnp.arange(number) + 1) * CELL_SAMPLES <= plan.samples)[:, None], ~free
    levels = merged_levels(jnp.where(whole & filled, wished, 0), free & whole, slab_samples)
    tables, limits = tables_of_parts(scene.transfer), Limits(fineness, jnp.zeros((), reference[0].dtype))
    sizes = slab_samples, 2, plan.cast.tuning.cells_bounded
    analysis = analyse(grid, beside, camera, reference, filled, tables, limits, *sizes)
    method = CastMethod(kernel, plan.cast, integrator_of(plan.integrator), every_bundle)

    def pixels(levels):
        here = jnp.repeat(levels == SUPER_PIXEL, CELL_SAMPLES // slab_samples, 0)
        schedule = coarse_schedule(windows, levels, reference, Painting(here, by_slab(analysis.paint)), slab_samples)
        rays = cast(grid, schedule, Shown(camera, scene.transfer), method)
        return jnp.concatenate([rays.color, 1 - rays.transmittance[None]])

    exact, found = jax.lax.map(pixels, jnp.stack([jnp.zeros_like(levels), levels]))
    rounding = 2 * jnp.finfo(reference[0].dtype).eps * CELL_SAMPLES * (filled.sum(0) + 1)
    final = jnp.where(filled, levels, 0)
    off, _ = bound(analysis.error, final, jnp.broadcast_to(final == SUPER_PIXEL, analysis.tau_lo.shape), rounding)
    return Looked(exact, found, *brackets(grid, beside, camera, scene.transfer, levels, slab_samples), off, levels, filled)


def brackets(grid, beside, camera, transfer, levels, slab_samples):
    """Bounds of the pixels of bundles: at levels by the lerp form, by the paper's, and at full rate."""
    cells, rays, live = levels.shape[0], rays_of_bundles(grid, camera), grid.ordered.live
    borders = grid.borders(cells * CELL_SAMPLES)
    # merged cells share what their sums are taken relative to
    ends = [(jnp.where(live, one, jnp.inf).min(), jnp.where(live, one, -jnp.inf).max()) for one in grid.ordered.quantities]
    ends = jax.tree.map(lambda end: jnp.broadcast_to(end, levels.shape), ends)
    depths, how = (borders[:-1], borders[1:]), {"slab_samples": slab_samples, "subdivisions": 2, "cells_at_once": 64}
    bounds = bounds_of_cells(grid, beside, depths, rays, ends, transfer, perspective=camera.is_perspective, **how)
    # a super-pixel is a sample as long as a cell, of colours within all ranges: as one of the coarsest level
    at_levels = [composited(bounds, borders, rays, jnp.minimum(levels, MAX_LEVEL), form=form) for form in ("lerp", "paper")]
    at_full_rate = composited(bounds, borders, rays)
    rounding = 0.5 * rounding_of(jnp.full(levels.shape[1], cells), borders.dtype)
    return [(lower - rounding, upper + rounding) for lower, upper in (*at_levels, at_full_rate)]


def filled_cells(slabs, slab_samples, number):
    """Which cells have particles in any of their slabs, (cells, bundles)."""
    of_slabs = jnp.pad(slabs.count, ((0, number * CELL_SAMPLES // slab_samples - slabs.count.shape[0]), (0, 0)))
    return of_slabs.reshape(number, -1, of_slabs.shape[1]).any(1)


def looked(stages, scene, camera, wished, plan, fineness=0.0):
    """`fineness`: of paints, a tolerance that they are rounded for."""
    frame = stages(scene.particles, camera, plan=plan)
    fineness = np.asarray(fineness, np.asarray(scene.particles.support).dtype)
    return jax.tree.map(np.asarray, look(scene, camera, frame, wished, fineness, plan=plan, kernel=scene.particles.kernel))


def wishes(cells, bundles):
    """A level for each bundle, but for a few cells."""
    every, few = st.sampled_from(CANDIDATES), st.dictionaries(st.integers(0, cells - 1), st.sampled_from(CANDIDATES), max_size=3)

    def table(of_bundles, of_cells):
        rows = np.full(cells, SUPER_PIXEL)
        rows[list(of_cells)] = list(of_cells.values())
        return np.minimum(rows[:, None], np.array(of_bundles)).astype(np.int32)

    return st.builds(table, st.lists(every, min_size=bundles, max_size=bundles), few)


def seen_whole(frames, kernel, projection, dtype):
    """A frame that particles fill, and a level for every bundle, one after the other."""
    rng = np.random.default_rng(0)
    scene, camera = frames.scene(rng, kernel, decades=0.3, dtype=dtype), frames.camera(rng, projection, dtype=dtype)
    particles = dataclasses.replace(scene.particles, support=array_of(2 * np.asarray(scene.particles.support)))
    return dataclasses.replace(scene, particles=particles), camera


@pytest.mark.parametrize(("kernel", "slab_samples", "projection", "dtype"), [
    ("poly6", 4, "perspective", np.float64),
    pytest.param("wendland_c2", 16, "orthographic", np.float32, marks=pytest.mark.slow),
    pytest.param("cubic_spline", 8, "perspective", np.float64, marks=pytest.mark.slow),
    pytest.param("wendland_c2", 8, "perspective", np.float32, marks=pytest.mark.slow),
    pytest.param("poly6", 4, "orthographic", np.float32, marks=pytest.mark.slow),
])  # fmt: skip
def test_bundle_bounds_enclose_pixels_and_errors_keep_to_theirs(stages, frames, kernel, slab_samples, projection, dtype):
    """At any levels. Where a level is within t of full rate, their brackets are no farther apart than t."""
    frames = frames.deep(slab_samples)
    plan = frames.plan(slab_samples)
    cells, bundles, met = -(-frames.samples // CELL_SAMPLES), plan.lists.num_bundles, set()

    def holds(scene, camera, wished, fineness):
        found = looked(stages, scene, camera, wished, plan, fineness)
        for pixels, bracket, room in ((found.found, found.bracket, fineness / 256), (found.exact, found.at_full_rate, 0)):
            lower, upper = (side[..., None, None] for side in bracket)
            assert (lower - room <= pixels).all() and (pixels <= upper + room).all()
        lerp, of_paper = (upper - lower for lower, upper in (found.bracket, found.of_paper))
        assert (lerp <= of_paper + 1e3 * np.finfo(dtype).eps).all()
        (lower, upper), (at_least, at_most) = found.bracket, found.at_full_rate
        reach = found.off + fineness / 256
        assert (lower <= at_most + reach).all() and (at_least <= upper + reach).all()
        error = np.abs(found.found - found.exact).max((0, 2, 3))
        if currently_in_test_context():
            target(float((error - found.off).max()))
        assert (error <= found.off).all(), f"{error[error > found.off]} > {found.off[error > found.off]}"
        met.update(np.unique(found.levels[found.filled]).tolist())

    with jax.enable_x64(dtype is np.float64):
        holds(
            *seen_whole(frames, kernel, projection, dtype),
            np.broadcast_to(np.minimum(np.arange(bundles) % 7, SUPER_PIXEL), (cells, bundles)).astype(np.int32),
            0.0,
        )
        assert met == set(CANDIDATES), "every level occurs, and super-pixels"
        rounded = st.sampled_from([0.0, 0.004, 0.5])
        examples(15)(given(scenes(kernel, dtype), cameras(frames, projection, dtype), wishes(cells, bundles), rounded)(holds))()


@pytest.fixture
def alike(frames, x64):
    """A frame that one support after the other holds whole, of quantities from 0.4 on, and the size of its table of levels."""
    frames = frames.deep(4)
    scene, camera = seen_whole(frames, "poly6", "perspective", np.float64)
    particles = dataclasses.replace(scene.particles, support=np.full_like(scene.particles.support, 30))
    transfer = js.TransferFunction.from_points(np.linspace(0, 1, 5), np.linspace(0, 1, 15).reshape(5, 3), np.linspace(0.1, 1, 5))

    def of(spread):
        quantity = 0.4 + spread * np.asarray(particles.quantity)
        return js.Scene(particles=dataclasses.replace(particles, quantity=quantity), transfer=transfer)

    return of, camera, frames.plan(4), (-(-frames.samples // CELL_SAMPLES), 16)


def test_bundle_bounds_of_one_quantity_are_attained(stages, alike):
    """Nothing is left that could vary but the lengths of rays, and the bounds are the range of the pixels."""
    of, camera, plan, (cells, bundles) = alike
    levels = np.broadcast_to(np.arange(bundles) % (MAX_LEVEL + 1), (cells, bundles)).astype(np.int32)
    found = looked(stages, of(0.0), camera, levels, plan)
    assert found.found.max() > 0.1
    np.testing.assert_allclose(found.bracket[0], found.found.min((2, 3)), atol=1e-12)
    np.testing.assert_allclose(found.bracket[1], found.found.max((2, 3)), atol=1e-12)


@pytest.mark.parametrize("spread", [0.01, 0.1])
def test_bundle_bounds_and_errors_inform(stages, alike, spread):
    """They add little to what the pixels of a bundle differ by anyway: the slopes of colours and of extinction are 1 and less."""
    of, camera, plan, size = alike
    full, painted = (looked(stages, of(spread), camera, np.full(size, level, np.int32), plan) for level in (0, SUPER_PIXEL))
    wide, wider = (upper - lower for lower, upper in (full.bracket, painted.bracket))
    assert (wide - np.ptp(full.found, (2, 3))).max() <= 2 * spread and (wider <= wide + spread).all()
    assert not full.off.any()
    assert 0 < painted.off.max() <= 1.5 * spread
