"""Parts of a picture: together the same bits as the whole, and refused where they make none."""

import dataclasses
import functools
import itertools

import numpy as np
import OpenEXR
import pytest
from extreme import same_in_another_unit
from images import same_bits

import jaxsph as js
from jaxsph.engine.planning.viewing import Measures
from jaxsph.engine.request import scaled
from jaxsph.scale.parts import cuts

pytestmark = pytest.mark.usefixtures("quick_programs")

LAYERS = ("color", "transmittance", "depth", "error_bound", "evaluations")
LOOK = js.TransferFunction.from_points([-1, 1], [(1, 0, 0), (0, 0, 1)], [1.0, 6.0])
SETTINGS = js.Settings(samples=32)


def view(height=56, count=300, support=0.35):
    """Particles that lie in the lower half, mostly, so that parts of equal height would differ much in work."""
    rng = np.random.default_rng(3)
    position = rng.normal(size=(count, 3)) * (0.5, 0.3, 0.5) - (0, 0.4, 0)
    particles = js.Particles.from_arrays(position, support, np.sin(3 * position[:, 0]))
    camera = js.Camera.look_at((0, 0, 4), (0, 0, 0), fov_degrees=40, width=40, height=height, near=2, far=6)
    return js.Scene(particles=particles, transfer=LOOK), camera


def parts_of(scene, camera, settings, count):
    return [js.scale.render_tile(scene, camera, settings, index, count) for index in range(count)]


@functools.cache
def parts():
    return parts_of(*view(), SETTINGS, 3)


@pytest.fixture
def three(quick_programs):
    return parts()


@pytest.mark.parametrize(
    "settings",
    [
        SETTINGS,
        pytest.param(js.Settings(samples=32, integrator="samples", tolerance=0.02), marks=pytest.mark.slow),
        pytest.param(js.Settings(samples=32, tolerance=0.02, integrator="segments"), marks=pytest.mark.slow),
        pytest.param(js.Settings(samples=32, min_transmittance=0.02), marks=pytest.mark.slow),
        pytest.param(js.Settings(samples=32, memory_limit=1 << 22), marks=pytest.mark.slow),
    ],
    ids=["full rate", "interval", "segments", "ended rays", "bands"],
)
def test_parts_are_together_the_same_bits_as_the_whole(settings):
    scene, camera = view()
    whole = js.render(scene, camera, settings)
    merged = js.scale.merge_tiles(reversed(parts_of(scene, camera, settings, 3)))
    same_bits(merged, whole, *LAYERS)
    assert (whole.levels is None) == (merged.levels is None)
    if whole.levels is not None:
        np.testing.assert_array_equal(merged.levels, whole.levels)
    assert merged.metadata == whole.metadata and bool(merged.certified) == bool(whole.certified)
    assert {name: merged.stats[name] for name in ("evaluations", "evaluations_full", "cells", "pairs")} == {
        name: whole.stats[name] for name in ("evaluations", "evaluations_full", "cells", "pairs")
    }
    assert np.asarray(whole.alpha).max() > 0.5


@pytest.mark.slow
def test_parts_of_the_pilot_keep_the_tolerance_as_the_whole_does():
    """Its lattice is shared by bundles and ends with a part, so that near a cut other slabs are interpolated."""
    scene, camera = view(support=0.8)
    settings = js.Settings(samples=64, tolerance=0.02, estimator="pilot")
    truth = js.render(scene, camera, dataclasses.replace(settings, tolerance=None, integrator="samples"))
    whole, merged = js.render(scene, camera, settings), js.scale.merge_tiles(parts_of(scene, camera, settings, 3))
    for image in (whole, merged):
        assert image.stats["evaluations"] < truth.stats["evaluations"]
        assert (np.abs(np.asarray(image.color) - truth.color).max(-1) <= np.asarray(image.error_bound) + 1e-6).all()
        assert np.asarray(image.error_bound).max() <= settings.tolerance
    assert merged.metadata == whole.metadata


def test_parts_are_in_the_unit_of_length_that_was_given(three):
    scene, camera = view()
    for part, other in zip(parts_of(scaled(scene, 80), scaled(camera, 80), SETTINGS, 3), three, strict=True):
        same_in_another_unit(part, other, 80)


def test_files_of_parts_make_the_same_file_as_the_whole(three, tmp_path):
    scene, camera = view()
    js.render(scene, camera, SETTINGS).save(tmp_path / "whole.exr")
    for number, part in enumerate(three):
        part.save(tmp_path / f"{number}.exr")
    js.scale.merge_tiles(js.io.read_image(tmp_path / f"{number}.exr") for number in (1, 2, 0)).save(tmp_path / "merged.exr")
    whole, merged = (js.io.read_image(tmp_path / name) for name in ("whole.exr", "merged.exr"))
    same_bits(merged, whole, *LAYERS)
    assert dict(merged.metadata) == dict(whole.metadata)
    files = [OpenEXR.File(str(tmp_path / name), separate_channels=True) for name in ("whole.exr", "merged.exr", "1.exr")]
    for name, channel in files[0].channels().items():
        np.testing.assert_array_equal(files[1].channels()[name].pixels, channel.pixels, name)
    of_colors = [file.header()["jaxsph.color"] for file in files]
    assert of_colors == ["linear Rec.709", "linear Rec.709", "sRGB, display-referred"]


def test_the_file_of_a_part_says_where_it_belongs(three, tmp_path):
    three[1].save(tmp_path / "part.exr")
    header = OpenEXR.File(str(tmp_path / "part.exr")).header()
    metadata = dict(three[1].metadata)
    first = metadata["jaxsph.first_row"]
    assert [corner.tolist() for corner in header["dataWindow"]] == [[0, first], [39, first + three[1].shape[0] - 1]]
    assert [corner.tolist() for corner in header["displayWindow"]] == [[0, 0], [39, 55]]
    assert 0 < first == three[0].shape[0] and metadata["jaxsph.rows"] == 56


@pytest.mark.parametrize("seed", range(20))
def test_parts_have_at_least_a_row_and_no_more_than_their_share_and_the_largest_row(seed):
    rng = np.random.default_rng(seed)
    rows = int(rng.integers(1, 40))
    pairs = (rng.uniform(size=rows) ** 8 * 1e6).astype(np.int64)
    count = int(rng.integers(1, rows + 1))
    ends = cuts(Measures(pairs, pairs, 1, 1, 1.0, 1.0), 3, count)
    assert ends[0] == 0 and ends[-1] == rows and len(ends) == count + 1
    assert all(later > before for before, later in itertools.pairwise(ends))
    weights = pairs + 12
    heaviest = max(weights[first:last].sum() for first, last in itertools.pairwise(ends))
    assert heaviest <= weights.sum() / count + 2 * weights.max()


def test_a_part_is_told_what_it_is_a_part_of(three):
    scene, camera = view()
    moved = dataclasses.replace(camera, eye=camera.eye + 0.001)
    others = {
        "camera": js.scale.render_tile(scene, moved, SETTINGS, 2, 3),
        "scene": js.scale.render_tile(view(count=299)[0], camera, SETTINGS, 2, 3),
        "settings": js.scale.render_tile(scene, camera, js.Settings(samples=32, min_transmittance=1e-4), 2, 3),
    }
    for other in others.values():
        with pytest.raises(ValueError, match=r"c\.exr is part of another picture than a\.exr"):
            js.scale.merge_tiles([*three[:2], other], names=["a.exr", "b.exr", "c.exr"])
    with pytest.raises(ValueError, match=r"c is one of 4 parts, but a is one of 3"):
        js.scale.merge_tiles([*three[:2], js.scale.render_tile(scene, camera, SETTINGS, 3, 4)], names=["a", "b", "c"])


def test_a_part_that_is_missing_or_there_twice_is_named(three):
    with pytest.raises(ValueError, match="1 of 3 parts of the picture are missing: --tile 1/3"):
        js.scale.merge_tiles([three[0], three[2]])
    with pytest.raises(ValueError, match="x and z are both part 0"):
        js.scale.merge_tiles([three[0], three[1], three[0]], names="xyz")
    whole = js.render(*view(), SETTINGS)
    with pytest.raises(ValueError, match="image 1 is not a part"):
        js.scale.merge_tiles([three[0], whole])
    with pytest.raises(ValueError, match="at least one"):
        js.scale.merge_tiles([])
    shorter = dataclasses.replace(three[1], **{name: getattr(three[1], name)[1:] for name in LAYERS})
    with pytest.raises(ValueError, match="b ends at row"):
        js.scale.merge_tiles([three[0], shorter, three[2]], names="abc")


@pytest.mark.parametrize(
    ("index", "count", "settings", "said"),
    [
        (0, 5, SETTINGS, r"`count` must lie in \[1, 4\].*got 5"),
        (0, 0, SETTINGS, "`count`"),
        (3, 3, SETTINGS, r"`index` must lie in \[0, 2\] for 3 parts, got 3"),
        (-1, 3, SETTINGS, "`index`"),
        (0.5, 3, SETTINGS, "`index` must be a whole number"),
        (0, 3, js.Settings(screen="quadtree"), "quadtree"),
    ],
)
def test_parts_that_there_are_not_are_refused(index, count, settings, said):
    with pytest.raises(ValueError, match=said):
        js.scale.render_tile(*view(), settings, index, count)


def test_what_the_memory_limit_is_does_not_make_another_picture(three):
    scene, camera = view()
    tight = js.scale.render_tile(scene, camera, dataclasses.replace(SETTINGS, memory_limit=1 << 30), 1, 3)
    np.testing.assert_array_equal(js.scale.merge_tiles([three[0], tight, three[2]]).color, js.scale.merge_tiles(three).color)


def test_room_for_more_than_a_part_needs_is_no_reason_to_refuse_it(monkeypatch):
    scene, camera = view(count=260)
    planned = []

    def stop(work, clock, progress=None):
        planned.append(work.plan)
        raise InterruptedError

    monkeypatch.setattr("jaxsph.scale.parts.draw", stop)
    for limit in (None, 1000):
        with pytest.raises((InterruptedError, ValueError)) as ended:
            js.scale.render_tile(scene, camera, dataclasses.replace(SETTINGS, memory_limit=limit), 1, 3)
    least = int(str(ended.value).split("needs about ")[1].split()[0])
    with pytest.raises(InterruptedError):
        js.scale.render_tile(scene, camera, dataclasses.replace(SETTINGS, memory_limit=least), 1, 3)
    assert planned[-1].bytes <= least
