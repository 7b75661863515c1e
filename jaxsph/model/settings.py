"""Settings: how well, and with what means, an image is to be made; and integrators by name, which a room above enters.

Entries are `module:name`, imported when they are used. Those of this package are entered by `jaxsph.engine.cast`, which `jaxsph`
imports; any other package may enter its own.
"""

from __future__ import annotations

import dataclasses
import functools
import numbers
from typing import Any

import jax
import numpy as np

from jaxsph.numerics.checks import is_traced, require_kinds
from jaxsph.numerics.names import INTEGRATORS, import_by_name
from jaxsph.numerics.trees import tree

ESTIMATORS = ("interval", "pilot")
SCREENS = ("pixels", "quadtree")
NUMBERS = "tolerance", "relax", "min_transmittance"
LEAF_PIXELS = 4, 8, 16, 32
ALLOCATIONS = ("budget", "greedy")
MAY_BE_LEFT = "estimator", "integrator"
PLAIN = str, int, float, type(None)


@tree(traced=NUMBERS, unchecked=True, kw_only=True)
class Settings:
    """Choices of the user; hashable where they fix a shape.

    `tolerance`, `relax` and `min_transmittance` are leaves, and floats.

    Changing leaves compiles nothing (but for `min_transmittance` from and to 0, which has nothing looked at).

    Attributes:
        samples: fine samples N along every ray, at least 1.
        tolerance: largest absolute error that any colour channel or alpha of any pixel may have; `None` takes all samples of each
            ray, at full rate. With `integrator="segments"`, which it means by itself, errors are measured against the light
            integral along the pixel's ray (`jaxsph.reference.integral`): they are estimated and nothing is certified; rays begin
            with a half of `samples`, and slabs are marched again with more where the estimate asks for it, up to four times
            `samples`. With `"samples"` they are measured against the reference image, which is that at full rate.
        estimator: of `integrator="samples"`, which naming it means, how errors are foreseen; `"interval"` bounds them
            (Hochstetter et al. 2016, sections 4 and 5) and is meant by `relax`, `super_pixels`, `merge` and `allocation`,
            `"pilot"` estimates them from a coarse lattice of rays, saves several times as many evaluations, and uses none of
            those. Segments use neither, nor any of those: they estimate by how samples differ from their neighbours.
        relax: share in [0, 1] of the variation between neighbouring rays that the bounds of samples leave out (section 5.1). 0
            gives a certificate; anything more an estimate. With a plan that was made with 0 images are as with 0, unless it is
            without `super_pixels`: there are no bounds of samples to relax.
        super_pixels: whether slabs of samples may be given one colour for all rays of a bundle (section 5.2).
        merge: whether coarsely sampled cells are merged along depth, so that particles are visited once (section 6.2).
        allocation: how a tolerance is shared along a ray: `"budget"` saves most, `"greedy"` goes back to front as section 4.4
            does.
        integrator: how samples along a ray become light; `None` is `"segments"` where a tolerance is to be kept along rays and no
            estimator of points is named, and else `"samples"`. Those are points, each of which stands for
            what lies around it (Hochstetter et al. 2016, section 2.2). With `"segments"` they count from border to border as far
            as supports, whose ends are found, cover that, and the transfer function is integrated over the range of the quantity
            there (Engel, Kraus & Ertl 2001).
        screen: which rays are cast; `"pixels"` gives every pixel its own, `"quadtree"` interpolates between rays where the image
            is expected to stay within the tolerance (Kratz et al. 2011, equations 7 and 8): an estimate, which rays and
            interpolation share, rays a half at most. Rays of points are at full rate, or by the pilot; with
            `integrator="segments"` those that are cast are refined, and errors are against the light integral. Without a
            tolerance all leaves are split down to pixels.
        leaf_pixels: on each side of the quadtree's first leaves, 4, 8, 16 or 32.
        min_transmittance: rays end where all of their bundle let less through than this, in [0, 1/2): what is left out of a
            pixel is at most what is let through there, and is in its `error_bound`. A tolerance is kept with it, of which it
            takes so much; with 0 no ray ends.
        memory_limit: bytes that a frame's working arrays may take; the image is rendered in bands to keep it. None is 4 GiB, or
            half of an accelerator's memory.
    """

    samples: int = 256
    tolerance: Any = None
    estimator: str | None = None
    relax: Any = 0.0
    super_pixels: bool = True
    merge: bool = True
    allocation: str = "budget"
    integrator: str | None = None
    screen: str = "pixels"
    leaf_pixels: int = 8
    min_transmittance: Any = 0.0
    memory_limit: int | float | None = None

    def __repr__(self) -> str:
        changed = ((field.name, getattr(self, field.name), field.default) for field in dataclasses.fields(self))
        told = (f"{name}={one!r}" for name, one, usual in changed if not (isinstance(one, PLAIN) and one == usual))
        return f"Settings({', '.join(told)})"

    @property
    def integrator_used(self) -> str:
        """`integrator` or, where none is named, the one that a tolerance along rays costs least with."""
        kept = self.tolerance is not None and self.screen == "pixels" and self.estimator is None
        return self.integrator or ("segments" if kept else "samples")

    @property
    def is_refined(self) -> bool:
        """Whether samples are doubled along rays where a tolerance needs it."""
        return self.tolerance is not None and estimates(self.integrator_used)

    @property
    def is_relaxed(self) -> bool:
        """Whether bounds may be relaxed: `relax` is not known to be 0."""
        return not _is_number(self.relax) or bool(self.relax != 0)

    def __post_init__(self) -> None:
        require_kinds(type(self), {name: getattr(self, name) for name in ("super_pixels", "merge", "memory_limit")})
        for name in NUMBERS:
            object.__setattr__(self, name, _number(name, getattr(self, name)))
        if self.estimator is None and (self.is_relaxed or not self.super_pixels or not self.merge or self.allocation != "budget"):
            object.__setattr__(self, "estimator", "interval")
        self._require_choices()
        self._require_ranges()

    def require_numbers(self) -> None:
        """Raise where a leaf that is known is out of range, or not a single number; what is traced is left to fault bits.

        Raises `ValueError`: naming the setting, what it is and what it may be.
        """
        for name in NUMBERS:
            value = getattr(self, name)
            if value is not None and not is_traced(value) and not _is_number(value):
                raise ValueError(f"`{name}` must be a single number, got {value!r}; to render with several, use `jax.vmap`")
        self._require_ranges()

    def _require_ranges(self) -> None:
        if _is_number(self.tolerance) and not (np.isfinite(self.tolerance) and self.tolerance >= 0):
            raise ValueError(f"`tolerance` must be >= 0 and finite, got {self.tolerance}; None renders at full rate")
        if _is_number(self.relax) and not 0 <= self.relax <= 1:
            raise ValueError(f"`relax` must lie in [0, 1], got {self.relax}; 0 keeps the certificate")
        least = self.min_transmittance
        if _is_number(least) and not 0 <= least < 0.5:
            raise ValueError(f"`min_transmittance` must lie in [0, 1/2), got {least}; 0 follows rays to their ends")
        if _is_number(least) and _is_number(self.tolerance) and 0 < self.tolerance <= least:
            raise ValueError(f"`min_transmittance` must be less than `tolerance`, of which it takes a part, got {least}")

    def _require_choices(self) -> None:
        if isinstance(self.samples, bool) or not isinstance(self.samples, int | np.integer) or self.samples < 1:
            raise ValueError(f"`samples` must be an integer of at least 1, got {self.samples!r}")
        if self.samples > 1 << 20:
            raise ValueError(f"`samples` must be at most {1 << 20}, got {self.samples}; more cannot be told apart in float32")
        named = {"estimator": ESTIMATORS, "allocation": ALLOCATIONS, "integrator": INTEGRATORS, "screen": SCREENS}
        for name, known in named.items():
            if getattr(self, name) not in tuple(known) and not (name in MAY_BE_LEFT and getattr(self, name) is None):
                raise ValueError(f"`{name}` must be one of {', '.join(known)}, got {getattr(self, name)!r}")
        if self.leaf_pixels not in LEAF_PIXELS:
            raise ValueError(f"`leaf_pixels` must be one of {', '.join(map(str, LEAF_PIXELS))}, got {self.leaf_pixels!r}")
        if self.memory_limit is not None and not self.memory_limit > 0:
            raise ValueError(f"`memory_limit` must be > 0 bytes, got {self.memory_limit}")


def integrator_of(name: str) -> Any:
    """The integrator of that name: one object a process, so that it may be static."""
    return _made(integrator_class(name))


def integrator_class(name: str) -> Any:
    """The class of the integrator of that name, which says what it needs: see `Integrator`."""
    return import_by_name(INTEGRATORS[name])


def estimates(name: str) -> bool:
    """Whether there is an integrator of that name that estimates its error, against the light integral."""
    return name in INTEGRATORS and bool(integrator_class(name).estimates)


@functools.cache
def _made(integrator: Any) -> Any:
    return integrator()


def _number(name: str, value: Any) -> Any:
    """A leaf that is known as a Python float, so that programs are the same whatever kind of number it was given as.

    What is traced stays as it is, and so do arrays of several numbers, for `jax.vmap`.
    """
    if value is None or is_traced(value) or (isinstance(value, np.ndarray | jax.Array) and value.ndim):
        return value
    if isinstance(value, bool | np.bool_) or not isinstance(value, numbers.Real | np.ndarray | jax.Array):
        raise ValueError(f"`{name}` must be a number, got {value!r} of type {type(value).__name__}")
    return float(value)


def _is_number(value: Any) -> bool:
    """Whether `value` can be looked at: a number, not a tracer nor what a transformation puts in a leaf's place."""
    return not is_traced(value) and isinstance(value, int | float | np.generic | np.ndarray | jax.Array) and np.ndim(value) == 0
