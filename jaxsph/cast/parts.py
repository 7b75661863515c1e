"""Parts of a band that are cast side by side.

Flow: worklist -> [parts] -> points -> image.

XLA splits every kernel among its threads, but those of a chunk of slabs are over before that pays: two threads were 1.1 to 1.3
times as fast as one, two programs side by side 1.9 times. So the bundles are dealt out (`access.parts`), and each part is a
run of the same program. What a bundle's rays meet does not depend on what it is marched with, so the image is the same bit for
bit.
"""

from __future__ import annotations

import dataclasses
import os
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxsph.cast.points import Rays
from jaxsph.cast.stretches import CastPlan

MOST = 4  # a tile has four bundles, so that many divide any band


def parts_at_hand(array: Array) -> int:
    """How many parts the device that holds `array` is to be given at once: a power of two, 1 but on CPUs."""
    if any(device.platform != "cpu" for device in array.devices()):
        return 1
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(MOST, 1 << (cores.bit_length() - 1))


def plan_of_part(plan: CastPlan, parts: int) -> CastPlan:
    """The plan of one part: all together they hold as much light as the plan for all does."""
    return dataclasses.replace(plan, held=max(plan.held // (parts * plan.chunk), 1) * plan.chunk)


def joined(rays: tuple[Rays, ...]) -> Rays:
    """All bundles, of those of the parts."""

    def mixed(axis: int, *values: Any) -> Array:
        shape = values[0].shape
        return jnp.stack(values, axis + 1).reshape(*shape[:axis], -1, *shape[axis + 1 :])

    axes = Rays(color=1, transmittance=0, depth=0, evaluations=0)  # type: ignore[arg-type]
    return jax.tree.map(mixed, axes, *rays)
