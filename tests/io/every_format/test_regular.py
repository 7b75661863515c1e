"""What never ends, or waits for ever, is not opened: pipes, sockets and devices are refused by name."""

import os
import socket
import threading

import pytest
from refusals import refused

import jaxsph.io as io
from jaxsph.io.damage import regular_file

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="a system without named pipes")
GUARD_SECONDS = 20

READERS = [
    (io.read_table, ("f.csv", "f.npz", "f.hdf5", "f.vtk", "f.bgeo", "f.ply", "f")),
    (io.read_volume, ("f.npy", "f.nii", "f.nii.gz", "f.nrrd", "f.nhdr", "f.vti")),
    (io.read_image, ("f.png", "f.exr")),
    (io.read_projection, ("f.exr",)),
    (io.read_camera_path, ("f.json",)),
    (io.read_transfer, ("f.json",)),
    (io.movie_info, ("f.mp4",)),
]
CASES = [(read, name) for read, names in READERS for name in names]


def ends_refused(read, path, match):
    """`read(path)` ends, and refuses; in a thread, as what waits for a pipe cannot be stopped otherwise."""
    found = []

    def attempt():
        try:
            read(path)
        except Exception as error:
            found.append(error)

    thread = threading.Thread(target=attempt, daemon=True)
    thread.start()
    thread.join(GUARD_SECONDS)
    assert found, f"{path} is read, or does not end"
    with pytest.raises(ValueError, match=match):
        raise found[0]


@pytest.mark.parametrize(("read", "name"), CASES)
def test_a_named_pipe_is_refused_and_not_waited_for(read, name, tmp_path):
    os.mkfifo(tmp_path / name)
    ends_refused(read, tmp_path / name, rf"{name}: is a named pipe, which may never end; write its content to a file first")


@pytest.mark.parametrize("device", ["/dev/zero", "/dev/urandom"])
@pytest.mark.parametrize(("read", "name"), CASES)
def test_a_link_to_a_device_is_refused(read, name, device, tmp_path):
    if not os.path.exists(device):
        pytest.skip("no such device")
    (tmp_path / name).symlink_to(device)
    ends_refused(read, tmp_path / name, rf"{name}: is a character device, which may never end")


def test_a_socket_is_refused(empty):
    with socket.socket(socket.AF_UNIX) as opened:
        opened.bind("f.csv")  # names of sockets are short
        ends_refused(io.read_table, "f.csv", r"f\.csv: is a socket")


def test_data_beside_a_header_is_no_pipe_either(tmp_path):
    nrrd, numpy = pytest.importorskip("nrrd"), pytest.importorskip("numpy")
    nrrd.write(str(tmp_path / "v.nhdr"), numpy.ones((3, 3, 3), "f4"), {"encoding": "raw"})
    assert io.read_volume(tmp_path / "v.nhdr").values.shape == (3, 3, 3)
    (tmp_path / "v.raw").unlink()
    os.mkfifo(tmp_path / "v.raw")
    ends_refused(io.read_volume, tmp_path / "v.nhdr", r"v\.nhdr: .*v\.raw: is a named pipe")


def test_other_files_of_a_snapshot_are_no_pipes_either(samples, tmp_path):
    h5py = pytest.importorskip("h5py")
    samples.write_gadget_hdf5(tmp_path / "s.0.hdf5", samples.particles())
    with h5py.File(tmp_path / "s.0.hdf5", "a") as file:
        file["Header"].attrs["NumFilesPerSnapshot"] = 2
    os.mkfifo(tmp_path / "s.1.hdf5")
    ends_refused(io.read_table, tmp_path / "s.0.hdf5", r"s\.1\.hdf5: is a named pipe")


def test_files_folders_and_links_to_them_are_let_through(tmp_path):
    (tmp_path / "a").write_text("1")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    assert regular_file(tmp_path / "b") == tmp_path / "b" and regular_file(str(tmp_path), or_folder=True) == tmp_path
    refused("is a folder; give the name of a file in it", regular_file, tmp_path)
    with pytest.raises(FileNotFoundError, match="there is no such file"):
        regular_file(tmp_path / "c")
