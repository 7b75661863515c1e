"""The cut holds the highest nodes that are small, all of them and no other, by an octree made one node at a time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import jaxsph as js
from jaxsph.access.morton import DIGITS, morton_keys
from jaxsph.access.octree_cut import octree_cut

COUNT = 24


def camera(projection="perspective", distance=6.0):
    size = {"width": 32, "height": 32, "near": distance - 2, "far": distance + 2}
    eye = np.array([0.0, 0.0, -distance], np.float32)
    if projection == "perspective":
        return js.Camera.look_at(eye, np.zeros(3), fov_degrees=30.0, **size)
    return js.Camera.orthographic(eye, np.zeros(3), view_height=3.0, **size)


def is_small(lower, upper, view, pixels):
    """Whether a box in view space is between near and far and no larger than some pixels, in float32 as decisions are."""
    near, far, half = (np.float32(value) for value in (view.near, view.far, view.half_height))
    if not (lower[2] > near and upper[2] < far):
        return False
    spans = [(lower[k], upper[k]) for k in range(2)]
    deep = upper[2] - lower[2]
    if view.is_perspective:
        spans = [(min(low / lower[2], low / upper[2]), max(high / lower[2], high / upper[2])) for low, high in spans]
        deep = deep / lower[2]
    return max([high - low for low, high in spans] + [deep]) <= np.float32(pixels) * 2 * half / 32


def heads_by_recursion(keys, lower, upper, view, pixels):
    """Of each sphere, the number of its node in the cut, or None."""
    found = {}

    def descend(members, level):
        box = lower[members].min(0), upper[members].max(0)
        if is_small(*box, view, pixels):
            found.update(dict.fromkeys(members.tolist(), int(members[0])))
        elif level > 0:
            for digit in range(8):
                descend_into = members[(keys[members] >> (3 * (level - 1))) & 7 == digit]
                if len(descend_into):
                    descend(descend_into, level - 1)

    descend(np.arange(len(keys)), DIGITS)
    return [found.get(k) for k in range(len(keys))]


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@settings(max_examples=20)
@given(
    hnp.arrays(np.float32, (COUNT, 3), elements=st.floats(-1, 1, width=16), fill=st.nothing()),
    st.sampled_from([1e-3, 0.03, 0.3]),
    st.sampled_from([0.5, 2.0, 30.0]),
)
def test_the_cut_is_that_of_an_octree_walked_from_its_root(projection, position, radius, pixels):
    spheres, view = js.Particles.from_arrays(position, np.float32(radius), 0.0, capacity=COUNT), camera(projection)
    cut = jax.jit(octree_cut)(spheres, view, pixels)
    order, head = np.asarray(cut.order), np.asarray(cut.head)
    keys = np.asarray(morton_keys(spheres))[order]
    center = np.asarray(jax.jit(view.to_view)(spheres.position))[order]
    support = np.asarray(spheres.support)[order, None]
    expected = heads_by_recursion(keys, center - support, center + support, view, pixels)
    assert [k if node is None else node for k, node in enumerate(expected)] == head.tolist()


def test_what_is_not_valid_is_in_no_node():
    spheres = js.Particles.from_arrays(np.zeros((3, 3), np.float32), np.float32(1e-3), 0.0, capacity=8)
    cut = octree_cut(spheres, camera(), 2.0)
    assert np.asarray(cut.head).tolist() == [0, 0, 0, 3, 4, 5, 6, 7]


def test_a_point_that_has_no_place_joins_no_node():
    position = jnp.zeros((4, 3)).at[2].set(jnp.nan)
    spheres = js.Particles(position, jnp.full(4, 1e-3), jnp.zeros(4), jnp.ones(4), jnp.ones(4, bool))
    cut = octree_cut(spheres, camera(), 2.0)
    node = dict(zip(np.asarray(cut.order).tolist(), np.asarray(cut.head).tolist(), strict=True))
    assert node[0] == node[1] == node[3] == 0
    assert np.asarray(cut.order)[node[2]] == 2
