"""No pixel of splats is further from chords than its bound, whatever is attempted; and what is not wrong has hardly any bound."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import jaxsph as js
from jaxsph.access.lists import ListPlan
from jaxsph.cast.batches import CastPlan
from jaxsph.cast.splat_bound import bounds_of
from jaxsph.field.moved import Moved

SETTINGS = js.Settings(samples=21)
COUNT = 6
WIDTH, HEIGHT = 12, 11
PLAN = js.Plan(WIDTH, HEIGHT, SETTINGS.samples, COUNT, 3, 1, ListPlan(1, 1, COUNT, 4 * COUNT), CastPlan(16, 4, 48), 0)
unit = st.floats(0, 1, width=32)


def numbers(*shape):
    return hnp.arrays(np.float64, shape, elements=unit, fill=st.nothing())


def camera(projection="perspective", near=1.6, far=3.4):
    frame = {"width": WIDTH, "height": HEIGHT, "near": near, "far": far}
    if projection == "perspective":
        return js.Camera.look_at(np.array([0.1, 0.2, -2.5]), np.zeros(3), fov_degrees=40.0, **frame)
    return js.Camera.orthographic(np.array([0.1, 0.2, -2.5]), np.zeros(3), view_height=1.8, **frame)


@st.composite
def point_sets(draw, profile, **given):
    """Few points: apart, overlapping, in the same place, cut by near and far; from nothing to walls."""
    centre = draw(st.sampled_from([1.0, 0.3, 0.0])) * (2 * draw(numbers(COUNT, 3)) - 1)
    centre[:, 2] += draw(st.sampled_from([0.0, -0.8, 0.8]))
    radius = draw(st.sampled_from([0.02, 0.2, 0.8])) * (0.1 + draw(numbers(COUNT)))
    weight = draw(hnp.arrays(np.float64, COUNT, elements=st.sampled_from([0.0, 0.1, 1.0, 5.0, 1e3, 1e9]), fill=st.nothing()))
    color = np.round(draw(numbers(COUNT, 3)))
    return js.Points.from_arrays(centre, radius, color, weight / radius, profile, capacity=COUNT, **given)


def chords(scene):
    points = tuple(dataclasses.replace(one, spread="chords", splats_beyond=None) for one in scene.point_sets)
    return dataclasses.replace(scene, points=points)


def wrong(scene, view, plan=PLAN):
    """By how much splats differ from chords, in the worst of channels and alpha; and the bound."""
    splats, truth = js.render(scene, view, SETTINGS, plan=plan), js.render(chords(scene), view, SETTINGS, plan=plan)
    layers = [np.asarray(jnp.concatenate([image.color, image.alpha[..., None]], -1)) for image in (splats, truth)]
    bound = js.splat_bound(scene, view, SETTINGS, plan=plan and dataclasses.replace(plan, integrator="splat_bound"))
    return np.abs(layers[0] - layers[1]).max(-1), np.asarray(bound)


def volume():
    values = np.linspace(0, 1, 27).reshape(3, 3, 3)
    look = js.TransferFunction.from_points(np.array([0.0, 1.0]), np.array([[0.0, 1, 0], [1, 0, 1]]), np.array([0.0, 3.0]))
    return {"volume": js.Volume.from_array(values, np.full(3, -0.6), 0.6), "volume_transfer": look}


CASES = [  # each is three programs
    ("perspective", "gaussian", {"splats_beyond": 2.5}, True),
    pytest.param("orthographic", "ball", {"spread": "centres"}, False, marks=pytest.mark.slow),
    pytest.param("perspective", "gaussian", {"spread": "feet"}, False, marks=pytest.mark.slow),
    pytest.param("perspective", "ball", {"spread": "centres"}, True, marks=pytest.mark.slow),
]


@pytest.mark.slow
@pytest.mark.parametrize(("projection", "profile", "spread", "with_volume"), CASES)
@settings(max_examples=50, phases=[Phase.explicit, Phase.reuse, Phase.generate])
@given(st.data())
def test_no_pixel_is_further_off_than_its_bound(projection, profile, spread, with_volume, data):
    with jax.enable_x64(True):
        scene = js.Scene(points=data.draw(point_sets(profile, **spread)), **(volume() if with_volume else {}))
        difference, bound = wrong(scene, camera(projection))
        assert (difference <= bound).all()
        assert (bound <= 1).all()


def rounding(dtype):
    return (4 * SETTINGS.samples + 64) * np.finfo(dtype).eps


@pytest.mark.slow
def test_points_alone_on_their_rays_are_not_wrong():
    with jax.enable_x64(True):
        center = np.array([[-0.4, 0, 0], [0.4, 0, 0.2]])
        scene = js.Scene(points=js.Points.from_arrays(center, 0.3, opacity=0.9, spread="centres", capacity=COUNT))
        difference, bound = wrong(scene, camera())
        assert difference.max() <= rounding(np.float64)
        assert bound.max() <= 1e-9  # rounding alone: of chords that only just meet a point, by the root of eps


@pytest.mark.slow
def test_what_no_point_is_a_splat_of_is_not_wrong():
    points = js.Points.from_arrays(np.float32([[0, 0, 0], [0, 0, 0.1]]), 0.5, opacity=0.9, capacity=COUNT)
    _, bound = wrong(js.Scene(points=points), camera())
    np.testing.assert_array_equal(bound, np.float32(rounding(np.float32)))


@pytest.mark.slow
def test_two_walls_that_change_places_have_no_bound_but_one():
    """Centre of a large red ball in front of that of a small blue one, whose chord is the first to be met."""
    with jax.enable_x64(True):
        center, radius = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.2]]), np.array([0.15, 0.6])
        given = {"color": np.array([[1.0, 0, 0], [0, 0, 1.0]]), "extinction": 1e4, "profile": "ball"}
        scene = js.Scene(points=js.Points.from_arrays(center, radius, spread="centres", capacity=COUNT, **given))
        difference, bound = wrong(scene, camera())
        assert difference[5, 6] > 0.999
        assert bound[5, 6] == 1


def test_a_bound_is_second_order_in_thickness():
    with jax.enable_x64(True):
        bounds = []
        for opacity in (1e-3, 2e-3):
            center = np.array([[0.1, 0.2, 0.0], [0.1, 0.2, 0.15]])
            points = js.Points.from_arrays(center, 0.4, opacity=opacity, spread="centres", capacity=COUNT)
            bounds.append(wrong(js.Scene(points=points), camera())[1][5, 6])
        assert bounds[1] / bounds[0] == pytest.approx(4, rel=0.01)


def test_what_is_wrong_further_back_is_dimmed_by_what_stays_in_front():
    nothing = Moved(*(jnp.zeros((1, 2, 1)) for _ in Moved._fields))
    moved = nothing._replace(past=jnp.float32([[[0], [9]]]), past_mean=jnp.float32([[[0], [9]]]))
    ahead, wrong_by = bounds_of(jnp.float32([[[2], [1]]]), moved, jnp.zeros((1, 1, 1)))
    np.testing.assert_allclose(ahead[0, :, 0], [2, 1])
    np.testing.assert_allclose(wrong_by[0, :, 0], [0, (1 - np.exp(-1)) * (1 - np.exp(-9))], rtol=1e-6)


@pytest.mark.slow
def test_under_jit_it_is_what_it_is_eagerly():
    scene = js.Scene(points=js.Points.from_arrays(np.float32([[0, 0, 0], [0, 0, 0.1]]), 0.5, opacity=0.9, spread="centres"))
    view = camera()
    plan = js.plan(scene, view, dataclasses.replace(SETTINGS, integrator="splat_bound"))
    eager = js.splat_bound(scene, view, SETTINGS)
    jitted = jax.jit(lambda scene: js.splat_bound(scene, view, SETTINGS, plan=plan))(scene)
    np.testing.assert_allclose(jitted, eager, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("given", "mix", "message"),
    [
        ({}, "opacity", "`mix` must be 'extinction'"),
        ({"profile": np.float32([1, 0])}, "extinction", "`profile` must be 'gaussian' or 'ball'.*Table"),
    ],
)
def test_what_cannot_be_bounded_is_refused(given, mix, message):
    points = js.Points.from_arrays(np.zeros((1, 3)), 0.5, extinction=1.0, spread="centres", **given)
    with pytest.raises(ValueError, match=message):
        js.splat_bound(js.Scene(points=points, mix=mix), camera(), SETTINGS)


@pytest.mark.slow
def test_of_many_small_points_the_bound_is_not_far_from_what_is_wrong():
    with jax.enable_x64(True):
        rng = np.random.default_rng(0)
        center, radius = rng.uniform(-0.7, 0.7, (2000, 3)), rng.uniform(0.02, 0.06, 2000)
        points = js.Points.from_arrays(center, radius, rng.random((2000, 3)), opacity=0.2, spread="centres")
        view = dataclasses.replace(camera(), width=64, height=64)
        difference, bound = wrong(js.Scene(points=points), view, None)
        seen = difference > 1e-6
        ratio = difference[seen] / bound[seen]
        print(
            f"of what is bounded, true: median {np.median(ratio):.3f}, largest {ratio.max():.3f}; largest bound {bound.max():.3f}"
        )
        assert ratio.max() <= 1
        assert np.median(ratio) > 0.02
