"""A schedule counts what it takes."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.engine.field.tasks import DENSE, SUBSAMPLED, evaluations, full_rate


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
