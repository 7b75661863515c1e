"""Dumps of Phantom, in its own format and in HDF5: those are written by conftest, which knows the format and not the reader."""

import numpy as np
import pytest
from refusals import refused

import jaxsph.io as io
from jaxsph.io.formats import find_format
from jaxsph.io.readers import phantom
from jaxsph.sequence import Snapshots

NOTHING = (0, {})
SINKS = {
    "x": [0.0, 1.0, 5.0], "y": [0.0, 2.0, 5.0], "z": [0.0, 3.0, 5.0], "m": [1.0, 0.5, -0.25], "h": [0.25, 0.125, 0.5],
    "vx": [1.0, 0, 0], "vy": [0.0, 1, 0], "vz": [0.0, 0, 1], "spinx": [1.0, 2, 3], "spiny": [1.0, 2, 3], "spinz": [1.0, 2, 3],
}  # fmt: skip


@pytest.fixture
def dump(samples, tmp_path):
    """`dump(blocks, **how)` is the path of a dump; blocks by default are 7 particles of gas."""

    def write(*blocks, **how):
        blocks = list(blocks) or [samples.phantom_particles(samples.particles()), NOTHING, NOTHING, NOTHING]
        (tmp_path / "disc_00010").write_bytes(b"".join(samples.phantom_records(blocks, **how)))
        return tmp_path / "disc_00010"

    return write


@pytest.fixture
def hdf5(samples, tmp_path):
    """`hdf5({name: value}, **how)` is the path of a dump in HDF5, with other data sets; without those whose value is None."""
    h5py = pytest.importorskip("h5py")

    def write(changes=(), **how):
        samples.write_phantom(tmp_path / "a.h5", samples.particles(), **how)
        with h5py.File(tmp_path / "a.h5", "a") as file:
            for name, value in dict(changes).items():
                file.pop(name, None)
                if value is not None:
                    file[name] = value
        return tmp_path / "a.h5"

    return write


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("int_bytes", [4, 8])
@pytest.mark.parametrize("real_bytes", [4, 8])
@pytest.mark.parametrize("name", ["FT:Phantom:2025.0.0:abc (hydro)", "ST:Phantom:1.1.0:abc (mhd)"])
def test_full_and_small_dumps_of_any_kinds_are_read(name, real_bytes, int_bytes, order, samples, dump):
    p = samples.particles()
    path = dump(name=name, real_bytes=real_bytes, int_bytes=int_bytes, order=order)
    assert find_format(path).name == "Phantom dump"
    table = io.read_table(path)
    np.testing.assert_array_equal(table.position, p.position)
    np.testing.assert_array_equal(table.columns["vxyz"], p.velocity)
    np.testing.assert_array_equal(table.support, np.full(7, 1.0))
    np.testing.assert_array_equal(table.columns["mass"], np.full(7, 2.0))
    np.testing.assert_allclose(table.columns["density"], np.full(7, 2 * 2.5**3))
    np.testing.assert_allclose(table.volume, np.full(7, 0.4**3))
    assert (table.kernel, table.part_type, table.time) == ("cubic_spline", 1, 3.0)
    assert table.position.dtype == np.dtype(f"f{real_bytes}") and all(each.dtype.isnative for each in table.columns.values())
    assert "support = 2 x smoothing length h (Phantom convention)" in table.conventions


@pytest.mark.parametrize("part_type", [1, 3, -1])
def test_a_dump_says_what_its_conversion_to_hdf5_says(part_type, samples, dump, hdf5):
    h, kinds = np.array([0.5, -1, 0.5, 2, 0, 0.25, 0.5]), [1, 1, 3, -3, 3, 1, 1]
    stated = {"udist": 1e16, "umass": 2e33, "utime": 1e10, "umagfd": 1.0, "time": 3.0}
    sinks = {"xyz": np.stack([SINKS[axis] for axis in "xyz"], 1), "m": np.array(SINKS["m"]), "h": np.array(SINKS["h"])}
    changes = {f"header/{name}": value for name, value in stated.items()} | {
        f"sinks/{name}": each for name, each in sinks.items()
    }
    own = {name: SINKS[name] for name in ("x", "y", "z", "m", "h")}
    path = dump(samples.phantom_particles(samples.particles(), h, kinds), (3, {"f0": own}), NOTHING, NOTHING)
    other = io.read_table(
        hdf5(changes | {"particles/derived/speed": np.ones(7)}, h=h, itype=np.array(kinds)), part_type=part_type
    )
    one = io.read_table(path, part_type=part_type)
    assert one.conventions == other.conventions and one.units == other.units and one.time == other.time
    assert one.columns.keys() == other.columns.keys()
    for name, column in {**one.columns, "position": one.position}.items():
        np.testing.assert_allclose(column, {**other.columns, "position": other.position}[name], rtol=1e-6)


def test_one_type_is_read_with_its_own_mass_and_the_dead_are_left_out(samples, dump):
    h, p = np.array([0.5, -1, 0.5, 0.5, 0, 0.25, 0.5]), samples.particles()
    path = dump(samples.phantom_particles(p, h, [1, 1, 3, -3, 3, 1, 1]), NOTHING)
    gas, other = io.read_table(path), io.read_table(path, part_type=3)
    assert len(gas) == 3 and len(other) == 2 and set(gas.columns["mass"]) == {2.0} and set(other.columns["mass"]) == {3.0}
    np.testing.assert_array_equal(gas.position, p.position[[0, 5, 6]])
    np.testing.assert_array_equal(gas.support, [1, 0.5, 1])
    np.testing.assert_allclose(gas.columns["density"], 2 * (1.25 / h[[0, 5, 6]]) ** 3)
    np.testing.assert_allclose(gas.volume, gas.columns["mass"] / gas.columns["density"])
    said = {"dropped 2 dead or accreted particles (h <= 0)", "particles of itype 1; left out 2 of other types"}
    assert said <= set(gas.conventions)
    refused("no particles of type 2; `part_type` can be 1, 3", io.read_table, path, part_type=2)


@pytest.mark.parametrize(
    ("changes", "how", "said"),
    [
        ({"header/hfact": None}, {}, "has no `hfact`"), ({"header/massoftype": None}, {}, "has no `massoftype`"),
        ({"particles/h": None}, {}, "has no `h`"), ({"header/hfact": 0.0}, {}, "has `hfact` 0"),
        ({"header/hfact": [1.0, 2.0]}, {}, "has 2 values of `hfact`"),
        (
            {},
            {"h": np.array([0.5, -1, 0.5, np.nan, 0.5, np.nan, 0.5])},
            "smoothing lengths .*2 of 7 are NaN, the first at index 3",
        ),
        *(
            ({}, {name: np.ones(shape)}, rf"has 7 positions, but `{name}` has the shape \(")
            for name in ("h", "itype")
            for shape in ((), (6,), (7, 2))
        ),
    ],
)  # fmt: skip
def test_hdf5_without_what_supports_and_volumes_follow_from_is_refused(changes, how, said, hdf5):
    refused(rf"a\.h5: {said}", io.read_table, hdf5(changes, **how))


def test_without_types_the_header_says_how_many_there_are_of_each(samples, dump):
    rows, arrays = samples.phantom_particles(samples.particles())
    header = samples.PHANTOM_HEADER | {"i8": {"npartoftype": [5, 0, 2]}, "i0": {"nblocks": [1]}}
    path = dump((rows, arrays | {"i1": {}}), header=header)
    assert len(io.read_table(path)) == 5 and len(io.read_table(path, part_type=3)) == 2
    assert len(io.read_table(dump((rows, arrays | {"i1": {}}), header=header | {"i8": {"npartoftype": [5, 0, 9]}}))) == 7


def test_refined_particles_have_less_mass(samples, dump):
    rows, arrays = samples.phantom_particles(samples.particles())
    table = io.read_table(dump((rows, arrays | {"i1": {"itype": np.ones(7), "apr_level": [1, 1, 2, 2, 3, 3, 1]}})))
    np.testing.assert_array_equal(table.columns["mass"], [2, 2, 1, 1, 0.5, 0.5, 2])
    np.testing.assert_allclose(table.columns["mass"] / table.columns["density"], table.volume)


def test_sinks_are_counted_and_read_as_a_type_of_their_own(samples, dump):
    path = dump(samples.phantom_particles(samples.particles()), (3, {"f0": SINKS}), NOTHING, NOTHING)
    assert "3 sink particles are left out: they are part_type -1" in io.read_table(path).conventions
    refused(r"no particles of type 2; `part_type` can be 1, -1 \(sinks\)", io.read_table, path, part_type=2)
    table = io.read_table(path, part_type=-1)
    np.testing.assert_array_equal(table.position, [[0, 0, 0], [1, 2, 3]])
    np.testing.assert_array_equal(table.columns["spinxyz"], [[1, 1, 1], [2, 2, 2]])
    assert table.columns["mass"].tolist() == [1, 0.5] and table.support is None and table.kernel is None
    assert "dropped 1 sinks that were merged with others (mass < 0)" in table.conventions


def test_without_sinks_there_are_none_to_ask_for(dump, hdf5):
    refused(r"disc_00010: has no sink particles \(type -1\)", io.read_table, dump(), part_type=-1)
    refused(r"a\.h5: has no sink particles", io.read_table, hdf5(), part_type=-1)


def test_the_field_of_the_fourth_block_and_arrays_of_one_name_are_columns(samples, dump):
    rows, arrays = samples.phantom_particles(samples.particles(), divv=np.arange(7.0))
    field = {"Bx": np.ones(7), "By": np.zeros(7), "Bz": np.full(7, 2.0), "psi": np.arange(7.0)}
    table = io.read_table(dump((rows, arrays), NOTHING, NOTHING, (7, {"f4": field})))
    np.testing.assert_array_equal(table.columns["Bxyz"], np.tile([1, 0, 2], (7, 1)))
    assert table.columns["psi"].tolist() == table.columns["divv"].tolist() == list(range(7))
    assert table.units.columns["Bxyz"].cgs == 1.0 and table.units.length.cgs == 1e16


def test_blocks_of_several_processes_are_joined(samples, dump):
    p = samples.particles()
    header = samples.PHANTOM_HEADER | {"i0": {"nblocks": [2]}}
    block = samples.phantom_particles(p)
    path = dump(block, (3, {"f0": SINKS}), block, NOTHING, header=header)
    refused("other arrays", io.read_table, path)
    path = dump(block, (3, {"f0": SINKS}), block, (3, {"f0": SINKS}), header=header)
    np.testing.assert_array_equal(io.read_table(path).position, np.concatenate([p.position] * 2))
    assert len(io.read_table(path, part_type=-1)) == 4


def test_records_longer_than_a_length_can_say_are_several(samples, dump):
    path, block = dump(), samples.phantom_particles(samples.particles())
    pieces = samples.phantom_records([block], limit=13)
    pieces[0] = samples.phantom_records([block])[0]  # by its length, byte order and kinds are known
    assert len(b"".join(pieces)) > path.stat().st_size
    path.write_bytes(b"".join(pieces))
    np.testing.assert_array_equal(io.read_table(path).position, samples.particles().position)


def test_a_dump_cut_behind_or_inside_any_record_is_refused(samples, tmp_path):
    records = samples.phantom_records([samples.phantom_particles(samples.particles()), (3, {"f0": SINKS})])
    for number in range(1, len(records)):
        for cut in (b"", records[number][:2], records[number][:-4], records[number][:-1]):
            (tmp_path / "x").write_bytes(b"".join(records[:number]) + cut)
            with pytest.raises(ValueError, match=r"x: is cut short: .* is not complete; copy it again") as caught:
                io.read_table(tmp_path / "x")
            assert "\n" not in str(caught.value)


def test_lengths_that_differ_are_refused_and_so_is_what_is_left_over(samples, tmp_path):
    records = samples.phantom_records([samples.phantom_particles(samples.particles()), NOTHING])
    for number in range(len(records)):
        changed = records[number][:-4] + np.array(np.frombuffer(records[number][-4:], "<i4") + 4, "<i4").tobytes()
        (tmp_path / "x").write_bytes(b"".join([*records[:number], changed, *records[number + 1 :]]))
        refused(r"x: is damaged: the record of .* begins with length .* and ends with", io.read_table, tmp_path / "x")
    (tmp_path / "x").write_bytes(b"".join(records) + b"\0" * 8)
    refused("x: has 8 more bytes than its arrays", io.read_table, tmp_path / "x")


@pytest.mark.parametrize("rows", [-1, 6, 8, 2**31, 2**62])
def test_rows_that_arrays_do_not_have_are_refused(rows, samples, dump):
    _, arrays = samples.phantom_particles(samples.particles())
    refused("is damaged: ", io.read_table, dump((rows, arrays)))


@pytest.mark.parametrize("number", [-1, 0, 2**31 - 1])
def test_absurd_numbers_of_processes_and_blocks_are_refused(number, samples, dump):
    path, made = dump(), samples.phantom_records([samples.phantom_particles(samples.particles())])
    at = next(n for n, record in enumerate(made) if len(record) == 4 + 8 + 8 * 4 + 4) - 1
    made[at] = samples.fortran(np.array(number, "<i4"))
    path.write_bytes(b"".join(made))
    refused(r"is damaged|is cut short", io.read_table, path)


@pytest.mark.parametrize(
    ("header", "left_out", "said"),
    [
        ("hfact", "", "has no `hfact`"),
        ("massoftype", "", "has no `massoftype`"),
        ("", "f4", "has no `h`"),
        ("", "f0", "no positions"),
    ],
)
def test_a_dump_without_what_supports_and_volumes_follow_from_is_refused(header, left_out, said, samples, dump):
    stated = {k: {t: v for t, v in each.items() if t != header} for k, each in samples.PHANTOM_HEADER.items()}
    rows, arrays = samples.phantom_particles(samples.particles())
    refused(said, io.read_table, dump((rows, {k: v for k, v in arrays.items() if k != left_out}), header=stated))
    refused("has no `h`", io.read_table, dump(NOTHING))


def test_dumps_without_tags_and_other_files_are_refused(dump, tmp_path):
    refused("is a dump without tags, by 'F:Phantom", io.read_table, dump(name="F:Phantom"))
    (tmp_path / "x").write_bytes(b"\x18\0\0\0" + bytes(100))
    starts = [(tmp_path / "x").read_bytes(), b"", dump().read_bytes()]
    assert [phantom.looks_like(start) for start in starts] == [False, False, True]
    refused("another format", phantom.read, tmp_path / "x")


def test_particles_are_followed_by_iorig_from_dump_to_dump(samples, tmp_path):
    """Stored in another order in the second, all moved by 4 along y."""
    order, places = np.random.default_rng(8).permutation(7), []
    for number, rows in enumerate((np.arange(7), order)):
        p = samples.particles()
        p.position, p.velocity = (p.position + np.array([0, 4 * number, 0], "f4"))[rows], p.velocity[rows]
        count, arrays = samples.phantom_particles(p)
        header = {"f0": {"time": [float(number)], "hfact": [1.25], "massoftype": [2.0]}}
        path = tmp_path / f"disc_{number:05d}"
        path.write_bytes(b"".join(samples.phantom_records([(count, arrays | {"i8": {"iorig": rows + 1}}), NOTHING], header)))
        places.append(path)
    at = Snapshots.from_files(places, quantity="density").at(0.25).particle_set.to_numpy()["position"]
    start = samples.particles().position
    np.testing.assert_allclose(at[np.lexsort(at.T)], (start + [0, 1, 0])[np.lexsort((start + [0, 1, 0]).T)], atol=1e-5)


def test_sinks_are_points_with_a_radius_that_is_given_or_their_own(samples, dump):
    path = dump(samples.phantom_particles(samples.particles()), (3, {"f0": SINKS}), NOTHING, NOTHING)
    assert np.asarray(io.read_points(path, part_type=-1).radius).tolist() == [0.25, 0.125]
    assert np.asarray(io.read_points(path, part_type=-1, radius=0.5).radius).tolist() == [0.5, 0.5]
    path = dump(samples.phantom_particles(samples.particles()), (3, {"f0": {**SINKS, "h": [0.25, -1.0, 0.5]}}), NOTHING, NOTHING)
    assert len(io.read_points(path, part_type=-1, radius=0.5).position) == 2
