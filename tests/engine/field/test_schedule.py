"""A schedule counts what it takes."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.engine.field.schedule import DENSE, SUBSAMPLED, evaluations, full_rate


@pytest.mark.slow
def test_a_subsampled_slab_takes_a_quarter_of_the_evaluations(stages):
    scene, camera = js.scenes.load("mixer", 500, width=40, height=33)
    plan = js.plan(scene, camera, js.Settings(samples=96))
    grid, reference = stages(scene.particles, camera, plan=plan)
    schedule = full_rate(grid.windows, reference)
    all_rays = evaluations(schedule, plan.samples, plan.cast.slab_samples)
    for method, share in ((SUBSAMPLED, 0.25), (DENSE, 1)):
        some = dataclasses.replace(schedule, method=jnp.where(schedule.filled, method, DENSE))
        np.testing.assert_allclose(evaluations(some, plan.samples, plan.cast.slab_samples), share * np.asarray(all_rays))
    assert float(all_rays.sum()) > 0


def test_a_halo_is_one_more_sample_of_every_slab(frames, stages):
    rng, plan = np.random.default_rng(0), frames.plan()
    grid, reference = stages(frames.scene(rng).particles, frames.camera(rng), plan=plan)

    @jax.jit
    def counted(windows):
        schedule = full_rate(windows, reference)
        return schedule.count.sum(0), [evaluations(schedule, plan.samples, plan.cast.slab_samples, halo) for halo in (0, 1)]

    more, (without, beside) = jax.tree.map(np.asarray, counted(grid.windows))
    np.testing.assert_allclose(beside - without, more)
    assert more.any()
