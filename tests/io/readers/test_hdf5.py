"""HDF5 of Gadget-like codes and of plain points: what their names mean, what a header says, and what was never written."""

import dataclasses

import h5py
import numpy as np
import pytest
from refusals import refused

import jaxsph as js
import jaxsph.io as io
from jaxsph.io.readers.hdf5 import GADGET4_KERNELS, GIZMO_KERNELS, SWIFT_KERNELS
from jaxsph.model.particles import kernels


@pytest.fixture
def gadget(samples, tmp_path):
    """`gadget({name: data set}, {"Header.Time": attribute}, **how)` is the path of a snapshot with such changes; None removes."""

    def write(data=(), attributes=(), **how):
        samples.write_gadget_hdf5(tmp_path / "a.hdf5", samples.particles(), **how)
        with h5py.File(tmp_path / "a.hdf5", "a") as file:
            for name, value in dict(data).items():
                file.pop(name, None)
                if value is not None:
                    file[name] = value
            for name, value in dict(attributes).items():
                group, _, attribute = name.partition(".")
                (file[group] if group in file else file.create_group(group)).attrs[attribute] = value
        return tmp_path / "a.hdf5"

    return write


def conventions(path, **more):
    return "; ".join(io.read_table(path, **more).conventions)


def test_the_smoothing_length_of_gadget_is_the_support_and_masses_are_of_the_header_unless_they_are_stored(gadget):
    table = io.read_table(gadget())
    np.testing.assert_array_equal(table.support, np.full(len(table), 0.5))
    assert any("support = SmoothingLength (Gadget convention" in sentence for sentence in table.conventions)
    np.testing.assert_array_equal(table.columns["Masses"], np.full(7, 2.0))
    np.testing.assert_array_equal(io.read_table(gadget(masses=np.arange(1.0, 8))).columns["Masses"], np.arange(1.0, 8))


@pytest.mark.parametrize("where", [("Header", [2]), ("HydroScheme", 2), ("HydroScheme", [1]), ("Header", 3), None])
@pytest.mark.parametrize("kernel", list(SWIFT_KERNELS))
def test_the_support_of_swift_is_gamma_smoothing_lengths_of_its_kernel_in_its_dimension(kernel, where, gadget):
    table = io.read_table(gadget({}, {f"{where[0]}.Dimension": where[1]} if where else {}, swift_kernel=kernel))
    gamma = SWIFT_KERNELS[kernel][1][2 if where is None else int(np.ravel(where[1])[0]) - 1]
    np.testing.assert_allclose(table.support, gamma * 0.5)
    assert table.source == "SWIFT HDF5"
    assert any(str(gamma) in sentence and kernel in sentence for sentence in table.conventions)


OF_ONE_DIMENSION = {
    "wendland_c2": lambda q: (1 - q) ** 3 * (1 + 3 * q),
    "wendland_c4": lambda q: (1 - q) ** 5 * (1 + 5 * q + 8 * q**2),
    "wendland_c6": lambda q: (1 - q) ** 7 * (1 + 7 * q + 19 * q**2 + 21 * q**3),
}


@pytest.mark.parametrize("dimension", [1, 2, 3])
@pytest.mark.parametrize(("kernel", "gammas"), SWIFT_KERNELS.values())
def test_gamma_is_the_support_over_twice_the_standard_deviation_of_the_kernel(kernel, gammas, dimension):
    q = np.linspace(0, 1, 100_001)
    other = OF_ONE_DIMENSION.get(kernel) if dimension == 1 else None
    weight = kernels.KERNELS[kernel].of_square(q**2, np) if other is None else other(q)
    moments = [np.trapezoid(weight * q ** (dimension - 1 + power), q) for power in (0, 2)]
    assert gammas[dimension - 1] == pytest.approx(0.5 / np.sqrt(moments[1] / moments[0] / dimension), rel=1e-6)


STATED = [
    *((name, "swift", stated) for stated, (name, _) in SWIFT_KERNELS.items()),
    *((name, f"Config.{stated}", "") for stated, name in GADGET4_KERNELS.items()),
    *((name, "Header.Kernel_Function_ID", stated) for stated, name in GIZMO_KERNELS.items()),
    ("cubic_spline", "Header.Kernel_Function_ID", 2),
    ("cubic_spline", "Config.PERIODIC", ""),
    ("cubic_spline", "Config.VORONOI", ""),
    ("cubic_spline", None, None),
]


@pytest.mark.parametrize(("name", "place", "stated"), STATED)
def test_the_kernel_is_the_one_that_the_file_states_and_that_is_said(name, place, stated, gadget):
    table = io.read_table(gadget(swift_kernel=stated) if place == "swift" else gadget({}, {place: stated} if place else {}))
    assert table.kernel == name
    particles, report = io.particles_from_table(table, "x", 0.5, box=None)
    assert particles.kernel == name and report.kernel.startswith(name) and f"kernel    {report.kernel}" in str(report)
    particles, report = io.particles_from_table(table, "x", 0.5, "poly6", box=None)
    assert particles.kernel == "poly6" and report.kernel == "poly6, given by the caller"
    assert not any(note.startswith("kernel") for note in report.notes)


def test_a_file_is_drawn_with_the_kernel_that_it_states(gadget, frames, compare, traced):
    """Against float64 brute force."""
    name, _, stated = next(one for one in STATED if one[:2] == ("quartic_spline", "swift"))
    given = io.read_particles(gadget(swift_kernel=stated), "x", 0.6, box=None)
    columns = given.to_numpy()
    middle = columns["position"].mean(0)
    columns["position"] = ((columns["position"] - middle) / np.ptp(columns["position"])).astype(np.float32)
    particles = js.Particles.from_arrays(**columns, kernel=given.kernel, capacity=frames.capacity)
    values = np.linspace(columns["quantity"].min(), columns["quantity"].max(), 5)
    transfer = js.TransferFunction.from_points(values, np.eye(5, 3), np.full(5, 3.0))
    scene, camera = js.Scene(particles=particles, transfer=transfer), frames.camera(np.random.default_rng(3))
    image = traced(scene, camera, frames.plan())
    compare(image, js.reference.render(scene, camera, frames.settings), 1e-4, 0.999)
    assert particles.kernel == name and np.asarray(image.alpha).max() > 0.1


def test_the_periodic_box_is_noted(gadget):
    table = io.read_table(gadget())
    assert table.box_size == (16, 16, 16)
    _, report = io.particles_from_table(dataclasses.replace(table, position=np.mod(table.position, 16)))
    assert "periodic box of 16 x 16 x 16: supports reach across its faces" in report.notes


def test_without_gas_the_first_type_with_positions_is_read(gadget):
    table = io.read_table(gadget(part_type=1))
    assert len(table) == 7 and table.support is None
    assert "particles of PartType1" in table.conventions
    refused(r"a\.hdf5: has no particles of type 0; `part_type` can be 1", io.read_table, gadget(part_type=1), part_type=0)


TOLD = "`NumPart_ThisFile` in its header says"


@pytest.mark.parametrize(
    ("data", "attributes", "how", "said"),
    [
        ({}, {}, {"swift_kernel": "Tophat"}, "kernel 'Tophat'"),
        ({}, {}, {"masses": np.ones(3)}, "PartType0/Masses has 3 rows, but there are 7 particles"),
        *(({}, {"Header.NumPart_ThisFile": told}, {}, rf"has 7 particles of type 0, but {TOLD} {np.ravel(told)[0]}; copy it")
          for told in ([90, 0, 0, 0, 0, 0], [3], 6, np.array([8, 0], np.uint64))),
        *(({}, {"Header.MassTable": [m, 1.0]}, {}, rf"has mass {m:g} for particles of type 0 in `MassTable` of its header")
          for m in (-1.0, np.nan, np.inf)),
    ],
)  # fmt: skip
def test_what_does_not_fit_its_header_is_refused(data, attributes, how, said, gadget):
    refused(said, io.read_table, gadget(data, attributes, **how))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("NumPart_ThisFile", told) for told in ([7, 1, 0], [7], [], "seven")),
        *(("NumFilesPerSnapshot", told) for told in (h5py.Empty("i4"), np.zeros(0, np.int32), "many", np.nan)),
        *(("BoxSize", told) for told in (0.0, [0.0, 0.0, 0.0])),
    ],
)
def test_a_header_that_says_the_same_or_nothing_is_read_and_nothing_said(name, value, gadget):
    path = gadget({}, {f"Header.{name}": value})
    assert len(io.read_table(path)) == 7
    assert not any(word in conventions(path) for word in ("files of the snapshot", "also holds", "box"))


@pytest.mark.parametrize("size", [np.nan, np.inf, -1.0, [1.0, 1.0, 0.0], [1.0, 2.0]])
def test_a_box_that_is_none_is_said(size, gadget):
    path = gadget({}, {"Header.BoxSize": size})
    assert io.read_table(path).box_size is None and "not periodic: a box of" in conventions(path)


@pytest.mark.parametrize("stored", [0.25, [0.25]])
def test_the_time_in_the_header_is_that_of_the_snapshot(stored, gadget):
    assert io.read_table(gadget({}, {"Header.Time": stored})).time == 0.25


@pytest.mark.parametrize(
    ("told", "said"),
    [
        ({"NumPart_Total": [7, 32768, 0, 0, 12, 0]}, "32,768 of type 1 (dark matter), 12 of type 4 (stars)"),
        ({"NumPart_Total": [7, 1, 0, 5, 0, 0], "NumPart_Total_HighWord": [0, 1, 0, 0, 0, 0]},
         "4,294,967,297 of type 1 (dark matter), 5 of type 3"),
        ({}, "type 1 (dark matter)"),
    ],
)  # fmt: skip
def test_other_types_are_told_with_how_many_there_are(told, said, gadget):
    stated = {f"Header.{name}": np.array(value, np.uint32) for name, value in told.items()}
    path = gadget({"PartType1/Coordinates": np.zeros((3, 3))}, stated)
    assert f"also holds {said}: `part_type=` or --part-type reads another" in io.read_table(path).conventions
    assert "(gas)" in conventions(path, part_type=1).partition("also holds")[2]


@pytest.mark.parametrize("mark", ["Config.VORONOI", "PartType0/CenterOfMass", "PartType0/GFM_Metallicity"])
def test_cells_of_a_moving_mesh_say_what_is_made_of_them(mark, gadget):
    data, attributes = ({}, {mark: ""}) if "." in mark else ({mark: np.zeros(7)}, {})
    assert "moving mesh (AREPO) are read" not in conventions(gadget(data, attributes, masses=np.arange(1.0, 8)))
    table = io.read_table(gadget(data | {"PartType0/SmoothingLength": None}, attributes, masses=np.arange(1.0, 8)))
    assert any("moving mesh (AREPO) are read as SPH particles" in each for each in table.conventions)
    particles, report = io.particles_from_table(table, box=None)
    np.testing.assert_allclose(particles.volume[:7], table.columns["Masses"] / table.columns["Density"], rtol=1e-6)
    assert "neighbour" in report.support


NAMED = ("MassTable", "BoxSize", "Time", "Redshift", "NumPart_ThisFile", "NumPart_Total", "Dimension", "Code")


@pytest.mark.parametrize("name", NAMED)
def test_attributes_without_a_value_say_nothing(name, gadget):
    assert len(io.read_table(gadget({}, {f"Header.{name}": h5py.Empty("f8")}))) == 7
    empty = {f"{group}.{name}": h5py.Empty("f8") for group in ("Units", "Cosmology", "Parameters")}
    empty |= {"PartType0/Density.U_M exponent": h5py.Empty("i4"), "HydroScheme.Dimension": h5py.Empty("i4")}
    np.testing.assert_allclose(io.read_table(gadget({}, empty, swift_kernel="Wendland C2")).support, 1.936492 * 0.5)


BAD = np.array([0.5, 0.5, -0.5, 0.5, 0.0, 0.5, 0.5])


@pytest.mark.parametrize("part_type", [0, 5])
def test_supports_that_are_none_stop_nothing_that_needs_none(part_type, gadget):
    path = gadget({f"PartType{part_type}/SmoothingLength": BAD}, part_type=part_type)
    assert len(io.read_points(path, part_type=part_type, radius=0.25).position) == 7
    particles = io.read_particles(path, "z", 0.25, part_type=part_type)
    np.testing.assert_array_equal(particles.to_numpy()["support"], np.full(7, 0.25))
    for read in (io.read_particles, io.read_points):
        refused(r"a\.hdf5: .* 2 of 7 .*are not, the first .*; remove these p", read, path, part_type=part_type)


def packed(file, name, values):
    """A data set by a filter that is none, as of a plugin that is not installed."""
    layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    layout.set_chunk((len(values),))
    layout.set_filter(32999, h5py.h5z.FLAG_OPTIONAL, (1,))
    space = h5py.h5s.create_simple((len(values),))
    one = h5py.h5d.create(file.id, name.encode(), h5py.h5t.IEEE_F64LE, space, layout)
    one.write_direct_chunk((0,), np.asarray(values, "<f8").tobytes(), 0)


MISSING = r"is packed by the HDF5 filter 32999.*not installed; `pip install hdf5plugin`"


def test_a_column_by_a_filter_that_is_missing_of_words_or_of_other_rows_is_left_out_by_name(samples, tmp_path):
    samples.write_gadget_hdf5(tmp_path / "a.hdf5", samples.particles())
    samples.write_points(tmp_path / "b.hdf5", samples.particles())
    samples.write_phantom(tmp_path / "c.h5", samples.particles())
    for name, group in (("a.hdf5", "PartType0/"), ("b.hdf5", ""), ("c.h5", "particles/")):
        with h5py.File(tmp_path / name, "a") as file:
            packed(file, f"{group}Dust", np.arange(7.0))
            file[f"{group}Words"] = np.array(7 * [b"gas"])
            file[f"{group}Few"] = np.zeros(6)
        table = io.read_table(tmp_path / name)
        assert len(table) == 7 and "Dust" not in table.columns and "density" in map(str.lower, table.columns)
        assert sum("left out Dust" in said and "32999" in said for said in table.conventions) == 1
        assert "left out Words: not numbers" in table.conventions
        assert "left out Few: it has 6 rows, but there are 7 particles" in table.conventions
        refused(rf"there is no quantity 'Dust'.*left out Dust.*{MISSING}", io.read_particles, tmp_path / name, "Dust")


@pytest.mark.parametrize("column", ["Masses", "SmoothingLength", "Density"])
def test_a_column_that_supports_and_volumes_need_is_not_left_out(column, gadget):
    path = gadget({f"PartType0/{column}": None})
    with h5py.File(path, "a") as file:
        packed(file, f"PartType0/{column}", np.ones(7))
    refused(rf"a\.hdf5: `/PartType0/{column}` {MISSING}", io.read_table, path)


POSITION = np.random.default_rng(0).random((10, 3))
LAYOUTS = [
    {},
    {"chunks": (4, 3)},
    {"chunks": (4, 3), "compression": "gzip", "shuffle": True},
    {"chunks": (4, 3), "compression": "lzf"},
]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_what_was_written_whole_is_read(layout, tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("Coordinates", data=POSITION, **layout)
        file.create_dataset("constant", data=np.ones((10, 3)), **layout)
    table = io.read_table(tmp_path / "a.h5")
    np.testing.assert_array_equal(table.position, POSITION)
    np.testing.assert_array_equal(table.columns["constant"], 1)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("name", ["Coordinates", "velocity"])
def test_what_was_never_written_is_refused_where_it_is_needed(name, layout, tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for label in ("Coordinates", "velocity"):
            file.create_dataset(label, (10, 3), "f8", **layout)
            if label != name:
                file[label][:] = POSITION
    wrong = rf"`/{name}` has shape \(10, 3\).* were ever written"
    if name == "Coordinates":
        refused(rf"a\.h5: {wrong}", io.read_table, tmp_path / "a.h5")
        return
    assert not io.read_table(tmp_path / "a.h5").columns
    for asked in ("velocity", "Velocity.x", "speed", "vel.y", "2 * speed"):
        refused(f"left out velocity: {wrong}", io.read_particles, tmp_path / "a.h5", asked, 0.5)


def test_sets_of_pysph_are_types_by_name_without_boundaries(samples, tmp_path):
    p = samples.particles()
    samples.write_pysph(tmp_path / "dam_10.hdf5", p)
    with h5py.File(tmp_path / "dam_10.hdf5", "a") as file:
        file.copy("particles/fluid", "particles/oil")
        file["particles/oil/arrays/gone"] = h5py.SoftLink("/nowhere")
        del file["particles/boundary/arrays/w"]
    both, wall, oil = (io.read_table(tmp_path / "dam_10.hdf5", part_type=kind) for kind in (None, "boundary", "oil"))
    np.testing.assert_array_equal(both.position, np.concatenate([p.position, p.position]))
    np.testing.assert_array_equal(oil.columns["velocity"], p.velocity)
    assert len(wall) == 3 and (both.time, both.source) == (0.5, "PySPH") and {"m", "rho", "gid"} <= set(both.columns)
    assert "also holds boundary: `part_type=` or --part-type reads one" in both.conventions
    assert any(said.startswith("left out gone: ") for said in oil.conventions)
    refused(
        "no particles called gas; `part_type` can be boundary, fluid, oil",
        io.read_table,
        tmp_path / "dam_10.hdf5",
        part_type="gas",
    )
    with h5py.File(tmp_path / "dam_10.hdf5", "a") as file:
        del file["particles/oil/arrays/x"]
    refused("has no `/particles/oil/arrays/x`; write", io.read_table, tmp_path / "dam_10.hdf5", part_type="oil")


def odd_columns(file, group):
    """What nobody needs, of all kinds, by name; True where it is numbers of seven particles."""
    plain = {
        "bytes": np.arange(7, dtype="i1"), "big": np.arange(7, dtype=">u2"), "flags": np.arange(7) > 3,
        "halves": np.ones(7, "f2"),
        "long": np.ones(7, np.longdouble), "gaps": np.full(7, np.nan), "words": np.array(7 * [b"gas"]), "none": np.zeros(0),
        "wide": np.zeros((7, 0)), "pairs": np.zeros(7, [("a", "f4"), ("b", "i8")]), "waves": np.ones(7, complex),
        "few": np.ones(3),
    }  # fmt: skip
    for name, values in plain.items():
        file[f"{group}{name}"] = values
    file.create_dataset(f"{group}texts", (7,), h5py.string_dtype())
    file.create_dataset(f"{group}kinds", data=np.ones(7, "i1"), dtype=h5py.enum_dtype({"gas": 1}, basetype="i1"))
    file.create_dataset(f"{group}links", data=np.array(7 * [file["/"].ref], h5py.ref_dtype), dtype=h5py.ref_dtype)
    file.create_dataset(f"{group}lists", (7,), h5py.vlen_dtype(np.int32))
    file.create_dataset(f"{group}gone", (7,), "f4")
    file.create_dataset(f"{group}half", (8,), "f4", chunks=(4,))[:3] = 1
    file[f"{group}times"] = h5py.Empty("f4")
    h5py.h5d.create(file.id, f"{group}odd".encode(), h5py.h5t.UNIX_D32LE, h5py.h5s.create_simple((7,)))
    file[f"{group}lost"] = h5py.SoftLink("/nowhere")
    file[f"{group}away"] = h5py.ExternalLink("gone.hdf5", "/x")
    return {"bytes", "big", "flags", "halves", "long", "gaps", "kinds"}


def test_what_nobody_needs_never_refuses_a_file(samples, tmp_path):
    samples.write_gadget_hdf5(tmp_path / "a.hdf5", samples.particles())
    samples.write_points(tmp_path / "b.hdf5", samples.particles())
    samples.write_phantom(tmp_path / "c.h5", samples.particles())
    for name, group in (("a.hdf5", "PartType0/"), ("b.hdf5", ""), ("c.h5", "particles/")):
        before = io.read_table(tmp_path / name)
        with h5py.File(tmp_path / name, "a") as file:
            numbers = odd_columns(file, group)
            file["PartType5"] = h5py.SoftLink("/nowhere") if name == "a.hdf5" else h5py.Empty("f4")
        if name != "a.hdf5":
            with h5py.File(tmp_path / name, "a") as file:
                del file["PartType5"]
        table = io.read_table(tmp_path / name)
        assert set(table.columns) - set(before.columns) == numbers and set(before.columns) <= set(table.columns)
        for column in (
            "words",
            "none",
            "wide",
            "pairs",
            "waves",
            "few",
            "texts",
            "links",
            "lists",
            "gone",
            "odd",
            "lost",
            "away",
        ):
            refused(f"left out {column}: ", io.read_particles, tmp_path / name, column)
        assert np.isfinite(io.read_particles(tmp_path / name, "z").to_numpy()["position"]).all()


@pytest.mark.parametrize("layout", LAYOUTS[1:])
def test_chunks_that_were_never_written_are_counted(layout, tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("Coordinates", (10, 3), "f8", **layout)[:8] = POSITION[:8]
    refused(r"a\.h5: `/Coordinates` .* only 2 of its 3 chunks were ever written", io.read_table, tmp_path / "a.h5")


@pytest.mark.parametrize("kind", ["gadget", "phantom"])
def test_what_codes_never_wrote_is_refused_too(kind, samples, tmp_path):
    name = {"gadget": "PartType0/Density", "phantom": "particles/h"}[kind]
    {"gadget": samples.write_gadget_hdf5, "phantom": samples.write_phantom}[kind](tmp_path / "a.h5", samples.particles())
    with h5py.File(tmp_path / "a.h5", "a") as file:
        del file[name]
        file.create_dataset(name, (7,), "f4")
    refused(rf"a\.h5: `/{name}` has shape \(7,\), which needs 28 bytes, but only 0", io.read_table, tmp_path / "a.h5")


def test_a_shape_that_the_bytes_cannot_hold_is_refused_before_memory_is_asked_for(tmp_path, measured):
    for layout in ({}, {"chunks": (4, 3)}, {"chunks": (2**20, 3), "compression": "gzip"}):
        with h5py.File(tmp_path / "a.h5", "w") as file:
            file.create_dataset("Coordinates", (10**11, 3), "f8", maxshape=(None, 3) if layout else None, **layout)
        with measured() as memory, pytest.raises(ValueError, match=r"a\.h5: `/Coordinates` has shape \(100000000000, 3\)"):
            io.read_table(tmp_path / "a.h5")
        assert memory.peak < 2**22


@pytest.mark.parametrize("shape", [(10, 2), (30,), (10**12, 0), ()])
@pytest.mark.parametrize("name", ["Coordinates", "PartType0/Coordinates"])
def test_positions_of_another_shape_are_refused_before_they_are_read(name, shape, tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset(name, shape, "f8")
        file.create_group("Header").attrs["MassTable"] = np.ones(6)
    refused(rf"a\.h5: `/{name}` must hold numbers of shape \(N, 3\)", io.read_table, tmp_path / "a.h5")


def test_a_group_of_the_name_of_positions_is_refused_and_so_is_what_has_none(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["spectrum"] = np.zeros(4)
    refused(r"a\.h5: is HDF5 with spectrum at its top", io.read_table, tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_group("Coordinates")
    refused(r"a\.h5: `/Coordinates` must hold numbers of shape \(N, 3\), got None", io.read_table, tmp_path / "a.h5")
