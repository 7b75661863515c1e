"""Spheres against pyramids of rays: none that touches is left out, however wide the view."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st

from jaxsph.engine.access.lists import side_distances, touches

TOUCHES = jax.jit(
    lambda x, y, z, reach, u, v: touches(
        side_distances(x, z, *u, True), side_distances(y, z, *v, True), reach, jnp.abs(x) + jnp.abs(y) + jnp.abs(z) + reach
    )
)


@pytest.mark.parametrize("width", [1.0, 1e3, 1e5, 1e7, 1e12])
@given(st.integers(0, 2**32 - 1))
def test_a_sphere_about_a_point_of_a_ray_touches_however_wide_the_view(width, seed):
    """Rays that run up to `width` aside a unit of depth; spheres reach a point of a ray and no more."""
    rng = np.random.default_rng(seed)
    number = 64
    low = width * rng.uniform(-1, 1, (2, number)) * 10.0 ** -rng.integers(0, 3, (2, number))
    high = low + width * 10.0 ** -rng.uniform(0, 4, (2, number))
    low, high = low.astype(np.float32), np.maximum(high.astype(np.float32), np.nextafter(low.astype(np.float32), np.inf))
    inside = low + rng.choice([0.0, 1.0, 0.5], (2, number)) * (high.astype(np.float64) - low)
    depth = 10.0 ** rng.uniform(-3, 3, number)
    point = np.stack([inside[0] * depth, inside[1] * depth, depth])
    away = rng.normal(size=(3, number))
    reach = np.linalg.norm(point, axis=0) * 10.0 ** rng.uniform(-4, 1, number)
    middle = (point + away / np.linalg.norm(away, axis=0) * reach * (1 - 1e-6)).astype(np.float32)
    reach = np.linalg.norm(middle.astype(np.float64) - point, axis=0) * (1 + 1e-6)
    found = TOUCHES(*middle, reach.astype(np.float32), (low[0], high[0]), (low[1], high[1]))
    seen = middle[2] > -reach  # what lies behind the eye is left out elsewhere
    assert np.asarray(found)[seen].all()


def test_towards_half_a_turn_no_division_by_zero_leaves_a_sphere_out():
    wide = jnp.float32(1e30)
    zero, one = jnp.float32(0), jnp.float32(1)
    assert bool(TOUCHES(zero, zero, one, one, (-wide, wide), (-wide, wide)))
    assert bool(TOUCHES(one, one, zero, 2 * one, (-wide, one), (-wide, one)))


def test_a_sphere_far_from_all_rays_is_left_out():
    far = jnp.float32(10)
    assert not bool(TOUCHES(far, jnp.float32(0), jnp.float32(1), jnp.float32(1), (-1.0, 1.0), (-1.0, 1.0)))
    assert not bool(TOUCHES(far, far, jnp.float32(1), jnp.float32(1), (-1.0, 1.0), (-1.0, 1.0)))
