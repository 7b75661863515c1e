"""HDF5 files, opened once it is known where their links lead, and read where their data is.

Flow: path -> [hdf5_guards: opened, members] -> data sets -> [read_dataset] -> the reader of a code -> ParticleTable.

A link may name another file, and HDF5 opens whatever lies there: a pipe that never ends, a file of somebody else. So files that
a file names must be regular ones in its folder or below it. A link that leads nowhere is an error where it stands for what is
needed; of any other column it is said.

A data set has a shape before it has data. Its storage is allocated when data is written: whole where it is contiguous, chunk by
chunk where it is chunked. So a run that was stopped, or a disk that was full, shows in what is allocated. Data may also lie in
other files: as raw bytes (external storage), or in data sets of which this one is a view (a virtual data set). All of them are
looked at, as HDF5 reads what it does not find as the fill value.
"""

from __future__ import annotations

import contextlib
import functools
import math
import os
from collections.abc import Container, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxsph.io.damage import DataError, explained, inside, regular_file, require
from jaxsph.io.parsing import DEFLATE_RATIO
from jaxsph.io.table import plain, refuse_shape

PURPOSE = "reading HDF5 files"
DEFLATE, SHUFFLE, FLETCHER32, LZF = 1, 2, 3, 32000
BOUNDED_FILTERS = {DEFLATE, SHUFFLE, FLETCHER32, LZF}
"""Filters that shrink data at most `DEFLATE_RATIO` times; others may have no such bound."""
MAX_CHUNK = 2**27  # bytes of a chunk that may be larger than its data set, which grows
HEADERS = "Header", "header", "particles", "sinks", "Config", "Code", "HydroScheme", "Parameters", "Units", "Cosmology"
"""Groups at the top of files by which numbers are understood."""
WORDS = "not numbers"
COPY = "write its numbers into one file"


class FilterError(DataError):
    """Data is packed by a filter that is not installed."""


class Source(NamedTuple):
    """A data set that a view shows: its file, its name in it, and part of a sentence that names it."""

    path: Path
    name: str
    said: str


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Any]:
    """An `h5py.File` to read, none of whose links leads astray; what fails inside the block names `path`."""
    h5py, path = require("h5py", PURPOSE), regular_file(path)
    with explained(path, "HDF5"), h5py.File(path, "r") as file:
        check_links(path)
        yield file


def members(group: Any) -> dict[str, Any]:
    """All that a group holds, by name. Raises `ValueError`: a link that cannot be followed."""
    return {name: member(group, name) for name in group}


def member(group: Any, name: str) -> Any:
    """What a group holds by a name that is there; `ValueError` where it is a link that cannot be followed."""
    content = followed(group, name)
    if content is None:
        link = group.get(name, getlink=True)
        where = f"{group.name.rstrip('/')}/{name}"
        if link is None:
            raise DataError(f"has no `{where}`; write the file again with it")
        path, file = getattr(link, "path", None), getattr(link, "filename", None)
        target = "is damaged" if path is None else f"is a link to `{path}`" + (f" in `{file}`" if file is not None else "")
        raise DataError(f"`{where}` {target}, which cannot be followed; put back what it leads to, or remove the link")
    return content


def followed(group: Any, name: str) -> Any:
    """What a group holds by a name; None where there is nothing, or a link that cannot be followed."""
    with contextlib.suppress(KeyError, RuntimeError, OSError):  # a link to itself, a file that is none of HDF5
        return group.get(name)
    return None


def holds(group: Any, name: str) -> bool:
    """Whether a group has something of this name, be it a link that leads nowhere."""
    return hasattr(group, "id") and hasattr(group.id, "links") and bool(group.id.links.exists(name.encode()))


def check_links(path: Path) -> None:
    """Refuse a file with links that lead astray, or at its top nowhere; asked once of a file that does not change."""
    known = path.stat()
    _check_links(path, known.st_mtime_ns, known.st_size, known.st_ino)


def file_of(file: Any, name: str, what: str) -> Path | None:
    """The file that HDF5 opens for a name that stands in an open `file`; None where there is none. `what` names it in errors."""
    path = Path(os.path.abspath(file.filename))
    folders = path.parent, Path.cwd(), path.resolve().parent  # in this order HDF5 looks
    names = (name, Path(name).name) if os.path.isabs(name) else (name,)
    places = [folder / each for each in names for folder in folders]
    place = next((place for place in places if os.path.lexists(place)), None)
    return None if place is None else inside(place, path, what)


@functools.lru_cache(maxsize=4096)
def _check_links(path: Path, *_: int) -> None:
    h5py = require("h5py", PURPOSE)
    visited, left = {path.resolve()}, [path]
    while left:
        with h5py.File(left.pop(), "r") as file:
            for group, name in _external_links(file):
                named = os.fsdecode(group.links.get_val(name)[0])
                other = file_of(file, named, f"`{name.decode(errors='replace')}` is a link to `{named}`")
                if other is not None and other.resolve() not in visited and h5py.is_hdf5(other):
                    visited.add(other.resolve())
                    left.append(other)
    with h5py.File(path, "r") as file:
        for header in HEADERS:
            if holds(file, header):
                member(file, header)


def _external_links(file: Any) -> Iterator[tuple[Any, bytes]]:
    """Each with the group that holds it, over all groups: a group may hold itself, so each is met once."""
    h5py = require("h5py", PURPOSE)
    visited, left = set(), [file["/"].id]
    while left:
        group = left.pop()
        for name in list(group):
            kind = group.links.get_info(name).type
            if kind == h5py.h5l.TYPE_EXTERNAL:
                yield group, name
            if kind != h5py.h5l.TYPE_HARD:
                continue
            known = h5py.h5o.get_info(group, name)
            if known.type == h5py.h5o.TYPE_GROUP and known.addr not in visited:
                visited.add(known.addr)
                left.append(h5py.h5g.open(group, name))


def read_dataset(dataset: Any) -> np.ndarray:
    """All of an `h5py.Dataset`."""
    if shape_of(dataset) is None:
        raise DataError(f"`{dataset.name}` holds no data; write the file again with a data set there")
    refuse_unwritten(dataset)
    return np.asarray(dataset[()])


def read_positions(dataset: Any) -> np.ndarray:
    """The positions (N, 3) of an `h5py.Dataset`; `ValueError` for other shapes, before they are read."""
    shape = shape_of(dataset)
    if shape is None or len(shape) != 2 or shape[1] != 3 or dataset.dtype.kind not in "fiu":
        raise DataError(f"`{dataset.name}` must hold numbers of shape (N, 3), got {shape}; write three coordinates a particle")
    return read_dataset(dataset)


def columns_beside(
    positions: str, group: Any, count: int, needed: Container[str] = ()
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Data sets of numbers, but `positions`, with `count` rows, and a sentence on each other, which nobody may ask for.

    Raises `ValueError`: what is `needed` has another number of rows, was never written, or cannot be read.
    """
    columns, said = {}, []
    for name in filter(lambda name: name != positions, group):
        try:
            column = _column(group, name, count, needed)
        except DataError as error:
            if plain(name) in needed and str(error) != WORDS:
                raise type(error)(str(error).replace("it has", f"{group.name[1:]}/{name} has")) from error
            said.append(f"left out {name}: {error}")
        else:
            if column is not None:
                columns[name] = column
    return columns, said


def _column(group: Any, name: str, count: int, needed: Container[str]) -> np.ndarray | None:
    """Numbers of `count` particles; None of a group, or of more axes or fewer than columns have."""
    dataset = member(group, name)
    shape = shape_of(dataset)
    one = group.name == "/" and shape in ((), (1,)) and plain(name) in needed and dataset.dtype.kind in "fiu"
    if one:  # for all
        return np.full(count, read_dataset(dataset).reshape(()))
    if shape is None or len(shape) not in (1, 2):
        return None
    try:
        kind = dataset.dtype.kind
    except TypeError:  # types that NumPy has not
        kind = "V"
    if kind not in "fiub":
        raise DataError(WORDS)
    refuse_shape(shape, count)
    return read_dataset(dataset)


def shape_of(dataset: Any) -> tuple[int, ...] | None:
    """The shape of a data set, which of some views HDF5 opens files to know; None of what is none, or has no data."""
    if getattr(dataset, "is_virtual", False):
        _sources(dataset)
    shape: tuple[int, ...] | None = getattr(dataset, "shape", None)
    return shape


def refuse_unwritten(dataset: Any) -> None:
    """Refuse a data set some of whose data was never written, is cut short, or lies in another that is not there."""
    needed = math.prod(shape_of(dataset) or ()) * dataset.dtype.itemsize
    if needed == 0:
        return
    if dataset.is_virtual:
        return _refuse_gaps(dataset)
    if dataset.external:
        return _refuse_short_storage(dataset, needed)
    what, stored = f"`{dataset.name}` has shape {dataset.shape}", dataset.id.get_storage_size()
    if dataset.chunks is not None:
        unpacked = math.prod(dataset.chunks) * dataset.dtype.itemsize
        if unpacked > max(needed, MAX_CHUNK):
            raise DataError(f"{what}, but chunks of {unpacked} bytes, each unpacked as a whole; write it in smaller ones")
        written = dataset.id.get_num_chunks()
        chunks = math.prod(-(-size // chunk) for size, chunk in zip(dataset.shape, dataset.chunks, strict=True))
        if written < chunks:
            wrong = f"{what}, but only {written} of its {chunks} chunks were ever written:"
            raise DataError(f"{wrong} the others would be read as {dataset.fillvalue}; write the file again, or copy it again")
    if needed > stored * _most_per_byte(dataset):
        again = "write the file again, or copy it again"
        raise DataError(f"{what}, which needs {needed} bytes, but only {stored} were ever written; {again}")


def _most_per_byte(dataset: Any) -> float:
    """How many bytes one stored byte can become. Raises `FilterError`: that cannot be, without what packed it."""
    pipeline, available = dataset.id.get_create_plist(), require("h5py", PURPOSE).h5z.filter_avail
    filters = {each[0]: each[3].decode(errors="replace") for each in map(pipeline.get_filter, range(pipeline.get_nfilters()))}
    if not all(map(available, filters)):
        with contextlib.suppress(ImportError):
            import hdf5plugin  # noqa: F401 (it brings those that are common)
    for number, name in filters.items():
        if not available(number):
            called = f"{number} ({name})" if name else f"{number}"
            packed = f"`{dataset.name}` is packed by the HDF5 filter {called}"
            raise FilterError(f"{packed}, which is not installed; `pip install hdf5plugin`")
    if not filters:
        return 1
    return DEFLATE_RATIO if filters.keys() <= BOUNDED_FILTERS else math.inf


def _refuse_short_storage(dataset: Any, needed: int) -> None:
    """Raw bytes in other files: as many as are needed, from each its part.

    HDF5 looks for them, unlike for all other files, from where the process was started, unless told otherwise.
    """
    left, file = needed, Path(os.path.abspath(dataset.file.filename))
    folder = os.environ.get("HDF5_EXTFILE_PREFIX", ".").replace("${ORIGIN}", str(file.parent))
    for name, offset, size in dataset.external:
        place, what = Path(os.path.abspath(folder)) / name, f"`{dataset.name}` lies in `{name}`"
        if not os.path.lexists(place):
            raise DataError(f"{what}, and there is no {place}; start the program in the folder of that file, or {COPY}")
        path, part = inside(place, file, what), min(size, left)
        there = path.stat().st_size
        if there < offset + part:
            wrong = f"{what}, which must have {offset + part} bytes and has {there}:"
            raise DataError(f"{wrong} the others would be read as zeros; copy that file again")
        left -= part
    if left > 0:
        raise DataError(f"`{dataset.name}` needs {needed} bytes, {left} of which lie nowhere; write the file again")


def _sources(dataset: Any) -> list[Source]:
    """What a view shows, in files that are there and may be opened."""
    names = [(source.file_name, source.dset_name) for source in dataset.virtual_sources()]
    paths = {file: _source_file(dataset, file) for file in {file for file, _ in names}}
    if any("%" in dset for _, dset in names):
        raise DataError(f"`{dataset.name}` is a view of data sets by a pattern: how many there must be is not said; {COPY}")
    return [Source(paths[file], dset, f"`{dataset.name}` is a view of `{dset}` in `{file}`") for file, dset in names]


def _source_file(dataset: Any, name: str) -> Path:
    what = f"`{dataset.name}` is a view of `{name}`"
    if "%" in name:
        raise DataError(f"{what}, a pattern of names: how many there must be is not said; {COPY}")
    if name == ".":
        return Path(dataset.file.filename)
    path = file_of(dataset.file, name, what)
    if path is None:
        instead = f"its part would be read as {dataset.fillvalue}"
        raise DataError(f"{what}, which is not there: {instead}; put that file beside this one")
    check_links(path)
    return path


def _refuse_gaps(dataset: Any) -> None:
    """A view is whole where all that it shows is there, and what it shows is all of it."""
    if None in dataset.maxshape:
        raise DataError(f"`{dataset.name}` is a view of what grows: how much there must be is not said; {COPY}")
    h5s, each = require("h5py", PURPOSE).h5s, (1,) * len(dataset.shape)
    covered = h5s.create_simple(dataset.shape)
    covered.select_none()
    for source, mapping in zip(_sources(dataset), dataset.virtual_sources(), strict=True):
        known = source.path.stat()
        there = _source_shape(source, known.st_mtime_ns, known.st_size, known.st_ino)
        space, shown = mapping.src_space, mapping.vspace.get_select_npoints()
        if space.get_select_type() == h5s.SEL_ALL:  # shown whole, so just as many
            fits = math.prod(there) == shown
        else:
            last = space.get_select_bounds()[1]
            fits = len(last) == len(there) and all(end < size for end, size in zip(last, there, strict=True))
            fits = fits and space.get_select_npoints() == shown
        if not fits:
            little = "too little for what is shown"
            raise DataError(f"{source.said}, which has the shape {there} there: {little}; write the file again")
        if shown:
            lower, upper = (np.array(edge, np.int64) for edge in mapping.vspace.get_select_bounds())
            block = tuple((upper + 1 - lower).tolist())
            if math.prod(block) != shown:
                raise DataError(f"`{dataset.name}` is a view by parts that are no blocks, and is not followed; {COPY}")
            covered.select_hyperslab(tuple(lower.tolist()), each, block=block, op=h5s.SELECT_OR)
    if covered.get_select_npoints() < math.prod(dataset.shape):
        wrong = f"`{dataset.name}` has shape {dataset.shape}, but is a view of {covered.get_select_npoints()} numbers only:"
        raise DataError(f"{wrong} the others would be read as {dataset.fillvalue}; write the file again")


@functools.lru_cache(maxsize=65536)
def _source_shape(source: Source, *_: int) -> tuple[int, ...]:
    """Asked once of a file that does not change: a view of thousands of files is read part by part."""
    h5py = require("h5py", PURPOSE)
    with h5py.File(source.path, "r") as file:
        if source.name not in file:
            raise DataError(f"{source.said}, which is not there: it would be read as its fill value; copy that file again")
        dataset = member(file, source.name)
        if not isinstance(dataset, h5py.Dataset):
            raise DataError(f"{source.said}, which is no data set; write the file again")
        if dataset.is_virtual:
            raise DataError(f"{source.said}, which is a view itself: views of views are not followed; {COPY}")
        try:
            refuse_unwritten(dataset)
        except DataError as error:
            raise type(error)(f"{source.said}: there {error}") from error
        return tuple(dataset.shape)
