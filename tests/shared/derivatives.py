"""Slopes of images: programs that give them in both modes, and the directions and frames that tests take them of."""

from __future__ import annotations

import dataclasses
import functools
import os

import jax
import jax.numpy as jnp
import numpy as np

import jaxsph as js

STEP = 1e-7  # of a difference: so small that hardly a sample meets a kink of the transfer function on the way
CLOSE = 1e-6  # of the sum of a slope's terms, and of one: the rounding of some thousand pixels over the step, with room
AGREE = 2.0**16 * np.finfo(np.float64).eps  # both modes add up the same numbers, some thousands of them, in another order
# Programs that run some times only: compiling them is what takes time, with these half of it or less (the older of XLA's
# emitters halves it again), and they run two to three times as long.
# Accelerators, where `JAX_PLATFORMS=cuda,cpu` has the suite run on one, compile by options of their own.
QUICKLY = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False, "xla_cpu_parallel_codegen_split_count": 1}
if os.environ.get("JAX_PLATFORMS", "cpu") != "cpu":
    QUICKLY = {}
elif jax.__version_info__ >= (0, 11):  # which has one emitter alone
    del QUICKLY["xla_cpu_use_fusion_emitters"]


def total(inputs, cotangent, settings, plan):
    """All layers that have derivatives, weighted by their cotangents."""
    image = js.render(*inputs, settings, plan=plan)
    return (jnp.concatenate([image.color, image.transmittance[..., None]], -1) * cotangent).sum()


@functools.partial(jax.jit, static_argnames="plan", compiler_options=QUICKLY)
def looked(inputs, move, cotangent, settings, plan):
    """The total, its slope in a direction by forward mode, and its gradient by reverse mode: one program."""

    def of(inputs):
        return total(inputs, cotangent, settings, plan)

    return *jax.jvp(of, (inputs,), (move,)), jax.grad(of, allow_int=True)(inputs)


def pulled(inputs, cotangent, settings, plan):
    return looked(inputs, still(inputs), cotangent, settings, plan)[2]


@functools.partial(jax.jit, static_argnames="plan", compiler_options=QUICKLY)
def valued(inputs, cotangent, settings, plan):
    """The total and its gradient: a smaller program."""
    return jax.value_and_grad(total, allow_int=True)(inputs, cotangent, settings, plan)


def still(inputs):
    """A direction in which nothing moves."""
    floating = functools.partial(jnp.issubdtype, arg2=jnp.floating)
    return jax.tree.map(lambda x: np.zeros(x.shape, x.dtype if floating(x.dtype) else jax.dtypes.float0), inputs)


def along(gradient, move):
    """Slope in the direction `move`, and the sum of its terms' sizes."""
    pairs = zip(jax.tree.leaves(gradient), jax.tree.leaves(move), strict=True)
    terms = [(np.asarray(a) * np.asarray(b)).ravel() for a, b in pairs if a.dtype != jax.dtypes.float0]
    return float(sum(t.sum() for t in terms)), float(sum(np.abs(t).sum() for t in terms))


def stepped(inputs, move, step):
    return jax.tree.map(lambda x, d: x if d.dtype == jax.dtypes.float0 else np.asarray(x) + step * np.asarray(d), inputs, move)


def differ(inputs, move, cotangent, settings, plan):
    """The central difference in the direction `move`, and the slope and gradient there."""
    ahead, behind = (looked(stepped(inputs, move, by), still(inputs), cotangent, settings, plan)[0] for by in (STEP, -STEP))
    _, pushed, gradient = looked(inputs, move, cotangent, settings, plan)
    return float(ahead - behind) / (2 * STEP), float(pushed), gradient


def weights(rng, frames):
    return rng.normal(size=(frames.height, frames.width, 4))


def filled(frames, rng, dtype=np.float64):
    """A frame without empty space, where colours would jump as a support's edge passes a sample."""
    scene, camera = frames.scene(rng, dtype=dtype), frames.camera(rng, dtype=dtype)
    particles = scene.particles
    position, support, volume = (np.array(column) for column in (particles.position, particles.support, particles.volume))
    position[0], support[0], volume[0] = 0, 20, 1e3
    particles = dataclasses.replace(particles, position=position, support=support, volume=volume)
    return dataclasses.replace(scene, particles=particles), camera


def anyhow(*names):
    def move(inputs, rng):
        parts = {**vars(inputs[0].particles), **vars(inputs[0].transfer), **vars(inputs[1])}
        return {name: rng.normal(size=parts[name].shape) for name in names}

    return move


def towards(inputs, named):
    """The direction that moves the parts that are `named`, and nothing else."""
    zero = still(inputs)
    scene, camera = zero

    def put(part):
        return dataclasses.replace(part, **{name: move for name, move in named.items() if name in vars(part)})

    return dataclasses.replace(scene, particles=put(scene.particles), transfer=put(scene.transfer)), put(camera)


def turns(inputs, rng):
    """About all three axes: a tangent of rotations."""
    x, y, z = rng.normal(size=3)
    return {"axes": np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ np.asarray(inputs[1].axes)}


def anywhere(inputs, rng):
    """A direction in which all that floats moves but low digits, which carry no slope, and the camera turns as cameras do."""

    def any_way(path, leaf, none):
        if none.dtype == jax.dtypes.float0:
            return none
        move = rng.normal(size=leaf.shape)
        return 0 * move if str(getattr(path[-1], "name", "")).endswith("rest") else move

    turn = turns(inputs, rng)
    scene, pose = jax.tree_util.tree_map_with_path(any_way, inputs, still(inputs))
    return scene, dataclasses.replace(pose, **turn)
