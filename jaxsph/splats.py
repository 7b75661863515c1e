"""How wrong splats can be, pixel by pixel.

Flow: scene, camera -> [splats: render with `cast.splat_bound`] -> image of bounds.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsph.model.camera import Camera
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.plan import Plan
from jaxsph.render import render

ROUNDINGS_PER_SAMPLE, ROUNDINGS = 4, 64  # of compositing, in eps of light: of both images, and of that of bounds


def splat_bound(
    scene: Scene, camera: Camera, settings: Settings | None = None, *, plan: Plan | None = None
) -> Float[Array, "height width"]:
    """How much any channel of a pixel, or its alpha, can change if all points were spread along their chords.

    That is, between the image of this scene, and the one in which all its points have `spread="chords"` and `splats_beyond=None`,
    both with the same samples. Rendered as the image is, in one pass over the same rays; see `jaxsph.cast.splat_bound` for the
    theorem and its argument. Points apart from each other, or smaller than intervals between samples, are hardly wrong; a
    bound near 1 says that nothing is known of a pixel. In float32 the bound of points whose radii are a few hundred eps of
    their depth is mostly of rounding; take float64 to know how wrong they are as such.

    Args:
        scene: with points whose profiles are "gaussian" or "ball", where any of them are splats.
        camera: as for `jaxsph.render`.
        settings: `samples` and `memory_limit` are looked at.
        plan: as for `jaxsph.render`; made with `integrator="splat_bound"`.

    Returns:
        Bounds in [0, 1], rounding of all three images included; of other media, that of their thickness.

    Raises:
        ValueError: a scene that is mixed by opacity, other profiles, and what `jaxsph.render` raises.
    """
    if scene.mix != "extinction":
        raise ValueError(
            f"`mix` must be 'extinction' for splats to be bounded, got {scene.mix!r}: it shows more light than there is"
        )
    settings = settings or Settings()
    asked = dataclasses.replace(settings, integrator="splat_bound")
    found = render(scene, camera, asked, plan=plan).color[..., 0]
    rounding = (ROUNDINGS_PER_SAMPLE * settings.samples + ROUNDINGS) * jnp.finfo(found.dtype).eps
    return jnp.minimum(found * (1 + rounding) + rounding, 1)
