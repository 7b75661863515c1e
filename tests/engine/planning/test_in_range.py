"""Looks that a step of an optimiser has led out of range: taken back, said beyond rounding, and never without derivatives."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from derivatives import QUICKLY

import jaxsph as js
from jaxsph.engine.planning.viewing import scene_in_range
from jaxsph.numerics import faults

TRANSFER = js.TransferFunction.from_points([0.0, 0.5, 1.0], [[1, 0, 0], [0, 1, 0], [0, 0.5, 1]], [0.0, 2.0, 1.0])
POINTS = js.Points.from_arrays([[0.0, 0, 0]], 1.0, [1.0, 0.5, 0.0], 2.0)
ULP = float(np.finfo(np.float32).eps)
in_range = jax.jit(scene_in_range)


def moved(field, step, of=TRANSFER):
    return dataclasses.replace(of, **{field: np.asarray(getattr(of, field)) + np.float32(step)})


@pytest.mark.parametrize(
    ("scene", "off"),
    [
        (js.Scene(transfer=TRANSFER, points=POINTS), False),
        (js.Scene(transfer=moved("colors", ULP)), False),
        (js.Scene(transfer=moved("colors", 1e-3)), True),
        (js.Scene(transfer=moved("colors", -1e-3)), True),
        (js.Scene(transfer=moved("extinction", -ULP)), False),
        (js.Scene(transfer=moved("extinction", -1e-3)), True),
        (js.Scene(transfer=moved("values", [0.0, 0.6, 0.0])), True),
        (js.Scene(volume_transfer=(TRANSFER, moved("colors", 1.0))), True),
        (js.Scene(points=moved("color", 0.1, POINTS)), True),
        (js.Scene(points=moved("color", ULP, POINTS)), False),
    ],
)
def test_what_is_off_by_more_than_rounding_is_a_fault_and_all_is_taken_back(scene, off):
    kept, word = jax.tree.map(np.asarray, in_range(scene))
    assert int(word) == (faults.CLIPPED_LOOK if off else 0)
    for look in jax.tree.leaves(
        (kept.transfer, kept.volume_transfer), is_leaf=lambda leaf: isinstance(leaf, js.TransferFunction)
    ):
        assert ((look.colors >= 0) & (look.colors <= 1)).all() and (look.extinction >= 0).all()
        assert (np.diff(look.values) >= 0).all()
    if kept.points is not None:
        assert np.asarray(kept.points.usable())[0] and kept.points.color.max() <= 1


def test_in_range_not_a_bit_changes():
    kept, _ = in_range(js.Scene(transfer=TRANSFER, points=POINTS))
    jax.tree.map(np.testing.assert_array_equal, (kept.transfer, kept.points), (TRANSFER, POINTS))


@pytest.mark.parametrize("field", ["colors", "extinction", "values"])
def test_derivatives_pass_where_numbers_are_taken_back(field):
    def total(step):
        way = np.float32([3.0, -3.0, 3.0]).reshape(-1, *[1] * (field == "colors"))
        transfer = dataclasses.replace(TRANSFER, **{field: getattr(TRANSFER, field) + step * way})
        return getattr(scene_in_range(js.Scene(transfer=transfer))[0].transfer, field).sum()

    assert float(jax.jit(jax.grad(total))(1.0)) == pytest.approx(9.0 if field == "colors" else 3.0)


def test_nan_stays_nan_and_is_not_hidden():
    kept, _ = in_range(js.Scene(transfer=moved("extinction", np.nan)))
    assert np.isnan(kept.transfer.extinction).all()


def test_an_optimiser_finds_back_from_beyond_the_range(frames):
    """Adam without any constraint, as it is first tried: steps lead beyond 1 and below 0, and the loss falls all the same."""
    optax = pytest.importorskip("optax")
    rng = np.random.default_rng(0)
    scene, camera, plan = frames.scene(rng), frames.camera(rng), frames.plan()
    look = js.TransferFunction.from_points(scene.transfer.values, np.eye(5, 3), np.linspace(0.5, 2, 5))

    def draw(colors, extinction):
        transfer = js.TransferFunction.from_points(look.values, colors, extinction)
        return js.render(dataclasses.replace(scene, transfer=transfer), camera, frames.settings, plan=plan).color

    def loss(found, target):
        color = draw(*found)
        return ((color - target) ** 2).mean(), color

    @functools.partial(jax.jit, compiler_options=QUICKLY)
    def stepped(found, state, target):
        (value, color), slope = jax.value_and_grad(loss, has_aux=True)(found, target)
        change, state = adam.update(slope, state)
        return optax.apply_updates(found, change), state, value, color, slope

    adam, found = optax.adam(0.05), (np.full((5, 3), 0.5, np.float32), np.full(5, 0.3, np.float32))
    state, losses, outside = adam.init(found), [], False
    target = stepped((look.colors, look.extinction), state, np.zeros((frames.height, frames.width, 3), np.float32))[3]
    for _ in range(200):
        outside |= bool((np.asarray(found[0]) > 1).any() or (np.asarray(found[0]) < 0).any())
        found, state, value, _, slope = stepped(found, state, target)
        losses.append(float(value))
        assert any(np.asarray(leaf).any() for leaf in slope)
    assert outside and losses[-1] < losses[0] / 20


@pytest.mark.parametrize(("colors", "extinction"), [(1 + ULP, 1.0), (-ULP, 1.0), (0.5, -1e-8)])
def test_rounding_is_taken_back_where_a_transfer_function_is_made(colors, extinction):
    made = js.TransferFunction.from_points([0.0, 1.0], np.full((2, 3), colors, np.float32), [extinction, 1.0])
    colors = np.asarray(made.colors)
    assert colors.min() >= 0 and colors.max() <= 1 and np.asarray(made.extinction).min() >= 0
