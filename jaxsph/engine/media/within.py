r"""A medium where a clip holds it, and nothing elsewhere.

Flow: medium, clip -> [within] -> integrator; cotangents -> [within] -> medium, clip.

Samples outside of the clip have no extinction. Between borders each ray's ways through the clip are found (`Clip.spans`), and
what part lies in it of what each sample stands for: of one that a face crosses, the mean of that part counts with its share of
the length. Where more than one way falls into the same sample, it is taken to be the hull of them, with their length in all: an
estimate, for what is thinner than a sample.

**Where it is.** A slab that `Clip.over` says a clip cannot meet is not marched, and that is a theorem.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsph.engine.field.tasks import Part, SlabTask
from jaxsph.model.camera.camera import Camera
from jaxsph.model.clips import Clip, Overlap
from jaxsph.model.medium import COLORS, Cotangents, Medium, Places, Stops
from jaxsph.numerics.extremes import clamped, greater, lesser
from jaxsph.numerics.fusion import fusion_barrier
from jaxsph.numerics.trees import tree


def as_inner(name: str) -> Any:
    """A property of what is around a medium: as that has it."""
    return property(lambda own: getattr(own.medium, name))


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

    at_points, between_samples, exact_means, stops_rays, may_be_missed, fault, dtype = map(  # type: ignore[assignment]
        as_inner, ("at_points", "between_samples", "exact_means", "stops_rays", "may_be_missed", "fault", "dtype")
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
