"""Error control of a band: what could pay is analysed, no tolerance is overspent, and cells merge where all allow it."""

from __future__ import annotations

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from examples import EXAMPLES, examples
from grids import BUNDLES, CELLS, windows_of
from hypothesis import given, strategies as st
from hypothesis.extra import numpy as hnp

import jaxsph as js
from jaxsph.engine.access.grid import CELL_SAMPLES, MAX_LEVEL, coarser_windows
from jaxsph.engine.control.adapt import (
    MIN_PROMISING_SHARE,
    ControlPlan,
    adapt,
    coarse_schedule,
    evaluations_of_levels,
    merged_levels,
    probe,
)
from jaxsph.engine.control.allocation import EMPTY, bound, choose, kept, rounding_of
from jaxsph.engine.control.decide import Limits
from jaxsph.engine.control.errors import CANDIDATES, LEVELS, SUPER_PIXEL, Candidates, CellErrors, fits
from jaxsph.engine.field.tasks import Painting, evaluations, full_rate
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
        full, limits = full_rate(grid.windows, reference), Limits(tolerance, jnp.float32(0))
        found = adapt(grid, camera, transfer, reference, wanted, limits, slab_samples=4, plan=control, tuning=CPU)
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
    assert not np.asarray(schedule.span).any() and not np.asarray(schedule.level)[np.asarray(schedule.filled)].any()
    assert not np.asarray(bound).any() and not np.asarray(painted).any()
    empty = np.pad(np.asarray(grid.windows.count), ((0, -slabs % 4), (0, 0))).reshape(len(levels), 4, -1).sum(1) == 0
    np.testing.assert_array_equal(np.asarray(levels), np.where(empty, EMPTY, 0))


ALONG, ACROSS = 4, 6  # cells of bundles
UNIT = st.floats(0, 1, width=16)
TOLERANCE = st.sampled_from([0.5, 1, 2, 4]).flatmap(lambda most: st.floats(0, most, width=16))
choosing = jax.jit(choose, static_argnames="allocation")
bounding = jax.jit(bound)


@st.composite
def offers(draw, slabs):
    """Errors of levels and of slabs that are painted, what they save, what is on offer, and the rounding of bundles."""
    shape = (LEVELS + 1, ALONG, ACROSS)
    grown = draw(hnp.arrays(np.float64, shape, elements=UNIT, fill=st.nothing()))
    error = np.cumsum(grown, 0) / CANDIDATES - grown[:1] / CANDIDATES
    saving = np.round(np.cumsum(draw(hnp.arrays(np.float64, shape, elements=UNIT, fill=st.nothing())), 0) * 100)
    saving -= saving[:1]
    on_offer = draw(hnp.arrays(bool, (LEVELS + slabs, ALONG, ACROSS)))
    rounding = draw(hnp.arrays(np.float64, ACROSS, elements=st.sampled_from([0.0, 1e-7, 0.01])))
    share = draw(hnp.arrays(np.float64, (2, slabs, ALONG, ACROSS), elements=st.floats(0.25, 1, width=16), fill=st.nothing()))
    error, saving = (np.concatenate([of[:LEVELS], of[LEVELS:] * part]) for of, part in zip((error, saving), share, strict=True))
    return error, saving, on_offer, rounding


def chosen_by(allocation, drawn, tolerance):
    """Candidates and painted slabs, and what is taken of the tolerance and saved by them, by cells and by bundles."""
    error, saving, on_offer, rounding = drawn
    errors, savings, offered = (Candidates(one[:LEVELS], one[LEVELS:]) for one in (error, saving, on_offer))
    slabs = len(error) - LEVELS
    with jax.enable_x64(True):
        nothing = np.zeros((4, slabs, ALONG, ACROSS))
        given = CellErrors(errors, errors.levels, nothing, nothing[0])
        chosen, painted = choosing(given, savings, offered, rounding, np.asarray(tolerance), allocation=allocation)
        errors = errors._replace(levels=offer_errors(errors.levels))
        largest, of_paint = map(np.asarray, bounding(errors, chosen, painted, rounding))
    chosen, painted = np.asarray(chosen), np.asarray(painted)
    np.testing.assert_array_equal(painted.any(0), chosen == SUPER_PIXEL)
    by_paint, saved = (np.where(painted, one.slabs, 0).sum(0) for one in (errors, savings))
    rows = (np.concatenate([one.levels, own[None]]) for one, own in ((errors, by_paint), (savings, saved)))
    taken, gain = (np.take_along_axis(value, chosen[None], 0)[0] for value in rows)
    np.testing.assert_allclose(largest, np.where((chosen > 0).any(0), taken.sum(0) + rounding, 0))
    np.testing.assert_allclose(of_paint, by_paint.sum(0))
    return chosen, painted, largest, gain


def offer_errors(error):
    """Level 0 changes nothing."""
    return np.concatenate([np.zeros_like(error[:1]), error[1:]])


def possible(drawn, tolerance, cell, bundle):
    """Rows that a cell may have: those on offer whose own error the tolerance allows; level 0 is one."""
    error, _, on_offer, rounding = drawn
    allowed = on_offer[:, cell, bundle] & (error[:, cell, bundle] + rounding[bundle] <= tolerance)
    return [0, *(c for c in range(1, len(error)) if allowed[c])]


def options(drawn, tolerance, cell, bundle):
    """Error and saving of all that a cell may be given: a level, or paint for some of its slabs."""
    error, saving = offer_errors(drawn[0])[:, cell, bundle], drawn[1][:, cell, bundle]
    rows = possible(drawn, tolerance, cell, bundle)
    slabs = [row for row in rows if row >= LEVELS]
    some = itertools.chain.from_iterable(itertools.combinations(slabs, number) for number in range(1, len(slabs) + 1))
    return [(error[list(one)].sum(), saving[list(one)].sum()) for one in ([row] for row in rows if row < LEVELS)] + [
        (error[list(one)].sum(), saving[list(one)].sum()) for one in some
    ]


@pytest.mark.parametrize("slabs", [1, 2])
def test_a_budget_is_kept_and_saves_all_but_one_cell_of_the_most_that_can_be_saved(slabs):
    @examples(EXAMPLES if slabs == 1 else 15)
    @given(drawn=offers(slabs), tolerance=TOLERANCE)
    def saves(drawn, tolerance):
        rounding = drawn[3]
        _, _, largest, gain = chosen_by("budget", drawn, tolerance)
        assert (largest <= tolerance).all()
        for bundle in range(ACROSS):
            cells = [options(drawn, tolerance, cell, bundle) for cell in range(ALONG)]
            most, widest = 0.0, max(saving for cell in cells for _, saving in cell)
            for choice in itertools.product(*cells):
                if sum(error for error, _ in choice) + rounding[bundle] <= tolerance:
                    most = max(most, sum(saving for _, saving in choice))
            slack = 1e-9 * (1 + most)  # savings of slabs are no whole numbers, and added in any order
            assert most - widest - slack <= gain[:, bundle].sum() <= most + slack

    saves()


@pytest.mark.parametrize("slabs", [1, 2])
def test_back_to_front_each_cell_takes_the_most_that_is_left(slabs):
    @given(drawn=offers(slabs), tolerance=TOLERANCE)
    def takes(drawn, tolerance):
        (error, saving, *_), rounding = drawn, drawn[3]
        chosen, painted, largest, _ = chosen_by("greedy", drawn, tolerance)
        assert (largest <= tolerance).all()
        error = offer_errors(error)
        for bundle in range(ACROSS):
            left = tolerance - rounding[bundle]
            for cell in reversed(range(ALONG)):
                rows = possible(drawn, tolerance, cell, bundle)
                own, gains = error[:, cell, bundle], saving[:, cell, bundle]
                offered = {row: (gains[row], own[row]) for row in rows if row < LEVELS and (row == 0 or own[row] <= left)}
                taken, slabs_taken = 0.0, []
                for row in reversed([row for row in rows if row >= LEVELS]):
                    if gains[row] > 0 and taken + own[row] <= left:
                        taken, slabs_taken = taken + own[row], [row - LEVELS, *slabs_taken]
                if slabs_taken:
                    offered[SUPER_PIXEL] = gains[[LEVELS + slab for slab in slabs_taken]].sum(), taken
                wanted = max(offered, key=lambda row: (offered[row][0], -row))
                assert chosen[cell, bundle] == wanted
                assert np.flatnonzero(painted[:, cell, bundle]).tolist() == (slabs_taken if wanted == SUPER_PIXEL else [])
                left -= offered[wanted][1]

    takes()


SLAB_SAMPLES = [4, 8, 16]


@pytest.mark.core
def test_what_is_over_the_tolerance_is_dropped():
    """Whatever was chosen, bundle by bundle; what is within it stays."""
    error = Candidates(np.float32([[[0, 0, 0]], [[0.3, 0.3, 0.1]]]), np.float32([[[0.1, 0.6, 0.2]], [[0.2, 0.3, 0.9]]]))
    chosen, painted = np.int32([[SUPER_PIXEL, SUPER_PIXEL, 1]]), np.array([[[True, True, False]], [[True, False, False]]])
    chosen, painted, largest, of_paint = map(
        np.asarray, kept(error, chosen, painted, np.full(3, 0.01, np.float32), np.float32(0.5))
    )
    np.testing.assert_array_equal(chosen, [[SUPER_PIXEL, 0, 1]])
    np.testing.assert_array_equal(painted, [[[True, False, False]], [[True, False, False]]])
    np.testing.assert_allclose(largest, [0.31, 0, 0.11], rtol=1e-6)
    np.testing.assert_allclose(of_paint, [0.3, 0, 0], rtol=1e-6)


merge = jax.jit(merged_levels, static_argnums=2)
unions = jax.jit(coarser_windows, compiler_options=QUICKLY)


@functools.partial(jax.jit, static_argnums=1, compiler_options=QUICKLY)
def costs(windows, slab_samples):
    """Of levels whose cells are merged, and of those whose cells are alone."""
    return [evaluations_of_levels(windows, CELLS, slab_samples, merged) for merged in (True, False)]


@functools.partial(jax.jit, static_argnums=2, compiler_options=QUICKLY)
def evaluated(windows, levels, slab_samples, past):
    shape = windows[0].length.shape[1:]
    here = jnp.repeat(levels == SUPER_PIXEL, CELL_SAMPLES // slab_samples, 0)
    painting = Painting(here, jnp.zeros((4, *here.shape)))
    schedule = coarse_schedule(windows, levels, (jnp.zeros(shape),), painting, slab_samples)
    return evaluations(schedule, CELLS * CELL_SAMPLES - past, slab_samples)


@pytest.mark.parametrize("slab_samples", SLAB_SAMPLES)
def test_a_level_costs_what_a_schedule_of_that_level_evaluates(slab_samples):
    found = unions(windows_of(slab_samples))
    merged, alone = costs(found, slab_samples)
    for level in range(MAX_LEVEL + 1):
        share = 1 << max(level - fits(slab_samples), 0)  # cells that share a slab
        whole = CELLS // share * share
        levels = np.int32(np.where(np.arange(CELLS) < whole, level, SUPER_PIXEL)[:, None] * np.ones(BUNDLES, int))
        spent = evaluated(found, levels, slab_samples, 0)
        np.testing.assert_allclose(np.asarray(merged[level])[:whole].sum(0), spent, rtol=1e-6)
        assert (alone[level] is None) == (share > 1)
        windows = np.asarray(found[level].length).sum(0)[: whole * CELL_SAMPLES // slab_samples >> level]
        np.testing.assert_allclose(spent, windows.sum(0) * slab_samples, rtol=1e-6)  # a slab has as many samples at any level


def test_samples_past_the_last_are_not_evaluated_at_full_rate():
    windows, levels = windows_of(4), np.zeros((CELLS, BUNDLES), np.int32)
    all_of_them, fewer = (np.asarray(evaluated(unions(windows), levels, 4, past)) for past in (0, 3))
    np.testing.assert_allclose(all_of_them - fewer, 3 * np.asarray(windows.count)[-1])


@pytest.mark.parametrize("slab_samples", SLAB_SAMPLES)
@examples(60)
@given(data=st.data())
def test_cells_merge_at_the_highest_level_that_all_of_a_group_allow(slab_samples, data):
    every = st.sampled_from([SUPER_PIXEL, *range(MAX_LEVEL + 1), MAX_LEVEL, MAX_LEVEL])
    chosen = data.draw(hnp.arrays(np.int32, (CELLS, BUNDLES), elements=every, fill=st.just(MAX_LEVEL)))
    free = data.draw(hnp.arrays(bool, (CELLS, BUNDLES)))
    found = np.asarray(merge(chosen, free, slab_samples))
    fitting = fits(slab_samples)
    allows = np.where(free, MAX_LEVEL, np.where(chosen == SUPER_PIXEL, 0, chosen))
    for cell, bundle in np.ndindex(chosen.shape):
        own = chosen[cell, bundle]
        wanted = SUPER_PIXEL if own == SUPER_PIXEL else min(own, fitting)
        for level in range(fitting + 1, MAX_LEVEL + 1):
            share = 1 << (level - fitting)
            group = allows[cell // share * share :, bundle][:share]
            if len(group) == share and (group >= level).all():
                wanted = level
        assert found[cell, bundle] == wanted


@pytest.fixture(scope="module")
def probed(frames, stages):
    """Which cells are promising, of particles with given quantities and a transfer function with given extinction."""
    rng = np.random.default_rng(0)
    scene, camera, plan = frames.scene(rng, decades=0.3), frames.camera(rng), frames.plan()

    @functools.partial(jax.jit, compiler_options=QUICKLY)
    def run(grid, transfer, tolerance):
        limits = Limits(tolerance, jnp.zeros_like(tolerance))
        return probe(grid, camera, transfer, limits, slab_samples=4, at_once=64)

    def look(quantity, extinction, tolerance, widened=1):
        support = widened * np.asarray(scene.particles.support)
        particles = js.Particles(**{**vars(scene.particles), "quantity": np.float32(quantity), "support": support})
        transfer = js.TransferFunction.from_points([0.0, 1.0], [[0, 0, 0], [1, 1, 1]], [extinction, extinction])
        grid, _ = stages(particles, camera, plan=plan)
        found = np.asarray(run(grid, transfer, np.float32(tolerance)))
        count = np.pad(np.asarray(grid.windows.count), ((0, -grid.windows.count.shape[0] % 4), (0, 0)))
        return found, count.reshape(-1, 4, count.shape[1]).sum(1)

    return look


def test_where_all_is_alike_every_filled_cell_is_promising(probed):
    found, count = probed(ALIKE, 1.0, 1e-3)
    np.testing.assert_array_equal(found, count > 0)
    assert count.sum() > 0


def test_opaque_bundles_are_promising_whole(probed):
    found, count = probed(MIXED, 1e4, 1e-3)
    opaque = np.asarray(found).any(0)
    assert opaque.any()
    np.testing.assert_array_equal(np.asarray(found)[:, opaque], (count > 0)[:, opaque])


def test_more_promises_with_a_larger_tolerance_and_a_tenth_of_the_work_or_none_of_it(probed):
    held, before = [], np.bool_(False)
    for tolerance in (1e-3, 0.01, 0.05, 0.2):
        found, count = probed(MIXED, 1.0, tolerance, widened=3)  # so that few slabs have one particle, which varies by nothing
        assert (np.asarray(found) | ~before).all()
        held.append(count[np.asarray(found)].sum() / count.sum())
        before = np.asarray(found)
    assert held[0] == 0 and any(MIN_PROMISING_SHARE <= share < 1 for share in held), held
    assert all(share == 0 or share >= MIN_PROMISING_SHARE for share in held), held
