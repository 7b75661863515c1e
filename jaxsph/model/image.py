"""Image: what a render gives, with the record of how it was made.

Flow: cast -> [image] -> files, notebooks.
"""

from __future__ import annotations

import base64
import io
import os
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsph.numerics.checks import array_of, at_hand
from jaxsph.numerics.names import did_you_mean, import_by_name
from jaxsph.numerics.trees import Traceable, kind_of, line_of, numbers_in, span_of, tree

COLORS = (
    *("white", "black", "gray", "grey", "silver", "red", "green", "lime", "blue", "navy"),
    *("yellow", "orange", "gold", "cyan", "magenta", "purple", "pink", "brown"),
)  # names of colours, as CSS has them (W3C CSS Color Module Level 4, section 6.1)


def rgb(color: Any) -> tuple[float, float, float]:
    """R, G and B in [0, 1], display-referred.

    Args:
        color: one of `COLORS`, `"#rgb"`, `"#rrggbb"`, `"R,G,B"` or three numbers in [0, 1].

    Raises:
        ValueError: no colour.
    """
    from cmap import Color

    given = color
    try:
        if isinstance(color, str):
            named = color.lower() in COLORS or (color.startswith("#") and len(color) in (4, 7) and color.isascii())
            given = Color(color.lower()).rgba[:3] if named else color.split(",")
        values = np.asarray(given, np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (3,) or not ((values >= 0) & (values <= 1)).all():
        meant = did_you_mean(color, COLORS) if isinstance(color, str) else ""
        raise ValueError(f"`color` must be a name such as white, #rrggbb, or R,G,B from 0 to 1; got {color!r}{meant}")
    return float(values[0]), float(values[1]), float(values[2])


PLANE = "row", "column"


def dataset(layers: Mapping[str, Any], coordinates: Mapping[str, Any], metadata: Iterable[tuple[str, Any]], **more: Any) -> Any:
    """A dataset of layers and coordinates, each as xarray takes it: dimensions, values, attributes.

    Raises `ImportError`: xarray is not installed.
    """
    try:
        import xarray
    except ImportError as error:
        raise ImportError('`to_xarray` needs the library `xarray`: pip install "jaxsph[xarray]"') from error
    noted = {str(name): value if isinstance(value, int | float | str) else str(value) for name, value in metadata}
    return xarray.Dataset(layers, coords=coordinates, attrs=noted | more)


def places(shape: tuple[int, int], pixel: float, middle: tuple[float, float], unit: str) -> dict[str, Any]:
    """Coordinates `x` of columns and `y` of rows, the first of which is the top; the middle has those given."""
    height, width = shape
    x = middle[0] + pixel * (np.arange(width) + 0.5 - width / 2)
    y = middle[1] + pixel * (height / 2 - np.arange(height) - 0.5)
    units = {"units": unit} if unit else {}
    return {"x": ("column", x, {"long_name": "to the right"} | units), "y": ("row", y, {"long_name": "upwards"} | units)}


@tree(static=("metadata",))
class Image(Traceable):
    """A rendered image; of `jax.vmap` a batch of them, `image[0]` one. Row 0 is the top, column 0 the left; behind it is black.

    Attributes:
        color: premultiplied RGB in [0, 1], display-referred (sRGB) as colours of the transfer function are.
        transmittance: what is left of the background's light, in [0, 1]; alpha is `1 - transmittance`.
        depth: view depth where transmittance falls to 1/2, inf where it never does, length units.
        error_bound: largest difference to the reference image that a pixel can have, an estimate unless `certified`; 0 at full
            rate, and at most 1. With a tolerance and `integrator="segments"`, the estimated error against the light integral;
            infinite where nothing is known: without a tolerance of other integrators than `"samples"`, and of surfaces, of which
            samples may miss what is thin; where a sample is within rounding of a jump of the transfer function or of a face of
            a clip, and may be shown as either side; and in files that do not hold it.
        evaluations: particle-sample kernel evaluations spent on each pixel.
        certified: whether `error_bound` is a proven bound, and known of every pixel.
        faults: 0 when all is well, else bits: `fault_messages` has them in words, and `check` raises them. An image with a fault
            is not certified, and its `error_bound` is 1.
        stats: `evaluations`, `evaluations_full`, `cells` (slabs of bundles that a particle can touch), `pairs` (particles of
            all bundle lists) and, from an eager render, `seconds`.
        metadata: strings and numbers for the file header.
        levels: what error control by bounds gave each slab, front to back; None without it. A slab is 8 x 8 pixels over
            `plan.cast.slab_samples` samples. 0 is full rate, 5 a super-pixel: a slab of one colour. 1 to 4 are sampling levels,
            which slabs have only with `super_pixels=False` or `relax`. -1 is a slab that no particle can touch.
        normal: of the scene's surface of particles, of unit length and out of the fluid, in the world; 0 where no ray meets it.
            None without one, and where pixels are interpolated.
        lower, upper: of `jaxsph.bracket`, where they were asked for: red, green, blue and alpha at full rate lie between.
    """

    LAYER = "color", 3
    color: Float[Array, "height width 3"]
    transmittance: Float[Array, "height width"]
    depth: Float[Array, "height width"]
    error_bound: Float[Array, "height width"]
    evaluations: Float[Array, "height width"]
    certified: Bool[Array, ""] | bool
    faults: Int[Array, ""] | int
    stats: dict[str, Any]
    metadata: tuple[tuple[str, Any], ...] = ()
    levels: Int[Array, "slabs bundle_rows bundle_columns"] | None = None
    normal: Float[Array, "height width 3"] | None = None
    lower: Float[Array, "height width 4"] | None = None
    upper: Float[Array, "height width 4"] | None = None

    def __repr__(self) -> str:
        shape: tuple[int, ...] = getattr(self.color, "shape", ())
        size = f"{shape[-2]} x {shape[-3]}" if len(shape) > 2 else kind_of(self.color)
        size = f"batch of {' x '.join(map(str, shape[:-3]))}, {size}" if len(shape) > 3 else size
        certified = numbers_in(self.certified)
        proven = None if certified is None else "certified" if certified.all() else "not certified"
        error = span_of(self.error_bound).replace("inf", "unknown")
        words = f"transmittance {span_of(self.transmittance)}", f"error {error}"
        return line_of("Image", size, *words, proven, f"faults {span_of(self.faults)}")

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """The picture as NumPy takes it, `color`: (H, W, 3), what `matplotlib.pyplot.imshow` shows."""
        return np.array(np.asarray(self.color), dtype, copy=copy)

    @property
    def alpha(self) -> Float[Array, "height width"]:
        """Opacity, `1 - transmittance`."""
        return array_of(1 - at_hand(self.transmittance)[1]) if isinstance(self.transmittance, Array) else 1 - self.transmittance

    def over(self, background: Any) -> Float[np.ndarray, "height width 3"]:
        """The picture in front of a background of one colour: C + T B, with premultiplied C and transmittance T (host side).

        Args:
            background: a name such as `"white"`, `"#rrggbb"`, or R, G and B in [0, 1], display-referred as `color` is.

        Returns:
            (height, width, 3) in [0, 1], float64, display-referred: what `matplotlib.pyplot.imshow` shows.

        Raises:
            ValueError: no colour; an image without transmittance, as one read from a PNG is.
        """
        color, behind = np.asarray(self.as_one("over").color, np.float64), np.asarray(rgb(background))
        transmittance = np.asarray(self.transmittance, np.float64)[..., None]
        if np.isnan(transmittance).any():
            raise ValueError("`over` needs the transmittance of the image, and a PNG does not hold it: write EXR to keep it")
        made: np.ndarray = np.clip(np.nan_to_num(color, nan=0.0) + transmittance * behind, 0, 1)
        return made

    def save(self, path: str | os.PathLike[str], background: Any = None) -> None:
        """Write to `path`: `.exr` (all layers) or `.png` (colour over black, or `background`). See `jaxsph.io.write_image`."""
        import_by_name("jaxsph.io.images.image_files:write_image")(path, self, background)  # 310 ms

    def figure(self, scene: Any = None, camera: Any = None, **more: Any) -> Any:
        """A figure of matplotlib's with colour bar, scale bar or axes, and time.

        Args:
            scene: gives colour bars; without it there are none.
            camera: that of the picture, where its metadata do not say it.
            more: of `jaxsph.plot.image_figure.image_figure`, such as `labels`, `axes` and `title`.
        """
        return figure_of(self.as_one("figure"), scene, camera, **more)

    def to_uint8(self) -> np.ndarray:
        """(H, W, 3) uint8: colours over black as they are (display-referred), clipped and rounded to nearest."""
        color = np.nan_to_num(np.asarray(self.as_one("to_uint8").color, np.float64), nan=0.0)
        return (np.clip(color, 0, 1) * 255 + 0.5).astype(np.uint8)

    def to_xarray(self) -> Any:
        """All layers as an `xarray.Dataset` over `row`, `column` and, for colours, `channel`; metadata are its attributes.

        Raises:
            ImportError: xarray is not installed.
        """
        color = np.asarray(self.as_one("to_xarray").color)
        layers: dict[str, Any] = {"color": ((*PLANE, "channel"), color, {"long_name": "premultiplied colour"})}
        for name in ("transmittance", "depth", "error_bound", "evaluations"):
            layers[name] = PLANE, np.asarray(getattr(self, name)), {"long_name": name.replace("_", " ")}
        if self.normal is not None:
            layers["normal"] = (*PLANE, "axis"), np.asarray(self.normal), {"long_name": "normal of the surface"}
        told = {"certified": str(bool(self.certified)).lower(), "faults": int(self.faults)}
        return dataset(layers, {"channel": ["red", "green", "blue"]}, self.metadata, **told)

    def _repr_html_(self) -> str:
        """The picture, and below it a line with size, time and error."""
        height, width = self.as_one("_repr_html_").shape
        told = [f"{width} &times; {height}"]
        seconds = self.stats.get("seconds")
        if isinstance(seconds, dict):
            told.append(f"{sum(float(value) for value in seconds.values()):.2g} s")
        worst = float(np.max(np.asarray(self.error_bound, np.float64), initial=0))
        if np.isinf(worst):
            told.append("error unknown")
        elif worst > 0:
            told.append(f"error at most {worst:.2g}, {'certified' if bool(self.certified) else 'estimated'}")
        if int(self.faults):
            told.append(f"faults {int(self.faults)}")
        picture = base64.b64encode(self._repr_png_()).decode()
        shown = f'<img src="data:image/png;base64,{picture}" width="{width}" height="{height}" alt="rendered image">'
        return f"<figure>{shown}<figcaption>{', '.join(told)}</figcaption></figure>"

    def _repr_png_(self) -> bytes:
        return png_of(self.to_uint8())


def figure_of(shown: Any, *given: Any, **more: Any) -> Any:
    """See `jaxsph.plot.image_figure.image_figure`."""
    return import_by_name("jaxsph.plot.image_figure:image_figure")(shown, *given, **more)  # 290 ms


def png_of(picture: np.ndarray) -> bytes:
    """A PNG file of (H, W, 3) uint8."""
    from PIL import Image as Pillow

    buffer = io.BytesIO()
    Pillow.fromarray(picture).save(buffer, format="PNG")
    return buffer.getvalue()
