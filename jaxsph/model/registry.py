"""What rooms above this one enter: integrators that are chosen by name, and methods of what is here.

Flow: settings -> [registry] -> stages; `Image.save`, `TransferFunction.figure`, ... -> [registry] -> files, figures.

Entries are `module:name`, imported when they are used. Those of this package are entered by `jaxsph.engine.cast` and
`jaxsph.plot.methods`, which `jaxsph` imports; any other package may enter its own.
"""

from __future__ import annotations

import functools
from typing import Any

from jaxsph.numerics.names import found

INTEGRATORS: dict[str, str] = {}
"""Classes, each a `jaxsph.engine.cast.integrator.Integrator`; without arguments, but for those that ask for points."""
METHODS: dict[str, str] = {}  # functions, by class and attribute: `"Image.writer"`


class Method:
    """An attribute of a class that is a function of a room above, imported when it is first used.

    It is assigned without an annotation, as dataclasses would look up what is annotated.
    """

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = f"{owner.__name__}.{name}"

    def __get__(self, one: Any, owner: type) -> Any:
        return found(METHODS[self.name])


def integrator(name: str, *arguments: Any) -> Any:
    """The integrator of that name, made with arguments if it takes any: one object a process, so that it may be static."""
    return _made(INTEGRATORS[name], *arguments)


def integrator_class(name: str) -> Any:
    """The class of the integrator of that name, which says what it needs: see `Integrator`."""
    return found(INTEGRATORS[name])


def estimates(name: str) -> bool:
    """Whether there is an integrator of that name that estimates its error, against the light integral."""
    return name in INTEGRATORS and bool(integrator_class(name).estimates)


@functools.cache
def _made(entry: str, *arguments: Any) -> Any:
    return found(entry)(*arguments)
