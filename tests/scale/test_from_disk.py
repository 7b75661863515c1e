"""A snapshot that stays on disk gives the picture that it gives in memory, of few particles at a time."""

import numpy as np
import pytest
from snapshots_made import particles, write

import jaxsph as js
from jaxsph.engine.access.lists import TILE
from jaxsph.io.disk import index as snapshot_index
from jaxsph.scale import from_disk

pytestmark = pytest.mark.usefixtures("quick_programs")

QUANTITY = "InternalEnergy"
SETTINGS = js.Settings(samples=24)
MANY_BYTES = 1500  # of a particle: so that the memory of small pictures, too, is that of their particles


@pytest.fixture(autouse=True)
def short_runs(monkeypatch):
    monkeypatch.setattr(snapshot_index, "RUN", 256)


def written(folder):
    """A snapshot of which a pane of a picture of 40 x 40 pixels sees a part."""
    columns = particles(6000)
    columns["SmoothingLength"] *= np.float32(0.5)
    return write(folder, columns, files=3)


def camera_of(bounded, **size):
    return js.Camera.framing(bounded, **({"width": 40, "height": 72} | size))


def in_memory(path, transfer, camera, settings=SETTINGS):
    scene = js.Scene(particles=js.io.read_particles(path, QUANTITY), transfer=transfer)
    return js.render(scene, camera, settings)


def test_panes_of_few_particles_make_the_picture_of_all(tmp_path, monkeypatch):
    monkeypatch.setattr(from_disk, "READ_BYTES", MANY_BYTES)
    path = written(tmp_path)
    on_disk = js.scale.OnDisk.open(path, QUANTITY)
    camera, transfer = camera_of(on_disk, width=40, height=40), on_disk.transfer()
    told = []
    image = js.scale.render_from_disk(on_disk, transfer, camera, SETTINGS, memory=12 << 20, progress=lambda *at: told.append(at))
    whole = in_memory(path, transfer, camera)
    for layer in ("color", "transmittance", "error_bound"):
        np.testing.assert_allclose(getattr(image, layer), getattr(whole, layer), atol=3e-7)
    np.testing.assert_array_equal(image.evaluations, whole.evaluations)
    assert image.stats["panes"] == 3 and image.stats["most_particles"] < 5500
    assert told == [(pane, 3) for pane in range(1, 4)]


def test_memory_for_all_is_one_pane_and_the_same_bits(tmp_path):
    path = written(tmp_path)
    on_disk = js.scale.OnDisk.open(path, QUANTITY)
    camera, transfer = camera_of(on_disk, height=40), on_disk.transfer()
    image = js.scale.render_from_disk(on_disk, transfer, camera, SETTINGS)
    np.testing.assert_array_equal(image.color, in_memory(path, transfer, camera).color)
    assert image.stats["panes"] == 1


def test_memory_that_does_not_suffice_says_how_much_does(tmp_path):
    on_disk = js.scale.OnDisk.open(write(tmp_path, particles(2000)), QUANTITY)
    with pytest.raises(ValueError, match=r"which need [\d,]+; give more"):
        js.scale.render_from_disk(on_disk, on_disk.transfer(), camera_of(on_disk), SETTINGS, memory=1000)
    with pytest.raises(ValueError, match="quadtree"):
        js.scale.render_from_disk(on_disk, on_disk.transfer(), camera_of(on_disk), js.Settings(screen="quadtree", tolerance=0.1))


def renderer_of(on_disk, camera, memory, settings=SETTINGS):
    return from_disk._Renderer(on_disk, on_disk.transfer(), camera, settings, memory)


def least_of(on_disk, camera, settings=SETTINGS):
    with pytest.raises(from_disk.TooLittleMemoryError, match=r"which need [\d,]+; give more") as refused:
        renderer_of(on_disk, camera, 1000, settings).panes()
    return refused.value.least


def one_pixel(columns):
    columns["Coordinates"][:] = np.float32(0.5)


def one_huge(columns):
    columns["SmoothingLength"][7] = 3


def as_they_are(columns):
    pass


PILOT = js.Settings(samples=24, tolerance=0.03, estimator="pilot")


@pytest.mark.parametrize(
    ("change", "size", "settings"),
    [
        (as_they_are, (40, 72), PILOT),
        (as_they_are, (1, 1), SETTINGS),
        (one_pixel, (40, 72), SETTINGS),
        (one_huge, (40, 72), SETTINGS),
    ],
    ids=["rows", "one pixel of image", "particles in one pixel", "one huge particle"],
)
def test_the_least_memory_that_is_named_has_panes_and_half_of_it_has_none(tmp_path, change, size, settings):
    columns = particles(2000)
    change(columns)
    on_disk = js.scale.OnDisk.open(write(tmp_path, columns), QUANTITY)
    camera = camera_of(on_disk, width=size[0], height=size[1])
    least = least_of(on_disk, camera, settings)
    assert renderer_of(on_disk, camera, least, settings).panes()
    with pytest.raises(from_disk.TooLittleMemoryError, match=f"which need {least:,}"):
        renderer_of(on_disk, camera, least // 2, settings).panes()


def test_panes_that_need_more_than_the_sample_tells_are_cut_and_the_picture_is_the_same(tmp_path, monkeypatch):
    path = written(tmp_path)
    on_disk = js.scale.OnDisk.open(path, QUANTITY)
    camera, transfer = camera_of(on_disk, width=40, height=40), on_disk.transfer()
    least, told = least_of(on_disk, camera), []
    monkeypatch.setattr(from_disk._Renderer, "panes", lambda renderer: [renderer.whole])
    image = js.scale.render_from_disk(on_disk, transfer, camera, SETTINGS, memory=least, progress=lambda *at: told.append(at))
    whole = in_memory(path, transfer, camera)
    for layer in ("color", "transmittance", "error_bound"):
        np.testing.assert_allclose(getattr(image, layer), getattr(whole, layer), atol=3e-7)
    assert image.stats["panes"] > 1 and told[-1] == (image.stats["panes"],) * 2


@pytest.mark.parametrize("settings", [SETTINGS, PILOT], ids=["tiles", "rows"])
@pytest.mark.parametrize("more", [1.0, 1.3])
def test_panes_are_all_of_the_picture_and_each_is_told_of_what_it_sees(tmp_path, monkeypatch, settings, more):
    monkeypatch.setattr(from_disk, "READ_BYTES", MANY_BYTES)
    on_disk = js.scale.OnDisk.open(written(tmp_path), QUANTITY)
    camera = camera_of(on_disk, width=88, height=72)
    renderer = renderer_of(on_disk, camera, int(more * least_of(on_disk, camera, settings)), settings)
    panes, covered, of = renderer.panes(), np.zeros((72, 88), int), renderer._sample.viewed  # of all, as they are few
    for pane in panes:
        covered[pane.top : pane.bottom, pane.left : pane.right] += 1
        told = renderer._told(pane)
        met = (of.right >= pane.left) & (of.left < pane.right) & (of.bottom >= pane.top) & (of.top < pane.bottom)
        assert told.particles >= min(from_disk.CROWDED * int(np.sum(met & (of.left <= of.right))), 6000)
        assert renderer._fits(told) or not pane.halves(renderer.whole_rows)[1]
        assert settings is SETTINGS or (pane.left, pane.right) == (0, 88)
    assert (covered == 1).all() and (more > 1 or len(panes) > 1)
    assert all(edge % TILE == 0 for pane in panes for edge in (pane.top, pane.left))
    told = [renderer._told(pane).particles for pane in panes]
    assert told == sorted(told, reverse=True)


def test_panes_are_large_where_little_is_and_one_where_nothing_is(tmp_path, monkeypatch):
    monkeypatch.setattr(from_disk, "READ_BYTES", MANY_BYTES)
    columns = particles(3000)
    columns["Coordinates"][60:] *= np.float32(0.25)
    columns["SmoothingLength"] *= np.float32(0.25)
    on_disk = js.scale.OnDisk.open(write(tmp_path, columns), QUANTITY)
    camera = js.Camera.look_at((0.5, 0.5, 4), (0.5, 0.5, 0.5), fov_degrees=20, width=128, height=128, near=2, far=6)
    least = least_of(on_disk, camera)
    panes = renderer_of(on_disk, camera, least).panes()
    areas = [(pane.bottom - pane.top) * (pane.right - pane.left) for pane in panes]
    assert min(areas) == TILE**2 and max(areas) >= 16 * min(areas) and len(panes) < 32
    away = js.Camera.look_at((0.5, 0.5, 4), (0.5, 0.5, 8), fov_degrees=20, width=128, height=128, near=2, far=6)
    assert renderer_of(on_disk, away, least).panes() == [(0, 128, 0, 128)]


def test_the_limit_of_a_frame_is_named_where_it_is_what_is_too_little(tmp_path):
    on_disk = js.scale.OnDisk.open(write(tmp_path, particles(2000)), QUANTITY)
    with pytest.raises(from_disk.TooLittleMemoryError, match=r"`settings.memory_limit` = 1000 bytes") as refused:
        renderer_of(on_disk, camera_of(on_disk), 1 << 30, js.Settings(samples=24, memory_limit=1000)).panes()
    settings = js.Settings(samples=24, memory_limit=refused.value.least)
    assert renderer_of(on_disk, camera_of(on_disk), 1 << 30, settings).panes()


@pytest.mark.slow
@pytest.mark.parametrize("way", [{"integrator": "segments"}, {"tolerance": 0.01}, {"tolerance": 0.03, "estimator": "pilot"}])
def test_panes_of_other_ways_are_as_near_as_the_whole(tmp_path, monkeypatch, way):
    monkeypatch.setattr(from_disk, "READ_BYTES", MANY_BYTES)
    path, settings = write(tmp_path, particles(6000), files=3), js.Settings(samples=48, **way)
    on_disk = js.scale.OnDisk.open(path, QUANTITY)
    camera, transfer = camera_of(on_disk, width=96, height=88), on_disk.transfer()
    image = js.scale.render_from_disk(
        on_disk, transfer, camera, settings, memory=(15 if settings.estimator == "pilot" else 12) << 20
    )
    whole = in_memory(path, transfer, camera, settings)
    apart = np.abs(np.asarray(image.color) - whole.color).max(-1)
    assert (
        image.stats["panes"] > 1
        and (apart <= 1e-6 + sum(np.nan_to_num(one.error_bound, posinf=0) for one in (image, whole))).all()
    )
