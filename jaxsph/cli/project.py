"""The command `project`: column densities, means along rays and emission of a particle file.

Flow: file, options -> [cli_project] -> project -> EXR, NPY or PNG.
"""

from __future__ import annotations

import argparse
import functools
import time
from pathlib import Path
from typing import Any

import numpy as np

from jaxsph import io
from jaxsph.analysis.projection.plan import PIXELS, plan_projection
from jaxsph.analysis.projection.project import project
from jaxsph.cli import options as cli_options
from jaxsph.cli import scene as cli_scene
from jaxsph.cli import where as cli_where
from jaxsph.cli.console import UsageError, progress, refuse, say, say_notes, span, wrong_usage
from jaxsph.cli.options import PLACE
from jaxsph.engine.runtime.executors import Clock
from jaxsph.io.images.projections import SUFFIXES
from jaxsph.io.settle.quantities import ROLES, choose_quantity
from jaxsph.io.settle.selection import chosen
from jaxsph.io.settle.stored import stored_density, without_placeholder
from jaxsph.model import Camera, Particles
from jaxsph.model.camera.framing import VIEWS
from jaxsph.model.particles.held import emission_measure
from jaxsph.model.particles.kernels import KERNELS
from jaxsph.model.projection import NORMS, Projection

MASS, VOLUME, NUMBER = "mass", "volume", "number"
SUMMED = {
    MASS: "column density: mass a unit of area",
    VOLUME: "length inside particles: volume a unit of area",
    NUMBER: "particles a unit of area",
}
"""What particles hold themselves; anything else is held by their volume."""

MORE = (
    "NAME is mass, volume, number (of particles), or any quantity of the file. Without --weight, mass is projected to a "
    "column density, number to a column number density, and the integral of any other quantity is taken along rays; nothing is "
    "normalised. What you do not say is chosen, and said."
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("source", metavar="FILE", help="file of particles")
    suffixes = ", ".join(SUFFIXES)
    parser.add_argument("-o", "--output", type=Path, metavar="OUT", help=f"{suffixes} (default: FILE's name with .exr, here)")
    add = parser.add_argument_group("what is projected").add_argument
    add("--of", metavar="NAME", help="mass, number, volume or a quantity (default: mass where there are masses, else number)")
    add("--weight", metavar="NAME", help="a mean of --of along rays, by mass, number, volume, or a quantity times volume")
    add("--emission", type=float, metavar="N", help="emission: the integral of density^N, times --of where that is given")
    add(
        "--pixel",
        choices=PIXELS,
        default=PIXELS[0],
        help="means of pixels, which keep all mass, or values of rays (default mean)",
    )
    add("--support", type=float, metavar="H", help="support radius (default: the file's, or from neighbours)")
    add("--kernel", choices=tuple(KERNELS), help="(default: that of the file or its code, else poly6)")
    add("--part-type", type=int, metavar="N", help="of a Gadget-like file (default: gas, else the first)")
    cli_where.add_selection(parser)
    add = parser.add_argument_group("camera", "default: parallel rays along z, all of the particles").add_argument
    add("--axis", choices=tuple(VIEWS), help="parallel rays along an axis")
    add("--eye", **PLACE, help="perspective from here")
    add("--target", **PLACE, help="what the eye looks at (default: the middle of the particles)")
    add("--up", **PLACE, help="upward direction (default 0 1 0)")
    add("--fov", type=float, metavar="DEG", help="vertical field of view (default 45)")
    depths = "what lies between: coordinates along the --axis, or depths from the --eye"
    add("--depth-range", nargs=2, type=float, metavar=("A", "B"), help=depths)
    add("--size", type=cli_options.size, default=(512, 512), metavar="WxH", help="pixels (default 512x512)")
    add = parser.add_argument_group("colours of a .png").add_argument
    add("--colormap", metavar="NAME", help="(default viridis)")
    add("--norm", choices=NORMS, help="(default: log where values span more than a decade)")
    add("--range", nargs=2, type=float, metavar=("LOW", "HIGH"), help="values that the colours span (default: nearly all)")


def run(options: argparse.Namespace) -> None:
    """Project, write, and say."""
    options = _checked(options)
    output = options.output or Path(Path(options.source).stem + ".exr")
    table = io.read_table(options.source, part_type=options.part_type)
    say("file", f"{options.source}: {table.source}, {len(table):,} particles")
    with wrong_usage(of=io.ConditionError):
        table = chosen(table, "density", options.support, options.kernel, **cli_where.selected(options))
    particles, report = io.particles_from_table(table, "x", options.support, options.kernel)
    say("support", f"{span(particles.to_numpy()['support'])}: {report.support}")
    say("kernel", report.kernel)
    say_notes(report.notes)
    columns = _Columns(table, particles)
    of, weight, name, what = _asked(columns, options)
    say("values", what)
    camera = _camera(particles, options)
    say("camera", camera.describe())
    image, seconds = _projected(particles, camera, (of, weight), options.pixel, name)
    values = np.asarray(image.values)
    image.save(output, **_look(options))
    say("image", f"{output}, {name} {span(values[np.isfinite(values)])}")
    if weight is None and not camera.is_perspective:
        say("total", f"{float(image.total()):.7g} in the image, of {float(np.sum(of)):.7g}")
    say("time", f"{sum(seconds.values()):.2f} s: " + ", ".join(f"{stage} {took:.2f} s" for stage, took in seconds.items()))


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
        image = project(particles, camera, *held, pixel=pixel, plan=plan, name=name, clock=clock)
        tell(2, 2)
    return image, {"plan": planned, "compile": clock.seconds["compile"], "cast": clock.seconds["cast"]}


def _checked(options: argparse.Namespace) -> argparse.Namespace:
    """The options; `UsageError` where they exclude each other, or are out of range."""
    options = cli_where.settled(options)
    if options.output is not None and options.output.suffix.lower() not in SUFFIXES:
        raise UsageError(f"{options.output}: a projection must be {', '.join(SUFFIXES)}")
    cli_options.require_support(options)
    if options.axis is not None and options.eye is not None:
        raise UsageError("--axis and --eye exclude each other: rays are parallel or spread from the eye")
    if options.eye is None:
        refuse(options, ("target", "up", "fov"), "needs --eye: from where should it be looked at?")
    if options.emission is not None and options.weight is not None:
        raise UsageError("--emission is an integral, not a mean: leave out --weight")
    if options.depth_range is not None and not options.depth_range[0] < options.depth_range[1]:
        raise UsageError(f"--depth-range must ascend, got {options.depth_range[0]:g} {options.depth_range[1]:g}")
    png = options.output is not None and options.output.suffix.lower() == ".png"
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

    def _summed(self) -> np.ndarray:
        support = self._particles.to_numpy()["support"].astype(np.float64)
        mass = None if self.mass_name is None else self.mass
        return io.kernel_sum(self.table.position, support, mass, kernel=self._particles.kernel, box=self.table.box_size)


def _asked(columns: _Columns, options: argparse.Namespace) -> tuple[np.ndarray, np.ndarray | None, str, str]:
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


def _camera(particles: Particles, options: argparse.Namespace) -> Camera:
    depths = None if options.depth_range is None else tuple(options.depth_range)
    if options.eye is not None:
        return cli_scene.camera_of(particles, options, depths)
    with wrong_usage():
        return Camera.along_axis(particles, options.axis or "z", *options.size, depth_range=depths)


def _look(options: argparse.Namespace) -> dict[str, Any]:
    given = {"colormap": options.colormap, "norm": options.norm, "range": options.range}
    return {name: value for name, value in given.items() if value is not None}
