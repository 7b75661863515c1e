"""Write `docs/how_accurate_how_fast.md` from the committed results: no number on that page is typed by hand.

python benchmarks/report.py
"""

from __future__ import annotations

import json
import pathlib
import statistics
from collections.abc import Callable, Iterable, Sequence
from typing import Any

HERE = pathlib.Path(__file__).parent
RESULTS, PAGE = HERE / "results", HERE.parent / "docs" / "how_accurate_how_fast.md"
TOLERANCES = 0.001, 0.004, 0.01
SMALL = 256  # pixels on a side
IDLE = 1.2  # load for each core, of a machine that does little else
COARSER = "samples/2", "samples/4", "size/2", "size/4"
KINDS = {
    "render": "picture",
    "kept": "to the tolerance",
    "project": "column densities",
    "gradient": "gradient by everything",
    "correct": "",
}


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    first, *others = ("| " + " | ".join(map(str, line)) + " |" for line in (header, *rows))
    return "\n".join([first, "|" + "---|" * len(header), *others])


def number(value: float | None, form: str = ".2g") -> str:
    return "-" if value is None else format(value, form)


def several(values: Iterable[float | None], form: str = ".2g") -> str:
    """Numbers of one cell."""
    return ", ".join(number(value, form) for value in values)


def alike(values: Iterable[float | None], form: str = ".2g") -> str:
    """Numbers of one cell, of several tolerances; one number where all are the same."""
    told = several(values, form)
    return told.split(", ")[0] if len(set(told.split(", "))) == 1 else told


def machine(found: dict) -> str:
    about = found["run"]
    return f"{about['device']}, {cores(about)}, {about['dtype']}, jax {about['jax']}"


def cores(about: dict) -> str:
    return f"{about['cores']} core{'s' * (about['cores'] > 1)}"


def share(record: dict) -> float:
    """Time, over that of full rate in the same turns."""
    return record["total"] / record["full_total"]


def grouped(records: Iterable[dict], *names: str) -> dict[tuple, list[dict]]:
    """Records by what they have under some names, in their order."""
    groups: dict[tuple, list[dict]] = {}
    for record in records:
        groups.setdefault(tuple(record[name] for name in names), []).append(record)
    return groups


def relaxed(groups: dict[tuple, list[dict]]) -> str:
    """Takes relaxed bounds out where they came to the same images as bounds did, and says by how much they were faster."""
    speeds = []
    for *scene, method in [key for key in groups if key[-1] == "interval relaxed"]:
        own, others = groups[*scene, method], groups[*scene, "interval"]
        if [(row["max_error"], row["evaluations"]) for row in own] == [(row["max_error"], row["evaluations"]) for row in others]:
            speeds += [1 / share(row) for row in groups.pop((*scene, method))]
    return f"Relaxed bounds chose the same, at {min(speeds):.2f} to {max(speeds):.2f} of full rate's speed." if speeds else ""


def trade(found: dict) -> str:
    """Error against tolerance, and against time; what beats coarser sampling."""
    controlled = {
        key: rows for key, rows in grouped(found["records"], "scene", "method").items() if rows[0]["tolerance"] is not None
    }
    same = relaxed(controlled)
    rows = [
        [*key, "-" if key[-1] == "segments" else alike(row["max_error"] for row in rows),
         alike((row["integral_p999"] for row in rows), ".1e"), alike((saved_by(row) for row in rows), ".2f"),
         alike((1 / share(row) for row in rows), ".2f")]
        for key, rows in controlled.items()
    ]  # fmt: skip
    uniform = []
    for (scene,), records in grouped(found["records"], "scene").items():
        of = {record["method"]: record for record in records}
        cells = [f"{number(of[name]['max_error'])}, {number(1 / share(of[name]), '.2f')}" for name in COARSER]
        uniform.append([scene, number(of["full rate"]["max_error_converged"]), *cells, fastest(records)])
    beaten = [(scene, *pair) for scene, by in found["beaten"].items() for pair in by.items() if pair[0] in COARSER]
    lost = sum(by is None for *_, by in beaten)
    return f"""## Error against tolerance against time
{found["size"]} x {found["size"]} pixels, {found["samples"]} samples a ray, {machine(found)}. Each cell is of tolerances
{several(TOLERANCES, "g")}, or of all of them alike. Errors are the largest of any channel to full rate,
which `interval` certifies and `pilot` estimates; and what 99.9 % of pixels stay below
of the difference to the light integral, which `segments` estimate.
Evaluations saved and speed-up are over full rate, in turns. {same}

{table(("scene", "method", "error", "to the integral", "evaluations saved", "speed-up"), rows)}

Without error control: the error of full rate to 8 times the samples; error and speed-up of fewer samples, and of smaller images
scaled up; then what keeps to each tolerance in least time, and its speed-up over what does so without error control.

{table(("scene", "full rate", *COARSER, "fastest within"), uniform)}

{analysis(found["records"])}
Of these {len(beaten)} coarser settings {lost} are beaten in time and error at once by none with error control: small images are
mostly silhouettes, where slabs are marched at full rate. Larger ones save more.
"""


def analysis(records: list[dict]) -> str:
    """How long bounds take to be analysed, where anything is chosen and elsewhere."""
    cast = {record["scene"]: record["cast"] for record in records if record["method"] == "full rate"}
    shares: dict[bool, list[float]] = {True: [], False: []}
    for record in (one for one in records if one["method"] == "interval"):
        chosen = record["evaluations"] < record["evaluations_full"]
        shares[chosen].append(record["adapt"] / cast[record["scene"]])
    told = [f"{100 * min(some):.0f} % to {100 * max(some):.0f} %" if some else "-" for some in shares.values()]
    return f"The analysis of bounds takes {told[0]} of the cast at full rate where anything is chosen, {told[1]} elsewhere."


def beside_paper(found: dict) -> str:
    """Table 2 of Hochstetter et al. 2016, row by row."""
    about, rows = found["run"], []
    for row in [*found["records"], *found["theirs_alone"]]:
        paper = row["theirs"] or {}
        time = [f"{milliseconds(paper.get(name))} / {milliseconds(row.get(name))}" for name in ("grid", "adapt", "cast", "total")]
        faster = " / ".join(
            f"{number(of['speed_cast'], '.2f')} ({number(of['speed_total'], '.2f')})" if "cast" in of else "-"
            for of in (paper, row)
        )
        error = paper.get("error")
        wrong = f"{error if isinstance(error, str) else number(error)} / {number(row.get('error'))}"
        coarser = "-" if row["tolerance"] is None or "coarser" not in row else f"{row['coarser']:.1%}"
        rows.append([row["scene"], row["contender"], number(row["tolerance"], "g"), wrong, *time, faster, coarser])
    counts = {row["scene"]: (row["theirs"]["particles"], row["particles"]) for row in found["records"] if row["theirs"]}
    told = ", ".join(f"{scene} {theirs / 1e6:g} M / {ours / 1e6:.2g} M" for scene, (theirs, ours) in counts.items())
    load = about["load"][0]
    loaded = f" The machine had a load of {load:.0f}: read ratios." if load > IDLE * about["cores"] else ""
    header = (
        "scene",
        "contender",
        "tolerance",
        "error",
        "grid, ms",
        "adapt",
        "ray casting",
        "total",
        "speed-up (in total)",
    )
    return f"""## Beside Hochstetter et al. 2016
Its table 2, theirs / ours: particles of the same kinds of scenes, not the same data ({told}; `letters` are after HPG 2016);
a GTX Titan and means over all frames of sequences, here one frame each on {about["device"]}, {cores(about)}:
{found["size"]} x {found["size"]} pixels, {found["samples"]} samples a ray, {about["dtype"]}, jax {about["jax"]}, of
{about["date"]}, commit {about["commit"]}; medians of {found["repeats"]} turns.{loaded}
Compare shapes, not digits. Speed-ups are of ray casting and, in brackets, in total.

`relaxed` is their setting, back to front with all relaxed, in all rows that they have; `certified` is ours by default. Contenders
without a part of the method are no settings of the package: in `no greedy` each cell keeps the tolerance as if it were alone
on its ray, in `no surface` partly empty cells count as covered, and both break the tolerance by design; `only z` has no
super-pixels; in `object space` an octree finds particles, and its building counts as grid. The last column is the share of
cells that were sampled more coarsely: where it is 0 nothing was chosen, and the error is 0 for that. Rows of theirs alone were
not measured.

{table((*header, "coarser"), rows)}
"""


def milliseconds(seconds: float | None) -> str:
    return "-" if seconds is None else f"{1e3 * seconds:.0f}"


def over_frames(found: dict) -> str:
    """Table 3 of Hochstetter et al. 2016: frames that are over the tolerance."""
    rows = []
    for row in found["records"]:
        chosen = [one for one, coarser in zip(row["speed_total"], row["coarser"], strict=True) if coarser > 0]
        faster = f"{min(chosen):.2f} to {max(chosen):.2f}" if chosen else "-"
        over = f"{row['frames_over']} of {row['frames']}", f"{row['most_over']:.2g}", row["nothing_chosen"]
        rows.append([row["scene"], f"{row['tolerance']:g}", number(max(row["error"])), *over, faster])
    about = found["run"]
    return f"""### Over {found["records"][0]["frames"]} frames
{found["size"]} x {found["size"]} pixels, relaxed, {about["device"]}, {cores(about)}, of {about["date"]}, commit
{about["commit"]}. Frames in which nothing was chosen have no error, and no part in speed-ups in total.
Theirs (table 3): up to 0.000125 of rays over the tolerance, in 1 frame of 1200 and of 1500.

{table(("scene", "tolerance", "largest error", "frames over", "most rays over", "nothing chosen", "speed-up"), rows)}
"""


def saved_by(record: dict) -> float | None:
    """How many times fewer evaluations than at full rate."""
    return record["evaluations_full"] / record["evaluations"] if record["evaluations"] else None


def fastest(records: list[dict]) -> str:
    """At each tolerance, the fastest setting with error control, and the time of the fastest uniform sampling over its."""
    told = []
    for limit in sorted({record["tolerance"] for record in records} - {None}):
        within = [record for record in records if record["max_error"] <= limit]
        uniform = min((r for r in within if r["tolerance"] is None), key=share)
        control = min((r for r in within if r["tolerance"] == limit), key=share)
        told.append(f"{control['method']} {share(uniform) / share(control):.2f}")
    return ", ".join(told)


def large(found: dict) -> str:
    """The paper's setting: its size of pictures, and more particles."""
    shown = [record for record in found["records"] if record["method"] not in ("full rate", "interval relaxed")]
    rows, methods = [], grouped(shown, "method")
    for (method,), records in methods.items():
        errors = alike(r["max_error"] for r in records), alike(r["max_error_converged"] for r in records)
        gained = alike(map(saved_by, records), ".2f"), alike((1 / share(r) for r in records), ".2f")
        rows.append([method, *errors, *gained])
    first = found["records"][0]
    return f"""### {first["scene"]} of {first["particles"]:,} particles at {found["size"]} x {found["size"]}
Full rate takes {first["total"]:.2f} s, and differs from 8 times the samples by {number(first["max_error_converged"])};
segments keep to the light integral, which those come near to.

{table(("method", "to full rate", "to 8 times the samples", "evaluations saved", "speed-up"), rows)}
"""


def sequences(found: dict) -> str:
    """Error control over the frames of each scene."""
    controlled = [record for record in found["records"] if record["tolerance"] is not None]
    rows = []
    for (method,), records in grouped(controlled, "method").items():
        by_tolerance = grouped(records, "tolerance").values()
        which = "integral_max" if method == "segments" else "max_error"
        errors = several(max(record[which] for record in of) for of in by_tolerance)
        over = sum(record["over_tolerance"] > 0 for record in records)
        most = max(record["over_tolerance"] for record in records)
        nothing = sum(record["evaluations"] == record["evaluations_full"] for record in records)
        rows.append([method, errors, f"{over} of {len(records)}", f"{100 * most:.2g} %", nothing])
    scenes = ", ".join(dict.fromkeys(record["scene"] for record in controlled))
    limits = several(sorted({record["tolerance"] for record in controlled}), "g")
    return f"""## Over sequences
Frames {several(sorted({record["frame"] for record in found["records"]}), "g")} of {scenes}; {found["size"]} x {found["size"]}
pixels. Largest errors at tolerances {limits}, of segments to the light integral, else to full rate; how many frames are
over theirs, the most rays of any, and in how many nothing was chosen, so that there is no error. Hochstetter et al. 2016
have up to 0.0125 % of rays over it, in 1 frame of 1200 (its table 3, relaxed).

{table(("method", "largest error", "frames over", "rays over", "nothing chosen"), rows)}
"""


def scaling(found: dict) -> str:
    parts = []
    for kind, records in found["tables"].items():
        names = list(records[0]["seconds"])
        rows = [[f"{record[kind]:,}", *(f"{record['seconds'][name]['total']:.3f}" for name in names)] for record in records]
        rows.append(["exponent", *(f"{found['exponents'][kind][name]:.2f}" for name in names)])
        parts.append(table([kind, *names], rows))
    middle = "\n\n".join(parts)
    return f"""## More particles, more pixels
Seconds of {found["scene"]}, compile time apart; the exponent is the slope of log time over log number.

{middle}
"""


def pilots(found: dict) -> str:
    rows, small = [], [record for record in found["records"] if record["size"] == SMALL]
    for key, records in grouped((record for record in found["records"] if record["size"] > SMALL), "scene", "size").items():
        saved = alike((record["evaluations_saved"] for record in records), ".2f")
        speed = alike((1 / record["total_to_full"] for record in records), ".2f")
        middle = next(record for record in records if record["tolerance"] == TOLERANCES[1])
        ratios = several(middle["estimate_to_error"] or (), ".3g") or "-"
        rows.append([*key, saved, speed, alike(record["max_error"] for record in records), ratios])
    foreseen = [record for record in found["records"] if record.get("oracle") is not None]
    oracle = ", ".join(f"{record['scene']} {record['oracle']:.2f}" for record in foreseen)
    over = [record for record in found["records"] if record["pixels_over_tolerance"]]
    told = ", ".join(f"{100 * r['pixels_over_tolerance']:.2g} % of {r['scene']} at {r['size']}, {r['tolerance']}" for r in over)
    return f"""## The pilot estimator
Each cell is of tolerances {several(TOLERANCES, "g")}; estimate over error is that of a pixel at 0.004, at 1, 50 and 99 % of the
pixels that differ at all. Pixels over the tolerance: {told or "none"}. Where the error of every choice were known, this could be
saved at {foreseen[0]["size"]} and {foreseen[0]["tolerance"]}: {oracle}.
At {SMALL} it saves {between(small, "evaluations_saved")} times, and full rate
takes {between(small, "total_to_full", inverse=True)} times as long.

![Evaluations saved, speed-up, and estimate over error](../benchmarks/results/pilot.png)

{table(("scene", "size", "evaluations saved", "speed-up", "largest error", "estimate / error"), rows)}
"""


def between(records: list[dict], name: str, *, inverse: bool = False) -> str:
    """Least and most of what records have under a name, or of one over it."""
    values = sorted(1 / record[name] if inverse else record[name] for record in records)
    return f"{values[0]:.2f} to {values[-1]:.2f}"


def peers(found: dict) -> str:
    rows = [[name, *(number(ratio) for ratio in ratios.values())] for name, ratios in found["ratios"].items()]
    return f"""## Beside a hand-written marcher
Time of a frame over that of a Numba packet marcher on the same particles, 512 x 512 x 256 samples.

{table(("particles", *next(iter(found["ratios"].values()))), rows)}
"""


def surfaces(found: dict) -> str:
    """Depths and CPU time beside a mesh and its rays."""
    rows = []
    for (file,), records in grouped(found["records"], "file").items():
        meshes = records[1:]
        seconds = several((sum(record["cpu_seconds"].values()) for record in records), ".2f")
        apart = several(mesh["median"] for mesh in meshes), several(mesh["percent_90"] for mesh in meshes)
        alone = ", ".join(f"{mesh['ours_alone']}/{mesh['theirs_alone']}" for mesh in meshes)
        rows.append([file, *apart, f"{alone} of {meshes[-1]['both']:,}", seconds])
    size = found["records"][0]["size"]
    sides = ", ".join(record["contender"].split()[-1] for record in found["records"][1:4])
    return f"""## Surfaces of liquids beside a mesh
`jaxsph.Surface`, and `pysplashsurf` {found["run"]["pysplashsurf"]} of the same field and level: marching cubes of {sides}
particle radii, then Embree through the same {size} x {size} pixels. How far depths are apart, in supports, for each size of
cubes; pixels that we or the mesh alone meet, of those that both do with the smallest; CPU seconds of ours and of each mesh. What
is left falls with the square of the cubes, so it is the mesh's. A mesh serves many views.

{table(("file", "median", "90 %", "ours/mesh alone", "CPU seconds"), rows)}

![Ours, the mesh of half radii, and decades of their difference](../benchmarks/results/surfaces.png)
"""


def grids(found: dict) -> str:
    rows = [
        [record["scene"], record["contender"].replace(", ", ": "), number(record["max_error"]), number(record["mean_error"]),
         f"{record['total']:.3f}"]
        for record in found["records"] if not record["contender"].startswith("jaxsph, pilot")
    ]  # fmt: skip
    size = found["records"][0]["size"]
    return f"""## Beside resampling to a grid
VTK {found["run"]["vtk"]}: `vtkSPHInterpolator` to a grid, and ray casting of that. {size} x {size} pixels, cubic spline.
Errors of colours to 8 times the samples (VTK's images have 8 bits: 0.002 at least). yt has no opacity, so none of it is here.

{table(("scene", "contender", "largest error", "mean", "seconds"), rows)}
"""


def gradients(found: dict) -> str:
    told = [
        f"{row['scene']} at {row['size']} x {row['size']} {row['backward_to_frame']:.2f} and {row['memory_to_frame']:.2f}"
        for row in found["frames"]
    ]
    scans = []
    for record in found["against_scan"]:
        used = [record["programs"][program]["bytes"] / 2**20 for program in ("marched", "scanned")]
        scans.append([record["samples"], *(f"{size:.1f}" for size in used)])
    return f"""## Gradients
By everything at once; what the backward pass takes beyond the frame, over the frame, in time and in memory: {"; ".join(told)}.
Memory in MiB beside automatic differentiation of a scan over samples, of 150 particles:

{table(("samples", "jaxsph", "scan"), scans)}
"""


def convergence(found: dict) -> str:
    """Rays for an error: the graphs of Kratz et al. 2011, and the iterations of their section 7.4."""
    rows = []
    for record in found["fields"]:
        reached = [record["rays"][kind] for kind in ("uniform", "corner_variance", "hierarchical")]
        least = "" if reached[0] else "> "
        most = reached[0] or record["curves"]["uniform"][-1]["rays"]
        rays = [least + number(most, ",.0f"), *(number(some, ",.0f") for some in reached[1:])]
        fewer = least + number(most / reached[2], ".1f")
        curved = record["parabolas"]
        gain = number(100 * (1 - curved["best"] / curved["error"]), ".1f") if curved else "-"
        about = record["leaves"]
        told = [
            number(about["spearman"], ".2f"),
            several((about["index"][k] for k in (0, 2, 4)), ".2f"),
            number(about["whole"], ".2f"),
        ]
        rows.append([record["field"], *rays, fewer, gain, *told])
    size, goal = found["fields"][0]["size"], found["goal"]
    header = "field", "uniform", "variance", "hierarchical", "fewer", "biquadratic, %", "rank correlation", "1, 50, 99 %", "image"
    return f"""## Fewer rays: the quadtree
Rays for a relative L2 error of {100 * goal:g} % of colours (Kratz et al. 2011, section 7): of uniform grids, of leaves split by
the variance of their corners (Levoy 1990), and by the hierarchical estimator, which takes so many times fewer; how many per cent
of its rays biquadratic leaves could save. Then how its estimate follows the true error there: rank correlation, and estimate
over error at 1, 50 and 99 % of the leaves that matter (0.1 % of the largest error or more) and of the whole image. Refinement is
simulated on an image of {size} x {size} pixels and {found["samples"]} samples, where no pixel is known to be empty.

{table(header, rows)}

![Error against rays](../benchmarks/results/convergence/rays.png)
![Estimated against true error of leaves](../benchmarks/results/convergence/leaves.png)

{iterations(found)}
"""


def iterations(found: dict) -> str:
    """Section 7.4 of Kratz et al. 2011."""
    timed = found["timed"]
    stages, spent = timed["stages"], timed["stages"][-1]["spent"]
    total, later = sum(stage["seconds"] for stage in stages), sorted(stage["seconds"] for stage in stages[1:])
    adapt = 100 * spent["adapt"] / sum(spent.values())
    return f"""From 256 x 256 rays of the mixing layer, {found["worst"]} leaves an iteration, to an error of {found["goal"]:g}:
the paper (section 7.4) takes 7 iterations, here {len(found["iterations"]) - 1} on paper; rendered at
{timed["size"]} x {timed["size"]} with {found["samples"] // 4} samples {len(stages) - 1} ({len(timed["on_paper"]) - 1} on paper).
The first lattice takes {stages[0]["seconds"]:.2f} s, each later stage {later[len(later) // 2]:.2f} s, all {total:.2f} s,
{adapt:.0f} % of it estimator and marking; an image whose every pixel has a ray {timed["every_pixel"]:.2f} s.

![Iterations of a real image](../benchmarks/results/convergence/iterations.png)"""


def points(found: dict) -> str:
    """Points cast and splatted among gas: Kaehler, Abel & Hege 2007, section 4."""
    rows = []
    for scene in found["scenes"]:
        of = {row["what"]: row for row in scene["rows"]}
        sprites, hybrid, full = scene["theirs"]
        for what, theirs in (("region 0", sprites), ("region 0.5", hybrid), ("feet", full), ("region 1", full)):
            if what not in of:  # not measured yet
                continue
            row = of[what]
            error = [number(row["error"][kind]) for kind in ("max", "p999", "rms")]
            over = row["seconds"] / of["region 0"]["seconds"], sprites / theirs
            rows.append([scene["scene"], what, number(row["seconds"], ".2f"), *error, *(number(one, ".2f") for one in over)])
    gas = ", ".join(f"{scene['scene']} {scene['rows'][0]['seconds']:.2f}" for scene in found["scenes"])
    feet = " Feet have points whole in one sample each, as theirs." if any(row[1] == "feet" for row in rows) else ""
    return f"""## Points among gas: splats, regions of interest, chords
The data sets of Kaehler, Abel & Hege 2007, section 4, in kind: 150,000 galaxies and 120,000 stars, each in gas of 256^3, at
830 x 520. In a region, a share of the depth from the eye on, points are cast along their chords, beyond it they are splats.
Errors are to region 1, all chords; times over that of region 0, all splats, beside theirs on a graphics card of 2006. Gas
alone takes {gas} s.{feet}

{table(("scene", "what", "seconds", "largest error", "0.1 % over", "rms", "time", "theirs"), rows)}

![Error against time](../benchmarks/results/points_and_grids.png)
"""


def accelerators(found: dict) -> str:
    """An accelerator beside the CPUs of its machine: seconds, and how far its pictures are off."""
    fast, slow = found["contenders"]
    rows, right = [], []
    for name, case in sorted(found["cases"].items(), key=lambda named: list(KINDS).index(named[0].split(":")[0])):
        kind, what, *rest = name.split(":")
        sides = case[fast], case[slow]
        if kind != "correct":
            seconds = [several((side[when] for side in sides), ".3g") for when in ("steady", "first")]
            told = KINDS[kind] + "".join(f", {how}" for how in rest[1:]), what.replace("k", ",000").replace("m", ",000,000")
            rows.append([*told, rest[0], *seconds, f"{case['speed']:.0f}"])
        elif what != "arithmetic":
            off = *(number(side.get("largest")) for side in sides), number(case["between"]["largest"])
            right.append([what, *off, *(number(sides[0].get(of)) for of in ("error", "bound"))])
    about, arithmetic = found["run"], found["cases"]["correct:arithmetic"]
    ulps = ", ".join(f"{name} {arithmetic[fast][name]:.1f}" for name in ("over", "sqrt", "exp", "log"))
    return f"""## A GPU beside the CPUs of its machine
One card, {about["device"]}, and {cores(about)} of the same machine, in turns in one process: float32, jax {about["jax"]},
{found["samples"]} samples a ray, tolerance {found["tolerance"]}. Seconds of the card, then of the cores, which are not the two of
the other sections. First frames have all that is compiled for them, and on accelerators no program is kept whole.
A gradient is one program, of which CPU cores share little.

{table(("what", "particles", "pixels", "steady", "first", "steady, times as fast"), rows)}

How far small pictures are off: the largest difference to float64 of the card, of the cores, and between both; then what a
tolerance changed on the card, and the `error_bound` of that, which segments estimate. Errors of the card's arithmetic in eps:
{ulps}; it fuses no product into a sum here.

{table(("what", "card", "cores", "between", "error", "bound"), right)}
"""


def truths(found: dict) -> str:
    """Points and segments against the light integral, scene by scene."""

    def errors(scene: dict, integrator: str, samples: int) -> str:
        row = next(r for r in scene["rows"] if (r["integrator"], r["samples"], r["tolerance"]) == (integrator, samples, None))
        return several((row["mean"], row["p999"]), ".1e")

    kinds = ("samples", 256), ("samples", 1024), ("segments", 256), ("segments", 512)
    plain = [[short(scene["scene"]), *(errors(scene, *kind) for kind in kinds)] for scene in found["scenes"]]
    beside = [beside_points(scene) for scene in found["scenes"]]
    least, most = ([round(end(one[k] for one in beside if one[k] is not None), 2) for k in range(3)] for end in (min, max))
    kept: dict[str, list[Any]] = {"segments": [], "pilot": []}
    thrice = 0.0
    for scene in found["scenes"]:
        for (integrator,), rows in grouped((row for row in scene["rows"] if row["tolerance"] is not None), "integrator").items():
            thrice = max(thrice, *(row["over_3"] for row in rows))
            told = alike((row["p999"] for row in rows), ".1e"), alike((row["over_1"] for row in rows), ".2%")
            middle = alike((row["estimate_over_error"][1] for row in rows), ".2g")
            times = alike((row["seconds"] for row in rows), ".2f"), alike((row.get("points_time") for row in rows), ".2f")
            kept[integrator].append([short(scene["scene"]), *told, middle, *times])
    header = "scene", "99.9 %", "over", "told / true", "s", "points, s"
    return f"""## Against the light integral
{found["size"]} x {found["size"]} pixels, errors at up to {max(scene["pixels"] for scene in found["scenes"])} random ones that any
particle touches, against `jaxsph.reference.integral`: mean, and what 99.9 % stay below.

{table(("scene", *(f"{'points' if kind == 'samples' else kind}, {count}" for kind, count in kinds)), plain)}

Segments of 256 samples have {least[0]:.2f} to {most[0]:.2f} of the mean error of as many points, in {least[1]:.2f} to
{most[1]:.2f} times the time; points of the same 99.9 % error take {least[2]:.2f} to {most[2]:.2f} times as long as they.

With tolerances of 0.03, 0.01, 0.004 by segments: the 99.9 % error, the share of pixels over the tolerance (over three times it,
with either method, at most {thrice:.2%}), the median of the estimate over the error, seconds, and those of uniform points of the
same 99.9 % error ("-" where 2,048 are not enough).

{table(header, kept["segments"])}

The same by the pilot and 1,024 points, whose tolerance is against full rate:

{table(header, kept["pilot"])}
"""


def beside_points(scene: dict) -> tuple[float, float, float | None]:
    """Mean error and time of segments over those of as many points, and the time of points of the same error over theirs."""
    points, segments = (
        next(r for r in scene["rows"] if (r["integrator"], r["samples"], r["tolerance"]) == (kind, 256, None))
        for kind in ("samples", "segments")
    )
    alike = segments["points_time"] and segments["points_time"] / segments["seconds"]
    return segments["mean"] / points["mean"], segments["seconds"] / points["seconds"], alike


def calibrations(found: dict) -> str:
    """What the pilot's constants promise on frames that they were not measured on."""
    frames, constant = found["groups"]["validation"], found["constants"]["DEVIATIONS"]["present"]
    decided = [one for frame in frames for one in frame["decided"] if one["deviations"] == constant]
    over, pixels = (sum(one[name] for one in decided) for name in ("over", "pixels"))
    limits = several(sorted({one["tolerance"] for one in decided}), "g")
    return f"""### Frames that no constant was measured on
Of {len(frames)} frames, {found["size"]} x {found["size"]} pixels, at tolerances {limits}: {over} of {pixels / 1e6:.1f} million
pixels are over the tolerance, the largest {max(one["worst"] for one in decided):.2f} times.
"""


def waits(found: dict) -> str:
    """How long the first picture of a file takes, in new processes one after the other."""
    first, *others = (one["seconds"] for one in found["waits"]["command"])
    again = found["waits"]["again"]
    loading, whole = (statistics.median(one[name] for one in again) for name in ("compiling", "seconds"))
    return f"""## First pictures of files
`jaxsph render` of {len(found["waits"]["command"])} files, {found["size"]} x {found["size"]} pixels, one after the other from an
empty folder of programs, each in a new process: {first:.1f} s for the first, {statistics.median(others):.1f} s for the others in
the median, {max(others):.1f} s at most. Once all is compiled, {whole:.1f} s in the median, {loading:.1f} s of it for programs.
"""


def short(scene: str) -> str:
    """A scene's name, without what a file's ends with."""
    return scene.split(".")[0]


SECTIONS: dict[str, Callable[[dict], str]] = {
    "truth": truths, "trade": trade, "trade_200k": large, "trade_1m": large, "table2": beside_paper, "table3": over_frames,
    "accelerator": accelerators, "first_pictures": waits,
    "sequences": sequences, "pilot": pilots, "calibration": calibrations, "convergence": convergence, "scaling": scaling,
    "peers": peers, "surfaces": surfaces, "vtk_grid": grids, "gradients": gradients,
    "points_and_grids": points,
}  # fmt: skip


def page() -> str:
    """The page, from the results that there are."""
    files = {name: RESULTS / f"{name}.json" for name in SECTIONS}
    sections = [SECTIONS[name](json.loads(file.read_text())) for name, file in files.items() if file.exists()]
    head = """# How accurate, how fast
Made by `python benchmarks/report.py` from `benchmarks/results/`, which has all rows. Times are of one or two cores of shared
machines: read ratios. What is promised, and over which range of inputs, is in [accuracy and limits](accuracy_and_limits.md).
"""
    return "\n".join([head, *sections])


if __name__ == "__main__":
    PAGE.write_text(page())
