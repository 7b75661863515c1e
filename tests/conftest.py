"""What all tests share: hypothesis settings, and random scenes of one fixed shape (so that programs are compiled once)."""

from __future__ import annotations

import dataclasses
import functools
import gc
import os
from collections.abc import Callable, Iterator

import hypothesis
import jax
import numpy as np
import pytest
from derivatives import QUICKLY
from examples import EXAMPLES, USUAL

import jaxsph as js
from jaxsph.engine.access.grid import CELL_SAMPLES, MAX_LEVEL
from jaxsph.engine.access.lists import ListPlan
from jaxsph.engine.access.view import rank_particles, view_particles
from jaxsph.engine.cast.batches import CastPlan
from jaxsph.engine.control.errors import fits
from jaxsph.engine.field.tasks import reference_quantities
from jaxsph.engine.frame import stages as frame_stages
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.planning.viewing import half_steps
from jaxsph.engine.runtime import programs
from jaxsph.engine.runtime.clock import Clock

pytest_plugins = ["by_reference", "commanded", "compiled", "core", "share"]

# `dev` tries other examples each time, and what failed before first; `ci` the same ones; `nightly` (`--hypothesis-profile`) ten
# times as many.
DEV = hypothesis.settings(deadline=None, max_examples=EXAMPLES, print_blob=True, derandomize=False)
hypothesis.settings.register_profile("dev", DEV)
hypothesis.settings.register_profile("ci", DEV, derandomize=True)
hypothesis.settings.register_profile("nightly", DEV, max_examples=10 * EXAMPLES)
hypothesis.settings.load_profile(USUAL)
# Tracing makes objects by the million, few of them in cycles: looking for these as often as usual is a quarter of its time.
gc.set_threshold(50_000, 20, 100)

MAX_MAPS = 30_000  # memory maps that a process may keep from one test file to the next; Linux allows 65530
MAX_PROGRAMS = 256  # of frames that a process may keep: compiled quickly, most have a third of the memory maps that others have
CAPACITY = 24
WIDTH, HEIGHT, SAMPLES = 21, 18, 37


@dataclasses.dataclass(frozen=True)
class Frames:
    """Random frames of one shape, and a plan with room for all of them."""

    width: int = WIDTH
    height: int = HEIGHT
    samples: int = SAMPLES
    capacity: int = CAPACITY

    def plan(self, slab_samples: int = 4, num_classes: int = 3) -> Plan:
        lists = ListPlan(2, 2, 4 * self.capacity, 16 * self.capacity)
        cast = CastPlan(16, slab_samples, 48)  # batches that end within a layer
        return Plan(self.width, self.height, self.samples, self.capacity, num_classes, 1, lists, cast, 0)

    def deep(self, slab_samples: int) -> Frames:
        """Frames of as many whole cells as the coarsest level merges, and one that is not whole."""
        return dataclasses.replace(self, samples=(CELL_SAMPLES << MAX_LEVEL - fits(slab_samples)) + 3)

    @property
    def settings(self) -> js.Settings:
        return js.Settings(samples=self.samples, integrator="samples")

    def scene(
        self, rng: np.random.Generator, kernel: str = "poly6", decades: float = 1.0, count: int | None = None, dtype=np.float32
    ) -> js.Scene:
        """Particles around the origin, supports log-uniform over `decades`, and a transfer function of five points."""
        count = self.capacity if count is None else count
        position = rng.uniform(-1, 1, (count, 3)).astype(dtype)
        support = (0.9 * 10 ** -rng.uniform(0, decades, count)).astype(dtype)
        quantity, volume = rng.uniform(0, 1, count).astype(dtype), rng.uniform(0.1, 1, count).astype(dtype)
        particles = js.Particles.from_arrays(position, support, quantity, volume, kernel, capacity=self.capacity)
        values = np.sort(rng.uniform(0, 1, 5)).astype(dtype)
        extinction = rng.uniform(0, 4, 5).astype(dtype)
        transfer = js.TransferFunction.from_points(values, rng.uniform(0, 1, (5, 3)).astype(dtype), extinction)
        return js.Scene(particles=particles, transfer=transfer)

    def camera(
        self, rng: np.random.Generator, projection: str = "perspective", distance: float = 3.0, dtype=np.float32
    ) -> js.Camera:
        """Looks at the origin from `distance`; with a small distance it stands among the particles."""
        direction = rng.normal(size=3)
        eye = (distance * direction / np.linalg.norm(direction)).astype(dtype)
        target = rng.uniform(-0.1, 0.1, 3).astype(dtype)
        near, far = max(distance - 1.7, 0.05), distance + 1.7
        size = {"width": self.width, "height": self.height, "near": near, "far": far}
        up = (0.1, 1.0, 0.2) if abs(direction[1]) < 0.9 * np.linalg.norm(direction) else (1.0, 0.1, 0.2)
        if projection == "perspective":
            return js.Camera.look_at(eye, target, up, 50.0, **size)
        return js.Camera.orthographic(eye, target, up, 2.5, **size)


@dataclasses.dataclass(frozen=True)
class Adversary:
    """Draws scenes that are hard to bound."""

    frames: Frames

    def scene(self, rng: np.random.Generator, kernel: str, dtype) -> js.Scene:
        """Supports over four decades, clumps, constants, transfer functions with bands, jumps, nothing and a wall."""
        scene = self.frames.scene(rng, kernel, decades=rng.choice([0.3, 1, 4]), count=rng.integers(0, 25), dtype=dtype)
        particles = scene.particles
        quantity = np.asarray(particles.quantity)
        style = rng.integers(3)
        if style == 0:
            quantity = np.where(np.asarray(particles.position)[:, 0] > 0, 0.7, 0.2)
        if style == 1:
            quantity = 0.4 + 0.01 * quantity
        support = np.asarray(particles.support) * (4 if rng.uniform() < 0.5 else 1)
        particles = dataclasses.replace(particles, quantity=quantity.astype(dtype), support=support.astype(dtype))
        values = np.sort(rng.uniform(0, 1, 5))
        if rng.uniform() < 0.3:
            values[3] = values[2]
        extinction = rng.choice([0, 0.1, 1, 30, 1e6], 5) * rng.uniform(0, 1, 5)
        colors = np.round(rng.uniform(0, 1, (5, 3)) * rng.choice([1, 3])) / 3
        given = (values, np.clip(colors, 0, 1), extinction)
        transfer = js.TransferFunction.from_points(*(value.astype(dtype) for value in given))
        return js.Scene(particles=particles, transfer=transfer)

    def camera(self, rng: np.random.Generator, projection: str, dtype) -> js.Camera:
        """From outside, or among the particles."""
        return self.frames.camera(rng, projection, distance=float(rng.choice([0.2, 1.5, 3.0])), dtype=dtype)


@pytest.fixture(scope="session")
def frames() -> Frames:
    return Frames()


@pytest.fixture(scope="session")
def adversary(frames) -> Adversary:
    return Adversary(frames)


def pytest_configure(config: pytest.Config) -> None:
    """Room for the programs that files share; a core for each of the processes that share the tests.

    Else all of them start threads for all cores. What tests compile is not kept where a person keeps programs.
    """
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", "")
    programs.PROGRAMS._most = MAX_PROGRAMS
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    if worker is not None and hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[int(worker.removeprefix("gw")) % len(cores)]})


@pytest.fixture(scope="module", autouse=True)
def few_programs() -> Iterator[None]:
    """Compiled programs hold memory maps, of which a process may have only so many."""
    yield
    _let_go_of_programs()


@pytest.fixture(autouse=True)
def few_programs_of_slow_tests(request: pytest.FixtureRequest) -> Iterator[None]:
    """The same after each test that takes long: a file of them may compile more than a process can hold."""
    yield
    if any(request.node.get_closest_marker(mark) for mark in ("slow", "endurance")):
        _let_go_of_programs()


def _let_go_of_programs() -> None:
    if (programs.in_use() or 0) > MAX_MAPS:
        jax.clear_caches()
    if (programs.in_use() or 0) > MAX_MAPS:  # else a file might begin with so many that its own would be let go
        programs.PROGRAMS.clear()


@pytest.fixture
def quick_programs(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Programs of eager images compiled in less than half the time, and slower: those of slow tests are as everyone has them."""
    if request.node.get_closest_marker("slow") is None:
        monkeypatch.setattr(programs, "OF_ALL", QUICKLY)


@pytest.fixture
def compiles() -> Iterator[list[int]]:
    """Grows with each program of frames that begins to be compiled."""
    count: list[int] = []
    programs.PROGRAMS.on_compile = lambda: count.append(1)
    yield count
    programs.PROGRAMS.on_compile = None


@pytest.fixture
def x64() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="session")
def compare() -> Callable[..., None]:
    """`compare(image, truth, atol, share)`: colour, alpha and depth agree on at least `share` of the pixels."""

    def check(image: js.Image, truth: js.Image, atol: float, share: float = 1.0) -> None:
        for name in ("color", "transmittance"):
            error = np.abs(np.asarray(getattr(image, name), np.float64) - getattr(truth, name))
            error = error.reshape(*truth.shape, -1).max(-1)
            assert (error <= atol).mean() >= share, f"{name}: {(error > atol).sum()} pixels over {atol}, worst {error.max()}"
        deep, true = np.asarray(image.depth, np.float64), truth.depth
        with np.errstate(invalid="ignore"):
            close = (deep == true) | (np.abs(deep - true) <= 100 * atol * np.maximum(true, 1))
        grazing = np.abs(truth.transmittance - 0.5) <= 10 * atol  # half transmittance is met at the far end, or just not
        assert (close | grazing).mean() >= share, f"depth differs on {(~(close | grazing)).sum()} pixels"

    return check


@pytest.fixture(scope="session")
def traced(frames):
    """A whole image as part of a trace, `traced(scene, camera, plan)`: one program for all random frames."""

    @functools.partial(jax.jit, static_argnames="plan", compiler_options=QUICKLY)
    def draw(scene, camera, plan):
        return js.render(scene, camera, frames.settings, plan=plan)

    return draw


@functools.partial(jax.jit, static_argnames="plan", compiler_options=QUICKLY)
def grid_of(particles, camera, *, plan):
    """The grid of a frame of one band, and what its sums are taken relative to."""
    depths = half_steps(camera, particles.dtype, plan.samples)[1::2]
    viewed = view_particles(particles, camera, depths, plan.num_classes)
    ordered = rank_particles(viewed, camera, depths, plan.cast.slab_samples)
    grid, _ = frame_stages.grid_of(
        Clock(traced=True), ordered, camera, 0, plan.lists, plan.cast.tuning, samples=plan.samples, beside=False
    )
    return grid, tuple(reference_quantities(grid.windows, grid.lists.rank, quantity) for quantity in ordered.quantities)


@pytest.fixture(scope="session")
def stages():
    """The stages of a frame, for tests that look between them."""
    return grid_of
