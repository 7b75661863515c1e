"""Snapshots in several files are read as one."""

import os
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, strategies as st
from refusals import refused

import jaxsph as js
from jaxsph.io.snapshot_files import files_of, in_order, missing_numbers, numbers_of, require_no_gap
from jaxsph.sequence import Snapshots


def write(path, nth, total, gas, dark=2):
    rng = np.random.default_rng(nth)
    with h5py.File(path, "w") as file:
        header = file.create_group("Header").attrs
        header["NumFilesPerSnapshot"], header["Time"], header["BoxSize"] = total, 0.5, 1.0
        for kind, count in ((0, gas), (1, dark)):
            if count:
                group = file.create_group(f"PartType{kind}")
                group["Coordinates"] = rng.random((count, 3))
                group["Masses"] = np.full(count, 1.0 + nth)
                if kind == 0:
                    group["Density"], group["SmoothingLength"] = rng.random(count) + 1, np.full(count, 0.1)


def snapshot(folder, counts=(5, 0, 7)):
    for nth, gas in enumerate(counts):
        write(folder / f"snap_002.{nth}.hdf5", nth, len(counts), gas)
    return [folder / f"snap_002.{nth}.hdf5" for nth in range(len(counts))]


@pytest.mark.parametrize("given", range(3))
def test_any_file_of_a_snapshot_stands_for_all_even_one_without_gas(tmp_path, given):
    files = snapshot(tmp_path)
    table = js.io.read_table(files[given])
    assert len(table) == 12 and table.part_type == 0
    np.testing.assert_array_equal(table.columns["Masses"], [1.0] * 5 + [3.0] * 7)
    assert "of 3 files" in " ".join(table.conventions)
    assert len(js.io.read_table(files[given], part_type=1)) == 6


def test_a_type_that_is_empty_everywhere_stays_that_type(tmp_path):
    for nth, path in enumerate(snapshot(tmp_path, (5, 7))):
        with h5py.File(path, "a") as file:
            file.create_group("PartType4")["Coordinates"] = np.zeros((0, 3))
            if nth:
                del file["PartType0"], file["PartType1"]
        shutil.copy(path, tmp_path / f"none.{nth}.hdf5")
    with h5py.File(tmp_path / "none.0.hdf5", "a") as file:
        del file["PartType0"], file["PartType1"]
    stars, nobody = (
        js.io.read_table(tmp_path / name, part_type=kind) for name, kind in (("snap_002.0.hdf5", 4), ("none.0.hdf5", None))
    )
    assert (len(stars), stars.part_type, len(nobody), nobody.part_type) == (0, 4, 0, 4)


def test_types_that_begin_in_another_file_are_read(tmp_path, samples):
    for nth, counts in enumerate(((0, 0), (0, 3), (4, 0))):
        write(tmp_path / f"late.{nth}.hdf5", nth, 3, *counts)
        with h5py.File(tmp_path / f"late.{nth}.hdf5", "a") as file:
            file["Header"].attrs["NumPart_ThisFile"] = counts
    for nth, (gas, dark) in enumerate(((0, 3), (4, 0))):
        path = tmp_path / f"late.{nth}"
        samples.write_gadget_binary(path, samples.particles(gas), dark=dark)
        content = bytearray(path.read_bytes())
        head = content.index(b"HEAD") + 16
        content[head + 96 : head + 104], content[head + 124 : head + 128] = np.uint32([4, 3]).tobytes(), np.uint32(2).tobytes()
        path.write_bytes(content)
    for path in tmp_path.iterdir():
        tables = [js.io.read_table(path, part_type=kind) for kind in (None, 0, "gas", 1, "dm")]
        assert [len(table) for table in tables] == [4, 4, 4, 3, 3], path
        assert [table.part_type for table in tables] == [0, 0, 0, 1, 1]
        refused("has no (particles of type 4|type of particles)", js.io.read_table, path, part_type="stars")


def test_types_are_not_taken_from_other_snapshots(tmp_path):
    for nth, counts in enumerate(((0, 3), (4, 0))):  # a sequence
        write(tmp_path / f"run.{nth}.hdf5", nth, 1, *counts)
    refused(
        r"run\.0\.hdf5: has no particles of type 0; `part_type` can be 1", js.io.read_table, tmp_path / "run.0.hdf5", part_type=0
    )


def test_columns_that_not_all_files_have_are_left_out_by_name(tmp_path):
    files = snapshot(tmp_path)
    for path, extra in ((files[0], {"Dust": (5,), "Flux": (5, 3)}), (files[2], {"Age": (7,), "Flux": (7,)})):
        with h5py.File(path, "a") as file:
            for name, shape in extra.items():
                file[f"PartType0/{name}"] = np.zeros(shape)
    table = js.io.read_table(files[1])
    assert {"Masses", "Density"} <= set(table.columns) and not {"Dust", "Age", "Flux"} & set(table.columns)
    assert "left out Age, Dust, Flux: in some files of the snapshot only" in table.conventions
    refused("no quantity 'Age'.*left out Age, Dust, Flux: in some", js.io.read_particles, files[0], "Age")


def test_a_part_that_is_written_again_makes_another_mark_of_a_sequence(tmp_path):
    files = snapshot(tmp_path)
    mark = Snapshots.from_files(files[:1]).fingerprint(0.5)
    os.utime(files[2], ns=(0, 0))
    assert Snapshots.from_files(files[:1]).fingerprint(0.5) != mark


def without_density(path):
    with h5py.File(path, "a") as file:
        del file["PartType0/Density"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (Path.unlink, r"one of 3 files.*beside it snap_002\.2\.hdf5 cannot be found"),
        (lambda path: path.write_bytes(path.read_bytes()[:600]), r"snap_002\.2\.hdf5: cannot be read"),
        (without_density, r"snap_002\.2\.hdf5: Density"),
        (lambda path: (path.unlink(), os.mkfifo(path)), r"snap_002\.2\.hdf5: is a named pipe"),
    ],
)
def test_a_file_that_is_missing_damaged_or_no_file_is_named(change, said, tmp_path):
    files = snapshot(tmp_path)
    for name in ("snap_002.02.hdf5", "snap_002.2.hdf5.bak"):  # which are none of them
        (tmp_path / name).touch()
    change(files[2])
    refused(said, js.io.read_table, files[0])


def test_a_name_without_its_number_is_read_alone_and_says_so(tmp_path):
    write(tmp_path / "alone.hdf5", 0, 4, 5)
    table = js.io.read_table(tmp_path / "alone.hdf5")
    assert len(table) == 5 and "only its particles are read" in " ".join(table.conventions)


def test_names_of_files_of_a_snapshot_keep_their_suffix(tmp_path):
    for number in range(2):
        (tmp_path / f"snap.{number}").touch()
    assert [file.name for file in files_of(tmp_path / "snap.1", 2)] == ["snap.0", "snap.1"]
    assert files_of(tmp_path / "snap.hdf5", 2) is None
    assert files_of(tmp_path / "snap.7.hdf5", 2) is None


@pytest.mark.parametrize("number", [5, 10**7, 2**31 - 1])
def test_a_header_may_ask_for_any_number_of_files(number, tmp_path, measured):
    write(tmp_path / "snap_002.0.hdf5", 0, number, 5)
    with measured() as memory, pytest.raises(ValueError) as caught:
        js.io.read_table(tmp_path / "snap_002.0.hdf5")
    missing = "snap_002.1.hdf5, snap_002.2.hdf5, snap_002.3.hdf5"
    assert f"is one of {number} files of a snapshot; beside it {missing} and {number - 4} more cannot be" in str(caught.value)
    assert memory.peak < 2**22


STRANGERS = [
    ("Time", 0.75, "time = 0.75"),
    ("BoxSize", 3.0, r"box_size = \(3.0, 3.0, 3.0\)"),
    ("NumFilesPerSnapshot", 4, "num_files = 4"),
    ("NumPart_Total", [90, 6, 0, 0, 0, 0], "announced = 90"),
]


@pytest.mark.parametrize(("name", "value", "said"), STRANGERS)
def test_parts_of_two_snapshots_are_not_joined_nor_the_same_part_twice(name, value, said, tmp_path):
    files = snapshot(tmp_path, (5, 6, 7))
    with h5py.File(files[2], "a") as file:
        file["Header"].attrs[name] = value
    refused(rf"snap_002\.2\.hdf5: has {said}, and .*snap_002\.0\.hdf5 .* one snapshot", js.io.read_table, files[0])
    shutil.copy(files[0], files[2])
    refused(r"snap_002\.2\.hdf5: has the particles of .*snap_002\.0\.hdf5 once more", js.io.read_table, files[1])


def test_parts_are_all_that_their_header_announces(tmp_path):
    files = snapshot(tmp_path)
    for total, right in ((12, True), (2**32 + 12, True), (13, False)):
        for path in files:
            with h5py.File(path, "a") as file:
                file["Header"].attrs["NumPart_Total"] = np.array([total, 6, 0, 0, 0, 0], np.uint64)
        if right:
            js.io.read_table(files[0])
            continue
        refused("announces 13 particles, and its files have 12", js.io.read_table, files[0])


@pytest.mark.parametrize(("total", "notes"), [(0, 0), (5, 0), (77, 1)])
def test_a_file_alone_that_announces_others_says_so(total, notes, tmp_path):
    write(tmp_path / "alone.hdf5", 0, 1, 5)
    with h5py.File(tmp_path / "alone.hdf5", "a") as file:
        file["Header"].attrs["NumPart_Total"] = [total, 0, 0, 0, 0, 0]
    said = [one for one in js.io.read_table(tmp_path / "alone.hdf5").conventions if "77" in one and "it has 5" in one]
    assert len(said) == notes


def test_parts_of_gadget_binary_belong_together_too(samples, tmp_path):
    paths = [tmp_path / f"snap.{number}" for number in range(2)]

    def write_both(total, time):
        for number, path in enumerate(paths):
            samples.write_gadget_binary(path, samples.particles(seed=number), form=1)
            content = bytearray(path.read_bytes())
            content[4 + 72 : 4 + 80] = np.float64(time * number + 1).tobytes()
            content[4 + 96 : 4 + 100], content[4 + 124 : 4 + 128] = total.to_bytes(4, "little"), (2).to_bytes(4, "little")
            path.write_bytes(content)

    write_both(14, 0)
    assert len(js.io.read_table(paths[0])) == 14
    for total, time, said in ((15, 0, "announces 15 particles, and its files have 14"), (14, 1, "time = 2.0")):
        write_both(total, time)
        refused(said, js.io.read_table, paths[0])


def paths(*names):
    return [Path(name) for name in names]


@pytest.mark.parametrize(("names", "numbers"), [
    (("snap_000.npz", "snap_010.npz"), (0, 10)), (("run2_9.hdf5", "run2_10.hdf5"), (9, 10)),
    (("a/snap_1.0.hdf5", "a/snap_1.1.hdf5"), (0, 1)), (("a.npz", "b.npz"), None), (("a1b1.npz", "a2b2.npz"), None),
    (("a1.npz",), None),
])  # fmt: skip
def test_the_number_of_a_file_is_the_one_in_which_names_differ(names, numbers):
    assert numbers_of(paths(*names)) == numbers


@given(st.integers(0, 50), st.integers(1, 9), st.integers(6, 20), st.data())
def test_numbers_that_were_taken_out_of_an_even_sequence_are_found(first, step, count, data):
    there = list(range(first, first + step * count, step))
    gone = data.draw(st.sampled_from(there[1:-1]))
    assert missing_numbers(there) == []
    assert missing_numbers([number for number in there if number != gone]) == [gone]


@pytest.mark.parametrize("numbers", [(0,), (0, 10), (0, 3, 6), (0, 1, 10, 20, 30), (5, 5)])
def test_what_is_even_or_has_no_step_lacks_nothing(numbers):
    assert missing_numbers(numbers) == []


def test_a_gap_is_refused_with_the_numbers_and_the_files_around_it():
    names = paths(*(f"s_{number:03d}.npz" for number in (0, 1, 2, 5, 6)))
    refused(r"numbers 3, 4 are missing in the sequence, first between s_002.npz and s_005.npz", require_no_gap, names)
    many = paths(*(f"s_{number}.npz" for number in (0, 1, 2, 50)))
    refused("3, 4, 5, 6, 7, 8, 9, 10 and 39 more", require_no_gap, many)


def test_files_are_in_the_order_of_their_times_and_that_is_said_where_names_have_another():
    order = in_order(paths("s_0.npz", "s_1.npz", "s_2.npz"), [0.5, 0.1, 0.9])
    assert order.indices == (1, 0, 2) and order.times == (0.1, 0.5, 0.9) and "another order" in order.told and order.by_files


def test_without_times_numbers_are_times_and_without_numbers_places_are():
    order = in_order(paths("s_3.npz", "s_10.npz", "s_7.npz"), [None, 1.0, None])
    assert order.times == (3, 7, 10) and order.indices == (0, 2, 1) and not order.by_files
    assert in_order(paths("b.npz", "a.npz"), [None, None]).indices == (0, 1)


def test_two_files_of_one_time_are_refused_by_name():
    refused(r"s_0.npz and s_1.npz are both of time 0.5", in_order, paths("s_0.npz", "s_1.npz"), [0.5, 0.5])
