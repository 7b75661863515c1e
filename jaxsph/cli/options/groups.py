"""Groups of options: those of `jaxsph.io.opening`, which Python shares, with their names on the command line, and its own.

Flow: [groups] -> a command's options, a dataclass of the groups that it reads -> cyclopts -> values -> commands.

A command offers what its groups hold, but for what it leaves out. Options that are seldom wanted are read, but not shown. One is
called as its field is, unless it says otherwise.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar, dataclass_transform

from cyclopts import Group, Parameter, Token

from jaxsph.cli.console import UsageError, is_given, wrong_usage
from jaxsph.cli.options import values
from jaxsph.cli.voice import name_of
from jaxsph.io.opening import options as opening
from jaxsph.io.opening.views import MEASURE, length_of
from jaxsph.model import Settings, registry
from jaxsph.model.particles.kernels import KERNELS
from jaxsph.model.scene import MIXES, Surface
from jaxsph.model.transfer.looks import PRESETS
from jaxsph.model.transfer.maps import COLORMAPS, DOMAINS

DATA = Group("Data", sort_key=1)
CAMERA = Group("Camera", sort_key=2)
LOOK = Group("Look", sort_key=3)
OUTPUT = Group("Output", sort_key=4)
QUALITY = Group("Quality", sort_key=5)
MEANS = Group("Means", sort_key=6)
OWN = Group("Of this command", sort_key=0)
COMMON = Group("Of all commands", sort_key=9)
FILE = Parameter(help="a file of particles or of a volume, or scene:NAME[:particles=N,frame=K]")
POINTS: dict[str, values.Reader] = {
    "type": values.read_as("a whole number as type")(int),
    "radius": values.number_or_column("a radius > 0", lambda value: 0 < value < math.inf),
    "opacity": values.number_or_column("an opacity in [0, 1)", lambda value: 0 <= value < 1),
    "color": values.color,
    "colormap": values.colormap,
}
VOLUMES: dict[str, values.Reader] = {"quantity": str, "colormap": values.colormap}
DRAFT = 4
"""Samples of a picture over those of a draft."""
SETTINGS = ("samples", "integrator", "tolerance", "estimator", "relax", "screen")


def word(
    metavar: str,
    read: values.Reader,
    group: Group,
    help: str,
    *names: str,
    show: bool = True,
    several: Callable[[list[Any]], Any] | None = None,
) -> Parameter:
    """An option with one value, which `read` makes of its text; of `several`, what that makes of all that were given."""

    def made(_: Any, tokens: Sequence[Token]) -> Any:
        return read(tokens[-1].value) if several is None else several([read(token.value) for token in tokens])

    return Parameter(
        name=names or None,
        metavar=metavar,
        converter=made,
        n_tokens=1,
        allow_repeating=several is not None or None,
        group=group,
        help=help,
        show=show,
        show_default=False,
        negative="",
    )


def name_in(known: Iterable[str], group: Group, help: str, more: str = "", show: bool = True) -> Parameter:
    """An option whose value is one of some names, which its help lists, with `more` behind them."""
    names = tuple(known)
    return word("NAME", values.one_of(names), group, f"{help}: {', '.join(names)}{more}", show=show)


def option(default: Any, *said: Any, **more: Any) -> Any:
    """A field with its option; see `word`."""
    return dataclasses.field(default=default, metadata={"word": word(*said, **more)})


def choice(default: Any, *said: Any, **more: Any) -> Any:
    """A field with its option; see `name_in`."""
    return dataclasses.field(default=default, metadata={"word": name_in(*said, **more)})


def flag(group: Group, help: str, *names: str, show: bool = True) -> Any:
    """A field with an option without a value."""
    said = Parameter(name=names or None, group=group, help=help, show=show, show_default=False, negative="")
    return dataclasses.field(default=False, metadata={"word": said})


def output(help: str, metavar: str = "OUT", default: Path | None = None) -> Any:
    """The field of what is written."""
    return option(default, metavar, Path, OUTPUT, help, "--output", "-o")


SHARED = {
    "color_by": word(
        "NAME",
        str,
        DATA,
        "an attribute, density, speed, x, y, z, or log10:NAME; of a volume, its values",
        "--color-by",
        "--quantity",
    ),
    "opacity_by": word("NAME", str, DATA, "the same for opacity alone (default: density where it spreads)"),
    "support": word("H", values.number_or_name, DATA, "radius, or as 2*h of columns (default: the file's, or found)"),
    "kernel": name_in(KERNELS, DATA, "smoothing kernel", " (default: the file's)", show=False),
    "part_type": word("N", values.whole, DATA, "of a Gadget-like file (default: gas, else the first)"),
    "box": word("LX,LY,LZ", values.box, DATA, "sides of a periodic box, or none (default: the file's)", "--box-size"),
    "where": word("CONDITION", str, DATA, 'such as "Temperature > 1e4 and Density < 2"; names as `jaxsph info` has them'),
    "share": word("S", values.number, DATA, "of the particles, as 0.1, for a quick look: their field is another one"),
    "center": word("X,Y,Z", values.center, CAMERA, "what is in the middle: a place, densest or mass"),
    "width": word("LENGTH", str, CAMERA, "across the picture, as 30 or 30kpc, or all (default: what is lit)"),
    "view": name_in(opening.VIEWS, CAMERA, "from where", " (default iso)"),
    "eye": word("X,Y,Z", values.place, CAMERA, "perspective from here"),
    "target": word("X,Y,Z", values.place, CAMERA, "what the eye looks at"),
    "up": word("X,Y,Z", values.place, CAMERA, "upward direction (default: that of the kind of file, else 0,1,0)"),
    "fov_degrees": word("DEG", values.number, CAMERA, "vertical field of view (default 45)", "--fov"),
    "size": word("WxH", values.size, CAMERA, "pixels (default 512x512)"),
    "clips": word(
        "SHAPE",
        values.clip,
        CAMERA,
        "what is in box:X0,Y0,Z0,X1,Y1,Z1, sphere:X,Y,Z,R or on a side, plane:X,Y,Z,NX,NY,NZ; outside with ~ before it; "
        "may be repeated; or none",
        "--clip",
        several=values.clips,
    ),
    "colormap": word(
        "NAME",
        values.colormap,
        LOOK,
        f"{', '.join(COLORMAPS)}, or any of cmap's, as cmocean:thermal (default: by the quantity)",
    ),
    "norm": name_in(DOMAINS, LOOK, "where colours sit"),
    "range": word("LOW,HIGH", values.numbers("LOW,HIGH"), LOOK, "values that the colours span (default: nearly all)"),
    "preset": name_in(PRESETS, LOOK, "kind of data"),
    "transfer": word("FILE.json", Path, LOOK, "a transfer function that was saved"),
    "exposure": word("STOPS", values.number, LOOK, "more, or less, opaque than what is chosen"),
    "optical_depth": word("DEPTH", values.optical_depth, LOOK, "of typical rays, instead of what is chosen", show=False),
    "surface": word("[LEVEL|none]", values.level, LOOK, f"of particles, where they cover so much (of liquids {Surface().level})"),
    "surface_of": word("NAME", str, LOOK, "of particles, where a quantity has the LEVEL (default: its median)", show=False),
}
"""How the fields of `jaxsph.io.opening` are said."""
EXCLUDE: tuple[tuple[str, str, str], ...] = (
    ("draft", "samples", "one says how many samples, the other leaves it open"),
    ("orbit", "camera", "one goes around, the other follows KEYS.json"),
    ("center width view eye target up fov_degrees frame_all", "camera", "KEYS.json places the camera"),
    ("workers", "client", "processes of this machine, or those of a scheduler"),
    ("plane", "view", "one says which plane, the other looks at that through the middle"),
    ("opacity_by", "surface_of", "a surface has no extinction"),
    ("emission", "weight", "an emission is an integral, and no mean"),
    ("surface", "estimators", "a surface has no tolerance"),
    ("annotate unit length_unit background", "progressive", "that is of the finished picture"),
    ("screen=pixels", "progressive", "that casts rays by a quadtree"),
    ("devices", "progressive", "its stages go by one device"),
    ("annotate unit length_unit", "background=transparent", "a key is drawn on a picture without holes"),
    ("progressive annotate unit length_unit devices background screen=quadtree", "tile", "that is a part, as it is"),
    ("volume points iso support where share center width clips box", "from_disk", "the one needs all particles at once"),
    ("surface surface_of", "from_disk", "a surface is of particles that are in memory"),
    ("progressive screen=quadtree annotate unit length_unit", "from_disk", "it renders the picture pane by pane"),
)
"""Options that exclude those behind them, and why."""

NOT_HERE = Parameter(parse=False)
Made = TypeVar("Made")


@dataclass_transform(frozen_default=True, kw_only_default=True)
def offered(without: str = "", **words: Parameter) -> Callable[[type[Made]], type[Made]]:
    """A class of options as cyclopts reads it: `without` some of those of its groups, with other `words` for some."""
    left = dict.fromkeys(without.split(), NOT_HERE)

    def made(own: type[Made]) -> type[Made]:
        known: Any = dataclasses.dataclass(frozen=True, kw_only=True)(own)
        for one in dataclasses.fields(known):
            said = (left | words).get(one.name) or one.metadata.get("word") or SHARED.get(one.name, NOT_HERE)
            hint: Any = tuple[Any, ...] if said.allow_repeating else Any
            known.__annotations__[one.name] = known.__init__.__annotations__[one.name] = Annotated[hint, said]
        return known  # type: ignore[no-any-return]

    return made


@Parameter(name="*")
@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """What every command reads.

    Attributes:
        source: the files or the scene, which are no option.
        command: name of the command.
        words: what was said, as options and their values.
    """

    source: Any = None
    command: str = ""
    words: tuple[str, ...] = ()
    quiet: bool = flag(COMMON, "say nothing but results and what is wrong", "--quiet", "-q")
    verbose: bool = flag(COMMON, "show where an error comes from", "--verbose", "-v")
    json: bool = flag(COMMON, "results and what was chosen as one JSON object on stdout")
    config: Any = option(None, "FILE.toml", Path, COMMON, "take options from a file; those beside it win")  # noqa: RUF009 - a field
    no_cache: bool = flag(COMMON, "keep no compiled programs for the next command", show=False)

    def __post_init__(self) -> None:
        """Check what each group checks."""
        for group in type(self).__mro__:
            check = vars(group).get("__post_init__")
            if check is not None and not issubclass(group, Options):
                check(self)

    def require_together(self) -> None:
        """Raise `UsageError` where two options exclude each other."""
        given = {name: value for name, value in vars(self).items() if is_given(name, value)}
        said = {*given, *(f"{name}={value}" for name, value in given.items())}
        for names, other, why in EXCLUDE:
            for name in names.split() if other in said else ():
                if name in said:
                    both = " and ".join(" ".join([name_of(one.split("=")[0]), *one.split("=")[1:]]) for one in (name, other))
                    raise UsageError(f"{both} exclude each other: {why}; leave one of them out")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Beside:
    """What shares a picture with the source, or stands for it."""

    points: tuple[values.Beside, ...] = option(
        (),
        "FILE[:radius=R,...]",
        values.with_options(POINTS),
        DATA,
        f"stars, tracers: {', '.join(POINTS)}, each a value or a column; may be repeated",
        several=tuple,
    )
    volume: tuple[values.Beside, ...] = option(
        (),
        "FILE[:quantity=NAME,...]",
        values.with_options(VOLUMES),
        DATA,
        f"a volume in the same picture: {', '.join(VOLUMES)}; may be repeated",
        several=tuple,
    )
    iso: float | None = option(None, "LEVEL", values.number, DATA, "of a volume, the surface on which its values are LEVEL")
    mix: str | None = choice(None, MIXES, DATA, "how parts mix colours", show=False)


@dataclasses.dataclass(frozen=True, kw_only=True)
class View(opening.View):
    """From where, how much of it, and how large."""

    def __post_init__(self) -> None:
        """`--width all` is `frame_all` of Python; another is known to be a length, whatever its unit, before a file is read."""
        if self.width == "all":
            object.__setattr__(self, "width", None)
            object.__setattr__(self, "frame_all", True)
        elif isinstance(self.width, str):
            found = MEASURE.fullmatch(self.width)
            length_of(self.width if found is None else float(found[1]), "width", None)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Quality:
    """How exactly light is summed up along rays, and how large errors may be."""

    samples: int | None = option(None, "N", values.whole, QUALITY, f"samples along a ray (default {Settings().samples})")
    integrator: str | None = choice(
        None, registry.INTEGRATORS, QUALITY, "how samples become light", " (default samples, segments for --tolerance)"
    )
    memory: float | None = option(None, "GIB", values.memory, MEANS, "working memory (default 4)")
    tolerance: float | None = option(None, "T", values.number, QUALITY, "largest error of a pixel (default: none asked for)")
    estimator: str | None = choice(None, ("interval", "pilot"), QUALITY, "how errors are known")
    relax: float | None = option(
        None, "R", values.number, QUALITY, "0 is certified, 1 takes neighbouring rays for alike", show=False
    )
    screen: str | None = choice(
        None, ("pixels", "quadtree"), QUALITY, "how rays become pixels", " (interpolated within the tolerance)", show=False
    )
    draft: bool = flag(QUALITY, "a quarter of the samples, for looking around")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Key:
    """What stands beside a picture."""

    unit: str | None = option(None, "UNIT", str, OUTPUT, "of the quantity, as Msun/kpc**3; draws the key (default: the file's)")
    length_unit: str | None = option(
        None, "UNIT", str, OUTPUT, "of lengths, as kpc; draws the key (default: the file's)", show=False
    )


def settings_of(options: Any) -> Settings:
    """Settings from the options given; what `Settings` refuses is wrong usage."""
    asked = {name: getattr(options, name) for name in SETTINGS}
    if options.draft:
        asked["samples"] = max(1, Settings().samples // DRAFT)
    if getattr(options, "progressive", False):  # its stages are of a quadtree
        asked["screen"] = "quadtree"
    asked["memory_limit"] = None if options.memory is None else int(options.memory * values.GIB)
    with wrong_usage():
        return Settings(**{name: value for name, value in asked.items() if value is not None})


def as_medium(options: Any, settings: Settings) -> Any:
    """Options that choose no surface for liquids where a tolerance is to be kept or media are asked at points: it has neither.

    Raises `UsageError`: a surface is asked for as well.
    """
    asks_points = registry.integrator_class(settings.integrator_used).asks_points
    if settings.tolerance is None and not asks_points:
        return options
    of_screen = settings.screen != "pixels"
    if options.surface not in (None, False) and (asks_points or not of_screen):
        other = f"--integrator {settings.integrator_used}" if asks_points else "--tolerance"
        raise UsageError(f"--surface and {other} exclude each other: {other[2:].split()[0]} is of media; leave one of them out")
    return dataclasses.replace(options, surface=False) if options.surface is None else options
