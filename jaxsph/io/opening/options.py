"""What may be said of a picture of a file, in four groups that Python and the command line share.

Flow: arguments, options of a command -> [options: Source, Look, View] -> opening -> Scene, Camera.

What is `None` is chosen by the data.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxsph.model.clips import Clip
from jaxsph.model.scene import Surface
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.transfer.looks import PRESETS
from jaxsph.model.transfer.maps import DOMAINS

VIEWS = ("iso", "x", "y", "z", "face-on", "edge-on")
AROUND = ("densest", "mass")
MAX_STOPS = 30.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Source:
    """Which quantities and particles of a file are shown.

    Attributes:
        color_by: quantity that colours are looked up by, as `jaxsph info` lists them, or `log10:NAME`; of a volume, which of its
            values.
        opacity_by: quantity that extinction is looked up by.
        support: support radius in the file's lengths, > 0, of all particles; or an expression of columns, as `"2*h"`.
        kernel: name of the smoothing kernel.
        part_type: which type of particles of a file that has several.
        box: "file" for the file's periodic box, None for none, or three sides.
        where: a condition on the particles that are shown (`jaxsph.io.settle.where`).
        share: of the particles, in (0, 1], taken at random.

    Raises:
        ValueError: a support that is not positive.
    """

    color_by: str | None = None
    opacity_by: str | None = None
    support: float | str | None = None
    kernel: str | None = None
    part_type: int | None = None
    box: Any = "file"
    where: str | None = None
    share: float | None = None

    def __post_init__(self) -> None:
        if isinstance(self.support, int | float) and not (np.isfinite(self.support) and self.support > 0):
            raise ValueError(f"`support` must be > 0, got {self.support:g}")

    @property
    def how(self) -> tuple[float | str | None, str | None]:
        """Support and kernel, as `jaxsph.io.particles_from_table` takes them."""
        return self.support, self.kernel

    @property
    def which(self) -> dict[str, Any]:
        """The part of all particles that is shown, as the same takes it."""
        return {"box": self.box, "where": self.where, "share": self.share}

    @property
    def of_particles(self) -> tuple[str, ...]:
        """Names of what was said that only particles have."""
        own = {"box": "file"}
        names = ("opacity_by", "support", "kernel", "part_type", "box", "where", "share")
        return tuple(name for name in names if getattr(self, name) != own.get(name))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Look:
    """Colours and opacity.

    Attributes:
        colormap: its name.
        norm: where on the axis of the quantity colours sit, one of `DOMAINS`.
        range: low and high end of the colours, in units of the quantity.
        preset: kind of data, one of `PRESETS`; None is found by the name of the quantity.
        transfer: a transfer function, or the file of one, which says all of it: nothing else goes with it but `exposure`.
        exposure: stops by which extinction is larger (2 to this power) than what is fitted to the picture.
        optical_depth: of typical columns, > 0, instead of what is fitted to the picture.
        surface: particles are shown by their surface, where their coverage first crosses this level (`jaxsph.Surface`), or all of
            a `jaxsph.Surface`; colours are as chosen here, and opacity is of no meaning. False shows them as a medium. None is
            the surface of liquids (see `jaxsph.io.opening.looks`), unless their opacity or a clip was asked for, and a medium
            of all else.
        surface_of: quantity whose level the surface is, in place of the coverage: an attribute or density, not negative. With it
            a level is chosen where none is given.

    Raises:
        ValueError: a name that is unknown; a range that does not ascend; what excludes each other.
    """

    colormap: str | None = None
    norm: str | None = None
    range: tuple[float, float] | None = None
    preset: str | None = None
    transfer: TransferFunction | str | os.PathLike[str] | None = None
    exposure: float = 0.0
    optical_depth: float | None = None
    surface: Any = None
    surface_of: str | None = None

    def __post_init__(self) -> None:
        if self.surface_of is not None and self.surface is False:
            raise ValueError("`surface_of` is of a surface, and `surface` says that there is none; leave out one of them")
        if self.surface not in (None, False) and not isinstance(self.surface, Surface):
            Surface(self.surface)  # which checks its level
        for name, known in (("norm", DOMAINS), ("preset", PRESETS)):
            value = getattr(self, name)
            if value is not None and value not in known:
                raise ValueError(f"`{name}` must be one of {', '.join(known)}, got {value!r}")
        if self.range is not None and not (np.isfinite(self.range).all() and self.range[0] < self.range[1]):
            raise ValueError(f"`range` must be two finite numbers that ascend, got {self.range[0]:g} and {self.range[1]:g}")
        if not abs(self.exposure) <= MAX_STOPS:
            raise ValueError(f"`exposure` must be stops between {-MAX_STOPS:g} and {MAX_STOPS:g}, got {self.exposure:g}")
        depth = self.optical_depth
        if depth is not None and not (np.isfinite(depth) and depth > 0):
            raise ValueError(f"`optical_depth` must be > 0, got {depth:g}")
        if self.transfer is not None and self.said:
            raise ValueError(f"`transfer` says all of a look: leave out `{self.said[0]}`, or edit the transfer function")

    @property
    def said(self) -> tuple[str, ...]:
        """Names of what was asked for besides a transfer function."""
        return tuple(name for name in ("colormap", "norm", "range", "preset", "optical_depth") if getattr(self, name) is not None)


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
    """From where, how much of it, and how large.

    Attributes:
        center: what is in the middle of the picture: x, y and z in the file's lengths; "densest" or "mass".
        width: across the picture at the middle, a length of the file or with a unit, as `"30 kpc"`. What is farther than that
            from the middle is left out, unless clips are given.
        view: "x", "y" or "z": parallel rays along an axis, from above along that which is up; "face-on" or "edge-on": parallel
            rays along or across the angular momentum; "iso": perspective from obliquely above.
        eye, target: of a perspective view from a place.
        up: which way is up in the picture; None is z for files of codes that have it so, as Phantom and DualSPHysics do, else y.
        fov_degrees: vertical field of view of a perspective view, in (0, 180).
        size: width and height in pixels.
        clips: parts of space that are shown, all of them together; None leaves `width` to choose, () shows everything.
        frame_all: every support is in the picture, however far it lies from the rest.

    Raises:
        ValueError: a name that is unknown, a width that is not positive, what excludes each other.
    """

    center: Any = None
    width: Any = None
    view: str | None = None
    eye: Sequence[float] | None = None
    target: Sequence[float] | None = None
    up: Sequence[float] | None = None
    fov_degrees: float | None = None
    size: tuple[int, int] = (512, 512)
    clips: tuple[Clip, ...] | None = None
    frame_all: bool = False

    def __post_init__(self) -> None:
        if self.view is not None and self.view not in VIEWS:
            raise ValueError(f"`view` must be one of {', '.join(VIEWS)}, got {self.view!r}")
        place = np.zeros(3) if self.center is None or (isinstance(self.center, str) and self.center in AROUND) else self.center
        if isinstance(place, str) or np.shape(place) != (3,) or not np.isfinite(np.asarray(place, np.float64)).all():
            raise ValueError(f"`center` must be x, y and z, or one of {', '.join(AROUND)}, got {self.center!r}")
        if self.eye is not None:
            for name in ("width", "view", "frame_all"):
                if getattr(self, name):
                    raise ValueError(f"`eye` and `{name}` exclude each other: one places the eye, the other has it placed")
        if self.target is not None and self.eye is None:
            raise ValueError("`target` needs `eye`: from where should it be looked at? `center` puts a place in the middle")
        if self.fov_degrees is not None and self.view in VIEWS[1:]:
            raise ValueError(f"`fov_degrees` is of perspective views, and the rays of view {self.view!r} are parallel")
        if self.frame_all and self.width is not None:
            raise ValueError("`frame_all` and `width` exclude each other: one shows everything, the other so much")
