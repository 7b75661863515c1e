"""A snapshot that stays on disk gives the picture that it gives in memory, of few particles at a time."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from snapshots_made import particles, write

import jaxsph as js
from jaxsph.engine.access.lists import TILE
from jaxsph.io.disk import index as snapshot_index
from jaxsph.scale import from_disk
from jaxsph.scale.from_disk import Pane
from jaxsph.scale.on_disk import seen_by as planes_of

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


@pytest.mark.parametrize("foreseen", [True, False], ids=["foreseen", "cut, as they need more than the sample tells"])
def test_panes_of_few_particles_make_the_picture_of_all(tmp_path, monkeypatch, foreseen):
    monkeypatch.setattr(from_disk, "READ_BYTES", MANY_BYTES)
    path = written(tmp_path)
    on_disk = js.scale.OnDisk.open(path, QUANTITY)
    camera, transfer, told = camera_of(on_disk, width=40, height=40), on_disk.transfer(), []
    if not foreseen:
        monkeypatch.setattr(from_disk._Renderer, "panes", lambda renderer: [renderer.whole])
    image = js.scale.render_from_disk(on_disk, transfer, camera, SETTINGS, memory=12 << 20, progress=lambda *at: told.append(at))
    whole = in_memory(path, transfer, camera)
    for layer in ("color", "transmittance", "error_bound"):
        np.testing.assert_allclose(getattr(image, layer), getattr(whole, layer), atol=3e-7)
    assert image.stats["panes"] > 1 and told[-1] == (image.stats["panes"],) * 2
    if foreseen:
        np.testing.assert_array_equal(image.evaluations, whole.evaluations)
        assert image.stats["most_particles"] < 5500 and told == [(pane, 3) for pane in range(1, 4)]


def test_memory_for_all_is_one_pane_and_the_same_bits(tmp_path):
    path = written(tmp_path)
    on_disk = js.scale.OnDisk.open(path, QUANTITY)
    camera, transfer = camera_of(on_disk, height=40), on_disk.transfer()
    image = js.scale.render_from_disk(on_disk, transfer, camera, SETTINGS)
    np.testing.assert_array_equal(image.color, in_memory(path, transfer, camera).color)
    assert image.stats["panes"] == 1


def drawn(on_disk, camera, memory, settings=SETTINGS):
    return js.scale.render_from_disk(on_disk, on_disk.transfer(), camera, settings, memory=memory)


def least_of(on_disk, camera, settings=SETTINGS, memory=1000):
    with pytest.raises(from_disk.TooLittleMemoryError, match=r"which need [\d,]+; give more") as refused:
        drawn(on_disk, camera, memory, settings)
    return refused.value.least


def test_what_needs_all_particles_is_refused(tmp_path):
    on_disk = js.scale.OnDisk.open(write(tmp_path, particles(2000)), QUANTITY)
    with pytest.raises(ValueError, match="quadtree"):
        drawn(on_disk, camera_of(on_disk), from_disk.MEMORY, js.Settings(screen="quadtree", tolerance=0.1))


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
def test_memory_that_does_not_suffice_says_how_much_does_and_half_of_it_does_not(tmp_path, change, size, settings):
    columns = particles(2000)
    change(columns)
    on_disk = js.scale.OnDisk.open(write(tmp_path, columns), QUANTITY)
    camera = camera_of(on_disk, width=size[0], height=size[1])
    least = least_of(on_disk, camera, settings)
    assert drawn(on_disk, camera, least, settings).stats["panes"] >= 1
    least_of(on_disk, camera, settings, least // 2)


def panes_of(on_disk, camera, memory, settings=SETTINGS):
    renderer = from_disk._Renderer(on_disk, on_disk.transfer(), camera, settings, memory)
    return renderer, renderer.panes()


@pytest.mark.parametrize("settings", [SETTINGS, PILOT], ids=["tiles", "rows"])
@pytest.mark.parametrize("more", [1.0, 1.3])
def test_panes_are_all_of_the_picture_the_fullest_first(tmp_path, monkeypatch, settings, more):
    monkeypatch.setattr(from_disk, "READ_BYTES", MANY_BYTES)
    on_disk = js.scale.OnDisk.open(written(tmp_path), QUANTITY)
    camera = camera_of(on_disk, width=88, height=72)
    renderer, panes = panes_of(on_disk, camera, int(more * (8 << 20)), settings)
    covered, counts = np.zeros((72, 88), int), []
    for pane in panes:
        covered[pane.top : pane.bottom, pane.left : pane.right] += 1
        columns = on_disk.seen_by(planes_of(camera, *pane))
        counts.append(len(columns[0]))  # of all, as they are few
        assert renderer._fits(renderer.bytes(counts[-1], pane)) or not pane.halves(renderer.whole_rows)[1]
        assert settings is SETTINGS or (pane.left, pane.right) == (0, 88)
    assert (covered == 1).all() and len(panes) > 1 and counts == sorted(counts, reverse=True)
    assert all(edge % TILE == 0 for pane in panes for edge in (pane.top, pane.left))


def test_panes_are_large_where_little_is_and_one_where_nothing_is(tmp_path, monkeypatch):
    monkeypatch.setattr(from_disk, "READ_BYTES", MANY_BYTES)
    columns = particles(3000)
    columns["Coordinates"][60:] *= np.float32(0.25)
    columns["SmoothingLength"] *= np.float32(0.25)
    on_disk = js.scale.OnDisk.open(write(tmp_path, columns), QUANTITY)
    camera = js.Camera.look_at((0.5, 0.5, 4), (0.5, 0.5, 0.5), fov_degrees=20, width=128, height=128, near=2, far=6)
    renderer, panes = panes_of(on_disk, camera, 1 << 30)
    memory = renderer.bytes(800, *panes)[0]
    _, panes = panes_of(on_disk, camera, memory)
    areas = [(pane.bottom - pane.top) * (pane.right - pane.left) for pane in panes]
    assert min(areas) == TILE**2 and max(areas) >= 16 * min(areas) and len(panes) < 32
    away = js.Camera.look_at((0.5, 0.5, 4), (0.5, 0.5, 8), fov_degrees=20, width=128, height=128, near=2, far=6)
    assert panes_of(on_disk, away, memory)[1] == [(0, 128, 0, 128)]


def test_the_limit_of_a_frame_is_named_where_it_is_what_is_too_little(tmp_path):
    on_disk = js.scale.OnDisk.open(write(tmp_path, particles(2000)), QUANTITY)
    with pytest.raises(from_disk.TooLittleMemoryError, match=r"`settings.memory_limit` = 1000 bytes") as refused:
        drawn(on_disk, camera_of(on_disk), 1 << 30, js.Settings(samples=24, memory_limit=1000))
    settings = js.Settings(samples=24, memory_limit=refused.value.least)
    assert drawn(on_disk, camera_of(on_disk), 1 << 30, settings).stats["panes"] >= 1


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


@pytest.mark.parametrize("whole_rows", [False, True])
@pytest.mark.parametrize("pane", [Pane(0, 90, 32, 100), Pane(16, 49, 0, 16), Pane(0, 1, 0, 1), Pane(0, 16, 0, 90)])
def test_halves_are_whole_tiles_and_together_the_pane(pane, whole_rows):
    axis, halves = pane.halves(whole_rows)
    if not halves:
        assert pane.bottom - pane.top <= TILE and (whole_rows or pane.right - pane.left <= TILE)
        return
    first, last = halves
    begin, end = (("top", "bottom"), ("left", "right"))[axis]
    assert getattr(first, end) == getattr(last, begin) and getattr(first, end) % TILE == 0
    assert first._replace(**{end: getattr(last, end)}) == pane == last._replace(**{begin: getattr(first, begin)})


def finest_of(pane, whole_rows):
    """All that a pane is cut into where it is cut as often as it can be."""
    halves = pane.halves(whole_rows)[1]
    return [least for half in halves for least in finest_of(half, whole_rows)] or [pane]


@given(st.integers(1, 300), st.integers(1, 300), st.booleans())
def test_the_finest_cut_is_all_tiles_or_all_rows_of_them_once(height, width, whole_rows):
    covered = np.zeros((height, width), int)
    panes = finest_of(Pane(0, height, 0, width), whole_rows)
    for pane in panes:
        covered[pane.top : pane.bottom, pane.left : pane.right] += 1
    assert (covered == 1).all() and all(edge % TILE == 0 for pane in panes for edge in (pane.top, pane.left))
    assert len(panes) == -(-height // TILE) * (1 if whole_rows else -(-width // TILE))


def test_halves_are_as_near_to_squares_as_can_be():
    """A square has the shortest border, across which particles are held by both sides."""
    pane = Pane(0, 256, 0, 512)
    while halves := pane.halves(False)[1]:
        pane = halves[0]
        long, short = sorted((pane.bottom - pane.top, pane.right - pane.left), reverse=True)
        assert long <= 2 * short
