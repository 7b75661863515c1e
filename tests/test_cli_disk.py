"""Snapshots that stay on disk, on the command line."""

import numpy as np
import pytest
from snapshots_made import particles, write

from jaxsph import cli, io

TINY = ["--size", "24x32", "--samples", "16"]


def run(capsys, *arguments):
    code = cli.main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return code, out, err.splitlines()


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return write(tmp_path, particles(800, ordered=False))


def test_a_snapshot_is_sorted_and_rendered_from_disk_as_from_memory(file, capsys):
    code, out, _ = run(capsys, "sort", file, "-o", "sorted.hdf5")
    assert code == 0 and "800 particles" in out
    look = ["--range", 0.5, 2.5, "--quantity", "InternalEnergy", *TINY]
    code, out, err = run(capsys, "render", "sorted.hdf5", "--from-disk", 0.1, "-o", "a.exr", *look)
    assert (code, err) == (0, []) and "1, of at most 800 particles" in out and "jaxsph-index.npz" in out
    assert run(capsys, "render", "sorted.hdf5", "-o", "b.exr", *look)[0] == 0
    a, b = (np.asarray(io.read_image(name).color) for name in ("a.exr", "b.exr"))
    np.testing.assert_allclose(a, b, atol=2e-2)  # opacity is chosen by a sample here


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--from-disk", "0"], "positive number of GiB"),
        (["--from-disk", "1", "--where", "Density > 1"], "--where needs all particles"),
        (["--from-disk", "1", "--annotate"], "leave out --progressive"),
    ],
)
def test_what_needs_all_particles_is_refused(file, capsys, arguments, message):
    code, _, err = run(capsys, "render", file, *arguments, *TINY)
    assert code == 2 and message in err[0]
