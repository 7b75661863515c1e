"""Options that commands share: what is shown, how, from where, how exactly, and by what.

Flow: [cli_options] -> Settings, values -> cli.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from jaxsph import scenes
from jaxsph.cli.console import UsageError, wrong_usage
from jaxsph.engine.runtime.devices import chosen_devices
from jaxsph.model import Settings, registry
from jaxsph.model.particles.kernels import KERNELS

SCENE = "scene:"
"""What the name of a built-in scene begins with."""
PLACE: dict[str, Any] = {"nargs": 3, "type": float, "metavar": ("X", "Y", "Z")}
INTEGRATORS = tuple(registry.INTEGRATORS)


def add_source(parser: argparse.ArgumentParser, *, optional: bool = False, several: bool = False, surface: bool = True) -> None:
    """Options of the file or built-in scene, and what of it is shown."""
    number: dict[str, Any] = {"nargs": ("*" if optional else "+") if several else "?"} if optional or several else {}
    what = "file of particles or of a volume, or built-in scene" + ("; --points or --volume may stand for it" if optional else "")
    parser.add_argument("source", metavar="FILE|scene:NAME", help=what, **number)
    add = parser.add_argument_group("particles of a file").add_argument
    names = "an attribute, density, speed, x, y, z, or log10:NAME of any of these"
    add("--quantity", "--color-by", metavar="NAME", help=names)
    more = "the same for opacity alone (default: log density where it spreads over a decade, else as colour)"
    add("--opacity-by", metavar="NAME", help=more)
    add("--support", type=float, metavar="H", help="support radius (default: the file's, or from neighbours)")
    add("--kernel", choices=tuple(KERNELS), help="smoothing kernel (default: that of the file or its code, else poly6)")
    add("--part-type", type=int, metavar="N", help="of a Gadget-like file (default: gas, else the first)")
    if surface:
        add = parser.add_argument_group("volume of a file").add_argument
        more = "show the surface on which its values are LEVEL (--quantity: which values)"
        add("--iso", type=float, metavar="LEVEL", help=more)
    add = parser.add_argument_group("particles of a built-in scene").add_argument
    add("--particles", type=int, metavar="N", help="how many")
    add("--frame", type=float, metavar="K", help="moment of the scene")


def add_picture(parser: argparse.ArgumentParser, *, means: bool = True) -> None:
    """Options of size, colours and camera, and of the means by which rays are cast where they are."""
    maps, depth = ", ".join(scenes.appearance.COLORMAPS), scenes.appearance.OPTICAL_DEPTH
    add = parser.add_argument_group("picture").add_argument
    add("--size", type=size, default=(512, 512), metavar="WxH", help="pixels (default 512x512)")
    if means:
        add("--samples", type=int, metavar="N", help=f"samples along a ray (default {Settings().samples})")
        integrator = Settings().integrator
        add("--integrator", choices=INTEGRATORS, help=f"how samples become light: points, segments, ... (default {integrator})")
    add("--colormap", metavar="NAME", help=f"{maps}, or any of cmap's, as cmocean:thermal (default viridis)")
    span = "values that the colours span (default: nearly all)"
    add("--range", nargs=2, type=float, metavar=("LOW", "HIGH"), help=span)
    add("--opacity", type=float, metavar="DEPTH", help=f"typical optical depth (default {depth:g})")
    add = parser.add_argument_group("camera", "default: one that frames the particles").add_argument
    add("--eye", **PLACE, help="where the eye is")
    add("--target", **PLACE, help="what it looks at (default: the middle of the particles)")
    add("--up", **PLACE, help="upward direction (default 0 1 0)")
    add("--fov", type=float, metavar="DEG", help="vertical field of view (default 45)")
    if means:
        add = parser.add_argument_group("means").add_argument
        add("--memory", type=float, metavar="GIB", help="working memory (default 4)")


def add_control(parser: argparse.ArgumentParser) -> None:
    """Options of error control."""
    add = parser.add_argument_group("error control").add_argument
    add("--tolerance", type=float, metavar="T", help="largest error of any channel of any pixel (default: none)")
    add("--estimator", choices=("interval", "pilot"), help="how the error is known")
    add("--screen", choices=("pixels", "quadtree"), help="whether pixels are interpolated where the tolerance allows it")
    add("--progressive", action="store_true", help="by a quadtree, in stages: OUT is rewritten at each")
    add("--relax", type=float, metavar="R", help="0 is certified, 1 takes neighbouring rays for alike")


def add_devices(parser: argparse.ArgumentParser) -> None:
    """The option of what one picture is shared among."""
    add = parser.add_argument_group("devices").add_argument
    add("--devices", type=_devices, metavar="all|N", help="share the picture among devices: all, or so many (default: one)")


def settings_of(options: argparse.Namespace) -> Settings:
    """Settings from the options given; what `Settings` refuses is wrong usage."""
    if options.memory is not None and not 0 < options.memory < 2**30:
        raise UsageError(f"--memory must be a positive number of GiB, got {options.memory:g}")
    names = "samples", "integrator", "tolerance", "estimator", "relax", "screen"
    given = {name: getattr(options, name, None) for name in names}
    given["memory_limit"] = None if options.memory is None else int(options.memory * 2**30)
    with wrong_usage():
        return Settings(**{name: value for name, value in given.items() if value is not None})


def devices_of(options: argparse.Namespace) -> str | int | None:
    """The devices that are asked for, if this machine has them."""
    wanted: str | int | None = options.devices
    if wanted is not None:
        if options.progressive:
            raise UsageError("--devices is not for --progressive, whose stages go by one device; leave out one of them")
        with wrong_usage("--devices: "):
            chosen_devices(wanted)
    return wanted


def require_support(options: argparse.Namespace) -> None:
    """Raise `UsageError` where a support radius is none."""
    if options.support is not None and not (np.isfinite(options.support) and options.support > 0):
        raise UsageError(f"--support must be > 0, got {options.support:g}")


def stem_of(source: str) -> str:
    """The name of a picture: that of its source, without a suffix; a number behind a point is none, as in `snap.00001`."""
    path = Path(source.removeprefix(SCENE))
    return path.name if path.suffix[1:].isdecimal() else path.stem


def replaced(options: argparse.Namespace, **values: Any) -> argparse.Namespace:
    """The options with some other values; those that were given stay as they are."""
    return argparse.Namespace(**{**vars(options), **values})


def size(text: str) -> tuple[int, int]:
    """Width and height of `640x480`; of one number, a square."""
    parts = text.lower().split("x")
    try:
        width, height = (int(part) for part in (parts if len(parts) == 2 else parts * 2))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size; write it as 640x480") from None
    if len(parts) > 2 or width < 1 or height < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size; both edges must be at least 1 pixel, as in 640x480")
    return width, height


def _devices(text: str) -> str | int:
    if text != "all" and not text.removeprefix("-").isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is neither `all` nor a number of devices")
    return text if text == "all" else int(text)
