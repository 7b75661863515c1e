"""Sequences of files: their order, their times, and what is missing."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsph.io.disk.sequence import in_order, missing_numbers, numbers_of, require_no_gap


def paths(*names):
    return [Path(name) for name in names]


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (("snap_000.npz", "snap_010.npz"), (0, 10)),
        (("run2_9.hdf5", "run2_10.hdf5"), (9, 10)),
        (("a/snap_1.0.hdf5", "a/snap_1.1.hdf5"), (0, 1)),
        (("a.npz", "b.npz"), None),
        (("a1b1.npz", "a2b2.npz"), None),
        (("a1.npz",), None),
    ],
)
def test_the_number_of_a_file_is_the_one_in_which_names_differ(names, numbers):
    assert numbers_of(paths(*names)) == numbers


@given(st.integers(0, 50), st.integers(1, 9), st.integers(6, 20), st.data())
def test_numbers_that_were_taken_out_of_an_even_sequence_are_found(first, step, count, data):
    there = list(range(first, first + step * count, step))
    gone = data.draw(st.sampled_from(there[1:-1]))
    assert missing_numbers(there) == []
    assert missing_numbers([number for number in there if number != gone]) == [gone]


@pytest.mark.parametrize("numbers", [(0,), (0, 10), (0, 3, 6), (0, 1, 10, 20, 30), (5, 5)])
def test_what_is_even_or_has_no_step_lacks_nothing(numbers):
    assert missing_numbers(numbers) == []


def test_a_gap_is_refused_with_the_numbers_and_the_files_around_it():
    names = paths(*(f"s_{number:03d}.npz" for number in (0, 1, 2, 5, 6)))
    with pytest.raises(ValueError, match=r"numbers 3, 4 are missing in the sequence, first between s_002.npz and s_005.npz"):
        require_no_gap(names)
    many = paths(*(f"s_{number}.npz" for number in (0, 1, 2, 50)))
    with pytest.raises(ValueError, match="3, 4, 5, 6, 7, 8, 9, 10 and 39 more"):
        require_no_gap(many)


def test_files_are_in_the_order_of_their_times_and_that_is_said_where_names_have_another():
    order = in_order(paths("s_0.npz", "s_1.npz", "s_2.npz"), [0.5, 0.1, 0.9])
    assert order.indices == (1, 0, 2) and order.times == (0.1, 0.5, 0.9) and "another order" in order.told and order.by_files


def test_without_times_numbers_are_times_and_without_numbers_places_are():
    order = in_order(paths("s_3.npz", "s_10.npz", "s_7.npz"), [None, 1.0, None])
    assert order.times == (3, 7, 10) and order.indices == (0, 2, 1) and not order.by_files
    assert in_order(paths("b.npz", "a.npz"), [None, None]).indices == (0, 1)


def test_two_files_of_one_time_are_refused_by_name():
    with pytest.raises(ValueError, match=r"s_0.npz and s_1.npz are both of time 0.5"):
        in_order(paths("s_0.npz", "s_1.npz"), [0.5, 0.5])
