"""Means over cells keep what particles have, and are means of the field."""

import numpy as np
import pytest

import jaxsph as js

SHAPE = 12, 10, 8


def set_of(support, scale=1.0, offset=0.0, kernel="cubic_spline", box=None, number=200):
    rng = np.random.default_rng(1)
    place = offset + scale * rng.uniform(0.2, 0.8, (number, 3)) * SHAPE
    more = {} if box is None else {"box": box}
    return js.Particles.from_arrays(
        place, scale * np.broadcast_to(support, number), rng.normal(size=number), kernel=kernel, **more
    )


def total(particles, masses, lower, spacing, shape=SHAPE, **more):
    volume = js.resample(particles, lower, spacing, shape, of=masses, normalised=False, cell="mean", **more)
    return float(np.asarray(volume.values, np.float64).sum()) * np.prod(np.broadcast_to(spacing, 3))


@pytest.mark.parametrize("kernel", ["poly6", "wendland_c6", "quintic_spline"])
@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1e-9, 0.0), (1e9, 3e9), (1.0, 1e4)])
def test_cells_keep_mass_for_supports_of_any_size(kernel, scale, offset):
    support = 10 ** np.linspace(-12, np.log10(1.5), 200)
    masses = np.linspace(0.5, 2, 200)
    particles = set_of(support, scale, offset, kernel)
    found = total(particles, masses, (offset + scale / 2,) * 3, scale)
    assert found == pytest.approx(masses.sum(), rel=1e-3)


@pytest.mark.parametrize("support", [1e-3, 0.3, 2.0, 9.0, 20.0])
def test_cells_of_a_period_keep_mass(support):
    particles = set_of(support, box=(12.0, 10.0, 8.0) if support < 4 else (48.0, 40.0, 32.0))
    shape, spacing = (SHAPE, 1.0) if support < 4 else (SHAPE, 4.0)
    for lower in (0.0, spacing / 2):
        assert total(particles, np.ones(200), (lower,) * 3, spacing, shape) == pytest.approx(200, rel=1e-2)


def test_means_are_those_of_finer_points():
    particles, fine = set_of(np.linspace(0.8, 2.5, 200)), 8
    points = js.resample(particles, (0.5 / fine,) * 3, 1 / fine, tuple(fine * n for n in SHAPE), normalised=False).values
    wanted = np.asarray(points, np.float64).reshape(12, fine, 10, fine, 8, fine).mean((1, 3, 5))
    found = np.asarray(js.resample(particles, (0.5,) * 3, 1.0, SHAPE, normalised=False, cell="mean").values)
    assert np.abs(found - wanted).max() < 0.02 * wanted.max()


def test_a_mean_field_weighs_by_mass_and_what_is_outside_is_left_out():
    one = js.Particles.from_arrays([[1.2, 1, 1], [0.9, 1, 1], [9, 9, 9]], 1e-4, [2.0, 5.0, 1.0], [3.0, 1.0, 1.0])
    volume = js.resample(one, (0.0,) * 3, 1.0, (3, 3, 3), fill=-1.0, cell="mean")
    assert float(volume.values[1, 1, 1]) == pytest.approx((2 * 3 + 5) / 4) and float(volume.values[0, 0, 0]) == -1
    half = js.Particles.from_arrays([[-0.5, 1.0, 1.0]], 1.0, 0.0)
    assert total(half, np.ones(1), (0.0,) * 3, 1.0, (3, 3, 3)) == pytest.approx(0.5, rel=1e-2)
    with pytest.raises(ValueError, match="`cell` must be 'point' or 'mean', got 'sum'"):
        js.resample(one, (0.0,) * 3, 1.0, (3, 3, 3), cell="sum")
