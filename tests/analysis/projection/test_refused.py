"""What cannot be projected is refused by name: arguments, particles, cameras, plans, amounts."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from extreme import spoilt

import jaxsph as js

POSITION, QUANTITY = np.split(np.random.default_rng(0).uniform(-1, 1, (40, 4)), [3], 1)
PARTICLES = js.Particles.from_arrays(POSITION, 0.3, QUANTITY[:, 0], kernel="cubic_spline")


def camera_of(width=20, near=0.5):
    return js.Camera.orthographic((1, 0.7, 2.9), (0, 0, 0), view_height=3.6, near=near, far=6.0, width=width, height=13)


CAMERA = camera_of()


@pytest.mark.parametrize("verb", [js.project, js.plan_projection])
def test_arguments_of_other_kinds_and_leaves_that_do_not_fit_are_refused_by_name(verb):
    name = "plan" if verb is js.project else "like"
    with pytest.raises(ValueError, match=rf"`{name}` must be a plan, got str; make one with `jaxsph\.plan_projection`"):
        verb(PARTICLES, CAMERA, **{name: "mine"})
    with pytest.raises(ValueError, match=r"`volume` of `particles` must have shape \([0-9]+,\), got \(3,\)"):
        verb(dataclasses.replace(PARTICLES, volume=jnp.ones(3)), CAMERA)
    with pytest.raises(ValueError, match=r"`axes` of `camera` must have shape \(3, 3\)"):
        verb(PARTICLES, dataclasses.replace(CAMERA, axes=jnp.ones((2, 3))))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"of": "mass"}, "'volume' or 'quantity'"),
        ({"of": np.ones(7)}, "one number for each particle"),
        ({"of": np.full(40, np.nan)}, "`of` must be finite"),
        ({"weight": -np.ones(40)}, "not negative"),
        ({"pixel": "corner"}, "`pixel` must be"),
        ({"pixel": "plane"}, "`pixel` must be 'mean' or 'ray', got 'plane'"),
        ({"of": np.where(np.arange(40) == 6, np.inf, 1)}, r"of\[6\] = inf"),
        ({"weight": np.where(np.arange(40) == 6, np.nan, 1)}, r"weight\[6\] = nan"),
        ({"depth_range": (3, 2)}, "two finite depths"),
        ({"tolerance": -1}, "`tolerance` must be at least 0"),
        ({"depth_range": (np.nan, 2)}, "two finite depths"),
        ({"depth_range": 3}, "`depth_range` must be two finite depths"),
        ({"depth_range": (1, 2, 3)}, "`depth_range` must be two finite depths"),
    ],
)
def test_bad_input_is_refused_by_name(given, said):
    with pytest.raises(ValueError, match=said):
        js.project(PARTICLES, CAMERA, **given)


def test_a_plan_is_of_no_other_rule_of_pixels():
    with pytest.raises(ValueError, match="`pixel` must be 'mean' or 'ray', got 'plane'"):
        js.plan_projection(PARTICLES, CAMERA, pixel="plane")


@pytest.mark.parametrize("near", [0.5, None])
@pytest.mark.parametrize(
    ("name", "value", "at"),
    [("position", np.nan, (3, 1)), ("support", np.nan, (3,)), ("support", np.inf, (3,)), ("support", 0, (3,))],
)
def test_the_first_particle_that_cannot_be_projected_is_named(name, value, at, near):
    broken = spoilt(PARTICLES, name, value, at)
    said = rf"`particles\.{name}` must be .*particles\.{name}\[{', '.join(map(str, at))}\] = {float(value)}"
    with pytest.raises(ValueError, match=said):
        js.project(broken, camera_of(near=near))


def test_depths_of_a_camera_in_the_wrong_order_and_scenes_without_particles_are_refused():
    camera = dataclasses.replace(CAMERA, near=np.float32(6), far=np.float32(1))
    with pytest.raises(ValueError, match=r"`camera` must have near < far, both finite, got near = 6\.0 and far = 1\.0"):
        js.project(PARTICLES, camera)
    for verb in (js.project, js.plan_projection):
        with pytest.raises(ValueError, match="this scene has none"):
            verb(js.Scene(), CAMERA)


@pytest.mark.parametrize(("along", "weight", "said"), [
    ("mean", None, "'mean' without"), ("max", "volume", "'max' with"), ("least", None, "one of sum, mean, dispersion, max"),
])  # fmt: skip
def test_what_is_made_of_a_ray_agrees_with_the_weight(along, weight, said):
    with pytest.raises(ValueError, match=said):
        js.project(PARTICLES, CAMERA, weight=weight, along=along)
    with pytest.raises(TypeError, match=r"`project` has no argument `wieght`; .*; did you mean weight\?"):
        js.project(PARTICLES, CAMERA, wieght="volume")


def test_bad_plans_are_refused():
    with pytest.raises(ValueError, match="plan_projection"):
        jax.jit(lambda particles: js.project(particles, CAMERA).values)(PARTICLES)
    with pytest.raises(ValueError, match=r"camera\.width"):
        js.project(PARTICLES, camera_of(width=21), plan=js.plan_projection(PARTICLES, CAMERA))
    with pytest.raises(ValueError, match="memory_limit"):
        js.plan_projection(PARTICLES, CAMERA, memory_limit=100)


def test_amounts_over_an_area_that_float32_cannot_hold_are_refused(tmp_path):
    particles = js.Particles.from_arrays([[0, 0, 0.0]], 1e24, 1.0, kernel="cubic_spline")
    camera = js.Camera.orthographic((0, 0, -3e24), (0, 0, 0), view_height=3e24, width=20, height=13, near=1e24, far=5e24)
    with pytest.raises(ValueError, match="underflow float32: give the amounts in another unit"):
        js.project(particles, camera, of=np.ones(1))
    mean = js.project(particles, camera, weight=np.ones(1))  # which needs no area
    assert np.nanmax(mean.values) == 1 and mean.weight.dtype == np.float64 and 0 < mean.weight.max() < 1e-47
    for of, weight, how in (
        (1e300, None, "values .* overflow"),
        (1e-300, None, "values .* underflow"),
        (1e39, 1.0, "values .* over"),
    ):
        with pytest.raises(ValueError, match=f"the {how}"):  # in lengths near 1, too
            js.project(
                PARTICLES, CAMERA, *(None if one is None else np.full(PARTICLES.num_particles, one) for one in (of, weight))
            )
    with pytest.raises(ValueError, match=r"`of` makes .* and float32 ends at"):
        js.project(PARTICLES, CAMERA, 1e39 * QUANTITY[:, 0], "volume", along="dispersion")
    image = js.project(particles, camera, of=np.full(1, 1e43))
    image.save(tmp_path / "a.exr")
    found = js.io.read_projection(tmp_path / "a.exr")
    assert float(found.pixel_area) == float(image.pixel_area) > 1e45 and float(found.total()) == pytest.approx(1e43, rel=1e-4)
