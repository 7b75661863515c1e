"""Promises of settings and scene: what cannot be meant is refused when made."""

import pytest

import jaxsph as js


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"samples": 0}, "`samples` must be an integer of at least 1, got 0"),
        ({"samples": 2.5}, "`samples` must be an integer"),
        ({"samples": 1 << 21}, "cannot be told apart"),
        ({"memory_limit": -1}, "`memory_limit` must be > 0 bytes, got -1"),
        ({"memory_limit": 0}, "`memory_limit` must be > 0"),
        ({"tolerance": -0.004}, "`tolerance` must be >= 0 and finite, got -0.004"),
        ({"tolerance": float("nan")}, "`tolerance` must be >= 0"),
        ({"relax": 1.5}, r"`relax` must lie in \[0, 1\], got 1.5"),
        ({"estimator": "guess"}, "`estimator` must be one of interval, pilot, got 'guess'"),
        ({"allocation": "fair"}, "`allocation` must be one of budget, greedy"),
    ],
)
def test_bad_settings_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        js.Settings(**change)


def test_settings_are_hashable_and_equal_by_value():
    assert hash(js.Settings(samples=8)) == hash(js.Settings(samples=8))
    assert js.Settings(samples=8) != js.Settings(samples=9)


def test_a_scene_of_the_wrong_parts_is_refused():
    with pytest.raises(ValueError, match=r"`particles` must be a `jaxsph\.Particles`, got str"):
        js.Scene(particles="mixer.npz", transfer=None)


@pytest.mark.parametrize("media", ["fog", ["fog"], 1.5, ("fog",), (2.0,), ({"extinction": 1.0},)])
def test_media_that_are_none_are_refused(media):
    particles = js.Particles.from_arrays([[0, 0, 0]], 1.0, 0.0)
    transfer = js.TransferFunction.from_points([0.0], [[1, 1, 1]], [1.0])
    assert js.Scene(particles, transfer).media == ()
    with pytest.raises(ValueError, match="`media` must be a tuple of media"):
        js.Scene(particles, transfer, media)
