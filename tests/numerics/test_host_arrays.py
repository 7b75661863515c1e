"""Numbers that are known are computed by NumPy: to the bits that JAX gives, and without a program for each operation."""

import forced
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsph.numerics.checks import array_of, module_for, product

FIRST_FRAME = """
import dataclasses, json, os, sys
import jax.monitoring
import numpy as np
import jaxsph as js
from jaxsph.engine.request import Request
from tests.shared.compiled import EVENT, is_operation

def told(event, _, fun_name="", **more):
    if event == EVENT and is_operation(fun_name):
        operations.append(fun_name)

operations = []
os.chdir(sys.argv[1])
jax.monitoring.register_event_duration_secs_listener(told)
scene, camera = js.scenes.load("mixer", particles=3000)
camera = dataclasses.replace(camera, width=16, height=16)
settings = js.Settings(samples=16)
image = js.render(scene, camera, settings)
image.save("x.png")
js.io.read_image("x.png")
x, y, z = np.random.default_rng(0).random((3, 200))
np.savez("x.npz", position=np.stack([x, y, z], 1), support=np.full(200, 0.2), quantity=x)
read, camera = js.io.read_scene("x.npz")
surface = js.Surface(level=0.1, of="quantity", smoothing=1.5)
cut = dataclasses.replace(read, surface=surface, within=js.Box((0, 0, 0), (1, 1, 1)))
Request.of(cut, js.Camera.look_at((3, 3, 3), (0, 0, 0)), settings)
points = js.Points.from_arrays(read.particles.to_numpy()["position"] * 1e24, 1e23, extinction=1e-23)
Request.of(js.Scene(points=points), js.Camera.framing(points), settings)
js.Particles.from_arrays(np.stack([x, y, z], 1), 0.2, x, box=(1, 1, 1)).centered((0, 0, 0))
print(json.dumps(operations))
"""


def test_of_what_makes_a_first_frame_no_operation_is_compiled_by_itself(tmp_path):
    operations = forced.ran(FIRST_FRAME, str(tmp_path), devices=1)
    assert len(operations) < 5, operations  # each takes a thirtieth of a second


@pytest.mark.parametrize("wide", [False, True])
def test_products_have_the_bits_of_those_that_xla_computes(wide):
    random = np.random.default_rng(0)
    first, second = random.normal(size=(2, 4000)) * 10.0 ** random.integers(-45, 38, (2, 4000))
    first[:5] = 0, -0.0, np.inf, -np.inf, np.nan
    with jax.enable_x64(wide), np.errstate(over="ignore"):
        first, second = (jnp.asarray(part) for part in (first, second))
        for other in (second, second[7], 2.0**-80, 0.1):
            found, wanted = product(first, other), first * other
            assert (found.dtype, found.weak_type) == (wanted.dtype, wanted.weak_type)
            assert np.asarray(found).tobytes() == np.asarray(wanted).tobytes()


def test_arrays_do_not_change_with_what_they_were_made_of():
    given = np.zeros(1000, np.float32)
    made = array_of(given, jnp.float32)
    given[:] = 1
    assert not made.any()


def test_what_is_part_of_a_trace_or_was_put_on_a_device_is_left_to_jax():
    here, there = jnp.ones(3), jax.device_put(jnp.ones(3), jax.devices()[0])
    assert module_for(here, 2.0, None) is (np if jax.default_backend() == "cpu" else jnp)
    assert module_for(here, there) is jnp
    assert jax.make_jaxpr(lambda traced: product(traced, 2.0))(here).eqns
    assert product(there, here).committed
