"""Classes that `tree` makes are frozen pytrees, told apart by what is static; what is in them fits, or is refused by name."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Bool, Float, Int, Num

import jaxsph as js
from jaxsph.numerics.trees import OPEN, fitting, on_host, tree


@tree(static=("name",))
class Named:
    """A number with a name."""

    value: float
    name: str = "one"


@tree(traced=("value",), unchecked=True, kw_only=True)
class Checked:
    """A number that must be positive."""

    name: str = "one"
    value: float

    def __post_init__(self) -> None:
        if not self.value > 0:
            raise ValueError("`value` must be > 0")


@pytest.mark.parametrize("kind", [Named, Checked])
def test_what_is_static_is_no_leaf_and_what_is_traced_has_its_name(kind):
    one = kind(value=2.0, name="two")
    assert jax.tree.leaves(one) == [2.0]
    assert [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(one)] == [".value"]
    assert jax.tree.structure(one) == jax.tree.structure(kind(value=5.0, name="two"))
    assert jax.tree.structure(one) != jax.tree.structure(kind(value=2.0, name="one"))
    assert jax.tree.map(lambda leaf: leaf + 1, one) == kind(value=3.0, name="two")
    with pytest.raises(dataclasses.FrozenInstanceError):
        one.value = 1.0


def test_programs_are_made_once_for_all_leaves():
    traces = []

    @jax.jit
    def twice(one):
        traces.append(one.name)
        return jax.tree.map(lambda leaf: 2 * leaf, one)

    assert twice(Named(jnp.float32(1.0))).value == 2 and twice(Named(jnp.float32(3.0))).value == 6
    assert twice(Named(jnp.float32(1.0), "two")).name == "two"
    assert traces == ["one", "two"]


def test_what_is_unchecked_holds_whatever_a_transformation_puts_into_its_leaves():
    assert jax.tree.map(lambda _: None, Checked(value=1.0)).value is None
    with pytest.raises(ValueError, match="must be > 0"):
        Checked(value=0.0)


@tree()
class Inner:
    """A part of a part."""

    corner: Float[Array, "3"]


@tree(static=("name",))
class Held:
    """One of all kinds of fields that there are."""

    place: Float[Array, "rows 3"]
    size: Float[Array, " rows"]
    there: Bool[Array, " rows"]
    counts: Num[Array, "x y"]
    weight: Float[Array, " rows_of_columns"]
    more: dict[str, Float[Array, " rows"]]
    far: Float[Array, ""] = dataclasses.field(metadata=OPEN)
    inner: Inner | tuple[Inner, ...] | None = None
    second: Float[Array, " rows_of_columns"] | None = None
    free: Float[Array, "3"] | Any = (1.0, 2.0, 3.0)
    word: Int[Array, ""] | int = 0
    name: str = "one"


ROW = np.ones(4, np.float32)
ROW_OF_JAX = jnp.asarray(ROW)
TABLES = np.ones((4, 3), np.float32), np.ones((2, 5), np.uint8)
WHOLE = Held(TABLES[0], ROW, ROW > 0, TABLES[1], ROW, {"age": ROW}, ROW[0], Inner(ROW[:3]), None, ROW[:3])
WHOLE = jax.tree.map(jnp.asarray, WHOLE)


def with_(**fields):
    return dataclasses.replace(WHOLE, **fields)


def test_what_fits_is_itself():
    assert fitting("held", WHOLE) is WHOLE
    assert fitting("held", with_(far=None)).far is None
    several = with_(inner=(WHOLE.inner, WHOLE.inner), second=jnp.ones(7), weight=jnp.ones(7))
    assert fitting("held", several) is several


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"size": jnp.ones(5)}, r"`size` of `held` must have shape \(4,\), got \(5,\)"),
        ({"size": jnp.ones(())}, r"`size` of `held` must have shape \(4,\), got \(\)"),
        ({"place": jnp.ones((7, 3))}, r"`place` of `held` must have shape \(4, 3\), got \(7, 3\)"),
        ({"place": jnp.ones((4, 2))}, r"`place` of `held` must have shape \(4, 3\), got \(4, 2\)"),
        ({"more": {"age": jnp.ones(3)}}, r"`more` of `held` must have shape \(4,\), got \(3,\)"),
        ({"far": jnp.ones(2)}, r"`far` of `held` must have shape \(\), got \(2,\)"),
        ({"free": (1.0, 2.0)}, r"`free` of `held` must have shape \(3,\), got \(2,\)"),
        ({"inner": Inner(jnp.ones(2))}, r"`corner` of `held.inner` must have shape \(3,\), got \(2,\)"),
        ({"inner": (WHOLE.inner, 2.0)}, r"`inner\[1\]` of `held` must be a `jaxsph.Inner`, got float"),
        ({"size": None}, "`size` of `held` must hold real numbers"),
        ({"size": "wide"}, "`size` of `held` must hold real numbers"),
        ({"size": jnp.ones(4, complex)}, "`size` of `held` must hold real numbers, got dtype complex64"),
        ({"size": [1.0, [2.0]]}, "`size` of `held` must be an array of numbers, got list"),
        ({"there": jnp.ones(4)}, "`there` of `held` must hold booleans, got dtype float32"),
    ],
)
def test_what_does_not_fit_is_refused_by_name_also_under_a_trace(fields, said):
    with pytest.raises(ValueError, match=said):
        fitting("held", with_(**fields))
    if {type(leaf) for leaf in jax.tree.leaves(fields)} == {type(ROW_OF_JAX)}:
        with pytest.raises(ValueError, match=said):
            jax.eval_shape(lambda given: fitting("held", with_(**given)), fields)


def test_plain_numbers_and_lists_become_arrays_of_the_dtype_that_the_others_have():
    made = fitting("held", with_(size=[1, 2, 3, 4], far=2.5, inner=Inner((0, 1, 2)), free=[1.0, 2.0, 3.0]))
    assert made.size.tolist() == [1, 2, 3, 4] and made.far.tolist() == 2.5 and made.inner.corner.tolist() == [0, 1, 2]
    assert {leaf.dtype for leaf in (made.size, made.far, made.inner.corner)} == {jnp.dtype("float32")}
    assert made.free == [1.0, 2.0, 3.0] and made.word == 0
    traced = jax.eval_shape(lambda number: fitting("held", with_(inner=Inner([number, 0.0, 1]))), 2.0).inner.corner
    assert (traced.shape, traced.dtype) == ((3,), jnp.dtype("float32"))


@pytest.mark.parametrize("dtype", [jnp.bfloat16, jnp.float16, jnp.int32])
def test_narrow_floats_and_integers_become_float32_and_small_integers_stay_where_numbers_may_be_any(dtype):
    narrow = jax.tree.map(lambda leaf: leaf.astype(dtype) if leaf.dtype == jnp.float32 else leaf, WHOLE)
    for made in (fitting("held", narrow), jax.eval_shape(lambda given: fitting("held", given), narrow)):
        assert made.size.dtype == made.more["age"].dtype == made.inner.corner.dtype == jnp.float32
        assert made.counts.dtype == jnp.uint8 and made.there.dtype == bool
    assert fitting("held", with_(counts=jnp.ones((2, 5), dtype))).counts.dtype == jnp.float32


def test_where_some_of_a_part_is_float64_all_is():
    with jax.enable_x64(True):
        made = fitting("held", with_(size=jnp.ones(4, jnp.float64), far=2.5))
        assert made.place.dtype == made.far.dtype == made.more["age"].dtype == jnp.float64
        assert made.inner.corner.dtype == jnp.float32  # a part of its own
        assert fitting("held", with_(far=0.1)).far.dtype == jnp.float32


def test_a_verb_of_the_host_refuses_what_is_traced_and_is_done_at_once_within_a_trace():
    @on_host
    def total(held, *, factor=1):
        return float((jnp.asarray(held.size) * factor).sum())

    for given in (lambda one: total(with_(size=one)), lambda one: total(WHOLE, factor=one[0])):
        with pytest.raises(ValueError, match=r"total` needs concrete arrays, and `(held|factor)` is traced"):
            jax.make_jaxpr(given)(WHOLE.size)
    assert jax.jit(lambda one: one * total(WHOLE))(2.0) == 8
    with pytest.raises(ValueError, match=r"`size` of `held` must have shape \(4,\)"):
        total(held=with_(size=jnp.ones(2)))
    with pytest.raises(TypeError, match="positional"):
        total(WHOLE, 2)


def test_other_rules_of_promotion_are_left_to_users():
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        assert on_host(lambda held: float((held.place + held.size[:3] * jnp.int32(1)).sum()))(WHOLE) == 24
        with pytest.raises(ValueError, match="rank_promotion"):
            WHOLE.place + WHOLE.size[:3]


FAR = np.array([[2e5, -1e6, 3e6], [1e6 + 0.3, 2e5 + 0.7, 1e5 + 0.1], [7e5 + 0.2, 1e6, 4e5 + 0.9]])
PLACED = {
    "particles": (js.Particles.from_arrays(FAR, 0.01, 1.0, capacity=3), "position"),
    "points": (js.Points.from_arrays(FAR, 0.01, extinction=1.0, capacity=3), "position"),
    "volume": (js.Volume.from_array(np.zeros((2, 2, 2)), lower=FAR[1]), "lower"),
    "camera": (js.Camera.look_at(FAR[1], FAR[1] + [0, 0, 1]), "eye"),
}
placed = pytest.mark.parametrize(("one", "name"), PLACED.values(), ids=PLACED)


def exact(one, name):
    """The place in float64."""
    return np.asarray(getattr(one, name), np.float64) + np.asarray(getattr(one, f"{name}_rest"), np.float64)


@placed
def test_what_is_put_in_is_of_no_other_place(one, name):
    """Wherever it is put in, and the tree stays the same; what is left of a place is left of the same numbers alone."""
    former = getattr(one, name)
    assert np.abs(getattr(one, f"{name}_rest")).max() > 1e-3
    some = np.arange(former.size).reshape(former.shape) % 2 == 0

    def moved(one, by):
        return dataclasses.replace(one, **{name: getattr(one, name) + by})

    step = jnp.where(some, 0, jnp.float32(2048.5))
    wanted = np.where(some, exact(one, name), np.asarray(former + step, np.float64))
    one_of_many = jax.tree.map(lambda leaf: leaf[0], jax.vmap(moved, (None, 0))(one, step[None]))
    for found in (moved(one, step), jax.jit(moved)(one, step), jax.jit(lambda by: moved(one, by))(step), one_of_many):
        np.testing.assert_array_equal(exact(found, name), wanted)
        assert jax.tree.structure(found) == jax.tree.structure(one)
    other = dataclasses.replace(one, **{name: np.zeros_like(former)})
    assert not exact(dataclasses.replace(other, length_unit="m") if name != "eye" else other, name).any()


@placed
def test_what_stays_where_it_is_keeps_its_digits(one, name):
    """Of other fields that are put in, of pairs that are, and of all leaves that a transformation makes anew."""
    wanted, low = exact(one, name), f"{name}_rest"
    static = {"width": 7} if name == "eye" else {"length_unit": "m"}
    np.testing.assert_array_equal(exact(dataclasses.replace(dataclasses.replace(one, **static)), name), wanted)
    doubled = jax.tree.map(lambda leaf: 2 * leaf if leaf.dtype != bool else leaf, one)
    np.testing.assert_array_equal(exact(dataclasses.replace(doubled, **static), name), 2 * wanted)
    pair = dataclasses.replace(one, **{name: 2 * getattr(one, name), low: 2 * getattr(one, low)})
    np.testing.assert_array_equal(exact(dataclasses.replace(pair, **static), name), 2 * wanted)
    slope = jax.grad(lambda moves: (getattr(moves, name) + getattr(moves, low)).sum(), allow_int=True)(one)
    assert (np.asarray(getattr(slope, name)) == 1).all() and (np.asarray(getattr(slope, low)) == 1).all()
    assert jax.tree.map(lambda _: None, one).placed == (None, None)
