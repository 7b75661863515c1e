"""Options of the commands: those of `jaxsph.io.opening`, which Python shares, and the command line's own; and what excludes what.

Flow: [groups] -> a command's options, a dataclass of the groups that it reads -> cyclopts -> values -> commands.

A command offers what its groups hold, but for what it leaves out. Options that are seldom wanted are read, but not shown. One is
called as its field is, unless it says otherwise.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar, dataclass_transform

from cyclopts import Group, Parameter, Token

from jaxsph.cli.console import UsageError, given_of, wrong_usage
from jaxsph.cli.figures import OF_FIGURES, has_key, is_figure
from jaxsph.cli.voice import name_of
from jaxsph.io.opening import values
from jaxsph.io.opening.options import CAMERA, DATA, LOOK, Look, Source, choice, flag, option
from jaxsph.model.scene import MIXES
from jaxsph.model.settings import INTEGRATORS, Settings
from jaxsph.plot.image_figure import require_dots

OUTPUT, QUALITY, MEANS, OWN, COMMON = "Output", "Quality", "Means", "Of this command", "Of all commands"
GROUPS = {name: Group(name, sort_key=key) for key, name in enumerate((OWN, DATA, CAMERA, LOOK, OUTPUT, QUALITY, MEANS, COMMON))}
FILE = Parameter(help="a file of particles or of a volume, or scene:NAME[:particles=N,frame=K]")
FRAMES = Parameter(help="a file, a sequence of snapshots, or scene:NAME[:particles=N,frame=K]")
POINTS: dict[str, values.Reader] = {
    "type": values.read_as("a whole number as type", int),
    "radius": values.number_or_column("a radius > 0", lambda value: 0 < value < math.inf),
    "opacity": values.number_or_column("an opacity in [0, 1)", lambda value: 0 <= value < 1),
    "color": values.color,
    "colormap": values.colormap,
}
VOLUMES: dict[str, values.Reader] = {"quantity": str, "colormap": values.colormap}
OF_POINTS = values.with_options(POINTS), DATA, f"stars, tracers: {', '.join(POINTS)}, each a value or a column; may be repeated"
OF_VOLUMES = values.with_options(VOLUMES), DATA, f"a volume in the same picture: {', '.join(VOLUMES)}; may be repeated"
DRAFT = 4  # samples of a picture over those of a draft
SETTINGS = ("samples", "integrator", "tolerance", "estimator", "relax", "screen")


def parameter_of(word: Mapping[str, Any]) -> Parameter:
    """An option as cyclopts has it, of the metadata of its field."""
    read, several, more = word["read"], word["several"], dict[str, Any]()
    if read is not None:

        def made(_: Any, tokens: Sequence[Token]) -> Any:
            return read(tokens[-1].value) if several is None else several([read(token.value) for token in tokens])

        repeats = several is not None or None
        more = {"metavar": word["metavar"], "converter": made, "n_tokens": 1, "allow_repeating": repeats}
    said: dict[str, Any] = {"help": word["help"], "show": word["show"], "show_default": False, "negative": ""}
    return Parameter(name=word["names"] or None, group=GROUPS[word["group"]], **said, **more)


def output(help: str, metavar: str = "OUT", default: Path | None = None) -> Any:
    """The field of what is written."""
    return option(default, metavar, Path, OUTPUT, help, "--output", "-o")


KEYED = " ".join(OF_FIGURES)  # options of a figure with a key
CLEAR = "opacity_by exposure optical_depth"  # of what has an extinction
HOW = "estimator relax"  # errors of samples along rays are known
OF_SOURCE = " ".join(one.name for group in (Source, Look) for one in dataclasses.fields(group) if one.name != "background")
EXCLUDE: tuple[tuple[str, str, str], ...] = (
    ("draft", "samples", "one says how many samples, the other leaves it open"),
    ("orbit", "camera", "one goes around, the other follows KEYS.json"),
    ("center width view eye target up fov_degrees frame_all", "camera", "KEYS.json places the camera"),
    ("workers", "client", "processes of this machine, or those of a scheduler"),
    ("panels", "difference", "one draws each file, the other what they differ by"),
    ("plane", "view", "one says which plane, the other looks at that through the middle"),
    ("plane", "eye", "one says which plane, the other looks at that through the target"),
    (CLEAR, "surface_of", "a surface has no extinction"),
    (CLEAR, "surface", "a surface has no extinction"),
    (f"{CLEAR} norm range preset transfer", "iso", "a surface of a volume has one colour, and no extinction"),
    ("fov_degrees", "plane", "a plane is seen by parallel rays"),
    ("preset transfer", "difference", "a difference has colours about zero"),
    ("colormap transfer", "look", "both are the colours of one type"),
    ("relax estimator=interval", "screen=quadtree", "its rays are at full rate, and nothing bounds them"),
    ("relax estimator=interval", "progressive", "its rays are at full rate, and nothing bounds them"),
    (HOW, "integrator=segments", "segments know their errors by themselves"),
    ("relax", "estimator=pilot", "bounds are relaxed, and the pilot has none"),
    ("field=sum", "weight", "one is a sum, the other is of a mean"),
    ("emission", "weight", "an emission is an integral, and no mean"),
    ("surface", "estimators", "a surface has no tolerance"),
    (f"{KEYED} background", "progressive", "that is of the finished picture"),
    ("screen=pixels", "progressive", "that casts rays by a quadtree"),
    ("devices", "progressive", "its stages go by one device"),
    ("background", "frame_format=png", "what is behind a frame is known of .exr alone"),
    (f"{KEYED} progressive devices background screen=quadtree", "tile", "that is a part, as it is"),
)
"""Options that exclude those behind them, and why."""
PICTURE = "is for a picture: name one with -o OUT.png"
NEED: tuple[tuple[str, str, str], ...] = (
    ("colormap range preset transfer background looks", "picture", PICTURE),
    ("norm", "picture difference", PICTURE),
    (KEYED.replace("unit ", "", 1), "figure", PICTURE),
    ("unit", "figure numbers", PICTURE),
    ("arrows", "figure", PICTURE),
    ("arrows", "key", "are drawn with a key: add --annotate"),
    ("looks", "drawn", "has colours, and nothing is drawn: leave them out"),
    (f"{HOW} screen=quadtree", "tolerance", "is of a tolerance: give --tolerance T, or leave it out"),
    ("mix", "points volume types", "is of what shares a picture: add --points or --volume, or leave it out"),
    ("gaps strict", "several", "is of a sequence of files, and there is one: leave it out"),
    (f"{OF_SOURCE} iso unit length_unit", "file", "is for FILE or scene:NAME, and there is none"),
)
"""Options that say nothing without one of those behind them or of `facts`, and what to do."""
RAW = ".exr", ".npy", ".fits"  # files that hold no key

Made = TypeVar("Made")


@dataclass_transform(frozen_default=True, kw_only_default=True)
def offered(without: str = "") -> Callable[[type[Made]], type[Made]]:
    """A class of options as cyclopts reads it, `without` some of those of its groups."""
    left = without.split()

    def made(own: type[Made]) -> type[Made]:
        known: Any = dataclasses.dataclass(frozen=True, kw_only=True)(own)
        for one in dataclasses.fields(known):
            word = {} if one.name in left else one.metadata
            said = parameter_of(word) if word else Parameter(parse=False)
            hint: Any = bool if word and word["read"] is None else tuple[Any, ...] if said.allow_repeating else Any
            known.__annotations__[one.name] = known.__init__.__annotations__[one.name] = Annotated[hint, said]
        return known  # type: ignore[no-any-return]

    return made


@Parameter(name="*")
@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """What every command reads."""

    source: Any = None  # the files or the scene, which are no option
    command: str = ""
    words: tuple[str, ...] = ()  # what was said, as options and their values
    app: Any = None  # of cyclopts with all commands, when it is called with their names
    quiet: bool = flag(COMMON, "say nothing but results and what is wrong", "--quiet", "-q")
    verbose: bool = flag(COMMON, "show where an error comes from", "--verbose", "-v")
    json: bool = flag(COMMON, "results and what was chosen as one JSON object on stdout")
    config: Any = option(None, "FILE.toml", Path, COMMON, "take options from a file; those beside it win")  # noqa: RUF009 - a field
    no_cache: bool = flag(COMMON, "keep no compiled programs for the next command", show=False)

    suffix: ClassVar[str] = ".png"  # of what is written where nothing says where
    numbers: ClassVar[tuple[str, ...]] = ()  # suffixes of files that hold numbers alone

    def __post_init__(self) -> None:
        """Check what each group checks."""
        for group in type(self).__mro__:
            check = vars(group).get("__post_init__")
            if check is not None and not issubclass(group, Options):
                check(self)

    def require_together(self) -> None:
        """Raise `UsageError` where two options exclude each other."""
        given = given_of(self)
        implied = is_figure(given.get("output")) and "annotate" in vars(self) and not given.get("annotate")
        given |= {"annotate": True} if implied else {}
        said = {*given, *(f"{name}={value}" for name, value in given.items()), *self.facts(given)}
        for names, other, why in EXCLUDE:
            for name in names.split() if other in said else ():
                if name in said:
                    both = " and ".join(" ".join([name_of(one.split("=")[0]), *one.split("=")[1:]]) for one in (name, other))
                    both = both.replace("--annotate", f"-o {given['output']}") if implied else both
                    raise UsageError(f"{both} exclude each other: {why}; leave one of them out")
        for names, others, why in NEED:
            for name in names.split() if said.isdisjoint(others.split()) else ():
                if name in said:
                    raise UsageError(f"{name_of(name.split('=')[0])} {why}")

    def facts(self, given: Mapping[str, Any]) -> set[str]:
        """What holds of the files and of the output, in words of `EXCLUDE` and `NEED`."""
        suffix = given["output"].suffix.lower() if "output" in given else self.suffix
        files = [one for one in self.source if one is not None]
        looks = [look is not None for _, look in getattr(self, "types", ())] or [False]
        holds = {
            "picture": suffix not in self.numbers,
            "figure": suffix not in RAW,
            "numbers": bool(self.numbers),
            "key": has_key(self),
            "drawn": hasattr(self, "colormap"),
            "several": len(files) > 1,
            "file": bool(files) or given.keys().isdisjoint(("points", "volume")),
            "types": len(looks) > 1,
            "looks": any(looks) and not (self.numbers and len(looks) > 1),  # which sums refuse, whatever they are written to
            "look": looks[0],
        }
        return {name for name, is_so in holds.items() if is_so}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Beside:
    """What shares a picture with the source, or stands for it."""

    points: tuple[values.Beside, ...] = option((), "FILE[:radius=R,...]", *OF_POINTS, several=tuple)
    volume: tuple[values.Beside, ...] = option((), "FILE[:quantity=NAME,...]", *OF_VOLUMES, several=tuple)
    iso: float | None = option(None, "LEVEL", values.number, DATA, "of a volume, the surface on which its values are LEVEL")
    mix: str | None = choice(None, MIXES, DATA, "how parts mix colours", show=False)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Quality:
    """How exactly light is summed up along rays, and how large errors may be."""

    samples: int | None = option(None, "N", values.whole, QUALITY, f"samples along a ray (default {Settings().samples})")
    integrator: str | None = choice(
        None, INTEGRATORS, QUALITY, "how samples become light", " (default samples, segments for --tolerance)"
    )
    memory: float | None = option(None, "GIB", values.memory, MEANS, "working memory (default 4)")
    tolerance: float | None = option(None, "T", values.number, QUALITY, "largest error of a pixel (default: none asked for)")
    estimator: str | None = choice(None, ("interval", "pilot"), QUALITY, "how errors are known")
    relax: float | None = option(None, "R", values.number, QUALITY, "0 is certified, 1 takes near rays for alike", show=False)
    screen: str | None = choice(
        None, ("pixels", "quadtree"), QUALITY, "how rays become pixels", " (interpolated within the tolerance)", show=False
    )
    draft: bool = flag(QUALITY, "a quarter of the samples, for looking around", show=False)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Key:
    """What stands behind a picture, and beside it: any of these but the background draws a figure with a key."""

    background: str | None = option(None, "COLOR", values.background, OUTPUT, "white, #rrggbb, R,G,B, transparent (else black)")
    annotate: bool = flag(OUTPUT, "with colour bar, scale bar and time, as any .pdf or .svg has them")
    axes: bool = flag(OUTPUT, "coordinates around a figure, not a scale bar; of parallel rays, as of --view z", show=False)
    unit: str | None = option(None, "UNIT", values.unit, OUTPUT, "of the quantity, as Msun/kpc**3 (default: the file's)")
    length_unit: str | None = option(None, "UNIT", values.length_unit, OUTPUT, "of lengths (default: the file's)", show=False)
    title: str | None = option(None, "TEXT", str, OUTPUT, "above a figure", show=False)
    panels: bool = flag(OUTPUT, "files side by side in one figure, by one frame and one norm")
    difference: bool = flag(OUTPUT, "the second of two files minus the first; with --norm log their ratio")
    contours: str | None = option(None, "NAME", str, OUTPUT, "of a quantity, over a figure; their levels are said")
    dpi: float | None = option(None, "N", values.positive, OUTPUT, "dots an inch of a figure, at least (default 150)", show=False)
    font_size: float | None = option(None, "PT", values.positive, OUTPUT, "letters of a figure (default 8)", show=False)

    def __post_init__(self) -> None:
        require_dots(self.dpi)


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
    """Options that choose no surface for liquids where a tolerance is to be kept: surfaces keep none, and are refused."""
    if settings.tolerance is None:
        return options
    if (options.surface not in (None, False) or options.of_surface) and settings.screen == "pixels":
        raise UsageError("--surface and --tolerance exclude each other: tolerance is of media; leave one of them out")
    return dataclasses.replace(options, surface=False) if options.surface is None else options
