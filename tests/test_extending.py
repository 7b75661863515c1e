"""docs/extending.md keeps its word: what it adds, a file each, works as it stands, and is differentiable."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chords import Rays

import jaxsph as js
from jaxsph.model.settings import INTEGRATORS

pytestmark = pytest.mark.usefixtures("quick_programs")

PAGE = (Path(__file__).parent.parent / "docs" / "extending.md").read_text(encoding="utf-8")
FILES = {re.match(r"# (\w+)\.py\n", block)[1]: block for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)}
ENTRIES = re.findall(r'`INTEGRATORS\["(\w+)"\] = "jaxsph\.(?:\w+\.)+(\w+:\w+)"`', PAGE)
CENTRE, RADIUS, DENSITY, COLOR = (0.1, -0.05, 0.0), 0.6, 1.5, (0.2, 0.5, 0.9)


@pytest.fixture
def added(tmp_path, monkeypatch):
    """The page's files, where they can be imported, and its entry among integrators."""
    for name, code in FILES.items():
        (tmp_path / f"{name}.py").write_text(code, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    for name, place in ENTRIES:
        monkeypatch.setitem(INTEGRATORS, name, place)
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
    rays = Rays.of(view)
    return rays.within([CENTRE], RADIUS**2).reshape(view.height, view.width), rays.slant.reshape(view.height, view.width)


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
