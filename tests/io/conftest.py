"""Whole files of every format, and what must hold of reading any file."""

import contextlib
import tracemalloc
import warnings
from types import SimpleNamespace

import files_written
import numpy as np
import pytest

import jaxsph.io as io

MEMORY, MEMORY_PER_BYTE = 2**23, 64
"""What reading a file of some size may take: far more than any needs, and far less than what a header can ask for."""


@pytest.fixture(scope="session")
def samples():
    """What makes small files: `samples.particles()`, `samples.writers[name](path, particles)`, `write_...`."""
    return SimpleNamespace(particles=files_written.make_particles, writers=files_written.WRITERS, **vars(files_written))


@pytest.fixture(scope="session")
def written(samples, tmp_path_factory):
    """A folder with a whole file of every format, each read once: what libraries keep from then on is no file's memory."""
    folder = tmp_path_factory.mktemp("whole")
    for name, write in samples.writers.items():
        write(folder / name, samples.particles())
        io.read_table(folder / name)
    return folder


@contextlib.contextmanager
def measure():
    memory = SimpleNamespace(peak=0)
    tracemalloc.start()
    try:
        yield memory
    finally:
        memory.peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()


def read_or_refuse(path):
    """Read a damaged file: a valid table or a `ValueError` with its name, in memory that its size bounds."""
    table = None
    with measure() as memory, warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        try:
            table = io.read_table(path)
        except ValueError as error:
            assert str(path) in str(error)
    assert memory.peak < MEMORY + MEMORY_PER_BYTE * path.stat().st_size
    if table is not None:
        assert np.isfinite(table.position).all() and table.position.shape == (len(table), 3)
        assert all(len(column) == len(table) for column in table.columns.values())
        assert {"x", "y", "z"} <= set(io.available_quantities(table))


@pytest.fixture(scope="session")
def measured():
    """`with measured() as memory:`, and then `memory.peak` in bytes, of Python and NumPy."""
    return measure


@pytest.fixture(scope="session")
def reader_holds():
    """`reader_holds(path)`: what must hold of reading any file, however damaged."""
    return read_or_refuse
