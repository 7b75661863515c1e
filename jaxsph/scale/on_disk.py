"""Snapshots whose particles stay on disk: a sample of them, and those that some pixels of an image can see, by planes.

Flow: snapshot, index, Planes -> [on_disk: OnDisk] -> columns of particles -> from_disk.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxsph import scenes
from jaxsph.io.disk.index import Snapshot, SnapshotIndex, index_of, needed_columns, supports_and_volumes, together
from jaxsph.io.settle.assemble import in_box, kernel_of, opacity_of
from jaxsph.io.settle.quantities import ROLES, choose_quantity
from jaxsph.io.table import ParticleTable
from jaxsph.model.camera.camera import Camera
from jaxsph.model.particles.particles import Particles
from jaxsph.model.transfer.function import TransferFunction

SAMPLED = 1 << 16
"""Particles, about, by which colours, plans and parts are chosen."""
MOST_EXTREMES = 2
"""Particles that come along wherever they are: the widest and the strongest."""
Columns = tuple[np.ndarray, ...]
Places = frozenset[tuple[int, int]]  # files and rows of some particles


SLACK = 256 * float(np.finfo(np.float32).eps)
"""Of coordinates and supports, that a distance may be off by where the camera's numbers are float32."""


class Planes(NamedTuple):
    """A convex region: points x with n . (x - origin) <= d for all planes.

    Attributes:
        origin: of the coordinates, float64.
        normals: n, of any length.
        offsets: d.
    """

    origin: Float[np.ndarray, "3"]
    normals: Float[np.ndarray, "planes 3"]
    offsets: Float[np.ndarray, " planes"]

    def meet(self, position: Float[np.ndarray, "places 3"], reach: Float[np.ndarray, " places"]) -> Bool[np.ndarray, " places"]:
        """Whether spheres can reach into the region: never false where one does, seldom true where none does."""
        offset = position - self.origin
        slack = SLACK * (np.abs(offset).max(initial=0) + np.abs(position).max(initial=0))
        return self._meet(offset, reach * (1 + SLACK) + slack)

    def meet_boxes(
        self, lower: Float[np.ndarray, "boxes 3"], upper: Float[np.ndarray, "boxes 3"], reach: Float[np.ndarray, " boxes"]
    ) -> Bool[np.ndarray, " boxes"]:
        """Whether any sphere whose middle lies in a box can, none of which is larger than its `reach`."""
        half, middle = (upper - lower) / 2, (upper + lower) / 2
        inside = half @ np.abs(self.normals).T
        slack = SLACK * (
            np.abs(middle - self.origin).max(1, initial=0) + half.max(1, initial=0) + np.abs(middle).max(1, initial=0)
        )
        return self._meet(middle - self.origin, reach * (1 + SLACK) + slack, inside)

    def _meet(self, offset: np.ndarray, reach: np.ndarray, inside: np.ndarray | None = None) -> np.ndarray:
        lengths, met = np.linalg.norm(self.normals, axis=1), np.ones(len(offset), bool)
        for number, (normal, most, length) in enumerate(zip(self.normals, self.offsets, lengths, strict=True)):
            beyond = offset @ normal - reach * length
            met &= (beyond if inside is None else beyond - inside[:, number]) <= most
        return met


def seen_by(camera: Camera, top: int, bottom: int, left: int, right: int) -> Planes:
    """What rays of rows `top` to `bottom - 1` and columns `left` to `right - 1` pass through, between near and far.

    And a pixel around that: so whatever a list of particles takes for touching by rounding is met here, too.
    """
    along_row, up, forward = np.asarray(camera.axes, np.float64)
    low, high = sorted(float(camera.row(jnp.asarray(row, camera.dtype))) for row in (top - 1, bottom + 1))
    least, most = sorted(float(camera.column(jnp.asarray(column, camera.dtype))) for column in (left - 1, right + 1))
    near, far = camera.near_and_far()
    depths = [(-forward, -near), (forward, far)]
    if camera.is_perspective:
        sides = [
            (up - high * forward, 0.0),
            (low * forward - up, 0.0),
            (along_row - most * forward, 0.0),
            (least * forward - along_row, 0.0),
        ]
    else:
        sides = [(up, high), (-up, -low), (along_row, most), (-along_row, -least)]
    normals, offsets = zip(*sides, *depths, strict=True)
    return Planes(camera.exact_eye(), np.stack(normals), np.array(offsets))


def between_depths(camera: Camera) -> Planes:
    """What lies between near and far."""
    seen = seen_by(camera, 0, camera.height, 0, camera.width)
    return Planes(seen.origin, seen.normals[-2:], seen.offsets[-2:])


@dataclasses.dataclass(frozen=True, eq=False)
class OnDisk:
    """A snapshot whose particles stay on disk; made by `OnDisk.open`.

    Attributes:
        snapshot, index: its files, and where in space their particles are.
        quantities: names of the quantity, and of that of extinction if there is another.
        kernel: name of the smoothing kernel.
        sample: some of the particles, evenly taken, with supports so large that they fill as much of space as all of them.
        ramp: how extinction depends on its quantity by default, see `scenes.default_transfer`.
    """

    snapshot: Snapshot
    index: SnapshotIndex
    quantities: tuple[str, ...]
    kernel: str
    sample: Particles
    ramp: str | None = None

    @classmethod
    def open(
        cls,
        path: str | Path,
        quantity: str | None = None,
        *,
        kernel: str | None = None,
        part_type: int | str | None = None,
        opacity_by: str | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> OnDisk:
        """Open a snapshot: Gadget-like HDF5 with supports, masses and densities, in one file or several.

        The first time all of it is read once, to index it; the index is kept beside it.

        Args:
            path: any of its files.
            quantity, kernel, part_type, opacity_by: as for `jaxsph.io.read_particles`; sums over neighbours cannot be had.
            progress: called as `progress(done, total)` while it is indexed.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: another format; particles whose supports or volumes need neighbours; an unknown quantity.

        Warns:
            UserWarning: where the index cannot be kept.
        """
        snapshot = Snapshot(path, part_type)
        index = index_of(snapshot, progress=progress)
        table = _sampled(snapshot, index)
        _, name = choose_quantity(table, quantity)
        _, volume = supports_and_volumes(table)
        mass = table.named(*ROLES["mass"])
        _, second = opacity_of(table, name, opacity_by, volume if mass is None else volume / table.columns[mass], None)
        names = tuple(dict.fromkeys((name, *([] if second is None else [second]))))
        ramp = "even" if name in ("x", "y", "z") else None
        nothing = Particles.from_arrays(np.zeros((0, 3)), 1.0, 0.0)
        opened = cls(snapshot, index, names, kernel_of(table, kernel)[0], nothing, ramp if second is None else "steep")
        position, support, volume, *values = opened.columns_of(table)
        thinned = np.cbrt(max(len(index), 1) / max(len(table), 1))
        sample = opened.particles((position, (support * thinned).astype(support.dtype), volume, *values))
        return dataclasses.replace(opened, sample=sample)

    def __len__(self) -> int:
        return len(self.index)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """See `Camera.framing`: those of the particles in memory, of a periodic box its own."""
        if not len(self):
            return self.index.bounds()
        corners = np.stack([self.index.runs.lower.min(0), self.index.runs.upper.max(0)])
        boxed, _ = in_box(dataclasses.replace(self.snapshot.first, position=corners, columns={}, support=None), "file")
        return self.index.bounds() if boxed.box_size is None else (np.zeros(3), np.asarray(boxed.box_size, np.float64))

    def transfer(self, colormap: str = "viridis", values: tuple[float, float] | None = None, **more: Any) -> TransferFunction:
        """What its particles look like by default, see `scenes.default_transfer`; chosen by the sample."""
        return scenes.default_transfer(self.sample, colormap, values, **{"ramp": self.ramp, **more})

    @functools.cached_property
    def needed(self) -> list[str]:
        """Columns of the files that are read."""
        return needed_columns(self.snapshot.first, *self.quantities)

    def columns_of(self, table: ParticleTable) -> Columns:
        """Positions, supports, volumes and quantities of rows that were read, as particles have them."""
        support, volume = supports_and_volumes(table)
        values = [choose_quantity(table, name)[0] for name in self.quantities]
        dtype = table.position.dtype
        with np.errstate(over="ignore"):
            return table.position, *(column.astype(dtype) for column in (support, volume / self._volume_unit, *values))

    @functools.cached_property
    def _volume_unit(self) -> float:
        """What volumes are divided by where float32 could not hold them: only their ratios matter."""
        limits, volumes = np.finfo(np.float32), self.index.runs.volume
        if not volumes.size or (volumes.max() < np.sqrt(limits.max) and volumes.min() > np.sqrt(limits.tiny)):
            return 1.0
        return float(2.0 ** np.round((np.log2(volumes.min()) + np.log2(volumes.max())) / 2))

    def particles(self, columns: Columns, capacity: int | None = None) -> Particles:
        """Of columns."""
        position, support, volume, *values = columns
        quantity: Any = values[0] if len(values) == 1 else tuple(values)
        return Particles.from_arrays(position, support, quantity, volume, self.kernel, capacity=capacity)

    def seen_by(self, planes: Planes, always: Places = frozenset(), most: int | None = None) -> Columns | None:
        """The particles whose supports reach into a region, and some others, in the order of the files.

        None where there are more than `most`: so many are never held.
        """
        parts: list[Columns] = []
        for file, begin, columns in self.read(planes, always):
            kept = planes.meet(columns[0].astype(np.float64), columns[1].astype(np.float64))
            kept[[row - begin for which, row in always if which == file and begin <= row < begin + len(kept)]] = True
            parts.append(tuple(column[kept] for column in columns))
            if most is not None and sum(len(part[0]) for part in parts) > most:
                return None
        if not parts:
            first = int(self.index.runs.file[0]) if len(self) else 0
            parts.append(self.columns_of(self.snapshot.read(first, slice(0, 0), self.needed)))
        return tuple(np.concatenate(each) for each in zip(*parts, strict=True))

    def count(self, planes: Planes) -> int:
        """How many particles reach into a region, and those that come along wherever they are; of any number none are held."""
        met = (planes.meet(where.astype(np.float64), reach.astype(np.float64)) for _, _, (where, reach, *_) in self.read(planes))
        return sum(int(some.sum()) for some in met) + MOST_EXTREMES

    def read(self, planes: Planes, always: Places = frozenset()) -> Iterator[tuple[int, int, Columns]]:
        """File, first row and columns of all runs that reach into a region, and of those of some others, some at a time."""
        runs = self.index.runs
        held = planes.meet_boxes(runs.lower, runs.upper, runs.support) if len(runs) else np.zeros(0, bool)
        for file, row in always:
            held |= (runs.file == file) & (runs.begin <= row) & (row < runs.end)
        for file, rows in together(runs[held][["file", "begin", "end"]].tolist()):
            begin, end = rows[0][0], rows[-1][1]
            yield file, begin, self.columns_of(self.snapshot.read(file, slice(begin, end), self.needed))

    def extremes(self, camera: Camera) -> Places:
        """File and row of the widest and of the strongest particle between near and far."""
        runs, planes = self.index.runs, between_depths(camera)
        met = runs[planes.meet_boxes(runs.lower, runs.upper, runs.support)] if len(runs) else runs
        found = set()
        for row, value in (("widest", "support"), ("strongest", "strength")):
            for run in np.argsort(-met[value], kind="stable"):
                place = int(met.file[run]), int(met[row][run])
                position, support, *_ = self.columns_of(self.snapshot.read(place[0], slice(place[1], place[1] + 1), self.needed))
                if planes.meet(position.astype(np.float64), support.astype(np.float64))[0]:
                    found.add(place)
                    break
        return frozenset(found)


def _sampled(snapshot: Snapshot, index: SnapshotIndex) -> ParticleTable:
    """Rows at the beginning of every run."""
    each = max(SAMPLED // max(len(index.runs), 1), 1)
    rows = index.runs[["file", "begin", "end"]].tolist()
    tables = [snapshot.read(int(file), slice(int(begin), min(int(begin) + each, int(end)))) for file, begin, end in rows]
    if not tables:
        return snapshot.read(0, slice(0, 0))
    names = set.intersection(*(set(table.columns) for table in tables))
    columns = {name: np.concatenate([table.columns[name] for table in tables]) for name in tables[0].columns if name in names}
    supports = [table.support for table in tables if table.support is not None]
    position = np.concatenate([table.position for table in tables])
    return dataclasses.replace(tables[0], position=position, columns=columns, support=np.concatenate(supports))
