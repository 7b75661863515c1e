r"""Slices: the field of particles on a plane, or a plain sum over them.

Flow: particles, plane -> projection: see -> lists of bundles -> sum -> [slices] -> Slice -> files.

A plane is seen as a projection sees particles along parallel rays, but that kernels themselves are summed, where rays meet it.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import os
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxsph.analysis.at_places import rounded
from jaxsph.analysis.projection.columns import PLANE as ON_PLANE
from jaxsph.analysis.projection.project import summed
from jaxsph.engine.runtime.clock import Clock
from jaxsph.io.images.planes import PlaneAxes, middle_of, names_of, write_slice
from jaxsph.model.camera.camera import Camera, require_size
from jaxsph.model.clips import Clip, Plane, inside
from jaxsph.model.image import PLANE, Image, dataset, figure_of, places
from jaxsph.model.particles.columns import held_by, require_usable, values_held
from jaxsph.model.particles.field import ParticleField
from jaxsph.model.particles.particles import Particles
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.transfer.maps import colors_at
from jaxsph.numerics import __version__
from jaxsph.numerics.checks import array_of, in_unit, vector_of
from jaxsph.numerics.trees import kind_of, line_of, on_host, span_of

ALONG = 0.9  # cosine of the angle to x or y, from which a normal is along it
SLACK = 32  # eps of coordinates that a depth may be off by


@dataclasses.dataclass(frozen=True)
class Slice:
    """The field on a plane; made by `slice`. Row 0 is the top, column 0 the left.

    Attributes:
        values: the quantity Q, float32 or float64, NaN outside of every support; or a plain sum, NaN where nothing is shown.
        camera: orthographic, with its eye in the middle of the slice, looking against the plane's normal.
        metadata: strings and numbers for the file header.
        length_unit: what the unit of lengths is called; empty where it is not known.
    """

    values: Float[np.ndarray, "height width"]
    camera: Camera
    metadata: tuple[tuple[str, Any], ...] = ()
    length_unit: str = ""

    def __repr__(self) -> str:
        return line_of("Slice", kind_of(self.values), f"values {span_of(self.values)}")

    @property
    def pixel_size(self) -> float:
        """Of a pixel's side, length units."""
        return 2 * float(self.camera.half_height) / self.camera.height

    def positions(self) -> Float[np.ndarray, "height width 3"]:
        """Places of all values, float64, length units."""
        across, down = np.meshgrid(*self.camera.exact_rays())
        return self.camera.exact_world(np.stack([across, down, np.zeros_like(across)], -1))

    def image(self, transfer: TransferFunction) -> Image:
        """A picture by the colours of a transfer function, opaque wherever there is a value."""
        there = np.isfinite(self.values)
        filled = np.where(there, self.values, 0)
        colors = np.asarray(transfer.colors, np.float64)
        shown: Any = colors_at(filled, np.asarray(transfer.values, np.float64), colors)
        color = np.where(there[..., None], shown, 0).astype(np.float32)
        transmittance, nothing = np.where(there, 0, 1).astype(np.float32), np.zeros(there.shape, np.float32)
        depth: Any = np.where(there, 0, np.inf).astype(np.float32)
        return Image(color, transmittance, depth, nothing, nothing, True, 0, {}, self.metadata)  # type: ignore[arg-type]

    def figure(self, transfer: TransferFunction | None = None, **more: Any) -> Any:
        """A figure of matplotlib with a colour bar and a scale bar; `more` as for `jaxsph.plot.image_figure.image_figure`."""
        return figure_of(self, transfer=transfer, **more)

    def save(self, path: str | os.PathLike[str], transfer: TransferFunction | None = None) -> None:
        """Write `.npy` or `.fits` (values), `.exr` (values, and colours where a transfer function is given) or `.png` (colours).

        Raises:
            ValueError: another suffix, a `.png` without a transfer function, a place that cannot be written to.
        """
        axes = PlaneAxes(self.pixel_size, middle_of(self.camera), self.length_unit, names_of(self.camera))
        write_slice(Path(path), self.values, None if transfer is None else self.image(transfer), self.metadata, axes)

    def to_xarray(self) -> Any:
        """Values as an `xarray.Dataset` over `row` and `column`, with coordinates `x` and `y`; metadata are its attributes.

        These are coordinates along the directions that are to the right and upwards: of a plane along z the x and y of positions.

        Raises:
            ImportError: xarray is not installed.
        """
        height, width = self.values.shape
        where = places((height, width), self.pixel_size, middle_of(self.camera), self.length_unit)
        return dataset({"values": (PLANE, self.values)}, where, self.metadata)


@on_host
def slice(
    particles: Particles,
    plane: Plane,
    *,
    within: Clip | None = None,
    center: Any = None,
    up: Any = None,
    view_height: float | None = None,
    width: int = 512,
    height: int = 512,
    of: Any = None,
    normalised: bool = True,
) -> Slice:
    """The field of particles on a plane, or a plain sum over them.

    Args:
        particles: whose quantity is shown; of a periodic set one period.
        plane: a `jaxsph.Plane`, seen from where its normal points to: of one along z, x is to the right and y upwards.
        within: where it is shown; default everywhere.
        center: (3,) what is in the middle, moved to the plane; default the middle of the particles.
        up: (3,) direction that points upwards; default y, or z where the normal is along x or y.
        view_height: visible height, length units; default all of the particles.
        width, height: size in pixels.
        of, normalised: as for `jaxsph.sample`: the plain sum of masses is the density. There is none outside of a period or of
            `within`, and it is 0 outside of every support.

    Raises:
        ValueError: arguments out of range, particles that cannot be rendered.
    """
    require_size(width, height)
    unit, normal = particles.length_unit, np.asarray(plane.normal, np.float64)
    point = np.asarray(plane.point, np.float64) + np.asarray(plane.rest, np.float64)
    center, view_height = in_unit("center", center, unit), in_unit("view_height", view_height, unit)
    if up is None:
        up = np.eye(3)[2 if np.abs(normal[:2]).max() > ALONG else 1]
    lower, upper = particles.bounds() if center is None or view_height is None else np.zeros((2, 3))
    middle = (lower + upper) / 2 if center is None else vector_of("center", center)
    foot = middle - ((middle - point) @ normal) * normal
    behind = foot - normal * 2.0 ** np.frexp(np.abs(foot).max())[1]  # however far from the origin, another place
    if view_height is None:
        axes = np.asarray(Camera.orthographic(foot, behind, up, 1.0, width, height, near=-1.0, far=1.0).axes, np.float64)
        corners = np.stack(np.meshgrid(*zip(lower, upper, strict=True), indexing="ij"), -1).reshape(-1, 3) - foot
        reach = np.abs(corners @ axes.T).max(0)
        view_height = 2 * max(float(reach[0]) * height / width, float(reach[1])) or 1.0
    deep = view_height / height
    camera = Camera.orthographic(foot, behind, up, view_height, width, height, near=-deep, far=deep)
    said = ("jaxsph.slice", f"point={point.tolist()} normal={normal.round(9).tolist()}")
    metadata = (("jaxsph.version", __version__), said, ("jaxsph.camera", camera.describe()))
    found = Slice(np.zeros((height, width)), camera, metadata, unit or "")
    values = _on_plane(particles, camera, of, normalised)
    for clip in filter(None, (particles.box, within)):
        values = np.where(inside(clip, found.positions()), values, np.nan)
    return dataclasses.replace(found, values=values)


def _on_plane(particles: Particles, camera: Camera, of: Any, normalised: bool) -> Float[np.ndarray, "height width"]:
    """What a camera sees at depth 0.

    Particles are given as it sees them, in pixels from the middle and with what rounding has left of that, so that float32 has
    distances to a few eps of a support. Means are those of values less their middle, of which it has more digits.
    """
    require_usable(particles)
    entry, view, support = _meeting(particles, camera)
    values = values_held(particles, "of", ("quantity" if normalised else "volume") if of is None else of)[entry]
    ends = (np.min(values), np.max(values)) if normalised and len(values) else (0.0, 0.0)
    middle = ends[0] / 2 + ends[1] / 2
    pixel, kind = 2 * float(camera.half_height) / camera.height, functools.partial(np.asarray, dtype=particles.dtype)
    exact = view * (1, 1, -1) / pixel  # depths go against the normal
    seen = Particles.from_arrays(kind(exact), kind(support / pixel), 0.0, 1.0, particles.kernel)
    rest = np.pad(exact - kind(exact).astype(np.float64), ((0, seen.capacity - len(exact)), (0, 0)))
    seen = dataclasses.replace(seen, position_rest=array_of(rest, particles.dtype))
    origin, ahead, up = kind([[0, 0, 0], [0, 0, -1], [0, 1, 0]])
    depths = {"near": kind(-camera.height), "far": kind(camera.height)}
    own = Camera.orthographic(origin, ahead, up, kind(camera.height), camera.width, camera.height, **depths)
    held = held_by(seen, values - middle, np.asarray(particles.volume, np.float64)[entry] if normalised else None)
    sums, *_ = summed(Clock(), seen, own, held.amounts, ON_PLANE)
    first, *weights = (np.asarray(one, np.float64) for one in sums)
    if not normalised:
        return rounded(first / pixel**3, held.exponents[0], particles.dtype)
    (weight,) = weights
    means = np.divide(first, weight, out=np.full(weight.shape, np.nan), where=weight > 0)
    means = middle + np.ldexp(means, held.exponents[0] - held.exponents[1])
    return rounded(np.clip(means, *ends), 0, particles.dtype)  # no mean is beyond, but for rounding


def _meeting(particles: Particles, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Particles whose supports meet what a camera sees at depth 0, with all copies of a periodic set that reach into its box.

    Entries, view coordinates and supports, in float64. Those whose supports are elsewhere by far are left out beforehand.
    """
    known, forward, eye = jax.tree.map(np.asarray, particles), camera.exact_axes()[2], camera.exact_eye()
    position, support, turned = known.position, known.support, np.zeros(1)
    if known.box is not None:
        lower, upper = known.box.corners()
        most = np.ceil(support.max(where=known.valid, initial=0) / (upper - lower)).astype(int)
        turned = np.unique(np.array(list(itertools.product(*(range(-k, k + 1) for k in most)))) @ ((upper - lower) * forward))
        position = lower + (known.exact_position() - lower) % (upper - lower)
    depth = position @ forward.astype(position.dtype) - eye @ forward
    slack = SLACK * np.finfo(known.dtype).eps * (np.abs(position).max(initial=0) + np.abs(eye).max() + np.abs(turned).max())
    near = np.zeros(len(depth), bool)
    for turn in turned:
        near |= np.abs(depth + turn) < support + slack
    entry = np.flatnonzero(near & known.valid)
    field = ParticleField(known.at(entry), signed=True)
    view, half = camera.exact_view(field.position), float(camera.half_height)
    sides = half * camera.width / camera.height, half, 0.0
    meets = (np.abs(view) < np.asarray(sides) + field.support[:, None]).all(1)
    return entry[field.entry[meets]], view[meets], field.support[meets]
