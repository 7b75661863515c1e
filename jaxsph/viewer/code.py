"""The Python and the command that make a view again.

Flow: state, source -> [code] -> text for people to paste.
"""

from __future__ import annotations

import dataclasses
import shlex
from typing import Any

import numpy as np

from jaxsph.model.camera.camera import Camera
from jaxsph.model.clips.clips import Clip
from jaxsph.model.particles.surface import Surface
from jaxsph.model.settings import Settings
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.viewer import cut
from jaxsph.viewer.pose import Pose

LOOK_FILE = "look.json"
REPLACED = (
    "--eye",
    "--target",
    "--up",
    "--fov",
    "--view",
    "--center",
    "--width",
    "--clip",
    "--size",
    "--port",
    "--range",
    "--preset",
)
LOOKS = ("--colormap", "--norm", "--range", "--preset", "--transfer", "--exposure", "--optical-depth")
FLAGS = ("--no-browser", "--picture-all", "--quiet", "--verbose", "-q", "-v")


@dataclasses.dataclass(frozen=True)
class Source:
    """Where a scene comes from.

    Attributes:
        python: lines that make `scene`; where they are not known, a line that says so.
        file: on the command line, FILE or scene:NAME; empty where there is none.
        words: options that it was opened with.
        whole: whether look and camera are to be said, too, as they are those of a sequence.
    """

    python: str = "# scene: as it was given to js.view"
    file: str = ""
    words: tuple[str, ...] = ()
    whole: bool = False


def python_of(
    source: Source,
    camera: Camera,
    pose: Pose | None,
    edited: TransferFunction | None,
    settings: Settings,
    within: Clip | None = None,
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


def command_of(
    source: Source,
    camera: Camera,
    pose: Pose | None,
    edited: bool,
    settings: Settings,
    surface: Surface | None = None,
    within: Clip | None = None,
) -> str:
    """The command that makes the picture again, with a pose by clips of `within`; else why there is none, as of parallel rays."""
    if not source.file:
        return "# a scene of Python's has no command"
    if pose is not None and not pose.perspective:
        return "# a parallel view that has moved or is cut has no command; use the Python"
    words = _kept(source.words, drop_look=edited, drop_view=pose is not None)
    if pose is not None:
        for name, place in (("--eye", pose.eye), ("--target", pose.target), ("--up", pose.axes[1])):
            words.append(f"{name}={','.join(f'{value:.9g}' for value in place)}")
        words.append(f"--fov={2 * np.degrees(np.arctan(pose.tangent)):.9g}")
        words += [f"--clip={clip}" for clip in cut.words_of(within)]
    words.append(f"--size={camera.width}x{camera.height}")
    if edited:
        words.append(f"--transfer={LOOK_FILE}")
    said = {word.partition("=")[0] for word in words}
    if surface is not None and "--surface" not in said:  # else a transfer function shows a medium
        words.append(f"--surface={float(surface.level):.9g}")
    if settings.tolerance is not None:
        chosen = {"--integrator": settings.integrator, "--tolerance": f"{settings.tolerance:g}"}
        words += [f"{name}={value}" for name, value in chosen.items() if name not in said]
    return shlex.join(["jaxsph", "render", source.file, *words, "-o", "view.png"])


def _kept(words: tuple[str, ...], *, drop_look: bool, drop_view: bool) -> list[str]:
    """Options, each with its value in one word, without those that the view has said anew."""
    gone = {"--port", "--size", *(LOOKS if drop_look else ()), *(REPLACED if drop_view else ())}
    kept: list[str] = []
    skip = False
    for word in words:
        name = word.partition("=")[0]
        if skip and not word.startswith("--"):
            continue
        skip = name in gone
        if not skip and word not in FLAGS:
            kept.append(word)
    return kept


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
