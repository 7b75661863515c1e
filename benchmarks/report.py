"""Write `docs/how_accurate_how_fast.md` from the committed results: no number on that page is typed by hand.

python benchmarks/report.py
"""

from __future__ import annotations

import json
import pathlib
from collections.abc import Callable, Iterable, Sequence

HERE = pathlib.Path(__file__).parent
RESULTS, PAGE = HERE / "results", HERE.parent / "docs" / "how_accurate_how_fast.md"

# Hochstetter et al. 2016, table 2 (GTX Titan, means) and table 3 (most of a sequence): particles, error, time to full rate
PAPER = {
    ("flubber", 0.004): (0.5, "7.2e-4", 1.3),
    ("checker_board", 0.001): (1.2, "3.3e-5", 1.08),
    ("checker_board", 0.004): (1.2, "2.1e-4", 1.26),
    ("checker_board", 0.01): (1.2, "1.1e-3", 1.38),
    ("mixer", 0.001): (2.5, "1.06e-3", 1.36),
    ("mixer", 0.004): (2.5, "2.7e-3", 1.43),
    ("mixer", 0.01): (2.5, "5.6e-3", 1.5),
    ("radial", 0.001): (10, "6.2e-4", 1.15),
    ("radial", 0.004): (10, "1.3e-3", 1.44),
    ("radial", 0.01): (10, "2.0e-3", 1.62),
}


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def number(value: float | None, form: str = ".2g") -> str:
    return "-" if value is None else format(value, form)


def machine(found: dict) -> str:
    about = found["machine"]
    return f"{about['device']}, {about['cores']} cores, {about['dtype']}, jax {about['jax']}, Python {about['python']}"


def trade(found: dict) -> str:
    """Error against tolerance, and against time; what beats coarser sampling; the numbers of Hochstetter et al. 2016."""
    rows, promised = [], []
    for record in found["records"]:
        saved = record["evaluations_full"] / record["evaluations"] if record["evaluations"] else None
        errors = number(record["max_error"]), number(record["mean_error"]), number(record["max_error_converged"])
        rows.append([
            record["scene"], record["method"], number(record["tolerance"], "g"), *errors, number(record["max_bound"]),
            number(saved, ".2f"), number(record["full_total"] / record["total"], ".2f"),
        ])  # fmt: skip
        paper = PAPER.get((record["scene"], record["tolerance"]))
        if paper and record["method"] in ("interval", "interval relaxed", "pilot"):
            over = f"{100 * record['over_tolerance']:.2g} %"
            speed = number(record["full_total"] / record["total"], ".2f")
            ours = record["method"], f"{record['particles'] / 1e6:.2g} M", number(record["max_error"]), over, speed
            promised.append([record["scene"], f"{record['tolerance']:g}", *ours, f"{paper[0]} M", paper[1], paper[2]])
    chosen = [row for scene in found["beaten"] for row in at_tolerances([r for r in found["records"] if r["scene"] == scene])]
    beaten = [[scene, *pair] for scene, by in found["beaten"].items() for pair in by.items()]
    header = "scene", "method", "tolerance", "max error", "mean error", "to converged", "bound", "evaluations saved", "speed-up"
    against = (
        "scene",
        "tolerance",
        "method",
        "particles",
        "max error",
        "rays over",
        "speed-up",
        "paper: particles",
        "error",
        "speed-up",
    )
    lost = sum(by is None for *_, by in beaten)
    beaten = [[scene, baseline, by or "nothing"] for scene, baseline, by in beaten]
    shape = f"{found['size']} x {found['size']} pixels, {found['samples']} samples a ray, {machine(found)}"
    return f"""## Error against tolerance against time
{shape}.
Errors are the largest difference of any colour channel or alpha to the same frame at full rate; "to converged" is that to an
image of 8 times the samples, so that the error of full rate itself is seen too. Speed-up is the time of full rate over that of
the setting, medians in turns. `interval` is certified; `interval relaxed` and `pilot` are estimates.

{table(header, rows)}

What keeps to a tolerance in least time, with error control and without (`full rate`, `samples/K`, `size/K`), and the time of the
latter over that of the former:

{table(("scene", "tolerance", "without", "with", "speed-up"), chosen)}

Which setting with error control takes no more time and errs no more than sampling coarser everywhere (`samples/K`), or than a
smaller image scaled up (`size/K`):

{table(("scene", "baseline", "beaten by"), beaten)}

{lost} of {len(beaten)} baselines are not beaten in this sense. They are faster than any setting here, at the errors above: every
sample is shaded whatever the tolerance, and slabs at a silhouette are marched at full rate. Small images have much of both;
larger ones save more (see the pilot estimator below).

### Beside Hochstetter et al. 2016
Its tables 2 and 3 (GTX Titan, up to 10 M particles, relaxed). Data are of the same kind, not the same:
compare shapes, not digits.

{table(against, promised)}
"""


def large(found: dict) -> str:
    """The paper's setting: its size of pictures, and more particles."""
    rows = []
    for record in found["records"]:
        paper = PAPER.get((record["scene"], record["tolerance"]))
        saved = record["evaluations_full"] / record["evaluations"]
        errors = number(record["max_error"]), number(record["max_error_converged"])
        speed = number(record["full_total"] / record["total"], ".2f"), "-" if paper is None else f"{paper[2]:g}"
        rows.append([record["method"], number(record["tolerance"], "g"), *errors, number(saved, ".2f"), *speed])
    first = found["records"][0]
    header = "method", "tolerance", "to full rate", "to converged", "evaluations saved", "speed-up", "paper"
    return f"""### {first["scene"]} of {first["particles"]:,} particles at {found["size"]} x {found["size"]}
{found["samples"]} samples a ray, {first["device"]}, {first["cores"]} cores: full rate takes {first["total"]:.2f} s. Segments
keep to the light integral, which "to converged" comes near to, the others to full rate; the paper's are speed-ups of its table 2.

{table(header, rows)}
"""


def sequences(found: dict) -> str:
    """Error control over the frames of each scene."""
    groups: dict[tuple, list[dict]] = {}
    for record in found["records"]:
        if record["tolerance"] is not None:
            groups.setdefault((record["scene"], record["method"], record["tolerance"]), []).append(record)
    rows = []
    for (scene, method, tolerance), records in groups.items():
        errors = (number(max(record[key] for record in records)) for key in ("max_error", "max_bound"))
        over = max(record["over_tolerance"] for record in records)
        frames = sum(record["over_tolerance"] > 0 for record in records)
        rows.append([scene, method, f"{tolerance:g}", len(records), *errors, frames, f"{100 * over:.2g} %"])
    header = "scene", "method", "tolerance", "frames", "max error", "max bound", "frames over", "rays over"
    return f"""## Over sequences
Frames {", ".join(f"{frame:g}" for frame in sorted({record["frame"] for record in found["records"]}))} of each scene,
{found["size"]} x {found["size"]} pixels, {found["samples"]} samples a ray, {machine(found)}. `interval` is certified: no
frame may be over its tolerance. "Rays over" is of the frame with most. Hochstetter et al. 2016 have up to 0.0125 % of rays over
it, in 1 frame of 1200 (its table 3, relaxed).

{table(header, rows)}
"""


def at_tolerances(records: list[dict]) -> list[list[str]]:
    """At each tolerance, the fastest uniform sampling whose error keeps to it, and the fastest setting with error control."""
    rows = []
    for limit in sorted({record["tolerance"] for record in records} - {None}):
        within = [record for record in records if record["max_error"] <= limit]
        uniform = min((r for r in within if r["tolerance"] is None), key=share)
        control = min((r for r in within if r["tolerance"] == limit), key=share)
        ratio = share(uniform) / share(control)
        rows.append([uniform["scene"], f"{limit:g}", uniform["method"], control["method"], f"{ratio:.2f}"])
    return rows


def share(record: dict) -> float:
    """Time, over that of full rate in the same turns."""
    return record["total"] / record["full_total"]


def scaling(found: dict) -> str:
    parts = []
    for kind, records in found["tables"].items():
        names = list(records[0]["seconds"])
        rows = [[f"{record[kind]:,}", *(f"{record['seconds'][name]['total']:.3f}" for name in names)] for record in records]
        rows.append(["**exponent**", *(f"**{found['exponents'][kind][name]:.2f}**" for name in names)])
        parts.append(table([kind, *(f"{name}, s" for name in names)], rows))
    middle = "\n\n".join(parts)
    return f"""## More particles, more pixels
{found["scene"]}, {machine(found)}; grid, analysis and cast. The exponent is the slope of log time over log number.

{middle}
"""


def pilots(found: dict) -> str:
    rows = []
    for record in found["records"]:
        ratios = [number(ratio, ".3g") for ratio in record["estimate_to_error"] or []]
        errors = number(record["max_error"]), f"{record['pixels_over_tolerance']:.1e}", *(ratios or ["-"] * 3)
        saved = (
            number(record["evaluations_saved"], ".2f"),
            number(record.get("oracle"), ".2f"),
            number(1 / record["total_to_full"], ".2f"),
        )
        rows.append([record["scene"], record["size"], number(record["tolerance"], "g"), *saved, *errors])
    header = "scene", "size", "tolerance", "evaluations saved", "oracle", "speed-up", "max error", "pixels over"
    return f"""## The pilot estimator
{machine(found)}.
The oracle is what could be saved if the error of every choice were known. The last columns are the estimated over the true error
of a pixel, at 1, 50 and 99 % of the pixels that differ at all.

![Evaluations saved, speed-up, and estimate over error](../benchmarks/results/pilot.png)

{table((*header, "1 %", "50 %", "99 %"), rows)}
"""


def peers(found: dict) -> str:
    rows = [[name, *(number(ratio) for ratio in ratios.values())] for name, ratios in found["ratios"].items()]
    return f"""## Beside a hand-written marcher
Time of a frame over that of a Numba packet marcher on the same particles, 512 x 512 x 256 samples, {machine(found)}.

{table(("particles", *next(iter(found["ratios"].values()))), rows)}
"""


def surfaces(found: dict) -> str:
    """Depths and CPU time beside a mesh and its rays."""
    rows = []
    for record in found["records"]:
        first, second = record["cpu_seconds"].values()
        own = "median" not in record
        apart = ["-"] * 3 if own else [number(record["median"]), number(record["percent_90"])]
        if not own:
            apart.append(f"{record['ours_alone']} and {record['theirs_alone']} of {record['both']:,}")
        rows.append([record["file"], record["contender"], *apart, f"{first:.2f}", f"{second:.2f}", f"{first + second:.2f}"])
    header = (
        "file",
        "contender",
        "median",
        "90 %",
        "found by us or the mesh alone",
        "volumes or mesh",
        "image or rays",
        "in all",
    )
    size = found["records"][0]["size"]
    return f"""## Surfaces of liquids beside a mesh
`pysplashsurf` {found["machine"]["pysplashsurf"]} (marching cubes of so many particle radii, then Embree through the
same pixels) and `jaxsph.Surface` of the same field and level, {size} x {size} pixels, {machine(found)}.
How far depths are from each other, in supports; CPU seconds of all threads.
They come together with the square of the cubes, so what is left is of the mesh. A mesh
serves many views. What one finds alone are outlines and droplets, fewer with smaller cubes.

{table(header, rows)}

![Ours, the mesh of half radii, and decades of their difference](../benchmarks/results/surfaces.png)
"""


def grids(found: dict) -> str:
    rows = []
    for record in found["records"]:
        errors = number(record["max_error"]), number(record["mean_error"])
        seconds = [f"{record[stage]:.3f}" for stage in ("resample", "cast", "total")]
        rows.append([record["scene"], record["contender"], *errors, *seconds])
    size = found["records"][0]["size"]
    header = "scene", "contender", "max error", "mean error", "resample, s", "cast, s", "in all, s"
    return f"""## Beside resampling to a grid
VTK {found["machine"]["vtk"]}, `vtkSPHInterpolator` to a grid and ray casting of that: {size} x {size} pixels,
cubic spline kernel, {machine(found)}. Errors of colours against an image of 8 times the samples (VTK's
images have 8 bits: 0.002 at least).

{table(header, rows)}

yt's projections are not in the table: they are integrals along the ray, without opacity or transfer function.
"""


def gradients(found: dict) -> str:
    frames, scans = [], []
    for record in found["frames"]:
        ratios = record["backward_to_frame"], record["memory_to_frame"]
        frames.append([record["scene"], record["size"], *(f"{ratio:.2f}" for ratio in ratios)])
    for record in found["against_scan"]:
        used = [record["programs"][program]["bytes"] / 2**20 for program in ("marched", "scanned")]
        scans.append([record["samples"], *(f"{size:.1f}" for size in used)])
    return f"""## Gradients
By everything at once, {machine(found)}: what the backward pass takes beyond the frame, over the frame; and memory.

{table(("scene", "size", "backward / frame", "memory / frame"), frames)}

Memory in MiB beside plain automatic differentiation of a scan over samples, on a scene of 150 particles:

{table(("samples", "jaxsph", "scan"), scans)}
"""


def convergence(found: dict) -> str:
    """Rays for an error: the graphs of Kratz et al. 2011, and the iterations of their section 7.4."""
    rows, leaves = [], []
    for record in found["fields"]:
        reached = [record["rays"][kind] for kind in ("uniform", "corner_variance", "hierarchical")]
        least = "" if reached[0] else "> "
        most = reached[0] or record["curves"]["uniform"][-1]["rays"]
        fewer = [least + number(most / rays, ".1f") if rays else "-" for rays in reached[1:]]
        rays = [least + number(most, ",.0f"), *(number(some, ",.0f") for some in reached[1:])]
        curved = record["parabolas"]
        gains = [number(100 * (1 - curved[kind] / curved["error"]), ".1f") if curved else "-" for kind in ("smoothed", "best")]
        rows.append([record["field"], *rays, *fewer, *gains])
        if about := record["leaves"]:
            index = [number(about["index"][k], ".2f") for k in (0, 2, 4)]
            leaves.append([record["field"], number(about["spearman"], ".2f"), *index, number(about["whole"], ".2f")])
    size, goal, run = found["fields"][0]["size"], found["goal"], found["run"]
    header = "field", "uniform", "variance of corners", "hierarchical", "uniform / variance", "uniform / hierarchical"
    return f"""## Fewer rays: the quadtree
After section 7 of Kratz et al. 2011. Relative L2 error of colours (their equation 11) against rays: leaves split by the
hierarchical estimator, by the variance of their corners (Levoy 1990), and plain uniform grids. The truth is an image of
{size} x {size} pixels and {found["samples"]} samples a ray; refinement is simulated on it, by the same marking that renders,
where no pixel is known to be empty and no bundle is cast whole. {run["device"]}, {run["cores"]} cores, jax {run["jax"]}.

![Error against rays](../benchmarks/results/convergence/rays.png)

Rays for an error of {100 * goal:g} %. The last columns are how many per cent of the hierarchical estimator's rays would be saved
if smooth leaves were biquadratic: those that are smooth by their errors, and those that really gain.

{table((*header, "smooth, %", "best, %"), rows)}

Estimated over true error of leaves where {100 * goal:g} % is reached: rank correlation, effectivity index at 1, 50 and 99 % of
the leaves that matter (0.1 % of the largest error or more), and that of the whole image.

![Estimated against true error of leaves](../benchmarks/results/convergence/leaves.png)

{table(("field", "rank correlation", "1 %", "50 %", "99 %", "whole image"), leaves)}

{iterations(found)}
"""


def iterations(found: dict) -> str:
    """Section 7.4 of Kratz et al. 2011."""
    size, timed = found["fields"][0]["size"], found["timed"]
    stages, spent = timed["stages"], timed["stages"][-1]["spent"]
    total, later = sum(stage["seconds"] for stage in stages), sorted(stage["seconds"] for stage in stages[1:])
    shares = ", ".join(f"{name} {100 * seconds / sum(spent.values()):.0f} %" for name, seconds in spent.items())
    seconds = f"the first lattice in {stages[0]['seconds']:.2f} s, then {later[len(later) // 2]:.2f} s each"
    return f"""Section 7.4 of the paper, on the mixing layer: from 256 x 256 rays, {found["worst"]} leaves an iteration, to an
error of {found["goal"]:g}. The paper takes 7 iterations; here it is {len(found["iterations"]) - 1} on paper at {size} x {size}.
Rendered for real at {timed["size"]} x {timed["size"]} with {found["samples"] // 4} samples it is {len(stages) - 1}
({len(timed["on_paper"]) - 1} on paper, as fewer samples leave more to resolve): {seconds},
{total:.2f} s in all; an image whose every pixel has a ray takes {timed["every_pixel"]:.2f} s.
Of the time: {shares} (`adapt` is estimator and marking, `image` reconstruction).
In the run that this was measured in, the first iterations went to leaves that look empty and may not be, of which the simulation
knows nothing, and bundles of which more than sixteen rays were wanted were cast whole; now the former compete with all others,
and eight are enough. Rays of bundles that are certain to be empty are not cast, nor counted.

![Iterations of a real image](../benchmarks/results/convergence/iterations.png)"""


def points(found: dict) -> str:
    """Points cast and splatted among gas: Kaehler, Abel & Hege 2007, section 4."""
    rows, ratios = [], []
    for scene in found["scenes"]:
        of = {row["what"]: row for row in scene["rows"]}
        for what, row in of.items():
            stages = [number(row["stages"].get(stage), ".3f") for stage in ("grid", "adapt", "cast")]
            error = [number(row["error"].get(kind)) for kind in ("max", "p999", "rms")]
            rows.append([scene["scene"], what, number(row["seconds"], ".2f"), *stages, *error])
        sprites, hybrid, full = scene["theirs"]
        over = [of[f"region {region:g}"]["seconds"] / of["region 0"]["seconds"] for region in (0.5, 1)]
        given = number(over[0], ".2f"), number(sprites / hybrid, ".2f"), number(over[1], ".2f"), number(sprites / full, ".2f")
        ratios.append([scene["scene"], *given])
    run = found["run"]
    return f"""## Points among gas: splats, regions of interest, chords
The two data sets of Kaehler, Abel & Hege 2007, section 4, in kind: 150,000 galaxies and 120,000 stars, each in gas of 256^3, at
830 x 520. In a region, a share of the depth from the eye on, points are cast along their chords, and beyond it they are splats:
region 0 is all splats, region 1 none. Errors are against region 1. {run["device"]}, {run["cores"]} cores, jax {run["jax"]}.

{table(("scene", "what", "seconds", "grid", "adapt", "cast", "largest error", "0.1 % over", "rms"), rows)}

Time over that of all splats, and the same of their frames a second on a graphics card of 2006:

{table(("scene", "half the depth", "theirs", "all cast", "theirs"), ratios)}

![Error against time](../benchmarks/results/points_and_grids.png)
"""


def accesses(found: dict) -> str:
    """Grid against octree, frame by frame."""
    frames = found["frames"]
    header = "scene", "grid, s", "octree, s", "octree over grid", "mean difference of colour"
    rows = [
        [name, *(number(row["seconds"][way]) for way in ("grid", "octree")), number(row["octree over grid"], ".1f"),
         number(row["mean difference"])]
        for name, row in frames["found"].items()
    ]  # fmt: skip
    size, of, run = frames["size"], f"{frames['samples']} point samples a ray", frames["run"]
    return f"""## Which access
Frames of {frames["particles"]} particles or points, {size} x {size} pixels and {of}, by the perspective grid and by octrees
that are made once (`in_octree`), medians of {frames["repeats"]} in turns, {run["device"]}, {run["cores"]} cores. Particles
show the same either way; points have exact chords by the grid, and are met or missed by samples in an octree.

{table(header, rows)}

Rays of a bundle share what the grid finds, while every sample asks the octree by itself: the grid wins in each of these, by far
where a sample is in many supports, and by little where it is in few points. So the rule is: the grid, unless the integrator asks
for points of its own choosing, which no list of slabs can answer.
"""


def truths(found: dict) -> str:
    """Points and segments against the light integral, scene by scene."""
    header = ["scene", "integrator", "samples or tolerance", "mean", "99.9 %", "max"]
    header += ["over, thrice", "told / true", "s", "points, s"]
    rows = [
        [scene["scene"], row["integrator"], row["samples"] if row["tolerance"] is None else f"t = {row['tolerance']:g}",
         *(number(row[key], ".1e") for key in ("mean", "p999", "max")),
         "-" if row["tolerance"] is None else f"{row['over_1']:.2%}, {row['over_3']:.2%}",
         " ".join(f"{ratio:.2g}" for ratio in row.get("estimate_over_error") or ()) or "-",
         number(row["seconds"], ".3f"), number(row.get("points_time"), ".3f")]
        for scene in found["scenes"] for row in scene["rows"]
    ]  # fmt: skip
    return f"""## Against the light integral
{found["size"]} x {found["size"]} pixels, errors at up to {max(scene["pixels"] for scene in found["scenes"])} random ones that any
particle touches, against `jaxsph.reference.integral`; {found["run"]["device"]}, {found["run"]["cores"]} cores, medians in turns.
`samples` are points, `pilot` the same with 1,024 samples and that estimator's tolerance; `over, thrice` are the shares of pixels
over the tolerance and over three times it, `told / true` the 1 %, 50 % and 99 % quantiles of the estimate over the error,
`points, s` the time of uniform points of the same 99.9 % error.

{table(header, rows)}
"""


SECTIONS: dict[str, Callable[[dict], str]] = {
    "truth": truths, "trade": trade, "trade_200k": large, "trade_1m": large, "sequences": sequences, "pilot": pilots,
    "convergence": convergence, "scaling": scaling,
    "peers": peers, "surfaces": surfaces, "vtk_grid": grids, "gradients": gradients, "octree": accesses,
    "points_and_grids": points,
}  # fmt: skip


def page() -> str:
    """The page, from the results that there are."""
    files = {name: RESULTS / f"{name}.json" for name in SECTIONS}
    sections = [SECTIONS[name](json.loads(file.read_text())) for name, file in files.items() if file.exists()]
    head = """# How accurate, how fast
Made by `python benchmarks/report.py` from `benchmarks/results/`, where each section has a file of its benchmark's name. Times are
of shared machines: read ratios. What is promised, and over which range of inputs, is in `accuracy_and_limits.md`.
"""
    return "\n".join([head, *sections])


if __name__ == "__main__":
    PAGE.write_text(page())
