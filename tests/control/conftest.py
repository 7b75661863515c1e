"""The stages of a frame, one by one, for tests that look between them."""

from __future__ import annotations

import functools

import jax
import pytest

from jaxsph.access.grid import Grid
from jaxsph.control.worklist import origins
from jaxsph.stages import grid_parts, order


@functools.partial(jax.jit, static_argnames="plan")
def grid_of(particles, camera, *, plan):
    """The grid of a frame of one band, and what its sums are taken relative to."""
    ordered = order(particles, camera, plan=plan)
    grid = Grid(ordered, *grid_parts(ordered, camera, 0, plan=plan))
    return grid, origins(grid.cells, grid.lists.rank, ordered.quantity)


@pytest.fixture(scope="session")
def stages():
    return grid_of
