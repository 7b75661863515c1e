"""Snapshots that stay on disk, on the command line."""

import numpy as np
import pytest
from commanded import run
from snapshots_made import particles, write

import jaxsph as js
from jaxsph import io

pytestmark = pytest.mark.usefixtures("quick_programs")

TINY = ["--size", "24x32", "--samples", "16"]


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return write(tmp_path, particles(800, ordered=False))


def test_a_snapshot_is_rendered_from_disk_as_from_memory(file, capsys):
    transfer = js.TransferFunction.from_points([0.5, 1.0, 2.5], [[0, 0, 1], [0, 1, 0], [1, 0, 0]], [0.1, 2.0, 5.0])
    io.write_transfer("look.json", transfer)  # else opacity would be chosen by a sample of what is on disk
    look = ["--transfer", "look.json", "--quantity", "InternalEnergy", *TINY]
    code, out, err = run(capsys, "render", file, "--from-disk", 0.1, "-o", "a.exr", *look)
    assert (code, err) == (0, []) and "1, of at most 800 particles" in out and "jaxsph-index.npz" in out
    assert out.count("y; --up 0,0,1 has z") == 1
    scene = js.Scene(particles=io.read_particles(file, "InternalEnergy"), transfer=transfer)
    camera = js.Camera.framing(js.scale.OnDisk.open(file, "InternalEnergy"), fov_degrees=30, width=24, height=32)
    a = np.asarray(io.read_image("a.exr").color)
    b = np.asarray(js.render(scene, camera, js.Settings(samples=16)).color)
    assert b.max() > 0.1
    np.testing.assert_allclose(a, b, rtol=0, atol=3e-7)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--from-disk", "0"], "positive number of GiB"),
        (["--from-disk", "1", "--where", "Density > 1"], "--where and --from-disk exclude each other"),
        (["--from-disk", "1", "--annotate"], "--annotate and --from-disk exclude each other"),
    ],
)
def test_what_needs_all_particles_is_refused(file, capsys, arguments, message):
    code, _, err = run(capsys, "render", file, *arguments, *TINY)
    assert code == 2 and message in err[0]


def test_too_little_memory_names_the_file_the_option_and_the_least_of_it_that_works(file, capsys):
    code, _, err = run(capsys, "render", file, "--from-disk", "0.00001", *TINY)
    assert (code, len(err)) == (1, 1) and f"{file}: --from-disk 1e-05 is too little" in err[0]
    least = float(err[0].split("give --from-disk ")[1].split()[0])
    assert run(capsys, "render", file, "--from-disk", least, "-o", "a.png", *TINY)[0] == 0


@pytest.mark.parametrize("kind", ["a folder", "bytes", "nothing"])
def test_what_is_not_gadget_like_hdf5_is_refused_in_one_line_that_says_what_can_be_read(file, capsys, kind):
    other = file.parent / "other.dat"
    if kind == "a folder":
        (other / "gas").mkdir(parents=True)
        (other / "gas" / "pos").write_bytes(bytes(40))
    else:
        other.write_bytes(b"" if kind == "nothing" else bytes(range(256)))
    code, _, err = run(capsys, "render", other, "--from-disk", 1)
    assert code == 1 and len(err) == 1 and f"{other}: is not a Gadget-like HDF5 snapshot, all that" in err[0]
