"""Small files of every format are changed and read: what comes out, and what the file itself would have betrayed.

| outcome | of a changed file |
|---|---|
| refused | a `ValueError` of one line that names the file |
| same | read, and every array that is read is one of the whole file |
| other | other numbers, where nothing in the file could tell: raw numbers have no check sum, text has no length |
| unseen | other numbers, though a check sum, a length or a count in the file betrays them |
| failed | another exception, more lines, no name, more than `SECONDS`, or more memory than `MEMORY` and ten times the file |

What a format betrays is of three kinds: of compressed data every change, of raw data of a stated length every change of its
length, and of every format other counts than it states.
"""

import collections
import contextlib
import dataclasses
import re
import time
import tracemalloc
import warnings
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np

import jaxsph.io as io

SECONDS, MEMORY, TIMES = 5, 2**24, 10
"""Of memory, LZMA alone takes half for its dictionary."""
Spans = list[tuple[int, int]]


@dataclasses.dataclass(frozen=True)
class Kind:
    """How a file is read, and what it betrays: any change in `checked`, any change of length in `exact`, and `counts`."""

    read: Callable[[Path], list[np.ndarray]]
    checked: Callable[[bytes], Spans] = lambda content: []
    exact: Callable[[bytes], Spans] = lambda content: []
    counts: tuple[tuple[bytes, bytes], ...] = ()


@contextlib.contextmanager
def measured():
    """`with measured() as taken:`, and then `taken.peak` in bytes, of Python and NumPy, and `taken.seconds`."""
    taken, began = SimpleNamespace(peak=0, seconds=0.0), time.monotonic()
    tracemalloc.start()
    try:
        yield taken
    finally:
        taken.peak, taken.seconds = tracemalloc.get_traced_memory()[1], time.monotonic() - began
        tracemalloc.stop()


def table(path):
    found = io.read_table(path)
    assert np.isfinite(found.position).all() and {"x", "y", "z"} <= set(io.available_quantities(found))
    assert found.position.shape == (len(found), 3) and all(len(column) == len(found) for column in found.columns.values())
    return [found.position, *found.columns.values(), *(each for each in (found.support, found.volume) if each is not None)]


def volume(path):
    found = io.read_volume_table(path)
    return [*found.arrays.values(), found.lower, found.spacing]


def image(path):
    found = io.read_image(path)
    return [np.asarray(layer) for layer in (found.color, found.transmittance, found.depth, found.error_bound, found.evaluations)]


def whole(content):
    return [(0, len(content))]


def behind(mark, before=b""):
    """From behind `mark` to `before`, or the end."""

    def spans(content):
        stop = content.index(before) if before else len(content)
        return [(content.index(mark) + len(mark), stop)]

    return spans


def base64_runs(content):
    return [match.span() for match in re.finditer(rb"[A-Za-z0-9+/]{40,}={0,2}", content)]


def zlib_chunks(content):
    """Where compressed data of an HDF5 file lies, as it is written at the default level."""
    starts = [match.start() for match in re.finditer(rb"\x78[\x5e\x9c]", content)]
    return [(start, start + 60) for start in starts if start + 60 < len(content)]


def second_half(content):
    return [(len(content) // 2, len(content) - 16)]


HEADER_OF_PLY = behind(b"end_header\n")
KINDS = {
    "a.npz": Kind(table, checked=whole),
    "stored.npz": Kind(table, checked=whole),
    "polydata.vtk": Kind(table, exact=behind(b"POINTS 60 float\n", b"\nVERTICES"), counts=((b"POINTS 60", b"POINTS %d"),)),
    "ascii.vtk": Kind(table, counts=((b"POINTS 60", b"POINTS %d"),)),
    "a.vtu": Kind(table, checked=base64_runs, counts=((b'NumberOfPoints="60"', b'NumberOfPoints="%d"'),)),
    "ascii.vtu": Kind(table, counts=((b'NumberOfPoints="60"', b'NumberOfPoints="%d"'),)),
    "plain.vtu": Kind(table, counts=((b'NumberOfPoints="60"', b'NumberOfPoints="%d"'),)),
    "lzma.vtu": Kind(table, checked=base64_runs),
    "appended.vtu": Kind(table, exact=behind(b">_", b"</AppendedData>"), counts=((b'Points="60"', b'Points="%d"'),)),
    "big.ply": Kind(table, exact=HEADER_OF_PLY, counts=((b"vertex 60", b"vertex %d"), (b"property float density\n", b""))),
    "little.ply": Kind(table, exact=HEADER_OF_PLY, counts=((b"vertex 60", b"vertex %d"), (b"property float vx\n", b""))),
    "ascii.ply": Kind(table, counts=((b"vertex 60", b"vertex %d"),)),
    "plain.bgeo": Kind(table, exact=lambda content: [(41, len(content))], counts=((b"\0\0\0\x3c", b"\0\0\0%c"),)),
    "zipped.bgeo": Kind(table, checked=whole),
    "two.gadget": Kind(table, exact=whole),
    "one.gadget": Kind(table, exact=whole),
    "disc_00010": Kind(table, exact=whole),
    "a.tipsy": Kind(table, exact=whole, counts=((b"\0\0\0\x3c", b"\0\0\0%c"),)),
    "a.csv": Kind(table),
    "a.xmf": Kind(table, counts=((b'Dimensions="60 3"', b'Dimensions="%d 3"'),)),
    "pysph.h5": Kind(table),
    "a.txt": Kind(table),
    "a.xyz": Kind(table, counts=((b"60\n", b"%d\n"),)),
    "extended.xyz": Kind(table, counts=((b"60\n", b"%d\n"),)),
    "gadget.hdf5": Kind(table),
    "swift.hdf5": Kind(table),
    "phantom.h5": Kind(table),
    "packed.hdf5": Kind(table, checked=zlib_chunks),
    "v.npy": Kind(volume, exact=lambda content: [(128, len(content))], counts=((b"(6, 7, 8)", b"(6, 7, %d)"),)),
    "raw.nrrd": Kind(volume, exact=behind(b"\n\n"), counts=((b"sizes: 6 7 8", b"sizes: 6 7 %d"),)),
    "packed.nrrd": Kind(volume, checked=behind(b"\n\n"), counts=((b"sizes: 6 7 8", b"sizes: 6 7 %d"),)),
    "ascii.nrrd": Kind(volume, counts=((b"sizes: 6 7 8", b"sizes: 6 7 %d"),)),
    "v.nii": Kind(volume, exact=lambda content: [(352, len(content))], counts=((b"\x06\0\x07\0\x08\0", b"\x06\0\x07\0%c\0"),)),
    "v.nii.gz": Kind(volume, checked=whole),
    "v.vti": Kind(volume, exact=behind(b"\n_", b"</AppendedData>"), counts=((b"0 7", b"0 %d"),)),
    "a.exr": Kind(image, checked=second_half),
    "a.png": Kind(image, checked=whole),
}
COMPRESSED = [
    name for name, kind in KINDS.items() if kind.checked is not Kind.checked and name != "stored.npz" and not name.endswith("x")
]


def write_all(folder, samples):
    """A whole file of every kind, 60 particles or 6 x 7 x 8 values."""
    import nibabel
    import nrrd

    import jaxsph as js

    particles = samples.particles(60)
    for name in KINDS.keys() & samples.writers.keys():
        samples.writers[name](folder / name, particles)
    np.savez(folder / "stored.npz", position=particles.position, density=particles.density, support=0.5)
    samples.write_ply(folder / "little.ply", particles, "binary_little_endian")
    samples.write_vtu(folder / "lzma.vtu", particles, compression="lzma")
    samples.write_points(folder / "packed.hdf5", particles, compression="gzip")
    (folder / "a.txt").write_text((folder / "a.csv").read_text().replace(",", " "))
    write_appended(folder / "appended.vtu", particles)
    write_tipsy(folder / "a.tipsy", particles)
    values = np.random.default_rng(0).random((6, 7, 8)).astype(np.float32)
    np.save(folder / "v.npy", values)
    for name, encoding in (("raw", "raw"), ("packed", "gzip"), ("ascii", "ascii")):
        nrrd.write(str(folder / f"{name}.nrrd"), values, {"encoding": encoding})
    for name in ("v.nii", "v.nii.gz"):
        nibabel.save(nibabel.Nifti1Image(values, np.eye(4)), str(folder / name))
    io.write_volume(folder / "v.vti", js.Volume.from_array(values, (0, 0, 0), (1, 1, 1)))
    layer, color = values[:, :, 0], values[:, :, :3]
    for name in ("a.exr", "a.png"):
        io.write_image(folder / name, js.Image(color, layer, layer, layer, layer, True, 0, {}, ()))


def write_appended(path, particles):
    arrays = [particles.position.astype("<f4").tobytes(), particles.density.astype("<f4").tobytes()]
    stored = [len(array).to_bytes(4, "little") + array for array in arrays]
    head = f"""<VTKFile type="PolyData" byte_order="LittleEndian" header_type="UInt32"><PolyData>
<Piece NumberOfPoints="60"><Points>
<DataArray type="Float32" NumberOfComponents="3" format="appended" offset="0"/></Points><PointData>
<DataArray type="Float32" Name="density" format="appended" offset="{len(stored[0])}"/></PointData></Piece></PolyData>
<AppendedData encoding="raw">_"""
    path.write_bytes(head.encode() + b"".join(stored) + b"\n</AppendedData></VTKFile>\n")


def write_tipsy(path, particles):
    number = len(particles.position)
    header = np.array([(1.0, number, 3, number, 0, 0)], [("time", ">f8"), *((name, ">i4") for name in "abcde")])
    rows = np.zeros((number, 12), ">f4")
    rows[:, 0], rows[:, 1:4], rows[:, 4:7], rows[:, 7] = 2, particles.position, particles.velocity, particles.density
    path.write_bytes(header.tobytes() + rows.tobytes())


def changed(content, kind, rng):
    """The content with one change, and whether the file betrays it."""
    start, stop = sorted(int(place) for place in rng.integers(0, len(content) + 1, 2))
    short = min(start + int(rng.integers(1, 17)), len(content))
    betrayed = lambda first, last, spans: any(low <= first and last <= high for low, high in spans)  # noqa: E731
    exact = [*kind.exact(content), *kind.checked(content)]
    match int(rng.integers(0, 7)):
        case 0:
            return content[:start], betrayed(start, len(content), exact)
        case 1:
            return content[:start] + rng.bytes(short - start) + content[start:], betrayed(start, start, exact)
        case 2:
            return content[:start] + content[short:], betrayed(start, short, exact)
        case 3:
            return content[:stop] + content[start:stop] + content[stop:], betrayed(start, stop, exact)
        case 4:
            value = bytes([int(rng.choice([0, 1, 2, 127, 128, 255]))]) * int(rng.choice([1, 2, 4, 8]))
            return content[:start] + value + content[start + len(value) :], betrayed(start, start + 8, kind.checked(content))
        case _ if kind.counts:
            old, new = kind.counts[int(rng.integers(0, len(kind.counts)))]
            other = new % int(rng.choice([1, 2, 3, 5, 6, 9, 61, 70, 120])) if b"%" in new else new
            assert old in content, old
            return content.replace(old, other, 1), True
        case _:
            return flipped(content, whole(content), rng), False


def flipped(content, spans, rng):
    """The content with one bit of the spans turned."""
    first, last = spans[int(rng.integers(0, len(spans)))]
    place, bit = int(rng.integers(first, last)), int(rng.integers(0, 8))
    return content[:place] + bytes([content[place] ^ 1 << bit]) + content[place + 1 :]


def outcome(path, kind, expected, is_betrayed, memory=MEMORY):
    """What reading gives, and what is to be said of it."""
    found, said = None, ""
    with measured() as taken, warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        try:
            found = kind.read(path)
        except ValueError as error:
            said = "" if path.name in str(error) and "\n" not in str(error) else repr(error)
        except Exception as error:
            said = repr(error)
    if said:
        return "failed", said
    if taken.peak > memory + TIMES * path.stat().st_size or taken.seconds > SECONDS:
        return "failed", f"{taken.peak} bytes, {taken.seconds:.1f} s"
    if found is None:
        return "refused", ""
    if all(any(np.array_equal(one, other, equal_nan=True) for other in expected) for one in found):
        return "same", ""
    return ("unseen", "other numbers than were written") if is_betrayed else ("other", "")


def counted(name, original, folder, number, seed=0, bits=False):
    """Outcomes of `number` changes of a file, or of single bits of what it checks, and what was wrong with them."""
    kind, content = KINDS[name], Path(original).read_bytes()
    expected, counts, wrong = kind.read(Path(original)), collections.Counter(), []
    path = Path(folder) / name
    for nth in range(number):
        rng = np.random.default_rng([seed, nth, *name.encode()])
        damaged, is_betrayed = (flipped(content, kind.checked(content), rng), True) if bits else changed(content, kind, rng)
        path.write_bytes(damaged)
        result, said = outcome(path, kind, expected, is_betrayed)
        counts[result] += 1
        if said:
            wrong.append(f"{name}, change {nth}: {result}: {said}")
    return counts, wrong
