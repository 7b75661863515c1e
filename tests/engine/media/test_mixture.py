"""Media that share samples are mixed as Kaehler, Abel & Hege 2007 do, and one alone is left as it is."""

import jax
import numpy as np
import pytest

from jaxsph.engine.media.shown import Mixture, mixed_colors, mixed_extinction

colors_of = jax.jit(mixed_colors)


def test_media_that_give_different_channels_are_refused():
    one = np.ones((2, 3), np.float32)
    with pytest.raises(ValueError, match=r"`Medium.colors` must give the channels .* gave \[1, 3\]"):
        mixed_colors([[one], [one] * 3], [one, one])


def test_colours_weigh_by_extinction_and_nothing_has_no_weight():
    extinctions = [np.float32([1, 0, 0]), np.float32([3, 2, 0])]
    colors = [[np.float32([1, 1, 1])], [np.float32([0, 0.5, 0.5])]]
    np.testing.assert_array_equal(mixed_extinction(extinctions), [4, 2, 0])
    np.testing.assert_array_equal(colors_of(colors, extinctions)[0], [0.25, 0.5, 0])


def test_by_opacity_colours_add_up_times_opacities():
    extinctions, path = [np.float32([1, 0, 0]), np.float32([3, 2, 0])], np.float32([0.5, 2, 1])
    colors = [[np.float32([1, 1, 1])], [np.float32([0, 0.5, 0.5])]]
    alpha = [1 - np.exp(-extinction * path) for extinction in extinctions]
    total = 1 - (1 - alpha[0]) * (1 - alpha[1])
    emitted = total * np.asarray(colors_of(colors, extinctions, path)[0])
    np.testing.assert_allclose(emitted, alpha[0] * colors[0][0] + alpha[1] * colors[1][0], rtol=1e-6)


def test_by_opacity_a_interval_of_no_length_is_mixed_by_extinction():
    extinctions, colors = list(np.float32([[1] * 3, [3] * 3])), [[np.float32([1] * 3)], [np.float32([0.5] * 3)]]
    np.testing.assert_allclose(colors_of(colors, extinctions, np.zeros(3, np.float32))[0], [0.625] * 3)


def test_one_medium_is_itself():
    medium = object()
    assert Mixture.of((medium,)) is medium
