"""Error control of a band, on fluids made by hand: what is alike is coarsened, what is not wanted is left alone."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY

import jaxsph as js
from jaxsph.engine.access.slab_windows import CELL_SAMPLES
from jaxsph.engine.control.adapt import EMPTY, ControlPlan, adapt, rounding_of
from jaxsph.engine.control.errors import SUPER_PIXEL
from jaxsph.engine.field.schedule import evaluations, full_rate
from jaxsph.engine.runtime.tuning import CPU


@pytest.fixture(scope="module")
def adapted(frames, stages):
    """What is decided for particles of given quantities, as `run` says; and the grid that it is decided by."""
    rng = np.random.default_rng(3)
    frames = frames.deep(4)
    plan, control = frames.plan(), ControlPlan(super_pixels=True, merge=True, allocation="budget")
    scene, camera = frames.scene(rng, decades=0.1), frames.camera(rng)
    transfer = js.TransferFunction.from_points([0.0, 1.0], [[0, 0, 0], [1, 1, 1]], [0.4, 0.6])

    @functools.partial(jax.jit, compiler_options=QUICKLY)
    def run(grid, reference, wanted, tolerance):
        """What is decided, what there is at full rate, and the evaluations of both."""
        full, limits = full_rate(grid.windows, reference), (tolerance, jnp.float32(0))
        found = adapt(grid, camera, transfer, reference, wanted, *limits, slab_samples=4, plan=control, tuning=CPU)
        return found, full, [evaluations(one, grid.samples, 4).sum() for one in (found[0], full)]

    def decide(quantity, tolerance, wanted=True):
        particles = js.Particles(**{**vars(scene.particles), "quantity": np.float32(quantity)})
        grid, reference = stages(particles, camera, plan=plan)
        cells = -(-grid.windows.count.shape[0] * 4 // CELL_SAMPLES)
        wanted = np.full((cells, grid.windows.count.shape[1]), wanted)
        return *run(grid, reference, wanted, np.float32(tolerance)), grid

    return decide


ALIKE, MIXED = np.full(24, 0.5), np.tile([0.0, 1.0], 12)


def test_what_is_alike_is_coarsened_within_the_tolerance(adapted):
    (_, bound, _, levels), _, (spent, most), _ = adapted(ALIKE, 0.1)
    assert (np.asarray(bound) <= 0.1).all() and (np.asarray(bound) > 0).any()
    assert 0 < float(spent) < 0.9 * float(most)
    assert set(np.unique(levels)) <= set(range(EMPTY, SUPER_PIXEL + 1)) and (np.asarray(levels) > 0).any()


def test_super_pixels_have_their_share_of_the_bound_and_no_more(adapted):
    for quantity, tolerance in ((ALIKE, 0.1), (MIXED, 0.3)):
        (_, bound, painted, levels), *_ = adapted(quantity, tolerance)
        bound, painted, levels = (np.asarray(value) for value in (bound, painted, levels))
        assert (levels == SUPER_PIXEL).any(0)[painted > 0].all() and painted.any() and (painted <= bound).all()
        alone = ((levels <= 0) | (levels == SUPER_PIXEL)).all(0)
        rounding = np.asarray(rounding_of((levels >= 0).sum(0), np.float32)) * (levels > 0).any(0)
        np.testing.assert_allclose(painted[alone] + rounding[alone], bound[alone], rtol=1e-5)


def test_a_smaller_tolerance_never_saves_more(adapted):
    spent = [float(adapted(MIXED, tolerance)[2][0]) for tolerance in (0.0, 0.01, 0.3)]
    assert spent[0] >= spent[1] >= spent[2] > 0 and spent[0] > spent[2]


@pytest.mark.parametrize(("tolerance", "wanted"), [(0.3, False), (0.0, True)])
def test_what_is_not_wanted_or_not_allowed_is_the_reference_image(adapted, tolerance, wanted):
    (schedule, bound, painted, levels), full, _, grid = adapted(MIXED, tolerance, wanted)
    slabs = len(grid.windows.count)
    for name in ("filled", "length", "count"):
        found, expected = (np.asarray(getattr(one, name)) for one in (schedule, full))
        np.testing.assert_array_equal(found[..., :slabs, :], expected, err_msg=name)
        assert not found[..., slabs:, :].any(), "slabs past the last have nothing"
    assert not np.asarray(schedule.painted).any() and not np.asarray(schedule.level)[np.asarray(schedule.filled)].any()
    assert not np.asarray(bound).any() and not np.asarray(painted).any()
    empty = np.pad(np.asarray(grid.windows.count), ((0, -slabs % 4), (0, 0))).reshape(len(levels), 4, -1).sum(1) == 0
    np.testing.assert_array_equal(np.asarray(levels), np.where(empty, EMPTY, 0))
