"""The clock of a frame runs what it is given in order, and compiles all that a frame needs side by side."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsph.engine.runtime.clock import Clock
from jaxsph.engine.runtime.programs import Programs, stage

traces = []


@stage()
def double(value):
    traces.append(value.shape)
    return 2 * value


@stage()
def halved(value):
    return value / 2, jnp.full((), 0.5)  # of a weak type


@pytest.fixture(autouse=True)
def no_traces():
    traces.clear()


def ones(size, dtype=np.float32):
    return np.ones(size, dtype)


def test_a_program_is_compiled_once_for_shapes_and_static_arguments():
    clock = Clock(programs=Programs())
    for value, wanted in ((ones(3), 1), (0 * ones(3), 1), (ones(4), 2), (ones(3, np.int32), 3), (ones(3), 3)):
        assert clock.one("cast", double, (value,)).shape == value.shape
        assert len(traces) == wanted


@pytest.mark.parametrize("number", [1, 2, 5])
def test_results_come_in_the_order_of_inputs(number):
    clock = Clock(programs=Programs())
    found = clock.each("cast", double, [(np.float32(k),) for k in range(number)])
    assert [float(value) for value in found] == [2 * k for k in range(number)]
    assert clock.seconds["cast"] > 0 and clock.seconds["grid"] == 0


def test_the_first_missing_program_has_all_of_them_compiled():
    programs, lengths = Programs(), []
    clock = Clock(programs=programs)

    def draw():
        first = clock.one("cast", double, (ones(6),))
        lengths.append((len(programs), isinstance(first, jax.core.Tracer)))
        return clock.one("cast", double, (clock.one("cast", halved, (first,))[1],))

    assert float(clock.run(draw)) == 1
    assert lengths == [(1, True), (3, False)], "they are traced by shapes, before the first of them is run"
    assert traces == [(6,), ()]
    assert float(clock.run(draw)) == 1 and lengths[2:] == [(3, False)], "nothing is missing"


def test_what_is_to_come_later_can_be_compiled_as_well():
    programs = Programs()
    clock = Clock(programs=programs)
    clock.run(lambda: clock.one("cast", double, (ones(3),)), ahead=lambda: clock.one("cast", double, (ones(4),)))
    assert traces == [(4,), (3,)] and len(programs) == 2


def test_arrays_on_a_chosen_device_are_compiled_for_once():
    clock, here = Clock(programs=Programs()), jax.devices("cpu")[-1]
    value = jax.device_put(ones(3), here)
    made = clock.run(lambda: clock.one("cast", double, (clock.one("cast", halved, (value,))[0],)))
    assert made.devices() == {here} and traces == [(3,)]


def test_progress_is_of_bands_that_are_drawn():
    told = []
    clock = Clock(programs=Programs(), progress=lambda done, total: told.append((done, total)))
    drawn = clock.run(lambda: clock.over([0, 16, 32], lambda row: clock.one("cast", double, (row,))))
    assert [int(one) for one in drawn] == [0, 32, 64] and told == [(1, 3), (2, 3), (3, 3)]


def test_within_a_trace_stages_are_part_of_it():
    clock = Clock(traced=True)
    total = jax.jit(lambda value: clock.one("cast", double, (value,)).sum())
    assert float(total(ones(3))) == 6 and clock.seconds["cast"] == 0


def test_a_program_that_cannot_be_compiled_is_tried_again():
    @stage()
    def broken(value):
        traces.append(value.shape)
        if len(traces) == 1:
            raise RuntimeError("no luck")
        return value

    clock = Clock(programs=Programs())
    with pytest.raises(RuntimeError, match="no luck"):
        clock.one("cast", broken, (ones(3),))
    assert clock.one("cast", broken, (ones(3),)).shape == (3,)
