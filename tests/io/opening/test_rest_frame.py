"""Velocities without that of the whole, and names that are about a centre, in what files show."""

import numpy as np
import pytest
from commanded import run
from refusals import refused

import jaxsph as js
from jaxsph import io
from jaxsph.io.opening.rest_frame import in_frame
from jaxsph.io.table import ParticleTable

COUNT = 400
RNG = np.random.default_rng(0)
SIDE = (1.0, 1.0, 1.0)
CLUMP = np.mod(np.concatenate([RNG.normal(0, 0.01, (50, 3)), RNG.uniform(0.2, 0.8, (COUNT - 50, 3))]), 1)  # across the faces
MASS = np.linspace(1, 2, COUNT)
VELOCITY = np.where(np.arange(COUNT)[:, None] < 50, (3.0, 4.0, 5.0), RNG.normal(size=(COUNT, 3)))
TABLE = ParticleTable(CLUMP, {"mass": MASS, "vel": VELOCITY}, np.full(COUNT, 0.2), box_size=SIDE)
TINY = ["--size", "8x8", "--box-size", "1,1,1"]
pytestmark = pytest.mark.usefixtures("quick_programs")


@pytest.fixture
def file(empty):
    """The same in a file."""
    np.savez("gas.npz", position=CLUMP, mass=MASS, vel=VELOCITY, support=np.full(COUNT, 0.2))
    return "gas.npz"


@pytest.mark.parametrize(
    ("frame", "bulk"), [("mass", np.average(VELOCITY, axis=0, weights=MASS)), ("densest", (3, 4, 5)), ("none", 0)]
)
def test_velocities_are_relative_to_the_frame(frame, bulk):
    table = in_frame(TABLE, frame)
    np.testing.assert_allclose(table.columns["vel"], VELOCITY - bulk, atol=1e-12)
    assert ("the mean by mass of" in " ".join(table.conventions)) == (frame != "none")
    refused("`frame` = 'mass' needs velocities", in_frame, ParticleTable(CLUMP), "mass")
    assert len(in_frame(ParticleTable(np.zeros((0, 3))), frame)) == 0


def test_every_command_takes_the_bulk_velocity_out(file, capsys):
    for command, more in (("project", ["--of", "velocity.los", "--weight", "mass"]), ("slice", ["--of", "vx"])):
        values = []
        for frame in ("none", "densest"):
            code, _, err = run(capsys, command, file, *TINY, *more, "--frame", frame, "-o", "out.npy")
            assert (code, err) == (0, [])
            values.append(np.load("out.npy"))
        np.testing.assert_allclose(values[1], values[0] - (-5 if command == "project" else 3), atol=1e-4)
    code, out, _ = run(capsys, "project", file, *TINY, "--where", "speed < 0.001", "--frame", "densest", "-o", "out.npy")
    assert code == 0 and "50 of 400 particles" in out and "the mean by mass of the 32 particles" in out
    scene, _ = io.read_scene(file, color_by="speed", box=SIDE, frame="densest")
    assert np.sort(scene.particle_set.to_numpy()["quantity"])[:50].max() < 1e-5
    shown = js.sequence.Snapshots.from_files([file], "speed", box=SIDE, frame="densest").at(0)
    assert np.sort(shown.particle_set.to_numpy()["quantity"])[:50].max() < 1e-5


def test_radii_are_from_the_center_of_the_view(file, capsys):
    away = CLUMP - (0.1, 0.2, 0.3)
    radius = np.linalg.norm(away - np.round(away), axis=1)
    code, out, _ = run(capsys, "project", file, *TINY, "--center", "0.1,0.2,0.3", "--where", "radius < 0.3", "-o", "out.npy")
    assert code == 0 and f"{(radius < 0.3).sum()} of 400 particles" in out and "radius is about 0.1 0.2 0.3" in out
    scene, _ = io.read_scene(file, color_by="radius", center=(0.1, 0.2, 0.3), box=SIDE)
    np.testing.assert_allclose(scene.particle_set.to_numpy()["quantity"], radius, rtol=1e-5)
    scene, _ = io.read_scene(file, color_by="velocity.radial", center="densest", box=SIDE)
    assert scene.particle_set.num_particles == COUNT
