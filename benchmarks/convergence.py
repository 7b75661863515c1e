"""Claim: adaptive rays reach an error with fewer rays than uniform ones do, and the estimator sees what is wrong.

After section 7 of Kratz et al. 2011: relative L2 error of colours (their equation 11) against rays, for leaves split by the
hierarchical estimator and by the variance of corners (Levoy 1990), and for plain uniform grids. The truth is an image of
`--size` pixels on a side, with four times the samples that a ray has by default; the graphs are simulated on it
(`refinement_on_paper`), as what a ray would meet is known there. One field is rendered for real beside them: from 256 x 256 rays,
1000 leaves an iteration, as in their section 7.4. Writes `results/convergence.json`, and figures under `results/convergence/`;
ends in asserts.

    python benchmarks/convergence.py [--size 2048] [--timed-size 2048] [--fields engine ...] [--keep FOLDER]
"""

from __future__ import annotations

import argparse
import itertools
import pathlib
import statistics
import sys
import time
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.stats import spearmanr

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import convergence_figures
import refinement_on_paper as paper
from convergence_fields import FIELDS, finest
from kept import keep

import jaxsph as js

SAMPLES = 4 * js.Settings().samples
COARSEST = 64  # nodes on a side of the first lattice
STRIDES = 16, 8, 4, 2
SHARE = 0.4  # of the squared estimated error: what is split in a stage of the graphs
GOAL = 1e-2  # relative error
LEAST = 1e-3  # graphs end there
ADAPTIVE = "hierarchical", "corner_variance"
TIMED, INITIAL, WORST, MOST_ITERATIONS = "mixing layer", 256, 1000, 100  # section 7.4
MIN_GAIN = 3.0  # times fewer rays for the mixing layer
RESULTS = pathlib.Path(__file__).with_name("results") / "convergence.json"
Record = dict[str, Any]


def rays_for(curve: list[Record], goal: float = GOAL, key: str = "error") -> float | None:
    """Rays at which an error is reached, interpolated (in logarithms) between the stages around it."""
    for before, after in itertools.pairwise(curve):
        if before[key] > goal >= after[key]:
            share = np.log(before[key] / goal) / np.log(before[key] / after[key])
            return float(before["rays"] * (after["rays"] / before["rays"]) ** share)
    return None


def curve(value: Any, estimator: str) -> tuple[list[Record], list[Any]]:
    """Stages of an adaptive graph, and what was known before and after the goal was reached."""
    size, around = value.shape[0], []
    known, stages = paper.first_known(size, size // COARSEST), []
    how = {"coarsest": 2 * size // COARSEST, "estimator": estimator, "number": None}
    while True:
        after, stage = paper.refine(value, known, jnp.float32(SHARE), **how)
        stages.append({name: float(getattr(stage, name)) for name in ("rays", "error", "estimated", "true")})
        if stages[-1]["error"] > GOAL:
            around = [known]
        elif len(around) == 1:
            around.append(known)
        stuck = len(stages) > 1 and stages[-1]["rays"] == stages[-2]["rays"]
        if stages[-1]["error"] < LEAST or stuck or stages[-1]["rays"] > size**2 / 2:
            return stages[: -1 if stuck else None], around
        known = after


def parabolas(value: Any, around: list[Any]) -> Record:
    """Rays for the goal with leaves that are bilinear, biquadratic where smooth, and biquadratic where that is nearer."""
    how = {"coarsest": 2 * value.shape[0] // COARSEST, "estimator": "hierarchical", "number": None, "quadratic": True}
    both = [paper.refine(value, known, jnp.float32(SHARE), **how)[1] for known in around]
    rays, found = np.log([float(stage.rays) for stage in both]), {}
    for name in ("error", "smoothed", "best"):
        errors = np.log([float(getattr(stage, name)) for stage in both])
        slope = (rays[1] - rays[0]) / (errors[1] - errors[0])
        found[name] = float(np.exp(rays[0] + slope * (np.log(GOAL) - errors[0])))
    return found


def leaves(value: Any, known: Any) -> Record:
    """How estimated and true norms of leaves compare where the goal is reached."""
    pairs = paper.errors_of_leaves(value, known, coarsest=2 * value.shape[0] // COARSEST, estimator="hierarchical")
    said, true = (np.concatenate([np.ravel(pair[k]) for pair in pairs]) for k in (0, 1))
    there = true > 1e-3 * true.max()
    index = said[there] / true[there]
    return {
        "leaves": int(there.sum()),
        "pearson": float(np.corrcoef(said[there], true[there])[0, 1]),
        "spearman": float(spearmanr(said[there], true[there]).statistic),
        "index": [float(q) for q in np.quantile(index, (0.01, 0.1, 0.5, 0.9, 0.99))],
        "whole": float(np.sqrt((said**2).sum() / (true**2).sum())),
        "sample": np.stack([said[there], true[there]], 1)[:: max(1, there.sum() // 2000)].tolist(),
    }


def measure(name: str, value: Any) -> Record:
    """All graphs of a field."""
    grids = [dict(zip(("rays", "error"), map(float, paper.uniform(value, stride=stride)), strict=True)) for stride in STRIDES]
    curves, around = {"uniform": grids}, []
    for estimator in ADAPTIVE:
        curves[estimator], found = curve(value, estimator)
        around = around or found
    rays = {kind: rays_for(stages) for kind, stages in curves.items()}
    record = {"field": name, "size": value.shape[0], "curves": curves, "rays": rays, "parabolas": None, "leaves": None}
    if len(around) == 2:
        record |= {"parabolas": parabolas(value, around), "leaves": leaves(value, around[1])}
    return record


def iterations(value: Any) -> list[Record]:
    """Section 7.4 on paper: from 256 x 256 rays, 1000 leaves at a time, until the goal is reached."""
    stride = value.shape[0] // INITIAL
    known, stages = paper.first_known(value.shape[0], stride), []
    how = {"coarsest": 2 * stride, "estimator": "hierarchical", "number": WORST}
    while len(stages) < MOST_ITERATIONS and (not stages or stages[-1]["error"] > GOAL):
        known, stage = paper.refine(value, known, jnp.float32(1), **how)
        stages.append({name: float(getattr(stage, name)) for name in ("rays", "error", "estimated", "true")})
    return stages


def timed(size: int) -> Record:
    """The same for real: seconds of each iteration, and of an image whose every pixel has a ray, in turns."""
    scene, camera = FIELDS[TIMED](size)
    settings = js.Settings(leaf_pixels=2 * size // INITIAL)
    full = js.render(scene, camera, js.Settings())
    truth = np.asarray(full.color)
    progress, turns, every = js.progressive(scene, camera, settings, worst=WORST), [], []
    for _ in range(4):  # the first is for compiling
        turns.append(staged(progress.restart(), truth))
        begun = time.perf_counter()
        np.asarray(js.render(scene, camera, js.Settings()).color)
        every.append(time.perf_counter() - begun)
    value = jnp.concatenate([full.color, full.transmittance[..., None], jnp.zeros((size, size, 2))], -1)
    last = sorted(turns[1:], key=lambda stages: sum(stage["seconds"] for stage in stages))[1]
    return {"size": size, "every_pixel": statistics.median(every[1:]), "stages": last, "on_paper": iterations(value)}


def staged(progress: js.progressive, truth: np.ndarray) -> list[Record]:
    """Iterations until the goal is reached."""
    stages: list[Record] = []
    while len(stages) < MOST_ITERATIONS and (not stages or stages[-1]["error"] > GOAL):
        begun = time.perf_counter()
        image = next(progress)
        color = np.asarray(image.color)
        seconds = time.perf_counter() - begun
        error = float(np.sqrt(((color - truth) ** 2).sum() / (truth**2).sum()))
        told = {"rays": image.stats["rays"], "estimated": image.stats["l2_error"], "spent": image.stats["seconds"]}
        stages.append({"error": error, "seconds": seconds, **told})
    return stages


def table(records: list[Record]) -> str:
    """Rays for the goal."""
    lines = [f"{'field':14s} {'uniform':>10s} {'variance':>10s} {'hierarchical':>12s} {'fewer':>6s} biquadratic: smooth, best"]
    for record in records:
        rays = [record["rays"][kind] for kind in ("uniform", "corner_variance", "hierarchical")]
        shown = [f"{number:>10,.0f}" if number else " " * 9 + "-" for number in rays]
        fewer = f"{rays[0] / rays[2]:6.2f}" if rays[0] and rays[2] else "     -"
        gains = record["parabolas"]
        curved = f"{gains['error'] / gains['smoothed']:.3f}, {gains['error'] / gains['best']:.3f}" if gains else "-"
        lines.append(f"{record['field']:14s} {' '.join(shown)} {fewer} {curved}")
    return "\n".join(lines)


def error_at(stages: list[Record], rays: float) -> float:
    """Of a graph, in logarithms."""
    x, y = (np.log([stage[key] for stage in stages]) for key in ("rays", "error"))
    return float(np.exp(np.interp(np.log(rays), x, y)))


def check(records: list[Record]) -> list[str]:
    """What the claim says and is not so."""
    wrong = []
    for record in records:
        curves = record["curves"]
        adaptive = curves["hierarchical"]
        between = [grid for grid in curves["uniform"] if adaptive[0]["rays"] < grid["rays"] <= adaptive[-1]["rays"]]
        if any(error_at(adaptive, grid["rays"]) >= grid["error"] for grid in between):
            wrong.append(f"{record['field']}: uniform rays are as good as adaptive ones")
        if record["field"] == "ramp":
            beyond = [stage for stage in curves["hierarchical"] if stage["rays"] > INITIAL**2]
            if any(stage["error"] >= error_at(curves["corner_variance"], stage["rays"]) for stage in beyond):
                wrong.append("ramp: the variance of corners is as good beyond 256 x 256 rays")
        if record["field"] == TIMED and not record["rays"]["uniform"] > MIN_GAIN * record["rays"]["hierarchical"]:
            wrong.append(f"{TIMED}: less than {MIN_GAIN} times fewer rays")
    return wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=2048, help="pixels on a side of the finest images")
    parser.add_argument("--timed-size", type=int, default=2048, help="of what is rendered for real; 512, 1024, 2048 or 4096")
    parser.add_argument("--fields", nargs="+", choices=FIELDS, default=list(FIELDS))
    parser.add_argument("--keep", type=pathlib.Path, help="folder where finest images are kept, or were")
    parser.add_argument("-o", "--output", type=pathlib.Path, default=RESULTS, help="JSON; a folder of figures is beside it")
    arguments = parser.parse_args()
    records, images, on_paper = [], {}, []
    for name in arguments.fields:
        value = jnp.asarray(finest(name, arguments.size, SAMPLES, arguments.keep))
        images[name] = np.asarray(value[::4, ::4, :3])
        records.append(measure(name, value))
        if name == TIMED:
            on_paper = iterations(value)
        print(name, flush=True)
    rendered = timed(arguments.timed_size)
    found = {"samples": SAMPLES, "goal": GOAL, "worst": WORST, "fields": records, "iterations": on_paper, "timed": rendered}
    convergence_figures.draw(found, images, arguments.output.with_suffix(""))
    for record in records:
        (record["leaves"] or {}).pop("sample", None)  # a figure shows it
    keep(arguments.output, ("uniform", *ADAPTIVE), **rounded(found))
    print(table(records))
    each = statistics.median(stage["seconds"] for stage in rendered["stages"][1:])
    total = sum(stage["seconds"] for stage in rendered["stages"])
    simulated = f"{len(on_paper) - 1} on paper at {arguments.size}, " if on_paper else ""
    print(f"iterations to {GOAL:g}: {simulated}{len(rendered['stages']) - 1} for real at {arguments.timed_size}")
    print(f"{each:.3f} s each, {total:.3f} s in all, every pixel {rendered['every_pixel']:.3f} s")
    wrong = check(records)
    assert not wrong, "\n".join(wrong)


def rounded(found: Any) -> Any:
    """Five digits: more are noise."""
    if isinstance(found, float):
        return float(f"{found:.5g}")
    if isinstance(found, dict):
        return {key: rounded(value) for key, value in found.items()}
    return [rounded(value) for value in found] if isinstance(found, list) else found


if __name__ == "__main__":
    main()
