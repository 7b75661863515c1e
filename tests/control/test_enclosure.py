"""Promise: bundle bounds always enclose sampled pixels, at every combination of levels."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsph.cast.points import cast_points
from jaxsph.control.enclosure import bundle_bounds
from jaxsph.control.merge import coarse_work, coarser_windows, merged_levels


@functools.partial(jax.jit, static_argnames=("plan", "kernel", "form"))
def pixels_and_bounds(scene, camera, parts, wished, *, plan, kernel, form):
    grid, origin = parts
    slab_samples = plan.cast.slab_samples
    whole = ((jnp.arange(wished.shape[0]) + 1) * 16 <= plan.samples)[:, None]
    levels = merged_levels(jnp.where(whole, wished, 0), jnp.zeros_like(wished, bool), slab_samples)
    work = coarse_work(coarser_windows(grid.cells, slab_samples), levels, origin, None, slab_samples)
    rays = cast_points(grid, work, camera, scene.transfer, kernel, plan.cast)
    bounds = bundle_bounds(grid, camera, scene.transfer, levels, slab_samples, form=form)
    return jnp.concatenate([rays.color, 1 - rays.transmittance[None]]), bounds


@pytest.mark.parametrize(("kernel", "slab_samples", "form", "projection"), [
    ("poly6", 4, "lerp", "perspective"), ("cubic_spline", 16, "paper", "orthographic"),
    pytest.param("poly6", 4, "lerp", "orthographic", marks=pytest.mark.slow),
    pytest.param("cubic_spline", 16, "paper", "perspective", marks=pytest.mark.slow),
])  # fmt: skip
@given(seed=st.integers(0, 2**32 - 1))
def test_bounds_enclose_every_pixel_at_any_levels(adversary, stages, frames, kernel, slab_samples, form, projection, seed):
    rng = np.random.default_rng(seed)
    with jax.enable_x64(True):
        scene, camera = adversary.scene(rng, kernel, np.float64), adversary.camera(rng, projection, np.float64)
        plan = frames.plan(slab_samples)
        parts = stages(scene.particles, camera, plan=plan)
        wished = jnp.asarray(rng.integers(0, 5, (3, plan.lists.num_bundles)), jnp.int32)
        found, bounds = pixels_and_bounds(scene, camera, parts, wished, plan=plan, kernel=kernel, form=form)
        found, lo, hi = (np.asarray(value) for value in (found, bounds.lo, bounds.hi))
    assert (found >= lo[..., None, None]).all() and (found <= hi[..., None, None]).all()
    assert (lo <= hi).all()


def test_the_lerp_form_is_never_wider_than_the_papers(adversary, stages, frames, x64):
    widths = {"lerp": [], "paper": []}
    for seed in range(8):
        rng = np.random.default_rng(seed)
        scene, camera = adversary.scene(rng, "poly6", np.float64), adversary.camera(rng, "perspective", np.float64)
        parts = stages(scene.particles, camera, plan=frames.plan())
        wished = jnp.zeros((3, 16), jnp.int32)
        for form, found in widths.items():
            bounds = pixels_and_bounds(scene, camera, parts, wished, plan=frames.plan(), kernel="poly6", form=form)[1]
            found.append(np.asarray(bounds.hi - bounds.lo))
    lerp, paper = (np.asarray(value) for value in widths.values())
    assert (lerp <= paper + 1e-12).all() and lerp.mean() < 0.9 * paper.mean()
