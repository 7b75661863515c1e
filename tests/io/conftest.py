"""Whole files of every format, and what must hold of reading any file."""

from types import SimpleNamespace

import files_written
import fuzzing
import pytest

import jaxsph.io as io


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


def read_or_refuse(path):
    """Read a damaged file: a valid table or a `ValueError` with its name, in memory that its size bounds."""
    result, said = fuzzing.outcome(path, fuzzing.Kind(fuzzing.table), [], is_betrayed=False, memory=2**23)
    assert result != "failed", said


@pytest.fixture(scope="session")
def measured():
    """`with measured() as memory:`, and then `memory.peak` in bytes, of Python and NumPy."""
    return fuzzing.measured


@pytest.fixture(scope="session")
def reader_holds():
    """`reader_holds(path)`: what must hold of reading any file, however damaged."""
    return read_or_refuse
