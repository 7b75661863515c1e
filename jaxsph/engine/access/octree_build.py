"""Plan an octree on the host, and build it under jit.

Flow: spheres -> [octree_build: plan -> octree_levels] -> octree -> media.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access import octree_levels
from jaxsph.engine.access.macrocells import Occupancy
from jaxsph.engine.access.octree import INNER, Octree
from jaxsph.engine.access.octree_levels import OCTANTS, Level, Placed
from jaxsph.engine.runtime.tuning import MEMORY
from jaxsph.model.particles import capacity_class
from jaxsph.numerics import faults
from jaxsph.numerics.sums import running_sum

MAX_TOP = 6  # levels of the dense grid: 64 cells an axis
MAX_LEVELS = 20  # such that a node of float32 coordinates is wider than what these are rounded by
PAIRS_PER_SPHERE = 5  # of the dense grid, before they are tested: its sort takes as long as two levels of splitting
BYTES_PER_PAIR = 80  # that splitting a level holds, for each pair of it
BYTES_PER_CHILD = 12  # and for each pair of its children


class LevelSizes(NamedTuple):
    """What there is room for in a level below the dense grid: blocks of eight nodes, and their pairs."""

    blocks: int
    pairs: int


@dataclasses.dataclass(frozen=True)
class OctreePlan:
    """All that fixes the shapes of an octree; `plan_octree` makes it.

    Attributes:
        top: levels of the dense grid.
        candidates, pairs: pairs of it, before they are tested and after.
        levels: those below.
        entries: of all leaves.
        most: a node with more spheres than that, smaller than itself, is split.
        ratio: a sphere is smaller than a node if its radius times that is less than the node's side.
        lowered: whether memory did not suffice for as many levels as were asked for.
    """

    top: int
    candidates: int
    pairs: int
    levels: tuple[LevelSizes, ...]
    entries: int
    most: int = 8
    ratio: float = 2.0
    lowered: bool = False

    def __post_init__(self) -> None:
        for name in ("candidates", "pairs", "entries", "most"):
            if getattr(self, name) < 1:
                raise ValueError(f"`{name}` must be at least 1, got {getattr(self, name)}")
        if not 0 <= self.top <= self.deepest <= MAX_LEVELS:
            raise ValueError(f"an octree has 0 to {MAX_LEVELS} levels, got `top` = {self.top} and {len(self.levels)} below")
        if not self.ratio > 0:
            raise ValueError(f"`ratio` must be > 0, got {self.ratio}")

    @property
    def deepest(self) -> int:
        """Level of the smallest nodes there is room for."""
        return self.top + len(self.levels)

    @property
    def num_nodes(self) -> int:
        """Nodes of all levels that there is room for."""
        return (1 << 3 * self.top) + sum(OCTANTS * level.blocks for level in self.levels)


def plan_octree(
    centre: Float[Array, "spheres 3"],
    radius: Float[Array, " spheres"],
    live: Bool[Array, " spheres"] | None = None,
    *,
    most: int = 8,
    ratio: float = 2.0,
    max_level: int = 16,
    memory: int = MEMORY,
) -> OctreePlan:
    """Count what an octree over spheres takes, with some room (host side).

    Args:
        centre, radius: of spheres, length units; `radius` >= 0.
        live: those that are there; by default all.
        most, ratio: what nodes are split by, see `OctreePlan`.
        max_level: the smallest leaf has a side of the box over 2^max_level, at most `MAX_LEVELS`.
        memory: bytes that building may take; levels are left out that would take more, and the plan's `lowered` says so.

    Raises:
        ValueError: settings out of range.
    """
    if not 0 <= max_level <= MAX_LEVELS:
        raise ValueError(f"`max_level` must be from 0 to {MAX_LEVELS}, got {max_level}")
    placed = _placed(centre, radius, live)
    top, candidates = _top(placed, max_level)
    plan = OctreePlan(top, capacity_class(candidates), 1, (), 1, most, ratio)
    level, _ = octree_levels.top_level(placed, top=top, capacity=plan.candidates)
    plan, entries = dataclasses.replace(plan, pairs=capacity_class(int(level.begin[-1]))), 0
    level = _within(level, plan.pairs)
    while plan.deepest < max_level:
        found = octree_levels.look(placed, level, depth=plan.deepest, most=most, ratio=ratio)
        split, children, kept = (int(size) for size in octree_levels.sizes_of(level, found))
        if not split:
            break
        sizes = LevelSizes(capacity_class(split), capacity_class(children))
        taken = BYTES_PER_PAIR * level.sphere.shape[0] + BYTES_PER_CHILD * sizes.pairs + 4 * (entries + children)
        if taken + 8 * plan.num_nodes > memory:
            plan = dataclasses.replace(plan, lowered=True)
            break
        level, entries = octree_levels.split(level, found, blocks=sizes.blocks, pairs=sizes.pairs), entries + kept
        plan = dataclasses.replace(plan, levels=(*plan.levels, sizes))
    return dataclasses.replace(plan, entries=capacity_class(entries + int(level.begin[-1])))


@functools.partial(jax.jit, static_argnames="plan")
def build_octree(
    centre: Float[Array, "spheres 3"],
    radius: Float[Array, " spheres"],
    live: Bool[Array, " spheres"] | None = None,
    *,
    plan: OctreePlan,
) -> Octree:
    """The octree over spheres, of the sizes of a plan.

    With a plan of other spheres, what there is no room for is missing, and `Octree.fault` says so.

    Differentiation:
        Held fixed: which leaf has which spheres carries no gradient.
    """
    placed = _placed(*jax.lax.stop_gradient((centre, radius)), live)
    level, over = octree_levels.top_level(placed, top=plan.top, capacity=plan.candidates)
    over |= level.begin[-1] > plan.pairs
    level = _within(level, plan.pairs)
    occupied = (level.begin[1:] > level.begin[:-1]).reshape((1 << plan.top,) * 3)
    tables = _Tables(plan)
    for depth, sizes in enumerate(plan.levels, plan.top):
        found = octree_levels.look(placed, level, depth=depth, most=plan.most, ratio=plan.ratio)
        split, children, _ = octree_levels.sizes_of(level, found)
        over |= (split > sizes.blocks) | (children > sizes.pairs)
        tables.add(level, found.wanted & (running_sum(found.wanted.astype(jnp.int32)) <= sizes.blocks))
        level = octree_levels.split(level, found, blocks=sizes.blocks, pairs=sizes.pairs)
    crowded = octree_levels.crowded(placed, level, depth=plan.deepest, most=plan.most, ratio=plan.ratio)
    tables.add(level, jnp.zeros_like(crowded))
    fault = faults.raised(faults.OCTREE_OVERFLOW, over | (tables.num_entries > plan.entries))
    return Octree(
        placed.lower,
        placed.side,
        jnp.concatenate(tables.rows),
        tables.entry[:-1],
        Occupancy.of(occupied),
        num_leaves=tables.num_leaves,
        num_entries=tables.num_entries,
        deepest=tables.deepest,
        crowded=crowded.sum(),
        fault=fault,
        top=plan.top,
        levels=plan.deepest,
    )


class _Tables:
    """Rows of nodes and entries of leaves, level by level."""

    def __init__(self, plan: OctreePlan) -> None:
        self.plan, self.depth, self.first = plan, plan.top, 0
        self.rows: list[Array] = []
        self.entry: Int[Array, " entries_and_one"] = jnp.zeros(plan.entries + 1, jnp.int32)
        self.num_entries = self.num_leaves = jnp.int32(0)
        self.deepest = jnp.int32(plan.top)
        self.there = jnp.ones(1 << 3 * plan.top, bool)

    def add(self, level: Level, split: Bool[Array, " nodes"]) -> None:
        """Those of a level, of which some nodes are split."""
        nodes, room = level.corner.shape[0], self.plan.entries
        count = jnp.where(split, 0, level.begin[1:] - level.begin[:-1])
        total = running_sum(count)
        start = self.num_entries + total - count
        shift = jnp.append(jnp.where(split, room, start - level.begin[:-1]), room)
        each = jnp.arange(level.sphere.shape[0], dtype=jnp.int32)
        target = jnp.clip(each + shift.at[level.node].get(mode="promise_in_bounds"), 0, room)
        self.entry = self.entry.at[target].set(level.sphere, mode="promise_in_bounds")
        nth = running_sum(split.astype(jnp.int32))
        child = self.first + nodes + OCTANTS * (nth - 1)
        count = jnp.clip(count, 0, jnp.maximum(room - start, 0))
        start = jnp.minimum(start, room - 1)
        self.rows.append(jnp.stack([jnp.where(split, child, start), jnp.where(split, INNER, count)], 1))
        self.num_entries += total[-1]
        self.num_leaves += (self.there & ~split).sum()
        self.deepest = jnp.where(self.there.any(), self.depth, self.deepest)
        self.first, self.depth = self.first + nodes, self.depth + 1
        if self.depth <= self.plan.deepest:
            blocks = self.plan.levels[self.depth - self.plan.top - 1].blocks
            self.there = jnp.arange(OCTANTS * blocks, dtype=jnp.int32) < OCTANTS * nth[-1]


def _placed(centre: Any, radius: Any, live: Any) -> Placed:
    live = jnp.ones(radius.shape, bool) if live is None else live
    missing = 0 if radius.shape[0] else 1  # an empty array cannot be read from
    padded = (
        jnp.pad(column, [(0, missing)] + [(0, 0)] * (column.ndim - 1)) for column in map(jnp.asarray, (centre, radius, live))
    )
    return octree_levels.place(*padded)


def _top(placed: Placed, max_level: int) -> tuple[int, int]:
    """Levels of the dense grid, as many as there are few pairs and cells for; and its pairs before they are tested."""
    spheres = np.asarray(placed.sphere)[np.asarray(placed.live)].astype(np.float64)
    most = PAIRS_PER_SPHERE * max(len(spheres), 1)
    chosen = 0, len(spheres)
    for top in range(1, min(MAX_TOP, max_level) + 1):
        ends = (np.clip(np.floor((spheres[:, :3] + side * spheres[:, 3:]) * (1 << top)), 0, (1 << top) - 1) for side in (-1, 1))
        first, last = ends
        pairs = int((last - first + 1).prod(1).sum())
        if max(pairs, 1 << 3 * top) > most:
            break
        chosen = top, pairs
    return chosen


def _within(level: Level, pairs: int) -> Level:
    """With room for so many pairs; begins stay within."""
    missing = max(pairs - level.sphere.shape[0], 0)
    nodes = level.corner.shape[0]
    sphere, node = jnp.pad(level.sphere, (0, missing)), jnp.pad(level.node, (0, missing), constant_values=nodes)
    return Level(level.corner, jnp.minimum(level.begin, pairs), sphere[:pairs], node[:pairs])
