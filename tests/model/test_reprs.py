"""Promises of `repr`: one line with counts and ranges, of whatever is in the leaves."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.analysis.slices import Slice
from jaxsph.model.projection import Projection
from jaxsph.numerics.trees import MAX_LOOKED_AT, count_of, kind_of, line_of, numbers_in, row_of, span_of
from jaxsph.sequence.task import FrameFile

pytestmark = pytest.mark.usefixtures("quick_programs")

POSITION = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
PARTICLES = js.Particles.from_arrays(POSITION, [0.5, 0.5, 1.0], [1.0, 2.0, 4.0])
LOOK = js.TransferFunction.from_points([0.0, 1.0, 5.0], np.ones((3, 3)), [0.0, 1.0, 2.0])
POINTS = js.Points.from_arrays(POSITION, 0.25, extinction=2.0, spread="feet")
VOLUME = js.Volume.from_array(np.arange(24.0).reshape(2, 3, 4), spacing=0.5)
CAMERA = js.Camera.look_at((0, 0, 4), (0, 0, 0), width=8, height=6, near=2, far=6)
PLANE = np.zeros((6, 8), np.float32)
COLUMNS = Projection(PLANE + 0.5, None, np.float32(0.1), False, 0, "density", "g/cm**2")
IMAGE = js.Image(np.zeros((6, 8, 3), np.float32), PLANE + 1, PLANE, PLANE + 0.25, PLANE, True, 0, {})

LINES = {
    "Particles(3, poly6, float32, quantity 1 to 4, support 0.5 to 1)": PARTICLES,
    "Particles(3, poly6, float32, quantity 1 to 4, extinction by 2, support 1, periodic)": js.Particles.from_arrays(
        POSITION, 1.0, ([1.0, 2.0, 4.0], 2.0), box=(8, 8, 8)
    ),
    "TransferFunction(3 points, values 0 to 5, extinction 0 to 2)": LOOK,
    "Points(3, float32, radius 0.25, extinction 2, spread at feet)": POINTS,
    "Volume(float32[2,3,4], values 0 to 23, from (0, 0, 0), spacing (0.5, 0.5, 0.5))": VOLUME,
    "Camera(perspective, 8 x 6, eye (0, 0, 4), forward (0, 0, -1), fov 45 degrees, near 2, far 6)": CAMERA,
    "Image(8 x 6, transmittance 1, error 0.25, certified, faults 0)": IMAGE,
    "Projection(float32[6,8], density 0.5 g/cm**2, faults 0)": COLUMNS,
    "Projection(float32[6,8], density 0.5 g/cm**2, faults 0, 12.5% cut off by depths)": dataclasses.replace(
        COLUMNS, metadata=(("jaxsph.cut", 0.125),)
    ),
    f"Scene(particles={PARTICLES!r}, transfer={LOOK!r})": js.Scene(PARTICLES, LOOK),
    f"Scene(volume={VOLUME!r}, volume_transfer={LOOK!r}, mix='opacity')": js.Scene(
        volume=VOLUME, volume_transfer=LOOK, mix="opacity"
    ),
}


@pytest.mark.parametrize(("told", "of"), LINES.items(), ids=[type(of).__name__ for of in LINES.values()])
def test_what_users_hold_is_told_in_a_line(told, of):
    assert repr(of).replace("-0,", "0,") == told


@pytest.mark.parametrize("of", LINES.values(), ids=[type(of).__name__ for of in LINES.values()])
def test_whatever_is_in_the_leaves_there_is_a_line(of):
    name, told = type(of).__name__, []
    jax.make_jaxpr(lambda one: told.append(repr(one)) or jax.tree.leaves(one))(of)
    batched = jax.tree.map(lambda leaf: np.stack([np.asarray(leaf)] * 2), of)
    others = [jax.tree.map(lambda _: other, of) for other in (object(), None, "a", 0)]  # noqa: B023
    for one in (*told, repr(batched), *map(repr, others), repr(jax.eval_shape(lambda: of))):
        assert one.startswith(f"{name}(") and one.endswith(")") and "\n" not in one and len(one) < 400


def test_a_plan_is_told_in_a_line():
    plan = js.plan(js.Scene(PARTICLES, LOOK), CAMERA, js.Settings(samples=8))
    assert repr(plan).startswith("Plan(8 x 6 of 8 samples, 3 particles, ") and repr(plan).endswith(" MB)")


def test_a_slice_and_a_frame_are_told_in_a_line():
    assert repr(Slice(PLANE + 1, CAMERA)) == "Slice(float32[6,8], values 1)"
    frame = FrameFile(3, Path("out/0003.png"), True, {"seconds": {"cast": 0.1}})
    assert repr(frame) == "FrameFile(3, out/0003.png, rendered)"
    assert repr(dataclasses.replace(frame, rendered=False)).endswith("there already)")


def test_particles_have_a_length():
    assert len(PARTICLES) == 3 and len(PARTICLES.padded(9)) == 3
    assert len(js.Particles.from_arrays(np.zeros((0, 3)), 1.0, 1.0)) == 0
    assert len(dataclasses.replace(PARTICLES, valid=np.array([True, False, False, False]))) == 1


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
