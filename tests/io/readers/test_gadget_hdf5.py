import dataclasses

import numpy as np
import pytest
from refusals import refused

import jaxsph as js
import jaxsph.io as io
from jaxsph.io.readers.hdf5 import GADGET4_KERNELS, GIZMO_KERNELS, SWIFT_KERNELS
from jaxsph.model.particles import kernels

h5py = pytest.importorskip("h5py")


def test_the_smoothing_length_of_gadget_is_the_support(samples, tmp_path):
    samples.write_gadget_hdf5(tmp_path / "a.hdf5", samples.particles())
    table = io.read_table(tmp_path / "a.hdf5")
    np.testing.assert_array_equal(table.support, np.full(len(table), 0.5))
    assert any("support = SmoothingLength (Gadget convention" in sentence for sentence in table.conventions)


@pytest.mark.parametrize("where", [("Header", [2]), ("HydroScheme", 2), ("HydroScheme", [1]), ("Header", 3), None])
@pytest.mark.parametrize("kernel", list(SWIFT_KERNELS))
def test_the_support_of_swift_is_gamma_smoothing_lengths_of_its_kernel_in_its_dimension(kernel, where, samples, tmp_path):
    samples.write_gadget_hdf5(tmp_path / "a.hdf5", samples.particles(), swift_kernel=kernel)
    if where is not None:
        with h5py.File(tmp_path / "a.hdf5", "a") as file:
            file[where[0]].attrs["Dimension"] = where[1]
    table = io.read_table(tmp_path / "a.hdf5")
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
    *((name, "Config", stated) for stated, name in GADGET4_KERNELS.items()),
    *((name, "Kernel_Function_ID", stated) for stated, name in GIZMO_KERNELS.items()),
    ("cubic_spline", "Kernel_Function_ID", 2),
    ("cubic_spline", "Config", "PERIODIC"),
    ("cubic_spline", "Config", "VORONOI"),
    ("cubic_spline", None, None),
]


def write(path, samples, place, stated):
    """A snapshot whose code says its kernel somewhere."""
    samples.write_gadget_hdf5(path, samples.particles(), **({"swift_kernel": stated} if place == "swift" else {}))
    with h5py.File(path, "a") as file:
        if place == "Config":
            file.require_group("Config").attrs[stated] = ""
        if place == "Kernel_Function_ID":
            file["Header"].attrs[place] = stated
    return path


@pytest.mark.parametrize(("name", "place", "stated"), STATED)
def test_the_kernel_is_the_one_that_the_file_states_and_that_is_said(name, place, stated, samples, tmp_path):
    table = io.read_table(write(tmp_path / "a.hdf5", samples, place, stated))
    assert table.kernel == name
    particles, report = io.particles_from_table(table, "x", 0.5, box=None)
    assert particles.kernel == name and report.kernel.startswith(name) and f"kernel    {report.kernel}" in str(report)
    particles, report = io.particles_from_table(table, "x", 0.5, "poly6", box=None)
    assert particles.kernel == "poly6" and report.kernel == "poly6, given by the caller"
    assert not any(note.startswith("kernel") for note in report.notes)


def test_a_file_is_drawn_with_the_kernel_that_it_states(samples, tmp_path, frames, compare, traced):
    """Against float64 brute force."""
    name, place, stated = next(one for one in STATED if one[0] == "quartic_spline")
    given = io.read_particles(write(tmp_path / "a.hdf5", samples, place, stated), "x", 0.6, box=None)
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


def test_an_unknown_swift_kernel_is_refused(samples, tmp_path):
    samples.write_gadget_hdf5(tmp_path / "a.hdf5", samples.particles(), swift_kernel="Tophat")
    refused("kernel 'Tophat'", io.read_table, tmp_path / "a.hdf5")


def test_masses_come_from_the_header_where_there_is_no_data_set(samples, tmp_path):
    samples.write_gadget_hdf5(tmp_path / "a.hdf5", samples.particles())
    np.testing.assert_array_equal(io.read_table(tmp_path / "a.hdf5").columns["Masses"], np.full(7, 2.0))


def test_stored_masses_win_over_the_header(samples, tmp_path):
    samples.write_gadget_hdf5(tmp_path / "a.hdf5", samples.particles(), masses=np.arange(1.0, 8))
    np.testing.assert_array_equal(io.read_table(tmp_path / "a.hdf5").columns["Masses"], np.arange(1.0, 8))


def test_the_periodic_box_is_noted(samples, tmp_path):
    samples.write_gadget_hdf5(tmp_path / "a.hdf5", samples.particles())
    table = io.read_table(tmp_path / "a.hdf5")
    assert table.box_size == (16, 16, 16)
    _, report = io.particles_from_table(dataclasses.replace(table, position=np.mod(table.position, 16)))
    assert "periodic box of 16 x 16 x 16: supports reach across its faces" in report.notes


def test_without_gas_the_first_type_with_positions_is_read(samples, tmp_path):
    samples.write_gadget_hdf5(tmp_path / "a.hdf5", samples.particles(), part_type=1)
    table = io.read_table(tmp_path / "a.hdf5")
    assert len(table) == 7 and table.support is None
    assert "particles of PartType1" in table.conventions


def test_a_type_that_is_not_there_is_answered_with_those_that_are(samples, tmp_path):
    samples.write_gadget_hdf5(tmp_path / "a.hdf5", samples.particles(), part_type=1)
    refused(r"a\.hdf5: has no particles of type 0; `part_type` can be 1", io.read_table, tmp_path / "a.hdf5", part_type=0)


def test_a_data_set_of_another_length_is_refused_by_name(samples, tmp_path):
    samples.write_gadget_hdf5(tmp_path / "a.hdf5", samples.particles(), masses=np.ones(3))
    refused("PartType0/Masses has 3 rows, but there are 7 particles", io.read_table, tmp_path / "a.hdf5")


def test_big_endian_data_sets_become_native(samples, tmp_path):
    p = samples.particles()
    p.position = p.position.astype(">f4")
    samples.write_gadget_hdf5(tmp_path / "a.hdf5", p)
    table = io.read_table(tmp_path / "a.hdf5")
    assert table.position.dtype.isnative
    np.testing.assert_array_equal(table.position, p.position)


def test_an_hdf5_file_of_no_known_flavour_is_answered_with_what_it_holds(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["spectrum"] = np.zeros(4)
    refused(r"a\.h5: is HDF5 with spectrum at its top", io.read_table, tmp_path / "a.h5")


@pytest.mark.parametrize("value", [h5py.Empty("i4"), np.zeros(0, np.int32), "many", np.nan])
def test_a_snapshot_that_does_not_say_of_how_many_files_it_is_one_is_read(value, samples, tmp_path):
    samples.write_gadget_hdf5(tmp_path / "a.hdf5", samples.particles())
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        file["Header"].attrs["NumFilesPerSnapshot"] = value
    table = io.read_table(tmp_path / "a.hdf5")
    assert len(table) == 7 and not any("files of the snapshot" in sentence for sentence in table.conventions)


@pytest.mark.parametrize("stored", [0.25, [0.25]])
def test_the_time_in_the_header_is_that_of_the_snapshot(stored, samples, tmp_path):
    samples.write_gadget_hdf5(tmp_path / "a.hdf5", samples.particles())
    with h5py.File(tmp_path / "a.hdf5", "r+") as file:
        file["Header"].attrs["Time"] = stored
    assert io.read_table(tmp_path / "a.hdf5").time == 0.25


def with_header(path, samples, **attributes):
    samples.write_gadget_hdf5(path, samples.particles())
    with h5py.File(path, "r+") as file:
        file["Header"].attrs.update(attributes)
    return path


@pytest.mark.parametrize("told", [[90, 0, 0, 0, 0, 0], [3], 6, np.array([8, 0], np.uint64)])
def test_another_number_of_particles_in_the_header_is_refused(told, samples, tmp_path):
    path = with_header(tmp_path / "a.hdf5", samples, NumPart_ThisFile=told)
    number = np.ravel(told)[0]
    with pytest.raises(
        ValueError, match=rf"has 7 particles of type 0, but `NumPart_ThisFile` in its header says {number}; copy it"
    ):
        io.read_table(path)


@pytest.mark.parametrize("told", [[7, 1, 0], [7], [], "seven"])
def test_a_header_that_says_the_same_number_or_none_is_read(told, samples, tmp_path):
    assert len(io.read_table(with_header(tmp_path / "a.hdf5", samples, NumPart_ThisFile=told))) == 7


@pytest.mark.parametrize("mass", [-1.0, np.nan, np.inf])
def test_a_mass_in_the_header_that_is_none_is_refused(mass, samples, tmp_path):
    path = with_header(tmp_path / "a.hdf5", samples, MassTable=[mass, 1.0])
    refused(rf"has mass {mass:g} for particles of type 0 in `MassTable` of its header; correct", io.read_table, path)


@pytest.mark.parametrize("size", [np.nan, np.inf, -1.0, [1.0, 1.0, 0.0], [1.0, 2.0]])
def test_a_box_that_is_none_is_said(size, samples, tmp_path):
    table = io.read_table(with_header(tmp_path / "a.hdf5", samples, BoxSize=size))
    assert table.box_size is None and any("not periodic: a box of" in sentence for sentence in table.conventions)


@pytest.mark.parametrize("size", [0.0, [0.0, 0.0, 0.0]])
def test_of_no_box_nothing_is_said(size, samples, tmp_path):
    table = io.read_table(with_header(tmp_path / "a.hdf5", samples, BoxSize=size))
    assert table.box_size is None and not any("box" in sentence for sentence in table.conventions)


@pytest.mark.parametrize(
    ("told", "said"),
    [
        ({"NumPart_Total": [7, 32768, 0, 0, 12, 0]}, "32,768 of type 1 (dark matter), 12 of type 4 (stars)"),
        ({"NumPart_Total": [7, 1, 0, 5, 0, 0], "NumPart_Total_HighWord": [0, 1, 0, 0, 0, 0]},
         "4,294,967,297 of type 1 (dark matter), 5 of type 3"),
        ({}, "type 1 (dark matter)"),
    ],
)  # fmt: skip
def test_other_types_are_told_with_how_many_there_are(told, said, samples, tmp_path):
    samples.write_gadget_hdf5(tmp_path / "a.hdf5", samples.particles())
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        file["PartType1/Coordinates"] = np.zeros((3, 3))
        file["Header"].attrs.update({name: np.array(value, np.uint32) for name, value in told.items()})
    assert f"also holds {said}: `part_type=` or --part-type reads another" in io.read_table(tmp_path / "a.hdf5").conventions
    assert any(
        each.startswith("also holds") and "(gas)" in each for each in io.read_table(tmp_path / "a.hdf5", part_type=1).conventions
    )


def test_gas_alone_says_nothing_of_others(samples, tmp_path):
    samples.write_gadget_hdf5(tmp_path / "a.hdf5", samples.particles())
    assert not any("also holds" in each for each in io.read_table(tmp_path / "a.hdf5").conventions)


@pytest.mark.parametrize("mark", ["Config/VORONOI", "PartType0/CenterOfMass", "PartType0/GFM_Metallicity"])
def test_cells_of_a_moving_mesh_say_what_is_made_of_them(mark, samples, tmp_path):
    samples.write_gadget_hdf5(tmp_path / "a.hdf5", samples.particles(), masses=np.arange(1.0, 8))
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        folder, name = mark.split("/")
        if folder == "Config":
            file.create_group(folder).attrs[name] = ""
        else:
            file[mark] = np.zeros(7)
        assert not any("moving mesh (AREPO) are read" in each for each in io.readers.hdf5.gadget(file, None).conventions)
        del file["PartType0/SmoothingLength"]
    table = io.read_table(tmp_path / "a.hdf5")
    assert any("moving mesh (AREPO) are read as SPH particles" in each for each in table.conventions)
    particles, report = io.particles_from_table(table, box=None)
    np.testing.assert_allclose(particles.volume[:7], table.columns["Masses"] / table.columns["Density"], rtol=1e-6)
    assert "neighbour" in report.support


NAMED = ("MassTable", "BoxSize", "Time", "Redshift", "NumPart_ThisFile", "NumPart_Total", "Dimension", "Code")


@pytest.mark.parametrize("name", NAMED)
def test_attributes_without_a_value_say_nothing(name, samples, tmp_path):
    path = with_header(tmp_path / "a.hdf5", samples, **{name: h5py.Empty("f8")})
    assert len(io.read_table(path)) == 7
    samples.write_gadget_hdf5(path, samples.particles(), swift_kernel="Wendland C2")
    with h5py.File(path, "a") as file:
        for group in ("Units", "Cosmology", "Parameters"):
            file.create_group(group).attrs[name] = h5py.Empty("f8")
        file["PartType0/Density"].attrs["U_M exponent"] = h5py.Empty("i4")
        file["HydroScheme"].attrs["Dimension"] = h5py.Empty("i4")
    np.testing.assert_allclose(io.read_table(path).support, 1.936492 * 0.5)


BAD = np.array([0.5, 0.5, -0.5, 0.5, 0.0, 0.5, 0.5])


@pytest.mark.parametrize("part_type", [0, 5])
def test_supports_that_are_none_stop_nothing_that_needs_none(part_type, samples, tmp_path):
    path = tmp_path / "a.hdf5"
    samples.write_gadget_hdf5(path, samples.particles(), part_type)
    with h5py.File(path, "a") as file:
        file.pop(f"PartType{part_type}/SmoothingLength", None)
        file[f"PartType{part_type}/SmoothingLength"] = BAD
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


def test_a_column_by_a_filter_that_is_missing_is_left_out_by_name(samples, tmp_path):
    samples.write_gadget_hdf5(tmp_path / "a.hdf5", samples.particles())
    samples.write_points(tmp_path / "b.hdf5", samples.particles())
    samples.write_phantom(tmp_path / "c.h5", samples.particles())
    for name, column in (("a.hdf5", "PartType0/Dust"), ("b.hdf5", "Dust"), ("c.h5", "particles/Dust")):
        with h5py.File(tmp_path / name, "a") as file:
            packed(file, column, np.arange(7.0))
        table = io.read_table(tmp_path / name)
        assert len(table) == 7 and "Dust" not in table.columns and "density" in map(str.lower, table.columns)
        assert sum("left out Dust" in said and "32999" in said for said in table.conventions) == 1
        refused(rf"there is no quantity 'Dust'.*left out Dust.*{MISSING}", io.read_particles, tmp_path / name, "Dust")


@pytest.mark.parametrize("column", ["Masses", "SmoothingLength", "Density"])
def test_a_column_that_supports_and_volumes_need_is_not_left_out(column, samples, tmp_path):
    samples.write_gadget_hdf5(tmp_path / "a.hdf5", samples.particles())
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        file.pop(f"PartType0/{column}", None)
        packed(file, f"PartType0/{column}", np.ones(7))
    refused(rf"a\.hdf5: `/PartType0/{column}` {MISSING}", io.read_table, tmp_path / "a.hdf5")
