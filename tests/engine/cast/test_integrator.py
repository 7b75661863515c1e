"""Point samples as they are summed up in few passes are those of the plain rule, and that rule is the one of the papers."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY

from jaxsph.engine.cast.integrator import PointSamples, emitted, in_samples, transmitted
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.media.shown import Mixture, mixed_colors
from jaxsph.model.medium import Medium
from jaxsph.numerics.compiled import barriers

TASKS, SAMPLES, ROWS, COLUMNS = 5, 4, 3, 2


@dataclasses.dataclass(frozen=True)
class Given(Medium):
    """Optics at samples as given: red, green, blue and extinction."""

    given: jax.Array

    def occupied(self, slabs):
        raise NotImplementedError

    def extinction(self, gathered, task):
        return self.given[3], ()

    def colors(self, samples, task, channels):
        return list(self.given)[channels]


jax.tree_util.register_dataclass(Given, data_fields=["given"], meta_fields=[])


def task(rng, perspective):
    border = np.cumsum(rng.uniform(0.1, 0.4, (TASKS, SAMPLES + 1)), 1)
    sides = rng.uniform(-1, 1, (TASKS, COLUMNS)), rng.uniform(-1, 1, (TASKS, ROWS))
    depths = 0.5 * (border[:, 1:] + border[:, :-1]), border
    return SlabTask(None, np.arange(TASKS), np.arange(TASKS), *sides, *depths, perspective)


@functools.partial(jax.jit, compiler_options=QUICKLY)
def lights(several, where):
    """Colours and transmittance of rays, and the thickness of samples, in few passes and plainly; and the length of samples."""
    ways = []
    for in_few_passes in (True, False):
        with barriers(in_few_passes):
            medium = Mixture.of(several)
            found = PointSamples()(medium, medium.gather(where), where)
        ways.append((jnp.stack([*found.color, found.transmittance]), jnp.broadcast_to(found.thickness, where.shape)))
    return ways, where.path()


@pytest.mark.parametrize("perspective", [True, False])
@pytest.mark.parametrize("media", [1, 2, 3])
def test_passes_over_memory_change_no_light(media, perspective, x64):
    rng = np.random.default_rng(media)
    there = rng.uniform(size=(media, 1, TASKS, SAMPLES, 1)) < 0.7
    optics = rng.uniform(0, 2, (media, 4, TASKS, SAMPLES, ROWS * COLUMNS)) * there
    ways, path = jax.tree.map(np.asarray, lights(tuple(Given(one) for one in optics), task(rng, perspective)))
    for few, plain in zip(*ways, strict=True):
        np.testing.assert_allclose(few, plain, rtol=1e-12, atol=1e-15)
    lit, _ = ways[0]
    # each sample adds its colour times what it takes away of the light
    extinction = optics[:, 3].sum(0)
    left = np.exp(-np.cumsum(extinction * path, 1))
    taken = np.concatenate([np.ones_like(left[:, :1]), left[:, :-1]], 1) - left
    for channel in range(3):
        color = (optics[:, channel] * optics[:, 3]).sum(0) / np.where(extinction > 0, extinction, 1)
        np.testing.assert_allclose(lit[channel], (color * taken).sum(1), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(lit[3], left[:, -1], rtol=1e-12)


def test_colours_add_up_to_the_alpha_that_is_lost():
    """However thin samples are, of a colour that is one."""
    thickness = np.tile(np.float32([1e-7, 0.3, 50.0])[:, None, None], (1 << 6, 1))
    *color, left = jax.jit(lambda thickness: emitted([in_samples(jnp.ones_like(thickness))], transmitted(thickness)))(thickness)
    np.testing.assert_allclose(color[0], 1 - np.asarray(left), rtol=1e-6)


colors_of = jax.jit(mixed_colors)


def test_media_that_give_different_channels_are_refused():
    one = np.ones((2, 3), np.float32)
    with pytest.raises(ValueError, match=r"`Medium.colors` must give the channels .* gave \[1, 3\]"):
        mixed_colors([[one], [one] * 3], [one, one])


def test_by_opacity_a_interval_of_no_length_is_mixed_by_extinction():
    extinctions, colors = list(np.float32([[1] * 3, [3] * 3])), [[np.float32([1] * 3)], [np.float32([0.5] * 3)]]
    np.testing.assert_allclose(colors_of(colors, extinctions, np.zeros(3, np.float32))[0], [0.625] * 3)


def test_one_medium_is_itself():
    medium = object()
    assert Mixture.of((medium,)) is medium
