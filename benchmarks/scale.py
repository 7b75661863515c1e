"""Claim: a frame over devices that have a core each takes its time divided by their number, but for ordering and lists; with
particles dealt out by depth, a device holds fewer.

Forced CPU devices take turns in one process, with one thread of shards a device: 1, 2 and 4 of them, kept to as many cores where
there are so many. Without that one device alone would use most of two cores, as XLA shares a program among threads. Measured are
seconds and processor seconds of eager frames by stage, seconds of a jitted frame over a mesh, of a jitted gradient, and of depth
slabs, with the bytes of particles on a device. Writes `results/scale.json`; ends in asserts on bits and memory and, with --check,
on the ratio of medians.

    python benchmarks/scale.py [--repeats 5] [--particles 100000] [--size 512] [--samples 256] [--check]
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import json
import os
import pathlib
import statistics
import time

import jax
import numpy as np
from jax.sharding import AxisType, Mesh
from kept import keep

import jaxsph as js
from jaxsph.engine.planning import plan
from jaxsph.sequence.cluster import keep_to

DEVICES = (1, 2, 4)
RESULTS = pathlib.Path(__file__).with_name("results") / "scale.json"
LAYERS = "color", "transmittance", "depth", "error_bound", "evaluations"
LEAST_EFFICIENCY = 0.7  # of two devices that have a core each, in the cast


def main() -> None:
    options = asked()
    jax.config.update("jax_num_cpu_devices", DEVICES[-1])
    plan.shards_at_hand = lambda *_: 1  # a core a device
    scene, camera = js.scenes.load("mixer", options.particles, width=options.size, height=options.size)
    settings = js.Settings(samples=options.samples)
    told = {"eager": eager(scene, camera, settings, options.repeats), "jitted": jitted(scene, camera, settings, options.repeats)}
    size = {name: getattr(options, name) for name in ("particles", "size", "samples", "repeats")}
    keep(RESULTS, [f"{number} devices" for number in DEVICES], frame=size, **told)
    print(json.dumps(told, indent=1))
    assert all(told["eager"]["same_bits"].values())
    if options.check and (os.cpu_count() or 1) >= 2:
        cast = told["eager"]["seconds"]
        assert cast["1"]["cast"] / (2 * cast["2"]["cast"]) >= LEAST_EFFICIENCY


def asked() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--particles", type=int, default=100_000)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--check", action="store_true")
    return parser.parse_args()


def eager(scene, camera, settings, repeats):
    """Median seconds of each stage, and whether bits are those of one device."""
    images = {number: js.render(scene, camera, settings, devices=number) for number in DEVICES}
    same = {
        str(number): all(np.array_equal(getattr(images[1], layer), getattr(image, layer)) for layer in LAYERS)
        for number, image in images.items()
    }
    seconds = {number: [] for number in DEVICES}
    for _ in range(repeats):
        for number in DEVICES:
            with a_core_each(number):
                begun, used = time.perf_counter(), time.process_time()
                stages = js.render(scene, camera, settings, devices=number).stats["seconds"]
                all_of_it = {"all": time.perf_counter() - begun, "processor": time.process_time() - used}
            seconds[number].append({**stages, **all_of_it})
    medians = {
        str(number): {stage: statistics.median(one[stage] for one in runs) for stage in runs[0]}
        for number, runs in seconds.items()
    }
    return {"same_bits": same, "seconds": medians, "pairs": images[1].stats["pairs"]}


def jitted(scene, camera, settings, repeats):
    """Median seconds of a frame and of its gradient by all quantities, as programs over a mesh."""
    plan, quantity = js.plan(scene, camera, settings), scene.particles.quantity

    def light(quantity, mesh):
        shown = dataclasses.replace(scene, particles=dataclasses.replace(scene.particles, quantity=quantity))
        return js.render(shown, camera, settings, plan=plan, devices=mesh).color.mean()

    told = {}
    for name, function in (("frame", light), ("gradient", jax.grad(light))):
        programs = {str(number): jax.jit(functools.partial(function, mesh=mesh_of(number))) for number in DEVICES}
        told[name] = in_turns({number: (lambda p=program: p(quantity)) for number, program in programs.items()}, repeats)
    return told


def in_turns(calls, repeats):
    """Median seconds of each, after one that compiles."""
    seconds = {name: [] for name in calls}
    for turn in range(repeats + 1):
        for name, call in calls.items():
            with a_core_each(int(name)):
                begun = time.perf_counter()
                jax.block_until_ready(call())
            if turn:
                seconds[name].append(time.perf_counter() - begun)
    return {name: statistics.median(runs) for name, runs in seconds.items()}


@contextlib.contextmanager
def a_core_each(devices):
    """All threads of this process on as many cores as there are devices."""
    cores = sorted(os.sched_getaffinity(0))
    keep_to(cores[:devices])
    try:
        yield
    finally:
        keep_to(cores)


def mesh_of(number):
    return Mesh(np.array(jax.devices()[:number]), ("devices",), axis_types=(AxisType.Auto,))


if __name__ == "__main__":
    main()
