"""All bands of a frame, one after the other or on several devices; the rays of a quadtree, or along outlines, chosen among all.

Flow: frame, run -> [bands: frame | quadtree | outlines] -> layers, faults -> image.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import threading
from concurrent.futures import ThreadPoolExecutor

import jax

from jaxsph.engine.frame.frame import Frame, Told
from jaxsph.engine.frame.outlines import outlined
from jaxsph.engine.frame.quadtree import refined
from jaxsph.engine.frame.stages import Drawn
from jaxsph.engine.planning.viewing import measure
from jaxsph.engine.runtime.executors import Dealing, Eager, Run
from jaxsph.numerics.checks import Progress


def draw_bands(frame: Frame, run: Run, progress: Progress | None = None) -> Drawn:
    """Draw all bands on the devices of a run; `progress(done, total)` is called after each."""
    plan, done, lock = frame.plan, itertools.count(1), threading.Lock()
    chooses = refined if plan.quadtree is not None else outlined if frame.formulas.antialias > 1 else None

    def pairs() -> list[int]:
        """Particles and bundles that meet, band by band; at most so many."""
        if plan.bands == 1:
            return [0]
        rows, tiles = measure(frame.seen.viewed, frame.camera, plan.samples).bundle_pairs, plan.lists.tile_rows
        return [int(rows[first : first + tiles].sum()) for first in range(0, plan.bands * tiles, tiles)]

    def told(run: Run) -> None:
        """How many bands are done, on whichever thread; those that are foreseen are not."""
        if progress is not None and not run.foreseeing:
            with lock:
                progress(next(done), plan.bands)

    dealt = run.dealt(pairs, plan.shards, chooses is not None)
    shared = dataclasses.replace(frame, plan=plan.dealt(dealt.shards), shards=dealt.shards)
    if len(dealt.groups) > 1:
        return shared.joined(run, _side_by_side(shared, dealt, run, told))  # type: ignore[arg-type]
    whole = shared.of_bands if chooses is None else functools.partial(chooses, shared)
    return run.foreseen(functools.partial(whole, run, told))


def _side_by_side(frame: Frame, dealt: Dealing, run: Eager, told: Told) -> list[Drawn]:
    """All bands in order, those of each group drawn on a thread of its own."""
    runs, wide = [Eager(group) for group in dealt.groups], jax.config.read("jax_enable_x64")
    run.mark("plan")

    def draw(run: Eager, numbers: tuple[int, ...]) -> list[Drawn]:
        with jax.enable_x64(wide):  # which a thread does not inherit
            return run.foreseen(lambda: frame.bands(run, numbers, told))

    with ThreadPoolExecutor(len(runs)) as threads:
        drawn = threads.map(draw, runs, dealt.bands)
        pairs = [zip(numbers, bands, strict=True) for numbers, bands in zip(dealt.bands, drawn, strict=True)]
    run.absorb(runs)
    places = dict(itertools.chain(*pairs))
    return [places[number] for number in range(frame.plan.bands)]
