r"""Media that share rays, mixed sample by sample: Kaehler, Abel & Hege 2007, section 3.

Flow: media -> [mixture] -> integrator.

A sample stands for a length l of a ray. Their equation 2: extinctions, and means of them over that, add up, so it has the opacity
$\alpha = 1 - \exp(-\sum_k \xi_k l)$. What it emits is mixed in one of two ways.

- `"extinction"`: $\alpha \sum_k \xi_k c_k / \sum_k \xi_k$. Exact for constant extinctions, however long the sample.
- `"opacity"`: $\sum_k \alpha_k c_k$ with $\alpha_k = 1 - \exp(-\xi_k l)$, their equation 1. Where several
  are not empty these add up to more than $\alpha$, so it shows more light than the first, and more than there can be where all
  are opaque. Both meet as l goes to 0.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsph.model.medium import Medium, OfPlaces, Stops
from jaxsph.numerics.extremes import ratio
from jaxsph.numerics.trees import tree

Optics = list[Float[Array, "..."]]


@tree(static=("mix",))
class Mixture(Medium):
    """Several media as one.

    Attributes:
        media: at least two.
        mix: "extinction" or "opacity", by what their colours weigh.
    """

    media: tuple[Medium, ...]
    mix: str = "extinction"

    @classmethod
    def of(cls, media: tuple[Medium, ...], mix: str = "extinction") -> Medium:
        """One medium is itself, so that its image is the same bit for bit whatever else there could be."""
        return media[0] if len(media) == 1 else cls(media, mix)

    def occupied(self, slabs: Any) -> Bool[Array, "slabs bundles"]:
        """Where any of them is."""
        return functools.reduce(operator.or_, (medium.occupied(slabs) for medium in self.media))

    def gather(self, task: Any) -> tuple[Any, ...]:
        """What each of them finds."""
        return tuple(medium.gather(task) for medium in self.media)

    def extinction(self, gathered: tuple[Any, ...], task: Any) -> tuple[Float[Array, "tasks samples rays"], tuple[Any, ...]]:
        """The sum; and of each its own, with what its colours are read by."""
        found = tuple(medium.extinction(one, task) for medium, one in zip(self.media, gathered, strict=True))
        return mixed_extinction([extinction for extinction, _ in found]), found

    def colors(self, samples: tuple[Any, ...], task: Any, channels: slice) -> Optics:
        """Mixed."""
        colors = [medium.colors(one, task, channels) for medium, (_, one) in zip(self.media, samples, strict=True)]
        extinctions = [extinction for extinction, _ in samples]
        return mixed_colors(colors, extinctions, None if self.mix == "extinction" else task.path())

    @property
    def exact_means(self) -> bool:  # type: ignore[override]
        """Whether those of all are."""
        return all(medium.exact_means for medium in self.media)

    @property
    def stops_rays(self) -> bool:  # type: ignore[override]
        """Whether any of them does."""
        return any(medium.stops_rays for medium in self.media)

    def stops(self, gathered: tuple[Any, ...], task: Any) -> Stops:
        """By the first of them."""
        found = [medium.stops(one, task) for medium, one in zip(self.media, gathered, strict=True) if medium.stops_rays]
        return functools.reduce(first_stops, found)

    def no_cotangents(self) -> tuple[Any, ...]:
        """Of each."""
        return tuple(medium.no_cotangents() for medium in self.media)

    def pull(  # type: ignore[override]
        self,
        total: tuple[Any, ...],
        gathered: tuple[Any, ...],
        task: Any,
        cotangents: list[Array],
        of_stops: Stops | None = None,
    ) -> tuple[tuple[Any, ...], OfPlaces]:
        """See `Medium.pull`: through the mixing by `jax.vjp`, then through each medium as it does."""

        def mixed(optics: list[Optics], path: Array) -> Optics:
            extinctions = [of_one[3] for of_one in optics]
            colors = mixed_colors([of_one[:3] for of_one in optics], extinctions, None if self.mix == "extinction" else path)
            return [*colors, mixed_extinction(extinctions)]

        def path(border: Array, factor: Array) -> Array:
            return dataclasses.replace(task, border=border, u=task.u * factor, v=task.v * factor).path()  # type: ignore[no-any-return]

        optics = [medium.optics(one, task) for medium, one in zip(self.media, gathered, strict=True)]
        of_optics, of_path = jax.vjp(mixed, optics, task.path())[1](cotangents)
        places = OfPlaces.none(task)
        if self.mix != "extinction":
            of_border, of_factor = jax.vjp(path, task.border, jnp.ones_like(places.factor))[1](of_path)
            places = places._replace(border=of_border, factor=of_factor)
        added, first = [], None if of_stops is None else self.stops(gathered, task)[0]
        for medium, so_far, one, of_one in zip(self.media, total, gathered, of_optics, strict=True):
            of_own: tuple[Any, ...] = ()
            if of_stops is not None and medium.stops_rays:
                own = medium.stops(one, task)[0] == first
                of_own = (tuple(jnp.where(own, of_stop, 0) for of_stop in of_stops),)
            more, moved = medium.pull(so_far, one, task, of_one, *of_own)
            added.append(more)
            places = jax.tree.map(jnp.add, places, moved)
        return tuple(added), places


def first_stops(one: Stops, other: Stops) -> Stops:
    """Of two, where rays end first."""
    return tuple(jnp.where(one[0] <= other[0], a, b) for a, b in zip(one, other, strict=True))  # type: ignore[return-value]


def mixed_extinction(extinctions: Optics) -> Float[Array, "..."]:
    """Of all media that share samples: extinctions add up (Kaehler et al. 2007, equation 2)."""
    total = extinctions[0]
    for extinction in extinctions[1:]:
        total = total + extinction
    return total


def mixed_colors(colors: list[Optics], extinctions: Optics, path: Float[Array, "..."] | None = None) -> Optics:
    """Of all media that share samples, by medium, then channel: weighed by extinction or, given path lengths, by opacity.

    Raises:
        ValueError: where media give different channels.
    """
    given = [len(of_one) for of_one in colors]
    if len(set(given)) > 1:
        raise ValueError(f"`Medium.colors` must give the channels that it is asked for, but media gave {given} of them")
    weights, total = extinctions, mixed_extinction(extinctions)
    if path is not None:
        weights, total = [_opacity(extinction, path) for extinction in extinctions], _opacity(total, path)
    shares = [ratio(weight, total) for weight in weights]
    weighed = [[share * color for color in of_one] for share, of_one in zip(shares, colors, strict=True)]
    return [mixed_extinction(list(of_channel)) for of_channel in zip(*weighed, strict=True)]


def _opacity(extinction: Float[Array, "..."], path: Float[Array, "..."]) -> Float[Array, "..."]:
    """Of a sample; a unit length where that has none, which is the limit."""
    return jnp.where(path > 0, -jnp.expm1(-extinction * path), extinction)
