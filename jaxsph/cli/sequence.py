"""A sequence of particle files on the command line: its snapshots with one look, said on the way.

Flow: files, options -> survey -> [sequence] -> Snapshots, Camera -> the commands movie and view.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from jaxsph import io
from jaxsph.cli import look as cli_look
from jaxsph.cli import where as cli_where
from jaxsph.cli.console import UsageError, progress, refuse, say_notes, say_report, span, wrong_usage
from jaxsph.cli.options.settings import SCENE
from jaxsph.cli.voice import say
from jaxsph.io.opening import options as opening
from jaxsph.io.opening.surfaces import coloured_of, surface_of, told_of_surface
from jaxsph.io.settle.assemble import AUTO
from jaxsph.model import Camera, Scene
from jaxsph.model.camera.camera import Bounded
from jaxsph.model.preview.frame import across_faces, bulk_of_period
from jaxsph.sequence.snapshots import Snapshots
from jaxsph.sequence.survey import Survey, surveyed


def snapshots_of(options: Any, *, gaps: bool, strict: bool) -> tuple[Snapshots, Camera, Bounded]:
    """The snapshots and their look, as said on the way; a camera, and what there ever is."""
    for path in options.source:
        if path.startswith(SCENE) or (Path(path).exists() and io.is_volume(path)):
            raise UsageError(f"a sequence is one of particle files, but there is {path}; give it alone")
    refuse(options, ("iso", "volume", "points", "mix"), "is not for a sequence of particle files")
    by = options.surface_of or options.opacity_by or (None if options.transfer is not None else AUTO)
    said = {field.name: getattr(options, field.name) for field in dataclasses.fields(opening.Source)}
    source = opening.Source(**said | {"opacity_by": by})
    with progress("read", " files") as show, wrong_usage(of=io.ConditionError):
        try:
            survey = surveyed(options.source, source, gaps=gaps, strict=strict, progress=show)
        except ValueError as error:
            if "missing" in str(error) and not gaps:
                raise ValueError(f"{error}; --gaps goes on without") from error
            raise
    _say_survey(survey)
    options = cli_where.upward(options, survey.report.up, survey.report.source)
    looks = options if options.transfer is not None else dataclasses.replace(options, range=options.range or survey.span)
    surface = surface_of(survey.middle, survey.report, options, options, clipped=bool(options.clips))
    colored = survey.middle if surface is None else coloured_of(survey.middle)
    transfer = cli_look.look(colored, looks, survey.quantity)
    of_range = "as asked for" if options.range else f"nearly all values of all {len(survey.files)} snapshots"
    say("", f"for all frames; range: {of_range}; extinction: by {survey.report.path}")
    center, middle = cli_where.middle_of(survey, options), Scene(particles=survey.middle, transfer=transfer)
    if center is None and options.eye is None and not options.clips and (place := across_faces(middle)) is not None:
        center = tuple(place.tolist())
        say("box", f"its middle is {' '.join(f'{one:.6g}' for one in center)}, as what is shown lies across its faces")
    if surface is not None:
        say("surface", f"{told_of_surface(surface, options)}; all frames alike, by {survey.report.path}")
    snapshots = Snapshots(survey, transfer, center, cli_where.clip_of(options), surface)
    placed = dataclasses.replace(options, center=None) if center is not None else options
    if center is not None:
        middle = dataclasses.replace(middle, particles=survey.middle.centered(center))
    shown = (None if options.clips or options.eye is not None else bulk_of_period(middle)) or snapshots
    return snapshots, cli_where.camera_of(shown, placed), cli_where.left_by(snapshots.within, shown)


def _say_survey(survey: Survey) -> None:
    files, times = survey.files, survey.order.times
    counts = span([file.num_particles for file in files])
    say("sequence", f"{len(files)} snapshots, {files[0].path} to {files[-1].path}, {counts} particles each")
    say("times", f"{span(times)}, {survey.order.told}")
    for unread in survey.unread:
        say("unread", f"{unread.why}; frames that need it are left out")
    for sentence in survey.told():
        say("between", sentence)
    say_report(survey.report)
    say_notes(survey.report.notes)
