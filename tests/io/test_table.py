import numpy as np
import pytest
from refusals import refused

from jaxsph.io.table import ParticleTable, single_number, table_from_columns


def test_big_endian_arrays_become_native():
    table = ParticleTable(np.ones((2, 3), ">f4"), {"a": np.arange(2, dtype=">i8")}, support=np.ones(2, ">f8"))
    assert table.position.dtype == np.float32 and table.position.dtype.isnative
    assert table.columns["a"].dtype.isnative and table.support.dtype.isnative
    np.testing.assert_array_equal(table.columns["a"], [0, 1])


def test_columns_of_width_one_become_scalars():
    table = ParticleTable(np.zeros((4, 3)), {"a": np.zeros((4, 1)), "b": np.zeros((4, 2))})
    assert table.columns["a"].shape == (4,)
    assert table.scalars == ("a",) and table.vectors == ("b",)


POINTS, BROKEN = np.zeros((4, 3)), np.array([[0.0, 0, 0], [0, 0, 0], [0, np.nan, 0], [np.inf, 0, 0]])


@pytest.mark.parametrize(
    ("position", "held", "said"),
    [
        (BROKEN, {}, r"2 of 4 are not, the first at index 2: \[0.0, nan, 0.0\]"),
        (POINTS[:, :2], {}, r"shape \(N, 3\), got \(4, 2\)"),
        (POINTS, {"columns": {"a": np.zeros(3)}}, r"column `a` has shape \(3,\), but there are 4 particles"),
        (POINTS, {"columns": {"a": np.array(["b"] * 4)}}, "column `a` must hold numbers"),
        (POINTS[:0], {"columns": {"a": np.zeros((0, 2**16 + 1))}}, r"column `a` has shape .* 1 to 65536 numbers a particle"),
        (POINTS, {"columns": {"a": np.zeros((4, 0))}}, r"column `a` has shape .* 1 to 65536 numbers a particle"),
        *(
            (POINTS, {name: np.array([1.0, 1, 1, bad])}, f"`{name}`.*1 of 4 values are not, the first at index 3")
            for name in ("support", "volume")
            for bad in (0.0, -1.0, np.nan, np.inf)
        ),
    ],
)
def test_what_particles_cannot_have_is_refused_by_name(position, held, said):
    refused(said, ParticleTable, position, **held)


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


@pytest.mark.parametrize(
    ("stored", "time"),
    [(0.5, 0.5), (np.float32([0.25]), 0.25), (3, 3.0), ((), None), ([1, 2], None), (np.nan, None), ("late", None)],
)
def test_a_time_is_one_finite_number_or_not_known(stored, time):
    assert single_number(stored) == time
