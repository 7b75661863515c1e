"""All bands of a frame, one by one: on one device, or dealt out to several of this process.

Flow: seen, plan -> [bands: groups of devices -> Frame -> bands] -> Drawn -> images.

Bundles are independent of each other, and so are bands: each has the lists, the decisions and the estimates that it has on one
device. So devices form groups of one size: every group ranks the particles for itself and renders the bands that are dealt to it,
the fullest first; within a group, each device decides and casts the bundles of its shard. Nothing is exchanged but the lists of a
band within a group, and pixels. One device is a group of its own.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp

from jaxsph.engine.frame.frame import Frame
from jaxsph.engine.frame.images import image_of
from jaxsph.engine.frame.layers import Band, Drawn, Layers, develop
from jaxsph.engine.frame.refinement import refined
from jaxsph.engine.planning.measures import measure
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.planning.viewing import Seen
from jaxsph.engine.runtime.executors import Clock, Devices, Executor, OnDevices
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.scene import Formulas
from jaxsph.model.settings import Settings
from jaxsph.numerics.checks import Progress, array_of

MANY = 4  # bands for each device, of which one more or less does not matter


@dataclasses.dataclass(frozen=True)
class Work:
    """A frame to be drawn: what is seen, and how.

    Attributes:
        plan: of the frame, or of those of its rows that begin at `first_row`.
    """

    seen: Seen
    camera: Camera
    settings: Settings
    plan: Plan
    formulas: Formulas
    first_row: int = 0

    def drawn(self, clock: Clock, progress: Progress | None = None) -> Drawn:
        """All bands, on the devices of a clock."""
        least, told = self.plan.shards, _Told(progress, self.plan.bands)
        if not clock.devices:
            dealt, work = Dealing(((),), (tuple(range(self.plan.bands)),), least), self
        else:
            pairs, whole = _pairs_of_bands(self.seen, self.camera, self.plan), self.plan.quadtree is not None
            dealt = dealing(clock.devices, pairs, least, whole)
            work = dataclasses.replace(self, plan=self.plan.dealt(dealt.shards))
        if len(dealt.groups) > 1:
            bands = _side_by_side(work, dealt, clock, told)
            return work.developed(clock, bands)
        draw = functools.partial(work.in_order, dealt.shards)
        clock.foresee(lambda run: draw(run, None))
        return draw(clock, told)

    def image(self, clock: Clock, progress: Progress | None = None, *, planned: bool = True) -> Image:
        """The image of it; `planned`: whether capacities were made for this very frame."""
        drawn, about = self.drawn(clock, progress), (self.camera, self.settings, self.plan, self.formulas, clock)
        return image_of(drawn, *about, planned=planned)

    def in_order(self, shards: int, run: Executor, told: _Told | None) -> Drawn:
        """All bands one after the other; a quadtree is of all of them."""
        if self.plan.quadtree is None:
            return self.developed(run, self.bands(shards, run, range(self.plan.bands), told))
        return refined(self.begun(shards, run), run, self.seen.viewed.faults, None if told is None else told.progress)

    def begun(self, shards: int, run: Executor) -> Frame:
        """With the particles ranked."""
        return Frame.begun(self.seen, self.camera, self.settings, self.plan, self.formulas, shards, run)

    def bands(self, shards: int, run: Executor, numbers: Sequence[int], told: _Told | None) -> list[Band]:
        """Bands of those numbers."""
        frame, found = self.begun(shards, run), []
        for number in numbers:
            found.append(frame.band(array_of(self.first_row + number * self.plan.band_height, jnp.int32), run))
            if told is not None:
                told.one_more()
        return found

    def developed(self, run: Executor, bands: list[Band]) -> Drawn:
        """The layers of the image, of all bands."""
        of_shards = tuple(band.of_shards for band in bands)
        layers: Layers = run.one("image", develop, (of_shards,), plan=dataclasses.replace(self.plan, control=None))
        return Drawn.of(layers, bands, self.seen.viewed.faults)


@dataclasses.dataclass(frozen=True)
class Dealing:
    """Who renders what.

    Attributes:
        groups: devices that render a band together, all of as many.
        bands: numbers of the bands of each group.
        shards: of every band.
    """

    groups: tuple[Devices, ...]
    bands: tuple[tuple[int, ...], ...]
    shards: int


def dealing(devices: Devices, pairs: Sequence[int], least_shards: int, whole: bool = False) -> Dealing:
    """Deal bands with so many pairs to devices; `whole`: all of them work on every band.

    A band goes to the group that has the fewest pairs so far, the fullest bands first: no group then has more than 4/3 of the
    pairs of the best dealing's fullest group (Graham 1969).
    """
    number = 1 if whole else len(devices) if len(pairs) >= MANY * len(devices) else math.gcd(len(devices), len(pairs))
    size = len(devices) // number
    groups = tuple(devices[first : first + size] for first in range(0, len(devices), size))
    load, bands = [0] * number, [[] for _ in range(number)]  # type: ignore[var-annotated]
    for band in sorted(range(len(pairs)), key=lambda band: -pairs[band]):
        least = min(range(number), key=lambda group: (load[group], len(bands[group])))
        load[least] += pairs[band]
        bands[least].append(band)
    shards = -(-least_shards // size) * size
    return Dealing(groups, tuple(tuple(sorted(one)) for one in bands), shards)


def _side_by_side(work: Work, dealt: Dealing, clock: Clock, told: _Told) -> list[Band]:
    """All bands in order, those of each group drawn on a thread of its own."""
    runs, wide = [OnDevices(group) for group in dealt.groups], jax.config.read("jax_enable_x64")
    clock.mark("plan")

    def draw(run: OnDevices, numbers: tuple[int, ...]) -> list[Band]:
        with jax.enable_x64(wide):  # which a thread does not inherit
            run.foresee(lambda forecast: work.bands(dealt.shards, forecast, numbers, None))
            return work.bands(dealt.shards, run, numbers, told)

    with ThreadPoolExecutor(len(runs)) as threads:
        found = list(threads.map(draw, runs, dealt.bands))
    clock.absorb(runs)
    pairs = [zip(numbers, bands, strict=True) for numbers, bands in zip(dealt.bands, found, strict=True)]
    places = {number: band for of_group in pairs for number, band in of_group}
    return [places[number] for number in range(work.plan.bands)]


def _pairs_of_bands(seen: Seen, camera: Camera, plan: Plan) -> list[int]:
    """Particles and bundles that meet, band by band; at most so many."""
    if plan.bands == 1:
        return [0]
    rows = measure(seen.viewed, camera, plan.samples).bundle_pairs
    tiles = plan.lists.tile_rows
    return [int(rows[first : first + tiles].sum()) for first in range(0, plan.bands * tiles, tiles)]


class _Told:
    """Counts bands that are done, on whichever thread."""

    def __init__(self, progress: Progress | None, bands: int) -> None:
        self.progress, self._bands, self._done, self._lock = progress, bands, 0, threading.Lock()

    def one_more(self) -> None:
        """Tell that another is done."""
        with self._lock:
            self._done += 1
            if self.progress is not None:
                self.progress(self._done, self._bands)
