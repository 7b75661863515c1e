"""Frames of any size, control, integrator, kernel and medium, other ones each day: none raises but by name, no number is NaN
where there is no fault, and what is certified is as near to the float64 reference as it says.

Of half of the frames transfer functions jump where quantities lie, next to that in floating point, or at what a sample has; and
faces of half of the clips pass through samples.

Numbers differ from frame to frame, what is compiled for from one kind of frames to the next: there are `KINDS` of `EAGER`
eager frames and `TRACED` under `jit`, where they have derivatives, too; more kinds at night. A failure shows its kind,
which `kind_of(SEED)` makes again. `PYTHONPATH=.:tests:tests/shared python tests/engine/test_random_frames.py SEED SECONDS TRACED`
draws as many kinds as there is time for, and counts their frames.
"""

import collections
import dataclasses
import datetime
import functools
import itertools
import sys
import time

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from examples import EXAMPLES
from rows import CLIPS, MEDIA

import jaxsph as js
from jaxsph.model.clips import Both, Outside
from jaxsph.model.particles.kernels import KERNELS
from jaxsph.reference.where import ray_coordinates, to_world

pytestmark = pytest.mark.usefixtures("quick_programs")

KINDS, AT_NIGHT = 2, 42  # of frames, and times as many at night
EAGER, TRACED = 3, 24  # frames of a kind
TODAY = datetime.datetime.now(datetime.UTC).date().toordinal()
SLOW = "all together"  # takes minutes to compile
SINGLE, DOUBLE = 2e-3, 1e-7  # between images in float32, and in float64, and the reference, where no error is told
FLIPPED = 0.02  # share of float32's pixels of which a sample may lie on the other side of a support's end


def several(frames, rng, kernel):
    """Types with looks of their own that share samples: gas of two quantities, a volume, and three of stars."""
    scene, volume = (MEDIA[name](frames, rng, kernel) for name in ("two quantities", "volume"))
    points = MEDIA["points"](frames, rng, kernel).points
    return dataclasses.replace(scene, volume=volume.volume, volume_transfer=volume.volume_transfer, points=points)


DRAWN = MEDIA | {"several": several}
CONTROLS = {
    "full rate": {},
    "bounds": {"tolerance": 0.02},
    "bounds, greedy": {"tolerance": 0.02, "allocation": "greedy", "merge": False},
    "no super-pixels": {"tolerance": 0.02, "super_pixels": False},
    "relaxed": {"tolerance": 0.02, "relax": 0.5},
    "pilot": {"tolerance": 0.02, "estimator": "pilot"},
    "quadtree": {"tolerance": 0.02, "screen": "quadtree", "leaf_pixels": 4},
    "ended": {"min_transmittance": 0.01},
}


@dataclasses.dataclass(frozen=True)
class Kind:
    """Frames that share their programs."""

    seed: tuple[int, ...]
    width: int
    height: int
    media: str
    kernel: str
    clip: str
    projection: str
    dtype: type
    settings: js.Settings


def kind_of(seed, media=DRAWN):
    """By chance, of some media."""
    rng = np.random.default_rng(seed)

    def one_of(names):
        return names[rng.integers(len(names))]

    shown = one_of(["particles"] * 4 + ["several", "periodic"] + list(media))
    integrator = one_of(["samples", "segments"])
    control = CONTROLS[one_of(list(CONTROLS))]
    asked = js.Settings(samples=int(2 ** rng.uniform(0, 6)), integrator=integrator, **control)
    size = int(rng.integers(1, 22)), int(rng.integers(1, 19))
    names = shown, one_of(list(KERNELS)), one_of(["everywhere"] * 2 + list(CLIPS)), one_of(["perspective", "orthographic"])
    return Kind(seed, *size, *names, one_of([np.float32, np.float32, np.float64]), asked)


def drawn(kind, nth, adversary):
    """One of its frames: hard particles of four decades of supports and with walls, what a row of the table has beside them, and
    a tolerance of four decades."""
    rng = np.random.default_rng((*kind.seed, nth))
    size = dataclasses.replace(adversary.frames, width=kind.width, height=kind.height, samples=kind.settings.samples)
    maker = dataclasses.replace(adversary, frames=size)
    scene = DRAWN[kind.media](size, rng, kind.kernel)
    if kind.media == "particles":
        scene = maker.scene(rng, kind.kernel, kind.dtype)
    camera, samples = maker.camera(rng, kind.projection, kind.dtype), kind.settings.samples
    clip = CLIPS[kind.clip]
    if rng.integers(2):
        clip = through(clip, sample_of(camera, samples, rng), rng)
    scene = dataclasses.replace(scene, within=clip)
    scene = jax.tree.map(functools.partial(typed, kind.dtype), scene)
    if rng.integers(2) and scene.transfer is not None:
        scene = on_jumps(scene, rng) if rng.integers(2) else on_means(scene, camera, samples, rng)
    if rng.integers(2) and scene.volume is not None:
        values = np.asarray(scene.volume.values)[:3].ravel()
        scene = dataclasses.replace(scene, volume_transfer=jumping(scene.volume_transfer, rng.choice(values, 2).mean(), rng))
    settings = kind.settings
    if settings.tolerance is not None:
        settings = dataclasses.replace(settings, tolerance=float(10 ** -rng.uniform(1, 5)))
    return scene, camera, settings


def sample_of(camera, samples, rng):
    """Where one of the samples lies in the world."""
    (u,), (v,) = ray_coordinates(camera, rng.integers(camera.width, size=1) + 0.5, rng.integers(camera.height, size=1) + 0.5)
    depth = rng.choice(js.reference.sample_depths(camera, samples))
    spread = depth if camera.is_perspective else 1
    return to_world(np.array([u * spread, v * spread, depth]), camera)


def through(clip, place, rng):
    """A clip of the same kind whose faces meet in a place, or pass through it."""
    if isinstance(clip, Both):
        return through(clip.first, place, rng) & through(clip.second, place, rng)
    if isinstance(clip, Outside):
        return ~through(clip.clip, place, rng)
    if isinstance(clip, js.Plane):
        return js.Plane(place, rng.normal(size=3) if rng.integers(2) else np.eye(3)[rng.integers(3)])
    if isinstance(clip, js.Box):
        return js.Box(place, place + rng.uniform(0.3, 2, 3))
    away = rng.normal(size=3)
    return clip if clip is None else js.Sphere(place + 0.7 * away / np.linalg.norm(away), 0.7)


def on_means(scene, camera, samples, rng):
    """The scene with a jump at the quantity of one of its samples."""
    weighted, weight, _ = js.reference.field(scene, camera, samples)
    if not (weight > 0).any():
        return scene
    mean = rng.choice(weighted[weight > 0] / weight[weight > 0])
    return dataclasses.replace(scene, transfer=jumping(scene.transfer, mean, rng))


def jumping(transfer, value, rng):
    """A transfer function of as many control points that jumps at a value, or next to it."""
    values = np.array(transfer.values)
    value = np.nextafter(values.dtype.type(value), values.dtype.type(rng.choice([-np.inf, value, np.inf])))
    if values.size > 1:
        nth = int(np.clip(np.searchsorted(values, value), 1, values.size - 1))
        values[nth - 1 : nth + 1] = value
        values.sort()
    return dataclasses.replace(transfer, values=jnp.asarray(values))


def on_jumps(scene, rng):
    """The scene with jumps, and quantities on control points or a rounding beside them, each side of a plane with its own."""
    particles, changed, points = scene.particles, {}, {}
    side = np.asarray(particles.position)[:, 0] > 0
    names = zip(("quantity", "extinction_quantity"), ("values", "extinction_values"), strict=True)
    for name, of_points in names:
        values = getattr(scene.transfer, of_points)
        if values is None or getattr(particles, name) is None:
            continue
        values = np.array(values)
        if values.size > 1:
            nth = rng.integers(1, values.size)
            values[nth - 1] = values[nth]
            values.sort()
        some = rng.choice(values, 2)
        quantity = np.where(side, *some) if rng.integers(2) else rng.choice(values, side.size)
        beside = np.nextafter(quantity, quantity.dtype.type(rng.choice([-np.inf, np.inf])))
        points[of_points] = jnp.asarray(values)
        changed[name] = jnp.asarray(np.where(rng.integers(2, size=side.size) * rng.integers(2) > 0, beside, quantity))
    transfer, particles = dataclasses.replace(scene.transfer, **points), dataclasses.replace(particles, **changed)
    return dataclasses.replace(scene, transfer=transfer, particles=particles)


def typed(dtype, leaf):
    leaf = np.asarray(leaf)
    return jnp.asarray(leaf, dtype if np.issubdtype(leaf.dtype, np.floating) else leaf.dtype)


@functools.partial(jax.jit, static_argnames=("plan", "derived"), compiler_options=QUICKLY)
def traced(inputs, settings, *, plan, derived):
    """The image, and the gradient of its light by all that floats."""

    def light(inputs):
        image = js.render(*inputs, settings, plan=plan)
        return image.color.sum() - image.transmittance.sum(), image

    if not derived:
        return light(inputs)[1], ()
    gradient, image = jax.grad(light, has_aux=True, allow_int=True)(inputs)
    return image, gradient


def check(kind, image, gradient, frame):
    """No NaN without a fault, values in their ranges, and no certified number that is more wrong than told."""
    scene, camera, settings = frame
    if int(image.faults):
        assert not image.certified
        return
    layers = [np.asarray(getattr(image, name), np.float64) for name in ("color", "transmittance")]
    for layer in layers:
        assert np.isfinite(layer).all() and layer.min() >= 0 and layer.max() <= 1 + 1e-5
    assert not np.isnan(np.asarray(image.depth)).any()
    for leaf in jax.tree.leaves(gradient):
        assert leaf.dtype == jax.dtypes.float0 or np.isfinite(np.asarray(leaf)).all()
    exact = settings.integrator_used == "samples" and scene.surface is None and not scene.media
    if not exact or not (image.certified or settings.tolerance is None):
        return
    truth = js.reference.render(scene, camera, settings)
    told = np.asarray(image.error_bound, np.float64) + (DOUBLE if kind.dtype is np.float64 else SINGLE)
    error = np.maximum(np.abs(layers[0] - truth.color).max(-1), np.abs(layers[1] - truth.transmittance))
    assert (error > told).sum() <= (0 if kind.dtype is np.float64 else max(1, FLIPPED * told.size)), (error - told).max()


def each_frame(kind, adversary, number=TRACED):
    """Eagerly, each with a plan of its own; and under `jit` with one of all."""
    frames, plan, derived = [drawn(kind, nth, adversary) for nth in range(EAGER + number)], None, True
    for frame in frames[:EAGER]:
        try:
            check(kind, js.render(*frame), (), frame)
        except ValueError as error:  # of supports over four decades, whose volumes are alike
            assert "the strengths volume / support^3 of the particles are too far apart" in str(error)
    for frame in frames[EAGER:]:
        plan = js.plan(*frame, like=plan, headroom=4)
    for frame in frames[EAGER:]:
        try:
            found = traced(frame[:2], frame[2], plan=plan, derived=derived)
        except NotImplementedError as error:
            assert derived and "`" in str(error)
            found = traced(frame[:2], frame[2], plan=plan, derived=(derived := False))
        check(kind, *found, frame)


def is_refused(kind, adversary):
    """Whether such a combination is, by name."""
    try:
        js.plan(*drawn(kind, 0, adversary))
    except (ValueError, NotImplementedError) as error:
        assert "`" in str(error)
        return True
    return False


@pytest.mark.parametrize("nth", range(KINDS))
def test_no_frame_raises_but_by_name_holds_nan_or_breaks_what_it_certifies(nth, adversary):
    night = hypothesis.settings().max_examples > EXAMPLES
    seeds, left = itertools.count(), AT_NIGHT if night else 1
    while left:
        kind = kind_of((TODAY, nth, next(seeds)), DRAWN if night else [one for one in DRAWN if one != SLOW])
        with jax.enable_x64(kind.dtype is np.float64):
            if not is_refused(kind, adversary):
                print(kind)
                each_frame(kind, adversary)
                left -= 1


def count_frames(adversary, seed, seconds, number):
    """Frames of kinds from a seed on, so many of each under `jit`, until the time is over; failures are told, and no end."""
    counts, end = collections.Counter(), time.monotonic() + seconds
    for nth in itertools.count():
        kind = kind_of((seed, nth), [one for one in DRAWN if one != SLOW])
        with jax.enable_x64(kind.dtype is np.float64):
            if time.monotonic() > end:
                return counts
            try:
                if is_refused(kind, adversary):
                    continue
                each_frame(kind, adversary, number)
            except Exception as error:
                print("FAILED", kind, type(error).__name__, error, flush=True)
        counts[kind.media, kind.clip, kind.settings.integrator, kind.dtype.__name__] += EAGER + number
        print(counts.total(), kind, flush=True)


if __name__ == "__main__":
    from conftest import Adversary, Frames

    print(*count_frames(Adversary(Frames()), *map(int, sys.argv[1:4])).items(), sep="\n")
