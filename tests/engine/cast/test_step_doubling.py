"""Step doubling finds the light integral to its tolerance, with few evaluations; what it cannot do it refuses by name."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from images import seen_from

import jaxsph as js
from jaxsph.engine.cast.step_doubling import SHORTEST, StepDoubling
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.media.shown import Mixture
from jaxsph.model.medium import Medium

pytestmark = pytest.mark.usefixtures("quick_programs")

NEAR, FAR, SAMPLES, POINTS = 1.0, 3.0, 8, 64
COLOR = 0.2, 0.5, 0.9


@dataclasses.dataclass(frozen=True)
class Along(Medium):
    """Extinction by depth: linear between given depths, 0 outside; everywhere in view."""

    depths: jax.Array
    values: jax.Array
    color: jax.Array

    def occupied(self, slabs):
        return slabs.z_upper >= 0

    def extinction(self, gathered, task):
        z = task.positions()[2]
        return jnp.interp(z.ravel(), self.depths, self.values, left=0, right=0).reshape(z.shape), z

    def colors(self, samples, task, channels):
        return [jnp.broadcast_to(color, samples.shape) for color in self.color[channels]]

    def thickness(self):
        """Integral of extinction over depth."""
        return float(np.trapezoid(np.asarray(self.values, float), np.asarray(self.depths, float)))


jax.tree_util.register_dataclass(Along, data_fields=["depths", "values", "color"], meta_fields=[])


def along(depths, values, color=COLOR):
    """Of so many points, the last again and again, that all share a program."""
    padded = (np.pad(np.asarray(value, np.float32), (0, POINTS - len(value)), mode="edge") for value in (depths, values))
    return Along(*padded, np.float32(color))


def slab(perspective=False):
    """All of a few rays in one slab, in packets or (in perspective) one by one; and their path a unit of depth."""
    border = np.linspace(NEAR, FAR, SAMPLES + 1, dtype=np.float32)[None]
    u, v = np.float32([[-0.4, 0.0, 0.3]]), np.float32([[0.1, 0.2, -0.5]])
    task = SlabTask(None, *2 * [np.arange(1, dtype=np.int32)], u, v, 0.5 * (border[:, 1:] + border[:, :-1]), border, perspective)
    if not perspective:
        return task, 1.0
    return dataclasses.replace(task, scattered=True), np.sqrt(1 + u**2 + v**2)


@functools.partial(jax.jit, compiler_options=QUICKLY)
def marched(media, task, tolerance):
    """Light of rays, and evaluations of each."""
    made = StepDoubling(tolerance, SAMPLES)
    medium = Mixture.of(media)
    return made(medium, medium.gather(task), task), made.march(medium, task).evaluations


NOTHING = along([NEAR, FAR], [0.0, 0.0])


@pytest.mark.parametrize("perspective", [False, True])
def test_extinction_that_is_linear_along_a_step_is_integrated_exactly_by_two_evaluations_a_sample(perspective):
    """A constant medium and a ramp together, of one colour: neither needs more than the longest steps."""
    media = along([NEAR, FAR], [0.3, 0.3]), along([NEAR, FAR], [0.0, 0.7])
    task, slant = slab(perspective)
    light, evaluations = marched(media, task, 1e-3)
    through = np.exp(-slant * sum(medium.thickness() for medium in media))
    np.testing.assert_allclose(light.transmittance, np.broadcast_to(through, light.transmittance.shape), rtol=2e-6)
    for channel, color in zip(light.color, COLOR, strict=True):
        np.testing.assert_allclose(channel, color * (1 - np.asarray(light.transmittance)), rtol=2e-6)
    np.testing.assert_allclose(np.exp(-np.asarray(light.thickness).sum(1)), light.transmittance, rtol=2e-6)
    assert (np.asarray(evaluations) == 2 * SAMPLES + 1).all()


def test_a_thin_bright_shell_is_found_that_as_many_uniform_samples_miss():
    """As wide as a seventh of a sample: three points of a step see it once, and its steps alone are halved."""
    width, middle, total = 0.035, 2.127, 1.2
    shell = along([middle - width, middle, middle + width], [0.0, total / width, 0.0], (1.0, 1.0, 1.0))
    light, evaluations = marched((along([NEAR, FAR], [0.1, 0.1], (0.0, 0.0, 0.0)), shell), slab()[0], 1e-3)
    truth = np.exp(-0.1 * (middle - NEAR)) * (1 - np.exp(-total))
    error, number = np.abs(np.asarray(light.color[0]) - truth).max(), int(np.asarray(evaluations).max())
    assert error < 2e-3
    at = NEAR + (FAR - NEAR) * (np.arange(number) + 0.5) / number
    values = np.interp(at, np.asarray(shell.depths), np.asarray(shell.values)) * (FAR - NEAR) / number
    assert abs(1 - np.exp(-values.sum()) - (1 - np.exp(-total))) > 10 * error


def test_error_falls_with_the_tolerance_and_stays_within_it():
    depths = np.linspace(NEAR, FAR, POINTS)
    medium = along(depths, 3 * np.exp(-(((depths - 1.9) / 0.2) ** 2)) + 0.2 * np.sin(9 * depths) ** 2)
    truth, errors, spent = np.exp(-medium.thickness()), [], []
    for tolerance in (1e-1, 1e-2, 1e-3):
        light, evaluations = marched((medium, NOTHING), slab()[0], tolerance)
        errors.append(float(np.abs(np.asarray(light.transmittance) - truth).max()))
        spent.append(int(evaluations.max()))
        assert errors[-1] <= tolerance
    assert errors[2] < errors[1] < errors[0] and spent[2] > spent[1] > spent[0]


def test_a_jump_ends_at_the_least_step():
    """A tolerance is asked for that no step keeps at the jump; what is constant behind it is no finer for that."""
    jump = 2.0371
    medium = along([NEAR, jump, jump, FAR], [0.0, 0.0, 5.0, 5.0])
    light, evaluations = marched((medium, NOTHING), slab()[0], 1e-6)
    assert int(evaluations.max()) < 4 * SAMPLES + 60
    step = (FAR - NEAR) / SAMPLES * SHORTEST
    np.testing.assert_allclose(light.transmittance, np.exp(-5 * (FAR - jump)), rtol=5 * step)


GRID = np.random.default_rng(4).uniform(0, 1, (6, 5, 7)).astype(np.float32)
SETTINGS = js.Settings(samples=24, integrator="step_doubling", step_tolerance=2e-3)


def scene(**parts):
    volume = js.Volume.from_array(GRID, (-1.0, -0.8, -0.9), (0.4, 0.4, 0.3))
    transfer = js.TransferFunction.from_points((0.2, 0.5, 0.8), [[1, 0.2, 0], [0, 1, 0.3], [0.1, 0, 1]], (0.0, 2.0, 0.5))
    return js.Scene(volume=volume, volume_transfer=transfer, **parts)


def camera(projection="perspective"):
    return seen_from((1.4, 1.1, -2.6), projection, width=13, height=11, near=1.2, far=5.0)


@pytest.fixture
def image():
    return js.render(scene(), camera(), SETTINGS)


def test_under_jit_the_image_is_the_same_and_a_plan_knows_its_step_tolerance(image):
    plan = js.plan(scene(), camera(), SETTINGS)
    jitted = jax.jit(lambda shown: js.render(shown, camera(), SETTINGS, plan=plan).color, compiler_options=QUICKLY)(scene())
    np.testing.assert_allclose(jitted, image.color, atol=0.1 * SETTINGS.step_tolerance)  # a step may be accepted or not
    with pytest.raises(ValueError, match=r"`plan` was made for settings.step_tolerance = 0.002, got 0.01"):
        js.render(scene(), camera(), dataclasses.replace(SETTINGS, step_tolerance=0.01), plan=plan)
    samples = dataclasses.replace(SETTINGS, integrator="samples")
    of_samples = js.plan(scene(), camera(), samples)
    assert of_samples == js.plan(scene(), camera(), dataclasses.replace(samples, step_tolerance=0.5)) != plan


@pytest.mark.slow
def test_a_quadtree_casts_single_rays_with_it(image):
    settings = dataclasses.replace(SETTINGS, screen="quadtree", tolerance=1e-4)
    found = js.render(scene(), camera(), settings)
    np.testing.assert_allclose(found.color, image.color, atol=1e-3)


def test_forward_derivatives_of_rays_are_those_of_the_closed_form():
    """By the height of a ramp, of which the thickness is a share."""
    ramp, task = along([NEAR, FAR], [0.0, 0.7]), slab()[0]
    way = dataclasses.replace(jax.tree.map(np.zeros_like, ramp), values=ramp.values)
    through, found = jax.jvp(lambda ramp: marched((ramp, NOTHING), task, 1e-3)[0].transmittance, (ramp,), (way,))
    np.testing.assert_allclose(found, -ramp.thickness() * np.asarray(through), rtol=1e-5)
