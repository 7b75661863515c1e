"""Sticky fault bits: what went wrong with data that could only be seen under jit.

A stage returns an `int32` word beside its result; words are OR-ed over stages and bands, and only the eager `render`
turns them into an exception.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

NONE = 0
TILE_OVERFLOW = 1
LIST_OVERFLOW = 2
BAD_PARTICLES = 4
BAD_CAMERA = 8
BAD_TRANSFER = 16
UNRESOLVED = 32
WEAK_PARTICLES = 64
BAD_VOLUME = 128
BAD_POINTS = 256
TOLERANCE_MISSED = 1024
GHOST_OVERFLOW = 4096
BAD_BOX = 8192
BAD_SETTINGS = 32768
CLIPPED_LOOK = 65536
BAD_SURFACE = 131072

MESSAGES = {
    TILE_OVERFLOW: "more (particle, tile) pairs than the plan has room for; make a new plan with `jaxsph.plan`",
    LIST_OVERFLOW: "more (particle, bundle) pairs than the plan has room for; make a new plan with `jaxsph.plan`",
    BAD_PARTICLES: "a particle has a position, quantity or volume that is not finite, a support that is not > 0 and finite, "
    "or a volume < 0; remove or repair these particles",
    BAD_CAMERA: "the camera is not usable: eye and axes must be finite, the field of view > 0 and 0 < near < far (perspective) "
    "or near < far (orthographic)",
    BAD_TRANSFER: "the transfer function is not usable: values, colours and extinction must be finite, and not all values so "
    "small that they are no normal numbers",
    CLIPPED_LOOK: "a transfer function or points were clipped: values must ascend, colours lie in [0, 1] and extinction be >= 0; "
    "keep them there, as by a sigmoid or a softplus",
    BAD_SETTINGS: "a traced number of the settings is out of range: `tolerance` must be >= 0 and finite, `relax` lie in [0, 1], "
    "`min_transmittance` in [0, 1/2) and below a tolerance that is not 0",
    UNRESOLVED: "lengths are too far apart for this precision: samples nearer each other than 16 eps of their depth, a particle "
    "in view that is seen more closely than the rounding of its distance from the eye allows, or lengths outside "
    "1e-15 .. 1e15 (float32); widen near and far or take fewer samples, move the eye nearer instead of narrowing the view, "
    "change the unit of length, or use float64 under jax.enable_x64",
    WEAK_PARTICLES: "the strengths volume / support^3 of the particles are too far apart for this precision, and the weakest "
    "would vanish: give each particle its own `volume` (about support^3), or use float64 under jax.enable_x64",
    BAD_VOLUME: "a volume holds values that are not finite, or its lower corner or spacing is not finite or not > 0; repair them",
    BAD_POINTS: "a point has a position, attribute or extinction that is not finite, a radius that is not > 0 and finite, an "
    "extinction < 0 or a colour outside [0, 1]; remove or repair these points",
    BAD_SURFACE: "a surface must have a level > 0 and finite, and a colour and a share of ambient light that are finite",
    GHOST_OVERFLOW: "more images of particles across the faces of their periodic box than the plan has room for; make a new "
    "plan with `jaxsph.plan`",
    BAD_BOX: "a periodic box must have sides > 0 and finite, and none shorter than the largest support radius; give a larger "
    "box, or smaller supports",
    TOLERANCE_MISSED: "the finest segments are too long for the tolerance where `error_bound` is above it; give more `samples`",
}
OVERFLOWS = TILE_OVERFLOW | LIST_OVERFLOW | GHOST_OVERFLOW
TOLD = TOLERANCE_MISSED  # the image is as good as can be: eager rendering warns
UNUSABLE = BAD_CAMERA | BAD_TRANSFER  # with these, no number of the image means anything


class CapacityError(ValueError):
    """A given plan has no room for this frame: make a new one with `jaxsph.plan`."""


def raise_for(word: int, planned: bool = False, planner: str = "plan") -> None:
    """Raise what a fault word says; `planned`: whether capacities were made for the very frame; `planner`: what makes plans.

    Raises:
        CapacityError: a given plan has no room.
        ValueError: any other fault.
    """
    if word & OVERFLOWS and not planned:
        raise CapacityError(f"`plan` is too small for this frame: {describe(word, planner)}")
    if word:
        raise ValueError(f"this frame cannot be rendered: {describe(word, planner)}")


def raised(bit: int, when: Bool[Array, "*any"]) -> Int[Array, "*any"]:
    """The fault word that holds `bit` where `when`."""
    return jnp.where(when, jnp.int32(bit), jnp.int32(NONE))


def describe(word: int, planner: str = "plan") -> str:
    """The messages of every bit set in `word`, joined."""
    return "; ".join(text.replace("jaxsph.plan`", f"jaxsph.{planner}`") for bit, text in MESSAGES.items() if int(word) & bit)
