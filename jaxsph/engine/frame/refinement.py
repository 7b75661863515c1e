"""A frame whose rays are chosen as it is drawn: a coarse lattice first, then the corners of leaves that are not good enough.

Flow: frame -> coarse grid, cast -> [refinement: estimate -> split -> cast] for each size of leaves -> layers.

The loop is that of Kratz et al. 2011, section 5; rays go through the same grid, media and integrator as those of all pixels.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.field.lattice import Lattice
from jaxsph.engine.field.schedule import SlabSchedule
from jaxsph.engine.frame.frame import Frame
from jaxsph.engine.frame.layers import Band, Drawn, Layers, OfShards
from jaxsph.engine.frame.refinement_stages import Shot, Told, begin, choose, finish, join, judge, mark, paint, shoot, spread_over
from jaxsph.engine.frame.stages import BandGrid, Decided, Verdict
from jaxsph.engine.runtime.executors import Executor
from jaxsph.engine.screen.canvas import Canvas
from jaxsph.engine.screen.marking import Quality
from jaxsph.engine.screen.packets import SCATTERED, Queue
from jaxsph.engine.screen.quadtree import QuadtreePlan

MAX_SHOTS = 8  # painted together


class Decisions(NamedTuple):
    """How rays of a band are marched: those of whole bundles, and single ones, for which no lattice of nodes serves."""

    grid: Grid
    of_bundles: Decided
    of_rays: Decided
    lattice: Lattice | None

    @property
    def verdict(self) -> Verdict:
        """What the image tells of them."""
        return self.of_bundles.verdict

    @property
    def of_nodes(self) -> Float[Array, " bundles"]:
        """Evaluations of the lattice of nodes, a pixel of each bundle."""
        return jnp.zeros_like(self.verdict.full) if self.lattice is None else self.lattice.evaluations


@dataclasses.dataclass(frozen=True)
class Refinement:
    """How a frame's canvas is filled."""

    frame: Frame
    sizes: QuadtreePlan
    run: Executor

    @classmethod
    def of(cls, frame: Frame, run: Executor) -> Refinement:
        """That of a frame whose plan has one."""
        assert frame.plan.quadtree is not None
        return cls(frame, frame.plan.quadtree, run)

    def begun(self) -> tuple[Canvas, BandGrid]:
        """The canvas with the first lattice cast, and the grid of that."""
        frame, run, lists = self.frame, self.run, self.sizes.lists
        camera = frame.camera.strided(self.sizes.stride)
        made = frame.grid(jnp.int32(0), run, camera, lists)
        grid = made.of(frame.ordered)
        decided = frame.leave(grid, run, with_levels=False, camera=camera)
        rays = tuple(frame.cast(grid, decided, None, run, camera))
        filled = tuple(one.schedule.filled for one in decided)
        canvas: Canvas = run.one("adapt", begin, (rays, filled, camera), lists=lists, **self._tuned)
        return canvas, made

    def band(self, canvas: Canvas, first_row: Int[Array, ""]) -> tuple[Canvas, BandGrid, Decisions]:
        """With the leaves of a band split as long as they are not good enough."""
        decisions, made = self.decided(first_row)
        for side in self.sizes.sides:
            canvas, *queues = self._choose(canvas, decisions.of_bundles, first_row, side)
            canvas = self.shot(canvas, decisions, *queues)
        return canvas, made, decisions

    def decided(self, first_row: Int[Array, ""]) -> tuple[Decisions, BandGrid]:
        """The grid of a band, and how rays are to be marched there."""
        frame, run = self.frame, self.run
        made = frame.grid(first_row, run)
        grid = made.of(frame.ordered)
        decided, lattice = frame.decide(grid, run)
        of_bundles = of_rays = self._joined(decided)
        if lattice is not None:
            of_rays = self._joined(frame.leave(grid, run, with_levels=False))
        return Decisions(grid, of_bundles, of_rays, lattice), made

    def marked(
        self, canvas: Canvas, decisions: Decisions, first_row: Int[Array, ""], number: int | None, share: float
    ) -> tuple[Canvas, Queue, Queue, Quality]:
        """Rays that the worst leaves want, and how good the canvas is said to be."""
        filled, bound = decisions.of_bundles.schedule.filled, decisions.of_bundles.verdict.bound
        inputs = canvas, filled, bound, first_row, self._allowed(bound.dtype), jnp.asarray(share, bound.dtype)
        static = {"lists": self.frame.plan.lists, "sizes": self.sizes.with_room(1, 1), "number": number}
        return self.run.one("adapt", mark, inputs, **static, **self._tuned)  # type: ignore[no-any-return]

    def judged(self, canvas: Canvas) -> Quality:
        """How good the canvas is said to be, before any band is known."""
        bound = self._told([]).bound
        inputs = canvas, bound, self._allowed(bound.dtype)
        quality: Quality = self.run.one("adapt", judge, inputs, sizes=self.sizes.with_room(1, 1), **self._tuned)
        return quality

    def _allowed(self, dtype: Any) -> Float[Array, ""]:
        return jnp.asarray(-1, dtype) if self.frame.allowed is None else self.frame.allowed

    def _told(self, bands: list[Decisions]) -> Told:
        """What is told of all pixels; nothing where no band is known yet."""
        plan = self.frame.plan
        if not bands:
            nothing = jnp.zeros((plan.height, plan.width), self.frame.ordered.x.dtype)
            return Told(nothing, nothing, nothing)
        size = {"height": plan.height, "width": plan.width, "lists": plan.lists}
        inputs = tuple(one.verdict for one in bands), tuple(one.of_nodes for one in bands)
        told: Told = self.run.one("image", spread_over, inputs, **size, **self._tuned)
        return told

    def shot(self, canvas: Canvas, decisions: Decisions, scattered: Queue, whole: Queue) -> Canvas:
        """With the rays cast that are queued."""
        apart = self._shoot("scattered", scattered, decisions.grid, decisions.of_rays.schedule, None)
        whole_ones = self._shoot("whole", whole, decisions.grid, decisions.of_bundles.schedule, decisions.lattice)
        return self._paint(self._paint(canvas, apart), whole_ones)

    def finished(self, canvas: Canvas, bands: list[Decisions]) -> Layers:
        """The layers of the image."""
        static = {"coarsest": self.sizes.leaf, "estimator": self.sizes.estimator, **self._tuned}
        layers: Layers = self.run.one("image", finish, (canvas, self._told(bands)), **static)
        return layers

    @property
    def _tuned(self) -> dict[str, Any]:
        return {"tuning": self.frame.plan.cast.tuning}

    def _choose(self, canvas: Canvas, decision: Decided, first_row: Array, side: int) -> tuple[Any, ...]:
        bound = decision.verdict.bound
        inputs = canvas, decision.schedule.filled, bound, first_row, self._allowed(bound.dtype)
        static = {"lists": self.frame.plan.lists, "side": side, "coarsest": self.sizes.leaf, "estimator": self.sizes.estimator}
        return self.run.one("adapt", choose, inputs, **static, **self._tuned)  # type: ignore[no-any-return]

    def _joined(self, decided: list[Decided]) -> Decided:
        joined: Decided = decided[0] if len(decided) == 1 else self.run.one("adapt", join, (tuple(decided),), **self._tuned)
        return joined

    def _shoot(self, kind: str, queue: Queue, grid: Grid, schedule: SlabSchedule, lattice: Lattice | None) -> list[Shot]:
        """Cast what a queue holds, some bundles at a time."""
        frame, plan = self.frame, self.frame.plan
        turns, packets = self.run.turns(queue.number, self.sizes.packets, plan.lists.num_bundles)
        cast_plan = plan.cast.of_shard(frame.shards)
        if kind == "scattered":
            cast_plan = cast_plan.for_rays(SCATTERED)
        scene = grid, frame.camera, frame.transfer, frame.media, schedule, lattice, queue, frame.min_transmittance
        inputs = [(*scene, jnp.int32(turn * packets), frame.within) for turn in range(turns)]
        static = {"shape": (plan.height, plan.width), "packets": packets, "kind": kind, "cast_plan": cast_plan}
        method = {"integrator": plan.chosen_integrator, "formulas": frame.formulas, **self._tuned}
        return [
            shot
            for first in range(0, turns, frame.shards)
            for shot in self.run.each("cast", shoot, inputs[first : first + frame.shards], **static, **method)
        ]

    def _paint(self, canvas: Canvas, shots: list[Shot]) -> Canvas:
        """In groups of one size, as each size is a program: filled up with such as paint nothing."""
        plan = self.frame.plan
        size = min(-(-plan.lists.num_bundles // shots[0].pixel.shape[0]), MAX_SHOTS) if shots else 1
        for first in range(0, len(shots), size):
            some = shots[first : first + size]
            room = (some[0].nowhere(plan.width * plan.height),) * (size - len(some))
            canvas = self.run.one("adapt", paint, (canvas, (*some, *room)), **self._tuned)
        return canvas


def refined(frame: Frame, run: Executor, faults: Int[Array, ""], progress: Callable[[int, int], None] | None = None) -> Drawn:
    """All bands of a frame, after its coarse lattice; `faults` are those of what is seen."""
    filling = Refinement.of(frame, run)
    canvas, coarse = filling.begun()
    bands, decided, plan = [counted(coarse)], [], frame.plan
    for nth in range(plan.bands):
        canvas, made, decisions = filling.band(canvas, jnp.int32(nth * plan.band_height))
        bands.append(counted(made))
        decided.append(decisions)
        if progress is not None:
            progress(nth + 1, plan.bands)
    return Drawn.of(filling.finished(canvas, decided), bands, faults)


def counted(made: BandGrid) -> Band:
    """What is known of a band whose rays are those of the whole canvas."""
    return Band(OfShards((), ()), made.lists.faults, made.filled, made.pairs)
