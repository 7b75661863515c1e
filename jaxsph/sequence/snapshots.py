"""A sequence of particle files as one thing that changes in time: one look for all of it, and particles at any moment.

Flow: files -> survey -> [snapshots] -> Scene at a time -> frames.
"""

from __future__ import annotations

import bisect
import dataclasses
import functools
import os
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxsph import io, scenes
from jaxsph.io.opening.options import Source
from jaxsph.io.replace import digest_of, fingerprint
from jaxsph.io.settle.matching import between, ids_of, velocity_of
from jaxsph.model.clips import Clip
from jaxsph.model.particles.particles import Particles, capacity_class
from jaxsph.model.scene import Scene, Surface
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.numerics.checks import Progress, array_of, record_of
from jaxsph.sequence.survey import Survey, UnreadFile, Way, Who, surveyed, table_of, way_between

ROUNDING = 1e-9  # share of the way between two snapshots by which a time may miss one of them, and mean it


class Loaded(NamedTuple):
    """The particles of one snapshot, and what is known of who they are."""

    columns: dict[str, np.ndarray]
    kernel: str
    who: Who


@dataclasses.dataclass(frozen=True, eq=False)
class Snapshots:
    """Particles that change from file to file; make it with `from_files`.

    Attributes:
        survey: the files in the order of time, and what they hold.
        transfer: what they look like, all of them.
        center: middle of the periodic box that all files have, where it is not their own.
        within: where they are shown; None is everywhere.
        surface: by which they are shown, all of them; None shows a medium.
    """

    survey: Survey
    transfer: TransferFunction
    center: tuple[float, float, float] | None = None
    within: Clip | None = None
    surface: Surface | None = None
    _loaded: dict[int, Loaded] = dataclasses.field(default_factory=dict, repr=False)
    _ways: dict[int, Way | str] = dataclasses.field(default_factory=dict, repr=False)

    @classmethod
    def from_files(
        cls,
        paths: Iterable[str | os.PathLike[str]],
        quantity: str | None = None,
        *,
        center: Any = None,
        within: Clip | None = None,
        transfer: TransferFunction | None = None,
        colormap: str = "viridis",
        surface: Surface | None = None,
        gaps: bool = False,
        strict: bool = True,
        progress: Progress | None = None,
        **source: Any,
    ) -> Snapshots:
        """Read all files once, for their times and the range of the quantity over all of them.

        Args:
            paths: of particle files, in any order: times in the files order them, else numbers in their names.
            quantity: as for `jaxsph.io.read_particles`; one that is chosen is chosen by the file in the middle, and taken of all.
            center: (3,) middle of the periodic box, or "densest" for the densest point of the file in the middle.
            within: where particles are shown; default everywhere.
            transfer: what particles look like; by default `colormap` over nearly all values of all files, with an extinction
                that suits the file in the middle.
            colormap: name of a colour map.
            surface: by which particles are shown, in the colours of `transfer`; None shows a medium, of liquids, too.
            gaps: whether numbers may be missing in the names of the files.
            strict: whether files that cannot be read are refused. Else the sequence is that of all others, and times between
                the two beside such a file have no scene.
            progress: called as `progress(done, total)` after every file.
            source: `support`, `kernel`, `part_type`, `box`, `where`, `share`, `opacity_by`, and `color_by` for `quantity`, as
                for `jaxsph.io.read_scene`; a share is of the same particles in all files that have ids, and opacity by `"auto"`
                is by the file in the middle.

        Raises:
            FileNotFoundError: there is no such file.
            TypeError: an argument that there is not.
            ValueError: files that cannot be read, each by name, or all of them; two of one time; a number that is missing.
        """
        how = record_of(Source, source, cls.from_files)
        how = how if quantity is None else dataclasses.replace(how, color_by=quantity)
        survey = surveyed(paths, how, gaps=gaps, strict=strict, progress=progress)
        if transfer is None:
            ramp = None if survey.report.opacity_by is None else "steep"
            transfer = scenes.default_transfer(survey.middle, colormap, survey.span, ramp=ramp)
        return cls(survey, transfer, center_of(survey, center), within, surface)

    @property
    def times(self) -> tuple[float, ...]:
        """Of the snapshots, ascending."""
        return self.survey.order.times

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the box around all particles of all snapshots: something to frame."""
        lower, upper = self.survey.bounds()
        if self.center is None:
            return lower, upper
        return np.array(self.center) - (upper - lower) / 2, np.array(self.center) + (upper - lower) / 2

    def at(self, time: float) -> Scene:
        """Particles at a time: those of a file, or between two.

        Where ids match, particles move from one file to the next on the shortest way in a periodic box: on the cubic that has
        their velocities at its ends where files have velocities that lead to where particles are, else straight and evenly.
        Supports and volumes change geometrically, the quantity linearly. Particles that are in one of the two alone are there
        for the half of the time that is nearer to it. Where ids do not match, or are not there, it is the nearer file.
        """
        particles = self._particles(*self.place(time))
        return Scene(particles=particles, transfer=self.transfer, within=self.within, surface=self.surface)

    def moments(self, times: Sequence[float]) -> list[Moment]:
        """Sources of frames at such times, each read when it is its turn."""
        return [Moment(self, float(time)) for time in times]

    def each(self) -> list[Moment | UnreadFile]:
        """One source a file, in the order of time; of files that cannot be read, too."""
        sources: list[Moment | UnreadFile] = [*self.moments(self.times)]
        for unread in reversed(self.survey.unread):
            sources.insert(unread.before + 1, unread)
        return sources

    def place(self, time: float) -> tuple[int, float]:
        """Which snapshot is before a time, and the share of the way to the next, in [0, 1)."""
        times = self.times
        if not times[0] <= time <= times[-1]:
            raise ValueError(f"`time` must lie in [{times[0]:g}, {times[-1]:g}], where there are snapshots, got {time:g}")
        before = bisect.bisect_right(times, time) - 1
        if before == len(times) - 1:
            return before, 0.0
        share = (time - times[before]) / (times[before + 1] - times[before])
        if share > 1 - ROUNDING:
            return before + 1, 0.0
        if share <= ROUNDING:
            return before, 0.0
        unread = [file.why for file in self.survey.unread if file.before == before]
        if unread:
            raise ValueError(f"there is no scene between times {times[before]:g} and {times[before + 1]:g}: {'; '.join(unread)}")
        return before, share

    def fingerprint(self, time: float) -> str:
        """A digest of all that the picture of a time depends on: files by their names, sizes and times of change."""
        before, share = self.place(time)
        files = [file.identity for file in self.survey.files[before : before + 1 + (share > 0)]]
        read = self.survey.source, self.survey.quantity, self.center
        return fingerprint("s", files, share, *read, digest_of((self.transfer, self.within, self.surface)))

    def _particles(self, before: int, share: float) -> Particles:
        first = self._load(before)
        if share == 0:
            return self._packed(first.columns, first.kernel)
        second = self._load(before + 1)
        if before not in self._ways:
            self._ways.clear()
            duration = self.times[before + 1] - self.times[before] if self.survey.order.by_files else None
            self._ways[before] = way_between(first.who, second.who, duration, self.survey.box)
        way = self._ways[before]
        if isinstance(way, str):
            nearer = first if share < 0.5 else second
            return self._packed(nearer.columns, nearer.kernel)
        matched, _, run = way
        return self._packed(between(first.columns, second.columns, matched, share, self.survey.box, run), first.kernel)

    def _load(self, number: int) -> Loaded:
        """A snapshot's particles; those of two files are kept."""
        if number not in self._loaded:
            for other in [other for other in self._loaded if abs(other - number) > 1]:
                del self._loaded[other]
            while len(self._loaded) > 1:
                del self._loaded[min(self._loaded)]
            file = self.survey.files[number]
            table = table_of(self.survey.source, file.path)
            quantity, by = self.survey.quantity, self.survey.report.opacity_by
            particles, _ = io.particles_from_table(table, quantity, *self.survey.source.how, opacity_by=by)
            exact = particles.places()
            who = ids_of(table), exact, velocity_of(table)
            self._loaded[number] = Loaded({**particles.to_numpy(), "position": exact}, particles.kernel, who)
        return self._loaded[number]

    def _packed(self, columns: dict[str, np.ndarray], kernel: str) -> Particles:
        """Particles with room for those of the largest file, and of one structure, so that all frames share programs."""
        wide = self.survey.wide
        position = columns["position"] if wide else columns["position"].astype(np.float32)
        others: dict[str, Any] = {name: column.astype(position.dtype) for name, column in columns.items() if name != "position"}
        if "extinction_quantity" in others:
            others["quantity"] = others["quantity"], others.pop("extinction_quantity")
        made = Particles.from_arrays(position, **others, kernel=kernel, capacity=self.capacity, box=self.survey.box)
        if wide and made.dtype == jnp.float32 and made.position_rest is None:
            made = dataclasses.replace(made, position_rest=array_of(np.zeros(made.position.shape, np.float32)))
        return made if self.center is None else made.centered(self.center)

    @property
    def capacity(self) -> int:
        """Entries of the particle arrays at any time."""
        return capacity_class(max(file.num_particles for file in self.survey.files))

    def __getstate__(self) -> dict[str, Any]:
        """Without what was read, so that a source can be sent to where its frame is rendered, which may be in another folder."""
        files = tuple(dataclasses.replace(file, path=file.path.absolute()) for file in self.survey.files)
        survey = dataclasses.replace(self.survey, files=files)
        return {**self.__dict__, "survey": survey, "_loaded": {}, "_ways": {}}


def center_of(survey: Survey, at: Any) -> tuple[float, float, float] | None:
    """Middle of the period that is asked for; of "densest" that of the file in the middle."""
    if at is None:
        return None
    if survey.box is None:
        raise ValueError("`center` is for periodic boxes, and these files do not have one; give its sides by `box`")
    lower, upper = survey.middle.centered(at).bounds()
    x, y, z = (float(value) for value in (lower + upper) / 2)
    return x, y, z


@dataclasses.dataclass(frozen=True, eq=False)
class Still:
    """One scene as a sequence in which nothing changes, of which a digest is taken once."""

    scene: Scene

    def at(self, _: float) -> Scene:
        """The scene."""
        return self.scene

    def fingerprint(self, _: float) -> str:
        """A digest of all of its arrays, and of what they are called."""
        return self._digest

    @functools.cached_property
    def _digest(self) -> str:
        return digest_of(self.scene)


@dataclasses.dataclass(frozen=True, eq=False)
class Moment:
    """A sequence at a time, as the source of a frame; on its way to a worker, with its name there."""

    snapshots: Any
    time: float = 0.0

    def __call__(self) -> Scene:
        """The scene, read now."""
        return self.snapshots.at(self.time)  # type: ignore[no-any-return]

    @property
    def fingerprint(self) -> str:
        """A digest of all that its picture depends on, known without reading particles."""
        return str(self.snapshots.fingerprint(self.time))
