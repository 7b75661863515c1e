"""The first stage of a frame: all that is in the scene as the camera sees it, in the units of all later stages.

Flow: scene, camera -> [viewing] -> plan, stages.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsph.access.quantities import rescaled, too_small
from jaxsph.access.resolution import too_fine
from jaxsph.access.view import Viewed, view_particles
from jaxsph.model.camera import Camera
from jaxsph.model.medium import Medium
from jaxsph.model.scene import Scene
from jaxsph.model.transfer import TransferFunction
from jaxsph.numerics import faults
from jaxsph.numerics.programs import compiled_quickly


class Seen(NamedTuple):
    """What the camera sees: particles and other media in view space, and the transfer function in the units of the particles.

    `order` is that of the particles' keys, where the host has found it.
    """

    viewed: Viewed
    transfer: TransferFunction
    media: tuple[Medium, ...]
    order: Int[Array, " particles"] | None = None


@compiled_quickly
@functools.partial(jax.jit, static_argnames=("samples", "num_classes"))
def view_scene(scene: Scene, camera: Camera, *, samples: int, num_classes: int) -> Seen:
    """All that depends on the scene and the camera alone; with the fault bits of both, whose numbers may change under jit."""
    dtype = jnp.promote_types(scene.particles.dtype, camera.dtype)
    transfer = jax.tree.map(lambda leaf: leaf.astype(dtype), scene.transfer)
    quantity, transfer = rescaled(scene.particles.quantity.astype(dtype), transfer)
    particles = dataclasses.replace(scene.particles, quantity=quantity)
    viewed = view_particles(particles, camera, half_steps(camera, dtype, samples)[1::2], num_classes)
    viewed = dataclasses.replace(viewed, faults=viewed.faults | _input_faults(scene, camera, samples))
    return Seen(viewed, transfer, tuple(medium.seen_by(camera) for medium in scene.media))


def half_steps(camera: Camera, dtype: Any, samples: int) -> Float[Array, " two_samples_and_one"]:
    """View depths s(0), s(1/2), ... s(N): fine samples sit at the odd entries, between borders at the even ones."""
    return camera.depth(jnp.arange(2 * samples + 1, dtype=dtype) / 2, samples).astype(dtype)


def _input_faults(scene: Scene, camera: Camera, samples: int) -> Int[Array, ""]:
    numbers = jnp.concatenate([camera.eye, camera.axes.ravel(), jnp.stack([camera.half_height, camera.near, camera.far])])
    usable = jnp.isfinite(numbers).all() & (camera.half_height > 0) & (camera.near < camera.far)
    if camera.is_perspective:
        usable &= camera.near > 0
    transfer = scene.transfer
    shown = (transfer.values[1:] >= transfer.values[:-1]).all() & jnp.isfinite(transfer.values).all()
    shown &= ((transfer.colors >= 0) & (transfer.colors <= 1)).all()
    shown &= ((transfer.extinction >= 0) & jnp.isfinite(transfer.extinction)).all() & ~too_small(transfer.values)
    unresolved = faults.raised(faults.UNRESOLVED, usable & too_fine(camera, samples))
    return unresolved | faults.raised(faults.BAD_CAMERA, ~usable) | faults.raised(faults.BAD_TRANSFER, ~shown)
