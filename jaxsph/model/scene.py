"""Scene: the parts that are looked at. A part that is absent is `None` and is neither traced nor paid for."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jaxsph.model.medium import Medium
from jaxsph.model.particles import NOTHING, Particles
from jaxsph.model.transfer import TransferFunction
from jaxsph.model.volume import Volume

PAIRS = (("particles", "transfer"), ("volume", "volume_transfer"))


@dataclasses.dataclass(frozen=True)
class Scene:
    """What is in a scene, and what its quantities look like.

    Attributes:
        particles: the particle set.
        transfer: maps its quantity to colour and extinction; given with particles, and only then.
        media: other media in the same rays, see `docs/extending.md`; extinctions add up, and colours weigh by extinction.
        volume: a quantity on a regular grid, rendered as a medium that shares the rays.
        volume_transfer: maps it to colour and extinction; given with a volume, and only then.
    """

    particles: Particles | None = None
    transfer: TransferFunction | None = None
    media: tuple[Medium, ...] = ()
    volume: Volume | None = None
    volume_transfer: TransferFunction | None = None

    def __post_init__(self) -> None:
        kinds = {"particles": Particles, "transfer": TransferFunction, "volume": Volume, "volume_transfer": TransferFunction}
        for name, kind in kinds.items():
            value = getattr(self, name)
            if isinstance(value, str | int | float | tuple | list | dict):
                raise ValueError(f"`{name}` must be a `jaxsph.{kind.__name__}`, got {type(value).__name__}")
        media = self.media if isinstance(self.media, tuple) else (self.media,)
        if isinstance(self.media, Medium) or any(isinstance(medium, str | int | float | list | dict) for medium in media):
            raise ValueError(f"`media` must be a tuple of media (`jaxsph.model.medium.Medium`), got {self.media!r}")

    def check(self) -> None:
        """Raise `ValueError` where there is nothing to look at, or a part without what it looks like."""
        for part, look in PAIRS:
            if (getattr(self, part) is None) != (getattr(self, look) is None):
                missing, given = (look, part) if getattr(self, look) is None else (part, look)
                raise ValueError(f"`{missing}` must be given with `{given}`, got None; give both to `jaxsph.Scene`, or neither")
        if self.particles is None and self.volume is None and not self.media:
            raise ValueError("`particles`, `volume` and `media` are all absent; give `jaxsph.Scene` something to look at")

    @property
    def dtype(self) -> Any:
        """float32, or float64 if particles or volume are."""
        given = [part.dtype for part in (self.particles, self.volume) if part is not None]
        return jnp.result_type(*given) if given else jnp.dtype(jnp.float32)

    @property
    def particle_set(self) -> Particles:
        """The particles; where there are none, a set of no particles in arrays of one entry."""
        if self.particles is not None:
            return self.particles
        entry: dict[str, Any] = {name: jnp.full(1, value, self.dtype) for name, value in NOTHING.items()}
        return Particles(**entry | {"position": jnp.zeros((1, 3), self.dtype)}, valid=jnp.zeros(1, bool))


jax.tree_util.register_dataclass(
    Scene, data_fields=["particles", "transfer", "media", "volume", "volume_transfer"], meta_fields=[]
)
