"""Claim: on an accelerator frames of 200,000 particles and more are drawn faster than by the CPUs beside it, and as correctly.

Both in one process, in turns, float32: the same particles, camera and settings on the accelerator and on the CPUs of the machine.
Cases, each by itself, small ones first (so that a few minutes tell much):

    render      at full rate, 256 samples a ray; `first` is the first frame of its kind with all that is compiled for it, `steady`
                the median of the next, with the seconds of each stage;
    kept        the same to a tolerance: `interval` bounds, `pilot` estimates, `segments` refines;
    project     column densities, means over pixels;
    gradient    of a mean of the picture by all of the scene and the camera, one program;
    correct     small frames against float64 NumPy on the CPU: the largest difference of either device to it, of the two to each
                other, and what a picture to a tolerance is off by beside its own `error_bound` (where that is a bound, `beyond`
                has to be 0). `correct:arithmetic` has what bounds assume of a device: errors of functions in eps, how often it
                fuses a product with what it is added to, keeps subnormals, and what products of matrices are off by.

A case that fails is told with its traceback, and the others go on; after `--seconds` none begins. On a machine without an
accelerator the CPUs are both contenders; `--tuned` has the first of them do what is tuned for accelerators.
Writes `results/accelerator.json`; ends in asserts on what is correct, and with --check on the claim of time.

    python benchmarks/accelerator.py [--seconds 600] [--repeats 5] [--quick] [--tuned] [--check] [--only render:200k:512 ...]
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import itertools
import pathlib
import statistics
import time
import traceback
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import workloads
from kept import keep

import jaxsph as js
from jaxsph.engine.planning import fit
from jaxsph.engine.runtime import tuning

RESULTS = pathlib.Path(__file__).with_name("results") / "accelerator.json"
SIDES = {"30k": 31, "200k": 58, "1m": 100}  # particles along an edge of the filled cube
TINY = {"30k": 8, "200k": 10, "1m": 12}
KEPT = {"interval": {"estimator": "interval"}, "pilot": {"estimator": "pilot"}, "segments": {}}
TOLERANCE, SAMPLES = 0.004, 256
ORDER = (
    "correct:arithmetic", "correct:samples", "render:30k:512", "correct:interval", "render:200k:512", "kept:30k:512:interval",
    "project:30k:512", "render:1m:1024", "gradient:30k:512", "kept:30k:512:segments", "correct:segments", "correct:surface",
    "correct:project", "kept:30k:512:pilot", "project:1m:1024", "kept:1m:1024:segments", "render:30k:1024", "render:200k:1024",
    "gradient:200k:512", "kept:200k:1024:interval", "kept:200k:1024:segments", "project:200k:1024", "render:1m:512",
    "kept:1m:1024:interval", "gradient:1m:1024",
)  # fmt: skip
SMALL = 64  # pixels
FEW = 3000  # particles of the frames that are compared with float64
ROUNDING = 1e-4  # largest difference to float64 that float32 may have on all but one pixel in a thousand, as the tests have it
FAST = "render:200k:512", "render:1m:1024"  # the claim of time


def contenders(tuned: bool) -> dict[str, tuple[jax.Device, Any]]:
    """Devices by name, and what forces their tuning."""
    fast, (slow, *_) = jax.devices()[0], jax.devices("cpu")
    if fast.platform != "cpu":
        return {fast.platform: (fast, contextlib.nullcontext), "cpu": (slow, contextlib.nullcontext)}
    forced = functools.partial(mock.patch.object, fit, "tuning_for", lambda _: tuning.ACCELERATOR)
    first = ("tuned", forced) if tuned else ("same", contextlib.nullcontext)
    return {first[0]: (slow, first[1]), "cpu": (slow, contextlib.nullcontext)}


@contextlib.contextmanager
def placed(contender: tuple[jax.Device, Any]) -> Iterator[None]:
    """What is made and run meanwhile is on that device."""
    device, forced = contender
    with jax.default_device(device), forced():
        yield


@dataclasses.dataclass(frozen=True)
class Timed:
    """Times runs of all contenders in turns."""

    contenders: dict[str, Any]
    repeats: int

    def turns(self, made: Callable[[], Callable[[], Any]]) -> dict[str, Any]:
        """Of what `made` makes on each device: first and steady seconds, and stages of what tells them."""
        found: dict[str, Any] = {}
        runs: dict[str, Callable[[], Any]] = {}
        for name, contender in self.contenders.items():
            with placed(contender):
                runs[name] = made()
                seconds, image = clocked(runs[name])
            found[name] = {"first": seconds, "steady": [], "stages": stages_of(image)}
        for _, (name, contender) in itertools.product(range(self.repeats), self.contenders.items()):
            with placed(contender):
                seconds, image = clocked(runs[name])
            found[name]["steady"].append(seconds)
            found[name]["stages"] = stages_of(image)
        for name, (device, _) in self.contenders.items():
            found[name]["all"], found[name]["steady"] = found[name]["steady"], statistics.median(found[name]["steady"])
            found[name]["peak_bytes"] = (device.memory_stats() or {}).get("peak_bytes_in_use")
        fast, slow = found.values()
        return found | {"speed": slow["steady"] / fast["steady"]}


def clocked(run: Callable[[], Any]) -> tuple[float, Any]:
    started = time.perf_counter()
    image = jax.block_until_ready(run())
    return time.perf_counter() - started, image


def stages_of(image: Any) -> dict[str, float] | None:
    return dict(image.stats["seconds"]) if isinstance(image, js.Image) else None


def work(size: str, pixels: int, quick: bool) -> workloads.Workload:
    side = (TINY if quick else SIDES)[size]
    return workloads.cube(side, size=pixels // 16 if quick else pixels, samples=SAMPLES // 4 if quick else SAMPLES)


def timed(kind: str, load: workloads.Workload, how: str | None) -> Callable[[], Any]:
    """What is run over and over, with its scene and plan made on the device of the moment."""
    scene, camera = load.scene("poly6"), load.camera()
    kept = {} if how is None else {"tolerance": TOLERANCE, **KEPT[how]}
    settings = js.Settings(samples=load.samples, **kept)
    if kind == "project":
        plan = js.plan_projection(scene.particles, camera)
        return lambda: js.project(scene.particles, camera, plan=plan).values
    plan = js.plan(scene, camera, settings)
    if kind != "gradient":
        return lambda: js.render(scene, camera, settings, plan=plan)

    @jax.jit
    def slope(inputs: Any) -> Any:
        def total(inputs: Any) -> Any:
            image = js.render(*inputs, settings, plan=plan)
            return image.color.mean() + image.transmittance.mean()

        return jax.grad(total, allow_int=True)(inputs)

    def run() -> Any:
        found = slope((scene, camera))
        assert all(np.isfinite(leaf).all() for leaf in map(np.asarray, jax.tree.leaves(found)) if leaf.dtype == np.float32)
        return found

    return run


def small_frame(kind: str) -> tuple[js.Scene, js.Camera, js.Settings, js.Settings | None]:
    """A frame that float64 NumPy draws in seconds; its settings at full rate, and to a tolerance."""
    scene, camera = workloads.blocks(FEW, SMALL)
    full = js.Settings(samples=128)
    return scene, camera, full, js.Settings(samples=128, tolerance=0.02, **KEPT[kind]) if kind in KEPT else None


def correct(kind: str, contenders: dict[str, Any]) -> dict[str, Any]:
    """Pictures of a small frame by each contender, beside those of float64."""
    check = {"project": projected, "surface": surfaced, "arithmetic": computed}.get(kind, pictured)
    with placed(contenders["cpu"]):
        truth = check.truth(kind)  # type: ignore[attr-defined]
    found: dict[str, Any] = {}
    layers: dict[str, np.ndarray] = {}
    for name, contender in contenders.items():
        with placed(contender):
            layers[name], found[name] = check(kind, truth)
    fast, slow = (layers[name] for name in contenders)
    return found | {"between": off(fast, slow)}


def off(one: np.ndarray, other: np.ndarray) -> dict[str, float]:
    """Largest difference, and that of all but one pixel in a thousand."""
    away = np.nan_to_num(np.abs(one.astype(np.float64) - other), nan=np.inf)
    return {"largest": float(away.max()), "of 999 in 1000": float(np.quantile(away, 0.999))}


def layers_of(image: js.Image) -> np.ndarray:
    return np.concatenate([np.asarray(image.color), np.asarray(image.transmittance)[..., None]], -1)


def pictured(kind: str, truth: tuple[np.ndarray, ...]) -> tuple[np.ndarray, dict[str, Any]]:
    """At full rate beside float64, twice, and to a tolerance beside its own bound."""
    scene, camera, full, kept = small_frame(kind)
    image = js.render(scene, camera, full)
    layers, told = layers_of(image), off(layers_of(image), truth[0])
    told["again"] = off(layers_of(js.render(scene, camera, full)), layers)["largest"]
    if kept is not None:
        image = js.render(scene, camera, kept)
        reference = truth[1] if kind == "segments" else layers  # bounds are against the picture at full rate of the same device
        away = np.abs(layers_of(image) - reference).max(-1)
        bound = np.asarray(image.error_bound, np.float64)
        told |= {"bound": float(bound.max()), "error": float(away.max()), "beyond": float(np.maximum(away - bound, 0).max())}
        saved = image.stats["evaluations_full"] / max(image.stats["evaluations"], 1)
        told |= {"saved": saved, "certified": bool(image.certified)}
    return layers, told


def true_pictures(kind: str) -> tuple[np.ndarray, ...]:
    scene, camera, full, _ = small_frame(kind)
    found = [js.reference.render(scene, camera, full)]
    if kind == "segments":
        found.append(js.reference.integral(scene, camera))
    return tuple(map(layers_of, found))


def projected(_: str, truth: tuple[np.ndarray, ...]) -> tuple[np.ndarray, dict[str, Any]]:
    """Column densities, relative to the largest."""
    scene, camera, *_ = small_frame("project")
    values = np.asarray(js.project(scene.particles, camera, pixel="ray").values)
    return values, off(values / truth[0].max(), truth[0] / truth[0].max())


def true_columns(_: str) -> tuple[np.ndarray, ...]:
    scene, camera, *_ = small_frame("project")
    return (np.asarray(js.reference.project(scene.particles, camera, pixel="ray").values),)


def surfaced(_: str, truth: tuple[np.ndarray, ...]) -> tuple[np.ndarray, dict[str, Any]]:
    """A surface with occlusion, whose light is smoothed over what is around: by each device, without truth."""
    scene, camera, full, _ = small_frame("surface")
    scene = js.Scene(particles=scene.particles, surface=js.Surface(level=0.5, occlusion=0.5))
    image = js.render(scene, camera, full)
    met = np.isfinite(np.asarray(image.depth))
    return layers_of(image), {"met": int(met.sum())}


def no_truth(_: str) -> tuple[np.ndarray, ...]:
    return ()


def computed(*_: Any) -> tuple[np.ndarray, dict[str, Any]]:
    """What a device makes of functions of float32, as compiled: in eps of the result (of `exp` below 1, as such: of 1)."""
    rng = np.random.default_rng(0)
    x, y, z = rng.uniform(0.01, 20, (3, 1 << 20)).astype(np.float32)
    functions: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
        "exp": (lambda x, *_: jnp.exp(-x), lambda x, *_: np.exp(-x)),
        "expm1": (lambda x, *_: jnp.expm1(-x), lambda x, *_: np.expm1(-x)),
        "exp2": (lambda x, *_: jnp.exp2(x), lambda x, *_: np.exp2(x)),
        "log": (lambda x, *_: jnp.log(x + 3), lambda x, *_: np.log(np.float32(3) + x.astype(np.float32))),
        "sqrt": (lambda x, *_: jnp.sqrt(x), lambda x, *_: np.sqrt(x)),
        "over": (lambda x, y, _: x / y, lambda x, y, _: x / y),
        "one over sqrt": (lambda x, *_: 1 / jnp.sqrt(x), lambda x, *_: 1 / np.sqrt(x)),
    }  # fmt: skip
    eps, found = float(np.finfo(np.float32).eps), {}
    for name, (ours, theirs) in functions.items():
        exact = theirs(*(column.astype(np.float64) for column in (x, y, z)))
        away = np.abs(np.asarray(jax.jit(ours)(x, y, z), np.float64) - exact)
        found[name] = float((away / (1 if name == "exp" else np.abs(exact))).max() / eps)
    fused = jax.jit(lambda x, y, z: x * y + z)(x, y, -(x * y))
    found["fuses"] = float((np.asarray(fused) != 0).mean())
    found["subnormals kept"] = float((np.asarray(jax.jit(lambda x: x * np.float32(0.25))(x * np.float32(2e-38))) > 0).mean())
    a, b = rng.normal(size=(2, 256, 256)).astype(np.float32)
    exact = a.astype(np.float64) @ b
    for how in (None, "highest"):
        product = np.asarray(jax.jit(lambda a, b, how=how: jnp.matmul(a, b, precision=how))(a, b), np.float64)
        found[f"matmul {how or 'default'}"] = float(np.abs(product - exact).max() / np.abs(exact).max() / eps)
    return np.zeros(1), found


pictured.truth, projected.truth, surfaced.truth, computed.truth = true_pictures, true_columns, no_truth, no_truth  # type: ignore[attr-defined]


def wrong(name: str, found: dict[str, Any], of: Any) -> list[str]:
    """What is not as correct as it is to be."""
    if not name.startswith("correct") or "failed" in found:
        return [name] if "failed" in found else []
    certified = [key for key in of if found[key].get("certified")]
    bad = [f"{name} {key}: beyond its bound by {found[key]['beyond']:.2g}" for key in certified if found[key]["beyond"] > 0]
    own = [key for key in (*of, "between") if found[key].get("of 999 in 1000", 0) > ROUNDING]
    return bad + [f"{name} {key}: {found[key]['of 999 in 1000']:.2g} off" for key in own]


def line(name: str, found: dict[str, Any], of: Any) -> str:
    """What a person reads of a case."""
    if "failed" in found:
        return f"{name:26s} FAILED {found['failed'].strip().splitlines()[-1][:150]}"
    if name.startswith("correct"):
        cells = ["  ".join(f"{key} {value:.3g}" for key, value in found[part].items()) for part in (*of, "between")]
        return "\n".join(f"{name:26s} {part:8s} {cell}" for part, cell in zip((*of, "between"), cells, strict=True))
    cells = [f"{key} first {found[key]['first']:7.2f} steady {found[key]['steady']:.4f} s" for key in of]
    stages = next(iter(found.values()))["stages"] or {}
    told = " ".join(f"{stage} {seconds:.4f}" for stage, seconds in stages.items() if seconds >= 5e-5)
    return f"{name:26s} {'  '.join(cells)}  x {found['speed']:.2f}  ({told})"


def variants() -> list[str]:
    """Names of contenders, of whatever machine."""
    return ["gpu", "tpu", "tuned", "same", "cpu"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=600, help="after which no case begins")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="tiny sizes, to try this program")
    parser.add_argument("--tuned", action="store_true", help="on CPUs alone: one contender does what is tuned for accelerators")
    parser.add_argument("--only", nargs="+", default=ORDER, metavar="CASE")
    parser.add_argument("--check", action="store_true", help="fail where the accelerator is slower than the CPUs")
    parser.add_argument("--output", type=pathlib.Path, default=RESULTS)
    arguments = parser.parse_args()
    begun, of = time.perf_counter(), contenders(arguments.tuned)
    record: dict[str, Any] = {"samples": SAMPLES, "tolerance": TOLERANCE, "cases": {}, "left_out": []}
    record["contenders"] = {name: str(device.device_kind) for name, (device, _) in of.items()}
    timer, cases = Timed(of, arguments.repeats), record["cases"]
    for name in arguments.only:
        if time.perf_counter() - begun > arguments.seconds:
            record["left_out"].append(name)
            continue
        kind, what, *rest = name.split(":")
        try:
            if kind == "correct":
                cases[name] = correct(what, of)
            else:
                load = work(what, int(rest[0]), arguments.quick)
                cases[name] = timer.turns(functools.partial(timed, kind, load, rest[1] if rest[1:] else None))
        except Exception:  # one that fails keeps none of the others from being told
            cases[name] = {"failed": traceback.format_exc()}
            print(cases[name]["failed"], flush=True)
        print(line(name, cases[name], of), f" [{time.perf_counter() - begun:.0f} s]", flush=True)
        keep(arguments.output, of, **record)
    print("left out:", *record["left_out"])
    bad = [text for name, found in cases.items() for text in wrong(name, found, of)]
    assert not bad, bad
    slow = [name for name in FAST if name in cases and cases[name]["speed"] < 1]
    assert not (arguments.check and slow), f"slower than the CPUs: {slow}"


if __name__ == "__main__":
    main()
