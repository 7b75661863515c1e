"""What a volume file holds: arrays by name on one grid whose axes lie along x, y and z.

Flow: file -> reader -> [VolumeTable] -> Volume.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from jaxsph.io.damage import DataError
from jaxsph.io.parsing import Columns
from jaxsph.numerics.names import did_you_mean

COMPONENTS = {"x": 0, "y": 1, "z": 2}
SKEW = 1e-6  # of a step along an axis that may lie across it: directions are written with some seven digits
MAGNITUDE = "magnitude"


@dataclasses.dataclass(frozen=True)
class VolumeTable:
    """Arrays by name, (nx, ny, nz) or (nx, ny, nz, components), at the points of a grid.

    Attributes:
        lower, spacing: of the grid, (3,), in the file's length unit.
        source: name of the format.
        conventions: what a user should know about how it was read.
        path: the file, or an empty string.
    """

    arrays: Columns
    lower: np.ndarray
    spacing: np.ndarray
    source: str
    conventions: tuple[str, ...] = ()
    path: str = ""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Grid points along x, y and z."""
        return next(iter(self.arrays.values())).shape[:3]  # type: ignore[return-value]

    def quantity(self, name: str | None) -> tuple[str, np.ndarray]:
        """One number a grid point, and what it is called: an array, a component (`B.x`, `B.0`) or `B.magnitude`.

        Without a name it is the first array of one number, else the magnitude of the first.
        """
        if name is None:
            plain = [key for key, values in self.arrays.items() if values.ndim == 3]
            name = plain[0] if plain else f"{next(iter(self.arrays))}.{MAGNITUDE}"
        if name in self.arrays and self.arrays[name].ndim == 3:
            return name, self.arrays[name]
        whole, _, part = name.rpartition(".")
        values = self.arrays.get(whole)
        if values is not None and values.ndim == 4:
            if part == MAGNITUDE:
                return name, np.sqrt((values.astype(np.float64) ** 2).sum(-1))
            index = COMPONENTS.get(part, int(part) if part.isdecimal() else -1)
            if 0 <= index < values.shape[3]:
                return name, values[..., index]
        raise DataError(f"has no quantity {name!r}; it has {', '.join(self.names())}{did_you_mean(name, self.names())}")

    def names(self) -> list[str]:
        """All that `quantity` knows."""
        return [
            f"{key}{part}"
            for key, values in self.arrays.items()
            for part in ([""] if values.ndim == 3 else [*(f".{i}" for i in range(values.shape[3])), f".{MAGNITUDE}"])
        ]


def along_axes(
    arrays: Columns, origin: np.ndarray, steps: np.ndarray, source: str, conventions: tuple[str, ...] = ()
) -> VolumeTable:
    """A table of arrays whose index k moves by column k of `steps` from `origin`; axes are permuted and flipped into x, y, z."""
    steps, origin = np.asarray(steps, np.float64), np.asarray(origin, np.float64)
    if not (np.isfinite(steps).all() and np.isfinite(origin).all()):
        raise DataError(f"has an origin or spacing that is not finite: {origin.tolist()}, {steps.tolist()}; write it again")
    lengths = np.linalg.norm(steps, axis=0)
    if not (lengths > 0).all():
        raise DataError(f"has a spacing of {lengths.tolist()}, which must be > 0; write it again with the distance of points")
    shares = abs(steps) / lengths
    axis = shares.argmax(0)
    if sorted(axis) != [0, 1, 2] or (np.sort(shares, 0)[:2] > SKEW).any():
        wrong = f"has oblique axes (directions {(steps / lengths).T.round(6).tolist()}),"
        raise DataError(f"{wrong} and a volume's axes lie along x, y and z; resample it onto such a grid first")
    order, lower = np.argsort(axis), origin.copy()
    shape = next(iter(arrays.values())).shape
    flips = tuple(int(k) for k in range(3) if steps[axis[k], k] < 0)
    for k in flips:
        lower += (shape[k] - 1) * steps[:, k]
    turned = {name: np.moveaxis(np.flip(values, flips), order, (0, 1, 2)) for name, values in arrays.items()}
    return VolumeTable(turned, lower, lengths[order], source, conventions)
