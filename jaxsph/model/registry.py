"""Integrators that are chosen by name: a room above this one enters them.

Flow: settings -> [registry] -> stages.

Entries are `module:name`, imported when they are used. Those of this package are entered by `jaxsph.engine.cast`, which `jaxsph`
imports; any other package may enter its own.
"""

from __future__ import annotations

import functools
from typing import Any

from jaxsph.numerics.names import found

INTEGRATORS: dict[str, str] = {}
"""Classes, each a `jaxsph.engine.cast.integrator.Integrator`, without arguments."""


def integrator(name: str) -> Any:
    """The integrator of that name: one object a process, so that it may be static."""
    return _made(INTEGRATORS[name])


def integrator_class(name: str) -> Any:
    """The class of the integrator of that name, which says what it needs: see `Integrator`."""
    return found(INTEGRATORS[name])


def estimates(name: str) -> bool:
    """Whether there is an integrator of that name that estimates its error, against the light integral."""
    return name in INTEGRATORS and bool(integrator_class(name).estimates)


@functools.cache
def _made(entry: str) -> Any:
    return found(entry)()
