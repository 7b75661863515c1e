"""The Python that makes a view again.

Flow: state, source -> [code] -> text for people to paste.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from jaxsph.model.camera.camera import Camera
from jaxsph.model.clips.clips import Clip
from jaxsph.model.settings import Settings
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.viewer import cut
from jaxsph.viewer.pose import Pose


@dataclasses.dataclass(frozen=True)
class Source:
    """Where a scene comes from.

    Attributes:
        python: lines that make `scene`; where they are not known, a line that says so.
        whole: whether look and camera are to be said, too, as those lines do not make them.
    """

    python: str = "# scene: as it was given to js.view"
    whole: bool = False


def python_of(
    source: Source, camera: Camera, pose: Pose | None, edited: TransferFunction | None, settings: Settings, within: Clip | None
) -> str:
    """Python that makes the picture again; `pose` is None where the camera is as it was given, `within` is what is shown."""
    lines = ["import dataclasses", "import jaxsph as js", "", source.python]
    if within is not None:
        lines.append(f"scene = dataclasses.replace(scene, within={cut.python_of(within)})")
    if pose is not None:
        lines.append(_camera(camera, pose))
    if edited is not None:
        given = {name: getattr(edited, name) for name in ("values", "colors", "extinction", "extinction_values")}
        named = [f"    {name}={_listed(value)}," for name, value in given.items() if value is not None]
        lines += ["transfer = js.TransferFunction.from_points(", *named, ")"]
        lines.append("scene = dataclasses.replace(scene, transfer=transfer)")
    lines += [f"image = js.render(scene, camera, js.{settings!r})", 'image.save("view.png")']
    return "\n".join(lines)


def _camera(camera: Camera, pose: Pose) -> str:
    eye, target, up = (_listed(vector) for vector in (pose.eye, pose.target, pose.axes[1]))
    size = f"width={camera.width}, height={camera.height}"
    if camera.near is not None and camera.far is not None:
        size += f", near={float(camera.near)!r}, far={float(camera.far)!r}"
    if pose.perspective:
        fov = f"fov_degrees={2 * np.degrees(np.arctan(pose.tangent)).item()!r}"
        return f"camera = js.Camera.look_at({eye}, {target}, {up}, {fov}, {size})"
    return f"camera = js.Camera.orthographic({eye}, {target}, {up}, view_height={pose.height!r}, {size})"


def _listed(values: Any) -> str:
    return str(np.asarray(values, np.float64).tolist())
