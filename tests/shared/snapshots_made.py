"""Gadget-like snapshots in several files, as codes write them."""

import h5py
import numpy as np


def particles(count, seed=0, ordered=True):
    """Columns of particles in the unit cube; ordered by cells of an eighth, or not at all."""
    rng = np.random.default_rng(seed)
    position = rng.random((count, 3)).astype(np.float32)
    if ordered:
        position = position[np.argsort(np.floor(position * 4).astype(int) @ np.array([16, 4, 1]), kind="stable")]
    density = (1 + position[:, 0]).astype(np.float32)
    support = (1.3 * np.cbrt(32 / (4.19 * count)) * rng.uniform(0.5, 1.2, count)).astype(np.float32)
    energy = np.sin(6 * position[:, 0]) * np.cos(5 * position[:, 1]) + 1.5
    return {
        "Coordinates": position,
        "SmoothingLength": support,
        "Masses": density / count,
        "Density": density,
        "InternalEnergy": energy,
        "ParticleIDs": np.arange(count),
    }


def write(folder, columns, files=2, cells=None):
    """The first of the files; `cells` are counts of a SWIFT-like table, for one file."""
    count = len(columns["Coordinates"])
    for number, rows in enumerate(np.array_split(np.arange(count), files)):
        name = f"snap.{number}.hdf5" if files > 1 else "snap.hdf5"
        with h5py.File(folder / name, "w") as file:
            header = file.create_group("Header").attrs
            header["NumFilesPerSnapshot"], header["ThisFile"], header["Time"] = files, number, 0.25
            for column, values in columns.items():
                file[f"PartType0/{column}"] = values[rows]
            if cells is not None:
                file["Cells/Counts/PartType0"] = cells
                file["Cells/OffsetsInFile/PartType0"] = np.cumsum(cells) - cells
    return folder / ("snap.0.hdf5" if files > 1 else "snap.hdf5")
