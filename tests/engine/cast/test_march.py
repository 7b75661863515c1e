"""How the march is cut into pieces changes no pixel."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import jaxsph as js


def test_how_many_slabs_a_batch_has_changes_no_bit(frames, quick_programs):
    rng = np.random.default_rng(3)
    scene, camera = frames.scene(rng, decades=0.5), frames.camera(rng)
    images = []
    for batch_slabs in (16, 48, 1024):
        plan = frames.plan()
        plan = dataclasses.replace(plan, cast=dataclasses.replace(plan.cast, batch_slabs=batch_slabs))
        images.append(js.render(scene, camera, frames.settings, plan=plan))
    assert np.asarray(images[0].alpha).max() > 0.1
    for image in images[1:]:
        for layer in ("color", "transmittance", "depth"):
            np.testing.assert_array_equal(getattr(image, layer), getattr(images[0], layer))


def test_a_plan_whose_pieces_do_not_fit_together_is_refused(frames):
    with pytest.raises(ValueError, match="multiple of `chunk`"):
        dataclasses.replace(frames.plan().cast, batch_slabs=50)
