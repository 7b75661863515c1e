"""Strategies: how samples become light, and which rays are cast, as objects that have the knobs of what reads them.

Flow: user -> [strategies] -> Settings, which spreads them over its fields.

`Settings(integrator=Samples(errors=Pilot()))` is `Settings(integrator="samples", estimator="pilot")`: the engine knows fields
alone. A strategy says all fields that it has; a field that it has no word for stays as it is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any


@dataclasses.dataclass(frozen=True, kw_only=True)
class Bounds:
    """Errors are bounded before rays are cast (Hochstetter et al. 2016, sections 4 and 5).

    Attributes:
        relax: share in [0, 1] of the variation between neighbouring rays that the bounds leave out; 0 gives a certificate.
        super_pixels: whether a cell may be given one colour for all of its rays.
        merge: whether coarsely sampled cells are merged along depth.
    """

    relax: Any = 0.0
    super_pixels: bool = True
    merge: bool = True

    def fields(self) -> dict[str, Any]:
        """Of `Settings`."""
        return {"estimator": "interval", "relax": self.relax, "super_pixels": self.super_pixels, "merge": self.merge}


@dataclasses.dataclass(frozen=True)
class Pilot:
    """Errors are estimated from a coarse lattice of rays: several times as many evaluations are saved, nothing is certified."""

    def fields(self) -> dict[str, Any]:
        """Of `Settings`."""
        return {"estimator": "pilot"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Samples:
    """Point samples, each of which stands for what lies around it (Hochstetter et al. 2016, section 2.2).

    Attributes:
        errors: how they are foreseen where there is a tolerance, `Bounds(...)` or `Pilot()`.
    """

    errors: Bounds | Pilot = Bounds()

    def __post_init__(self) -> None:
        if not isinstance(self.errors, Bounds | Pilot):
            raise ValueError(f"`errors` must be `jaxsph.Bounds(...)` or `jaxsph.Pilot()`, got {self.errors!r}")

    def fields(self) -> dict[str, Any]:
        """Of `Settings`."""
        return {"integrator": "samples", **self.errors.fields()}


@dataclasses.dataclass(frozen=True)
class Segments:
    """The transfer function is integrated between samples, where the quantity is linear; see `Settings.integrator`."""

    def fields(self) -> dict[str, Any]:
        """Of `Settings`."""
        return {"integrator": "segments"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class StepDoubling:
    """Steps are halved where two halves disagree with the whole (Kratz et al. 2011, section 6).

    Attributes:
        tolerance: what these differences may add up to along a ray, > 0; see `Settings.step_tolerance`.
    """

    tolerance: float = 1e-3

    def fields(self) -> dict[str, Any]:
        """Of `Settings`."""
        return {"integrator": "step_doubling", "step_tolerance": self.tolerance}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Quadtree:
    """Rays are cast at corners of leaves, and pixels interpolated where the tolerance allows it (Kratz et al. 2011).

    Attributes:
        leaf_pixels: on each side of the first leaves, 4, 8, 16 or 32.
    """

    leaf_pixels: int = 8

    def fields(self) -> dict[str, Any]:
        """Of `Settings`."""
        return {"screen": "quadtree", "leaf_pixels": self.leaf_pixels}


STRATEGIES: dict[str, tuple[type[Any], ...]] = {"integrator": (Samples, Segments, StepDoubling), "screen": (Quadtree,)}
"""What fields of `Settings` take, besides names."""
OTHERS = Bounds, Pilot, *STRATEGIES["integrator"], *STRATEGIES["screen"], type


def spread(given: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of settings that strategies among them say; empty where there are none.

    Raises:
        ValueError: a strategy of another field, or what it and another field say differently.
    """
    told: dict[str, Any] = {}
    for name, kinds in STRATEGIES.items():
        strategy: Any = given[name]
        if not isinstance(strategy, kinds):
            if isinstance(strategy, OTHERS):
                known = ", ".join(f"`jaxsph.{kind.__name__}(...)`" for kind in kinds)
                raise ValueError(f"`{name}` must be a name or {known}, got {strategy!r}")
            continue
        for field, value in strategy.fields().items():
            other = given[field]
            if field != name and not (alike(other, defaults[field]) or alike(other, value)):
                said = f"`{name}={type(strategy).__name__}(...)`, which says {value!r}"
                raise ValueError(f"`{field}` = {other!r} is given beside {said}; give one of them")
            told[field] = value
    return told


def alike(one: Any, other: Any) -> bool:
    """Whether two values are the same object, or plain values that are equal; what is traced is like itself alone."""
    return one is other or (isinstance(one, str | int | float) and isinstance(other, str | int | float) and one == other)
