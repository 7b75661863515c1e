r"""What a frame shows, as its stages are given it; of a band of it, as media are; and media of others: parts, and mixtures.

Flow: viewing -> [shown] -> stages: control | cast -> media -> [shown: within, mixture] -> integrator.

**Within.** Samples outside of a clip have no extinction. Between borders each ray's ways through the clip are found
(`Clip.spans`), and what part lies in it of what each sample stands for: of one that a face crosses, the mean of that part counts
with its share of the length. Where more than one way falls into the same sample, it is taken to be the hull of them, with their
length in all: an estimate, for what is thinner than a sample. A slab that `Clip.over` says a clip cannot meet is not marched, and
that is a theorem.

**Mixture.** Media that share rays are mixed sample by sample: Kaehler, Abel & Hege 2007, section 3. A sample stands for a length
l of a ray. Their equation 2: extinctions, and means of them over that, add up, so it has the opacity $\alpha = 1 - \exp(-\sum_k
\xi_k l)$. What it emits is mixed in one of two ways.

- `"extinction"`: $\alpha \sum_k \xi_k c_k / \sum_k \xi_k$. Exact for constant extinctions, however long the sample.
- `"opacity"`: $\sum_k \alpha_k c_k$ with $\alpha_k = 1 - \exp(-\xi_k l)$, their equation 1. Where several
  are not empty these add up to more than $\alpha$, so it shows more light than the first, and more than there can be where all
  are opaque. Both meet as l goes to 0.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.field.lattice import Lattice
from jaxsph.engine.field.tasks import Part, SlabTask
from jaxsph.model.camera.camera import Camera
from jaxsph.model.clips import Clip, Overlap
from jaxsph.model.medium import COLORS, Cotangents, Medium, Places, Stops, optics, pull_path
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.numerics.compiled import clamped, fusion_barrier, greater, lesser, ratio
from jaxsph.numerics.trees import tree

Optics = list[Float[Array, "..."]]


class Shown(NamedTuple):
    """What is shown besides spheres, which a grid holds.

    Attributes:
        camera: in whose view, or through whose rays.
        transfer: of the particles; None without any.
        media: other media, in view space.
        within: where particles are shown, None everywhere; other media are so by themselves.
    """

    camera: Camera
    transfer: TransferFunction | None
    media: tuple[Medium, ...] = ()
    within: Clip | None = None

    def of_type(self, dtype: Any) -> Shown:
        """With the numbers of the transfer function in the type of what is marched."""
        return self._replace(transfer=jax.tree.map(lambda leaf: leaf.astype(dtype), self.transfer))


class Band(NamedTuple):
    """What media are given of a band of the image.

    Attributes:
        grid: spheres, and where they are.
        lattice: where the sums of interpolated slabs come from, if any do.
        between: whether means from border to border are asked for.
        of_field, of_own: whether cotangents are, by where samples and particles are and what those carry; and of the medium.
    """

    grid: Grid
    lattice: Lattice | None = None
    between: bool = False
    of_field: bool = True
    of_own: bool = True


class RayLimits(NamedTuple):
    """Where rays stop being marched, and slabs being halved; None for neither.

    Attributes:
        min_transmittance: below which a ray ends.
        tolerance: that segments are refined for.
    """

    min_transmittance: Float[Array, ""] | None = None
    tolerance: Float[Array, ""] | None = None


@tree()
class Within(Medium):
    """Part of a medium: `jaxsph.Within(medium, clip)`, in `Scene(media=...)`; all of a scene by `Scene(within=clip)`.

    Differentiation:
        As the medium itself. With `integrator="segments"` by the clip as well; point samples are in it or not.

    Attributes:
        medium: what there is.
        clip: where it is shown.
    """

    medium: Medium
    clip: Clip

    @classmethod
    def of(cls, medium: Medium, clip: Clip | None) -> Medium:
        """A medium everywhere is itself."""
        return medium if clip is None else cls(medium, clip)

    between_samples, spheres, exact_means, stops_rays, may_be_missed, fault, dtype = map(  # type: ignore[assignment]
        lambda name: property(lambda own: getattr(own.medium, name)),
        ("between_samples", "spheres", "exact_means", "stops_rays", "may_be_missed", "fault", "dtype"),
    )

    def seen_by(self, camera: Camera) -> Within:
        """Both in view space."""
        return Within(self.medium.seen_by(camera), self.clip.seen_by(camera))

    def with_data(self, given: Any) -> Within:
        """See `Medium`; `given` may be the medium alone."""
        while isinstance(given, Within):
            given = given.medium
        return dataclasses.replace(self, medium=self.medium.with_data(given))

    def in_band(self, band: Any) -> Within:
        """See `Medium`."""
        return dataclasses.replace(self, medium=self.medium.in_band(band))

    def occupied(self, slabs: Any) -> Bool[Array, "slabs bundles"]:
        """Where the medium is and the clip may be."""
        return self.medium.occupied(slabs) & over_slabs(self.clip, slabs).meets

    def gather(self, task: SlabTask) -> Any:
        """What the medium finds; between borders, and what part of each sample counts."""
        if not task.between:
            return self.medium.gather(task)
        part = fusion_barrier(task.slab[0] >= 0, self._part, task)
        return self.medium.gather(self._task(task, jax.tree.map(jax.lax.stop_gradient, part))), part

    def extinction(self, gathered: Any, task: SlabTask) -> tuple[Float[Array, "tasks samples rays"], Any]:
        """None outside; between borders, of what part of each sample counts."""
        if task.between:
            inner, part = gathered
            return self._in_part(inner, task, part)
        extinction, samples = self.medium.extinction(gathered, task)
        return jnp.where(self.clip.contains(task.positions()), extinction, 0), samples

    def _in_part(self, gathered: Any, task: SlabTask, part: Part) -> tuple[Float[Array, "tasks samples rays"], Any]:
        extinction, samples = self.medium.extinction(gathered, self._task(task, part))
        return extinction if self.medium.in_parts else part.share * extinction, samples

    def colors(self, samples: Any, task: SlabTask, channels: slice) -> list[Float[Array, "tasks samples rays"]]:
        """Those of the medium."""
        return self.medium.colors(samples, task, channels)

    def doubtful(self, gathered: Any, task: SlabTask) -> Bool[Array, "tasks samples rays"]:
        """Those of the medium, and where it shows anything as near to a face as `Clip.over` says that rounding may matter."""
        place = task.positions()
        meets, holds = self.clip.over(place, place)
        there = self.medium.doubtful(gathered, task) | ~holds & (self.medium.extinction(gathered, task)[0] > 0)
        return meets & there

    def covered(self, samples: Any, task: SlabTask) -> Float[Array, "tasks samples rays"] | None:
        """What is inside of what the medium covers."""
        return self.medium.covered(samples, task) if self.medium.in_parts else self._part(task).share

    def stops(self, gathered: Any, task: SlabTask) -> Stops:
        """Those of the medium: where it is not shown, no sample counts."""
        return self.medium.stops(gathered[0] if task.between else gathered, task)

    def pull(
        self, total: Cotangents, gathered: Any, task: SlabTask, cotangents: list[Array], of_stops: Stops | None = None
    ) -> tuple[Cotangents, Places]:
        """See `Medium.pull`: of what is inside; between borders, of where faces cut as well."""
        own, of_own = total.own, total._replace(own=total.own.medium)
        if not task.between:
            inside = self.clip.contains(task.positions())
            some = [jnp.where(inside, cotangent, 0) for cotangent in cotangents]
            found, places = self.medium.pull(of_own, gathered, task, some, of_stops)
            return found._replace(own=dataclasses.replace(own, medium=found.own)), places
        gathered, _ = gathered
        part, pull_part = jax.vjp(functools.partial(parts_of, task), self.clip, task.border, jnp.ones_like(task.depth[0, 0]))
        inner, (*of_colors, of_extinction) = self._task(task, part), cotangents
        some = cotangents if self.medium.in_parts else [*of_colors, part.share * of_extinction]
        found, places = self.medium.pull(of_own, gathered, inner, some, of_stops)

        def met(part: Part) -> list[Array]:
            extinction, samples = self._in_part(gathered, task, part)
            return [*self.medium.colors(samples, self._task(task, part), COLORS), extinction]

        (of_part,) = jax.vjp(met, part)[1](cotangents)
        of_clip, border, factor = pull_part(of_part)
        places = places._replace(border=places.border + border, factor=places.factor + factor)
        return found._replace(own=Within(found.own, jax.tree.map(jnp.add, own.clip, of_clip))), places

    def _part(self, task: SlabTask) -> Part:
        return parts_of(task, self.clip, task.border, jnp.ones_like(task.depth[0, 0]))

    def _task(self, task: SlabTask, part: Part) -> SlabTask:
        """For the medium: with the part of each sample, if it looks at that."""
        return dataclasses.replace(task, part=part) if self.medium.in_parts else task


def over_slabs(clip: Clip, slabs: Any) -> Overlap:
    """How a clip lies to slabs (`access.grid.SlabExtents`)."""
    return clip.over((slabs.x_lower, slabs.y_lower, slabs.z_lower), (slabs.x_upper, slabs.y_upper, slabs.z_upper))


def parts_of(task: SlabTask, clip: Clip, border: Float[Array, "tasks samples_and_one"], factor: Float[Array, ""]) -> Part:
    """What of each sample's length lies in a clip, of rays at `factor` times their coordinates."""
    ends = dataclasses.replace(task, depth=border[:, jnp.array([0, -1])], u=task.u * factor, v=task.v * factor).positions()
    spans = clip.spans(*((tuple(at[:, k] for at in ends)) for k in (0, 1)))
    begin, end = border[:, :-1], border[:, 1:]
    first, slab = border[:, :1], border[:, -1:] - border[:, :1]
    length = jnp.where(end > begin, end - begin, 1)
    total: Any = 0
    low: Any = 1
    high: Any = 0
    for span_begin, span_end in zip(spans.begin, spans.end, strict=True):
        enters, leaves = (
            clamped((share[:, None] * slab[..., None] - (begin - first)[..., None]) / length[..., None], 0, 1)
            for share in (span_begin, span_end)
        )
        filled = leaves > enters
        total = total + jnp.where(filled, leaves - enters, 0)
        low, high = lesser(low, jnp.where(filled, enters, 1)), greater(high, jnp.where(filled, leaves, 0))
    return Part(low, greater(high, low), total)


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

    def meets(self, task: Any) -> Bool[Array, " tasks"]:
        """Where any may be met."""
        return functools.reduce(operator.or_, (medium.meets(task) for medium in self.media))

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

    def doubtful(self, gathered: tuple[Any, ...], task: Any) -> Bool[Array, "tasks samples rays"]:
        """Those of any."""
        each = (medium.doubtful(one, task) for medium, one in zip(self.media, gathered, strict=True))
        return functools.reduce(operator.or_, each)

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
        first, *others = found
        for other in others:
            first = tuple(jnp.where(first[0] <= other[0], a, b) for a, b in zip(first, other, strict=True))  # type: ignore[assignment]
        return first

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
