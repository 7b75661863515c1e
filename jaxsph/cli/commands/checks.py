"""The commands `explain`, `demo` and `doctor`: what a pixel is made of, how wrong a picture is, and what it is made by.

Flow: options -> Scene, Camera, pixel -> `jaxsph.explain` -> [checks] -> a table on stdout, a figure; a built-in scene -> render,
reference -> EXR, PNG, lines on stdout; installed packages, JAX -> lines on stdout.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import platform
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np

import jaxsph
from jaxsph import reference, scenes
from jaxsph.analysis.explain import explain as explained, pixel_of
from jaxsph.cli import console, figures, groups, scene as cli_scene, voice
from jaxsph.cli.console import UsageError, wrong_usage
from jaxsph.cli.groups import OWN, as_medium, offered, output, settings_of
from jaxsph.cli.table import COMMANDS
from jaxsph.cli.voice import say
from jaxsph.engine.runtime import kept
from jaxsph.io.opening import values
from jaxsph.io.opening.options import CAMERA, Look, Source, View, choice, option
from jaxsph.model.settings import Settings
from jaxsph.numerics import __version__
from jaxsph.trade.sweep import layers_of

TOLERANCE = 0.004
CHECK = 64  # rows and columns of pixels, about, that are compared with the float64 reference
NEEDED = ("jax", "jaxlib", "numpy", "scipy", "cyclopts", "OpenEXR", "pillow")
WANTED = "h5py", "matplotlib", "unyt", "tqdm", "imageio-ffmpeg", "nibabel", "pynrrd", "distributed", "xarray"
CHOSEN = f"as {kept.CHOSEN_BY_USER} names it, JAX's variables bound it"
SHELLS = ("bash", "zsh", "fish")


@offered(without="iso mix")
class Explain(groups.Options, groups.Quality, Look, View, groups.Beside, Source):
    """Options of the command."""

    pixel: Any = option(None, "R,C", values.pixel, OWN, "row and column, from 0 at the top and the left")
    output: Path | None = output("a figure too: .png, .pdf or .svg")


def explain(file: Annotated[str | None, groups.FILE] = None, /, *, asked: Explain = Explain()) -> None:
    """Say what the error bound of a pixel is made of, and what its ray meets."""
    options = dataclasses.replace(asked, source=file)
    settings = settings_of(options)
    options = as_medium(options, settings)
    cli_scene.require_something(options)
    if options.pixel is None:
        raise UsageError("--pixel R C says which pixel is to be explained: its row and its column")
    with wrong_usage():
        pixel_of(options.pixel, *options.size)
    if options.output is not None:
        figures.require_figure(options.output)
    opened = cli_scene.opened_of(options)
    if opened.scene.surface is not None:
        raise UsageError("a surface of particles has no error to explain; --surface none explains them as a medium")

    def make() -> figures.Made:
        made = explained(opened.scene, opened.camera, settings, pixel=options.pixel)
        voice.result(str(made))
        results = {one.name: getattr(made, one.name) for one in dataclasses.fields(made)} | {"off_integral": made.off_integral}
        results |= dict(zip(("unit", "length_unit"), opened.measures, strict=False))
        named = opened.labels.quantity, str(options.source or "")
        return figures.Made(made, ("figure", ""), results=results, save=lambda made, path: made.save(path, *named))

    figures.produce(options, options.output, opened, make)


@offered()
class Demo(groups.Options):
    """Options of the command."""

    output: Path = output("path without suffix (default: demo)", "STEM", Path("demo"))
    size: Any = option((512, 512), "WxH", values.size, CAMERA, "pixels (default 512x512)")


def demo(*, asked: Demo = Demo()) -> None:
    """Render a built-in scene and measure its error; write an EXR and a PNG."""
    width, height = asked.size
    outputs = [Path(f"{asked.output}{suffix}") for suffix in figures.IMAGES]
    for file in outputs:
        console.require_writable(file, "an image must be", figures.IMAGES)
    scene, camera = scenes.load("mixer", width=width, height=height)
    settings = Settings(tolerance=TOLERANCE, integrator="samples")
    exact = dataclasses.replace(settings, tolerance=None)
    every = max(min(width, height) // CHECK, 1)
    with ThreadPoolExecutor(1) as beside, console.progress("render") as show:  # NumPy has time while XLA compiles
        truth_of = beside.submit(reference.render, scene, camera, exact, every=every)
        started = time.perf_counter()
        image = jaxsph.render(scene, camera, settings, progress=show)
        elapsed = time.perf_counter() - started
    for file in outputs:
        image.save(file)
    full = jaxsph.render(scene, camera, exact)
    error = console.largest(np.abs(layers_of(image) - layers_of(full)))
    truth, some = truth_of.result(), slice(every // 2, None, every)
    rounding = console.largest(np.abs(layers_of(full)[some, some] - layers_of(truth)))
    say("scene", f"mixer, {scene.particle_set.num_particles:,} particles")
    for file in outputs:
        say("image", str(file.resolve()))
    bound = console.largest(image.error_bound)
    say("tolerance", f"{TOLERANCE:g}, certified: no pixel can be off by more than {bound:.2g}")
    say("error", f"{error:.2g}, the largest against full sampling")
    say("", f"{rounding:.2g} of full sampling against float64 brute force at {truth.shape[1]} x {truth.shape[0]} of its pixels")
    say("time", console.time_line(image.stats, elapsed))
    files = [str(file.resolve()) for file in outputs]
    voice.report(files=files, tolerance=TOLERANCE, bound=bound, error=error, rounding=rounding, seconds=elapsed)


@offered()
class Doctor(groups.Options):
    """Options of the command."""

    completion: str | None = choice(None, SHELLS, OWN, "print what completes commands")


def doctor(*, asked: Doctor = Doctor()) -> None:
    """Say versions, devices and the cache; or print a script by which a shell completes commands, options and names."""
    if asked.completion is not None:
        script = asked.app(*COMMANDS).generate_completion(shell=asked.completion)
        voice.result(script)
        voice.report(shell=asked.completion, script=script)
        return
    system = f"{platform.system()} {platform.release()}, {platform.machine()}"
    found: dict[str, str | None] = dict.fromkeys((*NEEDED, *WANTED))
    for name in found:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
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
    files = [path for path in kept.folder().glob("*") if path.is_file()]
    number = sum(path.name.endswith("-cache") for path in files)
    mine = CHOSEN if kept.is_chosen() else f"at most {2 * kept.MAX_BYTES / 1e6:.0f} MB"
    say("cache", str(kept.folder()))
    say("", f"{number} compiled programs, {sum(path.stat().st_size for path in files) / 1e6:.1f} MB; {mine}")
    voice.report(version=__version__, python=platform.python_version(), system=system, versions=found, devices=devices)
    voice.report(cache=str(kept.folder()))
