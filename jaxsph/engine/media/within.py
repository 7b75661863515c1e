r"""A medium where a clip holds it, and nothing elsewhere.

Flow: medium, clip -> [within] -> integrator; cotangents -> [within] -> medium, clip.

Samples outside of the clip have no extinction. Between samples each ray's ways through the clip are found (`Clip.spans`), and
of each interval what part lies in it: of one that a face crosses, the mean of that part counts with its share of the length.
Where more than one way falls into the same interval, it is taken to be the hull of them, with their length in all: an estimate,
for what is thinner than an interval.

**Where it is.** A slab that `Clip.over` says a clip cannot meet is not marched, and that is a theorem.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.field.tasks import Part, SlabTask
from jaxsph.model.camera.camera import Camera
from jaxsph.model.clips.clips import Clip, Overlap
from jaxsph.model.medium import LIGHT, Medium, OfPlaces, Stops
from jaxsph.numerics.extremes import clamped, greater, lesser
from jaxsph.numerics.trees import tree


@tree()
class Within(Medium):
    """Part of a medium: `jaxsph.Within(medium, clip)`, in `Scene(media=...)`; all of a scene by `Scene(within=clip)`.

    Differentiation:
        As the medium itself. Between samples (`integrator="segments"`) by the clip as well; point samples are in it or not.

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

    @property
    def at_points(self) -> bool:  # type: ignore[override]
        """As the medium."""
        return self.medium.at_points

    @property
    def between_samples(self) -> bool:  # type: ignore[override]
        """As the medium."""
        return self.medium.between_samples

    @property
    def stops_rays(self) -> bool:  # type: ignore[override]
        """As the medium."""
        return self.medium.stops_rays

    @property
    def may_be_missed(self) -> bool:  # type: ignore[override]
        """As the medium."""
        return self.medium.may_be_missed

    @property
    def dtype(self) -> Any:
        """That of the medium."""
        return self.medium.dtype

    def seen_by(self, camera: Camera) -> Within:
        """Both in view space."""
        return Within(self.medium.seen_by(camera), self.clip.seen_by(camera))

    def without_data(self) -> Within:
        """See `Medium`."""
        return self._around(self.medium.without_data())

    def with_data(self, given: Any) -> Within:
        """See `Medium`; `given` may be the medium alone."""
        while isinstance(given, Within):
            given = given.medium
        return self._around(self.medium.with_data(given))

    def in_band(self, grid: Any) -> Within:
        """See `Medium`."""
        return self._around(self.medium.in_band(grid))

    def for_means(self) -> Within:
        """See `Medium`."""
        return self._around(self.medium.for_means())

    def faults(self) -> Int[Array, ""]:
        """Those of the medium."""
        return self.medium.faults()

    def occupied(self, slabs: Any) -> Bool[Array, "slabs bundles"]:
        """Where the medium is and the clip may be."""
        return self.medium.occupied(slabs) & over_slabs(self.clip, slabs).meets

    def gather(self, task: SlabTask) -> Any:
        """What the medium finds."""
        if task.between and self.medium.in_parts:
            task = self._task(task, jax.tree.map(jax.lax.stop_gradient, self._part(task)))
        return self.medium.gather(task)

    def extinction(self, gathered: Any, task: SlabTask) -> tuple[Float[Array, "tasks samples rays"], Any]:
        """None outside."""
        extinction, samples = self.medium.extinction(gathered, task)
        return jnp.where(self.clip.contains(task.positions()), extinction, 0), samples

    def colors(self, samples: Any, task: SlabTask, channels: slice) -> list[Float[Array, "tasks samples rays"]]:
        """Those of the medium."""
        return self.medium.colors(samples, task, channels)

    def intervals(self, gathered: Any, task: SlabTask) -> tuple[Any, Part]:
        """Those of the medium, and what part of each counts."""
        part = self._part(task)
        return self.medium.intervals(gathered, self._task(task, part)), part

    def means(self, intervals: tuple[Any, Part], task: SlabTask, channels: slice) -> list[Float[Array, "tasks intervals rays"]]:
        """See `Medium.means`."""
        of_medium, part = intervals
        found = self.medium.means(of_medium, self._task(task, part), channels)
        return found if self.medium.in_parts else [part.share * mean for mean in found]

    def missed(self, gathered: Any, task: SlabTask) -> Float[Array, "tasks rays"]:
        """Of what is inside, where the medium knows of parts; else all that the medium misses."""
        return self.medium.missed(gathered, self._task(task, self._part(task)))

    def stops(self, gathered: Any, task: SlabTask) -> Stops:
        """Those of the medium: where it is not shown, no sample counts."""
        return self.medium.stops(gathered, task)

    def every_other(self, gathered: Any) -> Any:
        """See `Medium`."""
        return self.medium.every_other(gathered)

    def no_cotangents(self) -> Within:
        """None of either yet."""
        return Within(self.medium.no_cotangents(), jax.tree.map(jnp.zeros_like, self.clip))

    def pull(  # type: ignore[override]
        self, total: Within, gathered: Any, task: SlabTask, cotangents: list[Array]
    ) -> tuple[Within, OfPlaces]:
        """See `Medium.pull`: of what is inside; between samples, of where faces cut as well."""
        if not task.between:
            inside = self.clip.contains(task.positions())
            some = [jnp.where(inside, cotangent, 0) for cotangent in cotangents]
            of_medium, places = self.medium.pull(total.medium, gathered, task, some)
            return dataclasses.replace(total, medium=of_medium), places
        part, pull_part = jax.vjp(functools.partial(parts_of, task), self.clip, task.depth, jnp.ones_like(task.depth[0, 0]))
        inner = self._task(task, part)
        some = cotangents if self.medium.in_parts else [part.share * cotangent for cotangent in cotangents]
        of_medium, places = self.medium.pull(total.medium, gathered, inner, some)

        def means(part: Part) -> list[Array]:
            within = self._task(task, part)
            return self.means((self.medium.intervals(gathered, within), part), task, LIGHT)

        (of_part,) = jax.vjp(means, part)[1](cotangents)
        of_clip, depth, factor = pull_part(of_part)
        places = places._replace(depth=places.depth + depth, factor=places.factor + factor)
        return Within(of_medium, jax.tree.map(jnp.add, total.clip, of_clip)), places

    def _around(self, medium: Medium) -> Within:
        return dataclasses.replace(self, medium=medium)

    def _part(self, task: SlabTask) -> Part:
        return parts_of(task, self.clip, task.depth, jnp.ones_like(task.depth[0, 0]))

    def _task(self, task: SlabTask, part: Part) -> SlabTask:
        """For the medium: with the part of each interval, if it looks at that."""
        return dataclasses.replace(task, part=part) if self.medium.in_parts else task


def over_slabs(clip: Clip, slabs: Any) -> Overlap:
    """How a clip lies to slabs (`access.extents.SlabExtents`)."""
    return clip.over((slabs.x_lower, slabs.y_lower, slabs.z_lower), (slabs.x_upper, slabs.y_upper, slabs.z_upper))


def parts_of(task: SlabTask, clip: Clip, depth: Float[Array, "tasks samples"], factor: Float[Array, ""]) -> Part:
    """What of each interval lies in a clip, of rays at `factor` times their coordinates."""
    ends = dataclasses.replace(task, depth=depth[:, jnp.array([0, -1])], u=task.u * factor, v=task.v * factor).positions()
    spans = clip.spans(*((tuple(at[:, k] for at in ends)) for k in (0, 1)))
    begin, end = depth[:, :-1], depth[:, 1:]
    first, slab = depth[:, :1], depth[:, -1:] - depth[:, :1]
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
