"""What a bundle can see: which slabs are touched, which covered, and between which optics; nothing looks up to more."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from hypothesis import given, strategies as st

import jaxsph as js
from jaxsph.engine.control.bounds import Spheres, range_tables, sample_bounds, tables_of_parts, transfer_ranges
from jaxsph.model.transfer.function import look_up

RAYS = np.linspace(-0.1, 0.1, 8, dtype=np.float32)[:, None]
BORDERS = np.asarray([1.0, 2.0, 3.0, 4.0, 5.0], np.float32)[:, None]


@functools.partial(jax.jit, static_argnums=7, compiler_options=QUICKLY)
def bounds_of(*given):
    *seen, borders, references, transfer, subdivisions = given
    return sample_bounds(
        *seen, borders[:-1], borders[1:], references, tables_of_parts(transfer), perspective=False, subdivisions=subdivisions
    )


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


INTERVALS = 64


@functools.partial(jax.jit, compiler_options=QUICKLY)
def looked(transfer, lo, hi, q):
    """Least and greatest values of intervals, and those at quantities."""
    sides = transfer_ranges(range_tables(transfer), lo, hi)
    return [jnp.stack(side) for side in sides], jnp.stack(look_up(transfer.segments(), q))


def made(rng, points, how, offset, dtype):
    values = {"even": np.linspace(0, 1, points), "uneven": np.sort(rng.uniform(0, 1, points))}[how]
    if how == "uneven" and points > 4:
        values[2] = values[3]
    narrow = rng.uniform(0, 1, points) < 0.3
    colors, extinction = rng.uniform(0, 1, (points, 3)), np.where(narrow, 10 ** rng.uniform(-6, 6, points), 0)
    return js.TransferFunction.from_points((values + offset).astype(dtype), colors.astype(dtype), extinction.astype(dtype))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("how", ["even", "uneven"])
@pytest.mark.parametrize("points", [1, 2, 11, 64])
@given(seed=st.integers(0, 2**32 - 1), offset=st.sampled_from([0.0, -0.5, 3e3]), width=st.floats(-7, 1))
def test_every_value_of_an_interval_lies_in_its_range(points, how, dtype, seed, offset, width):
    rng = np.random.default_rng(seed)
    with jax.enable_x64(dtype is np.float64):
        transfer = made(rng, points, how, offset, dtype)
        knots = np.asarray(transfer.values)
        amid = rng.uniform(-0.3, 1.3, INTERVALS) + offset
        lo = np.where(rng.uniform(size=INTERVALS) < 0.4, rng.choice(knots, INTERVALS), amid).astype(dtype)
        hi = np.maximum(lo, (lo + 10.0**width * rng.uniform(0, 1, INTERVALS)).astype(dtype))
        between = np.clip((lo + np.linspace(0, 1, 40)[:, None] * (hi - lo)).astype(dtype), lo, hi)
        on_knots = np.clip(np.broadcast_to(rng.choice(knots, 20)[:, None], (20, INTERVALS)), lo, hi)
        places = np.concatenate([between, on_knots, np.nextafter(on_knots, lo), [lo, hi]])
        (least, greatest), truth = jax.tree.map(np.asarray, looked(transfer, lo, hi, places))
    assert (least[:, None] <= truth).all() and (truth <= greatest[:, None]).all()
    assert (least >= 0).all()


def test_ranges_are_tight(x64):
    transfer = js.TransferFunction.from_points(np.linspace(0, 1, 11), np.eye(11)[:, [2, 5, 8]], np.arange(11.0) ** 2)
    lo, hi = (np.resize(end, INTERVALS) for end in ([0.15, 0.45, -1, 0.31], [0.25, 0.65, 2, 0.39]))
    least, greatest = (np.asarray(side)[:, :4] for side in looked(transfer, lo, hi, np.zeros((82, INTERVALS)))[0])
    np.testing.assert_allclose(greatest[0], [1, 0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(greatest[1], [0, 1, 1, 0], atol=1e-12)
    np.testing.assert_allclose(least[3], [2.5, 20.5, 0, 9.7], atol=1e-12)
    np.testing.assert_allclose(greatest[3], [6.5, 42.5, 100, 15.3], atol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_exponentials_err_by_no_more_than_certificates_allow_for(dtype):
    """`errors.EXPONENTIAL` takes 2 ulp for granted, here counted against long doubles."""
    depth = np.concatenate([np.linspace(0, 40, 200_001), 10.0 ** np.linspace(-12, 1.5, 50_001)]).astype(dtype)
    with jax.enable_x64(dtype is np.float64):
        found = np.asarray(jax.jit(lambda x: jnp.exp(-x))(depth))
    truth = np.exp(-depth.astype(np.longdouble))
    ulp = np.spacing(truth.astype(dtype)).astype(np.longdouble)
    assert (np.abs(found - truth) <= 2 * ulp).all()
    assert (found <= 1).all()
