"""Small files of every format, written from scratch: readers are tested against the format, not against themselves."""

import functools
import gzip
import struct
from types import SimpleNamespace

import numpy as np

COUNT = 7


def make_particles(count=COUNT, seed=0):
    """Positions, velocities, densities and ids that float32 and three decimals hold exactly (multiples of 1/8)."""
    rng = np.random.default_rng(seed)
    eighths = lambda low, high, shape: (rng.integers(8 * low, 8 * high, shape) / 8).astype(np.float32)  # noqa: E731
    return SimpleNamespace(
        position=eighths(-4, 4, (count, 3)),
        velocity=eighths(-2, 2, (count, 3)),
        density=eighths(1, 9, count),
        id=np.arange(10, 10 + count, dtype=np.int32),
    )


def write_npz(path, p):
    columns = {"position": p.position, "velocity": p.velocity, "density": p.density, "id": p.id}
    np.savez_compressed(path, **columns, support_radius=0.5, particle_mass=2.0, time=3.0)


def write_vtk(path, p, dataset="POLYDATA", binary=True, scalar_width="1"):
    n = len(p.position)
    encode = (
        (lambda a, kind: a.astype(kind).tobytes())
        if binary
        else (lambda a, kind: "\n".join(" ".join(map(str, row)) for row in np.atleast_2d(a.T).T.tolist()).encode())
    )
    cells = np.stack([np.ones(n, np.int32), np.arange(n, dtype=np.int32)], axis=1)
    out = b"# vtk DataFile Version 3.0\ntitle\n" + (b"BINARY" if binary else b"ASCII") + b"\nDATASET " + dataset.encode() + b"\n"
    out += b"POINTS %d float\n" % n + encode(p.position, ">f4") + b"\n"
    if dataset == "POLYDATA":
        out += b"VERTICES %d %d\n" % (n, 2 * n) + encode(cells, ">i4") + b"\n"
    else:
        out += b"CELLS %d %d\n" % (n, 2 * n) + encode(cells, ">i4") + b"\n"
        out += b"CELL_TYPES %d\n" % n + encode(np.ones(n, np.int32), ">i4") + b"\n"
    out += b"POINT_DATA %d\nSCALARS id int %s\nLOOKUP_TABLE default\n" % (n, scalar_width.encode()) + encode(p.id, ">i4") + b"\n"
    out += b"FIELD FieldData 2\nvelocity 3 %d float\n" % n + encode(p.velocity, ">f4") + b"\n"
    out += b"density 1 %d float\n" % n + encode(p.density, ">f4") + b"\n"
    path.write_bytes(out)


def write_vtk5(path, p):
    n = len(p.position)
    out = b"# vtk DataFile Version 5.1\ntitle\nBINARY\nDATASET POLYDATA\n"
    out += b"POINTS %d double\n" % n + p.position.astype(">f8").tobytes() + b"\nMETADATA\nINFORMATION 1\nNAME x\nDATA y\n\n"
    out += b"VERTICES %d %d\nOFFSETS vtktypeint64\n" % (n + 1, n) + np.arange(n + 1).astype(">i8").tobytes()
    out += b"\nCONNECTIVITY vtktypeint64\n" + np.arange(n).astype(">i8").tobytes() + b"\n"
    out += b"CELL_DATA %d\nSCALARS cell float\nLOOKUP_TABLE default\n" % n + np.zeros(n, ">f4").tobytes() + b"\n"
    out += b"POINT_DATA %d\nVECTORS velocity double\n" % n + p.velocity.astype(">f8").tobytes() + b"\n"
    path.write_bytes(out)


def write_vtu(path, p, **options):
    import meshio

    cells = [("vertex", np.arange(len(p.position))[:, None])]
    data = {"velocity": p.velocity, "density": p.density[:, None], "id": p.id}
    meshio.Mesh(p.position, cells, point_data=data).write(path, **options)


def write_ply(path, p, encoding="binary_big_endian"):
    n = len(p.position)
    header = f"ply\nformat {encoding} 1.0\ncomment made by hand\nelement vertex {n}\n"
    for name in ("x", "y", "z", "vx", "vy", "vz", "density"):
        header += f"property float {name}\n"
    header += "property int id\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"
    if encoding == "ascii":
        rows = np.column_stack([p.position, p.velocity, p.density, p.id]).tolist()
        body = "".join(" ".join(map(str, [*row[:-1], int(row[-1])])) + "\n" for row in rows).encode()
    else:
        order = ">" if encoding == "binary_big_endian" else "<"
        record = np.zeros(n, [("f", order + "f4", 7), ("i", order + "i4")])
        record["f"], record["i"] = np.column_stack([p.position, p.velocity, p.density]), p.id
        body = record.tobytes()
    path.write_bytes(header.encode() + body)


def write_bgeo(path, p, names=("id", "density", "velocity"), compressed=True, overwrite=False):
    out = b"BgeoV" + struct.pack(">9i", 5, len(p.position), 0, 0, 0, len(names), 0, 0, 0)
    columns = [np.column_stack([p.position, np.ones(len(p.position))]).astype(">f4").view(">i4")]
    if overwrite:
        columns[0][:, 0] = p.id
    for name in names:
        values = np.atleast_2d(getattr(p, name).T).T
        kind = 1 if values.dtype.kind == "i" else (5 if values.shape[1] == 3 else 0)
        out += struct.pack(">H", len(name)) + name.encode() + struct.pack(">Hi", values.shape[1], kind)
        out += bytes(4 * values.shape[1])
        columns.append(values.astype(">i4" if kind == 1 else ">f4").view(">i4"))
    out += np.hstack(columns).astype(">i4").tobytes() + b"\x00\xff"
    path.write_bytes(gzip.compress(out) if compressed else out)


def write_gadget_hdf5(path, p, part_type=0, masses=None, swift_kernel=None):
    import h5py

    with h5py.File(path, "w") as file:
        header = file.create_group("Header").attrs
        table = np.zeros(6)
        table[part_type] = 0 if masses is not None else 2.0
        header.update({"MassTable": table, "BoxSize": 16.0, "NumFilesPerSnapshot": 1})
        group = file.create_group(f"PartType{part_type}")
        group["Coordinates"], group["Velocities"], group["ParticleIDs"] = p.position, p.velocity, p.id
        if masses is not None:
            group["Masses"] = masses
        if part_type == 0:
            group["Density"] = p.density
            group["SmoothingLengths" if swift_kernel else "SmoothingLength"] = np.full(len(p.position), 0.5, np.float32)
        if swift_kernel:
            header["Code"] = np.bytes_("SWIFT")
            file.create_group("HydroScheme").attrs["Kernel function"] = np.bytes_(swift_kernel)


def write_phantom(path, p, h=None, itype=None):
    import h5py

    n = len(p.position)
    with h5py.File(path, "w") as file:
        header, group = file.create_group("header"), file.create_group("particles")
        header["hfact"], header["massoftype"] = 1.25, np.array([2.0, 0.0, 3.0])
        group["xyz"], group["vxyz"] = p.position.astype(np.float64), p.velocity
        group["h"] = np.full(n, 0.5, np.float32) if h is None else h
        group["itype"] = np.ones(n, np.int8) if itype is None else itype
        file.create_group("sinks")


def fortran(*parts, order="<", limit=2**31 - 9):
    """A record as gfortran writes it: in several of at most `limit` bytes, the signs of whose lengths say which go on."""
    data = b"".join(np.asarray(part).tobytes() if not isinstance(part, bytes) else part for part in parts)
    pieces = [data[at : at + limit] for at in range(0, len(data), limit)] or [b""]
    last, made = len(pieces) - 1, b""
    for n, piece in enumerate(pieces):
        head, tail = (len(piece) if n == last else -len(piece)), (-len(piece) if n else len(piece))
        made += np.array(head, f"{order}i4").tobytes() + piece + np.array(tail, f"{order}i4").tobytes()
    return made


PHANTOM_HEADER = {
    "i0": {"nparttot": [7], "ntypes": [7], "npartoftype": [7, 0, 0, 0, 0, 0, 0], "nblocks": [1]},
    "i8": {"nparttot": [7], "npartoftype": [7, 0, 0, 0, 0, 0, 0]},
    "f0": {"time": [3.0], "hfact": [1.25], "massoftype": [2.0, 0.0, 3.0, 0.0, 0.0, 0.0, 0.0]},
    "f8": {"udist": [1e16], "umass": [2e33], "utime": [1e10], "umagfd": [1.0]},
}


def phantom_records(
    blocks, header=PHANTOM_HEADER, *, order="<", int_bytes=4, real_bytes=8, name="FT:Phantom:2025.0.0", limit=2**31 - 9
):
    """The records of a dump: `blocks` are (rows, {kind: {tag: array}}), kinds i0 (default), i1 .. i8, f0 (default), f4, f8."""
    kinds = ("i0", "i1", "i2", "i4", "i8", "f0", "f4", "f8")
    stored = {"i0": f"{order}i{int_bytes}", "f0": f"{order}f{real_bytes}"}
    dtype = {kind: np.dtype(stored.get(kind, f"{order}{kind}")) for kind in kinds}
    record, letters = functools.partial(fortran, order=order, limit=limit), lambda tag: tag.encode().ljust(16)
    magic = [np.array(v, dtype["f0" if n == 1 else "i0"]) for n, v in enumerate((60769, 60878, 60878, 1, 690706))]
    made = [record(*magic), record(name.encode().ljust(100))]
    for kind in kinds:
        values = [(tag, value) for tag, each in header.get(kind, {}).items() for value in each]
        made.append(record(np.array(len(values), f"{order}i4")))
        if values:
            made += [record(*(letters(tag) for tag, _ in values)), record(np.array([v for _, v in values], dtype[kind]))]
    made.append(record(np.array(len(blocks), f"{order}i4")))
    processes = header.get("i0", {}).get("nblocks", [1])[0]
    for begin in range(0, len(blocks), len(blocks) // processes):
        piece = blocks[begin : begin + len(blocks) // processes]
        for rows, arrays in piece:
            made.append(
                record(np.array(rows, f"{order}i8"), np.array([len(arrays.get(kind, ())) for kind in kinds], f"{order}i4"))
            )
        for _, arrays in piece:
            for kind in kinds:
                for tag, values in arrays.get(kind, {}).items():
                    made += [record(letters(tag)), record(np.asarray(values, dtype[kind]))]
    return made


def phantom_particles(p, h=0.5, itype=1, real="f0", **more):
    """The block of particles: positions and velocities in reals of the kind `real`."""
    rows = len(p.position)
    vectors = {"xyz"[n]: p.position[:, n] for n in range(3)} | {"v" + "xyz"[n]: p.velocity[:, n] for n in range(3)}
    return rows, {"i1": {"itype": np.broadcast_to(itype, rows)}, real: vectors, "f4": {"h": np.broadcast_to(h, rows)} | more}


def write_phantom_native(path, p, **how):
    path.write_bytes(b"".join(phantom_records([phantom_particles(p), (0, {}), (0, {}), (0, {})], **how)))


def write_points(path, p, **options):
    import h5py

    with h5py.File(path, "w") as file:
        for name, values in {"Coordinates": p.position, "velocity": p.velocity, "density": p.density}.items():
            file.create_dataset(name, data=values, **options)


def write_gadget_binary(path, p, order="<", form=2, dark=0, masses=False):
    """Gas particles `p` and `dark` dark ones; supports 0.5, internal energy = density + 1."""
    n = len(p.position)
    counts = np.array([n, dark, 0, 0, 0, 0], f"{order}u4").tobytes()
    table = np.array([0 if masses else 2.0, 4.0, 0, 0, 0, 0], f"{order}f8").tobytes()
    head = counts + table + struct.pack(f"{order}ddii", 1.0, 0.0, 0, 0) + counts + struct.pack(f"{order}iid", 0, 1, 16.0)
    everyone = lambda a: np.concatenate([a, np.zeros((dark, *a.shape[1:]), a.dtype)])  # noqa: E731
    number = lambda a: a.astype(f"{order}f4").tobytes()  # noqa: E731
    blocks = {"HEAD": head.ljust(256, b"\0"), "POS": number(everyone(p.position)), "VEL": number(everyone(p.velocity))}
    blocks["ID"] = everyone(p.id).astype(f"{order}u4").tobytes()
    if masses:
        blocks["MASS"] = number(np.full(n, 3.0))
    blocks |= {"U": number(p.density + 1), "RHO": number(p.density), "HSML": number(np.full(n, 0.5))}
    record = lambda data: struct.pack(f"{order}I", len(data)) + data + struct.pack(f"{order}I", len(data))  # noqa: E731
    out = b""
    for name, data in blocks.items():
        if form == 2:
            out += record(name.ljust(4).encode() + struct.pack(f"{order}I", len(data) + 8))
        out += record(data)
    path.write_bytes(out)


def write_csv(path, p):
    rows = np.column_stack([p.position, p.velocity, p.density, p.id]).tolist()
    lines = ["x,y,z,velocity_x,velocity_y,velocity_z,density,id", *(",".join(map(str, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n")


def write_xyz(path, p):
    lines = [str(len(p.position)), "a comment", *(f"Ar {x} {y} {z}" for x, y, z in p.position.tolist())]
    path.write_text("\n".join(lines) + "\n")


def write_extended_xyz(path, p):
    rows = (f"18 {x} {y} {z} {density}" for (x, y, z), density in zip(p.position.tolist(), p.density.tolist(), strict=True))
    path.write_text("\n".join([str(len(p.position)), "Properties=Z:I:1:pos:R:3:density:R:1", *rows]) + "\n")


def write_pysph(path, p, boundary=3):
    import h5py

    with h5py.File(path, "w") as file:
        for name, count in (("fluid", len(p.position)), ("boundary", boundary)):
            group = file.create_group(f"particles/{name}/arrays")
            for axis, place in enumerate("xyz"):
                group[place], group["uvw"[axis]] = p.position[:count, axis], p.velocity[:count, axis]
            group["rho"], group["m"], group["gid"] = p.density[:count], np.full(count, 2.0), p.id[:count].astype("u4")
        file.create_group("solver_data").attrs["t"] = 0.5


def xdmf_item(values, place=None):
    kind, size = ("Int" if values.dtype.kind == "i" else "Float"), values.dtype.itemsize
    shape, text = " ".join(map(str, values.shape)), place or " ".join(map(str, values.ravel().tolist()))
    form = "HDF" if place else "XML"
    return f'<DataItem Dimensions="{shape}" NumberType="{kind}" Precision="{size}" Format="{form}">{text}</DataItem>'


def write_xdmf(path, p, place=xdmf_item):
    n = len(p.position)
    items = {name: place(values) for name, values in (("velocity", p.velocity), ("density", p.density), ("id", p.id))}
    fields = "".join(f'<Attribute Name="{name}" Center="Node">{item}</Attribute>' for name, item in items.items())
    topology = f'<Topology TopologyType="Polyvertex" NumberOfElements="{n}"/>'
    grid = f'{topology}\n<Geometry GeometryType="XYZ">{place(p.position)}</Geometry>'
    path.write_text(
        f'<?xml version="1.0"?>\n<Xdmf Version="3.0"><Domain><Grid Name="a">{grid}\n{fields}</Grid></Domain></Xdmf>\n'
    )


HDF5 = ["gadget.hdf5", "swift.hdf5", "phantom.h5", "points.hdf5"]
WRITERS = {
    "a.npz": write_npz,
    "polydata.vtk": write_vtk,
    "ascii.vtk": lambda path, p: write_vtk(path, p, "UNSTRUCTURED_GRID", binary=False),
    "five.vtk": write_vtk5,
    "a.vtu": write_vtu,
    "ascii.vtu": lambda path, p: write_vtu(path, p, binary=False),
    "plain.vtu": lambda path, p: write_vtu(path, p, compression=None),
    "big.ply": write_ply,
    "ascii.ply": lambda path, p: write_ply(path, p, "ascii"),
    "zipped.bgeo": write_bgeo,
    "plain.bgeo": lambda path, p: write_bgeo(path, p, compressed=False),
    "gadget.hdf5": write_gadget_hdf5,
    "swift.hdf5": lambda path, p: write_gadget_hdf5(path, p, swift_kernel="Wendland C2"),
    "phantom.h5": write_phantom,
    "disc_00010": write_phantom_native,
    "sphere_00020": lambda path, p: write_phantom_native(path, p, order=">", real_bytes=4),
    "points.hdf5": write_points,
    "two.gadget": write_gadget_binary,
    "one.gadget": lambda path, p: write_gadget_binary(path, p, ">", form=1),
    "pysph.h5": write_pysph,
    "a.xmf": write_xdmf,
    "a.csv": write_csv,
    "a.xyz": write_xyz,
    "extended.xyz": write_extended_xyz,
}
