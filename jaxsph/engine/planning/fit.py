"""From a request to a plan: view the scene, measure it, and reuse the plan of an earlier frame where that fits (host side).

Flow: Request -> [fit: shape_of -> see -> demanded -> fit, or a cached plan] -> Plan, SceneInView -> frame.

A `Demand` grows on this way: `shape_of` knows what is known before the scene is viewed, `demanded` adds counts and choices, and
the plan is made of it.

Frames of a sequence differ a little in everything. So a cached plan is reused as long as it has enough room and is at most one
class too large. Room changes no bit of an image, and all else in a plan follows from the frame alone: so an image does not
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
from jaxsph.engine.planning.viewing import SceneInView, longest_interval, measure, view_scene
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
MAX_KEPT = 64  # plans of `Plans`


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
    request = Request.of(scene, camera, Settings() if settings is None else settings)
    shape = shape_of(request).shaped(headroom=1.0, bands=bands)
    if tuning is not None:
        shape = shape.shaped(tuning=tuning)
    if like is not None:
        like.check_image(camera, request.along)
        capacity, classes = max(shape.num_particles, like.num_particles), max(shape.num_classes, like.num_classes)
        shape = shape.shaped(num_particles=capacity, num_classes=classes)
    in_view = see(request.scene, request.camera, shape, Clock())
    _, demand = demanded(in_view, request, shape, None if like is None else like.chosen, in_order=False)
    if headroom == 1:
        return fit(demand, like)
    outgrown = like is not None and shape.num_particles > like.num_particles
    capacity = capacity_class(math.ceil(headroom * shape.num_particles)) if outgrown else shape.num_particles
    classes = min(shape.num_classes + 1, MAX_CLASSES)
    return fit(demand, like, demand.shaped(num_particles=capacity, num_classes=classes, headroom=headroom))


def fit(demand: Demand, like: Plan | None = None, roomy: Demand | None = None) -> Plan:
    """The plan of a frame: `like` itself where that serves, else a new plan with at least the room of `like`.

    Args:
        roomy: the same demand with more room, which a new plan takes if the memory limit allows.

    Raises:
        ValueError: as `Demand.fitted`.
    """
    needed = demand.fitted(demand.limit)
    if roomy is not None and (like is None or not like.serves(needed)):
        needed = roomy.fitting(demand.limit) or needed
    return needed if like is None else like.grown(needed)


def see(scene: Scene, camera: Camera, sizes: Plan | Demand, clock: Clock) -> SceneInView:
    """View the scene by the first stage of a frame, with its particles padded to the capacity in `sizes`."""
    capacity = sizes.num_particles
    if not scene.point_sets and scene.particle_set.box is None and scene.particle_set.capacity < capacity:
        scene = dataclasses.replace(scene, particles=scene.particle_set.padded(capacity))
    between = _between(scene, sizes.integrator)
    static = {"samples": sizes.samples, "num_classes": sizes.num_classes, "between_samples": between}
    in_view: SceneInView = clock.one("grid", view_scene, (scene, camera), capacity=capacity, **static)
    return in_view.with_data(scene)


def _between(scene: Scene, integrator: str) -> bool:
    """Whether rays meet spheres between samples too: those of points, of a surface, or by an integrator that asks for it."""
    return bool(scene.point_sets) or scene.surface is not None or integrator_class(integrator).between


def demanded(
    in_view: SceneInView, request: Request, shape: Demand, chosen: Chosen | None = None, *, in_order: bool = True
) -> tuple[SceneInView, Demand]:
    """Measure the scene in view, and choose what depends on that; return the demand with both.

    If `in_order`, and where the host sorts, the particles' order is found on a second thread meanwhile, and returned in the scene
    in view.
    """
    stride = request.along.leaf_pixels // 2 if request.along.screen == "quadtree" else 1
    with ThreadPoolExecutor(1) as thread:
        sorting = in_order and shape.tuning.sorts_on_host
        order = thread.submit(depth_order, in_view.viewed, max(cores_at_hand() - 1, 1)) if sorting else None
        measures = measure(in_view.viewed, request.camera, shape.samples, stride)
        in_view = in_view if order is None else in_view._replace(order=order.result())
    return in_view, shape.shaped(measures=measures, chosen=chosen or choose(measures, request.along, shape.opaque))


class Plans:
    """A cache of plans, one for all frames of a process, from which the least recently used plan is dropped when it is full."""

    def __init__(self) -> None:
        self._kept: list[Plan] = []
        self._lock = threading.Lock()

    def for_frame(self, request: Request, clock: Clock, plan: Plan | None = None) -> tuple[Plan, SceneInView]:
        """The plan of this frame, and its scene in view.

        A `plan` that is given is checked and returned. Else up to three capacities are tried in turn: that which many frames
        have in common, unless its room costs the frame more bands; that of a cached plan; and the frame's own. The first that
        fits memory is taken. A cached plan that serves, and is not much larger, is preferred to the new one.

        Raises:
            ValueError: the plan is for another image, or another kind of error control; none under a trace.
        """
        if plan is not None:
            plan.check(request.scene, request.camera, request.along)
            clock.mark("plan")
            return plan, see(request.scene, request.camera, plan, clock)
        if clock.traced:
            raise ValueError(
                "`plan` is needed under jit, vmap or grad; make it outside with `jaxsph.plan(scene, camera, settings)`"
            )
        own = shape_of(request)
        tries = [self._similar(own), own]  # some may be more than there is memory for
        if clock.mesh is None:  # the devices of a mesh each make their lists, which takes longer with room that is not filled
            tries.insert(0, own.in_common())
        for shape in {(one.num_particles, one.num_classes, one.common): one for one in tries}.values():
            clock.mark("plan")
            in_view, demand = demanded(see(request.scene, request.camera, shape, clock), request, shape)
            tight = demand.shaped(headroom=1.0, common=False)
            needed, roomy = (one.fitting(demand.limit) for one in (tight, demand))
            if needed is not None and ((roomy is not None and roomy.bands == needed.bands) or not shape.common):
                break
        needed = needed or tight.fitted(demand.limit)  # raises, and says how much memory would do
        serving = [kept for kept in self._kept if kept.control == needed.control and kept.serves(needed)]
        near = [kept for kept in serving if kept.rooms.is_near(needed.rooms) and kept.bytes <= demand.limit]
        best = min(near, key=lambda kept: kept.lists.list_capacity, default=roomy or needed)
        with self._lock:
            self._kept = [*(kept for kept in self._kept if kept != best), best][-MAX_KEPT:]
        clock.mark("plan")
        return best, in_view

    def clear(self) -> None:
        """Drop all plans."""
        with self._lock:
            self._kept.clear()

    def _similar(self, shape: Demand) -> Demand:
        """The demand with the capacity and the classes of the smallest cached plan that has room for it; itself without one."""
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


def shape_of(request: Request) -> Demand:
    """The demand of a frame before its scene is viewed and measured, with room for the ghosts of a periodic set."""
    scene, camera, settings = request.scene, request.camera, request.along
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
