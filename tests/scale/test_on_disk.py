"""A snapshot that stays on disk: what is read of it, and how it is shown by default."""

import h5py
import numpy as np
import pytest
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from images import seen_from
from snapshots_made import particles, write

import jaxsph as js
from jaxsph.io.disk import index as snapshot_index
from jaxsph.reference.where import ray_coordinates
from jaxsph.scale.on_disk import between_depths, seen_by

QUANTITY = "InternalEnergy"


@pytest.fixture(autouse=True)
def short_runs(monkeypatch):
    monkeypatch.setattr(snapshot_index, "RUN", 256)


def test_only_runs_that_the_rows_can_see_are_read(tmp_path, monkeypatch):
    on_disk = js.scale.OnDisk.open(write(tmp_path, particles(6000)), QUANTITY)
    camera, read = js.Camera.framing(on_disk, width=40, height=72), []
    real = snapshot_index.Snapshot.read

    def reading(self, file, rows, only=None):
        read.append(rows)
        return real(self, file, rows, only)

    monkeypatch.setattr(snapshot_index.Snapshot, "read", reading)
    on_disk.seen_by(seen_by(camera, 0, 8, 0, 40))
    assert 0 < len(read) < 0.7 * len(on_disk.index.runs)


def test_log_density_gives_opacity_where_densities_spread(tmp_path):
    columns = particles(1000)
    columns["Density"] = np.geomspace(1e-3, 10, 1000).astype(np.float32)
    on_disk = js.scale.OnDisk.open(write(tmp_path, columns), QUANTITY, opacity_by="auto")
    assert on_disk.quantities == (QUANTITY, "log10:Density") and on_disk.sample.extinction_quantity is not None
    assert np.asarray(on_disk.transfer().extinction)[0] == 0


@pytest.mark.parametrize("side", [1.0, 0.5], ids=["all inside", "some outside"])
def test_a_periodic_snapshot_is_framed_as_in_memory(tmp_path, side):
    path = write(tmp_path, particles(400))
    for name in ("snap.0.hdf5", "snap.1.hdf5"):
        with h5py.File(tmp_path / name, "r+") as file:
            file["Header"].attrs["BoxSize"] = side
    on_disk, in_memory = js.scale.OnDisk.open(path, QUANTITY), js.io.read_particles(path, QUANTITY)
    assert (in_memory.box is None) == (side < 1)
    np.testing.assert_allclose(on_disk.bounds(), in_memory.bounds(), rtol=1e-6)


def seen_over(height, projection="perspective"):
    return seen_from((0.3, -0.2, 3.0), projection, view_height=2.0, near=1.5, far=4.5, width=21, height=height)


@examples(40)
@given(st.sampled_from(["perspective", "orthographic"]), st.integers(0, 2**32 - 1), st.floats(-4, 0))
def test_spheres_that_a_ray_of_a_pane_meets_are_met_and_so_are_boxes_around_them(projection, seed, decade):
    rng, camera = np.random.default_rng(seed), seen_over(32, projection)
    (top, left), size = rng.integers(0, (31, 20)), (33, 22)
    bottom, right = (int(rng.integers(first + 1, end)) for first, end in zip((top, left), size, strict=True))
    rows, columns = rng.integers(top, bottom, 50), rng.integers(left, right, 50)
    depth = rng.uniform(1.5, 4.5, 50)
    u, v = ray_coordinates(camera, columns + 0.5, rows + 0.5)
    spread = depth if camera.is_perspective else np.ones(50)
    on_rays = camera.exact_eye() + np.stack([u * spread, v * spread, depth], 1) @ np.asarray(camera.axes, float)
    reach = 10**decade * rng.uniform(0.1, 1, 50)
    way = rng.normal(size=(50, 3))
    middle = on_rays + 0.999 * reach[:, None] * way / np.linalg.norm(way, axis=1)[:, None]
    planes = seen_by(camera, top, bottom, left, right)
    assert planes.meet(middle, reach).all() and between_depths(camera).meet(middle, reach).all()
    around = rng.uniform(0, 0.3, (2, 50, 3))
    assert planes.meet_boxes(middle - around[0], middle + around[1], reach).all()


def test_what_lies_far_outside_is_not_met():
    camera = seen_over(32)
    behind, above, beside = np.array([[0.3, -0.2, 9.0]]), np.array([[0.0, 8.0, 0.0]]), np.array([[5.0, 0.0, 0.0]])
    for place in (behind, above, beside):
        assert not seen_by(camera, 0, 32, 0, 21).meet(place, np.array([0.5])).any()
        assert not seen_by(camera, 0, 32, 0, 21).meet_boxes(place - 0.1, place + 0.1, np.array([0.5])).any()
    left_half, right_half = seen_by(camera, 0, 32, 0, 10), seen_by(camera, 0, 32, 10, 21)
    on_the_right = np.array([[0.9, 0.0, 0.0]]), np.array([0.5])
    assert right_half.meet(*on_the_right).all() and not left_half.meet(*on_the_right).any()
