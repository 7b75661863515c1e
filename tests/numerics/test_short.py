"""Words about arrays: of numbers, tracers, and whatever else stands in their places."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxsph.numerics.trees import MAX_LOOKED_AT, count_of, kind_of, line_of, numbers_in, row_of, span_of


def traced(word, value):
    told = []
    jax.make_jaxpr(lambda one: told.append(word(one)) or one)(value)
    return told[0]


def test_ranges_are_of_what_is_valid_and_no_nan():
    numbers = np.array([3, -1, np.nan, 100.0])
    assert span_of(numbers, numbers < 50) == "-1 to 3"
    assert span_of(jnp.float32(2)) == span_of(2) == span_of(np.full(3, 2)) == "2"
    assert span_of(np.zeros(0)) == span_of(numbers, np.zeros(4, bool)) == "of nothing"
    assert row_of(np.array([1, 2.5])) == "(1, 2.5)"
    assert count_of(np.array([True, False, True])) == "2"


def test_what_cannot_be_looked_at_is_told_by_type_and_shape():
    for word in (span_of, row_of):
        assert traced(word, jnp.zeros(3)) == "float32[3]"
        assert word(object()) == "object" and word(None) == "NoneType"
    assert traced(count_of, jnp.ones(3, bool)) == "in bool[3]"
    assert kind_of(jax.ShapeDtypeStruct((2, 3), np.int32)) == "int32[2,3]"
    gone = jnp.zeros(3)
    gone.delete()
    assert span_of(gone) == "float32[3]"
    assert numbers_in(np.broadcast_to(np.float32(0), MAX_LOOKED_AT + 1)) is None


def test_lines_leave_out_what_there_is_not():
    assert line_of("Plan", "1 x 2", None, "", "3 MB") == "Plan(1 x 2, 3 MB)"
