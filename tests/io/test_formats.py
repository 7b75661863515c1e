import builtins
import subprocess
import sys
import types

import numpy as np
import pytest
from examples import examples
from files_written import WRITERS
from hypothesis import given, strategies as st
from refusals import refused

import jaxsph as js
import jaxsph.io as io
from jaxsph.io.damage import UNENDED_NOTE
from jaxsph.io.formats import FORMATS, READERS, find_format, installed_readers

of_phantom = {"phantom.h5", "disc_00010", "sphere_00020"}  # whose densities follow from h
from_text = {"a.csv", "a.xyz", "extended.xyz"}


@pytest.mark.parametrize("name", WRITERS)
def test_what_was_written_is_read(name, written, samples):
    p, table = samples.particles(), io.read_table(written / name)
    np.testing.assert_array_equal(table.position, p.position)
    assert table.position.dtype.isnative
    for role, names in (
        ("velocity", ("velocity", "velocities", "vxyz", "v")),
        ("id", ("id", "ParticleIDs")),
        ("density", ("density",)),
    ):
        column = table.named(*names)
        if column is not None and name not in of_phantom:
            np.testing.assert_array_equal(table.columns[column], getattr(p, role))
            assert table.columns[column].dtype.isnative
    particles, report = io.particles_from_table(table)
    assert particles.num_particles == len(table) == report.num_particles and table.path == str(written / name)
    assert report.quantity in str(report) and table.path in str(report)


@pytest.mark.parametrize("name", WRITERS)
def test_an_empty_set_is_read_as_one_and_an_empty_file_refused_by_name(name, samples, tmp_path):
    (tmp_path / name).write_bytes(b"")
    refused(name, io.read_table, tmp_path / name)
    samples.writers[name](tmp_path / name, samples.particles(0))
    table = io.read_table(tmp_path / name)
    assert table.position.shape == (0, 3)
    assert io.particles_from_table(table)[0].num_particles == 0


@pytest.mark.parametrize("name", WRITERS)
@given(fraction=st.floats(0, 1, exclude_max=True))
@examples(25)
def test_a_file_cut_anywhere_is_refused_by_name_or_read_right(name, fraction, written, samples, tmp_path_factory):
    whole, p = (written / name).read_bytes(), samples.particles()
    cut = tmp_path_factory.mktemp("cut") / name
    cut.write_bytes(whole[: int(fraction * len(whole))])
    try:
        table = io.read_table(cut)
    except ValueError as error:
        assert str(cut) in str(error)
        return
    cut_in_text = UNENDED_NOTE in table.conventions  # the last number may have lost digits, and this is said
    assert len(table) == len(p.position) or name == "a.csv"  # a CSV file does not say how many rows it has
    same = len(table) - 1 if cut_in_text else len(table)
    np.testing.assert_array_equal(table.position[:same], p.position[:same])
    for column, values in table.columns.items():
        if same and column in ("velocity", "density", "id"):
            np.testing.assert_array_equal(values[:same], getattr(p, column)[:same])


def test_content_wins_over_suffix(written, tmp_path):
    for name in WRITERS:
        if name not in from_text:
            (tmp_path / "snapshot_005").write_bytes((written / name).read_bytes())
            assert find_format(tmp_path / "snapshot_005") is find_format(written / name)


def test_what_is_of_no_format_is_refused(written, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"gone\.vtk"):
        io.read_table(tmp_path / "gone.vtk")
    refused("is a folder", io.read_table, tmp_path)
    (tmp_path / "a.doc").write_bytes(b"hello")
    for suffix in (r"'\.doc'", *(suffix for form in FORMATS for suffix in form.suffixes)):
        refused(suffix, io.read_table, tmp_path / "a.doc")
    for name in ("a.npz", "points.hdf5"):
        refused("leave out `part_type`", io.read_table, written / name, part_type=1)


@pytest.mark.parametrize(("name", "library"), [("gadget.hdf5", "h5py"), ("phantom.h5", "h5py")])
def test_a_missing_library_is_named_with_the_extra_that_brings_it(name, library, written, monkeypatch):
    for module in [m for m in sys.modules if m == library or m.startswith(f"{library}.")]:
        monkeypatch.delitem(sys.modules, module)
    real = builtins.__import__

    def refuse(wanted, *args, **kwargs):
        if wanted.partition(".")[0] == library:
            raise ImportError(wanted)
        return real(wanted, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ImportError, match=rf'the library `{library}` is needed for .*: pip install "jaxsph\[io\]"'):
        io.read_table(written / name)


def test_optional_libraries_are_not_imported_before_they_are_needed():
    code = "import sys, jaxsph.io; assert not {'h5py', 'meshio', 'tqdm', 'OpenEXR'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


POINT = "extra"


def bring(monkeypatch, tmp_path, loaded):
    """One entry point that loads what is given, or raises it."""

    class Point:
        name, value = POINT, "package:FORMAT"

        def load(self):
            if isinstance(loaded, Exception):
                raise loaded
            return loaded

    monkeypatch.setattr("jaxsph.io.formats.installed_readers", lambda path: [Point()])


def test_a_format_of_another_package_is_read_by_its_reader(monkeypatch, tmp_path):
    (tmp_path / "one_file_reader.py").write_text(
        "import numpy as np\nimport jaxsph as js\n"
        "def read(path):\n    return js.io.ParticleTable(np.loadtxt(path, skiprows=1, ndmin=2)[:, :3])\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    package = types.ModuleType("one_package")
    package.__path__ = [str(tmp_path)]
    monkeypatch.setitem(sys.modules, "one_package", package)
    form = js.io.Format("mine", (".mine",), "one_package.one_file_reader", lambda start: start.startswith(b"MINE"))
    bring(monkeypatch, tmp_path, form)
    path = tmp_path / "a.mine"
    path.write_text("MINE\n1 2 3\n4 5 6\n")
    np.testing.assert_array_equal(js.io.read_table(path).position, [[1, 2, 3], [4, 5, 6]])


def test_packages_bring_their_readers_by_entry_points(monkeypatch, tmp_path):
    (tmp_path / "one_package-1.dist-info").mkdir()
    (tmp_path / "one_package-1.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: one-package\nVersion: 1\n")
    (tmp_path / "one_package-1.dist-info" / "entry_points.txt").write_text(f"[{READERS}]\n{POINT} = package:FORMAT\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert [point.value for point in installed_readers(tuple(sys.path)) if point.name == POINT] == ["package:FORMAT"]


@pytest.mark.parametrize("loaded", [ImportError("no such module"), "not a format"])
def test_a_reader_that_cannot_be_loaded_is_left_out_and_named(monkeypatch, tmp_path, loaded):
    bring(monkeypatch, tmp_path, loaded)
    path = tmp_path / "a.csv"
    path.write_text("x,y,z\n1,2,3\n")
    with pytest.warns(UserWarning, match=f"reader '{POINT}'.*left out"):
        assert len(js.io.read_table(path)) == 1
