"""Claim: of a frame with `screen="quadtree"`, at most 0.1 % of pixels are over the tolerance.

What it depends on is `screen.estimators.CAUTION`: of the largest difference that a leaf or its neighbours have seen, how much the
leaf may yet be wrong by. Leaves are split where CAUTION times that is over the tolerance, so a frame at tolerance t shows what a
factor c would have done at t c / CAUTION: the least factor that keeps the promise is CAUTION times the 0.999-quantile of errors,
over t. It is chosen from the calibration frames of `calibration_scenes`, and tested on the validation frames; none of them is a
scene of any other benchmark. Writes `results/calibration_screen.json`.

    python benchmarks/calibrate_screen.py [--size 512] [--kinds waves ...]
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import sys
from typing import Any

import jax
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from calibration_scenes import GROUPS, Kind
from kept import keep

import jaxsph as js
from jaxsph.engine.screen.canvas import CAUTION

TOLERANCES = 0.004, 0.01, 0.03, 0.06
MOST_OVER = 1e-3  # share of pixels
RESULTS = pathlib.Path(__file__).with_name("results") / "calibration_screen.json"
Record = dict[str, Any]


def light(image: js.Image) -> np.ndarray:
    """Colour and transmittance."""
    return np.concatenate([np.asarray(image.color), np.asarray(image.transmittance)[..., None]], -1)


def measure(kind: Kind, size: int) -> list[Record]:
    """A record for each frame of a kind and tolerance."""
    records = []
    for look, scene, camera in kind.frames(size):
        reference = light(js.render(scene, camera, js.Settings()))
        for tolerance in TOLERANCES:
            image = js.render(scene, camera, js.Settings(tolerance=tolerance, screen="quadtree"))
            error = np.abs(light(image) - reference).max(-1)
            least = CAUTION * float(np.quantile(error, 1 - MOST_OVER)) / tolerance
            over = {"over": float((error > tolerance).mean()), "largest": float(error.max() / tolerance), "least": least}
            said = float((np.asarray(image.error_bound) > tolerance).mean())
            filled = int((reference[..., 3] < 1).sum())
            saved = {"rays": image.stats["rays"], "filled": filled, "said_over": said}
            records.append({"kind": kind.name, **dataclasses.asdict(look), "tolerance": tolerance, **over, **saved})
    return records


def table(found: dict[str, list[Record]]) -> str:
    """For each group and tolerance."""
    lines = []
    for group, records in found.items():
        for tolerance in TOLERANCES:
            some = [record for record in records if record["tolerance"] == tolerance]
            least, over = ([record[name] for record in some] for name in ("least", "over"))
            fewer = np.exp(np.mean([np.log(record["filled"] / record["rays"]) for record in some]))
            lines.append(
                f"{group:12s} {tolerance:6.3f}: over {100 * max(over):.3f} % at most, {100 * np.median(over):.3f} % median; "
                f"least factor {max(least):.2f} at most, {np.median(least):.2f} median; {fewer:.2f} times fewer rays"
            )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=512, help="pixels on a side")
    parser.add_argument("--kinds", nargs="+", choices=[kind.name for kinds in GROUPS.values() for kind in kinds])
    arguments = parser.parse_args()
    found: dict[str, list[Record]] = {}
    for group, kinds in GROUPS.items():
        for kind in (kind for kind in kinds if not arguments.kinds or kind.name in arguments.kinds):
            found.setdefault(group, []).extend(measure(kind, arguments.size))
            print(f"{group} {kind.name}", flush=True)
            jax.clear_caches()  # compiled programs hold memory maps, of which a process may have only so many
    print(table(found))
    if not arguments.kinds:
        keep(RESULTS, map(str, TOLERANCES), size=arguments.size, caution=CAUTION, frames=found)
    worst = [record for record in found.get("validation", []) if record["over"] > MOST_OVER]
    assert not worst, "\n".join(["over the promise:", *map(str, worst)])


if __name__ == "__main__":
    main()
