"""What light meets along its way: the interface of all media.

Flow: scene -> [medium] -> field, cast.

A medium is a frozen dataclass and a pytree, whose floating leaves an image can be differentiated by. It is asked for its
extinction and colours at the samples of slabs; how samples become light is the integrator's affair, and media that share samples
are one to it (`Mixture`). What takes no loop of its own needs only `extinction` and `colors`, and no derivative written by hand.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import Any, ClassVar, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsph.model.camera.camera import Camera
from jaxsph.numerics import faults

COLORS = slice(0, 3)
Total = TypeVar("Total")


class Places(NamedTuple):
    """Where samples are: their depths, the borders between them, and a common factor of all u and v; or cotangents of these."""

    depth: Float[Array, "tasks samples"]
    border: Float[Array, "tasks samples_and_one"]
    factor: Float[Array, ""]

    @classmethod
    def of(cls, task: Any) -> Places:
        """Those of a task."""
        return cls(task.depth, task.border, jnp.ones_like(task.depth[0, 0]))

    def moved(self, task: Any) -> Any:
        """The task with its samples there."""
        u, v = task.u * self.factor, task.v * self.factor
        return dataclasses.replace(task, depth=self.depth, border=self.border, u=u, v=v)

    @classmethod
    def none(cls, task: Any) -> Places:
        """Cotangents that are zero."""
        return jax.tree.map(jnp.zeros_like, cls.of(task))  # type: ignore[no-any-return]


class Cotangents(NamedTuple):
    """What is added up of a medium over slabs.

    Attributes:
        table: of the particles of a band in rank order, rows of `field.gather.COLUMNS`; of all media together.
        own: of what the medium has in view space, as it is before `in_band`.
    """

    table: Float[Array, "particles 8"]
    own: Any

    def with_own(self, more: Any) -> Cotangents:
        """With more of the same."""
        return self._replace(own=added(self.own, more))


def added(total: Total, more: Any) -> Total:
    """Cotangents, with more of the same; what has none stays as it is, and what is None in `total` stays out."""

    def of_leaf(value: Any, other: Any) -> Any:
        return value if value is None or other.dtype == jax.dtypes.float0 else value + other

    return jax.tree.map(of_leaf, total, more, is_leaf=lambda one: one is None)  # type: ignore[no-any-return]


Stops = tuple[Array, Array, Array, Array]
"""Where rays first meet a surface, and end: view depths, infinite where they do not; and x, y and z of its normal in view space,
of unit length and out of it, 0 where there is none."""


class Medium(abc.ABC):
    """A participating medium that emits and absorbs.

    Positions are in view space (length units): x right, y up, z forward from the eye.

    Attributes:
        between_samples: whether it meets spheres of the grid anywhere between the borders of samples, not at samples alone.
        stops_rays: whether `stops` tells where rays meet a surface, which is opaque: behind it nothing is marched.
        only_stops: whether it has nothing else: `extinction` is 0 or opaque, and a slab has one colour, whichever the sample.
        in_parts: whether it looks at a task's `part`; means of those that do not are taken to be those of any part of a sample.
        exact_means: whether its means from border to border are exact, all that is left out is how they are mixed in between.
        may_be_missed: whether what is thin of it may lie between samples, unseen: at no number of samples is its error known.
        fault: of what `seen_by` made, fault word: what is wrong with its numbers.
    """

    between_samples: ClassVar[bool] = False
    in_parts: ClassVar[bool] = False
    stops_rays: ClassVar[bool] = False
    only_stops: ClassVar[bool] = False
    exact_means: ClassVar[bool] = False
    may_be_missed: ClassVar[bool] = False
    fault: Any = faults.NONE

    @property
    def dtype(self) -> Any:
        """What samples are to be computed in at least, float32 or float64; by default float32."""
        return jnp.dtype(jnp.float32)

    @property
    def spheres(self) -> slice:
        """Numbers of the spheres in the grid that it reads where it is `between_samples`; by default all."""
        return slice(None)

    def seen_by(self, camera: Camera) -> Medium:
        """The medium in view space; by default as it is."""
        return self

    def with_data(self, given: Any) -> Medium:
        """What `seen_by` made, with large arrays that are the scene's own, from what of the scene it was made of; by default as
        it is. Given None it is without them: a stage would copy what it returns.
        """
        return self

    def in_band(self, band: Any) -> Medium:
        """What `seen_by` made, with what it needs of a band (`media.shown.Band`), made once; by default as it is."""
        return self

    @abc.abstractmethod
    def occupied(self, slabs: Any) -> Bool[Array, "slabs bundles"]:
        """Where any of it may be: slabs of samples that are to be marched for it.

        Args:
            slabs: `access.grid.SlabExtents`, boxes in view space around the slabs of a band.
        """

    def meets(self, task: Any) -> Bool[Array, " tasks"]:
        """Slabs in which their rays may meet any of it; by default all of those that are to be marched."""
        return jnp.ones(task.depth.shape[0], bool)

    def gather(self, task: Any) -> Any:
        """What is found in loops, once for all that follows: arrays whose first axis is tasks; by default nothing."""
        return ()

    @abc.abstractmethod
    def extinction(self, gathered: Any, task: Any) -> tuple[Float[Array, "tasks samples rays"], Any]:
        """Extinction a unit length at the samples of slabs, 0 where there is nothing; and what `colors` reads.

        Of a task `between` borders a medium that knows better gives means over what samples stand for, colours by extinction.

        Args:
            gathered: what `gather` found.
            task: `field.tasks.SlabTask`, the slabs and where their samples are.
        """

    @abc.abstractmethod
    def colors(self, samples: Any, task: Any, channels: slice) -> list[Float[Array, "tasks samples rays"]]:
        """Those of red, green and blue that `channels` selects, at the samples of slabs; of no meaning where extinction is 0."""

    def doubtful(self, gathered: Any, task: Any) -> Bool[Array, "tasks samples rays"]:
        """Samples at which rounding may choose what is shown, as beside a jump: their rays have no bound; by default none."""
        return jnp.zeros(task.shape, bool)

    def covered(self, samples: Any, task: Any) -> Float[Array, "tasks samples rays"] | None:
        """Of a task `between` borders, what share of each sample's length holds any of it; by default None: all may.

        Args:
            samples: what `extinction` gave besides.
        """
        return None

    def stops(self, gathered: Any, task: Any) -> Stops:
        """Where rays first meet a surface in slabs, (tasks, rays) each; of media that `stops_rays`.

        There lies the half depth of rays that arrive with more, exactly and not to within a sample.
        """
        raise NotImplementedError(f"`{type(self).__name__}` says that it stops rays: define `stops`, which tells where")

    def pull(
        self, total: Cotangents, gathered: Any, task: Any, cotangents: list[Array], of_stops: Stops | None = None
    ) -> tuple[Cotangents, Places]:
        """Add the cotangents of all that `optics` depend on, from those of red, green, blue and extinction of samples.

        By differentiating `extinction` and `colors`; and then `gather`, by `pull_gather`.

        Args:
            total: of the slabs before.
            of_stops: cotangents of where rays end, of media that `stops_rays`.

        Returns:
            `total` with those of these slabs, and those of where samples are.
        """

        def met(medium: Medium, gathered: Any, places: Places) -> list[Array]:
            moved = places.moved(task)
            stops = () if of_stops is None else medium.stops(gathered, moved)
            return [*optics(medium, gathered, moved), *stops]

        own, of_gathered, places = jax.vjp(met, self, gathered, Places.of(task))[1]([*cotangents, *(of_stops or ())])
        total, more = self.pull_gather(total.with_own(own), gathered, task, of_gathered)
        return total, jax.tree.map(jnp.add, places, more)

    def pull_gather(self, total: Cotangents, gathered: Any, task: Any, cotangents: Any) -> tuple[Cotangents, Places]:
        """The same of all that `gather` depends on, from cotangents of what was gathered; by default by `jax.vjp`."""
        pull = jax.vjp(lambda medium, places: medium.gather(places.moved(task)), self, Places.of(task))[1]
        own, places = pull(cotangents)
        return total.with_own(own), places


def optics(medium: Medium, gathered: Any, task: Any) -> list[Float[Array, "tasks samples rays"]]:
    """Red, green, blue and extinction at the samples of slabs."""
    extinction, samples = medium.extinction(gathered, task)
    return [jnp.broadcast_to(value, task.shape) for value in (*medium.colors(samples, task, COLORS), extinction)]


def pull_path(task: Any, cotangent: Float[Array, "tasks samples rays"]) -> Places:
    """Cotangents of where samples are, from those of `task.path()`."""
    return jax.vjp(lambda places: places.moved(task).path(), Places.of(task))[1](cotangent)[0]  # type: ignore[no-any-return]
