"""docs/extending.md keeps its word: what it adds, a file each, works as it stands, and is differentiable."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.model import registry
from jaxsph.reference.where import ray_coordinates, to_view

pytestmark = pytest.mark.usefixtures("quick_programs")

PAGE = (Path(__file__).parent.parent / "docs" / "extending.md").read_text(encoding="utf-8")
FILES = {re.match(r"# (\w+)\.py\n", block)[1]: block for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)}
ENTRIES = re.findall(r'`INTEGRATORS\["(\w+)"\] = "jaxsph\.(?:\w+\.)+(\w+:\w+)"`', PAGE)
CENTRE, RADIUS, DENSITY, COLOR = (0.1, -0.05, 0.0), 0.6, 1.5, (0.2, 0.5, 0.9)


@pytest.fixture
def added(tmp_path, monkeypatch):
    """The page's files, where they can be imported, and its entry in the registry."""
    for name, code in FILES.items():
        (tmp_path / f"{name}.py").write_text(code, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    for name, place in ENTRIES:
        monkeypatch.setitem(registry.INTEGRATORS, name, place)
    return {name: importlib.import_module(name) for name in FILES}


def camera(width=37, height=29):
    return js.Camera.look_at((0.3, 0.2, -3.0), (0.0, 0.0, 0.0), fov_degrees=40.0, width=width, height=height, near=1.5, far=4.5)


def particles(count):
    rng = np.random.default_rng(2)
    position = rng.uniform(-0.8, 0.8, (count, 3)).astype(np.float32)
    found = js.Particles.from_arrays(position, 0.5, position[:, 0])
    transfer = js.TransferFunction.from_points([-0.8, 0.0, 0.8], [[1, 0, 0], [0, 1, 0], [0, 0, 1]], [0.5, 2.0, 1.0])
    return {"particles": found, "transfer": transfer}


def ball(added, **changed):
    given = {"centre": CENTRE, "radius": RADIUS, "density": DENSITY, "color": COLOR} | changed
    return added["ball"].Ball(**{name: jnp.asarray(value, jnp.float32) for name, value in given.items()})


def chords(view):
    """Of all pixels' rays with the ball, in float64; and a ray's length a unit of depth."""
    u, v = ray_coordinates(view, np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    direction = np.stack(np.broadcast_arrays(u, v[:, None], 1.0), -1)
    slant = np.linalg.norm(direction, axis=-1)
    centre = to_view(np.asarray(CENTRE), view)
    along = (direction @ centre) / slant
    return 2 * np.sqrt(np.maximum(RADIUS**2 - (centre @ centre - along**2), 0)), slant


def test_the_page_adds_one_of_each():
    assert set(FILES) == {"ball", "radiograph"} and len(ENTRIES) == 1


def test_a_ball_without_particles_is_the_light_integral_but_for_its_borders(added):
    view, settings = camera(), js.Settings(samples=512)
    image = js.render(js.Scene(**particles(0), media=(ball(added),)), view, settings)
    chord, slant = chords(view)
    alpha = 1 - np.exp(-DENSITY * chord)
    step = float(view.far) * np.log(float(view.far) / float(view.near)) / 512 * slant  # the longest there is
    assert (np.abs(np.asarray(image.alpha) - alpha) <= DENSITY * step + 1e-6).all()
    np.testing.assert_allclose(image.color, np.asarray(COLOR) * np.asarray(image.alpha)[..., None], atol=1e-6)
    assert np.asarray(image.alpha).max() > 0.5 and (np.asarray(image.alpha)[0] == 0).all()


@pytest.mark.slow
def test_media_share_a_ray_and_are_sorted_in_depth(added):
    """An absent ball changes no bit; an opaque one hides what is behind it, and not what is in front."""
    view, settings, fluid = camera(), js.Settings(samples=128), particles(60)
    alone = js.render(js.Scene(**fluid), view, settings)
    absent = js.render(js.Scene(**fluid, media=(ball(added, density=0.0),)), view, settings)
    np.testing.assert_allclose(absent.color, alone.color, atol=1e-6)
    np.testing.assert_allclose(absent.transmittance, alone.transmittance, atol=1e-6)
    both = js.render(js.Scene(**fluid, media=(ball(added, density=1e4, color=(0.0, 0.0, 0.0)),)), view, settings)
    middle = view.height // 2, view.width // 2
    assert float(both.alpha[middle]) > 0.999
    assert 0.05 < float(both.color[middle].sum()) < float(alone.color[middle].sum())
    assert float(both.depth[middle]) <= float(alone.depth[middle])


@pytest.mark.slow
def test_a_ball_is_differentiated_by_what_it_is_made_of(added):
    view, settings, fluid = camera(9, 8), js.Settings(samples=16), particles(20)
    plan = js.plan(js.Scene(**fluid, media=(ball(added),)), view, settings)

    def light(density, color):
        scene = js.Scene(**fluid, media=(ball(added, density=density, color=color),))
        image = js.render(scene, view, settings, plan=plan)
        return (image.color * jnp.arange(3.0)).sum() + image.transmittance.sum()

    both, step = jax.jit(jax.value_and_grad(light, (0, 1))), 1e-2
    density, color = jnp.float32(DENSITY), jnp.asarray(COLOR, jnp.float32)
    of_density, of_color = both(density, color)[1]
    wanted = (both(density + step, color)[0] - both(density - step, color)[0]) / (2 * step)
    np.testing.assert_allclose(of_density, wanted, rtol=5e-3)
    blue = step * jnp.eye(3, dtype=jnp.float32)[2]
    wanted = (both(density, color + blue)[0] - both(density, color - blue)[0]) / (2 * step)
    np.testing.assert_allclose(of_color[2], wanted, rtol=5e-3)
    assert float(of_color[0]) == 0 != float(wanted)


@pytest.mark.slow
def test_a_radiograph_is_of_lengths_of_chords_however_few_samples(added):
    """Of one support with the same extinction all over it is the exponential of that; and nothing shines."""
    fluid = js.Particles.from_arrays(np.asarray([CENTRE], np.float32), RADIUS, [0.5])
    transfer = js.TransferFunction.from_points([0.0, 1.0], [[1, 0, 0], [0, 0, 1]], [DENSITY, DENSITY])
    scene, view = js.Scene(particles=fluid, transfer=transfer), camera()
    image = js.render(scene, view, js.Settings(samples=18, integrator="radiograph"))  # not a whole number of slabs
    np.testing.assert_allclose(image.transmittance, np.exp(-DENSITY * chords(view)[0]), atol=1e-5)
    assert not np.asarray(image.color).any() and image.stats["evaluations"] > 0


@pytest.mark.slow
def test_radiographs_are_differentiable_without_an_adjoint_of_their_own(added):
    fluid, view, settings = particles(30), camera(13, 11), js.Settings(samples=32, integrator="radiograph")
    plan = js.plan(js.Scene(**fluid), view, settings)

    def light(extinction):
        transfer = js.TransferFunction(fluid["transfer"].values, fluid["transfer"].colors, extinction)
        image = js.render(js.Scene(particles=fluid["particles"], transfer=transfer), view, settings, plan=plan)
        return image.color.sum() + 2 * image.transmittance.sum()

    at, step, both = fluid["transfer"].extinction, 1e-2, jax.jit(jax.value_and_grad(light))
    found = both(at)[1]
    for k, direction in enumerate(np.eye(3, dtype=np.float32)):
        wanted = (both(at + step * direction)[0] - both(at - step * direction)[0]) / (2 * step)
        np.testing.assert_allclose(found[k], wanted, rtol=5e-3, atol=1e-2)


@pytest.mark.parametrize(
    ("changed", "what"),
    [
        ({"integrator": "radiograph"}, "integrator='radiograph'"),
        ({"integrator": "samples"}, "media"),
    ],
)
def test_a_tolerance_that_no_estimator_keeps_is_refused_by_name(added, changed, what):
    media = {"media": (ball(added),)} if what == "media" else {}
    scene, view = js.Scene(**particles(5), **media), camera(8, 8)
    with pytest.raises(ValueError, match=f"`tolerance` does not cover `.*{what}"):
        js.render(scene, view, js.Settings(tolerance=0.01, **changed))
