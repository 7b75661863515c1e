"""Numbers that are trained: each place once, no integers, and the way back; unknowns are recovered from pictures by optax."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from derivatives import QUICKLY

import jaxsph as js

pytestmark = pytest.mark.usefixtures("quick_programs")

FAR = np.array([1e4, -2e4, 3e4])
LOOK = js.TransferFunction.from_points([-1.0, 0.0, 1.0], [(0.8, 0.2, 0.1), (0.2, 0.7, 0.3), (0.1, 0.4, 0.8)], [0.4, 1.0, 1.6])
STEPS = 60
ADAM = optax.adam(optax.cosine_decay_schedule(0.05, STEPS, 0.01))
SETTINGS = js.Settings(samples=16, integrator="segments")


def fluid(at=0.0, dtype=np.float64):
    position = np.random.default_rng(0).uniform(-0.7, 0.7, (9, 3))
    return js.Particles.from_arrays((position + at).astype(dtype), 0.6, position[:, 0].astype(dtype))


def seen_from(eye, target=(0, 0, 0)):
    return js.Camera.look_at(eye, target, width=16, height=16, near=1.2, far=5.0)


def recovered(numbers, wanted, step, target):
    """Numbers after some steps of Adam by those whose path ends with one of the names, and the losses before and after."""
    moving = {name: float(name.rpartition(".")[2] in wanted) for name in numbers}
    state, losses = ADAM.init(numbers), []
    for _ in range(STEPS):
        numbers, state, value, _ = step(numbers, state, moving, target)
        losses.append(value)
    return numbers, losses[0], step(numbers, state, moving, target)[2]


def parts():
    points = js.Points.from_arrays(np.zeros((3, 3)), 0.2, extinction=1.0, attributes={"age": np.ones(3)}, profile=[1.0, 0.5])
    volume = js.Volume.from_array(np.ones((2, 3, 4), np.float32))
    counts = js.Volume.from_array(np.ones((2, 2, 2), np.uint8))
    scene = js.Scene(fluid(), LOOK, volume=(volume, counts), volume_transfer=(LOOK, LOOK), points=points, surface=js.Surface(0.4))
    return [scene, fluid(FAR), LOOK, seen_from((0, 0, 3)), points, volume, (scene, seen_from(FAR))]


@pytest.mark.parametrize("part", parts(), ids=lambda part: type(part).__name__)
def test_numbers_are_floats_that_make_the_part_again(part):
    numbers, rebuild = js.trainable(part)
    assert all(leaf.dtype == np.float32 for leaf in jax.tree.leaves(numbers))
    for made in (rebuild(numbers), rebuild({}), jax.jit(rebuild)(numbers)):
        told, given = (
            np.concatenate([np.ravel(leaf).astype(np.float32) for leaf in jax.tree.leaves(one)]) for one in (made, part)
        )
        assert type(made) is type(part) and np.array_equal(told, given)
    assert not any(word in " ".join(numbers) for word in ("rest", "valid", "near", "snug"))


def test_numbers_are_float64_where_those_of_the_part_are(x64):
    numbers, rebuild = js.trainable(fluid())
    assert {leaf.dtype for leaf in jax.tree.leaves(numbers)} == {np.dtype(np.float64)}
    assert rebuild(numbers).position.dtype == np.float64


def test_a_step_moves_a_place_by_that_step():
    particles, camera = fluid(FAR), seen_from(FAR + (0.1, 0.2, 3.3), FAR)
    step = np.float32(2.0**-6)
    for part, name, exact in ((particles, "position", js.Particles.exact_position), (camera, "eye", js.Camera.exact_eye)):
        numbers, rebuild = js.trainable(part)
        assert np.abs(getattr(part, f"{name}_rest")).max() > 0
        moved = exact(rebuild(numbers | {name: numbers[name] + step})) - exact(part)
        assert np.allclose(moved[:9], step, rtol=0, atol=1e-12)


def test_low_digits_of_places_carry_no_slope():
    particles, camera = fluid(FAR), seen_from(FAR + (0.1, 0.2, 3.3), FAR)
    scene = js.Scene(particles, LOOK)
    plan = js.plan(scene, camera, SETTINGS)

    def loss(scene, camera):
        return (js.render(scene, camera, SETTINGS, plan=plan).color ** 2).sum()

    of_scene, of_camera = jax.jit(jax.grad(loss, (0, 1), allow_int=True), compiler_options=QUICKLY)(scene, camera)
    assert np.abs(of_scene.particles.position).max() > 0 and np.abs(of_camera.eye).max() > 0
    assert not np.any(of_scene.particles.position_rest) and not np.any(of_camera.eye_rest)


def test_padding_stays_as_it_is():
    particles = js.Particles.from_arrays(np.ones((3, 3)), 0.3, 1.0, capacity=5)
    numbers, rebuild = js.trainable(particles)
    moved = rebuild(jax.tree.map(lambda leaf: leaf + 1, numbers))
    assert np.array_equal(moved.position[:3], particles.position[:3] + 1)
    assert np.array_equal(moved.position[3:], particles.position[3:]) and np.array_equal(moved.volume[3:], particles.volume[3:])


def test_a_camera_that_turns_stays_one():
    numbers, rebuild = js.trainable(seen_from((0, 0, 3)))
    turned = jax.vmap(rebuild)({"turn": jnp.array([[0.0, 2.0, 0.0], [0.3, -0.4, 0.9]])})
    assert all(np.allclose(axes @ axes.T, np.eye(3), atol=1e-6) for axes in turned.axes)
    assert np.allclose(turned.axes[0, 2], (-1, 0, 0), atol=1e-6)  # by a right angle: twice arctan(1)
    assert set(numbers) == {"eye", "turn", "half_height"}


def test_what_is_no_number_of_it_is_refused_by_name():
    _, rebuild = js.trainable(js.Scene(fluid(), LOOK))
    with pytest.raises(ValueError, match=r"'particles\.valid', .* known are particles\.position, "):
        rebuild({"particles.valid": 1.0})
    with pytest.raises(ValueError, match=r"`transfer\.colors` must have shape \(3, 3\)"):
        rebuild({"transfer.colors": np.ones(3)})
    for part in (None, 3, "scene", []):
        with pytest.raises(ValueError, match="`part` must be a scene"):
            js.trainable(part)


def test_unknowns_are_recovered_from_pictures():
    scene, camera = js.Scene(fluid(), LOOK), seen_from((0.1, 0.2, 3.0))
    plan = js.plan(scene, camera, SETTINGS, headroom=3)
    true, rebuild = js.trainable({"scene": scene, "camera": camera})

    def loss(numbers, target):
        color = js.render(**rebuild(numbers), settings=SETTINGS, plan=plan).color
        return ((color - target) ** 2).mean(), color

    @functools.partial(jax.jit, compiler_options=QUICKLY)
    def step(numbers, state, moving, target):
        (value, color), slope = jax.value_and_grad(loss, has_aux=True)(numbers, target)
        moves, state = ADAM.update(slope, state, numbers)
        return optax.apply_updates(numbers, jax.tree.map(jnp.multiply, moves, moving)), state, value, color

    target = step(true, ADAM.init(true), dict.fromkeys(true, 0.0), np.zeros((16, 16, 3), np.float32))[3]

    def astray(**changes):
        return true | {name: true[name] + changes.get(name.rpartition(".")[2], 0) for name in true}

    starts = {
        "look": (("colors", "extinction"), astray(colors=0.1, extinction=0.3)),
        "quantities": (("quantity",), astray(quantity=0.2)),
        "places": (("position",), astray(position=0.05)),
        "pose": (("eye", "turn"), astray(eye=0.1, turn=0.03)),
    }
    for what, (names, start) in starts.items():
        end, before, after = recovered(start, names, step, target)
        assert after < 0.05 * before, what
    off = [np.linalg.norm(numbers["camera.eye"] - camera.eye) for numbers in (end, start)]
    assert off[0] < 0.5 * off[1]
