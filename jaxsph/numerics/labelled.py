"""Labelled arrays: layers of a picture over `row` and `column` as an `xarray.Dataset`.

Flow: Image, Projection, Slice -> [labelled] -> xarray.Dataset.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

PLANE = "row", "column"


def dataset(layers: Mapping[str, Any], coordinates: Mapping[str, Any], metadata: Iterable[tuple[str, Any]], **more: Any) -> Any:
    """A dataset of layers and coordinates, each as xarray takes it: dimensions, values, attributes.

    Raises:
        ImportError: xarray is not installed.
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
