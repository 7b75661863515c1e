"""Files of particles on the command line: what is shown of them, and what `info` says.

Flow: file, options -> [cli_particles] -> Scene -> cli.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

from jaxsph import io
from jaxsph.cli import annotate as cli_annotate
from jaxsph.cli import transfer as cli_transfer
from jaxsph.cli import where as cli_where
from jaxsph.cli.console import UsageError, attributes, say, span
from jaxsph.model import Particles, Scene

COORDINATES = "x", "y", "z"


def scene_of(options: argparse.Namespace) -> tuple[Scene, Particles]:
    """The particles of the source under a colour map; and what there is to frame."""
    if options.support is not None and not (np.isfinite(options.support) and options.support > 0):
        raise UsageError(f"--support must be > 0, got {options.support:g}")
    table = _table(options)
    say("file", f"{options.source}: {table.source}, {len(table):,} particles")
    particles, report = _particles(table, options)
    columns = particles.to_numpy()
    say("support", f"{span(columns['support'])}: {report.support}")
    say("volume", report.volume)
    say("kernel", report.kernel)
    _say_quantities(report, columns)
    for note in report.notes:
        say("note", note)
    cli_annotate.label_file(table, report.quantity, columns["quantity"], options, report.opacity_by)
    particles = cli_where.centered(particles, options)
    return Scene(particles=particles, transfer=cli_transfer.look(particles, options, report.quantity, ramp_of(report))), particles


def ramp_of(report: io.Report) -> str | None:
    """How extinction depends on its quantity by default, see `scenes.default_transfer`."""
    return "steep" if report.opacity_by is not None else "even" if report.quantity in COORDINATES else None


def describe(options: argparse.Namespace) -> Particles:
    """Say what a file of particles holds, and what of it would be shown."""
    table = _table(options)
    print(f"{options.source}: {table.source}, {len(table):,} particles")
    attributes(table)
    cli_annotate.describe(table)
    print("\n`jaxsph render` would show")
    particles, report = _particles(table, options)
    columns = particles.to_numpy()
    _say_quantities(report, columns)
    say("support", f"{span(columns['support'])}: {report.support}")
    say("volume", report.volume)
    say("kernel", report.kernel)
    for note in report.notes:
        if note not in table.conventions:
            say("note", note)
    return particles


def _particles(table: io.ParticleTable, options: argparse.Namespace) -> tuple[Particles, io.Report]:
    """Those that are asked for."""
    with cli_where.conditions():
        return io.particles_from_table(
            table,
            options.quantity,
            options.support,
            options.kernel,
            opacity_by=opacity_by(options),
            **cli_where.selected(options),
        )


def opacity_by(options: argparse.Namespace) -> str | None:
    """What opacity is looked up by: nothing of its own where the whole transfer function is said."""
    if options.opacity_by is not None:
        return str(options.opacity_by)
    said = any(getattr(options, name, None) is not None for name in ("transfer", "preset", "domain"))
    return None if said else "auto"


def _say_quantities(report: io.Report, columns: dict[str, np.ndarray]) -> None:
    say("quantity", f"{report.quantity}, {span(columns['quantity'])}")
    if report.opacity_by is not None:
        say("opacity", f"by {report.opacity_by}, {span(columns.get('extinction_quantity', columns['quantity']))}")


def _table(options: argparse.Namespace) -> io.ParticleTable:
    return io.read_table(options.source, part_type=options.part_type, progress=sys.stderr.isatty())
