"""Put `vx`, `vy`, `vz` back together: scalar fields of tables and point lists to positions and vector columns."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .damage import DataError

TRIPLES = (("x", "y", "z"), ("X", "Y", "Z"), ("0", "1", "2"))
SEPARATORS = " :._-["
POSITION_BASES = ("", "position", "pos", "points", "point", "coordinates", "coords", "coord", "p", "r")


def gather_vectors(fields: Mapping[str, np.ndarray]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Positions (N, 3) and the other columns, with `a_x, a_y, a_z` or `a:0, a:1, a:2` joined to the vector `a`.

    Units in brackets (`x [m]`, `rho (kg/m3)`) are cut off names. Where there is a scalar `a` too, the vector is `a_xyz`.

    Raises:
        ValueError: no `x y z`, nor another triple that is named as a position; names that differ in their unit only.
    """
    columns: dict[str, np.ndarray] = {}
    for name, values in fields.items():
        if _without_unit(name) in columns:
            raise DataError(f"has the column `{_without_unit(name)}` twice, but for its unit; give them two names")
        columns[_without_unit(name)] = values
    positions: dict[str, np.ndarray] = {}
    for name in list(columns):
        for first, second, third in TRIPLES:
            base, bracket = (name[:-2], "]") if name.endswith(f"{first}]") else (name[:-1], "")
            members = [base + suffix + bracket for suffix in (first, second, third)]
            if name == members[0] and all(member in columns for member in members):
                vector = np.stack([columns.pop(member) for member in members], axis=1)
                label = base.rstrip(SEPARATORS)
                if label.lower() in POSITION_BASES:
                    positions[label.lower()] = vector
                else:
                    columns[f"{label}_xyz" if label in columns else label] = vector
                break
    for base in POSITION_BASES:
        if base in positions:
            position = positions.pop(base)
            return position, {**columns, **positions}
    raise DataError(f"holds no positions: there are {', '.join(fields) or 'no columns'}; name three of them x, y and z")


def _without_unit(name: str) -> str:
    for bracket in (" [", " ("):
        if bracket in name:
            name = name[: name.index(bracket)]
    return name.strip()
