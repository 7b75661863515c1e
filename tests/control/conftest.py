"""The stages of a frame, one by one, for tests that look between them."""

from __future__ import annotations

import functools

import jax
import pytest

from jaxsph.access.lists import bundle_origins
from jaxsph.control.worklist import origins
from jaxsph.render import _grid, _half_steps, _order


@functools.partial(jax.jit, static_argnames="plan")
def grid_of(particles, camera, *, plan):
    """Everything that the analysis of a band is made from, in its order."""
    ordered = _order(particles, camera, plan=plan)
    lists, cells = _grid(ordered, camera, 0, plan=plan)
    half_steps = _half_steps(camera, ordered.x, plan)
    return ordered, lists, cells, bundle_origins(plan.lists, 0), half_steps, origins(cells, lists.rank, ordered.quantity)


@pytest.fixture(scope="session")
def stages():
    return grid_of
