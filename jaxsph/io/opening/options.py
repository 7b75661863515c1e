"""What may be said of a picture of a file, in three groups that Python and the command line share, each option said once.

Flow: arguments, words of a command -> [options: Source, Look, View] -> opening -> Scene, Camera.

What is `None` is chosen by the data. An option is a field of a group that carries its word: what the command line makes of it.
"""

from __future__ import annotations

import dataclasses
import math
import os
import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from jaxsph.io.opening import values
from jaxsph.io.opening.rest_frame import FRAMES
from jaxsph.io.opening.values import AROUND, HEAD, VIEWS, Reader
from jaxsph.io.table import CodeUnit
from jaxsph.io.units import own_length
from jaxsph.model.clips import Clip
from jaxsph.model.particles.kernels import KERNELS
from jaxsph.model.scene import Surface
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.transfer.maps import COLORMAPS, DOMAINS
from jaxsph.model.transfer.presets import PRESETS

DATA, CAMERA, LOOK = "Data", "Camera", "Look"  # kinds of options, by which a person finds them
MAX_STOPS = 30.0
OF_SURFACE = "smoothing", "light", "occlusion", "antialias"
MEASURE = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")
COLORED = "an attribute, density, speed, x, y, z, velocity.los, an expression, or log10:NAME; of a volume, its values"
TYPES = (
    "gas, dm, disk, bulge, stars, bh, sinks or a number (default: gas, else the first); more, each with a colour or a "
    "colour map, lie beside it, as gas:inferno,stars:white; columns and slices sum all of them"
)
MAPS = f"{', '.join(COLORMAPS)}, or any of cmap's, as cmocean:thermal (default: by the quantity)"
WIDTHS = "across the picture, as 30 or 30kpc, or all (default: what is lit; all of columns and planes)"
SEEN = f"from where: {', '.join(VIEWS)}, or as X,Y,Z points, by parallel rays (default iso, flat things face-on; z of planes)"
CLIPPED = (
    "what is in box:X0,Y0,Z0,X1,Y1,Z1, sphere:X,Y,Z,R or on a side, plane:X,Y,Z,NX,NY,NZ; outside with ~ before it; "
    "may be repeated; or none"
)


def option(
    default: Any,
    metavar: str,
    read: Reader | None,
    group: str,
    help: str,
    *names: str,
    show: bool = True,
    several: Callable[[list[Any]], Any] | None = None,
) -> Any:
    """A field with its word: how the option is said.

    Args:
        default: where nothing is said.
        metavar: its value, for people; of numbers that may be words of their own, each of them.
        read: what makes a value of text; None where there is none, as saying it is all.
        group: its kind.
        help: what it means.
        names: how it is called, where that is not as its field is.
        show: whether help lists it; what is seldom wanted is read alone.
        several: what makes one value of all that are given, where it may be repeated.
    """
    said = {"metavar": metavar, "read": read, "group": group, "help": help, "names": names, "show": show, "several": several}
    return dataclasses.field(default=default, metadata=said)


def choice(default: Any, known: Iterable[str], group: str, help: str, more: str = "", **how: Any) -> Any:
    """One whose value is one of some names, which its help lists, with `more` behind them."""
    names = tuple(known)
    return option(default, "NAME", values.one_of(names), group, f"{help}: {', '.join(names)}{more}", **how)


def flag(group: str, help: str, *names: str, show: bool = True) -> Any:
    """One without a value."""
    return option(False, "", None, group, help, *names, show=show)


def _of(group: str) -> Callable[..., Any]:
    """What makes options of one kind, of which nothing said is `None`, unless there is another default."""
    return lambda metavar, read, help, *names, default=None, **how: option(default, metavar, read, group, help, *names, **how)


data, camera, look = map(_of, (DATA, CAMERA, LOOK))


def length_of(value: Any, name: str, unit: CodeUnit | None) -> tuple[float, str | None]:
    """A length, > 0, in the unit that a file states for its own, if it does, and how its own unit was understood.

    Raises `ValueError`: no positive length; a unit that is not one of length, or where the file does not state its own.
    """
    match = MEASURE.fullmatch(value) if isinstance(value, str) else None
    if isinstance(value, str) and match is None:
        raise ValueError(f"`{name}` must be a length, such as 30 or '30 kpc', got {value!r}")
    number, wanted = (float(match[1]), match[2]) if match else (float(value), "")
    if not (math.isfinite(number) and number > 0):
        raise ValueError(f"`{name}` must be > 0 and finite, got {value!r}")
    if not wanted:
        return number, None
    length, called = own_length(value, name, number, wanted, unit)
    return length, f"{number:g} {called}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Source:
    """Which quantities and particles of a file are shown; lengths are the file's.

    `support` is > 0, of all particles, or an expression of columns, as `"2*h"`; `box` is "file" for the file's own, None for
    none, or three sides; `where` is a condition (`jaxsph.io.settle.where`); a `share` in (0, 1] is taken at random.

    Raises `ValueError`: a support that is not positive.
    """

    color_by: str | None = data("NAME", str, COLORED, "--color-by", "--quantity")
    opacity_by: str | None = data("NAME", str, "the same for opacity alone (default: density where it spreads)")
    support: float | str | None = data(
        "H", values.number_or_name, "radius, or as 100pc, or 2*h of columns (default: the file's, or found)"
    )
    kernel: str | None = choice(None, KERNELS, DATA, "smoothing kernel", " (default: the file's)", show=False)
    part_type: int | str | None = data("TYPE[:LOOK],...", str, TYPES)
    box: Any = data(
        "LX,LY,LZ",
        values.measured(values.box),
        "sides of a periodic box, or none (default: the file's)",
        "--box-size",
        default="file",
    )
    where: str | None = data("CONDITION", str, 'such as "Temperature > 1e4 and Density < 2"; names as `jaxsph info` has them')
    share: float | None = data("S", values.number, "of the particles, as 0.1, for a quick look: their field is another one")

    frame: str | None = choice(None, FRAMES, DATA, "whose mean velocity is taken out of all")
    physical: bool = flag(DATA, "take scale factor and Hubble parameter out of numbers of a cosmological file")

    def __post_init__(self) -> None:
        if isinstance(self.support, int | float) and not (np.isfinite(self.support) and self.support > 0):
            raise ValueError(f"`support` must be > 0, got {self.support:g}")

    @property
    def types(self) -> list[tuple[int | str | None, str | None]]:
        """The types of particles that are shown, the first as a medium, each with the look that is asked for."""
        if not isinstance(self.part_type, str):
            return [(self.part_type, None)]
        parts = (one.partition(":") for one in self.part_type.split(","))
        return [(name.strip(), look or None) for name, _, look in parts]

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
        fields = dataclasses.fields(Source)[1:]
        return tuple(field.name for field in fields if getattr(self, field.name) != field.default)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Look:
    """Colours and opacity.

    `transfer`, a transfer function or the file of one, says all of it: nothing else goes with it but `exposure`, stops by which
    extinction is larger (2 to this power) than what is fitted to the picture.

    `surface` shows particles by their surface, where their coverage first crosses this level (`jaxsph.Surface`), or all of a
    `jaxsph.Surface`; opacity is of no meaning then. False shows them as a medium. None is the surface of liquids (see
    `jaxsph.io.opening.looks`), unless their opacity or a clip was asked for, and a medium of all else. `surface_of` is a quantity
    that is not negative, whose level it is in place of the coverage; with it a level is chosen where none is given. `smoothing`,
    `light` (three numbers, or "head"), `occlusion` and `antialias` are those of `jaxsph.Surface`; what is not given of a level is
    `jaxsph.io.opening.looks.SHOWN`.

    `background` is what will be behind the picture: on a light one a map that nobody chose begins light, what is dense is dark.

    Raises `ValueError`: a name that is unknown; a range that does not ascend; what excludes each other.
    """

    colormap: str | None = look("NAME", values.colormap, MAPS)
    norm: str | None = choice(None, DOMAINS, LOOK, "where colours sit")
    range: tuple[float, float] | None = look(
        "LOW,HIGH", values.numbers("LOW,HIGH"), "values that the colours span (default: nearly all)"
    )
    preset: str | None = choice(None, PRESETS, LOOK, "kind of data")
    transfer: TransferFunction | str | os.PathLike[str] | None = look(
        "FILE.json", values.Path, "a transfer function that was saved"
    )
    exposure: float = look("STOPS", values.number, "more, or less, opaque than what is chosen", default=0.0)
    optical_depth: float | None = look("DEPTH", values.optical_depth, "of typical rays, instead of what is chosen", show=False)
    surface: Any = look("[LEVEL|none]", values.level, f"of particles, where they cover so much (of liquids {Surface().level})")
    surface_of: str | None = look("NAME", str, "of particles, where a quantity has the LEVEL (default: its median)", show=False)
    background: str | None = None
    smoothing: float | None = look("S", values.number, "of a surface, what supports are multiplied by (default 1)", show=False)
    light: Any = look(
        "X,Y,Z|head", values.light, "of a surface, from the right, above and the eye's side (default -0.5,0.8,0.7)", show=False
    )
    occlusion: float | None = look("S", values.number, "of a surface, how dark its folds are, 0 to 1 (default 0.8)", show=False)
    antialias: int | None = look(
        "N", values.whole, "of a surface, N x N rays a pixel at edges: 1, 2, 4 or 8 (default 4)", show=False
    )

    def __post_init__(self) -> None:
        if self.surface_of is not None and self.surface is False:
            raise ValueError("`surface_of` is of a surface, and `surface` says that there is none; leave out one of them")
        if self.surface not in (None, False) and not isinstance(self.surface, Surface):
            Surface(self.surface)  # which checks its level
        self.shaded(Surface())
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
    def of_surface(self) -> dict[str, Any]:
        """What was asked for of a surface besides its level."""
        return {name: value for name in OF_SURFACE if (value := getattr(self, name)) is not None}

    def shaded(self, surface: Surface) -> Surface:
        """The surface with all that was asked for."""
        asked = self.of_surface
        if "light" in asked:
            asked["light"] = None if isinstance(self.light, str) and self.light == HEAD else tuple(np.ravel(self.light).tolist())
        return dataclasses.replace(surface, **asked) if asked else surface

    @property
    def said(self) -> tuple[str, ...]:
        """Names of what was asked for besides a transfer function."""
        return tuple(name for name in ("colormap", "norm", "range", "preset", "optical_depth") if getattr(self, name) is not None)


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
    """From where, how much of it, and how large.

    `width` is across the picture at the middle, a length of the file or with a unit, as `"30 kpc"`; what is farther than that
    from the middle is left out, unless clips are given. "all", and `frame_all`, is every support, however far it lies.

    `view` is "x", "y" or "z": parallel rays along an axis, from above along that which is up; "face-on" or "edge-on":
    along or across the angular momentum; three numbers: from where they point to; "iso": perspective from obliquely above.

    `up` of None is z for files of codes that have it so, as Phantom and DualSPHysics do, else y. Of `clips`, parts of space that
    are shown, all of them together, None leaves `width` to choose, and () shows everything.

    Raises `ValueError`: a name that is unknown, a width that is not positive, what excludes each other.
    """

    center: Any = camera("X,Y,Z", values.measured(values.center), "what is in the middle: a place, densest or mass")
    width: Any = camera("LENGTH", str, WIDTHS)
    view: Any = camera("NAME|X,Y,Z", values.view, SEEN)
    eye: Sequence[float] | None = camera("X,Y,Z", values.measured(values.place), "perspective from here")
    target: Sequence[float] | None = camera("X,Y,Z", values.measured(values.place), "what the eye looks at")
    up: Sequence[float] | None = camera("X,Y,Z", values.place, "upward direction (default: that of the kind of file, else 0,1,0)")
    fov_degrees: float | None = camera("DEG", values.number, "vertical field of view (default 45)", "--fov")
    size: tuple[int, int] = camera("WxH", values.size, "pixels (default 512x512)", default=(512, 512))
    clips: tuple[Clip, ...] | None = camera("SHAPE", values.measured(values.clip), CLIPPED, "--clip", several=values.clips)
    frame_all: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.width, str):  # a length, whatever its unit, is known to be one before a file is read
            if self.width == "all":
                object.__setattr__(self, "width", None)
                object.__setattr__(self, "frame_all", True)
            else:
                match = MEASURE.fullmatch(self.width)
                length_of(self.width if match is None else float(match[1]), "width", None)
        for name in ("view", "center", "eye", "target", "up"):
            if hasattr(getattr(self, name), "tolist"):  # an array
                object.__setattr__(self, name, tuple(np.ravel(getattr(self, name)).tolist()))
        is_named = self.view is None or (isinstance(self.view, str) and self.view in VIEWS)
        if not is_named and (isinstance(self.view, str) or not _is_place(self.view) or not np.any(self.view)):
            raise ValueError(f"`view` must be one of {', '.join(VIEWS)}, or a direction x, y and z, got {self.view!r}")
        known = self.center is None or isinstance(self.center, values.Measured)
        if not known and not (self.center in AROUND if isinstance(self.center, str) else _is_place(self.center)):
            raise ValueError(f"`center` must be x, y and z, or one of {', '.join(AROUND)}, got {self.center!r}")
        if self.eye is not None:
            for name in ("width", "view", "frame_all"):
                if getattr(self, name) not in (None, False):
                    raise ValueError(f"`eye` and `{name}` exclude each other: one places the eye, the other has it placed")
        if self.target is not None and self.eye is None:
            raise ValueError("`target` needs `eye`: from where should it be looked at? `center` puts a place in the middle")
        if self.fov_degrees is not None and not (is_named and self.view in (None, "iso")):
            raise ValueError(f"`fov_degrees` is of perspective views, and the rays of view {self.view!r} are parallel")
        if self.frame_all and self.width is not None:
            raise ValueError("`frame_all` and `width` exclude each other: one shows everything, the other so much")


def _is_place(value: Any) -> bool:
    return np.shape(value) == (3,) and bool(np.isfinite(np.asarray(value, np.float64)).all())
