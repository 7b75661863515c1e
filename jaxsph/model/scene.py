r"""Scene: the parts that are looked at. A part that is absent is `None` and is neither traced nor paid for.

Flow: user -> [scene] -> viewing -> access.

All parts that have centres and radii are *spheres*, in one set, such that one grid finds what a ray can meet: particles come
first, then the point sets one after the other. To the field of particles points are particles without volume, and to a point set
all else is out of its range of numbers: each medium takes from a list what is its own.

A surface is where the coverage of particles reaches a level, as fluids are drawn, or where a quantity does:
$\sum V_j W_j(x)$ of kernels of unit integral is about 1 within a fluid, and falls to 0 over a support outside of it. Where it is
a half lies the surface of the fluid, but for the curvature of thin parts.
"""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxsph.model.camera.camera import Bounded, BoundingBox
from jaxsph.model.clips import Clip, both
from jaxsph.model.medium import Medium
from jaxsph.model.particles.particles import NOTHING, Particles
from jaxsph.model.points import Points
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.volume import Volume, require_grid
from jaxsph.numerics.checks import (
    array_of,
    at_hand,
    is_traced,
    product,
    require_finite,
    require_kinds,
    require_positive,
    require_real,
    require_shape,
)
from jaxsph.numerics.trees import line_of, tree

PAIRS = (("particles", "transfer"), ("volume", "volume_transfer"))
MIXES = "extinction", "opacity"
NO_PARTS = float | tuple | list | dict | np.ndarray | jax.Array
FIELDS = ("coverage", "quantity", "extinction_quantity")  # what a surface is a level of: see `Surface.of`
NOT_ZERO = {"level": "coverage is 0 away from a fluid", "smoothing": "1 takes supports as given"}
RAYS = 1, 2, 4, 8  # across a pixel of which there are several: they divide a bundle
SHAPES = {"color": ((3,), "give red, green and blue"), "light": ((3,), "give x, y and z")}
COLOR, AMBIENT = (0.42, 0.66, 0.86), 0.3
"""Of a surface that no transfer function colours: that of water; and what it has of it where it is seen edge on."""


@tree(static=("of", "exact", "antialias"), unchecked=True)
class Surface:
    r"""The surface of a scene's particles: where a ray first crosses a level of a field of theirs; `Scene(surface=...)`.

    The field is $F(x) = \sum_j a_j V_j W(|x - x_j|, s H_j)$ with kernels of unit integral, supports H and `smoothing` s. With all
    a = 1 that is the coverage; else a is a quantity of the particles, and F what they have of it at x, which falls to 0 outside
    of them: the density of gas, say. The surface is opaque, and particles are shown by it alone: there is no fog of them. It is
    lit from the eye (Lambert): $c \, (a + (1 - a) \, |n \cdot d|)$, with d the ray's direction, a the share of ambient light and
    n along the gradient of F; or by a lamp at l, as wide as the sky: $c \, (a + (1 - a) \, (1 + n \cdot l) / 2)$. Its colour c is
    that of the scene's transfer function, at the mean of the quantity there, by what particles add to F; without one `color`.

    **What is found.** Every crossing between neighbouring samples of a ray (`Settings.samples`), to rounding; of thin parts see
    `jaxsph.engine.media.surfaces.particle_surface`, which says what is found between samples, and what is an estimate.

    **Derivatives** by positions, supports, volumes, quantities, level, smoothing and camera are those of an implicit function, of
    depth, normal and colour alike. Silhouettes have none: a ray that stops meeting the surface is not foreseen. What occlusion
    hides is held fixed, and so is which pixels have several rays.

    Nothing closes a fluid where a clip cuts it or a ray begins in it: there the first crossing is where the ray leaves it.

    Attributes:
        level: of the field, > 0. Of the coverage a half is halfway between fluid and nothing; a droplet of one particle has
            $V W(0, s H)$ at its centre, and shows at lower levels alone.
        of: the field (static): `"coverage"`; `"quantity"`, of the particles, by which the transfer function colours them as
            well; or `"extinction_quantity"`, their second, such that one is coloured by another. Neither may be negative.
        smoothing: what supports are multiplied by, > 0: 1.5 to 2 evens out bumps of single particles, and takes away droplets.
        color: red, green and blue (3,) in [0, 1], where there is no transfer function.
        exact: whether crossings are found to rounding, and looked for between samples (static); else as a draft has them, in half
            the time: where one step of Newton's leads from the straight line between two samples.
        ambient: share of the colour that the surface has where it is seen edge on, or faces away from the lamp, in [0, 1].
        light: (3,) to the lamp: rightwards, upwards and towards the eye; None is a light at the eye.
        occlusion: in [0, 1], what is taken of the light that fluid around hides, within some two supports
            (`jaxsph.engine.media.surfaces.particle_surface`); None looks at nothing around.
        antialias: N x N rays are cast through pixels at edges, of which colour and alpha are the mean: 1, 2, 4 or 8 (static).
            Depth and normal are then those of the ray at whose depth half of them have met something. Along an edge alpha is
            within about 1 / (2 N) of the share that is covered. Of `screen="quadtree"` no pixel has more than one.

    Raises:
        ValueError: a level or a smoothing that is not > 0 and finite, another field, a colour or a share outside of [0, 1], a
            light from nowhere, another number of rays.
    """

    level: Float[Array, ""] | Any = 0.5
    of: str = "coverage"
    smoothing: Float[Array, ""] | Any = 1.0
    color: Float[Array, "3"] | Any = COLOR
    ambient: Float[Array, ""] | Any = AMBIENT
    exact: bool = True
    light: Float[Array, "3"] | Any | None = None
    occlusion: Float[Array, ""] | Any | None = None
    antialias: int = 1

    def __post_init__(self) -> None:
        require_kinds(Surface, {"of": self.of, "antialias": self.antialias, "exact": self.exact})
        if self.of not in FIELDS:
            raise ValueError(f"`of` must be one of {', '.join(map(repr, FIELDS))}, got {self.of!r}")
        if self.antialias not in RAYS:
            known = ", ".join(map(str, RAYS))
            raise ValueError(f"`antialias` must be one of {known} rays across a pixel, got {self.antialias!r}")
        require_looks(**self.numbers)
        if self.light is not None and not is_traced(self.light) and not np.asarray(self.light).any():
            raise ValueError("`light` must point to where it comes from, got 0, 0, 0; None lights from the eye")
        for name, remedy in NOT_ZERO.items():
            if not is_traced(getattr(self, name)):
                require_positive(name, np.asarray(getattr(self, name), np.float64), remedy)

    @property
    def numbers(self) -> dict[str, Any]:
        """All that is not static, and given."""
        names = "level", "smoothing", "color", "ambient", "light", "occlusion"
        return {name: value for name in names if (value := getattr(self, name)) is not None}

    def check(self, particles: Particles) -> None:
        """Raise `ValueError` where particles lack the quantity that it is of, or where that is negative, or out of range."""
        values = particles.volume if self.of == "coverage" else getattr(particles, self.of)
        if values is None:
            raise ValueError(f"`surface` is of the {self.of!r} of `particles`, which have one quantity; give them a second")
        if self.of == "coverage" or is_traced(particles):
            return
        numbers, volumes = (np.asarray(column)[np.asarray(particles.valid)] for column in (values, particles.volume))
        if (numbers < 0).any():
            told = f"got {numbers.min():g}: shift it, and the level"
            raise ValueError(f"`surface` is of a quantity that may not be negative, {told}")
        with np.errstate(over="ignore", under="ignore"):
            made = numbers * volumes
        if ((made < np.finfo(made.dtype).tiny) & (numbers > 0) & (volumes > 0)).any() or not np.isfinite(made).all():
            wrong = f"`surface` is of quantity times volume, and {numbers.max():g} times {volumes.max():g} leaves the range of"
            raise ValueError(f"{wrong} {made.dtype}; give the quantity in other units")

    def makers(self, particles: Particles, smoothing: Any) -> Particles:
        """Particles whose coverage is the field: with supports that `smoothing` widens, and the quantity in their volumes."""
        support = product(particles.support, smoothing.astype(particles.support.dtype))
        volume = particles.volume if self.of == "coverage" else product(particles.volume, getattr(particles, self.of))
        return dataclasses.replace(particles, support=support, volume=volume)


def require_looks(**numbers: Any) -> None:
    """Raise `ValueError` where what makes a surface has another shape or is not finite; colours and shares lie in [0, 1]."""
    for name, value in numbers.items():
        shape, remedy = SHAPES.get(name, ((), "give one number"))
        require_shape(name, value, shape, remedy)
        if is_traced(value):
            continue
        number = np.asarray(require_real(name, value), np.float64)
        require_finite(name, number, "give a finite number")
        if name in ("color", "ambient", "occlusion") and not ((number >= 0) & (number <= 1)).all():
            raise ValueError(f"`{name}` must lie in [0, 1], got {value}")


class Formulas(NamedTuple):
    """What of a scene is compiled rather than given: the name of its smoothing kernel, and of how its parts are mixed.

    `surfaces`: whether there are any, parts of which may be missed between samples; `antialias`: as of `Surface`.
    """

    kernel: str
    mix: str
    surfaces: bool = False
    antialias: int = 1


@tree(static=("mix",), unchecked=True)
class Scene:
    """What is in a scene, and what its quantities look like.

    A part may be a word or a whole number, until it is rendered: prefixes of scenes are `in_axes`, or labels of an optimiser.

    Attributes:
        particles: the particle set.
        transfer: maps its quantity to colour and extinction; given with particles, and only then. With a surface it is that
            surface's colours, and may be left out.
        media: other media in the same rays, see `docs/extending.md`.
        volume: a quantity on a regular grid, rendered as a medium that shares the rays; or a tuple of several.
        volume_transfer: maps it to colour and extinction; given with a volume, and only then, and for several one each.
        points: a point set, or a tuple of several.
        mix: how parts that share a sample are mixed. Extinctions add up either way; "extinction" has colours weigh by extinction,
            "opacity" adds colours times opacities (Kaehler, Abel & Hege 2007, equations 1 to 4), see `Mixture`.
        surface: of the particles, which are then shown by it alone.
        within: where all of it is shown, by `jaxsph.Plane`, `Box` and `Sphere`; nothing is there elsewhere. None is everywhere.
    """

    particles: Particles | None = None
    transfer: TransferFunction | None = None
    media: tuple[Medium, ...] = ()
    volume: Volume | tuple[Volume, ...] | None = None
    volume_transfer: TransferFunction | tuple[TransferFunction, ...] | None = None
    points: Points | tuple[Points, ...] | None = None
    mix: str = "extinction"
    within: Clip | None = None
    surface: Surface | None = None

    def __post_init__(self) -> None:
        require_kinds(Scene, {"mix": self.mix})
        if self.mix not in MIXES:
            raise ValueError(f"`mix` must be one of {', '.join(map(repr, MIXES))}, got {self.mix!r}")
        kinds = {"particles": Particles, "transfer": TransferFunction, "surface": Surface}
        several = {"volume": Volume, "volume_transfer": TransferFunction, "points": Points}
        for name, kind in (kinds | several).items():
            value = getattr(self, name)
            wrong = [one for one in _all_of(value) if isinstance(one, NO_PARTS) or (isinstance(one, str) and Path(one).suffix)]
            if wrong or (isinstance(value, tuple) and name in kinds):
                given = type(wrong[0] if wrong else value).__name__
                more = ", or a tuple of them" if name in several else ""
                raise ValueError(f"`{name}` must be a `jaxsph.{kind.__name__}`{more}, got {given}")
        if isinstance(self.within, NO_PARTS):
            raise ValueError(f"`within` must be a `jaxsph.Plane`, `Box`, `Sphere` or made of these, got {self.within!r}")
        media = self.media if isinstance(self.media, tuple) else (self.media,)
        if isinstance(self.media, Medium) or any(isinstance(medium, str | NO_PARTS) for medium in media):
            raise ValueError(f"`media` must be a tuple of media (`jaxsph.model.medium.Medium`), got {self.media!r}")
        each = ((name, one) for name in ("particles", "volume", "points") for one in _all_of(getattr(self, name)))
        units = {unit: name for name, one in each if (unit := getattr(one, "length_unit", None)) is not None}
        if len(units) > 1:  # parts given as numbers are meant in that of the others
            told = " and ".join(f"`{name}` in {unit}" for unit, name in units.items())
            raise ValueError(f"all parts of a scene must have one unit of length, got {told}; convert positions to one unit")

    def __repr__(self) -> str:
        told = ((field.name, getattr(self, field.name), field.default) for field in dataclasses.fields(self))
        return line_of("Scene", *(f"{name}={value!r}" for name, value, usual in told if value is not usual))

    def check(self) -> None:
        """Raise `ValueError` where there is nothing to look at, or a part without what it looks like."""
        if self.surface is not None and self.particles is None:
            raise ValueError("`surface` is that of `particles`, got None; give both to `jaxsph.Scene`, or neither")
        for part, look in PAIRS[self.surface is not None :]:
            if (getattr(self, part) is None) != (getattr(self, look) is None):
                missing, given = (look, part) if getattr(self, look) is None else (part, look)
                raise ValueError(f"`{missing}` must be given with `{given}`, got None; give both to `jaxsph.Scene`, or neither")
        if self.surface is not None and self.particles is not None:
            self.surface.check(self.particles)
        for shown in self.looks:
            if shown.extinction_values is None and shown.extinction.shape != shown.values.shape:
                told = f"`extinction` of a `TransferFunction` must have shape {shown.values.shape}, as its `values`"
                raise ValueError(f"{told}, got {shown.extinction.shape}; or give `extinction_values`")
        for one in _all_of(self.volume):
            require_grid("`values` of `volume`", one.shape)
        volumes, looks = len(_all_of(self.volume)), len(_all_of(self.volume_transfer))
        if volumes != looks:
            raise ValueError(f"`volume_transfer` must be one for each volume, got {looks} for {volumes}")
        two_quantities = self.particles is not None and self.particles.extinction_quantity is not None
        if two_quantities and self.surface is None and self.transfer is not None and self.transfer.extinction_values is None:
            raise ValueError(
                "`particles` carry two quantities, but `transfer` looks up colour and extinction by one: give "
                "`jaxsph.TransferFunction.from_points(..., extinction_values=...)`, control points in units of the second, or "
                "`jaxsph.Particles.from_arrays` a single `quantity`"
            )
        if self.particles is None and not volumes and not self.point_sets and not self.media:
            absent = "`particles`, `volume`, `points` and `media` are all absent"
            raise ValueError(f"{absent}; give `jaxsph.Scene` something to look at")

    def check_without_surface(self, who: str) -> None:
        """`check`, for those who know particles as a medium alone; and raise `ValueError` where there is a surface."""
        self.check()
        if self.surface is not None:
            raise ValueError(f"`surface` is unknown to {who}; give `surface=None`, with a `transfer` for the particles")

    @property
    def dtype(self) -> Any:
        """float32, or float64 if any part is."""
        given = [part.dtype for part in (*_all_of(self.particles), *_all_of(self.volume), *self.point_sets, *self.media)]
        return jnp.result_type(*given) if given else jnp.dtype(jnp.float32)

    @property
    def particles_within(self) -> Clip | None:
        """Where particles are shown: of a periodic set in one period."""
        return both(None if self.particles is None else self.particles.box, self.within)

    @property
    def formulas(self) -> Formulas:
        """What programs are compiled for."""
        surfaces = self.surface is not None or any(medium.may_be_missed for medium in self.media)
        return Formulas(self.particle_set.kernel, self.mix, surfaces, 1 if self.surface is None else self.surface.antialias)

    @property
    def volumes(self) -> tuple[tuple[Volume, TransferFunction], ...]:
        """Each with what it looks like."""
        return tuple(zip(_all_of(self.volume), _all_of(self.volume_transfer), strict=True))

    @property
    def point_sets(self) -> tuple[Points, ...]:
        """All of them."""
        return _all_of(self.points)

    @property
    def looks(self) -> tuple[TransferFunction, ...]:
        """All transfer functions: that of particles, then those of volumes."""
        return (*_all_of(self.transfer), *_all_of(self.volume_transfer))

    @property
    def parts(self) -> tuple[Bounded, ...]:
        """Particles, volumes and point sets: what says how large it is, as media do not."""
        return (*_all_of(self.particles), *_all_of(self.volume), *self.point_sets)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the box around all particles, volumes and points (host side); zeros around nothing."""
        return BoundingBox.around(self.parts)

    @property
    def particle_set(self) -> Particles:
        """The particles; where there are none, a set of no particles in arrays of one entry."""
        if self.particles is not None:
            return self.particles
        entry: dict[str, Any] = {name: array_of([value], self.dtype) for name, value in NOTHING.items()}
        return Particles(**entry | {"position": array_of([[0, 0, 0]], self.dtype)}, valid=array_of([False], bool))


def spheres_of(scene: Scene) -> Particles:
    """Supports of particles, and points.

    Differentiation:
        By particles alone: where points can be met is held fixed.
    """
    points = [lax.stop_gradient(points.spheres()) for points in scene.point_sets]
    sets = points if scene.particles is None and points else [scene.particle_set, *points]
    if len(sets) == 1:
        return sets[0]
    (xp, sets), dtype = at_hand(sets), scene.dtype
    columns: dict[str, Any] = {
        name: xp.concatenate([one.columns.get(name, one.quantity).astype(dtype) for one in sets]) for name in sets[0].columns
    }
    rest = None
    if any(one.position_rest is not None for one in sets):
        rests = [xp.zeros_like(one.position) if one.position_rest is None else one.position_rest for one in sets]
        rest = xp.concatenate([one.astype(dtype) for one in rests])
    valid = xp.concatenate([one.valid for one in sets])
    made = Particles(**columns, valid=valid, kernel=scene.formulas.kernel, position_rest=rest)
    return jax.tree.map(array_of, made)  # type: ignore[no-any-return]


def widened(scene: Scene) -> Scene:
    """The scene as all stages are given it: its particles with supports that `smoothing` widens, and as the surface's field is
    made of them, with the quantity it is of in their volumes.
    """
    surface, particles = scene.surface, scene.particles
    if surface is None or particles is None:
        return scene
    given: dict[str, Any] = {name: array_of(value, scene.dtype) for name, value in surface.numbers.items()}
    packed = dataclasses.replace(surface, of="coverage", **given | {"smoothing": array_of(1, scene.dtype)})
    return dataclasses.replace(scene, particles=surface.makers(particles, given["smoothing"]), surface=packed)


def first_spheres(scene: Scene) -> tuple[int, ...]:
    """Number of the first sphere of each point set, static."""
    sizes = 0 if scene.particles is None else scene.particles.capacity, *(points.capacity for points in scene.point_sets)
    return tuple(itertools.accumulate(sizes[:-1]))


def num_spheres(scene: Scene) -> int:
    """Entries of all sets, padding included, static; at least 1."""
    return sum(one.capacity for one in ((scene.particles,) if scene.particles is not None else ()) + scene.point_sets) or 1


def _all_of(part: Any) -> tuple[Any, ...]:
    """One part or several, as a tuple."""
    if part is None:
        return ()
    return part if isinstance(part, tuple) else (part,)
