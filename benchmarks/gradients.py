"""Claim: a gradient costs no more than four frames beside the frame itself, and twice its memory.

The gradient of a scalar of the image by all that has one (particles, transfer function, camera) is pulled back in one program
with the frame; the frame alone and other programs take turns with it in one process, compile time apart. `backward` is what the
gradient takes beyond the frame. Memory is what a compiled program needs at once: arguments, results and working arrays.

On a small scene the same gradient is taken by plain automatic differentiation of a `lax.scan` over samples that sums over all
particles. In float64 it must agree; its memory grows with the number of samples, ours does not. Writes `results/gradients.json`;
ends in asserts on agreement and memory, and with --check on the ratio of medians.

    python benchmarks/gradients.py [--repeats 5] [--sizes 256 512] [--check]
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import statistics
import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import peers
from kept import keep

import jaxsph as js
from jaxsph.model.particles import kernels

MOST_BACKWARD = 4.0  # frames
MOST_MEMORY = 2.0  # times a frame's
SMALL = {"particles": 150, "width": 24, "height": 24}
SAMPLES = (32, 64, 128)
MOST_GROWTH = 1.25  # of our memory, once there are as many slabs as are held at once: with the fewest samples there are not
AGREE = 1e-8  # of the largest entry, in float64; in float32 either rounds, and by the opening terms cancel
RESULTS = peers.RESULTS.with_name("gradients.json")


def total(draw: Callable, scene: js.Scene, camera: js.Camera) -> Callable:
    """A scalar of the image as a function of the scene's and the camera's numbers."""
    cotangent = jnp.asarray(np.random.default_rng(0).normal(size=(camera.height, camera.width, 4)), jnp.float32)

    def of(numbers: dict) -> jax.Array:
        parts = {name: numbers[name] for name in ("position", "support", "quantity", "volume")}
        particles = dataclasses.replace(scene.particles, **parts)
        transfer = js.TransferFunction(*(numbers[name] for name in ("values", "colors", "extinction")))
        view = dataclasses.replace(camera, **{name: numbers[name] for name in ("eye", "axes", "half_height")})
        return (draw(js.Scene(particles=particles, transfer=transfer), view) * cotangent).mean()

    return of


def numbers_of(scene: js.Scene, camera: js.Camera) -> dict:
    parts = vars(scene.particles) | vars(scene.transfer) | vars(camera)
    names = ("position", "support", "quantity", "volume", "values", "colors", "extinction", "eye", "axes", "half_height")
    return {name: parts[name] for name in names}


def layers(image: js.Image) -> jax.Array:
    return jnp.concatenate([image.color, image.transmittance[..., None]], -1)


def marched(scene: js.Scene, camera: js.Camera, settings: js.Settings) -> Callable:
    plan = js.plan(scene, camera, settings)
    return lambda scene, camera: layers(js.render(scene, camera, settings, plan=plan))


def scanned(samples: int) -> Callable:
    """The image by a scan over samples, each of which sums over all particles: what automatic differentiation is fit for."""

    def draw(scene: js.Scene, camera: js.Camera) -> jax.Array:
        particles = scene.particles
        view, smooth = camera.to_view(particles.position), kernels.by_name(particles.kernel)
        u, v = camera.column(jnp.arange(camera.width) + 0.5), camera.row(jnp.arange(camera.height) + 0.5)
        slant = jnp.sqrt(1 + u**2 + v[:, None] ** 2)

        def step(state: tuple, i: jax.Array) -> tuple:
            color, transmittance = state
            s, front, back = (camera.depth(i + part, samples) for part in (0.5, 0.0, 1.0))
            squares = (u[:, None] * s - view[:, 0]) ** 2, (v[:, None] * s - view[:, 1]) ** 2 + (s - view[:, 2]) ** 2
            square = (squares[0] + squares[1][:, None]) / particles.support**2
            weight = particles.volume / particles.support**3 * smooth.of_square(square, jnp)
            sums = weight.sum(-1), (weight * particles.quantity).sum(-1)
            inside = sums[0] > 0
            optics = scene.transfer(jnp.where(inside, sums[1] / jnp.where(inside, sums[0], 1), 0))
            left = jnp.exp(-jnp.where(inside, optics[1] * (back - front) * slant, 0))
            color = color + (transmittance * (1 - left))[..., None] * optics[0]
            return (color, transmittance * left), None

        start = jnp.zeros((camera.height, camera.width, 3)), jnp.ones((camera.height, camera.width))
        color, transmittance = jax.lax.scan(step, start, jnp.arange(samples, dtype=jnp.float32))[0]
        return jnp.concatenate([color, transmittance[..., None]], -1)

    return draw


@dataclasses.dataclass(frozen=True)
class Program:
    """A compiled function of the numbers."""

    run: Callable
    compile_seconds: float
    bytes: int


def compiled(function: Callable, numbers: dict) -> Program:
    started = time.perf_counter()
    run = jax.jit(function).lower(numbers).compile()
    seconds, memory = time.perf_counter() - started, run.memory_analysis()
    needed = memory.argument_size_in_bytes + memory.output_size_in_bytes + memory.temp_size_in_bytes
    return Program(run, seconds, needed)


def in_turns(programs: dict[str, Program], numbers: dict, repeats: int) -> dict[str, dict]:
    times: dict[str, list[float]] = {name: [] for name in programs}
    for turn in range(repeats + 1):
        for name, program in programs.items():
            started = time.perf_counter()
            jax.block_until_ready(program.run(numbers))
            if turn:
                times[name].append(time.perf_counter() - started)
    return {
        name: {"seconds": statistics.median(times[name]), "compile": program.compile_seconds, "bytes": program.bytes}
        for name, program in programs.items()
    }


def backward(size: int, repeats: int) -> dict:
    """The mixer: a frame, its gradient, the gradient by the transfer function alone, and a derivative in one direction."""
    scene, camera = js.scenes.load("mixer", width=size, height=size)
    of, numbers = total(marched(scene, camera, js.Settings()), scene, camera), numbers_of(scene, camera)
    still = {name: numbers[name] for name in numbers if name not in ("values", "colors", "extinction")}
    programs = {
        "frame": compiled(of, numbers),
        "gradient": compiled(jax.value_and_grad(of), numbers),
        "by transfer": compiled(lambda moving: jax.value_and_grad(lambda part: of(still | part))(
            {name: moving[name] for name in ("values", "colors", "extinction")}), numbers),
        "one direction": compiled(lambda numbers: jax.jvp(of, (numbers,), (numbers,)), numbers),
    }  # fmt: skip
    found = in_turns(programs, numbers, repeats)
    frame = found["frame"]
    ratios = {
        "backward_to_frame": found["gradient"]["seconds"] / frame["seconds"] - 1,
        "memory_to_frame": found["gradient"]["bytes"] / frame["bytes"],
    }
    return {"scene": "mixer", "particles": scene.particles.num_particles, "size": size, **ratios, "programs": found}


def against_scan(samples: int, repeats: int) -> dict:
    """The small scene: our gradient beside that of a scan."""
    scene, camera = js.scenes.load("mixer", **SMALL)
    # dye and water are the ends of the transfer function, where slopes differ to either side: rounding would choose one
    within = dataclasses.replace(scene.particles, quantity=0.02 + 0.96 * scene.particles.quantity)
    scene = dataclasses.replace(scene, particles=within)
    settings, numbers = js.Settings(samples=samples), numbers_of(scene, camera)
    draws = {"marched": marched(scene, camera, settings), "scanned": scanned(samples)}
    programs = {name: compiled(jax.grad(total(draw, scene, camera)), numbers) for name, draw in draws.items()}
    found = in_turns(programs, numbers, repeats)
    return {"samples": samples, **SMALL, "off": disagreement(scene, camera, draws), "programs": found}


def disagreement(scene: js.Scene, camera: js.Camera, draws: dict[str, Callable]) -> dict[str, float]:
    """How far the two gradients are apart in float64, over the largest entry by each input."""

    def double(leaf: jax.Array) -> jax.Array:
        return leaf.astype(jnp.float64) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    with jax.enable_x64(True):
        scene, camera = jax.tree.map(double, (scene, camera))
        ours, theirs = (jax.jit(jax.grad(total(draw, scene, camera)))(numbers_of(scene, camera)) for draw in draws.values())
        return {name: float(jnp.abs(ours[name] - theirs[name]).max() / jnp.abs(theirs[name]).max()) for name in ours}


def variants() -> list[str]:
    """Names of all that is compared."""
    return ["frame", "gradient", "by transfer", "one direction", "marched", "scanned"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--sizes", type=int, nargs="+", default=[256, 512], help="pixels on a side")
    parser.add_argument("--check", action="store_true", help="fail where the ratio of medians is over its limit")
    arguments = parser.parse_args()
    frames = []
    for size in arguments.sizes:
        frames.append(backward(size, arguments.repeats))
        print(f"mixer {size}: backward {frames[-1]['backward_to_frame']:.2f} frames, memory {frames[-1]['memory_to_frame']:.2f}")
        for name, found in frames[-1]["programs"].items():
            print(f"  {name:14s} {found['seconds']:.3f} s  {found['bytes'] / 2**20:6.1f} MiB  compile {found['compile']:.1f} s")
    small = [against_scan(samples, arguments.repeats) for samples in SAMPLES]
    for record in small:
        cells = (f"{name} {f['seconds']:.3f} s {f['bytes'] / 2**20:.1f} MiB" for name, f in record["programs"].items())
        print(f"{record['samples']} samples: {'  '.join(cells)}  off by {max(record['off'].values()):.1e}", flush=True)
    names = [name for record in (*frames, *small) for name in record["programs"]]
    keep(RESULTS, names, repeats=arguments.repeats, frames=frames, against_scan=small)
    assert all(off <= AGREE for record in small for off in record["off"].values()), [record["off"] for record in small]
    grown = [record["programs"]["marched"]["bytes"] for record in small]
    assert grown[-1] <= MOST_GROWTH * grown[1], grown
    assert all(record["memory_to_frame"] <= MOST_MEMORY for record in frames)
    slow = [record["size"] for record in frames if record["backward_to_frame"] > MOST_BACKWARD]
    assert not (arguments.check and slow), f"backward takes more than {MOST_BACKWARD} frames at {slow}"


if __name__ == "__main__":
    main()
