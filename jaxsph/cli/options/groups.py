"""Groups of options: those of `jaxsph.io.opening`, which Python shares, with their names on the command line, and its own.

Flow: [groups] -> a command's options, a dataclass of the groups that it reads -> cyclopts -> values -> commands.

A command offers what its groups hold, and nothing else. Options that are seldom wanted are read, but not shown.
"""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Group, Parameter, Token

from jaxsph.cli.options import values
from jaxsph.io.opening import options as opening
from jaxsph.io.opening.views import MEASURE, length_of
from jaxsph.model import Settings, registry
from jaxsph.model.particles.kernels import KERNELS
from jaxsph.model.particles.surface import Surface
from jaxsph.model.scene import MIXES
from jaxsph.model.transfer.domains import DOMAINS
from jaxsph.model.transfer.looks import PRESETS
from jaxsph.model.transfer.maps import COLORMAPS

DATA = Group("Data", sort_key=1)
CAMERA = Group("Camera", sort_key=2)
LOOK = Group("Look", sort_key=3)
OUTPUT = Group("Output", sort_key=4)
QUALITY = Group("Quality", sort_key=5)
MEANS = Group("Means", sort_key=6)
OWN = Group("Of this command", sort_key=0)
COMMON = Group("Of all commands", sort_key=9)
FILE = Parameter(help="a file of particles or of a volume, or scene:NAME[:particles=N,frame=K]")
NOT_HERE = Parameter(parse=False)
"""An attribute of a group that Python shares which a command does not offer."""
POINTS = ("type", "radius", "opacity", "color", "colormap")
VOLUMES = ("quantity", "colormap")
ESTIMATORS = ("interval", "pilot")
SCREENS = ("pixels", "quadtree")
MAX_OPTICAL_DEPTH = 1e6


def option(
    name: str | tuple[str, ...],
    metavar: str,
    read: Callable[[str], Any],
    group: Group,
    help: str,
    *,
    show: bool = True,
    several: bool = False,
) -> Parameter:
    """An option with one value, which `read` makes of its text; of `several`, a tuple of what was given."""

    def made(_: Any, tokens: Sequence[Token]) -> Any:
        return tuple(read(token.value) for token in tokens) if several else read(tokens[-1].value)

    return Parameter(
        name=name,
        metavar=metavar,
        converter=made,
        n_tokens=1,
        allow_repeating=several or None,
        group=group,
        help=help,
        show=show,
        show_default=False,
        negative="",
    )


def choice(name: str, names: Iterable[str], group: Group, help: str, *, more: str = "", show: bool = True) -> Parameter:
    """An option whose value is one of some names, which its help lists, with `more` behind them."""
    known = tuple(names)
    return option(name, "NAME", values.one_of(known), group, f"{help}: {', '.join(known)}{more}", show=show)


def flag(name: str | tuple[str, ...], group: Group, help: str, *, show: bool = True) -> Parameter:
    """An option without a value."""
    return Parameter(name=name, group=group, help=help, show=show, show_default=False, negative="")


@Parameter(name="*")
@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """What every command reads.

    Attributes:
        source: the files or the scene, which are no option.
        command: name of the command.
        words: what was said, as options and their values.
    """

    source: Annotated[Any, NOT_HERE] = None
    command: Annotated[str, NOT_HERE] = ""
    words: Annotated[tuple[str, ...], NOT_HERE] = ()
    quiet: Annotated[bool, flag(("--quiet", "-q"), COMMON, "say nothing but results and what is wrong")] = False
    verbose: Annotated[bool, flag(("--verbose", "-v"), COMMON, "show where an error comes from")] = False
    json: Annotated[bool, flag("--json", COMMON, "results and what was chosen as one JSON object on stdout")] = False
    config: Annotated[Any, option("--config", "FILE.toml", Path, COMMON, "take options from a file; those beside it win")] = None
    no_cache: Annotated[bool, flag("--no-cache", COMMON, "keep no compiled programs for the next command", show=False)] = False

    def __post_init__(self) -> None:
        """Check what each group checks."""
        for group in type(self).__mro__:
            check = vars(group).get("__post_init__")
            if check is not None and not issubclass(group, Options):
                check(self)


_SUPPORT = option("--support", "H", values.number_or_name, DATA, "radius, or as 2*h of columns (default: the file's, or found)")
_KERNEL = choice("--kernel", KERNELS, DATA, "smoothing kernel", more=" (default: the file's)", show=False)
_TYPE = option("--part-type", "N", values.whole, DATA, "of a Gadget-like file (default: gas, else the first)")
_BOX = option("--box-size", "LX,LY,LZ", values.box, DATA, "sides of a periodic box, or none (default: the file's)")
_WHERE = option("--where", "CONDITION", str, DATA, 'such as "Temperature > 1e4 and Density < 2"; names as `jaxsph info` has them')
_SHARE = option("--share", "S", values.number, DATA, "of the particles, as 0.1, for a quick look: their field is another one")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Selection(opening.Source):
    """Which particles, for commands that have quantities of their own."""

    color_by: Annotated[str | None, NOT_HERE] = None
    opacity_by: Annotated[str | None, NOT_HERE] = None
    support: Annotated[float | str | None, _SUPPORT] = None
    kernel: Annotated[str | None, _KERNEL] = None
    part_type: Annotated[int | None, _TYPE] = None
    box: Annotated[Any, _BOX] = "file"
    where: Annotated[str | None, _WHERE] = None
    share: Annotated[float | None, _SHARE] = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Source(Selection):
    """Which particles, and which of their quantities."""

    color_by: Annotated[
        str | None,
        option(
            ("--color-by", "--quantity"),
            "NAME",
            str,
            DATA,
            "an attribute, density, speed, x, y, z, or log10:NAME; of a volume, its values",
        ),
    ] = None
    opacity_by: Annotated[
        str | None, option("--opacity-by", "NAME", str, DATA, "the same for opacity alone (default: density where it spreads)")
    ] = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Beside:
    """What shares a picture with the source, or stands for it."""

    points: Annotated[
        tuple[Any, ...],
        option(
            "--points",
            "FILE[:radius=R,...]",
            values.with_options(POINTS),
            DATA,
            f"stars, tracers: {', '.join(POINTS)}, each a value or a column; may be repeated",
            several=True,
        ),
    ] = ()
    volume: Annotated[
        tuple[Any, ...],
        option(
            "--volume",
            "FILE[:quantity=NAME,...]",
            values.with_options(VOLUMES),
            DATA,
            f"a volume in the same picture: {', '.join(VOLUMES)}; may be repeated",
            several=True,
        ),
    ] = ()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mixed(Beside):
    """The same in a picture."""

    iso: Annotated[
        float | None, option("--iso", "LEVEL", values.number, DATA, "of a volume, the surface on which its values are LEVEL")
    ] = None
    mix: Annotated[str | None, choice("--mix", MIXES, DATA, "how parts mix colours", show=False)] = None


_SIZE = option("--size", "WxH", values.size, CAMERA, "pixels (default 512x512)")
_UP = option("--up", "X,Y,Z", values.place, CAMERA, "upward direction (default: that of the kind of file, else 0,1,0)")
_CENTER = option("--center", "X,Y,Z", values.center, CAMERA, "what is in the middle: a place, densest or mass")
_WIDTH = option("--width", "LENGTH", str, CAMERA, "across the picture, as 30 or 30kpc, or all (default: what is lit)")
_CLIP = option(
    "--clip",
    "SHAPE",
    values.clip,
    CAMERA,
    "what is in box:X0,Y0,Z0,X1,Y1,Z1, sphere:X,Y,Z,R or on a side, plane:X,Y,Z,NX,NY,NZ; outside with ~ before it; "
    "may be repeated; or none",
    several=True,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class View(opening.View):
    """From where, how much of it, and how large."""

    center: Annotated[Any, _CENTER] = None
    width: Annotated[Any, _WIDTH] = None
    view: Annotated[str | None, choice("--view", opening.VIEWS, CAMERA, "from where", more=" (default iso)")] = None
    eye: Annotated[Any, option("--eye", "X,Y,Z", values.place, CAMERA, "perspective from here")] = None
    target: Annotated[Any, option("--target", "X,Y,Z", values.place, CAMERA, "what the eye looks at")] = None
    up: Annotated[Any, _UP] = None
    fov_degrees: Annotated[float | None, option("--fov", "DEG", values.number, CAMERA, "vertical field of view (default 45)")] = (
        None
    )
    size: Annotated[tuple[int, int], _SIZE] = (512, 512)
    clips: Annotated[Any, NOT_HERE] = None
    frame_all: Annotated[bool, NOT_HERE] = False
    clip: Annotated[tuple[Any, ...], _CLIP] = ()

    def __post_init__(self) -> None:
        """Clips as Python has them; `--width all` is its `frame_all`."""
        if self.width == "all":
            object.__setattr__(self, "width", None)
            object.__setattr__(self, "frame_all", True)
        if isinstance(self.width, str):  # known before a file is read to be a length, whatever its unit
            found = MEASURE.fullmatch(self.width)
            length_of(self.width if found is None else float(found[1]), "width", None)
        if self.clip and self.clips is None:
            if any(one.clip is None for one in self.clip) and len(self.clip) > 1:
                raise ValueError("--clip none stands alone: it shows everything")
            object.__setattr__(self, "clips", tuple(one.clip for one in self.clip if one.clip is not None))
        super().__post_init__()


def colormap_option(help: str) -> Parameter:
    """The option of a colour map."""
    return option("--colormap", "NAME", values.colormap, LOOK, help)


_COLORMAP = colormap_option(f"{', '.join(COLORMAPS)}, or any of cmap's, as cmocean:thermal (default: by the quantity)")
_RANGE = option("--range", "LOW,HIGH", values.numbers("LOW,HIGH"), LOOK, "values that the colours span (default: nearly all)")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Look(opening.Look):
    """Colours and opacity."""

    colormap: Annotated[str | None, _COLORMAP] = None
    norm: Annotated[str | None, choice("--norm", DOMAINS, LOOK, "where colours sit")] = None
    range: Annotated[Any, _RANGE] = None
    preset: Annotated[str | None, choice("--preset", PRESETS, LOOK, "kind of data")] = None
    transfer: Annotated[Any, option("--transfer", "FILE.json", Path, LOOK, "a transfer function that was saved")] = None
    exposure: Annotated[
        float, option("--exposure", "STOPS", values.number, LOOK, "more, or less, opaque than what is chosen")
    ] = 0.0
    optical_depth: Annotated[
        float | None,
        option("--optical-depth", "DEPTH", values.number, LOOK, "of typical rays, instead of what is chosen", show=False),
    ] = None
    surface: Annotated[Any, NOT_HERE] = None
    surface_of: Annotated[str | None, NOT_HERE] = None

    def __post_init__(self) -> None:
        """What Python checks, and a depth that numbers can hold."""
        if self.optical_depth is not None and self.optical_depth > MAX_OPTICAL_DEPTH:
            raise ValueError(f"`optical_depth` must be at most {MAX_OPTICAL_DEPTH:g}, got {self.optical_depth:g}")
        super().__post_init__()


@dataclasses.dataclass(frozen=True, kw_only=True)
class SurfaceLook(Look):
    """The same, of a picture whose particles may be shown by their surface."""

    surface: Annotated[
        float | None,
        option(
            "--surface",
            "[LEVEL|none]",
            values.level,
            LOOK,
            f"of particles, where they cover so much (of liquids {Surface().level})",
        ),
    ] = None
    surface_of: Annotated[
        str | None,
        option(
            "--surface-of", "NAME", str, LOOK, "of particles, where a quantity has the LEVEL (default: its median)", show=False
        ),
    ] = None


_INTEGRATOR = choice(
    "--integrator", registry.INTEGRATORS, QUALITY, "how samples become light", more=" (default samples, segments for --tolerance)"
)
_SCREEN = choice("--screen", SCREENS, QUALITY, "how rays become pixels", more=" (interpolated within the tolerance)", show=False)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Quality:
    """How exactly light is summed up along rays."""

    samples: Annotated[
        int | None, option("--samples", "N", values.whole, QUALITY, f"samples along a ray (default {Settings().samples})")
    ] = None
    integrator: Annotated[str | None, _INTEGRATOR] = None
    memory: Annotated[float | None, option("--memory", "GIB", values.memory, MEANS, "working memory (default 4)")] = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Control(Quality):
    """How large errors may be."""

    tolerance: Annotated[
        float | None, option("--tolerance", "T", values.number, QUALITY, "largest error of a pixel (default: none asked for)")
    ] = None
    estimator: Annotated[str | None, choice("--estimator", ESTIMATORS, QUALITY, "how errors are known")] = None
    relax: Annotated[
        float | None,
        option("--relax", "R", values.number, QUALITY, "0 is certified, 1 takes neighbouring rays for alike", show=False),
    ] = None
    screen: Annotated[str | None, _SCREEN] = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Draft(Control):
    """The same, of pictures that may be drafts."""

    draft: Annotated[bool, flag("--draft", QUALITY, "a quarter of the samples, for looking around")] = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class Key:
    """What stands beside a picture."""

    unit: Annotated[
        str | None, option("--unit", "UNIT", str, OUTPUT, "of the quantity, as Msun/kpc**3; draws the key (default: the file's)")
    ] = None
    length_unit: Annotated[
        str | None,
        option("--length-unit", "UNIT", str, OUTPUT, "of lengths, as kpc; draws the key (default: the file's)", show=False),
    ] = None


def output(help: str, metavar: str = "OUT") -> Parameter:
    """The option of what is written."""
    return option(("--output", "-o"), metavar, Path, OUTPUT, help)
