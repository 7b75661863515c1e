"""What rays meet: sums that are those of the image, and nothing seen that is hidden."""

import numpy as np
import pytest

import jaxsph as js


def flat_camera(size=8):
    return js.Camera.orthographic((0.5, 0.5, -2), (0.5, 0.5, 0), view_height=0.5, width=size, height=size, near=1.0, far=5.0)


def slab(value, z):
    """A slab of one value, of thickness 1 along the line of sight, from z on."""
    return js.Volume.from_array(np.full((2, 2, 2), value, np.float32), (0, 0, z), 1.0)


LOOK = js.TransferFunction.from_points([0, 1], [(1, 0.5, 0), (0, 0.5, 1)], [2.0, 3.0])


def test_a_uniform_slab_absorbs_and_emits_what_its_optical_depth_says():
    found = js.visibility_histogram(js.Scene(volume=slab(0.25, 0.0), volume_transfer=LOOK), flat_camera(), bins=10)
    depth, color = 2.25, np.array([0.75, 0.5, 0.25])
    assert found.rays == 64 and found.edges[[0, -1]].tolist() == [0, 1]
    filled = np.flatnonzero(found.there)
    assert filled.tolist() == [2]  # from 0.2 to 0.3
    np.testing.assert_allclose(found.there[2], 1, rtol=1e-9)
    np.testing.assert_allclose(found.absorbed[2], 1 - np.exp(-depth), rtol=1e-6)
    np.testing.assert_allclose(found.emitted[2], color * (1 - np.exp(-depth)), rtol=1e-6)


def test_what_lies_behind_is_there_but_absorbs_only_what_gets_through():
    scene = js.Scene(volume=(slab(1.0, 0.0), slab(0.0, 1.5)), volume_transfer=(LOOK, LOOK))
    front, back = (js.visibility_histogram(scene, flat_camera(), part=part) for part in (0, 1))
    np.testing.assert_allclose(front.absorbed.sum(), 1 - np.exp(-3), rtol=1e-6)
    np.testing.assert_allclose(back.absorbed.sum(), np.exp(-3) * (1 - np.exp(-2)), rtol=1e-6)
    np.testing.assert_allclose(back.there.sum(), 1, rtol=1e-9)


@pytest.mark.parametrize("perspective", [True, False])
def test_sums_over_all_values_are_the_mean_light_of_the_rays(perspective):
    rng = np.random.default_rng(5)
    particles = js.Particles.from_arrays(
        rng.normal(size=(80, 3)).astype(np.float32), 0.9, rng.uniform(size=80), rng.uniform(1, 2, 80)
    )
    camera = js.Camera.framing(particles, width=12, height=10)
    if not perspective:
        camera = js.Camera.orthographic((0, 0, -6), (0, 0, 0), view_height=7, width=12, height=10, near=1, far=11)
    look = js.TransferFunction.from_points([0, 1], [(1, 0.5, 0), (0, 0.5, 1)], [0.5, 2.0])
    scene = js.Scene(particles=particles, transfer=look)
    found, truth = js.visibility_histogram(scene, camera, rays=10_000), js.reference.integral(scene, camera)
    assert found.rays == 120
    np.testing.assert_allclose(found.absorbed.sum(), np.mean(1 - truth.transmittance), atol=1e-4)
    np.testing.assert_allclose(found.emitted.sum(0), np.mean(truth.color, (0, 1)), atol=1e-4)


@pytest.mark.parametrize("box", [None, (2, 2, 2)], ids=["clip", "period"])
def test_a_clip_and_a_period_hide_what_they_hide_in_images(box):
    rng = np.random.default_rng(5)
    particles = js.Particles.from_arrays(rng.uniform(0, 2, (60, 3)).astype(np.float32), 0.5, rng.uniform(size=60), box=box)
    camera = js.Camera.orthographic((1, 1, -3), (1, 1, 1), view_height=2, width=9, height=9, near=1, far=7)
    scene = js.Scene(particles=particles, transfer=LOOK, within=js.Plane((0, 0, 1), (0, 0.1, 1)) if box is None else None)
    found, truth = js.visibility_histogram(scene, camera), js.reference.integral(scene, camera)
    np.testing.assert_allclose(found.absorbed.sum(), np.mean(1 - truth.transmittance), atol=1e-4)


def test_values_beyond_the_control_points_have_bins_of_their_own():
    scene = js.Scene(volume=slab(1.5, 0.0), volume_transfer=LOOK)
    found = js.visibility_histogram(scene, flat_camera(), bins=30)
    assert found.edges[-1] == pytest.approx(1.5) and found.absorbed[-1] > 0.9


def test_bins_of_a_log_domain_have_even_logarithms():
    look = js.TransferFunction.from_colormap("heat", js.TransferFunction.control_values("log", low=1e-3, high=1e3))
    found = js.visibility_histogram(js.Scene(volume=slab(12.0, 0.0), volume_transfer=look), flat_camera(), bins=12)
    np.testing.assert_allclose(np.log10(found.edges), np.linspace(-3, 3, 13), atol=1e-5)
    assert np.flatnonzero(found.there).tolist() == [8]


def test_rays_that_meet_nothing_count_as_rays():
    camera = js.Camera.orthographic((9, 9, -2), (9, 9, 0), view_height=0.5, width=4, height=4, near=1.0, far=5.0)
    found = js.visibility_histogram(js.Scene(volume=slab(0.5, 0.0), volume_transfer=LOOK), camera)
    assert found.rays == 16 and not found.there.any() and np.isfinite(found.edges).all()


@pytest.mark.parametrize("more", [{"rays": 0}, {"rays": 2.5}, {"bins": 0}, {"part": 1}, {"part": -1}])
def test_numbers_out_of_range_are_refused_by_name(more):
    with pytest.raises(ValueError, match=f"`{next(iter(more))}`"):
        js.visibility_histogram(js.Scene(volume=slab(0.5, 0.0), volume_transfer=LOOK), flat_camera(), **more)


def test_media_it_does_not_know_are_refused():
    surface = js.IsoSurface.from_volume(slab(0.5, 0.0), 0.2)
    with pytest.raises(ValueError, match="media"):
        js.visibility_histogram(js.Scene(volume=slab(0.5, 0.0), volume_transfer=LOOK, media=(surface,)), flat_camera())
