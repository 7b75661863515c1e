"""Clips hold what planes, boxes and spheres say: points, ways through them, and boxes beside them, rounding included."""

from __future__ import annotations

import dataclasses
import functools

import jax
import numpy as np
import pytest
from derivatives import QUICKLY
from examples import examples
from hypothesis import given, strategies as st

import jaxsph as js
from jaxsph.model import clips
from jaxsph.model.camera.directions import corners_of
from jaxsph.reference import where

PLANE, BOX, BALL = (
    js.Plane((0.1, 0.2, -0.1), (1, 0.4, -2)),
    js.Box((-0.5, -0.4, -0.9), (0.6, 0.7, 0.3)),
    js.Sphere((0.2, 0, 0.1), 0.6),
)
CLIPS = {
    "plane": PLANE,
    "box": BOX,
    "sphere": BALL,
    "outside of a box": ~BOX,
    "outside of a sphere": ~BALL,
    "both": PLANE & BOX & ~BALL,
    "either": BALL | ~PLANE,
}
WHERE = st.integers(0, 2**31)
CAMERA = js.Camera.look_at(eye=(1.2, 2.1, -2.7), target=(0.1, 0, 0), width=8, height=8, near=1.0, far=5.0)


def inside(clip, place):
    """In float64, from the definition."""
    name = next(name for name, one in CLIPS.items() if one is clip)
    plane = (place - np.array([0.1, 0.2, -0.1])) @ np.array([1, 0.4, -2]) >= 0
    box = ((place >= [-0.5, -0.4, -0.9]) & (place <= [0.6, 0.7, 0.3])).all(-1)
    ball = ((place - np.array([0.2, 0, 0.1])) ** 2).sum(-1) <= 0.36
    return {
        "plane": plane,
        "box": box,
        "sphere": ball,
        "outside of a box": ~box,
        "outside of a sphere": ~ball,
        "both": plane & box & ~ball,
        "either": ball | ~plane,
    }[name]


@pytest.mark.parametrize("clip", CLIPS.values(), ids=CLIPS)
def test_exact_points_are_inside_by_definition(clip):
    place = np.random.default_rng(3).uniform(-1, 1, (500, 3))
    wanted = inside(clip, place)
    assert 0 < wanted.sum() < len(place)
    assert (clips.inside(clip, place) == wanted).all()
    assert (where.inside(clip, place) == wanted).all()


def columns(place):
    return tuple(np.asarray(place, np.float32).T)


@functools.partial(jax.jit, compiler_options=QUICKLY)
def contained(place, seen):
    """Whether places are in each clip, in the world and in a view."""
    views = {name: clip.seen_by(CAMERA).contains(seen) for name, clip in CLIPS.items()}
    return {name: clip.contains(place) for name, clip in CLIPS.items()}, views


@functools.partial(jax.jit, compiler_options=QUICKLY)
def spans(first, last):
    """Of ways, in each clip."""
    return {name: clip.spans(first, last) for name, clip in CLIPS.items()}


@functools.partial(jax.jit, compiler_options=QUICKLY)
def over(lower, upper, place):
    """Of boxes, and of places in them, by each clip in the world and in a view."""
    pairs = {name: (clip, clip.seen_by(CAMERA)) for name, clip in CLIPS.items()}
    return {name: [(clip.over(lower, upper), clip.contains(place)) for clip in pair] for name, pair in pairs.items()}


def near_faces(place):
    """Points that rounding may take for those on the other side."""
    away = [
        (place - np.array([0.1, 0.2, -0.1])) @ np.array([1, 0.4, -2]) / np.linalg.norm([1, 0.4, -2]),
        np.linalg.norm(place - np.array([0.2, 0, 0.1]), axis=-1) - 0.6,
        *(place[..., k] - face for k in range(3) for face in ([-0.5, -0.4, -0.9][k], [0.6, 0.7, 0.3][k])),
    ]
    return np.min(np.abs(away), 0) < 1e-5


@pytest.mark.parametrize("name", CLIPS)
def test_points_are_in_it_as_defined_in_the_world_and_in_a_view(name):
    place = np.random.default_rng(0).uniform(-1, 1, (4000, 3))
    clip, clear = CLIPS[name], ~near_faces(place)
    truth = inside(clip, place)
    assert 0 < truth.mean() < 1
    view = (place - CAMERA.exact_eye()) @ np.asarray(CAMERA.axes, np.float64).T
    for found in contained(columns(place), columns(view)):
        assert np.array_equal(np.asarray(found[name])[clear], truth[clear])


@pytest.mark.parametrize("name", CLIPS)
def test_ways_are_in_it_where_their_points_are(name):
    rng = np.random.default_rng(1)
    first, last = rng.uniform(-1.5, 1.5, (2, 300, 3))
    clip = CLIPS[name]
    begin, end = (np.asarray(part) for part in spans(columns(first), columns(last))[name])
    assert (begin <= end).all() and (begin >= 0).all() and (end <= 1).all()
    assert (begin[1:] >= end[:-1]).all() or (begin[1:][begin[1:] < end[:-1]] == 1).all()
    share = rng.uniform(0, 1, (64, 1, 1))
    place = first + share * (last - first)
    found = ((share[..., 0] >= begin[:, None]) & (share[..., 0] <= end[:, None])).any(0)
    clear = ~near_faces(place)
    assert np.array_equal(found[clear], inside(clip, place)[clear])


@examples(30)
@given(WHERE, st.sampled_from(list(CLIPS)), st.sampled_from([1e-3, 0.1, 1.0]))
def test_what_is_said_of_boxes_holds_for_each_of_their_points(seed, name, size):
    """Drawn from their corners and faces as often as from inside, with all rounding of float32."""
    rng = np.random.default_rng(seed)
    lower = rng.uniform(-1.5, 1.5, (50, 3)).astype(np.float32)
    upper = (lower + size * rng.uniform(0, 1, (50, 3))).astype(np.float32)
    share = rng.choice([0, 1, rng.uniform()], (40, 50, 3)).astype(np.float32)
    place = np.clip(lower + share * (upper - lower), lower, upper)
    said = over(columns(lower), columns(upper), tuple(place[..., k] for k in range(3)))
    for found, held in jax.tree.map(np.asarray, said[name]):
        assert (held | ~found.holds).all()
        assert (~held | found.meets).all()


@examples(30)
@given(WHERE, st.sampled_from(list(CLIPS)))
def test_what_is_in_a_box_lies_between_its_ends_along_any_direction(seed, name):
    rng = np.random.default_rng(seed)
    lower = rng.uniform(-1.2, 0.5, 3)
    upper, along = lower + rng.uniform(0.1, 2, 3), rng.normal(size=3)
    along /= np.linalg.norm(along)
    place = lower + rng.choice([0, 1, *rng.uniform(size=6)], (600, 3)) * (upper - lower)
    for clip, held in ((CLIPS[name], inside(CLIPS[name], place)), (~CLIPS[name], ~inside(CLIPS[name], place))):
        low, high = clip.ends(along, lower, upper)
        there = place[held] @ along
        assert ((there >= low - 1e-6) & (there <= high + 1e-6)).all()
        corners = corners_of(lower, upper) @ along
        assert not low < high or (low >= corners.min() - 1e-6 and high <= corners.max() + 1e-6)


@pytest.mark.parametrize(
    ("clip", "ends"),
    [
        (js.Plane((0, 0.5, 0), (0, 1, 1)), (-0.5, 1)),
        (js.Box((-3, -3, -0.25), (3, 3, 0.5)), (-0.25, 0.5)),
        (js.Sphere((0, 0, -1), 0.5), (-1, -0.5)),
        (js.Plane((0, 0, 0.25), (0, 0, 1)) | js.Sphere((0, 0, -0.5), 0.25), (-0.75, 1)),
        (js.Plane((0, 0, 0.5), (0, 0, -1)) & ~js.Plane((0, 0, -0.125), (0, 0, -1)), (-0.125, 0.5)),
        (js.Sphere((9, 0, 0), 0.5), (np.inf, -np.inf)),
    ],
)
def test_ends_are_those_of_what_is_left_of_a_cube(clip, ends):
    low, high = clip.ends(np.array([0.0, 0.0, 1.0]), np.full(3, -1.0), np.full(3, 1.0))
    assert (low, high) == pytest.approx(ends, abs=1e-6)


def test_a_corner_far_from_the_origin_keeps_the_digits_of_float64():
    box = js.Box(np.array([1e7, 0, 0]), np.array([1e7 + 0.25, 1, 1]))
    assert np.asarray(box.sides)[0] == 0.25
    assert box.corners()[1][0] == 1e7 + 0.25
    camera = js.Camera.look_at(eye=(1e7, 0.5, -3), target=(1e7, 0.5, 0), width=8, height=8, near=1.0, far=5.0)
    assert np.asarray(jax.jit(lambda box: box.seen_by(camera).sides)(box))[0] == 0.25


FAR = np.array([1e8 + 0.7, -7e6 - 0.41, 2e7 + 0.77])
FAR_OFF = {
    "sphere": (js.Sphere(FAR, 2.0), "center", {"radius": 3.0}),
    "plane": (js.Plane(FAR, (0, 0, 1)), "point", {"normal": (0, 1, 0)}),
    "lower corner": (js.Box(FAR, FAR + 1.5), "lower", {"upper": FAR + 2.25}),
    "upper corner": (js.Box(FAR - 1.5, FAR), "upper", {"lower": FAR - 2.25}),
}


def exact_place(clip, name):
    """In float64."""
    rest = np.asarray(clip.rest, np.float64)
    return np.asarray(getattr(clip, name), np.float64) + (rest[int(name == "upper")] if isinstance(clip, js.Box) else rest)


far_off = pytest.mark.parametrize(("clip", "name", "other"), FAR_OFF.values(), ids=FAR_OFF)


@far_off
def test_a_far_clip_keeps_its_digits_where_other_fields_are_put_in(clip, name, other):
    """Also of a tree made anew."""
    wanted = exact_place(clip, name)
    np.testing.assert_allclose(wanted, FAR, rtol=0, atol=1e-6)
    again = jax.tree.unflatten(jax.tree.structure(clip), jax.tree.leaves(clip))
    for one in (clip, again):
        np.testing.assert_array_equal(exact_place(dataclasses.replace(dataclasses.replace(one, **other)), name), wanted)


@far_off
def test_a_far_clip_takes_the_digits_of_another_place(clip, name, other):
    place = FAR - 0.125
    for other_place in (place, place.tolist()):
        np.testing.assert_allclose(exact_place(dataclasses.replace(clip, **{name: other_place}), name), place, rtol=0, atol=1e-6)
    coarse = np.asarray(getattr(clip, name)).astype(np.float64).tolist()
    np.testing.assert_array_equal(exact_place(dataclasses.replace(clip, **{name: coarse}), name), coarse)


@far_off
def test_a_far_clip_moved_along_an_axis_keeps_the_digits_of_the_others(clip, name, other):
    step = np.float32([0, 0, -1024 if name == "lower" else 1024])
    moved = np.asarray(getattr(clip, name)) + step
    for place in (moved, jax.device_put(moved)):
        found = exact_place(dataclasses.replace(clip, **{name: place}), name)
        np.testing.assert_array_equal(found[:2], exact_place(clip, name)[:2])
        assert found[2] == moved[2]


def larger(ball, by):
    return dataclasses.replace(ball, radius=ball.radius + by)


def test_clips_are_pytrees_of_arrays():
    clip = PLANE & ~BALL
    again = jax.tree.unflatten(jax.tree.structure(clip), jax.tree.leaves(clip))
    assert jax.tree.structure(again) == jax.tree.structure(clip)
    assert len(jax.tree.leaves(jax.tree.map(np.zeros_like, clip))) == 6  # a normal of zeros is no fault of JAX's own copies
    moved = dataclasses.replace(PLANE, point=np.zeros(3, np.float32))
    assert np.allclose(moved.normal, PLANE.normal)
    given_away = np.ones(3, np.float32), np.float32([0, 2, 0]), FAR_OFF["sphere"][0]
    compiled, ball = jax.jit(lambda point, normal, ball: (js.Plane(point, normal).normal, larger(ball, point[0])))(*given_away)
    assert np.allclose(compiled, [0, 1, 0])
    np.testing.assert_allclose(exact_place(ball, "center"), FAR, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: js.Plane((0, 0, 0), (0, 0, 0)), "`normal` must not be"),
        (lambda: js.Plane((0, 0, 0), (0, np.nan, 0)), "`normal` must be finite"),
        (lambda: js.Plane((0, 0), (1, 0, 0)), "`point` must have shape"),
        (lambda: js.Box((0, 0, 0), (1, 0, 1)), "`lower` must be below `upper`"),
        (lambda: js.Sphere((0, 0, 0), -1.0), "`radius` must be > 0"),
        (lambda: js.Sphere((0, 0, 0), (1, 2)), "`radius` must have shape"),
        (lambda: js.Scene(within=(1, 2)), "`within` must be"),
    ],
)
def test_bad_clips_are_refused_by_name(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_a_normal_of_any_length_is_taken():
    for length in (1e-200, 1.0, 1e200):
        assert np.allclose(js.Plane((0, 0, 0), np.array([0, 3, 4]) * length).normal, [0, 0.6, 0.8])


def test_what_is_no_clip_is_not_combined_with_one():
    with pytest.raises(TypeError):
        PLANE & 3
