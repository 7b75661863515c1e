"""Claim: a stricter step tolerance errs less, and on some volumes takes fewer evaluations than uniform samples as good.

The three made volumes of `made_fields` are rendered by uniform samples and by step doubling; errors are of colours, to
an image of very many uniform samples. What is counted is how often a ray asks its media: uniform samples of slabs that are not
marched count nothing, as step doubling does not march them either. Times are medians of the cast, in turns. Writes
`results/step_doubling.json`; ends in an assert on mean errors.

    python benchmarks/step_doubling.py [--points 64] [--size 64] [--repeats 3]
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import made_fields
import peers

import jaxsph as js
from jaxsph.engine.cast.integrator import Integrator, Segment
from jaxsph.engine.cast.step_doubling import StepDoubling
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.model import registry
from jaxsph.model.medium import Medium

RESULTS = peers.RESULTS.with_name("step_doubling.json")
SCENES = ("engine", "dragon", "mixing_layer")
UNIFORM = (32, 64, 128, 256, 512)
STEPS = ((32, 1e-1), (32, 1e-2), (64, 1e-1), (64, 1e-2), (64, 1e-3))
CONVERGED = 8192
HEADER = f"{'scene':14s} {'integrator':14s} samples tolerance  evaluations  max error  99 % error  mean error  seconds"


def counted(number: jax.Array, task: SlabTask) -> Segment:
    """A picture of how many evaluations rays take: slabs that let everything through, and shine in red."""
    nothing = jnp.zeros_like(number)
    return Segment((number, nothing, nothing), nothing + 1, jnp.zeros(task.shape, number.dtype))


class CountedSamples(Integrator):
    """Those of uniform samples."""

    def segment(self, optics, path):
        raise NotImplementedError("counts have no derivatives")

    def __call__(self, medium: Medium, gathered: object, task: SlabTask) -> Segment:
        """See `Integrator`."""
        real = (task.border[:, 1:] > task.border[:, :-1]).sum(1).astype(task.border.dtype)
        return counted(jnp.broadcast_to(real[:, None], task.shape[::2]), task)


class CountedSteps(StepDoubling):
    """Those of step doubling."""

    def __call__(self, medium: Medium, gathered: object, task: SlabTask) -> Segment:
        """See `Integrator`."""
        return counted(self.march(medium, task).evaluations.reshape(task.shape[::2]).astype(task.border.dtype), task)


COUNTING = {"samples": "counted_samples", "step_doubling": "counted_steps"}
registry.INTEGRATORS["counted_samples"] = f"{__name__}:CountedSamples"
registry.INTEGRATORS["counted_steps"] = f"{__name__}:CountedSteps"


def contenders() -> list[js.Settings]:
    """Uniform samples, and steps from few samples on."""
    steps = [js.Settings(samples=samples, integrator="step_doubling", step_tolerance=value) for samples, value in STEPS]
    return [*(js.Settings(samples=samples) for samples in UNIFORM), *steps]


def measure(name: str, arguments: argparse.Namespace) -> list[dict]:
    """Errors, evaluations and times of a scene."""
    scene, camera = getattr(made_fields, name)(arguments.points, width=arguments.size, height=arguments.size)
    truth = np.asarray(js.render(scene, camera, js.Settings(samples=CONVERGED)).color, np.float64)
    rows, settings = [], contenders()
    for one in settings:
        image = js.render(scene, camera, one)
        counts = js.render(scene, camera, dataclasses.replace(one, integrator=COUNTING[one.integrator])).color[..., 0]
        error = np.abs(np.asarray(image.color, np.float64) - truth).max(-1)
        row = {"scene": name, "integrator": one.integrator, "samples": one.samples}
        row["step_tolerance"] = one.step_tolerance if one.integrator == "step_doubling" else None
        row |= {"evaluations": float(counts.mean()), "max_error": float(error.max()), "mean_error": float(error.mean())}
        rows.append(row | {"error_99": float(np.quantile(error, 0.99))})
    times = [[js.render(scene, camera, one).stats["seconds"]["cast"] for one in settings] for _ in range(arguments.repeats)]
    for row, seconds in zip(rows, np.median(times, 0), strict=True):
        row["seconds"] = float(seconds)
        print(line(row), flush=True)
    return rows


def line(row: dict) -> str:
    """Of the printed table, under HEADER."""
    tolerance = "-" if row["step_tolerance"] is None else f"{row['step_tolerance']:g}"
    return (
        f"{row['scene']:14s} {row['integrator']:14s} {row['samples']:7d} {tolerance:>9s}  {row['evaluations']:11.1f}"
        f"  {row['max_error']:9.2g}  {row['error_99']:10.2g}  {row['mean_error']:10.2g}  {row['seconds']:7.3f}"
    )


def saved(rows: list[dict]) -> dict[str, float]:
    """By setting, how many times its evaluations uniform samples take for its mean error: interpolated, where any are as good."""
    uniform = sorted((row for row in rows if row["step_tolerance"] is None), key=lambda row: -row["mean_error"])
    error, spent = ([np.log(row[key]) for row in uniform] for key in ("mean_error", "evaluations"))
    found = {}
    for row in (row for row in rows if row["step_tolerance"] is not None and row["mean_error"] >= uniform[-1]["mean_error"]):
        as_good = np.exp(np.interp(-np.log(row["mean_error"]), -np.asarray(error), spent))
        found[f"{row['samples']} samples, {row['step_tolerance']:g}"] = round(float(as_good / row["evaluations"]), 2)
    return found


def falls(rows: list[dict]) -> bool:
    """Whether mean errors of step doubling fall with its tolerance, from the same samples on."""
    steps = [row for row in rows if row["step_tolerance"] is not None]
    pairs = [(loose, strict) for loose, strict in itertools.pairwise(steps) if loose["samples"] == strict["samples"]]
    return all(strict["mean_error"] < loose["mean_error"] for loose, strict in pairs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=64, help="of the grids, along the first axis")
    parser.add_argument("--size", type=int, default=64, help="pixels on a side")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("-o", "--output", type=pathlib.Path, default=RESULTS)
    arguments = parser.parse_args()
    print(HEADER)
    tables = {name: measure(name, arguments) for name in SCENES}
    times = {name: saved(rows) for name, rows in tables.items()}
    for name, found in times.items():
        print(f"{name:14s} evaluations saved: {', '.join(f'{value:g} ({setting})' for setting, value in found.items())}")
    arguments.output.parent.mkdir(exist_ok=True)
    sizes = {"size": arguments.size, "points": arguments.points, "converged": CONVERGED}
    records = [row for rows in tables.values() for row in rows]
    written = {"machine": peers.machine(), **sizes, "evaluations_saved": times, "records": records}
    arguments.output.write_text(json.dumps(written, indent=1) + "\n")
    assert all(falls(rows) for rows in tables.values())
    assert any(max(found.values()) > 1 for found in times.values()), times


if __name__ == "__main__":
    main()
