"""What can be chosen by name, and where it is found: the one file that a new integrator or screen sampler is entered in.

Flow: settings -> [registry] -> stages.

Entries are `module:name`, imported when they are used, so that this file knows no room above it.
"""

from __future__ import annotations

import functools
import importlib
from typing import Any

INTEGRATORS = {
    "samples": "jaxsph.engine.cast.samples:PointSamples",
    "segments": "jaxsph.engine.cast.segments:Segments",
    "step_doubling": "jaxsph.engine.cast.step_doubling:StepDoubling",
}
"""Classes without arguments, each a `jaxsph.engine.cast.integrator.Integrator`; but for those of `AT_POINTS`."""
AT_POINTS = {"step_doubling"}
"""Integrators that choose for themselves where they ask media: made with a tolerance and the samples of a ray."""
ESTIMATING = {"segments"}
"""Integrators that estimate their error against the light integral, and are refined for a tolerance."""
SCREENS = dict.fromkeys(("pixels", "quadtree"), "jaxsph.engine.screen.pixels:EveryPixel")
"""Classes without arguments, each a `jaxsph.engine.screen.sampler.ScreenSampler`; a quadtree chooses of every pixel's (`refinement`)."""


def integrator(name: str, *arguments: Any) -> Any:
    """The integrator of that name, made with arguments if it takes any: one object a process, so that it may be static."""
    return _made(INTEGRATORS[name], *arguments)


def between_samples(name: str) -> bool:
    """Whether the integrator of that name has media tell of what lies between samples, too."""
    module, _, kind = INTEGRATORS[name].partition(":")
    return bool(getattr(importlib.import_module(module), kind).between)


def screen(name: str) -> Any:
    """The screen sampler of that name: one object a process, so that it may be static in what is compiled."""
    return _made(SCREENS[name])


@functools.cache
def _made(entry: str, *arguments: Any) -> Any:
    module, _, name = entry.partition(":")
    return getattr(importlib.import_module(module), name)(*arguments)
