"""Promises at the extremes: over thirteen decades of every input a float32 image is right, or refused; never silently wrong.

What "right" means: the reference image of particles and samples moved by a few eps of their distance from the eye. How much
that changes a pixel is what it may be off, and 64 eps (`error_and_allowance`).
"""

import dataclasses
import itertools
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.numerics import faults
from jaxsph.plan import control_plan

EPS = float(np.finfo(np.float32).eps)
FORWARD = -np.array([0.3, 0.5, 0.8]) / np.linalg.norm([0.3, 0.5, 0.8])


@dataclasses.dataclass(frozen=True)
class Extreme:
    """A frame of 24 particles in a cube of two units, seen from three units away; and what of it is extreme."""

    length: float = 1.0  # of a unit
    offset: float = 0.0  # of everything from the origin, units
    decades: float = 1.0  # over which supports are spread
    volume: str = "given"
    support: float = 1.0
    slab: float | None = None  # far / near - 1 of a thin frame, into which the scene is shrunk
    nearest: float | None = None  # far / near
    extinction: tuple[float, ...] = (1, 1, 1, 1, 1)  # factors
    scale: float = 1.0  # of quantities and control points
    start: float = 0.0  # of quantities and control points, before they are scaled
    spike: float | None = None  # quantity of two particles
    coincident: bool = False
    projection: str = "perspective"
    kernel: str = "poly6"

    def scene(self, frames, seed=0):
        rng = np.random.default_rng(seed)
        count = frames.capacity
        position = rng.uniform(-1, 1, (count, 3)) * (0 if self.coincident else 1)
        support = 0.9 * 10 ** -rng.uniform(0, self.decades, count) * self.support
        volume = {"given": rng.uniform(0.1, 1, count), "equal": np.ones(count), "cube": support**3 / support.max() ** 3}[
            self.volume
        ]
        quantity = self.rounded(rng.uniform(0, 1, count))
        if self.spike is not None:
            quantity[:2] = self.spike, -self.spike
        points = np.sort(rng.uniform(0, 1, 5)), rng.uniform(0, 1, (5, 3)), rng.uniform(0, 4, 5) * self.extinction
        unit = self.length * (1 if self.slab is None else self.slab / 3.4)
        place = position * unit + self.origin()
        particles = js.Particles.from_arrays(place, support * unit, quantity, volume, self.kernel)
        return js.Scene(
            particles=particles, transfer=js.TransferFunction.from_points(self.rounded(points[0]), points[1], points[2] / unit)
        )

    def rounded(self, value):
        """Numbers that float32 holds as they are."""
        return np.float32((value + self.start) * self.scale).astype(np.float64)

    def origin(self):
        return np.array([1, -1 / 3, 1 / 7]) * self.offset * self.length

    def camera(self, frames):
        target, size = self.origin(), {"width": frames.width, "height": frames.height}
        distance, near, far, height = 3.0, 1.3, 4.7, 2.6
        if self.slab is not None:
            distance, near, far, height = 1.0, 1 - self.slab / 2, 1 + self.slab / 2, 0.8 * self.slab
        if self.nearest is not None:
            near = far / self.nearest
        distance, near, far, height = (value * self.length for value in (distance, near, far, height))
        eye, up = target - FORWARD * distance, (0.1, 1, 0.2)
        if self.projection == "perspective":
            fov = 2 * np.degrees(np.arctan(height / distance / 2))
            return js.Camera.look_at(eye, target, up, fov, **size, near=near, far=far)
        return js.Camera.orthographic(eye, target, up, height, **size, near=near, far=far)


def moved(scene, camera, rng, part):
    """The scene with everything moved by up to `part` of what it is rounded by: positions, supports, quantities."""
    particles = scene.particles
    position, eye = particles.exact_position(), camera.exact_eye()
    distance = np.abs(position - eye).max(1, keepdims=True)
    quantity = np.asarray(particles.quantity, np.float64)
    inside = np.abs(quantity) <= 1e6 * np.abs(np.asarray(scene.transfer.values, np.float64)).max()
    spread = np.ptp(quantity[inside]) if inside.any() else 0
    shaken = {
        "position": position + part * distance * rng.uniform(-1, 1, position.shape),
        "quantity": quantity + part * spread * rng.uniform(-1, 1, quantity.shape),
        "support": np.asarray(particles.support, np.float64) * (1 + part * rng.uniform(-1, 1, quantity.shape)),
        "position_rest": None,
    }
    return dataclasses.replace(scene, particles=dataclasses.replace(particles, **shaken))


def layers(image):
    return np.concatenate([np.asarray(image.color, np.float64), np.asarray(image.transmittance, np.float64)[..., None]], -1)


def error_and_allowance(image, scene, camera, settings, draws=6):
    """Error of every pixel, and how much the reference changes when rounding moves what it is made of."""
    truth = layers(js.reference.render(scene, camera, settings))
    part = (4 + np.log(float(camera.far) / float(camera.near)) / 2 if camera.is_perspective else 4) * EPS
    rng, change = np.random.default_rng(0), np.zeros(truth.shape[:2])
    depth = js.reference._depth
    for _ in range(draws):

        def shaken_depth(*at):
            exact = depth(*at)
            return exact + part * np.abs(exact) * rng.uniform(-1, 1, exact.shape)

        with mock.patch.object(js.reference, "_depth", shaken_depth):
            shaken = layers(js.reference.render(moved(scene, camera, rng, part), camera, settings))
        change = np.maximum(change, np.abs(shaken - truth).max(-1))
    return np.abs(layers(image) - truth).max(-1), 64 * EPS + 2 * change


def is_right(frames, extreme, seed=0):
    scene, camera = extreme.scene(frames, seed), extreme.camera(frames)
    image = js.render(scene, camera, frames.settings, plan=frames.plan())
    error, allowed = error_and_allowance(image, scene, camera, frames.settings)
    assert (error <= allowed).all(), f"{(error > allowed).sum()} pixels, worst {error.max():.3g}, allowed {allowed.max():.3g}"
    return scene, image


ALONE = {
    "ordinary": Extreme(),
    "lengths of 1e-14": Extreme(length=1e-14),
    "lengths of 1e-6": Extreme(length=1e-6),
    "lengths of 1e-2": Extreme(length=1e-2),
    "lengths of 1e8": Extreme(length=1e8),
    "lengths of 1e14": Extreme(length=1e14),
    "1e2 units from the origin": Extreme(offset=1e2),
    "1e6 units from the origin": Extreme(offset=1e6),
    "1e8 units from the origin": Extreme(offset=1e8),
    "supports 20000:1, equal volumes": Extreme(decades=4.3, volume="equal"),
    "supports 20000:1, volumes as supports": Extreme(decades=4.3, volume="cube"),
    "supports 1e9:1, equal volumes": Extreme(decades=9, volume="equal"),
    "supports 1e9:1, volumes as supports": Extreme(decades=9, volume="cube"),
    "supports of 1e-6": Extreme(support=1e-6),
    "supports of 1e-2": Extreme(support=1e-2),
    "supports of 1e3": Extreme(support=1e3),
    "far / near of 1 + 1e-3": Extreme(slab=1e-3),
    "far / near of 1e4": Extreme(nearest=1e4),
    "far / near of 1e8": Extreme(nearest=1e8),
    "no extinction": Extreme(extinction=(0,) * 5),
    "subnormal extinction": Extreme(extinction=(1e-41,) * 5),
    "extinction of 1e12": Extreme(extinction=(1e12,) * 5),
    "extinction of 0 to 1e12": Extreme(extinction=(0, 1e12, 0, 1e12, 1)),
    "quantities of 1e-33": Extreme(scale=1e-33),
    "quantities of 1e-31": Extreme(scale=1e-31),
    "quantities of 3e38": Extreme(scale=3e38),
    "negative quantities": Extreme(start=-1),
    "negative quantities of 1e30": Extreme(start=-2, scale=1e30),
    "quantities from 1e3 to 1e3 + 1": Extreme(start=1e3),
    "quantities from 1e5 to 1e5 + 1": Extreme(start=1e5),
    "quantities of +-3e38 among others": Extreme(spike=3e38),
    "coincident particles": Extreme(coincident=True),
}


UNSEEN = ("no extinction", "subnormal extinction", "supports of 1e-6", "supports of 1e-2")


@pytest.mark.parametrize("name", ALONE)
def test_an_extreme_frame_is_right(frames, name):
    """And shows something, but where there is nothing to be seen."""
    _, image = is_right(frames, ALONE[name])
    assert float(image.alpha.max()) > 0.5 or name in UNSEEN


SOME = [name for name in ALONE if "1e2 " not in name and "1e4" not in name and "1e-14" not in name and name != "ordinary"]


# quantities on a rounded control point of no extinction, beside 1e12: the rounding of the reference itself is opaque
UNDECIDED = {"extinction of 0 to 1e12", "quantities from 1e5 to 1e5 + 1"}


@pytest.mark.slow
@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@pytest.mark.parametrize("name", SOME)
def test_pairs_of_extremes_are_right_or_refused(frames, name, projection):
    """Of different inputs, each with all that come after it."""
    default, refused = Extreme(), 0
    for other in SOME[SOME.index(name) + 1 :]:
        one, two = (
            {key: value for key, value in vars(ALONE[n]).items() if value != getattr(default, key)} for n in (name, other)
        )
        if set(one) & set(two) or {name, other} == UNDECIDED:
            continue
        try:
            is_right(frames, Extreme(**one, **two, projection=projection), seed=len(other))
        except ValueError as error:
            assert any(word in str(error) for word in ("too far apart", "`values`", "must be", "finite")), f"{other}: {error}"
            refused += 1
        except AssertionError as error:
            raise AssertionError(f"{name} and {other}: {error}") from error
    assert refused < len(SOME)


@pytest.mark.slow
@pytest.mark.parametrize("kernel", ["cubic_spline", "wendland_c2"])
@pytest.mark.parametrize("name", ALONE)
def test_an_extreme_frame_is_right_with_other_kernels(frames, name, kernel):
    is_right(frames, dataclasses.replace(ALONE[name], kernel=kernel), seed=1)


@pytest.mark.parametrize(
    ("extreme", "message"),
    [
        (Extreme(length=1e-20), "lengths are too far apart"),
        (Extreme(length=1e19), "lengths are too far apart"),
        (Extreme(slab=1e-5), "lengths are too far apart"),
        (Extreme(nearest=1e30), "lengths are too far apart"),
        (Extreme(support=1e16), "lengths are too far apart"),
        (Extreme(decades=14, volume="equal"), "strengths .* are too far apart"),
    ],
)
def test_lengths_and_strengths_that_float32_cannot_hold_are_refused(frames, extreme, message):
    with pytest.raises(ValueError, match=message):
        js.render(extreme.scene(frames), extreme.camera(frames), frames.settings, plan=frames.plan())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda f: Extreme(scale=1e-36).scene(f), "`values` must reach at least"),
        (
            lambda f: js.TransferFunction.from_points(1e8 + np.linspace(0, 1, 5), np.ones((5, 3)), np.ones(5)),
            "subtract an offset",
        ),
        (lambda f: js.Particles.from_arrays(np.zeros((2, 3)), 1.0, 0.0, volume=[1.0, 1e-40]), r"volume\[1\] = 1e-40 underflows"),
    ],
)
def test_numbers_that_float32_would_lose_are_refused_where_they_are_given(frames, make, message):
    with pytest.raises(ValueError, match=message):
        make(frames)


def test_a_particle_too_small_for_a_narrow_view_is_refused_and_from_nearby_it_is_right(frames):
    """A support of 1e-6 seen from 3 units away through a telescope is less than the rounding of its depth."""
    particles = js.Particles.from_arrays(np.full((1, 3), 1 / 3), 1e-6, 0.5, capacity=frames.capacity)
    scene = js.Scene(particles=particles, transfer=Extreme().scene(frames).transfer)
    target, size = particles.exact_position()[0], {"width": frames.width, "height": frames.height}
    narrow = js.Camera.look_at(target - 3 * FORWARD, target, fov_degrees=3e-5, **size, near=2.9999, far=3.0001)
    with pytest.raises(ValueError, match="move the eye nearer instead of narrowing the view"):
        js.render(scene, narrow, frames.settings, plan=frames.plan())
    thick = js.TransferFunction.from_points(scene.transfer.values, scene.transfer.colors, scene.transfer.extinction * 1e6)
    scene = dataclasses.replace(scene, transfer=thick)
    nearby = js.Camera.look_at(target - 3e-6 * FORWARD, target, **size, near=1.9e-6, far=4.1e-6)
    image = js.render(scene, nearby, frames.settings, plan=frames.plan())
    error, allowed = error_and_allowance(image, scene, nearby, frames.settings)
    assert (error <= allowed).all() and float(image.alpha.max()) > 0.1


def test_float64_positions_far_from_the_origin_give_the_image_of_those_around_it(frames):
    """Whatever the offset, as long as float64 holds the positions."""
    near = Extreme()
    truth = layers(js.reference.render(near.scene(frames), near.camera(frames), frames.settings))
    for offset in (1e3, 1e6, 1e8):
        far = Extreme(offset=offset)
        image = js.render(far.scene(frames), far.camera(frames), frames.settings, plan=frames.plan())
        assert np.abs(layers(image) - truth).max() <= 1e-5
    assert near.scene(frames).particles.position_rest is None  # and costs nothing where it does not matter


@pytest.mark.parametrize("dtype", [np.float16, jnp.bfloat16])
def test_half_precision_is_promoted(frames, dtype):
    scene, camera = Extreme().scene(frames), Extreme().camera(frames)
    low = {
        name: np.asarray(getattr(scene.particles, name)).astype(dtype) for name in ("position", "support", "quantity", "volume")
    }
    points = [
        np.asarray(leaf).astype(dtype) for leaf in (scene.transfer.values, scene.transfer.colors, scene.transfer.extinction)
    ]
    scene = js.Scene(particles=js.Particles.from_arrays(**low), transfer=js.TransferFunction.from_points(*points))
    assert scene.particles.dtype == scene.transfer.values.dtype == jnp.float32
    eye = js.Camera.look_at(np.array([0, 1, 3]).astype(dtype), np.zeros(3, dtype), near=dtype(1), far=dtype(5)).eye
    assert eye.dtype == jnp.float32
    image = js.render(scene, camera, frames.settings, plan=frames.plan())
    error, allowed = error_and_allowance(image, scene, camera, frames.settings)
    assert (error <= allowed).all()


SPOILT = {
    "position": ("particles", np.nan, faults.BAD_PARTICLES),
    "support": ("particles", np.nan, faults.BAD_PARTICLES),
    "quantity": ("particles", np.nan, faults.BAD_PARTICLES),
    "volume": ("particles", np.nan, faults.BAD_PARTICLES),
    "values": ("transfer", np.nan, faults.BAD_TRANSFER),
    "colors": ("transfer", np.nan, faults.BAD_TRANSFER),
    "extinction": ("transfer", np.nan, faults.BAD_TRANSFER),
    "eye": ("camera", np.nan, faults.BAD_CAMERA),
    "axes": ("camera", np.nan, faults.BAD_CAMERA),
    "half_height": ("camera", np.nan, faults.BAD_CAMERA),
    "near": ("camera", np.nan, faults.BAD_CAMERA),
    "far": ("camera", np.nan, faults.BAD_CAMERA),
}


@pytest.fixture(scope="module")
def jitted(frames):
    return jax.jit(lambda scene, camera: js.render(scene, camera, frames.settings, plan=frames.plan()))


def test_nan_under_jit_is_a_fault_and_no_image_of_nan(frames, jitted):
    for field, (part, value, bit) in SPOILT.items():
        scene, camera = Extreme().scene(frames), Extreme().camera(frames)
        owner = camera if part == "camera" else getattr(scene, part)
        whole = getattr(owner, field)
        owner = dataclasses.replace(owner, **{field: whole.at[(0,) * whole.ndim].set(value)})
        scene, camera = (scene, owner) if part == "camera" else (dataclasses.replace(scene, **{part: owner}), camera)
        image = jitted(scene, camera)
        assert int(image.faults) & bit, field
        assert np.isfinite(image.color).all() and np.isfinite(image.transmittance).all(), field


def test_what_cannot_be_held_apart_is_a_fault_under_jit(frames, jitted):
    scene, camera = Extreme().scene(frames), Extreme().camera(frames)
    assert int(jitted(scene, camera).faults) == 0
    assert int(jitted(scene, dataclasses.replace(camera, far=camera.near * np.float32(1.00001))).faults) & faults.UNRESOLVED
    tiny = dataclasses.replace(scene.transfer, values=scene.transfer.values * np.float32(1e-37))
    assert int(jitted(dataclasses.replace(scene, transfer=tiny), camera).faults) & faults.BAD_TRANSFER
    for change in ({"volume": np.float32(1e-37)}, {"support": np.float32(1e-12)}):
        field, value = next(iter(change.items()))
        weak = dataclasses.replace(scene.particles, **{field: getattr(scene.particles, field).at[0].set(value)})
        assert int(jitted(dataclasses.replace(scene, particles=weak), camera).faults) & faults.WEAK_PARTICLES


def test_the_same_input_gives_the_same_bits_eager_and_jitted(frames, jitted):
    scene, camera = Extreme(decades=4).scene(frames), Extreme().camera(frames)
    for render in (jitted, lambda *frame: js.render(*frame, frames.settings, plan=frames.plan())):
        first, second = render(scene, camera), render(scene, camera)
        assert all(np.array_equal(getattr(first, name), getattr(second, name)) for name in ("color", "transmittance", "depth"))


def test_the_order_of_particles_changes_a_pixel_by_rounding_alone(frames):
    scene, camera = Extreme(decades=4).scene(frames), Extreme().camera(frames)
    image = js.render(scene, camera, frames.settings, plan=frames.plan())
    for seed in range(4):
        order = np.random.default_rng(seed).permutation(frames.capacity)
        shuffled = dataclasses.replace(scene, particles=jax.tree.map(lambda leaf: leaf[order], scene.particles))  # noqa: B023
        other = js.render(shuffled, camera, frames.settings, plan=frames.plan())
        assert np.abs(layers(other) - layers(image)).max() <= 4 * EPS


@pytest.mark.parametrize("length", [1e-6, 1.0, 1e8])
def test_a_constant_quantity_gives_the_bits_of_a_constant_transfer_function(frames, length):
    """At a control point: nothing of the CSPH quotient is left, whatever the supports."""
    extreme = Extreme(length=length, decades=4.3, volume="equal")
    scene, camera = extreme.scene(frames), extreme.camera(frames)
    transfer = scene.transfer
    for i in (0, 2, 4):
        quantity = jnp.full_like(scene.particles.quantity, transfer.values[i])
        constant = dataclasses.replace(scene, particles=dataclasses.replace(scene.particles, quantity=quantity))
        flat = dataclasses.replace(
            transfer,
            colors=jnp.broadcast_to(transfer.colors[i], (5, 3)),
            extinction=jnp.broadcast_to(transfer.extinction[i], (5,)),
        )
        image, same = (
            js.render(s, camera, frames.settings, plan=frames.plan())
            for s in (constant, dataclasses.replace(scene, transfer=flat))
        )
        assert np.array_equal(image.color, same.color) and np.array_equal(image.transmittance, same.transmittance)
        alpha, color = 1 - np.asarray(image.transmittance, np.float64), np.asarray(transfer.colors[i], np.float64)
        assert np.abs(np.asarray(image.color, np.float64) - alpha[..., None] * color).max() <= 2 * EPS


def test_a_uniform_medium_obeys_beer_lambert(frames):
    """One support far larger than the view; and many of equal quantity that fill it. Optical depths from 1e-3 to 1e3."""
    rng = np.random.default_rng(0)
    one = js.Particles.from_arrays(np.zeros((1, 3)), 1e4, 0.5, capacity=frames.capacity)
    many = js.Particles.from_arrays(rng.uniform(-1, 1, (frames.capacity, 3)), rng.uniform(9, 20, frames.capacity), 0.5)
    for particles, depth in itertools.product((one, many), 10 ** rng.uniform(-3, 3, 12)):
        near, length = rng.uniform(0.1, 2), rng.uniform(0.1, 5)
        transfer = js.TransferFunction.from_points(np.linspace(0, 1, 5), np.ones((5, 3)), np.full(5, depth / length))
        size = {"width": frames.width, "height": frames.height, "view_height": 2.5, "near": near, "far": near + length}
        camera = js.Camera.orthographic((0, 0, 3), (0, 0, 0), **size)
        image = js.render(js.Scene(particles=particles, transfer=transfer), camera, frames.settings, plan=frames.plan())
        exact = np.exp(-float(transfer.extinction[0]) * (float(camera.far) - float(camera.near)))
        assert np.abs(np.asarray(image.transmittance, np.float64) - exact).max() <= 4 * EPS
        assert np.abs(np.asarray(image.color, np.float64) - (1 - exact)).max() <= 4 * EPS


def test_a_particle_split_in_two_of_half_the_volume_changes_rounding_alone(frames):
    scene, camera = Extreme(decades=4).scene(frames), Extreme().camera(frames)
    parts = {name: np.asarray(getattr(scene.particles, name))[:12] for name in ("position", "support", "quantity", "volume")}
    whole = js.Particles.from_arrays(**parts, capacity=frames.capacity)
    halves = js.Particles.from_arrays(
        **{name: np.repeat(value, 2, 0) for name, value in parts.items()} | {"volume": parts["volume"].repeat(2) / 2}
    )
    one, two = (
        layers(js.render(dataclasses.replace(scene, particles=particles), camera, frames.settings, plan=frames.plan()))
        for particles in (whole, halves)
    )
    assert np.abs(one - two).max() <= 4 * EPS


def test_the_outermost_shell_of_a_support_is_seen(frames):
    """Weights there are the cube of the distance to the edge: samples in the outer thousandth count as much as any."""
    unit = js.TransferFunction.from_points(np.linspace(0, 1, 5), np.ones((5, 3)), np.full(5, 1e5))
    for support, strength in itertools.product((1e-3, 1.0, 1e3), (1.0, 1e-9, 1e-25)):
        # the other one is not on any ray, and makes the first one weak
        position = np.array([[0, 0, 0], [0.8, 0.8, 0]]) * support
        volume = [strength, 1e-3]
        particles = js.Particles.from_arrays(position, [support, 0.1 * support], 0.5, volume, capacity=frames.capacity)
        near, deep = (2 + 1e-5) * support, 1e-3 * support
        size = {"width": frames.width, "height": frames.height, "view_height": deep, "near": near, "far": near + deep}
        camera = js.Camera.orthographic((0, 0, 3 * support), (0, 0, 0), **size)
        transfer = dataclasses.replace(unit, extinction=unit.extinction / np.float32(support))
        scene = js.Scene(particles=particles, transfer=transfer)
        image = js.render(scene, camera, frames.settings, plan=frames.plan())
        assert float(image.alpha.min()) > 0.999
        error, allowed = error_and_allowance(image, scene, camera, frames.settings)
        assert (error <= allowed).all()


def test_any_tolerance_is_kept(frames):
    scene, camera, full = Extreme().scene(frames), Extreme().camera(frames), frames.settings
    reference = layers(js.render(scene, camera, full, plan=frames.plan()))
    for tolerance in (0.0, 1e-46, 1e-12, 1.0):
        settings = js.Settings(samples=frames.samples, tolerance=tolerance)
        plan = dataclasses.replace(frames.plan(), control=control_plan(settings, 1))
        image = js.render(scene, camera, settings, plan=plan)
        assert np.abs(layers(image) - reference).max() <= tolerance
        assert float(image.error_bound.max()) <= tolerance


@pytest.mark.parametrize(("width", "height", "samples"), [(1, 1, 1), pytest.param(8191, 3, 2, marks=pytest.mark.slow)])
def test_images_of_one_pixel_and_of_8191_columns(frames, width, height, samples):
    """And of one sample, which lies in the very middle of all particles."""
    scene, settings = Extreme(coincident=True).scene(frames), js.Settings(samples=samples)
    size = {"width": width, "height": height, "view_height": 2.0 * height / width, "near": 1.3, "far": 4.7}
    camera = js.Camera.orthographic(-3 * FORWARD, (0, 0, 0), **size)
    image = js.render(scene, camera, settings)
    assert image.shape == (height, width)
    error, allowed = error_and_allowance(image, scene, camera, settings)
    assert (error <= allowed).all() and float(image.alpha.max()) > 0.1


@pytest.mark.slow
def test_a_million_particles_in_one_cell(frames):
    """Sums of a million terms, added one after the other, round to 3e-4 here; 1e4 terms to 1e-7."""
    rng = np.random.default_rng(0)
    count = 1_000_000
    position = rng.normal(size=(count, 3)) * 1e-3
    particles = js.Particles.from_arrays(position, 1.0, rng.uniform(0, 1, count))
    transfer = js.TransferFunction.from_points(np.linspace(0, 1, 5), rng.uniform(0, 1, (5, 3)), rng.uniform(0, 4, 5))
    scene, settings = js.Scene(particles=particles, transfer=transfer), js.Settings(samples=8)
    camera = js.Camera.look_at((0, 0, 3), (0, 0, 0), fov_degrees=5, width=3, height=3, near=2.5, far=3.5)
    image = js.render(scene, camera, settings)
    truth = layers(js.reference.render(scene, camera, settings))
    assert np.abs(layers(image) - truth).max() <= 1e-3
