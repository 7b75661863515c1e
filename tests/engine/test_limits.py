"""A tolerance is never rounded up, and a relaxation is no certificate: what the stages are told of the settings."""

from __future__ import annotations

import jax.numpy as jnp
from hypothesis import given
from hypothesis import strategies as st

import jaxsph as js
from jaxsph.engine.frame.stages import limits_of


@given(st.floats(0, 1))
def test_a_tolerance_in_float32_is_no_more_than_was_asked_for_and_hardly_less(tolerance):
    told, _ = limits_of(js.Settings(integrator="samples", tolerance=tolerance), jnp.float32)
    assert told.dtype == jnp.float32
    assert float(told) <= tolerance <= float(told) * (1 + 2.0**-22) + 2.0**-148


def test_full_rate_has_no_limits():
    assert limits_of(js.Settings(), jnp.float32) is None
