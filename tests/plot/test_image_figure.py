"""Pictures with a key: the picture's own pixels, colours of the bar that are those of the picture, lengths that are right."""

import dataclasses
import io
import itertools
import subprocess
import sys

import numpy as np
import pytest
from lookups import look_up as looked_up

import jaxsph as js
from jaxsph.io.table import LENGTH, CodeUnit
from jaxsph.model.preview.glimpse import extinction_at
from jaxsph.model.projection import Projection
from jaxsph.plot.bars import Axis, measured, raised, symbol
from jaxsph.plot.image_figure import draw_arrows, image_figure

pytest.importorskip("matplotlib")
from matplotlib.figure import Figure

LOOK = js.TransferFunction.from_colormap("viridis", (0, 1), [200, 200])
CAMERA = js.Camera.orthographic((1, 0.5, -3), (1, 0.5, 0.5), view_height=1.5, width=200, height=100, near=2.5, far=4.5)


def ramp(values=None, transfer=LOOK):
    """An opaque volume whose quantity rises from left to right in the picture, and that scene's image."""
    rising = np.linspace(1, 0, 17) if values is None else values
    volume = js.Volume.from_array((rising[:, None, None] * np.ones((17, 2, 2))).astype(np.float32), (0, 0, 0), (2 / 16, 1, 1))
    scene = js.Scene(volume=volume, volume_transfer=transfer)
    return scene, js.reference.render(scene, CAMERA, js.Settings(samples=24))


def pixels(figure):
    from PIL import Image

    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return np.asarray(Image.open(buffer).convert("RGB")).astype(int)


def bar_of(figure):
    return figure.axes[1]


def place_of(figure, number=0):
    """Dots from left to right and from top to bottom that axes take."""
    box, height = figure.axes[number].get_window_extent(), round(figure.bbox.height)
    x0, x1, y0, y1 = (round(one) for one in (box.x0, box.x1, height - box.y1, height - box.y0))
    return np.s_[y0:y1, x0:x1]


SIZES = [(64, 48), (200, 100), (96, 300), (300, 20), (20, 300), (512, 512)]


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("style", [{}, {"axes": True, "font_size": 14, "title": "a long title " * 9}], ids=["bar", "axes"])
def test_a_pixel_is_a_square_of_dots_the_bar_is_as_high_as_the_picture_and_nothing_is_cut_off(size, style):
    width, height = size
    camera = js.Camera.orthographic((1, 0.5, -3), (1, 0.5, 0.5), view_height=1.5, width=width, height=height, near=2, far=4)
    values = np.random.default_rng(1).uniform(1, 2e5, (height, width))
    metadata = (("jaxsph.camera", camera.describe()),) if style else ()  # a scale bar would lie over pixels
    made = Projection(values, None, np.float64(1), False, name="column.mass", unit="Msun/pc**2", metadata=metadata)
    figure = made.figure(**style)
    found, place = pixels(figure), place_of(figure)
    dots = (place[0].stop - place[0].start) // height
    np.testing.assert_array_equal(found[place], np.kron(made.to_uint8(), np.ones((dots, dots, 1), int)))
    bar, picture = (axes.get_window_extent() for axes in (figure.axes[1], figure.axes[0]))
    upright = bar.height > bar.width
    one, other = ((box.y0, box.y1) if upright else (box.x0, box.x1) for box in (bar, picture))
    assert one == pytest.approx(other) and figure.dpi >= 150
    edge = np.concatenate([found[0], found[-1], found[:, 0], found[:, -1]])
    label = figure.axes[1].get_ylabel() + figure.axes[1].get_xlabel()
    assert (edge == 255).all() and label.replace("\n", " ") == r"$\Sigma$ ($10^{5}$ $\mathrm{M}_{\odot}$ pc$^{-2}$)"


@pytest.mark.parametrize("share", [0.1, 0.37, 0.5, 0.8])
def test_a_colour_of_the_bar_is_that_of_an_opaque_place_of_its_value(share):
    scene, image = ramp()
    figure = image.figure(scene)
    found = pixels(figure)
    extent = bar_of(figure).get_window_extent()
    row = round(found.shape[0] - (extent.y0 + share * extent.height) - 0.5)
    of_bar = found[row, round((extent.x0 + extent.x1) / 2)]
    right = np.asarray(CAMERA.axes)[0, 0]  # the picture's x runs against the world's here
    x = (1 - share) * 2
    column = int(100 + right * (x - 1) * 100 / 1.5)
    # a row of the bar and a column of the picture are steps
    assert np.abs(of_bar - image.to_uint8()[50, column].astype(int)).max() <= 6


@pytest.mark.parametrize("domain", ["linear", "log", "symlog", "equalised"])
def test_the_bar_spans_the_control_points_on_their_scale(domain):
    values = np.geomspace(1e-3, 10, 17)
    look = js.TransferFunction.from_colormap(
        "viridis", js.TransferFunction.control_values(domain, values, low=1e-3, high=10), 100.0
    )
    scene, image = ramp(values, look)
    axes = bar_of(image.figure(scene, labels="density"))
    assert axes.get_ylim() == pytest.approx((1e-3, 10), rel=1e-5)
    marks = axes.transData.transform([(0.5, value) for value in np.asarray(look.values)])
    places = axes.transAxes.inverted().transform(marks)[:, 1]
    np.testing.assert_allclose(places, np.linspace(0, 1, 16), atol=1e-4)
    assert axes.get_ylabel().replace("\n", " ") == r"$\rho$ (code units)"


def test_a_logarithmic_quantity_has_its_own_values_on_the_bar():
    look = js.TransferFunction.from_colormap("viridis", (-3, 1), 100.0)
    axis = Axis(look, "log10:Density", "g cm^-3", 2.0)
    assert axis.scale.name == "log" and axis.title.startswith(r"$\rho$ (g cm$^")
    np.testing.assert_allclose(axis.scale.values[[0, -1]], [2e-3, 20], rtol=1e-6)
    np.testing.assert_allclose(axis.colors(np.array([2e-3, 0.2, 20])), looked_up(look, np.array([-3.0, -1, 1]))[0], atol=1e-6)


def test_a_figure_shows_the_transfer_function_jumps_and_control_points_of_extinction_included():
    jumps = js.TransferFunction.from_points([0, 1, 1, 2], [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], [0, 1, 5, 2])
    apart = js.TransferFunction.from_points([0, 1], [(0, 0, 0), (1, 0, 0)], [0, 4, 1], extinction_values=[0, 0.5, 2])
    asked = np.array([-1, 0, 0.25, 0.5, 0.999, 1, 1.5, 2, 3, 9])
    for made in (jumps, apart):
        for own, theirs in zip((Axis(made).colors(asked), extinction_at(made, asked)), looked_up(made, asked), strict=True):
            np.testing.assert_allclose(own, theirs, atol=1e-6)


def texts(figure):
    return [text.get_text() for text in figure.axes[0].texts]


def test_the_scale_bar_is_as_long_as_it_says():
    scene, image = ramp()
    figure = image.figure(scene, CAMERA, triad=False)
    assert length_of(figure) == pytest.approx(0.5 * 100 / 1.5, rel=1e-6)
    assert texts(figure) == ["0.5 code units"]


def length_of(figure):
    """Pixels that the scale bar is long."""
    (line,) = figure.axes[0].lines
    drawn = np.ptp(line.get_transform().transform(line.get_xydata())[:, 0])
    return drawn / figure.axes[0].get_window_extent().width * np.shape(figure.axes[0].get_images()[0].get_array())[1]


@pytest.mark.parametrize("background", ["white", "black"])
def test_letters_stand_out_from_what_is_behind_the_picture(background):
    scene, image = ramp()
    bare = dataclasses.replace(image, color=np.zeros_like(image.color), transmittance=np.ones_like(image.transmittance))
    shown = dataclasses.replace(bare, color=bare.over(background))
    text = shown.figure(scene, CAMERA).axes[0].texts[-1]
    assert text.get_color() == ("#000000" if background == "white" else "#ffffff")


def test_an_axis_along_the_line_of_sight_is_not_drawn_and_nothing_has_no_empty_unit():
    scene, image = ramp()
    assert {"$x$", "$y$"} == set(texts(image.figure(scene, CAMERA, font_size=6))) & {f"${name}$" for name in "xyz"}
    assert Axis(LOOK, "Temperature", "").title == "$T$"


def test_a_perspective_scale_bar_says_where_it_holds():
    scene, _ = ramp()
    camera = js.Camera.look_at((1, 0.5, -3), (1, 0.5, 0.5), width=40, height=20, near=2.5, far=4.5)
    image = js.reference.render(scene, camera, js.Settings(samples=8))
    assert "at mid depth" in texts(image.figure(scene, camera))
    figure = image.figure(scene, camera, target=(1, 0.5, 1), triad=False)
    pixels_per_length = 20 / (2 * np.tan(np.radians(22.5)) * 4)
    length = float(texts(figure)[0].split()[0])
    assert "at the target" in texts(figure)
    assert length_of(figure) == pytest.approx(length * pixels_per_length, rel=1e-5)


def test_labels_are_said_in_the_units_that_files_state():
    pytest.importorskip("unyt")
    scene, image = ramp()
    labels = js.io.Labels("p", "erg cm^-3", 10.0, CodeUnit(3.0857e21, LENGTH), None, "t = 3 Myr")
    figure = image.figure(scene, CAMERA, labels=labels)
    assert "500 pc" in texts(figure) and "$t$ = 3 Myr" in texts(figure)
    assert bar_of(figure).get_ylim() == pytest.approx((0, 10)) and raised("cm^-3") in bar_of(figure).get_ylabel()


def test_several_volumes_have_bars_side_by_side_that_are_not_clipped():
    scene, image = ramp()
    other = js.TransferFunction.from_colormap("heat", (0, 123456.0), 1.0)
    both = js.Scene(volume=scene.volumes[0][0], volume_transfer=LOOK)
    both = js.Scene(volume=(both.volume, both.volume), volume_transfer=(LOOK, other))
    figure = image.figure(both, labels="a long name of a quantity that takes two lines")
    figure.canvas.draw()
    extents = [axes.get_tightbbox() for axes in figure.axes]
    assert len(extents) == 3 and all(one.x1 <= other.x0 for one, other in itertools.pairwise(extents))
    assert extents[2].x1 <= figure.get_size_inches()[0] * figure.dpi


def projection(values, name="mean.velocity.los", unit="km/s", camera=CAMERA):
    return Projection(
        values, values, np.float64(1), False, name=name, unit=unit, metadata=(("jaxsph.camera", camera.describe()),)
    )


def test_values_of_both_signs_are_even_about_zero_in_colours_that_diverge():
    rising = np.linspace(-2, 5, 20000).reshape(100, 200)
    assert projection(rising).span() == (False, pytest.approx((-5, 5), rel=0.01))
    np.testing.assert_array_equal(projection(rising).to_uint8(), projection(rising).to_uint8("coolwarm"))
    np.testing.assert_array_equal(projection(rising + 3).to_uint8(), projection(rising + 3).to_uint8("viridis"))
    low, high = bar_of(projection(rising).figure()).get_ylim()
    assert low == -high


@pytest.mark.parametrize("name", ["mean.velocity.los", "mean.a_name_that_is_very_long*Another_one_that_is_no_shorter"])
def test_a_wide_picture_is_as_wide_as_a_column_and_long_names_are_in_lines(name):
    camera = dataclasses.replace(CAMERA, width=200, height=50)
    figure = projection(np.linspace(1, 5, 10000).reshape(50, 200), name, camera=camera).figure(title=r"a $\Sigma / v$ " * 9)
    figure.canvas.draw()
    assert 3.3 < figure.get_size_inches()[0] < 3.5 and bar_of(figure).get_window_extent().width > 3.2 * figure.dpi


def test_a_narrow_range_has_round_ticks():
    for norm in ("linear", "log"):
        axis = bar_of(projection(np.linspace(1.1e4, 1.21e4, 20000).reshape(100, 200)).figure(norm=norm)).yaxis
        ticks = axis.get_ticklocs()
        assert 3 <= len(ticks) <= 7 and np.ptp(np.diff(ticks)) < 1e-6 and ticks[0] % 50 < 1e-6
        assert [float(text.get_text()) for text in axis.get_ticklabels()] == pytest.approx(ticks / 1e4)
    labels = bar_of(projection(np.linspace(80, 3000, 20000).reshape(100, 200)).figure(norm="log")).yaxis.get_ticklabels()
    assert {"500", "2000"} <= {text.get_text() for text in labels}


def test_names_of_axes_along_one_line_stand_apart():
    camera = js.Camera.orthographic((1, 2, -3), (1, 0.5, 0.5), view_height=1.5, width=200, height=100, near=2.5, far=4.5)
    figure = projection(np.ones((100, 200)), camera=camera).figure()
    figure.canvas.draw()
    shown = [text.get_window_extent() for text in figure.axes[0].texts if text.get_text() in ("$x$", "$y$", "$z$")]
    assert len(shown) == 3 and not any(one.overlaps(other) for one, other in itertools.combinations(shown, 2))


def test_more_dots_than_memory_holds_are_refused_by_what_they_would_make():
    with pytest.raises(ValueError, match=r"`dpi` must be at most 4800, got 100000: .* 340,000 pixels wide"):
        projection(np.ones((100, 200))).figure(dpi=100000)


def test_a_camera_of_another_size_and_a_target_behind_the_eye_are_refused():
    scene, image = ramp()
    with pytest.raises(ValueError, match="200 x 100"):
        image.figure(scene, js.Camera.framing(scene.volumes[0][0], width=20, height=20))
    camera = js.Camera.framing(scene.volumes[0][0], width=200, height=100)
    with pytest.raises(ValueError, match="not ahead"):
        image.figure(scene, camera, target=2 * camera.exact_eye())


@pytest.mark.parametrize(
    ("name", "written"),
    [
        ("column.mass", r"$\Sigma$"), ("column.number", "$N$"), ("mean.Temperature", r"$\langle$$T$$\rangle$"),
        ("velocity.los", r"$v_\mathrm{los}$"), ("Velocities.x", "$v_x$"), ("InternalEnergy", "$u$"), ("rho", r"$\rho$"),
        ("Masses*Density", r"$m$ $\rho$"), ("T_dust$", r"T dust\$"), ("mean.x", r"$\langle$$x$$\rangle$"),
    ],
)  # fmt: skip
def test_quantities_have_symbols_where_they_have_one(name, written):
    assert symbol(name) == written


@pytest.mark.parametrize(
    ("unit", "written"),
    [
        ("Msun/pc**2", r"$\mathrm{M}_{\odot}$ pc$^{-2}$"), ("kpc a h^-1", "$h^{-1}$ ckpc"), ("km/s", "km s$^{-1}$"),
        ("msun/pc^2", r"$\mathrm{M}_{\odot}$ pc$^{-2}$"),
        ("g/(cm)**2", "g cm$^{-2}$"), ("g*cm**(-1/2)", "g cm$^{-1/2}$"),
        ("g cm^-3 h^2 a^-3", "$h^{2}$ $a^{-3}$ g cm$^{-3}$"), ("code units", "code units"),
    ],
)  # fmt: skip
def test_units_are_written_as_papers_have_them(unit, written):
    assert raised(unit) == written
    assert measured(0.1, unit) == f"0.1 {written}" and measured(1, "code units") == "1 code unit"


def test_panels_share_a_norm_and_a_bar_and_contours_lie_where_their_values_are():
    x = np.linspace(1, 9, 40) * np.ones((30, 1))
    one, other = (Projection(x * k, None, np.float64(1), False, name="mean.T", unit="K") for k in (1, 10))
    figure = image_figure([one, other], title=["a", "b"], contours=(x, [5.0]), norm="linear")
    assert len(figure.axes) == 3 and [axes.texts[-1].get_text() for axes in figure.axes[:2]] == ["a", "b"]
    beside = image_figure([one, other], camera=dataclasses.replace(CAMERA, width=40, height=30), title=["a", "b"])
    assert [axes.texts[-1].get_text() for axes in beside.axes[:2]] == ["a", "b"]  # as high, whatever else the first says
    low, high = figure.axes[2].get_ylim()
    assert low < 9 and high > 80
    (line,) = figure.axes[0].collections[0].get_paths()
    np.testing.assert_allclose(line.vertices[:, 0], 20, atol=1e-6)
    with pytest.raises(ValueError, match="of one size"):
        image_figure([one, dataclasses.replace(other, values=x[1:])])
    with pytest.raises(ValueError, match="font_size"):
        one.figure(fontsize=3)


def test_a_file_has_its_text_as_text_the_picture_in_its_own_pixels_and_holes_where_there_is_nothing(tmp_path):
    values = np.where(np.eye(50), np.nan, 1 + np.arange(50.0))
    figure = Projection(values, values, np.float64(1), False, name="mean.T", unit="K").figure(background="transparent")
    for suffix in ("pdf", "svg", "png"):
        figure.savefig(tmp_path / f"a.{suffix}")
    pdf, svg = (tmp_path / "a.pdf").read_bytes(), (tmp_path / "a.svg").read_text()
    assert b"/Width 50 /Height 50" in pdf and b"CIDFontType2" in pdf and b"/Type3" not in pdf and "<text" in svg
    from PIL import Image

    found = np.asarray(Image.open(tmp_path / "a.png"))[place_of(figure)]
    dots = len(found) // 50
    assert (found[dots // 2 :: dots, dots // 2 :: dots, 3] == np.where(np.eye(50), 0, 255)).all()


def test_figures_need_no_display_and_leave_pyplot_alone():
    code = (
        "import sys, numpy as np, jaxsph as js\n"
        "layer = np.ones((20, 30))\n"
        "image = js.Image(np.zeros((20, 30, 3)), layer, layer, layer, layer, True, 0, {})\n"
        "image.figure(labels='x'); js.TransferFunction.from_colormap('heat', (0, 1)).figure()\n"
        "assert 'matplotlib.figure' in sys.modules and 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def axes(extent=(-3, 3, -2, 2)):
    made = Figure().subplots()
    made.imshow(np.zeros((4, 6)), extent=extent)
    return made


def test_arrows_stand_in_the_middle_of_cells_and_the_first_row_is_the_top():
    shown, right, up = axes(), np.full((2, 3), 1.0), np.zeros((2, 3))
    up[0] = 2.0
    draw_arrows([shown], right[None], up[None], "velocity", "km/s")
    quiver = next(one for one in shown.collections if hasattr(one, "U"))
    np.testing.assert_allclose(quiver.XY[:3], [[-2, 1], [0, 1], [2, 1]])
    np.testing.assert_allclose((quiver.U[:3], quiver.V[:3]), (np.ones(3), np.full(3, 2.0)))
    np.testing.assert_allclose(quiver.V[3:], 0)
    assert 0.9 < np.hypot(1, 2) / quiver.scale * 3 < 1.4 and quiver.scale_units == "width"


def test_the_key_has_the_name_a_round_length_and_the_unit():
    shown, other = axes(), axes()
    draw_arrows([shown, other], np.multiply.outer([1.0, 1234.0], np.ones((2, 2))), np.zeros((2, 2, 2)), "velocity", "km/s")
    key = next(one for one in shown.artists if hasattr(one, "label"))
    assert key.label == "$v$, 1000 km s$^{-1}$" and key.U == 1000 and not other.artists
    slow, fast = (next(one for one in panel.collections if hasattr(one, "U")) for panel in (shown, other))
    assert slow.scale == fast.scale and key.X + key.U / slow.scale < 1  # of one scale, whose key is inside


@pytest.mark.parametrize("nothing", [0.0, np.nan])
def test_where_nothing_moves_there_are_none(nothing):
    shown = axes()
    draw_arrows([shown], np.full((1, 2, 2), nothing), np.full((1, 2, 2), nothing), "velocity")
    assert not shown.collections


def test_symlog_has_both_signs_as_far_from_the_middle():
    values = np.array([[-1e4, -10.0, -1.0, 0.0, 1.0, 10.0, 1e4, 1e2]])
    pixels = projection(values).image("gray", "symlog").color[0, :7, 0]
    np.testing.assert_allclose(pixels + pixels[::-1], 2 * pixels[3], atol=1e-6)
    assert (np.diff(pixels) > 0.02)[[0, 1, 4, 5]].all()
    low, high = bar_of(projection(np.resize(values, (100, 200))).figure(norm="symlog")).get_ylim()
    assert low == -high
