"""Every sample of a slab lies in its box: to the last bit, as a medium that a box misses is not marched there."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from hypothesis import given
from hypothesis import strategies as st

from jaxsph.engine.access.grid import slab_extents
from jaxsph.engine.cast.batches import batches_of
from jaxsph.engine.field.schedule import full_rate
from jaxsph.engine.screen.packets import every_bundle


@functools.partial(jax.jit, static_argnames="plan", compiler_options=QUICKLY)
def looked(grid, reference, camera, point, *, plan):
    """Boxes of slabs, their distance to a point, and where samples are, on borders or between."""
    schedule, packets = full_rate(grid.windows, reference), every_bundle(grid, camera)
    found, samples = slab_extents(grid, camera, plan.cast.slab_samples), []
    for on_borders in (False, True):
        batches = batches_of(grid, schedule, packets, plan.cast, camera.is_perspective, on_borders)
        positions = batches.task(jnp.arange(schedule.count.size)).positions()
        samples.append([value.reshape(*schedule.count.shape, *value.shape[1:]) for value in positions])
    return found, found.distance_to(*point), samples


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@given(seed=st.integers(0, 2**32 - 1), distance=st.sampled_from([3.0, 0.8, 0.0001]))
def test_every_sample_lies_in_the_box_of_its_slab(frames, stages, projection, seed, distance):
    rng, plan = np.random.default_rng(seed), frames.plan()
    camera = frames.camera(rng, projection, distance)
    grid, reference = stages(frames.scene(rng).particles, camera, plan=plan)
    point = rng.uniform(-3, 3, 3).astype(np.float32)
    found, distance, samples = jax.tree.map(np.asarray, looked(grid, reference, camera, point, plan=plan))
    for places in samples:
        for name, place in zip("xyz", places, strict=True):
            lower, upper = (getattr(found, f"{name}_{side}")[..., None, None] for side in ("lower", "upper"))
            assert (lower <= place).all() and (place <= upper).all(), name
        # nor is any sample nearer to a point than its box is
        nearest = np.sqrt(sum((place.astype(np.float64) - at) ** 2 for place, at in zip(places, point, strict=True))).min((2, 3))
        assert (distance.astype(np.float64) <= nearest * (1 + 1e-6) + 1e-6).all()


def test_a_point_in_a_box_has_no_distance(frames, stages):
    rng, plan = np.random.default_rng(0), frames.plan()
    camera = frames.camera(rng)
    grid, reference = stages(frames.scene(rng).particles, camera, plan=plan)
    found, *_ = jax.tree.map(np.asarray, looked(grid, reference, camera, np.zeros(3, np.float32), plan=plan))
    middle = np.float32([(getattr(found, f"{name}_lower") + getattr(found, f"{name}_upper"))[2, 3] / 2 for name in "xyz"])
    assert float(looked(grid, reference, camera, middle, plan=plan)[1][2, 3]) == 0
