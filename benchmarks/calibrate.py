"""Claim: on scenes that no other benchmark reports, too, the pilot estimator keeps its promise.

That is: of all frames together at most one pixel in 100,000 is over the tolerance, and none over twice. (A single frame of this
size has fewer pixels than that; those with any over are listed.) The estimator's error constants are measured on scenes of one
group, `calibration`, and the promise on those of another, `validation`, which differ in kind (`calibration_scenes`). What a
constant is asked to be:

- `DEVIATIONS`: the least of some that, like all above it, keeps the promise. A tolerance t with D deviations decides as
  `DEVIATIONS` t / D does with the present ones, so all of them are rendered as they are.
  `off by` are the estimated deviations that all pixels of a frame but one in 100,000 are within, in the worst frame.
- `SUBSAMPLED_SHARE`: mean square error of the quantity between the rays of `SUBSAMPLE` over the variance across that fourth
  differences tell; as each slab weighs in the image, in the worst frame.
- `DEVIATION_PER_BEND`: root mean square of what wider spacing changes over what `second_differences` ascribes to it, in the
  worst frame.
- `RESOLVED`, which keeps what lies between nodes from being missed: the least reach of supports, in node spacings, from which
  on no slab's mean square error is over `DEVIATIONS` squared times its estimate.
- `MIN_CLEARANCE`, which keeps the sum of weights from being interpolated to or across zero: the largest margin, in estimated
  errors, at which a slab had samples on the wrong side. More than asked for is safe.
- `DEVIATIONS_AROUND`: deviations by which quantities between nodes lie beyond those at the nodes; in 99 of 100 slabs, of the
  worst frame.

Costs, not errors, are what `MIN_RESOLVED_SHARE` of `pilot` and `MIN_PROMISING_SHARE` of `probe` are about: not measured
here. Writes `results/calibration.json`; ends in asserts on the validation scenes.

    python benchmarks/calibrate.py [--size 256] [--kinds waves foam] [--quick]
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import sys
from collections.abc import Callable, Iterable

import jax
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import calibration_frames as frames
import peers
import tolerance
from calibration_scenes import GROUPS, Look
from kept import keep

import jaxsph as js
from jaxsph.engine.control.interpolation_error import DEVIATIONS_AROUND, MIN_CLEARANCE, SUBSAMPLED_SHARE
from jaxsph.engine.control.pilot import DEVIATION_PER_BEND, DEVIATIONS, RESOLVED
from jaxsph.engine.planning.plan import Plan

TOLERANCES = 0.002, 0.004, 0.01, 0.03
CHOICES = 4.0, 6.0, 8.0  # of `DEVIATIONS`
TAKEN_APART_AT = 0.01
MOST_OVER = 1e-5  # share of pixels
SLABS = 2048  # of a frame, whose sums are compared
ROUNDING = 1e-6  # between full rate and itself, where plans differ
FEWEST = 50  # slabs or bundles that statistics are made of
NEGLIGIBLE = 0.01  # of a deviation's budget: bundles whose wider samples are said to change less are left out
QUICK, QUICK_SIZE = ("waves", "foam"), 192
RESULTS = peers.RESULTS.with_name("calibration.json")
Record = dict
View = tuple[Look, js.Scene, js.Camera]


def planned(views: Iterable[View]) -> Plan:
    """One plan for all of them, such that they share compiled programs."""
    settings, plan = js.Settings(tolerance=TAKEN_APART_AT, estimator="pilot"), None
    for _, scene, camera in views:
        plan = js.plan(scene, camera, settings, like=plan)
    return plan


def measure(kind: str, views: Iterable[View], plan: Plan, choices: Iterable[float]) -> list[Record]:
    """One record for each view."""
    records = []
    for look, scene, camera in views:
        record = {"kind": kind, **dataclasses.asdict(look), "particles": scene.particles.num_particles}
        record["decided"] = decided(scene, camera, plan, choices)
        records.append(record | taken_apart(frames.frame_of(scene, camera, plan)))
    return records


def decided(scene: js.Scene, camera: js.Camera, plan: Plan, choices: Iterable[float]) -> list[Record]:
    """Errors at all tolerances, with every choice of `DEVIATIONS`."""
    full = js.render(scene, camera, js.Settings())
    true, found = tolerance.layers(full), []
    for limit in TOLERANCES:
        for deviations in choices:
            settings = js.Settings(tolerance=limit * DEVIATIONS / deviations, estimator="pilot")
            image = js.render(scene, camera, settings, plan=plan)
            error = np.abs(tolerance.layers(image) - true).max(-1)
            record = {"tolerance": limit, "deviations": deviations, "over": int((~(error <= limit)).sum()), "pixels": error.size}
            record |= {"worst": float(error.max() / limit), "off": float(quantile(error, image))}
            found.append(record | {"saved": full.stats["evaluations"] / image.stats["evaluations"]})
    return found


def quantile(error: np.ndarray, image: js.Image) -> float:
    """Estimated deviations that all pixels but `MOST_OVER` of them, and one, are within."""
    deviation = np.asarray(image.error_bound, float) / DEVIATIONS
    ratio = np.where(error > ROUNDING, error / np.maximum(deviation, ROUNDING), 0)
    return np.quantile(ratio, 1 - MOST_OVER, method="lower")


def taken_apart(frame: frames.Frame) -> Record:
    """What wider spacing changes, and what interpolation of sums does, over what is said of them."""
    schedule = frame.decide(TAKEN_APART_AT)
    light = {name: frame.light(frames.variants(frame, schedule)[name]) for name in ("fine", "all")}
    change = np.sqrt(((light["all"] - light["fine"]) ** 2).max(0).mean(1))
    said = frames.bend_effect(frame, schedule)
    some = said > NEGLIGIBLE * TAKEN_APART_AT / DEVIATIONS
    at = frames.slabs_to_compare(frame, SLABS)
    return {"wider": wider(change[some], said[some])} | of_sums(frames.compare_sums(frame, *at), frames.estimate_sums(frame, *at))


def wider(change: np.ndarray, said: np.ndarray) -> Record | None:
    """Of bundles: root mean square change over what is said, and quantiles."""
    if len(said) < FEWEST:
        return None
    return {"asked": float(np.sqrt((change**2).mean() / (said**2).mean())), "quantiles": quantiles(change / said)}


def of_sums(true: dict[str, np.ndarray], said: dict[str, np.ndarray]) -> Record:
    """What is asked of the constants that sums over particles tell about."""
    estimate = said["lateral"] + said["deep"]
    usable = np.isfinite(said["variance"]) & (estimate > 1e-12)
    off = np.sqrt(np.divide(true["lattice"], estimate, out=np.zeros_like(estimate), where=usable))
    by_reach = {reach: off[usable & (said["reach"] == reach)] for reach in (0.0, *frames.REACHES)}
    clear = said["margin"][true["wrong"] & (said["reach"] >= RESOLVED)]
    found = {"clear": float(clear.max(initial=0)), "reach": {k: quantiles(v) for k, v in by_reach.items() if len(v) >= FEWEST}}
    usable &= said["reach"] >= RESOLVED
    affordable = usable & (said["lateral"] > 0) & (SUBSAMPLED_SHARE * said["variance"] <= (max(TOLERANCES) / DEVIATIONS) ** 2)
    return found | {"left": left(true, said, affordable), "around": beyond(true, said, usable)}


def left(true: dict[str, np.ndarray], said: dict[str, np.ndarray], some: np.ndarray) -> Record | None:
    """Of the variance across, what there is between few rays."""
    if some.sum() < FEWEST:
        return None
    subsampled, lateral, weight = true["subsampled"][some], said["lateral"][some], (said["variance"] / said["total"])[some]
    return {"asked": float((weight * subsampled).sum() / (weight * lateral).sum()), "quantiles": quantiles(subsampled / lateral)}


def beyond(true: dict[str, np.ndarray], said: dict[str, np.ndarray], some: np.ndarray) -> Record | None:
    """Deviations by which quantities go beyond those at the nodes."""
    if some.sum() < FEWEST:
        return None
    outside = np.maximum(said["low"] - true["low"], true["high"] - said["high"])[some]
    found = quantiles(outside / np.sqrt((said["total"] / said["alike"])[some]))
    return {"asked": found[2], "quantiles": found}


def quantiles(values: np.ndarray) -> list[float]:
    return [float(value) for value in np.quantile(values, [0.5, 0.9, 0.99, 1])]


def keeps_its_word(records: list[Record]) -> bool:
    over, pixels = (sum(record[key] for record in records) for key in ("over", "pixels"))
    return over <= MOST_OVER * pixels and all(record["worst"] <= 2 for record in records)


def all_decided(records: list[Record], deviations: float) -> list[Record]:
    return [
        {"kind": r["kind"], "transfer": r["transfer"], **d}
        for r in records
        for d in r["decided"]
        if d["deviations"] == deviations
    ]


def asked_deviations(records: list[Record]) -> float | None:
    """The least choice that, like all above it, keeps the promise; None where none does."""
    kept = None
    for choice in sorted({d["deviations"] for r in records for d in r["decided"]}, reverse=True):
        if not keeps_its_word(all_decided(records, choice)):
            break
        kept = choice
    return kept


def asked_reach(records: list[Record]) -> float | None:
    """The least reach from which on no slab is off by more than `DEVIATIONS` times its estimate."""
    bad = [reach for r in records for reach, found in r["reach"].items() if found[-1] > DEVIATIONS]
    above = [reach for reach in frames.REACHES if reach > max(bad, default=-1)]
    return min(above, default=None)


def worst(name: str) -> Callable[[list[Record]], float | None]:
    return lambda records: max((r[name]["asked"] for r in records if r[name]), default=None)


ASKED: dict[str, tuple[float, Callable[[list[Record]], float | None]]] = {
    "DEVIATIONS": (DEVIATIONS, asked_deviations),
    "SUBSAMPLED_SHARE": (SUBSAMPLED_SHARE, worst("left")),
    "DEVIATION_PER_BEND": (DEVIATION_PER_BEND, worst("wider")),
    "RESOLVED": (RESOLVED, asked_reach),
    "MIN_CLEARANCE": (MIN_CLEARANCE, lambda records: max(r["clear"] for r in records)),
    "DEVIATIONS_AROUND": (DEVIATIONS_AROUND, worst("around")),
}


HEADER = "\ngroup        deviations  pixels over         of  error/tolerance  off by  saved frames that break it"


def table(found: dict[str, list[Record]]) -> str:
    """What is asked of each constant, by group; and how the present ones do."""
    lines = [f"{'constant':12s} {'present':>8s} " + " ".join(f"{group:>12s}" for group in found)]
    for name, (present, asked) in ASKED.items():
        cells = ("-" if value is None else format(value, ".3g") for value in map(asked, found.values()))
        lines.append(f"{name:12s} {present:8g} " + " ".join(f"{cell:>12s}" for cell in cells))
    lines.append(HEADER)
    lines += [of_choice(group, records, choice) for group, records in found.items() for choice in choices_of(records)]
    return "\n".join(lines)


def choices_of(records: list[Record]) -> list[float]:
    return sorted({d["deviations"] for r in records for d in r["decided"]})


def of_choice(group: str, records: list[Record], choice: float) -> str:
    """How one choice of `DEVIATIONS` does; what it saves is the geometric mean."""
    here = all_decided(records, choice)
    broken = sorted({f"{d['kind']} {d['transfer']}" for d in here if d["over"]})
    saved = float(np.exp(np.mean([np.log(d["saved"]) for d in here])))
    over, pixels = (sum(d[key] for d in here) for key in ("over", "pixels"))
    most, off = (max(d[key] for d in here) for key in ("worst", "off"))
    return f"{group:12s} {choice:10g} {over:12d} {pixels:10d} {most:16.2f} {off:7.3g} {saved:6.3f} {', '.join(broken)}"


def write(found: dict[str, list[Record]], size: int) -> None:
    """Whole or not at all."""
    asked = {name: {"present": now, **{g: ask(r) for g, r in found.items()}} for name, (now, ask) in ASKED.items()}
    sizes = {"size": size, "samples": js.Settings().samples}
    keep(RESULTS, [f"deviations {choice:g}" for choice in CHOICES], **sizes, constants=asked, groups=found)


def quick() -> dict[str, list[Record]]:
    """A small frame of one kind of either group, which share their programs; the present constants only."""
    views = {group: [next(kind.frames(QUICK_SIZE)) for kind in kinds if kind.name in QUICK] for group, kinds in GROUPS.items()}
    plan = planned(view for few in views.values() for view in few)
    return {group: measure(name, views[group], plan, (DEVIATIONS,)) for group, name in zip(GROUPS, QUICK, strict=True)}


def thorough(size: int, names: list[str] | None) -> dict[str, list[Record]]:
    """All frames of some or all kinds."""
    found: dict[str, list[Record]] = {group: [] for group in GROUPS}
    for group, kinds in GROUPS.items():
        for kind in (kind for kind in kinds if not names or kind.name in names):
            views = list(kind.frames(size))
            found[group] += measure(kind.name, views, planned(views), CHOICES)
            print(f"{group} {kind.name}", flush=True)
            jax.clear_caches()  # compiled programs hold memory maps, of which a process may have only so many
    return {group: records for group, records in found.items() if records}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=256, help="pixels on a side, a multiple of 32")
    parser.add_argument("--kinds", nargs="+", choices=[kind.name for kinds in GROUPS.values() for kind in kinds])
    parser.add_argument("--quick", action="store_true", help="two small frames; neither that nor some kinds write anything")
    arguments = parser.parse_args()
    found = quick() if arguments.quick else thorough(arguments.size, arguments.kinds)
    print(table(found))
    if not (arguments.quick or arguments.kinds):
        write(found, arguments.size)
    decisions = all_decided(found.get("validation", []), DEVIATIONS)
    assert keeps_its_word(decisions), "\n".join(["over the tolerance:", *(str(d) for d in decisions if d["over"])])


if __name__ == "__main__":
    main()
