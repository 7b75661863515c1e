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
from jaxsph.engine.cast.integrator import Integrator, Segment
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
    assert set(FILES) == {"ball", "radiograph", "step_doubling"} and len(ENTRIES) == 2


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


@pytest.fixture
def counting(added, monkeypatch):
    """Names of integrators that show in red at how many points even steps and step doubling ask."""
    page = added["step_doubling"]

    def shown(number, task):
        number = number.astype(task.border.dtype)
        return Segment((number, 0 * number, 0 * number), 0 * number + 1, jnp.zeros(task.shape, number.dtype))

    class EvenPoints(Integrator):
        def __call__(self, medium, gathered, task):
            return shown(jnp.broadcast_to((jnp.diff(task.border) > 0).sum(1)[:, None], task.shape[::2]), task)

    class StepPoints(page.StepDoubling):
        def __call__(self, medium, gathered, task):
            return shown(self.march(medium, task).evaluations.sum(1).reshape(task.shape[::2]), task)

    for one in (EvenPoints, StepPoints):
        monkeypatch.setattr(page, one.__name__, one, raising=False)
        monkeypatch.setitem(INTEGRATORS, one.__name__, f"step_doubling:{one.__name__}")
    return "EvenPoints", "StepPoints"


def shell():
    """A smooth volume, of which a thin shell is bright: wide steps serve elsewhere."""
    x, y, z = np.meshgrid(*3 * [np.linspace(-1, 1, 33)], indexing="ij")
    values = np.exp(-2 * (x**2 + y**2 + z**2)).astype(np.float32)
    volume = js.Volume.from_array(values, (-1.0, -1.0, -1.0), 2 / 32)
    colors = [[0, 0, 1], [0, 1, 0], [1, 0.5, 0], [1, 0, 0], [1, 0, 0]]
    transfer = js.TransferFunction.from_points([0.0, 0.4, 0.5, 0.6, 1.0], colors, [0.02, 0.1, 12.0, 0.1, 0.3])
    return js.Scene(volume=volume, volume_transfer=transfer)


def furthest(image, truth):
    """Largest error of colours and alpha."""
    return max(np.abs(np.asarray(image.color) - truth.color).max(), np.abs(np.asarray(image.alpha) - truth.alpha).max())


def test_steps_keep_their_tolerance_with_fewer_points(added, counting):
    """Than even steps that err more."""
    scene, view = shell(), camera(9, 7)
    truth = js.reference.integral(scene, view)

    def rendered(samples, integrator):
        return js.render(scene, view, js.Settings(samples=samples, integrator=integrator))

    error, of_even = (furthest(rendered(*how), truth) for how in ((32, "step_doubling"), (160, "samples")))
    even, steps = (np.asarray(rendered(*how).color)[..., 0].mean() for how in zip((160, 32), counting, strict=True))
    assert error <= added["step_doubling"].StepDoubling.tolerance
    assert steps < even and error < of_even


@pytest.mark.slow
def test_steps_find_particles_between_samples(added):
    """Of few supports, some shorter than the way from sample to sample."""
    scene, view = js.Scene(**particles(12)), camera(9, 7)
    truth = js.reference.integral(scene, view)
    error = furthest(js.render(scene, view, js.Settings(samples=16, integrator="step_doubling")), truth)
    assert error <= added["step_doubling"].StepDoubling.tolerance


def test_steps_refuse_media_without_points(added):
    points = js.Points.from_arrays(np.zeros((1, 3), np.float32), 0.5, [[1.0, 0, 0]], 1.0)
    with pytest.raises(ValueError, match="asks media at points, where `PointsMedium` has nothing"):
        js.render(js.Scene(points=points), camera(9, 7), js.Settings(samples=16, integrator="step_doubling"))


def test_steps_have_no_derivatives_and_say_so(added):
    view, settings = camera(9, 7), js.Settings(samples=16, integrator="step_doubling")
    plan = js.plan(js.Scene(media=(ball(added),)), view, settings)

    def light(density):
        return js.render(js.Scene(media=(ball(added, density=density),)), view, settings, plan=plan).transmittance.sum()

    with pytest.raises(NotImplementedError, match="step doubling has no derivatives"):
        jax.grad(light)(jnp.float32(1))
