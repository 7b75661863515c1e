"""A pixel of a surface explained: the place and the light of the picture, and shares of the coverage that add up to it."""

import dataclasses

import numpy as np
import pytest
from views import HEIGHT, SETTINGS, WIDTH, camera, scene

import jaxsph as js
from jaxsph.analysis.at_places import ParticleField
from jaxsph.analysis.explanation import surface
from jaxsph.analysis.explanation.surface import SurfaceExplanation
from jaxsph.model.scene import widened
from jaxsph.reference.chords import rays_of
from jaxsph.reference.where import to_world

pytestmark = pytest.mark.usefixtures("quick_programs")

LEVEL = 5.0
MIDDLE = HEIGHT // 2, WIDTH // 2


def surfaced(**more):
    return dataclasses.replace(scene(), surface=js.Surface(LEVEL, smoothing=1.1), **more)


@pytest.mark.core
def test_place_light_and_shares_are_those_of_the_picture():
    made, image = js.explain(surfaced(), camera(), SETTINGS, pixel=MIDDLE), js.render(surfaced(), camera(), SETTINGS)
    assert isinstance(made, SurfaceExplanation) and made.surface_depth == float(image.depth[MIDDLE])
    np.testing.assert_array_equal(made.color, image.color[MIDDLE])
    rays = rays_of(camera(), *np.reshape(MIDDLE, (2, 1)))
    place = to_world(rays.start + float(image.depth[MIDDLE]) * rays.direction, camera())
    np.testing.assert_allclose(made.position, place[0])
    np.testing.assert_allclose(made.normal, image.normal[MIDDLE], atol=1e-3)
    ambient = float(surfaced().surface.ambient)
    values, colors = (np.asarray(one, np.float64) for one in (scene().transfer.values, scene().transfer.colors))
    own = np.array([np.interp(made.surface_quantity, values, channel) for channel in colors.T])
    np.testing.assert_allclose(made.color, own * (ambient + (1 - ambient) * made.facing), atol=1e-3)
    assert made.off < 1e-5 and len(made.particles) > 1 and made.shares.sum() == pytest.approx(1)
    field = ParticleField(widened(surfaced()).particles)
    assert field.at(made.position[None]).coverage[0] == pytest.approx(LEVEL, rel=1e-4)
    np.testing.assert_array_equal(np.sort(field.near(made.position[None]).entry), made.particles)
    assert np.isnan(made.total) and not made.sources and not made.certified and (np.diff(made.depth) > 0).all()
    assert "depth" in str(made) and f"{len(made.particles)} reach the place" in str(made) and "pixel (16, 24)" in repr(made)


def test_where_there_is_none_it_says_what_coverages_the_ray_meets():
    made = js.explain(surfaced(), camera(), SETTINGS, pixel=(0, 0))
    assert np.isinf(made.surface_depth) and not len(made.particles) and not made.normal.any()
    assert "none: the ray meets a coverage of 0" in str(made) and "the level is 5" in str(made)


def test_clips_hide_what_they_hide_and_points_in_front_are_of_the_colour_alone():
    far = float(np.asarray(camera().exact_eye())[2])
    clip = js.Plane((0, 0, -0.2), (0, 0, -1))
    made = js.explain(surfaced(within=clip), camera(), SETTINGS, pixel=MIDDLE)
    assert made.surface_depth > far - 0.5 and np.isnan(made.coverage[made.depth < far - 0.5]).all()
    veil = js.Points.from_arrays(np.array([[0, 0, 1.5]], np.float32), radius=0.5, color=(1, 1, 1), opacity=0.9)
    veiled, bare = (js.explain(one, camera(), SETTINGS, pixel=MIDDLE) for one in (surfaced(points=veil), surfaced()))
    assert veiled.surface_depth == bare.surface_depth and np.abs(veiled.color - bare.color).max() > 0.1


def test_what_the_picture_passed_without_finding_it_is_told(monkeypatch):
    found = js.explain(surfaced(), camera(), SETTINGS, pixel=MIDDLE)
    image = js.render(surfaced(), camera(), SETTINGS)
    behind = dataclasses.replace(image, depth=image.depth + 0.5)  # as where samples are too far apart
    monkeypatch.setattr(surface, "render", lambda *_: behind)
    made = js.explain(surfaced(), camera(), SETTINGS, pixel=MIDDLE)
    assert made.missed == pytest.approx(found.surface_depth, abs=1e-5) and np.isinf(found.missed)
    assert "thinner than a sample, at depth" in str(made)
