import numpy as np
import pytest
from refusals import refused

from jaxsph.io.table import ParticleTable, table_from_columns, time_of


def test_big_endian_arrays_become_native():
    table = ParticleTable(np.ones((2, 3), ">f4"), {"a": np.arange(2, dtype=">i8")}, support=np.ones(2, ">f8"))
    assert table.position.dtype == np.float32 and table.position.dtype.isnative
    assert table.columns["a"].dtype.isnative and table.support.dtype.isnative
    np.testing.assert_array_equal(table.columns["a"], [0, 1])


def test_columns_of_width_one_become_scalars():
    table = ParticleTable(np.zeros((4, 3)), {"a": np.zeros((4, 1)), "b": np.zeros((4, 2))})
    assert table.columns["a"].shape == (4,)
    assert table.scalars == ("a",) and table.vectors == ("b",)


def test_positions_that_are_not_finite_are_counted_and_the_first_is_named():
    position = np.zeros((9, 3))
    position[4, 1], position[7, 0] = np.nan, np.inf
    refused(r"2 of 9 are not, the first at index 4: \[0.0, nan, 0.0\]", ParticleTable, position)


@pytest.mark.parametrize("name", ["support", "volume"])
@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_supports_and_volumes_must_be_positive(name, bad):
    with pytest.raises(ValueError, match=f"`{name}`.*1 of 3 values are not, the first at index 2"):
        ParticleTable(np.zeros((3, 3)), **{name: np.array([1.0, 1.0, bad])})


def test_columns_of_another_length_are_refused_by_name():
    refused(r"column `a` has shape \(3,\), but there are 4 particles", ParticleTable, np.zeros((4, 3)), {"a": np.zeros(3)})


def test_positions_of_another_shape_are_refused():
    refused(r"shape \(N, 3\), got \(4, 2\)", ParticleTable, np.zeros((4, 2)))


def test_columns_of_words_are_refused_by_name():
    refused("column `a` must hold numbers", ParticleTable, np.zeros((1, 3)), {"a": np.array(["b"])})


def test_an_empty_table_is_allowed():
    assert len(ParticleTable(np.zeros((0, 3)), {"a": np.zeros(0)}, support=np.zeros(0))) == 0


def test_positions_keep_their_precision_and_integers_become_float64():
    assert ParticleTable(np.zeros((1, 3), np.float32)).position.dtype == np.float32
    assert ParticleTable(np.zeros((1, 3), int)).position.dtype == np.float64


def test_a_support_column_is_the_support_and_said_so():
    table = table_from_columns(np.zeros((2, 3)), {"Support_Radius": np.ones(2), "volume": np.ones(2)}, source="s")
    np.testing.assert_array_equal(table.support, [1, 1])
    assert "support = column `Support_Radius`" in table.conventions and table.columns == {}


def test_a_smoothing_length_of_unknown_convention_is_kept_but_not_used():
    table = table_from_columns(np.zeros((2, 3)), {"h": np.ones(2)}, source="s")
    assert table.support is None and "h" in table.columns
    assert any("differs between codes" in sentence for sentence in table.conventions)


@pytest.mark.parametrize("shape", [(0, 2**16 + 1), (3, 0)])
def test_columns_wider_than_any_or_of_no_width_are_refused(shape):
    with pytest.raises(ValueError, match=r"column `a` has shape \(., \d+\).* 1 to 65536 numbers a particle"):
        ParticleTable(np.zeros((shape[0], 3)), {"a": np.zeros(shape)})


@pytest.mark.parametrize(
    ("stored", "time"),
    [(0.5, 0.5), (np.float32([0.25]), 0.25), (3, 3.0), ((), None), ([1, 2], None), (np.nan, None), ("late", None)],
)
def test_a_time_is_one_finite_number_or_not_known(stored, time):
    assert time_of(stored) == time
