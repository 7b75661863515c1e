import io as memory_io
import struct
import zipfile

import numpy as np
import pytest
from refusals import refused

import jaxsph.io as io


def test_single_numbers_hold_for_every_particle_and_other_ones_are_left_out(samples, tmp_path):
    samples.write_npz(tmp_path / "a.npz", samples.particles())
    table = io.read_table(tmp_path / "a.npz")
    np.testing.assert_array_equal(table.support, np.full(len(table), 0.5))
    np.testing.assert_array_equal(table.columns["particle_mass"], np.full(len(table), 2.0))
    assert "time" not in table.columns and table.time == 3
    np.savez(tmp_path / "a.npz", position=FOUR, t=0.25)
    assert io.read_table(tmp_path / "a.npz").time == 0.25


FOUR = np.zeros((4, 3))


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"position": FOUR, "support": np.ones(3)}, r"`support` has shape \(3,\), but there are 4 particles"),
        ({"velocity": FOUR}, "holds no `position`, only velocity"),
        ({"position": np.array([[{}, 0, 0]], dtype=object)}, "`position` must hold numbers, got dtype object"),
        ({"x": np.ones(4), "y": np.ones(4), "z": np.ones(3)}, "holds no positions: there are x, y"),
        ({"x": np.ones(4), "y": np.ones(4), "z": np.array(4 * [{}])}, "holds no positions: there are x, y"),
        ({"particles": np.array({}, dtype=object), "version": np.array(2)}, "is an archive of PySPH, .* write HDF5"),
        ({"position": np.full((2, 3), np.nan)}, "positions must be finite"),
    ],
)
def test_arrays_that_are_no_particles_are_refused_and_none_of_objects_is_loaded(arrays, said, tmp_path):
    np.savez(tmp_path / "a.npz", **arrays)
    refused(rf"a\.npz: {said}", io.read_table, tmp_path / "a.npz")


def test_arrays_that_nobody_needs_are_left_out_by_name(tmp_path):
    odd = {
        "evil": np.array(4 * [{}]), "words": np.array(4 * ["gas"]), "waves": np.ones(4, complex), "pairs": np.zeros(4, "f4,i4"),
        "wide": np.ones((4, 0)), "few": np.ones(3),
    }  # fmt: skip
    np.savez(tmp_path / "a.npz", position=FOUR, flags=np.ones(4, bool), halves=np.ones(4, "f2"), big=np.ones(4, ">i2"), **odd)
    table = io.read_table(tmp_path / "a.npz")
    assert set(table.columns) == {"flags", "halves", "big"}
    assert "left out evil, words, waves, pairs: not numbers" in table.conventions
    refused("left out evil, words, waves, pairs: not numbers", io.read_particles, tmp_path / "a.npz", "evil")


def test_layouts_of_the_same_columns_give_the_same_particles(tmp_path):
    h5py = pytest.importorskip("h5py")
    rng = np.random.default_rng(0)
    x, v, h, m, rho = rng.random((5, 3)), rng.random((5, 3)), np.full(5, 0.5), np.full(5, 2.0), rng.random(5) + 1
    flat = {**dict(zip("xyz", x.T, strict=True)), **{f"v{c}": v[:, n] for n, c in enumerate("xyz")}, "h": h, "m": m, "rho": rho}
    whole = {"vx": v[:, 0], "vy": v[:, 1], "vz": v[:, 2], "h": h, "m": m, "rho": rho}
    np.savez(tmp_path / "a.npz", **flat)
    for name in ("pos", "coords", "r", "Coordinates"):
        np.savez(tmp_path / f"{name}.npz", **{name: x}, **whole)
    np.savetxt(tmp_path / "a.csv", np.column_stack(list(flat.values())), "%.17g", ",", header=",".join(flat), comments="")
    for name, columns in (("flat.h5", flat), ("whole.h5", {"Coordinates": x, **whole}), ("one.h5", flat | {"m": 2.0})):
        with h5py.File(tmp_path / name, "w") as file:
            for key, values in columns.items():
                file[key] = values
    tables = [io.read_table(path) for path in sorted(tmp_path.iterdir())]
    assert len(tables) == 9
    for table in tables:
        np.testing.assert_array_equal(table.position, x)
        np.testing.assert_array_equal(table.columns["v"], v)
        assert {name: column.tolist() for name, column in table.columns.items() if name != "v"} == {
            "h": h.tolist(), "m": m.tolist(), "rho": rho.tolist()
        }  # fmt: skip


def test_columns_of_x_and_y_alone_lie_in_a_plane(tmp_path):
    x, v = np.random.default_rng(0).random((2, 2, 6))
    np.savez(tmp_path / "a.npz", x=x[0], y=x[1], vx=v[0], vy=v[1], rho=np.ones(6))
    (tmp_path / "a.csv").write_text(
        "x,y,vx,vy,rho\n" + "".join(f"{a},{b},{c},{d},1\n" for a, b, c, d in zip(*x, *v, strict=True))
    )
    for name in ("a.npz", "a.csv"):
        table = io.read_table(tmp_path / name)
        np.testing.assert_array_equal(table.position, np.column_stack([*x, np.zeros(6)]))
        np.testing.assert_array_equal(table.columns["v"], np.column_stack([*v, np.zeros(6)]))


def npy(array, shape=None):
    """`array` as an `.npy` file that may announce another shape."""
    buffer = memory_io.BytesIO()
    if shape is None:
        np.save(buffer, array)
    else:
        description = {"descr": array.dtype.str, "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(buffer, description)
        buffer.write(array.tobytes())
    return buffer.getvalue()


def write_entries(path, entries, method=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in entries:
            archive.writestr(name, content)


@pytest.mark.parametrize(
    ("stored", "shape", "said"),
    [
        *((FOUR, shape, "`position`.*holds 96") for shape in ((10**10, 3), (2**62, 3), (3, 3))),
        (FOUR, (-1, 3), r"`position`.*of shape \(-1, 3\)"),
        (FOUR[:0, :0], (10**12, 0), r"positions must have shape \(N, 3\)"),  # before other columns are made for them
    ],
)
def test_a_shape_that_the_bytes_cannot_hold_is_refused_before_memory_is_asked_for(stored, shape, said, tmp_path, measured):
    write_entries(tmp_path / "a.npz", [("position.npy", npy(stored, shape)), ("mass.npy", npy(np.float64(1)))])
    with measured() as memory:
        refused(rf"a\.npz: {said}", io.read_table, tmp_path / "a.npz")
    assert memory.peak < 2**22


def test_only_what_belongs_to_particles_is_unpacked(tmp_path, measured):
    np.savez_compressed(tmp_path / "a.npz", position=np.ones((4, 3)), mass=np.ones(4), image=np.zeros((2**12, 2**12)))
    with measured() as memory:
        table = io.read_table(tmp_path / "a.npz")
    assert set(table.columns) == {"mass"} and memory.peak < 2**22


def test_an_entry_that_unpacks_to_more_than_its_directory_says_is_not_unpacked_further(tmp_path, measured):
    header, body = npy(np.zeros((4, 3))), bytes(2**26)
    write_entries(tmp_path / "a.npz", [("position.npy", header + body)])
    content = (tmp_path / "a.npz").read_bytes()
    (tmp_path / "a.npz").write_bytes(content.replace(struct.pack("<I", len(header + body)), struct.pack("<I", len(header))))
    with measured() as memory, pytest.raises(ValueError, match=r"a\.npz: .*CRC"):
        io.read_table(tmp_path / "a.npz")
    assert memory.peak < 2**22


def test_an_entry_that_says_it_shrank_more_than_deflate_can_is_refused(tmp_path):
    write_entries(tmp_path / "a.npz", [("position.npy", npy(np.zeros((4, 3)), (10**6, 3)))])
    content, size = (tmp_path / "a.npz").read_bytes(), len(npy(np.zeros((4, 3))))
    claimed = struct.pack("<I", 24 * 10**6 + 128)
    (tmp_path / "a.npz").write_bytes(content.replace(struct.pack("<I", size), claimed))
    refused(r"a\.npz: `position` .*to 24000128 bytes, more than they can", io.read_table, tmp_path / "a.npz")


def test_an_array_that_is_there_twice_is_refused_by_name(tmp_path):
    with pytest.warns(UserWarning, match="Duplicate name"):
        write_entries(tmp_path / "a.npz", [("position.npy", npy(np.zeros((2, 3)))), ("position.npy", npy(np.ones((2, 3))))])
    refused(r"a\.npz: has the array `position` twice", io.read_table, tmp_path / "a.npz")


def test_a_packing_that_numpy_does_not_use_is_refused(tmp_path):
    write_entries(tmp_path / "a.npz", [("position.npy", npy(np.zeros((2, 3))))], zipfile.ZIP_BZIP2)
    refused(r"a\.npz: `position` is packed by a method .*numpy\.savez", io.read_table, tmp_path / "a.npz")


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", ["<f4", ">f8", "<i8"])
def test_every_layout_of_an_array_is_read(order, dtype, tmp_path):
    position = np.arange(12).reshape(4, 3).astype(dtype, order=order)
    np.savez(tmp_path / "a.npz", position=position, big=np.asfortranarray(position))
    table = io.read_table(tmp_path / "a.npz")
    np.testing.assert_array_equal(table.position, position)
    np.testing.assert_array_equal(table.columns["big"], position)
