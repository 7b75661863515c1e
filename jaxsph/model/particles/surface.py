r"""Surface: where the coverage of particles reaches a level, as fluids are drawn.

Flow: user -> [surface] -> scene -> viewing -> media.

$\sum V_j W_j(x)$ of kernels of unit integral is about 1 within a fluid, and falls to 0 over a support outside of it. Where it is
a half lies the surface of the fluid, but for the curvature of thin parts.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.spatial

from jaxsph.model.particles import kernels
from jaxsph.model.particles.particles import Particles
from jaxsph.numerics.checks import is_traced, require_finite, require_positive, require_shape
from jaxsph.numerics.trees import tree

FIELDS = ("coverage",)
MOST_CENTERS = 256
COLOR, AMBIENT = (0.42, 0.66, 0.86), 0.3
"""Of a surface that no transfer function colours: that of water; and what it has of it where it is seen edge on."""


@tree(static=("of",), unchecked=True)
class Surface:
    r"""The surface of a scene's particles: where a ray first crosses a level of their coverage; `Scene(surface=...)`.

    The field is $C(x) = \sum_j V_j W(|x - x_j|, s H_j)$ with kernels of unit integral, supports H and `smoothing` s. The
    surface is opaque, and particles are shown by it alone: there is no fog of them. It is lit from the eye (Lambert):
    $c \, (a + (1 - a) \, |n \cdot d|)$, with d the ray's direction, a the share of ambient light and n along the gradient of C.
    Its colour c is that of the scene's transfer function, at the quantity that particles interpolate there; without one `color`.

    **What is found.** Every crossing between neighbouring samples of a ray (`Settings.samples`), to rounding: see
    `jaxsph.engine.media.particle_surface`, which says what of thin parts is found between samples, and what is an estimate.

    **Derivatives** by positions, supports, volumes, quantities, level, smoothing and camera are those of an implicit function, of
    depth, normal and colour alike. Silhouettes have none: a ray that stops meeting the surface is not foreseen.

    Nothing closes a fluid where a clip cuts it or a ray begins in it: there the first crossing is where the ray leaves it.

    Attributes:
        level: of the coverage, > 0. A half is halfway between fluid and nothing; a droplet of one particle has
            $V W(0, s H)$ at its centre, and shows at lower levels alone.
        of: the field, `"coverage"` (static).
        smoothing: what supports are multiplied by, > 0: 1.5 to 2 evens out bumps of single particles, and takes away droplets.
        color: red, green and blue (3,) in [0, 1], where there is no transfer function.
        ambient: share of the colour that the surface has where it is seen edge on, in [0, 1].

    Raises:
        ValueError: a level or a smoothing that is not > 0 and finite, another field, a colour or a share outside of [0, 1].
    """

    level: Any = 0.5
    of: str = "coverage"
    smoothing: Any = 1.0
    color: Any = COLOR
    ambient: Any = AMBIENT

    def __post_init__(self) -> None:
        if self.of not in FIELDS:
            raise ValueError(f"`of` must be one of {', '.join(map(repr, FIELDS))}, got {self.of!r}")
        shapes: dict[str, tuple[int, ...]] = {"level": (), "smoothing": (), "color": (3,), "ambient": ()}
        for name, shape in shapes.items():
            value = getattr(self, name)
            require_shape(name, value, shape, "give red, green and blue" if shape else "give one number")
            if is_traced(value):
                continue
            number = np.asarray(value, np.float64)
            require_finite(name, number, "give a finite number")
            if name in ("level", "smoothing"):
                require_positive(
                    name, number, "coverage is 0 away from a fluid" if name == "level" else "1 takes supports as given"
                )
            elif not ((number >= 0) & (number <= 1)).all():
                raise ValueError(f"`{name}` must lie in [0, 1], got {value}")


def coverage_at_centers(particles: Particles, most: int = MOST_CENTERS) -> np.ndarray:
    r"""$\sum V_j W_j$ at the centres of some particles, at most so many, evenly out of all; nothing without any (host side)."""
    real = np.asarray(particles.valid)
    position, support, volume = (
        np.asarray(column, np.float64)[real] for column in (particles.position, particles.support, particles.volume)
    )
    if not len(position):
        return np.zeros(0)
    centers = position[:: -(-len(position) // most)]
    near = scipy.spatial.cKDTree(position).query_ball_point(centers, support.max())
    kernel = kernels.by_name(particles.kernel)

    def at(center: np.ndarray, here: list[int]) -> float:
        square = ((position[here] - center) ** 2).sum(1) / support[here] ** 2
        return float((volume[here] / support[here] ** 3 * kernel.norm * kernel.of_square(square, np)).sum())

    return np.array([at(*one) for one in zip(centers, near, strict=True)])
