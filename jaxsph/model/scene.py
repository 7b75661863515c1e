"""Scene: the parts that are looked at. A part that is absent is `None` and is neither traced nor paid for."""

from __future__ import annotations

import dataclasses

import jax

from jaxsph.model.particles import Particles
from jaxsph.model.transfer import TransferFunction


@dataclasses.dataclass(frozen=True)
class Scene:
    """Particles and what their quantity looks like.

    Attributes:
        particles: the particle set.
        transfer: maps its quantity to colour and extinction.
    """

    particles: Particles
    transfer: TransferFunction

    def __post_init__(self) -> None:
        for name, kind in (("particles", Particles), ("transfer", TransferFunction)):
            value = getattr(self, name)
            if isinstance(value, str | int | float | tuple | list | dict):
                raise ValueError(f"`{name}` must be a `jaxsph.{kind.__name__}`, got {type(value).__name__}")


jax.tree_util.register_dataclass(Scene, data_fields=["particles", "transfer"], meta_fields=[])
