"""A volume is what its grid says: interpolated, placed, shown, mixed, skipped where it is empty, and differentiated."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from derivatives import QUICKLY
from examples import examples
from hypothesis import given, strategies as st
from images import seen_from

import jaxsph as js
from jaxsph.engine.access.grid import SlabExtents
from jaxsph.engine.access.volume_grid import MACROCELL, MacrocellRanges, VolumeGrid, counted
from jaxsph.engine.media.volume import VolumeMedium
from jaxsph.numerics import faults
from jaxsph.reference.where import to_view

pytestmark = pytest.mark.usefixtures("quick_programs")

SETTINGS = js.Settings(samples=32)
FIELD = np.random.default_rng(4).uniform(0, 1, (9, 7, 12)).astype(np.float32)
LOWER, SPACING = (-1.1, -0.8, -0.9), (0.27, 0.25, 0.16)


def transfer(values=(0.2, 0.5, 0.8), extinction=(0.0, 2.0, 0.5)):
    return js.TransferFunction.from_points(values, [[1, 0.2, 0], [0, 1, 0.3], [0.1, 0, 1]], extinction)


def camera(projection="perspective", width=19, height=14):
    return seen_from((1.4, 1.1, -2.6), projection, width=width, height=height, near=1.2, far=5.0)


def scene(values=FIELD, **parts):
    return js.Scene(volume=js.Volume.from_array(values, LOWER, SPACING), volume_transfer=transfer(), **parts)


def particles():
    rng = np.random.default_rng(1)
    position = rng.uniform(-1, 1, (30, 3)).astype(np.float32)
    return {
        "particles": js.Particles.from_arrays(position, 0.6, rng.uniform(0, 1, 30).astype(np.float32)),
        "transfer": transfer(),
    }


@pytest.mark.slow
def test_bytes_are_kept_and_show_what_their_floats_do():
    data = (255 * FIELD).astype(np.uint8)
    volume = js.Volume.from_array(data, LOWER, SPACING)
    assert volume.values.dtype == np.uint8
    shown = js.Scene(volume=volume, volume_transfer=transfer((51, 128, 204)))
    as_floats = dataclasses.replace(shown, volume=js.Volume.from_array(data.astype(np.float32), LOWER, SPACING))
    images = [js.render(one, camera("orthographic"), SETTINGS) for one in (shown, as_floats)]
    np.testing.assert_array_equal(images[0].color, images[1].color)


def test_infinite_values_are_a_fault_under_jit():
    shown, view = scene(**particles()), camera("perspective")
    broken = dataclasses.replace(shown.volume, values=np.where(FIELD[3, 2, 1] == FIELD, np.float32(np.inf), FIELD))
    words = [int(FAULTS(volume, shown.volume_transfer, view)) for volume in (shown.volume, broken)]
    assert words == [0, faults.BAD_VOLUME]
    for volume in (broken, dataclasses.replace(shown.volume, spacing=np.zeros(3, np.float32))):
        with pytest.raises(ValueError, match="a volume holds values that are not finite"):
            js.render(dataclasses.replace(shown, volume=volume), view, SETTINGS)


HOLED = np.where(np.random.default_rng(8).uniform(size=FIELD.shape) < 0.02, np.float32(np.nan), FIELD)
HOLED[:3] = np.nan


@pytest.mark.parametrize("integrator", ["samples", "segments"])
def test_what_is_nan_is_not_there_as_in_references(integrator):
    holed, view, n = scene(HOLED), camera("orthographic"), 32 if integrator == "samples" else 256
    image = js.render(holed, view, js.Settings(samples=n, integrator=integrator))
    truth = js.reference.render(holed, view, SETTINGS) if integrator == "samples" else js.reference.integral(holed, view)
    off = np.abs(np.asarray(image.color) - np.asarray(truth.color))
    assert off.max() < (2e-5 if integrator == "samples" else 1e-2) and off.mean() < 5e-4
    whole = js.reference.render(scene(), view, SETTINGS)
    assert 0.2 < np.sum(1 - np.asarray(truth.transmittance)) / np.sum(1 - np.asarray(whole.transmittance)) < 0.8


def test_derivatives_of_a_volume_with_holes_are_finite():
    view = camera("orthographic")
    plan = js.plan(scene(HOLED), view, SETTINGS)

    def brightness(values, lower, eye):
        volume = dataclasses.replace(js.Volume.from_array(values, LOWER, SPACING), lower=lower)
        shown = js.Scene(volume=volume, volume_transfer=transfer())
        return js.render(shown, dataclasses.replace(view, eye=eye), SETTINGS, plan=plan).color.sum()

    start = HOLED, np.asarray(LOWER, np.float32), np.asarray(view.eye)
    slopes = jax.jit(jax.grad(brightness, (0, 1, 2)), compiler_options=QUICKLY)(*map(jax.numpy.asarray, start))
    assert all(np.isfinite(slope).all() for slope in slopes) and not np.asarray(slopes[0])[np.isnan(HOLED)].any()
    assert all(np.abs(slope).max() > 0.1 for slope in slopes)


@pytest.mark.parametrize(
    ("parts", "missing"),
    [(("volume",), "volume_transfer"), (("volume_transfer",), "volume"), (("particles",), "transfer"), ((), "particles")],
)
def test_a_part_without_its_looks_is_refused_by_name(parts, missing):
    whole = scene(**particles())
    some = js.Scene(**{name: getattr(whole, name) for name in parts})
    with pytest.raises(ValueError, match=f"^`{missing}`"):
        js.render(some, camera(), SETTINGS)


@examples(60)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_no_extinction_lies_in_a_slab_that_is_called_empty(seed, many_points):
    """Slabs of random extents; samples in their corners, on their faces and inside; values are often control points."""
    rng = np.random.default_rng(seed)
    points = np.sort(rng.uniform(0, 1, 20)) if many_points else np.linspace(0, 1, 6)
    if many_points and rng.uniform() < 0.5:
        points = np.linspace(0, 1, 20)
    extinction = np.where(rng.uniform(size=len(points)) < 0.3, 1.0, 0.0)
    looks = js.TransferFunction.from_points(points, np.ones((len(points), 3)), extinction)
    values = rng.choice(points, (11, 9, 14))
    values[: rng.integers(1, 11)] = rng.choice(points)  # empty parts, if there is no extinction
    smooth = rng.uniform() < 0.5
    values = np.where(smooth, values * rng.uniform(0.9, 1, values.shape), values).astype(np.float32)
    volume = js.Volume.from_array(values, rng.uniform(-2, 2, 3), rng.uniform(0.1, 0.5, 3))
    medium = EXAMPLES(volume, looks, camera())
    grid = np.asarray(volume.bounds())
    middle = to_view(rng.uniform(grid[0], grid[1], (200, 3)), camera())
    half = 10.0 ** rng.uniform(-2, 0, (200, 3))
    lower, upper = (middle - half).astype(np.float32), (middle + half).astype(np.float32)
    slabs = SlabExtents(*(side[:, axis, None] for axis in range(3) for side in (lower, upper)))
    empty = ~np.asarray(OCCUPIED(medium, slabs))[:, 0]
    share = rng.choice([0.0, 1.0, 0.5, 0.3], (200, 30, 3))
    samples = np.clip(lower[:, None] + share * (upper - lower)[:, None], lower[:, None], upper[:, None]).astype(np.float32)
    shown = np.asarray(SHOWN(medium, samples))
    assert not (shown > 0)[empty].any()


@jax.jit
def EXAMPLES(volume, looks, view):
    return VolumeMedium.seen(volume, looks, view)


@jax.jit
def FAULTS(volume, looks, view):
    return VolumeMedium.seen(volume, looks, view).fault


@jax.jit
def OCCUPIED(medium, slabs):
    return medium.occupied(slabs)


@jax.jit
def SHOWN(medium, samples):
    place = medium.grid.coordinates(tuple(samples[..., axis][..., None] for axis in range(3)))
    gathered = medium.grid.interpolate(place), medium.grid.inside(place)
    return medium.extinction(gathered, SimpleNamespace(between=False))[0][..., 0]


def test_empty_space_is_skipped():
    values = np.zeros((33, 33, 33), np.float32)
    values[20:24, 20:24, 20:24] = 1.0
    volume = js.Volume.from_array(values, 0 * np.ones(3), 1 / 32)
    ranges = jax.jit(MacrocellRanges.of)(volume.values)
    assert ranges.lo.shape == (8, 8, 8) == tuple(32 // MACROCELL for _ in range(3))
    shown = jax.jit(MacrocellRanges.shown_by)(ranges, js.TransferFunction.from_points([0, 1], np.ones((2, 3)), [0.0, 1.0]))
    assert np.asarray(shown).sum() == 8
    grid = VolumeGrid(volume.values, np.zeros(3, np.float32), np.eye(3, dtype=np.float32) * 32)
    ends = [np.float32([[low], [low + 0.05]]) for low in (0.1, 0.65)]
    boxes = [SlabExtents(*(edge[i : i + 1] for _ in range(3) for i in range(2))) for edge in ends]
    touched = jax.jit(lambda box: grid.touched(counted(shown), box))
    assert [np.asarray(touched(box)).item() for box in boxes] == [False, True]
