"""Rays one by one meet what they do in tensor products, and their cotangents are the same."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import AGREE, QUICKLY

from jaxsph.engine.access.lists import BUNDLE
from jaxsph.engine.cast.integrator import PointSamples
from jaxsph.engine.cast.march import CastMethod, cast
from jaxsph.engine.field.gather import gather
from jaxsph.engine.field.tasks import RayPackets, SlabTask, full_rate
from jaxsph.engine.media.shown import Shown
from jaxsph.engine.runtime.tuning import CPU
from jaxsph.engine.screen.packets import SCATTERED
from jaxsph.numerics.fusion import barriers

RAYS = BUNDLE * BUNDLE


def dense(grid, camera):
    return RayPackets(*grid.rays(camera, jnp.arange(grid.row.shape[0], dtype=jnp.int32)))


def apart(grid, camera):
    """The same rays, those of a bundle in several packets; and four more packets that are room."""
    every, number = dense(grid, camera), grid.row.shape[0]
    u, v = (value.reshape(-1, number) for value in (jnp.tile(every.u[None], (BUNDLE, 1, 1)), jnp.repeat(every.v, BUNDLE, 0)))
    parts = [slice(first, first + SCATTERED) for first in range(0, RAYS, SCATTERED)]
    u, v = (jnp.concatenate([value[part] for part in parts] + [value[:SCATTERED, :4]], 1) for value in (u, v))
    bundle = jnp.concatenate([jnp.tile(jnp.arange(number, dtype=jnp.int32), len(parts)), jnp.zeros(4, jnp.int32)])
    return RayPackets(u, v, bundle, jnp.arange(u.shape[1]) < number * len(parts), scattered=True)


@functools.partial(jax.jit, static_argnames=("kernel", "scattered"))
def sums(grid, camera, reference, *, kernel, scattered):
    """Of a slab in the middle of each bundle, of four samples."""
    bundles = grid.row.shape[0]
    depth = jnp.broadcast_to(grid.half_steps[1::2][16:20], (bundles, 4))
    border = jnp.broadcast_to(grid.half_steps[::2][16:21], (bundles, 5))
    entry = jax.tree.map(lambda value: value[..., 4, :], full_rate(grid.windows, reference))
    every = jnp.arange(bundles, dtype=jnp.int32)

    def task(packets):
        where = packets.u.T, packets.v.T, depth, border
        return SlabTask(entry, 0 * every + 4, every, *where, camera.is_perspective, packets.scattered)

    packets = dense(grid, camera)
    if scattered:
        u, v = jnp.tile(packets.u, (BUNDLE, 1)), jnp.repeat(packets.v, BUNDLE, 0)
        packets = RayPackets(u, v, scattered=True)
    with barriers(CPU.fusion_barriers):
        return gather(grid.ordered, grid.lists.rank, task(packets), kernel).all


@pytest.mark.parametrize(("kernel", "projection"), [("poly6", "perspective"), ("wendland_c2", "orthographic")])
def test_sums_are_those_of_tensor_products_bit_for_bit(frames, stages, kernel, projection):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        scene, camera = frames.scene(rng, kernel), frames.camera(rng, projection)
        grid, reference = stages(scene.particles, camera, plan=frames.plan())
        products, found = (sums(grid, camera, reference, kernel=kernel, scattered=apart) for apart in (False, True))
        for one, other in zip(products, found, strict=True):
            np.testing.assert_array_equal(np.asarray(one).reshape(*one.shape[:2], -1), other[:, :, 0])
        assert np.asarray(products[0]).any()


@pytest.mark.slow
def test_light_and_cotangents_are_those_of_tensor_products(frames, stages, x64):
    """By particles, transfer function, depths and opening; room adds nothing."""
    rng = np.random.default_rng(0)
    scene, camera = frames.scene(rng, dtype=np.float64), frames.camera(rng, dtype=np.float64)
    plan = frames.plan()
    grid, reference = stages(scene.particles, camera, plan=plan)
    schedule, number = full_rate(grid.windows, reference), grid.row.shape[0]
    cotangent = rng.normal(size=(4, number, RAYS))

    def seen(packets_of, cotangent, columns, half_steps, half_height, transfer):
        looking = dataclasses.replace(camera, half_height=half_height)
        there = dataclasses.replace(grid, ordered=dataclasses.replace(grid.ordered, **columns), half_steps=half_steps)
        method = CastMethod("poly6", plan.cast, PointSamples(), packets_of)
        rays = cast(there, schedule, Shown(looking, transfer), method)
        layers = jnp.concatenate([rays.color, rays.transmittance[None]])
        if packets_of is apart:
            parts = RAYS // SCATTERED
            layers = layers[:, : parts * number, 0].reshape(4, parts, number, SCATTERED)
            layers = jnp.moveaxis(layers, 1, 2)
        layers = layers.reshape(4, number, RAYS)
        return (layers * cotangent).sum(), layers

    at = {name: getattr(grid.ordered, name) for name in ("x", "y", "z", "scale", "size", "quantity")}
    at = at, grid.half_steps, camera.half_height, scene.transfer
    found = []
    for packets_of in (dense, apart):
        of = jax.value_and_grad(functools.partial(seen, packets_of, cotangent), (0, 1, 2, 3), has_aux=True)
        found.append(jax.jit(of, compiler_options=QUICKLY)(*at))
    ((_, layers), gradient), ((_, same), of_apart) = found
    assert (np.asarray(layers[3]) < 0.9).any()
    np.testing.assert_allclose(same, layers, rtol=0, atol=AGREE)
    for one, other in zip(jax.tree.leaves(gradient), jax.tree.leaves(of_apart), strict=True):
        assert np.asarray(one).any()
        np.testing.assert_allclose(other, one, rtol=0, atol=AGREE * (1 + np.abs(one).max()))
