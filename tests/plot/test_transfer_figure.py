"""Figures of transfer functions: the function as it is, over bars in the colours of what is seen."""

import numpy as np
import pytest

import jaxsph as js

pytest.importorskip("matplotlib")
LOOK = js.TransferFunction.from_colormap("viridis", js.TransferFunction.control_values("log", low=0.01, high=100), [0, 1, 4])
CAMERA = js.Camera.orthographic((0.5, 0.5, -2), (0.5, 0.5, 0), view_height=0.5, width=6, height=6, near=1.0, far=5.0)


def scene(transfer=LOOK):
    volume = js.Volume.from_array(np.full((2, 2, 2), 3.0, np.float32), (0, 0, 0), 1.0)
    return js.Scene(volume=volume, volume_transfer=transfer)


def test_extinction_is_drawn_as_it_is_and_the_axis_is_that_of_the_control_points():
    figure = LOOK.figure(labels="density")
    upper, strip = figure.axes
    x, y = upper.lines[0].get_data()
    np.testing.assert_allclose(y, np.interp(x, np.asarray(LOOK.values), np.asarray(LOOK.extinction)), rtol=1e-6)
    assert strip.get_xscale() == "log" and strip.get_xlabel() == r"$\rho$ (code units)"


def test_bars_are_shares_of_what_is_absorbed_in_the_colours_of_their_values():
    figure = LOOK.figure(scene(), CAMERA, bins=40)
    bars = figure.axes[0].patches
    heights = np.array([bar.get_height() for bar in bars[:40]])
    (seen,) = np.flatnonzero(heights)
    assert heights[seen] == pytest.approx(1)
    middle = bars[seen].get_x() + bars[seen].get_width() / 2
    wanted = [np.interp(middle, np.asarray(LOOK.values), channel) for channel in np.asarray(LOOK.colors).T]
    np.testing.assert_allclose(bars[seen].get_facecolor()[:3], wanted, atol=1e-3)
    assert bars[seen].get_x() <= 3 <= bars[seen].get_x() + bars[seen].get_width()


def test_another_function_is_drawn_over_what_it_would_show():
    other = js.TransferFunction.from_colormap("heat", (0, 4), 0.0)
    heights = [bar.get_height() for bar in other.figure(scene(), CAMERA, bins=8).axes[0].patches[:8]]
    assert heights == [0.0] * 8


def test_nothing_is_clipped_at_the_edges():
    figure = LOOK.figure(scene(), CAMERA, labels="a quantity", title="title")
    figure.canvas.draw()
    whole = figure.bbox
    for axes in figure.axes:
        extent = axes.get_tightbbox()
        assert extent.x0 >= whole.x0 and extent.x1 <= whole.x1 and extent.y0 >= whole.y0 and extent.y1 <= whole.y1


def test_extinction_by_a_quantity_of_its_own_has_an_axis_of_its_own():
    look = js.TransferFunction.from_points([0, 1], [(0, 0, 0), (1, 1, 1)], [0, 1, 9], extinction_values=[-3, -1, 1])
    position = np.random.default_rng(0).random((20, 3)).astype(np.float32)
    particles = js.Particles.from_arrays(position, 0.4, (position[:, 0], 4 * position[:, 1] - 3))
    labels = js.io.Labels("temperature", opacity="log10:density")
    figure = look.figure(js.Scene(particles=particles, transfer=look), CAMERA, labels=labels)
    (own,) = [axes for axes in figure.axes if axes.get_xlabel().startswith(r"extinction by $\rho$")]
    x, y = own.lines[0].get_data()
    np.testing.assert_allclose(y, np.interp(np.log10(x), [-3, -1, 1], [0, 1, 9]), atol=1e-6)
    assert own.get_xscale() == "log" and own.get_xlim() == pytest.approx((1e-3, 10))


def test_a_scene_without_a_camera_or_without_a_quantity_is_refused():
    with pytest.raises(ValueError, match="go together"):
        LOOK.figure(scene())
    points = js.Points.from_arrays(np.zeros((1, 3), np.float32), 0.5, (1, 1, 1), opacity=0.5)
    with pytest.raises(ValueError, match="particles or a volume"):
        LOOK.figure(js.Scene(points=points), CAMERA)
