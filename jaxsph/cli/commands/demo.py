"""The command `demo`: a built-in scene with error control, and how wrong it is.

Flow: [demo] -> render, reference -> EXR, PNG, lines on stdout.
"""

from __future__ import annotations

import dataclasses
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any

import numpy as np

import jaxsph
from jaxsph import scenes
from jaxsph.cli import voice
from jaxsph.cli.console import IMAGES, largest, progress, require_writable, time_line
from jaxsph.cli.options import groups, values
from jaxsph.cli.options.groups import CAMERA, OUTPUT, option
from jaxsph.cli.voice import say
from jaxsph.model import Settings
from jaxsph.trade.contenders import layers_of

TOLERANCE = 0.004
CHECK = 64
"""Rows and columns of pixels, about, that are compared with the float64 reference."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Demo(groups.Options):
    """Options of the command."""

    output: Annotated[Path, option(("--output", "-o"), "STEM", Path, OUTPUT, "path without suffix (default: demo)")] = Path(
        "demo"
    )
    size: Annotated[Any, option("--size", "WxH", values.size, CAMERA, "pixels (default 512x512)")] = (512, 512)


def demo(*, asked: Demo = Demo()) -> None:
    """Render a built-in scene and measure its error; write an EXR and a PNG."""
    width, height = asked.size
    outputs = [Path(f"{asked.output}{suffix}") for suffix in IMAGES]
    for output in outputs:
        require_writable(output, "an image must be", IMAGES)
    scene, camera = scenes.load("mixer", width=width, height=height)
    settings = Settings(tolerance=TOLERANCE, integrator="samples")
    exact = dataclasses.replace(settings, tolerance=None)
    every = max(min(width, height) // CHECK, 1)
    with ThreadPoolExecutor(1) as beside, progress("render") as show:  # NumPy has time while XLA compiles
        truth_of = beside.submit(jaxsph.reference.render, scene, camera, exact, every=every)
        started = time.perf_counter()
        image = jaxsph.render(scene, camera, settings, progress=show)
        elapsed = time.perf_counter() - started
    for output in outputs:
        image.save(output)
    full = jaxsph.render(scene, camera, exact)
    error = largest(np.abs(layers_of(image) - layers_of(full)))
    truth, some = truth_of.result(), slice(every // 2, None, every)
    rounding = largest(np.abs(layers_of(full)[some, some] - layers_of(truth)))
    say("scene", f"mixer, {scene.particle_set.num_particles:,} particles")
    for output in outputs:
        say("image", str(output.resolve()))
    bound = largest(image.error_bound)
    say("tolerance", f"{TOLERANCE:g}, certified: no pixel can be off by more than {bound:.2g}")
    say("error", f"{error:.2g}, the largest against full sampling")
    say("", f"{rounding:.2g} of full sampling against float64 brute force at {truth.shape[1]} x {truth.shape[0]} of its pixels")
    say("time", time_line(image, elapsed))
    files = [str(output.resolve()) for output in outputs]
    voice.report(files=files, tolerance=TOLERANCE, bound=bound, error=error, rounding=rounding, seconds=elapsed)
