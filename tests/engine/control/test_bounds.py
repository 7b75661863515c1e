"""What a bundle can see: which slabs are touched, which covered, and between which optics; nothing looks up to more."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from hypothesis import given
from hypothesis import strategies as st

import jaxsph as js
from jaxsph.engine.control.bounds import range_tables, transfer_ranges
from jaxsph.model.transfer.function import look_up

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
