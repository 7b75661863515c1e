r"""Claim: errors of Hochstetter et al. 2016 stay within the tolerance because a budget is kept along the ray, and by coverage.

Their table 2 beside ours, row by row: error, grid, adapt, ray casting, total, and how many times faster than full rate. `relaxed`
is the setting of all their rows (back to front, all that rays of a bundle differ by left out), `certified` our default, which
they have no row for. What one part of the method is worth is told by contenders without it, all relaxed:

- `no greedy`: every cell keeps the tolerance for itself, as if nothing else lay on the ray: breaks it, by design;
- `no surface`: cells that are partly empty are taken for covered: breaks it at surfaces, by design;
- `only z`: no super-pixels;
- `object space`: at full rate, particles found by an octree (`object_space`), whose building counts as grid.

All contenders render a scene in one process, in turns; compile time is apart, and times are medians. Those that are no settings
of the package live here alone: each replaces functions of `jaxsph.engine.control` while its own program is traced. Particles
are of the same kinds of scenes, not the same data, and times are of other machines: compare shapes, not digits. Writes
`results/table2.json`, or with --frames `results/table3.json`; ends in asserts on errors.

With --frames N, after their table 3: frames 0 to N - 1 of three scenes, of which so many are over the tolerance. Frames in which
nothing was chosen, whose error is 0 for that, are counted apart.

    python benchmarks/table2.py [--particles 100000] [--size 256] [--repeats 3] [--scenes flubber] [--paper] [--frames 60]
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import statistics
import sys
import time
from collections.abc import Callable, Iterable
from typing import Any, ClassVar
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from kept import keep
from object_space import in_object_space

import jaxsph as js
from jaxsph.engine.control import adapt, bounds
from jaxsph.engine.control.adapt import ControlPlan
from jaxsph.engine.control.decide import Decided
from jaxsph.engine.control.errors import SUPER_PIXEL
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.runtime.programs import stage
from jaxsph.trade.sweep import layers_of

TOLERANCES = 0.001, 0.004, 0.01
ABLATED_AT = 0.004
FULL_RATE, RELAXED, CERTIFIED = "full rate", "relaxed", "certified"
NO_GREEDY, NO_SURFACE, ONLY_Z, OBJECT_SPACE = "no greedy", "no surface", "only z", "object space"
BREAKING = NO_GREEDY, NO_SURFACE  # the tolerance, by design
# Difference of colours in object space that rounding may make on all but one pixel in a thousand: near the edge of all supports
# that reach a sample, its weights are small differences of large numbers.
SAME = 1e-5
STAGES = "grid", "adapt", "cast"
PARTICLES, SIZE = 100_000, 256
PAPER_SIZE = 1024
OF_PAPER = {"flubber": 500_000, "checker_board": 1_200_000, "mixer": 2_500_000, "letters": 5_300_000, "radial": 10_000_000}
SEQUENCES = "checker_board", "flubber", "letters"
SEQUENCE_SIZE = 512
RESULTS = pathlib.Path(__file__).with_name("results")
Record = dict[str, Any]

THEIRS: dict[tuple[str, str, float | None], tuple[float | str, int, int | None, int, int]] = {
    ("flubber", FULL_RATE, None): (0, 7, None, 66, 73),
    ("flubber", RELAXED, 0.004): (7.2e-4, 7, 5, 44, 56),
    ("flubber", NO_SURFACE, 0.004): ("far over", 7, 8, 19, 34),
    ("checker_board", FULL_RATE, None): (0, 23, None, 134, 157),
    ("checker_board", RELAXED, 0.001): (3.3e-5, 23, 14, 109, 146),
    ("checker_board", RELAXED, 0.004): (2.1e-4, 23, 15, 87, 125),
    ("checker_board", RELAXED, 0.01): (1.1e-3, 23, 16, 75, 114),
    ("mixer", FULL_RATE, None): (0, 49, None, 297, 346),
    ("mixer", RELAXED, 0.001): (7.4e-4, 49, 28, 181, 254),
    ("mixer", RELAXED, 0.004): (2.7e-3, 49, 29, 164, 242),
    ("mixer", RELAXED, 0.01): (5.6e-3, 49, 29, 152, 230),
    ("mixer", NO_GREEDY, 0.004): (0.016, 49, 23, 121, 193),
    ("mixer", OBJECT_SPACE, None): (0, 75, None, 981, 1056),
    ("letters", FULL_RATE, None): (0, 71, None, 317, 388),
    ("letters", RELAXED, 0.001): (5.4e-4, 71, 31, 217, 319),
    ("letters", RELAXED, 0.004): (2.0e-3, 71, 32, 191, 294),
    ("letters", RELAXED, 0.01): (3.5e-3, 71, 33, 173, 280),
    ("radial", FULL_RATE, None): (0, 79, None, 598, 677),
    ("radial", RELAXED, 0.001): (6.2e-4, 79, 49, 460, 588),
    ("radial", RELAXED, 0.004): (1.3e-3, 79, 50, 340, 469),
    ("radial", RELAXED, 0.01): (2.0e-3, 79, 50, 290, 419),
    ("radial", ONLY_Z, 0.004): (1.4e-3, 79, 59, 389, 527),
}
"""Their table 2 (GTX Titan, means over all frames): error, then milliseconds of grid, adapt, ray casting, and in all."""


class Contending(ControlPlan):
    """Error control with some functions of another's.

    Attributes:
        REPLACED: the module, and what stands in place of some of its functions, by their names.
    """

    REPLACED: ClassVar[tuple[Any, dict[str, Callable[..., Any]]]]

    def decide(
        self, clock: Any, grid: Any, shown: Any, limits: Any, shards: int, lists: Any, kernel: str, **sizes: Any
    ) -> tuple[list[Decided], None]:
        """What is to be marched of a band, see `ControlPlan.decide`."""
        inputs = [(grid, shown, limits, nth) for nth in clock.shards(shards)]
        return clock.each("adapt", decide_otherwise, inputs, shards=shards, control=self, **sizes), None


def independent(errors: Any, saving: Any, on_offer: Any, rounding: Any, tolerance: Any, allocation: str) -> Any:
    """The candidate that saves most of those within the tolerance, for each cell alone: their l_max, without section 4.4."""
    slabs = on_offer.slabs
    of_paint, saved = (jnp.where(slabs, one.slabs, 0).sum(0)[None] for one in (errors.error, saving))
    offered = jnp.concatenate([on_offer.levels, slabs.any(0)[None]])
    allowed = offered & (jnp.concatenate([errors.strict, of_paint]) + rounding <= tolerance)
    chosen = jnp.where(allowed.at[0].set(True), jnp.concatenate([saving.levels, saved]), -jnp.inf).argmax(0).astype(jnp.int32)
    return lax.stop_gradient((chosen, slabs & (chosen == SUPER_PIXEL)))


def not_held(error: Any, chosen: Any, painted: Any, rounding: Any, tolerance: Any, *, of: Callable[..., Any] = adapt.kept) -> Any:
    """What was chosen, however much that is."""
    return of(error, chosen, painted, rounding, jnp.full_like(tolerance, jnp.inf))


def taken_for_covered(*arguments: Any, of: Callable[..., Any] = bounds.sample_bounds) -> bounds.SampleBounds:
    """Bounds of samples, none of which may be empty where any particle is near."""
    proven = of(*arguments)
    return dataclasses.replace(proven, covered=proven.touched)


class NoGreedy(Contending):
    """Each cell is chosen for as if it were alone on its ray."""

    REPLACED = adapt, {"choose": independent, "kept": not_held}


class NoSurface(Contending):
    """There is no test of coverage."""

    REPLACED = bounds, {"sample_bounds": taken_for_covered}


@stage("shards", "slab_samples", "control")
def decide_otherwise(*inputs: Any, shards: int, slab_samples: int, control: Contending, tuning: Any) -> Decided:
    """`adapt.decide_by_bounds`, traced with what `control` replaces; a program of its own."""
    sizes = {"shards": shards, "slab_samples": slab_samples, "control": control, "tuning": tuning}
    module, others = control.REPLACED
    with mock.patch.multiple(module, **others):
        return adapt.decide_by_bounds.__wrapped__(*inputs, **sizes)


@dataclasses.dataclass(frozen=True)
class Contender:
    """What takes part: a row of the table."""

    name: str
    tolerance: float | None = None
    chosen: dict[str, Any] = dataclasses.field(default_factory=dict, hash=False)
    control: type[ControlPlan] = ControlPlan

    def settings(self, samples: int) -> js.Settings:
        """To render with."""
        return js.Settings(samples=samples, integrator="samples", tolerance=self.tolerance, **self.chosen)

    def plan(self, scene: js.Scene, camera: js.Camera, samples: int, like: Plan | None = None) -> Plan:
        """By which it is rendered, grown from that of an earlier frame."""
        made = js.plan(scene, camera, self.settings(samples), like=like)
        if made.control is None or isinstance(made.control, self.control):
            return made
        parts = {field.name: getattr(made.control, field.name) for field in dataclasses.fields(made.control)}
        return dataclasses.replace(made, control=self.control(**parts))


AS_PAPER = {"estimator": "interval", "allocation": "greedy", "relax": 1.0}
ABLATIONS = (
    Contender(NO_GREEDY, ABLATED_AT, AS_PAPER, NoGreedy),
    Contender(NO_SURFACE, ABLATED_AT, AS_PAPER, NoSurface),
    Contender(ONLY_Z, ABLATED_AT, AS_PAPER | {"super_pixels": False}),
    Contender(OBJECT_SPACE),
)


def contenders(tolerances: Iterable[float] = TOLERANCES) -> list[Contender]:
    """All rows of a scene, full rate first."""
    kinds = {RELAXED: AS_PAPER, CERTIFIED: {"estimator": "interval"}}
    return [Contender(FULL_RATE), *(Contender(name, t, how) for name, how in kinds.items() for t in tolerances), *ABLATIONS]


def measure(
    name: str,
    view: tuple[js.Scene, js.Camera],
    samples: int,
    repeats: int,
    some: list[Contender],
    plans: dict[Contender, Plan] | None = None,
) -> list[Record]:
    """A record of each contender, full rate first.

    Args:
        view: scene and camera.
        plans: of earlier frames, which grow as frames need it.
    """
    scene, camera = view
    plans, known, turns, built = {} if plans is None else plans, {}, {one: [] for one in some}, {}
    full, scenes = None, {}
    for number, one in enumerate(some, 1):
        started = time.perf_counter()
        scenes[one] = jax.block_until_ready(in_object_space(scene)) if one.name == OBJECT_SPACE else scene
        built[one] = time.perf_counter() - started if one.name == OBJECT_SPACE else 0.0
        plans[one] = one.plan(scenes[one], camera, samples, plans.get(one))
        image = js.render(scenes[one], camera, one.settings(samples), plan=plans[one])
        full = image if full is None else full
        known[one] = compared(image, full, one.tolerance) | {"compile": image.stats["seconds"]["compile"]}
        label = one.name if one.tolerance is None else f"{one.name} {one.tolerance:g}"
        print(f"{name}: {label}, {number} of {len(some)}, compiled in {known[one]['compile']:.1f} s", flush=True)
    for turn in range(repeats):
        for one, seconds in turns.items():
            spent = js.render(scenes[one], camera, one.settings(samples), plan=plans[one]).stats["seconds"]
            seconds.append(spent | {"grid": spent["grid"] + built[one]})
        print(f"{name}: turn {turn + 1} of {repeats}", flush=True)
    about = {"scene": name, "particles": scene.particle_set.num_particles}
    rows = [
        about
        | {"contender": one.name, "tolerance": one.tolerance}
        | known[one]
        | medians(turns[one])
        | {"theirs": theirs(name, one)}
        for one in some
    ]
    for row in rows:
        row["speed_cast"], row["speed_total"] = (rows[0][stage] / row[stage] for stage in ("cast", "total"))
    return rows


def compared(image: js.Image, full: js.Image, tolerance: float | None) -> Record:
    """How wrong pixels are, how wrong they were said to be at most, how many slabs are coarser, and what that saved."""
    error = np.abs(layers_of(image) - layers_of(full)).max(-1)
    levels = np.zeros(1, int) if image.levels is None else np.asarray(image.levels)
    return {
        "error": float(error.max()),
        "of_999_in_1000": float(np.quantile(error, 0.999)),
        "over": 0.0 if tolerance is None else float((error > tolerance).mean()),
        "bound": None if tolerance is None else float(np.asarray(image.error_bound).max()),
        "certified": bool(image.certified) and tolerance is not None,
        "coarser": float((levels > 0).sum() / max((levels >= 0).sum(), 1)),
        "evaluations": image.stats["evaluations"],
        "saved": full.stats["evaluations"] / image.stats["evaluations"] if image.stats["evaluations"] else None,
    }


def medians(turns: list[dict[str, float]]) -> Record:
    """Seconds of each stage and of their sum, and by how much that varies: its median deviation from the median."""
    sums = [sum(turn[stage] for stage in STAGES) for turn in turns]
    total = statistics.median(sums)
    found = {stage: statistics.median(turn[stage] for turn in turns) for stage in STAGES}
    return found | {"total": total, "deviation": statistics.median(abs(one - total) for one in sums)}


def theirs(scene: str, one: Contender) -> Record | None:
    """Their row, in seconds, where they have one."""
    row = THEIRS.get((scene, one.name, one.tolerance))
    if row is None:
        return None
    full = THEIRS[scene, FULL_RATE, None]
    names = *STAGES, "total"
    seconds = {name: None if time is None else time / 1e3 for name, time in zip(names, row[1:], strict=True)}
    speeds = {"speed_cast": full[3] / row[3], "speed_total": full[4] / row[4]}
    return {"particles": OF_PAPER[scene], "error": row[0]} | seconds | speeds


def theirs_alone(rows: list[Record]) -> list[Record]:
    """Their rows that none of ours stands beside."""
    measured = {(row["scene"], row["contender"], row["tolerance"]) for row in rows}
    return [
        {"scene": scene, "contender": name, "tolerance": tolerance, "theirs": theirs(scene, Contender(name, tolerance))}
        for scene, name, tolerance in THEIRS
        if (scene, name, tolerance) not in measured
    ]


def sequence(name: str, frames: int, size: int, particles: int, samples: int) -> list[Record]:
    """For each tolerance, how many frames are over it, and in how many nothing was chosen."""
    some = [Contender(FULL_RATE), *(Contender(RELAXED, tolerance, AS_PAPER) for tolerance in TOLERANCES)]
    plans: dict[Contender, Plan] = {}
    rows: dict[float, list[Record]] = {tolerance: [] for tolerance in TOLERANCES}
    for frame in range(frames):
        view = js.scenes.load(name, particles, frame, width=size, height=size)
        for row in measure(f"{name}, frame {frame}", view, samples, 1, some, plans)[1:]:
            rows[row["tolerance"]].append(row)
    return [
        {
            "scene": name,
            "contender": RELAXED,
            "tolerance": tolerance,
            "frames": frames,
            "nothing_chosen": sum(row["coarser"] == 0 for row in of),
            "frames_over": sum(row["over"] > 0 for row in of),
            "most_over": max(row["over"] for row in of),
            **{figure: [row[figure] for row in of] for figure in ("error", "coarser", "saved", *STAGES, "total", "speed_total")},
        }
        for tolerance, of in rows.items()
    ]


COLUMNS = ("error", "grid", "adapt", "cast", "total", "speed_cast", "speed_total")


def line(row: Record) -> str:
    """Of the printed table: ours, and theirs below where they have one."""
    tolerance = "-" if row["tolerance"] is None else f"{row['tolerance']:g}"
    start = f"{row['scene']:14s} {row['contender']:12s} {tolerance:>6s} {100 * row['coarser']:5.1f} %"
    ours = start + " ours  " + " ".join(shown(row[name]) for name in COLUMNS)
    if row["theirs"] is None:
        return ours
    return ours + "\n" + " " * len(start) + " theirs" + " ".join(shown(row["theirs"][name]) for name in COLUMNS)


def shown(value: float | str | None) -> str:
    """A cell of the printed table."""
    return f"{'-' if value is None else value if isinstance(value, str) else f'{value:.3g}':>9s}"


HEADER = f"{'scene':14s} {'contender':12s} tol.   coarser" + " " * 7 + " ".join(f"{name:>9s}" for name in COLUMNS)


def is_kept(row: Record) -> bool:
    """Whether a row keeps its bound where it is certified, else its tolerance, unless it breaks that by design."""
    if row["contender"] in BREAKING:
        return True
    if row["certified"]:
        return row["error"] <= row["bound"] <= row["tolerance"]
    if row["contender"] == OBJECT_SPACE:
        return row["of_999_in_1000"] <= SAME
    return row["error"] <= (row["tolerance"] or 0)


def variants() -> list[str]:
    """Names of all that is compared."""
    return [one.name for one in contenders()]


def main() -> None:
    """Measure, write, and check."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=int, default=PARTICLES, help="of each scene")
    parser.add_argument("--size", type=int, help=f"pixels on a side: {SIZE}, of sequences {SEQUENCE_SIZE}")
    parser.add_argument("--samples", type=int, default=256, help="along a ray")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--scenes", nargs="+", choices=OF_PAPER, help="all; of sequences " + ", ".join(SEQUENCES))
    parser.add_argument("--paper", action="store_true", help=f"as many particles as theirs, {PAPER_SIZE} pixels on a side")
    parser.add_argument("--frames", type=int, help="of sequences, in place of the table")
    parser.add_argument("-o", "--output", type=pathlib.Path, help="JSON, in place of that in results/")
    arguments = parser.parse_args()
    size = arguments.size or (PAPER_SIZE if arguments.paper else SEQUENCE_SIZE if arguments.frames else SIZE)
    output = arguments.output or RESULTS / ("table3.json" if arguments.frames else "table2.json")
    numbers = {name: number if arguments.paper else arguments.particles for name, number in OF_PAPER.items()}
    asked = {"size": size, "samples": arguments.samples, "repeats": arguments.repeats}
    rows: list[Record] = []
    for name in arguments.scenes or (SEQUENCES if arguments.frames else OF_PAPER):
        if arguments.frames:
            rows += sequence(name, arguments.frames, size, numbers[name], arguments.samples)
        else:
            view = js.scenes.load(name, numbers[name], width=size, height=size)
            rows += measure(name, view, arguments.samples, arguments.repeats, contenders())
            print("\n".join([HEADER, *(line(row) for row in rows if row["scene"] == name)]), flush=True)
        told = {} if arguments.frames else {"theirs_alone": theirs_alone(rows)}
        # so far: a run that ends early has what it measured
        keep(output, [row["contender"] for row in rows], **asked, records=rows, **told)
    if arguments.frames:
        assert all(row["frames_over"] == 0 for row in rows), rows
        return
    broken = [line(row) for row in rows if not is_kept(row)]
    assert not broken, "\n".join(["over the tolerance:", HEADER, *broken])
    assert any(row["over"] for row in rows if row["contender"] == NO_GREEDY), "cells that know nothing of each other kept it"


if __name__ == "__main__":
    main()
