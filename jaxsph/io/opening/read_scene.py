"""`jaxsph.io.read_scene`: the front door in Python.

Flow: file -> [read_scene] -> Scene, Camera -> `jaxsph.render`.
"""

from __future__ import annotations

import dataclasses
import os
from typing import Any

import numpy as np

from jaxsph.io.opening.opened import load, staged
from jaxsph.io.opening.options import Look, Source, View
from jaxsph.model.camera.camera import Camera
from jaxsph.model.scene import Scene
from jaxsph.numerics.checks import array_of

GROUPS = (Source, Look, View)


def read_scene(
    path: str | os.PathLike[str],
    *,
    color_by: str | None = None,
    opacity_by: str | None = None,
    center: Any = None,
    width: Any = None,
    view: str | None = None,
    size: tuple[int, int] = (512, 512),
    **more: Any,
) -> tuple[Scene, Camera]:
    """A scene and a camera that show a file: what `jaxsph render FILE` shows with the same options, bit for bit.

    What is not said is chosen: the quantity by what the file holds, colours by the kind of quantity, the camera such that what is
    lit fills the picture, extinction such that the brightest of it is nearly opaque.

    Args:
        path: a file of particles or of a volume.
        color_by: quantity that colours are looked up by.
        opacity_by: quantity that extinction is looked up by; over more than a decade its logarithm is taken.
        center: x, y and z in the file's lengths, `"densest"` or `"mass"`.
        width: across the picture, a length of the file or with a unit, `"30 kpc"`.
        view: `"x"`, `"y"`, `"z"`, `"iso"`, `"face-on"` or `"edge-on"`.
        size: width and height of the picture in pixels.
        more: any other attribute of `jaxsph.io.opening.options.Source`, `Look` and `View`, such as `where=`, `colormap=`, `eye=`.

    Returns:
        What `jaxsph.render` takes. Of parallel rays near and far are None, and `camera.near_and_far()` are those of the picture.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: what cannot be read, or an option that does not suit the file.
        ImportError: a library that the format needs is not installed.
        TypeError: an option that there is not.
    """
    given = {"color_by": color_by, "opacity_by": opacity_by, "center": center, "width": width, "view": view, "size": size} | more
    groups: Any = [(group, [field.name for field in dataclasses.fields(group) if field.name in given]) for group in GROUPS]
    source, look, seen = (group(**{name: given.pop(name) for name in own}) for group, own in groups)
    if given:
        known = ", ".join(field.name for group in GROUPS for field in dataclasses.fields(group))
        raise TypeError(f"read_scene has no option {next(iter(given))!r}; there are {known}")
    opened = staged(load(path, source, look), look, seen, source=source)
    camera = opened.camera
    if not camera.is_perspective:
        depths = array_of(np.array(camera.near_and_far()), camera.dtype)
        camera = dataclasses.replace(camera, near=None, far=None, snug=depths)  # type: ignore[arg-type]
    return opened.scene, camera
