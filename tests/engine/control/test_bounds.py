"""What a bundle can see of a few spheres, placed by hand: which slabs are touched, which covered, and between which optics."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import jaxsph as js
from jaxsph.engine.control.bounds import Spheres, sample_bounds
from jaxsph.engine.control.ranges import tables_of_parts

RAYS = np.linspace(-0.1, 0.1, 8, dtype=np.float32)[:, None]
BORDERS = np.asarray([1.0, 2.0, 3.0, 4.0, 5.0], np.float32)[:, None]


def bounds(*balls, subdivisions=2):
    """Bounds of the four samples of one bundle of parallel rays, by balls (x, y, z, radius, quantity)."""
    x, y, z, radius, quantity = (jnp.asarray(column, jnp.float32) for column in zip(*balls, strict=True))
    spheres = Spheres(x, y, z, 1 / radius, 1 / radius, (quantity,))
    transfer = js.TransferFunction.from_points([0.0, 1.0], [[0, 0, 0], [1, 0.5, 0]], [1.0, 3.0])
    window = jnp.zeros((1, 1), jnp.int32), jnp.full((1, 1), len(balls), jnp.int32)
    rank, footprint = jnp.arange(len(balls), dtype=jnp.int32), (jnp.asarray(RAYS), jnp.asarray(RAYS))
    reference = jnp.full(1, 0.5, jnp.float32)
    find = jax.jit(sample_bounds, static_argnames=("perspective", "subdivisions"))
    tables, how = tables_of_parts(transfer), {"perspective": False, "subdivisions": subdivisions}
    return find(spheres, rank, window, footprint, jnp.asarray(BORDERS), ((reference, reference),), tables, **how)


def test_a_slab_is_touched_where_a_sphere_reaches_it_and_covered_where_one_holds_it():
    found = bounds((0.0, 0.0, 2.5, 0.8, 0.25))
    np.testing.assert_array_equal(found.touched[:, 0], [True, True, True, False])
    np.testing.assert_array_equal(found.covered[:, 0], [False, True, False, False])


def test_a_sphere_beside_the_bundle_touches_nothing():
    assert not bounds((2.0, 0.0, 2.5, 1.5, 0.25)).touched.any()


def test_several_spheres_cover_what_none_does_alone():
    """Each sub-rectangle of a footprint lies inside one of them."""
    left, right = (-0.45, 0.0, 1.5, 0.7, 0.1), (0.45, 0.0, 1.5, 0.7, 0.2)
    assert not bounds(left).covered[0] and not bounds(right).covered[0]
    assert bounds(left, right).covered[0, 0] and not bounds(left, right, subdivisions=1).covered[0, 0]


def test_optics_lie_between_those_of_the_least_and_the_greatest_quantity():
    found = bounds((0.0, 0.0, 1.5, 3.0, 0.25), (0.0, 0.0, 1.5, 0.9, 0.75))
    for channel, (least, greatest) in enumerate([(0.25, 0.75), (0.125, 0.375), (0.0, 0.0), (1.5, 2.5)]):
        assert float(found.lo[channel][0, 0]) <= least and greatest <= float(found.hi[channel][0, 0])
        np.testing.assert_allclose([found.lo[channel][0, 0], found.hi[channel][0, 0]], [least, greatest], atol=1e-5)
    assert float(found.hi[3][3, 0]) < 1.6, "the smaller sphere is not met by the last slab"
