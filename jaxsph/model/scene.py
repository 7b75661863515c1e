"""Scene: the parts that are looked at. A part that is absent is `None` and is neither traced nor paid for."""

from __future__ import annotations

import dataclasses

import jax

from jaxsph.model.medium import Medium
from jaxsph.model.particles import Particles
from jaxsph.model.transfer import TransferFunction


@dataclasses.dataclass(frozen=True)
class Scene:
    """Particles and what their quantity looks like.

    Attributes:
        particles: the particle set.
        transfer: maps its quantity to colour and extinction.
        media: other media in the same rays, see `docs/extending.md`; extinctions add up, and colours weigh by extinction.
    """

    particles: Particles
    transfer: TransferFunction
    media: tuple[Medium, ...] = ()

    def __post_init__(self) -> None:
        for name, kind in (("particles", Particles), ("transfer", TransferFunction)):
            value = getattr(self, name)
            if isinstance(value, str | int | float | tuple | list | dict):
                raise ValueError(f"`{name}` must be a `jaxsph.{kind.__name__}`, got {type(value).__name__}")
        media = self.media if isinstance(self.media, tuple) else (self.media,)
        if isinstance(self.media, Medium) or any(isinstance(medium, str | int | float | list | dict) for medium in media):
            raise ValueError(f"`media` must be a tuple of media (`jaxsph.model.medium.Medium`), got {self.media!r}")


jax.tree_util.register_dataclass(Scene, data_fields=["particles", "transfer", "media"], meta_fields=[])
