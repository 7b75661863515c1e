"""What a verb is asked for: that its arguments are what they are called.

Flow: scene, camera, settings -> [asked] -> render, plan.
"""

from __future__ import annotations

from typing import Any

import jax

from jaxsph.model.camera.camera import Camera
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings


def require_asked(scene: Any, camera: Any, settings: Any) -> None:
    """Check the arguments of `render` and `plan`.

    Raises:
        ValueError: one of another kind, numbers of settings that are none, or arrays of the scene that are sharded.
        NotImplementedError: within `jax.shard_map` that checks which values vary over its mesh.
    """
    for name, value, kind in (("scene", scene, Scene), ("camera", camera, Camera), ("settings", settings, Settings)):
        if not isinstance(value, kind):
            raise ValueError(f"`{name}` must be a `jaxsph.{kind.__name__}`, got {type(value).__name__}")
    settings.require_numbers()
    for path, leaf in jax.tree_util.tree_leaves_with_path(scene):
        if isinstance(leaf, jax.Array) and not isinstance(leaf, jax.core.Tracer) and not leaf.sharding.is_fully_replicated:
            raise ValueError(
                f"`scene{jax.tree_util.keystr(path)}` is sharded over {len(leaf.sharding.device_set)} devices, and each needs "
                "all of it: put the scene on one device, or replicate it, and share out the work by `devices=`"
            )
    _require_unvarying(scene, camera, settings)


def _require_unvarying(*given: Any) -> None:
    """Raise where a value is known to vary over a mesh: loops begin with constants, which JAX refuses to mix with it."""
    traced = [jax.typeof(leaf) for leaf in jax.tree.leaves(given) if isinstance(leaf, jax.core.Tracer)]
    kinds = [getattr(kind, "manual_axis_type", None) for kind in traced]
    over = sorted({axis for kind in kinds if kind is not None for axis in kind.varying})
    if over:
        raise NotImplementedError(
            f"an image within `jax.shard_map` cannot be checked for what varies over its axes {', '.join(map(repr, over))}: "
            "give `jax.shard_map(..., check_vma=False)`"
        )
