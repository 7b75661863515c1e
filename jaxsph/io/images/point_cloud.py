"""Points with normals and colours as PLY files, binary, little endian, as point cloud tools read them.

Flow: SurfaceDepth -> [point_cloud] -> .ply.

Source: G. Turk, The PLY Polygon File Format, 1994.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsph.io.replace import written_whole

SUFFIX = ".ply"
KINDS = {"f8": "double", "f4": "float", "u1": "uchar"}
BRIGHTEST = 255


def write_points(
    path: str | os.PathLike[str],
    position: Float[np.ndarray, "points 3"],
    normal: Float[np.ndarray, "points 3"],
    color: Float[np.ndarray, "points 3"],
    columns: Mapping[str, Float[np.ndarray, " points"]],
    metadata: tuple[tuple[str, Any], ...] = (),
) -> None:
    """Write points, whole or not at all: positions as `double`, normals and columns as `float`, colours as `uchar`.

    Args:
        path: `.ply`.
        position: length units.
        normal: of unit length.
        color: red, green and blue in [0, 1], display-referred.
        columns: further numbers of each point, by name.
        metadata: names and values, as comments of the header.

    Raises:
        ValueError: another suffix, a place that cannot be written to.
    """
    path = Path(path)
    if path.suffix.lower() != SUFFIX:
        raise ValueError(f"{path}: points of a surface are written as {SUFFIX}; give a name that ends in it")
    fields = [(name, "<f8") for name in "xyz"] + [(name, "<f4") for name in ("nx", "ny", "nz")]
    fields += [(name, "u1") for name in ("red", "green", "blue")] + [(name, "<f4") for name in columns]
    rows = np.empty(len(position), fields)
    shown = np.rint(BRIGHTEST * np.clip(color, 0, 1))
    for values, names in ((position, "xyz"), (normal, ("nx", "ny", "nz")), (shown, ("red", "green", "blue"))):
        for axis, name in enumerate(names):
            rows[name] = values[:, axis]
    for name, column in columns.items():
        rows[name] = column
    said = [f"comment {name} {' '.join(str(value).split())}" for name, value in metadata]
    told = [f"property {KINDS[kind[-2:]]} {name}" for name, kind in fields]
    header = ["ply", "format binary_little_endian 1.0", *said, f"element vertex {len(rows)}", *told, "end_header", ""]
    with written_whole(path) as temporary:
        temporary.write_bytes("\n".join(header).encode("ascii", errors="replace") + rows.tobytes())
