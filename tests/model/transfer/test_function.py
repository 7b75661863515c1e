"""Promises of the transfer function: piecewise linear, exact at control points, clamped at its ends, jumps allowed."""

import jax
import numpy as np
import pytest
from hypothesis import given, strategies as st
from lookups import look_up, look_ups

import jaxsph as js


def made(values, seed=0):
    rng = np.random.default_rng(seed)
    count = len(values)
    return js.TransferFunction.from_points(values, rng.uniform(0, 1, (count, 3)), rng.uniform(0, 5, count))


def expected(transfer, q):
    values = np.asarray(transfer.values, np.float64)
    rows = [*np.asarray(transfer.colors, np.float64).T, np.asarray(transfer.extinction, np.float64)]
    return np.stack([np.interp(q, values, row) for row in rows], -1)


def spaced(count, how, rng):
    even = np.linspace(-1, 2, count)
    return {
        "even": even,
        "uneven": np.sort(rng.uniform(-1, 2, count)),
        "crowded": np.sort(2 * rng.uniform(0, 1, count) ** 12),
    }[how]


@pytest.mark.parametrize("values", [[0.3], [0.3, 0.3], [1e9 + 0.7, 1e9 + 0.7, 1e9 + 0.7]])
def test_one_value_is_taken_however_it_rounds(values):
    assert np.array_equal(made(values).values, np.float32(values))
    second = js.TransferFunction.from_points([0.0, 1.0], np.zeros((2, 3)), np.ones(len(values)), values)
    assert np.array_equal(second.extinction_values, np.float32(values))


@pytest.mark.parametrize("how", ["even", "uneven", "crowded"])
def test_is_piecewise_linear_for_any_number_and_spacing_of_points(how, x64):
    drawn = [(count, np.random.default_rng(count)) for count in (1, 2, 5, 16, 17, 64, 256)]
    transfers = [made(spaced(count, how, rng)) for count, rng in drawn]
    values = (np.asarray(transfer.values) for transfer in transfers)
    places = [np.concatenate([rng.uniform(-2, 3, 500), own, [-1e30, 1e30]]) for (_, rng), own in zip(drawn, values, strict=True)]
    for transfer, q, found in zip(transfers, places, look_ups(transfers, places), strict=True):
        np.testing.assert_allclose(np.column_stack(found), expected(transfer, q), atol=1e-9, err_msg=str(len(q)))


def test_control_points_are_met_exactly_in_float32():
    transfers = [made(np.sort(np.random.default_rng(1).uniform(0, 1, count))) for count in (2, 16, 17, 256)]
    for transfer, found in zip(transfers, look_ups(transfers, [one.values for one in transfers]), strict=True):
        color, extinction = found
        assert np.array_equal(color, transfer.colors)
        assert np.array_equal(extinction, transfer.extinction)


@pytest.mark.parametrize("extra", [0, 20])
def test_a_jump_takes_the_later_point_and_leaves_its_sides_alone(extra):
    values = np.concatenate([[0, 0.5, 0.5, 1], 1 + np.arange(1, extra + 1)])
    extinction = np.concatenate([[1, 1, 7, 7], np.full(extra, 7)])
    transfer = js.TransferFunction.from_points(values, np.zeros((len(values), 3)), extinction)
    assert look_up(transfer, np.float32([0.25, np.nextafter(np.float32(0.5), 0), 0.5, 0.75, 1]))[1].tolist() == [1, 1, 7, 7, 7]


def test_jumps_at_the_ends_hold_inside_and_clamp_outside():
    transfer = js.TransferFunction.from_points([0, 0, 1, 1], np.zeros((4, 3)), [1, 2, 2, 3])
    assert look_up(transfer, np.float32([-1, 0, 0.5, 1, 2]))[1].tolist() == [1, 2, 2, 3, 3]


def test_a_huge_end_does_not_spoil_its_neighbours():
    transfer = js.TransferFunction.from_points([0, 1, 2, 3], np.zeros((4, 3)), [0.1, 1e12, 0.1, 0.2])
    assert look_up(transfer, np.float32([0, 1, 2, 3, 4]))[1].tolist() == np.float32([0.1, 1e12, 0.1, 0.2, 0.2]).tolist()


@pytest.mark.parametrize("count", [5, 20])
def test_nan_in_gives_nan_out_and_no_crash(count):
    assert np.isnan(look_up(made(np.linspace(0, 1, count)), np.float32(np.nan))[1])


@given(q=st.floats(-10, 10, width=32), seed=st.integers(0, 5))
def test_stays_between_its_neighbouring_control_points(q, seed):
    transfer = made(np.linspace(0, 1, 20), seed)
    extinction = np.asarray(transfer.extinction, np.float64)
    got = float(look_up(transfer, np.float32(q))[1])
    i = int(np.clip(np.floor(np.clip(q, 0, 1) * 19 - 1e-4), 0, 18))
    near = extinction[i : i + 3]
    assert near.min() - 1e-5 <= got <= near.max() + 1e-5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([], np.zeros((0, 3)), []), "at least one control point"),
        (([1, 0], np.zeros((2, 3)), [1, 1]), r"must ascend, but values\[0\] = 1"),
        (([0, 1], np.zeros((2, 4)), [1, 1]), r"`colors` must have shape \(2, 3\)"),
        (([0, 1], np.full((2, 3), 1.001), [1, 1]), "colours lie in"),
        (([0, 1], np.full((2, 3), -0.5), [1, 1]), "colours lie in"),
        (([0, 1], np.zeros((2, 3)), [1, -1e-3]), r"`extinction` must be >= 0, but extinction\[1\] = -0.001"),
        (([0, 1], np.zeros((2, 3)), [1, np.inf]), "must be finite"),
        (([0, 1], np.zeros((2, 3)), [1]), r"`extinction` must have shape \(2,\)"),
    ],
)
def test_bad_points_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        js.TransferFunction.from_points(*arguments)


def test_numbers_may_change_under_jit_without_recompiling():
    traces = []

    @jax.jit
    def look(transfer, q):
        traces.append(1)
        return transfer(q)[1]

    for seed in range(3):
        transfer = made(np.sort(np.random.default_rng(seed).uniform(0, 1, 40)), seed)
        np.testing.assert_allclose(look(transfer, np.float32(0.3)), expected(transfer, 0.3)[3], atol=1e-5)
    assert len(traces) == 1
