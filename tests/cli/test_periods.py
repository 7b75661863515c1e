"""What columns and planes show of a periodic set is what its field is there, wherever the faces of its box are."""

import commanded
import numpy as np
import pytest

import jaxsph as js
from jaxsph.model.preview.frame import halfway

pytestmark = pytest.mark.usefixtures("quick_programs", "empty")
COUNT = 60
SIDES = np.array([1.0, 1.5, 2.0])
BOX = "1,1.5,2"
MIDDLE = SIDES / 2


def disc():
    """A flat blob that turns about an oblique axis, around the origin."""
    rng = np.random.default_rng(3)
    axis = np.array([1.0, 2.0, 2.0]) / 3
    away = 0.08 * rng.normal(size=(COUNT, 3))
    away -= 0.9 * (away @ axis)[:, None] * axis
    return away, np.cross(axis, away)


def values(capsys, command, place, *arguments):
    """What a command writes of the disc at a place."""
    away, velocity = disc()
    columns = {"mass": np.ones(COUNT), "heat": 1 + away[:, 0], "velocity": velocity, "support": np.full(COUNT, 0.1)}
    np.savez("a.npz", position=np.mod(away + place, SIDES), **columns)
    how = ["a.npz", "--box-size", BOX, "--size", "18x12", "-o", "out.npy", *arguments]
    code, _, err = commanded.run(capsys, command, *how)
    assert (code, err) == (0, []), err
    return np.load("out.npy")


def written(place):
    return ",".join(map(str, np.asarray(place).tolist()))


CORNER = np.array([0.0, 1.5, 0.01])
WAYS = {
    "a width": lambda at: ["--width", "0.6", "--view", "x"],
    "a center": lambda at: ["--width", "0.6", "--center", written(at)],
    "a slab": lambda at: ["--width", "0.6", "--center", written(at), "--depth-range", f"{at[2] - 0.05},{at[2] + 0.02}"],
    "a slab a period off": lambda at: [
        "--width",
        "0.6",
        "--center",
        written(at),
        "--depth-range",
        f"{at[2] - 2.05},{at[2] - 1.98}",
    ],
    "a ball": lambda at: ["--width", "0.6", "--center", written(at), "--clip", f"sphere:{written(at)},0.1"],
    "a ball alone": lambda at: ["--clip", f"sphere:{written(at)},0.1"],
    "a ball a period off": lambda at: ["--width", "0.6", "--center", written(at + SIDES), "--clip", f"sphere:{written(at)},0.1"],
    "as it turns": lambda at: ["--width", "0.6", "--view", "face-on", "--center", "mass"],
    "around which it turns": lambda at: ["--width", "0.6", "--view", "edge-on"],
}


@pytest.mark.parametrize("way", WAYS)
def test_columns_across_faces_are_those_within(capsys, way):
    within, across = (values(capsys, "project", at, *WAYS[way](at)) for at in (MIDDLE, CORNER))
    assert within.sum() > 0
    np.testing.assert_allclose(across, within, atol=2e-3 * within.max())


PLANES = {
    "a width": lambda at: ["--width", "0.6", "--view", "y"],
    "a plane": lambda at: ["--center", written(at), "--width", "0.6", "--plane", f"{written(at + (0, 0, 0.02))},0,0,1"],
    "a plane a period off": lambda at: ["--center", written(at), "--width", "0.6", "--plane", f"{written(at - SIDES)},0,1,0"],
    "a ball": lambda at: ["--width", "0.6", "--center", written(at), "--clip", f"sphere:{written(at)},0.1"],
    "as it turns": lambda at: ["--width", "0.6", "--view", "face-on"],
}


@pytest.mark.parametrize("way", PLANES)
def test_planes_across_faces_are_those_within(capsys, way):
    within, across = (values(capsys, "slice", at, "--color-by", "heat", *PLANES[way](at)) for at in (MIDDLE, CORNER))
    there = np.isfinite(within)
    assert there.any() and np.count_nonzero(there != np.isfinite(across)) < 3
    there &= np.isfinite(across)
    np.testing.assert_allclose(across[there], within[there], atol=2e-2)


@pytest.mark.parametrize("place", [MIDDLE, CORNER, (0.99, 0.2, 1.0)])
def test_a_slice_of_all_goes_through_the_particles(capsys, place):
    assert np.isfinite(values(capsys, "slice", place, "--color-by", "heat", "--size", "180x120")).any()


def test_what_fills_a_side_keeps_the_middle():
    position = np.random.default_rng(0).random((500, 3)) * (1, 0.2, 0.5) + (0, 0.9, 1.75)
    place = halfway(js.Particles.from_arrays(position % SIDES, 0.05, 1.0, box=SIDES))
    np.testing.assert_allclose((place + 0.25) % SIDES, (0.75, 1.25, 0.25), atol=0.03)
