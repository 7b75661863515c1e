"""What `render` and its like are asked for: a scene, a camera and settings, checked together and in a unit that floats can bear.

Flow: scene, camera, settings -> [request: Request.of] -> planning, render; Image -> [request: in_given_unit] -> Image.

A user may choose any unit of length. Where the longest length of a camera is far from 1, the frame is rendered in a unit that
differs from the given one by a power of two: a galaxy is 1e24 cm across, and in float32 the product of two such lengths is
infinite. A power of two changes no digit, so the image is the one that exact numbers would have. Frames whose lengths are
comfortable are not scaled.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxsph.engine.access.precision import longest
from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.framing import with_depths
from jaxsph.model.clips import Both, Box, Outside, Plane, Sphere
from jaxsph.model.image import Image
from jaxsph.model.particles.particles import Particles
from jaxsph.model.points import Points
from jaxsph.model.scene import Scene, widened
from jaxsph.model.settings import Settings, estimates
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.volume import Volume
from jaxsph.numerics.checks import is_traced, product
from jaxsph.numerics.trees import fitting, unchecked_of

FIRST, DOUBLINGS = 2, 3  # segments begin with 1 / FIRST of `samples`, doubled at most DOUBLINGS times: 1/2 to 4 of `samples`
COMFORTABLE = 0.75
"""Share of log2 of the longest length that a dtype can render; a frame is scaled if its camera has a length beyond that."""
PLACED = {"position": 1, "position_rest": 1}
PART = 0  # no power of length: the field is a part with lengths of its own
LENGTHS: dict[type, dict[str, int]] = {
    Scene: dict.fromkeys(("particles", "transfer", "media", "volume", "volume_transfer", "points", "within", "surface"), PART),
    Particles: PLACED | {"support": 1, "box": PART},
    Points: PLACED | {"radius": 1, "splats_beyond": 1, "extinction": -1},
    TransferFunction: {"extinction": -1},
    Volume: {"lower": 1, "spacing": 1, "lower_rest": 1},
    Plane: {"point": 1, "rest": 1},
    Box: {"lower": 1, "upper": 1, "rest": 1},
    Sphere: {"center": 1, "radius": 1, "rest": 1},
    Outside: {"clip": PART},
    Both: {"first": PART, "second": PART},
    Camera: {"eye": 1, "eye_rest": 1, "near": 1, "far": 1},
}
"""For each class in a scene, and for cameras: the fields that hold lengths, and to which power; or `PART`.

Volumes of particles are not here, as only their ratios matter. The `half_height` of a camera is a length only if its rays are
parallel; `scaled` sees to that.
"""


def as_asked(scene: Any, camera: Any, settings: Any) -> tuple[Scene, Camera]:
    """Check the arguments of `render` and `plan`; return the scene and the camera with arrays of the annotated dtypes and shapes.

    Raises:
        ValueError: an argument of another class, a leaf of another shape, settings that are not numbers or out of range, or
            arrays that are sharded.
        NotImplementedError: within `jax.shard_map` that checks which values vary over its mesh.
    """
    scene, camera = fitting("scene", scene, Scene), fitting("camera", camera, Camera)
    fitting("settings", settings, Settings).require_numbers()
    for path, leaf in jax.tree_util.tree_leaves_with_path(scene):
        if isinstance(leaf, jax.Array):
            _require_whole(path, leaf)
    traced = [jax.typeof(leaf) for leaf in jax.tree.leaves((scene, camera, settings)) if isinstance(leaf, jax.core.Tracer)]
    kinds = [getattr(kind, "manual_axis_type", None) for kind in traced]
    over = sorted({axis for kind in kinds if kind is not None for axis in kind.varying})
    if over:  # loops begin with constants, which JAX refuses to mix with what varies
        raise NotImplementedError(
            f"an image within `jax.shard_map` cannot be checked for what varies over its axes {', '.join(map(repr, over))}: "
            "give `jax.shard_map(..., check_vma=False)`"
        )
    return scene, camera


def as_drawn(scene: Any, camera: Any, settings: Any) -> tuple[Scene, Camera]:
    """Check as `as_asked`, then prepare for the stages: supports as wide as smoothing makes them, and a camera with depths."""
    scene, camera = as_asked(scene, camera, settings)
    scene = widened(scene)
    return scene, with_depths(camera, scene)


def _require_whole(path: Any, leaf: Any) -> None:
    """Raise where an array is sharded. A tracer over automatic axes is checked when XLA, which shards those, compiles."""

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


class Request(NamedTuple):
    """A scene, a camera and settings that were checked together.

    Attributes:
        scene: with its lengths in a unit that floats can bear.
        camera: in the same unit, with near and far.
        settings: as they were given.
        along: what the march along each ray has to keep: the same settings, but without a tolerance if only the screen (the
            quadtree, between rays) can keep it. Plans are made for these.
        digits: scene and camera have lengths times `2 ** digits`, see `digits_to_scale`; 0 where they were not scaled.
        given: the camera in the unit that it was given in, which the metadata of the image tell of.
    """

    scene: Scene
    camera: Camera
    settings: Settings
    along: Settings
    digits: int = 0
    given: Camera | None = None

    @classmethod
    def of(cls, scene: Scene, camera: Camera, settings: Settings) -> Request:
        """Check and scale what `render` is given.

        Tracers stay in their unit, as the lengths are not known.

        Raises:
            ValueError: as `as_asked`; and for combinations of scene and settings that cannot be rendered, see `along_rays`.
        """
        scene, camera = as_drawn(scene, camera, settings)
        digits = 0 if is_traced(scene, camera, settings) else digits_to_scale(scene, camera)
        scene = scaled(scene, digits)
        return cls(scene, scaled(camera, digits), settings, along_rays(scene, settings), digits, camera)

    def in_given_unit(self, image: Image) -> Image:
        """The same image with depths, and the camera of its metadata, in the unit of length that the user gave."""
        if self.digits == 0:
            return image
        camera = self.given or self.camera
        metadata = tuple((name, camera.describe() if name == "jaxsph.camera" else value) for name, value in image.metadata)
        return dataclasses.replace(image, depth=times(image.depth, -self.digits), metadata=metadata)


def first_samples(settings: Settings) -> int:
    """Fine samples of a ray before any are doubled for a tolerance; without one, `settings.samples`."""
    return -(-settings.samples // FIRST) if settings.is_refined else settings.samples


def along_rays(scene: Scene, settings: Settings) -> Settings:
    """The settings that a march along rays keeps: without a tolerance if only the screen can keep it; see `Request.along`.

    Raises:
        ValueError: a scene lacks a part, or nothing can keep the tolerance for what it shows.
    """
    scene.check()
    used = settings.integrator_used
    if settings.tolerance is None:
        return settings
    not_covered = {
        f"`integrator={used!r}`": used != "samples" and not estimates(used),
        "`Scene(media=...)`": bool(scene.media),
        "`Scene(volume=...)`": scene.volume is not None,
        "`Scene(points=...)`": bool(scene.point_sets),
        "`Scene(surface=...)`": scene.surface is not None,
    }
    if settings.is_refined:
        if scene.surface is not None:
            left_out = "leave the surface out (`surface=False` of `jaxsph.io.read_scene`)"
            raise ValueError(f"`tolerance` does not cover `Scene(surface=...)` yet; give `tolerance=None`, or {left_out}")
        for points in scene.point_sets:
            if points.spread != "chords" or points.splats_beyond is not None:
                how = f"spread={points.spread!r}" if points.splats_beyond is None else "splats_beyond=..."
                remedy = "`tolerance=None`" if settings.screen == "pixels" else "`integrator='samples'`"
                raise ValueError(
                    "`tolerance` is kept against the light integral, in which points lie along their chords, got points with "
                    f"`{how}`; give {remedy}, or points with `spread='chords'` and no `splats_beyond`"
                )
        return settings
    if settings.screen == "quadtree":
        if settings.estimator is None or used != "samples":
            return dataclasses.replace(settings, tolerance=None)
        if settings.estimator == "interval":  # to bound a cell takes as long as to cast it, whatever number of its rays is cast
            raise ValueError(
                '`estimator="interval"`, which `relax`, `super_pixels`, `merge` and `allocation` mean, does not serve '
                '`screen="quadtree"`, whose rays are at full rate; leave it out, give `estimator="pilot"`, or `screen="pixels"`'
            )
    remedy = "give `tolerance=None`" if settings.screen == "pixels" else "leave `estimator` out, and rays are cast at full rate"
    for what, present in not_covered.items():
        if present:
            raise ValueError(f"`tolerance` does not cover {what} yet; {remedy}, or leave that out")
    return settings


def digits_to_scale(part: Any, camera: Camera) -> int:
    """The power of two that brings the longest length of the camera to about 1; 0 if that length is comfortable as it is.

    It is 0, too, if `part` holds anything whose lengths are not known, such as a medium of another package.
    """
    ends = [abs(float(camera.near)), abs(float(camera.far))]
    ends += [] if camera.is_perspective else [abs(float(camera.half_height))]
    length = max(ends)
    if not 0 < length < math.inf:
        return 0
    digits = math.frexp(length)[1]
    limit = COMFORTABLE * math.log2(longest(np.result_type(part.dtype, camera.dtype)))
    return -digits if abs(digits) > limit and _is_known(part) else 0


def scaled(part: Any, digits: int) -> Any:
    """A copy of a scene, of a camera or of a part of one, with lengths times `2 ** digits`."""
    if digits == 0 or part is None:
        return part
    if isinstance(part, tuple):
        return tuple(scaled(one, digits) for one in part)
    fields = {field.name: getattr(part, field.name) for field in dataclasses.fields(part)}
    powers = _lengths_of(part) or {}
    if isinstance(part, Camera) and not part.is_perspective:
        powers = powers | {"half_height": 1}
    for name, power in powers.items():
        fields[name] = scaled(fields[name], digits) if power == PART else times(fields[name], digits * power)
    return unchecked_of(type(part), **fields)


def times(value: Any, digits: int) -> Any:
    """`value` times `2 ** digits`, in two steps, as that power alone may overflow the dtype; None stays None."""
    half = digits // 2
    return value if value is None or digits == 0 else product(product(value, 2.0**half), 2.0 ** (digits - half))


def _lengths_of(part: Any) -> dict[str, int] | None:
    """Powers of length of a part's fields: from `LENGTHS`, or as a medium says by its own `LENGTHS`; None if neither has any."""
    return LENGTHS.get(type(part), getattr(part, "LENGTHS", None))


def _is_known(part: Any) -> bool:
    """Whether powers of length are known of a part, and of all parts that it has."""
    if part is None:
        return True
    if isinstance(part, tuple):
        return all(map(_is_known, part))
    known = _lengths_of(part)
    return known is not None and all(_is_known(getattr(part, name)) for name, power in known.items() if power == PART)
