"""A picture with its key: colour bars, scale bar, axes, the outline of what is shown, the time; and arrows over a picture.

Flow: Image, scene, camera, labels -> [image_figure] -> figure of matplotlib's.

Pixels of the image are pixels of the figure, as they are in the PNG without a key, under what is drawn over them.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxsph.io.damage import require
from jaxsph.io.units import CODE_UNITS, Labels
from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.framing import with_depths
from jaxsph.model.image import Image
from jaxsph.model.scene import Scene
from jaxsph.plot.bars import STEPS, Axis, raised

DOTS_AN_INCH = 100
LETTERS = 42  # lines of text that are as high as the image
SMALLEST, LARGEST = 11, 64  # pixels of a letter
ROOM = 30  # letters, for a colour bar with its ticks and label, before these are measured
BAR_SPAN = 0.06, 0.94  # of the figure's height
LONGEST_BAR = 0.25  # of the image's width
TALLEST = 0.55  # of a letter: its mean width
AXES_COLORS = "#ff7b72", "#7ee787", "#79b8ff"
LIGHT, DARK = "#ffffff", "#000000"
BRIGHT = 127.5  # mean of the edge of a picture, of 255, from which letters on it are dark
ALONG = 0.3  # of a letter: an axis that seems shorter points along the line of sight
PIECES = 128  # of an edge, each of which is hidden or not
AHEAD = 1e-3  # of the far depth, before which nothing is drawn
LONG, CELLS = 95, 1.3
"""Percentile of lengths that is drawn so many cells of the lattice long."""


def image_figure(
    image: Image,
    scene: Scene | None = None,
    camera: Camera | None = None,
    *,
    labels: Labels | str = "quantity",
    target: Any = None,
    outline: bool = True,
    triad: bool = True,
    title: str = "",
) -> Any:
    """Draw an image with its key.

    The colour bar shows the colours of the transfer function alone; what is semi-transparent is mixed with what lies behind it,
    and with the black background. The scale bar of a perspective camera holds at one depth, which stands below it. The outline
    is that of all particles with their supports, volumes and points; it is faint behind the depth at which half of the light
    is absorbed.

    Args:
        image: the picture.
        scene: gives colour bars and the outline; without it there are none.
        camera: that of the picture, gives scale bar, axes and outline.
        labels: see `jaxsph.io.labels_of`; or the name of the quantity, in code units. They are of the particles, else of the
            first volume; other volumes are in code units.
        target: (3,) place at whose depth the scale bar holds; `None` is the middle of the scene.
        outline, triad: whether to draw the outline, and the axes.
        title: a line above the time.

    Returns:
        A `matplotlib.figure.Figure` (no display is needed): `figure.savefig("picture.png")`.

    Raises:
        ImportError: matplotlib is not installed.
        ValueError: a camera of another size than the image, a target that is not ahead of it.
    """
    require("matplotlib", "pictures with a key", "color")
    if camera is not None and scene is not None:
        camera = with_depths(camera, scene)
    if camera is not None and (camera.height, camera.width) != image.shape:
        size, given = f"{image.shape[1]} x {image.shape[0]}", f"{camera.width} x {camera.height}"
        raise ValueError(f"`camera` must be the one of the image, of {size} pixels, got one of {given}")
    labels, bounds = Labels.of(labels), None if scene is None or not scene.parts else scene.bounds()
    looks = () if scene is None else scene.looks
    bars = [Axis(look, labels.quantity, labels.unit, labels.factor) for look in looks[:1]]
    bars += [Axis(one, f"volume {k}" if len(looks) > 2 else "volume", CODE_UNITS) for k, one in enumerate(looks[1:], 1)]
    page = _Page(image)
    if camera is not None and bounds is not None and outline:
        page.draw_outline(camera, *bounds)
    if camera is not None and triad:
        page.draw_axes(camera)
    if camera is not None:
        page.draw_scale(camera, _anchor(camera, bounds, target), target is not None, labels)
    page.write([line for line in (title, labels.moment) if line])
    for bar in bars:
        page.draw_bar(bar)
    return page.figure


def _anchor(camera: Camera, bounds: tuple[np.ndarray, np.ndarray] | None, target: Any) -> float:
    """Depth at which the scale bar holds."""
    if target is None and bounds is None:
        return sum(camera.near_and_far()) / 2
    place = np.mean(bounds, 0) if target is None and bounds is not None else np.asarray(target, np.float64)
    if place.shape != (3,):
        raise ValueError(f"`target` must have shape (3,), got {place.shape}; give x, y and z")
    depth = float(to_pixels(camera, place)[1])
    if camera.is_perspective and depth <= 0:
        if target is not None:
            raise ValueError(f"`target` = {place.tolist()} is not ahead of the eye; give a place that the camera looks at")
        return sum(camera.near_and_far()) / 2
    return depth


class _Page:
    """A figure with the picture at its left, and room for colour bars."""

    def __init__(self, image: Image):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self.height, self.width = image.shape
        self.letter = float(np.clip(self.height / LETTERS, SMALLEST, LARGEST))
        self.image, self.figure = image, Figure(dpi=DOTS_AN_INCH, facecolor="white")
        self.canvas = FigureCanvasAgg(self.figure)
        self.axes = self.figure.add_axes((0, 0, 1, 1))
        self._places = [(self.axes, 0.0, float(self.width))]
        self._fit(self.width)
        extent = (0, self.width, self.height, 0)
        picture = image.to_uint8()
        around = np.concatenate([picture[[0, -1]].reshape(-1, 3), picture[:, [0, -1]].reshape(-1, 3)])
        self.ink, self.halo = (DARK, LIGHT) if around.mean() > BRIGHT else (LIGHT, DARK)
        self.axes.imshow(picture, extent=extent, interpolation="nearest", aspect="auto")
        self.axes.set(xlim=(0, self.width), ylim=(self.height, 0))
        self.axes.axis("off")

    def _fit(self, whole: int) -> None:
        """Make the figure so many pixels wide, with axes where they are."""
        self.whole = whole
        self.figure.set_size_inches(whole / DOTS_AN_INCH, self.height / DOTS_AN_INCH)
        for axes, left, width in self._places:
            lower, high = (0.0, 1.0) if axes is self.axes else BAR_SPAN
            axes.set_position((left / whole, lower, width / whole, high - lower))

    @property
    def points(self) -> float:
        """Size of letters, as matplotlib counts it."""
        return self.letter * 72 / DOTS_AN_INCH

    def text(self, x: float, y: float, line: str, size: float = 1.0, **style: Any) -> None:
        """In letters that stand out from the edge of the picture, with a border, such that they are read anywhere on it."""
        from matplotlib import patheffects

        border = [patheffects.withStroke(linewidth=0.22 * self.points, foreground=self.halo)]
        whole: dict[str, Any] = {"color": self.ink, "fontsize": size * self.points, "path_effects": border}
        self.axes.text(x, y, line, **whole | style)

    def line(self, ends: np.ndarray, width: float, color: str | None = None) -> None:
        """A line with a border; a width in letters."""
        from matplotlib import patheffects

        wide = width * self.points
        border = [patheffects.Stroke(linewidth=wide + 0.16 * self.points, foreground=self.halo), patheffects.Normal()]
        self.axes.plot(*ends.T, color=color or self.ink, linewidth=wide, path_effects=border, solid_capstyle="butt")

    def draw_outline(self, camera: Camera, lower: np.ndarray, upper: np.ndarray) -> None:
        """Edges of the box; faint and dotted where they lie behind half of the light."""
        from matplotlib.collections import LineCollection

        lines = box_lines(camera, lower, upper)
        hidden = lines.hidden(np.nan_to_num(np.asarray(self.image.depth, np.float64), nan=np.inf))
        for which, alpha in ((hidden, 0.22), (~hidden, 0.75)):
            style: dict[str, Any] = {"colors": self.ink, "alpha": alpha, "linewidths": 0.09 * self.points, "capstyle": "butt"}
            self.axes.add_collection(LineCollection(list(lines.ends[which]), **style), autolim=False)

    def draw_axes(self, camera: Camera) -> None:
        """Directions of x, y and z in the lower left corner, those that point away from the eye first."""
        axes = np.asarray(camera.axes, np.float64)
        start = np.array([3.8 * self.letter, self.height - 3.8 * self.letter])
        for i in np.argsort(-axes[2]):
            along = np.array([axes[0, i], -axes[1, i]]) * 2.2 * self.letter
            if np.hypot(*along) < ALONG * self.letter:
                continue
            self.line(np.stack([start, start + along]), 0.17, AXES_COLORS[i])
            length = float(np.hypot(*along))
            place = start + along + along / length * 0.7 * self.letter
            self.text(float(place[0]), float(place[1]), "xyz"[i], 0.95, ha="center", va="center", color=AXES_COLORS[i])

    def draw_scale(self, camera: Camera, depth: float, at_target: bool, labels: Labels) -> None:
        """A bar of a round length in the lower right corner."""
        scale = pixels_per_length(camera, depth)
        most = LONGEST_BAR * self.width / scale
        factor, name = labels.length_as(most)
        length = round_length(most * factor)
        right, y = self.width - 1.2 * self.letter, self.height - 2.3 * self.letter
        left = right - length / factor * scale
        self.line(np.array([[left, y], [right, y]]), 0.25)
        self.text(right, y - 0.5 * self.letter, f"{length:g} {raised(name)}", ha="right", va="bottom")
        if camera.is_perspective:
            where = "at the target" if at_target else "at mid depth"
            self.text(right, y + 0.35 * self.letter, where, 0.8, ha="right", va="top")

    def write(self, lines: Sequence[str]) -> None:
        """Lines of text in the upper left corner."""
        if lines:
            self.text(0.8 * self.letter, 0.7 * self.letter, "\n".join(lines), 1.05, ha="left", va="top", linespacing=1.3)

    def draw_bar(self, bar: Axis) -> None:
        """A colour bar at the right of all, with ticks and label; the figure grows by what these take."""
        left = self.whole + self.letter
        axes = self.figure.add_axes((0, 0, 1, 1))
        self._places.append((axes, left, 1.3 * self.letter))
        self._fit(round(left + ROOM * self.letter))
        scale = bar.scale
        place = np.linspace(0, 1, STEPS + 1)
        edges, middles = scale.value(place), scale.value((place[1:] + place[:-1]) / 2)
        bar.apply(axes, "y", float(edges[0]), float(edges[-1]))
        axes.pcolormesh([0, 1], edges, bar.colors(middles)[:, None], rasterized=True)
        axes.set_xticks([])
        axes.yaxis.tick_right()
        axes.yaxis.set_label_position("right")
        axes.tick_params(
            labelsize=0.85 * self.points, width=0.08 * self.points, length=0.35 * self.points, pad=0.25 * self.points
        )
        axes.yaxis.get_offset_text().set_fontsize(0.85 * self.points)
        fits = (len(bar.label) + len(bar.unit) + 3) * TALLEST * self.letter < 0.95 * self.height
        axes.set_ylabel(bar.title if fits else bar.title.replace(" (", "\n(", 1), fontsize=self.points)
        extent = axes.get_tightbbox(self.canvas.get_renderer())
        self._fit(int(np.ceil((self.whole if extent is None else extent.x1) + 0.6 * self.letter)))


class Lines(NamedTuple):
    """Pieces of lines in pixels, x to the right and y down from the upper left corner of the image.

    Attributes:
        ends: of the pieces.
        depth: of their middles, length units.
    """

    ends: Float[np.ndarray, "pieces 2 2"]
    depth: Float[np.ndarray, " pieces"]

    def hidden(self, depth: Float[np.ndarray, "height width"]) -> Bool[np.ndarray, " pieces"]:
        """Which of them lie behind the depth at which transmittance falls to 1/2."""
        height, width = depth.shape
        column, row = np.floor(self.ends.mean(1)).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        at = depth[np.where(inside, row, 0).astype(int), np.where(inside, column, 0).astype(int)]
        return inside & (at < self.depth)


def to_pixels(camera: Camera, position: Float[np.ndarray, "... 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Pixel coordinates (..., 2) of world positions, the middle of the first pixel at 1/2; and their depths.

    What is not ahead of a perspective eye has no place: NaN.
    """
    view = (np.asarray(position, np.float64) - camera.exact_eye()) @ np.asarray(camera.axes, np.float64).T
    depth = view[..., 2]
    ahead = depth > AHEAD * abs(camera.near_and_far()[1]) if camera.is_perspective else np.ones(depth.shape, bool)
    spread = np.where(ahead, depth, 1) if camera.is_perspective else np.ones_like(depth)
    half = float(camera.half_height)
    x = (view[..., 0] / spread / half * camera.height + camera.width) / 2
    y = (1 - view[..., 1] / spread / half) / 2 * camera.height
    return np.where(ahead[..., None], np.stack([x, y], -1), np.nan), depth


def box_lines(camera: Camera, lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"]) -> Lines:
    """The twelve edges of a box, in pieces; those that are not ahead of the eye are left out."""
    corners = np.array(list(itertools.product((0, 1), repeat=3)))
    pairs = [(one, other) for one, other in itertools.combinations(corners, 2) if np.abs(one - other).sum() == 1]
    share = np.linspace(0, 1, PIECES + 1)[:, None]
    places = np.array([lower + (upper - lower) * (one + (other - one) * share) for one, other in pairs])
    pixels, depth = to_pixels(camera, places)
    ends = np.stack([pixels[:, :-1], pixels[:, 1:]], 2).reshape(-1, 2, 2)
    middle = ((depth[:, :-1] + depth[:, 1:]) / 2).ravel()
    drawn = np.isfinite(ends).all((1, 2))
    return Lines(ends[drawn], middle[drawn])


def pixels_per_length(camera: Camera, depth: float) -> float:
    """Pixels that a length unit across the line of sight takes at a depth; in the middle of the image, and anywhere else."""
    spread = depth if camera.is_perspective else 1.0
    return camera.height / (2 * float(camera.half_height) * spread)


def round_length(most: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is at most `most`, > 0."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(max((step * power for step in (1, 2, 5) if step * power <= most), default=power))


def draw_arrows(
    axes: Any, right: Float[np.ndarray, "rows columns"], up: Float[np.ndarray, "rows columns"], name: str, unit: str = ""
) -> None:
    """Draw an arrow in the middle of each cell of a lattice over the picture of `axes`, and one of a round length as a key.

    Args:
        axes: of matplotlib, with one picture.
        right, up: components to the right and upwards; row 0 is the top. Cells that are NaN have no arrow.
        name: of the vector.
        unit: of its components; empty where it is not known.
    """
    rows, columns = right.shape
    left, end, bottom, top = axes.get_images()[0].get_extent()
    x = left + (np.arange(columns) + 0.5) / columns * (end - left)
    y = top - (np.arange(rows) + 0.5) / rows * (top - bottom)
    lengths = np.hypot(right, up)
    there = lengths[np.isfinite(lengths) & (lengths > 0)]
    if not there.size:
        return
    typical = float(np.percentile(there, LONG))
    scale = typical * columns / (CELLS * abs(end - left))
    drawn = axes.quiver(x, y, right, up, angles="xy", scale_units="xy", scale=scale, pivot="mid", color="white", width=0.003)
    drawn.set(edgecolor="black", linewidth=0.4)
    key = float(f"{typical:.2g}")
    label = f"{name}, {key:g} {raised(unit)}".strip()
    axes.quiverkey(drawn, 0.92, 0.95, key, label, labelpos="W", coordinates="axes", color="white", labelcolor="white")
