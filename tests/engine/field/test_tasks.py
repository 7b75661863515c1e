"""Packets read the lists of bundles, and samples are where rays and depths meet."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest

from jaxsph.engine.field.tasks import RayPackets, SlabTask

BUNDLES = 4
reading = jax.jit(RayPackets.reading)
places = jax.jit(lambda task: (task.positions(), task.path()))


@functools.partial(jax.jit, static_argnums=2)
def per_pixel(packets, per_ray, pixels):
    return packets.sum_per_pixel(packets.reading(per_ray), BUNDLES, pixels)


def packets(list_id, rows=2, columns=3):
    number = BUNDLES if list_id is None else len(list_id)
    u, v = np.zeros((columns, number), np.float32), np.zeros((rows, number), np.float32)
    return RayPackets(u, v, None if list_id is None else np.asarray(list_id))


@pytest.mark.parametrize("list_id", [None, [2, 2, 0]])
def test_packets_read_the_lists_that_they_name(list_id):
    of_bundles = np.arange(2.0 * BUNDLES).reshape(2, BUNDLES)
    wanted = of_bundles if list_id is None else of_bundles[:, list_id]
    np.testing.assert_array_equal(reading(packets(list_id), of_bundles), wanted)
    assert packets(list_id).shape == (2, 3) and packets(list_id).num_rays == 6


@pytest.mark.parametrize(("list_id", "each"), [(None, [1, 1, 1, 1]), ([2, 2, 0], [1, 0, 2, 0])])
def test_what_rays_take_is_shared_among_the_pixels_of_their_bundle(list_id, each):
    """Six rays a packet, eight pixels a bundle."""
    per_ray = np.array([1.0, 2.0, 4.0, 8.0])
    np.testing.assert_allclose(per_pixel(packets(list_id), per_ray, 8), np.array(each) * per_ray * 6 / 8)
    if list_id is None:
        np.testing.assert_array_equal(per_pixel(packets(None), per_ray, 6), per_ray)


@pytest.mark.parametrize("perspective", [True, False])
def test_samples_are_where_rays_and_depths_meet(perspective, x64):
    rng = np.random.default_rng(0)
    u, v, border = rng.normal(size=(5, 3)), rng.normal(size=(5, 2)), np.cumsum(rng.uniform(0.1, 1, (5, 5)), 1)
    depth = 0.5 * (border[:, 1:] + border[:, :-1])
    task = SlabTask(None, np.arange(5), np.arange(5), u, v, depth, border, perspective)
    assert task.shape == (5, 4, 6)
    positions, path = places(task)
    positions, path = np.stack(positions), np.broadcast_to(path, task.shape)
    for nth, sample, row, column in np.ndindex(5, 4, 2, 3):
        spread = depth[nth, sample] if perspective else 1
        wanted = u[nth, column] * spread, v[nth, row] * spread, depth[nth, sample]
        np.testing.assert_allclose(positions[:, nth, sample, 3 * row + column], wanted)
        slant = np.sqrt(1 + u[nth, column] ** 2 + v[nth, row] ** 2) if perspective else 1
        step = border[nth, sample + 1] - border[nth, sample]
        np.testing.assert_allclose(path[nth, sample, 3 * row + column], slant * step)
