"""A snapshot that stays on disk gives the picture that it gives in memory, of few particles at a time."""

import numpy as np
import pytest
from snapshots_made import particles, write

import jaxsph as js
from jaxsph import on_disk as on_disk_module
from jaxsph.io import snapshot_index, snapshot_rows
from jaxsph.model.frusta import seen_by_rows

QUANTITY = "InternalEnergy"
SETTINGS = js.Settings(samples=24)


@pytest.fixture(autouse=True)
def short_runs(monkeypatch):
    for module in (snapshot_index, snapshot_rows):
        monkeypatch.setattr(module, "RUN", 256)


def camera_of(bounded, **size):
    return js.Camera.framing(bounded, **({"width": 40, "height": 72} | size))


def in_memory(path, transfer, camera, settings=SETTINGS):
    scene = js.Scene(particles=js.io.read_particles(path, QUANTITY), transfer=transfer)
    return js.render(scene, camera, settings)


def test_parts_of_few_particles_make_the_picture_of_all(tmp_path, monkeypatch):
    monkeypatch.setattr(on_disk_module, "BYTES_A_PARTICLE", 3500)
    columns = particles(6000)
    columns["SmoothingLength"] *= np.float32(0.5)
    path = write(tmp_path, columns, files=3)
    on_disk = js.OnDisk.open(path, QUANTITY)
    camera, transfer = camera_of(on_disk, width=96, height=88), on_disk.transfer()
    told = []
    image = js.render_from_disk(on_disk, transfer, camera, SETTINGS, memory=20 << 20, progress=lambda *at: told.append(at))
    whole = in_memory(path, transfer, camera)
    for layer in ("color", "transmittance", "error_bound"):
        np.testing.assert_allclose(getattr(image, layer), getattr(whole, layer), atol=3e-7)
    np.testing.assert_array_equal(image.evaluations, whole.evaluations)
    assert image.stats["parts"] == 6 and image.stats["most_particles"] < 5000
    assert told == [(part, 6) for part in range(1, 7)]


def test_memory_for_all_is_one_part_and_the_same_bits(tmp_path):
    path = write(tmp_path, particles(2000))
    on_disk = js.OnDisk.open(path, QUANTITY)
    camera, transfer = camera_of(on_disk, height=40), on_disk.transfer()
    image = js.render_from_disk(on_disk, transfer, camera, SETTINGS)
    np.testing.assert_array_equal(image.color, in_memory(path, transfer, camera).color)
    assert image.stats["parts"] == 1


def test_only_runs_that_the_rows_can_see_are_read(tmp_path, monkeypatch):
    on_disk = js.OnDisk.open(write(tmp_path, particles(6000)), QUANTITY)
    camera, read = camera_of(on_disk), []
    real = snapshot_rows.Snapshot.read

    def reading(self, file, rows, only=None):
        read.append(rows)
        return real(self, file, rows, only)

    monkeypatch.setattr(snapshot_rows.Snapshot, "read", reading)
    on_disk.seen_by(seen_by_rows(camera, 0, 8))
    assert 0 < len(read) < 0.7 * len(on_disk.index.file)


def test_log_density_gives_opacity_where_densities_spread(tmp_path):
    columns = particles(1000)
    columns["Density"] = np.geomspace(1e-3, 10, 1000).astype(np.float32)
    on_disk = js.OnDisk.open(write(tmp_path, columns), QUANTITY, opacity_by="auto")
    assert on_disk.quantities == (QUANTITY, "log10:Density") and on_disk.sample.extinction_quantity is not None
    assert np.asarray(on_disk.transfer().extinction)[0] == 0


def test_memory_that_does_not_suffice_says_how_much_does(tmp_path):
    on_disk = js.OnDisk.open(write(tmp_path, particles(2000)), QUANTITY)
    with pytest.raises(ValueError, match=r"which need [\d,]+; give more"):
        js.render_from_disk(on_disk, on_disk.transfer(), camera_of(on_disk), SETTINGS, memory=1000)
    with pytest.raises(ValueError, match="quadtree"):
        js.render_from_disk(on_disk, on_disk.transfer(), camera_of(on_disk), js.Settings(screen="quadtree", tolerance=0.1))
