"""What a verb is asked for: that its arguments are what they are called.

Flow: scene, camera, settings -> [asked] -> render, plan.
"""

from __future__ import annotations

from typing import Any

import jax

from jaxsph.model.camera.camera import Camera
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics.trees import fitting


def as_asked(scene: Any, camera: Any, settings: Any) -> tuple[Scene, Camera]:
    """The scene and the camera that `render` and `plan` are given, with leaves that fit.

    Raises:
        ValueError: one of another kind, a leaf that does not fit, numbers of settings that are none, or arrays that are sharded.
        NotImplementedError: within `jax.shard_map` that checks which values vary over its mesh.
    """
    scene, camera = fitting("scene", scene, Scene), fitting("camera", camera, Camera)
    fitting("settings", settings, Settings).require_numbers()
    for path, leaf in jax.tree_util.tree_leaves_with_path(scene):
        if isinstance(leaf, jax.Array):
            _require_whole(path, leaf)
    _require_unvarying(scene, camera, settings)
    return scene, camera


def _require_whole(path: Any, leaf: Any) -> None:
    """Raise where an array is sharded; of a trace over automatic axes, where XLA chooses, when it is compiled."""

    def refuse(place: jax.sharding.Sharding) -> None:
        if not place.is_fully_replicated:
            raise ValueError(
                f"`scene{jax.tree_util.keystr(path)}` is sharded over {place.num_devices} devices, and each needs all of it: put "
                "the scene on one device, or replicate it, and share out the work by `devices=`"
            )

    if not isinstance(leaf, jax.core.Tracer):
        return refuse(leaf.sharding)
    refuse(place := jax.typeof(leaf).sharding)
    while hasattr(leaf, "primal"):
        leaf = leaf.primal
    if jax.sharding.AxisType.Auto in place.mesh.axis_types and not hasattr(leaf, "batch_dim"):  # whose shards may be whole
        jax.debug.inspect_array_sharding(leaf, callback=refuse)


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
