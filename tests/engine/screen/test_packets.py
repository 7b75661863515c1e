"""From wanted pixels to packets: each is cast once, and what is room is never painted."""

from __future__ import annotations

import types

import jax
import numpy as np
import pytest
from hypothesis import example, given, strategies as st

from jaxsph.engine.access.lists import BUNDLE, ListPlan, bundle_origins
from jaxsph.engine.screen.packets import SCATTERED, SHARING, by_bundle, queued

LISTS = ListPlan(2, 2, 1, 1)
SHAPE = 29, 27  # less than the band
PACKETS = 3  # which do not divide the bundles


def corners():
    row, column = bundle_origins(LISTS, 0)
    return types.SimpleNamespace(row=row, column=column)


queues_of = jax.jit(lambda image, apart: queued(by_bundle(LISTS, image), apart), static_argnames="apart")
as_image = jax.jit(LISTS.as_image)
there_and_back = jax.jit(lambda image: LISTS.as_image(by_bundle(LISTS, image).reshape(-1, BUNDLE, BUNDLE)))


@jax.jit
def packets(queue, nth):
    """Those that are cast in the nth turn, and which pixels that are."""
    chosen = queue.turn(nth, PACKETS).chosen()
    return chosen, chosen.pixels(corners(), SHAPE)


def cast(queue):
    """How often each pixel of the image is cast, and the packets."""
    count, parts = np.zeros(SHAPE[0] * SHAPE[1] + 1, int), []
    for turn in range(-(-int(queue.number) // PACKETS)):
        chosen, pixel = packets(queue, turn)
        pixel, real = np.asarray(pixel), np.asarray(chosen.real).T
        assert (pixel[~real] == SHAPE[0] * SHAPE[1]).all(), "room is painted past the last pixel"
        np.add.at(count, pixel.ravel(), 1)
        parts += [bundle for bundle, some in zip(np.asarray(chosen.bundle), real.any(1), strict=True) if some]
    return count[:-1].reshape(SHAPE), parts


@pytest.mark.parametrize("apart", [SHARING, SCATTERED])
@given(st.integers(0, 2**32 - 1), st.lists(st.sampled_from([0, 1, 8, 9, 16, 17, 32, 33, 64]), min_size=16, max_size=16))
@example(0, [0] * 16)
@example(0, [SHARING.rays] * 16)
@example(0, [SCATTERED.rays * SCATTERED.packets] * 16)
@example(0, [BUNDLE * BUNDLE] * 16)
def test_every_wanted_pixel_is_in_exactly_one_packet(apart, seed, counts):
    """Of those bundles have so many; none is in two, scattered packets hold no other, and are as few as can be."""
    rng = np.random.default_rng(seed)
    wanted = np.stack([rng.permutation(BUNDLE * BUNDLE) < count for count in counts])
    image = np.asarray(as_image(wanted.reshape(-1, BUNDLE, BUNDLE)))[: SHAPE[0], : SHAPE[1]]
    scattered, together = queues_of(image, apart=apart)
    (few, parts), (many, wholes) = cast(scattered), cast(together)
    assert ((few + many)[image] == 1).all()
    assert (few[~image] == 0).all() and many.max(initial=0) <= 1
    number = {bundle: -(-count // apart.rays) for bundle, count in enumerate(np.asarray(scattered.wanted).sum(1))}
    assert all(parts.count(bundle) == number[bundle] <= apart.packets for bundle in parts)
    assert len(set(wholes)) == len(wholes) and not set(parts) & set(wholes)


@given(st.integers(0, 2**32 - 1))
def test_bundles_of_an_image_lie_as_they_do_in_it(seed):
    image = np.random.default_rng(seed).uniform(size=SHAPE) < 0.5
    back = np.asarray(there_and_back(image))
    np.testing.assert_array_equal(back[: SHAPE[0], : SHAPE[1]], image)
    assert not back[SHAPE[0] :].any() and not back[:, SHAPE[1] :].any()
