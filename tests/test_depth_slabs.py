"""Promises of particles that are dealt out by depth: the image, its gradients and its error are those of one device."""

import dataclasses
import json

import numpy as np
import pytest
from forced import ran
from hypothesis import given
from hypothesis import strategies as st

import jaxsph as js
from jaxsph import depth_slabs
from jaxsph.depth_slabs import composited

SCENE = """
import dataclasses, json, sys
import jax, jax.numpy as jnp, numpy as np
import jaxsph as js

scene, camera = js.scenes.load("checker_board", 2000, width=72, height=64)
if sys.argv[2:] == ["calm"]:  # such that bounds save something
    calm = 0.4 + 0.01 * scene.particles.quantity
    scene = dataclasses.replace(scene, particles=dataclasses.replace(scene.particles, quantity=calm))
settings = js.Settings(**{"samples": 96, **json.loads(sys.argv[1])})
slabs = js.DepthSlabs.of(scene, camera, settings, 4)
plan = js.plan(scene, camera, settings)
"""
IMAGES = """
one, dealt, told = js.render(scene, camera, settings), js.render_slabs(slabs, camera, settings), {}
for layer in ("color", "transmittance", "depth"):
    pair = [np.asarray(getattr(image, layer)) for image in (one, dealt)]
    there = [np.isfinite(values) for values in pair]
    told[layer] = float(np.abs(np.where(there[0] & there[1], pair[0], 0) - np.where(there[0] & there[1], pair[1], 0)).max())
    told[layer + " there"] = bool((there[0] == there[1]).all())
full = js.render(scene, camera, dataclasses.replace(settings, tolerance=None))
off = np.abs(np.concatenate([dealt.color - full.color, (dealt.transmittance - full.transmittance)[..., None]], -1)).max(-1)
told["within"] = bool((off <= dealt.error_bound + 1e-6).all())
told["bound"] = float(dealt.error_bound.max())
told["saved"] = 1 - dealt.stats["evaluations"] / one.stats["evaluations_full"]
told["certified"] = dealt.certified
told["shown"] = float(one.alpha.mean())
held = slabs.scene.particles.position
told["held"] = [shard.data.shape[1] for shard in held.addressable_shards]
told["bytes"] = [sum(leaf.addressable_shards[0].data.nbytes for leaf in jax.tree.leaves(slabs.scene.particles)),
                 sum(leaf.nbytes for leaf in jax.tree.leaves(scene.particles))]
print(json.dumps(told))
"""
GRADIENTS = """
from jax.sharding import AxisType

weight, told = np.random.default_rng(0).uniform(size=(64, 72, 3)), {}
with jax.enable_x64(True):
    def wide(tree):
        return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), jnp.float64) if leaf.dtype == jnp.float32 else leaf, tree)

    scene, camera = wide(scene), wide(camera)
    plan = js.plan(scene, camera, settings)
    mesh = jax.make_mesh((4,), ("depth",), axis_types=(getattr(AxisType, sys.argv[2]),))
    slabs = js.DepthSlabs.of(scene, camera, settings, mesh)
    move = np.random.default_rng(1).normal(size=scene.particles.position.shape)

    def looked(render):
        def total(particles):
            return (render(particles).color * weight).sum()

        def both(particles):
            def along(step):
                return total(dataclasses.replace(particles, position=particles.position + step * move))

            return jax.grad(total, allow_int=True)(particles), jax.jvp(along, (0.0,), (1.0,))[1]

        return jax.jit(both)(scene.particles)

    one = looked(lambda particles: js.render(dataclasses.replace(scene, particles=particles), camera, settings, plan=plan))
    dealt = looked(lambda particles: js.render_slabs(slabs.with_particles(particles), camera, settings))
    for name in ("position", "support", "quantity", "volume"):
        a, b = (np.asarray(getattr(gradient, name)) for gradient in (one[0], dealt[0]))
        told[name] = float(np.abs(a - b).max() / np.abs(a).max())
    told["forward"] = float(abs(one[1] - dealt[1]) / abs(one[1]))
print(json.dumps(told))
"""
MOVED = """
def image(move):
    particles = dataclasses.replace(scene.particles, position=scene.particles.position + move)
    return js.render_slabs(slabs.with_particles(particles), camera, settings)

told = {}
try:
    image(jnp.asarray([0.0, 0.0, 0.7]))
except ValueError as error:
    told["moved"] = str(error)
told["faults"] = int(jax.jit(image)(jnp.asarray([0.0, 0.0, 0.7])).faults)
print(json.dumps(told))
"""


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["samples", "segments"])
def test_the_image_is_that_of_one_device_and_each_holds_its_part(integrator):
    told = ran(SCENE + IMAGES, json.dumps({"integrator": integrator}), quickly=False)
    assert told["color"] < 1e-6 and told["transmittance"] < 1e-6 and told["depth"] < 1e-5
    assert told["color there"] and told["depth there"] and told["shown"] > 0.1
    assert told["certified"] and told["bound"] == 0
    assert max(told["held"]) < 2000 and told["bytes"][0] < told["bytes"][1]


@pytest.mark.slow
@pytest.mark.parametrize(
    "given", [{"tolerance": 0.1}, {"tolerance": 0.1, "integrator": "segments", "samples": 128}], ids=["bounds", "segments"]
)
def test_the_tolerance_holds_for_the_whole(given):
    told = ran(SCENE + IMAGES, json.dumps(given), "calm", quickly=False)
    assert 0 < told["bound"] <= given["tolerance"]
    if "integrator" not in given:
        assert told["within"] and told["certified"] and told["saved"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["Auto", "Explicit"])
def test_gradients_are_those_of_one_device(kind):
    told = ran(SCENE + GRADIENTS, json.dumps({"integrator": "samples"}), kind)
    assert all(off < 1e-9 for off in told.values()), told


@pytest.mark.slow
def test_a_particle_that_leaves_its_halo_is_a_fault():
    told = ran(SCENE + MOVED, "{}")
    assert "DepthSlabs.of" in told["moved"]
    assert told["faults"] == js.numerics.faults.BEYOND_HALO


shown = st.floats(0, 1).map(lambda value: round(value, 3))


def parts_of(values):
    """Images of one pixel: premultiplied colour at most what is not let through, transmittance, depth, error."""
    for share, through, bound in values:
        color = np.full((1, 1, 3), share * (1 - through))
        one = np.ones((1, 1))
        yield js.Image(color, through * one, np.inf * one, bound * one, one, True, 0, {})


@given(values=st.lists(st.tuples(shown, shown, shown), min_size=3, max_size=6), cut=st.integers(1, 5))
def test_compositing_is_associative(values, cut):
    parts = tuple(parts_of(values))
    cut = min(cut, len(parts) - 1)
    once, apart = composited(parts), composited((composited(parts[:cut]), composited(parts[cut:])))
    for layer in ("color", "transmittance", "error_bound", "evaluations"):
        np.testing.assert_allclose(getattr(once, layer), getattr(apart, layer), atol=1e-5)


@given(
    values=st.lists(st.tuples(shown, shown, shown), min_size=1, max_size=5),
    wrong=st.lists(st.tuples(shown, shown), min_size=5, max_size=5),
)
def test_the_error_of_the_whole_is_at_most_what_is_said(values, wrong):
    """True depth slabs are off by at most the bound of each, whatever shines from behind."""
    found, true = list(parts_of(values)), []
    for part, (color, through) in zip(found, wrong, strict=False):
        off = float(part.error_bound[0, 0])
        t = np.clip(part.transmittance + (2 * through - 1) * off / 2, 0, 1)
        c = np.clip(part.color + (2 * color - 1) * off / 2, 0, 1 - t[..., None])
        dc, dt = np.abs(c - part.color).max(), np.abs(t - part.transmittance).max()
        found[len(true)] = dataclasses.replace(part, error_bound=np.full((1, 1), dc + dt))
        true.append(dataclasses.replace(part, color=c, transmittance=t))
    image, truth = composited(tuple(found)), composited(tuple(true))
    bound = image.error_bound[0, 0] + 1e-5
    assert np.abs(image.color - truth.color).max() <= bound
    assert np.abs(image.transmittance - truth.transmittance).max() <= bound


@pytest.mark.parametrize(
    "given",
    [
        {"tolerance": 0.1, "estimator": "pilot"},
        {"screen": "quadtree"},
        {"integrator": "step_doubling"},
    ],
    ids=["pilot", "quadtree", "step doubling"],
)
def test_what_needs_samples_of_others_is_refused_by_name(frames, given):
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match=f"`{list(given)[-1]}` must be"):
        js.DepthSlabs.of(frames.scene(rng), frames.camera(rng), js.Settings(samples=frames.samples, **given), 1)


def test_more_devices_than_cells_are_refused(frames):
    with pytest.raises(ValueError, match="at most 3, one for each 16 of 37 samples, got 4"):
        depth_slabs._require_cells(frames.settings, 4)
