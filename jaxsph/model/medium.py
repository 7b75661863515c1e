"""What light meets along its way: the interface of all media.

Flow: scene -> [medium] -> field, cast.

A medium is a frozen dataclass and a pytree, whose floating leaves an image can be differentiated by. It is asked for its
extinction and colours at the samples of slabs; how samples become light is the integrator's affair, and media that share samples
are one to it (`model.mixture`). What takes no loop of its own needs only `extinction` and `colors`, and no derivative written by
hand.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import Any, ClassVar, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsph.model.camera.camera import Camera
from jaxsph.numerics import faults

COLORS = slice(0, 3)
Total = TypeVar("Total")


class OfPlaces(NamedTuple):
    """Cotangents of where samples are: of their depths, of the borders between them, and of a common factor of all u and v."""

    depth: Float[Array, "tasks samples"]
    border: Float[Array, "tasks samples_and_one"]
    factor: Float[Array, ""]

    @classmethod
    def none(cls, task: Any) -> OfPlaces:
        """Zeros."""
        return cls(jnp.zeros_like(task.depth), jnp.zeros_like(task.border), jnp.zeros_like(task.depth[0, 0]))


Stops = tuple[Array, Array, Array, Array]
"""Where rays first meet a surface: view depths, infinite where they do not; and x, y and z of its normal in view space, of unit
length and out of it, 0 where there is none. One that is opaque ends them."""


class Medium(abc.ABC):
    """A participating medium that emits and absorbs.

    Positions are in view space (length units): x right, y up, z forward from the eye.

    Attributes:
        at_points: whether `gather`, `extinction` and `colors` look at a task's positions alone, so that they may be asked for any
            points: not for those whose lists are of slabs, nor for what is found between the borders of samples.
        between_samples: whether it meets spheres of the grid anywhere between the borders of samples, not at samples alone.
        stops_rays: whether `stops` tells where rays meet a surface; behind one that is opaque nothing is marched.
        in_parts: whether it looks at a task's `part`; means of those that do not are taken to be those of any part of a sample.
        exact_means: whether its means from border to border are exact, all that is left out is how they are mixed in between.
        may_be_missed: whether what is thin of it may lie between samples, unseen: at no number of samples is its error known.
    """

    at_points: ClassVar[bool] = True
    between_samples: ClassVar[bool] = False
    in_parts: ClassVar[bool] = False
    stops_rays: ClassVar[bool] = False
    exact_means: ClassVar[bool] = False
    may_be_missed: ClassVar[bool] = False

    @property
    def dtype(self) -> Any:
        """What samples are to be computed in at least, float32 or float64; by default float32."""
        return jnp.dtype(jnp.float32)

    def seen_by(self, camera: Camera) -> Medium:
        """The medium in view space; by default as it is."""
        return self

    def without_data(self) -> Medium:
        """What `seen_by` made, without large arrays that are the scene's own: a stage would copy what it returns."""
        return self

    def with_data(self, given: Any) -> Medium:
        """The same with those arrays again, from what of the scene it was made of."""
        return self

    def in_band(self, grid: Any) -> Medium:
        """What `seen_by` made, with what it needs of the grid of a band (`access.grid.Grid`); by default as it is."""
        return self

    def for_means(self) -> Medium:
        """The same with what means between borders read of it, made once, outside of loops; by default as it is."""
        return self

    def faults(self) -> Int[Array, ""]:
        """What is wrong with the numbers of a medium that `seen_by` made, as a fault word; by default nothing."""
        return jnp.int32(faults.NONE)

    @abc.abstractmethod
    def occupied(self, slabs: Any) -> Bool[Array, "slabs bundles"]:
        """Where any of it may be: slabs of samples that are to be marched for it.

        Args:
            slabs: `access.grid.SlabExtents`, boxes in view space around the slabs of a band.
        """

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

    def optics(self, gathered: Any, task: Any) -> list[Float[Array, "tasks samples rays"]]:
        """Red, green, blue and extinction at the samples of slabs, by `extinction` and `colors`."""
        extinction, samples = self.extinction(gathered, task)
        return [jnp.broadcast_to(value, task.shape) for value in (*self.colors(samples, task, COLORS), extinction)]

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

    def no_cotangents(self) -> Any:
        """Where cotangents are added up, by `pull`: by default, those of the medium's leaves."""
        return jax.tree.map(jnp.zeros_like, self)

    def pull(
        self, total: Total, gathered: Any, task: Any, cotangents: list[Array], of_stops: Stops | None = None
    ) -> tuple[Total, OfPlaces]:
        """Cotangents of `optics`, pulled back: of red, green, blue and extinction of samples.

        By default by differentiating `gather`, `extinction` and `colors`.

        Args:
            total: of the slabs before, see `no_cotangents`.
            of_stops: cotangents of where rays end, of media that `stops_rays`.

        Returns:
            `total` with those of these slabs, and those of where samples are.
        """

        def optics(medium: Medium, places: OfPlaces) -> list[Array]:
            moved = dataclasses.replace(
                task, depth=places.depth, border=places.border, u=task.u * places.factor, v=task.v * places.factor
            )
            gathered = medium.gather(moved)
            stops = () if of_stops is None else medium.stops(gathered, moved)
            return [*medium.optics(gathered, moved), *stops]

        there = OfPlaces(task.depth, task.border, jnp.ones_like(task.depth[0, 0]))
        of_medium, of_places = jax.vjp(optics, self, there)[1]([*cotangents, *(of_stops or ())])
        return added(total, of_medium), of_places

    def apart(self, total: Any) -> tuple[Any, dict[str, Array]]:
        """What was added up: cotangents of the medium's leaves, and of the grid's particles by name, by default of none."""
        return total, {}


def added(total: Total, more: Any) -> Total:
    """Cotangents, with more of the same; what has none stays as it is."""
    leaves = zip(jax.tree.leaves(total), jax.tree.leaves(more), strict=True)
    sums = [value if other.dtype == jax.dtypes.float0 else value + other for value, other in leaves]
    return jax.tree.unflatten(jax.tree.structure(total), sums)  # type: ignore[no-any-return]
