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

import functools
import operator
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsph.model.medium import Cotangents, Medium, Places, Stops, optics, pull_path
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

    def pull(
        self, total: Cotangents, gathered: tuple[Any, ...], task: Any, cotangents: list[Array], of_stops: Stops | None = None
    ) -> tuple[Cotangents, Places]:
        """See `Medium.pull`: through the mixing by `jax.vjp`, then through each medium as it does."""

        def mixed(each: list[Optics], path: Array) -> Optics:
            extinctions = [of_one[3] for of_one in each]
            colors = mixed_colors([of_one[:3] for of_one in each], extinctions, None if self.mix == "extinction" else path)
            return [*colors, mixed_extinction(extinctions)]

        each = [optics(medium, one, task) for medium, one in zip(self.media, gathered, strict=True)]
        of_optics, of_path = jax.vjp(mixed, each, task.path())[1](cotangents)
        places = Places.none(task) if self.mix == "extinction" else pull_path(task, of_path)
        added, first = [], None if of_stops is None else self.stops(gathered, task)[0]
        for medium, own, one, of_one in zip(self.media, total.own, gathered, of_optics, strict=True):
            of_its: Any = None
            if of_stops is not None and medium.stops_rays:
                mine = medium.stops(one, task)[0] == first
                of_its = tuple(jnp.where(mine, of_stop, 0) for of_stop in of_stops)
            total, moved = medium.pull(total._replace(own=own), one, task, of_one, of_its)
            added.append(total.own)
            places = jax.tree.map(jnp.add, places, moved)
        return total._replace(own=tuple(added)), places


def first_stops(one: Stops, other: Stops) -> Stops:
    """Of two, where rays end first."""
    return tuple(jnp.where(one[0] <= other[0], a, b) for a, b in zip(one, other, strict=True))  # type: ignore[return-value]


def mixed_extinction(extinctions: Optics) -> Float[Array, "..."]:
    """Of all media that share samples: extinctions add up (Kaehler et al. 2007, equation 2)."""
    return functools.reduce(operator.add, extinctions)


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
