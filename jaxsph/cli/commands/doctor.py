"""The command `doctor`: versions, devices and the cache, as a report of a fault should have them.

Flow: installed packages, JAX -> [doctor] -> lines on stdout.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
import platform
import sys
from typing import Annotated

from jaxsph.cli import cache as kept
from jaxsph.cli import voice
from jaxsph.cli.options import groups
from jaxsph.cli.options.table import app
from jaxsph.cli.voice import say
from jaxsph.numerics.version import __version__

NEEDED = ("jax", "jaxlib", "numpy", "scipy", "cyclopts", "OpenEXR", "pillow")
WANTED = "h5py", "matplotlib", "unyt", "tqdm", "imageio-ffmpeg", "nibabel", "pynrrd", "distributed", "xarray"
SHELLS = ("bash", "zsh", "fish")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Doctor(groups.Options):
    """Options of the command."""

    completion: Annotated[str | None, groups.choice("--completion", SHELLS, groups.OWN, "print what completes commands")] = None


def doctor(*, asked: Doctor = Doctor()) -> None:
    """Say versions, devices and the cache; or print a script by which a shell completes commands, options and names."""
    if asked.completion is not None:
        script = app().generate_completion(shell=asked.completion)  # type: ignore[arg-type]
        voice.result(script)
        voice.report(shell=asked.completion, script=script)
        return
    import jax

    system = f"{platform.system()} {platform.release()}, {platform.machine()}"
    found = {name: _version(name) for name in (*NEEDED, *WANTED)}
    devices = [f"{device.platform}:{device.id} {device.device_kind}" for device in jax.devices()]
    say("jaxsph", __version__)
    say("python", f"{platform.python_version()}, {sys.executable}")
    say("system", system)
    say("versions", ", ".join(f"{name} {found[name] or 'MISSING'}" for name in NEEDED))
    there = [f"{name} {found[name]}" for name in WANTED if found[name]]
    say("optional", ", ".join(there) or "none")
    say("absent", ", ".join(name for name in WANTED if not found[name]) or "none")
    say("devices", ", ".join(devices))
    say("float64", "on" if jax.config.read("jax_enable_x64") else "off; JAX_ENABLE_X64=1 turns it on")
    kept.say_kept()
    voice.report(version=__version__, python=platform.python_version(), system=system, versions=found, devices=devices)
    voice.report(cache=str(kept.folder()))


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
