"""A snapshot that stays on disk gives the picture that it gives in memory, of few particles at a time."""

import numpy as np
import pytest
from snapshots_made import particles, write

import jaxsph as js
from jaxsph import from_disk
from jaxsph.io import snapshot_index, snapshot_rows

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


def test_panes_of_few_particles_make_the_picture_of_all(tmp_path, monkeypatch):
    monkeypatch.setattr(from_disk, "BYTES_A_PARTICLE", 3500)
    columns = particles(6000)
    columns["SmoothingLength"] *= np.float32(0.5)
    path = write(tmp_path, columns, files=3)
    on_disk = js.OnDisk.open(path, QUANTITY)
    camera, transfer = camera_of(on_disk, width=96, height=88), on_disk.transfer()
    told = []
    image = js.render_from_disk(on_disk, transfer, camera, SETTINGS, memory=10 << 20, progress=lambda *at: told.append(at))
    whole = in_memory(path, transfer, camera)
    for layer in ("color", "transmittance", "error_bound"):
        np.testing.assert_allclose(getattr(image, layer), getattr(whole, layer), atol=3e-7)
    np.testing.assert_array_equal(image.evaluations, whole.evaluations)
    assert image.stats["panes"] == 8 and image.stats["most_particles"] < 4000
    assert told == [(pane, 8) for pane in range(1, 9)]


def test_memory_for_all_is_one_pane_and_the_same_bits(tmp_path):
    path = write(tmp_path, particles(2000))
    on_disk = js.OnDisk.open(path, QUANTITY)
    camera, transfer = camera_of(on_disk, height=40), on_disk.transfer()
    image = js.render_from_disk(on_disk, transfer, camera, SETTINGS)
    np.testing.assert_array_equal(image.color, in_memory(path, transfer, camera).color)
    assert image.stats["panes"] == 1


def test_memory_that_does_not_suffice_says_how_much_does(tmp_path):
    on_disk = js.OnDisk.open(write(tmp_path, particles(2000)), QUANTITY)
    with pytest.raises(ValueError, match=r"which need [\d,]+; give more"):
        js.render_from_disk(on_disk, on_disk.transfer(), camera_of(on_disk), SETTINGS, memory=1000)
    with pytest.raises(ValueError, match="quadtree"):
        js.render_from_disk(on_disk, on_disk.transfer(), camera_of(on_disk), js.Settings(screen="quadtree", tolerance=0.1))


@pytest.mark.slow
@pytest.mark.parametrize("way", [{"integrator": "segments"}, {"tolerance": 0.01}, {"tolerance": 0.03, "estimator": "pilot"}])
def test_panes_of_other_ways_are_as_near_as_the_whole(tmp_path, monkeypatch, way):
    monkeypatch.setattr(from_disk, "BYTES_A_PARTICLE", 3500)
    path, settings = write(tmp_path, particles(6000), files=3), js.Settings(samples=48, **way)
    on_disk = js.OnDisk.open(path, QUANTITY)
    camera, transfer = camera_of(on_disk, width=96, height=88), on_disk.transfer()
    image = js.render_from_disk(on_disk, transfer, camera, settings, memory=22 << 20)
    whole = in_memory(path, transfer, camera, settings)
    apart = np.abs(np.asarray(image.color) - whole.color).max(-1)
    assert image.stats["panes"] > 1 and (apart <= 1e-6 + np.asarray(image.error_bound) + whole.error_bound).all()
