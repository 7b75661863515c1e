"""The command `project`: column densities, means along rays and emission of a particle file.

Flow: file, options -> [cli_project] -> project -> EXR, NPY or PNG.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from cyclopts import Parameter

from jaxsph import io
from jaxsph.analysis.projection.plan import PIXELS, plan_projection
from jaxsph.analysis.projection.project import project as projected
from jaxsph.cli import voice
from jaxsph.cli import where as cli_where
from jaxsph.cli.console import UsageError, progress, refuse, require_writable, say_notes, span, wrong_usage
from jaxsph.cli.options import groups, values
from jaxsph.cli.options.groups import CAMERA, LOOK, OUTPUT, OWN, flag, option, output
from jaxsph.cli.options.settings import SCENE
from jaxsph.cli.voice import say
from jaxsph.engine.runtime.executors import Clock
from jaxsph.io.images.projections import SUFFIXES
from jaxsph.io.opening.views import place_of
from jaxsph.io.replace import write_figure
from jaxsph.io.settle.quantities import ROLES, choose_quantity, is_log, velocity_name
from jaxsph.io.settle.selection import chosen
from jaxsph.io.settle.stored import stored_density, without_placeholder
from jaxsph.io.settle.unit_names import unit_of, written
from jaxsph.io.table import plain
from jaxsph.io.units import CodeUnit
from jaxsph.model import Camera, Particles, Scene
from jaxsph.model.camera.framing import VIEWS
from jaxsph.model.particles.held import emission_measure
from jaxsph.model.projection import NORMS, Projection
from jaxsph.model.transfer.looks import default_transfer
from jaxsph.plot.arrows import draw_arrows

MASS, VOLUME, NUMBER = "mass", "volume", "number"
SUMMED = {
    MASS: "column density: mass a unit of area",
    VOLUME: "length inside particles: volume a unit of area",
    NUMBER: "particles a unit of area",
}
"""What particles hold themselves; anything else is held by their volume."""


@Parameter(name="*")
@dataclasses.dataclass(frozen=True, kw_only=True)
class Project(groups.Options, groups.Selection, groups.View):
    """Options of the command."""

    view: Annotated[
        str | None, option("--view", "x|y|z", values.one_of(tuple(VIEWS)), CAMERA, "parallel rays along an axis (default z)")
    ] = None
    clip: Annotated[Any, groups.NOT_HERE] = ()
    output: Annotated[Path | None, output(f"{', '.join(SUFFIXES)} (default: FILE's name with .exr, here)")] = None
    of: Annotated[
        str | None,
        option("--of", "NAME", str, OWN, "mass, number, volume or a quantity (default: mass, else number)"),
    ] = None
    weight: Annotated[
        str | None,
        option("--weight", "NAME", str, OWN, "a mean of --of along rays, by mass, number, volume, or a quantity times volume"),
    ] = None
    emission: Annotated[
        float | None,
        option("--emission", "N", values.number, OWN, "emission: the integral of density^N, times --of where that is given"),
    ] = None
    pixel: Annotated[
        str,
        option("--pixel", "mean|ray", values.one_of(PIXELS), OWN, "means of pixels, which keep all mass, or values of rays"),
    ] = PIXELS[0]
    annotate: Annotated[bool, flag("--annotate", OUTPUT, "of a .png: with a colour bar, and the name of what it shows")] = False
    arrows: Annotated[
        str | None,
        option("--arrows", "NAME", str, OUTPUT, "with --annotate: arrows of a vector, as velocity, its mean along rays"),
    ] = None
    depth_range: Annotated[
        Any,
        option(
            "--depth-range",
            "A,B",
            values.numbers("A,B"),
            CAMERA,
            "what lies between: coordinates along the --view, or depths from the --eye",
        ),
    ] = None
    colormap: Annotated[str | None, groups.colormap_option("of a .png: a colour map (default viridis)")] = None
    norm: Annotated[str | None, groups.choice("--norm", NORMS, LOOK, "of a .png", more=" (default: log over a decade)")] = None
    range: Annotated[
        Any, option("--range", "LOW,HIGH", values.numbers("LOW,HIGH"), LOOK, "of a .png: values that the colours span")
    ] = None


PROJECT = Project()


ARROWS = 20
"""Across a picture."""


def _save(image: Projection, arrows: _Arrows | None, options: Any, output: Path) -> None:
    """Write the values or the picture, with a colour bar where that is asked for."""
    if options.annotate:
        figure = image.figure(**_look(options))
        if arrows is not None:
            draw_arrows(figure.axes[0], *arrows)
        write_figure(figure, output)
    else:
        image.save(output, **_look(options))


def project(file: Annotated[str, Parameter(help="a file of particles")], /, *, asked: Project = PROJECT) -> None:
    """Project, write, and say.

    NAME is mass, volume, number (of particles), or any quantity of the file. Without --weight, mass is projected to a column
    density, number to a column number density, and the integral of any other quantity is taken along rays.
    """
    options = _checked(dataclasses.replace(asked, source=file))
    output = options.output or Path(Path(options.source).stem + ".exr")
    require_writable(output, "a projection must be", SUFFIXES)
    table = io.read_table(options.source, part_type=options.part_type)
    say("file", f"{options.source}: {table.source}, {len(table):,} particles")
    which: dict[str, Any] = {"box": options.box, "where": options.where, "share": options.share}
    with wrong_usage(of=io.ConditionError):
        table = chosen(table, "density", options.support, options.kernel, **which)
    particles, report = io.particles_from_table(table, "x", options.support, options.kernel)
    say("support", f"{span(particles.to_numpy()['support'])}: {report.support}")
    say("kernel", report.kernel)
    say_notes(report.notes)
    columns = _Columns(table, particles)
    of, weight, name, what = _asked(columns, options)
    say("values", what)
    camera = _camera(particles, table, options)
    say("camera", camera.describe())
    image, seconds = _projected(particles, camera, (of, weight), options.pixel, name)
    image = dataclasses.replace(image, unit=columns.unit(options))
    found = np.asarray(image.values)
    _save(image, _arrows(columns, particles, camera, options), options, output)
    said = found[np.isfinite(found)]
    say("image", f"{output}, {name} {span(said)}")
    if weight is None and not camera.is_perspective:
        total = float(image.total())
        say("total", f"{total:.7g} in the image, of {float(np.sum(of)):.7g}")
        voice.report(total=total, of_all=float(np.sum(of)))
    say("time", f"{sum(seconds.values()):.2f} s: " + ", ".join(f"{stage} {took:.2f} s" for stage, took in seconds.items()))
    lowest, highest = (float(said.min()), float(said.max())) if said.size else (None, None)
    voice.written(output, name=name, lowest=lowest, highest=highest, camera=camera.describe(), seconds=seconds)


class _Arrows(NamedTuple):
    """Components of a vector to the right and upwards, means along rays, and what it is called."""

    right: np.ndarray
    up: np.ndarray
    name: str
    unit: str


def _arrows(columns: _Columns, particles: Particles, camera: Camera, options: Any) -> _Arrows | None:
    """Of the vector that is asked for, by mass where there are masses, else by volume."""
    if options.arrows is None:
        return None
    table = columns.table
    role = velocity_name(table) if plain(options.arrows) in map(plain, ROLES["velocity"]) else None
    name = table.named(options.arrows) or role
    if name is None or table.columns[name].ndim != 2 or table.columns[name].shape[1] != 3:
        vectors = [vector for vector in table.vectors if table.columns[vector].shape[1] == 3]
        raise UsageError(f"--arrows {options.arrows}: there is no such vector; there are {', '.join(vectors) or 'none'}")
    weight = columns.amounts(VOLUME if columns.mass_name is None else MASS)
    coarse = dataclasses.replace(camera, width=ARROWS, height=max(1, round(ARROWS * camera.height / camera.width)))
    parts = table.columns[name].astype(np.float64) @ np.asarray(camera.axes, np.float64)[:2].T
    right, up = (np.asarray(projected(particles, coarse, part, weight).values) for part in parts.T)
    labels = io.labels_of(table, name, float(np.abs(parts).max(initial=0)))
    return _Arrows(right * labels.factor, up * labels.factor, name, labels.unit)


def _projected(particles: Particles, camera: Camera, held: Any, pixel: str, name: str) -> tuple[Projection, dict[str, float]]:
    """The image, with a bar while it is made; and the seconds of each stage, compiling told apart."""
    with progress("project", " stages") as show:
        tell = show or (lambda done, total: None)
        tell(0, 2)
        started = time.perf_counter()
        plan = plan_projection(particles, camera, pixel=pixel)
        planned = time.perf_counter() - started
        tell(1, 2)
        clock = Clock()
        image = projected(particles, camera, *held, pixel=pixel, plan=plan, name=name, clock=clock)
        tell(2, 2)
    return image, {"plan": planned, "compile": clock.seconds["compile"], "cast": clock.seconds["cast"]}


def _checked(options: Any) -> Any:
    """The options; `UsageError` where they exclude each other, or are out of range."""
    if options.source.startswith(SCENE):
        raise UsageError(f"{options.source}: a projection is of a file of particles; `jaxsph render` shows built-in scenes")
    if options.output is not None and options.output.suffix.lower() not in SUFFIXES:
        raise UsageError(f"{options.output}: a projection must be {', '.join(SUFFIXES)}")
    if options.view is not None and options.eye is not None:
        raise UsageError("--view and --eye exclude each other: rays are parallel or spread from the eye")
    if options.eye is None:
        refuse(options, ("fov_degrees",), "needs --eye: from where should it be looked at?")
    if options.emission is not None and options.weight is not None:
        raise UsageError("--emission is an integral, not a mean: leave out --weight")
    if options.depth_range is not None and not options.depth_range[0] < options.depth_range[1]:
        raise UsageError(f"--depth-range must ascend, got {options.depth_range[0]:g} {options.depth_range[1]:g}")
    png = options.output is not None and options.output.suffix.lower() == ".png"
    if options.arrows is not None and not options.annotate:
        raise UsageError("--arrows are drawn with a key: add --annotate")
    if options.annotate and not png:
        raise UsageError("--annotate is for a picture: name one with -o OUT.png")
    if not png and any(getattr(options, name) is not None for name in ("colormap", "norm", "range")):
        raise UsageError("--colormap, --norm and --range are for a picture: name one with -o OUT.png")
    return options


class _Columns:
    """What a file's particles hold, in float64."""

    def __init__(self, table: io.ParticleTable, particles: Particles) -> None:
        self._stored = stored_density(table)
        self.table, self._particles = without_placeholder(table, self._stored), particles
        self.mass_name = table.named(*ROLES[MASS])

    @functools.cached_property
    def mass(self) -> np.ndarray:
        if self.mass_name is None:
            raise UsageError("the file has no masses; project --of number, volume or a quantity")
        return self.table.columns[self.mass_name].astype(np.float64)

    @functools.cached_property
    def density(self) -> np.ndarray:
        """As stored where that is the density, else summed over each particle's support."""
        refused = self._stored.column is None and self._stored.told
        return self._summed() if refused else choose_quantity(self.table, "density", density=self._summed)[0]

    @functools.cached_property
    def volume(self) -> np.ndarray:
        if self.table.volume is not None:
            return self.table.volume.astype(np.float64)
        if self.mass_name is not None:
            return self.mass / self.density
        return self._particles.to_numpy()[VOLUME].astype(np.float64)

    def amounts(self, name: str) -> np.ndarray:
        """What is summed up of a name: masses and volumes as they are, others times volume."""
        if name in (MASS, NUMBER):
            return self.mass if name == MASS else np.ones(len(self.table))
        return self.volume if name == VOLUME else self.values(name) * self.volume

    def values(self, name: str) -> np.ndarray:
        """A number a particle."""
        if name in SUMMED:
            return self.amounts(name)
        return choose_quantity(self.table, name, density=self._summed)[0]

    def unit(self, options: Any) -> str:
        """The unit of what is asked for, as far as the file states those that it is made of."""
        length = self.table.units.length
        name = options.of or ("density" if options.weight else MASS if self.mass_name else NUMBER)
        own = unit_of(self.table, (self.mass_name or MASS) if name == MASS else name)
        if options.weight is None and length is not None:
            own = CodeUnit(1.0, (0, 0, 0, 0)) if name in (NUMBER, VOLUME) else own
            own = None if own is None else own.over(length, 2 if name in (MASS, NUMBER) else -1)
        elif options.weight is None:
            own = None
        return "" if own is None or options.emission is not None or is_log(name) else written(own)

    def _summed(self) -> np.ndarray:
        support = self._particles.to_numpy()["support"].astype(np.float64)
        mass = None if self.mass_name is None else self.mass
        return io.kernel_sum(self.table.position, support, mass, kernel=self._particles.kernel, box=self.table.box_size)


def _asked(columns: _Columns, options: Any) -> tuple[np.ndarray, np.ndarray | None, str, str]:
    """Amounts or values, weights, the name of the result, and a sentence about it."""
    default = MASS if columns.mass_name is not None else NUMBER
    if options.emission is not None:
        factor = 1.0 if options.of is None else columns.values(options.of)
        times = "" if options.of is None else f"{options.of} x "
        name = f"emission.{options.of}" if options.of else "emission"
        said = f"integral of {times}density^{options.emission:g} along rays, each particle with its own density"
        return emission_measure(columns.mass, columns.density, factor, options.emission), None, name, said
    if options.weight is not None:
        of = options.of or "density"
        said = f"mean of {of} along rays, weighted by {options.weight}"
        return columns.values(of), columns.amounts(options.weight), f"mean.{of}", said
    of = options.of or default
    return columns.amounts(of), None, f"column.{of}", SUMMED.get(of, f"integral of {of} along rays: {of} times length")


def _camera(particles: Particles, table: io.ParticleTable, options: Any) -> Camera:
    depths = None if options.depth_range is None else tuple(options.depth_range)
    if options.eye is None and options.view is None:
        options = dataclasses.replace(options, view="z")
    if isinstance(options.center, str):
        with wrong_usage():
            place = place_of(Scene(particles=particles, transfer=default_transfer(particles)), options.center, table)
        assert place is not None
        say("center", " ".join(f"{value:.6g}" for value in place))
        options = dataclasses.replace(options, center=tuple(place))
    return cli_where.camera_of(particles, cli_where.upward(options, table.up, table.source), depths, table.units.length)


def _look(options: Any) -> dict[str, Any]:
    given = {"colormap": options.colormap, "norm": options.norm, "range": options.range}
    return {name: value for name, value in given.items() if value is not None}
