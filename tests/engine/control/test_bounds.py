"""What a bundle can see of a few spheres, placed by hand: which slabs are touched, which covered, and between which optics."""

from __future__ import annotations

import functools

import jax
import numpy as np
from derivatives import QUICKLY

import jaxsph as js
from jaxsph.engine.control.bounds import Spheres, sample_bounds
from jaxsph.engine.control.ranges import tables_of_parts

RAYS = np.linspace(-0.1, 0.1, 8, dtype=np.float32)[:, None]
BORDERS = np.asarray([1.0, 2.0, 3.0, 4.0, 5.0], np.float32)[:, None]


@functools.partial(jax.jit, static_argnums=7, compiler_options=QUICKLY)
def bounds_of(*given):
    *seen, transfer, subdivisions = given
    return sample_bounds(*seen, tables_of_parts(transfer), perspective=False, subdivisions=subdivisions)


def bounds(*balls, subdivisions=2):
    """Bounds of the four samples of one bundle of parallel rays, by one or two balls (x, y, z, radius, quantity)."""
    x, y, z, radius, quantity = np.float32([*balls, balls[0]][:2]).T  # of which a window may have the first alone
    spheres = Spheres(x, y, z, 1 / radius, 1 / radius, (quantity,))
    transfer = js.TransferFunction.from_points([0.0, 1.0], [[0, 0, 0], [1, 0.5, 0]], [1.0, 3.0])
    window = np.zeros((1, 1), np.int32), np.full((1, 1), len(balls), np.int32)
    rank, reference = np.arange(2, dtype=np.int32), np.full(1, 0.5, np.float32)
    return bounds_of(spheres, rank, window, (RAYS, RAYS), BORDERS, ((reference, reference),), transfer, subdivisions)


def test_a_slab_is_touched_where_a_sphere_reaches_it_and_covered_where_one_holds_it():
    found = jax.tree.map(np.asarray, bounds((0.0, 0.0, 2.5, 0.8, 0.25)))
    np.testing.assert_array_equal(found.touched[:, 0], [True, True, True, False])
    np.testing.assert_array_equal(found.covered[:, 0], [False, True, False, False])


def test_a_sphere_beside_the_bundle_touches_nothing():
    assert not np.asarray(bounds((2.0, 0.0, 2.5, 1.5, 0.25)).touched).any()


def test_several_spheres_cover_what_none_does_alone():
    """Each sub-rectangle of a footprint lies inside one of them."""
    left, right = (-0.45, 0.0, 1.5, 0.7, 0.1), (0.45, 0.0, 1.5, 0.7, 0.2)
    assert not any(np.asarray(bounds(one).covered)[0] for one in (left, right))
    whole, one = (np.asarray(bounds(left, right, subdivisions=number).covered)[0, 0] for number in (2, 1))
    assert whole and not one


def test_optics_lie_between_those_of_the_least_and_the_greatest_quantity():
    found = jax.tree.map(np.asarray, bounds((0.0, 0.0, 1.5, 3.0, 0.25), (0.0, 0.0, 1.5, 0.9, 0.75)))
    for channel, (least, greatest) in enumerate([(0.25, 0.75), (0.125, 0.375), (0.0, 0.0), (1.5, 2.5)]):
        assert float(found.lo[channel][0, 0]) <= least and greatest <= float(found.hi[channel][0, 0])
        np.testing.assert_allclose([found.lo[channel][0, 0], found.hi[channel][0, 0]], [least, greatest], atol=1e-5)
    assert float(found.hi[3][3, 0]) < 1.6, "the smaller sphere is not met by the last slab"
