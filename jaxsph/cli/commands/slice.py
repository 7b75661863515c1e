"""The command `slice`: a quantity on a plane.

Flow: file or scene, options -> Particles, Plane -> slice_of -> [slice] -> NPY, EXR or PNG.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter

from jaxsph.analysis.at_places import slice as slice_of
from jaxsph.cli import scene as cli_scene
from jaxsph.cli import voice
from jaxsph.cli import where as cli_where
from jaxsph.cli.console import UsageError, require_writable, span, wrong_usage
from jaxsph.cli.options import groups, values
from jaxsph.cli.options.groups import CAMERA, OUTPUT, OWN, flag, offered, option, output, word
from jaxsph.cli.scene import SCENE, stem_of
from jaxsph.cli.voice import say
from jaxsph.io import Labels
from jaxsph.io.images.planes import SUFFIXES
from jaxsph.io.opening import options as opening
from jaxsph.io.opening.opened import Loaded
from jaxsph.io.opening.views import length_of
from jaxsph.io.settle.quantities import is_log
from jaxsph.io.units import unit_of, written
from jaxsph.model import Particles, Scene, TransferFunction
from jaxsph.model.camera.framing import UP, VIEWS, sight, upright
from jaxsph.model.clips import Plane


@offered(
    without="opacity_by eye target fov_degrees exposure optical_depth surface surface_of",
    view=word("x|y|z", values.one_of(tuple(VIEWS)), CAMERA, "looked at along an axis (default z)"),
)
class Slice(groups.Options, groups.Key, opening.Look, groups.View, opening.Source):
    """Options of the command."""

    plane: Any = option(
        None,
        "X,Y,Z,NX,NY,NZ",
        values.plane,
        OWN,
        "through X,Y,Z, seen from where NX,NY,NZ points to (default: through the middle)",
    )
    annotate: bool = flag(OUTPUT, "with colour bar, scale bar and axes (a .png)")
    output: Path | None = output(f"{', '.join(SUFFIXES)} (default: FILE's name with .png, here)")


def slice(file: Annotated[str, Parameter(help="a file of particles, or scene:NAME")], /, *, asked: Slice = Slice()) -> None:
    """Show the quantity on a plane, write, and say."""
    options = dataclasses.replace(asked, source=file)
    output = options.output or Path(f"{stem_of(options.source)}.png")
    require_writable(output, "an image must be", SUFFIXES)
    cli_scene.require_key(options, output)
    loaded, transfer = _shown(options)
    particles: Any = loaded.shown
    options = cli_where.placed(options, particles, loaded.table)
    up = options.up or UP
    if options.plane is None:
        forward, up = sight(options.view or "z", up)
        middle = np.mean(particles.bounds(), 0) if options.center is None else options.center
        plane = Plane(tuple(middle), tuple(-forward))
    else:
        plane, up = options.plane, upright(options.plane.normal, up)
    width, height = options.size
    unit = None if loaded.table is None else loaded.table.units.length
    started = time.perf_counter()
    with wrong_usage():
        across = None if options.width is None else length_of(options.width, "width", unit)[0] * height / width
    frame = {"within": cli_where.clip_of(options), "center": options.center, "up": up, "view_height": across}
    made = slice_of(particles, plane, **frame, width=width, height=height)
    there = np.isfinite(made.values)
    if not there.any():
        raise ValueError(f"no particle reaches the plane; there are particles {cli_where.ends_of(*particles.bounds())}")
    told = cli_where.left_out(options)
    if loaded.table is not None and not is_log(loaded.quantity) and (own := unit_of(loaded.table, loaded.quantity)) is not None:
        told.append(("jaxsph.unit", written(own)))
    made = dataclasses.replace(made, metadata=(*made.metadata, *told))
    if cli_scene.has_key(options):
        labels = cli_scene.labels_of(loaded, options) or Labels()
        shown = Scene(particles=particles, transfer=transfer)
        cli_scene.save_with_key(made.image(transfer), shown, made.camera, labels, options, output)
    else:
        made.save(output, transfer)
    found = made.values[there]
    say("slice", f"{span(found)}, {there.mean():.1%} of the pixels inside of supports")
    say("image", f"{output}, {width} x {height}, {made.pixel_size:.6g} a pixel")
    seconds = time.perf_counter() - started
    say("time", f"{seconds:.2f} s")
    voice.written(
        output,
        lowest=float(found.min()),
        highest=float(found.max()),
        inside=float(there.mean()),
        pixel_size=float(made.pixel_size),
        seconds=seconds,
    )


def _shown(options: Any) -> tuple[Loaded, TransferFunction]:
    """The particles, and the colours of their quantity."""
    if options.source.startswith(SCENE):
        name, scene, _ = cli_scene.named_scene(options)
        loaded = Loaded(options.source, scene.particle_set, "concentration")
        say("scene", f"{name}, {scene.particle_set.num_particles:,} particles")
        if not cli_scene.is_looked(options):
            return loaded, scene.looks[0]
    else:
        loaded = cli_scene.loaded_of(options, opacity=False)
    if not isinstance(loaded.shown, Particles):
        raise UsageError(f"{options.source}: a slice is of particles, and this is a volume")
    return loaded, cli_scene.look(loaded.shown, options, loaded.quantity)
