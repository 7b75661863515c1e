r"""What a splat moves along a ray: thickness that its chord has elsewhere, and past what else that is moved.

Flow: points -> [moved: pieces -> sums of intervals] -> cast.splat_bound.

A splat has all of its thickness in the interval of a ray that holds its centre; its chord has some of that in other intervals.
What the chord has in the splat's own interval *stays*. What it has in front of that, and what it has behind, are two *pieces*
that are moved. The *span* of a piece is all intervals from the first that it touches in either place to the last. Where the near
and the far end of a ray cut a chord or leave a centre out, one of both has more in all: what the other lacks is *extra*. Lengths
are in radii of a point, counted along a ray from the foot of its centre, as in `model.profiles`. Shapes as in `field.points`.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsph.model.profiles import Profile

ROUNDINGS = 2  # of each coordinate relative to the eye, in eps, by which two programs may see a point in different places
LEAST_ROUNDING = 8  # the same in radii, in eps, for what is rounded there; and of integrals of profiles


class Moved(NamedTuple):
    """Sums over splats, for intervals of rays: (tasks, intervals, rays).

    Attributes:
        placed: thickness of pieces where splats have it.
        ended: thickness of pieces whose span ends there.
        past: thickness that may be on the other side of something there once it is moved.
        past_mean: the mean of it over the interval, and over where in it a piece may be.
        past_own: `past_mean` of a splat times its thickness that stays there.
        spanning: opacities of pieces whose span includes the interval.
        begun: opacities of pieces whose span begins there.
        same: half the squares of those, and the products of those with that of the other piece of the same splat.
        extra: thickness that only chords or only splats have there, and what rounding may have misplaced.
    """

    placed: Array
    ended: Array
    past: Array
    past_mean: Array
    past_own: Array
    spanning: Array
    begun: Array
    same: Array
    extra: Array


class Places(NamedTuple):
    """Where intervals of a slab lie relative to that of a splat: in front of it, it, behind it; in none if that is none."""

    before: Bool[Array, "tasks points intervals rays"]
    here: Bool[Array, "tasks points intervals rays"]
    behind: Bool[Array, "tasks points intervals rays"]


@dataclasses.dataclass(frozen=True)
class Splats:
    """A block of splats as rays meet them.

    Attributes:
        square: squared distance between ray and centre.
        strength: thickness of a length of 1; 0 of what is no splat.
        border: where intervals of the slab begin and end.
        near, far: where the ray does.
        front, back: where the interval of the splat begins and ends.
        seen: whether there is one, between near and far.
        places: where intervals of the slab lie relative to it.
        rounding: how far off all of this may be.
        profile: a `closed` one.
    """

    square: Float[Array, "tasks points 1 rays"]
    strength: Float[Array, "tasks points 1 rays"]
    border: Float[Array, "tasks points intervals_and_one rays"]
    near: Float[Array, "tasks points 1 rays"]
    far: Float[Array, "tasks points 1 rays"]
    front: Float[Array, "tasks points 1 rays"]
    back: Float[Array, "tasks points 1 rays"]
    seen: Bool[Array, "tasks points 1 rays"]
    places: Places
    rounding: Float[Array, "tasks points 1 rays"]
    profile: Profile

    def moved(self) -> Moved:
        """Sums over the block."""
        (before, here, behind), first, last = self.places, *self.ends()
        edge, front, back = (jnp.clip(at, first, last) for at in (self.border, self.front, self.back))
        fore, aft = self.along(first, front), self.along(back, last)
        cut = self.along(-self.half(), first) + self.along(last, self.half())
        to, beyond = self.along(first, edge), self.along(edge, last)
        to_middle, beyond_middle = 0.5 * (to[:, :, :-1] + to[:, :, 1:]), 0.5 * (beyond[:, :, :-1] + beyond[:, :, 1:])
        whole = fore + aft
        past = self.up(jnp.where(here, whole, jnp.where(before, to[:, :, 1:], jnp.where(behind, beyond[:, :, :-1], 0))))
        past_mean = self.up(jnp.where(here, 0.5 * whole, jnp.where(before, to_middle, jnp.where(behind, beyond_middle, 0))))
        stays = jnp.maximum(self.along(front, back) + cut - self.noise(), 0)
        own = jnp.where(here, 0.5 * whole * stays, 0)
        extra = jnp.where(here, cut, jnp.where(self.seen, 0, self.along(edge[:, :, :-1], edge[:, :, 1:]))) + self.misplaced()
        ended = jnp.where(here, fore, 0) + jnp.where(self.ends_in(last), aft, 0)
        sums = jnp.where(here, whole, 0), ended, past, past_mean, own, *self.opacities(fore, aft, first, last), extra
        return Moved(*(value.sum(1) for value in sums))

    def half(self) -> Float[Array, "tasks points 1 rays"]:
        """Of the chord."""
        inside = self.square < 1
        return jnp.where(inside, jnp.sqrt(jnp.where(inside, 1 - self.square, 1)), 0)

    def ends(self) -> tuple[Array, Array]:
        """Of what of the chord lies between near and far; the same twice where nothing does."""
        half = self.half()
        return jnp.clip(self.near, -half, half), jnp.clip(self.far, -half, half)

    def along(self, start: Array, end: Array) -> Array:
        """Thickness between two places of the chord."""
        return jnp.where(self.square < 1, self.profile.along(self.square, start, end) * self.strength, 0)

    def noise(self) -> Array:
        """By how much any thickness may be rounded."""
        return LEAST_ROUNDING * jnp.finfo(self.square.dtype).eps * self.strength

    def up(self, thickness: Array) -> Array:
        """Thickness rounded up, but for nothing."""
        return jnp.where(thickness > 0, thickness + self.noise(), 0)

    def opacities(self, fore: Array, aft: Array, first: Array, last: Array) -> tuple[Array, Array, Array]:
        """`spanning`, `begun` and `same` of the two pieces. A border within rounding of a chord's end counts as on both sides."""
        (before, here, behind), (begin, end) = self.places, (self.border[:, :, :-1], self.border[:, :, 1:])
        of_fore, of_aft = -jnp.expm1(-fore), -jnp.expm1(-aft)
        reached = before & (end > first - self.rounding)
        begins = jnp.where(reached & (begin <= first + self.rounding), of_fore, 0)
        spans = jnp.where(here | reached, of_fore, 0) + jnp.where(here | (behind & (begin < last + self.rounding)), of_aft, 0)
        same = 0.5 * begins**2 + jnp.where(here, of_aft * (0.5 * of_aft + of_fore), 0)
        return spans, begins + jnp.where(here, of_aft, 0), same

    def ends_in(self, last: Array) -> Array:
        """Intervals that surely hold the end of the chord; none where that is within rounding of a border."""
        begin, end = self.border[:, :, :-1], self.border[:, :, 1:]
        return self.places.behind & (begin < last - self.rounding) & (last + self.rounding <= end)

    def misplaced(self) -> Array:
        """What rounding may have moved in or out of intervals, of chords and splats together.

        If a centre is off by p in any direction, the distance b is, and so are the ends of intervals; the half chord h by
        $min(\\sqrt{3p}, 3p/h)$, as its square is by less than 3p. A profile of at most 1 and of a slope of at most 2 has an
        integral then that is off by four times p for the distance, and by as much as both ends are.
        """
        off, half = self.rounding, self.half()
        of_half = jnp.minimum(jnp.sqrt(3 * off), 3 * off / jnp.where(half > 0, half, jnp.finfo(half.dtype).tiny))
        margin = off + of_half
        first, last = jnp.clip(self.near, -half, half), jnp.clip(self.far, -half, half)
        touched = (self.border[:, :, 1:] >= first - margin) & (self.border[:, :, :-1] <= last + margin)
        thickness = (4 * off + 2 * margin) * self.strength + self.noise()
        return jnp.where((self.square < 1 + 3 * off) & (touched | self.places.here), 2 * thickness, 0)
