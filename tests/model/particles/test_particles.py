"""Promises of the particle set: nothing wrong gets in, padding is inert, dtypes follow the inputs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.model.particles.particles import capacity_class

good = {"position": np.zeros((3, 3)), "support": np.ones(3), "quantity": np.arange(3.0), "volume": np.ones(3)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position": np.zeros((3, 2))}, r"`position` must have shape \(N, 3\), got \(3, 2\)"),
        ({"position": np.array([[0, 0, 0], [0, np.nan, 0], [0, 0, 0]])}, r"position\[1, 1\] = nan"),
        ({"position": np.full((3, 3), np.inf)}, "must be finite"),
        ({"position": np.full((3, 3), 1e300)}, "float64 under"),
        ({"support": np.array([1.0, 0.0, 1.0])}, r"`support` must be > 0, but support\[1\] = 0.0"),
        ({"support": -1.0}, "`support` must be > 0"),
        ({"support": 1e-60}, "underflows"),
        ({"support": np.ones(4)}, r"`support` must have shape \(3,\), got \(4,\)"),
        ({"quantity": np.ones(2)}, "each of the 3 particles"),
        ({"quantity": np.array([0, 1, np.nan])}, r"quantity\[2\] = nan"),
        ({"quantity": np.array(["a", "b", "c"])}, "real numbers"),
        ({"quantity": np.ones(3) * 1j}, "real numbers"),
        ({"volume": -1.0}, "`volume` must be >= 0"),
        ({"kernel": "cubic"}, "`kernel` must be one of poly6"),
        ({"capacity": 2}, r"`capacity` must be at least the number of particles \(3\) and 1, got 2"),
    ],
)
def test_bad_input_is_refused_by_name_with_the_value(change, message):
    with pytest.raises(ValueError, match=message):
        js.Particles.from_arrays(**{**good, **change})


def test_numbers_are_broadcast_and_lists_accepted():
    particles = js.Particles.from_arrays([[0, 0, 0], [1, 2, 3]], 0.5, [1, 2])
    assert particles.support.tolist() == [0.5, 0.5]
    assert particles.volume.tolist() == [1, 1]
    assert particles.num_particles == particles.capacity == 2


@pytest.mark.parametrize("empty", [[], np.zeros((0, 3))])
def test_an_empty_set_is_welcome(empty):
    particles = js.Particles.from_arrays(empty, 1.0, 0.0)
    assert particles.num_particles == 0
    assert particles.bounds()[0].shape == (3,)


def test_padding_is_marked_invalid():
    particles = js.Particles.from_arrays(**good, capacity=8)
    assert particles.capacity == 8
    assert particles.num_particles == 3
    assert particles.valid.tolist() == [True] * 3 + [False] * 5


@pytest.mark.parametrize("count", [*range(70), 20_000, 20_480, 20_481, 10**6, 2**30])
def test_capacities_come_in_four_classes_an_octave(count):
    capacity = capacity_class(count)
    assert max(count, 1) <= capacity <= max(1.25 * count, count + 1)
    assert capacity_class(capacity) == capacity
    while capacity > 7 and capacity % 2 == 0:
        capacity //= 2
    assert capacity <= 7


def test_sets_of_similar_size_have_the_same_capacity_and_keep_their_number():
    for count in range(900, 1024, 9):
        particles = js.Particles.from_arrays(np.ones((count, 3)), 0.5, 2.0)
        assert (particles.num_particles, particles.capacity) == (count, 1024)


def test_another_number_in_the_same_capacity_compiles_nothing(caplog):
    particles = [{name: np.ones((count, *array.shape[1:])) for name, array in good.items()} for count in (17, 18, 19)]
    js.Particles.from_arrays(**particles[0], capacity=20)
    with jax.log_compiles():
        for columns in particles[1:]:
            js.Particles.from_arrays(**columns, capacity=20)
    assert "Compiling" not in caplog.text


def test_padding_is_the_first_particle_without_volume():
    """So that who forgets what is valid meets no place, support or quantity that nobody gave."""
    for particles in (js.Particles.from_arrays(**good, capacity=8), js.Particles.from_arrays(**good).padded(8)):
        np.testing.assert_array_equal(particles.position[3:], np.tile(good["position"][:1], (5, 1)))
        np.testing.assert_array_equal(particles.quantity[3:], [good["quantity"][0]] * 5)
        np.testing.assert_array_equal(particles.volume[3:], np.zeros(5))
        assert particles.valid.tolist() == [True] * 3 + [False] * 5
        for name, column in particles.to_numpy().items():
            np.testing.assert_array_equal(column, np.asarray(getattr(particles, name))[:3])
    with pytest.raises(ValueError, match="`capacity` must be at least 8, the entries there are, got 7"):
        particles.padded(7)


@pytest.mark.parametrize("dtype", [np.float16, jnp.bfloat16, np.float32, np.float64, np.int32])
def test_without_x64_everything_becomes_float32(dtype):
    arrays = {name: np.asarray(value).astype(dtype) for name, value in good.items()}
    assert js.Particles.from_arrays(**arrays).dtype == jnp.float32


def test_float64_is_kept_under_x64(x64):
    assert js.Particles.from_arrays(**good).dtype == jnp.float64
    assert js.Particles.from_arrays(good["position"].astype(np.float32), 1.0, 0.0).dtype == jnp.float32


def test_bounds_hold_every_support():
    lower, upper = js.Particles.from_arrays([[0, 0, 0], [1, 2, 3]], [0.5, 0.25], 0.0, capacity=5).bounds()
    np.testing.assert_allclose(lower, [-0.5, -0.5, -0.5])
    np.testing.assert_allclose(upper, [1.25, 2.25, 3.25])


def test_can_be_built_under_jit():
    quantity = jax.jit(lambda q: js.Particles.from_arrays(good["position"], 1.0, q).quantity * 2)(jnp.arange(3.0))
    assert quantity.tolist() == [0, 2, 4]
