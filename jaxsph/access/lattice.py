"""The lattice of nodes that neighbouring bundles share: sums over particles, for all samples between to be interpolated from.

Flow: grid -> [lattice] -> control, cast.

Sums over particles are as smooth as the kernel, whatever the transfer function makes of their ratio. So nodes are every
`NODE_PIXELS`-th ray and every `NODE_SAMPLES`-th fine sample, a small part of all samples.
"""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
from jaxtyping import Array, Float

NODE_PIXELS = 4
NODE_SAMPLES = 2


@dataclasses.dataclass(frozen=True)
class Lattice:
    """Sums at the nodes of a band, up to one common factor.

    Attributes:
        weight: of V W.
        weighted: of (q - origin) V W.
        origin: a quantity amid the particles'.
        evaluations: kernel evaluations that the nodes took, for each ray of a bundle.
    """

    weight: Float[Array, "deep down across"]
    weighted: Float[Array, "deep down across"]
    origin: Float[Array, ""]
    evaluations: Float[Array, " bundles"]


def between(cells: int, every: int) -> Float[np.ndarray, "points nodes"]:
    """Weights of the cubic through the nearest four nodes, for points that divide `cells` cells by `every`.

    Nodes begin one before the first cell and end one after the last.
    """
    table = np.zeros((cells * every, cells + 3))
    for point in range(cells * every):
        cell, t = point // every, point % every / every
        table[point, cell : cell + 4] = (
            -t * (t - 1) * (t - 2) / 6, (t + 1) * (t - 1) * (t - 2) / 2, -(t + 1) * t * (t - 2) / 2, (t + 1) * t * (t - 1) / 6
        )  # fmt: skip
    return table


jax.tree_util.register_dataclass(Lattice, data_fields=[field.name for field in dataclasses.fields(Lattice)], meta_fields=[])
