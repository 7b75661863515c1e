"""One table of what can be combined: media, clips, integrators, screens and kernels, and what is promised of each row.

In float64 a row's derivatives are alike in both modes and those of differences; its image is that of the reference, if that knows
it, and the same eagerly, under `jit` and under `vmap`; where nothing is in view it is finite; after a fault it claims nothing.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY, along, anywhere, looked, stepped, total
from images import error_of
from rows import HEIGHT, WIDTH, Row

import jaxsph as js

ALIKE = 1e-8  # of a slope's size: forward and reverse mode add up the same terms
DIFFERENCE = 1e-5  # and what differences make of it; of iso-surfaces, whose roots are found to a tolerance, 1e-3
OF_SURFACES = 1e-3
OF_TABLES = 1e-4  # profiles of points whose kinks no rule meets
STEP = 5e-7
OF_POINTS = 5e-8  # whose profiles are steep: what a difference misses grows with the square of its step
ROUNDING = 2.0**16 * np.finfo(np.float64).eps
DERIVATIVES, ALL_WAYS = "derivatives", "all ways"

TABLE = [
    Row("particles", quick=()),  # `test_gradients` holds its derivatives, in every direction
    Row("particles", "~sphere", "segments", quick=()),
    Row("particles", "plane & ~sphere", "samples", "quadtree", "wendland_c2"),
    Row("particles", "box", "segments", "quadtree", "cubic_spline"),
    Row("particles", "sphere", "samples", "pixels", "quintic_spline"),
    Row("particles", "plane", "segments", "pixels", "wendland_c6", projection="orthographic"),
    Row("two quantities", "plane", "samples", "pixels", "quartic_spline", projection="orthographic"),
    Row("two quantities", "plane & ~sphere", "segments", "pixels", "wendland_c4"),
    Row("two quantities", "everywhere", "segments", "quadtree", "poly6"),
    Row("volume", "box", "samples", "pixels", quick=(ALL_WAYS,)),
    Row("volume", "~sphere", "segments", "pixels"),
    Row("volume", "plane", "segments", "quadtree"),
    Row("points", "sphere", "segments", "pixels"),
    Row("points", "plane & ~sphere", "samples", "pixels", projection="orthographic", quick=(ALL_WAYS,)),
    Row("points", "everywhere", "samples", "quadtree"),
    Row("points", "box", "segments", "quadtree"),
    Row("feet", "sphere", "samples", "quadtree"),
    Row("feet", "box", "segments", "pixels"),
    Row("feet", "everywhere", "samples", "pixels"),
    Row("surface", "everywhere", "samples", "pixels", quick=(DERIVATIVES,)),
    Row("surface", "box", "segments", "pixels", projection="orthographic"),
    Row("surface", "~sphere", "samples", "quadtree"),
    Row("surface", "plane & ~sphere", "segments", "pixels"),
    Row("fluid", "plane", "samples", "pixels", "wendland_c2"),
    Row("fluid", "sphere", "segments", "pixels", projection="orthographic"),
    Row("fluid", "~sphere", "samples", "quadtree", "cubic_spline"),
    Row("all together", "everywhere", "samples", "pixels", "wendland_c2"),
    Row("all together", "plane & ~sphere", "segments", "pixels", "cubic_spline"),
    Row("all together", "sphere", "segments", "quadtree", "poly6"),
    Row("by opacity", "everywhere", "samples", "pixels"),
    Row("by opacity", "~sphere", "segments", "pixels", quick=(DERIVATIVES,)),  # volumes, particles, spans of a clip, segments
    Row("by opacity", "sphere", "segments", "pixels", "wendland_c6", projection="orthographic"),
    Row("fog", "everywhere", "samples", "pixels", "wendland_c2"),
    Row("periodic", "everywhere", "segments", "pixels", "wendland_c4"),
    Row("periodic", "box", "samples", "pixels", "cubic_spline", projection="orthographic"),
    Row("periodic", "~sphere", "segments", "quadtree", "quartic_spline"),
]


def rows(promise):
    """The table: quick where the row is the holder of a promise, else slow, as each takes up to two minutes."""
    marks = {False: [pytest.mark.slow], True: []}
    return [pytest.param(row, id=row.name, marks=marks[promise in row.quick]) for row in TABLE]


def figures(row, frames):
    """How far both modes are apart, and from differences, of the size of the slope; and what an empty view has."""
    plan, settings, rng = row.plan(frames), row.settings, np.random.default_rng(row.seed + 100)
    inputs, cotangent = jax.tree.map(np.asarray, row.inputs(frames)), rng.normal(size=(HEIGHT, WIDTH, 4))
    move = anywhere(inputs, rng)
    _, pushed, gradient = looked(inputs, move, cotangent, settings, plan)
    pulled, size = along(gradient, move)
    step = OF_POINTS if row.media in ("points", "feet") else STEP
    ahead, behind = (looked(stepped(inputs, move, by), move, cotangent, settings, plan)[0] for by in (step, -step))
    away = dataclasses.replace(inputs[1], eye=inputs[1].eye - 100 * inputs[1].axes[2])
    nothing, _, flat = looked((inputs[0], away), move, cotangent, settings, plan)
    fog = row.media == "fog"  # which is in every view
    return {
        "alike": abs(float(pushed) - pulled) / size,
        "difference": abs(float(ahead - behind) / (2 * step) - pulled) / size,
        "size": size,
        "empty": 0 if fog else float(nothing) - float(cotangent[..., 3].sum()),
        "finite": all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(flat) if leaf.dtype != jax.dtypes.float0),
    }


def check_figures(row, found):
    assert found["size"] > 1e-2
    assert found["alike"] <= ALIKE
    assert found["difference"] <= (OF_SURFACES if row.media in ("surface", "fluid", "all together") else DIFFERENCE)
    assert abs(found["empty"]) <= ROUNDING and found["finite"]


@pytest.mark.parametrize("row", rows(DERIVATIVES))
def test_both_modes_are_alike_and_those_of_differences_and_an_empty_view_is_finite(row, frames, x64):
    check_figures(row, figures(row, frames))


def ways(row, frames):
    """How far images under `jit` and `vmap` are from eager ones, and what an image with a fault claims beside one without."""
    plan, settings = row.plan(frames), row.settings
    both = [row.inputs(frames, row.seed + more) for more in (0, 1)]
    draw = jax.jit(lambda given: js.render(*given, settings, plan=plan), compiler_options=QUICKLY)
    batch = jax.jit(jax.vmap(lambda given: js.render(*given, settings, plan=plan)), compiler_options=QUICKLY)
    together, one = batch(_stacked(*both)), draw(both[0])
    eager = [js.render(*given, settings, plan=plan) for given in both]
    scene, camera = both[1]
    bad = batch(_stacked(both[0], (scene, dataclasses.replace(camera, half_height=jnp.nan * camera.half_height))))
    truth = row.truth(frames) and js.reference.render(*row.truth(frames), settings)
    return {
        "jit": error_of(one, eager[0]).max(),
        "vmap": max(error_of(together[nth], eager[nth]).max() for nth in (0, 1)),
        "shown": float(np.ptp(eager[0].color)),
        "alone": int(bad.faults[0]) == 0 and bool(bad.certified[0]) == eager[0].certified,
        "disclaimed": int(bad.faults[1]) != 0 and not bad.certified[1] and bool((np.asarray(bad.error_bound)[1] == 1).all()),
        "still finite": bool(np.isfinite(np.asarray(bad.color)).all()),
        "reference": 0 if truth is None else error_of(eager[0], truth).max(),
    }


def _stacked(first, second):
    return jax.tree.map(lambda a, b: np.stack([a, b]), first, second)


@pytest.mark.parametrize("row", rows(ALL_WAYS))
def test_images_are_those_of_the_reference_eagerly_and_under_jit_and_vmap_and_a_fault_disclaims_its_own_alone(
    row, frames, x64, quick_programs
):
    found = ways(row, frames)
    assert found["shown"] > 0.05
    assert found["jit"] <= ROUNDING and found["vmap"] <= ROUNDING
    assert found["reference"] <= (OF_TABLES if row.media in ("points", "feet") else ALIKE)
    assert found["alone"] and found["disclaimed"] and found["still finite"]


def test_reverse_mode_is_forward_mode_in_programs_that_are_optimised(frames, x64):
    """At default options: XLA's optimiser got what passes between spans of a clip wrong, and only there."""
    row = Row("particles", "~sphere", "segments")
    scene, camera = row.inputs(frames)
    small = dataclasses.replace(camera, width=4, height=4)
    settings = dataclasses.replace(row.settings, samples=8)
    plan = js.plan(scene, small, settings)
    cotangent = jnp.asarray(np.random.default_rng(1).normal(size=(4, 4, 4)))

    def of(radius):
        sphere = dataclasses.replace(scene.within.clip, radius=radius)
        return total((dataclasses.replace(scene, within=~sphere), small), cotangent, settings, plan)

    radius = scene.within.clip.radius
    pushed = jax.jit(lambda r: jax.jvp(of, (r,), (jnp.ones_like(r),))[1], compiler_options=QUICKLY)(radius)
    pulled = jax.jit(jax.grad(of))(radius)
    assert abs(float(pushed)) > 1e-2
    assert float(pulled) == pytest.approx(float(pushed), rel=ALIKE)
