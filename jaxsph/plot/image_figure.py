"""Pictures as figures of a journal: a thin frame, colour bars, lengths, the time; and arrows and contours over a picture.

Flow: Image, Slice or Projection, scene, camera, labels -> [image_figure] -> figure of matplotlib's.

Each pixel of a picture is a square of a whole number of dots, in the colours of the PNG without a key, under what is drawn over
it; in PDF and SVG it is a pixel of an image. Around the picture there is as much room as letters take.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsph.analysis.slices import Slice
from jaxsph.io.damage import require
from jaxsph.io.units import CODE_UNITS, Labels, labels_said
from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.framing import with_depths
from jaxsph.model.image import Image
from jaxsph.model.projection import Projection, suited
from jaxsph.model.scene import Scene
from jaxsph.plot.bars import STEPS, STYLE, Axis, canvas, in_lines, measured, symbol
from jaxsph.plot.places import DARK, anchor, bordered, described, frame_of, ink_of, picture_of, pixels_per_length, round_length

COLUMN, PAGE, TALLEST = 3.4, 7.1, 7.0  # inches: of a figure in one column, or of panels on two, and how tall it may be
MOST_DOTS = 4800  # an inch
MIN_INCHES = 0.5  # of a picture's side
AROUND, TICKED = 6.5, 3.5  # letters that a colour bar takes, and ticks and label of an axis
BESIDE = 1.0  # inches: colour bars of pictures less tall lie above them
PAD = 0.25  # letters around all there is
LINE, GAP, WIDE = 0.6, 0.55, 1.1  # points of a line; letters between a picture and its colour bar, and of the bar's width
HALO = 0.16  # letters: twice the border that sets letters and lines off from a picture
LONGEST_BAR = 0.3  # of the picture's width
ROOMY = 8.0  # letters that a picture is high and wide where there is room for directions of axes
ALONG = 0.3  # of its length: an axis that seems shorter points along the line of sight
LONG, CELLS = 95, 1.3  # percentile of lengths that is drawn so many cells of the lattice long


class Style(NamedTuple):
    """How a figure is made; see `image_figure`."""

    font_size: float = 8.0
    dpi: float = 150.0
    background: Any = None
    transfer: Any = None
    colormap: str | None = None
    norm: str | None = None
    range: tuple[float, float] | None = None
    contours: tuple[Any, Any] | None = None


def image_figure(
    image: Image | Slice | Projection | Sequence[Any],
    scene: Scene | None = None,
    camera: Camera | None = None,
    *,
    labels: Labels | str | None = None,
    target: Any = None,
    axes: bool = False,
    triad: bool = True,
    title: str | Sequence[str] = "",
    **style: Any,
) -> Any:
    """Draw a picture with its key, as wide as a column of a journal; several as panels, of one norm and with one colour bar.

    The colour bar of a render shows the colours of the transfer function alone; what is semi-transparent is mixed with what lies
    behind it. The scale bar of a perspective camera holds at one depth, which stands below it.

    Args:
        image: the picture, or pictures of one size.
        scene: of a render, gives colour bars; without it there are none.
        camera: that of the picture, where its metadata do not say it; gives lengths and directions.
        labels: see `jaxsph.io.labels_of`; or the name of the quantity, in code units. They are of the particles, else of the
            first volume; other volumes are in code units. A projection has its own.
        target: (3,) place at whose depth the scale bar holds; `None` is the middle of the scene.
        axes, triad: coordinates with their unit, of parallel rays, not a scale bar; whether directions of x, y, z are there.
        title: above the figure; or one for each panel, written in it.
        style: `font_size=8`, points. `dpi=150`, dots an inch at least. `background`: a colour behind the picture, or
            `"transparent"`. Of slices and projections `colormap`, `norm` and `range`, see `Projection.to_uint8`, or `transfer`, a
            transfer function. `contours`: values on the same pixels, (H, W) or (panels, H, W), and levels (or how many).

    Returns:
        A `matplotlib.figure.Figure` (no display is needed): `figure.savefig("picture.pdf")`. Coordinates of `figure.axes[0]` are
        lengths in the unit that is told, from where the camera's are, or pixels.

    Raises:
        ImportError: matplotlib is not installed.
        ValueError: a camera of another size than the image, a target that is not ahead of it, axes in perspective, pictures of
            several sizes, an unknown style.
    """
    matplotlib = require("matplotlib", "pictures with a key", "color")
    images = list(image) if isinstance(image, list | tuple) else [image]
    if unknown := set(style) - set(Style._fields):
        raise ValueError(f"`style` must be of {', '.join(Style._fields)}, got {', '.join(sorted(unknown))}")
    asked = Style(**style)
    camera = _camera_of(images, scene, camera)
    if axes and (camera is None or camera.is_perspective):
        raise ValueError("`axes` are of parallel rays, whose camera is known; leave them out for a scale bar")
    pictures, bars, labels = _coloured(images, scene, labels, asked)
    with matplotlib.rc_context(STYLE | {"font.size": asked.font_size}):
        page = _Page(pictures, camera, labels, asked, axes)
        if camera is not None and triad and not axes:
            page.draw_axes(camera)
        if camera is not None and not axes:
            page.draw_scale(camera, anchor(camera, scene, target), target is not None, labels)
        page.write(0, labels.moment)
        for bar in bars:
            page.draw_bar(bar)
        page.name(title, bool(labels.moment))
        page.fit()
    return page.figure


def require_dots(dpi: float | None) -> None:
    """Raise `ValueError` where a figure of so many dots an inch is one that no memory holds."""
    if dpi is not None and dpi > MOST_DOTS:
        wide = f"a figure of one column would be {COLUMN * dpi:,.0f} pixels wide"
        raise ValueError(f"`dpi` must be at most {MOST_DOTS}, got {dpi:g}: {wide}; journals ask for 300 to 1200")


def _camera_of(images: list[Any], scene: Scene | None, camera: Camera | None) -> Camera | None:
    """The camera of the pictures, given or as their metadata have it, with depths."""
    if len(shapes := {np.shape(one.values if hasattr(one, "values") else one.color)[:2] for one in images}) != 1:
        raise ValueError(f"`image` must be a picture, or some of one size, got sizes {sorted(shapes)}")
    (height, width), own = shapes.pop(), getattr(images[0], "camera", None)
    camera = camera or own or described(str(dict(images[0].metadata).get("jaxsph.camera", "")))
    if camera is not None and (camera.height, camera.width) != (height, width):
        given = f"{camera.width} x {camera.height}"
        raise ValueError(f"`camera` must be the one of the image, of {width} x {height} pixels, got one of {given}")
    return camera if camera is None or scene is None or not scene.parts else with_depths(camera, scene)


def _coloured(images: list[Any], scene: Scene | None, labels: Any, style: Style) -> tuple[list[Image], list[Axis], Labels]:
    """Pictures, their colour bars, and what these are called."""
    first = images[0]
    given = Labels.of(labels or "quantity")
    if isinstance(first, Slice) and style.transfer is None:
        images = [Projection(one.values, one.values, 1.0, False, metadata=one.metadata) for one in images]  # type: ignore[arg-type]
    elif isinstance(first, Slice):
        bar = Axis(style.transfer, given.quantity, given.unit, given.factor)
        return [one.image(style.transfer) for one in images], [bar], given
    if isinstance(first, Image):
        looks = () if scene is None else scene.looks
        bars = [Axis(look, given.quantity, given.unit, given.factor) for look in looks[:1]]
        bars += [Axis(one, f"volume {k}" if len(looks) > 2 else "volume", CODE_UNITS) for k, one in enumerate(looks[1:], 1)]
        return images, bars, given
    every = np.concatenate([np.asarray(one.values, np.float64) for one in images])
    log, ends = dataclasses.replace(images[0], values=every).span(style.norm, style.range)
    colormap = suited(style.colormap, ends)
    norm = style.norm if style.norm == "symlog" else "log" if log else "linear"
    pictures = [one.image(colormap, norm, ends) for one in images]
    if labels is None and isinstance(first, Projection):
        given = labels_said(first.name, first.unit, first.length_unit, float(np.abs(every[np.isfinite(every)]).max(initial=0)))
    return pictures, [Axis.over(colormap, norm, ends, given)], given


class _Page:
    """Pictures in rows, and what is drawn over and around them; places on the page in dots from the lower left picture corner."""

    def __init__(self, images: list[Image], camera: Camera | None, labels: Labels, style: Style, ticked: bool):
        require_dots(style.dpi)
        height, width = images[0].shape
        self.columns = len(images) if len(images) <= 3 else int(np.ceil(np.sqrt(len(images))))
        self.rows, self.letter, self.images = -(-len(images) // self.columns), style.font_size, images
        whole, letter = COLUMN if len(images) == 1 else PAGE, style.font_size / 72
        inches = max((whole - letter * (AROUND + TICKED * ticked)) / self.columns, MIN_INCHES)
        self.upright = self.rows * inches * height / width >= BESIDE  # colour bars stand at the right
        inches += 0 if self.upright else letter * (AROUND - 2 * PAD) / self.columns
        inches = max(min(inches, TALLEST / self.rows / height * width), MIN_INCHES * min(1, width / height))
        self.dot = int(np.ceil(style.dpi * inches / width))  # dots that a pixel is wide
        self.figure = canvas((COLUMN, COLUMN), width * self.dot / inches, "", None)
        self.figure.set_facecolor("none" if style.background == "transparent" else "white")
        self.point = self.figure.dpi / 72
        self.size = width * self.dot, height * self.dot
        step = [side + round(GAP * self.letter * self.point) for side in self.size]
        self.whole = self.columns * step[0] - step[0] + self.size[0], self.rows * step[1] - step[1] + self.size[1]
        self._places: list[tuple[Any, tuple[float, float, float, float]]] = []
        self.extent, names = frame_of(camera, labels, width, height)
        self.inks = []
        for number, image in enumerate(images):
            row, column = divmod(number, self.columns)
            made = self._add((column * step[0], (self.rows - 1 - row) * step[1], *self.size))
            picture, ink = picture_of(image, style.background)
            self.inks.append(ink)
            made.imshow(picture, extent=self.extent, interpolation="none", aspect="auto", zorder=1)
            made.set_axisbelow(True)  # ticks touch no pixel
            _frame(made, 1 if style.background == "transparent" else 2)
            if style.contours is not None:
                self._draw_contours(number, ink, *style.contours)
            if not ticked:
                made.set(xticks=[], yticks=[])
                continue
            made.tick_params(width=LINE, length=0.35 * self.letter, labelsize=0.9 * self.letter)
            for which, side, each in zip("xy", self.size, (4.5, 2.5), strict=True):
                made.locator_params(which, nbins=max(2, min(6, int(side / self.point / self.letter / each))))
            lowest = number + self.columns >= len(images)
            made.set(xlabel=names[0] * lowest, ylabel=names[1] * (column == 0))
            made.tick_params(labelbottom=lowest, labelleft=column == 0)

    def _add(self, place: tuple[float, float, float, float]) -> Any:
        axes = self.figure.add_axes((0, 0, 1, 1), label=str(len(self._places)))
        self._places.append((axes, place))
        self.fit()
        return axes

    def fit(self, pad: float = PAD) -> None:
        """Make the figure as large as what is on it, letters of room aside."""
        left, low, right, high = self._reach(pad * self.letter * self.point)
        wide, tall = right - left, high - low
        self.figure.set_size_inches(wide / self.figure.dpi, tall / self.figure.dpi)
        for axes, (x, y, width, height) in self._places:
            axes.set_position(((x - left) / wide, (y - low) / tall, width / wide, height / tall))

    def _reach(self, pad: float = 0.0) -> tuple[int, int, int, int]:
        """From where to where on the page there is something."""
        places = np.array([(x, y, x + width, y + height) for _, (x, y, width, height) in self._places])
        reach = np.concatenate([places[:, :2].min(0), places[:, 2:].max(0)])
        if (axes := self._places[0][0]).get_images():
            corner = np.subtract(self._places[0][1][:2], axes.get_window_extent().p0)
            extents = self.figure.get_tightbbox(self.figure.canvas.get_renderer()).extents * self.figure.dpi
            reach = np.concatenate([np.minimum(reach[:2], extents[:2] + corner), np.maximum(reach[2:], extents[2:] + corner)])
        left, low = np.floor(reach[:2] - pad).astype(int)
        right, high = np.ceil(reach[2:] + pad).astype(int)
        return int(left), int(low), int(right), int(high)

    def _from(self, corner: tuple[float, float], number: int = 0) -> Any:
        """Points to the right and upwards from a corner of a picture, a transform of matplotlib's."""
        from matplotlib.transforms import Affine2D, ScaledTranslation

        axes = self._places[number][0]
        return Affine2D().scale(1 / 72) + self.figure.dpi_scale_trans + ScaledTranslation(*corner, axes.transAxes)

    def text(self, corner: tuple[float, float], place: tuple[float, float], line: str, number: int = 0, **style: Any) -> None:
        """Points from a corner, in letters with a border, such that they are read anywhere; smaller where there is no room."""
        whole = bordered(self.inks[number], HALO * self.letter) | {"transform": self._from(corner, number)} | style
        made = self._places[number][0].text(*place, line, **whole)
        wide = made.get_window_extent(self.figure.canvas.get_renderer()).width
        made.set_fontsize(made.get_fontsize() * min(1.0, (self.size[0] - self.letter * self.point) / wide))

    def line(self, corner: tuple[float, float], ends: np.ndarray, width: float) -> None:
        """A line with a border, points from a corner of the first picture; a width in points."""
        from matplotlib.lines import Line2D

        style = bordered(self.inks[0], width + HALO * self.letter) | {"linewidth": width, "solid_capstyle": "butt"}
        self._places[0][0].add_line(Line2D(*ends.T, transform=self._from(corner), **style))

    def _draw_contours(self, number: int, ink: str, values: Any, levels: Any) -> None:
        values = np.broadcast_to(np.asarray(values, np.float64), (len(self.images), *np.shape(values)[-2:]))[number]
        if values.shape != self.images[0].shape:
            raise ValueError(f"`contours` must have the shape of the image, {self.images[0].shape}, got {values.shape}")
        place = {"origin": "upper", "extent": self.extent}
        low, high = np.nanmin(values), np.nanmax(values)
        if inside := [one for one in levels if low < one < high] if np.ndim(levels) else int(levels):
            border = bordered(ink, LINE + HALO / 2 * self.letter)["path_effects"]
            self._places[number][0].contour(values, inside, colors=ink, linewidths=LINE, **place).set_path_effects(border)

    def draw_axes(self, camera: Camera) -> None:
        """Directions of x, y and z in the lower left corner."""
        axes, length, start = camera.exact_axes(), 1.9 * self.letter, np.full(2, 1.5 * self.letter)
        if min(self.size) < ROOMY * self.letter * self.point:
            return
        across = [axes[:2, i] for i in range(3)]
        start, taken = start + length * np.maximum(0, -np.min(across, 0)), [np.full(2, np.inf)]
        for name, along in sorted(zip("xyz", across, strict=True), key=lambda one: -np.hypot(*one[1])):
            if (seen := float(np.hypot(*along))) < ALONG:
                continue
            end = start + along * length
            self.line((0, 0), np.stack([start, end]), 1.5 * LINE)
            place = end + along / seen * 0.6 * self.letter
            if np.linalg.norm(np.subtract(taken, place), axis=1).min() < self.letter:  # beside a longer one along the same line
                place = end + np.array([-along[1], along[0]]) / seen * 0.6 * self.letter
            taken.append(place)
            self.text((0, 0), (float(place[0]), float(place[1])), f"${name}$", ha="center", va="center")

    def draw_scale(self, camera: Camera, depth: float, at_target: bool, labels: Labels) -> None:
        """A bar of a round length in the lower right corner."""
        scale = pixels_per_length(camera, depth) * self.dot / self.point
        most = LONGEST_BAR * self.size[0] / self.point / scale
        factor, name = labels.length_as(most)
        length = round_length(most * factor)
        low = self.letter * (1.7 if camera.is_perspective else 0.9)
        right = -0.9 * self.letter
        left = right - length / factor * scale
        self.line((1, 0), np.array([[left, low], [right, low]]), 2.5 * LINE)
        text = measured(length, name)
        wide = (left + right) / 2, "center"
        if (right - left) < 0.55 * self.letter * len(text.replace("$", "")):
            wide = right, "right"
        self.text((1, 0), (wide[0], low + 0.35 * self.letter), text, ha=wide[1], va="bottom")
        if camera.is_perspective:
            where = "at the target" if at_target else "at mid depth"
            self.text((1, 0), (right, low - 0.35 * self.letter), where, fontsize=0.8 * self.letter, ha="right", va="top")

    def write(self, number: int, line: str) -> None:
        """In the upper left corner of a picture."""
        if line:
            line = re.sub(r"\b([zt]) =", r"$\1$ =", line)
            self.text((0, 1), (0.7 * self.letter, -0.7 * self.letter), line, number, ha="left", va="top", linespacing=1.3)

    def name(self, title: str | Sequence[str], timed: bool) -> None:
        """Titles, over the whole or in panels, in the first below a time."""
        if not isinstance(title, str):
            for number, line in enumerate(title):
                self.write(number, "\n" * (timed and number == 0) + line)
        elif title:
            letters = max(12, int(self.whole[0] / self.point / self.letter / 0.5))
            top = (self._reach()[3] - self._places[0][1][1] - self.size[1]) / self.point
            style: dict[str, Any] = {"ha": "left", "va": "bottom", "transform": self._from((0, 1))}
            self._places[0][0].text(0, top + 0.4 * self.letter, in_lines(title, letters), **style)

    def draw_bar(self, bar: Axis) -> None:
        """A colour bar as high as all pictures at their right, or where these are low as wide above them."""
        upright, (_, _, right, high) = self.upright, self._reach()
        gap, wide = GAP * self.letter * self.point, round(WIDE * self.letter * self.point)
        if len(self._places) == len(self.images):
            right, high = self.whole
        start = round((right if upright else high) + gap)
        axes = self._add((start, 0, wide, self.whole[1]) if upright else (0, start, self.whole[0], wide))
        which, other = "yx" if upright else "xy"
        place = np.linspace(0, 1, STEPS + 1)
        edges, middles = bar.scale.value(place), bar.scale.value((place[1:] + place[:-1]) / 2)
        long = self.whole[upright] / self.point / self.letter
        bar.apply(axes, which, float(edges[0]), float(edges[-1]), max(2, min(7, int(long / (2.2 if upright else 4.5)))))
        across_along = ([0, 1], edges) if upright else (edges, [0, 1])
        axes.pcolormesh(*across_along, np.expand_dims(bar.colors(middles), int(upright)), rasterized=True)
        axes.set(**{f"{other}ticks": []})
        axis, side = getattr(axes, f"{which}axis"), "right" if upright else "top"
        axis.set_ticks_position(side)
        axis.set_label_position(side)
        axes.tick_params(which="both", width=LINE, labelsize=0.9 * self.letter, length=0.35 * self.letter, pad=0.25 * self.letter)
        axes.tick_params(which="minor", length=0.2 * self.letter)
        _frame(axes, 2)
        name, bracket, unit = bar.title.partition(" (")
        unit = bracket and f"\n({unit}"
        for text in (bar.title, name + unit, in_lines(name, max(10, int(1.6 * long))) + unit):
            axis.set_label_text(text, linespacing=1.2)
            label = axis.label.get_window_extent(self.figure.canvas.get_renderer())
            if (label.height if upright else label.width) <= self.whole[upright]:
                break
        self.fit()


def _frame(axes: Any, lines: int) -> None:
    """A frame around axes; of two lines the inner one lies behind what is drawn in them."""
    axes.patch.set(facecolor="none", edgecolor=DARK, linewidth=lines * LINE)
    axes.spines[:].set_visible(False)


def draw_arrows(panels: Any, right: Float[np.ndarray, "panels rows columns"], up: Any, name: str, unit: str = "") -> None:
    """Draw an arrow in the middle of each cell of a lattice over pictures, and in the first one of a round length, as a key.

    Args:
        panels: axes of matplotlib, each with one picture.
        right, up: components to the right and upwards; row 0 is the top. Cells that are NaN have no arrow.
        name: of the vector.
        unit: of its components; empty where it is not known.
    """
    lengths = np.hypot(right, up)
    there, (_, rows, columns) = lengths[np.isfinite(lengths) & (lengths > 0)], lengths.shape
    if not there.size:
        return
    typical = float(np.percentile(there, LONG))
    key, scale = round_length(typical), typical * columns / CELLS
    size = {"scale_units": "width", "scale": scale, "width": 0.003, "linewidth": 0.4, "zorder": 1.5}
    for axes, *parts in reversed(list(zip(panels, right, up, strict=False))):  # the first last, which has the key
        left, end, bottom, top = axes.get_images()[0].get_extent()
        x = left + (np.arange(columns) + 0.5) / columns * (end - left)
        y = top - (np.arange(rows) + 0.5) / rows * (top - bottom)
        drawn = axes.quiver(x, y, *parts, angles="uv", pivot="mid", color="white", edgecolor="black", **size)
    font, box, ink = axes.xaxis.label.get_fontproperties(), axes.bbox, ink_of(np.asarray(axes.get_images()[0].get_array()))
    letter, label = font.get_size() * axes.figure.dpi / 72, f"{symbol(name)}, {measured(key, unit)}"
    place = 1 - 0.7 * letter / box.width - key / scale, 1 - 1.35 * letter / box.height  # as high as a title
    style: dict[str, Any] = {"labelpos": "W", "labelsep": 0.05, "coordinates": "axes", "color": ink, "fontproperties": font}
    behind = {"facecolor": "white" if ink == DARK else DARK, "alpha": 0.5, "pad": 1, "linewidth": 0}
    axes.quiverkey(drawn, *place, key, label, **style).text.set(bbox=behind, **bordered(ink, HALO * font.get_size()))
