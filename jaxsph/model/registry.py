"""What can be chosen by name: integrators and screen samplers, which rooms above this one enter.

Flow: settings -> [registry] -> stages.

Entries are `module:name`, imported when they are used. Those of this package are entered by `jaxsph.engine.cast` and
`jaxsph.engine.screen`; any other package may enter its own.
"""

from __future__ import annotations

import functools
import importlib
from typing import Any

INTEGRATORS: dict[str, str] = {}
"""Classes, each a `jaxsph.engine.cast.integrator.Integrator`; without arguments, but for those that ask for points."""
SCREENS: dict[str, str] = {}  # classes without arguments, each a `jaxsph.engine.screen.sampler.ScreenSampler`


def integrator(name: str, *arguments: Any) -> Any:
    """The integrator of that name, made with arguments if it takes any: one object a process, so that it may be static."""
    return _made(INTEGRATORS[name], *arguments)


def integrator_class(name: str) -> Any:
    """The class of the integrator of that name, which says what it needs: see `Integrator`."""
    return _found(INTEGRATORS[name])


def estimates(name: str) -> bool:
    """Whether there is an integrator of that name that estimates its error, against the light integral."""
    return name in INTEGRATORS and bool(integrator_class(name).estimates)


def screen(name: str) -> Any:
    """The screen sampler of that name: one object a process, so that it may be static in what is compiled."""
    return _made(SCREENS[name])


@functools.cache
def _made(entry: str, *arguments: Any) -> Any:
    return _found(entry)(*arguments)


def _found(entry: str) -> Any:
    module, _, name = entry.partition(":")
    return getattr(importlib.import_module(module), name)
