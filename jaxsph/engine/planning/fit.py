"""From a scene to a plan: view it, measure it, and take the plan of an earlier frame where that fits (host side).

Flow: scene, camera, settings -> [fit: see -> demanded -> fit] -> frame.

Frames of a sequence differ a little in everything. So a plan that is kept is taken again as long as it has room and is at most
one class too large. Room changes no bit of an image, and all else in a plan follows from the frame alone: so an image does not
depend on what was rendered before it.
"""

from __future__ import annotations

import dataclasses
import math
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from jaxsph.engine.access.host_lists import depth_order
from jaxsph.engine.planning.plan import Chosen, Demand, Plan, choose, next_class
from jaxsph.engine.planning.viewing import Seen, longest_interval, measure, view_scene
from jaxsph.engine.request import Request, first_samples
from jaxsph.engine.runtime.clock import Clock
from jaxsph.engine.runtime.tuning import Tuning, cores_at_hand, memory_for, tuning_for
from jaxsph.model.camera.camera import Camera
from jaxsph.model.particles.particles import capacity_class
from jaxsph.model.particles.periodic import num_ghosts
from jaxsph.model.scene import Scene, spheres_of
from jaxsph.model.settings import Settings, integrator_class
from jaxsph.numerics.checks import require_kinds, require_plan
from jaxsph.numerics.trees import on_host

MAX_CLASSES = 16  # classes of support, a factor of two each; the last holds all that is smaller still
MAX_KEPT = 64


@on_host
def plan(
    scene: Scene,
    camera: Camera,
    settings: Settings | None = None,
    *,
    like: Plan | None = None,
    tuning: Tuning | None = None,
    headroom: float = 1.0,
    bands: int = 1,
) -> Plan:
    """Measure the room that a frame needs (host side; values must be concrete).

    Args:
        scene, camera, settings: as for `jaxsph.render`.
        like: a plan to grow: returned as it is where it has room for this frame, else with more; so that one plan, and
            what is compiled for it, serves all frames of a sequence. Its choices of cells are kept.
        tuning: of another kind of machine (`jaxsph.engine.runtime.tuning`) than is at hand: to compile for it, or to compare.
        headroom: at least 1, factor of room beyond what this frame needs, where a plan is made or grown: for frames to come.
            There is room for more particles where `like` has too little; and for this frame alone where memory has no room.
        bands: that the image is to be made in, as far as it has rows for them: more is done where memory needs it. Bands change
            no bit of images without a tolerance, and `progress` of `jaxsph.render` may leave an image between two of them.

    Raises:
        ValueError: under a trace; for less headroom or fewer bands than 1; when even a band of one row of tiles exceeds
            `settings.memory_limit`; where `like` is for another image or kind of error control.
    """
    require_plan("like", like, Plan, "plan")
    require_kinds(plan, {"headroom": headroom, "bands": bands})
    if not headroom >= 1:
        raise ValueError(f"`headroom` must be at least 1, got {headroom}; 1 is what the frame needs")
    if not bands >= 1:
        raise ValueError(f"`bands` must be at least 1, got {bands}; 1 is as few as memory allows")
    asked = Request.of(scene, camera, Settings() if settings is None else settings)
    shape = shape_of(asked).shaped(headroom=1.0, bands=bands)
    if tuning is not None:
        shape = shape.shaped(tuning=tuning)
    if like is not None:
        like.check_image(camera, asked.along)
        capacity, classes = max(shape.num_particles, like.num_particles), max(shape.num_classes, like.num_classes)
        shape = shape.shaped(num_particles=capacity, num_classes=classes)
    seen = see(asked.scene, asked.camera, shape, Clock())
    _, demand = demanded(seen, asked, shape, None if like is None else like.chosen, in_order=False)
    if headroom == 1:
        return fit(demand, like)
    outgrown = like is not None and shape.num_particles > like.num_particles
    capacity = capacity_class(math.ceil(headroom * shape.num_particles)) if outgrown else shape.num_particles
    classes = min(shape.num_classes + 1, MAX_CLASSES)
    return fit(demand, like, demand.shaped(num_particles=capacity, num_classes=classes, headroom=headroom))


def fit(demand: Demand, like: Plan | None = None, roomy: Demand | None = None) -> Plan:
    """The plan of a frame: `like` where it serves, else a new one with its room; and with that of another, if memory has it.

    Raises:
        ValueError: as `Demand.fitted`.
    """
    made = demand.fitted(demand.limit)
    if roomy is not None and (like is None or not like.serves(made)):
        made = roomy.fitting(demand.limit) or made
    return made if like is None else like.grown(made)


def see(scene: Scene, camera: Camera, sizes: Plan | Demand, clock: Clock) -> Seen:
    """Have the scene viewed, with its particles padded to the capacity of a frame."""
    capacity = sizes.num_particles
    if not scene.point_sets and scene.particle_set.box is None and scene.particle_set.capacity < capacity:
        scene = dataclasses.replace(scene, particles=scene.particle_set.padded(capacity))
    between = _between(scene, sizes.integrator)
    static = {"samples": sizes.samples, "num_classes": sizes.num_classes, "between_samples": between}
    seen: Seen = clock.one("grid", view_scene, (scene, camera), capacity=capacity, **static)
    return seen.with_data(scene)


def _between(scene: Scene, integrator: str) -> bool:
    """Whether any sphere is met between samples."""
    return bool(scene.point_sets) or scene.surface is not None or integrator_class(integrator).between


def demanded(
    seen: Seen, asked: Request, shape: Demand, chosen: Chosen | None = None, *, in_order: bool = True
) -> tuple[Seen, Demand]:
    """What is seen, and measured; and `in_order`, if the host is to sort, which it does beside measuring."""
    stride = asked.along.leaf_pixels // 2 if asked.along.screen == "quadtree" else 1
    with ThreadPoolExecutor(1) as thread:
        sorting = in_order and shape.tuning.sorts_on_host
        order = thread.submit(depth_order, seen.viewed, max(cores_at_hand() - 1, 1)) if sorting else None
        measures = measure(seen.viewed, asked.camera, shape.samples, stride)
        seen = seen if order is None else seen._replace(order=order.result())
    return seen, shape.shaped(measures=measures, chosen=chosen or choose(measures, asked.along, shape.opaque))


class Plans:
    """The plans of a process's frames, the least recently used of which goes when there are too many."""

    def __init__(self) -> None:
        self._kept: list[Plan] = []
        self._lock = threading.Lock()

    def for_frame(self, asked: Request, clock: Clock, plan: Plan | None = None) -> tuple[Plan, Seen]:
        """The plan for this frame that is given, else one that is kept or new; and the frame as seen with its capacity.

        Raises:
            ValueError: the plan is for another image, or another kind of error control; none under a trace.
        """
        if plan is not None:
            plan.check(asked.scene, asked.camera, asked.along)
            clock.mark("plan")
            return plan, see(asked.scene, asked.camera, plan, clock)
        if clock.traced:
            raise ValueError(
                "`plan` is needed under jit, vmap or grad; make it outside with `jaxsph.plan(scene, camera, settings)`"
            )
        own = shape_of(asked)
        tries = [self._similar(own), own]  # some may be more than there is memory for
        if clock.mesh is None:  # whose devices make lists for themselves, and have no use for room that is not filled
            tries.insert(0, own.in_common())
        for shape in {(one.num_particles, one.num_classes, one.common): one for one in tries}.values():
            clock.mark("plan")
            seen, demand = demanded(see(asked.scene, asked.camera, shape, clock), asked, shape)
            tight = demand.shaped(headroom=1.0, common=False)
            needed, made = (one.fitting(demand.limit) for one in (tight, demand))
            if needed is not None and ((made is not None and made.bands == needed.bands) or not shape.common):
                break
        needed = needed or tight.fitted(demand.limit)  # which says how much memory would do
        served = [kept for kept in self._kept if kept.control == needed.control and kept.serves(needed)]
        near = [kept for kept in served if kept.rooms.is_near(needed.rooms) and kept.bytes <= demand.limit]  # not much more
        made = min(near, key=lambda kept: kept.lists.list_capacity, default=made or needed)
        with self._lock:
            self._kept = [*(kept for kept in self._kept if kept != made), made][-MAX_KEPT:]
        clock.mark("plan")
        return made, seen

    def clear(self) -> None:
        """Forget all."""
        with self._lock:
            self._kept.clear()

    def _similar(self, shape: Demand) -> Demand:
        """The same frame with the capacity and the classes of the smallest kept plan that has room for it."""
        image = shape.width, shape.height, shape.samples
        capacities = [
            (kept.num_particles, kept.num_classes)
            for kept in self._kept
            if (kept.width, kept.height, kept.samples) == image
            and shape.num_particles <= kept.num_particles <= next_class(shape.num_particles)
            and shape.num_classes <= kept.num_classes <= shape.num_classes + 1
        ]
        if not capacities:
            return shape
        capacity, classes = min(capacities)
        headroom = shape.headroom * capacity / shape.num_particles
        return shape.shaped(num_particles=capacity, num_classes=classes, headroom=headroom)


PLANS = Plans()


def shape_of(asked: Request) -> Demand:
    """What is known of a frame before it is measured, ghosts of periodic sets included."""
    scene, camera, settings = asked.scene, asked.camera, asked.along
    spheres, samples = spheres_of(scene), first_samples(settings)
    capacity, valid = spheres.capacity, np.asarray(spheres.valid)
    headroom = capacity / max(int(valid.sum()), 1)
    headroom = headroom if capacity == capacity_class(capacity) and headroom < 2 else 1.0
    number = np.dtype(spheres.dtype).itemsize
    support = np.asarray(spheres.support)[valid]
    support = support[np.isfinite(support) & (support > 0)]
    octaves = math.log2(float(support.max()) / float(support.min())) if support.size else 0.0
    classes = min(1 + math.ceil(max(octaves - 0.01, 0)), MAX_CLASSES)
    machine = tuning_for(spheres.support), memory_for(spheres.support)
    if scene.particles is not None and scene.particles.box is not None:
        margin = float(longest_interval(camera, samples)) if _between(scene, settings.integrator_used) else 0.0
        ghosts = num_ghosts(scene.particles, margin)
        capacity, headroom = capacity_class(capacity + ghosts), 1.0
    size = camera.width, camera.height, samples
    return Demand(settings, *size, capacity, classes, headroom, number, *machine, opaque=scene.surface is not None)
