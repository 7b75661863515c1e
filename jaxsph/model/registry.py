"""What can be chosen by name, and where it is found: the one file that a new integrator or screen sampler is entered in.

Flow: settings -> [registry] -> stages.

Entries are `module:name`, imported when they are used, so that this file knows no room above it.
"""

from __future__ import annotations

import functools
import importlib
from typing import Any

INTEGRATORS = {"samples": "jaxsph.cast.samples:PointSamples"}
"""Classes without arguments, each a `jaxsph.cast.integrator.Integrator`."""
SCREENS = {"pixels": "jaxsph.screen.pixels:EveryPixel", "quadtree": "jaxsph.screen.quadtree:Quadtree"}
"""Classes without arguments, each a `jaxsph.screen.sampler.ScreenSampler`."""


def integrator(name: str) -> Any:
    """The integrator of that name: one object a process, so that it may be static in what is compiled."""
    return _made(INTEGRATORS[name])


def screen(name: str) -> Any:
    """The screen sampler of that name: one object a process, so that it may be static in what is compiled."""
    return _made(SCREENS[name])


@functools.cache
def _made(entry: str) -> Any:
    module, _, name = entry.partition(":")
    return getattr(importlib.import_module(module), name)()
