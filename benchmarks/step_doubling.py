"""Claim: for the same mean error step doubling asks a mixing layer at fewer points than even steps do.

The integrator is the one of docs/extending.md (Kratz et al. 2011, section 6). Fields of `made_fields` are rendered by even steps
and by step doubling; errors are of colours, against very many even steps. Counted is at how many points a ray asks its media:
slabs that are not marched count nothing. Seconds are of one cast, after another: read ratios. Writes
`results/step_doubling.json`; ends in an assert.

    python benchmarks/step_doubling.py [--points 64] [--size 64]
"""

from __future__ import annotations

import argparse
import pathlib
import re
import sys
import types

import jax.numpy as jnp
import made_fields
import numpy as np
from kept import keep

import jaxsph as js
from jaxsph.engine.cast.integrator import Integrator, Segment
from jaxsph.model.settings import INTEGRATORS

ROOT = pathlib.Path(__file__).parent
RESULTS = ROOT / "results" / "step_doubling.json"
FIELDS = "mixing_layer", "dragon"
EVEN = 32, 64, 128, 256, 512, 1024, 2048
STEPS = (32, 1e-1), (32, 1e-2), (64, 1e-2)  # samples, which are the longest steps, and the tolerance
CONVERGED = 8192


def of_page() -> types.ModuleType:
    """The page's example as a module, such that what is measured is what is shown."""
    page = (ROOT.parent / "docs" / "extending.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n# step_doubling\.py\n(.*?)```", page, re.DOTALL)
    module = types.ModuleType("step_doubling_of_page")
    sys.modules[module.__name__] = module
    exec(compile(code, "step_doubling.py", "exec"), module.__dict__)
    return module


PAGE = of_page()


def counted(number, task) -> Segment:
    """Slabs that let everything through, and shine in red as much as they ask for points."""
    number = number.astype(task.border.dtype)
    nothing = jnp.zeros_like(number)
    return Segment((number, nothing, nothing), nothing + 1, jnp.zeros(task.shape, number.dtype))


class CountedSamples(Integrator):
    """Points of even steps."""

    def __call__(self, medium, gathered, task) -> Segment:
        """See `Integrator`."""
        real = (task.border[:, 1:] > task.border[:, :-1]).sum(1)
        return counted(jnp.broadcast_to(real[:, None], task.shape[::2]), task)


def contenders() -> list[dict]:
    """What is rendered; of each, the names of an integrator and of one that counts."""
    INTEGRATORS["counted_samples"] = f"{__name__}:CountedSamples"
    rows = [
        {"variant": "even steps", "samples": samples, "tolerance": None, "names": ("samples", "counted_samples")}
        for samples in EVEN
    ]
    for samples, tolerance in STEPS:
        names = tuple(f"{kind}_{-np.log10(tolerance):.0f}" for kind in ("steps", "counted_steps"))
        steps = type(names[0], (PAGE.StepDoubling,), {"tolerance": tolerance})

        def count(self, medium, gathered, task) -> Segment:
            return counted(self.march(medium, task).evaluations.sum(1).reshape(task.shape[::2]), task)

        for name, of_name in zip(names, (steps, type(names[1], (steps,), {"__call__": count})), strict=True):
            setattr(PAGE, name, of_name)
            INTEGRATORS[name] = f"{PAGE.__name__}:{name}"
        rows.append({"variant": "step doubling", "samples": samples, "tolerance": tolerance, "names": names})
    return rows


def measured(name: str, arguments: argparse.Namespace) -> list[dict]:
    """Errors and points a ray of all contenders on a field."""
    scene, camera = getattr(made_fields, name)(arguments.points, width=arguments.size, height=arguments.size)

    def rendered(samples: int, integrator: str) -> js.Image:
        return js.render(scene, camera, js.Settings(samples=samples, integrator=integrator))

    truth, rows = np.asarray(rendered(CONVERGED, "samples").color, np.float64), []
    for row in contenders():
        integrator, counting = row.pop("names")
        rendered(row["samples"], integrator)
        image, points = rendered(row["samples"], integrator), rendered(row["samples"], counting).color[..., 0]
        error = np.abs(np.asarray(image.color, np.float64) - truth).max(-1)
        rows.append(row | {"field": name, "points": float(points.mean()), "mean_error": float(error.mean())})
        rows[-1] |= {"error_99": float(np.quantile(error, 0.99)), "max_error": float(error.max())}
        rows[-1]["seconds"] = float(image.stats["seconds"]["cast"])
        print(" ".join(f"{value:.3g}" if isinstance(value, float) else str(value) for value in rows[-1].values()), flush=True)
    even = [row for row in rows if row["tolerance"] is None]
    for row in rows:
        if row["tolerance"] is not None and even[-1]["mean_error"] <= row["mean_error"] <= even[0]["mean_error"]:
            row |= {name: over_even(row, even, key) for name, key in (("share", "points"), ("time", "seconds"))}
    return rows


def over_even(row: dict, even: list[dict], key: str) -> float:
    """What a contender takes over what even steps of its mean error do, between those that were measured."""
    errors, taken = (np.log([one[name] for one in even]) for name in ("mean_error", key))
    return round(float(row[key] / np.exp(np.interp(-np.log(row["mean_error"]), -errors, taken))), 2)


def variants() -> list[str]:
    """Names of all that is compared."""
    return [f"even {points}" for points in EVEN] + [f"doubling {samples}, {tolerance:g}" for samples, tolerance in STEPS]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=64, help="of the grids, along the first axis")
    parser.add_argument("--size", type=int, default=64, help="pixels on a side")
    arguments = parser.parse_args()
    records = [row for name in FIELDS for row in measured(name, arguments)]
    shares, times = (
        {name: [row[key] for row in records if row["field"] == name and key in row] for name in FIELDS}
        for key in ("share", "time")
    )
    sizes = {"size": arguments.size, "points": arguments.points, "converged": CONVERGED}
    keep(RESULTS, variants(), **sizes, shares=shares, times=times, records=records)
    print(shares, times)
    assert shares["mixing_layer"] and max(shares["mixing_layer"]) < 1, shares


if __name__ == "__main__":
    main()
