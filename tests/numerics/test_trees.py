"""Classes that `tree` makes are frozen, are pytrees, and are told apart by what is static."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from jaxsph.numerics.trees import tree


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
