"""One frame over several devices of this process: bands dealt out by their pairs, and the bundles of a band like cards.

Flow: seen, plan -> [over_devices: groups of devices -> Frame -> bands] -> layers.

Bundles are independent of each other, and so are bands: each has the lists, the decisions and the estimates that it has on one
device. So devices form groups of one size: every group ranks the particles for itself and renders the bands that are dealt to it,
the fullest first; within a group, each device decides and casts the bundles of its shard. Nothing is exchanged but the lists of a
band within a group, and pixels.
"""

from __future__ import annotations

import dataclasses
import math
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp

from jaxsph.frame import Band, Frame
from jaxsph.layers import Layers, develop
from jaxsph.measures import measure
from jaxsph.model.camera import Camera
from jaxsph.model.scene import Formulas
from jaxsph.model.settings import Settings
from jaxsph.numerics.device_executors import Devices, OnDevices
from jaxsph.numerics.executors import Executor, Forecast
from jaxsph.numerics.tuning import shards_at_hand
from jaxsph.plan import Plan
from jaxsph.refinement import refined
from jaxsph.viewing import Seen

MANY = 4  # bands for each device, of which one more or less does not matter
Progress = Callable[[int, int], None]


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
    number = _num_groups(len(devices), len(pairs), whole)
    size = len(devices) // number
    groups = tuple(devices[first : first + size] for first in range(0, len(devices), size))
    load, bands = [0] * number, [[] for _ in range(number)]  # type: ignore[var-annotated]
    for band in sorted(range(len(pairs)), key=lambda band: -pairs[band]):
        least = min(range(number), key=lambda group: (load[group], len(bands[group])))
        load[least] += pairs[band]
        bands[least].append(band)
    shards = -(-least_shards // size) * size
    return Dealing(groups, tuple(tuple(sorted(one)) for one in bands), shards)


def _num_groups(devices: int, bands: int, whole: bool) -> int:
    if whole:
        return 1
    return devices if bands >= MANY * devices else math.gcd(devices, bands)


def draw_over_devices(
    seen: Seen, camera: Camera, settings: Settings, plan: Plan, formulas: Formulas, clock: OnDevices, progress: Progress | None
) -> tuple[list[Band], Layers]:
    """All bands in order, and the layers of the image."""
    pairs, whole = _pairs_of_bands(seen, camera, plan), plan.quadtree is not None
    dealt = dealing(clock.devices, pairs, shards_at_hand(plan.cast.tuning), whole)
    plan = plan.dealt(dealt.shards)
    work = _Work(seen, camera, settings, plan, formulas, dealt.shards, _Told(progress, plan.bands))
    if whole:
        clock.foresee(lambda known: work.refined(clock.forecast(known)))
        return work.refined(clock)
    if len(dealt.groups) == 1:
        bands = work.foreseen(clock, dealt.bands[0])
    else:
        bands = _side_by_side(work, dealt, clock)
    images = tuple(band.of_shards for band in bands)
    return bands, clock.one("image", develop, (images,), plan=dataclasses.replace(plan, control=None))


def _side_by_side(work: _Work, dealt: Dealing, clock: OnDevices) -> list[Band]:
    """The bands of each group on a thread of its own."""
    runs, wide = [OnDevices(group) for group in dealt.groups], jax.config.read("jax_enable_x64")
    clock.mark("plan")

    def draw(run: OnDevices, numbers: tuple[int, ...]) -> list[Band]:
        with jax.enable_x64(wide):  # which a thread does not inherit
            return work.foreseen(run, numbers)

    with ThreadPoolExecutor(len(runs)) as threads:
        found = list(threads.map(draw, runs, dealt.bands))
    clock.absorb(runs)
    places = {
        number: band
        for numbers, bands in zip(dealt.bands, found, strict=True)
        for number, band in zip(numbers, bands, strict=True)
    }
    return [places[number] for number in range(work.plan.bands)]


def _pairs_of_bands(seen: Seen, camera: Camera, plan: Plan) -> list[int]:
    """Particles and bundles that meet, band by band; at most so many."""
    if plan.bands == 1:
        return [0]
    rows = measure(seen.viewed, camera, plan.samples).bundle_pairs
    tiles = plan.lists.tile_rows
    return [int(rows[first : first + tiles].sum()) for first in range(0, plan.bands * tiles, tiles)]


@dataclasses.dataclass(frozen=True)
class _Work:
    """A frame that several executors share."""

    seen: Seen
    camera: Camera
    settings: Settings
    plan: Plan
    formulas: Formulas
    shards: int
    told: _Told

    def begun(self, run: Executor) -> Frame:
        """With the particles ranked."""
        return Frame.begun(self.seen, self.camera, self.settings, self.plan, self.formulas, self.shards, run)

    def bands(self, run: Executor, numbers: tuple[int, ...]) -> list[Band]:
        """Bands of those numbers."""
        frame, found = self.begun(run), []
        for number in numbers:
            found.append(frame.band(jnp.int32(number * self.plan.band_height), run))
            if not isinstance(run, Forecast):
                self.told.one_more()
        return found

    def foreseen(self, run: OnDevices, numbers: tuple[int, ...]) -> list[Band]:
        """The same, compiled side by side before."""
        run.foresee(lambda known: self.bands(run.forecast(known), numbers))
        return self.bands(run, numbers)

    def refined(self, run: Executor) -> tuple[list[Band], Layers]:
        """By a quadtree, which all bands share."""
        return refined(self.begun(run), run, None if isinstance(run, Forecast) else self.told.progress)


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
