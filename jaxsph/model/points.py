"""Points: stars, galaxies, tracers, spray: each with a radius, a colour and an extinction of its own.

Flow: files, arrays -> [points] -> field -> cast -> image.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsph.model.particles.particles import Particles, columns_of, packed, rest_of, room_for
from jaxsph.model.profiles import Profile, profile_of
from jaxsph.numerics import short
from jaxsph.numerics.checks import array_of, at_hand, is_traced, module_for, require_finite, require_positive
from jaxsph.numerics.given import in_unit, name_of, own, plain, with_unit
from jaxsph.numerics.trees import Placed, tree

SPREADS = "chords", "centres"
MAIN = "position", "radius", "color", "extinction"


@tree(static=("spread", "length_unit"))
class Points(Placed):
    """A set of points; make it with `from_arrays`.

    At an offset d from its centre a point has the extinction `extinction * profile(|d| / radius)` a unit length, and none where
    its radius ends. Where points overlap, extinctions add up, and colours weigh by extinction. Unlike the field of `Particles`,
    nothing is normalised: more points are more light. Arrays are padded to a capacity, with the first point; values may be
    changed by `dataclasses.replace` under jit without recompiling.

    Attributes:
        position: of centres, world coordinates, length units.
        radius: > 0, length units.
        color: red, green, blue in [0, 1].
        extinction: at the centre, >= 0, a unit length.
        valid: which entries are points; the rest is padding.
        attributes: further numbers of each point by name, for a profile that reads them.
        profile: how extinction falls off, see `jaxsph.model.profiles`.
        position_rest: what rounding float64 positions has left; None where that is a negligible part of every radius.
        splats_beyond: distance from the eye (depth, if the view is orthographic) beyond which points are splats: spread as
            "centres"; None where none are.
        spread: how a point's thickness is laid along a ray. "chords": where it is, to a sample: what each sample of the ray
            stands for has the integral of extinction along it. "centres": all of it at the depth of the centre, as a splat has
            it. What a ray meets in all is the same; how it is ordered in depth is not.
        length_unit: what the unit of lengths is called, where positions were given with one (static).
    """

    PLACE, REST = "position", "position_rest"
    position: Float[Array, "points 3"]
    radius: Float[Array, " points"]
    color: Float[Array, "points 3"]
    extinction: Float[Array, " points"]
    valid: Bool[Array, " points"]
    attributes: dict[str, Float[Array, " points"]]
    profile: Profile
    position_rest: Float[Array, "points 3"] | None = None
    splats_beyond: Float[Array, ""] | None = None
    spread: str = "chords"
    length_unit: str | None = None

    def __repr__(self) -> str:
        return short.line(
            "Points",
            f"{short.count(self.valid)}, {getattr(self.position, 'dtype', 'of no type')}",
            f"radius {short.span(self.radius, self.valid)}" + ("" if self.length_unit is None else f" {self.length_unit}"),
            f"extinction {short.span(self.extinction, self.valid)}",
            None if self.spread == "chords" else f"spread at {self.spread}",
        )

    @classmethod
    def from_arrays(
        cls,
        position: Any,
        radius: Any,
        color: Any = (1.0, 1.0, 1.0),
        extinction: Any = None,
        profile: Any = "gaussian",
        *,
        opacity: Any = None,
        attributes: dict[str, Any] | None = None,
        spread: str = "chords",
        splats_beyond: Any = None,
        capacity: int | None = None,
    ) -> Points:
        """Check and pack arrays of points.

        Arrays may carry units, as those of unyt and astropy do. Lengths and extinctions are then converted to that of `position`,
        in which numbers without one are meant; attributes keep their own.

        Args:
            position: (N, 3), length units; N = 0 is an empty set.
            radius: (N,) or a number, > 0, length units.
            color: (N, 3) or (3,), in [0, 1].
            extinction: (N,) or a number, >= 0: at the centre, a unit length. Give this or `opacity`.
            profile: `"gaussian"` (exp(-4.5 q^2), q in radii, cut off at 1), `"ball"` (constant), numbers at distances evenly
                spaced from the centre to the radius, or a function of the offset and the attributes, see `profiles.Shaped`.
            opacity: (N,) or a number in [0, 1): that of a whole point along a ray through its centre.
            attributes: (N,) or a number each, by name.
            spread: "chords" or "centres", see `Points`.
            splats_beyond: distance >= 0 beyond which points are splats; None for none.
            capacity: pad to this many entries; default the class of N, so that sets of similar size share programs.

        Returns:
            Points of dtype float64 if `position` is float64 and x64 is enabled, else float32.

        Raises:
            ValueError: wrong shapes, numbers that are not finite or out of range, neither or both of extinction and opacity,
                an unknown profile or spread, capacity < N, an attribute named as what every point has, an opacity where the
                profile has none through the centre, or is not known by distance alone; masks, units of another kind.
        """
        if spread not in SPREADS:
            raise ValueError(f"`spread` must be one of {', '.join(map(repr, SPREADS))}, got {spread!r}")
        position, unit = with_unit("position", position)
        given = {"position": position, "radius": in_unit("radius", radius, unit), "color": plain("color", color)}
        columns = columns_of("point", given | _strengths(extinction, opacity, attributes or {}, unit))
        _require_usable(columns)
        dtype = jnp.promote_types(jax.dtypes.canonicalize_dtype((center := columns["position"]).dtype), jnp.float32)
        room, shape = room_for("point", center.shape[0], capacity), profile_of(profile, dtype)
        if opacity is not None:
            columns["extinction"] = _extinction(columns.pop("opacity"), columns["radius"], shape)
        rounded = {name: packed(name, value, room, dtype, float(name == "radius")) for name, value in columns.items()}
        rest = rest_of(center, rounded["position"], rounded["radius"])
        entries: dict[str, Any] = {name: array_of(value) for name, value in rounded.items()}
        main = {name: entries.pop(name) for name in MAIN}
        valid = array_of(module_for(columns).arange(room) < center.shape[0])
        beyond = _distance(in_unit("splats_beyond", splats_beyond, unit), dtype)
        more: dict[str, Any] = {"splats_beyond": beyond, "spread": spread, "length_unit": name_of(unit), "position_rest": rest}
        return cls(**main, valid=valid, attributes=entries, profile=shape, **more)

    @property
    def capacity(self) -> int:
        """Number of entries, padding included (static)."""
        return int(self.radius.shape[0])

    @property
    def num_points(self) -> int:
        """Number of points that exist (host side)."""
        return int(np.asarray(self.valid).sum())

    @property
    def dtype(self) -> Any:
        """float32 or float64."""
        return self.position.dtype

    def usable(self) -> Bool[Array, " points"]:
        """Points that exist, with numbers that mean something."""
        xp, own = at_hand(self)
        finite = xp.isfinite(own.position).all(1) & xp.isfinite(own.radius) & xp.isfinite(own.extinction)
        for value in own.attributes.values():
            finite &= xp.isfinite(value)
        shown = ((own.color >= 0) & (own.color <= 1)).all(1)
        return array_of(own.valid & finite & shown & (own.radius > 0) & (own.extinction >= 0))

    def spheres(self) -> Particles:
        """What they can be met in, as particles that carry nothing."""
        nothing = array_of(module_for(self.radius).zeros(self.radius.shape, self.radius.dtype))
        return Particles(self.position, self.radius, nothing, nothing, self.usable(), position_rest=self.position_rest)

    def exact_position(self) -> np.ndarray:
        """Positions in float64, (capacity, 3), with what float32 could not hold (host side)."""
        return self.spheres().exact_position()

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the box around all points, (3,) and (3,), float64, length units (host side)."""
        return self.spheres().bounds()


def _strengths(extinction: Any, opacity: Any, attributes: dict[str, Any], unit: Any) -> dict[str, Any]:
    """Extinction or opacity, by name, and attributes, none of which may stand for what every point has."""
    if (extinction is None) == (opacity is None):
        what = "neither" if extinction is None else "both"
        raise ValueError(f"one of `extinction` and `opacity` must be given, got {what}; opacity is that through the centre")
    taken = [name for name in attributes if name in (*MAIN, "opacity")]
    if taken:
        raise ValueError(f"`attributes` must not be named as what every point has, got {taken[0]!r}; give it another name")
    given = {name: own(name, value) for name, value in attributes.items()}
    if opacity is None:
        return {"extinction": in_unit("extinction", extinction, unit, -1)} | given
    return {"opacity": plain("opacity", opacity, "it is a number")} | given


def _extinction(opacity: Any, radius: Any, profile: Profile) -> Any:
    """Extinction at the centre of points that have an opacity along a ray through it; in float64 where numbers are known."""
    through: Any = profile.through_centre()
    if not is_traced(through):
        through = float(through)
        if not through > 0:
            raise ValueError("`profile` is 0 along a ray through the centre; give `extinction`, not `opacity`")
    if is_traced(opacity):
        return -jnp.log1p(-opacity) / (radius * through)
    return -np.log1p(-np.asarray(opacity, np.float64)) / (radius * through)


def _require_usable(columns: dict[str, Any]) -> None:
    """Raise where numbers are out of range."""
    for name, value in columns.items():
        if is_traced(value):
            continue
        require_finite(name, value)
        if name == "radius":
            require_positive(name, value, "give the radius of every point, where its light ends")
        if name in ("extinction", "opacity"):
            require_positive(name, value, "points can only take light away or emit it", strict=False)
        above = np.asarray(value) > 1 if name == "color" else np.asarray(value) >= (1 if name == "opacity" else np.inf)
        if above.any() or (name == "color" and (np.asarray(value) < 0).any()):
            allowed = "in [0, 1]" if name == "color" else "in [0, 1)"
            raise ValueError(f"`{name}` must be {allowed}, got {np.asarray(value).min():.6g} .. {np.asarray(value).max():.6g}")


def _distance(value: Any, dtype: Any) -> Array | None:
    if value is None:
        return None
    if not is_traced(value) and not float(value) >= 0:
        raise ValueError(f"`splats_beyond` must be >= 0 or None, got {value!r}; it is a distance from the eye")
    return array_of(value, dtype)
