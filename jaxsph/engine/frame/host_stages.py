"""The stages of access for a frame that is run on CPUs: the host sorts and selects, between programs.

Flow: viewing -> [host_stages: order -> make_grid] -> stages.

Images are the same bit for bit: particles are in the same order in every list.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxsph.engine.access.host_lists import build_lists_on_host, find_sides, find_touched, list_shapes, pair_shapes
from jaxsph.engine.access.host_sorting import depth_order
from jaxsph.engine.access.lists import BundleLists, ListPlan
from jaxsph.engine.access.ordering import Ordered
from jaxsph.engine.access.view import Viewed
from jaxsph.engine.frame.stages import BandGrid, grid_of_lists, make_grid, order, stage
from jaxsph.engine.runtime.executors import Clock, Forecast, HostStage
from jaxsph.engine.runtime.tuning import Tuning, cores_at_hand
from jaxsph.model.camera.camera import Camera

Found = Int[Array, " particles"] | None


@stage("lists", "samples", "beside", quickly=True)
def find_windows(
    ordered: Ordered,
    made: BundleLists,
    camera: Camera,
    first_row: Int[Array, ""],
    *,
    lists: ListPlan,
    samples: int,
    beside: bool,
    tuning: Tuning,
) -> BandGrid:
    """All but the lists of the grid of the band that begins at a row of pixels; what a program returns it would copy."""
    return grid_of_lists(ordered, made, camera, first_row, lists, samples, beside)._replace(lists=None)  # type: ignore[arg-type]


def _order(run: Clock, stage: str, viewed: Viewed, camera: Camera, found: Found, **static: Any) -> Ordered:
    if found is None:
        found = depth_order(viewed, cores_at_hand())
        run.mark(stage)
    ordered: Ordered = run.one(stage, order, (viewed, camera, found), **static)
    return ordered


def _order_foreseen(run: Forecast, stage: str, viewed: Viewed, camera: Camera, found: Found, **static: Any) -> Ordered:
    shape = jax.ShapeDtypeStruct(viewed.key.shape, jnp.int32) if found is None else found
    ordered: Ordered = run.one(stage, order, (viewed, camera, shape), **static)
    return ordered


def _grid(
    run: Clock, stage: str, ordered: Ordered, camera: Camera, first_row: Int[Array, ""], *, lists: ListPlan, **static: Any
) -> BandGrid:
    sides = run.one(stage, find_sides, (ordered, camera, first_row), lists=lists)
    view = (sides.spheres, sides.bundles, camera, first_row)
    touched = run.program(stage, find_touched, (*view, pair_shapes(lists)))
    made = build_lists_on_host(sides, lambda pairs: touched(*view, pairs), lists, cores_at_hand())
    run.mark(stage)
    grid: BandGrid = run.one(stage, find_windows, (ordered, made, camera, first_row), lists=lists, **static)
    return grid._replace(lists=made)


def _grid_foreseen(
    run: Forecast, stage: str, ordered: Ordered, camera: Camera, first_row: Int[Array, ""], *, lists: ListPlan, **static: Any
) -> BandGrid:
    sides = run.one(stage, find_sides, (ordered, camera, first_row), lists=lists)
    run.one(stage, find_touched, (sides.spheres, sides.bundles, camera, first_row, pair_shapes(lists)))
    made = list_shapes(lists)
    grid: BandGrid = run.one(stage, find_windows, (ordered, made, camera, first_row), lists=lists, **static)
    return grid._replace(lists=made)


ORDER = HostStage(order, _order, _order_foreseen)
MAKE_GRID = HostStage(make_grid, _grid, _grid_foreseen)
